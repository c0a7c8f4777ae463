"""Output of commands: terminal, log files and broken pipes."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from io import TextIOWrapper
from typing import Any, cast

from rich import box

from lcc_rl.errors import Concern

# Level of headlines, between INFO (details) and WARNING.
HEADLINE = 25
logging.addLevelName(HEADLINE, "NOTE")

# Options of tables on a terminal of 80 characters.
PLAIN: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": 0, "show_edge": False}
PLAIN |= {"caption_justify": "left"}

log = logging.getLogger("lcc_rl")
_warned: set[str] = set()


class ShortFormatter(logging.Formatter):
    """Formats time and message, with the level for warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return f"{record.levelname} {text}" if record.levelno >= logging.WARNING else text


def show_headline(text: str) -> None:
    """Log a headline, which :func:`headlines` shows on the terminal."""
    log.log(HEADLINE, text)


def log_report(lines: Iterable[str]) -> None:
    """Log lines of a report; lines on changes of the results also appear on the terminal."""
    for line in lines:
        log.log(logging.WARNING if isinstance(line, Concern) else logging.INFO, line)


@contextmanager
def headlines() -> Iterator[None]:
    """Show only headlines and warnings on the terminal, without dates; log files get all lines."""
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
        for handler, level, formatter in changed:
            handler.setLevel(level)
            handler.setFormatter(formatter)


@contextmanager
def repeated_warnings_left_out() -> Iterator[None]:
    """Log a warning of the same text once in all such contexts of a process, as in a loop."""
    log.addFilter(_is_new)
    try:
        yield
    finally:
        log.removeFilter(_is_new)


def _is_new(record: logging.LogRecord) -> bool:
    if record.levelno != logging.WARNING:
        return True
    before = len(_warned)
    _warned.add(record.getMessage())
    return len(_warned) > before


class Unbroken:
    """A text stream that drops its output once writing fails.

    ``lcc-rl train … | head -1`` thus trains to the end.

    Attributes:
        failure: the first error other than a closed pipe, or None.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self.failure: OSError | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, or drop it."""
        self._attempt(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush the stream, or drop its output."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as error:
            if not isinstance(error, BrokenPipeError):
                self.failure = self.failure or error
            # Buffered and further output is dropped.
            with suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextmanager
def unbroken_output() -> Iterator[None]:
    """Drop output that is not read or cannot be written, so that it does not end a command.

    A closed stream (``>&-``) becomes a null device. Characters that the terminal's encoding lacks
    are written as their codes.

    Raises:
        OSError: at the end, if output that is read could not be written.
    """
    own, end = {}, None
    with ExitStack() as stack:
        _open_closed()
        for name, redirect in (("output", redirect_stdout), ("error", redirect_stderr)):
            stream = getattr(sys, f"std{name[:3]}")
            if not isinstance(stream, Unbroken):
                own[f"standard {name}"] = unbroken = Unbroken(stream)
                stack.enter_context(redirect(cast(Any, unbroken)))
        try:
            yield
        except SystemExit as stop:  # raised by commands with an exit code
            if stop.code:
                raise
            end = stop
        finally:
            for stream in (sys.stdout, sys.stderr):
                stream.flush()
    for name, stream in own.items():
        if stream.failure is not None:
            raise OSError(stream.failure.errno, stream.failure.strerror, name)
    if end is not None:
        raise end


def _open_closed() -> None:
    """Open closed standard streams, so that later files do not get their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115
        if number and isinstance(getattr(sys, name), TextIOWrapper):
            getattr(sys, name).reconfigure(errors="backslashreplace")
