"""Agents: one learning algorithm a file, trained by one of two loops with one record."""

from lcc_rl.agents.analytic import Analytic
from lcc_rl.agents.ddpg import DDPG
from lcc_rl.agents.sac import SAC
from lcc_rl.agents.td3 import TD3

__all__ = ["DDPG", "SAC", "TD3", "Analytic"]
