"""The filter's promise with late brakes and wrong, late sensors, behind the worst leaders.

Here, not :class:`lcc_rl.pieces.Sensors` but the test measures: as wrong and as late as is declared.
"""

from __future__ import annotations

import pytest
import torch
from helpers import slow_but
from test_braking import MARGIN, draw, leader, states
from torch import Tensor

from lcc_rl.functional.actuation import PairState
from lcc_rl.functional.braking import Braking, least_room_to_come
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.safety import time_to_collision
from lcc_rl.pieces import Actuation, CBFFilter, Sensors
from lcc_rl.pieces.cbf import REMEMBERS
from lcc_rl.pieces.world import World

STEP, LIMIT, STEPS, HARD = 0.1, 4.0, 300, 3.0
ERRORS = {"gap_error": 0.5, "speed_error": 0.1, "ahead_error": 0.1}
LOST = {"dropouts": 0.1, "longest_dropout": 0.4}
FAULTS = {
    "none": (Actuation(), Sensors()),
    "delay 0.1 s": (Actuation(delay=0.1), Sensors()),
    "delay 0.3 s": (Actuation(delay=0.3), Sensors()),
    "lag 0.3 s": (Actuation(lag=0.3), Sensors()),
    "delay 0.2 s, lag 1 s": (Actuation(delay=0.2, lag=1.0), Sensors()),
    "brakes 2.5 m/s²": (Actuation(braking=2.5), Sensors()),
    "errors": (Actuation(), Sensors(**ERRORS)),
    "scale": (Actuation(), Sensors(scale_error=0.02)),
    "sensors 0.2 s late": (Actuation(), Sensors(delay=0.2)),
    "drop-outs": (Actuation(), Sensors(**LOST)),
    "all": (
        Actuation(delay=0.2, lag=0.3, braking=2.5),
        Sensors(delay=0.2, scale_error=0.01, **ERRORS, **LOST),
    ),
}


class Road:
    """Filtered vehicles that start where the promise holds, each behind a leader of its own."""

    def __init__(self, fault: str, count: int, seed: int, robust: bool = True) -> None:
        actuation, sensors = FAULTS[fault]
        world = World(actuators={"automated": actuation}, sensors={"automated": sensors})
        # Nothing but the promise holds the vehicles back.
        self.filter = CBFFilter(time_gap=None, rate=100.0, robust=robust).bind(world)
        true = CBFFilter().bind(world)
        self.response, self.bounds, self.limits = true.response, true.sensing, true.limits
        self.chance = torch.Generator().manual_seed(seed)
        self.obeyed = self.acceleration = self.ahead_acceleration = torch.zeros(count, 1)
        self.pending = torch.zeros(count, self.response.late)
        self.agreed = torch.zeros(count, REMEMBERS)
        self.dropped = torch.zeros(count, 1, dtype=torch.long)
        found = states(count, self.limits, seed, self.room)
        self.speed, room, self.ahead = (x.unsqueeze(-1) for x in found)
        self.gap = room + MARGIN
        back = STEP * (self.speed - self.ahead)
        self.frames = [self.frame(self.gap + n * back) for n in range(self.bounds.oldest + 1)]
        self.leads = torch.randint(0, 6, (count,), generator=self.chance)
        # Who sees everything too rosy, who sees it so or too dark in turn, who at random.
        self.errs = torch.randint(0, 3, (count, 1), generator=self.chance)
        self.factor = 1.0 - 2.0 * (self.errs == 1).float()  # of the error of scale, always

    def room(self, speed: Tensor, gap: Tensor, ahead: Tensor, braking: Braking) -> Tensor:
        now = PairState(*(x.unsqueeze(-1) for x in (speed, gap, ahead)), self.obeyed)
        return least_room_to_come(now, self.pending, self.response, braking).squeeze(-1)

    def frame(self, gap: Tensor) -> Tensor:
        own, ahead = self.acceleration, self.ahead_acceleration
        return torch.cat([gap, self.speed, self.ahead, ahead, own], -1)

    def measured(self) -> list[Tensor]:
        """What the filter reads."""
        count, bounds = len(self.speed), self.bounds
        lost = (draw(count, self.chance).unsqueeze(-1) < 0.5) & (self.dropped < bounds.longest)
        self.dropped = torch.where(lost, self.dropped + 1, 0)
        age, stack = bounds.late + self.dropped, torch.stack(self.frames, -2)
        seen = stack.gather(-2, age.unsqueeze(-1).expand(-1, -1, 5)).squeeze(-2)
        gap, speed, ahead, acceleration, _ = seen.split(1, -1)
        # Every other car loses its target only, and measures its own speed at the wheels.
        own = torch.where(torch.arange(count).unsqueeze(-1) % 2 == 0, age, bounds.late)
        speed = stack[..., 1].gather(-1, own)
        turns = 2.0 * torch.randint(0, 2, (count, 1), generator=self.chance) - 1.0
        drawn = 2.0 * draw(count, self.chance).unsqueeze(-1) - 1.0
        sign = torch.where(self.errs == 0, 1.0, torch.where(self.errs == 1, turns, drawn))
        factor = self.factor * bounds.scale
        speed = ((1.0 - factor) * speed - sign * bounds.speed).clamp(min=0.0)
        ahead = ((1.0 + factor) * ahead + sign * bounds.ahead).clamp(min=0.0)
        memories = {
            "automated.actuation": torch.cat([self.obeyed, self.pending], -1),
            "automated.sensors": torch.cat([age, own, stack.flatten(-2)], -1),
        }
        kept = (memories[name] for name in self.filter.memories)
        return [speed, gap + sign * bounds.gap, ahead, acceleration, self.agreed, *kept]

    def advance(self, step: int) -> Tensor:
        """Take a step; return time-to-collision [s]."""
        wish = torch.full_like(self.speed, HARD)
        if step % 50 < 25:
            wish = torch.where(draw(len(wish), self.chance).unsqueeze(-1) < 0.8, wish, -HARD)
        command, self.agreed = self.filter.filtered(wish, *self.measured())
        line = torch.cat([self.pending, command], -1)
        self.obeyed, self.pending = self.response.next(self.obeyed, line[:, :1]), line[:, 1:]
        speed, self.acceleration = advance_speed(self.speed, self.obeyed, STEP)
        gap = self.gap.squeeze(-1)
        pressed = leader(self.leads, gap, step * STEP, self.limits, self.chance)
        ahead = advance_speed(self.ahead, pressed.unsqueeze(-1), STEP)[0].clamp(max=60.0)
        self.ahead_acceleration = (ahead - self.ahead) / STEP
        self.gap = advance_gap(self.gap, self.ahead, self.speed, ahead, speed, STEP)
        self.speed, self.ahead = speed, ahead
        self.frames = [self.frame(self.gap), *self.frames[:-1]]
        return time_to_collision(self.gap, speed - ahead)


