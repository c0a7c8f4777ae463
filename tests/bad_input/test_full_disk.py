"""Disks that are really full, folders that cannot be written, and two processes in one folder."""

from __future__ import annotations

import os
import re
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from commands import (
    DATA,
    NO_AGENT,
    QUICK,
    TINY,
    assert_same_tables,
    jobs_in_threads,
    run_command,
    start,
    tiny,
    wait_for,
)

from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.config import load
from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import new_figure, save
from lcc_rl.figures.page import Page
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.runs import save_config
from lcc_rl.runs import progress
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.runs.states import claim, is_claimed

TRAIN = ("variant=alcc", *TINY)
COMMANDS = {
    "train": TRAIN,
    "evaluate": ("variant=idm", *NO_AGENT),
    "calibrate": (*DATA, QUICK),
    "pipeline": ("variants=[alcc]", *TINY),
}


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let the system refuse to write files beyond a size, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[None]:
    """Mount a file system in memory; skip the test where that is not allowed."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    try:
        subprocess.run(command, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("mounting is not allowed here")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def noise() -> np.ndarray:
    return np.random.default_rng(0).normal(size=20_000)


def figure(path: Path) -> None:
    made = new_figure(6, 4)
    made.add_subplot().plot(noise())
    save(made, path)


def page(path: Path) -> None:
    made = Page(path.parent)
    made.add("h", "x" * 20_000)
    made.write("t")


def text(path: Path) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text("x" * 20_000)


WRITERS: dict[str, Callable[[Path], object]] = {
    "a.pt": lambda path: write_torch({"w": torch.from_numpy(noise())}, path),
    "a.parquet": lambda path: write_parquet(pd.DataFrame({"x": noise()}), path),
    "a.png": figure,
    "error.txt": text,
    "config.yaml": lambda path: save_config(
        replace(load("train"), variant="x" * 20_000), path.parent
    ),
    "report.html": page,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_writer_on_a_full_disk_names_the_file_and_keeps_the_former_one(tmp_path, name) -> None:
    path = tmp_path / name
    path.write_bytes(b"former")
    with (
        files_of_at_most(9_000),
        pytest.raises(ResultsError, match=rf"{name}: cannot be written: .*[Ff]ile too large"),
    ):
        WRITERS[name](path)
    assert path.read_bytes() == b"former"
    assert list(tmp_path.iterdir()) == [path]
    WRITERS[name](path)
    assert path.stat().st_size > 9_000


def test_a_training_stopped_by_a_full_disk_resumes_as_if_it_never_was(
    tmp_path, monkeypatch
) -> None:
    cfg = tiny("train", "variant=alcc", "training.episodes=32")
    training.run(cfg, tmp_path / "whole", quiet=True)
    update = ProgressReporter.update

    def fill(self: ProgressReporter, done: int, *values: object) -> None:
        update(self, done, *values)
        if done == 3:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    monkeypatch.setattr(ProgressReporter, "update", fill)
    stopped = tmp_path / "stopped"
    try:
        with pytest.raises(ResultsError, match=r"checkpoint\.pt: cannot be written: .*too large"):
            training.run(cfg, stopped, quiet=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    monkeypatch.undo()
    assert read_torch(stopped / "checkpoint.pt")["iteration"] == 2
    assert not list(stopped.glob(".*.tmp"))
    assert "checkpoint.pt: cannot be written" in (stopped / "error.txt").read_text()
    training.run(cfg, stopped, quiet=True, resume=True)
    assert_same_tables(tmp_path / "whole", stopped)


@pytest.mark.parametrize("size", ["4k", "12k", "200k"])
def test_a_command_on_a_disk_without_space_ends_in_one_line(tmp_path, size) -> None:
    disk = tmp_path / "disk"
    with small_disk(disk, size):
        done = run_command(
            "lcc_rl.cli.train", *TRAIN, f"hydra.run.dir={disk / 'run'}", cwd=tmp_path
        )
        assert not list(disk.rglob("*.tmp"))
    lines = [line for line in done.stderr.splitlines() if "[INFO]" not in line]
    assert done.returncode == 2
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith(f"lcc_rl: error: {disk / 'run'}")
    assert lines[0].endswith("No space left on device")


# -- folders --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "place", "words"),
    [
        *((entry, "file", "Not a directory|File exists") for entry in COMMANDS),
        ("train", "file/run", "Not a directory"),
        ("train", "x" * 5000, "File name too long"),
        ("train", "/proc/run", "No such file|Permission|not permitted"),
    ],
)
def test_a_folder_that_cannot_be_made_is_one_line(tmp_path, entry, place, words) -> None:
    (tmp_path / "file").write_text("kept")
    module, target = f"lcc_rl.cli.{entry}", f"hydra.run.dir={place}"
    done = run_command(module, *COMMANDS[entry], target, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert re.search(words, done.stderr)
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_permission_is_one_line(tmp_path) -> None:
    tmp_path.chmod(0o500)
    done = run_command("lcc_rl.cli.train", *TRAIN, cwd=tmp_path)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert "Permission denied" in done.stderr


def test_a_folder_that_is_removed_during_the_run_is_one_clear_error(tmp_path, monkeypatch) -> None:
    folder, update = tmp_path / "run", ProgressReporter.update

    def remove(self: ProgressReporter, done: int, *values: object) -> None:
        if done == 2:
            folder.rename(tmp_path / "elsewhere")
        update(self, done, *values)

    monkeypatch.setattr(progress.ProgressReporter, "update", remove)
    with pytest.raises(ResultsError, match="the folder was removed during the run"):
        training.run(tiny("train", "variant=alcc"), folder, quiet=True)
    assert read_torch(tmp_path / "elsewhere" / "checkpoint.pt")["iteration"] == 1


# -- two processes --------------------------------------------------------------------------------


@pytest.mark.parametrize("entry", COMMANDS)
def test_the_second_process_in_a_folder_says_so_and_touches_nothing(
    tmp_path, entry, monkeypatch
) -> None:
    jobs_in_threads(monkeypatch)
    folder = tmp_path / "run"
    with claim(folder):
        before = sorted(folder.rglob("*"))
        target = f"hydra.run.dir={folder}"
        done = run_command(f"lcc_rl.cli.{entry}", *COMMANDS[entry], target, cwd=tmp_path)
        assert sorted(folder.rglob("*")) == before
    assert done.returncode == 2
    assert done.stderr == f"lcc_rl: error: {folder}: another process is working on this run\n"


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize(
    ("entry", "module"), [("evaluate", evaluation), ("calibrate", calibration)]
)
def test_a_folder_is_held_while_a_command_works_and_free_afterwards(
    tmp_path, entry, module, monkeypatch
) -> None:
    held = []

    def observed(cfg: Any, folder: Path) -> None:
        held.append(is_claimed(folder))
        save_config(cfg, folder)

    monkeypatch.setattr(module, "save_config", observed)
    target = f"hydra.run.dir={tmp_path / 'run'}"
    run_command(f"lcc_rl.cli.{entry}", *COMMANDS[entry], target, cwd=tmp_path, check=True)
    assert held == [True]
    assert not is_claimed(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_a_process_that_is_ended_leaves_a_folder_that_can_be_resumed(tmp_path, kind) -> None:
    words = (*TRAIN, "training.episodes=80000", f"hydra.run.dir={tmp_path / 'run'}")
    with start("lcc_rl.cli.train", *words, cwd=tmp_path) as child:
        wait_for(tmp_path / "run" / "checkpoint.pt", child)
        second = run_command("lcc_rl.cli.train", f"resume={tmp_path / 'run'}", cwd=tmp_path)
        assert child.poll() is None
        child.send_signal(kind)
        _, errors = child.communicate(timeout=60)
    assert second.returncode == 2
    assert "another process is working on this run" in second.stderr
    assert child.returncode == (-kind if kind == signal.SIGKILL else 130)
    assert "Traceback" not in errors
    with claim(tmp_path / "run"):
        assert read_torch(tmp_path / "run" / "checkpoint.pt")["iteration"] >= 1
