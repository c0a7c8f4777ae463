"""Sources as the commands use them: from Hydra configurations, with their reports."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from ngsim_text import START_MS, cells, csv_text, pair

import lcc_rl.conf
from lcc_rl.config import load
from lcc_rl.data.episodes import write_episodes
from lcc_rl.data.sources import EpisodesSource, NgsimSource, find_files
from lcc_rl.errors import DataError
from lcc_rl.nodes import build


def configured(name: str, *overrides: str) -> NgsimSource | EpisodesSource:
    return build(load("calibrate", [f"data={name}", *overrides]).data, "data")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.csv"
    path.write_text(csv_text(pair(range(200))))
    return path


def test_ngsim_configuration(file: Path) -> None:
    loaded = configured("ngsim", f"data.path={file}").load()
    assert len(loaded.episodes) == 200
    assert loaded.report[0] == f"read 400 rows from {file}; kept 400"
    assert "removed 0: min_duration_s: 15" in loaded.report
    assert "removed 0: max_gap_m: 120" in loaded.report
    assert loaded.report[-1].startswith("kept 1 episodes: 200 samples")


def test_criteria_can_be_overridden(file: Path) -> None:
    source = configured("ngsim", f"data.path={file}", "data.criteria.min_duration_s=30")
    with pytest.raises(DataError, match=r"a\.csv: no episode is left .*'min_duration_s: 30'"):
        source.load()


@pytest.mark.parametrize("kind", ["SavitzkyGolay,window_s:1.5", "ExponentialAverage,width_s:0.5"])
def test_smoothing_is_one_override(file: Path, kind: str) -> None:
    override = f"data.smoothing={{_target_:lcc_rl.data.smoothing.{kind}}}"
    loaded = configured("ngsim", f"data.path={file}", override).load()
    assert any(line.startswith(f"smoothed with {kind.split(',')[0]}") for line in loaded.report)
    assert override in Path(lcc_rl.conf.__path__[0], "data", "ngsim.yaml").read_text()


def test_lists_and_patterns(file: Path) -> None:
    other = file.with_name("b.csv.gz")
    later = csv_text(
        [
            cells(v, k, Global_Time=START_MS + 900_000 + 100 * k, Preceding=9 * (v == 7),
                  Local_Y=10.0 * k + 60 * (v == 9))
            for v in (7, 9)
            for k in range(160)
        ]
    )  # fmt: skip
    other.write_bytes(gzip.compress(later.encode()))
    for path in (f"data.path='{file.parent}/*.csv*'", f"data.path=['{file}','{other}']"):
        episodes = configured("ngsim", path).load().episodes
        assert episodes.groupby("episode").size().tolist() == [200, 160]
        assert episodes["recording"].nunique() == 2


def test_files_of_a_path(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv", "odd[1].csv"):
        (tmp_path / name).write_text("")
    (tmp_path / "folder.csv").mkdir()
    names = [str(tmp_path / name) for name in ("a.csv", "b.csv")]
    assert find_files(f"{tmp_path}/?.csv") == names
    assert find_files(tmp_path / "odd[1].csv") == [str(tmp_path / "odd[1].csv")]
    with pytest.raises(DataError, match="no file matches this pattern"):
        find_files(f"{tmp_path}/*.txt")
    with pytest.raises(DataError, match=r"a\.csv: is named twice"):
        find_files([f"{tmp_path}/?.csv", names[0]])


def test_episodes_configuration(file: Path, tmp_path: Path) -> None:
    table = NgsimSource(path=str(file)).load().episodes
    write_episodes(table, tmp_path / "pairs.parquet")
    loaded = configured("episodes", f"data.path={tmp_path / 'pairs.parquet'}").load()
    assert loaded.episodes.equals(table)
    assert loaded.report == [f"read 1 episodes, 200 rows, {tmp_path / 'pairs.parquet'}"]
