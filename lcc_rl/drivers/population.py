"""Populations of human drivers, from which episodes draw drivers."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.assets import ASSETS
from lcc_rl.drivers.observed import PAIR_IDENTITY
from lcc_rl.drivers.parameters import (
    DEFAULT_BOUNDS,
    DEFAULT_MODEL,
    MODEL,
    REACTION,
    at_bound,
    find_law,
    parameters_of,
    users,
)
from lcc_rl.errors import ConfigError, DataError, ResultsError, raised_as, require
from lcc_rl.functional.driver_models import INDIVIDUAL, PARAMETERS, Reaction
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import read_parquet
from lcc_rl.settings import NonNegative, Positive, checked

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


@dataclass(frozen=True)
class DriverPopulation:
    """Drivers that an episode can draw.

    Args:
        desired_speed: v0, ``[drivers]`` [m/s].
        time_gap: T, ``[drivers]`` [s].
        constants: the other parameters of the IDM: numbers if all drivers share them, else
            tensors ``[drivers]`` (a globally calibrated population). With other driver models,
            estimators that use the IDM read them.
        ids: identity of each driver.
        at_bound: whether a desired speed lies on a calibration bound, ``[drivers]``.
        models: model of each driver; None: the IDM for all.
        reaction: shared delay and noises.
        mode: mode of the calibration, ``local`` or ``global``, if known.
        own: further parameters of other models by name, ``[drivers]``; NaN where a driver's model
            lacks one.

    Raises:
        ConfigError: if there is no driver, or a parameter is not plausible.
    """

    desired_speed: Tensor
    time_gap: Tensor
    constants: IDMConstants
    ids: tuple[str, ...]
    at_bound: Tensor
    models: tuple[str, ...] | None = None
    own: Mapping[str, Tensor] = field(default_factory=dict)
    reaction: Reaction = field(default_factory=Reaction)
    mode: str | None = None

    def __post_init__(self) -> None:
        require(self.ids, "driver population: holds no drivers")
        table = parameters_of(self.models or (DEFAULT_MODEL,))
        for name, values in self.parameters().items():
            low, high = table[name].plausible
            unused = values.isnan() if self.models else torch.zeros(()).bool()
            wrong = ~((values >= low) & (values <= high)) & ~unused
            if bool(wrong.any()):
                found = float(values[wrong][0])
                raise ConfigError(
                    f"driver population: {name!r} must be {low:g} to {high:g}, got {found:g}"
                )
        for name, (_, low, high) in REACTION.items():
            value = getattr(self.reaction, name)
            if not low <= value <= high:
                raise ConfigError(
                    f"driver population: reaction {name} must be {low:g} to {high:g}, got {value:g}"
                )

    def __len__(self) -> int:
        """Number of drivers."""
        return len(self.ids)

    @property
    def vehicles(self) -> int:
        """Number of vehicles; one has several records after a hole or behind several leaders."""
        return len({tuple(identity.rsplit("/", 2)[:2]) for identity in self.ids})

    def select(self, index: Tensor) -> DriverPopulation:
        """Return the drivers at ``index`` ``[chosen]``, in that order, with repetitions."""
        constants = vars(self.constants).items()
        own = {name: value[index] for name, value in constants if isinstance(value, Tensor)}
        return DriverPopulation(
            self.desired_speed[index],
            self.time_gap[index],
            self.constants.with_(**own),
            tuple(self.ids[place] for place in index.tolist()),
            self.at_bound[index],
            self.models and tuple(self.models[place] for place in index.tolist()),
            {name: values[index] for name, values in self.own.items()},
            self.reaction,
            self.mode,
        )

    def summary(self) -> dict[str, float]:
        """Return the correlation of (v0, T), NaN if one does not vary, and the share at a bound."""
        speed, gap = (x.double().cpu().numpy() for x in (self.desired_speed, self.time_gap))
        varies = min(np.ptp(speed), np.ptp(gap)) > 0.0
        return {
            "correlation": float(np.corrcoef(speed, gap)[0, 1]) if varies else float("nan"),
            "share_at_bound": float(self.at_bound.double().mean()),
        }

    def parameters(self) -> dict[str, Tensor]:
        """Return the drivers' parameters by name, each ``[drivers]``, float64.

        IDM drivers have five. In a mixture of models, parameters that a driver lacks are NaN.
        """
        own = {"desired_speed": self.desired_speed, "time_gap": self.time_gap}
        shared = {name: getattr(self.constants, name) for name in LAWS[DEFAULT_MODEL].shared()}
        own |= shared if self.models is None else self.own
        device = self.desired_speed.device
        return {
            name: torch.as_tensor(values, dtype=torch.float64, device=device).expand(len(self))
            for name, values in own.items()
        }


@checked
def bootstrap(
    path: str | Path | None = None,
    mode: str | None = None,
    least_speed: Positive | None = None,
    reaction_delay: NonNegative | None = None,
    acceleration_noise: NonNegative | None = None,
    gap_noise: NonNegative | None = None,
    law: str | None = None,
) -> DriverPopulation:
    """Return the calibrated drivers as a population, the empirical joint distribution.

    Args:
        path: table of calibrated drivers; None: the shipped I-80 drivers.
        mode: see :func:`load_drivers`.
        least_speed: lower bound of desired speeds, for leaders faster than those of the calibration
            [m/s]; None: no bound. Time gaps are unchanged.
        reaction_delay: delay of all drivers [s]; None: that of the table, 0 if it has none.
        acceleration_noise: standard deviation [m/s²], likewise; see
            :class:`lcc_rl.functional.driver_models.Reaction`.
        gap_noise: standard deviation of the perceived gap's logarithm, likewise.
        law: dotted path of your own driver model, if drivers of the table have it.

    Raises:
        DataError: if the table is not valid.
    """
    if law is not None:
        find_law(law)
    table = load_drivers(path, mode)
    calibrated = str(table["mode"].iloc[0]) if "mode" in table else None
    found = replace(from_table(table, path or SHIPPED_DRIVERS), mode=calibrated)
    given = {"delay": reaction_delay, "noise": acceleration_noise, "gap_noise": gap_noise}
    changes = {name: value for name, value in given.items() if value is not None}
    found = replace(found, reaction=replace(found.reaction, **changes))
    if least_speed is None:
        return found
    raised = found.desired_speed < least_speed
    speed = found.desired_speed.clamp(min=least_speed)
    return replace(found, desired_speed=speed, at_bound=found.at_bound & ~raised)


def from_table(table: pd.DataFrame, name: str | Path = "driver table") -> DriverPopulation:
    """Build a population from a driver table, one driver per row; ``name``: in messages.

    Raises:
        DataError: if the table is not valid.
    """
    check_drivers(table, str(name))
    models = models_of(table, str(name))
    shared = LAWS[DEFAULT_MODEL].shared() if (models == DEFAULT_MODEL).all() else ()
    own = {name: table[PARAMETERS[name].column].to_numpy(np.float64) for name in shared}
    constants = IDMConstants(
        **{name: float(values[0]) for name, values in own.items() if np.ptp(values) == 0.0}
    )
    varying = {name: _tensor(values) for name, values in own.items() if np.ptp(values) > 0.0}
    found = DriverPopulation(
        desired_speed=_tensor(table[PARAMETERS["desired_speed"].column]),
        time_gap=_tensor(table[PARAMETERS["time_gap"].column]),
        constants=constants.with_(**varying),
        ids=_identities(table),
        at_bound=_flags(table),
        reaction=reaction_of(table, str(name)),
    )
    if shared:
        return found
    more = {
        name: _tensor(table[one.column].where(models.isin(users(name))))
        for name, one in parameters_of(models.unique()).items()
        if name not in INDIVIDUAL
    }
    return replace(found, models=tuple(models), own=more)


def _tensor(values: np.ndarray | pd.Series) -> Tensor:
    return torch.tensor(np.asarray(values, np.float64), dtype=torch.float32)


def _identities(table: pd.DataFrame) -> tuple[str, ...]:
    """Return ``recording/follower/leader`` if known, else the row's number."""
    if not set(PAIR_IDENTITY) <= set(table.columns):
        return tuple(str(number) for number in range(len(table)))
    return tuple(
        "/".join(map(str, row)) for row in table[list(PAIR_IDENTITY)].itertuples(index=False)
    )


