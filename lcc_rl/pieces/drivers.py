"""Human drivers: driver models with noise and a reaction delay, as controllers of any role."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import torch
from pydantic import BeforeValidator, Field, InstanceOf
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.functional.driver_models import GAP_NOISE_TIME, DriverConstants, NoiseStep, Reaction
from lcc_rl.functional.gipps import GippsConstants
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.laws import LAWS
from lcc_rl.functional.layout import join, reverse
from lcc_rl.functional.ovm import FVDMConstants, OVMConstants
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.functional.random import between, choose, normal, stream_id, uniform
from lcc_rl.pieces.base import SEED, Entry, require_option
from lcc_rl.pieces.controllers import Controller, stream_name
from lcc_rl.pieces.features import first_speeds, of_role, speed_limits
from lcc_rl.pieces.leader import LEADER_SPEED
from lcc_rl.pieces.views import MOTION_READS
from lcc_rl.pieces.world import MOST_LATE, World
from lcc_rl.settings import Factors, Increasing, NonNegative, Positive, Share, defaults, values

Delay = Annotated[int, Field(ge=0, le=MOST_LATE)]
# Draws that all drivers of an episode share.
WIENER_STREAM, TIME_GAP_STREAM, DELAY_STREAM, NOISE_STREAM = (
    stream_id(f"drivers.{name}") for name in ("wiener", "time_gap", "delay", "noise")
)
LONGEST_TIME_GAP = 1000.0  # time gap up to which an equilibrium gap is written [s]


class Drivers(Controller):
    """Base of human drivers: individual (v0, T), noise and a reaction delay.

    Every vehicle draws a driver by the episode's seed, unless ``(role, "driver")`` is given to
    ``env.reset``. Further entries are written where they are needed: the equilibrium gap, unless
    the drivers are IDM drivers or on a ring; the past motion with a delay; the latest values of
    a noise.
    """

    # Largest relative error ξ of the executed acceleration a·(1 + ξ), drawn anew each step from
    # U(0, noise) (A18).
    noise: Share = 0.05
    wiener: NonNegative = 0.0  # standard deviation of a random walk of the speed [m/s per √s]
    # Ranges of a factor on wiener and on every driver's T in training; 1 in evaluation.
    wiener_range: Factors = (1.0, 1.0)
    time_gap_range: Factors = (1.0, 1.0)
    # Age in steps of the speed, gap and relative speed that the driver reacts to; in the first
    # steps they are those of the start. None: the reaction delay of the population.
    delay: Delay | None = None
    # Range in steps from which every training episode draws its delay. Evaluation uses delay, as
    # does training without a range.
    delay_range: Annotated[tuple[Delay, Delay], Increasing] | None = None
    # Standard deviation of a smooth noise of the acceleration, see
    # lcc_rl.functional.driver_models.NoiseStep [m/s²]; None: that of the population.
    acceleration_noise: NonNegative | None = None
    # Range from which every training episode draws acceleration_noise, likewise [m/s²].
    acceleration_noise_range: Annotated[tuple[NonNegative, NonNegative], Increasing] | None = None
    # Standard deviation of a smooth noise of ln(perceived gap); None: that of the population.
    gap_noise: NonNegative | None = None

    of_training = ("wiener_range", "time_gap_range", "delay_range", "acceleration_noise_range")
    reads_drivers = True
    name = HUMAN
    known = (
        Entry("role.driver", "–", "id of each vehicle's driver in the population", option=True),
        Entry("role.desired_speed", "m/s", "desired speed v0 of the driver"),
        Entry("role.desired_time_gap", "s", "desired time gap T of the driver"),
        Entry(
            "role.equilibrium_gap", "m", "gap at which the driver follows the leader's first speed"
        ),
    )
    history = Entry(
        "role.motion_history", "m/s, m, m/s", "past (speed, gap, relative speed), latest first"
    )
    latest = Entry("role.acceleration_noise", "m/s²", "noise of the acceleration, latest first", 2)
    gap_latest = Entry("role.gap_noise", "–", "noise of ln(perceived gap), latest first", 2)
    law: ClassVar[type[DriverConstants]] = IDMConstants
    tells_gap = False  # whether the equilibrium gap is written
    further: ClassVar[tuple[str, ...]] = ()  # entries of the role that acceleration reads, too
    desired_speeds: ClassVar[Tensor]
    time_gaps: ClassVar[Tensor]
    index: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        """Read the drivers, and choose the entries by the settings."""
        role, self.fleet = self.name, world.energy
        speeds, time_gaps, self.drivers = self.described(world, f"scenario.controllers.{role}")
        reaction = self.reaction(world)
        late, spread, sight = self.delay, self.acceleration_noise, self.gap_noise
        what = "the reaction delay of drivers"
        late = world.late(reaction.delay, what) if late is None else late
        noise = reaction.noise if spread is None else spread
        # Range of the delay; the memory of drivers covers the largest one.
        ranges = self.delay_range, self.acceleration_noise_range
        delays, noises = (None, None) if world.nominal else ranges
        self.soonest, self.late = delays or (late, late)
        self.noise_least, self.noise_spread = noises or (noise, noise)
        self.gap_spread = reaction.gap_noise if sight is None else sight
        drawn = self.noise, self.wiener, self.noise_spread, self.gap_spread
        self.steady = not any(drawn) and self.soonest == self.late
        self.noise_step = NoiseStep.of(world.time_step)
        self.gap_noise_step = NoiseStep.of(world.time_step, GAP_NOISE_TIME)
        self.starts = self.tells_gap and not world.string.ring
        memory = [self.history.wide(3 * self.late)] * (self.late > 0)
        memory += [self.latest] * (self.noise_spread > 0)
        memory += [self.gap_latest] * (self.gap_spread > 0)
        names = [*MOTION_READS, f"{role}.desired_speed", f"{role}.desired_time_gap", "episode.seed"]
        names += ["episode.step", *(f"{role}.{name}" for name in self.further)]
        self.declare(world, names, keeps=self.known[: 3 + self.starts], remembers=memory)
        self.limits = None  # no clamp at ±3 m/s² in automated vehicles
        walk = self.wiener / world.time_step**0.5
        self.spreads = tuple(walk * factor for factor in world.deviations(self.wiener_range))
        self.time_gap_factors = world.deviations(self.time_gap_range)
        self.noise_stream = stream_id(f"{stream_name(role)}.noise")
        self.wiener_stream = stream_id(f"{stream_name(role)}.wiener")
        self.noise_streams, self.gap_noise_streams = (
            [stream_id(f"{stream_name(role)}.{what}{end}") for end in ("", ".before")]
            for what in ("acceleration_noise", "gap_noise")
        )
        self.driver_stream = stream_id(f"{stream_name(role)}.driver")
        self.register_buffer("desired_speeds", speeds)
        self.register_buffer("time_gaps", time_gaps)
        self.register_buffer("index", torch.arange(*self.rows).unsqueeze(-1))

    def described(self, world: World, where: str) -> tuple[Tensor, Tensor, DriverConstants]:
        """Return v0 [m/s] and T [s] of the drivers, ``[drivers]``, and their shared parameters.

        Raises:
            ConfigError: if there are no drivers, or their model differs.
        """
        population = world.given("population", where)
        return population.desired_speed, population.time_gap, population.constants

    def reaction(self, world: World) -> Reaction:
        """Return the reaction of the population's drivers; no reaction if it has none."""
        return getattr(world.population, "reaction", Reaction())

    def command(
        self,
        speed: Tensor,
        gap: Tensor,
        relative_speed: Tensor,
        desired_speed: Tensor,
        time_gap: Tensor,
        seed: Tensor,
        step: Tensor,
        *more: Tensor,
    ) -> Any:
        """Return the commands, then the history and the noise if they are kept."""
        motion = (speed, gap, relative_speed)
        memories: list[Tensor] = []
        noise = sight = None
        if self.gap_spread:
            *more, before = more  # type: ignore[assignment]
            args = self.gap_spread, self.gap_noise_step, self.gap_noise_streams
            memories.insert(0, sight := self._noise_of(before, seed, step, *args))
        if self.noise_spread:
            *more, before = more  # type: ignore[assignment]
            args = self.noise_spread, self.noise_step, self.noise_streams
            memories.insert(0, noise := self._noise_of(before, seed, step, *args))
        if self.late:
            *more, history = more  # type: ignore[assignment]
            now = join(motion, -1)
            # In the first step the whole history is the present.
            past = torch.where(step == 0, now.repeat(*[1] * (now.ndim - 1), self.late), history)
            frames = join([now, past], -1)
            motion = self._then(frames, seed).split(1, -1)
            memories.insert(0, frames[..., :-3])
        if sight is not None:
            motion = (motion[0], motion[1] * sight[..., :1].exp(), motion[2])
        command = self.acceleration(*motion, desired_speed, time_gap, *more)
        if self.noise:
            draw = uniform(seed, step, self.noise_stream + self.index)
            command = command * (1.0 + self.noise * draw)
        if self.wiener:
            spread = between(self.spreads, seed, WIENER_STREAM)
            command = command + spread * normal(seed, step, self.wiener_stream + self.index)
        if noise is not None:
            least = self.noise_least / self.noise_spread
            factor = between((least, 1.0), seed, NOISE_STREAM)
            command = command + factor * noise[..., :1]
        return (command, *memories) if memories else command

    def _then(self, frames: Tensor, seed: Tensor) -> Tensor:
        """Return the motion that the drivers react to from the motion seen, latest first."""
        if self.soonest == self.late:
            return frames[..., -3:]
        span = self.late - self.soonest + 1
        late = self.soonest + (span * uniform(seed, 0, DELAY_STREAM)).long()
        columns = 3 * late + torch.arange(3, device=frames.device)
        columns = columns.expand(*frames.shape[:-1], 3)
        return reverse(reverse(frames).gather(0, reverse(columns)))

    def _noise_of(
        self,
        before: Tensor,
        seed: Tensor,
        step: Tensor,
        spread: float,
        noise_step: NoiseStep,
        streams: Sequence[int],
    ) -> Tensor:
        """Return the latest two values of a noise from the previous two."""
        drawn, further = (spread * normal(seed, step, stream + self.index) for stream in streams)
        first = join(noise_step.start(drawn, further), -1)
        latest, last = before.split(1, -1)
        later = join([noise_step.next(latest, last, drawn), latest], -1)
        return torch.where(step == 0, first, later)

    def acceleration(
        self,
        speed: Tensor,
        gap: Tensor,
        relative_speed: Tensor,
        desired_speed: Tensor,
        time_gap: Tensor,
        *more: Tensor,
    ) -> Tensor:
        """Return the desired acceleration without noise [m/s²], all ``[*batch, n, 1]``."""
        return self.drivers(speed, gap, -relative_speed, desired_speed, time_gap)

    def equilibrium_gap(
        self, speed: Tensor, desired_speed: Tensor, time_gap: Tensor, driver: Tensor
    ) -> Tensor:
        """Return the equilibrium gap [m], all ``[*batch, n, 1]``."""
        return self.drivers.equilibrium_gap(speed, desired_speed, time_gap, LONGEST_TIME_GAP)

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        super().begin(given, start)
        driver = given.get(self.reset_options[0], None)
        count = len(self.desired_speeds)
        if driver is None:
            seed = start.get(SEED).unsqueeze(-2)
            driver = choose(seed, count, self.driver_stream + self.index)
        else:
            require_option(self.reset_options[0], driver, count)
        factor = between(self.time_gap_factors, start.get(SEED).unsqueeze(-2), TIME_GAP_STREAM)
        desired, limits = self.desired_speeds[driver], speed_limits(start, self.fleet)
        if limits is not None:
            desired = torch.minimum(desired, of_role(limits, start, self.string, self.name))
        values = [driver, desired, factor * self.time_gaps[driver]]
        if self.starts:
            speed = first_speeds(start.get(LEADER_SPEED), len(self.string), limits)
            speed = of_role(speed, start, self.string, self.name)
            values.append(self.equilibrium_gap(speed, values[1], values[2], driver))
        for key, value in zip(self.constants, values, strict=True):
            start.set(key, value)


