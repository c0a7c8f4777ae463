"""The quadratic program of a model predictive controller that follows a vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lcc_rl.functional.power import POWER_COEFFICIENTS

Array = np.ndarray


@dataclass(frozen=True)
class MPCSettings:
    """Horizon, prediction, limits and prices of :class:`lcc_rl.pieces.MPC`.

    Args:
        horizon: how far ahead is planned [s].
        step: duration of a step of the plan, which the horizon is a multiple of [s].
        acceleration_time: time constant with which the acceleration of the vehicle ahead is
            expected to decay; 0: it keeps its speed [s].
        margin: gap at standstill that is kept [m].
        least_time_gap: time gap that is kept beyond it [s].
        longest_time_gap: of the gap that is not exceeded, this times the speed [s] and …
        longest_gap: … this, which may be negative; more where the vehicle ahead is so slow that
            it would be less than the gap to be kept [m].
        least_ttc: time-to-collision that is kept [s].
        steady_price: weight of what the planned speeds take without accelerating.
        jerk_price: weight of the squared change of the acceleration per second [s²].
        near_price: of the squared distance by which the gap is too short [1/(m²s⁴)] …
        far_price: … or too long, likewise …
        ttc_price: … or too short for the time-to-collision, likewise.
        max_acceleration: limit in both directions [m/s²].
        tolerance: absolute and relative, at which the solver stops.
        iterations: after which it gives up.
    """

    horizon: float = 5.0
    step: float = 0.25
    acceleration_time: float = 1.5
    margin: float = 1.0
    least_time_gap: float = 0.5
    longest_time_gap: float = 2.8
    longest_gap: float = -8.5
    least_ttc: float = 4.1
    steady_price: float = 1.0
    jerk_price: float = 0.1
    near_price: float = 3.0
    far_price: float = 0.1
    ttc_price: float = 30.0
    max_acceleration: float = 3.0
    tolerance: float = 1e-4
    iterations: int = 4000


@dataclass(frozen=True)
class Vectors:
    """The parts of the program that depend on the moment, one row per vehicle.

    Args:
        linear: q, ``[rows, 4 N]``.
        lower, upper: bounds of A x, ``[rows, 5 N]``.
    """

    linear: Array
    lower: Array
    upper: Array


class FollowingProgram:
    """min ½ xᵀPx + qᵀx, l ≤ Ax ≤ u; x: N accelerations and N slacks of each of three limits.

    The plan's speeds and gaps are linear in its accelerations, so that P and A depend on settings
    only. Minimised is what accelerating loses (the part of A2 with a²) and ``steady_price`` times
    the slope of the steady power at the present speed, over the loss of 1 m/s² at that speed. The
    limits of the gap and of the time-to-collision are soft: there is always a solution.

    Args:
        settings: of the controller.

    Attributes:
        quadratic: P, ``[4 N, 4 N]``.
        constraints: A, ``[5 N, 4 N]``.
    """

    def __init__(self, settings: MPCSettings) -> None:
        self.settings, self.steps = settings, round(settings.horizon / settings.step)
        h, n = settings.step, self.steps
        self.times = h * np.arange(1, n + 1)
        sums = np.tril(np.ones((n, n)))
        self.speeds = h * sums  # of the plan, by its accelerations
        # Trapezoids, as the vehicles move (A18).
        self.ways = h * sums @ (self.speeds - 0.5 * h * np.eye(n))
        changes = (np.eye(n) - np.eye(n, k=-1)) / h
        own = np.eye(n) + settings.jerk_price * changes.T @ changes
        prices = (settings.near_price, settings.far_price, settings.ttc_price)
        self.quadratic = 2.0 * np.diag(np.repeat([0.0, *prices], n))
        self.quadratic[:n, :n] = 2.0 * own
        self.constraints = self._constraints()

    def _constraints(self) -> Array:
        """Return A: gap too short, too long, too short for the speeds; speed; acceleration."""
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
    ) -> Vectors:
        """Return what depends on the moment.

        Args:
            speed, gap, acceleration: of the vehicle, ``[rows]`` [m/s], [m], [m/s²].
            ahead, ahead_change: speed and acceleration of the one ahead, ``[rows]`` [m/s], [m/s²].
        """
        s, n = self.settings, self.steps
        speed = speed[:, None]
        lead, way = self.predicted(ahead[:, None], ahead_change[:, None])
        free = gap[:, None] + way - speed * self.times  # gaps without accelerating
        # Following steadily, the limits leave a gap at any speed.
        narrowest = s.margin - (s.longest_time_gap - s.least_time_gap) * lead
        upper = [
            free - s.margin - s.least_time_gap * speed,
            s.longest_time_gap * speed + np.maximum(narrowest, s.longest_gap) - free,
            free - s.least_ttc * (speed - lead),
            np.broadcast_to(speed, free.shape),
            np.full_like(free, s.max_acceleration),
        ]
        lower = np.full((len(free), 5 * n), -np.inf)
        lower[:, 4 * n :] = -s.max_acceleration
        linear = np.zeros((len(free), 4 * n))
        linear[:, :n] = s.steady_price * _steady_slope(speed) * self.speeds.sum(0)
        linear[:, 0] -= 2.0 * s.jerk_price * acceleration / s.step**2
        return Vectors(linear, lower, np.concatenate(upper, 1))

    def predicted(self, speed: Array, acceleration: Array) -> tuple[Array, Array]:
        """Return speeds and distances of the vehicle ahead, ``[rows, N]`` [m/s], [m]."""
        decay = self.settings.acceleration_time
        change = decay * -np.expm1(-self.times / decay) if decay else np.zeros_like(self.times)
        speeds = np.maximum(speed + acceleration * change, 0.0)
        before = np.concatenate([speed, speeds[:, :-1]], 1)
        return speeds, np.cumsum(0.5 * self.settings.step * (before + speeds), 1)


def _steady_slope(speed: Array) -> Array:
    """Return dP/dv of the steady power over the loss of 1 m/s² at a speed, from A2."""
    (_, _, p02), (p10, _, p12), (p20, _, _), (p30, _, _) = POWER_COEFFICIENTS
    return (p10 + speed * (2.0 * p20 + speed * 3.0 * p30)) / (p02 + p12 * speed)
