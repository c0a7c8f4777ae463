"""Space–time diagrams: where every vehicle of a string is, coloured by its speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from omegaconf import DictConfig

from lcc_rl.functional.pattern import AUTOMATED, parse_string
from lcc_rl.results.drawing import new_figure

FEWEST = 3  # vehicles; of fewer, speeds over time show all
EVERY = 5  # steps between the points of a line
WIDEST = 3  # panels
COLOURS = "RdYlGn"  # red stands, green drives


def space_time(steps: pd.DataFrame, names: Sequence[str], cfg: DictConfig) -> Figure | None:
    """Positions over time of one sample episode, a panel per strategy (the same episode).

    Positions follow from the gaps on an open road behind the leader; on a ring each vehicle's from
    its speed. Lines of automated vehicles are framed in black.

    Args:
        steps: rows of steps.parquet.
        names: the strategies to show, at most :data:`WIDEST`.
        cfg: the evaluation's configuration.

    Returns:
        The figure; None of strings with fewer than :data:`FEWEST` vehicles, or places drawn anew
        in every episode, whose order the rows do not tell.
    """
    if not isinstance(cfg.scenario.string, str):
        return None
    roles = parse_string(cfg.scenario.string).roles
    if len(roles) < FEWEST:
        return None
    first = steps.iloc[0]
    same = (steps["profile"] == first["profile"]) & (steps["driver_id"] == first["driver_id"])
    rows = {name: _one(steps[same & (steps["strategy"] == name)]) for name in names}
    # Of strategies that drive all of the string.
    rows = {name: part for name, part in rows.items() if len(part) and _drives(part, roles)}
    if not rows:
        return None
    names = list(rows)[:WIDEST]
    top = max(
        float(_columns(rows[name], _shown(rows[name], roles), "speed").max()) for name in names
    )
    figure = new_figure(1.5 + 4.0 * len(names), 4.2)
    axes = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
    lines: LineCollection | None = None
    for axis, name in zip(axes, names, strict=True):
        lines = _panel(axis, rows[name], roles, cfg, top)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel("time [s]")
    axes[0].set_ylabel("position [m]")
    assert lines is not None
    figure.colorbar(lines, ax=axes, label="speed [m/s]")
    return figure


def _one(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows of one training seed, every few steps."""
    seeds = rows["training_seed"]
    if seeds.notna().any():
        rows = rows[seeds == seeds.min()]
    return rows.iloc[::EVERY]


def _columns(rows: pd.DataFrame, roles: Sequence[str], entry: str) -> np.ndarray:
    """Return an entry of all vehicles from front to back, ``[time, vehicles]``."""
    return rows[_names(rows, roles, entry)].to_numpy(float)


def _drives(rows: pd.DataFrame, roles: Sequence[str]) -> bool:
    """Whether the rows have every vehicle of a string."""
    names = _names(rows, _shown(rows, roles), "speed")
    return set(names) <= set(rows) and bool(rows[names].notna().all(axis=None))


def _names(rows: pd.DataFrame, roles: Sequence[str], entry: str) -> list[str]:
    counts: dict[str, int] = {}
    found = []
    for role in roles:
        kind = "cav" if role == AUTOMATED else "hdv"
        counts[kind] = counts.get(kind, 0) + 1
        numbered = f"{kind}{counts[kind]}_{entry}"
        found.append(numbered if numbered in rows else f"{kind}_{entry}")
    return found


def _shown(rows: pd.DataFrame, roles: Sequence[str]) -> list[str]:
    """Return the roles as the rows have them: where a baseline drives, all may be human."""
    automated = any(str(name).startswith("cav") and rows[name].notna().any() for name in rows)
    return [role if automated else "human" for role in roles]


def _panel(
    axis: Axes, rows: pd.DataFrame, roles: Sequence[str], cfg: DictConfig, top: float
) -> LineCollection:
    """Draw the lines of all vehicles; return them for the scale of colours."""
    roles = _shown(rows, roles)
    time, speed = rows["time_s"].to_numpy(float), _columns(rows, roles, "speed")
    place = _positions(rows, roles, speed, time, cfg)
    around = cfg.scenario.get("circumference") if cfg.scenario.road == "ring" else None
    shown = place if around is None else place % float(around)
    for vehicle, role in enumerate(roles):
        points = np.stack([time, shown[:, vehicle]], -1)
        parts = np.stack([points[:-1], points[1:]], 1)
        whole = np.abs(parts[:, 1, 1] - parts[:, 0, 1]) < 0.5 * float(around or np.inf)
        if role == AUTOMATED:
            axis.add_collection(LineCollection(list(parts[whole]), colors="black", linewidths=2.6))
        lines = LineCollection(list(parts[whole]), cmap=COLOURS, linewidths=1.1)
        lines.set_array(speed[:-1, vehicle][whole])
        lines.set_clim(0.0, top)
        axis.add_collection(lines)
    axis.autoscale_view()
    return lines


def _positions(
    rows: pd.DataFrame, roles: Sequence[str], speed: np.ndarray, time: np.ndarray, cfg: DictConfig
) -> np.ndarray:
    """Return the front of every vehicle, ``[time, vehicles]`` [m]."""
    gap, length = _columns(rows, roles, "gap"), float(cfg.scenario.vehicle_length)
    behind = np.cumsum(gap + length, axis=1)
    step = np.diff(time, prepend=time[0])[:, None]
    if cfg.scenario.road == "ring":
        # Each by its own speed, from where it begins behind the first.
        start = -(behind[0] - behind[0, 0])
        return start + np.cumsum(speed * step, axis=0)
    leader = np.cumsum(rows["leader_speed"].to_numpy(float)[:, None] * step, axis=0)
    return leader - behind
