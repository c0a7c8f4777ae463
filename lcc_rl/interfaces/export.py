"""Export of trained policies as ONNX, PyTorch's ``.pt2`` or a page in which they drive.

An exported program takes the measurements of one vehicle in SI units and returns its acceleration;
it contains the scales of the observation, the network and the safety filter, if there is one. The
program of a policy that remembers takes and returns its memory, too.
"""

from __future__ import annotations

import json
import logging
import warnings
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.factory import build_env
from lcc_rl.envs.inputs import constant_profiles
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError, how_to_install, require, unknown_name
from lcc_rl.evaluation.named import is_policy, rules
from lcc_rl.evaluation.strategies import with_weights
from lcc_rl.interfaces.onnx_policy import MAKES, TAKES
from lcc_rl.io.atomic import atomic_path, new_file
from lcc_rl.pieces import Action, CBFFilter, Observation
from lcc_rl.pieces.cbf import STATE
from lcc_rl.pieces.entries import ENTRIES
from lcc_rl.pieces.knowledge import ObservationMemory
from lcc_rl.results.policies import PRETRAINED, load_policy
from lcc_rl.runs.arguments import Arguments
from lcc_rl.version import __version__

# Entries computed inside from other measurements: v_ahead − v.
DERIVED = {
    "self.relative_speed": ("ahead.speed", "self.speed"),
    "behind.relative_speed": ("self.speed", "behind.speed"),
}
PRESENT, REMEMBERED = "behind.present", "memory.entries."


class Input(NamedTuple):
    """A column of an exported policy's input: its name, unit and meaning."""

    name: str
    unit: str
    meaning: str


class ExportedPolicy(nn.Module):
    """From measurements ``[batch, inputs]`` to accelerations ``[batch, 1]`` [m/s²].

    Args:
        network: from the scaled observation to actions in [−1, 1].
        observation: the piece that gathers and scales measurements.
        action: the piece that turns actions into accelerations.
        safety: the safety filter, or None.
        memory: the piece that remembers what the columns ``memory.entries.…`` hold, or None.
    """

    constants: Tensor

    def __init__(
        self, network: nn.Module, observation: Observation, action: Action, safety: Any, memory: Any
    ) -> None:
        super().__init__()
        self.network, self.largest, self.safety = network, action.max_acceleration, safety
        self.memory = memory
        self.register_buffer("constants", observation.constants.clone())
        seen = observation.columns()
        needed = [name for column in seen for name in column]
        needed += STATE if safety is not None else ()
        flat = [base for name in needed for base in DERIVED.get(name, (name,))]
        self.names = list(dict.fromkeys(flat))
        self.columns = [[self._places(name) for name in column] for column in seen]

    def _places(self, name: str) -> tuple[int, ...]:
        bases = DERIVED.get(name, (name,))
        if name == "behind.relative_speed" and PRESENT in self.names:
            bases = (*bases, PRESENT)
        return tuple(self.names.index(base) for base in bases)

    def _value(self, state: Tensor, places: tuple[int, ...]) -> Tensor:
        first, *others = (state[:, place : place + 1] for place in places)
        difference = first - others[0] if others else first
        return difference * others[1] if len(others) > 1 else difference

    def forward(self, state: Tensor) -> Tensor:
        """Return the acceleration to command."""
        rows = []
        for value, *bases in self.columns:
            seen = self._value(state, value)
            rows.append(seen - self._value(state, bases[0]) if bases else seen)
        action = self.network(torch.cat(rows, -1) * self.constants)
        command = action.clamp(-1.0, 1.0) * self.largest
        if self.safety is None:
            return command
        measured = (self._value(state, self._places(name)) for name in STATE)
        filtered: Tensor = self.safety.filtered(command, *measured)
        return filtered


