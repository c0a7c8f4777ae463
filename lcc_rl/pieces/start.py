"""How the vehicles of a role start: their speeds and gaps at reset."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import LARGEST, ConfigError, require_in, require_positive
from lcc_rl.functional.driver_models import capped
from lcc_rl.functional.idm import equilibrium_gap
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.random import stream_id, uniform
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.controllers import Population, stream_name

GAP, SPEED = stream_id("platoon.gap"), stream_id("platoon.speed")


def draw(start: TensorDictBase, stream: int, like: Tensor) -> Tensor:
    """Draw from U[0, 1) for every vehicle of a role, by the seed of its episode."""
    index = torch.arange(like.shape[-2], device=like.device).unsqueeze(-1)
    return uniform(start.get(SEED).unsqueeze(-2), 0, stream + index)


class TimeGapStart:
    """A gap that grows with the speed: standstill gap + time gap · speed, at the leader's speed.

    Args:
        standstill_gap: gap when standing [m].
        time_gap: further time gap; the ALCC paper is silent on it [s].
        gap_range: the gap is that times a factor drawn evenly from this range by the episode's
            seed, so that training meets what good driving never does; evaluation takes 1.
        nominal: take the factor 1, as an evaluation does.
        role: whose vehicles start, by which random numbers are drawn.

    Raises:
        ConfigError: if ``standstill_gap`` or the range is not positive, or the time gap negative.
    """

    def __init__(
        self,
        standstill_gap: float = 2.0,
        time_gap: float = 1.5,
        gap_range: Sequence[float] = (0.1, 1.5),
        nominal: bool = False,
        role: str = AUTOMATED,
    ) -> None:
        require_positive("scenario.start", standstill_gap=standstill_gap)
        require_in("scenario.start", "[0, inf)", time_gap=time_gap)
        if len(gap_range) != 2 or not 0 < gap_range[0] <= gap_range[1] <= LARGEST:
            raise ConfigError(
                "scenario.start: gap_range must be two increasing positive factors, got "
                f"{list(gap_range)}"
            )
        self.standstill_gap, self.time_gap = standstill_gap, time_gap
        self.stream = stream_id(f"{stream_name(role)}.gap_factor")
        self.lowest, self.highest = (1.0, 1.0) if nominal else map(float, gap_range)

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        uniformly = draw(start, self.stream, speed)
        factor = self.lowest + (self.highest - self.lowest) * uniformly
        return speed, factor * (self.standstill_gap + self.time_gap * speed)


class EquilibriumStart:
    """The gap at which the role's own drivers neither brake nor accelerate, at the leader's speed.

    Args:
        population: the drivers, for the parameters that they share.
        cap_time_gap: bounds the gap, see :func:`lcc_rl.functional.idm.equilibrium_gap` [s].

    Raises:
        ConfigError: if ``cap_time_gap`` is not positive.
    """

    def __init__(self, population: Population, cap_time_gap: float = 3.0) -> None:
        require_positive("scenario.start", cap_time_gap=cap_time_gap)
        self.drivers, self.cap_time_gap = population.constants.shared(), cap_time_gap

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        desired_speed, time_gap = (
            start.get((role, name), None) for name in ("desired_speed", "desired_time_gap")
        )
        if desired_speed is None or time_gap is None:
            raise ConfigError(
                f"scenario.start.{role}: EquilibriumStart needs {role}.desired_speed and "
                f"{role}.desired_time_gap, which only driver models write; say for example "
                f"'scenario.start.{role}=${{scenario.start.automated}}'"
            )
        told = start.get((role, "equilibrium_gap"), None)
        if told is not None:
            return speed, capped(told, speed, self.drivers, self.cap_time_gap)
        gap = equilibrium_gap(speed, desired_speed, time_gap, self.drivers, self.cap_time_gap)
        return speed, gap


class HeadwayStart:
    """A fixed gap at the leader's speed, in training with deviations from both (HCFS).

    Args:
        headway: h, the gap at equilibrium [m]; the paper is silent on it.
        gap_spread: largest deviation of a gap from it [m].
        speed_spread: largest deviation of a speed from the leader's [m/s].
        nominal: no deviations, as in an evaluation.

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        headway: float = 5.0,
        gap_spread: float = 2.0,
        speed_spread: float = 1.0,
        nominal: bool = False,
    ) -> None:
        require_positive("scenario.start", headway=headway)
        require_in("scenario.start", f"[0, {headway})", gap_spread=gap_spread)
        require_in("scenario.start", "[0, inf)", speed_spread=speed_spread)
        self.headway = headway
        self.gap_spread, self.speed_spread = (0.0, 0.0) if nominal else (gap_spread, speed_spread)

    def __call__(self, start: TensorDictBase, role: str, speed: Tensor) -> tuple[Tensor, Tensor]:
        """Return speed and gap, see :class:`lcc_rl.pieces.string.Start`."""
        shift = 2.0 * draw(start, GAP, speed) - 1.0
        gap = self.headway + self.gap_spread * shift
        shift = 2.0 * draw(start, SPEED, speed) - 1.0
        return (speed + self.speed_spread * shift).clamp(min=0.0), gap
