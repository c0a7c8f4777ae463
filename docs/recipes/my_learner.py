"""REINFORCE as a learner of one's own: settings, a policy, and the loop that trains it."""

from collections.abc import Sequence

import torch

from lcc_rl.agents import Agent, CollectingLoop, GaussianExploration, make_actor
from lcc_rl.settings import Count, Positive


class ReinforceLoop(CollectingLoop):
    advice = "Lower agent.learning_rate"

    def learn(self, batch, before):
        agent, group = self.agent, batch["automated"]
        reward, done = batch["next", "automated", "reward"], batch["next", "done"]
        value, returns = 0.0, []
        for step in reversed(range(batch.shape[1])):  # [environments, vehicles, 1] a step
            value = reward[:, step] + agent.gamma * value * ~done[:, step, None]
            returns.append(value)
        returns = torch.stack(returns[::-1], 1)
        advantage = (returns - returns.mean(0)) / (returns.std() + 1e-6)
        mean = agent.policy.module(group["observation"])
        log_prob = -0.5 * ((group["action"] - mean) / agent.sigma) ** 2
        loss = -(advantage * log_prob).mean()
        agent.optimizer.zero_grad()
        loss.backward()
        agent.optimizer.step()
        self.updates += 1
        return {"loss_actor": loss.item(), "loss_value": returns.square().mean().item()}


class Reinforce(Agent):
    learning_rate: Positive = 3e-3
    sigma: Positive = 0.3  # standard deviation of the exploration
    gamma: Positive = 0.99
    hidden: Sequence[Count] = (32, 32)

    loop = ReinforceLoop

    def setup(self, scene):
        self.policy = make_actor(scene.observation_size, 1, self.hidden, scene.seed)
        self.noise = GaussianExploration(self.sigma)
        self.optimizer = torch.optim.Adam(self.policy.parameters(), lr=self.learning_rate)
