"""Columns of tables: their quantities, ranges and units, and how a configuration names them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from math import pi

from lcc_rl.data.trajectories import FOOT
from lcc_rl.errors import ConfigError, require_known, unknown_name

LARGEST_CELL = 1e12  # in SI: beyond any time or position, and within every type
ISO, FRAMES = "iso", "frames/"  # dates and times of ISO 8601; prefix of the frames per second
CLOCK = "hh:mm:ss"
SPEEDS = {"m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704, "ft/s": FOOT, "kn": 1852 / 3600}
# Units by quantity and their sizes; the first is the SI unit.
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, ISO: 1.0, CLOCK: 1.0},
    "speed": {**SPEEDS, "kph": SPEEDS["km/h"]},
    "length": {"m": 1.0, "cm": 0.01, "km": 1000.0, "ft": FOOT},
    "grade": {"rad": 1.0, "deg": pi / 180, "%": 0.01, "m/m": 1.0},
}
SLOPES = ("%", "m/m")  # units of grades that are slopes, the tangent of the angle
SI = {quantity: next(iter(units)) for quantity, units in UNITS.items()}
QUESTIONS = {  # for numbers outside of their range, with the setting of their unit
    "time": "; is it in ms, us or ns ({})?",
    "grade": "; is it in % (leader.units.grade=%)?",
}
# Spellings of units in names of columns; "min" may also mean the minimum.
UNIT_WORDS = {
    "time": {"ms": "ms|msecs?|milliseconds?", "us": "us|µs|microseconds?", "ns": "ns|nanoseconds?"},
    "speed": {
        "m/s": "m ?/?s|mps|(met(re|er)s|m) per s(ec(ond)?)?",
        "km/h": "km ?/?h|kmph|kph|(kilomet(re|er)s|km) per h(ou)?r?",
        "mph": "mph|mi/h|miles? (per|an) hour",
        "ft/s": "ft/s|fps|(feet|ft) per s(ec(ond)?)?",
        "kn": "kn|kts?|knots?",
    },
    "length": {"ft": "ft|feet|foot", "cm": "cm", "km": "km"},
    "grade": {"rad": "rad", "deg": "deg|degrees?", "%": "%|pct|per ?cent"},
}
Names = Mapping[str, str | None]  # names of columns in a file, by key
Units = Mapping[str, str]  # units of columns, by key


@dataclass(frozen=True)
class Column:
    """Column of a table.

    Args:
        key: its name in the program.
        quantity: ``time``, ``speed``, ``length``, ``number`` or ``text``.
        name: its usual name in a file.
        least, most: range of its numbers, in SI.
        whole: whether its numbers are whole.
        blank: whether cells may be blank: NaN, or ``""`` of text.
        required: whether a table must have it.
        used: what alone uses it, for messages; empty for all.
    """

    key: str
    quantity: str = "number"
    name: str | None = None
    least: float = -LARGEST_CELL
    most: float = LARGEST_CELL
    whole: bool = False
    blank: bool = False
    required: bool = True
    used: str = ""

    @property
    def expected(self) -> str:
        """Description of valid values for messages."""
        unit = f" {SI[self.quantity]}" if self.quantity in SI else ""
        return f"a {'whole ' * self.whole}number from {self.least:g} to {self.most:g}{unit}"


def check_map(columns: Iterable[Column], names: Names, units: Units, at: str) -> None:
    """Check the names and units of columns in a configuration.

    Args:
        columns: all possible columns.
        names: the file's names, by key.
        units: units by key; by default SI.
        at: the node of the configuration, ``data`` or ``leader``.

    Raises:
        ConfigError: naming an unknown key or unit, a required column without name, or a column that
            is named twice.
    """
    by_key = {column.key: column for column in columns}
    measured = {key: UNITS[c.quantity] for key, c in by_key.items() if c.quantity in UNITS}
    require_known(f"key of {at}.columns", names, by_key)
    require_known(f"key of {at}.units", units, measured)
    for key, name in names.items():
        if not (isinstance(name, str) or (name is None and not by_key[key].required)):
            raise ConfigError(f"{at}.columns.{key} must name a column, got {name!r}")
        if name is not None and [*names.values()].count(name) > 1:
            raise ConfigError(f"{at}.columns names the column {name!r} twice")
    for key, unit in units.items():
        more = {"frames/<rate>": 1.0} if by_key[key].quantity == "time" else {}
        if unit_size(by_key[key].quantity, str(unit)) is None:
            raise unknown_name(f"unit in {at}.units.{key}:", str(unit), {**measured[key], **more})


def unit_size(quantity: str, unit: str) -> float | None:
    """Return the size of a unit in SI, including ``frames/25``; None if it is unknown."""
    if quantity == "time" and unit.startswith(FRAMES):
        with suppress(ValueError):
            rate = float(unit.removeprefix(FRAMES))
            return 1 / rate if 0.0 < rate < LARGEST_CELL else None
    return UNITS[quantity].get(unit)


def named_unit(name: str, quantity: str) -> str | None:
    """Return the unit in the name of a column: ``mph`` for ``v (mph)``."""
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])|[^\w/%]|_", " ", name).lower()
    for unit, spelled in UNIT_WORDS.get(quantity, {}).items():
        if re.search(rf"(?<![^\W\d])({spelled})(?![^\W\d])", spaced):
            return unit
    return None
