"""Platoon controllers by behaviour: dead-beat, jerk, causality, safety, any number of followers."""

from __future__ import annotations

import time

import pytest
import torch
from helpers import POPULATION
from platoons import (
    A_MAX,
    ACTORS,
    Actor,
    T,
    cacc,
    env_of,
    hcfs,
    leader,
    play,
    ramps,
    repeated,
    whole,
    windows,
)
from tensordict import TensorDict
from torchrl.envs import check_env_specs
from torchrl.envs.utils import step_mdp

from lcc_rl.config import load
from lcc_rl.envs.factory import build_agent, build_env, build_policy
from lcc_rl.errors import ConfigError
from lcc_rl.policies import CACCPolicy, DeadBeatPolicy

# -- dead-beat -------------------------------------------------------------------------------------


def test_oracle_dead_beat_has_no_error_where_limits_are_inactive() -> None:
    # In double precision: the claim is about the law, not about rounding.
    env = env_of(ramps())
    for piece in env.transform:
        piece.double()
    given = TensorDict({("leader", "profile"): torch.arange(3).unsqueeze(-1)}, [3])
    given.set(("leader", "start"), torch.zeros(3, 1, dtype=torch.int64))
    td = env.reset(given).apply(lambda x: x.double() if x.is_floating_point() else x)
    policy, total = DeadBeatPolicy(T, A_MAX, "oracle"), 0.0
    for _ in range(100):
        td = env.step(policy(td))
        td["next"].set("reward", td["next", "reward"].double())
        total += td["next", "platoon", "leader_speed_error"].abs().sum()
        td = step_mdp(td)
    assert total < 1e-6


def test_dead_beat_on_held_speed_pays_the_total_variation() -> None:
    profiles = windows()
    series = play(profiles, DeadBeatPolicy(T, A_MAX, "hold"), 8)
    error = series["leader_speed_error"].abs().sum((0, 2))
    variation = torch.stack([profiles.record(i).diff().abs().sum() for i in range(len(profiles))])
    torch.testing.assert_close(error, 8 * variation, atol=0.1, rtol=0)
    assert variation.max() > 10.0


def test_dead_beat_orders_as_its_knowledge_does() -> None:
    profiles = windows(20)
    rewards = [
        float(play(profiles, DeadBeatPolicy(T, A_MAX, mode))["reward"].sum())
        for mode in ("hold", "causal", "oracle")
    ]
    assert rewards[0] < rewards[1] < rewards[2] < 0.0


# -- CACC ------------------------------------------------------------------------------------------


def test_gains_behave_as_described() -> None:
    error = {}
    for name in ("path", "paper_like", "tuned"):
        series = play(ramps().select([0]), cacc(name), 8)
        error[name] = float(series["leader_speed_error"].abs().sum())
        jerk = float(series["jerk"].abs().sum())
        if name == "paper_like":
            # Near the CACC row of Table IV (149.6 and 735 on the paper-like ramp).
            assert error[name] > 100
            assert jerk > 400
    assert error["tuned"] < 0.25 * min(error["path"], error["paper_like"])


def test_cacc_closes_its_gaps() -> None:
    # From disturbed gaps behind a steady leader back to equilibrium: h plus what the delay hides.
    steady = leader(torch.full((401,), 10.0))
    cfg = load("train", ["variant=cacc", "scenario.horizon=400"])
    cfg.scenario.pieces.leader.perturbation = 0.0
    env = build_env(cfg, steady, POPULATION, 4)
    td = env.reset()
    assert (td["platoon", "gap"] - 5.0).abs().max() > 0.5
    with torch.no_grad():
        end = env.rollout(400, cacc(), tensordict=td, auto_reset=False)[:, -1]["next"]
    torch.testing.assert_close(end["platoon", "gap"], torch.full((4, 6, 1), 5.0), atol=0.06, rtol=0)
    assert end["platoon", "leader_speed_error"].abs().max() < 1e-3


def test_unstable_gains_are_refused_by_the_policy() -> None:
    with pytest.raises(ConfigError, match=r"kv = k2 \+ k4 = 2\.6 must be below 2"):
        CACCPolicy(T, A_MAX, k2=1.3)


# -- jerk ------------------------------------------------------------------------------------------


