"""Tables and figures of the platoon from small tables with known values."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch
from matplotlib.colors import to_rgb

from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.cases import measure
from lcc_rl.figures.platoon import PARENTS, switching
from lcc_rl.results.string_tables import case_table
from lcc_rl.studies.hcfs.tables import win_rates


def series() -> dict[str, torch.Tensor]:
    """Two followers, one run, three frames."""
    shape = (3, 1, 2)
    error = torch.tensor([[1.0, 0.5], [-1.0, 0.5], [2.0, -0.5]]).view(shape)
    return {
        "leader_speed_error": error,
        "gap_error": torch.tensor([[0.0, -1.0], [-2.0, 0.5], [-1.0, -5.1]]).view(shape),
        "speed_error": torch.tensor([[1.0, 2.0], [1.0, 0.0], [0.0, 0.0]]).view(shape),
        "jerk": torch.tensor([[4.0, 0.0], [-6.0, 1.0], [0.0, 0.0]]).view(shape),
        "reward": -error.abs(),
        "gap": torch.tensor([[5.0, 4.0], [3.0, 4.0], [4.0, -0.1]]).view(shape),
        "winner": torch.tensor([[0, 1], [1, 1], [1, 1]]).view(shape),
        "switches": torch.tensor([[0, 0], [1, 0], [1, 0]]).view(shape),
        "clamps": torch.zeros(shape, dtype=torch.int64),
        "cap_interventions": torch.zeros(shape, dtype=torch.int64),
    }


def test_measures_by_hand() -> None:
    first, second = measure(series()).to_dict("records")
    assert (first["speed_error_sum"], second["speed_error_sum"]) == (4.0, 1.5)
    assert (first["jerk_sum"], first["peak_jerk_mps3"]) == (10.0, 6.0)
    assert (first["min_gap_m"], first["collided"], second["collided"]) == (3.0, False, True)
    assert (first["max_gap_error_m"], second["max_gap_error_m"]) == (2.0, pytest.approx(5.1))
    assert pd.isna(first["energy_ratio"])
    assert second["energy_ratio"] == pytest.approx(4.0 / 2.0)
    assert first["learned_share"] == pytest.approx(2 / 3)
    assert (first["switches"], second["switches"], first["frames"]) == (1, 0, 3)


def test_only_automated_vehicles_have_a_gap_to_keep() -> None:
    given = series()
    given["reward"][..., 1] = torch.nan  # driven by a human, who earns nothing
    first, second = measure(given).to_dict("records")
    assert first["max_gap_error_m"] == 2.0
    assert pd.isna(second["max_gap_error_m"])


def test_case_table_by_hand() -> None:
    rows = measure(series()).assign(
        strategy="hcfs", training_seed=pd.Series([0, 0], dtype="Int64"), case="case 1", profile="a"
    )
    (row,) = case_table(rows, "case 1").to_dict("records")
    errors = pd.Series([1.0, 1.0, 2.0, 0.5, 0.5, 0.5])
    assert row["speed_error_sum_mps"] == pytest.approx(5.5)
    assert row["speed_error_std_mps"] == pytest.approx(errors.std(ddof=0))
    assert row["reward"] == pytest.approx(-5.5)
    assert (row["collisions"], row["switches"]) == (1, 1)
    assert (row["max_gap_error_m"], row["string_ratio"]) == (pytest.approx(5.1), pytest.approx(2.0))
    assert row["learned_share"] == pytest.approx(5 / 6)
    with pytest.raises(ConfigError, match="case 9"):
        case_table(rows, "case 9")


def rewards(strategy: str, seed: int | None, *values: float) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "strategy": strategy,
            "training_seed": pd.Series([seed] * len(values), dtype="Int64"),
            "case": "windows",
            "profile": [f"w{i}" for i in range(len(values))],
            "reward": values,
        }
    )


def test_win_rates_by_hand() -> None:
    episodes = pd.concat(
        [
            rewards("cacc", None, -2.0, -2.0, -2.0, -2.0),
            rewards("ddpg", 0, -1.0, -3.0, -1.0, -1.0),
            rewards("ddpg", 1, -4.0, -4.0, -4.0, -4.0),
            rewards("hcfs", 0, -1.0, -1.0, -3.0, -2.0),
            rewards("hcfs", 1, -1.0, -1.0, -1.0, -1.0),
        ],
        ignore_index=True,
    )
    table = win_rates(episodes).set_index("against")
    # Against cacc: seed 0 wins 2, loses 1, ties 1 → 62.5 %; seed 1 wins all.
    assert table.loc["cacc", "wins_pct"] == pytest.approx((62.5 + 100.0) / 2)
    assert table.loc["cacc", "reward_gain"] == pytest.approx((0.25 + 1.0) / 2)
    # Against its own parent, seed by seed: 1 win, 2 losses, 1 tie; then 4 wins.
    assert table.loc["ddpg", "wins_pct"] == pytest.approx((37.5 + 100.0) / 2)
    assert table.loc["ddpg", "windows"] == 4


def test_switching_has_the_colour_of_the_controller_that_drives() -> None:
    winners = np.array([[0, 0, 1, 1], [1, 0, 0, 0], [0, 1, 0, 1]])  # follower × time
    rows = [
        {"strategy": "hcfs", "case": "case 1", "follower": f + 1, "time_s": 0.2 * (t + 1)}
        | {"winner": float(winners[f, t])}
        for f in range(3)
        for t in range(4)
    ]
    figure = switching(pd.DataFrame(rows), "case 1")
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0
    colours = np.array([to_rgb(colour) for colour in PARENTS.values()])
    centres = [(0.2 * t + 0.1, f + 1) for f in range(3) for t in range(4)]
    places = figure.axes[0].transData.transform(centres).astype(int)
    drawn = np.array([pixels[len(pixels) - y, x] for x, y in places])
    np.testing.assert_allclose(drawn, colours[winners.ravel()], atol=1 / 255)
