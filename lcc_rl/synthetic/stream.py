"""Synthetic congested traffic with known drivers, the default data source.

A lane of IDM drivers drawn from the calibrated I-80 population drives in platoons behind
stochastic stop-and-go leaders (:class:`lcc_rl.synthetic.stop_and_go.StopAndGo`). The stream is
written in the official NGSIM layout and read back, so that it passes the same reader, extraction
and calibration as the real files. Unlike there, the parameters of every driver are known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.ngsim_writer import write_ngsim
from lcc_rl.data.sources import LoadedEpisodes, NgsimSource
from lcc_rl.drivers.population import DriverPopulation, bootstrap
from lcc_rl.io.files import write_parquet
from lcc_rl.synthetic.lane import Lane, Stream, at_least
from lcc_rl.synthetic.stop_and_go import StopAndGo

FIRST_START = datetime(2005, 1, 1, 12, tzinfo=UTC)


@dataclass(frozen=True)
class StreamSource:
    """Source of synthetic car-following episodes, written in the NGSIM layout and read back.

    The default size gives 270 pairs in three recordings; the I-80 data that the leader is fitted
    to hold 264 pairs in three recordings.

    Args:
        recordings: number of recordings; their leaders, drivers and vehicle ids are independent.
        platoons: platoons per recording.
        vehicles: vehicles per platoon, the stochastic leader included.
        duration_s: range of the time for which a platoon is recorded [s].
        seed: seed of all randomness; the same seed gives the same file, byte for byte.
        noise: relative noise of the drivers' acceleration, see :class:`Lane`.
        leader: the stochastic leader; by default the one fitted to I-80.
        drivers: the population; by default the shipped I-80 drivers.
        criteria: what counts as car following; by default that of the real files.
        keep: path under which the file is kept, compressed where it ends in ``.gz``; by default
            a temporary file is used.

    Raises:
        ConfigError: if an argument is out of range, naming it.
    """

    recordings: int = 3
    platoons: int = 30
    vehicles: int = 4
    duration_s: tuple[float, float] = (60.0, 90.0)
    seed: int = 0
    noise: float = 0.05
    leader: StopAndGo | None = None
    drivers: DriverPopulation | None = None
    criteria: Criteria | None = None
    keep: str | None = None

    def __post_init__(self) -> None:
        at_least("recordings", self.recordings, 1)
        at_least("seed", self.seed, 0)
        self._lane()

    def generate(self) -> Stream:
        """Drive all recordings.

        Raises:
            DataError: if the shipped drivers cannot be read.
        """
        lane, drivers = self._lane(), self.drivers or bootstrap()
        made = [
            lane.drive(drivers, recording_name(index), np.random.default_rng([self.seed, index]))
            for index in range(self.recordings)
        ]
        samples = pd.concat([one.samples for one in made], ignore_index=True)
        return Stream(samples, pd.concat([one.truth for one in made], ignore_index=True))

    def write(self, path: str | Path) -> Stream:
        """Drive all recordings and write them in the official NGSIM layout.

        The truth is written beside the file, ``stream.csv`` getting ``stream_truth.parquet``.

        Returns:
            What was written.

        Raises:
            DataError: if the shipped drivers cannot be read.
            ResultsError: if a file cannot be written.
        """
        stream = self.generate()
        write_ngsim(stream.samples, path)
        write_parquet(stream.truth, truth_path(path))
        return stream

    def load(self) -> LoadedEpisodes:
        """Write the stream, read it back and extract its car-following episodes.

        Raises:
            DataError: if no pair meets the criteria.
            ResultsError: if the file cannot be written.
        """
        with TemporaryDirectory(prefix="lcc_rl_stream_") as folder:
            path = Path(self.keep or Path(folder) / "stream.csv").expanduser()
            self.write(path)
            loaded = NgsimSource(str(path), criteria=self.criteria).load()
        size = f"{self.recordings} recordings of {self.platoons} platoons of {self.vehicles}"
        line = f"synthetic stream: {size} vehicles, seed {self.seed}"
        return replace(loaded, report=[line, *loaded.report])

    def _lane(self) -> Lane:
        leader = self.leader or StopAndGo()
        return Lane(self.platoons, self.vehicles, self.duration_s, leader, self.noise)


def truth_path(path: str | Path) -> Path:
    """Where the ground truth of a stream file lies."""
    path = Path(path)
    return path.with_name(f"{path.name.removesuffix('.gz').removesuffix('.csv')}_truth.parquet")


def recording_name(index: int) -> str:
    """Name of a recording as the reader gives it: its start, an hour after the one before."""
    return (FIRST_START + timedelta(hours=index)).strftime("%Y-%m-%dT%H:%M:%SZ")
