"""A small ALCC study, run once for all tests of this file: runs, tables, page, and resuming."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from commands import UNTRAINED
from matplotlib.figure import Figure
from PIL import Image

from lcc_rl import config
from lcc_rl.commands import evaluation, reproduce, training
from lcc_rl.errors import LccError
from lcc_rl.io.files import read_parquet
from lcc_rl.studies import page, runner
from lcc_rl.studies.alcc import report
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.runner import FAILED, FINISHED, FOREIGN, Outcome, Run

pytestmark = [pytest.mark.xdist_group("small_study"), pytest.mark.slow]

SPEEDS = (0, 8)  # of the filter
MODULES = (training, evaluation, runner, alcc)
TINY = (
    "data.platoons=4",
    "data.recordings=2",
    "scenario.horizon=20",
    "evaluation.drivers=2",
    "training.episodes=8",
    "agent.batch_size=64",
    "agent.hidden=[16,16]",
    "calibration.local_genetic.generations=2",
    "calibration.global_genetic.generations=2",
)


START = runner._start


@cache
def composed(entry: str, overrides: tuple[str, ...]):
    return config.load(entry, list(overrides))


def load(entry: str, overrides: Sequence[str] = ()):
    """Compose every configuration once."""
    return composed(entry, tuple(overrides)).copy()


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


def sketch(figure: Figure, path: Path, dpi: int, formats: Sequence[str]) -> Path:
    """Write a tiny picture in the place of a figure."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", (1, 1)).save(path)
    return path


