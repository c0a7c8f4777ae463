"""A platoon over time: its leader's record, speeds, jerks and switching (HCFS Figs. 3–12)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from lcc_rl.data.leaders import Case
from lcc_rl.data.profiles import Profiles
from lcc_rl.io.files import read_parquet
from lcc_rl.results.drawing import INK, in_file, in_words, legend_above, new_figure, save, unbox
from lcc_rl.results.runs import stored_config

SHOWN = ("cacc paper_like", "cacc tuned", "cacc", "ddpg", "hcfs")  # strategies with a panel
NEAR, FAR = np.array([0.0, 0.45, 0.70]), np.array([0.90, 0.62, 0.0])
BOUND = "#b00020"
PAPER = {"case 1": (0.37, 10.76)}  # first and last speed in the paper [m/s]
PARENTS = {"CACC": "#e8e8e8", "DDPG": "#0072b2"}  # by the value of the column "winner"


def hue(follower: int, followers: int) -> tuple[float, ...]:
    """Return the colour of a follower, from blue (the first) to orange (the last)."""
    share = (follower - 1) / max(followers - 1, 1)
    return tuple((1.0 - share) * NEAR + share * FAR)


def shown(steps: pd.DataFrame) -> list[str]:
    """Return the strategies of :data:`SHOWN` that there are; all where there is none of them."""
    names = list(dict.fromkeys(steps["strategy"]))
    return [name for name in SHOWN if name in names] or names


def _panels(steps: pd.DataFrame, names: list[str], title: str) -> tuple[Figure, list[Axes]]:
    figure = new_figure(8.0, 1.2 + 2.0 * len(names))
    axes = list(np.atleast_1d(figure.subplots(len(names), 1, sharex=True, sharey=True)))
    for axis, name in zip(axes, names, strict=True):
        axis.set_title(in_words(name), fontsize=10, loc="right")
        unbox(axis)
    axes[-1].set_xlabel("time [s]")
    figure.suptitle(title, fontsize=11)
    return figure, axes


def _lines(axis: Axes, rows: pd.DataFrame, column: str) -> None:
    followers = int(rows["follower"].max())
    for follower in range(1, followers + 1):
        own = rows[rows["follower"] == follower]
        label = f"follower {follower}" if follower in (1, followers) else None
        colour = hue(follower, followers)
        axis.plot(own["time_s"], own[column], color=colour, lw=1.0, label=label)


def record_figure(record: Profiles, from_s: float, cases: Sequence[Case]) -> Figure:
    """Draw the leader's record with the part for training, and the cases' windows (Fig. 3).

    Args:
        record: the record that the training takes a part of, whole.
        from_s: where that part begins [s].
        cases: the windows for tests.
    """
    figure = new_figure(7.2, 4.6)
    grid = figure.subplot_mosaic([["record"] * len(cases), [case.name for case in cases]])
    axis, windows = grid.pop("record"), list(grid.values())
    _speeds(axis, record)
    axis.axvspan(
        from_s, _seconds(record)[-1], color=PARENTS["DDPG"], alpha=0.15, lw=0, label="training"
    )
    axis.set_title(_in_record(record), fontsize=10, loc="right")
    legend_above(axis)
    for window, case in zip(windows, cases, strict=True):
        _speeds(window, case.profile)
        window.set_ylim(-0.5, 13.0)
        window.set_title(f"{case.name}\n{_in_record(case.profile)}", fontsize=10)
        if case.name in PAPER:
            ends = _seconds(case.profile)[[0, -1]]
            window.plot(ends, PAPER[case.name], "o", color=BOUND, label="paper", clip_on=False)
            window.legend(frameon=False, fontsize=8, loc="upper left")
    for left in (axis, windows[0]):
        left.set_ylabel("speed [m/s]")
    return figure


def _speeds(axis: Axes, profile: Profiles) -> None:
    axis.plot(_seconds(profile), profile.record(0).numpy(), color=INK, lw=1.0)
    axis.set_xlabel("time [s]")
    axis.margins(x=0.01)
    unbox(axis)


def _seconds(profile: Profiles) -> np.ndarray:
    return profile.time_step * np.arange(int(profile.lengths[0]))


def _in_record(profile: Profiles) -> str:
    """Return a profile's record, and where in it the profile begins."""
    record, _, start = profile.names[0].partition("@")
    name = in_words(record).upper()
    return name if start == "0s" else f"{name} from {in_words(start)} on"


