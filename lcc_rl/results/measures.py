"""Measures of evaluations with their names in tables, limits and scores.

A new measure is a function in :mod:`lcc_rl.evaluation.metrics` and a line here.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from lcc_rl.energy import AVERAGED, AVERAGES, SECOND
from lcc_rl.results.windows import DAMPING, DISTANCE, WAYS, episode_mean, how

PATH = "total_path_energy_kj"
PATH_PER_KM = "path_energy_kj_per_km"  # per vehicle and km; falling behind does not lower it
FASTER, BROKEN = "share_leader_faster", "share_promise_broken"
REACH = ("cav_share_infeasible", "hdv_share_infeasible")
FLOW = "flow_vph"
TTC, LONG_GAPS = "share_ttc_unsafe", "share_time_gap_long_moving"
SHORT_NAMES = {TTC: "unsafe_ttc_pct", LONG_GAPS: "long_time_gap_pct"}  # columns of short tables
BARE, TURNED = "share_ttc_unpromised", "share_turned_unsafe"
SPEED_STD, FINAL_SPREAD = "speed_std_mps", "final_speed_spread_mps"
AT_LEAST, SHARE, PERCENT = "≥", "share_", "{:.2%}"


class Shown(NamedTuple):
    """A column of a short table: its name in files, and its heading on the terminal."""

    key: str
    heading: str


@dataclass(frozen=True)
class Measure:
    """A measure of a strategy.

    Args:
        key: its name in files; also the column of episodes.parquet, unless ``of`` is given.
        label: its row in full tables, with the unit; without a label it is in files only.
        form: format of its number.
        limit: heading of a limit in a task, with ``≤ {:g}`` or ``≥ {:g}`` for the bound.
        short: its heading in short tables, with shares in per cent; without it the measure is in
            full tables only.
        of: the column of episodes.parquet.
        per: a column; the measure is then the ratio of both totals.
        factor: factor on a ratio.
        score: its name as a task's score.
    """

    key: str
    label: str = ""
    form: str = "{:.2f}"
    limit: str = ""
    short: str = ""
    of: str = ""
    per: str = ""
    factor: float = 1.0
    score: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns from which it is computed."""
        return tuple(filter(None, (self.of or self.key, self.per)))

    @property
    def shown(self) -> Shown:
        """Its column of short tables."""
        share = f"{self.key.removeprefix(SHARE)}_pct" if self.scale > 1.0 else self.key
        return Shown(SHORT_NAMES.get(self.key, share), self.short)

    @property
    def scale(self) -> float:
        """Factor in limits and short columns; 100 for shares."""
        return 100.0 if self.key.startswith(SHARE) else 1.0

    def value(self, part: pd.DataFrame) -> float:
        """Return its value from a strategy's rows of :func:`lcc_rl.results.windows.windows_of`."""
        column, *per = self.columns
        if not {column, *per} <= set(part):
            return np.nan
        if per:
            whole = episode_mean(part, per[0])
            return self.factor * episode_mean(part, column) / whole if whole else np.nan
        kind = how(column)
        return (
            episode_mean(part, column) if kind == "mean" else float(getattr(part[column], kind)())
        )

    def keeps(self, value: float, bound: float) -> bool:
        """Whether a limit is kept; NaN, the value without such a vehicle, keeps it."""
        return not (value < bound if AT_LEAST in self.limit else value > bound)

    def bounded(self, bound: float) -> str:
        """Return the heading of a limit, with line breaks."""
        return self.limit.format(self.scale * bound)

    @property
    def limited(self) -> str:
        """The name of its limit, without the bound."""
        return re.split(r"\s*[≤≥]", self.limit.replace("\n", " "))[0]


def _energy(kind: str, label: str = "", score: str = "") -> Measure:
    """Return the measure of an energy of all vehicles divided by their distance [kJ/km]."""
    key = f"{kind}kj_per_km" if kind else "kj_per_km"
    of = f"all_{kind or 'energy_'}kj"
    return Measure(key, label, "{:.1f}", of=of, per=DISTANCE, factor=1e3, score=score)


def _per(key: str, label: str, of: str, factor: float, form: str = "{:.2f}") -> Measure:
    """Return the measure of a column of all vehicles divided by their distance."""
    return Measure(key, label, form, of=of, per=DISTANCE, factor=factor)


