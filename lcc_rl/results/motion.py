"""Positions of all vehicles in a sample episode, for diagrams and animations."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from lcc_rl.arrays import Integers
from lcc_rl.errors import ResultsError
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING, parse_string
from lcc_rl.settings import TARGET

MotionSeries = NDArray[np.float64]
SAMPLE_KEYS = ("profile", "driver_id", "repeat")  # columns by which sample episodes differ


@dataclass(frozen=True)
class SampleMotion:
    """One sample episode of one strategy.

    Args:
        time: ``[T]`` [s].
        roles: roles of the N vehicles, front to back.
        speed: ``[T, N]`` [m/s].
        gap: gap to the vehicle ahead, bumper to bumper, ``[T, N]`` [m].
        front: front bumper of the vehicle ahead of the first one, ``[T]`` [m]: the leader, which
            starts at 0; on a ring the last vehicle, one round ahead.
        leader: the leader's speed, ``[T]`` [m/s]; None on a ring.
        length: length of all vehicles [m]; or ``[N + 1]``, of the vehicle ahead of the first one,
            then of each.
        circumference: circumference of a ring [m]; None on an open road.
    """

    time: MotionSeries
    roles: tuple[str, ...]
    speed: MotionSeries
    gap: MotionSeries
    front: MotionSeries
    leader: MotionSeries | None
    length: float | MotionSeries
    circumference: float | None

    @property
    def lengths(self) -> MotionSeries:
        """Length of the vehicle ahead of the first one, then of each, ``[N + 1]`` [m]."""
        return np.broadcast_to(self.length, len(self.roles) + 1)

    @property
    def position(self) -> MotionSeries:
        """Front bumper of every vehicle, ``[T, N]`` [m]."""
        fronts: MotionSeries = self.front[:, None] - np.cumsum(self.gap + self.lengths[:-1], axis=1)
        return fronts

    @property
    def ahead(self) -> MotionSeries:
        """Speed of the vehicle ahead of each, ``[T, N]`` [m/s]."""
        first = self.speed[:, -1] if self.leader is None else self.leader
        return np.column_stack([first, self.speed[:, :-1]])

    def at(self, moments: slice | Integers) -> SampleMotion:
        """Return the motion at selected times."""
        return replace(
            self,
            time=self.time[moments],
            speed=self.speed[moments],
            gap=self.gap[moments],
            front=self.front[moments],
            leader=None if self.leader is None else self.leader[moments],
        )


def of_first_seed(steps: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of steps.parquet of each strategy's first training seed."""
    earlier = "case" in steps and "training_seed" not in steps  # of a version before
    if steps.empty or earlier:
        return steps
    seeds = steps["training_seed"]
    return steps[seeds.isna() | (seeds == seeds.groupby(steps["strategy"]).transform("min"))]


def sample_episodes(steps: pd.DataFrame, strategy: str) -> dict[str, pd.DataFrame]:
    """Return the sample episodes of a strategy by a readable name.

    Args:
        steps: rows of steps.parquet; the first training seed is used.
        strategy: its name.

    Raises:
        ResultsError: if there is none.
    """
    if "strategy" not in steps:
        raise ResultsError("no sample episode is stored")
    rows = of_first_seed(steps[steps["strategy"] == strategy])
    if "case" in rows:
        episodes = {str(case): group for case, group in rows.groupby("case", sort=False)}
    else:
        keys = [name for name in SAMPLE_KEYS if name in rows]
        groups = rows.groupby(keys, sort=False)
        episodes = {f"profile {key[0]}, driver {key[1]}": group for key, group in groups}
    if not episodes:
        raise ResultsError(f"no sample episode of {strategy} is stored")
    return episodes


