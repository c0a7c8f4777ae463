"""Late brakes: how commands become accelerations, and the room that they leave."""

from __future__ import annotations

import pytest
import torch
from test_braking import draw
from torch import Tensor

from lcc_rl.functional.actuation import PairState, Response, predicted
from lcc_rl.functional.braking import Braking, least_room_held

BRAKING = Braking(3.0, 2.6, 4.0)
STEP = 0.1
LAGS = [0.0, 0.3, 1.0]


def test_commands_act_late_and_with_a_lag() -> None:
    response = Response.of(3, 0.5, 3.0, STEP)
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


def braked(motion: PairState, response: Response, braking: Braking) -> Tensor:
    """Least room at the samples to come while both brake fully."""
    least = torch.full_like(motion.gap, torch.inf)
    for _ in range(300):
        least = torch.minimum(
            least, motion.gap - braking.time_to_collision * (motion.speed - motion.ahead)
        )
        full = torch.full_like(motion.gap, -braking.own)
        motion = predicted(motion, full, -braking.ahead, response)[-1]
    return least


@pytest.mark.parametrize("lag", LAGS)
def test_the_least_room_is_never_more_than_that_of_braking(lag) -> None:
    chance, count = torch.Generator().manual_seed(0), 5_000
    response = Response.of(0, lag, BRAKING.own, STEP)
    motion = PairState(
        draw(count, chance, 40.0).double().unsqueeze(-1),
        draw(count, chance, 300.0).double().unsqueeze(-1),
        draw(count, chance, 40.0).double().unsqueeze(-1),
        (6.0 * draw(count, chance) - 3.0).double().unsqueeze(-1),
    )
    bound = least_room_held(motion, motion.acceleration, response.hold, BRAKING)
    found = braked(motion, response, BRAKING)
    assert (bound <= found + 0.02).all()
    assert (found - bound).median() < 2.0 * lag + 0.1  # and not by far
