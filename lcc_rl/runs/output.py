"""What a command writes to the terminal, whose reader may stop, and what to its log."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout, suppress
from io import TextIOWrapper
from typing import Any, cast

from rich import box

# Between INFO, the details, and WARNING: what a waiting user wants to know.
HEADLINE = 25
logging.addLevelName(HEADLINE, "NOTE")

# Looks of every table on the terminal, which has room for 80 characters.
PLAIN: dict[str, Any] = {"box": box.SIMPLE_HEAD, "padding": 0, "show_edge": False}
PLAIN |= {"caption_justify": "left"}

log = logging.getLogger("lcc_rl")


class ShortFormatter(logging.Formatter):
    """The time and the message; the level only of warnings and errors."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return f"{record.levelname} {text}" if record.levelno >= logging.WARNING else text


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
        for handler, level, formatter in changed:
            handler.setLevel(level)
            handler.setFormatter(formatter)


class Unbroken:
    """A stream of text that drops what is written once that is impossible.

    ``lcc-rl train … | head -1`` trains to the end: its results are files.

    Args:
        stream: the stream itself.

    Attributes:
        failure: what went wrong, unless the reader went away; None so far.
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
        """Hand over what is written, or drop it."""
        self._attempt(self._stream.flush)

    def _attempt(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as error:
            if not isinstance(error, BrokenPipeError):
                self.failure = self.failure or error
            # What is still buffered, and all that follows, goes nowhere.
            with suppress(OSError):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._stream.fileno())
                os.close(nowhere)


@contextmanager
def unbroken_output() -> Iterator[None]:
    """Let no output end a command: it is dropped if it is not read or cannot be written.

    A stream that was closed (``>&-``) becomes one to nowhere, and a sign that the terminal's
    encoding lacks is written as its code.

    Raises:
        OSError: at the end, if output could not be written although it is read.
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
        except SystemExit as stop:  # as a command ends that returns its code
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
    """Give closed standard streams a place; a file opened later would get their numbers."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free number
        if getattr(sys, name) is None:
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115
        if number and isinstance(getattr(sys, name), TextIOWrapper):
            getattr(sys, name).reconfigure(errors="backslashreplace")
