"""The clock: the base environment of every scenario, with time, action and done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from secrets import randbelow
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from tensordict.utils import NestedKey
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, TransformedEnv

from lcc_rl.envs.compiled import compile_settings
from lcc_rl.envs.single import VIEWS
from lcc_rl.envs.step import pieces_of, tick, written
from lcc_rl.errors import LAST_SEED, ConfigError, in_short, require
from lcc_rl.pieces.base import SEED, STEP, Entry, Key, Piece, StepTransform, as_key, require_option


def batch_shape(batch_size: Sequence[int] | int) -> torch.Size:
    """Return the shape of a batch of episodes.

    Raises:
        ConfigError: if it holds no episode or is not of whole numbers.
    """
    try:
        batch = torch.Size([batch_size] if isinstance(batch_size, int) else batch_size)
    except (TypeError, ValueError):
        raise ConfigError(f"batch_size must be whole numbers, got {batch_size!r}") from None
    if any(size < 1 for size in batch):
        raise ConfigError(f"batch_size must hold at least one episode, got {batch_size}")
    return batch


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number of 64 bits and no truth value."""
    integral = isinstance(value, Integral) and not isinstance(value, bool)
    return integral and -(2**63) <= value < 2**63


def checked_seed(seed: Any) -> int | None:
    """Return a seed as an int; None stays None.

    Raises:
        ConfigError: naming the seed and its range.
    """
    if seed is None:
        return None
    if not (is_whole(seed) and 0 <= seed <= LAST_SEED):
        raise ConfigError(f"seed must be a whole number from 0 to {LAST_SEED}, got {seed!r}")
    return int(seed)


class Clock(EnvBase):
    """Counts steps, truncates at the horizon and draws a seed for every episode.

    All random numbers of an episode are functions of its seed (:mod:`lcc_rl.functional.random`),
    so the generator of this class is the only random state of an environment.
    ``env.reset(options={("episode", "seed"): ...})`` replays an episode.

    Args:
        horizon: steps per episode, after which it is truncated.
        batch_size: shape of the batch of episodes.
        actions: shape of each action after the batch dimensions, by key; entries lie in [−1, 1].
        seed: seed of the generator of the episodes' seeds; None: drawn at random.
        device: device of the tensors.

    Raises:
        ConfigError: if the horizon is not positive, the batch holds no episode or is not of whole
            numbers, or the seed is out of range.
    """

    entries = (
        Entry(SEED, "–", "seed of all random numbers of the episode"),
        Entry(STEP, "–", "steps since the start of the episode"),
        Entry("done", "–", "terminated or truncated"),
        Entry("terminated", "–", "a collision ended the episode"),
        Entry("truncated", "–", "the horizon is reached"),
        Entry("automated.action", "–", "action in [−1, 1]"),
    )

    _supports_set_state = True

    def __init__(
        self,
        horizon: int,
        batch_size: Sequence[int] | int = (),
        actions: Mapping[NestedKey, tuple[int, ...]] | None = None,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        require(horizon >= 1, f"horizon must be at least 1 step, got {horizon}")
        batch = batch_shape(batch_size)
        super().__init__(device=device, batch_size=batch)
        self.horizon = horizon
        self.generator = torch.Generator()
        # The members of each group, as in TorchRL's multi-agent environments.
        self.group_map = {
            str(key[0]): [f"{key[0]}_{i}" for i in range(shape[0])]
            for key, shape in (actions or {}).items()
            if not isinstance(key, str)
        }
        count = Unbounded(shape=(*batch, 1), dtype=torch.int64, device=self.device)
        flag = Binary(n=1, shape=(*batch, 1), dtype=torch.bool, device=self.device)
        times = Composite(
            episode=Composite(seed=count, step=count.clone(), shape=batch), shape=batch
        )
        self.observation_spec = times.to(self.device)
        self.state_spec = times.clone().to(self.device)
        action_spec = Composite(shape=batch, device=self.device)
        for key, shape in (actions or {}).items():
            action_spec[key] = Bounded(-1.0, 1.0, shape=(*batch, *shape), device=self.device)
        self.action_spec = action_spec
        self.full_reward_spec = Composite(shape=batch, device=self.device)
        self.full_done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")},
            shape=batch,
            device=self.device,
        )
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        seed = checked_seed(seed)
        # Not from torch's global generator, which starts equally in every process.
        self.generator.manual_seed(randbelow(LAST_SEED + 1) if seed is None else seed)

    def draw_seeds(self) -> torch.Tensor:
        """Draw a seed for a new episode in every place of the batch, ``[*batch, 1]``, int64."""
        shape = (*self.batch_size, 1)
        seeds = torch.randint(2**31, shape, generator=self.generator, dtype=torch.int64)
        return seeds.to(self.device)

    def _reset(self, tensordict: TensorDictBase | None = None, **_: object) -> TensorDictBase:
        options = {} if tensordict is None else tensordict
        seeds, step = options.get(SEED, None), options.get(STEP, None)
        if seeds is None:
            seeds = self.draw_seeds()
        else:
            require_option(SEED, seeds, LAST_SEED + 1)
        return self._moment(seeds, torch.zeros_like(seeds) if step is None else step)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return self._moment(tensordict.get(SEED), tensordict.get(STEP) + 1)

    def _moment(self, seeds: torch.Tensor, step: torch.Tensor) -> TensorDictBase:
        return TensorDict(tick(seeds, step, self.horizon), self.batch_size, device=self.device)


def option_specs(env: TransformedEnv) -> dict[Key, Any]:
    """Return the spec of every option of ``env.reset``."""
    keys = [SEED, *(key for piece in pieces_of(env) for key in piece.reset_options)]
    return {key: env.full_state_spec[key] for key in keys}


