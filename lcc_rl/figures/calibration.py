"""Figures of a calibration, counterparts of Figs. 4 and 5 of the ALCC paper."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcc_rl.drivers.parameters import DEFAULT_MODEL, MODEL, parameters_of
from lcc_rl.drivers.twins import REACTING, RECORDED_DRIVERS, TWINS, densities, ratios
from lcc_rl.errors import DataError
from lcc_rl.figures.drawing import COLUMN_WIDTH, INK, PAGE_WIDTH, SOFT, footnote, new_figure, paper
from lcc_rl.results.measures import signed

MODE_COLOURS = {"local": "#0072b2", "global": "#d55e00"}
DRIVER_COLOURS = {RECORDED_DRIVERS: INK, TWINS: "#d55e00", REACTING: "#0072b2"}
RATIOS = {"energy": "energy\nper km", "lost": "lost to\naccelerating", "distance": "distance"}


@paper
def calibration_figure(drivers: pd.DataFrame) -> Figure:
    """Box plots of the error and the parameters by mode (Fig. 4 of the ALCC paper).

    Boxes span the quartiles, whiskers the 5th to 95th percentile; a diamond marks the mean.

    Args:
        drivers: calibrated drivers of one mode or both.

    Raises:
        DataError: if the table is empty or lacks a column.
    """
    modes = _modes(drivers)
    # Parameters that are constant in every mode would give empty panels.
    shown = {
        name: one
        for name, one in parameters_of(_models(drivers)).items()
        if drivers[one.column].nunique() > 1
    }
    rows = 1 + len(shown) // 3
    figure = new_figure(PAGE_WIDTH, 0.4 + 1.9 * rows)
    first, *others = figure.subplots(rows, 3).ravel()
    for axis in others[len(shown) :]:
        axis.remove()
    _boxes(first, {mode: 100.0 * part["rmspe"] for mode, part in modes.items()})
    first.set_title("speed error RMSPE [%]")
    for axis, (name, one) in zip(others, shown.items(), strict=False):
        _boxes(axis, {mode: part[one.column] for mode, part in modes.items()})
        axis.set_title(one.label)
        # The share of drivers with a parameter on a bound of the search.
        flags = {mode: part[f"{name}_at_bound"].mean() for mode, part in modes.items()}
        texts = [f"{mode} {100 * share:.0f} %" for mode, share in flags.items() if share > 0.0]
        if texts:
            axis.set_xlabel(f"on a bound: {', '.join(texts)}", fontsize=7)
    means = ", ".join(f"{mode} {100 * part['rmspe'].mean():.1f} %" for mode, part in modes.items())
    model = ", ".join(drivers["model"].unique()).upper() if "model" in drivers else "IDM"
    figure.suptitle(f"{model} calibration: mean RMSPE {means}")
    footnote(
        figure, "box: quartiles; whiskers: 5th to 95th percentile; line: median; diamond: mean"
    )
    return figure


@paper
def joint_figure(drivers: pd.DataFrame) -> Figure:
    """Joint distribution of (v0, T) with its marginals (Fig. 5 of the ALCC paper).

    Args:
        drivers: calibrated drivers; local ones if the table has both modes.

    Raises:
        DataError: if the table is empty or lacks a column.
    """
    mode, table = next(iter(_modes(drivers).items()))
    speed, gap = (table[name].to_numpy(float) for name in ("desired_speed_mps", "time_gap_s"))
    bound = table["desired_speed_at_bound"].to_numpy(bool)
    colour = MODE_COLOURS.get(mode, INK)
    figure = new_figure(COLUMN_WIDTH, 3.6)
    spec = figure.add_gridspec(2, 2, width_ratios=(4, 1), height_ratios=(1, 4))
    centre = figure.add_subplot(spec[1, 0])
    top = figure.add_subplot(spec[0, 0], sharex=centre)
    side = figure.add_subplot(spec[1, 1], sharey=centre)
    _scatter(centre, speed, gap, bound, colour)
    figure.legend(loc="outside lower left", ncols=2)
    look: dict[str, Any] = {"bins": 24, "stacked": True, "color": [colour, "#c8c8c8"]}
    top.hist([speed[~bound], speed[bound]], **look)
    side.hist([gap[~bound], gap[bound]], orientation="horizontal", **look)
    top.tick_params(labelbottom=False)
    side.tick_params(labelleft=False)
    top.set_ylabel("drivers")
    side.set_xlabel("drivers")
    figure.suptitle(
        f"{len(table)} drivers, {mode} calibration; correlation of $v_0$ and $T$:\n"
        f"{_pearson(speed, gap)} of all, "
        f"{_pearson(speed[~bound], gap[~bound])} of those with $v_0$ inside its bounds"
    )
    return figure


@paper
def twins_figure(twins: pd.DataFrame) -> Figure:
    """Calibrated and recorded drivers behind the same leaders, a row per mode.

    Args:
        twins: measured table, see :class:`lcc_rl.drivers.calibrator.Calibration`.
    """
    modes = list(dict.fromkeys(twins["mode"]))
    figure = new_figure(PAGE_WIDTH, 0.3 + 2.2 * len(modes))
    for mode, row in zip(modes, np.atleast_2d(figure.subplots(len(modes), 3)), strict=True):
        part = twins[twins["mode"] == mode]
        found = {kind: part[part["driver"] == kind] for kind in dict.fromkeys(part["driver"])}
        spectra, share, gaps = row
        for kind, one in found.items():
            look: dict[str, Any] = {"color": DRIVER_COLOURS[kind], "label": kind}
            density = densities(one).mean()
            spectra.semilogy(density.index, density, **look)
            ordered = np.sort(one["gap_m"])
            gaps.plot(ordered, np.linspace(0.0, 1.0, len(ordered)), **look)
            if kind != RECORDED_DRIVERS:
                near = ratios(one, found[RECORDED_DRIVERS])
                places = [100.0 * (near[name] - 1.0) for name in RATIOS]
                share.plot(places, range(len(RATIOS)), "o", color=DRIVER_COLOURS[kind], label=kind)
        share.axvline(0.0, color=DRIVER_COLOURS[RECORDED_DRIVERS])
        share.set_yticks(range(len(RATIOS)), list(RATIOS.values()))
        share.set_ylim(len(RATIOS) - 0.5, -0.5)
        spectra.set(xlabel="frequency [Hz]", ylabel="spectral density [m²/s⁴/Hz]")
        share.set(xlabel="difference from recorded [%]")
        gaps.set(xlabel="mean gap [m]", ylabel="share of drivers")
        spectra.set_title(f"acceleration ({mode} calibration)")
        share.set_title("all drivers together")
        gaps.set_title("gaps")
        gaps.set_xlim(left=0.0)
        spectra.legend()
    return figure


def _models(drivers: pd.DataFrame) -> list[str]:
    return list(drivers[MODEL].unique()) if MODEL in drivers else [DEFAULT_MODEL]


def _modes(drivers: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Split the table by mode, local first."""
    table = parameters_of(_models(drivers))
    columns = [one.column for one in table.values()] + [f"{name}_at_bound" for name in table]
    missing = [name for name in ("mode", "rmspe", *columns) if name not in drivers]
    if missing:
        raise DataError(f"driver table: missing column(s) {', '.join(missing)}")
    if drivers.empty:
        raise DataError("driver table: no drivers to draw")
    order = sorted(drivers["mode"].unique(), key=lambda mode: (mode != "local", mode))
    return {str(mode): drivers[drivers["mode"] == mode] for mode in order}


