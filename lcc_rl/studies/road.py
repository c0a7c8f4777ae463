"""Effect of automated cars on a recorded road: lcc-rl reproduce road.

Drivers are calibrated to trajectories. Strings of them drive behind the recorded leaders, with
and without automated cars.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd

from lcc_rl.commands.evaluation import complete
from lcc_rl.commands.pipeline import TRAJECTORIES, calibrate_once, read_once
from lcc_rl.config.compose import NOT_IDENTITY, load, with_inputs
from lcc_rl.config.words import key_of, quoted, top_key
from lcc_rl.errors import ConfigError, ResultsError, require
from lcc_rl.figures.evaluation import measures_of
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.files import parquet_metadata, read_parquet, write_parquet
from lcc_rl.results.intervals import NOTHING, Estimate
from lcc_rl.results.measures import MEASURES, Shown
from lcc_rl.results.names import several, with_drivers
from lcc_rl.results.remarks import crashes
from lcc_rl.results.report import Report, windows_for
from lcc_rl.results.runs import CONFIG, EPISODES, differing, flatten, read_settings, without
from lcc_rl.results.windows import DRIVE, savings, varied_in
from lcc_rl.studies.alcc.study import DRIVERS_FILE
from lcc_rl.studies.study import StudyResults

ROAD_SHARES = ("5", "10", "20")  # shares of automated cars [%]
# Strings with desired speeds below those of the leaders would fall behind.
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
LEADERS_FILE, SHARES_FOLDER = "leaders.parquet", "evaluation"
OF_SHARE = ("scenario.string.penetration", *NOT_IDENTITY)  # settings in which shares may differ
OF_DRIVE = " leader "  # separates recording and leader in the name of a drive
LONGEST = 4000  # most steps of a window
FUEL = "fuel_l_per_100km"
DRAWN = (FUEL, "flow_vph", "brakings_below_2_per_100km", "share_time_gap_short")
COMPARED = (*DRAWN, "co2_g_per_km", "brakings_below_3_per_100km", "travel_time_s_per_km")
COUNTED = ("collisions", "episodes", "max_leader_braking_mps2", "max_braking_mps2")


def run(folder: Path, overrides: Sequence[str], shares: Sequence[str] = ROAD_SHARES) -> None:
    """Calibrate drivers and evaluate all shares; finished parts are skipped.

    Args:
        folder: the study's folder.
        overrides: options of ``lcc-rl calibrate`` (data, calibration) and ``lcc-rl evaluate``.
        shares: shares of automated cars [%].

    Raises:
        LccError: one clear error for wrong settings or files.
    """
    of_data = [override for override in overrides if top_key(override) in ("data", "calibration")]
    driven = [override for override in overrides if override not in of_data]
    keys, extra = {top_key(override) for override in driven}, []
    cfg = load("pipeline", ["~experiment", *_beside(FITTED, of_data)])
    first = _evaluation(driven, "50")  # checked before data are read
    check_shares(shares, first.scenario.string["size"])
    read_once(cfg, folder, learns=False)
    if "leader" not in keys:
        drives = leader_drives(read_parquet(folder / TRAJECTORIES), cfg.scenario.time_step)
        write_parquet(drives, folder / LEADERS_FILE)
        step = first.scenario.time_step
        samples = samples_of(drives, cfg.scenario.time_step, step)
        steps = window_steps(samples, round(first.evaluation.warm_up / step))
        extra += ["leader=drives", f"leader.path={quoted(folder / LEADERS_FILE)}"]
        extra += ["leader.evaluation_share=1", "leader.least_variation=0"]
        extra += [f"leader.together='.*(?={OF_DRIVE})'", f"scenario.horizon={steps}"]
    if "drivers" not in keys:
        extra += ["drivers=calibrated", f"drivers.path={quoted(calibrate_once(cfg, folder))}"]
    for share in shares:
        complete(with_inputs(_evaluation([*extra, *driven], share)), folder / SHARES_FOLDER / share)


def check_shares(shares: Sequence[str], size: int) -> None:
    """Refuse shares [%] that are no whole number of cars of the string.

    Raises:
        ConfigError: naming the share, and a size for which it is.
    """
    for share in shares:
        try:
            number = float(share)
        except ValueError:
            number = math.nan
        message = f"--shares takes per cent above 0 and at most 100, got {share!r} (0 is in "
        require(0.0 < number <= 100.0, message + "every table)")
        sizes = (n for n in range(size, 100 * size) if (number * n / 100.0 + 1e-9) % 1.0 < 1e-6)
        if (enough := next(sizes, size)) != size:
            message = f"{size} vehicles have no {share} %; use scenario.string.size={enough}"
            raise ConfigError(f"--shares {','.join(shares)}: {message}")


def _evaluation(overrides: Sequence[str], share: str) -> Any:
    option = f"scenario.string.penetration={share}e-2"
    return load("evaluate", [*_beside(DRIVEN, overrides), option])


def _beside(defaults: Sequence[str], overrides: Sequence[str]) -> list[str]:
    return [*(item for item in defaults if key_of(item) not in map(key_of, overrides)), *overrides]


def leader_drives(episodes: pd.DataFrame, time_step: float) -> pd.DataFrame:
    """Return ``drive``, ``time_s`` and ``speed_mps`` of all leaders, over all followers.

    A drive is as long as its leader's record, at steps of ``time_step`` [s].
    """
    keys = ["recording", "leader_id"]
    rows = episodes.sort_values([*keys, "time_s"]).drop_duplicates([*keys, "time_s"])
    begins = ~(rows.groupby(keys)["time_s"].diff() < 1.5 * time_step)
    since = rows["time_s"].where(begins).ffill().map(" from {:.1f} s".format)
    names = rows["recording"] + OF_DRIVE + rows["leader_id"].astype(str) + since
    rows = rows.assign(drive=names, speed_mps=rows["leader_speed_mps"])
    return rows[["drive", "time_s", "speed_mps"]]


def samples_of(drives: pd.DataFrame, recorded: float, step: float) -> np.ndarray:
    """Return the samples of each drive at a step [s], of a table with another step [s]."""
    lasting = (drives.groupby("drive").size().to_numpy() - 1) * recorded
    return (lasting / step + 1e-6).astype(int) + 1


def window_steps(samples: np.ndarray, begun: int) -> int:
    """Return the length of windows [steps] that covers the most time of all drives.

    Args:
        samples: samples of each drive.
        begun: first steps of a window, which do not count.
    """
    sizes = np.unique(np.minimum(samples, LONGEST + 1))
    counted = [(samples // size).sum() * (size - 1 - begun) for size in sizes]
    return int(sizes[np.argmax(counted)]) - 1


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write the study's table and figure, and the reports on data and drivers.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    study = StudyResults(folder, formats)
    places = sorted((folder / SHARES_FOLDER).iterdir(), key=lambda path: float(path.name))
    check_one_study(places)
    by_share = {path.name: windows_for(read_parquet(path / EPISODES)) for path in places}
    table = pd.DataFrame(row for share, group in by_share.items() for row in rows_of(share, group))
    table = table.astype(dict.fromkeys(COUNTED[:2], int))
    windows, cfg = by_share[places[0].name], read_settings(places[0] / CONFIG)
    drives, scenario, settings = windows[DRIVE].nunique(), cfg["scenario"], cfg["evaluation"]
    alone = f" (of a single one over its {varied_in(windows)})" * (drives == 1)
    study.table(
        "road",
        f"{scenario['string']['size']} vehicles, {several(settings['drivers'], 'time')} behind "
        f"each of {several(len(windows['profile_id'].unique()), 'window')} of "
        f"{scenario['horizon'] * scenario['time_step']:g} s, the first {settings['warm_up']:g} s "
        "not counted. Brackets: the value of human drivers times the 95 % interval of the ratio to "
        f"it, over {several(drives, 'recording')}{alone}",
        table,
    )
    for share, rows in table.groupby("automated_pct"):
        study.blocks += [
            f"{share:g} % automated: {remark}" for remark in crashes(rows.assign(against=HUMAN))
        ]
    shown = [Shown(x.shown.key, fill(x.title, 18)) for x in MEASURES if x.key in DRAWN]
    of = [f"{x:g} %" for x in table["automated_pct"]]
    report = Report("", table, with_drivers(table.assign(of=of)), tuple(shown), (), "", "")
    study.figure("road", "The same values and intervals; shares of time in %", measures_of(report))
    for name, file in (("Data", folder / TRAJECTORIES), ("Drivers", folder / DRIVERS_FILE)):
        if file.is_file():
            lines = [f"* {line}" for line in parquet_metadata(file)["report"].splitlines()]
            new = [line for line in lines if line not in "\n".join(study.blocks)]
            study.blocks.append("\n".join([f"## {name}\n", *new]))
    study.write("Automated cars on this road")
    return study


def check_one_study(places: Sequence[Path]) -> None:
    """Refuse evaluations that differ in more than the share of automated cars."""
    settings = [without(dict(flatten(read_settings(path / CONFIG))), OF_SHARE) for path in places]
    for place, own in zip(places, settings, strict=True):
        if keys := differing(settings[0], own):
            raise ResultsError(
                f"{place} differs from {places[0]} in {', '.join(keys[:3])}; remove the shares of "
                "other settings, or choose another --out"
            )


def rows_of(share: str, windows: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield a row per strategy: measures, with intervals from those of the ratio to humans'.

    Without automated cars nothing is compared; a controller with collisions has no values. If human
    drivers collide, nothing is compared with them.

    Args:
        share: share of automated cars [%].
        windows: result of :func:`lcc_rl.results.report.windows_for`.
    """
    groups = {str(name): group for name, group in windows.groupby("strategy", sort=False)}
    for name, group in groups.items():
        row: dict[str, Any] = {"automated_pct": float(share), "strategy": name}
        crashed = name != HUMAN and bool(group["collisions"].sum())
        alone = crashed or name == HUMAN or bool(groups[HUMAN]["collisions"].sum())
        for one in (one for one in MEASURES if one.key in COMPARED):
            column, *per = one.columns
            saved = NOTHING if alone else savings(windows, column, name, HUMAN, per)
            humans = one.value(groups[HUMAN])
            value = math.nan if crashed else one.value(group)
            interval = Estimate(value, humans * (1.0 - saved.high), humans * (1.0 - saved.low))
            row |= interval.within(*one.possible).columns(one.shown.key, one.scale)
            if one.key == FUEL:
                row |= saved.columns("fuel_saved_pct", 100.0)
        yield row | {one.key: one.value(group) for one in MEASURES if one.key in COUNTED}
