"""The command as a user types it: once through, again without work, and refused in one line."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from lcc_rl.io.files import read_parquet

SCRIPT = Path(__file__).resolve().parents[2] / "tools" / "reproduce.py"
TINY = (
    *("--recipe", "smoke", "--seeds", "1", "--parts", "main"),
    "data.platoons=4",
    "data.recordings=2",
    "scenario.horizon=40",
    "agent.batch_size=64",
    "agent.hidden=[16,16]",
)


@pytest.fixture(scope="module")
def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("reproduce", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def reproduce(*words: str, cwd: Path) -> str:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), *words],
        cwd=cwd,
        capture_output=True,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


def test_from_data_to_page_and_on_from_where_it_stopped(tool, tmp_path, monkeypatch) -> None:
    reproduce("alcc", "--out", "study", *TINY, cwd=tmp_path)
    study = tmp_path / "study"
    assert "Table IV" in (study / "report.html").read_text()
    episodes = read_parquet(study / "evaluation" / "episodes.parquet")
    # One training lost its end: it goes on from its checkpoint, the other is skipped.
    (study / "train" / "alcc" / "seed_0" / "episodes.parquet").unlink()
    said = reproduce("alcc", "--out", "study", *TINY, cwd=tmp_path)
    assert "3 runs: 1 to do, 2 finished before" in said
    assert "study/train/alcc/seed_0: going on" in said
    assert read_parquet(study / "evaluation" / "episodes.parquet").equals(episodes)
    (study / "report.html").unlink()
    monkeypatch.chdir(tmp_path)
    assert tool.main(["report", "study"]) == 0
    assert (study / "report.html").exists()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["alcc", "--recipe", "smok"], "smok"),
        (["alcc", "--parts", "mian"], "Did you mean 'main'?"),
        (["alcc", "data"], "expected overrides"),
        (["alcc", "seed=3"], "say --seeds"),
        (["report", "nowhere"], "no evaluation/episodes.parquet"),
    ],
)
def test_bad_input_is_one_line(tool, tmp_path, monkeypatch, capsys, words, expected) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        tool.main_guard(tool.main)(words)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert expected in said
    assert len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("words", "recipe"),
    [
        ([], "paper_alcc"),
        (["agent=analytic"], None),
        (["agent.gamma=0.9"], "paper_alcc"),
        (["agent=td3", "--recipe", "quickstart"], "quickstart"),
    ],
)
def test_another_agent_comes_with_its_own_length(
    tool, tmp_path, monkeypatch, words, recipe
) -> None:
    class SeenError(Exception):
        pass

    def run(study, parts, command):
        raise SeenError(study.recipe, study.runs(study.folder)[0].compose().training.episodes)

    monkeypatch.setattr(tool.alcc, "run", run)
    with pytest.raises(SeenError) as seen:
        tool.main(["alcc", "--out", str(tmp_path), *words])
    lengths = {None: 30720, "paper_alcc": 3000, "quickstart": 1500}
    assert seen.value.args == (recipe, lengths[recipe])
