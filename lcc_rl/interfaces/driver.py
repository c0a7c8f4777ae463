"""Policies and rules that drive vehicles of another simulator by their measurements.

A driver consists of pieces of the environment: the network with its filter (:mod:`.export`), the
memory that it observes, or the controller.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from lcc_rl.config.nodes import Node
from lcc_rl.config.words import FILTERED
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.checks import BATCH, check_step
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.named import controller_of, is_policy, label_of, setting_of
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, VehicleString
from lcc_rl.functional.string import entries_ahead
from lcc_rl.interfaces.exported import ExportedPolicy, exported_policy
from lcc_rl.pieces import Controller, ObservationMemory
from lcc_rl.pieces.base import SEED, STEP, Key, State, StepTransform
from lcc_rl.pieces.cbf import REMEMBERS
from lcc_rl.pieces.world import World
from lcc_rl.results.policies import load_policy

# Each driven vehicle is an episode of its own: who is ahead leads, who is behind follows.
STRING = VehicleString((AUTOMATED, HUMAN))
AGREEMENT = (AUTOMATED, "agreement")  # what the safety filter of a policy remembers
COMMAND_KEY = ("command", AUTOMATED)
PRESENT_KEY = ("behind", "present")
MEASURED_KEYS: tuple[Key, ...] = (
    *(("leader", name) for name in ("speed", "acceleration")),
    *(("vehicles", name) for name in ("speed", "gap", "relative_speed", "acceleration")),
    *(PRESENT_KEY, SEED, STEP),
)


class Measured(NamedTuple):
    """Measurements of one vehicle, of the vehicle ahead and of the one behind.

    Speeds [m/s], gaps bumper to bumper [m], accelerations executed during the last step [m/s²];
    ``present`` is 1 if there is a vehicle behind, else 0.
    """

    speed: float
    gap: float
    acceleration: float
    speed_ahead: float
    acceleration_ahead: float
    speed_behind: float
    gap_behind: float
    acceleration_behind: float
    present: float


def state_of(rows: Sequence[Measured]) -> State:
    """Return measurements as entries of an environment, one row per vehicle."""
    table = torch.tensor(rows, dtype=torch.float32)
    seen = dict(zip(Measured._fields, table.split(1, -1), strict=True))
    state: State = {PRESENT_KEY: seen["present"]}
    for name in ("speed", "acceleration"):
        state["leader", name] = seen[f"{name}_ahead"]
    for name in ("speed", "gap", "acceleration"):
        own, behind = seen[name], seen[f"{name}_behind"]
        state["vehicles", name] = torch.stack([own, behind], 1)
    speed = state["vehicles", "speed"]
    state["vehicles", "relative_speed"] = entries_ahead(state["leader", "speed"], speed) - speed
    return state


class Driver:
    """Computes accelerations of any number of vehicles, and updates their memories.

    Args:
        name: a run, a run folder, a policy file, ``pretrained/<name>``, or a controller by name
            (``"idm_acc"``), as object, class, function, file or node, as :func:`lcc_rl.compare`
            takes it.
        time_step: duration of a step of the other simulator [s].
        trust: modules outside this package that a policy may name.

    Attributes:
        kept: keys of the entries that are remembered from step to step.

    Raises:
        LccError: if the policy or rule is unknown, was trained with another step, reads an entry
            that is not measured, or returns another shape than a row per vehicle.
    """

    def __init__(self, name: Any, time_step: float, trust: Sequence[str] = ()) -> None:
        who = setting_of(name)
        self.name = who if isinstance(who, str) else label_of(who)
        self.time_step = time_step
        self.module: ExportedPolicy | None = None
        pieces: list[StepTransform] = []
        filtered = isinstance(who, str) and who.endswith(FILTERED)
        require(not filtered, f"{who}: there is no safety filter here, but that of a policy")
        if is_policy(who):
            pieces += self._policy(who, trust)
        else:
            pieces.append(self._build(Controller, controller_of(who), AUTOMATED))
        self.pieces = pieces
        self.kept = [key for piece in pieces for key in (*piece.targets, *piece.constants)]
        self.kept = [key for key in self.kept if key != COMMAND_KEY]
        self.kept += [AGREEMENT] * (self.module is not None and self.module.safety is not None)
        self._check()

    def _policy(self, name: str, trust: Sequence[str]) -> list[StepTransform]:
        self.module, (_, cfg) = exported_policy(name, trust), load_policy(name, trust=trust)
        trained = float(cfg.scenario.time_step)
        if abs(trained - self.time_step) > 1e-9:
            raise ConfigError(
                f"{name} was trained with steps of {trained:g} s, the simulation has "
                f"{self.time_step:g} s (--step-length {trained:g} sets SUMO's)"
            )
        memory = cfg.scenario.pieces.get("memory")
        wanted = any(column.startswith("memory.") for column in self.module.names)
        return [self._build(ObservationMemory, memory, "memory")] if wanted and memory else []

    def _build(self, kind: type[StepTransform], node: Node, name: str) -> Any:
        return node.made(kind).bind(World(STRING, self.time_step, population=bootstrap()), name)

    def _check(self) -> None:
        for key in self.reads():
            if key not in (*MEASURED_KEYS, *self.kept):
                known = ", ".join(".".join(key) for key in MEASURED_KEYS)
                raise ConfigError(
                    f"{self.name} reads {'.'.join(key)}, which is not measured here, only {known}"
                )
        none = torch.zeros(BATCH, 1).long()
        trial = state_of([Measured(*[1.0] * len(Measured._fields))] * BATCH) | {
            SEED: none,
            STEP: none,
        }
        before = {**trial, **self.begin(trial)}
        for piece in self.pieces:
            check_step(piece, before, trial)

    def reads(self) -> list[Key]:
        """Return the keys of all entries that the driver reads."""
        names = [] if self.module is None else self.module.names
        sources = [key for piece in self.pieces for _, key in piece.needs]
        return [*sources, *(place(name)[0] for name in names)]

    def begin(self, measured: State) -> State:
        """Return the memories of vehicles that are driven for the first time.

        Args:
            measured: the entries :data:`MEASURED_KEYS`, one row per vehicle.
        """
        start = TensorDict(batch_size=measured[STEP].shape[:1])
        for key, value in measured.items():
            start.set(key, value)
        for piece in self.pieces:
            piece.begin(TensorDict(batch_size=start.batch_size), start)
        if AGREEMENT in self.kept:
            start.set(AGREEMENT, torch.zeros(*start.batch_size, 1, REMEMBERS))
        return {key: start.get(key) for key in self.kept}

    @torch.no_grad()
    def __call__(self, measured: State, kept: State) -> tuple[Tensor, State]:
        """Return accelerations ``[vehicles]`` [m/s²] and the memories after this step.

        Args:
            measured: the entries :data:`MEASURED_KEYS`, one row per vehicle; see :func:`state_of`.
            kept: memories of the step before, or of :meth:`begin`.
        """
        reached = dict(measured)
        for piece in self.pieces:
            piece.derive({**measured, **kept}, reached)
        if self.module is None:
            command = reached[COMMAND_KEY]
        else:
            state = torch.stack([value(reached, name) for name in self.module.names], -1)
            if AGREEMENT in self.kept:
                command, agreed = self.module(state, kept[AGREEMENT].flatten(1))
                reached[AGREEMENT] = agreed.unsqueeze(1)
            else:
                command = self.module(state)
        return command.flatten(), {key: reached[key] for key in self.kept}


def place(name: str) -> tuple[Key, int]:
    """Return the key of an exported policy's input, and its row or column in that entry."""
    view, entry, *column = name.split(".")
    if (view, entry) == PRESENT_KEY:
        return PRESENT_KEY, int(*column)
    if view == "memory":
        return (view, entry), int(*column)
    key = {"self": "vehicles", "ahead": "leader", "behind": "vehicles"}.get(view, view)
    return (key, ".".join([entry, *column])), int(view == "behind")


def value(state: State, name: str) -> Tensor:
    """Return an input of an exported policy, ``[vehicles]``."""
    key, index = place(name)
    return state[key].flatten(1)[:, index]
