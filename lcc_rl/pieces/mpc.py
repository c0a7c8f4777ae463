"""A model predictive controller: plans some seconds ahead and drives the first of it."""

from __future__ import annotations

from dataclasses import fields
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lcc_rl.errors import ConfigError, how_to_install
from lcc_rl.functional.mpc import Array, FollowingProgram, MPCSettings
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.world import World

LONGEST = 200.0  # gaps beyond it are planned for as this one [m]


class MPC(MPCSettings, Controller):
    """Plans accelerations by a quadratic program every step and commands the first one.

    Little energy within limits of the gap and of the time-to-collision, see
    :class:`lcc_rl.functional.mpc.FollowingProgram`; solved by OSQP (Stellato et al. 2020) from
    the same start every time, so that the command depends on what is read alone. Where OSQP finds
    no solution it brakes fully, and ``(role, "unsolved")``, ``[*batch, n, 1]``, is 1. It passes no
    gradient and is not compiled; rows that are alike are solved once.
    """

    reads = ("self.speed", "self.gap", "self.acceleration", "ahead.speed", "ahead.acceleration")

    def setup(self, world: World) -> None:
        """Set up the solver."""
        self.check_installed()
        self.drive(world, self.reads, [(self.name, "unsolved")])
        own = {field.name: getattr(self, field.name) for field in fields(MPCSettings)}
        self.solver = Solver(MPCSettings(**own))

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