class Remembering(nn.Module):
    """A policy with its memory: ``state``, ``memory`` to ``acceleration``, ``next_memory``.

    A memory of zeros begins anew; the first number of ``next_memory`` is one.
    """

    def __init__(self, policy: ExportedPolicy) -> None:
        super().__init__()
        self.policy, memory = policy, policy.memory
        self.repeat = memory.depth if memory.stacked else memory.repeat
        self.width = 1 + memory.counted * self.repeat
        flat = [base for name in memory.sources for base in DERIVED.get(name, (name,))]
        names = [name for name in policy.names if not name.startswith(REMEMBERED)]
        self.names = list(dict.fromkeys([*names, *flat]))

    def forward(self, state: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the acceleration to command, and the memory of the next step."""
        measured = dict(zip(self.names, state.split(1, -1), strict=True))
        pairs = (
            [measured[x] for x in DERIVED.get(name, (name,))] for name in self.policy.memory.sources
        )
        now = torch.cat([one - other[0] if other else one for one, *other in pairs], -1)
        begun, kept = memory.split((1, self.width - 1), -1)
        kept = torch.where(begun > 0.0, kept, now.repeat_interleave(self.repeat, -1))
        entries, kept = self.policy.memory.remember(kept, now)
        measured |= {f"{REMEMBERED}{n}": x for n, x in enumerate(entries.split(1, -1))}
        acceleration = self.policy(torch.cat([measured[name] for name in self.policy.names], -1))
        return acceleration, torch.cat([torch.ones_like(begun), kept], -1)


def described(name: str) -> Input:
    """Return name, unit and meaning of a measurement such as ``"ahead.speed"``."""
    view, entry = name.split(".")[:2]
    whose = {"self": "own", "ahead": "of the vehicle ahead", "behind": "of the vehicle behind"}
    for key in (("vehicles", entry), (view, entry), ("role", entry)):
        if key in ENTRIES:
            unit, meaning = ENTRIES[key]
            return Input(name, unit, f"{meaning} ({whose.get(view, view)})")
    return Input(name, "–", f"{entry} ({whose.get(view, view)})")


def exported_policy(policy: str | Path, trust: Sequence[str] = ()) -> ExportedPolicy:
    """Build the policy that is exported; arguments as for :func:`export`."""
    weights, cfg = load_policy(policy, trust=trust)
    population = bootstrap()
    scenario = cfg.scenario
    leader = constant_profiles(10.0, scenario.horizon, scenario.time_step, ["constant"])
    env = build_env(cfg, leader, population)
    pieces = pieces_of(env)
    found = {kind: [p for p in pieces if isinstance(p, kind)] for kind in (Observation, Action)}
    if not all(found.values()):
        raise ConfigError(f"{policy}: no network drives its vehicles; nothing to export")
    safety = next((p for p in pieces if isinstance(p, CBFFilter)), None)
    if safety is not None and safety.memories:
        raise ConfigError(
            f"{policy}: its filter remembers commands or measurements, an exported policy nothing; "
            "only without delays, lag and drop-outs can it be exported"
        )
    learned = with_weights(cfg, weights, cfg.seed, str(policy), population).policy
    assert isinstance(learned, TensorDictModule)
    (observation,), (action,) = found.values()
    memory = next((p for p in pieces if isinstance(p, ObservationMemory)), None)
    module = ExportedPolicy(learned.module, observation, action, safety, memory)
    return module.eval().requires_grad_(False)


def program(policy: str | Path, trust: Sequence[str] = ()) -> ExportedPolicy | Remembering:
    """Return the module that a program is made of; arguments as for :func:`export`."""
    module = exported_policy(policy, trust)
    remembers = any(name.startswith(REMEMBERED) for name in module.names)
    return Remembering(module) if remembers else module


def export(policy: str | Path, path: str | Path, trust: Sequence[str] = ()) -> Path:
    """Write a trained policy, with its safety filter, for use elsewhere.

    The ending chooses the form. ONNX (``.onnx``) and PyTorch's exported program (``.pt2``) take
    ``state``, ``[batch, inputs]`` in SI units, and return ``acceleration``, ``[batch, 1]`` [m/s²],
    of a policy that remembers also ``memory`` and ``next_memory`` (zeros at first);
    names, units and meanings of the inputs are in the file's metadata under ``lcc_rl`` as JSON. A
    page (``.html``) shows the ring road with the policy in any browser, see
    :func:`lcc_rl.interfaces.ring_page.ring_page`.

    Args:
        policy: a run folder, a policy file, or ``pretrained/<name>``.
        path: the file to write.
        trust: modules outside this package that the policy may name.

    Returns:
        The file's path.

    Raises:
        ConfigError: if the ending is another one, an extra is missing, or the policy cannot be
            exported.
        ResultsError: if the policy cannot be read, or the file exists or cannot be written.

    Examples:
        >>> export("pretrained/alcc_limits", "alcc.pt2")  # doctest: +SKIP
    """
    path = new_file(path, "name")
    if path.suffix not in FORMS:
        raise unknown_name("ending", path.suffix, FORMS)
    require(
        is_policy(str(policy)) or str(policy) not in rules(),
        f"{policy} is a rule; only a trained policy can be exported: give a run folder, a policy "
        f"file or {PRETRAINED}/<name>",
    )
    content = FORMS[path.suffix](policy, trust)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return path


def _program(policy: str | Path, trust: Sequence[str]) -> tuple[Any, str]:
    """Return the exported program, and what is to know about it as JSON."""
    module = program(policy, trust)
    inputs = [described(name)._asdict() for name in module.names]
    own = module.policy if isinstance(module, Remembering) else module
    about: dict[str, Any] = {"policy": str(policy), "lcc_rl": __version__, "inputs": inputs}
    about |= {"output": "acceleration [m/s²]", "filter": own.safety is not None}
    widths = [len(module.names)] + ([module.width] if isinstance(module, Remembering) else [])
    batch = dict(zip(TAKES, [{0: torch.export.Dim("batch", min=1)}] * len(widths), strict=False))
    examples = tuple(torch.ones(2, width) for width in widths)
    made = torch.export.export(module, examples, dynamic_shapes=batch)
    return made, json.dumps(about, ensure_ascii=False)


def _as_page(policy: str | Path, trust: Sequence[str]) -> bytes:
    from lcc_rl.interfaces.ring_page import ring_page  # it reads policies by this module

    return ring_page(policy, trust).encode()


def _as_pt2(policy: str | Path, trust: Sequence[str]) -> bytes:
    made, about = _program(policy, trust)
    buffer = BytesIO()
    torch.export.save(made, buffer, extra_files={"lcc_rl": about})
    return buffer.getvalue()


def _as_onnx(policy: str | Path, trust: Sequence[str]) -> bytes:
    exported, about = _program(policy, trust)
    count = len(exported.graph_signature.user_inputs)
    try:
        import onnx
        import onnxscript  # noqa: F401 - what torch exports with
    except ImportError as error:
        raise ConfigError(
            f"{error.name} is not installed: {how_to_install('interfaces')}; or write a .pt2"
        ) from error
    registry = logging.getLogger("torch.onnx._internal.exporter._registration")
    registry.setLevel(logging.ERROR)  # that torchvision, of no use here, is missing
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # of torch, about itself
        made = torch.onnx.export(
            exported,
            (),
            dynamo=True,
            verbose=False,
            input_names=TAKES[:count],
            output_names=MAKES[:count],
        )
    assert made is not None
    proto = made.model_proto
    onnx.helper.set_model_props(proto, {"lcc_rl": about})
    content: bytes = proto.SerializeToString()
    return content


FORMS = {".onnx": _as_onnx, ".pt2": _as_pt2, ".html": _as_page}


def main(words: Sequence[str] | None = None) -> int:
    """Export the policy named on the command line."""
    parser = Arguments(description="Export a policy for use elsewhere.")
    parser.add_argument("policy", help="run folder, policy.pt or pretrained/<name>")
    parser.add_argument("path", help="file to write: a program (.onnx, .pt2) or a page (.html)")
    parser.add_argument("--trust", action="append", default=[], help="module that it may name")
    options = parser.parse_args(words)
    path = export(options.policy, options.path, options.trust)
    if path.suffix == ".html":
        print(f"{path}: the ring road in the browser, with {options.policy}")
        return 0
    for item in map(described, program(options.policy, options.trust).names):
        print(f"  {item.name} [{item.unit}]: {item.meaning}")
    print(f"{path}: from these, in this order, the acceleration [m/s²]")
    return 0
