"""The contract: every piece reads named entries of a TensorDict and writes named entries.

One object serves every role: appended to an environment, inside a ``TensorDictSequential``, by
keyword call, on a stored rollout and in a replay buffer. Two kinds exist:

* a :class:`Feature` looks at one moment: the same function at reset and after every step;
* a :class:`Transition` looks at two: keys under ``"next"`` belong to the moment reached, all
  others to the moment left, so that it applies unchanged to any stored transition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.base import NO_DEFAULT
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Compose, Transform

NEXT = "next"
# Written by the clock: the seed from which everything random in an episode follows, and its step.
SEED = ("episode", "seed")
STEP = ("episode", "step")


def as_tuple(key: NestedKey) -> tuple[str, ...]:
    """Return a key as a tuple; a dotted string counts as nested (``"cav.gap"``)."""
    if isinstance(key, str):
        return tuple(key.split("."))
    return tuple(key)


def following(key: NestedKey) -> tuple[str, ...]:
    """Return the key of the same entry one step later."""
    return (NEXT, *as_tuple(key))


def arrived(key: NestedKey) -> tuple[str, ...]:
    """Return the key of an entry of the moment reached, as that moment itself names it."""
    key = as_tuple(key)
    return key[1:] if key[0] == NEXT else key


def as_sequence(values: Tensor | Sequence[Tensor]) -> Sequence[Tensor]:
    """Return what :meth:`Piece.compute` returned as a sequence, also where it is one tensor."""
    return (values,) if isinstance(values, Tensor) else values


def peek(source: Any, key: tuple[str, ...]) -> Tensor:
    """Return an entry, past TensorDict's checks of the key, which cost as much as the physics."""
    for part in key:
        source = source._get_str(part, NO_DEFAULT)
    return source


def put(target: TensorDictBase, key: tuple[str, ...], value: Tensor) -> None:
    """Set an entry of an environment's own TensorDict, past the checks of shape and device."""
    target._set_tuple(key, value, inplace=False, validated=True, non_blocking=False)


class Piece(TensorDictModuleBase, Transform):
    """Base of all pieces; see the module's description.

    Args:
        reads: keys of the arguments of :meth:`compute`, in order.
        writes: keys of what :meth:`compute` returns, in order.
        event_shape: shape of one written entry after the batch dimensions.
    """

    # Maps the entries read to the entries written; a pure function of tensors.
    compute: Callable[..., Any]

    def __init__(
        self,
        reads: Sequence[NestedKey],
        writes: Sequence[NestedKey],
        event_shape: Sequence[int] = (1,),
    ) -> None:
        super().__init__(
            in_keys=[as_tuple(key) for key in reads], out_keys=[as_tuple(key) for key in writes]
        )
        self._entries, self._results = list(map(as_tuple, reads)), list(map(as_tuple, writes))
        self.event_shape = tuple(event_shape)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        """Return the spec of each written key, without ``"next"``."""
        shape = (*batch, *self.event_shape)
        return {key: Unbounded(shape=shape, device=device) for key in map(arrived, self.out_keys)}

    @dispatch(auto_batch_size=False)  # entries of followers have one dimension more
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the piece to any TensorDict that holds its ``in_keys``."""
        values = self.compute(*(tensordict.get(key) for key in self.in_keys))
        for key, value in zip(self.out_keys, as_sequence(values), strict=True):
            tensordict.set(key, value)
        return tensordict

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        # TorchRL's own version insists on finding the out_keys literally in the specs, which
        # keys under "next" never are.
        output_spec = output_spec.clone()
        for part, transform in (
            ("full_observation_spec", self.transform_observation_spec),
            ("full_reward_spec", self.transform_reward_spec),
            ("full_done_spec", self.transform_done_spec),
        ):
            output_spec[part] = transform(output_spec[part])
        return output_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return add_specs(self, observation_spec)


def add_specs(piece: Piece, spec: Composite) -> Composite:
    """Add the entries that a piece writes to a spec."""
    for key, entry in piece.written_specs(spec.shape, spec.device).items():
        spec[key] = entry
    return spec


class Feature(Piece):
    """A piece that looks at one moment, at reset as well as after every step."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        values = self.compute(*[peek(next_tensordict, key) for key in self._entries])
        for key, value in zip(self._results, as_sequence(values), strict=True):
            put(next_tensordict, key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)


