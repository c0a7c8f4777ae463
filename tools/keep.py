"""Keep the small tables behind a page: python tools/keep.py lengths|means <folder>… --out <path>

lengths: the held-out windows of HCFS studies whose trainings differ in length, one file.
means: of one evaluation, the means per window and per driver, two files in a folder.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from lcc_rl.cli.entry import main_guard
from lcc_rl.errors import require
from lcc_rl.evaluation.cases import WINDOWS
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.studies.hcfs.study import TRAINING
from lcc_rl.studies.hcfs.tables import LEARNED
from lcc_rl.studies.runner import EPISODES

TRAINED = ["strategy", "training_seed"]
NUMBERS = ("profile_id", "driver_id", "training_seed")  # name a thing, measure none
GROUPS = {"windows": ["profile_id", "profile"], "drivers": ["driver_id"]}


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


def means(folder: Path, target: Path) -> None:
    """Keep the mean of every measure per window and per driver; of ``min_…``, ``max_…`` these."""
    rows = read_parquet(folder / EPISODES)
    rows = rows.assign(collided=rows["collided"].astype("float32"))
    measures = [str(name) for name in rows.select_dtypes("number") if name not in NUMBERS]
    ends = {"min": "min", "max": "max"}
    how = {name: ends.get(name.partition("_")[0], "mean") for name in measures}
    for name, by in GROUPS.items():
        groups = rows.groupby([*TRAINED, *by], dropna=False, as_index=False, observed=True)
        kept = groups.agg(how)
        kept[measures] = kept[measures].astype("float32").round(4)
        write_parquet(kept, target / f"{name}.parquet")


def main(words: Sequence[str] | None = None) -> int:
    """Keep what is asked for."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("what", choices=("lengths", "means"))
    parser.add_argument("folders", nargs="+", type=Path, help="studies, or one evaluation")
    parser.add_argument("--out", type=Path, required=True, help="the file, or the folder")
    options = parser.parse_args(words)
    if options.what == "lengths":
        lengths(options.folders, options.out)
    else:
        require(len(options.folders) == 1, "means: of one evaluation")
        means(options.folders[0], options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)())
