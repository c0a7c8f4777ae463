"""Checks that values are finite; errors name entry, step and episode."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import torch
from torch import Tensor

from lcc_rl.errors import Diverged


def any_nonfinite(values: Iterable[Tensor]) -> bool:
    """Whether a value may be NaN or infinite, by the sum of each tensor."""
    sums = [value.sum() for value in values if value.is_floating_point()]
    return bool(sums) and not bool(torch.stack(sums).sum().isfinite())


def nonfinite_weight(weights: Mapping[str, Tensor]) -> str | None:
    """Return the name of the first weight with a NaN or an infinity; None if there is none."""
    if not any_nonfinite(weights.values()):
        return None
    return next((name for name, x in weights.items() if not bool(x.isfinite().all())), None)


def require_finite(
    entries: Mapping[tuple[str, ...], Tensor],
    running: Tensor,
    first: int | Tensor = 1,
    label: str = "",
    named: Callable[[int], str] = str,
    writers: Mapping[tuple[str, ...], str] | None = None,
) -> bool:
    """Check that entries of episodes side by side are finite numbers.

    Args:
        entries: entries ``[steps, batch, …]`` by key, causes before effects.
        running: whether each episode runs, ``[steps, batch, 1]``; later steps are not checked.
        first: number of the first step, or of every step, ``[steps, batch]``.
        label: name of the policy in the message.
        named: returns the name of an episode in the message from its index.
        writers: what computes entries, by key.

    Returns:
        Whether an entry may be NaN or infinite after the end of an episode.

    Raises:
        Diverged: naming the first such entry, its step and its episode.
    """
    if not any_nonfinite(entries.values()):
        return False
    found = []
    for place, (key, value) in enumerate(entries.items()):
        bad = ~value.isfinite().flatten(2).all(-1) & running.squeeze(-1)
        if bad.any():
            step, episode = bad.nonzero()[0].tolist()
            found.append((step, place, episode, key))
    if not found:
        return True
    step, _, episode, key = min(found)
    values = entries[key][step, episode]
    number = values[~values.isfinite()][0].item()
    where = f"{label}: {'.'.join(key)}" if label else ".".join(key)
    where += f" of {writers[key]}" if writers and key in writers else ""
    at = int(first[step, episode]) if isinstance(first, Tensor) else first + step
    raise Diverged(f"{where} is {number} at step {at} of episode {named(episode)}")
