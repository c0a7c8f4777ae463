"""Trained policies as modules of plain tensors, from measurements to accelerations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.factory import build_env
from lcc_rl.envs.inputs import constant_profiles
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import with_weights
from lcc_rl.pieces import Action, CBFFilter, Observation
from lcc_rl.pieces.base import ROLE, Piece, declared
from lcc_rl.pieces.cbf import FILTER_READS
from lcc_rl.pieces.knowledge import ObservationMemory
from lcc_rl.pieces.views import VEHICLES
from lcc_rl.results.policies import load_policy

# Entries computed inside from other measurements: v_ahead − v.
DERIVED_INPUTS = {
    "self.relative_speed": ("ahead.speed", "self.speed"),
    "behind.relative_speed": ("self.speed", "behind.speed"),
}
BEHIND_PRESENT, REMEMBERED = "behind.present", "memory.entries."


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
        self.register_buffer("constants", observation.factors.clone())
        seen = observation.columns()
        needed = [name for column in seen for name in column]
        needed += FILTER_READS if safety is not None else ()
        flat = [base for name in needed for base in DERIVED_INPUTS.get(name, (name,))]
        self.names = list(dict.fromkeys(flat))
        self.columns = [[self._places(name) for name in column] for column in seen]

    def _places(self, name: str) -> tuple[int, ...]:
        bases = DERIVED_INPUTS.get(name, (name,))
        if name == "behind.relative_speed" and BEHIND_PRESENT in self.names:
            bases = (*bases, BEHIND_PRESENT)
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
        measured = (self._value(state, self._places(name)) for name in FILTER_READS)
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
        flat = [base for name in memory.sources for base in DERIVED_INPUTS.get(name, (name,))]
        names = [name for name in policy.names if not name.startswith(REMEMBERED)]
        self.names = list(dict.fromkeys([*names, *flat]))

    def forward(self, state: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Return the acceleration to command, and the memory of the next step."""
        measured = dict(zip(self.names, state.split(1, -1), strict=True))
        pairs = (
            [measured[x] for x in DERIVED_INPUTS.get(name, (name,))]
            for name in self.policy.memory.sources
        )
        now = torch.cat([one - other[0] if other else one for one, *other in pairs], -1)
        begun, kept = memory.split((1, self.width - 1), -1)
        kept = torch.where(begun > 0.0, kept, now.repeat_interleave(self.repeat, -1))
        entries, kept = self.policy.memory.remember(kept, now)
        measured |= {f"{REMEMBERED}{n}": x for n, x in enumerate(entries.split(1, -1))}
        acceleration = self.policy(torch.cat([measured[name] for name in self.policy.names], -1))
        return acceleration, torch.cat([torch.ones_like(begun), kept], -1)


def described_input(name: str) -> Input:
    """Return name, unit and meaning of a measurement such as ``"ahead.speed"``."""
    view, entry = name.split(".")[:2]
    whose = {"self": "own", "ahead": "of the vehicle ahead", "behind": "of the vehicle behind"}
    known = declared(Piece)
    for key in ((VEHICLES, entry), (view, entry), (ROLE, entry)):
        if key in known:
            return Input(name, known[key].unit, f"{known[key].meaning} ({whose.get(view, view)})")
    return Input(name, "–", f"{entry} ({whose.get(view, view)})")


def exported_policy(
    policy: str | Path | nn.Module, trust: Sequence[str] = (), cfg: StudyConfig | None = None
) -> ExportedPolicy:
    """Build the policy that is exported.

    Args:
        policy: as for ``lcc_rl.interfaces.export.export``; or a network, see
            :func:`lcc_rl.evaluation.foreign.network_of`.
        trust: modules outside this package that the policy may name.
        cfg: the configuration in which a network was trained.
    """
    population, weights = bootstrap(), None
    if not isinstance(policy, nn.Module):
        weights, cfg = load_policy(policy, trust=trust)
    assert cfg is not None
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
    if isinstance(policy, nn.Module):
        network = policy
    else:
        learned = with_weights(cfg, weights or {}, cfg.seed, str(policy), population).policy
        assert isinstance(learned, TensorDictModule)
        network = learned.module
    (observation,), (action,) = found.values()
    memory = next((p for p in pieces if isinstance(p, ObservationMemory)), None)
    module = ExportedPolicy(network, observation, action, safety, memory)
    return module.eval().requires_grad_(False)


def program(
    policy: str | Path | nn.Module, trust: Sequence[str] = (), cfg: StudyConfig | None = None
) -> ExportedPolicy | Remembering:
    """Return the module that a program is made of; arguments as for :func:`exported_policy`."""
    module = exported_policy(policy, trust, cfg)
    remembers = any(name.startswith(REMEMBERED) for name in module.names)
    return Remembering(module) if remembers else module
