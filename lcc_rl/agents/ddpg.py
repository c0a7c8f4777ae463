"""Deep deterministic policy gradient, on TorchRL's loss (ALCC Table III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import ValueOperator
from torchrl.objectives import DDPGLoss, SoftUpdate

from lcc_rl.agents.fused import FusedUpdate
from lcc_rl.agents.loop import anneal, check_final_share
from lcc_rl.errors import ConfigError, require_positive
from lcc_rl.policies.actor import make_actor, seeded_mlp


@dataclass(frozen=True)
class Exploration:
    """Standard deviation of the Gaussian action noise, falling linearly during training.

    Args:
        initial: at the first episode.
        final: after the decay.
        decay_share: share of the training over which it falls.

    Raises:
        ConfigError: if a value is out of range.
    """

    initial: float = 0.4
    final: float = 0.05
    decay_share: float = 0.5

    def __post_init__(self) -> None:
        if self.initial < 0 or self.final < 0 or not 0 < self.decay_share <= 1:
            raise ConfigError(
                "agent.exploration: initial and final must not be negative and decay_share must "
                f"lie in (0, 1], got {self}"
            )

    def sigma(self, share: float) -> float:
        """Return the standard deviation after this share of the training."""
        return self.initial + (self.final - self.initial) * min(share / self.decay_share, 1.0)


class DDPG:
    """Actor, critic, their target networks and one optimizer.

    Args:
        observation_size: entries of the observation.
        action_size: entries of the action.
        seed: seed of the initial weights.
        gamma: discount.
        hidden: sizes of the ReLU layers of both networks.
        actor_lr: learning rate of the policy.
        critic_lr: learning rate of the Q network.
        batch_size: transitions per update.
        buffer_size: transitions that the replay buffer holds.
        tau: share by which the target networks follow at every update.
        saturation: weight of a penalty on the square of the actor's output before its tanh; 0 is
            the literal algorithm. Without it some seeds brake fully for ever: where every action
            leads to the same end, nothing else draws the actor back from the tanh's flat part.
        final_share: share of the learning rates at the end; they fall to it along half a cosine.
            1 is the literal algorithm, whose policy keeps swinging until it stops.
        updates_per_transition: updates per collected transition.
        exploration: schedule of the action noise.
        fused: compute the update with its gradient written out, which gives the numbers of
            TorchRL's ``DDPGLoss`` up to rounding at up to twice the speed; False uses the loss
            itself.
        device: where the networks live.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    learns: ClassVar[bool] = True

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        seed: int,
        gamma: float = 0.9,
        hidden: Sequence[int] = (200, 100, 50),
        actor_lr: float = 1e-3,
        critic_lr: float = 1e-3,
        batch_size: int = 1024,
        buffer_size: int = 20000,
        tau: float = 0.005,
        saturation: float = 0.001,
        final_share: float = 1.0,
        updates_per_transition: float = 0.125,
        exploration: dict[str, float] | None = None,
        fused: bool = True,
        device: str = "cpu",
    ) -> None:
        check_settings(gamma, batch_size, buffer_size, tau, updates_per_transition)
        check_gentleness(saturation, final_share)
        require_positive("agent", actor_lr=actor_lr, critic_lr=critic_lr)
        self.gamma, self.batch_size, self.buffer_size = gamma, batch_size, buffer_size
        self.updates_per_transition, self.saturation = updates_per_transition, saturation
        self.final_share = final_share
        self.exploration = Exploration(**(exploration or {}))
        self.policy: TensorDictModuleBase = make_actor(
            observation_size, action_size, hidden, seed
        ).to(device)
        value = ValueOperator(
            seeded_mlp(observation_size + action_size, 1, hidden, seed + 1),
            in_keys=["observation", "action"],
        ).to(device)
        self.loss = DDPGLoss(
            self.policy, value, loss_function="l2", delay_actor=True, delay_value=True
        )
        self.loss.make_value_estimator(gamma=gamma)
        self.targets = SoftUpdate(self.loss, tau=tau)
        loss = self.loss
        actor, critic = leaves(loss.actor_network_params), leaves(loss.value_network_params)
        self.fused: FusedUpdate | None = None
        if fused:
            following = (loss.target_actor_network_params, loss.target_value_network_params)
            targets = (leaves(following[0]), leaves(following[1]))
            self.fused = FusedUpdate(
                actor, critic, *targets, (actor_lr, critic_lr), gamma, tau, saturation
            )
            self.optimizer = self.fused.optimizer
            return
        groups = [{"params": actor, "lr": actor_lr}, {"params": critic, "lr": critic_lr}]
        self.optimizer = torch.optim.Adam(groups, fused=True)

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's."""
        return anneal([self.optimizer], share, self.final_share)

    def update(self, batch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Take one gradient step on actor and critic and move the targets.

        Args:
            batch: transitions with observation, action and, under ``"next"``, observation,
                reward, done and terminated; shape ``[batch_size]``.

        Returns:
            The two losses, detached.
        """
        if self.fused is not None:
            loss_actor, loss_value = self.fused(batch)
            return {"loss_actor": loss_actor, "loss_value": loss_value}
        losses = self.loss(batch)
        raw = self.policy.module[0](batch["observation"])
        penalty = self.saturation * raw.square().mean()
        # Only these two: the other entries of TorchRL's result are not losses, and one of them
        # still carries a gradient.
        (losses["loss_actor"] + losses["loss_value"] + penalty).backward()
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        self.targets.step()
        return {key: losses[key].detach() for key in ("loss_actor", "loss_value")}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to go on bit for bit."""
        return {"loss": dict(self.loss.state_dict()), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.loss.load_state_dict(state["loss"])
        self.optimizer.load_state_dict(state["optimizer"])


def leaves(parameters: TensorDictBase) -> list[torch.Tensor]:
    """Return the tensors of a network's parameters, in the order of its layers."""
    return list(parameters.flatten_keys().values())


def check_settings(
    gamma: float, batch_size: int, buffer_size: int, tau: float, updates_per_transition: float
) -> None:
    """Check settings that all agents with a replay buffer share.

    Raises:
        ConfigError: naming the one at fault.
    """
    if not 0.0 <= gamma < 1.0:
        raise ConfigError(f"agent.gamma must lie in [0, 1), got {gamma}")
    if not 0.0 < tau <= 1.0:
        raise ConfigError(f"agent.tau must lie in (0, 1], got {tau}")
    if not 0 < batch_size <= buffer_size:
        raise ConfigError(
            f"agent.batch_size ({batch_size}) must be positive and at most agent.buffer_size "
            f"({buffer_size})"
        )
    if not updates_per_transition > 0:
        raise ConfigError(
            f"agent.updates_per_transition must be positive, got {updates_per_transition}"
        )


def check_gentleness(saturation: float, final_share: float) -> None:
    """Check what keeps a policy from running away and from swinging.

    Raises:
        ConfigError: naming the one at fault.
    """
    if saturation < 0:
        raise ConfigError(f"agent.saturation must not be negative, got {saturation}")
    check_final_share(final_share)
