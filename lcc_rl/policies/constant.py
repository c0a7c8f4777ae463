"""One action for ever: nobody acts, or only a filter does."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from lcc_rl.errors import ConfigError


class ConstantPolicy(TensorDictModuleBase):
    """Writes the same ``"action"`` always, shape ``[*batch, 1]``; learns nothing.

    Args:
        action: that action, in [−1, 1].

    Raises:
        ConfigError: if it lies outside.
    """

    learns: ClassVar[bool] = False

    def __init__(self, action: float = 0.0) -> None:
        if not -1.0 <= action <= 1.0:
            raise ConfigError(f"agent.action must lie in [-1, 1], got {action}")
        self.in_keys = ["observation"]
        self.out_keys = ["action"]
        super().__init__()
        self.action = action

    @property
    def policy(self) -> TensorDictModuleBase:
        """The policy itself: what an agent of any kind offers."""
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the action."""
        like = tensordict.get("observation")[..., :1]
        return tensordict.set("action", torch.full_like(like, self.action))
