"""Views: how a vehicle of some role sees the string, by names such as ``"ahead.speed"``.

======================  ====================================================================
``self.x``              entry x of the vehicle itself
``ahead.x``             of the vehicle ahead: of the string, or the leader
``behind.x``            of the vehicle behind; zeros where there is none
``behind.present``      1 where there is a vehicle behind, else 0
``leader.x``            of the leader, ahead of the whole string
``episode.x``           of the episode: its seed, its step
any other ``name.x``    the entry as it is, ``[*batch, n, w]``: one row per vehicle of the role
======================  ====================================================================

With ``next.`` before a name the moment reached is meant. Whatever the name, what comes out is
``[*batch, n, w]``, one row per vehicle of the role (or 1 where all of them see the same).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.functional.string import blocks_of, entries_ahead, gather, take
from lcc_rl.pieces.base import NEXT, Key, as_key

VEHICLES, LEADER, EPISODE = "vehicles", "leader", "episode"
SELF, AHEAD, BEHIND = "self", "ahead", "behind"
PRESENT = "present"


class Views:
    """What vehicles of one role see, as tensors of one row per vehicle.

    Args:
        string: the string of vehicles.
        role: whose view.
        names: what is seen, dotted.
        behind: how many vehicles behind are seen, the nearest first.

    Attributes:
        keys: the entries to read, in the order in which :meth:`__call__` takes them.

    Raises:
        ConfigError: if a name has no namespace.
    """

    def __init__(
        self, string: VehicleString, role: str, names: Sequence[str], behind: int = 1
    ) -> None:
        self.string, self.behind = string, behind
        self.names = [as_key(name) for name in names]
        for name in self.names:
            if len(name) - (name[0] == NEXT) != 2:
                raise ConfigError(f"expected a name such as self.gap, got {'.'.join(name)!r}")
        # Only roles have places; what all vehicles see alike needs none.
        self.drawn = string.drawn and role in string.names
        self.places = string.places(role)
        self.blocks = blocks_of(self.places)
        # Of those ahead (-1) and behind, where their places are the same in every episode.
        self.others = {distance: self._blocks_at(distance) for distance in range(-1, behind + 1)}
        self.first_is_ahead = 0 in self.places and not self.drawn
        self.keys: list[Key] = []
        self.plan = [self._add(name) for name in self.names]
        # Where every entry is taken as it is, nobody needs to know where the role drives.
        picks = any(kind in (SELF, AHEAD, BEHIND, PRESENT) for kind, _, _ in self.plan)
        self.index = self._place((role, "index")) if self.drawn and picks else -1

    def _blocks_at(self, distance: int) -> list[slice] | None:
        """Return where the vehicles so far behind each one are; None if not always somewhere."""
        places = [place + distance for place in self.places]
        if self.string.ring:
            places = [place % len(self.string) for place in places]
        fixed = not self.drawn and all(0 <= place < len(self.string) for place in places)
        return blocks_of(places) if fixed else None

    def _place(self, key: Key) -> int:
        """Return the place of an entry among those read."""
        if key not in self.keys:
            self.keys.append(key)
        return self.keys.index(key)

    def _add(self, name: Key) -> tuple[str, int, int]:
        """Return the kind of a name, and the places of the entries it is made from."""
        prefix, (space, entry) = name[:-2], name[-2:]
        own, leading = (*prefix, VEHICLES, entry), (*prefix, LEADER, entry)
        if space == SELF:
            return SELF, self._place(own), -1
        if space == AHEAD:
            follows = (self.first_is_ahead or self.drawn) and not self.string.ring
            alone = self.places == (0,) and not self.drawn and not self.string.ring
            return AHEAD, -1 if alone else self._place(own), self._place(leading) if follows else -1
        if space == BEHIND:
            # Any entry of the vehicles tells the shape of the batch.
            known = own if entry != PRESENT else (*prefix, VEHICLES, "speed")
            return (PRESENT if entry == PRESENT else BEHIND), self._place(known), -1
        kind = LEADER if space in (LEADER, EPISODE) else ""
        return kind, self._place(name), -1

    def __call__(self, *entries: Tensor) -> list[Tensor]:
        """Return what is seen, one tensor per name."""
        return [self._resolve(kind, entries, own, lead) for kind, own, lead in self.plan]

    def _resolve(self, kind: str, entries: Sequence[Tensor], own: int, lead: int) -> Tensor:
        if kind == SELF:
            return self._pick(entries, entries[own])
        if kind == AHEAD:
            leading = entries[lead] if lead >= 0 else None
            if own < 0:
                assert leading is not None
                return leading.unsqueeze(-2)
            return self._ahead(entries, entries[own], leading)
        if kind == BEHIND:
            return self._behind(entries, entries[own])
        if kind == PRESENT:
            return self._behind(entries, torch.ones_like(entries[own]))
        return entries[own].unsqueeze(-2) if kind == LEADER else entries[own]

    def _pick(self, entries: Sequence[Tensor], entry: Tensor) -> Tensor:
        if self.drawn:
            return gather(entry, entries[self.index])
        return take(entry, self.blocks)

    def _ahead(self, entries: Sequence[Tensor], entry: Tensor, leading: Tensor | None) -> Tensor:
        blocks = self.others[-1]
        if blocks is not None:
            return take(entry, blocks)
        return self._pick(entries, entries_ahead(leading, entry))

    def _behind(self, entries: Sequence[Tensor], entry: Tensor) -> Tensor:
        """Return an entry of the vehicles behind, ``[*batch, n, behind · w]``, zeros for none."""
        seen = []
        for distance in range(1, self.behind + 1):
            blocks = self.others[distance]
            if blocks is not None:
                seen.append(take(entry, blocks))
                continue
            # The first vehicles come round to the end on a ring; elsewhere nobody is there.
            wrapped = entry[..., :distance, :]
            end = wrapped if self.string.ring else torch.zeros_like(wrapped)
            shifted = torch.cat([entry[..., distance:, :], end], -2)[..., : len(self.string), :]
            seen.append(self._pick(entries, shifted))
        return seen[0] if len(seen) == 1 else torch.cat(seen, -1)

    def sees_all_behind(self) -> bool:
        """Whether every vehicle of the role always has as many vehicles behind as it sees."""
        if self.string.ring:
            return len(self.string) > self.behind
        if self.drawn:
            return False
        return all(place + self.behind < len(self.string) for place in self.places)
