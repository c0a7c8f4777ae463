"""Write tables and figures of the documentation from outputs/reference: python tools/pages.py

Tables are in docs/*.md between ``<!-- table: name -->`` and ``<!-- end -->``, figures in
docs/figures. Commands on the pages draw the other figures. The tools of the tag history/2026-11
made the results in outputs/reference, see its README.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import fleets
import measured_energy
import numpy as np
import pandas as pd
import trained
from matplotlib.figure import Figure

from lcc_rl.cli.guard import main_guard
from lcc_rl.config import load
from lcc_rl.config.nodes import as_plain
from lcc_rl.config.words import RECORDED
from lcc_rl.data.leaders import stretch
from lcc_rl.energy import AVERAGED, AVERAGES, SECOND
from lcc_rl.errors import require
from lcc_rl.figures import drawing
from lcc_rl.figures.calibration import twins_figure
from lcc_rl.figures.platoon import record_figure
from lcc_rl.figures.space_time import space_time
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import read_parquet
from lcc_rl.io.settings import read_json
from lcc_rl.results import board
from lcc_rl.results.fronts import ENERGY, FRONT_KINDS, LONG_SHARE, at_equal_flow, points
from lcc_rl.results.intervals import BOUNDED
from lcc_rl.results.measures import FLOW, SIGNS, Measure, signed
from lcc_rl.results.names import MARKS, NETWORK, ON_FRONT, in_words, worded
from lcc_rl.results.remarks import MORE_NAMED
from lcc_rl.results.render import as_markdown, for_print, markdown_table, saved_text
from lcc_rl.results.report import report
from lcc_rl.results.runs import naming_run
from lcc_rl.results.task import Task
from lcc_rl.studies.alcc.study import narrow
from lcc_rl.studies.reproduce import STUDY_RESULTS

REFERENCE, DOCS = Path("outputs/reference"), Path("docs")
MARKED = re.compile(r"(<!-- table: (\w+) -->).*?(<!-- end -->)", re.DOTALL)
TASKS_SHOWN = ("i24-follow5", "i80-follow")
LIMIT = "limit_"  # prefix of the columns of limits in stored scores
# Figures of the studies with stored rows.
SHOWN_OF = {
    "alcc": ("learning_curve", "improvement"),
    "hcfs": ("case_1_velocities", "case_1_switching_hcfs"),
}
SHOWN = {
    "human": "all cars: human drivers",
    "pi_saturation": "one car: PI with saturation",
    "alcc": "one car: network",
}
KINDS_SHOWN = {  # label and colour by variant and policy
    ("alcc", "idm"): ("IDM, tuned by search", drawing.colour("idm_acc")),
    ("alcc", "idm_gradient"): ("IDM, tuned by gradient", drawing.colour("rule")),
    ("own_energy", "network"): (in_words("own_energy"), drawing.colour("own_energy")),
    ("alcc", "network"): (in_words(NETWORK), drawing.colour(NETWORK)),
    ("alcc", "memory"): ("network with memory", drawing.OWN_COLOURS[0]),
    ("alcc", "preview"): ("network with preview", drawing.OWN_COLOURS[1]),
}
# Labels of the sources of averaged energies.
SOURCES = {
    "i80": "I-80",
    "stop_and_go": "OpenACC, test track and low speed (`data=stop_and_go`)",
    "platoons": "OpenACC, motorways (`data=platoons`)",
}
FILTERED_RULE = "idm_acc_filtered"
ALL_TERMS = f"{NETWORK} reward.without=null"
ROWS_WITHOUT = {  # rows of an ablation in words
    f" [{MARKS}]": "",
    re.escape(in_words(ALL_TERMS)): "all terms",
    r"network \(reward\.without=\[?([^\]]+?)\]?\)": r"without \1",
}


def fill(page: Path, tables: Mapping[str, str]) -> None:
    """Write tables into a Markdown file, between their marks.

    Raises:
        ConfigError: if a marked table is missing.
        ResultsError: if the file cannot be written.
    """

    def marked(found: re.Match[str]) -> str:
        begin, name, end = found.groups()
        require(name in tables, f"{page}: no table {name!r}; known: {', '.join(tables)}")
        return f"{begin}\n\n{tables[name].strip()}\n\n{end}"

    text = MARKED.sub(marked, page.read_text(encoding="utf-8"))
    with atomic_path(page) as temporary:
        temporary.write_text(text, encoding="utf-8")


def study(name: str, reference: Path, docs: Path) -> None:
    """Write the tables and figures of a study's page."""
    with TemporaryDirectory() as place:
        kept = shutil.copytree(reference / name, Path(place) / name)
        found = STUDY_RESULTS[name](kept).tables
        found |= narrow(found) if name == "alcc" else {}
        fill(docs / f"{name}.md", {x: as_markdown(worded(table)) for x, table in found.items()})
        for figure in SHOWN_OF[name]:
            shown = docs / "figures" / f"{name}_{figure}.png"
            shutil.copyfile(kept / "figures" / f"{figure}.png", shown)


