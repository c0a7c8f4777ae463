"""Evaluations in blocks: resumed, repeated, divided into shards, compiled, and read lazily."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch
from commands import run_command, tiny
from helpers import ACTION, POPULATION, compose, network, slow_but, wavy_profiles

from lcc_rl import results
from lcc_rl.commands import evaluation
from lcc_rl.envs import Inputs, build_env
from lcc_rl.errors import ConfigError, Diverged, Interrupted, ResultsError
from lcc_rl.evaluation.blocks import BLOCKS, Store
from lcc_rl.evaluation.episodes import Episodes, Plan, evaluate
from lcc_rl.evaluation.rollout import Player, reset_options
from lcc_rl.evaluation.strategies import Strategy, baseline
from lcc_rl.io.files import as_dataset, read_parquet, write_parquet
from lcc_rl.results.tables import leader_too_fast, summary
from lcc_rl.schemas import EvaluateConfig

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


@pytest.mark.parametrize(("batch", "repeats"), [(1, 1), (3, 2), (7, 1), (8, 3), (1000, 2)])
def test_blocks_hold_every_episode_once_and_shards_every_block_once(batch, repeats) -> None:
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


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["evaluation.shards=3", "evaluation.shard=3"], r"shard must lie from 0 to .* = 2, got 3"),
        (["evaluation.shards=3"], "shards=3: the 10 episodes are 1 blocks of up to .*=8192"),
        (["evaluation.repeats=1000000000"], r"evaluation.repeats must be a whole number from 1 to"),
        (
            ["evaluation.repeats=1000000", "evaluation.profiles=1000", "evaluation.drivers=null"],
            "a run has at most 1000000000: divide them, evaluation.shards=",
        ),
    ],
)
def test_what_cannot_be_divided_is_refused(tmp_path, words, message) -> None:
    with pytest.raises(ConfigError, match=message):
        evaluation.run(settings(*words), tmp_path, quiet=True)
    assert not (tmp_path / "episodes.parquet").exists()


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


def test_noise_is_that_of_profile_driver_and_repeat() -> None:
    env = build_env(compose("idm"), PROFILES, POPULATION, 4)
    ids = torch.tensor([0, 0, 1, 0]), torch.tensor([0, 0, 0, 1]), torch.tensor([0, 1, 1, 1])
    seeds = reset_options(env, *ids[:2], 1, 249, ids[2])["episode", "seed"].flatten().tolist()
    assert len(set(seeds)) == 4
    plain = reset_options(env, *ids[:2], 1, 249)["episode", "seed"].flatten().tolist()
    assert plain[0] == seeds[0]


# -- resuming -------------------------------------------------------------------------------------


def test_blocks_are_rows_of_one_table(whole, tmp_path) -> None:
    assert not (whole / BLOCKS).exists()
    rows = read_parquet(whole / "episodes.parquet")
    at_once = evaluation.run(settings(), tmp_path, quiet=True)
    order = ["strategy", "profile_id", "driver_id"]
    one, two = (x.sort_values(order, ignore_index=True) for x in (rows, at_once))
    pd.testing.assert_frame_equal(one, two, rtol=1e-5, atol=1e-5)
    # A block holds the same episodes of every strategy, side by side.
    file = as_dataset([whole / "episodes.parquet"])
    groups = [x for part in file.get_fragments() for x in part.split_by_row_group()]
    assert len(groups) == 4
    first = groups[0].to_table().to_pandas()
    assert first["strategy"].value_counts().eq(3).all()
    assert first["strategy"].nunique() == 3


def stop_after(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let Ctrl-C come after so many blocks."""
    put, done = Store.put, []

    def counted(self: Store, *arguments: object) -> None:
        if len(done) == count:
            raise KeyboardInterrupt
        put(self, *arguments)
        done.append(arguments)

    monkeypatch.setattr(Store, "put", counted)


@pytest.mark.parametrize("count", slow_but([5], [0, 1, 5, 11]))
def test_resuming_equals_never_having_stopped(whole, tmp_path, monkeypatch, count) -> None:
    folder = tmp_path / "run"
    with monkeypatch.context() as patched:
        stop_after(patched, count)
        with pytest.raises(Interrupted, match=f"resume={folder}"):
            evaluation.run(settings(BLOCK), folder, quiet=True)
    assert not (folder / "episodes.parquet").exists()
    played = []
    play = Episodes.play
    monkeypatch.setattr(Episodes, "play", lambda self, b: played.append(b) or play(self, b))
    evaluation.run(tiny("evaluate", f"resume={folder}", agent=False), folder, quiet=True)
    assert len(played) == 12 - count
    same(folder, whole)
    assert not (folder / BLOCKS).exists()


