"""Benchmarks, the study as a vectorised environment of stable-baselines3 over the plain loop."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3.common.vec_env import VecEnv
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.plain import PlainLoop


class PlainVector(VecEnv):  # type: ignore[misc,unused-ignore]
    """Episodes side by side as one batch of tensors, those that end replaced at once.

    Args:
        env: the ALCC environment whose settings, data and batch it shares.
        compiled: compile the plain loop.
    """

    def __init__(self, env: TransformedEnv, compiled: bool) -> None:
        self.env, self.plain = env, PlainLoop(env)
        seen = gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)
        super().__init__(self.plain.rows, seen, gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32))
        self.play = self.plain.player(compiled)

    def reset(self) -> Any:
        """Begin new episodes everywhere; return what is seen."""
        self.now = self.plain.start(self.env.reset())
        return self.plain.observe(self.now).numpy()

    def step_async(self, actions: Any) -> None:
        """Take the actions of the next step."""
        self.actions: Tensor = torch.from_numpy(actions)

    @torch.no_grad()
    def step_wait(self) -> Any:
        """Step; return what is seen, rewards, ends and what stable-baselines3 asks of the ends."""
        self.now, written, seen = self.play(self.now, self.actions, self.plain.seeds())
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for row in written["done"].flatten().nonzero().flatten().tolist():
            infos[row] = {
                "terminal_observation": written["observation"][row].numpy(),
                "TimeLimit.truncated": not written["terminated"][row],
            }
        return (
            seen.numpy(),
            written["reward"].flatten().numpy(),
            written["done"].flatten().numpy(),
            infos,
        )

    def close(self) -> None:
        """Nothing is open."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """No environment has attributes of its own."""
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """No environment has attributes of its own."""

    def env_method(self, method_name: str, *_: Any, **__: Any) -> list[Any]:
        """No environment has methods of its own."""
        return [None] * self.num_envs

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """No environment is wrapped."""
        return [False] * self.num_envs
