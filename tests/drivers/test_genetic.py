"""The genetic algorithm on functions whose minimum is known."""

import pytest
import torch

from lcc_rl.drivers.genetic import GeneticSettings, minimise, polish

SETTINGS = GeneticSettings(population=40, generations=80)


def solve(objective, problems, low=-5.0, high=5.0, dims=2, seed=0, settings=SETTINGS, **more):
    lower = torch.full((dims,), low, dtype=torch.float64)
    upper = torch.full((dims,), high, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    return minimise(objective, lower, upper, problems, generator, settings, **more)


def spheres(centres):
    return lambda x: (x - centres.unsqueeze(1)).square().sum(-1)


def rosenbrock(x):
    first, second = x[..., 0], x[..., 1]
    return (1.0 - first).square() + 100.0 * (second - first.square()).square()


def test_spheres_with_a_centre_each_are_all_solved():
    centres = torch.linspace(-4.0, 4.0, 30, dtype=torch.float64).reshape(6, 5)
    found = solve(spheres(centres), 6, dims=5)
    torch.testing.assert_close(found, centres, atol=1e-2, rtol=0.0)


@pytest.mark.parametrize("seed", range(2))
def test_rosenbrock_valley_is_followed_to_its_end(seed):
    found = solve(rosenbrock, 1, seed=seed)
    torch.testing.assert_close(found[0], torch.ones(2).double(), atol=0.02, rtol=0.0)
    longer = solve(rosenbrock, 1, seed=seed, settings=GeneticSettings(generations=1000))
    assert rosenbrock(longer) < 1e-9


def test_optimum_on_a_bound_is_reached_exactly():
    found = solve(lambda x: -x[..., 0] + x[..., 1], 1)
    assert found[0].tolist() == [5.0, -5.0]


def test_a_problem_does_not_depend_on_its_neighbours():
    centres = torch.tensor([[1.0, 2.0], [-3.0, 0.5], [4.0, -4.0]], dtype=torch.float64)
    together = solve(spheres(centres), 3)
    for one in range(3):
        assert torch.equal(together[one], solve(spheres(centres[one : one + 1]), 1)[0])


def test_polished_solutions_are_minima_within_the_bounds():
    def terms(x):  # two roots of squares, in a narrow valley; the second minimum is on a bound
        valley = 30.0 * (x[..., 1] - x[..., 0] ** 2), x[..., 0] - torch.tensor([[0.5], [3.0]])
        return torch.stack([(valley[0].square() + valley[1].square()).sqrt(), valley[1].abs()], -1)

    ends = torch.tensor([-1.0, -1.0]).double(), torch.tensor([2.0, 4.0]).double()
    start = torch.tensor([[-0.5, 3.0], [0.0, 0.0]]).double()
    best, solved = polish(terms, start, *ends)
    assert solved.all()
    assert torch.allclose(best, torch.tensor([[0.5, 0.25], [2.0, 4.0]]).double(), atol=1e-4)


def test_equal_seeds_give_equal_results_and_others_do_not():
    first, again, other = (solve(rosenbrock, 2, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
