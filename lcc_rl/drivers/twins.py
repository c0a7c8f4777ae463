"""Twins: calibrated drivers, each behind the leader of the driver to which it was fitted.

A calibration that minimises the error of speed or gap gives drivers that accelerate too little,
because it penalises every acceleration at the wrong time. Energy is compared by driving each
calibrated driver behind its own recorded leader. The fit has no reaction, a delay and a noise that
all drivers share. These are chosen by the spectrum of the acceleration, the energy lost to
accelerating and the growth of energy along a string of such drivers. With a delay only, the first
driver fits, but its successors amplify its motion until they collide. A noise of the perceived gap
is optional. With the noise of the acceleration only, drivers are too lively behind calm leaders and
too calm behind rough ones, if leaders differ much.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from lcc_rl.drivers.genetic import Progress
from lcc_rl.drivers.observed import Observed
from lcc_rl.energy import AVERAGES, PaperMotor
from lcc_rl.errors import Concern
from lcc_rl.functional.driver_models import (
    GAP_NOISE_TIME,
    DriverConstants,
    NoiseStep,
    Reaction,
    follow,
)
from lcc_rl.functional.laws import LAWS

FREQUENCIES = (0.04, 0.26)  # frequencies compared; above them the records are smoothed [Hz]
SPECTRUM_WINDOW = 20.0  # length of parts of a record in its spectrum; parts overlap by half [s]
LONG_GAP = 2.5  # time gap that counts as long, above 1 m/s [s]
REPEATS = 2  # draws of the noise of every driver
AT_ONCE = 20_000  # parallel trajectories; more would only need memory
DRIVER_FOLDS = 5  # each fold is evaluated with the reaction chosen on the other folds
DELAYS = tuple(round(0.1 * number, 1) for number in range(10))  # candidates, see delays_at [s]
NOISES = tuple(round(0.05 * number, 2) for number in range(13))  # likewise [m/s²]
# Candidates of the relative noise of gaps, in addition to none; see choose_reaction.
GAP_NOISES = tuple(round(0.1 * number, 1) for number in range(1, 7))
TOLERANCES = {"lost": 0.05, "spectrum": 0.2, "growth": 0.05, "slope": 0.1}
LEADER_LOST, LEADER_WAY = "leader_lost_1.1s_j", "leader_distance_1.1s_m"
CARS = 5  # cars in the string over which energy must not grow
HELD = "the recorded drivers hold their speeds"
LEAST_LOST = 1e-6  # share of the energy that drivers in traffic lose at least to accelerating
DENSITY, HERTZ = "density_", "hz"  # around the frequency in the name of a column
RECORDED_DRIVERS, TWINS, REACTING = "recorded", "as calibrated", "with reaction"
_Array = NDArray[np.float64]
_Rows = NDArray[np.bool_]
People = tuple[DriverConstants, tuple[Tensor, Tensor]]  # model and (v0, T) of drivers


def measure_motion(
    speed: _Array, gap: _Array, samples: NDArray[np.int64], time_step: float
) -> pd.DataFrame:
    """Measure the motion of drivers, means over draws of their noise.

    The energy is that of the paper's motor (A2) net of kinetic energy.

    Args:
        speed: ``[time, draws, drivers]`` [m/s].
        gap: ``[time, draws, drivers]`` [m].
        samples: samples of every record, ``[drivers]``.
        time_step: T [s].

    Returns:
        A row per driver: mean gap_m and long_gap_share of the time; for each of
        :data:`lcc_rl.energy.AVERAGES`, such as 1.1 s, energy_1.1s_j, its part lost_1.1s_j and
        distance_1.1s_m; and for each frequency within :data:`FREQUENCIES`, such as 0.1 Hz,
        density_0.1hz of the acceleration [m²/s⁴/Hz], NaN for records shorter than
        :data:`SPECTRUM_WINDOW`.
    """
    table: dict[str, _Array] = {}
    for smoothing in AVERAGES:
        found = _energies(speed, samples, time_step, smoothing)
        units = {"energy": "j", "lost": "j", "distance": "m"}
        table |= {f"{x}_{smoothing}s_{unit}": found[x] for x, unit in units.items()}
    alive = running(len(speed), samples)
    table["gap_m"] = (gap * alive).mean(1).sum(0) / samples
    moving = alive & (speed > 1.0)
    far = moving & (gap > LONG_GAP * speed)
    table["long_gap_share"] = far.sum((0, 1)) / np.maximum(moving.sum((0, 1)), 1)
    return pd.DataFrame(table | _spectrum(speed, samples, time_step))


def running(length: int, samples: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return which of ``length`` samples belong to a record, ``[length, 1, drivers]``."""
    return (np.arange(length)[:, None] < samples)[:, None]


