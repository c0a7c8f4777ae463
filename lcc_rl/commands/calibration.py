"""Calibration of drivers from trajectories."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import perf_counter

import pandas as pd
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from lcc_rl.config.compose import config_hash
from lcc_rl.config.nodes import CALLED, as_plain
from lcc_rl.config.schemas import CalibrateConfig
from lcc_rl.drivers.calibrator import (
    EQUILIBRIUM,
    MEAN_GAP,
    MEAN_SPEED,
    OUT,
    Calibration,
    count_records,
)
from lcc_rl.drivers.parameters import MODEL, parameters_of
from lcc_rl.drivers.population import from_table
from lcc_rl.envs.inputs import load_episodes
from lcc_rl.figures.calibration import calibration_figure, joint_figure, twins_figure
from lcc_rl.figures.drawing import save
from lcc_rl.functional.driver_models import PARAMETERS
from lcc_rl.io.files import write_parquet
from lcc_rl.results.render import DASH
from lcc_rl.results.runs import check_folder, save_config
from lcc_rl.runs.output import PLAIN
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.progress import phases
from lcc_rl.runs.states import claim

ERROR_HEADINGS = (
    *(("rmspe", "RMSPE [%]"), ("gap_rmse_m", "gap RMSE [m]")),
    ("gap_nrmse", "gap NRMSE [%]"),
)

# Gaps divided by the record's mean speed, below T in the table.
BESIDE_T = ((EQUILIBRIUM, "  at equilibrium [s]"), (MEAN_GAP, "  recorded [s]"))


def run(
    cfg: CalibrateConfig,
    folder: str | Path,
    console: Console | None = None,
    emit: Callable[[Sequence[str]], None] | None = None,
) -> pd.DataFrame:
    """Calibrate the drivers of ``cfg.data`` with the settings ``cfg.calibration``.

    Writes ``config.yaml``, ``twins.parquet``, ``drivers.parquet``, ``calibration.png``,
    ``joint_distribution.png`` and ``twins.png``.

    Args:
        cfg: configuration of the entry point ``calibrate``.
        folder: folder of the results.
        console: console of progress and summary; by default the terminal.
        emit: receives the lines of the report; by default they go to the console.

    Returns:
        The calibrated drivers, as written.

    Raises:
        LccError: for any error in settings, data or files, in one line.
    """
    folder, console = Path(folder), console or Console(highlight=False)
    emit = emit or partial(_print, console)
    with claim(folder):
        check_folder(cfg, folder)
        device = prepare_torch(cfg)
        # Settings are checked before the data are read, which may take a long time.
        calibrator = cfg.calibration.made(CALLED)
        dataset = load_episodes(cfg.data)
        emit(dataset.report)
        start = perf_counter()
        with phases("calibration", console, emit) as progress:
            result = calibrator(dataset.episodes, seed=cfg.seed, device=device, progress=progress)
        for role in ("follower", "leader"):
            names = result.drivers[f"{role}_id"].map(dataset.vehicles)
            if names.notna().any():
                result.drivers[role] = names
        seconds = perf_counter() - start
        save_config(cfg, folder)
        emit(result.report)
        _write(result, dataset.report, cfg, folder)
        console.print(_summary(result.drivers))
        emit([f"calibrated in {seconds:.1f} s; results in {folder}"])
        return result.drivers


def _write(result: Calibration, read: list[str], cfg: CalibrateConfig, folder: Path) -> None:
    plain = as_plain(cfg)
    settings = {key: plain[key] for key in ("data", "calibration", "seed", "inputs")}
    metadata = {
        "config": json.dumps(settings),
        "config_hash": config_hash(settings),
        "report": "\n".join([*read, *result.report]),
    }
    formats = cfg.figure_formats
    save(calibration_figure(result.drivers), folder / "calibration.png", formats=formats)
    save(joint_figure(result.drivers), folder / "joint_distribution.png", formats=formats)
    save(twins_figure(result.twins), folder / "twins.png", formats=formats)
    write_parquet(result.twins, folder / "twins.parquet", metadata)
    # Last, because it marks a finished calibration.
    write_parquet(result.drivers, folder / "drivers.parquet", metadata)


def _print(console: Console, lines: Sequence[str]) -> None:
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)


def _summary(drivers: pd.DataFrame) -> Table:
    """Return means and standard deviations of errors and parameters, by mode."""
    modes = list(drivers["mode"].unique())
    table = Table("", *modes, title="calibrated drivers, mean ± standard deviation", **PLAIN)
    groups = {mode: drivers[drivers["mode"] == mode] for mode in modes}
    table.add_row("fitted", *map(count_records, groups.values()))
    errors = [(column, column, label) for column, label in ERROR_HEADINGS]
    errors += [(column + OUT, column, f"{label}, held out") for column, label in ERROR_HEADINGS]
    for column, kind, label in errors:
        if column in drivers:
            scale = 1.0 if kind.endswith("_m") else 100.0
            table.add_row(escape(label), *(_spread(scale * p[column]) for p in groups.values()))
    for parameter in parameters_of(drivers[MODEL].unique()).values():
        row = (_spread(part[parameter.column]) for part in groups.values())
        table.add_row(escape(re.sub(r" \$.*\$", "", parameter.label)), *row)
        for gap, label in BESIDE_T if parameter.column == PARAMETERS["time_gap"].column else ():
            times = (_spread(part[gap] / part[MEAN_SPEED]) for part in groups.values())
            table.add_row(escape(label), *times)
    populations = [from_table(part).summary() for part in groups.values()]
    correlations = (row["correlation"] for row in populations)
    shown = (f"{value:.2f}" if math.isfinite(value) else DASH for value in correlations)
    table.add_row("correlation of (v0, T)", *shown)
    shares = (f"{100 * row['share_at_bound']:.0f} %" for row in populations)
    table.add_row("v0 on a bound", *shares)
    return table


def _spread(values: pd.Series) -> str:
    if values.nunique() == 1:
        return f"{values.iloc[0]:.2f} (all)"
    return f"{values.mean():.2f} ± {values.std():.2f}"  # n − 1 degrees of freedom
