"""Loggers of training rows: TensorBoard, wandb and MLflow."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lcc_rl.errors import ConfigError, how_to_install
from lcc_rl.settings import Settings

if TYPE_CHECKING:  # loading it looks for the packages of all loggers
    from torchrl.record.loggers import Logger

Row = Mapping[str, float]


class Silent:
    """Logs nothing; training.parquet holds the rows."""

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[Row], None]]:
        """Yield a function that ignores a row."""
        yield lambda row: None


class RowLogger(Settings):
    """Logs every training row with one of TorchRL's loggers, under the run folder's name."""

    WRITES = ("where",)  # settings that name a place to write

    kind: Literal["tensorboard", "wandb", "mlflow"]
    where: str | None = None  # folder or tracking address; null: logs in the run's folder
    project: str = "lcc_rl"  # wandb's project, or MLflow's experiment
    offline: bool = True  # wandb keeps its files on this machine until wandb sync

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[Row], None]]:
        """Yield a function that logs a row at its iteration."""
        try:
            logger = self._make(folder)
        except ImportError as error:
            raise ConfigError(
                f"logger={self.kind} is not installed: {how_to_install(self.kind)} ({error})"
            ) from error
        try:
            yield partial(_send, logger)
        finally:
            _close(logger, self.kind)

    def _make(self, folder: Path) -> Logger:
        where = self.where or str(folder / "logs")
        if self.kind == "tensorboard":
            from torchrl.record.loggers.tensorboard import TensorboardLogger

            return TensorboardLogger(exp_name=folder.name, log_dir=where)
        if self.kind == "wandb":
            from torchrl.record.loggers.wandb import WandbLogger

            Path(where).mkdir(parents=True, exist_ok=True)
            return WandbLogger(
                exp_name=folder.name,
                offline=self.offline,
                save_dir=where,
                project=self.project,
                log_env_packages=False,
            )
        from torchrl.record.loggers.mlflow import MLFlowLogger

        address = self.where or f"sqlite:///{folder.resolve() / 'mlflow.db'}"
        return MLFlowLogger(exp_name=self.project, tracking_uri=address)


def _send(logger: Logger, row: Row) -> None:
    values: dict[str, Any] = {name: float(value) for name, value in row.items()}
    logger.log_metrics(values, step=int(row["iteration"]))


def _close(logger: Logger, kind: str) -> None:
    if kind == "mlflow":
        import mlflow

        mlflow.end_run()
    elif kind == "wandb":
        logger.experiment.finish()
    else:
        logger.experiment.close()
