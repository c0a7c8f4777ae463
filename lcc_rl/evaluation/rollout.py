"""Plays episodes to their end, without resets, and keeps the entries of an evaluation."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.envs.clock import option_specs
from lcc_rl.envs.compiled import Traced
from lcc_rl.envs.rowwise import Rows, Rowwise
from lcc_rl.envs.step import TERMINATED, Step, closure, entries_of, pieces_of, read_before, written
from lcc_rl.errors import is_ours, require
from lcc_rl.functional.finite import require_finite
from lcc_rl.functional.layout import batch_innermost
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.functional.random import LOW_BITS, STREAM_INCREMENT, hash_bits
from lcc_rl.pieces import CBFFilter
from lcc_rl.pieces.base import ACTION, SEED, STEP, Key, State, as_key
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.leader import PROFILE, PROFILE_START
from lcc_rl.pieces.string import COMMAND, WANTED

log = logging.getLogger("lcc_rl")

# Reads and writes a TensorDict; None for a rule.
Policy = Callable[[TensorDictBase], TensorDictBase]
Record = dict[Key, Tensor]
# The next state, the entries to keep, which episodes run, and a sum of all written entries.
Advanced = tuple[State, list[Tensor], Tensor]
DRIVER = (HUMAN, "driver")


class Player:
    """Plays batches of episodes to the horizon, without resets.

    Args:
        env: the environment, without the single-agent view.
        policy: writes the action; None if none is needed.
        keys: entries to keep; unknown ones are ignored.
        label: name of the strategy in messages.
        compiled: compile the step, not the policy; without a compiler the plain step is used,
            which is logged.
        rowwise: play each episode as a row of numbers, in machine code (:class:`Rowwise`); the
            policy must be a function of its entries, without a memory of its own.

    Raises:
        ConfigError: if a controller takes an action and there is no policy.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: Policy | None,
        keys: Sequence[Key],
        label: str = "",
        compiled: bool = False,
        rowwise: bool = False,
    ) -> None:
        self.rowwise = rowwise
        self.machine: tuple[Rows, Rowwise, State] | None = None  # made at the first play
        self.env, self.policy, self.label, self.horizon = env, policy, label, env.base_env.horizon
        self.pieces = pieces_of(env)
        acts = any(key == ACTION for piece in self.pieces for _, key in piece.needs)
        require(
            policy is not None or not acts,
            "scenario.controllers.automated needs the action of a policy, but there is none: "
            "choose an agent or another controller",
        )
        outputs = written(self.pieces)
        self.events: list[Any] = [piece for piece in self.pieces if piece.event]
        self.idle: dict[str, bool] = {}  # whether their events happened in no episode so far
        events = [key for piece in self.events for key in piece.event]
        self.kept = [key for key in keys if key in outputs]
        self.reads = [as_key(key) for key in getattr(policy, "in_keys", [])]
        needed = closure(self.pieces, {*self.kept, *self.reads, *events, TERMINATED})
        self.step = Step(needed, self.horizon)
        # Actions, commands before the safety filter and memories are checked, too.
        wishes = [
            key
            for piece in needed
            for key in piece.targets
            if key[-1] in (WANTED, COMMAND)
            or (isinstance(piece, Controller) and key[1] in piece.remembers)
        ]
        driven = [] if policy is None else [ACTION]
        self.checked = list(dict.fromkeys([*driven, *wishes, *events, *self.kept]))
        self.record: Record = {}
        self.start: State = {}  # before the first step
        # Compiled code is for one layout in memory.
        self.arranged = batch_innermost if compiled else lambda entry: entry
        self.names: list[Key] = []  # of the state
        self.move = Traced(self._move, "the evaluation", compiled)

    @torch.no_grad()
    def play(
        self, given: TensorDictBase, named: Callable[[int], str] = str
    ) -> tuple[Record, Tensor]:
        """Play one batch.

        Args:
            given: reset options.
            named: returns the name of an episode in messages from its index.

        Returns:
            The entries after every step, ``[time, *batch, …]``, speeds also before the first one,
            ``[time + 1, …]``, and whether each step belongs to a running episode,
            ``[time, batch, 1]``. The next call writes into the same tensors.

        Raises:
            Diverged: if an action, a command, also before the safety filter, a memory or an entry
                to keep is not finite.
        """
        state, record = self._begin(given), self.record
        state = {key: self.arranged(value) for key, value in state.items()}
        self.start, self.names = state, [*state]
        if self.rowwise:
            return self._checked(*self._by_rows(state), named)
        running, alive = torch.ones_like(state[TERMINATED]), []
        for step in range(self.horizon):
            alive.append(running)
            before, (state, entries, running) = state, self._advance(state, running)
            for key, value in zip(self.checked, entries, strict=True):
                first = int(key[-1] == "speed")
                if key not in record:  # written in place: a stack would need twice the memory
                    record[key] = value.new_empty((self.horizon + first, *value.shape))
                if first and step == 0:
                    record[key][0] = before[key]
                record[key][step + first] = value
        return self._checked(record, torch.stack(alive), named)

    @property
    def reads_drivers(self) -> bool:
        """Whether a piece depends, or one of a user may depend, on the human drivers."""
        pieces = [piece for piece, _ in self.step.pieces]
        return any(x.reads_drivers or not is_ours(x.setup.__module__) for x in pieces)

    def draws(self, given: TensorDictBase, other: TensorDictBase) -> bool:
        """Return whether episodes depend on the drivers and seeds in which two options differ."""
        first, second = (self._begin(options) for options in (given, other))
        same = all(torch.equal(first[key], second[key]) for key in first if key != SEED)
        seeded = [x for x, _ in self.step.pieces if SEED in [key for _, key in x.needs]]
        return not same or not all(x.steady for x in seeded)

    def _checked(
        self, record: Record, alive: Tensor, named: Callable[[int], str]
    ) -> tuple[Record, Tensor]:
        """Return the entries to keep, and which steps belong to running episodes."""
        after = {key: record[key][-self.horizon :] for key in self.checked}
        writers = {key: piece.title for piece in self.pieces for key in piece.targets}
        if require_finite(after, alive, label=self.label, named=named, writers=writers):
            for value in after.values():
                value.nan_to_num_(0.0, 0.0, 0.0)
        for piece in self.events:
            happened = piece.happened(*(after[key] for key in piece.event)) & alive
            self.idle[piece.title] = self.idle.get(piece.title, True) and not bool(happened.any())
        return {key: record[key] for key in self.kept}, alive

    def _by_rows(self, state: State) -> tuple[Record, Tensor]:
        """Play the episodes from a state as rows of numbers, in machine code."""
        self.machine = self.machine or self._translated(state)
        rows, kernel, kinds = self.machine
        row = rows.packed(state).numpy()
        width, dtype = kernel.widths[1]
        record = np.empty((self.horizon, len(row), width), dtype)
        for step in range(self.horizon):
            row, record[step] = kernel(row)
        columns = torch.from_numpy(record).split([x[0].numel() for x in kinds.values()], -1)
        series = {}
        for (key, kind), column in zip(kinds.items(), columns, strict=True):
            value = column.reshape(*column.shape[:2], *kind.shape[1:]).to(kind.dtype)
            speeds = key[-1] == "speed"  # also before the first step
            series[key] = torch.cat([state[key].unsqueeze(0), value]) if speeds else value
        ended = series.pop(TERMINATED)
        alive = torch.ones_like(ended)
        alive[1:] = ended[:-1].cumsum(0) == 0
        return series, alive

    def _translated(self, state: State) -> tuple[Rows, Rowwise, State]:
        """Return the rows of a state, the step of them, and an example of each entry to keep."""
        read = {*read_before(piece for piece, _ in self.step.pieces), *self.reads}
        anything = self.policy is not None and not self.reads
        rows = Rows(state, [key for key in state if anything or key in read])
        names = [*self.checked, TERMINATED]

        def moments(packed: Tensor) -> State:
            before = rows.entries(packed)
            before |= self._action(before, packed.shape[:1])
            return {**before, **self.step(before)}

        def advance(packed: Tensor) -> tuple[Tensor, Tensor]:
            after, dtype = moments(packed), torch.get_default_dtype()
            entries = torch.cat([after[key].flatten(1).to(dtype) for key in names], 1)
            return rows.packed(after), entries

        example = rows.packed(state)[:1]
        reached = moments(example)
        kernel = Rowwise(advance, (example,), "the evaluation")
        return rows, kernel, {key: reached[key] for key in names}

    def _begin(self, options: TensorDictBase) -> State:
        state = entries_of(self.env.reset(options=options))
        if self.policy is not None and not self.reads:
            return state  # it may read anything
        carried = {SEED, STEP, TERMINATED, *written(piece for piece, _ in self.step.pieces)}
        return {key: value for key, value in state.items() if key in carried}

    def _advance(self, state: State, running: Tensor) -> Advanced:
        """Return the next state, the entries to keep, and which episodes still run."""
        action = self._action(state, self.env.batch_size).values()
        *tensors, running = self.move(*state.values(), *map(self.arranged, action), running)
        count = len(self.names)
        return dict(zip(self.names, tensors[:count], strict=True)), tensors[count:], running

    def _move(self, *tensors: Tensor) -> Sequence[Tensor]:
        """Return the next state, the entries and who runs, from state, action and who runs."""
        before = dict(zip((*self.names, ACTION), tensors[:-1], strict=False))
        shown = {**before, **self.step(before)}
        entries = [self.arranged(shown[key]) for key in (*self.names, *self.checked)]
        return *entries, tensors[-1] & ~shown[TERMINATED]

    def _action(self, state: State, batch: torch.Size) -> State:
        """Return the action of the policy for a batch; none without a policy."""
        if self.policy is None:
            return {}
        td = TensorDict(batch_size=batch, device=self.env.device)
        for key in self.reads or state:
            if key in state:
                td.set(key, state[key])
        return {ACTION: self.policy(td).get(ACTION)}


