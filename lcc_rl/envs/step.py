"""One step of an environment as a function of plain mappings of tensors.

The TorchRL environment, the collector, the differentiable rollout and the evaluation all advance
by a :class:`Step`: :func:`tick` and the pieces' :meth:`~lcc_rl.pieces.base.Piece.derive`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Size as BatchSize
from torch import Tensor, compiler, device, ones, ones_like, zeros_like
from torchrl.data import Composite
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, FrameSkipTransform, Transform

from lcc_rl.config.nodes import as_plain
from lcc_rl.envs.single import find, group_key
from lcc_rl.errors import ConfigError
from lcc_rl.functional.finite import any_nonfinite, require_finite
from lcc_rl.pieces.base import (
    ACTION,
    NEXT,
    OBSERVATION,
    REWARD,
    SEED,
    STEP,
    Key,
    Piece,
    RewardPiece,
    State,
    StepTransform,
    add_specs,
    as_key,
    root_key,
)
from lcc_rl.pieces.rewards import RewardTerm, TotalReward
from lcc_rl.pieces.world import World
from lcc_rl.settings import TARGET, path_of, values

DONE, TERMINATED, TRUNCATED = ("done",), ("terminated",), ("truncated",)
PARTIAL = "_step"  # TorchRL's key of the mask of episodes that take the step
# If these entries are finite after a step, so are all others that matter.
FINITE_CHECKED = (("vehicles", "gap"), OBSERVATION, REWARD)


def tick(seed: Tensor, step: Tensor, horizon: int) -> State:
    """Return the entries of the clock at a step of an episode, before any piece acts."""
    truncated = step >= horizon
    terminated = zeros_like(truncated)
    return {SEED: seed, STEP: step, TRUNCATED: truncated, TERMINATED: terminated, DONE: truncated}


class Step:
    """Takes a batch of episodes one step further.

    Args:
        pieces: the pieces in the order in which they act.
        horizon: steps per episode.
        graded: pieces with a gradient; None for all.
    """

    def __init__(
        self, pieces: Sequence[Piece], horizon: int, graded: Iterable[Piece] | None = None
    ) -> None:
        chosen = set(pieces) if graded is None else set(graded)
        self.pieces = [(piece, piece not in chosen) for piece in pieces]
        self.horizon = horizon

    def __call__(self, before: State) -> State:
        """Return the entries of the next state.

        Args:
            before: the entries before the step that the pieces read, including the action.
        """
        reached = tick(before[SEED], before[STEP] + 1, self.horizon)
        for piece, detached in self.pieces:
            piece.derive(before, reached, detached)
        return reached

    def begin(self, seeds: Tensor) -> State:
        """Return the first state of episodes, as ``env.reset`` draws it.

        Args:
            seeds: the seed of each episode, ``[n, 1]``, int64.
        """
        clock = tick(seeds, zeros_like(seeds), self.horizon)
        start = TensorDict(batch_size=seeds.shape[:-1], device=seeds.device)
        for key, value in clock.items():
            start.set(key, value)
        options = TensorDict(batch_size=start.batch_size)
        for piece, _ in self.pieces:
            start = piece._reset(options, start)
        return _read(start)


def written(pieces: Iterable[Piece]) -> set[Key]:
    """Return the keys that pieces write, including constants, without ``"next"``."""
    return {key for piece in pieces for key in piece.entries}


def read_before(pieces: Iterable[Piece]) -> set[Key]:
    """Return the entries of a state that the next step reads, including constants."""
    keys: set[Key] = {SEED, STEP}
    for piece in pieces:
        keys |= {key for late, key in piece.needs if not late} | set(piece.constants)
    return keys


def closure(pieces: Sequence[Piece], wanted: set[Key], chosen: Sequence[Piece] = ()) -> list[Piece]:
    """Return the chosen pieces and all on which they or the wanted entries depend, in order."""
    closed = list(chosen)
    keys = set(wanted) | {key for piece in closed for _, key in piece.needs}
    grown = True
    while grown:
        added = [piece for piece in pieces if piece not in closed and written([piece]) & keys]
        keys |= {key for piece in added for _, key in piece.needs}
        closed, grown = closed + added, bool(added)
    return [piece for piece in pieces if piece in closed]


def entries_of(td: TensorDictBase) -> State:
    """Return the entries of a state by their full keys."""
    # Copies: entries that share a tensor would need another compiled graph.
    return {key: value.clone() for key, value in _read(td).items()}


def check_batch(batch: TensorDictBase, first: int | Tensor = 1, label: str = "") -> None:
    """Check that transitions are finite, before an update uses them.

    Args:
        batch: ``[environments, steps]``.
        first: number of the first step, or of every step of an episode, ``[steps, environments]``.
        label: name of the policy in the message.

    Raises:
        Diverged: naming the first entry that is not finite, its step and its episode.
    """
    numbers: State = {}
    for key in map(as_key, batch.keys(True, True)):
        name = group_key(root_key(key))
        # The state before a step is the result of the previous step.
        if (name == ACTION) != (key[0] == NEXT):
            numbers[name] = batch.get(key).detach().transpose(0, 1)
    order = sorted(numbers, key=lambda name: (name != ACTION, name == REWARD))  # causes first
    running = ones((*batch.shape[1::-1], 1), device=batch.device).bool()
    require_finite({name: numbers[name] for name in order}, running, first, label)


def leaf_keys(key: NestedKey, known: Iterable[Key]) -> list[Key]:
    """Return the keys of an entry, or of all entries below it, among those known."""
    name, path = root_key(key), as_key(key)
    prefix = path[: len(path) - len(name)]
    return [prefix + entry for entry in known if entry[: len(name)] == name]


def transforms_of(env: TransformedEnv) -> list[Any]:
    """Return the transforms of an environment."""
    return [*env.transform] if isinstance(env.transform, Compose) else [env.transform]


def pieces_of(env: TransformedEnv) -> list[Piece]:
    """Return the pieces of an environment."""
    return [piece for piece in transforms_of(env) if isinstance(piece, Piece)]


def observation_settings(env: TransformedEnv) -> dict[str, Any]:
    """Return the settings of an environment's observation as plain containers."""
    observation = next(piece for piece in pieces_of(env) if OBSERVATION in piece.targets)
    return as_plain({TARGET: path_of(type(observation)), **values(observation)})


