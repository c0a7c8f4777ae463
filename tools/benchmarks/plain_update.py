"""Updates written by hand on plain tensors, as fast as torch's operations allow.

Everything large that is computed goes into tensors made beforehand. They share no code with the
package; :func:`check` holds them against TorchRL's losses.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import softplus

from benchmarks.harness import agree
from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.off_policy import OffPolicy

Network = list[tuple[Tensor, Tensor]]
COLUMNS = ("observation", "action", "reached", "reward", "terminated")


class PlainUpdate(ABC):
    """Draws a batch and takes one step of all that is learned and of the targets.

    Args:
        agent: whose weights, settings and sizes to copy.
        columns: the transitions to draw from, ``[transitions, …]`` each.
    """

    parts: ClassVar[tuple[str, ...]] = ("actor", "value")  # what has a target network

    def __init__(self, agent: OffPolicy, columns: Mapping[str, Tensor]) -> None:
        self.settings, self.rows = agent, agent.batch_size
        self.columns = [columns[name] for name in COLUMNS]
        self.drawn = [column[: self.rows].clone() for column in self.columns]
        self.device = self.columns[0].device
        self.index = torch.empty(self.rows, dtype=torch.long, device=self.device)
        self.generator, self.draws = (
            torch.Generator(self.device).manual_seed(seed) for seed in (0, 1)
        )
        seen, acts = self.columns[0].shape[1], self.columns[1].shape[1]
        critic = (seen + acts, *agent.hidden, 1)
        self.sizes = {"actor": [(seen, *agent.hidden, acts)], "value": [critic] * agent.critics}
        self._arrange(agent)
        self.acts, self.spare = self._made(self.sizes["actor"][0]), self._made(critic)
        self.judges = [self._made(critic) for _ in range(agent.critics)]
        self.input, self.wanted, self.slope, self.action = self._made((0, seen + acts, 1, 1, acts))
        self.steps: dict[int, Tensor] = {}

    def _arrange(self, agent: OffPolicy) -> None:
        """Copy the agent's weights into one vector, and its targets' into another."""
        state = {key: value.detach() for key, value in agent.loss.state_dict().items()}
        vectors: dict[str, Tensor] = {}
        for name in ("actor", "value", "target_actor", "target_value"):
            head = name if agent.critics == 1 else name.replace("value", "qvalue")
            own = [value for key, value in state.items() if key.startswith(f"{head}_network")]
            stacked = "value" in name and agent.critics > 1
            each = zip(*own, strict=True) if stacked else [own]
            flat = [tensor.reshape(-1) for tensors in each for tensor in tensors]
            vectors[name] = torch.cat(flat) if flat else torch.empty(0, device=self.device)
        extra = [state["log_alpha"].reshape(1)] if "log_alpha" in state else []
        self.weights = torch.cat([vectors["actor"], vectors["value"], *extra])
        self.targets = torch.cat([vectors[f"target_{name}"] for name in self.parts])
        self.slopes, self.mean, self.square = (torch.zeros_like(self.weights) for _ in range(3))
        begin = 0 if "actor" in self.parts else len(vectors["actor"])
        self.followed = self.weights[begin : begin + len(self.targets)]
        self.split = len(vectors["actor"])  # where the actor ends and the critics begin
        count, sizes = len(self.sizes["actor"]), [*self.sizes["actor"], *self.sizes["value"]]
        made, slopes = networks(self.weights, sizes), networks(self.slopes, sizes)
        self.actors, self.critics = made[:count], made[count:]
        self.actor_slopes, self.critic_slopes = slopes[:count], slopes[count:]
        behind = networks(self.targets, [size for part in self.parts for size in self.sizes[part]])
        self.target_critics = behind[-agent.critics :]
        self.target_actor = behind[0]

    def _made(self, size: tuple[int, ...], rows: int | None = None) -> list[Tensor]:
        rows = rows or self.rows
        return [torch.empty(rows, count, device=self.device) for count in size[1:]]

    @abstractmethod
    def __call__(self) -> None:
        """Take the step."""

    def _draw(self) -> list[Tensor]:
        size = len(self.columns[0])
        torch.randint(size, (self.rows,), generator=self.generator, out=self.index)
        for column, drawn in zip(self.columns, self.drawn, strict=True):
            torch.index_select(column, 0, self.index, out=drawn)
        return self.drawn

    def _future(self, reached: Tensor, action: Tensor) -> Tensor:
        """Return the least value of actions by the target critics."""
        torch.cat([reached, action], 1, out=self.input)
        values = [
            forward(critic, self.input, into)
            for critic, into in zip(self.target_critics, self.judges, strict=True)
        ]
        return values[0] if len(values) == 1 else torch.minimum(*values)

    def _back_values(self, x: Tensor, judges: list[list[Tensor]]) -> None:
        """Write the gradient of the critics, which have answered."""
        self.loss_value = torch.zeros((), device=self.device)
        for critic, into, slopes in zip(self.critics, judges, self.critic_slopes, strict=True):
            error = into[-1].sub_(self.wanted)
            self.loss_value.add_(error.square().mean())
            torch.mul(error, 2.0 / self.rows, out=self.slope)
            self._back(critic, [x, *into], self.slope, slopes)

    def _critic_loss(self, future: Tensor) -> None:
        seen, action, _, reward, terminated = self.drawn
        future.masked_fill_(terminated, 0.0).mul_(self.settings.gamma)
        torch.add(future, reward, out=self.wanted)
        torch.cat([seen, action], 1, out=self.input)
        for critic, into in zip(self.critics, self.judges, strict=True):
            forward(critic, self.input, into)
        self._back_values(self.input, self.judges)

    def _actor_loss(self) -> None:
        """Write the gradient of a deterministic actor by the first critic."""
        seen, judges = self.drawn[0], self.judges[0]
        raw = forward(self.actors[0], seen, self.acts)
        torch.tanh(raw, out=self.action)
        torch.cat([seen, self.action], 1, out=self.input)
        self.loss_actor = -forward(self.critics[0], self.input, judges).mean()
        slope = self._by_action(self.critics[0], [self.input, *judges], self.slope.fill_(-1.0))
        slope.mul_(self.action.square_().neg_().add_(1.0))
        slope.add_(raw, alpha=2.0 * self.settings.saturation).div_(self.rows)
        self._back(self.actors[0], [seen, *self.acts], slope, self.actor_slopes[0])

    def _by_action(self, critic: Network, inputs: list[Tensor], slope: Tensor) -> Tensor:
        below = self._back(critic, inputs, slope, None)
        return torch.mm(below, critic[0][0][:, self.drawn[0].shape[1] :])

    def _back(
        self, network: Network, inputs: list[Tensor], slope: Tensor, into: Network | None
    ) -> Tensor:
        spare = self.spare[-len(network) :]
        for place in range(len(network) - 1, -1, -1):
            if into is not None:
                torch.mm(slope.t(), inputs[place], out=into[place][0])
                torch.sum(slope, 0, out=into[place][1])
            if place:
                slope = torch.mm(slope, network[place][0], out=spare[place - 1])
                torch.ops.aten.threshold_backward.grad_input(
                    slope, inputs[place], 0, grad_input=slope
                )
        return slope

    def _adam(self, begin: int = 0, end: int | None = None) -> None:
        """Take a step of Adam on a range of the weights."""
        step = self.steps.setdefault(begin, torch.zeros((), device=self.device)).add_(1)
        vectors = (self.weights, self.slopes, self.mean, self.square)
        weights, slopes, mean, square = ([vector[begin:end]] for vector in vectors)
        how: dict[str, Any] = {"beta1": 0.9, "beta2": 0.999, "weight_decay": 0.0, "eps": 1e-8}
        how |= {"lr": self.settings.actor_lr, "amsgrad": False, "maximize": False}
        torch._fused_adam_(weights, slopes, mean, square, [], [step], **how)

    def _follow(self) -> None:
        self.targets.lerp_(self.followed, self.settings.tau)


class PlainDDPG(PlainUpdate):
    """Actor and critic step together."""

    @torch.no_grad()
    def __call__(self) -> None:
        reached = self._draw()[2]
        action = forward(self.target_actor, reached, self.acts).tanh_()
        self._critic_loss(self._future(reached, action))
        self._actor_loss()
        self._adam()
        self._follow()


class PlainTD3(PlainUpdate):
    """Two critics, noise on the target's actions, an actor that steps less often."""

    count = 0

    @torch.no_grad()
    def __call__(self) -> None:
        own, reached = self.settings, self._draw()[2]
        action = forward(self.target_actor, reached, self.acts).tanh_()
        noise = self.action.normal_(generator=self.draws).mul_(own.policy_noise)
        action.add_(noise.clamp_(-own.noise_clip, own.noise_clip)).clamp_(-1.0, 1.0)
        self._critic_loss(self._future(reached, action))
        self._adam(self.split)
        self.count += 1
        if self.count % own.policy_delay == 0:
            self._actor_loss()
            self._adam(0, self.split)
            self._follow()
        elif self.count == 1:
            self.loss_actor = torch.zeros(())


