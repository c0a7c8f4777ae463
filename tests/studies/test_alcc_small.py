"""A small ALCC study by its command: runs, tables, figures, and resuming."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest
from commands import UNTRAINED, jobs_in_threads

from lcc_rl.errors import ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.studies import reproduce
from lcc_rl.studies.alcc.study import ITSELF, study_results

pytestmark = [pytest.mark.xdist_group("small_study"), pytest.mark.slow]

TINY = (
    *("data.platoons=4", "data.recordings=2", "scenario.horizon=20", "evaluation.drivers=2"),
    *("training.episodes=8", "agent.batch_size=64", "agent.hidden=[16,16]"),
    *(f"calibration.{x}_genetic.generations=2" for x in ("local", "global")),
)


def reproduced(folder: Path, *words: str) -> None:
    options = ["--out", str(folder), "--recipe", "smoke", "--ablations", "late:agent.tau=0.01"]
    assert reproduce.main(["alcc", *options, *words, *TINY]) == 0


def test_a_study_resumes_grows_and_needs_its_parquet_files_only(tmp_path, monkeypatch) -> None:
    jobs_in_threads(monkeypatch)
    folder = tmp_path / "a study, its folder"
    with pytest.raises(ResultsError, match="no evaluation"):
        study_results(folder)
    reproduced(folder, "--seeds", "1", "--parts", "ablations")
    assert "late" in (folder / "results.md").read_text()  # a part alone has results
    reproduced(folder, "--seeds", "2", "--parts", "main")
    episodes = read_parquet(folder / "evaluation" / "episodes.parquet")
    counts = episodes.groupby("strategy")["training_seed"].nunique()
    learned = {"alcc": 2, "own_energy": 2, "reference": 2}
    assert counts.to_dict() == {**learned, **dict.fromkeys(UNTRAINED, 0)}
    tables = {path: read_parquet(path) for path in (folder / "tables").iterdir()}
    assert set(tables[folder / "tables" / "ablations.parquet"]["ablation"]) == {ITSELF, "late"}
    assert "Table IV" in (folder / "results.md").read_text()
    # A training that was killed before its evaluation is resumed, the others are left alone.
    (folder / "train" / "alcc" / "seed_0" / "episodes.parquet").unlink()
    kept = [x for x in folder.rglob("episodes.parquet") if "train" in x.parts]
    times = {path: path.stat().st_mtime_ns for path in kept}
    reproduced(folder, "--seeds", "2", "--parts", "main")
    assert times == {path: path.stat().st_mtime_ns for path in kept}
    again = read_parquet(folder / "evaluation" / "episodes.parquet")
    pd.testing.assert_frame_equal(again, episodes, check_exact=True)
    for path in (*folder.rglob("*.pt"), *tables):
        path.unlink()
    study_results(folder)
    for path, frame in tables.items():
        pd.testing.assert_frame_equal(frame, read_parquet(path), check_exact=True)
