"""Names, table columns and bounds of the parameters that a calibration fits (A6)."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.errors import ConfigError
from lcc_rl.functional.laws import LAWS
from lcc_rl.settings import Number, Settings, values

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
# What the drivers of a table share where they react late or stray from their model: its column and
# its plausible range.
REACTION = {
    "delay": ("reaction_delay_s", 0.0, 3.0),
    "noise": ("acceleration_noise_mps2", 0.0, 3.0),
}
IDM = "idm"
MODEL = "model"  # the column that names a driver's model; a table without it is of the IDM
# A parameter this close to a bound, as a share of the range, counts as being on it.
BOUND_TOLERANCE = 0.005

Model = Literal["idm", "ovm", "fvdm", "gipps"]
Mode = Literal["local", "global"]
Limits = Annotated[tuple[Number, Number], Field(strict=False)]  # lower and upper


class Bounds(Settings):
    """Lower and upper bound of every parameter that a calibration may fit."""

    desired_speed: Limits = (5.0, 40.0)  # v0 [m/s]
    time_gap: Limits = (0.3, 4.0)  # T [s]
    acceleration: Limits = (0.3, 4.0)  # a [m/s²]
    deceleration: Limits = (0.3, 5.0)  # b [m/s²]
    min_gap: Limits = (0.5, 5.0)  # s0 [m]
    sensitivity: Limits = (0.05, 5.0)  # κ of ovm and fvdm [1/s]
    form: Limits = (0.05, 3.0)  # β of ovm and fvdm
    speed_gain: Limits = (0.05, 3.0)  # λ of fvdm [1/s]
    leader_deceleration: Limits = (0.3, 5.0)  # b̂ of gipps [m/s²]

    def validate(self) -> None:
        for name, (lower, upper) in values(self).items():
            low, high = PLAUSIBLE[name]
            if not low <= lower < upper <= high:
                raise ConfigError(
                    f"bounds of {name!r} must be {low:g} <= lower < upper <= {high:g}, "
                    f"got [{lower:g}, {upper:g}]"
                )


DEFAULT_BOUNDS = values(Bounds())


def fitted(mode: str, model: str = IDM) -> tuple[str, ...]:
    """Return the parameters that a mode fits: (v0, T), or all of the model."""
    parameters = LAWS[model].parameters
    return parameters[:2] if mode == "local" else parameters


def users(parameter: str) -> list[str]:
    """Return the models that have a parameter."""
    return [model for model, law in LAWS.items() if parameter in law.parameters]


def at_bound(values: NDArray[np.float64], bounds: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether parameters lie on their lower or upper bound."""
    low, high = bounds
    margin = BOUND_TOLERANCE * (high - low)
    return (values <= low + margin) | (values >= high - margin)
