"""Measures of evaluations: aggregation, unit, bound and names in tables, limits and scores.

:func:`lcc_rl.evaluation.metrics.register` adds one from outside the package.
"""

from __future__ import annotations

import re
from dataclasses import KW_ONLY, dataclass
from functools import partial
from math import isfinite
from typing import NamedTuple

import numpy as np
import pandas as pd

from lcc_rl.energy import AVERAGED, AVERAGES, SECOND
from lcc_rl.errors import require_known

WAYS = ("cav_distance_m", "hdv_distance_m")  # their sum is the distance of all vehicles
DISTANCE, DAMPING = "distance_m", "damping_time_s"
PATH = "total_path_energy_kj"
PATH_PER_KM = "path_energy_kj_per_km"  # per vehicle and km; falling behind does not lower it
FASTER, BROKEN = "share_leader_faster", "share_promise_broken"
REACH = ("cav_share_infeasible", "hdv_share_infeasible")
FLOW, GAP = "flow_vph", "mean_gap_m"
TTC, LONG_GAPS = "share_ttc_unsafe", "share_time_gap_long_moving"
BARE, TURNED = "share_ttc_unpromised", "share_turned_unsafe"
FILTER_ACTS = "share_filter_acts"  # NaN without a safety filter
SPEED_STD, FINAL_SPREAD = "speed_std_mps", "final_speed_spread_mps"
CALM = 0.5  # spread of speeds below which a wave counts as damped [m/s]
WITH_VALUE = "counted_"  # prefix of a window's number of episodes with a value, if some lack one
AGGREGATES = ("mean", "sum", "min", "max")
SIGNS = {"at least": "≥", "at most": "≤"}
SHARE, COUNT = "%", "{:.0f}"
# Units of columns by the end of their names.
SUFFIX_UNITS = {"kj_per_km": "kJ/km", "mps3": "m/s³", "mps": "m/s", "pct": "%", "kj": "kJ"}
SUFFIX_UNITS |= {
    "ms": "ms",
    "m": "m",
    "s": "s",
    "vph": "1/h",
    "g_per_km": "g/km",
    "s_per_km": "s/km",
}
SUFFIX_UNITS |= {"wh_per_km": "Wh/km", "kwh_per_100km": "kWh/100 km", "l_per_100km": "L/100 km"}
SUFFIX_UNITS |= {"per_100km": "1/100 km"}
INITIALS = ("cav", "hdv", "ttc", "sd")


class Shown(NamedTuple):
    """A column of a short table: its name in files, and its heading on the terminal."""

    key: str
    heading: str

    @property
    def words(self) -> str:
        """The heading in one line."""
        return self.heading.replace("-\n", "").replace("\n", " ")