class Transition(Piece):
    """A piece that looks at the moment left and the moment reached.

    Args:
        reads: keys of the arguments of :meth:`compute`; under ``"next"`` for the moment reached.
        writes: keys written at the moment reached, given without ``"next"``.
        constants: keys that :meth:`begin` sets at reset and that keep their value for the whole
            episode; a caller may set those listed in ``choices`` through ``env.reset``.
        choices: the keys among ``constants`` that can be given to ``env.reset``.
        event_shape: shape of one written entry after the batch dimensions.
    """

    def __init__(
        self,
        reads: Sequence[NestedKey],
        writes: Sequence[NestedKey],
        constants: Sequence[NestedKey] = (),
        choices: Sequence[NestedKey] = (),
        event_shape: Sequence[int] = (1,),
    ) -> None:
        super().__init__(reads, [following(key) for key in writes], event_shape)
        self._sources = [(as_tuple(key)[0] == NEXT, arrived(key)) for key in reads]
        self._arrival_keys = [as_tuple(key) for key in writes]
        self.constants = [as_tuple(key) for key in constants]
        self.choices = [as_tuple(key) for key in choices]

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        """Set the written entries and the constants at reset; zeros unless overridden.

        Args:
            given: what the caller passed to ``env.reset``: the ``choices`` may be in it.
            start: the first moment of the episodes, written by the pieces before this one.
        """
        specs = self.written_specs(start.batch_size, start.device)
        for key in map(arrived, self.out_keys):
            start.set(key, specs[key].zero())

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Any, Any]:
        """Return the spec of each constant key."""
        shape = (*batch, *self.event_shape)
        return {key: Unbounded(shape=shape, device=device) for key in self.constants}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries = [
            peek(next_tensordict if late else tensordict, key) for late, key in self._sources
        ]
        values = as_sequence(self.compute(*entries))
        for key, value in zip(self._arrival_keys, values, strict=True):
            put(next_tensordict, key, value)
        for key in self.constants:
            put(next_tensordict, key, peek(tensordict, key))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.begin(tensordict, tensordict_reset)
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = add_specs(self, observation_spec)
        constants = self.constant_specs(observation_spec.shape, observation_spec.device)
        for key, entry in constants.items():
            observation_spec[key] = entry
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        constants = self.constant_specs(state_spec.shape, state_spec.device)
        for key in self.choices:
            state_spec[key] = constants[key]
        return state_spec


class Pieces(Compose):
    """The pieces of an environment in the order in which they act.

    No piece has an inverse, changes the device or the size of the batch, or looks at what a step
    leaves behind. TorchRL asks for all this at every step; here only other transforms, which a
    user may append, are asked.
    """

    def inv(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the inverse of what is not a piece, last first."""
        tensordict = tensordict.copy()
        for transform in reversed(self._others()):
            tensordict = transform._inv_call(tensordict)
        return tensordict

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        for transform in self._others():
            tensordict, tensordict_ = transform._post_step_mdp_hooks(tensordict, tensordict_)
        return tensordict, tensordict_

    def transform_env_device(self, device: torch.device) -> torch.device:
        """Return the device of the environment."""
        for transform in self._others():
            device = transform.transform_env_device(device)
        return device

    def transform_env_batch_size(self, batch_size: torch.Size) -> torch.Size:
        """Return the size of the environment's batch."""
        for transform in self._others():
            batch_size = transform.transform_env_batch_size(batch_size)
        return batch_size

    def _others(self) -> list[Transform]:
        return [transform for transform in self.transforms if not isinstance(transform, Piece)]


class RewardPiece(Feature):
    """A feature written to the reward spec: it exists after a step, not at reset."""

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return observation_spec

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        return add_specs(self, reward_spec)
