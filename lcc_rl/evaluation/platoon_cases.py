"""Platoon evaluation: every strategy through the same cases, held-out windows and whole record."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from lcc_rl.config import build, load, plain
from lcc_rl.data.cycles import Case
from lcc_rl.envs.factory import Inputs, build_agent, build_env, build_policy, learns, load_inputs
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.evaluation.monte_carlo import Strategy
from lcc_rl.io.files import write_parquet
from lcc_rl.pieces.base import SEED
from lcc_rl.policies import CACCPolicy, DeadBeatPolicy
from lcc_rl.policies.hcfs import COUNTERS, HYBRID
from lcc_rl.results.runs import identity, load_policy, save_config
from lcc_rl.results.string_figures import write_platoon_figures
from lcc_rl.results.string_tables import as_rich, case_table
from lcc_rl.results.tables import show

log = logging.getLogger("lcc_rl")

SCENARIO = "platoon"
LEARNED = "ddpg"  # whose pretrained policy the variants of the platoon share
GAINS = ("path", "paper_like", "tuned")
WINDOWS = "windows"
PLATOON = ("speed", "gap", "acceleration", "jerk", "speed_error", "leader_speed_error")
# Settings that make training start and drive unlike the record; evaluation drives it as it is.
NOMINAL = {"leader": ("perturbation",), "platoon": ("gap_spread", "speed_spread")}
Series = dict[str, Tensor]


# -- strategies ------------------------------------------------------------------------------------


def run(cfg: DictConfig, folder: Path, quiet: bool = False) -> pd.DataFrame:
    """Evaluate the variant of a configuration beside the yardsticks, and draw the figures.

    Writes config.yaml, episodes.parquet, steps.parquet and figures.

    Args:
        cfg: configuration of the entry point ``evaluate``, of a variant of the platoon.
        folder: where the files go.
        quiet: do not print the tables.

    Returns:
        The rows of episodes.parquet: one per strategy, run and follower.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.
    """
    inputs = load_inputs(cfg)
    for line in inputs.report:
        log.info(line)
    strategies = [*yardsticks(cfg), *(trained(cfg, path, inputs) for path in cfg.compare)]
    strategies += studied(cfg, inputs)
    save_config(cfg, folder)
    episodes = evaluate_and_write(strategies, cfg, inputs, folder, quiet)
    write_platoon_figures(folder)
    return episodes


def yardsticks(cfg: DictConfig) -> list[Strategy]:
    """Build what every platoon is compared with: CACC with each set of gains, and dead-beat."""
    step, limit = cfg.scenario.time_step, cfg.scenario.pieces.platoon.max_acceleration
    rules = [
        Strategy(f"cacc {name}", cfg, CACCPolicy(step, limit, **named_gains(name)))
        for name in GAINS
    ]
    beats = [("deadbeat", "causal"), ("deadbeat oracle", "oracle")]
    return rules + [Strategy(name, cfg, DeadBeatPolicy(step, limit, mode)) for name, mode in beats]


def named_gains(name: str) -> dict[str, Any]:
    """Return one of the shipped sets of gains."""
    return dict(plain(load("evaluate", ["variant=cacc", f"gains={name}"]).gains))


def studied(cfg: DictConfig, inputs: Inputs) -> list[Strategy]:
    """Build the variant asked for and, of a hybrid, its parents and its oracle, too.

    Raises:
        ConfigError: if it needs a policy and none is given, or the policy does not fit.
    """
    if not learns(cfg):
        shipped = [Strategy(s.name, cfg, s.policy) for s in yardsticks(cfg)]
        own = build_agent(cfg, inputs.population, cfg.device).policy
        known = any(_same(own, strategy.policy) for strategy in shipped)
        return [] if known else [Strategy(cfg.variant, cfg, own)]
    if cfg.policy is None:
        raise ConfigError(
            f"variant {cfg.variant} is learned: give policy=<run folder or policy.pt> "
            f"(python -m lcc_rl.train variant={cfg.variant} makes one) or policy=pretrained"
        )
    agent, own = load_learned(cfg, inputs)
    if cfg.controller is None:
        return [Strategy(cfg.variant, cfg, agent.policy, own.seed)]
    return hybrids(cfg, agent.policy, own.seed)


def _same(one: Any, other: Any) -> bool:
    """Whether two rules of the yardsticks' kinds do the same."""
    return type(one) is type(other) and all(
        getattr(one, key, None) == getattr(other, key, None) for key in ("gains", "lookahead")
    )


def changed(cfg: DictConfig, **settings: Any) -> DictConfig:
    """Return a configuration with other settings of its controller."""
    cfg = cfg.copy()
    for name, value in settings.items():
        cfg.controller[name] = value
    return cfg


