"""Handlers of signals that end a command: Ctrl-C, scheduler, closed terminal."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, NoReturn

from lcc_rl.io.memory import uncollected

# Exit codes.
BAD_INPUT, INTERRUPTED = 2, 130
ENDING_SIGNALS = (
    signal.SIGINT,
    signal.SIGTERM,
    *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []),
)
TOGETHER = 1.0  # signals of scheduler, terminal and parent within this time count as one [s]
BETWEEN_LOOKS = 1.0  # time after which a process looks again whether its parent lives [s]
Restore = Callable[[], None]


def _end(*_: Any) -> NoReturn:
    # A module that is being imported could suppress an exception, such as that of a closed stderr.
    with suppress(OSError):
        os.write(2, b"lcc_rl: interrupted\n")
    os._exit(INTERRUPTED)


def end_quietly() -> None:
    """Exit with one line instead of a traceback while a command imports modules."""
    for kind in ENDING_SIGNALS:
        # A shell may have started this process in the background with SIGINT ignored.
        if signal.getsignal(kind) is not signal.SIG_IGN:
            signal.signal(kind, _end)


@cache
def end_with_parent() -> None:
    """End a process of a pool when its parent is killed; else it would wait for work forever."""
    parent = multiprocessing.parent_process()

    def wait_for_end() -> None:
        while parent is not None and os.getppid() == parent.pid:
            time.sleep(BETWEEN_LOOKS)
        os._exit(INTERRUPTED)

    if parent is not None:
        threading.Thread(target=wait_for_end, daemon=True).start()


@contextmanager
def _handled_by(
    action: Callable[[int, Restore], None], also_ignored: Collection[int] = ()
) -> Iterator[None]:
    """Make signals call ``action(signal, restore)`` in the main thread; restore them at the end."""
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

    Interrupted code may raise another error.
    """
    event = threading.Event()

    def interrupt(number: int, restore: Restore) -> None:
        event.set()
        raise KeyboardInterrupt

    with _handled_by(interrupt):
        yield event


@contextmanager
def ending_quietly() -> Iterator[None]:
    """Exit on a signal as :func:`end_quietly` does, while a command imports further modules."""
    with uncollected():
        try:
            with _handled_by(_end):
                yield
        finally:
            gc.freeze()  # later garbage collection skips modules


def was_interrupted(error: BaseException | None) -> bool:
    """Whether an error was caused by an interrupt."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


@contextmanager
def stop_signal() -> Iterator[threading.Event]:
    """Set the event on the first signal, with a line; one a second later has its default action.

    SIGINT counts even if the shell ignores it for background processes; an ignored SIGHUP
    (``nohup``) does not.
    """
    event = threading.Event()
    last = 0.0

    def request(number: int, restore: Restore) -> None:
        nonlocal last
        if not event.is_set():
            event.set()
            last = time.monotonic() + TOGETHER
            with suppress(OSError):
                os.write(2, b"lcc_rl: stopping once this iteration is saved\n")
        elif time.monotonic() > last:
            restore()
            signal.raise_signal(number)

    with _handled_by(request, also_ignored=(signal.SIGINT, signal.SIGTERM)):
        yield event
