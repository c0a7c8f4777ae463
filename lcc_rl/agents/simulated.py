"""What agents share that learn through the simulator itself, by its gradient or by search."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

from tensordict.nn import TensorDictModule

from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.agents.objective import Objective
from lcc_rl.energy import Fleet, as_fleet
from lcc_rl.envs.rollout import DifferentiableRollout
from lcc_rl.envs.step import pieces_of
from lcc_rl.functional.pattern import VehicleString
from lcc_rl.pieces.base import as_key
from lcc_rl.pieces.observation import Observation
from lcc_rl.pieces.rewards import REWARD, RewardTerm
from lcc_rl.pieces.world import World
from lcc_rl.policies.rules import make_policy


@dataclass(frozen=True)
class SimulatedSettings:
    """What learns, and what it maximises; conf/agent holds the values.

    Args:
        policy: what learns: ``"network"``, a rule with learned constants (``"idm"``, ``"acc"``), or
            a network on top of a rule (``"residual_idm"``, ``"residual_acc"``).
        constants: constants of a rule at the start; those left out have its own values.
        hidden: sizes of the ReLU layers of a network.
        surrogates: nodes of reward terms that take the place of those of the same name in the
            objective; their weights multiply the terms' own. Those of terms that the reward
            lacks are ignored.
        limits: largest share of the time in which a surrogate's limit may be missed, by its name;
            its weight is then the price at the start, see :class:`lcc_rl.agents.limits.Limits`.
        limit_rate: largest change of the logarithm of such a price at once.
        regularizers: nodes of reward terms that belong to the objective only.
    """

    policy: str = "network"
    constants: Mapping[str, float] | None = None
    hidden: Sequence[int] = (200, 100, 50)
    surrogates: Mapping[str, Any] = field(default_factory=dict)
    limits: Mapping[str, float | None] = field(default_factory=dict)
    limit_rate: float = 0.1
    regularizers: Mapping[str, Any] = field(default_factory=dict)


class SimulatedAgent(ABC):
    """A policy and the objective that it learns by.

    Args:
        observation: what the policy sees.
        seed: seed of the initial weights.
        time_step: duration of a step [s], for terms of the objective that need it.
        max_acceleration: acceleration of action 1 [m/s²], for rules.
        string: the string of vehicles, for terms of the objective.
        settings: see the class's ``Settings``; None for its defaults.
        device: where the networks live.
        energy: the energy models, for terms of the objective; None for the ALCC paper's.

    Raises:
        ConfigError: if a setting is out of range.
    """

    Settings: ClassVar[type[SimulatedSettings]] = SimulatedSettings

    def __init__(
        self,
        observation: Observation,
        seed: int,
        time_step: float,
        max_acceleration: float = 3.0,
        string: VehicleString | None = None,
        settings: Any = None,
        device: str = "cpu",
        energy: Fleet | None = None,
    ) -> None:
        self.settings: Any = self.Settings() if settings is None else settings
        self.seed, self.device = seed, device
        own = self.settings
        world = World(string or VehicleString(), time_step, energy=as_fleet(energy))
        self.objective = Objective(own, device, world)
        self.policy: TensorDictModule = make_policy(
            own.policy, observation, own.hidden, seed, own.constants, max_acceleration
        ).to(device)
        self._prepare(observation.event_shape[-1])

    @abstractmethod
    def _prepare(self, size: int) -> None:
        """Make what learns besides the policy; observations have ``size`` entries."""


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
        price = self.objective.limits.price
        return {
            **{f"share_{name}": share for name, share in shares.items()},
            **{f"price_{name}": price(name) for name in shares},
        }
