"""Entry point: evaluate a policy beside the human baselines, ``python -m lcc_rl.evaluate``."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
from omegaconf import DictConfig, OmegaConf

from lcc_rl.config import TARGET, load, plain, short_name
from lcc_rl.envs.factory import Inputs, build_agent, learns, load_inputs
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.evaluation import platoon_cases
from lcc_rl.evaluation.monte_carlo import Strategy
from lcc_rl.results.figures import write_study_figures
from lcc_rl.results.runs import PRETRAINED, differing, flatten, load_policy, save_config
from lcc_rl.runs.cli import entry_point, prepare_torch, run_folder
from lcc_rl.train import EPISODES, check_sizes, evaluate_and_write

log = logging.getLogger("lcc_rl")

BASELINES = ("direct", "idm")
Policy = tuple[dict[str, Any], DictConfig]  # weights and configuration
# What makes a baseline what it is; everything else it shares with the scenario under study.
OWN_SETTINGS = {("cav", "max_acceleration")}


def run(cfg: DictConfig, folder: str | Path, own: bool = True, quiet: bool = False) -> pd.DataFrame:
    """Evaluate a policy, those it is compared with, and the human baselines.

    All meet the same profiles, drivers and noise. Writes config.yaml, episodes.parquet,
    steps.parquet and figures.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        folder: where the files go.
        own: evaluate the configuration's own variant, not only what it is compared with.
        quiet: write the rows only: print no table, draw no figures.

    Returns:
        The rows of episodes.parquet.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.
    """
    folder = Path(folder)
    prepare_torch(cfg)
    check_sizes(cfg)
    if cfg.policy not in (None, PRETRAINED) and not learns(cfg):
        raise ConfigError(f"variant {cfg.variant} learns nothing: remove policy={cfg.policy}")
    if cfg.scenario.name == platoon_cases.SCENARIO:
        return platoon_cases.run(cfg, folder, quiet)
    # Before the data: a missing file should not be noticed after minutes of reading.
    trust = tuple(cfg.trust)
    policy = None if cfg.policy is None else load_policy(cfg.policy, cfg.variant, trust)
    compared = {path: load_policy(path, cfg.variant, trust) for path in cfg.compare}
    inputs = load_inputs(cfg)
    for line in inputs.report:
        log.info(line)
    strategies = [baseline(cfg, name, inputs) for name in BASELINES]
    strategies += [trained(cfg, path, compared[path], inputs) for path in cfg.compare]
    if own and cfg.variant not in BASELINES:
        strategies.append(studied(cfg, policy, inputs))
    strategies = named_apart(strategies)
    check_distinct(strategies)
    # The rows of an earlier evaluation must never stand beside the configuration of this one.
    (folder / EPISODES).unlink(missing_ok=True)
    save_config(cfg, folder)
    episodes = evaluate_and_write(strategies, cfg, inputs, folder, quiet)
    if not quiet:
        write_study_figures(folder)
    return episodes


def named_apart(strategies: Sequence[Strategy]) -> list[Strategy]:
    """Add its agent to the name of a variant that more than one kind of agent has learned."""
    named = [(strategy.name, short_name(strategy.cfg.agent[TARGET])) for strategy in strategies]
    learned_by = Counter(name for name, _ in set(named))
    return [
        replace(strategy, name=f"{name} {agent}") if learned_by[name] > 1 else strategy
        for strategy, (name, agent) in zip(strategies, named, strict=True)
    ]


def check_distinct(strategies: Sequence[Strategy]) -> None:
    """Refuse two policies that no row could tell apart.

    Raises:
        ConfigError: naming the variant and the seed.
    """
    seen = set()
    for strategy in strategies:
        key = (strategy.name, strategy.seed)
        if key in seen:
            seed = "" if strategy.seed is None else f" with training seed {strategy.seed}"
            raise ConfigError(
                f"policy and compare name two policies of variant {strategy.name}{seed}; their "
                "rows could not be told apart: evaluate them one after the other"
            )
        seen.add(key)


def baseline(cfg: DictConfig, variant: str, inputs: Inputs) -> Strategy:
    """Build a human baseline in the scenario under study."""
    if cfg.variant != variant:
        studied, cfg = cfg, load("evaluate", [f"variant={variant}"])
        share_scenario(studied, cfg)
    return Strategy(variant, cfg, build_agent(cfg, inputs.population, cfg.device).policy)


def share_scenario(cfg: DictConfig, other: DictConfig) -> None:
    """Give another variant the clock and the pieces' numbers of the scenario under study."""
    OmegaConf.set_struct(other, False)
    for key in ("horizon", "time_step", "followers"):
        other.scenario[key] = cfg.scenario[key]
    for name, node in other.scenario.pieces.items():
        for key, value in (cfg.scenario.pieces.get(name) or {}).items():
            # The shape of an entry follows the number of followers.
            shared = isinstance(value, (int, float)) or key == "event_shape"
            if node is not None and shared and (name, key) not in OWN_SETTINGS:
                node[key] = value


