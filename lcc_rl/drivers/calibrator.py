"""Calibration of the parameters of observed drivers, all drivers at once (A6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Annotated, Any

import numpy as np
import pandas as pd
import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.drivers.fit_error import (
    GAP_NRMSE,
    GAP_RMSE,
    SPEED_RMSPE,
    FitError,
    FitMeasure,
    intervals,
)
from lcc_rl.drivers.genetic import GeneticSettings, Progress, minimise, polish
from lcc_rl.drivers.observed import Observed, Selection, observe
from lcc_rl.drivers.parameters import (
    DEFAULT_BOUNDS,
    DEFAULT_MODEL,
    MODEL,
    REACTION,
    BoundPair,
    Mode,
    at_bound,
    find_law,
    fitted,
)
from lcc_rl.drivers.twins import HELD, accelerate, compare_twins, measure_recorded
from lcc_rl.errors import Concern, ConfigError, DataError, require_known
from lcc_rl.functional.driver_models import INDIVIDUAL, PARAMETERS, DriverConstants, Reaction
from lcc_rl.functional.laws import LAWS
from lcc_rl.settings import Positive, Settings

# Columns of the errors; those of the held-out part end in ``_out``.
ERROR_COLUMNS = {SPEED_RMSPE: "rmspe", GAP_RMSE: "gap_rmse_m", GAP_NRMSE: "gap_nrmse"}
OUT = "_out"
GAPS_OFF, BADLY_OFF = 0.1, 0.4  # reported relative errors of gaps: not fitted, and fitted
MEAN_SPEED, MEAN_GAP, EQUILIBRIUM = "mean_speed_mps", "mean_gap_m", "equilibrium_gap_m"
IMPLAUSIBLE = 1.0  # relative error of the median driver's gap from which the report warns
CONGESTED = "; it is unknown for followers that never drive freely"


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Args:
        drivers: one row per driver, in the order of the episodes in the input.
        compared: returns both attributes below; called when one of them is read.

    Attributes:
        report: lines on dropped episodes and errors.
        twins: results of :func:`lcc_rl.drivers.twins.compare_twins` for the recorded and the
            calibrated drivers, with the column mode.
    """

    drivers: pd.DataFrame
    compared: Callable[[], tuple[list[str], pd.DataFrame]]

    @property
    def report(self) -> list[str]:
        return self.compared()[0]

    @property
    def twins(self) -> pd.DataFrame:
        return self.compared()[1]


DEFAULT_CONSTANTS = dict.fromkeys(list(PARAMETERS)[len(INDIVIDUAL) :])


class Calibrator(Settings):
    """Calibration of one driver per episode in one or both modes, all drivers at once (A6).

    The mode ``local`` fits (v0, T), ``global`` all parameters of the model.
    """

    modes: Annotated[Sequence[Mode], Field(min_length=1)] = ("local",)
    model: str = DEFAULT_MODEL  # idm, ovm, fvdm, gipps or the dotted path of your own class
    objective: FitMeasure = "speed_rmspe"  # see lcc_rl.drivers.fit_error.FitError
    # Share of each episode, at its end, that is predicted and not fitted.
    holdout: Annotated[float, Field(ge=0.0, le=0.9)] = 0.0
    # Lower and upper bound by parameter, see lcc_rl.functional.driver_models.PARAMETERS.
    bounds: Mapping[str, BoundPair] = field(default_factory=lambda: dict(DEFAULT_BOUNDS))
    # Parameters that the local mode does not fit; None: the default of the driver model.
    constants: Mapping[str, Positive | None] = field(
        default_factory=lambda: dict(DEFAULT_CONSTANTS)
    )
    # Choose a shared reaction delay and acceleration noise with which the drivers' energy equals
    # that of the recorded drivers; see lcc_rl.drivers.twins.
    reaction: bool = False
    perception: bool = False  # try noises of the perceived gap, too; see lcc_rl.drivers.twins
    selection: Selection = field(default_factory=Selection)
    local_genetic: GeneticSettings = field(default_factory=GeneticSettings)
    global_genetic: GeneticSettings = field(
        default_factory=lambda: GeneticSettings(population=64, generations=60)
    )

    def validate(self) -> None:
        if self.perception and not self.reaction:
            raise ConfigError("perception chooses a part of the reaction: set reaction=true, too")
        law = find_law(self.model)
        given = {name: x for name, x in self.constants.items() if x is not None}
        require_known(f"constant of model {self.model}", given, law.shared())
        self.shared: DriverConstants = law(**given)
        table = {**PARAMETERS, **law.own}
        require_known("parameter", self.bounds, table)
        self.bounds = {**{name: one.bounds for name, one in table.items()}, **self.bounds}
        for name, (lower, upper) in self.bounds.items():
            low, high = table[name].plausible
            if not low <= lower < upper <= high:
                raise ConfigError(
                    f"bounds of {name!r} must be {low:g} <= lower < upper <= {high:g}, "
                    f"got [{lower:g}, {upper:g}]"
                )

    def __call__(
        self,
        episodes: pd.DataFrame | Observed,
        seed: int = 0,
        device: torch.device | str = "cpu",
        progress: Progress | None = None,
    ) -> Calibration:
        """Calibrate the drivers of an episode table.

        Args:
            episodes: the table, or the result of :func:`lcc_rl.drivers.observed.observe`.
            seed: seed of all random numbers; equal seeds give equal drivers.
            device: device of the simulation in float32; reported errors are computed in float64.
            progress: called as ``progress(generation, total, text)``.

        Returns:
            The drivers of all modes, with the column ``mode``, and one report.

        Raises:
            DataError: if the table lacks a column or a usable episode, or an episode's error is not
                finite for any parameters.
        """
        observed = episodes
        if not isinstance(observed, Observed):
            observed = observe(observed, self.selection)
        if self.reaction and not accelerate(measure_recorded(observed)):
            raise DataError(f"{HELD}: too little to choose a reaction by; use calibration=local")
        fits = {
            mode: _Fit(self, mode, observed, seed, device, progress).drivers()
            for mode in dict.fromkeys(self.modes)
        }

        @cache
        def twins(mode: Mode) -> tuple[Reaction, pd.DataFrame, list[str]]:
            return compare_twins(observed, fits[mode][0], self.reaction, progress, self.perception)

        @cache
        def compared() -> tuple[list[str], pd.DataFrame]:
            lines = [
                type(line)(f"{mode}: {line}")
                for mode, (_, found) in fits.items()
                for line in [*found, *twins(mode)[2]]
            ]
            parts = [twins(mode)[1].assign(mode=mode) for mode in fits]
            return [*observed.report, *lines], pd.concat(parts, ignore_index=True)

        parts = []
        for mode, (drivers, _) in fits.items():
            own = vars(twins(mode)[0]) if self.reaction else {}
            parts.append(drivers.assign(**{REACTION[name][0]: x for name, x in own.items()}))
        return Calibration(pd.concat(parts, ignore_index=True), compared)


