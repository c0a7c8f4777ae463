"""Sensors: delayed measurements of the true state with bounded errors."""

from __future__ import annotations

from typing import Annotated, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.functional.layout import join, reverse
from lcc_rl.functional.random import stream_id, uniform
from lcc_rl.functional.sensing import Sensing
from lcc_rl.pieces.base import Entry, RoleTransform
from lcc_rl.pieces.views import Key, Views
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Share

SENSORS = "sensors"
# Measured entries, the columns of a frame of the memory.
TRUE_STATE = ("self.gap", "self.speed", "ahead.speed", "ahead.acceleration", "self.acceleration")
AGES = 2  # numbers of the memory before its frames: ages of the target and of the own speed


class Sensors(RoleTransform):
    """Measures gap and speeds for a role, with delay, bounded errors and drop-outs.

    Controllers, safety filter, observation and memory of the role read the measurements instead of
    ``self.gap``, ``self.speed``, ``self.relative_speed``, ``ahead.speed`` and
    ``ahead.acceleration``, and their age as ``self.target_age``. Limits, rewards and energy use the
    true state. The own acceleration, vehicles behind and messages are exact. Errors are drawn
    uniformly within their bounds by the episode's seed, for each measurement or every
    ``error_time`` with linear interpolation.

    A drop-out keeps all of a measurement, a lost target gap, speed and acceleration ahead: the own
    speed is measured at the wheels. The memory holds the ages of the target's measurement and of
    the own speed's in steps, then the entries of :data:`TRUE_STATE` at present and in the steps
    before. Speeds before the episode are those of its start.
    """

    gap_error: NonNegative = 0.0  # largest error of the gap [m]
    speed_error: NonNegative = 0.0  # largest error of the own speed [m/s]
    ahead_error: NonNegative = 0.0  # largest error of the speed of the vehicle ahead [m/s]
    # Largest relative error of both speeds; each has one factor for a whole episode.
    scale_error: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    error_time: NonNegative = 0.0  # interval of drawn errors, multiple of a step; 0: a step [s]
    delay: NonNegative = 0.0  # age of an arriving measurement, multiple of a step [s]
    dropouts: Share = 0.0  # probability that a measurement is missing; the last one is kept
    longest_dropout: NonNegative = 0.0  # longest drop-out, multiple of a step [s]
    # Time of the last measurement before the target is lost; None: never [s].
    lost_from: NonNegative | None = None
    lost_for: NonNegative = 0.0  # duration of this loss, multiple of a step [s]

    measured = (
        Entry("role.sensed_gap", "m", "gap as measured"),
        Entry("role.sensed_speed", "m/s", "own speed as measured"),
        Entry("role.sensed_relative_speed", "m/s", "speed ahead minus own speed, as measured"),
        Entry("role.sensed_ahead_speed", "m/s", "speed of the vehicle ahead as measured"),
        Entry("role.sensed_ahead_acceleration", "m/s²", "acceleration ahead as measured"),
        Entry("role.target_age", "s", "age of the measurement of gap and vehicle ahead"),
    )
    kept = Entry(
        "role.sensors", "–", "ages of target and own speed [steps], true states to measure"
    )
    index: ClassVar[Tensor]

    def validate(self) -> None:
        for name, given, duration in (
            ("dropouts", self.dropouts > 0.0, "longest_dropout"),
            ("lost_from", self.lost_from is not None, "lost_for"),
        ):
            if given != (getattr(self, duration) > 0.0):
                raise ValueError(f"{name} and {duration} belong together: give both or none")

    def setup(self, world: World) -> None:
        role, self.time_step = self.name, world.time_step
        self.sensing = self.sensing_in(world, role)
        where, end = f"scenario.sensors.{role}.lost_from", world.horizon * world.time_step
        require(
            (self.lost_from or 0.0) < end,
            f"{where}={self.lost_from} must lie within the episode of {end:g} s "
            f"(scenario.horizon); {where}=2 sets another time",
        )
        self.first_lost = world.steps(self.lost_from or 0.0, where)
        self.apart = max(1, world.steps(self.error_time, f"scenario.sensors.{role}.error_time"))
        drawn = ["episode.seed", "next.episode.step"]
        reads = [f"{role}.{SENSORS}", *(f"next.{name}" for name in TRUE_STATE), *drawn]
        width = AGES + len(TRUE_STATE) * (self.sensing.oldest + 1)
        self.declare(world, reads, [*self.measured, self.kept.wide(width)])
        # The same entries at reset, which has no previous step.
        self.first = Views(world.string, role, [*TRUE_STATE, "episode.seed", "episode.step"])
        self.streams = [stream_id(f"{role}.sensors.{name}") for name in ("gap", "speed", "ahead")]
        self.scales = [stream_id(f"{role}.sensors.{name}_scale") for name in ("speed", "ahead")]
        self.missing = stream_id(f"{role}.sensors.missing")
        self.register_buffer("index", torch.arange(*self.rows).unsqueeze(-1))

    def sensing_in(self, world: World, role: str) -> Sensing:
        """Return the bounds of the role's measurements.

        Raises:
            ConfigError: if a duration is no multiple of the time step, or too long.
        """
        late, self.longest, self.lost = (
            world.late(getattr(self, name), f"scenario.sensors.{role}.{name}")
            for name in ("delay", "longest_dropout", "lost_for")
        )
        errors = (self.gap_error, self.speed_error, self.ahead_error, self.scale_error)
        # A loss may follow a drop-out, and end within another one.
        longest = self.lost + (2 if self.lost else 1) * self.longest
        return Sensing(*errors, late, longest)

    def compute(self, memory: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
        *now, seed, step = inputs
        frames = join([*now, memory[..., AGES : -len(TRUE_STATE)]], -1)
        ages, missing = memory[..., :AGES], uniform(seed, step, self.missing + self.index)
        # The own speed's age counts the steps of a drop-out, the target's those of a loss, too.
        kept = (missing < self.dropouts) & (ages[..., 1:] < self.sensing.late + self.longest)
        lost = torch.zeros_like(kept)
        if self.lost_from is not None:
            lost = ((step > self.first_lost) & (step <= self.first_lost + self.lost)) | lost
        kept = join([kept | lost, kept], -1)
        ages = torch.where(kept, ages + 1.0, float(self.sensing.late))
        return self._measured(frames, ages, seed, step)

    @property
    def event(self) -> list[Key]:  # type: ignore[override]
        """The age of the target, if it is lost at a time."""
        return [(self.role, "target_age")] * (self.lost_from is not None)

    def happened(self, age: Tensor) -> Tensor:
        """Return the steps without a new measurement of the target, ``[*batch, 1]``."""
        return (age > self.time_step * (self.sensing.late + 0.5)).any(-2)

    def _measured(
        self, frames: Tensor, ages: Tensor, seed: Tensor, step: Tensor
    ) -> tuple[Tensor, ...]:
        """Return the measurements from frames, latest first, and the memory."""
        target, own_age = ages.long().split(1, -1)
        of_column = join([target, own_age, *[target] * (len(TRUE_STATE) - 2)], -1)
        columns = len(TRUE_STATE) * of_column + torch.arange(len(TRUE_STATE), device=frames.device)
        chosen = reverse(reverse(frames).gather(0, reverse(columns)))
        gap, speed, ahead, acceleration, _ = chosen.split(1, -1)
        bounds = (self.sensing.gap, self.sensing.speed, self.sensing.ahead)
        gap_error, speed_error, ahead_error = (
            bound * self._error(seed, step - age, stream)
            for bound, age, stream in zip(
                bounds, (target, own_age, target), self.streams, strict=True
            )
        )
        own, other = (
            1.0 + self.sensing.scale * (2.0 * uniform(seed, 0, stream + self.index) - 1.0)
            for stream in self.scales
        )
        speed = (own * speed + speed_error).clamp(min=0.0)
        ahead = (other * ahead + ahead_error).clamp(min=0.0)
        measured = gap + gap_error, speed, ahead - speed, ahead, acceleration
        return *measured, self.time_step * ages[..., :1], join([ages, frames], -1)

    def _error(self, seed: Tensor, step: Tensor, stream: int) -> Tensor:
        """Return the error of a step's measurements as a share of its bound, in [−1, 1]."""
        phase = step / self.apart
        first = phase.floor()
        start, end = (uniform(seed, first.long() + k, stream + self.index) for k in (0, 1))
        return 2.0 * torch.lerp(start, end, phase - first) - 1.0

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        *now, seed, step = self.first.of(start)
        gap, speed, ahead, *_ = now
        closing = self.time_step * (speed - ahead)
        frames = [
            join([gap + number * closing, *now[1:]], -1)
            for number in range(self.sensing.oldest + 1)
        ]
        age = torch.full_like(closing, self.sensing.late)
        values = self._measured(join(frames, -1), join([age] * AGES, -1), seed, step)
        for key, value in zip(self.targets, values, strict=True):
            start.set(key, value)


def frames_of(memory: Tensor, name: str) -> Tensor:
    """Return one of :data:`TRUE_STATE` in all frames, latest first, ``[*batch, n, frames]``."""
    return memory[..., AGES + TRUE_STATE.index(name) :: len(TRUE_STATE)]
