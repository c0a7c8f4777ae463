"""The contract that every piece passes: one object in every role, offline equal to online.

One string holds a role for every controller, so that all pieces act in one environment: on an
open road, with places drawn, and on a ring.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from importlib.util import find_spec
from itertools import product

import pytest
import torch
from helpers import ACTION, MIXED, POPULATION, REWARD, TERMS, followed_profiles, slow_but, small_env
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import Compose, TransformedEnv, check_env_specs

import lcc_rl.pieces as room
from lcc_rl.agents.actor import GaussianExploration, make_actor, shared_policy
from lcc_rl.agents.controller import ControllerPolicy
from lcc_rl.energy import CirclesFuel, ElectricCar, Fleet, as_fleet
from lcc_rl.envs.clock import Clock, Traffic
from lcc_rl.envs.step import Pieces, pieces_of
from lcc_rl.pieces import (
    CACC,
    FVDM,
    HCFS,
    IDM,
    IDMACC,
    MPC,
    OVM,
    Action,
    Actuation,
    CalibratedDrivers,
    Calm,
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
    Entry,
    EquilibriumStart,
    ExcessSpacing,
    Feature,
    FollowerStopper,
    Gipps,
    Handover,
    HeadwayStart,
    Hybrid,
    JerkReward,
    Law,
    LeaderPreview,
    LinearACC,
    MotorPower,
    NGSIMLeader,
    Observation,
    ObservationMemory,
    PathEnergy,
    Piece,
    PISaturation,
    RangeReward,
    RecordedDriver,
    ReplacedLeader,
    RewardPiece,
    RewardTerm,
    RolePlaces,
    SafetyReward,
    Sensors,
    Slope,
    SlopePreview,
    SmoothEfficiency,
    Smoothness,
    SmoothRange,
    SmoothSafety,
    SpacingReward,
    SpeedSpread,
    StepTransform,
    StringMotion,
    TimeGap,
    TimeGapStart,
    TimeToCollision,
    TotalReward,
    TrafficAhead,
    VehicleString,
    VelocityReward,
)
from lcc_rl.pieces.base import as_key
from lcc_rl.pieces.world import World

HORIZON, T = 12, 0.1
LATE = Actuation(delay=0.2, lag=0.3)
BLURRED = Sensors(gap_error=0.5, delay=0.2, dropouts=0.3, longest_dropout=0.2)
FLEET = Fleet(
    {"car": CirclesFuel(), "electric": ElectricCar()}, roles={"automated": {"electric": 1.0}}
)
HILLS = Slope(points=((0.0, 0.0), (30.0, 0.03), (90.0, -0.02)), repeats=True)
# Whose package is an extra, and not installed here.
MISSING = set() if find_spec("osqp") else {MPC}
CONNECTED = ("cacc", "beat", "hybrid")
ROLES = ("human", "automated", "human", "cacc", "cacc", "automated", "beat", "stopper")
ROLES = (
    *ROLES,
    "handover",
    "saturating",
    "constant",
    "lawful",
    "plain",
    "slow",
    "following",
    "cruising",
    "planning",
    "hybrid",
    "hybrid",
    "human",
    *("late", "optimal", "difference", "gipps", "calibrated", "calibrated", "calm"),
)
STRINGS = {
    "open": VehicleString((*ROLES, "recorded")),
    "drawn": VehicleString((*ROLES, "recorded"), drawn=True),
    "ring": VehicleString(ROLES, ring=True),
    "replaced": VehicleString(ROLES),
}
SCALES = {
    "self": {"speed": 0.1, "gap": 0.1},
    "ahead": {"speed": 0.1},
    "behind": {"speed": 0.1, "gap": 0.1},
    "memory": {"entries": 0.5},
}
DRIVEN = ("human", "handover", "late", "optimal", "difference", "gipps", "calibrated")
ACTIONS = {ACTION: (2, 1), ("plain", "action"): (1, 1), ("hybrid", "action"): (2, 1)}
BASES = (Piece, Feature, StepTransform, RewardPiece, RewardTerm, Controller, DriverModel, Hybrid)
STARTS = (HeadwayStart, TimeGapStart, EquilibriumStart)


def leading(road: str) -> dict[str, Piece]:
    """The pieces that there are only behind a leader."""
    if road == "replaced":
        return {"ReplacedLeader": ReplacedLeader(at=(2 * T, 4 * T), gap=(5.0, 9.0))}
    return {
        "NGSIMLeader": NGSIMLeader(perturbation=0.5, foresight=True),
        "LeaderPreview": LeaderPreview(horizons=[0.5, 3.0], noise=0.2),
    }


def steady(gap, speed, ahead_speed):
    return (0.1 * (gap - 2.0 - speed) + 0.5 * (ahead_speed - speed)).clamp(-3.0, 3.0)


def driver(kind: type[DriverModel], delay: int) -> DriverModel:
    return kind(wiener=0.1, delay=delay, parameters=kind.law())


def controllers() -> dict[str, tuple[str, Piece]]:
    """Every controller and filter, and the role that it drives."""
    human, stopper = IDM(noise=0.05, wiener=0.1), FollowerStopper(window=0.5)
    planning = {"LinearACC, planning": LinearACC()} if MISSING else {"MPC": MPC(horizon=3.0)}
    cacc = CACC(k3=0.4)
    return {
        **{name: ("planning", piece) for name, piece in planning.items()},
        "Action, filtered": ("automated", Action()),
        "Action": ("plain", Action()),
        "IDM": ("human", human),
        "IDM, late": ("late", driver(IDM, 3)),
        "OVM": ("optimal", driver(OVM, 0)),
        "FVDM": ("difference", driver(FVDM, 1)),
        "Gipps": ("gipps", driver(Gipps, 2)),
        "CalibratedDrivers": ("calibrated", CalibratedDrivers(wiener=0.1, delay=2)),
        "CACC": ("cacc", cacc),
        "CACC, literal": ("printed", CACC(literal=True)),
        "DeadBeat": ("beat", DeadBeat()),
        "FollowerStopper": ("stopper", stopper),
        "PISaturation": ("saturating", PISaturation(window=0.5)),
        "Calm": ("calm", Calm(window=0.5)),
        "Handover": ("handover", Handover(before=human, after=stopper, from_s=0.5)),
        "IDMACC": ("following", IDMACC()),
        "LinearACC": ("cruising", LinearACC()),
        "Law": ("lawful", Law(law=f"{__name__}.steady")),
        "ConstantAcceleration": ("constant", ConstantAcceleration(acceleration=0.3)),
        "HCFS": ("hybrid", HCFS(rule=cacc, spacing_weight=0.02, spacing_time=1.0)),
        "CBFFilter": ("automated", CBFFilter()),
        "Corrected": ("automated", Corrected()),
        "ConstantAcceleration, late": ("slow", ConstantAcceleration(acceleration=0.3)),
        "Actuation": ("slow", LATE),
    }


def motion(string: VehicleString) -> StringMotion:
    start = {role: TimeGapStart() for role in string.names}
    start |= {role: EquilibriumStart() for role in DRIVEN}
    start |= {role: HeadwayStart() for role in CONNECTED}
    length = 30.0 * len(string) if string.ring else None
    return StringMotion(start=start, circumference=length, initial_speed=8.0)


def rewards() -> dict[str, tuple[str | None, Piece]]:
    """Every reward term, and its name where there are several of a class."""
    estimated = EnergyReward(of="behind", power="human.predicted_power")
    return {
        "SafetyReward": (None, SafetyReward()),
        "EfficiencyReward": (None, EfficiencyReward()),
        "EnergyReward": ("self_energy", EnergyReward()),
        "EnergyReward, behind": ("behind_energy", EnergyReward(of="behind")),
        "EnergyReward, estimated": ("estimated", estimated),
        "EnergyReward, string": ("string_energy", EnergyReward(of="string")),
        "CollisionPenalty": (None, CollisionPenalty()),
        "RangeReward": ("longest", RangeReward(largest=9.0)),
        "SmoothRange": ("shortest", SmoothRange(entry="time_gap", least=1.2)),
        "VelocityReward": (None, VelocityReward()),
        "JerkReward": (None, JerkReward()),
        "SpacingReward": (None, SpacingReward()),
        "SmoothSafety": (None, SmoothSafety()),
        "SmoothEfficiency": (None, SmoothEfficiency()),
        "Smoothness": (None, Smoothness()),
        "SpeedSpread": (None, SpeedSpread()),
        "Correction": (None, Correction()),
        "ExcessSpacing": (None, ExcessSpacing()),
        "PathEnergy": ("path_energy", PathEnergy()),
        "PathEnergy, mixed": ("path_mixed", PathEnergy()),
        "PathEnergy, behind": ("path_behind", PathEnergy(of="behind")),
    }


def makers(road: str) -> dict[str, Callable[[], Piece]]:
    """Every piece, in the order in which a scenario needs them."""
    string = STRINGS[road]
    kind = "stacked" if road == "drawn" else "filtered"
    believed = MotorPower(
        vehicles="human", acceleration="predicted_acceleration", power="predicted_power"
    )
    memory = ObservationMemory(sources=["ahead.speed", "self.gap"], seconds=[0.5, 1.0], kind=kind)
    terms = rewards()
    listed = [name or piece.name for name, piece in terms.values()]
    unnamed = {
        "StringMotion": motion(string),
        "Communication": Communication(connected=CONNECTED),
        "DriverEstimator": DriverEstimator(learning_time=0.5),
        "TimeToCollision": TimeToCollision(),
        "TimeGap": TimeGap(),
        "EnergyClasses": EnergyClasses(),
        "MotorPower": MotorPower(),
        "MotorPower, mixed": MotorPower(power="mixed_power"),
        "MotorPower, estimated": believed,
        "Collision": Collision(),
        "TrafficAhead": TrafficAhead(places=(1, 2)),
        "ObservationMemory": memory,
        "ObservationMemory, spread": ObservationMemory(seconds=[0.5, 1.0], kind="spread"),
        "Observation": Observation(scales=SCALES, visible=2, widths={"memory": 4}),
    }
    hills = {
        "Slope": ("leader", HILLS),
        "Slope, vehicles": ("vehicles", HILLS),
        "SlopePreview": (None, SlopePreview()),
        "MotorPower, sloped": (None, MotorPower(power="sloped_power")),
    }
    first = {"RolePlaces": RolePlaces(), **({} if string.ring else leading(road))}
    pieces: dict[str, tuple[str | None, Piece]] = {
        **{name: (None, piece) for name, piece in first.items()},
        **controllers(),
        **(
            {"RecordedDriver": ("recorded", RecordedDriver())} if "recorded" in string.names else {}
        ),
        **{name: (None, piece) for name, piece in unnamed.items()},
        **({} if string.ring else hills),
        "Sensors": ("slow", BLURRED),
        **terms,
        "TotalReward": (None, TotalReward(terms=listed)),
    }
    return {
        label: partial(piece.bind, world_of(road, label), name)
        for label, (name, piece) in pieces.items()
    }


def world_of(road: str, label: str) -> World:
    world = World(STRINGS[road], T, HORIZON, followed_profiles(), POPULATION, as_fleet(None))
    faults = {"actuators": {"slow": LATE}, "sensors": {"slow": BLURRED}}
    world = replace(world, filtered=["automated"], replaced=road == "replaced", **faults)
    if label == "CalibratedDrivers":
        return replace(world, population=MIXED)
    sloped = "lope" in label
    mixed = sloped or label.endswith("mixed") or label == "EnergyClasses"
    world = replace(world, slope=HILLS) if sloped else world
    return replace(world, energy=FLEET) if mixed else world


@cache
def made(road: str) -> dict[str, Piece]:
    return {name: make() for name, make in makers(road).items()}


# Every piece is on the drawn road; make test-all drives them on the others, too.
EACH_ROAD = pytest.mark.parametrize("road", slow_but(["drawn"], STRINGS))


def each_piece(check: Callable[[str, str], None]) -> Callable[[str], None]:
    """Check every piece of a road."""

    def check_all(road: str) -> None:
        for name in made(road):
            check(road, name)

    check_all.__name__ = check.__name__
    return EACH_ROAD(check_all)


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


@pytest.mark.parametrize("piece", [SafetyReward(), IDM(), TimeGap()])
def test_a_piece_that_is_not_bound_says_so(piece) -> None:
    with pytest.raises(AttributeError, match=r"not bound to a world yet: use \w+\(…\)\.bind"):
        piece(TensorDict({}, [2]))


def test_every_exported_class_is_under_contract() -> None:
    exported = {kind for kind in vars(room).values() if inspect.isclass(kind)}
    tested = {type(piece) for road in STRINGS for piece in made(road).values()}
    assert exported == tested | MISSING | {*BASES, *STARTS, Entry, VehicleString}


@pytest.mark.parametrize(
    ("road", "batch_size"),
    slow_but([("drawn", 3), ("open", ()), ("ring", (2, 2))], product(STRINGS, [(), 3, (2, 2)])),
)
def test_environment_of_all_pieces_passes_torchrls_check(road, batch_size) -> None:
    check_env_specs(full_env(road, batch_size), break_when_any_done="both")


@EACH_ROAD
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
    made, stock = (x.rand_step(x.reset())["next"] for x in (env, full_env(road)))
    assert made["vehicles"].batch_size == stock["vehicles"].batch_size
    assert [made.device, made.is_locked, made.names] == [stock.device, stock.is_locked, stock.names]


@pytest.mark.parametrize("road", list(STRINGS))
def test_a_step_lays_out_what_the_next_one_reads_as_a_reset_does(road) -> None:
    """Else a compiled step would be compiled once more."""
    env = full_env(road)
    start = env.reset()
    reached = env.rand_step(start)["next"]
    steps = [piece for piece in pieces_of(env) if isinstance(piece, StepTransform)]
    read = {key for piece in steps for late, key in piece.needs if not late}
    for key in read - set(ACTIONS):
        before, after = (
            [step for step, size in zip(x.stride(), x.shape, strict=True) if size > 1]
            for x in (start[key], reached[key])
        )
        assert before == after, key


@each_piece
def test_offline_on_a_stored_rollout_also_inside_a_sequential_equals_online(road, name) -> None:
    piece, data = made(road)[name], played(road)
    part = moment(piece, data)
    assert_results_equal(piece, piece(without_results(piece, part)), part)
    if isinstance(piece, RewardPiece):  # a sequence of modules works on one moment
        got = TensorDictSequential(piece)(without_results(piece, part)["next"])
        for key in piece.out_keys:
            assert same(piece, got[key], part["next", *key]), key
        return
    assert_results_equal(piece, TensorDictSequential(piece)(without_results(piece, part)), part)


@each_piece
def test_without_batch(road, name) -> None:
    piece = made(road)[name]
    single = moment(piece, played(road, ()))[7]
    assert single.batch_size == ()
    assert_results_equal(piece, piece(without_results(piece, single)), single)


@each_piece
def test_by_keyword(road, name) -> None:
    piece, data = made(road)[name], played(road)
    if not piece.in_keys:
        return
    part = data if isinstance(piece, StepTransform) else data["next"]
    got = piece(**{"_".join(as_key(key)): part[key] for key in piece.in_keys})
    got = got if isinstance(got, tuple) else (got,)
    for key, value in zip(piece.out_keys, got, strict=True):
        assert same(piece, value, part[key]), key


@each_piece
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


@each_piece
def test_written_specs_match_what_is_written(road, name) -> None:
    piece, reached = made(road)[name], played(road)[:, 3]["next"]
    layouts = piece.layouts(reached.batch_size)
    assert set(layouts) >= set(piece.targets)
    for key, layout in layouts.items():
        if key not in (("done",), ("terminated",)):
            assert (reached[key].shape, reached[key].dtype) == layout, key


@pytest.mark.parametrize("road", list(STRINGS))
def test_constants_keep_their_value(road) -> None:
    data, checked = played(road), 0
    for piece in made(road).values():
        for key in piece.constants if isinstance(piece, StepTransform) else ():
            assert torch.equal(data[key], data["next", *key]), key
            checked += 1
    assert checked >= 7


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

PLATOON = World(VehicleString(("automated",) * 3), 0.2)


def policy_of(controller: Controller) -> ControllerPolicy:
    return ControllerPolicy(controller.bind(PLATOON))


POLICIES: dict[str, tuple[str, Callable]] = {
    "CACC": ("ddpg", lambda: policy_of(CACC())),
    "DeadBeat": ("ddpg", lambda: policy_of(DeadBeat())),
    "FollowerStopper": ("ddpg", lambda: policy_of(FollowerStopper(desired_speed=8.0))),
    "ConstantAcceleration": ("ddpg", lambda: policy_of(ConstantAcceleration(acceleration=0.3))),
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


@pytest.mark.parametrize("variant", ["cacc", "deadbeat"])
def test_a_controller_drives_as_well_as_a_policy(variant) -> None:
    """The same motion, whether the controller commands or acts."""
    own = ["scenario.string=automated*3"]
    rule = small_env(variant, 3, own).rollout(20)
    controller = {"cacc": CACC, "deadbeat": DeadBeat}[variant]()
    acting = small_env("ddpg", 3, own).rollout(20, policy_of(controller))
    for name in ("speed", "gap", "command"):
        torch.testing.assert_close(
            acting["next", "vehicles", name], rule["next", "vehicles", name], rtol=1e-4, atol=1e-4
        )
