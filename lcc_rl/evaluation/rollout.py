"""Plays episodes to their end, without resets, and keeps what an evaluation measures."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.envs.finite import ACTION, check_moment
from lcc_rl.envs.step import TERMINATED, Step, closure, entries, pieces_of, written, written_by
from lcc_rl.errors import ConfigError
from lcc_rl.functional.random import MASK, hash_bits
from lcc_rl.pieces.base import SEED, Key, Piece, State, as_key

# Reads and writes a TensorDict; None where a rule drives.
Policy = Callable[[TensorDictBase], TensorDictBase]
Record = dict[Key, Tensor]
PROFILE, START, DRIVER = ("leader", "profile"), ("leader", "start"), ("human", "driver")


def play(
    env: TransformedEnv,
    policy: Policy | None,
    given: TensorDictBase,
    keys: Sequence[Key],
    who: str = "",
) -> tuple[Record, Tensor]:
    """Play all episodes of a batch to the horizon, without resets.

    Args:
        env: the environment, without the single-agent view.
        policy: writes the action; None where none is needed.
        given: reset options.
        keys: entries to keep; those that the environment lacks are left out.
        who: who drives, for messages.

    Returns:
        The entries after every step, ``[time, *batch, …]``, speeds also before the first one,
        ``[time + 1, …]``, and whether each step belongs to a running episode, ``[time, batch, 1]``.

    Raises:
        ConfigError: if a controller takes an action and there is no policy.
        Diverged: if the action, or an entry that is written, is not a number; what the policy and
            every controller wish counts, not what a filter makes of it.
    """
    pieces = pieces_of(env)
    _check_driven(policy, pieces)
    known = written(pieces)
    kept = [key for key in keys if key in known]
    reads = [as_key(key) for key in getattr(policy, "in_keys", [])]
    step = Step(closure(pieces, {*kept, *reads, TERMINATED}), env.base_env.horizon)
    with torch.no_grad():
        state = _begin(env, given, pieces, who)
        record = {key: [state[key]] if key[-1] == "speed" else [] for key in kept}
        running, alive = torch.ones_like(state[TERMINATED]), []
        for _ in range(env.base_env.horizon):
            reached = step.checked({**state, **_action(policy, reads, state, env)}, running, who)
            for key in kept:
                record[key].append(reached[key])
            alive.append(running)
            running = running & ~reached[TERMINATED]
            state = {key: reached.get(key, value) for key, value in state.items()}
    return {key: torch.stack(values) for key, values in record.items()}, torch.stack(alive)


def _begin(
    env: TransformedEnv, given: TensorDictBase, pieces: Sequence[Piece], who: str
) -> dict[Key, Tensor]:
    """Return the first moment of the episodes, whose entries are checked."""
    state = entries(env.reset(given))
    start = [entry for piece in pieces for entry in written_by(piece, state)]
    check_moment(start, state, torch.ones_like(state[TERMINATED]), pieces, who)
    return state


def _check_driven(policy: Policy | None, pieces: Sequence[Piece]) -> None:
    if policy is None and any(key == ACTION for piece in pieces for _, key in piece.sources):
        raise ConfigError(
            "scenario.controllers.automated takes the action of a policy, and there is none: "
            "choose an agent, or another controller"
        )


def _action(
    policy: Policy | None, reads: Sequence[Key], state: State, env: TransformedEnv
) -> State:
    """Return the action of a policy; none where there is no policy."""
    if policy is None:
        return {}
    seen = TensorDict(batch_size=env.batch_size, device=env.device)
    for key in reads or state:
        if key in state:
            seen.set(key, state[key])
    return {ACTION: policy(seen).get(ACTION)}


def reset_options(
    env: TransformedEnv, profile: Tensor, driver: Tensor, seed: int, drivers: int
) -> TensorDict:
    """Build what ``env.reset`` needs to play given profiles to given drivers.

    Args:
        env: the environment, ``[batch]``.
        profile: profile of each episode, ``[batch]``.
        driver: driver that each episode is named after, ``[batch]``.
        seed: seed of the noise.
        drivers: how many drivers there are.
    """
    batch = env.batch_size
    # Every episode gets its own stream. A string begins with the driver it is named after, those
    # of the next ids follow: every driver is met equally often in every place.
    number = profile * drivers + driver
    given = TensorDict(batch_size=batch, device=env.device)
    given.set(SEED, (hash_bits(number + (seed * 0x9E3779B1 & MASK)) >> 1).unsqueeze(-1))
    spec = env.full_state_spec
    known = [as_key(key) for key in spec.keys(True, True)]
    if PROFILE in known:
        given.set(PROFILE, profile.unsqueeze(-1))
        given.set(START, torch.zeros_like(profile).unsqueeze(-1))
    if DRIVER in known:
        place = torch.arange(spec[DRIVER].shape[-2]).unsqueeze(-1)
        given.set(DRIVER, (driver.view(-1, 1, 1) + place) % drivers)
    return given