class PlainSAC(PlainUpdate):
    """A distribution of actions, two critics and a temperature, which step together."""

    parts = ("value",)

    def _arrange(self, agent: OffPolicy) -> None:
        seen, acts = self.columns[0].shape[1], self.columns[1].shape[1]
        self.sizes["actor"].append((seen, *agent.hidden[-1:], acts))
        super()._arrange(agent)
        # States that were reached and, below them, those seen; actions of the data and own ones.
        self.states = self.drawn[2].repeat(2, 1)
        self.drawn[2], self.drawn[0] = self.states.split(self.rows)
        self.heads = [self._made(size, 2 * self.rows) for size in self.sizes["actor"]]
        critic = self.sizes["value"][0]
        self.both = torch.empty(2 * self.rows, critic[0], device=self.device)
        self.answers = [self._made(critic, 2 * self.rows) for _ in self.critics]
        self.noise = torch.empty(2 * self.rows, acts, device=self.device)

    @torch.no_grad()
    def __call__(self) -> None:
        rows = self.rows
        seen, played, reached, *_ = self._draw()
        alpha = self.weights[-1].exp()
        mean = forward(self.actors[0], self.states, self.heads[0])
        bend = forward(self.actors[1], self.states, self.heads[1]).tanh_()
        log_std = bend.mul(3.0).sub_(2.0)
        for half in self.noise.split(rows):
            half.normal_(generator=self.draws)
        push = log_std.exp().mul_(self.noise)
        before = push + mean
        log_prob = softplus(before.mul(-2.0)).add_(before).mul_(2.0).sub_(log_std)
        log_prob.addcmul_(self.noise, self.noise, value=-0.5)
        log_prob.sub_(math.log(4.0) + 0.5 * math.log(2.0 * math.pi))
        action = before.tanh_()
        future = self._future(reached, action[:rows])
        data, own = self.both.split(rows)
        torch.cat([seen, played], 1, out=data)
        torch.cat([seen, action[rows:]], 1, out=own)
        for critic, into in zip(self.critics, self.answers, strict=True):
            forward(critic, self.both, into)
        self.wanted.copy_(future.sub_(log_prob[:rows] * alpha))
        self.wanted.masked_fill_(self.drawn[4], 0.0).mul_(self.settings.gamma).add_(self.drawn[3])
        self._policy_loss(action[rows:], log_prob[rows:], push[rows:], bend[rows:], alpha)
        self._back_values(data, [[x[:rows] for x in into] for into in self.answers])
        self._adam()
        self._follow()

    def _policy_loss(
        self, action: Tensor, log_prob: Tensor, push: Tensor, bend: Tensor, alpha: Tensor
    ) -> None:
        """Write the gradient of policy and temperature; the critics have answered."""
        rows, seen = self.rows, self.drawn[0]
        answers = [[x[rows:] for x in into] for into in self.answers]
        first, second = (into[-1] for into in answers)
        self.loss_actor = (log_prob * alpha - torch.minimum(first, second)).mean()
        least = (first <= second).to(first.dtype)
        inputs = self.both[rows:]
        slope = self._by_action(self.critics[0], [inputs, *answers[0]], least)
        slope += self._by_action(self.critics[1], [inputs, *answers[1]], 1.0 - least)
        slope.mul_(action.square().sub_(1.0)).addcmul_(action, alpha, value=2.0)
        spread = slope.mul(push).sub_(alpha).mul_(bend.square().neg_().add_(1.0))
        heads = [[x[rows:] for x in head] for head in self.heads]
        slope.add_(heads[0][-1], alpha=2.0 * self.settings.saturation).div_(rows)
        self._back(self.actors[0], [seen, *heads[0]], slope, self.actor_slopes[0])
        self._back(self.actors[1], [seen, *heads[1]], spread.mul_(3.0 / rows), self.actor_slopes[1])
        self.slopes[-1] = 1.0 - log_prob.mean()


