"""CACC, dead-beat, the safe cap and the hybrid decision against values worked out by hand."""

from __future__ import annotations

import itertools
import math

import pytest
import torch

from lcc_rl.errors import ConfigError
from lcc_rl.functional.braking import Braking, safe_acceleration
from lcc_rl.functional.cacc import Errors, Gains, cacc_acceleration, find_chains, platoon_errors
from lcc_rl.functional.hcfs import PlatoonPlace, PlatoonReward, hybrid_decision, jerk_interval
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.string import entries_ahead
from lcc_rl.studies.hcfs.tables import weight_table

T, A_MAX = 0.2, 3.0
LIMITS = -A_MAX, A_MAX
NAMED = {
    "path": Gains(0.225, 0.125, 0.225, 0.125),
    "paper_like": Gains(0.072, 0.168, 0.939, 0.023),
    "tuned": Gains(0.04, 0.12, 1.4, 1.3),
}


def errors_behind(v0, speed, gap, headway, delay) -> Errors:
    """The errors of a platoon all of whose vehicles, the leader included, send and hear."""
    lead = v0.unsqueeze(-2).expand_as(speed)
    return platoon_errors(entries_ahead(v0, speed), lead, speed, gap, headway, delay)


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).unsqueeze(-1)


# -- errors ----------------------------------------------------------------------------------------


def test_errors_from_positions() -> None:
    # x0 = 100, L = 5, h = 5: places 90 and 80; the cars stand at 88 and 81 (first too far back).
    length, headway = 5.0, 5.0
    x0, x1, x2 = 100.0, 88.0, 81.0
    gap = column(x0 - x1 - length, x1 - x2 - length)
    v0, v = torch.tensor([10.0], dtype=torch.float64), column(9.0, 12.0)
    errors = errors_behind(v0, v, gap, headway, delay=0.0)
    torch.testing.assert_close(errors.gap, column(2.0, -3.0))
    torch.testing.assert_close(errors.speed, column(1.0, -3.0))
    torch.testing.assert_close(errors.leader_gap, column(2.0, x0 - x2 - 2 * 10.0))
    torch.testing.assert_close(errors.leader_speed, column(1.0, -2.0))
    # The delay acts on what is received.
    gap, v = column(5.0, 5.0), column(8.0, 8.0)
    late, now = (errors_behind(v0, v, gap, 5.0, delay) for delay in (0.005, 0.0))
    torch.testing.assert_close(late.gap - now.gap, column(-0.05, -0.04))
    torch.testing.assert_close(late.leader_gap - now.leader_gap, column(-0.05, -0.05))
    assert torch.equal(late.speed, now.speed)


def test_chains_of_a_mixed_string() -> None:
    connected = torch.tensor([[True, True, False, True, True, True], [False, True, True] * 2])
    chain = find_chains(connected, leader_sends=True)
    assert chain.first.tolist() == [[0, 0, 2, 3, 3, 3], [0, 1, 1, 3, 4, 4]]
    hears = chain.hears.squeeze(-1)
    assert hears[0].tolist() == [True, True, False, False, True, True]
    assert hears[1].tolist() == [False, False, True, False, False, True]
    assert not find_chains(connected, leader_sends=False).hears[0, 0]


# -- CACC ------------------------------------------------------------------------------------------


def test_the_law_is_a_speed_command_and_as_printed_an_acceleration() -> None:
    errors = Errors(column(1.0), column(0.5), column(2.0), column(-0.25))
    gains = Gains(0.1, 0.2, 0.03, 0.4)
    change = 0.1 * 1.0 + 0.2 * 0.5 + 0.03 * 2.0 - 0.4 * 0.25
    torch.testing.assert_close(cacc_acceleration(errors, gains, T), column(change / T))
    for speed in (2.0, 10.0):  # the law as printed adds the change to the speed
        printed = cacc_acceleration(errors, gains, T, column(speed))
        torch.testing.assert_close(printed, column(speed + change))


