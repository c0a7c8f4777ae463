"""Reading and checking of tables of calibrated drivers."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pandas as pd

from lcc_rl.data.sources import ASSETS
from lcc_rl.drivers.observed import PAIR_IDENTITY
from lcc_rl.drivers.parameters import DEFAULT_MODEL, MODEL, REACTION, parameters_of, users
from lcc_rl.errors import DataError, ResultsError, raised_as
from lcc_rl.functional.driver_models import Reaction
from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import read_parquet

log = logging.getLogger("lcc_rl")

SHIPPED_DRIVERS = "i80_drivers.parquet"


def load_drivers(path: str | Path | None = None, mode: str | None = None) -> pd.DataFrame:
    """Read a table of calibrated drivers and check it.

    Args:
        path: a ``drivers.parquet`` of a calibration; None: the shipped I-80 drivers.
        mode: mode of the calibration, ``local`` or ``global``; by default that of the table,
            ``local`` if it has both.

    Returns:
        One row per driver, columns as written by :class:`lcc_rl.drivers.calibrator.Calibrator`.

    Raises:
        DataError: naming file, row and column, if the table is missing, empty or not valid.
    """
    with raised_as(DataError, "", ResultsError):
        frame = read_parquet(ASSETS / SHIPPED_DRIVERS if path is None else path)
    name = SHIPPED_DRIVERS if path is None else str(path)
    check_drivers(frame, name)
    return _of_mode(frame, mode or ("local" if path is None else None), name)


def _of_mode(frame: pd.DataFrame, mode: str | None, name: str) -> pd.DataFrame:
    """Keep the drivers of one calibration mode."""
    if "mode" not in frame.columns:
        return frame
    held = frame["mode"].unique().tolist()
    if mode is None and len(held) > 1:
        log.warning("%s holds drivers of several modes; drivers.mode=local is taken", name)
    mode = mode or ("local" if "local" in held else held[0])
    if mode not in held:
        raise DataError(f"{name}: no drivers of mode {mode!r}; the table holds {', '.join(held)}")
    return frame[frame["mode"] == mode].reset_index(drop=True)


def models_of(frame: pd.DataFrame, name: str) -> pd.Series:
    """Return the model of every driver of a table; the IDM if the column is missing.

    Raises:
        DataError: naming the table and row, if a model is unknown.
    """
    if MODEL not in frame.columns:
        return pd.Series(DEFAULT_MODEL, index=frame.index)
    unknown = ~frame[MODEL].isin(list(LAWS)).to_numpy()
    if unknown.any():
        row = int(unknown.argmax())
        raise DataError(
            f"{name}: row {row}, column {MODEL!r}: must be one of {', '.join(LAWS)}, got "
            f"{frame[MODEL].iloc[row]!r}; +drivers.law=<module.Class> adds your own model"
        )
    return frame[MODEL]


def check_drivers(frame: pd.DataFrame, name: str) -> None:
    """Check that a table holds drivers with plausible parameters, each driver once.

    Raises:
        DataError: naming the table, row and column of the first fault.
    """
    if frame.empty:
        raise DataError(f"{name}: the table holds no drivers")
    models = models_of(frame, name)
    needed = parameters_of(models.unique())
    missing = [one.column for one in needed.values() if one.column not in frame.columns]
    if missing:
        raise DataError(f"{name}: missing column(s) {', '.join(missing)}")
    for parameter, (column, _, _, (low, high)) in needed.items():
        if not pd.api.types.is_numeric_dtype(frame[column]):
            raise DataError(f"{name}: column {column!r} is not numeric")
        values = frame[column].to_numpy(np.float64, na_value=np.nan)
        bad = models.isin(users(parameter)).to_numpy() & ~((values >= low) & (values <= high))
        if bad.any():
            row = int(bad.argmax())
            raise DataError(
                f"{name}: row {row}, column {column!r}: must be {low:g} to {high:g}, "
                f"got {frame[column].iloc[row]}"
            )
    _check_identities(frame, name)


def reaction_of(frame: pd.DataFrame, name: str) -> Reaction:
    """Return the shared reaction of a table's drivers; 0 for missing columns.

    Raises:
        DataError: naming the table and column, if one differs by driver or is implausible.
    """
    found = {}
    for part, (column, low, high) in REACTION.items():
        if column in frame.columns:
            values = pd.to_numeric(frame[column], errors="coerce").unique()
            if len(values) != 1 or not low <= values[0] <= high:
                raise DataError(
                    f"{name}: column {column!r} must be {low:g} to {high:g}, the same for all "
                    f"drivers, got {', '.join(map(str, frame[column].unique()[:3]))}"
                )
            found[part] = float(values[0])
    return Reaction(**found)


def _check_identities(frame: pd.DataFrame, name: str) -> None:
    """Raise a DataError if a driver appears twice."""
    if not set(PAIR_IDENTITY) <= set(frame.columns):
        return
    # A pair that was cut by a lane change counts as two drivers with different episodes.
    columns = [
        column for column in ("mode", MODEL, "episode", *PAIR_IDENTITY) if column in frame.columns
    ]
    twice = frame.duplicated(columns).to_numpy()
    if twice.any():
        row = int(twice.argmax())
        shown = ", ".join(f"{column} {frame[column].iloc[row]}" for column in columns)
        raise DataError(f"{name}: row {row}: a driver appears twice ({shown}); expected it once")
