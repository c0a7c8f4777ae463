"""The calibration's alternative: a genetic search of (v0, T) written for numba as a whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple
from typing import Any

import numpy as np

from lcc_rl.drivers.genetic import GeneticSettings
from lcc_rl.drivers.observed import Observed
from lcc_rl.drivers.parameters import DEFAULT_BOUNDS
from lcc_rl.functional.idm import IDMConstants


def batched_search(observed: Observed, names: tuple[str, str], settings: GeneticSettings) -> Any:
    """Return a function that calibrates all drivers and returns their RMSPE, compiled already.

    Args:
        observed: the episodes; they are simulated in float32, as ours.
        names: the parameters, v0 and T.
        settings: population, founders, generations and rates, the same as ours.
    """
    leader, follower = (
        np.ascontiguousarray(speed.numpy().T, np.float32)
        for speed in (observed.leader_speed, observed.follower_speed)
    )
    single = np.float32
    lower, upper = np.array([DEFAULT_BOUNDS[name] for name in names], single).T.copy()
    dt = observed.time_step
    known = tuple(single(x) for x in (*astuple(IDMConstants()), dt, 0.5 * dt, 0.0, 1.0))
    sizes = (settings.founders * settings.population, settings.population, settings.generations)
    rates = (settings.mutation_rate, settings.mutation_start, settings.mutation_end)
    gap, samples = observed.gap.numpy().astype(single), np.array(observed.samples)
    search = _compiled()

    def run(drivers: int = observed.count) -> Any:
        random = np.random.default_rng(0)
        few = gap[:drivers]
        return search(random, leader, follower, few, samples, known, lower, upper, sizes, rates)

    run(1)
    return run


def errors(leader: Any, follower: Any, first: Any, known: Any, values: Any) -> Any:
    """RMSPE of all candidates (v0, T) of one driver, side by side (A3, A6)."""
    maximum, comfort, min_gap, _, floor, braking, limit, dt, half, zero, one = known
    count = len(values)
    root = (maximum * comfort) ** np.float32(-0.5) * half / dt
    slowness, headway = one / values[:, 0], values[:, 1].copy()
    speed, gap = np.full(count, follower[0]), np.full(count, first)
    total, norm = np.zeros(count, np.float32), follower[0] * follower[0]
    for step in range(len(leader) - 1):
        ahead, mean, truth = (
            leader[step],
            half * (leader[step] + leader[step + 1]),
            follower[step + 1],
        )
        norm += truth * truth
        for i in range(count):
            wish = speed[i] * (headway[i] + (speed[i] - ahead) * root)
            ratio = (max(wish, zero) + min_gap) / max(gap[i], floor)
            free = speed[i] * slowness[i]
            free *= free
            command = maximum * (one - free * free - ratio * ratio)
            reached = max(speed[i] + dt * min(max(command, -braking), limit), zero)
            gap[i] += mean - half * (speed[i] + reached)
            speed[i] = reached
            total[i] += (reached - truth) * (reached - truth)
    return np.sqrt(total / norm)


def children(random: Any, genes: Any, fitness: Any, rate: float, strength: float) -> Any:
    """One child per individual: tournaments of two, blend crossover, difference, mutation."""
    count, dims = genes.shape
    born = np.empty_like(genes)
    for child in range(count):
        a, b, c, d, e, f = random.integers(0, count, 6)
        first, second = (a if fitness[a] < fitness[b] else b), (c if fitness[c] < fitness[d] else d)
        share = random.random()
        for gene in range(dims):
            weight = 2.0 * random.random() - 0.5
            value = genes[first, gene] + weight * (genes[second, gene] - genes[first, gene])
            value += share * (genes[e, gene] - genes[f, gene])
            if random.random() < rate:
                value += strength * random.standard_normal()
            born[child, gene] = min(max(value, 0.0), 1.0)
    return born


def _compiled() -> Callable[..., Any]:
    """The search, compiled by numba."""
    from numba import njit

    fast = njit(fastmath={"contract"}, error_model="numpy")
    simulate, breed = fast(errors), fast(children)

    @fast
    def search(
        random: Any,
        leader: Any,
        follower: Any,
        gap: Any,
        samples: Any,
        known: Any,
        lower: Any,
        upper: Any,
        sizes: Any,
        rates: Any,
    ) -> Any:
        best, (founders, count, generations) = np.empty(len(gap)), sizes
        rate, begin, end = rates
        for driver in range(len(gap)):
            ahead, truth = leader[driver, : samples[driver]], follower[driver, : samples[driver]]
            genes = random.random((founders, len(lower))).astype(np.float32)
            values = simulate(ahead, truth, gap[driver], known, lower + genes * (upper - lower))
            for generation in range(generations):
                order = np.argsort(values)[:count]
                genes, values = genes[order], values[order]
                share = generation / max(generations - 1, 1)
                young = breed(random, genes, values, rate, begin ** (1.0 - share) * end**share)
                born = simulate(ahead, truth, gap[driver], known, lower + young * (upper - lower))
                genes = np.concatenate((genes[: count // 2], young))
                values = np.concatenate((values[: count // 2], born))
            best[driver] = values.min()
        return best

    return search
