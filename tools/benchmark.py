"""Measure speed against named alternatives: python tools/benchmark.py [read env …] [--quick].

A figure is the median of alternating repeats (A B A B …); a ratio is the median over the repeats
of value / value of the alternative, both of the same run, so that a busy machine slows both.
Every row also goes into one parquet file (--out).
"""

from __future__ import annotations

import argparse
import gzip
import logging
import os
import platform
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table
from scipy.optimize import differential_evolution
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from lcc_rl.agents import DDPG
from lcc_rl.agents.training import LEARNED_FROM
from lcc_rl.calibration.idm_fit import DEFAULT_BOUNDS, fit
from lcc_rl.calibration.observed import Observed, observe
from lcc_rl.config import load
from lcc_rl.data.ngsim import read_ngsim
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.data.stream import StreamSource
from lcc_rl.envs.factory import Inputs, build_agent, build_env, load_inputs
from lcc_rl.errors import DataError, LccError, unknown_name
from lcc_rl.evaluation.monte_carlo import Strategy
from lcc_rl.evaluation.monte_carlo import evaluate as play
from lcc_rl.functional.estimation import Belief, predict_and_update
from lcc_rl.functional.idm import IDMConstants, idm_acceleration
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.random import uniform
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.pieces.base import SEED, STEP
from lcc_rl.results.files import write_parquet

TOLERANCE = 1e-4  # within which two ways to the same result must agree before they are timed
Row = dict[str, Any]
Run = Callable[[], Any]
Values = Mapping[str, np.ndarray]


def alternate(runs: Mapping[str, Run], repeats: int) -> dict[str, np.ndarray]:
    """Seconds of every run, ``repeats`` times in turn; once before that, untimed."""
    spent: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            begun = time.perf_counter()
            run()
            spent[name].append(time.perf_counter() - begun)
    return {name: np.array(seconds[1:]) for name, seconds in spent.items()}


def rows_of(
    benchmark: str, values: Values, unit: str, other: str | None = None, batch: int | None = None
) -> list[Row]:
    """One row per case; ``values`` holds the repeats of each, in the order they were taken."""
    columns = ("benchmark", "case", "batch", "value", "unit", "spread_low", "spread_high")
    rows = []
    for case, each in values.items():
        figures = (benchmark, case, batch, np.median(each), unit, each.min(), each.max())
        against = other if case != other else None
        ratio = np.nan if against is None else np.median(each / values[against])
        row = dict(zip(columns, figures, strict=True))
        rows.append({**row, "alternative": against, "ratio": ratio})
    return rows


def times(count: int, function: Run) -> None:
    """Call a function so many times."""
    for _ in range(count):
        function()


def stream(quick: bool) -> StreamSource:
    """Return the default data: the synthetic stream, or a little of it."""
    return StreamSource(2, 3, 3, (35.0, 45.0)) if quick else StreamSource()


# -- read ------------------------------------------------------------------------------------------

# The kernel's mark of this very process: ru_maxrss may begin at that of the one that started it.
PEAK = """
import resource, sys
from pathlib import Path
from lcc_rl.data.ngsim import read_ngsim
def peak():
    if not Path("/proc/self/status").exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # bytes where no /proc
    return int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]) / 2**10
before = peak()
read_ngsim(sys.argv[1], sys.argv[2] or None)
print(peak() - before)
"""


def read(options: Namespace) -> list[Row]:
    """Rows per second of the NGSIM reader, and by how much reading raises the peak of memory.

    Memory is the largest resident size of a process of its own, less that before reading. The
    file of four times the rows holds one copy under each of four Locations.
    """
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder:
        path, fourfold = Path(folder, "stream.csv.gz"), Path(folder, "fourfold.csv.gz")
        if options.ngsim is None:
            stream(options.quick).write(path)
        path = Path(options.ngsim or path)
        runs = {"read_ngsim": lambda: read_ngsim(path), "pandas": lambda: pd.read_csv(path)}
        count = read_ngsim(path).report.rows_read
        rates = {name: count / spent for name, spent in alternate(runs, options.repeats).items()}
        write_copies(path, fourfold, ("a", "b", "c", "d"))
        memory = {
            "peak memory": peak_memory(path, ""),
            "… 4 × the rows, ¼ kept": peak_memory(fourfold, "a"),
            "… 4 × the rows": peak_memory(fourfold, ""),
        }
    speed = rows_of("read", rates, "rows/s", "pandas")
    return speed + rows_of("read", memory, "MiB", "peak memory")


