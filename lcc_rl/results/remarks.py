"""Sentences on the result of an evaluation and the limitations of its numbers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.config.compose import choices
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.results import measures
from lcc_rl.results.measures import (
    BROKEN,
    DISTANCE,
    FASTER,
    FLOW,
    LONG_GAPS,
    PATH,
    PATH_PER_KM,
    REACH,
    between,
)
from lcc_rl.results.names import HUMAN, NETWORK, ON_FRONT, RULE_ROWS, in_words, several
from lcc_rl.results.windows import savings

ONE = " ‡"  # marks a training of one seed beside several
MUCH = 0.01  # share of time with infeasible accelerations that tables and log mention
MOSTLY = 0.2  # share of time; I-80's drivers behind its leaders have 0.02, the stream's 0.06
FLOW_LOST, FLOW_NAMED, MARK = "flow_lost", 0.02, " †"  # loss of flow that tables mark, as a share
MORE_FLOW, MORE_NAMED = "more_flow", 0.001  # see Estimate; least share that sentences mention
FEW_WINDOWS, SHORT = 5, 150.0  # least number of windows; length of short ones [s]


def remarks(windows: pd.DataFrame) -> list[str]:
    """Return sentences on limitations of the numbers of an evaluation."""
    added = [one for one in measures.MEASURES if one.key not in measures.SHIPPED]
    means = measures.means(windows, (*REACH, BROKEN, *(one.key for one in added)))
    sentences = [
        f"No episode has a number of {one.key}: its function gives NaN, or lacks an entry."
        for one in added
        if means[one.key].isna().all()
    ]

    def named(shares: pd.Series, least: float) -> str:
        large = shares[shares > least].items()
        return ", ".join(f"{in_words(str(name))} {share:.2%}" for name, share in large)

    if names := named(means[list(REACH)].max(axis=1), MUCH):
        sentences.append(
            "Vehicles accelerate harder, or hold a higher speed, than their energy model allows "
            f"for more than {MUCH:.0%} of the time ({names}): such vehicles would fall behind."
        )
    if names := named(means[BROKEN], 0.0):
        sentences.append(
            f"Steps that the filter's guarantee covers turn unsafe ({names}): brakes, delays or "
            "sensors differ from scenario.actuators and scenario.sensors."
        )
    return sentences


def flow_note(table: pd.DataFrame) -> str:
    """Return a sentence on strategies that lose much flow; empty if none does."""
    lost = table[table[FLOW_LOST] > FLOW_NAMED]
    named = zip(lost["strategy"], lost[FLOW_LOST], strict=True)
    losses = (f"{in_words(str(name))} {100.0 * share:.0f} %" for name, share in named)
    against = in_words(str(table["against"].iloc[0]))
    return f"{MARK.strip()}: flow lost against {against}: {'; '.join(losses)}." if len(lost) else ""


def front_note(table: pd.DataFrame, reference: str) -> str:
    """Return sentences on fronts with more, or less, flow than the reference has."""
    rows = table[table[MORE_FLOW] > MORE_NAMED]
    named = zip(rows["strategy"], rows[MORE_FLOW], strict=True)
    names = ", ".join(f"{in_words(str(name))} {share:.1%}" for name, share in named)
    more = "Saved at their flow: not at equal flow, but at the least flow on the strategy's front, "
    lines = [f"{more}which exceeds that of {reference} by: {names}."] * bool(names)
    less = table[table["flow_saving"].isna() & table[MORE_FLOW].notna() & ~crashed(table)]
    names = ", ".join(map(in_words, less["strategy"]))
    fewer = "No saving at their flow: less flow at all points of the front: "
    return " ".join(lines + [f"{fewer}{names}."] * bool(names))


def seeds_note(table: pd.DataFrame) -> str:
    """Return sentences on single trainings, and on seeds that comparisons leave out, if any."""
    rows = table[(table["left_out"] != "") & table["saving"].notna()]
    names = zip(rows["strategy"], rows["left_out"], strict=True)
    left = [f"for {in_words(str(name))} {seeds}" for name, seeds in names]
    lines = [
        f"{ONE.strip()}: one training seed, so that intervals exclude the variation of trainings."
    ] * bool(table["single"].any())
    lines += [f"Savings are by equal training seeds; left out: {'; '.join(left)}."] * bool(left)
    return " ".join(lines)


def by_ends(table: pd.DataFrame) -> str:
    """Return a sentence on savings that start and end of the episodes exceed; empty for none."""
    strategies = table["strategy"][table["end_saving"].abs() > table["saving"].abs()]
    names = ", ".join(in_words(str(name)) for name in strategies)
    return (
        "Start and end of episodes (distance, stored energy) change the energy drawn more than "
        f"steady driving: {names}."
        if names
        else ""
    )


def crashed(table: pd.DataFrame) -> pd.Series:
    """Return which rows have neither saving nor flow: they, or their baseline, collide."""
    hit = table["strategy"][table["collisions"] > 0]
    return table["strategy"].isin(hit) | table["against"].isin(hit)


def crashes(table: pd.DataFrame) -> list[str]:
    """Return a sentence on strategies with collisions, if there are any."""
    collided = table[table["collisions"] > 0]
    rows = zip(collided["strategy"], collided["collisions"], collided["episodes"], strict=True)
    names = ", ".join(f"{in_words(str(x))} {some} of {of:,}" for x, some, of in rows)
    base = collided["strategy"][collided["strategy"] == collided["against"]]
    names += "".join(f" (so none has a saving against {in_words(str(x))})" for x in base)
    ahead, own = (collided[f"max_{x}braking_mps2"].max() for x in ("leader_", ""))
    return [
        f"Episodes end in a collision, so that rows have no saving and no flow: {names}; leaders "
        f"brake by up to {ahead:.1f} m/s², whoever drives automated cars by up to {own:.1f} m/s²."
    ] * bool(len(collided))


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
        filtered = name.partition(ON_FRONT)[0].endswith(FILTERED)
        if not filtered and not np.isclose(shares[name], people).any():
            driver = "scenario.controllers.automated"
            option = f"variant=idm controller@{driver}={name} {driver}.desired_speed=45"
            option += " 'compare=[<run>]'"
            hint = "desired_speed: 45 beside its other settings in compare="
            remedies.setdefault(name, option if name in choices("controller") else hint)
    return [
        f"the leaders drive faster than the desired speed of {name} for {shares[name]:.0%} of the "
        f"time (more than {MOSTLY:.0%}): savings against it are not valid. Raise v0: {remedy}"
        for name, remedy in remedies.items()
        if shares.get(name, 0.0) > MOSTLY
    ]


def few_windows(windows: int, seconds: float) -> str:
    """Return a warning on few windows of a length [s]; empty for enough or long ones."""
    if windows >= FEW_WINDOWS or windows * seconds >= SHORT:
        return ""
    count = f"{several(windows, 'window')} of {seconds:g} s"
    return f"{count} are too few for conclusions: these numbers only show that everything runs"


def verdict(windows: pd.DataFrame, found: pd.DataFrame, of_few: bool = True) -> str:
    """Return a sentence on the result of the network; empty without one, or if it collides.

    If no network has its variant's name, each network has a sentence.

    Args:
        windows: result of :func:`windows_for`.
        found: their :func:`summary`.
        of_few: whether too few windows are mentioned.
    """
    cars = found[found[PATH].notna() & ~crashed(found)].to_dict("records")
    rows: dict[str, Any] = {str(row["strategy"]): row for row in cars}
    other = next((name for name in (*RULE_ROWS, HUMAN) if name in rows), None)
    if other is None:
        return ""
    learned = [name for name, row in rows.items() if row["seeds"] and name not in RULE_ROWS]
    names = [NETWORK] if NETWORK in rows else learned
    sentences = []
    for name in names:
        if (count := rows[name]["windows"]) >= FEW_WINDOWS:
            sentences.append(_sentence(windows, rows, name, other))
        elif of_few:
            both = (f"{rows[x][PATH_PER_KM]:,.1f} kJ ({in_words(x)})" for x in (name, other))
            few = f"{several(count, 'window')} are too few for a conclusion."
            sentences.append(f"Per vehicle and km: {', '.join(both)}; {few}")
    least = min(rows, key=lambda name: rows[name][PATH_PER_KM])
    # It may be the user's rule.
    if sentences and rows[least]["windows"] >= FEW_WINDOWS and least not in (*names, other):
        sentences.append(f"Least energy: {in_words(least)}, {rows[least][PATH_PER_KM]:,.1f} kJ/km.")
    return "\n".join(sentences)


def _sentence(windows: pd.DataFrame, rows: Mapping[str, Any], name: str, other: str) -> str:
    """Return a sentence that compares a network with another strategy."""
    share = savings(windows, PATH, name, other, [DISTANCE])
    saved, low, high = share.percent
    less = "less"
    if saved < 0.0:
        less, saved, low, high = "more", -saved, -high, -low
    within = "" if low > 0.0 else ", within the uncertainty"
    ours, theirs = (100.0 * rows[x][LONG_GAPS] for x in (name, other))
    article = "the " * in_words(name).startswith("network")
    flows = [f"{rows[x][FLOW]:,.0f}" for x in (name, other, RECORDED) if x in rows]
    flow = f"; flow: {flows[0]} vehicles per hour against {flows[1]}"
    flow += f", {in_words(RECORDED)} {flows[2]}" if len(flows) > 2 else ""
    flow *= bool(np.isfinite(rows[name][FLOW]))
    return (
        f"With {article}{in_words(name)}, energy per vehicle and km is {saved:.1f} % "
        f"({between(low, high)}) {less} than with {in_words(other)}{within}; long "
        f"time gaps: {ours:.2f} % of the time against {theirs:.2f} %{flow}."
    )
