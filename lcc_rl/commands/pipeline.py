"""The main job: trajectories, calibration, training and evaluation."""

from __future__ import annotations

import gc
import logging
import multiprocessing
import os
import shlex
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path

import pandas as pd
from rich.console import Console

from lcc_rl import results
from lcc_rl.agents import Analytic
from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.commands.checks import check_measured, check_settings
from lcc_rl.config.compose import NOT_IDENTITY, config_hash, load, with_inputs
from lcc_rl.config.nodes import Node, as_plain
from lcc_rl.config.schemas import (
    KINDS,
    CalibrateConfig,
    EvaluateConfig,
    PipelineConfig,
    TrainConfig,
)
from lcc_rl.config.unused import OF_COMPARISONS
from lcc_rl.config.words import key_of, top_key
from lcc_rl.data.episodes import SCHEMA
from lcc_rl.data.sources import EpisodesSource
from lcc_rl.drivers.calibrator import count_records
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.inputs import LOADS, MADE, build_energy, load_inputs, second_energy
from lcc_rl.errors import ConfigError, Interrupted, ResultsError
from lcc_rl.evaluation.fit import check_variant
from lcc_rl.figures.drawing import save
from lcc_rl.figures.evaluation import write_figures
from lcc_rl.figures.page import held_to, write_page
from lcc_rl.figures.training import training_figure
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import Rows, parquet_metadata, write_parquet
from lcc_rl.io.settings import read_text
from lcc_rl.results import runs
from lcc_rl.results.names import RULE, size_of
from lcc_rl.results.render import print_table, terminal
from lcc_rl.results.report import report, windows_for
from lcc_rl.results.trust import own_modules, trust_option
from lcc_rl.runs.interrupts import INTERRUPTED, end_with_parent
from lcc_rl.runs.output import log_report, show_headline
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.progress import watch_jobs
from lcc_rl.runs.states import CHECKPOINT, claim
from lcc_rl.settings import TARGET, path_of, values
from lcc_rl.version import __version__

log = logging.getLogger("lcc_rl")

# Settings of the pipeline only, and data, which variants with other leaders refuse. All others are
# passed to calibration and trainings.
JOB_OPTIONS = ("calibration", "variants", "jobs", "variant", "resume", "hydra", "data")
COMMAND_FILE, TRAJECTORIES = "command.txt", "trajectories.parquet"
NETWORKS = ("reference", "alcc")  # trained by default, besides the rule


def run(cfg: PipelineConfig, folder: str | Path, overrides: list[str]) -> Rows:
    """Read trajectories, calibrate drivers, train the variants, evaluate and draw.

    A folder with parts of the same job is completed.

    Args:
        cfg: configuration of the entry point ``pipeline``; with ``resume`` the job in that folder
            is resumed with its settings.
        folder: folder of ``calibration``, of a folder per variant and of ``evaluation``.
        overrides: overrides of the command line, which are passed to the parts.

    Returns:
        The rows of evaluation/episodes.parquet.

    Raises:
        LccError: for any error in settings, data or files, in one line.
    """
    folder = Path(folder)
    with claim(folder):
        if cfg.resume is None:
            trainings, final = composed_part(cfg, overrides)
            cfg = cfg.with_(variants=list(trainings))
            runs.check_folder(cfg, folder)
            command = shlex.join(["lcc-rl", "run", *overrides])
        elif (folder / COMMAND_FILE).is_file():
            read = (folder / TRAJECTORIES).exists()  # then no other data are read
            cfg = (runs.load_config if read else runs.resumed_config)(folder, cfg.trust)
            trainings = {
                x: runs.load_config(folder / runs.PARTS / x, cfg.trust) for x in cfg.variants or ()
            }
            final = runs.load_config(folder / runs.PARTS / runs.FINAL, cfg.trust)
            command = read_text(folder / COMMAND_FILE)
        else:
            raise ConfigError(f"{folder}: not the folder of a pipeline: it has no {COMMAND_FILE}")
        prepare_torch(cfg)
        for name, training in trainings.items():
            check_settings(training, folder / name)
        check_measured(final)
        runs.save_config(cfg, folder)
        for name, settings in {**trainings, runs.FINAL: final}.items():
            runs.save_config(settings, folder / runs.PARTS / name)
        with atomic_path(folder / COMMAND_FILE) as temporary:
            temporary.write_text(command, encoding="utf-8")
        return _run(cfg, trainings, final, folder, command)


