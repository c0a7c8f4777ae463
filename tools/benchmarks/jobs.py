"""Benchmarks of updates, of whole trainings by them and by the gradient, and of evaluations."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from tensordict import TensorDictBase

from benchmarks.env import OTHER
from benchmarks.harness import Row, Run, alternate, endings, installed, rates, rows_of
from benchmarks.plain import alcc, study, training
from lcc_rl.agents import DDPG, SAC, TD3
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.agent import Scene
from lcc_rl.agents.analytic import GradientLoop
from lcc_rl.agents.collecting import LEARNED_FROM, transitions
from lcc_rl.agents.factory import build_agent, make_trainer, training_env
from lcc_rl.agents.off_policy import OffPolicy
from lcc_rl.agents.replay import Replay, ReplayLoop
from lcc_rl.config import load
from lcc_rl.envs import load_inputs
from lcc_rl.evaluation.episodes import Episodes, Plan
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.io.files import write_parquet

WIDTH = 20  # environments side by side
QUICK = ("scenario.horizon=20", "training.segment=20", "training.environments=8", "agent.warm_up=0")
OWN = "Analytic"


def train(options: Namespace) -> list[Row]:
    """Return the seconds per 1,000 (step + update) of DDPG, at one update per transition.

    "Trainer" is the package's own with 20 environments side by side, its bookkeeping included,
    checkpoints (one per 10 iterations) not; stable-baselines3's is ``DDPG.learn`` with the plain
    loop as one environment. Both learn in batches of 1,024 from a buffer of 20,000.
    """
    batch, steps = (32, 40) if options.quick else (1024, 300)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        runs: dict[str, Run] = {"Trainer": trainer(options, batch, steps, Path(folder))}
        if installed():
            runs[OTHER] = their_training(options, batch, steps)
        spent = alternate(runs, options.repeats)
        each = {name: seconds * 1000 / steps for name, seconds in spent.items()}
        return rows_of(each, "s", {"Trainer": [OTHER]}, batch)


def trainer(options: Namespace, batch: int, steps: int, folder: Path) -> Run:
    """Return one iteration of the package's training: so many transitions, updates for each."""
    sizes = {"environments": WIDTH, "segment": steps // WIDTH, "episodes": 10**6}
    cfg = study(options.quick)[0].with_(training={**sizes, "compiled": options.compile})
    env = alcc(options, WIDTH)
    env.base_env.horizon = steps // WIDTH  # episodes of one segment
    agent = DDPG(batch_size=batch, updates_per_transition=1.0)
    agent = agent.start(Scene(7))
    trained = ReplayLoop(agent, env, cfg.training, 0, folder, "benchmark")
    played = alcc(options, 100).rollout(20, break_when_any_done=False)
    trained.buffer.extend(transitions(played))
    collector = trained.source()
    return lambda: trained._numbers(collector)


def their_training(options: Namespace, batch: int, steps: int) -> Run:
    """Return ``DDPG.learn`` of stable-baselines3 for so many steps, after a start of no updates."""
    from benchmarks.theirs import PlainVector, their_agent

    how = {"train_freq": 1, "gradient_steps": 1, "batch_size": batch, "buffer_size": 20000}
    vector = PlainVector(training(options, 1), options.compile)
    model = their_agent(vector, "DDPG", learning_starts=batch, verbose=0, **how)
    model.learn(batch + 1)
    return lambda: model.learn(steps, reset_num_timesteps=False)


def analytic(options: Namespace) -> list[Row]:
    """Return iterations/s of the main job's training."""
    cfg = load("train", ["variant=alcc", "experiment=main", *(QUICK if options.quick else ())])
    cfg = cfg.with_(training={"compiled": options.compile})
    inputs = load_inputs(cfg)
    agent, profiles = build_agent(cfg, inputs.population), inputs.to_learn_from()
    agent.take(profiles)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder, torch.enable_grad():
        env = training_env(cfg, profiles, inputs.population)
        trainer = make_trainer(cfg, agent, env, Path(folder))
        assert isinstance(trainer, GradientLoop)
        own: Run = partial(trainer._numbers, trainer.source())
        batch = cfg.training.environments
        return rates(options, {OWN: own}, "iterations/s", 1, batch=batch, grad=True)


def evaluate(options: Namespace) -> list[Row]:
    """Return episodes per second of an untrained actor, rows and time series written."""
    cfg, inputs = study(options.quick)
    agent = build_agent(cfg, inputs.population)
    strategy = Strategy("untrained", cfg, shared_policy(agent.policy))
    settings, people = cfg.evaluation, len(inputs.population.time_gap)
    drivers = 2 if options.quick else settings.drivers
    plan = Plan(len(inputs.evaluation), people, drivers, settings.batch_size)
    how = (strategy, inputs, plan, settings.seed, settings.sample_episodes)
    rows: list[Row] = []
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        for ending in endings(options):
            episodes = Episodes(*how, compiled=bool(ending))
            run: Run = partial(written, episodes, Path(name))
            own = {f"evaluation{ending}": run}
            rows += rates(options, own, "episodes/s", len(plan), batch=plan.size)
    return rows


def written(episodes: Episodes, folder: Path) -> None:
    """Play all episodes and write their rows and time series."""
    for block in episodes.plan.own:
        rows, steps = episodes.play(block)
        write_parquet(rows, folder / f"{block}.parquet")
        write_parquet(steps, folder / f"{block}_steps.parquet")


# -- updates ---------------------------------------------------------------------------------------

AGENTS: tuple[type[OffPolicy], ...] = (DDPG, TD3, SAC)
SIZES = ((64, 60), (256, 40), (1024, 20))  # batch, updates of a repeat
FEW = ((16, 2), (32, 2))


def update(options: Namespace) -> list[Row]:
    """Return updates per second, beside those of stable-baselines3.

    All updates include drawing the batch from the buffer, all losses and backward passes, Adam
    and the soft target updates, all in single precision. stable-baselines3's is its ``train()``,
    which also writes its losses to its logger, once per call of many updates.
    """
    played = transitions(alcc(options, 1000).rollout(20, break_when_any_done=False))
    rows: list[Row] = []
    for kind, (batch, count) in product(AGENTS, FEW if options.quick else SIZES):
        agent = kind(batch_size=batch).start(Scene(7))
        own, other = f"{kind.__name__}.update", f"{OTHER} {kind.__name__}"
        runs: dict[str, Run] = {own: own_updates(agent, played, count)}
        if installed():
            model = their_update(options, agent, played)
            runs[other] = partial(model.train, count, batch)
        rows += rates(options, runs, "updates/s", count, {own: [other]}, batch, grad=True)
    return rows


def own_updates(agent: OffPolicy, played: TensorDictBase, count: int) -> Run:
    """Return so many of the agent's updates with batches from a buffer of its size."""
    generator = torch.Generator().manual_seed(0)
    buffer = Replay(agent.buffer_size, agent.batch_size, generator, agent.device)
    buffer.extend(played)
    return lambda: [agent.update(buffer.draw()) for _ in range(count)]


def their_update(options: Namespace, agent: OffPolicy, played: TensorDictBase) -> Any:
    """Return SB3's agent of that name with the same transitions in a buffer of the same size."""
    from stable_baselines3.common.logger import configure

    from benchmarks.theirs import PlainVector, their_agent

    vector = PlainVector(training(options, 1), compiled=False)
    how = {"batch_size": agent.batch_size, "buffer_size": agent.buffer_size}
    model = their_agent(vector, type(agent).__name__, **how)
    model.set_logger(configure(None, []))
    columns = [played[key].cpu().numpy() for key in list(LEARNED_FROM.values())[:5]]
    for seen, action, after, reward, done in zip(*columns, strict=True):
        model.replay_buffer.add(seen, after, action, reward, done, [{}])
    return model
