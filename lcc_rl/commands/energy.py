"""Energy of recorded trips, per trip and per kilometre."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from os import PathLike, fspath
from typing import Any

import numpy as np
import pandas as pd
import torch

from lcc_rl.arrays import times
from lcc_rl.config import load
from lcc_rl.config.words import key_of, quoted, top_key
from lcc_rl.data.leaders import DriveLeaders
from lcc_rl.data.profiles import Profiles
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import DataError, require
from lcc_rl.evaluation.metrics import KILO
from lcc_rl.results.remarks import MUCH
from lcc_rl.runs.output import log_report
from lcc_rl.settings import checked

log = logging.getLogger("lcc_rl")

BLOCK = 10  # records whose energies are computed together; more exceed the processor's cache
KWH = 3600.0  # [kJ]
OF_DRIVES = ("columns", "units", "plausible", "average_s", "bridge_s")  # of leader, that are used
OF_TRIPS = ("scenario.time_step.", *(f"leader.{name}." for name in OF_DRIVES))


@checked
def trip_energies(
    path: str | PathLike | Sequence[str | PathLike], overrides: Sequence[str] = ()
) -> pd.DataFrame:
    """Return the energy of recorded trips, and log lines on the data.

    Args:
        path: a table of many trips, files with one trip each, a folder, a pattern, or a list.
        overrides: the energy model, columns and units: ``["energy=fuel", "leader.columns.drive=id",
            "leader.units.speed=km/h", "leader.columns.grade=slope", "leader.units.grade=%"]``.

    Returns:
        A row per trip, by name: ``trip``, ``parts`` (records that holes divide it into),
        ``duration_s``, ``distance_km``, ``energy_kj`` as drawn, ``net_energy_kj``, less the gain of
        kinetic energy and height; of the energy drawn ``energy_kwh``, ``kwh_per_100km``, fuel and
        carbon dioxide; and ``share_infeasible``, the share of the time with motion beyond the
        model's power.

    Raises:
        LccError: if a setting has no effect, the data are unusable, or a power is not finite.
    """
    for word in overrides:
        valid = top_key(word) in ("energy", "trust") or f"{key_of(word)}.".startswith(OF_TRIPS)
        require(valid, f"{word} has no effect on the energy of given trips")
    names = [path] if isinstance(path, (str, PathLike)) else path
    listed = ",".join(quoted(fspath(name)) for name in names)
    settings = ["variant=direct", "leader=drives", f"leader.path=[{listed}]", *overrides]
    cfg = load("evaluate", settings)
    (model, *further), step = build_energy(cfg).models, cfg.scenario.time_step
    require(not further, "energy: a mixture has several models; choose one, such as fuel")
    source = cfg.leader.made(DriveLeaders)
    records, lines = source.profiles(step)
    log_report(lines)
    blocks = (slice(first, first + BLOCK) for first in range(0, len(records), BLOCK))
    rows = pd.concat([_energies(records, block, model) for block in blocks])
    trips = rows.groupby("trip").sum().reset_index()
    order = trips["trip"].astype(str).str.replace(r"\d+", lambda x: x[0].zfill(20), regex=True)
    trips = trips.loc[order.sort_values().index].reset_index(drop=True)  # 2 before 10
    km = trips["distance_km"].where(trips["distance_km"] > 0.0)
    trips["energy_kwh"] = trips["energy_kj"] / KWH
    trips["kwh_per_100km"] = 100.0 * trips["energy_kwh"] / km
    if model.heating_value:
        drawn = torch.from_numpy(trips["energy_kj"].to_numpy() / KILO)
        trips["fuel_l"], trips["co2_g"] = (x.numpy() for x in model.burnt(drawn))
        trips["l_per_100km"] = 100.0 * trips["fuel_l"] / km
        trips["co2_g_per_km"] = trips["co2_g"] / km
    trips["share_infeasible"] = trips.pop("infeasible_s") / trips["duration_s"]
    for trip, share in zip(trips["trip"], trips["share_infeasible"], strict=True):
        if share > MUCH:
            text = "%s drives beyond the model's power for %.0f %% of the time"
            log.warning(f"{text}: such a vehicle would be slower", trip, 100.0 * share)
    return trips


def _energies(records: Profiles, block: slice, model: Any) -> pd.DataFrame:
    """Return duration, distance and energies of some records, as ``energy_measures`` does."""
    first, step = records.offsets[block].numpy(), records.time_step
    last = first + records.lengths[block].numpy() - 1
    rows, first, last = slice(first[0], last[-1] + 1), first - first[0], last - first[0]
    speed = records.speeds[rows]
    if records.grades is not None:
        model = model.at(records.grades[rows][:-1])
    motion = speed[:-1], speed.diff() / step
    beyond = model.infeasible(*motion)
    beyond = torch.zeros_like(motion[0]) if beyond is None else beyond.float()
    stored_rate = model.climbing(speed[:-1]) - model.unpaid(*motion)
    rates = np.stack([model.power(*motion), stored_rate, beyond])
    rates[:, last[:-1]] = 0.0  # from one record to the next
    lost = np.flatnonzero(~np.isfinite(rates[0]))
    if len(lost):
        part = int(np.searchsorted(first, lost[0], side="right")) - 1
        after, (at, risen) = times(lost[0] - first[part], step), (float(x[lost[0]]) for x in motion)
        raise DataError(
            f"{records.recordings[block][part]}: {type(model).__name__}.power is "
            f"{rates[0, lost[0]]} at {at:.4g} m/s and {risen:.4g} m/s², {after:g} s after the "
            "start of the trip or of its part"
        )
    drawn, climbed, spent = step * np.add.reduceat(rates, first, axis=1, dtype=np.float64)
    drawn, climbed = KILO * drawn, KILO * climbed
    edges = speed[np.stack([first, last])].double()
    stored = climbed + KILO * model.stored_energy(edges).diff(dim=0)[0].numpy()
    total = np.add.reduceat(speed.numpy(), first, dtype=np.float64) - 0.5 * edges.sum(0).numpy()
    return pd.DataFrame(
        {
            "trip": records.recordings[block],
            "parts": 1,
            "duration_s": times(last - first, step),
            "distance_km": KILO * step * total,
            "energy_kj": drawn,
            "net_energy_kj": drawn - stored,
            "infeasible_s": spent,
        }
    )
