"""Rollouts that keep the graph of gradients, for learning by back-propagation through time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.envs.compiled import Traced
from lcc_rl.envs.step import DONE, TERMINATED, Step, closure, pieces_of, read_before, written
from lcc_rl.functional.layout import reverse
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

ActionFunction = Callable[[Tensor], Tensor]


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
        self.constants = sorted({SEED}.union(*(piece.constants for piece in inside)))
        read = read_before(inside) & known
        self.moving = sorted((kept | read | {STEP}) - {ACTION, *self.constants})
        self.recorded = sorted(kept)
        self.advance = Traced(self._advance, "the simulator", compiled)
        self.pull = Traced(self._pull, "its gradient", compiled)

    def start(self, given: TensorDictBase | None = None) -> State:
        """Reset the environment, to given choices or drawn ones; return the first moment."""
        td = self.env.reset(given)
        self.types = [(td.get(key).shape[1:], td.get(key).dtype) for key in self.moving]
        self.sizes = [shape.numel() for shape, _ in self.types]
        return {key: td.get(key) for key in (*self.constants, *self.moving)}

    @torch.no_grad()
    def skip(self, state: State, steps: int) -> State:
        """Return the moment some steps later; the action is zero, and no gradient is kept."""
        action = self.env.full_action_spec[ACTION].zero()
        row, held = self._packed(state), [state[key] for key in self.constants]
        for _ in range(steps):
            row, _ = self.advance(row, action, *held)
        return state | self._entries(row)

    def play(
        self, state: State, network: ActionFunction, steps: int, shifts: Tensor | None = None
    ) -> tuple[State, State]:
        """Let a policy drive for some steps.

        Args:
            state: the moment to begin at, to which no gradient flows back.
            network: from observation ``[…, A, observations]`` to action in [−1, 1], for each
                vehicle by itself.
            steps: how many.
            shifts: added to the actions, which stay in [−1, 1], ``[steps, batch, A, 1]``.

        Returns:
            The last moment, and the :attr:`recorded` entries of each moment, ``[batch, steps + 1,
            …]``, those of the last one with action zero.
        """

        def act(seen: Tensor, step: Any) -> Tensor:
            action = network(seen)
            return action if shifts is None else (action + shifts[step]).clamp(-1.0, 1.0)

        held, taken = [state[key] for key in self.constants], []
        with torch.no_grad():
            passed, seen = [self._packed(state)], [state[OBSERVATION]]
            for step in range(steps):
                taken.append(act(seen[-1], step).contiguous())
                row, reached = self.advance(passed[-1], taken[-1], *held)
                passed.append(row)
                seen.append(reached)
            rows, actions, known = (torch.stack(x) for x in (passed, taken, seen[:-1]))
        # What was seen is known: the policy is differentiated for all steps at once.
        if torch.is_grad_enabled() and (again := act(known.requires_grad_(), ...)).requires_grad:
            slopes = torch.autograd.grad(
                again.sum(), known, retain_graph=True, allow_unused=True, materialize_grads=True
            )
            rows, actions = _Motion.apply(again, rows, actions, *slopes, held, self.pull)
        moments = self._entries(rows)
        last = state | {key: value[-1] for key, value in moments.items()}
        moments |= {key: state[key].expand(steps + 1, *state[key].shape) for key in self.constants}
        moments[ACTION] = torch.cat([actions, torch.zeros_like(actions[:1])])
        return last, {key: moments[key].transpose(0, 1) for key in self.recorded}

    def assemble(self, record: State) -> TensorDictBase:
        """Make the record of a play a rollout ``[batch, steps]`` and apply the remaining pieces."""
        data = TensorDict(batch_size=record[ACTION][:, :-1].shape[:2])
        for key, column in record.items():
            data.set(key, column[:, :-1])
            data.set((NEXT, *key), column[:, 1:])
        step = data.get((NEXT, *STEP))
        data.set((NEXT, *DONE), step >= self.horizon)
        data.set((NEXT, *TERMINATED), torch.zeros_like(step, dtype=torch.bool))
        for piece in self.after:
            with torch.set_grad_enabled(torch.is_grad_enabled() and piece in self.graded):
                piece(data if isinstance(piece, StepTransform) else data.get(NEXT))
        return data

    def _packed(self, state: State) -> Tensor:
        """Return the moving entries of a moment as one tensor, ``[numbers, batch]``."""
        return torch.cat([reverse(state[key]).flatten(0, -2) for key in self.moving])

    def _entries(self, rows: Tensor) -> State:
        """Return the moving entries of packed moments, ``[*moments, numbers, batch]``."""
        entries, lead = {}, rows.ndim - 2
        parts = zip(self.moving, self.types, rows.split(self.sizes, -2), strict=True)
        for key, (shape, dtype), part in parts:
            entry = part.unflatten(-2, tuple(shape)[::-1]).to(dtype)
            entries[key] = entry.permute(*range(lead), *reversed(range(lead, entry.ndim)))
        return entries

    def _advance(self, row: Tensor, action: Tensor, *held: Tensor) -> Sequence[Tensor]:
        """Return the next moment and its observation; what is held are the constants."""
        before = dict(zip(self.constants, held, strict=True)) | self._entries(row)
        reached = self.step({**before, ACTION: action})
        return self._packed(reached), reached[OBSERVATION].contiguous()

    def _pull(
        self,
        later: Tensor,
        by_row: Tensor,
        by_action: Tensor,
        slope: Tensor,
        row: Tensor,
        action: Tensor,
        *held: Tensor,
    ) -> Sequence[Tensor]:
        """Return the gradient by a moment and by its action.

        Args:
            later: the gradient by the next moment.
            by_row, by_action: what does not come through the next moment.
            slope: the derivative of the action by the observation.
            row, action, held: as for :meth:`_advance`.
        """
        with torch.enable_grad():
            given = row.detach().requires_grad_(), action.detach().requires_grad_()
            found = torch.autograd.grad(self._advance(*given, *held)[:1], given, [later])
        by_action = by_action + found[1]
        at = sum(self.sizes[: self.moving.index(OBSERVATION)])
        seen = reverse(slope * by_action).flatten(0, -2)
        parts = (found[0] + by_row).split([at, len(seen), len(row) - at - len(seen)])
        return torch.cat([parts[0], parts[1] + seen, parts[2]]), by_action


class _Motion(torch.autograd.Function):
    """The record of a play as a function of its actions, differentiated step by step."""

    @staticmethod
    def forward(
        ctx: Any,
        again: Tensor,
        rows: Tensor,
        actions: Tensor,
        slopes: Tensor,
        held: Sequence[Tensor],
        pull: Traced,
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(slopes, rows, actions, *held)
        ctx.pull = pull
        return rows.clone(), actions.clone()

    @staticmethod
    def backward(ctx: Any, by_rows: Tensor, by_actions: Tensor) -> tuple[Tensor | None, ...]:
        slopes, rows, actions, *held = ctx.saved_tensors
        columns = by_rows.contiguous(), by_actions.contiguous(), slopes, rows, actions
        later, found = columns[0][-1], torch.empty_like(actions)
        for step in reversed(range(len(actions))):
            given = (column[step] for column in columns)
            later, found[step] = ctx.pull(later, *given, *held)
        return found, None, None, None, None, None


def _is_recurrent(piece: Piece) -> bool:
    """Whether a piece reads what it wrote one moment before."""
    return bool({key for late, key in piece.needs if not late} & written([piece]))
