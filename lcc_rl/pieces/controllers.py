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
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.idm import IDMConstants, idm_acceleration
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, VehicleString
from lcc_rl.functional.random import choose, normal, stream_id, uniform
from lcc_rl.pieces.base import SEED, Key, StepTransform, as_key, require_option
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
        """The parameters that the drivers share."""


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


class IDM(Controller):
    """Human drivers by the Intelligent Driver Model (A3–A4), each with its own (v0, T).

    Every vehicle draws a driver of the population by the episode's seed, unless ``(role,
    "driver")`` is given to ``env.reset``; or all are the one driver that ``desired_speed`` and
    ``time_gap`` describe. Constants of the episode under the role, ``[*batch, n, 1]``: driver,
    desired_speed [m/s], desired_time_gap [s].

    Args:
        population: the drivers.
        time_step: duration of a step [s].
        noise: largest relative error ξ of the executed acceleration a·(1 + ξ), drawn anew each
            step from U(0, noise) (A18).
        wiener: standard deviation of a random walk of the speed [m/s per √s].
        desired_speed: v0 of every vehicle; None: that of drivers of the population [m/s].
        time_gap: T of every vehicle, likewise [s].
        string, role: see :class:`Controller`.

    Raises:
        ConfigError: if a setting is out of range, one of v0 and T is given alone, or the drivers
            of the population differ in more than (v0, T).
    """

    desired_speeds: Tensor
    time_gaps: Tensor
    index: Tensor

    def __init__(
        self,
        population: Population,
        time_step: float,
        noise: float = 0.05,
        wiener: float = 0.0,
        desired_speed: float | None = None,
        time_gap: float | None = None,
        string: VehicleString | None = None,
        role: str = HUMAN,
    ) -> None:
        where = f"scenario.controllers.{role}"
        if any(isinstance(value, Tensor) for value in vars(population.constants).values()):
            raise ConfigError(
                f"{where}: drivers must share a, b and s0 (a locally calibrated population, "
                "drivers.mode=local), got a population in which they differ by driver"
            )
        require_in(where, "[0, 1)", noise=noise)
        require_in(where, "[0, inf)", wiener=wiener)
        constants = [(role, name) for name in ("driver", "desired_speed", "desired_time_gap")]
        names = ["self.speed", "self.gap", "self.relative_speed"]
        names += [".".join(key) for key in constants[1:]] + ["episode.seed", "episode.step"]
        super().__init__(string, role, names, (), constants, constants[:1])
        self.noise, self.spread = noise, wiener / time_step**0.5
        self.drivers = population.constants
        own = _given_driver(where, desired_speed, time_gap)
        drivers = (population.desired_speed, population.time_gap) if own is None else own
        self.noise_stream = stream_id(f"{stream_name(role)}.noise")
        self.wiener_stream = stream_id(f"{stream_name(role)}.wiener")
        self.driver_stream = stream_id(f"{stream_name(role)}.driver")
        self.register_buffer("desired_speeds", drivers[0])
        self.register_buffer("time_gaps", drivers[1])
        self.register_buffer("index", torch.arange(self.event_shape[0]).unsqueeze(-1))

    def command(
        self,
        speed: Tensor,
        gap: Tensor,
        relative_speed: Tensor,
        desired_speed: Tensor,
        time_gap: Tensor,
        seed: Tensor,
        step: Tensor,
    ) -> Tensor:
        """Return the commands."""
        command = idm_acceleration(
            speed, gap, -relative_speed, desired_speed, time_gap, self.drivers
        )
        if self.noise:
            draw = uniform(seed, step, self.noise_stream + self.index)
            command = command * (1.0 + self.noise * draw)
        if self.spread:
            command = command + self.spread * normal(seed, step, self.wiener_stream + self.index)
        return command

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        specs = super().constant_specs(batch, device)
        shape = (*batch, *self.event_shape)
        specs[self.constants[0]] = Unbounded(shape=shape, dtype=torch.int64, device=device)
        return specs

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        driver = given.get(self.reset_options[0], None)
        count = len(self.desired_speeds)
        if driver is None:
            seed = start.get(SEED).unsqueeze(-2)
            driver = choose(seed, count, self.driver_stream + self.index)
        else:
            require_option(self.reset_options[0], driver, count)
        values = (driver, self.desired_speeds[driver], self.time_gaps[driver])
        for key, value in zip(self.constants, values, strict=True):
            start.set(as_key(key), value)


def _given_driver(
    where: str, desired_speed: float | None, time_gap: float | None
) -> tuple[Tensor, Tensor] | None:
    """Return v0 and T as a population of one, None where neither is given."""
    if desired_speed is None and time_gap is None:
        return None
    if desired_speed is None or time_gap is None:
        raise ConfigError(f"{where}: desired_speed and time_gap belong together: give both or none")
    require_positive(where, desired_speed=desired_speed, time_gap=time_gap)
    return torch.tensor([float(desired_speed)]), torch.tensor([float(time_gap)])
