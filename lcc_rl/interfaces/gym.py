"""Gymnasium environments of strings with one automated vehicle.

``gymnasium.make("lcc_rl/alcc-v0")``, ``gymnasium.make_vec("lcc_rl/alcc-v0", 64)``: importing this
module registers them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from tensordict import TensorDictBase

from lcc_rl.envs.factory import make_env

VARIANTS = ("alcc", "reference", "own_energy")
TERMS = "reward_terms"
Array = np.ndarray[Any, Any]


def register() -> None:
    """Register ``lcc_rl/alcc-v0``, ``lcc_rl/reference-v0`` and ``lcc_rl/own_energy-v0``."""
    for variant in VARIANTS:
        if (name := f"lcc_rl/{variant}-v0") not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point=f"{__name__}:CarFollowing",
                vector_entry_point=f"{__name__}:CarFollowingVector",
                kwargs={"variant": variant},
            )


def _spaces(size: int) -> tuple[Box, Box]:
    """Return the spaces of observation (unbounded) and action (a share of 3 m/s²)."""
    return Box(-np.inf, np.inf, (size,), np.float32), Box(-1.0, 1.0, (1,), np.float32)


def _terms(td: TensorDictBase) -> dict[str, Array]:
    return {str(name): value.squeeze(-1).numpy() for name, value in td.get(TERMS).items()}


class CarFollowing(gymnasium.Env[Array, Array]):
    """One episode of a string with one automated vehicle.

    Observation: the entries of ``observation.scales``, scaled, float32. Action: acceleration as a
    share of 3 m/s². ``terminated`` after a collision, ``truncated`` at the horizon; ``info`` has
    the terms of the reward by name.

    Args:
        variant: ``"alcc"``, ``"reference"`` or ``"own_energy"``.
        overrides: further settings, as on the command line: ``["scenario.horizon=100"]``.
        held_out: play the evaluation's leaders instead of the training's.
        render_mode: None; there is no rendering.

    Raises:
        ConfigError: if an override is unknown or there is not just one automated vehicle.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(
        self,
        variant: str = "alcc",
        overrides: Sequence[str] = (),
        held_out: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.env = make_env(variant, (), overrides, held_out=held_out, single=True)
        size = self.env.observation_spec["observation"].shape[-1]
        self.observation_space, self.action_space = _spaces(size)
        self.render_mode = render_mode
        self._td: TensorDictBase | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; with a seed, the same series of episodes as ever with it."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self._td = self.env.reset()
        return self._td["observation"].numpy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Play one step."""
        if self._td is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        given = torch.as_tensor(np.asarray(action), dtype=torch.float32)
        after = self.env.step(self._td.set("action", given))["next"]
        self._td = after.exclude("reward", TERMS)
        ends = bool(after["terminated"]), bool(after["truncated"])
        info = {TERMS: {name: float(value) for name, value in _terms(after).items()}}
        return after["observation"].numpy(), float(after["reward"]), *ends, info


class CarFollowingVector(VectorEnv[Array, Array, Array]):
    """Episodes side by side in one batch; those that end begin anew in the same step.

    ``info["final_obs"]`` holds the last observations where ``info["_final_obs"]`` is true.

    Args:
        num_envs: episodes side by side.
        variant, overrides, held_out, render_mode: see :class:`CarFollowing`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        variant: str = "alcc",
        overrides: Sequence[str] = (),
        held_out: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.env = make_env(variant, num_envs, overrides, held_out=held_out, single=True)
        size = self.env.observation_spec["observation"].shape[-1]
        self.single_observation_space, self.single_action_space = _spaces(size)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.num_envs, self.render_mode = num_envs, render_mode
        self._td: TensorDictBase | None = None

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes; one seed for all of them."""
        if isinstance(seed, Sequence):
            seed = seed[0]
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        self._td = self.env.reset()
        return self._td["observation"].numpy().copy(), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Play one step of every episode."""
        if self._td is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        given = torch.as_tensor(np.asarray(actions), dtype=torch.float32)
        data, self._td = self.env.step_and_maybe_reset(self._td.set("action", given))
        after = data["next"]
        done = after["done"].squeeze(-1).numpy()
        info: dict[str, Any] = {TERMS: _terms(after)}
        if done.any():
            info |= {"final_obs": after["observation"].numpy(), "_final_obs": done}
        observation = self._td["observation"].numpy().copy()
        flat = (after[name].squeeze(-1).numpy() for name in ("reward", "terminated", "truncated"))
        return observation, *flat, info


register()
