"""Calibration room: IDM parameters of observed drivers, all drivers at once (A6)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import pandas as pd
import torch
from torch import Tensor
from torch.nn.functional import pad

from lcc_rl.drivers.genetic import Evolution, GeneticSettings, Progress, minimise
from lcc_rl.drivers.observed import Observed, Selection, observe
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.functional.idm import IDMConstants, power

# Parameters by their place in a gene, with the column each fills and its default bounds.
COLUMNS = {
    "desired_speed": "desired_speed_mps",
    "time_gap": "time_gap_s",
    "acceleration": "acceleration_mps2",
    "deceleration": "deceleration_mps2",
    "min_gap": "min_gap_m",
}
DEFAULT_BOUNDS: dict[str, tuple[float, float]] = {
    "desired_speed": (5.0, 40.0),
    "time_gap": (0.3, 4.0),
    "acceleration": (0.3, 4.0),
    "deceleration": (0.3, 5.0),
    "min_gap": (0.5, 5.0),
}
MODES = {"local": ("desired_speed", "time_gap"), "global": tuple(COLUMNS)}
SHARED = ("acceleration", "deceleration", "min_gap")
DEFAULT_GENETIC = {
    "local": GeneticSettings(population=32, generations=20),
    "global": GeneticSettings(population=64, generations=60),
}
# A parameter this close to a bound, as a share of the range, counts as being on it.
BOUND_TOLERANCE = 0.005
CHUNK = 10


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration.

    Args:
        drivers: one row per driver, in the order of the episodes in the input.
        report: what was dropped, chosen and found, in plain lines.
        constants: the constants that all drivers share in local mode.
        generations: generations that the genetic algorithm ran.
        evaluations: simulated trajectories per driver.
    """

    drivers: pd.DataFrame
    report: list[str]
    constants: IDMConstants
    generations: int
    evaluations: int


class SpeedError:
    """RMSPE of simulated followers for many candidates of every driver (A6).

    A follower starts at its observed speed and gap and drives behind the observed leader. The
    trajectories are those of :func:`lcc_rl.functional.idm.simulate_follower`, but only the error
    is kept, and no episode is simulated beyond its end.

    Args:
        observed: the episodes; its device and dtype are those of the simulation.
        constants: parameters that are not among the candidates'.
        names: the candidates' parameters, in the order of the last dimension.
        compiled: compile the simulation: about three times faster, after tens of seconds of
            compilation, so worth it for thousands of drivers.
    """

    def __init__(
        self,
        observed: Observed,
        constants: IDMConstants,
        names: Sequence[str] = MODES["local"],
        compiled: bool = False,
    ) -> None:
        self.constants, self.names = constants, tuple(names)
        self.gap = observed.gap.unsqueeze(-1)
        self.time_step = observed.time_step
        self._run = _compiled_advance() if compiled else _advance
        self._pieces = list(observed.segments(CHUNK if compiled else None))
        spare = self._pieces[-1][1] + 1 - len(observed.leader_speed)
        self._leader = pad(observed.leader_speed, (0, 0, 0, spare)).unsqueeze(-1)
        self._follower = pad(observed.follower_speed, (0, 0, 0, spare)).unsqueeze(-1)
        self._norm = observed.follower_speed.square().sum(0).unsqueeze(-1)
        self._counts = self._weights(observed) if compiled else None

    def __call__(self, candidates: Tensor) -> Tensor:
        """Return RMSPE ``[drivers, candidates]`` (0.07 is 7 %) of ``[drivers, candidates, dims]``.

        The constants may be tensors that broadcast to ``[drivers, candidates]``.
        """
        with torch.no_grad():
            parameters = self._parameters(candidates)
            speed = self._follower[0].expand(candidates.shape[:-1]).contiguous()
            gap = self.gap.expand_as(speed).contiguous()
            total = torch.zeros_like(speed)
            for start, stop, active in self._pieces:
                window = slice(start, stop + 1)
                speed, gap, part = self._run(
                    (speed[:active], gap[:active], total[:active]),
                    tuple(parameter[:active] for parameter in parameters),
                    (self._leader[window, :active], self._follower[window, :active]),
                    None if self._counts is None else self._counts[start:stop, :active],
                    self.constants,
                    self.time_step,
                )
                total[:active] = part
            return (total / self._norm).sqrt()

    def _parameters(self, candidates: Tensor) -> tuple[Tensor, ...]:
        """Per candidate: 1/v0, T, a, 1/(2√(ab)), s0."""
        given = dict(zip(self.names, candidates.unbind(-1), strict=True))
        shape = candidates.shape[:-1]
        values = [
            torch.as_tensor(
                given.get(name, getattr(self.constants, name, None)),
                dtype=candidates.dtype,
                device=candidates.device,
            )
            for name in COLUMNS
        ]
        desired_speed, time_gap, acceleration, deceleration, min_gap = values
        root = 2.0 * (acceleration * deceleration).sqrt()
        ready = (desired_speed.reciprocal(), time_gap, acceleration, root.reciprocal(), min_gap)
        return tuple(value.expand(shape).contiguous() for value in ready)

    def _weights(self, observed: Observed) -> Tensor:
        """1 for the samples of an episode, 0 beyond its end; pieces of one length reach there."""
        reached = torch.arange(1, len(self._leader), device=self.gap.device).unsqueeze(-1)
        samples = torch.tensor(observed.samples.tolist(), device=self.gap.device)
        return (reached < samples).to(self.gap.dtype).unsqueeze(-1)


