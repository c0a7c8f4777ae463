"""Agent room: one learning algorithm a file, all trained by the same loop."""

from lcc_rl.agents.ddpg import DDPG

__all__ = ["DDPG"]
