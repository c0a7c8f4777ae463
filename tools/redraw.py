"""Draw tables and figures of the documentation again from outputs/reference: python tools/redraw.py

The tables of docs/{alcc,hcfs,tasks}.md, and of docs/figures: alcc_*, hcfs_*, fleets.png,
fleets_ring.png, limits.png, measured.png, record.png, ring.png and twins.png. The commands that
the pages name draw the other figures.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fleets
import leaderboard
import measured_energy
import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.cli.guard import main_guard
from lcc_rl.config import load
from lcc_rl.config.nodes import build
from lcc_rl.config.schemas import as_plain
from lcc_rl.data.leaders import stretch
from lcc_rl.figures.calibration import twins_figure
from lcc_rl.figures.drawing import COLUMN, footnote, new_figure, paper, save, style
from lcc_rl.figures.platoon import record_figure
from lcc_rl.figures.space_time import space_time
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.fronts import ENERGY, KINDS, SHARE, points
from lcc_rl.studies.alcc.results import narrow
from lcc_rl.studies.reproduce import RESULTS

REFERENCE, FIGURES = Path("outputs/reference"), Path("docs/figures")
MEASURED = measured_energy.KEPT.name
RING = "tasks/ring_steps.parquet"
# Figures of the studies whose rows are kept, on their pages.
SHOWN_OF = {
    "alcc": ("learning_curve", "improvement"),
    "hcfs": ("case_1_velocities", "case_1_switching_hcfs"),
}
SHOWN = {
    "human": "all cars: human drivers",
    "pi_saturation": "one car: PI with saturation",
    "alcc": "one car: learned",
}
EVERY = 10  # steps between the rows kept
COLUMNS = ("strategy", "training_seed", "profile", "driver_id", "time_s")
KINDS_SHOWN = {  # variant and policy, how it is named, its colour and whether its dots are filled
    ("alcc", "idm"): ("IDM, tuned by search", "#d55e00", True),
    ("alcc", "idm_gradient"): ("IDM, tuned by gradient", "#cc79a7", True),
    ("own_energy", "network"): ("network, its own energy", "#0072b2", False),
    ("alcc", "network"): ("network", "#0072b2", True),
    ("alcc", "memory"): ("network with memory", "#56b4e9", True),
    ("alcc", "preview"): ("network with preview", "#009e73", True),
}


def keep_ring(run: Path, path: Path) -> None:
    """Keep of an evaluation of ring-22 what its diagram needs: speeds and gaps of one episode."""
    steps = read_parquet(run / "steps.parquet")
    steps = steps[steps["strategy"].isin(SHOWN) & (steps["profile"] == steps["profile"].iloc[0])]
    steps = steps[steps["training_seed"].isna() | (steps["training_seed"] == 0)]
    entries = [name for name in steps if str(name).endswith(("_speed", "_gap"))]
    kept = steps[[*COLUMNS, *entries]].groupby("strategy", sort=False).nth(slice(0, None, EVERY))
    kept[entries] = kept[entries].astype("float32").round(2)  # [m/s], [m]: what can be seen
    write_parquet(kept.reset_index(drop=True), path)


def figure_of_record() -> Figure:
    """Draw the speed record that platoons train on, and their test cases."""
    cfg = load("evaluate", ["variant=cacc"])
    step, used = cfg.scenario.time_step, cfg.leader["training"]["udds"]
    leaders = build(cfg.leader, "leader").load(
        step, cfg.scenario.horizon, len(cfg.scenario.vehicles)
    )
    record = stretch(used["path"], step, used["scale"])
    return record_figure(record, used["from_s"], leaders.cases)


@paper
def figure_of_limits(windows: pd.DataFrame) -> Figure:
    """Draw path energy over the share of long time gaps: a dot per training, a line per kind.

    Args:
        windows: one row per training and held-out window.
    """
    figure = new_figure(COLUMN, 3.2)
    axes = figure.subplots()
    kinds = dict(list(windows.groupby(KINDS)))
    for kind, (label, hue, filled) in KINDS_SHOWN.items():
        line = points(kinds[kind]).sort_values(SHARE)
        look: dict[str, Any] = {"color": hue, "mfc": hue if filled else "white", "ms": 3.0}
        axes.plot(100.0 * line[SHARE], line[ENERGY], "-" if filled else "--", color=hue)
        each = kinds[kind].groupby(["limit", "training_seed"])[[ENERGY, SHARE]].mean()
        axes.plot(100.0 * each[SHARE], each[ENERGY], "o", **look)
        axes.plot([], [], "o-" if filled else "o--", label=label, **look)
    figure.legend(loc="outside upper left", ncols=2, frameon=False)
    style(axes, "time gap > 2.5 s above 1 m/s [% of the time]", "path energy [kJ per episode]")
    footnote(figure, "dot: one training; line: means at limits of 0.5, 1 and 2 %")
    return figure


def redraw(reference: Path, figures: Path, page: Path) -> list[Path]:
    """Write the tables into the page and the figures; return the files written."""
    leaderboard.write_tables(reference / "tasks", page)
    for task in ("i24-mixed", "ring-22"):
        where = ["--reference", str(reference / "tasks"), "--figures", str(figures)]
        fleets.main([task, *where])
    cfg = load("evaluate", ["task=ring-22"])
    steps = read_parquet(reference / RING).replace({"strategy": SHOWN})
    ring = space_time(steps, list(SHOWN.values()), as_plain(cfg), every=1)
    assert ring is not None
    save(ring, figures / "ring.png", dpi=150)  # thousands of lines: larger is over a megabyte
    drawn = {
        "limits.png": figure_of_limits(read_parquet(reference / "limits" / "windows.parquet")),
        "measured.png": measured_energy.figure_of(read_parquet(reference / MEASURED)),
        "record.png": figure_of_record(),
        "twins.png": twins_figure(read_parquet(reference / "twins.parquet")),
    }
    for name, figure in drawn.items():
        save(figure, figures / name)
    names = ["fleets.png", "fleets_ring.png", "ring.png", *drawn]
    return [page, *(figures / name for name in names)]


def redraw_study(name: str, reference: Path, docs: Path) -> list[Path]:
    """Write the tables of a study's page, and the figures that it shows; return the files."""
    page, made = docs / f"{name}.md", []
    with TemporaryDirectory() as place:
        kept = shutil.copytree(reference / name, Path(place) / name)
        found = RESULTS[name](kept)
        found.tables |= narrow(found.tables) if name == "alcc" else {}
        found.fill(page)
        for figure in SHOWN_OF[name]:
            made.append(docs / "figures" / f"{name}_{figure}.png")
            shutil.copyfile(kept / "figures" / f"{figure}.png", made[-1])
    return [page, *made]


def main(words: Sequence[str] | None = None) -> int:
    """Draw again."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="folder of the results")
    parser.add_argument("--figures", type=Path, default=FIGURES, help="folder of the images")
    parser.add_argument("--page", type=Path, default="docs/tasks.md", help="page of the tables")
    parser.add_argument("--ring", type=Path, help="first keep this evaluation of ring-22")
    options = parser.parse_args(words)
    if options.ring is not None:
        keep_ring(options.ring, options.reference / RING)
    print(*redraw(options.reference, options.figures, Path(options.page)), sep="\n")
    for name in SHOWN_OF:
        print(*redraw_study(name, options.reference, Path(options.page).parent), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
