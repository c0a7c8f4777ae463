"""Agent room: one learning algorithm a file, trained by one of two loops with one record."""

from lcc_rl.agents.analytic import Analytic
from lcc_rl.agents.ddpg import DDPG

__all__ = ["DDPG", "Analytic"]
