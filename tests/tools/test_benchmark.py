"""The benchmarks: every benchmark runs and writes sane rows; no speed is asserted."""

from __future__ import annotations

import importlib
from types import ModuleType

import pandas as pd
import pytest
import torch

from lcc_rl.io.files import read_parquet
from lcc_rl.synthetic.stream import StreamSource

NAMES = ("read", "env", "collect", "update", "train", "calibrate", "evaluate")
COLUMNS = [
    "benchmark",
    "case",
    "batch",
    "value",
    "unit",
    "spread_low",
    "spread_high",
    "alternative",
    "ratio",
    "device",
    "threads",
    "machine",
    "torch",
]


EXTRAS = ("collect", "update", "calibrate")  # those that compare with packages of an extra


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    module = importlib.import_module("benchmarks.command")
    assert set(module.BENCHMARKS) == set(NAMES)
    return module


LONG = ("calibrate", "read", "evaluate")  # longer than all others together


def check_rows(rows: pd.DataFrame, name: str) -> None:
    assert list(rows.columns) == COLUMNS
    assert (rows["benchmark"] == name).all()
    assert (rows["value"] > 0).all()
    assert (rows["spread_low"] <= rows["value"]).all()
    assert (rows["value"] <= rows["spread_high"]).all()
    # What has an alternative has a ratio, and the alternative a row of its own beside it.
    compared = rows[rows["alternative"].notna()]
    assert (compared["ratio"] > 0).all()
    assert rows.loc[rows["alternative"].isna(), "ratio"].isna().all()
    beside = compared.merge(
        rows,
        left_on=["alternative", "batch", "unit"],
        right_on=["case", "batch", "unit"],
        suffixes=("", "_other"),
    )
    assert len(beside) == len(compared)
    assert (rows["threads"] == torch.get_num_threads()).all()
    assert rows["machine"].str.len().gt(0).all()
    assert (rows["torch"] == torch.__version__).all()


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in NAMES],
)
def test_quick_run_writes_sane_rows(benchmark, tmp_path, capsys, name) -> None:
    out = tmp_path / "rows.parquet"
    assert benchmark.main([name, "--quick", "--out", str(out)]) == 0
    check_rows(read_parquet(out), name)
    assert name in capsys.readouterr().out


@pytest.mark.slow
def test_given_episodes_are_calibrated(benchmark, tmp_path, capsys) -> None:
    episodes = StreamSource(2, 2, 2, (35.0, 40.0)).load().episodes
    episodes.to_parquet(tmp_path / "pairs.parquet")
    out = tmp_path / "rows.parquet"
    given = ["--episodes", str(tmp_path / "pairs.parquet"), "--out", str(out)]
    assert benchmark.main(["calibrate", "update", "--quick", *given]) == 0
    rows = read_parquet(out)
    assert set(rows["benchmark"]) == {"calibrate", "update"}
    assert episodes["episode"].nunique() in set(rows["batch"])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["reed"], "Did you mean 'read'"),
        (["read", "--ngsim", "missing.csv"], "missing.csv"),
        (["calibrate", "--episodes", "missing.parquet"], "missing.parquet"),
    ],
)
def test_bad_input_ends_in_one_clear_error(benchmark, tmp_path, capsys, arguments, message) -> None:
    assert benchmark.main([*arguments, "--quick", "--out", str(tmp_path / "rows.parquet")]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "rows.parquet").exists()


def test_a_wrong_plain_loop_is_not_timed(benchmark, monkeypatch) -> None:
    monkeypatch.setattr("benchmarks.plain.motor_power", lambda speed, acceleration: speed)
    options = benchmark.parse(["env", "--quick", "--device", "cpu"])
    with pytest.raises(RuntimeError, match="plain loop is off"):
        benchmark.env(options)


def test_a_wrong_plain_python_loop_is_not_timed(benchmark, monkeypatch) -> None:
    pytest.importorskip("gymnasium")
    pytest.importorskip("stable_baselines3")
    monkeypatch.setattr("benchmarks.scalar.power", lambda speed, acceleration: speed)
    options = benchmark.parse(["collect", "--quick", "--device", "cpu"])
    with pytest.raises(RuntimeError, match="plain Python loop is off"):
        benchmark.collect(options)


@pytest.mark.slow
def test_without_the_extra_it_says_what_is_left_out(benchmark, monkeypatch, tmp_path, capsys):
    for module in ("command", *EXTRAS):
        monkeypatch.setattr(f"benchmarks.{module}.installed", lambda *names: False)
    out = tmp_path / "rows.parquet"
    names = ["collect", "update", "calibrate"]
    assert benchmark.main([*names, "--quick", "--out", str(out)]) == 0
    rows = read_parquet(out)
    assert set(rows["benchmark"]) == set(names)
    assert not rows["case"].isin(["stable-baselines3", "scipy and numba"]).any()
    assert "left out: stable_baselines3, gymnasium, numba" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the compiler's own making
def test_compiled_cases(benchmark, tmp_path, capsys) -> None:
    out = tmp_path / "rows.parquet"
    assert benchmark.main(["env", "--quick", "--compile", "--out", str(out)]) == 0
    rows = read_parquet(out)
    compiled = rows[rows["case"].str.contains("compiled")]
    assert set(compiled["benchmark"]) == {"env"}
