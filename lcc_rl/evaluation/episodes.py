"""Evaluation with one row per episode: all pairs of profile and driver with the same noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.config.words import RECORDED
from lcc_rl.envs import build_env
from lcc_rl.envs.factory import after_uncounted, moment_bytes
from lcc_rl.envs.inputs import Inputs, build_energy, second_energy
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import require
from lcc_rl.evaluation import rows as of_rows
from lcc_rl.evaluation.foreign import GivenPolicy
from lcc_rl.evaluation.metrics import SERIES, damping_time
from lcc_rl.evaluation.rollout import Player, reset_options
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED, RING
from lcc_rl.pieces.base import SEED
from lcc_rl.pieces.features import CLASS
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.slope import Slope
from lcc_rl.results.measures import FASTER

# Steps of a strategy from which machine code saves more than the 2 to 4 s that it takes once, and
# from which torch's compiler, whose code is three times as fast, does: it takes 10 to 20 s.
ROWWISE_STEPS, COMPILED_STEPS = 150_000, 10_000_000


@dataclass(frozen=True)
class Plan:
    """The episodes of an evaluation in blocks of one size.

    Every profile is paired with every driver; repeats vary slowest, drivers fastest. A block is the
    same, bit for bit, in any shard.

    Args:
        profiles: number of profiles.
        population: number of drivers.
        drivers: number of drivers used, spread evenly; None: all.
        batch_size: largest number of episodes of a block.
        repeats: draws of the noise of every pair.
        shards: number of parts of the blocks.
        shard: index of the part to play.

    Raises:
        ConfigError: if there are more shards than blocks.
    """

    profiles: int
    population: int
    drivers: int | None
    batch_size: int
    repeats: int = 1
    shards: int = 1
    shard: int = 0

    def __post_init__(self) -> None:
        require(
            self.shards <= self.blocks,
            f"evaluation.shards={self.shards}: the {len(self)} episodes are {self.blocks} blocks "
            f"of up to evaluation.batch_size={self.batch_size}",
        )

    @cached_property
    def chosen(self) -> Tensor:
        """The ids of the drivers used."""
        count = min(self.drivers or self.population, self.population)
        return torch.from_numpy(np.linspace(0, self.population - 1, count).round().astype(np.int64))

    def __len__(self) -> int:
        """Return the number of episodes of all shards."""
        return self.profiles * len(self.chosen) * self.repeats

    @property
    def blocks(self) -> int:
        """Number of blocks of all shards."""
        return math.ceil(len(self) / self.batch_size)

    @property
    def size(self) -> int:
        """Episodes of a block; the last one may have fewer."""
        return math.ceil(len(self) / self.blocks)

    @property
    def own(self) -> range:
        """The blocks of this shard."""
        first, end = (self.blocks * shard // self.shards for shard in (self.shard, self.shard + 1))
        return range(first, end)

    def count(self, block: int) -> int:
        """Return the number of episodes of a block."""
        return min(self.size, len(self) - block * self.size)

    def episodes(self, block: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return profile, driver and repeat of each episode of a block, each ``[size]``.

        The last block is padded with its last episode, so that one size is compiled.
        """
        number = torch.arange(self.size).clamp(max=self.count(block) - 1) + block * self.size
        pair, driver = number // len(self.chosen), number % len(self.chosen)
        return pair % self.profiles, self.chosen[driver], pair // self.profiles


def plan_of(cfg: StudyConfig, inputs: Inputs) -> Plan:
    """Return the episodes of a configuration's evaluation."""
    settings, people = cfg.evaluation, len(inputs.population.time_gap)
    sizes = (settings.batch_size, settings.repeats, settings.shards, settings.shard)
    return Plan(len(inputs.evaluation), people, settings.drivers, *sizes)


