"""Where vehicles are follows from stored speeds and gaps; animations hold their motion."""

from __future__ import annotations

import json
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib.colors import to_rgb
from PIL import Image, ImageSequence

from lcc_rl.commands import animate as command
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.figures.animation import LARGEST_PAGE, ROLE_COLOURS, animate, frames, page
from lcc_rl.figures.platoon import platoon_figures
from lcc_rl.io.files import write_parquet
from lcc_rl.results.motion import SampleMotion, motion_of, sample_episodes

OPEN = {"string": "automated human", "road": "open", "circumference": None, "vehicle_length": 5.0}
RING = {**OPEN, "road": "ring", "circumference": 40.0}
TIME = 0.5 * np.arange(1, 5)
SVG = "{http://www.w3.org/2000/svg}"


def rows(**more) -> pd.DataFrame:
    table = {"strategy": "alcc", "training_seed": pd.NA, "profile": "p", "driver_id": 0}
    table |= {"time_s": TIME, "leader_speed": 10.0}
    table |= {"cav_speed": 8.0, "cav_gap": 7.0, "hdv_speed": 6.0, "hdv_gap": 9.0}
    return pd.DataFrame({**table, **more})


def test_vehicles_stand_behind_the_leader_by_gaps_and_lengths() -> None:
    motion = motion_of(rows(), OPEN)
    assert motion.roles == ("automated", "human")
    assert motion.front.tolist() == [0.0, 5.0, 10.0, 15.0]
    assert motion.position[0].tolist() == [-12.0, -26.0]
    assert motion.ahead[0].tolist() == [10.0, 8.0]
    assert motion_of(rows(cav_speed=np.nan, cav_gap=np.nan), OPEN).roles == ("human",)


def test_on_a_ring_the_first_follows_the_last() -> None:
    # 40 m hold both vehicles and both gaps.
    motion = motion_of(rows(leader_speed=np.nan, hdv_gap=23.0), RING)
    assert motion.leader is None
    assert motion.position[:, 0].tolist() == [0.0, 4.0, 8.0, 12.0]
    assert motion.position[:, 0] + 12.0 - motion.position[:, 1] == pytest.approx(40.0)
    assert motion.ahead[0].tolist() == [6.0, 8.0]


def test_a_platoon_has_a_row_per_vehicle() -> None:
    table = {"strategy": "hcfs", "case": "case 1", "time_s": np.repeat(TIME, 3)}
    table |= {"follower": np.tile([0, 1, 2], 4), "speed_mps": np.tile([4.0, 3.0, 2.0], 4)}
    table |= {"gap_m": np.tile([np.nan, 5.0, 6.0], 4)}
    found = sample_episodes(pd.DataFrame(table), "hcfs")["case 1"]
    steps = pd.concat([pd.DataFrame(table).assign(training_seed=s, speed_mps=s) for s in (1, 0)])
    assert set(sample_episodes(steps, "hcfs")["case 1"]["speed_mps"]) == {0}  # no mean of both
    for _, figure in platoon_figures(steps.assign(jerk_mps3=0.0), 30.0):
        assert all(np.diff(x.get_xdata()).min() > 0 for x in figure.axes[0].lines if x.get_label())
    motion = motion_of(found, {**OPEN, "string": "automated*6"})
    assert motion.roles == ("automated", "automated")
    assert motion.position[0].tolist() == [-10.0, -21.0]
    assert motion.ahead[0].tolist() == [4.0, 3.0]


def test_drawn_places_are_read_and_sample_episodes_are_of_one_seed() -> None:
    drawn = {**OPEN, "string": {"size": 2, "penetration": 0.5}}
    assert motion_of(rows(cav_place=1), drawn).roles == ("human", "automated")
    both = pd.concat([rows(training_seed=seed, profile=name) for seed in (3, 1) for name in "ab"])
    found = sample_episodes(both, "alcc")
    assert list(found) == ["profile a, driver 0", "profile b, driver 0"]
    assert all((part["training_seed"] == 1).all() for part in found.values())
    for wrong, words in (
        (lambda: motion_of(rows(), drawn), "places"),
        (lambda: motion_of(rows(), {**OPEN, "string": "automated*3 human"}), "lacks vehicles"),
        (lambda: sample_episodes(both, "idm"), "no sample episode of idm"),
    ):
        with pytest.raises(ResultsError, match=words):
            wrong()


