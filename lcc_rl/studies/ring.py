"""The field experiment on a ring (Stern et al. 2018), simulated: lcc-rl reproduce ring.

Humans drive all cars until a wave has developed; then one car is automated, or stays a human's.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.figures.page import Page
from lcc_rl.figures.space_time import space_time
from lcc_rl.io.files import read_parquet
from lcc_rl.results.names import in_words
from lcc_rl.results.runs import EPISODES, STEPS, stored_config
from lcc_rl.studies.runner import note, read_notes

HUMAN = "human"
RIVALS = ("follower_stopper", "pi_saturation")
SETTINGS = (
    "variant=alcc",
    "task=ring-22",
    f"compare=[{','.join(RIVALS)},pretrained]",
    "evaluation.humans_first=300",
    "scenario.horizon=3000",
)
TITLE = "One automated car on a ring"
# Stern et al., Transportation Research C 89 (2018), experiment A: FollowerStopper in 22 cars.
FIELD = {"driven by": "field experiment", "speeds against humans": "−80.8 %", "fuel": "−42.5 %"}


def run(folder: Path, overrides: Sequence[str], command: str) -> None:
    """Evaluate the rules and the shipped policy after a handover.

    Args:
        folder: the study's folder.
        overrides: further options of ``lcc-rl evaluate``.
        command: the command line, stored in the folder's notes.

    Raises:
        LccError: one clear error for wrong settings or files.
    """
    cfg = load("evaluate", [*SETTINGS, *overrides])
    evaluation.run(cfg, folder, replace=True)
    note(folder, "ring", command)


def write_results(
    folder: str | Path, formats: Iterable[str] = (), page: Path | None = None
) -> Path:
    """Write the study's page, ``report.html``, from its evaluation.

    Args:
        folder: holds config.yaml, episodes.parquet and steps.parquet.
        formats: further formats of the figures.
        page: Markdown file whose marked table is written anew, too.

    Returns:
        The path of report.html.

    Raises:
        ResultsError: if a table is missing or cannot be read.
    """
    made = Page(folder, formats)
    rows, steps = (read_parquet(made.folder / name) for name in (EPISODES, STEPS))
    cfg = stored_config(made.folder)
    names = list(dict.fromkeys(rows["strategy"]))
    pictures = {name: space_time(steps, [name], cfg) for name in names}
    drawn = [
        (name.replace("/", "_"), in_words(name), figure)
        for name, figure in pictures.items()
        if figure is not None
    ]
    text = words(cfg, len(rows) // len(names))
    made.add("After the handover", text, [("ring", "Means over the episodes", table(rows))], drawn)
    if page is not None:
        made.fill(page)
    return made.write(TITLE, read_notes(made.folder).get("commands", ()))


def words(cfg: Mapping[str, Any], episodes: int) -> str:
    """Return what the table shows."""
    scenario, first = cfg["scenario"], cfg["evaluation"]["humans_first"]
    lasting = scenario["horizon"] * scenario["time_step"]
    return f"""{scenario["string"]} on {scenario["circumference"]:g} m. Humans drive all cars for
        {first:g} s; then one car changes its driver, and the next {lasting:g} s are measured, in
        {episodes} episodes. A wave counts as damped once the standard deviation of the speeds stays
        below 0.5 m/s. Speeds vary by each car's standard deviation in time; fuel is net of kinetic
        energy, per km of all cars.

        In the field (Stern et al. 2018) what followed the handover is compared with the wave
        before it, here with the same minutes of human drivers."""


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row per driver of the automated car, and the field experiment's.

    Args:
        rows: rows of the evaluation, an episode each.
    """
    rows = rows.assign(
        fuel=rows["total_net_energy_kj"] / (rows["cav_distance_m"] + rows["hdv_distance_m"])
    )
    means = rows.groupby("strategy", sort=False).mean(numeric_only=True)
    humans, found = means.loc[HUMAN], []
    for name, part in rows.groupby("strategy", sort=False):
        own, times = means.loc[name], part["damping_time_s"]
        damped = (
            f"{times.mean():.0f} s" if times.notna().all() else f"{times.count()} of {len(times)}"
        )
        change = {key: own[key] / humans[key] - 1.0 for key in ("speed_std_mps", "fuel")}
        found.append(
            {
                "driven by": in_words(str(name)),
                "damped after": damped,
                "speeds vary [m/s]": own["speed_std_mps"],
                "speeds against humans": f"{100 * change['speed_std_mps']:+.1f} %",
                "fuel": f"{100 * change['fuel']:+.1f} %",
                "mean speed [m/s]": own["mean_speed_mps"],
                "smallest gap [m]": part["min_gap_m"].min(),
            }
        )
    return pd.DataFrame([*found, FIELD])
