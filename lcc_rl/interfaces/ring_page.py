"""A page of the ring road with a policy, for any browser.

The page needs no server and no other file. It computes the equations of this package with the
weights of the policy and the ring, drivers and cars of its training, or else of ``task=ring-22``.
It has the package's random numbers, so equal seeds give equal drives in both.
"""

from __future__ import annotations

import shlex
from base64 import b64encode
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch import nn

from lcc_rl.assets import page_of
from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.unused import drawn_in_training, refuse
from lcc_rl.config.words import key_of, top_key
from lcc_rl.energy.fuel import STANDSTILL, STILL, CirclesFuel
from lcc_rl.envs.factory import build_env
from lcc_rl.envs.inputs import build_energy, load_inputs
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, MAX_ACCELERATION, RING
from lcc_rl.functional.random import stream_id
from lcc_rl.interfaces.driver import Driver
from lcc_rl.interfaces.exported import NetworkController
from lcc_rl.pieces import CBFFilter
from lcc_rl.pieces.cbf import SLOWEST
from lcc_rl.pieces.controllers import stream_name
from lcc_rl.pieces.drivers import IDM, Drivers
from lcc_rl.pieces.knowledge import ObservationMemory
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import values

RING_TASK = ("variant=alcc", "task=ring-22")
NOT_ON_PAGE = ("sensors", "actuators", "fleet")
OF_RING = (*NOT_ON_PAGE, "circumference", "string", "vehicle_length", "initial_speed", "time_step")
OF_DRIVERS = ("drivers", "controllers.human")
SHOWN = ("drivers", "energy", *(f"scenario.{name}" for name in (*OF_RING[3:], OF_DRIVERS[1])))
DRAWS = ("noise", "wiener", "acceleration_noise", "acceleration_noise.before", "driver")
RING_RULES = ("follower_stopper", "pi_saturation")
# Layers that the page can compute.
LAYERS, VIEWS = (nn.Linear, nn.ReLU, nn.Tanh), ("self", "ahead", "behind", "memory")


def ring_page(policy: str | Path, trust: Sequence[str] = (), overrides: Sequence[str] = ()) -> str:
    """Return the page with all data.

    Args:
        policy: a run folder, a policy file, or ``pretrained/<name>``.
        trust: modules outside this package that the policy may name.
        overrides: settings of the ring, its drivers and cars.

    Raises:
        LccError: if the policy cannot be read, or the page cannot compute it or the ring.
    """
    return page_of("ring.html", page_data(policy, trust, overrides))