def violations(series, bound: float) -> torch.Tensor:
    """Frames beyond the bound, less standstill and logged interventions of the safe cap."""
    capped = series["cap_interventions"].diff(
        dim=0, prepend=torch.zeros_like(series["cap_interventions"][:1])
    )
    stopped = series["speed"][1:] == 0.0
    return (series["jerk"].abs() > bound + 1e-2) & (capped == 0) & ~stopped


@pytest.mark.parametrize("bound", [5.0, 10.0, 30.0])
@pytest.mark.parametrize("actor", ACTORS)
def test_jerk_keeps_its_bound_over_every_window(actor, bound) -> None:
    series = play(windows(), hcfs(actor, jerk_bound=bound))
    assert not violations(series, bound).any()


def test_the_literal_rule_violates_the_bound() -> None:
    # Else the test above could not fail.
    series = play(windows(), hcfs("random", jerk_bound=10.0, clamp=False))
    assert violations(series, 10.0).float().mean() > 0.01


# -- causality -------------------------------------------------------------------------------------

FRAME = 40


def strategy(name: str) -> object:
    kind, _, mode = name.partition(" ")
    if kind == "deadbeat":
        return DeadBeatPolicy(T, A_MAX, mode)
    if kind == "hcfs":
        return hcfs("random", lookahead=mode)
    network = build_agent(load("train", ["variant=hcfs"]), POPULATION).policy
    return cacc() if kind == "cacc" else network


MODES = ("causal", "hold", "oracle")


@pytest.mark.parametrize(
    "name", ["cacc", "ddpg", *(f"{kind} {mode}" for kind in ("deadbeat", "hcfs") for mode in MODES)]
)
def test_nothing_but_the_oracle_knows_the_future(name) -> None:
    policy = strategy(name)
    past = 8.0 + torch.sin(T * torch.arange(61.0))
    other = past.clone()
    other[FRAME + 1 :] = (past[FRAME] + 0.6 * torch.arange(1.0, 21.0)).clamp(max=20.0)
    commands = []
    for record in (past, other):
        env, actions = env_of(leader(record)), []
        given = TensorDict(
            {("episode", "seed"): torch.tensor([[3]]), ("leader", "start"): torch.tensor([[0]])},
            [1],
        )
        td = env.reset(given)
        with torch.no_grad():
            for _ in range(60):
                td = env.step(policy(td))
                actions.append(td["action"])
                td = step_mdp(td)
        commands.append(torch.stack(actions))
    same = (commands[0] == commands[1]).flatten(1).all(1)
    assert same[:FRAME].all()
    assert bool(same[FRAME]) == ("oracle" not in name)
    assert not same[FRAME + 1 :].all()


# -- safety ----------------------------------------------------------------------------------------


def hard_brake():
    """From 20 m/s at 3 m/s² to standstill, after 4 s."""
    speed = (20.0 - 3.0 * (T * torch.arange(101.0) - 4.0).clamp(min=0.0)).clamp(min=0.0)
    return leader(speed)


@pytest.mark.parametrize("rule", ["tuned", "paper_like"])
@pytest.mark.parametrize("bound", [5.0, 30.0])
def test_no_collision_over_windows_and_hard_braking(rule, bound) -> None:
    for profiles in (windows(), hard_brake()):
        series = play(repeated(profiles, 3), hcfs("mixed", rule, jerk_bound=bound))
        assert series["gap"].min() > 0.0
    # The bad and the random actor did put the cap to the test.
    assert series["cap_interventions"][-1].sum() > 0


def test_no_collision_over_the_whole_udds_at_half_and_full_speed() -> None:
    profiles = whole(("udds", 0.5), ("udds", 1.0))
    series = play(repeated(profiles, 3), hcfs("mixed"), 6)
    assert series["gap"].min() > 0.0


def test_no_collision_behind_measured_leaders(shared_data) -> None:
    files = [shared_data / f"leader_openacc_platoon{n}_10hz.csv" for n in (3, 10)]
    if not all(file.is_file() for file in files):
        pytest.skip(f"no OpenACC leaders in {shared_data}")
    series = play(repeated(whole(*((str(file), 1.0) for file in files)), 3), hcfs("mixed"), 6)
    assert series["gap"].min() > 0.0


def test_without_the_cap_it_drives_through_its_predecessor() -> None:
    # The reward has no spacing term: an actor 10 cm/s too fast wins every frame against CACC.
    steady = leader(8.0 + 1.5 * torch.sin(T * torch.arange(651.0) / 3.0))
    literal = play(steady, hcfs("hasty", "path", safe_cap=False), 3)
    assert literal["gap"].min() <= 0.0
    safe = play(steady, hcfs("hasty", "path"), 3)
    assert safe["gap"].min() > 0.4


