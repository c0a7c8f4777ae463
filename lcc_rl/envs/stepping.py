"""The pieces of an environment as one function of tensors: a step without any bookkeeping."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.exc import InductorError
from torchrl.envs import TransformedEnv

from lcc_rl.envs.unroll import as_function, closure
from lcc_rl.pieces.base import NEXT, SEED, STEP, arrived, as_tuple

log = logging.getLogger("lcc_rl")

COMPILER_ERRORS = (TorchDynamoException, InductorError)
ACTION, DONE, TERMINATED, TRUNCATED = ("action",), ("done",), ("terminated",), ("truncated",)
State = dict[tuple[str, ...], Tensor]


class Segments:
    """Plays an environment without end and yields segments of so many steps.

    The transitions are those of TorchRL's ``Collector``, an episode that is over being followed
    by a new one. But TensorDicts are made once per segment, not several per step, and hold only
    what is asked for, so that the policy and the physics are what takes the time.

    Args:
        env: the environment, ``[batch]`` episodes side by side.
        policy: writes ``"action"`` into a TensorDict with its ``in_keys``.
        steps: steps of every environment in one segment.
        keys: the entries of a segment, those of the moment reached under ``"next"``.
        compiled: compile the step, policy included; where there is no compiler, one line of the
            log says so and the plain step is used.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: TensorDictModuleBase,
        steps: int,
        keys: Sequence[NestedKey],
        compiled: bool = False,
    ) -> None:
        self.env, self.policy, self.steps = env, policy, steps
        self.reads = [as_tuple(key) for key in policy.in_keys if as_tuple(key) != ACTION]
        self.horizon = env.base_env.horizon
        self.advance: Callable[[State], tuple[State, list[Tensor], Tensor]] = self._advance
        if compiled:
            # One graph for this size: a graph for any size would be slower.
            self.advance = torch.compile(self._advance, dynamic=False)
        self.reset()
        rewards = env.full_reward_spec.keys(True, True)
        known = [*self.state, ACTION, *map(as_tuple, rewards)]
        self.keys = list(dict.fromkeys(leaf for key in keys for leaf in leaves(key, known)))
        wanted = {*map(arrived, self.keys), *self.reads, DONE}
        # Pieces that none of this depends on, which only an evaluation measures, are left out.
        self.pieces = [as_function(piece, True) for piece in closure(list(env.transform), wanted)]

    def reset(self) -> None:
        """Begin new episodes everywhere."""
        self.state = entries(self.env.reset())

    def __iter__(self) -> Segments:
        return self

    @torch.no_grad()
    def __next__(self) -> TensorDictBase:
        """Return the next segment, ``[batch, steps]``."""
        record = []
        for _ in range(self.steps):
            self.state, kept, over = self._attempt(self.state)
            record.append(kept)
            if over:
                self.state = self._renew(self.state)
        batch = self.env.batch_size
        segment = TensorDict(batch_size=[*batch, self.steps], device=self.env.device)
        for key, values in zip(self.keys, zip(*record, strict=True), strict=True):
            segment.set(key, torch.stack(values, len(batch)))
        return segment

    def _advance(self, state: State) -> tuple[State, list[Tensor], Tensor]:
        """Return the moment reached, the entries to keep and whether any episode is over."""
        seen = TensorDict(batch_size=self.env.batch_size)
        for key in self.reads:
            seen.set(key, state[key])
        before = {**state, ACTION: self.policy(seen).get("action")}
        step = state[STEP] + 1
        truncated = step >= self.horizon
        reached: State = {SEED: state[SEED], STEP: step, TRUNCATED: truncated, DONE: truncated}
        reached[TERMINATED] = torch.zeros_like(truncated)
        for piece in self.pieces:
            piece(before, reached)
        kept = [reached[key[1:]] if key[0] == NEXT else before[key] for key in self.keys]
        after = {key: reached.get(key, value) for key, value in state.items()}
        return after, kept, reached[DONE].any()

    def _attempt(self, state: State) -> tuple[State, list[Tensor], Tensor]:
        """Take a compiled step, or a plain one where there is no compiler."""
        try:
            return self.advance(state)
        except COMPILER_ERRORS as error:
            log.info("not compiling the environment: %s", str(error).strip().splitlines()[0])
            self.advance = self._advance
            return self._advance(state)

    def _renew(self, state: State) -> State:
        """Begin a new episode where one is over."""
        moment = TensorDict(batch_size=self.env.batch_size, device=self.env.device)
        for key, value in state.items():
            moment.set(key, value)
        return entries(self.env.maybe_reset(moment))


def leaves(key: NestedKey, known: Sequence[tuple[str, ...]]) -> list[tuple[str, ...]]:
    """Return a key, or the keys of all entries below it, of those known."""
    name, place = arrived(key), as_tuple(key)
    prefix = place[: len(place) - len(name)]
    return [prefix + entry for entry in known if entry[: len(name)] == name]


def entries(td: TensorDictBase) -> State:
    """Return the entries of a moment by their full keys."""
    # Copies: entries that begin as one tensor would cost the compiler a graph of their own.
    return {as_tuple(key): td.get(key).clone() for key in td.keys(True, True)}
