"""What driver models have in common; :mod:`lcc_rl.functional.laws` lists them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from lcc_rl.errors import require_positive


class DriverConstants:
    """Base of the parameters of a driver model besides v0 and T: a frozen dataclass each.

    Every model has ``min_gap``, the gap at standstill [m], and the physical limits
    ``braking_limit`` and ``acceleration_limit`` [m/s²].

    Raises:
        ConfigError: if a parameter is not positive.
    """

    min_gap: float
    braking_limit: float
    acceleration_limit: float

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, Tensor):
                require_positive(f"{type(self).__name__.removesuffix('Constants')}.{name}", value)

    def with_(self, **changes: Tensor | float) -> Self:
        """Return a copy in which some constants vary by driver (tensors, for calibration)."""
        return replace(self, **changes)  # type: ignore[type-var]

    def shared(self) -> Self:
        """Return a copy with the mean in place of what varies by driver."""
        varying = {name: x for name, x in vars(self).items() if isinstance(x, Tensor)}
        return self.with_(**{name: float(x.mean()) for name, x in varying.items()})


@dataclass(frozen=True)
class Reaction:
    """How drivers lag behind their model and stray from it; all drivers of a population share it.

    Args:
        delay: age of the speed, gap and relative speed that a driver reacts to [s].
        noise: standard deviation of a noise of the acceleration, see :class:`NoiseStep` [m/s²].
    """

    delay: float = 0.0
    noise: float = 0.0


NOISE_TIME = 0.7  # time constant of the noise of the acceleration [s]


@dataclass(frozen=True)
class NoiseStep:
    """A step of the noise of the acceleration, exact for any time step.

    The noise is white noise behind two low-passes of the time constant :data:`NOISE_TIME`, so that
    it has a finite jerk, as a pedal has; an Ornstein–Uhlenbeck process has one low-pass only. With
    z ~ N(0, 1), xₖ = 2ρ xₖ₋₁ − ρ² xₖ₋₂ + c z has the standard deviation 1; neighbours have the
    correlation ``linked``.

    Args:
        kept: ρ.
        new: c.
        linked: correlation of neighbouring values.
    """

    kept: float
    new: float
    linked: float

    @classmethod
    def of(cls, time_step: float) -> Self:
        """Return the step of a time step [s]."""
        kept = math.exp(-time_step / NOISE_TIME)
        new = math.sqrt((1.0 - kept * kept) ** 3 / (1.0 + kept * kept))
        return cls(kept, new, 2.0 * kept / (1.0 + kept * kept))

    def start(self, drawn: Tensor, further: Tensor) -> tuple[Tensor, Tensor]:
        """Return a first value and the one before it, from two independent draws of N(0, 1)."""
        return drawn, self.linked * drawn + math.sqrt(1.0 - self.linked**2) * further

    def next(self, latest: Tensor, before: Tensor, drawn: Tensor) -> Tensor:
        """Return the value after two others."""
        return 2.0 * self.kept * latest - self.kept**2 * before + self.new * drawn


def limit(acceleration: Tensor, constants: DriverConstants) -> Tensor:
    """Hold an acceleration within what a car can do [m/s²]."""
    return acceleration.clamp(-constants.braking_limit, constants.acceleration_limit)


def capped(gap: Tensor, speed: Tensor, constants: DriverConstants, cap_time_gap: float) -> Tensor:
    """Hold an equilibrium gap, which diverges near v0, below ``2·s0 + cap_time_gap·v`` [m]."""
    return torch.minimum(gap, 2.0 * constants.min_gap + cap_time_gap * speed)


@dataclass(frozen=True)
class DriverLaw:
    """A driver model: how it accelerates, and which parameters it has.

    Args:
        acceleration: of (speed [m/s], gap [m], approach rate v − v_ahead [m/s], v0 [m/s], T [s],
            constants), all broadcast [m/s²].
        equilibrium_gap: gap at which it follows steadily, of (speed, v0, T, constants,
            cap_time_gap) [m].
        constants: class of its constants.
        parameters: names of the parameters that a calibration may fit, v0 and T first.
    """

    acceleration: Callable[..., Tensor]
    equilibrium_gap: Callable[..., Tensor]
    constants: type[DriverConstants]
    parameters: tuple[str, ...]

    @property
    def shared(self) -> tuple[str, ...]:
        """The parameters besides v0 and T."""
        return self.parameters[2:]