def networks(vector: Tensor, sizes: list[tuple[int, ...]]) -> list[Network]:
    """Return the weights and biases of networks that lie in a vector, one after the other."""
    made, place = [], 0
    for size in sizes:
        network = []
        for inputs, outputs in pairwise(size):
            middle, end = place + inputs * outputs, place + (inputs + 1) * outputs
            network.append((vector[place:middle].view(outputs, inputs), vector[middle:end]))
            place = end
        made.append(network)
    return made


def forward(network: Network, x: Tensor, into: list[Tensor]) -> Tensor:
    """Apply a ReLU network, writing what each layer returns to ``into``."""
    for (weight, bias), output in zip(network, into, strict=True):
        torch.addmm(bias, x, weight.t(), out=output)
        x = output if output is into[-1] else output.relu_()
    return x


def check(agent: OffPolicy, plain: PlainUpdate, steps: int = 5) -> None:
    """Hold a plain update against an agent that computes the gradient by TorchRL's loss."""
    from tensordict import TensorDict

    for step in range(steps):
        plain.draws.manual_seed(derived_seed(agent.seed, step, "update"))
        plain()
        seen, action, reached, reward, terminated = plain.drawn
        after = {"observation": reached, "reward": reward, "terminated": terminated}
        after["done"] = terminated
        moments = {"observation": seen, "action": action, "next": after}
        found = agent.update(TensorDict(moments, [plain.rows]))
        for name, own in (("loss_actor", plain.loss_actor), ("loss_value", plain.loss_value)):
            size = found[name].abs().clamp(min=1.0)
            agree(f"update {step}: {name} of the plain update", own / size, found[name] / size)
