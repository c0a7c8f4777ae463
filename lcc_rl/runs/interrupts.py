"""Handlers of SIGINT and SIGTERM for commands."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

# Exit codes.
BAD_INPUT, INTERRUPTED = 2, 130
SIGNALS = (signal.SIGINT, signal.SIGTERM)
Restore = Callable[[], None]


def _end(*_: Any) -> NoReturn:
    os.write(2, b"lcc_rl: interrupted\n")
    # An exception could be swallowed by whatever is being imported.
    os._exit(INTERRUPTED)


def end_quietly() -> None:
    """Exit with one line instead of a traceback while a command is still importing."""
    for kind in SIGNALS:
        # A shell may have started this process in the background with SIGINT ignored.
        if signal.getsignal(kind) is not signal.SIG_IGN:
            signal.signal(kind, _end)


def is_command() -> bool:
    """Whether ``python -m`` is importing this package."""
    return sys.argv[:1] == ["-m"] and threading.current_thread() is threading.main_thread()


@contextmanager
def _handled_by(action: Callable[[Restore], None], also_ignored: bool) -> Iterator[None]:
    """Let signals call ``action(restore)`` in the main thread; restore the handlers at the end."""
    main = threading.current_thread() is threading.main_thread()
    before = {kind: signal.getsignal(kind) for kind in SIGNALS} if main else {}

    def restore() -> None:
        for kind, previous in before.items():
            signal.signal(kind, previous)

    for kind, previous in before.items():
        if also_ignored or previous is not signal.SIG_IGN:
            signal.signal(kind, lambda number, frame: action(restore))
    try:
        yield
    finally:
        restore()


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise KeyboardInterrupt on SIGTERM and SIGINT."""

    def interrupt(restore: Restore) -> None:
        raise KeyboardInterrupt

    with _handled_by(interrupt, also_ignored=False):
        yield


@contextmanager
def ending_quietly() -> Iterator[None]:
    """Exit on SIGTERM and SIGINT as :func:`end_quietly` does, while a command imports more."""
    with _handled_by(_end, also_ignored=False):
        yield


def was_interrupted(error: BaseException | None) -> bool:
    """Whether an error followed from an interrupt, which broke into what cannot bear it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Set the event on the first SIGINT or SIGTERM; the second one acts as before."""
    event = threading.Event()

    def request(restore: Restore) -> None:
        event.set()
        restore()

    with _handled_by(request, also_ignored=True):
        yield event
