"""The hybrid car-following strategy: a rule and a learned policy, the better of both each step."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from lcc_rl.config import require
from lcc_rl.functional.cacc import (
    Decision,
    PlatoonReward,
    check_lookahead,
    hybrid_decision,
    jerk_interval,
    next_leader_speed,
    safe_acceleration,
)
from lcc_rl.pieces.base import STEP
from lcc_rl.policies.deadbeat import LEADER

HYBRID = "hybrid"
COUNTERS = ("switches", "clamps", "cap_interventions")


class HCFSPolicy(TensorDictModuleBase):
    """Composes two policies by HCFS H12–H14; see :func:`lcc_rl.functional.cacc.hybrid_decision`.

    The switching state lives in the TensorDict, where TorchRL carries it from step to step. Under
    ``"hybrid"``, each ``[*batch, followers, 1]``, int64: ``winner`` (0 rule, 1 learned) of this
    step, and since the start of the episode the numbers of ``switches``, ``clamps`` (the jerk
    bound cut a candidate) and ``cap_interventions``.

    Args:
        rule, learned: policies that write ``"action"``; any two.
        time_step: duration of a step T [s].
        max_acceleration: acceleration of action 1 [m/s²].
        jerk_bound: J [m/s³]; the paper's 2 a_max/T = 30 never binds.
        lookahead: how the leader's next speed is predicted: ``"causal"`` by v0 + a0 T, ``"hold"``
            by v0; ``"oracle"`` knows it and serves as an upper bound only.
        clamp: hold the candidates within the jerk bound; false is the literal rule, which
            violates it.
        safe_cap: hold the result below what braking allows; false is the literal rule, which in
            long runs drives through the vehicle ahead: the reward has no spacing term.
        braking: b of the safe cap [m/s²].
        margin: gap that it keeps at standstill [m].
        velocity_weight, speed_scale, jerk_weight, jerk_scale: of the reward compared, see
            :class:`lcc_rl.functional.cacc.PlatoonReward`.
        platoon: namespace of the followers.
        leader: namespace of the leader.

    Raises:
        ConfigError: if a setting is unknown or out of range.
    """

    def __init__(
        self,
        rule: Any,
        learned: Any,
        time_step: float,
        max_acceleration: float,
        jerk_bound: float = 30.0,
        lookahead: str = "causal",
        clamp: bool = True,
        safe_cap: bool = True,
        braking: float = 3.0,
        margin: float = 0.5,
        velocity_weight: float = 10.0,
        speed_scale: float = 27.1,
        jerk_weight: float = 0.036,
        jerk_scale: float = 30.0,
        platoon: str = "platoon",
        leader: str = "leader",
    ) -> None:
        require(jerk_bound > 0, f"controller.jerk_bound must be positive, got {jerk_bound}")
        require(
            0 < braking <= max_acceleration,
            f"controller.braking must lie in (0, {max_acceleration}], which is what the vehicles "
            f"can do, got {braking}",
        )
        require(margin >= 0, f"controller.margin must not be negative, got {margin}")
        own = ("speed", "acceleration", "received_gap", "speed_error")
        self._leader_keys = [(leader, entry) for entry in LEADER]
        self._own_keys = [(platoon, entry) for entry in own]
        self.in_keys = list(
            dict.fromkeys(
                [*rule.in_keys, *learned.in_keys, *self._leader_keys, *self._own_keys, STEP]
            )
        )
        self.out_keys = ["action", *((HYBRID, entry) for entry in ("winner", *COUNTERS))]
        super().__init__()
        self.rule, self.learned = rule, learned
        self.time_step, self.max_acceleration = time_step, max_acceleration
        self.jerk_bound, self.clamp, self.safe_cap = jerk_bound, clamp, safe_cap
        self.lookahead = check_lookahead(lookahead, "controller")
        self.braking, self.margin = braking, margin
        self.reward = PlatoonReward(velocity_weight, speed_scale, jerk_weight, jerk_scale)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action, the winner and the counters."""
        decision = self.decide(tensordict)
        flags = (decision.switched, decision.clamped, decision.capped)
        begun = (tensordict.get(STEP) > 0).unsqueeze(-2)
        for name, flag in zip(COUNTERS, flags, strict=True):
            count = flag.to(torch.int64)
            before = tensordict.get((HYBRID, name), None)
            tensordict.set((HYBRID, name), count if before is None else count + before * begun)
        tensordict.set((HYBRID, "winner"), decision.winner)
        return tensordict.set("action", decision.acceleration / self.max_acceleration)

    def decide(self, tensordict: TensorDictBase) -> Decision:
        """Return the decision and what led to it, writing nothing."""
        rule, learned = (
            policy(tensordict.copy()).get("action") * self.max_acceleration
            for policy in (self.rule, self.learned)
        )
        speed, last, gap, speed_error = (tensordict.get(key) for key in self._own_keys)
        leader, leading, true = (tensordict.get(key) for key in self._leader_keys)
        return hybrid_decision(
            rule,
            learned,
            speed,
            last,
            self._last_winner(tensordict),
            next_leader_speed(leader, leading, true, self.lookahead, self.time_step),
            jerk_interval(last, self.jerk_bound, self.time_step, self.max_acceleration)
            if self.clamp
            else None,
            safe_acceleration(
                gap, speed, speed + speed_error, self.time_step, self.braking, self.margin
            )
            if self.safe_cap
            else None,
            self.reward,
            self.time_step,
            self.max_acceleration,
        )

    def _last_winner(self, tensordict: TensorDictBase) -> Tensor | None:
        """Return the winner of the frame before, −1 where an episode has just begun."""
        last = tensordict.get((HYBRID, "winner"), None)
        if last is None:
            return None
        begun = (tensordict.get(STEP) > 0).unsqueeze(-2)
        return torch.where(begun, last, -1)
