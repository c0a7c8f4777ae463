"""Motion of a string of vehicles on one lane, all vehicles at once (ALCC A18).

Entries of vehicles are ``[*batch, N, w]``, front to back; those of the leader ``[*batch, w]``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.layout import join, reverse


class Motion(NamedTuple):
    """Motion of every vehicle at one moment, each ``[*batch, N, 1]``.

    speed [m/s]; gap to the vehicle ahead, bumper to bumper [m]; relative_speed v_ahead − v [m/s];
    acceleration executed during the step before [m/s²]; jerk, its change per second [m/s³].
    """

    speed: Tensor
    gap: Tensor
    relative_speed: Tensor
    acceleration: Tensor
    jerk: Tensor


def entries_ahead(leader: Tensor | None, entry: Tensor) -> Tensor:
    """Return an entry of the vehicle ahead of each vehicle, ``[*batch, N, w]``.

    Args:
        leader: the same entry of the vehicle ahead of the string, ``[*batch, w]``; None on a ring
            road, where the first vehicle follows the last.
        entry: the entry of every vehicle, ``[*batch, N, w]``.
    """
    first = entry[..., -1:, :] if leader is None else leader.unsqueeze(-2)
    return first if entry.shape[-2] == 1 else join([first, entry[..., :-1, :]], -2)


def advance_string(
    speed: Tensor,
    gap: Tensor,
    acceleration: Tensor,
    command: Tensor,
    leader: Tensor | None,
    leader_reached: Tensor | None,
    time_step: float,
) -> Motion:
    """Advance all vehicles by one step (A18); none drives backwards.

    Args:
        speed: v, ``[*batch, N, 1]`` [m/s].
        gap: bumper-to-bumper gap to the vehicle ahead [m].
        acceleration: executed during the step before [m/s²].
        command: commanded acceleration [m/s²].
        leader: speed of the vehicle ahead of the string, ``[*batch, 1]``; None on a ring [m/s].
        leader_reached: the same after the step [m/s].
        time_step: duration of the step T [s].

    Returns:
        The motion after the step; a gap of zero or less means a collision.
    """
    reached, executed = advance_speed(speed, command, time_step)
    ahead, ahead_reached = entries_ahead(leader, speed), entries_ahead(leader_reached, reached)
    gap = advance_gap(gap, ahead, speed, ahead_reached, reached, time_step)
    jerk = (executed - acceleration) / time_step
    return Motion(reached, gap, ahead_reached - reached, executed, jerk)


def blocks_of(places: Sequence[int]) -> list[slice]:
    """Return slices that select the given places in order; one slice if a stride suffices."""
    steps = {b - a for a, b in pairwise(places)}
    if len(steps) <= 1 and all(step > 0 for step in steps):
        step = steps.pop() if steps else 1
        return [slice(places[0], places[-1] + 1, step)] if places else [slice(0, 0, 1)]
    found: list[slice] = []
    for place in places:
        if found and found[-1].stop == place:
            found[-1] = slice(found[-1].start, place + 1)
        else:
            found.append(slice(place, place + 1))
    return found


def selector(places: Sequence[int], size: int) -> Callable[[Tensor], Tensor]:
    """Return a function that selects vehicles: ``[*batch, n, w]`` of ``[*batch, N, w]``.

    Args:
        places: the selected places, in order.
        size: number N of vehicles.
    """
    blocks = blocks_of(places)
    if blocks == [slice(0, size, 1)]:
        return _whole
    if len(blocks) == 1 and blocks[0].step == 1:
        return partial(torch.narrow, dim=-2, start=blocks[0].start, length=len(places))
    return partial(_picked, blocks=tuple(blocks))


def _whole(entry: Tensor) -> Tensor:
    return entry


def _picked(entry: Tensor, blocks: Sequence[slice]) -> Tensor:
    parts = [entry[..., block, :] for block in blocks]
    return parts[0] if len(parts) == 1 else join(parts, -2)


def gather(entry: Tensor, index: Tensor) -> Tensor:
    """Select vehicles by an index that differs by episode.

    Args:
        entry: ``[*batch, N, w]``.
        index: places, int64, ``[*batch, n]``.

    Returns:
        ``[*batch, n, w]``.
    """
    wide = index.unsqueeze(-1).expand(*index.shape, entry.shape[-1])
    return reverse(reverse(entry).gather(1, reverse(wide)))


def sum_ranges(entry: Tensor, first: Tensor, last: Tensor) -> Tensor:
    """Sum an entry over ranges of vehicles.

    Args:
        entry: ``[*batch, N, 1]``.
        first: first vehicle of each range, int64, ``[*batch, n]``.
        last: the vehicle after the last one of each range, int64, ``[*batch, n]``.

    Returns:
        The sums, ``[*batch, n, 1]``.
    """
    total = torch.nn.functional.pad(entry.cumsum(-2), (0, 0, 1, 0))
    return gather(total, last) - gather(total, first)
