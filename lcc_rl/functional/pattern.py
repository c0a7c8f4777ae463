"""The string of vehicles: which roles drive in which order, from a pattern.

A pattern lists roles from front to back: ``"automated human*5"``, ``"human*5 (automated
human*9)*10"``. A mapping ``{size: 100, penetration: 0.1}`` draws the places of the automated
vehicles anew in every episode.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lcc_rl.errors import ConfigError, require

AUTOMATED, HUMAN = "automated", "human"
# First parts of other entries and views, which no role can have.
RESERVED = {"vehicles", "leader", "episode", "self", "ahead", "behind", "next", "role", "name"}
OPEN, RING = "open", "ring"
MAX_ACCELERATION = 3.0  # of automated vehicles by default, in both directions [m/s²]
TOKEN = re.compile(r"\s*([A-Za-z_]\w*|\*\s*[0-9]+|[()])")
MOST_VEHICLES = 10_000  # vehicles of one string


@dataclass(frozen=True)
class VehicleString:
    """The roles of the vehicles of one lane.

    Args:
        roles: role of every vehicle, front to back; in any order if places are drawn.
        drawn: whether places are drawn anew in every episode; the counts of the roles are fixed.
        ring: whether the first vehicle follows the last.
        measured: whether views of a vehicle are inputs, under their own names, and not computed
            from the string.
    """

    roles: tuple[str, ...] = (AUTOMATED,)
    drawn: bool = False
    ring: bool = False
    measured: bool = False

    def __len__(self) -> int:
        return len(self.roles)

    def count(self, role: str) -> int:
        """Return how many vehicles have a role."""
        return self.roles.count(role)

    def places(self, role: str) -> tuple[int, ...]:
        """Return the places of a role, 0 at the front; not meaningful if places are drawn."""
        return tuple(place for place, name in enumerate(self.roles) if name == role)

    def follows(self, role: str) -> bool:
        """Return whether a vehicle of a role drives, or may be drawn, directly behind another."""
        pairs = zip(self.roles, self.roles[1:] + self.roles[: int(self.ring)], strict=False)
        return (role, role) in pairs or (self.drawn and self.count(role) > 1)

    @property
    def names(self) -> tuple[str, ...]:
        """The roles in the string, in the order of their first vehicles."""
        return tuple(dict.fromkeys(self.roles))


def parse_string(pattern: Any, road: str = OPEN) -> VehicleString:
    """Return the string that a configuration describes.

    Args:
        pattern: a pattern, or a mapping with ``size`` and ``penetration``, see the module.
        road: ``"open"`` or ``"ring"``.

    Raises:
        ConfigError: pointing at the place in the pattern where it cannot be read.

    Examples:
        >>> parse_string("automated human*2").roles
        ('automated', 'human', 'human')
        >>> parse_string({"size": 10, "penetration": 0.04}).count("automated")
        1
    """
    require(road in (OPEN, RING), f"scenario.road must be {OPEN!r} or {RING!r}, got {road!r}")
    if isinstance(pattern, str):
        return VehicleString(tuple(_Parser(pattern).parse()), ring=road == RING)
    if not isinstance(pattern, Mapping) or set(pattern) != {"size", "penetration"}:
        raise ConfigError(
            "scenario.string must be a pattern such as 'automated human*5' or "
            f"{{size: 100, penetration: 0.1}}, got {pattern!r}"
        )
    return _mixture(pattern["size"], pattern["penetration"], road == RING)


def _mixture(size: Any, penetration: Any, ring: bool) -> VehicleString:
    if not isinstance(size, int) or isinstance(size, bool) or not 1 <= size <= MOST_VEHICLES:
        raise ConfigError(
            f"scenario.string.size must be a whole number in 1…{MOST_VEHICLES}, got {size}"
        )
    number = isinstance(penetration, (int, float)) and not isinstance(penetration, bool)
    if not number or not 0.0 <= penetration <= 1.0:
        raise ConfigError(f"scenario.string.penetration must lie in [0, 1], got {penetration!r}")
    count = max(round(size * penetration), 1) if penetration > 0 else 0
    roles = (AUTOMATED,) * count + (HUMAN,) * (size - count)
    return VehicleString(roles, drawn=0 < count < size, ring=ring)


class _Parser:
    """Reads ``sequence := item+``, ``item := (NAME | '(' sequence ')') ['*' NUMBER]``."""

    def __init__(self, text: str) -> None:
        self.text, self.place = text, 0

    def parse(self) -> list[str]:
        roles = self._sequence(0)
        if self.place < len(self.text.rstrip()):
            times = self.text[self.place :].lstrip().startswith("*")
            what = "a number behind '*'" if times else "a role, '(' or the end"
            raise self._error(f"expected {what}", self.place)
        return roles

    def _sequence(self, depth: int) -> list[str]:
        roles: list[str] = []
        while (token := self._peek()) is not None and token != ")":
            begun = self.place
            roles += self._item(token, depth)
            if len(roles) > MOST_VEHICLES:
                raise self._error(f"more than {MOST_VEHICLES} vehicles", begun)
        if not roles:
            raise self._error("expected a role", self.place)
        return roles

    def _item(self, token: str, depth: int) -> list[str]:
        if token.startswith("*"):
            raise self._error("expected a role before '*'", self.place)
        if depth > 20:
            raise self._error("too many brackets", self.place)
        begun = self.place
        if token in RESERVED:
            raise self._error(f"the name {token} is reserved, expected a role", begun)
        self._advance()
        roles = [token]
        if token == "(":
            roles = self._sequence(depth + 1)
            if self._peek() != ")":
                raise self._error("this bracket is never closed", begun)
            self._advance()
        times = self._peek()
        if times is None or not times.startswith("*"):
            return roles
        count = int(times[1:].lstrip("0")[:6] or 0)
        if not 1 <= count * len(roles) <= MOST_VEHICLES:
            raise self._error(
                f"expected a number that makes 1…{MOST_VEHICLES} vehicles", self.place
            )
        self._advance()
        return roles * count

    def _peek(self) -> str | None:
        found = TOKEN.match(self.text, self.place)
        return None if found is None else found.group(1).replace(" ", "")

    def _advance(self) -> None:
        found = TOKEN.match(self.text, self.place)
        assert found is not None
        self.place = found.end()

    def _error(self, what: str, place: int) -> ConfigError:
        # The next word, not the white space before it.
        rest = self.text[place:]
        place += len(rest) - len(rest.lstrip())
        return ConfigError(
            f"scenario.string={self.text!r}: {what} at character {place + 1}: "
            f"{self.text[:place]}»{self.text[place:]}"
        )
