"""TorchRL's own transforms, collectors and wrappers take the environment as any single-agent one.

Every transform and collector of TorchRL 0.14 that fits an environment with one continuous action is
tried.
"""

from __future__ import annotations

from functools import partial

import pytest
import torch
import torch.multiprocessing as mp
from helpers import single_env, small_env
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import (
    AsyncBatchedCollector,
    AsyncCollector,
    Collector,
    MultiAsyncCollector,
    MultiSyncCollector,
)
from torchrl.data import Unbounded
from torchrl.data.vla import UniformActionTokenizer
from torchrl.envs import SerialEnv, TransformedEnv, check_env_specs
from torchrl.envs import transforms as room
from torchrl.envs.transforms import Compose
from torchrl.envs.utils import RandomPolicy, step_mdp
from torchrl.modules import RandomPolicy as AnyAction

import lcc_rl
from lcc_rl.errors import ConfigError
from lcc_rl.pieces.base import SEED, STEP

OBS, WIDTH = ["observation"], 7
TERM = ("reward_terms", "safety")


def tokens():
    return UniformActionTokenizer(8, low=-1.0, high=1.0)


def doubled() -> TensorDictModule:
    return TensorDictModule(lambda x: 2.0 * x, OBS, OBS)


def pushing() -> TensorDictModule:
    return TensorDictModule(lambda x: 0.3 + 0.0 * x[..., :1], OBS, ["action"])


# Transform by its name in TorchRL → how to make it, as its documentation does.
FITS = {
    "ActionDiscretizer": lambda: room.ActionDiscretizer(5),
    "ActionScaling": lambda: room.ActionScaling(loc=0.1, scale=2.0),
    "ActionTokenizerTransform": lambda: room.ActionTokenizerTransform(tokens(), mode="decode"),
    "BatchSizeTransform": lambda: room.BatchSizeTransform(reshape_fn=lambda td: td.unsqueeze(0)),
    "BinarizeReward": room.BinarizeReward,
    "CatFrames": lambda: room.CatFrames(3, dim=-1, in_keys=OBS),
    "CatTensors": lambda: room.CatTensors([*OBS, ("leader", "speed")], "all", del_keys=False),
    "ClipTransform": lambda: room.ClipTransform(in_keys=[*OBS, "reward"], low=-1.0, high=1.0),
    "Compose": lambda: Compose(room.StepCounter(), room.RewardSum()),
    "ConditionalPolicySwitch": lambda: room.ConditionalPolicySwitch(pushing(), lambda td: True),
    "ConditionalSkip": lambda: room.ConditionalSkip(lambda td: td[STEP][..., 0] % 2 == 1),
    "DTypeCastTransform": lambda: room.DTypeCastTransform(torch.float32, torch.float64),
    "DeviceCastTransform": lambda: room.DeviceCastTransform("cpu", "cpu"),
    "DoubleToFloat": room.DoubleToFloat,
    "ExcludeTransform": lambda: room.ExcludeTransform(TERM, ("vehicles", "ttc")),
    "ExpandAs": lambda: room.ExpandAs("done", "observation", "over"),
    "FiniteTensorDictCheck": room.FiniteTensorDictCheck,
    "FlattenObservation": lambda: room.FlattenObservation(-2, -1, in_keys=OBS),
    "FrameSkipTransform": lambda: room.FrameSkipTransform(2),
    "Hash": lambda: room.Hash(OBS, ["hash"], hash_fn=lambda x: x.sum(-1, keepdim=True).long()),
    "InitTracker": room.InitTracker,
    "LineariseRewards": lambda: room.LineariseRewards(["reward"], ["twice"], weights=[2.0]),
    "ModuleTransform": lambda: room.ModuleTransform(module=doubled(), no_grad=True),
    "MultiAction": room.MultiAction,
    "NoopResetEnv": lambda: room.NoopResetEnv(3),
    "ObservationNorm": lambda: room.ObservationNorm(0.0, 2.0, in_keys=OBS),
    "PermuteTransform": lambda: Compose(
        room.UnsqueezeTransform(-1, in_keys=OBS), room.PermuteTransform((-1, -2), in_keys=OBS)
    ),
    "RNDTransform": lambda: room.RNDTransform(nn.Linear(WIDTH, 3), nn.Linear(WIDTH, 3), OBS),
    "RandomTruncationTransform": lambda: Compose(
        room.StepCounter(), room.RandomTruncationTransform(3, 10)
    ),
    "RemoveEmptySpecs": room.RemoveEmptySpecs,
    "RenameTransform": lambda: room.RenameTransform(
        ["reward", ("vehicles", "ttc")], ["r", "ttc"], ["action"], ["a"]
    ),
    "RewardClipping": lambda: room.RewardClipping(-1.0, 0.0),
    "RewardScaling": lambda: room.RewardScaling(0.0, 2.0),
    "RewardSum": room.RewardSum,
    "SignTransform": lambda: room.SignTransform(in_keys=["reward"]),
    "SqueezeTransform": lambda: Compose(
        room.UnsqueezeTransform(-1, in_keys=OBS), room.SqueezeTransform(-1, in_keys=OBS)
    ),
    "Stack": lambda: room.Stack(OBS, "stacked", dim=-2, del_keys=False),
    "StepCounter": lambda: room.StepCounter(max_steps=5),
    "SuccessReward": lambda: room.SuccessReward("terminated"),
    "TargetReturn": lambda: room.TargetReturn(-1.0),
    "TensorDictPrimer": lambda: room.TensorDictPrimer(h=Unbounded(shape=(3,)), expand_specs=True),
    "TerminateTransform": lambda: room.TerminateTransform(lambda td: td[TERM] < -1e9),
    "TimeMaxPool": lambda: room.TimeMaxPool(OBS, ["most"], T=2),
    "Timer": room.Timer,
    "TrajCounter": room.TrajCounter,
    "UnaryTransform": lambda: room.UnaryTransform(OBS, ["double"], fn=lambda x: 2.0 * x),
    "UnsqueezeTransform": lambda: room.UnsqueezeTransform(-1, in_keys=OBS),
    "VecNorm": lambda: room.VecNorm(in_keys=[*OBS, "reward"]),
    "VecNormV2": lambda: room.VecNormV2(in_keys=[*OBS, "reward"]),
    "gSDENoise": lambda: room.gSDENoise(state_dim=WIDTH, action_dim=1, shape=(2,)),
}
ONE = {"NoopResetEnv"}  # takes one episode, no batch


