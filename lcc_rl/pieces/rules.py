"""Published rules for smoothing traffic, and the handover from a human driver to a rule."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field, InstanceOf
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.functional.driver_models import Each
from lcc_rl.functional.layout import join, total
from lcc_rl.pieces.base import Entry
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive, defaults

Window = Annotated[float, Field(gt=0.0, le=3600.0)]
Pair = tuple[NonNegative, NonNegative]
Three = tuple[Positive, Positive, Positive]
ThreeTimes = tuple[NonNegative, NonNegative, NonNegative]


class Averaging(Controller):
    """Base of rules that use the mean of the vehicle's own speed during the last seconds.

    The speeds are kept in ``(role, "speed_history")``, ``[*batch, n, samples]`` [m/s]. Until the
    window is full, the mean is that since the start of the episode.
    """

    window: Window = 60.0  # length of the mean [s]
    max_acceleration: Positive = 1.5  # of the command [m/s²]
    max_deceleration: Positive | None = None  # None: the limit of the vehicles [m/s²]

    history = Entry("role.speed_history", "m/s", "own speeds of the last steps, latest first")

    @property
    def averages(self) -> bool:
        """Whether the speeds are kept."""
        return True

    def setup(self, world: World) -> None:
        """Read the entries of the rule, and the history if it is kept."""
        self.samples = max(world.steps(self.window, "window"), 1) if self.averages else 0
        memory = [self.history.wide(self.samples), *self.remembers] if self.averages else []
        reads = [*self.reads, *["episode.step"] * self.averages]
        self.declare(world, reads, remembers=memory)

    def mean(self, speed: Tensor, step: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean [m/s], ``[*batch, n, 1]``, and the history with the present speed."""
        past = join([speed, history[..., :-1]], -1)
        return total(past, -1) / (step + 1).clamp(max=self.samples), past

    def towards(self, target: Tensor, speed: Tensor) -> Tensor:
        """Return the acceleration [m/s²] to a speed."""
        return (target - speed) / self.time_step


