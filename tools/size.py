"""Print how large the project is: python tools/size.py, or make size.

Only files that git tracks count. Code is what is left of the lines without docstrings, comments and
blank lines. Guards are the lines of `raise`, of calls of check_… and require_…, and of functions
so named. Cases are the tests that pytest collects, marked slow or not.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
GUARD = re.compile(r"(check|require)_")
SPACE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, ast.ClassDef, *FUNCTIONS)
TARGETS = {"lcc_rl + tools": "25,000 lines, 15,500 of code", "tests": "10,000 lines, 900 cases"}


def tracked() -> list[str]:
    """Return the files that git tracks, relative to the root."""
    done = subprocess.run(("git", "ls-files"), cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


def lines_of(nodes: Iterable[Any]) -> set[int]:
    """Return the lines of nodes of a syntax tree."""
    return {n for node in nodes for n in range(node.lineno, node.end_lineno + 1)}


def is_guard(node: ast.AST) -> bool:
    """Return whether a node raises, or is or calls a function named check_… or require_…."""
    if isinstance(node, ast.Call):
        return bool(GUARD.match(getattr(node.func, "id", getattr(node.func, "attr", ""))))
    return isinstance(node, ast.Raise) or (
        isinstance(node, FUNCTIONS) and bool(GUARD.match(node.name))
    )


def measured(text: str) -> dict[str, int]:
    """Return the numbers of one module."""
    nodes = list(ast.walk(ast.parse(text)))
    documented = (x.body[0] for x in nodes if isinstance(x, DOCUMENTED) and ast.get_docstring(x))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    filled = (range(x.start[0], x.end[0] + 1) for x in tokens if x.type not in SPACE and x.string)
    code = {n for lines in filled for n in lines} - lines_of(documented)
    guards = code & lines_of(x for x in nodes if is_guard(x))
    tests = sum(isinstance(x, FUNCTIONS) and x.name.startswith("test") for x in nodes)
    numbers = (1, len(text.splitlines()), len(code), len(guards), tests)
    return dict(zip(("modules", "lines", "code", "guards", "tests"), numbers, strict=True))


def cases() -> dict[str, int]:
    """Return how many cases pytest collects in each test module."""
    words = (sys.executable, "-m", "pytest", "--collect-only", "-qq", "tests")
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    found = re.findall(r"^(tests/\S+\.py): (\d+)$", done.stdout, re.MULTILINE)
    return {name: int(count) for name, count in found}


def table(names: Iterable[str], counted: dict[str, int]) -> pd.DataFrame:
    """Return a row for each part of the project, and for each folder of lcc_rl and tools.

    Args:
        names: files, relative to the root.
        counted: cases by test module.
    """
    rows = []
    for name in names:
        top, *rest = Path(name).parts
        parts = [top]
        if top in ("lcc_rl", "tools"):
            parts += ["lcc_rl + tools", "/".join((top, *rest[:-1][:1]))]
        if name.endswith(".yaml"):
            numbers = {"yaml": 1}
        elif name.endswith(".py") and top in ("lcc_rl", "tools", "tests"):
            numbers = measured((ROOT / name).read_text(encoding="utf-8")) | {
                "cases": counted.get(name, 0)
            }
        else:
            continue
        rows += [{"part": part, **numbers} for part in dict.fromkeys(parts)]
    found = pd.DataFrame(rows).fillna(0).groupby("part").sum().astype(int)
    found.insert(4, "%", (100 * found["guards"] / found["code"]).round(1))
    found["target"] = pd.Series(TARGETS)
    return found


def main() -> None:
    """Print the table."""
    print(table(tracked(), cases()).to_string(na_rep=""))


if __name__ == "__main__":
    main()
