"""Controllers by name: nodes of baselines, files, classes and functions."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from functools import cache
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeGuard

from omegaconf import OmegaConf
from torch import nn

from lcc_rl.config.compose import choices, composed, load, own_file, shipped_files
from lcc_rl.config.nodes import Node
from lcc_rl.config.schemas import AUTO
from lcc_rl.config.words import DOTTED, FILTERED, YAML
from lcc_rl.errors import ConfigError, in_short, require, unknown_name
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.settings import parse_yaml, read_text
from lcc_rl.pieces.controllers import Controller, Law
from lcc_rl.results.policies import PRETRAINED
from lcc_rl.settings import TARGET, find_target, path_of, values

# Cruise controls with tuned constants, which differ behind the safety filter.
TUNED = ("idm_acc", "acc")
# Baselines: controllers of conf/ with other settings.
BASELINES: dict[str, tuple[str, dict[str, Any]]] = {
    # Time gaps above 2.5 s for 2 % of the time, the limit of idm_acc and acc; mpc keeps 1 %.
    "mpc_far": ("mpc", {"longest_gap": -4.0}),
    "deadbeat oracle": ("deadbeat", {"lookahead": "oracle"}),
}
GAINS = ("path", "paper_like", "tuned")  # files of conf/gains
OF_CACC = tuple(f"cacc {name}" for name in GAINS)
DIRECT = "direct"  # a string without automated vehicles
PEOPLE = "human"  # automated vehicles with the scenario's human drivers
# Controllers that need a policy's action, or the communication of a platoon.
NEEDY = ("action", "human", "cacc", "deadbeat", "hcfs")
MODULE = ".py"
ONNX, ONNX_POLICY = ".onnx", "lcc_rl.interfaces.onnx_policy.OnnxPolicy"
OTHER_WORDS = (
    "<module.Class>",
    "<controller.yaml>",
    "<program.onnx>",
    PRETRAINED,
    "<run folder>",
    "<policy.pt>",
)


def rules() -> tuple[str, ...]:
    """Return the names of all baselines and of the files of ``controller``."""
    names = [name for name in choices("controller") if name not in NEEDY]
    return tuple(dict.fromkeys([DIRECT, PEOPLE, "idm", *OF_CACC, *BASELINES, "deadbeat", *names]))


def is_shipped(name: str) -> bool:
    """Whether a name in tables is that of a baseline or a controller of the package.

    Names of variants, such as ``alcc``, are reserved for learned policies.
    """
    known = {DIRECT, PEOPLE, *OF_CACC, *BASELINES, *shipped_files("controller")}
    return name.removesuffix(FILTERED) in known


def setting_of(spec: Any, where: str = "compare") -> str | Node:
    """Return the value of a policy or controller in a configuration.

    Args:
        spec: a name; a path, such as a run's; a node; or a controller as object, class or function.
        where: its place in the configuration, for messages.

    Raises:
        ConfigError: if it is none, or a class or function is not at the top level of a module.
    """
    if isinstance(spec, (str, Node)):
        return spec
    if isinstance(spec, Controller):
        spec = {TARGET: path_of(type(spec)), **values(spec)}
    if isinstance(spec, Mapping):
        return Node.of(spec, where)
    if isinstance(spec, PathLike):
        return fspath(spec)
    message = f"{where}: expected a run, a file or a controller, got {in_short(spec)}"
    if isinstance(spec, nn.Module) or hasattr(spec, "predict"):  # a model of stable-baselines3
        message += "; lcc_rl.export(…, 'policy.onnx') makes a file of a torch network or a model"
    require(callable(spec) and not isinstance(spec, nn.Module), message)
    return path_of(spec)


def value_of(given: Any) -> tuple[str, Any]:
    """Return a value and its name: "", or that of a mapping of one.

    Raises:
        ConfigError: if the mapping has several.
    """
    named = isinstance(given, Mapping) and TARGET not in given
    message = f"controller: expected one, such as {{'name': MyACC()}}, got {in_short(given)}"
    require(not named or len(given) == 1, message)
    return next(iter(given.items())) if named else ("", given)


def one_of(given: Any) -> tuple[str, Any]:
    """Return name and setting of a policy or controller, see :func:`value_of`.

    Raises:
        ConfigError: as :func:`setting_of`, or if the mapping has several.
    """
    name, value = value_of(given)
    spec = setting_of(value, "controller")
    return name or (spec if isinstance(spec, str) else label_of(spec)), spec


def is_policy(spec: Any) -> TypeGuard[str]:
    """Whether a name is that of a trained policy's file or folder."""
    if not isinstance(spec, str) or not spec or spec.endswith((*YAML, ONNX, MODULE)):
        return False
    path = Path(spec)
    return path.exists() or path.parts[:1] == (PRETRAINED,) or path.suffix == ".pt"


