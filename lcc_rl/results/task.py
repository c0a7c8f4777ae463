"""Tasks: score, baseline and limits."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import field, replace
from typing import Annotated, Any

import numpy as np
import pandas as pd
from pydantic import BeforeValidator

from lcc_rl.config.words import RECORDED
from lcc_rl.energy import Fleet
from lcc_rl.errors import ConfigError, require, require_known
from lcc_rl.results import measures
from lcc_rl.results.intervals import BOUNDED
from lcc_rl.results.measures import Measure, heading
from lcc_rl.results.names import HUMAN
from lcc_rl.settings import Settings

PERCENT = re.compile(r"\d+(\.\d+)? ?%")


def _bound(value: Any) -> Any:
    relative = value == RECORDED or (isinstance(value, str) and PERCENT.fullmatch(value))
    if relative or (isinstance(value, (int, float)) and value >= 0.0):
        return value
    expected = (
        f"a number of at least 0, {RECORDED}, or a share of the value of task.against such as 98 %"
    )
    raise ValueError(f"must be {expected}, got {value!r}; ~task.limits.<name> removes a limit")


Bound = Annotated[float | str, BeforeValidator(_bound)]


class Task(Settings):
    """Score, baseline and limits of a task."""

    name: str = ""  # needed
    # The score, which is minimised: energy, net_energy or path_energy of all vehicles divided by
    # their distance, or a column of episodes.parquet.
    score: str = "net_energy"
    unit: str = "kJ/km"  # unit of energy per distance, see lcc_rl.results.task
    against: str = HUMAN  # the baseline
    # Bounds by column: largest value of max_… and smallest of min_… in any episode, largest mean of
    # share_… and smallest mean of flow_vph over all episodes. ``recorded``: the value of the
    # recorded drivers; ``98 %``: this share of the value of ``against``.
    limits: Mapping[str, Bound] = field(default_factory=dict)

    def validate(self) -> None:
        require(self.name, "task.name is required: choose a task, such as task=i24-follow5")
        require_known("score (task.score)", self.score, measures.score_measures())
        require_known("column of task.limits", self.limits, measures.limit_measures())

    def among(self, strategies: Iterable[str]) -> Task:
        """Return the task for an evaluation of these strategies.

        If the baseline was not evaluated, the first strategy is used.
        """
        names = list(dict.fromkeys(map(str, strategies)))
        return self if self.against in names else replace(self, against=names[0])

    @property
    def references(self) -> list[str]:
        """The strategies whose values the saving and the limits refer to."""
        return [self.against, *([RECORDED] if RECORDED in self.limits.values() else [])]

    def resolved(self, windows: pd.DataFrame) -> Task:
        """Return the task with numbers for limits that refer to other strategies."""
        measure_of, limits = measures.limit_measures(), dict(self.limits)
        for key, bound in self.limits.items():
            if isinstance(bound, str):
                name = RECORDED if bound == RECORDED else self.against
                share = 1.0 if bound == RECORDED else 0.01 * float(bound.rstrip(" %"))
                rows = windows[windows["strategy"] == name]
                limits[key] = share * measure_of[key].value(rows) if len(rows) else bound
        return replace(self, limits=limits)

    @property
    def bounds(self) -> dict[Measure, float]:
        """The limits by measure, without unknown ones of other strategies."""
        known = measures.limit_measures()
        return {
            known[key]: bound for key, bound in self.limits.items() if not isinstance(bound, str)
        }

    @property
    def measure(self) -> Measure:
        """The measure of the score."""
        return measures.score_measures()[self.score]

    @property
    def label(self) -> str:
        """The score with its unit, for tables."""
        named = heading(self.score)
        return f"{named} [{self.unit}]" if self.measure.per else named


# -- energy per distance in several units ----------------------------------------------------------

KJ_PER_WH = 3.6
MPG = 235.215  # miles per US gallon times litres per 100 km
KJ = "kJ/km"
ELECTRIC = {KJ: 1.0, "Wh/km": 1.0 / KJ_PER_WH, "kWh/100km": 0.1 / KJ_PER_WH}
OF_FUEL = ("g/km", "L/100km", "mpg")  # units for vehicles that all burn one fuel
ENERGY_UNITS = (*ELECTRIC, *OF_FUEL)


def in_units(
    table: Mapping[str, Any] | pd.DataFrame, key: str, name: str, unit: str, energy: Fleet | None
) -> dict[str, Any]:
    """Return a column [kJ/km] of a row or a table and its interval in a unit, under a name."""
    low, high = BOUNDED[:0:-1] if unit == "mpg" else BOUNDED[1:]
    ends = zip(BOUNDED, ("", low, high), strict=True)
    return {f"{name}{x}": in_unit(table.get(f"{key}{y}", np.nan), unit, energy) for x, y in ends}


def in_unit(kj_per_km: Any, unit: str, energy: Fleet | None) -> Any:
    """Convert energy per distance [kJ/km], of any shape, to one of :data:`ENERGY_UNITS`.

    Raises:
        ConfigError: if the unit is unknown, or one of fuel and not all vehicles burn the same fuel.
    """
    check_unit(unit, energy)
    if unit in ELECTRIC:
        return kj_per_km * ELECTRIC[unit]
    model = energy.models[0]  # type: ignore[union-attr]  # see check_unit
    grams = kj_per_km * 1e3 / model.heating_value
    if unit == "g/km":
        return grams
    litres = grams / model.density / 10.0  # (g/km) / (g/L) · 100 km
    return litres if unit == "L/100km" else MPG / litres


def check_unit(unit: str, energy: Fleet | None) -> None:
    """Check that a unit is known and valid for all vehicles, see :func:`in_unit`."""
    require_known("unit (unit, task.unit, --unit)", unit, ENERGY_UNITS)
    if unit in OF_FUEL and not (energy and burns_one_fuel(energy)):
        raise ConfigError(
            f"unit={unit} (task.unit, --unit) needs vehicles that all burn one fuel; here they "
            "burn several or no fuel (energy=…): choose kJ/km or Wh/km"
        )


def burns_one_fuel(energy: Fleet) -> bool:
    """Whether all vehicles burn one fuel."""
    fuels = {(round(m.heating_value or 0.0, 3), m.density) for m in energy.models}
    return len(fuels) == 1 and next(iter(fuels))[0] > 0.0
