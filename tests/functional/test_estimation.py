"""The estimator of A15 on simulated followers with noise, and the population mean."""

import pytest
import torch

from lcc_rl.drivers.population import bootstrap
from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.functional.random import uniform

T = 0.1


def simulated(population, noise: float):
    """Every driver behind the same wavy leader: speeds and gaps, ``[time + 1, drivers, 1]``."""
    drivers = len(population.time_gap)
    time = torch.arange(301) * T
    wave = 6.0 + 2.5 * torch.sin(time / 3.0) + 1.0 * torch.sin(time / 0.9 + 1.0)
    leader = wave.view(-1, 1, 1).expand(-1, drivers, 1)
    v0, gap = population.desired_speed.unsqueeze(-1), population.time_gap.unsqueeze(-1)
    start = population.constants.equilibrium_gap(leader[0], v0, gap)
    seeds = torch.arange(drivers).unsqueeze(-1) + 17
    speed, gaps, executed = simulate_follower(
        leader,
        leader[0],
        start,
        v0,
        gap,
        population.constants,
        T,
        noise=lambda step: noise * uniform(seeds, step),
    )
    return leader, speed, gaps, executed


def test_prediction_after_15_s_beats_the_population_mean() -> None:
    population = bootstrap()
    leader, speed, gap, executed = simulated(population, noise=0.05)
    mean = PopulationMean(population.desired_speed, population.time_gap, population.constants)
    start = prior(population.desired_speed, population.time_gap)
    shape = speed[0].shape
    belief = Belief(start.estimate.expand(*shape[:-1], 2), start.covariance.expand(*shape[:-1], 3))
    fitted, average = [], []
    for step in range(300):
        rate = speed[step] - leader[step]
        predicted, belief = predict_and_update(
            speed[step], gap[step], rate, speed[step + 1], belief, population.constants, T, 0.05
        )
        if step >= 150:
            fitted.append((predicted - executed[step]).abs())
            average.append((mean(speed[step], gap[step], rate) - executed[step]).abs())
    error, by_mean = torch.stack(fitted), torch.stack(average)
    assert error.median() <= 0.05
    better = error.median(0).values < by_mean.median(0).values
    assert better.float().mean() >= 0.95


def test_recovers_the_driver_without_noise() -> None:
    population = bootstrap()
    leader, speed, gap, _ = simulated(population, noise=0.0)
    start = prior(population.desired_speed, population.time_gap)
    belief = Belief(
        start.estimate.expand(*speed[0].shape[:-1], 2),
        start.covariance.expand(*speed[0].shape[:-1], 3),
    )
    for step in range(300):
        _, belief = predict_and_update(
            speed[step],
            gap[step],
            speed[step] - leader[step],
            speed[step + 1],
            belief,
            population.constants,
            T,
            0.05,
        )
    error = (belief.estimate[:, 1] - population.time_gap).abs() / population.time_gap
    assert error.median() < 0.02


@pytest.mark.parametrize(("v", "s", "rate"), [(4.0, 12.0, 0.5), (2.0, 4.0, -3.0), (0.0, 3.0, 0.0)])
def test_population_mean_is_the_mean_over_drivers(v: float, s: float, rate: float) -> None:
    population = bootstrap()
    mean = PopulationMean(population.desired_speed, population.time_gap, population.constants)
    state = [torch.tensor([x]) for x in (v, s, rate)]
    each = population.constants(*state, population.desired_speed, population.time_gap)
    torch.testing.assert_close(mean(*state), each.mean().unsqueeze(0), rtol=1e-4, atol=1e-4)
