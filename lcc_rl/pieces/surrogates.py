"""Smooth surrogates of reward terms with thresholds, which have a gradient; for training only.

The literal terms have no slope where it matters: an indicator has none at all, a penalty that
begins at a threshold has none before it. Each surrogate has a ``threshold`` of its own, to be
set a little on the safe side of the term's, and a ``width`` over which it bends. ``missed`` marks
the steps that violate the term's limit.
"""

from __future__ import annotations

import math
from typing import Literal

from torch import Tensor
from torch.nn.functional import softplus

from lcc_rl.pieces.features import CLASS
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import VEHICLES
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive


def excess(value: Tensor, width: float) -> Tensor:
    """Return max(0, value), bent: quadratic up to about ``width``, then straight; same shape.

    Nothing of it reaches below zero: a tail, however small, is paid in every step of every
    episode and would outweigh what it stands for.
    """
    above = value.clamp(min=0.0)
    return width * ((1.0 + (above / width).square()).sqrt() - 1.0)


class SmoothSafety(RewardTerm):
    """−max(0, log(threshold / TTC)), smooth in gap and approach rate (stands in for A10–A11).

    Unlike the literal term it has a slope beyond the threshold, at contact and behind it, all of
    which lead back to safety.
    """

    weight: NonNegative = 0.5  # price of log(threshold / TTC)
    threshold: Positive = 4.2  # time-to-collision that is safe enough; the term's is 4 [s]
    width: Positive = 0.1  # range over which the logarithm bends
    margin: NonNegative = 1.0  # gap that counts as contact, as for the term [m]
    gap_width: Positive = 0.2  # range of gaps over which contact bends [m]
    rate_width: Positive = 0.1  # range of approach rates over which closing begins [m/s]
    limit: Positive = 4.0  # time-to-collision below which a limit is missed [s]

    reads = ("self.gap", "self.relative_speed")

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        room = _log_softplus((gap - self.margin) / self.gap_width) + math.log(self.gap_width)
        rate = _log_softplus(-relative_speed / self.rate_width) + math.log(self.rate_width)
        return -excess(math.log(self.threshold) + rate - room, self.width)

    def missed(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return where the limit is missed, ``[*batch, A, 1]``."""
        return gap < -self.limit * relative_speed


class SmoothEfficiency(RewardTerm):
    """−max(0, log(TG / threshold)), smooth (stands in for A12–A13)."""

    weight: NonNegative = 2.0  # price of log(TG / threshold)
    threshold: Positive = 2.3  # time gap that is too long; the term's is 2.5 [s]
    width: Positive = 0.05  # range over which the logarithm bends
    speed_floor: Positive = 1.0  # speeds below this count as this [m/s]
    limit: Positive = 2.5  # time gap above which a limit is missed, if faster than the floor [s]

    reads = ("self.gap", "self.speed")

    def reward(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        longest = self.threshold * speed.clamp(min=self.speed_floor)
        # Behind contact nothing is too long.
        return -excess((gap / longest).clamp(min=1e-3).log(), self.width)

    def missed(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return where the limit is missed, ``[*batch, A, 1]``."""
        return (gap > self.limit * speed) & (speed > self.speed_floor)


class Smoothness(RewardTerm):
    """Minus the square of the jerk: draws a policy that still learns away from limit cycles.

    With a high gain on the gap a controlled car oscillates, and gradients through an oscillating
    car are long and carry little information.
    """

    weight: NonNegative = 0.001  # price of 1 (m/s³)²

    reads = ("self.jerk",)

    def reward(self, jerk: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -jerk.square()


class SpeedSpread(RewardTerm):
    """Minus the standard deviation of the speeds of all vehicles, a measure of waves."""

    weight: NonNegative = 0.2  # price of 1 m/s in a step
    floor: Positive = 0.05  # spread of no wave, where the slope ends [m/s]

    reads = ("vehicles.speed",)

    def reward(self, speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        variance = speed.var(-2, correction=0, keepdim=True)
        return -(variance + self.floor**2).sqrt().expand(*speed.shape[:-2], *self.event_shape)


class Correction(RewardTerm):
    """Minus the square of the safety filter's change of the command: draws a policy to its limits.

    When the filter overrides the policy, no gradient reaches it, so a policy that starts by
    braking never learns. Only of use with a filter that writes the correction.
    """

    weight: NonNegative = 0.1  # price of 1 (m/s²)²

    reads = ("automated.correction",)

    def reward(self, correction: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -correction.square()


class ExcessSpacing(RewardTerm):
    """Minus the share by which a vehicle takes more of the lane than a human driver at its speed.

    The flow of a lane is speed over mean spacing, so a lane with a share p of such vehicles loses
    about p times this share. Its limit holds on average: what is taken in a wave may be given
    back after it.
    """

    standstill_gap: Positive = 2.0  # of the human driver [m]
    time_gap: Positive = 1.05  # of the human driver, that of a stationary gap [s]
    vehicle_length: Positive = 5.0  # [m]

    reads = ("self.gap", "self.speed")

    def reward(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -self.missed(gap, speed)

    def missed(self, gap: Tensor, speed: Tensor) -> Tensor:
        """Return that share, negative for a vehicle closer than a human, ``[*batch, A, 1]``."""
        own = self.standstill_gap + self.time_gap * speed
        return (gap - own) / (own + self.vehicle_length)


class PathEnergy(RewardTerm):
    """−P/scale · T of the path energy: energy without the kinetic energy that is stored.

    Of A2's three parts (:func:`lcc_rl.functional.power.acceleration_loss`) the steady power of the
    speeds driven and what accelerating loses; of another model what is drawn less what the
    kinetic energy is worth (:meth:`lcc_rl.energy.EnergyModel.path_power`). A vehicle that ends
    slower than it began gains nothing by it.
    """

    scale: Positive = 20000.0  # power that costs 1 per second [W]
    of: Literal["self", "behind"] = "self"  # behind: all back to the next automated vehicle
    # Energy that a metre driven is worth: at what a metre takes, the objective is energy per
    # distance, and falling behind gains nothing [J/m].
    distance_price: NonNegative = 0.0

    def setup(self, world: World) -> None:
        """Choose what is read by whose energy counts, and by which models."""
        self.sections = Sections(world.string, VEHICLES)
        self.energy = world.given("energy", self.title)
        self.mixed, behind = len(self.energy.models) > 1, self.of == "behind"
        space = VEHICLES if behind else "self"
        kind = [f"{space}.{CLASS[-1]}"] * self.mixed
        indices = self.sections.keys if behind else []
        self.time_step, self.factor = world.time_step, world.time_step / self.scale
        self.declare(world, [f"{space}.speed", f"{space}.acceleration", *kind, *indices])

    def reward(self, speed: Tensor, acceleration: Tensor, *more: Tensor) -> Tensor:
        """Return the unweighted term."""
        before = speed - acceleration * self.time_step
        kind, indices = (more[0], more[1:]) if self.mixed else (None, more)
        power = self.energy.path_power(before, acceleration, kind) - self.distance_price * before
        if self.of == "behind":
            power = self.sections.sum(power, *indices)
        return power * -self.factor


def _log_softplus(value: Tensor) -> Tensor:
    """log(log(1 + eˣ)), which is x far below zero, where softplus itself is rounded to zero."""
    return softplus(value.clamp(min=-15.0)).log() + (value + 15.0).clamp(max=0.0)