def closed_loop(gains: Gains, followers: int = 3) -> torch.Tensor:
    """Jacobian of one step of the platoon itself behind a steady leader, in (gap, speed)."""
    v0 = torch.tensor([10.0], dtype=torch.float64)

    def step(state: torch.Tensor) -> torch.Tensor:
        gap, speed = state[:followers, None], state[followers:, None]
        errors = errors_behind(v0, speed, gap, 5.0, 0.005)
        wanted = cacc_acceleration(errors, gains, T)
        reached, _ = advance_speed(speed, wanted, T)
        ahead, ahead_reached = errors.speed + speed, torch.cat([v0[None], reached[:-1]])
        return torch.cat([advance_gap(gap, ahead, speed, ahead_reached, reached, T), reached])

    def flat(state: torch.Tensor) -> torch.Tensor:
        return step(state).squeeze(-1)

    start = torch.cat([torch.full((followers,), 5.0), torch.full((followers,), 10.0)]).double()
    return torch.autograd.functional.jacobian(flat, start)


def test_stability_limit_agrees_with_the_eigenvalues() -> None:
    kxs = (-0.5, 0.05, 0.4, 1.0, 2.0, 5.0, 9.0)
    kvs = (-0.2, 0.02, 0.1, 0.3, 0.7, 1.2, 1.9, 1.99, 2.1, 3.0)
    seen = set()
    for kx, kv, share in itertools.product(kxs, kvs, (0.0, 0.3, 1.0)):
        gains = Gains(share * kx, share * kv, (1 - share) * kx, (1 - share) * kv)
        radius = torch.linalg.eigvals(closed_loop(gains)).abs().max()
        stable = kx > 0 and T * kx / 2 < kv < 2
        assert (radius < 1.0) == stable, (kx, kv, radius)
        seen.add(stable)
        try:
            gains.check_stable(T)
            accepted = True
        except ConfigError:
            accepted = False
        assert accepted == stable
    assert seen == {True, False}


def test_named_gains_are_stable_and_as_described() -> None:
    damping = {}
    for name, gains in NAMED.items():
        gains.check_stable(T)
        eigenvalues = torch.linalg.eigvals(closed_loop(gains, 1))
        damping[name] = float(eigenvalues.abs().max())
    # paper_like rings: a slowly decaying complex pair; tuned settles several times faster.
    pair = torch.linalg.eigvals(closed_loop(NAMED["paper_like"], 1))
    assert pair.imag.abs().max() > 0.3
    assert damping["paper_like"] > 0.94
    assert damping["tuned"] < 0.85
    # path: the California PATH gains 0.45 and 0.25, split evenly.
    path = NAMED["path"]
    assert (path.k1 + path.k3, path.k2 + path.k4) == (0.45, 0.25)


# -- reward ----------------------------------------------------------------------------------------


def test_weights_reproduce_table_iv() -> None:
    table = weight_table()  # the reward is additive in both absolute values: sums go in as they are
    assert table["reward_printed"].tolist() == [-59.70, -56.81, -9.64]
    assert table["reward_computed"].sub(table["reward_printed"]).abs().max() < 0.1


def test_one_step_reward() -> None:
    # From 10 m/s at 1 m/s² after 0.5: reaches 10.2, leader at 10.5; jerk 2.5.
    got = PlatoonReward(10.0, 20.0, 0.03, 30.0).one_step(
        column(10.0), column(0.5), column(1.0), column(10.5)[0], T
    )
    torch.testing.assert_close(got, column(-0.5 * 0.3 - 0.001 * 2.5))


@pytest.mark.parametrize(("seconds", "error"), [(0.0, 0.93), (2.0, 1.53)])
def test_one_step_reward_with_spacing(seconds, error) -> None:
    # As above, 0.9 m behind its place and a leader at 10.0 m/s: after the step it is
    # 0.9 + 0.1 (0 + 0.3) = 0.93 m behind, and falls back by 0.3 m/s.
    given = (column(10.0), column(0.5), column(1.0), column(10.5)[0], T)
    place = PlatoonPlace(column(0.9), column(10.0))
    reward = PlatoonReward(10.0, 20.0, 0.03, 30.0, 0.02, 0.5, seconds)
    got = reward.one_step(*given, place)
    wanted = -0.5 * 0.3 - 0.001 * 2.5 - 0.02 * (error / 0.5) ** 2
    torch.testing.assert_close(got, column(wanted))
    # The paper's rule knows no place.
    assert torch.equal(PlatoonReward().one_step(*given, place), PlatoonReward().one_step(*given))


