"""A filter between policy and car that keeps time-to-collision and time gap within limits."""

from __future__ import annotations

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.pieces.base import Transition

SLOWEST = 1.0  # slower speeds count as this, as in the time gap: the limit has a slope [m/s]


class Barrier(Transition):
    """Moves the action as little as needed for the car to stay between two limits.

    Two functions of the state are to stay positive: ``gap − margin − τ·(v − v_ahead)``, which
    keeps time-to-collision above τ, and ``longest(v) − gap``, which keeps the time gap below
    ``time_gap``. Each may fall at most at its rate times its value per second, which bounds the
    acceleration from above and from below; within the bounds the policy decides. Where they
    contradict each other, safety wins. This is the quadratic programme of Ames, Grizzle and
    Tabuada ("Control barrier function based quadratic programs with application to adaptive
    cruise control", CDC 2014), whose solution for one number is a clamp. The leader is expected
    to keep its last measured acceleration.

    Behind a leader at standstill both limits are about the same number, gap / speed, so who comes
    from afar must break one. With a ``full_speed``, ``longest(v)`` is ``time_gap·v`` from there on
    and falls with the square of the speed below: the car is near before its leader stands, and
    pays for it with energy.

    Reads ``"action"`` in [−1, 1], writes ``(name, "action")``, both ``[*batch, 1]``; a car obeys
    it with ``CAVMotion(obeys="next.barrier.action")``. Differentiable.

    Args:
        max_acceleration: acceleration of action 1 [m/s²], as of the car.
        time_step: duration of a step [s].
        time_to_collision: shortest allowed [s].
        rate: how fast that limit may be approached [1/s].
        margin: gap that counts as contact [m].
        time_gap: longest allowed [s]; None: no limit.
        time_gap_rate: how fast that limit may be approached [1/s].
        full_speed: speed below which the longest time gap falls in proportion; 0: it does not
            [m/s].
        least_gap: gap that the limit of the time gap always allows [m].
        name: namespace of what is written.
        vehicle: namespace of the car.
        predecessor: namespace of the vehicle ahead.

    Raises:
        ConfigError: if a limit, a rate or the acceleration is not positive, or the speed negative.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        time_to_collision: float = 4.0,
        rate: float = 3.0,
        margin: float = 0.2,
        time_gap: float | None = 2.45,
        time_gap_rate: float = 0.2,
        full_speed: float = 0.0,
        least_gap: float = 2.0,
        name: str = "barrier",
        vehicle: str = "cav",
        predecessor: str = "leader",
    ) -> None:
        limits = {"time_to_collision": time_to_collision, "rate": rate}
        limits |= {"time_gap_rate": time_gap_rate, "max_acceleration": max_acceleration}
        require_positive(name, **limits)
        if time_gap is not None:
            require_positive(name, time_gap=time_gap)
        if full_speed < 0:
            raise ConfigError(f"{name}.full_speed must not be negative, got {full_speed}")
        super().__init__(
            reads=[
                "action",
                (vehicle, "speed"),
                (vehicle, "gap"),
                (predecessor, "speed"),
                (predecessor, "acceleration"),
            ],
            writes=[(name, "action")],
        )
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.shortest, self.rate, self.margin = time_to_collision, rate, margin
        self.longest, self.time_gap_rate = time_gap, time_gap_rate
        self.full_speed, self.least_gap = max(full_speed, SLOWEST), least_gap

    def compute(
        self, action: Tensor, speed: Tensor, gap: Tensor, ahead: Tensor, ahead_acceleration: Tensor
    ) -> Tensor:
        """Return the action that the car obeys."""
        closing = speed - ahead
        wanted = action * self.max_acceleration
        if self.longest is not None:
            allowed, slope = self._longest_gap(speed, self.longest)
            least = (-closing - self.time_gap_rate * (allowed - gap)) / slope
            wanted = torch.maximum(wanted, least)
        room = gap - self.margin - self.shortest * closing
        slower = (self.rate * room - closing) / (self.shortest + 0.5 * self.time_step)
        wanted = torch.minimum(wanted, ahead_acceleration + slower)
        return (wanted / self.max_acceleration).clamp(-1.0, 1.0)

    def _longest_gap(self, speed: Tensor, time_gap: float) -> tuple[Tensor, Tensor]:
        """Return the longest gap at a speed, and how it grows with the speed."""
        moving = speed.clamp(min=SLOWEST)
        share = (moving / self.full_speed).clamp(max=1.0)
        slope = time_gap * torch.where(share < 1.0, 2.0 * share, share)
        return (time_gap * share * moving).clamp(min=self.least_gap), slope
