"""Environments: a clock and the pieces that a configuration names."""

from lcc_rl.envs.clock import Clock
from lcc_rl.envs.collector import StringCollector
from lcc_rl.envs.factory import build_env, make_env
from lcc_rl.envs.inputs import Inputs, load_inputs
from lcc_rl.envs.rollout import DifferentiableRollout
from lcc_rl.envs.single import MultiAgent, SingleAgent

__all__ = [
    "Clock",
    "DifferentiableRollout",
    "Inputs",
    "MultiAgent",
    "SingleAgent",
    "StringCollector",
    "build_env",
    "load_inputs",
    "make_env",
]
