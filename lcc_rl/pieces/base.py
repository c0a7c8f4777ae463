"""The contract: every piece reads named entries of a TensorDict and writes named entries.

One object serves every role: in an environment, inside a ``TensorDictSequential``, by keyword
call, on a stored rollout and in a replay buffer. Two kinds exist:

* a :class:`Feature` reads one state: the same function at reset and after every step;
* a :class:`StepTransform` reads two: keys under ``"next"`` belong to the state after the step, all
  others to the state before it, so that it applies unchanged to any stored transition.

A piece is constructed from its settings (:mod:`lcc_rl.settings`). ``bind`` returns a copy of it for
a world and calls ``setup``, which declares the entries that the piece reads and writes: ``reads``
and ``writes`` of its class, unless they depend on settings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from lcc_rl.errors import ConfigError, require
from lcc_rl.functional.guard import unchanged
from lcc_rl.functional.layout import batch_innermost
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.views import EPISODE, NEXT, VEHICLES, Key, Views, as_key
from lcc_rl.pieces.world import Part, World
from lcc_rl.settings import values

# The entries of one state by their full keys.
State = dict[Key, Tensor]

# Written by the clock: the episode's seed, which determines all its random numbers, and its step.
SEED = (EPISODE, "seed")
STEP = (EPISODE, "step")
# Read and written by learners, and their reward.
OBSERVATION, ACTION, REWARD = ((AUTOMATED, x) for x in ("observation", "action", "reward"))
# Parts of declared keys that stand for the role of a piece, and for its name.
ROLE, TERM = "role", "name"


@dataclass(frozen=True)
class Entry:
    """An entry that a piece writes, declared in the body of its class.

    Args:
        key: its key; a part ``role`` stands for the role of the piece, ``name`` for its name.
        unit: unit of its numbers; "–" for none.
        meaning: description for docs/entries.md.
        width: numbers per row; a tuple for several dimensions.
        whole: whether it holds whole numbers, int64.
        option: whether a caller may set it, a whole constant, through ``env.reset``.
    """

    key: NestedKey
    unit: str = "–"
    meaning: str = ""
    width: int | tuple[int, ...] = 1
    whole: bool = False
    option: bool = False

    def of(self, role: str, name: str = "") -> Entry:
        """Return the entry of a role or of a name."""
        names = {ROLE: role, TERM: name}
        return replace(self, key=tuple(names.get(x) or x for x in as_key(self.key)))

    def wide(self, width: int | tuple[int, ...]) -> Entry:
        """Return the entry with another width."""
        return replace(self, width=width)


def declared(*kinds: type) -> dict[Key, Entry]:
    """Return the entries in the bodies of classes and of those derived from them, by key."""
    entries: dict[Key, Entry] = {}
    for kind in kinds:
        for value in vars(kind).values():
            several = value if isinstance(value, tuple) else (value,)
            entries |= {as_key(entry.key): entry for entry in several if isinstance(entry, Entry)}
        entries |= declared(*kind.__subclasses__())
    return entries


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

    # Settings that an evaluation may change for a policy, as it does drivers and faults.
    conditions: ClassVar[tuple[str, ...]] = ()
    # Rows of the written entries: one per vehicle of a role, one per vehicle ("vehicles"), or one
    # per episode ("episode").
    role = AUTOMATED
    # Arguments of compute, in order: names of views, and keys as tuples.
    reads: ClassVar[Sequence[NestedKey]] = ()
    # Results of compute, in order; a plain key holds one number per row.
    writes: ClassVar[Sequence[Entry | NestedKey]] = ()
    keeps: ClassVar[Sequence[Entry]] = ()  # constants of an episode, which begin sets at reset
    event: ClassVar[Sequence[Key]] = ()  # arguments of its method happened: steps of an event
    reads_drivers = False  # whether it depends on the population of drivers
    measures: ClassVar[bool] = False  # whether measured values are read where the role has sensors
    # Maps the entries read to the entries written; a pure function of tensors.
    compute: ClassVar[Callable[..., Any]]

    @property
    def title(self) -> str:
        """Its name in messages."""
        return type(self).__name__

    def __post_init__(self) -> None:
        # As a transform it reads and writes nothing before it is bound.
        Transform.__init__(self, in_keys=[], out_keys=[])

    def __getattr__(self, name: str) -> Any:
        if name in ("needs", "targets", "views", "event_shape"):
            kind = type(self).__name__
            raise AttributeError(f"{kind} is not bound to a world yet: use {kind}(…).bind(world)")
        return super().__getattr__(name)

    def __setattr__(self, name: str, value: Any) -> None:
        if vars(self).get("fixed") and name in values(self):
            raise ConfigError(
                f"{self.title}.{name} cannot change after env.compile(), whose step has the value "
                "before: build another environment"
            )
        super().__setattr__(name, value)

    def setup(self, world: World) -> None:
        """Derive everything that depends on a world; an override calls :meth:`declare`."""
        self.declare(world)

    def declare(
        self,
        world: World,
        reads: Sequence[NestedKey] | Views | None = None,
        writes: Sequence[Entry | NestedKey] | None = None,
        keeps: Sequence[Entry] | None = None,
    ) -> None:
        """Set the entries that the piece reads and writes; by default those of its class.

        Args:
            world, keeps: the world, and constants of an episode.
            reads: arguments of :meth:`compute`, in order.
            writes: results of :meth:`compute`, in order, without ``"next"``.
        """
        string = self.string = world.string
        if not isinstance(reads, Views):
            names = self.reads if reads is None else reads
            names = world.sensed(self.role, names) if self.measures else names
            reads = Views(string, self.role, names)
        self.views = reads
        # Plain tuples, because TorchRL's properties convert at every access.
        self.needs = [self.read_at(key) for key in reads.keys]
        self.read_names = [".".join(key) for key in reads.keys]
        count = len(string) if self.role == VEHICLES else string.count(self.role)
        self.rows = () if self.role == EPISODE else (count,)
        self.entries: dict[Key, Entry] = {}
        self.targets = self._declared(self.writes if writes is None else writes)
        self.constants = self._declared(self.keeps if keeps is None else keeps)
        self.reset_options = [key for key in self.constants if self.entries[key].option]
        self.in_keys = list(reads.keys)
        self.out_keys = [self.written_at(key) for key in self.targets]
        self.event_shape = self.shape_of(self.targets[0]) if self.targets else (*self.rows, 1)

    read_at = staticmethod(lambda key: (True, key))  # (whether it is of the next state, key)
    written_at = staticmethod(root_key)  # key of a written entry in a step's TensorDict

    def _declared(self, entries: Sequence[Entry | NestedKey]) -> list[Key]:
        """Store entries of the piece; return their keys."""
        new = [x.of(self.role, self.name) if isinstance(x, Entry) else Entry(x) for x in entries]
        self.entries |= {as_key(entry.key): entry for entry in new}
        return [as_key(entry.key) for entry in new]

    def shape_of(self, key: Key) -> tuple[int, ...]:
        """Return the shape of a declared entry after the batch dimensions."""
        width = self.entries[key].width
        return (*self.rows, *((width,) if isinstance(width, int) else width))

    def layouts(
        self, batch: torch.Size, keys: Sequence[Key] | None = None
    ) -> dict[Key, tuple[torch.Size, torch.dtype]]:
        """Return shape and type of declared entries, by default of all."""
        result = {}
        for key in self.entries if keys is None else keys:
            integral = self.entries[key].whole or self.entries[key].option
            dtype = torch.int64 if integral else torch.get_default_dtype()
            result[key] = torch.Size((*batch, *self.shape_of(key))), dtype
        return result

    def derive(self, before: State, reached: State, detached: bool = False) -> None:
        """Compute the written entries from plain mappings of entries.

        Args:
            before: entries of the state before the step; a feature ignores them.
            reached: entries of the state after the step, to which the written ones are added.
            detached: cut the gradient of the written entries.
        """
        values = [(reached if late else before)[key] for late, key in self.needs]
        if detached:
            values = [value.detach() for value in values]
        self._write(self.computed(values), reached)

    def computed(self, entries: Sequence[Tensor]) -> Any:
        """Return the results of :meth:`compute`; a ConfigError if it changes an entry in place.

        Args:
            entries: the entries read, in the order of ``in_keys``.
        """
        return unchanged(self._seen, entries, self.title, self.read_names)

    def _seen(self, *entries: Tensor) -> Any:
        return self.compute(*self.views(*entries))

    def _present(self, entries: Sequence[Tensor | None]) -> list[Tensor]:
        """Return entries of TensorDicts; a ConfigError names those that they lack."""
        missing = [x for x, entry in zip(self.read_names, entries, strict=True) if entry is None]
        require(not missing, f"{self.title} reads {', '.join(missing)}, which nothing has written")
        return [entry for entry in entries if entry is not None]

    def _write(self, values: Any, reached: State) -> None:
        values = returned(values)
        if len(values) != len(self.targets):
            raise ValueError(f"it returned {len(values)} instead of {len(self.targets)} entries")
        reached.update(zip(self.targets, values, strict=True))

    @dispatch(auto_batch_size=False)  # entries of vehicles have a further dimension
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the piece to any TensorDict that holds its ``in_keys``."""
        reads = self.in_keys if self.needs else ()  # an unbound piece raises here
        inputs = self._present([tensordict.get(key, None) for key in reads])
        values = returned(self.computed(inputs))
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        return self._extended(output_spec, "observation", "reward", "done")

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        return self._extended(input_spec, "state")

    def _extended(self, spec: Composite, *parts: str) -> Composite:
        # TorchRL's own version requires the out_keys in the specs, where keys under "next" are
        # missing. TransformedEnv passes a copy; one per piece would be slow.
        for part in parts:
            name = f"full_{part}_spec"
            spec[name] = getattr(self, f"transform_{part}_spec")(spec[name])
        return spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return add_specs(self, observation_spec)