def controller_of(spec: Any, behind: bool = False) -> Node:
    """Return the node of a controller.

    Args:
        spec: a baseline; a file of ``controller`` or ``variant`` in conf/ or ``--config-dir``; the
            dotted path of a class or of a function of named entries; a yaml file with a node; an
            ONNX program (:mod:`lcc_rl.interfaces.onnx_policy`); or a node.
        behind: whether it drives behind a filter that keeps a longest time gap, for which tuned
            controllers have other constants.

    Raises:
        ConfigError: if there is no such controller, or it cannot be built.
    """
    if isinstance(spec, str):
        plain = spec.removesuffix(FILTERED)
        filtered = _named(spec) if behind or plain not in TUNED else None
        if node := filtered or _named(plain):
            return node
        spec = plain
    node = spec if isinstance(spec, Node) else Node.of(_described(spec), f"compare={spec}")
    node.made(Controller)
    return node


def label_of(spec: Any) -> str:
    """Return the name of a controller in tables: its own, or that of its file, class or function.

    A file with a name of the package keeps its ending: ``idm_acc.yaml``.
    """
    if isinstance(spec, Node):
        spec = str(spec.settings.get("law") or spec.settings[TARGET])
    names, plain = {*rules(), *choices("variant")}, spec.removesuffix(FILTERED)
    file = Path(plain)
    if file.suffix in (*YAML, ONNX):
        return (file.name if file.stem in names else file.stem) + spec[len(plain) :]
    return spec if spec in names else str(spec).rpartition(".")[2]


def _named(spec: str) -> Node | None:
    """Return the controller with a name; None if there is none."""
    if spec in (shipped := _shipped()):
        return shipped[spec]
    if spec in choices("variant"):  # first, because hcfs needs the policy of its variant
        overrides = [f"variant={spec}"]
    elif spec in choices("controller"):
        overrides = ["variant=idm", f"controller@{AUTO}={spec}"]
    else:
        return None
    cfg = load("evaluate", overrides)
    if cfg.agent is not None:
        raise ConfigError(
            f"variant {spec} is learned: compare the run folder or policy.pt of "
            f"lcc-rl train variant={spec}"
        )
    controller: Node = cfg.scenario.controllers[AUTOMATED]
    return controller


@cache
def _shipped() -> dict[str, Node]:
    """Compose all controllers and baselines of the package at once, because composing is slow."""
    needing = {"action", "hcfs"}  # these need further settings
    names = [name for name in shipped_files("controller") if name not in needing]
    drivers = [f"+controller@scenario.controllers.{name}={name}" for name in names]
    gains = ["+gains=tuned", *(f"+gains@gains.{name}={name}" for name in GAINS)]
    plain: Any = OmegaConf.to_container(composed(None, [*gains, *drivers]), resolve=True)
    settings = plain["scenario"]["controllers"]
    nodes = {x: Node.of(settings[x], f"controller {x}") for x in names if x != PEOPLE}
    nodes |= {name: nodes[file].changed(**changes) for name, (file, changes) in BASELINES.items()}
    return nodes | {f"cacc {x}": nodes["cacc"].changed(**plain["gains"][x]) for x in GAINS}


def _described(spec: Any) -> Any:
    """Return the settings of a controller without a name."""
    if isinstance(spec, Mapping):
        return spec
    if spec.endswith(ONNX):
        return {TARGET: ONNX_POLICY, "path": spec}
    if spec.endswith(YAML):
        settings = parse_yaml(read_text(Path(spec)), spec)
        for key in settings:
            require(isinstance(key, str), f"{spec}: the key {key} is no name: quote it, as in 'on'")
        return settings
    if spec.endswith(MODULE):
        inside = Path(spec).stem
        raise ConfigError(f"{spec} is a module: name a class or function in it, {inside}.<Class>")
    if DOTTED.fullmatch(spec) is None:
        error = unknown_name("strategy", spec, [*rules(), *OTHER_WORDS])
        raise ConfigError(f"{error} {own_file('controller', spec)}")
    if inspect.isclass(find_target(spec, f"compare={spec}")):
        return {TARGET: spec}
    return {TARGET: f"{Law.__module__}.{Law.__name__}", "law": spec}
