"""Parser of command-line flags with typed values and one-line errors."""

from __future__ import annotations

import re
import sys
from argparse import ArgumentParser, ArgumentTypeError, RawDescriptionHelpFormatter
from collections.abc import Callable, Sequence
from os.path import exists  # false, too, for what is too long for a path
from textwrap import fill
from typing import Annotated, Any, NoReturn

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError

from lcc_rl.config.words import check_once
from lcc_rl.errors import ConfigError

HELP_WIDTH = 79
FINITE = ConfigDict(allow_inf_nan=False)


class Arguments(ArgumentParser):
    """A parser that keeps the examples in its description and raises a ConfigError."""

    trusts = False

    def __init__(self, description: str | None = None, **settings: Any) -> None:
        settings.setdefault("formatter_class", RawDescriptionHelpFormatter)
        settings.setdefault("allow_abbrev", False)
        super().__init__(description=wrapped(description or ""), **settings)

    def add_trust(self) -> None:
        """Add ``--trust``, whose modules are separated by commas; it may be repeated."""
        how: Any = {"action": "extend", "type": lambda word: word.split(","), "default": []}
        self.add_argument("--trust", help="modules that files may name, with commas", **how)
        self.trusts = True

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse words, also ``trust=[…]`` as training and evaluation write it."""
        words = sys.argv[1:] if args is None else [*args]
        if self.trusts:
            words = [re.sub(r"^trust=\[?(.*?)\]?$", r"--trust=\1", word) for word in words]
        return super().parse_known_args(words, namespace)

    def error(self, message: str) -> NoReturn:
        raise ConfigError(f"{message} ({self.prog} -h lists all flags)")


def wrapped(text: str) -> str:
    """Return a text with paragraphs wrapped at 80 columns, except those with commands."""
    parts = text.strip().split("\n\n")
    prose = [
        part if "lcc-rl " in part else fill(" ".join(part.split()), HELP_WIDTH) for part in parts
    ]
    return "\n\n".join(prose)


def typed(kind: Any) -> Callable[[str], Any]:
    """Return a parser of words for an annotated type, such as :data:`lcc_rl.settings.Count`."""
    adapter = TypeAdapter(kind, config=FINITE)

    def read(word: str) -> Any:
        try:
            return adapter.validate_strings(word)
        except ValidationError as error:
            wanted = re.sub(r"^\w+ should", "must", error.errors()[0]["msg"])
            raise ArgumentTypeError(f"{wanted}, got {word!r}") from None

    return read


TABLE = typed(Annotated[str, Field(pattern=r"\.(csv|parquet)$")])  # a file to write a table to


def files_and_settings(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Divide the words of a command into names, such as files, and settings ``key=value``."""
    files = [word for word in words if "=" not in word or exists(word)]
    return files, [*check_once([word for word in words if word not in files])]
