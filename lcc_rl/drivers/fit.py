"""Calibration of the parameters of observed drivers, all drivers at once (A6)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.drivers.fit_error import GAP, GAP_SHARE, SPEED, FitError
from lcc_rl.drivers.genetic import GeneticSettings, Progress, minimise
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import (
    COLUMNS,
    IDM,
    MODEL,
    Bounds,
    Limits,
    at_bound,
    checked_bounds,
    fitted,
    law_of,
)
from lcc_rl.errors import ConfigError, DataError, require_in
from lcc_rl.functional.driver_models import DriverConstants

log = logging.getLogger("lcc_rl")

DEFAULT_GENETIC = {
    "local": GeneticSettings(population=32, generations=20),
    "global": GeneticSettings(population=64, generations=60),
}
# Genetic algorithms of the choice of constants: over constants, and within each over (v0, T).
OUTER = GeneticSettings(population=12, generations=12, founders=2, patience=4)
INNER = GeneticSettings(population=16, generations=8)

# Columns of the errors; those of the part held out end in ``_out``.
ERRORS = {SPEED: "rmspe", GAP: "gap_rmse_m", GAP_SHARE: "gap_nrmse"}
OUT = "_out"


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Args:
        drivers: one row per driver, in the order of the episodes in the input.
        report: what was dropped, chosen and found, in plain lines.
    """

    drivers: pd.DataFrame
    report: list[str]


def fit(
    episodes: pd.DataFrame | Observed,
    mode: str = "local",
    bounds: Bounds | None = None,
    constants: DriverConstants | None = None,
    genetic: GeneticSettings | None = None,
    seed: int = 0,
    choose_constants: bool = False,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
    model: str = IDM,
    objective: str = SPEED,
    holdout: float = 0.0,
) -> Calibration:
    """Calibrate one driver per episode (A6), all of them at once.

    Args:
        episodes: an episode table, or the result of :func:`lcc_rl.drivers.observed.observe`.
        mode: ``local`` fits (v0, T), ``global`` all parameters of the model.
        bounds: lower and upper bound by parameter; those not named keep their default.
        constants: parameters that are not fitted; None: the model's defaults.
        genetic: settings of the genetic algorithm; defaults depend on the mode.
        seed: seed of all randomness; equal seeds give equal drivers.
        choose_constants: in local mode, first choose what drivers share by the mean error of all.
        device: where to simulate, in float32; the reported errors are evaluated in float64.
        progress: called as ``progress(generation, total, text)``.
        model: driver model, a key of :data:`lcc_rl.functional.laws.LAWS`.
        objective: what is minimised, see :class:`lcc_rl.drivers.fit_error.FitError`.
        holdout: share of each episode, its end, that is not fitted; the errors there, from the
            observed state at the cut, are columns of their own.

    Raises:
        ConfigError: if a mode, model, objective, parameter or bound is unknown or impossible.
        DataError: if the table lacks a column or holds no usable episode, or an episode's error is
            no number whatever the parameters.
    """
    if choose_constants and mode != "local":
        raise ConfigError("choose_constants applies to local calibration only")
    require_in("calibration", "[0, 0.9]", holdout=holdout)
    names, limits = fitted(mode, model), checked_bounds(bounds)
    start = constants or law_of(model).constants()
    if not isinstance(start, law_of(model).constants):
        raise ConfigError(f"constants of {model} expected, got {type(start).__name__}")
    observed = episodes if isinstance(episodes, Observed) else observe(episodes)
    inside, outside = observed.split(holdout) if holdout else (observed, None)
    simulated = inside.to(device, torch.float32)
    search = _Search(simulated, names, model, objective, limits, seed, progress)
    chosen, report = start, list(observed.report)
    if choose_constants:
        chosen, line = search.chosen_constants(start)
        report.append(line)
    best = search.best(chosen, genetic or DEFAULT_GENETIC[mode])
    drivers = _table(observed, best, chosen, names, model, limits)
    _add_errors(drivers, [inside, outside], best, chosen, names, model)
    _check_errors(drivers, objective, mode)
    for name in law_of(model).parameters:
        drivers[f"{name}_at_bound"] = drivers.pop(f"{name}_at_bound")  # after the errors
    drivers["mode"], drivers[MODEL] = mode, model
    # The episodes are sorted by length; the table has the order of the input.
    drivers = drivers.sort_values("episode", kind="stable", ignore_index=True)
    return Calibration(drivers, report + _findings(drivers, limits))


