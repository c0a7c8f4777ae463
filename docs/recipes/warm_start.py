"""TD3 whose policy begins with the weights of another one."""

from lcc_rl.agents import TD3
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import Share


class Warm(TD3):
    weights: str = "pretrained/i24-follow5"
    waits: Share = 0.25  # share of the training in which only the Q networks learn

    def setup(self, scene):
        super().setup(scene)
        self.actor.load_state_dict(load_policy(self.weights)[0])
        target, actor = self.targets["actor"]
        target.copy_(actor)

    def anneal(self, share):
        rate = super().anneal(share)
        if share < self.waits:
            for group in self.optimizers["actor"].param_groups:
                group["lr"] = 0.0
        return rate