class FollowerStopper(Averaging):
    """FollowerStopper in its time-headway form (Stern et al. 2018, arXiv 1705.01693).

    Three gaps Δx_k = max(Δx⁰_k, h_k v) + Δv₋²/(2 d_k), Δv₋ = min(v_ahead − v, 0), bound regions of
    the gap. v_cmd is 0 below Δx₁, rises to min(max(v_ahead, 0), v_d) at Δx₂ and to v_d at Δx₃.
    The command is (v_cmd − v)/T within the limits. The desired speed v_d is fixed, or the mean of
    the vehicle's own speed during the last ``window`` seconds, kept in ``(role,
    "speed_history")``, ``[*batch, n, samples]`` [m/s].
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
        """Whether the speeds are kept: if there is no desired speed."""
        return self.desired_speed is None

    def command(self, speed: Tensor, gap: Tensor, ahead: Tensor, *history: Tensor) -> Any:
        """Return the commands, and the history if it is kept."""
        if self.desired_speed is not None:
            desired = torch.full_like(speed, self.desired_speed)
            return self.towards(self.wanted(speed, gap, ahead, desired), speed)
        mean, past = self.mean(speed, *history)
        return self.towards(self.wanted(speed, gap, ahead, mean), speed), past

    def wanted(self, speed: Tensor, gap: Tensor, ahead: Tensor, desired: Tensor) -> Tensor:
        """Return v_cmd [m/s] for the desired speed v_d [m/s]."""
        closing = (ahead - speed).clamp(max=0.0).square()
        near, middle, far = (
            (time_gap * speed).clamp(min=least) + closing / (2.0 * deceleration)
            for least, time_gap, deceleration in zip(
                self.gaps, self.time_gaps, self.decelerations, strict=True
            )
        )
        safe = torch.minimum(ahead.clamp(min=0.0), desired)
        rising = safe * (gap - near) / (middle - near)
        freeing = safe + (desired - safe) * (gap - middle) / (far - middle)
        commanded = torch.where(gap >= far, desired, freeing)  # NaN if the gap is NaN
        commanded = torch.where(gap < middle, rising, commanded)
        return torch.where(gap < near, torch.zeros_like(commanded), commanded)


class PISaturation(Averaging):
    """PI with saturation (Stern et al. 2018, arXiv 1705.01693).

    The vehicle drives at the mean v_d of its own speed, faster if the gap is large, and at the
    speed ahead if it is small: v_target = v_d + c·min(max((Δx − g_l)/(g_u − g_l), 0), 1);
    Δx_s = max(2 s·(v − v_ahead), 4 m); α = min(max((Δx − Δx_s)/γ, 0), 1), β = 1 − α/2. The speed
    command is β(α v_target + (1 − α) v_ahead) + (1 − β) times the last one, which is kept in
    ``(role, "commanded_speed")``, ``[*batch, n, 1]`` [m/s].
    """

    window: Window = 38.0  # length of the mean [s]
    gaps: Pair = (7.0, 30.0)  # g_l and g_u, between which the target rises [m]
    catch_up: NonNegative = 1.0  # c, by how much the target may exceed the mean [m/s]
    least_gap: NonNegative = 4.0  # least Δx_s; at Δx_s the target is the speed ahead [m]
    closing_time: Positive = 2.0  # factor of the closing speed in Δx_s [s]
    transition: Positive = 2.0  # γ, range of gaps over which the target changes [m]

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
        wanted = self.wanted(speed, gap, ahead, mean, before)
        return self.towards(wanted, speed), past, wanted

    def wanted(
        self, speed: Tensor, gap: Tensor, ahead: Tensor, mean: Tensor, before: Tensor
    ) -> Tensor:
        """Return the speed commanded [m/s] after the one before [m/s]."""
        lower, upper = self.gaps
        target = mean + self.catch_up * ((gap - lower) / (upper - lower)).clamp(0.0, 1.0)
        safe = (self.closing_time * (speed - ahead)).clamp(min=self.least_gap)
        share = ((gap - safe) / self.transition).clamp(0.0, 1.0)
        weight = 1.0 - 0.5 * share
        return weight * (share * target + (1.0 - share) * ahead) + (1.0 - weight) * before


class Calm(Averaging):
    """Rule that ends waves of drivers with a reaction time, on rings of 22 cars up to 0.5 s.

    The vehicle drives at the mean v_d of its own speed, faster where the gap Δx is long:
    v_cmd = min(v_d + k·max(Δx − g, 0), (Δx − s − Δv₋²/(2d))/T) with Δv₋ = min(v_ahead − v, 0), at
    least 0. The mean lets the gap take up the wave; the first gain closes what is left of it
    slowly, and the bound keeps the time gap T after the closing speed is braked by d. The command
    is (v_cmd − v)/τ within the limits, because the bound may fall at −Δv₋/T, that is by 10 m/s².
    """

    window: Window = 15.0  # length of the mean [s]
    gain: NonNegative = 0.015  # k, of gaps above ``gap`` [1/s]
    gap: NonNegative = 9.5  # g [m]
    standstill_gap: NonNegative = 2.0  # s [m]
    time_gap: Positive = 1.0  # T, which the speed does not fall below [s]
    braking: Positive = 1.5  # d, deceleration behind a slower vehicle [m/s²]
    response: Positive = 0.7  # τ [s]

    reads = ("self.speed", "self.gap", "self.relative_speed")
    # A learned policy reads the mean from a memory of the own speed.
    observed = (*((name,) for name in reads), ("memory.entries", "self.speed"))

    @classmethod
    def constants_of_rule(cls) -> dict[str, float]:
        """Return the constants of the law with their defaults."""
        names = ("gain", "gap", "standstill_gap", "time_gap", "braking", "response")
        return {name: defaults(cls)[name] for name in names}

    @staticmethod
    def law(speed: Tensor, gap: Tensor, relative: Tensor, lag: Tensor, *constants: Each) -> Tensor:
        """Return the command [m/s²] for a mean of the own speed that is ``lag`` above it [m/s]."""
        gain, longest, standstill_gap, time_gap, braking, response = constants
        wanted = lag + gain * (gap - longest).clamp(min=0.0)
        free = gap - standstill_gap - relative.clamp(max=0.0).square() / (2.0 * braking)
        return torch.maximum(torch.minimum(wanted, free / time_gap - speed), -speed) / response

    def command(
        self, speed: Tensor, gap: Tensor, relative: Tensor, step: Tensor, history: Tensor
    ) -> Any:
        """Return the commands and the history."""
        mean, past = self.mean(speed, step, history)
        constants = (getattr(self, name) for name in self.constants_of_rule())
        return self.law(speed, gap, relative, mean - speed, *constants), past


class Handover(Controller):
    """Executes one controller until a time of the episode, and another one from then on.

    Both compute from the start, so the memory of the second one is up to date at the handover.
    """

    before: InstanceOf[Controller]  # drives first, for example a human driver
    after: InstanceOf[Controller]  # drives from then on
    from_s: NonNegative  # time of the handover [s]

    def setup(self, world: World) -> None:
        both = [inner.bind(world, self.name) for inner in (self.before, self.after)]
        self.before, self.after = both
        self.declare(
            world,
            ["episode.step", *(name for inner in both for name in inner.names)],
            [inner.entries[key] for inner in both for key in inner.targets[1:]],
            [inner.entries[key] for inner in both for key in inner.constants],
        )
        self.limits = None  # each has its own limits
        self.from_step = world.steps(self.from_s, "from_s")

    def command(self, step: Tensor, *entries: Tensor) -> Any:
        """Return the commands of the active controller and the further entries of both."""
        count = len(self.before.names)
        first = self.before.compute(*entries[:count])
        second = self.after.compute(*entries[count:])
        first, second = (x if isinstance(x, tuple) else (x,) for x in (first, second))
        command = torch.where(step < self.from_step, first[0], second[0])
        return (command, *first[1:], *second[1:])

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        self.before.begin(given, start)
        self.after.begin(given, start)
