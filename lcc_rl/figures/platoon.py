"""Figures of a platoon over time: leader, speeds, jerks and switching (HCFS Figs. 3–12)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lcc_rl.data.leaders import Case
from lcc_rl.data.profiles import Profiles
from lcc_rl.figures.drawing import INK, PAGE_WIDTH, footnote, legend_above, new_figure, paper
from lcc_rl.results.motion import of_first_seed
from lcc_rl.results.names import in_words

# Strategies with a panel, beside those of the user.
PANEL_STRATEGIES = ("cacc paper_like", "cacc tuned", "cacc", "ddpg", "hcfs")
NEAR_COLOUR, FAR_COLOUR = np.array([0.0, 0.45, 0.70]), np.array([0.90, 0.62, 0.0])
BOUND = "#b00020"
PAPER_SPEEDS = {"case 1": (0.37, 10.76)}  # first and last speed in the paper [m/s]
WINNER_COLOURS = {"rule": "#e8e8e8", "policy": "#0072b2"}  # by the value of the column "winner"
WHO_DRIVES = ListedColormap(list(WINNER_COLOURS.values()))


def platoon_figures(steps: pd.DataFrame, bound: float) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every case, of trained strategies with their first seed.

    Args:
        steps: rows of steps.parquet.
        bound: bound of the jerk [m/s³].
    """
    steps = of_first_seed(steps)
    for case in dict.fromkeys(steps["case"]) if len(steps) else ():
        yield f"{case} velocities", velocities(steps, case)
        yield f"{case} jerk", jerks(steps, case, bound)
        driven = steps.dropna(subset=["winner"]) if "winner" in steps else steps[:0]
        for strategy in dict.fromkeys(driven["strategy"]):
            yield f"{case} switching {strategy}", switching(steps, case, strategy)


@paper
def record_figure(record: Profiles, from_s: float, cases: Sequence[Case]) -> Figure:
    """Draw the leader's record with the part for training, and the cases' windows (Fig. 3).

    Args:
        record: the whole record of the training.
        from_s: start of the training's part [s].
        cases: the windows of tests.
    """
    figure = new_figure(PAGE_WIDTH, 3.6)
    grid = figure.subplot_mosaic([["record"] * len(cases), [case.name for case in cases]])
    axis, windows = grid.pop("record"), list(grid.values())
    seconds = _speeds(axis, record)
    axis.axvspan(from_s, seconds[-1], color=WINNER_COLOURS["policy"], alpha=0.15, lw=0)
    axis.set_title(f"{_in_record(record)}; blue: training")
    for window, case in zip(windows, cases, strict=True):
        ends = _speeds(window, case.profile)[[0, -1]]
        window.set_ylim(-0.5, 13.0)
        window.set_title(f"{case.name}\n{_in_record(case.profile)}")
        if case.name in PAPER_SPEEDS:
            window.plot(
                ends,
                PAPER_SPEEDS[case.name],
                "o",
                color=BOUND,
                label="first and last speed\nin the paper",
                clip_on=False,
            )
            window.legend(loc="upper left")
    for left in (axis, windows[0]):
        left.set_ylabel("speed [m/s]")
    return figure


def _speeds(axis: Axes, profile: Profiles) -> np.ndarray:
    """Draw a record over time; return its times [s]."""
    seconds = profile.time_step * np.arange(int(profile.lengths[0]))
    axis.plot(seconds, profile.record(0).numpy(), color=INK)
    axis.set_xlabel("time [s]")
    axis.margins(x=0.01)
    return seconds


def _in_record(profile: Profiles) -> str:
    """Return a profile's record and its start in the record."""
    record, _, start = profile.names[0].partition("@")
    name = record.replace("_", " ").upper()
    return name if start == "0s" else f"{name} from {start.removesuffix('s')} s on"


@paper
def velocities(steps: pd.DataFrame, case: str) -> Figure:
    """Speeds of leader and followers, a panel per strategy (Figs. 4, 7, 10)."""
    figure, panels = _panels(steps[steps["case"] == case], case, "speed [m/s]")
    for axis, rows in panels:
        leader = rows[rows["follower"] == 0]
        _lines(axis, rows, "speed_mps")
        axis.plot(leader["time_s"], leader["speed_mps"], color=INK, ls="--", label="leader")
    legend_above(panels[0][0])
    return figure


