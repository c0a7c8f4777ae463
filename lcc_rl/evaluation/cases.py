"""Evaluation with one row per vehicle: cases, held-out windows and whole records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.arrays import times
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.data.leaders import Case
from lcc_rl.envs import build_env
from lcc_rl.envs.factory import moment_bytes
from lcc_rl.envs.inputs import Inputs
from lcc_rl.envs.step import pieces_of
from lcc_rl.evaluation.metrics import registered, safety_measures
from lcc_rl.evaluation.rollout import Player, reset_options
from lcc_rl.evaluation.rows import INDEX, VALUE_BYTES, nullable
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces.base import REWARD
from lcc_rl.pieces.hybrid import COUNTERS, WINNER
from lcc_rl.results.windows import DRIVE, SOURCE, START

WINDOW_CASES = "windows"
TRACKING_ERRORS = ("gap_error", "speed_error", "leader_speed_error")
CASE_ENTRIES = ("speed", "gap", "acceleration", "jerk", "power", *TRACKING_ERRORS)
CASE_KEYS = [("leader", "speed"), *(("vehicles", name) for name in CASE_ENTRIES), REWARD]
CASE_KEYS += [INDEX, WINNER, *COUNTERS]
# Columns of a time series besides the speed.
TRACED = {"gap": "gap_m", "acceleration": "acceleration_mps2", "jerk": "jerk_mps3"}
TRACED["winner"] = "winner"
OF_CAV = ("speed_error_sum", "speed_error_squares", "jerk_sum", "jerk_squares", "max_gap_error_m")
CaseSeries = dict[str, Tensor]  # ``[time, runs, vehicles]``


class Cases:
    """Plays one strategy on all cases, held-out windows and whole records, in one block."""

    def __init__(self, strategy: Strategy, cfg: StudyConfig, inputs: Inputs) -> None:
        self.strategy, self.cfg, self.inputs = strategy, cfg, inputs
        windows = Case(WINDOW_CASES, inputs.evaluation, len(cfg.scenario.vehicles))
        full = inputs.full_length if cfg.evaluation.full_length else ()
        cases = (*inputs.cases, windows, *full)
        self.drives = [CaseRuns(strategy, case, inputs, cfg.device) for case in cases]
        self.idle = [drive.player.idle for drive in self.drives]
        self.player = self.drives[0].player
        self.largest = max((drive.size for drive in self.drives), key=math.prod)
        # Size of the time series of the cases in a file, which hardly compress [bytes].
        steps = sum(case.horizon * (case.followers + 1) for case in inputs.cases)
        self.sampled = steps * len(TRACED) * VALUE_BYTES

    def count(self, block: int) -> int:
        """Return the number of runs of all cases."""
        return sum(len(drive.case.profile) for drive in self.drives)

    def play(self, block: int = 0) -> tuple[pd.DataFrame, pd.DataFrame]:
        """Play all cases.

        Returns:
            One row per run and vehicle, and the time series of the cases.
        """
        rows, steps, time_step = [], [], self.cfg.scenario.time_step
        for drive in self.drives:
            series, case = drive.play(self.cfg.evaluation.seed), drive.case
            rows.append(self._described(case, measured_series(series, time_step)))
            if case in self.inputs.cases:
                drawn = trace(series, time_step)
                labels = {**self.strategy.labels(len(drawn)), "case": case.name}
                steps.append(pd.concat([pd.DataFrame(labels), drawn], axis=1))
        trails = pd.concat(steps, ignore_index=True) if steps else pd.DataFrame()
        return pd.concat(rows, ignore_index=True), trails

    def _described(self, case: Case, frame: pd.DataFrame) -> pd.DataFrame:
        """Return measures with the names of their strategy, case and profile."""
        labels = {
            **self.strategy.labels(len(frame)),
            "case": case.name,
            "profile": [case.profile.names[i] for i in frame["run_id"]],
            DRIVE: [case.profile.recordings[i] for i in frame["run_id"]],
            "followers": int(frame["follower"].max()),
        }
        frame = pd.concat([pd.DataFrame(labels), frame], axis=1)
        if case.profile.starts:
            frame[START] = [case.profile.starts[i] for i in frame["run_id"]]
        if self.inputs.evaluation.sources:
            sources = case.profile.sources or [""] * len(case.profile)
            frame[SOURCE] = [sources[i] for i in frame["run_id"]]
        return frame


class CaseRuns:
    """Drives a strategy behind all records of a case in parallel."""

    def __init__(self, strategy: Strategy, case: Case, inputs: Inputs, device: str = "cpu") -> None:
        changes: dict[str, Any] = {"horizon": case.horizon}
        if set(strategy.cfg.scenario.vehicles.names) == {AUTOMATED}:  # a platoon: the case's number
            changes["string"] = f"{AUTOMATED}*{case.followers}"
        self.case, self.cfg = case, strategy.cfg.with_(scenario=changes)
        self.drivers, self.runs = len(inputs.population.time_gap), len(case.profile)
        env = build_env(self.cfg, case.profile, inputs.population, self.runs, 0, device, True)
        self.player = Player(env, strategy.policy, CASE_KEYS, strategy.title)
        # Episodes side by side, their steps, and the size of the state of one [bytes].
        self.size = self.runs, self.cfg.scenario.horizon, moment_bytes(pieces_of(env))

    def play(self, seed: int = 0) -> CaseSeries:
        """Play all runs.

        Returns:
            ``leader`` ``[time + 1, runs, 1]`` and ``speed`` ``[time + 1, runs, N]``; gap,
            acceleration, jerk, power and errors ``[time, runs, N]``; reward and, for a hybrid,
            winner and counters, NaN for vehicles that are not automated.
        """
        env, vehicles = self.player.env, len(self.cfg.scenario.vehicles)
        ids = torch.arange(self.runs, device=env.device)
        options = reset_options(env, ids, ids % self.drivers, seed, self.drivers)
        record = dict(self.player.play(options)[0])
        index = record.pop(INDEX, None)
        series = {"leader": record.pop(("leader", "speed"))}
        for (space, name), entry in record.items():
            entry = entry.squeeze(-1)
            if space != "vehicles" and index is not None and entry.shape[-1] != vehicles:
                full = torch.full((*entry.shape[:-1], vehicles), torch.nan, device=entry.device)
                entry = full.scatter(-1, index, entry.to(full.dtype))
            series[name] = entry
        return series


def measured_series(series: CaseSeries, time_step: float = 0.1) -> pd.DataFrame:
    """Return one row per run and vehicle; ``time_step`` [s].

    Speed errors are e_v(i,0), as in the paper's tables; sums and squares of them and of jerks, and
    ``max_gap_error_m``, the largest |e_x(i,i−1)| by the position received, which is late, are NaN
    for vehicles that are not automated. ``energy_ratio`` is Σ e_v(i,i−1)² divided by that of the
    vehicle ahead (string stability: at most 1); it is missing for the first vehicle and if the
    divisor is at most 1e-3 m²/s². ``drawn_energy_kj_per_km`` is
    the scenario's power over the distance, missing at standstill.
    """
    error, jerk = series["leader_speed_error"].abs(), series["jerk"].abs()
    energy = series["speed_error"].square().sum(0)
    ratio = torch.full_like(energy, torch.nan)
    ahead = energy[..., :-1]
    ratio[..., 1:] = torch.where(ahead > 1e-3, energy[..., 1:] / ahead.clamp(min=1e-3), torch.nan)
    keeps = series["reward"].isfinite().all(0)
    driven = 0.5 * (series["speed"][1:] + series["speed"][:-1]).sum(0)  # in units of a step
    columns = {
        "speed_error_sum": error.sum(0),
        "speed_error_squares": error.square().sum(0),
        "jerk_sum": jerk.sum(0),
        "jerk_squares": jerk.square().sum(0),
        "reward": series["reward"].sum(0),
        "min_gap_m": series["gap"].amin(0),
        "max_gap_error_m": series["gap_error"].abs().amax(0),
        "peak_jerk_mps3": jerk.amax(0),
        "energy_ratio": ratio,
        "drawn_energy_kj_per_km": torch.where(
            driven > 0.0, series["power"].sum(0) / driven, torch.nan
        ),
    }
    columns |= {key: torch.where(keeps, columns[key], torch.nan) for key in OF_CAV}
    if "winner" in series:
        columns["learned_share"] = series["winner"].double().mean(0)
        columns |= {name: series[name][-1] for _, name in COUNTERS}
    entries = {name: value[..., None, None] for name, value in series.items()}  # a vehicle a batch
    alive = torch.ones_like(entries["jerk"], dtype=torch.bool)
    columns |= safety_measures(entries, alive, time_step, registered())
    runs, vehicles = energy.shape
    frame = pd.DataFrame({name: value.flatten().cpu().numpy() for name, value in columns.items()})
    frame = nullable(frame, [name for _, name in COUNTERS])
    frame.insert(0, "run_id", np.repeat(np.arange(runs), vehicles))
    frame.insert(1, "follower", np.tile(np.arange(1, vehicles + 1), runs))
    frame["collided"] = frame["min_gap_m"] <= 0.0
    frame["frames"] = len(jerk)
    return frame


def trace(series: CaseSeries, time_step: float) -> pd.DataFrame:
    """Return a row per time and vehicle of the first run; the leader is vehicle 0."""
    leader = series["leader"][1:, 0]
    steps, vehicles = series["jerk"].shape[0], series["jerk"].shape[2]
    columns = {"speed_mps": torch.cat([leader, series["speed"][1:, 0]], dim=-1)}
    for name, label in TRACED.items():
        if name in series:
            values = series[name][:, 0].to(leader.dtype)
            columns[label] = torch.cat([torch.full_like(leader, torch.nan), values], dim=-1)
    frame = pd.DataFrame({name: value.flatten().cpu().numpy() for name, value in columns.items()})
    frame.insert(0, "time_s", np.repeat(times(np.arange(1, steps + 1), time_step), vehicles + 1))
    frame.insert(1, "follower", np.tile(np.arange(vehicles + 1), steps))
    return frame