@dataclass(frozen=True)
class Measure:
    """A measure of a strategy.

    Args:
        key: its name in files; also the column of episodes.parquet, unless ``of`` is given.
        label: its row in full tables, without the unit; without a label it is in files only.
        unit: its unit; ``"%"`` for a share of 0 to 1, which limits and short tables give in per
            cent.
        form: format of its number in full tables; by default two decimals, ``{:.2%}`` for shares.
        aggregate: how episodes and windows are combined: ``mean``, ``sum``, ``min`` or ``max``.
        bound: ``at least`` or ``at most``: what a limit of a task bounds; without it there is none.
        limit: words for a limit's heading, with line breaks; by default the label.
        short: its heading in short tables; without it the measure is in full tables only.
        column: its name in short tables; by default the key, for shares with ``_pct``.
        of: the column of episodes.parquet.
        per: a column; the measure is then the ratio of both totals.
        factor: factor on a ratio.
        score: its name as a task's score.
        least: mean of a baseline below which no share of it is given: it is noise.
        interval: whether tables have its 95 % interval; extremes and sums have none.
        possible: least value, and largest, without the factor; intervals are cut there.

    Raises:
        ConfigError: if aggregate or bound is unknown.
    """

    key: str
    label: str = ""
    _: KW_ONLY
    unit: str = ""
    form: str = ""
    aggregate: str = "mean"
    bound: str = ""
    limit: str = ""
    short: str = ""
    column: str = ""
    of: str = ""
    per: str = ""
    factor: float = 1.0
    score: str = ""
    least: float = 0.0
    interval: bool = False
    possible: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        require_known(f"aggregate of {self.key}", self.aggregate, AGGREGATES)
        require_known(f"bound of {self.key}", [self.bound] if self.bound else (), SIGNS)

    @property
    def columns(self) -> tuple[str, ...]:
        """The columns from which it is computed."""
        return tuple(filter(None, (self.of or self.key, self.per)))

    @property
    def shown(self) -> Shown:
        """Its column of short tables."""
        share = f"{self.key.removeprefix('share_')}_pct" if self.unit == SHARE else self.key
        bare = self.short and self.unit and "[" not in self.short
        return Shown(self.column or share, self.short + f"\n[{self.unit}]" * bool(bare))

    @property
    def scale(self) -> float:
        """Factor in limits and short columns; 100 for shares."""
        return 100.0 if self.unit == SHARE else 1.0

    @property
    def title(self) -> str:
        """Its label with the unit; numbers of shares have theirs."""
        return f"{self.label} [{self.unit}]" if self.unit not in ("", SHARE) else self.label

    @property
    def number(self) -> str:
        """The format of its number."""
        return self.form or ("{:.2%}" if self.unit == SHARE else "{:.2f}")

    def value(self, part: pd.DataFrame) -> float:
        """Return its value from a strategy's rows of :func:`lcc_rl.results.windows.windows_of`."""
        column, *per = self.columns
        if not {column, *per} <= set(part):
            return np.nan
        if per:
            distance = episode_mean(part, per[0])
            return self.factor * episode_mean(part, column) / distance if distance else np.nan
        if self.aggregate == "mean":
            return episode_mean(part, column)
        return float(getattr(part[column], self.aggregate)())

    def keeps(self, value: float, bound: float) -> bool:
        """Whether a limit is kept; NaN, the value without such a vehicle, keeps it."""
        return not (value < bound if self.bound == "at least" else value > bound)

    def bounded(self, bound: float) -> str:
        """Return the heading of a limit, with line breaks."""
        text = self.with_unit(bound)
        if len(self.unit) > 1:
            text = f"{text.removesuffix(self.unit).rstrip()}\n[{self.unit}]"
        return f"{self.limit or self.label}\n{SIGNS[self.bound]} {text}"

    @property
    def limited(self) -> str:
        """The name of its limit, without the bound."""
        return " ".join((self.limit or self.label).split())

    def with_unit(self, value: float) -> str:
        """Return a value in four digits with its unit, as limits and pages name it."""
        return f"{float(f'{self.scale * value:.4g}'):,.10g} {self.unit}".rstrip()


_kj = partial(Measure, unit="kJ", form="{:.1f}")
_share = partial(Measure, unit=SHARE, bound="at most", interval=True, possible=(0.0, 1.0))
_least = partial(Measure, aggregate="min", bound="at least")
_least_mean = partial(_least, aggregate="mean", interval=True, possible=(0.0,))
_largest = partial(Measure, aggregate="max", bound="at most")
_average = partial(Measure, interval=True, possible=(0.0,))
_varied = partial(_average, unit="m/s")
_braking = partial(Measure, unit="m/s²", form="{:.1f}", aggregate="max")
# Ratios of a column of all vehicles and their distance.
_per = partial(Measure, per=DISTANCE, factor=1e3, interval=True, possible=(0.0,))
_signed = partial(_per, possible=())  # of net energies, too, and of their fuel
_kj_per_km = partial(_signed, unit="kJ", form="{:.1f}")
_per_100km = partial(_per, factor=1e5, unit="1/100 km")

