"""The string of vehicles: views, sections, places, one motion for all, and mixed roles."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import ACTION, POPULATION, REWARD, compose, small_env, string, wavy_profiles
from torch import Tensor

from lcc_rl.config.nodes import Node
from lcc_rl.envs import build_env
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.functional.string import advance_string
from lcc_rl.pieces import Calm, Collision, FollowerStopper, Observation, PISaturation, parse_string
from lcc_rl.pieces.sections import Sections
from lcc_rl.pieces.views import Views
from lcc_rl.pieces.world import World

MIXED = "human automated*2 human"


def entries(count: int) -> dict[tuple[str, ...], Tensor]:
    """Speeds 1, 2, … and gaps 10, 20, … from front to back; the leader drives 100 m/s."""
    place = torch.arange(1.0, count + 1).view(1, count, 1)
    return {
        ("vehicles", "speed"): place,
        ("vehicles", "gap"): 10.0 * place,
        ("leader", "speed"): torch.tensor([[100.0]]),
        ("next", "vehicles", "speed"): place + 0.5,
        ("episode", "step"): torch.tensor([[7]]),
        ("preview", "speed"): torch.tensor([[[3.0, 4.0]]]),
    }


def seen(pattern: str, names: list[str], road: str = "open", behind: int = 1) -> list[list]:
    known = parse_string(pattern, road)
    views = Views(known, "automated", names, behind)
    values = entries(len(known))
    return [entry[0].tolist() for entry in views(*(values[key] for key in views.keys))]


def test_views_by_name() -> None:
    names = ["self.gap", "ahead.speed", "behind.speed", "behind.present", "leader.speed"]
    assert seen(MIXED, names) == [
        [[20.0], [30.0]],
        [[1.0], [2.0]],
        [[3.0], [4.0]],
        [[1.0], [1.0]],
        [[100.0]],
    ]
    assert seen(MIXED, ["next.self.speed", "episode.step", "preview.speed"]) == [
        [[2.5], [3.5]],
        [[7]],
        [[3.0, 4.0]],
    ]


def test_the_first_one_sees_the_leader_and_the_last_one_nobody_behind() -> None:
    names = ["ahead.speed", "behind.speed", "behind.present"]
    assert seen("automated human automated", names) == [
        [[100.0], [2.0]],
        [[2.0], [0.0]],
        [[1.0], [0.0]],
    ]
    assert seen("automated", names) == [[[100.0]], [[0.0]], [[0.0]]]


def test_a_ring_wraps() -> None:
    names = ["ahead.speed", "behind.speed", "behind.present"]
    assert seen("automated human automated", names, "ring") == [
        [[3.0], [2.0]],
        [[2.0], [1.0]],
        [[1.0], [1.0]],
    ]
    assert seen("automated human automated", ["behind.speed"], "ring", behind=2) == [
        [[2.0, 3.0], [1.0, 2.0]]
    ]


def test_a_raw_observation_is_in_si_units() -> None:
    scales = {"self": {"speed": 0.1, "gap": 0.5}, "behind": {"speed": 0.1}}
    pair = World(parse_string("automated human"))
    scaled, raw = (Observation(scales=scales, raw=x).bind(pair).factors for x in (False, True))
    assert scaled.tolist() == pytest.approx([0.1, 0.5, 0.1])
    assert raw.tolist() == [1.0, 1.0, 1.0]


def test_an_entry_says_whether_somebody_is_behind_only_where_that_may_differ() -> None:
    scales = {"self": {"speed": 0.1}, "behind": {"speed": 0.1, "gap": 0.1}}

    def width(pattern: str, road: str = "open", visible: int = 1) -> int:
        seen = Observation(scales=scales, visible=visible)
        return seen.bind(World(parse_string(pattern, road))).event_shape[-1]

    assert width("automated human") == 3
    assert width("automated human automated") == 4
    assert width("automated human automated", "ring") == 3
    assert width("automated human", visible=2) == 1 + 2 * 2 + 2
    piece = Observation(scales=scales).bind(World(parse_string("automated human automated")))
    values = entries(3)
    got = piece.computed([values[key] for key in piece.in_keys])[0]
    expected = torch.tensor([[0.1, 0.2, 2.0, 1.0], [0.3, 0.0, 0.0, 0.0]])
    torch.testing.assert_close(got, expected)


# -- drawn places ----------------------------------------------------------------------------------

FIXED = parse_string("human automated human*2 automated")


@pytest.mark.parametrize("ring", [False, True])
@pytest.mark.parametrize("of", ["vehicles", "human"])
def test_sections_sum_the_same_of_fixed_and_drawn_places(ring, of) -> None:
    fixed, drawn = (VehicleString(FIXED.roles, drawn=d, ring=ring) for d in (False, True))
    entry = torch.tensor([1.0, 10.0, 100.0, 1000.0, 10000.0]).view(1, 5, 1)
    entry = entry[:, list(FIXED.places("human"))] if of == "human" else entry
    index = {role: torch.tensor([FIXED.places(role)]) for role in FIXED.names}
    one, two = Sections(fixed, of), Sections(drawn, of)
    assert two.keys == [(role, "index") for role in ("automated", of) if role != "vehicles"]
    expected = [[1100.0], [1.0 if ring else 0.0]]
    assert one.sum(entry)[0].tolist() == expected
    assert two.sum(entry, *(index[key[0]] for key in two.keys))[0].tolist() == expected


def test_fixed_and_drawn_places_give_the_same_numbers() -> None:
    """The same arrangement, by a pattern and by what was drawn for an episode."""
    mixture = "scenario.string={size: 4, penetration: 0.5}"
    env = small_env("reference", 16, [mixture, "scenario.controllers.human.noise=0"], seed=3)
    td = env.reset()
    patterns = [tuple(row) for row in td["automated", "index"].tolist()]
    assert len(set(patterns)) >= 4
    for episode in (0, 5):
        places = patterns[episode]
        pattern = " ".join("automated" if p in places else "human" for p in range(4))
        other = small_env("reference", 16, [string(pattern), "scenario.controllers.human.noise=0"])
        given = td.select(("episode", "seed"), ("leader", "profile"), ("leader", "start")).clone()
        given.set(("human", "driver"), td["human", "driver"])
        start = other.reset(options=given)
        runs = []
        for one, begun in ((env, td), (other, start)):
            state = begun.clone()
            for _ in range(5):
                state = one.step(state.set(ACTION, torch.full((16, 2, 1), 0.3)))["next"]
            runs.append(state)
        drawn, fixed = (run[episode] for run in runs)
        names = ("speed", "gap", "relative_speed", "acceleration", "jerk", "power", "time_gap")
        for key in [*(("vehicles", name) for name in names), ("automated", "observation")]:
            torch.testing.assert_close(drawn[key], fixed[key], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(drawn[REWARD], fixed[REWARD], rtol=1e-5, atol=1e-5)
        assert drawn["automated", "index"].tolist() == fixed["automated", "index"].tolist()


def test_places_are_drawn_evenly_anew_in_every_episode_and_repeat_with_its_seed() -> None:
    env = small_env("reference", 400, ["scenario.string={size: 6, penetration: 0.34}"])
    td = env.reset()
    index, humans = td["automated", "index"], td["human", "index"]
    everybody = torch.cat([index, humans], -1).sort(-1).values
    assert torch.equal(everybody, torch.arange(6).expand(400, 6))
    assert (index.diff(dim=-1) > 0).all()
    counts = torch.bincount(index.flatten(), minlength=6)
    assert counts.min() > 95  # 133 expected, 9.4 their standard deviation
    again = env.reset(options=td.select(("episode", "seed")))
    assert torch.equal(again["automated", "index"], index)
    assert not torch.equal(env.reset()["automated", "index"], index)


# -- motion ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("ring", [False, True])
def test_motion_equals_a_plain_loop_over_the_vehicles(ring) -> None:
    chance = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=chance, dtype=torch.float64)

    speed, gap = 3.0 * draw(8, 5, 1), 1.0 + 20.0 * draw(8, 5, 1)
    command, last = 20.0 * (draw(8, 5, 1) - 0.7), draw(8, 5, 1)
    leader, reached = (None, None) if ring else (3.0 * draw(8, 1), 3.0 * draw(8, 1))
    found = advance_string(speed, gap, last, command, leader, reached, 0.1)
    assert (found.speed == 0.0).any()  # some stop
    ends = [advance_speed(speed[:, i], command[:, i], 0.1) for i in range(5)]
    for i in range(5):
        ahead = speed[:, i - 1] if ring or i else leader
        ahead_reached = ends[i - 1][0] if ring or i else reached
        end, executed = ends[i]
        expected = (
            end,
            advance_gap(gap[:, i], ahead, speed[:, i], ahead_reached, end, 0.1),
            ahead_reached - end,
            executed,
            (executed - last[:, i]) / 0.1,
        )
        for name, value, wanted in zip(found._fields, found, expected, strict=True):
            torch.testing.assert_close(value[:, i], wanted, msg=name)


def test_contact_of_any_two_vehicles_ends_the_episode() -> None:
    # Three episodes of two vehicles: 1 cm is no contact, 0 is, and so is less.
    gap = torch.tensor([[5.0, 0.01], [5.0, 0.0], [-0.1, 5.0]]).unsqueeze(-1)
    running = torch.zeros(3, 1, dtype=torch.bool)
    done, terminated = Collision().compute(running, running, gap)
    assert terminated.flatten().tolist() == [False, True, True]
    assert torch.equal(done, terminated)


# -- rules -----------------------------------------------------------------------------------------


def test_follower_stopper_by_region() -> None:
    cases = [  # speed, gap, speed ahead, wanted
        (5.0, 4.0, 5.0, 0.0),  # nearer than 4.5 m
        (5.0, 4.875, 5.0, 2.5),  # half way from 4.5 to 5.25 m: half of the speed ahead
        (5.0, 5.25, 5.0, 5.0),
        (5.0, 5.625, 5.0, 6.5),  # half way from 5.25 to 6 m: half way from 5 to 8 m/s
        (5.0, 6.0, 5.0, 8.0),
        (5.0, 99.0, 5.0, 8.0),
        (5.0, 5.25, 20.0, 8.0),  # never faster than the desired speed
        (0.0, 5.0, -1.0, 0.0),  # nor backwards
        # Closing at 3 m/s the gaps grow by 9/(2·1.5) = 3, 9/2 = 4.5 and 9/1 = 9 m.
        (8.0, 7.4, 5.0, 0.0),
        (8.0, 0.5 * (7.5 + 9.75), 5.0, 2.5),
        (8.0, 0.5 * (9.75 + 15.0), 5.0, 6.5),
        (8.0, 15.1, 5.0, 8.0),
    ]
    *state, wanted = torch.tensor(cases, dtype=torch.float64).T
    piece = FollowerStopper(time_gaps=(0.0, 0.0, 0.0))  # the original form
    torch.testing.assert_close(piece.wanted(*state, torch.full_like(wanted, 8.0)), wanted)


def test_follower_stopper_keeps_time_gaps_and_its_limits() -> None:
    piece = FollowerStopper(desired_speed=30.0).bind()

    def column(*values: float) -> Tensor:
        return torch.tensor(values).view(-1, 1, 1)

    # At 20 m/s: 0.4, 0.6 and 0.8 s are 8, 12 and 16 m. 10 m: half of 20 m/s; 14 m: 25 m/s.
    wanted = [0.0, 10.0, 25.0, 30.0]
    gap, speed = column(7.0, 10.0, 14.0, 17.0), column(*[20.0] * 4)
    got = piece.compute(speed, gap, speed)
    limited = [min(max((v - 20.0) / 0.1, -3.0), 1.5) for v in wanted]
    assert got.flatten().tolist() == pytest.approx(limited)
    slow = (
        FollowerStopper(desired_speed=30.0).bind(World(time_step=10.0)).compute(speed, gap, speed)
    )
    assert slow.flatten().tolist() == pytest.approx([(v - 20.0) / 10.0 for v in wanted])


def test_follower_stopper_desires_its_own_mean_speed() -> None:
    piece = FollowerStopper(window=3.0).bind(World(time_step=1.0))
    history, ahead, gap = torch.zeros(1, 1, 3), torch.full((1, 1, 1), 50.0), 1e3
    # The mean of what was driven, from the first step on.
    for step, (speed, mean) in enumerate(((3.0, 3.0), (6.0, 4.5), (9.0, 6.0), (9.0, 8.0))):
        own, at = torch.full((1, 1, 1), speed), torch.full((1, 1, 1), step)
        command, history = piece.compute(own, torch.full_like(own, gap), ahead, at, history)
        assert float(command) == pytest.approx(min(max(mean - speed, -3.0), 1.5))


def test_a_handover_switches_at_its_moment() -> None:
    human = compose("idm", "controller@scenario.controllers.automated=human")
    node = {
        "_target_": "lcc_rl.pieces.Handover",
        "before": human.scenario.controllers["automated"],
        "after": {"_target_": "lcc_rl.pieces.ConstantAcceleration", "acceleration": 0.25},
        "from_s": 1.0,
    }
    commands = []
    for cfg in (human, human.driven_by(Node.of(node, "automated"))):
        env = build_env(cfg, wavy_profiles(), POPULATION, 4)
        commands.append(env.rollout(20)["next", "vehicles", "command"][..., 0, 0])
    # Until then it drives as the human driver would who has the same numbers.
    assert torch.equal(commands[1][:, :10], commands[0][:, :10])
    assert not (commands[1][:, :10] == 0.25).any()
    assert (commands[1][:, 10:] == 0.25).all()


def test_calm_follows_its_formula() -> None:
    constants = {"gain": 0.02, "gap": 12.0, "time_gap": 1.2, "response": 2.0}
    piece = Calm(window=2.0, max_acceleration=50.0, max_deceleration=50.0, **constants)
    piece = piece.bind(World(time_step=1.0, max_braking=50.0, max_acceleration=50.0))
    history, speed = torch.zeros(1, 4, 2), torch.full((1, 4, 1), 4.0)
    gap = torch.tensor([10.0, 62.0, 5.0, 5.0]).view(1, 4, 1)
    relative = torch.tensor([0.0, 0.0, 0.0, -3.0]).view(1, 4, 1)
    command, past = piece.command(speed, gap, relative, torch.zeros(1, 1, 1), history)
    # The mean is 4 m/s; 50 m above 12 m add 1 m/s; 3 m above 2 m allow 2.5 m/s, but none where
    # 3 m are needed to brake. Half of the difference is the command.
    assert command.flatten().tolist() == pytest.approx([0.0, 0.5, -0.75, -2.0])
    slower, _ = piece.command(0.5 * speed, gap, relative, torch.ones(1, 1, 1), past)
    assert slower.flatten().tolist()[:2] == pytest.approx([0.5, 1.0])  # the mean is now 3 m/s


def test_calm_follows_a_leader_without_jerk_or_contact() -> None:
    """A leader that slows from 19 to 3 m/s and speeds up again, as in waves of a motorway."""
    piece = Calm().bind(World())
    speed, gap, before = torch.full((1, 1, 1), 11.0), torch.full((1, 1, 1), 20.0), 0.0
    history, jerks, gaps = torch.zeros(1, 1, 150), [], []
    for step in range(1200):
        ahead = 11.0 + 8.0 * math.sin(2.0 * math.pi * step / 600.0)
        at = torch.full((1, 1, 1), step)
        command, history = piece.command(speed, gap, ahead - speed, at, history)
        command = command.clamp(*piece.limits)
        gap = gap + 0.1 * (ahead - speed - 0.05 * command)
        speed = (speed + 0.1 * command).clamp(min=0.0)
        jerks.append(abs(command.item() - before) / 0.1)
        gaps.append(gap.item())
        before = command.item()
    assert max(jerks) < 20.0  # 43 m/s³ with a command that reaches v_cmd in one step
    assert min(gaps) > 2.0


def test_pi_saturation_follows_its_formula() -> None:
    piece = PISaturation(window=2.0, max_acceleration=50.0, max_deceleration=50.0)
    piece = piece.bind(World(time_step=1.0, max_braking=50.0, max_acceleration=50.0))
    history, before = torch.zeros(1, 4, 2), torch.full((1, 4, 1), 9.0)
    speed, ahead = torch.full((1, 4, 1), 10.0), torch.tensor([10.0, 12.0, 10.0, 4.0]).view(1, 4, 1)
    gap = torch.tensor([40.0, 18.5, 5.0, 3.0]).view(1, 4, 1)
    step = torch.zeros(1, 1, 1)
    command, _, wanted = piece.command(speed, gap, ahead, step, history, before)
    # At the first step the command before is the own speed; the targets are 11, 10.5, 10 and 10.
    # Δx_s is 4, 4, 4 and 2·6 = 12 m, so α is 1, 1, ½ and 0 and β 0.5, 0.5, 0.75 and 1.
    expected = [10.5, 10.25, 0.75 * (0.5 * 10.0 + 0.5 * 10.0) + 0.25 * 10.0, 4.0]
    assert wanted.flatten().tolist() == pytest.approx(expected)
    assert command.flatten().tolist() == pytest.approx([v - 10.0 for v in expected])
    late, _, later = piece.command(speed, gap, ahead, step + 1, history, before)
    assert later.flatten().tolist()[0] == pytest.approx(0.5 * (5.0 + 1.0) + 0.5 * 9.0)
    assert late.shape == (1, 4, 1)
