"""MAPPO of TorchRL; with ``centralised = False`` it is IPPO."""

from functools import partial

import torch
from my_ppo import SIZE, STARTS, loss_of, train
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.modules import MultiAgentMLP, NormalParamExtractor, ProbabilisticActor, TanhNormal

import lcc_rl

torch.set_num_threads(1)
torch.manual_seed(0)
centralised = True
mixed = ["scenario.string='automated human automated human'"]
env = lcc_rl.make_env("alcc", batch_size=64, overrides=[*mixed, *STARTS], seed=0)
own = {name: ("automated", name) for name in ("action", "reward", "done", "terminated")}
seen, value, loc, scale = (("automated", x) for x in ("observation", "value", "loc", "scale"))
vehicles, width = env.observation_spec[seen].shape[-2:]
network = partial(MultiAgentMLP, width, n_agents=vehicles, share_params=True, num_cells=[64, 64])
actor = torch.nn.Sequential(network(2, centralised=False), NormalParamExtractor())
policy = ProbabilisticActor(
    TensorDictModule(actor, [seen], [loc, scale]),
    spec=env.full_action_spec_unbatched,
    in_keys=[loc, scale],
    out_keys=[own["action"]],
    distribution_class=TanhNormal,
    return_log_prob=True,
    log_prob_key=("automated", "log_prob"),
)
critic = TensorDictModule(network(1, centralised=centralised), [seen], [value])
keys = {**own, "value": value, "sample_log_prob": ("automated", "log_prob")}
loss = loss_of(policy, critic, each=(-2,), **keys)  # advantages of each vehicle

rewards = train(Collector(env, policy, **SIZE), loss, reward=own["reward"])
print(lcc_rl.compare({"MAPPO": policy}, overrides=[*mixed, "evaluation.drivers=24"]))
