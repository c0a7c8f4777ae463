"""Leaders that drive the records of one table: many drives, or a single one."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lcc_rl.data.cycles import Leaders, varying
from lcc_rl.data.drive_tables import COLUMNS, UNITS, read_drives
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records, nothing
from lcc_rl.data.units import factors
from lcc_rl.errors import ConfigError, DataError, require_in, unknown_name


@dataclass(frozen=True)
class DriveLeaders:
    """Leaders that drive the speed records of a table.

    Several drives are divided by name: whether a drive is held out depends on a SHA-256 hash of
    its name alone, or of the part that drives of one day share, so that it is on the same side in
    every file. Of a single record the end is held out.

    Args:
        path: a .csv or .parquet file, of drives also several or a pattern. A native OpenACC file
            is the drive of its first car, named after the file.
        columns: what its columns are called: ``drive``, the name of the record, null for a table
            that holds one record; ``time``, even in a record; ``speed``.
        units: of the columns ``time`` and ``speed``, such as ``{"speed": "km/h"}``; s and m/s
            where they are not named.
        evaluation_share: share of the names, or of the single record, that is held out, 0…1; 1
            evaluates on everything and leaves nothing to train on.
        together: regular expression; drives whose names begin with the same match are on the same
            side. None: every name by itself.
        tuning: for choosing settings: leave the evaluation's part out and divide the rest again.
        least_variation: see :class:`lcc_rl.data.cycles.RecordLeaders`.
        fastest: held-out windows in which the leader's mean speed is higher are left out [m/s];
            None for none.
        plausible: thresholds of every sample; None for the defaults.

    Raises:
        ConfigError: if a column is unknown, a number out of range or the expression is none.
    """

    path: str | Sequence[str]
    columns: Mapping[str, str | None] = field(default_factory=lambda: dict(COLUMNS))
    units: Mapping[str, str] = field(default_factory=lambda: dict(UNITS))
    evaluation_share: float = 1 / 3
    together: str | None = None
    tuning: bool = False
    least_variation: float = 2.0
    fastest: float | None = None
    plausible: Plausible | None = None

    def __post_init__(self) -> None:
        require_in("leader", "(0, 1]", evaluation_share=self.evaluation_share)
        require_in("leader", "[0, inf)", least_variation=self.least_variation)
        if self.fastest is not None:
            require_in("leader", "(0, inf)", fastest=self.fastest)
        if self.tuning and self.evaluation_share == 1:
            raise ConfigError("leader.tuning=true leaves nothing to tune on: evaluation_share is 1")
        try:
            re.compile(self.together or "")
        except re.error as error:
            raise ConfigError(f"leader.together={self.together}: {error}") from error
        if self.together and self.columns.get("drive", "") is None:
            raise ConfigError("leader.together divides drives by name; the table holds one record")
        for key, name in self.columns.items():
            if key not in COLUMNS:
                raise unknown_name("key of leader.columns", str(key), COLUMNS)
            if not (isinstance(name, str) or (key == "drive" and name is None)):
                raise ConfigError(f"leader.columns.{key} must name a column, got {name!r}")
        factors(self.units, COLUMNS, "leader.units")

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read everything; see :meth:`lcc_rl.data.cycles.RecordLeaders.load`."""
        columns = {**COLUMNS, **self.columns}
        profiles, report = read_drives(self.path, columns, time_step, self.plausible, self.units)
        divide = self._by_time if columns["drive"] is None else self._by_name
        training, held_out = divide(profiles)
        if self.tuning:
            training, held_out = divide(training, again=True)
        self._check_lengths(profiles, (training, held_out), horizon)
        windows = varying(held_out.at_least(horizon).windows(horizon), self.least_variation)
        windows = slow(windows, self.fastest)
        if len(training):
            training = training.at_least(horizon)
        by = "at the end" if columns["drive"] is None else "by name"
        count = f"{len(held_out)} of {len(profiles)} record(s) for evaluation, {by}: "
        line = f"{self.path}: {count}{', '.join(held_out.names)}"
        return Leaders(training, windows, report=(*report, line))

    def _check_lengths(self, all_: Profiles, parts: Sequence[Profiles], horizon: int) -> None:
        """Check that both sides hold a record of an episode's length; say what can be done."""
        step = all_.time_step
        whole, *sides = (int(x.lengths.max()) - 1 if len(x) else horizon for x in (all_, *parts))
        shortest = min(sides)
        if shortest >= horizon:
            return
        needs = f"shorter than the horizon: an episode needs {horizon} steps ({horizon * step:g} s)"
        has = f"the longest record has {whole} ({whole * step:g} s)"
        lower = f"lower scenario.horizon to at most {max(1, min(whole, shortest))}"
        if whole < horizon:
            lower = f"lower scenario.horizon to at most {whole}"
            raise DataError(f"{self.path}: {needs}, {has}; {lower} or give longer records")
        side = ("training", "evaluation")[sides.index(shortest)]
        raise DataError(
            f"{self.path}: {needs}, {has}, its part for {side} only {shortest}; {lower}, give "
            "longer records, or say leader.evaluation_share=1 to evaluate on all of it and train "
            "on nothing"
        )

    def _by_name(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide drives by a hash of their names; once more for tuning."""
        share = self.evaluation_share
        place = np.array([hashed(self._family(name)) for name in profiles.recordings])
        if again:  # what is left lies in share…1
            place = (place - share) / (1 - share)
        held = place < share
        if held.all() and share == 1:
            return nothing(profiles.time_step), profiles
        if held.all() or not held.any():
            side = "evaluation" if held.any() else "training"
            raise DataError(
                f"{self.path}: the names of all {len(held)} drives fall on the side of {side}; "
                "change leader.evaluation_share (1: all for evaluation) or give more drives"
            )
        return profiles.select(np.flatnonzero(~held)), profiles.select(np.flatnonzero(held))

    def _family(self, name: str) -> str:
        """Return the part of a name that says on which side its drive is.

        Raises:
            DataError: if the name has no such part.
        """
        if self.together is None:
            return name
        found = re.match(self.together, name)
        if not found or not found.group():
            raise DataError(f"{self.path}: drive {name!r} does not begin with {self.together!r}")
        return found.group()

    def _by_time(self, profiles: Profiles, again: bool = False) -> tuple[Profiles, Profiles]:
        """Divide the one record, whose end is held out."""
        if self.evaluation_share == 1:
            return nothing(profiles.time_step), profiles
        record, name = profiles.record(0), profiles.names[0]
        cut = len(record) - round(self.evaluation_share * len(record))
        if not 1 < cut < len(record) - 1:
            raise DataError(f"{self.path}: {len(record)} samples cannot be divided")
        at = f"{name}+{cut * profiles.time_step:g}s"
        parts = ((record[:cut], name), (record[cut:], at))
        first, last = (
            from_records([part], [label], profiles.recordings, profiles.time_step)
            for part, label in parts
        )
        return first, last


def slow(profiles: Profiles, fastest: float | None) -> Profiles:
    """Return the records whose mean speed is at most ``fastest`` [m/s]; all for None.

    Raises:
        DataError: if there is none.
    """
    if fastest is None:
        return profiles
    kept = [i for i in range(len(profiles)) if float(profiles.record(i).mean()) <= fastest]
    if not kept:
        raise DataError(
            f"no held-out window in which the leader's mean speed is at most {fastest:g} m/s; "
            "raise leader.fastest or give another record"
        )
    return profiles.select(kept)


def hashed(name: str) -> float:
    """Return a number in [0, 1) that depends on a name alone, the same on every machine.

    The prefix keeps it apart from other divisions by the plain hash of the same names.
    """
    digest = hashlib.sha256(f"lcc_rl held out: {name}".encode()).digest()
    return int.from_bytes(digest[:6], "big") / 2**48
