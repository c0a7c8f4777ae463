"""PPO of TorchRL with two collecting processes."""

from functools import partial

from my_ppo import SIZE, STARTS, loss_of, networks, train
from torchrl.collectors import MultiSyncCollector

import lcc_rl

if __name__ == "__main__":  # each process imports the program again
    make = partial(lcc_rl.make_env, "alcc", 32, STARTS)
    policy, critic = networks(make())
    workers = MultiSyncCollector([make, make], policy, **SIZE)
    workers.set_seed(3)
    train(workers, loss_of(policy, critic))
    workers.shutdown()
    found = lcc_rl.compare({"PPO, two workers": policy}, overrides=["evaluation.drivers=24"])
    print(found)
