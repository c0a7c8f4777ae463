"""Maps of policies: braking where it is near and closing, accelerating where it is far."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
import torch
from commands import tiny
from helpers import POPULATION
from matplotlib.colors import to_rgb
from omegaconf import OmegaConf
from PIL import Image

from lcc_rl.commands import evaluation
from lcc_rl.commands.maps import write_responses
from lcc_rl.config import load
from lcc_rl.evaluation.responses import responses
from lcc_rl.evaluation.strategies import baseline, trained
from lcc_rl.figures.drawing import save
from lcc_rl.figures.platoon import PARENTS
from lcc_rl.figures.policy_maps import accelerations, winners, write_maps
from lcc_rl.functional.rules import idm_acc
from lcc_rl.io.files import read_parquet
from lcc_rl.results.policies import load_policy
from lcc_rl.schemas import FORMATS

GAPS, RELATIVE = [1.0, 8.0, 60.0], [-4.0, 0.0, 4.0]
CASES = {
    "idm tuned": ["variant=alcc"],
    "acc tuned": ["variant=alcc", "scenario.string=human*2 automated human"],
    "pretrained/alcc": ["variant=alcc"],
    "pretrained/alcc_limits": ["variant=alcc"],
    "pretrained/ring-22": ["variant=alcc", "task=ring-22", "scenario.horizon=20"],
    "idm": ["variant=alcc", "scenario.string={size: 6, penetration: 0.4}"],
    "cacc tuned": ["variant=hcfs"],
}


def rows_of(name: str, words: list[str], speeds: list[float]) -> pd.DataFrame:
    cfg = load("evaluate", words)
    if not name.startswith("pretrained"):
        return responses(baseline(cfg, name), POPULATION, speeds, GAPS, RELATIVE)
    strategy = trained(cfg, name, load_policy(name), POPULATION)
    return responses(strategy, POPULATION, speeds, GAPS, RELATIVE)


@pytest.mark.parametrize("name", CASES)
def test_signs_are_right_at_the_corners(name) -> None:
    rows = rows_of(name, CASES[name], [8.0, 3.0])
    # At 3 m/s nobody ahead can be 4 m/s slower.
    assert len(rows) == 9 + 6
    found = rows.set_index(["speed_mps", "gap_m", "relative_speed_mps"])["acceleration_mps2"]
    assert found[8.0, 1.0, -4.0] < -1.0
    assert found[8.0, 60.0, 4.0] > 0.3
    assert found[3.0, 60.0, 4.0] > 0.3
    assert found[8.0, 1.0, -4.0] <= found[8.0, 8.0, 0.0] <= found[8.0, 60.0, 4.0]


def test_a_rule_does_what_its_law_says() -> None:
    rows = rows_of("idm tuned", ["variant=alcc"], [8.0])
    node = load("evaluate", ["variant=alcc", "controller@scenario.controllers.automated=idm_acc"])
    own = node.scenario.controllers.automated
    names = ("desired_speed", "time_gap", "acceleration", "deceleration", "min_gap")
    constants = [torch.tensor(float(own[name])) for name in names]
    gap, relative = (torch.tensor(rows[x].to_numpy()) for x in ("gap_m", "relative_speed_mps"))
    law = idm_acc(torch.full_like(gap, 8.0), gap, relative, *constants).clamp(-3.0, 3.0)
    assert rows["acceleration_mps2"].to_numpy() == pytest.approx(law.numpy(), abs=1e-3)


def grid() -> pd.DataFrame:
    """Two strategies that brake below 10 m, one with a winner."""
    parts = []
    for name in ("alcc", "idm tuned"):
        for speed in (2.0, 6.0):
            gap, relative = np.meshgrid(np.linspace(1, 20, 15), np.linspace(-3, 3, 15))
            table = {"strategy": name, "speed_mps": speed, "gap_m": gap.ravel()}
            table |= {"relative_speed_mps": relative.ravel()}
            table |= {"acceleration_mps2": (0.2 * (gap - 10.0) + 0.1 * relative).ravel()}
            table |= {"winner": (gap > 12).ravel() * 1.0 if name == "alcc" else np.nan}
            parts.append(pd.DataFrame(table))
    return pd.concat(parts, ignore_index=True)


def pixels(figure, path) -> np.ndarray:
    with Image.open(save(figure, path, dpi=80)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_the_image_brakes_in_red_below_and_accelerates_in_blue_above(tmp_path) -> None:
    steps = pd.DataFrame({"strategy": [], "training_seed": [], "profile": [], "driver_id": []})
    figure = accelerations(grid(), steps, OmegaConf.create({"scenario": {}}))
    titles = [axis.get_title(loc="right") for axis in figure.axes[:4]]
    assert titles == ["alcc at 2 m/s", "alcc at 6 m/s", "idm tuned at 2 m/s", "idm tuned at 6 m/s"]
    image = pixels(figure, tmp_path / "map.png")
    for axis in figure.axes[:4]:
        box = axis.get_window_extent()
        scale = 80 / figure.dpi
        left, right = (int(scale * x) + 4 for x in (box.x0, box.x1 - 10))
        high, low = (image.shape[0] - int(scale * y) for y in (box.y1 - 10, box.y0 + 10))
        above, below = image[high, left:right].mean(0), image[low - 8, left:right].mean(0)
        assert above[2] > above[0] + 40  # blue
        assert below[0] > below[2] + 40  # red
    limits = {mesh.get_clim() for axis in figure.axes[:4] for mesh in axis.collections[:1]}
    assert len(limits) == 1
    ((low, high),) = limits
    assert low == -high


def test_who_drives_is_shown_in_both_colours(tmp_path) -> None:
    image = pixels(winners(grid()), tmp_path / "winners.png").reshape(-1, 3)
    for colour in PARENTS.values():
        assert (np.abs(image - 255 * np.array(to_rgb(colour))).max(-1) < 3).sum() > 1000


LEARNED = ("variant=alcc", "policy=pretrained", "evaluation.baselines=[idm]")


def test_an_evaluation_maps_what_it_learned(tmp_path) -> None:
    cfg = tiny("evaluate", *LEARNED, "figure_formats=[png,svg]", agent=False)
    evaluation.run(cfg, tmp_path, quiet=True)
    rows = read_parquet(tmp_path / "responses.parquet")
    assert list(dict.fromkeys(rows["strategy"])) == ["alcc", "idm tuned"]
    assert rows["gap_m"].min() == 0.5
    assert [path.name for path in write_maps(tmp_path)] == ["policy_map.png"]
    assert "<svg" in (tmp_path / "figures" / "policy_map.svg").read_text()[:400]


@pytest.mark.slow
def test_every_figure_comes_in_every_format(tmp_path) -> None:
    cfg = tiny("evaluate", *LEARNED, "figure_formats=[png,svg,pdf]", agent=False)
    evaluation.run(cfg, tmp_path)
    drawn = [path.name.rpartition(".") for path in (tmp_path / "figures").iterdir()]
    stems = {kind: {stem for stem, _, own in drawn if own == kind} for kind in FORMATS}
    assert {"policy_map", "overview", "improvement_alcc_vs_idm"} <= stems["png"]
    assert stems["png"] == stems["svg"] == stems["pdf"]


def test_where_nothing_is_learned_there_is_no_map(tmp_path) -> None:
    (tmp_path / "responses.parquet").write_bytes(b"of another evaluation")
    cfg = load("evaluate", ["variant=idm"])
    write_responses([baseline(cfg, "idm")], cfg, POPULATION, tmp_path, {})
    assert not (tmp_path / "responses.parquet").exists()
    assert write_maps(tmp_path) == []
