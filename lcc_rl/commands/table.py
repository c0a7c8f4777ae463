"""The table of a finished run, printed again in several formats."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill

import pandas as pd

from lcc_rl.commands.evaluation import Run
from lcc_rl.config.words import SHOWN_AS
from lcc_rl.errors import require
from lcc_rl.io.files import Rows, as_rows, read_parquet
from lcc_rl.results.names import MARKS, rename, worded
from lcc_rl.results.render import as_csv, as_latex, as_markdown, chosen, for_print
from lcc_rl.results.report import together
from lcc_rl.results.runs import EPISODES, FINAL, PARTS, load_config, naming_run
from lcc_rl.results.sweeps import load_sweep
from lcc_rl.runs.states import CONFIG, run_folders

PRINTERS = (as_markdown, as_markdown, as_latex, as_csv)
OF_RUNS = ("all", "against", "unit", "rename", "figure")  # options of a run's table
TABLE_FORMATS: dict[str, Callable[..., str]] = dict(zip(SHOWN_AS, PRINTERS, strict=True))


def print_again(options: Namespace) -> None:
    """Print the table of a run or of a parquet file; ``options`` are those of the command."""
    csv = options.format == "csv"
    names = options.columns.split(",") if options.columns else []
    note = ""
    if options.run.suffix == ".parquet":
        unused = [name for name in OF_RUNS if getattr(options, name)]
        require(not unused, f"--{', --'.join(unused)} need a run's folder, not a parquet file")
        table = chosen(worded(read_parquet(options.run)), names)
    else:
        run = read_run(options.run, options.trust)
        if options.unit:
            run = replace(run, cfg=run.cfg.with_(unit=options.unit))
        for row, label in options.rename or ():
            rename(row, label, names_of(run.rows))
        if options.figure:
            draw_table(run, options.against, options.figure)
        with naming_run(run.folder / EPISODES):
            if options.format == "text" and not names:
                print(run.printed(options.all, options.against))
                return
            report = together(reports := run.reports(options.against))
            if names and len(reports) > 1 and not csv:
                names = list(dict.fromkeys(["of", *names]))
        if options.all:
            table = chosen(report.table, names)
        else:
            note = report.note
            table = chosen(report.short, names) if csv else for_print(report, names)
        if csv:  # has no footnotes
            table = table.replace({"driver": f" [{MARKS}]"}, "", regex=True)
        note = "" if csv else ". ".join(filter(None, [report.size, note]))
    print(TABLE_FORMATS[options.format](table, *[options.decimal] * csv))
    if note:
        lines = fill(note, 98, initial_indent="% ", subsequent_indent="% ")
        print(lines if options.format == "latex" else f"\n{note}")


def names_of(rows: Rows) -> list[object]:
    """Return the strategies of rows."""
    table = rows if isinstance(rows, pd.DataFrame) else rows.to_table(["strategy"]).to_pandas()
    return list(table["strategy"].unique())


def draw_table(run: Run, against: str | None, path: str) -> None:
    """Draw the table of a run with grey dots for training seeds."""
    # Here, because tables need no matplotlib.
    from lcc_rl.figures.drawing import save
    from lcc_rl.figures.evaluation import measures_of

    rows, alone = run.rows, []
    with naming_run(run.folder / EPISODES):
        if isinstance(rows, pd.DataFrame):
            seeds = rows["training_seed"]
            parts = (rows[seeds.isna() | (seeds == seed)] for seed in seeds.dropna().unique())
            alone = [together(replace(run, rows=part).reports(against)) for part in parts]
        figure = measures_of(together(run.reports(against)), alone)
    save(figure, path)


def read_run(folder: Path, trust: Sequence[str]) -> Run:
    """Return the run of a folder: the last part of a job, all runs of a sweep as one."""
    folder = folder / FINAL if (folder / PARTS).is_dir() else folder
    if not (folder / CONFIG).is_file() and run_folders(folder):
        rows = load_sweep(folder)
        return Run(folder, rows, load_config(rows.attrs["first"], trust))
    cfg = load_config(folder, trust)
    with naming_run(folder / EPISODES):
        return Run(folder, as_rows(folder / EPISODES), cfg)
