"""The comparison of driver models: every model and objective, in and out of sample."""

from __future__ import annotations

import compare_drivers
import pandas as pd
import pytest

from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import read_parquet

QUICK = [
    *("data.platoons=2", "data.vehicles=4", "data.recordings=1"),
    *("calibration.global_genetic.population=8", "calibration.global_genetic.generations=2"),
]


def test_every_model_and_objective_is_a_row(tmp_path, capsys) -> None:
    path = tmp_path / "rows.parquet"
    assert compare_drivers.main([*QUICK, "--save", str(path)]) == 0
    rows = read_parquet(path)
    pairs = [(x, y) for x in LAWS for y in compare_drivers.OBJECTIVES]
    assert list(zip(rows["model"], rows["objective"], strict=True)) == pairs
    assert (rows["holdout"] == 0.3).all()
    assert (rows["mode"] == "global").all()
    for name in ("rmspe", "gap_rmse_m", "gap_nrmse"):
        for end in ("", "_out"):
            assert (rows[f"{name}{end}_median"] <= rows[f"{name}{end}_p95"]).all()
            assert rows[f"{name}{end}"].notna().all()
    shown = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("| ") for line in shown) == 1 + len(pairs)
    assert f"{100 * rows['rmspe_out'][0]:.1f} %" in shown[2]


def test_without_a_holdout_there_is_nothing_out_of_sample() -> None:
    known = {"model": "gipps", "objective": "gap_rmse", "rmspe": 0.05, "gap_rmse_m": 1.0}
    line = compare_drivers.table(pd.DataFrame([known])).splitlines()[-1]
    assert line == "| Gipps | gap_rmse | 5.0 % | 1.00 m | – | – |"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["data=episodes", "data.path=/no/such"], "/no/such: no such file"),
        (["calibration.holdout=2"], "holdout"),
        (["calibration.modle=idm"], "modle"),
    ],
)
def test_bad_input_ends_in_one_line(words, message, capsys) -> None:
    assert compare_drivers.main([*QUICK[:3], *words] if "data" not in words[0] else words) == 1
    said = capsys.readouterr().err
    assert said.startswith("error: ")
    assert message in said
    assert said.count("\n") == 1
