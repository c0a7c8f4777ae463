"""What a long command tells on the terminal, and what only its log file gets."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

# Between INFO, the details, and WARNING: what somebody who waits wants to know.
HEADLINE = 25
logging.addLevelName(HEADLINE, "NOTE")

log = logging.getLogger("lcc_rl")


def tell(text: str) -> None:
    """Log a line that :func:`headlines` lets through to the terminal."""
    log.log(HEADLINE, text)


@contextmanager
def headlines() -> Iterator[None]:
    """Show headlines and warnings on the terminal, without dates; log files get every line."""
    changed = []
    for handler in logging.getLogger().handlers:
        if isinstance(handler, logging.StreamHandler) and not isinstance(
            handler, logging.FileHandler
        ):
            changed.append((handler, handler.level, handler.formatter))
            handler.setLevel(max(handler.level, HEADLINE))
            handler.setFormatter(logging.Formatter("%(message)s"))
    try:
        yield
    finally:
        _put_back(changed)


def _put_back(
    changed: list[tuple[logging.StreamHandler[TextIO], int, logging.Formatter | None]],
) -> None:
    for handler, level, formatter in changed:
        handler.setLevel(level)
        handler.setFormatter(formatter)
