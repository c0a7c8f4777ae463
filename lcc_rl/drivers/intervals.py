"""Intervals of calibrated parameters by the profile of the objective and simulated noise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.fit_error import SPEED_RMSPE, FitError
from lcc_rl.drivers.twins import drive, running
from lcc_rl.functional.driver_models import Reaction

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