# -- the hybrid as a policy ------------------------------------------------------------------------


def test_switching_state_is_carried_by_the_tensordict() -> None:
    policy, profiles = hcfs("random"), ramps()
    series = play(profiles, policy)
    env = env_of(profiles)
    given = TensorDict({("episode", "seed"): torch.arange(3).unsqueeze(-1)}, [3])
    given.set(("leader", "profile"), torch.arange(3).unsqueeze(-1))
    given.set(("leader", "start"), torch.zeros(3, 1, dtype=torch.int64))
    with torch.no_grad():
        data = env.rollout(100, policy, tensordict=env.reset(given), auto_reset=False)
    for name in ("winner", "switches", "clamps", "cap_interventions"):
        assert torch.equal(data["hybrid", name].squeeze(-1).transpose(0, 1), series[name]), name
    # Counted from the record of winners: a change is a switch.
    changes = (series["winner"].diff(dim=0) != 0).sum(0)
    assert torch.equal(series["switches"][-1], changes)
    assert changes.sum() > 10
    # A new episode begins anew, whatever is left in the TensorDict from the one before.
    td = data[:, -1].exclude("next")
    td["episode", "step"].zero_()
    again = policy(td.clone())
    assert (again["hybrid", "switches"] == 0).all()


def test_keeps_no_state_of_its_own() -> None:
    policy = hcfs("random")
    one, two = (play(ramps(), policy) for _ in range(2))
    for name, value in one.items():
        assert torch.equal(value, two[name]), name


def test_any_two_policies_make_a_hybrid() -> None:
    series = play(ramps(), hcfs(cacc("paper_like")))
    parents = [play(ramps(), cacc(name))["reward"].sum() for name in ("tuned", "paper_like")]
    assert series["reward"].sum() >= max(parents) - 0.1 * abs(max(parents))


def test_the_hybrid_of_good_parents_is_about_as_good_as_the_better() -> None:
    profiles = windows()
    hybrid = play(profiles, hcfs("good"))["reward"].sum()
    parents = [play(profiles, p)["reward"].sum() for p in (cacc(), Actor("good"))]
    assert hybrid >= 1.1 * max(parents)  # rewards are negative: 10 %


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("controller.jerk_bound=0", "jerk_bound must be positive"),
        ("controller.lookahead=future", "causal, hold, oracle"),
        ("controller.braking=9", "braking must lie in"),
        ("controller.margin=-1", "margin"),
        ("+controller.mass=3", "mass"),
        ("gains.k2=1.9", "unstable"),
    ],
)
def test_impossible_controllers(override, words) -> None:
    cfg = load("train", ["variant=hcfs", override])
    with pytest.raises(ConfigError, match=words):
        build_policy(cfg, build_agent(cfg, POPULATION).policy)


# -- any number of followers -----------------------------------------------------------------------


@pytest.mark.parametrize("followers", [1, 8, 100])
@pytest.mark.parametrize("batch", [1, 512])
def test_any_number_of_followers_and_any_batch(followers, batch) -> None:
    profiles = repeated(ramps().select([1]), batch)
    cfg = load("train", ["variant=hcfs"])
    policy = build_policy(cfg, build_agent(cfg, POPULATION).policy)
    env = env_of(profiles, followers, horizon=5)
    td = env.rollout(5, policy, break_when_any_done=False)
    assert td["action"].shape == (batch, 5, followers, 1)
    assert td["next", "reward"].shape == (batch, 5, followers, 1)
    assert torch.isfinite(td["next", "reward"]).all()


@pytest.mark.parametrize("followers", [1, 5])
def test_specs(followers) -> None:
    check_env_specs(env_of(ramps(), followers), break_when_any_done="both")


def test_many_followers_cost_little_each() -> None:
    spent = {}
    for followers, batch in ((8, 1), (100, 512)):
        env = env_of(repeated(ramps().select([1]), batch), followers)
        td, policy, each = env.reset(), hcfs(cacc("path")), []
        with torch.no_grad():
            for _ in range(8):
                begun = time.perf_counter()
                td = step_mdp(env.step(policy(td)))
                each.append(time.perf_counter() - begun)
        spent[followers] = min(each) / (followers * batch)
    assert spent[100] <= spent[8] / 20
