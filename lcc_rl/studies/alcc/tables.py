"""Tables of energy, safety and learning in the ALCC study, with 95 % intervals.

Their arguments are windows of :class:`lcc_rl.results.windows.Means`; all strategies have the same
windows and drivers. Intervals of savings are over windows and seeds, all others over seeds only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd

from lcc_rl.results.intervals import NOTHING, mean, share_saved
from lcc_rl.results.measures import PATH, heading
from lcc_rl.results.render import DASH
from lcc_rl.results.report import UNTRAINED
from lcc_rl.results.windows import LEADER_COLUMNS, SOURCE, by_source, per_seed, savings

ENERGY_PARTS = ("total_steady_energy_kj", "total_acceleration_loss_kj")
COMPARED_WITH = ("idm", "human", "recorded", "idm_acc_filtered", "idm_acc", "rule", "reference")
COMPARED = (*COMPARED_WITH, "own_energy")
# Prefixes of savings and their energies: path energy, net of kinetic energy, which a lower final
# speed does not lower; and energy as drawn (A2).
ENERGY_KINDS = {"path_": "path_energy_kj", "": "energy_kj"}
TERCILES = ("lower", "middle", "upper")
LONG, MOVING = "long_time_gap_pct", "long_time_gap_above_1_mps_pct"
SHARES = {
    "unsafe_ttc_pct": "share_ttc_unsafe",
    LONG: "share_time_gap_long",
    MOVING: "share_time_gap_long_moving",
}
SHARE_LIMITS = {"unsafe_ttc_pct": 0.1, LONG: 1.0}  # largest share of time for every seed [%]


def energies(windows: pd.DataFrame) -> pd.DataFrame:
    """Return mean energies of all strategies [kJ].

    These are the path energy of both vehicles and the energy as drawn, the parts of the path energy
    at constant speed and lost by accelerating, and the energies of CAV and HDV.
    """
    rows = []
    for strategy, part in windows.groupby("strategy", sort=False):
        row: dict[str, object] = {"strategy": strategy, "seeds": _seeds(part)}
        for column in (f"total_{name}" for name in ENERGY_KINDS.values()):
            row |= mean(part.groupby("training_seed", dropna=False)[column].mean()).columns(column)
        for column in (*ENERGY_PARTS, "cav_energy_kj", "hdv_energy_kj"):
            row[column] = part[column].mean()
        rows.append(row)
    return pd.DataFrame(rows)


def headline_rows(windows: pd.DataFrame) -> pd.DataFrame:
    """Return savings of total path energy and energy as drawn by trained strategy and baseline.

    These are the share saved [%] and that of the worst seed.
    """
    columns = [f"total_{column}" for column in ENERGY_KINDS.values()]
    seeds = {column: per_seed(windows, column) for column in columns}
    rows = []
    for strategy in (name for name in seeds[columns[0]] if name not in UNTRAINED):
        for baseline in (x for x in COMPARED if x in seeds[columns[0]] and x != strategy):
            row: dict[str, object] = {"strategy": strategy, "against": baseline}
            row["seeds"] = _seeds(windows[windows["strategy"] == strategy])
            for kind, column in zip(ENERGY_KINDS, columns, strict=True):
                share = savings(windows, column, strategy, baseline)
                row |= share.columns(f"{kind}saving_pct", 100.0)
                worst = share_saved(seeds[column][strategy].max(), seeds[column][baseline].mean())
                row[f"worst_seed_{kind}saving_pct"] = 100.0 * worst
            rows.append(row)
    return pd.DataFrame(rows)


def strata(windows: pd.DataFrame) -> pd.DataFrame:
    """Return savings of path energy in thirds of the windows by properties of their leader.

    Returns:
        For ``alcc``, or without it all trained strategies, against each baseline: a row per
        property of the leader and third, lowest first, with the number of windows, the range of
        the property and the share saved [%]; and, if there are several sources of leaders, a row
        per source with its name in the column ``tercile`` and no range.
    """
    names = [name for name in per_seed(windows, PATH) if name not in UNTRAINED]
    thirds = list(_thirds(windows))
    rows = [
        {
            "strategy": name,
            "against": baseline,
            "by": heading(by),
            "tercile": third,
            "windows": inside["profile_id"].nunique(),
            "least": least,
            "most": most,
            **savings(inside, PATH, name, baseline).columns("saving_pct", 100.0),
        }
        for name in (["alcc"] if "alcc" in names else names)
        for baseline in COMPARED
        if baseline != name and (windows["strategy"] == baseline).any()
        for by, third, least, most, inside in thirds
    ]
    return pd.DataFrame(rows)


def _thirds(windows: pd.DataFrame) -> Iterator[tuple[str, str, float, float, pd.DataFrame]]:
    """Yield property, name, range and rows of each source and third of the windows."""
    if SOURCE in windows:
        for source, rows in by_source(windows):
            yield SOURCE, source, np.nan, np.nan, rows
    for column in LEADER_COLUMNS:
        values = windows.groupby("profile_id")[column].first().sort_values()
        thirds = np.array_split(np.arange(len(values)), len(TERCILES))
        for name, third in zip(TERCILES, (values.iloc[chosen] for chosen in thirds), strict=True):
            if len(third):
                inside = windows[windows["profile_id"].isin(third.index)]
                yield column, name, third.iloc[0], third.iloc[-1], inside


def _seeds(rows: pd.DataFrame) -> str:
    """Return the number of training seeds; a dash for a strategy without training."""
    return str(rows["training_seed"].nunique() or DASH)


def constraints(windows: pd.DataFrame) -> pd.DataFrame:
    """Return safety and efficiency of all strategies with a controlled car.

    These are collisions in all episodes; shares of time with TTC < 4 s and time gap > 2.5 s [%],
    means over seeds, of the worst seed and of the worst episode; the least TTC [s] and gap [m]; and
    whether every seed is within :data:`SHARE_LIMITS`.
    """
    rows = []
    for strategy in per_seed(windows, "total_energy_kj"):
        part = windows[windows["strategy"] == strategy]
        row: dict[str, object] = {"strategy": strategy, "seeds": _seeds(part)}
        row |= {name: int(part[name].sum()) for name in ("episodes", "collisions")}
        within = not row["collisions"]
        for name, column in SHARES.items():
            values = 100.0 * part.groupby("training_seed", dropna=False)[column].mean()
            row[f"mean_{name}"], row[f"worst_seed_{name}"] = values.mean(), values.max()
            row[f"worst_episode_{name}"] = 100.0 * part[f"worst_{column}"].max()
            within = within and values.max() <= SHARE_LIMITS.get(name, np.inf)
        row["least_ttc_s"], row["least_gap_m"] = part["min_ttc_s"].min(), part["min_gap_m"].min()
        rows.append(row | {"within_limits": bool(within)})
    return pd.DataFrame(rows)


def constraints_by_seed(windows: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of :func:`constraints` for each trained seed."""
    groups = windows.groupby(["strategy", "training_seed"], sort=True)
    table = groups[["total_energy_kj"]].mean().assign(collisions=groups["collisions"].sum())
    for name, column in SHARES.items():
        table[name] = 100.0 * groups[column].mean()
    table["least_ttc_s"] = groups["min_ttc_s"].min()
    table = table.reset_index().rename(columns={"training_seed": "seed"})
    return table.astype({"seed": str})


