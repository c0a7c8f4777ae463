"""Environments: specs, physics, determinism, compilation."""

from __future__ import annotations

import pytest
import torch
from commands import tiny
from helpers import (
    ACTION,
    POPULATION,
    REWARD,
    TERMS,
    VARIANTS,
    compose,
    network,
    small_env,
    steady,
    wavy_profiles,
)
from tensordict import TensorDict
from torchrl.envs import check_env_specs
from torchrl.envs.utils import step_mdp

from lcc_rl.drivers.population import DriverPopulation, fixed
from lcc_rl.envs import load_inputs
from lcc_rl.functional.power import motor_power

T = 0.1


def play(env, actions):
    """Step through actions ``[time, *batch, A, 1]`` without resets; returns the list of moments."""
    td = env.reset()
    return [td, *play_from(env, td, actions)]


def test_specs(subtests) -> None:
    for number, variant in enumerate(VARIANTS):
        with subtests.test(variant=variant):
            env = small_env(variant, (3, ())[number % 2])
            check_env_specs(env, break_when_any_done="both")


def test_rollout_follows_the_equations() -> None:
    env = small_env("alcc", 5, ["scenario.controllers.human.noise=0"])
    data = env.rollout(20, break_when_any_done=False)
    leader, speed, gap = data["leader"], *(data["vehicles", x] for x in ("speed", "gap"))
    after = data["next"]
    cav, reached = speed[..., 0, :], after["vehicles", "speed"][..., 0, :]
    # The automated vehicle moves by its action: v' = v + 3·action·T unless it stops.
    moved = (cav + 3.0 * data[ACTION][..., 0, :] * T).clamp(min=0.0)
    torch.testing.assert_close(reached, moved)
    # Gaps are the integral of relative speed by the trapezoidal rule.
    closing = leader["speed"] - cav + after["leader", "speed"] - reached
    torch.testing.assert_close(after["vehicles", "gap"][..., 0, :], gap[..., 0, :] + 0.05 * closing)
    # Power: A2 of the speed at the start and the acceleration executed.
    power = motor_power(speed, (after["vehicles", "speed"] - speed) / T)
    torch.testing.assert_close(after["vehicles", "power"], power, rtol=1e-3, atol=2.0)
    # The reward is the sum of its terms; energy is −P/20000·T.
    terms = after[TERMS]
    torch.testing.assert_close(after[REWARD], sum(terms.values()))
    own = after["vehicles", "power"][..., :1, :]
    torch.testing.assert_close(terms["cav_energy"], -own / 20000 * T)
    predicted = after["human", "predicted_power"].sum(-2, keepdim=True)
    torch.testing.assert_close(terms["hdv_energy"], -predicted / 20000 * T)
    assert data["human", "driver"].unique().numel() > 1


def test_initial_state() -> None:
    td = small_env("alcc", 6, nominal=True).reset()
    lead, speed, gap = td["leader", "speed"], *(td["vehicles", x] for x in ("speed", "gap"))
    assert torch.equal(speed, lead.unsqueeze(-2).expand(6, 2, 1))
    torch.testing.assert_close(gap[:, 0], 2.0 + 1.5 * lead)
    human = td["human"]
    expected = POPULATION.constants.equilibrium_gap(
        speed[:, 1:], human["desired_speed"], human["desired_time_gap"]
    )
    torch.testing.assert_close(gap[:, 1:], expected)


def test_leader_plays_the_profile_that_is_asked_for() -> None:
    env, profiles = small_env("alcc", 2), wavy_profiles()
    given = TensorDict(
        {
            ("leader", "profile"): torch.tensor([[2], [0]]),
            ("leader", "start"): torch.tensor([[7], [300]]),
            ("human", "driver"): torch.tensor([[[5]], [[9]]]),
        },
        [2],
    )
    td = env.reset(options=given)
    data = env.rollout(20, tensordict=td, auto_reset=False, break_when_any_done=False)
    expected = torch.stack([profiles.record(2)[8:28], profiles.record(0)[301:321]])
    assert torch.equal(data["next", "leader", "speed"].squeeze(-1), expected)
    drawn = POPULATION.time_gap[torch.tensor([5, 9])]
    assert torch.equal(data["human", "desired_time_gap"][:, 0].flatten(), drawn)