MEASURES = [
    _kj(PATH, "path energy"),
    _kj("total_acceleration_loss_kj", "  lost to accelerating"),
    _kj_per_km(
        "path_energy_kj_per_km",
        "  path energy per vehicle and km",
        of="all_path_energy_kj",
        score="path_energy",
    ),
    *(
        _kj_per_km(f"{name}_per_km", f"    of speeds averaged over {seconds:g} s", of=f"all_{name}")
        for name, seconds in zip(AVERAGED, AVERAGES, strict=True)
    ),
    Measure(DISTANCE, "distance of all vehicles", unit="m", form=COUNT),
    _kj("total_energy_kj", "energy as drawn"),
    _kj("cav_energy_kj", "  CAV"),
    _kj("hdv_energy_kj", "  HDV"),
    _kj_per_km("kj_per_km", "  as drawn, per vehicle and km", of="all_energy_kj", score="energy"),
    _kj_per_km("net_energy_kj_per_km", of="all_net_energy_kj", score="net_energy"),
    *(Measure(f"{group}_net_energy_kj") for group in ("cav", "hdv", "total")),
    Measure(f"total_{SECOND}"),
    _kj_per_km(
        f"{SECOND}_per_km", "path energy, second model, per vehicle and km", of=f"all_{SECOND}"
    ),
    _signed("fuel_l_per_100km", "fuel", unit="L/100 km", of="all_fuel_l", factor=1e5),
    _signed("co2_g_per_km", "carbon dioxide of it", unit="g/km", form="{:.1f}", of="all_co2_g"),
    _per("travel_time_s_per_km", "travel time", unit="s/km", of="vehicle_time_s"),
    _signed("delay_s_per_km", "  delay against v0", unit="s/km", of="delay_s"),
    _least_mean("mean_speed_mps", "mean speed", unit="m/s", limit="mean\nspeed"),
    _varied(SPEED_STD, "deviation of a speed in time", score=SPEED_STD),
    _varied(FINAL_SPREAD, "spread of speeds at the end", score=FINAL_SPREAD, least=CALM),
    _least_mean(FLOW, "flow", unit="1/h", form=COUNT),
    _average("string_ratio", "string ratio", score="string_ratio"),
    Measure("damped", "episodes that end calm", form="{:.0%}"),
    Measure(DAMPING, "  from when on, mean", unit="s", form=COUNT, of="damped_s", per="damped"),
    _average(GAP, "mean gap", unit="m", form="{:.1f}"),
    Measure("gap_opened_m", "  opened during the counted time", unit="m", form="{:+.1f}"),
    _least("min_gap_m", "smallest gap", unit="m", limit="gap"),
    _largest("max_gap_m", "largest gap", unit="m", limit="gap"),
    _least("min_time_gap_s", "shortest time gap", unit="s", limit="time\ngap"),
    _largest("max_time_gap_s", unit="s", limit="time\ngap"),
    _least("min_ttc_s", "minimum time-to-collision", unit="s", limit="TTC"),
    _share(
        TTC,
        "time with TTC < 4 s",
        limit="TTC\n< 4 s",
        short="TTC\n< 4 s\n[%]",
        column="unsafe_ttc_pct",
    ),
    _share(BARE, "  of it outside the filter's guarantee", limit="TTC\nbare"),
    _share(TURNED, "steps that turn unsafe", limit="turned\nunsafe"),
    Measure(BROKEN, "  of them covered by the guarantee", unit=SHARE),
    Measure(FILTER_ACTS, "time in which the filter acts", unit=SHARE, form="{:.1%}"),
    _share("share_time_gap_long", "time with time gap > 2.5 s", limit="long\ngaps"),
    _share(
        LONG_GAPS,
        "  above 1 m/s",
        limit="long\ngaps",
        short="long\ngap\n[%]",
        column="long_time_gap_pct",
    ),
    _share("share_time_gap_short", "time with time gap < 1 s, all", limit="gap\n< 1 s"),
    _braking("max_braking_mps2", "hardest braking, with warm-up"),
    _braking("max_leader_braking_mps2", "  of the leader"),
    _per_100km("brakings_below_2_per_100km", "brakings < −2 m/s²", of="brakings_below_2"),
    _per_100km("brakings_below_3_per_100km", "  < −3 m/s²", of="brakings_below_3"),
    _largest("max_deceleration_mps2", "largest deceleration", unit="m/s²", limit="braking"),
    _largest("max_deceleration_1s_mps2", "  mean of 1 s", unit="m/s²", limit="braking\n1 s"),
    _average(
        "rms_jerk_mps3",
        "RMS jerk of an episode, mean",
        unit="m/s³",
        bound="at most",
        limit="RMS\njerk",
    ),
    _largest("max_jerk_mps3", "  largest jerk", unit="m/s³", limit="jerk"),
    _largest("max_jerk_1s_mps3", "  largest mean of 1 s", unit="m/s³", limit="jerk\n1 s"),
    _least("standstill_gap_m", "smallest gap at standstill", unit="m", limit="gap\nat rest"),
    _average("standstill_s", "time to standstill", unit="s", form="{:.1f}"),
    Measure("speed_overshoot_mps", "speed above the leader's highest", unit="m/s", aggregate="max"),
    _share(FASTER, "time with a leader faster than v0", form="{:.1%}", limit="leader\nfaster"),
    Measure(REACH[0], "CAV beyond the energy model's reach", form="{:.1%}"),
    Measure(REACH[1], "HDV beyond the energy model's reach", form="{:.1%}"),
    Measure("collisions", "collisions", form=COUNT, aggregate="sum"),
    Measure("episodes", "episodes", form=COUNT, aggregate="sum"),
]
SHIPPED = frozenset(measure.key for measure in MEASURES)


