"""The control barrier function (CBF) safety filter between a controller and its vehicles."""

from __future__ import annotations

import torch
from pydantic import InstanceOf
from torch import Tensor

from lcc_rl.functional.actuation import Motion, Response, predicted
from lcc_rl.functional.braking import (
    Braking,
    least_room,
    least_room_late,
    safe_acceleration,
    safe_command,
)
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.actuation import ACTUATION, response_of
from lcc_rl.pieces.base import StepTransform
from lcc_rl.pieces.world import World
from lcc_rl.settings import NonNegative, Positive

ROUNDING = 5e-3  # of gaps [m] and accelerations [m/s²] in single precision
SLOWEST = 1.0  # slower speeds count as this, as in the time gap: the limit has a slope [m/s]


class CBFFilter(StepTransform):
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
    :class:`Promised` of :meth:`watch` writes. If a measurement or the command is no number, the
    filter brakes fully.

    With a ``shortest_time_gap``, ``gap − shortest_time_gap·v`` is kept positive, too, by the same
    expectation as comfort: as far as the vehicle ahead keeps its acceleration and braking suffices.

    Behind a leader at standstill both limits are about the same number, gap / speed, so who comes
    from afar must break one. With a ``full_speed``, ``longest(v)`` is ``time_gap·v`` from there on
    and falls with the square of the speed below: the vehicle is near before its leader stands, and
    pays for it with energy.

    With a ``delay``, a ``lag`` and a ``braking`` of the vehicle (:class:`Actuation`) the bounds are
    those of the state in which the command begins to act: commands given before it act until then,
    while the vehicle ahead brakes as hard as is reckoned with; and full braking is reached with the
    lag (:func:`lcc_rl.functional.braking.safe_command`).

    Reads and replaces ``("command", role)``, ``[*batch, n, 1]`` [m/s²]. Differentiable.
    """

    max_acceleration: Positive = 3.0  # in both directions [m/s²]
    delay: NonNegative = 0.0  # of the commands' effect, a number of steps [s]
    lag: NonNegative = 0.0  # of the acceleration behind the command [s]
    braking: Positive | None = None  # hardest braking that there is; None: max_acceleration [m/s²]
    time_to_collision: Positive = 4.0  # shortest allowed [s]
    rate: Positive = 3.0  # how fast that limit may be approached [1/s]
    margin: Positive = 0.2  # gap that counts as contact [m]
    braking_ahead: Positive = 2.6  # hardest braking of the vehicle ahead reckoned with [m/s²]
    time_gap: Positive | None = 2.45  # longest allowed; None: no limit [s]
    shortest_time_gap: Positive | None = None  # shortest allowed; None: no limit [s]
    time_gap_rate: Positive = 0.2  # how fast limits of the time gap may be approached [1/s]
    # Speed below which the longest time gap falls in proportion; 0: it does not [m/s].
    full_speed: NonNegative = 0.0
    least_gap: NonNegative = 2.0  # gap that the limit of the time gap always allows [m]

    name = AUTOMATED

    def __post_init__(self) -> None:
        if self.time_gap is not None and (self.shortest_time_gap or 0.0) >= self.time_gap:
            shortest = f"shortest_time_gap={self.shortest_time_gap}"
            raise ValueError(f"{shortest} must be below time_gap={self.time_gap}")

    def setup(self, world: World) -> None:
        """Read the commands of the role and what bounds them."""
        self.role, self.string, self.time_step = self.name, world.string, world.time_step
        own = min(self.braking or self.max_acceleration, self.max_acceleration)
        self.response = response_of(self.delay, self.lag, own, world, self.role)
        seen = ["self.speed", "self.gap", "ahead.speed", "ahead.acceleration"]
        seen += [f"{self.role}.{ACTUATION}"] * self.late
        self.see(world, [f"next.command.{self.role}", *seen], [("command", self.role)], self.role)
        self.limits = Braking(own, self.braking_ahead, self.time_to_collision)

    @property
    def late(self) -> bool:
        """Whether the vehicle obeys with a delay or a lag."""
        return bool(self.delay or self.lag)

    def watch(self) -> Promised:
        """Return the piece that records the steps for which the filter promises its limit."""
        late = self.response if self.late else None
        watching = Promised(braking=self.limits, margin=self.margin, response=late)
        return watching.bind(World(self.string), self.role)

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the commands that the vehicles obey."""
        return self.filtered(*self.views(*entries))

    def filtered(
        self,
        wanted: Tensor,
        speed: Tensor,
        gap: Tensor,
        ahead: Tensor,
        ahead_acceleration: Tensor,
        kept: Tensor | None = None,
    ) -> Tensor:
        """Return the commands that the vehicles obey, ``[*batch, n, 1]`` [m/s²].

        Args:
            wanted: commands [m/s²].
            speed, gap, ahead, ahead_acceleration: the state [m/s, m, m/s, m/s²].
            kept: of the actuation, where there is one.
        """
        # Any of them that is no number, or infinite, shows in the sum.
        known = (wanted + speed + gap + ahead + ahead_acceleration).isfinite()
        response, free = self.response, gap - self.margin
        if kept is None:
            safe = safe_acceleration(speed, free, ahead, self.limits, self.time_step)
        else:
            now = Motion(speed, free, ahead, kept[..., :1])
            worst = predicted(now, kept[..., 1:], -self.braking_ahead, response)[-1]
            safe = safe_command(worst, response, self.limits)
            expected = predicted(now, kept[..., 1:], ahead_acceleration, response)[-1]
            speed, free, ahead = expected.speed, expected.gap, expected.ahead
            gap = free + self.margin
        closing, shortest = speed - ahead, self.time_to_collision
        command = wanted
        if self.time_gap is not None:
            allowed, slope = self._longest_gap(speed, self.time_gap)
            least = (-closing - self.time_gap_rate * (allowed - gap)) / slope
            command = torch.maximum(command, least)
        slower = self.rate * (free - shortest * closing) - closing
        comfort = ahead_acceleration + slower / (shortest + 0.5 * self.time_step)
        command = torch.minimum(command, torch.minimum(comfort, safe))
        if self.shortest_time_gap is not None:
            room = gap - self.shortest_time_gap * speed
            half = 0.5 * self.time_step
            opening = half * ahead_acceleration - closing
            held = (self.time_gap_rate * room + opening) / (self.shortest_time_gap + half)
            command = torch.minimum(command, held)
        command = command.clamp(-self.max_acceleration, self.max_acceleration)
        return torch.where(known, command, -self.max_acceleration)

    def _longest_gap(self, speed: Tensor, time_gap: float) -> tuple[Tensor, Tensor]:
        """Return the longest gap at a speed, and how it grows with the speed."""
        moving = speed.clamp(min=SLOWEST)
        share = (moving / max(self.full_speed, SLOWEST)).clamp(max=1.0)
        slope = time_gap * torch.where(share < 1.0, 2.0 * share, share)
        return (time_gap * share * moving).clamp(min=self.least_gap), slope


