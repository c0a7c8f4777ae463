"""Energy per distance in several units."""

from __future__ import annotations

from lcc_rl.energy import Fleet
from lcc_rl.errors import ConfigError, require_known

KJ_PER_WH = 3.6
MPG = 235.215  # miles per US gallon times litres per 100 km
ELECTRIC = {"kJ/km": 1.0, "Wh/km": 1.0 / KJ_PER_WH, "kWh/100km": 0.1 / KJ_PER_WH}
OF_FUEL = ("g/km", "L/100km", "mpg")  # units for vehicles that all burn one fuel
ENERGY_UNITS = (*ELECTRIC, *OF_FUEL)


def in_unit(kj_per_km: float, unit: str, energy: Fleet) -> float:
    """Convert energy per distance [kJ/km] to one of :data:`ENERGY_UNITS`.

    Args:
        kj_per_km: the energy per distance [kJ/km].
        unit: one of :data:`ENERGY_UNITS`.
        energy: the energy models.

    Raises:
        ConfigError: if the unit is unknown, or one of fuel and not all vehicles burn the same fuel.
    """
    check_unit(unit, energy)
    if unit in ELECTRIC:
        return kj_per_km * ELECTRIC[unit]
    model = energy.models[0]
    grams = kj_per_km * 1e3 / model.heating_value
    if unit == "g/km":
        return grams
    litres = grams / model.density / 10.0  # (g/km) / (g/L) · 100 km
    return litres if unit == "L/100km" else MPG / litres


def check_unit(unit: str, energy: Fleet) -> None:
    """Check that a unit is known and valid for all vehicles, see :func:`in_unit`."""
    require_known("unit (task.unit, --unit)", unit, ENERGY_UNITS)
    if unit in OF_FUEL and not burns_one_fuel(energy):
        raise ConfigError(
            f"unit={unit} (task.unit, --unit) needs vehicles that all burn one fuel; here they "
            "burn several or no fuel (energy=…): choose kJ/km or Wh/km"
        )


def burns_one_fuel(energy: Fleet) -> bool:
    """Whether all vehicles burn one fuel."""
    fuels = {(round(m.heating_value or 0.0, 3), m.density) for m in energy.models}
    return len(fuels) == 1 and next(iter(fuels))[0] > 0.0