def composed_part(
    cfg: PipelineConfig, overrides: list[str]
) -> tuple[dict[str, TrainConfig], EvaluateConfig]:
    """Compose the parts of a job: trainings by variant, and the evaluation."""
    for override in overrides:
        if top_key(override) == "variant":
            raise ConfigError(
                f"{override} has no effect on lcc-rl run, which trains several: use variants=[…]"
            )
    shared = [override for override in overrides if top_key(override) not in JOB_OPTIONS]
    learned = [override for override in shared if key_of(override) not in OF_COMPARISONS]
    names = cfg.variants or NETWORKS
    trainings = {name: load("train", [*learned, f"variant={name}"]) for name in names}
    for settings in trainings.values():
        check_variant(settings)
    if cfg.variants is None and trainings[names[-1]].agent.kind is Analytic:
        trainings = {RULE: load("train", [*learned, f"variant={RULE}"]), **trainings}
    final = load("evaluate", [*known_settings(shared, "evaluate"), f"variant={names[-1]}"])
    trainings = {name: training.with_(data=cfg.data) for name, training in trainings.items()}
    # It reads the policies of these trainings, with classes of the same command.
    own = (module for training in trainings.values() for module in own_modules(training))
    return trainings, final.with_(data=cfg.data, trust=list(dict.fromkeys([*final.trust, *own])))


def _run(
    cfg: PipelineConfig,
    trainings: dict[str, TrainConfig],
    final: EvaluateConfig,
    folder: Path,
    command: str,
) -> Rows:
    show_headline(f"lcc_rl {__version__}: data, drivers, policies, results into {folder}")
    read_once(cfg, folder)
    drivers = calibrate_once(cfg, folder)
    population = Node.of({TARGET: path_of(bootstrap), "path": str(drivers)}, "drivers")
    traffic = {"data": _episodes(cfg, folder), "drivers": population}
    trainings = {name: training.with_(**traffic) for name, training in trainings.items()}
    show_headline(f"training {', '.join(trainings)}, {cfg.jobs} at a time; details in */train.log")
    try:
        train_all(trainings, folder, cfg.jobs)
    except Interrupted:
        message = f"stopped; complete it with: lcc-rl run resume={folder}{trust_option(final)}"
        raise Interrupted(message) from None
    learned = [name for name in trainings if (folder / name / runs.POLICY).exists()]
    final = final.with_(**traffic, compare=[str(folder / name) for name in learned])
    show_headline("evaluating them and the baselines on held-out windows")
    paged = final.evaluation.rows == "episodes"
    rows = evaluation.run(final, folder / runs.FINAL, own=False, quiet=paged)
    if final.compare:
        curve = training_figure(results.load(folder, "training"))
        path = folder / runs.FINAL / "figures" / "learning_curve.png"
        save(curve, path, formats=cfg.figure_formats)
    if paged and isinstance(rows, pd.DataFrame):
        size = size_of(rows["profile_id"].nunique(), rows["driver_id"].nunique())
        models = build_energy(final), second_energy(final)
        one = report(windows_for(rows), None, models[0], few=True, second=models[1])
        one = replace(one, remarks=[*filter(None, [held_to(trainings.values())]), *one.remarks])
        write_figures(folder / runs.FINAL, reports=[one])
        page = write_page(folder, [command], one, size)
        print_table(terminal(one, f"Leader, car, human behind it: {size}"))
        show_headline(f"rows, figures and policies: {folder}")
        show_headline(f"page: {page}")
    return rows


def _episodes(cfg: PipelineConfig, folder: Path) -> Node:
    """Return the node of the trajectories in a job's folder."""
    settings = {TARGET: path_of(EpisodesSource), "path": str(folder / TRAJECTORIES)}
    if plausible := cfg.data.settings.get("plausible"):
        settings["plausible"] = plausible
    return Node.of(settings, "data")


