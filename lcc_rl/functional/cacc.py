"""Cooperative adaptive cruise control and the hybrid strategy built on it (HCFS H1–H14).

Signs: an error is positive where the follower is too far behind or too slow; the signs of H1–H2 as
printed would make the gap negative. Tensors of followers are ``[*batch, followers, 1]``, those of
the leader ``[*batch, 1]``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.kinematics import advance_speed


class Errors(NamedTuple):
    """What a follower knows of its place in the platoon, each ``[*batch, followers, 1]``.

    gap: e_x(i,i−1) [m]; speed: e_v(i,i−1) [m/s]; leader_gap: e_x(i,0) [m]; leader_speed:
    e_v(i,0) [m/s].
    """

    gap: Tensor
    speed: Tensor
    leader_gap: Tensor
    leader_speed: Tensor


def speeds_ahead(leader_speed: Tensor, speed: Tensor) -> Tensor:
    """Return the speed of the vehicle ahead of each follower, ``[*batch, followers, 1]``."""
    first = leader_speed.unsqueeze(-2)
    return first if speed.shape[-2] == 1 else torch.cat([first, speed[..., :-1, :]], dim=-2)


def platoon_errors(
    leader_speed: Tensor, speed: Tensor, gap: Tensor, safe_headway: float, delay: float
) -> Errors:
    """Compute the errors to the predecessor and to the leader (H1–H2).

    e_x(i,i−1) = x_{i−1} − x_i − (L+h) and e_x(i,0) = x_0 − x_i − i (L+h). With gaps measured
    bumper to bumper the vehicle length L cancels. The delay acts on the positions *received*,
    x̂ = x − delay · v, and is never integrated.

    Args:
        leader_speed: v_0 [m/s].
        speed: v_i [m/s].
        gap: bumper-to-bumper gap to the vehicle ahead [m].
        safe_headway: h, the gap to be kept [m].
        delay: of vehicle-to-vehicle messages [s].
    """
    ahead = speeds_ahead(leader_speed, speed)
    lead = leader_speed.unsqueeze(-2)
    excess = gap - safe_headway
    return Errors(
        gap=excess - delay * ahead,
        speed=ahead - speed,
        leader_gap=excess.cumsum(-2) - delay * lead,
        leader_speed=lead - speed,
    )


@dataclass(frozen=True)
class Gains:
    """Gains of the CACC law; k1, k3 [1/s] weigh gap errors, k2, k4 [–] speed errors.

    k1, k2 belong to the predecessor, k3, k4 to the leader.
    """

    k1: float
    k2: float
    k3: float
    k4: float

    def check_stable(self, time_step: float, where: str = "gains") -> None:
        """Check that the closed loop is stable: kx > 0 and T·kx/2 < kv < 2.

        kx = k1 + k3 and kv = k2 + k4. By the Jury criterion for
        e_v' = e_v − kx e_x − kv e_v, e_x' = e_x + T (e_v + e_v')/2, the same for every follower,
        since what the others do enters only as an input.

        Raises:
            ConfigError: naming the condition that fails.
        """
        kx, kv = self.k1 + self.k3, self.k2 + self.k4
        low = 0.5 * time_step * kx
        conditions = {
            f"kx = k1 + k3 = {kx:g} must be positive": kx > 0,
            f"kv = k2 + k4 = {kv:g} must exceed T·kx/2 = {low:g}": kv > low,
            f"kv = k2 + k4 = {kv:g} must be below 2": kv < 2,
        }
        failed = [text for text, holds in conditions.items() if not holds]
        if failed:
            raise ConfigError(f"{where}: this CACC is unstable: {'; '.join(failed)}")


def cacc_acceleration(
    errors: Errors, gains: Gains, time_step: float, max_acceleration: float
) -> Tensor:
    """Compute the acceleration of the CACC law (H11), ``[*batch, followers, 1]`` [m/s²].

    H11 is dimensionally a speed command, v_cmd = v_i + k1 e_x(i,i−1) + k2 e_v(i,i−1) +
    k3 e_x(i,0) + k4 e_v(i,0), reached in one step: a = clip((v_cmd − v_i)/T, ±a_max).
    """
    change = (
        gains.k1 * errors.gap
        + gains.k2 * errors.speed
        + gains.k3 * errors.leader_gap
        + gains.k4 * errors.leader_speed
    )
    return (change / time_step).clamp(-max_acceleration, max_acceleration)


LOOKAHEADS = ("causal", "hold", "oracle")


def check_lookahead(lookahead: str, where: str) -> str:
    """Return the name of a look-ahead.

    Raises:
        ConfigError: if there is none of that name.
    """
    if lookahead not in LOOKAHEADS:
        raise ConfigError(
            f"{where}.lookahead must be one of {', '.join(LOOKAHEADS)}, got {lookahead!r}"
        )
    return lookahead


def next_leader_speed(
    speed: Tensor, acceleration: Tensor, true_next: Tensor, lookahead: str, time_step: float
) -> Tensor:
    """Predict the leader's speed one step ahead, ``[*batch, 1]`` [m/s].

    Args:
        speed: v_0 [m/s].
        acceleration: a_0 by backward difference [m/s²].
        true_next: the speed that the leader will really have; only ``"oracle"`` looks at it.
        lookahead: ``"causal"`` for v_0 + a_0 T, ``"hold"`` for v_0, ``"oracle"`` for the truth.
        time_step: T [s].
    """
    if lookahead == "oracle":
        return true_next
    if lookahead == "hold":
        return speed
    return advance_speed(speed, acceleration, time_step)[0]


def dead_beat_acceleration(
    speed: Tensor, target: Tensor, time_step: float, max_acceleration: float
) -> Tensor:
    """Compute the acceleration that reaches the leader's predicted speed in one step [m/s²].

    Args:
        speed: v_i, ``[*batch, followers, 1]`` [m/s].
        target: the leader's predicted speed, ``[*batch, 1]`` [m/s].
        time_step: T [s].
        max_acceleration: bound in both directions [m/s²].
    """
    wanted = (target.unsqueeze(-2) - speed) / time_step
    return wanted.clamp(-max_acceleration, max_acceleration)


@dataclass(frozen=True)
class PlatoonReward:
    """The paper's reward H4–H6: −ω1 |e_v(i,0)|/v_max − ω2 |jerk|/jerk_scale.

    Table IV of the paper determines ω1/v_max = 0.369 s/m and ω2 = 0.036 (jerk_scale =
    2 a_max/T = 30 m/s³).

    Args:
        velocity_weight: ω1.
        speed_scale: v_max [m/s].
        jerk_weight: ω2.
        jerk_scale: 2 a_max/T [m/s³].
    """

    velocity_weight: float = 10.0
    speed_scale: float = 27.1
    jerk_weight: float = 0.036
    jerk_scale: float = 30.0

    def __call__(self, speed_error: Tensor, jerk: Tensor) -> Tensor:
        """Return the reward of e_v(i,0) [m/s] and jerk [m/s³], of their broadcast shape."""
        return (
            -self.velocity_weight / self.speed_scale * speed_error.abs()
            - self.jerk_weight / self.jerk_scale * jerk.abs()
        )

    def one_step(
        self,
        speed: Tensor,
        last_acceleration: Tensor,
        acceleration: Tensor,
        leader_next: Tensor,
        time_step: float,
    ) -> Tensor:
        """Return the reward that an acceleration will earn, ``[*batch, followers, 1]`` (H12)."""
        reached, executed = advance_speed(speed, acceleration, time_step)
        jerk = (executed - last_acceleration) / time_step
        return self(leader_next.unsqueeze(-2) - reached, jerk)


def safe_acceleration(
    gap: Tensor,
    speed: Tensor,
    ahead: Tensor,
    time_step: float,
    braking: float,
    margin: float,
) -> Tensor:
    """Compute the largest acceleration after which braking still avoids the vehicle ahead.

    The vehicle ahead brakes at ``braking`` to standstill from now on; the follower executes this
    acceleration for one step, then brakes at ``braking`` too and ends ``margin`` behind it.

    Args:
        gap: bumper-to-bumper gap as received [m].
        speed: own speed [m/s].
        ahead: speed of the vehicle ahead [m/s].
        time_step: T [s].
        braking: b [m/s²].
        margin: g [m].

    Returns:
        The cap [m/s²], of the arguments' shape; it may lie below −b where it is too late.
    """
    ahead_next = (ahead - braking * time_step).clamp(min=0.0)
    room = gap + 0.5 * time_step * (ahead + ahead_next) + ahead_next**2 / (2.0 * braking) - margin
    q = 0.5 * time_step * speed - room
    root = (0.25 * time_step**2 - 2.0 * q / braking).clamp(min=0.0).sqrt()
    reached = braking * (root - 0.5 * time_step)
    return (reached - speed) / time_step


class Decision(NamedTuple):
    """What the hybrid strategy decides, each ``[*batch, followers, 1]``.

    acceleration [m/s²]; winner: 0 for the rule, 1 for the learned policy; switched, clamped,
    capped: whether the winner changed, the jerk bound cut a candidate, the safe cap the result.
    """

    acceleration: Tensor
    winner: Tensor
    switched: Tensor
    clamped: Tensor
    capped: Tensor


def jerk_interval(
    last_acceleration: Tensor, jerk_bound: float, time_step: float, max_acceleration: float
) -> tuple[Tensor, Tensor]:
    """Return the accelerations between which |jerk| stays within the bound (HCFS step 1)."""
    reach = jerk_bound * time_step
    low = (last_acceleration - reach).clamp(min=-max_acceleration)
    return low, (last_acceleration + reach).clamp(max=max_acceleration)


def hybrid_decision(
    rule: Tensor,
    learned: Tensor,
    speed: Tensor,
    last_acceleration: Tensor,
    last_winner: Tensor | None,
    leader_next: Tensor,
    interval: tuple[Tensor, Tensor] | None,
    cap: Tensor | None,
    reward: PlatoonReward,
    time_step: float,
    max_acceleration: float,
) -> Decision:
    """Decide between two candidate accelerations, per follower (H12–H14).

    1. Clamp both to the interval of the jerk bound and, from above, to the safe cap.
    2. The one whose one-step reward is larger wins; the rule wins ties.
    3. In the frame in which the winner changes, the two are blended half and half.

    The theorem H15–H21 assumes that each candidate keeps the jerk bound relative to the
    acceleration executed last; without step 1 that is not so.

    Args:
        rule, learned: the candidates [m/s²].
        speed: v_i [m/s].
        last_acceleration: a_{k−1} as executed [m/s²].
        last_winner: winner of the frame before, negative where there was none; None likewise.
        leader_next: the leader's predicted speed, ``[*batch, 1]`` [m/s].
        interval: see :func:`jerk_interval`; None leaves the bound out (the literal rule).
        cap: see :func:`safe_acceleration`; None leaves it out.
        reward: the reward to compare by.
        time_step: T [s].
        max_acceleration: a_max [m/s²]; no cap asks for braking harder than it.
    """
    candidates = torch.stack([rule, learned])
    free = candidates
    if interval is not None:
        candidates = candidates.clamp(*interval)
    clamped = (candidates != free).any(0)
    capped = torch.zeros_like(clamped)
    if cap is not None:
        bounded = torch.minimum(candidates, cap.clamp(min=-max_acceleration))
        capped = (bounded != candidates).any(0)
        candidates = bounded
    rule, learned = candidates.unbind(0)
    earned = reward.one_step(speed, last_acceleration, candidates, leader_next, time_step)
    winner = (earned[1] > earned[0]).to(torch.int64)
    if last_winner is None:
        switched = torch.zeros_like(clamped)
    else:
        switched = (last_winner >= 0) & (winner != last_winner)
    chosen = torch.where(winner.bool(), learned, rule)
    chosen = torch.where(switched, 0.5 * (rule + learned), chosen)
    return Decision(chosen, winner, switched, clamped, capped)