class Constant(nn.Module):
    """An action in the middle of any specification."""

    def __init__(self, env) -> None:
        super().__init__()
        self.spec = next(iter(env.full_action_spec.values(True, True)))

    def forward(self, *_) -> torch.Tensor:
        shape = [2 if size < 0 else size for size in self.spec.shape]
        return torch.full(shape, 0, dtype=self.spec.dtype)


@pytest.mark.filterwarnings("ignore")
def test_a_transform(subtests) -> None:
    for name in FITS:
        with subtests.test(name=name):
            env = single_env("alcc", () if name in ONE else 2)
            if name == "FlattenObservation":
                env.append_transform(room.UnsqueezeTransform(-1, in_keys=OBS))
            env.append_transform(FITS[name]())
            check_env_specs(env)
            key = env.action_keys[0]
            seen = "observation"
            policy = TensorDictModule(Constant(env), [seen], [key])
            for driver in (None, policy):
                driven = env.rollout(4, driver, break_when_any_done=name != "BatchSizeTransform")
                assert driven[seen].isfinite().all()
                assert driven["next", env.reward_keys[0]].isfinite().all()
                if name == "RandomTruncationTransform":
                    continue  # ends at random
                assert driven.shape[-1] == 4
                moved = driven["next", *STEP].flatten().max()
                assert moved >= (1 if name == "ConditionalSkip" else 4)
            assert env.rand_step()["next", seen].isfinite().all()


def test_the_environment_alone(subtests) -> None:
    for batch in [(), 2]:
        with subtests.test(batch=batch):
            one = partial(single_env, "alcc", batch)
            for env in (one(), TransformedEnv(one()), SerialEnv(2, one)):
                check_env_specs(env)
                assert (env.reward_key, env.action_key) == ("reward", "action")
                assert list(env.full_reward_spec.keys(True, True)) == ["reward"]
                assert env.rand_action()["action"].shape == env.action_spec.shape
                known = RandomPolicy(env.full_action_spec), AnyAction(env.action_spec)
                for policy in (None, pushing(), *known):
                    assert env.rollout(4, policy)["next", "reward"].isfinite().all()
            assert single_env("alcc", batch).rand_step()["next", *STEP].unique() == 1
            group = small_env("alcc", batch, ["scenario.string='automated human automated'"])
            assert group.reward_key == ("automated", "reward")


