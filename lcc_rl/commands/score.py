"""Scores of a policy or controller on all tasks that it fits, for all sources of leaders."""

from __future__ import annotations

import hashlib
import json
import platform
import re
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from lcc_rl.commands.evaluation import evaluate_and_write
from lcc_rl.config.compose import choices, identity, load
from lcc_rl.config.inputs import compared_files
from lcc_rl.config.schemas import EvaluateConfig
from lcc_rl.config.unused import drawn_in_training, refuse
from lcc_rl.config.words import FILTERED, RECORDED, top_key
from lcc_rl.data.profiles import Profiles
from lcc_rl.drivers.population import fixed
from lcc_rl.envs import build_env, load_inputs
from lcc_rl.envs.inputs import build_drivers, build_energy, constant_profiles
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import ConfigError, DataError, Diverged, ResultsError, require
from lcc_rl.evaluation.comparison import Comparison
from lcc_rl.evaluation.entrants import check_effective, check_installed
from lcc_rl.evaluation.fit import task_of
from lcc_rl.evaluation.named import DIRECT, controller_of, is_policy, is_shipped, label_of
from lcc_rl.evaluation.strategies import Strategy, TrainedPolicy, applies, baseline, trained
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING
from lcc_rl.io.atomic import atomic_path, own_folder
from lcc_rl.io.files import read_parquet
from lcc_rl.pieces.knowledge import foreseen
from lcc_rl.results.board import row_of
from lcc_rl.results.names import in_words
from lcc_rl.results.policies import load_policy, policy_file
from lcc_rl.results.report import summary, windows_for
from lcc_rl.results.runs import EPISODES, save_config
from lcc_rl.runs.output import show_headline
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.states import ERROR, LOCK, claim, forget, fresh_folder, record

# Sources of leaders, with human drivers that are fast enough for them.
LEADER_SOURCES: dict[str, tuple[str, ...]] = {
    "stream": ("data=stream", "drivers=i80"),
    "highway": ("data=highway", "drivers=highway"),
    "stop_and_go": ("data=stop_and_go", "drivers=highway"),
    "platoons": ("data=platoons", "drivers=highway"),
    "everyday": ("leader=everyday", "drivers=highway"),
}
OF_A_SOURCE = ("data", "split", "leader", "drivers")
SET_BY_SCORE = (
    *(*OF_A_SOURCE, "task", "variant", "policy", "compare", "safety"),
    *("agent", "observation", "reward"),
)
SCORED_WITH = ("torch", "torchrl", "tensordict", "numpy", "onnxruntime")
FILE = "score.json"


class Scored(NamedTuple):
    """A scored controller: name in tables, specification, and the policy if it is one."""

    label: str
    spec: str
    policy: TrainedPolicy | None

    def strategy(self, cfg: EvaluateConfig) -> tuple[Strategy, list[str]]:
        """Return it as a strategy of a task, and the entries of the leader's future that it reads.

        Raises:
            LccError: if it does not fit the vehicles, observation or action of the task.
        """
        population, scenario = build_drivers(cfg), cfg.scenario
        if self.policy is not None:
            entry = replace(trained(cfg, self.spec, self.policy, population), name=self.label)
        else:
            require(applies(cfg, self.label), "it has no vehicle to drive in this string")
            require(
                scenario.filters.get(AUTOMATED) is not None or not self.label.endswith(FILTERED),
                f"the task has no safety filter: score {self.spec.removesuffix(FILTERED)} without "
                "one; with +filter=cbf the leaderboard refuses the row",
            )
            entry = baseline(cfg, self.label, self.spec)
        road = constant_profiles(10.0, scenario.horizon, scenario.time_step, ["trial"])
        env = build_env(entry.cfg.for_any_leader(), road, population, 1, nominal=True)
        return entry, foreseen(pieces_of(env))


