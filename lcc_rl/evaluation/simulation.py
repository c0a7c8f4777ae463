"""Simulation of a string of vehicles behind given leaders: tables of their motion."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from lcc_rl.arrays import times
from lcc_rl.config import load
from lcc_rl.config.nodes import Node
from lcc_rl.config.schemas import RewardConfig, StudyConfig, TimeStep
from lcc_rl.config.words import check_overrides, quoted, top_key
from lcc_rl.data.plausible import Plausible
from lcc_rl.data.profiles import Profiles, from_records, no_profiles, resample
from lcc_rl.data.speed_records import read_speed_record
from lcc_rl.envs.factory import build_env
from lcc_rl.envs.inputs import POPULATION, Inputs, build_drivers, build_energy, constant_profiles
from lcc_rl.errors import ConfigError, DataError, in_short, raised_as, require
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.evaluation.foreign import GivenPolicy, as_given
from lcc_rl.evaluation.metrics import (
    METRICS,
    ROAD_METRICS,
    SERIES,
    Reductions,
    energy_measures,
    safety_measures,
)
from lcc_rl.evaluation.named import controller_of, is_policy, one_of, value_of
from lcc_rl.evaluation.rollout import Player, Record, reset_options, warn_of_brakes, warn_of_idle
from lcc_rl.evaluation.rows import INDEX, highest
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED, HUMAN, RING
from lcc_rl.pieces.base import Key, State
from lcc_rl.pieces.connected import MESSAGES
from lcc_rl.pieces.features import CLASS, GRADE
from lcc_rl.pieces.rewards import CollisionPenalty
from lcc_rl.pieces.slope import PLACE
from lcc_rl.settings import TARGET, Count, Positive, Seed, checked, path_of

log = logging.getLogger("lcc_rl")

# Machine code, which takes seconds to compile once, pays from so many steps on; translating more
# vehicles takes longer than their steps.
LONG, SHORT_STRING = 2_000, 40
BLOCK = 2**20  # numbers of each entry that are measured at a time
LEADER: Key = ("leader", "speed")
SCENE = {"experiment", *(f"scenario.{name}" for name in ("string", "time_step", "horizon"))}
OF_FILES = {"leader", "data"}
OF_TABLES = {"unit", "table"}
OF_ARGUMENTS = SCENE | OF_TABLES | {"split", "compare", "policy", "seed", "evaluation", "reward"}
# Nothing reads the reward; this term fits any scenario.
UNREAD = RewardConfig(terms={"collision": Node.of({TARGET: path_of(CollisionPenalty)}, "reward")})
MOTION = {
    "speed": "speed_mps",
    "gap": "gap_m",
    "acceleration": "acceleration_mps2",
    "power": "power_w",
    PLACE: "place_m",  # this and the next on a road with slopes
    GRADE: "grade_rad",
}
AT_START = {"gap", PLACE, GRADE}  # also known before the first step


@dataclass(frozen=True)
class Simulation:
    """The motion of strings of vehicles.

    Args:
        steps: a row per episode, time and vehicle; vehicle 0 is the leader, the others are from
            front to back. ``acceleration_mps2`` and ``power_w`` are those of the step that ends at
            ``time_s``; energies add ``energy.grade`` to the slope's ``grade_rad``. An episode ends
            with its first collision, a gap of 0 m or less.
        vehicles: a row per episode and vehicle: of a mixture ``energy_class``; ``collided``,
            ``mean_speed_mps`` (of the speeds after each step, as in evaluations), distance and
            energies of :func:`lcc_rl.evaluation.metrics.energy_measures`, and the measures of
            :data:`lcc_rl.evaluation.metrics.METRICS` and ``ROAD_METRICS``, those of
            ``measures=[…]`` included, each of one vehicle; NaN where it has none.
    """

    steps: pd.DataFrame
    vehicles: pd.DataFrame


@checked
def simulate(
    leader: Any,
    string: str | Mapping[str, Any] = "human*10",
    controller: Any = None,
    drivers: Any = None,
    overrides: Sequence[str] = (),
    time_step: TimeStep = 0.1,
    seconds: Positive | None = None,
    repeats: Count = 1,
    seed: Seed = 0,
) -> Simulation:
    """Simulate a string of vehicles behind a leader.

    Args:
        leader: speeds [m/s] at every time step; a shipped cycle (``"udds"``, ``"us06"``,
            ``"wltc_3b"``, ``"hwfet"``); a file or a data frame with ``time_s`` and ``speed_mps``; a
            list of these, each an episode of the length of the shortest; None on a ring.
        string: the vehicles behind the leader from front to back, see docs/strings.md.
        controller: controller or policy of the automated vehicles, as for
            :func:`lcc_rl.compare`, or a mapping of one by its name, with ``_filtered`` to put it
            behind the safety filter; None: an IDM driver without noise. A policy of another library
            reads the observation of ``alcc``.
        drivers: a table of ``lcc-rl calibrate`` or a population of
            :mod:`lcc_rl.drivers.population`; None: those of ``overrides`` or the shipped ones. The
            first human is the first driver of it in the first repeat, the second in the next one.
        overrides: further settings, ``["scenario.controllers.human.noise=0", "+filter=cbf"]``.
        time_step: duration of a step [s].
        seconds: duration [s]; None: that of the leader's record. A ring needs one.
        repeats: episodes behind each leader, with other drivers and noise.
        seed: seed of the noise.

    Raises:
        LccError: for any error in settings, data or files, in one line.

    Examples:
        >>> found = simulate([12.0] * 301, "human*3")
        >>> found.steps.shape[0], found.vehicles["vehicle"].tolist()
        (1204, [0, 1, 2, 3])
    """
    table = isinstance(drivers, (str, PathLike))
    chosen = {"drivers.path"} if table else {"drivers"} if drivers is not None else set()
    reason = "has no effect in simulate: see the arguments"
    check_overrides(overrides, OF_ARGUMENTS | chosen, reason)
    check_overrides(overrides, OF_FILES, f"{reason}; files have time_s [s], speed_mps [m/s]")
    profiles = _profiles(leader, time_step, seconds)
    mix = f"'{string}'"
    if not isinstance(string, str):
        mix = f"{{{', '.join(f'{key}: {value}' for key, value in string.items())}}}"
    name, spec, policies = _resolved(controller)
    reads = () if spec is None or is_policy(spec) else controller_of(spec).kind.reads
    settings = (
        *("evaluation.baselines=[]", "evaluation.behind_filter=[]", "evaluation.warm_up=0"),
        f"variant={'alcc' if policies or is_policy(spec) else 'idm'}",
        *(["drivers=calibrated", f"drivers.path={quoted(drivers)}"] if table else []),
        *(["scenario=platoon"] * (not MESSAGES.isdisjoint(reads)) + list(overrides)),
        *(f"scenario.string={mix}", f"scenario.time_step={float(time_step)!r}"),
        f"scenario.horizon={int(profiles.lengths[0]) - 1}",
    )
    cfg = load("evaluate", settings).with_(compare={name: spec} if spec else [], reward=UNREAD)
    require(
        (cfg.scenario.road == RING) == (leader is None),
        "simulate: a ring (scenario=ring in overrides) has leader=None, an open road has a leader",
    )
    require(
        cfg.automated or controller is None,
        "simulate: controller has no vehicle to drive in string",
    )
    people = build_drivers(cfg) if table or drivers is None else drivers
    fits = all(hasattr(people, name) for name in POPULATION)
    require(fits, f"drivers: not a population: {in_short(people)}")
    inputs = Inputs(no_profiles(time_step), profiles, people)
    strategy = Entrants(cfg, controller is None, policies, overrides).strategies(inputs)[-1]
    given = [word for word in overrides if top_key(word) == "drivers"]
    return _driven(strategy, inputs, repeats, seed, given + ["drivers"] * (drivers is not None))


def _resolved(controller: Any) -> tuple[str, Any, dict[str, GivenPolicy]]:
    """Return a controller's name and setting, or a policy of another library by its name."""
    if controller is None:
        return "", None, {}
    name, value = value_of(controller)
    policy = as_given(value, name or type(value).__name__)
    return (*one_of(controller), {}) if policy is None else ("", None, {policy.name: policy})


