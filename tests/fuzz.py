"""Fuzzes configurations: random overrides end in a built study or in an error of the package.

The long run: ``python tests/fuzz.py --minutes 10``; a case again: ``--case SEED``.
"""

from __future__ import annotations

import argparse
import random
import resource
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

from commands import process_state

import lcc_rl.conf
from lcc_rl.agents.factory import build_agent, learns
from lcc_rl.commands import evaluation, training
from lcc_rl.commands.checks import check_settings
from lcc_rl.config import load
from lcc_rl.config.nodes import build
from lcc_rl.config.schemas import as_plain
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import build_env
from lcc_rl.envs.inputs import constant_profiles, string_of
from lcc_rl.errors import LccError
from lcc_rl.io import memory

CONF = Path(lcc_rl.conf.__path__[0])
# Limits of a case; a training or an evaluation may rightly take longer, and is ended sooner.
SECONDS, LONGEST, GIGABYTES = 90, 20, 6
CHOICES = {
    folder.name: sorted(path.stem for path in folder.glob("*.yaml"))
    for folder in sorted(CONF.iterdir())
    if folder.is_dir() and folder.name not in ("hydra", "logger", "__pycache__")
}
SMALL = ("experiment=smoke", "scenario.horizon=20")
DATA = ("data.platoons=2", "data.recordings=2")
RECIPES = (
    *("+filter=cbf", "+knowledge=memory", "+knowledge=preview", "scenario=ring agent=none"),
    *("agent=td3", "agent=sac", "agent=analytic", "agent=none", "drivers=fixed", "drivers=kde"),
    *("split.by=vehicle", "split=single", "experiment=single_profile", "leader=trajectories"),
    *("scenario.string=automated*2", "scenario.string={size:6,penetration:0.3}"),
    "controller@scenario.controllers.automated=handover",
)
# Files, folders, foreign code and machines are the business of other tests.
FOREIGN = ("_target_", "path", "policy", "resume", "sweep", "keep", "device", "compiled", "trust")
VALUES = (
    *("nan", "inf", "-inf", "-1", "0", "1", "0.5", "-0.0", "1e30", "-1e30", "1e-30", "1e9"),
    *("2147483647", "99999999999999999999999", "1" + "0" * 400, "true", "false", "null", "''"),
    *("abc", "größe", "[]", "{}", "[1]", "[1,2,3]", "[nan,1]", "[a,b]", "[[1],[2]]", "{a: 1}"),
    *("{a: {b: nan}}", "${seed}", "${nowhere}", "${scenario}", "${oc.env:NOBODY}", "???", "'???'"),
    *("'a b'", "random", "first", "self", "automated", "human", "vehicles", "automated*2"),
)


@dataclass(frozen=True)
class Case:
    """What is typed, and how far it is taken: ``build``, ``train`` or ``evaluate``."""

    seed: int
    overrides: tuple[str, ...]
    goal: str


class TooLong(BaseException):
    """A case took longer than its limit."""


@cache
def keys_of(variant: str) -> dict[str, Any]:
    """Return the values of a variant's configuration by dotted keys, those of nodes, too."""
    cfg = as_plain(load("train", [f"variant={variant}"]))
    unused = ("data", "split") if cfg.get("leader") is not None else ()
    found, left = {}, list(cfg.items())
    while left:
        key, value = left.pop(0)
        if {*key.split(".")} & {*FOREIGN} or key in unused:
            continue
        found[key] = value
        if isinstance(value, dict):
            left = [(f"{key}.{name}", x) for name, x in value.items()] + left
    return found


def make(seed: int) -> Case:
    """Return the case of a seed."""
    draw = random.Random(seed)
    variant = draw.choice(CHOICES["variant"])
    recipe = draw.choice(RECIPES).split() if draw.random() < 0.4 else []
    goal = draw.choices(("build", "train", "evaluate"), (0.9, 0.05, 0.05))[0]
    ring = "scenario=ring" in recipe
    data = DATA if goal != "build" and not ring and "leader" not in keys_of(variant) else ()
    typed = [_override(draw, variant) for _ in range(draw.randint(1, 3))]
    return Case(seed, (f"variant={variant}", *SMALL, *data, *recipe, *typed), goal)


def _override(draw: random.Random, variant: str) -> str:
    """Return a random override of a variant's configuration."""
    known, kind = keys_of(variant), draw.random()
    if kind < 0.7:
        return _number(draw, known)
    key = draw.choice(list(known))
    if kind < 0.75:
        group = draw.choice(list(CHOICES))
        at = draw.choice(("", "", "", "@scenario.controllers.automated", "@deployed"))
        value = draw.choice([*CHOICES[group], "nobody", "null"])
        return f"{draw.choice(('', '+', '++'))}{group}{at}={value}"
    if kind < 0.79:
        place = draw.randrange(len(key))
        key = key[:place] + draw.choice(("x", ".", "")) + key[place + draw.randint(0, 1) :]
    elif kind < 0.82:
        return f"~{key}"
    elif kind < 0.86:
        key = f"{key}.{draw.choice(('more', 'weight', 'speed', 'x'))}"
    plus = draw.choice(("", "", "++") if key in known else ("", "+", "++"))
    return f"{plus}{key}={draw.choice(VALUES)}"


