"""Training rows beside parquet: TensorBoard, wandb and MLflow, where installed; precision."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from lcc_rl.runs.loggers import RowLogger
from lcc_rl.runs.precision import set_precision

ROWS = [{"iteration": float(i), "episode_reward": -10.0 * i} for i in (1, 2)]


def send(kind: str, folder: Path) -> None:
    with RowLogger(kind=kind).opened(folder) as on_row:
        for row in ROWS:
            on_row(row)


def test_tensorboard_holds_every_row(tmp_path) -> None:
    pytest.importorskip("tensorboard", reason="extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    send("tensorboard", tmp_path / "run")
    (file,) = tmp_path.rglob("events*")
    events = EventAccumulator(str(file))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("episode_reward")]
    assert found == [(1, -10.0), (2, -20.0)]


def test_wandb_keeps_its_files_offline(tmp_path) -> None:
    pytest.importorskip("wandb", reason="extra wandb")
    send("wandb", tmp_path / "run")
    assert list(tmp_path.rglob("*.wandb"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its database layer's own making
def test_mlflow_holds_every_row(tmp_path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="extra mlflow")
    send("mlflow", tmp_path)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("lcc_rl").experiment_id])
    history = client.get_metric_history(run.info.run_id, "episode_reward")
    assert [(point.step, point.value) for point in history] == [(1, -10.0), (2, -20.0)]


def test_the_error_of_a_reduced_precision_is_measured_and_logged(caplog) -> None:
    caplog.set_level(logging.INFO, "lcc_rl")
    before = torch.get_float32_matmul_precision()
    try:
        assert 0.0 < set_precision("highest") < 1e-5
        assert not caplog.messages
        error = set_precision("medium")
        assert torch.get_float32_matmul_precision() == "medium"
    finally:
        torch.set_float32_matmul_precision(before)
    assert f"{error:.1g}" in caplog.messages[0]
