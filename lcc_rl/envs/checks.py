"""Checks of a list of pieces when an environment is built: what is read is written, and fits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey

from lcc_rl.envs.step import DONE, TERMINATED, TRUNCATED, Step, entries, tick
from lcc_rl.errors import ConfigError, LccError
from lcc_rl.pieces import CBFFilter, Collision
from lcc_rl.pieces.base import SEED, STEP, Key, Piece, StepTransform, as_key

BATCH = 2
# Pieces that replace what others wrote.
REPLACING = (CBFFilter, Collision)


def check_pieces(
    pieces: Sequence[Piece], horizon: int, actions: Mapping[NestedKey, tuple[int, ...]]
) -> None:
    """Check the wiring and the shapes of pieces, by a reset and a step of two episodes.

    Args:
        pieces: the pieces in the order in which they act.
        horizon: steps per episode.
        actions: shape of each action after the batch dimensions, by key.

    Raises:
        ConfigError: naming the entry and the piece at fault.
    """
    _check_wiring(pieces, [as_key(key) for key in actions])
    episodes = torch.arange(BATCH).unsqueeze(-1)
    moment = TensorDict(batch_size=[BATCH])
    for key, value in tick(episodes, torch.zeros_like(episodes), horizon).items():
        moment.set(key, value)
    given = TensorDict(batch_size=[BATCH])
    for piece in pieces:
        _attempt(piece, lambda piece=piece: piece._reset(given, moment))
        if isinstance(piece, StepTransform):
            found = {key: moment.get(key) for key in piece.targets}
            _compare(piece, found, "at reset")
    state = entries(moment)
    for key, shape in actions.items():
        state[as_key(key)] = torch.zeros(BATCH, *shape)
    reached = tick(state[SEED], state[STEP] + 1, horizon)
    for piece in pieces:
        step = Step([piece], horizon).pieces[0][0]
        _attempt(piece, lambda step=step: step.apply(state, reached))
        _compare(piece, {key: reached[key] for key in piece.targets}, "after a step")


def _attempt(piece: Piece, action: object) -> None:
    """Call a function, naming the piece where it fails."""
    try:
        action()  # type: ignore[operator]
    except LccError:
        raise
    except Exception as error:
        where = type(piece).__name__
        raise ConfigError(f"{where} does not fit the string of vehicles: {error}") from error


def _compare(piece: Piece, found: Mapping[Key, torch.Tensor], when: str) -> None:
    """Compare what a piece wrote with what its spec promises."""
    specs = piece.written_specs(torch.Size([BATCH]), None)
    for key, value in found.items():
        spec = specs.get(key)
        if spec is None or key in (DONE, TERMINATED):
            continue
        if value.shape != spec.shape or value.dtype != spec.dtype:
            raise ConfigError(
                f"{type(piece).__name__} writes {'.'.join(key)} as {list(value.shape[1:])} "
                f"{value.dtype} {when}; expected {list(spec.shape[1:])} {spec.dtype}, one row per "
                "vehicle"
            )


def _check_wiring(pieces: Sequence[Piece], actions: Sequence[Key]) -> None:
    """Check that every entry read is written by somebody, and none by two pieces.

    Raises:
        ConfigError: naming the entry and the piece.
    """
    writers = Counter(
        key for piece in pieces if not isinstance(piece, REPLACING) for key in piece.targets
    )
    for key, count in writers.items():
        if count > 1:
            names = [type(piece).__name__ for piece in pieces if key in piece.targets]
            raise ConfigError(f"{'.'.join(key)} is written by more than one piece: {names}")
    known = {SEED, STEP, DONE, TERMINATED, TRUNCATED, *actions, *writers}
    for piece in pieces:
        known |= set(piece.constants) if isinstance(piece, StepTransform) else set()
    for piece in pieces:
        for _, key in piece.sources:
            if key in known:
                continue
            if key[-1] == "action":
                raise ConfigError(
                    f"{type(piece).__name__} reads {'.'.join(key)}, but only automated vehicles "
                    "have an action"
                )
            raise ConfigError(
                f"{type(piece).__name__} reads {'.'.join(key)}, which no piece of the "
                "scenario writes; was a piece removed?"
            )
