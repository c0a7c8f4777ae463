"""The control barrier function (CBF) safety filter between a controller and its vehicles."""

from __future__ import annotations

from math import inf

import torch
from torch import Tensor

from lcc_rl.errors import require_in, require_positive
from lcc_rl.functional.braking import Braking, least_room, safe_acceleration
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces.base import StepTransform
from lcc_rl.pieces.views import Views

ROUNDING = 5e-3  # of gaps [m] and accelerations [m/s²] in single precision
SLOWEST = 1.0  # slower speeds count as this, as in the time gap: the limit has a slope [m/s]


class CBFFilter(StepTransform):
    """Changes a command as little as needed for the vehicle to stay between its limits.

    Two functions of the state are to stay positive: ``gap − margin − τ·(v − v_ahead)``, which
    keeps time-to-collision above τ, and ``longest(v) − gap``, which keeps the time gap below
    ``time_gap``. Each may fall at most at its rate times its value per second, which bounds the
    acceleration from above and from below; within the bounds the controller decides. Where they
    contradict each other, safety wins. This is the quadratic programme of Ames, Grizzle and
    Tabuada ("Control barrier function based quadratic programs with application to adaptive
    cruise control", CDC 2014), whose solution for one number is a clamp. The vehicle ahead is
    expected to keep its last measured acceleration.

    Comfort rests on that expectation, safety does not: a third bound keeps the vehicle where full
    braking maintains the first limit even if the vehicle ahead brakes by ``braking_ahead`` until
    it stands (:mod:`lcc_rl.functional.braking`). A vehicle that starts there has no TTC below τ at
    any sample as long as the vehicle ahead brakes no harder; which steps that covers, the
    :class:`Promised` of :meth:`watch` writes. Where a measurement or the command is no number, the
    filter brakes fully.

    With a ``shortest_time_gap``, ``gap − shortest_time_gap·v`` is kept positive, too, by the same
    expectation as comfort: as far as the vehicle ahead keeps its acceleration and braking suffices.

    Behind a leader at standstill both limits are about the same number, gap / speed, so who comes
    from afar must break one. With a ``full_speed``, ``longest(v)`` is ``time_gap·v`` from there on
    and falls with the square of the speed below: the vehicle is near before its leader stands, and
    pays for it with energy.

    Reads and replaces ``("command", role)``, ``[*batch, n, 1]`` [m/s²]. Differentiable.

    Args:
        time_step: duration of a step [s].
        max_acceleration: bound of the acceleration in both directions [m/s²].
        time_to_collision: shortest allowed [s].
        rate: how fast that limit may be approached [1/s].
        margin: gap that counts as contact [m].
        braking_ahead: hardest braking of the vehicle ahead that is reckoned with [m/s²].
        time_gap: longest allowed [s]; None: no limit.
        shortest_time_gap: shortest allowed [s]; None: no limit.
        time_gap_rate: how fast the limits of the time gap may be approached [1/s].
        full_speed: speed below which the longest time gap falls in proportion; 0: it does not
            [m/s].
        least_gap: gap that the limit of the time gap always allows [m].
        string: the string of vehicles; one automated vehicle where not given.
        role: whose commands are filtered.

    Raises:
        ConfigError: if a limit, a rate or the acceleration is not positive, or another setting
            negative.
    """

    def __init__(
        self,
        time_step: float,
        max_acceleration: float = 3.0,
        time_to_collision: float = 4.0,
        rate: float = 3.0,
        margin: float = 0.2,
        braking_ahead: float = 2.6,
        time_gap: float | None = 2.45,
        shortest_time_gap: float | None = None,
        time_gap_rate: float = 0.2,
        full_speed: float = 0.0,
        least_gap: float = 2.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.filters.{role}"
        limits = {"time_to_collision": time_to_collision, "rate": rate, "margin": margin}
        limits |= {"time_gap_rate": time_gap_rate, "max_acceleration": max_acceleration}
        limits |= {"braking_ahead": braking_ahead}
        require_positive(where, **limits)
        if time_gap is not None:
            require_positive(where, time_gap=time_gap)
        if shortest_time_gap is not None:
            require_in(where, f"(0, {time_gap or inf})", shortest_time_gap=shortest_time_gap)
        require_in(where, "[0, inf)", full_speed=full_speed, least_gap=least_gap)
        string = VehicleString((role,)) if string is None else string
        seen = ("self.speed", "self.gap", "ahead.speed", "ahead.acceleration")
        self.views = Views(string, role, [f"next.command.{role}", *seen])
        super().__init__(self.views.keys, [("command", role)], event_shape=(string.count(role), 1))
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.rate, self.margin = rate, margin
        self.braking = Braking(max_acceleration, braking_ahead, time_to_collision)
        self.string, self.role = string, role
        self.longest, self.shortest = time_gap, shortest_time_gap
        self.time_gap_rate = time_gap_rate
        self.full_speed, self.least_gap = max(full_speed, SLOWEST), least_gap

    def watch(self) -> Promised:
        """Return the piece that says for which steps the filter answers."""
        return Promised(self.braking, self.margin, self.string, self.role)

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the commands that the vehicles obey."""
        return self.filtered(*self.views(*entries))

    def filtered(
        self, wanted: Tensor, speed: Tensor, gap: Tensor, ahead: Tensor, ahead_acceleration: Tensor
    ) -> Tensor:
        """Return the commands that the vehicles obey, ``[*batch, n, 1]`` [m/s²]."""
        closing, shortest = speed - ahead, self.braking.time_to_collision
        command = wanted
        if self.longest is not None:
            allowed, slope = self._longest_gap(speed, self.longest)
            least = (-closing - self.time_gap_rate * (allowed - gap)) / slope
            command = torch.maximum(command, least)
        free = gap - self.margin
        slower = self.rate * (free - shortest * closing) - closing
        expected = ahead_acceleration + slower / (shortest + 0.5 * self.time_step)
        safe = safe_acceleration(speed, free, ahead, self.braking, self.time_step)
        command = torch.minimum(command, torch.minimum(expected, safe))
        if self.shortest is not None:
            room = gap - self.shortest * speed
            opening = 0.5 * self.time_step * ahead_acceleration - closing
            held = (self.time_gap_rate * room + opening) / (self.shortest + 0.5 * self.time_step)
            command = torch.minimum(command, held)
        command = command.clamp(-self.max_acceleration, self.max_acceleration)
        # Any of them that is no number, or infinite, shows in the sum.
        known = (wanted + speed + gap + ahead + ahead_acceleration).isfinite()
        return torch.where(known, command, -self.max_acceleration)

    def _longest_gap(self, speed: Tensor, time_gap: float) -> tuple[Tensor, Tensor]:
        """Return the longest gap at a speed, and how it grows with the speed."""
        moving = speed.clamp(min=SLOWEST)
        share = (moving / self.full_speed).clamp(max=1.0)
        slope = time_gap * torch.where(share < 1.0, 2.0 * share, share)
        return (time_gap * share * moving).clamp(min=self.least_gap), slope


class Corrected(StepTransform):
    """Writes by how much the command differs from a policy's action, ``(role, "correction")``.

    ``[*batch, n, 1]`` [m/s²]: zero where the filter lets the policy drive.

    Args:
        max_acceleration: acceleration of action 1 [m/s²].
        string: the string of vehicles; one automated vehicle where not given.
        role: whose commands are filtered.
    """

    def __init__(
        self,
        max_acceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        string = VehicleString((role,)) if string is None else string
        self.views = Views(string, role, [f"{role}.action", f"next.command.{role}"])
        writes, shape = [(role, "correction")], (string.count(role), 1)
        super().__init__(self.views.keys, writes, event_shape=shape)
        self.max_acceleration = max_acceleration

    def compute(self, *entries: Tensor) -> Tensor:
        """Return what the filter added."""
        action, command = self.views(*entries)
        return command - self.max_acceleration * action


class Promised(StepTransform):
    """Writes for which steps a filter answers, ``(role, "promised")``, ``[*batch, n, 1]``.

    1 where the vehicle was safe when the step began and the vehicle ahead braked no harder than
    is reckoned with: time-to-collision at its end is then above the filter's limit; else 0.

    Args:
        braking: what the filter reckons with.
        margin: gap that counts as contact [m].
        string: the string of vehicles.
        role: whose commands are filtered.
    """

    def __init__(self, braking: Braking, margin: float, string: VehicleString, role: str) -> None:
        seen = ("self.speed", "self.gap", "ahead.speed", "next.ahead.acceleration")
        self.views = Views(string, role, seen)
        super().__init__(self.views.keys, [(role, "promised")], event_shape=(string.count(role), 1))
        self.braking, self.margin = braking, margin

    def compute(self, *entries: Tensor) -> Tensor:
        """Return 1 for the steps that are covered."""
        speed, gap, ahead, acceleration = self.views(*entries)
        safe = least_room(speed, gap - self.margin, ahead, self.braking) >= -ROUNDING
        return (safe & (acceleration >= -self.braking.ahead - ROUNDING)).to(speed.dtype)
