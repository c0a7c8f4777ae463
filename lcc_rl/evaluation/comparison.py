"""Strategies on the same held-out windows, in environments that are built once and then played."""

from __future__ import annotations

import hashlib
import logging
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd
import torch

from lcc_rl.config.compose import identity, with_inputs
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.envs.inputs import Inputs
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ResultsError
from lcc_rl.evaluation.cases import Cases
from lcc_rl.evaluation.episodes import Episodes, plan_of
from lcc_rl.evaluation.rollout import warn_of_brakes, warn_of_idle
from lcc_rl.evaluation.rows import nullable
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import IDENTITY, Rows, as_rows, parquet_metadata, read_parquet, write_parquet
from lcc_rl.io.memory import require_memory
from lcc_rl.pieces.knowledge import hears, unconnected
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.runs.progress import BETWEEN_LINES, ProgressReporter
from lcc_rl.runs.states import check_present
from lcc_rl.version import code_version

log = logging.getLogger("lcc_rl")

BLOCKS = "blocks"
BLOCK_MARK = "lcc_rl.block"  # in the metadata of a block's files
Tables = tuple[pd.DataFrame, pd.DataFrame]  # rows, time series of sample episodes


def mark_of(strategy: Strategy) -> str:
    """Return a hash of settings, files, weights and code, on which a strategy's rows depend."""
    digest = hashlib.sha256(f"{code_version()} {strategy.name} {strategy.seed} ".encode())
    digest.update(identity(with_inputs(strategy.cfg)).encode())
    weights = getattr(strategy.policy, "state_dict", None)
    for name, value in sorted(weights().items()) if weights else ():
        digest.update(name.encode())
        plain = value.detach().cpu().contiguous().flatten()
        digest.update(plain.view(torch.uint8).numpy().tobytes())  # NumPy has no bfloat16
    return digest.hexdigest()


class Store:
    """Stores the blocks of several strategies in a folder, or a single block in memory.

    Args:
        folder: folder of the run.
        strategies: the strategies; methods refer to them by index.
        blocks: numbers of the blocks.
    """

    def __init__(self, folder: Path, strategies: Sequence[Strategy], blocks: Sequence[int]) -> None:
        self.folder, self.blocks = folder / BLOCKS, blocks
        self.marks = [mark_of(strategy) for strategy in strategies]
        self.kept: dict[tuple[int, int], Tables] = {}

    def missing(self, strategy: int) -> list[int]:
        """Return the blocks of a strategy that are not played yet."""
        return [block for block in self.blocks if not self._has(strategy, block)]

    def _paths(self, strategy: int, block: int) -> tuple[Path, Path]:
        stem = f"{block:07d}_{strategy:02d}"
        return self.folder / f"{stem}.parquet", self.folder / f"{stem}_steps.parquet"

    def _has(self, strategy: int, block: int) -> bool:
        if len(self.blocks) == 1:
            return (strategy, block) in self.kept
        try:  # the rows are written last
            metadata = parquet_metadata(self._paths(strategy, block)[0])
        except ResultsError:
            return False
        return metadata.get(BLOCK_MARK) == self.marks[strategy]

    def put(self, strategy: int, block: int, tables: Tables) -> None:
        """Store a block of a strategy."""
        if len(self.blocks) == 1:
            self.kept[strategy, block] = tables
            return
        rows, steps = self._paths(strategy, block)
        steps.unlink(missing_ok=True)
        metadata = {BLOCK_MARK: self.marks[strategy]}
        if len(tables[1]):
            write_parquet(tables[1], steps, metadata)
        write_parquet(tables[0], rows, metadata)

    def rows(self) -> Iterator[pd.DataFrame]:
        """Yield the rows of each block, strategy by strategy."""
        for block in self.blocks:
            frames = [self._read(index, block, 0) for index in range(len(self.marks))]
            yield stacked(frames)

    def steps(self) -> pd.DataFrame:
        """Return the time series of all sample episodes, strategy by strategy."""
        every = [(index, block) for index in range(len(self.marks)) for block in self.blocks]
        return stacked([self._read(*key, 1) for key in every])

    def _read(self, strategy: int, block: int, which: int) -> pd.DataFrame:
        """Return the rows (0) or the time series (1) of a block."""
        if len(self.blocks) == 1:
            return self.kept[strategy, block][which]
        path = self._paths(strategy, block)[which]
        return read_parquet(path) if which == 0 or path.is_file() else pd.DataFrame()

    def clear(self) -> None:
        """Remove the folder of the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)


def stacked(frames: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return tables below each other; integers that some of them lack stay integers, with nulls."""
    columns = [set(frame) for frame in frames if len(frame.columns)]
    lacking = set().union(*columns).difference(set.intersection(*columns)) if columns else set()
    parts = [nullable(frame, lacking) for frame in frames]
    return pd.concat(parts, ignore_index=True)


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
        rows = zip(strategies, self.players, strict=True)
        heard = [in_words(x.name) for x, one in rows if hears(pieces_of(one.player.env))]
        if heard:
            log.warning("sensors change no messages, which are read by %s", "; ".join(heard))
        for role in set().union(*(unconnected(pieces_of(x.player.env)) for x in self.players)):
            text = "%s reads messages but is not in scenario.pieces.communication.connected"
            log.warning(text, role)
        warn_of_brakes(one.player for one in self.players)
        if settings.rows == "episodes" and not any(x.player.reads_drivers for x in self.players):
            log.warning("no row depends on the human drivers: drivers=… has no effect")
        count, steps, moment = max((x.largest for x in self.players), key=math.prod)
        size = f"an evaluation of {count} episodes of {steps} steps side by side"
        require_memory({size: count * steps * moment}, cfg.device)
        self.told = time.monotonic()  # time of the last line [s]
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
        idle = [one for player in self.players for one in player.idle]
        for index in range(len(self.strategies)):
            self._play_missing(index, self.players.pop(0), store, folder)
        warn_of_idle(idle)
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
                if where is not None or time.monotonic() - self.told >= BETWEEN_LINES:
                    progress.update(done)
                    self.told = time.monotonic()
