"""Checks of pieces when an environment is built: every entry read is written and fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.envs.step import DONE, TERMINATED, TRUNCATED, entries_of, tick, written
from lcc_rl.errors import ConfigError, line_of, naming, nearest, replacing, require
from lcc_rl.functional.guard import changed, check_forgets, check_independent
from lcc_rl.pieces import Collision
from lcc_rl.pieces.base import SEED, STEP, Key, Piece, State, StepTransform, as_key
from lcc_rl.pieces.views import LEADER

BATCH = 2
# Options that add pieces, by the entries, or the group of them, that these write.
ADDED_BY = {
    **{f"{x}.{y}": "+slope=hills" for x in ("vehicles", "leader") for y in ("place", "grade")},
    "terrain": "+slope=hills +knowledge=terrain",
    **{name: f"+knowledge={name}" for name in ("memory", "preview", "spread", "traffic")},
}


def check_pieces(
    pieces: Sequence[Piece], horizon: int, actions: Mapping[NestedKey, tuple[int, ...]]
) -> None:
    """Check wiring, shapes and memory of pieces, by resets and steps of two episodes.

    Args:
        pieces: the pieces in the order in which they act.
        horizon: steps per episode.
        actions: shape of each action after the batch dimensions, by key.

    Raises:
        ConfigError: naming the entry and the piece at fault.
    """
    _check_wiring(pieces, [as_key(key) for key in actions])
    episodes = torch.arange(BATCH).unsqueeze(-1)
    play = partial(_play, pieces, horizon, actions)
    check_forgets(pieces, lambda n: play(episodes + n * BATCH))
    play(episodes, check_alone)


def _play(
    pieces: Sequence[Piece],
    horizon: int,
    actions: Mapping[NestedKey, tuple[int, ...]],
    episodes: Tensor,
    check: Callable[[Piece, State, State], None] | None = None,
) -> None:
    """Reset episodes by their seeds, and take a step by a check, by default :func:`check_step`."""
    moment = TensorDict(tick(episodes, torch.zeros_like(episodes), horizon), [BATCH])
    options = TensorDict(batch_size=[BATCH])
    for piece in pieces:
        _attempt(piece, lambda piece=piece: piece._reset(options, moment))
        if isinstance(piece, StepTransform):
            entries = {key: moment.get(key) for key in piece.targets}
            _compare(piece, entries, "at reset")
    state = entries_of(moment)
    for key, shape in actions.items():
        state[as_key(key)] = torch.zeros(BATCH, *shape)
    reached = tick(state[SEED], state[STEP] + 1, horizon)
    for piece in pieces:
        (check or check_step)(piece, state, reached)


def check_step(piece: Piece, before: State, reached: State) -> None:
    """Compare the entries that a piece writes for :data:`BATCH` episodes with its specs.

    Args:
        piece: the piece to check.
        before: entries of the state before the step.
        reached: entries of the state after the step, to which the written ones are added.

    Raises:
        ConfigError: naming the piece, and the number of entries, shape or type at fault.
    """
    read = {key: (reached if late else before)[key] for late, key in piece.needs}
    copies = {key: value.clone() for key, value in read.items()}
    _attempt(piece, lambda: piece.derive(before, reached))
    for key, value in copies.items():  # torch does not count changes by .data or NumPy
        if not torch.equal(read[key].nan_to_num(), value.nan_to_num()):
            raise changed(type(piece).__name__, ".".join(key))
    _compare(piece, {key: reached[key] for key in piece.targets}, "after a step")


def check_alone(piece: Piece, before: State, reached: State) -> None:
    """Refuse a piece that gives an episode other numbers alone than beside another, or again.

    Args:
        piece, before, reached: see :func:`check_step`.

    Raises:
        ConfigError: naming the piece and the entry.
    """
    late = list(dict.fromkeys([*piece.needs, *((False, key) for key in piece.constants)]))

    def play(*values: Tensor) -> list[Tensor]:
        states: tuple[State, State] = ({}, {})
        for (after, key), value in zip(late, values, strict=True):
            states[after][key] = value
        piece.derive(*states)
        return [states[1][key] for key in piece.targets]

    inputs = [(reached if after else before)[key] for after, key in late]
    if inputs:
        check_independent(piece.title, [".".join(key) for key in piece.targets], play, inputs)
    piece.derive(before, reached)


def _attempt(piece: Piece, action: object) -> None:
    """Call a function; an error names the piece."""

    def misfit(error: Exception) -> ConfigError:
        shape = ", ".join(map(str, ("batch", *piece.event_shape)))
        returned = " and ".join(".".join(key) for key in piece.targets)
        return ConfigError(
            f"{piece.title} does not fit the string of vehicles: {line_of(error)}; it must "
            f"return {returned} as tensors [{shape}]"
        )

    with replacing(misfit), naming(piece.title):
        action()  # type: ignore[operator]


def _compare(piece: Piece, entries: Mapping[Key, Tensor], when: str) -> None:
    """Compare the written entries of a piece with its specs."""
    layouts = piece.layouts(torch.Size([BATCH]))
    for key, value in entries.items():
        if key not in layouts or key in (DONE, TERMINATED):
            continue
        shape, dtype = layouts[key]
        if value.shape != shape or value.dtype != dtype:
            raise ConfigError(
                f"{piece.title} writes {'.'.join(key)} as {list(value.shape[1:])} "
                f"{value.dtype} {when}; expected {list(shape[1:])} {dtype}, one row per "
                "vehicle"
            )


def _check_wiring(pieces: Sequence[Piece], actions: Sequence[Key]) -> None:
    """Refuse entries that are read and not written, or written by several pieces."""
    writers = Counter(
        key for piece in pieces if not isinstance(piece, Collision) for key in piece.targets
    )
    for key, count in writers.items():
        if count > 1:
            names = [type(piece).__name__ for piece in pieces if key in piece.targets]
            raise ConfigError(f"{'.'.join(key)} is written by more than one piece: {names}")
    groups = {key[0] for key in written(pieces) if len(key) > 1}
    for piece in pieces:
        for key in piece.entries:
            where = f"{piece.title} writes {'.'.join(key)}, but {key[-1]!r} is a group of entries"
            # tensordict confuses the two where a TensorDict lacks the group
            require(len(key) == 1 or key[-1] not in groups, f"{where}: use another name")
    keys = {SEED, STEP, DONE, TERMINATED, TRUNCATED, *actions, *written(pieces)}
    for piece in pieces:
        for _, key in piece.needs:
            if key in keys:
                continue
            if key[-1] == "action":
                raise ConfigError(
                    f"{piece.title} reads {'.'.join(key)}, but only automated vehicles "
                    "have an action"
                )
            name = ".".join(key)
            ring = key[0] == LEADER and piece.string.ring
            require(not ring, f"{piece.title} reads {name}, but a ring road has no leader")
            where = f"{piece.title} reads {name}, which no piece of the scenario writes"
            option = ADDED_BY.get(key[0], ADDED_BY.get(name))
            require(option is None, f"{where}; {option} adds one that does")
            near = sorted(".".join(other) for other in keys if other[0] == key[0])
            hint = nearest(name, near)
            where += ", only " + ", ".join(near) if near else "; vehicles' are self.x and ahead.x"
            raise ConfigError(
                f"{where}; was a piece removed, or does it belong to another scenario=…?{hint}"
            )
