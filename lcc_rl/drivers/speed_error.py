"""Speed error of simulated IDM followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor
from torch.nn.functional import pad

from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.parameters import COLUMNS, MODES
from lcc_rl.functional.idm import IDMConstants, power

CHUNK = 10  # steps of a compiled piece

State = tuple[Tensor, Tensor, Tensor]


class SpeedError:
    """RMSPE of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.idm.simulate_follower`, but only the error
    is kept, and no episode is simulated beyond its end.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        constants: parameters that are not among the candidates'.
        names: the candidates' parameters, in the order of the last dimension.
        compiled: compile the simulation: about three times faster, after tens of seconds of
            compilation, so worth it for thousands of drivers.
    """

    def __init__(
        self,
        observed: Observed,
        constants: IDMConstants,
        names: Sequence[str] = MODES["local"],
        compiled: bool = False,
    ) -> None:
        self.constants, self.names = constants, tuple(names)
        self.gap = observed.gap.unsqueeze(-1)
        self.time_step = observed.time_step
        self._run = _compiled_advance() if compiled else _advance
        self._pieces = list(observed.segments(CHUNK if compiled else None))
        spare = self._pieces[-1][1] + 1 - len(observed.leader_speed)
        self._leader = pad(observed.leader_speed, (0, 0, 0, spare)).unsqueeze(-1)
        self._follower = pad(observed.follower_speed, (0, 0, 0, spare)).unsqueeze(-1)
        self._norm = observed.follower_speed.square().sum(0).unsqueeze(-1)
        self._counts = self._weights(observed) if compiled else None

    def __call__(self, candidates: Tensor) -> Tensor:
        """Return RMSPE ``[drivers, candidates]`` (0.07 is 7 %) of ``[drivers, candidates, dims]``.

        The constants may be tensors that broadcast to ``[drivers, candidates]``.
        """
        with torch.no_grad():
            parameters = self._parameters(candidates)
            speed = self._follower[0].expand(candidates.shape[:-1]).contiguous()
            gap = self.gap.expand_as(speed).contiguous()
            total = torch.zeros_like(speed)
            for start, stop, active in self._pieces:
                window = slice(start, stop + 1)
                speed, gap, part = self._run(
                    (speed[:active], gap[:active], total[:active]),
                    tuple(parameter[:active] for parameter in parameters),
                    (self._leader[window, :active], self._follower[window, :active]),
                    None if self._counts is None else self._counts[start:stop, :active],
                    self.constants,
                    self.time_step,
                )
                total[:active] = part
            return (total / self._norm).sqrt()

    def _parameters(self, candidates: Tensor) -> tuple[Tensor, ...]:
        """Per candidate: 1/v0, T, a, 1/(2√(ab)), s0."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        shape = candidates.shape[:-1]
        values = [
            torch.as_tensor(
                given.get(name, getattr(self.constants, name, None)),
                dtype=candidates.dtype,
                device=candidates.device,
            )
            for name in COLUMNS
        ]
        desired_speed, time_gap, acceleration, deceleration, min_gap = values
        root = 2.0 * (acceleration * deceleration).sqrt()
        ready = (desired_speed.reciprocal(), time_gap, acceleration, root.reciprocal(), min_gap)
        return tuple(value.expand(shape).contiguous() for value in ready)

    def _weights(self, observed: Observed) -> Tensor:
        """1 for the samples of an episode, 0 beyond its end; pieces of one length reach there."""
        reached = torch.arange(1, len(self._leader), device=self.gap.device).unsqueeze(-1)
        samples = torch.tensor(observed.samples.tolist(), device=self.gap.device)
        return (reached < samples).to(self.gap.dtype).unsqueeze(-1)


def _advance(
    state: State,
    parameters: tuple[Tensor, ...],
    speeds: tuple[Tensor, Tensor],
    weights: Tensor | None,
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
        if weights is not None:
            error = error * weights[step]
        total = torch.addcmul(total, error, error)
        speed = reached
    return speed, gap, total


@lru_cache(maxsize=1)
def _compiled_advance() -> Callable[..., State]:
    return torch.compile(_advance, dynamic=True)
