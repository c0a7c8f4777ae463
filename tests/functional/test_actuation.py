"""Late brakes: how commands become accelerations, and what the filter promises with them."""

from __future__ import annotations

import pytest
import torch
from test_braking import MARGIN, draw, leader, states
from torch import Tensor

from lcc_rl.functional.actuation import Motion, Response, predicted
from lcc_rl.functional.braking import Braking, least_room_late, safe_command
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.safety import time_to_collision

BRAKING = Braking(3.0, 2.6, 4.0)
STEP = 0.1
LATE = [(0.1, 0.0), (0.3, 0.0), (0.0, 0.3), (0.2, 0.3), (0.2, 1.0)]


def test_commands_act_late_and_with_a_lag() -> None:
    response = Response.of(0.3, 0.5, 3.0, STEP)
    assert response.late == 3
    acceleration, reached = torch.zeros(1), []
    for _ in range(20):
        acceleration = response.next(acceleration, torch.tensor([-9.0]))
        reached.append(float(acceleration))
    expected = [-3.0 * (1.0 - torch.exp(torch.tensor(-STEP * (k + 1) / 0.5))) for k in range(20)]
    assert reached == pytest.approx([float(x) for x in expected], abs=1e-5)
    # What the lag loses is the area between the command and the acceleration.
    lost = STEP * sum(3.0 + x for x in reached[:20]) + 3.0 * response.hold * 0.8**0
    assert lost > 3.0 * response.hold


def braked(motion: Motion, response: Response, braking: Braking) -> Tensor:
    """Least room at the samples to come while both brake fully."""
    least = torch.full_like(motion.gap, torch.inf)
    for _ in range(300):
        least = torch.minimum(
            least, motion.gap - braking.time_to_collision * (motion.speed - motion.ahead)
        )
        full = torch.full_like(motion.gap, -braking.own)
        motion = predicted(motion, full.unsqueeze(-1).squeeze(-1), -braking.ahead, response)[-1]
    return least


@pytest.mark.parametrize(("delay", "lag"), LATE)
def test_the_least_room_is_never_more_than_that_of_braking(delay, lag) -> None:
    chance, count = torch.Generator().manual_seed(0), 5_000
    response = Response.of(0.0, lag, BRAKING.own, STEP)
    motion = Motion(
        draw(count, chance, 40.0).double().unsqueeze(-1),
        draw(count, chance, 300.0).double().unsqueeze(-1),
        draw(count, chance, 40.0).double().unsqueeze(-1),
        (6.0 * draw(count, chance) - 3.0).double().unsqueeze(-1),
    )
    bound, found = least_room_late(motion, response, BRAKING), braked(motion, response, BRAKING)
    assert (bound <= found + 0.02).all()
    assert (found - bound).median() < 2.0 * lag + 0.1  # and not by far


def violations(delay: float, lag: float, count: int, seed: int) -> tuple[float, int, float]:
    """Least TTC [s], samples below τ of episodes that start safe, and their number."""
    response = Response.of(delay, lag, BRAKING.own, STEP)
    speed, room, ahead = (x.unsqueeze(-1) for x in states(count, BRAKING, seed))
    gap = room + MARGIN
    pending, acceleration = torch.zeros(count, response.late), torch.zeros(count, 1)
    chance = torch.Generator().manual_seed(seed)
    mode = torch.randint(0, 6, (count,), generator=chance)
    path = predicted(Motion(speed, room, ahead, acceleration), pending, -BRAKING.ahead, response)
    rooms = [x.gap - BRAKING.time_to_collision * (x.speed - x.ahead) for x in path]
    safe = torch.stack([*rooms, least_room_late(path[-1], response, BRAKING)]).amin(0) >= 0.0
    least, broken = torch.inf, 0
    for step in range(300):
        now = Motion(speed, gap - MARGIN, ahead, acceleration)
        then = predicted(now, pending, -BRAKING.ahead, response)[-1]
        wish = torch.where(draw(count, chance) < 0.8, BRAKING.own, -BRAKING.own).unsqueeze(-1)
        wish = wish if step % 50 < 25 else torch.full_like(wish, BRAKING.own)
        command = torch.minimum(wish, safe_command(then, response, BRAKING))
        line = torch.cat([pending, command.clamp(-BRAKING.own, BRAKING.own)], -1)
        pending, acceleration = line[:, 1:], response.next(acceleration, line[:, :1])
        reached, _ = advance_speed(speed, acceleration, STEP)
        wanted = leader(mode, gap.squeeze(-1), step * STEP, BRAKING, chance).unsqueeze(-1)
        ahead_reached, _ = advance_speed(ahead, wanted, STEP)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, STEP)
        speed, ahead = reached, ahead_reached.clamp(max=60.0)
        ttc = time_to_collision(gap, speed - ahead)[safe]
        least, broken = min(least, float(ttc.min())), broken + int((ttc < 4.0).sum())
    return least, broken, float(safe.double().mean())


@pytest.mark.parametrize(("delay", "lag"), LATE)
def test_the_promise_holds_with_late_brakes(delay, lag) -> None:
    least, broken, share = violations(delay, lag, 2_000, 0)
    assert broken == 0
    assert 4.0 <= least < 4.2  # full throttle reaches the limit: it is not far beyond it
    assert share > 0.4


@pytest.mark.slow
@pytest.mark.parametrize(("delay", "lag"), LATE)
def test_the_promise_holds_in_many_episodes(delay, lag) -> None:
    assert violations(delay, lag, 100_000, 1)[1] == 0