class Traffic(TransformedEnv):
    """A clock and the pieces that move the vehicles, as one environment."""

    # Without this, environments around it would draw actions for the clock.
    rand_action = EnvBase.rand_action

    def reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        set_state: bool | None = None,
        **settings: Any,
    ) -> TensorDictBase:
        """Begin new episodes, see TorchRL's ``EnvBase.reset``.

        Args:
            tensordict: a mask ``"_reset"`` of the episodes to begin anew; its state is ignored, as
                by TorchRL from 0.15 on, without ``set_state``.
            set_state: continue from the state in the TensorDict, which must be whole.
            **settings: ``options``, reset options by their keys (docs/entries.md).

        Raises:
            ConfigError: naming the argument, or the entry of the options or the state, at fault.
        """
        return super().reset(tensordict, set_state=bool(set_state), **settings)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        options: Mapping[NestedKey, torch.Tensor] | None = None,
        set_state: bool = False,
        **others: Any,
    ) -> TensorDictBase:
        words = "env.set_seed(…) seeds later episodes, options={('episode', 'seed'): …} those of a"
        require(not others, f"reset takes no {', '.join(others)}; {words} reset")
        start = TensorDict(batch_size=self.batch_size) if tensordict is None else tensordict
        moving = written(piece for piece in pieces_of(self) if isinstance(piece, StepTransform))
        state = sorted({SEED, STEP, *moving})
        missing = [".".join(key) for key in state if start.get(key, None) is None]
        if set_state or len(missing) < len(state):
            require(
                not missing,
                "reset: the TensorDict must hold the whole state of the episodes or nothing of it, "
                f"it lacks {', '.join(missing)}; a seed or a profile is given by reset(options=…)",
            )
        if not set_state:
            start = start.exclude(*state)
            for key, value in self._checked({} if options is None else options).items():
                start.set(key, value)
        return super()._reset(start, set_state=set_state)

    def compile(self, *, warmup: int | None = None, **given: Any) -> Traffic:
        """Compile ``step_and_maybe_reset``, see TorchRL's ``EnvBase.compile``.

        Compiled steps are not checked for NaN, because they cannot raise.
        Settings of pieces are compared at every step only with a ``mode``, a ``backend`` or
        ``options``; otherwise to change one later is an error.
        """
        own = {} if {"mode", "backend", "options"} & set(given) else compile_settings(self.device)
        for piece in pieces_of(self) if own else ():
            piece.fixed = True
        super().compile(warmup=warmup, **{**own, **given})
        return self

    def rand_step(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        """Take a step with a random action; without a TensorDict, reset first."""
        return super().rand_step(self.reset() if tensordict is None else tensordict)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.get(SEED, None) is None or tensordict.get(STEP, None) is None:
            raise ConfigError(
                "a step needs the TensorDict of reset or step_mdp, which holds the state of the "
                f"episodes, got only {', '.join(map(str, tensordict.keys()))}"
            )
        return super()._step(tensordict)

    def _assert_tensordict_shape(self, tensordict: TensorDictBase) -> None:
        size = getattr(tensordict, "batch_size", None)
        if size != self.batch_size:
            raise ConfigError(
                f"expected a TensorDict of {list(self.batch_size)} episodes, as the environment "
                f"has, got {in_short(tensordict) if size is None else list(size)}"
            )
        for key in self.action_keys:
            # Other shapes may broadcast: one action would drive every vehicle. Other types would
            # change the type of observations.
            action, spec = tensordict.get(key, None), self.full_action_spec[key]
            if action is None:
                continue
            # −1 stands for any size: a transform may take several actions in a row.
            sizes = zip(action.shape, spec.shape, strict=False)
            fits = action.ndim == spec.ndim and all(x == y or y < 0 for x, y in sizes)
            if fits and action.dtype == spec.dtype:
                continue
            expected, got = (f"{list(x.shape)} {x.dtype}" for x in (spec, action))
            raise ConfigError(f"{'.'.join(as_key(key))} must be {expected}, got {got}")

    def _checked(self, options: Any) -> dict[Key, torch.Tensor]:
        """Return reset options by their full keys, after a check of names, shapes and types."""
        mapping = isinstance(options, Mapping) or is_tensor_collection(options)
        require(mapping, f"reset: options must be entries by key, got {in_short(options)}")
        leaves = options.items(True, True) if is_tensor_collection(options) else options.items()
        entries, specs = {as_key(key): value for key, value in leaves}, option_specs(self)
        for key, value in entries.items():
            name, names = ".".join(key), ", ".join(".".join(key) for key in specs)
            require(key in specs, f"reset: {name} is no reset option; those that exist: {names}")
            spec = specs[key]
            message = f"reset: {name} must be {list(spec.shape)} {spec.dtype}"
            if not isinstance(value, torch.Tensor):
                raise ConfigError(f"{message}, got {value!r}")
            if value.shape != spec.shape or value.dtype != spec.dtype:
                raise ConfigError(f"{message}, got {list(value.shape)} {value.dtype}")
        return entries

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # TorchRL looks up the shape of every reward here, a twentieth of the time of a step. The
        # shapes of pieces' rewards were checked when the environment was built.
        ours = all(isinstance(x, Piece | VIEWS) for x in self.transform)
        return next_tensordict_out if ours else super()._step_proc_data(next_tensordict_out)

    def double(self) -> Traffic:
        """Refuse: data would have another type than the specs."""
        raise ConfigError("call torch.set_default_dtype before the environment is built")

    half = bfloat16 = double
