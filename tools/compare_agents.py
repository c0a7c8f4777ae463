"""Compare agents, and controllers that know more than the present state.

    python tools/compare_agents.py agents data=ngsim data.path=...      # ddpg, td3, sac, analytic
    python tools/compare_agents.py agents training.keep_every=5 ...     # ... and on the way there
    python tools/compare_agents.py knowledge data=ngsim data.path=...   # memory and preview
    python tools/compare_agents.py limits data=ngsim data.path=...      # networks and tuned rules

Each runs trainings into ``--out``, then reads their parquet files and writes a table and a
figure. The same command resumes where it stopped and skips finished runs; ``--draw`` only draws.
Words that are no options are overrides of every training.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Callable, Iterable
from itertools import product
from pathlib import Path

import pandas as pd
from agent_results import (
    EPISODES,
    FILTERED,
    KEPT,
    MEANS,
    PREVIEWS,
    figure_of_agents,
    figure_of_knowledge,
    table_of_agents,
    table_of_knowledge,
)
from limit_results import comparisons, figure_of_limits, table_of_limits
from matplotlib.figure import Figure

from lcc_rl.commands.pipeline import root_key
from lcc_rl.commands.training import POLICIES
from lcc_rl.config import load, require
from lcc_rl.envs import load_inputs
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.strategies import trained
from lcc_rl.figures.drawing import save
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.policies.rules import NETWORK
from lcc_rl.results.policies import load_policy
from lcc_rl.runs.cli import main_guard
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.sweeps import key_of
from lcc_rl.studies.runner import FINISHED, Run, check_overrides, run_all

log = logging.getLogger("lcc_rl")

AGENTS = ("analytic", "ddpg", "td3", "sac")
POLICY = "policy.pt"
GRADIENT = "_gradient"


def runs_of_agents(options: argparse.Namespace) -> list[Run]:
    """Return a training per agent, variant and seed, and the human baseline."""
    return [
        Run(
            options.out / agent / variant / f"seed_{seed}",
            (f"agent={agent}", f"variant={variant}", f"seed={seed}", *options.overrides),
        )
        for agent in options.agents
        for variant in options.variants
        for seed in range(options.seeds)
    ]


def runs_of_knowledge(options: argparse.Namespace) -> list[Run]:
    """Return trainings with present state only, with memory, and with previews."""
    kinds: dict[str, list[str]] = {"none": [], "memory": ["+knowledge=memory"]}
    for seconds in PREVIEWS:
        kinds[f"preview_{seconds:g}s"] = preview(seconds)
    return [
        Run(
            options.out / kind / f"seed_{seed}",
            (f"agent={options.agent}", f"seed={seed}", *changes, *options.overrides),
        )
        for kind, changes in kinds.items()
        for seed in range(options.seeds)
    ]


def preview(seconds: float) -> list[str]:
    """Return the overrides of a preview of ten speeds over so long a time."""
    ahead = ",".join(f"{seconds * part / 10:g}" for part in range(1, 11))
    return ["+knowledge=preview", f"scenario.pieces.preview.horizons=[{ahead}]"]


def runs_of_limits(options: argparse.Namespace) -> list[Run]:
    """Return trainings of networks and of rules' constants within several limits."""
    runs = []
    for variant, kind, share in product(options.variants, options.policies, options.shares):
        how = [*learner(kind), f"agent.limits.efficiency={share}"]
        runs += [
            Run(
                options.out / variant / kind / f"limit_{share}" / f"seed_{seed}",
                (f"variant={variant}", *how, f"seed={seed}", *options.overrides),
            )
            for seed in range(options.seeds)
        ]
    return runs


def learner(kind: str) -> list[str]:
    """Return the overrides of a network and what it knows, or of a rule.

    A rule's constants are tuned by search, or by the gradient as ``idm_gradient``.
    """
    networks = {NETWORK: [], "memory": ["+knowledge=memory"], "preview": preview(5.0)}
    if kind in networks:
        return ["experiment=limits", *networks[kind]]
    rule = kind.removesuffix(GRADIENT)
    if rule == kind:
        return ["experiment=limits_tuned", f"agent.policy={rule}"]
    # Its five constants change little per step at the rate of a network's weights.
    return ["experiment=limits", f"agent.policy={rule}", "agent.learning_rate=0.03"]


def human(options: argparse.Namespace) -> Run:
    """Return the evaluation of the human baseline."""
    return Run(options.out / "idm", ("variant=idm", *data_overrides(options.overrides)))


def data_overrides(overrides: Iterable[str]) -> list[str]:
    """Return the overrides that also apply to a controller without training."""
    known = (
        "data",
        "split",
        "leader",
        "drivers",
        "evaluation",
        "scenario",
        "experiment",
        "trust",
        "device",
    )
    own = ("scenario.filters.", "scenario.pieces.preview.", "scenario.pieces.memory.")
    return [
        item for item in overrides if root_key(item) in known and not key_of(item).startswith(own)
    ]


def evaluate_kept(options: argparse.Namespace) -> None:
    """Evaluate the policies that each finished training kept, into its kept.parquet."""
    kept = {folder: sorted((folder / POLICIES).glob("*.pt")) for folder in finished(options.out)}
    todo = {folder: paths for folder, paths in kept.items() if paths and outdated(folder, paths)}
    if not todo:
        return
    judge = evaluator(options.overrides)
    for folder, paths in todo.items():
        log.info("%s: evaluating the policies that it kept", folder)
        rows = [{"iteration": float(path.stem), **judge(path)} for path in paths]
        write_parquet(pd.DataFrame(rows), folder / KEPT)


