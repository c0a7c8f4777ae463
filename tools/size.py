"""Print or check the size of the project: python tools/size.py [--check]; make size, make lint.

Only files tracked by git count. Code is lines without docstrings, comments and blank lines. Guards
are the lines of `raise`, of calls of check_… and require_…, and of functions with these names.
Cases are the tests that pytest collects, slow ones included. The floor of a package is above those
of all packages that it imports; a circle is a group of modules that import each other.
"""

from __future__ import annotations

import ast
import gc
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import networkx
import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
GUARD = re.compile(r"(check|require)_")
SPACE = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT}
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
DOCUMENTED = (ast.Module, ast.ClassDef, *FUNCTIONS)
# make lint fails above these ceilings; further work may use the difference.
CEILINGS = {
    "lcc_rl + tools": {"lines": 45_880, "code": 30_510},
    "tests": {"lines": 28_030},
    "conf": {"yaml": 166},
}
CASES = 1_335  # ceiling of all quick tests, see tests/tools/test_size.py
STRUCTURE = {
    "names in several modules": 55,
    "floors": 10,
    "circles": 0,
    "functions with a configuration": 128,
}


def tracked() -> list[str]:
    """Return the files tracked by git, relative to the root."""
    done = subprocess.run(("git", "ls-files"), cwd=ROOT, capture_output=True, text=True, check=True)
    return [name for name in done.stdout.splitlines() if (ROOT / name).is_file()]


tree_of = cache(ast.parse)  # of a module's text


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
    nodes = list(ast.walk(tree_of(text)))
    documented = (x.body[0] for x in nodes if isinstance(x, DOCUMENTED) and ast.get_docstring(x))
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    filled = (range(x.start[0], x.end[0] + 1) for x in tokens if x.type not in SPACE and x.string)
    code = {n for lines in filled for n in lines} - lines_of(documented)
    guards = code & lines_of(x for x in nodes if is_guard(x))
    tests = sum(isinstance(x, FUNCTIONS) and x.name.startswith("test") for x in nodes)
    numbers = (1, len(text.splitlines()), len(code), len(guards), tests)
    return dict(zip(("modules", "lines", "code", "guards", "tests"), numbers, strict=True))


def cases() -> dict[str, int]:
    """Return the number of cases that pytest collects in each test module."""
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
    return found


def above(found: pd.DataFrame, shape: dict[str, int]) -> list[str]:
    """Return a line for each number that is above its ceiling.

    Args:
        found: of :func:`table`.
        shape: of :func:`structure`.
    """
    wanted = [(part, what, most) for part, own in CEILINGS.items() for what, most in own.items()]
    counts: Any = found.to_dict("index")
    numbers = [(f"{part}, {what}", int(counts[part][what]), most) for part, what, most in wanted]
    numbers += [(what, shape[what], most) for what, most in STRUCTURE.items()]
    return [
        f"{what}: {count:,}, above the ceiling of {most:,} in tools/size.py"
        for what, count, most in numbers
        if count > most
    ]


def shared_names(trees: dict[str, ast.Module]) -> list[str]:
    """Return the top-level names that several modules define, except private ones and ``log``."""
    places: dict[str, set[str]] = {}
    for module, tree in trees.items():
        for node in tree.body:
            if isinstance(node, (*FUNCTIONS, ast.ClassDef)):
                names = [node.name]
            elif isinstance(node, ast.Assign | ast.AnnAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names = [x.id for y in targets for x in ast.walk(y) if isinstance(x, ast.Name)]
            else:
                continue
            for name in names:
                places.setdefault(name, set()).add(module)
    several = (name for name, modules in places.items() if len(modules) > 1)
    return sorted(name for name in several if not name.startswith("_") and name != "log")


def imports(trees: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Return the modules of the package that each imports, also within functions."""
    found: dict[str, set[str]] = {}
    for module, tree in trees.items():
        names = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
        found[module] = (names & trees.keys()) - {module}
    return found


def circles(arrows: dict[str, set[str]]) -> list[set[str]]:
    """Return the groups of nodes that reach each other."""
    groups = networkx.strongly_connected_components(networkx.DiGraph(arrows))
    return [group for group in groups if len(group) > 1]


def floors(arrows: dict[str, set[str]]) -> dict[str, int]:
    """Return the floor of each package, 1 without imports; packages of a circle have one floor."""
    rooms = networkx.DiGraph()
    for module, ends in arrows.items():
        room, *targets = (".".join(name.split(".")[:2]) for name in (module, *ends))
        rooms.add_node(room)
        rooms.add_edges_from((room, target) for target in targets if target != room)
    rooms.remove_nodes_from(["lcc_rl"])
    circled = networkx.condensation(rooms)
    storeys = enumerate(networkx.topological_generations(circled.reverse()), 1)
    members = circled.nodes(data="members")
    return {room: floor for floor, ends in storeys for end in ends for room in members[end]}


def takes_configuration(node: ast.AST) -> bool:
    """Return whether a node is a function with a configuration among its parameters."""
    if not isinstance(node, FUNCTIONS):
        return False
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    kinds = [ast.unparse(x.annotation) for x in given if x.annotation]
    return any(x.arg == "cfg" for x in given) or any(x.endswith("Config") for x in kinds)


def structure(names: Iterable[str]) -> dict[str, int]:
    """Return the numbers of shared names, floors, circles and functions with a configuration."""
    files = [x for x in names if x.startswith("lcc_rl/") and x.endswith(".py")]
    dotted = (x.removesuffix(".py").removesuffix("/__init__").replace("/", ".") for x in files)
    texts = ((ROOT / x).read_text(encoding="utf-8") for x in files)
    trees = {module: tree_of(text) for module, text in zip(dotted, texts, strict=True)}
    arrows = imports(trees)
    high = max(floors(arrows).values(), default=0)
    reads = sum(takes_configuration(node) for tree in trees.values() for node in ast.walk(tree))
    counts = (len(shared_names(trees)), high, len(circles(arrows)), reads)
    return dict(zip(STRUCTURE, counts, strict=True))


def main(words: Sequence[str]) -> int:
    """Print table and structure; or check them, and return 1 if one is above its ceiling."""
    gc.disable()  # its passes over half a million nodes of trees would take most of the time
    names, check = tracked(), "--check" in words
    found, shape = table(names, {} if check else cases()), structure(names)
    lines = above(found, shape)
    if not check:
        print(found.to_string(na_rep=""))
        lines = [f"{what}: {count} (at most {STRUCTURE[what]})" for what, count in shape.items()]
    print(*lines, sep="\n", end="\n" * bool(lines))
    return int(check and bool(lines))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
