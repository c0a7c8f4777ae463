"""Blocks of rows of an evaluation, stored separately so that it can be resumed."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import pandas as pd

from lcc_rl.config.compose import identity
from lcc_rl.errors import ResultsError
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import parquet_metadata, read_parquet, write_parquet
from lcc_rl.version import __version__

BLOCKS = "blocks"
BLOCK_MARK = "lcc_rl.block"  # in the metadata of a block's files
Tables = tuple[pd.DataFrame, pd.DataFrame]  # rows, time series of sample episodes


def mark_of(strategy: Strategy) -> str:
    """Return a hash of settings, weights and version, on which a strategy's rows depend."""
    digest = hashlib.sha256(f"{__version__} {strategy.name} {strategy.seed} ".encode())
    digest.update(identity(strategy.cfg).encode())
    weights = getattr(strategy.policy, "state_dict", None)
    for name, value in sorted(weights().items()) if weights else ():
        digest.update(name.encode())
        digest.update(value.detach().cpu().numpy().tobytes())
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
            yield pd.concat(frames, ignore_index=True)

    def steps(self) -> pd.DataFrame:
        """Return the time series of all sample episodes, strategy by strategy."""
        every = [(index, block) for index in range(len(self.marks)) for block in self.blocks]
        return pd.concat([self._read(*key, 1) for key in every], ignore_index=True)

    def _read(self, strategy: int, block: int, which: int) -> pd.DataFrame:
        """Return the rows (0) or the time series (1) of a block."""
        if len(self.blocks) == 1:
            return self.kept[strategy, block][which]
        path = self._paths(strategy, block)[which]
        return read_parquet(path) if which == 0 or path.is_file() else pd.DataFrame()

    def clear(self) -> None:
        """Remove the folder of the blocks."""
        shutil.rmtree(self.folder, ignore_errors=True)
