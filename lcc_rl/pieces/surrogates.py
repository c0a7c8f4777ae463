"""Smooth stand-ins for reward terms with thresholds: what a gradient can follow, in training only.

The literal terms have no slope where it matters: an indicator has none at all, a penalty that
begins at a threshold has none before it. Each stand-in takes a ``threshold`` of its own, to be
set a little on the safe side of the term's, and a ``width`` over which it bends. Where a limit is
to be kept and not a price to be paid, ``missed`` says where it is not.
"""

from __future__ import annotations

import math

from torch import Tensor
from torch.nn.functional import softplus

from lcc_rl.energy import EnergyModel, Fleet, as_fleet
from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.pieces.features import CLASS
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import VEHICLES


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

    Args:
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`.
        threshold: time-to-collision that is safe enough [s].
        width: range over which the logarithm bends.
        margin: gap that counts as contact [m].
        gap_width: range of gaps over which contact bends [m].
        rate_width: range of approach rates over which closing begins [m/s].
        limit: time-to-collision below which the limit is missed [s].

    Raises:
        ConfigError: if a threshold or width is not positive or the margin negative.
    """

    reads = ("self.gap", "self.relative_speed")

    def __init__(
        self,
        name: str = "safety",
        weight: float = 0.5,
        threshold: float = 4.2,
        width: float = 0.1,
        margin: float = 1.0,
        gap_width: float = 0.2,
        rate_width: float = 0.1,
        limit: float = 4.0,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(
            f"agent.surrogates.{name}",
            threshold=threshold,
            width=width,
            gap_width=gap_width,
            rate_width=rate_width,
            limit=limit,
        )
        require_in(f"agent.surrogates.{name}", "[0, inf)", margin=margin)
        super().__init__(name, weight, string=string)
        self.log_threshold, self.width, self.margin = math.log(threshold), width, margin
        self.gap_width, self.rate_width, self.limit = gap_width, rate_width, limit

    def reward(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return the unweighted term."""
        room = _log_softplus((gap - self.margin) / self.gap_width) + math.log(self.gap_width)
        rate = _log_softplus(-relative_speed / self.rate_width) + math.log(self.rate_width)
        return -excess(self.log_threshold + rate - room, self.width)

    def missed(self, gap: Tensor, relative_speed: Tensor) -> Tensor:
        """Return where the limit is missed, ``[*batch, A, 1]``."""
        return gap < -self.limit * relative_speed


class SmoothEfficiency(RewardTerm):
    """−max(0, log(TG / threshold)), smooth (stands in for A12–A13).

    Args:
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`.
        threshold: time gap that is too long [s].
        width: range over which the logarithm bends.
        speed_floor: speeds below this count as this [m/s].
        limit: time gap above which the limit is missed, by vehicles faster than the floor [s].

    Raises:
        ConfigError: if a setting is not positive.
    """

    reads = ("self.gap", "self.speed")

    def __init__(
        self,
        name: str = "efficiency",
        weight: float = 2.0,
        threshold: float = 2.3,
        width: float = 0.05,
        speed_floor: float = 1.0,
        limit: float = 2.5,
        string: VehicleString | None = None,
    ) -> None:
        require_positive(
            f"agent.surrogates.{name}",
            threshold=threshold,
            width=width,
            speed_floor=speed_floor,
            limit=limit,
        )
        super().__init__(name, weight, string=string)
        self.threshold, self.width = threshold, width
        self.speed_floor, self.limit = speed_floor, limit

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
    car are long and say little.

    Args:
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`; the price of 1 (m/s³)².
    """

    reads = ("self.jerk",)

    def __init__(
        self,
        name: str = "smoothness",
        weight: float = 0.001,
        string: VehicleString | None = None,
    ) -> None:
        super().__init__(name, weight, string=string)

    def reward(self, jerk: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -jerk.square()


class Correction(RewardTerm):
    """Minus the square of what the safety filter changes: draws a policy to the filter's limits.

    Where the filter drives, a policy has no gradient, and one that starts there, braking always,
    never learns anything. Only of use with a filter that writes the correction.

    Args:
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`; the price of 1 (m/s²)².
    """

    reads = ("automated.correction",)

    def __init__(
        self,
        name: str = "correction",
        weight: float = 0.1,
        string: VehicleString | None = None,
    ) -> None:
        super().__init__(name, weight, string=string)

    def reward(self, correction: Tensor) -> Tensor:
        """Return the unweighted term."""
        return -correction.square()


class PathEnergy(RewardTerm):
    """−P/scale · T of the energy that a path takes: without what the motion stores.

    Of A2's three parts (:func:`lcc_rl.functional.power.acceleration_loss`) the steady power of the
    speeds driven and what accelerating loses; of another model what is drawn less what the
    kinetic energy is worth (:meth:`lcc_rl.energy.EnergyModel.path_power`). Who ends slower than he
    began gains nothing by it.

    Args:
        time_step: duration of a step [s].
        name, weight, string: see :class:`lcc_rl.pieces.rewards.RewardTerm`.
        scale: power that costs 1 per second [W].
        of: ``"self"``, or ``"behind"``: all vehicles behind, back to the next automated one.
        distance_price: energy that a metre driven is worth [J/m]: at what a metre takes, the
            objective is energy per distance, and falling behind gains nothing.
        energy: the energy models; None for that of the ALCC paper.

    Raises:
        ConfigError: if the scale is not positive, or ``of`` is unknown.
    """

    def __init__(
        self,
        time_step: float,
        name: str = "energy",
        weight: float = 1.0,
        scale: float = 20000.0,
        of: str = "self",
        distance_price: float = 0.0,
        string: VehicleString | None = None,
        energy: Fleet | EnergyModel | None = None,
    ) -> None:
        require_positive(f"agent.surrogates.{name}", scale=scale)
        require_in(f"agent.surrogates.{name}", "[0, inf)", distance_price=distance_price)
        if of not in ("self", "behind"):
            raise ConfigError(f"agent.surrogates.{name}.of must be self or behind, got {of!r}")
        string = VehicleString() if string is None else string
        self.sections, self.behind = Sections(string, VEHICLES), of == "behind"
        space = VEHICLES if self.behind else "self"
        reads = [f"{space}.speed", f"{space}.acceleration"]
        self.energy, self.distance_price = as_fleet(energy), distance_price
        self.mixed = len(self.energy.models) > 1
        if self.mixed:
            reads.append(f"{space}.{CLASS[-1]}")
        reads += [".".join(key) for key in self.sections.keys if self.behind]
        super().__init__(name, weight, reads, string)
        self.time_step, self.factor = time_step, time_step / scale

    def reward(self, speed: Tensor, acceleration: Tensor, *more: Tensor) -> Tensor:
        """Return the unweighted term."""
        before = speed - acceleration * self.time_step
        kind, indices = (more[0], more[1:]) if self.mixed else (None, more)
        power = self.energy.path_power(before, acceleration, kind) - self.distance_price * before
        if self.behind:
            power = self.sections.sum(power, *indices)
        return power * -self.factor


def _log_softplus(value: Tensor) -> Tensor:
    """log(log(1 + eˣ)), which is x far below zero, where softplus itself is rounded to zero."""
    return softplus(value.clamp(min=-15.0)).log() + (value + 15.0).clamp(max=0.0)