def read_once(cfg: PipelineConfig, folder: Path, learns: bool = True) -> None:
    """Read the trajectories and store them, unless they exist.

    If a policy ``learns`` from them, check that they can be divided.

    Raises:
        ResultsError: if existing ones are of other settings or files.
    """
    path, data = folder / TRAJECTORIES, as_plain(cfg.data)
    digest = config_hash([data, cfg.inputs.get("data")])
    if path.exists():
        if parquet_metadata(path).get(MADE, digest) != digest:
            raise ResultsError(f"{path} is of other data; choose another folder, or remove this")
        return
    loaded = cfg.data.made(LOADS).load()
    log_report(loaded.report)
    counts = [line for line in loaded.report if line.startswith(("kept ", "read "))]
    show_headline(f"data: {(counts or loaded.report)[-1]}")
    if learns:
        load_inputs(cfg, loaded.episodes).to_learn_from()
    episodes = loaded.episodes[list(SCHEMA)].astype({**SCHEMA, "recording": str})
    write_parquet(episodes, path, {MADE: digest, "report": "\n".join(loaded.report)})


def calibrate_once(cfg: PipelineConfig, folder: Path) -> Path:
    """Calibrate drivers to the trajectories in the folder, unless this is done."""
    drivers = folder / "calibration" / "drivers.parquet"
    shared = values(cfg, CalibrateConfig)
    settings = CalibrateConfig(**shared | {"data": _episodes(cfg, folder)})
    runs.check_folder(settings, drivers.parent)
    if not drivers.exists():
        fits = calibration.run(settings, drivers.parent, Console(quiet=True), emit=log_report)
        modes = {str(mode): rows for mode, rows in fits.groupby("mode", sort=False)}
        errors = (f"{mode} {100.0 * x['rmspe'].mean():.2f} %" for mode, x in modes.items())
        records = count_records(next(iter(modes.values())))
        show_headline(f"calibrated {records}: mean RMSPE {', '.join(errors)}")
    return drivers


def train_all(parts: dict[str, TrainConfig], folder: Path, jobs: int) -> None:
    """Run trainings in parallel, each in its own process and folder; finished ones are skipped.

    Args:
        parts: the trainings by their folders below ``folder``.
        folder: the job's folder.
        jobs: number of parallel trainings.

    Raises:
        LccError: the error of the first failed training, after all others ended.
        Interrupted: on SIGINT or SIGTERM, after all running trainings saved their state.
    """
    parts = {name: with_inputs(cfg) for name, cfg in parts.items()}
    todo = {name: cfg for name, cfg in parts.items() if not _finished(folder / name, cfg)}
    # A new interpreter per training: forking a process with torch's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _prepare_process) as pool:
        futures: dict[str, Future[None]] = {
            name: pool.submit(_train_one, cfg, str(folder / name)) for name, cfg in todo.items()
        }
        try:
            watch_jobs({name: (folder / name, future) for name, future in futures.items()})
            for future in futures.values():
                future.result()
        except (KeyboardInterrupt, BrokenProcessPool):
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()  # a training saves its state first
            raise Interrupted("stopped; the same command resumes it") from None


def _prepare_process() -> None:
    """Prepare a process of the pool."""
    gc.freeze()  # later garbage collection skips modules
    logging.getLogger().setLevel(logging.INFO)
    logging.raiseExceptions = False  # a failing log must not end a training
    end_with_parent()


def _train_one(cfg: TrainConfig, folder: str) -> None:
    """Train one variant with its own log file, in a process of the pool."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    if (target / CHECKPOINT).exists():
        cfg = cfg.with_(resume=folder)
    handler = logging.FileHandler(target / "train.log", encoding="utf-8")
    handler.setFormatter(logging.Formatter("[%(asctime)s][%(levelname)s] %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        training.run(cfg, target, quiet=True)
    except Interrupted:
        os._exit(INTERRUPTED)  # else the pool would start the next training in this process
    finally:
        root.removeHandler(handler)
        handler.close()


def _finished(folder: Path, cfg: TrainConfig) -> bool:
    """Whether a training is complete; other settings are refused."""
    runs.check_folder(cfg, folder, *NOT_IDENTITY)
    return (folder / runs.EPISODES).exists()


def known_settings(overrides: list[str], entry: str) -> list[str]:
    """Return the overrides of settings that an entry point has."""
    names = {"experiment", *KINDS[entry].__dataclass_fields__}
    return [override for override in overrides if top_key(override) in names]
