"""What agents that learn from a replay buffer share: settings, networks and optimizers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import field
from typing import Annotated, Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives import HardUpdate
from torchrl.objectives.common import LossModule

from lcc_rl.agents.actor import Activation, GaussianExploration, make_actor, seeded_mlp
from lcc_rl.agents.agent import Agent, Fraction, Scene, Schedule, anneal, derived_seed
from lcc_rl.agents.fused import ActorCritic
from lcc_rl.agents.replay import ReplayLoop
from lcc_rl.agents.vectors import as_vector, take_step, vector_adam, views
from lcc_rl.errors import ConfigError
from lcc_rl.settings import Count, NonNegative, Positive, Settings, Share, Whole


class Exploration(Settings):
    """Schedule of the exploration noise: falls linearly, or by a factor at every update."""

    initial: NonNegative = 0.4  # standard deviation at the first episode; actions lie in [-1, 1]
    final: NonNegative = 0.05  # after the decay
    decay_share: Fraction | None = 0.5  # share of the training over which it falls linearly
    decay_per_update: Fraction | None = None  # instead: factor of every update, down to final

    def validate(self) -> None:
        if (self.decay_share is None) == (self.decay_per_update is None):
            raise ConfigError(
                "agent.exploration: give either decay_share or decay_per_update, and null for the "
                "other"
            )

    def sigma(self, share: float, updates: int = 0) -> float:
        """Return the standard deviation after this share of the training and these updates."""
        if self.decay_per_update is not None:
            return max(self.final, self.initial * self.decay_per_update**updates)
        assert self.decay_share is not None
        return self.initial + (self.final - self.initial) * min(share / self.decay_share, 1.0)


class OffPolicy(Agent):
    """A policy, its Q networks, their loss and optimizers; a subclass defines the update.

    Target networks follow by a share of the difference (HCFS H9–H10).
    """

    gamma: Share = 0.9  # discount
    hidden: Sequence[Count] = (200, 100, 50)  # layers of policy and Q networks
    activation: Activation = "relu"  # between the layers of networks
    actor_lr: Positive = 1e-3  # learning rate of the policy
    critic_lr: Positive = 1e-3  # learning rate of the Q networks
    batch_size: Count = 1024  # transitions per update
    buffer_size: Count = 20_000  # transitions that the replay buffer holds
    tau: Fraction = 0.005  # share by which the targets follow at an update; the paper is silent
    # Weight of a penalty on the square of the actor's output before its tanh; 0 is the literal
    # algorithm. Without it some seeds brake fully for ever: where every action leads to the same
    # end, nothing else draws the actor back from the tanh's flat part.
    saturation: NonNegative = 0.001
    # Share of the learning rates that is left at the end of the schedule. 1 is the literal
    # algorithm, whose policy keeps swinging until it stops.
    final_lr_fraction: Fraction = 0.05
    schedule: Schedule = "cosine"  # how the learning rates fall
    clip_norm: Positive | None = None  # gradients longer than this are shortened to it
    # Updates per collected transition; the paper is silent. Many more would never end.
    updates_per_transition: Annotated[float, Field(gt=0.0, le=1000.0)] = 0.125
    learning_starts: Whole = 0  # transitions in the buffer before the first update
    # Episodes whose mean reward rates the policy; the best one becomes the run's. None: the last.
    best_window: Count | None = None
    exploration: Exploration = field(default_factory=Exploration)
    # Compute the gradient as written out, which gives the numbers of TorchRL's loss up to rounding
    # in less time; False, and networks without ReLU, differentiate the loss itself.
    fused: bool = True

    LATER = ("activation", "schedule", "clip_norm")
    loop = ReplayLoop
    critics: ClassVar[int] = 1
    joint: ClassVar[bool] = True  # whether one optimizer steps all that is learned at once

    def validate(self) -> None:
        for name in ("batch_size", "learning_starts"):
            if getattr(self, name) > self.buffer_size:
                raise ConfigError(
                    f"agent.{name} ({getattr(self, name)}) must be at most agent.buffer_size "
                    f"({self.buffer_size}), or nothing is ever learned"
                )

    def setup(self, scene: Scene) -> None:
        size, seed, kind = scene.observation_size, scene.seed, self.activation
        self.count, self.generator = 0, torch.Generator(scene.device)
        self.policy = make_actor(size, 1, self.hidden, seed, kind).to(scene.device)
        self.noise: TensorDictModuleBase = GaussianExploration(0.0)
        keys = ["observation", "action"]
        self.values = [
            ValueOperator(seeded_mlp(size + 1, 1, self.hidden, own, kind), in_keys=keys).to(
                scene.device
            )
            for own in range(seed + 1, seed + 1 + 2 * self.critics, 2)
        ]

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's."""
        return anneal(self.optimizers.values(), share, self.final_lr_fraction, self.schedule)

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Take one gradient step.

        Args:
            batch: transitions with observation, action and, under ``"next"``, observation,
                reward, done and terminated; shape ``[batch_size]``.

        Returns:
            ``loss_actor`` and ``loss_value``, detached.
        """

    def _complete(
        self, loss: LossModule, delayed: Sequence[str], alpha: tuple[Tensor, float] | None = None
    ) -> None:
        """Set discount, optimizers and targets of a loss with an actor and Q networks.

        Args:
            loss: TorchRL's.
            delayed: which of ``"actor"`` and ``"value"`` have a target network.
            alpha: a temperature that is learned, and its learning rate.
        """
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.gamma)
        # TorchRL asks for an updater of the targets; _follow does its work.
        HardUpdate(loss)
        keys = {"actor": "actor_network_params"}
        keys["value"] = "value_network_params" if self.critics == 1 else "qvalue_network_params"
        networks = {name: leaves(getattr(loss, key)) for name, key in keys.items()}
        rates = {"actor": self.actor_lr, "value": self.critic_lr}
        if alpha is not None:
            networks["alpha"], rates["alpha"] = [alpha[0]], alpha[1]
        targets = {name: leaves(getattr(loss, f"target_{keys[name]}")) for name in delayed}
        self._join(networks, rates, targets)
        parts = networks, targets, self.critics, self.gamma, self.saturation
        by_hand = self.fused and self.activation == "relu"
        self.written = ActorCritic(*parts) if by_hand else None

    def _join(
        self,
        networks: dict[str, list[Tensor]],
        rates: dict[str, float],
        targets: dict[str, list[Tensor]],
    ) -> None:
        """Let all that is learned live in one vector, as do its gradients and the targets."""
        everything = [tensor for network in networks.values() for tensor in network]
        vector = as_vector(everything)
        self.slopes = torch.zeros_like(vector)
        for parameter, slope in zip(everything, views(self.slopes, everything), strict=True):
            parameter.grad = slope
        sizes = {name: sum(map(Tensor.numel, network)) for name, network in networks.items()}
        parts = [each.split(list(sizes.values())) for each in (vector, self.slopes)]
        groups = {"all": (vector, self.slopes, [*sizes.values()], [*rates.values()])}
        if not self.joint:
            alone = zip(sizes, *parts, strict=True)
            groups = {n: (own, slope, [len(own)], [rates[n]]) for n, own, slope in alone}
        self.optimizers = {name: vector_adam(*group) for name, group in groups.items()}
        target = as_vector([tensor for network in targets.values() for tensor in network])
        behind = target.split([sizes[name] for name in targets])
        ahead = dict(zip(sizes, parts[0], strict=True))
        self.targets = {n: (own, ahead[n]) for n, own in zip(targets, behind, strict=True)}

    @contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Make what TorchRL draws a function of the seed and the number of updates so far."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(self.seed, self.count, "update"))
            yield

    def _noise(self, like: Tensor, count: int) -> list[Tensor]:
        """Draw what TorchRL's loss draws in this update: N(0, 1), so many times."""
        generator = self.generator.manual_seed(derived_seed(self.seed, self.count, "update"))
        return [
            torch.randn(like.shape, generator=generator, device=like.device) for _ in range(count)
        ]

    def _losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Write the gradient, by hand where it is written out; return the losses."""
        by_loss = self.written is None
        losses = self._by_loss(batch) if by_loss else self._by_hand(batch, self.written)
        return dict(zip(("loss_actor", "loss_value"), losses, strict=True))

    def _penalty(self, batch: TensorDictBase) -> Tensor:
        """Return the penalty on the actor's output before its tanh."""
        raw = self.policy.module[0](batch["observation"])
        return self.saturation * raw.square().mean()

    def _differentiate(self, loss: Tensor) -> None:
        """Write the gradient of a loss by automatic differentiation."""
        self.slopes.zero_()
        loss.backward()

    def _step(self, name: str) -> None:
        """Take a step of the named optimizer along the gradients at hand."""
        optimizer = self.optimizers[name]
        if self.clip_norm is not None:
            weights = [weight for group in optimizer.param_groups for weight in group["params"]]
            nn.utils.clip_grad_norm_(weights, self.clip_norm)
        take_step(optimizer)

    @torch.no_grad()
    def _follow(self, *names: str) -> None:
        """Move the named target networks towards their own, as TorchRL's ``SoftUpdate`` does."""
        for name in names:
            target, vector = self.targets[name]
            target.lerp_(vector, self.tau)

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
