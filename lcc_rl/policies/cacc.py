"""Cooperative adaptive cruise control as a policy (HCFS H11)."""

from __future__ import annotations

from typing import ClassVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from lcc_rl.functional.cacc import Errors, Gains, cacc_acceleration

ERRORS = ("gap_error", "speed_error", "leader_gap_error", "leader_speed_error")


class CACCPolicy(TensorDictModuleBase):
    """Drives every follower of a platoon by the CACC law; learns nothing.

    Reads the four errors under ``platoon`` and writes ``"action"``: the acceleration over
    ``max_acceleration``, shape ``[*batch, followers, 1]``.

    Args:
        time_step: duration of a step T [s].
        max_acceleration: acceleration of action 1 [m/s²].
        k1: gain of e_x(i,i−1) [1/s].
        k2: gain of e_v(i,i−1).
        k3: gain of e_x(i,0) [1/s].
        k4: gain of e_v(i,0).
        platoon: namespace of the followers.

    Raises:
        ConfigError: if the closed loop is unstable, naming the condition that fails.
    """

    learns: ClassVar[bool] = False

    def __init__(
        self,
        time_step: float,
        max_acceleration: float,
        k1: float = 0.04,
        k2: float = 0.12,
        k3: float = 1.4,
        k4: float = 1.3,
        platoon: str = "platoon",
    ) -> None:
        self.in_keys = [(platoon, entry) for entry in ERRORS]
        self.out_keys = ["action"]
        super().__init__()
        self.gains = Gains(k1, k2, k3, k4)
        self.gains.check_stable(time_step)
        self.time_step, self.max_acceleration = time_step, max_acceleration

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy itself: what an agent of any kind offers."""
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        errors = Errors(*(tensordict.get(key) for key in self.in_keys))
        wanted = cacc_acceleration(errors, self.gains, self.time_step, self.max_acceleration)
        return tensordict.set("action", wanted / self.max_acceleration)
