"""Environment room: a thin clock plus the pieces that a configuration names."""

from lcc_rl.envs.clock import Clock
from lcc_rl.envs.factory import build_agent, build_env, load_inputs, make_env

__all__ = ["Clock", "build_agent", "build_env", "load_inputs", "make_env"]
