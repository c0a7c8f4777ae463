"""Human drivers of every model: in any role, with noise, late, and mixed in one population."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch
from helpers import MIXED, POPULATION, compose, slow_but, wavy_profiles
from torchrl.envs import check_env_specs

from lcc_rl.data.profiles import from_records
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import constant_profiles
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError
from lcc_rl.functional.driver_models import Reaction
from lcc_rl.functional.laws import LAWS
from lcc_rl.pieces import IDM
from lcc_rl.pieces.world import World

MODELS = {"idm": "human", "ovm": "ovm", "fvdm": "fvdm", "gipps": "gipps"}
EACH = pytest.mark.parametrize("model", list(MODELS))
QUIET = "scenario.controllers.human.noise=0"
MOTION = ("speed", "gap", "relative_speed")


def human(controller: str, *more: str):
    """Return the configuration of three human drivers of one controller."""
    choice = f"controller@scenario.controllers.human={controller}"
    return compose("direct", choice, "scenario.string=human*3", *more)


def rolled(cfg, profiles=None, population=POPULATION, steps=20, batch=4, seed=0):
    """Play a few steps."""
    env = build_env(cfg, profiles or wavy_profiles(), population, batch, seed, nominal=True)
    return env.rollout(steps, break_when_any_done=False)


def steady(speed: float = 4.0):
    """Return a leader at a speed that every driver wants to exceed."""
    return constant_profiles(speed, 400, 0.1, ["steady"])


@pytest.mark.parametrize(
    ("controller", "delay"),
    slow_but(
        [("human", 0), *((x, 4) for x in MODELS.values()), ("calibrated", 4)],
        product([*MODELS.values(), "calibrated"], [0, 4]),
    ),
)
def test_every_model_passes_torchrls_check_in_any_role(controller, delay) -> None:
    late = f"scenario.controllers.human.delay={delay}"
    population = MIXED if controller == "calibrated" else POPULATION
    env = build_env(human(controller, late), wavy_profiles(), population, 2)
    check_env_specs(env)
    other = f"scenario.controllers.automated.delay={delay}"
    choice = f"controller@scenario.controllers.automated={controller}"
    people = f"controller@scenario.controllers.human={controller}"
    cfg = compose("alcc", choice, other, people)
    check_env_specs(build_env(cfg, wavy_profiles(), population, 2))


@EACH
def test_drivers_start_at_their_equilibrium_and_stay(model) -> None:
    cap = "scenario.start.human.cap_time_gap=100"
    data = rolled(human(MODELS[model], QUIET, cap), steady(), batch=64, seed=3)
    assert data["next", "human", "command"].abs().max() < 1e-3


def test_idm_drivers_with_own_parameters_start_at_their_own_equilibrium() -> None:
    own = "{_target_: lcc_rl.functional.idm.IDMConstants, min_gap: 4.0, acceleration: 2.0}"
    cap = "scenario.start.human.cap_time_gap=100"
    cfg = human("human", QUIET, cap, f"+scenario.controllers.human.parameters={own}")
    data = rolled(cfg, steady(), batch=64, seed=3)
    assert data["next", "human", "command"].abs().max() < 1e-3


@EACH
def test_a_delay_replays_the_same_law_on_what_was(model) -> None:
    delay = 3
    data = rolled(human(MODELS[model], QUIET, f"scenario.controllers.human.delay={delay}"))
    seen = {name: data["vehicles", name] for name in MOTION}
    own = LAWS[model]()
    for step in range(12):
        speed, gap, relative = (values[:, max(step - delay, 0)] for values in seen.values())
        drivers = (data["human", name][:, step] for name in ("desired_speed", "desired_time_gap"))
        expected = own(speed, gap, -relative, *drivers)
        assert torch.equal(data["next", "human", "command"][:, step], expected), step


@pytest.mark.slow
def test_a_delay_makes_a_string_less_stable() -> None:
    time = torch.arange(600) * 0.1
    dip = 15.0 - 3.0 * torch.exp(-(((time - 15.0) / 3.0) ** 2))
    profiles = from_records([dip], ["dip"], ["dip"], 0.1)
    first = "scenario.pieces.leader.start=first"
    base = ["scenario.string=human*8", "scenario.horizon=500", QUIET, first]
    one = ["scenario.controllers.human.desired_speed=30", "scenario.controllers.human.time_gap=1.2"]
    lowest = []
    for delay in (0, 8):
        cfg = compose("direct", *base, *one, f"scenario.controllers.human.delay={delay}")
        speed = rolled(cfg, profiles, steps=500, batch=1)["next", "vehicles", "speed"]
        lowest.append(float(speed[..., -1, :].min()))
    assert lowest[1] < lowest[0] - 0.3


@pytest.mark.parametrize("model", slow_but(["idm"], MODELS))
def test_noise_is_that_of_the_paper_for_every_model(model) -> None:
    quiet = rolled(human(MODELS[model], QUIET), steps=1, batch=64)["next", "human", "command"]
    noisy = rolled(human(MODELS[model], QUIET.replace("=0", "=0.3")), steps=1, batch=64)
    ratio = (noisy["next", "human", "command"] / quiet)[quiet.abs() > 1e-3]
    assert ratio.min() >= 1.0 - 1e-5
    assert ratio.max() < 1.3 + 1e-5
    assert ratio.mean() == pytest.approx(1.15, abs=0.05)
    walk = "scenario.controllers.human.wiener=0.5"
    moved = rolled(human(MODELS[model], QUIET, walk), steps=1, batch=256)
    same = rolled(human(MODELS[model], QUIET), steps=1, batch=256)
    added = (moved["next", "human", "command"] - same["next", "human", "command"]) * 0.1**0.5
    assert added.std().item() == pytest.approx(0.5, rel=0.1)


def test_drivers_react_as_their_population_does() -> None:
    cfg, reacting = human("human", QUIET), replace(POPULATION, reaction=Reaction(0.3, 0.25))
    data = rolled(cfg, population=reacting, batch=256, steps=20)
    assert data["human", "motion_history"].shape[-1] == 3 * 3
    noise = data["next", "human", "acceleration_noise"][..., :1].squeeze(-1)
    assert noise.std().item() == pytest.approx(0.25, rel=0.05)
    # Two low-passes of 0.7 s: ρ = e^−1/7 = 0.8669, after k steps (1 + k (1 − ρ²)/(1 + ρ²)) ρᵏ, from
    # the first step on; each car has its own.
    for steps, expected in ((1, 0.990), (5, 0.837), (10, 0.580)):
        later = (noise[:, steps:] * noise[:, :-steps]).mean() / noise.square().mean()
        assert later.item() == pytest.approx(expected, abs=0.06), steps
    assert noise[:, 0].std().item() == pytest.approx(0.25, rel=0.12)
    assert abs(float((noise[..., 0] * noise[..., 1]).mean())) < 0.01
    # It is what is added to the late law.
    late = rolled(human("human", QUIET, "scenario.controllers.human.delay=3"), batch=256, steps=1)
    command = data["next", "human", "command"][:, 0, :, 0]
    assert torch.allclose(command, late["next", "human", "command"][:, 0, :, 0] + noise[:, 0])
    # Settings of the controller come first; a driver of given (v0, T) is not of the population.
    own = [f"scenario.controllers.human.{x}=0" for x in ("delay", "acceleration_noise")]
    given = [f"scenario.controllers.human.{x}" for x in ("desired_speed=20", "time_gap=1.2")]
    for more in (own, given):
        keys = rolled(human("human", QUIET, *more), population=reacting).keys(True, True)
        assert not {("human", "motion_history"), ("human", "acceleration_noise")} & set(keys)


def test_drivers_misjudge_their_gaps_as_their_population_does() -> None:
    cfg, reacting = human("human", QUIET), replace(POPULATION, reaction=Reaction(0.3, 0.25, 0.2))
    data = rolled(cfg, population=reacting, batch=256, steps=20)
    noise = data["next", "human", "gap_noise"][..., :1].squeeze(-1)
    assert noise.std().item() == pytest.approx(0.2, rel=0.1)
    # Two low-passes of 2 s: ρ = e^−1/20, see above.
    later = (noise[:, 10:] * noise[:, :-10]).mean() / noise.square().mean()
    assert later.item() == pytest.approx(0.910, abs=0.06)
    # The gap alone is seen so, by the late law, to which the noise of the acceleration is added.
    exact = rolled(
        cfg, population=replace(reacting, reaction=Reaction(0.3, 0.25)), batch=256, steps=1
    )
    command, other = (x["next", "human", "command"][:, 0, :, 0] for x in (data, exact))
    nearer = noise[:, 0] < 0.0
    assert (command[nearer] <= other[nearer]).all()
    assert (command[~nearer] >= other[~nearer]).all()
    added = data["next", "human", "acceleration_noise"]
    assert torch.equal(added[:, 0], exact["next", "human", "acceleration_noise"][:, 0])
    keys = rolled(
        human("human", QUIET, "scenario.controllers.human.gap_noise=0"), population=reacting
    )
    assert ("human", "gap_noise") not in keys.keys(True, True)


def test_each_driver_of_a_mixture_has_its_own_model_and_parameters() -> None:
    data = rolled(human("calibrated", QUIET), population=MIXED, batch=16)
    own, driver = MIXED.parameters(), data["human", "driver"]
    speed, gap, relative = (data["vehicles", name] for name in MOTION)
    command = data["next", "human", "command"]
    for number, model in enumerate(MIXED.models):
        law, chosen = LAWS[model], driver == number
        values = {name: float(x[number]) for name, x in own.items()}
        constants = law(**{name: values[name] for name in law.shared()})
        expected = constants(
            *(speed[chosen], gap[chosen], -relative[chosen]),
            *(values["desired_speed"], values["time_gap"]),
        )
        torch.testing.assert_close(command[chosen], expected, rtol=1e-4, atol=1e-4)


def test_calibrated_idm_drivers_are_those_of_the_idm() -> None:
    by_idm = rolled(human("human"))
    by_table = rolled(human("calibrated"))
    for key in (("vehicles", "speed"), ("human", "driver")):
        assert torch.equal(by_idm["next", key], by_table["next", key])
    # Drivers that differ in more than (v0, T) are those of the table by default.
    for population in (bootstrap(mode="global"), MIXED):
        both = (rolled(human(x), population=population) for x in ("human", "calibrated"))
        assert torch.equal(*(data["next", "vehicles", "speed"] for data in both))
    with pytest.raises(
        ConfigError, match=r"s0; controller@scenario\.controllers\.human=calibrated"
    ):
        type("Own", (IDM,), {})().bind(World(population=bootstrap(mode="global")))
    # One driver of given (v0, T) has the mean of what differs by driver.
    people = "controller@scenario.controllers.human=calibrated"
    cfg = compose("alcc", "controller@scenario.controllers.automated=idm", people)
    env = build_env(cfg, steady(), bootstrap(mode="global"), 2)
    (one,) = (piece for piece in pieces_of(env) if type(piece) is IDM)
    assert one.drivers == bootstrap(mode="global").constants.mean()


def test_a_handover_passes_on_what_a_late_driver_remembers() -> None:
    cfg = compose(
        "reference",
        "scenario=ring",
        "controller@scenario.controllers.automated=handover",
        "scenario.controllers.human.delay=2",
        "scenario.string=automated human*3",
        "scenario.horizon=20",
    )
    check_env_specs(build_env(cfg, steady(), POPULATION, 2))


def test_every_episode_of_training_draws_its_delay() -> None:
    def played(nominal: bool, *more: str, batch: int = 64) -> torch.Tensor:
        cfg = human("human", QUIET, *(f"scenario.controllers.human.{x}" for x in more))
        env = build_env(cfg, wavy_profiles(), POPULATION, batch, 0, nominal=nominal)
        return env.rollout(12, break_when_any_done=False)["vehicles", "speed"]

    known = torch.stack([played(False, f"delay={late}") for late in range(4)])
    drawn = played(False, "delay_range=[0,3]")
    equal = ((known - drawn).abs() < 1e-5).flatten(2).all(-1)
    assert (equal.sum(0) == 1).all()
    assert (equal.sum(1) > 5).all()
    assert torch.equal(played(True, "delay_range=[1,3]", "delay=2"), played(True, "delay=2"))
    louder = "acceleration_noise_range=[0,0.4]"
    assert torch.equal(played(True, louder), played(True))
    quiet, loud = played(False), played(False, "acceleration_noise=0.4")
    apart, most = ((x - quiet).abs().mean((1, 2, 3)) for x in (played(False, louder), loud))
    assert (apart < most).all()
    assert apart.min() < 0.1 * most.min()
    for name in ("delay", "acceleration_noise"):
        with pytest.raises(ConfigError, match=rf"{name}_range: must not fall, got \[3.*, 1"):
            played(False, f"{name}_range=[3,1]")