def _profiles(leader: Any, time_step: float, seconds: float | None) -> Profiles:
    """Return the leaders' records, of one length; for a ring one of zeros."""
    steps = (seconds or 0.0) / time_step
    fits = abs(steps - round(steps)) < 1e-6
    require(fits, f"simulate: seconds={seconds or 0.0:g} is no multiple of time_step={time_step}")
    if leader is None:
        require(seconds is not None, "simulate: leader=None needs scenario=ring and seconds=…")
        return constant_profiles(0.0, round(steps), time_step, ["ring"])
    listed = isinstance(leader, (list, tuple)) and len(leader) > 0
    several = listed and not all(isinstance(x, (int, float, np.number)) for x in leader)
    records = [_record(speeds, time_step) for speeds in (leader if several else [leader])]
    most = min(map(len, records)) - 1
    require(most > 0, "simulate: leader needs at least two speeds [m/s]")
    text = f"simulate: seconds={seconds or 0:g}, and the leader drives for {most * time_step:g} s"
    require(round(steps) <= most, text)
    steps = round(steps) or most
    names = [f"leader {number}" for number in range(len(records))]
    return from_records([x[: steps + 1] for x in records], names, names, time_step)


def _record(leader: Any, time_step: float) -> Tensor:
    """Return a leader's speed at every step, ``[steps + 1]`` [m/s]."""
    hard = Plausible(max_hard=1.0)  # tests of brakes; the column names the unit
    if isinstance(leader, pd.DataFrame):  # is read as its file
        with TemporaryDirectory() as folder:
            try:
                leader.to_parquet(file := Path(folder) / "leader.parquet")
                return _record(file, time_step)
            except (TypeError, ValueError) as error:
                text = str(error).removeprefix(f"{file}: ")
                raise DataError(f"the data frame: {text}") from error
    if isinstance(leader, (str, PathLike)):
        return resample(*read_speed_record(fspath(leader), hard), time_step)
    message = "simulate: leader must be speeds [m/s], a shipped cycle or a file"
    with raised_as(ConfigError, message, ValueError, TypeError):
        leader = leader.detach().cpu().numpy() if isinstance(leader, Tensor) else leader
        record = torch.from_numpy(np.array(np.ma.filled(leader, np.nan), dtype=np.float32))
        if record.ndim != 1:
            raise ValueError(f"got an array of shape {list(record.shape)}; give a column of speeds")
        rate = record.diff().abs() / time_step
        hint = "max_acceleration={:g}; give the time between two speeds, time_step=…"
        for text, values, most in (
            ("is {:g}, not from 0 to {:g} m/s: missing, or in km/h?", record, hard.max_speed),
            (f"changes by {{:.3g}} m/s², {hint}", rate, hard.max_acceleration),
        ):
            fits = (values >= 0.0) & (values <= most)
            if not fits.all():
                at = int(fits.int().argmin())
                text = text.format(float(values[at]), most)
                raise ValueError(f"speed {at}, at {at * time_step:g} s, {text}")
        return record


