"""Calibration of IDM parameters of observed drivers, all drivers at once (A6)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.drivers.genetic import GeneticSettings, Progress, minimise
from lcc_rl.drivers.observed import Observed, observe
from lcc_rl.drivers.parameters import (
    COLUMNS,
    MODES,
    SHARED,
    Bounds,
    Limits,
    at_bound,
    checked_bounds,
)
from lcc_rl.drivers.speed_error import SpeedError
from lcc_rl.errors import ConfigError, DataError, unknown_name
from lcc_rl.functional.idm import IDMConstants

log = logging.getLogger("lcc_rl")

DEFAULT_GENETIC = {
    "local": GeneticSettings(population=32, generations=20),
    "global": GeneticSettings(population=64, generations=60),
}
# Genetic algorithms of the choice of constants: over constants, and within each over (v0, T).
OUTER = GeneticSettings(population=12, generations=12, founders=2, patience=4)
INNER = GeneticSettings(population=16, generations=8)


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
    constants: IDMConstants | None = None,
    genetic: GeneticSettings | None = None,
    seed: int = 0,
    choose_constants: bool = False,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate one driver per episode (A6), all of them at once.

    Args:
        episodes: an episode table, or the result of :func:`lcc_rl.drivers.observed.observe`.
        mode: ``local`` fits (v0, T), ``global`` fits (v0, T, a, b, s0).
        bounds: lower and upper bound by parameter; those not named keep their default.
        constants: parameters that are not fitted; by default a 1.0, b 1.5, s0 2.0.
        genetic: settings of the genetic algorithm; defaults depend on the mode.
        seed: seed of all randomness; equal seeds give equal drivers.
        choose_constants: in local mode, first choose (a, b, s0) by the mean error of all drivers.
        device: where to simulate, in float32; the reported errors are evaluated in float64.
        progress: called as ``progress(generation, total, text)``.

    Raises:
        ConfigError: if a mode, parameter or bound is unknown or impossible.
        DataError: if the table lacks a column or holds no usable episode, or an episode's error is
            no number whatever the parameters.
    """
    if mode not in MODES:
        raise unknown_name("calibration mode", mode, MODES)
    if choose_constants and mode != "local":
        raise ConfigError("choose_constants applies to local calibration only")
    limits, start = checked_bounds(bounds), constants or IDMConstants()
    observed = episodes if isinstance(episodes, Observed) else observe(episodes)
    search = _Search(observed.to(device, torch.float32), limits, seed, progress)
    return search.run(observed, mode, start, genetic or DEFAULT_GENETIC[mode], choose_constants)


