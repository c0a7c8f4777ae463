"""Write docs/settings.md for make docs: every setting of every class, from the fields."""

from __future__ import annotations

import ast
import inspect
import pkgutil
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from lcc_rl.results.render import markdown_table
from lcc_rl.settings import Settings, defaults

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "settings.md"
ROOMS = (
    *("config.schemas", "agents", "pieces", "energy", "drivers", "data", "synthetic"),
    "runs.loggers",
)
HEAD = """# Settings

<!-- Written by `python tools/settings.py`; do not edit. -->

The key `_target_` of a node names its class; the other keys are the settings below.
`lcc-rl train agent.gamma=0.95 reward.terms.safety.margin=0.5` sets two of them. A run's
`config.yaml` holds the values of all settings. The files of `conf/` hold values that differ from
defaults.
"""


def classes() -> Iterator[type[Settings]]:
    """Yield the classes with settings in order of packages, each once."""
    for room in ROOMS:
        top = import_module(f"lcc_rl.{room}")
        parts = pkgutil.walk_packages(getattr(top, "__path__", ()), f"{top.__name__}.")
        for module in (top, *(import_module(part.name) for part in parts)):
            for kind in vars(module).values():
                own = inspect.isclass(kind) and kind.__module__ == module.__name__
                if own and issubclass(kind, Settings):
                    yield kind


def settings(kind: type[Settings]) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, type, default and meaning of each setting declared by a class."""
    lines, _ = inspect.getsourcelines(kind)
    (body,) = ast.parse("".join(lines)).body
    assert isinstance(body, ast.ClassDef)
    for node in body.body:
        if isinstance(node, ast.AnnAssign) and "ClassVar" not in ast.unparse(node.annotation):
            value = "required" if node.value is None else default(kind, node)
            yield ast.unparse(node.target), ast.unparse(node.annotation), value, noted(lines, node)


def default(kind: type[Settings], node: ast.AnnAssign) -> str:
    """Return a default without ``field(...)``, and the value of a name."""
    if isinstance(node.value, ast.Name | ast.Attribute):
        return repr(defaults(kind)[ast.unparse(node.target)])
    source = ast.unparse(node.value) if node.value else ""
    return re.sub(r"^field\(default_factory=(?:lambda: )?(.*)\)$", r"\1", source)


def noted(lines: list[str], node: ast.AnnAssign) -> str:
    """Return the comment of a setting, at its end or in the lines above it."""
    behind = lines[(node.end_lineno or node.lineno) - 1].partition("  # ")[2].strip()
    above: list[str] = []
    place = node.lineno - 2
    while lines[place].strip().startswith("# "):
        above.insert(0, lines[place].strip().removeprefix("# "))
        place -= 1
    found = " ".join([*above, behind]).strip()
    return "" if found.startswith("type: ") else found.partition("  # type:")[0]


def page() -> str:
    """Return the page, with a section per class that declares settings."""
    parts = [HEAD]
    for kind in classes():
        rows = list(settings(kind))
        if not rows:
            continue
        bases = [base.__name__ for base in kind.__bases__ if issubclass(base, Settings)][:1]
        also = (
            f" It also has the settings of `{bases[0]}`." if bases not in ([], ["Settings"]) else ""
        )
        summary = (kind.__doc__ or "").partition("\n")[0]
        parts.append(f"## {kind.__module__}.{kind.__name__}\n\n{summary}{also}\n")
        cells = ((*(f"`{x}`" for x in coded), text) for *coded, text in rows)
        parts.append(markdown_table(("setting", "type", "default", ""), cells) + "\n")
    return "\n".join(parts)


def main() -> int:
    """Write the page."""
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
