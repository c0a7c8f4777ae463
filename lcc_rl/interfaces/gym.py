"""Gymnasium environments of strings with one automated vehicle.

``gymnasium.make("lcc_rl/alcc-v0")``, ``gymnasium.make_vec("lcc_rl/alcc-v0", 64)``: importing this
module registers them, also by the name ``"lcc_rl.interfaces.gym:lcc_rl/alcc-v0"``.
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

from lcc_rl.envs.arrays import ArrayEpisodes
from lcc_rl.envs.clock import checked_seed
from lcc_rl.envs.factory import make_env
from lcc_rl.envs.rowwise import Array
from lcc_rl.errors import ConfigError, require, unknown_name

GYM_VARIANTS = ("alcc", "reference", "own_energy")
TERMS_INFO, MASK_OPTION = "reward_terms", "reset_mask"
LARGEST_SCALED = 1e6  # beyond every speed [m/s], gap [m] and time [s] of a string, scaled
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
    """Build episodes side by side; arguments as of the environments.

    Raises:
        ConfigError: naming the setting at fault.
    """
    require(
        render_mode in (None, *MODES), f"render_mode must be None or {MODES}, got {render_mode!r}"
    )
    env = make_env(variant, count, overrides, held_out=held_out, single=True)
    episodes = ArrayEpisodes(env)
    if render_mode is not None:
        from lcc_rl.interfaces.film import Film  # loads matplotlib

        episodes.films = [Film(episodes, place) for place in range(count)]
    return episodes


def _seeds(seed: Any, count: int) -> list[int | None]:
    """Return the seed of each place, from a number, None or a list of these.

    Raises:
        ConfigError: naming a seed and its range, or the number of places.
    """
    given = np.asarray(seed, np.object_)
    if given.ndim == 0:
        first = checked_seed(given.item())
        return [None if first is None else checked_seed(first + i) for i in range(count)]
    if given.shape != (count,):
        raise ConfigError(
            f"seed must be a number or a list of {count}, got one of {list(given.shape)}"
        )
    return [checked_seed(each) for each in given]


def _options(options: Any) -> dict[str, Any]:
    """Return reset options as a dictionary of the caller's own.

    Raises:
        ConfigError: if they are none.
    """
    if not isinstance(options, Mapping | None):
        raise ConfigError(f"options must be a dictionary of reset options, got {options!r}")
    return dict(options or {})


def _spaces(episodes: ArrayEpisodes) -> tuple[Box, Box]:
    """Return the spaces of observation and action (a share of 3 m/s²)."""
    shape = episodes.observation.shape[1:]
    return Box(-LARGEST_SCALED, LARGEST_SCALED, shape, np.float32), Box(-1.0, 1.0, (1,), np.float32)


class CarFollowing(gymnasium.Env[Array, Array]):
    """One episode of a string with one automated vehicle.

    Observation: the entries of ``observation.scales``, scaled, float32. Action: acceleration as a
    share of 3 m/s². ``terminated`` after a collision, ``truncated`` at the horizon; ``info`` has
    the terms of the reward by name.

    Args:
        variant: ``"alcc"``, ``"reference"`` or ``"own_energy"``.
        overrides: further settings, as on the command line: ``["scenario.horizon=100"]``.
        held_out: play the evaluation's leaders instead of the training's.
        render_mode: ``"rgb_array"``: :meth:`render` draws the road; None: nothing is drawn.

    Raises:
        ConfigError: if an override is unknown, there is not just one automated vehicle, or the
            ``render_mode`` is another.
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
        self.render_mode = render_mode
        self.observation_space, self.action_space = _spaces(self.episodes)
        self.running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; with a seed, the same series of episodes as ever with it.

        Args:
            seed: of the series; None: the next episode of the series.
            options: see :meth:`lcc_rl.envs.arrays.ArrayEpisodes.reset`.

        Raises:
            ConfigError: naming the seed or the option and its range; nothing changes then.
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
        results = self.episodes.step([action])
        reward, terminated, truncated, *terms = results[0].tolist()
        self.running = not (terminated or truncated)
        info = {TERMS_INFO: dict(zip(self.episodes.terms, terms, strict=True))}
        return self.episodes.observation[0], reward, bool(terminated), bool(truncated), info

    def render(self) -> Any:
        """Return the road at the present moment, ``[height, width, 3]``, uint8."""
        films = self.episodes.films
        return films[0].picture() if films else None