def most_varied(steps: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of the sample episode in which the leader's speed varies most.

    Without a leader the speed of the first vehicle counts. The evaluation has a row per episode.
    """
    speed = next(name for name in steps.columns if name.endswith("_speed"))
    keys = ["profile", "driver_id"]
    chosen: Any = steps.groupby(keys)[speed].std().fillna(0.0).idxmax()
    return steps[(steps[keys] == list(chosen)).all(axis=1)]


def motion_of(rows: pd.DataFrame, scenario: Mapping[str, Any]) -> SampleMotion:
    """Return the motion of one sample episode.

    Positions are computed from the gaps behind the leader; on a ring from those behind the first
    vehicle, which moves by its speed.

    Args:
        rows: rows of one episode, see :func:`sample_episodes`.
        scenario: section of the evaluation's configuration.

    Raises:
        ResultsError: if the rows lack the place of a vehicle.
    """
    read = _of_platoon if "follower" in rows else _of_string
    time, leader, speed, gap, roles, lengths = read(rows, scenario)
    first = float(scenario["vehicle_length"])
    if scenario["road"] == RING and lengths is not None:
        first = lengths[-1]
    length: Any = first if lengths is None else np.array([first, *lengths])
    step = np.diff(time, prepend=time[0])
    if scenario["road"] == RING:
        front = np.cumsum(speed[:, 0] * step) + gap[:, 0] + first
        around = float(scenario["circumference"])
        return SampleMotion(time, roles, speed, gap, front, None, length, around)
    if leader is None:
        raise ResultsError("the sample episode has no leader")
    front = np.cumsum(leader * step)
    return SampleMotion(time, roles, speed, gap, front, leader, length, None)


Series = MotionSeries | None
# Time, leader's speed, speeds, gaps, roles, and lengths if vehicles have classes.
Found = tuple[MotionSeries, Series, MotionSeries, MotionSeries, tuple[str, ...], Series]


def _of_platoon(rows: pd.DataFrame, scenario: Mapping[str, Any]) -> Found:
    """Read rows of one vehicle each; the leader is follower 0."""
    table = rows.pivot_table(index="time_s", columns="follower", values=["speed_mps", "gap_m"])
    speed, gap = table["speed_mps"], table["gap_m"]
    roles = parse_string(scenario["string"], scenario["road"]).roles
    count = speed.shape[1] - 1
    # A case has its own number of vehicles, all automated.
    roles = roles if len(roles) == count else (AUTOMATED,) * count
    leader, speeds = speed[0].to_numpy(float), speed.drop(columns=0).to_numpy(float)
    return speed.index.to_numpy(float), leader, speeds, gap.to_numpy(float), roles, None


def _driver_of(scenario: Mapping[str, Any]) -> Callable[[str], str]:
    """Return a function of a role: ``human`` for roles with human drivers, else the role."""
    nodes = scenario.get("controllers", {})
    kinds = {role: node[TARGET] for role, node in nodes.items() if node}
    people = {role for role, kind in kinds.items() if kind == kinds.get(HUMAN)} - {AUTOMATED}
    return lambda role: HUMAN if role in people else role


def _of_string(rows: pd.DataFrame, scenario: Mapping[str, Any]) -> Found:
    """Read rows of all vehicles."""
    cars, humans = _vehicles(rows, "cav"), _vehicles(rows, "hdv")
    count = len(cars) + len(humans)
    places = _places(rows, cars, scenario)
    if len(places) != len(cars) or max(places, default=0) >= count:
        raise ResultsError("the sample episode lacks vehicles of the string")
    automated, rest = iter(cars), iter(humans)
    names = [next(automated) if place in places else next(rest) for place in range(count)]
    roles = tuple(AUTOMATED if place in places else HUMAN for place in range(count))
    if isinstance(scenario["string"], str):
        composed = parse_string(scenario["string"], scenario["road"]).roles
        roles = tuple(map(_driver_of(scenario), composed)) if len(composed) == count else roles
    time = rows["time_s"].to_numpy(float)
    speed, gap = (rows[[f"{x}_{entry}" for x in names]] for entry in ("speed", "gap"))
    leader = rows.get("leader_speed")
    ahead = None if leader is None or leader.isna().any() else leader.to_numpy(float)
    own_length = [f"{x}_length" for x in names]
    complete = set(own_length) <= set(rows)
    length = rows[own_length].iloc[0].to_numpy(float) if complete else None
    return time, ahead, speed.to_numpy(float), gap.to_numpy(float), roles, length


def _vehicles(rows: pd.DataFrame, group: str) -> list[str]:
    """Return the names of a group's vehicles in an episode, front to back."""
    fits = {str(name): re.fullmatch(rf"{group}(\d*)_speed", str(name)) for name in rows}
    numbers = [int(x.group(1) or 0) for name, x in fits.items() if x and rows[name].notna().all()]
    return [f"{group}{number or ''}" for number in sorted(numbers)]


def _places(rows: pd.DataFrame, cars: list[str], scenario: Mapping[str, Any]) -> list[int]:
    """Return the places of the automated vehicles, 0 at the front."""
    if not cars:  # a baseline without automated vehicles
        return []
    string = parse_string(scenario["string"], scenario["road"])
    if not string.drawn:
        return list(string.places(AUTOMATED))
    names = [f"{car}_place" for car in cars]
    if not set(names) <= set(rows):
        raise ResultsError("places drawn in the episode are not stored; evaluate again")
    return [int(place) for place in rows[names].iloc[0]]
