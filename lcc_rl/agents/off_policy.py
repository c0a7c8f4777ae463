"""What the agents that learn from a replay buffer share besides DDPG's own update."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from lcc_rl.agents.ddpg import Exploration, check_gentleness, check_settings, leaves
from lcc_rl.agents.loop import anneal, derived_seed
from lcc_rl.errors import require_positive
from lcc_rl.policies import GaussianExploration
from lcc_rl.policies.actor import make_actor, seeded_mlp


class OffPolicy(ABC):
    """A policy, its loss and its optimizers; a subclass says what an update is.

    Args:
        observation_size, action_size, seed, gamma, hidden, batch_size, buffer_size, tau,
            updates_per_transition, saturation, final_share, exploration, device: see
            :class:`lcc_rl.agents.DDPG`.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    learns: ClassVar[bool] = True

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        gamma: float,
        hidden: Sequence[int],
        batch_size: int,
        buffer_size: int,
        tau: float,
        updates_per_transition: float,
        saturation: float,
        final_share: float,
        exploration: Mapping[str, float] | None,
        device: str,
    ) -> None:
        check_settings(gamma, batch_size, buffer_size, tau, updates_per_transition)
        check_gentleness(saturation, final_share)
        self.seed, self.gamma, self.saturation = seed, gamma, saturation
        self.batch_size, self.buffer_size = batch_size, buffer_size
        self.updates_per_transition, self.final_share = updates_per_transition, final_share
        self.exploration = Exploration(**(exploration or {}))
        self.policy: TensorDictModuleBase = make_actor(
            observation_size, action_size, hidden, seed
        ).to(device)
        self.noise: TensorDictModuleBase = GaussianExploration(0.0)
        inputs, keys = observation_size + action_size, ["observation", "action"]
        self.values = [
            ValueOperator(seeded_mlp(inputs, 1, hidden, seed + number), in_keys=keys).to(device)
            for number in (1, 3)
        ]
        self.count = 0

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's."""
        return anneal(self.optimizers.values(), share, self.final_share)

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take one gradient step; as :meth:`lcc_rl.agents.DDPG.update`."""

    def _complete(self, loss: LossModule, tau: float, rates: tuple[float, float]) -> None:
        """Set discount, followers and optimizers of a loss with an actor and Q networks.

        Raises:
            ConfigError: if a learning rate, of the actor or the Q networks, is not positive.
        """
        require_positive("agent", actor_lr=rates[0], critic_lr=rates[1])
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.gamma)
        self.targets = SoftUpdate(self.loss, tau=tau)
        networks = (self.loss.actor_network_params, self.loss.qvalue_network_params)
        self.optimizers = {
            name: torch.optim.Adam(leaves(network), lr=rate, fused=True)
            for name, network, rate in zip(("actor", "value"), networks, rates, strict=True)
        }

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Make what TorchRL draws a function of the seed and the number of updates so far."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(self.seed, self.count, "update"))
            yield

    def _penalty(self, batch: TensorDictBase) -> Tensor:
        """Keep the policy out of the tanh's flat part, as in DDPG."""
        return self.saturation * self.policy.module[0](batch["observation"]).square().mean()

    def _step(self, *names: str) -> None:
        """Take a step of the named optimizers along the gradients at hand."""
        for name in names:
            self.optimizers[name].step()
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to go on bit for bit."""
        return {
            "count": self.count,
            "loss": dict(self.loss.state_dict()),
            "optimizers": {name: part.state_dict() for name, part in self.optimizers.items()},
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.count = state["count"]
        self.loss.load_state_dict(state["loss"])
        for name, part in self.optimizers.items():
            part.load_state_dict(state["optimizers"][name])
