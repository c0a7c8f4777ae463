"""A small ALCC study, run once for all tests of this file: runs, tables, page, and resuming."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace

import pandas as pd
import pytest
from commands import UNTRAINED

from lcc_rl.commands import training
from lcc_rl.errors import LccError, ResultsError
from lcc_rl.io.files import read_parquet
from lcc_rl.studies import reproduce, runner
from lcc_rl.studies.alcc import report
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.runner import FAILED, FINISHED, FOREIGN, Outcome, Run

pytestmark = [pytest.mark.xdist_group("small_study"), pytest.mark.slow]

TINY = (
    *("data.platoons=4", "data.recordings=2", "scenario.horizon=20", "evaluation.drivers=2"),
    *("training.episodes=8", "agent.batch_size=64", "agent.hidden=[16,16]"),
    *(f"calibration.{x}_genetic.generations=2" for x in ("local", "global")),
)
START = runner._start


def in_this_process(runs: Sequence[Run], jobs: int) -> list[Outcome]:
    """Train here instead of in processes of their own, which start for seconds."""
    outcomes = []
    for run in runs:
        cfg = run.compose()
        if (run.folder / "checkpoint.pt").exists():
            cfg.resume = str(run.folder)
        try:
            training.run(cfg, run.folder, quiet=True)
            outcomes.append(Outcome(run, FINISHED))
        except LccError as error:
            outcomes.append(Outcome(run, FAILED, str(error)))
    return outcomes


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[None]:
    """Train in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_start", in_this_process)
        yield


@pytest.fixture(scope="module")
def study(quick, tmp_path_factory) -> alcc.Study:
    """Every part of the study; two seeds in the main one."""
    folder = tmp_path_factory.mktemp("alcc") / "a study, its folder"
    one = alcc.Study(folder, "smoke", 1, TINY, ablations=("late:agent.tau=0.01",))
    outcomes = alcc.run(one, ["ablations"])
    assert "late" in report.write_results(folder).read_text()  # a part alone has a page
    with pytest.raises(ResultsError, match="main part"):
        report.write_results(folder, target=folder / "page.md")
    two = replace(one, seeds=2)
    outcomes += alcc.run(two, ["main"], "typed")
    assert [outcome.status for outcome in outcomes] == [FINISHED] * (2 + 6)
    report.write_results(folder)
    return two


@pytest.fixture
def copied(study, tmp_path) -> alcc.Study:
    """A copy of the study in a folder of its own."""
    folder = tmp_path / "copy"
    shutil.copytree(study.folder, folder)
    for path in (*folder.rglob("config.yaml"), folder / "study.json"):
        path.write_text(path.read_text().replace(str(study.folder), str(folder)))
    return replace(study, folder=folder)


def test_every_part_is_evaluated_and_on_the_page(study) -> None:
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    counts = episodes.groupby("strategy")["training_seed"].nunique()
    learned = {"alcc": 2, "own_energy": 2, "reference": 2}
    assert counts.to_dict() == {**learned, **dict.fromkeys(UNTRAINED, 0)}
    tables = {p.stem: read_parquet(p) for p in (study.folder / "tables").iterdir()}
    assert set(tables["ablations"]["ablation"]) == {report.ITSELF, "late"}
    html = (study.folder / "report.html").read_text()
    for words in (
        "Table IV",
        "late",
        "seed_1",
        "Configuration",
        "typed",
    ):
        assert words in html, words


def test_finished_runs_are_skipped_and_the_page_needs_the_parquet_files_only(copied) -> None:
    before = {p: p.stat().st_mtime_ns for p in copied.folder.rglob("episodes.parquet")}
    assert {outcome.status for outcome in alcc.run(copied, ["main"])} == {FINISHED}
    assert before == {p: p.stat().st_mtime_ns for p in copied.folder.rglob("episodes.parquet")}
    tables = {p: read_parquet(p) for p in (copied.folder / "tables").iterdir()}
    for path in (*copied.folder.rglob("*.pt"), *tables):
        path.unlink()
    (copied.folder / "ablations" / "stopped" / "evaluation").mkdir(parents=True)  # left out
    report.write_results(copied.folder)
    for path, frame in tables.items():
        pd.testing.assert_frame_equal(frame, read_parquet(path), check_exact=True)


def test_foreign_and_broken_runs_do_not_stop_the_others(copied) -> None:
    broken, other = (copied.folder / "train" / "alcc" / f"seed_{n}" for n in (0, 1))
    (broken / "episodes.parquet").unlink()
    (broken / "training.parquet").unlink()  # its hash is that of the folder it was copied from
    (broken / "checkpoint.pt").write_bytes(b"no checkpoint")
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("tau: 0.005", "tau: 0.5"))
    outcomes = {outcome.run.folder: outcome for outcome in alcc.run(copied, ["main"])}
    assert outcomes[broken].status == FAILED
    assert "checkpoint.pt" in outcomes[broken].note
    assert (outcomes[other].status, outcomes[other].note) == (FOREIGN, "agent.tau: 0.5 → 0.005")
    report.write_results(copied.folder)  # without alcc, some sections are left out
    problems = json.loads((copied.folder / runner.NOTES).read_text())["problems"]
    assert set(problems) == {"train/alcc/seed_0", "train/alcc/seed_1"}
    # Accepted, the same run counts as finished; the broken one is made anew.
    (broken / "checkpoint.pt").unlink()
    accepting = replace(copied, accept=("agent",))
    assert {outcome.status for outcome in alcc.run(accepting, ["main"])} == {FINISHED}
    assert json.loads((copied.folder / runner.NOTES).read_text())["problems"] == {}
    episodes = read_parquet(copied.folder / "evaluation" / "episodes.parquet")
    assert set(episodes["strategy"]) == {*UNTRAINED, "reference", "own_energy", "alcc"}


def test_the_command_resumes_a_training_in_a_process_of_its_own(study, monkeypatch, caplog) -> None:
    caplog.set_level("INFO")
    monkeypatch.setattr(runner, "_start", START)
    folder = study.folder / "train" / "alcc" / "seed_0"
    (folder / "episodes.parquet").unlink()
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    words = ["alcc", "--out", str(study.folder), "--recipe", "smoke", "--seeds", "2"]
    assert reproduce.main([*words, "--parts", "main", *TINY]) == 0
    assert "6 runs: 1 to do, 5 finished before" in caplog.text
    assert f"{folder}: resumed" in caplog.text
    again = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    pd.testing.assert_frame_equal(again, episodes, check_exact=True)
