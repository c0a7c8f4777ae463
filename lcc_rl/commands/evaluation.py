"""Evaluation of strategies in the scenario of a configuration."""

from __future__ import annotations

import dataclasses
import logging
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lcc_rl.commands.checks import check_installed, check_measured, check_variant
from lcc_rl.config import identity, with_inputs
from lcc_rl.config.nodes import Node
from lcc_rl.config.schemas import EvaluateConfig, StudyConfig
from lcc_rl.config.words import FILTERED, RECORDED
from lcc_rl.envs import Inputs, build_env, load_inputs
from lcc_rl.envs.inputs import build_energy, second_energy
from lcc_rl.errors import ConfigError, require
from lcc_rl.evaluation.comparison import IDENTITY, Comparison
from lcc_rl.evaluation.episodes import plan_of
from lcc_rl.evaluation.fit import check_policy, classes, other_drivers, other_traffic
from lcc_rl.evaluation.foreign import GivenPolicy
from lcc_rl.evaluation.named import DIRECT, controller_of, is_policy, is_shipped, label_of
from lcc_rl.evaluation.strategies import (
    POLICY,
    Strategy,
    TrainedPolicy,
    applies,
    baselines,
    beside_filtered,
    check_distinct,
    front_of,
    named_apart,
    no_policy,
    studied,
    trained,
)
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.io.files import FEW, Rows, parquet_metadata
from lcc_rl.results.names import counted_windows, in_words, several
from lcc_rl.results.platoons import case_report
from lcc_rl.results.policies import PRETRAINED, load_policy, of_task
from lcc_rl.results.remarks import few_windows, leader_too_fast, remarks
from lcc_rl.results.render import print_table, terminal
from lcc_rl.results.report import (
    Report,
    report,
    windows_for,
)
from lcc_rl.results.runs import EPISODES, check_folder, resumed_config, save_config
from lcc_rl.results.task import Task
from lcc_rl.results.units import OF_FUEL, burns_one_fuel, check_unit
from lcc_rl.results.windows import by_source
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.states import CONFIG, claim, forget, run_folders
from lcc_rl.settings import parse

log = logging.getLogger("lcc_rl")


def run(
    cfg: EvaluateConfig,
    folder: str | Path,
    own: bool = True,
    quiet: bool = False,
    replace: bool = False,
    policies: Mapping[str, GivenPolicy] | None = None,
) -> Rows:
    """Evaluate a policy or rule, compared strategies and baselines.

    All have the same profiles, drivers and noise. Writes config.yaml, steps.parquet,
    episodes.parquet and figures.

    Args:
        cfg: configuration of the entry point ``evaluate``; with ``resume`` the run in that folder
            is resumed with its settings.
        folder: folder of the results.
        own: evaluate the configuration's variant, too, not only compared strategies.
        quiet: write the rows only, without tables and figures.
        replace: overwrite an evaluation of other settings.
        policies: further policies by their names in tables.

    Returns:
        The rows of episodes.parquet; many rows as a dataset, which is read on demand.

    Raises:
        LccError: for any error in settings, data or files, in one line.
    """
    folder = Path(folder)
    if cfg.resume is not None:
        folder, cfg = Path(cfg.resume), resumed_config(cfg.resume, cfg.trust)
    else:
        cfg = with_inputs(cfg)
    with claim(folder):
        if not replace:
            check_folder(cfg, folder)
        return _run(cfg, folder, own, quiet, replace, policies or {})


def made_by(table: Path) -> str | None:
    """Return the hash of the configuration of a table; None without a table."""
    return parquet_metadata(table).get(IDENTITY) if table.exists() else None


def complete(cfg: EvaluateConfig, folder: Path) -> None:
    """Complete a run of a sweep: skip a finished one, resume a stopped one."""
    table = folder / EPISODES
    if made_by(table) == identity(cfg):
        log.info("%s: finished before", folder.name)
        return
    check_folder(cfg, folder, "inputs")  # with other files it is repeated
    run(cfg, folder, quiet=cfg.evaluation.shards > 1, replace=True)
    forget(folder)


