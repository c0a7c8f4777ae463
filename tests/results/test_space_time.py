"""Space–time diagrams show every vehicle where it is, in the colour of its speed."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest
from omegaconf import OmegaConf

from lcc_rl.figures.drawing import save
from lcc_rl.figures.space_time import space_time

TIME = 0.1 * np.arange(1, 101)


def config(string="automated human*2", road="open"):
    scenario = {"string": string, "road": road, "circumference": 60.0, "vehicle_length": 5.0}
    return OmegaConf.create({"scenario": scenario})


def steps(name: str, stops: float) -> pd.DataFrame:
    table = {"strategy": name, "training_seed": pd.NA, "profile": "p", "driver_id": 0}
    table |= {"time_s": TIME, "leader_speed": 10.0}
    for vehicle, kind in enumerate(("cav", "hdv1", "hdv2")):
        slow = (3.0 + vehicle < TIME) & (6.0 + vehicle > TIME)
        speed = np.where(slow, 10.0 - stops, 10.0)
        table |= {f"{kind}_speed": speed, f"{kind}_gap": 10.0 + vehicle}
    return pd.DataFrame(table)


ROWS = pd.concat([steps("human", 9.0), steps("alcc", 0.5)])


def test_lines_stand_behind_the_leader_by_gaps_and_lengths() -> None:
    figure = space_time(ROWS, ["human", "alcc"], config())
    assert figure is not None
    first, last = (axis.collections[-1] for axis in figure.axes[:2])
    start = last.get_segments()[0][0]
    assert start == pytest.approx([0.1, -(10.0 + 11.0 + 12.0 + 3 * 5.0)])
    assert first.get_array().min() == pytest.approx(1.0)
    assert last.get_array().min() == pytest.approx(9.5)
    assert first.get_clim() == last.get_clim() == (0.0, 10.0)


def test_a_ring_closes_and_no_line_crosses_it() -> None:
    figure = space_time(ROWS, ["human"], config(road="ring"))
    assert figure is not None
    for lines in figure.axes[0].collections:
        segments = np.array(lines.get_segments())
        assert segments[..., 1].min() >= 0.0
        assert segments[..., 1].max() <= 60.0
        assert np.abs(np.diff(segments[..., 1], axis=1)).max() < 30.0


def test_the_image_has_the_colours_of_many_speeds(tmp_path) -> None:
    from PIL import Image

    figure = space_time(ROWS, ["human", "alcc"], config())
    assert figure is not None
    with Image.open(save(figure, tmp_path / "x.png", dpi=60)) as image:
        pixels = np.asarray(image.convert("RGB"))[:, : int(0.75 * image.width)].reshape(-1, 3)
    reddish = (pixels[:, 0] > 150) & (pixels[:, 1] < 80)
    blueish = (pixels[:, 2] > 120) & (pixels[:, 0] < 60)
    assert reddish.sum() > 20
    assert blueish.sum() > 100
    assert len(np.unique(pixels, axis=0)) > 200


def test_places_drawn_in_the_episode_are_where_the_rows_say() -> None:
    drawn = config({"size": 3, "penetration": 0.3})
    assert space_time(ROWS, ["human"], drawn) is None  # the rows do not say
    figure = space_time(ROWS.assign(cav_place=2), ["human"], drawn)
    assert figure is not None
    framed = [lines.get_array() is None for lines in figure.axes[0].collections]
    assert framed == [False, False, True, False]


def test_short_strings_have_none() -> None:
    short = ROWS.drop(columns=[name for name in ROWS if name.startswith("hdv2")])
    assert space_time(short, ["human"], config("automated human")) is None
