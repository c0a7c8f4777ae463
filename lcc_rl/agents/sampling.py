"""Base of agents that learn from samples: decisions, discount by time, and rules under a policy."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.objective import Aiming
from lcc_rl.agents.rules import NETWORK_ALONE, RESIDUAL, Residual
from lcc_rl.errors import require
from lcc_rl.settings import NonNegative, Positive, Share


class Returns(nn.Module):
    """Number, total and total of the squares of the discounted sums of rewards of a training."""

    moments: Tensor

    def __init__(self, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.register_buffer("moments", torch.zeros(3, dtype=torch.float64))

    def add(self, reward: Tensor, done: Tensor, before: Tensor | float) -> Tensor | float:
        """Add a segment ``[environments, decisions, …]`` after given sums; return its last sums."""
        for now, ended in zip(reward.unbind(1), done.unsqueeze(-1).unbind(1), strict=True):
            sums = now + self.gamma * before
            self.moments += torch.stack([(sums.double() ** power).sum() for power in range(3)])
            before = sums * ~ended
        return before

    def deviation(self) -> Tensor:
        """Return the standard deviation of the sums."""
        count, total, square = self.moments
        return (square / count - (total / count).square()).clamp(min=1e-12).sqrt()


class Sampling(Aiming):
    """Settings of agents that learn from transitions between decisions."""

    gamma: Share  # discount per decision
    # Time between two decisions in training, in which the action is held [s]; 0: a step. A trained
    # policy decides in every step.
    hold: NonNegative = 0.0
    # Time after which a reward counts for 1/e, instead of gamma [s].
    horizon: Positive | None = None
    # Learn from rewards over the running standard deviation of their discounted sum.
    scale_rewards: bool = False

    def state_dict(self) -> dict[str, Any]:
        return {"count": self.count, **super().state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.count = state["count"]
        super().load_state_dict(state)

    def _more(self) -> dict[str, Any]:
        """Return further parts of the state, if there are: rule, prices of limits and scale."""
        limits = self.objective.limits if self.objective.limits.largest else None
        parts = {"rule": self.rule, "limits": limits, "returns": self.returns}
        return {name: part for name, part in parts.items() if part is not None}

    def scaled(self, reward: Tensor) -> Tensor:
        """Return rewards in the units of the losses."""
        return reward if self.returns is None else reward / self.returns.deviation().to(reward)

    def make_actor(self, scene: Scene) -> TensorDictModule:
        """Make ``policy``, and its ``rule`` if it has one; return the learned part.

        Raises:
            ConfigError: if the policy is a rule alone.
        """
        kind = self.policy
        self.count, self.every = 0, max(scene.world.steps(self.hold, "agent.hold"), 1)
        if self.horizon is not None:
            self.gamma = math.exp(-self.every * scene.world.time_step / self.horizon)
        self.returns = Returns(self.gamma).to(scene.device) if self.scale_rewards else None
        self.rule = None
        require(
            kind == NETWORK_ALONE or kind.startswith(RESIDUAL),
            f"agent.policy={kind}: only agent=analytic learns the constants of a rule; expected "
            f"{NETWORK_ALONE} or {RESIDUAL}{kind}",
        )
        self.aim(scene)
        whole = self.policy.module
        if not isinstance(whole, Residual):
            return self.policy
        self.rule = whole.rule
        own = nn.Sequential(whole.network, nn.Tanh())
        return TensorDictModule(own, in_keys=["observation"], out_keys=["action"])
