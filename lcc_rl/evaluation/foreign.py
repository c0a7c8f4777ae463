"""Policies trained by other libraries in an environment of this package.

A policy is a TensorDict module; a torch module from observations to actions; or a model of
stable-baselines3. It can be evaluated (:class:`GivenPolicy`) or exported (:func:`network_of`).
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs.transforms import CatFrames, Transform
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lcc_rl.errors import ConfigError, raised_as, require
from lcc_rl.pieces.base import ACTION, OBSERVATION, STEP, StepTransform
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.views import NEXT

INITIAL = "is_init"  # key from which recurrent modules of TorchRL read that an episode begins


class GivenPolicy(TensorDictModuleBase):
    """A policy from another library that drives every automated vehicle, without exploration.

    The module reads ``"observation"``, ``[rows, n]``, and writes ``"action"``, ``[rows, 1]``, one
    row per vehicle; or these entries of the group ``"automated"``, ``[*batch, vehicles, …]``. It
    may read ``"is_init"`` and entries that it wrote to ``("next", key)`` in the previous step.
    Transforms at the head of a sequence, such as ``CatFrames``, work as in an environment.

    Args:
        module: a TensorDict module.
        name: its name in messages.

    Raises:
        ConfigError: if it reads or writes other entries.
    """

    def __init__(self, module: TensorDictModuleBase, name: str) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [OBSERVATION, STEP], [ACTION]
        self.name, self.module = name, module
        self.heads: list[Transform] = []
        while isinstance(self.module, TensorDictSequential) and _is_head(self.module[0]):
            self.heads.append(self.module[0])
            self.module = self.module[1:]
        reads, writes = (list(map(unravel_key, x)) for x in (module.in_keys, module.out_keys))
        self.grouped = OBSERVATION in reads
        self.action = ACTION if self.grouped else ACTION[-1]
        self.memory = {key: (NEXT, key) for key in reads if unravel_key((NEXT, key)) in writes}
        seen = [OBSERVATION if self.grouped else OBSERVATION[-1], INITIAL, *self.memory]
        require(
            set(reads) <= set(seen) and seen[0] in reads and self.action in writes,
            f"{name} reads {reads} and writes {writes}: expected 'observation' and 'action', maybe "
            "of the group 'automated', 'is_init', and entries that it writes to ('next', key)",
        )
        self.kept: dict[Any, Tensor] = {}

    @torch.compiler.disable
    @torch.no_grad()
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``("automated", "action")``, ``[*batch, vehicles, 1]``."""
        observed, first = tensordict.get(OBSERVATION), tensordict.get(STEP) == 0
        seen = TensorDict({OBSERVATION: observed}, observed.shape[:-2])
        if not self.grouped:
            first = first.unsqueeze(-2).expand(*observed.shape[:-1], 1).reshape(-1, 1)
            seen = TensorDict({OBSERVATION[-1]: observed.flatten(0, -2)}, [len(first)])
        if first.any():  # all episodes begin at once
            self.kept, self.heads = {}, [_anew(head) for head in self.heads]
        seen.update({INITIAL: first, **self.kept})
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            for head in self.heads:
                begun = {"_reset": first} if isinstance(head, CatFrames) and first.any() else {}
                seen = head._call(seen, **begun)
            training = self.module.training
            seen = self.module.eval()(seen)
            self.module.train(training)
        self.kept = {key: seen.get(after) for key, after in self.memory.items()}
        action = seen.get(self.action).reshape(*observed.shape[:-1], 1)
        return tensordict.set(ACTION, action)

    def tried(self, moment: TensorDictBase) -> None:
        """Check that it returns an action for the first state of an episode.

        Raises:
            ConfigError: with the error in one line.
        """
        width = moment.get(OBSERVATION).shape[-1]
        words = f"{self.name} fails for observations of {width} numbers"
        with raised_as(ConfigError, words, Exception):  # any error of the user's module
            self(moment)


def _anew(head: Transform) -> Transform:
    """Return a transform in its initial state; only CatFrames has a state."""
    if not isinstance(head, CatFrames):
        return head
    keys = {"in_keys": head.in_keys, "out_keys": head.out_keys}
    padding = {"padding": head.padding, "padding_value": head.padding_value}
    return CatFrames(N=head.N, dim=head.dim, **keys, **padding)


def _is_head(part: Any) -> bool:
    return isinstance(part, Transform) and not isinstance(part, StepTransform)


def as_given(policy: Any, name: str) -> GivenPolicy | None:
    """Return a policy of another library as a policy of an evaluation; None if it is none."""
    if isinstance(policy, Controller):
        return None
    if isinstance(policy, TensorDictModuleBase):
        return GivenPolicy(policy, name)
    if (network := network_of(policy)) is None:
        return None
    return GivenPolicy(TensorDictModule(network, [OBSERVATION[-1]], [ACTION[-1]]), name)


def network_of(policy: Any, normalize: Any = None) -> nn.Module | None:
    """Return a policy as a module from observations ``[rows, n]`` to actions ``[rows, 1]``.

    Args:
        policy: a torch module, which is returned unchanged, or a model of stable-baselines3.
        normalize: its ``VecNormalize``; by default that of the model's environment, if any.

    Returns:
        The module; None for TensorDict modules and anything else.
    """
    if hasattr(policy, "get_vec_normalize_env"):
        return Deterministic(policy.policy, normalize or policy.get_vec_normalize_env())
    plain = isinstance(policy, nn.Module) and not isinstance(policy, TensorDictModuleBase)
    return policy if plain else None


class Deterministic(nn.Module):
    """The policy of a stable-baselines3 model without exploration, and its normalisation.

    Args:
        policy: ``model.policy``.
        normalize: ``VecNormalize`` or None; its statistics are copied.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, policy: Any, normalize: Any) -> None:
        super().__init__()
        actor = getattr(policy, "actor", None)
        if actor is None:  # A2C, PPO: the mean of a Gaussian
            layers = [policy.pi_features_extractor, policy.mlp_extractor.policy_net]
            layers += [policy.action_net, nn.Hardtanh()]
        else:  # DDPG, TD3, SAC
            sac = hasattr(actor, "latent_pi")
            layers = [actor.features_extractor, *([actor.latent_pi] if sac else []), actor.mu]
            layers += [nn.Tanh()] if sac else []
        self.network = deepcopy(nn.Sequential(*layers)).cpu().eval()
        own = normalize is not None and normalize.norm_obs
        self.limit = float(normalize.clip_obs) if own else torch.inf
        mean = normalize.obs_rms.mean if own else 0.0
        scale = (normalize.obs_rms.var + normalize.epsilon) ** 0.5 if own else 1.0
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float32))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the actions in [−1, 1]."""
        seen = ((observation - self.mean) / self.scale).clamp(-self.limit, self.limit)
        return self.network(seen)
