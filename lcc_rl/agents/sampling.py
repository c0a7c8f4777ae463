"""Base of agents that learn from samples: decisions, discount by time, and rules under a policy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

from tensordict.nn import TensorDictModule
from torch import nn

from lcc_rl.agents.actor import Activation, make_actor
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.objective import Aiming, Objective
from lcc_rl.agents.rules import NETWORK_ALONE, RESIDUAL, Residual, make_policy
from lcc_rl.errors import require
from lcc_rl.settings import Count, NonNegative, Positive, Share


class Sampling(Aiming):
    """Settings of agents that learn from transitions between decisions."""

    gamma: Share  # discount per decision
    hidden: Sequence[Count]
    activation: Activation = "relu"  # between the layers of networks
    policy: Any = NETWORK_ALONE  # or a network on top of a rule, such as residual_idm
    constants: dict[str, Positive] | None = None  # of the rule; the others keep their defaults
    # Time between two decisions in training, in which the action is held [s]; 0: a step. A trained
    # policy decides in every step.
    hold: NonNegative = 0.0
    # Time after which a reward counts for 1/e, instead of gamma [s].
    horizon: Positive | None = None

    LATER: ClassVar[Sequence[str]] = (
        *("policy", "constants", "hold", "horizon"),
        *("surrogates", "regularizers", "limits", "limit_rate"),
    )

    def _more(self) -> dict[str, Any]:
        """Return further parts of the state: the rule and the prices of limits, if there are."""
        parts = {"rule": self.rule, "limits": self.objective.limits}
        used = {"rule": self.rule is not None, "limits": bool(self.objective.limits.largest)}
        return {name: part for name, part in parts.items() if used[name]}

    def make_actor(self, scene: Scene) -> TensorDictModule:
        """Make ``policy``, and its ``rule`` if it has one; return the learned part.

        Raises:
            ConfigError: if the policy is a rule alone.
        """
        kind, size = self.policy, scene.observation_size
        self.every = max(scene.world.steps(self.hold, "agent.hold"), 1)
        if self.horizon is not None:
            self.gamma = math.exp(-self.every * scene.world.time_step / self.horizon)
        self.objective = Objective(self, scene.device, scene.world)
        self.rule = None
        if kind == NETWORK_ALONE:
            learned = make_actor(size, 1, self.hidden, scene.seed, self.activation)
            self.policy = learned.to(scene.device)
            return self.policy
        require(
            kind.startswith(RESIDUAL),
            f"agent.policy={kind}: only agent=analytic learns the constants of a rule; expected "
            f"{NETWORK_ALONE} or {RESIDUAL}{kind}",
        )
        assert scene.observation is not None
        given = kind, scene.observation, self.hidden, scene.seed, self.constants
        self.policy = make_policy(*given, scene.max_acceleration, self.activation).to(scene.device)
        whole: Residual = self.policy.module
        self.rule = whole.rule
        own = nn.Sequential(whole.network, nn.Tanh())
        return TensorDictModule(own, in_keys=["observation"], out_keys=["action"])
