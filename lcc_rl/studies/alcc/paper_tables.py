"""Tables of the ALCC study with the paper's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.results.intervals import share_saved
from lcc_rl.results.windows import Means, by_driver, driver_savings, per_seed, savings
from lcc_rl.studies.alcc.tables import ENERGY_KINDS

PAIR = STRATEGY, BASELINE = "alcc", "reference"  # compared strategies
PAPER_ROW, STUDY_ROW = "paper", "this study"
ENERGY_WORDS = {"path_": "path energy", "": "as drawn"}  # by the keys of KINDS
# Wang et al., arXiv 2210.02147: Table IV, Fig. 9 and the generalization experiment.
# CAV, HDV and total energy [kJ].
PAPER_TABLE_IV = {
    ("mean", "reference"): (214.85, 193.89, 408.74),
    ("mean", "alcc"): (226.46, 164.38, 390.84),
    ("best", "reference"): (214.85, 201.91, 416.76),
    ("best", "alcc"): (221.03, 135.59, 356.62),
    ("worst", "reference"): (214.85, 202.52, 417.37),
    ("worst", "alcc"): (227.11, 210.81, 437.92),
}
PAPER_IMPROVEMENT = {"mean": 4.38, "best": 14.43, "worst": -4.92}
PAPER_WORSE = (138, 923)
PAPER_GENERALIZATION = (7.00, 8.04, 9.35, 4.62)
PAPER_HUMAN = {
    "scenario_A_kj": 165.38,
    "scenario_B_kj": 212.39,
    "saving_pct": 22.1,
    "least_driver_pct": 16.7,
    "most_driver_pct": 34.7,
}


def table_iv(drivers: pd.DataFrame) -> pd.DataFrame:
    """Return energies with the mean, best and worst driver (Table IV of the paper).

    The best driver has the largest saving of total energy over profiles and seeds.

    Args:
        drivers: see :class:`lcc_rl.results.windows.Means`.

    Returns:
        Rows for both controllers and each driver, of this study and of the paper: CAV, HDV and
        total energy [kJ], and the total saved [%], as path energy and as drawn. The paper's are
        as drawn.
    """
    columns = [
        f"{vehicle}_{x}" for vehicle in ("cav", "hdv", "total") for x in ENERGY_KINDS.values()
    ]
    energies = {column: by_driver(drivers, column) for column in columns}
    saved = driver_savings(drivers, "total_energy_kj", *PAIR)
    chosen: dict[str, Any] = {"mean": None, "best": saved.idxmax(), "worst": saved.idxmin()}
    rows = []
    for label, driver in chosen.items():
        of_driver = {x: t.mean() if driver is None else t.loc[driver] for x, t in energies.items()}
        for name in (BASELINE, STRATEGY):
            row: dict[str, object] = {"driver": label, "strategy": name, "from": STUDY_ROW}
            row |= {column: energy[name] for column, energy in of_driver.items()}
            for kind, column in ENERGY_KINDS.items():
                energy = of_driver[f"total_{column}"]
                share = 100.0 * share_saved(energy[STRATEGY], energy[BASELINE])
                row[f"{kind}saving_pct"] = share if name == STRATEGY else np.nan
            rows.append(row)
            if (label, name) in PAPER_TABLE_IV:
                row = {"driver": label, "strategy": name, "from": PAPER_ROW}
                keys = ("cav_energy_kj", "hdv_energy_kj", "total_energy_kj")
                row |= dict(zip(keys, PAPER_TABLE_IV[label, name], strict=True))
                row["saving_pct"] = PAPER_IMPROVEMENT[label] if name == STRATEGY else np.nan
                rows.append(row)
    return _with_its_decimals(rows)


def holistic(means: Means) -> pd.DataFrame:
    """Return savings of the total energy per driver, for study and paper (Fig. 10)."""
    rows = []
    for kind, column in ENERGY_KINDS.items():
        share = savings(means.windows, f"total_{column}", *PAIR)
        saved = 100.0 * driver_savings(means.drivers, f"total_{column}", *PAIR)
        row = {
            "from": f"{STUDY_ROW}, {ENERGY_WORDS[kind]}",
            **share.columns("mean_saving_pct", 100.0),
        }
        row |= {"best_driver_pct": saved.max(), "worst_driver_pct": saved.min()}
        row |= {"drivers_worse_off": f"{int((saved < 0).sum())} of {len(saved)}"}
        rows.append(row)
    columns = ("mean_saving_pct", "best_driver_pct", "worst_driver_pct")
    paper = dict(zip(columns, PAPER_IMPROVEMENT.values(), strict=True))
    rows.append({"from": PAPER_ROW, **paper, "drivers_worse_off": "{} of {}".format(*PAPER_WORSE)})
    return pd.DataFrame(rows)


def generalization(windows: pd.DataFrame) -> pd.DataFrame:
    """Return energies and savings on all held-out windows (Fig. 12).

    Returns:
        One row per profile: path energy of both vehicles with the baseline and the strategy
        [kJ], ``path_saving_pct`` and, as drawn, ``saving_pct`` of the strategy against the
        baseline, and ``path_saving_against_idm_pct``.
    """
    path = "total_path_energy_kj"
    rows = []
    for profile, part in windows.groupby("profile_id", sort=True):
        row: dict[str, object] = {"profile_id": profile, "profile": part["profile"].iloc[0]}
        energy = per_seed(part, path)
        row |= {f"{name}_path_energy_kj": energy[name].mean() for name in (BASELINE, STRATEGY)}
        for kind, column in ENERGY_KINDS.items():
            share = savings(part, f"total_{column}", *PAIR)
            row |= share.columns(f"{kind}saving_pct", 100.0)
        against = savings(part, path, STRATEGY, "idm")
        rows.append(row | against.columns("path_saving_against_idm_pct", 100.0))
    return pd.DataFrame(rows)


def generalization_row(windows: pd.DataFrame) -> pd.DataFrame:
    """Return the distribution of savings over held-out windows, and over the paper's profiles.

    Returns:
        Rows for this study's path energy, its energy as drawn and the paper:
        ``together_pct``, the saving over all profiles, and the least, median and largest saving
        of a profile.
    """
    table = generalization(windows)
    rows = []
    for kind, column in ENERGY_KINDS.items():
        together = savings(windows, f"total_{column}", *PAIR)
        row = {
            "from": f"{STUDY_ROW}, {ENERGY_WORDS[kind]}",
            **together.columns("together_pct", 100.0),
        }
        rows.append(row | _spread(table[f"{kind}saving_pct"]))
    return pd.DataFrame([*rows, {"from": PAPER_ROW, **_spread(pd.Series(PAPER_GENERALIZATION))}])


def _spread(values: pd.Series) -> dict[str, float]:
    ends = {"least_pct": values.min(), "median_pct": values.median(), "most_pct": values.max()}
    return {"profiles": len(values), **ends, "profiles_with_saving": int((values > 0).sum())}


def human_energy(means: Means) -> pd.DataFrame:
    """Return energies of human drivers behind a controlled car (A) and the leader (B; Fig. 9).

    Returns:
        One row per strategy and kind of energy: both means [kJ], the saving of A [%] with its
        interval over windows and seeds, and the least and largest saving of a driver.
    """
    rows: list[dict[str, object]] = []
    for strategy in per_seed(means.windows, "total_energy_kj"):
        for kind, column in ENERGY_KINDS.items():
            share = savings(means.windows, f"hdv_{column}", strategy, "direct")
            energy = by_driver(means.drivers, f"hdv_{column}")
            saved = 100.0 * share_saved(energy[strategy], energy["direct"])
            rows.append(
                {
                    "behind": strategy,
                    "energy": ENERGY_WORDS[kind],
                    "scenario_A_kj": energy[strategy].mean(),
                    "scenario_B_kj": energy["direct"].mean(),
                    **share.columns("saving_pct", 100.0),
                    "least_driver_pct": saved.min(),
                    "most_driver_pct": saved.max(),
                    "drivers_better_off": f"{int((saved > 0).sum())} of {len(saved)}",
                }
            )
    rows.append({"behind": f"alcc {PAPER_ROW}", "energy": ENERGY_WORDS[""], **PAPER_HUMAN})
    return _with_its_decimals(rows)


def _with_its_decimals(rows: Sequence[dict[str, object]]) -> pd.DataFrame:
    """Return a table with the number of decimals of the paper."""
    table = pd.DataFrame(rows)
    table.attrs["decimals"] = 2
    return table