def evaluate_filtered(options: argparse.Namespace) -> None:
    """Evaluate each finished policy with the filter, into its filtered.parquet."""
    todo = [
        folder
        for folder in finished(options.out)
        if (folder / POLICY).exists() and older(folder / FILTERED, folder / POLICY)
    ]
    if not todo:
        return
    judge = evaluator(options.overrides, "+filter=cbf")
    for folder in todo:
        log.info("%s: evaluating the policy behind the filter", folder)
        write_parquet(pd.DataFrame([judge(folder)]), folder / FILTERED)


def finished(folder: Path) -> list[Path]:
    """Return the folders of all runs below that were evaluated."""
    return [path.parent for path in sorted(folder.rglob(EPISODES))]


def older(path: Path, than: Path) -> bool:
    """Whether a file is missing or older than another one."""
    return not path.exists() or path.stat().st_mtime < than.stat().st_mtime


def evaluator(overrides: Iterable[str], *further: str) -> Callable[[Path], dict[str, float]]:
    """Return a function from a policy's file or folder to its means on the held-out profiles."""
    cfg = load("evaluate", [*data_overrides(overrides), *further])
    prepare_torch(cfg)
    inputs, size, trust = load_inputs(cfg), cfg.evaluation, tuple(cfg.trust)

    def judge(path: Path) -> dict[str, float]:
        strategy = trained(cfg, str(path), load_policy(path, trust=trust), inputs.population)
        who = (inputs, size.drivers, size.batch_size, size.seed)
        episodes, _ = evaluate(strategy, *who, device=cfg.device)
        return {name: float(episodes[name].mean()) for name in (*MEANS, "collided")}

    return judge


def outdated(folder: Path, policies: list[Path]) -> bool:
    """Whether kept.parquet of a training is missing or lists other policies."""
    path = folder / KEPT
    numbers = [float(policy.stem) for policy in policies]
    return not path.exists() or read_parquet(path)["iteration"].tolist() != numbers


Part = tuple[
    Callable[[argparse.Namespace], list[Run]],
    Callable[[Path], pd.DataFrame],
    Callable[[Path], Figure],
]
PARTS: dict[str, Part] = {
    "agents": (runs_of_agents, table_of_agents, figure_of_agents),
    "knowledge": (runs_of_knowledge, table_of_knowledge, figure_of_knowledge),
    "limits": (runs_of_limits, table_of_limits, figure_of_limits),
}


def perform(part: str, options: argparse.Namespace) -> int:
    """Run the unfinished trainings, then write table and figure; 1 if a training failed."""
    plan, tabulate, draw = PARTS[part]
    failed = 0
    if not options.draw:
        outcomes = run_all([*plan(options), human(options)], options.jobs)
        wrong = [outcome for outcome in outcomes if outcome.status != FINISHED]
        for outcome in wrong:
            log.error("%s: %s: %s", outcome.run.folder, outcome.status, outcome.note)
        failed = int(bool(wrong))
        evaluate_kept(options)
        if part == "knowledge":
            evaluate_filtered(options)
    table = tabulate(options.out)
    write_parquet(table, options.out / f"{part}.parquet")
    save(draw(options.out), options.out / f"{part}.png")
    print(table.to_string(index=False, float_format="{:.4g}".format))
    if part == "limits":
        print(*comparisons(options.out, options.at), sep="\n")
    log.info("table and figure: %s", options.out / f"{part}.png")
    return failed


def parser() -> argparse.ArgumentParser:
    """Return the command line: a subcommand per comparison."""
    form = argparse.RawDescriptionHelpFormatter
    top = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    commands = top.add_subparsers(required=True, dest="part")
    for part in PARTS:
        one = commands.add_parser(part)
        one.add_argument("--out", type=Path, default=Path("outputs/compare") / part)
        one.add_argument("--seeds", type=int, default=3, help="trainings of each kind")
        one.add_argument("--jobs", type=int, default=2, help="trainings at a time")
        one.add_argument("--draw", action="store_true", help="only draw finished runs")
        if part == "agents":
            one.add_argument("--agents", type=words, default=list(AGENTS))
            one.add_argument("--variants", type=words, default=["alcc", "reference"])
        elif part == "knowledge":
            one.add_argument("--agent", default="analytic")
        else:
            one.add_argument("--variants", type=words, default=["alcc"])
            kinds = [NETWORK, "idm", "idm_gradient"]
            text = "also memory, preview (5 s), acc, acc_gradient"
            one.add_argument("--policies", type=words, default=kinds, help=text)
            one.add_argument("--shares", type=words, default=["0.005", "0.01", "0.02"])
            one.add_argument("--at", type=float, default=0.01, help="share at which to compare")
    return top


def words(text: str) -> list[str]:
    """Split a list with commas."""
    return text.split(",")


def main(arguments: list[str]) -> int:
    """Run a comparison and return the exit code."""
    options, overrides = parser().parse_known_args(arguments)
    check_overrides(overrides)
    require(options.jobs >= 1 and options.seeds >= 1, "--jobs and --seeds must be at least 1")
    options.overrides = overrides
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    return perform(options.part, options)


if __name__ == "__main__":
    sys.exit(main_guard(main)(sys.argv[1:]))