def hybrids(cfg: DictConfig, learned: Any, seed: int | None) -> list[Strategy]:
    """Build a hybrid strategy, the parents it is composed of, and its oracle."""
    step, limit = cfg.scenario.time_step, cfg.scenario.pieces.platoon.max_acceleration
    oracle = changed(cfg, lookahead="oracle")
    rule = build(cfg.controller.rule, "controller.rule", time_step=step, max_acceleration=limit)
    known = any(_same(rule, strategy.policy) for strategy in yardsticks(cfg))
    return [
        *([] if known else [Strategy("cacc", cfg, rule)]),
        Strategy(LEARNED, cfg, learned, seed),
        Strategy(cfg.variant, cfg, build_policy(cfg, learned), seed),
        Strategy(f"{cfg.variant} oracle", oracle, build_policy(oracle, learned), seed),
    ]


def load_learned(cfg: DictConfig, inputs: Inputs) -> tuple[Any, DictConfig]:
    """Build the agent that ``cfg.policy`` holds, whichever variant of the platoon trained it.

    Returns:
        The agent with its weights, and the configuration that it was trained with.

    Raises:
        ConfigError: if the policy is of another scenario or observation.
        ResultsError: if it is missing or damaged.
    """
    weights, own = load_policy(cfg.policy, LEARNED, tuple(cfg.get("trust") or ()))
    name = own.get("scenario", {}).get("name")
    if name != SCENARIO:
        raise ConfigError(
            f"policy={cfg.policy} was trained as variant {own.variant}, in the scenario {name}, "
            f"not for a {SCENARIO}"
        )
    if own.observation.scales != OmegaConf.create(plain(cfg.observation.scales)):
        raise ConfigError(f"policy={cfg.policy} was trained with another observation than this")
    cfg = cfg.copy()
    OmegaConf.set_struct(cfg, False)
    cfg.agent = own.agent
    agent = build_agent(cfg, inputs.population, cfg.device)
    try:
        agent.policy.load_state_dict(weights)
    except RuntimeError as error:
        raise ResultsError(
            f"{cfg.policy}: the weights do not fit the policy network: {error}"
        ) from error
    return agent, own


def trained(cfg: DictConfig, path: str, inputs: Inputs) -> Strategy:
    """Build a strategy to compare with, as it was trained, in the scenario under study."""
    other = cfg.copy()
    OmegaConf.set_struct(other, False)
    other.policy = path
    agent, own = load_learned(other, inputs)
    other.controller = own.get("controller")
    return Strategy(str(own.variant), other, build_policy(other, agent.policy), own.seed)


# -- playing ---------------------------------------------------------------------------------------


def nominal(cfg: DictConfig, followers: int, horizon: int) -> DictConfig:
    """Return the configuration of an evaluation run: the record as it is, gaps at equilibrium."""
    cfg = cfg.copy()
    cfg.scenario.followers, cfg.scenario.horizon = followers, horizon
    for piece, settings in NOMINAL.items():
        for setting in settings:
            if setting in cfg.scenario.pieces[piece]:
                cfg.scenario.pieces[piece][setting] = 0.0
    return cfg


def play(strategy: Strategy, case: Case, inputs: Inputs, device: str = "cpu") -> Series:
    """Drive a strategy behind every record of a case, side by side.

    Returns:
        ``leader`` and ``speed`` ``[time + 1, …]``; gap, acceleration, jerk, errors, reward and,
        of a hybrid, winner and counters ``[time, …]``: each ``[time, records, followers]``,
        ``leader`` ``[time + 1, records]``.
    """
    cfg = nominal(strategy.cfg, case.followers, case.horizon)
    env = build_env(cfg, case.profile, inputs.population, len(case.profile), 0, device)
    return roll(env, strategy.policy)


def roll(env: TransformedEnv, policy: Any) -> Series:
    """Play every profile of an environment from its start; see :func:`play`."""
    episodes = torch.arange(env.batch_size[0], device=env.device).unsqueeze(-1)
    given = TensorDict(batch_size=env.batch_size, device=env.device)
    given.set(SEED, episodes)
    given.set(("leader", "profile"), episodes)
    given.set(("leader", "start"), torch.zeros_like(episodes))
    record: dict[str, list[Tensor]] = {}
    with torch.no_grad():
        td = env.reset(given)
        record["leader"], record["speed"] = [td["leader", "speed"]], [td["platoon", "speed"]]
        for _ in range(env.base_env.horizon):
            td = env.step(policy(td))
            for name, value in _seen(td):
                record.setdefault(name, []).append(value)
            td = step_mdp(td)
    return {name: torch.stack(values).squeeze(-1) for name, values in record.items()}


def _seen(td: TensorDictBase) -> Iterator[tuple[str, Tensor]]:
    """Yield what is recorded of one step."""
    yield "leader", td["next", "leader", "speed"]
    yield "reward", td["next", "reward"]
    for name in PLATOON:
        yield name, td["next", "platoon", name]
    if (HYBRID, "winner") in td.keys(True):
        for name in ("winner", *COUNTERS):
            yield name, td[HYBRID, name]


