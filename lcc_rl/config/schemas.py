"""The typed tree of a configuration: sections with types and ranges of settings.

Values are in conf/. Objects with a ``_target_`` (pieces, agents, data …) are a
:class:`lcc_rl.config.nodes.Node`.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import AfterValidator, Field

from lcc_rl.config.nodes import Node, as_nodes, as_plain, check_nodes, check_numbers, nodes_in
from lcc_rl.errors import ConfigError, require, require_known
from lcc_rl.functional.cacc import Gains
from lcc_rl.functional.pattern import (
    AUTOMATED,
    HUMAN,
    MAX_ACCELERATION,
    VehicleString,
    parse_string,
)
from lcc_rl.settings import (
    TARGET,
    Acceleration,
    Count,
    Million,
    NonNegative,
    Parallel,
    Positive,
    Seed,
    Settings,
    Speed,
    load_module,
    parse,
    values,
)

TimeStep = Annotated[float, Field(ge=0.001, le=0.5)]  # behind US06 the tuned IDM collides at 1 s
Device = Annotated[str, Field(pattern=r"^(cpu|cuda)(:\d+)?$")]
# Each variant has a folder in the job's folder.
Variants = Annotated[list[Annotated[str, Field(pattern=r"^\w[\w.-]*$")]], Field(min_length=1)]
FORMATS = ("png", "pdf", "svg")  # formats of figures; pages show the first
Format = Literal["png", "pdf", "svg"]


def _described(node: Any) -> Any:
    if node is not None and not isinstance(node, Node):
        raise ValueError(f"expected a node with {TARGET} or null, got {node!r}")
    return node


def all_of(nodes: dict[str, Any], kind: type, added: str) -> dict[str, Any]:
    """Check that named values are of a class or None; ``added``: how they are, if there is none."""
    for name, node in nodes.items():
        if isinstance(node, Mapping):
            known = ", ".join(x for x in nodes if x != name) or f"none; {added}"
            raise ValueError(f"unknown name {name!r}, which has no {TARGET}; valid: {known}")
        if node is not None and not isinstance(node, kind):
            what = "node" if kind is Node else kind.__name__
            raise ValueError(f"{name}: expected a {what} with {TARGET} or null, got {node!r}")
    return nodes


_ADDED = "+filter=cbf or a task adds a filter, +faults=all actuators and sensors, "
_ADDED += "safety.margin=2 changes the filter that a policy keeps"
Described = Annotated[Any, AfterValidator(_described)]  # a node or None
_ALL_NODES = AfterValidator(partial(all_of, kind=Node, added=_ADDED))
Nodes = Annotated[dict[str, Any], _ALL_NODES, AfterValidator(MappingProxyType)]
AUTO = "scenario.controllers.automated"


class Section(Settings):
    """Base of a configuration and of its sections, none of which changes."""

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a configuration does not change; use with_({name}=…)")

    def __deepcopy__(self, memo: Any) -> Self:
        return self

    def __reduce__(self) -> Any:  # constructed anew in another process
        plain = {key: dict(x) if _is_nodes(x) else x for key, x in values(self).items()}
        return partial(type(self), **plain), ()

    def with_(self, **changes: Any) -> Self:
        """Return the configuration with other settings.

        Args:
            changes: new values by name; the changes of a section, and of a mapping of nodes, as a
                mapping, in which None leaves a node out.

        Raises:
            ConfigError: naming the first unknown or wrong setting.

        Examples:
            >>> cfg.with_(seed=3, scenario={"filters": {"automated": None}})  # doctest: +SKIP
        """
        stored = values(self)
        changed = {key: _changed(stored.get(key), value) for key, value in changes.items()}
        return type(self)(**{**stored, **changed})


def _is_nodes(value: Any) -> bool:
    return isinstance(value, MappingProxyType)


def _changed(value: Any, change: Any) -> Any:
    """Return a value of a configuration after a change, see :meth:`Section.with_`."""
    if isinstance(value, Section) and isinstance(change, Mapping):
        return value.with_(**change)
    if not _is_nodes(value):
        return change
    return {key: node for key, node in {**value, **change}.items() if node is not None}


class ScenarioConfig(Section):
    """A scenario: clock, string of vehicles and pieces."""

    name: str
    horizon: Million  # steps of an episode
    time_step: TimeStep  # [s]
    string: str | dict[str, Any]  # roles from front to back, see docs/strings.md
    road: Literal["open", "ring"]
    circumference: Positive | None = None  # circumference of a ring [m]
    # Range of a factor on it in training; 1 in evaluation.
    circumference_range: list[Positive] = Field(default_factory=lambda: [1.0, 1.0])
    vehicle_length: Positive  # [m]
    initial_speed: Speed  # on a ring [m/s]
    # Limits of automated vehicles, for every controller, filter and policy [m/s²].
    max_braking: Acceleration = MAX_ACCELERATION
    max_acceleration: Acceleration = MAX_ACCELERATION
    controllers: Nodes
    start: Nodes
    filters: Nodes
    actuators: Nodes = Field(default_factory=dict)
    sensors: Nodes = Field(default_factory=dict)
    fleet: Nodes = Field(default_factory=dict)  # further classes of vehicles
    pieces: Nodes

    def validate(self) -> None:
        for role in self.vehicles.names:
            roles = ", ".join(name for name, node in self.controllers.items() if node)
            message = (
                f"scenario.string has the role {role!r}, but scenario.controllers names only "
                f"{roles}; use +controller@scenario.controllers.{role}=… for another"
            )
            require(self.controllers.get(role) is not None, message)

    @property
    def vehicles(self) -> VehicleString:
        """The string of vehicles of ``string`` and ``road``.

        Raises:
            ConfigError: naming the position in the pattern that cannot be parsed.
        """
        return parse_string(self.string, self.road)

    def is_exact(self, role: str) -> bool:
        """Whether a role has neither actuators nor sensors."""
        return self.actuators.get(role) is None and self.sensors.get(role) is None

    @property
    def replaced(self) -> bool:
        """Whether the leader is replaced during episodes."""
        leader = self.pieces.get("leader")
        return leader is not None and getattr(leader.kind, "replaces", False)

    @property
    def perturbation(self) -> float:
        """The perturbation of the leader's speed in training."""
        leader = self.pieces.get("leader")
        return 0.0 if leader is None else float(leader.settings.get("perturbation", 0.0))

    @property
    def slope(self) -> Node | None:
        """The node of the road's grade; None: the road is level."""
        return self.pieces.get("slope")


