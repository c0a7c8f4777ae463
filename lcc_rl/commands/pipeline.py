"""The main job: from trajectories over calibration and training to an evaluation with figures."""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import threading
from collections.abc import Sequence
from concurrent.futures import Future, ProcessPoolExecutor, wait
from dataclasses import fields
from io import StringIO
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from lcc_rl import results
from lcc_rl.cli.entry import root_key
from lcc_rl.commands import calibration, evaluation, training
from lcc_rl.commands.checks import check_settings, check_sizes
from lcc_rl.config import load, raw
from lcc_rl.config.nodes import forget_places, with_defaults
from lcc_rl.config.schemas import KINDS, CalibrateConfig, PipelineConfig, TrainConfig, as_plain
from lcc_rl.data.episodes import write_episodes
from lcc_rl.envs.inputs import build_source, load_inputs
from lcc_rl.errors import Interrupted, ResultsError, require
from lcc_rl.figures.drawing import save
from lcc_rl.figures.main_page import as_rich, caption_of, write_page
from lcc_rl.figures.training import training_figure
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import Rows
from lcc_rl.io.settings import read_json
from lcc_rl.results.tables import show
from lcc_rl.results.trust import check_targets
from lcc_rl.runs.console import tell
from lcc_rl.runs.interrupts import INTERRUPTED
from lcc_rl.runs.precision import prepare_torch
from lcc_rl.runs.progress import watch
from lcc_rl.runs.states import claim

log = logging.getLogger("lcc_rl")

# Settings that only the pipeline has, and data, which a variant with other leaders would refuse;
# all others are passed on to calibration and trainings.
OWN = ("calibration", "variants", "jobs", "variant", "resume", "hydra", "data")
PATIENCE = 20.0  # a training ends after the iteration at hand [s]
OVERRIDES, TRAJECTORIES = "overrides.json", "trajectories.parquet"
EPISODES_SOURCE = "lcc_rl.data.sources.EpisodesSource"
BOOTSTRAP = "lcc_rl.drivers.population.bootstrap"


def run(cfg: PipelineConfig, folder: str | Path, overrides: list[str]) -> Rows:
    """Read trajectories, calibrate drivers, train the variants, evaluate and draw.

    A folder that already holds parts of the same job is completed.

    Args:
        cfg: configuration of the entry point ``pipeline``.
        folder: where everything goes: ``calibration``, a folder per variant, ``evaluation``.
        overrides: what was typed on the command line; passed on to the parts.

    Returns:
        The rows of evaluation/episodes.parquet.

    Raises:
        LccError: one clear error for whatever is wrong with settings, data or files.
    """
    with claim(Path(folder)):
        return _run(cfg, Path(folder), overrides)


def _run(cfg: PipelineConfig, folder: Path, overrides: list[str]) -> Rows:
    prepare_torch(cfg)
    require(bool(cfg.variants), "variants is empty: name at least one, e.g. variants=[alcc]")
    for item in overrides:
        require(
            root_key(item) != "variant",
            f"{item} has no effect on lcc-rl run, which trains several: say variants=[…]",
        )
    shared = [item for item in overrides if root_key(item) not in OWN]
    # Every part is composed before the first one runs: a typo must not cost an hour.
    parts = {name: load("train", [*shared, f"variant={name}"]) for name in cfg.variants}
    final = load("evaluate", [*known_settings(shared, "evaluate"), f"variant={cfg.variants[-1]}"])
    for part in (*parts.values(), final):
        part.data = cfg.data
    for name, part in parts.items():
        check_settings(part, folder / name)
    check_sizes(final)
    with atomic_path(folder / OVERRIDES) as temporary:
        temporary.write_text(json.dumps(overrides))
    drivers = calibrate_once(cfg, folder)
    for part in (*parts.values(), final):
        part.data = with_defaults(_episodes(cfg, folder))
        part.drivers = with_defaults({"_target_": BOOTSTRAP, "path": str(drivers)})
    tell(f"training {', '.join(cfg.variants)}, {cfg.jobs} at a time; details in */train.log")
    _train_all(parts, folder, cfg.jobs)
    final.compare = [
        str(folder / name) for name in cfg.variants if (folder / name / "policy.pt").exists()
    ]
    tell("evaluating them and the baselines on held-out windows")
    paged = final.evaluation.rows == "episodes"
    rows = evaluation.run(final, folder / "evaluation", own=False, quiet=paged)
    if final.compare:
        curve = training_figure(results.load(folder, "training"))
        place = folder / "evaluation" / "figures" / "learning_curve.png"
        save(curve, place, formats=cfg.figure_formats)
    if paged and isinstance(rows, pd.DataFrame):
        _conclude(folder, overrides, caption_of(parts.values()))
    return rows


def _conclude(folder: Path, overrides: list[str], caption: str) -> None:
    """Draw the figures, print the headline and write the page."""
    evaluation.draw(folder / "evaluation")
    page, table = write_page(folder, [" ".join(["lcc-rl run", *overrides])], caption)
    title = "A leader, the car, and a human driver behind it: held-out windows"
    show(as_rich(table, title, caption))
    tell(f"rows, figures and policies: {folder}")
    tell(f"page: {page}")


