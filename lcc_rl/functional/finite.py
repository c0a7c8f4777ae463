"""What is not a number ends an evaluation or a training; entry, step and episode are named."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from lcc_rl.errors import Diverged


def any_lost(values: Iterable[Tensor]) -> bool:
    """Whether something may not be a number: a sum of each, which neither NaN nor inf leaves."""
    sums = [value.sum() for value in values if value.is_floating_point()]
    return bool(sums) and not bool(torch.stack(sums).sum().isfinite())


def lost_weight(weights: Mapping[str, Tensor]) -> str | None:
    """Name the first weight that holds something other than numbers; None where none does."""
    if not any_lost(weights.values()):
        return None
    return next((name for name, x in weights.items() if not bool(x.isfinite().all())), None)


def require_finite(
    entries: Mapping[tuple[str, ...], Tensor],
    running: Tensor,
    first: int = 1,
    who: str = "",
    named: Callable[[int], str] = str,
) -> bool:
    """Check that entries of episodes side by side are finite numbers.

    Args:
        entries: entries ``[steps, batch, …]`` by key, causes before effects.
        running: whether each episode runs, ``[steps, batch, 1]``; what follows its end does not
            count.
        first: number of the first step.
        who: what the message calls the policy.
        named: what the message calls the episode of a number.

    Returns:
        Whether an entry may hold something else after the end of an episode.

    Raises:
        Diverged: naming the entry that is lost first, its step and its episode.
    """
    if not any_lost(entries.values()):
        return False
    found = []
    for place, (key, value) in enumerate(entries.items()):
        lost = ~value.isfinite().flatten(2).all(-1) & running.squeeze(-1)
        if lost.any():
            step, episode = lost.nonzero()[0].tolist()
            found.append((step, place, episode, key))
    if not found:
        return True
    step, _, episode, key = min(found)
    values = entries[key][step, episode]
    number = values[~values.isfinite()][0].item()
    where = f"{who}: {'.'.join(key)}" if who else ".".join(key)
    raise Diverged(f"{where} is {number} at step {first + step} of episode {named(episode)}")