def _flags(table: pd.DataFrame) -> Tensor:
    """Return which desired speeds lie on a bound of the calibration, else on a default bound."""
    if "desired_speed_at_bound" in table.columns:
        return torch.tensor(table["desired_speed_at_bound"].to_numpy(bool))
    values = table[PARAMETERS["desired_speed"].column].to_numpy(np.float64)
    return torch.tensor(at_bound(values, DEFAULT_BOUNDS["desired_speed"]))


@checked
def fixed(
    desired_speed: float = 25.0,
    time_gap: float = 1.2,
    acceleration: float = 1.0,
    deceleration: float = 1.5,
    min_gap: float = 2.0,
    reaction_delay: NonNegative = 0.0,
    acceleration_noise: NonNegative = 0.0,
    gap_noise: NonNegative = 0.0,
) -> DriverPopulation:
    """Return a population of one given driver.

    Args:
        desired_speed: v0 [m/s].
        time_gap: T [s].
        acceleration: a [m/s²].
        deceleration: b [m/s²].
        min_gap: s0 [m].
        reaction_delay: delay [s].
        acceleration_noise: standard deviation [m/s²].
        gap_noise: standard deviation of the perceived gap's logarithm.
    """
    return DriverPopulation(
        desired_speed=torch.tensor([float(desired_speed)]),
        time_gap=torch.tensor([float(time_gap)]),
        constants=IDMConstants(acceleration, deceleration, min_gap),
        ids=("fixed",),
        at_bound=torch.zeros(1, dtype=torch.bool),
        reaction=Reaction(reaction_delay, acceleration_noise, gap_noise),
    )