@dataclass(frozen=True)
class _Search:
    """Genetic searches over one set of episodes.

    Args:
        observed: the episodes, on the device and in the precision of the simulation.
        limits: bounds of every parameter.
        seed: seed of every search.
        progress: see :func:`fit`.
    """

    observed: Observed
    limits: Limits
    seed: int
    progress: Progress | None

    def run(
        self,
        exact: Observed,
        mode: str,
        constants: IDMConstants,
        genetic: GeneticSettings,
        choose_constants: bool,
    ) -> Calibration:
        """Calibrate; ``exact`` holds the episodes in float64 on the CPU."""
        report = list(exact.report)
        if choose_constants:
            constants = self.chosen_constants(constants)
            report.append(
                f"constants chosen over all drivers: a {constants.acceleration:.3g} m/s², "
                f"b {constants.deceleration:.3g} m/s², s0 {constants.min_gap:.3g} m"
            )
        names = MODES[mode]
        error = SpeedError(self.observed, constants, names)
        log.info("drivers are simulated with %s", error.simulator)
        lower, upper = self.box(names)
        found = minimise(error, lower, upper, exact.count, self.generator(), genetic, self.progress)
        drivers = _table(exact, found.best, constants, mode, self.limits)
        return Calibration(drivers, report + _findings(drivers, self.limits))

    def chosen_constants(self, constants: IDMConstants) -> IDMConstants:
        """Choose (a, b, s0): an outer search whose objective is the mean error of local fits."""
        lower, upper = self.box(SHARED)
        error = partial(self.mean_error, constants)
        found = minimise(error, lower, upper, 1, self.generator(), OUTER, self.progress)
        return replace(constants, **dict(zip(SHARED, found.best[0].tolist(), strict=True)))

    def mean_error(self, constants: IDMConstants, candidates: Tensor) -> Tensor:
        """Mean error of local fits, ``[1, candidates]`` of constants ``[1, candidates, 3]``."""
        drivers, count = self.observed.count, candidates.shape[1]

        def error(genes: Tensor) -> Tensor:
            # Every pair of driver and candidate is a problem of its own.
            own = candidates[0].repeat_interleave(genes.shape[1], dim=0).unbind(-1)
            trial = constants.with_(**dict(zip(SHARED, own, strict=True)))
            side_by_side = genes.reshape(drivers, -1, genes.shape[-1])
            found = SpeedError(self.observed, trial, MODES["local"])(side_by_side)
            return found.reshape(genes.shape[:-1])

        lower, upper = self.box(MODES["local"])
        found = minimise(error, lower, upper, drivers * count, self.generator(), INNER)
        return found.fitness.reshape(drivers, count).mean(0, keepdim=True)

    def box(self, names: Sequence[str]) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of some parameters."""
        lower, upper = zip(*(self.limits[name] for name in names), strict=True)
        return self.observed.gap.new_tensor(lower), self.observed.gap.new_tensor(upper)

    def generator(self) -> torch.Generator:
        """A fresh generator with the seed."""
        return torch.Generator().manual_seed(self.seed)


def _table(
    observed: Observed,
    best: Tensor,
    constants: IDMConstants,
    mode: str,
    limits: Limits,
) -> pd.DataFrame:
    """Fitted parameters and errors, one row per driver."""
    names = MODES[mode]
    best = best.to("cpu", torch.float64)
    exact = SpeedError(observed.to("cpu", torch.float64), constants, names)
    columns: dict[str, Any] = {str(name): values for name, values in observed.identity.items()}
    fitted = dict(zip(names, best.numpy().T, strict=True))
    for name, column in COLUMNS.items():
        columns[column] = fitted.get(name, getattr(constants, name, None))
    columns["rmspe"] = exact(best.unsqueeze(1)).squeeze(1).numpy()
    lost = ~np.isfinite(columns["rmspe"])
    if lost.any():
        raise DataError(
            f"episode {columns['episode'].iloc[lost.argmax()]} (and {lost.sum() - 1} others): no "
            f"{mode} parameters within the bounds give a finite relative speed error; a follower "
            "that never moves has none, see selection.min_mean_speed_mps"
        )
    columns["samples"] = observed.samples
    for name in COLUMNS:
        columns[f"{name}_at_bound"] = name in fitted and at_bound(fitted[name], limits[name])
    columns["mode"] = mode
    # The episodes are sorted by length; the table has the order of the input.
    return pd.DataFrame(columns).sort_values("episode", kind="stable", ignore_index=True)


def _findings(drivers: pd.DataFrame, limits: Limits) -> list[str]:
    """Lines on the quality of the fit and on what it could not identify."""
    error = 100.0 * drivers["rmspe"]
    lines = [
        f"RMSPE of {len(drivers)} drivers: mean {error.mean():.2f} %, "
        f"median {error.median():.2f} %, worst {error.max():.1f} %"
    ]
    share = drivers["desired_speed_at_bound"].mean()
    if share > 0.0:
        low, high = limits["desired_speed"]
        lines.append(
            f"{100 * share:.0f} % of the desired speeds lie on a bound ({low:g} or {high:g} m/s): "
            "congested traffic does not tell how fast these drivers would like to go"
        )
    return lines
