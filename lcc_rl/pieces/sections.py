"""Sections of a string: an automated vehicle and those behind it, back to the next one."""

from __future__ import annotations

from torch import Tensor
from torch.nn.functional import pad

from lcc_rl.functional.layout import join, total
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.string import sum_ranges
from lcc_rl.pieces.base import Key
from lcc_rl.pieces.views import VEHICLES


class Sections:
    """Sums an entry over the vehicles behind each automated one, back to the next automated one.

    On a ring road the section of the last automated vehicle continues at the front.

    Args:
        of: ``"vehicles"`` if all have the entry, or the one role that has it.

    Attributes:
        keys: further entries that :meth:`sum` needs; none if places are fixed.
    """

    def __init__(self, string: VehicleString, of: str) -> None:
        self.string, self.of = string, of
        self.keys: list[Key] = []
        if string.drawn:
            self.keys = [(role, "index") for role in (AUTOMATED, *({of} - {VEHICLES}))]
        automated = string.places(AUTOMATED)
        ends = [*automated[1:], len(string)]
        self.first = [self._rank(place + 1) for place in automated]
        self.last = [self._rank(place) for place in ends] if automated else []
        # On a ring, vehicles ahead of the first automated vehicle are behind the last one.
        self.wrapped = self._rank(automated[0]) if automated and string.ring else 0

    def _rank(self, place: int) -> int:
        """Return how many vehicles with the entry are ahead of a place."""
        roles = self.string.roles[:place]
        return place if self.of == VEHICLES else roles.count(self.of)

    def sum(self, entry: Tensor, *indices: Tensor) -> Tensor:
        """Return the sums, ``[*batch, A, 1]``, of an entry ``[*batch, n, 1]``."""
        if self.string.drawn:
            return self._sum_drawn(entry, *indices)
        sums = [
            _sum(entry[..., first:last, :])
            for first, last in zip(self.first, self.last, strict=True)
        ]
        if self.wrapped:
            sums[-1] = sums[-1] + _sum(entry[..., : self.wrapped, :])
        if not sums:
            return entry[..., :0, :]
        return sums[0] if len(sums) == 1 else join(sums, -2)

    def _sum_drawn(self, entry: Tensor, places: Tensor, *indices: Tensor) -> Tensor:
        first, last = places + 1, pad(places[..., 1:], (0, 1), value=len(self.string))
        for index in indices:
            ahead = index.unsqueeze(-2)
            first, last = ((ahead < end.unsqueeze(-1)).sum(-1) for end in (first, last))
        total = sum_ranges(entry, first, last)
        if self.string.ring:
            start = first[..., :1] - (0 if indices else 1)
            front = sum_ranges(entry, start.new_zeros(start.shape), start)
            total = total + pad(front, (0, 0, total.shape[-2] - 1, 0))
        return total


def _sum(entry: Tensor) -> Tensor:
    """Return the sum over vehicles, ``[*batch, 1, 1]``."""
    return entry if entry.shape[-2] == 1 else total(entry, -2)
