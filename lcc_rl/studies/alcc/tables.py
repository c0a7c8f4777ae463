"""Tables of the ALCC study: this study's numbers beside the paper's, with intervals over seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.results.intervals import Estimate, mean, share_saved
from lcc_rl.results.tables import BASELINES, HUMANS, paired, per_seed, savings

KINDS = {"": "energy_kj", "net_": "net_energy_kj"}  # raw; net of the change in kinetic energy
PARTS = ("steady_energy_kj", "acceleration_loss_kj")  # studies of earlier releases lack them
PAPER, OURS = "paper", "this study"
COMPARED = (*BASELINES, "own_energy")
# Wang et al., arXiv 2210.02147: Table IV, Fig. 9 and the generalization experiment.
PAPER_TABLE_IV = {"reference": (214.85, 193.89, 408.74), "alcc": (226.46, 164.38, 390.84)}
PAPER_IMPROVEMENT = {"mean": 4.38, "best": 14.43, "worst": -4.92}
PAPER_WORSE = (138, 923)
PAPER_GENERALIZATION = (7.00, 8.04, 9.35, 4.62)
PAPER_HUMAN = {"A": 165.38, "B": 212.39}
PAPER_HUMAN_SAVING = {"mean": 22.1, "least": 16.7, "most": 34.7}
# What the study demands: no collision, shares of time [%].
LIMITS = {"unsafe_ttc_pct": 0.1, "long_time_gap_pct": 1.0}


def energies(episodes: pd.DataFrame) -> pd.DataFrame:
    """Mean energies of every strategy.

    Args:
        episodes: rows of an evaluation: every strategy on the same profiles and drivers.

    Returns:
        One row per strategy: seeds, energy of the CAV, the HDV and both [kJ], the latter also net
        of the change in kinetic energy, with 95 % bootstrap intervals over seeds; what the speeds
        driven take without accelerating, and what accelerating loses.
    """
    rows = []
    for strategy in dict.fromkeys(episodes["strategy"]):
        part = episodes[episodes["strategy"] == strategy]
        row: dict[str, object] = {"strategy": strategy, "seeds": _seeds(episodes, strategy)}
        row |= {f"{v}_energy_kj": part[f"{v}_energy_kj"].mean() for v in ("cav", "hdv")}
        for kind, column in KINDS.items():
            energy = part.groupby("training_seed", dropna=False)[f"total_{column}"].mean()
            row |= mean(energy).columns(f"total_{kind}energy_kj")
        parts = [f"total_{name}" for name in PARTS if f"total_{name}" in part]
        rows.append(row | part[parts].mean().to_dict())
    return pd.DataFrame(rows)


def headline(episodes: pd.DataFrame) -> pd.DataFrame:
    """Savings of the total energy, raw and net of the change in kinetic energy.

    Args:
        episodes: rows of an evaluation: every strategy on the same profiles and drivers.

    Returns:
        One row per trained strategy and baseline: the share saved [%], positive where energy is
        saved, with its 95 % bootstrap interval over seeds, and the least of any seed.
    """
    found = per_seed(episodes, "total_energy_kj")
    rows = []
    for strategy in (name for name in found if name not in HUMANS):
        for baseline in (name for name in COMPARED if name in found):
            if baseline == strategy:
                continue
            row: dict[str, object] = {"strategy": strategy, "against": baseline}
            row["seeds"] = _seeds(episodes, strategy)
            for kind, column in KINDS.items():
                share = savings(episodes, f"total_{column}", strategy, baseline)
                row |= share.columns(f"{kind}saving_pct", 100.0)
                values = per_seed(episodes, f"total_{column}")
                worst = share_saved(values[strategy].max(), values[baseline].mean())
                row[f"worst_seed_{kind}saving_pct"] = 100.0 * worst
            rows.append(row)
    return pd.DataFrame(rows)


def _seeds(episodes: pd.DataFrame, strategy: str) -> str:
    """Number of training seeds as text; a dash where nothing was trained."""
    count = episodes.loc[episodes["strategy"] == strategy, "training_seed"].nunique()
    return str(count) if count else "–"


def constraints(episodes: pd.DataFrame) -> pd.DataFrame:
    """Safety and efficiency of every strategy with a car: over all seeds, and the worst of them.

    Returns:
        One row per strategy: collisions in all episodes, shares of time with TTC < 4 s and time
        gap > 2.5 s [%] in the mean over seeds, for the worst seed and the worst episode, the
        least TTC and gap met, and whether the study's limits hold for every seed.
    """
    shares = {
        "unsafe_ttc_pct": "share_ttc_unsafe",
        "long_time_gap_pct": "share_time_gap_long",
    }
    rows = []
    for strategy in per_seed(episodes, "total_energy_kj"):
        part = episodes[episodes["strategy"] == strategy]
        row: dict[str, object] = {
            "strategy": strategy,
            "seeds": _seeds(episodes, strategy),
            "episodes": len(part),
            "collisions": int(part["collided"].sum()),
        }
        for name, column in shares.items():
            values = 100.0 * part.groupby("training_seed", dropna=False)[column].mean()
            row[f"mean_{name}"], row[f"worst_seed_{name}"] = values.mean(), values.max()
            row[f"worst_episode_{name}"] = 100.0 * part[column].max()
        row["least_ttc_s"], row["least_gap_m"] = part["min_ttc_s"].min(), part["min_gap_m"].min()
        row["within_limits"] = row["collisions"] == 0 and all(
            float(str(row[f"worst_seed_{name}"])) <= limit for name, limit in LIMITS.items()
        )
        rows.append(row)
    return pd.DataFrame(rows)


def constraints_by_seed(episodes: pd.DataFrame) -> pd.DataFrame:
    """The same shares for every trained seed, one row each."""
    learned = episodes[episodes["training_seed"].notna()]
    rows = []
    for (strategy, seed), part in learned.groupby(["strategy", "training_seed"], sort=True):
        rows.append(
            {
                "strategy": strategy,
                "seed": str(seed),
                "total_energy_kj": part["total_energy_kj"].mean(),
                "collisions": int(part["collided"].sum()),
                "unsafe_ttc_pct": 100.0 * part["share_ttc_unsafe"].mean(),
                "long_time_gap_pct": 100.0 * part["share_time_gap_long"].mean(),
                "least_ttc_s": part["min_ttc_s"].min(),
            }
        )
    return pd.DataFrame(rows)


def table_iv(
    episodes: pd.DataFrame, strategy: str = "alcc", baseline: str = "reference"
) -> pd.DataFrame:
    """Energies behind the mean, best and worst driver (Table IV of the paper).

    The best driver is the one behind whom the strategy saves most against the baseline, in total
    energy over all profiles and seeds.

    Returns:
        Rows for both controllers and each driver, this study's and the paper's: CAV, HDV and
        total energy [kJ], and the total saved [%], raw and net of kinetic energy.
    """
    by_driver = {
        f"{vehicle}_{column}": paired(episodes, f"{vehicle}_{column}").groupby("driver_id").mean()
        for vehicle in ("cav", "hdv", "total")
        for column in KINDS.values()
    }
    total = by_driver["total_energy_kj"]
    saved = share_saved(total[strategy], total[baseline])
    drivers = {"mean": None, "best": saved.idxmax(), "worst": saved.idxmin()}
    rows = []
    for label, driver in drivers.items():
        for name in (baseline, strategy):
            row: dict[str, object] = {"driver": label, "strategy": name, "from": OURS}
            for column, table in by_driver.items():
                row[column] = _of(table, driver)[name]
            for kind, column in KINDS.items():
                of = _of(by_driver[f"total_{column}"], driver)
                share = 100.0 * share_saved(of[strategy], of[baseline])
                row[f"{kind}saving_pct"] = share if name == strategy else np.nan
            rows += [row, *_paper_row(label, name, strategy)]
    return pd.DataFrame(rows)


def _of(by_driver: pd.DataFrame, driver: Any) -> pd.Series:
    """Return every strategy's energy behind one driver; None is the mean over drivers."""
    return by_driver.mean() if driver is None else by_driver.loc[driver]