def write_copies(path: Path, target: Path, locations: Sequence[str]) -> None:
    """Write an 18-column CSV several times below one header, a Location added to each copy."""
    content = path.read_bytes()
    content = gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    header, *lines = content.decode().splitlines()
    if header.count(",") != 17:
        raise DataError(f"{path}: expected an 18-column CSV with a header, got {header[:80]!r}")
    with gzip.open(target, "wt", compresslevel=1) as file:
        file.write(f"{header},Location\n")
        for place in locations:
            file.writelines(f"{line},{place}\n" for line in lines)


def peak_memory(path: Path, location: str) -> np.ndarray:
    """By how much reading raises the peak of a fresh process [MiB]."""
    command = [sys.executable, "-c", PEAK, str(path), location]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return np.array([float(done.stdout)])


# -- env -------------------------------------------------------------------------------------------


@cache
def study(quick: bool) -> tuple[DictConfig, Inputs]:
    """Configuration and inputs of the ALCC study on the synthetic stream."""
    cfg = load("train", ["variant=alcc"])
    return cfg, load_inputs(cfg, stream(quick).load().episodes)


def alcc(options: Namespace, batch: int, initial_time_gap: float = 1.5) -> TransformedEnv:
    """Build the ALCC environment; the car starts with the given time gap [s]."""
    cfg, inputs = study(options.quick)
    cfg = cfg.copy()
    cfg.scenario.pieces.cav.initial_time_gap = initial_time_gap
    cfg.scenario.pieces.cav.initial_gap_range = [1.0, 1.0]
    return build_env(cfg, inputs.training, inputs.population, batch)


