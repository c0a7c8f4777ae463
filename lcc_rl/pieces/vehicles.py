"""The vehicles: the controlled car and the human followers, each moved by its own law."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.functional.idm import IDMConstants, equilibrium_gap, idm_acceleration
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.random import choose, stream_id, uniform
from lcc_rl.pieces.base import SEED, STEP, Transition, following

MOTION = ("speed", "gap", "relative_speed", "acceleration", "jerk")


class Population(Protocol):
    """What the pieces need to know of a driver population."""

    desired_speed: Tensor
    time_gap: Tensor
    constants: IDMConstants


def motion_keys(name: str) -> list[tuple[str, str]]:
    """Return the keys that every moving vehicle writes."""
    return [(name, entry) for entry in MOTION]


class CAVMotion(Transition):
    """The controlled car: its action, in [−1, 1], times the largest acceleration (A18).

    Writes speed [m/s], gap [m], relative speed v_ahead − v [m/s], executed acceleration [m/s²]
    and jerk [m/s³] under ``name``, shape ``[*batch, 1]``.

    Args:
        time_step: duration of a step [s].
        max_acceleration: acceleration of action 1; braking of action −1 [m/s²].
        standstill_gap: gap at the start when standing [m].
        initial_time_gap: further time gap at the start [s]; the paper is silent on it.
        initial_gap_range: the gap at the start is that times a factor drawn evenly from this
            range by the episode's seed, so that training meets what good driving never does;
            ``(name, "gap_factor")`` given to ``env.reset`` replaces the draw (evaluation gives 1).
        obeys: the entry that is its action, dotted; ``"next.barrier.action"`` where a
            :class:`lcc_rl.pieces.Barrier` acts before it.
        name: namespace of the car.
        predecessor: namespace of the vehicle ahead.

    Raises:
        ConfigError: if ``max_acceleration``, ``standstill_gap`` or the range is not positive, or
            the time gap negative.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        standstill_gap: float = 2.0,
        initial_time_gap: float = 1.5,
        initial_gap_range: Sequence[float] = (1.0, 1.0),
        obeys: str = "action",
        name: str = "cav",
        predecessor: str = "leader",
    ) -> None:
        require_positive(name, max_acceleration=max_acceleration, standstill_gap=standstill_gap)
        if initial_time_gap < 0:
            raise ConfigError(f"{name}.initial_time_gap must not be negative: {initial_time_gap}")
        if len(initial_gap_range) != 2 or not 0 < initial_gap_range[0] <= initial_gap_range[1]:
            raise ConfigError(
                f"{name}.initial_gap_range must be two increasing positive factors, got "
                f"{list(initial_gap_range)}"
            )
        factor = [(name, "gap_factor")]
        super().__init__(
            reads=[
                (name, "speed"),
                (name, "gap"),
                (name, "acceleration"),
                obeys,
                (predecessor, "speed"),
                following((predecessor, "speed")),
            ],
            writes=motion_keys(name),
            constants=factor,
            choices=factor,
        )
        self.lowest, self.highest = map(float, initial_gap_range)
        self.factor_stream = stream_id(f"{name}.gap_factor")
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.standstill_gap, self.initial_time_gap = standstill_gap, initial_time_gap
        self.name, self.predecessor = name, predecessor

    def compute(
        self,
        speed: Tensor,
        gap: Tensor,
        last_acceleration: Tensor,
        action: Tensor,
        ahead: Tensor,
        ahead_reached: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the entries of :data:`MOTION` at the moment reached."""
        command = action * self.max_acceleration
        reached, executed = advance_speed(speed, command, self.time_step)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, self.time_step)
        jerk = (executed - last_acceleration) / self.time_step
        return reached, gap, ahead_reached - reached, executed, jerk

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        speed = start.get((self.predecessor, "speed"))
        still = torch.zeros_like(speed)
        factor = given.get(self.choices[0], None)
        if factor is None:
            draw = uniform(start.get(SEED), 0, self.factor_stream)
            factor = self.lowest + (self.highest - self.lowest) * draw
        gap = factor * (self.standstill_gap + self.initial_time_gap * speed)
        values = (factor, speed, gap, still, still, still)
        for key, value in zip([*self.constants, *motion_keys(self.name)], values, strict=True):
            start.set(key, value)


class IDMFollower(Transition):
    """A string of human drivers by the Intelligent Driver Model (A3–A4), each with its own (v0, T).

    Every follower draws a driver of the population by the episode's seed, unless ``(name,
    "driver")`` is given to ``env.reset``. Its executed acceleration is a2·(1 + ξ),
    ξ ~ U(0, ``noise``), drawn anew each step (A18).

    Writes the same entries as :class:`CAVMotion`, shape ``[*batch, followers, 1]``.

    Args:
        population: the drivers.
        time_step: duration of a step [s].
        followers: human drivers one behind another.
        noise: largest relative error ξ of the executed acceleration.
        cap_time_gap: bounds the initial equilibrium gap, see
            :func:`lcc_rl.functional.idm.equilibrium_gap` [s].
        name: namespace of the followers.
        predecessor: namespace of the vehicle ahead of the first of them.

    Raises:
        ConfigError: if ``followers`` or ``noise`` is out of range, or the drivers differ in more
            than (v0, T).
    """

    desired_speeds: Tensor
    time_gaps: Tensor
    index: Tensor

    def __init__(
        self,
        population: Population,
        time_step: float,
        followers: int = 1,
        noise: float = 0.05,
        cap_time_gap: float = 3.0,
        name: str = "hdv",
        predecessor: str = "cav",
    ) -> None:
        if followers < 1:
            raise ConfigError(f"{name}.followers must be at least 1, got {followers}")
        if any(isinstance(value, Tensor) for value in vars(population.constants).values()):
            raise ConfigError(
                f"{name}: drivers must share a, b and s0 (a locally calibrated population, "
                "drivers.mode=local), got a population in which they differ by driver"
            )
        if not 0.0 <= noise < 1.0:
            raise ConfigError(f"{name}.noise must lie in [0, 1), got {noise}")
        constants = [(name, "driver"), (name, "desired_speed"), (name, "desired_time_gap")]
        super().__init__(
            reads=[
                (name, "speed"),
                (name, "gap"),
                (name, "relative_speed"),
                (name, "acceleration"),
                *constants[1:],
                (predecessor, "speed"),
                following((predecessor, "speed")),
                SEED,
                STEP,
            ],
            writes=motion_keys(name),
            constants=constants,
            choices=constants[:1],
            event_shape=(followers, 1),
        )
        self.time_step, self.noise, self.cap_time_gap = time_step, noise, cap_time_gap
        self.name, self.predecessor, self.drivers = name, predecessor, population.constants
        self.noise_stream = stream_id(f"{name}.noise")
        self.driver_stream = stream_id(f"{name}.driver")
        self.register_buffer("desired_speeds", population.desired_speed)
        self.register_buffer("time_gaps", population.time_gap)
        self.register_buffer("index", torch.arange(followers).unsqueeze(-1))

    def compute(
        self,
        speed: Tensor,
        gap: Tensor,
        relative_speed: Tensor,
        last_acceleration: Tensor,
        desired_speed: Tensor,
        time_gap: Tensor,
        predecessor: Tensor,
        predecessor_reached: Tensor,
        seed: Tensor,
        step: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the entries of :data:`MOTION` at the moment reached."""
        command = idm_acceleration(
            speed, gap, -relative_speed, desired_speed, time_gap, self.drivers
        )
        if self.noise:
            draw = uniform(seed.unsqueeze(-2), step.unsqueeze(-2), self.noise_stream + self.index)
            command = command * (1.0 + self.noise * draw)
        reached, executed = advance_speed(speed, command, self.time_step)
        ahead, ahead_reached = _string(predecessor, speed), _string(predecessor_reached, reached)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, self.time_step)
        jerk = (executed - last_acceleration) / self.time_step
        return reached, gap, ahead_reached - reached, executed, jerk

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        specs = super().constant_specs(batch, device)
        shape = (*batch, *self.event_shape)
        specs[self.constants[0]] = Unbounded(shape=shape, dtype=torch.int64, device=device)
        return specs

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        driver = given.get(self.choices[0], None)
        count = len(self.desired_speeds)
        if driver is None:
            stream = self.driver_stream + self.index
            driver = choose(start.get(SEED).unsqueeze(-2), count, stream)
        elif bool(((driver < 0) | (driver >= count)).any()):
            raise ConfigError(f"driver ids must lie in 0…{count - 1}, got {driver}")
        desired_speed, time_gap = self.desired_speeds[driver], self.time_gaps[driver]
        speed = start.get((self.predecessor, "speed")).unsqueeze(-2).expand_as(time_gap).clone()
        gap = equilibrium_gap(speed, desired_speed, time_gap, self.drivers, self.cap_time_gap)
        still = torch.zeros_like(speed)
        values = (driver, desired_speed, time_gap, speed, gap, still, still, still)
        for key, value in zip([*self.constants, *motion_keys(self.name)], values, strict=True):
            start.set(key, value)


def _string(predecessor: Tensor, speed: Tensor) -> Tensor:
    """Speeds of the vehicles ahead of each follower of a string, ``[*batch, followers, 1]``."""
    first = predecessor.unsqueeze(-2)
    if speed.shape[-2] == 1:
        return first
    return torch.cat([first, speed[..., :-1, :]], dim=-2)
