"""The commands with settings: ``lcc-rl run``, ``train``, ``evaluate`` and ``calibrate``."""

from __future__ import annotations

import logging

from hydra.core.hydra_config import HydraConfig

from lcc_rl.cli.entry import entry_point, resumed_folder, run_folder
from lcc_rl.config.compose import is_sweep
from lcc_rl.config.schemas import CalibrateConfig, EvaluateConfig, PipelineConfig, TrainConfig
from lcc_rl.config.words import top_key
from lcc_rl.runs.output import headlines

log = logging.getLogger("lcc_rl")


@entry_point("pipeline", "lcc_rl.commands.pipeline")
def run(cfg: PipelineConfig) -> None:
    """Run the main job into its folder, or complete that of ``resume``."""
    from lcc_rl.commands import pipeline  # loads torch

    folder = resumed_folder(cfg)
    typed, chosen = HydraConfig.get().overrides.task, HydraConfig.get().runtime.choices
    own = [] if any(top_key(item) == "experiment" for item in typed) else ["experiment"]
    with headlines():  # the parts are composed from the overrides
        pipeline.run(cfg, folder, [*(f"{key}={chosen[key]}" for key in own), *typed])


@entry_point("train", "lcc_rl.commands.training")
def train(cfg: TrainConfig) -> None:
    """Train a variant into the run's folder, and evaluate it on held-out windows."""
    from lcc_rl.commands import training  # loads torch

    folder = resumed_folder(cfg)
    (training.complete if is_sweep() else training.run)(cfg, folder)
    log.info("results in %s", folder)


@entry_point("evaluate", "lcc_rl.commands.evaluation")
def evaluate(cfg: EvaluateConfig) -> None:
    """Evaluate a policy and baselines into the run's folder."""
    from lcc_rl.commands import evaluation  # loads torch

    folder = resumed_folder(cfg)
    work = evaluation.complete if is_sweep() else evaluation.run
    work(cfg, folder, typed=HydraConfig.get().overrides.task)
    log.info("results in %s", folder)


@entry_point("calibrate", "lcc_rl.commands.calibration")
def calibrate(cfg: CalibrateConfig) -> None:
    """Calibrate drivers from trajectories into the run's folder."""
    from lcc_rl.commands import calibration  # loads torch

    calibration.run(cfg, run_folder())
