"""The hybrid car-following strategy: the better of two candidates (HCFS H4–H6, H12–H14).

Tensors of vehicles are ``[*batch, N, 1]``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from lcc_rl.functional.kinematics import advance_gap, advance_speed

# The command of the hybrid strategy: the better candidate (the paper); the point between both that
# is nearest to the rule and earns no less; or the rule and the first vehicle's correction of it.
Choice = Literal["better", "between", "first"]


class PlatoonPlace(NamedTuple):
    """Place of a vehicle in its platoon, each ``[*batch, N, 1]``.

    leader_gap: e_x(i,0), positive where too far behind [m]; leader_speed: v_0 [m/s].
    """

    leader_gap: Tensor
    leader_speed: Tensor


@dataclass(frozen=True)
class PlatoonReward:
    """The paper's reward H4–H6: −ω1 |e_v(i,0)|/v_max − ω2 |jerk|/jerk_scale.

    Table IV of the paper determines ω1/v_max = 0.369 s/m and ω2 = 0.036 (jerk_scale =
    2 a_max/T = 30 m/s³). The paper's reward has no spacing term; −ω3 (e_x(i,0)/gap_scale)² is an
    addition that only :meth:`one_step` uses.

    Args:
        velocity_weight: ω1.
        speed_scale: v_max [m/s].
        jerk_weight: ω2.
        jerk_scale: 2 a_max/T [m/s³].
        spacing_weight: ω3; 0 as in the paper.
        gap_scale: deviation that costs ω3 [m].
        spacing_time: time after a step, at the speeds reached, at which e_x counts [s].
    """

    velocity_weight: float = 10.0
    speed_scale: float = 27.1
    jerk_weight: float = 0.036
    jerk_scale: float = 30.0
    spacing_weight: float = 0.0
    gap_scale: float = 1.0
    spacing_time: float = 0.0

    def __call__(self, speed_error: Tensor, jerk: Tensor) -> Tensor:
        """Return the reward for e_v(i,0) [m/s] and jerk [m/s³], in their broadcast shape."""
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
        place: PlatoonPlace | None = None,
    ) -> Tensor:
        """Return the reward that an acceleration will earn, ``[*batch, N, 1]`` (H12).

        With a spacing weight, e_x(i,0) after the step and ``spacing_time`` at the speeds reached
        counts, too. Without that time the speed would outweigh the position in every step,
        because one step moves a vehicle by a T²/2 only.

        Args:
            speed: v_i [m/s].
            last_acceleration: a_{k−1} as executed [m/s²].
            acceleration: the candidate [m/s²].
            leader_next: the predicted speed of each vehicle's leader [m/s].
            time_step: T [s].
            place: the vehicle's place in its platoon, needed with a spacing weight.
        """
        reached, executed = advance_speed(speed, acceleration, time_step)
        jerk = (executed - last_acceleration) / time_step
        earned = self(leader_next - reached, jerk)
        if not self.spacing_weight or place is None:
            return earned
        leader_gap, leader_speed = place
        error = advance_gap(leader_gap, leader_speed, speed, leader_next, reached, time_step)
        error = error + self.spacing_time * (leader_next - reached)
        return earned - self.spacing_weight * (error / self.gap_scale).square()


class Decision(NamedTuple):
    """Decision of the hybrid strategy, each ``[*batch, N, 1]``.

    acceleration [m/s²]; winner: 0 for the rule, 1 for the learned policy; switched, clamped,
    capped: whether the winner changed, the jerk bound cut a candidate, the safe cap cut one.
    """

    acceleration: Tensor
    winner: Tensor
    switched: Tensor
    clamped: Tensor
    capped: Tensor


def jerk_interval(
    last_acceleration: Tensor, jerk_bound: float, time_step: float, limits: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return the accelerations within limits between which |jerk| keeps the bound J of H15–H21."""
    reach = jerk_bound * time_step
    low = (last_acceleration - reach).clamp(min=limits[0])
    return low, (last_acceleration + reach).clamp(max=limits[1])


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
    limits: tuple[float, float],
    place: PlatoonPlace | None = None,
    choice: Choice = "better",
) -> Decision:
    """Decide between two candidate accelerations, per follower (H12–H14).

    1. Clamp both to the interval of the jerk bound and, from above, to the safe cap.
    2. The candidate with the larger one-step reward wins; the rule wins ties.
    3. In the step in which the winner changes, the command is the mean of both.

    The theorem H15–H21 assumes that each candidate keeps the jerk bound relative to the
    acceleration executed last; only step 1 ensures that.

    ``choice="between"`` replaces steps 2 and 3: the command is the point between the candidates
    that is nearest to the rule and earns no less than either. It does not jump, and no step earns
    less than a candidate, as the mean of step 3 may. With ``"first"`` the first vehicle decides
    so. Its correction is the difference from its rule; the other vehicles add it to theirs. It
    cancels in the errors between neighbours, which follow the rule's law for any policy.

    Args:
        rule, learned: the candidates [m/s²]; the rule's may exceed the limits, so that neighbours
            differ by its law there, too.
        speed: v_i [m/s].
        last_acceleration: a_{k−1} as executed [m/s²].
        last_winner: winner of the step before; negative or None where there was none.
        leader_next: the predicted speed of each vehicle's leader [m/s].
        interval: see :func:`jerk_interval`; None: no bound (the literal rule).
        cap: see :func:`lcc_rl.functional.braking.safe_acceleration`; it may be below them. None:
            no cap. If the cap or a candidate is not finite, the vehicle brakes fully.
        reward: the reward by which candidates are compared.
        time_step: T [s].
        limits: least and largest acceleration, in the paper −a_max and a_max [m/s²].
        place: the vehicle's place in its platoon, needed by a reward with a spacing weight.
        choice: see above. With ``"between"`` and ``"first"`` the winner is the nearer candidate.
    """
    (one, two), clamped, capped = _bounded(torch.stack([rule, learned]), interval, cap, limits)

    def earned(x: Tensor) -> Tensor:
        return reward.one_step(speed, last_acceleration, x, leader_next, time_step, place)

    if choice == "better":
        share = (earned(two) > earned(one)).to(one.dtype)
    else:  # the reward bends where the speed error or the jerk vanishes
        bends = torch.cat([(leader_next - speed) / time_step, last_acceleration], -1)
        share = _nearest(one, two, bends, earned)
    if choice == "first":
        share = share[..., :1, :].expand_as(rule)
    winner = (share > 0.5).to(torch.int64)
    before = winner if last_winner is None else last_winner
    switched = (before >= 0) & (winner != before)
    if choice == "better":
        share = torch.where(switched, 0.5, share)
    chosen = torch.lerp(one, two, share)
    if choice == "first":
        same = rule + (chosen - rule)[..., :1, :]
        (chosen,), clamped, capped = _bounded(same[None], interval, cap, limits)
    return Decision(chosen, winner, switched, clamped, capped)