def page_data(policy: Any, trust: Sequence[str], overrides: Sequence[str]) -> dict[str, Any]:
    """Return all numbers of the page; arguments as for :func:`ring_page`."""
    cfg = ring_of(policy, trust, overrides)
    scenario, vehicles, energy = cfg.scenario, cfg.scenario.vehicles, build_energy(cfg).models
    car = energy[0] if len(energy) == 1 and isinstance(energy[0], CirclesFuel) else None
    strange = [f"role {name}" for name in vehicles.names if name not in (HUMAN, AUTOMATED)]
    strange += [f"scenario.{x}" for x in NOT_ON_PAGE if getattr(scenario, x)]
    limits = {"max_braking": scenario.max_braking, "max_acceleration": scenario.max_acceleration}
    strange += [f"scenario.{name}={x:g}" for name, x in limits.items() if x != MAX_ACCELERATION]
    if car is None or car.truck or car.grade:
        strange.append("energy (only one car on a level road: energy=compact)")
    human = None if strange else _human(cfg)
    if human is None and not strange:
        strange.append("drivers (only IDM drivers that share a, b and s0, without gap_noise)")
    if strange or car is None:
        raise ConfigError(f"{policy}: a page of the ring does not support {', '.join(strange)}")
    refuse(overrides, drawn_in_training(scenario))
    for override in overrides:
        key = key_of(override).removeprefix("controller@")
        require(key.startswith(SHOWN), f"{override} has no effect: a page shows {', '.join(SHOWN)}")
    rules = {name: Driver(name, scenario.time_step).program.controller for name in RING_RULES}
    count, some = len(vehicles), vehicles.count(AUTOMATED)
    spread = [k * count // some for k in range(some)]
    return {
        "policy": str(policy),
        "command": shlex.join(["lcc-rl", "export", str(policy), "ring.html", *overrides]),
        "time_step": scenario.time_step,
        "circumference": scenario.circumference,
        "length": scenario.vehicle_length,
        "initial_speed": scenario.initial_speed,
        "count": count,
        "automated": spread if vehicles.drawn else vehicles.places(AUTOMATED),
        "human": human,
        "streams": {
            role: {kind: stream_id(f"{stream_name(role)}.{kind}") for kind in DRAWS}
            for role in (HUMAN, AUTOMATED)
        },
        "rules": {name: _rule(rule) for name, rule in rules.items()},
        "network": _network(policy, scenario.time_step, trust),
        "vehicle": car.vehicle,
        "fuel": {**car.own, "standstill": STANDSTILL, "still": STILL},
    }


def ring_of(policy: str | Path, trust: Sequence[str], overrides: Sequence[str]) -> StudyConfig:
    """Return the ring of a policy's training, or else of the task, with overrides."""
    cfg: StudyConfig = load("evaluate", [*RING_TASK, *overrides])
    trained, keys = load_policy(policy, trust=trust)[1], [key_of(x) for x in overrides]
    if trained.scenario.road != RING:
        return cfg
    ring = {
        name: getattr(trained.scenario, name)
        for name in OF_RING
        if getattr(trained.scenario, name) != {}
        and not any(key.startswith(f"scenario.{name}") for key in keys)
    }
    changes: dict[str, Any] = {}
    if trained.drivers is not None and not any(x in key for x in OF_DRIVERS for key in keys):
        changes["drivers"] = trained.drivers
        ring["controllers"] = {HUMAN: trained.scenario.controllers[HUMAN]}
    if trained.energy is not None and "energy" not in map(top_key, keys):
        changes["energy"] = trained.energy
    return cfg.with_(scenario=ring, **changes)


def _human(cfg: StudyConfig) -> dict[str, Any] | None:
    """Return the settings of human drivers; None if the page cannot compute them."""
    inputs = load_inputs(cfg)
    pieces = pieces_of(build_env(cfg, inputs.evaluation, inputs.population, nominal=True))
    people = [piece for piece in pieces if isinstance(piece, Drivers)]
    if [type(piece) for piece in people] != [IDM] or people[0].gap_spread:
        return None
    human = people[0]
    drivers = {"desired_speed": human.desired_speeds.tolist(), "time_gap": human.time_gaps.tolist()}
    noise = {"noise": human.noise, "wiener": human.wiener, "spread": human.spreads[0]}
    late = {"late": human.late, "stray": human.noise_spread, **vars(human.noise_step)}
    return {"drivers": drivers, **vars(human.drivers), **noise, **late}


def _rule(rule: Any) -> dict[str, Any]:
    """Return the settings of a rule, with the limits of its commands, and its samples."""
    least, largest = rule.limits
    limits = {"max_deceleration": -least, "max_acceleration": largest}
    return {**values(rule), **limits, "samples": rule.samples}


def _network(policy: str | Path, time_step: float, trust: Sequence[str]) -> dict[str, Any]:
    """Return weights, scales and memory of a policy, and its safety filter."""
    program = Driver(policy, time_step, trust).program
    controller = program.controller
    assert isinstance(controller, NetworkController)
    observation: Any = program.observation
    memory = [piece for piece in program.pieces if isinstance(piece, ObservationMemory)]
    layers = [x for x in controller.layers.modules() if not list(x.children())]
    past = [(name, time) for x in memory for name in x.sources for time in x.seconds]
    columns = observation.columns()
    names = [*(name for column in columns for name in column), *(name for name, _ in past)]
    strange = [type(x).__name__ for x in layers if not isinstance(x, LAYERS)]
    strange += [name for name in names if name.partition(".")[0] not in VIEWS]
    strange += ["stacked memory"] if any(x.stacked for x in memory) else []
    strange += ["late filter"] if program.safety is not None and program.safety.late else []
    require(not strange, f"{policy}: the page does not support its {', '.join(strange)}")
    return {
        "layers": [_layer(layer) for layer in layers],
        "columns": columns,
        "scales": observation.factors.tolist(),
        "max_acceleration": controller.max_acceleration,
        "filter": None if program.safety is None else filter_data(program.safety),
        "memory": [{"source": name, "seconds": time} for name, time in past],
    }


def _layer(layer: nn.Module) -> dict[str, str]:
    numbers = {
        name: b64encode(weights.detach().numpy().astype("<f4").tobytes()).decode()
        for name, weights in layer.named_parameters()
    }
    return {"kind": type(layer).__name__, **numbers}


def filter_data(safety: CBFFilter) -> dict[str, Any]:
    """Return the settings of a safety filter for the page."""
    return {**values(safety), "own": safety.limits.own, "slowest": SLOWEST}
