"""Calibration as described by a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import pandas as pd
import torch

from lcc_rl.drivers.genetic import GeneticSettings, Progress
from lcc_rl.drivers.idm_fit import DEFAULT_GENETIC, Calibration, fit
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.drivers.parameters import MODES, Bounds, checked_bounds
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.functional.idm import IDMConstants


@dataclass(frozen=True)
class Calibrator:
    """Calibration of all drivers in one or both modes.

    Args:
        modes: ``local``, ``global`` or both, each once.
        bounds: lower and upper bound by parameter, in its unit.
        constants: parameters that the local mode does not fit.
        selection: which episodes are used.
        local_genetic: genetic algorithm of the local mode.
        global_genetic: genetic algorithm of the global mode.
        choose_constants: first choose the local mode's constants over all drivers.

    Raises:
        ConfigError: if a mode is unknown, or named twice or not at all, or bounds are crossed.
    """

    modes: Sequence[str] = ("local",)
    bounds: Bounds | None = None
    constants: IDMConstants = field(default_factory=IDMConstants)
    selection: Selection = field(default_factory=Selection)
    local_genetic: GeneticSettings = DEFAULT_GENETIC["local"]
    global_genetic: GeneticSettings = DEFAULT_GENETIC["global"]
    choose_constants: bool = False

    def __post_init__(self) -> None:
        for mode in self.modes:
            if mode not in MODES:
                raise unknown_name("calibration mode", mode, MODES)
        if not self.modes or len(set(self.modes)) < len(self.modes):
            raise ConfigError(f"calibration modes must be given once each, got {list(self.modes)}")

        checked_bounds(self.bounds)

    def __call__(
        self,
        episodes: pd.DataFrame,
        seed: int = 0,
        device: torch.device | str = "cpu",
        progress: Progress | None = None,
    ) -> Calibration:
        """Calibrate the drivers of an episode table; see :func:`lcc_rl.drivers.idm_fit.fit`.

        Returns:
            The drivers of all modes, with the column ``mode``, and one report.
        """
        observed = observe(episodes, self.selection)
        genetic = {"local": self.local_genetic, "global": self.global_genetic}
        parts = [
            fit(
                observed,
                mode,
                self.bounds,
                self.constants,
                genetic[mode],
                seed,
                self.choose_constants and mode == "local",
                device,
                progress,
            )
            for mode in self.modes
        ]
        report = list(observed.report)
        for mode, part in zip(self.modes, parts, strict=True):
            report += [f"{mode}: {line}" for line in part.report[len(observed.report) :]]
        return Calibration(pd.concat([part.drivers for part in parts], ignore_index=True), report)