def scored(spec: str, trust: Sequence[str] = ()) -> Scored:
    """Read a policy, or find a controller.

    Raises:
        LccError: if there is none, or it cannot be scored.
    """
    require(spec not in (DIRECT, RECORDED), f"{spec} cannot be scored")
    if is_policy(spec):
        return Scored(spec, spec, load_policy(spec, trust=trust))
    controller_of(spec)
    return Scored(label_of(spec), spec, None)


def roads(
    entrant: Scored, task: str, given: Mapping[str, Sequence[str]], further: Sequence[str]
) -> dict[str, EvaluateConfig]:
    """Return the configurations of a task by the source of its leaders.

    A ring has no leader; a task with its own record has no other sources.

    Raises:
        LccError: if a setting is wrong, or the policy does not fit the task.
    """
    overrides = (f"task={task}", *further)
    base: EvaluateConfig = load("evaluate", overrides)
    refuse(further, drawn_in_training(base.scenario))
    entrant.strategy(base)
    if base.scenario.road == RING:
        return {"ring": base}
    if base.leader is not None and "held_out" in base.leader.settings:
        return {" ".join(base.leader.settings["held_out"]): base}
    # Fixed drivers belong to a task; a population belongs to the source.
    people = HUMAN in base.scenario.vehicles.names and base.drivers.kind is not fixed
    dropped = () if people else ("drivers",)
    return {
        name: load("evaluate", [*overrides, *(word for word in of if top_key(word) not in dropped)])
        for name, of in given.items()
    }


def play_source(entrant: Scored, source: str, cfg: EvaluateConfig, folder: Path) -> dict[str, Any]:
    """Play a task behind the leaders of a source; return its row.

    Raises:
        LccError: if it does not fit the task, or the source has no suitable leaders.
    """
    prepare_torch(cfg)
    task, (strategy, future) = task_of(cfg), entrant.strategy(cfg)
    assert task is not None
    check_installed(cfg)
    inputs = load_inputs(cfg)
    against = [baseline(cfg, name) for name in task.references if name != strategy.name]
    comparison = Comparison(cfg, inputs, [*against, strategy])
    save_config(cfg, folder)
    evaluate_and_write(comparison, inputs, folder, quiet=True)
    rows = read_parquet(folder / EPISODES)
    # Further controllers and the size of files do not count; "data" is the hash of the leaders.
    unused = ("evaluation.behind_filter", "evaluation.sample_mb", "inputs.data", "inputs.leader")
    settings = identity(cfg, *unused)
    hashes = {"data": hash_of(inputs.evaluation), "settings": settings}
    windows = windows_for(rows)
    task = task.resolved(windows)
    table = summary(windows, task, build_energy(cfg))
    drivers = rows["driver_id"].nunique()
    return row_of(table, task, source, strategy.name, drivers, future) | hashes


def hash_of(windows: Profiles) -> str:
    """Return the SHA-256 of the leaders' speeds in mm/s, window by window."""
    digest = hashlib.sha256()
    for index in range(len(windows)):
        speeds = (1e3 * windows.record(index).double()).round().to("cpu").numpy().astype("<i4")
        digest.update(len(speeds).to_bytes(8, "little") + speeds.tobytes())
    return digest.hexdigest()


def about(entrant: Scored) -> dict[str, Any]:
    """Return the hash of the scored policy's or controller's files, and versions.

    A controller of the package has no file, one of the user's a yaml file or a module.
    """
    learned, spec = entrant.policy is not None, entrant.spec
    files = [policy_file(spec)] if learned else compared_files(spec)
    contents = [file.read_bytes() for file in files]
    installed: dict[str, str | None] = {}
    for name in ("lcc_rl", *SCORED_WITH):
        try:
            installed[name] = version(name)
        except PackageNotFoundError:
            installed[name] = None
    digest = hashlib.sha256(b"".join(contents)).hexdigest() if contents else None
    versions = {"python": platform.python_version(), **installed}
    return {"sha256": digest, "versions": versions}