# -- safe cap --------------------------------------------------------------------------------------


def brake_to_standstill(gap, speed, ahead, first, braking=3.0):
    """Follower executes ``first``, then brakes; the vehicle ahead brakes from the start."""
    least = gap
    for step in range(200):
        command = first if step == 0 else torch.full_like(speed, -braking)
        reached, _ = advance_speed(speed, command, T)
        ahead_reached, _ = advance_speed(ahead, torch.full_like(ahead, -braking), T)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, T)
        speed, ahead = reached, ahead_reached
        least = torch.minimum(least, gap)
    return gap, least


def test_the_cap_is_safe_and_tight() -> None:
    generator = torch.Generator().manual_seed(0)
    shape = (2000, 1)
    ahead = 30.0 * torch.rand(shape, generator=generator, dtype=torch.float64)
    speed = 30.0 * torch.rand(shape, generator=generator, dtype=torch.float64)
    gap = 60.0 * torch.rand(shape, generator=generator, dtype=torch.float64) + 0.5
    cap = safe_acceleration(speed, gap - 0.5, ahead, Braking(3.0, 3.0, 0.0), T)
    feasible = cap >= -3.0
    binding = feasible & (cap <= 3.0) & (speed + cap * T > 1.0)
    assert binding.sum() > 50
    assert feasible.sum() > 500
    _, least = brake_to_standstill(gap, speed, ahead, cap.clamp(-3.0, 3.0))
    # Up to the 1.5 cm by which the last, partial step of braking is longer than v²/2b.
    assert (least[feasible] >= 0.5 - 0.02).all()
    end, _ = brake_to_standstill(gap, speed, ahead, cap)
    torch.testing.assert_close(end[binding], torch.full_like(end[binding], 0.5), atol=0.04, rtol=0)
    # Tight: a little more than the cap, and the margin is gone.
    end, _ = brake_to_standstill(gap, speed, ahead, cap + 0.5)
    assert (end[binding] < 0.5).all()


# -- hybrid decision -------------------------------------------------------------------------------


def decide(rule, learned, last=0.0, winner=None, jerk_bound=30.0, cap=None, leader=10.0, **more):
    last = column(last)
    return hybrid_decision(
        column(rule),
        column(learned),
        column(10.0),
        last,
        None if winner is None else torch.tensor([[winner]]),
        torch.tensor([leader], dtype=torch.float64),
        None if jerk_bound is None else jerk_interval(last, jerk_bound, T, LIMITS),
        None if cap is None else column(cap),
        more.pop("reward", PlatoonReward()),
        T,
        LIMITS,
        **more,
    )


def test_the_larger_reward_wins_and_ties_go_to_the_rule() -> None:
    assert decide(0.0, 1.0, leader=10.2).winner.item() == 1
    assert decide(1.0, 0.0, leader=10.2).winner.item() == 0
    assert decide(0.7, 0.7).winner.item() == 0
    # Same speed error on both sides of the target; the gentler one wins.
    assert decide(1.0, -0.9).winner.item() == 1


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
def test_a_cap_brakes_where_it_cannot_know(number) -> None:
    for rule, learned, cap in ((number, 0.5, 1.0), (0.5, number, 1.0), (0.5, 0.5, number)):
        for bound in (None, 10.0):
            got = decide(rule, learned, cap=cap, jerk_bound=bound)
            assert got.acceleration.item() == -A_MAX
            assert got.capped.item()
    # Without the cap, nothing hides it.
    assert not decide(math.nan, math.nan).acceleration.isfinite()


def test_blend_only_in_the_frame_of_a_switch() -> None:
    first = decide(0.0, 1.0, leader=10.2)
    assert (first.acceleration.item(), first.switched.item()) == (1.0, False)
    again = decide(0.0, 1.0, leader=10.2, winner=1)
    assert (again.acceleration.item(), again.switched.item()) == (1.0, False)
    change = decide(0.0, 1.0, leader=10.2, winner=0)
    assert (change.acceleration.item(), change.switched.item()) == (0.5, True)
    fresh = decide(0.0, 1.0, leader=10.2, winner=-1)
    assert not fresh.switched.item()


