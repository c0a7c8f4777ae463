"""Loggers of training rows: TensorBoard, wandb and MLflow."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from numbers import Real
from pathlib import Path
from typing import Any, Literal

import yaml

from lcc_rl.config.compose import NOT_IDENTITY, config_hash
from lcc_rl.errors import needing
from lcc_rl.results.runs import CONFIG, flatten, read_settings
from lcc_rl.settings import Settings

TrainingRow = Mapping[str, float]
RUN_TAG = "lcc_rl.id"
NOT_MLFLOW = re.compile(r"[^\w\-. :/]")  # characters that MLflow's names must not contain


class Silent:
    """Logs nothing; training.parquet holds the rows."""

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[TrainingRow], None]]:
        """Yield a function that ignores a row."""
        yield lambda row: None


class RowLogger(Settings):
    """Logs settings, training rows and the result of a run by TensorBoard, wandb or MLflow.

    The run has the name of its folder. Its id is a hash of the folder's path and the settings, so a
    resumed run is the same one. Measures of the evaluation are named ``result/…``.
    """

    kind: Literal["tensorboard", "wandb", "mlflow"]
    where: str | None = None  # folder or tracking address; null: logs in the run's folder
    project: str = "lcc_rl"  # wandb's project, or MLflow's experiment
    offline: bool = True  # wandb stores files locally until wandb sync

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[TrainingRow], None]]:
        """Yield a function that logs a row at its iteration."""
        with self._run(folder) as send:
            yield lambda row: send(_numbers(row), step=int(row["iteration"]))

    def log_result(self, folder: Path, row: Mapping[str, Any]) -> None:
        """Log the measures of an evaluation."""
        with self._run(folder) as send:
            send({f"result/{name}": value for name, value in _numbers(row).items()})

    @contextmanager
    def _run(self, folder: Path) -> Iterator[Callable[..., Any]]:
        """Yield a function that logs numbers by name, optionally at a step."""
        where, name = self.where or str(folder / "logs"), folder.resolve().name
        stored = read_settings(folder / CONFIG) if (folder / CONFIG).is_file() else {}
        settings = {key: value for key, value in stored.items() if key not in NOT_IDENTITY}
        run_id = config_hash([str(folder.resolve()), settings])
        with needing(self.kind, f"logger={self.kind} is not installed"):
            if self.kind == "tensorboard":
                from torchrl.record.loggers.tensorboard import TensorboardLogger

                logger = TensorboardLogger(exp_name=name, log_dir=where)
                logger.experiment.add_text("settings", f"```\n{yaml.safe_dump(settings)}```")
                send, close = logger.log_metrics, logger.experiment.close
            elif self.kind == "wandb":
                from torchrl.record.loggers.wandb import WandbLogger

                place = {"save_dir": where, "project": self.project, "offline": self.offline}
                wandb = WandbLogger(exp_name=name, id=run_id, log_env_packages=False, **place)
                wandb.log_hparams(settings)
                send, close = wandb.log_metrics, wandb.experiment.finish
            else:
                address = self.where or f"sqlite:///{folder.resolve() / 'mlflow.db'}"
                send, close = _of_mlflow(address, self.project, name, run_id, settings)
        try:
            yield send
        finally:
            close()


def _of_mlflow(
    address: str, project: str, name: str, run_id: str, settings: Mapping[str, Any]
) -> tuple[Callable[..., Any], Callable[[], Any]]:
    """Start or resume a run of MLflow, which chooses ids; return functions to log and to end it."""
    import mlflow

    mlflow.set_tracking_uri(address)
    experiment = mlflow.set_experiment(project).experiment_id
    chosen = f"tags.`{RUN_TAG}` = '{run_id}'"
    for run in mlflow.search_runs([experiment], chosen, output_format="list"):
        mlflow.start_run(run.info.run_id)
        break
    else:
        mlflow.start_run(run_name=name, tags={RUN_TAG: run_id})
        values = {NOT_MLFLOW.sub("_", key)[:250]: str(x)[:500] for key, x in flatten(settings)}
        mlflow.log_params(values)
    return mlflow.log_metrics, mlflow.end_run


def _numbers(row: Mapping[str, Any]) -> dict[str, float]:
    return {key: float(x) for key, x in row.items() if isinstance(x, Real) and isfinite(x)}
