"""Interrupt room: what SIGINT and SIGTERM do before, during and after the work of a command."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

INTERRUPTED = 130  # exit code
SIGNALS = (signal.SIGINT, signal.SIGTERM)


def end_quietly() -> None:
    """Let a command that only imports yet end with one line instead of a traceback or nothing."""

    def end(number: int, frame: Any) -> None:
        os.write(2, b"lcc_rl: interrupted\n")
        # An exception could be swallowed by whatever is being imported.
        os._exit(INTERRUPTED)

    for kind in SIGNALS:
        # Whoever started this in the background may have told it to ignore Ctrl-C.
        if signal.getsignal(kind) is not signal.SIG_IGN:
            signal.signal(kind, end)


def is_command() -> bool:
    """Whether this package is being imported by ``python -m lcc_rl.…``, which says so itself."""
    return sys.argv[:1] == ["-m"] and threading.current_thread() is threading.main_thread()


@contextmanager
def interruptible() -> Iterator[None]:
    """Make SIGTERM what Ctrl-C is, a KeyboardInterrupt, and Ctrl-C again what it was."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    before = {kind: signal.getsignal(kind) for kind in SIGNALS}
    for kind, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(kind, interrupt)
    try:
        yield
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Turn the first SIGINT or SIGTERM into a request to stop; the second acts at once."""
    event = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield event
        return
    before = {kind: signal.getsignal(kind) for kind in SIGNALS}

    def request(number: int, frame: Any) -> None:
        event.set()
        for kind, handler in before.items():
            signal.signal(kind, handler)

    for kind in before:
        signal.signal(kind, request)
    try:
        yield event
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
