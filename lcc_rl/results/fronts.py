"""Comparison of controllers by fronts: energy at equal cost.

A controller with shorter gaps saves less energy, but violates the limit of the time gap less or
loses less flow. Two controllers are therefore compared as curves over several limits or time gaps,
at equal cost.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.arrays import Floats, per_distance
from lcc_rl.errors import ResultsError
from lcc_rl.results.intervals import NOTHING, Estimate, Side, equal_seeds, estimate, share_saved
from lcc_rl.results.measures import DISTANCE, FLOW, LONG_GAPS, PATH
from lcc_rl.results.windows import STRATEGY, TRAINED, drives_of, with_equal_seeds

FRONT_KINDS = ["variant", "policy"]
ENERGY, LONG_SHARE = PATH, LONG_GAPS
# Columns of a fleet.
NET = "total_net_energy_kj"
FLEET = NET, DISTANCE, FLOW
# Means of columns of one kind of controller, each ``[limits]``, or ``[groups, limits]``.
Curve = Mapping[str, Floats]
Statistic = Callable[[Curve, Curve], Any]


def front(windows: pd.DataFrame, kind: Sequence[str], columns: Sequence[str]) -> Side:
    """Return columns of one kind of controller by limit, window and seed.

    Args:
        windows: columns :data:`FRONT_KINDS`, ``limit`` (or another variable along a front),
            ``training_seed``, ``profile_id`` and ``columns``; a row per training and window.
        kind: variant and policy.
        columns: columns to return.

    Raises:
        ResultsError: if the kind is missing, or lacks a window or seed at one of its limits.
    """
    name = " ".join(kind)
    rows = windows[(windows[FRONT_KINDS] == list(kind)).all(axis=1)]
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
    return {column: rows[column].to_numpy(float).reshape(sizes) for column in columns}


def compare_fronts(
    windows: pd.DataFrame, *kinds: Sequence[str], columns: Sequence[str], measure: Statistic
) -> Estimate:
    """Return a measure of kinds of controllers with its interval.

    See :func:`lcc_rl.results.intervals.estimate`; equal seeds are left out in pairs.

    Args:
        windows, columns: see :func:`front`.
        kinds: variant and policy of each.
        measure: function of the means by limit of each.
    """
    fronts = [front(windows, kind, columns) for kind in kinds]
    seeds = windows.groupby(FRONT_KINDS)["training_seed"].unique()
    paired = equal_seeds(*(seeds[tuple(kind)] for kind in kinds))
    drives = drives_of(windows.drop_duplicates("profile_id").sort_values("profile_id"))

    def statistic(*sides: Curve) -> Any:
        return measure(*({name: x.T for name, x in side.items()} for side in sides))

    return estimate(statistic, *fronts, drives=drives, paired=paired)


def energy_at(energy: Floats, share: Floats, at: Any, most: float | None = np.nan) -> Floats:
    """Return the energy of a front, ``[..., limits]`` each, at the share ``at``.

    It is interpolated linearly between the limits. If all shares are larger, it is NaN; if all are
    smaller, ``most``; None: the energy of the nearest share. Several fronts are those without one
    group of windows or seeds after the other, which just miss a share that all reach: in place of
    NaN they are continued by the slope from end to end.
    """
    several = share.ndim > 1

    def read(at: float, share: Floats, energy: Floats) -> float:
        order = np.argsort(share)
        (least, x), (first, y) = (values[order[[0, -1]]] for values in (share, energy))
        found = float(np.interp(at, share[order], energy[order], left=np.nan, right=most))
        if not (several and np.isnan(found)):
            return found
        slope = (y - first) / (x - least) if x > least else 0.0
        return float(first + slope * (at - least) if at < least else y + slope * (at - x))

    return np.asarray(np.vectorize(read, signature="(),(n),(n)->()")(at, share, energy))


def energy_per_distance(curve: Curve) -> Floats:
    """Return the energy, the first column, per distance, ``[..., limits]``."""
    return per_distance(next(iter(curve.values())), curve[DISTANCE])


def fleet_saved(point: Curve, baseline: Curve) -> Any:
    """Return the share of a baseline's energy per distance that a fleet saves."""
    return share_saved(*(energy_per_distance(x)[..., 0] for x in (point, baseline)))


def flow_gained(point: Curve, baseline: Curve) -> Any:
    """Return the share of a baseline's flow that a fleet gains."""
    return point[FLOW][..., 0] / baseline[FLOW][..., 0] - 1.0


def saved_at_flow(
    own: Curve, other: Curve, reference: Curve | None = None, most: float | None = np.nan
) -> Any:
    """Return the share of energy per distance that one front saves against another at equal flow.

    A car, a platoon or a fleet is a front of one point. The flow is that of ``own``, or with a
    reference that of the reference, or the least one that both fronts have if that is more. The
    share is NaN if a front has less flow everywhere, but for ``most``: None compares with the point
    of ``other`` that has most flow.
    """
    flow = own[FLOW][..., 0]
    if reference is not None:
        flow = np.maximum(reference[FLOW][..., 0], own[FLOW].min(-1))
        flow = np.maximum(flow, other[FLOW].min(-1))
    mine = energy_at(energy_per_distance(own), own[FLOW], flow)
    return share_saved(mine, energy_at(energy_per_distance(other), other[FLOW], flow, most))


def at_equal_flow(
    windows: pd.DataFrame, own: Sequence[str], other: Sequence[str], energy: str, reference: str
) -> Estimate:
    """Return the share of energy per distance saved at the flow of a reference.

    If a front has more flow at all its points, the flow is the least one that both have; then the
    estimate has ``more_flow``, the share by which it exceeds the reference's. The reference itself
    as ``other`` counts with its own flow. Trainings are compared by equal seeds.

    Args:
        windows: result of :func:`lcc_rl.results.windows.windows_of`.
        own: strategies along the front of one kind, such as a network behind filters with several
            longest time gaps.
        other: likewise, of the kind with which it is compared.
        energy: column of the energy.
        reference: strategy with the flow.

    Returns:
        The share with its interval; NaN if a front has less flow everywhere, or one is missing.
    """
    columns = (energy, DISTANCE, FLOW)
    sides = {"own": own, "other": other, "reference": [reference]}
    complete = {*own, *other, reference} <= set(windows[STRATEGY]) and {*columns} <= set(windows)
    if not complete or not own or not other:
        return NOTHING
    rows = pd.concat(
        windows[windows[STRATEGY] == name].assign(strategy=side, variant=side, policy="", limit=x)
        for side, names in sides.items()
        for x, name in enumerate(names)
    )
    both = with_equal_seeds(rows, *list(sides)[:2])
    rows = pd.concat([both, rows[rows[STRATEGY] == "reference"]])
    rows[TRAINED] = rows[TRAINED].astype(object).fillna(-1)
    measure = partial(saved_at_flow, most=None if [*other] == [reference] else np.nan)
    kinds = ((side, "") for side in sides)
    found = compare_fronts(rows, *kinds, columns=columns, measure=measure)
    least = rows.groupby([STRATEGY, "limit"])[FLOW].mean().groupby(level=0).min()
    return replace(found, more_flow=float(least.max() / least["reference"] - 1.0))


def points(windows: pd.DataFrame) -> pd.DataFrame:
    """Return one row per kind of controller and limit: means over windows and seeds."""
    rows = windows.groupby([*FRONT_KINDS, "limit"], sort=False)
    table = rows.mean(numeric_only=True).drop(columns=["training_seed", "profile_id"])
    return table.assign(seeds=rows["training_seed"].nunique()).reset_index()
