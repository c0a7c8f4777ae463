"""Observation of a policy: entries of the string in the views of each automated vehicle."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces.base import OBSERVATION, Entry, Feature
from lcc_rl.pieces.views import BEHIND, PRESENT, Views
from lcc_rl.pieces.world import World
from lcc_rl.settings import Number

Width = Annotated[int, Field(ge=1, le=10_000)]  # entries of one view


class Observation(Feature):
    """Gathers entries, each times a fixed constant, into ``("automated", "observation")``.

    Writes ``[*batch, A, entries]``, one row per automated vehicle. If a vehicle may have fewer than
    ``visible`` vehicles behind, or with ``presence``, one more entry per vehicle behind is 1 if it
    exists and else 0, as its entries are. HCFS observes the state H3, see
    ``conf/observation/platoon.yaml``.
    """

    # Constant of each entry, nested by view (lcc_rl.pieces.views), in the order of the
    # observation, e.g. {"self": {"speed": 0.1}, "ahead": {"speed": 0.1}}.
    scales: Mapping[str, Mapping[str, Number]]
    visible: Width = 1  # number of vehicles behind that are observed, nearest first
    # Number of columns of views with several, or a list of that length, such as the horizons of a
    # preview.
    widths: Mapping[str, Width | Sequence[float]] | None = None
    # Dotted name of the entry subtracted from a view's entries, e.g. {"preview": "ahead.speed"}, or
    # one per equal part; None: no difference. A difference keeps small changes of large numbers
    # visible.
    relative_to: Mapping[str, str | Sequence[str] | None] | None = None
    presence: bool = False  # write which vehicles behind exist, even if all always do
    raw: bool = False  # entries in SI units, without their scale

    measures = True
    gathered = Entry(OBSERVATION, "–", "observed entries, each times its constant")
    factors: ClassVar[Tensor]

    def validate(self) -> None:
        zeros = [".".join(key) for key, scale in self._flat().items() if not scale]
        if zeros or not self._flat():
            which = f"{zeros[0]} has scale 0" if zeros else "there is none"
            raise ValueError(f"scales needs entries that are not 0, {which}")

    def _flat(self) -> dict[tuple[str, str], float]:
        return {(view, name): x for view, own in self.scales.items() for name, x in own.items()}

    def shows_presence(self, string: VehicleString) -> bool:
        """Whether entries show which vehicles behind exist."""
        everywhere = Views(string, AUTOMATED, [], self.visible).sees_all_behind()
        return BEHIND in self.scales and (self.presence or not everywhere)

    def setup(self, world: World) -> None:
        """Find the entries and their columns."""
        flat, string, visible = self._flat(), world.string, self.visible
        wide = {
            view: width if isinstance(width, int) else len(width)
            for view, width in (self.widths or {}).items()
        }
        counts = [visible if view == BEHIND else wide.get(view, 1) for view, _ in flat]
        bases = _bases(self.relative_to or {}, flat, counts)
        values = [x for x, n in zip(flat.values(), counts, strict=True) for _ in range(n)]
        shown = list(flat)
        if self.shows_presence(string):
            shown.append((BEHIND, PRESENT))
            values += [1.0] * visible
            bases.append([])
            counts.append(visible)
        names = list(dict.fromkeys([*shown, *(key for keys in bases for key in keys)]))
        sensed = world.sensed(AUTOMATED, [".".join(name) for name in names])
        views = Views(string, AUTOMATED, sensed, visible)
        self.declare(world, views, [self.gathered.wide(len(values))])
        self.seen, self.names = [".".join(key) for key in shown], [".".join(key) for key in names]
        self.bases = [[names.index(key) for key in keys] for keys in bases]
        self.repeats = [n // max(len(keys), 1) for n, keys in zip(counts, bases, strict=True)]
        factors = [1.0] * len(values) if self.raw else values
        self.register_buffer("factors", torch.tensor(factors))

    def columns_of(self, name: str, *base: str) -> slice:
        """Return the columns of an entry, ``"self.gap"``, or of its differences from a second one.

        Raises:
            ConfigError: if it is not observed.
        """
        named = re.compile(re.escape(name) + r"(\.\d+)?")
        columns = enumerate(self.columns())
        indices = [i for i, (entry, *of) in columns if named.fullmatch(entry) and tuple(of) == base]
        text = " relative to ".join((name, *base))
        require(bool(indices), f"a rule needs {text}, which observation.scales does not name")
        return slice(indices[0], indices[-1] + 1)

    def columns(self) -> list[list[str]]:
        """Return for each column the name of its entry, and that of the subtracted entry if any.

        The name of a view with several columns ends with a number: ``"memory.entries.0"``.
        """
        result = []
        for name, bases, repeat in zip(self.seen, self.bases, self.repeats, strict=True):
            width = max(len(bases), 1) * repeat
            for column in range(width):
                label = name if width == 1 else f"{name}.{column}"
                result.append([label, *(self.names[i] for i in bases[column // repeat :][:1])])
        return result

    def compute(self, *values: Tensor) -> Tensor:
        """Return the scaled observation, ``[*batch, A, entries]``."""
        entries = list(values[: len(self.bases)])
        for index, (bases, repeat) in enumerate(zip(self.bases, self.repeats, strict=True)):
            if bases:
                base = torch.cat([values[i] for i in bases], -1)
                entries[index] = entries[index] - base.repeat_interleave(repeat, -1)
        vehicles = max(entry.shape[-2] for entry in entries)
        # An entry that is the same for all, such as a preview of the leader, has one row.
        rows = [
            entry if entry.shape[-2] == vehicles else entry.expand(*entry.shape[:-2], vehicles, -1)
            for entry in entries
        ]
        return torch.cat(rows, dim=-1) * self.factors


def _bases(
    relative_to: Mapping[str, str | Sequence[str] | None],
    flat: Mapping[tuple[str, str], float],
    counts: Sequence[int],
) -> list[list[tuple[str, ...]]]:
    """Return the entries to subtract from each entry, by equal parts; mostly none."""
    for view in relative_to:
        if view == BEHIND or view not in {name for name, _ in flat}:
            where = f"observation.relative_to.{view}"
            raise ConfigError(f"{where}: expected a view of observation.scales other than behind")
    bases = []
    for (view, _), count in zip(flat, counts, strict=True):
        base = relative_to.get(view) or ()
        keys = [tuple(key.split(".")) for key in ([base] if isinstance(base, str) else base)]
        if keys and count % len(keys):
            raise ConfigError(
                f"observation.relative_to.{view}: {len(keys)} entries do not divide its {count}"
            )
        bases.append(keys)
    return bases