def _paper_row(driver: str, name: str, strategy: str) -> list[dict[str, object]]:
    """Return what the paper gives: energies for the mean, savings only for the others."""
    row: dict[str, object] = {"driver": driver, "strategy": name, "from": PAPER}
    if driver == "mean" and name in PAPER_TABLE_IV:
        keys = ("cav_energy_kj", "hdv_energy_kj", "total_energy_kj")
        row |= dict(zip(keys, PAPER_TABLE_IV[name], strict=True))
    if name == strategy == "alcc":
        row["saving_pct"] = PAPER_IMPROVEMENT[driver]
    return [row] if len(row) > 3 else []


def holistic(
    episodes: pd.DataFrame, strategy: str = "alcc", baseline: str = "reference"
) -> pd.DataFrame:
    """Saving of the total energy per driver beside the paper's (Fig. 10): one row each."""
    rows = []
    for kind, column in KINDS.items():
        found = savings(episodes, f"total_{column}", strategy, baseline)
        by_driver = paired(episodes, f"total_{column}").groupby("driver_id").mean()
        saved = 100.0 * share_saved(by_driver[strategy], by_driver[baseline])
        rows.append(
            {
                "from": f"{OURS}, {'net of kinetic energy' if kind else 'raw'}",
                **found.columns("mean_saving_pct", 100.0),
                "best_driver_pct": saved.max(),
                "worst_driver_pct": saved.min(),
                "drivers_worse_off": f"{int((saved < 0).sum())} of {len(saved)}",
            }
        )
    paper = {
        "from": PAPER,
        "mean_saving_pct": PAPER_IMPROVEMENT["mean"],
        "best_driver_pct": PAPER_IMPROVEMENT["best"],
        "worst_driver_pct": PAPER_IMPROVEMENT["worst"],
        "drivers_worse_off": "{} of {}".format(*PAPER_WORSE),
    }
    return pd.DataFrame([*rows, paper])


