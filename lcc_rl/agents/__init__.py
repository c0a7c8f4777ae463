"""Agents: learning algorithms and their training loops, one file each."""

from lcc_rl.agents.actor import GaussianExploration, make_actor, seeded_mlp, shared_policy
from lcc_rl.agents.agent import Agent, Scene, anneal, derived_seed
from lcc_rl.agents.analytic import Analytic
from lcc_rl.agents.collecting import CollectingLoop, transitions
from lcc_rl.agents.ddpg import DDPG
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.agents.ppo import PPO
from lcc_rl.agents.sac import SAC
from lcc_rl.agents.td3 import TD3

__all__ = [
    "DDPG",
    "PPO",
    "SAC",
    "TD3",
    "Agent",
    "Analytic",
    "CollectingLoop",
    "GaussianExploration",
    "Scene",
    "TrainingLoop",
    "anneal",
    "derived_seed",
    "make_actor",
    "seeded_mlp",
    "shared_policy",
    "transitions",
]