def run(options: Namespace, further: Sequence[str]) -> dict[str, Any]:
    """Play all tasks that fit, and write and return the scores."""
    entrant = scored(options.policy, tuple(options.trust))
    if entrant.policy is None:
        check_effective(further, [entrant.label], [entrant.spec])
    name = entrant.label if options.name is None else _own_name(options.name)
    file = re.sub(r"\W+", "_", name)
    mine = {*choices("task"), ERROR}.issuperset  # of a killed run, which is repeated
    folder = own_folder(options.out or fresh_folder("score", file), mine)
    with claim(folder):
        own_folder(folder, mine)  # another process may just have ended
        try:
            return _run(entrant, name, folder, options, further)
        except Exception as error:
            if any(path.name != LOCK for path in folder.iterdir()):  # not if refused
                record(folder, error)
            raise


def _run(
    entrant: Scored, name: str, folder: Path, options: Namespace, further: Sequence[str]
) -> dict[str, Any]:
    users = dict(map(_source, options.source))
    offered, selected = {**LEADER_SOURCES, **users}, {*options.on, *users} if options.on else None
    scores: list[dict[str, Any]] = []
    left_out: list[str] = []
    found: dict[str, dict[str, EvaluateConfig]] = {}
    for task in options.task or choices("task"):
        with leaving_out(task, left_out):
            found[task] = roads(entrant, task, offered, further)
    known = dict.fromkeys(name for sources in found.values() for name in sources)
    for source in options.on if known else ():
        require(source in known, f"--on {source}: no such source, only {', '.join(known)}")
    for task, sources in found.items():
        chosen = [one for one in sources if one in (selected or [one])]
        if not chosen:
            left_out.append(f"{task}: no such source, only {', '.join(sources)}")
        for source in chosen:
            show_headline(f"{task}, {source}")
            with leaving_out(f"{task}, {source}", left_out):
                scores.append(play_source(entrant, source, sources[source], folder / task / source))
    why = "; ".join(left_out) or f"no such source, only {', '.join(offered)}"
    require(bool(scores), f"nothing could be played: {why}")
    document = {"name": name, **about(entrant), "results": scores, "left_out": left_out}
    with atomic_path(folder / FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", "utf-8")
    forget(folder)
    show_headline(f"scores in {folder / FILE}")
    played = {row["source"] for row in scores}
    for source in users:
        require(source in played, f"--source {source} could not be played: {'; '.join(left_out)}")
    return document


@contextmanager
def leaving_out(what: str, left_out: list[str]) -> Iterator[None]:
    """Note the error of a task or source that cannot be played, and continue."""
    try:
        yield
    except (ConfigError, DataError, ResultsError, Diverged) as error:
        left_out.append(f"{what}: {error}")


def _own_name(name: str) -> str:
    """Return a name of the command line; reserved names are refused."""
    plain = name.removesuffix(FILTERED)
    new = not is_shipped(plain) and in_words(plain) == plain
    require(new, f"--name {name} stands for {in_words(name)!r} in tables: choose another")
    require(
        re.fullmatch(r"\w[\w .+-]*", name) is not None,
        f"--name {name}: expected letters, digits, spaces and _.+-",
    )
    return name


def _source(arguments: Sequence[str]) -> tuple[str, tuple[str, ...]]:
    """Return name and settings of a source of the command line."""
    name, *settings = arguments
    require(
        re.fullmatch(r"\w[\w-]*", name) is not None and name not in LEADER_SOURCES,
        f"--source {name}: expected a new name of letters, digits, - and _",
    )
    for word in settings:
        require(
            "=" in word and top_key(word) in OF_A_SOURCE,
            f"--source {name}: expected settings of {', '.join(OF_A_SOURCE)}, got {word}; put "
            "others before --source",
        )
    people = () if any(top_key(word) == "drivers" for word in settings) else ("drivers=highway",)
    return name, (*people, *settings)
