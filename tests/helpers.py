"""Shared by the tests: small profiles whose motion is known, and composed environments."""

from __future__ import annotations

import re
import signal
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import Agent, build_agent
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.config.compose import identity, load
from lcc_rl.config.schemas import EvaluateConfig, TrainConfig
from lcc_rl.data.episodes import SCHEMA
from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.drivers.population import bootstrap, from_table
from lcc_rl.envs import Inputs, SingleAgent, build_env, load_inputs
from lcc_rl.errors import Interrupted, LccError
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.evaluation.rollout import Player, Record
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import read_parquet

PLATOON = ("cacc", "ddpg", "deadbeat", "hcfs")
VARIANTS = ("alcc", "reference", "own_energy", "rule", "cbf", "idm", "direct", *PLATOON)
POPULATION = bootstrap()
# Two drivers of each model, all parameters of their own.
MIXED = from_table(
    pd.DataFrame(
        {
            "model": ["idm", "ovm", "fvdm", "gipps"] * 2,
            "desired_speed_mps": [20.0 + i for i in range(8)],
            "time_gap_s": [1.0 + 0.1 * i for i in range(8)],
            "acceleration_mps2": [1.0, None, None, 1.5, 1.2, None, None, 1.8],
            "deceleration_mps2": [1.5, None, None, 3.0, 1.8, None, None, 3.5],
            "leader_deceleration_mps2": [None, None, None, 3.1, None, None, None, 3.3],
            "min_gap_m": [1.5 + 0.1 * i for i in range(8)],
            "sensitivity_hz": [None, 2.0, 0.5, None, None, 2.5, 0.6, None],
            "form": [None, 1.0, 1.2, None, None, 0.8, 1.5, None],
            "speed_gain_hz": [None, None, 0.5, None, None, None, 0.7, None],
        }
    )
)
ACTION, REWARD = ("automated", "action"), ("automated", "reward")
OBSERVATION, TERMS = ("automated", "observation"), ("automated", "reward_terms")
# Sizes of a training of seconds, and of one from a buffer of transitions.
SMALL = (
    *("training.episodes=16", "training.environments=4", "training.checkpoint_every=2"),
    *("training.segment=10", "agent.hidden=[16,16]"),
)
REPLAYED = (*SMALL, "agent.batch_size=32", "agent.buffer_size=200")


def t(*values: float) -> torch.Tensor:
    """Return numbers in double precision."""
    return torch.tensor(values, dtype=torch.float64)


def wavy_profiles(count: int = 4, samples: int = 400) -> Profiles:
    """Leaders between 2 and 14 m/s whose acceleration stays below 2 m/s²."""
    time = torch.arange(samples) * 0.1
    records = [
        8.0 + 4.0 * torch.sin(time / (3.0 + i) + i) + 2.0 * torch.sin(time / 5.0 + 2 * i)
        for i in range(count)
    ]
    names = [f"rec{i % 2}/{i}@0.0s" for i in range(count)]
    return from_records(records, names, [f"rec{i % 2}" for i in range(count)], 0.1)


def followed_profiles() -> Profiles:
    """The same leaders with recorded followers, who drive a second behind, some 20 m away."""
    leaders = wavy_profiles()
    each = [leaders.record(number) for number in range(len(leaders))]
    behind = []
    for speed in each:
        own = torch.cat([speed[:1].expand(10), speed[:-10]])
        relative = (speed - own).double()
        way = torch.cumsum(0.05 * (relative[1:] + relative[:-1]), 0)
        gap = 20.0 + torch.cat([way.new_zeros(1), way])
        behind.append(torch.stack([own, gap.float()], -1))
    return from_records(each, leaders.names, leaders.recordings, 0.1, behind)


def string(pattern: str) -> str:
    """Return the override that makes a pattern the string of vehicles."""
    return f"scenario.string='{pattern}'"


def followers(count: int) -> str:
    """Return the override for so many human drivers behind one automated vehicle."""
    return string(f"automated human*{count}")


@cache
def _loaded(overrides: tuple[str, ...]) -> TrainConfig:
    return load("train", overrides)


def strategies_of(cfg: EvaluateConfig) -> tuple[list[Strategy], Inputs]:
    """Return the strategies of an evaluation, and its inputs."""
    entrants = Entrants(cfg)
    inputs = load_inputs(cfg)
    return entrants.strategies(inputs), inputs


def play(
    env: TransformedEnv, policy: Any, given: TensorDictBase, keys: Sequence[Any], label: str = ""
) -> tuple[Record, torch.Tensor]:
    """Play one batch of episodes to the horizon, see :class:`lcc_rl.evaluation.rollout.Player`."""
    return Player(env, policy, keys, label).play(given)


def composed(*overrides: str) -> TrainConfig:
    """Compose the configuration of a training; the same one is composed only once.

    All seconds count, so that episodes may be short.
    """
    return _loaded(("evaluation.warm_up=0", *overrides))


def compose(variant: str = "alcc", *overrides: str) -> TrainConfig:
    """Compose the configuration of a training with short episodes."""
    return composed(f"variant={variant}", "scenario.horizon=20", *overrides)