@pytest.mark.slow
def test_a_damaged_block_and_one_of_other_weights_are_played_again(
    whole, tmp_path, monkeypatch
) -> None:
    with monkeypatch.context() as patched:
        stop_after(patched, 6)
        with pytest.raises(Interrupted):
            evaluation.run(settings(BLOCK), tmp_path, quiet=True)
    kept = sorted(path for path in (tmp_path / BLOCKS).iterdir() if "steps" not in path.name)
    assert len(kept) == 6
    kept[0].write_bytes(b"PAR1 half")
    write_parquet(read_parquet(kept[1]).assign(collided=True), kept[1], {"lcc_rl.block": "other"})
    evaluation.run(settings(BLOCK), tmp_path, quiet=True)
    same(tmp_path, whole)


def test_a_stopped_evaluation_of_other_settings_is_left_alone(tmp_path, monkeypatch) -> None:
    with monkeypatch.context() as patched:
        stop_after(patched, 2)
        with pytest.raises(Interrupted):
            evaluation.run(settings(BLOCK), tmp_path, quiet=True)
    with pytest.raises(ResultsError, match="already holds blocks of other settings"):
        evaluation.run(settings(BLOCK, "evaluation.seed=3"), tmp_path, quiet=True)


def test_a_resumed_evaluation_takes_no_other_settings(whole, tmp_path) -> None:
    done = run_command("lcc_rl.evaluate", f"resume={whole}", "evaluation.seed=1", cwd=tmp_path)
    assert done.returncode == 2
    assert "keeps the settings it was started with; remove evaluation.seed=1" in done.stderr


# -- shards ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shards_are_one_table_and_a_missing_one_is_said(whole, tmp_path, caplog) -> None:
    words = [*WORDS, BLOCK, "experiment=smoke", "data.platoons=2", "data.recordings=2"]
    words += ["data.duration_s=[32,40]", "scenario.horizon=40", "sweep=parts"]
    words += ["evaluation.shards=4", "evaluation.shard=range(4)"]
    run_command("lcc_rl.evaluate", "-m", *words, cwd=tmp_path, check=True)
    root, order = tmp_path / "outputs/evaluate/parts", ["profile_id", "driver_id", "strategy"]
    rows, own = results.load(root, strict=True), read_parquet(whole / "episodes.parquet")
    one, two = (x[own.columns].sort_values(order, ignore_index=True) for x in (rows, own))
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    written = {path: path.stat().st_mtime_ns for path in root.glob("*/episodes.parquet")}
    gone = sorted(written)[2]
    number = int(gone.parent.name.split("=")[1].split("_")[0])
    shutil.rmtree(gone.parent)
    assert f"evaluation.shard={number}" in results.load(root).attrs["missing"][0]
    assert "1 of 4 shards of variant idm are missing" in caplog.text
    with pytest.raises(ResultsError, match="1 of 4 shards"):
        results.load(root, strict=True)
    # The same command plays what is missing and nothing else.
    run_command("lcc_rl.evaluate", "-m", *words, cwd=tmp_path, check=True)
    again = {path: path.stat().st_mtime_ns for path in root.glob("*/episodes.parquet")}
    assert {path for path in again if again[path] == written.get(path)} == set(written) - {gone}
    assert len(results.load(root, strict=True)) == len(own)


@pytest.mark.slow
def test_a_finished_part_of_a_sweep_is_played_again_for_a_newer_policy(tmp_path, caplog) -> None:
    shutil.copy(Path(results.__file__).parents[1] / "assets/pretrained/alcc.pt", tmp_path / "a.pt")
    words = ["variant=alcc", f"policy={tmp_path / 'a.pt'}", "evaluation.baselines=[]"]
    cfg, caplog.handler.level = tiny("evaluate", *words, agent=False), 20
    caplog.set_level("INFO")
    folder = tmp_path / "run"
    for expected in (False, True):
        caplog.clear()
        evaluation.complete(cfg, folder)
        assert ("finished before" in caplog.text) == expected
    later = (folder / "episodes.parquet").stat().st_mtime + 10
    os.utime(tmp_path / "a.pt", (later, later))
    caplog.clear()
    evaluation.complete(cfg, folder)
    assert "finished before" not in caplog.text


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