def generalization(
    episodes: pd.DataFrame, strategy: str = "alcc", baseline: str = "reference"
) -> pd.DataFrame:
    """Saving of the total energy on every held-out profile, with its interval over seeds.

    Returns:
        One row per profile: the baseline's mean energy [kJ], without which a percentage says
        little (in a jam it nears zero), ``saving_pct`` and ``net_saving_pct`` of the strategy
        against the baseline, and ``saving_against_idm_pct``.
    """
    rows = []
    for profile, part in episodes.groupby("profile_id", sort=True):
        row: dict[str, object] = {"profile_id": profile, "profile": part["profile"].iloc[0]}
        row[f"{baseline}_energy_kj"] = per_seed(part, "total_energy_kj")[baseline].mean()
        for kind, column in KINDS.items():
            found = savings(part, f"total_{column}", strategy, baseline)
            row |= found.columns(f"{kind}saving_pct", 100.0)
        against = savings(part, "total_energy_kj", strategy, "idm")
        rows.append(row | against.columns("saving_against_idm_pct", 100.0))
    return pd.DataFrame(rows)


def generalization_row(
    episodes: pd.DataFrame, strategy: str = "alcc", baseline: str = "reference"
) -> pd.DataFrame:
    """Put the distribution over held-out profiles beside the paper's four (its last table).

    Returns:
        One row for this study's raw and net energy, and one for the paper: ``together_pct``, the
        saving of the energy of all profiles, and least, median and most over the profiles.
    """
    table = generalization(episodes, strategy, baseline)
    rows = []
    for kind, column in KINDS.items():
        together = savings(episodes, f"total_{column}", strategy, baseline)
        name = f"{OURS}, {'net of kinetic energy' if kind else 'raw'}"
        spread = _spread(table[f"{kind}saving_pct"].tolist())
        rows.append({"from": name, **together.columns("together_pct", 100.0), **spread})
    return pd.DataFrame([*rows, {"from": PAPER, **_spread(PAPER_GENERALIZATION)}])


def _spread(values: Sequence[float]) -> dict[str, float | int]:
    numbers = np.asarray(values, float)
    return {
        "profiles": len(numbers),
        "least_pct": float(numbers.min()),
        "median_pct": float(np.median(numbers)),
        "most_pct": float(numbers.max()),
        "profiles_with_saving": int((numbers > 0).sum()),
    }


def human_energy(episodes: pd.DataFrame) -> pd.DataFrame:
    """Human driver's energy behind a controlled car (A) and directly behind the leader (B; Fig. 9).

    Returns:
        One row per strategy and kind of energy: both means [kJ], the saving of A [%] with its
        interval over seeds, and its least and most over drivers.
    """
    rows: list[dict[str, object]] = []
    for strategy in per_seed(episodes, "total_energy_kj"):
        for kind, column in KINDS.items():
            found = savings(episodes, f"hdv_{column}", strategy, "direct")
            by_driver = paired(episodes, f"hdv_{column}").groupby("driver_id").mean()
            saved = 100.0 * share_saved(by_driver[strategy], by_driver["direct"])
            rows.append(
                {
                    "behind": strategy,
                    "energy": "net of kinetic energy" if kind else "raw",
                    "scenario_A_kj": by_driver[strategy].mean(),
                    "scenario_B_kj": by_driver["direct"].mean(),
                    **found.columns("saving_pct", 100.0),
                    "least_driver_pct": saved.min(),
                    "most_driver_pct": saved.max(),
                    "drivers_better_off": f"{int((saved > 0).sum())} of {len(saved)}",
                }
            )
    rows.append(
        {
            "behind": f"alcc ({PAPER})",
            "energy": "raw",
            "scenario_A_kj": PAPER_HUMAN["A"],
            "scenario_B_kj": PAPER_HUMAN["B"],
            "saving_pct": PAPER_HUMAN_SAVING["mean"],
            "least_driver_pct": PAPER_HUMAN_SAVING["least"],
            "most_driver_pct": PAPER_HUMAN_SAVING["most"],
        }
    )
    return pd.DataFrame(rows)


