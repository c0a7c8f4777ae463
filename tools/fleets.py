"""Savings of fleets over the share of automated vehicles, for docs/fleets.md."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.config.words import FILTERED
from lcc_rl.figures import drawing
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
from lcc_rl.results.intervals import Estimate
from lcc_rl.results.measures import between, signed
from lcc_rl.results.names import NETWORK, in_words
from lcc_rl.results.render import markdown_table

SHARE, LEARNED = "penetration", "learned"
SHOWN = {"saving": "fuel saved per km, all cars [%]", "mean_speed_mps": "mean speed [m/s]"}
HUMAN, RULES = "human", ("idm_fleet", "idm_acc")  # the rule is the first that was evaluated
SETTINGS = {  # labels of the stored fronts
    "drives_taught": "I-24, whole drives, trained over 400 s",
    "drives_metres": "I-24, whole drives, trained with a price per metre",
    "drives_traffic": "I-24, whole drives, … and the speeds of the traffic ahead",
    "drives_wavy_taught": "I-24, wavy half of the drives, trained over 400 s",
    "drives_wavy_metres": "I-24, wavy half of the drives, trained with a price per metre",
    "drives_wavy_traffic": "I-24, wavy half of the drives, … and the speeds of the traffic ahead",
    "front": "I-24, 100 s",
    "free": "free driving, 100 s",
    "long": "I-24, 400 s",
    "long_taught": "I-24, 400 s, trained over 400 s",
    "true": "drivers with reaction, I-24, 100 s",
    "true_taught": "drivers with reaction, I-24, 100 s, trained with them",
    "metres": "whole drives",
    "metres_200": "200 s after 100 s",
    "metres_400": "whole drives after 100 s",
    "metres_200_traffic": "200 s after 100 s, with the traffic ahead",
    "metres_400_traffic": "whole drives after 100 s, with the traffic ahead",
    "metres_400_wavy_traffic": "wavy half after 100 s, with the traffic ahead",
    "metres_200_each": "200 s after 100 s, … and a limit behind each leader",
    "metres_400_each": "whole drives after 100 s, … and a limit behind each leader",
    "metres_400_wavy_each": "wavy half after 100 s, … and a limit behind each leader",
}
PANELS = ("front", "free", "long", "true")
TAUGHT = ", trained "  # part of the label of a setting with fleets trained in it
RIVALS = ("idm_acc", "idm_acc_filtered", "acc", "follower_stopper", "pi_saturation")


def fronts(rows: pd.DataFrame) -> str:
    """Return a Markdown table: a row per setting and share, by :mod:`lcc_rl.results.fronts`."""
    head = [
        "leaders",
        "automated",
        "saved",
        "flow [1/h]",
        "saved against the rule at equal flow",
        "largest saving of the rule",
    ]
    lines = []
    for setting, share, part in by_setting(rows):
        rule = rule_of(part)
        saving, flow = curve(part, rule)
        own, best = curve(part, LEARNED)[1].iloc[0], saving.index.to_numpy(float)[saving.argmax()]
        gap = np.interp(own, flow.to_numpy()[::-1], flow.index.to_numpy()[::-1])
        cells = [setting, f"{share:.0f} %", percent(against(part, HUMAN, fleet_saved))]
        cells.append(f"{own:,.0f}: {percent(against(part, HUMAN, flow_gained))}")
        cells.append(f"{percent(against(part, rule, saved_at_flow))}; T = {gap:.2f} s")
        cells.append(f"{saving[best]:.1f} %; T = {best:.1f} s, {flow[best]:,.0f}")
        lines.append(cells)
    return markdown_table(head, lines)


def by_setting(rows: pd.DataFrame) -> Iterator[tuple[str, float, pd.DataFrame]]:
    """Yield the rows of each setting and share with the setting in words and the share [%]."""
    names = pd.Categorical(rows["setting"].map(SETTINGS), list(SETTINGS.values()))
    rows = rows.assign(setting=names)
    for (setting, share), part in rows.groupby(["setting", SHARE], observed=True):
        yield str(setting), 100.0 * float(str(share)), part


def rule_of(part: pd.DataFrame) -> str:
    """Return the name of the rule with which the learned fleet is compared."""
    return next(name for name in RULES if name in set(part["variant"]))


def curve(part: pd.DataFrame, name: str) -> tuple[pd.Series, pd.Series]:
    """Return the saving of a fleet against human drivers [%] and its flow [1/h], by time gap."""
    means = part.groupby(["variant", "limit"])[list(FLEET)].mean()
    own, people = means.xs(name), means.xs(HUMAN).iloc[0]
    saving = 100.0 * (1.0 - own[NET] / own[DISTANCE] * people[DISTANCE] / people[NET])
    return saving, own[FLOW]


def against(
    part: pd.DataFrame, name: str, measure: Statistic, own: str = LEARNED, policy: str = "fleet"
) -> Estimate:
    """Return a measure of the learned fleet, or another kind, against a third."""
    kinds = (own, policy), (name, policy)
    return compare_fronts(part, *kinds, columns=FLEET, measure=measure)


def percent(found: Estimate) -> str:
    """Return an estimate and its interval in per cent."""
    value, low, high = found.percent
    return f"{signed(value, '{:.1f}')} % ({between(low, high)})"


@drawing.paper
def drawn_fronts(rows: pd.DataFrame) -> Figure:
    """Draw, for each setting, the learned fleets and the rule's fronts, a colour per share."""
    figure = drawing.new_figure(drawing.PAGE_WIDTH, 5.4)
    titles = [SETTINGS[name] for name in PANELS]
    rows = rows[rows["setting"].str.startswith(PANELS)]
    axes = dict(zip(titles, figure.subplots(2, 2).flat, strict=True))
    shares = 100.0 * np.sort(rows[SHARE].unique())
    hues = dict(zip(shares.round(), drawing.SERIES, strict=False))
    for setting, share, part in by_setting(rows):
        axis, hue = axes[setting.partition(TAUGHT)[0]], hues[round(share)]
        look = {"marker": "D"} if TAUGHT in setting else {"label": f"{share:g} % automated"}
        people = curve(part, HUMAN)[1].iloc[0]
        (saving, flow), (own, point) = curve(part, rule_of(part)), curve(part, LEARNED)
        axis.plot(100.0 * (flow / people - 1.0), saving, ".-", color=hue)
        x, found = 100.0 * (point / people - 1.0), against(part, HUMAN, fleet_saved)
        axis.vlines(x, 100.0 * found.low, 100.0 * found.high, color=hue, **drawing.INTERVAL)
        axis.plot(
            x, own, **{"marker": "o"} | look, ls="", color=hue, mec=drawing.INK, ms=7, zorder=5
        )
    for setting, axis in axes.items():
        axis.axhline(0.0, color=drawing.INK, lw=0.6)
        axis.axvline(0.0, color=drawing.INK, lw=0.6)
        axis.set(xlim=(-15.0, 15.0), ylim=(-2.0, None), title=setting)  # fronts are longer
        axis.set(xlabel="flow against human drivers [%]", ylabel="fuel saved per km [%]")
    handles = axes[SETTINGS["front"]].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=4)
    drawing.footnote(
        figure,
        "large: network with its 95 % interval (circle: trained on I-24 over 100 s; diamond: "
        "trained as in the panel);\nsmall: tuned IDM with several time gaps, shorter to the right",
    )
    return figure