@paper
def jerks(steps: pd.DataFrame, case: str, bound: float) -> Figure:
    """Jerk of the followers, a panel per strategy, with the bound where it is near.

    Each panel is scaled to its data (Figs. 5, 8, 11).
    """
    figure, panels = _panels(steps[steps["case"] == case], case, "jerk [m/s³]", sharey=False)
    for axis, rows in panels:
        _lines(axis, rows, "jerk_mps3")
        top = max(float(rows["jerk_mps3"].abs().max()), 0.1)
        for side in (-bound, bound) if top > 0.5 * bound else ():
            axis.axhline(side, color=BOUND, lw=0.8, ls=":")
            top = max(top, bound)
        axis.set_ylim(-1.1 * top, 1.1 * top)
    legend_above(panels[0][0])
    footnote(figure, f"scales differ; dotted: bound of ±{bound:g} m/s³, where a jerk is near it")
    return figure


def shown(steps: pd.DataFrame) -> list[str]:
    """Return the user's strategies in a table and those of :data:`PANEL_STRATEGIES`, or all."""
    names = list(dict.fromkeys(steps["strategy"]))
    own = [name for name in names if in_words(name) == name]
    return [name for name in (*PANEL_STRATEGIES, *own) if name in names] or names


def _panels(
    rows: pd.DataFrame, case: str, label: str, sharey: bool = True
) -> tuple[Figure, list[tuple[Axes, pd.DataFrame]]]:
    """Return a figure with a panel per strategy, and the panels with their rows."""
    names = shown(rows)
    figure = new_figure(PAGE_WIDTH, 0.8 + 1.3 * len(names))
    axes = figure.subplots(len(names), 1, sharex=True, sharey=sharey, squeeze=False)[:, 0]
    for axis, name in zip(axes, names, strict=True):
        axis.set_title(f"{case}: {in_words(name)}", loc="right")
        axis.set_ylabel(label)
    axes[-1].set_xlabel("time [s]")
    parts = (rows[rows["strategy"] == name] for name in names)
    return figure, list(zip(axes, parts, strict=True))


def _lines(axis: Axes, rows: pd.DataFrame, column: str) -> None:
    """Draw a line per follower, from blue (the first) to orange (the last)."""
    followers = int(rows["follower"].max())
    for follower in range(1, followers + 1):
        own = rows[rows["follower"] == follower]
        label = f"follower {follower}" if follower in (1, followers) else None
        share = (follower - 1) / max(followers - 1, 1)
        hue = tuple((1.0 - share) * NEAR_COLOUR + share * FAR_COLOUR)
        axis.plot(own["time_s"], own[column], color=hue, label=label)


@paper
def switching(steps: pd.DataFrame, case: str, strategy: str = "hcfs") -> Figure:
    """Candidate in use for each follower over time, rule or policy (Figs. 6, 9, 12).

    Args:
        steps: rows of steps.parquet; ``winner`` is 0 for the rule and 1 for the policy.
        case: name of the case.
        strategy: name of a hybrid strategy.
    """
    rows = steps[(steps["case"] == case) & (steps["strategy"] == strategy)]
    rows = rows[rows["follower"] > 0]
    raster = rows.pivot_table(index="follower", columns="time_s", values="winner")
    figure = new_figure(PAGE_WIDTH, 0.9 + 0.16 * len(raster))
    axis = figure.subplots()
    step = float(raster.columns[0])
    edges = np.append(raster.columns.to_numpy(float) - step, raster.columns[-1])
    rims = np.arange(len(raster) + 1) + 0.5
    axis.pcolormesh(edges, rims, raster.to_numpy(), cmap=WHO_DRIVES, vmin=0.0, vmax=1.0)
    for name, hue in WINNER_COLOURS.items():
        axis.plot([], [], "s", color=hue, label=name)
    axis.set_yticks(raster.index)
    axis.set(xlabel="time [s]", ylabel="follower")
    axis.grid(visible=False)
    share = float(np.nanmean(raster.to_numpy()))
    title = f"{case}: {in_words(strategy)} (policy {100 * share:.0f} %)"
    axis.set_title(title, loc="right")
    legend_above(axis)
    return figure
