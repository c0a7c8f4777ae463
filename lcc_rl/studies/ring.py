"""The field experiment on a ring (Stern et al. 2018), simulated: lcc-rl reproduce ring.

Humans drive all cars until a wave has developed. Then one car is automated or still human-driven.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from lcc_rl.commands.evaluation import complete
from lcc_rl.config import load
from lcc_rl.figures.space_time import space_time
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.files import read_parquet
from lcc_rl.results.measures import signed
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import CONFIG, EPISODES, STEPS, read_settings
from lcc_rl.studies.study import StudyResults

RING_EVALUATION = "evaluation"
RIVALS = ("follower_stopper", "pi_saturation")
SETTINGS = (
    "variant=alcc",
    "task=ring-22",
    f"compare=[{','.join(RIVALS)},pretrained]",
    "evaluation.humans_first=300",
    "scenario.horizon=3000",
)
RING_TITLE = "One automated car on a ring"
# Stern et al., Transportation Research C 89 (2018), experiment A: FollowerStopper in 22 cars.
FIELD = {"driven by": "field experiment", "speeds against humans": "−80.8 %", "fuel": "−42.5 %"}


def run(folder: Path, overrides: Sequence[str]) -> None:
    """Evaluate the rules and the shipped policy after the handover.

    Args:
        folder: the study's folder.
        overrides: further options of ``lcc-rl evaluate``.

    Raises:
        LccError: for any error in settings or files, in one line.
    """
    complete(load("evaluate", [*SETTINGS, *overrides]), folder / RING_EVALUATION)


def study_results(folder: Path, formats: Iterable[str] = ()) -> StudyResults:
    """Write the study's table and diagrams from its evaluation.

    The variation of speeds is each car's standard deviation in time. Fuel is net of kinetic energy,
    per km of all cars. The field experiment is compared with the wave before the handover, the
    others with human drivers in the same minutes.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    source = folder / RING_EVALUATION
    rows, steps = (read_parquet(source / name) for name in (EPISODES, STEPS))
    cfg, study = read_settings(source / CONFIG), StudyResults(folder, formats)
    first, skipped = (cfg["evaluation"][name] for name in ("humans_first", "warm_up"))
    lasting = cfg["scenario"]["horizon"] * cfg["scenario"]["time_step"]
    caption = f"{lasting:g} s after {first:g} s in which humans drive all cars, the first "
    caption += f"{skipped:g} s not counted: means over episodes"
    study.table("ring", caption, table(rows))
    for name in dict.fromkeys(rows["strategy"]):
        figure = space_time(steps, [name], cfg)
        if figure is not None:
            study.figure(name.replace("/", "_"), in_words(name), figure)
    study.write(RING_TITLE)
    return study


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row per controller of the automated car, and that of the field experiment.

    Args:
        rows: rows of the evaluation, one per episode.
    """
    rows = rows.assign(
        fuel=rows["total_net_energy_kj"] / (rows["cav_distance_m"] + rows["hdv_distance_m"])
    )
    means = rows.groupby("strategy", sort=False).mean(numeric_only=True)
    humans, entries = means.loc[HUMAN], []
    for name, group in rows.groupby("strategy", sort=False):
        mean, times = means.loc[name], group["damping_time_s"]
        damped = (
            f"{times.mean():.0f} s" if times.notna().all() else f"{times.count()} of {len(times)}"
        )
        ratios = (mean / humans).to_dict()
        changes = (f"{signed(100 * (ratios[x] - 1))} %" for x in ("speed_std_mps", "fuel"))
        entries.append(
            {
                "driven by": in_words(str(name)),
                "damped after": damped,
                "speeds vary [m/s]": mean["speed_std_mps"],
                **dict(zip(("speeds against humans", "fuel"), changes, strict=True)),
                "mean speed [m/s]": mean["mean_speed_mps"],
                "smallest gap [m]": group["min_gap_m"].min(),
            }
        )
    return pd.DataFrame([*entries, FIELD])