def _run(
    cfg: EvaluateConfig,
    folder: Path,
    own: bool,
    quiet: bool,
    replace: bool,
    policies: Mapping[str, GivenPolicy],
) -> Rows:
    prepare_torch(cfg)
    check_measured(cfg)
    if cfg.policy not in (None, PRETRAINED) and not cfg.learns and not _nobody_drives(cfg):
        raise ConfigError(f"variant {cfg.variant} has no agent: remove policy={cfg.policy}")
    own = own and not only_named(cfg)
    if own:
        check_variant(cfg)
    strategies, inputs = strategies_of(cfg, own, policies)
    comparison = Comparison(cfg, inputs, strategies)
    if replace:  # rows of other settings must not be in a folder with this configuration
        (folder / EPISODES).unlink(missing_ok=True)
    save_config(cfg, folder)
    rows = evaluate_and_write(comparison, inputs, folder, quiet)
    for words in filter(None, (policy.clipped() for policy in policies.values())):
        log.warning(words)
    if not quiet:
        draw(rows, cfg, folder)
    return rows


def draw(rows: Rows, cfg: EvaluateConfig, folder: Path) -> None:
    """Draw the figures of an evaluation into its folder, unless it has too many rows."""
    if not isinstance(rows, pd.DataFrame):
        log.info("no figures: there are more than %d rows", FEW)
        return
    # Here, because a training draws nothing and need not load matplotlib.
    from lcc_rl.figures.evaluation import write_figures

    own = [name for name in rows["strategy"].unique() if not is_shipped(name)]
    write_figures(folder, cfg.evaluation.rows, list(reports(rows, cfg)), own)


def task_of(cfg: StudyConfig) -> Task | None:
    """Return the task of a configuration; None without one.

    If its unit needs a single fuel and scenario.fleet adds vehicles of another, it is kJ/km.
    """
    if cfg.task is None:
        return None
    task, energy = parse(Task, cfg.task, "task"), build_energy(cfg)
    if cfg.scenario.fleet and task.unit in OF_FUEL and not burns_one_fuel(energy):
        return dataclasses.replace(task, unit="kJ/km")
    check_unit(task.unit, energy)
    return task


def _task_name(cfg: StudyConfig) -> str | None:
    return None if cfg.task is None else str(cfg.task["name"])


def only_named(cfg: EvaluateConfig) -> bool:
    """True if ``compare=`` names every policy."""
    return bool(cfg.compare) and cfg.policy is None and cfg.learns


