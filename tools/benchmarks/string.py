"""Benchmark of long strings of vehicles, and of one beside SUMO."""

from __future__ import annotations

from argparse import Namespace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

from tensordict import TensorDict

from benchmarks.env import ways
from benchmarks.harness import Row, Run, agree, endings, rates
from benchmarks.sumo import start
from lcc_rl.config import load
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.evaluation.rollout import Player
from lcc_rl.interfaces.sumo import load_sumo

SIZE, SUMO = 100, "libsumo"


def string(options: Namespace) -> list[Row]:
    """Return vehicle-steps per second of strings of 100 vehicles.

    First a batch behind automated vehicles that keep their speed, with the estimate of every
    driver and the reward, by the training's collector, beside the same physics as one function of
    tensors. Then a single ring of human drivers by the evaluation's player, which keeps speeds and
    gaps, beside SUMO, which drives its own IDM and keeps nothing.
    """
    return [*batch(options), *ring(options)]


def batch(options: Namespace) -> list[Row]:
    """Return the rows of many strings side by side."""
    count, steps = (4, 10) if options.quick else (1024, 30)
    rows: list[Row] = []
    for ending in endings(options):
        own, other = f"StringCollector{ending}", f"plain loop{ending}"
        every = ways(options, count, steps, ending, SIZE - 1)
        runs = {name: every[name] for name in (own, other)}
        moved = count * steps * SIZE
        rows += rates(options, runs, "vehicle-steps/s", moved, {own: [other]}, count)
    return rows


def ring(options: Namespace) -> list[Row]:
    """Return the rows of one ring; both are first checked to reach the same speeds."""
    steps, around = 20 if options.quick else 600, 23.0 * SIZE
    size = [f'scenario.string="human*{SIZE}"', f"scenario.circumference={around}"]
    fixed = [f"scenario.horizon={steps}"]
    fixed += [f"scenario.controllers.human.{noise}=0" for noise in ("noise", "wiener")]
    cfg = load("evaluate", ["variant=idm", "scenario=ring", "drivers=fixed", *size, *fixed])
    inputs, key = load_inputs(cfg), ("vehicles", "speed")
    runs: dict[str, Run] = {}
    for ending in endings(options):
        env = build_env(cfg, inputs.evaluation, inputs.population, 1)
        player = Player(env, None, [key, ("vehicles", "gap")], compiled=bool(ending))
        runs[f"Player{ending}"] = partial(player.play, TensorDict(batch_size=[1]))
    against = {name: [SUMO] for name in runs}
    speed = player.play(TensorDict(batch_size=[1]))[0][key][-1]
    how = "vehicle-steps/s", steps * SIZE, against, 1
    if find_spec("libsumo") is None:
        return rates(options, runs, *how)
    sumo = load_sumo()

    def simulate() -> None:
        for _ in range(steps):
            sumo.simulationStep()

    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        start(cfg, Path(name), around)
        try:
            simulate()
            theirs = [sumo.vehicle.getSpeed(f"car{number}") for number in range(SIZE)]
            agree("SUMO's speed [m/s]", theirs, speed.flatten(), 1e-3)
            return rates(options, {**runs, SUMO: simulate}, *how)
        finally:
            sumo.close()