def _number(draw: random.Random, known: Mapping[str, Any]) -> str:
    """Return an override that changes a number, little or far."""
    numbers = {key: x for key, x in known.items() if isinstance(x, (int, float))}
    for key in ("vehicle_length", "initial_speed"):  # of a ring
        del numbers[f"scenario.{key}"]
    key, value = draw.choice(list(numbers.items()))
    if isinstance(value, bool):
        return f"{key}={draw.choice(('true', 'false', '1', 'null'))}"
    factor = draw.choice((-1, 0, 1e-9, 1e-3, 0.3, 0.9, 0.95, 1.05, 1.1, 2, 10, 1e4, 1e12))
    if isinstance(value, int):
        return f"{key}={round(value * factor)}"
    return f"{key}={value * factor!r}"


def attempt(case: Case) -> str:
    """Carry out a case; return how it ended: an error of the package's own is one way."""
    try:
        if case.goal == "build":
            build_study(case.overrides)
        else:
            command = training if case.goal == "train" else evaluation
            with tempfile.TemporaryDirectory() as folder:
                cfg = load(case.goal, case.overrides)
                command.run(cfg, Path(folder) / "run", quiet=True)
    except LccError as error:
        return "refused" if str(error).strip() else "refused without words"
    return "works"


def build_study(overrides: Sequence[str]) -> None:
    """Build the environment, the agent and the inputs of a configuration."""
    cfg = load("train", overrides)
    with tempfile.TemporaryDirectory() as folder:
        check_settings(cfg, Path(folder))
    scenario = cfg.scenario
    profiles = constant_profiles(8.0, scenario.horizon, scenario.time_step, ["one", "two"])
    env = build_env(cfg, profiles, bootstrap(), 2)
    if learns(cfg):
        build_agent(cfg, bootstrap())
    env.rollout(3)
    for key in ("data", "split", "leader"):
        if getattr(cfg, key) is not None:
            build(getattr(cfg, key), key)
    if cfg.leader is not None:
        followers = len(string_of(cfg))
        build(cfg.leader, "leader").load(scenario.time_step, scenario.horizon, followers)


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """Limit the time and the memory of what runs inside, and put back what it changes."""

    def stop(*_: object) -> None:
        raise TooLong(f"longer than {seconds} s")

    def free(device: object = "cpu") -> int:
        return GIGABYTES << 29  # half: torch and its libraries take their part

    before = resource.getrlimit(resource.RLIMIT_DATA)
    alarm = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    resource.setrlimit(resource.RLIMIT_DATA, (GIGABYTES << 30, before[1]))
    try:
        with process_state("fuzz", (), Path.cwd()), patch.object(memory, "available", free):
            warnings.simplefilter("ignore")
            yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, alarm)
        resource.setrlimit(resource.RLIMIT_DATA, before)


def run(seeds: Iterator[int], deadline: float) -> tuple[Counter[str], list[tuple[Case, str]]]:
    """Carry out cases until a moment of :func:`time.monotonic`; return counts and failures."""
    counts: Counter[str] = Counter()
    failures = []
    for seed in seeds:
        if time.monotonic() > deadline:
            break
        case = make(seed)
        short = case.goal == "build"
        try:
            with limited(SECONDS if short else LONGEST):
                end = attempt(case)
        except (Exception, TooLong) as error:
            end = "long" if isinstance(error, TooLong) and not short else "failed"
            failures += [(case, traceback.format_exc())] * (end == "failed")
        counts[f"{case.goal} {end}"] += 1
    return counts, failures


def main() -> int:
    """Command line; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--first", type=int, default=10_000, help="seed of the first case")
    parser.add_argument("--case", type=int, help="carry out the case of this seed only")
    arguments = parser.parse_args()
    first = arguments.first if arguments.case is None else arguments.case
    last = sys.maxsize if arguments.case is None else first + 1
    deadline = time.monotonic() + 60.0 * arguments.minutes
    counts, failures = run(iter(range(first, last)), deadline)
    for case, text in failures:
        print(f"--- {case.goal}: {' '.join(case.overrides)}  (--case {case.seed})\n{text}")
    print(dict(sorted(counts.items())))
    return int(bool(failures))


if __name__ == "__main__":
    sys.exit(main())
