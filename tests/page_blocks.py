"""The pages of the documentation as blocks and commands."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs" / "reference").glob("*.md")),
]


@dataclass(frozen=True)
class Block:
    """A fenced block of a page.

    Attributes:
        line: number of its first line inside the fence.
        language: what stands after the fence.
        text: its lines.
        before: the last line of text above it.
    """

    line: int
    language: str
    text: str
    before: str


def blocks(page: Path) -> list[Block]:
    """Return all fenced blocks of a page in their order."""
    found, before = [], ""
    lines = iter(enumerate(page.read_text(encoding="utf-8").splitlines(), 1))
    for number, line in lines:
        if not line.startswith("```"):
            before = line or before
            continue
        inside: list[str] = []
        for _, text in lines:
            if text == "```":
                break
            inside.append(text)
        found.append(Block(number + 1, line[3:], "\n".join(inside) + "\n", before))
    return found


def commands(block: Block) -> Iterator[list[str]]:
    """Yield the words of every command of a block of the languages bash and console."""
    for line in block.text.replace("\\\n", " ").splitlines():
        if block.language == "bash" or line.startswith("$ "):
            words = words_of(line.removeprefix("$ "))
            if words:
                yield words


def words_of(line: str) -> list[str]:
    """Split a command; a word ``…`` that stands for further settings is left out."""
    words = shlex.split(line, comments=True)
    pairs = zip(["", *words], words, strict=False)
    return [word for before, word in pairs if word != "…" or before.startswith("--")]
