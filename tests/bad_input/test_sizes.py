"""Sizes that no machine has, and numbers out of range: one line before anything is read or made."""

from __future__ import annotations

import gzip
import os
from pathlib import Path
from time import perf_counter

import pytest
import torch
from commands import DATA, NO_AGENT, run_command, tiny
from omegaconf import OmegaConf
from table_text import long_table
from tensordict import TensorDict

from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.commands.checks import training_bytes
from lcc_rl.config import load
from lcc_rl.data.table_source import TableSource
from lcc_rl.data.tables import unpacked_size
from lcc_rl.drivers.genetic import GeneticSettings, minimise
from lcc_rl.envs.rollout import OBSERVATION
from lcc_rl.errors import ConfigError
from lcc_rl.io import memory
from lcc_rl.io.files import read_parquet
from lcc_rl.io.memory import amount, available, require_memory

BY_GAP = {"leader": "ahead", "gap": "gap"}
NOWHERE = {"_target_": "lcc_rl.data.sources.EpisodesSource", "path": "nowhere.parquet"}
HUGE = 10**15


def train_on_nothing(overrides: list[str], folder: Path) -> None:
    cfg = load("train", [*NO_AGENT, *overrides])
    OmegaConf.set_struct(cfg, False)
    cfg.data = NOWHERE
    training.run(cfg, folder, quiet=True)


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        ([f"training.environments={HUGE}", f"training.episodes={HUGE}"], "training.environments="),
        ([f"training.episodes={HUGE}"], f"training.episodes={HUGE} needs about .* PiB"),
        ([f"agent.buffer_size={HUGE}"], f"agent.buffer_size={HUGE} needs about .* PiB"),
        (
            ["agent.batch_size=1000000000", "agent.buffer_size=1000000000"],
            "agent.batch_size=1000000000 needs",
        ),
        (["agent.hidden=[1000000,1000000]"], r"agent.hidden=\[1000000, 1000000\] needs .* TiB"),
        (["agent.hidden=[-1]"], r"hidden=.*size must be a whole number from 1 up, got -1"),
        (["agent.hidden=[1e9]"], r"agent.hidden must be list of int, got \[1000000000.0\]"),
        ([f"training.episodes={8 * HUGE}"], f"training.episodes must be .* from 1 to {HUGE}, got"),
        (["agent.buffer_size=0"], r"agent.buffer_size \(0\)"),
        (["agent.batch_size=50000"], r"at most agent.buffer_size \(20000\)"),
        ([f"scenario.horizon={HUGE}", "training.segment=1"], "whole number from 1 to 1000000"),
        (
            ["scenario.horizon=0"],
            "horizon must be a whole number from 1 to 1000000, got 0",
        ),
        (["training.environments=0"], "training.environments must be a whole number from 1 up"),
        (["training.environments=-8"], "training.environments must be a whole number from 1 up"),
        (["training.checkpoint_every=0"], "training.checkpoint_every must be"),
        (["evaluation.batch_size=0"], "evaluation.batch_size must be a whole number from 1 up"),
        (["evaluation.sample_episodes=-1"], "evaluation.sample_episodes must be"),
        ([f"evaluation.seed={10**19}"], "evaluation.seed must be .* from 0 to 2147483647"),
        ([f"seed={10**19}"], "^seed must be a whole number from 0 to 2147483647"),
        (["seed=-1"], "^seed must be a whole number from 0"),
        (["threads=100000"], "^threads must be a whole number from 1 to"),
        (["device=meta"], "device must be cpu, cuda or one such as cuda:0, got 'meta'"),
        (["device=cuda:77"], "device 'cuda:77' is not available"),
        (["scenario.string='automated human*100000000'"], r"1…10000 vehicles"),
        (["drivers=kde", f"drivers.drivers={HUGE}"], f"drivers={HUGE} needs about"),
        (["drivers=kde", "drivers.seed=-1"], "drivers.seed must be a whole number from 0"),
    ],
)
def test_a_size_is_refused_in_one_line_before_the_data_are_read(tmp_path, overrides, words) -> None:
    # The data do not exist: whoever reads them first says so instead.
    begun = perf_counter()
    with pytest.raises(ConfigError, match=words) as caught:
        train_on_nothing(overrides, tmp_path)
    assert "\n" not in str(caught.value)
    assert perf_counter() - begun < 10


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


