"""Schemas of the configurations: which keys exist and of which type; values stand in conf/."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from lcc_rl.config_types import check_numbers
from lcc_rl.errors import LAST_SEED, ConfigError, require_in, require_whole, unknown_name
from lcc_rl.targets import TARGET, settings_at


@dataclass
class ScenarioConfig:
    """A scenario: its clock, its string of vehicles and its pieces."""

    name: str = MISSING
    horizon: int = MISSING
    time_step: float = MISSING
    string: Any = MISSING
    road: str = MISSING
    circumference: float | None = None
    vehicle_length: float = MISSING
    initial_speed: float = MISSING
    controllers: dict[str, Any] = field(default_factory=dict)
    start: dict[str, Any] = field(default_factory=dict)
    filters: dict[str, Any] = field(default_factory=dict)
    pieces: dict[str, Any] = field(default_factory=dict)


@dataclass
class RewardConfig:
    """The reward: named terms."""

    terms: dict[str, Any] = field(default_factory=dict)


@dataclass
class TrainingConfig:
    """Length and bookkeeping of a training; the algorithm's own settings are the agent's."""

    episodes: int = MISSING
    environments: int = MISSING
    segment: int = MISSING
    checkpoint_every: int = MISSING
    keep_every: int | None = None
    compiled: bool | None = None
    collector: str = "string"
    gap_range: list[float] = MISSING


@dataclass
class EvaluationConfig:
    """Size of an evaluation, and what a row of its table is: an episode or a vehicle."""

    rows: str = MISSING
    baselines: list[str] = MISSING
    profiles: int | None = MISSING
    drivers: int | None = MISSING
    batch_size: int = MISSING
    seed: int = MISSING
    sample_episodes: int = MISSING
    repeats: int = MISSING
    shards: int = MISSING
    shard: int = MISSING
    compiled: bool | None = None
    full_length: bool = False


@dataclass
class StudyConfig:
    """What every entry point that drives vehicles shares."""

    variant: str = MISSING
    seed: int = MISSING
    device: str = MISSING
    threads: int = MISSING
    matmul_precision: str = "highest"
    data: Any = MISSING
    drivers: Any = MISSING
    split: Any = MISSING
    leader: Any = None
    energy: Any = None
    task: Any = None
    scenario: ScenarioConfig = field(default_factory=ScenarioConfig)
    observation: Any = MISSING
    reward: RewardConfig = field(default_factory=RewardConfig)
    agent: Any = MISSING
    gains: Any = None
    # Drives the automated vehicles once the policy is trained; None: the policy itself.
    deployed: Any = None
    # Here, not in TrainConfig, so that one recipe serves every entry point.
    training: TrainingConfig = field(default_factory=TrainingConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    figure_formats: list[str] = MISSING
    trust: list[str] = field(default_factory=list)


@dataclass
class TrainConfig(StudyConfig):
    """``lcc-rl train``."""

    resume: str | None = None
    sweep: str | None = None
    objective: Any = "total_path_energy_kj"
    policy: str | None = None
    logger: Any = MISSING


@dataclass
class EvaluateConfig(StudyConfig):
    """``lcc-rl evaluate``."""

    resume: str | None = None
    sweep: str | None = None
    policy: str | None = None
    compare: list[str] = field(default_factory=list)


@dataclass
class PipelineConfig(TrainConfig):
    """``lcc-rl run``."""

    calibration: Any = MISSING
    variants: list[str] = MISSING
    jobs: int = MISSING


# Ranges of the numbers above; other numbers are checked by the classes that take them.
RANGES = {
    "scenario.time_step": "[0.001, 10]",
    "scenario.circumference": "(0, inf)",
    "scenario.vehicle_length": "(0, inf)",
    "scenario.initial_speed": "[0, inf)",
}
MOST_PARALLEL = max(64, 4 * (os.cpu_count() or 1))  # threads or processes of a command
WHOLE: dict[str, tuple[int, ...]] = {
    **dict.fromkeys(("seed", "evaluation.seed"), (0, LAST_SEED)),
    **dict.fromkeys(("threads", "jobs"), (1, MOST_PARALLEL)),
    "scenario.horizon": (1, 1_000_000),
    **{
        f"training.{name}": (1,)
        for name in ("episodes", "environments", "segment", "checkpoint_every", "keep_every")
    },
    **{f"evaluation.{name}": (1,) for name in ("profiles", "drivers", "batch_size")},
    **{f"evaluation.{name}": (1, 1_000_000) for name in ("repeats", "shards")},
    **dict.fromkeys(("evaluation.sample_episodes", "evaluation.shard"), (0,)),
}


FORMATS = ("png", "pdf", "svg")  # of figures; pages show the first


def check_formats(formats: Sequence[str]) -> None:
    """Check the formats in which figures are written.

    Raises:
        ConfigError: if one is unknown, or the one that pages show is missing.
    """
    for name in formats:
        if name not in FORMATS:
            raise unknown_name("format (figure_formats)", str(name), FORMATS)
    if FORMATS[0] not in formats:
        raise ConfigError(
            f"figure_formats must name {FORMATS[0]}, which pages show, got {list(formats)}"
        )


def check_ranges(cfg: Any) -> None:
    """Check that a configuration is whole, its numbers finite, and the schema's in their range.

    Args:
        cfg: configuration of an entry point, or a part such as ``{"scenario": …}``.

    Raises:
        ConfigError: naming the first key at fault.
    """
    try:
        everything = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:  # a reference to nothing, or in a circle
        raise ConfigError(" ".join(str(error).split())) from error
    schema = OmegaConf.get_type(cfg)
    lacking = [x.name for x in fields(schema) if x.name not in cfg] if is_dataclass(schema) else []
    # Of an object, who builds it says what it lacks.
    lacking += [
        key for key, node, value in settings_at(everything) if value == "???" and TARGET not in node
    ]
    if lacking:
        raise ConfigError(f"{lacking[0]} is required: say {lacking[0]}=…")
    for key in (*RANGES, *WHOLE):
        value = OmegaConf.select(cfg, key)
        if value is None:
            continue
        where, _, name = key.rpartition(".")
        if key in RANGES:
            require_in(where, RANGES[key], **{name: value})
        else:
            require_whole(where, *WHOLE[key], **{name: value})
    if "figure_formats" in cfg:
        check_formats(cfg.figure_formats)
    check_numbers(everything, "")


def register_schemas() -> None:
    """Make the schemas known to Hydra; each yaml names its own first in its defaults."""
    store = ConfigStore.instance()
    for name, schema in (
        ("train_schema", TrainConfig),
        ("evaluate_schema", EvaluateConfig),
        ("pipeline_schema", PipelineConfig),
    ):
        store.store(name=name, node=schema)