def test_a_damaged_table_is_left_out_of_a_dataset(whole, tmp_path, caplog) -> None:
    shutil.copytree(whole, tmp_path / "one")
    (tmp_path / "two").mkdir()
    (tmp_path / "two" / "episodes.parquet").write_bytes(b"no table")
    assert results.load(tmp_path, lazy=True).count_rows() == 30
    assert "left out: " in caplog.text
    with pytest.raises(ResultsError, match="not a readable parquet file"):
        results.load(tmp_path, strict=True, lazy=True)


def test_the_summary_of_a_dataset_is_that_of_its_rows(whole) -> None:
    frame = read_parquet(whole / "episodes.parquet")
    data = as_dataset([whole / "episodes.parquet"])
    pd.testing.assert_frame_equal(summary(data), summary(frame), rtol=1e-9)
    assert leader_too_fast(data) == leader_too_fast(frame)
    by_hand = frame.groupby("strategy")["total_path_energy_kj"].mean()
    found = summary(data).set_index("strategy")["total_path_energy_kj"]
    assert found["idm"] == pytest.approx(by_hand["idm"], rel=1e-6)


def test_pairs_are_counted_with_their_repeat(tmp_path) -> None:
    rows = pd.DataFrame(
        {
            "strategy": ["idm"] * 4 + ["alcc"] * 4,
            "training_seed": pd.array([None] * 4 + [0] * 4, dtype="Int64"),
            "profile_id": 0,
            "driver_id": [0, 0, 1, 1] * 2,
            "repeat": [0, 1] * 4,
            "total_path_energy_kj": [1.0, 3.0, 1.0, 1.0, 2.0, 1.0, 0.5, 0.5],
            "collided": False,
        }
    )
    row = summary(rows).set_index("strategy").loc["alcc"]
    assert row["pairs_worse_than_idm"] == 0.25
    assert row["drivers_worse_than_idm"] == 0.0  # driver 0 draws 4 and 3


@pytest.mark.slow
def test_many_rows_are_a_dataset_and_draw_no_figures(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("lcc_rl.io.files.FEW", 20)
    rows = evaluation.run(settings(BLOCK), tmp_path)
    assert not isinstance(rows, pd.DataFrame)
    assert rows.count_rows() == 30
    assert not (tmp_path / "figures").exists()


def test_parts_of_a_table_must_have_the_same_columns(tmp_path) -> None:
    parts = [pd.DataFrame({"a": [1.0]}), pd.DataFrame({"a": [2.0]})]
    write_parquet(iter(parts), tmp_path / "a.parquet")
    assert read_parquet(tmp_path / "a.parquet")["a"].tolist() == [1.0, 2.0]
    with pytest.raises(ResultsError, match="row 0, column 'a' is infinite"):
        write_parquet(iter([parts[0], pd.DataFrame({"a": [math.inf]})]), tmp_path / "b.parquet")
    assert not (tmp_path / "b.parquet").exists()


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


@pytest.mark.slow
@COMPILER
def test_a_compiled_step_names_what_is_not_a_number() -> None:
    cfg = compose("alcc", "agent.hidden=[8]")
    env, good = build_env(cfg, PROFILES, POPULATION, 4, nominal=True), network(cfg)

    def policy(td):
        late = td["episode", "step"].unsqueeze(-1) == 5
        action = good(td).get(ACTION)
        return td.set(ACTION, torch.where(late, math.nan, action))

    policy.in_keys = [*good.in_keys, ("episode", "step")]
    player = Player(env, policy, [("vehicles", "gap")], "strategy x", compiled=True)
    words = "strategy x: automated.action, written by the policy, is nan at step 6 of episode 0"
    ids = torch.arange(4)
    with pytest.raises(Diverged, match=words):
        player.play(reset_options(env, ids, ids, 1, 249))


@COMPILER
def test_long_evaluations_are_compiled_whatever_their_shard() -> None:
    cfg = compose("idm", "scenario.horizon=100")
    strategy = baseline(cfg, "idm")

    def compiled(repeats: int, shards: int = 1) -> bool:
        plan = Plan(len(PROFILES), 249, None, 8, repeats, shards, 0)
        return Episodes(strategy, INPUTS, plan, 1).player.compiled

    assert not compiled(1)
    assert compiled(100)
    assert compiled(100, 1000)
