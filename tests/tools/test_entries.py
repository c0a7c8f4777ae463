"""The page of entries and equations, and the reference: complete, and up to date."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pkgutil import iter_modules, resolve_name
from types import FunctionType, ModuleType

import entries as tool
import pytest
from page_blocks import PAGES, ROOT, blocks

from lcc_rl import learn, pieces

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


def test_every_equation_is_listed_once_and_named_by_docstrings() -> None:
    listed = [number for row in tool.EQUATIONS for number in numbers_in(row.number)]
    wanted = {f"{paper}{i + 1}" for paper, last in LAST.items() for i in range(last)}
    assert len(listed) == len(set(listed))
    assert set(listed) == wanted
    for row in tool.EQUATIONS:
        numbers, named = numbers_in(row.number), set()
        for path in row.functions:
            own = numbers_in(resolve_name(f"lcc_rl.{path}").__doc__) & numbers
            assert own, f"the docstring of {path} does not name {row.number}"
            named |= own
        assert named == numbers


def test_the_reference_has_all_that_pages_import() -> None:
    """Also all pieces and the ``__all__`` of packages; and docstrings name all parameters."""
    text = "".join(page.read_text() for page in PAGES if page.parent.name == "reference")
    modules = {*re.findall(r":: ([\w.]+)", text)}
    assert {x.name for x in iter_modules(pieces.__path__, "lcc_rl.pieces.")} <= modules
    places = [("lcc_rl.commands.evaluation", learn.__annotations__["return"])]
    for name in ("lcc_rl", "lcc_rl.agents", "lcc_rl.energy", "lcc_rl.envs", "lcc_rl.results"):
        places += [(name, x) for x in import_module(name).__all__]
    codes = [block.text for page in PAGES for block in blocks(page)]
    codes += [path.read_text() for path in (ROOT / "docs" / "recipes").glob("*.py")]
    imports = re.compile(r"^from (lcc_rl[\w.]*) import ([\w, ]+)", re.M)
    for module, names in imports.findall("\n".join(codes)):
        places += [(module, name) for name in names.split(", ")]
    for module, name in places:
        found, home = getattr(import_module(module), name), module
        if isinstance(found, FunctionType | type):
            home = found.__module__
        if not isinstance(found, ModuleType | str | tuple):
            assert modules & {home, f"{home}.{name}", f"{module}.{name}"}, f"{module}.{name}"
    for path in (ROOT / "lcc_rl").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef) or node.name.startswith("_"):
                continue
            text = (ast.get_docstring(node) or "") + "\n"
            if section := re.search(r"^Args:\n((?: {4}.*\n|\n)*)", text, re.M):
                names = ", ".join(re.findall(r"^ {4}(\S[^:\n]*):", section[1], re.M)).split(", ")
                given = {x.arg for x in ast.iter_child_nodes(node.args) if isinstance(x, ast.arg)}
                assert {x.lstrip("*") for x in names} == given - {"self", "cls"}, node.name