def share_filter(cfg: DictConfig, other: DictConfig) -> None:
    """Give another trained car the filter of the one under study; without one it keeps its own."""
    node, pieces = cfg.scenario.pieces.get("barrier"), other.scenario.pieces
    if node is None or "cav" not in pieces:
        return
    obedient = {**pieces.cav, "obeys": cfg.scenario.pieces.cav.obeys}
    # It acts before the car, and the order of the pieces is that of the file.
    names = [name for name in pieces if name != "barrier"]
    names.insert(names.index("cav"), "barrier")
    changed = {"barrier": node, "cav": obedient}
    given = {name: changed[name] if name in changed else pieces[name] for name in names}
    other.scenario.pieces = given


def studied(cfg: DictConfig, policy: Policy | None, inputs: Inputs) -> Strategy:
    """Build the strategy that the configuration asks for.

    Raises:
        ConfigError: if it needs a policy and none is given, or the policy is of another variant.
    """
    agent = build_agent(cfg, inputs.population, cfg.device)
    if not agent.learns:
        return Strategy(cfg.variant, cfg, agent.policy)
    if policy is None:
        raise ConfigError(
            f"variant {cfg.variant} is learned: give policy=<run folder or policy.pt> "
            f"(python -m lcc_rl.train variant={cfg.variant} makes one) or policy=pretrained"
        )
    weights, own = policy
    if own.variant != cfg.variant:
        raise ConfigError(
            f"policy={cfg.policy} was trained as variant {own.variant}, not {cfg.variant}; "
            f"say variant={own.variant}"
        )
    trained_with, observed = (
        dict(flatten(plain(node))) for node in (own.observation, cfg.observation)
    )
    changes = [
        f"observation.{key}: {trained_with.get(key)}, got {observed.get(key)}"
        for key in differing(trained_with, observed)
    ]
    if changes:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another observation than this: expected "
            f"{'; '.join(changes)}; say +knowledge=… and observation.… as in its training"
        )
    remembered, asked = (node.scenario.pieces.get("memory") for node in (own, cfg))
    if remembered != asked:
        raise ConfigError(
            f"policy={cfg.policy} was trained with another memory than this: "
            f"expected scenario.pieces.memory={remembered}, got {asked}"
        )
    cfg = cfg.copy()
    OmegaConf.set_struct(cfg, False)
    cfg.agent = own.agent
    if cfg.scenario.pieces.get("barrier") is None and own.scenario.pieces.get("barrier"):
        log.info("policy=%s was trained with a filter and keeps it", cfg.policy)
        share_filter(own, cfg)
    return with_weights(cfg, weights, own.seed, str(cfg.policy), inputs)


def trained(cfg: DictConfig, path: str, policy: Policy, inputs: Inputs) -> Strategy:
    """Build a trained strategy from the policy read from a file, in the scenario under study."""
    weights, own = policy[0], policy[1].copy()
    own.device = cfg.device
    share_scenario(cfg, own)
    share_filter(cfg, own)
    return with_weights(own, weights, own.seed, path, inputs)


def with_weights(
    cfg: DictConfig, weights: dict[str, object], seed: int, path: str, inputs: Inputs
) -> Strategy:
    """Build a strategy and load its policy's weights.

    Raises:
        ResultsError: if the weights do not fit the network.
    """
    agent = build_agent(cfg, inputs.population, cfg.device)
    try:
        agent.policy.load_state_dict(weights)
    except RuntimeError as error:
        raise ResultsError(f"{path}: the weights do not fit the policy network: {error}") from error
    return Strategy(cfg.variant, cfg, agent.policy, seed)


@entry_point("evaluate")
def main(cfg: DictConfig) -> None:
    """Evaluate into the run's folder."""
    folder = run_folder()
    run(cfg, folder)
    log.info("results in %s", folder)


if __name__ == "__main__":
    main()
