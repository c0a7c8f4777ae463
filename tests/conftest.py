"""Shared fixtures: real data where this machine has them, and one thread for the tests."""

from __future__ import annotations

import os
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path

import pytest
import torch
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from matplotlib.figure import Figure
from PIL import Image

# Several test processes share a machine's cores; more threads each would only slow them down.
torch.set_num_threads(1)

DEFAULT_DATA = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session", autouse=True)
def configurations_are_parsed_once() -> Iterator[None]:
    """Keep what the package's yaml files hold: composing them anew is much of many a test."""
    Plugins.instance()  # registers the sources of configurations
    source = SourcesRegistry.instance().types["pkg"]
    parse = source.load_config
    known: dict[tuple[str, str], ConfigResult] = {}

    def load_config(self: ConfigSource, config_path: str) -> ConfigResult:
        key = self.path, config_path
        if key not in known:
            known[key] = parse(self, config_path)
        return deepcopy(known[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(source, "load_config", load_config)
        yield


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
