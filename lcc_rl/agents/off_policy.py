"""Base of agents that learn from a replay buffer: settings, networks and optimizers."""

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

from lcc_rl.agents.actor import GaussianExploration, seeded_mlp
from lcc_rl.agents.agent import Fraction, Scene, Schedule, anneal, derived_seed
from lcc_rl.agents.fused import ActorCritic
from lcc_rl.agents.replay import ReplayLoop
from lcc_rl.agents.sampling import Sampling
from lcc_rl.agents.vectors import as_vector, take_step, vector_adam, views
from lcc_rl.errors import ConfigError
from lcc_rl.settings import Count, LearningRate, NonNegative, Positive, Settings, Share, Whole


class Exploration(Settings):
    """Schedule of the exploration noise: linear, or a factor per update."""

    initial: NonNegative = 0.4  # standard deviation at the first episode; actions lie in [-1, 1]
    final: NonNegative = 0.05  # standard deviation after the decay
    decay_share: Fraction | None = 0.5  # share of the training with the linear decay
    decay_per_update: Fraction | None = None  # alternatively the factor per update

    def validate(self) -> None:
        if (self.decay_share is None) == (self.decay_per_update is None):
            raise ConfigError(
                "agent.exploration: give either decay_share or decay_per_update, and null for the "
                "other"
            )

    def sigma(self, share: float, updates: int = 0) -> float:
        """Return the standard deviation after a share of the training and a number of updates."""
        if self.decay_per_update is not None:
            return max(self.final, self.initial * self.decay_per_update**updates)
        assert self.decay_share is not None
        return self.initial + (self.final - self.initial) * min(share / self.decay_share, 1.0)


class OffPolicy(Sampling):
    """A policy, its Q networks, their loss and optimizers; a subclass defines the update.

    Each step moves target networks by a share of the difference (HCFS H9–H10).
    """

    gamma: Share = 0.9  # discount
    hidden: Sequence[Count] = (200, 100, 50)  # layers of policy and Q networks
    actor_lr: LearningRate = 1e-3  # learning rate of the policy
    critic_lr: LearningRate = 1e-3  # learning rate of the Q networks
    batch_size: Count = 1024  # transitions per update
    buffer_size: Count = 20_000  # transitions that the replay buffer holds
    tau: Fraction = 0.005  # share of a step of the targets; not given in the paper
    # Weight of a penalty on the square of the actor's output before its tanh; 0 is the literal
    # algorithm. Without it the policies of some seeds brake fully in all states: where all actions
    # have equal values, no other term moves the actor away from the flat part of the tanh.
    saturation: NonNegative = 0.001
    # Final learning rates as a fraction of the initial ones. 1 is the literal algorithm, whose
    # policy fluctuates until the end.
    final_lr_fraction: Fraction = 0.05
    schedule: Schedule = "cosine"  # shape of the learning rates
    clip_norm: Positive | None = None  # largest norm of a gradient; None: not clipped
    # Updates per collected transition; not given in the paper.
    updates_per_transition: Annotated[float, Field(gt=0.0, le=1000.0)] = 0.125
    n_step: Count = 1  # decisions whose rewards a TD target sums; their actions are those stored
    learning_starts: Whole = 0  # transitions in the buffer before the first update
    # Number of episodes whose mean reward selects the run's policy; None: the last policy.
    best_window: Count | None = None
    exploration: Exploration = field(default_factory=Exploration)
    # Compute the gradient explicitly, which equals that of TorchRL's loss up to rounding and takes
    # less time. False, or networks without ReLU: differentiate the loss automatically.
    fused: bool = True

    loop = ReplayLoop
    critics: ClassVar[int] = 1
    joint: ClassVar[bool] = True  # whether one optimizer steps all networks at once

    def validate(self) -> None:
        for name in ("batch_size", "learning_starts"):
            if getattr(self, name) > self.buffer_size:
                raise ConfigError(
                    f"agent.{name} ({getattr(self, name)}) must be at most agent.buffer_size "
                    f"({self.buffer_size}), or there are no updates"
                )

    def setup(self, scene: Scene) -> None:
        size, seed, kind = scene.observation_size, scene.seed, self.activation
        self.generator = torch.Generator(scene.device)
        self.lasting = False  # whether a target value may last for several updates
        self.actor = self.make_actor(scene)
        self.noise: TensorDictModuleBase = GaussianExploration(0.0)
        keys = ["observation", "action"]
        seeds = range(seed + 1, seed + 1 + 2 * self.critics, 2)
        networks = (seeded_mlp(size + 1, 1, self.hidden, own, kind) for own in seeds)
        self.values = [ValueOperator(x, in_keys=keys).to(scene.device) for x in networks]

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
            loss: TorchRL's loss.
            delayed: names of networks with a target network, of ``"actor"`` and ``"value"``.
            alpha: a learned temperature and its learning rate.
        """
        self.loss = loss
        self.loss.make_value_estimator(gamma=self.gamma)
        # TorchRL requires an updater of the targets; _follow replaces it.
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
        """Store all learned tensors in one vector, likewise their gradients and targets."""
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
        """Seed TorchRL's draws by the seed and the number of updates."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derived_seed(self.seed, self.count, "update"))
            yield

    def _noise(self, like: Tensor, count: int) -> list[Tensor]:
        """Draw ``count`` times N(0, 1) as TorchRL's loss does in this update."""
        generator = self.generator.manual_seed(derived_seed(self.seed, self.count, "update"))
        return [
            torch.randn(like.shape, generator=generator, device=like.device) for _ in range(count)
        ]

    def _losses(self, batch: TensorDictBase) -> dict[str, Tensor]:
        """Write the gradient, explicit or automatic; return the losses."""
        by_loss = self.written is None
        losses = self._by_loss(batch) if by_loss else self._by_hand(batch, self.written)
        return dict(zip(("loss_actor", "loss_value"), losses, strict=True))

    def _penalty(self, batch: TensorDictBase) -> Tensor:
        """Return the penalty on the actor's output before its tanh."""
        raw = self.actor.module[0](batch["observation"])
        return self.saturation * raw.square().mean()

    def _differentiate(self, loss: Tensor) -> None:
        """Write the gradient of a loss by automatic differentiation."""
        self.slopes.zero_()
        loss.backward()

    def _step(self, name: str) -> None:
        """Take a step of the named optimizer along the present gradients."""
        optimizer = self.optimizers[name]
        if self.clip_norm is not None:
            weights = [weight for group in optimizer.param_groups for weight in group["params"]]
            nn.utils.clip_grad_norm_(weights, self.clip_norm)
        take_step(optimizer)

    @torch.no_grad()
    def _follow(self, *names: str) -> None:
        """Move the named target networks towards the networks, as TorchRL's ``SoftUpdate``."""
        for name in names:
            target, vector = self.targets[name]
            target.lerp_(vector, self.tau)

    def _parts(self) -> dict[str, Any]:
        return {"loss": self.loss, **self._more(), **self.optimizers}


def leaves(parameters: TensorDictBase) -> list[Tensor]:
    """Return the tensors of a network's parameters, in the order of its layers."""
    return list(parameters.flatten_keys().values())
