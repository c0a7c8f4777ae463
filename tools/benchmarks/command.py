"""Measure speed against named alternatives: python tools/benchmarks [read env …] [--quick].

A figure is the median of alternating repeats (A B A B …); a ratio is the median over the repeats
of value / value of the alternative, both of the same run, so that a busy machine slows both.
Every row also goes into one parquet file (--out). What each measures: docs/benchmarks.md.
"""

from __future__ import annotations

import logging
import os
from argparse import BooleanOptionalAction, Namespace
from collections.abc import Callable, Sequence
from datetime import date
from shutil import which

import pandas as pd
import torch

from benchmarks.calibrate import calibrate
from benchmarks.env import collect, env, gym
from benchmarks.harness import EXTRA, Row, installed, page, table
from benchmarks.jobs import analytic, evaluate, train, update
from benchmarks.read import read, start
from benchmarks.string import simulate, string
from lcc_rl.data.tables import TableFile
from lcc_rl.errors import how_to_install, require_known
from lcc_rl.io.atomic import new_file
from lcc_rl.io.files import processor, read_parquet, write_parquet
from lcc_rl.runs.arguments import Arguments, typed
from lcc_rl.settings import Million

LISTED = (
    *(read, start, env, string, simulate, gym, collect, update, train, analytic),
    *(calibrate, evaluate),
)
BENCHMARKS: dict[str, Callable[[Namespace], list[Row]]] = {
    function.__name__: function for function in LISTED
}


def parse(arguments: Sequence[str] | None) -> Namespace:
    """Read the command line."""
    parser = Arguments(description=__doc__.partition("\n")[0] if __doc__ else None)
    listed = f"{', '.join(BENCHMARKS)}; all by default, which takes minutes"
    parser.add_argument("names", nargs="*", metavar="name", help=listed)
    parser.add_argument(
        "--compile", action=BooleanOptionalAction, help="compiled cases (default: yes)"
    )
    parser.add_argument("--repeats", type=typed(Million), default=5, help="repeats of every case")
    parser.add_argument(
        "--quick", action="store_true", help="two repeats of tiny sizes, not compiled, as a trial"
    )
    parser.add_argument("--out", default="outputs/benchmark.parquet", help="where the rows go")
    parser.add_argument(
        "--page", nargs="+", metavar="ROWS", help="measure nothing: print files of rows as Markdown"
    )
    options = parser.parse_args(arguments)
    options.repeats = 2 if options.quick else options.repeats
    if options.compile is None:
        options.compile = not options.quick and which("c++") is not None
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write."""
    options = parse(arguments)
    if options.page:
        print(page(pd.concat(map(read_parquet, options.page), ignore_index=True)))
        return 0
    require_known("benchmark", options.names, BENCHMARKS)
    out = new_file(options.out, "--out", lambda path: "benchmark" in TableFile(path).header)
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    if not installed():
        print(f"left out: {', '.join(EXTRA)} ({how_to_install('bench')})")
    here = {
        "machine": processor(),
        "torch": torch.__version__,
        "date": f"{date.today()}",
        "repeats": options.repeats,
    }
    rows = pd.DataFrame()
    for name in options.names or BENCHMARKS:
        measured = pd.DataFrame(BENCHMARKS[name](options)).assign(benchmark=name, **here)
        if len(measured):
            measured = measured.assign(load=os.getloadavg()[0]).astype({"batch": "Int64"})
            print(f"\n{table(measured)}", flush=True)
            rows = pd.concat([rows, measured])
            write_parquet(rows, out)  # after each, so that an interruption loses the next ones only
    print(f"{len(rows)} rows: {out}")
    return 0
