"""Engine and brakes between the commands of a role and its motion."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import require
from lcc_rl.functional.actuation import Response
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.base import Key, StepTransform
from lcc_rl.pieces.string import OBEYED
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

ACTUATION = "actuation"
HARDEST = 1e3  # braking that nobody commands [m/s²]


class Actuation(StepTransform):
    """Makes accelerations of commands: after a delay, with a first-order lag, within the brakes.

    Reads ``("command", role)`` and writes what the vehicles obey, ``("obeyed", role)``, both
    ``[*batch, n, 1]`` [m/s²]. Keeps ``(role, "actuation")``, ``[*batch, n, 1 + steps]``: the last
    acceleration and the commands that do not act yet, the oldest first [m/s²]; zeros at the start.
    """

    delay: NonNegative = 0.0  # between a command and its first effect, a number of steps [s]
    lag: NonNegative = 0.0  # time constant with which the acceleration follows the command [s]
    braking: Positive | None = None  # hardest braking that there is; None: as commanded [m/s²]

    name = AUTOMATED

    def setup(self, world: World) -> None:
        """Read the commands of the role."""
        self.response = response_of(self.delay, self.lag, self.braking or HARDEST, world, self.name)
        state = (self.name, ACTUATION)
        wanted = f"next.command.{self.name}"
        writes = [(OBEYED, self.name), state]
        self.see(world, [wanted, ".".join(state)], writes, self.name)

    def compute(self, *entries: Tensor) -> tuple[Tensor, Tensor]:
        """Return the accelerations, and what is kept."""
        command, kept = self.views(*entries)
        line = torch.cat([kept[..., 1:], command], -1)
        acceleration = self.response.next(kept[..., :1], line[..., :1])
        return acceleration, torch.cat([acceleration, line[..., 1:]], -1)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        specs = super().written_specs(batch, device)
        shape = (*batch, self.event_shape[0], 1 + self.response.late)
        specs[self.targets[1]] = Unbounded(shape=shape, device=device)
        return specs


def response_of(delay: float, lag: float, braking: float, world: World, role: str) -> Response:
    """Return the response of a role.

    Raises:
        ConfigError: if the delay is no number of steps.
    """
    steps = delay / world.time_step
    require(
        abs(steps - round(steps)) < 1e-6,
        f"the delay of {role} must be a multiple of the time step, {world.time_step:g} s, got "
        f"{delay:g} s",
    )
    return Response.of(delay, lag, braking, world.time_step)