def test_same_seed_same_episodes_and_other_seed_others() -> None:
    a, b, c = (small_env("alcc", 4, seed=s).reset() for s in (1, 1, 2))
    assert (a == b).all()
    assert not torch.equal(a["leader", "speed"], c["leader", "speed"])


def test_episode_seed_replays_an_episode_wherever_it_stands() -> None:
    env = small_env("alcc", 4)
    actions = torch.zeros(20, 4, 1, 1)
    td = env.reset()
    seeds = td["episode", "seed"]
    first = torch.stack([m["vehicles", "speed"] for m in play_from(env, td, actions)])
    turned = env.reset(options={("episode", "seed"): seeds.flip(0)})
    second = torch.stack([m["vehicles", "speed"] for m in play_from(env, turned, actions)])
    assert torch.equal(first, second.flip(1))


def play_from(env, td, actions):
    moments = []
    for action in actions:
        td = step_mdp(env.step(td.set(ACTION, action)))
        moments.append(td)
    return moments


def test_noise_is_within_bounds_and_the_same_for_every_controller() -> None:
    quiet = small_env("alcc", 64, ["scenario.controllers.human.noise=0"], seed=3)
    noisy = small_env("alcc", 64, seed=3)
    zero = torch.zeros(1, 64, 1, 1)
    a, b = (play(env, zero)[-1]["vehicles", "acceleration"][:, 1] for env in (quiet, noisy))
    # Dividing tiny accelerations is noise of another kind.
    firm = a.abs() > 0.05
    ratio = (b / a)[firm]
    assert ((ratio > 1.0 - 1e-4) & (ratio < 1.05 + 1e-4)).all()
    assert ratio.std() > 0.005


def test_collision_terminates_and_is_penalised() -> None:
    env = small_env("alcc", 2, ["scenario.horizon=100"])
    data = env.rollout(100, steady(1.0, env), break_when_any_done=True)
    last = data[:, -1]["next"]
    crashed = last["terminated"].squeeze(-1)
    assert crashed.any()
    assert torch.equal(last["done"], last["terminated"])
    assert not last["truncated"].any()
    assert (last["vehicles", "gap"][crashed][:, 0] <= 0).all()
    penalty = data["next", *TERMS, "collision"]
    assert (penalty[:, -1][crashed] == -100.0).all()
    assert (penalty[:, :-1] == 0.0).all()


def test_horizon_truncates() -> None:
    data = small_env("idm", 2).rollout(20)
    assert data.shape == (2, 20)
    last = data[:, -1]["next"]
    assert last["truncated"].all()
    assert last["done"].all()
    assert not last["terminated"].any()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the compiler's own
def test_compiled_environment_agrees_with_eager_over_an_episode() -> None:
    policy = network(compose("alcc"))
    runs = []
    for compiled in (False, True):
        env = small_env("alcc", 64, ["scenario.horizon=300"], seed=2)
        if compiled:
            env.compile(warmup=1)
        with torch.no_grad():
            runs.append(env.rollout(300, policy, break_when_any_done=False)["next"])
    keys = (("vehicles", "gap"), ("vehicles", "speed"), ("human", "predicted_acceleration"), REWARD)
    for key in keys:
        difference = (runs[0][key] - runs[1][key]).abs()
        # Until the first collision; what follows depends on rounding.
        running = ~runs[0]["terminated"].cumsum(1).bool().unsqueeze(-1)
        assert (difference * running).max() < 1e-3 * runs[0][key].abs().max(), key


def own_drivers() -> DriverPopulation:
    """A population of a user's own."""
    return fixed(desired_speed=20.0, time_gap=1.0)


def test_the_report_says_whose_drivers_drive(subtests) -> None:
    for words, origin in [
        ("drivers=i80", "fitted to NGSIM I-80, shipped, drivers.mode=local"),
        ("drivers=fixed", "fixed"),
        (f"drivers._target_={__name__}.own_drivers", "own_drivers"),
    ]:
        with subtests.test(words=words):
            line = next(x for x in load_inputs(tiny("train", words)).report if "human drivers" in x)
            assert f" ({origin})" in line
