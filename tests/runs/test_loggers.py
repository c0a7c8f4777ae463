"""Training rows beside parquet: TensorBoard, wandb and MLflow, where installed; precision."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest
import torch

from lcc_rl.runs.loggers import RowLogger
from lcc_rl.runs.precision import product_error, set_precision

ROWS = [{"iteration": float(i), "episode_reward": -10.0 * i} for i in (1, 2)]


def send(kind: str, folder: Path) -> None:
    """Log as a run does that is resumed after its first row, and then evaluated."""
    folder.mkdir()
    (folder / "config.yaml").write_text(
        "{seed: 3, agent: {gamma: 0.5}, inputs: {a: {b(1).csv: x}}}"
    )
    logger = RowLogger(kind=kind)
    for row in ROWS:
        with logger.opened(folder) as on_row:
            on_row(row)
    logger.log_result(folder, {"strategy": "alcc", "kj_per_km": 700.0, "saving": float("nan")})


def test_tensorboard_holds_settings_every_row_and_the_result(tmp_path) -> None:
    pytest.importorskip("tensorboard", reason="extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    send("tensorboard", tmp_path / "run")
    events = EventAccumulator(str(tmp_path / "run" / "logs" / "run"))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("episode_reward")]
    assert found == [(1, -10.0), (2, -20.0)]
    assert [event.value for event in events.Scalars("result/kj_per_km")] == [700.0]
    (text, *_) = events.Tensors("settings/text_summary")
    assert b"gamma: 0.5" in text.tensor_proto.string_val[0]


def test_wandb_keeps_the_files_of_one_run_offline(tmp_path) -> None:
    pytest.importorskip("wandb", reason="extra wandb")

    send("wandb", tmp_path / "run")
    files = sorted(tmp_path.rglob("*.wandb"))
    assert len({path.stem.rpartition("-")[2] for path in files}) == 1  # the id
    # Its format is its own; texts stand in it as they are.
    content = b"".join(path.read_bytes() for path in files)
    for text in (b"gamma", b"episode_reward", b"result/kj_per_km", b"700"):
        assert text in content


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its database layer's own making
def test_mlflow_holds_one_run_with_settings_every_row_and_the_result(tmp_path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="extra mlflow")
    send("mlflow", tmp_path / "run")
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'run' / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("lcc_rl").experiment_id])
    assert run.info.run_name == "run"
    assert run.data.params == {"seed": "3", "agent.gamma": "0.5", "inputs.a.b_1_.csv": "x"}
    assert run.data.metrics["result/kj_per_km"] == 700.0
    history = client.get_metric_history(run.info.run_id, "episode_reward")
    assert [(point.step, point.value) for point in history] == [(1, -10.0), (2, -20.0)]


def test_the_error_of_a_reduced_precision_is_measured_and_logged(caplog) -> None:
    caplog.set_level(logging.INFO, "lcc_rl")
    before = torch.get_float32_matmul_precision()
    try:
        set_precision("highest")
        assert not caplog.messages
        best = product_error()
        set_precision("medium")
        assert torch.get_float32_matmul_precision() == "medium"
        error = product_error()
    finally:
        torch.set_float32_matmul_precision(before)
    assert 0.0 < best < 1e-5
    assert f"{error:.1g}, at the highest {best:.1g}" in caplog.messages[0]
