"""Synthetic congested traffic with known drivers, the default data source.

IDM drivers from the calibrated I-80 population drive in platoons behind stochastic stop-and-go
leaders (:class:`lcc_rl.synthetic.stop_and_go.StopAndGo`). The stream has the columns and the
rounding of NGSIM files, and the same extraction and calibration apply. Unlike in recorded data,
the parameters of every driver are known.
"""

from __future__ import annotations

from dataclasses import field, replace
from datetime import UTC, datetime, timedelta
from typing import Annotated

import numpy as np
import pandas as pd
from pydantic import Field, InstanceOf

from lcc_rl.data.car_following import Criteria
from lcc_rl.data.sources import LoadedEpisodes, TrajectorySource
from lcc_rl.data.trajectories import (
    FOOT,
    FRAME,
    SAMPLE_KEYS,
    ReadReport,
    Trajectories,
    assembled,
    find_leaders,
)
from lcc_rl.drivers.population import DriverPopulation, bootstrap
from lcc_rl.settings import Increasing, Seed, Settings, Share
from lcc_rl.synthetic.lane import Stream, drive_platoons
from lcc_rl.synthetic.stop_and_go import StopAndGo

Duration = Annotated[float, Field(ge=1.0, le=36_000.0)]
Range = Annotated[tuple[Duration, Duration], Increasing]
FIRST_START = datetime(2005, 1, 1, 12, tzinfo=UTC)


class StreamSource(Settings):
    """Source of synthetic car-following episodes, in the columns and the rounding of NGSIM.

    The default size gives 270 pairs in three recordings; the I-80 data have 264 in three.
    """

    WRITES = ("keep",)  # settings that name a path to write to

    # Recordings with independent leaders, drivers and vehicle ids.
    recordings: Annotated[int, Field(ge=1, le=1000)] = 3
    platoons: Annotated[int, Field(ge=1, le=10_000)] = 30  # successive platoons per recording
    # Vehicles per platoon, including the stochastic leader.
    vehicles: Annotated[int, Field(ge=2, le=1000)] = 4
    duration_s: Range = (60.0, 90.0)  # range of the recorded time of a platoon [s]
    seed: Seed = 0  # seed of the data, independent of the run's seed
    noise: Share = 0.05  # drivers execute a(1 + ξ), ξ ~ U(0, noise) (A18)
    leader: StopAndGo = field(default_factory=StopAndGo)
    drivers: InstanceOf[DriverPopulation] | None = None  # None: the shipped I-80 drivers
    # Criteria of car following; the default is that of real files.
    criteria: Criteria = field(default_factory=Criteria)
    keep: None = None  # no file is written; the setting remains in the hashes of runs

    def generate(self) -> Stream:
        """Simulate all recordings."""
        low, high = (round(value / FRAME) for value in self.duration_s)
        drawn = []
        for index in range(self.recordings):
            generator = np.random.default_rng([self.seed, index])
            drawn.append((generator.integers(low, high + 1, self.platoons), generator))
        drivers = self.drivers or bootstrap()
        made = drive_platoons(self.leader, drivers, self.vehicles, self.noise, drawn)
        starts = (FIRST_START + timedelta(hours=index) for index in range(self.recordings))
        made = [
            Stream(one.samples.assign(recording=name), one.truth.assign(recording=name))
            for name, one in zip((f"{x:%Y-%m-%dT%H:%M:%SZ}" for x in starts), made, strict=True)
        ]
        samples = pd.concat([one.samples for one in made], ignore_index=True)
        return Stream(samples, pd.concat([one.truth for one in made], ignore_index=True))

    def load(self) -> LoadedEpisodes:
        """Generate the stream and extract its car-following episodes.

        Raises:
            DataError: if no pair meets the criteria.
        """
        recorded = as_recorded(self.generate().samples)
        loaded = TrajectorySource(criteria=self.criteria).extracted(recorded)
        size = f"{self.recordings} recordings of {self.platoons} platoons of {self.vehicles}"
        line = f"synthetic stream: {size} vehicles, seed {self.seed}"
        return replace(loaded, report=[line, *loaded.report])


def as_recorded(samples: pd.DataFrame) -> Trajectories:
    """Return samples with the rounding of NGSIM files: three decimals of a foot, in float32.

    Args:
        samples: see :class:`lcc_rl.synthetic.lane.Stream`; recordings are sorted by name.
    """
    columns = {str(name): samples[name].to_numpy() for name in samples if name != "time_s"}
    columns["recording"], names = pd.factorize(columns["recording"])
    ahead = find_leaders(*(columns[key] for key in SAMPLE_KEYS))
    position = columns["position_m"]
    columns["space_headway_m"] = np.where(ahead >= 0, position[ahead] - position, np.nan)
    for name in columns:
        if name.endswith(("_m", "_mps", "_mps2")):
            columns[name] = (np.round(columns[name] / FOOT, 3) + 0.0) * FOOT
    return assembled(columns, list(names), ReadReport(["the stream"], rows_read=len(samples)))
