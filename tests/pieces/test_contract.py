"""The contract that every piece passes: one object in every role, offline equal to online.

One string holds a role for every controller, so that all pieces act in one environment: on an
open road, with places drawn, and on a ring.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from importlib.util import find_spec

import pytest
import torch
from helpers import (
    ACTION,
    MIXED,
    OBSERVATION,
    POPULATION,
    REWARD,
    TERMS,
    small_env,
    wavy_profiles,
)
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, TransformedEnv, check_env_specs

import lcc_rl.pieces as room
from lcc_rl.energy import CirclesFuel, ElectricCar, Fleet
from lcc_rl.envs.clock import Clock, Traffic
from lcc_rl.envs.step import Pieces
from lcc_rl.functional.mpc import MPCSettings
from lcc_rl.pieces import (
    CACC,
    FVDM,
    HCFS,
    IDM,
    IDMACC,
    MPC,
    OVM,
    Action,
    CalibratedDrivers,
    CBFFilter,
    Collision,
    CollisionPenalty,
    Communication,
    ConstantAcceleration,
    Controller,
    Corrected,
    Correction,
    DeadBeat,
    DriverEstimator,
    DriverModel,
    EfficiencyReward,
    EnergyClasses,
    EnergyReward,
    EquilibriumStart,
    Feature,
    FollowerStopper,
    Gipps,
    Handover,
    HeadwayStart,
    JerkReward,
    LeaderPreview,
    LinearACC,
    MotorPower,
    NGSIMLeader,
    Observation,
    ObservationMemory,
    PathEnergy,
    Piece,
    PISaturation,
    Places,
    RangeReward,
    RewardPiece,
    RewardTerm,
    SafetyReward,
    SmoothEfficiency,
    Smoothness,
    SmoothRange,
    SmoothSafety,
    SpacingReward,
    StepTransform,
    StringMotion,
    TimeGap,
    TimeGapStart,
    TimeToCollision,
    TotalReward,
    VehicleString,
    VelocityReward,
)
from lcc_rl.pieces.base import as_key
from lcc_rl.pieces.world import World
from lcc_rl.policies import ControllerPolicy, GaussianExploration, make_actor, shared_policy

HORIZON, T = 12, 0.1
FLEET = Fleet(
    {"car": CirclesFuel(), "electric": ElectricCar()}, roles={"automated": {"electric": 1.0}}
)
# Whose package is an extra, and not installed here.
MISSING = set() if find_spec("osqp") else {MPC}
CONNECTED = ("cacc", "beat", "hybrid")
ROLES = ("human", "automated", "human", "cacc", "cacc", "automated", "beat", "stopper")
ROLES = (
    *ROLES,
    "handover",
    "saturating",
    "constant",
    "plain",
    "following",
    "cruising",
    "planning",
    "hybrid",
    "hybrid",
    "human",
    *("late", "optimal", "difference", "gipps", "calibrated", "calibrated"),
)
STRINGS = {
    "open": VehicleString(ROLES),
    "drawn": VehicleString(ROLES, drawn=True),
    "ring": VehicleString(ROLES, ring=True),
}
SCALES = {
    "self": {"speed": 0.1, "gap": 0.1},
    "ahead": {"speed": 0.1},
    "behind": {"speed": 0.1, "gap": 0.1},
    "memory": {"entries": 0.5},
}
FILTERED = "Action, filtered"
DRIVEN = ("human", "handover", "late", "optimal", "difference", "gipps", "calibrated")
ACTIONS = {ACTION: (2, 1), ("plain", "action"): (1, 1), ("hybrid", "action"): (2, 1)}
BASES = (Piece, Feature, StepTransform, RewardPiece, RewardTerm, Controller, DriverModel)
STARTS = (HeadwayStart, TimeGapStart, EquilibriumStart)


def leading(string: VehicleString) -> dict[str, Callable[[], Piece]]:
    """The pieces that there are only behind a leader."""
    if string.ring:
        return {}
    return {
        "NGSIMLeader": lambda: NGSIMLeader(
            wavy_profiles(), HORIZON, T, perturbation=0.5, foresight=True
        ),
        "LeaderPreview": lambda: LeaderPreview(wavy_profiles(), T, [0.5, 3.0], noise=0.2),
    }


def controllers(string: VehicleString) -> dict[str, Callable[[], Piece]]:
    def human(role: str) -> IDM:
        return IDM(POPULATION, T, noise=0.05, wiener=0.1, string=string, role=role)

    def driver(kind: type, role: str, delay: int) -> DriverModel:
        own = kind.law.constants()
        return kind(
            POPULATION, T, wiener=0.1, delay=delay, parameters=own, string=string, role=role
        )

    def stopper(role: str, speed: float | None = None) -> FollowerStopper:
        return FollowerStopper(T, speed, window=0.5, string=string, role=role)

    own = {"string": string, "role": "planning"}
    planning = {"MPC": lambda: MPC(MPCSettings(horizon=3.0), **own)}
    if MISSING:
        planning = {"LinearACC, planning": lambda: LinearACC(**own)}
    return {
        **planning,
        FILTERED: lambda: Action(string=string),
        "Action": lambda: Action(string=string, role="plain"),
        "IDM": lambda: human("human"),
        "IDM, late": lambda: driver(IDM, "late", 3),
        "OVM": lambda: driver(OVM, "optimal", 0),
        "FVDM": lambda: driver(FVDM, "difference", 1),
        "Gipps": lambda: driver(Gipps, "gipps", 2),
        "CalibratedDrivers": lambda: CalibratedDrivers(
            MIXED, T, wiener=0.1, delay=2, string=string, role="calibrated"
        ),
        "CACC": lambda: CACC(T, k3=0.4, string=string, role="cacc"),
        "DeadBeat": lambda: DeadBeat(T, string=string, role="beat"),
        "FollowerStopper": lambda: stopper("stopper"),
        "PISaturation": lambda: PISaturation(T, 0.5, string=string, role="saturating"),
        "Handover": lambda: Handover(
            human("handover"), stopper("handover"), 0.5, T, string, "handover"
        ),
        "IDMACC": lambda: IDMACC(string=string, role="following"),
        "LinearACC": lambda: LinearACC(string=string, role="cruising"),
        "ConstantAcceleration": lambda: ConstantAcceleration(0.3, string, "constant"),
        "HCFS": lambda: HCFS(
            CACC(T, k3=0.4, string=string, role="hybrid"),
            T,
            spacing_weight=0.02,
            spacing_time=1.0,
            string=string,
            role="hybrid",
        ),
        "CBFFilter": lambda: CBFFilter(T, string=string),
        "Corrected": lambda: Corrected(3.0, string),
    }


def motion(string: VehicleString) -> StringMotion:
    start = {role: TimeGapStart() for role in string.names}
    start |= {role: EquilibriumStart(POPULATION) for role in DRIVEN}
    start |= {role: HeadwayStart() for role in CONNECTED}
    length = 30.0 * len(string) if string.ring else None
    return StringMotion(string, T, start, length, initial_speed=8.0)


def rewards(string: VehicleString) -> dict[str, Callable[[], Piece]]:
    world = World(string, T)
    mixed = replace(world, energy=FLEET)
    return {
        "SafetyReward": lambda: SafetyReward().bind(world),
        "EfficiencyReward": lambda: EfficiencyReward().bind(world),
        "EnergyReward": lambda: EnergyReward().bind(world, "self_energy"),
        "EnergyReward, behind": lambda: EnergyReward(of="behind").bind(world, "behind_energy"),
        "EnergyReward, estimated": lambda: EnergyReward(
            of="behind", power="human.predicted_power"
        ).bind(world, "estimated"),
        "EnergyReward, string": lambda: EnergyReward(of="string").bind(world, "string_energy"),
        "CollisionPenalty": lambda: CollisionPenalty().bind(world),
        "RangeReward": lambda: RangeReward(largest=9.0).bind(world, "longest"),
        "SmoothRange": lambda: SmoothRange(entry="time_gap", least=1.2).bind(world, "shortest"),
        "VelocityReward": lambda: VelocityReward().bind(world),
        "JerkReward": lambda: JerkReward().bind(world),
        "SpacingReward": lambda: SpacingReward().bind(world),
        "SmoothSafety": lambda: SmoothSafety().bind(world),
        "SmoothEfficiency": lambda: SmoothEfficiency().bind(world),
        "Smoothness": lambda: Smoothness().bind(world),
        "Correction": lambda: Correction().bind(world),
        "PathEnergy": lambda: PathEnergy().bind(world, "path_energy"),
        "PathEnergy, mixed": lambda: PathEnergy().bind(mixed, "path_mixed"),
        "PathEnergy, behind": lambda: PathEnergy(of="behind").bind(world, "path_behind"),
    }


def makers(road: str) -> dict[str, Callable[[], Piece]]:
    """Every piece, in the order in which a scenario needs them."""
    string = STRINGS[road]
    own = {"string": string}
    kind = "stacked" if road == "drawn" else "filtered"
    terms = rewards(string)
    return {
        "Places": lambda: Places(string),
        **leading(string),
        **controllers(string),
        "StringMotion": lambda: motion(string),
        "Communication": lambda: Communication(string, CONNECTED),
        "DriverEstimator": lambda: DriverEstimator(POPULATION, T, learning_time=0.5, **own),
        "TimeToCollision": lambda: TimeToCollision(string),
        "TimeGap": lambda: TimeGap(string),
        "EnergyClasses": lambda: EnergyClasses(string, FLEET),
        "MotorPower": lambda: MotorPower(string),
        "MotorPower, mixed": lambda: MotorPower(string, power="mixed_power", energy=FLEET),
        "MotorPower, estimated": lambda: MotorPower(
            string, "human", "predicted_acceleration", "predicted_power"
        ),
        "Collision": Collision,
        "ObservationMemory": lambda: ObservationMemory(
            T, ["ahead.speed", "self.gap"], [0.5, 1.0], kind, **own
        ),
        "Observation": lambda: Observation(SCALES, 2, {"memory": 4}, **own),
        **terms,
        "TotalReward": lambda: TotalReward([make().name for make in terms.values()], string),
    }


@cache
def made(road: str) -> dict[str, Piece]:
    return {name: make() for name, make in makers(road).items()}


# What is checked of each piece; what the filter replaces is no piece's own any more.
EACH = pytest.mark.parametrize(
    ("road", "name"),
    [(r, n) for r in STRINGS for n in makers(r) if n != FILTERED],
)


def clock(batch_size: int | tuple[int, ...] = 3) -> Clock:
    return Clock(HORIZON, batch_size, ACTIONS, seed=4)


def full_env(road: str, batch_size: int | tuple[int, ...] = 3) -> TransformedEnv:
    """The environment of all pieces, as TorchRL puts one together."""
    return TransformedEnv(clock(batch_size), Compose(*(make() for make in makers(road).values())))


@cache
def played(road: str, batch_size: int | tuple[int, ...] = 3) -> TensorDictBase:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return full_env(road, batch_size).rollout(HORIZON, break_when_any_done=False)


def moment(piece: Piece, data: TensorDictBase) -> TensorDictBase:
    """Return the part of a rollout that a piece is applied to."""
    whole = isinstance(piece, (StepTransform, RewardPiece))
    return data if whole else data["next"]


def results(piece: Piece) -> list[tuple[str, ...]]:
    """Return where a piece writes in the part that it is applied to."""
    late = isinstance(piece, RewardPiece)
    return [("next", *key) if late else key for key in piece.out_keys]


def without_results(piece: Piece, data: TensorDictBase) -> TensorDictBase:
    """Take away what the piece writes, where it does not also read it."""
    read = set(piece.in_keys)
    return data.exclude(*(key for key in results(piece) if key not in read)).clone()


def same(piece: Piece, got: torch.Tensor, expected: torch.Tensor) -> bool:
    if isinstance(piece, TotalReward):  # a sum of many is rounded by how it lies in memory
        return torch.allclose(got, expected, rtol=1e-6, atol=1e-6)
    return torch.equal(got, expected)


def assert_results_equal(piece: Piece, got: TensorDictBase, expected: TensorDictBase) -> None:
    for key in results(piece):
        assert same(piece, got[key], expected[key]), key


def test_every_exported_class_is_under_contract() -> None:
    exported = {kind for kind in map(vars(room).get, room.__all__) if inspect.isclass(kind)}
    tested = {type(piece) for road in STRINGS for piece in made(road).values()}
    assert exported == tested | MISSING | {*BASES, *STARTS, VehicleString}
    # Whatever is a piece in that room is exported, too.
    found = {kind for kind in vars(room).values() if inspect.isclass(kind)}
    assert {kind for kind in found if issubclass(kind, Piece)} <= exported


@pytest.mark.parametrize("batch_size", [(), 3, (2, 2)])
@pytest.mark.parametrize("road", list(STRINGS))
def test_environment_of_all_pieces_passes_torchrls_check(road, batch_size) -> None:
    check_env_specs(full_env(road, batch_size), break_when_any_done="both")


@pytest.mark.parametrize("road", list(STRINGS))
def test_torchrls_compose_and_this_packages_give_the_same(road) -> None:
    data = played(road)
    env = Traffic(clock(), Pieces(*(make() for make in makers(road).values())))
    number = iter(range(HORIZON))

    def same_actions(td):
        step = data[:, next(number)]
        return td.update(step.select(*ACTIONS))

    other = env.rollout(HORIZON, same_actions, break_when_any_done=False)
    assert set(other.keys(True, True)) == set(data.keys(True, True))
    for key in data.keys(True, True):
        assert torch.equal(other[key], data[key]), key


@EACH
def test_offline_on_a_stored_rollout_equals_online(road, name) -> None:
    piece, data = made(road)[name], played(road)
    part = moment(piece, data)
    assert_results_equal(piece, piece(without_results(piece, part)), part)


@EACH
def test_inside_a_sequential(road, name) -> None:
    piece, data = made(road)[name], played(road)
    part = moment(piece, data)
    if isinstance(piece, RewardPiece):  # a sequence of modules works on one moment
        got = TensorDictSequential(piece)(without_results(piece, part)["next"])
        for key in piece.out_keys:
            assert same(piece, got[key], part["next", *key]), key
        return
    assert_results_equal(piece, TensorDictSequential(piece)(without_results(piece, part)), part)


@EACH
def test_without_batch(road, name) -> None:
    piece = made(road)[name]
    single = moment(piece, played(road, ()))[7]
    assert single.batch_size == ()
    assert_results_equal(piece, piece(without_results(piece, single)), single)


@EACH
def test_by_keyword(road, name) -> None:
    piece, data = made(road)[name], played(road)
    if not piece.in_keys:
        pytest.skip("reads nothing")
    part = data if isinstance(piece, StepTransform) else data["next"]
    got = piece(**{"_".join(as_key(key)): part[key] for key in piece.in_keys})
    got = got if isinstance(got, tuple) else (got,)
    for key, value in zip(piece.out_keys, got, strict=True):
        assert same(piece, value, part[key]), key


@EACH
def test_in_a_replay_buffer_of_transitions(road, name) -> None:
    piece, data = made(road)[name], played(road).reshape(-1)
    part = moment(piece, data)
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
def test_keys_are_nested_and_survive_flattening(road, name) -> None:
    piece, data = made(road)[name], played(road)
    part = moment(piece, data)
    stored = without_results(piece, part).flatten_keys(".").unflatten_keys(".")
    assert_results_equal(piece, piece(stored), part)


@EACH
def test_keeps_no_state(road, name) -> None:
    piece, data = made(road)[name], played(road)
    part = moment(piece, data)
    before = {key: value.clone() for key, value in piece.state_dict().items()}
    first, second = (piece(without_results(piece, part)) for _ in range(2))
    assert_results_equal(piece, first, second)
    assert all(torch.equal(value, before[key]) for key, value in piece.state_dict().items())


@EACH
def test_written_specs_match_what_is_written(road, name) -> None:
    piece, reached = made(road)[name], played(road)[:, 3]["next"]
    specs = piece.written_specs(reached.batch_size, None)
    if isinstance(piece, StepTransform):
        specs |= piece.constant_specs(reached.batch_size, None)
    assert set(specs) >= set(piece.targets)
    for key, spec in specs.items():
        if key not in (("done",), ("terminated",)):
            assert spec.is_in(reached[key]), key


@pytest.mark.parametrize("road", list(STRINGS))
def test_constants_keep_their_value(road) -> None:
    data, checked = played(road), 0
    for piece in made(road).values():
        for key in piece.constants if isinstance(piece, StepTransform) else ():
            assert torch.equal(data[key], data["next", *key]), key
            checked += 1
    assert checked >= 7


def test_reward_pieces_read_the_state_reached() -> None:
    data = played("open")
    piece = made("open")["EfficiencyReward"]
    key = (*TERMS, "efficiency")
    got = piece(data.exclude(("next", *key)).clone())
    expected = -(data["next", "vehicles", "time_gap"][..., [1, 5], :] >= 2.5).float()
    assert torch.equal(got["next", *key], expected)
    assert key not in got.keys(True)
    assert not torch.equal(data["vehicles", "time_gap"], data["next", "vehicles", "time_gap"])


# -- a term of one's own ---------------------------------------------------------------------------


class Comfort(RewardTerm):
    """As the documentation says how."""

    reads = ("self.jerk",)

    def reward(self, jerk: torch.Tensor) -> torch.Tensor:
        return -jerk.abs()


def test_a_term_appended_to_an_environment_counts() -> None:
    plain, env = (small_env("alcc", 3, seed=2) for _ in range(2))
    env.append_transform(Comfort(weight=0.5))
    check_env_specs(env)
    # Appended after the checks, whose random actions draw from the environment's generator.
    one, two = (e.set_seed(7) and e.rollout(10, zero) for e in (plain, env))
    term = two["next", *TERMS, "comfort"]
    torch.testing.assert_close(term, -0.5 * two["next", "vehicles", "jerk"][..., :1, :].abs())
    assert term.min() < 0
    torch.testing.assert_close(two["next", *REWARD], one["next", *REWARD] + term)


def zero(td: TensorDictBase) -> TensorDictBase:
    return td.set(ACTION, torch.full((3, 1, 1), 0.2))


# -- policies --------------------------------------------------------------------------------------

PLATOON = VehicleString(("automated",) * 3)
POLICIES: dict[str, tuple[str, Callable]] = {
    "CACC": ("ddpg", lambda: ControllerPolicy(CACC(0.2, string=PLATOON))),
    "DeadBeat": ("ddpg", lambda: ControllerPolicy(DeadBeat(0.2, string=PLATOON))),
    "FollowerStopper": (
        "ddpg",
        lambda: ControllerPolicy(FollowerStopper(0.2, 8.0, string=PLATOON)),
    ),
    "ConstantAcceleration": (
        "ddpg",
        lambda: ControllerPolicy(ConstantAcceleration(0.3, PLATOON)),
    ),
    "network": ("ddpg", lambda: shared_policy(make_actor(6, 1, (8,), 0))),
    "network that explores": (
        "ddpg",
        lambda: TensorDictSequential(
            shared_policy(make_actor(6, 1, (8,), 0)), GaussianExploration(0.3)
        ),
    ),
}
EACH_POLICY = pytest.mark.parametrize("name", list(POLICIES))


@cache
def driven(name: str, batch_size: int | tuple[int, ...] = 3) -> tuple:
    variant, make = POLICIES[name]
    env = small_env(variant, batch_size, ["scenario.string=automated*3"])
    with torch.no_grad():
        return make(), env.rollout(10, make(), break_when_any_done=False)


@EACH_POLICY
def test_a_policy_offline_equals_online(name) -> None:
    policy, data = driven(name)
    assert data[ACTION].shape == (3, 10, 3, 1)
    with torch.no_grad():
        got = policy(data.exclude(ACTION).clone())
        also = TensorDictSequential(policy)(data.exclude(ACTION).clone())
    torch.testing.assert_close(got[ACTION], data[ACTION], rtol=1e-6, atol=1e-6)
    assert torch.equal(also[ACTION], got[ACTION])
    assert data[ACTION].std() > 0 or name == "ConstantAcceleration"


@EACH_POLICY
def test_a_policy_by_keyword_and_without_batch(name) -> None:
    policy, data = driven(name, ())
    entries = {"_".join(key): data[key] for key in policy.in_keys if key != ACTION}
    with torch.no_grad():
        got = policy(**entries)
        single = policy(data[4].exclude(ACTION).clone())
    got = got[-1] if isinstance(got, tuple) else got
    torch.testing.assert_close(got, data[ACTION], rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(single[ACTION], data[4][ACTION], rtol=1e-6, atol=1e-6)


def test_a_network_by_keyword() -> None:
    actor = make_actor(6, 1, (8,), 0)
    seen = driven("network")[1][OBSERVATION]
    with torch.no_grad():
        assert torch.equal(
            actor(observation=seen), shared_policy(actor)(automated_observation=seen)
        )


@pytest.mark.parametrize("variant", ["cacc", "deadbeat"])
def test_a_controller_drives_as_well_as_a_policy(variant) -> None:
    """The same motion, whether the controller commands or acts."""
    own = ["scenario.string=automated*3"]
    rule = small_env(variant, 3, own).rollout(20)
    controller = {"cacc": CACC, "deadbeat": DeadBeat}[variant](0.2, string=PLATOON)
    acting = small_env("ddpg", 3, own).rollout(20, ControllerPolicy(controller))
    for name in ("speed", "gap", "command"):
        torch.testing.assert_close(
            acting["next", "vehicles", name], rule["next", "vehicles", name], rtol=1e-4, atol=1e-4
        )
