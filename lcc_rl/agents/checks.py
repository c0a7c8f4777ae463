"""Checks during a training: what is learned from and what was learned are finite numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from lcc_rl.envs.finite import ACTION, EPISODE, Written, check_moment
from lcc_rl.errors import Diverged
from lcc_rl.functional.finite import any_lost, lost_weight
from lcc_rl.pieces.base import STEP, Key, Piece, as_key, next_key


def check_learner(
    policy: TensorDictModule, values: Mapping[str, float | Tensor], advice: str
) -> None:
    """Check that the results of an update and the policy's weights are numbers.

    Args:
        policy: what was learned.
        values: losses and other results by name.
        advice: what to do where they are not.

    Raises:
        Diverged: naming the first that is not.
    """
    for name, value in values.items():
        if not math.isfinite(value):
            raise Diverged(f"{name} became {float(value)}", advice)
    found = lost_weight(policy.state_dict())
    if found is not None:
        raise Diverged(f"the policy's weight {found} became no number", advice)


def check_batch(
    batch: TensorDictBase, pieces: Sequence[Piece], begun: int = 0, who: str = ""
) -> None:
    """Check that transitions are numbers, before anything is learned from them.

    One sum per entry; only where that is lost, the first cause is looked for.

    Args:
        batch: ``[environments, steps]``.
        pieces: the environment's.
        begun: steps played before the batch, for batches that do not hold the steps themselves.
        who: who drives, for the message.

    Raises:
        Diverged: naming the first entry that is not a number, its step and its episode.
    """
    if not any_lost(batch.values(True, True)):
        return
    writers = {key: piece for piece in pieces for key in piece.targets}
    found = {as_key(name): entry.detach() for name, entry in batch.items(True, True)}
    for step in range(batch.shape[1]):
        now = {key: entry[:, step] for key, entry in found.items()}
        count = torch.full((len(batch), 1), begun + step, device=batch.device)
        moment: dict[Key, Tensor] = {STEP: count, **{k: now[k] for k in EPISODE if k in now}}
        left = [Written(key, now[key], piece) for key, piece in writers.items() if key in now]
        reached = [Written(ACTION, now[ACTION])] if ACTION in now else []
        after = [(key, next_key(key)) for key in writers]
        reached += [Written(key, now[late], writers[key]) for key, late in after if late in now]
        running = torch.ones_like(count, dtype=torch.bool)
        check_moment(left, moment, running, pieces, who)
        check_moment(reached, {**moment, STEP: moment[STEP] + 1}, running, pieces, who)
