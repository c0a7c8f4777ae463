"""Keep the small tables behind a page: python tools/keep.py <what> <folder>… --out <path>

lengths: the held-out windows of HCFS studies whose trainings differ in length, one file.
sources: the windows of platoons behind several sources of leaders, one file.
classes: the scores of evaluations with task=… by source and speed of the leader, one file.
fleets: what fronts of fleets need of evaluations named <setting>_<share>, one file.
means: the means of one evaluation per window and per driver, two files in a folder.
alcc: those of an ALCC study's main part, its learning curves, an episode and its drivers.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import leaderboard
import numpy as np
import pandas as pd

from lcc_rl import results
from lcc_rl.cli.guard import main_guard
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import require
from lcc_rl.evaluation.cases import WINDOWS
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.fronts import DISTANCE, FLEET
from lcc_rl.results.means import TRAINED, Means
from lcc_rl.results.runs import EPISODES, STEPS
from lcc_rl.results.savings import DRIVE, SOURCE
from lcc_rl.results.scores import LEAST, scores
from lcc_rl.studies.alcc.results import CURVES
from lcc_rl.studies.alcc.study import DRIVERS, EVALUATION
from lcc_rl.studies.hcfs.study import TRAINING
from lcc_rl.studies.hcfs.tables import LEARNED, MEASURES, RUN, STABLE, per_run, rounded

# Columns of the learning curves that are kept, besides the terms of the reward.
CURVE = ("variant", "seed", "iteration", "episodes", "updates", "episode_reward", "collisions")

# What is kept of a fleet's episodes beside energy, distance and flow, of all drivers of a window.
FLEET_LIMITS = {"max_gap_m": "max", "min_time_gap_s": "min", "collided": "sum"}

# Classes of a leader's mean speed, and the column with the lower end of one [m/s].
CLASSES, FASTER = (0.0, 15.0, 25.0, 29.0, np.inf), "faster_than_mps"


def lengths(studies: Sequence[Path], path: Path) -> None:
    """Keep Σ reward per window of DDPG and HCFS, and how many episodes DDPG was trained for."""
    parts = []
    for study in studies:
        rows = read_parquet(study / EPISODES)
        rows = rows[(rows["case"] == WINDOWS) & rows["strategy"].isin([LEARNED, "hcfs"])]
        kept = rows.groupby([*TRAINED, "case", "profile"], as_index=False)["reward"].sum()
        episodes = int(read_parquet(study / TRAINING)["episodes"].max())
        parts.append(
            kept.assign(
                reward=kept["reward"].astype("float32").round(4), training_episodes=episodes
            )
        )
    write_parquet(pd.concat(parts, ignore_index=True), path)


def sources(evaluations: Sequence[Path], path: Path) -> None:
    """Keep what CACC, DDPG and the hybrid, by its choices, did behind every source of leaders."""
    rows = pd.concat([results.load(folder) for folder in evaluations], ignore_index=True)
    hybrid = (rows["strategy"] == "hcfs") & (rows["deployed.choice"] != "better")
    names = rows["strategy"].astype(str).mask(hybrid, "hcfs " + rows["deployed.choice"].astype(str))
    rows = rows.assign(strategy=names)[(rows["case"] == WINDOWS) & names.isin(STABLE)]
    # Rules and DDPG drove beside every choice.
    rows = rows.drop_duplicates([SOURCE, *RUN, "follower"])
    parts = [per_run(part).assign(source=name) for name, part in rows.groupby(SOURCE, sort=False)]
    write_parquet(rounded(pd.concat(parts)[[SOURCE, *RUN, DRIVE, *MEASURES]]), path)


def classes(evaluations: Sequence[Path], path: Path) -> None:
    """Keep how every strategy scores by source and class of the leader's mean speed.

    ``outside_…`` counts the episodes, over all seeds, that break a limit of the task.
    """
    kept = []
    for folder in evaluations:
        cfg, task, rows, _ = leaderboard.task_scores(folder)
        # That of most strategies: a collision ends an episode early.
        speed = rows.groupby("profile_id")["leader_speed_mps"].transform("median")
        rows[FASTER] = pd.cut(speed, CLASSES, labels=CLASSES[:-1]).astype(float)
        for name, bound in task.limits.items():
            broken = rows[name] < bound if name.startswith(LEAST) else rows[name] > bound
            rows[f"outside_{name}"] = broken
        counts = [name for name in rows if str(name).startswith("outside_")]
        for _, part in rows.groupby([SOURCE, FASTER]):
            table = scores(part, task, build_energy(cfg)).set_index("strategy")
            table = table.join(part.groupby("strategy")[counts].sum()).reset_index()
            labelled = table.assign(
                evaluation=folder.name,
                source=part[SOURCE].iloc[0],
                faster_than_mps=part[FASTER].iloc[0],
                windows=part["profile_id"].nunique(),
                drives=part[DRIVE].nunique(),
            )
            kept.append(labelled)
    write_parquet(rounded(pd.concat(kept)), path)


def fleets(evaluations: Sequence[Path], path: Path) -> None:
    """Keep a row per setting, share, strategy, seed and window of fleets, for their fronts.

    A strategy ``T_1.2`` is the point of the rule's front with that time gap.
    """
    rows = pd.concat(map(_fleet, evaluations), ignore_index=True)
    # Humans drive in every evaluation of a setting.
    axes = ["setting", "penetration", "variant", "limit", "training_seed", "profile_id"]
    write_parquet(rounded(rows.drop_duplicates(axes, ignore_index=True)), path)


def _fleet(folder: Path) -> pd.DataFrame:
    cfg, _, rows, _ = leaderboard.task_scores(folder)
    driven = [name for name in ("cav_distance_m", "hdv_distance_m") if name in rows]
    rows = rows.assign(
        **{DISTANCE: rows[driven].sum(axis=1), "training_seed": rows["training_seed"].fillna(-1)}
    )
    axes = ["strategy", "training_seed", "profile_id", DRIVE]
    how = dict.fromkeys(FLEET, "mean") | FLEET_LIMITS
    kept = rows.groupby(axes, sort=False).agg(how).reset_index()
    names, string = kept["strategy"].astype(str), cfg.scenario.vehicles
    time_gap = names.str.extract("^T_(.*)$")[0].astype(float)
    variant = names.mask(time_gap.notna(), "idm_acc").mask(names == cfg.variant, "learned")
    return kept.drop(columns="strategy").assign(
        setting=folder.name.rpartition("_")[0],
        penetration=string.count(AUTOMATED) / len(string),
        variant=variant,
        policy="fleet",
        limit=time_gap.fillna(0.0),
    )


def means(evaluations: Sequence[Path], target: Path) -> None:
    """Keep the means of an evaluation per window and per driver."""
    Means.of(read_parquet(_only(evaluations) / EPISODES)).write(target)


def alcc(studies: Sequence[Path], target: Path) -> None:
    """Keep what the page of an ALCC study shows of its main part."""
    study = _only(studies)
    means([study / EVALUATION], target / EVALUATION)
    steps = read_parquet(study / EVALUATION / STEPS)
    steps = steps[steps["strategy"] == "alcc"]
    keys = ["training_seed", "profile", "driver_id"]
    first = (steps[keys] == steps[keys].iloc[0]).all(axis=1)
    write_parquet(steps[first], target / EVALUATION / STEPS)
    curves = results.load(study / "train", "training")
    shown = [x for x in curves if x in CURVE or str(x).startswith("reward_")]
    curves = curves[shown]
    rewards = curves.select_dtypes("float").columns
    write_parquet(curves.astype(dict.fromkeys(rewards, "float32")), target / CURVES)
    write_parquet(read_parquet(study / DRIVERS), target / DRIVERS)


def _only(folders: Sequence[Path]) -> Path:
    require(len(folders) == 1, f"expected one folder, got {len(folders)}")
    return folders[0]


KINDS = {kind.__name__: kind for kind in (lengths, sources, classes, fleets, means, alcc)}


def main(words: Sequence[str] | None = None) -> int:
    """Keep what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=KINDS)
    parser.add_argument("folders", nargs="+", type=Path, help="studies, or evaluations")
    parser.add_argument("--out", type=Path, required=True, help="the file, or the folder")
    options = parser.parse_args(words)
    KINDS[options.what](options.folders, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