def warn_of_idle(idle: Iterable[Mapping[str, bool]]) -> None:
    """Log each event that happened in no episode of several players, from their ``idle``."""
    given = [item for one in idle for item in one.items()]
    for title in dict(given):
        if all(never for name, never in given if name == title):
            text = "the event of %s happened in no episode: they ended before it, or the gap of a "
            log.warning(text + "cut-in is above the present one", title)


def warn_of_brakes(players: Iterable[Player]) -> None:
    """Log the safety filters that assume weaker brakes ahead than automated cars have."""
    every = {p.label: x for p in players for x in p.pieces if isinstance(x, CBFFilter)}
    texts = {label: text for label, piece in every.items() if (text := piece.exceeded)}
    for text in dict.fromkeys(texts.values()):
        log.warning("%s: %s", ", ".join(x for x in texts if texts[x] == text), text)


def reset_options(
    env: TransformedEnv,
    profile: Tensor,
    driver: Tensor,
    seed: int,
    drivers: int,
    repeat: Tensor | int = 0,
) -> TensorDict:
    """Build the reset options for given pairs of profile and driver.

    Args:
        env: the environment, ``[batch]``.
        profile: profile of each episode, ``[batch]``.
        driver: first driver of each episode, ``[batch]``.
        seed: seed of the noise.
        drivers: number of drivers.
        repeat: number of the draw of the noise for this pair, ``[batch]``.
    """
    batch = env.batch_size
    # Every episode has its own stream. The drivers of a string have consecutive ids, so every
    # driver is used equally often in every place.
    number = profile * drivers + driver + repeat * STREAM_INCREMENT
    options = TensorDict(batch_size=batch, device=env.device)
    options.set(SEED, (hash_bits(number + (seed * 0x9E3779B1 & LOW_BITS)) >> 1).unsqueeze(-1))
    specs = option_specs(env)
    if PROFILE in specs:
        options.set(PROFILE, profile.unsqueeze(-1))
        options.set(PROFILE_START, torch.zeros_like(profile).unsqueeze(-1))
    if DRIVER in specs:
        place = torch.arange(specs[DRIVER].shape[-2]).unsqueeze(-1)
        options.set(DRIVER, (driver.view(-1, 1, 1) + place) % drivers)
    return options
