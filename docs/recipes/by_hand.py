"""An environment composed of its pieces, from trajectories to a rollout, and CACC as a policy."""

import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import RewardSum, TransformedEnv
from torchrl.envs.utils import check_env_specs

from lcc_rl import pieces
from lcc_rl.agents.controller import ControllerPolicy
from lcc_rl.data.profiles import leader_profiles
from lcc_rl.drivers.population import fixed
from lcc_rl.energy import PaperMotor, as_fleet
from lcc_rl.envs import Clock
from lcc_rl.pieces.world import World
from lcc_rl.synthetic.stream import StreamSource

source = StreamSource(recordings=1, platoons=4)  # or NgsimSource(path="…") of lcc_rl.data.sources
ACTION, REWARD = ("automated", "action"), ("automated", "reward")
profiles = leader_profiles(source.load().episodes, time_step=0.1)
string, drivers = pieces.parse_string("automated human"), fixed(desired_speed=25.0, time_gap=1.2)
energy = as_fleet(PaperMotor())
world = World(string, horizon=300, profiles=profiles, population=drivers, energy=energy)
start = {"automated": pieces.HeadwayStart(headway=20.0), "human": pieces.EquilibriumStart()}
scales = {"self": {"speed": 0.1, "gap": 0.1}, "ahead": {"speed": 0.1}}
env = TransformedEnv(Clock(horizon=300, batch_size=16, actions={ACTION: (1, 1)}))
for piece in (
    pieces.NGSIMLeader(),
    pieces.RolePlaces(),
    pieces.Action(),
    pieces.IDM(),
    pieces.StringMotion(start=start),
    pieces.Communication(headway=20.0),
    pieces.MotorPower(),
    pieces.Collision(),
    pieces.Observation(scales=scales),
    pieces.SafetyReward(),
    pieces.EnergyReward(of="string"),
    pieces.TotalReward(terms=["safety", "energy"]),
):
    env.append_transform(piece.bind(world))
env.append_transform(RewardSum([REWARD], [("automated", "episode_reward")]))
check_env_specs(env)

torch.manual_seed(0)
network = torch.nn.Sequential(torch.nn.Linear(3, 1), torch.nn.Tanh())
policy = TensorDictModule(network, [("automated", "observation")], [ACTION])
data = env.rollout(300, policy, break_when_any_done=False)
print(data["next", "vehicles", "gap"].shape, *data["next", "automated", "reward_terms"].keys())

rule = pieces.CACC().bind(world)
for name, driver in (("network", policy), ("CACC", ControllerPolicy(rule))):
    env.set_seed(0)  # the same leaders
    run = env.rollout(300, driver, break_when_any_done=False)
    count, reward = run["next", "terminated"].sum(), run["next", *REWARD].mean()
    print(f"{name}: {count} collisions, reward {reward:.2f} a step")
advice = rule(data.clone())["next", "automated", "command"]
print(advice.shape)