def _energies(
    speed: _Array, samples: NDArray[np.int64], time_step: float, smoothing: float
) -> dict[str, _Array]:
    """Return energy [J], its part lost to accelerating [J] and distance [m], each ``[drivers]``."""
    width, motor = round(smoothing / time_step), PaperMotor()
    total = np.cumsum(np.concatenate([0.0 * speed[:1], speed]), axis=0)
    smooth = (total[width:] - total[:-width]) / width
    inside = running(len(smooth) - 1, samples - width)
    accelerations = torch.from_numpy(np.diff(smooth, axis=0) / time_step)
    motion = (torch.from_numpy(smooth[:-1]), accelerations)
    rates = {
        "energy": motor.path_power(*motion).numpy(),
        "lost": motor.acceleration_loss(*motion).numpy(),
        "distance": 0.5 * (smooth[1:] + smooth[:-1]),
    }
    return {name: (rate * time_step * inside).sum(0).mean(0) for name, rate in rates.items()}


def _spectrum(speed: _Array, samples: NDArray[np.int64], time_step: float) -> dict[str, _Array]:
    """Return the acceleration's density by Welch's method, ``[drivers]`` for each frequency."""
    acceleration, width = np.diff(speed, axis=0) / time_step, round(SPECTRUM_WINDOW / time_step)
    frequency = np.fft.rfftfreq(width, time_step)
    inside = (frequency >= FREQUENCIES[0]) & (frequency <= FREQUENCIES[1])
    taper = np.hanning(width)[:, None, None]
    total, count = np.zeros((int(inside.sum()), speed.shape[-1])), np.zeros(speed.shape[-1])
    for start in range(0, len(acceleration) - width + 1, width // 2):
        part = acceleration[start : start + width]
        power = np.abs(np.fft.rfft((part - part.mean(0)) * taper, axis=0)[inside]) ** 2
        whole = samples > start + width
        total += power.mean(1) * whole
        count += whole
    scale = 2.0 * time_step / (taper**2).sum()
    density = scale * total / np.where(count > 0, count, np.nan)
    names = [f"{DENSITY}{hertz:g}{HERTZ}" for hertz in frequency[inside]]
    return dict(zip(names, density, strict=True))


def densities(table: pd.DataFrame) -> pd.DataFrame:
    """Return the densities of measured drivers, by frequency [Hz]; without short records."""
    found = [str(name) for name in table if str(name).startswith(DENSITY)]
    values = table[found].to_numpy()
    hertz = [float(name[len(DENSITY) : -len(HERTZ)]) for name in found]
    return pd.DataFrame(values[~np.isnan(values).any(1)], columns=hertz)


def measure_recorded(observed: Observed) -> pd.DataFrame:
    """Measure the recorded drivers, and loss by accelerating [J] and distance [m] of leaders."""
    series = (observed.follower_speed, observed.gaps, observed.leader_speed)
    speed, gap, leader = (x.double().cpu().numpy()[:, None] for x in series)
    table = measure_motion(speed, gap, observed.samples, observed.time_step)
    ahead = _energies(leader, observed.samples, observed.time_step, AVERAGES[0])
    return table.assign(**{LEADER_LOST: ahead["lost"], LEADER_WAY: ahead["distance"]})


def drive_twins(
    observed: Observed, drivers: pd.DataFrame, reactions: Sequence[Reaction], repeats: int = REPEATS
) -> list[pd.DataFrame]:
    """Drive calibrated drivers from the first speed and gap of the recorded ones.

    Args:
        observed: the recorded drivers and their leaders.
        drivers: their calibrated parameters by one model, a row for each episode.
        reactions: reactions with one delay; all have the same draws of the noise.
        repeats: draws of the noise.

    Returns:
        Measured tables for every reaction, with the error of the speed, rmspe (A6).
    """
    series = (observed.leader_speed, observed.follower_speed[0], observed.gaps[0])
    leader, *start = (x.double().cpu() for x in series)
    generator = torch.Generator().manual_seed(0)
    people, shape = _people(observed, drivers), (len(reactions), repeats, observed.count)
    motion = drive(people, leader, start, reactions, shape, generator, observed.time_step)
    truth = observed.follower_speed.double().cpu().numpy()[:, None]
    alive = running(len(truth), observed.samples)
    norm = (truth**2).sum(0)
    found = []
    for speed, gap in motion:
        share = np.sqrt((((speed - truth) * alive) ** 2).sum(0) / norm).mean(0)
        table = measure_motion(speed, gap, observed.samples, observed.time_step)
        found.append(table.assign(rmspe=share))
    return found


def growth(observed: Observed, drivers: pd.DataFrame, reactions: Sequence[Reaction]) -> list[float]:
    """Return the growth of energy from the first to the last of :data:`CARS` drivers.

    Behind every recorded leader, drivers drawn from all of them follow one another and start at
    equilibrium. The growth is the logarithm of the ratio of both energies per distance, for every
    reaction; it is infinite after a collision.
    """
    law, own = _people(observed, drivers)
    leader = observed.leader_speed.double().cpu()
    generator, chance = torch.Generator().manual_seed(0), np.random.default_rng(0)
    shape, step = (len(reactions), 1, observed.count), observed.time_step
    energies, collided = [], np.zeros(len(reactions), bool)
    inside = running(len(leader), observed.samples)
    for car in range(CARS):
        order = torch.from_numpy(chance.permutation(observed.count))
        shared = {name: getattr(law, name)[order] for name in law.shared()}
        people = (law.with_(**shared), (own[0][order], own[1][order]))
        gap = people[0].equilibrium_gap(leader[0], *people[1])
        motion = drive(people, leader, (leader[0], gap), reactions, shape, generator, step)
        collided |= [bool(((gaps <= 0.0) & inside).any()) for _, gaps in motion]
        if car in (0, CARS - 1):
            each = [_energies(x, observed.samples, step, AVERAGES[0]) for x, _ in motion]
            energies.append([one["energy"].sum() / one["distance"].sum() for one in each])
        leader = torch.from_numpy(np.stack([speed for speed, _ in motion], 1))
    grown = np.log(np.divide(energies[1], energies[0]))
    return [float(x) for x in np.where(collided, np.inf, grown)]


def drive(
    people: People,
    leader: Tensor,
    start: Sequence[Tensor],
    reactions: Sequence[Reaction],
    shape: tuple[int, int, int],
    generator: torch.Generator,
    step: float,
) -> list[tuple[_Array, _Array]]:
    """Drive followers; return speeds and gaps ``[time, draws, drivers]`` for every reaction.

    The leader's speed is ``[time, …]``, broadcast to reactions, draws and drivers, the ``shape`` of
    the noise. Its last number is 1 if all drivers have the same noise.
    """
    law, own = people
    level, gap_level = (
        torch.tensor(x).double().view(-1, 1, 1)
        for x in ([one.noise for one in reactions], [one.gap_noise for one in reactions])
    )

    def noises(noise_step: NoiseStep) -> Iterator[Tensor]:
        def draw() -> Tensor:
            return torch.randn(shape[1:], generator=generator, dtype=torch.float64)

        noise, last = noise_step.start(draw(), draw())
        while True:
            yield noise
            noise, last = noise_step.next(noise, last, draw()), noise

    own_noise, gap_noise = noises(NoiseStep.of(step)), noises(NoiseStep.of(step, GAP_NOISE_TIME))

    def strayed(_: int, command: Tensor) -> Tensor:
        return command + level * next(own_noise)

    def seen(gap: Tensor) -> Tensor:
        return gap * (gap_level * next(gap_noise)).exp()

    speed, gap = (x.expand(*shape[:2], -1) for x in start)
    late = round(reactions[0].delay / step)
    sight = seen if gap_level.any() else None
    driven = follow(law, leader, speed, gap, own, step, late, strayed, sight)
    motion = [(speed, gap), *((speed, gap) for speed, gap, _ in driven)]
    speeds, gaps = (torch.stack(x, 1).numpy() for x in zip(*motion, strict=True))
    return list(zip(speeds, gaps, strict=True))


def one_step_error(observed: Observed, drivers: pd.DataFrame, delay: float) -> float:
    """Return the standard deviation of a model's error of the next acceleration [m/s²].

    The model reads the recorded state, delayed by the reaction delay. Except for a constant, the
    logarithm of this number is the negative log-likelihood of a sample.
    """
    law, own = _people(observed, drivers)
    series = (observed.leader_speed, observed.follower_speed, observed.gaps)
    leader, speed, gap = (x.double().cpu() for x in series)
    late = round(delay / observed.time_step)
    wish = law(speed, gap, speed - leader, *own)
    left = speed.diff(dim=0)[late:] / observed.time_step - wish[: len(wish) - 1 - late]
    last = torch.tensor(observed.samples) - 1 - late
    inside = torch.arange(len(left)).unsqueeze(-1) < last
    return float((left.square() * inside).sum().div(inside.sum()).sqrt())


def _people(observed: Observed, drivers: pd.DataFrame) -> People:
    """Return the model and (v0, T) of the drivers in the order of the records."""
    table = drivers.set_index("episode").loc[observed.identity["episode"]]
    law = LAWS[str(table["model"].iloc[0])]
    columns = {name: one.column for name, one in law.table().items()}
    own = {name: torch.tensor(table[x].to_numpy(np.float64)) for name, x in columns.items()}
    return law().with_(**{x: own[x] for x in law.shared()}), (own["desired_speed"], own["time_gap"])


def ratios(
    twins: pd.DataFrame, records: pd.DataFrame, smoothing: float = AVERAGES[0]
) -> dict[str, float]:
    """Compare drivers with the recorded ones by ratios of sums over them.

    Args:
        twins, records: tables of :func:`measure_motion` for the same drivers.
        smoothing: one of :data:`lcc_rl.energy.AVERAGES` [s].

    Returns:
        ``energy`` and ``lost`` (to accelerating) per distance; ``distance``; ``lost_1`` to
        ``lost_3``, the loss behind the calmest, middle and roughest third of the leaders, by their
        loss per distance, if it is known; and root mean squares of logarithms of ratios: ``slope``
        of these three, and ``spectrum`` of the densities, 0 if all records are too short.
    """

    def over(column: str, rows: Any = slice(None)) -> Any:
        own, recorded = (table[column].to_numpy()[rows].sum() for table in (twins, records))
        return own / recorded

    energy, lost, distance = (
        f"{name}_{smoothing}s_{unit}"
        for name, unit in (("energy", "j"), ("lost", "j"), ("distance", "m"))
    )
    thirds: list[NDArray[np.intp]] = []  # of their leaders, the calmest first
    if LEADER_LOST in records and len(records) >= 3:
        calm_first = (records[LEADER_LOST] / records[LEADER_WAY]).to_numpy().argsort()
        thirds = np.array_split(calm_first, 3)
    by_third = [over(lost, rows) / over(distance, rows) for rows in thirds]
    own, recorded = (densities(table).to_numpy().sum(0) for table in (twins, records))
    apart = np.log(np.divide(own, recorded, out=np.ones_like(own), where=recorded > 0.0))
    return {
        "energy": float(over(energy) / over(distance)),
        "lost": float(over(lost) / over(distance)),
        "distance": float(over(distance)),
        **{f"lost_{number}": float(value) for number, value in enumerate(by_third, 1)},
        "slope": float(np.sqrt(np.mean(np.log(by_third) ** 2))) if by_third else np.nan,
        "spectrum": float(np.sqrt(np.mean(apart**2))),
    }


@dataclass(frozen=True)
class Tried:
    """Twins with one reaction: their measured table, and :func:`growth`."""

    twins: pd.DataFrame
    growth: float


def delays_at(step: float) -> list[float]:
    """Return the multiples of a time step [s] that are nearest to :data:`DELAYS`, each once."""
    return list(dict.fromkeys(round(round(delay / step) * step, 3) for delay in DELAYS))


def tried(
    observed: Observed,
    drivers: pd.DataFrame,
    progress: Progress | None = None,
    perception: bool = False,
) -> dict[Reaction, Tried]:
    """Drive twins with all of :func:`delays_at` × :data:`NOISES`.

    Args:
        observed, drivers: see :func:`drive_twins`.
        progress: called as ``progress(tried, total, text)``.
        perception: also drive every second of both with all :data:`GAP_NOISES`.
    """
    found: dict[Reaction, Tried] = {}
    together = max(1, AT_ONCE // (REPEATS * observed.count))
    delays = delays_at(observed.time_step)
    grid = {delay: [Reaction(delay, noise) for noise in NOISES] for delay in delays}
    for delay in delays[::2] if perception else ():
        grid[delay] += [Reaction(delay, x, gap) for x in NOISES[::2] for gap in GAP_NOISES]
    count = sum(map(len, grid.values()))
    for every in grid.values():
        for start in range(0, len(every), together):
            reactions = every[start : start + together]
            twins = drive_twins(observed, drivers, reactions)
            grown = growth(observed, drivers, reactions)
            found |= dict(zip(reactions, map(Tried, twins, grown), strict=True))
            if progress is not None:
                progress(len(found), count, "reactions tried")
    return found


def choose_reaction(
    tries: Mapping[Reaction, Tried], records: pd.DataFrame, rows: _Rows
) -> Reaction:
    """Choose the reaction with which the drivers are nearest to the recorded ones.

    The objective is the sum of squares of three logarithms, each divided by its
    :data:`TOLERANCES`: the ratios of the energy lost to accelerating and of the spectrum to the
    recorded ones, and the growth of energy along a string of such drivers. If noises of the
    perceived gap were tried, the ``slope`` of :func:`ratios` is the fourth.
    """
    sized = {name: size for name, size in TOLERANCES.items() if name != "slope"}
    if any(reaction.gap_noise for reaction in tries):
        sized = TOLERANCES

    def distance(reaction: Reaction) -> float:
        near = ratios(tries[reaction].twins[rows], records[rows])
        errors = {
            "lost": np.log(near["lost"]),
            "spectrum": near["spectrum"],
            "growth": tries[reaction].growth,
            "slope": near["slope"],
        }
        return float(sum((errors[name] / size) ** 2 for name, size in sized.items()))

    return min(tries, key=distance)


def cross_chosen(tries: Mapping[Reaction, Tried], records: pd.DataFrame) -> pd.DataFrame:
    """Return tables of drivers with the reaction that was chosen on the other folds."""
    fold = np.arange(len(records)) % DRIVER_FOLDS
    parts = []
    for own in (fold == number for number in range(min(DRIVER_FOLDS, len(records)))):
        others = ~own if (~own).any() else own
        parts.append(tries[choose_reaction(tries, records, others)].twins[own])
    return pd.concat(parts).sort_index()


def compare_twins(
    observed: Observed,
    drivers: pd.DataFrame,
    react: bool,
    progress: Progress | None,
    perception: bool,
) -> tuple[Reaction, pd.DataFrame, list[str]]:
    """Compare calibrated drivers with the recorded ones.

    Args:
        observed, drivers: see :func:`drive_twins`.
        react: also choose a reaction that all drivers share.
        progress, perception: see :func:`tried`.

    Returns:
        The reaction; tables (:func:`measure_motion`, with the columns episode and driver) of the
        recorded drivers, of their twins and of twins with the reaction that was chosen on other
        drivers; and lines on both.
    """
    records = measure_recorded(observed)
    if not react:
        found = {
            RECORDED_DRIVERS: records,
            TWINS: drive_twins(observed, drivers, [Reaction()], 1)[0],
        }
        line = f"{HELD}: too little to compare the energy of calibrated ones"
        if accelerate(records):
            line = _line(TWINS, found, one_step_error(observed, drivers, 0.0))
        return Reaction(), _together(found, observed), [line]
    tries = tried(observed, drivers, progress, perception)
    reaction = choose_reaction(tries, records, np.ones(len(records), bool))
    found = {
        RECORDED_DRIVERS: records,
        TWINS: tries[Reaction()].twins,
        REACTING: cross_chosen(tries, records),
    }
    errors = {
        kind: one_step_error(observed, drivers, delay)
        for kind, delay in ((TWINS, 0.0), (REACTING, reaction.delay))
    }
    line = (
        f"reaction delay {reaction.delay:g} s and acceleration noise {reaction.noise:g} m/s²"
        f"{f', noise of perceived gaps {reaction.gap_noise:g},' * bool(reaction.gap_noise)} "
        "chosen together so that energies are those recorded, no estimate of a reaction time "
        f"({100 * np.expm1(tries[reaction].growth):+.0f} % of energy from the first to the "
        f"{CARS}th in a row); below, each driver has the choice on others"
    )
    lines = [Concern(line), *(_line(kind, found, one) for kind, one in errors.items())]
    return reaction, _together(found, observed), lines


def accelerate(records: pd.DataFrame) -> bool:
    """Whether measured drivers lose a measurable part of their energy to accelerating."""
    lost, energy = (records[f"{x}_{AVERAGES[0]}s_j"].sum() for x in ("lost", "energy"))
    return bool(lost > LEAST_LOST * energy)


def _together(found: Mapping[str, pd.DataFrame], observed: Observed) -> pd.DataFrame:
    episode = observed.identity["episode"]
    parts = [part.assign(episode=episode, driver=kind) for kind, part in found.items()]
    return pd.concat(parts, ignore_index=True)


def _line(kind: str, found: Mapping[str, pd.DataFrame], one_step: float) -> str:
    each = [ratios(found[kind], found[RECORDED_DRIVERS], smoothing=width) for width in AVERAGES]
    energies = ", ".join(f"{one['energy']:.3f}" for one in each)
    losses = ", ".join(f"{one['lost']:.2f}" for one in each)
    parts = ", ".join(f"{value:.2f}" for name, value in each[0].items() if "lost_" in name)
    own, theirs = (found[x].mean(numeric_only=True) for x in (kind, RECORDED_DRIVERS))
    return (
        f"drivers {kind}: RMSPE {100 * own.rmspe:.1f} %; {energies} of the recorded energy per km, "
        f"{losses} of the loss by accelerating (speeds smoothed over {AVERAGES[0]}, "
        f"{AVERAGES[1]} s), {parts} of this loss behind the calmest, middle and roughest leaders; "
        f"spectrum off by a factor {np.exp(each[0]['spectrum']):.2f}, one-step error "
        f"{one_step:.2f} m/s²; distance {each[0]['distance']:.3f} of the recorded one, gap "
        f"{own.gap_m:.1f} m against {theirs.gap_m:.1f} m, long time gaps "
        f"{100 * own.long_gap_share:.1f} % against {100 * theirs.long_gap_share:.1f} %"
    )
