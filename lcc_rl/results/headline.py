"""The table that every command prints: a row per strategy, the columns that a reader asks first."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import pandas as pd
from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from lcc_rl.energy import Fleet
from lcc_rl.errors import unknown_name
from lcc_rl.results.bootstrap import LEAST_DRIVES
from lcc_rl.results.cells import MISSING, column_cells
from lcc_rl.results.names import HUMAN, NETWORK, in_words
from lcc_rl.results.savings import KEYS
from lcc_rl.results.tables import PATH, PER_KM, ROWS, strategies_side_by_side
from lcc_rl.results.units import burns_one_fuel, per_distance
from lcc_rl.runs.output import PLAIN

# Whom tables compare with, and whom the verdict compares a network with: the first that there is.
AGAINST = (HUMAN, "idm", "idm_acc_filtered", "idm_acc", "rule", "reference")
RULES = ("rule", "idm_acc_filtered", "idm_acc")
FEW, SHORT, WIDEST = 5, 150.0, 10_000  # windows; seconds of them; characters
CAPTION = (
    "Energy per vehicle and km, without what motion stores; {}shares of the time: "
    "TTC < 4 s; time gap > 2.5 s above 1 m/s; all measures: table=all or --all."
)
BEHIND = "networks, and those called filtered, drive behind the safety filter; "
COMPARED = "saved: against {}{}; distance against theirs; "
INTERVAL = ", with the 95 % interval over {}"


class Shown(NamedTuple):
    """A column of a table on the terminal; one with an interval shows sign and interval."""

    key: str
    heading: str


COLUMNS = (
    Shown("who", "driven by"),
    Shown("energy_kj_per_km", "energy\n[kJ/km]"),
    Shown("fuel_g_per_km", "fuel\n[g/km]"),
    Shown("saved_pct", "saved\n[%]"),
    Shown("distance_pct", "dis-\ntance\n[%]"),
    Shown("unsafe_ttc_pct", "TTC\n< 4 s\n[%]"),
    Shown("long_time_gap_pct", "long\ngap\n[%]"),
    Shown("collisions", "colli-\nsions"),
)


def baseline_of(strategies: Iterable[object]) -> str | None:
    """Return the strategy that tables and figures compare with; None without one."""
    known = set(strategies)
    return next((name for name in AGAINST if name in known), None)


def resampled(found: pd.DataFrame) -> str:
    """Return what the intervals of savings are over, in words, and whether they are too narrow.

    Args:
        found: a row per strategy with its numbers of ``windows``, ``drives`` and ``seeds``.
    """
    windows, drives, seeds = (int(found[name].max()) for name in ("windows", "drives", "seeds"))
    over = "windows" if drives < LEAST_DRIVES else f"{drives} drives"
    if seeds > 1:
        up_to = "up to " if found.loc[found["seeds"] > 0, "seeds"].nunique() > 1 else ""
        over += f" and {up_to}{seeds} training seeds"
    if drives < min(LEAST_DRIVES, windows):
        over += f" (too narrow: windows of {several(drives, 'drive')} are alike)"
    return over


def headline(
    found: pd.DataFrame, energy: Fleet | None = None, filtered: bool = False
) -> pd.DataFrame:
    """Shorten a summary to what a reader asks first.

    Args:
        found: of :func:`lcc_rl.results.tables.summary`.
        energy: the energy models; where all burn one fuel, the table has it in g/km, too.
        filtered: whether there is a safety filter, for the caption.

    Returns:
        A row per strategy with a controlled car, if any has one, those that draw most first: path
        energy per vehicle and km [kJ/km], of several strategies the share saved [%] against
        :func:`baseline_of` with its interval and the distance [%] against it, the shares of the
        time [%] with an unsafe time-to-collision and a long time gap, and collisions. Its
        ``attrs`` hold the baseline (``against``), the column that is compared (``score``) and its
        name with unit (``label``), the columns that are ``shown`` and the ``caption``.
    """
    # Beside others, a string without controlled cars is of fewer vehicles, and not to be compared.
    cars = found[found[PATH].notna()] if found[PATH].notna().any() else found
    cars = cars.sort_values(PER_KM, ascending=False, kind="stable")
    against = baseline_of(cars["strategy"]) if len(cars) > 1 else None
    table = pd.DataFrame({"strategy": cars["strategy"]})
    table["who"] = [in_words(str(name)) for name in cars["strategy"]]
    table["energy_kj_per_km"] = cars[PER_KM]
    if energy is not None and burns_one_fuel(energy):
        table["fuel_g_per_km"] = cars[PER_KM] * per_distance(1.0, "g/km", energy)
    if against is not None:
        for end in ("", "_low", "_high"):
            table[f"saved_pct{end}"] = 100.0 * cars[f"km_saving_vs_{against}{end}"]
        whole = cars.loc[cars["strategy"] == against, "distance_m"].iloc[0]
        table["distance_pct"] = 100.0 * (cars["distance_m"] / whole - 1.0)
    table["unsafe_ttc_pct"] = (100.0 * cars["share_ttc_unsafe"]).round(2)
    table["long_time_gap_pct"] = (100.0 * cars["share_time_gap_long_moving"]).round(2)
    table["collisions"] = cars["collisions"]
    table = table.reset_index(drop=True)
    note = _comparison(table, cars, against) + (BEHIND if filtered else "")
    table.attrs |= {"against": against, "caption": CAPTION.format(note), "shown": COLUMNS}
    table.attrs |= {"score": "energy_kj_per_km", "label": "path energy per km [kJ/km]"}
    return table


def _comparison(table: pd.DataFrame, cars: pd.DataFrame, against: str | None) -> str:
    """Return whom a headline compares with, and over what its intervals are, if it has any."""
    if against is None:
        return ""
    known = table["saved_pct_low"].notna().any()
    return COMPARED.format(in_words(against), INTERVAL.format(resampled(cars)) if known else "")


def verdict(found: pd.DataFrame, of_few: bool = True) -> str:
    """Return in a sentence what came out for the network, from a summary; empty without one.

    Without one that goes by its variant's name, each network has a sentence.

    Args:
        found: of :func:`lcc_rl.results.tables.summary`.
        of_few: whether windows that are too few for a finding have a sentence, too.
    """
    rows: dict[str, Any] = {
        str(row["strategy"]): row for row in found[found[PATH].notna()].to_dict("records")
    }
    other = next((name for name in (*RULES, HUMAN) if name in rows), None)
    if other is None:
        return ""
    learned = [name for name, row in rows.items() if row["seeds"] and name not in RULES]
    names = [NETWORK] if NETWORK in rows else learned
    words = [said for name in names if (said := _sentence(rows, name, other, of_few))]
    least = min(rows, key=lambda name: rows[name][PER_KM])
    # It may be a rule of the user's own.
    if words and rows[least]["windows"] >= FEW and least not in (*names, other):
        words.append(f"Least energy: {in_words(least)}, {rows[least][PER_KM]:,.1f} kJ/km.")
    return "\n".join(words)


def _sentence(rows: Mapping[str, Any], name: str, other: str, of_few: bool) -> str:
    """Return what came out for one network beside another strategy."""
    windows = rows[name]["windows"]
    if windows < FEW:
        if not of_few:
            return ""
        both = (f"{rows[who][PER_KM]:,.1f} kJ ({in_words(who)})" for who in (name, other))
        return f"Per vehicle and km: {', '.join(both)}; {counted(windows)} allow no finding."
    key, long = f"km_saving_vs_{other}", "share_time_gap_long_moving"
    saved, low, high = (100.0 * rows[name][f"{key}{end}"] for end in ("", "_low", "_high"))
    less = "less"
    if saved < 0.0:
        less, saved, low, high = "more", -saved, -high, -low
    within = "" if low > 0.0 else ", within the uncertainty"
    own, theirs = (100.0 * rows[who][long] for who in (name, other))
    article = "the " if in_words(name) != name else ""
    interval = f"({low:.1f} … {high:.1f})".replace("-", "−")
    return (
        f"With {article}{in_words(name)}, energy per vehicle and km is {saved:.1f} % {interval} "
        f"{less} than with {in_words(other)}{within}; long time gaps: {own:.2f} % of "
        f"the time against {theirs:.2f} %."
    )


def several(count: int, what: str) -> str:
    """Return a number of things in words."""
    return f"{count} {what}{'s' * (count != 1)}"


def counted(windows: int, which: str = "") -> str:
    """Return a number of windows in words, ``which`` such as ``"held-out "``."""
    return several(windows, f"{which}window")


def sample_of(episodes: pd.DataFrame) -> str:
    """Return how many windows and drivers an evaluation is of, for a title."""
    windows, drivers = (episodes[key].nunique() for key in KEYS)
    return f"{counted(windows, 'held-out ')} × {several(drivers, 'driver')}"


def caption_of(table: pd.DataFrame, more: str = "") -> str:
    """Return what stands below a headline, and what else there is to say."""
    return f"{table.attrs['caption']} {more}".strip()


def few_windows(windows: int, seconds: float | None = None) -> str:
    """Return what an evaluation of few windows means; empty for one of enough, or of long ones.

    Args:
        windows: how many windows were evaluated.
        seconds: how long each of them is, if that is known.
    """
    if windows >= FEW or windows * (seconds or 0.0) >= SHORT:
        return ""
    found = counted(windows) + (f" of {seconds:g} s" if seconds else "")
    return f"{found}: these numbers show that everything runs, and mean nothing else"


def as_rich(
    table: pd.DataFrame, title: str, caption: str, shown: Sequence[Shown] | None = None
) -> Table:
    """Return a table for the terminal, a row per strategy, within 80 characters.

    Args:
        table: the rows.
        title: above the table.
        caption: below it.
        shown: its columns; by default those of a headline.
    """
    drawn = Table(
        title=escape(title),
        caption=escape(caption),
        **PLAIN,
    )
    shown = [column for column in shown or table.attrs["shown"] if column.key in table]
    for place, column in enumerate(shown):
        drawn.add_column(escape(column.heading), justify="right" if place else "left")
    for row in zip(*(_cells(table, column.key) for column in shown), strict=True):
        drawn.add_row(*map(escape, row))
    return drawn


def for_print(table: pd.DataFrame, names: Sequence[str] | None = None) -> pd.DataFrame:
    """Return columns of a table with their intervals, named for a page or a paper.

    Args:
        table: a headline, or any other.
        names: the columns; by default those of a headline that are shown, else all.

    Raises:
        ConfigError: for a column that is not there, naming the nearest.
    """
    known = [str(key) for key in table]
    for name in names or ():
        if name not in known:
            raise unknown_name("column", name, known)
    keys = names or [column.key for column in table.attrs.get("shown", ())] or known
    kept = [name for key in keys for name in (key, f"{key}_low", f"{key}_high") if name in known]
    label = table.attrs.get("label", "score")
    return table[list(dict.fromkeys(kept))].rename(columns={"who": "driven by", "score": label})


def _cells(table: pd.DataFrame, name: str) -> list[str]:
    """Return the cells of a column; savings have one decimal, sign and interval."""
    if f"{name}_low" not in table:
        return column_cells(table, name)
    bounds = zip(*(table[f"{name}{end}"] for end in ("", "_low", "_high")), strict=True)
    return [saved(*row) for row in bounds]


def saved(share: float, low: float, high: float) -> str:
    if pd.isna(share):
        return MISSING
    within = "" if pd.isna(low) else f" ({low:.1f} … {high:.1f})"
    return f"{share:+.1f}{within}".replace("-", "−")


def in_full(found: pd.DataFrame, title: str) -> Group:
    """Return a whole summary as a table for the terminal, a column per strategy."""
    caption = (
        "energies: mean per episode; path energy: without what the motion stores; saved: of path "
        "energy per km, or as drawn; intervals: over "
        "held-out windows (drives, if five or more) and training seeds; pairs: of a window and a "
        "driver"
    )
    return strategies_side_by_side(found, ROWS, title, caption)


def show(table: Table | Group | Text) -> None:
    """Print a table or a text, as wide as the terminal or ``COLUMNS``; else as its content."""
    console = Console()
    if not console.is_terminal and "COLUMNS" not in os.environ:
        wide = Console(width=WIDEST).measure(table).maximum  # a console measures within its width
        console = Console(width=max(wide, console.width))
    console.print(table)
