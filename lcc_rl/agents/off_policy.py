"""What agents that learn from a replay buffer share: settings, networks and optimizers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives import HardUpdate
from torchrl.objectives.common import LossModule

from lcc_rl.agents.loop import anneal, check_fraction, derived_seed
from lcc_rl.agents.vectors import join, take_step, vector_adam, views
from lcc_rl.errors import ConfigError, require_in, require_positive, require_whole, unknown_name
from lcc_rl.policies import GaussianExploration
from lcc_rl.policies.actor import make_actor, seeded_mlp


@dataclass(frozen=True)
class Exploration:
    """Schedule of the exploration noise: falls linearly, or by a factor at every update.

    Args:
        initial: standard deviation at the first episode, where the action's range is [-1, 1].
        final: after the decay.
        decay_share: share of the training over which it falls linearly; None: see next.
        decay_per_update: factor of every update, down to ``final``; None: falls linearly.

    Raises:
        ConfigError: if a value is out of range, or both or neither decay is given.
    """

    initial: float = 0.4
    final: float = 0.05
    decay_share: float | None = 0.5
    decay_per_update: float | None = None

    def __post_init__(self) -> None:
        where = "agent.exploration"
        require_in(where, "[0, inf)", initial=self.initial, final=self.final)
        if (self.decay_share is None) == (self.decay_per_update is None):
            raise ConfigError(
                f"{where}: give either decay_share or decay_per_update, and null for the other"
            )
        if self.decay_share is not None:
            require_in(where, "(0, 1]", decay_share=self.decay_share)
        if self.decay_per_update is not None:
            require_in(where, "(0, 1]", decay_per_update=self.decay_per_update)

    def sigma(self, share: float, updates: int = 0) -> float:
        """Return the standard deviation after this share of the training and these updates."""
        if self.decay_per_update is not None:
            return max(self.final, self.initial * self.decay_per_update**updates)
        assert self.decay_share is not None
        return self.initial + (self.final - self.initial) * min(share / self.decay_share, 1.0)


@dataclass(frozen=True)
class OffPolicySettings:
    """Settings that all agents with a replay buffer share; conf/agent holds their values.

    Args:
        gamma: discount.
        hidden: sizes of the ReLU layers of policy and Q networks.
        actor_lr: learning rate of the policy.
        critic_lr: learning rate of the Q networks.
        batch_size: transitions per update.
        buffer_size: transitions that the replay buffer holds.
        tau: share by which the target networks follow at every update.
        saturation: weight of a penalty on the square of the actor's output before its tanh; 0 is
            the literal algorithm. Without it some seeds brake fully for ever: where every action
            leads to the same end, nothing else draws the actor back from the tanh's flat part.
        final_lr_fraction: of the learning rates at the end; they fall to it along half a cosine.
            1 is the literal algorithm, whose policy keeps swinging until it stops.
        updates_per_transition: updates per collected transition.
        learning_starts: transitions in the buffer before the first update; at least one batch.
        best_window: episodes whose mean reward rates the policy; the best one becomes the run's.
            None: the last one does.
        exploration: schedule of the exploration, see :class:`Exploration`.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    gamma: float = 0.9
    hidden: Sequence[int] = (200, 100, 50)
    actor_lr: float = 1e-3
    critic_lr: float = 1e-3
    batch_size: int = 1024
    buffer_size: int = 20000
    tau: float = 0.005
    saturation: float = 0.001
    final_lr_fraction: float = 0.05
    updates_per_transition: float = 0.125
    learning_starts: int = 0
    best_window: int | None = None
    exploration: Mapping[str, float | None] = field(
        default_factory=lambda: {
            "initial": 0.4,
            "final": 0.05,
            "decay_share": 0.5,
            "decay_per_update": None,
        }
    )

    def __post_init__(self) -> None:
        require_in("agent", "[0, 1)", gamma=self.gamma)
        require_in("agent", "(0, 1]", tau=self.tau)
        if not 0 < self.batch_size <= self.buffer_size:
            raise ConfigError(
                f"agent.batch_size ({self.batch_size}) must be positive and at most "
                f"agent.buffer_size ({self.buffer_size})"
            )
        require_in("agent", "[0, inf)", saturation=self.saturation)
        check_fraction(self.final_lr_fraction)
        # Far more updates than that would be a training without end.
        require_in("agent", "(0, 1000]", updates_per_transition=self.updates_per_transition)
        if not 0 <= self.learning_starts <= self.buffer_size:
            raise ConfigError(
                f"agent.learning_starts ({self.learning_starts}) must be between 0 and "
                f"agent.buffer_size ({self.buffer_size}), or nothing is ever learned"
            )
        if self.best_window is not None:
            require_whole("agent", 1, best_window=self.best_window)
        require_positive("agent", actor_lr=self.actor_lr, critic_lr=self.critic_lr)
        known = [item.name for item in fields(Exploration)]
        for key in self.exploration:
            if key not in known:
                raise unknown_name("setting of agent.exploration", key, known)


