"""Policy gradient through the simulator itself: back-propagation through time.

The environment is differentiable, so the gradient of the return by the policy's weights need not
be estimated from samples. Rewards with thresholds have none; smooth stand-ins take their place in
the objective (:mod:`lcc_rl.pieces.surrogates`), while the record keeps the literal terms. The
gradient may be cut into segments, each ended by a learned value (short-horizon actor-critic, Xu
et al., "Accelerated policy learning with parallel differentiable simulation", ICLR 2022).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from lcc_rl.agents.loop import anneal, check_fraction
from lcc_rl.agents.simulated import SimulatedAgent, SimulatedSettings
from lcc_rl.errors import require, require_in, require_positive, require_whole
from lcc_rl.policies.actor import seeded_mlp


@dataclass(frozen=True)
class AnalyticSettings(SimulatedSettings):
    """Settings of the analytic agent; the layers are those of policy and value network.

    Args:
        learning_rate: of the policy at the start; it falls along half a cosine.
        final_lr_fraction: of it that is left at the end.
        clip_norm: gradients longer than this are shortened to it; through 300 steps of traffic
            they can become arbitrarily long.
        gamma: discount.
        bootstrap: learn a value and add it at the end of every segment; without it the segment is
            all that counts, and should be the whole episode.
        value_lr: learning rate of the value network.
        td_lambda: weight of longer returns in the value's targets, per step.
        value_every: steps from one moment at which the value is learned to the next; moments a
            tenth of a second apart tell hardly more than one of them. 1 takes all.
        tau: share by which the value's target network follows at every update.
        compiled: compile the step of the simulator; None: where the training is long enough to
            pay for it. Without a compiler the plain step is used.

    Raises:
        ConfigError: if a setting is out of range or contradicts another.
    """

    learning_rate: float = 3e-3
    final_lr_fraction: float = 0.05
    clip_norm: float = 1.0
    gamma: float = 0.998
    bootstrap: bool = True
    value_lr: float = 1e-3
    td_lambda: float = 0.95
    value_every: int = 5
    tau: float = 0.05
    compiled: bool | None = None

    def __post_init__(self) -> None:
        require_in("agent", "(0, 1]", gamma=self.gamma, tau=self.tau)
        require_in("agent", "[0, 1]", td_lambda=self.td_lambda)
        require_whole("agent", 1, value_every=self.value_every)
        require(not self.bootstrap or self.gamma < 1.0, "agent.bootstrap needs agent.gamma below 1")
        require_positive(
            "agent",
            learning_rate=self.learning_rate,
            clip_norm=self.clip_norm,
            value_lr=self.value_lr,
        )
        check_fraction(self.final_lr_fraction)


class Analytic(SimulatedAgent):
    """A policy, its optimizer, the objective's stand-ins and, where asked for, a value.

    Arguments as of :class:`lcc_rl.agents.simulated.SimulatedAgent`.
    """

    Settings: ClassVar[type[AnalyticSettings]] = AnalyticSettings

    def _prepare(self, size: int) -> None:
        own, seed = self.settings, self.seed + 1
        self.value = seeded_mlp(size, 1, own.hidden, seed).to(self.device)
        self.target = seeded_mlp(size, 1, own.hidden, seed).to(self.device)
        self.optimizer = torch.optim.Adam(
            [entry for entry in self.policy.parameters() if entry.requires_grad],
            lr=own.learning_rate,
            betas=(0.9, 0.99),
        )
        self.value_optimizer = torch.optim.Adam(self.value.parameters(), lr=own.value_lr)

    def anneal(self, share: float) -> float:
        """Set and return the learning rate after this share of the training."""
        return anneal([self.optimizer], share, self.settings.final_lr_fraction)

    def update(self, rewards: Tensor, running: Tensor, observation: Tensor) -> dict[str, Tensor]:
        """Take one gradient step on the policy, and one on the value where it is learned.

        Args:
            rewards: the objective at each step of a segment, ``[batch, steps, A]``, zero where an
                episode is over; with their graph back to the policy's weights.
            running: whether each episode goes on after each step, ``[batch, steps, 1]``.
            observation: at each of the segment's moments, ``[batch, steps + 1, A, n]``, likewise.

        Returns:
            The loss and the length of its gradient before clipping, and the value's loss.
        """
        steps = rewards.shape[1]
        discounts = self.settings.gamma ** torch.arange(steps, device=rewards.device)
        returns = (rewards * discounts.unsqueeze(-1)).sum(1)
        if self.settings.bootstrap:
            last = self.target(observation[:, -1]).squeeze(-1) * running[:, -1]
            returns = returns + self.settings.gamma**steps * last
        loss = -returns.mean()
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.policy.parameters(), self.settings.clip_norm)
        # A step along a gradient that is not a number would destroy the weights for good.
        if bool(torch.isfinite(norm)):
            self.optimizer.step()
        result = {"loss_actor": loss.detach(), "gradient_norm": norm.detach()}
        if self.settings.bootstrap:
            result["loss_value"] = self._fit(rewards.detach(), running, observation.detach())
        return result

    def _fit(self, rewards: Tensor, running: Tensor, observation: Tensor) -> Tensor:
        """Take one step of the value towards the λ-returns of a segment and move its target."""
        own, steps = self.settings, rewards.shape[1]
        begins = range(0, steps, own.value_every)
        ends = [*begins[1:], steps]
        gamma = own.gamma ** torch.arange(own.value_every, device=rewards.device).unsqueeze(-1)
        with torch.no_grad():
            after = running[:, [end - 1 for end in ends]]
            ahead = self.target(observation[:, ends]).squeeze(-1) * after
            wanted, future = rewards.new_empty(ahead.shape), ahead[:, -1]
            for place in range(len(ends) - 1, -1, -1):
                begin, end = begins[place], ends[place]
                length = end - begin
                mixed = torch.lerp(ahead[:, place], future, own.td_lambda**length)
                reward = (rewards[:, begin:end] * gamma[:length]).sum(1)
                future = reward + own.gamma**length * mixed * after[:, place]
                wanted[:, place] = future
        # What follows a collision is no state of any episode.
        begun = torch.cat([torch.ones_like(running[:, :1]), after[:, :-1]], 1)
        seen = observation[:, : steps : own.value_every]
        error = (self.value(seen).squeeze(-1) - wanted) * begun
        loss = error.square().mean()
        self.value_optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.value_optimizer.step()
        with torch.no_grad():
            pairs = zip(self.target.parameters(), self.value.parameters(), strict=True)
            for target, online in pairs:
                target.lerp_(online, self.settings.tau)
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to resume bit for bit."""
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        own = {"policy": self.policy, "optimizer": self.optimizer, "limits": self.objective.limits}
        if self.settings.bootstrap:
            learned = (self.value, self.target, self.value_optimizer)
            own |= dict(zip(("value", "target", "value_optimizer"), learned, strict=True))
        return own
