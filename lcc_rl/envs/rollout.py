"""Rollouts that keep the graph of gradients, for learning by back-propagation through time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import TransformedEnv

from lcc_rl.envs.compiled import Traced
from lcc_rl.envs.step import DONE, TERMINATED, Step, closure, pieces_of, read_before, written
from lcc_rl.functional.layout import reverse
from lcc_rl.pieces.base import ACTION, OBSERVATION, SEED, STEP, State, StepTransform, as_key
from lcc_rl.pieces.views import NEXT


class DifferentiableRollout:
    """Plays an environment step by step without its bookkeeping, keeping the graph of gradients.

    The pieces divide in two. Those that the motion itself depends on (everything that reaches the
    policy's observation, or its own past) act in every step; all others, such as time gaps,
    powers and reward terms, are applied once to the whole record, which by the pieces' contract
    gives the same. Pieces that nothing depends on are left out. The entries equal those of
    ``env.rollout``.

    Args:
        env: the environment, without the single-agent view.
        policy: maps an observation ``[…, A, observations]`` to an action in [−1, 1], for each
            vehicle by itself. Parameters that need no gradient yet get none later.
        wanted: entries of the next state that the record must hold, with their gradient.
        observed: further entries that the record must hold; what only they need gets none.
        compiled: compile the step, for a batch size once; where there is no compiler, one line
            of the log says so and the plain step is used.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: nn.Module,
        wanted: Iterable[NestedKey],
        observed: Iterable[NestedKey] = (),
        compiled: bool = False,
    ) -> None:
        self.env, self.horizon = env, env.base_env.horizon
        pieces = pieces_of(env)
        graded = {as_key(key) for key in wanted} | {OBSERVATION}
        every = graded | {as_key(key) for key in observed} | {TERMINATED}
        needed, self.graded = closure(pieces, every), closure(pieces, graded)
        # Those that read what they wrote one moment before.
        recurrent = [x for x in needed if {key for late, key in x.needs if not late} & written([x])]
        inside = closure(needed, {OBSERVATION}, recurrent)
        self.after = [piece for piece in needed if piece not in inside]
        self.step = Step(inside, self.horizon, self.graded)
        entries = {SEED, STEP, ACTION, *written(inside)}
        recorded = entries & (
            {key for piece in self.after for _, key in piece.needs} | every | {STEP, ACTION}
        )
        self.constants = sorted({SEED}.union(*(piece.constants for piece in inside)))
        read = read_before(inside) & entries
        self.moving = sorted((recorded | read | {STEP}) - {ACTION, *self.constants})
        self.recorded = sorted(recorded)
        self.policy = policy
        self.learned = {name: x for name, x in policy.named_parameters() if x.requires_grad}
        tensors = dict(policy.named_parameters()) | dict(policy.named_buffers())
        self.fixed = {name: x for name, x in tensors.items() if name not in self.learned}
        self.advance = Traced(self._advance, "the simulator", compiled)
        self.drive = Traced(self._drive, "the simulator with its policy", compiled)
        self.pull = Traced(self._pull, "its gradient", compiled)

    def start(self, given: TensorDictBase | None = None) -> State:
        """Reset the environment, to given choices or drawn ones; return the first moment."""
        td = self.env.reset(options=given)
        self.types = [(td.get(key).shape[1:], td.get(key).dtype) for key in self.moving]
        self.sizes = [shape.numel() for shape, _ in self.types]
        return {key: td.get(key) for key in (*self.constants, *self.moving)}

    @torch.no_grad()
    def skip(self, state: State, steps: int) -> State:
        """Return the moment some steps later; the action is zero, and no gradient is kept."""
        action = self.env.full_action_spec[ACTION].zero()
        row, constants = self._packed(state), [state[key] for key in self.constants]
        for _ in range(steps):
            (row,) = self.advance(row, action, *constants)
        return state | self._entries(row)

    def play(self, state: State, steps: int, shifts: Tensor | None = None) -> tuple[State, State]:
        """Let the policy drive for some steps.

        Args:
            state: the moment to begin at, to which no gradient flows back.
            steps: how many.
            shifts: added to the actions, which stay in [−1, 1], ``[steps, batch, A, 1]``.

        Returns:
            The last moment, and the :attr:`recorded` entries of each moment, ``[batch, steps + 1,
            …]``, those of the last one with action zero.
        """
        if shifts is None:
            shifts = self.env.full_action_spec[ACTION].zero().expand(steps, -1, -1, -1)
        fixed = [state[key] for key in self.constants] + list(self.fixed.values())
        states, driven = [self._packed(state)], []
        with torch.no_grad():
            for step in range(steps):
                inputs = states[-1], shifts[step], *fixed, *self.learned.values()
                row, action = self.drive(*inputs)
                states.append(row)
                driven.append(action)
            rows, actions = torch.stack(states), torch.stack(driven)
        if torch.is_grad_enabled():
            if self.drive.function is self.drive.plain:  # nor can its gradient be compiled
                self.pull.function = self.pull.plain
            weights = self.learned.values()
            rows, actions = _Motion.apply(self.pull, rows, actions, fixed, shifts, *weights)
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
        columns = zip(self.moving, self.types, rows.split(self.sizes, -2), strict=True)
        for key, (shape, dtype), column in columns:
            entry = column.unflatten(-2, tuple(shape)[::-1]).to(dtype)
            entries[key] = entry.permute(*range(lead), *reversed(range(lead, entry.ndim)))
        return entries

    def _advance(self, row: Tensor, action: Tensor, *constants: Tensor) -> Sequence[Tensor]:
        before = dict(zip(self.constants, constants, strict=True)) | self._entries(row)
        return (self._packed(self.step({**before, ACTION: action})),)

    def _drive(self, row: Tensor, shift: Tensor, *fixed: Tensor) -> Sequence[Tensor]:
        """Return the next moment and the action; fixed: constants, fixed and learned tensors."""
        constants, tensors = fixed[: len(self.constants)], fixed[len(self.constants) :]
        named = dict(zip((*self.fixed, *self.learned), tensors, strict=True))
        observed = self._entries(row)[OBSERVATION].contiguous()
        action = torch.func.functional_call(self.policy, named, (observed,))
        action = (action + shift).clamp(-1.0, 1.0)
        return *self._advance(row, action, *constants), action

    def _pull(
        self,
        later: Tensor,
        by_row: Tensor,
        by_action: Tensor,
        row: Tensor,
        shift: Tensor,
        *fixed: Tensor,
    ) -> Sequence[Tensor]:
        """Return the gradient by a moment, by its shift, and by the learned tensors so far.

        Args:
            later: the gradient by the next moment.
            by_row, by_action: what does not come through the next moment.
            row, shift: as for :meth:`_drive`.
            fixed: likewise, and the gradient by the learned tensors from later moments.
        """
        count = len(self.learned)
        first = len(fixed) - 2 * count
        with torch.enable_grad():
            inputs = [x.detach().requires_grad_() for x in (row, shift, *fixed[first:][:count])]
            reached = self._drive(*inputs[:2], *fixed[:first], *inputs[2:])
            gradients = torch.autograd.grad(
                reached, inputs, [later, by_action], allow_unused=True, materialize_grads=True
            )
        sums = (x + y for x, y in zip(fixed[first + count :], gradients[2:], strict=True))
        return gradients[0] + by_row, gradients[1], *sums


class _Motion(torch.autograd.Function):
    """The record of a play as a function of shifts and learned tensors."""

    @staticmethod
    def forward(
        ctx: Any,
        pull: Traced,
        rows: Tensor,
        actions: Tensor,
        fixed: Sequence[Tensor],
        shifts: Tensor,
        *learned: Tensor,
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(rows, shifts, *fixed, *learned)
        ctx.pull, ctx.learned = pull, len(learned)
        return rows.clone(), actions.clone()

    @staticmethod
    def backward(ctx: Any, by_rows: Tensor, by_actions: Tensor) -> tuple[Tensor | None, ...]:
        rows, shifts, *fixed = ctx.saved_tensors
        columns = by_rows.contiguous(), by_actions.contiguous(), rows, shifts
        later, by_shifts = columns[0][-1], torch.empty_like(shifts)
        sums = [torch.zeros_like(x) for x in fixed[len(fixed) - ctx.learned :]]
        for step in reversed(range(len(shifts))):
            inputs = (column[step] for column in columns)
            later, by_shifts[step], *sums = ctx.pull(later, *inputs, *fixed, *sums)
        return None, None, None, None, by_shifts, *sums
