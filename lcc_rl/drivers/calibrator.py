"""Calibration as described by a configuration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd
import torch

from lcc_rl.drivers.fit import DEFAULT_GENETIC, Calibration, fit
from lcc_rl.drivers.fit_error import OBJECTIVES, SPEED
from lcc_rl.drivers.genetic import GeneticSettings, Progress
from lcc_rl.drivers.observed import Selection, observe
from lcc_rl.drivers.parameters import IDM, MODES, Bounds, checked_bounds, fitted, law_of
from lcc_rl.errors import ConfigError, require_in, unknown_name
from lcc_rl.functional.driver_models import DriverConstants


@dataclass(frozen=True)
class Calibrator:
    """Calibration of all drivers in one or both modes.

    Args:
        modes: ``local``, ``global`` or both, each once.
        model: driver model, a key of :data:`lcc_rl.functional.laws.LAWS`.
        objective: what is minimised, see :class:`lcc_rl.drivers.fit_error.FitError`.
        holdout: share of each episode, its end, that is not fitted but predicted.
        bounds: lower and upper bound by parameter, in its unit.
        constants: parameters that the local mode does not fit, by name; None, or a parameter that
            is None: the model's default.
        selection: which episodes are used.
        local_genetic: genetic algorithm of the local mode.
        global_genetic: genetic algorithm of the global mode.
        choose_constants: first choose the local mode's constants over all drivers.

    Raises:
        ConfigError: if a mode, model or objective is unknown, a mode is named twice or not at
            all, a constant is none of the model's, or bounds are crossed.
    """

    modes: Sequence[str] = ("local",)
    model: str = IDM
    objective: str = SPEED
    holdout: float = 0.0
    bounds: Bounds | None = None
    constants: Mapping[str, float | None] | None = None
    selection: Selection = field(default_factory=Selection)
    local_genetic: GeneticSettings = DEFAULT_GENETIC["local"]
    global_genetic: GeneticSettings = DEFAULT_GENETIC["global"]
    choose_constants: bool = False

    def __post_init__(self) -> None:
        for mode in self.modes:
            fitted(mode, self.model)
        if not self.modes or len(set(self.modes)) < len(self.modes):
            raise ConfigError(
                f"calibration modes must be some of {', '.join(MODES)}, given once each, got "
                f"{list(self.modes)}"
            )
        if self.objective not in OBJECTIVES:
            raise unknown_name("calibration objective", self.objective, OBJECTIVES)
        require_in("calibration", "[0, 0.9]", holdout=self.holdout)
        checked_bounds(self.bounds)
        self.shared()

    def shared(self) -> DriverConstants:
        """Return what the local mode does not fit.

        Raises:
            ConfigError: if one is given that the model lacks.
        """
        law = law_of(self.model)
        given = {name: x for name, x in (self.constants or {}).items() if x is not None}
        for name in given:
            if name not in law.shared:
                raise unknown_name(f"constant of model {self.model}", name, law.shared)
        return law.constants(**given)

    def __call__(
        self,
        episodes: pd.DataFrame,
        seed: int = 0,
        device: torch.device | str = "cpu",
        progress: Progress | None = None,
    ) -> Calibration:
        """Calibrate the drivers of an episode table; see :func:`lcc_rl.drivers.fit.fit`.

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
                self.shared(),
                genetic[mode],
                seed,
                self.choose_constants and mode == "local",
                device,
                progress,
                self.model,
                self.objective,
                self.holdout,
            )
            for mode in self.modes
        ]
        report = list(observed.report)
        for mode, part in zip(self.modes, parts, strict=True):
            report += [f"{mode}: {line}" for line in part.report[len(observed.report) :]]
        return Calibration(pd.concat([part.drivers for part in parts], ignore_index=True), report)
