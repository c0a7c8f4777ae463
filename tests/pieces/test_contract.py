"""The contract that every piece passes: one object in every role, offline equal to online."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import pytest
import torch
from helpers import POPULATION, small_env, wavy_profiles
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, TransformedEnv, check_env_specs

import lcc_rl.pieces as room
from lcc_rl.envs.clock import Clock
from lcc_rl.pieces import (
    Barrier,
    CAVMotion,
    Collision,
    CollisionPenalty,
    DriverEstimator,
    EfficiencyReward,
    EnergyReward,
    IDMFollower,
    JerkReward,
    LeaderPreview,
    MotorPower,
    NGSIMLeader,
    Observation,
    ObservationMemory,
    Piece,
    PlatoonErrors,
    PlatoonLeader,
    PlatoonMotion,
    PlatoonObservation,
    SafetyReward,
    SmoothEfficiency,
    Smoothness,
    SmoothSafety,
    TimeGap,
    TimeToCollision,
    TotalReward,
    Transition,
    VelocityReward,
)

HORIZON = 20
TERMS = ["safety", "efficiency", "cav_energy", "hdv_energy", "collision"]
SCALES = {"leader": {"speed": 0.1}, "cav": {"gap": 0.1}, "hdv": {"gap": 0.1}}

# Every piece, in the order in which its scenario needs them.
LEADING_CRUISE: dict[str, Callable[[], Piece]] = {
    "NGSIMLeader": lambda: NGSIMLeader(wavy_profiles(), HORIZON, 0.1),
    "Barrier": lambda: Barrier(0.1),
    "CAVMotion": lambda: CAVMotion(0.1),
    "IDMFollower": lambda: IDMFollower(POPULATION, 0.1, followers=2),
    "DriverEstimator": lambda: DriverEstimator(POPULATION, 0.1, followers=2, learning_time=0.5),
    "TimeToCollision": lambda: TimeToCollision("cav"),
    "TimeGap": lambda: TimeGap("cav"),
    "MotorPower": lambda: MotorPower("cav"),
    "MotorPower, followers": lambda: MotorPower(
        "hdv", "predicted_acceleration", "predicted_power", event_shape=(2, 1)
    ),
    "Collision": lambda: Collision(["cav", "hdv"], followers=["hdv"]),
    "LeaderPreview": lambda: LeaderPreview(wavy_profiles(), 0.1, [0.5, 3.0], noise=0.2, delay=0.1),
    "ObservationMemory": lambda: ObservationMemory(0.1, ["leader.speed", "cav.gap"], [0.5, 1.0]),
    "ObservationMemory, stacked": lambda: ObservationMemory(
        0.1, ["leader.speed", "cav.gap"], [0.5, 1.0], "stacked", "stack"
    ),
    "Observation": lambda: Observation(SCALES, visible=2),
    "SafetyReward": SafetyReward,
    "EfficiencyReward": EfficiencyReward,
    "EnergyReward": lambda: EnergyReward(0.1, "cav_energy"),
    "EnergyReward, followers": lambda: EnergyReward(
        0.1, "hdv_energy", vehicle="hdv", power="predicted_power", followers=True
    ),
    "CollisionPenalty": CollisionPenalty,
    "SmoothSafety": lambda: SmoothSafety("smooth_safety"),
    "SmoothEfficiency": lambda: SmoothEfficiency("smooth_efficiency"),
    "Smoothness": Smoothness,
    "TotalReward": lambda: TotalReward(TERMS),
}
N = 4
STATE = {"gap_error": 0.1, "speed_error": 0.5, "leader_gap_error": 0.1, "acceleration": 0.3}
PLATOON: dict[str, Callable[[], Piece]] = {
    "PlatoonLeader": lambda: PlatoonLeader(wavy_profiles(), HORIZON, 0.1, perturbation=0.5),
    "PlatoonMotion": lambda: PlatoonMotion(0.1, N, gap_spread=2.0, speed_spread=1.0),
    "PlatoonErrors": lambda: PlatoonErrors(N),
    "PlatoonObservation": lambda: PlatoonObservation(STATE, N),
    "VelocityReward": lambda: VelocityReward(followers=N),
    "JerkReward": lambda: JerkReward(followers=N),
    "TotalReward, platoon": lambda: TotalReward(["velocity", "jerk"], (N, 1)),
}
MAKERS = LEADING_CRUISE | PLATOON
EACH = pytest.mark.parametrize("name", list(MAKERS))


def full_env(batch_size: int | tuple[int, ...] = 3, name: str = "NGSIMLeader") -> TransformedEnv:
    """The environment of all pieces of the scenario that the named one belongs to."""
    platoon = name in PLATOON
    makers, action = (PLATOON, (N, 1)) if platoon else (LEADING_CRUISE, (1,))
    clock = Clock(HORIZON, batch_size, action, seed=4)
    return TransformedEnv(clock, Compose(*(make() for make in makers.values())))


def rollout(batch_size: int | tuple[int, ...] = 3, name: str = "NGSIMLeader") -> TensorDictBase:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return full_env(batch_size, name).rollout(HORIZON, break_when_any_done=False)


def moment(piece: Piece, data: TensorDictBase) -> TensorDictBase:
    """Return the part of a rollout that a piece is applied to."""
    return data if isinstance(piece, Transition) else data["next"]


def without_results(piece: Piece, data: TensorDictBase) -> TensorDictBase:
    """Take away what the piece writes, where it does not also read it."""
    read = set(piece.in_keys)
    return data.exclude(*(key for key in piece.out_keys if key not in read))


def assert_results_equal(piece: Piece, got: TensorDictBase, expected: TensorDictBase) -> None:
    for key in piece.out_keys:
        assert torch.equal(got[key], expected[key]), key


def test_every_piece_is_under_contract() -> None:
    concrete = {
        name
        for name, kind in vars(room).items()
        if inspect.isclass(kind)
        and issubclass(kind, Piece)
        and hasattr(kind, "compute")
        and name not in ("RewardTerm",)
    }
    assert concrete == {name.split(",")[0] for name in MAKERS}


@pytest.mark.parametrize("batch_size", [(), 3, (2, 2)])
@pytest.mark.parametrize("name", ["NGSIMLeader", "PlatoonLeader"])
def test_environment_of_all_pieces_passes_torchrl_check(batch_size, name) -> None:
    check_env_specs(full_env(batch_size, name), break_when_any_done="both")


@EACH
def test_offline_on_a_stored_rollout_equals_online(name: str) -> None:
    piece, data = MAKERS[name](), rollout(name=name)
    part = moment(piece, data)
    assert_results_equal(piece, piece(without_results(piece, part).clone()), part)


@EACH
def test_inside_a_sequential(name: str) -> None:
    piece, data = MAKERS[name](), rollout(name=name)
    part = moment(piece, data)
    assert_results_equal(piece, TensorDictSequential(piece)(without_results(piece, part)), part)


@EACH
def test_without_batch(name: str) -> None:
    piece = MAKERS[name]()
    part = moment(piece, rollout((), name))
    assert part.batch_size == (HORIZON,)
    single = part[7]
    assert_results_equal(piece, piece(without_results(piece, single).clone()), single)


@EACH
def test_by_keyword(name: str) -> None:
    piece, data = MAKERS[name](), rollout(name=name)
    part = moment(piece, data)
    named = {"_".join(k) if isinstance(k, tuple) else k: part[k] for k in piece.in_keys}
    got = piece(**named)
    got = got if isinstance(got, tuple) else (got,)
    for key, value in zip(piece.out_keys, got, strict=True):
        assert torch.equal(value, part[key]), key


@EACH
def test_in_a_replay_buffer(name: str) -> None:
    piece, data = MAKERS[name](), rollout(name=name)
    part = moment(piece, data).reshape(-1)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(part.numel()),
        batch_size=16,
        transform=piece,
        generator=torch.Generator().manual_seed(0),
    )
    row = torch.arange(part.numel()).unsqueeze(-1)
    buffer.extend(without_results(piece, part).set("row", row))
    sample = buffer.sample()
    assert_results_equal(piece, sample, part[sample["row"].squeeze(-1)])


@EACH
def test_keeps_no_state(name: str) -> None:
    piece, data = MAKERS[name](), rollout(name=name)
    part = moment(piece, data)
    before = {key: value.clone() for key, value in piece.state_dict().items()}
    first = piece(without_results(piece, part).clone())
    second = piece(without_results(piece, part).clone())
    assert_results_equal(piece, first, second)
    assert all(torch.equal(value, before[key]) for key, value in piece.state_dict().items())


@EACH
def test_written_specs_match_what_is_written(name: str) -> None:
    env = full_env(3, name)
    td = env.rand_step(env.reset())["next"]
    specs = {
        **dict(env.observation_spec.items(True, True)),
        **dict(env.full_reward_spec.items(True, True)),
        **dict(env.full_done_spec.items(True, True)),
    }
    for key in MAKERS[name]().out_keys:
        bare = key[1:] if isinstance(key, tuple) and key[0] == "next" else key
        bare = bare[0] if isinstance(bare, tuple) and len(bare) == 1 else bare
        assert specs[bare].is_in(td[bare]), key


def test_pieces_work_on_other_names() -> None:
    # Nothing is tied to "cav": a second car is another name.
    piece = CAVMotion(0.1, name="truck", predecessor="cav")
    data = rollout()
    truck = TensorDict(
        {
            "truck": data["cav"],
            "cav": data["leader"],
            "action": data["action"],
            "next": {"cav": data["next", "leader"]},
        },
        data.batch_size,
    )
    assert torch.equal(piece(truck)["next", "truck", "gap"], data["next", "cav", "gap"])


def test_small_env_uses_the_shipped_scenario() -> None:
    names = [type(piece).__name__ for piece in small_env("alcc").transform]
    assert names[:3] == ["NGSIMLeader", "CAVMotion", "IDMFollower"]
    assert names[-1] == "TotalReward"