def _made(value: Any) -> Any:
    if isinstance(value, Mapping):
        raise ValueError(
            "expected a node with _target_; a, b and s0 of all drivers are set by drivers=fixed "
            "drivers.acceleration=… drivers.deceleration=… drivers.min_gap=…"
        )
    return value


class DriverModel(Drivers):
    """Drivers of one model: those of the population, or the same driver in all vehicles.

    They execute the desired acceleration with a relative error (A18).

    Your own model overrides :meth:`acceleration`, or sets ``law`` to a
    :class:`lcc_rl.functional.driver_models.DriverConstants` and ``tells_gap``.
    """

    # v0 of every vehicle; None: that of the population [m/s]. Needs time_gap, too.
    desired_speed: Positive | None = None
    time_gap: Positive | None = None  # T of every vehicle, likewise [s]; needs desired_speed, too
    # The law's constants besides v0 and T; None: those of the population. A driver of given (v0, T)
    # has their means if they differ by driver.
    parameters: Annotated[InstanceOf[DriverConstants] | None, BeforeValidator(_made)] = None

    def validate(self) -> None:
        if (self.desired_speed is None) != (self.time_gap is None):
            raise ValueError("desired_speed and time_gap belong together: give both or none")

    def reaction(self, world: World) -> Reaction:
        """Return the population's reaction; drivers of given (v0, T) have none."""
        return super().reaction(world) if self.desired_speed is None else Reaction()

    def described(self, world: World, where: str) -> tuple[Tensor, Tensor, DriverConstants]:
        """Return the drivers, see :class:`Drivers`; drivers of other models are refused."""
        single = self.desired_speed is not None
        if single:
            pair = torch.tensor([[float(x)] for x in (self.desired_speed, self.time_gap)])  # type: ignore[arg-type]
            shared = self.law() if world.population is None else world.population.constants.mean()
            drivers = (pair[0], pair[1], shared)
        else:
            drivers = super().described(world, where)
        constants = drivers[2] if self.parameters is None else self.parameters
        text = f"{where}.parameters: expected {self.law.__name__}, got {constants!r}"
        require(isinstance(constants, self.law), text)
        shared = not any(isinstance(value, Tensor) for value in vars(constants).values())
        shared = shared and (single or not getattr(world.population, "models", None))
        own = f"controller@scenario.controllers.{HUMAN}=calibrated drives each by its own"
        require(shared, f"{where}: drivers differ in model, a, b or s0; {own}")
        self.reads_drivers = not single or constants != self.law()
        self.tells_gap = self.tells_gap or self.parameters is not None
        return (*drivers[:2], constants)


