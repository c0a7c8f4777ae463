"""Savings of fleets over the share of automated vehicles, for docs/fleets.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.figures.drawing import INK, PAGE_WIDTH, footnote, new_figure, paper, style
from lcc_rl.results.bootstrap import Estimate
from lcc_rl.results.fronts import (
    DISTANCE,
    FLEET,
    FLOW,
    NET,
    Statistic,
    compare_fronts,
    fleet_saved,
    flow_gained,
    saved_at_flow,
)
from lcc_rl.results.render import markdown_row

SHARE, LEARNED = "penetration", "learned"
SHOWN = {"saving": "fuel saved per km, all cars [%]", "mean_speed_mps": "mean speed [m/s]"}
HUMAN, RULE = "human", "idm_acc"
SETTINGS = {  # labels of the stored fronts
    "drives": "I-24, whole drives",
    "drives_taught": "I-24, whole drives, trained so",
    "drives_wavy": "I-24, wavy half of the drives",
    "drives_wavy_taught": "I-24, wavy half of the drives, trained so",
    "front": "I-24, 100 s",
    "free": "free driving, 100 s",
    "long": "I-24, 400 s",
    "long_taught": "I-24, 400 s, trained so",
    "true": "true drivers, I-24, 100 s",
    "true_taught": "true drivers, I-24, 100 s, trained so",
}
DRIVES, PANELS = "drives", ("front", "free", "long", "true")
TAUGHT = ", trained "  # part of the label of a setting with fleets trained in it
SHOWN_AS = {
    LEARNED: ("learned", "#0072b2"),
    "idm_acc": ("tuned IDM", "#009e73"),
    "idm_acc_filtered": ("tuned IDM behind the safety filter", "#56b4e9"),
    "acc": ("tuned linear ACC", "#e69f00"),
    "follower_stopper": ("FollowerStopper", "#cc79a7"),
    "pi_saturation": ("PI with saturation", "#d55e00"),
}
COLOURS = ("#56b4e9", "#009e73", "#e69f00", "#cc79a7")  # of the shares of a front


def fronts(rows: pd.DataFrame) -> str:
    """Return a Markdown table: a row per setting and share, by :mod:`lcc_rl.results.fronts`."""
    head = [
        "leaders",
        "automated",
        "saved",
        "flow [1/h]",
        "against the rule at this flow",
        "the rule at best",
    ]
    lines = [head, ["---"] * len(head)]
    for setting, share, part in by_setting(rows):
        saving, flow = curve(part, RULE)
        own, best = curve(part, LEARNED)[1].iloc[0], saving.index.to_numpy(float)[saving.argmax()]
        gap = np.interp(own, flow.to_numpy()[::-1], flow.index.to_numpy()[::-1])
        cells = [setting, f"{share:.0f} %", percent(against(part, HUMAN, fleet_saved))]
        cells.append(f"{own:,.0f}: {percent(against(part, HUMAN, flow_gained))}")
        cells.append(f"{percent(against(part, RULE, saved_at_flow))}; T = {gap:.2f} s")
        cells.append(f"{saving[best]:.1f} %; T = {best:.1f} s, {flow[best]:,.0f}")
        lines.append(cells)
    return "\n".join(map(markdown_row, lines))


def by_setting(rows: pd.DataFrame) -> Iterator[tuple[str, float, pd.DataFrame]]:
    """Yield the rows of each setting and share with the setting in words and the share [%]."""
    names = pd.Categorical(rows["setting"].map(SETTINGS), list(SETTINGS.values()))
    rows = rows.assign(setting=names)
    for (setting, share), part in rows.groupby(["setting", SHARE], observed=True):
        yield str(setting), 100.0 * float(str(share)), part


def curve(part: pd.DataFrame, name: str) -> tuple[pd.Series, pd.Series]:
    """Return the saving of a fleet against human drivers [%] and its flow [1/h], by time gap."""
    means = part.groupby(["variant", "limit"])[list(FLEET)].mean()
    own, people = means.xs(name), means.xs(HUMAN).iloc[0]
    saving = 100.0 * (1.0 - own[NET] / own[DISTANCE] * people[DISTANCE] / people[NET])
    return saving, own[FLOW]


def against(part: pd.DataFrame, name: str, measure: Statistic) -> Estimate:
    """Return a measure of the learned fleet against another."""
    return compare_fronts(part, (LEARNED, "fleet"), (name, "fleet"), FLEET, measure)


def percent(found: Estimate) -> str:
    """Return an estimate and its interval in per cent."""
    value, low, high = (f"{100.0 * x:.1f}" for x in (found.value, found.low, found.high))
    return f"{value} % ({low} … {high})".replace("-", "−")


@paper
def drawn_fronts(rows: pd.DataFrame) -> Figure:
    """Draw, for each setting, the learned fleets and the rule's fronts, a colour per share."""
    figure = new_figure(PAGE_WIDTH, 5.4)
    titles = [SETTINGS[name] for name in PANELS]
    rows = rows[~rows["setting"].str.startswith(DRIVES)]
    axes = dict(zip(titles, figure.subplots(2, 2).flat, strict=True))
    shares = 100.0 * np.sort(rows[SHARE].unique())
    hues = dict(zip(shares.round(), COLOURS, strict=False))
    for setting, share, part in by_setting(rows):
        axis, hue = axes[setting.partition(TAUGHT)[0]], hues[round(share)]
        look = {"marker": "D"} if TAUGHT in setting else {"label": f"{share:g} % automated"}
        people = curve(part, HUMAN)[1].iloc[0]
        (saving, flow), (own, point) = curve(part, RULE), curve(part, LEARNED)
        axis.plot(100.0 * (flow / people - 1.0), saving, ".-", color=hue, lw=1.0, ms=4)
        x, found = 100.0 * (point / people - 1.0), against(part, HUMAN, fleet_saved)
        axis.vlines(x, 100.0 * found.low, 100.0 * found.high, color=hue, lw=2.5, alpha=0.5)
        axis.plot(x, own, **{"marker": "o"} | look, ls="", color=hue, mec=INK, ms=7, zorder=5)
    for setting, axis in axes.items():
        axis.axhline(0.0, color=INK, lw=0.6)
        axis.axvline(0.0, color=INK, lw=0.6)
        axis.set(xlim=(-15.0, 15.0), ylim=(-2.0, None), title=setting)  # fronts are longer
        style(axis, "flow against humans only [%]", "fuel saved per km [%]")
    handles = axes[SETTINGS["front"]].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=4, frameon=False)
    footnote(
        figure,
        "large: learned, with the 95 % interval; circles trained for the first panel, diamonds for "
        "theirs;\nsmall: the tuned IDM by its time gap, shorter to the right",
    )
    return figure


