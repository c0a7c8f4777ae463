"""The ALCC study as a VecEnv of stable-baselines3 over the plain loop, and its DDPG."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.harness import Run
from benchmarks.plain import PlainLoop

SEEN = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)
ACTS = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)


class PlainVector(VecEnv):  # type: ignore[misc,unused-ignore]
    """Episodes side by side as one batch of tensors, those that end replaced at once.

    Args:
        env: the ALCC environment whose settings, data and batch it shares.
        compiled: compile the plain loop.
    """

    def __init__(self, env: TransformedEnv, compiled: bool) -> None:
        self.env, self.plain = env, PlainLoop(env)
        super().__init__(self.plain.rows, SEEN, ACTS)
        eager, together = self.plain.play_eagerly, self.plain.play
        self.play = torch.compile(together, dynamic=False) if compiled else eager

    def reset(self) -> Any:
        """Begin new episodes everywhere; return what is seen."""
        self.now = self.plain.start(self.env.reset())
        return self.plain.observe(self.now).numpy()

    def step_async(self, actions: Any) -> None:
        """Take the actions of the next step."""
        self.actions: Tensor = torch.from_numpy(actions)

    @torch.no_grad()
    def step_wait(self) -> Any:
        """Step; return observations, rewards, dones and infos."""
        self.now, written, seen = self.play(self.now, self.actions, self.plain.seeds())
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in written["done"].flatten().nonzero().flatten().tolist():
            infos[row] = {
                "terminal_observation": written["observation"][row].numpy(),
                "TimeLimit.truncated": not written["terminated"][row],
            }
        ends = (written[name].flatten().numpy() for name in ("reward", "done"))
        return seen.numpy(), *ends, infos

    def _none_each(self, *_: Any, **__: Any) -> list[Any]:
        """Return None for each environment; there are no attributes to report."""
        return [None] * self.num_envs

    close = get_attr = set_attr = env_method = env_is_wrapped = _none_each


def their_agent(vector: VecEnv, kind: str, **how: Any) -> Any:
    """Return stable-baselines3's agent of that name with the paper's layers."""
    layers = {"net_arch": [200, 100, 50]}
    settings = {"policy_kwargs": layers, "gamma": 0.9, "device": "cpu", **how}
    return getattr(stable_baselines3, kind)("MlpPolicy", vector, **settings)


def predicting(vector: VecEnv, steps: int) -> Run:
    """Return so many steps of ``predict`` and the environment; nothing is kept."""
    model, state = their_agent(vector, "DDPG"), {"seen": vector.reset()}

    def run() -> None:
        for _ in range(steps):
            action, _ = model.predict(state["seen"], deterministic=True)
            state["seen"], *_ = vector.step(action)

    return run
