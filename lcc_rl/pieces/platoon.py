"""The platoon: N followers in cooperative control behind one leader, as a vector dimension (HCFS).

A policy acts on each follower alike: observation ``[*batch, followers, 6]``, action ``[*batch,
followers, 1]``; any number of followers runs with the same policy.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.functional.cacc import platoon_errors, speeds_ahead
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.random import stream_id, uniform
from lcc_rl.pieces.base import SEED, Feature, Transition, following
from lcc_rl.pieces.vehicles import motion_keys


class PlatoonMotion(Transition):
    """Moves all followers by their actions, in [−1, 1], times the largest acceleration.

    At the start every follower has the leader's speed and the gap ``safe_headway``, shifted by up
    to ``gap_spread`` and ``speed_spread`` by the episode's seed. A collision does not end an
    episode: the reward knows nothing of gaps, so an end would only spare an agent its costs;
    gaps may turn negative and are counted in the evaluation.

    Writes speed [m/s], gap [m], relative speed v_ahead − v [m/s], executed acceleration [m/s²]
    and jerk [m/s³] under ``name``, shape ``[*batch, followers, 1]``.

    Args:
        time_step: duration of a step T [s].
        followers: vehicles behind the leader.
        max_acceleration: acceleration of action 1; braking of action −1 [m/s²].
        safe_headway: h, the gap at equilibrium [m]; the paper is silent on it.
        gap_spread: largest deviation of a gap from it at the start [m].
        speed_spread: largest deviation of a speed from the leader's at the start [m/s].
        name: namespace of the followers.
        predecessor: namespace of the leader.

    Raises:
        ConfigError: if a setting is out of range.
    """

    index: Tensor

    def __init__(
        self,
        time_step: float,
        followers: int = 6,
        max_acceleration: float = 3.0,
        safe_headway: float = 5.0,
        gap_spread: float = 0.0,
        speed_spread: float = 0.0,
        name: str = "platoon",
        predecessor: str = "leader",
    ) -> None:
        if followers < 1:
            raise ConfigError(f"{name}.followers must be at least 1, got {followers}")
        require_positive(name, max_acceleration=max_acceleration, safe_headway=safe_headway)
        if not (0 <= gap_spread < safe_headway and speed_spread >= 0):
            raise ConfigError(
                f"{name}: gap_spread {gap_spread} must lie in [0, {safe_headway}) and "
                f"speed_spread {speed_spread} must not be negative"
            )
        super().__init__(
            reads=[
                (name, "speed"),
                (name, "gap"),
                (name, "acceleration"),
                "action",
                (predecessor, "speed"),
                following((predecessor, "speed")),
            ],
            writes=motion_keys(name),
            event_shape=(followers, 1),
        )
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.safe_headway = safe_headway
        self.gap_spread, self.speed_spread = gap_spread, speed_spread
        self.name, self.predecessor = name, predecessor
        self.gap_stream, self.speed_stream = stream_id(f"{name}.gap"), stream_id(f"{name}.speed")
        self.register_buffer("index", torch.arange(followers).unsqueeze(-1))

    def compute(
        self,
        speed: Tensor,
        gap: Tensor,
        last_acceleration: Tensor,
        action: Tensor,
        leader: Tensor,
        leader_reached: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return speed, gap, relative speed, acceleration and jerk at the moment reached."""
        command = action * self.max_acceleration
        reached, executed = advance_speed(speed, command, self.time_step)
        ahead, ahead_reached = speeds_ahead(leader, speed), speeds_ahead(leader_reached, reached)
        gap = advance_gap(gap, ahead, speed, ahead_reached, reached, self.time_step)
        jerk = (executed - last_acceleration) / self.time_step
        return reached, gap, ahead_reached - reached, executed, jerk

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        seed, leader = start.get(SEED).unsqueeze(-2), start.get((self.predecessor, "speed"))
        shift = 2.0 * uniform(seed, 0, self.gap_stream + self.index) - 1.0
        gap = self.safe_headway + self.gap_spread * shift
        shift = 2.0 * uniform(seed, 0, self.speed_stream + self.index) - 1.0
        speed = (leader.unsqueeze(-2) + self.speed_spread * shift).clamp(min=0.0)
        still = torch.zeros_like(speed)
        relative = speeds_ahead(leader, speed) - speed
        values = (speed, gap, relative, still, still.clone())
        for key, value in zip(motion_keys(self.name), values, strict=True):
            start.set(key, value)


class PlatoonErrors(Feature):
    """Writes the errors to predecessor and leader as received over the air (HCFS H1–H2).

    Under ``name``: ``gap_error`` e_x(i,i−1) and ``leader_gap_error`` e_x(i,0) [m],
    ``speed_error`` e_v(i,i−1) and ``leader_speed_error`` e_v(i,0) [m/s], positive where the
    follower is too far behind or too slow, and ``received_gap``, the gap as the message says [m].

    Args:
        followers: vehicles behind the leader.
        safe_headway: h, the gap to be kept [m].
        delay: of vehicle-to-vehicle messages; it acts on the positions received [s].
        name: namespace of the followers.
        predecessor: namespace of the leader.

    Raises:
        ConfigError: if ``delay`` is negative.
    """

    def __init__(
        self,
        followers: int = 6,
        safe_headway: float = 5.0,
        delay: float = 0.005,
        name: str = "platoon",
        predecessor: str = "leader",
    ) -> None:
        if not delay >= 0:
            raise ConfigError(f"{name}: delay must not be negative, got {delay}")
        written = (
            "gap_error",
            "speed_error",
            "leader_gap_error",
            "leader_speed_error",
            "received_gap",
        )
        super().__init__(
            [(predecessor, "speed"), (name, "speed"), (name, "gap")],
            [(name, entry) for entry in written],
            (followers, 1),
        )
        self.safe_headway, self.delay = safe_headway, delay

    def compute(self, leader_speed: Tensor, speed: Tensor, gap: Tensor) -> tuple[Tensor, ...]:
        """Return the four errors and the gap received."""
        errors = platoon_errors(leader_speed, speed, gap, self.safe_headway, self.delay)
        return (*errors, errors.gap + self.safe_headway)


class PlatoonObservation(Feature):
    """Gathers each follower's own state, each entry times a fixed constant (HCFS H3).

    Writes ``"observation"``, ``[*batch, followers, entries]``.

    Args:
        scales: constant of each entry of the platoon, in the order of the observation.
        followers: vehicles behind the leader.
        platoon: namespace of the followers.
        name: entry written.

    Raises:
        ConfigError: if there is no entry or a scale is zero.
    """

    constants: Tensor

    def __init__(
        self,
        scales: Mapping[str, float],
        followers: int = 6,
        platoon: str = "platoon",
        name: str = "observation",
    ) -> None:
        if not scales or not all(scales.values()):
            raise ConfigError("observation.scales must name at least one entry, none with scale 0")
        super().__init__([(platoon, entry) for entry in scales], [name], (followers, len(scales)))
        self.register_buffer("constants", torch.tensor([float(x) for x in scales.values()]))

    def compute(self, *entries: Tensor) -> Tensor:
        """Return the scaled observation."""
        return torch.cat(entries, dim=-1) * self.constants
