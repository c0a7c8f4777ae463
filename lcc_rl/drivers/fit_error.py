"""Error of simulated followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.twins import drive, running
from lcc_rl.functional.driver_models import DriverConstants, Reaction, follow
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
        self.summands = [SPEED_RMSPE, GAP_NRMSE] if objective == "both" else [objective]
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
        return self.terms(candidates).sum(-1)

    def terms(self, candidates: Tensor) -> Tensor:
        """Return the summands of the error, ``[drivers, candidates, summands]``."""
        measures = self.measures(candidates, self.objective != SPEED_RMSPE)
        return torch.stack([measures[name] for name in self.summands], -1)

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


# -- intervals of parameters, by the profile of the objective and simulated noise ------------------

REPLICATES, DISTURBANCE = 32, Reaction(noise=0.2)  # simulated records of each driver
SAMPLES_AT_ONCE = 2**23  # samples times draws that are simulated together
SHIFT = 1e-3  # relative change of a parameter that measures its effect
ANSWERS = (0.0, 0.5, 1.0)  # of the linear change of the other parameters with one
VALUES = 32  # values between the fitted one and a bound, the densest near the fitted one


def intervals(
    error: FitError, best: Tensor, bounds: Sequence[tuple[float, float]]
) -> tuple[Tensor, ...]:
    """Return the ends of 95 % intervals of fitted parameters, each ``[drivers, names]``.

    Successive errors of a driver depend on each other. Therefore, drivers with the fitted
    parameters and a noise of the acceleration are simulated. A linearised fit to each draw gives
    the relative decrease of the squared error due to each parameter. An interval ends where the
    squared error exceeds its minimum by four times the mean decrease, while the other parameters
    change, too. If there are several, they follow only roughly, and the interval of the linearised
    fit, of logarithms, is included.

    Args:
        error: the objective in float64.
        best: fitted parameters ``[drivers, names]``.
        bounds: lower and upper bound of each parameter. An end that is not within them is NaN.
    """
    normal, joint, noise = _products(error, best)
    inverse = torch.linalg.pinv(normal, hermitian=True)
    moved, variance = inverse @ joint, inverse.diagonal(dim1=1, dim2=2)
    left = (noise - (moved * joint).sum(1)).unsqueeze(1)
    spread = 4.0 * (moved.square() / left).mean(-1)
    allowed = error(best.unsqueeze(1)) * (1.0 + spread / variance).sqrt()
    place, limits = best.log().unsqueeze(1), torch.tensor(bounds).to(best).log().T
    share = torch.linspace(0.0, 1.0, VALUES + 1).to(best)[1:] ** 3
    steps = (limits - place).unsqueeze(-1) * share  # [drivers, ends, names, values]
    others = torch.tensor(ANSWERS).to(best).unsqueeze(-1)
    ways = others * (inverse / variance.unsqueeze(2)).unsqueeze(2)  # by driver, name, share, name
    ways.diagonal(dim1=1, dim2=3).fill_(1.0)
    tried = steps[:, :, :, None, :, None] * ways[:, None, :, :, None] + place[:, None, None, None]
    errors = error(tried.clamp(*limits).exp().flatten(1, 4)).view(tried.shape[:-1]).amin(3)
    above = errors > allowed[:, None, :, None]
    first = steps.gather(3, above.int().argmax(3, keepdim=True)).squeeze(3)
    ends = torch.where(above.any(3), first, torch.nan)
    if len(bounds) > 2:
        outward = torch.tensor([[-1.0], [1.0]]).to(best)
        ends = outward * torch.maximum(outward * ends, spread.sqrt().unsqueeze(1))
    ends = place + ends
    within = (ends >= limits[0]) & (ends <= limits[1])
    return torch.where(within, ends.exp(), torch.nan).unbind(1)


def _products(error: FitError, best: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sums over each record of products of the effects of parameters and of noise.

    Returns:
        Effects by effects ``[drivers, names, names]``, effects by noise ``[drivers, names, draws]``
        and squares of noise ``[drivers, draws]``, relative to the squared error.
    """
    observed, count = error.observed, best.shape[1]
    start = observed.follower_speed[0], observed.gaps[0]
    generator = torch.Generator().manual_seed(0)
    alive = torch.from_numpy(running(len(observed.gaps), observed.samples))

    def motion(shift: Tensor, reaction: Reaction) -> Tensor:
        candidates = best.unsqueeze(1) * shift.exp()
        own = {name: values.T for name, values in error.parameters(candidates).items()}
        pair = own.pop("desired_speed"), own.pop("time_gap")
        people = error.law.with_(**own), pair
        # All drivers have the same draws, so that none depends on the others.
        shape = (1, len(shift), 1)
        step, leader = observed.time_step, observed.leader_speed
        [found] = drive(people, leader, start, [reaction], shape, generator, step)
        return torch.from_numpy(np.stack(found)).nan_to_num_(0.0, 0.0, 0.0).mul_(alive)

    change = SHIFT * torch.eye(count).to(best)
    shifts = torch.cat([change, -change, 0.0 * change[:1]])
    more, less, plain = motion(shifts, Reaction()).split([count, count, 1], 2)
    effects = (more - less) / (2.0 * SHIFT)
    seen = torch.stack([observed.follower_speed, observed.gaps])
    squares = (plain[:, :, 0] - seen).square().sum(1).clamp(min=1e-12)
    used = [error.objective in (SPEED_RMSPE, "both"), error.objective != SPEED_RMSPE]
    norms = seen.square().sum(1).clamp(min=1e-12)
    weights = torch.tensor(used).unsqueeze(-1) / (squares * norms).sqrt()
    weights = weights / (weights * squares).sum(0)
    normal = torch.einsum("ctid,ctjd,cd->dij", effects, effects, weights)
    joint, noise, group = [], [], max(1, SAMPLES_AT_ONCE // seen[0].numel())
    for fitted in torch.zeros(REPLICATES, count).to(best).split(group):  # fits into memory
        strayed = motion(fitted, DISTURBANCE).sub_(plain)
        joint.append(torch.einsum("ctid,ctjd,cd->dij", effects, strayed, weights))
        noise.append(torch.einsum("ctjd,cd->dj", strayed.square_(), weights))
    return normal, torch.cat(joint, -1), torch.cat(noise, -1)
