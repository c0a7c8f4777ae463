"""Genetic algorithm and Newton's method that solve many independent problems at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor

from lcc_rl.errors import ConfigError
from lcc_rl.settings import NonNegative, Positive, Settings

Fitness = Callable[[Tensor], Tensor]
Progress = Callable[[int, int, str], None]

Individuals = Annotated[int, Field(ge=1, le=100_000)]
# Newton's method: shift that measures derivatives, as a share of the bounds; largest number of
# rounds; damping tried, as a share of the largest curvature; relative and absolute decrease of the
# objective below which a problem is solved.
SHIFTED, ROUNDS, SOLVED, NEGLIGIBLE = 1e-5, 100, 5e-5, 1e-6
DAMPINGS = (1e-9, 1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 1.0)
Probability = Annotated[float, Field(ge=0.0, le=1.0)]


class GeneticSettings(Settings):
    """Settings of the genetic algorithm."""

    population: Annotated[int, Field(ge=4, le=100_000)] = 32  # individuals per problem
    generations: Individuals = 20
    founders: Individuals = 8  # size of the first generation, in populations; the fittest survive
    elites: Probability = 0.5  # share of a generation that may survive by its fitness
    tournament: Individuals = 2  # individuals drawn per tournament; the fittest is a parent
    # Largest distance of a child from its parents' interval (BLX-α), as a share of it.
    blend: NonNegative = 0.5
    difference_rate: Probability = 1.0  # probability of a shift by a difference of individuals
    mutation_rate: Probability = 0.3  # probability of Gaussian noise on a gene
    mutation_start: Positive = 0.1  # standard deviation of that noise, as a share of the bounds
    mutation_end: Positive = 1e-4  # that in the last generation; geometric in between


def minimise(
    objective: Fitness,
    lower: Tensor,
    upper: Tensor,
    problems: int,
    generator: torch.Generator,
    settings: GeneticSettings | None = None,
    progress: Progress | None = None,
) -> Tensor:
    """Minimise an objective inside a box, for all problems at once.

    The algorithm uses tournament selection, blend crossover (Eshelman & Schaffer 1993), mutation by
    differences of individuals and by annealed Gaussian noise, and elitist survival. All problems
    share the random numbers of a generation; a result does not depend on other problems.

    Args:
        objective: maps ``[problems, population, dims]`` to ``[problems, population]``; values that
            are not finite count as infinite.
        lower, upper: bounds, ``[dims]``; the search has the device and dtype of ``lower``.
        problems: number of problems.
        generator: generator of all random numbers, on the CPU, so that devices agree.
        settings: settings of the algorithm.
        progress: called as ``progress(generation, total, text)`` after each generation.

    Returns:
        The fittest individual of every problem, ``[problems, dims]``.

    Raises:
        ConfigError: if the bounds are empty or crossed.
    """
    settings = settings or GeneticSettings()
    if lower.ndim != 1 or lower.shape != upper.shape or not bool((lower < upper).all()):
        raise ConfigError("bounds must be two vectors of one length with lower < upper")
    evaluate = _in_units(objective, lower, upper)
    best = _evolve(evaluate, problems, _Random(generator, lower), settings, progress)
    return lower + best * (upper - lower)


def polish(terms: Fitness, best: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Move solutions to the next minimum by damped Newton steps; no objective increases.

    The objective is a sum of roots of smooth terms. Steps minimise the terms' squares, each divided
    by its present root. Derivatives are differences. Negative curvatures count as positive ones,
    and a parameter stays on a bound that the slope leads beyond.

    Args:
        terms: returns the summands of the objective, ``[problems, population, summands]``, for
            ``[problems, population, dims]``, in float64.
        best: solutions ``[problems, dims]``.
        lower, upper: bounds, ``[dims]``.

    Returns:
        The solutions, and whether each is a minimum, ``[problems]``.
    """
    span, count = upper - lower, len(lower)
    evaluate = _in_units(terms, lower, upper)
    one = torch.eye(count).to(best)
    row, column = torch.triu_indices(count, count, 1)
    shifts = SHIFTED * torch.cat([one, one[row] + one[column]])
    shifts = torch.cat([0.0 * one[:1], shifts, -shifts])
    damping = torch.tensor(DAMPINGS).to(best)
    genes = ((best - lower) / span).clamp(0.0, 1.0).unsqueeze(1)
    least, solved = evaluate(genes).sum(-1), torch.zeros(len(best), dtype=torch.bool)
    for _ in range(ROUNDS):
        values = evaluate(genes.clamp(SHIFTED, 1.0 - SHIFTED) + shifts)
        values = (values.square() / values[:, :1].clamp(min=NEGLIGIBLE**2)).sum(-1)
        slope, curve = _derivatives(values, count)
        place = genes.squeeze(1)
        free = ~((place <= 0.0) & (slope > 0.0) | (place >= 1.0) & (slope < 0.0))
        sizes, ways = torch.linalg.eigh(curve * (free.unsqueeze(1) & free.unsqueeze(2)))
        sizes = sizes.abs().unsqueeze(-1)
        along = ways.mT @ (slope * free).unsqueeze(-1)
        steps = ways @ (along / (sizes + damping * sizes.amax(1, keepdim=True))).nan_to_num()
        tried = torch.cat([genes, (genes - steps.mT).clamp(0.0, 1.0)], 1)
        genes, found = _fittest(tried, evaluate(tried).sum(-1), 1)
        solved = (found >= least * (1.0 - SOLVED) - NEGLIGIBLE).squeeze(1)
        least = found
        if bool(solved.all()):
            break
    return lower + genes.squeeze(1) * span, solved


