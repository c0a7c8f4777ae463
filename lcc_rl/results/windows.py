"""Windows of an evaluation: means by strategy, training seed and held-out window, and savings."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
import pyarrow as pa

from lcc_rl.arrays import per_distance
from lcc_rl.energy import AVERAGED, BURNT, SECOND
from lcc_rl.io.files import Rows, read_parquet
from lcc_rl.results.intervals import (
    NOTHING,
    Estimate,
    Minute,
    equal_seeds,
    estimate,
    saving,
    share_saved,
    varied,
)
from lcc_rl.results.measures import (
    DAMPING,
    DISTANCE,
    MEASURES,
    SHARE,
    WAYS,
    WITH_VALUE,
    Measure,
    aggregates,
)
from lcc_rl.results.names import in_words, size_of
from lcc_rl.results.runs import EPISODES

WINDOWS, DRIVERS = "windows.parquet", "drivers.parquet"
PAIR_KEYS = ["profile_id", "driver_id"]
REPEAT = "repeat"  # number of the draw of the noise, if there are several
DRIVE = "drive"  # drive of a row's window; windows of one drive are similar
START = "start_s"  # time in its recording at which a row's window starts [s]
SOURCE = "source"  # source of a row's leader, if a mixture has several
LEADER_COLUMNS = ("leader_path_energy_kj", "leader_speed_mps")
STRATEGY, TRAINED = "strategy", "training_seed"
WINDOW_KEYS = [STRATEGY, TRAINED, "profile_id"]
PER_WINDOW = ["profile", SOURCE, DRIVE, START]  # constant within a window
ENERGIES = ("energy_kj", "net_energy_kj", "path_energy_kj", *AVERAGED, *BURNT, SECOND)
FOLDED = 100_000  # most rows of partial sums before they are added
PER_KM = "vehicle and km"
# Distances by which the energies of each group of vehicles are divided.
DRIVEN = {"cav": WAYS[:1], "hdv": WAYS[1:], "total": WAYS}
WORST = "worst_"  # prefix of the largest share of an episode


def windows_of(rows: Rows, columns: Sequence[str] = ()) -> pd.DataFrame:
    """Aggregate the rows of an evaluation to means over drivers and repeats.

    Args:
        rows: rows of episodes.parquet; of a dataset one block is in memory at a time.
        columns: columns to aggregate; by default all measures.

    Returns:
        A row per strategy, training seed and window. Measures have their ``aggregate``; other
        columns are means, ``episodes`` is the number of rows, ``drivers`` that of drivers,
        ``collisions`` that of rows with a collision, ``worst_share_…`` the largest share of an
        episode, ``counted_…`` the number of episodes with a value, if some of a window lack one.
    """
    return fold(rows, [*WINDOW_KEYS, *PER_WINDOW], columns)


def fold(rows: Rows, by: Sequence[str], columns: Sequence[str] = ()) -> pd.DataFrame:
    """Aggregate rows by keys, block by block, see :func:`windows_of`; missing keys are left out.

    Memory grows with the number of groups, not of rows.
    """
    sums: list[pd.DataFrame] = []
    for frame in _frames(rows, [*by, *columns] if columns else []):
        sums.append(_sums(_derived(frame), by, columns))
        if sum(map(len, sums)) > FOLDED + 2 * len(sums[0]):
            sums = [_added(sums)]
    total = _added(sums)
    means = {}
    for kind, name in zip(*map(total.columns.get_level_values, (0, 1)), strict=True):
        if kind != "count":
            count = total.get(("count", name))
            values = total[kind, name]
            means[name] = values if count is None else values / count.replace(0, np.nan)
            if count is not None and ((count > 0) & (count < total["sum", "episodes"])).any():
                means[f"{WITH_VALUE}{name}"] = count
    return pd.DataFrame(means).reset_index()


def _frames(rows: Rows, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    """Yield rows block by block; a data frame is one block."""
    if isinstance(rows, pd.DataFrame):
        yield rows
        return
    needed = set(columns) or set(rows.schema.names)
    needed |= {"collided", DAMPING, REPEAT, *WAYS}
    needed |= {f"{group}_{name}" for group in ("total", "hdv") for name in ENERGIES}
    present = [name for name in rows.schema.names if name in needed]
    for file in rows.get_fragments():
        for group in file.split_by_row_group():
            table = group.to_table(schema=rows.schema, columns=present)
            for index, field in enumerate(table.schema):
                if pa.types.is_dictionary(field.type):
                    text = table.column(index).cast(pa.string())
                    table = table.set_column(index, field.name, text)
            yield table.to_pandas()


def _derived(rows: pd.DataFrame) -> pd.DataFrame:
    """Add numbers, distances and energies of all vehicles, and whether an episode is damped."""
    seed = pd.to_numeric(rows.get(TRAINED, pd.Series(np.nan, rows.index))).astype("Int64")
    added: dict[str, Any] = {TRAINED: seed, "episodes": 1.0}
    added["drivers"] = (rows[REPEAT] == 0).astype(float) if REPEAT in rows else 1.0
    if "collided" in rows:
        added |= dict.fromkeys(("collisions", "collided"), rows["collided"].astype(float))
    if distances := [name for name in WAYS if name in rows]:
        added[DISTANCE] = rows[distances].sum(axis=1, min_count=1)  # NaN as the energies are
    for name in ENERGIES:  # without automated vehicles, those of the others
        energies = [rows[f"{x}_{name}"] for x in ("total", "hdv") if f"{x}_{name}" in rows]
        if energies:
            added[f"all_{name}"] = energies[0].fillna(energies[-1])
    if DAMPING in rows:
        added |= {"damped": rows[DAMPING].notna(), "damped_s": rows[DAMPING].fillna(0.0)}
    return rows.assign(**added)


def _sums(frame: pd.DataFrame, by: Sequence[str], columns: Sequence[str]) -> pd.DataFrame:
    """Return sums, counts and extremes of columns by keys."""
    numbers = [str(name) for name in frame.select_dtypes(["number", "bool"])]
    keys = {*PAIR_KEYS, TRAINED, *by}
    names = [name for name in columns or numbers if name in numbers and name not in keys]
    if not columns:
        shares = [one.key for one in MEASURES if one.unit == SHARE and one.key in names]
        frame = frame.assign(**{f"{WORST}{name}": frame[name] for name in shares})
        names += [f"{WORST}{name}" for name in shares]
    names = list(dict.fromkeys(["episodes", "drivers", *names]))
    of = [frame[name] for name in by if name in frame]
    values = frame[names].astype(np.float64)
    groups = values.groupby(of, sort=False, dropna=False, observed=True)
    kinds: dict[str, list[str]] = {kind: [] for kind in ("sum", "count", "min", "max")}
    statistics = aggregates()
    for name in names:
        kind = "max" if name.startswith(WORST) else statistics.get(name, "mean")
        for statistic in ("sum", "count") if kind == "mean" else (kind,):
            kinds[statistic].append(name)
    return pd.concat({x: getattr(groups[y], x)() for x, y in kinds.items() if y}, axis=1)


def _added(sums: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Add partial sums of the same groups."""
    if len(sums) == 1:
        return sums[0]
    total = pd.concat(sums)
    kinds = {column: "sum" if column[0] == "count" else column[0] for column in total.columns}
    levels = list(range(total.index.nlevels))
    return total.groupby(level=levels, sort=False, dropna=False).agg(kinds)


