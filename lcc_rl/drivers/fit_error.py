"""Error of simulated followers, for many candidates of many drivers (A6)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from lcc_rl.drivers.kernel import kernel_of
from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.parameters import COLUMNS, IDM, law_of
from lcc_rl.errors import unknown_name
from lcc_rl.functional.driver_models import DriverConstants
from lcc_rl.functional.idm import power

State = tuple[Tensor, Tensor, Tensor, Tensor]
SPEED, GAP, GAP_SHARE = "speed_rmspe", "gap_rmse", "gap_nrmse"
# What a calibration may minimise; ``both`` is the sum of the two relative errors.
OBJECTIVES = (SPEED, GAP, GAP_SHARE, "both")
OVMS = ("ovm", "fvdm")  # simulated alike; λ of the first is zero


class FitError:
    """Error of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.idm.simulate_follower`, but only the error
    is kept, and no episode is simulated beyond its end. On a CPU, the simulation is
    :func:`lcc_rl.drivers.kernel.squared_errors` where numba is installed.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        constants: parameters that are not among the candidates'.
        names: the candidates' parameters, in the order of the last dimension.
        model: the driver model.
        objective: which error: of the speed, √(Σ(v_sim − v_obs)²/Σv_obs²) (``speed_rmspe``); of
            the gap, the root of the mean square [m] (``gap_rmse``) or relative to the observed
            one as of the speed (``gap_nrmse``); or the sum of both relative ones (``both``).

    Raises:
        ConfigError: if the model or the objective is unknown.
    """

    def __init__(
        self,
        observed: Observed,
        constants: DriverConstants,
        names: Sequence[str],
        model: str = IDM,
        objective: str = SPEED,
    ) -> None:
        if objective not in OBJECTIVES:
            raise unknown_name("calibration objective", objective, OBJECTIVES)
        self.law, self.model, self.objective = law_of(model), model, objective
        self.observed, self.constants, self.names = observed, constants, tuple(names)
        series = (observed.follower_speed, observed.gaps)
        self._norms = [values.square().sum(0).unsqueeze(-1) for values in series]
        self._samples = observed.gaps.new_tensor(observed.samples.tolist()).unsqueeze(-1)
        on_cpu = observed.gaps.device.type == "cpu"
        self._kernel = kernel_of(_name(observed.gaps.dtype)) if on_cpu else None
        if self._kernel is not None:
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
            parameters = self._parameters(candidates)
            simulate = self._by_tensors if self._kernel is None else self._by_kernel
            speed, gap = simulate(parameters, apart)
            return {
                SPEED: (speed / self._norms[0]).sqrt(),
                GAP: (gap / self._samples).sqrt(),
                GAP_SHARE: (gap / self._norms[1]).sqrt(),
            }

    @property
    def simulator(self) -> str:
        """The package that simulates, ``numba`` or ``torch``."""
        return "torch" if self._kernel is None else "numba"

    def _parameters(self, candidates: Tensor) -> tuple[Tensor, ...]:
        """Per candidate what the model's formula needs, six each; see :data:`READY`."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        values = {
            name: torch.as_tensor(
                given.get(name, getattr(self.constants, name, 0.0)),
                dtype=self.observed.gaps.dtype,
                device=candidates.device,
            )
            for name in COLUMNS
        }
        shape = candidates.shape[:-1]
        ready = READY[self.model](values)
        return tuple(value.expand(shape).contiguous() for value in ready)

    def _by_tensors(self, parameters: tuple[Tensor, ...], apart: bool) -> tuple[Tensor, Tensor]:
        """Sums of squared errors, ``[drivers, candidates]``: all of them a step at a time."""
        observed = self.observed
        series = [
            values.unsqueeze(-1)
            for values in (observed.leader_speed, observed.follower_speed, observed.gaps)
        ]
        speed, gap = (values[0].expand_as(parameters[0]).contiguous() for values in series[1:])
        totals = torch.zeros_like(speed), torch.zeros_like(speed)
        for start, stop, active in observed.segments():
            window = slice(start, stop + 1)
            speed, gap, *parts = self._advance(
                (speed[:active], gap[:active], totals[0][:active], totals[1][:active]),
                tuple(parameter[:active] for parameter in parameters),
                [values[window, :active] for values in series],
                apart,
            )
            for total, part in zip(totals, parts, strict=True):
                total[:active] = part
        return totals

    def _advance(
        self,
        state: State,
        parameters: tuple[Tensor, ...],
        series: Sequence[Tensor],
        apart: bool,
    ) -> State:
        """Drive followers through a piece of time (A18).

        The formulas are written out with temporaries reused in place, which is twice as fast as
        the pure functions; a test holds both against each other.
        """
        speed, gap, total, distance = state
        leader, observed, gaps = (tensor.unbind(0) for tensor in series)
        command_of, constants = COMMANDS[self.model], self.constants
        time_step = self.observed.time_step
        half = 0.5 * time_step
        for step in range(len(leader) - 1):
            ahead, ahead_reached = leader[step], leader[step + 1]
            command = command_of(speed, gap, ahead, parameters, constants)
            command = command.clamp_(-constants.braking_limit, constants.acceleration_limit)
            reached = torch.add(speed, command, alpha=time_step).clamp_(min=0.0)
            gap = torch.add(gap, ahead + ahead_reached, alpha=half)
            gap = gap.sub_(speed, alpha=half).sub_(reached, alpha=half)
            error = reached - observed[step + 1]
            total = torch.addcmul(total, error, error)
            if apart:
                error = gap - gaps[step + 1]
                distance = torch.addcmul(distance, error, error)
            speed = reached
        return speed, gap, total, distance

    def _by_kernel(self, parameters: tuple[Tensor, ...], apart: bool) -> tuple[Tensor, Tensor]:
        """The same: all steps of a driver at once."""
        assert self._kernel is not None
        constants, time_step = self.constants, self.observed.time_step
        totals = torch.empty((2, *parameters[0].shape), dtype=parameters[0].dtype)
        settings = (
            *(getattr(constants, name, 1.0) for name in ("gap_floor", "braking_limit")),
            *(constants.acceleration_limit, time_step, 0.5 * time_step),
            *(0.0, 1.0, 2.0, 0.025, 1e-12),
        )
        single = np.dtype(_name(totals.dtype)).type
        exponent = getattr(constants, "exponent", 4.0)
        self._kernel(
            True if self.model == IDM else None,
            True if self.model in OVMS else None,
            None if exponent == 4.0 else single(exponent),
            apart or None,
            *self._episodes,
            tuple(parameter.numpy() for parameter in parameters),
            tuple(single(value) for value in settings),
            totals.numpy(),
        )
        return totals[0], totals[1]


def _name(dtype: torch.dtype) -> str:
    """The name by which numpy knows a precision."""
    return str(dtype).removeprefix("torch.")


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


def _idm(
    speed: Tensor, gap: Tensor, ahead: Tensor, ready: Sequence[Tensor], constants: DriverConstants
) -> Tensor:
    slowness, time_gap, acceleration, inverse_root, min_gap, _ = ready
    wish = torch.addcmul(time_gap, speed - ahead, inverse_root)
    wish = wish.mul_(speed).clamp_(min=0.0).add_(min_gap)
    wish = wish.div_(gap.clamp(min=constants.gap_floor))  # type: ignore[attr-defined]
    load = power(speed * slowness, constants.exponent)  # type: ignore[attr-defined]
    load = load.addcmul_(wish, wish)
    return torch.addcmul(acceleration, acceleration, load, value=-1.0)


def _ovm(
    speed: Tensor, gap: Tensor, ahead: Tensor, ready: Sequence[Tensor], constants: DriverConstants
) -> Tensor:
    scale, slope, shift, offset, sensitivity, speed_gain = ready
    optimal = torch.addcmul(-shift, gap, slope).tanh_().mul_(scale).add_(offset)
    return optimal.sub_(speed).mul_(sensitivity).addcmul_(speed_gain, ahead - speed)


def _gipps(
    speed: Tensor, gap: Tensor, ahead: Tensor, ready: Sequence[Tensor], constants: DriverConstants
) -> Tensor:
    slowness, rise, brake, tau, min_gap, ratio = ready
    share, slowing = speed * slowness, brake * tau
    free = rise * (1.0 - share) * (share + 0.025).sqrt_()
    room = (gap - min_gap).mul_(2.0).sub_(speed * tau).mul_(brake)
    root = room.addcmul_(slowing, slowing).addcmul_(ratio, ahead * ahead)
    root = root.clamp_(min=1e-12).sqrt_()
    return torch.minimum(free, root.sub_(slowing).sub_(speed).div_(tau))


# By model: what is computed once per candidate, and the command at a step.
READY: dict[str, Callable[[dict[str, Tensor]], list[Tensor]]] = {
    IDM: _ready_idm,
    **dict.fromkeys(OVMS, _ready_ovm),
    "gipps": _ready_gipps,
}
COMMANDS: dict[str, Callable[..., Tensor]] = {
    IDM: _idm,
    **dict.fromkeys(OVMS, _ovm),
    "gipps": _gipps,
}