@pytest.mark.parametrize(
    ("override", "words"),
    [
        (f"population={HUGE}", "population must be a whole number from 4 to 100000, got"),
        ("population=0", "population must be a whole number from 4 to 100000, got 0"),
        ("generations=-1", "generations must be a whole number from 1 to 100000, got -1"),
        (f"+founders={HUGE}", "founders must be a whole number from 1 to 100000, got"),
    ],
)
def test_sizes_of_a_calibration(tmp_path, override, words) -> None:
    plus, name = ("+", override[1:]) if override[0] == "+" else ("", override)
    cfg = load("calibrate", [f"{plus}calibration.local_genetic.{name}"])
    cfg.data = NOWHERE
    with pytest.raises(ConfigError, match=words):
        calibration.run(cfg, tmp_path)


def test_a_search_that_fits_for_one_driver_but_not_for_all() -> None:
    settings, box = GeneticSettings(population=1000), torch.tensor([0.0, 0.0])
    with pytest.raises(ConfigError, match="search of 1000000000 × 8000"):
        minimise(lambda genes: genes, box, box + 1, 10**9, torch.Generator(), settings)


@pytest.mark.parametrize("setting", ["jobs=100000", "jobs=0", "evaluation.batch_size=0"])
def test_a_pipeline_checks_its_parts_before_the_data(tmp_path, setting) -> None:
    words = ("experiment=smoke", "data=ngsim", "data.path=nowhere.csv", setting)
    done = run_command("lcc_rl.pipeline", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert f"{setting.split('=')[0]} must be a whole number from 1" in done.stderr


def test_a_pipeline_splits_the_data_before_it_calibrates(tmp_path) -> None:
    words = ("experiment=smoke", *DATA, "data.recordings=1", "hydra.run.dir=job")
    done = run_command("lcc_rl.pipeline", *words, cwd=tmp_path)
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
    size, batch, width = cfg.agent.buffer_size, cfg.agent.batch_size, sum(cfg.agent.hidden)
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


@pytest.mark.parametrize(
    ("lines", "place", "files", "left"),
    [
        ("0::/job/step", "job", ("memory.max", "memory.current", "inactive_file"), 700),
        (
            "4:memory:/job\n0::/",
            "memory/job",
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
            700,
        ),
        ("0::/elsewhere", "job", ("memory.max", "memory.current", "inactive_file"), 4096),
    ],
)
def test_the_limit_of_a_control_group_counts(
    tmp_path, monkeypatch, lines, place, files, left
) -> None:
    group = tmp_path / "cgroup" / place
    group.mkdir(parents=True)
    for name, text in zip(files, ("1000", "500"), strict=False):
        (group / name).write_text(text)
    (group / "memory.stat").write_text(f"cache 9\n{files[2]} 200\n")
    (tmp_path / "process").write_text(lines)
    (tmp_path / "meminfo").write_text("MemTotal: 9 kB\nMemAvailable:       4 kB\n")
    monkeypatch.setattr(memory, "PROCESS", tmp_path / "process")
    monkeypatch.setattr(memory, "MEMORY", tmp_path / "meminfo")
    monkeypatch.setattr(memory, "GROUPS", tmp_path / "cgroup")
    assert available() == left


def test_without_these_files_the_physical_memory_counts_and_else_nothing(
    tmp_path, monkeypatch
) -> None:
    for name in ("PROCESS", "MEMORY", "GROUPS"):
        monkeypatch.setattr(memory, name, tmp_path / "none")
    assert available() == os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    monkeypatch.delattr(os, "sysconf")
    assert available() is None


def test_amounts_and_sizes_of_files(tmp_path) -> None:
    sizes = (0, 999, 1536, 23 * 2**30, 1.94 * 2**40, 2.0**90)
    shown = ["0 B", "999 B", "1.5 KiB", "23 GiB", "1.9 TiB", "1073741824 EiB"]
    assert [amount(size) for size in sizes] == shown
    text = b"1 2 3\n" * 10_000
    (tmp_path / "a.csv").write_bytes(text)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(text))
    assert [unpacked_size(str(tmp_path / name)) for name in ("a.csv", "a.csv.gz", "b")] == [
        len(text),
        len(text),
        0,
    ]


def test_files_larger_than_memory(tmp_path, monkeypatch) -> None:
    (tmp_path / "big.csv").write_bytes(b"x" * 10_000)
    cfg = load("calibrate", ["data=ngsim", f"data.path={tmp_path / 'big.csv'}"])
    monkeypatch.setattr(memory, "available", lambda device: 29_000)
    with pytest.raises(ConfigError, match=r"reading .*big\.csv needs about 29 KiB"):
        calibration.run(cfg, tmp_path)


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
