"""Upper bound of the saving: the best drive with knowledge of the whole profile.

    python tools/clairvoyant.py data=ngsim data.path=...          # beside idm and the policy
    python tools/clairvoyant.py --policy outputs/train/<run> --iterations 100 evaluation.drivers=3

Plans every held-out episode by the gradient through the simulator, starting from a learned
policy's actions, and evaluates the plan like any other strategy. Words that are no options are
overrides of the evaluation (data, drivers, split, evaluation, scenario, +filter); by default 12
drivers follow on each of 20 profiles.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

import pandas as pd
from rich.console import Console

from lcc_rl.commands.pipeline import root_key
from lcc_rl.config import load, require
from lcc_rl.envs import load_inputs
from lcc_rl.envs.inputs import string_of
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.clairvoyant import clairvoyant
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.strategies import baseline, trained
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.files import write_parquet
from lcc_rl.results.runs import load_policy
from lcc_rl.results.tables import as_rich, summary
from lcc_rl.runs.cli import main_guard, prepare_torch
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.studies.runner import check_overrides

DRIVERS = 12
OWN = ("variant", "policy", "compare", "seed", "knowledge", "agent", "observation", "reward")


def plan(options: argparse.Namespace, overrides: list[str]) -> pd.DataFrame:
    """Evaluate human driver, policy and plan; write and return the rows of episodes.parquet."""
    own = ["variant=alcc", f"evaluation.drivers={DRIVERS}"]
    cfg = load("evaluate", [*own, *overrides])
    require(cfg.device == "cpu", "tools/clairvoyant.py runs on device=cpu")
    prepare_torch(cfg)
    inputs, size = load_inputs(cfg), cfg.evaluation
    policy = load_policy(options.policy, cfg.variant, tuple(cfg.trust))
    if HUMAN not in string_of(policy[1]).names:
        raise ConfigError(
            f"--policy {options.policy} was trained as variant {policy[1].variant}, which has no "
            "human drivers; expected that of a car with a human behind, such as alcc"
        )
    learned = trained(cfg, options.policy, policy, inputs.population)
    with ProgressReporter("clairvoyant", options.iterations, folder=options.out) as progress:
        best = clairvoyant(
            learned,
            inputs,
            size.drivers,
            size.seed,
            options.iterations,
            not options.no_compile,
            progress.update,
        )
    batch = len(inputs.evaluation) * len(inputs.population.time_gap)
    rows = [
        evaluate(strategy, inputs, size.drivers, batch, size.seed)[0]
        for strategy in (baseline(cfg, "idm"), learned, best)
    ]
    episodes = pd.concat(rows, ignore_index=True)
    write_parquet(episodes, options.out / "episodes.parquet")
    return episodes


def main(arguments: list[str]) -> int:
    """Plan and print the table."""
    form = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("--policy", default="pretrained", help="start of the plan")
    parser.add_argument("--iterations", type=int, default=400)
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("outputs/clairvoyant"))
    options, overrides = parser.parse_known_args(arguments)
    for word in overrides:
        if root_key(word) in OWN:
            raise ConfigError(f"{word}: the controller is that of --policy, as it was trained")
    check_overrides(overrides)
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    table = summary(plan(options, overrides))
    Console().print(as_rich(table, "the whole profile known"))
    return 0


if __name__ == "__main__":
    sys.exit(main_guard(main)(sys.argv[1:]))
