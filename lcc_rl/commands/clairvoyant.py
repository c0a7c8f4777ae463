"""Upper bound of the saving, and of the benefit of regard for the drivers behind.

    lcc-rl clairvoyant data=ngsim data.path=...   # with idm and the policy
    lcc-rl clairvoyant --policy outputs/train/<run> evaluation.drivers=3
    lcc-rl clairvoyant --regard --policy pretrained --iterations 100

Every held-out episode is planned by the gradient through the simulator, with knowledge of the whole
profile. The plan starts from the actions of a learned policy and is evaluated as a strategy. With
several policies the best plan of each episode counts. With --regard a second plan minimises the
car's own energy only; the saving of the first plan against it, in the energy of all vehicles, is an
upper bound of the benefit of regard. Further words are overrides of the evaluation (data, leader,
drivers, split, evaluation, scenario, +filter, task); by default 12 drivers follow on each of 20
profiles. With task=i24-mixed a whole fleet is planned at the flow of the learned one.
"""

from __future__ import annotations

import logging
from argparse import Namespace
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count
from pathlib import Path

import pandas as pd
from rich.console import Console

from lcc_rl.commands.evaluation import show_tables
from lcc_rl.config import load
from lcc_rl.config.schemas import EvaluateConfig
from lcc_rl.config.words import check_overrides
from lcc_rl.envs import load_inputs
from lcc_rl.envs.inputs import Inputs
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.clairvoyant import BOUND_BOTH, BOUND_OWN, clairvoyant
from lcc_rl.evaluation.entrants import check_distinct
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.fit import task_of
from lcc_rl.evaluation.strategies import Strategy, baseline, trained
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.io.atomic import own_folder
from lcc_rl.io.files import write_parquet
from lcc_rl.results.names import in_words
from lcc_rl.results.policies import load_policy
from lcc_rl.results.runs import EPISODES
from lcc_rl.results.windows import savings
from lcc_rl.runs.arguments import Arguments, typed
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.progress import ProgressReporter
from lcc_rl.runs.states import PROGRESS, claim
from lcc_rl.settings import Million, Positive

DRIVER_COUNT = 12
BLOCK = 1_000_000  # vehicles × steps of parallel plans: some GiB
SET_BY_BOUND = (
    *("variant", "policy", "compare", "safety", "seed", "knowledge"),
    *("agent", "observation", "reward"),
)
PATH_ENERGY = {BOUND_BOTH: "total_path_energy_kj", BOUND_OWN: "cav_path_energy_kj"}
KEYS = ["profile_id", "driver_id"]


def plan(options: Namespace, cfg: EvaluateConfig, inputs: Inputs, folder: Path) -> pd.DataFrame:
    """Evaluate human driver, policies and plans; write and return the rows of episodes.parquet."""
    learned = [initial_strategy(cfg, path, inputs) for path in options.policy or ["pretrained"]]
    check_distinct(learned)
    pieces = list(blocks(inputs, cfg))
    work = len(pieces) * len(learned) * (1 + options.regard) * options.iterations
    tables, done = [], count(1)
    with ProgressReporter("clairvoyant", work, folder=folder) as progress:

        def update(_: int, values: dict[str, float]) -> None:
            progress.update(next(done), values)

        for first, block in pieces:
            rows = pd.concat(block_rows(cfg, learned, block, options, update))
            rows["profile_id"] += first
            tables.append(rows)
    episodes = pd.concat(tables, ignore_index=True)
    write_parquet(episodes, folder / EPISODES)
    return episodes


def initial_strategy(cfg: EvaluateConfig, path: str, inputs: Inputs) -> Strategy:
    """Read the initial policy."""
    policy = load_policy(path, cfg.variant, tuple(cfg.trust))
    if HUMAN not in policy[1].scenario.vehicles.names:
        raise ConfigError(
            f"--policy {path} was trained as variant {policy[1].variant}, which has no human "
            "drivers; expected that of a car with a human behind, such as alcc"
        )
    return trained(cfg, path, policy, inputs.population)


