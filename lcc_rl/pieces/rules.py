"""Published rules for smoothing traffic, and the handover from a human driver to a rule."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field, InstanceOf
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.functional.layout import join, total
from lcc_rl.functional.rules import follower_stopper_speed, pi_saturation_speed
from lcc_rl.pieces.base import Entry
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

Window = Annotated[float, Field(gt=0.0, le=3600.0)]
Pair = Annotated[tuple[NonNegative, NonNegative], Field(strict=False)]
Three = Annotated[tuple[Positive, Positive, Positive], Field(strict=False)]
ThreeTimes = Annotated[tuple[NonNegative, NonNegative, NonNegative], Field(strict=False)]


class Averaging(Controller):
    """Base of rules that know the mean of the vehicle's own speed during the last seconds.

    It is kept in ``(role, "speed_history")``, ``[*batch, n, samples]`` [m/s]; before the window
    is full, the mean is that since the episode began.
    """

    window: Window = 60.0  # length of the mean [s]
    max_acceleration: Positive = 1.5  # of the command [m/s²]
    max_deceleration: Positive = 3.0  # of the command [m/s²]

    history = Entry("role.speed_history", "m/s", "own speeds of the last steps, latest first")

    @property
    def averages(self) -> bool:
        """Whether the mean is kept."""
        return True

    def setup(self, world: World) -> None:
        """Read what the rule reads, and the history where it is kept."""
        self.samples = max(world.steps(self.window, "window"), 1) if self.averages else 0
        memory = [self.history.wide(self.samples), *self.remembers] if self.averages else []
        reads = [*self.reads, *["episode.step"] * self.averages]
        self.declare(world, reads, remembers=memory)
        self.limits = (-self.max_deceleration, self.max_acceleration)

    def mean(self, speed: Tensor, step: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean [m/s], ``[*batch, n, 1]``, and the history with the present in it."""
        past = join([speed, history[..., :-1]], -1)
        return total(past, -1) / (step + 1).clamp(max=self.samples), past

    def towards(self, wanted: Tensor, speed: Tensor) -> Tensor:
        """Return the acceleration [m/s²] to a speed."""
        return (wanted - speed) / self.time_step


class FollowerStopper(Averaging):
    """FollowerStopper in its time-headway form (Stern et al. 2018, arXiv 1705.01693).

    Drives at a desired speed unless the vehicle ahead is near; see
    :func:`lcc_rl.functional.rules.follower_stopper_speed`. The command is (v_cmd − v)/T within
    the limits. The desired speed is fixed, or the mean of the vehicle's own speed during the last
    ``window`` seconds, kept in ``(role, "speed_history")``, ``[*batch, n, samples]`` [m/s].
    """

    desired_speed: Positive | None = None  # v_d; None: the vehicle's own mean [m/s]
    gaps: Three = (4.5, 5.25, 6.0)  # Δx⁰_k, gaps at standstill that bound the regions [m]
    time_gaps: ThreeTimes = (0.4, 0.6, 0.8)  # h_k; Δx⁰_k is at least h_k v; 0: original form [s]
    decelerations: Three = (1.5, 1.0, 0.5)  # d_k, see the paper [m/s²]

    reads = ("self.speed", "self.gap", "ahead.speed")

    def validate(self) -> None:
        if list(self.gaps) != sorted(self.gaps):
            raise ValueError(f"gaps must increase, got {list(self.gaps)}")

    @property
    def averages(self) -> bool:
        """Whether the mean is kept, which is of use without a desired speed."""
        return self.desired_speed is None

    def command(self, speed: Tensor, gap: Tensor, ahead: Tensor, *kept: Tensor) -> Any:
        """Return the commands, and the history where it is kept."""
        if self.desired_speed is not None:
            return self._beside(speed, gap, ahead, torch.full_like(speed, self.desired_speed))
        mean, past = self.mean(speed, *kept)
        return self._beside(speed, gap, ahead, mean), past

    def _beside(self, speed: Tensor, gap: Tensor, ahead: Tensor, desired: Tensor) -> Tensor:
        wanted = follower_stopper_speed(
            speed, gap, ahead, desired, self.gaps, self.time_gaps, self.decelerations
        )
        return self.towards(wanted, speed)


class PISaturation(Averaging):
    """PI with saturation (Stern et al. 2018, arXiv 1705.01693).

    Drives at the mean of its own speed, a little faster where the gap is large, and like the
    vehicle ahead where it is small; see :func:`lcc_rl.functional.rules.pi_saturation_speed`. The
    command before is kept in ``(role, "commanded_speed")``, ``[*batch, n, 1]`` [m/s].
    """

    window: Window = 38.0  # length of the mean [s]
    gaps: Pair = (7.0, 30.0)  # between which catching up sets in [m]
    catch_up: NonNegative = 1.0  # by how much the target may exceed the mean [m/s]
    least_gap: NonNegative = 4.0  # gap below which it drives like the vehicle ahead [m]
    closing_time: Positive = 2.0  # how long closing in may take [s]
    transition: Positive = 2.0  # range of gaps over which it changes from one to the other [m]

    reads = ("self.speed", "self.gap", "ahead.speed")
    remembers = (
        Entry("role.commanded_speed", "m/s", "speed that PI with saturation commanded last"),
    )

    def validate(self) -> None:
        if self.gaps[0] >= self.gaps[1]:
            raise ValueError(f"gaps must be two increasing numbers, got {list(self.gaps)}")

    def command(
        self,
        speed: Tensor,
        gap: Tensor,
        ahead: Tensor,
        step: Tensor,
        history: Tensor,
        before: Tensor,
    ) -> Any:
        """Return the commands, the history and the speed commanded."""
        mean, past = self.mean(speed, step, history)
        before = torch.where(step == 0, speed, before)
        shape = (self.gaps, self.catch_up, self.least_gap, self.closing_time, self.transition)
        wanted = pi_saturation_speed(speed, gap, ahead, mean, before, *shape)
        return self.towards(wanted, speed), past, wanted


class Handover(Controller):
    """Lets one controller drive until a moment of the episode, and another one from then on.

    Both compute from the start, so that one which remembers is ready when its turn comes.
    """

    before: InstanceOf[Controller]  # who drives first, a human driver say
    after: InstanceOf[Controller]  # who drives from then on
    from_s: NonNegative  # that moment [s]

    def setup(self, world: World) -> None:
        """Read and write what both do."""
        both = [inner.bind(world, self.name) for inner in (self.before, self.after)]
        self.before, self.after = both
        self.declare(
            world,
            ["episode.step", *(name for inner in both for name in inner.names)],
            [inner.entries[key] for inner in both for key in inner.targets[1:]],
            [inner.entries[key] for inner in both for key in inner.constants],
        )
        self.limits = None  # each has its own
        self.from_step = world.steps(self.from_s, "from_s")

    def command(self, step: Tensor, *entries: Tensor) -> Any:
        """Return the commands of whoever drives, and what both write besides."""
        place = len(self.before.names)
        first = self.before.compute(*entries[:place])
        second = self.after.compute(*entries[place:])
        first, second = (x if isinstance(x, tuple) else (x,) for x in (first, second))
        command = torch.where(step < self.from_step, first[0], second[0])
        return (command, *first[1:], *second[1:])

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        self.before.begin(given, start)
        self.after.begin(given, start)
