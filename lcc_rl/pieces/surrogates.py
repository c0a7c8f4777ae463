"""Smooth surrogates of reward terms with thresholds, which have a gradient; for training only.

The literal terms lack a useful slope: an indicator has none, and a penalty that begins at a
threshold has none before it. Each surrogate has its own ``threshold``, on the safe side of the
term's, and a ``width`` over which it bends. ``missed`` marks the steps that violate the limit.
"""

from __future__ import annotations

import math
from typing import ClassVar, Literal

from torch import Tensor
from torch.nn.functional import softplus

from lcc_rl.pieces.features import CLASS, GRADE
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive


def excess(value: Tensor, width: float) -> Tensor:
    """Return a smooth max(0, value): quadratic up to about ``width``, then linear; same shape.

    It is exactly zero below zero. A smooth tail would add a small cost to every step, which sums
    to more than the cost of real violations.
    """
    above = value.clamp(min=0.0)
    return width * ((1.0 + (above / width).square()).sqrt() - 1.0)


class SmoothSafety(RewardTerm):
    """−max(0, log(threshold / TTC)), smooth in gap and approach rate (surrogate of A10–A11).

    Unlike the literal term it has a slope towards safety beyond the threshold, at contact and at
    negative gaps.
    """

    weight: NonNegative = 0.5  # price of log(threshold / TTC)
    threshold: Positive = 4.2  # time-to-collision above which the term is 0; 4 in A11 [s]
    width: Positive = 0.1  # range over which the logarithm bends
    margin: NonNegative = 1.0  # gap that counts as contact, as for the term [m]
    gap_width: Positive = 0.2  # range of gaps over which contact bends [m]
    rate_width: Positive = 0.1  # range of approach rates over which closing begins [m/s]
    limit: Positive = 4.0  # time-to-collision below which the limit is missed [s]

    reads = ("self.gap", "self.relative_speed")

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        room = _log_softplus((gap - self.margin) / self.gap_width) + math.log(self.gap_width)
        rate = _log_softplus(-relative_speed / self.rate_width) + math.log(self.rate_width)
        return -excess(math.log(self.threshold) + rate - room, self.width)

    def missed(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return where the limit is missed, ``[*batch, A, 1]``."""
        return gap < -self.limit * relative_speed


class SmoothEfficiency(RewardTerm):
    """−max(0, log(TG / threshold)), smooth (surrogate of A12–A13)."""

    weight: NonNegative = 2.0  # price of log(TG / threshold)
    threshold: Positive = 2.3  # time gap below which the term is 0; 2.5 in A13 [s]
    width: Positive = 0.05  # range over which the logarithm bends
    speed_floor: Positive = 1.0  # speeds below this count as this [m/s]
    limit: Positive = 2.5  # time gap above which the limit is missed at speeds above the floor [s]

    reads = ("self.gap", "self.speed")

    def reward(self, gap: Tensor, speed: Tensor) -> Tensor:
        longest = self.threshold * speed.clamp(min=self.speed_floor)
        # Negative gaps are never too long.
        return -excess((gap / longest).clamp(min=1e-3).log(), self.width)

    def missed(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return where the limit is missed, ``[*batch, A, 1]``."""
        return (gap > self.limit * speed) & (speed > self.speed_floor)


class Smoothness(RewardTerm):
    """Minus the square of the jerk: moves a policy in training away from limit cycles.

    With a high gain on the gap a controlled car oscillates. Gradients through an oscillating car
    are large and carry little information.
    """

    weight: NonNegative = 0.001  # price of 1 (m/s³)²

    reads = ("self.jerk",)

    def reward(self, jerk: Tensor) -> Tensor:
        return -jerk.square()


class SpeedSpread(RewardTerm):
    """Minus the standard deviation of the speeds of all vehicles, a measure of waves."""

    weight: NonNegative = 0.2  # price of 1 m/s in a step
    floor: Positive = 0.05  # lower bound of the spread, which keeps its slope finite [m/s]

    reads = ("vehicles.speed",)

    def reward(self, speed: Tensor) -> Tensor:
        variance = speed.var(-2, correction=0, keepdim=True)
        return -(variance + self.floor**2).sqrt().expand(*speed.shape[:-2], *self.event_shape)


class Correction(RewardTerm):
    """Minus the square of the safety filter's correction: moves a policy into the filter's limits.

    When the filter overrides the policy, no gradient reaches it, and a policy that brakes at first
    never learns. The term needs a filter that writes the correction.
    """

    weight: NonNegative = 0.1  # price of 1 (m/s²)²

    reads = ("automated.correction",)

    def reward(self, correction: Tensor) -> Tensor:
        return -correction.square()


class ExcessSpacing(RewardTerm):
    """Minus the share by which a vehicle needs more of the lane than a human driver at its speed.

    The flow of a lane is speed divided by mean spacing, so a lane with a share p of such vehicles
    loses about p times this share of its flow. Its limit is one of the average: longer gaps in a
    wave may be compensated later.
    """

    standstill_gap: Positive = 2.0  # of the human driver [m]
    time_gap: NonNegative = 1.05  # of the human driver at equilibrium [s]
    vehicle_length: Positive = 5.0  # [m]
    # Spacing of which the excess is a share [m]; None: the human driver's at the present speed, by
    # which a metre costs more in a jam. The flow of a drive counts every metre alike.
    spacing: Positive | None = None

    reads = ("self.gap", "self.speed")
    limit_width: ClassVar = 0.1  # least miss of a limit at which its price changes fastest

    def reward(self, gap: Tensor, speed: Tensor) -> Tensor:
        return -self.missed(gap, speed)

    def missed(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the share, ``[*batch, A, 1]``; negative for gaps shorter than a human driver's."""
        desired = self.standstill_gap + self.time_gap * speed
        return (gap - desired) / (self.spacing or desired + self.vehicle_length)


class PathEnergy(RewardTerm):
    """−P/scale · T of the path energy: energy net of kinetic energy.

    With A2 these are the steady power and the loss by acceleration
    (:func:`lcc_rl.functional.power.acceleration_loss`); with another model the power drawn minus
    the change of kinetic energy (:meth:`lcc_rl.energy.EnergyModel.path_power`). A lower final speed
    does not lower it.
    """

    scale: Positive = 20000.0  # power that costs 1 per second [W]
    of: Literal["self", "behind"] = "self"  # behind: all back to the next automated vehicle
    # Energy credited per metre. If it is the energy that a metre takes, the objective is energy per
    # distance, and falling behind does not lower it [J/m].
    distance_price: NonNegative = 0.0

    def setup(self, world: World) -> None:
        """Choose the entries for ``of``, and the energy models."""
        self.sections = Sections(world.string, VEHICLES)
        self.energy = world.given("energy", self.title)
        self.mixed, behind = len(self.energy.models) > 1, self.of == "behind"
        space = VEHICLES if behind else "self"
        kind = [f"{space}.{CLASS[-1]}"] * self.mixed
        indices = self.sections.keys if behind else []
        self.sloped = world.slope is not None
        kind = [f"{space}.{GRADE}"] * self.sloped + kind
        self.time_step, self.factor = world.time_step, world.time_step / self.scale
        self.declare(world, [f"{space}.speed", f"{space}.acceleration", *kind, *indices])

    def reward(self, speed: Tensor, acceleration: Tensor, *more: Tensor) -> Tensor:
        before = speed - acceleration * self.time_step
        grade, more = (more[0], more[1:]) if self.sloped else (None, more)
        kind, indices = (more[0], more[1:]) if self.mixed else (None, more)
        power = (
            self.energy.at(grade).path_power(before, acceleration, kind)
            - self.distance_price * before
        )
        if self.of == "behind":
            power = self.sections.sum(power, *indices)
        return power * -self.factor


def _log_softplus(value: Tensor) -> Tensor:
    """log(log(1 + eˣ)); it is x far below zero, where softplus is rounded to zero."""
    return softplus(value.clamp(min=-15.0)).log() + (value + 15.0).clamp(max=0.0)
