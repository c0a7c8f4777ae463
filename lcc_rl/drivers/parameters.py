"""The driver models that a calibration fits, by name, and their parameters (A6)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcc_rl.config.nodes import find_target
from lcc_rl.errors import ConfigError, raised_as, require, require_known
from lcc_rl.functional.driver_models import PARAMETERS, DriverConstants, Parameter
from lcc_rl.functional.guard import check_forgets, check_independent
from lcc_rl.functional.laws import LAWS
from lcc_rl.settings import Number

# Columns of the reaction that the drivers of a table share, with their plausible ranges.
REACTION = {
    "delay": ("reaction_delay_s", 0.0, 3.0),
    "noise": ("acceleration_noise_mps2", 0.0, 3.0),
    "gap_noise": ("gap_noise", 0.0, 1.0),
}
DEFAULT_MODEL = "idm"
MODEL = "model"  # column of a driver's model; without it all drivers are IDM drivers
# Distance from a bound within which a parameter counts as on it, as a share of the range.
BOUND_TOLERANCE = 0.005

OF_PRESENT = (
    "a calibrated law is a function of the present motion; evaluate one with memory as a "
    "DriverModel, see docs/extend.md"
)

Mode = Literal["local", "global"]
BoundPair = tuple[Number, Number]  # lower and upper
DEFAULT_BOUNDS: dict[str, BoundPair] = {name: one.bounds for name, one in PARAMETERS.items()}


def find_law(name: str) -> type[DriverConstants]:
    """Return a driver model.

    Args:
        name: one of :data:`lcc_rl.functional.laws.LAWS`, or the dotted path of your own class,
            ``my_models.Helly``, which is added to them.

    Raises:
        ConfigError: if there is none, it is no driver model, ``own`` names a shipped parameter, or
            it depends on more than the present motion of a driver.
    """
    if name not in LAWS and "." in name:
        found = find_target(name, "model")
        if not (isinstance(found, type) and issubclass(found, DriverConstants)):
            raise ConfigError(f"model: expected a class derived from DriverConstants, got {name!r}")
        for shipped in found.own.keys() & PARAMETERS.keys():
            remedy = f"remove it there; calibration.bounds.{shipped}=[…] sets other bounds"
            raise ConfigError(f"{name}.own names {shipped!r} of shipped models: {remedy}")
        _check_law(found, name)
        LAWS[name] = found
    require_known("model of drivers", name, LAWS)
    return LAWS[name]


def _check_law(kind: type[DriverConstants], name: str) -> None:
    """Refuse a law that remembers, or whose acceleration of a driver depends on other drivers."""
    require(not getattr(kind, "remembers", ()), f"{name} has remembers: {OF_PRESENT}")
    with raised_as(ConfigError, name, Exception):
        law = kind()

        def motion(number: int) -> list[Tensor]:
            found = (10.0 + number, 20.0 + number, 1.0 + number, 30.0, 1.5)
            return [torch.tensor([x, 1.1 * x]) for x in found]

        def play(speed: Tensor, gap: Tensor, rate: Tensor, v0: Tensor, headway: Tensor) -> Any:
            law.equilibrium_gap(speed, v0, headway)
            wish = law.wish(speed, gap, rate, v0, headway)
            require(isinstance(wish, Tensor), "wish must return one tensor, an acceleration")
            return [wish]

        check_forgets([law], lambda n: play(*motion(n)), OF_PRESENT)
        check_independent(kind.__name__, ["acceleration"], play, motion(0))


def parameters_of(models: Iterable[str]) -> dict[str, Parameter]:
    """Return the parameters of one or several models, in the order of the table."""
    found = {name: one for model in models for name, one in LAWS[model].table().items()}
    return {name: found[name] for name in (*PARAMETERS, *found) if name in found}


def fitted(mode: str, model: str = DEFAULT_MODEL) -> tuple[str, ...]:
    """Return the parameters that a mode fits: (v0, T), or all parameters of the model."""
    parameters = tuple(LAWS[model].table())
    return parameters[:2] if mode == "local" else parameters


def users(parameter: str) -> list[str]:
    """Return the models that have a parameter."""
    return [model for model, law in LAWS.items() if parameter in law.table()]


def at_bound(values: NDArray[np.float64], bounds: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether parameters lie on their lower or upper bound."""
    low, high = bounds
    margin = BOUND_TOLERANCE * (high - low)
    return (values <= low + margin) | (values >= high - margin)
