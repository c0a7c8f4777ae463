"""The typed model of a checkpoint, which checks foreign files."""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import AfterValidator
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.settings import Settings, Whole


def check_columns(columns: dict[str, Any]) -> dict[str, Any]:
    """Check that the columns of a record are numbers in double precision."""
    for name, value in columns.items():
        if not isinstance(value, Tensor) or value.dtype != torch.float64 or value.ndim != 1:
            raise ValueError(f"column {name!r} is no list of numbers in double precision")
    return columns


RecordColumns = Annotated[dict[str, Any], AfterValidator(check_columns)]


class Checkpoint(Settings):
    """Contents of a checkpoint."""

    identity: str
    iteration: Whole
    updates: Whole
    agent: dict[str, Any]
    rows: RecordColumns  # the record, an entry per iteration
    times: RecordColumns
    memory: dict[str, Any]

    def validate(self) -> None:
        lengths = {len(column) for column in (*self.rows.values(), *self.times.values())}
        if not {*lengths, *([] if self.rows else [0])} <= {self.iteration}:
            raise ConfigError(f"iteration {self.iteration}, but rows of {sorted(lengths)}")
