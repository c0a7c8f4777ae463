"""Controllers: what the vehicles of a role wish to do, one acceleration each.

A controller of your own is a class with the names it reads (:mod:`lcc_rl.pieces.views`) and its
law::

    class KeepDistance(Controller):
        reads = ("self.gap", "self.relative_speed")
        def command(self, gap, relative_speed): return 0.1 * (gap - 20.0) + 0.5 * relative_speed

and ``scenario.controllers.automated._target_=mymodule.KeepDistance`` on the command line. Any
controller drives any role, and is a policy by :class:`lcc_rl.policies.ControllerPolicy`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Protocol

import torch
from tensordict.utils import NestedKey
from torch import Tensor

from lcc_rl.errors import require_in, require_positive
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, VehicleString
from lcc_rl.pieces.base import StepTransform
from lcc_rl.pieces.views import Views

# The names of the random streams: an episode's seed means the same episode under either.
STREAMS = {AUTOMATED: "cav", HUMAN: "hdv"}


def stream_name(role: str) -> str:
    """Return the name under which a role draws random numbers."""
    return STREAMS.get(role, role)


class Population(Protocol):
    """What the pieces need to know of a driver population."""

    @property
    def desired_speed(self) -> Tensor:
        """v0 of each driver, ``[drivers]`` [m/s]."""

    @property
    def time_gap(self) -> Tensor:
        """T of each driver, ``[drivers]`` [s]."""

    @property
    def constants(self) -> IDMConstants:
        """The parameters of the IDM that the drivers share."""


class Controller(StepTransform):
    """Base of all controllers: writes ``("command", role)``, ``[*batch, n, 1]`` [m/s²].

    Args:
        string: the string of vehicles; one automated vehicle where not given.
        role: the role that it drives.
        reads: names of what it reads, where they depend on settings.
        writes: entries written besides the command, in the order of the values after it.
        constants, reset_options: see :class:`lcc_rl.pieces.base.StepTransform`.
    """

    reads: ClassVar[tuple[str, ...]] = ()
    # Maps what is read, one row per vehicle of the role, to the commands [*batch, n, 1], or to a
    # tuple of them and the further entries written.
    command: Callable[..., Any]

    def __init__(
        self,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
        reads: Sequence[str] | None = None,
        writes: Sequence[NestedKey] = (),
        constants: Sequence[NestedKey] = (),
        reset_options: Sequence[NestedKey] = (),
    ) -> None:
        string = VehicleString((role,)) if string is None else string
        self.role, self.string = role, string
        self.names = tuple(self.reads if reads is None else reads)
        self.views = Views(string, role, self.names)
        super().__init__(
            self.views.keys,
            [("command", role), *writes],
            constants,
            reset_options,
            (string.count(role), 1),
        )

    def compute(self, *entries: Tensor) -> Any:
        """Return the commands, and what else is written."""
        return self.command(*self.views(*entries))


class Action(Controller):
    """The action of a policy, in [−1, 1], times the largest acceleration.

    Reads ``(role, "action")``, ``[*batch, n, 1]``; like everybody who reads it by its name, it
    sees actions beyond the range as its ends (:mod:`lcc_rl.pieces.views`).

    Args:
        max_acceleration: acceleration of action 1, braking of action −1 [m/s²].
        string, role: see :class:`Controller`.

    Raises:
        ConfigError: if ``max_acceleration`` is not positive.
    """

    def __init__(
        self,
        max_acceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        require_positive(f"scenario.controllers.{role}", max_acceleration=max_acceleration)
        super().__init__(string, role, [f"{role}.action"])
        self.max_acceleration = max_acceleration

    def command(self, action: Tensor) -> Tensor:
        """Return the commands."""
        return action * self.max_acceleration


class ConstantAcceleration(Controller):
    """The same acceleration always; behind a safety filter, the filter alone drives.

    Args:
        acceleration: that acceleration [m/s²].
        string, role: see :class:`Controller`.

    Raises:
        ConfigError: if ``acceleration`` is not finite.
    """

    reads = ("self.speed",)

    def __init__(
        self,
        acceleration: float = 0.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        require_in(f"scenario.controllers.{role}", "(-inf, inf)", acceleration=acceleration)
        super().__init__(string, role)
        self.acceleration = acceleration

    def command(self, speed: Tensor) -> Tensor:
        """Return the commands."""
        return torch.full_like(speed, self.acceleration)