def stored_overrides(path: Path, trust: Sequence[str]) -> list[str]:
    """Read what a stopped job was started with, which may come from somebody else.

    Args:
        path: the file.
        trust: modules outside this package that it may name.

    Raises:
        ResultsError: if it is damaged, or names foreign code or a place to write.
    """
    overrides = read_json(path)
    if not isinstance(overrides, list) or not all(isinstance(item, str) for item in overrides):
        raise ResultsError(f"{path}: damaged: expected a list of settings")
    overrides = [item for item in overrides if root_key(item) != "trust"]
    for item in overrides:
        if "${" in item:
            raise ResultsError(f"{path}: {item} refers to another value; expected plain values")
    places: dict[str, str] = {}
    for content in _composed(overrides, path, trust):
        places |= {place.partition("=")[0]: place for place in forget_places(content)}
    for place in places.values():
        log.warning("%s: %s names a place to write and is left out", path, place)
    kept = [item for item in overrides if item.lstrip("+").partition("=")[0] not in places]
    if any(forget_places(content) for content in _composed(kept, path, trust)):
        raise ResultsError(f"{path}: names a place to write: {', '.join(places.values())}")
    return kept


def _composed(overrides: list[str], path: Path, trust: Sequence[str]) -> list[dict[str, Any]]:
    """Compose a job and the training of each of its variants, as plain containers."""
    shared = [item for item in overrides if root_key(item) not in OWN]
    job = _checked("pipeline", overrides, path, trust)
    parts = ([*shared, f"variant={name}"] for name in job["variants"])
    return [job, *(_checked("train", part, path, trust) for part in parts)]


def _checked(entry: str, overrides: list[str], path: Path, trust: Sequence[str]) -> dict[str, Any]:
    """Compose one configuration; its targets are checked before one of them is imported."""
    check_targets(raw(entry, overrides), str(path), trust)
    return as_plain(load(entry, overrides))


def _episodes(cfg: PipelineConfig, folder: Path) -> dict[str, Any]:
    """Return the node of the trajectories that a job keeps in its folder."""
    node: dict[str, Any] = {"_target_": EPISODES_SOURCE, "path": str(folder / TRAJECTORIES)}
    if cfg.data.get("plausible"):
        node["plausible"] = cfg.data["plausible"]
    return node


def calibrate_once(cfg: PipelineConfig, folder: Path) -> Path:
    """Read the trajectories once, keep them, and calibrate; skip what is already there."""
    table, drivers = folder / TRAJECTORIES, folder / "calibration" / "drivers.parquet"
    if not table.exists():
        loaded = build_source(cfg.data).load()
        for line in loaded.report:
            log.info(line)
        counts = [line for line in loaded.report if line.startswith(("kept ", "read "))]
        tell(f"data: {(counts or loaded.report)[-1]}")
        load_inputs(cfg, loaded.episodes).to_learn_from()  # whether they can be split
        write_episodes(loaded.episodes, table)
    if not drivers.exists():
        shared = {item.name: getattr(cfg, item.name) for item in fields(CalibrateConfig)}
        own = CalibrateConfig(**shared | {"data": _episodes(cfg, folder)})
        said = StringIO()
        found = calibration.run(own, drivers.parent, Console(file=said, width=100))
        for line in said.getvalue().splitlines():
            log.info(line)
        tell(f"drivers: {len(found)} calibrated, mean RMSPE {100.0 * found['rmspe'].mean():.2f} %")
    return drivers


def _train_all(parts: dict[str, TrainConfig], folder: Path, jobs: int) -> None:
    """Train the variants side by side, each in a process and a folder of its own."""
    todo = {name: cfg for name, cfg in parts.items() if not _finished(folder / name)}
    # A fresh interpreter per training: forking a process that has used torch's threads can hang.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, _end_with_parent) as pool:
        futures: dict[str, Future[None]] = {
            name: pool.submit(_train_one, cfg, str(folder / name)) for name, cfg in todo.items()
        }
        try:
            watch({name: (folder / name, future) for name, future in futures.items()})
            for future in futures.values():
                future.result()
        except (KeyboardInterrupt, Interrupted):
            _stop_children(list(futures.values()))
            raise Interrupted(f"stopped; complete it with: lcc-rl run resume={folder}") from None


def _stop_children(futures: list[Future[None]]) -> None:
    """Let trainings that heard the interrupt save and end; then tell those that did not."""
    _, running = wait(futures, PATIENCE)
    for process in multiprocessing.active_children() if running else ():
        process.terminate()


def _end_with_parent() -> None:
    """End this process once its parent was killed; it would wait for work forever."""
    parent = multiprocessing.parent_process()

    def wait_for_end() -> None:
        if parent is not None:
            parent.join()
            os._exit(INTERRUPTED)

    threading.Thread(target=wait_for_end, daemon=True).start()


def _train_one(cfg: TrainConfig, folder: str) -> None:
    """Train one variant; runs in a process of its own, with a log file of its own."""
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(
        filename=target / "train.log",
        level=logging.INFO,
        format="[%(asctime)s][%(levelname)s] %(message)s",
    )
    if (target / "checkpoint.pt").exists():
        cfg.resume = folder
    training.run(cfg, target, quiet=True)


def _finished(folder: Path) -> bool:
    return (folder / "episodes.parquet").exists()


def known_settings(overrides: list[str], entry: str) -> list[str]:
    """Keep the overrides that an entry point has settings for."""
    known = {"experiment", *KINDS[entry].__dataclass_fields__}
    return [item for item in overrides if root_key(item) in known]
