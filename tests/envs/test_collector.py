"""StringCollector: a TorchRL collector whose transitions are those of TorchRL's own."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from helpers import TERMS, check_refused, compose, make_agent, single_env, small_env, string
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch._dynamo.utils import counters
from torchrl.collectors import BaseCollector, Collector
from torchrl.envs import Compose, RewardSum, TransformedEnv

from lcc_rl.agents.actor import GaussianExploration, shared_policy
from lcc_rl.agents.collecting import LEARNED_FROM
from lcc_rl.envs import StringCollector
from lcc_rl.envs.collector import PLAIN_RESETS
from lcc_rl.envs.step import Step, pieces_of
from lcc_rl.errors import ConfigError
from lcc_rl.pieces.base import SEED, as_key

KEYS = (*LEARNED_FROM, ("next", *TERMS), ("vehicles", "gap"))
# Half the horizon ahead is far enough to run into the leader, so that episodes end early, too.
CRASHING = ("scenario.horizon=100", "training.gap_range=[0.1,0.5]")
MIXED = "(automated human)*2"


def policy(single: bool = False):
    agent = make_agent(compose("alcc"))
    with torch.no_grad():
        agent.policy.module[0][-1].bias.fill_(0.5)  # speeds up into the leader
    if single:
        return TensorDictSequential(agent.policy, GaussianExploration(0.3, "action"))
    return TensorDictSequential(shared_policy(agent.policy), GaussianExploration(0.3))


def environment(view: str, batch: int = 8):
    if view == "single":
        return single_env("alcc", batch, CRASHING)
    return small_env("alcc", batch, [*CRASHING, *([string(MIXED)] if view == "two" else [])])


def test_transitions_are_those_of_torchrls_collector(subtests) -> None:
    for view in ["single", "one", "two"]:
        with subtests.test(view=view):
            acting, frames = policy(view == "single"), 8 * 40
            theirs = Collector(
                environment(view),
                acting,
                frames_per_batch=frames,
                total_frames=3 * frames,
                auto_register_policy_transforms=False,
            )
            ours = StringCollector(
                environment(view), acting, frames_per_batch=frames, total_frames=3 * frames
            )
            assert isinstance(ours, BaseCollector)
            seen = 0
            for wanted, batch in zip(theirs, ours, strict=True):
                assert batch.shape == (8, 40)
                # All entries but those of the collector itself.
                assert set(wanted.exclude("collector").keys(True, True)) == set(
                    batch.keys(True, True)
                )
                for key in batch.keys(True, True):
                    assert torch.equal(batch[key], wanted[key]), key
                seen += batch.numel()
                over = wanted["next", "terminated"].any()
            assert over
            assert seen == 3 * frames
            theirs.shutdown()
            ours.shutdown()


def test_any_batch_of_episodes(subtests) -> None:
    for batch in [(), (2, 3)]:
        with subtests.test(batch=batch):

            def played(make, batch=batch):
                env = small_env("alcc", batch, ["scenario.horizon=10"])
                return next(iter(make(env, policy(), frames_per_batch=env.batch_size.numel() * 25)))

            theirs = played(
                partial(Collector, total_frames=-1, auto_register_policy_transforms=False)
            )
            ours = played(StringCollector)
            assert ours.shape == (*batch, 25)
            assert ours["next", "done"].sum() == 2 * ours[..., 0].numel()
            for key in ours.keys(True, True):
                assert torch.equal(ours[key], theirs[key]), key


def test_an_episode_begins_as_the_environment_would_begin_it(subtests) -> None:
    for variant, overrides in [
        *((variant, []) for variant in ("alcc", "reference", "ddpg", "hcfs")),
        ("alcc", ["+knowledge=[memory,preview]", "+filter=cbf"]),
        ("alcc", ["scenario.string={size: 9, penetration: 0.4}"]),
        ("alcc", ["scenario.pieces.leader.perturbation=1.0"]),
        ("idm", ["scenario=ring"]),
    ]:
        with subtests.test(variant=variant):
            env = small_env(variant, 7, overrides)
            begun = env.reset()
            rows = torch.tensor([5, 2])
            ours = Step(pieces_of(env), env.base_env.horizon).begin(begun[SEED][rows])
            assert set(ours) == {as_key(key) for key in begun.keys(True, True)}
            for key, value in ours.items():
                assert torch.equal(value, begun[key][rows]), key


def test_an_environment_may_be_made_by_a_function_and_its_state_restored() -> None:
    def segments(collector):
        return next(iter(collector))["vehicles", "speed"]

    one = StringCollector(lambda: small_env("alcc", 4), policy(), frames_per_batch=40)
    segments(one)
    one.resets = PLAIN_RESETS + 1  # compiled from here on
    state = one.state_dict()
    expected = segments(one)
    two = StringCollector(lambda: small_env("alcc", 4), policy(), frames_per_batch=40)
    two.load_state_dict(state)
    assert two.resets == PLAIN_RESETS + 1
    assert torch.equal(segments(two), expected)


def test_what_cannot_be_collected_is_refused() -> None:
    sums = [TransformedEnv(environment("one"), x) for x in (RewardSum(), Compose(RewardSum()))]
    cases = [
        (small_env("alcc", 4, [string("human*3")]), 40, "no vehicle of the string is automated"),
        (environment("one"), 41, "must be a multiple of the 8 episodes side by side"),
        *((env, 40, "has the transforms RewardSum") for env in sums),
    ]

    def collect(env, frames: int) -> None:
        StringCollector(env, None, frames_per_batch=frames)

    check_refused(collect, cases, ConfigError)


def test_compiled_agrees_and_repeats_itself_past_an_end() -> None:
    def collector(compiled: bool, batch: int = 2):
        env = small_env("alcc", batch, ["scenario.horizon=80"])
        return StringCollector(env, policy(), frames_per_batch=100, keys=KEYS, compiled=compiled)

    def played(source: StringCollector):
        source.set_seed(1)  # both episodes last to the horizon
        begun, graphs = source.collect(), counters["stats"]["unique_graphs"]
        whole = torch.cat([begun, source.collect()], -1)
        assert counters["stats"]["unique_graphs"] == graphs  # a reset needs no other graph
        return whole

    plain, fast = played(collector(False)), collector(True)
    one, two = played(fast), played(fast)
    assert counters["stats"]["unique_graphs"]
    assert plain["next", "done"].sum() == 2
    for key in plain.keys(True, True):
        torch.testing.assert_close(one[key], plain[key], rtol=1e-4, atol=1e-4)
        assert torch.equal(one[key], two[key]), key
    (alone := collector(False, 1)).collect()  # nor does that of one episode, whose strides differ
    begun = alone._renewed(alone.state, torch.tensor([0]), torch.tensor([[5]]))
    assert [x.stride() for x in begun.values()] == [x.stride() for x in alone.state.values()]


def crashing(compiled: bool, batch: int = 40, seed: int = 0):
    env = small_env("alcc", batch, CRASHING, seed)
    return StringCollector(
        env, policy(), frames_per_batch=batch * 150, keys=[*KEYS, SEED], compiled=compiled
    )


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_compiled_replaces_the_episodes_that_end() -> None:
    ours = crashing(True)
    ours.resets = PLAIN_RESETS - 50  # both kinds
    assert ours.rows < 40  # so that those that all reach the horizon are more than fit
    compiled, plain = ours.collect(), crashing(False).collect()
    assert isinstance(ours.renew.function, type(ours.advance.function))
    assert ours.renew.function is not ours.renew.plain
    assert ours.resets > PLAIN_RESETS
    assert plain["next", "terminated"].any()
    assert (plain["next", "done"].sum(1) > 1).any()
    # A gap of nearly zero may end an episode a step earlier; from there on the seeds differ.
    same = (compiled["next", "done"] == plain["next", "done"]).all(0).cumprod(0).flatten().bool()
    assert same[:100].all()
    for key in plain.keys(True, True):
        torch.testing.assert_close(
            compiled[key][:, same], plain[key][:, same], rtol=1e-3, atol=1e-3, msg=str(key)
        )


class Shifted(TensorDictModuleBase):
    """A policy with a setting that is no tensor."""

    def __init__(self) -> None:
        self.in_keys, self.out_keys = [("automated", "observation")], [("automated", "action")]
        super().__init__()
        self.shift = 0.5

    def forward(self, tensordict):
        action = torch.zeros_like(tensordict[self.in_keys[0]][..., :1]) + self.shift
        return tensordict.set(self.out_keys[0], action)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_compiled_sees_a_change_of_the_policy() -> None:
    acting = Shifted()
    collector = StringCollector(
        small_env("alcc", 4),
        acting,
        frames_per_batch=8,
        keys=[("automated", "action")],
        compiled=True,
    )
    assert (collector.collect()["automated", "action"] == 0.5).all()
    acting.shift = -0.25
    assert (collector.collect()["automated", "action"] == -0.25).all()
