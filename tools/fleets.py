"""Scores over the share of automated vehicles: python tools/fleets.py <task> <evaluation>…

Each run is an evaluation of the task, i24-mixed or ring-22, with another scenario.string. Scores go
to outputs/reference/tasks, the figure to docs/figures; without runs the figure is drawn again from
what is kept. Instead of a task, ``fronts`` prints what learned fleets save beside the front of a
rule (tools/keep.py fleets), as a Markdown table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from leaderboard import task_scores
from matplotlib.figure import Figure

from lcc_rl.cli.guard import main_guard
from lcc_rl.errors import require
from lcc_rl.figures.drawing import INK, PAGE, footnote, new_figure, paper, save, style
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.fronts import (
    DISTANCE,
    FLEET,
    FLOW,
    NET,
    compared,
    flow_gained,
    saved,
    saved_at_flow,
)
from lcc_rl.results.intervals import Estimate

SHARE, LEARNED = "penetration", "learned"
REFERENCE, FIGURES = Path("outputs/reference/tasks"), Path("docs/figures")
NAMES = {"i24-mixed": "fleets", "ring-22": "fleets_ring"}
PERCENT = ("saving",)
SHOWN = {
    "i24-mixed": {"saving": "fuel saved per km [%]", "flow_vph": "flow [vehicles/h]"},
    "ring-22": {"saving": "fuel saved per km, all cars [%]", "mean_speed_mps": "mean speed [m/s]"},
}
HUMAN, RULE = "human", "idm_acc"
FRONTS = "fleets_fronts.parquet"
SETTINGS = {  # of what is kept for fronts, for readers
    "front": "I-24, windows of 100 s",
    "free": "free driving, 100 s",
    "long": "I-24, windows of 400 s",
    "true": "true drivers behind I-24, 100 s",
}
SHOWN_AS = {
    LEARNED: ("learned", "#0072b2"),
    "idm_acc": ("tuned IDM", "#009e73"),
    "idm_acc_filtered": ("tuned IDM behind the safety filter", "#56b4e9"),
    "acc": ("tuned linear ACC", "#e69f00"),
    "follower_stopper": ("FollowerStopper", "#cc79a7"),
    "pi_saturation": ("PI with saturation", "#d55e00"),
    "idm": ("simulated driver (IDM)", "#6b6b6b"),
}


def scored(run: Path) -> pd.DataFrame:
    """Return the scores of one evaluation, with its share of automated vehicles."""
    cfg, task, _, found = task_scores(run)
    require(task.name in SHOWN, f"{run}: an evaluation of {task.name}, not of {', '.join(SHOWN)}")
    found["strategy"] = found["strategy"].astype(str).replace(cfg.variant, LEARNED)
    string = cfg.scenario.vehicles
    found.insert(0, SHARE, string.count(AUTOMATED) / len(string))
    return found


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
    learned, human, rule = ((name, "fleet") for name in (LEARNED, HUMAN, RULE))
    names = pd.Categorical(rows["setting"].map(SETTINGS), list(SETTINGS.values()))
    groups = rows.assign(setting=names).groupby(["setting", SHARE], observed=True)
    for (setting, share), part in groups:
        means = part.groupby(["variant", "limit"])[list(FLEET)].mean()
        flow, spent = means[FLOW], means[NET] / means[DISTANCE]
        others = spent[RULE], flow[RULE]
        saving = 100.0 * (1.0 - others[0] / spent[HUMAN].iloc[0])
        own, best = flow[LEARNED].iloc[0], saving.idxmax()
        gap = np.interp(own, others[1].to_numpy()[::-1], others[1].index.to_numpy()[::-1])
        cells = [str(setting), f"{100.0 * float(str(share)):.0f} %"]
        cells.append(percent(compared(part, learned, human, FLEET, saved)))
        gained = percent(compared(part, learned, human, FLEET, flow_gained))
        cells.append(f"{own:,.0f}: {gained}")
        against = compared(part, learned, rule, FLEET, saved_at_flow)
        cells.append(f"{percent(against)}; T = {gap:.2f} s")
        cells.append(f"{saving[best]:.1f} %; T = {best:.1f} s, {others[1][best]:,.0f}")
        lines.append(cells)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def percent(found: Estimate) -> str:
    """Return an estimate and its interval in per cent."""
    value, low, high = (f"{100.0 * x:.1f}" for x in (found.value, found.low, found.high))
    return f"{value} % ({low} … {high})".replace("-", "−")


@paper
def drawn(table: pd.DataFrame, task: str) -> Figure:
    """Draw what a task shows over the share; hollow where a limit is missed."""
    figure = new_figure(PAGE, 3.2)
    axes = figure.subplots(1, len(SHOWN[task]))
    humans = table[table["strategy"] == HUMAN]
    for axis, (column, label) in zip(axes, SHOWN[task].items(), strict=True):
        scale = 100.0 if column in PERCENT else 1.0
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
        # Of a saving zero; what is left are draws of the noise, alike at every share.
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


def main(words: Sequence[str] | None = None) -> int:
    """Keep the scores of the runs given, and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task", choices=[*SHOWN, "fronts"], help="of the runs")
    parser.add_argument("runs", nargs="*", type=Path, help="folders of evaluations")
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="where scores are kept")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder of the image")
    options = parser.parse_args(words)
    if options.task == "fronts":
        print(fronts(read_parquet(options.reference / FRONTS)))
        return 0
    name = NAMES[options.task]
    kept = options.reference / f"{name}.parquet"
    if options.runs:
        write_parquet(pd.concat(map(scored, options.runs), ignore_index=True), kept)
    print(save(drawn(read_parquet(kept), options.task), options.figures / f"{name}.png"))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