def blocks(inputs: Inputs, cfg: EvaluateConfig) -> Iterator[tuple[int, Inputs]]:
    """Yield the windows in blocks that fit into memory, each with the index of its first one."""
    people = len(inputs.population.time_gap)
    episodes = min(cfg.evaluation.drivers or people, people)
    size = max(BLOCK // (episodes * len(cfg.scenario.vehicles) * cfg.scenario.horizon), 1)
    for first in range(0, len(inputs.evaluation), size):
        chosen = range(first, min(first + size, len(inputs.evaluation)))
        yield first, replace(inputs, evaluation=inputs.evaluation.select(chosen))


def block_rows(
    cfg: EvaluateConfig,
    learned: list[Strategy],
    block: Inputs,
    options: Namespace,
    update: Callable[[int, dict[str, float]], None],
) -> Iterator[pd.DataFrame]:
    """Yield the rows of all strategies for a block of windows."""
    size = cfg.evaluation
    batch = len(block.evaluation) * len(block.population.time_gap)
    hold = round(options.hold / cfg.scenario.time_step)

    def drive(strategy: Strategy) -> pd.DataFrame:
        return evaluate(strategy, block, size.drivers, batch, size.seed)[0]

    task = task_of(cfg)
    rival = baseline(cfg, task.against if task else "idm")
    yield from (drive(strategy) for strategy in (rival, *learned))
    for alone in (False, True) if options.regard else (False,):
        how = size.drivers, size.seed, options.iterations, not options.no_compile, alone, hold
        plans = [clairvoyant(strategy, block, *how, update) for strategy in learned]
        yield best([drive(planned) for planned in plans])


def best(plans: list[pd.DataFrame]) -> pd.DataFrame:
    """Return the plan with the lowest objective of every episode, without a collision if any is."""
    together = pd.concat(plans, ignore_index=True)
    energy = PATH_ENERGY[str(together["strategy"].iloc[0])]
    ranked = together.sort_values([*KEYS, "collided", energy], kind="stable")
    return ranked.drop_duplicates(KEYS, ignore_index=True)


def regard(episodes: pd.DataFrame) -> str:
    """Return a sentence on the largest saving by regard for the drivers behind."""
    saved = savings(episodes, PATH_ENERGY[BOUND_BOTH], BOUND_BOTH, BOUND_OWN)
    energy = episodes.groupby("strategy")[PATH_ENERGY[BOUND_BOTH]].mean()
    rival = str(episodes["strategy"].iloc[0])
    share = (energy[BOUND_OWN] - energy[BOUND_BOTH]) / energy[rival]
    return (
        f"With plans for all vehicles, their path energy is {100 * saved.value:.2f} % lower than "
        f"with plans for the car only (95 % interval over windows: {100 * saved.low:.2f} … "
        f"{100 * saved.high:.2f}); {share:.2%} of that with {in_words(rival)}."
    )


def main(arguments: list[str]) -> int:
    """Plan and print the table."""
    parser = Arguments(description=__doc__)
    parser.add_argument("--policy", action="append", help="initial policy (pretrained)")
    parser.add_argument("--regard", action="store_true", help="also plan for the car only")
    parser.add_argument("--iterations", type=typed(Million), default=400)
    parser.add_argument("--hold", type=typed(Positive), default=0.1, help="duration of a shift [s]")
    parser.add_argument("--no-compile", action="store_true")
    parser.add_argument("--out", type=Path, default=Path("outputs/clairvoyant"))
    options, overrides = parser.parse_known_args(arguments)
    check_overrides(overrides, SET_BY_BOUND, "the controller is that of --policy")
    logging.basicConfig(level=logging.INFO, format="[%(asctime)s] %(message)s", datefmt="%H:%M:%S")
    cfg = load("evaluate", ["variant=alcc", *overrides])
    cfg = cfg.with_(evaluation={"drivers": cfg.evaluation.drivers or DRIVER_COUNT})
    require(cfg.device == "cpu", "lcc-rl clairvoyant runs on device=cpu")
    require(cfg.scenario.slope is None, "lcc-rl clairvoyant: plans know no slopes")
    least = cfg.scenario.time_step
    require(options.hold >= least, f"--hold={options.hold:g} is shorter than a step, {least:g} s")
    folder = own_folder(options.out, {PROGRESS}.issuperset)
    prepare_torch(cfg)
    with claim(folder):
        inputs = load_inputs(cfg)
        episodes = plan(options, cfg, inputs, folder)
    show_tables(episodes, cfg, inputs)
    if options.regard:
        Console().print(regard(episodes), highlight=False)
    return 0
