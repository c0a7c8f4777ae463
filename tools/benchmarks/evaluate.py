"""Benchmark of the Monte Carlo evaluation, its results written."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.harness import TOLERANCE, Row, Run, agree, endings, rates
from benchmarks.plain import PlainLoop, study
from lcc_rl.agents.actor import shared_policy
from lcc_rl.agents.factory import build_agent
from lcc_rl.evaluation.episodes import Episodes, Plan
from lcc_rl.evaluation.metrics import LONG_TIME_GAP, PACE, UNSAFE_TTC
from lcc_rl.evaluation.rollout import reset_options
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.idm import idm_acceleration
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.power import acceleration_loss, motor_power, steady_power
from lcc_rl.functional.random import uniform
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.io.files import write_parquet

Sums = dict[str, Tensor]


def evaluate(options: Namespace) -> list[Row]:
    """Return episodes per second of an untrained actor, rows and time series written.

    The plain loop runs the same network and physics, adds up the same measures as it goes and
    writes nothing.
    """
    cfg, inputs = study(options.quick)
    agent = build_agent(cfg, inputs.population, options.device)
    strategy = Strategy("untrained", cfg, shared_policy(agent.policy))
    settings, people = cfg.evaluation, len(inputs.population.time_gap)
    drivers = 2 if options.quick else settings.drivers
    plan = Plan(len(inputs.evaluation), people, drivers, settings.batch_size)
    how = (strategy, inputs, plan, settings.seed, settings.sample_episodes, options.device)
    rows: list[Row] = []
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        for ending in endings(options):
            episodes = Episodes(*how, compiled=bool(ending))
            env = episodes.player.env
            given = reset_options(env, *plan.episodes(0)[:2], settings.seed, plan.population)
            plain = PlainEvaluation(env, agent.policy.module, bool(ending))
            check(episodes, plain, given)
            own, other = f"evaluation{ending}", f"plain loop{ending}"
            runs: dict[str, Run] = {
                own: partial(written, episodes, Path(name)),
                other: partial(plain.measure, given),
            }
            counts = dict.fromkeys(runs, len(plan))
            rows += rates(options, runs, "episodes/s", counts, {own: [other]}, plan.size)
    return rows


def written(episodes: Episodes, folder: Path) -> None:
    """Play all episodes and write their rows and time series."""
    for block in episodes.plan.own:
        rows, steps = episodes.play(block)
        write_parquet(rows, folder / f"{block}.parquet")
        write_parquet(steps, folder / f"{block}_steps.parquet")


def check(episodes: Episodes, plain: PlainEvaluation, given: TensorDictBase) -> None:
    """Hold what the plain loop adds up against the rows of the evaluation."""
    rows, sums = episodes.play(0)[0], plain.measure(given)
    for name in ("cav_path_energy_kj", "hdv_energy_kj", "min_gap_m", "share_time_gap_long"):
        expected = torch.from_numpy(rows[name].to_numpy(copy=True))
        own = sums[name].cpu().flatten()[: len(expected)]
        tolerance = 10.0 * TOLERANCE * max(1.0, float(expected.abs().max()))
        agree(f"{name} of the plain evaluation", own, expected, tolerance)


class PlainEvaluation(PlainLoop):
    """A Monte Carlo evaluation as one would write it by hand for this one string of vehicles.

    Args:
        env: an ALCC environment with one human follower, whose settings and data it shares.
        network: from observation to action.
        compiled: compile the step.
    """

    def __init__(
        self, env: TransformedEnv, network: Callable[[Tensor], Tensor], compiled: bool
    ) -> None:
        super().__init__(env)
        self.env, self.network, self.horizon = env, network, env.base_env.horizon
        self.act = torch.compile(self._act, dynamic=False) if compiled else self._act

    @torch.no_grad()
    def measure(self, given: TensorDictBase) -> Sums:
        """Play all episodes to the horizon; return their measures, each ``[batch, 1]``."""
        now = self.start(self.env.reset(given))
        # Of one human driver: [batch, 1] as of the other vehicles.
        now = {key: now[key].flatten(1) for key in now if key not in ("estimate", "covariance")}
        now |= {"alive": torch.ones_like(now["cav"]), "cav_last": torch.zeros_like(now["cav"])}
        none = torch.zeros_like(now["cav"])
        sums = dict.fromkeys(SUMMED, none) | {
            "min_gap_m": torch.full_like(none, torch.inf),
            "min_ttc_s": torch.full_like(none, torch.inf),
            "max_time_gap_s": none,
        }
        for _ in range(self.horizon):
            now, sums = self.act(now, sums)
        time = self.motion.time_step
        joules = {name: sums[name] * time * 1e-3 for name in SUMMED if name.endswith("_kj")}
        shares = {name: sums[name] / sums["steps"] for name in SUMMED if name.startswith("share")}
        path = {
            f"{car}_path_energy_kj": joules[f"{car}_steady_kj"] + joules[f"{car}_lost_kj"]
            for car in ("cav", "hdv")
        }
        return sums | joules | shares | path

    def _act(self, now: Sums, sums: Sums) -> tuple[Sums, Sums]:
        """Return the next state and what was added up until then."""
        dt, drivers, alive = self.motion.time_step, self.human.drivers, now["alive"]
        seen = [now["leader"], now["cav"], now["leader"] - now["cav"], now["cav_gap"]]
        seen += [now["speed"], now["cav"] - now["speed"], now["gap"]]
        action = self.network(torch.cat(seen, dim=-1) * self.scales)
        leader = self.leader.speeds[now["place"] + now["step"] + 1]
        cav, pull = advance_speed(now["cav"], action * self.max_acceleration, dt)
        cav_gap = advance_gap(now["cav_gap"], now["leader"], now["cav"], leader, cav, dt)
        motion = (now["speed"], now["gap"], now["speed"] - now["cav"])
        wish = idm_acceleration(*motion, now["desired_speed"], now["desired_time_gap"], drivers)
        noise = self.human.noise * uniform(now["seed"], now["step"], self.human.noise_stream)
        speed, acceleration = advance_speed(now["speed"], wish * (1.0 + noise), dt)
        gap = advance_gap(now["gap"], now["cav"], now["speed"], cav, speed, dt)
        ttc, distance = time_to_collision(cav_gap, cav - leader), time_gap(cav_gap, cav)
        jerk = (pull - now["cav_last"]) / dt
        long = distance > LONG_TIME_GAP
        added = {
            **energies("cav", now["cav"], cav, pull),
            **energies("hdv", now["speed"], speed, acceleration),
            "share_ttc_unsafe": ttc < UNSAFE_TTC,
            "share_time_gap_long": long,
            "share_time_gap_long_moving": long & (cav > PACE),
            "square_jerk": jerk * jerk,
            "steps": torch.ones_like(alive),
        }
        after = {name: sums[name] + value * alive for name, value in added.items()}
        runs = alive > 0.0
        for name, value in (("min_gap_m", cav_gap), ("min_ttc_s", ttc)):
            after[name] = torch.where(runs, torch.minimum(sums[name], value), sums[name])
        most = torch.maximum(sums["max_time_gap_s"], distance)
        after["max_time_gap_s"] = torch.where(runs, most, sums["max_time_gap_s"])
        alive = alive * ((cav_gap > 0.0) & (gap > 0.0))
        reached = {"leader": leader, "cav": cav, "cav_gap": cav_gap, "speed": speed, "gap": gap}
        reached |= {"cav_last": pull, "alive": alive}
        return {**now, "step": now["step"] + 1, **reached}, after


def energies(car: str, before: Tensor, speed: Tensor, acceleration: Tensor) -> Sums:
    """Return the powers [W] of a step and the distance over its duration [m/s]."""
    return {
        f"{car}_energy_kj": motor_power(before, acceleration),
        f"{car}_steady_kj": steady_power(before),
        f"{car}_lost_kj": acceleration_loss(before, acceleration),
        f"{car}_distance": 0.5 * (before + speed),
    }


SUMMED = (
    *(f"{car}_{name}" for car in ("cav", "hdv") for name in ("energy_kj", "steady_kj", "lost_kj")),
    *("cav_distance", "hdv_distance", "square_jerk", "steps"),
    *(f"share_{name}" for name in ("ttc_unsafe", "time_gap_long", "time_gap_long_moving")),
)
