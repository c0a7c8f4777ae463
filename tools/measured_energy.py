"""Compare energy models with measurements: python tools/measured_energy.py

Prints levels and correlations of the stored runs: fuel on an engine bench and on a chassis
dynamometer [g], energy of an electric car's battery [kWh], each measured and modelled. The version
of commit a07c1fcb wrote the runs from the tables of samples.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.figures.drawing import INK, PAGE_WIDTH, legend_above, new_figure, paper
from lcc_rl.io.files import read_parquet

FUELS = {"Compact": "#0072b2", "midBase": "#d55e00", "midSUV": "#999999"}
ELECTRIC = "electric"
SEASONS = {"summer": "#d55e00", "winter": "#0072b2"}
LABELS = {"summer": "summer", "winter": "winter, with the heating"}


def agreement(rows: pd.DataFrame, model: str) -> tuple[float, float]:
    """Return level and correlation of runs: modelled over measured in total, and r of both per km.

    The r of totals would depend on the lengths of the runs. With fewer than three runs it is NaN.
    """
    level = float(rows[model].sum() / rows["measured"].sum())
    per_km = rows[[model, "measured"]].div(rows["distance_m"], axis=0)
    return level, per_km[model].corr(per_km["measured"]) if len(rows) > 2 else np.nan


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
    left.set(xlabel="measured, Renault 1.3 TCe on a bench [g/km]", ylabel="modelled fuel [g/km]")
    right.set(xlabel="measured, BMW i3 on the road [Wh/km]", ylabel="modelled energy [Wh/km]")
    for axis in (left, right):
        ends = [*axis.get_xlim(), *axis.get_ylim()]
        axis.plot(
            [min(ends), max(ends)],
            [min(ends), max(ends)],
            color=INK,
            lw=0.8,
            label="modelled = measured",
        )
        legend_above(axis, 1)
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


if __name__ == "__main__":
    print(*lines(read_parquet("outputs/reference/measured_energy.parquet")), sep="\n")
