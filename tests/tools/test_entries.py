"""The page of entries and equations: complete, and up to date."""

from __future__ import annotations

import re
from pkgutil import resolve_name

import entries as tool
import pytest

LAST = {"A": 20, "H": 21}  # numbers of equations of ALCC and of HCFS
REFERENCE = re.compile(r"\b([AH])(\d+)[a-d]?(?:–\1?(\d+)[a-d]?)?")
# One process for all: to make the environments takes longer than to look at them.
pytestmark = pytest.mark.xdist_group("entries")


@pytest.fixture(scope="module")
def environments():
    pytest.importorskip("osqp", reason="extra mpc")
    return list(tool.environments())


def test_every_entry_is_listed_and_every_listed_entry_is_written(environments) -> None:
    rows = tool.collect(environments)
    assert set(rows) == set(tool.ENTRIES)
    assert all(entry.meaning for entry in tool.ENTRIES.values())
    assert all(len(row) > 2 for row in rows.values()), "an entry that no class writes"


def test_page_is_up_to_date(environments, monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(tool, "environments", lambda: environments)
    assert tool.main(["--check"]) == 0
    monkeypatch.setattr(tool, "PAGE", tmp_path / "entries.md")
    assert tool.main(["--check"]) == 1
    assert "python tools/entries.py" in capsys.readouterr().err
    assert tool.main([]) == 0
    assert tool.main(["--check"]) == 0


def numbers_in(text: str) -> set[str]:
    """Return the numbers of equations in a text such as "HCFS H1–H2, see A18d", each by itself."""
    found = set()
    for paper, first, last in REFERENCE.findall(text):
        found |= {f"{paper}{number}" for number in range(int(first), int(last or first) + 1)}
    return found


def test_every_equation_is_listed_once() -> None:
    listed = [number for row in tool.EQUATIONS for number in numbers_in(row.number)]
    wanted = {f"{paper}{i + 1}" for paper, last in LAST.items() for i in range(last)}
    assert len(listed) == len(set(listed))
    assert set(listed) == wanted


def test_docstrings_name_their_equations() -> None:
    for row in tool.EQUATIONS:
        numbers, named = numbers_in(row.number), set()
        for path in row.functions:
            own = numbers_in(resolve_name(f"lcc_rl.{path}").__doc__) & numbers
            assert own, f"the docstring of {path} does not name {row.number}"
            named |= own
        assert named == numbers
