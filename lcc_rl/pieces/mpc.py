"""A model predictive controller: plans some seconds and executes the first step."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.errors import ConfigError, how_to_install
from lcc_rl.functional.power import POWER_COEFFICIENTS
from lcc_rl.pieces.base import Entry
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Number, Positive, Settings, values

LONGEST_GAP = 200.0  # longer gaps count as this one [m]
Array = np.ndarray
MOST_STEPS = 200  # of a plan


class MPCSettings(Settings):
    """Horizon, prediction, limits and prices of :class:`MPC`."""

    horizon: Positive = 5.0  # length of the plan [s]
    step: Positive = 0.25  # step of the plan; the horizon is a multiple of it [s]
    # Time constant with which the acceleration of the vehicle ahead is assumed to decay; 0: its
    # speed is constant [s].
    acceleration_time: NonNegative = 1.5
    margin: NonNegative = 1.0  # shortest gap at standstill [m]
    least_time_gap: NonNegative = 0.5  # shortest time gap beyond margin [s]
    # The largest gap is longest_time_gap [s] times the speed plus longest_gap [m], which may be
    # negative. It is raised to the shortest gap where it would be less.
    longest_time_gap: Positive = 2.8
    longest_gap: Number = -8.5
    least_ttc: NonNegative = 4.1  # shortest time-to-collision [s]
    steady_price: NonNegative = 1.0  # price of the steady power at the planned speeds
    jerk_price: NonNegative = 0.1  # price of the squared jerk [s²]
    # Prices of the squared distance by which the gap is too short, too long, or too short for the
    # time-to-collision [1/(m²s⁴)].
    near_price: Positive = 3.0
    far_price: Positive = 0.1
    ttc_price: Positive = 30.0
    max_acceleration: Positive | None = None  # None: the limits of the vehicles [m/s²]
    # Absolute and relative tolerance of the solver.
    tolerance: Annotated[float, Field(ge=1e-10, le=0.1)] = 1e-4
    iterations: Annotated[int, Field(ge=1, le=1_000_000)] = 4000  # most iterations of the solver

    def validate(self) -> None:
        if self.longest_time_gap <= self.least_time_gap:
            least = f"least_time_gap={self.least_time_gap}"
            raise ValueError(f"longest_time_gap must be above {least}, got {self.longest_time_gap}")
        steps = self.horizon / self.step
        if not 1 <= round(steps) <= MOST_STEPS or abs(steps - round(steps)) > 1e-6:
            raise ValueError(
                f"horizon must be 1 to {MOST_STEPS} times step={self.step:g}, got {self.horizon:g}"
            )


class MPC(MPCSettings, Controller):
    """Plans accelerations by a quadratic program in every step and commands the first one.

    The plan minimises energy within limits of the gap and the time-to-collision, see
    :class:`FollowingProgram`. OSQP (Stellato et al. 2020) starts from the same point every time, so
    the command depends on its inputs only. Without a solution the vehicle brakes fully, and
    ``(role, "unsolved")``, ``[*batch, n, 1]``, is 1. The controller passes no gradient and is not
    compiled; equal rows are solved once.
    """

    reads = ("self.speed", "self.gap", "self.acceleration", "ahead.speed", "ahead.acceleration")
    writes = (Entry("role.unsolved", "–", "1 where MPC found no solution and brakes fully"),)

    def setup(self, world: World) -> None:
        self.check_installed()
        self.declare(world)
        assert self.limits is not None
        self.program = FollowingProgram(MPCSettings(**values(self, MPCSettings)), self.limits)

    @staticmethod
    def check_installed() -> None:
        """Check that OSQP is installed.

        Raises:
            ConfigError: if it is not; the message contains the command to install it.
        """
        if find_spec("osqp") is None:
            raise ConfigError(f"controller=mpc needs osqp: {how_to_install('mpc')}")

    @torch.compiler.disable
    def command(self, *entries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the commands, and 1 where there was no solution."""
        speed = entries[0]
        rows = torch.stack([x.detach().expand_as(speed).flatten() for x in entries], -1)
        first, unsolved = self.program(rows.double().cpu().numpy())
        results = (torch.as_tensor(x).to(speed).view_as(speed) for x in (first, unsolved))
        return tuple(results)  # type: ignore[return-value]


