"""Policies trained by other libraries in an environment of this package.

A policy is a TensorDict module; a torch module from observations to actions; or a model of
stable-baselines3. It can be evaluated (:class:`GivenPolicy`) or exported (:func:`network_of`).
"""

from __future__ import annotations

import re
from copy import deepcopy
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import CatFrames, ObservationNorm, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lcc_rl.envs.arrays import LARGEST_SCALED
from lcc_rl.envs.step import observation_settings
from lcc_rl.errors import ConfigError, line_of, raised_as, replacing, require
from lcc_rl.functional.guard import check_independent
from lcc_rl.pieces.base import ACTION, OBSERVATION, STEP, StepTransform
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import NEXT
from lcc_rl.results.runs import differing, flatten

BY_NEXT = "draw random numbers, or remember but by ('next', key) of a TensorDictModule"
INITIAL = "is_init"  # key from which recurrent modules of TorchRL read that an episode begins


class GivenPolicy(TensorDictModuleBase):
    """A policy from another library that drives every automated vehicle, without exploration.

    The module reads ``"observation"``, ``[rows, n]``, and writes ``"action"``, ``[rows, 1]``, one
    row per vehicle; or these entries of the group ``"automated"``, ``[*batch, vehicles, …]``. It
    may read ``"is_init"`` and entries that it wrote to ``("next", key)`` in the previous step.
    Transforms at the head of a sequence, such as ``CatFrames``, work as in an environment; the
    statistics of ``VecNorm`` and ``VecNormV2`` are those of the moment at which this is made.

    Raises:
        ConfigError: if it reads or writes other entries.
    """

    def __init__(self, module: TensorDictModuleBase, name: str) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [OBSERVATION, STEP], [ACTION]
        self.name, self.module = name, module
        self.heads: list[Transform] = []
        while isinstance(self.module, TensorDictSequential) and _is_head(self.module[0]):
            self.heads.append(_still(self.module[0], name))
            self.module = self.module[1:]
        moving = [type(layer).__name__ for layer in self.module.modules() if _normalizes(layer)]
        message = f"{name}: {', '.join(moving)} must be the first module of the sequence"
        require(not moving, message)
        reads, writes = (list(map(unravel_key, x)) for x in (module.in_keys, module.out_keys))
        self.grouped = OBSERVATION in reads
        self.action = ACTION if self.grouped else ACTION[-1]
        self.memory = {key: (NEXT, key) for key in reads if unravel_key((NEXT, key)) in writes}
        entries = [OBSERVATION if self.grouped else OBSERVATION[-1], INITIAL, *self.memory]
        require(
            set(reads) <= set(entries) and entries[0] in reads and self.action in writes,
            f"{name} reads {reads} and writes {writes}: expected 'observation' and 'action', maybe "
            "of the group 'automated', 'is_init', and entries that it writes to ('next', key)",
        )
        self.kept: dict[Any, Tensor] = {}
        self.steps, self.beyond, self.largest = 0, torch.zeros(()), torch.zeros(())

    @torch.compiler.disable
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``("automated", "action")``, ``[*batch, vehicles, 1]``."""
        action = self._action(tensordict.get(OBSERVATION), tensordict.get(STEP) == 0)
        size = action.detach().abs().cpu()
        self.steps += 1
        self.beyond = self.beyond + (size > 1.0 + 1e-5).float().mean()
        self.largest = torch.maximum(self.largest, size.max())
        return tensordict.set(ACTION, action)

    def _action(self, observed: Tensor, first: Tensor) -> Tensor:
        """Return the actions for observations, in whose type, and keep the module's memory."""
        td = TensorDict({OBSERVATION: observed}, observed.shape[:-2])
        if not self.grouped:
            first = first.unsqueeze(-2).expand(*observed.shape[:-1], 1).reshape(-1, 1)
            td = TensorDict({OBSERVATION[-1]: observed.flatten(0, -2)}, [len(first)])
        if first.any():  # all episodes begin at once
            self.kept, self.heads = {}, [_anew(head) for head in self.heads]
        td.update({INITIAL: first, **self.kept})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            for head in self.heads:
                reset = {"_reset": first} if isinstance(head, CatFrames) and first.any() else {}
                td = head._call(td, **reset)
            training = self.module.training
            td = self.module.eval()(td)
            self.module.train(training)
        self.kept = {key: td.get(after) for key, after in self.memory.items()}
        return td.get(self.action).reshape(*observed.shape[:-1], 1).to(observed.dtype)

    def clipped(self) -> str:
        """Return a warning if actions so far were beyond [−1, 1]; else nothing."""
        if not self.beyond:
            return ""
        share = 100.0 * float(self.beyond) / self.steps
        return (
            f"{self.name}: {share:.2g} % of its actions are beyond ±1, up to {self.largest:.3g}; "
            "they were clipped. An action is a share of the largest acceleration (3 m/s²): divide "
            "accelerations in m/s² by it"
        )

    @torch.no_grad()
    def tried(self, moment: TensorDictBase) -> None:
        """Check that it returns actions, for each episode by its observations alone.

        Raises:
            ConfigError: with the error in one line.
        """
        seen = moment.get(OBSERVATION)
        seen = seen.reshape(-1, *seen.shape[-2:])[:1].expand(2, -1, -1)

        def play(*steps: Tensor) -> list[Tensor]:
            firsts = (torch.full((len(seen), 1), n == 0) for n, seen in enumerate(steps))
            return [self._action(*one) for one in zip(steps, firsts, strict=True)]

        message = f"{self.name} fails for observations of {seen.shape[-1]} numbers"
        with replacing(lambda error: ConfigError(f"{message}: {line_of(error)}")):
            names = "first action", "second action"
            check_independent(self.name, names, play, [seen, seen], BY_NEXT, 1e-2)