def learning(training: pd.DataFrame) -> pd.DataFrame:
    """Statistics of the learning curves, one row per variant and seed.

    Returns:
        Mean reward per episode in the first, middle and last tenth of the training, its standard
        deviation over the batches of the last tenth, and ``drop``: how far the mean of a tenth
        ever falls below the best tenth before it, zero for a curve that only rises.
    """
    rows = []
    for (variant, seed), part in training.groupby(["variant", "seed"], sort=True):
        curve = part.sort_values("iteration")["episode_reward"].to_numpy(float)
        tenths = [chunk for chunk in np.array_split(curve, 10) if len(chunk)]
        means = np.array([chunk.mean() for chunk in tenths])
        rows.append(
            {
                "variant": variant,
                "seed": str(seed),
                "episodes": int(part["episodes"].max()),
                "updates": int(part["updates"].max()),
                "first_tenth": means[0],
                "middle_tenth": means[len(means) // 2],
                "last_tenth": means[-1],
                "sd_in_last_tenth": tenths[-1].std(),
                "drop": float((np.maximum.accumulate(means) - means).max()),
                "collisions_in_training": int(part["collisions"].sum()),
            }
        )
    return pd.DataFrame(rows)


def comparison(episodes: pd.DataFrame, by: str = "ablation") -> pd.DataFrame:
    """What each change of the study does, every one against the humans of its own scenario.

    Args:
        episodes: rows of the evaluations.
        by: the column that names the change.

    Returns:
        One row per change and trained strategy: total energy [kJ], savings against each of
        :data:`COMPARED` [%] with intervals over seeds, collisions, shares of time [%], and RMS
        jerk [m/s³]; energy and jerk also of the worst seed.
    """
    baselines = [name for name in COMPARED if (episodes["strategy"] == name).any()]
    rows = []
    for change, part in episodes.groupby(by, sort=False):
        for strategy, energy in per_seed(part, "total_energy_kj").items():
            if strategy in HUMANS:
                continue
            own = part[part["strategy"] == strategy]
            row: dict[str, object] = {by: change, "strategy": strategy}
            row["seeds"] = _seeds(part, strategy)
            row |= mean(energy).columns("total_energy_kj")
            row["worst_seed_energy_kj"] = energy.max()
            for baseline in baselines:
                found = savings(part, "total_energy_kj", strategy, baseline)
                if baseline == strategy:
                    found = Estimate(np.nan, np.nan, np.nan)
                row |= found.columns(f"saving_against_{baseline}_pct", 100.0)
            row["collisions"] = int(own["collided"].sum())
            for name, column in (
                ("unsafe_ttc_pct", "share_ttc_unsafe"),
                ("long_time_gap_pct", "share_time_gap_long"),
            ):
                row |= mean(per_seed(part, column)[strategy]).columns(name, 100.0)
            jerk = per_seed(part, "rms_jerk_mps3")[strategy]
            row["rms_jerk_mps3"], row["worst_seed_rms_jerk_mps3"] = jerk.mean(), jerk.max()
            rows.append(row)
    return pd.DataFrame(rows)


def single_profile(episodes: pd.DataFrame) -> pd.DataFrame:
    """One profile for training and evaluation, as the paper probably did: one row per profile.

    Args:
        episodes: rows of the evaluations, with the column ``study_profile``.

    Returns:
        Total energy [kJ] of ``idm``, ``reference`` and ``alcc`` with intervals over seeds, the
        saving of ``alcc`` against both [%], and how many seeds of either beat the human.
    """
    rows = []
    for profile, part in episodes.groupby("study_profile", sort=True):
        energy = per_seed(part, "total_energy_kj")
        row: dict[str, object] = {"profile": str(profile), "seeds": _seeds(part, "alcc")}
        row["idm_energy_kj"] = energy["idm"].mean()
        for strategy in ("reference", "alcc"):
            if strategy not in energy:
                continue
            row |= mean(energy[strategy]).columns(f"{strategy}_energy_kj")
            better = int((energy[strategy] < energy["idm"].mean()).sum())
            row[f"{strategy}_seeds_below_idm"] = f"{better} of {len(energy[strategy])}"
        for baseline in ("reference", "idm"):
            found = savings(part, "total_energy_kj", "alcc", baseline)
            row |= found.columns(f"alcc_saving_against_{baseline}_pct", 100.0)
        row["collisions"] = int(part.loc[part["training_seed"].notna(), "collided"].sum())
        rows.append(row)
    return pd.DataFrame(rows)
