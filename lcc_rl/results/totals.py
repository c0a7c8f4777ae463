"""Sums over the rows of an evaluation, added up block by block."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
import pyarrow as pa

from lcc_rl.io.files import Rows
from lcc_rl.results.savings import DRIVE, KEYS, REPEAT, SOURCE, WAYS, paired

WINDOW = ["strategy", "training_seed", "profile_id"]
FOLDED = 100_000  # rows of partial sums that are kept before they are added up


def frames(rows: Rows, columns: Sequence[str], source: str = "") -> Iterator[pd.DataFrame]:
    """Yield rows block by block; a data frame is one block.

    Columns that do not exist are left out; ``source`` is that of the leaders, empty for all.
    """
    wanted = [*dict.fromkeys([*columns, SOURCE])] if source else list(columns)
    for frame in [rows] if isinstance(rows, pd.DataFrame) else _row_groups(rows, wanted):
        kept = frame[[name for name in wanted if name in frame]]
        yield kept[kept[SOURCE] == source] if source else kept


def sources_of(rows: Rows) -> list[str]:
    """Return the names of the sources of leaders, in their order; without one only ""."""
    found: dict[str, None] = {}
    for frame in frames(rows, [SOURCE]):
        found |= dict.fromkeys(map(str, frame.get(SOURCE, ())))
    return list(found) or [""]


def _row_groups(rows: pa.dataset.Dataset, columns: Sequence[str]) -> Iterator[pd.DataFrame]:
    known = [name for name in columns if name in rows.schema.names]
    for file in rows.get_fragments():
        for group in file.split_by_row_group():
            table = group.to_table(schema=rows.schema, columns=known)
            for place, field in enumerate(table.schema):
                if pa.types.is_dictionary(field.type):
                    text = table.column(place).cast(pa.string())
                    table = table.set_column(place, field.name, text)
            yield table.to_pandas()


class Totals:
    """Sums over the rows of one or more evaluations on the same profiles and drivers.

    Memory grows with the windows and the drivers, not with the rows. Strategies are paired within
    a block, which holds the same episodes of all strategies.

    Args:
        rows: the rows.
        means: columns whose means are needed.
        lows: columns whose minima are needed.
        paired_by: the energy that, per distance, pairs of window and driver are compared by.
        baselines: the strategies that the others are compared with.
        source: of the leaders; empty for all.
    """

    def __init__(
        self,
        rows: Rows,
        means: Sequence[str],
        lows: Sequence[str],
        paired_by: str,
        baselines: Sequence[str],
        source: str = "",
    ) -> None:
        self.means, self.lows, self.paired_by = list(means), list(lows), paired_by
        self.baselines, self.minima = baselines, pd.DataFrame()
        # By strategy and baseline: pairs, those worse off, and the sums of both by driver.
        self.pairs: dict[tuple[str, str], tuple[int, int]] = {}
        self.drivers: dict[tuple[str, str], pd.DataFrame] = {}
        parts: list[pd.DataFrame] = []
        self.drives: dict[int, str] = {}  # by window
        columns = [*WINDOW, *KEYS, DRIVE, REPEAT, *self.means, *self.lows, *WAYS, paired_by]
        for frame in frames(rows, list(dict.fromkeys(columns)), source):
            parts.append(self._window_sums(frame))
            if sum(map(len, parts)) > FOLDED + 2 * len(parts[0]):
                parts = [_folded(parts)]
            known = [name for name in self.lows if name in frame]
            lows_here = frame.groupby("strategy", sort=False)[known].min()
            self.minima = pd.concat([self.minima, lows_here]).groupby(level=0, sort=False).min()
            self._compare(frame)
            if DRIVE in frame:
                known_here = frame.drop_duplicates("profile_id")
                self.drives |= dict(zip(known_here["profile_id"], known_here[DRIVE], strict=True))
        self.windows = _folded(parts)
        self.strategies = [str(name) for name in self.windows.index.unique(0)]

    def _window_sums(self, frame: pd.DataFrame) -> pd.DataFrame:
        """Return sums and counts by window."""
        values = frame.reindex(columns=self.means).astype(np.float64).assign(rows=1.0)
        seeds = frame.get("training_seed", pd.Series(np.nan, frame.index, name=WINDOW[1]))
        by = [frame["strategy"], pd.to_numeric(seeds).astype("Int64"), frame["profile_id"]]
        groups = values.groupby(by, sort=False, dropna=False)
        return pd.concat({"sum": groups.sum(), "count": groups.count()}, axis=1)

    def _compare(self, frame: pd.DataFrame) -> None:
        """Count who is worse off with a strategy than with a baseline, pair by pair."""
        if self.paired_by not in frame:
            return
        ways = frame[[name for name in WAYS if name in frame]].sum(axis=1)
        frame = frame.assign(way=ways, per_way=frame[self.paired_by] / ways)
        energy, way, per_way = (paired(frame, x) for x in (self.paired_by, "way", "per_way"))
        for baseline in (name for name in self.baselines if name in per_way):
            for strategy in (str(name) for name in per_way if name != baseline):
                place = [strategy, baseline]
                both = per_way[place].dropna().astype(np.float64)
                count, worse = self.pairs.get((strategy, baseline), (0, 0))
                more = int((both[strategy] > both[baseline]).sum())
                self.pairs[strategy, baseline] = (count + len(both), worse + more)
                parts = {"energy": energy.loc[both.index, place], "way": way.loc[both.index, place]}
                sums = pd.concat(parts, axis=1).groupby("driver_id").sum()
                known = self.drivers.get((strategy, baseline))
                total = sums if known is None else known.add(sums, fill_value=0.0)
                self.drivers[strategy, baseline] = total

    def sums(self) -> pd.DataFrame:
        """Return the sum of each column of means by strategy, and the number of ``rows``."""
        return pd.DataFrame(self.windows["sum"].groupby(level=0, sort=False).sum())

    def mean(self) -> pd.DataFrame:
        """Return the mean of each column of means by strategy."""
        found = self.windows.groupby(level=0, sort=False).sum()
        return pd.DataFrame(found["sum"] / found["count"].replace(0, np.nan))

    def low(self, column: str, strategy: str) -> float:
        """Return the minimum of a column of lows; NaN if the strategy has none."""
        return float(self.minima[column][strategy]) if column in self.minima else np.nan

    def per_window(self) -> pd.DataFrame:
        """Return the means by strategy, training seed and window, as rows, with their drives."""
        means = self.windows["sum"] / self.windows["count"].replace(0, np.nan)
        rows = means.reset_index()
        return rows.assign(**{DRIVE: rows["profile_id"].map(self.drives)}) if self.drives else rows

    def worse_off(self, strategy: str, baseline: str) -> dict[str, float]:
        """Return the shares of pairs and of drivers who take more per distance; NaN without any.

        As a saving, that of a driver is of the sums over its windows.
        """
        count, worse = self.pairs.get((strategy, baseline), (0, 0))
        if not count:
            return {"pairs": np.nan, "drivers": np.nan}
        sums = self.drivers[strategy, baseline]
        per_way = sums["energy"] / sums["way"]
        return {"pairs": worse / count, "drivers": (per_way[strategy] > per_way[baseline]).mean()}


def _folded(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Add up partial sums of the same windows."""
    return pd.concat(parts).groupby(level=[0, 1, 2], sort=False, dropna=False).sum()