@drawing.paper
def drawn_ring(table: pd.DataFrame) -> Figure:
    """Draw the results of the ring over the share, with hollow dots beyond a limit."""
    figure = drawing.new_figure(drawing.PAGE_WIDTH, 3.2)
    axes = figure.subplots(1, len(SHOWN))
    humans = table[table["strategy"] == HUMAN]
    for axis, (column, label) in zip(axes, SHOWN.items(), strict=True):
        scale = 100.0 if column == "saving" else 1.0
        for name in (LEARNED, *RIVALS):
            rows = table[table["strategy"] == name].sort_values(SHARE)
            shown = NETWORK if name == LEARNED else name
            hue, dashed = drawing.colour(shown), "--" if name.endswith(FILTERED) else "-"
            if rows.empty:
                continue
            x = 100.0 * rows[SHARE]
            above = 5 if name == LEARNED else 3
            axis.plot(x, scale * rows[column], dashed, color=hue, zorder=above)
            face = [hue if kept else "white" for kept in rows["kept"]]
            axis.scatter(x, scale * rows[column], c=face, edgecolors=hue, s=16, zorder=above)
            axis.plot([], [], "o" + dashed, color=hue, label=in_words(shown))
            if name == LEARNED and column == "saving":
                ends = (scale * rows[f"saving_{end}"] for end in ("low", "high"))
                axis.vlines(x, *ends, color=hue, zorder=above, **drawing.INTERVAL)
        # The saving is zero; means over the shares average the noise.
        axis.axhline(scale * humans[column].fillna(0.0).mean(), color=drawing.INK, ls=":")
        axis.set_xscale("log")
        shares = sorted(100.0 * table[SHARE].unique())
        axis.set_xticks(shares, [f"{float(f'{share:.2g}'):g}" for share in shares])
        axis.minorticks_off()
        axis.set(xlabel="automated vehicles [%]", ylabel=label)
    axes[0].plot([], [], color=drawing.INK, ls=":", label="human drivers")
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=4)
    drawing.footnote(
        figure, "filled: keeps all limits of the task; vertical lines: 95 % interval of the network"
    )
    return figure
