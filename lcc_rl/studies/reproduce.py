"""Reproduce a paper's study, from trajectories to one page: lcc-rl reproduce alcc.

  lcc-rl reproduce alcc                           # embedded stream, 8 seeds
  lcc-rl reproduce alcc data=ngsim data.path=...  # trajectories; any override
  lcc-rl reproduce alcc --recipe quickstart --parts main  # an hour, not days
  lcc-rl reproduce alcc --parts main agent=analytic       # another agent
  lcc-rl reproduce alcc --recipe smoke --seeds 1  # everything once, in seconds
  lcc-rl reproduce hcfs                           # platoon: DDPG, CACC, hybrids
  lcc-rl reproduce ring                           # one automated car in a wave
  lcc-rl reproduce report outputs/alcc            # the page anew, from parquet

The same command resumes where it stopped: finished runs are skipped, interrupted trainings are
resumed, failed ones are listed and do not stop the others.
"""

from __future__ import annotations

import logging
import shlex
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lcc_rl.config import check_overrides
from lcc_rl.config.schemas import FORMATS
from lcc_rl.io.atomic import own_folder
from lcc_rl.runs.arguments import Arguments
from lcc_rl.runs.states import claim
from lcc_rl.studies import ring
from lcc_rl.studies.alcc import report as alcc_report
from lcc_rl.studies.alcc import study as alcc
from lcc_rl.studies.hcfs import report as hcfs_report
from lcc_rl.studies.hcfs import study as hcfs
from lcc_rl.studies.runner import FINISHED, NOTES, Outcome, read_notes

log = logging.getLogger("lcc_rl")

GIVEN = ("seed", "variant")
OWN = (
    "every run has its own; --seeds is their number, counted from 0, and options of this command "
    "choose the variants"
)
OTHERS = "further formats of figures: " + ",".join(FORMATS[1:])
REPORTS = {
    "alcc": alcc_report.write_results,
    "hcfs": hcfs_report.write_results,
    "ring": ring.write_results,
}


def reproduce_alcc(arguments: Namespace, command: str) -> int:
    """Run the ALCC study and write its page; 1 if a training failed."""
    usual = None if alcc.chooses_agent(arguments.overrides) else "paper_alcc"
    study = alcc.Study(
        **common(arguments, usual),
        ablations=tuple(arguments.ablations) or None,
    )
    with claim(study.folder):
        outcomes = alcc.run(study, arguments.parts, command)
        return concluded(outcomes, study.folder, "alcc", arguments.formats)


def reproduce_hcfs(arguments: Namespace, command: str) -> int:
    """Run the HCFS study and write its page; 1 if a training failed."""
    study = hcfs.Study(**common(arguments, "paper_hcfs"))
    with claim(study.folder):
        return concluded(hcfs.run(study, command), study.folder, "hcfs", arguments.formats)


def reproduce_ring(arguments: Namespace, command: str) -> int:
    """Evaluate controllers on a ring after a handover and write the page."""
    folder = own_folder(arguments.out, "--out", lambda names: NOTES in names)
    ring.run(folder, arguments.overrides, command)
    log.info("wrote %s", ring.write_results(folder, arguments.formats))
    return 0


def common(arguments: Namespace, recipe: str | None) -> dict[str, Any]:
    """Return the settings that every study has, with the recipe's default."""
    return {
        "folder": own_folder(arguments.out, "--out", lambda names: NOTES in names),
        "recipe": arguments.recipe or recipe,
        "seeds": arguments.seeds,
        "overrides": tuple(arguments.overrides),
        "jobs": arguments.jobs,
        "accept": tuple(arguments.accept),
    }


def concluded(
    outcomes: Sequence[Outcome], folder: Path, study: str, formats: Sequence[str] = ()
) -> int:
    """Log the trainings that failed and write the page; 1 if one failed."""
    wrong = [outcome for outcome in outcomes if outcome.status != FINISHED]
    for outcome in wrong:
        log.error("%s: %s: %s", outcome.run.folder, outcome.status, outcome.note)
    page = REPORTS[study](folder, formats)
    log.info("%d of %d trainings in %s", len(outcomes) - len(wrong), len(outcomes), page)
    return 1 if wrong else 0


def rewrite(arguments: Namespace, command: str) -> int:
    """Rewrite tables, figures and page of a study's folder."""
    study = read_notes(arguments.folder).get("study", "alcc")
    log.info("wrote %s", REPORTS[study](arguments.folder, arguments.formats, arguments.page))
    return 0


def parser() -> ArgumentParser:
    """Return the command line: a subcommand per study, and ``report``."""
    top = Arguments(description=__doc__)
    commands = top.add_subparsers(required=True)
    one = study_parser(commands, "alcc", "Adaptive Leading Cruise Control (arXiv 2210.02147)")
    one.set_defaults(run=reproduce_alcc)
    listing(one, "--parts", alcc.PARTS, "which parts to run: " + ",".join(alcc.PARTS))
    names = f"all by default: {','.join(alcc.ABLATIONS)}; or your own as name:override"
    listing(one, "--ablations", (), f"which ablations; {names}")
    two = study_parser(commands, "hcfs", "Hybrid Car-Following Strategy (IEEE T-ASE 2021)")
    two.set_defaults(run=reproduce_hcfs)
    three = commands.add_parser("ring", help="field experiment on a ring (Stern et al. 2018)")
    three.add_argument("--out", type=Path, default=Path("outputs/ring"), help="the study's folder")
    listing(three, "--formats", (), OTHERS)
    three.set_defaults(run=reproduce_ring)
    again = commands.add_parser("report", help="write a study's page anew, from parquet alone")
    again.set_defaults(run=rewrite, overrides=[])
    again.add_argument("folder", type=Path)
    again.add_argument("--page", type=Path, help="a Markdown page whose tables are written anew")
    listing(again, "--formats", (), OTHERS)
    return top


def study_parser(commands: Any, name: str, text: str) -> ArgumentParser:
    """Add the subcommand of a study, with the options that every study has."""
    one: ArgumentParser = commands.add_parser(name, help=text)
    folder = Path("outputs") / name
    one.add_argument("--out", type=Path, default=folder, help="the study's folder")
    one.add_argument("--seeds", type=int, default=8, help="trainings of every learned variant")
    one.add_argument("--jobs", type=int, default=2, help="trainings at a time")
    text = f"experiment: paper_{name}, quickstart …; in alcc with agent=… that agent's own length"
    one.add_argument("--recipe", help=text)
    listing(one, "--formats", (), OTHERS)
    listing(one, "--accept", (), "settings in which runs found in the folder may differ: data,…")
    return one


def listing(target: ArgumentParser, name: str, default: tuple[str, ...], text: str) -> None:
    """Add an option that takes names separated by commas."""
    target.add_argument(name, type=lambda words: words.split(","), default=default, help=text)


def main(words: list[str]) -> int:
    """Run a command; words that are no options are overrides of every run."""
    top = parser()
    arguments, overrides = top.parse_known_args(words)
    wrong = [item for item in overrides if item.startswith("-")]
    if wrong or (overrides and "folder" in arguments):
        top.error(f"unknown: {' '.join(wrong or overrides)}")
    check_overrides(overrides, GIVEN, OWN)
    arguments.overrides = overrides
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    return int(arguments.run(arguments, shlex.join(["lcc-rl", "reproduce", *words])))