@dataclass(frozen=True)
class Means:
    """Means over the episodes of an evaluation with the same drivers in all windows.

    Args:
        windows: result of :func:`windows_of`.
        drivers: energies and distances per strategy and driver, means over windows and seeds.
        per: unit to which energies refer.
    """

    windows: pd.DataFrame
    drivers: pd.DataFrame
    per: str = "episode"

    @property
    def size(self) -> str:
        """Numbers of windows and drivers, in words."""
        return size_of(self.windows["profile_id"].nunique(), self.drivers["driver_id"].nunique())

    @classmethod
    def of(cls, rows: pd.DataFrame) -> Self:
        """Return the means of rows of episodes.parquet."""
        energies = [str(name) for name in rows if str(name).endswith("energy_kj") or name in WAYS]
        return cls(windows_of(rows), fold(rows, [STRATEGY, "driver_id"], energies))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Return the means of an evaluation: stored in its folder, else of its episodes."""
        if (folder / WINDOWS).exists():
            return cls(read_parquet(folder / WINDOWS), read_parquet(folder / DRIVERS))
        return cls.of(read_parquet(folder / EPISODES))

    def per_km(self) -> Self:
        """Return the means with energies and savings per vehicle and km."""
        drivers = self.drivers.copy()
        for group, names in DRIVEN.items():
            km = drivers[[name for name in names if name in drivers]].sum(axis=1) / 1e3
            energies = drivers.columns[drivers.columns.str.fullmatch(f"{group}_.*energy_kj")]
            drivers[energies] = drivers[energies].div(km, axis=0)
        return replace(self, drivers=drivers, per=PER_KM)

    def saving(self, column: str, strategy: str, baseline: str) -> Estimate:
        """Return the saving of a strategy over windows, see :func:`savings`."""
        per = DRIVEN[column.partition("_")[0]] if self.per == PER_KM else ()
        return savings(self.windows, column, strategy, baseline, per)


def savings(
    rows: pd.DataFrame, column: str, strategy: str, baseline: str, per: Sequence[str] = ()
) -> Estimate:
    """Return the share of the baseline's mean energy that a strategy saves.

    Tables show ``savings(rows, "total_path_energy_kj", "alcc", "human", per=WAYS)``. Trainings are
    compared by equal seeds (:func:`with_equal_seeds`), which are left out in pairs.

    Args:
        rows: rows of an evaluation, or result of :func:`windows_of`.
        column, strategy, baseline: the energy, and names of the strategies.
        per: columns of distances; the total energy is divided by their sum. Without them energies
            of whole episodes are compared, which falling behind lowers.

    Returns:
        The share with its interval over windows or drives, and seeds
        (:func:`lcc_rl.results.intervals.estimate`), for the windows of both; NaN if one of them is
        missing, or the baseline is below the measure's ``least``.
    """
    chosen = with_equal_seeds(rows, strategy, baseline)
    energy, distance, drives = _over(_by_window(chosen, [column, *per]), column, per)
    if energy.empty or not {strategy, baseline} <= set(energy.columns.get_level_values(0)):
        return NOTHING
    ours, theirs = ((energy[x].to_numpy(), distance[x].to_numpy()) for x in (strategy, baseline))
    least = next((x.least for x in MEASURES if x.key == column), -np.inf)
    if theirs[0].mean() < least * float(theirs[1].mean()):
        return NOTHING
    paired = equal_seeds(energy[strategy].columns, energy[baseline].columns)
    return saving(ours[0], theirs[0], paired, drives, ways=(ours[1], theirs[1]))


def with_bounds(rows: pd.DataFrame, measures: Iterable[Measure]) -> dict[str, Estimate]:
    """Return measures of a strategy's rows by key, without factors, with their intervals."""
    found = [one for one in measures if {*one.columns} <= set(rows)]
    table, estimates = _by_window(rows, [name for one in found for name in one.columns]), {}
    for one in found:
        column, *per = one.columns
        total, by, drives = _over(table, column, per)
        side = {"energy": total.to_numpy(), "way": by.to_numpy()}
        if by.size:
            drawn = estimate(lambda x: per_distance(**x), side, drives=drives)
            estimates[one.key] = drawn.within(*one.possible)
    return estimates