State = tuple[Tensor, Tensor, Tensor]


def _advance(
    state: State,
    parameters: tuple[Tensor, ...],
    speeds: tuple[Tensor, Tensor],
    weights: Tensor | None,
    constants: IDMConstants,
    time_step: float,
) -> State:
    """Drive followers through a piece of time; the formulas are A3, A4 and A18.

    They are written out here with temporaries reused in place, which is twice as fast as the
    pure functions; a test holds both against each other.
    """
    speed, gap, total = state
    slowness, time_gap, acceleration, inverse_root, min_gap = parameters
    leader, observed = (tensor.unbind(0) for tensor in speeds)
    half = 0.5 * time_step
    for step in range(len(leader) - 1):
        ahead, ahead_reached = leader[step], leader[step + 1]
        wish = torch.addcmul(time_gap, speed - ahead, inverse_root)
        wish = wish.mul_(speed).clamp_(min=0.0).add_(min_gap)
        wish = wish.div_(gap.clamp(min=constants.gap_floor))
        load = power(speed * slowness, constants.exponent).addcmul_(wish, wish)
        command = torch.addcmul(acceleration, acceleration, load, value=-1.0)
        command = command.clamp_(-constants.braking_limit, constants.acceleration_limit)
        reached = torch.add(speed, command, alpha=time_step).clamp_(min=0.0)
        gap = torch.add(gap, ahead + ahead_reached, alpha=half)
        gap = gap.sub_(speed, alpha=half).sub_(reached, alpha=half)
        error = reached - observed[step + 1]
        if weights is not None:
            error = error * weights[step]
        total = torch.addcmul(total, error, error)
        speed = reached
    return speed, gap, total


@lru_cache(maxsize=1)
def _compiled_advance() -> Callable[..., State]:
    return torch.compile(_advance, dynamic=True)


def fit(
    episodes: pd.DataFrame | Observed,
    mode: str = "local",
    bounds: Mapping[str, Sequence[float]] | None = None,
    constants: IDMConstants | None = None,
    genetic: GeneticSettings | None = None,
    selection: Selection | None = None,
    seed: int = 0,
    choose_constants: bool = False,
    compiled: bool = False,
    device: torch.device | str = "cpu",
    dtype: torch.dtype = torch.float32,
    progress: Progress | None = None,
) -> Calibration:
    """Calibrate one driver per episode (A6), all of them at once.

    Args:
        episodes: the episode table, or what :func:`lcc_rl.drivers.observed.observe` made of it.
        mode: ``local`` fits (v0, T), ``global`` fits (v0, T, a, b, s0).
        bounds: lower and upper bound by parameter; those not named keep their default.
        constants: parameters that are not fitted; by default a 1.0, b 1.5, s0 2.0.
        genetic: settings of the genetic algorithm; defaults depend on the mode.
        selection: which episodes are used, and how much of them.
        seed: seed of all randomness; equal seeds give equal drivers.
        choose_constants: in local mode, first choose (a, b, s0) by the same objective over the
            whole set (the paper: by trial and error).
        compiled: compile the simulation, see :class:`SpeedError`.
        device: where to simulate.
        dtype: precision of the search; the reported errors are evaluated in float64.
        progress: called as ``progress(generation, total, text)``.

    Returns:
        Parameters and errors per driver; see :class:`Calibration`.

    Raises:
        ConfigError: if a mode, parameter or bound is unknown or impossible.
        DataError: if the table lacks a column or holds no usable episode.
    """
    if mode not in MODES:
        raise unknown_name("calibration mode", mode, MODES)
    if choose_constants and mode != "local":
        raise ConfigError("choose_constants applies to local calibration only")
    limits = checked_bounds(bounds)
    constants = constants or IDMConstants()
    genetic = genetic or DEFAULT_GENETIC[mode]
    observed = episodes if isinstance(episodes, Observed) else observe(episodes, selection)
    ready = observed.to(device, dtype)
    report = list(observed.report)
    if choose_constants:
        constants = _choose_constants(ready, limits, constants, seed, compiled, progress)
        report.append(
            f"constants chosen over all drivers: a {constants.acceleration:.3g} m/s², "
            f"b {constants.deceleration:.3g} m/s², s0 {constants.min_gap:.3g} m"
        )
    names = MODES[mode]
    error = SpeedError(ready, constants, names, compiled)
    lower, upper = _box(names, limits, ready.gap)
    generator = torch.Generator().manual_seed(seed)
    found = minimise(error, lower, upper, ready.count, generator, genetic, progress)
    drivers = _table(observed, found, constants, mode, limits)
    report += _findings(drivers, limits)
    return Calibration(drivers, report, constants, found.generations, found.evaluations)


