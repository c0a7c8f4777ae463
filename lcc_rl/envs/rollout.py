"""Rollouts that keep the graph of gradients, for learning by back-propagation through time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.envs.compiled import Compiled
from lcc_rl.envs.step import DONE, TERMINATED, Step, closure, pieces_of, read_before, written
from lcc_rl.pieces.base import (
    ACTION,
    OBSERVATION,
    SEED,
    STEP,
    Piece,
    State,
    StepTransform,
    as_key,
)
from lcc_rl.pieces.views import NEXT

Network = Callable[[Tensor], Tensor]


class DifferentiableRollout:
    """Plays an environment step by step without its bookkeeping, keeping the graph of gradients.

    The pieces divide in two. Those that the motion itself depends on (everything that reaches the
    policy's observation, or its own past) act in every step; all others, such as time gaps,
    powers and reward terms, are applied once to the whole record, which by the pieces' contract
    gives the same. Pieces that nothing depends on are left out. The entries equal those of
    ``env.rollout``.

    Args:
        env: the environment, without the single-agent view.
        wanted: entries of the next state that the record must hold, with their gradient.
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
        pieces = pieces_of(env)
        graded = {as_key(key) for key in wanted} | {OBSERVATION}
        every = graded | {as_key(key) for key in observed} | {TERMINATED}
        needed, self.graded = closure(pieces, every), closure(pieces, graded)
        recurrent = [piece for piece in needed if _is_recurrent(piece)]
        inside = closure(needed, {OBSERVATION}, recurrent)
        self.after = [piece for piece in needed if piece not in inside]
        self.step = Step(inside, self.horizon, self.graded)
        known = {SEED, STEP, ACTION, *written(inside)}
        kept = known & (
            {key for piece in self.after for _, key in piece.needs} | every | {STEP, ACTION}
        )
        # A compiled step takes its time for every entry that it returns: only those that are used.
        self.constants = sorted({SEED}.union(*(piece.constants for piece in inside)))
        read = read_before(inside) & known
        self.moving = sorted((kept | read | {STEP}) - {ACTION, *self.constants})
        self.recorded = sorted(kept)
        self.advance = Compiled(self._advance, "the simulator", compiled)

    def start(self, given: TensorDictBase | None = None) -> State:
        """Reset the environment, to given choices or drawn ones; return the first moment."""
        td = self.env.reset(given)
        return {key: td.get(key) for key in (*self.constants, *self.moving)}

    def _advance(self, state: State, action: Tensor) -> State:
        """Return what of the next state differs from one step to the next."""
        reached = self.step({**state, ACTION: action})
        return {key: reached[key] for key in self.moving}

    @torch.no_grad()
    def skip(self, state: State, steps: int) -> State:
        """Return the moment some steps later; the action is zero, and no gradient is kept."""
        action = self.env.full_action_spec[ACTION].zero()
        for _ in range(steps):
            state = state | self.advance(state, action)
        return state

    def play(
        self, state: State, network: Network, steps: int, shifts: Tensor | None = None
    ) -> tuple[State, list[list[Tensor]]]:
        """Let a policy drive for some steps.

        Args:
            state: the moment to begin at.
            network: from observation ``[batch, A, observations]`` to action in [−1, 1].
            steps: how many.
            shifts: added to the actions, which stay in [−1, 1], ``[steps, batch, A, 1]``.

        Returns:
            The last moment, and for each moment (``steps`` + 1) the :attr:`recorded` entries,
            those of the last one with action zero.
        """
        record = []
        for step in range(steps):
            # Not compiled: in a compiled graph with its gradient, ReLU is many times slower.
            action = network(state[OBSERVATION])
            if shifts is not None:
                action = (action + shifts[step]).clamp(-1.0, 1.0)
            record.append(self._entries(state, action))
            # The first moment carries no gradient; compiled, it would need a graph of its own.
            state = state | (self.advance if step else self._advance)(state, action)
        record.append(self._entries(state, torch.zeros_like(action)))
        return state, record

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
                piece(data if isinstance(piece, StepTransform) else data.get(NEXT))
        return data

    def _entries(self, state: State, action: Tensor) -> list[Tensor]:
        return [action if key == ACTION else state[key] for key in self.recorded]


def _is_recurrent(piece: Piece) -> bool:
    """Whether a piece reads what it wrote one moment before."""
    return bool({key for late, key in piece.needs if not late} & written([piece]))
