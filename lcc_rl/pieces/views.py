"""Views: entries of the string from a vehicle of a role, by names such as ``"ahead.speed"``.

======================  ====================================================================
``self.x``              entry x of the vehicle itself
``ahead.x``             entry x of the vehicle ahead, in the string or the leader
``behind.x``            entry x of the vehicle behind; zeros if there is none
``behind.present``      1 if there is a vehicle behind, else 0
``self.target_age``     age of the measurement of gap and vehicle ahead [s], 0 without sensors
``leader.x``            entry x of the leader, ahead of the whole string
``episode.x``           entry of the episode: seed or step
``role.action``         the action, clamped to [−1, 1]
any other ``name.x``    the entry itself, ``[*batch, n, w]``: one row per vehicle of the role
======================  ====================================================================

A name that begins with ``next.`` refers to the state after the step. Every view is
``[*batch, n, w]``, one row per vehicle of the role, or one row if it is the same for all. A tuple
is the key of an entry, which is not changed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.layout import join
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.functional.string import entries_ahead, gather, selector

Key = tuple[str, ...]
NEXT = "next"
VEHICLES, LEADER, EPISODE = "vehicles", "leader", "episode"
SELF, AHEAD, BEHIND = "self", "ahead", "behind"
PRESENT = "present"
TARGET_AGE = "target_age"
MOTION_READS = ("self.speed", "self.gap", "self.relative_speed")


Resolver = Callable[[Sequence[Tensor]], Tensor]


def as_key(key: NestedKey) -> Key:
    """Return a key as a tuple; a dotted string counts as nested (``"vehicles.gap"``)."""
    return tuple(key.split(".")) if isinstance(key, str) else tuple(key)


class Views:
    """Views of the vehicles of one role, as tensors of one row per vehicle.

    Args:
        role: role of the vehicles.
        names: dotted names, and keys as tuples.
        behind: number of vehicles behind in each view ``behind.x``, nearest first.

    Attributes:
        keys: the entries to read, in the order of the arguments of :meth:`__call__`.

    Raises:
        ConfigError: if a name has no namespace.
    """

    def __init__(
        self, string: VehicleString, role: str, names: Sequence[NestedKey], behind: int = 1
    ) -> None:
        self.string, self.behind = string, behind
        if isinstance(names, str):
            raise ConfigError(f"reads must be a tuple of names such as self.gap, got {names!r}")
        for name in names:
            if not isinstance(name, (str, tuple)):
                raise ConfigError(f"reads must hold names such as self.gap, got {name!r}")
        # Only roles have places; entries that are the same for all vehicles need none.
        self.drawn = string.drawn and role in string.names
        self.places, self.role = string.places(role), role
        self.select = selector(self.places, len(string))
        self.keys: list[Key] = []
        # Everything that depends on the string only is resolved here, not in every step.
        self.plan = [self._resolver(name) for name in names]

    def __call__(self, *entries: Tensor) -> list[Tensor]:
        """Return the views, one tensor per name."""
        return [resolve(entries) for resolve in self.plan]

    def of(self, moment: TensorDictBase) -> list[Tensor]:
        """Return the views of a state."""
        return self(*(moment.get(key) for key in self.keys))

    def _place(self, key: Key) -> int:
        """Return the index of an entry among those read."""
        if key not in self.keys:
            self.keys.append(key)
        return self.keys.index(key)

    def _resolver(self, requested: NestedKey) -> Resolver:
        """Return the function from the entries read to the view of a name or a key."""
        name = as_key(requested)
        if not isinstance(requested, str):
            return partial(_as_it_is, self._place(name))
        if len(name) - (name[0] == NEXT) != 2:
            raise ConfigError(f"expected a name such as self.gap, got {requested!r}")
        prefix, (space, entry) = name[:-2], name[-2:]
        if self.string.measured and space in (SELF, AHEAD, BEHIND, LEADER):
            group = AHEAD if space == LEADER else space
            return partial(_as_it_is, self._place((*prefix, group, entry)))
        if name[-2:] == (SELF, TARGET_AGE):  # of a role without sensors
            return partial(_fresh, self._at((*prefix, VEHICLES, "speed"), 0))
        if space in (SELF, AHEAD):
            return self._at((*prefix, VEHICLES, entry), -1 if space == AHEAD else 0)
        if space == BEHIND:
            # Any entry of the vehicles has the shape of the batch.
            present = entry == PRESENT
            key = (*prefix, VEHICLES, "speed" if present else entry)
            distances = range(1, self.behind + 1)
            return partial(_joined, [self._at(key, distance, present) for distance in distances])
        if entry == "action":
            return partial(_held, self._place(name))
        return partial(_row if space in (LEADER, EPISODE) else _as_it_is, self._place(name))

    def _at(self, key: Key, distance: int, present: bool = False) -> Resolver:
        """Return a function to the entry of the vehicles at a distance behind (−1: ahead)."""
        size = len(self.string)
        places = [place + distance for place in self.places]
        if self.string.ring:
            places = [place % size for place in places]
        if not self.drawn and all(0 <= place < size for place in places):
            return partial(_selected, self._place(key), selector(places, size), present)
        follows = distance == -1 and not self.string.ring
        lead = self._place((*key[:-2], LEADER, key[-1])) if follows else -1
        if follows and self.places == (0,) and not self.drawn:
            return partial(_row, lead)
        index = self._place((self.role, "index")) if self.drawn else -1
        return partial(self._found, self._place(key), lead, index, distance, present)

    def _found(
        self,
        own: int,
        lead: int,
        index: int,
        distance: int,
        present: bool,
        entries: Sequence[Tensor],
    ) -> Tensor:
        """Return an entry at a distance where not every vehicle or episode has a vehicle."""
        entry = torch.ones_like(entries[own]) if present else entries[own]
        if distance < 0:
            entry = entries_ahead(entries[lead] if lead >= 0 else None, entry)
        elif distance > 0:
            # On a ring the first vehicles follow the last; elsewhere there are none.
            wrapped = entry[..., :distance, :]
            end = wrapped if self.string.ring else torch.zeros_like(wrapped)
            entry = join([entry[..., distance:, :], end], -2)[..., : len(self.string), :]
        if index >= 0:
            return gather(entry, entries[index])
        return self.select(entry)

    def sees_all_behind(self) -> bool:
        """Whether every vehicle of the role always has as many vehicles behind as its views."""
        if self.string.ring:
            return len(self.string) > self.behind
        if self.drawn:
            return False
        return all(place + self.behind < len(self.string) for place in self.places)


def _selected(
    index: int, select: Callable[[Tensor], Tensor], present: bool, entries: Sequence[Tensor]
) -> Tensor:
    entry = select(entries[index])
    return torch.ones_like(entry) if present else entry


def _row(index: int, entries: Sequence[Tensor]) -> Tensor:
    return entries[index].unsqueeze(-2)


def _fresh(own: Resolver, entries: Sequence[Tensor]) -> Tensor:
    return torch.zeros_like(own(entries))


def _as_it_is(index: int, entries: Sequence[Tensor]) -> Tensor:
    return entries[index]


def _held(index: int, entries: Sequence[Tensor]) -> Tensor:
    return entries[index].clamp(-1.0, 1.0)


def _joined(resolvers: Sequence[Resolver], entries: Sequence[Tensor]) -> Tensor:
    views = [resolve(entries) for resolve in resolvers]
    return views[0] if len(views) == 1 else join(views, -1)
