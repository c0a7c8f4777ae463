"""Counter-based random numbers: distribution, independence, and what makes them useful."""

import torch
from scipy import stats

from lcc_rl.functional.random import choose, normal, uniform

SEEDS = torch.arange(200_000) * 7919 % 2**31


def test_uniform_along_seeds_steps_and_streams() -> None:
    for draws in (
        uniform(SEEDS, 3),
        uniform(torch.tensor(12345), torch.arange(200_000)),
        uniform(torch.tensor(12345), 7, torch.arange(200_000)),
    ):
        assert 0.0 <= draws.min() < 1e-3
        assert 1 - 1e-3 < draws.max() < 1.0
        assert stats.kstest(draws.numpy(), "uniform").pvalue > 1e-3
        neighbours = torch.corrcoef(torch.stack([draws[:-1], draws[1:]]))[0, 1]
        assert abs(neighbours) < 0.01


def test_draw_is_a_function_of_its_counter() -> None:
    order = torch.randperm(len(SEEDS), generator=torch.Generator().manual_seed(0))
    assert torch.equal(uniform(SEEDS, 5)[order], uniform(SEEDS[order], 5))


def test_normal_draws_are_finite_at_both_ends(monkeypatch) -> None:
    ends = torch.tensor([0.0, 1.0 - 2.0**-24])  # all 24 bits clear, all set
    monkeypatch.setattr("lcc_rl.functional.random.uniform", lambda *_: ends)
    drawn = normal(torch.zeros(2, dtype=torch.int64), 0)
    assert drawn.isfinite().all()
    assert drawn.abs().min() > 5.0


def test_an_index_is_drawn_of_any_stream() -> None:
    seeds = torch.arange(4)
    for stream in (0, 2**32 - 1):  # times its factor the latter leaves 64 bits
        assert torch.equal(choose(seeds, 5, stream), choose(seeds, 5, torch.tensor(stream)))
