"""What agents share that learn through the simulator itself, by its gradient or by search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from typing import Any, Literal, TypeVar

from lcc_rl.agents.agent import Agent, Scene
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.agents.objective import Objective
from lcc_rl.agents.rules import make_policy
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs.rollout import DifferentiableRollout
from lcc_rl.envs.step import pieces_of
from lcc_rl.pieces.base import as_key
from lcc_rl.pieces.rewards import REWARD, RewardTerm
from lcc_rl.settings import Count, Positive, Share


class SimulatedAgent(Agent):
    """A policy and the objective that it learns by; once started, ``policy`` is the module."""

    # A network; a rule with learned constants (idm, acc); or a network on top of a rule
    # (residual_idm, residual_acc).
    policy: Any = "network"
    constants: dict[str, Positive] | None = None  # of a rule at the start; the others keep theirs
    hidden: Sequence[Count] = (200, 100, 50)  # ReLU layers of a network
    # Nodes of reward terms that take the place of those of the same name in the objective; their
    # weights multiply the terms' own. Those of terms that the reward lacks are ignored.
    surrogates: dict[str, Any] = field(default_factory=dict)
    # Largest share of the time in which a surrogate's limit may be missed, by its name, or that of
    # the recorded drivers; its weight is the price at the start, see lcc_rl.agents.limits.
    limits: dict[str, Share | Literal["recorded"] | None] = field(default_factory=dict)
    limit_rate: Positive = 0.1  # largest change of the logarithm of such a price at once
    regularizers: dict[str, Any] = field(default_factory=dict)  # terms of the objective only

    def setup(self, scene: Scene) -> None:
        assert scene.observation is not None
        self.objective = Objective(self, scene.device, scene.world)
        module = make_policy(
            self.policy,
            scene.observation,
            self.hidden,
            scene.seed,
            self.constants,
            scene.max_acceleration,
        )
        self.policy = module.to(scene.device)

    def take(self, profiles: Profiles) -> None:
        """Take the limits that recorded drivers set."""
        self.objective.limits.take(profiles)


SimulatedT = TypeVar("SimulatedT", bound=Any)


class SimulatedLoop(TrainingLoop[SimulatedT]):
    """A loop that plays the simulator by itself; arguments as of :class:`TrainingLoop`."""

    def _prepare(self) -> None:
        self.terms = [piece for piece in pieces_of(self.env) if isinstance(piece, RewardTerm)]
        self.objective: Objective = self.agent.objective
        self.objective.replace(self.terms)

    def _rollout(self, compiled: bool = False) -> DifferentiableRollout:
        """Return what plays episodes for the objective, and records the reward's terms."""
        known = set(map(as_key, self.env.full_observation_spec.keys(True, True)))
        return DifferentiableRollout(
            self.env,
            wanted=self.objective.wanted(known),
            observed=[REWARD, *(term.targets[0] for term in self.terms)],
            compiled=compiled,
        )

    def _limits_row(self, shares: Mapping[str, float]) -> dict[str, float]:
        """Return the columns of the limits: how often each was missed, and at which price."""
        price, largest = self.objective.limits.price, self.objective.limits.largest
        return {
            **{f"limit_{name}": largest[name] for name in shares},
            **{f"share_{name}": share for name, share in shares.items()},
            **{f"price_{name}": price(name) for name in shares},
        }