class CalibratedDrivers(Drivers):
    """Drivers of the population; each follows its calibrated model and parameters."""

    tells_gap = True
    further = ("driver",)
    kinds: ClassVar[Tensor]

    def setup(self, world: World) -> None:
        super().setup(world)
        population = world.population
        known = hasattr(population, "parameters")
        require(known, f"{self.title}: expected a population with its drivers' parameters")
        models = getattr(population, "models", None) or ("idm",) * len(population.time_gap)
        self.models = [name for name in LAWS if name in models]
        self.register_buffer("kinds", torch.tensor([self.models.index(name) for name in models]))
        for name, own in population.parameters().items():
            # Parameters that a driver's model lacks are computed, too, and need a finite gradient.
            otherwise = [getattr(LAWS[model], name, 1.0) for model in self.models]
            self.register_buffer(f"own_{name}", own.float().nan_to_num(nan=otherwise[0]))

    def acceleration(self, speed: Tensor, *more: Tensor) -> Tensor:
        """Return the desired acceleration of each driver by its model."""
        gap, relative_speed, desired_speed, time_gap, driver = more
        motion = (speed, gap, -relative_speed, desired_speed, time_gap)
        return self._each(driver, lambda law: law(*motion))

    def equilibrium_gap(self, speed: Tensor, *more: Tensor) -> Tensor:
        """Return the equilibrium gap of each driver by its model."""
        desired_speed, time_gap, driver = more
        steady = (speed, desired_speed, time_gap, LONGEST_TIME_GAP)
        return self._each(driver, lambda law: law.equilibrium_gap(*steady))

    def _each(self, driver: Tensor, quantity: Callable[[DriverConstants], Tensor]) -> Tensor:
        results = []
        for law in map(LAWS.__getitem__, self.models):
            constants = {x: getattr(self, f"own_{x}")[driver] for x in law.shared()}
            results.append(quantity(law(**constants)))
        for number, result in enumerate(results[1:], 1):
            results[0] = torch.where(self.kinds[driver] == number, result, results[0])
        return results[0]


