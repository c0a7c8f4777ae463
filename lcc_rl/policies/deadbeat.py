"""Dead-beat control: every follower takes the leader's predicted speed in one step."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from lcc_rl.functional.cacc import check_lookahead, dead_beat_acceleration, next_leader_speed

LEADER = ("speed", "acceleration", "next_speed")


class DeadBeatPolicy(TensorDictModuleBase):
    """Accelerates by (v̂0 − v)/T, within ±max_acceleration; learns nothing.

    With ``lookahead="oracle"`` it knows the leader's next speed and bounds what any controller
    can reach; ``"causal"`` takes v0 + a0 T, ``"hold"`` v0. It keeps no gap: errors of the past
    stay, so it is a yardstick, not a controller to drive with.

    Reads speed, acceleration and next speed of ``leader`` and the speed of ``platoon``; writes
    ``"action"``, shape ``[*batch, followers, 1]``.

    Args:
        time_step: duration of a step T [s].
        max_acceleration: acceleration of action 1 [m/s²].
        lookahead: ``"causal"``, ``"hold"`` or ``"oracle"``.
        platoon: namespace of the followers.
        leader: namespace of the leader.

    Raises:
        ConfigError: if the look-ahead is unknown.
    """

    learns: ClassVar[bool] = False

    def __init__(
        self,
        time_step: float,
        max_acceleration: float,
        lookahead: str = "causal",
        platoon: str = "platoon",
        leader: str = "leader",
    ) -> None:
        self.in_keys = [(platoon, "speed"), *((leader, entry) for entry in LEADER)]
        self.out_keys = ["action"]
        super().__init__()
        self.lookahead = check_lookahead(lookahead, "agent")
        self.time_step, self.max_acceleration = time_step, max_acceleration

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy itself: what an agent of any kind offers."""
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        speed, leader, acceleration, true = (tensordict.get(key) for key in self.in_keys)
        target = next_leader_speed(leader, acceleration, true, self.lookahead, self.time_step)
        wanted = dead_beat_acceleration(speed, target, self.time_step, self.max_acceleration)
        return tensordict.set("action", wanted / self.max_acceleration)
