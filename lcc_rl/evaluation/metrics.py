"""Measures of one episode, from its time series."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from inspect import signature

import torch
from torch import Tensor

from lcc_rl.energy import AVERAGED, AVERAGES, Fleet, as_fleet
from lcc_rl.functional.safety import NEVER

KILO = 1e-3
UNSAFE_TTC = 4.0  # [s] (A10)
LONG_TIME_GAP = 2.5  # [s] (A13)
SHORT_TIME_GAP = 1.0  # [s]
APART = 1.0  # brakings of a vehicle that are closer in time count as one [s]
CALM = 0.5  # spread of the speeds at which a wave counts as damped [m/s]
PACE = 1.0  # below it a long time gap is a matter of metres [m/s]
ACTS = 0.01  # change of a command by which a filter acts [m/s²]


def energy_measures(
    power: Tensor,
    speed: Tensor,
    alive: Tensor,
    time_step: float,
    energy: Fleet | None = None,
    kind: Tensor | None = None,
) -> dict[str, Tensor]:
    """Energy of every vehicle (A20), raw, net of what its motion stores, and its distance.

    Args:
        power: power of each step, ``[time, *batch, n, 1]`` [W].
        speed: speed at every moment, ``[time + 1, *batch, n, 1]`` [m/s].
        alive: whether the episode was still running, ``[time, *batch, 1, 1]``.
        time_step: duration of a step [s].
        energy: the energy models; None for that of the ALCC paper.
        kind: class of every vehicle, ``[*batch, n, 1]``; None: all have the first model.

    Returns:
        ``energy_kj``, ``net_energy_kj`` (a trip that ends slower than it began has used energy
        that it did not draw), what the speeds driven take without accelerating
        (``steady_energy_kj``), what a path takes without what the motion stores
        (``path_energy_kj``; of a model without such a part the net energy), ``distance_m``, its
        fuel and carbon dioxide (:data:`lcc_rl.energy.BURNT`) where a model burns fuel, and,
        of models that know them, what accelerating loses (``acceleration_loss_kj``) and the share
        of time in which the vehicle cannot accelerate as it does (``share_infeasible``), each
        ``[*batch, n, 1]``.
    """
    energy = as_fleet(energy)
    motion = speed[:-1], speed.diff(dim=0) / time_step
    still = torch.zeros_like(motion[0])

    def total(rate: Tensor) -> Tensor:
        return (rate * alive).sum(0) * time_step

    drawn, steady = total(power) * KILO, total(energy.power(speed[:-1], still, kind)) * KILO
    steps = alive.sum(0, keepdim=True).long().expand(1, *speed.shape[1:])
    last = speed.gather(0, steps).squeeze(0)
    stored = (energy.stored_energy(last, kind) - energy.stored_energy(speed[0], kind)) * KILO
    lost = energy.acceleration_loss(*motion, kind)
    found = {
        "energy_kj": drawn,
        "net_energy_kj": drawn - stored,
        "steady_energy_kj": steady,
        "path_energy_kj": drawn - stored,
        "distance_m": total(0.5 * (speed[:-1] + speed[1:])),
    }
    if lost is not None:
        found["acceleration_loss_kj"] = total(lost) * KILO
        found["path_energy_kj"] = steady + found["acceleration_loss_kj"]
    found |= energy.burnt(found["path_energy_kj"] / KILO, kind)
    strange = energy.infeasible(*motion, kind)
    if strange is not None:
        count = steps.squeeze(0).clamp(min=1)
        found["share_infeasible"] = (strange * alive).sum(0) / count
    return found


def averaged_energies(
    speed: Tensor,
    alive: Tensor,
    time_step: float,
    energy: Fleet | None = None,
    kind: Tensor | None = None,
) -> dict[str, Tensor]:
    """Path energies of speeds averaged over :data:`lcc_rl.energy.AVERAGES`, of the whole way.

    Neither noise of a recorded speed nor that of a model counts. The ends, where an average is not
    whole, count as the rest does.

    Args:
        speed, alive, time_step, energy, kind: as of :func:`energy_measures`.

    Returns:
        By name of :data:`lcc_rl.energy.AVERAGED`, each ``[*batch, n, 1]`` [kJ]; NaN if no average
        is whole.
    """
    energy, found = as_fleet(energy), {}
    way = (0.5 * (speed[:-1] + speed[1:]) * alive).sum(0) * time_step
    for name, seconds in zip(AVERAGED, AVERAGES, strict=True):
        width = round(seconds / time_step)
        if width >= len(speed):
            found[name] = torch.full_like(way, torch.nan)
            continue
        # Sums of single precision would lose what differs from one average to the next.
        sums = torch.cat([torch.zeros_like(speed[:1]), speed]).cumsum(0, dtype=torch.float64)
        mean = ((sums[width:] - sums[:-width]) / width).to(speed)
        power = energy.power(mean[:-1], mean.diff(dim=0) / time_step, kind)
        own = energy_measures(power, mean, alive[width - 1 :], time_step, energy, kind)
        found[name] = own["path_energy_kj"] * way / own["distance_m"]
    return found


def measured_ttc(ttc: Tensor) -> Tensor:
    """Return times-to-collision [s] with NaN where the number only says that no gap closes."""
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
        """How many steps each episode has."""
        return self.alive.sum(0).squeeze(-2)

    def mean(self, entry: Tensor) -> Tensor:
        """Mean over time and vehicles."""
        count = self.steps.clamp(min=1) * entry.shape[-2]
        return (entry * self.alive).sum(0).sum(-2) / count

    def total(self, entry: Tensor) -> Tensor:
        """Integral over time, added up over vehicles."""
        return (entry * self.alive).sum(0).sum(-2) * self.time_step

    def begun(self, state: Tensor) -> Tensor:
        """How often a state of a vehicle begins, :data:`APART` after its last time at the least."""
        state, recent = state & self.alive, torch.zeros_like(state)
        for back in range(1, max(1, round(APART / self.time_step)) + 1):
            recent[back:] |= state[:-back]
        return (state & ~recent).sum(0).sum(-2)

    def lowest(self, entry: Tensor) -> Tensor:
        """Minimum over time and vehicles."""
        return torch.where(self.alive, entry, torch.inf).amin(0).amin(-2)

    def highest(self, entry: Tensor) -> Tensor:
        """Maximum over time and vehicles."""
        return torch.where(self.alive, entry, -torch.inf).amax(0).amax(-2)


def _turned(over: Reductions, safe: Tensor) -> Tensor:
    """Whether a safe step is followed by an unsafe one; that after the last step is not known."""
    turned = torch.zeros_like(safe, dtype=torch.bool)
    turned[:-1] = (safe[:-1] > 0.0) & (safe[1:] <= 0.0) & over.alive[1:]
    return turned


# Measures of the automated vehicles of a string by column of episodes.parquet. Each is a function
# of the entries that it names, see :func:`safety_measures`; where one lacks, so does the column.
METRICS: dict[str, Callable[..., Tensor]] = {
    "min_gap_m": lambda over, gap: over.lowest(gap),
    "mean_gap_m": lambda over, gap: over.mean(gap),
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
ROAD_METRICS: dict[str, Callable[..., Tensor]] = {
    "brakings_below_2": lambda over, acceleration: over.begun(acceleration < -2.0),
    "brakings_below_3": lambda over, acceleration: over.begun(acceleration < -3.0),
    "share_time_gap_short": lambda over, time_gap: over.mean(time_gap < SHORT_TIME_GAP),
    "vehicle_time_s": lambda over, gap: over.total(torch.ones_like(gap)),
    "delay_s": lambda over, speed, free: over.total(1.0 - 0.5 * (speed[:-1] + speed[1:]) / free),
}


def safety_measures(
    series: Mapping[str, Tensor],
    alive: Tensor,
    time_step: float,
    metrics: Mapping[str, Callable[..., Tensor]] = METRICS,
) -> dict[str, Tensor]:
    """Safety, efficiency and comfort of vehicles of a string.

    Args:
        series: ``ttc`` [s], ``time_gap`` [s], ``gap`` [m], ``jerk`` [m/s³] after every step,
            each ``[time, *batch, A, 1]``; ``speed`` [m/s], also before the first one;
            behind a safety filter, which steps its guarantee covers, ``promised``, which begin
            ``safe``, and the desired and commanded accelerations ``wanted`` and ``command`` [m/s²].
        alive: whether the episode was still running, ``[time, *batch, 1, 1]``.
        time_step: duration of a step [s].
        metrics: what is measured, such as :data:`ROAD_METRICS` of all vehicles; by default
            :data:`METRICS`, of the automated ones.

    Returns:
        Minima and maxima over the vehicles, shares of time and root mean squares averaged over
        them, each ``[*batch, 1]``; the least time-to-collision is NaN where no gap ever closed.
    """
    over, found = Reductions(alive, time_step), {}
    for name, metric in metrics.items():
        _, *entries = signature(metric).parameters
        if all(entry in series for entry in entries):
            found[name] = metric(over, *(series[entry] for entry in entries))
    return found


def string_measures(
    speed: Tensor,
    gap: Tensor,
    alive: Tensor,
    length: float | Tensor,
    time_step: float,
    leader: Tensor | None = None,
) -> dict[str, Tensor]:
    """Traffic of a string, front to back.

    Args:
        speed: of every vehicle after each step, ``[time, *batch, N, 1]`` [m/s].
        gap: to the vehicle ahead, likewise [m].
        alive: whether the episode was still running, ``[time, *batch, 1]``.
        length: of a vehicle; a mean over those of an episode, ``[*batch, 1]`` [m].
        time_step: duration of a step [s].
        leader: speed of the vehicle ahead of the string, ``[time, *batch, 1]`` [m/s].

    Returns:
        Each ``[*batch, 1]``: mean speed; standard deviation of a vehicle's speed in time, averaged
        over vehicles (``speed_std_mps``), and over the vehicles at a time, averaged over the
        episode and over its last tenth (``speed_spread_mps``, ``final_speed_spread_mps``);
        vehicles per hour by the mean speed and spacing (``flow_vph``); behind a leader, that
        deviation in time of the last vehicle over the leader's (``string_ratio``); and, on a ring,
        how long the deviation over the vehicles takes to stay below 0.5 m/s (``damping_time_s``;
        NaN: it does not).
    """
    here, steps = alive.unsqueeze(-2), alive.sum(0).clamp(min=1)

    def average(entry: Tensor) -> Tensor:
        """Mean over time of ``[time, *batch, …, 1]``."""
        running = here if entry.ndim == here.ndim else alive
        count = running.sum(0).clamp(min=1)
        return torch.where(running, entry, 0.0).sum(0) / count

    def deviation(entry: Tensor) -> Tensor:
        return average((entry - average(entry)).square()).sqrt()

    # Several times as fast as torch's std of a few vehicles.
    spread = (speed - speed.mean(-2, keepdim=True)).square().mean(-2).sqrt()
    late = torch.arange(len(alive), device=alive.device).view(-1, *[1] * (alive.ndim - 1))
    last = alive & (late >= (0.9 * steps).floor())
    found = {
        "mean_speed_mps": average(speed).mean(-2),
        "speed_std_mps": deviation(speed).mean(-2),
        "speed_spread_mps": average(spread),
        "final_speed_spread_mps": torch.where(last, spread, 0.0).sum(0) / last.sum(0).clamp(min=1),
    }
    found["flow_vph"] = 3600.0 * found["mean_speed_mps"] / (average(gap).mean(-2) + length)
    if leader is None:
        time = (torch.where(spread > CALM, late + 1, 0) * alive).amax(0)
        found["damping_time_s"] = torch.where(time < steps, time * time_step, torch.nan)
    else:
        own = deviation(speed[..., -1, :])
        found["string_ratio"] = own / deviation(leader).clamp(min=1e-3)
    return found
