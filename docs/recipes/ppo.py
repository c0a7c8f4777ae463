"""PPO of TorchRL in one process."""

import torch
from my_ppo import SIZE, STARTS, loss_of, networks, train
from torchrl.collectors import Collector

import lcc_rl

torch.set_num_threads(1)
env = lcc_rl.make_env("alcc", batch_size=64, overrides=STARTS, seed=0)
policy, critic = networks(env)
rewards = train(Collector(env, policy, **SIZE), loss_of(policy, critic))
print(lcc_rl.compare({"PPO": policy}, overrides=["evaluation.drivers=24"]))
