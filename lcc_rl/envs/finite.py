"""What is not a number ends an evaluation or a training; entry, step and episode are named."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from lcc_rl.errors import Diverged
from lcc_rl.functional.finite import any_lost
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.base import Key

ACTION = (AUTOMATED, "action")


def check_numbers(
    entries: Mapping[Key, Tensor],
    running: Tensor,
    first: int = 1,
    who: str = "",
    named: Callable[[int], str] = str,
) -> bool:
    """Check that the entries of a batch of episodes are finite numbers.

    Args:
        entries: entries ``[steps, batch, …]`` by key, causes before effects.
        running: whether each episode runs, ``[steps, batch, 1]``; what follows its end does not
            count.
        first: number of the first step.
        who: who drives, for the message.
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
