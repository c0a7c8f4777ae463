"""Savings of a strategy against a baseline, from the rows of episodes.parquet."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd

from lcc_rl.results.bootstrap import NOTHING, Estimate, saving, share_saved

KEYS = ["profile_id", "driver_id"]
REPEAT = "repeat"  # which draw of the noise of its profile and driver a row is of, if several
BASELINES = ("idm", "human", "recorded", "idm_acc_filtered", "idm_acc", "rule", "reference")
RULE = "rule"  # the IDM tuned on the same data, by the gradient
# Whom networks are compared with. All but the rule learn nothing.
UNTRAINED = (
    *("direct", "idm", "human", "recorded", "constant_filtered", RULE),
    *("idm_acc_filtered", "acc_filtered", "idm_acc", "acc"),
)
WAYS = ("cav_distance_m", "hdv_distance_m")  # of all vehicles
# Prefix of a saving, and of which energy: the path's, which leaves out what the motion stores
# and with it what ending slower saves; and as drawn (A2).
KINDS = {"path_": "path_energy_kj", "": "energy_kj"}
LEADER = ("leader_path_energy_kj", "leader_speed_mps")
DRIVE = "drive"  # what a row's window is cut from; windows of one are alike
SOURCE = "source"  # of a row's leader, if a mixture has several
TERCILES = ("lower", "middle", "upper")


def paired(episodes: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column per strategy and a row per pair, the mean over seeds.

    A pair is a profile and a driver and, if there are several draws of its noise, the draw.
    """
    keys = [*KEYS, REPEAT] if REPEAT in episodes else KEYS
    return episodes.pivot_table(index=keys, columns="strategy", values=column, aggfunc="mean")


