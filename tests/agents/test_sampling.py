"""Held actions, discounts by time, rules under a policy and objectives of learners from samples."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import (
    POPULATION,
    check_refused,
    check_resuming,
    compose,
    make_agent,
    small_loop,
    wavy_profiles,
)
from tensordict import TensorDict

from lcc_rl.agents.collecting import LIMITED, decisions, n_step_returns, of_decisions, transitions
from lcc_rl.agents.factory import check_lengths, make_trainer, training_env
from lcc_rl.agents.sampling import Returns
from lcc_rl.envs import make_env
from lcc_rl.errors import ConfigError
from lcc_rl.pieces.base import ACTION, OBSERVATION, REWARD, SEED, STEP

LEARNERS = ("ppo", "sac", "td3", "ddpg")


def test_a_decision_sums_the_rewards_up_to_a_collision() -> None:
    # One environment and six steps; a collision in the second step begins an episode in the third.
    hit = torch.tensor([0, 1, 0, 0, 0, 0]).bool().view(1, 6, 1)
    step = torch.tensor([0, 1, 0, 1, 2, 3]).view(1, 6, 1)
    number = torch.arange(6.0).view(1, 6, 1, 1)
    batch = TensorDict(batch_size=[1, 6])
    for key, value in {OBSERVATION: number, ACTION: number, STEP: step}.items():
        batch.set(key, value)
    after = {OBSERVATION: number + 1.0, REWARD: number + 1.0, ("done",): hit, ("terminated",): hit}
    after[LIMITED[1:]] = torch.cat([number, number + 1.0], -1)
    for key, value in after.items():
        batch.set(("next", *key), value)
    assert decisions(batch, 1) is batch
    rows = of_decisions(transitions(decisions(batch, 3)))  # the second part begins at step 1
    assert rows["observation"].tolist() == [[0.0]]
    assert rows["next", "reward"].tolist() == [[3.0]]
    assert rows["next", "terminated"].tolist() == [[True]]
    rows = of_decisions(transitions(decisions(batch, 2)))
    assert rows["action"].flatten().tolist() == [0.0, 2.0, 4.0]
    assert rows["next", "reward"].flatten().tolist() == [3.0, 7.0, 11.0]
    assert rows[LIMITED].tolist() == [[1.0, 3.0], [5.0, 7.0], [9.0, 11.0]]
    assert rows["next", "observation"].flatten().tolist() == [2.0, 4.0, 6.0]
    rows = transitions(n_step_returns(batch, 3, 0.5))  # to the collision, or the batch's end
    assert rows["next", "reward"].flatten().tolist() == [2.0, 2.0, 6.25, 8.0, 8.0, 6.0]
    assert rows[LIMITED][2].tolist() == [4.5, 6.25]
    assert rows["next", "observation"].flatten().tolist() == [2.0, 2.0, 5.0, 6.0, 6.0, 6.0]
    assert rows["next", "terminated"].flatten().tolist() == [True, True] + [False] * 4
    assert rows["steps_to_next_obs"].flatten().tolist() == [2, 1, 3, 3, 2, 1]


def test_an_action_is_executed_until_the_next_decision() -> None:
    env = make_env("alcc", 2, ["scenario.controllers.automated.hold=0.3"], seed=1, single=False)
    played = env.rollout(9, policy=None)
    drawn, found = played[ACTION], played["next", "automated", "command"]
    expected = 3.0 * drawn.clamp(-1.0, 1.0)[:, [0, 0, 0, 3, 3, 3, 6, 6, 6]]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("agent", LEARNERS)
def test_a_network_on_a_rule_is_the_rule_at_first(agent: str) -> None:
    words = (f"agent={agent}", "agent.hold=0.5", "agent.horizon=10")
    residual = make_agent(compose("alcc", *words, "agent.policy=residual_idm"))
    assert residual.gamma == pytest.approx(math.exp(-0.05))
    seen = torch.rand(5, 7)
    torch.testing.assert_close(residual.policy.module(seen), residual.rule(seen))


def test_a_network_moves_a_rule_within_its_bound(tmp_path, monkeypatch) -> None:
    words = ("agent=ppo", "agent.policy=residual_idm", "agent.bound=0.1", "agent.sigma=5")
    sizes = ("scenario.horizon=20", "training.segment=20", "training.environments=4")
    loop = small_loop(tmp_path, *words, *sizes, "training.episodes=4")
    parts = []

    def learn(batch: TensorDict, before: int) -> dict[str, float]:
        parts.append(batch.get(ACTION))
        return {"loss_value": 0.0}

    monkeypatch.setattr(loop, "learn", learn)
    loop.run()
    assert parts[0].abs().max() > 0.9  # what the network adds, as a share of the bound
    agent, seen = loop.agent, torch.rand(50, 1, 7)
    drawn = TensorDict({}, [50])
    clock = torch.arange(50).unsqueeze(-1)
    for key, value in {OBSERVATION: seen, SEED: clock, STEP: clock}.items():
        drawn.set(key, value)
    away = (agent.noise(drawn).get(ACTION) - agent.rule(seen)).abs()
    assert 0.09 < away.max() < 0.1 + 1e-6
    agent.policy.module.network[-1].bias.data.fill_(50.0)
    away = agent.policy.module(seen) - agent.rule(seen)
    assert 0.09 < away.max() < 0.1 + 1e-6


@pytest.mark.parametrize(("agent", "terms"), [("ppo", "alcc_ppo"), ("td3", "limits")])
def test_prices_of_limits_are_recorded_and_resume(tmp_path, agent: str, terms: str) -> None:
    words = (f"agent={agent}", f"surrogates@agent={terms}", "agent.policy=residual_idm")
    sizes = ("scenario.horizon=20", "training.segment=10", "agent.hold=0.5", "agent.batch_size=8")
    sizes += (
        "agent.scale_rewards=true",
        "training.environments=4",
        "training.episodes=24",
        "training.checkpoint_every=2",
    )
    record = check_resuming(lambda folder: small_loop(folder, *words, *sizes), tmp_path)
    assert {"limit_efficiency", "share_efficiency", "reward_cav_energy"} <= {*record.columns}
    assert record["price_efficiency"].nunique() > 1


def test_drawn_rewards_have_the_present_prices_of_limits(tmp_path, monkeypatch) -> None:
    words = ("agent=td3", "surrogates@agent=limits", "scenario.horizon=20", "agent.hold=0.5")
    words += ("training.segment=20", "training.environments=4", "agent.batch_size=8")
    words += ("training.gap_range=[0.05,3.0]", "agent.updates_per_transition=1")

    def drawn(*overrides: str, stored_at: float = 1.0) -> torch.Tensor:
        loop = small_loop(tmp_path, *words, *overrides)
        prices, rewards = loop.agent.objective.limits.logarithms, []

        def update(batch: TensorDict) -> dict[str, torch.Tensor]:
            rewards.append(batch["next", "reward"].clone())
            return dict.fromkeys(("loss_actor", "loss_value"), torch.zeros(()))

        monkeypatch.setattr(loop.agent, "update", update)
        source, now = loop.source(), {"safety": math.log(3.0), "efficiency": math.log(2.0)}
        for given in (dict.fromkeys(now, math.log(stored_at)), now):
            prices.update({name: given[name] for name in prices})
            loop.iterate(source)
        kept = loop.buffer.columns.get(LIMITED)
        assert kept is None or kept[0].any(0).all()  # both limits are missed
        return torch.cat(rewards[-16:])

    fixed = ("agent.limits={safety:null,efficiency:null}", "agent.surrogates.safety.weight=1.5")
    expected = drawn(*fixed, "agent.surrogates.efficiency.weight=16")
    for price in (1e-6, 1.0, 9.0):
        torch.testing.assert_close(drawn(stored_at=price), expected, rtol=1e-4, atol=1e-5)


def test_the_scale_of_rewards_is_that_of_discounted_sums() -> None:
    reward, done = torch.randn(2, 6, 3, 1), torch.zeros(2, 6, 1, dtype=torch.bool)
    done[0, 2] = True
    returns, sums = Returns(0.5), []
    for environment in range(2):
        last = torch.zeros(3)
        for step in range(6):
            last = reward[environment, step, :, 0] + 0.5 * last
            sums.append(last)
            last = last * ~done[environment, step]
    middle = returns.add(reward[:, :4], done[:, :4], 0.0)
    returns.add(reward[:, 4:], done[:, 4:], middle)
    expected = torch.stack(sums).double().std(correction=0)
    torch.testing.assert_close(returns.deviation(), expected, rtol=1e-5, atol=0.0)


def test_nothing_is_learned_from_the_time_of_human_drivers(tmp_path, monkeypatch) -> None:
    words = ("scenario=ring", "scenario.string=automated human*3", "agent=ppo", "agent.hold=0.5")
    words += ("agent.humans_first=2", "scenario.horizon=20")
    sizes = ("training.environments=2", "training.episodes=2")

    def begins(segment: int) -> list[int]:
        cfg = compose("alcc", *words, *sizes, f"training.segment={segment}")
        env = training_env(cfg, wavy_profiles(), POPULATION)
        loop, steps = make_trainer(cfg, make_agent(cfg), env, tmp_path), []

        def learn(batch: TensorDict, before: int) -> dict[str, float]:
            steps.append(int(batch.get(STEP)[0, 0]))
            return {"loss_value": 0.0}

        monkeypatch.setattr(loop, "learn", learn)
        loop.run()
        return steps

    assert begins(10) == [20, 30]
    check_refused(begins, ((40, "training.segment must divide the steps of agent.humans_first"),))


def test_what_does_not_fit_is_refused() -> None:
    def built(*words: str) -> None:
        cfg = compose("alcc", "agent=ppo", "training.segment=20", *words)
        check_lengths(cfg)
        make_agent(cfg)

    cases = (
        ("agent.policy=idm", "only agent=analytic learns the constants.*residual_idm"),
        ("agent.policy=residual_none", "agent.policy"),
        ("agent.hold=0.15", "agent.hold"),
        ("agent.hold=0.3", r"agent.hold \(3 steps\) must divide training.segment \(20\)"),
        ("evaluation.warm_up=60", "evaluation.warm_up must be below the 2 s of an episode"),
        ("agent.limits.jerk=0.1", "agent.limits.jerk=0.1 has no effect: the reward has no term"),
    )
    check_refused(built, cases)
    words = ("training.segment=10", "agent.n_step=4", "agent.hold=0.5")
    with pytest.raises(ConfigError, match=r"agent.n_step \(20 steps with agent.hold\) must not"):
        check_lengths(compose("alcc", "agent=td3", *words))
