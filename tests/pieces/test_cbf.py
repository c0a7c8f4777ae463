"""The CBF safety filter: whatever the policy wants, the vehicle stays between its limits."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from commands import tiny
from helpers import ACTION, play, slow_but, small_env

from lcc_rl.commands import evaluation
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.metrics import safety_measures
from lcc_rl.functional.actuation import PairState, Response
from lcc_rl.functional.braking import Braking, safe_command
from lcc_rl.functional.kinematics import advance_speed
from lcc_rl.pieces import Actuation, CBFFilter
from lcc_rl.pieces.cbf import REMEMBERS
from lcc_rl.pieces.rewards import TERMS
from lcc_rl.pieces.world import World
from lcc_rl.settings import Positive

WHOLE, AUTO = "scenario.horizon=150", "scenario.filters.automated"


def driven(action: float | None, *overrides: str, places: tuple[int, ...] = (0,)):
    """Drive 32 episodes with one action throughout, or with random ones."""
    env = small_env("alcc", 32, [WHOLE, *overrides], nominal=True)
    chance = torch.Generator().manual_seed(0)
    shape = (32, len(places), 1)

    def policy(td):
        drawn = 2.0 * torch.rand(shape, generator=chance) - 1.0
        return td.set(ACTION, drawn if action is None else torch.full(shape, action))

    keys = [("vehicles", name) for name in ("ttc", "time_gap", "gap")]
    record, _ = play(env, policy, None, [*keys, ("automated", "promised")])
    promised = record.pop(("automated", "promised"), None)
    found = {name: entry[..., list(places), :] for (_, name), entry in record.items()}
    return found if promised is None else {**found, "promised": promised}


@pytest.mark.parametrize("action", [1.0, 0.0, -1.0, None])
def test_no_policy_passes_the_limits(action) -> None:
    free, held = driven(action), driven(action, "+filter=cbf")
    assert held["ttc"].min() >= 4.0
    assert held["gap"].min() > 0.1
    # The leader may pull away faster than the limit is approached, but not for long.
    assert (held["time_gap"] > 2.5).double().mean() < 0.01
    broken = (free["ttc"] < 4.0) | (free["time_gap"] > 2.5)
    assert broken.double().mean() > 0.1


@pytest.mark.parametrize(
    ("faults", "action"),
    slow_but([], [(x, y) for x in ("actuation", "sensors", "all") for y in (1.0, None)]),
)
def test_faults_need_a_filter_that_reckons_with_them(faults, action) -> None:
    both = ["+filter=cbf", f"+faults={faults}", "scenario.horizon=150"]
    blind, knows = (driven(action, *both, f"{AUTO}.robust={x}") for x in ("false", "true"))
    assert blind["ttc"].min() < 4.0
    assert "promised" not in blind  # its guarantee covers no step
    promised = knows["promised"] == 1.0
    assert promised.double().mean() > 0.9
    assert (knows["ttc"][promised] >= 4.0).all()
    assert knows["gap"].min() > 0.1


def test_what_acts_or_is_measured_late_is_a_number_of_steps() -> None:
    for option in ("actuators.automated.delay", "sensors.automated.longest_dropout"):
        with pytest.raises(ConfigError, match=f"{option} must be a multiple of the time step, 0.1"):
            small_env("alcc", 2, ["+faults=all", f"scenario.{option}=0.25"])


def test_the_gradient_passes_the_filter_that_knows_late_brakes() -> None:
    response, limits = Response.of(1, 0.3, 3.0, 0.1), Braking(3.0, 2.6, 4.0)
    gap = torch.tensor([[35.0]], dtype=torch.float64, requires_grad=True)

    def bound(x: torch.Tensor) -> torch.Tensor:
        one = torch.ones_like(x)
        return safe_command(PairState(20.0 * one, x, 15.0 * one, 0.3 * one), response, limits)

    (slope,) = torch.autograd.grad(bound(gap).sum(), gap)
    with torch.no_grad():
        expected = (bound(gap + 0.5) - bound(gap - 0.5)) / 1.0
    torch.testing.assert_close(slope, expected, rtol=0.05, atol=1e-3)


def test_a_shortest_time_gap_is_kept_where_braking_suffices() -> None:
    both = ["+filter=cbf", "scenario.filters.automated.time_to_collision=0.5"]
    limit = "scenario.filters.automated.shortest_time_gap=1.2"
    without, held = driven(1.0, *both), driven(1.0, *both, limit)
    assert (without["time_gap"] < 1.0).double().mean() > 0.2
    assert (held["time_gap"][50:] < 1.19).double().mean() < 0.01
    assert held["time_gap"][50:].median() < 1.6  # it is a limit, not a longer gap


def test_every_automated_vehicle_of_a_string_is_filtered() -> None:
    mixed = "scenario.string='human automated human automated*2 human'"
    data = driven(1.0, "+filter=cbf", mixed, places=(1, 3, 4))
    assert data["ttc"].min() >= 4.0
    assert data["promised"].shape == data["ttc"].shape
    assert data["promised"].mean() > 0.95
    assert data["gap"].min() > 0.1


def test_what_the_filter_changes_is_recorded_and_priced() -> None:
    price = "+reward.terms.held={_target_: lcc_rl.pieces.Correction, weight: 0.5}"
    env = small_env("alcc", 32, [WHOLE, "+filter=cbf", price], nominal=True)
    keys = [("automated", "correction"), ("vehicles", "command"), (*TERMS, "held")]
    record, _ = play(env, lambda td: td.set(ACTION, torch.full((32, 1, 1), 0.2)), None, keys)
    correction, command, term = (record[key] for key in keys)
    command = command[-len(correction) :, ..., :1, :]
    assert torch.allclose(correction, command - 0.6, atol=1e-6)
    assert correction.abs().max() > 0.5
    assert (correction == 0).double().mean() > 0.1  # where the filter lets it drive
    assert torch.allclose(term, -0.5 * correction.square(), atol=1e-6)


def column(*values: float) -> torch.Tensor:
    return torch.tensor(values).view(-1, 1, 1)


def test_the_limit_holds_wherever_it_is_promised(subtests) -> None:
    for expected in [0.3, 1.0, 2.6]:
        with subtests.test(expected=expected):
            data = driven(
                1.0, "+filter=cbf", f"scenario.filters.automated.braking_ahead={expected}"
            )
            promised = data["promised"] == 1.0
            assert (data["ttc"][promised] >= 4.0).all()
            assert promised.all() == (expected == 2.6)  # these leaders brake by up to 1.5 m/s²


def test_the_filter_brakes_when_it_cannot_know(subtests) -> None:
    for value in [torch.nan, torch.inf, -torch.inf]:
        for place in range(5):
            with subtests.test(value=value, place=place):
                given = [column(x, x) for x in (0.5, 8.0, 20.0, 8.0, 0.0)]
                given[place][0] = value
                command, _ = CBFFilter().bind().filtered(*given, torch.zeros(1, REMEMBERS))
                assert command[0] == -3.0
                assert command[1] == 0.5


def command(piece: CBFFilter, *given: float) -> torch.Tensor:
    """What the filter makes of a wish, own speed, gap, speed and acceleration ahead at first."""
    state = [column(x) for x in (*given, *[0.0] * (5 - len(given)))]
    return piece.filtered(*state, torch.zeros(1, REMEMBERS))[0]


def test_the_margin_counts_as_contact() -> None:
    # Both drive 5 m/s, 2.2 m apart; of that 2.2 − 0.2 = 2 m are free: 3 · 2 / (4 + 0.05) m/s².
    piece = CBFFilter(rate=3.0, margin=0.2).bind()
    held = command(piece, 3.0, 5.0, 2.2, 5.0)
    assert held.item() == pytest.approx(6.0 / 4.05, rel=1e-5)


def test_safety_wins() -> None:
    # A gap far too long, closing far too fast: the limits contradict each other.
    piece = CBFFilter(time_gap=0.5, full_speed=0.0).bind()
    assert command(piece, 3.0, 10.0, 20.0, 2.0) == -3.0


def test_below_its_margin_it_does_not_accelerate_until_the_gap_grows() -> None:
    piece = CBFFilter(margin=2.0).bind()
    for ahead, accelerates in [(0.0, False), (0.5, True)]:
        assert (command(piece, 1.0, 0.0, 1.9, ahead, 2.0) > 0.0) == accelerates


LIMITS = {"margin": 2.0, "time_gap": None, "longest_gap": 115.0, "shortest_time_gap": 1.05}
# What a leader's reported speed runs ahead of the rate of its position: for ten seconds of twenty,
# as in a record behind which a car collided [m/s]; throughout, as a share, as in a data set.
REPORTED = torch.tensor([[3.0, 0.0], [-3.0, 0.0], [0.0, 0.02], [0.0, -0.02]])
WAVES, SPEED = torch.tensor([1.0, 1.0, 0.0, 0.0]), torch.tensor([25.0, 25.0, 33.0, 33.0])


@pytest.mark.parametrize("wish", [3.0, -0.5])
def test_gaps_are_kept_whatever_speed_is_reported(wish: float) -> None:
    ahead_by, share = (x.unsqueeze(-1) for x in REPORTED.unbind(-1))
    piece, commands = CBFFilter(**LIMITS).bind(), torch.full((4, 1), wish)
    leader, wave = SPEED.unsqueeze(-1), WAVES.unsqueeze(-1)
    speed, gap, said, kept = leader, torch.full((4, 1), 60.0), leader, torch.zeros(4, REMEMBERS)
    record = []
    for step in range(1500):
        # Stop and go, a wave a minute, or a constant speed.
        reached = SPEED.unsqueeze(-1) * (1.0 - wave * math.sin(math.pi * step / 600.0) ** 2)
        before, said = said, (reached * (1.0 + share) + ahead_by * (step % 200 < 100)).clamp(min=0)
        given, kept = piece.filtered(commands, speed, gap, said, (said - before) / 0.1, kept)
        after, _ = advance_speed(speed, given, 0.1)
        gap, speed, leader = gap + 0.05 * (leader + reached - speed - after), after, reached
        record.append(gap)
    gaps = torch.cat(record, -1)
    assert gaps.amin() > 1.0
    assert gaps[:, 300:].amax() < 117.0


class Mistaken(Actuation):
    """Brakes that are not as the scenario declares."""

    actual: Positive = 1.5  # hardest braking that there is [m/s²]

    def setup(self, world: World) -> None:
        super().setup(world)
        self.response = replace(self.response, braking=self.actual)


def mistaken(actual: float, declared: float) -> str:
    given = f"actual: {actual}, braking: {declared}"
    return f"scenario.actuators={{automated: {{_target_: {__name__}.Mistaken, {given}}}}}"


@pytest.mark.parametrize(
    ("actual", "declared", "turns"), [(1.5, 3.0, True), (2.5, 2.5, False), (3.0, 1.5, False)]
)
def test_steps_that_turn_unsafe_show_wrong_actuators(
    tmp_path, actual, declared, turns, caplog
) -> None:
    cfg = tiny(
        "evaluate",
        "variant=idm",
        "+filter=cbf",
        mistaken(actual, declared),
        "evaluation.baselines=[constant_filtered]",
        "scenario.horizon=200",
        "data.duration_s=[40,50]",
        "compare=[constant_filtered]",
        agent=False,
    )
    rows = evaluation.run(cfg, tmp_path, quiet=True).set_index("strategy")
    alone = rows.loc["constant_filtered"]
    assert (alone["share_turned_unsafe"].mean() > 0.0) == turns
    assert (alone["share_promise_broken"].mean() > 0.0) == turns
    assert (alone["share_ttc_unsafe"].mean() > 0.0) == turns
    assert ("Steps that the filter's guarantee covers turn unsafe" in caplog.text) == turns


def test_a_leader_beyond_the_bound_breaks_no_promise() -> None:
    """Steps turn unsafe behind it, whoever is to blame."""
    entries = {"ttc": 3.0, "time_gap": 1.0, "gap": 9.0, "jerk": 0.0}
    series = {name: torch.full((4, 1, 1, 1), x) for name, x in entries.items()}
    series["speed"] = torch.full((5, 1, 1, 1), 9.0)
    series["safe"] = torch.tensor([1.0, 1.0, 0.0, 1.0]).view(4, 1, 1, 1)
    alive = torch.ones(4, 1, 1, 1, dtype=torch.bool)
    for promised, broken in (([1.0, 0.0, 0.0, 1.0], 0.0), ([1.0, 1.0, 0.0, 1.0], 0.25)):
        series["promised"] = torch.tensor(promised).view(4, 1, 1, 1)
        found = safety_measures(series, alive, 0.1)
        assert found["share_turned_unsafe"].item() == 0.25
        assert found["share_promise_broken"].item() == broken


def test_nothing_is_promised_before_the_filter_acts() -> None:
    data = driven(0.0, "+filter=cbf", f"{AUTO}.from_s=5")
    assert not data["promised"][:50].any()
    assert data["promised"][50:].any()
