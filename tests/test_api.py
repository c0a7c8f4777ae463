"""Training and evaluation as functions: the files and rows of the commands."""

from __future__ import annotations

import pandas as pd
import pytest
from commands import TINY

import lcc_rl
from lcc_rl.io.files import read_parquet


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return lcc_rl.learn("alcc", TINY, tmp_path_factory.mktemp("api") / "run")


def test_a_run_has_rows_table_and_training(run) -> None:
    pd.testing.assert_frame_equal(run.rows, read_parquet(run.folder / "episodes.parquet"))
    assert list(run.table["strategy"]) == ["alcc"]
    assert len(run.training) == 3
    assert (run.folder / "policy.pt").exists()


def test_runs_controllers_and_baselines_are_compared(run, tmp_path) -> None:
    shrunk = [word for word in TINY if not word.startswith("agent.")]
    found = lcc_rl.compare([run, "idm_acc"], "alcc", shrunk, tmp_path / "found")
    assert {"alcc", "idm_acc", "idm"} <= set(found.table["strategy"])
    own = found.rows[found.rows["strategy"] == "alcc"].reset_index(drop=True)
    columns = ["profile_id", "driver_id", "total_energy_kj"]
    pd.testing.assert_frame_equal(own[columns], run.rows[columns])