# -- measuring -------------------------------------------------------------------------------------


def measure(series: Series) -> pd.DataFrame:
    """Turn a record into one row per run and follower.

    Speed errors are e_v(i,0), as in the paper's tables; ``energy_ratio`` is that of
    Σ e_v(i,i−1)² to the same of the vehicle ahead (string stability: at most 1), missing for the
    first follower and where nothing moves.
    """
    error, jerk = series["leader_speed_error"].abs(), series["jerk"].abs()
    energy = series["speed_error"].square().sum(0)
    ratio = torch.full_like(energy, torch.nan)
    ahead = energy[..., :-1]
    ratio[..., 1:] = torch.where(ahead > 1e-3, energy[..., 1:] / ahead.clamp(min=1e-3), torch.nan)
    columns = {
        "speed_error_sum": error.sum(0),
        "speed_error_squares": error.square().sum(0),
        "jerk_sum": jerk.sum(0),
        "jerk_squares": jerk.square().sum(0),
        "reward": series["reward"].sum(0),
        "min_gap_m": series["gap"].amin(0),
        "peak_jerk_mps3": jerk.amax(0),
        "energy_ratio": ratio,
    }
    if "winner" in series:
        columns["learned_share"] = series["winner"].double().mean(0)
        columns |= {name: series[name][-1] for name in COUNTERS}
    runs, followers = energy.shape
    frame = pd.DataFrame({name: value.flatten().cpu().numpy() for name, value in columns.items()})
    frame.insert(0, "run_id", np.repeat(np.arange(runs), followers))
    frame.insert(1, "follower", np.tile(np.arange(1, followers + 1), runs))
    frame["collided"] = frame["min_gap_m"] <= 0.0
    frame["frames"] = len(jerk)
    return frame


def trace(series: Series, time_step: float) -> pd.DataFrame:
    """Return the time series of the first run: a row per moment and vehicle, the leader's as 0."""
    leader = series["leader"][1:, :1, None]
    steps, followers = series["jerk"].shape[0], series["jerk"].shape[2]
    columns = {"speed_mps": torch.cat([leader, series["speed"][1:, :1]], dim=2)}
    for name, label in (
        ("gap", "gap_m"),
        ("acceleration", "acceleration_mps2"),
        ("jerk", "jerk_mps3"),
        ("winner", "winner"),
    ):
        if name in series:
            own = series[name][:, :1].to(leader.dtype)
            columns[label] = torch.cat([torch.full_like(leader, torch.nan), own], dim=2)
    frame = pd.DataFrame({name: value.flatten().cpu().numpy() for name, value in columns.items()})
    frame.insert(0, "time_s", np.repeat(np.arange(1, steps + 1) * time_step, followers + 1))
    frame.insert(1, "follower", np.tile(np.arange(followers + 1), steps))
    return frame


def evaluate(
    strategy: Strategy, cfg: DictConfig, inputs: Inputs
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Drive one strategy through everything.

    Returns:
        One row per run and follower, and the time series of the cases.
    """
    cases = [*inputs.cases, Case(WINDOWS, inputs.evaluation, cfg.scenario.followers)]
    if cfg.evaluation.full_length and inputs.full_length is not None:
        cases.append(inputs.full_length)
    rows, steps = [], []
    for case in cases:
        series = play(strategy, case, inputs, cfg.device)
        frame = measure(series)
        frame.insert(0, "strategy", strategy.name)
        seeds = pd.Series([strategy.seed] * len(frame), dtype="Int64")
        frame.insert(1, "training_seed", seeds)
        frame.insert(2, "case", case.name)
        frame.insert(3, "profile", [case.profile.names[i] for i in frame["run_id"]])
        frame.insert(4, "followers", case.followers)
        rows.append(frame)
        if case in inputs.cases:
            drawn = trace(series, cfg.scenario.time_step)
            drawn.insert(0, "strategy", strategy.name)
            drawn.insert(1, "case", case.name)
            steps.append(drawn)
    return (
        pd.concat(rows, ignore_index=True),
        pd.concat(steps, ignore_index=True) if steps else pd.DataFrame(),
    )


def evaluate_and_write(
    strategies: list[Strategy], cfg: DictConfig, inputs: Inputs, folder: Path, quiet: bool = False
) -> pd.DataFrame:
    """Drive all strategies, write episodes.parquet and steps.parquet and print the tables."""
    results = [evaluate(strategy, cfg, inputs) for strategy in strategies]
    episodes = pd.concat([rows for rows, _ in results], ignore_index=True)
    steps = pd.concat([rows for _, rows in results], ignore_index=True)
    metadata = {"lcc_rl.config": identity(cfg)}
    write_parquet(episodes, folder / "episodes.parquet", metadata)
    write_parquet(steps, folder / "steps.parquet", metadata)
    if not quiet:
        for case in dict.fromkeys(episodes["case"]):
            show(as_rich(case_table(episodes, case), case))
    return episodes
