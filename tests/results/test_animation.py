"""Animations hold every vehicle's motion, in frames that differ."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib.animation import FFMpegWriter
from matplotlib.colors import to_rgb
from PIL import Image

from lcc_rl.commands import animate as command
from lcc_rl.console import COMMANDS
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.figures.animation import COLOURS, LARGEST, animate, frames, page
from lcc_rl.io.files import write_parquet
from lcc_rl.results import animation
from lcc_rl.results.motion import Motion

TIME = 0.1 * np.arange(1, 13)
SCENARIO = {
    "string": "automated human",
    "road": "open",
    "circumference": None,
    "vehicle_length": 5.0,
}


def motion(vehicles: int = 2, ring: bool = False, time: np.ndarray = TIME) -> Motion:
    """Vehicles that drift apart, so that every moment looks different."""
    gap = 5.0 + np.outer(time, np.arange(1, vehicles + 1))
    speed = 3.0 + np.arange(vehicles) + np.sin(time)[:, None]
    roles = ("automated", *["human"] * (vehicles - 1))
    around = 500.0 if ring else None
    return Motion(time, roles, speed, gap, 20.0 * time, None if ring else 2 * time, 5.0, around)


def data_of(text: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found is not None
    return json.loads(found[1])


@pytest.fixture
def run_folder(tmp_path):
    """An evaluation's folder with two strategies, two sample episodes each."""
    parts = []
    for name in ("idm", "alcc"):
        for driver in (0, 1):
            table = {"strategy": name, "training_seed": pd.NA, "profile": "p", "driver_id": driver}
            table |= {"time_s": TIME, "leader_speed": 10.0, "cav_speed": 8.0 + driver}
            table |= {"cav_gap": 7.0, "hdv_speed": 6.0, "hdv_gap": 9.0}
            parts.append(pd.DataFrame(table))
    write_parquet(pd.concat(parts), tmp_path / "run" / "steps.parquet")
    (tmp_path / "run" / "config.yaml").write_text(yaml.safe_dump({"scenario": SCENARIO}))
    return tmp_path / "run"


@pytest.mark.parametrize("ring", [False, True])
def test_a_page_holds_the_motion_of_all_vehicles_and_needs_nothing_else(ring) -> None:
    shown = motion(3, ring)
    text = page(shown, "a </script> title")
    found = data_of(text)
    assert found["title"] == "a </script> title"
    assert found["roles"] == ["automated", "human", "human"]
    for name in ("speed", "gap"):
        assert pytest.approx(getattr(shown, name), abs=0.005) == np.array(found[name]).T
    assert (found["leader"] is None) == (found["circumference"] is not None) == ring
    assert not re.search(r"(src|href)=|https?:|@import", text)
    assert "default-src 'none'" in text


def test_the_page_of_a_long_episode_of_many_stays_small() -> None:
    time = 0.1 * np.arange(1, 6001)
    text = page(motion(100, time=time), "a fleet")
    found = data_of(text)
    assert len(found["gap"]) == 100
    assert len(found["time"]) * 100 <= LARGEST
    assert len(text) < 1_500_000


@pytest.mark.parametrize("ring", [False, True])
def test_the_frames_of_a_gif_differ_and_show_each_role(ring, tmp_path) -> None:
    path = animate(motion(2, ring), "drifting", tmp_path / "x.gif")
    with Image.open(path) as image:
        assert image.n_frames == 11
        shown = []
        for frame in (0, 5, 10):
            image.seek(frame)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
    road = slice(0, shown[0].shape[0] // 4)
    assert np.abs(shown[0][road] - shown[1][road]).sum() > 1000
    assert np.abs(shown[1][road] - shown[2][road]).sum() > 1000
    for role in ("automated", "human", *([] if ring else ["leader"])):
        near = np.abs(shown[0] - 255 * np.array(to_rgb(COLOURS[role]))).max(-1) < 24
        assert near.sum() > 30, role


def test_a_long_episode_plays_faster_and_says_so() -> None:
    time = 0.1 * np.arange(1, 601)
    drawn = frames(motion(time=time), "long")
    assert "4.0 × as fast" in next(drawn)._suptitle.get_text()
    assert 1 + sum(1 for _ in zip(range(3), drawn, strict=False)) == 4


def test_an_mp4_is_one_or_the_error_names_ffmpeg(tmp_path, monkeypatch) -> None:
    if FFMpegWriter.isAvailable():
        assert animate(motion(), "x", tmp_path / "x.mp4").read_bytes()[4:8] == b"ftyp"
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda cls: False))
    with pytest.raises(ConfigError, match="ffmpeg"):
        animate(motion(), "x", tmp_path / "y.mp4")


def test_a_file_is_replaced_whole_or_kept(tmp_path, monkeypatch) -> None:
    path = tmp_path / "x.html"
    path.write_text("before")

    def half(motion: Motion, title: str, target) -> None:
        target.write_text("half")
        raise OSError(28, "No space left on device")

    monkeypatch.setitem(animation.FORMS, ".html", half)
    with pytest.raises(ResultsError, match="No space"):
        animate(motion(), "x", path)
    assert path.read_text() == "before"
    assert [p.name for p in tmp_path.iterdir()] == ["x.html"]
    monkeypatch.undo()
    animate(motion(), "x", path)
    assert data_of(path.read_text())["title"] == "x"


def test_the_command_animates_what_is_named(run_folder, capsys) -> None:
    assert COMMANDS["animate"][0] == command.__name__
    assert command.main([str(run_folder)]) == 0
    name = capsys.readouterr().out.splitlines()[-1]
    assert name == str(run_folder / "figures" / "animation_alcc_0.html")
    assert "alcc: profile p, driver 0" in Path(name).read_text()
    out = run_folder.parent / "there.html"
    words = ["--strategy", "idm", "--episode", "1", "--start", "0.5", "--duration", "0.3"]
    assert command.main([str(run_folder), *words, "--out", str(out)]) == 0
    found = data_of(out.read_text())
    assert found["title"] == "idm: profile p, driver 1"
    assert found["time"] == [0.5, 0.6, 0.7, 0.8]
    assert found["speed"][0] == [9.0] * 4


def test_a_main_job_shows_its_evaluation(run_folder) -> None:
    job = run_folder.parent / "job"
    job.mkdir()
    run_folder.rename(job / "evaluation")
    assert command.run(job).parent == job / "evaluation" / "figures"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--strategy", "alccc"], "unknown strategy 'alccc'; valid: alcc, idm. Did you mean"),
        (["--episode", "2"], "--episode must lie from 0 to 1, got 2"),
        (["--out", "x.avi"], "unknown ending of an animation '.avi'; valid: .gif, .html, .mp4"),
        (["--start", "9"], "the episode has those from 0.1 to 1.2 s"),
    ],
)
def test_mistakes_are_named(words, said, run_folder) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        command.main([str(run_folder), *words])


def test_folders_without_episodes_are_named(run_folder, tmp_path) -> None:
    with pytest.raises(ConfigError, match="not a run folder"):
        command.run(tmp_path / "nothing")
    write_parquet(pd.DataFrame(), run_folder / "steps.parquet")
    with pytest.raises(ConfigError, match="holds no sample episode"):
        command.run(run_folder)
    (run_folder / "steps.parquet").unlink()
    with pytest.raises(ResultsError, match=r"holds no steps\.parquet"):
        command.run(run_folder)
