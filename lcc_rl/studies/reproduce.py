"""Reproduce a paper's study with tables and figures: lcc-rl reproduce alcc.

  lcc-rl reproduce alcc                           # embedded stream, 8 seeds
  lcc-rl reproduce alcc data=ngsim data.path=...  # trajectories; any override
  lcc-rl reproduce alcc --recipe quickstart --parts main  # an hour, not days
  lcc-rl reproduce alcc --parts main agent=analytic       # another agent
  lcc-rl reproduce alcc --recipe smoke --seeds 1  # everything once, in seconds
  lcc-rl reproduce hcfs                           # platoon: DDPG, CACC, hybrids
  lcc-rl reproduce ring                           # one automated car in a wave
  lcc-rl reproduce road data=table data.path=...  # effect of 5, 10, 20 %

The same command resumes a stopped study: finished runs are skipped, interrupted trainings are
resumed. results.md in the study's folder shows all tables and figures.
"""

from __future__ import annotations

import logging
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lcc_rl.config.schemas import FORMATS
from lcc_rl.config.words import check_overrides
from lcc_rl.io.atomic import own_folder
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.states import claim
from lcc_rl.studies import ring, road
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.hcfs import study as hcfs
from lcc_rl.studies.study import RESULTS_PAGE, Study, StudyResults

log = logging.getLogger("lcc_rl")

SET_BY_STUDY = ("seed", "variant")
# Contents of a study's folder.
MADE = {
    RESULTS_PAGE,
    "calibration",
    "train",
    "ablations",
    "evaluation",
    "tables",
    "figures",
    "ddpg",
}
MADE |= {f"{name}.parquet" for name in ("trajectories", "leaders", "episodes", "steps", "training")}
OWN_FOLDER_WORDS = (
    "it differs by run; --seeds is the number of seeds, from 0, and options of this command choose "
    "the variants"
)
STUDY_RESULTS: dict[str, Callable[..., StudyResults]] = {
    "alcc": alcc.study_results,
    "hcfs": hcfs.study_results,
    "ring": ring.study_results,
    "road": road.study_results,
}


def run(given: Namespace) -> None:
    """Run the chosen study."""
    if given.study == "ring":
        ring.run(given.out, given.overrides)
    elif given.study == "road":
        road.run(given.out, given.overrides, given.shares)
    elif given.study == "hcfs":
        hcfs.run(_study(given, hcfs.RECIPE))
    else:
        alcc.run(_study(given, alcc.default_recipe(given.overrides)), given.parts, given.ablations)


def _study(given: Namespace, recipe: str | None) -> Study:
    overrides = tuple(given.overrides)
    return Study(given.out, given.recipe or recipe, given.seeds, overrides, given.jobs)


def parser() -> ArgumentParser:
    """Return the command line: a subcommand per study."""
    top = Arguments(description=__doc__)
    commands = top.add_subparsers(required=True, dest="study")
    paper = _trained(commands, "alcc", "Adaptive Leading Cruise Control (arXiv 2210.02147)")
    _listing(paper, "--parts", alcc.STUDY_PARTS, "parts to run: " + ",".join(alcc.STUDY_PARTS))
    names = f"all by default: {','.join(alcc.ABLATIONS)}; or your own as name:override"
    _listing(paper, "--ablations", (), f"ablations; {names}")
    _trained(commands, "hcfs", "Hybrid Car-Following Strategy (IEEE T-ASE 2021)")
    _subcommand(commands, "ring", "field experiment on a ring (Stern et al. 2018)")
    two = _subcommand(commands, "road", "effect of automated cars on a recorded road")
    _listing(two, "--shares", road.ROAD_SHARES, "shares of automated cars in per cent: 5,10,20")
    return top


def _subcommand(commands: Any, name: str, text: str) -> ArgumentParser:
    command: ArgumentParser = commands.add_parser(name, help=text)
    folder = Path("outputs") / name
    command.add_argument("--out", type=Path, default=folder, help="the study's folder")
    _listing(command, "--formats", (), "further formats of figures: " + ",".join(FORMATS[1:]))
    return command


def _trained(commands: Any, name: str, text: str) -> ArgumentParser:
    command = _subcommand(commands, name, text)
    command.add_argument("--seeds", type=int, default=8, help="trainings of every learned variant")
    command.add_argument("--jobs", type=int, default=2, help="parallel trainings")
    text = f"experiment: paper_{name}, quickstart …; for alcc with agent=…: the agent's length"
    command.add_argument("--recipe", help=text)
    return command


def _listing(target: ArgumentParser, name: str, default: tuple[str, ...], text: str) -> None:
    """Add an option with names separated by commas."""
    target.add_argument(name, type=lambda words: words.split(","), default=default, help=text)


def main(words: list[str]) -> int:
    """Run a command; further words are overrides of all runs."""
    top = parser()
    arguments, overrides = top.parse_known_args(words)
    if wrong := [option for option in overrides if option.startswith("-")]:
        top.error(f"unknown: {' '.join(wrong)}")
    check_overrides(overrides, SET_BY_STUDY, OWN_FOLDER_WORDS)
    arguments.overrides = overrides
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    arguments.out = own_folder(arguments.out, MADE.issuperset)
    with claim(arguments.out):
        run(arguments)
        STUDY_RESULTS[arguments.study](arguments.out, arguments.formats)
    log.info("tables and figures: %s", arguments.out / RESULTS_PAGE)
    return 0
