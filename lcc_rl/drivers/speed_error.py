"""Speed error of simulated IDM followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.kernel import kernel_of
from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.parameters import COLUMNS, MODES
from lcc_rl.functional.idm import IDMConstants, power

State = tuple[Tensor, Tensor, Tensor]


class SpeedError:
    """RMSPE of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.idm.simulate_follower`, but only the error
    is kept, and no episode is simulated beyond its end. On a CPU, the simulation is
    :func:`lcc_rl.drivers.kernel.squared_errors` where numba is installed.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        constants: parameters that are not among the candidates'.
        names: the candidates' parameters, in the order of the last dimension.
    """

    def __init__(
        self, observed: Observed, constants: IDMConstants, names: Sequence[str] = MODES["local"]
    ) -> None:
        self.observed, self.constants, self.names = observed, constants, tuple(names)
        self._norm = observed.follower_speed.square().sum(0).unsqueeze(-1)
        on_cpu = observed.gap.device.type == "cpu"
        self._kernel = kernel_of(_name(observed.gap.dtype)) if on_cpu else None
        if self._kernel is not None:
            speeds = (observed.leader_speed, observed.follower_speed)
            by_driver = [speed.T.contiguous().numpy() for speed in speeds]
            self._episodes = (*by_driver, observed.gap.numpy(), np.array(observed.samples))

    def __call__(self, candidates: Tensor) -> Tensor:
        """Return RMSPE ``[drivers, candidates]`` (0.07 is 7 %) of ``[drivers, candidates, dims]``.

        The constants may be tensors that broadcast to ``[drivers, candidates]``.
        """
        with torch.no_grad():
            parameters = self._parameters(candidates)
            simulate = self._by_tensors if self._kernel is None else self._by_kernel
            return (simulate(parameters) / self._norm).sqrt()

    @property
    def simulator(self) -> str:
        """The package that simulates, ``numba`` or ``torch``."""
        return "torch" if self._kernel is None else "numba"

    def _parameters(self, candidates: Tensor) -> tuple[Tensor, ...]:
        """Per candidate: 1/v0, T, a, 1/(2√(ab)), s0."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        shape = candidates.shape[:-1]
        values = [
            torch.as_tensor(
                given.get(name, getattr(self.constants, name, None)),
                dtype=self.observed.gap.dtype,
                device=candidates.device,
            )
            for name in COLUMNS
        ]
        desired_speed, time_gap, acceleration, deceleration, min_gap = values
        root = 2.0 * (acceleration * deceleration).sqrt()
        ready = (desired_speed.reciprocal(), time_gap, acceleration, root.reciprocal(), min_gap)
        return tuple(value.expand(shape).contiguous() for value in ready)

    def _by_tensors(self, parameters: tuple[Tensor, ...]) -> Tensor:
        """Sums of squared errors, ``[drivers, candidates]``: all of them a step at a time."""
        observed = self.observed
        leader = observed.leader_speed.unsqueeze(-1)
        follower = observed.follower_speed.unsqueeze(-1)
        speed = follower[0].expand_as(parameters[0]).contiguous()
        gap = observed.gap.unsqueeze(-1).expand_as(speed).contiguous()
        total = torch.zeros_like(speed)
        for start, stop, active in observed.segments():
            window = slice(start, stop + 1)
            speed, gap, part = _advance(
                (speed[:active], gap[:active], total[:active]),
                tuple(parameter[:active] for parameter in parameters),
                (leader[window, :active], follower[window, :active]),
                self.constants,
                observed.time_step,
            )
            total[:active] = part
        return total

    def _by_kernel(self, parameters: tuple[Tensor, ...]) -> Tensor:
        """The same: all steps of a driver at once."""
        assert self._kernel is not None
        constants, time_step = self.constants, self.observed.time_step
        total = torch.empty_like(parameters[0])
        settings = (
            *(constants.gap_floor, constants.braking_limit, constants.acceleration_limit),
            *(constants.exponent, time_step, 0.5 * time_step),
            *(0.0, 1.0, 4.0),
        )
        self._kernel(
            *self._episodes,
            tuple(parameter.numpy() for parameter in parameters),
            tuple(np.dtype(_name(total.dtype)).type(value) for value in settings),
            total.numpy(),
        )
        return total


def _name(dtype: torch.dtype) -> str:
    """The name by which numpy knows a precision."""
    return str(dtype).removeprefix("torch.")


def _advance(
    state: State,
    parameters: tuple[Tensor, ...],
    speeds: tuple[Tensor, Tensor],
    constants: IDMConstants,
    time_step: float,
) -> State:
    """Drive followers through a piece of time; the formulas are A3, A4 and A18.

    They are written out here with temporaries reused in place, which is twice as fast as the
    pure functions; a test holds both against each other.
    """
    speed, gap, total = state
    slowness, time_gap, acceleration, inverse_root, min_gap = parameters
    leader, observed = (tensor.unbind(0) for tensor in speeds)
    half = 0.5 * time_step
    for step in range(len(leader) - 1):
        ahead, ahead_reached = leader[step], leader[step + 1]
        wish = torch.addcmul(time_gap, speed - ahead, inverse_root)
        wish = wish.mul_(speed).clamp_(min=0.0).add_(min_gap)
        wish = wish.div_(gap.clamp(min=constants.gap_floor))
        load = power(speed * slowness, constants.exponent).addcmul_(wish, wish)
        command = torch.addcmul(acceleration, acceleration, load, value=-1.0)
        command = command.clamp_(-constants.braking_limit, constants.acceleration_limit)
        reached = torch.add(speed, command, alpha=time_step).clamp_(min=0.0)
        gap = torch.add(gap, ahead + ahead_reached, alpha=half)
        gap = gap.sub_(speed, alpha=half).sub_(reached, alpha=half)
        error = reached - observed[step + 1]
        total = torch.addcmul(total, error, error)
        speed = reached
    return speed, gap, total
