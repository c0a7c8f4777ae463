"""Controllers compared at the same share of the time beyond a limit.

A controller that drives nearer saves less energy and misses the limit of the time gap less. Two
controllers are compared as curves over several limits, read where both miss as much.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.errors import ResultsError
from lcc_rl.results.intervals import Estimate, bounds, share_saved, weights

KINDS = ["variant", "policy"]
ENERGY, SHARE = "total_path_energy_kj", "share_time_gap_long_moving"
# Energy and share of one kind of controller, each ``[limits, windows, seeds]``.
Front = tuple[NDArray[np.float64], NDArray[np.float64]]


def front(windows: pd.DataFrame, kind: Sequence[str]) -> Front:
    """Return the means of one kind of controller by limit, window and seed.

    Args:
        windows: columns :data:`KINDS`, ``limit``, ``training_seed``, ``profile_id``, energy and
            share; a row per training and window.
        kind: variant and policy.

    Raises:
        ResultsError: if it is missing, or lacks a window or seed at one of its limits.
    """
    name = " ".join(kind)
    rows = windows[(windows[KINDS] == list(kind)).all(axis=1)]
    if rows.empty:
        raise ResultsError(f"there are no trainings of {name}")
    axes = ["limit", "profile_id", "training_seed"]
    sizes = [rows[axis].nunique() for axis in axes]
    if len(rows) != np.prod(sizes):
        raise ResultsError(
            f"{name}: {len(rows)} rows; expected every window and seed at every limit, "
            f"{' × '.join(map(str, sizes))}"
        )
    rows = rows.sort_values(axes)
    energy, share = (rows[column].to_numpy(float).reshape(sizes) for column in (ENERGY, SHARE))
    return energy, share


def energy_at(energy: NDArray[np.float64], share: NDArray[np.float64], at: float) -> float:
    """Return the energy of a front, ``[limits]`` each, at a share of ``at``.

    It is linear between the limits, that of the largest share if all are smaller, and NaN if none
    is as small.
    """
    order = np.argsort(share)
    return float(np.interp(at, share[order], energy[order], left=np.nan))


def saving_at(
    windows: pd.DataFrame, one: Sequence[str], other: Sequence[str], at: float
) -> Estimate:
    """Return the share of energy that one kind of controller saves against another.

    Both spend at most the same share of the time beyond the limit. The interval is that of
    :func:`lcc_rl.results.intervals.saving`, without resamples in which a front does not reach the
    share.

    Args:
        windows: see :func:`front`.
        one: variant and policy of the controller that saves.
        other: variant and policy of the controller that it is compared with.
        at: the largest share of the time.
    """
    fronts = [front(windows, kind) for kind in (one, other)]
    energies = [energy_at(e.mean((1, 2)), s.mean((1, 2)), at) for e, s in fronts]
    value = float(share_saved(*energies))
    drawn = weights(fronts[0][0].shape[1], 0)
    found = []
    for stream, parts in enumerate(fronts, 1):
        seeds = weights(parts[0].shape[2], stream)
        means = [np.einsum("rw,lws,rs->rl", drawn, part, seeds, optimize=True) for part in parts]
        found.append([energy_at(e, s, at) for e, s in zip(*means, strict=True)])
    saved = share_saved(*np.array(found))
    saved = saved[np.isfinite(saved)]
    if not len(saved):
        return Estimate(value)
    return Estimate(value, *bounds(saved))


def points(windows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per kind of controller and limit: means over windows and seeds."""
    rows = windows.groupby([*KINDS, "limit"], sort=False)
    table = rows.mean(numeric_only=True).drop(columns=["training_seed", "profile_id"])
    return table.assign(seeds=rows["training_seed"].nunique()).reset_index()
