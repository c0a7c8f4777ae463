"""Synthetic congested traffic with known drivers, the default data source.

A lane of IDM drivers drawn from the calibrated I-80 population drives in platoons behind
stochastic stop-and-go leaders (:class:`lcc_rl.synthetic.stop_and_go.StopAndGo`). The stream has the
columns and the rounding of the official NGSIM layout, in which it can be written, and passes the
same extraction and calibration as the real files. Unlike there, the parameters of every driver are
known.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field, replace
from datetime import UTC, datetime, timedelta
from filecmp import cmp
from os.path import expanduser
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field, InstanceOf

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.ngsim import of_columns
from lcc_rl.data.ngsim_writer import official_columns, write_ngsim
from lcc_rl.data.sources import LoadedEpisodes, episodes_of
from lcc_rl.data.trajectories import FRAME
from lcc_rl.drivers.population import DriverPopulation, bootstrap
from lcc_rl.errors import LARGEST_SIZE, LAST_SEED, ConfigError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import write_parquet
from lcc_rl.io.memory import require_memory
from lcc_rl.settings import Count, Settings, Share, given_as
from lcc_rl.synthetic.lane import Stream, drive_platoons
from lcc_rl.synthetic.stop_and_go import StopAndGo

SAMPLE = 600  # bytes that a sample of a vehicle costs while the stream is made
Duration = Annotated[float, Field(ge=1.0, le=36_000.0)]
Range = Annotated[tuple[Duration, Duration], Field(strict=False)]
Seed = Annotated[int, Field(ge=0, le=LAST_SEED)]
FIRST_START = datetime(2005, 1, 1, 12, tzinfo=UTC)


class StreamSource(Settings):
    """Source of synthetic car-following episodes, in the columns and the rounding of NGSIM.

    The default size gives 270 pairs in three recordings; the I-80 data that the leader is fitted
    to hold 264 pairs in three recordings.
    """

    WRITES = ("keep",)  # settings that name a place to write

    recordings: Count = 3  # their leaders, drivers and vehicle ids are independent
    platoons: Count = 30  # per recording, one after another
    # Per platoon, the stochastic leader included.
    vehicles: Annotated[int, Field(ge=2, le=LARGEST_SIZE)] = 4
    duration_s: Range = (60.0, 90.0)  # of how long a platoon is seen [s]
    seed: Seed = 0  # of the data; the run's own seed leaves them alone
    noise: Share = 0.05  # drivers execute a(1 + ξ), ξ ~ U(0, noise) (A18)
    leader: given_as(StopAndGo) = field(default_factory=StopAndGo)  # type: ignore[valid-type]
    drivers: InstanceOf[DriverPopulation] | None = None  # None: the shipped I-80 drivers
    # What counts as car following; the default is that of real files.
    criteria: given_as(Criteria) = field(default_factory=Criteria)  # type: ignore[valid-type]
    # A new .csv or .csv.gz file to write the stream to, never over another; None: no file.
    keep: Annotated[str, Field(pattern=r"\.csv(\.gz)?$")] | None = None

    def settled(self) -> None:
        low, high = self.duration_s
        if low > high:
            raise ConfigError(f"data.duration_s must be a range, got {low:g} to {high:g} s")

    def generate(self) -> Stream:
        """Simulate all recordings."""
        count, longest = self.recordings * self.platoons * self.vehicles, self.duration_s[1]
        size = f"data: recordings × platoons × vehicles = {count}, up to {longest:g} s each,"
        require_memory({size: count * longest / FRAME * SAMPLE})
        low, high = (round(value / FRAME) for value in self.duration_s)
        drawn = []
        for index in range(self.recordings):
            generator = np.random.default_rng([self.seed, index])
            drawn.append((generator.integers(low, high + 1, self.platoons), generator))
        drivers = self.drivers or bootstrap()
        made = drive_platoons(self.leader, drivers, self.vehicles, self.noise, drawn)
        made = [
            Stream(one.samples.assign(recording=name), one.truth.assign(recording=name))
            for name, one in zip(map(recording_name, range(self.recordings)), made, strict=True)
        ]
        samples = pd.concat([one.samples for one in made], ignore_index=True)
        return Stream(samples, pd.concat([one.truth for one in made], ignore_index=True))

    def write(self, path: str | Path) -> Stream:
        """Generate the stream and write it in the official NGSIM layout.

        The parameters of the drivers are written beside the file: ``stream_truth.parquet`` for
        ``stream.csv``.
            ResultsError: if a file cannot be written.
        """
        stream = self.generate()
        write_stream(stream, path)
        return stream

    def load(self) -> LoadedEpisodes:
        """Generate the stream and extract the car-following episodes that its file would have.

        Raises:
            DataError: if no pair meets the criteria.
            ConfigError: if ``keep`` names a file that holds something else.
            ResultsError: if the file cannot be written.
        """
        stream = self.generate()
        if self.keep is not None:
            with TemporaryDirectory(prefix="lcc_rl_stream_") as folder:
                kept = Path(expanduser(self.keep))
                path = Path(folder) / kept.name
                write_stream(stream, path)
                keep_files({path: kept, truth_path(path): truth_path(kept)})
        trajectories = of_columns(official_columns(stream.samples), "the stream")
        loaded = episodes_of(trajectories, self.criteria, None)
        size = f"{self.recordings} recordings of {self.platoons} platoons of {self.vehicles}"
        line = f"synthetic stream: {size} vehicles, seed {self.seed}"
        return replace(loaded, report=[line, *loaded.report])


def write_stream(stream: Stream, path: str | Path) -> None:
    """Write a stream, and beside it the parameters of its drivers."""
    write_ngsim(stream.samples, path)
    write_parquet(stream.truth, truth_path(path))


def keep_files(files: Mapping[Path, Path]) -> None:
    """Copy files to where nothing stands, or the same already does.

    Raises:
        ConfigError: if one of the places holds something else; then none is written.
    """
    new = {made: place for made, place in files.items() if not place.exists()}
    for made, place in files.items():
        if made not in new and not (place.is_file() and cmp(made, place, shallow=False)):
            raise ConfigError(f"data.keep: {place} exists and holds something else; name a new one")
    for made, place in new.items():
        with atomic_path(place) as temporary:
            copyfile(made, temporary)


def truth_path(path: str | Path) -> Path:
    """Path of the true parameters of a stream file's drivers."""
    path = Path(path)
    return path.with_name(f"{path.name.removesuffix('.gz').removesuffix('.csv')}_truth.parquet")


def recording_name(index: int) -> str:
    """Name of a recording as the reader gives it: its start, one hour apart."""
    return (FIRST_START + timedelta(hours=index)).strftime("%Y-%m-%dT%H:%M:%SZ")
