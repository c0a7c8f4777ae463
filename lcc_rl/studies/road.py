"""What automated cars would bring on a recorded road: lcc-rl reproduce road.

Drivers are calibrated to trajectories. Strings of them drive behind the recorded leaders, with
shares of automated cars and without any.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from lcc_rl.commands.evaluation import complete
from lcc_rl.commands.pipeline import TRAJECTORIES, calibrate_once, read_once
from lcc_rl.config import load, quoted, top_key, with_inputs
from lcc_rl.config.schemas import EvaluateConfig
from lcc_rl.figures.drawing import (
    PAGE_WIDTH,
    SOFT,
    colour,
    dots,
    grid,
    new_figure,
    paper,
    style,
)
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.files import parquet_metadata, read_parquet, write_parquet
from lcc_rl.results.bootstrap import LEAST_DRIVES, Estimate
from lcc_rl.results.measures import MEASURES
from lcc_rl.results.names import in_words, several
from lcc_rl.results.render import saved_text
from lcc_rl.results.report import windows_for
from lcc_rl.results.runs import EPISODES, stored_config
from lcc_rl.results.windows import DRIVE, savings
from lcc_rl.studies.alcc.study import DRIVERS_FILE
from lcc_rl.studies.results import StudyResults

ROAD_TITLE = "Automated cars on this road"
ROAD_SHARES = ("5", "10", "20")  # of automated cars [%]
# Drivers who keep up: a desired speed below that of the leaders would leave a string behind.
FITTED = (
    "data=platoons",
    "calibration=energy",
    "calibration.objective=both",
    "calibration.bounds.desired_speed=[45,50]",
)
DRIVEN = (
    "variant=alcc",
    "energy=compact",
    "scenario.string={size: 20, penetration: 0.05}",
    "scenario.horizon=3000",
    "evaluation={baselines: [human], behind_filter: [], warm_up: 20, profiles: 100, drivers: 4}",
    "evaluation.batch_size=128",
    "compare={network: pretrained/i24-mixed, idm_acc: idm_acc, "
    "ACC: {_target_: lcc_rl.pieces.LinearACC, desired_speed: 45}}",
)
LEADERS_FILE, WINDOW_RUNS = "leaders.parquet", "evaluation"
OF_DRIVE = " leader "  # between recording and leader in the name of a drive
LONGEST = 4000  # steps of a window at most
COMPARED = {
    "fuel_l_per_100km": "fuel [L/100 km]",
    "co2_g_per_km": "CO₂ [g/km]",
    "flow_vph": "flow [1/h]",
    "brakings_below_2_per_100km": "brakings < −2 m/s² [1/100 km]",
    "brakings_below_3_per_100km": "< −3 m/s²",
    "share_time_gap_short": "time gap < 1 s",
    "travel_time_s_per_km": "travel time [s/km]",
    "collisions": "collisions",
}
HUES = [colour(name) for name in ("idm_acc", "reference", "alcc", "own_energy", "human")]
DRAWN = ("fuel_l_per_100km", "flow_vph", "brakings_below_2_per_100km", "share_time_gap_short")


def run(folder: Path, overrides: Sequence[str], shares: Sequence[str] = ROAD_SHARES) -> None:
    """Calibrate drivers and evaluate every share; finished parts are skipped.

    Args:
        folder: the study's folder.
        overrides: options of ``lcc-rl calibrate`` (data, calibration) and ``lcc-rl evaluate``.
        shares: of automated cars [%].

    Raises:
        LccError: one clear error for wrong settings or files.
    """
    of_data = [item for item in overrides if top_key(item) in ("data", "calibration")]
    driven = [item for item in overrides if item not in of_data]
    cfg = load("pipeline", ["~experiment", *FITTED, *of_data])
    first, *_ = [_evaluation(driven, share) for share in shares]  # refused before data are read
    read_once(cfg, folder, learns=False)
    drives = leader_drives(read_parquet(folder / TRAJECTORIES), cfg.scenario.time_step)
    write_parquet(drives, folder / LEADERS_FILE)
    given, found = {top_key(item) for item in driven}, []
    if "leader" not in given:
        begun = round(first.evaluation.warm_up / cfg.scenario.time_step)
        steps = window_steps(drives.groupby("drive").size().to_numpy(), begun)
        found += ["leader=drives", f"leader.path={quoted(folder / LEADERS_FILE)}"]
        found += ["leader.evaluation_share=1", "leader.least_variation=0"]
        found += [f"leader.together='.*(?={OF_DRIVE})'", f"scenario.horizon={steps}"]
    if "drivers" not in given:
        path = calibrate_once(cfg, folder)
        found += ["drivers=calibrated", f"drivers.path={quoted(path)}"]
    for share in shares:
        complete(with_inputs(_evaluation([*found, *driven], share)), folder / WINDOW_RUNS / share)


def _evaluation(words: Sequence[str], share: str) -> EvaluateConfig:
    part = f"scenario.string.penetration={float(share) / 100.0:g}"
    cfg: EvaluateConfig = load("evaluate", [*DRIVEN, *words, part])
    return cfg


def leader_drives(episodes: pd.DataFrame, time_step: float) -> pd.DataFrame:
    """Return the drives of all leaders, each as long as it was seen, whoever followed.

    Args:
        episodes: the table of episodes.
        time_step: its step [s].

    Returns:
        Columns ``drive``, ``time_s`` and ``speed_mps``.
    """
    keys = ["recording", "leader_id"]
    rows = episodes.sort_values([*keys, "time_s"]).drop_duplicates([*keys, "time_s"])
    begins = ~(rows.groupby(keys)["time_s"].diff() < 1.5 * time_step)
    first = rows["time_s"].where(begins).ffill()
    names = rows["recording"] + OF_DRIVE + rows["leader_id"].astype(str)
    names += first.map(" from {:.1f} s".format)
    return pd.DataFrame(
        {"drive": names, "time_s": rows["time_s"], "speed_mps": rows["leader_speed_mps"]}
    )


def window_steps(samples: np.ndarray, begun: int) -> int:
    """Return the steps of the windows that count the most time of all drives.

    Args:
        samples: of every drive.
        begun: first steps of a window that do not count.
    """
    sizes = np.unique(np.minimum(samples, LONGEST + 1))
    counted = [(samples // size).sum() * (size - 1 - begun) for size in sizes]
    return int(sizes[np.argmax(counted)]) - 1


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write the study's table, its figure, and what was found in data and drivers.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    found = StudyResults(folder, formats)
    places = sorted((folder / WINDOW_RUNS).iterdir(), key=lambda place: float(place.name))
    parts = {place.name: windows_for(read_parquet(place / EPISODES)) for place in places}
    numbers = pd.DataFrame(row for share, part in parts.items() for row in compared(share, part))
    write_parquet(numbers, folder / "tables" / "numbers.parquet")
    cfg, windows = stored_config(places[0]), next(iter(parts.values()))
    found.table("road", caption_of(windows, cfg), table(numbers))
    found.figure(
        "road", "Changes against human drivers only, with the same intervals", drawn(numbers)
    )
    for name, file in (("Data", folder / TRAJECTORIES), ("Drivers", folder / DRIVERS_FILE)):
        if file.is_file():
            lines = parquet_metadata(file)["report"].splitlines()
            new = [f"* {line}" for line in lines if f"* {line}" not in "\n".join(found.blocks)]
            found.blocks.append("\n".join([f"## {name}\n", *new]))
    found.write(ROAD_TITLE)
    return found


def compared(share: str, windows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield each measure of each strategy beside that of human drivers only.

    Args:
        share: of automated cars [%].
        windows: of :func:`lcc_rl.results.report.windows_for`.

    Returns:
        Rows of ``share_pct``, ``strategy``, ``measure``, ``value`` and ``change_pct`` with the
        bounds of the interval: over drives, of two to four a t-interval, of one over windows.
    """
    known = {one.key: one for one in MEASURES}
    for name, part in windows.groupby("strategy", sort=False):
        for key in COMPARED:
            column, *per = known[key].columns
            found = savings(windows, column, str(name), HUMAN, per)
            low, high = found.over_drives or (found.low, found.high)
            change = Estimate(-found.value, -high, -low).columns("change_pct", 100.0)
            row = {"share_pct": float(share), "strategy": name, "measure": key}
            yield row | {"value": known[key].value(part)} | change