class _Fit:
    """Calibration in one mode; arguments as for :class:`Calibrator`."""

    def __init__(
        self,
        settings: Calibrator,
        mode: str,
        observed: Observed,
        seed: int,
        device: torch.device | str,
        progress: Progress | None,
    ) -> None:
        self.settings, self.mode, self.observed = settings, mode, observed
        self.seed, self.progress = seed, progress
        self.model, self.table_of = settings.model, LAWS[settings.model].table()
        self.names, self.limits = fitted(mode, self.model), settings.bounds
        self.parts = {"": observed}
        if settings.holdout:
            self.parts[""], self.parts[OUT] = observed.split(settings.holdout)
        law, objective = settings.shared, settings.objective
        error = partial(FitError, law=law, names=self.names, objective=objective)
        self.error = error(self.parts[""].to(device, torch.float32))
        self.exact = {end: error(x.to("cpu", torch.float64)) for end, x in self.parts.items()}

    def drivers(self) -> tuple[pd.DataFrame, list[str]]:
        """Return one row per driver, and the lines of the report."""
        settings, lines = self.settings, list[str]()
        genetic = getattr(settings, f"{self.mode}_genetic")
        gaps, generator = self.error.observed.gaps, torch.Generator().manual_seed(self.seed)
        lower, upper = gaps.new_tensor([self.limits[name] for name in self.names]).T
        args = lower, upper, self.observed.count, generator, genetic, self.progress
        found = minimise(self.error, *args)
        box = (x.to("cpu", torch.float64) for x in (found, lower, upper))
        best, solved = polish(self.exact[""].terms, *box)
        drivers = self.table(best, solved)
        if falling := int((~solved).sum()):
            line = f"{falling} of {len(drivers)} records have not converged and have no intervals"
            more = f"calibration.{self.mode}_genetic.generations={3 * genetic.generations}"
            lines.append(Concern(f"{line}: more generations? ({more})"))
        return drivers, [*lines, *self.quality(drivers), *map(Concern, self.concerns(drivers))]

    def table(self, best: Tensor, solved: Tensor) -> pd.DataFrame:
        """Return identities, parameters ``[drivers, names]``, errors and flags, a row per driver.

        Drivers whose search has not ended in a minimum, ``[drivers]``, have no intervals.

        Raises:
            DataError: if no parameters give a finite error.
        """
        constants = self.settings.shared
        columns: dict[str, Any] = {str(key): held for key, held in self.observed.identity.items()}
        own = dict(zip(self.names, best.numpy().T, strict=True))
        for name, one in self.table_of.items():
            columns[one.column] = own.get(name, getattr(constants, name, None))
        columns |= self.equilibrium(own)
        for end, error in self.exact.items():
            measures = error.measures(best.unsqueeze(1))
            for name, column in ERROR_COLUMNS.items():
                columns[column + end] = measures[name].squeeze(1).numpy()
            columns[f"samples{end}"] = self.parts[end].samples
        for name in self.table_of:
            columns[f"{name}_at_bound"] = name in own and at_bound(own[name], self.limits[name])
        drivers = pd.DataFrame({**columns, "mode": self.mode, MODEL: self.model})
        needed = [ERROR_COLUMNS[name] for name in self.exact[""].summands]
        lost = ~np.isfinite(drivers[needed].to_numpy()).all(axis=1)
        if lost.any():
            raise DataError(
                f"episode {drivers['episode'].iloc[lost.argmax()]} (and {lost.sum() - 1} others): "
                f"no {self.mode} parameters within the bounds give a finite "
                f"{self.settings.objective}; a follower that never moves has no relative speed "
                "error, see selection.min_mean_speed_mps"
            )
        ends = intervals(self.exact[""], best, [self.limits[name] for name in self.names])
        for end, values in zip(("low", "high"), ends, strict=True):
            values[~solved] = torch.nan
            drivers[[f"{self.table_of[x].column}_{end}" for x in self.names]] = values.numpy()
        # The episodes are sorted by length; the table has the order of the input.
        return drivers.sort_values("episode", kind="stable", ignore_index=True)

    def equilibrium(self, own: Mapping[str, Any]) -> dict[str, Any]:
        """Return each record's mean speed and gap, and the equilibrium gap at this speed."""
        seen, samples = self.observed, torch.tensor(self.observed.samples)
        speed, gap = (x.cpu().sum(0) / samples for x in (seen.follower_speed, seen.gaps))
        given = {name: torch.tensor(values) for name, values in own.items()}
        v0, headway = (given.pop(name) for name in INDIVIDUAL)
        steady = self.settings.shared.with_(**given).equilibrium_gap(speed, v0, headway)
        found = {MEAN_SPEED: speed, MEAN_GAP: gap, EQUILIBRIUM: steady}
        return {name: values.numpy() for name, values in found.items()}

    def quality(self, drivers: pd.DataFrame) -> list[str]:
        """Return lines on the errors of the fit and on the intervals."""
        error = 100.0 * drivers["rmspe"]
        lines = [
            f"RMSPE of {count_records(drivers)}: mean {error.mean():.2f} %, "
            f"median {error.median():.2f} %, worst {error.max():.1f} %"
        ]
        for end, part in (("", "fitted"), (OUT, "held out")):
            if f"gap_rmse_m{end}" in drivers:
                speed, gap, share = (drivers[f"{x}{end}"].mean() for x in ERROR_COLUMNS.values())
                both = f"RMSPE {100.0 * speed:.2f} %, gap RMSE {gap:.2f} m, {100.0 * share:.1f} %"
                lines.append(f"{part}: {both} of the gap (means)")
        v0, headway = (self.table_of[x].column for x in INDIVIDUAL)
        open_share = 100 * drivers[[f"{v0}_low", f"{v0}_high"]].isna().any(axis=1).mean()
        width = (drivers[f"{headway}_high"] - drivers[f"{headway}_low"]).median()
        of_t = f"; median width of T {width:.2g} s" * bool(width > 0.0)
        return [
            *lines,
            f"95 % intervals: v0 is not identified for {open_share:.0f} % of the records (an end "
            f"is not within calibration.bounds){of_t}",
        ]

    def concerns(self, drivers: pd.DataFrame) -> list[str]:
        """Return lines on gaps that are off and on unidentified parameters."""
        speed, share = drivers["rmspe"].mean(), drivers["gap_nrmse"].mean()
        concerns = []
        apart = self.settings.objective == SPEED_RMSPE
        if share > (max(GAPS_OFF, 3.0 * speed) if apart else BADLY_OFF):
            cure = "calibration.objective=both fits gaps, too"
            hint = cure if apart else "are they to one leader?"
            concerns.append(
                f"gaps are off by {100.0 * share:.0f} %, speeds by {100.0 * speed:.1f} %: {hint}"
            )
        for name in self.names:
            bound = drivers[f"{name}_at_bound"]
            if bound.any():
                low, high = self.limits[name]
                column = self.table_of[name].column
                upper = drivers[column] > (low + high) / 2
                shares = [100 * (bound & side).mean() for side in (~upper, upper)]
                concerns.append(
                    f"{100 * bound.mean():.0f} % of the values of {column} lie on a bound: "
                    f"{shares[0]:.0f} % on {low:g}, {shares[1]:.0f} % on {high:g} "
                    f"(calibration.bounds.{name}){CONGESTED if name == 'desired_speed' else ''}"
                )
        off = 100.0 * drivers["gap_nrmse"].median()
        if off > 100.0 * IMPLAUSIBLE:
            concerns.append(
                f"IMPLAUSIBLE FIT: the gap of the median driver is off by {off:.0f} %; are speeds "
                "in km/h or ft/s, or gaps and positions in feet, in columns of m/s and m "
                "(data.units)?"
            )
        return concerns


def count_records(drivers: pd.DataFrame) -> str:
    """Return the numbers of fitted records and of drivers as text."""
    people = len(drivers[["recording", "follower_id"]].drop_duplicates())
    counted = f"{people} driver{'s' * (people > 1)}"
    return counted if people == len(drivers) else f"{len(drivers)} records of {counted}"