def _anew(head: Transform) -> Transform:
    """Return a transform in its initial state; only CatFrames has a state."""
    if not isinstance(head, CatFrames):
        return head
    keys = {"in_keys": head.in_keys, "out_keys": head.out_keys}
    padding = {"padding": head.padding, "padding_value": head.padding_value}
    return CatFrames(N=head.N, dim=head.dim, **keys, **padding)


def _normalizes(module: nn.Module) -> bool:
    return hasattr(module, "to_observation_norm")


def _still(head: Any, name: str) -> Transform:
    """Return a transform whose statistics do not change; refuse missing or separate ones."""
    kind = type(head).__name__
    message = f"{name}: {kind} has no statistics yet; pass the one of the training"
    with raised_as(ConfigError, message, Exception):  # torchrl has no check
        still = head.to_observation_norm() if _normalizes(head) else head
    norms = [module for module in still.modules() if isinstance(module, ObservationNorm)]
    require(
        all(norm.loc.ndim < 2 + (OBSERVATION in norm.in_keys) for norm in norms),
        f"{name}: {kind} has statistics of its own for each environment: train with "
        "VecNormV2(…, reduce_batch_dims=True)",
    )
    return still


def _is_head(module: Any) -> bool:
    return isinstance(module, Transform) and not isinstance(module, StepTransform)


def as_given(policy: Any, name: str) -> GivenPolicy | None:
    """Return a policy of another library as a policy of an evaluation; None if it is none."""
    if isinstance(policy, Controller):
        return None
    if isinstance(policy, TensorDictModuleBase):
        return GivenPolicy(policy, name)
    if (network := network_of(policy)) is None:
        return None
    return GivenPolicy(TensorDictModule(network, [OBSERVATION[-1]], [ACTION[-1]]), name)


def check_observed(policy: GivenPolicy, env: TransformedEnv) -> None:
    """Check that a model of stable-baselines3 observes as in its environment, if it has one.

    Raises:
        ConfigError: naming the settings of the observation that differ.
    """
    here = dict(flatten(observation_settings(env)))
    for module in policy.modules():
        there = dict(flatten(getattr(module, "observes", None) or here))
        other = [f"observation.{key}={there.get(key)}" for key in differing(here, there)]
        text = f"{policy.name} was trained with {', '.join(other)}, which are other here: "
        require(not other, f"{text}give the variant and overrides of its environment")


def network_of(policy: Any, normalize: Any = None) -> nn.Module | None:
    """Return a policy as a module from observations ``[rows, n]`` to actions ``[rows, 1]``.

    Args:
        policy: a torch module, which is returned unchanged, or a model of stable-baselines3.
        normalize: its ``VecNormalize``; by default that of the model's environment, if any.

    Returns:
        The module; None for TensorDict modules and anything else.

    Raises:
        ConfigError: if a model would act differently here.
    """
    if hasattr(policy, "get_vec_normalize_env"):
        return StableBaselinesPolicy(policy, normalize)
    plain = isinstance(policy, nn.Module) and not isinstance(policy, TensorDictModuleBase)
    return policy if plain else None


# -- stable-baselines3 -----------------------------------------------------------------------------

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
        self.observes = vectors[-1].get_attr("observes", 0)[0] if vectors else None
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
