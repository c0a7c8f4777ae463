"""Shared fixtures: real data where this machine has them, and one thread for the tests."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from matplotlib.figure import Figure
from PIL import Image
from streams import driven_once

# Several test processes share a machine's cores; more threads each would only slow them down.
torch.set_num_threads(1)

DEFAULT_DATA = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session", autouse=True)
def work_that_all_tests_share() -> Iterator[None]:
    """Drive each synthetic stream once."""
    with driven_once():
        yield


def pytest_collection_finish() -> None:
    """Spare the collector of garbage what lives to the end: modules and thousands of tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 50)


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be made and saved, but not drawn: half of the time of an evaluation's test.

    Tests of results, and of a pipeline and a platoon as a whole, draw them.
    """

    def savefig(self: Figure, path: str | Path, **how: object) -> None:
        Image.new("RGB", (1, 1)).save(path, format="PNG")

    monkeypatch.setattr(Figure, "savefig", savefig)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real measurements: ``LCC_RL_DATA``, or ``../shared/data`` beside the checkout."""
    folder = Path(os.environ.get("LCC_RL_DATA", DEFAULT_DATA)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set LCC_RL_DATA to the folder that holds them")
    return folder