def _driven(
    strategy: Strategy, inputs: Inputs, repeats: int, seed: int, given: Sequence[str]
) -> Simulation:
    """Drive a strategy behind all leaders side by side; ``given``: the settings of the drivers."""
    cfg, leaders, people = strategy.cfg, len(inputs.evaluation), len(inputs.population.time_gap)
    number = torch.arange(leaders * repeats)
    profile, repeat, batch = number // repeats, number % repeats, len(number)
    env = build_env(cfg, inputs.evaluation, inputs.population, batch, 0, cfg.device, nominal=True)
    long, short = cfg.scenario.horizon >= LONG, len(cfg.scenario.vehicles) <= SHORT_STRING
    rows = long and short and not isinstance(strategy.policy, GivenPolicy)  # has its own memory
    ahead = [("leader", name) for name in ("speed", "acceleration", PLACE, GRADE)]
    keys = [*ahead, CLASS, INDEX, *(("vehicles", name) for name in (*MOTION, *SERIES))]
    player = Player(env, strategy.policy, keys, strategy.title, long and not rows, rows)
    warn_of_brakes([player])
    options, other = (
        reset_options(env, profile, (repeat + k) % people, seed + k, people, repeat // people)
        for k in (0, 1)
    )
    drawn = [f"repeats={repeats}"] * (repeats > 1) + [f"seed={seed}"] * (seed > 0)
    slow = int((inputs.population.desired_speed < inputs.evaluation.speeds.max()).sum())
    if slow and player.reads_drivers and len(cfg.scenario.vehicles) > cfg.automated:
        text = "the leader exceeds the desired speed of %d of %d human drivers, who fall behind; "
        log.warning(text + "drivers=highway in overrides has faster ones", slow, people)
    idle = [] if player.reads_drivers else [*given]
    idle += [] if drawn and player.draws(options, other) else drawn
    if idle:
        log.warning("without effect on these vehicles: %s", ", ".join(idle))
    record, alive = player.play(options)
    warn_of_idle([player.idle])
    if isinstance(strategy.policy, GivenPolicy) and (text := strategy.policy.clipped()):
        log.warning("%s", text)
    return _Motion(cfg, record, player.start, alive).tables()


class _Motion:
    """The motion of all vehicles, and of the leader if there is one, as arrays.

    Args:
        cfg: configuration of the simulation.
        record: entries of a :class:`Player`.
        start: the state before the first step.
        alive: whether each step belongs to a running episode, ``[steps, episodes, 1]``.
    """

    def __init__(self, cfg: StudyConfig, record: Record, start: State, alive: Tensor) -> None:
        self.cfg, self.record, self.alive = cfg, record, alive
        self.energy, self.time_step = build_energy(cfg), cfg.scenario.time_step
        self.ahead = highest(record)
        self.names = [name for name in MOTION if ("vehicles", name) in record]
        spaces = ["leader"] * (LEADER in record) + ["vehicles"]
        self.groups = [self._group(space, start) for space in spaces]
        kind = record[CLASS][0] if CLASS in record else None
        self.kinds = [*[None] * (LEADER in record), kind]
        self.vehicles = np.arange(len(cfg.scenario.vehicles) + 1)[LEADER not in record :]

    def _group(self, space: str, start: State) -> dict[str, Tensor]:
        """Return the motion of the leader or of the vehicles, ``[time, episodes, n, 1]``."""
        group = {name: x for (within, name), x in self.record.items() if within == space}
        for name in AT_START & {*group}:
            group[name] = torch.cat([start[space, name].unsqueeze(0), group[name]])
        if space == "leader":
            group = {name: entry.unsqueeze(-2) for name, entry in group.items()}
            energy = self.energy.at(_after(group.get(GRADE)))
            speed = group["speed"][:-1]
            if self.cfg.scenario.replaced:  # that of the new vehicle in the step of the change
                speed = group["speed"][1:] - self.time_step * group["acceleration"]
            group["power"] = energy.power(speed, group["acceleration"])
        return group

    def tables(self) -> Simulation:
        """Return a row per time and vehicle, and a row per vehicle."""
        running = torch.cat([self.alive[:1], self.alive]).squeeze(-1).T.numpy()
        episode, time = np.nonzero(running)  # in this order
        lengths, roles = running.sum(1), self._roles()
        parts = [slice(x - y, x) for x, y in zip(lengths.cumsum(), lengths, strict=True)]
        motion = {MOTION[name]: self._rows(name, parts) for name in self.names}
        shape = len(time), len(self.vehicles)
        summary = pd.DataFrame(
            {
                "episode": np.repeat(np.arange(len(roles)), shape[1]),
                "vehicle": np.tile(self.vehicles, len(roles)),
                "role": roles.flatten(),
            }
        )
        place = episode[:, None] * shape[1] + np.arange(shape[1])  # of the summary's rows
        columns = {
            "episode": _column(episode[:, None], shape),
            "time_s": _column(times(time, self.time_step)[:, None], shape),
            "vehicle": _column(self.vehicles, shape),
            "role": summary["role"].array.take(place.reshape(-1)),
            **{name: _column(rows, shape) for name, rows in motion.items()},
        }
        measured = self._measures()
        if len(names := self.energy.names) > 1:
            summary = summary.assign(energy_class=np.array(names)[self._classes().flatten()])
        summary = summary.assign(collided=measured["min_gap_m"] <= 0.0, **measured)
        return Simulation(pd.DataFrame(columns, copy=False), summary)

    def _rows(self, name: str, parts: Sequence[slice]) -> np.ndarray:
        """Return a quantity of all vehicles in the rows of each episode, NaN where unknown."""
        found = np.empty((parts[-1].stop, len(self.vehicles)), np.float32)
        first = 0
        for group in self.groups:
            last = first + group["speed"].shape[-2]
            values = group.get(name, group["speed"][:0]).squeeze(-1).numpy()
            late = len(self.alive) + 1 - len(values)  # of a step: none before the first one
            for episode, part in enumerate(parts):
                rows = found[part, first:last]
                rows[:late], rows[late:] = np.nan, values[: max(0, len(rows) - late), episode]
            first = last
        return found

    def _roles(self) -> np.ndarray:
        """Return the role of each vehicle in each episode, ``[episodes, n]``."""
        string, episodes = self.cfg.scenario.vehicles, self.alive.shape[1]
        roles = np.tile(np.array(["leader", *string.roles], dtype=object), (episodes, 1))
        if string.drawn:
            roles[:, 1:] = HUMAN
            index = self.record[INDEX][0].squeeze(-1).numpy() + 1
            np.put_along_axis(roles, index, AUTOMATED, axis=1)
        return roles[:, self.vehicles]

    def _classes(self) -> np.ndarray:
        """Return the number of each vehicle's class, ``[episodes, n]``; a leader has the first."""
        parts = zip(self.groups, self.kinds, strict=True)
        none = [group["speed"][0] * 0.0 if kind is None else kind for group, kind in parts]
        return torch.cat(none, -2).squeeze(-1).long().numpy()

    def _measures(self) -> dict[str, np.ndarray]:
        """Return energies and measures of every vehicle, episode by episode; NaN without one."""
        # By blocks of episodes, so that what lies between stays in the processor's caches.
        size = max(1, BLOCK // (len(self.alive) * len(self.vehicles)))
        blocks = [slice(x, x + size) for x in range(0, self.alive.shape[1], size)]
        found = [self._measured(block) for block in blocks]
        return {name: torch.cat([x[name] for x in found]).flatten().numpy() for name in found[0]}

    def _measured(self, block: slice) -> dict[str, Tensor]:
        """Return energies and measures of the vehicles of some episodes, ``[episodes, n, 1]``."""
        found, metrics, alive = [], {**METRICS, **ROAD_METRICS}, self.alive[:, block]
        ahead = {name: x[:, block].unsqueeze(-2) for name, x in self.ahead.items()}
        for whole, kinds in zip(self.groups, self.kinds, strict=True):
            group = {name: x[:, block] for name, x in whole.items()}
            kind = None if kinds is None else kinds[block]
            args = (self.time_step, self.energy, kind, _after(group.get(GRADE)))
            known = energy_measures(group["power"], group["speed"], alive.unsqueeze(-2), *args)
            if self.cfg.scenario.replaced and whole is self.groups[0]:  # of two vehicles in turn
                known = {"distance_m": known["distance_m"]}
            series = {x: group[x].unsqueeze(-2) for x in SERIES if x in group}
            late = {name: x[-len(alive) :] for name, x in series.items() if name in AT_START}
            series |= late | ahead
            running = alive[..., None, None].expand_as(series["acceleration"])
            mean = Reductions(running, self.time_step).mean(series["speed"][1:])
            measured = safety_measures(series, running, self.time_step, metrics)
            found.append({"mean_speed_mps": mean} | known | measured)
        return {
            name: torch.cat([x.get(name, torch.nan * x["distance_m"]) for x in found], -2)
            for name in found[-1]
        }


def _after(entry: Tensor | None) -> Tensor | None:
    """Return the values after each step of an entry that is known before the first one, too."""
    return None if entry is None else entry[1:]


def _column(values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    return np.broadcast_to(values, shape).reshape(-1)
