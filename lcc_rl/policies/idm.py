"""A human driver as a policy: the Intelligent Driver Model in the controlled car's place."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.functional.idm import idm_acceleration
from lcc_rl.functional.random import choose, stream_id
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.vehicles import Population


class IDMPolicy(TensorDictModuleBase):
    """Drives the controlled car by A3; learns nothing.

    Reads speed, gap and relative speed of ``vehicle`` and writes ``"action"``: the acceleration
    over ``max_acceleration``, held within [−1, 1].

    Args:
        population: gives the shared IDM parameters, and the drivers when ``sampled``.
        max_acceleration: acceleration of action 1 [m/s²].
        desired_speed: desired speed v0 [m/s].
        time_gap: desired time gap T [s].
        sampled: draw a driver of the population for every episode instead, by its seed.
        vehicle: namespace of the controlled car.

    Raises:
        ConfigError: if ``desired_speed`` or ``time_gap`` is not positive.
    """

    learns: ClassVar[bool] = False
    desired_speeds: Tensor
    time_gaps: Tensor

    def __init__(
        self,
        population: Population,
        max_acceleration: float,
        desired_speed: float = 25.0,
        time_gap: float = 1.2,
        sampled: bool = False,
        vehicle: str = "cav",
    ) -> None:
        if not (desired_speed > 0 and time_gap > 0):
            raise ConfigError(
                f"agent: desired_speed {desired_speed} and time_gap {time_gap} must be positive"
            )
        self.in_keys = [(vehicle, "speed"), (vehicle, "gap"), (vehicle, "relative_speed"), SEED]
        self.out_keys = ["action"]
        super().__init__()
        self.drivers, self.max_acceleration = population.constants, max_acceleration
        self.stream = stream_id(f"{vehicle}.driver")
        fixed = torch.tensor([desired_speed]), torch.tensor([time_gap])
        drivers = (population.desired_speed, population.time_gap) if sampled else fixed
        self.register_buffer("desired_speeds", drivers[0], persistent=False)
        self.register_buffer("time_gaps", drivers[1], persistent=False)

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy itself: what an agent of any kind offers."""
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        speed, gap, relative_speed, seed = (tensordict.get(key) for key in self.in_keys)
        driver = choose(seed, len(self.desired_speeds), self.stream)
        acceleration = idm_acceleration(
            speed,
            gap,
            -relative_speed,
            self.desired_speeds[driver],
            self.time_gaps[driver],
            self.drivers,
        )
        return tensordict.set("action", (acceleration / self.max_acceleration).clamp(-1.0, 1.0))