def tasks(reference: Path, docs: Path) -> None:
    """Write the tables of docs/{ablations,fleets,leaderboard,limits,notes/results}.md."""
    tables = {path.stem: read_parquet(path) for path in sorted((reference / "tasks").glob("*"))}
    parts = [task_table(name, tables[name]) for name in TASKS_SHOWN]
    rows = tables["fleets_fronts"]
    kinds = rows["setting"].str.extract("^(drives|metres)", expand=False).fillna("fleets")
    found = {str(name): fleets.fronts(part) for name, part in rows.groupby(kinds)}
    fill(docs / "fleets.md", found)
    files = sorted((reference / "scores").glob("*.json"))
    documents = {path.name: read_json(path) for path in files}
    with naming_run(reference / "scores"):
        table = board.leaderboard(documents)
    fill(docs / "leaderboard.md", {"board": table})
    fill(docs / "notes" / "results.md", {**found, "tasks": "\n\n".join(parts)})
    kept = read_parquet(reference / "averaged.parquet")
    fill(docs / "limits.md", {"averaged": averaged(kept)})
    kept = read_parquet(reference / "ablations.parquet")
    fill(docs / "ablations.md", {"ablations": as_markdown(ablations(kept))})


def averaged(rows: pd.DataFrame) -> str:
    """Return a Markdown table of savings at equal flow by source and comparison.

    Args:
        rows: ``source``, strategy (also behind filters with other longest time gaps) and window,
            with the energies of raw and of averaged speeds and of petrol, distance and flow.
    """
    energies = [f"total_{name}" for name in ("path_energy_kj", *AVERAGED, SECOND)]
    head, lines = ["traffic", "", "raw", *(f"{x:g} s" for x in AVERAGES), "petrol, raw"], []
    for source, words in SOURCES.items():
        part = rows[rows["source"] == source]
        names = part["strategy"].unique()
        own, rule = (points_of(names, one) for one in (NETWORK, FILTERED_RULE))
        for label, mine, other in (
            ("network against the recorded drivers", own, [RECORDED]),
            ("tuned IDM against the recorded drivers", rule, [RECORDED]),
            ("network against tuned IDM", own, rule),
        ):
            found = [at_equal_flow(part, mine, other, x, RECORDED) for x in energies]
            at = f", at {found[0].more_flow:.0%} more flow" * (found[0].more_flow > MORE_NAMED)
            lines.append([words, label + at.replace("%", " %"), *map(fleets.percent, found)])
    return markdown_table(head, lines)


def learners(reference: Path, docs: Path) -> None:
    """Write the scores of learners: a row per task and learner, with the range of seeds."""
    rows = worded(read_parquet(reference / "learners.parquet"))
    rows = rows.replace({"strategy": trained.LEARNERS})
    scores = {"score": "mean", "score_low": "min", "score_high": "max"}
    how = {name: ("score", kind) for name, kind in scores.items()}
    how |= {name: (name, "mean") for name in rows.columns[4:]}
    table = rows.groupby(["task", "strategy"], sort=False).agg(**how).reset_index()
    table.loc[table["score_low"] == table["score_high"], ["score_low", "score_high"]] = np.nan
    table.attrs["decimals"] = 2
    chosen = table["task"].str.contains("training")  # where settings were chosen
    windows = read_parquet(reference / "learner_windows.parquet")
    found = {"savings": trained.learner_savings(windows)}
    for page, own in (("learners.md", table[~chosen]), ("notes/agents.md", table[chosen])):
        shown = {"learners": as_markdown(own.dropna(axis=1, how="all"))}
        fill(docs / page, shown | found)