def velocities(steps: pd.DataFrame, case: str) -> Figure:
    """Speeds of leader and followers, a panel per strategy (Figs. 4, 7, 10)."""
    rows = steps[steps["case"] == case]
    figure, axes = _panels(rows, shown(rows), f"{case}: speed [m/s]")
    for axis, name in zip(axes, shown(rows), strict=True):
        own = rows[rows["strategy"] == name]
        leader = own[own["follower"] == 0]
        _lines(axis, own, "speed_mps")
        axis.plot(leader["time_s"], leader["speed_mps"], color=INK, ls="--", label="leader")
    legend_above(axes[0])
    return figure


def jerks(steps: pd.DataFrame, case: str, bound: float) -> Figure:
    """Jerk of the followers, a panel per strategy, and its bound where they come near it.

    The scale is that of the data (Figs. 5, 8, 11).
    """
    rows = steps[steps["case"] == case]
    own = rows[rows["strategy"].isin(shown(rows)) & (rows["follower"] > 0)]
    top = 1.1 * max(float(own["jerk_mps3"].abs().max()), 0.1)
    near = top > 0.5 * bound
    where = f"dotted: bound ±{bound:g}" if near else f"bound ±{bound:g}, beyond the scale"
    figure, axes = _panels(rows, shown(rows), f"{case}: jerk [m/s³]; {where}")
    for axis, name in zip(axes, shown(rows), strict=True):
        _lines(axis, rows[rows["strategy"] == name], "jerk_mps3")
        for side in (-bound, bound) if near else ():
            axis.axhline(side, color=BOUND, lw=0.8, ls=":")
    scale = max(top, 1.1 * bound) if near else top
    axes[0].set_ylim(-scale, scale)
    legend_above(axes[0])
    return figure


def switching(steps: pd.DataFrame, case: str, strategy: str = "hcfs") -> Figure:
    """The controller that drives each follower over time, CACC or DDPG (Figs. 6, 9, 12).

    Args:
        steps: rows of steps.parquet; ``winner`` is 0 for CACC and 1 for DDPG.
        case: name of the case.
        strategy: name of a hybrid strategy.
    """
    rows = steps[(steps["case"] == case) & (steps["strategy"] == strategy)]
    rows = rows[rows["follower"] > 0]
    raster = rows.pivot_table(index="follower", columns="time_s", values="winner")
    figure = new_figure(8.0, 1.4 + 0.25 * len(raster))
    axis = figure.subplots()
    step = float(raster.columns[0])
    edges = np.append(raster.columns.to_numpy(float) - step, raster.columns[-1])
    rims = np.arange(len(raster) + 1) + 0.5
    colours = ListedColormap(list(PARENTS.values()))
    axis.pcolormesh(edges, rims, raster.to_numpy(), cmap=colours, vmin=0.0, vmax=1.0)
    for name, colour in PARENTS.items():
        axis.plot([], [], "s", color=colour, label=name)
    axis.set_yticks(raster.index)
    axis.set_xlabel("time [s]")
    axis.set_ylabel("follower")
    unbox(axis)
    share = float(np.nanmean(raster.to_numpy()))
    title = f"{case}: who drives in {in_words(strategy)} (DDPG {100 * share:.0f} %)"
    axis.set_title(title, fontsize=10, loc="right")
    legend_above(axis)
    return figure


def write_platoon_figures(folder: str | Path, target: Path | None = None) -> list[Path]:
    """Draw the figures of every case of an evaluation.

    Args:
        folder: holds config.yaml and steps.parquet.
        target: folder of the figures; ``figures`` in the first one by default.

    Returns:
        The figures' paths.

    Raises:
        ResultsError: if a table is missing or a figure cannot be written.
    """
    folder = Path(folder)
    steps, target = read_parquet(folder / "steps.parquet"), target or folder / "figures"
    if steps.empty:
        return []
    cfg = stored_config(folder)
    bound = float((cfg.get("deployed") or {}).get("jerk_bound", 30.0))
    found = platoon_figures(steps, bound)
    return [
        save(figure, target / f"{in_file(stem)}.png", formats=cfg.get("figure_formats", ()))
        for stem, figure in found
    ]


def platoon_figures(steps: pd.DataFrame, bound: float) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every case.

    Args:
        steps: rows of steps.parquet.
        bound: of the jerk [m/s³].
    """
    for case in dict.fromkeys(steps["case"]):
        yield f"{case} velocities", velocities(steps, case)
        yield f"{case} jerk", jerks(steps, case, bound)
        for strategy in ("hcfs", "hcfs oracle"):
            if (steps["strategy"] == strategy).any():
                yield f"{case} switching {strategy}", switching(steps, case, strategy)