def returned(values: Any) -> Sequence[Tensor]:
    """Return the results of a piece as a sequence; a TypeError names one that is no tensor."""
    values = values if isinstance(values, (tuple, list)) else (values,)
    for value in values:
        if not isinstance(value, Tensor):
            raise TypeError(f"it returned {value!r}, not a tensor")
    return values


def add_specs(piece: Piece, spec: Composite, keys: Sequence[Key] | None = None) -> Composite:
    """Add declared entries of a piece to a spec, by default all of them."""
    for key, (shape, dtype) in piece.layouts(spec.shape, keys).items():
        spec[key] = Unbounded(shape, dtype=dtype, device=spec.device)
    return spec


class Feature(Piece):
    """A piece that reads one state, at reset and after every step."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self.forward(next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self.forward(tensordict_reset)


class AfterStep(Feature):
    """A feature that writes nothing at reset, and what it writes is no observation."""

    _reset = Transform._reset
    transform_observation_spec = Transform.transform_observation_spec


class StepTransform(Piece):
    """A piece that reads the states before and after a step."""

    compute: ClassVar[Callable[..., Any]] = staticmethod(lambda: ())  # of a piece of constants

    read_at = staticmethod(lambda key: (key[0] == NEXT, root_key(key)))
    written_at = staticmethod(next_key)

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        """Set the written entries and the constants at reset; zeros unless overridden.

        Args:
            given: TensorDict passed to ``env.reset``, which may contain reset options.
            start: first state of the episodes, with the entries of the pieces before this one.
        """
        for key, (shape, dtype) in self.layouts(start.batch_size, self.targets).items():
            start.set(key, torch.zeros(shape, dtype=dtype, device=start.device))

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        return add_specs(self, state_spec)

    def derive(self, before: State, reached: State, detached: bool = False) -> None:
        super().derive(before, reached, detached)
        reached.update((key, before[key]) for key in self.constants)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        moments = (tensordict, next_tensordict)
        entries = self._present([moments[late].get(key, None) for late, key in self.needs])
        reached: State = {}
        self._write(self.computed(entries), reached)
        reached.update((key, tensordict.get(key)) for key in self.constants)
        for key, value in reached.items():
            next_tensordict.set(key, value)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        state = (*self.targets, *self.constants)
        if tensordict.get(STEP, None) is None:
            self.begin(tensordict, tensordict_reset)
        else:  # a whole state is given
            tensordict_reset.update(tensordict.select(*state))
        for key in state:  # in the memory layout of a step
            tensordict_reset.set(key, batch_innermost(tensordict_reset.get(key)))
        return tensordict_reset


class RoleTransform(StepTransform):
    """A step transform of the vehicles of one role; its name in an environment is the role."""

    name = AUTOMATED

    @property
    def role(self) -> str:  # type: ignore[override]
        """The role."""
        return self.name


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
        for key, (shape, dtype) in self.layouts(tensordict_reset.batch_size).items():
            zeros = torch.zeros(shape, dtype=dtype, device=tensordict_reset.device)
            tensordict_reset.set(key, batch_innermost(zeros))
        return tensordict_reset
