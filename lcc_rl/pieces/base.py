"""The contract: every piece reads named entries of a TensorDict and writes named entries.

One object serves every role: in an environment, inside a ``TensorDictSequential``, by keyword
call, on a stored rollout and in a replay buffer. Two kinds exist:

* a :class:`Feature` reads one state: the same function at reset and after every step;
* a :class:`StepTransform` reads two: keys under ``"next"`` belong to the state after the step, all
  others to the state before it, so that it applies unchanged to any stored transition.

A piece is made of its settings (:mod:`lcc_rl.settings`). ``bind`` puts a copy of it into a world
and calls ``setup``, which declares by ``wire`` what the piece reads and writes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from lcc_rl.errors import ConfigError
from lcc_rl.functional.guard import unchanged
from lcc_rl.functional.layout import batch_innermost
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.views import NEXT as NEXT
from lcc_rl.pieces.views import Key as Key
from lcc_rl.pieces.views import Views
from lcc_rl.pieces.views import as_key as as_key
from lcc_rl.pieces.world import Part, World

# The entries of one moment by their full keys.
State = dict[Key, Tensor]

# Written by the clock: the seed from which everything random in an episode follows, and its step.
SEED = ("episode", "seed")
STEP = ("episode", "step")


def next_key(key: NestedKey) -> Key:
    """Return the key of the same entry in the next state."""
    return (NEXT, *as_key(key))


def root_key(key: NestedKey) -> Key:
    """Return a key without ``"next"``."""
    key = as_key(key)
    return key[1:] if key[0] == NEXT else key


def require_option(key: Key, values: Tensor, count: Tensor | int) -> None:
    """Check values of a reset option: whole numbers below ``count``, which may differ by episode.

    Raises:
        ConfigError: naming the option and its range.
    """
    wrong = (values < 0) | (values >= count)
    if bool(wrong.any()):
        last = (torch.as_tensor(count, device=values.device) - 1).expand_as(values)[wrong][0]
        raise ConfigError(
            f"reset: {'.'.join(key)} must lie in 0…{int(last)}, got {int(values[wrong][0])}"
        )


class Piece(Part, TensorDictModuleBase, Transform):
    """Base of all pieces; see the module's description."""

    # Maps the entries read to the entries written; a pure function of tensors.
    compute: ClassVar[Callable[..., Any]]

    @property
    def title(self) -> str:
        """What messages call it."""
        return type(self).__name__

    def __post_init__(self) -> None:
        # A transform, which reads and writes nothing before it is put into a world.
        Transform.__init__(self, in_keys=[], out_keys=[])

    def __getattr__(self, name: str) -> Any:
        if name in ("needs", "targets", "views", "event_shape"):
            kind = type(self).__name__
            raise AttributeError(f"{kind} is not bound to a world yet: use {kind}(…).bind(world)")
        return super().__getattr__(name)

    def wire(
        self,
        reads: Sequence[NestedKey],
        writes: Sequence[NestedKey],
        event_shape: Sequence[int] = (1,),
    ) -> None:
        """Set what the piece reads and writes.

        Args:
            reads: keys of the arguments of :meth:`compute`, in order.
            writes: keys of what :meth:`compute` returns, in order.
            event_shape: shape of one written entry after the batch dimensions.
        """
        self.in_keys = [as_key(key) for key in reads]
        self.out_keys = [as_key(key) for key in writes]
        self.event_shape = tuple(event_shape)
        # As plain tuples: TorchRL's properties convert at every access.
        self.needs = [(as_key(key)[0] == NEXT, root_key(key)) for key in reads]
        self.targets = [root_key(key) for key in writes]
        self.read_names = [".".join(as_key(key)) for key in reads]

    def see(
        self,
        world: World,
        names: Sequence[str],
        writes: Sequence[NestedKey],
        role: str = AUTOMATED,
        **more: Any,
    ) -> None:
        """Set what is read as the vehicles of a role see it, one row each: ``self.views`` says how.

        Args:
            world: what the pieces of the environment share.
            names: what is seen, see :mod:`lcc_rl.pieces.views`.
            writes: keys of what :meth:`compute` returns, one number per vehicle, in order.
            role: the role.
            **more: further arguments of :meth:`wire`.
        """
        self.views = Views(world.string, role, names)
        self.wire(self.views.keys, writes, (world.string.count(role), 1), **more)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        """Return the spec of each written key, without ``"next"``."""
        shape = (*batch, *self.event_shape)
        return {key: Unbounded(shape=shape, device=device) for key in self.targets}

    def derive(self, before: State, reached: State, detached: bool = False) -> None:
        """Compute the entries written from plain mappings of entries.

        Args:
            before: entries of the state before the step; a feature ignores them.
            reached: entries of the state after it, to which those written are added.
            detached: cut the gradient of what is written.
        """
        values = self._entries(before, reached)
        if detached:
            values = [value.detach() for value in values]
        self._write(self.computed(values), reached)

    def computed(self, values: Sequence[Tensor]) -> Any:
        """Return what :meth:`compute` returns; a ConfigError if it changes an entry in place."""
        return unchanged(self.compute, values, self.title, self.read_names)

    def _entries(self, before: State, reached: State) -> list[Tensor]:
        return [(reached if late else before)[key] for late, key in self.needs]

    def _write(self, values: Tensor | Sequence[Tensor], reached: State) -> None:
        values = (values,) if isinstance(values, Tensor) else values
        if len(values) != len(self.targets):
            raise ValueError(f"it returned {len(values)} instead of {len(self.targets)} entries")
        reached.update(zip(self.targets, values, strict=True))

    @dispatch(auto_batch_size=False)  # entries of vehicles have one dimension more
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the piece to any TensorDict that holds its ``in_keys``."""
        reads = self.in_keys if self.needs else ()  # an unbound piece raises here
        values = self.computed([tensordict.get(key) for key in reads])
        values = (values,) if isinstance(values, Tensor) else values
        for key, value in zip(self.out_keys, values, strict=True):
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
    """A piece that reads one moment, at reset as well as after every step."""

    def _entries(self, before: State, reached: State) -> list[Tensor]:
        return [reached[key] for _, key in self.needs]

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)


class StepTransform(Piece):
    """A piece that reads the states before and after a step."""

    def wire(
        self,
        reads: Sequence[NestedKey],
        writes: Sequence[NestedKey],
        event_shape: Sequence[int] = (1,),
        constants: Sequence[NestedKey] = (),
        reset_options: Sequence[NestedKey] = (),
    ) -> None:
        """Set what the piece reads and writes.

        Args:
            reads: keys of the arguments of :meth:`compute`; under ``"next"`` for the moment
                reached.
            writes: keys written in the next state, given without ``"next"``.
            event_shape: shape of one written entry after the batch dimensions.
            constants: keys that :meth:`begin` sets at reset and that keep their value for the
                whole episode.
            reset_options: the keys among ``constants`` that a caller may set through
                ``env.reset``.
        """
        super().wire(reads, [next_key(key) for key in writes], event_shape)
        self.constants = [as_key(key) for key in constants]
        self.reset_options = [as_key(key) for key in reset_options]

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        """Set the written entries and the constants at reset; zeros unless overridden.

        Args:
            given: what the caller passed to ``env.reset``: the reset options may be in it.
            start: the first moment of the episodes, written by the pieces before this one.
        """
        for key, spec in self.written_specs(start.batch_size, start.device).items():
            start.set(key, spec.zero())

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        """Return the spec of each constant key."""
        shape = (*batch, *self.event_shape)
        return {key: Unbounded(shape=shape, device=device) for key in self.constants}

    def derive(self, before: State, reached: State, detached: bool = False) -> None:
        super().derive(before, reached, detached)
        reached.update((key, before[key]) for key in self.constants)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        entries = [(next_tensordict if late else tensordict).get(key) for late, key in self.needs]
        reached: State = {}
        self._write(self.computed(entries), reached)
        reached.update((key, tensordict.get(key)) for key in self.constants)
        for key, value in reached.items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self.begin(tensordict, tensordict_reset)
        for key in (*self.targets, *self.constants):  # as a step lays them out
            tensordict_reset.set(key, batch_innermost(tensordict_reset.get(key)))
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        observation_spec = add_specs(self, observation_spec)
        constants = self.constant_specs(observation_spec.shape, observation_spec.device)
        for key, entry in constants.items():
            observation_spec[key] = entry
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        constants = self.constant_specs(state_spec.shape, state_spec.device)
        for key in self.reset_options:
            state_spec[key] = constants[key]
        return state_spec


class RewardPiece(Feature):
    """A feature of a step: at reset it is zero.

    Called on stored transitions (TensorDicts with ``"next"``), it reads the next state and
    writes there, as in an environment.
    """

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the piece to transitions, or to a TensorDict that holds its ``in_keys``."""
        if NEXT in tensordict.keys():  # noqa: SIM118  a TensorDict is no dict
            super().forward(tensordict.get(NEXT))
            return tensordict
        return super().forward(tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        batch, device = tensordict_reset.batch_size, tensordict_reset.device
        for key, spec in self.written_specs(batch, device).items():
            tensordict_reset.set(key, batch_innermost(spec.zero()))
        return tensordict_reset
