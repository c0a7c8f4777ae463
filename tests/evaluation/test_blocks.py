"""Evaluations in blocks: resumed, repeated, divided into shards, compiled, and read lazily."""

from __future__ import annotations

import math
import re
import shutil
from pathlib import Path

import pandas as pd
import pytest
from commands import NO_AGENT, run_command, tiny
from helpers import POPULATION, compose, network, slow_but, wavy_profiles

from lcc_rl import results
from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.config.nodes import Node
from lcc_rl.config.schemas import EvaluateConfig
from lcc_rl.envs import Inputs
from lcc_rl.errors import ResultsError
from lcc_rl.evaluation.comparison import BLOCKS, Store, mark_of
from lcc_rl.evaluation.episodes import Episodes, Plan, evaluate
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.figures import evaluation as figures
from lcc_rl.io.files import read_parquet, write_parquet

PROFILES = wavy_profiles().windows(100)
INPUTS = Inputs(PROFILES, PROFILES, POPULATION)
WORDS = ("variant=idm", "evaluation.baselines=[direct,human]", "evaluation.drivers=5")
BLOCK = "evaluation.batch_size=3"


def settings(*overrides: str) -> EvaluateConfig:
    return tiny("evaluate", *WORDS, *overrides, agent=False)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    evaluation.run(settings(BLOCK), folder, quiet=True)
    return folder


def same(one: Path, two: Path) -> None:
    for name in ("episodes", "steps"):
        tables = (read_parquet(folder / f"{name}.parquet") for folder in (one, two))
        pd.testing.assert_frame_equal(*tables, check_exact=True)


# -- the plan -------------------------------------------------------------------------------------


def test_blocks_hold_every_episode_once_and_shards_every_block_once(subtests) -> None:
    for batch, repeats in [(1, 1), (7, 3), (1000, 2)]:
        with subtests.test(batch=batch):
            plan = Plan(4, 249, 5, batch, repeats)
            seen = [
                tuple(int(part[place]) for part in plan.episodes(block))
                for block in plan.own
                for place in range(plan.count(block))
            ]
            assert len(seen) == len(set(seen)) == len(plan) == 20 * repeats
            assert plan.size <= batch
            assert all(0 < plan.count(block) <= plan.size for block in plan.own)
            shards = min(3, plan.blocks)
            parts = [Plan(4, 249, 5, batch, repeats, shards, shard).own for shard in range(shards)]
            assert [block for part in parts for block in part] == list(plan.own)
            assert all(parts)


# -- repeats --------------------------------------------------------------------------------------


def test_repeats_draw_other_noise_and_the_first_is_the_only_one_of_before() -> None:
    strategy = Strategy("idm", compose("idm", "scenario.horizon=100"))
    once, _ = evaluate(strategy, INPUTS, 5, 1000, 1)
    rows, steps = evaluate(strategy, INPUTS, 5, len(once), 1, 2, repeats=3)
    first = rows[rows["repeat"] == 0].drop(columns="repeat").reset_index(drop=True)
    pd.testing.assert_frame_equal(first, once, check_exact=True)
    energies = rows.pivot_table(
        index=["profile_id", "driver_id"], columns="repeat", values="hdv_energy_kj"
    )
    assert list(energies) == [0, 1, 2]
    assert energies.nunique(axis=1).eq(3).all()
    assert set(steps["repeat"]) == {0, 2}


# -- resuming -------------------------------------------------------------------------------------