class IDM(DriverModel):
    """Drivers of the Intelligent Driver Model (A3–A4).

    Drivers of the population that differ in model, a, b or s0 become :class:`CalibratedDrivers`.
    """

    def bind(self, world: World | None = None, name: str | None = None) -> Any:
        population: Any = None if world is None or self.desired_speed else world.population
        shared = vars(population.constants).values() if population else ()
        differ = getattr(population, "models", None) or any(isinstance(x, Tensor) for x in shared)
        if type(self) is not IDM or self.parameters is not None or not differ:
            return super().bind(world, name)
        own = {x: value for x, value in values(self).items() if x in defaults(Drivers)}
        return CalibratedDrivers(**own).bind(world, name)


class OVM(DriverModel):
    """Drivers of the optimal velocity model, see :class:`lcc_rl.functional.ovm.OVMConstants`.

    The model ignores the speed difference and may collide.
    """

    law = OVMConstants
    tells_gap = True


class FVDM(DriverModel):
    """Drivers of the full velocity difference model.

    See :class:`lcc_rl.functional.ovm.FVDMConstants`.
    """

    law = FVDMConstants
    tells_gap = True


class Gipps(DriverModel):
    """Drivers of Gipps' model, see :class:`lcc_rl.functional.gipps.GippsConstants`."""

    law = GippsConstants
    tells_gap = True