@pytest.fixture(scope="module", autouse=True)
def quick() -> Iterator[pytest.MonkeyPatch]:
    """Train in this process, two filters only, each configuration once, no figures saved."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(runner, "_start", in_this_process)
        patch.setattr(page, "save", sketch)
        for module in MODULES:
            if hasattr(module, "load"):
                patch.setattr(module, "load", load)
        for module in (alcc, report):
            patch.setattr(module, "FILTERS", SPEEDS)
        yield patch


@pytest.fixture(scope="module")
def study(quick, tmp_path_factory) -> alcc.Study:
    """Every part of the study; two seeds in the main one."""
    folder = tmp_path_factory.mktemp("alcc") / "a study, its folder"
    one = alcc.Study(folder, "smoke", 1, TINY, ablations=("late:agent.tau=0.01",), profiles=1)
    outcomes = alcc.run(one, ["ablations"])
    assert "late" in report.write_results(folder).read_text()  # a part alone has a page
    outcomes += alcc.run(one, ["single"])
    strings = replace(one, followers=(1, 2))
    outcomes += alcc.run(strings, ["followers"])
    two = replace(one, seeds=2)
    outcomes += alcc.run(two, ["main", "filter"], "typed")
    assert [outcome.status for outcome in outcomes] == [FINISHED] * (2 + 2 + 5 + 6)
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


def table(study: alcc.Study, name: str) -> pd.DataFrame:
    return read_parquet(study.folder / "tables" / f"{name}.parquet")


def test_strategies_and_seeds_of_the_evaluation(study) -> None:
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    counts = episodes.groupby("strategy")["training_seed"].nunique()
    learned = {"alcc": 2, "own_energy": 2, "reference": 2}
    assert counts.to_dict() == {**learned, **dict.fromkeys(UNTRAINED, 0)}


def test_table_of_the_filter(study) -> None:
    filtered = table(study, "filter")
    assert len(filtered) == 3 + 4 * len(SPEEDS)
    with_filter = filtered[filtered["filter"] == "full_speed_0"]
    assert set(with_filter["strategy"]) == {"alcc", "reference", "own_energy", "cbf"}
    assert not with_filter["total_energy_kj"].isin(filtered["total_energy_kj"][:3]).any()


def test_table_of_followers(study) -> None:
    more = table(study, "followers")
    assert more[["followers", "strategy"]].to_numpy().tolist() == [
        [number, name] for number in (1, 2) for name in ("alcc", "own_energy", "reference")
    ]
    assert not (study.folder / "followers" / "2" / "reference").exists()  # that of 1 is taken
    saved = more.set_index("strategy")["path_saving_against_own_energy_pct"]
    assert saved["alcc"].notna().all()
    assert saved["own_energy"].isna().all()


def test_the_single_profile_is_trained_on_and_evaluated(study) -> None:
    (folder,) = (study.folder / "single").iterdir()
    once = read_parquet(folder / "evaluation" / "episodes.parquet")
    assert once["profile_id"].nunique() == 1


def test_page_and_tables_have_every_part(study) -> None:
    assert set(table(study, "ablations")["ablation"]) == {report.ITSELF, "late"}
    tables = {path.stem for path in (study.folder / "tables").iterdir()}
    assert {"headline", "table_iv", "ablations", "single_profile", "learning"} <= tables
    html = (study.folder / "report.html").read_text()
    sections = ("Ablations", "Table IV", "One profile", "A filter", "More human drivers")
    for words in (*sections, "late", "seed_1", "Configuration", "typed"):
        assert words in html, words


def test_finished_runs_are_skipped(study) -> None:
    before = {p: p.stat().st_mtime_ns for p in study.folder.rglob("*.parquet")}
    parts = [(study, ["main", "filter"]), (replace(study, seeds=1), ["ablations", "single"])]
    strings = replace(study, seeds=1, followers=(1, 2))
    for settings, names in (*parts, (strings, ["followers"])):
        assert {outcome.status for outcome in alcc.run(settings, names)} == {FINISHED}
    assert before == {p: p.stat().st_mtime_ns for p in study.folder.rglob("*.parquet")}


def test_the_page_needs_the_parquet_files_only(copied) -> None:
    tables = {p.name: read_parquet(p) for p in (copied.folder / "tables").iterdir()}
    for path in (*copied.folder.rglob("*.pt"), *(copied.folder / "tables").iterdir()):
        path.unlink()
    report.write_results(copied.folder)
    for name, frame in tables.items():
        again = read_parquet(copied.folder / "tables" / name)
        pd.testing.assert_frame_equal(frame, again, check_exact=True)


def test_foreign_and_broken_runs_do_not_stop_the_others(copied) -> None:
    study = copied
    train_folder = study.folder / "train"
    broken, other = train_folder / "alcc" / "seed_0", train_folder / "alcc" / "seed_1"
    (broken / "episodes.parquet").unlink()
    (broken / "training.parquet").unlink()  # its hash is that of the folder it was copied from
    (broken / "checkpoint.pt").write_bytes(b"no checkpoint")
    text = (other / "config.yaml").read_text()
    (other / "config.yaml").write_text(text.replace("tau: 0.005", "tau: 0.5"))
    outcomes = {outcome.run.folder: outcome for outcome in alcc.run(study, ["main"])}
    assert outcomes[broken].status == FAILED
    assert "checkpoint.pt" in outcomes[broken].note
    assert outcomes[other].status == FOREIGN
    assert outcomes[other].note == "agent.tau: 0.5 → 0.005"
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
    assert set(episodes["strategy"]) == {*UNTRAINED, "reference", "own_energy"}
    report.write_results(study.folder)  # without alcc, some sections are left out
    problems = json.loads((study.folder / runner.NOTES).read_text())["problems"]
    assert set(problems) == {"train/alcc/seed_0", "train/alcc/seed_1"}
    # Accepted, the same run counts as finished; the broken one is made anew.
    (broken / "checkpoint.pt").unlink()
    accepting = replace(study, accept=("agent",))
    assert {outcome.status for outcome in alcc.run(accepting, ["main"])} == {FINISHED}
    assert json.loads((study.folder / runner.NOTES).read_text())["problems"] == {}
    episodes = read_parquet(study.folder / "evaluation" / "episodes.parquet")
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
    (study.folder / "report.html").unlink()
    assert reproduce.main(["report", str(study.folder)]) == 0
    assert "Table IV" in (study.folder / "report.html").read_text()