def ablations(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the table of rewards without some terms, compared at equal flow.

    Args:
        rows: result of :func:`lcc_rl.results.windows.windows_of` of policies that were trained with
            ``reward.without``, behind filters with several longest time gaps.
    """
    found, names = report(rows, against=ALL_TERMS), rows["strategy"].unique()
    keys = ["driver", "energy_kj_per_km", "saved_pct", "flow_pct", "flow_saved_pct"]
    shown, table, fronts = for_print(found, keys), found.short, partial(points_of, names)
    compared = table["flow_saved_pct"].notna() & (table["strategy"] != ALL_TERMS)
    saved = [
        at_equal_flow(rows, fronts(name) * kept, fronts(ALL_TERMS), ENERGY, RECORDED).percent
        for name, kept in zip(table["strategy"], compared, strict=True)
    ]
    shown[[f"at equal flow [%]{end}" for end in BOUNDED]] = saved
    return shown.replace({"driven by": ROWS_WITHOUT}, regex=True)


def points_of(names: Iterable[str], kind: str) -> list[str]:
    """Return the strategies along the front of one kind."""
    return [x for x in names if x.partition(ON_FRONT)[0] == kind]


def task_table(name: str, table: pd.DataFrame) -> str:
    """Return the Markdown table of a task below its name."""
    first = {str(key): value for key, value in table.iloc[0].items()}
    kept = {x.removeprefix(LIMIT): float(first[x]) for x in first if x.startswith(LIMIT)}
    given = {"score": first["score_name"], "unit": first["unit"], "against": first["against"]}
    task = Task(name=name, limits=kept, **given)
    head = ["driven by", task.label, "saved [%]", "distance [%]", "flow [1/h] (%)", "limits"]
    lines = []
    whole = table.set_index("strategy").loc[task.against, FLOW]
    for row in table.to_dict("records"):
        share = (100.0 * row[f"saving{end}"] for end in ("", "_low", "_high"))
        cells = [
            in_words(str(row["strategy"])),
            f"{row['score']:.2f}",
            saved_text(*share),
            signed(-100.0 * row["distance_lost"]),
            f"{row[FLOW]:,.0f} ({signed(100.0 * (row[FLOW] / whole - 1.0))})",
            "kept" if row["kept"] else broken(task, row),
            f"{row['decision_ms']:.2f}" if np.isfinite(row["decision_ms"]) else "",
        ]
        lines.append(cells)
    bounds = ", ".join(bounded(one, bound) for one, bound in task.bounds.items())
    words = f"Saved against {in_words(task.against)}. Limits: {bounds or 'no collision'}."
    shown = markdown_table([*head, "decision [ms]"], lines)
    return f"### {name}\n\n{first['windows']} windows. {words}\n\n{shown}"


def bounded(measure: Measure, bound: float) -> str:
    """Return a measure and its limit in words."""
    return f"{measure.limited} {SIGNS[measure.bound]} {measure.with_unit(bound)}"


def broken(task: Task, row: Mapping[Hashable, Any]) -> str:
    """Return the violated limits with their values, or the collisions."""
    found = [
        f"{one.limited} {one.with_unit(row[one.key])}"
        for one, bound in task.bounds.items()
        if not one.keeps(row[one.key], bound)
    ]
    return "; ".join(found) or f"{row['collisions']} collisions"


def figure_of_record() -> Figure:
    """Draw the speed record of platoons' training, and the test cases."""
    cfg = load("evaluate", ["variant=cacc"])
    step, used = cfg.scenario.time_step, cfg.leader.settings["training"]["udds"]
    leaders = cfg.leader.made().load(step, cfg.scenario.horizon, len(cfg.scenario.vehicles))
    record = stretch(used["path"], step, used["scale"])
    return record_figure(record, used["from_s"], leaders.cases)


@drawing.paper
def figure_of_limits(windows: pd.DataFrame) -> Figure:
    """Draw path energy over the share of long time gaps: a dot per training, a line per kind.

    Args:
        windows: one row per training and held-out window.
    """
    figure = drawing.new_figure(drawing.COLUMN_WIDTH, 3.2)
    axes = figure.subplots()
    kinds = dict(list(windows.groupby(FRONT_KINDS)))
    for kind, (label, hue) in KINDS_SHOWN.items():
        line = points(kinds[kind]).sort_values(LONG_SHARE)
        axes.plot(100.0 * line[LONG_SHARE], line[ENERGY], color=hue)
        each = kinds[kind].groupby(["limit", "training_seed"])[[ENERGY, LONG_SHARE]].mean()
        axes.plot(100.0 * each[LONG_SHARE], each[ENERGY], "o", color=hue, ms=3.0)
        axes.plot([], [], "o-", label=label, color=hue, ms=3.0)
    figure.legend(loc="outside upper left", ncols=2)
    axes.set(xlabel="time gap > 2.5 s above 1 m/s [% of the time]")
    axes.set(ylabel="path energy [kJ per episode]")
    drawing.footnote(figure, "dot: one training; line: means at limits of 0.5, 1 and 2 %")
    return figure


def figure_of_ring(reference: Path) -> Figure:
    """Draw the trajectories on the ring."""
    cfg = as_plain(load("evaluate", ["task=ring-22"]))
    steps = read_parquet(reference / "tasks" / "ring_steps.parquet").replace({"strategy": SHOWN})
    figure = space_time(steps, list(SHOWN.values()), cfg, every=2)
    assert figure is not None
    return figure


def figures(reference: Path, folder: Path) -> list[Path]:
    """Draw the figures of stored results; return the written files."""

    def kept(name: str) -> pd.DataFrame:
        return read_parquet(reference / f"{name}.parquet")

    drawn: dict[str, Callable[[], Figure]] = {
        "fleets": lambda: fleets.drawn_fronts(kept("tasks/fleets_fronts")),
        "fleets_ring": lambda: fleets.drawn_ring(kept("tasks/fleets_ring")),
        "limits": lambda: figure_of_limits(kept("limits/windows")),
        "measured": lambda: measured_energy.figure_of(kept("measured_energy")),
        "record": figure_of_record,
        "ring": lambda: figure_of_ring(reference),
        "twins": lambda: twins_figure(kept("twins")),
    }
    return [drawing.save(draw(), folder / f"{x}.png") for x, draw in drawn.items()]


def main(words: Sequence[str] | None = None) -> int:
    """Write all pages and figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--reference", type=Path, default=REFERENCE, help="folder of the results")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the pages")
    options = parser.parse_args(words)
    for name in SHOWN_OF:
        study(name, options.reference, options.docs)
    tasks(options.reference, options.docs)
    learners(options.reference, options.docs)
    figures(options.reference, options.docs / "figures")
    print(f"written: {options.docs}")
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
