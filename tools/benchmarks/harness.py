"""Timing in turn, comparison with alternatives, and the rows that come out."""

from __future__ import annotations

import os
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd
import torch
from rich.table import Table

from lcc_rl.results.render import markdown_row
from lcc_rl.synthetic.stream import StreamSource

TOLERANCE = 1e-4  # within which two ways to the same result must agree before they are timed
EXTRA = ("stable_baselines3", "gymnasium")  # alternatives of the extra bench
TIMERS = {"wall": time.perf_counter, "processor": time.process_time}
timer = "wall"  # which of them is read
HEADINGS = ("case", "batch", "median", "smallest … largest", "unit", "ratio", "to")
Row = dict[str, Any]
Run = Callable[[], Any]
Against = Mapping[str, Sequence[str]]  # names of a case's alternatives


def alternate(runs: Mapping[str, Run], repeats: int) -> dict[str, np.ndarray]:
    """Return the seconds of every run, ``repeats`` times in turn; once before that, untimed."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            spent[name].append(seconds(run))
    return {name: np.array(each[1:]) for name, each in spent.items()}


def seconds(run: Run) -> float:
    """Return the seconds of a run."""
    begun = TIMERS[timer]()
    run()
    return TIMERS[timer]() - begun


def rates(
    options: Namespace,
    runs: Mapping[str, Run],
    unit: str,
    counts: Mapping[str, int],
    against: Against,
    batch: int | None = None,
    first: bool = False,
    grad: bool = False,
) -> list[Row]:
    """Time runs in turn and return their rates.

    Args:
        options: those of the command line.
        runs: the cases by name.
        unit: unit of the rates.
        counts: what one call of each run makes or does.
        against: the alternatives of each case; those that are no case are left out.
        batch: the batch size.
        first: add the seconds of each first call, with nothing kept of an earlier compilation.
        grad: keep gradients.
    """
    rows: list[Row] = []
    with torch.set_grad_enabled(grad):
        if first:
            config: Any = torch.compiler.config  # torch adds its method patch on import
            with config.patch(force_disable_caches=True), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # that caches are disabled
                calls = {name: np.array([seconds(run)]) for name, run in runs.items()}
            rows = rows_of(calls, "s, first call", batch=batch)
        spent = alternate(runs, options.repeats)
    values = {name: counts[name] / each for name, each in spent.items()}
    return rows_of(values, unit, against, batch) + rows


def rows_of(
    values: Mapping[str, np.ndarray],
    unit: str,
    against: Against | None = None,
    batch: int | None = None,
) -> list[Row]:
    """Return a row per case and alternative; ``values`` holds the repeats in their order."""
    rows = []
    for case, each in values.items():
        others = [name for name in (against or {}).get(case, ()) if name in values]
        row = {"case": case, "batch": batch, "value": np.median(each), "unit": unit}
        row |= {"spread_low": each.min(), "spread_high": each.max()}
        if not others:
            rows.append({**row, "alternative": None, "ratio": np.nan})
        for other in others:
            ratio = np.median(each / values[other])
            rows.append({**row, "alternative": other, "ratio": ratio})
    return rows


def agree(what: str, one: Any, other: Any, tolerance: float = TOLERANCE) -> None:
    """Check that two ways lead to the same result.

    Raises:
        RuntimeError: if they do not.
    """
    one, other = (torch.as_tensor(x, dtype=torch.float64).cpu() for x in (one, other))
    off = float((one - other).abs().max())
    if not off <= tolerance:
        raise RuntimeError(f"{what} is off by {off:g}")


def stream(quick: bool) -> StreamSource:
    """Return the default data: the synthetic stream, or a little of it."""
    small = StreamSource(recordings=2, platoons=3, vehicles=3, duration_s=(35.0, 45.0))
    return small if quick else StreamSource()


def installed() -> bool:
    """Return whether the packages of the extra ``bench`` are installed."""
    return all(find_spec(name) is not None for name in EXTRA)


def endings(options: Namespace) -> tuple[str, ...]:
    """Return what is appended to the names of eager cases and, if wanted, of compiled ones."""
    return ("", ", compiled") if options.compile else ("",)


def drawn(name: str, rows: list[Row]) -> Table:
    """Return the rows of one benchmark as a table for the terminal."""
    table = Table(title=name, caption=f"load average {os.getloadavg()[0]:.1f}")
    for heading in HEADINGS:
        table.add_column(heading, justify="left" if heading in ("case", "unit", "to") else "right")
    for row in rows:
        table.add_row(*cells_of(row))
    return table


def cells_of(row: Any) -> list[str]:
    """Return the cells of a row below :data:`HEADINGS`."""
    numbers = (row["value"], row["spread_low"], row["spread_high"])
    value, low, high = (f"{x:,.0f}" if x >= 1000 else f"{x:.3g}" for x in numbers)
    batch = "" if pd.isna(row["batch"]) else f"{row['batch']:,}"
    compared = pd.notna(row["alternative"])
    ratio, other = (f"{row['ratio']:.3g}", row["alternative"]) if compared else ("", "")
    return [row["case"], batch, value, f"{low} … {high}", row["unit"], ratio, other]


def page(rows: pd.DataFrame) -> str:
    """Return rows as a table in Markdown, below a line on where and when they were measured."""
    kinds = ("machine", "torch", "threads", "clock", "repeats", "date")
    where = (f"{kind} {', '.join(map(str, rows[kind].unique()))}" for kind in kinds)
    load = f"load average {rows['load'].min():.1f} to {rows['load'].max():.1f}."
    cases = rows.assign(case=rows["benchmark"] + ": " + rows["case"])
    table = [HEADINGS, ["---"] * len(HEADINGS), *map(cells_of, cases.to_dict("records"))]
    return "\n".join([f"{'; '.join(where)}; {load}", "", *map(markdown_row, table)])
