"""Benchmark of the main job's training: an iteration by the simulator's gradient."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from benchmarks.harness import Row, Run, rates
from lcc_rl.agents.factory import build_agent, make_trainer, training_env
from lcc_rl.agents.gradient import GradientLoop
from lcc_rl.config import load
from lcc_rl.envs import load_inputs

QUICK = ("scenario.horizon=20", "training.segment=20", "training.environments=8", "agent.warm_up=0")
OWN = "Analytic"


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
        own: Run = partial(trainer._numbers, trainer._source())
        batch = cfg.training.environments
        return rates(options, {OWN: own}, "iterations/s", {OWN: 1}, {}, batch, grad=True)