def drifting(vehicles: int = 2, ring: bool = False, seconds: float = 1.2) -> SampleMotion:
    """Vehicles that drift apart, so that every moment looks different."""
    time = 0.1 * np.arange(1, round(10 * seconds) + 1)
    gap = 5.0 + np.outer(time, np.arange(1, vehicles + 1))
    speed = 3.0 + np.arange(vehicles) + np.sin(time)[:, None]
    roles = ("automated", *["human"] * (vehicles - 1))
    around = 500.0 if ring else None
    return SampleMotion(
        time, roles, speed, gap, 20.0 * time, None if ring else 2 * time, 5.0, around
    )


def test_vehicles_of_a_class_have_its_length() -> None:
    steps = pd.DataFrame({"time_s": [0.1, 0.2], "leader_speed": 10.0})
    for name, length in (("cav", 5.0), ("hdv", 20.0)):
        steps = steps.assign(**{f"{name}_{x}": 10.0 for x in ("speed", "gap")})
        steps[f"{name}_length"] = length
    for road, lengths in (("open", [5.0, 5.0, 20.0]), ("ring", [20.0, 5.0, 20.0])):
        scenario = {**OPEN, "road": road, "circumference": 45.0}
        moved = motion_of(steps, scenario)
        assert moved.lengths.tolist() == lengths
        apart = moved.position[0, 0] - moved.position[0, 1]
        assert apart == pytest.approx(15.0)  # a gap of 10 m and the car ahead
        assert data_of(page(moved, "trucks"))["length"] == lengths
        before = moved.front[0] - moved.position[0, 0]
        assert before == pytest.approx(10.0 + lengths[0])


def data_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None
    return json.loads(found[1])


def test_a_page_holds_the_motion_of_all_vehicles_and_needs_nothing_else(subtests) -> None:
    for ring in [False, True]:
        with subtests.test(ring=ring):
            shown = drifting(3, ring)
            text = page(shown, "a </script> title")
            found = data_of(text)
            assert found["title"] == "a </script> title"
            assert found["roles"] == ["automated", "human", "human"]
            for name in ("speed", "gap"):
                assert pytest.approx(getattr(shown, name), abs=0.005) == np.array(found[name]).T
            assert (found["leader"] is None) == (found["circumference"] is not None) == ring
            assert not re.search(r"(src|href)=|https?:|@import", text)
            long = data_of(page(drifting(100, seconds=600.0), "a fleet"))
            assert len(long["time"]) * 100 <= LARGEST_PAGE


