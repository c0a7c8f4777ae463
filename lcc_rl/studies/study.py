"""Settings of a study with trainings."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lcc_rl.errors import require
from lcc_rl.settings import MOST_PARALLEL


@dataclass(frozen=True)
class Study:
    """The settings of a study.

    Args:
        folder: the study's folder.
        recipe: ``experiment`` of every training; None for the defaults of the agent.
        seeds: number of trainings of every learned variant, numbered from 0.
        overrides: further settings of all runs, including data and calibration.
        jobs: number of parallel trainings.

    Raises:
        ConfigError: naming a setting that is out of range.
    """

    folder: Path
    recipe: str | None = None
    seeds: int = 8
    overrides: tuple[str, ...] = ()
    jobs: int = 2

    def __post_init__(self) -> None:
        for name, most in (("seeds", 10**6), ("jobs", MOST_PARALLEL)):
            given = getattr(self, name)
            require(1 <= given <= most, f"{name} must lie from 1 to {most}, got {given}")
