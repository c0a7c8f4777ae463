"""Calibration errors by length and speed of the episodes, and by settings, as one table.

    python tools/compare_lengths.py data=ngsim data.path=trajectories.csv.gz
    python tools/compare_lengths.py    # from what is kept

Rows, one per episode, mode and condition, go to outputs/reference/calibration.parquet, the figure
to docs/figures/calibration.png.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig

from lcc_rl.config import CALLED, build_as, load
from lcc_rl.drivers.calibrator import Calibrator
from lcc_rl.drivers.observed import observe
from lcc_rl.drivers.parameters import COLUMNS
from lcc_rl.envs.inputs import build_source
from lcc_rl.figures.calibration import COLOURS
from lcc_rl.figures.drawing import INK, new_figure, save, unbox
from lcc_rl.functional.idm import IDMConstants, simulate_follower
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.intervals import bounds, weights
from lcc_rl.runs.cli import main_guard

KEPT, FIGURE = Path("outputs/reference/calibration.parquet"), Path("docs/figures/calibration.png")
BASE, ALONE = "first 60 s", "one at a time"
SECONDS = (15, 20, 30, 40, 50)
SLOWEST = 1.0  # speed below which the error relative to each sample is left out [m/s]
FAST = 8.0  # mean speed above which an episode is no jam [m/s]
PAPER = {"global": (6.0, 16.8), "local": (6.7, 5.5)}  # RMSPE [%], seconds per episode
SELECT, SEARCH = "calibration.selection", "calibration.{}_genetic.{}={}"
CONDITIONS = {
    BASE: [],
    **{f"first {x} s": [f"{SELECT}.max_duration_s={x}"] for x in SECONDS},
    "whole episodes": [f"{SELECT}.max_duration_s=null"],
    "gaps below 1 m, too": [f"{SELECT}.min_gap_m=0"],
    "v0 up to 30 m/s": ["calibration.bounds.desired_speed=[5,30]"],
    "v0 up to 60 m/s": ["calibration.bounds.desired_speed=[5,60]"],
    "a, b, s0 chosen over all": ["calibration.choose_constants=true"],
    "search of twice the size": [
        SEARCH.format(*x)
        for x in (
            *(("local", "population", 64), ("local", "generations", 40)),
            *(("global", "population", 128), ("global", "generations", 120)),
        )
    ],
    "positions smoothed over 1.5 s": [
        "data.smoothing={_target_:lcc_rl.data.smoothing.SavitzkyGolay,window_s:1.5}"
    ],
}
PIECES = {**{f"pieces of {x} s": (x, x) for x in SECONDS}, "pieces of 15 to 50 s": (15, 50)}
SPLIT = (BASE, "first 15 s", "first 30 s", "pieces of 15 s", "pieces of 15 to 50 s")
COLUMNS_KEPT = (
    *("condition", "mode", "recording", "follower_id", "episode", "samples", "mean_speed_mps"),
    *("rmspe", "desired_speed_mps", "time_gap_s", "desired_speed_at_bound", "milliseconds"),
    *("rms_speed_mps", "absolute", "per_sample"),
)
HEAD = ("episodes", "RMSPE, local [%]", "global [%]", "difference", "correlation of (v0, T)")


def pieces(episodes: pd.DataFrame, shortest: float, longest: float) -> pd.DataFrame:
    """Cut every episode into consecutive ones; an end too short is left out.

    Args:
        episodes: the episodes.
        shortest, longest: durations are drawn evenly between these, the same in every call [s].
    """
    generator = np.random.default_rng(0)
    parts: list[pd.DataFrame] = []
    for _, episode in episodes.groupby("episode", sort=True):
        time = episode["time_s"].to_numpy()
        begin = time[0]
        while time[-1] - begin >= (duration := generator.uniform(shortest, longest)) - 1e-6:
            inside = (time >= begin - 1e-6) & (time <= begin + duration + 1e-6)
            parts.append(episode[inside].assign(episode=len(parts)))
            begin = time[inside][-1]
    return pd.concat(parts, ignore_index=True)


def calibrated(cfg: DictConfig, episodes: pd.DataFrame, condition: str) -> pd.DataFrame:
    """Calibrate all episodes in both modes; one row per episode and mode."""
    calibrator = build_as("a calibrator", CALLED, cfg.calibration, "calibration")
    parts = []
    for mode in cfg.calibration.modes:
        start = process_time()
        drivers = replace(calibrator, modes=[mode])(episodes, seed=cfg.seed).drivers
        spent = process_time() - start
        parts.append(drivers.assign(milliseconds=1000.0 * spent / len(drivers)))
    rows = pd.concat([other_errors(part, episodes, calibrator) for part in parts])
    return rows.assign(condition=condition)


def other_errors(
    drivers: pd.DataFrame, episodes: pd.DataFrame, calibrator: Calibrator
) -> pd.DataFrame:
    """Add speeds, and the errors that others than A6 would report of the same parameters."""
    observed = observe(episodes, calibrator.selection)
    rows = drivers.set_index("episode").loc[observed.identity["episode"]].reset_index()
    own = {name: torch.tensor(rows[column]) for name, column in COLUMNS.items() if column in rows}
    speed, time_gap = own.pop("desired_speed"), own.pop("time_gap")
    truth = observed.follower_speed
    driven, _, _ = simulate_follower(
        *(observed.leader_speed, truth[0], observed.gap, speed, time_gap),
        *(IDMConstants().with_(**own), observed.time_step),
    )
    inside = torch.arange(len(truth)).unsqueeze(-1) < torch.tensor(observed.samples)
    error, moving = (driven - truth) * inside, inside & (truth >= SLOWEST)
    share = torch.where(moving, error / truth, 0.0).square().sum(0) / moving.sum(0)
    columns = {
        "absolute": error.abs().sum(0) / truth.sum(0),
        "per_sample": share.sqrt(),
        "mean_speed_mps": truth.sum(0) / inside.sum(0),
        "rms_speed_mps": (truth.square().sum(0) / inside.sum(0)).sqrt(),
    }
    return rows.assign(**{name: values.numpy() for name, values in columns.items()})


def measure(overrides: Sequence[str]) -> pd.DataFrame:
    """Calibrate under every condition.

    Args:
        overrides: options of ``lcc-rl calibrate``.
    """
    words = ["calibration=both", *overrides]
    cfg = load("calibrate", words)
    episodes = build_source(cfg.data).load().episodes
    few = [episode for _, episode in islice(episodes.groupby("episode", sort=True), 20)]
    calibrated(cfg, pd.concat(few), "")  # compiles
    parts = []
    for name, more in CONDITIONS.items():
        own = load("calibrate", [*words, *more])
        again = build_source(own.data).load().episodes if own.data != cfg.data else episodes
        parts.append(calibrated(own, again, name))
    kept = episodes[episodes["episode"].isin(parts[0]["episode"])]
    parts += [calibrated(cfg, pieces(kept, *x), name) for name, x in PIECES.items()]
    parts += [calibrated(cfg, x, ALONE) for x in few if x["episode"].isin(kept["episode"]).all()]
    rows = pd.concat(parts, ignore_index=True)[list(COLUMNS_KEPT)]
    rows.loc[rows["condition"] != BASE, ["absolute", "per_sample"]] = np.nan
    numbers = list(rows.select_dtypes("float64"))
    return rows.astype(dict.fromkeys(numbers, "float32")).round(dict.fromkeys(numbers, 4))


def compared(rows: pd.DataFrame) -> dict[str, tuple[float, float, float]]:
    """Return errors [%] and correlation of one condition, each with its interval.

    The interval is a bootstrap over drivers: the pieces of one stay together.
    """
    local, other = (rows[rows["mode"] == mode].set_index("episode") for mode in ("local", "global"))
    x, y = (local[name].astype(float) for name in ("desired_speed_mps", "time_gap_s"))
    sums = pd.DataFrame(
        {"n": 1.0, "local": 100.0 * local["rmspe"], "global": 100.0 * other["rmspe"]}
        | {"x": x, "y": y, "xx": x * x, "yy": y * y, "xy": x * y}
    )
    by_driver = sums.groupby([local["recording"], local["follower_id"]], observed=True).sum()
    totals = by_driver.to_numpy()
    values, resampled = (_statistics(x) for x in (totals.sum(0), weights(len(totals), 0) @ totals))
    return {name: (float(x), *bounds(resampled[name])) for name, x in values.items()}


def _statistics(totals: np.ndarray) -> dict[str, np.ndarray]:
    """Means and correlation from sums over episodes."""
    n, local, other, x, y, xx, yy, xy = np.moveaxis(totals, -1, 0)
    spread = np.sqrt((n * xx - x * x) * (n * yy - y * y))
    with np.errstate(invalid="ignore"):  # undefined where all v0 or all T are equal
        correlation = (n * xy - x * y) / spread
    means = {"local": local / n, "global": other / n, "difference": (local - other) / n}
    return means | {"correlation": correlation}


def table(rows: pd.DataFrame) -> str:
    """Return the conditions as a Markdown table, with intervals over drivers."""
    shown = rows[rows["condition"] != ALONE]
    parts = {str(name): part for name, part in shown.groupby("condition", sort=False)}
    fast = {x: parts[x][parts[x]["mean_speed_mps"] >= FAST] for x in SPLIT if x in parts}
    parts |= {f"{name}, {FAST:g} m/s or more": part for name, part in fast.items() if len(part)}
    lines = ["| | " + " | ".join(HEAD) + " |", "|---" * (1 + len(HEAD)) + "|"]
    for name, part in parts.items():
        found = [f"{x:.2f} ({low:.2f} … {high:.2f})" for x, low, high in compared(part).values()]
        lines.append(" | ".join([f"| {name}", str(len(part) // 2), *found]) + " |")
    return "\n".join(lines).replace("-0", "−0")


def others(rows: pd.DataFrame) -> str:
    """Return other error definitions, thirds by speed, and computing times, in lines."""
    lines = []
    for mode, part in rows[rows["condition"] == BASE].groupby("mode", sort=False):
        square = part["rms_speed_mps"] ** 2 * part["samples"]
        shares = {
            "A6": part["rmspe"].mean(),
            "its median": part["rmspe"].median(),
            "A6 of all samples at once": ((part["rmspe"] ** 2 * square).sum() / square.sum())
            ** 0.5,
            "Σ|e|/Σv": part["absolute"].mean(),
            f"e/v of samples above {SLOWEST:g} m/s": part["per_sample"].mean(),
            "v0 on a bound": part["desired_speed_at_bound"].mean(),
        }
        lines.append(f"{mode}: " + ", ".join(f"{k} {100 * x:.2f} %" for k, x in shares.items()))
        error = 100.0 * part["rmspe"], part["rmspe"] * part["rms_speed_mps"]
        third = pd.qcut(part["mean_speed_mps"], 3)
        means = pd.concat(error, axis=1).groupby(third, observed=True).mean()
        for speeds, share, metres in means.itertuples():
            lines.append(f"  up to {speeds.right:.1f} m/s: {share:.2f} %, {metres:.2f} m/s")
    times = rows[rows["condition"].isin([BASE, ALONE])].groupby(["condition", "mode"], sort=False)
    for name, mode, spent in times["milliseconds"].mean().reset_index().itertuples(index=False):
        lines.append(f"{name}, {mode}: {spent:.1f} ms per driver")
    return "\n".join(lines)


def figure_of_lengths(rows: pd.DataFrame) -> Figure:
    """Draw errors by length and speed, and computing times, beside the paper's (Fig. 4)."""
    figure = new_figure(9.0, 3.4)
    by_length, by_speed, time = figure.subplots(1, 3, width_ratios=(4, 4, 3))
    base = rows[rows["condition"] == BASE]
    fifth = pd.qcut(base["mean_speed_mps"], 5)
    lengths = {float(x): rows[rows["condition"] == f"pieces of {x} s"] for x in SECONDS}
    speeds = {float(x["mean_speed_mps"].mean()): x for _, x in base.groupby(fifth, observed=True)}
    for mode, marker in (("local", "o"), ("global", "s")):
        style = {"color": COLOURS[mode], "marker": marker, "label": mode}
        for axis, parts in ((by_length, lengths), (by_speed, speeds)):
            value, low, high = np.array([compared(part)[mode] for part in parts.values()]).T
            axis.fill_between(list(parts), low, high, color=COLOURS[mode], alpha=0.2, lw=0)
            axis.plot(list(parts), value, **style)
            axis.axhline(PAPER[mode][0], color=COLOURS[mode], ls=":", label=f"{mode}, paper")
            axis.set_ylim(0.0, 14.0)
        known = rows[rows["mode"] == mode].groupby("condition")["milliseconds"].mean()
        time.plot([1000.0 * PAPER[mode][1], known[ALONE], known[BASE]], range(3), ls="", **style)
    by_length.set(xlabel="length of the pieces [s]", ylabel="mean RMSPE [%]")
    by_speed.set(xlabel="mean speed, first 60 s [m/s]")
    time.set_yticks(range(3), ["paper", "here, one\nat a time", "here, all\nat once"])
    time.set(xscale="log", xlabel="computing time\nper driver [ms]", ylim=(2.5, -0.5))
    for axis in (by_length, by_speed, time):
        axis.tick_params(colors=INK, labelsize=9)
        unbox(axis)
    handles, names = by_length.get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    return figure


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    formatter = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=formatter)
    parser.add_argument("overrides", nargs="*", help="options of lcc-rl calibrate; none: as kept")
    parser.add_argument("--rows", type=Path, default=KEPT, help="parquet file of the rows")
    parser.add_argument("--figure", type=Path, default=FIGURE, help="image")
    options = parser.parse_args(arguments)
    if options.overrides:
        write_parquet(measure(options.overrides), options.rows)
    rows = read_parquet(options.rows)
    print(table(rows), others(rows), sep="\n\n")
    print(save(figure_of_lengths(rows), options.figure))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
