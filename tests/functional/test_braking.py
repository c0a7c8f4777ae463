"""The safe states of braking, and the filter's promise on leaders that do their worst."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from lcc_rl.functional.braking import Braking, least_room, safe_acceleration
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.safety import time_to_collision

MARGIN = 0.2
CASES = [
    (Braking(3.0, 2.6, 4.0), 0.1),
    (Braking(3.0, 3.0, 4.0), 0.1),
    (Braking(3.0, 4.5, 4.0), 0.1),
    (Braking(3.0, 2.6, 4.0), 0.2),
    (Braking(6.0, 1.0, 2.0), 0.1),
]


def draw(count: int, chance: torch.Generator, top: float = 1.0) -> Tensor:
    return top * torch.rand(count, generator=chance)


def simulated(speed: Tensor, gap: Tensor, ahead: Tensor, braking: Braking) -> Tensor:
    """The least room while both brake, by small steps."""
    dt, least = 1e-3, torch.full_like(gap, torch.inf)
    for _ in range(int(16.0 / dt)):
        least = torch.minimum(least, gap - braking.time_to_collision * (speed - ahead))
        slower = (speed - braking.own * dt).clamp(min=0.0)
        ahead_slower = (ahead - braking.ahead * dt).clamp(min=0.0)
        gap = gap + 0.5 * dt * (ahead + ahead_slower - speed - slower)
        speed, ahead = slower, ahead_slower
    return least


def states(
    count: int, braking: Braking, seed: int, room: Callable[..., Tensor] = least_room
) -> tuple[Tensor, Tensor, Tensor]:
    """Speed, gap less the margin and speed ahead: a third of the states on the boundary."""
    chance = torch.Generator().manual_seed(seed)
    speed, ahead = draw(count, chance, 40.0), draw(count, chance, 40.0)
    near = speed + torch.randn(count, generator=chance)
    ahead = torch.where(draw(count, chance) < 0.4, near.clamp(min=0.0), ahead)
    ahead = torch.where(draw(count, chance) < 0.1, 0.0, ahead)
    low, high = torch.zeros(count), torch.full((count,), 2000.0)
    for _ in range(50):
        middle = 0.5 * (low + high)
        safe = room(speed, middle, ahead, braking) >= 0.0
        low, high = torch.where(safe, low, middle), torch.where(safe, middle, high)
    more = torch.where(draw(count, chance) < 0.33, 0.0, draw(count, chance, 60.0))
    return speed, high + more, ahead


@pytest.mark.parametrize("braking", dict(CASES))
def test_the_least_room_is_that_of_braking_in_small_steps(braking) -> None:
    chance = torch.Generator().manual_seed(1)
    speed, ahead = draw(200, chance, 40.0).double(), draw(200, chance, 40.0).double()
    gap = draw(200, chance, 150.0).double()
    expected = simulated(speed, gap, ahead, braking)
    assert torch.allclose(least_room(speed, gap, ahead, braking), expected, atol=0.03)


@pytest.mark.parametrize(("braking", "time_step"), CASES)
def test_the_bound_is_safe_and_no_tighter_than_needed(braking, time_step) -> None:
    speed, gap, ahead = (entry.double() for entry in states(20_000, braking, 2))
    bound = safe_acceleration(speed, gap, ahead, braking, time_step)
    assert (bound >= -braking.own - 1e-4).all()
    # Where nobody stops within the step, the state reached lies on the boundary.
    slowest = (ahead - braking.ahead * time_step).clamp(min=0.0)
    reached = speed + bound * time_step
    plain = (reached > braking.own * time_step) & (reached < 60.0)
    assert plain.double().mean() > 0.5
    gap = advance_gap(gap, ahead, speed, slowest, reached, time_step)
    room = least_room(reached, gap, slowest, braking)[plain]
    assert room.abs().max() < 1e-6


def leader(mode: Tensor, gap: Tensor, time: float, braking: Braking, chance) -> Tensor:
    """Acceleration of leaders of six kinds that brake at most as hard as is reckoned with."""
    count, hard = len(mode), -braking.ahead
    waves = time + 0.01 * torch.arange(count)
    kinds = (
        torch.full((count,), hard),
        (2.0 * draw(count, chance) - 1.0) * braking.ahead,
        torch.where(draw(count, chance) < 0.5, hard, 3.0),
        torch.where(torch.sin(0.5 * waves) > 0.0, 2.0, hard),
        torch.where(gap < 20.0 + waves % 20.0, hard, 3.0),
        torch.full((count,), 4.0 if time % 5.0 < 2.5 else hard),
    )
    return torch.stack(kinds).gather(0, mode.unsqueeze(0)).squeeze(0)


def violations(count: int, braking: Braking, time_step: float, seed: int) -> tuple[float, int]:
    """Least TTC [s] and how many samples of 30 s lie below τ, for wishes of all kinds."""
    speed, room, ahead = states(count, braking, seed)
    gap, chance = room + MARGIN, torch.Generator().manual_seed(seed)
    mode = torch.randint(0, 6, (count,), generator=chance)
    least, broken = torch.inf, 0
    for step in range(int(30.0 / time_step)):
        wish = torch.where(draw(count, chance) < 0.8, braking.own, -braking.own)
        wish = wish if step % 50 < 25 else torch.full_like(wish, braking.own)
        bound = safe_acceleration(speed, gap - MARGIN, ahead, braking, time_step)
        command = torch.minimum(wish, bound).clamp(-braking.own, braking.own)
        reached, _ = advance_speed(speed, command, time_step)
        wanted = leader(mode, gap, step * time_step, braking, chance)
        ahead_reached, _ = advance_speed(ahead, wanted, time_step)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, time_step)
        speed, ahead = reached, ahead_reached.clamp(max=60.0)
        ttc = time_to_collision(gap, speed - ahead)
        least = min(least, float(ttc.min()))
        broken += int((ttc < braking.time_to_collision).sum())
    return least, broken


@pytest.mark.parametrize(("braking", "time_step"), CASES)
def test_no_leader_that_keeps_the_condition_breaks_the_limit(braking, time_step) -> None:
    least, broken = violations(4_000, braking, time_step, 3)
    assert broken == 0
    # Wishes press against the limit: it is met closely.
    assert least < 1.2 * braking.time_to_collision


@pytest.mark.slow
def test_a_million_episodes_without_a_violation() -> None:
    for seed in range(10):
        assert violations(100_000, *CASES[0], 100 + seed)[1] == 0


def test_a_leader_that_brakes_harder_breaks_it() -> None:
    careless = Braking(3.0, 1.0, 4.0)
    speed, room, ahead = states(2_000, careless, 4)
    least = torch.inf
    for _ in range(100):
        bound = safe_acceleration(speed, room, ahead, careless, 0.1)
        reached, _ = advance_speed(speed, bound.clamp(-3.0, 3.0), 0.1)
        ahead_reached, _ = advance_speed(ahead, torch.full_like(ahead, -6.0), 0.1)
        room = advance_gap(room, ahead, speed, ahead_reached, reached, 0.1)
        speed, ahead = reached, ahead_reached
        least = min(least, float(time_to_collision(room, speed - ahead).min()))
    assert least < 4.0
