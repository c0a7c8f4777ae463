"""A filter between policy and car that keeps time-to-collision and time gap within limits."""

from __future__ import annotations

import torch
from torch import Tensor

from lcc_rl.errors import require_positive
from lcc_rl.pieces.base import Transition


class Barrier(Transition):
    """Moves the action as little as needed for the car to stay between two limits.

    Two functions of the state are to stay positive: ``gap − margin − τ·(v − v_ahead)``, which
    keeps time-to-collision above τ, and ``longest·max(v, floor) − gap``, which keeps the time gap
    below the longest. Each may fall at most at ``rate`` times its value per second, which bounds
    the acceleration from above and from below; within the bounds the policy decides. Where they
    contradict each other, safety wins. This is the quadratic programme of Ames, Grizzle and
    Tabuada ("Control barrier function based quadratic programs with application to adaptive
    cruise control", CDC 2014), whose solution for one number is a clamp. The leader is expected
    to keep its last measured acceleration.

    Reads ``"action"`` in [−1, 1], writes ``(name, "action")``, both ``[*batch, 1]``; a car obeys
    it with ``CAVMotion(obeys="next.barrier.action")``. Differentiable.

    Args:
        max_acceleration: acceleration of action 1 [m/s²], as of the car.
        time_step: duration of a step [s].
        time_to_collision: shortest allowed [s].
        time_gap: longest allowed [s]; None: no limit.
        rate: how fast a limit may be approached [1/s].
        margin: gap that counts as contact [m].
        speed_floor: speeds below this count as this in the time gap [m/s].
        name: namespace of what is written.
        vehicle: namespace of the car.
        predecessor: namespace of the vehicle ahead.

    Raises:
        ConfigError: if a limit, the rate or the acceleration is not positive.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        time_to_collision: float = 4.0,
        time_gap: float | None = 2.45,
        rate: float = 1.0,
        margin: float = 0.2,
        speed_floor: float = 1.0,
        name: str = "barrier",
        vehicle: str = "cav",
        predecessor: str = "leader",
    ) -> None:
        require_positive(
            name, max_acceleration=max_acceleration, time_to_collision=time_to_collision, rate=rate
        )
        if time_gap is not None:
            require_positive(name, time_gap=time_gap)
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
        self.shortest, self.longest, self.rate = time_to_collision, time_gap, rate
        self.margin, self.speed_floor = margin, speed_floor

    def compute(
        self, action: Tensor, speed: Tensor, gap: Tensor, ahead: Tensor, ahead_acceleration: Tensor
    ) -> Tensor:
        """Return the action that the car obeys."""
        closing = speed - ahead
        wanted = action * self.max_acceleration
        if self.longest is not None:
            room = self.longest * speed.clamp(min=self.speed_floor) - gap
            wanted = torch.maximum(wanted, (-closing - self.rate * room) / self.longest)
        room = gap - self.margin - self.shortest * closing
        slower = (self.rate * room - closing) / (self.shortest + 0.5 * self.time_step)
        wanted = torch.minimum(wanted, ahead_acceleration + slower)
        return (wanted / self.max_acceleration).clamp(-1.0, 1.0)