@dataclass(frozen=True)
class _Search:
    """Genetic searches over one set of episodes.

    Args:
        observed: the episodes, on the device and in the precision of the simulation.
        names: the parameters that are fitted.
        model: the driver model.
        objective: what is minimised.
        limits: bounds of every parameter.
        seed: seed of every search.
        progress: see :func:`fit`.
    """

    observed: Observed
    names: tuple[str, ...]
    model: str
    objective: str
    limits: Limits
    seed: int
    progress: Progress | None

    def best(self, constants: DriverConstants, genetic: GeneticSettings) -> Tensor:
        """Return the fitted parameters, ``[drivers, dims]``, float64 on the CPU."""
        error = self.error(constants)
        log.info("drivers are simulated with %s", error.simulator)
        lower, upper = self.box(self.names)
        count, generator = self.observed.count, self.generator()
        found = minimise(error, lower, upper, count, generator, genetic, self.progress)
        return found.best.to("cpu", torch.float64)

    def error(self, constants: DriverConstants) -> FitError:
        """Return what is minimised, as a function of the fitted parameters."""
        return FitError(self.observed, constants, self.names, self.model, self.objective)

    def chosen_constants(self, constants: DriverConstants) -> tuple[DriverConstants, str]:
        """Choose what drivers share, by a search whose objective is the mean error of local fits.

        Returns:
            The constants, and a line about them.
        """
        shared = law_of(self.model).shared
        lower, upper = self.box(shared)
        error = partial(self.mean_error, constants)
        found = minimise(error, lower, upper, 1, self.generator(), OUTER, self.progress)
        values = dict(zip(shared, found.best[0].tolist(), strict=True))
        shown = ", ".join(f"{COLUMNS[name]} {value:.3g}" for name, value in values.items())
        return constants.with_(**values), f"constants chosen over all drivers: {shown}"

    def mean_error(self, constants: DriverConstants, candidates: Tensor) -> Tensor:
        """Mean error of local fits, ``[1, candidates]`` of ``[1, candidates, constants]``."""
        drivers, count = self.observed.count, candidates.shape[1]
        shared = law_of(self.model).shared

        def error(genes: Tensor) -> Tensor:
            # Every pair of driver and candidate is a problem of its own.
            own = candidates[0].repeat_interleave(genes.shape[1], dim=0).unbind(-1)
            trial = constants.with_(**dict(zip(shared, own, strict=True)))
            side_by_side = genes.reshape(drivers, -1, genes.shape[-1])
            return self.error(trial)(side_by_side).reshape(genes.shape[:-1])

        lower, upper = self.box(self.names)
        found = minimise(error, lower, upper, drivers * count, self.generator(), INNER)
        return found.fitness.reshape(drivers, count).mean(0, keepdim=True)

    def box(self, names: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of some parameters."""
        lower, upper = zip(*(self.limits[name] for name in names), strict=True)
        return self.observed.gaps.new_tensor(lower), self.observed.gaps.new_tensor(upper)

    def generator(self) -> torch.Generator:
        """A fresh generator with the seed."""
        return torch.Generator().manual_seed(self.seed)


def _table(
    observed: Observed,
    best: Tensor,
    constants: DriverConstants,
    names: Sequence[str],
    model: str,
    limits: Limits,
) -> pd.DataFrame:
    """Identities and fitted parameters, one row per driver, and which lie on a bound."""
    columns: dict[str, Any] = {str(name): values for name, values in observed.identity.items()}
    own = dict(zip(names, best.numpy().T, strict=True))
    for name in law_of(model).parameters:
        columns[COLUMNS[name]] = own.get(name, getattr(constants, name, None))
    for name in law_of(model).parameters:
        columns[f"{name}_at_bound"] = name in own and at_bound(own[name], limits[name])
    return pd.DataFrame(columns)


def _add_errors(
    drivers: pd.DataFrame,
    parts: Sequence[Observed | None],
    best: Tensor,
    constants: DriverConstants,
    names: Sequence[str],
    model: str,
) -> None:
    """Add the errors in and out of sample, evaluated in float64, and the number of samples."""
    for part, end in zip(parts, ("", OUT), strict=True):
        if part is None:
            continue
        exact = FitError(part.to("cpu", torch.float64), constants, names, model)
        measures = exact.measures(best.unsqueeze(1))
        for name, column in ERRORS.items():
            drivers[column + end] = measures[name].squeeze(1).numpy()
        drivers[f"samples{end}"] = part.samples


def _check_errors(drivers: pd.DataFrame, objective: str, mode: str) -> None:
    """Raise a DataError where no parameters give an error that is a number."""
    needed = [ERRORS[objective]] if objective in ERRORS else [ERRORS[SPEED], ERRORS[GAP_SHARE]]
    lost = ~np.isfinite(drivers[needed].to_numpy()).all(axis=1)
    if lost.any():
        raise DataError(
            f"episode {drivers['episode'].iloc[lost.argmax()]} (and {lost.sum() - 1} others): no "
            f"{mode} parameters within the bounds give a finite {objective}; a follower that never "
            "moves has no relative speed error, see selection.min_mean_speed_mps"
        )


def _findings(drivers: pd.DataFrame, limits: Limits) -> list[str]:
    """Lines on the quality of the fit and on what it could not identify."""
    error = 100.0 * drivers["rmspe"]
    lines = [
        f"RMSPE of {len(drivers)} drivers: mean {error.mean():.2f} %, "
        f"median {error.median():.2f} %, worst {error.max():.1f} %"
    ]
    for end, part in (("", "fitted"), (OUT, "held out")):
        if f"gap_rmse_m{OUT}" in drivers:
            speed, gap = 100.0 * drivers[f"rmspe{end}"], drivers[f"gap_rmse_m{end}"]
            lines.append(f"{part}: RMSPE {speed.mean():.2f} %, gap RMSE {gap.mean():.2f} m (means)")
    share = drivers["desired_speed_at_bound"].mean()
    if share > 0.0:
        low, high = limits["desired_speed"]
        lines.append(
            f"{100 * share:.0f} % of the desired speeds lie on a bound ({low:g} or {high:g} m/s): "
            "congested traffic does not tell how fast these drivers would like to go"
        )
    return lines
