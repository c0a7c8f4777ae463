"""What driver models have in common; :mod:`lcc_rl.functional.laws` lists them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from lcc_rl.errors import require_positive
from lcc_rl.functional.kinematics import advance_gap, advance_speed

Each = Tensor | float  # a number per driver, or one for all


class Parameter(NamedTuple):
    """A parameter that a calibration may fit, of one driver model or several.

    column: its name in tables, with the unit; label: its name, symbol and unit in figures; bounds:
    of a calibration, by default; plausible: the range outside which a table is refused, because
    its units differ or its rows are no drivers.
    """

    column: str
    label: str
    bounds: tuple[float, float]
    plausible: tuple[float, float]


_ACCELERATION = (0.05, 20.0)  # plausible [m/s²]
_RATE = (0.001, 20.0)  # plausible [1/s]
# The parameters of all models; your own model adds its own in ``own``.
PARAMETERS: dict[str, Parameter] = {
    "desired_speed": Parameter(
        "desired_speed_mps", "desired speed $v_0$ [m/s]", (5.0, 40.0), (1.0, 70.0)
    ),
    "time_gap": Parameter("time_gap_s", "time gap $T$ [s]", (0.3, 4.0), (0.05, 20.0)),
    "acceleration": Parameter(
        "acceleration_mps2", "acceleration $a$ [m/s²]", (0.3, 4.0), _ACCELERATION
    ),
    "deceleration": Parameter(
        "deceleration_mps2", "deceleration $b$ [m/s²]", (0.3, 5.0), _ACCELERATION
    ),
    "min_gap": Parameter("min_gap_m", "standstill gap $s_0$ [m]", (0.5, 5.0), (0.05, 50.0)),
    "sensitivity": Parameter(  # of ovm and fvdm
        "sensitivity_hz", "sensitivity $\\kappa$ [1/s]", (0.05, 5.0), _RATE
    ),
    "form": Parameter("form", "form $\\beta$", (0.05, 3.0), (0.001, 10.0)),  # of ovm and fvdm
    "speed_gain": Parameter(  # of fvdm
        "speed_gain_hz", "speed gain $\\lambda$ [1/s]", (0.05, 3.0), _RATE
    ),
    "leader_deceleration": Parameter(  # of gipps
        "leader_deceleration_mps2",
        "leader deceleration $\\hat{b}$ [m/s²]",
        (0.3, 5.0),
        _ACCELERATION,
    ),
}
INDIVIDUAL = ("desired_speed", "time_gap")  # parameters that differ by driver in every model


@dataclass(frozen=True, kw_only=True)
class DriverConstants(ABC):
    """A driver model: its law, and its parameters besides v0 and T; a frozen dataclass each.

    Every model has ``min_gap``, the gap s0 at standstill [m].

    Args:
        braking_limit: largest physical deceleration, positive [m/s²].
        acceleration_limit: largest physical acceleration [m/s²].

    Raises:
        ConfigError: if a parameter is not positive.
    """

    min_gap = 2.0  # without annotation: each model places it among its parameters
    own: ClassVar[Mapping[str, Parameter]] = {}  # parameters that no other model has

    braking_limit: float = 8.0
    acceleration_limit: float = 5.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not isinstance(value, Tensor):
                require_positive(f"{type(self).__name__.removesuffix('Constants')}.{name}", value)

    @abstractmethod
    def wish(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return the desired acceleration [m/s²]; arguments as in :meth:`__call__`."""

    @abstractmethod
    def steady_gap(self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor) -> Tensor:
        """Return the gap of :meth:`equilibrium_gap` without its cap [m]."""

    def __call__(
        self, speed: Tensor, gap: Tensor, approach_rate: Tensor, desired_speed: Each, time_gap: Each
    ) -> Tensor:
        """Return the acceleration of the law, held within physical limits.

        Args:
            speed: speed v of the follower [m/s].
            gap: bumper-to-bumper gap s to the vehicle ahead [m].
            approach_rate: Δv = v − v_ahead, positive when closing [m/s].
            desired_speed: v0 [m/s].
            time_gap: T [s].

        Returns:
            Acceleration [m/s²], broadcast over the arguments.
        """
        return self.limited(self.wish(speed, gap, approach_rate, desired_speed, time_gap))

    def equilibrium_gap(
        self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor, cap_time_gap: float = 3.0
    ) -> Tensor:
        """Return the gap at which a driver keeps its speed behind an equally fast leader.

        It may diverge as v approaches v0 and is capped at ``2·s0 + cap_time_gap·v``. The papers
        do not define how a follower starts.

        Args:
            speed: common speed v [m/s].
            desired_speed: v0 [m/s].
            time_gap: T [s].
            cap_time_gap: time gap of the cap [s].

        Returns:
            Gap [m], broadcast over the arguments.
        """
        return self.capped(self.steady_gap(speed, desired_speed, time_gap), speed, cap_time_gap)

    def limited(self, acceleration: Tensor) -> Tensor:
        """Hold an acceleration within what a car can do [m/s²]."""
        return acceleration.clamp(-self.braking_limit, self.acceleration_limit)

    def capped(self, gap: Tensor, speed: Tensor, cap_time_gap: float) -> Tensor:
        """Hold an equilibrium gap below ``2·s0 + cap_time_gap·v`` [m]."""
        return torch.minimum(gap, 2.0 * self.min_gap + cap_time_gap * speed)

    @classmethod
    def table(cls) -> dict[str, Parameter]:
        """Return the parameters that a calibration may fit, v0 and T first."""
        known = {**PARAMETERS, **cls.own}
        names = [*INDIVIDUAL, *(field.name for field in fields(cls))]
        return {name: known[name] for name in names if name in known}

    @classmethod
    def shared(cls) -> tuple[str, ...]:
        """Return the names of the parameters besides v0 and T."""
        return tuple(cls.table())[len(INDIVIDUAL) :]

    def with_(self, **changes: Each) -> Self:
        """Return a copy in which some constants vary by driver (tensors, for calibration)."""
        return replace(self, **changes)  # type: ignore[arg-type]

    def mean(self) -> Self:
        """Return a copy with the mean of each parameter that varies by driver."""
        varying = {name: x for name, x in vars(self).items() if isinstance(x, Tensor)}
        return self.with_(**{name: float(x.mean()) for name, x in varying.items()})


