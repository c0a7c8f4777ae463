"""Logger room: training rows sent to TensorBoard, wandb or MLflow beside the parquet tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchrl.record.loggers import Logger

from lcc_rl.errors import ConfigError

KINDS = ("tensorboard", "wandb", "mlflow")
Row = Mapping[str, float]


class Silent:
    """Sends rows nowhere: training.parquet has them."""

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[Row], None]]:
        """Yield a function that takes a row and drops it."""
        yield lambda row: None


class RowLogger:
    """Sends every training row to one of TorchRL's loggers, under the run folder's name.

    Args:
        kind: ``"tensorboard"``, ``"wandb"`` or ``"mlflow"``.
        where: folder or tracking address; None for ``logs`` in the run's folder.
        project: wandb's project, or MLflow's experiment.
        offline: wandb keeps its files on this machine until ``wandb sync``.

    Raises:
        ConfigError: if the kind is unknown.
    """

    def __init__(
        self, kind: str, where: str | None = None, project: str = "lcc_rl", offline: bool = True
    ) -> None:
        if kind not in KINDS:
            raise ConfigError(f"logger.kind must be one of {', '.join(KINDS)}, got {kind!r}")
        self.kind, self.where, self.project, self.offline = kind, where, project, offline

    @contextmanager
    def opened(self, folder: Path) -> Iterator[Callable[[Row], None]]:
        """Yield a function that sends a row, at the step of its iteration.

        Raises:
            ConfigError: if the package that it needs is not installed.
        """
        try:
            logger = self._make(folder)
        except ImportError as error:
            raise ConfigError(
                f"logger={self.kind} is not installed: pip install -e '.[{self.kind}]' ({error})"
            ) from error
        try:
            yield lambda row: _send(logger, row)
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
