"""The table of a task: which strategies keep its limits, and what they save."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import field, replace

import pandas as pd
from rich.console import Group

from lcc_rl.energy import Fleet
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.results.cells import heading
from lcc_rl.results.headline import COLUMNS, Shown, resampled
from lcc_rl.results.names import in_words
from lcc_rl.results.savings import DRIVE, NOTHING, WAYS, savings
from lcc_rl.results.tables import strategies_side_by_side
from lcc_rl.results.units import check_unit, per_distance
from lcc_rl.settings import NonNegative, Settings

# Scores by name: the column that is divided by the distance of all vehicles.
PER_DISTANCE = {
    "energy": "total_energy_kj",
    "net_energy": "total_net_energy_kj",
    "path_energy": "total_path_energy_kj",
}
PLAIN = ("final_speed_spread_mps", "speed_std_mps", "string_ratio")
SCORE, DISTANCE, DAMPING = "score", "distance_m", "damping_time_s"
FLOW, FLOW_LOST = "flow_vph", "flow_lost"
NAMED = 0.05  # share of the flow from which on a table says that it is lost
MEANS = ("mean_gap_m", "mean_speed_mps", "final_speed_spread_mps", FLOW, "string_ratio")
# Columns that may have a limit, and what tables call them.
HEADINGS = {
    "max_gap_m": "gap\n≤ {:g}\n[m]",
    "max_time_gap_s": "time\ngap\n≤ {:g} s",
    "min_gap_m": "gap\n≥ {:g}\n[m]",
    "min_time_gap_s": "time\ngap\n≥ {:g} s",
    "min_ttc_s": "TTC\n≥ {:g} s",
    "share_leader_faster": "leader\nfaster\n≤ {:g} %",
    "share_time_gap_long": "long\ngaps\n≤ {:g} %",
    "share_time_gap_long_moving": "long\ngaps\n≤ {:g} %",
    "share_ttc_unsafe": "TTC\n< 4 s\n≤ {:g} %",
    "share_ttc_unpromised": "TTC\nbare\n≤ {:g} %",
    "share_turned_unsafe": "turned\nunsafe\n≤ {:g} %",
}
LARGEST, LEAST, SHARE = "max_", "min_", "share_"


class Task(Settings):
    """What a task asks for."""

    name: str
    # What is minimised: energy, net_energy or path_energy of all vehicles over their distance, or
    # a column of episodes.parquet.
    score: str = "net_energy"
    unit: str = "kJ/km"  # of an energy over a distance, see lcc_rl.results.units
    against: str = "human"  # the strategy that the others are compared with
    # Bounds by column: the largest value of max_… and the smallest of min_… in any episode, and
    # the largest mean of share_… over all episodes.
    limits: Mapping[str, NonNegative] = field(default_factory=dict)

    def settled(self) -> None:
        if self.score not in (*PER_DISTANCE, *PLAIN):
            raise unknown_name("score (task.score)", self.score, (*PER_DISTANCE, *PLAIN))
        for column in self.limits:
            if column not in HEADINGS:
                raise unknown_name("column of task.limits", column, HEADINGS)

    def among(self, strategies: Iterable[str]) -> Task:
        """Return the task for an evaluation of these strategies.

        If the strategy to compare against was not evaluated, the first that was is used.
        """
        names = list(dict.fromkeys(map(str, strategies)))
        return self if self.against in names else replace(self, against=names[0])

    @property
    def label(self) -> str:
        """The score with its unit, for tables."""
        named = heading(self.score)
        return f"{named} [{self.unit}]" if self.score in PER_DISTANCE else named


def scores(episodes: pd.DataFrame, task: Task, energy: Fleet) -> pd.DataFrame:
    """Score every strategy of an evaluation.

    Args:
        episodes: rows of an evaluation, every strategy on the same windows and drivers.
        task: the score and the limits.
        energy: the energy models, for units.

    Returns:
        One row per strategy: seeds, windows, drives, score, the share saved against
        ``task.against`` with its interval, the shares of the distance and the flow that are lost
        against it, means of gap, speed and traffic, on a ring the share of episodes that are
        damped and their mean damping time, the value of every limit, collisions, and whether the
        strategy keeps all limits and never collides.

    Raises:
        ConfigError: if the column of a limit, or the strategy ``task.against``, is missing.
    """
    check_unit(task.unit, energy)
    rows, per = _scored(episodes, task), [DISTANCE] if task.score in PER_DISTANCE else []
    missing = [column for column in task.limits if column not in rows]
    if missing:
        raise ConfigError(f"task.limits.{missing[0]}: episodes.parquet has no such column")
    if task.against not in set(episodes["strategy"]):
        raise ConfigError(f"task.against={task.against}: it is not among the strategies evaluated")
    whole = rows[rows["strategy"] == task.against]
    found = []
    for name, part in rows.groupby("strategy", sort=False):
        value, share = float(part[SCORE].mean()), NOTHING
        if per:
            value = per_distance(value / part[DISTANCE].mean() * 1e3, task.unit, energy)
        if name != task.against:
            share = savings(rows, SCORE, str(name), task.against, per)
        limits = {column: _worst(part, column) for column in task.limits}
        row: dict[str, object] = {"strategy": name, "seeds": part["training_seed"].nunique()}
        row |= {"windows": part["profile_id"].nunique()}
        row |= {"drives": part.get(DRIVE, part["profile_id"]).nunique()}
        row |= {"score": value, **share.columns("saving")}
        row |= {"distance_lost": _lost(part, whole, DISTANCE)}
        row |= {FLOW_LOST: _lost(part, whole, FLOW)} if FLOW in part else {}
        row |= {column: part[column].mean() for column in MEANS if column in part}
        if DAMPING in part:  # on a ring; the mean is over the episodes that are damped
            row |= {"damped": part[DAMPING].notna().mean(), DAMPING: part[DAMPING].mean()}
        row |= limits | {"collisions": int(part["collided"].sum())}
        kept = all(keeps(column, limits[column], task.limits[column]) for column in limits)
        found.append(row | {"kept": kept and not row["collisions"]})
    return pd.DataFrame(found)


def _scored(episodes: pd.DataFrame, task: Task) -> pd.DataFrame:
    """Return the rows with score, an energy as such, and distance of all vehicles.

    Where no vehicle is automated, none has a value that a limit bounds.
    """
    parts = [name for name in WAYS if name in episodes]
    none = {} if WAYS[0] in parts else dict.fromkeys(task.limits, float("nan"))
    rows = episodes.assign(**none, **{DISTANCE: episodes[parts].sum(axis=1)})
    column = PER_DISTANCE.get(task.score, task.score)
    score = rows[column] if column in rows else pd.Series(float("nan"), rows.index)
    alone = column.replace("total", "hdv")  # where nobody is automated
    if alone in rows:
        score = score.fillna(rows[alone])
    return rows.assign(**{SCORE: score})


def _lost(part: pd.DataFrame, whole: pd.DataFrame, column: str) -> float:
    """Return the share of the mean of a column that rows lose against others."""
    return float(1.0 - part[column].mean() / whole[column].mean())


def flow_note(table: pd.DataFrame, against: str) -> str:
    """Return in a sentence which strategies lose much of the flow; empty if none does."""
    lost = table.set_index("strategy").get(FLOW_LOST, pd.Series(dtype=float))
    lost = lost[lost > NAMED]
    parts = [f"{in_words(str(name))} {100.0 * share:.0f} %" for name, share in lost.items()]
    return f"Flow lost against {in_words(against)}: {'; '.join(parts)}." if parts else ""


def _worst(part: pd.DataFrame, column: str) -> float:
    """Return the value that the limit of a column bounds."""
    if column.startswith(SHARE):
        return float(part[column].mean())
    return float(part[column].max() if column.startswith(LARGEST) else part[column].min())


def keeps(column: str, value: float, bound: float) -> bool:
    """Whether a limit is kept; NaN, the value of a vehicle that does not exist, keeps it."""
    return not (value < bound if column.startswith(LEAST) else value > bound)


def limited(column: str) -> str:
    """Return the words of a column that may have a limit, without its bound."""
    return re.split(r"\s*[≤≥]", HEADINGS[column].replace("\n", " "))[0]


def _scale(column: str) -> float:
    """Return what a limited column is multiplied by in tables: shares are in per cent."""
    return 100.0 if column.startswith(SHARE) else 1.0


def _bounded(column: str, bound: float) -> str:
    """Return a limit in words, with line breaks as in the heading of a column."""
    return HEADINGS[column].format(_scale(column) * bound)


def _columns(task: Task, table: pd.DataFrame) -> tuple[Shown, ...]:
    """Return the columns of scores on the terminal: those of every table, and the limits."""
    flows = FLOW in table and table[FLOW].notna().any()
    way = Shown(FLOW, "flow\n[1/h]") if flows else Shown("distance_pct", "dis-\ntance\n[%]")
    limits = [Shown(name, _bounded(name, bound)) for name, bound in task.limits.items()]
    return (
        COLUMNS[0],
        Shown("score", task.label.replace(" ", "\n")),
        Shown("saved_pct", "saved\n[%]"),
        way,
        *limits,
        Shown("collisions", "colli-\nsions"),
        Shown("kept", "kept"),
    )


def headline(table: pd.DataFrame, task: Task) -> pd.DataFrame:
    """Shorten scores to what a reader asks first, as :func:`lcc_rl.results.headline.headline`."""
    percent = {f"saved_pct{end}": 100.0 * table[f"saving{end}"] for end in ("", "_low", "_high")}
    percent |= {name: _scale(name) * table[name] for name in task.limits}
    words = [in_words(str(name)) for name in table["strategy"]]
    found = table.assign(who=words, distance_pct=-100.0 * table["distance_lost"], **percent)
    shown = _columns(task, found)
    ends = [f"saved_pct{end}" for end in ("_low", "_high")]
    found = found[["strategy", *(column.key for column in shown), *ends]]
    saved = (
        f"saved: against {in_words(task.against)}, with the 95 % interval over {resampled(table)}; "
    )
    caption = (
        f"{saved * (len(table) > 1)}kept: all limits, without a collision; all measures: "
        f"table=all or --all. {flow_note(table, task.against)}"
    ).strip()
    found.attrs |= {"against": task.against, "caption": caption, "shown": shown}
    found.attrs |= {"score": SCORE, "label": task.label}
    return found


def in_full(table: pd.DataFrame, title: str, task: Task) -> Group:
    """Return all that scores hold as a table for the terminal, a column per strategy."""
    limits = sorted(task.limits, key=lambda column: column.startswith(SHARE))
    rows = (
        (task.label, "score", "{:.2f}"),
        (f"saved against {in_words(task.against)}", "saving", "{:+.2%}"),
        ("  95 % interval, low", "saving_low", "{:+.2%}"),
        ("    high", "saving_high", "{:+.2%}"),
        ("distance lost", "distance_lost", "{:+.2%}"),
        ("mean gap [m]", "mean_gap_m", "{:.1f}"),
        ("mean speed [m/s]", "mean_speed_mps", "{:.2f}"),
        ("spread of speeds at the end [m/s]", "final_speed_spread_mps", "{:.2f}"),
        ("flow [vehicles/h]", FLOW, "{:.0f}"),
        ("flow lost", FLOW_LOST, "{:+.2%}"),
        ("episodes that end calm", "damped", "{:.0%}"),
        ("  from when on, mean [s]", DAMPING, "{:.0f}"),
        ("string ratio", "string_ratio", "{:.2f}"),
        *(
            (
                f"limit: {' '.join(_bounded(column, task.limits[column]).split())}",
                column,
                "{:.2%}" if column.startswith(SHARE) else "{:.2f}",
            )
            for column in limits
        ),
        ("collisions", "collisions", "{:d}"),
        ("keeps the limits (1: yes)", "kept", "{:d}"),
        ("training seeds", "seeds", "{:d}"),
    )
    known = [row for row in rows if row[1] in table]
    caption = "intervals: over held-out windows (drives, if five or more) and training seeds"
    return strategies_side_by_side(table, known, title, caption)
