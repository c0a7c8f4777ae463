"""Calibration errors by length of the episodes: cutting, intervals over drivers, table, figure."""

from __future__ import annotations

from pathlib import Path

import compare_lengths
import numpy as np
import pandas as pd
import pytest
from compare_lengths import BASE, SECONDS

from lcc_rl.io.files import read_parquet

ROOT = Path(__file__).parents[2]
QUICK = [
    *("data.platoons=2", "data.vehicles=4", "data.recordings=1"),
    *("calibration.local_genetic.population=8", "calibration.local_genetic.generations=2"),
    *("calibration.global_genetic.population=8", "calibration.global_genetic.generations=2"),
]


def test_pieces_follow_each_other_and_share_the_sample_between() -> None:
    lengths = {7: 501, 8: 140}  # 50 s and 13.9 s
    episodes = pd.concat(
        pd.DataFrame({"episode": name, "time_s": 0.1 * np.arange(n) + 3.0})
        for name, n in lengths.items()
    )
    cut = compare_lengths.pieces(episodes, 15, 15).groupby("episode")["time_s"]
    assert cut.size().tolist() == [151, 151, 151]
    np.testing.assert_allclose(cut.first(), [3.0, 18.0, 33.0])
    np.testing.assert_allclose(cut.last(), [18.0, 33.0, 48.0])


def rows(**columns: list[float]) -> pd.DataFrame:
    """Local and global rows of four episodes, two of each driver."""
    known = {"recording": "one", "follower_id": [1, 1, 2, 2], "episode": range(4)}
    known |= {"desired_speed_mps": [10.0, 20.0, 30.0, 20.0], "time_gap_s": [1.0, 3.0, 3.0, 1.0]}
    parts = [pd.DataFrame({**known, "mode": x, "rmspe": columns[x]}) for x in ("local", "other")]
    return pd.concat(parts).replace({"mode": {"other": "global"}})


def test_intervals_are_over_drivers() -> None:
    # Both drivers' means are 8 and 6 %, whatever their single pieces.
    found = compare_lengths.compared(
        rows(local=[0.07, 0.09, 0.10, 0.06], other=[0.06, 0.06, 0.05, 0.07])
    )
    assert found["local"] == pytest.approx((8.0, 8.0, 8.0))
    assert found["difference"] == pytest.approx((2.0, 2.0, 2.0))
    # Deviations (−10, 0, 10, 0) and (−1, 1, 1, −1): 20/√(200 · 4).
    assert found["correlation"][0] == pytest.approx(0.5**0.5)


def test_the_page_shows_what_is_kept() -> None:
    kept = read_parquet(ROOT / compare_lengths.KEPT)
    page = (ROOT / "docs" / "notes" / "calibration.md").read_text()
    shown = [x for x in page.splitlines() if x.startswith(("| first", "| pieces", "| a, b"))]
    assert len(shown) >= 5
    assert set(shown) <= set(compare_lengths.table(kept).splitlines())
    figure = compare_lengths.figure_of_lengths(kept)
    drawn = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    for mode in ("local", "global"):
        pieces = [kept[kept["condition"] == f"pieces of {x} s"] for x in SECONDS]
        means = [100 * x[x["mode"] == mode]["rmspe"].mean() for x in pieces]
        np.testing.assert_allclose(drawn[mode], means, rtol=1e-5)


def test_rows_are_measured_kept_and_shown(tmp_path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(compare_lengths, "CONDITIONS", {BASE: []})
    path, image = tmp_path / "rows.parquet", tmp_path / "figure.png"
    where = ["--rows", str(path), "--figure", str(image)]
    assert compare_lengths.main([*QUICK, *where]) == 0
    measured = read_parquet(path)
    base = measured[measured["condition"] == BASE]
    assert set(base["mode"]) == {"local", "global"}
    assert (base["rmspe"] > 0).all()
    # The mean absolute error relative to the mean is at most the root mean square one's share.
    ratio = base["rms_speed_mps"] / base["mean_speed_mps"]
    assert (base["absolute"] <= base["rmspe"] * ratio * 1.001).all()
    assert image.stat().st_size > 10_000
    first = capsys.readouterr().out
    assert compare_lengths.main(where) == 0
    assert capsys.readouterr().out == first