def table(numbers: pd.DataFrame) -> pd.DataFrame:
    """Return a row per share and strategy: measures as text, with their changes below."""
    forms, rows = {one.key: one.form for one in MEASURES}, []
    for (share, name), part in numbers.groupby(["share_pct", "strategy"], sort=False):
        row = {"automated": f"{share:g} %", "driven by": in_words(str(name))}
        for one in part.to_dict("records"):
            key, change = one["measure"], one["change_pct"]
            text = forms[key].format(one["value"])
            if name != HUMAN and np.isfinite(change):
                bounds = (one["change_pct_low"], one["change_pct_high"])
                text += f"<br>{saved_text(change, *bounds)}"
            row[COMPARED[key]] = text
        rows.append(row)
    return pd.DataFrame(rows)


def caption_of(windows: pd.DataFrame, cfg: Mapping[str, Any]) -> str:
    """Return what the table is of, and what its intervals are over."""
    count, settings, scenario = windows[DRIVE].nunique(), cfg["evaluation"], cfg["scenario"]
    seconds = scenario["horizon"] * scenario["time_step"]
    over = f"{count} recordings" + " (too few for a bootstrap: t-intervals)" * (
        count < LEAST_DRIVES
    )
    over = (
        over if count > 1 else "windows: of one recording, too few to tell what others would give"
    )
    return (
        f"{scenario['string']['size']} vehicles behind each of "
        f"{several(windows['profile_id'].nunique(), 'window')} of {seconds:g} s × "
        f"{settings['drivers']} drivers, without the first {settings['warm_up']:g} s. Below each "
        "value: its change against human drivers only [%], with the 95 % interval over " + over
    )


@paper
def drawn(numbers: pd.DataFrame) -> Figure:
    """Draw the changes of some measures over the share, a colour per strategy."""
    figure = new_figure(PAGE_WIDTH, 2.6)
    names = [name for name in dict.fromkeys(numbers["strategy"]) if name != HUMAN]
    shares = sorted(numbers["share_pct"].unique())
    for axis, key in zip(figure.subplots(1, len(DRAWN)), DRAWN, strict=True):
        axis.axhline(0.0, color=SOFT, lw=0.8)
        for place, (name, hue) in enumerate(zip(names, cycle(HUES), strict=False)):
            of = (numbers["strategy"] == name) & (numbers["measure"] == key)
            at = np.arange(len(shares)) + 0.2 * (place - (len(names) - 1) / 2)
            part = numbers[of].sort_values("share_pct")
            dots(axis, at, part, "change_pct", hue, upright=True, label=in_words(str(name)))
        axis.set_xticks(range(len(shares)), [f"{share:g} %" for share in shares])
        axis.set_title(COMPARED[key].partition(" [")[0])
        grid(axis, "y")
        style(axis, "automated", "change [%]" * (key == DRAWN[0]))
    handles, labels = axis.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(names), frameon=False)
    return figure