class Corrected(StepTransform):
    """Writes by how much the command differs from a policy's action, ``(role, "correction")``.

    ``[*batch, n, 1]`` [m/s²]: zero where the filter lets the policy drive.
    """

    max_acceleration: Positive = 3.0  # acceleration of action 1 [m/s²]

    name = AUTOMATED

    def setup(self, world: World) -> None:
        """Read the actions and commands of the role."""
        role = self.name
        seen = (f"{role}.action", f"next.command.{role}")
        self.see(world, seen, [(role, "correction")], role)

    def compute(self, *entries: Tensor) -> Tensor:
        """Return what the filter added."""
        action, command = self.views(*entries)
        return command - self.max_acceleration * action


class Promised(StepTransform):
    """Writes for which steps a filter answers, ``(role, "promised")``, ``[*batch, n, 1]``.

    1 where the vehicle was safe when the step began and the vehicle ahead braked no harder than
    is reckoned with: time-to-collision at its end is then above the filter's limit; else 0.
    """

    braking: InstanceOf[Braking]  # what the filter reckons with
    margin: Positive  # gap that counts as contact [m]
    response: InstanceOf[Response] | None = None  # of a vehicle that obeys late

    name = AUTOMATED

    def setup(self, world: World) -> None:
        """Read what bounds the commands of the role."""
        seen = ["self.speed", "self.gap", "ahead.speed", "next.ahead.acceleration"]
        seen += [f"{self.name}.{ACTUATION}"] * (self.response is not None)
        self.see(world, seen, [(self.name, "promised")], self.name)

    def compute(self, *entries: Tensor) -> Tensor:
        """Return 1 for the steps that are covered."""
        speed, gap, ahead, acceleration, *kept = self.views(*entries)
        free = gap - self.margin
        room = least_room(speed, free, ahead, self.braking)
        if self.response is not None:
            now = Motion(speed, free, ahead, kept[0][..., :1])
            path = predicted(now, kept[0][..., 1:], -self.braking.ahead, self.response)
            rooms = [x.gap - self.braking.time_to_collision * (x.speed - x.ahead) for x in path]
            rooms.append(least_room_late(path[-1], self.response, self.braking))
            room = torch.stack(rooms).amin(0)
        kept_up = acceleration >= -self.braking.ahead - ROUNDING
        return ((room >= -ROUNDING) & kept_up).to(speed.dtype)
