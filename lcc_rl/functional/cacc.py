"""Cooperative adaptive cruise control (HCFS H1–H2, H11).

Signs: an error is positive where the follower is too far behind or too slow; the signs of H1–H2 as
printed would make the gap negative. Tensors of vehicles are ``[*batch, N, 1]``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from lcc_rl.errors import require
from lcc_rl.functional.kinematics import advance_speed
from lcc_rl.functional.string import gather


class Errors(NamedTuple):
    """Errors of a vehicle's position and speed in the platoon, each ``[*batch, N, 1]``.

    gap: e_x(i,i−1) [m]; speed: e_v(i,i−1) [m/s]; leader_gap: e_x(i,0) [m]; leader_speed:
    e_v(i,0) [m/s].
    """

    gap: Tensor
    speed: Tensor
    leader_gap: Tensor
    leader_speed: Tensor


def platoon_errors(
    ahead: Tensor,
    lead: Tensor,
    speed: Tensor,
    gap: Tensor,
    headway: float,
    delay: float,
    chain: Chain | None = None,
) -> Errors:
    """Compute the errors to the predecessor and to the leader of the chain (H1–H2).

    e_x(i,i−1) = x_{i−1} − x_i − (L+h) and e_x(i,0) = x_0 − x_i − i (L+h). With gaps measured
    bumper to bumper the vehicle length L cancels. The delay acts on the positions *received*,
    x̂ = x − delay · v, and is never integrated.

    Args:
        ahead: speed of the vehicle ahead of each vehicle, ``[*batch, vehicles, 1]`` [m/s].
        lead: speed of the leader of its chain, likewise [m/s].
        speed: v_i, likewise [m/s].
        gap: bumper-to-bumper gap to the vehicle ahead, likewise [m].
        headway: h, the gap to be kept [m].
        delay: of vehicle-to-vehicle messages [s].
        chain: the radio links; None: all vehicles are one chain behind a leader that sends.

    Returns:
        The errors of each vehicle, of the same shape.
    """
    excess = gap - headway
    received = excess - delay * ahead
    total = excess.cumsum(-2)
    if chain is None:
        leader_gap = total - delay * lead
    else:
        received = torch.where(chain.hears, received, excess)
        total = total - gather(total - excess, chain.first)
        leader_gap = torch.where(chain.hears, total - delay * lead, total)
    return Errors(received, ahead - speed, leader_gap, lead - speed)


class Chain(NamedTuple):
    """The radio links of a string; other vehicles use their own sensors, which have no delay.

    first: index of the first vehicle of each vehicle's chain of connected vehicles, int64,
    ``[*batch, N]``; hears: whether the vehicle ahead, and so the leader of its chain, sends to it,
    ``[*batch, N, 1]``.
    """

    first: Tensor
    hears: Tensor


def find_chains(connected: Tensor, leader_sends: bool) -> Chain:
    """Find the chains of connected vehicles, each behind a leader that is not.

    A vehicle receives messages of the connected vehicles directly ahead of it. The vehicle ahead
    of the first of them is their leader, which the first one measures by its sensors.

    Args:
        connected: whether a vehicle sends and receives, ``[*batch, N]``.
        leader_sends: whether the vehicle ahead of the whole string sends, too.
    """
    before = torch.nn.functional.pad(connected[..., :-1], (1, 0), value=False)
    goes_on = connected & before
    place = torch.arange(connected.shape[-1], device=connected.device)
    first = torch.where(goes_on, 0, place).cummax(-1).values
    hears = goes_on | (connected & leader_sends & (place == 0))
    return Chain(first, hears.unsqueeze(-1))


@dataclass(frozen=True)
class Gains:
    """Gains of the CACC law; k1, k3 [1/s] weigh gap errors, k2, k4 [–] speed errors.

    k1 and k2 belong to the predecessor, k3 and k4 to the leader.
    """

    k1: float
    k2: float
    k3: float
    k4: float

    def check_stable(self, time_step: float) -> None:
        """Check that the closed loop is stable: kx > 0 and T·kx/2 < kv < 2.

        kx = k1 + k3 and kv = k2 + k4. By the Jury criterion for
        e_v' = e_v − kx e_x − kv e_v, e_x' = e_x + T (e_v + e_v')/2. This holds for every follower:
        the other vehicles enter as inputs only.

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
        require(not failed, f"gains: this CACC is unstable: {'; '.join(failed)}")


def cacc_acceleration(
    errors: Errors, gains: Gains, time_step: float, speed: Tensor | None = None
) -> Tensor:
    """Compute the acceleration of the CACC law (H11), ``[*batch, N, 1]`` [m/s²].

    H11 is dimensionally a speed command, v_cmd = v_i + k1 e_x(i,i−1) + k2 e_v(i,i−1) +
    k3 e_x(i,0) + k4 e_v(i,0), reached in one step: a = (v_cmd − v_i)/T. With ``speed``, v_i, the
    law is as printed, where v_cmd is the acceleration. The controller clips it to ±a_max.
    """
    change = (
        gains.k1 * errors.gap
        + gains.k2 * errors.speed
        + gains.k3 * errors.leader_gap
        + gains.k4 * errors.leader_speed
    )
    return change / time_step if speed is None else speed + change


def next_leader_speed(leader: Sequence[Tensor], lookahead: str, time_step: float) -> Tensor:
    """Predict the leader's speed one step ahead [m/s].

    Args:
        leader: its speed v_0 [m/s], its acceleration a_0 by backward difference [m/s²] and its
            true next speed [m/s], which only ``"oracle"`` reads.
        lookahead: ``"causal"``: v_0 + a_0 T; ``"hold"``: v_0; ``"oracle"``: the true speed.
        time_step: T [s].
    """
    speed, acceleration, true_next = leader
    if lookahead == "oracle":
        return true_next
    if lookahead == "hold":
        return speed
    return advance_speed(speed, acceleration, time_step)[0]