def small_env(
    variant: str = "alcc",
    batch_size: Sequence[int] | int = (),
    overrides: Sequence[str] = (),
    seed: int = 0,
    nominal: bool = False,
) -> TransformedEnv:
    """Build an environment on the wavy profiles and the shipped drivers."""
    cfg = compose(variant, *overrides)
    return build_env(cfg, wavy_profiles(), POPULATION, batch_size, seed, nominal=nominal)


def single_env(
    variant: str = "alcc",
    batch_size: Sequence[int] | int = (),
    overrides: Sequence[str] = (),
    seed: int = 0,
) -> TransformedEnv:
    """Build the same with the single-agent view."""
    return small_env(variant, batch_size, overrides, seed).append_transform(SingleAgent())


def make_agent(cfg: TrainConfig) -> Agent:
    """Build the agent of a configuration for the shipped drivers."""
    return build_agent(cfg, POPULATION)


def small_loop(folder: Path, *overrides: str, variant: str = "alcc") -> TrainingLoop[Any]:
    """Build the loop of an agent that trains on the wavy profiles in a folder."""
    cfg = compose(variant, *overrides)
    env = build_env(cfg, wavy_profiles(), POPULATION, cfg.training.environments)
    agent = make_agent(cfg)
    return agent.loop(agent, env, cfg.training, cfg.seed, folder, identity(cfg))


def weights(loop: TrainingLoop[Any]) -> torch.Tensor:
    """All numbers that a policy has learned."""
    return torch.cat([p.detach().flatten() for p in loop.agent.policy.parameters()])


def check_resuming(
    make: Callable[[Path], TrainingLoop[Any]], folder: Path, said: str | None = None
) -> pd.DataFrame:
    """Check that a training of checkpoints every 2 iterations resumes; return its rows.

    With the words of its error it is asked to stop during the third iteration, which it saves.
    """
    whole = make(folder / "whole")
    expected = whole.run()
    first = make(folder / "parts")
    iterate = first.iterate

    def stops(source):
        if first.iteration == 3:
            raise MemoryError  # as sudden as SIGKILL: nothing is saved on the way out
        if said and first.iteration == 2:
            signal.raise_signal(signal.SIGTERM)
        return iterate(source)

    first.iterate = stops
    with pytest.raises(Interrupted if said else MemoryError, match=said):
        first.run()
    second = make(folder / "parts")
    second.load()
    assert second.iteration == (3 if said else 2)  # the last checkpoint
    pd.testing.assert_frame_equal(second.run(), expected, check_exact=True)
    assert torch.equal(weights(second), weights(whole))
    assert repr(second.best) == repr(whole.best)
    stored = read_parquet(folder / "parts" / "training.parquet")
    pd.testing.assert_frame_equal(stored, expected, check_exact=True)
    return expected


def network(cfg: TrainConfig) -> TensorDictBase:
    """Return the untrained policy of a configuration, for the group of automated vehicles."""
    return shared_policy(make_agent(cfg).policy)


def steady(value: float, env: TransformedEnv) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return the policy that always takes one action."""
    shape = env.full_action_spec[ACTION].shape
    return lambda td: td.set(ACTION, torch.full(shape, value))


def slow_but(quick: Iterable[Any], cases: Iterable[Any]) -> list[Any]:
    """Mark the cases of a test as slow but for the quick ones, which ``make test`` runs."""
    quick = list(quick)
    return [
        case
        if case in quick
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]


def check_refused(
    call: Callable[..., object], cases: Iterable[tuple[Any, ...]], error: type[Exception] = LccError
) -> None:
    """Check that a call ends in one line for every case, and name the cases for which it does not.

    Args:
        call: what is called with the items of a case but the last.
        cases: the arguments and, last, the pattern of the error's words.
        error: the class of the error.
    """
    wrong = []
    for *given, words in cases:
        try:
            call(*given)
        except error as caught:
            said = str(caught)
            if not re.search(words, said) or "\n" in said:
                wrong.append(f"{given}: expected {words!r}, got {said!r}")
        else:
            wrong.append(f"{given} is not refused; expected {words!r}")
    assert not wrong, "\n".join(wrong)


def check_episodes(table: pd.DataFrame) -> pd.DataFrame:
    """Return the columns of an episode table in its types, after checking that it is whole.

    The rows of an episode lie together, 0.1 s apart, are of one pair and hold numbers that are
    finite; speeds and gaps are not negative.
    """
    table = table[[*SCHEMA]].reset_index(drop=True).astype({**SCHEMA, "recording": str})
    begins = (table["episode"].diff() != 0).to_numpy()
    assert table.loc[begins, "episode"].is_unique
    groups = table.groupby("episode")
    assert (groups.size() >= 2).all()
    assert (groups[["recording", "follower_id", "leader_id"]].nunique() == 1).all(axis=None)
    assert np.allclose(table["time_s"].diff()[~begins], 0.1, atol=1e-3)
    assert np.isfinite(table.select_dtypes("number")).all(axis=None)
    assert (table.filter(regex="speed_mps|gap_m") >= 0).all(axis=None)
    return table