class Pieces(Compose):
    """The pieces of an environment in the order in which they act, applied as one function.

    No piece has an inverse, changes the device or the batch size, or acts after a step. TorchRL
    calls all these methods in every step; here they are called for other transforms only, which a
    user may append. An appended reward term counts in the total reward.
    """

    world: World = World()  # the world of appended reward terms

    def append(self, transform: Transform | Callable[[TensorDictBase], TensorDictBase]) -> None:
        """Append a transform; a reward term is inserted before the sum of all terms."""
        total = self._total()
        if not isinstance(transform, RewardTerm) or total is None:
            super().append(self._bound(transform))
            return
        bound = self._bound(transform)
        super().insert(list(self.transforms).index(total), bound)
        self._count([*total.terms, bound.name])

    def insert(self, index: int, transform: Any) -> None:
        """Insert a transform; a reward term is appended, so that it counts."""
        if isinstance(transform, RewardTerm):
            self.append(transform)
        else:
            super().insert(index, self._bound(transform))

    def pop(self, index: int | None = None) -> Transform:
        """Remove and return a transform; the sum of all terms no longer holds a reward term."""
        removed = self.transforms[-1 if index is None else index]
        self._leave_out([removed])
        return super().pop(index)

    def __delitem__(self, index: Any) -> None:
        removed = self.transforms[index]
        self._leave_out(removed if isinstance(index, slice) else [removed])
        super().__delitem__(index)

    def __setitem__(self, index: Any, value: Any) -> None:
        del self[index]
        self.insert(range(len(self.transforms) + 1)[index], value)

    def _leave_out(self, transforms: Iterable[Transform]) -> None:
        """Let the sum of all terms no longer hold those of some transforms."""
        gone = {x.name for x in transforms if isinstance(x, RewardTerm)}
        if gone and self._total() is not None:
            self._count([name for name in self._total().terms if name not in gone])

    def _bound(self, transform: Any) -> Any:
        """Return a transform; a piece that is not bound yet is bound to the world."""
        if isinstance(transform, Piece) and "targets" not in vars(transform):
            return transform.bind(self.world, transform.name or None)
        return transform

    def _total(self) -> Any:
        return next((x for x in self.transforms if isinstance(x, TotalReward)), None)

    def _count(self, terms: Sequence[str]) -> None:
        """Let the sum of all terms hold these."""
        total = self._total()
        index = list(self.transforms).index(total)
        renewed = TotalReward(terms=terms).bind(World(total.string))
        renewed = renewed.to(total.parent.device) if total.parent else renewed
        super().pop(index)
        super().insert(index, renewed)

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Return the specs of action and state: what steps change, and features that they read."""
        input_spec = super().transform_input_spec(input_spec)
        pieces = [piece for piece in self.transforms if isinstance(piece, Piece)]
        read = read_before(pieces)
        for piece in pieces:
            if not isinstance(piece, StepTransform):
                add_specs(piece, input_spec["full_state_spec"], sorted(read & {*piece.entries}))
        return input_spec

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        next_tensordict = self._run(len(self.transforms), tensordict, next_tensordict)
        if not compiler.is_compiling():  # a compiled step cannot raise
            self._check_numbers(tensordict, next_tensordict)
        return next_tensordict

    def _run(self, count: int, td: TensorDictBase, next_td: TensorDictBase) -> TensorDictBase:
        """Apply the first transforms to a step, consecutive pieces as one function."""
        waiting: list[Piece] = []
        for index, transform in enumerate(self.transforms[:count]):
            if isinstance(transform, Piece):
                waiting.append(transform)
                continue
            next_td, waiting = _apply(waiting, td, next_td), []
            again = isinstance(transform, FrameSkipTransform)
            next_td = self._repeat(index, td, next_td) if again else transform._step(td, next_td)
        return _apply(waiting, td, next_td)

    def _repeat(self, index: int, td: TensorDictBase, next_td: TensorDictBase) -> TensorDictBase:
        """Repeat the action and add up rewards; TorchRL's transform would lose the state."""
        skip: Any = self.transforms[index]
        rewards = skip.parent.reward_keys
        for _ in range(skip.frame_skip - 1):
            now = td.copy().update(next_td.exclude(*rewards))
            now.set(PARTIAL, ~next_td.get(DONE).flatten(len(td.batch_size) - 1))
            reached = self._run(index, now, self.container.base_env._step(now))
            for key in rewards:
                reached.set(key, reached.get(key) + next_td.get(key))
            next_td = reached
        return next_td

    def _check_numbers(self, td: TensorDictBase, next_td: TensorDictBase) -> None:
        """Raise Diverged if an entry before or after a step is not finite."""
        checked = [find(td, ACTION), *(find(next_td, key) for key in FINITE_CHECKED)]
        if not any_nonfinite(value for value in checked if value is not None):
            return
        pieces = [piece for piece in self.transforms if isinstance(piece, Piece)]
        named: dict[Key, Tensor | None] = {ACTION: checked[0]}
        named |= {key: find(next_td, key) for piece in pieces for key in piece.targets}
        done = td.get(DONE, None)
        running = ones_like(next_td.get(DONE)) if done is None else ~done
        batch = running.numel()
        reached = {k: x.reshape(1, batch, -1) for k, x in named.items() if x is not None}
        require_finite(reached, running.reshape(1, batch, 1), int(next_td.get(STEP).max()))

    def inv(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the inverse of transforms that are no pieces, last first."""
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

    def transform_env_device(self, device: device) -> device:
        """Return the device of the environment."""
        for transform in self._others():
            device = transform.transform_env_device(device)
        return device

    def transform_env_batch_size(self, batch_size: BatchSize) -> BatchSize:
        """Return the size of the environment's batch."""
        for transform in self._others():
            batch_size = transform.transform_env_batch_size(batch_size)
        return batch_size

    def _others(self) -> list[Transform]:
        return [transform for transform in self.transforms if not isinstance(transform, Piece)]


def _read(td: TensorDictBase, prefix: Key = ()) -> State:
    """Return the entries of a TensorDict by their full keys, without copies."""
    entries: State = {}
    for name, value in td.items():
        if isinstance(value, Tensor):
            entries[(*prefix, name)] = value
        else:
            entries |= _read(value, (*prefix, name))
    return entries


def _hold(moves: Tensor, before: State, reached: State, keys: Iterable[Key]) -> None:
    """Restore entries, or set them to zero, where an episode does not take this step."""
    for key in list(keys):
        value = reached[key]
        rows = moves.reshape(*moves.shape, *[1] * (value.ndim - moves.ndim))
        reached[key] = value.where(rows, before.get(key, zeros_like(value)))


def _apply(pieces: list[Piece], td: TensorDictBase, next_td: TensorDictBase) -> TensorDictBase:
    """Apply pieces to two states; return the second one with the written entries."""
    if not pieces:
        return next_td
    before, reached = _read(td), _read(next_td)
    moves = before.get((PARTIAL,))
    if moves is not None:
        _hold(moves, before, reached, reached)
    for piece in pieces:
        try:
            piece.derive(before, reached)
        except KeyError as error:
            raise ConfigError(
                f"{piece.title} reads {error}, which no piece before it writes, or which is not in "
                "the state before the step: transforms must keep it"
            ) from error
        if moves is not None and isinstance(piece, StepTransform | RewardPiece):
            earlier = {} if isinstance(piece, RewardPiece) else before
            _hold(moves, earlier, reached, piece.targets)
    batch, device = next_td.batch_size, next_td.device
    spaces: dict[str, Any] = {}
    for key, value in reached.items():
        space = spaces
        for name in key[:-1]:
            space = space.setdefault(name, {})
        space[key[-1]] = value
    return _tensordict(spaces, batch, device)


def _tensordict(entries_of: dict[str, Any], batch: BatchSize, device: device | None) -> TensorDict:
    """Return nested entries as a TensorDict.

    TensorDict's check of every shape costs as much as the physics. The shapes were checked when the
    environment was built (:mod:`lcc_rl.envs.checks`).
    """
    entries = {
        name: _tensordict(value, batch, device) if isinstance(value, dict) else value
        for name, value in entries_of.items()
    }
    return TensorDict._new_unsafe(entries, batch_size=batch, device=device)
