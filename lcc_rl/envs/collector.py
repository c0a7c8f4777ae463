"""A TorchRL collector with little overhead."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.collectors import BaseCollector
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import RandomPolicy

from lcc_rl.envs.compiled import Compiled
from lcc_rl.envs.single import VIEWS, MultiAgent, SingleAgent, group_key
from lcc_rl.envs.step import (
    DONE,
    Step,
    check_batch,
    closure,
    entries_of,
    leaf_keys,
    pieces_of,
    read_before,
    transforms_of,
)
from lcc_rl.errors import ConfigError, require
from lcc_rl.pieces.base import NEXT, STEP, Key, State, as_key, root_key

# Plain resets, 2 ms each, before they are compiled, which takes 3 to 7 s.
PLAIN_RESETS = 2_000


class StringCollector(BaseCollector):
    """Plays an environment and yields batches of a number of frames.

    The transitions are those of TorchRL's ``Collector``; a new episode follows one that is over.
    TensorDicts are made once per batch, not several times per step, and hold the requested entries
    only, so most of the time is spent in the policy and the physics.

    Args:
        create_env_fn: the environment with ``[batch]`` parallel episodes, or a function that
            returns it.
        policy: writes the action into a TensorDict with its ``in_keys``; None for random actions.
        frames_per_batch: frames of a batch: steps times parallel episodes.
        total_frames: frames after which iteration ends; −1: never.
        keys: entries of a batch, those of the next state under ``"next"``; a nested key stands
            for all entries below it. None: all entries.
        compiled: compile the step and the policy; without a compiler the plain step is used, which
            is logged.

    Raises:
        ConfigError: if the frames are no multiple of the parallel episodes, no vehicle is
            automated, or the environment has transforms other than pieces and a view of the
            automated vehicles.
    """

    def __init__(
        self,
        create_env_fn: Any,
        policy: TensorDictModuleBase | None,
        *,
        frames_per_batch: int,
        total_frames: int = -1,
        keys: Sequence[NestedKey] | None = None,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        env = create_env_fn if isinstance(create_env_fn, TransformedEnv) else create_env_fn()
        self.env: TransformedEnv = env
        self.policy: Any = RandomPolicy(env.full_action_spec) if policy is None else policy
        self.requested_frames_per_batch, self.total_frames = frames_per_batch, total_frames
        self._frames, self._iter, self._iterator, self.trajs_per_batch = 0, -1, None, None
        episodes = env.batch_size.numel()
        require(
            frames_per_batch > 0 and not frames_per_batch % episodes,
            f"frames_per_batch ({frames_per_batch}) must be a multiple of the {episodes} episodes "
            "side by side",
        )
        self.steps = frames_per_batch // episodes
        self.view = _view(env)
        self.single = isinstance(self.view, SingleAgent)
        actions = [as_key(key) for key in env.full_action_spec.keys(True, True)]
        require(actions, "no vehicle of the string is automated: StringCollector needs an action")
        self.action: Key = actions[0]
        reads = map(as_key, getattr(policy, "in_keys", []))
        self.reads = [key for key in reads if key != self.action]
        state = self._entries(env.reset())
        self.keys = self._asked(keys, list(state))
        entries = {*(self._inner(root_key(key)) for key in self.keys), DONE}
        entries |= {self._inner(key) for key in self.reads}
        # Pieces on which none of these entries depend are left out.
        self.step = Step(closure(pieces_of(env), entries), env.base_env.horizon)
        self.first = Step(pieces_of(env), env.base_env.horizon)  # a reset may read more
        # What the next step reads or a batch contains.
        self.carried = read_before(piece for piece, _ in self.step.pieces)
        self.carried |= {DONE, *map(self._inner, self.reads)}
        self.carried |= {self._inner(key) for key in self.keys if key[0] != NEXT}
        self.state = {key: value for key, value in state.items() if key in self.carried}
        self.advance = Compiled(self._advance, "the environment", compiled, env.device)
        self.renew = Compiled(self._renewed, "its resets", compiled, env.device)
        # Number of episodes of a compiled reset, about twice as many as end in a step.
        self.rows = min(episodes, max(32, episodes // 64)) if compiled else 0
        self.resets = 0

    def _asked(self, keys: Sequence[NestedKey] | None, state: list[Key]) -> list[Key]:
        """Return the leaves of a batch; by default all entries before and after a step."""
        rewards = [as_key(key) for key in self.env.full_reward_spec.keys(True, True)]
        before = [self._shown(key) for key in [*state, self._inner(self.action)]]
        after = [(NEXT, *self._shown(key)) for key in [*state, *rewards]]
        asked = keys if keys is not None else [*before, *after]
        every = [*before, *rewards]
        return list(dict.fromkeys(leaf for key in asked for leaf in leaf_keys(key, every)))

    def _inner(self, key: Key) -> Key:
        """Return the key of an entry for the pieces."""
        return group_key(key) if self.single else key

    def _shown(self, key: Key) -> Key:
        """Return the key of an entry of the pieces in the environment."""
        inner = self.single and key[:1] == ("automated",) and group_key(key[1:]) == key
        return key[1:] if inner else key

    def reset(self) -> None:
        """Begin new episodes in all places."""
        entries = self._entries(self.env.reset())
        self.state = {key: value for key, value in entries.items() if key in self.carried}

    def _entries(self, td: TensorDictBase) -> State:
        shown = entries_of(td.exclude(*MultiAgent.keys))
        return {
            self._inner(key): value.unsqueeze(-2) if self._inner(key) != key else value
            for key, value in shown.items()
        }

    def iterator(self) -> Iterator[TensorDictBase]:
        """Yield batches ``[*batch, steps]`` until ``total_frames``."""
        while self.total_frames < 0 or self._frames < self.total_frames:
            yield self.collect()

    @torch.no_grad()
    def collect(self) -> TensorDictBase:
        """Return the next batch, ``[*batch, steps]``; :class:`Diverged` if it is not finite."""
        record, begun = [], []
        for _ in range(self.steps):
            begun.append(self.state[STEP])
            self.state, entries, over = self.advance(self.state)
            record.append(entries)
            if over:
                self.state = self._renew(self.state)
        self._frames += self.requested_frames_per_batch
        self._iter += 1
        batch = self.env.batch_size
        segment = TensorDict(batch_size=[*batch, self.steps], device=self.env.device)
        for key, values in zip(self.keys, zip(*record, strict=True), strict=True):
            segment.set(key, torch.stack(values, len(batch)))
        check_batch(segment.reshape(-1, self.steps), torch.stack(begun).flatten(1) + 1)
        if isinstance(self.view, MultiAgent):
            self.view(segment)
            self.view(segment.get(NEXT, TensorDict()))
        return segment

    def _act(self, state: State) -> State:
        td = TensorDict(batch_size=self.env.batch_size)
        for key in self.reads:
            td.set(key, self._look(state, key))
        action = self.policy(td).get(self.action)
        inner = self._inner(self.action)
        return {**state, inner: action if inner == self.action else action.unsqueeze(-2)}

    def _advance(self, state: State) -> tuple[State, list[Tensor], Tensor]:
        """Return the next state, the entries to keep and whether any episode is over."""
        before = self._act(state)
        reached = self.step(before)
        values = [
            self._look(reached, key[1:]) if key[0] == NEXT else self._look(before, key)
            for key in self.keys
        ]
        after = {key: reached.get(key, value) for key, value in state.items()}
        return after, values, reached[DONE].any()

    def _look(self, state: State, key: Key) -> Tensor:
        """Return an entry in the form that the environment shows."""
        inner = self._inner(key)
        return state[key] if inner == key else state[inner].squeeze(-2)

    def _renew(self, state: State) -> State:
        """Begin new episodes where one is over, ``rows`` at a time; 0: all at once."""
        rows = state[DONE].flatten().nonzero().flatten()
        seeds = self.env.base_env.draw_seeds().view(-1, 1)[rows]
        size = self.rows or len(rows)
        for first in range(0, len(rows), size):
            # Missing episodes are filled by repeating the last one, which is written twice.
            places = torch.arange(first, first + size, device=rows.device).clamp(max=len(rows) - 1)
            self.resets += 1
            renewed = self.renew if self.resets > PLAIN_RESETS else self._renewed
            state = renewed(state, rows[places], seeds[places])
        return state

    def _renewed(self, state: State, rows: Tensor, seeds: Tensor) -> State:
        """Return the state with the first states of new episodes, by their seeds, in some rows."""
        fresh = self.first.begin(seeds)

        def put(value: Tensor, new: Tensor) -> Tensor:
            flat = value.reshape(-1, *new.shape[1:])
            renewed = flat.index_put((rows,), new).view(value.shape)
            return torch.empty_like(value).copy_(renewed)  # other strides need another graph

        return {key: put(value, fresh[key]) for key, value in state.items()}

    def update_policy_weights_(self, *_: Any, **__: Any) -> None:
        """Do nothing: the policy is the caller's own object, in this process."""

    def set_seed(self, seed: int, static_seed: bool = False) -> int:
        """Seed the environment and begin new episodes; return the next seed."""
        following = self.env.set_seed(seed, static_seed)
        self.reset()
        return int(following)

    def state_dict(self) -> OrderedDict[str, Any]:
        """Return the state of the episodes and the number of frames played."""
        state = {".".join(key): value for key, value in self.state.items()}
        return OrderedDict(frames=self._frames, iter=self._iter, resets=self.resets, state=state)

    def load_state_dict(self, state_dict: OrderedDict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self._frames, self._iter = state_dict["frames"], state_dict["iter"]
        self.resets = state_dict["resets"]
        self.state = {tuple(key.split(".")): value for key, value in state_dict["state"].items()}

    def shutdown(
        self, timeout: float | None = None, close_env: bool = True, raise_on_error: bool = True
    ) -> None:
        """Close the environment."""
        if close_env and not self.env.is_closed:
            self.env.close(raise_if_closed=False)


def _view(env: TransformedEnv) -> Any:
    """Return the view of the automated vehicles, if there is one; refuse other transforms."""
    foreign = [t for t in transforms_of(env) if t not in pieces_of(env)]
    strange = [type(t).__name__ for t in foreign if not isinstance(t, VIEWS)]
    if strange:
        raise ConfigError(
            f"the environment has the transforms {', '.join(strange)}, which StringCollector does "
            "not apply; use torchrl.collectors.Collector (training.collector=torchrl)"
        )
    return foreign[0] if foreign else None
