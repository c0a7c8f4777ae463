"""Names, table columns and bounds of the parameters that a calibration fits (A6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.functional.driver_models import DriverLaw
from lcc_rl.functional.laws import LAWS

# Table column of every parameter of every model.
COLUMNS = {
    "desired_speed": "desired_speed_mps",
    "time_gap": "time_gap_s",
    "acceleration": "acceleration_mps2",
    "deceleration": "deceleration_mps2",
    "min_gap": "min_gap_m",
    "sensitivity": "sensitivity_hz",
    "form": "form",
    "speed_gain": "speed_gain_hz",
    "leader_deceleration": "leader_deceleration_mps2",
}
DEFAULT_BOUNDS = {
    "desired_speed": (5.0, 40.0),
    "time_gap": (0.3, 4.0),
    "acceleration": (0.3, 4.0),
    "deceleration": (0.3, 5.0),
    "min_gap": (0.5, 5.0),
    "sensitivity": (0.05, 5.0),
    "form": (0.05, 3.0),
    "speed_gain": (0.05, 3.0),
    "leader_deceleration": (0.3, 5.0),
}
# What no driver has: beyond these a table is in other units, or not one of drivers.
PLAUSIBLE = {
    "desired_speed": (1.0, 100.0),
    "time_gap": (0.05, 20.0),
    "acceleration": (0.05, 20.0),
    "deceleration": (0.05, 20.0),
    "min_gap": (0.05, 50.0),
    "sensitivity": (0.001, 20.0),
    "form": (0.001, 10.0),
    "speed_gain": (0.001, 20.0),
    "leader_deceleration": (0.05, 20.0),
}
IDM = "idm"
MODEL = "model"  # the column that names a driver's model; a table without it is of the IDM
MODES = ("local", "global")
# A parameter this close to a bound, as a share of the range, counts as being on it.
BOUND_TOLERANCE = 0.005

Bounds = Mapping[str, Sequence[float]]
Limits = dict[str, tuple[float, float]]


def law_of(model: str) -> DriverLaw:
    """Return a driver model by its name.

    Raises:
        ConfigError: if there is none of that name.
    """
    if model not in LAWS:
        raise unknown_name("driver model", model, LAWS)
    return LAWS[model]


def fitted(mode: str, model: str = IDM) -> tuple[str, ...]:
    """Return the parameters that a mode fits: (v0, T), or all of the model.

    Raises:
        ConfigError: if there is no such mode or model.
    """
    if mode not in MODES:
        raise unknown_name("calibration mode", mode, MODES)
    parameters = law_of(model).parameters
    return parameters[:2] if mode == "local" else parameters


def users(parameter: str) -> list[str]:
    """Return the models that have a parameter."""
    return [model for model, law in LAWS.items() if parameter in law.parameters]


def checked_bounds(bounds: Bounds | None) -> Limits:
    """Fill in default bounds and check the given ones.

    Raises:
        ConfigError: if a parameter is unknown, its bounds are not lower < upper, or no driver has
            such values.
    """
    limits = dict(DEFAULT_BOUNDS)
    for name, pair in (bounds or {}).items():
        if name not in COLUMNS:
            raise unknown_name("driver parameter", name, COLUMNS)
        low, high = PLAUSIBLE[name]
        if len(pair) != 2 or not low <= pair[0] < pair[1] <= high:
            raise ConfigError(
                f"bounds of {name!r} must be {low:g} <= lower < upper <= {high:g}, got {list(pair)}"
            )
        limits[name] = (float(pair[0]), float(pair[1]))
    return limits


def at_bound(values: NDArray[np.float64], bounds: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether parameters lie on their lower or upper bound."""
    low, high = bounds
    margin = BOUND_TOLERANCE * (high - low)
    return (values <= low + margin) | (values >= high - margin)
