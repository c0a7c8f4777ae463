"""Compare energy models with measurements: python tools/measured_energy.py --bench … --electric …

Three tables with a row per sample are read. Fuel on an engine bench: setting, position, sample,
time_s, speed_mps, fuel_g_per_s. Battery of an electric car: trip, time_s, speed_mps, elevation_m,
battery_v, battery_a (discharge negative), heating_kw, aircon_kw. Fuel on a chassis dynamometer:
test, time_s, speed_mps, fuel_ccps. Every run, of the dynamometer every range of speeds of a test,
becomes a row of outputs/reference/measured_energy.parquet, from which --draw alone draws
docs/figures/measured.png.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from lcc_rl.cli.guard import main_guard
from lcc_rl.energy import CirclesFuel, ElectricCar, EnergyModel
from lcc_rl.figures.drawing import (
    INK,
    PAGE_WIDTH,
    grid,
    legend_above,
    new_figure,
    paper,
    save,
    style,
)
from lcc_rl.io.files import read_parquet, write_parquet

KEPT, DRAWN = Path("outputs/reference/measured_energy.parquet"), Path("docs/figures/measured.png")
SMOOTHING = 1.1  # moving average of the speeds before they are differentiated [s]
FUELS = {"Compact": "#0072b2", "midBase": "#d55e00", "midSUV": "#999999"}
ELECTRIC = "electric"
GRAVITY = 9.81  # [m/s²]
WARM = 15.0  # ambient temperature above which a trip counts as summer [°C]
SEASONS = {"summer": "#d55e00", "winter": "#0072b2"}
LABELS = {"summer": "summer", "winter": "winter, with the heating"}
RUN = ["setting", "position", "sample"]
PETROL = 0.745  # [g/cm³]
RANGES = {"below 10 m/s": 10.0, "10 to 21 m/s": 21.0, "above 21 m/s": np.inf}  # their ends
Array = NDArray[np.float64]


def motion(frame: pd.DataFrame) -> tuple[Array, Array, float]:
    """Return smoothed speed [m/s], acceleration [m/s²] and the time step [s] of a run."""
    time = frame["time_s"].to_numpy(float)
    step = float(np.median(np.diff(time)))
    width = max(1, round(SMOOTHING / step))
    padded = np.pad(frame["speed_mps"].to_numpy(float), width // 2, mode="edge")
    speed = np.convolve(padded, np.ones(width) / width, mode="valid")[: len(time)]
    return speed, np.gradient(speed, step), step


def energy_of(model: EnergyModel, speed: Array, acceleration: Array, step: float) -> float:
    """Return what a model draws on a run [J]."""
    power = model.power(torch.from_numpy(speed), torch.from_numpy(acceleration))
    return float(power.sum()) * step


def fuels_of(speed: Array, acceleration: Array, step: float) -> dict[str, float]:
    """Return the fuel that each model burns on a run [g]."""
    models = {name: CirclesFuel(vehicle=name) for name in FUELS}
    run = (speed, acceleration, step)
    return {name: energy_of(model, *run) / model.heating_value for name, model in models.items()}


def of_bench(bench: pd.DataFrame) -> pd.DataFrame:
    """Return a row per run on the bench: distance, and measured and modelled fuel [g]."""
    rows = []
    for key, run in bench.groupby(RUN, observed=True):
        speed, acceleration, step = motion(run)
        row = dict(zip(RUN, key, strict=True)) | {"distance_m": float(speed.sum()) * step}
        row["measured"] = float(run["fuel_g_per_s"].sum()) * step
        rows.append(row | fuels_of(speed, acceleration, step))
    return pd.DataFrame(rows).assign(kind="bench")


def of_trips(trips: pd.DataFrame) -> pd.DataFrame:
    """Return a row per trip: distance, and measured and modelled energy of the battery [kWh].

    The model has the grade's potential energy added and its auxiliaries measured: heating and air
    conditioning.
    """
    model = ElectricCar()
    rows = []
    for trip, run in trips.groupby("trip", observed=True):
        speed, acceleration, step = motion(run)
        height = run["elevation_m"].to_numpy(float)
        comfort = 1e3 * run[["heating_kw", "aircon_kw"]].fillna(0.0).to_numpy().sum() * step
        drawn = energy_of(model, speed, acceleration, step)
        lifted = model.mass * GRAVITY * (height[-1] - height[0]) / model.efficiency
        measured = -float((run["battery_v"] * run["battery_a"]).sum()) * step
        rows.append(
            {
                "setting": "summer" if run["ambient_c"].mean() > WARM else "winter",
                "trip": str(trip),
                "distance_m": float(speed.sum()) * step,
                "measured": measured / 3.6e6,
                ELECTRIC: (drawn + lifted + comfort) / 3.6e6,
                f"{ELECTRIC}_bare": (drawn + lifted) / 3.6e6,
            }
        )
    return pd.DataFrame(rows).assign(kind="battery")


def of_dynamometer(tests: pd.DataFrame) -> pd.DataFrame:
    """Return a row per test and range of speeds: distance, measured and modelled fuel [g]."""
    rows = []
    for test, run in tests.groupby("test", observed=True):
        speed, acceleration, step = motion(run)
        fuel = PETROL * run["fuel_ccps"].to_numpy(float)
        place = np.searchsorted([*RANGES.values()], speed, side="right")
        for number, name in enumerate(RANGES):
            own = place == number
            row = {"setting": name, "trip": str(test), "measured": float(fuel[own].sum()) * step}
            row["distance_m"] = float(speed[own].sum()) * step
            rows.append(row | fuels_of(speed[own], acceleration[own], step))
    return pd.DataFrame(rows).assign(kind="dynamometer")


def agreement(rows: pd.DataFrame, model: str) -> tuple[float, float]:
    """Return level and correlation of runs: modelled over measured in total, and r of both.

    Below three runs r says nothing and is NaN.
    """
    level = float(rows[model].sum() / rows["measured"].sum())
    return level, rows[model].corr(rows["measured"]) if len(rows) > 2 else np.nan


def along(bench: pd.DataFrame, column: str) -> float:
    """Return the fuel per km of the last car of a platoon over that of the first."""
    sums = bench.groupby("position")[[column, "distance_m"]].sum()
    per_km = sums[column] / sums["distance_m"]
    return float(per_km.iloc[-1] / per_km.iloc[0])


@paper
def figure_of(table: pd.DataFrame) -> Figure:
    """Draw modelled over measured energy per km, a dot for each run."""
    bench, trips = (table[table["kind"] == kind] for kind in ("bench", "battery"))
    figure = new_figure(PAGE_WIDTH, 3.4)
    left, right = figure.subplots(1, 2)
    for model, colour in FUELS.items():
        _dots(left, bench, model, colour, 1e3)
    for season, colour in SEASONS.items():
        part = trips[trips["setting"] == season]
        model = ELECTRIC if season == "winter" else f"{ELECTRIC}_bare"
        _dots(right, part, model, colour, 1e6, label=LABELS[season])
    style(left, "measured, Renault 1.3 TCe on a bench [g/km]", "modelled fuel [g/km]")
    style(right, "measured, BMW i3 on the road [Wh/km]", "modelled energy [Wh/km]")
    for axis in (left, right):
        ends = [*axis.get_xlim(), *axis.get_ylim()]
        axis.plot([min(ends), max(ends)], [min(ends), max(ends)], color=INK, lw=0.8, label="equal")
        legend_above(axis, 1)
        grid(axis)
    return figure


def _dots(
    axis: Axes, rows: pd.DataFrame, model: str, colour: str, scale: float, label: str | None = None
) -> None:
    level, together = agreement(rows, model)
    text = f"{label or model}: modelled/measured {level:.2f}, r = {together:.2f}"
    per_km = scale * rows[["measured", model]].div(rows["distance_m"], axis=0)
    axis.plot(per_km["measured"], per_km[model], ".", color=colour, label=text)


def lines(table: pd.DataFrame) -> list[str]:
    """Return the agreement of every model with all runs of its kind and with each setting."""
    found = []
    electric = [ELECTRIC, f"{ELECTRIC}_bare"]
    for kind, models in {"bench": [*FUELS], "dynamometer": [*FUELS], "battery": electric}.items():
        whole = table[table["kind"] == kind]
        for setting, rows in [("all", whole), *whole.groupby("setting")]:
            for model in models:
                level, together = agreement(rows, model)
                runs = f"{kind}, {setting}, {model}: {len(rows)} runs"
                found.append(f"{runs}, level {level:.3f}" + f", r {together:.3f}" * (len(rows) > 2))
            if kind == "bench" and setting != "all":
                cars = ", ".join(f"{name} {along(rows, name):.3f}" for name in ["measured", *FUELS])
                found.append(f"last over first car, {setting}: {cars}")
    return found


def main(words: Sequence[str] | None = None) -> int:
    """Measure where files are given, print the agreement, and draw."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bench", type=Path, help="table of the engine bench")
    parser.add_argument("--electric", type=Path, help="table of the electric car")
    parser.add_argument("--dynamometer", type=Path, help="table of the dynamometer, .csv")
    parser.add_argument("--draw", action="store_true", help="only draw what was kept")
    parser.add_argument("--kept", type=Path, default=KEPT, help="table of runs")
    parser.add_argument("--figure", type=Path, default=DRAWN, help="where to draw")
    options = parser.parse_args(words)
    if not options.draw:
        if None in (options.bench, options.electric, options.dynamometer):
            parser.error("give --bench, --electric and --dynamometer, or --draw")
        parts = (
            of_bench(read_parquet(options.bench)),
            of_trips(read_parquet(options.electric)),
            of_dynamometer(pd.read_csv(options.dynamometer)),
        )
        write_parquet(pd.concat(parts, ignore_index=True), options.kept)
    table = read_parquet(options.kept)
    print(*lines(table), sep="\n")
    save(figure_of(table), options.figure)
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
