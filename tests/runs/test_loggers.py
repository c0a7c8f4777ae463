"""Training rows beside parquet: TensorBoard, wandb and MLflow, where they are installed."""

from __future__ import annotations

from pathlib import Path

import pytest

from lcc_rl.config import identity, load
from lcc_rl.errors import ConfigError
from lcc_rl.runs.loggers import RowLogger, Silent

ROWS = [{"iteration": float(i), "episode_reward": -10.0 * i} for i in (1, 2)]


def send(logger: RowLogger | Silent, folder: Path) -> None:
    with logger.opened(folder) as on_row:
        for row in ROWS:
            on_row(row)


def test_tensorboard_holds_every_row(tmp_path) -> None:
    pytest.importorskip("tensorboard", reason="extra tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    send(RowLogger(kind="tensorboard"), tmp_path / "run")
    (file,) = tmp_path.rglob("events*")
    events = EventAccumulator(str(file))
    events.Reload()
    found = [(event.step, event.value) for event in events.Scalars("episode_reward")]
    assert found == [(1, -10.0), (2, -20.0)]


def test_wandb_keeps_its_files_offline(tmp_path) -> None:
    pytest.importorskip("wandb", reason="extra wandb")
    send(RowLogger(kind="wandb"), tmp_path / "run")
    assert list(tmp_path.rglob("*.wandb"))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of its database layer's own making
def test_mlflow_holds_every_row(tmp_path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="extra mlflow")
    send(RowLogger(kind="mlflow"), tmp_path)
    client = mlflow.MlflowClient(f"sqlite:///{tmp_path / 'mlflow.db'}")
    (run,) = client.search_runs([client.get_experiment_by_name("lcc_rl").experiment_id])
    history = client.get_metric_history(run.info.run_id, "episode_reward")
    assert [(point.step, point.value) for point in history] == [(1, -10.0), (2, -20.0)]


def test_nothing_is_kept_by_default(tmp_path) -> None:
    send(Silent(), tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_logger_changes_no_hash() -> None:
    assert identity(load("train", ["logger=rows"])) == identity(load("train"))


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(ConfigError, match="kind must be"):
        RowLogger(kind="paper")
