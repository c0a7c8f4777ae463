"""Largest acceleration from which full braking still keeps a safe distance.

A vehicle is *safe* where full braking keeps ``gap − τ·(v − v_ahead)`` from becoming negative at
all times to come, while the vehicle ahead brakes as hard as is expected of it until it stands. No
other behaviour of the vehicle ahead within that bound is worse: its speed and its position are at
least those of constant braking. From a safe state, full braking leads to safe states only. A
controller in a safe state can therefore always stay in safe states: full braking is the backup
strategy of a control barrier function. The distance is that of Shalev-Shwartz, Shammah and
Shashua, "On a formal model of safe and scalable self-driving cars", arXiv 1708.06374, without
reaction time and for time-to-collision instead of contact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lcc_rl.functional.actuation import PairState, Response, predicted

HALVINGS, NEARBY = 16, 1e-2  # of the range of accelerations; step of a slope [m/s²]


@dataclass(frozen=True)
class Braking:
    """Braking of both vehicles, and the time-to-collision to be kept.

    Args:
        own: largest braking of the vehicle itself, positive [m/s²].
        ahead: largest braking expected of the vehicle ahead, positive [m/s²].
        time_to_collision: the shortest allowed τ [s].
    """

    own: float
    ahead: float
    time_to_collision: float


def least_room(speed: Tensor, gap: Tensor, speed_ahead: Tensor, braking: Braking) -> Tensor:
    """Return the least ``gap − τ·(v − v_ahead)`` to come while both vehicles brake fully.

    Args:
        speed: v, any shape [m/s].
        gap: gap minus the margin of contact [m].
        speed_ahead: speed of the vehicle ahead [m/s].
        braking: how hard both brake, and τ.

    Returns:
        The room [m]; the state is safe where it is not negative. In continuous time: a vehicle
        that stops within a step of T comes at most ``own·T²/8`` nearer.
    """
    tau, difference = braking.time_to_collision, braking.own - braking.ahead
    closing = speed - speed_ahead
    room = gap - tau * closing
    standing = speed_ahead / braking.ahead  # when the vehicle ahead stands [s]
    least = torch.minimum(room, _room_at(standing, speed, gap, speed_ahead, braking))
    if difference > 0.0:  # while both drive, room is convex in time: its minimum may be earlier
        when = (closing / difference - tau).clamp(min=0.0)
        before = torch.minimum(least, room - 0.5 * difference * when**2)
        least = torch.where(when < standing, before, least)
    return least


def _room_at(
    time: Tensor, speed: Tensor, gap: Tensor, speed_ahead: Tensor, braking: Braking
) -> Tensor:
    """Return the least room from the moment on at which the vehicle ahead stands."""
    tau, own = braking.time_to_collision, braking.own
    # If the vehicle stops earlier, its gap grows again: the minimum was before.
    reached = (speed - own * time).clamp(min=0.0)
    moving = torch.minimum(time, speed / own)
    gap = gap + 0.5 * speed_ahead * time - 0.5 * (speed + reached) * moving
    over = (reached - tau * own).clamp(min=0.0)
    return gap - tau * reached - 0.5 * over**2 / own


def least_room_held(
    motion: PairState, acceleration: Tensor, time: float, braking: Braking
) -> Tensor:
    """Return the least room to come if a vehicle holds an acceleration, then brakes fully.

    The vehicle ahead brakes fully from now on.

    Args:
        motion: the state, with the gap minus the margin; its acceleration is not used.
        acceleration: held [m/s²].
        time: for which it is held [s].
        braking: how hard both brake, and τ.
    """
    speed, ahead, tau = motion.speed, motion.ahead, braking.time_to_collision
    hard = torch.full_like(ahead, -braking.ahead)

    def at(moment: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        gap = motion.gap + _way(ahead, hard, moment) - _way(speed, acceleration, moment)
        reached = (speed + acceleration * moment).clamp(min=0.0)
        return reached, gap, (ahead + hard * moment).clamp(min=0.0)

    end = torch.full_like(speed, time)
    # Room may be least where its slope vanishes or changes, before the vehicle ahead stands, when
    # it stands, or afterwards.
    slower, slows = (-(acceleration + braking.ahead), -acceleration)
    inner = (
        (speed - ahead) / slower.clamp(min=1e-6) - tau,
        ahead / braking.ahead,
        speed / slows.clamp(min=1e-6) - tau,
    )
    least = least_room(*at(end), braking)
    for moment in (torch.zeros_like(end), *(torch.minimum(x.clamp(min=0.0), end) for x in inner)):
        reached, gap, ahead_reached = at(moment)
        least = torch.minimum(least, gap - tau * (reached - ahead_reached))
    return least


def least_room_to_come(
    now: PairState, pending: Tensor, response: Response, braking: Braking
) -> Tensor:
    """Return the least room to come while pending commands act, then full braking.

    The vehicle ahead brakes fully from now on.

    Args:
        now: the state, with the gap minus the margin.
        pending: commands that do not act yet, oldest first, ``[…, late]`` [m/s²].
        response: how commands become accelerations.
        braking: how hard both brake, and τ.
    """
    path = predicted(now, pending, -braking.ahead, response)
    rooms = [x.gap - braking.time_to_collision * (x.speed - x.ahead) for x in path]
    last = least_room_held(path[-1], path[-1].acceleration, response.hold, braking)
    return torch.stack([*rooms, last]).amin(0)


def safe_command(motion: PairState, response: Response, braking: Braking) -> Tensor:
    """Return the largest command after which a vehicle with a lag is still safe.

    The resulting acceleration must leave room if it is held for a step and for ``response.hold``.
    Full braking does so in every safe state. The largest such acceleration is found by bisection
    and has the gradient of the implicit function.

    Args:
        motion: the state when the command begins to act, with the gap minus the margin.
        response: how commands become accelerations.
        braking: how hard both brake, and τ.

    Returns:
        The command; the acceleration that it leads to is at most ``braking.own`` [m/s²].
    """
    time = response.time_step + response.hold
    # A vehicle that stops within a step comes nearer than the trapezoidal rule gives.
    now = replace(motion, gap=motion.gap - 0.125 * braking.own * response.time_step**2)
    with torch.no_grad():
        low = torch.full_like(now.speed, -braking.own)
        high = -low
        for _ in range(HALVINGS):
            middle = 0.5 * (low + high)
            safe = least_room_held(now, middle, time, braking) >= 0.0
            low, high = torch.where(safe, middle, low), torch.where(safe, high, middle)
        slope = least_room_held(now, low - NEARBY, time, braking)
        slope = (slope - least_room_held(now, low, time, braking)) / NEARBY
        inner = (low > -braking.own) & (low < braking.own - NEARBY)  # elsewhere it is clamped
    largest = low
    if any(x.requires_grad for x in (now.speed, now.gap, now.ahead)):
        room = least_room_held(now, low, time, braking)
        change = (room - room.detach()) / slope.clamp(min=time * time)
        largest = low + torch.where(inner, change, 0.0)
    return motion.acceleration + (largest - motion.acceleration) / response.share


def _way(speed: Tensor, acceleration: Tensor, time: Tensor) -> Tensor:
    """Return the distance that a vehicle drives in a time; it does not reverse."""
    reached = speed + acceleration * time
    stopped = 0.5 * speed**2 / (-acceleration).clamp(min=1e-6)
    return torch.where(reached < 0.0, stopped, 0.5 * (speed + reached) * time)


def safe_acceleration(
    speed: Tensor, gap: Tensor, speed_ahead: Tensor, braking: Braking, time_step: float
) -> Tensor:
    """Return the largest acceleration of one step after which the vehicle is safe.

    The step is the simulator's (A18): the acceleration is held for T, gaps follow the trapezoidal
    rule. The vehicle ahead brakes as hard as expected during the step, too. In a safe state the
    result is at least ``−own``, because full braking is safe there.

    Args:
        speed: v, any shape [m/s].
        gap: gap minus the margin of contact [m].
        speed_ahead: speed of the vehicle ahead [m/s].
        braking: how hard both brake, and τ.
        time_step: T [s].

    Returns:
        The acceleration, not bounded [m/s²].
    """
    tau, difference = braking.time_to_collision, braking.own - braking.ahead
    slowest = (speed_ahead - braking.ahead * time_step).clamp(min=0.0)
    # After the step with acceleration a: closing + a·T, room − slope·T·a.
    closing, slope = speed - slowest, tau + 0.5 * time_step
    gap = gap + time_step * (0.5 * (speed_ahead + slowest) - speed)
    room = gap - tau * closing
    # Likewise once the vehicle ahead stands: closing is then the speed itself.
    standing = slowest / braking.ahead
    left = speed - braking.own * standing
    gap = gap + standing * (0.5 * slowest - 0.5 * (speed + left))
    end = _largest(gap - tau * left, left, slope + standing, braking.own, tau)
    bound = torch.minimum(room / slope, end)
    if difference > 0.0:
        before = _largest(room, closing, slope, difference, tau)
        early = closing + bound < difference * (tau + standing)
        bound = torch.where(early, torch.minimum(bound, before), bound)
    return bound / time_step


def _largest(
    room: Tensor, closing: Tensor, slope: Tensor | float, rate: float, tau: float
) -> Tensor:
    """Return the largest change x of speed for which the room never becomes negative.

    With x the room is ``room − slope·x``. While closing falls at ``rate`` it falls by a further
    ``(closing + x − τ·rate)²/(2·rate)``, where that bracket is positive.
    """
    over = closing - tau * rate
    total = room + slope * over
    root = torch.sqrt(slope**2 + 2.0 * total.clamp(min=0.0) / rate)
    return 2.0 * total / (slope + root) - over
