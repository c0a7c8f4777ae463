"""Scores over the share of automated vehicles: python tools/fleets.py <task> <evaluation>…

Each run is an evaluation of the task, i24-mixed or ring-22, with another scenario.string. Scores go
to outputs/reference/tasks, the figure to docs/figures; without runs the figure is drawn again from
what is kept.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from leaderboard import task_scores
from matplotlib.figure import Figure

from lcc_rl.cli.guard import main_guard
from lcc_rl.errors import require
from lcc_rl.figures.drawing import legend_above, new_figure, save, style
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet

SHARE, LEARNED = "penetration", "learned"
REFERENCE, FIGURES = Path("outputs/reference/tasks"), Path("docs/figures")
NAMES = {"i24-mixed": "fleets", "ring-22": "fleets_ring"}
PERCENT = ("saving", "distance_lost")
SHOWN = {
    "i24-mixed": {"saving": "fuel saved per km [%]", "distance_lost": "distance lost [%]"},
    "ring-22": {"score": "fuel of all [g/km]", "mean_speed_mps": "mean speed [m/s]"},
}
SHOWN_AS = {
    LEARNED: (LEARNED, "#0072b2"),
    "idm_acc": ("IDM as cruise control, tuned", "#009e73"),
    "idm_acc_filtered": ("IDM as cruise control, tuned, filtered", "#56b4e9"),
    "acc": ("linear ACC, tuned", "#e69f00"),
    "follower_stopper": ("FollowerStopper", "#cc79a7"),
    "pi_saturation": ("PI with saturation", "#d55e00"),
    "idm": ("one human driver (IDM)", "#6b6b6b"),
    "human": ("humans only", "#222222"),
}


def scored(run: Path) -> pd.DataFrame:
    """Return the scores of one evaluation, with its share of automated vehicles."""
    cfg, task, _, found = task_scores(run)
    require(task.name in SHOWN, f"{run}: an evaluation of {task.name}, not of {', '.join(SHOWN)}")
    found["strategy"] = found["strategy"].astype(str).replace(cfg.variant, LEARNED)
    string = cfg.scenario.vehicles
    found.insert(0, SHARE, string.count(AUTOMATED) / len(string))
    return found


def drawn(table: pd.DataFrame, task: str) -> Figure:
    """Draw what a task shows over the share; hollow where a limit is missed."""
    figure = new_figure(10.0, 4.0)
    axes = figure.subplots(1, len(SHOWN[task]))
    for axis, (column, label) in zip(axes, SHOWN[task].items(), strict=True):
        scale = 100.0 if column in PERCENT else 1.0
        for name, (words, colour) in SHOWN_AS.items():
            rows = table[table["strategy"] == name].sort_values(SHARE)
            if rows.empty or (name == "human" and column in PERCENT):  # compared with itself
                continue
            x, y = 100.0 * rows[SHARE], scale * rows[column]
            axis.plot(x, y, color=colour, lw=1.3, label=words)
            face = [colour if kept else "white" for kept in rows["kept"]]
            axis.scatter(x, y, c=face, edgecolors=colour, zorder=3, s=28)
            if name == LEARNED and column == "saving":
                low, high = (scale * rows[f"saving_{end}"] for end in ("low", "high"))
                axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        if column in PERCENT:
            axis.axhline(0.0, color="#222222", lw=0.8)
        axis.set_xscale("log")
        shares = sorted(100.0 * table[SHARE].unique())
        axis.set_xticks(shares, [f"{share:.3g}" for share in shares])
        axis.minorticks_off()
        style(axis, "automated vehicles [%]", label)
    legend_above(axes[0], 2)
    band = "; band: 95 % of learned" * ("saving" in SHOWN[task])
    figure.suptitle(f"{task}; filled: keeps all limits{band}", fontsize=10)
    return figure


def main(words: Sequence[str] | None = None) -> int:
    """Keep the scores of the runs given, and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("task", choices=SHOWN, help="of the runs")
    parser.add_argument("runs", nargs="*", type=Path, help="folders of evaluations")
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="where scores are kept")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder of the image")
    options = parser.parse_args(words)
    name = NAMES[options.task]
    kept = options.reference / f"{name}.parquet"
    if options.runs:
        write_parquet(pd.concat(map(scored, options.runs), ignore_index=True), kept)
    print(save(drawn(read_parquet(kept), options.task), options.figures / f"{name}.png"))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