def stop_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let Ctrl-C come after so many blocks."""
    put, done = Store.put, []

    def counted(self: Store, *arguments: object) -> None:
        if len(done) == count:
            raise KeyboardInterrupt
        put(self, *arguments)
        done.append(arguments)

    monkeypatch.setattr(Store, "put", counted)


@pytest.mark.parametrize("count", slow_but([5], [0, 5]))
def test_resuming_equals_never_having_stopped(whole, tmp_path, monkeypatch, count) -> None:
    folder = tmp_path / "run"
    with monkeypatch.context() as patched:
        stop_after(patched, count)
        with pytest.raises(KeyboardInterrupt):
            evaluation.run(settings(BLOCK), folder, quiet=True)
    assert not (folder / "episodes.parquet").exists()
    played = []
    play = Episodes.play
    monkeypatch.setattr(Episodes, "play", lambda self, b: played.append(b) or play(self, b))
    evaluation.run(tiny("evaluate", f"resume={folder}", agent=False), folder, quiet=True)
    assert len(played) == 12 - count
    same(folder, whole)
    assert not (folder / BLOCKS).exists()


def test_blocks_of_a_policy_whose_file_changed_are_played_again(tmp_path) -> None:
    settings = {"_target_": "lcc_rl.data.sources.EpisodesSource", "path": str(tmp_path / "a.csv")}
    strategy, marks = Strategy("own", compose("idm").with_(data=Node.of(settings, "data"))), set()
    for text in ("one", "two", "two"):
        (tmp_path / "a.csv").write_text(text)
        marks.add(mark_of(strategy))
    assert len(marks) == 2


def test_an_interrupted_command_names_the_one_that_goes_on(tmp_path, monkeypatch) -> None:
    text = "from lcc_rl.pieces import IDM\n\n\nclass Mine(IDM):\n    pass\n"
    (tmp_path / "mine.py").write_text(text)
    own = "scenario.controllers.automated._target_=mine.Mine"
    words = (*NO_AGENT, "variant=idm", own, "evaluation.drivers=2", "hydra.run.dir=run")  # a block
    with monkeypatch.context() as patched:
        stop_after(patched, 2)
        patched.syspath_prepend(tmp_path)
        done = run_command("evaluate", *words, cwd=tmp_path)
    assert done.returncode == 130
    assert re.search(
        r"stopped; resume with: lcc-rl evaluate resume=\S*run trust=\[mine\]$", done.stderr.strip()
    )


@pytest.mark.slow
def test_a_damaged_block_and_one_of_other_weights_are_played_again(
    whole, tmp_path, monkeypatch
) -> None:
    with monkeypatch.context() as patched:
        stop_after(patched, 6)
        with pytest.raises(KeyboardInterrupt):
            evaluation.run(settings(BLOCK), tmp_path, quiet=True)
    kept = sorted(path for path in (tmp_path / BLOCKS).iterdir() if "steps" not in path.name)
    assert len(kept) == 6
    kept[0].write_bytes(b"PAR1 half")
    write_parquet(read_parquet(kept[1]).assign(collided=True), kept[1], {"lcc_rl.block": "other"})
    evaluation.run(settings(BLOCK), tmp_path, quiet=True)
    same(tmp_path, whole)


def test_figures_that_were_cut_short_are_drawn_by_the_same_command(tmp_path, monkeypatch) -> None:
    def cut(*args: object, **named: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(figures, "save", cut)
    with pytest.raises(KeyboardInterrupt):
        evaluation.complete(settings(), tmp_path)
    before = (tmp_path / "episodes.parquet").stat().st_mtime_ns
    monkeypatch.undo()
    evaluation.complete(settings(), tmp_path)
    assert (tmp_path / "figures" / "overview.png").is_file()
    monkeypatch.setattr(figures, "save", cut)
    evaluation.complete(settings(), tmp_path)  # nothing is drawn twice, and nothing played
    assert (tmp_path / "episodes.parquet").stat().st_mtime_ns == before


# -- shards ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shards_are_one_table_and_a_missing_one_is_said(whole, tmp_path, caplog) -> None:
    words = [*WORDS, BLOCK, *NO_AGENT, "sweep=parts"]
    words += ["evaluation.shards=4", "evaluation.shard=range(4)"]
    run_command("evaluate", "-m", *words, cwd=tmp_path, check=True)
    root, order = tmp_path / "outputs/evaluate/parts", ["profile_id", "driver_id", "strategy"]
    rows, own = results.load(root, strict=True), read_parquet(whole / "episodes.parquet")
    kinds = own.dtypes.to_dict()  # text is categorical in a table of many runs
    one, two = (
        x[own.columns].astype(kinds).sort_values(order, ignore_index=True) for x in (rows, own)
    )
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    written = {path: path.stat().st_mtime_ns for path in root.glob("*/episodes.parquet")}
    gone = sorted(written)[2]
    number = int(gone.parent.name.split("=")[1].split("_")[0])
    shutil.rmtree(gone.parent)
    assert f"evaluation.shard={number}" in results.load(root).attrs["missing"][0]
    assert "1 of 4 shards of variant idm are missing" in caplog.text
    with pytest.raises(ResultsError, match=r"not finished: evaluation\.shard=2"):
        results.load(root, strict=True)
    # The same command plays what is missing and nothing else.
    run_command("evaluate", "-m", *words, cwd=tmp_path, check=True)
    again = {path: path.stat().st_mtime_ns for path in root.glob("*/episodes.parquet")}
    assert {path for path in again if again[path] == written.get(path)} == set(written) - {gone}
    assert len(results.load(root, strict=True)) == len(own)


# -- reading --------------------------------------------------------------------------------------


def test_a_dataset_is_the_same_table(whole, tmp_path) -> None:
    other = tmp_path / "other"
    shutil.copytree(whole, tmp_path / "one")
    evaluation.run(settings("evaluation.seed=5", "evaluation.baselines=[]"), other, quiet=True)
    frame, data = results.load(tmp_path), results.load(tmp_path, lazy=True)
    assert data.count_rows() == len(frame)
    found = data.to_table().to_pandas()
    assert found["run"].tolist() == frame["run"].tolist()
    assert found["evaluation.seed"].tolist() == frame["evaluation.seed"].tolist()
    assert "scenario.horizon" not in found  # the same in all runs
    energies = (x["total_energy_kj"].tolist() for x in (found, frame))
    assert all(a == b or (math.isnan(a) and math.isnan(b)) for a, b in zip(*energies, strict=True))
    field = type(data.schema.field("run").type).__name__
    assert field == "DictionaryType"


# -- compiled -------------------------------------------------------------------------------------

COMPILER = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its own making


@pytest.mark.slow
@COMPILER
def test_a_compiled_evaluation_differs_by_rounding() -> None:
    cfg = compose("alcc", "agent.hidden=[8]")
    strategy = Strategy("alcc", cfg, network(cfg), 0)
    inputs = Inputs(PROFILES, wavy_profiles().windows(20), POPULATION)
    tables = [evaluate(strategy, inputs, 3, 20, 1, 2, compiled=fast) for fast in (False, True)]
    for plain, fast in zip(*tables, strict=True):
        pd.testing.assert_frame_equal(fast, plain, rtol=1e-4, atol=1e-4)


@pytest.mark.usefixtures("blank_figures")
def test_time_series_are_thinned_to_the_largest_size_of_their_file(tmp_path, subtests) -> None:
    words = ["variant=cacc", "evaluation.full_length=false", "evaluation.baselines=[deadbeat]"]
    cacc = load("evaluate", words)
    for name, base, most in (("episodes", settings(BLOCK), 0.004), ("cases", cacc, 0.02)):
        with subtests.test(name):
            tables = {}
            for limit in (None, most):
                cfg = base.with_(evaluation={"sample_mb": limit})
                folder = tmp_path / f"{name}{limit}"
                evaluation.run(cfg, folder, quiet=True)
                tables[limit] = read_parquet(folder / "steps.parquet")
            assert (folder / "steps.parquet").stat().st_size < most * 1e6 + 20_000  # columns' heads
            all_steps, kept = tables[None], tables[most]
            assert (all_steps["time_s"] == all_steps["time_s"].round(3)).all()  # 0.3, not 0.30…04
            times = sorted(set(kept["time_s"]))
            step = cfg.scenario.time_step
            every = round((times[1] - times[0]) / step)
            assert every > 1
            number = (all_steps["time_s"] / step).round() - 1
            expected = all_steps[number % every == 0].reset_index(drop=True)
            pd.testing.assert_frame_equal(kept, expected, check_exact=True)
