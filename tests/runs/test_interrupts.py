"""What signals do to a command: one line while it imports, KeyboardInterrupt while it works."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from lcc_rl.cli.entry import sweep
from lcc_rl.errors import Interrupted
from lcc_rl.runs.interrupts import INTERRUPTED, interruptible, is_command, stop_signal

IMPORTS = "import sys; sys.argv = ['-m']; import lcc_rl; print('on', flush=True); input()"


@pytest.fixture(autouse=True)
def ctrl_c():
    """Hear SIGINT also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_imports_yet_ends_with_one_line(kind) -> None:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", IMPORTS], text=True, **pipes) as child:
        assert child.stdout.readline() == "on\n"
        child.send_signal(kind)
        _, errors = child.communicate(timeout=60)
    assert (child.returncode, errors) == (INTERRUPTED, "lcc_rl: interrupted\n")


def test_importing_the_package_elsewhere_changes_no_handler() -> None:
    assert not is_command()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_an_interrupt_that_another_error_hides_is_one_still() -> None:
    def composing() -> None:
        try:
            raise KeyboardInterrupt
        finally:
            {}["what the interrupt has left half done"]

    def stopping() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt:
            raise Interrupted("stopped; resume it") from None

    for command, kind in ((composing, KeyboardInterrupt), (stopping, Interrupted)):
        with pytest.raises(kind):
            sweep(command)
    with pytest.raises(KeyError):
        sweep(lambda: {}["no interrupt"])


def test_sigterm_is_an_interrupt_and_afterwards_what_it_was() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), interruptible():
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_the_first_signal_asks_and_the_second_acts() -> None:
    with interruptible(), stop_signal() as stop:
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