def with_equal_seeds(rows: pd.DataFrame, strategy: str, baseline: str) -> pd.DataFrame:
    """Return the rows of two strategies, of their common training seeds if they have any."""
    chosen = rows[rows[STRATEGY].isin([strategy, baseline])]
    if TRAINED not in chosen:
        return chosen.assign(**{TRAINED: np.nan})
    seeds = [set(x.dropna()) for _, x in chosen.groupby(STRATEGY, observed=True)[TRAINED]]
    common = set.intersection(*seeds) if seeds else ()
    return chosen[chosen[TRAINED].isna() | chosen[TRAINED].isin(common)] if common else chosen


def seeds_left_out(rows: pd.DataFrame, strategy: str, baseline: str | None) -> tuple[str, int]:
    """Return in words the seeds of two strategies that are not compared, and the number of others.

    The number is that of the strategy's seeds.
    """
    every = rows[rows[STRATEGY].isin([strategy, baseline])].dropna(subset=TRAINED)
    every = every.drop_duplicates(WINDOW_KEYS[:2]).sort_values(TRAINED)
    compared = with_equal_seeds(every, strategy, str(baseline))
    rest = every.drop(compared.index).groupby(STRATEGY, sort=False)[TRAINED]
    phrases = (f"seed {', '.join(map(str, seeds))} of {in_words(str(of))}" for of, seeds in rest)
    return " and ".join(phrases), int((compared[STRATEGY] == strategy).sum())


