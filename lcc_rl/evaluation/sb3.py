"""Models of stable-baselines3 as modules from observations to actions in [−1, 1]."""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from lcc_rl.envs.arrays import LARGEST_SCALED
from lcc_rl.errors import ConfigError, raised_as, require

ENVIRONMENT, RESCALED, NORMALIZED = "CarFollowing", "RescaleAction", "VecNormalize"
# Wrappers of Gymnasium and stable-baselines3, by name, that act on neither observation nor action.
TRANSPARENT = {
    *("OrderEnforcing", "PassiveEnvChecker", "TimeLimit", "Monitor", "RecordEpisodeStatistics"),
    *("RecordVideo", "HumanRendering", "NormalizeReward", "TransformReward", "ClipReward"),
    *("DummyVecEnv", "SubprocVecEnv", "VecMonitor", "VecCheckNan", "VecVideoRecorder"),
}
ELSE = (
    "pass a torch module from this package's observations to actions in [−1, 1], or train with no "
    f"other wrappers than {RESCALED} and {NORMALIZED}"
)


class StableBaselinesPolicy(nn.Module):
    """A model of stable-baselines3 without exploration, in this package's environment.

    It contains the statistics of ``VecNormalize`` and the scale of ``RescaleAction``.

    Args:
        model: the model.
        normalize: a vector with its ``VecNormalize``; None: the model's environment, if it has one.

    Raises:
        ConfigError: if another wrapper, space or policy class would make it act differently here.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, model: Any, normalize: Any = None) -> None:
        super().__init__()
        self.title = type(model).__name__
        env = model.get_env() if normalize is None else normalize
        normalizers, names = ([], set()) if env is None else self._wrappers(env)
        # Only models trained with VecNormalize have it; those with a replay buffer always do.
        raw = getattr(model, "_last_original_obs", None) is not None
        lacking = raw and not normalizers and (env is None or not hasattr(model, "replay_buffer"))
        words = f"{self.title} lacks the {NORMALIZED} of its training, or the vector without one: "
        require(not lacking, f"{words}load it by {self.title}.load(path, env=…)")
        low, high = self._bounds(model, RESCALED in names)
        self.middle, self.half = (high + low) / 2.0, (high - low) / 2.0
        own = next((one for one in normalizers if one.norm_obs), None)
        self.limit = torch.inf if own is None else float(own.clip_obs)
        mean = 0.0 if own is None else own.obs_rms.mean
        scale = 1.0 if own is None else (own.obs_rms.var + own.epsilon) ** 0.5
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32))
        policy, width = model.policy, model.observation_space.shape[-1]
        self.squashed = bool(policy.squash_output)
        kind = f"{self.title}: its {type(policy).__name__} cannot be carried over"
        with raised_as(ConfigError, kind, Exception):  # any error of a class of the user's
            self.network = deepcopy(nn.Sequential(*_layers(policy))).cpu().eval()
            draw = (
                np.random.default_rng(0).normal(size=(64, width)) * np.linspace(0, 3, 64)[:, None]
            )
            seen = draw.astype(np.float32)
            wanted = (model.predict(seen, deterministic=True)[0] - self.middle) / self.half
            with torch.no_grad():
                off = np.abs(self._action(torch.as_tensor(seen)).numpy() - wanted).max()
            require(off < 1e-4, f"its layers act otherwise than predict(), by up to {off:.2g}")

    def _wrappers(self, env: Any) -> tuple[list[Any], set[str]]:
        """Return the ``VecNormalize`` of a vector and the names of its other wrappers."""
        vectors = [env]
        while hasattr(vectors[-1], "venv"):
            vectors.append(vectors[-1].venv)
        names = [type(one).__name__ for one in vectors]
        self._check_known(names[:-1], NORMALIZED)
        self._check_known(names[-1:])
        words = f"{self.title}: the wrappers of its environment cannot be read; is it closed?"
        with raised_as(ConfigError, words, Exception):  # of a process that has ended
            texts = vectors[-1].env_method("__str__")  # <Monitor<CarFollowing<lcc_rl/alcc-v0>>>
        inner = {name for text in texts for name in re.findall(r"<(\w+)(?=[< ])", text)}
        require(ENVIRONMENT in inner, f"{self.title}: {texts[0]} is no environment here; {ELSE}")
        self._check_known(sorted(inner - {ENVIRONMENT}), RESCALED)
        return [one for one in vectors if type(one).__name__ == NORMALIZED], inner

    def _check_known(self, names: list[str], *more: str) -> None:
        strange = [name for name in names if name not in TRANSPARENT.union(more)]
        words = f"{self.title} was trained with {', '.join(strange)}, which cannot be carried over"
        require(not strange and names.count(NORMALIZED) < 2, f"{words}: {ELSE}")

    def _bounds(self, model: Any, rescaled: bool) -> tuple[float, float]:
        """Return the bounds of the model's actions, which stand for −1 and 1.

        Raises:
            ConfigError: if its spaces are not those of an environment of this package.
        """
        spaces = (model.action_space, model.observation_space)
        ends = [[getattr(space, end, None) for end in ("low", "high")] for space in spaces]
        usable = all(x is not None and x.ndim == 1 for pair in ends for x in pair)
        low, high = (float(x[0]) for x in ends[0]) if usable else (np.nan, np.nan)
        usable = usable and np.abs(ends[1]).min() == np.abs(ends[1]).max() == LARGEST_SCALED
        usable = usable and len(ends[0][0]) == 1 and (rescaled or (low, high) == (-1.0, 1.0))
        words = (
            f"{self.title} has the spaces {spaces[0]} of actions and {spaces[1]} of observations"
        )
        require(usable, f"{words}, which are not those of this package's environment: {ELSE}")
        return low, high

    def _action(self, seen: Tensor) -> Tensor:
        """Return the actions for normalised observations."""
        found = self.network(seen)
        return found if self.squashed else ((found - self.middle) / self.half).clamp(-1.0, 1.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions in [−1, 1], ``[rows, 1]``."""
        seen = (observation - self.mean) / self.scale
        return self._action(seen.clamp(-self.limit, self.limit))


def _layers(policy: Any) -> list[nn.Module]:
    """Return the layers of a policy; with ``squash_output`` they end in a tanh."""
    actor = getattr(policy, "actor", None)
    if actor is None:  # A2C, PPO: the mean of a Gaussian
        layers = [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net]
        return [*layers, *([nn.Tanh()] if policy.squash_output else [])]
    if hasattr(actor, "latent_pi"):  # SAC
        return [actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh()]
    return [actor.features_extractor, actor.mu]  # DDPG, TD3