def _derivatives(values: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return slopes ``[problems, count]`` and curvatures of values at the shifts of polish."""
    values = torch.where(values.isfinite(), values, values[:, :1]).nan_to_num(posinf=0.0)
    more, less = values[:, 1:].chunk(2, 1)
    slope = (more - less)[:, :count] / (2.0 * SHIFTED)
    twice = (more + less - 2.0 * values[:, :1]) / SHIFTED**2
    single, both = twice[:, :count], twice[:, count:]
    row, column = torch.triu_indices(count, count, 1)
    curve = torch.diag_embed(single)
    curve[:, row, column] = 0.5 * (both - single[:, row] - single[:, column])
    curve[:, column, row] = curve[:, row, column]
    return slope, curve


def _evolve(
    evaluate: Fitness,
    problems: int,
    random: _Random,
    settings: GeneticSettings,
    progress: Progress | None,
) -> Tensor:
    """Evolve in the unit box, where all parameters have one scale of mutations."""
    genes = _latin_hypercube(random, settings.founders * settings.population)
    genes = genes.expand(problems, -1, -1).contiguous()
    genes, fitness = _fittest(genes, evaluate(genes), settings.population)
    for generation in range(1, settings.generations + 1):
        children = _children(genes, fitness, random, settings, generation)
        genes, fitness = _survivors(genes, fitness, children, evaluate(children), settings)
        if progress is not None:
            text = f"mean best {fitness[:, 0].mean().item():.5g}"
            progress(generation, settings.generations, text)
    return genes[:, 0]


class _Random:
    """Random numbers from a generator on the CPU, moved to the device of ``like``."""

    def __init__(self, generator: torch.Generator, like: Tensor) -> None:
        self.generator, self.like = generator, like

    def uniform(self, *shape: int) -> Tensor:
        return torch.rand(shape, generator=self.generator).to(self.like)

    def normal(self, *shape: int) -> Tensor:
        return torch.randn(shape, generator=self.generator).to(self.like)

    def index(self, high: int, *shape: int) -> Tensor:
        return torch.randint(high, shape, generator=self.generator).to(self.like.device)

    def permutation(self, count: int) -> Tensor:
        return torch.randperm(count, generator=self.generator).to(self.like.device)


def _latin_hypercube(random: _Random, count: int) -> Tensor:
    """Return ``count`` individuals, one in each of ``count`` equal parts of every range."""
    dims = random.like.numel()
    strata = torch.stack([random.permutation(count) for _ in range(dims)], dim=1)
    return (strata + random.uniform(count, dims)) / count


def _in_units(objective: Fitness, lower: Tensor, upper: Tensor) -> Fitness:
    """Return the objective as a function of genes in the unit box, without NaN."""
    span = upper - lower

    def evaluate(genes: Tensor) -> Tensor:
        value = objective(lower + genes * span)
        return torch.where(value.isfinite(), value, math.inf)

    return evaluate


def _children(
    genes: Tensor, fitness: Tensor, random: _Random, settings: GeneticSettings, generation: int
) -> Tensor:
    """Breed one child per individual: selection, crossover, mutation."""
    _, count, dims = genes.shape
    first = _tournament(genes, fitness, random, settings.tournament)
    second = _tournament(genes, fitness, random, settings.tournament)
    weight = random.uniform(count, dims) * (1.0 + 2.0 * settings.blend) - settings.blend
    child = first + weight * (second - first)
    # The spread of the population scales this step, which therefore decreases with it.
    shift = genes[:, random.permutation(count)] - genes[:, random.permutation(count)]
    chosen = random.uniform(count, 1) < settings.difference_rate
    child = child + torch.where(chosen, random.uniform(count, 1), 0.0) * shift
    chosen = random.uniform(count, dims) < settings.mutation_rate
    share = (generation - 1) / max(settings.generations - 1, 1)
    strength = settings.mutation_start ** (1.0 - share) * settings.mutation_end**share
    noise = random.normal(count, dims) * strength
    child = child + torch.where(chosen, noise, 0.0)
    # Clamped, not reflected: an optimum on a bound is reached exactly and can be flagged.
    return child.clamp_(0.0, 1.0)


def _tournament(genes: Tensor, fitness: Tensor, random: _Random, size: int) -> Tensor:
    """Return one parent per place, the fittest of ``size`` random individuals."""
    count = genes.shape[1]
    entrants = random.index(count, count, size)
    winner = fitness[:, entrants].argmin(-1, keepdim=True)
    parents = entrants.expand(genes.shape[0], -1, -1).gather(-1, winner)
    return genes.gather(1, parents.expand(-1, -1, genes.shape[-1]))


def _survivors(
    genes: Tensor, fitness: Tensor, children: Tensor, born: Tensor, settings: GeneticSettings
) -> tuple[Tensor, Tensor]:
    """Return the fittest of the parents' elite and the children, sorted."""
    count = genes.shape[1]
    elites = max(1, round(settings.elites * count))
    united = torch.cat([genes[:, :elites], children], 1)  # the parents are sorted
    return _fittest(united, torch.cat([fitness[:, :elites], born], 1), count)


def _fittest(genes: Tensor, fitness: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return the ``count`` fittest individuals of every problem, fittest first."""
    order = fitness.argsort(dim=1, stable=True)[:, :count]
    index = order.unsqueeze(-1).expand(-1, -1, genes.shape[-1])
    return genes.gather(1, index), fitness.gather(1, order)
