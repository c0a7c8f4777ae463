"""Speed profiles of leaders, read from trajectories."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from ngsim_text import cells, csv_text, native_text, pair

from lcc_rl.data.leaders import from_trajectories
from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, DataError

FOOT = 0.3048


def accelerating_leader() -> list[list[str]]:
    """A follower 7 for 20 s behind a leader 9 whose speed rises by 2 ft/s²."""
    follower = pair(range(201))[:201]
    leader = [cells(9, k, Local_Y=10.0 * k + 60, v_Vel=round(20 + 0.2 * k, 1)) for k in range(201)]
    return follower + leader


@pytest.mark.parametrize("text", [csv_text, native_text])
@pytest.mark.parametrize("step", [0.1, 0.2, 0.25])
def test_leaders_of_a_file_at_any_step(tmp_path: Path, text, step: float) -> None:
    path = tmp_path / "file.txt"
    path.write_text(text(accelerating_leader()))
    profiles = from_trajectories(path, step)
    assert isinstance(profiles, Profiles)
    assert (len(profiles), profiles.time_step) == (1, step)
    assert profiles.names == ("2005-04-13T22:58:55Z/9@0.0s",)
    time = step * np.arange(round(20 / step) + 1)
    expected = torch.tensor((20 + 2 * time) * FOOT, dtype=torch.float32)
    torch.testing.assert_close(profiles.record(0), expected, atol=1e-4, rtol=0)


def test_files_without_episodes_and_impossible_steps_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "file.csv"
    path.write_text(csv_text(pair()))  # 2 s, the default criteria need 15 s
    with pytest.raises(DataError, match=r"file\.csv: no episode is left .*'min_duration_s: 15'"):
        from_trajectories(path, 0.1)
    for step in (0.0, -0.1, float("nan"), float("inf")):
        with pytest.raises(ConfigError, match="time_step"):
            from_trajectories(path, step)