class CarFollowingVector(VectorEnv[Array, Array, Array]):
    """Episodes side by side in one batch.

    Every place plays what a :class:`CarFollowing` of its seed plays. Where an episode ends in
    the mode ``"SameStep"``, ``info["final_obs"]`` holds the last observations where
    ``info["_final_obs"]`` is true, and ``info["final_info"]`` the terms of the last rewards.

    Args:
        num_envs: episodes side by side.
        variant, overrides, held_out, render_mode: see :class:`CarFollowing`.
        max_episode_steps: None; ``scenario.horizon`` is the number of steps.
        autoreset_mode: when an episode that has ended begins anew, as Gymnasium names it:
            ``"SameStep"``; ``"NextStep"``: in the next step, whose action and reward do not count;
            ``"Disabled"``: by ``reset`` with the option ``"reset_mask"``.

    Raises:
        ConfigError: as of :class:`CarFollowing`, if ``max_episode_steps`` is given, or the mode is
            unknown.
    """

    metadata: dict[str, Any] = CarFollowing.metadata  # and the mode, of each vector

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
        given = getattr(autoreset_mode, "value", autoreset_mode)
        if given not in (names := [mode.value for mode in AutoresetMode]):
            raise unknown_name("autoreset_mode", str(given), names)
        self.mode = AutoresetMode(given)
        self.metadata = {**self.metadata, "autoreset_mode": self.mode}
        self.episodes = _episodes(variant, num_envs, overrides, held_out, render_mode)
        self.render_mode = render_mode
        self.single_observation_space, self.single_action_space = _spaces(self.episodes)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.num_envs = num_envs
        self.running = np.zeros(num_envs, np.bool_)
        self.ended = self.running.copy()  # those that begin anew in the next step

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin episodes.

        Args:
            seed: of the first place, one more for each further one; or the seed of each place,
                None where its series is to go on.
            options: see :meth:`lcc_rl.envs.arrays.ArrayEpisodes.reset`; besides, ``"reset_mask"``
                says where episodes begin, by default everywhere.

        Raises:
            ConfigError: if seeds or mask do not fit the number of places, and as of
                :meth:`CarFollowing.reset`; nothing changes then.
        """
        options, count = _options(options), self.num_envs
        mask = np.asarray(options.pop(MASK_OPTION, [True] * count), np.object_)
        truths = all(isinstance(each, bool | np.bool_) for each in mask.flat)
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
        results, begun = self.episodes.step(actions), self.ended
        if begun.any():
            self.episodes.reset(np.flatnonzero(begun))
            results[begun] = 0.0
        observation = self.episodes.observation
        ends = results[:, 1:3] > 0.0
        done: Any = ends.any(1)
        info: dict[str, Any] = {
            TERMS_INFO: dict(zip(self.episodes.terms, results[:, 3:].T, strict=True))
        }
        same = self.mode == AutoresetMode.SAME_STEP
        if same and done.any():
            final = {TERMS_INFO: info[TERMS_INFO], f"_{TERMS_INFO}": done}
            info |= {"final_obs": observation, "_final_obs": done}
            info |= {"final_info": final, "_final_info": done}
            observation = self.episodes.reset(np.flatnonzero(done))
        self.running = ~done | same
        self.ended = done & (self.mode == AutoresetMode.NEXT_STEP)
        return observation, results[:, 0], ends[:, 0], ends[:, 1], info

    def render(self) -> tuple[Any, ...] | None:
        """Return the road of every place, ``[height, width, 3]``, uint8."""
        return tuple(film.picture() for film in self.episodes.films) or None


register()
