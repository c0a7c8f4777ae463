"""What signals do to a command, and that it resumes as if nothing had happened."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import (
    QUICK,
    TINY,
    assert_same_tables,
    jobs_in_threads,
    run_command,
    start,
    tiny,
    wait_for,
)
from helpers import slow_but

from lcc_rl.cli.guard import main_guard
from lcc_rl.commands import training
from lcc_rl.errors import ConfigError
from lcc_rl.io.files import read_parquet
from lcc_rl.runs import interrupts
from lcc_rl.runs.interrupts import ENDING_SIGNALS, interruptible, stop_signal

# SIGINT is heard again below; nohup ignores SIGHUP, for its children, too.
SENT = [x for x in ENDING_SIGNALS if x == signal.SIGINT or signal.getsignal(x) != signal.SIG_IGN]
LONGER = ("training.episodes=240", "variant=alcc")
# A command whose import of the console takes until something is typed.
IMPORTS = """
import runpy, sys
class Slow:
    def find_spec(self, name, path, target=None):
        if name == "lcc_rl.cli.console":
            print("on", flush=True), input()
sys.meta_path.insert(0, Slow())
runpy.run_module("lcc_rl", run_name="__main__", alter_sys=True)
"""
# A module that closes stderr and suppresses errors while it is imported.
DEAF = """
            import os
            os.close(2)
            try:
                print("on", flush=True), input()
            except Exception:
                os._exit(0)
"""
# A program of the user's own, which starts a process.
MINE = """
import signal
import lcc_rl

def handlers(_=None):
    return [signal.getsignal(kind) for kind in (signal.SIGINT, signal.SIGTERM)]
"""
PROGRAM = """
import multiprocessing, signal
from mine import handlers

if __name__ == "__main__":
    assert handlers() == [signal.default_int_handler, signal.SIG_DFL], handlers()
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        assert pool.map(handlers, [0]) == [handlers()]
"""


@pytest.fixture(autouse=True)
def ctrl_c():
    """Hear SIGINT also where the tests were started in the background, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize("kind", slow_but(SENT[-1:], SENT))
def test_a_command_that_imports_yet_ends_with_one_line(kind) -> None:
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", IMPORTS], text=True, **pipes) as child:
        assert child.stdout.readline() == "on\n"
        child.send_signal(kind)
        _, errors = child.communicate(timeout=60)
    assert (child.returncode, errors) == (130, "lcc_rl: interrupted\n")


def test_a_command_that_imports_ends_without_a_stderr() -> None:
    deaf = IMPORTS.replace('print("on", flush=True), input()', DEAF)
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", deaf], text=True, **pipes) as child:
        assert child.stdout.readline() == "on\n"
        child.terminate()
        with suppress(BrokenPipeError):
            child.communicate("\n", timeout=60)
    assert child.returncode == 130


@pytest.mark.slow
def test_a_program_that_imports_the_package_keeps_its_handlers(tmp_path) -> None:
    (tmp_path / "mine").mkdir()
    for name, text in (("__init__", MINE), ("__main__", PROGRAM)):
        (tmp_path / "mine" / f"{name}.py").write_text(text)
    subprocess.run([sys.executable, "-m", "mine"], cwd=tmp_path, check=True, timeout=60)


def test_the_first_signal_asks_and_one_that_comes_later_acts(monkeypatch, capfd) -> None:
    for kind in SENT:
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL  # importing changes no handler
        with interruptible(), stop_signal() as stop:
            os.kill(os.getpid(), kind)
            assert stop.is_set()
            assert capfd.readouterr().err == "lcc_rl: stopping once this iteration is saved\n"
            os.kill(os.getpid(), kind)  # as a scheduler does, to this process and by its parent
            with monkeypatch.context() as later:
                later.setattr("lcc_rl.runs.interrupts.time.monotonic", lambda: math.inf)
                with pytest.raises(KeyboardInterrupt):
                    os.kill(os.getpid(), signal.SIGINT)
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_an_error_that_follows_from_an_interrupt_is_one(capsys) -> None:
    @main_guard
    def command() -> None:
        with suppress(KeyboardInterrupt):  # as a library may do that was in the midst of its work
            os.kill(os.getpid(), signal.SIGTERM)
        raise ConfigError("'NoneType' object has no attribute 'flags'")

    with pytest.raises(SystemExit) as end:
        command()
    assert end.value.code == 130
    assert capsys.readouterr().err == "lcc_rl: interrupted\n"


def test_a_closed_terminal_is_ignored_where_nohup_says_so() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with interruptible(), stop_signal() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert not stop.is_set()
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    training.run(tiny("train", *LONGER), folder, quiet=True)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*SENT, signal.SIGKILL])
def test_a_training_that_is_ended_resumes_to_the_same_rows(whole, tmp_path, kind) -> None:
    with start("train", *TINY, *LONGER, "hydra.run.dir=run", cwd=tmp_path) as child:
        wait_for(tmp_path / "run" / "checkpoint.pt", child)
        second = run_command("train", "resume=run", cwd=tmp_path)
        assert child.poll() is None
        child.send_signal(kind)
        _, errors = child.communicate(timeout=60)
    assert second.returncode == 2
    assert "another process is working on this run" in second.stderr
    assert child.returncode == (-kind if kind == signal.SIGKILL else 130)
    assert "Traceback" not in errors
    assert ("resume=" in errors) == (kind != signal.SIGKILL)
    assert not (tmp_path / "run" / "episodes.parquet").exists()
    run_command("train", "resume=run", cwd=tmp_path, check=True)
    assert_same_tables(whole, tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("send", [os.kill, os.killpg])
def test_an_interrupted_pipeline_starts_no_further_training(tmp_path, monkeypatch, send) -> None:
    words = [*TINY, QUICK, "training.episodes=400", "variants=[alcc,reference]", "jobs=1"]
    with start("run", *words, "hydra.run.dir=job", cwd=tmp_path) as process:
        wait_for(tmp_path / "job/alcc/checkpoint.pt", process)
        send(process.pid, signal.SIGINT)  # a terminal sends it to every process of the job
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "resume=" in errors
    assert not (tmp_path / "job/alcc/episodes.parquet").exists()
    assert not (tmp_path / "job/reference").exists()
    jobs_in_threads(monkeypatch)
    run_command("run", "resume=job", cwd=tmp_path, check=True)
    for name in ("alcc", "reference"):
        assert len(read_parquet(tmp_path / "job" / name / "training.parquet")) == 50
        assert f"train {name}: iteration 50/50" in (tmp_path / f"job/{name}/train.log").read_text()
    assert (tmp_path / "job/evaluation/figures/overview.png").exists()


def test_a_process_of_a_pool_ends_with_its_parent(monkeypatch) -> None:
    ended = threading.Event()
    monkeypatch.setattr(os, "_exit", lambda code: ended.set())
    for parent in (None, SimpleNamespace(pid=os.getpid())):  # the parent's pid is another one
        monkeypatch.setattr(multiprocessing, "parent_process", lambda parent=parent: parent)
        interrupts.end_with_parent.__wrapped__()
        assert ended.wait(5.0 if parent else 0.0) is (parent is not None)