def test_candidates_are_clamped_before_they_are_compared() -> None:
    # From −1 with J = 5: [−2, 0]. The rule's 3 becomes 0, the learned −3 becomes −2.
    got = decide(3.0, -3.0, last=-1.0, jerk_bound=5.0, leader=9.6)
    assert got.clamped.item()
    assert got.winner.item() == 1
    assert got.acceleration.item() == -2.0
    assert not decide(-0.5, -1.5, last=-1.0, jerk_bound=5.0).clamped.item()


def test_the_cap_overrides_the_jerk_bound_but_not_the_brakes() -> None:
    got = decide(3.0, 2.0, last=2.0, jerk_bound=5.0, cap=-2.5)
    assert got.capped.item()
    assert got.acceleration.item() == -2.5
    assert decide(3.0, 2.0, cap=-9.0).acceleration.item() == -A_MAX
    assert not decide(1.0, 2.0, cap=2.5).capped.item()


def test_theorem_holds_with_clamping_for_every_bound() -> None:
    # H15–H21: blended or not, the decision stays within the interval around a_{k−1}.
    generator = torch.Generator().manual_seed(1)
    shape = (5000, 1)

    def draw(scale: float = 1.0) -> torch.Tensor:
        return scale * (2.0 * torch.rand(shape, generator=generator) - 1.0)

    for bound in (5.0, 10.0, 30.0):
        last = draw(A_MAX)
        last_winner = torch.randint(-1, 2, shape, generator=generator)
        given = (draw(A_MAX), draw(A_MAX), 10.0 + draw(2.0), last, last_winner)
        leader = torch.full((1,), 10.0)
        for interval in (jerk_interval(last, bound, T, LIMITS), None):
            got = hybrid_decision(
                *given, leader, interval, None, PlatoonReward(), T, LIMITS
            ).acceleration
            jerk = (got - last).abs() / T
            violated = (jerk > bound + 1e-4).float().mean()
            if interval is not None:
                assert violated == 0.0
            elif bound < 30.0:
                assert violated > 0.05  # the literal rule does fail
            else:
                assert violated == 0.0  # vacuous: 2 a_max/T


@pytest.mark.parametrize("choice", ["better", "between", "first"])
@pytest.mark.parametrize("bound", [10.0, 30.0])
def test_no_step_earns_less_than_a_parent_would(choice, bound) -> None:
    generator = torch.Generator().manual_seed(2)
    shape = (3000, 4, 1)

    def draw(scale: float) -> torch.Tensor:
        return scale * (2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0)

    last, speed, rule, learned = draw(A_MAX), 10.0 + draw(0.5), draw(2.0), draw(2.0)
    before = torch.randint(-1, 2, shape, generator=generator)
    leader, interval = (
        torch.full((3000, 1, 1), 10.0).double(),
        jerk_interval(last, bound, T, LIMITS),
    )
    got = hybrid_decision(
        *(rule, learned, speed, last, before, leader, interval, None, PlatoonReward(), T, LIMITS),
        choice=choice,
    )

    def earned(acceleration: torch.Tensor) -> torch.Tensor:
        return PlatoonReward().one_step(speed, last, acceleration, leader, T)

    one, two = (parent.clamp(*interval) for parent in (rule, learned))
    short = torch.maximum(earned(one), earned(two)) - earned(got.acceleration)
    if choice == "better":  # the printed blend falls short, and nothing else does
        assert short[got.switched].max() > 0.01
        assert short[~got.switched].max() < 1e-12
        return
    deciding = slice(None) if choice == "between" else slice(1)
    assert short[:, deciding].max() < 1e-12
    # No point nearer to the rule would do, by trying them all.
    every = torch.lerp(one, two, torch.linspace(0.0, 1.0, 201, dtype=torch.float64))
    nearer = (every - one).abs() < (got.acceleration - one).abs() - 1e-9
    enough = earned(every) >= torch.maximum(earned(one), earned(two)) + 1e-9
    assert not (nearer & enough)[:, deciding].any()
    if choice == "first" and bound == 30.0:  # where nothing is cut, all add the same to their rule
        added = got.acceleration - rule
        free = (rule + (learned - rule)[:, :1]).abs().amax((1, 2)) < A_MAX
        torch.testing.assert_close(added[free], added[free][:, :1].expand(-1, 4, 1))
