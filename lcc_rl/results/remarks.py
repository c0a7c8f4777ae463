"""Sentences on the limitations of an evaluation's numbers."""

from __future__ import annotations

import numpy as np
import pandas as pd

from lcc_rl.config import choices
from lcc_rl.config.words import FILTERED
from lcc_rl.results import measures
from lcc_rl.results.measures import BROKEN, FASTER, REACH
from lcc_rl.results.names import HUMAN, counted_windows, in_words, several

MUCH = 0.01  # share of time with infeasible accelerations that tables and log mention
MOSTLY = 0.2  # share of time; I-80's drivers behind its leaders have 0.02, the stream's 0.06
FLOW_LOST, FLOW_NAMED, MARK = "flow_lost", 0.02, " †"  # loss of flow that tables mark, as a share
FEW_DRIVES = ("saving_drives_low", "saving_drives_high")  # t-interval over fewer than five drives
FEW_WINDOWS, SHORT = 5, 150.0  # least number of windows; length of short ones [s]


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


def flow_note(table: pd.DataFrame) -> str:
    """Return a sentence on strategies that lose much flow; empty if none does."""
    lost = table[table[FLOW_LOST] > FLOW_NAMED]
    named = zip(lost["strategy"], lost[FLOW_LOST], strict=True)
    parts = (f"{in_words(str(name))} {100.0 * share:.0f} %" for name, share in named)
    against = in_words(str(table["against"].iloc[0]))
    return f"{MARK.strip()}: flow lost against {against}: {'; '.join(parts)}." if len(lost) else ""


def by_ends(table: pd.DataFrame) -> str:
    """Return a sentence on savings that start and end of the episodes exceed; empty for none."""
    found = table["strategy"][table["end_saving"].abs() > table["saving"].abs()]
    names = ", ".join(in_words(str(name)) for name in found)
    return (
        "Start and end of episodes (distance, stored energy) change the energy drawn more than "
        f"steady driving: {names}."
        if names
        else ""
    )


def crashes(table: pd.DataFrame) -> list[str]:
    """Return sentences on strategies with collisions."""
    found = table[table["collisions"] > 0]
    columns = ["strategy", "collisions", "episodes", "max_leader_braking_mps2", "max_braking_mps2"]
    return [
        f"{in_words(str(name))}: {collisions} of {episodes:,} episodes end in a collision, so it "
        f"has no saving and no flow; leaders brake by up to {ahead:.1f} m/s², automated vehicles "
        f"by up to {own:.1f} m/s²."
        for name, collisions, episodes, ahead, own in found[columns].itertuples(index=False)
    ]


def few_drives(table: pd.DataFrame) -> str:
    """Return a sentence with the intervals over fewer than five drives; empty without any."""
    found = table[table[FEW_DRIVES[0]].notna()]
    rows = zip(found["strategy"], *(100.0 * found[name] for name in FEW_DRIVES), strict=True)
    words = (f"{in_words(str(name))} {low:.1f} … {high:.1f}" for name, low, high in rows)
    text = "; ".join(words).replace("-", "−")
    return f"Saved [%], t-interval over {table['drives'].max()} drives: {text}." if text else ""


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