class PlainLoop:
    """The physics of the environment as one function of tensors, without TorchRL.

    Args:
        env: an ALCC environment with one human follower, whose settings and data it shares.
    """

    def __init__(self, env: TransformedEnv) -> None:
        pieces = {type(piece).__name__: piece for piece in env.transform}
        terms = {piece.name: piece for piece in env.transform if hasattr(piece, "weight")}
        self.leader, self.cav = pieces["NGSIMLeader"], pieces["CAVMotion"]
        self.human, self.estimator = pieces["IDMFollower"], pieces["DriverEstimator"]
        self.scales, self.penalty = pieces["Observation"].constants, terms["collision"].weight
        self.safety, self.efficiency = terms["safety"], terms["efficiency"]
        energies = (terms["cav_energy"], terms["hdv_energy"])
        self.cav_price, self.hdv_price = (term.weight * term.factor for term in energies)

    def start(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Begin where a reset of the environment begins; all entries are ``[batch, width]``."""
        keys = ("speed", "gap", "estimate", "covariance", "desired_speed", "desired_time_gap")
        return {
            "seed": td[SEED],
            "step": td[STEP],
            "place": self.leader.offsets[td["leader", "profile"]] + td["leader", "start"],
            "leader": td["leader", "speed"],
            "cav": td["cav", "speed"],
            "cav_gap": td["cav", "gap"],
            **{key: td["hdv", key].squeeze(-2) for key in keys},
        }

    def step(self, now: dict[str, Tensor], action: Tensor) -> tuple[dict[str, Tensor], ...]:
        """Return the next state and what the environment writes beside it."""
        dt, drivers = self.cav.time_step, self.human.drivers
        leader = self.leader.speeds[now["place"] + now["step"] + 1]
        cav, cav_acceleration = advance_speed(now["cav"], action * self.cav.max_acceleration, dt)
        cav_gap = advance_gap(now["cav_gap"], now["leader"], now["cav"], leader, cav, dt)
        motion = (now["speed"], now["gap"], now["speed"] - now["cav"])
        wish = idm_acceleration(*motion, now["desired_speed"], now["desired_time_gap"], drivers)
        noise = self.human.noise * uniform(now["seed"], now["step"], self.human.noise_stream)
        speed, acceleration = advance_speed(now["speed"], wish * (1.0 + noise), dt)
        gap = advance_gap(now["gap"], now["cav"], now["speed"], cav, speed, dt)
        belief = Belief(now["estimate"], now["covariance"])
        error = self.estimator.measurement_error
        predicted, belief = predict_and_update(*motion, speed, belief, drivers, dt, error)
        early = now["step"] < self.estimator.learning_steps
        predicted = torch.where(early, self.estimator.mean(*motion), predicted)
        threshold = self.safety.threshold
        ttc = time_to_collision(cav_gap - self.safety.margin, cav - leader)
        late = time_gap(cav_gap, cav) >= self.efficiency.threshold
        reward = (
            self.safety.weight * (ttc.clamp(self.safety.floor, threshold) / threshold).log()
            - self.efficiency.weight * late.float()
            - self.cav_price * motor_power(now["cav"], cav_acceleration)
            - self.hdv_price * motor_power(now["speed"], predicted)
            - self.penalty * ((cav_gap <= 0.0) | (gap <= 0.0)).float()
        )
        seen = [leader, cav, leader - cav, cav_gap, speed, cav - speed, gap]
        written = {
            "observation": torch.cat(seen, dim=-1) * self.scales,
            "reward": reward,
            "hdv_power": motor_power(now["speed"], acceleration),
        }
        reached = {"leader": leader, "cav": cav, "cav_gap": cav_gap, "speed": speed, "gap": gap}
        learned = {"estimate": belief.estimate, "covariance": belief.covariance}
        return {**now, "step": now["step"] + 1, **reached, **learned}, written


def check_physics(options: Namespace, steps: int) -> None:
    """Hold the plain loop against the environment, whose episodes go on after a collision."""
    env = alcc(options, 64)
    plain, generator, td = PlainLoop(env), torch.Generator().manual_seed(0), env.reset()
    state = plain.start(td)
    for step in range(steps):
        action = torch.rand(64, 1, generator=generator) * 2.0 - 1.0
        td = env.step(td.set("action", action))
        state, written = plain.step(state, action)
        for name in ("observation", "reward"):
            off = float((td["next", name] - written[name]).abs().max())
            if not off <= TOLERANCE:
                raise RuntimeError(f"step {step}: {name} of the plain loop is off by {off:g}")
        td = step_mdp(td)


def env(options: Namespace) -> list[Row]:
    """Steps per second of the ALCC environment with zero actions, beside the plain loop.

    "step" is what a collector calls (``step_and_maybe_reset``) and keeps nothing, like the plain
    loop; "rollout" stacks every entry of every moment. The cars start 30 s apart, so that no
    episode ends within a run and nobody resets. Both are first checked to be the same physics.
    """
    check_physics(options, 20 if options.quick else 250)
    rows: list[Row] = []
    for batch in (1, 16) if options.quick else (1, 64, 1024, 8192):
        for ending in ("", ", compiled") if options.compile else ("",):
            rates = env_rates(options, batch, ending)
            rows += rows_of("env", rates, "steps/s", f"plain loop{ending}", batch)
    return rows


def env_rates(options: Namespace, batch: int, ending: str) -> dict[str, np.ndarray]:
    """Steps per second of every way to step, all eager or, with an ending, all compiled."""
    steps, zero, env = 10 if options.quick else 100, torch.zeros(batch, 1), alcc(options, batch, 30)
    plain, start = PlainLoop(env), env.reset()
    advance = plain.step
    if ending:
        # One graph per size, which is faster than one for any size; and none of other sizes, whose
        # guards would be tried first and count towards the compiler's limit.
        torch.compiler.reset()
        env.compile(warmup=3, dynamic=False)
        advance = torch.compile(plain.step, dynamic=False)

    def rollout() -> None:
        begin = {"auto_reset": False, "tensordict": start.copy(), "break_when_any_done": False}
        env.rollout(steps, lambda td: td.set("action", zero), **begin)

    def step() -> None:
        td = start.copy()
        for _ in range(steps):
            _, td = env.step_and_maybe_reset(td.set("action", zero))

    def loop() -> None:
        state = plain.start(start)
        for _ in range(steps):
            state, _ = advance(state, zero)

    runs = {f"rollout{ending}": rollout, f"step{ending}": step, f"plain loop{ending}": loop}
    with torch.no_grad():
        spent = alternate(runs, options.repeats)
    return {name: batch * steps / seconds for name, seconds in spent.items()}


def estimator(options: Namespace) -> list[Row]:
    """Microseconds per step of the driver estimator, beside those of the IDM step itself."""
    batch, calls = (16, 5) if options.quick else (1024, 300)
    env = alcc(options, batch)
    td, zero = env.step(env.reset().set("action", torch.zeros(batch, 1))), torch.zeros(batch, 1)
    for _ in range(10):
        td = env.step(step_mdp(td).set("action", zero))
    pieces = {type(piece).__name__: piece for piece in env.transform}
    rows: list[Row] = []
    for ending in ("", ", compiled") if options.compile else ("",):
        runs: dict[str, Run] = {}
        for name in ("DriverEstimator", "IDMFollower"):
            compute = pieces[name].compute
            compute = torch.compile(compute, dynamic=False) if ending else compute
            call = partial(compute, *(td.get(key) for key in pieces[name].in_keys))
            runs[f"{name}{ending}"] = partial(times, calls, call)
        with torch.no_grad():
            spent = alternate(runs, options.repeats)
        cost = {name: 1e6 * seconds / calls for name, seconds in spent.items()}
        rows += rows_of("estimator", cost, "µs/step", f"IDMFollower{ending}", batch)
    return rows


# -- calibrate -------------------------------------------------------------------------------------


class Problem:
    """RMSPE of one driver as a function of (v0, T), in plain Python (A3, A6)."""

    def __init__(self, observed: Observed, index: int) -> None:
        part = slice(int(observed.samples[index]))
        self.leader: list[float] = observed.leader_speed[part, index].tolist()
        self.follower: list[float] = observed.follower_speed[part, index].tolist()
        self.gap, self.time_step = float(observed.gap[index]), observed.time_step
        self.norm = sum(speed * speed for speed in self.follower)

    def __call__(self, candidate: Sequence[float]) -> float:
        """Return the error; 0.07 is 7 %."""
        desired_speed, headway = float(candidate[0]), float(candidate[1])
        known, dt = IDMConstants(), self.time_step
        gap, speed, total = self.gap, self.follower[0], 0.0
        root = 2.0 * (known.acceleration * known.deceleration) ** 0.5
        for step in range(len(self.leader) - 1):
            ahead, ahead_reached = self.leader[step], self.leader[step + 1]
            wish = known.min_gap + max(0.0, speed * (headway + (speed - ahead) / root))
            load = (speed / desired_speed) ** 4 + (wish / max(gap, known.gap_floor)) ** 2
            command = known.acceleration * (1.0 - load)
            command = min(max(command, -known.braking_limit), known.acceleration_limit)
            reached = max(0.0, speed + command * dt)
            gap += 0.5 * dt * (ahead - speed + ahead_reached - reached)
            speed = reached
            total += (speed - self.follower[step + 1]) ** 2
        return float((total / self.norm) ** 0.5)


def calibrate(options: Namespace) -> list[Row]:
    """Seconds to fit (v0, T) of every driver, beside scipy driver by driver.

    scipy's differential evolution, with its own defaults and an objective in plain Python, fits
    a few drivers; its time is scaled to all by the number of samples. Errors are compared on
    these few.
    """
    source = EpisodesSource(options.episodes) if options.episodes else stream(options.quick)
    observed = observe(source.load().episodes)
    few = np.linspace(0, observed.count - 1, 2 if options.quick else 6).round().astype(int)
    problems = [Problem(observed, int(index)) for index in few]
    bounds = [DEFAULT_BOUNDS[name] for name in ("desired_speed", "time_gap")]
    limit = {"maxiter": 2} if options.quick else {}
    found: dict[str, Any] = {}

    def ours() -> None:
        found["fit"] = fit(observed, compiled=options.compile).drivers.set_index("episode")

    def scipy() -> None:
        found["scipy"] = [differential_evolution(p, bounds, seed=0, **limit) for p in problems]

    ending = "scipy, scaled from few"
    spent = alternate({"fit": ours, ending: scipy}, options.repeats)
    spent[ending] = spent[ending] * (observed.samples.sum() / observed.samples[few].sum())
    columns = ["desired_speed_mps", "time_gap_s", "rmspe"]
    fitted = found["fit"].loc[observed.identity["episode"].iloc[few], columns].to_numpy(float)
    for problem, (desired_speed, headway, rmspe) in zip(problems, fitted, strict=True):
        off = abs(problem((desired_speed, headway)) - rmspe)
        if not off <= TOLERANCE:
            raise RuntimeError(f"the objectives differ by {off:g}")
    theirs = np.mean([result.fun for result in found["scipy"]])
    means = {"fit": np.array([100 * fitted[:, 2].mean()]), "scipy": np.array([100 * theirs])}
    overall = {"fit": np.array([100 * found["fit"]["rmspe"].mean()])}
    rows = rows_of("calibrate", spent, "s", ending, observed.count)
    rows += rows_of("calibrate", overall, "% RMSPE", None, observed.count)
    return rows + rows_of("calibrate", means, "% RMSPE", "scipy", len(few))


# -- evaluate and update ---------------------------------------------------------------------------


def evaluate(options: Namespace) -> list[Row]:
    """Seconds of a Monte Carlo evaluation of an untrained actor, its results written."""
    cfg, inputs = study(options.quick)
    strategy = Strategy("untrained", cfg, build_agent(cfg, inputs.population).policy)
    settings, drivers = cfg.evaluation, 2 if options.quick else cfg.evaluation.drivers
    how = (drivers, settings.batch_size, settings.seed, settings.sample_episodes)
    count = len(inputs.evaluation) * (drivers or len(inputs.population.time_gap))

    def run(folder: str) -> None:
        episodes, steps = play(strategy, inputs.evaluation, inputs.population, *how)
        write_parquet(episodes, Path(folder, "episodes.parquet"))
        write_parquet(steps, Path(folder, "steps.parquet"))

    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as name:
        (spent,) = alternate({"run": partial(run, name)}, options.repeats).values()
    case, batch = f"{count} episodes of {cfg.scenario.horizon}", settings.batch_size
    rows = rows_of("evaluate", {case: spent}, "s", None, batch)
    return rows + rows_of("evaluate", {case: count / spent}, "episodes/s", None, batch)


def update(options: Namespace) -> list[Row]:
    """DDPG updates per second, replay sample included, beside their matrix products alone."""
    logging.getLogger("torchrl").setLevel(logging.WARNING)  # the buffer announces its storage
    played = alcc(options, 1000).rollout(20, break_when_any_done=False)
    played = played.select(*LEARNED_FROM).reshape(-1)
    rows: list[Row] = []
    for batch, count in ((16, 2), (32, 2)) if options.quick else ((256, 40), (1024, 20)):
        agent = DDPG(observation_size=7, action_size=1, seed=0, batch_size=batch)
        buffer = ReplayBuffer(storage=LazyTensorStorage(agent.buffer_size), batch_size=batch)
        buffer.extend(played)

        def learn(agent: DDPG = agent, buffer: ReplayBuffer = buffer) -> None:
            agent.update(buffer.sample())

        runs = {"DDPG.update": learn, "matrix products": matrix_products(batch)}
        timed = {name: partial(times, count, run) for name, run in runs.items()}
        rates = {name: count / spent for name, spent in alternate(timed, options.repeats).items()}
        rows += rows_of("update", rates, "updates/s", "matrix products", batch)
    return rows


def matrix_products(batch: int, hidden: Sequence[int] = (200, 100, 50)) -> Run:
    """The matrix products of one update: no activation, loss, optimizer or target step."""

    def layers(inputs: int) -> list[tuple[Tensor, Tensor, Tensor]]:
        sizes = list(zip((inputs, *hidden), (*hidden, 1), strict=True))
        return [(torch.rand(batch, i), torch.rand(o, i), torch.rand(batch, o)) for i, o in sizes]

    actor, critic = layers(7), layers(8)

    def run() -> None:
        # Forward: both targets, the critic on the data, the actor, the critic on its action.
        for x, weight, _ in (*actor, *critic, *critic, *actor, *critic):
            torch.mm(x, weight.t())
        for x, _, gradient in (*actor, *critic):
            torch.mm(gradient.t(), x)
        # To the inputs: no first layer needs it but where the critic judges the actor's action.
        for _, weight, gradient in (*critic[1:], *critic, *actor[1:]):
            torch.mm(gradient, weight)

    return run


# -- the command -----------------------------------------------------------------------------------

BENCHMARKS: dict[str, Callable[[Namespace], list[Row]]] = {
    function.__name__: function for function in (read, env, estimator, calibrate, evaluate, update)
}


def machine() -> str:
    """Name of the processor."""
    try:
        _, found, after = Path("/proc/cpuinfo").read_text().partition("model name")
    except OSError:
        found = ""
    return after.splitlines()[0].lstrip("\t :") if found else platform.processor() or "unknown"


def drawn(name: str, rows: list[Row]) -> Table:
    """The rows of one benchmark, for the terminal."""
    table = Table(title=name, caption=f"load average {os.getloadavg()[0]:.1f}")
    for heading in ("case", "batch", "median", "smallest … largest", "unit", "ratio", "to"):
        table.add_column(heading, justify="left" if heading in ("case", "unit", "to") else "right")
    for row in rows:
        numbers = (row["value"], row["spread_low"], row["spread_high"])
        value, low, high = (f"{x:,.0f}" if x >= 1000 else f"{x:.3g}" for x in numbers)
        batch = "" if row["batch"] is None else str(row["batch"])
        other = (
            ("", "") if row["alternative"] is None else (f"{row['ratio']:.3g}", row["alternative"])
        )
        table.add_row(row["case"], batch, value, f"{low} … {high}", row["unit"], *other)
    return table


def parse(arguments: Sequence[str] | None) -> Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    listed = f"{', '.join(BENCHMARKS)}; all by default, which takes minutes"
    parser.add_argument("names", nargs="*", metavar="name", help=listed)
    parser.add_argument("--ngsim", help="18-column CSV to read (default: a synthetic stream)")
    parser.add_argument("--episodes", help="episode table to calibrate (default: the stream's)")
    parser.add_argument("--compile", action="store_true", help="env, estimator, calibrate: compile")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--repeats", type=int, default=5, help="repeats of every case")
    parser.add_argument(
        "--quick", action="store_true", help="two repeats of tiny sizes, as a trial"
    )
    parser.add_argument("--out", default="outputs/benchmark.parquet", help="where the rows go")
    options = parser.parse_args(arguments)
    if min(options.threads, options.repeats) < 1:
        parser.error("--threads and --repeats must be at least 1")
    options.repeats = 2 if options.quick else options.repeats
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print and write; 1 where the input is at fault."""
    options = parse(arguments)
    torch.set_num_threads(options.threads)
    console, rows = Console(), []
    try:
        for name in options.names:
            if name not in BENCHMARKS:
                raise unknown_name("benchmark", name, BENCHMARKS)
        here = {"threads": options.threads, "machine": machine(), "torch": torch.__version__}
        for name in options.names or BENCHMARKS:
            measured = BENCHMARKS[name](options)
            console.print(drawn(name, measured))
            rows += measured
            # After each, so that what is measured stays whatever happens to the next.
            write_parquet(pd.DataFrame(rows).astype({"batch": "Int64"}).assign(**here), options.out)
    except LccError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    console.print(f"{len(rows)} rows: {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
