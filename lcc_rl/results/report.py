"""Reports of evaluations: measures, savings and limits by strategy, and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.energy import SECOND, Fleet
from lcc_rl.errors import require, require_known
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.files import Rows
from lcc_rl.results import measures
from lcc_rl.results.fronts import at_equal_flow
from lcc_rl.results.intervals import BOUNDED, NOTHING, varied
from lcc_rl.results.measures import (
    DISTANCE,
    FILTER_ACTS,
    FLOW,
    MEASURES,
    PATH,
    PATH_PER_KM,
    SHARE,
    WAYS,
    Measure,
    Shown,
)
from lcc_rl.results.names import ON_FRONT, RULE, RULE_ROWS, in_words, strategy_named, with_drivers
from lcc_rl.results.remarks import (
    FLOW_LOST,
    FLOW_NAMED,
    MARK,
    MORE_FLOW,
    ONE,
    by_ends,
    crashed,
    crashes,
    flow_note,
    front_note,
    remarks,
    seeds_note,
    verdict,
)
from lcc_rl.results.task import ELECTRIC, KJ, Task, burns_one_fuel, in_units
from lcc_rl.results.windows import (
    DRIVE,
    START,
    TRAINED,
    drives_of,
    savings,
    seeds_left_out,
    windows_of,
    with_bounds,
)

# Baselines of tables and verdicts; the first one that was evaluated is used.
AGAINST = (RECORDED, HUMAN, "idm", "idm_acc_filtered", "idm_acc", "rule", "reference")
# Strategies with which networks are compared. Only the rule is trained.
UNTRAINED = (
    *("direct", "idm", HUMAN, RECORDED, "constant_filtered", RULE),
    *("idm_acc_filtered", "acc_filtered", "idm_acc", "acc"),
)
SCORE = "score"
NONE = pd.Series(dtype=float)
SAVED = Shown("saved_pct", "saved\n[%]")
SECOND_SAVED = Shown("second_pct", "saved,\n{}\n[%]")
# Savings at the flow of the recorded drivers.
AT_FLOW = (
    Shown("flow_saved_pct", "saved at\ntheir flow\n[%]"),
    Shown("second_flow_saved_pct", "of {}\n[%]"),
    Shown("rule_pct", "against\nthe rule\n[%]"),
)
SAVINGS = {  # columns of short tables by estimate
    "saving": SAVED.key,
    "second_saving": SECOND_SAVED.key,
    "flow_saving": AT_FLOW[0].key,
    "second_flow_saving": AT_FLOW[1].key,
    "rule_saving": AT_FLOW[2].key,
}
WAY, FLOW_SHARE = Shown("distance_pct", "dis-\ntance\n[%]"), Shown("flow_pct", "flow\n[%]")
# Tables show what is more than the baseline's, in per cent.
LOST = {"distance_lost": (WAY.key, DISTANCE), FLOW_LOST: (FLOW_SHARE.key, FLOW)}
COLLISIONS, KEEPS = Shown("collisions", "colli-\nsions"), Shown("kept", "kept")
COUNTS = {x: x for x in ("windows", "drives", "minutes", "drivers")} | {"seeds": "training seeds"}
ALL = "all measures: table=all or --all."
CAPTION = f"Path energy per vehicle and km; {{}}{ALL}"
SHARES = "shares of the time: TTC < 4 s; time gap > 2.5 s above 1 m/s; "
FULL = (
    "energies: mean per episode; path energy: of the speeds without acceleration, and the loss by "
    "accelerating; saved: of path energy per km, or of a task's score; intervals: over drives, "
    "else minutes of the only one, else windows, and training seeds"
)


@dataclass(frozen=True)
class Report:
    """All measures of an evaluation behind one source of leaders, or of a case of a platoon.

    Args:
        of: name of the source or case; empty if there is only one.
        table: all measures, a row per strategy.
        short: the most important measures, with the columns ``shown``.
        rows: the measures of the full table.
        caption: caption of ``short``.
        full_caption: caption of the full table.
        against: the baseline of savings.
        score: column of ``short`` that is compared.
        label: its name with unit.
        verdict: sentences on the result; may be empty.
        remarks: sentences on limitations of the numbers.
        size: numbers of windows, drivers and steps in words; empty for a case.
    """

    of: str
    table: pd.DataFrame
    short: pd.DataFrame
    shown: tuple[Shown, ...]
    rows: Sequence[Measure]
    caption: str
    full_caption: str
    against: str | None = None
    score: str = SCORE
    label: str = SCORE
    verdict: str = ""
    remarks: Sequence[str] = ()
    size: str = ""

    @property
    def note(self) -> str:
        """Caption and remarks of the short table."""
        return " ".join([self.caption, *self.remarks]).strip()


def together(reports: Sequence[Report]) -> Report:
    """Return the rows of several sources or cases as one report, named in ``of``."""
    first, *rest = reports
    if not rest:
        return first
    table, short = (
        pd.concat([getattr(one, name).assign(of=one.of) for one in reports])
        for name in ("table", "short")
    )
    shown = (Shown("of", "of"), *first.shown)
    caption = first.note if {one.note for one in rest} == {first.note} else ""
    first = replace(first, size="; ".join(f"{x.of}: {x.size}" for x in reports if x.size))
    return replace(first, table=table, short=short, shown=shown, caption=caption, remarks=())


def windows_for(rows: Rows) -> pd.DataFrame:
    """Return the windows of an evaluation with the columns of all tables."""
    return windows_of(rows, measures.table_columns())


def baseline_of(strategies: Iterable[object]) -> str | None:
    """Return the baseline of tables and figures; None if there is none."""
    names = set(strategies)
    return next((name for name in AGAINST if name in names), None)


def summary(
    windows: pd.DataFrame,
    task: Task | None = None,
    energy: Fleet | None = None,
    against: str | None = None,
) -> pd.DataFrame:
    """Summarise every strategy but those along the front of a rule.

    Args:
        windows: result of :func:`windows_for`; all strategies have the same windows and drivers.
        task: score, baseline and limits; by default path energy per km, against the first of
            :data:`AGAINST`, without limits.
        energy: the energy models, for the unit of a task.
        against: the baseline without a task.

    Returns:
        One row per strategy: :data:`lcc_rl.results.measures.MEASURES`; ``saving``, the share of the
        score saved ``against`` the baseline, ``second_saving``, that of the second energy model,
        ``flow_saving`` and ``second_flow_saving``, those against the recorded drivers, or the
        baseline without them, at their flow, ``more_flow``, see
        :class:`lcc_rl.results.intervals.Estimate`, ``rule_saving``, that against the rule at this
        flow, and ``drawn_saving``, that of the energy drawn in an episode, and the share of the
        flow lost, with their intervals; ``end_saving``, the difference of the drawn and the first
        saving; the share of the distance lost; numbers of windows, drives,
        drivers behind each window and training seeds; ``left_out``, the seeds that the first saving
        leaves out, and ``single``, whether it has one training beside others of several; and for a
        task score, limits and whether they are kept without a collision. Missing values are NaN, as
        are savings and losses of a strategy with collisions, and of all if the baseline has some.

    Raises:
        ConfigError: if the column of a limit, or the baseline, is missing.
    """
    every = {str(name): frame for name, frame in windows.groupby("strategy", sort=False)}
    frames = {name: frame for name, frame in every.items() if ON_FRONT not in name}
    against = task.against if task else against or baseline_of(frames)
    require_known("strategy to compare against", () if against is None else against, frames)
    # Without automated vehicles the values of limits are missing.
    for column in task.limits if task and WAYS[0] in windows else ():
        require(column in windows, f"task.limits.{column}: episodes.parquet has no such column")
    reference = RECORDED if RECORDED in every else against or ""  # whose flow is that of savings
    column, *per = task.measure.columns if task else (PATH, DISTANCE)
    rows, hit = [], {name for name, frame in frames.items() if frame.get("collisions", NONE).sum()}
    for name, frame in frames.items():
        row: dict[str, Any] = {"strategy": name, "against": against or ""}
        kinds = {"windows": "profile_id", "drives": DRIVE, "seeds": TRAINED}
        row |= {key: frame.get(of, frame["profile_id"]).nunique() for key, of in kinds.items()}
        row |= {"minutes": len({*(drives_of(frame) or ())})} if START in frame else {}
        row |= {"drivers": int(frame["drivers"].max())} if "drivers" in frame else {}
        row["left_out"], seeds = seeds_left_out(windows, name, against)
        row["single"] = seeds == 1
        values: dict[str, Any] = {}
        drawn = with_bounds(frame, [one for one in MEASURES if one.interval])
        for one in MEASURES:
            if one.interval:
                values |= drawn.get(one.key, NOTHING).columns(one.key, one.factor)
            values[one.key] = one.value(frame)
        if task:
            unit = task.unit if task.measure.per and energy is not None else KJ
            row |= in_units(values, task.measure.key, SCORE, unit, energy)
        other = None if hit & {name, against} else against
        row |= _savings(windows, name, (column, per), other, reference)
        rows.append(row | values)
    table = pd.DataFrame(rows)
    table = table.astype({"collisions": int, "episodes": int}).copy()  # has few blocks
    table.attrs["reference"] = reference
    table["single"] &= table["seeds"].max() > 1
    base = table[table["strategy"] == against]
    for key, (_, lost) in LOST.items():
        share = 1.0 - table[lost] / (base[lost].iloc[0] if len(base) else np.nan)
        table[key] = table[key].fillna(share) if key in table else share  # of equal seeds if known
    table.loc[crashed(table), [*LOST, *(f"{FLOW}{end}" for end in BOUNDED)]] = np.nan
    if task:
        table["kept"] = table["collisions"] == 0
        for limit, bound in task.bounds.items():
            table[f"limit_{limit.key}"] = bound
            table["kept"] &= pd.Series([limit.keeps(x, bound) for x in table[limit.key]])
    return table


def _savings(
    windows: pd.DataFrame, name: str, of: tuple[str, Sequence[str]], against: str | None, flow: str
) -> dict[str, float]:
    """Return the savings of a strategy, see :func:`summary`; ``of``: energy and distances."""
    row: dict[str, float] = {}
    second = f"total_{SECOND}"
    for key, energy, per in (
        ("saving", *of),
        ("second_saving", second, [DISTANCE]),
        ("drawn_saving", "total_energy_kj", []),
        (FLOW_LOST, FLOW, []),
    ):
        comparable = against not in (None, name) and energy in windows
        share = savings(windows, energy, name, str(against), per) if comparable else NOTHING
        row |= share.columns(key)
    row["end_saving"] = row["drawn_saving"] - row["saving"]
    names = windows["strategy"].unique()
    theirs = [flow] if name != flow else []
    fronts = {x: [y for y in names if y.partition(ON_FRONT)[0] == x] for x in (*RULE_ROWS, name)}
    rule = next((x for x in RULE_ROWS if len(fronts[x]) > 1), "")
    for key, other, energy in (
        ("flow_saving", theirs, of[0]),
        ("second_flow_saving", theirs, second),
        ("rule_saving", fronts.get(rule, []) if name != rule else [], of[0]),
    ):
        front = fronts[name] if len(fronts[name]) > 1 and against is not None else []
        share = at_equal_flow(windows, front, other, energy, flow)
        row |= share.columns(key) | ({MORE_FLOW: share.more_flow} if key == "flow_saving" else {})
    return row


def report(
    windows: pd.DataFrame,
    task: Task | None = None,
    energy: Fleet | None = None,
    of: str = "",
    few: bool = False,
    against: str | None = None,
    second: Fleet | None = None,
    unit: str | None = None,
) -> Report:
    """Return the report of an evaluation.

    Args:
        windows: result of :func:`windows_for` for one source of leaders.
        task: the task, if any.
        energy: the energy models, for units; if all burn one fuel, tables include it in g/km.
        of: name of the source.
        few: whether the verdict mentions too few windows.
        against: the baseline; by default that of the task, or the first of :data:`AGAINST`.
        second: the second energy model, if any, for a heading.
        unit: energy per distance in tables, see :func:`lcc_rl.results.task.in_unit`; None:
            that of the task, or kJ/km, and g/km for one fuel.

    Raises:
        ConfigError: if the unit is unknown or does not fit the energy models.
    """
    against = strategy_named(against, windows["strategy"].unique()) if against else None
    if task:
        task = replace(task, against=against) if against else task.among(windows["strategy"])
        task = replace(task, unit=unit or task.unit).resolved(windows)
    table = summary(windows, task, energy, against)
    names = [(f"{shown}{x}", f"{key}{x}") for key, shown in SAVINGS.items() for x in BOUNDED]
    percent = {shown: 100.0 * table[key] for shown, key in names}
    units = [unit] if unit else [KJ, *["g/km"] * (energy is not None and burns_one_fuel(energy))]
    for one in units if task is None else ():
        percent |= in_units(table, PATH_PER_KM, _energy_in(one).key, one, energy)
    percent |= {shown: -100.0 * table[lost] for lost, (shown, _) in LOST.items()}
    every = with_drivers(pd.concat([table, pd.DataFrame(percent)], axis=1))
    reference = in_words(table.attrs["reference"])
    fields = _of_task(every, task) if task else _of_energy(every, units, second, reference)
    short, shown = fields.pop("short")
    baseline = str(table["against"].iloc[0])
    rows = _rows(task, baseline, reference, shown[1] if task or unit else None)
    text = "" if task else verdict(windows, table, few)
    seen, shown_windows = (x[x["strategy"].isin(short["strategy"])] for x in (table, windows))
    notes = [*remarks(shown_windows), *crashes(seen)]
    notes += filter(
        None, [flow_note(seen), front_note(seen, reference), by_ends(seen), seeds_note(seen)]
    )
    fields |= {"full_caption": FULL, "verdict": text, "remarks": notes}
    ends = {"_low": "_high", "_high": "_low"}
    bounds = {f"{FLOW_SHARE.key}{x}": -100.0 * table[f"{FLOW_LOST}{y}"] for x, y in ends.items()}
    every = every.filter(regex=f"^(?!{'|'.join(LOST)})").assign(**bounds)
    further = ["strategy", *short.columns.difference(every.columns, sort=False)]
    every = every.merge(short[further], how="left", on="strategy")
    return Report(of, every, short, shown, rows, **fields)


def _rows(task: Task | None, against: str, reference: str, score: Shown | None) -> list[Measure]:
    """Return the rows of the full table.

    Args:
        reference: whose flow is that of comparisons at equal flow, in words.
        score: the first number of the short table, if any.
    """
    bounds = task.bounds if task else {}
    limits = [
        replace(x, label=f"limit: {' '.join(x.bounded(bounds[x]).split())}", unit="", form=x.number)
        for x in sorted(bounds, key=lambda x: x.unit == SHARE)
    ]
    kept = [Measure("kept", "keeps the limits (1: yes)", form="{:d}")] if task else []
    return [
        *([Measure(score.key, score.words)] if score else ()),
        Measure("saving", f"saved against {in_words(against)}", form="{:+.2%}"),
        Measure("second_saving", "  second energy model", form="{:+.2%}"),
        Measure("flow_saving", f"  at equal flow, against {reference}", form="{:+.2%}"),
        Measure("rule_saving", "    against the rule", form="{:+.2%}"),
        Measure(MORE_FLOW, "    at more flow, by", form="{:+.2%}"),
        Measure("drawn_saving", "  as drawn, per episode", form="{:+.1%}"),
        Measure("end_saving", "    of it by start and end of episodes", form="{:+.1%}"),
        Measure(WAY.key, "distance against the baseline", form="{:+.2f}%"),
        Measure(FLOW_SHARE.key, "flow against the baseline", form="{:+.2f}%"),
        *(measure for measure in MEASURES if measure.label),
        *limits,
        *kept,
        *(Measure(key, label, form="{:.0f}") for key, label in COUNTS.items()),
    ]


def _of_energy(
    table: pd.DataFrame, units: Sequence[str], second: Fleet | None, reference: str
) -> dict[str, Any]:
    """Return the parts of a report that are specific to one without a task, most energy first."""
    # A string without automated vehicles has fewer vehicles and is not comparable.
    cars = table[table[PATH].notna()] if table[PATH].notna().any() else table
    cars = cars.sort_values(PATH_PER_KM, ascending=False, kind="stable").reset_index(drop=True)
    against = (cars["against"].iloc[0] or None) if len(cars) > 1 else None
    shown = [*map(_energy_in, units)]
    spread = [one.key for one in shown if against is None and len(cars) > 1]
    loss, basis = FLOW_SHARE, f"flow against {in_words(str(against))}"
    if cars[FLOW_SHARE.key].isna().all():
        loss, basis = WAY, "distance against theirs"
    note = "" if against is None else f"{saved_against(cars, against)}; {basis}; "
    note += f"{with_interval(cars, 'energy')}; " * bool(spread)
    short = [one for one in MEASURES if one.short]
    columns = {one.shown.key: one.scale * cars[one.key] for one in short}
    fronts = [one for one in AT_FLOW if cars[one.key].notna().any()]
    seconds = [SECOND_SAVED] * bool(cars[SECOND_SAVED.key].notna().any() and not fronts)
    shown += [] if against is None else [SAVED, *seconds, loss]
    shown += fronts or [one.shown for one in short]
    of = "fuel" if second is not None and burns_one_fuel(second) else "second model"
    shown = [Shown(key, heading.format(of)) for key, heading in [*shown, COLLISIONS]]
    note += SHARES * (not fronts)
    if AT_FLOW[0] in fronts and in_words(str(against)) != reference:
        note += f"saved at their flow: against {reference}, at the flow of these; "
    return {
        "short": shortened(cars.assign(**columns), shown, spread),
        "caption": CAPTION.format(note + behind_filter(cars)),
        "against": against,
        "score": shown[0].key,
        "label": f"path energy per km [{units[0]}]",
    }


def _energy_in(unit: str) -> Shown:
    """Return the column of energies or fuel per distance in a unit."""
    key, name = ("energy", "energy") if unit in ELECTRIC else ("path_fuel", "fuel")
    return Shown(f"{key}_{unit.replace('/', '_per_').lower()}", f"{name}\n[{unit}]")


def behind_filter(found: pd.DataFrame) -> str:
    """Return the caption on the strategies behind the safety filter; empty without any."""
    behind, words = found[FILTER_ACTS].notna(), list[str]()
    others, called = behind, found["strategy"].str.endswith(FILTERED)
    for group, rows in (("trained ones", found["seeds"] > 0), ("those called filtered", called)):
        if rows.any() and behind[rows].all():
            words, others = [*words, group], others & ~rows
    words += map(in_words, found["strategy"][others])
    return f"strategies behind the safety filter: {', '.join(words)}; " if words else ""


def _of_task(table: pd.DataFrame, task: Task) -> dict[str, Any]:
    """Return the parts of a report that are specific to a task: score and limits."""
    distance = Shown(FLOW, "flow\n[1/h]") if table[FLOW].notna().any() else WAY
    limits = [Shown(limit.shown.key, limit.bounded(bound)) for limit, bound in task.bounds.items()]
    shown = [
        Shown(SCORE, task.label.replace(" ", "\n")),
        SAVED,
        *(() if distance.key in {limit.key for limit in limits} else [distance]),
        *limits,
        COLLISIONS,
        KEEPS,
    ]
    columns = {limit.shown.key: limit.scale * table[limit.key] for limit in task.bounds}
    note, least = saved_against(table, task.against, always=True), task.measure.least
    if (table.loc[table["strategy"] == task.against, SCORE] < least).any():
        note = f"no saving: the baseline, {in_words(task.against)}, is below {least:g} "
        note += task.measure.unit
    saved = f"{note}; " * (len(table) > 1)
    caption = f"{saved}kept: all limits, without a collision; {ALL}"
    short, headed = shortened(table.assign(**columns), shown)
    unit = task.unit if task.measure.per else task.measure.unit
    short = short.assign(unit=unit)  # in CSV, where the score has no heading
    return {
        "short": (short, headed),
        "caption": caption,
        "against": task.against,
        "label": task.label,
    }


def shortened(
    table: pd.DataFrame, shown: Sequence[Shown], spread: Iterable[str] = ()
) -> tuple[pd.DataFrame, tuple[Shown, ...]]:
    """Return columns of a :func:`with_drivers` table, and the columns.

    Savings and the columns ``spread`` have their intervals. Strategies that lose more than 2 % of
    the flow, and single trainings beside several, are marked. With several seeds, collisions are
    means of a training.
    """
    if table.get("seeds", pd.Series([0])).max() > 1:
        per = Shown(f"{COLLISIONS.key}_per_seed", f"{COLLISIONS.heading}\n/ seed")
        shown = [*(per if one == COLLISIONS else one for one in shown), Shown("seeds", "seeds")]
        table = table.assign(**{per.key: table["collisions"] / table["seeds"].clip(lower=1)})
    counts = [key for key in ("windows", "drivers") if key in table and table[key].nunique() > 1]
    shown = [*shown, *(Shown(key, key) for key in counts)]
    lost = table.get(FLOW_LOST, pd.Series(np.nan, table.index)) > FLOW_NAMED
    single = table.get("single", lost & False)
    rows = zip(table["driver"], lost, single, strict=True)
    table = table.assign(driver=[x + MARK * y + ONE * z for x, y, z in rows])
    shown = (Shown("driver", "driven by"), *shown)
    ranged = {*SAVINGS.values(), *spread}
    names = [
        f"{x.key}{end}" for x in shown for end in (BOUNDED if x.key in ranged else BOUNDED[:1])
    ]
    names += [key for key in COUNTS if key not in names]
    return table[["strategy", *(x for x in names if x in table)]], shown


def saved_against(found: pd.DataFrame, against: str, always: bool = False) -> str:
    """Return a caption on the baseline of savings and their intervals.

    Args:
        found: a row per strategy with its numbers of ``windows``, ``drives`` and ``seeds``.
        against: the baseline.
        always: mention intervals even if there are none.
    """
    caption = f"saved: against {in_words(against)}"
    if not always and found["saving_low"].isna().all():
        return caption
    return with_interval(found, caption)


def with_interval(found: pd.DataFrame, words: str) -> str:
    """Return the words with the kind of the interval; ``found`` as for :func:`saved_against`."""
    names = ("windows", "drives", "minutes", "seeds")
    windows, drives, minutes, seeds = (int(found.get(x, pd.Series([0])).max()) for x in names)
    unit, counts = varied(drives, minutes), {"drives": drives, "minutes": minutes}
    over = f"{counts[unit]} {unit}" if unit in counts else unit
    over += " of one training" * (seeds == 1)
    if seeds > 1:
        up_to = "up to " if found.loc[found["seeds"] > 0, "seeds"].nunique() > 1 else ""
        over += f" and {up_to}{seeds} training seeds"
    if drives == 1 < windows:
        over += " (too narrow: all windows are of one drive)"
    return f"{words}, with the 95 % interval over {over}"