def _by_window(chosen: pd.DataFrame, columns: Iterable[str]) -> dict[str, pd.DataFrame]:
    """Return columns by window, of each strategy and seed; ``drive``: a row of each window."""
    both = [each for name in dict.fromkeys(columns) for each in (name, f"{WITH_VALUE}{name}")]
    names = [name for name in both if name in chosen]
    drives = {DRIVE: chosen.drop_duplicates("profile_id").set_index("profile_id")}
    keyed = chosen.assign(**{TRAINED: chosen[TRAINED].astype(object).fillna(-1)})
    means = keyed.groupby(["profile_id", *WINDOW_KEYS[:2]], observed=True)[names].mean()
    return drives | {x: means[x].unstack(WINDOW_KEYS[:2]).sort_index(axis=1) for x in names}


def drives_of(windows: pd.DataFrame) -> list[object] | None:
    """Return the drive of each row, with the minute if it is known; None without drives."""
    if DRIVE not in windows:
        return None
    drives = windows[DRIVE].tolist()
    if START not in windows or windows[START].isna().any():
        return drives
    return [*map(Minute, drives, (windows[START] // 60.0).astype(int))]


def varied_in(windows: pd.DataFrame) -> str:
    """Return what intervals of these windows are over, see :func:`varied`."""
    drives = windows[DRIVE].nunique() if DRIVE in windows else 0
    return varied(drives, len({*(drives_of(windows) or ())}))


def _over(
    tables: dict[str, pd.DataFrame], column: str, per: Sequence[str]
) -> tuple[pd.DataFrame, pd.DataFrame, list[object] | None]:
    """Return energy and distance by window, strategy and seed, and the drives of the windows."""
    energy = tables[column].dropna(axis=1, how="all").dropna()
    ways = [tables[name].reindex_like(energy).fillna(0.0) for name in per if name in tables]
    way = sum(ways, 0.0 * energy) + float(not ways)
    if not ways and (counts := tables.get(f"{WITH_VALUE}{column}")) is not None:
        way = counts.reindex_like(energy)  # not all episodes of a window have a value
        energy = energy * way
    return energy, way, drives_of(tables[DRIVE].loc[energy.index])


def by_driver(drivers: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return a column per strategy and a row per driver, from the drivers of :class:`Means`."""
    return drivers.pivot_table(index="driver_id", columns=STRATEGY, values=column, aggfunc="mean")


def driver_savings(drivers: pd.DataFrame, column: str, strategy: str, baseline: str) -> pd.Series:
    """Return the share of a baseline's mean energy that a strategy saves, by driver."""
    energy = by_driver(drivers, column)
    return share_saved(energy[strategy], energy[baseline])


def per_seed(windows: pd.DataFrame, column: str) -> dict[str, pd.Series]:
    """Return for each strategy the mean of a column over windows by training seed."""
    means = {
        str(strategy): rows.groupby(TRAINED, dropna=False)[column].mean()
        for strategy, rows in windows.groupby(STRATEGY, sort=False)
    }
    return {strategy: values for strategy, values in means.items() if values.notna().any()}


def by_source(rows: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the name and rows of each source of leaders; "" and all rows without sources."""
    if SOURCE not in rows:
        yield "", rows
        return
    for source, group in rows.groupby(SOURCE, sort=False):
        yield str(source), group
