"""The pieces of an environment as one plain function of tensors, for gradients through time."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch._dynamo.exc import TorchDynamoException
from torch._inductor.exc import InductorError
from torchrl.envs import TransformedEnv

from lcc_rl.pieces import Piece
from lcc_rl.pieces.base import NEXT, SEED, STEP, Transition, arrived, as_tuple

log = logging.getLogger("lcc_rl")

COMPILER_ERRORS = (TorchDynamoException, InductorError)
Key = tuple[str, ...]
State = dict[Key, Tensor]
Network = Callable[[Tensor], Tensor]
OBSERVATION, ACTION = ("observation",), ("action",)
DONE, TERMINATED = ("done",), ("terminated",)


class Unrolled:
    """Plays an environment step by step without its bookkeeping, keeping the graph of gradients.

    The pieces divide in two. Those that the motion itself depends on (everything that reaches the
    policy's observation, or its own past) act in every step, as plain functions of tensors; all
    others, such as time gaps, powers and reward terms, are applied once to the whole record,
    which by the pieces' contract gives the same. Pieces that nothing depends on are left out. The
    entries equal those of ``env.rollout``.

    Args:
        env: the environment.
        wanted: entries of the moment reached that the record must hold, with their gradient.
        observed: further entries that the record must hold; what only they need gets none.
        compiled: compile the step, for a batch size once; where there is no compiler, one line
            of the log says so and the plain step is used.
    """

    def __init__(
        self,
        env: TransformedEnv,
        wanted: Iterable[NestedKey],
        observed: Iterable[NestedKey] = (),
        compiled: bool = False,
    ) -> None:
        self.env, self.horizon = env, env.base_env.horizon
        pieces: list[Piece] = list(env.transform)
        graded = {as_tuple(key) for key in wanted} | {OBSERVATION}
        every = graded | {as_tuple(key) for key in observed} | {TERMINATED}
        needed, self.graded = closure(pieces, every), closure(pieces, graded)
        recurrent = [piece for piece in needed if _is_recurrent(piece)]
        inside = closure(needed, {OBSERVATION}, recurrent)
        self.after = [piece for piece in needed if piece not in inside]
        self.steps = [as_function(piece, piece in self.graded) for piece in inside]
        self.carried = {SEED, STEP, *_written(inside)}
        entries = {arrived(key) for piece in needed for key in piece.in_keys} | every
        self.recorded = sorted(entries & {*self.carried, ACTION})
        self.plain = self._advance
        self.advance = torch.compile(self._advance) if compiled else self._advance

    def start(self, given: TensorDictBase | None = None) -> State:
        """Reset the environment, to given choices or drawn ones; return the first moment."""
        td = self.env.reset(given)
        return {key: td.get(key) for key in sorted(self.carried)}

    def _advance(
        self, network: Network, state: State, shift: Tensor | None = None
    ) -> tuple[State, Tensor]:
        """Return the moment reached and the action taken."""
        action = network(state[OBSERVATION])
        if shift is not None:
            action = (action + shift).clamp(-1.0, 1.0)
        before = {**state, ACTION: action}
        reached: State = {SEED: state[SEED], STEP: state[STEP] + 1}
        for piece in self.steps:
            piece(before, reached)
        return {key: reached[key] for key in state}, action

    def play(
        self, state: State, network: Network, steps: int, shifts: Tensor | None = None
    ) -> tuple[State, list[list[Tensor]]]:
        """Let a policy drive for some steps.

        Args:
            state: the moment to begin at.
            network: from observation ``[batch, observations]`` to action in [−1, 1].
            steps: how many.
            shifts: added to the actions, which stay in [−1, 1], ``[steps, batch, 1]``.

        Returns:
            The last moment, and for each moment (``steps`` + 1) the :attr:`recorded` entries,
            those of the last one with action zero.
        """
        record = []
        for step in range(steps):
            shift = None if shifts is None else shifts[step]
            reached, action = self._attempt(network, state, shift)
            record.append(self._entries(state, action))
            state = reached
        record.append(self._entries(state, torch.zeros_like(action)))
        return state, record

    def _attempt(
        self, network: Network, state: State, shift: Tensor | None
    ) -> tuple[State, Tensor]:
        """Take a compiled step, or a plain one where there is no compiler."""
        if self.advance is self.plain:
            return self.plain(network, state, shift)
        try:
            return self.advance(network, state, shift)
        except COMPILER_ERRORS as error:
            log.info("not compiling the simulator: %s", str(error).strip().splitlines()[0])
            self.advance = self.plain
            return self.plain(network, state, shift)

    def assemble(self, record: Sequence[Sequence[Tensor]]) -> TensorDictBase:
        """Make the record of a play a rollout ``[batch, steps]`` and apply the remaining pieces."""
        columns = [torch.stack(values, 1) for values in zip(*record, strict=True)]
        batch = columns[0][:, :-1].shape[:2]
        data = TensorDict(batch_size=batch)
        for key, column in zip(self.recorded, columns, strict=True):
            data.set(key, column[:, :-1])
            data.set((NEXT, *key), column[:, 1:])
        step = data.get((NEXT, *STEP))
        data.set((NEXT, *DONE), step >= self.horizon)
        data.set((NEXT, *TERMINATED), torch.zeros_like(step, dtype=torch.bool))
        for piece in self.after:
            with torch.set_grad_enabled(torch.is_grad_enabled() and piece in self.graded):
                piece(data if isinstance(piece, Transition) else data.get(NEXT))
        return data

    def _entries(self, state: State, action: Tensor) -> list[Tensor]:
        return [action if key == ACTION else state[key] for key in self.recorded]


def _written(pieces: Iterable[Piece]) -> set[Key]:
    constants = {key for p in pieces if isinstance(p, Transition) for key in p.constants}
    return {arrived(key) for piece in pieces for key in piece.out_keys} | constants


def _is_recurrent(piece: Piece) -> bool:
    """Whether a piece reads what it wrote one moment before."""
    if not isinstance(piece, Transition):
        return False
    past = {as_tuple(key) for key in piece.in_keys if as_tuple(key)[0] != NEXT}
    return bool(past & _written([piece]))


def closure(pieces: Sequence[Piece], wanted: set[Key], chosen: Sequence[Piece] = ()) -> list[Piece]:
    """Return the chosen pieces and all that they or the wanted entries depend on, in order."""
    kept = list(chosen)
    keys = set(wanted) | {arrived(key) for piece in kept for key in piece.in_keys}
    grown = True
    while grown:
        more = [p for p in pieces if p not in kept and _written([p]) & keys]
        keys |= {arrived(key) for piece in more for key in piece.in_keys}
        kept, grown = kept + more, bool(more)
    return [piece for piece in pieces if piece in kept]


def as_function(piece: Piece, graded: bool) -> Callable[[State, State], None]:
    """Return a piece as a function that reads two moments and writes into the second."""
    transition = isinstance(piece, Transition)
    sources = [(not transition or as_tuple(k)[0] == NEXT, arrived(k)) for k in piece.in_keys]
    targets = [arrived(key) for key in piece.out_keys]
    constants = piece.constants if isinstance(piece, Transition) else []

    def act(before: State, reached: State) -> None:
        entries = [(reached if late else before)[key] for late, key in sources]
        if not graded:
            entries = [entry.detach() for entry in entries]
        values = piece.compute(*entries)
        values = (values,) if isinstance(values, Tensor) else values
        reached.update(zip(targets, values, strict=True))
        reached.update((key, before[key]) for key in constants)

    return act
