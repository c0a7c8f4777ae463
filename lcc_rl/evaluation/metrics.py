"""Measures of one episode, from its time series."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
from typing import Any

import torch
from torch import Tensor

from lcc_rl.energy import AVERAGED, AVERAGES, Fleet, as_fleet
from lcc_rl.errors import ConfigError, line_of, replacing, require, require_known
from lcc_rl.functional.safety import NEVER
from lcc_rl.results.measures import CALM, MEASURES, SHIPPED, Measure
from lcc_rl.results.platoons import PLATOON

KILO = 1e-3
UNSAFE_TTC = 4.0  # [s] (A10)
LONG_TIME_GAP = 2.5  # [s] (A13)
SHORT_TIME_GAP = 1.0  # [s]
APART = 1.0  # brakings of a vehicle within this time count as one [s]
PACE = 1.0  # lower speeds do not count for moving time gaps [m/s]
SPAN = 1.0  # over which accelerations and jerks are averaged [s]
STANDSTILL = 0.1  # lower speeds count as standing [m/s]
ACTS = 0.01  # change of a command above which a filter counts as active [m/s²]
SERIES = ("speed", "gap", "acceleration", "power", "ttc", "time_gap", "jerk")  # of every vehicle
OF_FILTER = ("promised", "safe", "wanted", "command")  # of vehicles behind a safety filter
Metric = Callable[..., Tensor]


def energy_measures(
    power: Tensor,
    speed: Tensor,
    alive: Tensor,
    time_step: float,
    energy: Fleet | None = None,
    kind: Tensor | None = None,
    grade: Tensor | None = None,
) -> dict[str, Tensor]:
    """Return energy (A20), gross and net of kinetic energy, and distance of every vehicle.

    Args:
        power: power of each step, ``[time, *batch, n, 1]`` [W].
        speed: speed at every time, ``[time + 1, *batch, n, 1]`` [m/s].
        alive: whether the episode was still running, ``[time, *batch, 1, 1]``.
        time_step: duration of a step [s].
        energy: the energy models; None: that of the ALCC paper.
        kind: class of every vehicle, ``[*batch, n, 1]``; None: all have the first model.
        grade: grade of the road after each step, as ``power`` [rad]; None: a level road.

    Returns:
        ``energy_kj``; ``net_energy_kj``, net of kinetic energy and height gained;
        ``steady_energy_kj``, that of the driven speeds without acceleration; ``path_energy_kj``,
        the steady energy plus the loss by accelerating, or the net energy for a model without them;
        ``distance_m``; fuel and carbon dioxide (:data:`lcc_rl.energy.BURNT`) if a model burns
        fuel; and, for models that define them, ``acceleration_loss_kj``, the loss by accelerating,
        and ``share_infeasible``, the share of time with an infeasible acceleration; each
        ``[*batch, n, 1]``.
    """
    energy = as_fleet(energy).at(grade)
    motion = speed[:-1], speed.diff(dim=0) / time_step
    still = torch.zeros_like(motion[0])

    def total(rate: Tensor) -> Tensor:
        return (rate * alive).sum(0) * time_step

    drawn, steady = total(power) * KILO, total(energy.power(speed[:-1], still, kind)) * KILO
    steps = alive.sum(0, keepdim=True).long().expand(1, *speed.shape[1:])
    last = speed.gather(0, steps).squeeze(0)
    stored = (energy.stored_energy(last, kind) - energy.stored_energy(speed[0], kind)) * KILO
    stored = stored - total(energy.unpaid(*motion, kind)) * KILO
    if not energy.level:
        stored = stored + total(energy.climbing(speed[:-1], kind)) * KILO
    lost = energy.acceleration_loss(*motion, kind)
    measures = {
        "energy_kj": drawn,
        "net_energy_kj": drawn - stored,
        "steady_energy_kj": steady,
        "path_energy_kj": drawn - stored,
        "distance_m": total(0.5 * (speed[:-1] + speed[1:])),
    }
    if lost is not None:
        measures["acceleration_loss_kj"] = total(lost) * KILO
        measures["path_energy_kj"] = steady + measures["acceleration_loss_kj"]
    measures |= energy.burnt(measures["path_energy_kj"] / KILO, kind)
    strange = energy.infeasible(*motion, kind)
    if strange is not None:
        count = steps.squeeze(0).clamp(min=1)
        measures["share_infeasible"] = (strange * alive).sum(0) / count
    return measures


def averaged_energies(
    speed: Tensor,
    alive: Tensor,
    time_step: float,
    energy: Fleet | None = None,
    kind: Tensor | None = None,
    grade: Tensor | None = None,
) -> dict[str, Tensor]:
    """Return path energies of speeds averaged over :data:`lcc_rl.energy.AVERAGES`.

    They exclude the noise of recorded speeds and of models. The ends, without a whole average,
    count like the rest.

    Args:
        speed, alive, time_step, energy, kind, grade: as for :func:`energy_measures`.

    Returns:
        Energies by name of :data:`lcc_rl.energy.AVERAGED`, each ``[*batch, n, 1]`` [kJ]; NaN if no
        average is whole.
    """
    energy, energies = as_fleet(energy), {}
    distance = (0.5 * (speed[:-1] + speed[1:]) * alive).sum(0) * time_step
    for name, seconds in zip(AVERAGED, AVERAGES, strict=True):
        width = round(seconds / time_step)
        if width >= len(speed):
            energies[name] = torch.full_like(distance, torch.nan)
            continue
        mean = _averaged(speed, width)
        slope = None if grade is None else _averaged(grade, width)
        power = energy.at(slope).power(mean[:-1], mean.diff(dim=0) / time_step, kind)
        args = alive[width - 1 :], time_step, energy, kind, slope
        values = energy_measures(power, mean, *args)
        energies[name] = values["path_energy_kj"] * distance / values["distance_m"]
    return energies


def _averaged(entry: Tensor, width: int) -> Tensor:
    """Return averages of consecutive values, ``[time - width + 1, …]``."""
    # In single precision, sums would lose the difference of consecutive averages.
    sums = torch.cat([torch.zeros_like(entry[:1]), entry]).cumsum(0, dtype=torch.float64)
    return ((sums[width:] - sums[:-width]) / width).to(entry)


def measured_ttc(ttc: Tensor) -> Tensor:
    """Return times-to-collision [s] with NaN where no gap closes."""
    return torch.where(ttc < NEVER, ttc, torch.nan)


@dataclass(frozen=True)
class Reductions:
    """Reductions of the series of a batch of episodes, ``[time, *batch, A, 1]`` to ``[*batch, 1]``.

    Args:
        alive: whether the episode was still running, ``[time, *batch, 1, 1]``.
        time_step: duration of a step [s].
    """

    alive: Tensor
    time_step: float

    @cached_property
    def steps(self) -> Tensor:
        """Number of steps of each episode."""
        return self.alive.sum(0).squeeze(-2)

    def at(self, entry: Tensor) -> Tensor:
        """Return whether the episode was running at the entry's times.

        An entry may lack the first times, or begin with the state before the first step.
        """
        missing = len(self.alive) - len(entry)
        return self.alive[missing:] if missing >= 0 else torch.cat([self.alive[:1], self.alive])

    def mean(self, entry: Tensor) -> Tensor:
        """Mean over time and vehicles."""
        count = self.steps.clamp(min=1) * entry.shape[-2]
        return (entry * self.alive).sum(0).sum(-2) / count

    def total(self, entry: Tensor) -> Tensor:
        """Integral over time, summed over vehicles."""
        return (entry * self.alive).sum(0).sum(-2) * self.time_step

    def begun(self, state: Tensor) -> Tensor:
        """Number of times that a state of a vehicle begins, at least :data:`APART` apart."""
        state, recent = state & self.alive, torch.zeros_like(state)
        for back in range(1, max(1, round(APART / self.time_step)) + 1):
            recent[back:] |= state[:-back]
        return (state & ~recent).sum(0).sum(-2)

    def change(self, entry: Tensor) -> Tensor:
        """Difference of the last and the first value, averaged over vehicles."""
        last = (self.at(entry).sum(0) - 1).clamp(min=0).expand(entry.shape[1:]).unsqueeze(0)
        return (entry.gather(0, last).squeeze(0) - entry[0]).mean(-2)

    def lowest(self, entry: Tensor) -> Tensor:
        """Minimum over time and vehicles."""
        return torch.where(self.at(entry), entry, torch.inf).amin(0).amin(-2)

    def highest(self, entry: Tensor) -> Tensor:
        """Maximum over time and vehicles."""
        values = torch.where(self.at(entry), entry, -torch.inf)
        return values.amax(0).amax(-2) if len(entry) else values.sum(0).sum(-2) * torch.nan

    def slope(self, entry: Tensor) -> Tensor:
        """Change of an entry per second over each :data:`SPAN`; the first times are missing."""
        steps = max(1, round(SPAN / self.time_step))
        return (entry[steps:] - entry[:-steps]) / (steps * self.time_step)

    def first(self, state: Tensor) -> Tensor:
        """Time at which a state of a vehicle begins, the last of the vehicles; NaN if not all."""
        state = state & self.alive
        time = (state.int().argmax(0) + 1.0) * self.time_step
        return torch.where(state.any(0), time, torch.nan).amax(-2)


def _turned(over: Reductions, safe: Tensor) -> Tensor:
    """Return whether an unsafe step follows a safe one; False for the last step."""
    turned = torch.zeros_like(safe, dtype=torch.bool)
    turned[:-1] = (safe[:-1] > 0.0) & (safe[1:] <= 0.0) & over.alive[1:]
    return turned


def _stops(speed: Tensor) -> Tensor:
    """Return whether a vehicle comes to a standstill in each step."""
    stands = speed < STANDSTILL
    return stands[1:] & ~stands[:-1]


def _extreme(value: Tensor) -> Tensor:
    """Return a largest value; NaN for an episode without one."""
    return torch.where(value.isfinite(), value, torch.nan)


# Measures of the automated vehicles of a string by column of episodes.parquet. Each is a function
# of the entries that it names, see :func:`safety_measures`. Without an entry there is no column.
METRICS: dict[str, Metric] = {
    "min_gap_m": lambda over, gap: over.lowest(gap),
    "mean_gap_m": lambda over, gap: over.mean(gap),
    "gap_opened_m": lambda over, gap: over.change(gap),
    "max_gap_m": lambda over, gap: over.highest(gap),
    "min_time_gap_s": lambda over, time_gap: over.lowest(time_gap),
    "min_ttc_s": lambda over, ttc: measured_ttc(over.lowest(ttc)),
    "max_time_gap_s": lambda over, time_gap: over.highest(time_gap),
    "share_ttc_unsafe": lambda over, ttc: over.mean(ttc < UNSAFE_TTC),
    "share_time_gap_long": lambda over, time_gap: over.mean(time_gap > LONG_TIME_GAP),
    "share_time_gap_long_moving": lambda over, time_gap, speed: over.mean(
        (time_gap > LONG_TIME_GAP) & (speed[1:] > PACE)
    ),
    "rms_jerk_mps3": lambda over, jerk: over.mean(jerk**2).sqrt(),
    "max_jerk_mps3": lambda over, jerk: over.highest(jerk.abs()),
    "max_jerk_1s_mps3": lambda over, acceleration, jerk: _extreme(  # also before the first step
        over.highest(
            over.slope(torch.cat([(acceleration - jerk * over.time_step)[:1], acceleration])).abs()
        )
    ),
    "max_deceleration_mps2": lambda over, acceleration: over.highest(-acceleration),
    "max_deceleration_1s_mps2": lambda over, speed: _extreme(over.highest(-over.slope(speed))),
    "standstill_gap_m": lambda over, gap, speed: _extreme(
        over.lowest(
            torch.where((speed[1:] < STANDSTILL) & (_stops(speed).cumsum(0) > 0), gap, torch.inf)
        )
    ),
    "standstill_s": lambda over, speed: over.first(_stops(speed)),
    "speed_overshoot_mps": lambda over, speed, leader_highest: _extreme(
        over.highest((speed - leader_highest)[1:]).clamp(min=0.0)
    ),
    "duration_s": lambda over: over.steps * over.time_step,
    "share_filter_acts": lambda over, command, wanted: over.mean((command - wanted).abs() > ACTS),
    "share_promised": lambda over, promised: over.mean(promised),
    "share_ttc_unpromised": lambda over, ttc, promised: over.mean(
        (ttc < UNSAFE_TTC) & (promised == 0.0)
    ),
    "share_turned_unsafe": lambda over, safe: over.mean(_turned(over, safe)),
    "share_promise_broken": lambda over, safe, promised: over.mean(
        _turned(over, safe) & (promised > 0.0)
    ),
}
# Measures of all vehicles of a string, likewise; ``free`` is v0 [m/s].
ROAD_METRICS: dict[str, Metric] = {
    "brakings_below_2": lambda over, acceleration: over.begun(acceleration < -2.0),
    "brakings_below_3": lambda over, acceleration: over.begun(acceleration < -3.0),
    "share_time_gap_short": lambda over, time_gap: over.mean(time_gap < SHORT_TIME_GAP),
    "vehicle_time_s": lambda over, gap: over.total(torch.ones_like(gap)),
    "delay_s": lambda over, speed, free: over.total(1.0 - 0.5 * (speed[:-1] + speed[1:]) / free),
}


OURS = frozenset((*SHIPPED, *(one.key for one in PLATOON), *METRICS, *ROAD_METRICS))


def register(measure: Measure, metric: Metric, every: bool = False) -> None:
    """Add a measure to all evaluations, tables, figures, limits and files of this process.

    A command imports the modules of ``measures=[…]``, which call this function. A notebook, and a
    module that is loaded again, replace their measure of the same key.

    Args:
        measure: its names, unit, aggregation and bound.
        metric: a function of ``over``, :class:`Reductions`, and of the entries that it names:
            :data:`SERIES`, :data:`OF_FILTER` and, of every vehicle, ``free``, v0 [m/s]; shapes as
            for :func:`safety_measures`. Episodes without one of them have no value.
        every: over all vehicles of a string, not the automated ones. Rows of platoons are of one
            vehicle each.

    Raises:
        ConfigError: if the key is no word, is one of the package or of another ``register``, an
            entry is unknown, or a trial of the metric fails.
    """
    key, previous = measure.key, registered().get(measure.key, metric)
    message = "expected letters, digits and _, as in the name of a column"
    require(key.isidentifier(), f"measure {key!r}: {message}")
    require(key not in OURS, f"measure {key}: the package has one of this key; expected another")
    again = metric.__module__ == "__main__" or _place(previous) == _place(metric)
    message = f"{previous.__module__} has registered one of this key; expected another"
    require(again, f"measure {key}: {message}")
    _, *entries = signature(metric).parameters
    valid = (*SERIES, *(("free",) if every else OF_FILTER))
    require_known(f"entry of the measure {key}", entries, valid)
    trial = {name: torch.ones(50 + (name == "speed"), 2, 2, 1) for name in valid}
    hint = " (speed has a row more than steps: speed[1:])" * ("speed" in entries)
    with replacing(lambda error: ConfigError(f"measure {key}: {line_of(error, True)}{hint}")):
        safety_measures(trial, torch.ones(50, 2, 1, 1, dtype=torch.bool), 0.1, {key: metric})
    for table in (MEASURES, PLATOON):
        table[:] = [row for row in table if row.key != key] + [measure]
    for metrics in (METRICS, ROAD_METRICS):
        metrics.pop(key, None)
    (ROAD_METRICS if every else METRICS)[key] = metric


def _place(metric: Metric) -> tuple[Any, ...]:
    return metric.__module__, getattr(getattr(metric, "__code__", None), "co_firstlineno", None)


def registered() -> dict[str, Metric]:
    """Return the metrics of :func:`register`."""
    return {key: x for key, x in {**METRICS, **ROAD_METRICS}.items() if key not in OURS}


def safety_measures(
    series: Mapping[str, Tensor],
    alive: Tensor,
    time_step: float,
    metrics: Mapping[str, Metric] = METRICS,
) -> dict[str, Tensor]:
    """Return measures of safety, efficiency and comfort of vehicles of a string.

    Args:
        series: ``ttc`` [s], ``time_gap`` [s], ``gap`` [m], ``jerk`` [m/s³] after every step,
            each ``[time, *batch, A, 1]``; ``speed`` and ``leader_highest``, the leader's highest
            speed until then [m/s], also before the first step; and with a safety filter
            ``promised``, 1 for steps that the guarantee covers, ``safe``, 1 for steps that begin
            safe, ``wanted`` and ``command``, the desired and the commanded acceleration [m/s²].
        alive: whether the episode was still running, ``[time, *batch, 1, 1]``.
        time_step: duration of a step [s].
        metrics: the measures, such as :data:`ROAD_METRICS` of all vehicles; by default
            :data:`METRICS` of the automated ones.

    Returns:
        Minima and maxima over the vehicles, shares of time and root mean squares averaged over
        them, each ``[*batch, 1]``; the least time-to-collision is NaN if no gap closed.
    """
    over, measures = Reductions(alive, time_step), {}
    for name, metric in metrics.items():
        _, *entries = signature(metric).parameters
        if all(entry in series for entry in entries):
            value = measures[name] = metric(over, *(series[entry] for entry in entries))
            shape, expected = list(torch.as_tensor(value).shape), list(alive.shape[1:-1])
            text = f"measure {name}: expected a number of each episode {expected}, got {shape}"
            require(shape == expected, f"{text}; over reduces entries: over.mean, over.highest …")
    return measures


def string_measures(
    speed: Tensor, gap: Tensor, alive: Tensor, length: float | Tensor, leader: Tensor | None = None
) -> dict[str, Tensor]:
    """Return measures of the traffic of a string.

    Args:
        speed: speed of every vehicle after each step, ``[time, *batch, N, 1]`` [m/s].
        gap: gap to the vehicle ahead, likewise [m].
        alive: whether the episode was still running, ``[time, *batch, 1]``.
        length: length of a vehicle, or its mean by episode, ``[*batch, 1]`` [m].
        leader: speed of the vehicle ahead of the string, ``[time, *batch, 1]`` [m/s].

    Returns:
        Each ``[*batch, 1]``: mean speed; standard deviation of a vehicle's speed in time, averaged
        over vehicles (``speed_std_mps``); standard deviation over the vehicles at a time, averaged
        over the episode and over its last tenth (``speed_spread_mps``,
        ``final_speed_spread_mps``); vehicles per hour by mean speed and spacing (``flow_vph``);
        and, behind a leader, the deviation in time of the last vehicle divided by the leader's
        (``string_ratio``).
    """
    by_vehicle, steps = alive.unsqueeze(-2), alive.sum(0).clamp(min=1)

    def average(entry: Tensor) -> Tensor:
        """Mean over time of ``[time, *batch, …, 1]``."""
        running = by_vehicle if entry.ndim == by_vehicle.ndim else alive
        count = running.sum(0).clamp(min=1)
        return torch.where(running, entry, 0.0).sum(0) / count

    def deviation(entry: Tensor) -> Tensor:
        return average((entry - average(entry)).square()).sqrt()

    spread = _spread(speed)
    late = torch.arange(len(alive), device=alive.device).view(-1, *[1] * (alive.ndim - 1))
    last = alive & (late >= (0.9 * steps).floor())
    measures = {
        "mean_speed_mps": average(speed).mean(-2),
        "speed_std_mps": deviation(speed).mean(-2),
        "speed_spread_mps": average(spread),
        "final_speed_spread_mps": torch.where(last, spread, 0.0).sum(0) / last.sum(0).clamp(min=1),
    }
    measures["flow_vph"] = 3600.0 * measures["mean_speed_mps"] / (average(gap).mean(-2) + length)
    if leader is not None:
        std = deviation(speed[..., -1, :])
        measures["string_ratio"] = std / deviation(leader).clamp(min=1e-3)
    return measures


def damping_time(speed: Tensor, alive: Tensor, time_step: float) -> Tensor:
    """Return the time after which the speeds' deviation over the vehicles stays below 0.5 m/s.

    Args:
        speed, alive: see :func:`string_measures`.
        time_step: duration of a step [s].

    Returns:
        ``[*batch, 1]`` [s]; NaN if it does not stay below.
    """
    steps = torch.arange(1, len(alive) + 1, device=alive.device).view(-1, *[1] * (alive.ndim - 1))
    time = (steps * (alive & (_spread(speed) > CALM))).amax(0)
    return torch.where(time < alive.sum(0).clamp(min=1), time * time_step, torch.nan)


def _spread(speed: Tensor) -> Tensor:
    """Return the deviation over the vehicles; several times faster than torch's for few."""
    return (speed - speed.mean(-2, keepdim=True)).square().mean(-2).sqrt()