def _nearest(
    rule: Tensor, learned: Tensor, bends: Tensor, earned: Callable[[Tensor], Tensor]
) -> Tensor:
    """Return the least share of the learned candidate in a mix that earns no less than either.

    Args:
        rule, learned: the candidates, ``[*batch, N, 1]`` [m/s²].
        bends: accelerations at which the slope of the reward changes, ``[*batch, N, n]`` [m/s²].
        earned: the reward of accelerations, concave.
    """
    span = learned - rule
    between = ((bends - rule) / torch.where(span == 0.0, 1.0, span)).clamp(0.0, 1.0).sort(-1).values
    shares = torch.cat([torch.zeros_like(rule), between, torch.ones_like(rule)], -1)
    rewards = earned(torch.lerp(rule, learned, shares))
    wanted = torch.maximum(rewards[..., :1], rewards[..., -1:])
    # Within the interval in which this level is first reached.
    end = (rewards >= wanted).to(torch.int64).argmax(-1, keepdim=True)
    begin = (end - 1).clamp(min=0)
    low, high = rewards.gather(-1, begin), rewards.gather(-1, end)
    part = (wanted - low) / torch.where(high == low, 1.0, high - low)
    share = torch.lerp(shares.gather(-1, begin), shares.gather(-1, end), part.clamp(0.0, 1.0))
    return torch.where(span == 0.0, 0.0, share)


def _bounded(
    candidates: Tensor,
    interval: tuple[Tensor, Tensor] | None,
    cap: Tensor | None,
    limits: tuple[float, float],
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the candidates within jerk bound and cap, and whether each cut one (step 1)."""
    given, free = candidates, candidates.clamp(*limits)
    candidates = free
    if interval is not None:
        candidates = candidates.clamp(*interval)
    clamped = (candidates != free).any(0)
    if cap is None:
        return candidates, clamped, torch.zeros_like(clamped)
    bounded = torch.minimum(candidates, cap.clamp(min=limits[0]))
    # If a candidate or an input of the cap is NaN, no command is known to be safe.
    known = (given.isfinite() & bounded.isfinite() & cap.isfinite()).all(0)
    bounded = torch.where(known, bounded, limits[0])
    return bounded, clamped, (bounded != candidates).any(0)
