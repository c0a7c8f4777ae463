"""Tables of energy, safety and learning in the ALCC study, with 95 % intervals."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lcc_rl.results.cells import heading
from lcc_rl.results.intervals import mean, share_saved
from lcc_rl.results.savings import (
    BASELINES,
    KINDS,
    NOTHING,
    UNTRAINED,
    paired,
    per_seed,
    per_window,
    savings,
    stratified,
    worse_off,
)

PARTS = ("total_steady_energy_kj", "total_acceleration_loss_kj")
COMPARED = (*BASELINES, "own_energy")
LONG, MOVING = "long_time_gap_pct", "long_time_gap_above_1_mps_pct"
SHARES = {
    "unsafe_ttc_pct": "share_ttc_unsafe",
    LONG: "share_time_gap_long",
    MOVING: "share_time_gap_long_moving",
}
LIMITS = {"unsafe_ttc_pct": 0.1, LONG: 1.0}  # share of time [%], for every seed


def energies(episodes: pd.DataFrame) -> pd.DataFrame:
    """Mean energies of every strategy.

    Args:
        episodes: rows of an evaluation: every strategy on the same profiles and drivers.

    Returns:
        One row per strategy: seeds, path energy of both vehicles and energy as drawn, the path's
        parts at constant speed and lost by accelerating, and what CAV and HDV draw [kJ].
        Intervals are over seeds only: they say how much trainings differ on these windows.
    """
    rows = []
    for strategy in dict.fromkeys(episodes["strategy"]):
        part = episodes[episodes["strategy"] == strategy]
        row: dict[str, object] = {"strategy": strategy, "seeds": _seeds(episodes, strategy)}
        for column in (f"total_{name}" for name in KINDS.values()):
            energy = part.groupby("training_seed", dropna=False)[column].mean()
            row |= mean(energy).columns(column)
        row |= part[list(PARTS)].mean().to_dict()
        row |= {f"{v}_energy_kj": part[f"{v}_energy_kj"].mean() for v in ("cav", "hdv")}
        rows.append(row)
    return pd.DataFrame(rows)


def headline(episodes: pd.DataFrame) -> pd.DataFrame:
    """Savings of the total energy: of its path, and as drawn.

    Args:
        episodes: rows of an evaluation: every strategy on the same profiles and drivers.

    Returns:
        One row per trained strategy and baseline: the share saved [%] with its interval over
        windows and seeds, that of the worst seed, and the (window, driver) pairs whose path takes
        more [%].
    """
    columns = [f"total_{column}" for column in KINDS.values()]
    windows, path = per_window(episodes, columns), paired(episodes, columns[0])
    found = per_seed(episodes, columns[0])
    learned = [name for name in found if name not in UNTRAINED]
    rows = []
    for strategy in learned:
        for baseline in (name for name in COMPARED if name in found and name != strategy):
            row: dict[str, object] = {"strategy": strategy, "against": baseline}
            row["seeds"] = _seeds(episodes, strategy)
            for kind, column in KINDS.items():
                share = savings(windows, f"total_{column}", strategy, baseline)
                row |= share.columns(f"{kind}saving_pct", 100.0)
                values = per_seed(windows, f"total_{column}")
                worst = share_saved(values[strategy].max(), values[baseline].mean())
                row[f"worst_seed_{kind}saving_pct"] = 100.0 * worst
            row["pairs_worse_off_pct"] = 100.0 * worse_off(path, strategy, baseline)["pairs"]
            rows.append(row)
    return pd.DataFrame(rows)


def strata(episodes: pd.DataFrame) -> pd.DataFrame:
    """Savings of path energy in the terciles of windows by what their leader does.

    Returns:
        The rows of :func:`lcc_rl.results.savings.stratified` for ``alcc``, or every trained
        strategy without it, against each baseline.
    """
    names = [name for name in per_seed(episodes, "total_path_energy_kj") if name not in UNTRAINED]
    kept = ["alcc"] if "alcc" in names else names
    parts = [
        stratified(episodes, "total_path_energy_kj", name, baseline).assign(
            strategy=name, against=baseline
        )
        for name in kept
        for baseline in COMPARED
        if baseline != name and (episodes["strategy"] == baseline).any()
    ]
    table = pd.concat(parts, ignore_index=True)
    table["by"] = table["by"].map(heading)
    return table[["strategy", "against", *table.columns.drop(["strategy", "against"])]]


def _seeds(episodes: pd.DataFrame, strategy: str) -> str:
    """Return the number of training seeds; a dash for a strategy without training."""
    count = episodes.loc[episodes["strategy"] == strategy, "training_seed"].nunique()
    return str(count) if count else "–"


def constraints(episodes: pd.DataFrame) -> pd.DataFrame:
    """Safety and efficiency of every strategy with a controlled car.

    Returns:
        One row per strategy: collisions in all episodes; shares of time with TTC < 4 s and time
        gap > 2.5 s [%] in the mean over seeds, of the worst seed and of the worst episode; the
        least TTC [s] and gap [m]; and whether every seed is within :data:`LIMITS`.
    """
    rows = []
    for strategy in per_seed(episodes, "total_energy_kj"):
        part = episodes[episodes["strategy"] == strategy]
        row: dict[str, object] = {
            "strategy": strategy,
            "seeds": _seeds(episodes, strategy),
            "episodes": len(part),
            "collisions": int(part["collided"].sum()),
        }
        for name, column in SHARES.items():
            values = 100.0 * part.groupby("training_seed", dropna=False)[column].mean()
            row[f"mean_{name}"], row[f"worst_seed_{name}"] = values.mean(), values.max()
            row[f"worst_episode_{name}"] = 100.0 * part[column].max()
        row["least_ttc_s"], row["least_gap_m"] = part["min_ttc_s"].min(), part["min_gap_m"].min()
        within = [float(str(row[f"worst_seed_{x}"])) <= limit for x, limit in LIMITS.items()]
        row["within_limits"] = row["collisions"] == 0 and all(within)
        rows.append(row)
    return pd.DataFrame(rows)


def constraints_by_seed(episodes: pd.DataFrame) -> pd.DataFrame:
    """The shares of :func:`constraints` for every trained seed, one row each."""
    learned = episodes[episodes["training_seed"].notna()]
    rows = []
    for (strategy, seed), part in learned.groupby(["strategy", "training_seed"], sort=True):
        rows.append(
            {
                "strategy": strategy,
                "seed": str(seed),
                "total_energy_kj": part["total_energy_kj"].mean(),
                "collisions": int(part["collided"].sum()),
                **{name: 100.0 * part[column].mean() for name, column in SHARES.items()},
                "least_ttc_s": part["min_ttc_s"].min(),
            }
        )
    return pd.DataFrame(rows)


def learning(training: pd.DataFrame) -> pd.DataFrame:
    """Statistics of the learning curves, one row per variant and seed.

    Returns:
        Mean reward per episode in the first, middle and last tenth of the training, its standard
        deviation over the batches of the last tenth, and ``drop``: the largest fall of the mean
        of a tenth below that of an earlier one.
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
    """Compare each change of the study with the baselines of its own scenario.

    Args:
        episodes: rows of the evaluations.
        by: the column that names the change.

    Returns:
        One row per change and trained strategy: path energy [kJ], its savings against each of
        :data:`COMPARED` [%] with intervals over windows and seeds, energy as drawn [kJ],
        collisions, shares of time [%], and RMS jerk [m/s³]; path energy and jerk also of the
        worst seed. Intervals of other than savings are over seeds only.
    """
    baselines = [name for name in COMPARED if (episodes["strategy"] == name).any()]
    path = "total_path_energy_kj"
    rows = []
    for change, part in episodes.groupby(by, sort=False):
        windows = per_window(part, [path, "total_energy_kj", *SHARES.values(), "rms_jerk_mps3"])
        for strategy, energy in per_seed(windows, path).items():
            if strategy in UNTRAINED:
                continue
            own = windows[windows["strategy"] == strategy]
            row: dict[str, object] = {by: change, "strategy": strategy}
            row["seeds"] = _seeds(part, strategy)
            row |= mean(energy).columns("path_energy_kj")
            row["worst_seed_path_energy_kj"] = energy.max()
            for baseline in baselines:
                known = baseline != strategy
                found = savings(windows, path, strategy, baseline) if known else NOTHING
                row |= found.columns(f"path_saving_against_{baseline}_pct", 100.0)
            row["total_energy_kj"] = own["total_energy_kj"].mean()
            row["collisions"] = int(part.loc[part["strategy"] == strategy, "collided"].sum())
            for name, column in SHARES.items():
                row |= mean(per_seed(own, column)[strategy]).columns(name, 100.0)
            jerk = per_seed(own, "rms_jerk_mps3")[strategy]
            row["rms_jerk_mps3"], row["worst_seed_rms_jerk_mps3"] = jerk.mean(), jerk.max()
            rows.append(row)
    return pd.DataFrame(rows)


def single_profile(episodes: pd.DataFrame) -> pd.DataFrame:
    """One profile for both training and evaluation, one row per profile.

    Args:
        episodes: rows of the evaluations, with the column ``study_profile``.

    Returns:
        Total energy as drawn [kJ], the paper's measure, of ``idm``, ``reference`` and ``alcc``
        with intervals over seeds, the saving of ``alcc`` against both, also of path energy [%],
        and how many seeds of either beat the human.
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
            for kind, column in KINDS.items():
                found = savings(part, f"total_{column}", "alcc", baseline)
                row |= found.columns(f"alcc_{kind}saving_against_{baseline}_pct", 100.0)
        row["collisions"] = int(part.loc[part["training_seed"].notna(), "collided"].sum())
        rows.append(row)
    return pd.DataFrame(rows)
