"""Shared fixtures: runs that are made once, real data where this machine has them, one thread.

They import what they need: a process that only hands out tests to others loads no torch.
"""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

gc.disable()  # until all modules are loaded, see pytest_collection_finish

DEFAULT_DATA = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session", autouse=True)
def work_that_all_tests_share() -> Iterator[None]:
    """Drive each synthetic stream and compose each choice of files of conf/ once."""
    import torch
    from streams import composed_once, driven_once

    # Several test processes share a machine's cores; more threads would only slow them down.
    torch.set_num_threads(1)
    with driven_once(), composed_once():
        yield


@pytest.fixture(autouse=True)
def the_same_draws_in_any_order() -> None:
    """Begin torch's own generator anew: what a test draws does not depend on those before it."""
    import torch

    torch.manual_seed(0)


@pytest.fixture
def double() -> Iterator[None]:
    """Compute in double precision, in which ways and kernels differ by less than any fault."""
    import torch

    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def pytest_collection_finish() -> None:
    """Spare the collector of garbage what lives to the end: modules and thousands of tests."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)
    gc.enable()


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """Return a folder that the first process of the session that asks for it fills.

    Args:
        factory: of temporary folders of this process.
        name: of the folder.
        make: fills the folder, which does not exist yet.
    """
    root = factory.getbasetemp()
    root = root.parent if "PYTEST_XDIST_WORKER" in os.environ else root
    folder = root / "made_once" / name
    folder.parent.mkdir(exist_ok=True)
    with folder.with_suffix(".lock").open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        if not file.read():
            shutil.rmtree(folder, ignore_errors=True)
            make(folder)
            file.write("made")
    return folder


@pytest.fixture(scope="session")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny training of the variant alcc. Tests that change it copy it."""
    from commands import tiny

    from lcc_rl.commands import training

    cfg = tiny("train", "variant=alcc")
    return made_once(tmp_path_factory, "alcc", lambda to: training.run(cfg, to, quiet=True))


@pytest.fixture(scope="session")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What lcc-rl train leaves of the rule idm, tiny. Tests that change it copy it."""

    from commands import NO_AGENT, run_command

    def make(to: Path) -> None:
        words = ("variant=idm", *NO_AGENT, f"hydra.run.dir={to}")
        run_command("train", *words, cwd=to.parent, check=True)

    return made_once(tmp_path_factory, "idm", make)


@pytest.fixture
def blank_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let figures be made and saved, but not drawn: half of the time of an evaluation's test.

    Tests of results, and of a pipeline and a platoon as a whole, draw them.
    """

    from matplotlib.figure import Figure
    from PIL import Image

    def savefig(self: object, path: str | Path, **how: object) -> None:
        Image.new("RGB", (1, 1)).save(path, format="PNG")

    monkeypatch.setattr(Figure, "savefig", savefig)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real measurements: ``LCC_RL_DATA``, or ``../shared/data`` beside the checkout."""
    folder = Path(os.environ.get("LCC_RL_DATA", DEFAULT_DATA)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set LCC_RL_DATA to the folder that holds them")
    return folder
