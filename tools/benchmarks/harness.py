"""Benchmarks, the harness: timing in turn, rows, and the table they are shown in."""

from __future__ import annotations

import os
import time
import warnings
from argparse import Namespace
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from rich.table import Table

from lcc_rl.synthetic.stream import StreamSource

TOLERANCE = 1e-4  # within which two ways to the same result must agree before they are timed
EXTRA = ("stable_baselines3", "gymnasium", "numba")  # the alternatives
Row = dict[str, Any]
Run = Callable[[], Any]
Values = Mapping[str, np.ndarray]


def alternate(runs: Mapping[str, Run], repeats: int) -> dict[str, np.ndarray]:
    """Seconds of every run, ``repeats`` times in turn; once before that, untimed."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            begun = clock()
            run()
            spent[name].append(clock() - begun)
    return {name: np.array(seconds[1:]) for name, seconds in spent.items()}


def first_calls(runs: Mapping[str, Run]) -> dict[str, np.ndarray]:
    """Seconds of the first call of every run, with nothing kept of an earlier compilation."""
    spent = {}
    config: Any = torch.compiler.config  # torch adds its method patch on import
    with config.patch(force_disable_caches=True), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that caches are disabled
        for name, run in runs.items():
            begun = clock()
            run()
            spent[name] = np.array([clock() - begun])
    return spent


def clock() -> float:
    """Read the time [s] once the accelerator, if any, has done what it was given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def rows_of(
    benchmark: str, values: Values, unit: str, other: str | None = None, batch: int | None = None
) -> list[Row]:
    """One row per case; ``values`` holds the repeats of each, in the order they were taken."""
    columns = ("benchmark", "case", "batch", "value", "unit", "spread_low", "spread_high")
    rows = []
    for case, each in values.items():
        figures = (benchmark, case, batch, np.median(each), unit, each.min(), each.max())
        against = other if case != other else None
        ratio = np.nan if against is None else np.median(each / values[against])
        row = dict(zip(columns, figures, strict=True))
        rows.append({**row, "alternative": against, "ratio": ratio})
    return rows


def times(count: int, function: Run) -> None:
    """Call a function so many times."""
    for _ in range(count):
        function()


def stream(quick: bool) -> StreamSource:
    """Return the default data: the synthetic stream, or a little of it."""
    return StreamSource(2, 3, 3, (35.0, 45.0)) if quick else StreamSource()


def installed(*names: str) -> bool:
    """Whether all these packages, of the extra ``bench`` or numba, are at hand."""
    try:
        return all(find_spec(name) is not None for name in names)
    except ModuleNotFoundError:  # of a package within one that is missing
        return False


def endings(options: Namespace) -> tuple[str, ...]:
    """Return what is appended to the names of eager cases and, if wanted, of compiled ones."""
    return ("", ", compiled") if options.compile else ("",)


def drawn(name: str, rows: list[Row]) -> Table:
    """The rows of one benchmark, for the terminal."""
    table = Table(title=name, caption=f"load average {os.getloadavg()[0]:.1f}")
    for heading in ("case", "batch", "median", "smallest … largest", "unit", "ratio", "to"):
        table.add_column(heading, justify="left" if heading in ("case", "unit", "to") else "right")
    for row in rows:
        numbers = (row["value"], row["spread_low"], row["spread_high"])
        value, low, high = (f"{x:,.0f}" if x >= 1000 else f"{x:.3g}" for x in numbers)
        batch = "" if row["batch"] is None else str(row["batch"])
        other = (
            ("", "") if row["alternative"] is None else (f"{row['ratio']:.3g}", row["alternative"])
        )
        table.add_row(row["case"], batch, value, f"{low} … {high}", row["unit"], *other)
    return table