def learning(training: pd.DataFrame) -> pd.DataFrame:
    """Return statistics of the learning curves, one row per variant and seed.

    These are the mean reward per episode in the first, middle and last tenth of the training, its
    standard deviation over the batches of the last tenth, and ``drop``: the largest fall of the
    mean of a tenth below that of an earlier one.
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


def comparison(windows: pd.DataFrame) -> pd.DataFrame:
    """Compare each change of the study with the baselines of its own scenario.

    Args:
        windows: windows of the evaluations, with the column ``ablation``, which names the change.

    Returns:
        One row per change and trained strategy: path energy [kJ], its savings against each of
        :data:`COMPARED` [%], energy as drawn [kJ], collisions, shares of time [%], and RMS jerk
        [m/s³]; path energy and jerk also of the worst seed.
    """
    baselines = [name for name in COMPARED if (windows["strategy"] == name).any()]
    rows = []
    for change, part in windows.groupby("ablation", sort=False):
        learned = {x: y for x, y in per_seed(part, PATH).items() if x not in UNTRAINED}
        for strategy, energy in learned.items():
            own = part[part["strategy"] == strategy]
            row: dict[str, object] = {
                "ablation": change,
                "strategy": strategy,
                "seeds": _seeds(own),
            }
            row |= mean(energy).columns("path_energy_kj")
            row["worst_seed_path_energy_kj"] = energy.max()
            for baseline in baselines:
                known = baseline != strategy
                found = savings(part, PATH, strategy, baseline) if known else NOTHING
                row |= found.columns(f"path_saving_against_{baseline}_pct", 100.0)
            row["total_energy_kj"] = own["total_energy_kj"].mean()
            row["collisions"] = int(own["collisions"].sum())
            for name, column in SHARES.items():
                row |= mean(per_seed(own, column)[strategy]).columns(name, 100.0)
            jerk = per_seed(own, "rms_jerk_mps3")[strategy]
            row["rms_jerk_mps3"], row["worst_seed_rms_jerk_mps3"] = jerk.mean(), jerk.max()
            rows.append(row)
    return pd.DataFrame(rows)


def series(windows: pd.DataFrame) -> pd.DataFrame:
    """Return savings of the total energy as drawn, the paper's measure, by series of trainings.

    Args:
        windows: windows of the evaluations, with the column ``ablation``, the series' name.

    Returns:
        One row per series: the number of trainings of ``alcc``, their saving against the
        reference and against ``idm``, and that of the control ``own_energy`` against the
        reference [%].
    """
    rows = []
    for name, part in windows.groupby("ablation", sort=False):
        seeds = _seeds(part[part["strategy"] == "alcc"])
        row: dict[str, object] = {"training": name, "seeds": seeds}
        compared = (("alcc", "reference"), ("alcc", "idm"), ("own_energy", "reference"))
        for strategy, baseline in compared:
            share = savings(part, "total_energy_kj", strategy, baseline)
            row |= share.columns(f"{strategy}_against_{baseline}_pct", 100.0)
        rows.append(row)
    return pd.DataFrame(rows)