def by_driver(episodes: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column per strategy and a row per driver, the mean over profiles and seeds."""
    return episodes.pivot_table(
        index="driver_id", columns="strategy", values=column, aggfunc="mean"
    )


def driver_savings(drivers: pd.DataFrame, column: str, strategy: str, baseline: str) -> pd.Series:
    """Return the share of a baseline's mean energy that a strategy saves, by driver."""
    energy = by_driver(drivers, column)
    return share_saved(energy[strategy], energy[baseline])


def per_seed(episodes: pd.DataFrame, column: str) -> dict[str, pd.Series]:
    """Return, for each strategy, the mean of a column over the episodes of each training seed."""
    found = {
        str(strategy): rows.groupby("training_seed", dropna=False)[column].mean()
        for strategy, rows in episodes.groupby("strategy", sort=False)
    }
    return {strategy: values for strategy, values in found.items() if values.notna().any()}


def per_window(episodes: pd.DataFrame, columns: str | Sequence[str]) -> pd.DataFrame:
    """Return the means over drivers: a row per strategy, training seed and window.

    If every window has the same drivers, these rows give the same :func:`savings`, faster.
    """
    keys = ["strategy", "training_seed", "profile_id", *([DRIVE] if DRIVE in episodes else [])]
    names = [columns] if isinstance(columns, str) else list(columns)
    if "training_seed" not in episodes:
        episodes = episodes.assign(training_seed=np.nan)
    return episodes.groupby(keys, dropna=False, sort=False)[names].mean().reset_index()


def savings(
    episodes: pd.DataFrame, column: str, strategy: str, baseline: str, per: Sequence[str] = ()
) -> Estimate:
    """Return the share of the baseline's mean energy that a strategy saves.

    ``savings(rows, "total_path_energy_kj", "alcc", "human", per=WAYS)`` is what tables show.

    Args:
        episodes: rows of an evaluation, or of :func:`per_window`.
        column: the energy.
        strategy: the strategy that saves.
        baseline: the strategy that it is compared with.
        per: columns of distances, by whose sum the energy is divided, total by total; by none,
            what an episode takes is compared, and who falls back saves by it.

    Returns:
        The share with its interval over windows or drives, and seeds
        (:func:`lcc_rl.results.bootstrap.estimate`), on the windows that both were evaluated on; NaN
        if one of them is missing.
    """
    chosen = episodes[episodes["strategy"].isin([strategy, baseline])]
    return Windows.of(chosen, column, per).saving(strategy, baseline)


class Windows(NamedTuple):
    """Means over drivers: a row per window, a column per strategy and training seed."""

    energy: pd.DataFrame
    way: pd.DataFrame  # what the energy is divided by
    drives: pd.Series | None  # the recorded drive of each window

    @classmethod
    def of(cls, episodes: pd.DataFrame, column: str, per: Sequence[str] = ()) -> Windows:
        """Return those of the rows of an evaluation, or of :func:`per_window`."""
        ways = [name for name in per if name in episodes]
        rows = per_window(episodes, [column, *ways])
        rows["training_seed"] = rows["training_seed"].astype(object).fillna(-1)
        rows["way"] = rows[ways].sum(axis=1) if ways else 1.0
        energy, way = (
            rows.pivot(index="profile_id", columns=["strategy", "training_seed"], values=name)
            for name in (column, "way")
        )
        drives = rows.groupby("profile_id")[DRIVE].first() if DRIVE in rows else None
        return cls(energy, way, drives)

    def saving(self, strategy: str, baseline: str) -> Estimate:
        """Return the share that a strategy saves, see :func:`savings`."""
        both = self.energy.columns.get_level_values(0).isin([strategy, baseline])
        table = self.energy.loc[:, both].dropna(axis=1, how="all").dropna()
        if table.empty or not {strategy, baseline} <= set(table.columns.get_level_values(0)):
            return NOTHING
        drives = None if self.drives is None else self.drives.reindex(table.index).tolist()
        way = self.way.loc[table.index, table.columns]
        energies, ways = ((x[strategy].to_numpy(), x[baseline].to_numpy()) for x in (table, way))
        return saving(energies[0], energies[1], drives=drives, ways=ways)


def worse_off(energy: pd.DataFrame, strategy: str, baseline: str) -> dict[str, float]:
    """Return the shares of (window, driver) pairs and of drivers who draw more with a strategy.

    Args:
        energy: a table of :func:`paired`; the mean over seeds counts.
        strategy: the strategy that may draw more.
        baseline: the strategy that it is compared with.

    Returns:
        ``pairs`` and ``drivers``, the latter by their mean over windows.
    """
    pairs = energy[[strategy, baseline]].dropna()
    levels = {"pairs": pairs, "drivers": pairs.groupby("driver_id").mean()}
    return {name: float((x[strategy] > x[baseline]).mean()) for name, x in levels.items()}


def by_source(episodes: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the rows of each source of leaders with its name; without one, all rows and ""."""
    if SOURCE not in episodes:
        yield "", episodes
        return
    for source, rows in episodes.groupby(SOURCE, sort=False):
        yield str(source), rows


def stratified(
    episodes: pd.DataFrame, column: str, strategy: str, baseline: str, by: Sequence[str] = LEADER
) -> pd.DataFrame:
    """Return savings in the terciles of windows by their leader, and in each source of leaders.

    Args:
        episodes: rows of an evaluation.
        column: the energy.
        strategy: the strategy that saves.
        baseline: the strategy that it is compared with.
        by: columns that are the same in every row of a window.

    Returns:
        One row per measure and tercile, the lowest first: its windows, the range of the measure
        and the share saved [%] with its interval; and one per source, if there are several, by
        its name in the column ``tercile``, without a range.
    """
    strata: list[tuple[str, str, object, object, pd.DataFrame]] = []
    if SOURCE in episodes:
        strata += [(SOURCE, name, np.nan, np.nan, rows) for name, rows in by_source(episodes)]
    for measure in by:
        windows = episodes.groupby("profile_id")[measure].first().sort_values()
        parts = np.array_split(np.arange(len(windows)), len(TERCILES))
        for name, part in zip(TERCILES, (windows.iloc[chosen] for chosen in parts), strict=True):
            if len(part):
                inside = episodes[episodes["profile_id"].isin(part.index)]
                strata.append((measure, name, part.iloc[0], part.iloc[-1], inside))
    return pd.DataFrame(
        [
            {"by": measure, "tercile": name, "windows": inside["profile_id"].nunique()}
            | {"least": least, "most": most}
            | savings(inside, column, strategy, baseline).columns("saving_pct", 100.0)
            for measure, name, least, most, inside in strata
        ]
    )
