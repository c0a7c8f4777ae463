"""All equations of the two papers: formula, symbols with units, and implementation."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

LAST = {"A": 20, "H": 21}  # numbers of equations of ALCC and of HCFS
PAPERS = """A1–A20: Wang et al., *Adaptive Leading Cruise Control in Mixed Traffic Considering
Human Behavioral Diversity* (ALCC). H1–H21: Yan et al., *Hybrid Car-Following Strategy Based on
Deep Deterministic Policy Gradient and Cooperative Adaptive Cruise Control* (HCFS). Vehicles count
from the front, 0 is the leader. T is the time step, in A4 and A15 the desired time gap. Import
paths start with `lcc_rl.`. – means no unit, or no deviation."""
REFERENCE = re.compile(r"\b([AH])(\d+)[a-d]?(?:–\1?(\d+)[a-d]?)?")


class Equation(NamedTuple):
    """One equation or several related ones.

    number: as ``A3`` or ``H4–H6``; formula: in plain text; symbols: with units; functions: import
    paths below ``lcc_rl``; deviation: difference of the code from the printed form.
    """

    number: str
    formula: str
    symbols: str
    functions: tuple[str, ...]
    deviation: str = "–"


def numbers_in(text: str) -> set[str]:
    """Return the numbers of equations in a text, with ranges written out.

    Examples:
        >>> sorted(numbers_in("CACC (HCFS H1–H2), see A18d"))
        ['A18', 'H1', 'H2']
    """
    found = set()
    for paper, first, last in REFERENCE.findall(text):
        found |= {f"{paper}{number}" for number in range(int(first), int(last or first) + 1)}
    return found


TABLE = Path(__file__).with_suffix(".toml")
ROWS: list[dict[str, Any]] = tomllib.loads(TABLE.read_text(encoding="utf-8"))["equation"]
EQUATIONS = tuple(Equation(**{**row, "functions": tuple(row["functions"])}) for row in ROWS)
