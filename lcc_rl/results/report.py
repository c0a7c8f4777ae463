"""Reports of evaluations: measures, savings and limits by strategy, and a verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.config import choices
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.energy import Fleet
from lcc_rl.errors import require, require_known
from lcc_rl.io.files import Rows
from lcc_rl.results import measures
from lcc_rl.results.bootstrap import LEAST_DRIVES, NOTHING
from lcc_rl.results.measures import (
    BROKEN,
    FASTER,
    FLOW,
    LONG_GAPS,
    MEASURES,
    PATH,
    PATH_PER_KM,
    REACH,
    SHARE,
    Measure,
    Shown,
)
from lcc_rl.results.names import HUMAN, NETWORK, counted_windows, in_words, several
from lcc_rl.results.task import Task
from lcc_rl.results.units import burns_one_fuel, check_unit, in_unit
from lcc_rl.results.windows import DISTANCE, DRIVE, TRAINED, WAYS, savings, windows_of

# Baselines of tables and verdicts; the first one that was evaluated is used.
AGAINST = (HUMAN, "idm", "idm_acc_filtered", "idm_acc", "rule", "reference")
RULE = "rule"  # the IDM, tuned on the same data by the gradient
RULE_ROWS = (RULE, "idm_acc_filtered", "idm_acc")
# Strategies with which networks are compared. Only the rule is trained.
UNTRAINED = (
    *("direct", "idm", HUMAN, RECORDED, "constant_filtered", RULE),
    *("idm_acc_filtered", "acc_filtered", "idm_acc", "acc"),
)
FEW_WINDOWS, SHORT = 5, 150.0  # least number of windows; length of short ones [s]
SCORE, FLOW_LOST = "score", "flow_lost"
FEW_DRIVES = ("saving_drives_low", "saving_drives_high")  # t-interval over fewer than five drives
SAVED = Shown("saved_pct", "saved\n[%]")
WAY, FLOW_SHARE = Shown("distance_pct", "dis-\ntance\n[%]"), Shown("flow_pct", "flow\n[%]")
COLLISIONS, KEEPS = Shown("collisions", "colli-\nsions"), Shown("kept", "kept")
FLOW_NAMED = 0.05  # loss of flow that tables mention, as a share
MUCH = 0.01  # share of time with infeasible accelerations that tables and log mention
MOSTLY = 0.2  # share of time; I-80's drivers behind its leaders have 0.02, the stream's 0.06
ALL = "all measures: table=all or --all."
CAPTION = (
    "Energy per vehicle and km, net of kinetic energy; {}shares of the time: "
    f"TTC < 4 s; time gap > 2.5 s above 1 m/s; {ALL}"
)
BEHIND_FILTER = "networks and strategies called filtered drive behind the safety filter; "
FULL = (
    "energies: mean per episode; path energy: net of kinetic energy; saved: of path energy per "
    "km, or of a task's score; intervals: over held-out windows, or drives if there are five or "
    "more, and training seeds"
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

    @property
    def note(self) -> str:
        """Caption and remarks of the short table."""
        return " ".join([self.caption, *self.remarks]).strip()


def together(reports: Sequence[Report]) -> Report:
    """Return the rows of several sources or cases as one report, named in ``of``."""
    first, *others = reports
    if not others:
        return first
    table, short = (
        pd.concat([getattr(one, name).assign(of=one.of) for one in reports])
        for name in ("table", "short")
    )
    shown = (Shown("of", "of"), *first.shown)
    caption = first.note if {one.note for one in others} == {first.note} else ""
    return replace(first, table=table, short=short, shown=shown, caption=caption, remarks=())


def windows_for(rows: Rows) -> pd.DataFrame:
    """Return the windows of an evaluation with the columns of all tables."""
    return windows_of(rows, measures.table_columns())


def baseline_of(strategies: Iterable[object]) -> str | None:
    """Return the baseline of tables and figures; None if there is none."""
    known = set(strategies)
    return next((name for name in AGAINST if name in known), None)


def summary(
    windows: pd.DataFrame,
    task: Task | None = None,
    energy: Fleet | None = None,
    against: str | None = None,
) -> pd.DataFrame:
    """Summarise every strategy.

    Args:
        windows: result of :func:`windows_for`; all strategies have the same windows and drivers.
        task: score, baseline and limits; by default path energy per km, against the first of
            :data:`AGAINST`, without limits.
        energy: the energy models, for the unit of a task.
        against: the baseline without a task.

    Returns:
        One row per strategy: :data:`lcc_rl.results.measures.MEASURES`; ``saving``, the share of
        the score saved ``against`` the baseline, and ``drawn_saving``, that of the energy drawn
        in an episode, with their intervals; the shares of distance and flow lost; numbers of
        windows, drives and training seeds; and for a task score, limits and whether they are kept
        without a collision. Missing values are NaN.

    Raises:
        ConfigError: if the column of a limit, or the baseline, is missing.
    """
    parts = {str(name): part for name, part in windows.groupby("strategy", sort=False)}
    against = task.against if task else against or baseline_of(parts)
    require_known("strategy to compare against", () if against is None else against, parts)
    # Without automated vehicles the values of limits are missing.
    for column in task.limits if task and WAYS[0] in windows else ():
        require(column in windows, f"task.limits.{column}: episodes.parquet has no such column")
    column, *per = task.measure.columns if task else (PATH, DISTANCE)
    rows = []
    for name, part in parts.items():
        row: dict[str, Any] = {"strategy": name, "against": against or ""}
        kinds = {"windows": "profile_id", "drives": DRIVE, "seeds": TRAINED}
        row |= {key: part.get(of, part["profile_id"]).nunique() for key, of in kinds.items()}
        if task:
            row |= {SCORE: score_of(task, part, energy)}
        for key, of in {"saving": (column, per), "drawn_saving": ("total_energy_kj", [])}.items():
            known = against not in (None, name) and of[0] in windows
            share = savings(windows, of[0], name, str(against), of[1]) if known else NOTHING
            row |= share.columns(key)
            if key == "saving":
                row |= dict(zip(FEW_DRIVES, share.over_drives or (np.nan, np.nan), strict=True))
        row |= {measure.key: measure.value(part) for measure in MEASURES}
        rows.append(row)
    table = pd.DataFrame(rows)
    table = table.astype({"collisions": int, "episodes": int})
    whole = table[table["strategy"] == against]
    for key, lost in {"distance_lost": DISTANCE, FLOW_LOST: FLOW}.items():
        table[key] = 1.0 - table[lost] / (whole[lost].iloc[0] if len(whole) else np.nan)
    if task:
        table["kept"] = table["collisions"] == 0
        for one, bound in task.bounds.items():
            table[f"limit_{one.key}"] = bound
            table["kept"] &= pd.Series([one.keeps(x, bound) for x in table[one.key]])
    return table


def score_of(task: Task, part: pd.DataFrame, energy: Fleet | None) -> float:
    """Return the score of a strategy's windows in the task's unit."""
    value = task.measure.value(part)
    if not task.measure.per or energy is None:
        return value
    check_unit(task.unit, energy)
    return in_unit(value, task.unit, energy)


def report(
    windows: pd.DataFrame,
    task: Task | None = None,
    energy: Fleet | None = None,
    filtered: bool = False,
    of: str = "",
    few: bool = False,
    against: str | None = None,
) -> Report:
    """Return the report of an evaluation.

    Args:
        windows: result of :func:`windows_for` for one source of leaders.
        task: the task, if any.
        energy: the energy models, for units; if all burn one fuel, tables include it in g/km.
        filtered: whether there is a safety filter, for the caption.
        of: name of the source.
        few: whether the verdict mentions too few windows.
        against: the baseline; by default that of the task, or the first of :data:`AGAINST`.
    """
    if task:
        task = replace(task, against=against) if against else task.among(windows["strategy"])
        task = task.resolved(windows)
    table, notes = summary(windows, task, energy, against), remarks(windows)
    percent = {f"saved_pct{end}": 100.0 * table[f"saving{end}"] for end in ("", "_low", "_high")}
    percent["distance_pct"] = -100.0 * table["distance_lost"] + 0.0  # no negative zero
    every = table.assign(**percent)
    made = _of_task(every, task) if task else _of_energy(every, energy, filtered)
    short, shown = made.pop("short")
    rows = _rows(task, table["against"].iloc[0])
    words = "" if task else verdict(windows, table, few)
    words = "\n".join(filter(None, [words, few_drives(table)]))
    made |= {"full_caption": FULL, "verdict": words, "remarks": notes}
    return Report(of, table, short, shown, rows, **made)


def _rows(task: Task | None, against: str | None) -> list[Measure]:
    """Return the rows of the full table."""
    bounds = task.bounds if task else {}
    kept = [Measure("kept", "keeps the limits (1: yes)", "{:d}")] if task else []
    counts = {"windows": "windows", "drives": "drives", "seeds": "training seeds"}
    return [
        *([Measure(SCORE, task.label)] if task else ()),
        Measure("saving", f"saved against {in_words(str(against))}", "{:+.2%}"),
        Measure("saving_low", "  95 % interval, low", "{:+.2%}"),
        Measure("saving_high", "    high", "{:+.2%}"),
        Measure(FEW_DRIVES[0], "  over its few drives (t), low", "{:+.2%}"),
        Measure(FEW_DRIVES[1], "    high", "{:+.2%}"),
        Measure("drawn_saving", "  as drawn, per episode", "{:+.1%}"),
        Measure("distance_lost", "distance lost", "{:+.2%}"),
        Measure(FLOW_LOST, "flow lost", "{:+.2%}"),
        *(one for one in MEASURES if one.label),
        *(
            replace(one, label=f"limit: {' '.join(one.bounded(bounds[one]).split())}")
            for one in sorted(bounds, key=lambda one: one.key.startswith(SHARE))
        ),
        *kept,
        *(Measure(key, label, "{:d}") for key, label in counts.items()),
    ]


def _of_energy(table: pd.DataFrame, energy: Fleet | None, filtered: bool) -> dict[str, Any]:
    """Return the parts of a report that are specific to one without a task.

    The short table has rows for strategies with an automated vehicle, largest energy first.
    """
    # A string without automated vehicles has fewer vehicles and is not comparable.
    cars = table[table[PATH].notna()] if table[PATH].notna().any() else table
    cars = cars.sort_values(PATH_PER_KM, ascending=False, kind="stable").reset_index(drop=True)
    against = (cars["against"].iloc[0] or None) if len(cars) > 1 else None
    source, flow = flow_against(cars)
    way, basis = (WAY, "distance against theirs") if flow.isna().all() else (FLOW_SHARE, source)
    note = "" if against is None else f"{saved_against(cars, against)}; {basis}; "
    short = [one for one in MEASURES if one.short]
    columns = {"energy_kj_per_km": cars[PATH_PER_KM], FLOW_SHARE.key: flow}
    columns |= {one.shown.key: (one.scale * cars[one.key]).round(2) for one in short}
    shown = [Shown("energy_kj_per_km", "energy\n[kJ/km]")]
    if energy is not None and burns_one_fuel(energy):
        columns["fuel_g_per_km"] = cars[PATH_PER_KM] * in_unit(1.0, "g/km", energy)
        shown.append(Shown("fuel_g_per_km", "fuel\n[g/km]"))
    shown += [] if against is None else [SAVED, way]
    shown += [*(one.shown for one in short), COLLISIONS]
    return {
        "short": shortened(cars.assign(**columns), shown),
        "caption": CAPTION.format(note + BEHIND_FILTER * filtered),
        "against": against,
        "score": "energy_kj_per_km",
        "label": "path energy per km [kJ/km]",
    }


def _of_task(table: pd.DataFrame, task: Task) -> dict[str, Any]:
    """Return the parts of a report that are specific to a task: score and limits."""
    way = Shown(FLOW, "flow\n[1/h]") if table[FLOW].notna().any() else WAY
    limits = [Shown(one.key, one.bounded(bound)) for one, bound in task.bounds.items()]
    shown = [
        Shown(SCORE, task.label.replace(" ", "\n")),
        SAVED,
        *(() if way.key in {one.key for one in limits} else [way]),
        *limits,
        COLLISIONS,
        KEEPS,
    ]
    columns = {one.key: one.scale * table[one.key] for one in task.bounds}
    saved = f"{saved_against(table, task.against, always=True)}; " * (len(table) > 1)
    caption = f"{saved}kept: all limits, without a collision; {ALL} {flow_note(table)}".strip()
    short = shortened(table.assign(**columns), shown)
    return {"short": short, "caption": caption, "against": task.against, "label": task.label}


def shortened(
    table: pd.DataFrame, shown: Sequence[Shown]
) -> tuple[pd.DataFrame, tuple[Shown, ...]]:
    """Return columns of a table with intervals and strategies in words, and the columns."""
    table = table.assign(driver=[in_words(str(name)) for name in table["strategy"]])
    shown = (Shown("driver", "driven by"), *shown)
    names = [f"{one.key}{end}" for one in shown for end in ("", "_low", "_high")]
    return table[["strategy", *(x for x in names if x in table)]], shown


def saved_against(found: pd.DataFrame, against: str, always: bool = False) -> str:
    """Return a caption on the baseline of savings and their intervals.

    Args:
        found: a row per strategy with its numbers of ``windows``, ``drives`` and ``seeds``.
        against: the baseline.
        always: mention intervals even if there are none.
    """
    words = f"saved: against {in_words(against)}"
    if not always and found["saving_low"].isna().all():
        return words
    windows, drives, seeds = (int(found[name].max()) for name in ("windows", "drives", "seeds"))
    over = "windows" if drives < LEAST_DRIVES else f"{drives} drives"
    if seeds > 1:
        up_to = "up to " if found.loc[found["seeds"] > 0, "seeds"].nunique() > 1 else ""
        over += f" and {up_to}{seeds} training seeds"
    if drives < min(LEAST_DRIVES, windows):
        of = "one drive" if drives == 1 else f"only {drives} drives"
        over += f" (too narrow: all windows are of {of})"
    return f"{words}, with the 95 % interval over {over}"


def few_drives(table: pd.DataFrame) -> str:
    """Return a sentence with the intervals over fewer than five drives; empty without any."""
    found = table[table[FEW_DRIVES[0]].notna()]
    rows = zip(found["strategy"], *(100.0 * found[name] for name in FEW_DRIVES), strict=True)
    words = (f"{in_words(str(name))} {low:.1f} … {high:.1f}" for name, low, high in rows)
    text = "; ".join(words).replace("-", "−")
    return f"Saved [%], t-interval over {table['drives'].max()} drives: {text}." if text else ""


def flow_against(table: pd.DataFrame) -> tuple[str, pd.Series]:
    """Return the caption of the flow's baseline, and the differences to it [%].

    The baseline is the recorded drivers, else that of the savings.
    """
    known = set(table["strategy"])
    name = RECORDED if RECORDED in known else table["against"].iloc[0]
    whole = table.loc[table["strategy"] == name, FLOW]
    share = table[FLOW] / (whole.iloc[0] if len(whole) else np.nan) - 1.0
    return f"flow against {in_words(str(name))}", 100.0 * share


def flow_note(table: pd.DataFrame) -> str:
    """Return a sentence on strategies that lose much flow; empty if none does."""
    lost = table[table[FLOW_LOST] > FLOW_NAMED]
    named = zip(lost["strategy"], lost[FLOW_LOST], strict=True)
    parts = (f"{in_words(str(name))} {100.0 * share:.0f} %" for name, share in named)
    against = in_words(str(table["against"].iloc[0]))
    return f"Flow lost against {against}: {'; '.join(parts)}." if len(lost) else ""


def verdict(windows: pd.DataFrame, found: pd.DataFrame, of_few: bool = True) -> str:
    """Return a sentence on the result of the network; empty without one.

    If no network has its variant's name, each network has a sentence.

    Args:
        windows: result of :func:`windows_for`.
        found: their :func:`summary`.
        of_few: whether too few windows are mentioned.
    """
    cars = found[found[PATH].notna()].to_dict("records")
    rows: dict[str, Any] = {str(row["strategy"]): row for row in cars}
    other = next((name for name in (*RULE_ROWS, HUMAN) if name in rows), None)
    if other is None:
        return ""
    learned = [name for name, row in rows.items() if row["seeds"] and name not in RULE_ROWS]
    names = [NETWORK] if NETWORK in rows else learned
    words = []
    for name in names:
        if (count := rows[name]["windows"]) >= FEW_WINDOWS:
            words.append(_sentence(windows, rows, name, other))
        elif of_few:
            both = (f"{rows[x][PATH_PER_KM]:,.1f} kJ ({in_words(x)})" for x in (name, other))
            few = f"{counted_windows(count)} are too few for a conclusion."
            words.append(f"Per vehicle and km: {', '.join(both)}; {few}")
    least = min(rows, key=lambda name: rows[name][PATH_PER_KM])
    # It may be the user's rule.
    if words and rows[least]["windows"] >= FEW_WINDOWS and least not in (*names, other):
        words.append(f"Least energy: {in_words(least)}, {rows[least][PATH_PER_KM]:,.1f} kJ/km.")
    return "\n".join(words)


def _sentence(windows: pd.DataFrame, rows: Mapping[str, Any], name: str, other: str) -> str:
    """Return a sentence that compares a network with another strategy."""
    share = savings(windows, PATH, name, other, [DISTANCE])
    saved, low, high = (100.0 * x for x in (share.value, share.low, share.high))
    less = "less"
    if saved < 0.0:
        less, saved, low, high = "more", -saved, -high, -low
    within = "" if low > 0.0 else ", within the uncertainty"
    own, theirs = (100.0 * rows[x][LONG_GAPS] for x in (name, other))
    article = "the " if in_words(name) != name else ""
    interval = f"({low:.1f} … {high:.1f})".replace("-", "−")
    flows = [f"{rows[x][FLOW]:,.0f}" for x in (name, other, RECORDED) if x in rows]
    flow = f"; flow: {flows[0]} vehicles per hour against {flows[1]}"
    flow += f", {in_words(RECORDED)} {flows[2]}" if len(flows) > 2 else ""
    flow *= bool(np.isfinite(rows[name][FLOW]))
    return (
        f"With {article}{in_words(name)}, energy per vehicle and km is {saved:.1f} % {interval} "
        f"{less} than with {in_words(other)}{within}; long time gaps: {own:.2f} % of "
        f"the time against {theirs:.2f} %{flow}."
    )


def remarks(windows: pd.DataFrame) -> list[str]:
    """Return sentences on limitations of the numbers of an evaluation."""
    means, found = measures.means(windows, (*REACH, BROKEN)), []

    def named(shares: pd.Series, least: float) -> str:
        large = shares[shares > least].items()
        return ", ".join(f"{in_words(str(name))} {share:.2%}" for name, share in large)

    if names := named(means[list(REACH)].max(axis=1), MUCH):
        found.append(
            "Vehicles accelerate harder, or hold a higher speed, than their energy model allows "
            f"for more than {MUCH:.0%} of the time ({names}): their energies are lower bounds."
        )
    if names := named(means[BROKEN], 0.0):
        found.append(
            f"Steps that the filter's guarantee covers turn unsafe ({names}): brakes, delays or "
            "sensors differ from scenario.actuators and scenario.sensors."
        )
    return found


def leader_too_fast(windows: pd.DataFrame, of_task: bool = False) -> list[str]:
    """Return a warning for every driver with a desired speed that leaders mostly exceed.

    Such a driver falls behind with any strategy, so energies reflect distances. There is no warning
    for strategies behind a safety filter, or for networks, whose share is that of drivers behind.

    Args:
        windows: result of :func:`windows_for`.
        of_task: whether a task is evaluated, which defines the strategies.
    """
    remedies = {
        "direct": "drivers=highway, or drivers calibrated on such traffic",
        "idm": "variant=idm scenario.controllers.automated.desired_speed=45 'compare=[<run>]'",
    }
    remedies[HUMAN] = remedies["direct"]
    if of_task:
        remedies["idm"] = "compare with human, which has the v0 of drivers=…"
    shares = measures.means(windows, (FASTER,))[FASTER]
    people = [shares[name] for name in (HUMAN, "direct") if name in shares]
    for name in shares.index if people else ():
        if not name.endswith(FILTERED) and not np.isclose(shares[name], people).any():
            driver = "scenario.controllers.automated"
            option = f"variant=idm controller@{driver}={name} {driver}.desired_speed=45"
            option += " 'compare=[<run>]'"
            own = "desired_speed: 45 beside its other settings in compare="
            remedies.setdefault(name, option if name in choices("controller") else own)
    return [
        f"the leaders drive faster than the desired speed of {name} for {shares[name]:.0%} of the "
        f"time (more than {MOSTLY:.0%}): savings against it are not valid. Raise v0: {remedy}"
        for name, remedy in remedies.items()
        if shares.get(name, 0.0) > MOSTLY
    ]


def sample_of(rows: pd.DataFrame, drivers: pd.DataFrame | None = None) -> str:
    """Return the numbers of windows and drivers of rows, for a title."""
    windows, people = rows["profile_id"].nunique(), (rows if drivers is None else drivers)
    size = several(people["driver_id"].nunique(), "driver")
    return f"{counted_windows(windows, 'held-out ')} × {size}"


def few_windows(windows: int, seconds: float | None = None) -> str:
    """Return a warning on few windows; empty for enough or long ones.

    Args:
        windows: number of windows.
        seconds: length of each, if it is known.
    """
    if windows >= FEW_WINDOWS or windows * (seconds or 0.0) >= SHORT:
        return ""
    found = counted_windows(windows) + (f" of {seconds:g} s" if seconds else "")
    return f"{found} are too few for conclusions: these numbers only show that everything runs"
