"""The control barrier function (CBF) safety filter between a controller and its vehicles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from pydantic import InstanceOf
from torch import Tensor

from lcc_rl.functional.actuation import PairState, predicted
from lcc_rl.functional.braking import (
    Braking,
    least_room,
    least_room_to_come,
    safe_acceleration,
    safe_command,
)
from lcc_rl.functional.layout import batch_innermost, join
from lcc_rl.functional.pattern import MAX_ACCELERATION
from lcc_rl.functional.sensing import Agreement, brought_up
from lcc_rl.pieces.actuation import ACTUATION, Actuation
from lcc_rl.pieces.base import Entry, RoleTransform
from lcc_rl.pieces.sensors import AGES, SENSORS, Sensors, frames_of
from lcc_rl.pieces.string import COMMANDED, WANTED
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

ROUNDING = 5e-3  # of gaps [m] and accelerations [m/s²] in single precision
FILTER_READS = ("self.speed", "self.gap", "ahead.speed", "ahead.acceleration")
REMEMBERS = 3  # numbers in the filter's memory of gaps
SLOWEST = 1.0  # slower speeds count as this, which gives the limit a slope [m/s]


class CBFFilter(RoleTransform):
    """Changes a command as little as needed to keep the vehicle within its limits.

    Two functions of the state are kept positive: ``gap − margin − τ·(v − v_ahead)``, which keeps
    time-to-collision above τ, and ``longest(v) − gap``, which keeps the time gap below
    ``time_gap``. Each may fall per second by at most its rate times its value. This bounds the
    acceleration from above and from below; within the bounds the command is unchanged. If the
    bounds conflict, safety has priority. This is the quadratic program of Ames, Grizzle and
    Tabuada ("Control barrier function based quadratic programs with application to adaptive
    cruise control", CDC 2014), whose solution for one number is a clamp. The vehicle ahead is
    expected to keep its last measured acceleration.

    These bounds depend on that expectation. A third bound does not: full braking must still keep
    the first limit if the vehicle ahead brakes by ``braking_ahead`` until it stands
    (:mod:`lcc_rl.functional.braking`). A vehicle that starts in such a state has no TTC below τ at
    any sample as long as the vehicle ahead brakes no harder. The :class:`CBFGuarantee` of
    :meth:`watch` marks the covered steps. If a measurement or the command is NaN, the filter
    brakes fully.

    Gaps have priority over speeds. If the rate of the measured gap differs from the measured
    relative speed (:class:`lcc_rl.functional.sensing.Agreement`), the limits of short gaps use the
    lower speed ahead, those of long gaps the higher one. While the gap is below ``margin`` and does
    not grow, the vehicle does not accelerate.

    With ``shortest_time_gap``, ``gap − shortest_time_gap·v`` is kept positive, too, as long as the
    vehicle ahead keeps its acceleration and braking suffices.

    With ``longest_gap``, ``longest_gap − gap − h·(v_ahead − v)`` is kept positive, too, with
    ``h = √(2·longest_gap / a)`` and the largest acceleration a; the last two terms are the gap
    after h at the present speeds. Half of the acceleration suffices to keep this limit; the other
    half is left for a vehicle ahead that accelerates. Limits of short gaps have priority.

    Behind a leader at standstill both limits are about gap / speed, so a vehicle that approaches
    from far away must violate one of them. With ``full_speed``, ``longest(v)`` is ``time_gap·v``
    above this speed and falls with the square of the speed below: the vehicle closes up before
    its leader stands, which costs energy.

    A ``robust`` filter uses the scenario's actuators and sensors (:class:`Actuation`,
    :class:`Sensors`):

    1. It takes the worst state within the errors of the measurement.
    2. It predicts the present from it with the accelerations driven since.
    3. It predicts the moment at which the command acts, with the pending commands and a vehicle
       ahead that brakes by ``braking_ahead``.
    4. Full braking is reached with the lag (:func:`lcc_rl.functional.braking.safe_command`).

    The other bounds use the expected state. The filter reads ``(role, "wanted")``, which the
    controller of a filtered role writes. It is differentiable.
    """

    # Lowers the limits of the vehicles, in both directions; 3: it does not [m/s²].
    max_acceleration: Positive = MAX_ACCELERATION
    # Use the actuators and sensors of the scenario; false: assume that both are exact.
    robust: bool = True
    time_to_collision: Positive = 4.0  # shortest allowed [s]
    rate: Positive = 3.0  # largest relative rate of approach to that limit [1/s]
    margin: Positive = 0.2  # gap that counts as contact [m]
    braking_ahead: Positive = 2.6  # hardest braking assumed of the vehicle ahead [m/s²]
    time_gap: Positive | None = 2.45  # longest allowed; None: no limit [s]
    shortest_time_gap: Positive | None = None  # shortest allowed; None: no limit [s]
    longest_gap: Positive | None = None  # longest allowed; None: no limit [m]
    # Largest relative rate of approach to the limits of the time gap and the longest gap [1/s].
    time_gap_rate: Positive = 0.2
    # Speed below which the longest time gap falls in proportion to the speed; 0: never [m/s].
    full_speed: NonNegative = 0.0
    least_gap: NonNegative = 2.0  # gap that the limit of the time gap allows at any speed [m]
    from_s: NonNegative = 0.0  # time of the episode from which it acts, see Handover [s]

    measures = of_limits = True
    agreed = Entry(
        "role.agreement",
        "–, m, m/s",
        "1, last measured gap, its rate minus the relative speed",
        REMEMBERS,
    )
    writes = (COMMANDED, agreed)

    def validate(self) -> None:
        if self.time_gap is not None and (self.shortest_time_gap or 0.0) >= self.time_gap:
            shortest = f"shortest_time_gap={self.shortest_time_gap}"
            raise ValueError(f"{shortest} must be below time_gap={self.time_gap}")

    def setup(self, world: World) -> None:
        """Read the commands of the role and what bounds them."""
        self.time_step = world.time_step
        actuation = world.actuators.get(self.role, Actuation())
        sensors = world.sensors.get(self.role, Sensors())
        self.guaranteed = self.robust or self.role not in {*world.actuators, *world.sensors}
        if not self.robust:
            actuation, sensors = Actuation(), Sensors()
        limits = world.limits(self.role, self)
        assert limits is not None
        self.least, self.largest = limits
        self.response = actuation.response_in(world, self.role, -self.least)
        self.sensing = sensors.sensing_in(world, self.role)
        # The memories of pending commands and of measurements, where there are any.
        self.late = self.response.late > 0 or self.response.share < 1.0
        self.remembers = {ACTUATION: self.late, SENSORS: self.sensing.oldest > 0}
        self.memories = [f"{self.role}.{name}" for name, needed in self.remembers.items() if needed]
        self.from_step = world.steps(self.from_s, "from_s")
        self.agreement = Agreement(self.sensing, world.time_step)
        memory = [f"{self.role}.agreement", *self.memories]
        reads = [f"next.{self.role}.{WANTED}", *FILTER_READS, *memory]
        self.replaced = world.replaced
        reads += ["self.followed"] * self.replaced
        self.declare(world, [*reads, *["episode.step"] * (self.from_step > 0)])
        self.limits = Braking(self.response.braking, self.braking_ahead, self.time_to_collision)

    @property
    def exceeded(self) -> str:
        """Why vehicles of the role may brake harder than it assumes of those ahead, or nothing."""
        if not self.string.follows(self.role) or self.braking_ahead >= -self.least - ROUNDING:
            return ""
        return (
            f"an automated car directly behind another may collide: the one ahead brakes by up to "
            f"{-self.least:g} m/s² (scenario.max_braking), and its filter assumes at most "
            f"{self.braking_ahead:g} m/s²; set scenario.filters.{self.role}.braking_ahead="
            f"{-self.least:g}, of a policy's own filter safety.braking_ahead={-self.least:g}"
        )

    def watch(self) -> CBFGuarantee:
        """Return the piece that records the steps which the filter's guarantee covers."""
        world = World(self.string, replaced=self.replaced)
        return CBFGuarantee(safety=self).bind(world, self.role)

    def compute(self, wanted: Tensor, *state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the filtered commands and the memory of gaps."""
        inputs = list(state)
        step = inputs.pop() if self.from_step else None
        if self.replaced:  # gaps to another vehicle are not compared
            same_leader = inputs.pop() > self.sensing.oldest
            inputs[len(FILTER_READS)] = torch.where(same_leader, inputs[len(FILTER_READS)], 0.0)
        command, agreed = self.filtered(wanted, *inputs)
        if step is not None:
            command = torch.where(step < self.from_step, wanted, command)
        return command, agreed

    def kept(self, memories: Sequence[Tensor], nothing: Tensor) -> list[Tensor]:
        """Return the memories of actuation and sensors; ``nothing``, one column, for none."""
        rest = iter(memories)
        return [next(rest) if needed else nothing for needed in self.remembers.values()]

    def _when_it_acts(
        self, motion: PairState, acceleration: Tensor | float, actuation: Tensor, sensors: Tensor
    ) -> PairState:
        """Return the state when the command begins to act from the measured state."""
        past = frames_of(sensors, "self.acceleration")[..., : self.sensing.oldest]
        now = brought_up(motion, sensors[..., :AGES], past, acceleration, self.time_step)
        return predicted(now, actuation[..., 1:], acceleration, self.response)[-1]

    def filtered(
        self,
        wanted: Tensor,
        speed: Tensor,
        gap: Tensor,
        ahead: Tensor,
        ahead_acceleration: Tensor,
        agreed: Tensor,
        *memories: Tensor,
    ) -> tuple[Tensor, Tensor]:
        """Return the filtered commands, ``[*batch, n, 1]`` [m/s²], and the memory of gaps.

        Args:
            wanted: desired commands [m/s²].
            speed, gap, ahead, ahead_acceleration: measured state [m/s, m, m/s, m/s²].
            agreed: memory of the step before, ``[*batch, n, 3]``; zeros reset it.
            *memories: the entries that :attr:`memories` names.
        """
        # A NaN or an infinity in any of them makes the sum non-finite.
        finite = (wanted + speed + gap + ahead + ahead_acceleration).isfinite()
        memory, relative = self.kept(memories, wanted), ahead - speed
        with torch.no_grad():  # no slope: simulated measurements agree
            agreed = self.agreement.next(agreed, gap, relative)
            agreed = batch_innermost(torch.where(finite, agreed, 0.0))
            differs = self.agreement.difference(agreed, relative)
        nearer = (ahead + differs.clamp(max=0.0)).clamp(min=0.0)
        measured = PairState(speed, gap, nearer, memory[0][..., :1])
        worst = self._when_it_acts(self.sensing.worst(measured), -self.braking_ahead, *memory)
        safe = self._safe(replace(worst, gap=worst.gap - self.margin))
        now = self._when_it_acts(measured, ahead_acceleration, *memory)
        command = self._comfortable(wanted, now, ahead_acceleration, differs.abs(), safe)
        stays = (gap < self.margin) & (relative + differs <= 0.0)
        command = torch.where(stays, command.clamp(max=0.0), command)
        command = command.clamp(self.least, self.largest)
        return torch.where(finite, command, self.least), agreed

    def _safe(self, worst: PairState) -> Tensor:
        """Return the largest command after which full braking suffices."""
        if self.late:
            return safe_command(worst, self.response, self.limits)
        state = (worst.speed, worst.gap, worst.ahead)
        return safe_acceleration(*state, self.limits, self.time_step)

    def _comfortable(
        self,
        wanted: Tensor,
        now: PairState,
        ahead_acceleration: Tensor,
        doubt: Tensor,
        safe: Tensor,
    ) -> Tensor:
        """Return the nearest command within all bounds; ``doubt``: excess of the speed ahead."""
        speed, gap, closing = now.speed, now.gap, now.speed - now.ahead
        opening = doubt - closing
        free, half = gap - self.margin, 0.5 * self.time_step
        shortest = self.time_to_collision
        command = wanted
        if self.time_gap is not None:
            allowed, slope = self._allowed(speed, self.time_gap)
            least = (opening - self.time_gap_rate * (allowed - gap)) / slope
            command = torch.maximum(command, least)
        if self.longest_gap is not None:
            foresight = math.sqrt(2.0 * self.longest_gap / self.largest)
            room = self.longest_gap - gap - foresight * opening
            faster = (opening - self.time_gap_rate * room) / (foresight + half)
            command = torch.maximum(command, ahead_acceleration + faster)
        slower = self.rate * (free - shortest * closing) - closing
        comfort = ahead_acceleration + slower / (shortest + half)
        command = torch.minimum(command, torch.minimum(comfort, safe))
        if self.shortest_time_gap is not None:
            room = gap - self.shortest_time_gap * speed
            grows = half * ahead_acceleration - closing
            bound = (self.time_gap_rate * room + grows) / (self.shortest_time_gap + half)
            command = torch.minimum(command, bound)
        return command

    def _allowed(self, speed: Tensor, time_gap: float) -> tuple[Tensor, Tensor]:
        """Return the longest gap at a speed and its derivative by the speed."""
        moving = speed.clamp(min=SLOWEST)
        share = (moving / max(self.full_speed, SLOWEST)).clamp(max=1.0)
        slope = time_gap * torch.where(share < 1.0, 2.0 * share, share)
        return (time_gap * share * moving).clamp(min=self.least_gap), slope


class Corrected(RoleTransform):
    """Writes the change of a policy's command by the filter: zero where the filter is inactive."""

    writes = (
        Entry("role.correction", "m/s²", "change of a policy's command by the safety filter"),
    )

    def setup(self, world: World) -> None:
        self.declare(world, (f"next.{self.role}.wanted", f"next.{self.role}.command"))

    def compute(self, wanted: Tensor, command: Tensor) -> Tensor:
        return command - wanted


class CBFGuarantee(RoleTransform):
    """Marks the steps that a filter's guarantee covers, ``(role, "promised")``, ``[*batch, n, 1]``.

    It is 1 where the vehicle was safe when the step began and the vehicle ahead braked no harder
    than ``braking_ahead``, in the step and since the oldest measurement in use. Time-to-collision
    at the end of the step is then above the filter's limit. Elsewhere, and before the filter acts
    (``from_s``), it is 0. It is 0, too, while a measurement in use is of a vehicle ahead that has
    been replaced.

    ``(role, "safe")`` of the same shape is 1 where the vehicle was safe when the step began, by its
    true state and the declared actuators. A covered step that ends unsafe shows that actuators or
    sensors differ from the declared ones.
    """

    safety: InstanceOf[CBFFilter]  # the filter, bound

    writes = (
        Entry("role.promised", "–", "1 if the guarantee of the safety filter covers the step"),
        Entry("role.safe", "–", "1 if full braking keeps the limit from the start of the step"),
    )

    def setup(self, world: World) -> None:
        reads = ["self.speed", "self.gap", "ahead.speed", "next.ahead.acceleration"]
        self.replaced = world.replaced
        reads += [*self.safety.memories, "episode.step", *["next.self.followed"] * self.replaced]
        self.declare(world, reads)

    def compute(
        self, speed: Tensor, gap: Tensor, ahead: Tensor, acceleration: Tensor, *more: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return 1 for covered steps, and 1 for steps that begin safe."""
        safety, later = self.safety, list(more)
        followed = later.pop() if self.replaced else None
        *memories, step = later
        actuation, sensors = safety.kept(memories, speed)
        now = PairState(speed, gap - safety.margin, ahead, actuation[..., :1])
        if safety.late:
            room = least_room_to_come(now, actuation[..., 1:], safety.response, safety.limits)
        else:
            room = least_room(speed, now.gap, ahead, safety.limits)
        past = frames_of(sensors, "ahead.acceleration")[..., : safety.sensing.oldest]
        hardest = join([acceleration, past], -1).amin(-1, keepdim=True)
        kept_up = hardest >= -safety.braking_ahead - ROUNDING
        safe = room >= -ROUNDING
        promised = safe & kept_up & (step >= safety.from_step)
        if followed is not None:
            promised = promised & (followed > safety.sensing.oldest)
        return promised.to(speed.dtype), safe.to(speed.dtype)