@pytest.mark.parametrize("ring", [False, True])
def test_the_frames_of_a_gif_differ_and_show_each_role(ring, tmp_path) -> None:
    with Image.open(animate({"drifting": drifting(2, ring)}, tmp_path / "x.gif")) as image:
        assert image.n_frames == 11
        shown = []
        for frame in (0, 10):
            image.seek(frame)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
    road = slice(0, shown[0].shape[0] // 4)
    assert np.abs(shown[0][road] - shown[1][road]).sum() > 1000
    for role in ("automated", "human", *([] if ring else ["leader"])):
        near = np.abs(shown[0] - 255 * np.array(to_rgb(ROLE_COLOURS[role]))).max(-1) < 24
        assert near.sum() > 30, role


def test_every_colour_and_axis_of_a_film_is_named() -> None:
    for ring in (True, False):
        *_, figure = frames(drifting(9, ring), "title")
        _, speeds, gaps = figure.axes
        names = [text.get_text() for text in speeds.get_legend().get_texts()]
        assert names == ["leader", "controlled car", "human driver"][ring:]
    assert [axis.get_ylabel() for axis in (speeds, gaps)] == ["speed [m/s]", "gap ahead [m]"]
    assert gaps.get_xlabel() == "time [s]"
    assert all(line.get_alpha() == 1.0 for line in speeds.get_legend().get_lines())


def test_an_svg_turns_each_car_by_its_way_and_shows_rings_side_by_side(tmp_path) -> None:
    moved = drifting(3, ring=True, seconds=7.0)
    path = animate({"a < b": moved, "c": moved}, tmp_path / "ring.svg")
    root = ElementTree.parse(path).getroot()
    turns = [x.get("values") for x in root.iter(f"{SVG}animateTransform")]
    assert len(turns) == 6
    shown = np.linspace(0, len(moved.time) - 1, 6).round().astype(int)  # to the end, near 1.5 s
    middle = moved.position[shown] - 0.5 * moved.length
    found = np.array([text.split(";") for text in turns[:3]], float).T
    assert found == pytest.approx(-360.0 / 500.0 * middle, abs=0.051)
    assert len(list(root.iter(f"{SVG}circle"))) == 2 + 2  # two roads, two marks
    two = {"a": moved, "b": moved}
    for wrong, ending in (({"a": moved, "b": drifting()}, "svg"), (two, "gif"), (two, "html")):
        with pytest.raises(ConfigError, match=ending):
            animate(wrong, tmp_path / f"x.{ending}")


def test_diagrams_of_open_roads_unroll_side_by_side(tmp_path) -> None:
    both = {"a < b": drifting(3, seconds=6.0), "c": drifting(4, seconds=6.0)}
    root = ElementTree.parse(animate(both, tmp_path / "waves.svg")).getroot()
    covers = [[x.get("values").split(";") for x in rect] for rect in root.iter(f"{SVG}rect")]
    assert len(covers) == 2
    for (left, right, _), (wide, *nothing) in covers:
        assert float(wide) == pytest.approx(float(right) - float(left), abs=0.11)
        assert nothing == ["0", "0"]
    with Image.open(animate(both, tmp_path / "waves.gif")) as image:
        inks = [np.asarray(frame.convert("L")) < 128 for frame in ImageSequence.Iterator(image)]
    drawn = [
        [int(ink[:, part].sum()) for ink in inks]
        for part in np.array_split(range(inks[0].shape[1]), 2)
    ]
    assert all(counts == sorted(counts) and counts[-1] > counts[0] for counts in drawn)


@pytest.fixture
def run_folder(tmp_path):
    """An evaluation's folder with two strategies, two sample episodes each."""
    found = [
        rows(strategy=name, driver_id=driver, cav_speed=8.0 + driver)
        for name in ("idm", "alcc")
        for driver in (0, 1)
    ]
    write_parquet(pd.concat(found), tmp_path / "run" / "steps.parquet")
    (tmp_path / "run" / "config.yaml").write_text(yaml.safe_dump({"scenario": OPEN}))
    return tmp_path / "run"


def test_the_command_animates_what_is_named(run_folder, capsys) -> None:
    assert command.main([str(run_folder)]) == 0
    name = capsys.readouterr().out.splitlines()[-1]
    assert name == str(run_folder / "figures" / "animation_alcc_0.html")
    assert "network: profile p, driver 0" in Path(name).read_text()
    out = run_folder.parent / "there.html"
    words = ["--strategy=one IDM driver", "--episode=1", "--start=1", "--duration=0.5"]
    assert command.main([str(run_folder), *words, "--out", str(out)]) == 0
    found = data_of(out.read_text())
    assert (found["title"], found["time"]) == ("one IDM driver: profile p, driver 1", [1.0, 1.5])
    assert found["speed"][0] == [9.0] * 2
    twice = [str(run_folder), "--strategy=alcc: A", "--strategy=one IDM driver: A", "--out=x.svg"]
    with pytest.raises(ConfigError, match="one IDM driver: a second 'A'"):
        command.main(twice)
    job = run_folder.parent / "job"
    job.mkdir()
    run_folder.rename(job / "evaluation")
    assert command.run(job).parent == job / "evaluation" / "figures"
