"""Gymnasium environments of strings with one automated vehicle.

Importing this module registers them: ``gymnasium.make("lcc_rl/alcc-v0")``,
``gymnasium.make_vec("lcc_rl/alcc-v0", 64)``. The name ``"lcc_rl.interfaces.gym:lcc_rl/alcc-v0"``
imports it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from lcc_rl.envs.arrays import LARGEST_SCALED, ArrayEpisodes
from lcc_rl.envs.clock import checked_seed
from lcc_rl.envs.factory import make_env
from lcc_rl.envs.rowwise import Array
from lcc_rl.envs.step import observation_settings
from lcc_rl.errors import ConfigError, require, require_known

GYM_VARIANTS = ("alcc", "reference", "own_energy")
TERMS_INFO, MASK_OPTION = "reward_terms", "reset_mask"
MODES = ["rgb_array"]
FIRST_EPISODE = np.zeros(1, np.int64)  # the place of the only episode


def register() -> None:
    """Register ``lcc_rl/alcc-v0``, ``lcc_rl/reference-v0`` and ``lcc_rl/own_energy-v0``."""
    for variant in GYM_VARIANTS:
        if (name := f"lcc_rl/{variant}-v0") not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point=f"{__name__}:CarFollowing",
                vector_entry_point=f"{__name__}:CarFollowingVector",
                kwargs={"variant": variant},
            )


def _episodes(
    variant: str, count: int, overrides: Sequence[str], held_out: bool, render_mode: Any
) -> ArrayEpisodes:
    """Build parallel episodes; arguments as for the environments."""
    require(
        render_mode in (None, *MODES), f"render_mode must be None or {MODES}, got {render_mode!r}"
    )
    env = make_env(variant, count, overrides, held_out=held_out, single=True)
    episodes = ArrayEpisodes(env)
    if render_mode is not None:
        from lcc_rl.interfaces.film import Film  # loads matplotlib

        episodes.films = [Film(episodes, index) for index in range(count)]
    return episodes


def _seeds(seed: Any, count: int) -> list[int | None]:
    """Return the seed of each place from a number, None or a list of these."""
    seeds = np.asarray(seed, np.object_)
    if seeds.ndim == 0:
        first = checked_seed(seeds.item())
        return [None if first is None else checked_seed(first + i) for i in range(count)]
    if seeds.shape != (count,):
        raise ConfigError(
            f"seed must be a number or a list of {count}, got one of {list(seeds.shape)}"
        )
    return [checked_seed(x) for x in seeds]


def _options(options: Any) -> dict[str, Any]:
    if not isinstance(options, Mapping | None):
        raise ConfigError(f"options must be a dictionary of reset options, got {options!r}")
    return dict(options or {})


def _spaces(episodes: ArrayEpisodes) -> tuple[Box, Box]:
    shape = episodes.observation.shape[1:]
    return Box(-LARGEST_SCALED, LARGEST_SCALED, shape, np.float32), Box(-1.0, 1.0, (1,), np.float32)


class CarFollowing(gymnasium.Env[Array, Array]):
    """One episode of a string with one automated vehicle.

    The observation is the scaled entries of ``observation.scales``, float32, the action an
    acceleration as a share of 3 m/s². An episode is ``terminated`` by a collision and ``truncated``
    at the horizon. ``info`` holds the reward terms by name.

    Args:
        variant: ``"alcc"``, ``"reference"`` or ``"own_energy"``.
        overrides: further settings, as on the command line: ``["scenario.horizon=100"]``.
        held_out: play the leaders of the evaluation, not of the training.
        render_mode: ``"rgb_array"``: :meth:`render` draws the road; None: no rendering.

    Raises:
        ConfigError: if an override or the ``render_mode`` is unknown, or there is not exactly one
            automated vehicle.
    """

    metadata: dict[str, Any] = {"render_modes": MODES, "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        variant: str = "alcc",
        overrides: Sequence[str] = (),
        held_out: bool = False,
        render_mode: str | None = None,
    ) -> None:
        self.episodes = _episodes(variant, 1, overrides, held_out, render_mode)
        self.observes = observation_settings(self.episodes.env)  # read from a model's environment
        self.render_mode = render_mode
        self.observation_space, self.action_space = _spaces(self.episodes)
        self.running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; equal seeds give equal series of episodes.

        Args:
            seed: seed of the series; None: the next episode of the series.
            options: see :meth:`lcc_rl.envs.arrays.ArrayEpisodes.reset`.

        Raises:
            ConfigError: naming the seed or the option and its range; the state is then unchanged.
        """
        seed = checked_seed(seed)
        observation = self.episodes.reset(FIRST_EPISODE, [seed], _options(options))[0]
        super().reset(seed=seed)
        self.running = True
        return observation, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Play one step."""
        if not self.running:
            raise ResetNeeded("call reset before the first step, and after the last of an episode")
        results = self.episodes.step([action], alone=True)
        reward, terminated, truncated, *terms = results[0].tolist()
        self.running = not (terminated or truncated)
        info = {TERMS_INFO: dict(zip(self.episodes.terms, terms, strict=True))}
        return self.episodes.observation[0], reward, bool(terminated), bool(truncated), info

    def render(self) -> Any:
        """Return a picture of the road, ``[height, width, 3]``, uint8."""
        films = self.episodes.films
        return films[0].picture() if films else None


class CarFollowingVector(VectorEnv[Array, Array, Array]):
    """Parallel episodes in one batch.

    Every place plays the episodes of a :class:`CarFollowing` with its seed. In the mode
    ``"SameStep"``, ``info["final_obs"]`` holds the last observations of ended episodes, where
    ``info["_final_obs"]`` is true, and ``info["final_info"]`` the terms of their last rewards.

    Args:
        num_envs: number of parallel episodes.
        variant, overrides, held_out, render_mode: see :class:`CarFollowing`.
        max_episode_steps: None; ``scenario.horizon`` is the number of steps.
        autoreset_mode: when a new episode begins after one has ended, as in Gymnasium:
            ``"SameStep"``; ``"NextStep"``: in the next step, which ignores action and reward;
            ``"Disabled"``: by ``reset`` with the option ``"reset_mask"``.

    Raises:
        ConfigError: as for :class:`CarFollowing`, or if ``max_episode_steps`` is given or the mode
            is unknown.
    """

    metadata: dict[str, Any] = CarFollowing.metadata  # and the mode of each vector

    def __init__(
        self,
        num_envs: int = 1,
        variant: str = "alcc",
        overrides: Sequence[str] = (),
        held_out: bool = False,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        require(
            max_episode_steps is None,
            f"max_episode_steps={max_episode_steps} is no setting of the vector: "
            f'use overrides=["scenario.horizon={max_episode_steps}"]',
        )
        choice = getattr(autoreset_mode, "value", autoreset_mode)
        require_known("autoreset_mode", [choice], [mode.value for mode in AutoresetMode])
        self.mode = AutoresetMode(choice)
        self.metadata = {**self.metadata, "autoreset_mode": self.mode}
        self.episodes = _episodes(variant, num_envs, overrides, held_out, render_mode)
        self.render_mode = render_mode
        self.single_observation_space, self.single_action_space = _spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.num_envs = num_envs
        self.running = np.zeros(num_envs, np.bool_)
        self.ended = self.running.copy()  # places with a new episode in the next step

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: seed of the first place, increasing by one per place; or a seed per place, None to
                continue its series.
            options: see :meth:`lcc_rl.envs.arrays.ArrayEpisodes.reset`; the option ``"reset_mask"``
                selects the places in which episodes begin, by default all.

        Raises:
            ConfigError: if seeds or mask do not fit the number of places, and as for
                :meth:`CarFollowing.reset`; the state is then unchanged.
        """
        options, count = _options(options), self.num_envs
        mask = np.asarray(options.pop(MASK_OPTION, [True] * count), np.object_)
        truths = all(isinstance(x, bool | np.bool_) for x in mask.flat)
        if mask.shape != (count,) or not truths or not mask.any():
            raise ConfigError(
                f"{MASK_OPTION} must be {count} truth values, one true, got {mask.tolist()}"
            )
        seeds, places = _seeds(seed, count), np.flatnonzero(mask)
        observation = self.episodes.reset(places, seeds, options)
        super().reset(seed=seeds[0])
        self.running[places], self.ended[places] = True, False
        return observation, {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Play one step of every episode."""
        if not (self.running | self.ended).all():
            ended = np.flatnonzero(~self.running).tolist()
            raise ResetNeeded(f"call reset before step, by reset_mask in the places {ended}")
        results, finished = self.episodes.step(actions), self.ended
        if finished.any():
            self.episodes.reset(np.flatnonzero(finished))
            results[finished] = 0.0
        observation = self.episodes.observation
        ends = results[:, 1:3] > 0.0
        done: Any = ends.any(1)
        info: dict[str, Any] = {
            TERMS_INFO: dict(zip(self.episodes.terms, results[:, 3:].T, strict=True))
        }
        same_step = self.mode == AutoresetMode.SAME_STEP
        if same_step and done.any():
            final = {TERMS_INFO: info[TERMS_INFO], f"_{TERMS_INFO}": done}
            info |= {"final_obs": observation, "_final_obs": done}
            info |= {"final_info": final, "_final_info": done}
            observation = self.episodes.reset(np.flatnonzero(done))
        self.running = ~done | same_step
        self.ended = done & (self.mode == AutoresetMode.NEXT_STEP)
        return observation, results[:, 0], ends[:, 0], ends[:, 1], info

    def render(self) -> tuple[Any, ...] | None:
        """Return a picture of the road of every place, ``[height, width, 3]``, uint8."""
        return tuple(film.picture() for film in self.episodes.films) or None


register()