def compared(cfg: EvaluateConfig) -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Return the controllers of ``compare`` by their names in tables, and its policies.

    Policies are pairs of a name, if one was given, and a path; the folder of a sweep stands for
    those of its runs. If no vehicle of the string is automated, as at the share 0 of a sweep,
    nothing is compared.

    Raises:
        ConfigError: if two share a name, a name is reserved, or a controller is unknown or has no
            vehicle to drive.
    """
    named = cfg.compare
    for spec in named.values() if isinstance(named, Mapping) else named:
        require(
            isinstance(spec, (str, Node)),
            f"compare names {spec!r}: expected a name, a path or a node; for several runs, the "
            "folder that holds them",
        )
    if not isinstance(named, Mapping):
        labels = [spec if is_policy(spec) else label_of(spec) for spec in named]
        for label, count in Counter(labels).items():
            require(
                count == 1,
                f"compare names two {label}: give each a name, 'compare={{first: …, second: …}}'",
            )
        named = dict(zip(labels, named, strict=True))
    task_of(cfg)  # checks its settings before the data are read
    task = _task_name(cfg)
    policies = [
        (label if named is cfg.compare else "", of_task(run, task))
        for label, spec in named.items()
        if is_policy(spec)
        for run in _runs_of(Path(spec))
    ]
    rivals = {label: spec for label, spec in named.items() if not is_policy(spec)}
    for label, spec in rivals.items():
        _check_label(label, spec, str(spec).removesuffix(FILTERED))
        if spec != DIRECT:
            controller_of(spec)
    if _nobody_drives(cfg):
        if left := [*named, *filter(None, [cfg.policy])]:
            log.warning("no vehicle is automated; left out: %s", ", ".join(left))
        return {}, []
    for label in rivals:
        require(applies(cfg, label), f"compare={label}: it has no vehicle to drive in this string")
    return rivals, policies


def _check_label(label: str, spec: Any, own: str) -> None:
    """Refuse reserved names of rows; ``own`` is allowed for the strategy of that name."""
    plain = label.removesuffix(FILTERED)
    require(
        in_words(plain) in (plain, in_words(own)),
        f"compare names {label_of(spec)} {label}, which stands for {in_words(label)!r}: choose "
        "another",
    )


def _runs_of(path: Path) -> list[str]:
    """Return the runs with a policy in the folder of a sweep; else the path."""
    sweep = path.is_dir() and not (path / CONFIG).exists()
    runs = [run for run in run_folders(path) if (run / POLICY).is_file()] if sweep else []
    return list(map(str, runs or [path]))


def _nobody_drives(cfg: StudyConfig) -> bool:
    return AUTOMATED not in cfg.scenario.vehicles.names


def strategies_of(
    cfg: EvaluateConfig, own: bool | None = None, further: Mapping[str, GivenPolicy] | None = None
) -> tuple[list[Strategy], Inputs]:
    """Build all strategies of an evaluation, and read its inputs.

    Args:
        cfg: configuration of the entry point ``evaluate``.
        own: include the configuration's variant; None: unless ``compare`` names every policy.
        further: further policies by name.
    """
    own = not only_named(cfg) if own is None else own
    # Before the data, so that a missing file is noticed before minutes of reading.
    rivals, paths = compared(cfg)
    policy, policies = _read_policies(cfg, paths)
    check_installed(cfg, list(rivals.values()))
    for asked in [] if RECORDED in {*rivals, *cfg.evaluation.baselines} else _held_as_recorded(cfg):
        raise ConfigError(f"{asked}: add {RECORDED} to evaluation.baselines")
    if own and cfg.learns and cfg.policy is None:
        raise no_policy(cfg)
    inputs = load_inputs(cfg)
    for line in filter(None, [*inputs.report, other_drivers(cfg), classes(cfg)]):
        log.info(line)
    strategies = _rules(cfg, rivals, inputs)
    for (name, path), file in zip(paths, policies, strict=True):
        one = trained(cfg, path, file, inputs.population)
        strategies.append(dataclasses.replace(one, name=name or one.name))
    if own:
        strategies += studied(cfg, policy, inputs.population)
    for name, policy_given in (further or {}).items():
        _check_label(name, "a policy", "")
        require(cfg.learns, f"{name} is a policy, and variant {cfg.variant} has no agent")
        env = build_env(cfg, inputs.evaluation, inputs.population, 1, 0, cfg.device, nominal=True)
        policy_given.tried(env.reset())
        strategies.append(Strategy(name, cfg, policy_given))
    strategies = beside_filtered(cfg, strategies) + strategies
    strategies = named_apart(strategies)
    check_distinct(strategies)
    strategies += front_of(strategies, cfg.evaluation.front)
    for strategy in (s for s in strategies if s.source):
        log.info("%s: the policy of %s", in_words(strategy.name), strategy.source)
    return strategies, inputs


def _read_policies(
    cfg: EvaluateConfig, compared: Sequence[tuple[str, str]]
) -> tuple[TrainedPolicy | None, list[TrainedPolicy]]:
    """Read the policy under study, if there is one, and compared policies."""

    def read(path: str) -> TrainedPolicy:
        weights, own = load_policy(path, cfg.variant, tuple(cfg.trust))
        if words := other_traffic(path, own, cfg):
            log.warning(words)
        return weights, own

    studied_too = cfg.policy is not None and cfg.learns
    policy = read(of_task(str(cfg.policy), _task_name(cfg))) if studied_too else None
    if policy is not None:
        check_policy(cfg, policy[1])
    policies = [read(path) for _, path in compared]
    for (name, path), (_, own) in zip(compared, policies, strict=True):
        _check_label(name, path, own.variant)
    return policy, policies


def _rules(cfg: EvaluateConfig, rivals: Mapping[str, Any], inputs: Inputs) -> list[Strategy]:
    """Return the baselines and named controllers; ``recorded`` only with recorded drivers."""
    lacking = _lacking_record(cfg, inputs)
    for asked in [f"compare={RECORDED}"] * (RECORDED in rivals) + _held_as_recorded(cfg):
        require(not lacking, f"{asked}: {lacking}; use trajectories of several vehicles")
    if lacking and RECORDED in cfg.evaluation.baselines:
        log.warning("%s is left out: %s", RECORDED, lacking)
    return [one for one in baselines(cfg, rivals) if not lacking or one.name != RECORDED]


def _held_as_recorded(cfg: EvaluateConfig) -> list[str]:
    """Return the limits of the task that refer to the recorded drivers."""
    task = task_of(cfg)
    limits = task.limits if task else {}
    return [f"task.limits.{key}={RECORDED}" for key, bound in limits.items() if bound == RECORDED]


def _lacking_record(cfg: EvaluateConfig, inputs: Inputs) -> str:
    """Return why no vehicle can drive as a recorded driver; empty if one can."""
    if inputs.evaluation.followers is None:
        return "no driver was recorded behind these leaders"
    first = applies(cfg, RECORDED)
    return "" if first else "the automated vehicle is not the first behind the leader"


def evaluate_and_write(comparison: Comparison, inputs: Inputs, folder: Path, quiet: bool) -> Rows:
    """Play a comparison, write its rows and print the tables.

    Returns:
        The rows; many rows as a dataset, which is read on demand.
    """
    cfg, rows = comparison.cfg, comparison.play(folder)
    if cfg.evaluation.rows == "episodes":
        windows = windows_for(rows)
        for line in [*leader_too_fast(windows, cfg.task is not None), *remarks(windows)]:
            log.warning(line)
    if not quiet:
        show_tables(rows, cfg, inputs)
    return rows


def reports(rows: Rows, cfg: StudyConfig, against: str | None = None) -> Iterator[Report]:
    """Yield the report of each source of leaders or case of a platoon."""
    if isinstance(rows, pd.DataFrame) and cfg.evaluation.rows == "vehicles":
        for source, part in by_source(rows):
            of = f"{source}: " if source else ""
            for case in dict.fromkeys(part["case"]):
                yield case_report(part, case, f"{of}{case}")
        return
    filtered = cfg.scenario.filters.get(AUTOMATED) is not None
    words = list(filter(None, [other_drivers(cfg), classes(cfg)]))
    of_sweep = rows.attrs.get("remarks", ()) if isinstance(rows, pd.DataFrame) else ()
    for source, part in by_source(windows_for(rows)):
        one = report(
            part,
            task_of(cfg),
            build_energy(cfg),
            filtered,
            source,
            against=against,
            second=second_energy(cfg),
        )
        yield dataclasses.replace(one, remarks=[*one.remarks, *words, *of_sweep])


def show_tables(rows: Rows, cfg: StudyConfig, inputs: Inputs) -> None:
    """Print the tables of an evaluation, short or, with ``table=all``, full."""
    plan = plan_of(cfg, inputs)
    drivers = several(len(plan.chosen), "driver")
    drivers += f" × {plan.repeats} repeats" if plan.repeats > 1 else ""
    drivers += f", shard {plan.shard} of {plan.shards}" if plan.shards > 1 else ""
    counts = Counter(inputs.evaluation.sources or [""] * plan.profiles)
    for one in reports(rows, cfg):
        title = one.of
        if one.of in counts:
            of = [x for x in (_task_name(cfg), one.of) if x]
            windows = counted_windows(counts[one.of], "held-out " * bool(len(inputs.training)))
            warm_up = cfg.evaluation.warm_up
            size = f"{windows} × {drivers}, {cfg.scenario.horizon} steps"
            size += f", after {warm_up:g} s" if warm_up else ""
            title = ": ".join([*of, size])
        print_table(terminal(one, title, cfg.table == "all"))
    seconds = cfg.scenario.horizon * cfg.scenario.time_step
    if words := few_windows(plan.profiles, seconds):
        log.info(words)