class OffPolicy(ABC):
    """A policy, its Q networks, their loss and optimizers; a subclass says what an update is.

    Args:
        observation_size: entries of the observation.
        action_size: entries of the action.
        seed: seed of the initial weights.
        settings: see :class:`OffPolicySettings`; None for its defaults.
        device: where the networks live.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    Settings: ClassVar[type[OffPolicySettings]] = OffPolicySettings
    critics: ClassVar[int] = 1

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        settings: Any = None,
        device: str = "cpu",
    ) -> None:
        self.settings: Any = self.Settings() if settings is None else settings
        self.seed, self.device, self.count = seed, device, 0
        self.exploration = Exploration(**self.settings.exploration)
        hidden = self.settings.hidden
        self.policy: TensorDictModule = make_actor(observation_size, action_size, hidden, seed).to(
            device
        )
        self.noise: TensorDictModuleBase = GaussianExploration(0.0)
        inputs, keys = observation_size + action_size, ["observation", "action"]
        self.values = [
            ValueOperator(seeded_mlp(inputs, 1, hidden, seed + 1 + 2 * number), in_keys=keys).to(
                device
            )
            for number in range(self.critics)
        ]
        self.optimizers: dict[str, torch.optim.Adam] = {}
        self.targets: dict[str, tuple[Tensor, Tensor]] = {}  # of each: its vector and the online

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's."""
        return anneal(self.optimizers.values(), share, self.settings.final_lr_fraction)

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take one gradient step.

        Args:
            batch: transitions with observation, action and, under ``"next"``, observation,
                reward, done and terminated; shape ``[batch_size]``.

        Returns:
            ``loss_actor`` and ``loss_value``, detached.
        """

    def _complete(self, loss: LossModule, critic: str, delayed: Sequence[str]) -> None:
        """Set discount, optimizers and targets of a loss with an actor and Q networks.

        Args:
            loss: TorchRL's.
            critic: its name for the Q networks' parameters.
            delayed: which of ``"actor"`` and ``"value"`` have a target network.
        """
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.settings.gamma)
        # TorchRL asks for an updater of the targets; _follow does its work.
        HardUpdate(loss)
        rates = {"actor": self.settings.actor_lr, "value": self.settings.critic_lr}
        for name, key in (("actor", "actor_network_params"), ("value", critic)):
            network = leaves(getattr(loss, key))
            vector = join(network)
            slopes = torch.zeros_like(vector)
            for parameter, slope in zip(network, views(slopes, network), strict=True):
                parameter.grad = slope
            self.optimizers[name] = vector_adam(vector, slopes, [len(vector)], [rates[name]])
            if name in delayed:
                self.targets[name] = join(leaves(getattr(loss, f"target_{key}"))), vector

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Make what TorchRL draws a function of the seed and the number of updates so far."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(self.seed, self.count, "update"))
            yield

    def _penalty(self, batch: TensorDictBase) -> Tensor:
        """Return the penalty on the actor's output before its tanh."""
        raw = self.policy.module[0](batch["observation"])
        return self.settings.saturation * raw.square().mean()

    def _step(self, *names: str) -> None:
        """Take a step of the named optimizers along the gradients at hand; clear all gradients."""
        for name in names:
            take_step(self.optimizers[name])
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=False)

    @torch.no_grad()
    def _follow(self, *names: str) -> None:
        """Move the named target networks towards their own, as TorchRL's ``SoftUpdate`` does."""
        for name in names:
            target, vector = self.targets[name]
            target.lerp_(vector, self.settings.tau)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to resume bit for bit."""
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


def leaves(parameters: TensorDictBase) -> list[Tensor]:
    """Return the tensors of a network's parameters, in the order of its layers."""
    return list(parameters.flatten_keys().values())