def test_what_torchrl_calls_is_its_own() -> None:
    env = single_env("alcc", 2)
    touched = []
    env.apply(lambda module: touched.append(module))  # as PyTorch's initialisers do
    assert len(touched) > len(env.transform)


# -- what a transform means ------------------------------------------------------------------------


def stepped(env, td, action: float):
    td = env.step(td.set("action", torch.full(env.action_spec.shape, action)))
    return td["next"], step_mdp(td)


def test_frames_skipped_are_steps_by_the_same_action() -> None:
    plain, skipping = single_env("alcc", 2), single_env("alcc", 2)
    skipping.append_transform(room.FrameSkipTransform(3))
    td, other = plain.reset(), skipping.reset()
    total = 0.0
    for _ in range(3):
        one, td = stepped(plain, td, 0.2)
        total = total + one["reward"]
    three, _ = stepped(skipping, other, 0.2)
    assert torch.equal(three["observation"], one["observation"])
    assert torch.equal(three["reward"], total)
    assert (three[STEP] == 3).all()


def test_an_episode_that_ends_skips_no_further_frame() -> None:
    env = single_env("alcc", (), ["scenario.horizon=10"])
    env.append_transform(room.FrameSkipTransform(4))
    played = env.rollout(20)
    assert played["next", *STEP].flatten().tolist() == [4, 8, 10]
    assert played["next", "done"].flatten().tolist() == [False, False, True]


def test_several_actions_at_once_are_steps() -> None:
    plain, joined = single_env("alcc", 2), single_env("alcc", 2)
    joined.append_transform(room.MultiAction())
    td, other = plain.reset(), joined.reset()
    for action in (0.2, -0.1):
        one, td = stepped(plain, td, action)
    actions = torch.tensor([[[0.2], [-0.1]]] * 2)
    two = joined.step(other.set("action", actions))["next"]
    assert torch.equal(two["observation"], one["observation"])


def test_an_episode_that_skips_stands_still() -> None:
    env = single_env("alcc", 2)
    env.append_transform(room.ConditionalSkip(lambda td: torch.tensor([True, False])))
    td = env.reset()
    start = td["observation"].clone()
    after, _ = stepped(env, td, 1.0)
    assert after[STEP].flatten().tolist() == [0, 1]
    assert torch.equal(after["observation"][0], start[0])
    assert after["reward"][0] == 0.0
    assert not torch.equal(after["observation"][1], start[1])


def test_statistics_of_observations(subtests) -> None:
    for nested in [False, True]:
        with subtests.test(nested=nested):
            norm = room.ObservationNorm(in_keys=OBS, standard_normal=True)
            env = single_env("alcc", ())
            env = TransformedEnv(env, Compose(norm)) if nested else env.append_transform(norm)
            norm.init_stats(40, reduce_dim=0, cat_dim=0)
            assert norm.loc.shape == (WIDTH,)
            assert env.rollout(20)["observation"].abs().median() < 3.0


def test_actions_of_a_group_flattened() -> None:
    env = small_env("alcc", 2, ["scenario.string='automated human automated'"])
    key = ("automated", "action")
    env.append_transform(room.FlattenAction(-2, -1, in_keys_inv=[key]))
    check_env_specs(env)
    assert env.rollout(4)[key].shape == (2, 4, 2)


@pytest.mark.usefixtures("double")
def test_double_precision_by_default() -> None:
    env = single_env("alcc", 2)
    check_env_specs(env)
    assert env.rollout(4)["next", "reward"].dtype == torch.float64
    env.append_transform(room.DoubleToFloat())
    check_env_specs(env)
    assert env.rollout(4)["observation"].dtype == torch.float32