def checked_bounds(bounds: Mapping[str, Sequence[float]] | None) -> dict[str, tuple[float, float]]:
    """Fill in default bounds and check the given ones.

    Raises:
        ConfigError: if a parameter is unknown or its bounds are not 0 < lower < upper.
    """
    limits = dict(DEFAULT_BOUNDS)
    for name, pair in (bounds or {}).items():
        if name not in COLUMNS:
            raise unknown_name("IDM parameter", name, COLUMNS)
        if len(pair) != 2 or not 0.0 < pair[0] < pair[1]:
            raise ConfigError(f"bounds of {name!r} must be 0 < lower < upper, got {list(pair)}")
        limits[name] = (float(pair[0]), float(pair[1]))
    return limits


def _box(
    names: Sequence[str], limits: Mapping[str, tuple[float, float]], like: Tensor
) -> tuple[Tensor, Tensor]:
    lower, upper = zip(*(limits[name] for name in names), strict=True)
    return like.new_tensor(lower), like.new_tensor(upper)


def _choose_constants(
    observed: Observed,
    limits: Mapping[str, tuple[float, float]],
    constants: IDMConstants,
    seed: int,
    compiled: bool,
    progress: Progress | None,
) -> IDMConstants:
    """Choose (a, b, s0): an outer search whose objective is the mean error of local fits."""
    inner = GeneticSettings(population=16, generations=8)
    outer = GeneticSettings(population=12, generations=12, founders=2, patience=4)
    lower, upper = _box(MODES["local"], limits, observed.gap)

    def mean_error(candidates: Tensor) -> Tensor:
        # Every pair of driver and candidate is a problem of its own.
        count = candidates.shape[1]

        def error(genes: Tensor) -> Tensor:
            own = candidates[0].repeat_interleave(genes.shape[1], dim=0).unbind(-1)
            trial = constants.with_(**dict(zip(SHARED, own, strict=True)))
            side_by_side = genes.reshape(observed.count, -1, genes.shape[-1])
            found = SpeedError(observed, trial, MODES["local"], compiled)(side_by_side)
            return found.reshape(genes.shape[:-1])

        generator = torch.Generator().manual_seed(seed)
        found = minimise(error, lower, upper, observed.count * count, generator, inner)
        return found.fitness.reshape(observed.count, count).mean(0, keepdim=True)

    generator = torch.Generator().manual_seed(seed)
    box = _box(SHARED, limits, observed.gap)
    best = minimise(mean_error, *box, 1, generator, outer, progress).best[0].tolist()
    return replace(constants, **dict(zip(SHARED, best, strict=True)))


def _table(
    observed: Observed,
    found: Evolution,
    constants: IDMConstants,
    mode: str,
    limits: Mapping[str, tuple[float, float]],
) -> pd.DataFrame:
    """Write the fittest parameters beside who they belong to."""
    names = MODES[mode]
    best = found.best.to("cpu", torch.float64)
    exact = SpeedError(observed.to("cpu", torch.float64), constants, names)
    columns: dict[str, Any] = {str(name): values for name, values in observed.identity.items()}
    fitted = dict(zip(names, best.unbind(-1), strict=True))
    for name, column in COLUMNS.items():
        columns[column] = fitted[name].numpy() if name in fitted else getattr(constants, name)
    columns["rmspe"] = exact(best.unsqueeze(1)).squeeze(1).numpy()
    columns["samples"] = observed.samples
    for name in COLUMNS:
        columns[f"{name}_at_bound"] = (
            _at_bound(fitted[name], limits[name]).numpy() if name in fitted else False
        )
    columns["mode"] = mode
    # Back to the order of the input, which the search had sorted by length.
    return pd.DataFrame(columns).sort_values("episode", kind="stable", ignore_index=True)


def _at_bound(values: Tensor, pair: tuple[float, float]) -> Tensor:
    """Whether a parameter lies on its lower or upper bound."""
    margin = BOUND_TOLERANCE * (pair[1] - pair[0])
    return (values <= pair[0] + margin) | (values >= pair[1] - margin)


def _findings(drivers: pd.DataFrame, limits: Mapping[str, tuple[float, float]]) -> list[str]:
    """Say how good the fit is and what it could not identify."""
    error = 100.0 * drivers["rmspe"]
    lines = [
        f"RMSPE of {len(drivers)} drivers: mean {error.mean():.2f} %, "
        f"median {error.median():.2f} %, worst {error.max():.1f} %"
    ]
    share = drivers["desired_speed_at_bound"].mean()
    if share > 0.0:
        low, high = limits["desired_speed"]
        lines.append(
            f"{100 * share:.0f} % of the desired speeds lie on a bound ({low:g} or {high:g} m/s): "
            "congested traffic does not tell how fast these drivers would like to go"
        )
    return lines
