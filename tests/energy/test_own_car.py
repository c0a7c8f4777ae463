"""The car of docs/your_car.md: coast-down coefficients and an efficiency map."""

from __future__ import annotations

import runpy

import numpy as np
import pytest
import torch
import yaml
from page_blocks import ROOT, blocks
from scipy.interpolate import RegularGridInterpolator

from lcc_rl.pieces.base import Piece
from lcc_rl.results.task import in_unit


def test_the_car_of_the_page_draws_what_its_map_says(tmp_path) -> None:
    (block,) = (b for b in blocks(ROOT / "docs" / "your_car.md") if "class MyCar" in b.text)
    (tmp_path / "page_car.py").write_text(block.text)
    space = runpy.run_path(str(tmp_path / "page_car.py"), run_name="page_car")
    assert issubclass(space["Follow"], Piece)
    car, chance = space["MyCar"](), np.random.default_rng(0)
    speed, acceleration = 40.0 * chance.random(200), 3.0 * chance.normal(size=200)
    force = 110.0 + 1.2 * speed + 0.42 * speed**2 + 1650.0 * 1.04 * acceleration
    grid = [0.0, 15.0, 30.0], [0.0, 2000.0, 4000.0]
    table = RegularGridInterpolator(grid, space["MAP"].numpy())
    share = table(np.stack([speed.clip(max=30.0), abs(force).clip(max=4000.0)], -1))
    expected = np.where(force > 0.0, force * speed / share, force * speed * share) + 400.0
    given = (torch.tensor(x, dtype=torch.float64).requires_grad_() for x in (speed, acceleration))
    found = car.power(*given)
    np.testing.assert_allclose(found.detach().numpy(), expected, rtol=1e-5)
    assert found.requires_grad
    assert in_unit(720.0, "kWh/100km", car) == pytest.approx(20.0)


def test_the_search_of_the_page_keeps_flow_and_damps_waves(tmp_path, monkeypatch) -> None:
    """The gains of the page, and those that short windows or no penalty on waves would choose."""
    trial = pytest.importorskip("optuna").trial.FixedTrial
    page = blocks(ROOT / "docs" / "your_car.md")
    (tmp_path / "my_car.py").write_text(next(b.text for b in page if "class MyCar" in b.text))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    space = runpy.run_path(str(ROOT / "docs" / "recipes" / "my_gains.py"))
    tuned = yaml.safe_load(next(b.text for b in page if b.before == "`tuned.yaml`:"))
    assert tuned.pop("_target_") == "my_car.Follow"
    start = {"time_gap": 1.4, "gain": 0.2, "damping": 0.8}
    short = {**start, "time_gap": 1.183, "gain": 0.02}
    assert space["growth"](tuned) < 0.96 < 1.02 < space["growth"]({**short, "time_gap": 0.845})
    assert space["cost"](trial(tuned)) < 0.8 * space["cost"](trial(start))  # of less flow
    assert space["cost"](trial(short)) == np.inf  # what windows of 6 s do not show