def test_a_step_without_its_state_is_refused_in_one_line() -> None:
    env = single_env("alcc", 2)
    env.reset()
    with pytest.raises(ConfigError, match=r"TensorDict of reset or step_mdp.*only action"):
        env.step(TensorDict({"action": torch.zeros(2, 1)}, [2]))
    with pytest.raises(ConfigError, match=r"transforms must keep it"):
        TransformedEnv(env, room.ExcludeTransform(("vehicles", "gap"))).rollout(3)
    kept = TransformedEnv(single_env("alcc", 2), room.SelectTransform(*OBS)).rollout(3)
    assert kept["next", "reward"].isfinite().all()  # TorchRL keeps the state of the specs


# -- collectors and wrappers -----------------------------------------------------------------------

make = partial(lcc_rl.make_env, "alcc", (), ["data.platoons=2", "data.recordings=2"])
SIZE = {"frames_per_batch": 20, "total_frames": 40}


def env_of(*transforms):
    env = single_env("alcc", 2)
    for transform in transforms:
        env.append_transform(transform)
    return env


@pytest.fixture
def fork():
    before = mp.get_start_method(allow_none=True)
    mp.set_start_method("fork", force=True)
    yield
    mp.set_start_method(before, force=True)


COLLECTORS = {
    "no policy": lambda: Collector(env_of(), None, **SIZE),
    "a policy": lambda: Collector(env_of(), pushing(), **SIZE),
    "random warm-up": lambda: Collector(env_of(), pushing(), init_random_frames=20, **SIZE),
    "rand_action": lambda: Collector(env_of(), env_of().rand_action, **SIZE),
    "another device": lambda: Collector(
        env_of(room.DeviceCastTransform("cpu", "cpu")), None, env_device="cpu", **SIZE
    ),
    "short trajectories": lambda: Collector(env_of(), None, max_frames_per_traj=3, **SIZE),
    "split trajectories": lambda: Collector(env_of(), None, split_trajs=True, **SIZE),
    "compact": lambda: Collector(env_of(), None, compact_obs=True, **SIZE),
    "of several": lambda: Collector(SerialEnv(2, make), None, **SIZE),
    "batched": lambda: AsyncBatchedCollector([make, make], policy=pushing(), **SIZE),
}


@pytest.mark.filterwarnings("ignore")
def test_a_collector(subtests) -> None:
    for name in COLLECTORS:
        with subtests.test(name=name):
            collector = COLLECTORS[name]()
            batches = list(collector)
            collector.shutdown()
            masks = [batch.get(("collector", "mask"), None) for batch in batches]
            counted = zip(batches, masks, strict=True)
            frames = sum(batch.numel() if mask is None else mask.sum() for batch, mask in counted)
            assert frames == SIZE["total_frames"]
            assert all(batch["next", "reward"].isfinite().all() for batch in batches)


def first_seeds(env) -> torch.Tensor:
    seeds = env.reset()[SEED].flatten()
    assert len(seeds.unique()) == len(seeds)
    return seeds


def test_workers_play_different_episodes() -> None:
    env = SerialEnv(2, make)
    drawn = first_seeds(env)
    env.set_seed(3)
    again = first_seeds(env)
    assert not torch.equal(drawn, again)
    env.set_seed(3)
    assert torch.equal(first_seeds(env), again)
    one, two = (make(seed=3).reset()[SEED] for _ in range(2))
    assert torch.equal(one, two)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("fork")
def test_collectors_in_processes(subtests) -> None:
    for kind in (MultiSyncCollector, MultiAsyncCollector, AsyncCollector):
        with subtests.test(kind=kind.__name__):
            collector = kind(make if kind is AsyncCollector else [make, make], None, **SIZE)
            batches = [batch.clone() for batch in collector]
            collector.shutdown()
            assert sum(batch.numel() for batch in batches) == SIZE["total_frames"]
            seeds = torch.cat([batch[SEED].flatten() for batch in batches])
            # Where workers do not wait for each other, one may have played all batches.
            assert len(seeds.unique()) >= (2 if kind is MultiSyncCollector else 1)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.usefixtures("fork")
def test_a_seed_of_a_collector_differs_by_worker() -> None:
    collector = MultiSyncCollector([make, make], None, frames_per_batch=20, total_frames=20)
    collector.set_seed(5)
    (batch,) = [batch[SEED].clone() for batch in collector]
    collector.shutdown()
    assert len(batch.unique()) == 2


def test_an_environment_is_built_and_played_in_inference_mode() -> None:
    with torch.inference_mode():
        env = small_env("alcc", 2)
        assert env.rollout(3).shape == (2, 3)
