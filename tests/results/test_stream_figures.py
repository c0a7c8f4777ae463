"""The figure of two sets of leaders is drawn whole or not at all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lcc_rl.errors import ConfigError
from lcc_rl.figures.leaders import figure_leaders, save_leaders


def episodes(shift: float) -> pd.DataFrame:
    time = 0.1 * np.arange(400)
    parts = [
        pd.DataFrame(
            {
                "episode": number,
                "time_s": time,
                "leader_speed_mps": 5 + shift + 3 * np.sin(time / (1 + number)),
            }
        )
        for number in range(3)
    ]
    return pd.concat(parts, ignore_index=True)


def test_labels_tell_units_and_sample_sizes() -> None:
    figure = figure_leaders({"real": episodes(0.0), "stream": episodes(1.0)})
    axes = figure.get_axes()
    assert [one.get_xlabel() for one in axes[:3]] == [
        "leader speed [m/s]",
        "leader acceleration [m/s²]",
        "leader energy in 30 s [kJ]",
    ]
    text = [entry.get_text() for entry in axes[0].get_legend().get_texts()]
    assert text == ["real, 1,200 samples", "stream, 1,200 samples"]
    assert axes[3].get_title() == "real: 3 of 3 leaders"


def test_a_figure_is_written_and_nothing_else(tmp_path: Path) -> None:
    save_leaders({"real": episodes(0.0), "stream": episodes(1.0)}, tmp_path / "new" / "a.png")
    assert (tmp_path / "new" / "a.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["a.png"]


def test_what_cannot_be_drawn_is_told(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="two sets"):
        figure_leaders({"real": episodes(0.0)})
    with pytest.raises(ConfigError, match=r"ending must be one of.*png"):
        save_leaders({"real": episodes(0.0), "stream": episodes(1.0)}, tmp_path / "a.nonsense")
    assert not list(tmp_path.iterdir())
