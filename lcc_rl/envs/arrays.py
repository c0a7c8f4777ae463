"""Parallel episodes as arrays, the engine of the Gymnasium environments."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.envs.clock import is_whole, option_specs
from lcc_rl.envs.rowwise import Array, Rows, Rowwise
from lcc_rl.envs.step import (
    TERMINATED,
    TRUNCATED,
    Step,
    closure,
    entries_of,
    pieces_of,
    read_before,
)
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.functional.finite import require_finite
from lcc_rl.pieces.base import ACTION, OBSERVATION, REWARD, SEED, STEP, Key, State, as_key
from lcc_rl.pieces.rewards import TERMS, TotalReward

LARGEST_SCALED = 1e6  # exceeds all scaled speeds [m/s], gaps [m] and times [s]


class ArrayEpisodes:
    """Episodes of one automated vehicle, stepped as rows of arrays by :class:`Rowwise`.

    All random numbers of an episode follow from its seed. Each place has its own generator of
    seeds, as an environment of one episode has.

    Args:
        env: an environment in the view of one automated vehicle, ``[n]`` episodes.

    Attributes:
        terms: names of the reward terms.
        observation: the observations, ``[n, entries]``, float32; not changed in place.
        films: recorder of the motion of each place, or None.
    """

    def __init__(self, env: TransformedEnv) -> None:
        self.env, self.count = env, env.batch_size.numel()
        self.films: list[Any] = []
        pieces = closure(pieces_of(env), {OBSERVATION, REWARD, TERMINATED, TRUNCATED})
        self.one_step = Step(pieces, env.base_env.horizon)
        totals = [piece for piece in pieces if isinstance(piece, TotalReward)]
        self.terms = [str(name) for name in totals[-1].terms]
        self.written = [REWARD, TERMINATED, TRUNCATED, *((*TERMS, name) for name in self.terms)]
        first, seed = self._first(pieces), torch.zeros(1, 1, dtype=torch.int64)
        row = self.rows.packed(first)
        self.advance = Rowwise(self._advance, (row, torch.zeros(1, 1)), "a step")
        self.begin = Rowwise(self._begin, (seed,), "a reset")
        self.generators = [torch.Generator() for _ in range(self.count)]
        for generator in self.generators:
            generator.seed()  # at random, until a reset gives a seed
        self.observation = np.zeros((self.count, first[OBSERVATION].shape[-1]), np.float32)
        self.state = np.zeros((self.count, row.shape[-1]))

    def _first(self, pieces: Sequence[Any]) -> State:
        """Return the first state of an episode, and choose the entries that a step reads."""
        with torch.no_grad():
            first = self.one_step.begin(torch.zeros(1, 1, dtype=torch.int64))
        read = read_before(pieces)
        keys = [key for key in first if key in read]
        self.rows = Rows(first, keys)
        self.step_column = sum(self.rows.sizes[: keys.index(STEP)])
        return first

    def _advance(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return state and observation after a step, and the result of :meth:`step`."""
        reached = self.one_step(self.rows.entries(state) | {ACTION: action.unsqueeze(1)})
        observation = reached[OBSERVATION].flatten(1)
        results = [reached[key].flatten(1).to(observation.dtype) for key in self.written]
        total = observation.sum(1, keepdim=True) + results[0]
        finite = (total - total == 0.0).to(observation.dtype)  # False for NaN and infinity
        return self.rows.packed(reached), observation, torch.cat([*results, finite], 1)

    def _begin(self, seeds: Tensor) -> tuple[Tensor, Tensor]:
        first = self.one_step.begin(seeds)
        return self.rows.packed(first), first[OBSERVATION].flatten(1)

    def reset(
        self,
        places: Array,
        seeds: Sequence[int | None] | None = None,
        options: Mapping[str, Any] | None = None,
    ) -> Array:
        """Begin new episodes in some places; nothing changes if an argument is refused.

        Args:
            places: indices of the places.
            seeds: seed of the generator of every place; None: the generator continues.
            options: reset options by their dotted names, such as ``"leader.profile"``: a whole
                number for all episodes, or one for each episode of the batch.

        Returns:
            The observations of all places.

        Raises:
            ConfigError: naming an unknown option, or the range of an option.
        """
        generators = [self.generators[place].clone_state() for place in places]
        for place, generator in zip(places, generators, strict=True):
            if seeds is not None and (seed := seeds[place]) is not None:
                generator.manual_seed(seed)
        drawn = [torch.randint(2**31, (1, 1), generator=x) for x in generators]
        if options:
            every = torch.zeros(self.count, 1, dtype=torch.int64)
            every[places] = torch.cat(drawn)
            moment = entries_of(self.env.reset(options=self._given(every, options)))
            state = self.rows.packed(moment)[places].numpy()
            observation = moment[OBSERVATION[1:]][places].numpy()
        else:
            state, observation = self.begin(torch.cat(drawn).numpy())
        for place, generator in zip(places, generators, strict=True):
            self.generators[place] = generator
        self.state, self.observation = self.state.copy(), self.observation.copy()
        self.state[places], self.observation[places] = state, observation
        self._expose(places, begins=True)
        return self.observation

    def _given(self, seeds: Tensor, options: Mapping[str, Any]) -> TensorDict:
        """Return seeds and reset options as an argument of the TorchRL environment's reset."""
        td = TensorDict({SEED: seeds}, [self.count])
        specs = {".".join(key): spec for key, spec in option_specs(self.env).items()}
        for name, value in options.items():
            if (spec := specs.get(name)) is None:
                raise unknown_name("reset option", str(name), specs)
            array, size = np.asarray(value, np.object_), spec.shape.numel()
            if array.size not in (1, size) or not all(map(is_whole, array.flat)):
                raise ConfigError(f"reset: {name} must be 1 or {size} whole numbers, got {value!r}")
            integers = torch.as_tensor(array.astype(np.int64)).flatten()
            td.set(as_key(name), integers.expand(size).reshape(spec.shape).clone())
        return td

    def step(self, actions: Any, alone: bool = False) -> Array:
        """Advance every episode by a step, including episodes that have ended.

        Args:
            actions: ``[n, 1]``, in [−1, 1].
            alone: whether messages have the shape of one episode's action, ``[1]``.

        Returns:
            ``[n, 3 + terms]``, float32: reward, terminated, truncated and the reward terms.

        Raises:
            ConfigError: if the actions have another shape, or are no real numbers.
            Diverged: if an action, an observation or a reward is not a finite number.
        """
        try:
            array = np.asarray(actions)
        except ValueError:  # rows of different lengths
            array = np.empty(0, np.object_)
        if array.shape != (self.count, 1) or array.dtype.kind not in "fiu":
            wanted, given = ([*shape][alone:] for shape in ((self.count, 1), array.shape))
            raise ConfigError(f"actions must be real numbers {wanted}, got {given} {array.dtype}")
        array = np.ascontiguousarray(array, np.float32)
        step = int(self.state[:, self.step_column].max()) + 1
        if not np.isfinite(array).all():
            self._check({ACTION: array}, step)
        self.state, self.observation, results = self.advance(self.state, array)
        if not results[:, -1].all():
            self._check({OBSERVATION: self.observation, REWARD: results[:, :1]}, step)
        self._expose(range(self.count), begins=False)
        return results[:, :-1]

    def _check(self, named: dict[Key, Array], step: int) -> None:
        numbers = {key: torch.as_tensor(x).unsqueeze(0) for key, x in named.items()}
        require_finite(numbers, torch.ones(1, self.count, 1, dtype=torch.bool), step)

    def _expose(self, places: Iterable[int], begins: bool) -> None:
        for film in [self.films[place] for place in places] if self.films else []:
            film.expose(begins)
