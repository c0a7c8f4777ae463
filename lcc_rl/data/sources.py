"""Sources of car-following episodes: NGSIM files and episode tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from glob import has_magic
from os.path import abspath, expanduser
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import Field

from lcc_rl.assets import ASSETS
from lcc_rl.data.agreement import PAIR_SIGNALS, check_positions
from lcc_rl.data.car_following import Criteria, extract
from lcc_rl.data.columns import SI, Column, Names, Units, check_map
from lcc_rl.data.episodes import (
    DERIVED_POSITIONS,
    EPISODE_NAMES,
    PAIR_FIELDS,
    derive_positions,
    read_episodes,
)
from lcc_rl.data.grid import BRIDGE_S, LongestHole, Places, places
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.plausible import SMOOTHING, Plausible, doubts
from lcc_rl.data.smoothing import averaged
from lcc_rl.data.trajectories import Trajectories, listed
from lcc_rl.errors import Concern, DataError, raised_as
from lcc_rl.io.paths import matching
from lcc_rl.settings import Settings

# Files of the package by name: recorded platoons and drives, drive cycles.
SHIPPED_FILES = {
    path.stem: str(path)
    for kind in ("recorded/*.parquet", "cycles/*.csv")
    for path in ASSETS.glob(kind)
}


@dataclass(frozen=True)
class LoadedEpisodes:
    """Episode table and the report on its origin.

    Args:
        episodes: the episode table, see :data:`lcc_rl.data.episodes.SCHEMA`.
        report: lines on rows read, dropped and kept.
        vehicles: names of the numbered vehicles, if the file names them.
    """

    episodes: pd.DataFrame
    report: list[str]
    vehicles: Mapping[int, str] = field(default_factory=dict)

    def load(self) -> LoadedEpisodes:
        """Return itself, so that a loaded table is a source, too."""
        return self


class Source(Settings):
    """Base of sources of recorded episodes."""

    plausible: Plausible | None = None  # None: the defaults
    # Width of a moving average of speeds, gaps and positions, see
    # :func:`lcc_rl.data.smoothing.averaged`; 0: none [s].
    average_s: Annotated[float, Field(ge=0.0, lt=600.0)] = 0.0

    def select(
        self,
        episodes: pd.DataFrame,
        source: str,
        lines: list[str],
        remedy: str = "",
        place: Places = places,
        units: Units | None = None,
    ) -> LoadedEpisodes:
        """Return the averaged plausible episodes; see :meth:`Plausible.select`."""
        thresholds = self.plausible or Plausible()
        rest, notes = thresholds.select(episodes, source, place, remedy=remedy, units=units)
        if units and rest["follower_position_m"].any():  # of mapped columns; 0 if unknown
            with raised_as(DataError, source, DataError):
                check_positions(rest, place(rest))
        notes += copies(rest["recording"], rest[[*PAIR_SIGNALS.values()]])
        if self.average_s:
            rest, line = averaged(rest, self.average_s, source)
            notes.append(line)
        return LoadedEpisodes(rest, [*lines, *notes, *doubts(rest, "data")])


class TrajectorySource(Source):
    """Base of sources that extract episodes from trajectories."""

    criteria: Criteria | None = None  # None: the defaults

    def extracted(
        self, trajectories: Trajectories, remedy: str = "", place: Places = places
    ) -> LoadedEpisodes:
        """Extract episodes; missing positions are derived from speeds and gaps.

        Args:
            trajectories: samples and report.
            remedy: remedy for implausible accelerations.
            place: returns for an episode table the function that describes its samples.

        Raises:
            DataError: naming the files, if there is no episode, or too many are implausible.
        """
        report, source = trajectories.report, trajectories.report.source
        with raised_as(DataError, source, DataError):
            episodes, extraction = extract(trajectories, self.criteria or Criteria(), place)
        lines = [*report.lines(), *extraction.lines()]
        if not trajectories.samples["position_m"].to_numpy().any():
            derive_positions(episodes)
            lines.append(DERIVED_POSITIONS)
        loaded = self.select(episodes, source, lines, remedy, place, report.units)
        return replace(loaded, vehicles=report.names)


class NgsimSource(TrajectorySource):
    """Episodes extracted from NGSIM files of any published layout."""

    path: str | Path | Sequence[str]  # a file, several, or a pattern such as data/*.csv.gz
    location: str | None = None  # keep only this location, such as i-80 or us-101
    smoothing: Callable | None = None  # of the trajectories, see lcc_rl.data.smoothing
    units: Literal["feet", "metres"] = "feet"

    def load(self) -> LoadedEpisodes:
        """Read, smooth if configured, and extract.

        Raises:
            DataError: if a file is missing or not valid, no episode is left, or more are
                implausible than ``plausible`` allows.
        """
        files = find_files(self.path)
        trajectories = read_ngsim(files, self.location, self.units)
        if self.smoothing is not None:
            trajectories = self.smoothing(trajectories)
        remedy = "" if self.smoothing else f", smooth it ({SMOOTHING})"
        return self.extracted(trajectories, remedy)


class EpisodesSource(Source):
    """Episodes from tables of pairs: a row per pair and time, at any rate, possibly with holes."""

    path: str | Sequence[str]  # a file, several, or a pattern; each is a recording
    # Names in the table of ``episode``, ``recording``, ``follower_id``, ``leader_id``, ``time``,
    # ``follower_speed``, ``leader_speed``, ``gap`` (bumper to bumper), ``follower_position`` and
    # ``leader_position`` (front bumpers) and ``leader_length``; by default those of the package.
    # Instead of ``leader_speed``: ``relative_speed``. ``valid`` and ``target`` divide episodes.
    columns: Mapping[str, str | None] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)  # such as {gap: ft}; else SI
    bridge_s: LongestHole = BRIDGE_S  # longer holes divide records [s]

    def validate(self) -> None:
        check_map(PAIR_FIELDS, self.columns, self.units, "data")

    def load(self) -> LoadedEpisodes:
        """Read and validate.

        Raises:
            DataError: if a file is missing or not a valid table, or more samples are implausible
                than ``plausible`` allows.
        """
        files = find_files(self.path)
        episodes, notes = read_episodes(files, self.columns, self.units, self.bridge_s)
        count, source = episodes["episode"].nunique(), listed(files)
        lines = [f"read {count:,} episodes, {len(episodes):,} rows of 0.1 s, {source}", *notes]
        usual = {key: name for key, name in EPISODE_NAMES.items() if key in self.units}
        named = {**usual, **self.columns}
        source += read_as(PAIR_FIELDS, named, self.units)
        units = units_of(PAIR_FIELDS, {**EPISODE_NAMES, **self.columns}, self.units)
        place = partial(places, files=files, columns=self.columns)
        # A target names the leader of its episode, another text the car that is driven.
        key = "leader_id" if self.columns.get("target") else "follower_id"
        pairs = episodes.drop_duplicates([key, "label"])
        cars, labels = pairs[key], pairs["label"].astype(str)
        told = key == "leader_id" or not (labels == "").any() | labels.str.isnumeric().all()
        vehicles = dict(zip(cars, labels, strict=True)) if told and cars.is_unique else {}
        return replace(
            self.select(episodes, source, lines, place=place, units=units), vehicles=vehicles
        )


def copies(names: Any, motion: pd.DataFrame) -> list[Concern]:
    """Return a concern about recordings, named in each row, with the same speeds and gaps."""
    codes, distinct = pd.factorize(names)
    sums = pd.util.hash_pandas_object(motion, index=False).groupby(codes).sum().sort_values()
    twice = listed([str(distinct[x]) for x in sums.index[sums.duplicated(keep=False)]])
    line = f"recordings {twice} hold the same motion; is a file read twice?"
    return [Concern(line)] * bool(twice)


def read_as(columns: Iterable[Column], names: Names, units: Units) -> str:
    """Return words on named measured columns and their units, for messages.

    Args:
        columns: all possible columns.
        names: the file's names, by key.
        units: units by key; by default SI.
    """
    declared = units_of(columns, names, units)
    if not declared:
        return ""
    option = ", ".join(f"{key}: {unit}" for key, unit in declared.items())
    return f", with data.units={{{option}}} for {', '.join(repr(names[key]) for key in declared)}"


def units_of(columns: Iterable[Column], names: Names, units: Units) -> dict[str, str]:
    """Return the units of named measured columns, by key; see :func:`read_as`."""
    measured = [x for x in columns if x.quantity in SI and names.get(x.key)]
    return {x.key: units.get(x.key, SI[x.quantity]) for x in measured}


def find_files(path: str | Path | Sequence[str | Path]) -> list[str]:
    """Return the files of a path, a pattern or a list of them; those of a pattern are sorted.

    A path may be the name of a shipped recording or cycle. A folder stands for its files, or, if it
    has none, for those of its folders.

    Raises:
        DataError: if a pattern matches no file, or a file is named twice.
    """
    files: list[str] = []
    for entry in [path] if isinstance(path, (str, Path)) else path:
        name = str(expanduser(entry))
        matches = [SHIPPED_FILES[name]] if name in SHIPPED_FILES else matching(name)
        if not matches and (has_magic(name) or Path(name).is_dir()):
            raise DataError(f"{name}: no file matches this pattern")
        files += matches or [name]  # the reader refuses a missing file
    if not files:
        raise DataError("no file is named; expected at least one path")
    twice = [name for name, count in Counter(map(abspath, files)).items() if count > 1]
    if twice:
        raise DataError(f"{twice[0]}: is named twice; expected every file once")
    return files
