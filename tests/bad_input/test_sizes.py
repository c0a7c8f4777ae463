"""Sizes that no machine has, and numbers out of range: one line before anything is read or made."""

from __future__ import annotations

import gzip
import json
import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import pytest
import torch
from commands import DATA, NO_AGENT, run_command, tiny
from omegaconf import OmegaConf
from table_text import long_table

from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.config import load
from lcc_rl.data.table_source import TableSource
from lcc_rl.data.tables import unpacked_size
from lcc_rl.drivers.genetic import GeneticSettings, minimise
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
        (f"population={HUGE}", "individuals needs about"),
        ("population=0", "population must be a whole number from 4 up, got 0"),
        ("generations=-1", "generations must be a whole number from 1 up, got -1"),
        (f"+founders={HUGE}", "individuals needs about"),
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
    assert "say split=vehicle" in done.stderr
    assert not (tmp_path / "job" / "calibration").exists()


def test_more_samples_than_episodes_are_all_episodes(tmp_path) -> None:
    cfg = tiny("train", "variant=idm", f"evaluation.sample_episodes={HUGE}", agent=False)
    rows = training.run(cfg, tmp_path, quiet=True)
    assert len(read_parquet(tmp_path / "steps.parquet")) == rows["steps"].sum()


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
    # Enough for the search of one driver, not for the file.
    monkeypatch.setattr(memory, "available", lambda device: 29_000)
    monkeypatch.setattr(GeneticSettings, "check_memory", lambda *_: None)
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


# -- estimate and truth ---------------------------------------------------------------------------

MEASURE = """
import json, sys, threading, time
from pathlib import Path
import torch
from lcc_rl.agents.factory import build_agent, make_trainer
from lcc_rl.config import load
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.inputs import constant_profiles

torch.set_num_threads(1)
cfg = load("train", ["training.compiled=false", *sys.argv[1:]])
population = bootstrap()
profiles = constant_profiles(10.0, cfg.scenario.horizon, cfg.scenario.time_step, ["trial"])

def trainer(environments):
    own = cfg.copy()
    own.training.environments = own.training.episodes = environments
    return make_trainer(own, build_agent(own, population), profiles, population, Path("."))

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096

small = trainer(2)
needs = small.footprint().needs(cfg.training, cfg.scenario.horizon)
small._iterate(small._source())
before = top = resident()

def watch():
    global top
    while True:
        top = max(top, resident())
        time.sleep(0.001)

threading.Thread(target=watch, daemon=True).start()
large = trainer(cfg.training.environments)
large._iterate(large._source())
print(json.dumps([sum(needs.values()), top - before]))
"""


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="reads /proc")
@pytest.mark.parametrize(
    "words",
    [
        "agent=ddpg training.environments=4000 training.episodes=4000 training.segment=15",
        "agent=ddpg training.environments=1000 training.episodes=1000 training.segment=300",
        "agent=analytic training.environments=400 training.episodes=400",
        "variant=ddpg training.environments=2000 training.episodes=2000 training.segment=10",
        "agent=analytic agent.bootstrap=false training.environments=200 training.episodes=200 "
        "scenario.string='automated*6'",
    ],
)
def test_the_estimate_is_at_least_the_truth_and_at_most_four_times_as_much(tmp_path, words) -> None:
    given = [word.replace("'", "") for word in words.split()]
    if "analytic" not in words:  # fewer updates take less time, not less memory
        given.append("agent.updates_per_transition=1e-6")
    command = [sys.executable, "-c", MEASURE, *given]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    need, truth = json.loads(done.stdout.splitlines()[-1])
    assert truth <= need <= 4 * truth, f"needs {amount(need)}, took {amount(truth)}"