@paper
def drawn_ring(table: pd.DataFrame) -> Figure:
    """Draw the results of the ring over the share, with hollow dots beyond a limit."""
    figure = new_figure(PAGE_WIDTH, 3.2)
    axes = figure.subplots(1, len(SHOWN))
    humans = table[table["strategy"] == HUMAN]
    for axis, (column, label) in zip(axes, SHOWN.items(), strict=True):
        scale = 100.0 if column == "saving" else 1.0
        for name, (words, colour) in SHOWN_AS.items():
            rows = table[table["strategy"] == name].sort_values(SHARE)
            if rows.empty:
                continue
            x = 100.0 * rows[SHARE]
            above = 5 if name == LEARNED else 3
            axis.plot(x, scale * rows[column], color=colour, label=words, zorder=above)
            face = [colour if kept else "white" for kept in rows["kept"]]
            axis.scatter(x, scale * rows[column], c=face, edgecolors=colour, s=16, zorder=above)
            if name == LEARNED and column == "saving":
                ends = (scale * rows[f"saving_{end}"] for end in ("low", "high"))
                axis.vlines(x, *ends, color=colour, lw=1.5, alpha=0.5, zorder=above)
        # The saving is zero; means over the shares average the noise.
        axis.axhline(scale * humans[column].fillna(0.0).mean(), color=INK, ls="--", lw=0.8)
        axis.set_xscale("log")
        shares = sorted(100.0 * table[SHARE].unique())
        axis.set_xticks(shares, [f"{float(f'{share:.2g}'):g}" for share in shares])
        axis.minorticks_off()
        style(axis, "automated vehicles [%]", label)
    axes[0].plot([], [], color=INK, ls="--", lw=0.8, label="human drivers only")
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=4, frameon=False)
    footnote(
        figure, "filled: keeps all limits of the task; vertical lines: 95 % interval of learned"
    )
    return figure