def _boxes(axis: Axes, values: dict[str, pd.Series]) -> None:
    """Draw a box per mode, or a line for a constant parameter."""
    for place, (mode, series) in enumerate(values.items()):
        colour = MODE_COLOURS.get(mode, INK)
        numbers = series.to_numpy(float)
        if len(numbers) > 1 and np.ptp(numbers) == 0.0:
            axis.plot([place - 0.25, place + 0.25], numbers[[0, 0]], color=colour, linewidth=2)
            look: dict[str, Any] = {"ha": "center", "fontsize": 7, "color": colour}
            look |= {"xytext": (0, -10), "textcoords": "offset points"}  # the line may be on top
            axis.annotate(f"held at {numbers[0]:g}", (place, numbers[0]), **look)
            continue
        axis.boxplot(
            [numbers],
            positions=[place],
            widths=0.5,
            whis=(5, 95),
            showmeans=True,
            patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.35, "edgecolor": colour},
            medianprops={"color": colour, "linewidth": 2},
            meanprops={"marker": "D", "markerfacecolor": INK, "markeredgecolor": INK}
            | {"markersize": 3},
            whiskerprops={"color": colour},
            capprops={"color": colour},
            flierprops={"marker": ".", "markersize": 3, "markeredgecolor": SOFT},
        )
    labels = [f"{mode}\nn = {len(series)}" for mode, series in values.items()]
    axis.set_xticks(range(len(values)), labels)
    axis.set_xlim(-0.6, len(values) - 0.4)
    axis.set_ylim(bottom=0.0)


def _scatter(
    axis: Axes, speed: np.ndarray, gap: np.ndarray, bound: np.ndarray, colour: str
) -> None:
    """Draw a dot per driver, hollow if v0 lies on a bound."""
    known = ~bound
    hollow: dict[str, Any] = {"facecolors": "none", "edgecolors": SOFT, "linewidths": 0.8}
    label = f"$v_0$ inside its bounds ({known.sum()})"
    axis.scatter(speed[known], gap[known], 16, colour, alpha=0.6, linewidths=0, label=label)
    if bound.any():
        label = f"$v_0$ on a bound ({bound.sum()}, {100 * bound.mean():.0f} %)"
        axis.scatter(speed[bound], gap[bound], 16, clip_on=False, label=label, **hollow)
    axis.set(xlabel="desired speed $v_0$ [m/s]", ylabel="time gap $T$ [s]")
    axis.set_ylim(bottom=0.0)


def _pearson(first: np.ndarray, second: np.ndarray) -> str:
    if len(first) < 3 or first.std() == 0.0 or second.std() == 0.0:
        return "undefined"
    return signed(np.corrcoef(first, second)[0, 1], "{:.2f}")
