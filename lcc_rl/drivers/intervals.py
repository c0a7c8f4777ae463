"""Intervals of calibrated parameters: the objective's profile, and simulated noise."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from lcc_rl.drivers.fit_error import FitError
from lcc_rl.functional.driver_models import NoiseStep, follow

DRAWS, LEVEL = 32, 0.2  # simulated records of each driver, and their noise [m/s²]
SHIFT = 1e-3  # relative change of a parameter that measures its effect
SHARES = (0.0, 0.5, 1.0)  # of the linear answer of the other parameters to a change of one
VALUES = 32  # values between the fitted one and a bound, the densest near the fitted one


def intervals(
    error: FitError, best: Tensor, bounds: Sequence[tuple[float, float]]
) -> tuple[Tensor, Tensor]:
    """Return the ends of 95 % intervals of fitted parameters, each ``[drivers, names]``.

    Successive errors of a driver depend on each other. To include this, drivers with the fitted
    parameters and a small noise of the acceleration (:class:`NoiseStep`) are simulated. For every
    draw of the noise, a linearised fit gives the relative decrease of the squared error due to each
    parameter. The end of an interval is the value of a parameter at which the squared error exceeds
    its minimum by four times the mean decrease, while the other parameters change with it. With
    more than two parameters they follow only roughly, and the interval of the linearised fit, of
    logarithms, is included.

    Args:
        error: the objective in float64.
        best: fitted parameters ``[drivers, names]``.
        bounds: lower and upper bound of each parameter. An end that is not within them is NaN.
    """
    count = best.shape[1]
    least = error(best.unsqueeze(1))
    normal, joint, noise = _products(error, best)
    inverse = torch.linalg.pinv(normal, hermitian=True)
    moved = inverse @ joint
    left = (noise - (moved * joint).sum(1)).unsqueeze(1)
    variance = inverse.diagonal(dim1=1, dim2=2)
    spread = 4.0 * (moved.square() / left).mean(-1)
    allowed = least * (1.0 + spread / variance).sqrt()
    answers = inverse / variance.unsqueeze(1)
    place, limits = best.log(), torch.tensor(bounds).to(best).log().T
    share = torch.linspace(0.0, 1.0, VALUES + 1).to(best)[1:] ** 3
    ends = []
    for side, beyond in zip(limits, (-torch.inf, torch.inf), strict=True):
        steps = (side - place).unsqueeze(-1) * share  # [drivers, names, values]
        found = []
        for own in range(count):
            errors = []
            for follows in SHARES:
                way = (follows * answers[:, :, own]).index_fill(1, torch.tensor(own), 1.0)
                tried = place.unsqueeze(1) + steps[:, own].unsqueeze(-1) * way.unsqueeze(1)
                errors.append(error(tried.clamp(*limits).exp()))
            above = torch.stack(errors).amin(0) > allowed[:, own, None]
            first = steps[:, own].gather(1, above.int().argmax(1, keepdim=True)).squeeze(1)
            found.append(torch.where(above.any(1), first, beyond))
        ends.append(torch.stack(found, 1))
    if count > 2:
        linear = spread.sqrt()
        ends = [torch.minimum(ends[0], -linear), torch.maximum(ends[1], linear)]
    low, high = ((place + end).exp() for end in ends)
    inside = low >= limits[0].exp(), high <= limits[1].exp()
    return torch.where(inside[0], low, torch.nan), torch.where(inside[1], high, torch.nan)


def _products(error: FitError, best: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return sums over each record of products of the effects of parameters and of noise.

    Returns:
        Effects by effects ``[drivers, names, names]``, effects by noise ``[drivers, names, draws]``
        and squares of noise ``[drivers, draws]``, weighted as in the objective.
    """
    observed, count = error.observed, best.shape[1]
    shift, rest = SHIFT * torch.eye(count), torch.zeros(1 + DRAWS, count)
    tried = torch.cat([shift, -shift, rest]).to(best).exp() * best.unsqueeze(1)
    own = {name: values.T for name, values in error.parameters(tried).items()}
    pair = own.pop("desired_speed"), own.pop("time_gap")
    generator, form = torch.Generator().manual_seed(0), NoiseStep.of(observed.time_step)

    def draw() -> Tensor:  # the same for all drivers, so that none depends on the others
        drawn = LEVEL * torch.randn(DRAWS, 1, generator=generator).to(best)
        return torch.nn.functional.pad(drawn, (0, 0, 2 * count + 1, 0))

    noise = form.start(draw(), draw())

    def disturbed(_: int, command: Tensor) -> Tensor:
        nonlocal noise
        noise = form.next(*noise, draw()), noise[0]
        return command + noise[1]

    seen = observed.follower_speed[0], observed.gaps[0]
    speed, gap = (x.expand(tried.shape[1], -1) for x in seen)
    law, step = error.law.with_(**own), observed.time_step
    motion = follow(law, observed.leader_speed, speed, gap, pair, step, 0, disturbed)
    joint, squares = torch.zeros(2, 1).to(best)
    samples = torch.tensor(observed.samples)
    for number, (speed, gap, _) in enumerate(motion, 1):
        running = number < samples
        reached = torch.stack([speed, gap]).nan_to_num(0.0, 0.0, 0.0) * running
        more, less, plain, noisy = reached.split([count, count, 1, DRAWS], 1)
        effects = torch.cat([(more - less) / (2.0 * SHIFT), noisy - plain], 1)
        joint = joint + effects[:, :count].unsqueeze(2) * effects.unsqueeze(1)
        squares = squares + effects[:, count:].square()
    weights = error.weights(best)
    joint, squares = (torch.einsum("c...d,cd->d...", x, weights) for x in (joint, squares))
    return joint[..., :count], joint[..., count:], squares
