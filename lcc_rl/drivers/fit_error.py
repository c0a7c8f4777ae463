"""Error of simulated followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.parameters import COLUMNS, IDM
from lcc_rl.functional.driver_models import DriverConstants
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.laws import LAWS

SPEED, GAP, GAP_SHARE = "speed_rmspe", "gap_rmse", "gap_nrmse"
# What a calibration may minimise; ``both`` is the sum of the two relative errors.
Objective = Literal["speed_rmspe", "gap_rmse", "gap_nrmse", "both"]
OVMS = ("ovm", "fvdm")  # simulated alike; λ of the first is zero


class FitError:
    """Error of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.idm.simulate_follower`, but only the error
    is kept, and no episode is simulated beyond its end. On a CPU, the simulation is the compiled
    :func:`lcc_rl.drivers.kernel.squared_errors`.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        constants: parameters that are not among the candidates'.
        names: the candidates' parameters, in the order of the last dimension.
        model: the driver model.
        objective: which error: of the speed, √(Σ(v_sim − v_obs)²/Σv_obs²) (``speed_rmspe``); of
            the gap, the root of the mean square [m] (``gap_rmse``) or relative to the observed
            one as of the speed (``gap_nrmse``); or the sum of both relative ones (``both``).
    """

    def __init__(
        self,
        observed: Observed,
        constants: DriverConstants,
        names: Sequence[str],
        model: str = IDM,
        objective: Objective = "speed_rmspe",
    ) -> None:
        self.model, self.objective = model, objective
        self.observed, self.constants, self.names = observed, constants, tuple(names)
        series = (observed.follower_speed, observed.gaps)
        self._norms = [values.square().sum(0).unsqueeze(-1) for values in series]
        self._samples = observed.gaps.new_tensor(observed.samples.tolist()).unsqueeze(-1)
        self.compiled = observed.gaps.device.type == "cpu"
        if self.compiled:
            all_series = (observed.leader_speed, *series)
            by_driver = [values.T.contiguous().numpy() for values in all_series]
            self._episodes = (*by_driver, np.array(observed.samples))

    def __call__(self, candidates: Tensor) -> Tensor:
        """Return the error ``[drivers, candidates]`` of ``[drivers, candidates, dims]``.

        The constants may be tensors that broadcast to ``[drivers, candidates]``.
        """
        measures = self.measures(candidates, self.objective != SPEED)
        if self.objective in measures:
            return measures[self.objective]
        return measures[SPEED] + measures[GAP_SHARE]

    def measures(self, candidates: Tensor, apart: bool = True) -> dict[str, Tensor]:
        """Return every error by name, each as :meth:`__call__` does.

        Args:
            candidates: see there.
            apart: whether the errors of the gap are wanted; without them they are zero.
        """
        with torch.no_grad():
            simulate = self._by_kernel if self.compiled else self._by_tensors
            speed, gap = simulate(self._parameters(candidates), apart)
            return {
                SPEED: (speed / self._norms[0]).sqrt(),
                GAP: (gap / self._samples).sqrt(),
                GAP_SHARE: (gap / self._norms[1]).sqrt(),
            }

    def _parameters(self, candidates: Tensor) -> dict[str, Tensor]:
        """Return the parameters of every candidate by name, ``[drivers, candidates]``."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        like: dict[str, Any] = {"dtype": self.observed.gaps.dtype, "device": candidates.device}
        return {
            name: torch.as_tensor(given.get(name, getattr(self.constants, name, 0.0)), **like)
            .expand(candidates.shape[:-1])
            .contiguous()
            for name in COLUMNS
        }

    def _by_tensors(self, parameters: dict[str, Tensor], apart: bool) -> tuple[Tensor, Tensor]:
        """Sums of squared errors, ``[drivers, candidates]``: all of them a step at a time."""
        observed, law = self.observed, LAWS[self.model]
        shape = parameters["time_gap"].shape
        first = observed.follower_speed[0], observed.gaps[0]
        speed, gap = (values.unsqueeze(-1).expand(shape) for values in first)
        totals = torch.zeros((2, *shape)).to(speed)
        for start, stop, active in observed.segments():
            v0, headway, *shared = (parameters[name][:active] for name in law.parameters)
            constants = self.constants.with_(**dict(zip(law.shared, shared, strict=True)))
            speed, gap = speed[:active], gap[:active]
            for step in range(start, stop):
                leader, truth, seen = (
                    values[step : step + 2, :active].unsqueeze(-1)
                    for values in (observed.leader_speed, observed.follower_speed, observed.gaps)
                )
                command = law.acceleration(speed, gap, speed - leader[0], v0, headway, constants)
                reached, _ = advance_speed(speed, command, observed.time_step)
                gap = advance_gap(gap, leader[0], speed, leader[1], reached, observed.time_step)
                speed = reached
                totals[0, :active] += (speed - truth[1]).square()
                if apart:
                    totals[1, :active] += (gap - seen[1]).square()
        return totals[0], totals[1]

    def _by_kernel(self, parameters: dict[str, Tensor], apart: bool) -> tuple[Tensor, Tensor]:
        """The same: all steps of a driver at once."""
        from lcc_rl.drivers.kernel import compiled  # here: numba loads for half a second

        ready = [value.contiguous() for value in READY[self.model](parameters)]
        constants, time_step = self.constants, self.observed.time_step
        totals = torch.empty((2, *ready[0].shape), dtype=ready[0].dtype)
        settings = (
            *(getattr(constants, name, 1.0) for name in ("gap_floor", "braking_limit")),
            *(constants.acceleration_limit, time_step, 0.5 * time_step),
            *(0.0, 1.0, 2.0, 0.025, 1e-12),
        )
        name = str(totals.dtype).removeprefix("torch.")
        single = np.dtype(name).type
        exponent = getattr(constants, "exponent", 4.0)
        compiled(name)(
            True if self.model == IDM else None,
            True if self.model in OVMS else None,
            None if exponent == 4.0 else single(exponent),
            apart or None,
            *self._episodes,
            tuple(value.numpy() for value in ready),
            tuple(single(value) for value in settings),
            totals.numpy(),
        )
        return totals[0], totals[1]


def _ready_idm(given: dict[str, Tensor]) -> list[Tensor]:
    """1/v0, T, a, 1/(2√(ab)), s0, and one of no use."""
    acceleration = given["acceleration"]
    root = 2.0 * (acceleration * given["deceleration"]).sqrt()
    own = [given["desired_speed"].reciprocal(), given["time_gap"], acceleration]
    return [*own, root.reciprocal(), given["min_gap"], given["min_gap"]]


def _ready_ovm(given: dict[str, Tensor]) -> list[Tensor]:
    """A, 1/(A T), s0/(A T) + β, A tanh β, κ, λ (0 for the optimal velocity model)."""
    offset = given["form"].tanh()
    scale = given["desired_speed"] / (1.0 + offset)
    slope = (scale * given["time_gap"]).reciprocal()
    shift = given["min_gap"] * slope + given["form"]
    return [scale, slope, shift, scale * offset, given["sensitivity"], given["speed_gain"]]


def _ready_gipps(given: dict[str, Tensor]) -> list[Tensor]:
    """1/v0, 2.5 a, b, τ, s0, b/b̂."""
    brake = given["deceleration"]
    own = [given["desired_speed"].reciprocal(), 2.5 * given["acceleration"], brake]
    ratio = brake / given["leader_deceleration"]
    return [*own, given["time_gap"] / 1.5, given["min_gap"], ratio]


# By model: what the compiled simulation needs of each candidate.
READY: dict[str, Callable[[dict[str, Tensor]], list[Tensor]]] = {
    IDM: _ready_idm,
    **dict.fromkeys(OVMS, _ready_ovm),
    "gipps": _ready_gipps,
}
