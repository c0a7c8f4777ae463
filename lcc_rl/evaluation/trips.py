"""Energy of trips: recorded speeds, with or without the grade of the road."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from os import PathLike, fspath

import numpy as np
import pandas as pd
import torch

from lcc_rl.config import load, quoted
from lcc_rl.config.words import top_key
from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.speed_records import Drive, read_drives
from lcc_rl.energy import EnergyModel
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import Concern, require
from lcc_rl.evaluation.metrics import KILO

log = logging.getLogger("lcc_rl")

BLOCK = 10  # records whose energies are computed together; more exceed the processor's cache
WORKED = ("energy", "leader", "scenario", "trust")
KWH = 3600.0  # [kJ]


def trip_energies(
    path: str | PathLike | Sequence[str | PathLike], overrides: Sequence[str] = ()
) -> pd.DataFrame:
    """Return the energy of recorded trips, and log lines on the data.

    Speeds are interpolated to ``scenario.time_step``, as those of leaders in an evaluation.

    Args:
        path: a .csv or .parquet table of many trips, files with one trip each, a folder, a pattern,
            or several of these.
        overrides: the energy model, columns and units: ``["energy=fuel", "leader.columns.drive=id",
            "leader.units.speed=km/h", "leader.columns.grade=slope", "leader.units.grade=%"]``.

    Returns:
        A row per trip, sorted by name: ``trip``, ``parts`` (records that holes divide it into),
        ``duration_s``, ``distance_km``, ``energy_kj`` as drawn and ``net_energy_kj``, less the gain
        of kinetic energy; of the energy drawn ``energy_kwh`` and ``kwh_per_100km``, with fuel also
        ``fuel_l``, ``co2_g``, ``l_per_100km`` and ``co2_g_per_km``.

    Raises:
        LccError: for any error in settings or files, in one line.
    """
    for word in overrides:
        require(top_key(word) in WORKED, f"{word} has no effect on the energy of given trips")
    names = [path] if isinstance(path, (str, PathLike)) else [*path]
    listed = ",".join(quoted(fspath(name)) for name in names)
    words = ["variant=direct", "leader=drives", f"leader.path=[{listed}]", *overrides]
    cfg = load("evaluate", words)
    models, step = build_energy(cfg).models, cfg.scenario.time_step
    require(len(models) == 1, "energy: a mixture has several models; choose one, such as fuel")
    source = cfg.leader.made(DriveLeaders)
    drives, lines = read_drives(source.path, source.columns, step, source.plausible, source.units)
    for line in lines:
        log.log(logging.WARNING if isinstance(line, Concern) else logging.INFO, line)
    blocks = (drives[first : first + BLOCK] for first in range(0, len(drives), BLOCK))
    rows = pd.concat([_energies(block, models[0], step) for block in blocks])
    return _per_distance(rows.groupby("trip").sum().reset_index(), models[0])


def _energies(drives: Sequence[Drive], model: EnergyModel, time_step: float) -> pd.DataFrame:
    """Return duration, distance and energies of records, as ``energy_measures`` does."""
    whole = torch.cat([drive.values for drive in drives])
    ends = np.cumsum([len(drive.values) for drive in drives])
    first, last = np.append(0, ends[:-1]), ends - 1
    speed, own = whole[:, 0], model if whole.shape[1] == 1 else model.with_grade(whole[:-1, 1])
    power = own.power(speed[:-1], speed.diff() / time_step).numpy()
    power[last[:-1]] = 0.0  # from one record to the next
    drawn = KILO * time_step * np.add.reduceat(power, first, dtype=np.float64)
    ends_of = speed[np.stack([first, last])].double()
    gained = KILO * model.stored_energy(ends_of).diff(dim=0)[0].numpy()
    total = np.add.reduceat(speed.numpy(), first, dtype=np.float64)
    way = time_step * (total - 0.5 * ends_of.sum(0).numpy())
    return pd.DataFrame(
        {
            "trip": [drive.drive for drive in drives],
            "parts": 1,
            "duration_s": time_step * (last - first),
            "distance_km": KILO * way,
            "energy_kj": drawn,
            "net_energy_kj": drawn - gained,
        }
    )


def _per_distance(trips: pd.DataFrame, model: EnergyModel) -> pd.DataFrame:
    """Return trips with their energy in all units, and per distance; NaN for a vehicle at rest."""
    way = trips["distance_km"].where(trips["distance_km"] > 0.0)
    trips["energy_kwh"] = trips["energy_kj"] / KWH
    trips["kwh_per_100km"] = 100.0 * trips["energy_kwh"] / way
    if model.heating_value:
        drawn = torch.from_numpy(trips["energy_kj"].to_numpy() / KILO)
        trips["fuel_l"], trips["co2_g"] = (x.numpy() for x in model.burnt(drawn))
        trips["l_per_100km"] = 100.0 * trips["fuel_l"] / way
        trips["co2_g_per_km"] = trips["co2_g"] / way
    return trips
