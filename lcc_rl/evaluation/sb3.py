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
# Vectors and wrappers, by name, that can be carried over; most leave observation and action alone.
CARRIED = {
    *(ENVIRONMENT, RESCALED, NORMALIZED, "OrderEnforcing", "PassiveEnvChecker", "TimeLimit"),
    *("Monitor", "RecordEpisodeStatistics", "RecordVideo", "HumanRendering", "NormalizeReward"),
    *("TransformReward", "ClipReward", "DummyVecEnv", "SubprocVecEnv", "VecMonitor"),
    *("VecCheckNan", "VecVideoRecorder"),
}


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
        self.title, policy = type(model).__name__, model.policy
        vectors, names = self._wrappers(model.get_env() if normalize is None else normalize)
        # Only models trained with VecNormalize have it; those with a replay buffer always do.
        raw = getattr(model, "_last_original_obs", None) is not None
        normalized = NORMALIZED in names or (vectors and hasattr(model, "replay_buffer"))
        text = f"{self.title} lacks the {NORMALIZED} of its training, or the vector without one: "
        require(normalized or not raw, f"{text}load it by {self.title}.load(path, env=…)")
        acts, sees = model.action_space, model.observation_space
        ends = [np.unique(getattr(x, at, np.nan)) for x in (acts, sees) for at in ("low", "high")]
        bounds, first = [-1.0, 1.0, -LARGEST_SCALED, LARGEST_SCALED], 2 * (RESCALED in names)
        usable = all(map(np.array_equal, ends[first:], [[x] for x in bounds[first:]]))
        usable = usable and acts.shape == (1,)
        text = f"{self.title}: its spaces {acts} and {sees} are not those of this package's"
        require(usable, f"{text} environment, and no wrapper of the training explains them")
        low, high = float(ends[0][0]), float(ends[1][0])
        self.middle, self.reach = (low + high) / 2.0, (high - low) / 2.0
        self.squashed, self.limit, mean, scale = policy.squash_output, torch.inf, 0.0, 1.0
        for norm in (x for x in vectors if getattr(x, "norm_obs", False)):
            self.limit, mean = float(norm.clip_obs), norm.obs_rms.mean
            scale = (norm.obs_rms.var + norm.epsilon) ** 0.5
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32))
        kind = f"{self.title}: its {type(policy).__name__} cannot be carried over"
        with raised_as(ConfigError, kind, Exception), torch.no_grad():  # any of a user's class
            self.network = deepcopy(nn.Sequential(*_layers(policy))).cpu().eval()
            sizes = np.geomspace(0.01, 3.0, 64)[:, None]
            batch = np.random.default_rng(0).normal(0.0, sizes, (64, *sees.shape)).astype("float32")
            actions = self._action(torch.as_tensor(batch)) * self.reach + self.middle
            off = np.abs(model.predict(batch, deterministic=True)[0] - actions.numpy()).max()
            require(off < 1e-4 * self.reach, f"predict() differs from its layers by {off:.2g}")

    def _wrappers(self, env: Any) -> tuple[list[Any], list[str]]:
        """Return a vector with all that it wraps, and the names of these and of inner wrappers."""
        if env is None:
            return [], []
        vectors = [env]
        while hasattr(vectors[-1], "venv"):
            vectors.append(vectors[-1].venv)
        message = f"{self.title}: the wrappers of its environment cannot be read; is it closed?"
        with raised_as(ConfigError, message, Exception):  # of a process that has ended
            texts = {*vectors[-1].env_method("__str__")}  # <Monitor<CarFollowing<lcc_rl/alcc-v0>>>
        names = [type(x).__name__ for x in vectors]
        names += [name for text in texts for name in re.findall(r"<(\w+)(?=[< ])", text)]
        strange = ", ".join({*names} - CARRIED) or "wrappers"
        require(
            CARRIED.issuperset(names) and ENVIRONMENT in names and names.count(NORMALIZED) < 2,
            f"{self.title} was trained with {strange}, which cannot be carried over: pass a torch "
            "module from this package's observations to actions in [−1, 1], or train with no "
            f"other wrappers than one {NORMALIZED} and {RESCALED}",
        )
        return vectors, names

    def _action(self, inputs: Tensor) -> Tensor:
        outputs = self.network(inputs)
        return outputs if self.squashed else ((outputs - self.middle) / self.reach).clamp(-1.0, 1.0)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions in [−1, 1], ``[rows, 1]``."""
        inputs = (observation - self.mean) / self.scale
        return self._action(inputs.clamp(-self.limit, self.limit))


def _layers(policy: Any) -> list[nn.Module]:
    """Return the layers of a policy; with ``squash_output`` they end in a tanh."""
    actor = getattr(policy, "actor", None)
    if actor is None:  # A2C, PPO: the mean of a Gaussian
        layers = [policy.pi_features_extractor, policy.mlp_extractor.policy_net, policy.action_net]
        return [*layers, nn.Tanh()] if policy.squash_output else layers
    if hasattr(actor, "latent_pi"):  # SAC
        return [actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh()]
    return [actor.features_extractor, actor.mu]  # DDPG, TD3
