"""PPO of TorchRL with a recurrent policy; minibatches are whole episodes."""

import torch
from my_ppo import SIZE, STARTS, loss_of, networks, train
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import (
    MLP,
    GRUModule,
    NormalParamExtractor,
    ProbabilisticActor,
    TanhNormal,
    set_recurrent_mode,
)

import lcc_rl

torch.set_num_threads(1)
env = lcc_rl.make_env("alcc", batch_size=64, overrides=STARTS, seed=0)
_, critic = networks(env)
keys = {"in_keys": ["observation", "memory"], "out_keys": ["seen", ("next", "memory")]}
memory = GRUModule(input_size=env.observation_spec["observation"].shape[-1], hidden_size=32, **keys)
head = torch.nn.Sequential(MLP(32, 2, num_cells=[64]), NormalParamExtractor())
policy = ProbabilisticActor(
    TensorDictSequential(memory, TensorDictModule(head, ["seen"], ["loc", "scale"])),
    spec=env.action_spec_unbatched,
    in_keys=["loc", "scale"],
    distribution_class=TanhNormal,
    return_log_prob=True,
)


def batches():
    for data in Collector(env, policy, **SIZE):
        with set_recurrent_mode(True):  # learn from sequences
            yield data


train(batches(), loss_of(policy, critic), rows_of=lambda data: data)
found = lcc_rl.compare({"PPO, recurrent": policy}, overrides=["evaluation.drivers=24"])
print(found)
