"""Text is read and written as UTF-8, whatever the machine's code page is."""

from __future__ import annotations

import ast
from collections.abc import Iterator

from page_blocks import ROOT

FOLDERS = ("lcc_rl", "tools")
# Calls that open a file, and the place of the mode among their arguments.
OPENERS = {"open": 1, "fdopen": 1, "NamedTemporaryFile": 0, "TemporaryFile": 0}
TEXTS = {"read_text": 0, "write_text": 1, "FileHandler": 2}  # … of the encoding
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]


def by_code_page(tree: ast.AST) -> Iterator[int]:
    """Yield the lines of calls that read or write text without naming the encoding."""
    for call in ast.walk(tree):
        if not isinstance(call, ast.Call) or any(word.arg == "encoding" for word in call.keywords):
            continue
        method = isinstance(call.func, ast.Attribute)
        name = call.func.attr if method else getattr(call.func, "id", "")
        if name in TEXTS and len(call.args) <= TEXTS[name]:
            yield call.lineno
        if name not in OPENERS or (
            method and getattr(call.func.value, "id", "") in {"os", "Image"}
        ):
            continue
        bound = method and getattr(call.func.value, "id", "") not in {"gzip", "io", "tempfile"}
        place = OPENERS[name] - (bound and name == "open")
        modes = [word.value for word in call.keywords if word.arg == "mode"] or call.args[place:]
        mode = getattr(modes[0], "value", "b") if modes else "r"
        binary = "b" if getattr(getattr(call.func, "value", None), "id", "") != "gzip" else ""
        if isinstance(mode, str) and ("t" in mode or binary not in mode):
            yield call.lineno


def test_calls_that_depend_on_the_code_page_are_found(subtests) -> None:
    for code, found in [
        ("path.read_text()", True),
        ("path.read_text('utf-8')", False),
        ("path.read_text(encoding='utf-8')", False),
        ("path.write_text(text)", True),
        ("path.open()", True),
        ("path.open('w')", True),
        ("path.open('rb')", False),
        ("open(path)", True),
        ("open(path, 'wb')", False),
        ("open(path, mode='w')", True),
        ("gzip.open(path, 'wt')", True),
        ("gzip.open(path, 'wt', encoding='utf-8')", False),
        ("Image.open(path)", False),
    ]:
        with subtests.test(code=code):
            assert bool(list(by_code_page(ast.parse(code)))) == found


def test_every_text_is_utf_8() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in FILES
        for line in by_code_page(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert len(FILES) > 200
    assert not found, "\n".join(found)
