"""Timing in turn, comparison with alternatives, and the rows that come out."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from typing import Any

import numpy as np
import pandas as pd
import torch

from lcc_rl.results.render import markdown_table
from lcc_rl.synthetic.stream import StreamSource

TOLERANCE = 1e-4  # within which two ways to the same result must agree before they are timed
EXTRA = ("stable_baselines3", "gymnasium")  # alternatives of the extra bench
HEADINGS = ("case", "batch", "median", "smallest … largest", "unit", "ratio", "to")
Row = dict[str, Any]
Run = Callable[[], Any]
Against = Mapping[str, Sequence[str]]  # names of a case's alternatives


def alternate(
    runs: Mapping[str, Run], repeats: int, read: Callable[[], float] = time.perf_counter
) -> dict[str, np.ndarray]:
    """Return the seconds of every run, ``repeats`` times in turn; once before that, untimed."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            begun = read()
            run()
            spent[name].append(read() - begun)
    return {name: np.array(each[1:]) for name, each in spent.items()}


def rates(
    options: Namespace,
    runs: Mapping[str, Run],
    unit: str,
    count: int,
    against: Against | None = None,
    batch: int | None = None,
    grad: bool = False,
) -> list[Row]:
    """Time runs in turn and return their rates.

    Args:
        options: those of the command line.
        runs: the cases by name.
        unit: unit of the rates.
        count: what one call of a run makes or does.
        against: the alternatives of each case; those that are no case are left out.
        batch: the batch size.
        grad: keep gradients.
    """
    with torch.set_grad_enabled(grad):
        spent = alternate(runs, options.repeats)
    return rows_of({name: count / each for name, each in spent.items()}, unit, against, batch)


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


def cells_of(row: Any) -> list[str]:
    """Return the cells of a row below :data:`HEADINGS`."""
    numbers = (row["value"], row["spread_low"], row["spread_high"])
    value, low, high = (f"{x:,.0f}" if x >= 1000 else f"{x:.3g}" for x in numbers)
    batch = "" if pd.isna(row["batch"]) else f"{row['batch']:,}"
    compared = pd.notna(row["alternative"])
    ratio, other = (f"{row['ratio']:.3g}", row["alternative"]) if compared else ("", "")
    return [row["case"], batch, value, f"{low} … {high}", row["unit"], ratio, other]


def table(rows: pd.DataFrame) -> str:
    """Return rows as a table in Markdown."""
    cases = rows.assign(case=rows["benchmark"] + ": " + rows["case"])
    return markdown_table(HEADINGS, map(cells_of, cases.to_dict("records")))


def page(rows: pd.DataFrame) -> str:
    """Return the table of rows below a line on where and when they were measured."""
    kinds = ("machine", "torch", "repeats", "date")
    where = (f"{kind} {', '.join(map(str, rows[kind].unique()))}" for kind in kinds)
    load = f"load average {rows['load'].min():.1f} to {rows['load'].max():.1f}."
    return f"{'; '.join(where)}; {load}\n\n{table(rows)}"