def driven(road: Road, steps: int = STEPS) -> tuple[float, int, float]:
    """Least TTC [s], samples below the limit, and the least gap [m]."""
    least, broken, nearest = torch.inf, 0, torch.inf
    for step in range(steps):
        ttc = road.advance(step)
        least, nearest = min(least, float(ttc.min())), min(nearest, float(road.gap.min()))
        broken += int((ttc < LIMIT).sum())
    return least, broken, nearest


@pytest.mark.parametrize(
    ("fault", "episodes", "steps"),
    [("all", 1_000, STEPS // 3), *slow_but([], [(x, 10_000, STEPS) for x in FAULTS])],
)
def test_the_promise_holds_with_faults(fault, episodes, steps) -> None:
    least, broken, nearest = driven(Road(fault, episodes, 0), steps)
    assert broken == 0
    assert nearest > 0.0
    assert least < 4.1  # full throttle reaches the limit


def test_a_filter_that_does_not_reckon_with_a_fault_breaks_it(subtests) -> None:
    for fault in ["errors", "sensors 0.2 s late"]:
        with subtests.test(fault=fault):
            assert driven(Road(fault, 500, 0, robust=False))[1] > 100


def farthest_behind(piece: CBFFilter) -> tuple[float, float]:
    """Largest gap [m] and least TTC [s] of a minute: the vehicle brakes, or coasts, if it may.

    The leaders accelerate by half of what the vehicle can, and brake, in waves.
    """
    chance, longest = torch.Generator().manual_seed(0), 115.0
    speed, room, ahead = states(10_000, piece.limits, 0)
    gap, opening = room + MARGIN, (2.0 * longest / HARD) ** 0.5 * (ahead - speed)
    inside = gap + opening.clamp(min=0.0) < longest
    speed, gap, ahead = (x[inside].unsqueeze(-1) for x in (speed, gap, ahead))
    phase = 20.0 * draw(len(gap), chance).unsqueeze(-1)
    wish = torch.where(draw(len(gap), chance).unsqueeze(-1) < 0.5, -HARD, 0.0)
    seen, farthest, least = torch.zeros_like(gap), 0.0, torch.inf
    agreed = torch.zeros(len(gap), REMEMBERS)
    for step in range(600):
        command, agreed = piece.filtered(wish, speed, gap, ahead, seen, agreed)
        pressed = torch.where((step * STEP + phase) % 20.0 < 12.0, 0.5 * HARD, -2.6)
        reached = advance_speed(speed, command, STEP)[0]
        ahead_reached = advance_speed(ahead, pressed, STEP)[0].clamp(max=50.0)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, STEP)
        seen, speed, ahead = (ahead_reached - ahead) / STEP, reached, ahead_reached
        farthest = max(farthest, float(gap.max()))
        least = min(least, float(time_to_collision(gap, speed - ahead).min()))
    return farthest, least


def test_the_longest_gap_is_kept_and_nearness_wins(subtests) -> None:
    for longest, kept in [(115.0, True), (None, False)]:
        with subtests.test(longest=longest):
            piece = CBFFilter(time_gap=None, longest_gap=longest, shortest_time_gap=1.05).bind()
            farthest, least = farthest_behind(piece)
            assert (farthest < 116.0) == kept
            assert least >= LIMIT
