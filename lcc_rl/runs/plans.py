"""Plans of sweeps: their cells, the settings of each, and runs without results."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, islice, product, repeat
from pathlib import Path
from typing import Any

from lcc_rl.config.words import key_of
from lcc_rl.errors import ResultsError
from lcc_rl.io.settings import parse_yaml, read_json, read_text
from lcc_rl.runs.states import HYDRA_FOLDER, run_folders, survey

PLAN = "sweep.json"
RUN_HASH = re.compile(r"(?:^|/|_)([0-9a-f]{8})$")  # hash of a run's settings at the end of its name
MOST_RUNS = 100_000  # most runs of a sweep: Hydra holds all of them in memory


@dataclass(frozen=True)
class SweepPlan:
    """Plan of a sweep.

    Args:
        runs: number of runs, without cells that are the run of another one; 0 if unknown.
        varied: dotted keys of settings that differ between runs.
        values: values of each of them; its cells are all combinations.
        marks: hash of the settings of each cell, as in the name of its run; empty if unknown.
        earlier: plans of other commands that wrote into the same folder.
    """

    runs: int = 0
    varied: list[str] = field(default_factory=list)
    values: list[list[str]] = field(default_factory=list)
    marks: list[str] = field(default_factory=list)
    earlier: list[SweepPlan] = field(default_factory=list)

    def after(self, before: SweepPlan) -> SweepPlan:
        """Return this plan with the cells of the plans before it."""
        others = [replace(before, earlier=[]), *before.earlier]
        same = self.varied, self.values, self.marks
        return replace(self, earlier=[x for x in others if (x.varied, x.values, x.marks) != same])


def read_plan(folder: Path) -> SweepPlan:
    """Return the plan of the sweep in a folder; an empty one if there is none."""

    def plan(content: Any) -> SweepPlan:
        found = SweepPlan(**content)
        values = [[str(value) for value in some] for some in found.values]
        varied, marks = ([str(x) for x in some] for some in (found.varied, found.marks))
        return SweepPlan(int(found.runs), varied, values, marks, [plan(x) for x in found.earlier])

    try:
        return plan(read_json(folder / PLAN))
    except (ResultsError, ValueError, TypeError, OverflowError):
        return SweepPlan()


def choices_of(folder: Path) -> dict[str, str]:
    """Return the settings of a run's command by key; empty for a run without a command."""
    path = folder / HYDRA_FOLDER / "overrides.yaml"
    try:
        words = parse_yaml(f"words:\n{read_text(path)}", str(path))["words"]
        return {key_of(str(word)): str(word).partition("=")[2] for word in words}
    except (ResultsError, TypeError):
        return {}


def unfinished(root: Path) -> dict[str, str]:
    """Return the state of each run without results at or below a folder, by name.

    Cells of a plan without a run, known by its hash, else by its command, are ``waiting``.
    """
    folders = run_folders(root)
    found = {run.name: str(run) for run in survey(root, folders) if run.state != "finished"}
    sweeps: dict[Path, list[Path]] = {root: []}
    for run in (run for run in folders if run != root):
        sweeps.setdefault(run.parent, []).append(run)
    for sweep, runs in sweeps.items():
        latest = read_plan(sweep)
        for name in _waiting([latest, *latest.earlier], runs):
            found[str((sweep / name).relative_to(root))] = "waiting"
    return found


def _waiting(plans: Sequence[SweepPlan], runs: Sequence[Path]) -> Iterator[str]:
    """Yield the names of cells of the plans of a folder without a run, each run once."""
    plans = [plan for plan in plans if plan.values]
    named = runs if plans else ()
    typed = [("".join(RUN_HASH.findall(run.name)), choices_of(run)) for run in named]
    known = {mark for mark, _ in typed} - {""}
    for plan in plans:
        by_words = [choices for mark, choices in typed if not (mark and plan.marks)]
        begun = {tuple(map(choices.get, plan.varied)) for choices in by_words}
        cells = islice(product(*plan.values), MOST_RUNS)
        for cell, mark in zip(cells, chain(plan.marks, repeat("")), strict=False):
            if cell not in begun and mark not in known:
                known |= {mark} - {""}
                yield "+".join(map("=".join, zip(plan.varied, cell, strict=False)))
