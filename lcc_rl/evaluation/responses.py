"""Policy maps: what a strategy does at each gap and relative speed."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import NamedTuple

import pandas as pd
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from lcc_rl.data.profiles import Profiles, from_records
from lcc_rl.envs import build_env
from lcc_rl.envs.step import Step, entries, pieces_of, tick
from lcc_rl.evaluation.episodes import any_leader
from lcc_rl.evaluation.rollout import ACTION, reset_options
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.string import entries_ahead
from lcc_rl.pieces import StringMotion
from lcc_rl.pieces.base import SEED, Piece, State
from lcc_rl.pieces.controllers import Population
from lcc_rl.pieces.hybrid import HYBRID
from lcc_rl.pieces.string import LEADER_SPEED

SPEED, GAP, RELATIVE = (("vehicles", name) for name in ("speed", "gap", "relative_speed"))
ACCELERATION, WINNER = ("vehicles", "acceleration"), (HYBRID, "winner")
INDEX = (AUTOMATED, "index")


class Situation(NamedTuple):
    """Starts of episodes, each ``[episodes, 1]``: speed, speed ahead [m/s] and gap [m]."""

    speed: Tensor
    ahead: Tensor
    gap: Tensor


def responses(
    strategy: Strategy,
    population: Population,
    speeds: Sequence[float],
    gaps: Sequence[float],
    relative_speeds: Sequence[float],
) -> pd.DataFrame:
    """Return what a strategy's first automated vehicle does in the first step of episodes.

    Every episode begins at another gap and relative speed. All else is steady: vehicles ahead keep
    their speed, those behind follow at the vehicle's own, and memory, messages and previews hold
    the present. Filters and limits act as in an evaluation.

    Args:
        strategy: the strategy.
        population: the human drivers; those behind are its first ones.
        speeds: of the vehicle [m/s].
        gaps: to the vehicle ahead [m].
        relative_speeds: v_ahead − v [m/s]; those that would need a negative speed are left out.

    Returns:
        One row per gap, speed and relative speed: the executed acceleration [m/s²] and, for a
        hybrid, ``winner``: 0 for the rule, 1 for the policy.
    """
    pairs = torch.tensor([(v, x) for v in speeds for x in relative_speeds if v + x >= 0.0])
    place = torch.cartesian_prod(torch.tensor(gaps), torch.arange(len(pairs)).float())
    gap, profile = place[:, :1], place[:, 1].long()
    speed, relative = pairs[profile].split(1, -1)
    scenario = strategy.cfg.scenario
    records = [torch.full((scenario.horizon + 1,), v) for v in pairs.sum(-1).tolist()]
    names = [f"leader {number}" for number in range(len(records))]
    leaders = from_records(records, names, names, scenario.time_step)
    situation = Situation(speed, speed + relative, gap)
    before, reached = _step(strategy, population, leaders, profile, situation)
    own = before.get(INDEX)[..., :1].unsqueeze(-1)
    entries_of = {
        "speed_mps": speed,
        "gap_m": gap,
        "relative_speed_mps": relative,
        "acceleration_mps2": reached[ACCELERATION].gather(-2, own),
    }
    if WINNER in reached:
        entries_of["winner"] = reached[WINNER][..., :1, :]
    columns = {name: entry.flatten().numpy() for name, entry in entries_of.items()}
    return pd.DataFrame({"strategy": strategy.name, **columns})


def _step(
    strategy: Strategy,
    population: Population,
    leaders: Profiles,
    profile: Tensor,
    situation: Situation,
) -> tuple[TensorDictBase, State]:
    cfg, people = any_leader(strategy.cfg), len(population.time_gap)
    env = build_env(cfg, leaders, population, len(profile), 0, "cpu", nominal=True)
    given = reset_options(env, profile, torch.zeros_like(profile), cfg.seed, people)
    before = _begin(pieces_of(env), given, cfg.scenario.horizon, situation)
    policy = strategy.policy
    if isinstance(policy, nn.Module):
        policy = deepcopy(policy).to("cpu")
    with torch.no_grad():
        if policy is not None:
            before.set(ACTION, policy(before).get(ACTION))
        return before, Step(pieces_of(env), cfg.scenario.horizon)(entries(before))


def _begin(
    pieces: Sequence[Piece],
    given: TensorDictBase,
    horizon: int,
    situation: Situation,
) -> TensorDictBase:
    start: TensorDictBase = TensorDict(batch_size=given.batch_size)
    seeds = given.get(SEED)
    for key, value in tick(seeds, torch.zeros_like(seeds), horizon).items():
        start.set(key, value)
    for piece in pieces:
        if isinstance(piece, StringMotion):
            _place(piece, given, start, situation)
        else:
            start = piece._reset(given, start)
    return start


def _place(
    motion: StringMotion,
    given: TensorDictBase,
    start: TensorDictBase,
    situation: Situation,
) -> None:
    leader = start.get(LEADER_SPEED, None)
    if leader is not None:
        start.set(LEADER_SPEED, situation.speed)
    motion.begin(given, start)
    if leader is not None:
        start.set(LEADER_SPEED, leader)
    count = len(motion.string)
    places, own = torch.arange(count).unsqueeze(-1), start.get(INDEX)[..., :1].unsqueeze(-1)
    # On a ring nobody is ahead of all; the vehicle ahead alone drives otherwise.
    others = places == (own - 1) % count if motion.string.ring else places < own
    speed, ahead, gap = (entry.unsqueeze(-1) for entry in situation)
    speeds = torch.where(others, ahead, speed)
    start.set(SPEED, speeds)
    start.set(GAP, torch.where(places == own, gap, start.get(GAP)))
    start.set(RELATIVE, entries_ahead(leader, speeds) - speeds)