MEASURES = [
    Measure(PATH, "path energy [kJ]", "{:.1f}"),
    Measure("total_acceleration_loss_kj", "  lost to accelerating [kJ]", "{:.1f}"),
    _energy("path_energy_", "  path energy per vehicle and km [kJ]", "path_energy"),
    *(
        _energy(name.removesuffix("kj"), f"    of speeds averaged over {seconds:g} s [kJ]")
        for name, seconds in zip(AVERAGED, AVERAGES, strict=True)
    ),
    Measure(DISTANCE, "distance of all vehicles [m]", "{:.0f}"),
    Measure("total_energy_kj", "energy as drawn [kJ]", "{:.1f}"),
    Measure("cav_energy_kj", "  CAV [kJ]", "{:.1f}"),
    Measure("hdv_energy_kj", "  HDV [kJ]", "{:.1f}"),
    _energy("", "  as drawn, per vehicle and km [kJ]", "energy"),
    _energy("net_energy_", score="net_energy"),
    *(Measure(f"{group}_net_energy_kj") for group in ("cav", "hdv", "total")),
    Measure(f"total_{SECOND}"),
    _energy("second_path_energy_", "path energy, second model, per vehicle and km [kJ]"),
    _per("fuel_l_per_100km", "fuel [L/100 km]", "all_fuel_l", 1e5),
    _per("co2_g_per_km", "carbon dioxide of it [g/km]", "all_co2_g", 1e3, "{:.1f}"),
    _per("travel_time_s_per_km", "travel time [s/km]", "vehicle_time_s", 1e3),
    _per("delay_s_per_km", "  delay against v0 [s/km]", "delay_s", 1e3),
    Measure("mean_speed_mps", "mean speed [m/s]", limit="mean\nspeed\n≥ {:g}\n[m/s]"),
    Measure(SPEED_STD, "deviation of a speed in time [m/s]", score=SPEED_STD),
    Measure(FINAL_SPREAD, "spread of speeds at the end [m/s]", score=FINAL_SPREAD),
    Measure(FLOW, "flow [vehicles/h]", "{:.0f}", limit="flow\n≥ {:.0f}\n[1/h]"),
    Measure("string_ratio", "string ratio", score="string_ratio"),
    Measure("damped", "episodes that end calm", "{:.0%}"),
    Measure(DAMPING, "  from when on, mean [s]", "{:.0f}", of="damped_s", per="damped"),
    Measure("mean_gap_m", "mean gap [m]", "{:.1f}"),
    Measure("gap_opened_m", "  opened during the counted time [m]", "{:+.1f}"),
    Measure("min_gap_m", "smallest gap [m]", limit="gap\n≥ {:g}\n[m]"),
    Measure("max_gap_m", "largest gap [m]", limit="gap\n≤ {:g}\n[m]"),
    Measure("min_time_gap_s", "shortest time gap [s]", limit="time\ngap\n≥ {:g} s"),
    Measure("max_time_gap_s", limit="time\ngap\n≤ {:g} s"),
    Measure("min_ttc_s", "minimum time-to-collision [s]", limit="TTC\n≥ {:g} s"),
    Measure(TTC, "time with TTC < 4 s", PERCENT, "TTC\n< 4 s\n≤ {:g} %", "TTC\n< 4 s\n[%]"),
    Measure(BARE, "  of it outside the filter's guarantee", PERCENT, "TTC\nbare\n≤ {:g} %"),
    Measure(TURNED, "steps that turn unsafe", PERCENT, "turned\nunsafe\n≤ {:g} %"),
    Measure(BROKEN, "  of them covered by the guarantee", PERCENT),
    Measure("share_filter_acts", "time in which the filter acts", "{:.1%}"),
    Measure("share_time_gap_long", "time with time gap > 2.5 s", PERCENT, "long\ngaps\n≤ {:g} %"),
    Measure(LONG_GAPS, "  above 1 m/s", PERCENT, "long\ngaps\n≤ {:g} %", "long\ngap\n[%]"),
    Measure(
        "share_time_gap_short", "time with time gap < 1 s, all", PERCENT, "gap\n< 1 s\n≤ {:g} %"
    ),
    Measure("max_braking_mps2", "hardest braking [m/s²]", "{:.1f}"),
    Measure("max_leader_braking_mps2", "  of the leader [m/s²]", "{:.1f}"),
    _per("brakings_below_2_per_100km", "brakings < −2 m/s² [1/100 km]", "brakings_below_2", 1e5),
    _per("brakings_below_3_per_100km", "  < −3 m/s² [1/100 km]", "brakings_below_3", 1e5),
    Measure("rms_jerk_mps3", "RMS jerk [m/s³]"),
    Measure(FASTER, "time with a leader faster than v0", "{:.1%}", "leader\nfaster\n≤ {:g} %"),
    Measure(REACH[0], "CAV beyond the energy model's reach", "{:.1%}"),
    Measure(REACH[1], "HDV beyond the energy model's reach", "{:.1%}"),
    Measure("collisions", "collisions", "{:.0f}"),
    Measure("episodes", "episodes", "{:.0f}"),
]


def limit_measures() -> dict[str, Measure]:
    """Return the measures that may have a limit, by key."""
    return {measure.key: measure for measure in MEASURES if measure.limit}


def score_measures() -> dict[str, Measure]:
    """Return the measures that may be a task's score, by its name there."""
    return {measure.score: measure for measure in MEASURES if measure.score}


def table_columns() -> list[str]:
    """Return the columns of episodes.parquet, or derived from them, that tables need."""
    return list(
        dict.fromkeys((*WAYS, "drivers", *(name for one in MEASURES for name in one.columns)))
    )


def means(windows: pd.DataFrame, keys: tuple[str, ...]) -> pd.DataFrame:
    """Return measures by strategy, in their order."""
    chosen = [measure for measure in MEASURES if measure.key in keys]
    parts = windows.groupby("strategy", sort=False)
    rows = {name: {x.key: x.value(part) for x in chosen} for name, part in parts}
    return pd.DataFrame.from_dict(rows, orient="index")