def limit_measures() -> dict[str, Measure]:
    """Return the measures that may have a limit, by key."""
    return {measure.key: measure for measure in MEASURES if measure.bound}


def score_measures() -> dict[str, Measure]:
    """Return the measures that may be a task's score, by its name there."""
    return {measure.score: measure for measure in MEASURES if measure.score}


def aggregates() -> dict[str, str]:
    """Return the aggregation of columns of episodes.parquet; others are averaged."""
    return {measure.columns[0]: measure.aggregate for measure in MEASURES} | {"drivers": "sum"}


def table_columns() -> list[str]:
    """Return the columns of episodes.parquet, or derived from them, that tables need."""
    return list(
        dict.fromkeys((*WAYS, "drivers", *(name for one in MEASURES for name in one.columns)))
    )


def means(windows: pd.DataFrame, keys: tuple[str, ...]) -> pd.DataFrame:
    """Return measures by strategy, in their order."""
    chosen = [measure for measure in MEASURES if measure.key in keys]
    groups = windows.groupby("strategy", sort=False)
    rows = {name: {x.key: x.value(part) for x in chosen} for name, part in groups}
    return pd.DataFrame.from_dict(rows, orient="index")


def episode_mean(part: pd.DataFrame, column: str) -> float:
    """Return a column's mean over episodes that have it, from windows; NaN without any."""
    episodes = part.get(f"{WITH_VALUE}{column}", part["episodes"])[part[column].notna()]
    return float((part[column] * episodes).sum() / episodes.sum()) if len(episodes) else np.nan


def signed(value: float, form: str = "{:+.1f}") -> str:
    """Return a number with its sign, a typographic minus; a rounded zero without a sign.

    Examples:
        >>> signed(-2.34), signed(2.34), signed(-0.04)
        ('−2.3', '+2.3', '0.0')
    """
    text = form.format(value)
    zero = isfinite(value) and not re.search("[1-9]", text)
    return re.sub("[+-]", "", text) if zero else text.replace("-", "−")


def between(low: float, high: float, form: str = "{:.1f}") -> str:
    """Return the bounds of an interval, see :func:`signed`; if rounded to 0, too, with a minus.

    Examples:
        >>> between(-0.04, 0.04), between(-1.2, -0.04)
        ('−0.0 … 0.0', '−1.2 … −0.0')
    """
    texts = [(x, signed(x, form)) for x in (low, high)]
    return " … ".join("−" * bool(x < -1e-9 and text[0] != "−") + text for x, text in texts)


def heading(column: str) -> str:
    """Return the heading of a column: its words, and the unit of its measure or of its name.

    Examples:
        >>> heading("energy_kwh_per_100km"), heading("cav_saving_pct")
        ('energy [kWh/100 km]', 'CAV saving [%]')
    """
    if column.endswith("]"):
        return column
    suffix = next((end for end in SUFFIX_UNITS if column.endswith(f"_{end}")), "")
    words = (column.removesuffix(f"_{suffix}") if suffix else column).split("_")
    text = " ".join(word.upper() if word in INITIALS else word for word in words)
    units = {measure.key: measure.unit for measure in MEASURES if measure.unit != SHARE}
    unit = SUFFIX_UNITS[suffix] if suffix else units.get(column)
    return f"{text} [{unit}]" if unit else text
