"""Engine and brakes between the commands of a role and its motion."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from torch import Tensor

from lcc_rl.energy.base import GRAVITY
from lcc_rl.errors import require
from lcc_rl.functional.actuation import Response
from lcc_rl.functional.layout import join
from lcc_rl.pieces.base import Entry, RoleTransform
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

ACTUATION = "actuation"
HARDEST = 1e3  # above any braking that is commanded [m/s²]


class Actuation(RoleTransform):
    """Turns commands into accelerations, with a delay, a first-order lag and limited brakes.

    It keeps the last acceleration and the commands that do not act yet, oldest first; zeros at the
    start.
    """

    delay: NonNegative = 0.0  # between a command and its first effect, a number of steps [s]
    lag: NonNegative = 0.0  # time constant with which the acceleration follows the command [s]
    braking: Positive | None = None  # hardest braking possible; None: no limit [m/s²]
    # Share of gravity along a slope that engine and brakes do not make up for.
    slope: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0

    obeyed = Entry("role.obeyed", "m/s²", "acceleration of engine and brakes for the command")
    kept = Entry("role.actuation", "m/s²", "last acceleration, then commands that do not act yet")

    def setup(self, world: World) -> None:
        self.response = self.response_in(world, self.name, HARDEST)
        reads = [f"next.{self.name}.command", f"{self.name}.{ACTUATION}"]
        if self.slope:
            where = f"scenario.actuators.{self.name}.slope"
            require(world.slope is not None, f"{where} needs a slope: +slope=hills")
            require(self.name not in world.filtered, f"{where}: the safety filter knows no slopes")
            reads.append("self.grade")
        self.declare(world, reads, [self.obeyed, self.kept.wide(1 + self.response.late)])

    def response_in(self, world: World, role: str, hardest: float) -> Response:
        """Return the response of the role's vehicles; ``hardest``: of the commands [m/s²].

        Raises:
            ConfigError: if the delay is no multiple of the time step or too long, or the braking
                exceeds that of the vehicle.
        """
        late = world.late(self.delay, f"scenario.actuators.{role}.delay")
        limits = world.limits(role)
        require(
            limits is None or (self.braking or 0.0) <= -limits[0],
            f"scenario.actuators.{role}.braking={self.braking} has no effect above "
            f"scenario.max_braking={world.max_braking:g}",
        )
        braking = min(self.braking or hardest, hardest)
        return Response.of(late, self.lag, braking, world.time_step)

    def compute(self, command: Tensor, memory: Tensor, *grade: Tensor) -> tuple[Tensor, Tensor]:
        line = join([memory[..., 1:], command], -1)
        acceleration = self.response.next(memory[..., :1], line[..., :1])
        kept = join([acceleration, line[..., 1:]], -1)
        for angle in grade:
            acceleration = acceleration - self.slope * GRAVITY * angle.sin()
        return acceleration, kept
