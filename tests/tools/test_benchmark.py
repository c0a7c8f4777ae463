"""The benchmarks: every benchmark runs and writes sane rows; no speed is asserted."""

from __future__ import annotations

import pandas as pd
import pytest
import torch

from benchmarks import command
from lcc_rl.io.files import read_parquet

SHORT = ("env",)  # the others take most of the time


def check_rows(rows: pd.DataFrame, name: str) -> None:
    assert (rows["benchmark"] == name).all()
    assert (rows["value"] > 0).all()
    assert rows["value"].between(rows["spread_low"], rows["spread_high"]).all()
    # A case that has an alternative has a ratio, and the alternative a row of its own beside it.
    compared = rows[rows["alternative"].notna()]
    assert (compared["ratio"] > 0).all()
    assert rows.loc[rows["alternative"].isna(), "ratio"].isna().all()
    own = rows.drop_duplicates(["case", "batch", "unit"])
    keys = ["alternative", "batch", "unit"]
    beside = compared.merge(own, left_on=keys, right_on=["case", *keys[1:]])
    assert len(beside) == len(compared)
    assert (rows["torch"] == torch.__version__).all()


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=() if x in SHORT else pytest.mark.slow) for x in command.BENCHMARKS],
)
def test_quick_run_writes_sane_rows(tmp_path, capsys, name) -> None:
    if name == "gym":
        pytest.importorskip("stable_baselines3", reason="extra bench")  # gymnasium comes with it
    out = tmp_path / "rows.parquet"
    assert command.main([name, "--quick", "--out", str(out)]) == 0
    check_rows(read_parquet(out), name)
    assert name in capsys.readouterr().out


def test_a_wrong_plain_loop_is_not_timed(monkeypatch) -> None:
    monkeypatch.setattr("benchmarks.plain.motor_power", lambda speed, acceleration: speed)
    options = command.parse(["env", "--quick"])
    with pytest.raises(RuntimeError, match="plain loop is off"):
        command.env(options)
