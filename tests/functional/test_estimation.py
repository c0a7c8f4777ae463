"""The estimator of A15 on simulated followers with noise, and the population mean."""

import torch

from lcc_rl.drivers.population import bootstrap
from lcc_rl.functional.driver_models import simulate_follower
from lcc_rl.functional.estimation import Belief, PopulationMean, predict_and_update, prior
from lcc_rl.functional.idm import IDMConstants
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


def learned(population, leader, speed, gap):
    """Yield the state, the prediction of it and what is then believed, step by step."""
    start, drivers = prior(population.desired_speed, population.time_gap), speed.shape[1]
    belief = Belief(start.estimate.expand(drivers, 2), start.covariance.expand(drivers, 3))
    for step in range(300):
        state = speed[step], gap[step], speed[step] - leader[step]
        predicted, belief = predict_and_update(
            *state, speed[step + 1], belief, population.constants, T, 0.05
        )
        yield state, predicted, belief


def test_prediction_after_15_s_beats_the_population_mean() -> None:
    population = bootstrap()
    *motion, executed = simulated(population, noise=0.05)
    mean = PopulationMean(population.desired_speed, population.time_gap, population.constants)
    fitted, average = [], []
    for step, (state, predicted, _) in enumerate(learned(population, *motion)):
        if step >= 150:
            fitted.append((predicted - executed[step]).abs())
            average.append((mean(*state) - executed[step]).abs())
    error, by_mean = torch.stack(fitted), torch.stack(average)
    assert error.median() <= 0.05
    better = error.median(0).values < by_mean.median(0).values
    assert better.float().mean() >= 0.95


def test_recovers_the_driver_without_noise() -> None:
    population = bootstrap()
    *motion, _ = simulated(population, noise=0.0)
    *_, (_, _, belief) = learned(population, *motion)
    error = (belief.estimate[:, 1] - population.time_gap).abs() / population.time_gap
    assert error.median() < 0.02


def test_an_update_is_the_best_linear_one_whatever_the_curvature() -> None:
    mean, error = torch.tensor([0.4, 1.6]), 0.3
    spread = torch.tensor([[0.0100, 0.0120], [0.0120, 0.0900]])
    root = torch.linalg.cholesky(spread).T.double()
    draw = mean + torch.randn(1_000_000, 2, dtype=torch.float64) @ root
    v, gap, rate, constants = 9.0, 15.0, 0.5, IDMConstants()
    wanted = 2.0 + v * (draw[:, 1] + rate / 1.5**0.5 / 2.0)
    seen = 1.0 - draw[:, 0] * (v / 15.0) ** 4 - (wanted / gap) ** 2
    seen += error * torch.randn(len(seen), dtype=torch.float64)
    joint = torch.cov(torch.cat([draw, seen.unsqueeze(1)], 1).T)
    gain = joint[:2, 2] / joint[2, 2]
    state = (torch.tensor([x]) for x in (v, gap, rate, v - 0.2 * T))  # brakes by 0.2 m/s²
    before = Belief(mean, torch.tensor([spread[0, 0], spread[0, 1], spread[1, 1]]))
    _, after = predict_and_update(*state, before, constants, T, error)
    best = draw.mean(0) + gain * (-0.2 - seen.mean())
    torch.testing.assert_close(after.estimate.double(), best, rtol=0.0, atol=2e-3)
    left = (joint[:2, :2] - torch.outer(gain, joint[2, :2]))[[0, 0, 1], [0, 1, 1]]
    torch.testing.assert_close(after.covariance.double(), left, rtol=0.0, atol=2e-4)


def test_population_mean_is_the_mean_over_drivers() -> None:
    population = bootstrap()
    drivers = population.desired_speed, population.time_gap
    states = torch.tensor([[4.0, 12.0, 0.5], [2.0, 4.0, -3.0], [0.0, 3.0, 0.0]]).T  # v, s, rate
    found = PopulationMean(*drivers, population.constants)(*states)
    each = population.constants(*states.unsqueeze(-1), *drivers)
    torch.testing.assert_close(found, each.mean(-1), rtol=1e-4, atol=1e-4)
