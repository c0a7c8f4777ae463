"""Handlers of the signals that end a command: Ctrl-C, a scheduler's, a closed terminal's."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

# Exit codes.
BAD_INPUT, INTERRUPTED = 2, 130
ENDING_SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []),
)
TOGETHER = 1.0  # a scheduler, a terminal and a parent process may all send one [s]
Restore = Callable[[], None]


def _end(*_: Any) -> NoReturn:
    os.write(2, b"lcc_rl: interrupted\n")
    # An exception could be swallowed by whatever is being imported.
    os._exit(INTERRUPTED)


def end_quietly() -> None:
    """Exit with one line instead of a traceback while a command is still importing."""
    for kind in ENDING_SIGNALS:
        # A shell may have started this process in the background with SIGINT ignored.
        if signal.getsignal(kind) is not signal.SIG_IGN:
            signal.signal(kind, _end)


@contextmanager
def _handled_by(
    action: Callable[[int, Restore], None], also_ignored: Collection[int] = ()
) -> Iterator[None]:
    """Let signals call ``action(signal, restore)`` in the main thread; restore them at the end."""
    main = threading.current_thread() is threading.main_thread()
    before = {kind: signal.getsignal(kind) for kind in ENDING_SIGNALS} if main else {}

    def restore() -> None:
        for kind, previous in before.items():
            signal.signal(kind, previous)

    for kind, previous in before.items():
        if kind in also_ignored or previous is not signal.SIG_IGN:
            signal.signal(kind, lambda number, frame: action(number, restore))
    try:
        yield
    finally:
        restore()


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Raise KeyboardInterrupt on a signal that ends a command, and set the event.

    What the interrupt breaks into may answer with an error of its own.
    """
    event = threading.Event()

    def interrupt(number: int, restore: Restore) -> None:
        event.set()
        raise KeyboardInterrupt

    with _handled_by(interrupt):
        yield event


@contextmanager
def ending_quietly() -> Iterator[None]:
    """Exit on a signal as :func:`end_quietly` does, while a command imports more."""
    gc.disable()  # a fifth of the time
    try:
        with _handled_by(_end):
            yield
    finally:
        gc.freeze()  # modules stay: later searches for garbage leave them out
        gc.enable()


def was_interrupted(error: BaseException | None) -> bool:
    """Whether an error followed from an interrupt, which broke into what cannot bear it."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Set the event on the first signal; one that comes a second later acts as before.

    SIGINT counts although the shell that started the process in the background ignores it; an
    ignored SIGHUP (``nohup``) does not.
    """
    event = threading.Event()
    last = 0.0

    def request(number: int, restore: Restore) -> None:
        nonlocal last
        if not event.is_set():
            event.set()
            last = time.monotonic() + TOGETHER
        elif time.monotonic() > last:
            restore()
            signal.raise_signal(number)

    with _handled_by(request, also_ignored=(signal.SIGINT, signal.SIGTERM)):
        yield event