class FollowingProgram:
    """min ½ xᵀPx + qᵀx, l ≤ Ax ≤ u; x: N accelerations and N slacks of each of three limits.

    The plan's speeds and gaps are linear in its accelerations, so P and A depend on settings only,
    and the programs of many states are solved one after the other with one factorisation. The
    objective is the loss by acceleration (the part of A2 with a²) plus ``steady_price`` times the
    steady power, linearised at the present speed; both in units of the loss of 1 m/s² at this
    speed. The limits of gap and time-to-collision are soft, so a solution always exists.

    Args:
        settings: settings of the controller.
        limits: least and largest command [m/s²].
    """

    def __init__(self, settings: MPCSettings, limits: tuple[float, float]) -> None:
        self.settings, self.limits = settings, limits
        self.steps = round(settings.horizon / settings.step)
        h, n = settings.step, self.steps
        self.times = h * np.arange(1, n + 1)
        sums = np.tril(np.ones((n, n)))
        self.speeds = h * sums  # speeds of the plan by its accelerations
        # The trapezoidal rule of the simulator (A18).
        self.ways = h * sums @ (self.speeds - 0.5 * h * np.eye(n))
        changes = (np.eye(n) - np.eye(n, k=-1)) / h
        prices = (settings.near_price, settings.far_price, settings.ttc_price)
        quadratic = 2.0 * np.diag(np.repeat([0.0, *prices], n))
        quadratic[:n, :n] = 2.0 * (np.eye(n) + settings.jerk_price * changes.T @ changes)
        self.osqp = self._set_up(quadratic)

    def _set_up(self, quadratic: Array) -> Any:
        """Return OSQP's solver with P ``[4 N, 4 N]`` and A."""
        from osqp import OSQP
        from scipy.sparse import csc_matrix, triu

        linear, lower, upper = (x[0] for x in self.vectors(*np.zeros((5, 1))))
        solver = OSQP()
        solver.setup(
            triu(csc_matrix(quadratic), format="csc"),
            linear,
            csc_matrix(self._constraints()),
            lower,
            upper,
            verbose=False,
            warm_starting=False,  # a result must not depend on earlier programs
            adaptive_rho=0,
            eps_abs=self.settings.tolerance,
            eps_rel=self.settings.tolerance,
            max_iter=self.settings.iterations,
            check_termination=10,
        )
        return solver

    def __reduce__(self) -> Any:
        return FollowingProgram, (self.settings, self.limits)  # OSQP's object cannot be copied

    def __call__(self, rows: Array) -> tuple[Array, Array]:
        """Return the first accelerations, and 1 where there was no solution, ``[rows]``.

        Args:
            rows: speed, gap, acceleration, speed and acceleration ahead, ``[rows, 5]``.
        """
        distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
        first, unsolved = np.full(len(distinct), np.nan), np.zeros(len(distinct))
        finite = np.flatnonzero(np.isfinite(distinct).all(1))
        speed, gap, *rest = distinct[finite].T
        vectors = self.vectors(speed, gap.clip(-LONGEST_GAP, LONGEST_GAP), *rest)
        for row, linear, lower, upper in zip(finite, *vectors, strict=True):
            self.osqp.update(q=linear, l=lower, u=upper)
            result = self.osqp.solve(raise_error=False)
            solved = result.info.status_val == 1
            first[row] = np.clip(result.x[0], *self.limits) if solved else self.limits[0]
            unsolved[row] = not solved
        return first[inverse.ravel()], unsolved[inverse.ravel()]

    def _constraints(self) -> Array:
        """Return A ``[5 N, 4 N]``: gaps too short, too long, short for the speeds; speed; plan."""
        n, s = self.steps, self.settings
        rows = np.zeros((5 * n, 4 * n))
        closing = [
            self.ways + s.least_time_gap * self.speeds,
            -(self.ways + s.longest_time_gap * self.speeds),
            self.ways + s.least_ttc * self.speeds,
            -self.speeds,
            np.eye(n),
        ]
        rows[:, :n] = np.concatenate(closing)
        rows[: 3 * n, n:] = -np.eye(3 * n)
        return rows

    def vectors(
        self, speed: Array, gap: Array, acceleration: Array, ahead: Array, ahead_change: Array
    ) -> tuple[Array, Array, Array]:
        """Return q, ``[rows, 4 N]``, and the bounds l and u, ``[rows, 5 N]``, of states.

        Args:
            speed, gap, acceleration: of the vehicle, ``[rows]`` [m/s], [m], [m/s²].
            ahead, ahead_change: those of the vehicle ahead, ``[rows]`` [m/s], [m/s²].
        """
        s, n = self.settings, self.steps
        speed = speed[:, None]
        lead, distance = self.predicted(ahead[:, None], ahead_change[:, None])
        free = gap[:, None] + distance - speed * self.times  # gaps without accelerating
        # At equilibrium the limits leave a gap at any speed.
        narrowest = s.margin - (s.longest_time_gap - s.least_time_gap) * lead
        upper = [
            free - s.margin - s.least_time_gap * speed,
            s.longest_time_gap * speed + np.maximum(narrowest, s.longest_gap) - free,
            free - s.least_ttc * (speed - lead),
            np.broadcast_to(speed, free.shape),
            np.full_like(free, self.limits[1]),
        ]
        lower = np.full((len(free), 5 * n), -np.inf)
        lower[:, 4 * n :] = self.limits[0]
        linear = np.zeros((len(free), 4 * n))
        linear[:, :n] = s.steady_price * _steady_slope(speed) * self.speeds.sum(0)
        linear[:, 0] -= 2.0 * s.jerk_price * acceleration / s.step**2
        return linear, lower, np.concatenate(upper, 1)

    def predicted(self, speed: Array, acceleration: Array) -> tuple[Array, Array]:
        """Return speeds and distances of the vehicle ahead, ``[rows, N]`` [m/s], [m]."""
        decay = self.settings.acceleration_time
        change = decay * -np.expm1(-self.times / decay) if decay else np.zeros_like(self.times)
        speeds = np.maximum(speed + acceleration * change, 0.0)
        before = np.concatenate([speed, speeds[:, :-1]], 1)
        return speeds, np.cumsum(0.5 * self.settings.step * (before + speeds), 1)


def _steady_slope(speed: Array) -> Array:
    """Return dP/dv of the steady power divided by the loss of 1 m/s² at a speed (A2)."""
    (_, _, p02), (p10, _, p12), (p20, _, _), (p30, _, _) = POWER_COEFFICIENTS
    return (p10 + speed * (2.0 * p20 + speed * 3.0 * p30)) / (p02 + p12 * speed)
