"""Scores over the share of automated vehicles: python tools/fleets.py outputs/evaluate/<run>…

Each run is an evaluation with task=i24-mixed and another scenario.string.penetration. Scores go to
--reference, the figure to --figure; without runs the figure is drawn again from what is kept.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.commands.tasks import task_of
from lcc_rl.config import require
from lcc_rl.energy import build_energy
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.drawing import legend_above, new_figure, save
from lcc_rl.results.figures import style
from lcc_rl.results.runs import load_config
from lcc_rl.results.scores import scores
from lcc_rl.runs.cli import main_guard

SHARE, LEARNED = "penetration", "learned"
SHOWN = {"saving": "fuel saved per km [%]", "distance_lost": "distance lost [%]"}
SHOWN_AS = {
    LEARNED: (LEARNED, "#0072b2"),
    "idm_acc": ("IDM as cruise control, tuned", "#009e73"),
    "acc": ("linear ACC, tuned", "#e69f00"),
    "follower_stopper": ("FollowerStopper", "#cc79a7"),
    "pi_saturation": ("PI with saturation", "#d55e00"),
    "idm": ("one human driver (IDM)", "#6b6b6b"),
}


def scored(run: Path) -> pd.DataFrame:
    """Return the scores of one evaluation, with its share of automated vehicles."""
    cfg = load_config(run)
    task = task_of(cfg)
    require(task is not None and SHARE in cfg.scenario.string, f"{run}: not of task=i24-mixed")
    assert task is not None
    rows = read_parquet(run / "episodes.parquet")
    found = scores(rows, task.among(rows["strategy"]), build_energy(cfg))
    found["strategy"] = found["strategy"].astype(str).replace(cfg.variant, LEARNED)
    found.insert(0, SHARE, float(cfg.scenario.string.penetration))
    return found


def drawn(table: pd.DataFrame) -> Figure:
    """Draw saving and distance lost over the share; hollow where a limit is missed."""
    figure = new_figure(10.0, 4.0)
    axes = figure.subplots(1, len(SHOWN))
    for axis, (column, label) in zip(axes, SHOWN.items(), strict=True):
        for name, (words, colour) in SHOWN_AS.items():
            rows = table[table["strategy"] == name].sort_values(SHARE)
            x, y = 100.0 * rows[SHARE], 100.0 * rows[column]
            axis.plot(x, y, color=colour, lw=1.3, label=words)
            face = [colour if kept else "white" for kept in rows["kept"]]
            axis.scatter(x, y, c=face, edgecolors=colour, zorder=3, s=28)
            if name == LEARNED and column == "saving":
                low, high = (100.0 * rows[f"saving_{end}"] for end in ("low", "high"))
                axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)
        axis.axhline(0.0, color="#222222", lw=0.8)
        axis.set_xscale("log")
        shares = sorted(100.0 * table[SHARE].unique())
        axis.set_xticks(shares, [f"{share:g}" for share in shares])
        axis.minorticks_off()
        style(axis, "automated vehicles [%]", label)
    legend_above(axes[0], 2)
    figure.suptitle("i24-mixed; filled: keeps all limits; band: 95 % of learned", fontsize=10)
    return figure


def main(words: Sequence[str] | None = None) -> int:
    """Keep the scores of the runs given, and draw."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("runs", nargs="*", type=Path, help="folders of evaluations")
    reference = Path("outputs/reference/tasks/fleets.parquet")
    parser.add_argument("--reference", type=Path, default=reference, help="where scores are kept")
    figure = Path("docs/figures/fleets.png")
    parser.add_argument("--figure", type=Path, default=figure, help="the image to write")
    options = parser.parse_args(words)
    if options.runs:
        write_parquet(pd.concat(map(scored, options.runs), ignore_index=True), options.reference)
    print(save(drawn(read_parquet(options.reference)), options.figure))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
