"""A model predictive controller: plans some seconds ahead and drives the first of it."""

from __future__ import annotations

from dataclasses import asdict
from importlib.util import find_spec
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, how_to_install, require_in, require_positive, require_whole
from lcc_rl.functional.mpc import Array, FollowingProgram, MPCSettings
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces.controllers import Controller

LONGEST = 200.0  # gaps beyond it are planned for as this one [m]
MOST_STEPS = 200  # of a plan


class MPC(Controller):
    """Plans accelerations by a quadratic program every step and commands the first one.

    Little energy within limits of the gap and of the time-to-collision, see
    :class:`lcc_rl.functional.mpc.FollowingProgram`; solved by OSQP (Stellato et al. 2020) from
    the same start every time, so that the command depends on what is read alone. Where OSQP finds
    no solution it brakes fully, and ``(role, "unsolved")``, ``[*batch, n, 1]``, is 1. It passes no
    gradient and is not compiled; rows that are alike are solved once.

    Args:
        settings: horizon, prediction, limits and prices.
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is out of range, or OSQP is not installed.
    """

    Settings: ClassVar[type[MPCSettings]] = MPCSettings
    reads = ("self.speed", "self.gap", "self.acceleration", "ahead.speed", "ahead.acceleration")

    def __init__(
        self,
        settings: MPCSettings | None = None,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        self.check_installed()
        settings = MPCSettings() if settings is None else settings
        _check(settings, f"scenario.controllers.{role}")
        super().__init__(string, role, writes=[(role, "unsolved")])
        self.settings = settings
        self.solver = Solver(settings)

    @staticmethod
    def check_installed() -> None:
        """Refuse to drive without OSQP.

        Raises:
            ConfigError: saying how to install it.
        """
        if find_spec("osqp") is None:
            raise ConfigError(f"controller=mpc needs osqp: {how_to_install('mpc')}")

    @torch.compiler.disable
    def command(self, *entries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the commands, and where there was no solution."""
        speed = entries[0]
        rows = torch.stack([x.detach().expand_as(speed).flatten() for x in entries], -1)
        first, unsolved = self.solver(rows.double().cpu().numpy())
        made = (torch.as_tensor(x).to(speed).view_as(speed) for x in (first, unsolved))
        return tuple(made)  # type: ignore[return-value]


class Solver:
    """Solves the program of many moments one after the other with one factorisation.

    Args:
        settings: of the controller.
    """

    def __init__(self, settings: MPCSettings) -> None:
        self.settings = settings
        self.program = FollowingProgram(settings)
        self.osqp = _set_up(self.program)

    def __reduce__(self) -> Any:
        return Solver, (self.settings,)  # OSQP's own object cannot be copied

    def __call__(self, rows: Array) -> tuple[Array, Array]:
        """Return the first accelerations and where there was no solution, ``[rows]``.

        Args:
            rows: speed, gap, acceleration, speed and acceleration ahead, ``[rows, 5]``.
        """
        alike, place = np.unique(rows, axis=0, return_inverse=True)
        first, unsolved = self._each(alike)
        return first[place.ravel()], unsolved[place.ravel()]

    def _each(self, rows: Array) -> tuple[Array, Array]:
        first, unsolved = np.full(len(rows), np.nan), np.zeros(len(rows))
        known = np.flatnonzero(np.isfinite(rows).all(1))
        limit = self.settings.max_acceleration
        speed, gap, *others = rows[known].T
        vectors = self.program.vectors(speed, gap.clip(-LONGEST, LONGEST), *others)
        each = zip(known, vectors.linear, vectors.lower, vectors.upper, strict=True)
        for row, linear, lower, upper in each:
            self.osqp.update(q=linear, l=lower, u=upper)
            found = self.osqp.solve(raise_error=False)
            solved = found.info.status_val == 1
            first[row] = np.clip(found.x[0], -limit, limit) if solved else -limit
            unsolved[row] = not solved
        return first, unsolved


def _set_up(program: FollowingProgram) -> Any:
    from osqp import OSQP
    from scipy.sparse import csc_matrix, triu

    settings, still = program.settings, np.zeros(1)
    vectors = program.vectors(still, still, still, still, still)
    solver = OSQP()
    solver.setup(
        triu(csc_matrix(program.quadratic), format="csc"),
        vectors.linear[0],
        csc_matrix(program.constraints),
        vectors.lower[0],
        vectors.upper[0],
        verbose=False,
        warm_starting=False,  # a result must not depend on what was solved before
        adaptive_rho=0,
        eps_abs=settings.tolerance,
        eps_rel=settings.tolerance,
        max_iter=settings.iterations,
        check_termination=10,
    )
    return solver


def _check(settings: MPCSettings, where: str) -> None:
    """Check settings of the node ``where``."""
    s = settings
    require_positive(where, horizon=s.horizon, step=s.step, max_acceleration=s.max_acceleration)
    values = asdict(s)
    names = ["acceleration_time", "margin", "least_time_gap", "least_ttc"]
    names += ["steady_price", "jerk_price"]
    require_in(where, "[0, inf)", **{name: values[name] for name in names})
    require_in(where, "(-inf, inf)", longest_gap=s.longest_gap)
    prices = ("near_price", "far_price", "ttc_price")
    require_positive(where, **{name: values[name] for name in prices})
    require_in(where, f"({s.least_time_gap}, inf)", longest_time_gap=s.longest_time_gap)
    require_in(where, "[1e-10, 0.1]", tolerance=s.tolerance)
    require_whole(where, 1, 1_000_000, iterations=s.iterations)
    steps = s.horizon / s.step
    if not 1 <= round(steps) <= MOST_STEPS or abs(steps - round(steps)) > 1e-6:
        raise ConfigError(
            f"{where}.horizon must be 1 to {MOST_STEPS} times step={s.step:g}, got {s.horizon:g}"
        )