class Episodes:
    """Plays the episodes of one strategy, block by block.

    An episode's noise depends only on ``seed``, profile, driver and repeat. It is the same for all
    strategies, and the batch size changes rows by rounding only.

    Args:
        inputs: held-out windows and drivers.
        plan: the episodes.
        seed: seed of the noise.
        sample_episodes: number of episodes to keep as time series.
        device: device of the computation.
        compiled: compile the step by torch; None: the way that is fastest for the length of the
            plan with all shards.
    """

    def __init__(
        self,
        strategy: Strategy,
        inputs: Inputs,
        plan: Plan,
        seed: int,
        sample_episodes: int = 0,
        device: str = "cpu",
        compiled: bool | None = None,
    ) -> None:
        self.strategy, self.inputs, self.plan, self.seed = strategy, inputs, plan, seed
        self.cfg, start, self.warm_up = after_uncounted(strategy.cfg.for_any_leader())
        self.begun = start + self.warm_up
        steps, rowwise = len(plan) * self.cfg.scenario.horizon, False
        if compiled is None:
            compiled = steps >= COMPILED_STEPS
            pure = device == "cpu" and not isinstance(strategy.policy, GivenPolicy)  # has a memory
            rowwise = pure and ROWWISE_STEPS <= steps < COMPILED_STEPS
        env = build_env(
            self.cfg, inputs.evaluation, inputs.population, plan.size, 0, device, nominal=True
        )
        pieces = pieces_of(env)
        # Episodes side by side, their steps, and the size of the state of one [bytes].
        self.largest = plan.size, self.cfg.scenario.horizon, moment_bytes(pieces)
        self.energy, self.second = build_energy(self.cfg), second_energy(self.cfg)
        self.slope = next((piece for piece in pieces if isinstance(piece, Slope)), None)
        filtered = self.cfg.scenario.filters.get(AUTOMATED) is not None
        entries = of_rows.FILTER_ENTRIES if filtered else ()
        self.keys = [*of_rows.ROW_KEYS, of_rows.INDEX, CLASS, *entries]
        learned = strategy.policy is not None and self.cfg.evaluation.terms
        self.terms = [x for x in pieces if learned and isinstance(x, RewardTerm)]
        read = (key for term in self.terms for _, key in term.needs)
        keys = list(dict.fromkeys([*self.keys, *read]))
        self.player = Player(env, strategy.policy, keys, strategy.title, compiled, rowwise)
        self.idle = [self.player.idle]
        count = min(sample_episodes, len(plan))
        self.samples = set(np.linspace(0, len(plan) - 1, count).round().astype(int).tolist())
        # Size of their time series in a file, which hardly compress [bytes].
        values = len(self.cfg.scenario.vehicles) * len(SERIES) * of_rows.VALUE_BYTES
        self.sampled = len(self.samples) * (self.cfg.scenario.horizon - self.begun) * values

    def count(self, block: int) -> int:
        """Return the number of episodes of a block."""
        return self.plan.count(block)

    def play(self, block: int) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Play a block.

        Returns:
            One row per episode, and one row per step of its sample episodes.
        """
        plan, inputs, count = self.plan, self.inputs, self.plan.count(block)
        profile, driver, repeat = plan.episodes(block)
        options = reset_options(
            self.player.env, profile, driver, self.seed, plan.population, repeat
        )

        def named(number: int) -> str:
            name, met = inputs.evaluation.names[int(profile[number])], int(driver[number])
            return f"{number} (profile {name}, driver {met}, seed {int(options[SEED][number])})"

        record, alive = self.player.play(options, named)
        counted = {key: x[self.begun - len(alive) :] for key, x in record.items()}
        record = {key: x for key, x in record.items() if key in self.keys}
        crashed = (alive.unsqueeze(-2) & (record["vehicles", "gap"] <= 0.0)).any(0).any(-2)
        braked = of_rows.brakings(record, alive, self.cfg.scenario.vehicles)
        driven = alive[self.begun - self.warm_up :]  # from a handover on, also uncounted steps
        speed = record["vehicles", "speed"][-len(driven) :]
        ahead = of_rows.highest(record)
        record, alive = {key: x[self.begun :] for key, x in record.items()}, alive[self.begun :]
        if self.cfg.scenario.fleet:
            record["vehicles", "length"] = self.energy.lengths(record[CLASS])
        groups = of_rows.grouped(record, self.cfg.scenario.vehicles)
        noted = repeat if plan.repeats > 1 else None
        given = inputs.evaluation, inputs.population, profile, driver, noted
        described = of_rows.describe(self.strategy, *given)
        if not self.player.reads_drivers:
            described[["desired_speed_mps", "time_gap_s"]] = np.float32(np.nan)
        desired = of_rows.desired_speeds(self.strategy, described)
        described[FASTER] = of_rows.leader_faster(inputs.evaluation, profile, desired, self.warm_up)
        time_step = self.cfg.scenario.time_step
        led = inputs.evaluation, profile, self.energy, self.warm_up, self.slope
        leader = of_rows.leader_measures(*led)
        if self.cfg.scenario.road == RING:  # it has no leader
            leader[:] = np.nan
        # The noise of sensors adds energy to the motion of recorded drivers.
        recorded = RECORDED in self.cfg.evaluation.baselines
        args = groups, alive, time_step, self.energy, recorded, self.second, ahead
        measured = of_rows.measures(*args)
        length, free = self.cfg.scenario.vehicle_length, inputs.population.desired_speed[driver]
        measured |= of_rows.traffic(record, alive, length, time_step, free, self.energy)
        for term in self.terms:  # means of a step, sums over vehicles
            values = term.reward(*term.views(*(counted[key] for _, key in term.needs)))
            mean = (values.sum(-2) * alive).sum(0) / alive.sum(0)
            names = (f"mean_reward_{term.name}", f"mean_term_{term.name}")
            measured |= dict(zip(names, (term.weight * mean, mean), strict=True))
        if self.cfg.scenario.road == RING:
            measured["damping_time_s"] = damping_time(speed, driven, time_step)
        rows = pd.concat([described, leader, braked, of_rows.as_frame(measured, crashed)], axis=1)
        rows = rows.iloc[:count]
        inside = [index - block * plan.size for index in sorted(self.samples)]
        inside = [index for index in inside if 0 <= index < count]
        steps = list(of_rows.sample(groups, alive, rows, inside, time_step))
        return rows, pd.concat(steps, ignore_index=True) if steps else pd.DataFrame()


def evaluate(
    strategy: Strategy,
    inputs: Inputs,
    drivers: int | None,
    batch_size: int,
    seed: int,
    sample_episodes: int = 0,
    repeats: int = 1,
    compiled: bool | None = None,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run all episodes of one strategy in memory.

    Args:
        strategy, inputs, seed, sample_episodes, compiled: see :class:`Episodes`.
        drivers: number of drivers used, spread evenly; None: all.
        batch_size: parallel episodes.
        repeats: draws of the noise of every profile and driver.

    Returns:
        One row per episode, and one row per step of the sample episodes.
    """
    people = len(inputs.population.time_gap)
    plan = Plan(len(inputs.evaluation), people, drivers, batch_size, repeats)
    episodes = Episodes(strategy, inputs, plan, seed, sample_episodes, compiled=compiled)
    rows, steps = zip(*map(episodes.play, plan.own), strict=True)
    return pd.concat(rows, ignore_index=True), pd.concat(steps, ignore_index=True)
