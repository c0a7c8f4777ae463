"""The task of a configuration, and whom it compares."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lcc_rl.agents.factory import learns
from lcc_rl.config.nodes import TARGET, build
from lcc_rl.config.schemas import EvaluateConfig, StudyConfig
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import unknown_name
from lcc_rl.evaluation.strategies import rules
from lcc_rl.results.policies import PRETRAINED
from lcc_rl.results.scores import Task
from lcc_rl.results.units import check_unit

TASK = f"{Task.__module__}.{Task.__name__}"


def task_of(cfg: StudyConfig) -> Task | None:
    """Return the task of a configuration; None without one.

    Raises:
        ConfigError: naming the option at fault.
    """
    if cfg.task is None:
        return None
    task: Task = build({TARGET: TASK, **cfg.task}, "task", Task)
    check_unit(task.unit, build_energy(cfg))
    return task


def only_named(cfg: EvaluateConfig) -> bool:
    """Whether a task compares those that are named only: nobody's policy is its own variant's."""
    return task_of(cfg) is not None and bool(cfg.compare) and cfg.policy is None and learns(cfg)


def check_named(names: Sequence[str]) -> None:
    """Check that whom ``compare`` names exists: a controller, a baseline, a folder or a policy.

    Raises:
        ConfigError: naming the nearest that does.
    """
    for name in names:
        plain_name = Path(name).name == name and not Path(name).suffix
        if plain_name and name not in rules() and name != PRETRAINED and not Path(name).exists():
            known = [*rules(), PRETRAINED, "<run folder>", "<policy.pt>"]
            raise unknown_name("strategy (compare)", name, known)
