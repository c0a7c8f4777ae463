"""PPO of TorchRL that observes the last four steps."""

from functools import partial

import torch
from my_ppo import SIZE, STARTS, loss_of, networks, train
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.envs.transforms import CatFrames

import lcc_rl

torch.set_num_threads(1)
frames = partial(CatFrames, N=4, dim=-1, in_keys=["observation"], out_keys=["frames"])
env = lcc_rl.make_env("alcc", batch_size=64, overrides=STARTS, seed=0).append_transform(frames())
policy, critic = networks(env, "frames")
train(Collector(env, policy, **SIZE), loss_of(policy, critic))
whole = TensorDictSequential(frames(), policy)
found = lcc_rl.compare({"PPO, four frames": whole}, overrides=["evaluation.drivers=24"])
print(found)