@dataclass(frozen=True)
class Reaction:
    """Reaction delay and noises of a driver model, shared by all drivers of a population.

    Args:
        delay: age of the speed, gap and relative speed that a driver reacts to [s].
        noise: standard deviation of a noise of the acceleration, see :class:`NoiseStep` [m/s²].
        gap_noise: standard deviation of such a noise of the logarithm of the perceived gap.
    """

    delay: float = 0.0
    noise: float = 0.0
    gap_noise: float = 0.0


NOISE_TIME = 0.7  # time constant of the noise of the acceleration [s]
GAP_NOISE_TIME = 2.0  # time constant of the noise of the perceived gap [s]


@dataclass(frozen=True)
class NoiseStep:
    """A step of a smooth noise with the standard deviation 1 at any time step.

    The noise is white noise behind two low-pass filters of one time constant. Its jerk is finite,
    as that of a pedal; an Ornstein–Uhlenbeck process has one low-pass filter only. With
    z ~ N(0, 1), xₖ = 2ρ xₖ₋₁ − ρ² xₖ₋₂ + c z. The correlation ``linked`` of successive values is
    that of continuous filters for short steps: 1 − linked is 9 % larger at 0.1 s, 31 % at 0.5 s.

    Args:
        kept: ρ.
        new: c.
        linked: correlation of successive values.
    """

    kept: float
    new: float
    linked: float

    @classmethod
    def of(cls, time_step: float, time_constant: float = NOISE_TIME) -> Self:
        """Return the coefficients for a time step and a time constant [s]."""
        kept = math.exp(-time_step / time_constant)
        new = math.sqrt((1.0 - kept * kept) ** 3 / (1.0 + kept * kept))
        return cls(kept, new, 2.0 * kept / (1.0 + kept * kept))

    def start(self, drawn: Tensor, further: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first value and its predecessor from two independent draws of N(0, 1)."""
        return drawn, self.linked * drawn + math.sqrt(1.0 - self.linked**2) * further

    def next(self, latest: Tensor, before: Tensor, drawn: Tensor) -> Tensor:
        """Return the value that follows two others."""
        return 2.0 * self.kept * latest - self.kept**2 * before + self.new * drawn


def follow(
    law: DriverConstants,
    leader_speed: Tensor,
    speed: Tensor,
    gap: Tensor,
    own: tuple[Tensor, Tensor],
    time_step: float,
    late: int = 0,
    disturbed: Callable[[int, Tensor], Tensor] | None = None,
    perceived: Callable[[Tensor], Tensor] | None = None,
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Drive a follower behind a leader, step by step (A18).

    Args:
        law: the follower's driver model.
        leader_speed: speed of the leader, ``[time + 1, *batch]`` [m/s].
        speed: initial speed of the follower, ``[*batch]`` [m/s].
        gap: initial gap, ``[*batch]`` [m].
        own: v0 [m/s] and T [s], broadcastable to ``[*batch]``.
        time_step: duration of a step [s].
        late: age in steps of the speed, gap and relative speed that the driver reacts to; in the
            first steps they are those of the start.
        disturbed: returns the executed command from the number of the step and the law's command.
        perceived: returns the gap that the driver sees from the true one, once a step.

    Yields:
        Speed, gap and executed acceleration after each step, ``[*batch]``.
    """
    seen: deque[tuple[Tensor, Tensor, Tensor]] = deque(maxlen=late + 1)
    for step, (ahead, ahead_reached) in enumerate(pairwise(leader_speed)):
        now = (speed, gap, speed - ahead)
        seen.extend([now] * (1 if seen else late + 1))
        own_speed, distance, approach_rate = seen[0]
        if perceived is not None:
            distance = perceived(distance)
        command = law(own_speed, distance, approach_rate, *own)
        if disturbed is not None:
            command = disturbed(step, command)
        reached, executed = advance_speed(speed, command, time_step)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, time_step)
        speed = reached
        yield speed, gap, executed


def simulate_follower(
    leader_speed: Tensor,
    speed: Tensor,
    gap: Tensor,
    desired_speed: Tensor,
    time_gap: Tensor,
    law: DriverConstants,
    time_step: float,
    noise: Callable[[int], Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the motion of :func:`follow` from the start on.

    Args:
        leader_speed, speed, gap, law, time_step: see :func:`follow`.
        desired_speed, time_gap: v0 [m/s] and T [s], broadcastable to ``[*batch]``.
        noise: returns the relative error ξ of the executed acceleration at a step (A18).

    Returns:
        Speeds and gaps of shape ``[time + 1, *batch]`` and accelerations ``[time, *batch]``.
    """

    def strayed(step: int, command: Tensor) -> Tensor:
        return command if noise is None else command * (1.0 + noise(step))

    own = (desired_speed, time_gap)
    motion = follow(law, leader_speed, speed, gap, own, time_step, disturbed=strayed)
    speeds, gaps, accelerations = zip(*motion, strict=True)
    return torch.stack([speed, *speeds]), torch.stack([gap, *gaps]), torch.stack(accelerations)
