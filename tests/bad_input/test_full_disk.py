"""Disks that are really full and folders that cannot be written: one line, nothing is lost."""

from __future__ import annotations

import itertools
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from commands import assert_same_tables, tiny

from lcc_rl.commands import training
from lcc_rl.config import load
from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import new_figure, save
from lcc_rl.figures.page import section, write_sections
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.runs import ORIGIN, save_config
from lcc_rl.runs.states import inspect_run


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Let the system refuse to write files beyond a size, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


NOISE = np.random.default_rng(0).normal(size=20_000)


def figure(path: Path) -> None:
    made = new_figure(6, 4)
    made.add_subplot().plot(NOISE)
    save(made, path)


def page(path: Path) -> None:
    write_sections(path.parent, "t", [section("h", "x" * 20_000)])


WRITERS: dict[str, Callable[[Path], object]] = {
    "a.pt": lambda path: write_torch({"w": torch.from_numpy(NOISE)}, path),
    "a.parquet": lambda path: write_parquet(pd.DataFrame({"x": NOISE}), path),
    "a.png": figure,
    "config.yaml": lambda path: save_config(
        replace(load("train"), variant="x" * 20_000), path.parent
    ),
    "report.html": page,
}


def test_a_writer_on_a_full_disk_names_the_file_and_keeps_the_former_one(tmp_path) -> None:
    for name, write in WRITERS.items():
        path = tmp_path / name
        path.write_bytes(b"former")
        with (
            files_of_at_most(9_000),
            pytest.raises(ResultsError, match=rf"{name}: cannot be written: .*[Ff]ile too large"),
        ):
            write(path)
        assert path.read_bytes() == b"former"
        assert {*tmp_path.iterdir()} - {tmp_path / ORIGIN} == {path}
        write(path)
        assert path.stat().st_size > 9_000, name
        path.unlink()


def test_only_regular_files_are_replaced(tmp_path) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for name in ("folder", "pipe"):
        with (
            pytest.raises(ResultsError, match=f"{name}: is no regular file"),
            atomic_path(tmp_path / name),
        ):
            pass


class Mishap:
    """A logger by which something happens to the folder after the third row."""

    act: Callable[[Path], object]

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[dict[str, float]], None]]:
        count = itertools.count(1)
        yield lambda row: Mishap.act(folder) if next(count) == 3 else None


def fill(folder: Path) -> None:
    resource.setrlimit(
        resource.RLIMIT_FSIZE, (20_000, resource.getrlimit(resource.RLIMIT_FSIZE)[1])
    )


def test_a_training_stopped_by_a_full_disk_resumes_as_if_it_never_was(tmp_path) -> None:
    words = ("variant=alcc", "training.episodes=32", "training.checkpoint_every=1")
    cfg = tiny("train", *words)
    training.run(cfg, tmp_path / "whole", quiet=True)
    stopped, Mishap.act = tmp_path / "stopped", fill
    logger = f"+logger={{_target_: {__name__}.Mishap}}"
    with (
        files_of_at_most(resource.RLIM_INFINITY),
        pytest.raises(ResultsError, match=r"checkpoint\.pt: cannot be written: .*too large"),
    ):
        training.run(tiny("train", *words, logger), stopped, quiet=True)
    assert read_torch(stopped / "checkpoint.pt")["iteration"] == 2
    assert not list(stopped.glob(".*.tmp"))
    assert "checkpoint.pt: cannot be written" in inspect_run(stopped).error
    training.run(cfg, stopped, quiet=True, resume=True)
    assert_same_tables(tmp_path / "whole", stopped)


def test_a_folder_that_is_removed_during_the_run_is_one_clear_error(tmp_path) -> None:
    Mishap.act = lambda folder: folder.rename(tmp_path / "elsewhere")
    words = ("training.checkpoint_every=1", f"+logger={{_target_: {__name__}.Mishap}}")
    with pytest.raises(ResultsError, match="the folder was removed during the run"):
        training.run(tiny("train", "variant=alcc", *words), tmp_path / "run", quiet=True)
    assert read_torch(tmp_path / "elsewhere" / "checkpoint.pt")["iteration"] == 2
