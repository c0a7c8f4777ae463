"""Measure speed against named alternatives: python tools/benchmarks [read env …] [--quick].

A figure is the median of alternating repeats (A B A B …); a ratio is the median over the repeats
of value / value of the alternative, both of the same run, so that a busy machine slows both.
Every row also goes into one parquet file (--out). What each measures: docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import logging
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from shutil import which

import pandas as pd
import torch
from rich.console import Console
from rich.markup import escape

from benchmarks.calibrate import calibrate
from benchmarks.collect import collect
from benchmarks.env import env
from benchmarks.evaluate import evaluate
from benchmarks.gym import gym
from benchmarks.harness import EXTRA, Row, drawn, installed
from benchmarks.read import read
from benchmarks.train import train
from benchmarks.update import update
from lcc_rl.data.tables import TableFile
from lcc_rl.errors import LccError, ResultsError, how_to_install, unknown_name
from lcc_rl.io.files import processor, write_parquet

LISTED = (read, env, gym, collect, update, train, calibrate, evaluate)
BENCHMARKS: dict[str, Callable[[Namespace], list[Row]]] = {
    function.__name__: function for function in LISTED
}


def parse(arguments: Sequence[str] | None) -> Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    listed = f"{', '.join(BENCHMARKS)}; all by default, which takes minutes"
    parser.add_argument("names", nargs="*", metavar="name", help=listed)
    parser.add_argument("--ngsim", help="18-column CSV to read (default: a synthetic stream)")
    parser.add_argument("--episodes", help="episode table to calibrate (default: the stream's)")
    parser.add_argument(
        "--compile", action=argparse.BooleanOptionalAction, help="compiled cases (default: yes)"
    )
    parser.add_argument("--device", help="cpu or cuda (default: cpu, and cuda where there is one)")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--repeats", type=int, default=5, help="repeats of every case")
    parser.add_argument(
        "--quick", action="store_true", help="two repeats of tiny sizes, not compiled, as a trial"
    )
    parser.add_argument("--out", default="outputs/benchmark.parquet", help="where the rows go")
    options = parser.parse_args(arguments)
    if min(options.threads, options.repeats) < 1:
        parser.error("--threads and --repeats must be at least 1")
    options.repeats = 2 if options.quick else options.repeats
    if options.compile is None:
        options.compile = not options.quick and which("c++") is not None
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; return 1 if the input is at fault."""
    options = parse(arguments)
    torch.set_num_threads(options.threads)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    console, rows = Console(), []
    console.width = max(console.width, 110)
    if not installed():
        console.print(escape(f"left out: {', '.join(EXTRA)} ({how_to_install('bench')})"))
    here = {"threads": options.threads, "machine": processor(), "torch": torch.__version__}
    devices = ["cpu", "cuda"] if torch.cuda.is_available() else ["cpu"]
    try:
        if Path(options.out).exists() and "benchmark" not in TableFile(options.out).header:
            raise ResultsError(f"{options.out} is no table of benchmarks; choose another --out")
        for name in options.names:
            if name not in BENCHMARKS:
                raise unknown_name("benchmark", name, BENCHMARKS)
        for name in options.names or BENCHMARKS:
            chosen = [options.device] if options.device else devices
            for device in ["cpu"] if name == "read" else chosen:
                measured = BENCHMARKS[name](Namespace(**{**vars(options), "device": device}))
                console.print(drawn(f"{name}, {device}", measured))
                rows += [{"benchmark": name, **row, "device": device} for row in measured]
                # After each, so that what is measured stays whatever happens to the next.
                table = pd.DataFrame(rows).astype({"batch": "Int64"}).assign(**here)
                write_parquet(table, options.out)
    except LccError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    console.print(f"{len(rows)} rows: {options.out}")
    return 0
