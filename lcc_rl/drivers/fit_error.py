"""Error of simulated followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.observed import Observed
from lcc_rl.functional.driver_models import DriverConstants, follow
from lcc_rl.functional.recorder import Untranslatable

log = logging.getLogger("lcc_rl")

SPEED_RMSPE, GAP_RMSE, GAP_NRMSE = "speed_rmspe", "gap_rmse", "gap_nrmse"
# Errors that a calibration may minimise; ``both`` is the sum of the two relative errors.
FitMeasure = Literal["speed_rmspe", "gap_rmse", "gap_nrmse", "both"]


class FitError:
    """Error of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.driver_models.follow`. Only the error is
    stored, and no episode is simulated beyond its end. On a CPU the simulation is the compiled
    :func:`lcc_rl.drivers.kernel.squared_errors`.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        law: the driver model with its other parameters.
        names: the candidates' parameters, in the order of the last dimension.
        objective: the error: ``speed_rmspe``, √(Σ(v_sim − v_obs)²/Σv_obs²); ``gap_rmse``, the root
            mean square error of the gap [m]; ``gap_nrmse``, that of the gap relative to the
            observed gap; or ``both``, the sum of both relative errors.
    """

    def __init__(
        self,
        observed: Observed,
        law: DriverConstants,
        names: Sequence[str],
        objective: FitMeasure = "speed_rmspe",
    ) -> None:
        self.observed, self.law, self.objective = observed, law, objective
        self.names = tuple(names)
        series = (observed.follower_speed, observed.gaps)
        self._norms = [values.square().sum(0).unsqueeze(-1) for values in series]
        self._samples = observed.gaps.new_tensor(observed.samples.tolist()).unsqueeze(-1)
        self.compiled = observed.gaps.device.type == "cpu"
        if self.compiled:
            all_series = (observed.leader_speed, *series)
            by_driver = [values.T.contiguous().numpy() for values in all_series]
            self._episodes = (*by_driver, np.array(observed.samples))

    def __call__(self, candidates: Tensor) -> Tensor:
        """Return the error ``[drivers, candidates]`` for ``[drivers, candidates, dims]``.

        The law's parameters may be tensors that broadcast to ``[drivers, candidates]``.
        """
        measures = self.measures(candidates, self.objective != SPEED_RMSPE)
        if self.objective in measures:
            return measures[self.objective]
        return measures[SPEED_RMSPE] + measures[GAP_NRMSE]

    def measures(self, candidates: Tensor, apart: bool = True) -> dict[str, Tensor]:
        """Return every error by name, each as :meth:`__call__` does.

        Args:
            candidates: see :meth:`__call__`.
            apart: compute the errors of the gap; else they are zero.
        """
        with torch.no_grad():
            simulate = self._by_kernel if self.compiled else self._by_tensors
            speed, gap = simulate(self.parameters(candidates), apart)
            return {
                SPEED_RMSPE: (speed / self._norms[0]).sqrt(),
                GAP_RMSE: (gap / self._samples).sqrt(),
                GAP_NRMSE: (gap / self._norms[1]).sqrt(),
            }

    def parameters(self, candidates: Tensor) -> dict[str, Tensor]:
        """Return the parameters of every candidate by name, ``[drivers, candidates]``."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        like: dict[str, Any] = {"dtype": self.observed.gaps.dtype, "device": candidates.device}
        return {
            name: torch.as_tensor(given.get(name, getattr(self.law, name, None)), **like)
            .expand(candidates.shape[:-1])
            .contiguous()
            for name in self.law.table()
        }

    def _by_tensors(self, parameters: dict[str, Tensor], apart: bool) -> tuple[Tensor, Tensor]:
        """Return sums of squared errors, ``[drivers, candidates]``; all drivers step by step."""
        observed = self.observed
        shape = parameters["time_gap"].shape
        first = observed.follower_speed[0], observed.gaps[0]
        speed, gap = (values.unsqueeze(-1).expand(shape) for values in first)
        totals = torch.zeros((2, *shape)).to(speed)
        for start, stop, active in observed.segments():
            v0, headway, *shared = (values[:active] for values in parameters.values())
            law = self.law.with_(**dict(zip(self.law.shared(), shared, strict=True)))
            leader, truth, seen = (
                values[start : stop + 1, :active].unsqueeze(-1)
                for values in (observed.leader_speed, observed.follower_speed, observed.gaps)
            )
            begin = (speed[:active], gap[:active])
            motion = follow(law, leader, *begin, (v0, headway), observed.time_step)
            for step, (speed, gap, _) in enumerate(motion, 1):
                totals[0, :active] += (speed - truth[step]).square()
                if apart:
                    totals[1, :active] += (gap - seen[step]).square()
        return totals[0], totals[1]

    def _by_kernel(self, parameters: dict[str, Tensor], apart: bool) -> tuple[Tensor, Tensor]:
        """Return the same by the kernel, driver by driver."""
        from lcc_rl.drivers.kernel import squared_errors  # here: numba loads for half a second

        observed, dtype = self.observed, self.observed.gaps.dtype
        try:
            simulate = squared_errors(self.law, observed.time_step, dtype)
        except Untranslatable as error:
            log.info("%s is simulated by tensors: %s", type(self.law).__name__, error)
            self.compiled = False
            return self._by_tensors(parameters, apart)
        totals = torch.empty((2, *parameters["time_gap"].shape), dtype=dtype)
        own = tuple(value.numpy() for value in parameters.values())
        simulate(apart or None, *self._episodes, own, totals.numpy())
        return totals[0], totals[1]
