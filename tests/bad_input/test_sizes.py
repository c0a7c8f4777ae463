"""Sizes that no machine has, and numbers out of range: one line before anything is read or made."""

from __future__ import annotations

import pytest
import torch
from commands import DATA, run_command, tiny
from table_text import long_table
from tensordict import TensorDict

from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.commands.checks import training_bytes
from lcc_rl.config import load
from lcc_rl.data.table_source import TableSource
from lcc_rl.envs.rollout import OBSERVATION
from lcc_rl.errors import ConfigError
from lcc_rl.io import memory
from lcc_rl.io.files import read_parquet
from lcc_rl.io.memory import require_memory

BY_GAP = {"leader": "ahead", "gap": "gap"}
NOWHERE = {"_target_": "lcc_rl.data.sources.EpisodesSource", "path": "nowhere.parquet"}
HUGE = 10**15


def test_the_gradient_of_too_many_episodes_is_refused(tmp_path) -> None:
    many = [f"training.environments={HUGE}", f"training.episodes={HUGE}"]
    cfg = tiny("train", "agent=analytic", "training.segment=20", *many, agent=False)
    with pytest.raises(ConfigError, match=rf"training\.environments={HUGE} needs about .* EiB"):
        training.run(cfg, tmp_path, quiet=True)


@pytest.mark.parametrize(
    ("entry", "run", "size"),
    [
        ("train", training.run, "platoons"),
        ("evaluate", evaluation.run, "recordings"),
        ("calibrate", calibration.run, "platoons"),
    ],
)
def test_a_stream_that_is_larger_than_memory(tmp_path, entry, run, size) -> None:
    given = ["policy=pretrained"] if entry == "evaluate" else []
    cfg = load(entry, [f"data.{size}={HUGE}", *given])
    with pytest.raises(ConfigError, match=r"recordings × platoons × vehicles = \d+.* needs about"):
        run(cfg, tmp_path)


def test_a_pipeline_splits_the_data_before_it_calibrates(tmp_path) -> None:
    words = ("experiment=smoke", *DATA, "data.recordings=1", "hydra.run.dir=job")
    done = run_command("lcc_rl.cli.pipeline", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert "by recording: only" in done.stderr
    assert "say split.by=vehicle" in done.stderr
    assert not (tmp_path / "job" / "calibration").exists()


def test_more_samples_than_episodes_are_all_episodes(tmp_path) -> None:
    cfg = tiny("train", "variant=idm", f"evaluation.sample_episodes={HUGE}", agent=False)
    rows = training.run(cfg, tmp_path, quiet=True)
    assert len(read_parquet(tmp_path / "steps.parquet")) == rows["steps"].sum()


def test_the_bytes_of_a_training_by_hand() -> None:
    cfg = tiny("train", "variant=alcc", "agent=ddpg", "training.segment=20", agent=False)
    moment = TensorDict({OBSERVATION: torch.zeros(1, 1, 7), "one": torch.zeros(1, 93)}, [1])
    count, episodes = cfg.training.environments, cfg.training.episodes
    record = {f"training.episodes={episodes}": episodes / count * 4096}
    # 100 numbers of 4 bytes a moment; 7 before, 7 after, the action and the reward a transition.
    size, batch, width = cfg.agent["buffer_size"], cfg.agent["batch_size"], sum(cfg.agent["hidden"])
    assert training_bytes(cfg, moment) == {
        f"training.environments={count}": count * (24 * 400 + 2 * cfg.scenario.horizon * 64),
        **record,
        f"agent.buffer_size={size}": size * 64,
        f"agent.batch_size={batch}": batch * (2 * 64 + 16 * width),
    }
    cfg = tiny("train", "variant=alcc", "agent=analytic", "training.segment=20", agent=False)
    count = cfg.training.environments
    name = f"training.environments={count}"
    assert training_bytes(cfg, moment)[name] == count * 20 * 24 * 400


# -- what is free ---------------------------------------------------------------------------------


def test_what_fits_passes_and_what_does_not_names_the_largest_part(monkeypatch) -> None:
    monkeypatch.setattr(memory, "available", lambda device: 23 * 2**30)
    require_memory({"a=1": 2**30, "b=2": 20 * 2**30})
    words = r"b=2 needs about 20 GiB of memory \(24 GiB with the rest\); this machine has 23 GiB"
    with pytest.raises(ConfigError, match=words):
        require_memory({"a=1": 4 * 2**30, "b=2": 20 * 2**30})
    monkeypatch.setattr(memory, "available", lambda device: None)
    require_memory({"a=1": 1e30})


def test_an_evaluation_that_does_not_fit_is_refused_once_the_data_are_read(
    tmp_path, monkeypatch
) -> None:
    many = ("drivers=kde", "drivers.drivers=2000", "evaluation.drivers=null")
    cfg = tiny("evaluate", "variant=idm", *many, agent=False)
    monkeypatch.setattr(memory, "available", lambda device: 12 * 2**20)
    with pytest.raises(ConfigError, match="an evaluation of 4000 episodes of 40 steps side by"):
        evaluation.run(cfg, tmp_path)


@pytest.mark.parametrize("name", ["big.csv", "big.csv.gz", "big.parquet"])
def test_tables_larger_than_memory(tmp_path, monkeypatch, name) -> None:
    frame, path = long_table(rows=200), tmp_path / name
    frame.to_parquet(path) if path.suffix == ".parquet" else frame.to_csv(path, index=False)
    source = TableSource(
        path=str(path), columns={"vehicle": "id", "time": "t", "speed": "v", **BY_GAP}
    )
    source.load()
    monkeypatch.setattr(memory, "available", lambda device: 29_000)
    with pytest.raises(ConfigError, match=rf"reading .*{name} needs about"):
        source.load()
