"""Functions of rows of numbers in machine code give what torch gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn.functional import softplus

from lcc_rl.envs.rowwise import Rowwise, translated

TABLE = torch.linspace(-1.0, 1.0, 12).reshape(4, 3)
LAYERS = torch.nn.Sequential(torch.nn.Linear(4, 6), torch.nn.ReLU(), torch.nn.Linear(6, 2))
LAYERS.requires_grad_(False)
PLACES = torch.tensor([3, 0, 2])

FUNCTIONS = {
    "arithmetic": lambda x, n: (x * 2.0 - x / (x.abs() + 1.0)).neg() + 3 - 1.0 / (x * x + 1.0),
    "functions": lambda x, n: x.abs().log() + x.exp() * x.sin() + x.tanh() - x.abs().rsqrt(),
    "smooth": lambda x, n: softplus(9.0 * x) + x.sigmoid() * x.abs().log1p(),
    "filled": lambda x, n: (
        (3.0 * x).round() + x.masked_fill(n > 1, 2.0).masked_fill(x > 0.5, TABLE[2, 2])
    ),
    "gathered": lambda x, n: x.gather(-1, n) + x[:, :3].gather(-1, n[:, :1].clamp(max=2)),
    "running": lambda x, n: x.cumsum(-1) + torch.bucketize(x, TABLE[0], right=True),
    "normal": lambda x, n: torch.cat([y := torch.special.ndtri(n * 0.2 + 0.1), y + 1e8 - 1e8], -1),
    "powers": lambda x, n: x**2 + x.abs() ** 1.7 + x.square().sqrt(),
    "clamp": lambda x, n: x.clamp(-0.5, 0.5) + x.clamp(min=0.0) + torch.minimum(x, x.flip(-1)),
    "choice": lambda x, n: torch.where((x > 0.0) & ~(n == 2), x, 0.1 * n),
    "lerp": lambda x, n: torch.lerp(x, n.float(), torch.tensor([0.1, 0.5, 0.9, 0.0])),
    "not": lambda x, n: ~n + (~(x > 0.0)).logical_not(),
    "bits": lambda x, n: ((n * 0x7EB352D ^ n >> 3) & 0xFFFF).float() * 2.0**-16,
    "moves": lambda x, n: torch.cat([x[..., 1:], x[..., :1]], -1).unflatten(-1, (2, 2)).flatten(1),
    "folds": lambda x, n: x.sum(-1, keepdim=True) * (x > 1.0).any(-1, keepdim=True),
    "tables": lambda x, n: TABLE[n].sum(-2) + TABLE[:, 1][n][..., :3] - x[..., PLACES],
    "search": lambda x, n: torch.searchsorted(TABLE[1], x[..., :3].contiguous()) + n[..., :3] * 0.5,
    "network": lambda x, n: LAYERS(x),
    "truth": lambda x, n: (x > 0.0) * x + (x <= 0.0).to(x.dtype) + (x > 0.0).double(),
}


def examples(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, 4, generator=generator)
    x[-1, 0] = torch.nan
    return x, torch.randint(4, (count, 4), generator=generator)


def test_a_translated_function_gives_what_torch_gives(subtests) -> None:
    def function(*given):
        return tuple(own(*given) for own in FUNCTIONS.values())

    rows, given = Rowwise(function, examples(1), "all"), examples(50)
    assert rows.translated
    each = zip(FUNCTIONS, rows(*(x.numpy() for x in given)), function(*given), strict=True)
    for name, found, wanted in each:
        with subtests.test(name=name):
            assert found.dtype == wanted.numpy().dtype
            np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)


def test_functions_that_differ_in_their_settings_are_one_kernel_that_is_kept() -> None:
    def made(gain: float, layers: nn.Module) -> Rowwise:
        def function(x: torch.Tensor, n: torch.Tensor) -> tuple[torch.Tensor]:
            noise = torch.special.ndtri((0.3 * x[..., :1]).sin().abs().double())
            return (gain * layers(x) + noise,)

        rows, given = Rowwise(function, examples(1), "a test"), examples(9)
        (found,), (wanted,) = rows(*(x.numpy() for x in given)), function(*given)
        np.testing.assert_allclose(found, wanted.detach(), rtol=1e-5, atol=1e-6)
        return rows

    wide = [nn.Sequential(nn.Linear(4, 90), nn.ReLU(), nn.Linear(90, 2)) for _ in range(2)]
    first, other = made(1.25, wide[0]), made(-0.7, wide[1])
    assert first.kernel is other.kernel  # the noise, whose function has an address, included
    stored = Path(first.kernel.chosen.stats.cache_path)
    assert any(stored.glob(f"*{first.kernel.chosen.py_func.__name__}*.nbc"))
    source, _ = translated(lambda x, n: (wide[0](x),), examples(1))
    assert source.count("\n") < 20  # a layer is one statement, not one for each unit


def test_what_has_no_translation_is_computed_by_tensors(subtests) -> None:
    for function in [
        lambda x, n: (x.sort(-1).values,),  # no such operation on numbers
        lambda x, n: (x if x.sum() > 0.0 else -x,),  # another graph for other numbers
        lambda x, n: (torch.div(x, 2.0, rounding_mode="floor"),),
        lambda x, n: (x.half(),),
        lambda x, n: (softplus(x, 2.0),),
        lambda x, n: (torch.rsub(x, 1.0, alpha=2.0),),
        lambda x, n: (x.clone().mul_(2.0),),  # changes what it is given
        lambda x, n: (torch.as_tensor(2.0 * x.numpy()),),  # leaves tensors
        lambda x, n: (torch.as_tensor(2.0 * np.asarray(x)),),
        lambda x, n: (torch.tensor(x.tolist()),),
        lambda x, n: (torch.addmm(x, x, torch.eye(4)),),  # no constant bias
    ]:
        with subtests.test(function=function):
            rows, given = Rowwise(function, examples(1), "a test"), examples(5)
            assert not rows.translated
            (found,), (wanted,) = rows(*(x.numpy() for x in given)), function(*given)
            np.testing.assert_array_equal(found, wanted)


def test_a_place_beyond_a_table_is_an_error() -> None:
    rows = Rowwise(lambda n: (TABLE[:, 0][n],), [torch.zeros(1, 1, dtype=torch.int64)], "a test")
    assert rows.translated
    with pytest.raises(IndexError):
        rows(np.array([[4]]))
    gathered = Rowwise(lambda x, n: (x.gather(-1, n),), examples(1), "a test")
    assert gathered.translated
    with pytest.raises(IndexError):
        gathered(np.ones((1, 4), np.float32), np.array([[0, 1, 4, 2]]))
