"""Shared fixtures: real data where this machine has them, and one thread for the tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

# Several test processes share a machine's cores; more threads each would only slow them down.
torch.set_num_threads(1)

DEFAULT_DATA = Path(__file__).resolve().parents[1] / "../shared/data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real measurements: ``LCC_RL_DATA``, or ``../shared/data`` beside the checkout."""
    folder = Path(os.environ.get("LCC_RL_DATA", DEFAULT_DATA)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no real data at {folder}; set LCC_RL_DATA to the folder that holds them")
    return folder
