"""Energy per distance in the units of whoever reads it."""

from __future__ import annotations

from collections.abc import Sequence

from lcc_rl.energy import EnergyModel, Fleet
from lcc_rl.errors import ConfigError, unknown_name

KJ_PER_WH = 3.6
MPG = 235.215  # miles per US gallon times litres per 100 km
ELECTRIC = {"kJ/km": 1.0, "Wh/km": 1.0 / KJ_PER_WH}
FUEL = ("g/km", "L/100km", "mpg")
UNITS = (*ELECTRIC, *FUEL)


def per_distance(kj_per_km: float, unit: str, energy: Fleet) -> float:
    """Convert energy per distance.

    Args:
        kj_per_km: what is converted [kJ/km].
        unit: one of :data:`UNITS`.
        energy: the energy models, which know their fuel.

    Returns:
        The value in that unit.

    Raises:
        ConfigError: if the unit is unknown, or of fuel where vehicles use none or different ones.
    """
    check_unit(unit, energy)
    if unit in ELECTRIC:
        return kj_per_km * ELECTRIC[unit]
    model = energy.models[0]
    grams = kj_per_km * 1e3 / model.heating_value
    if unit == "g/km":
        return grams
    litres = grams / model.density / 10.0  # g/km over g/L, times 100 km
    return litres if unit == "L/100km" else MPG / litres


def check_unit(unit: str, energy: Fleet) -> None:
    """Check that a unit is known and means something for all vehicles.

    Raises:
        ConfigError: see :func:`per_distance`.
    """
    if unit not in UNITS:
        raise unknown_name("unit (task.unit)", unit, UNITS)
    if unit in FUEL and len(_fuels(energy.models)) != 1:
        raise ConfigError(
            f"task.unit={unit} needs vehicles that all burn one fuel; these burn several, or some "
            "none (energy=…): say kJ/km or Wh/km"
        )


def _fuels(models: Sequence[EnergyModel]) -> set[tuple[float, float]]:
    """Return heating value and density of every fuel; of none where a vehicle has no fuel."""
    found = {(round(m.heating_value, 3), m.density) for m in models}
    return set() if any(not value for value, _ in found) else found