class RewardConfig(Section):
    """The reward: named terms."""

    terms: Nodes

    def validate(self) -> None:
        for name in (name for name, node in self.terms.items() if node is None):
            raise ConfigError(f"reward.terms.{name} is null; ~reward.terms.{name} leaves it out")


class TrainingConfig(Section):
    """Length and checkpoints of a training; settings of the algorithm belong to the agent."""

    episodes: Count
    environments: Count
    segment: Count
    checkpoint_every: Count
    keep_every: Count | None = None
    compiled: bool | None = None
    collector: Literal["string", "torchrl"] = "string"
    gap_range: list[float]

    def validate(self) -> None:
        size = self.environments
        vars(self).update(episodes=-(-self.episodes // size) * size)


class EvaluationConfig(Section):
    """Size of an evaluation, and the subject of its rows: an episode or a vehicle."""

    rows: Literal["episodes", "vehicles"]
    baselines: list[str]
    behind_filter: list[str] = dataclasses.field(default_factory=list)
    profiles: Count | None
    drivers: Count | None
    batch_size: Count
    seed: Seed
    sample_episodes: Annotated[int, Field(ge=0)]
    repeats: Million
    shards: Million
    shard: Annotated[int, Field(ge=0)]
    sample_mb: Positive | None = None  # largest size of steps.parquet, else every n-th step
    compiled: bool | None = None
    full_length: bool = False
    humans_first: NonNegative = 0.0  # time with human drivers only, on a ring, not measured [s]
    warm_up: NonNegative = 0.0  # first seconds of an episode, in which only collisions count [s]
    # Further longest time gaps of the safety filter, for savings at equal flow [s].
    front: list[Positive] = dataclasses.field(default_factory=list)
    second_energy: Described = None  # energy model of a second saving
    terms: bool = False  # means of the reward's terms, of networks

    def validate(self) -> None:
        for name in ("baselines", "behind_filter", "front"):
            for item, count in Counter(getattr(self, name)).items():
                require(count == 1, f"evaluation.{name} names {item} {count} times")
        if self.shard >= self.shards:
            raise ConfigError(
                f"evaluation.shard must lie from 0 to {self.shards - 1}, got {self.shard}"
            )
        if self.warm_up and self.rows != "episodes":
            raise ConfigError("evaluation.warm_up needs evaluation.rows=episodes")


class BaseConfig(Section):
    """Settings that all commands share."""

    seed: Seed
    device: Device  # cpu, cuda or cuda:<number>
    threads: Parallel
    matmul_precision: Literal["highest", "high", "medium"] = "highest"
    data: Described  # null in shipped policies, as drivers and split
    figure_formats: list[Format]  # beside png, which pages show
    trust: list[str] = dataclasses.field(default_factory=list)
    # Hashes of input files, see lcc_rl.config.inputs, recorded by a run.
    inputs: dict[str, dict[str, str]] = dataclasses.field(default_factory=dict)


class CalibrateConfig(BaseConfig):
    """``lcc-rl calibrate``."""

    calibration: Described


class StudyConfig(BaseConfig):
    """Settings of all commands that simulate vehicles."""

    variant: str
    drivers: Described
    split: Described
    leader: Described = None
    energy: Described = None
    task: dict[str, Any] | None = None
    scenario: ScenarioConfig
    observation: Described
    reward: RewardConfig
    agent: Described
    gains: Any = None
    # Controller of the automated vehicles after training; None: the policy.
    deployed: Described = None
    # Here, not in TrainConfig, so that a recipe fits every entry point.
    training: TrainingConfig
    evaluation: EvaluationConfig
    resume: str | None = None
    sweep: str | None = None
    policy: str | None = None
    table: Literal["short", "all"] = "short"  # printed table: six columns, or all measures
    unit: str | None = None  # of energy per distance in printed tables, see lcc_rl.results.task
    # Modules that register measures, see lcc_rl.evaluation.metrics.register.
    measures: list[str] = dataclasses.field(default_factory=list)

    @property
    def learns(self) -> bool:
        """Whether there is an agent."""
        return self.agent is not None

    @property
    def automated(self) -> int:
        """Number of automated vehicles."""
        return self.scenario.vehicles.count(AUTOMATED)

    def driven_by(self, controller: Node) -> Self:
        """Return it with another controller of the automated vehicles, for the same policy."""
        before = self.scenario.controllers.get(AUTOMATED)
        scale = before and before.settings.get("max_acceleration")
        if scale and controller.settings.get("action_scale", 0.0) is None:
            controller = controller.changed(action_scale=scale)
        return self.with_(deployed=None, scenario={"controllers": {AUTOMATED: controller}})

    def after_training(self) -> Self:
        """Return the configuration with the controller that is used after training."""
        return self if self.deployed is None else self.driven_by(self.deployed)

    def without_equipment(self) -> Self:
        """Return it without filter, actuators and sensors of the automated vehicles."""
        groups = ("filters", "actuators", "sensors")
        return self.with_(scenario={group: {AUTOMATED: None} for group in groups})

    def without_automated(self) -> Self:
        """Return the configuration without automated vehicles."""
        roles = [role for role in self.scenario.vehicles.roles if role != AUTOMATED]
        return self.with_(scenario={"string": " ".join(roles)})

    def is_fixed(self, further: Sequence[Node] = ()) -> bool:
        """Whether a platoon, with further controllers, depends on no drivers and no noise."""
        scenario = self.scenario
        if self.evaluation.rows != "vehicles" or {*scenario.vehicles.names} != {AUTOMATED}:
            return False
        own = scenario.with_(controllers={HUMAN: None}, start={HUMAN: None})
        nodes = nodes_in([own, self.deployed, *further])
        return all(getattr(node.kind, "steady", False) for node in nodes)

    def for_any_leader(self) -> Self:
        """Return the configuration with a leader that may play any record."""
        leader = self.scenario.pieces.get("leader")
        if leader is None or leader.settings.get("profile") is None:
            return self
        return self.with_(scenario={"pieces": {"leader": leader.changed(profile=None)}})

    def validate(self) -> None:
        for module in self.measures:
            load_module(module, "measures")
        require_known("setting of gains", self.gains or (), Gains.__dataclass_fields__)


class TrainConfig(StudyConfig):
    """``lcc-rl train``."""

    logger: Described = None


class EvaluateConfig(StudyConfig):
    """``lcc-rl evaluate``."""

    # Policies and controllers, see lcc_rl.evaluation.named, optionally by name.
    compare: list[Any] | dict[str, Any] = dataclasses.field(default_factory=list)
    # Changed settings of every row's safety filter, also of one that a policy keeps.
    safety: dict[str, Any] = dataclasses.field(default_factory=dict)


class PipelineConfig(TrainConfig):
    """``lcc-rl run``."""

    calibration: Described
    variants: Variants | None = None  # at least one
    jobs: Parallel


KINDS: dict[str, type[BaseConfig]] = {
    "train": TrainConfig,
    "evaluate": EvaluateConfig,
    "pipeline": PipelineConfig,
    "calibrate": CalibrateConfig,
}
SECTIONS: dict[str, type[Section]] = {
    "scenario": ScenarioConfig,
    "reward": RewardConfig,
    "training": TrainingConfig,
    "evaluation": EvaluationConfig,
}


def parse_config(content: Mapping[str, Any], kind: type[BaseConfig] | None = None) -> Any:
    """Return the checked, typed tree of a configuration.

    Args:
        content: a configuration as plain containers or nodes, with the defaults of classes.
        kind: class of the tree; by default that of the command with these settings.

    Raises:
        ConfigError: naming the first unknown or wrong setting.
    """
    given = {kind: {x.name for x in dataclasses.fields(kind)} for kind in KINDS.values()}
    kind = kind or min(given, key=lambda x: len(given[x] ^ content.keys()))
    check_numbers(content, "")
    nodes, names = as_nodes(content), given[kind]
    check_nodes(nodes)
    for name, section in SECTIONS.items():
        if name in nodes and name in names:
            if not isinstance(nodes[name], Mapping):
                raise ConfigError(f"{name} must be a mapping of settings, got {nodes[name]!r}")
            nodes[name] = parse(section, nodes[name], name)
    return parse(kind, nodes, "")


def as_text(cfg: Settings) -> str:
    """Return a typed tree as YAML, see :func:`parse_config`."""
    return str(yaml.safe_dump(as_plain(cfg), sort_keys=False, allow_unicode=True))
