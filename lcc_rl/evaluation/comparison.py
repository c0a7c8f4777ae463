"""Strategies on the same held-out windows, in environments that are built once and then played."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

from lcc_rl.config.compose import identity
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.envs.inputs import Inputs
from lcc_rl.evaluation.blocks import Store
from lcc_rl.evaluation.cases import Cases
from lcc_rl.evaluation.episodes import Episodes, plan_of
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import Rows, as_rows, write_parquet
from lcc_rl.io.memory import require_memory
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.runs.states import check_present

log = logging.getLogger("lcc_rl")

IDENTITY = "lcc_rl.config"  # in the metadata of a table, hash of its configuration


class Comparison:
    """The strategies of an evaluation.

    Their environments are built and checked here, before files are written or a policy is trained.

    Args:
        cfg: configuration of the evaluation.
        inputs: held-out windows and drivers.
        strategies: the strategies in the order of their rows.

    Raises:
        ConfigError: naming the controller and the entry or shape at fault, or the memory that the
            episodes need.
    """

    def __init__(self, cfg: StudyConfig, inputs: Inputs, strategies: Sequence[Strategy]) -> None:
        self.cfg, self.strategies, settings = cfg, strategies, cfg.evaluation
        self.players: list[Episodes | Cases]
        if settings.rows == "vehicles":
            self.blocks = range(1)
            self.players = [Cases(strategy, cfg, inputs) for strategy in strategies]
        else:
            plan = plan_of(cfg, inputs)
            self.blocks = plan.own
            args = (settings.seed, settings.sample_episodes, cfg.device, settings.compiled)
            self.players = [Episodes(strategy, inputs, plan, *args) for strategy in strategies]
        count, steps, moment = max((x.largest for x in self.players), key=math.prod)
        size = f"an evaluation of {count} episodes of {steps} steps side by side"
        require_memory({size: count * steps * moment}, cfg.device)
        self.every, most = 1, settings.sample_mb
        if most is not None:
            self.every = max(1, math.ceil(sum(x.sampled for x in self.players) / (most * 1e6)))
        if self.every > 1:
            log.info(
                "%s keeps every %dth step of the sample episodes, at most %g MB; "
                "evaluation.sample_mb=null keeps all",
                *(STEPS, self.every, most),
            )

    def play(self, folder: Path) -> Rows:
        """Play the episodes and write their rows and sample time series; call it once.

        Several blocks are written one by one, and those in the folder are not played again.

        Returns:
            The rows; many rows as a dataset, which is read on demand.
        """
        metadata = {IDENTITY: identity(self.cfg)}
        store = Store(folder, self.strategies, self.blocks)
        for index in range(len(self.strategies)):
            self._play_missing(index, self.players.pop(0), store, folder)
        check_present(folder)
        write_parquet(store.steps(), folder / STEPS, metadata)
        # Last, because it marks a finished run.
        write_parquet(store.rows(), folder / EPISODES, metadata)
        store.clear()
        return next(store.rows()) if len(self.blocks) == 1 else as_rows(folder / EPISODES)

    def _play_missing(
        self, index: int, player: Episodes | Cases, store: Store, folder: Path
    ) -> None:
        """Play the blocks of a strategy that are not stored yet."""
        name, missing = self.strategies[index].name, store.missing(index)
        if not missing:
            return
        counts = {block: player.count(block) for block in self.blocks}
        done = sum(counts.values()) - sum(counts[block] for block in missing)
        if done:
            there = len(counts) - len(missing)
            log.info("%s: %d of %d blocks exist already", name, there, len(counts))
        where = folder if len(self.blocks) > 1 else None
        title = f"evaluate {in_words(name)} ({index + 1} of {len(self.strategies)})"
        with ProgressReporter(title, sum(counts.values()), "episode", done, where) as progress:
            for block in missing:
                rows, steps = player.play(block)
                if self.every > 1 and len(steps):
                    number = (steps["time_s"] / self.cfg.scenario.time_step).round() - 1
                    steps = steps[number % self.every == 0]
                store.put(index, block, (rows, steps))
                done += counts[block]
                if where is not None:
                    progress.update(done)
