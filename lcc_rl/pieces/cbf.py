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
from lcc_rl.functional.sensing import Agreement, brought_up
from lcc_rl.pieces.actuation import ACTUATION, Actuation
from lcc_rl.pieces.base import Entry, RoleTransform
from lcc_rl.pieces.sensors import SENSORS, Sensors, frames_of
from lcc_rl.pieces.string import COMMANDED, WANTED
from lcc_rl.pieces.world import MAX_ACCELERATION, World
from lcc_rl.settings import NonNegative, Positive

ROUNDING = 5e-3  # of gaps [m] and accelerations [m/s²] in single precision
FILTER_READS = ("self.speed", "self.gap", "ahead.speed", "ahead.acceleration")
REMEMBERS = 3  # numbers in the filter's memory of gaps
SLOWEST = 1.0  # slower speeds count as this, as in the time gap: the limit has a slope [m/s]


class CBFFilter(RoleTransform):
    """Changes a command as little as needed for the vehicle to stay between its limits.

    Two functions of the state are to stay positive: ``gap − margin − τ·(v − v_ahead)``, which
    keeps time-to-collision above τ, and ``longest(v) − gap``, which keeps the time gap below
    ``time_gap``. Each may fall at most at its rate times its value per second, which bounds the
    acceleration from above and from below; within the bounds the controller decides. If they
    contradict each other, safety wins. This is the quadratic programme of Ames, Grizzle and
    Tabuada ("Control barrier function based quadratic programs with application to adaptive
    cruise control", CDC 2014), whose solution for one number is a clamp. The vehicle ahead is
    expected to keep its last measured acceleration.

    Comfort rests on that expectation, safety does not: a third bound keeps the vehicle where full
    braking maintains the first limit even if the vehicle ahead brakes by ``braking_ahead`` until
    it stands (:mod:`lcc_rl.functional.braking`). A vehicle that starts there has no TTC below τ at
    any sample as long as the vehicle ahead brakes no harder; which steps that covers, the
    :class:`CBFGuarantee` of :meth:`watch` writes. If a measurement or the command is no number, the
    filter brakes fully.

    It trusts gaps. Where the measured gap grows at another rate than the measured relative speed
    says (:class:`lcc_rl.functional.sensing.Agreement`), limits of nearness count with the lower
    speed ahead, those of distance with the higher. While the gap is below ``margin`` and does not
    grow, the vehicle does not accelerate.

    With a ``shortest_time_gap``, ``gap − shortest_time_gap·v`` is kept positive, too, by the same
    expectation as comfort: as far as the vehicle ahead keeps its acceleration and braking suffices.

    With a ``longest_gap``, ``longest_gap − gap − h·(v_ahead − v)`` is kept positive, likewise, with
    ``h = √(2·longest_gap / max_acceleration)``: the gap that the present speeds lead to within h.
    Where it is, half of the acceleration suffices to keep it, so that the other half can answer a
    vehicle ahead that accelerates. Limits of nearness win.

    Behind a leader at standstill both limits are about the same number, gap / speed, so that a
    vehicle from farther away violates one of them. With a ``full_speed``, ``longest(v)`` is
    ``time_gap·v`` from there on and falls with the square of the speed below: the vehicle is near
    before its leader stands, at a cost of energy.

    A ``robust`` filter reckons with the scenario's actuators and sensors (:class:`Actuation`,
    :class:`Sensors`). It starts from the worst state within the errors of the measurement, moves it
    on to the present with the accelerations driven since, then to the moment at which the command
    begins to act with the commands under way, while the vehicle ahead brakes as hard as is reckoned
    with; and full braking is reached with the lag
    (:func:`lcc_rl.functional.braking.safe_command`). Comfort is that of the state expected.

    It reads ``("wanted", role)``, which the controller of a filtered role writes. Differentiable.
    """

    max_acceleration: Positive = MAX_ACCELERATION  # in both directions [m/s²]
    # Reckon with the actuators and sensors of the scenario; false: as if both were exact.
    robust: bool = True
    time_to_collision: Positive = 4.0  # shortest allowed [s]
    rate: Positive = 3.0  # how fast that limit may be approached [1/s]
    margin: Positive = 0.2  # gap that counts as contact [m]
    braking_ahead: Positive = 2.6  # hardest braking of the vehicle ahead reckoned with [m/s²]
    time_gap: Positive | None = 2.45  # longest allowed; None: no limit [s]
    shortest_time_gap: Positive | None = None  # shortest allowed; None: no limit [s]
    longest_gap: Positive | None = None  # longest allowed; None: no limit [m]
    # How fast the limits of the time gap and the longest gap may be approached [1/s].
    time_gap_rate: Positive = 0.2
    # Speed below which the longest time gap falls in proportion; 0: it does not [m/s].
    full_speed: NonNegative = 0.0
    least_gap: NonNegative = 2.0  # gap that the limit of the time gap always allows [m]
    from_s: NonNegative = 0.0  # moment of the episode from which on it acts, see Handover [s]

    measures = True
    agreed = Entry(
        "role.agreement", "–, m, m/s", "1, the gap last measured, what it grows too fast", REMEMBERS
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
        self.answers = self.robust or self.role not in {*world.actuators, *world.sensors}
        if not self.robust:
            actuation, sensors = Actuation(), Sensors()
        self.response = actuation.response_in(world, self.role, self.max_acceleration)
        self.sensing = sensors.sensing_in(world, self.role)
        # What is kept of commands under way, and since the measurement, where there is anything.
        self.late = self.response.late > 0 or self.response.share < 1.0
        self.remembers = {ACTUATION: self.late, SENSORS: self.sensing.oldest > 0}
        self.memories = [f"{self.role}.{name}" for name, needed in self.remembers.items() if needed]
        self.from_step = world.steps(self.from_s, "from_s")
        self.agreement = Agreement(self.sensing, world.time_step)
        kept = [f"{self.role}.agreement", *self.memories]
        seen = [f"next.{WANTED}.{self.role}", *FILTER_READS, *kept]
        self.declare(world, [*seen, *["episode.step"] * (self.from_step > 0)])
        self.limits = Braking(self.response.braking, self.braking_ahead, self.time_to_collision)

    def watch(self) -> CBFGuarantee:
        """Return the piece that records the steps for which the filter promises its limit."""
        return CBFGuarantee(safety=self).bind(World(self.string), self.role)

    def compute(self, wanted: Tensor, *state: Tensor) -> tuple[Tensor, Tensor]:
        """Return the commands that the vehicles obey, and what is remembered of gaps."""
        if not self.from_step:
            return self.filtered(wanted, *state)
        *state, step = state  # type: ignore[assignment]
        command, agreed = self.filtered(wanted, *state)
        return torch.where(step < self.from_step, wanted, command), agreed

    def kept(self, memories: Sequence[Tensor], nothing: Tensor) -> list[Tensor]:
        """Return the memories of actuation and sensors; ``nothing``, one column, for none."""
        given = iter(memories)
        return [next(given) if needed else nothing for needed in self.remembers.values()]

    def _when_it_acts(
        self, motion: PairState, acceleration: Tensor | float, actuation: Tensor, sensors: Tensor
    ) -> PairState:
        """Return the motion when the command begins to act, from one as old as the measurement."""
        past = frames_of(sensors, "self.acceleration")[..., : self.sensing.oldest]
        now = brought_up(motion, sensors[..., :1], past, acceleration, self.time_step)
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
        """Return the commands that the vehicles obey, ``[*batch, n, 1]`` [m/s²], and a memory.

        Args:
            wanted: commands [m/s²].
            speed, gap, ahead, ahead_acceleration: the state measured [m/s, m, m/s, m/s²].
            agreed: the memory of the step before, ``[*batch, n, 3]``; zeros begin anew.
            *memories: the entries that :attr:`memories` names.
        """
        # Any of them that is no number, or infinite, shows in the sum.
        known = (wanted + speed + gap + ahead + ahead_acceleration).isfinite()
        kept, relative = self.kept(memories, wanted), ahead - speed
        with torch.no_grad():  # what is measured agrees in a simulator: there is no slope
            agreed = self.agreement.next(agreed, gap, relative)
            agreed = batch_innermost(torch.where(known, agreed, 0.0))
            differs = self.agreement.difference(agreed, relative)
        nearer = (ahead + differs.clamp(max=0.0)).clamp(min=0.0)
        measured = PairState(speed, gap, nearer, kept[0][..., :1])
        worst = self._when_it_acts(self.sensing.worst(measured), -self.braking_ahead, *kept)
        safe = self._safe(replace(worst, gap=worst.gap - self.margin))
        now = self._when_it_acts(measured, ahead_acceleration, *kept)
        command = self._comfortable(wanted, now, ahead_acceleration, differs.abs(), safe)
        stays = (gap < self.margin) & (relative + differs <= 0.0)
        command = torch.where(stays, command.clamp(max=0.0), command)
        command = command.clamp(-self.max_acceleration, self.max_acceleration)
        return torch.where(known, command, -self.max_acceleration), agreed

    def _safe(self, worst: PairState) -> Tensor:
        """Return the largest command that leaves the vehicle where braking suffices."""
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
        """Return the command nearest to what is wanted within all bounds, not clamped.

        The vehicle ahead may be faster by ``doubt`` than ``now`` says.
        """
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
            foresight = math.sqrt(2.0 * self.longest_gap / self.max_acceleration)
            room = self.longest_gap - gap - foresight * opening
            faster = (opening - self.time_gap_rate * room) / (foresight + half)
            command = torch.maximum(command, ahead_acceleration + faster)
        slower = self.rate * (free - shortest * closing) - closing
        comfort = ahead_acceleration + slower / (shortest + half)
        command = torch.minimum(command, torch.minimum(comfort, safe))
        if self.shortest_time_gap is not None:
            room = gap - self.shortest_time_gap * speed
            grows = half * ahead_acceleration - closing
            held = (self.time_gap_rate * room + grows) / (self.shortest_time_gap + half)
            command = torch.minimum(command, held)
        return command

    def _allowed(self, speed: Tensor, time_gap: float) -> tuple[Tensor, Tensor]:
        """Return the longest gap at a speed, and how it grows with the speed."""
        moving = speed.clamp(min=SLOWEST)
        share = (moving / max(self.full_speed, SLOWEST)).clamp(max=1.0)
        slope = time_gap * torch.where(share < 1.0, 2.0 * share, share)
        return (time_gap * share * moving).clamp(min=self.least_gap), slope


class Corrected(RoleTransform):
    """By how much the command differs from a policy's action: zero where the filter is inactive."""

    max_acceleration: Positive = MAX_ACCELERATION  # acceleration of action 1 [m/s²]

    writes = (
        Entry("role.correction", "m/s²", "what the safety filter added to a policy's command"),
    )

    def setup(self, world: World) -> None:
        """Read the actions and commands of the role."""
        self.declare(world, (f"{self.role}.action", f"next.command.{self.role}"))

    def compute(self, action: Tensor, command: Tensor) -> Tensor:
        """Return what the filter added."""
        return command - self.max_acceleration * action


class CBFGuarantee(RoleTransform):
    """Writes which steps a filter's guarantee covers, ``(role, "promised")``, ``[*batch, n, 1]``.

    1 where the vehicle was safe when the step began and the vehicle ahead braked no harder than
    is reckoned with, in the step and since the oldest measurement that may be in use:
    time-to-collision at its end is then above the filter's limit; else 0. Before the filter acts
    (``from_s``) it promises nothing.

    ``(role, "safe")``, likewise, is 1 where the vehicle was safe when the step began, by its true
    state and the actuators that the scenario declares. A step that turns unsafe though it is
    promised shows that actuators or sensors are not as declared.
    """

    safety: InstanceOf[CBFFilter]  # the filter, bound

    writes = (
        Entry("role.promised", "–", "1 if the guarantee of the safety filter covers the step"),
        Entry("role.safe", "–", "1 where full braking keeps the limit when the step begins"),
    )

    def setup(self, world: World) -> None:
        """Read the true state, and what bounds the commands of the role."""
        seen = ["self.speed", "self.gap", "ahead.speed", "next.ahead.acceleration"]
        self.declare(world, [*seen, *self.safety.memories, "episode.step"])

    def compute(
        self, speed: Tensor, gap: Tensor, ahead: Tensor, acceleration: Tensor, *more: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return 1 for the steps that are covered, and for those that begin safe."""
        safety, (*memories, step) = self.safety, more
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
        return promised.to(speed.dtype), safe.to(speed.dtype)
