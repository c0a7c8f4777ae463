"""Every figure draws from a tiny table, and says and shows what it should."""

from __future__ import annotations

import html
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import tiny
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from study_frames import episodes, training, windows

from lcc_rl.commands import evaluation
from lcc_rl.data.leaders import Case, stretch
from lcc_rl.drivers.population import load_drivers
from lcc_rl.figures import evaluation as run_figures
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.figures.drawing import COLUMN_WIDTH, PAGE_WIDTH, colour, save
from lcc_rl.figures.platoon import WINNER_COLOURS, jerks, record_figure, switching, velocities
from lcc_rl.figures.space_time import space_time
from lcc_rl.figures.training import learning_curve, training_figure
from lcc_rl.results.report import report, windows_for
from lcc_rl.results.windows import Means
from lcc_rl.studies.alcc import figures as alcc


def texts(figure: Figure) -> str:
    """Everything written on a figure that is drawn."""
    figure.draw_without_rendering()
    return "\n".join(item.get_text() for item in figure.findobj(Text))


def pixels(figure: Figure, path: Path) -> np.ndarray:
    with Image.open(save(figure, path, dpi=80)) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def count(image: np.ndarray, hue: str, alpha: float = 1.0) -> int:
    """How many pixels have a colour, or a transparent one on white."""
    mixed = 255 * (alpha * np.array(to_rgb(hue)) + 1.0 - alpha)
    return int((np.abs(image - mixed).max(-1) <= 3).sum())


def steps() -> pd.DataFrame:
    """One sample episode of two seeds; the car drives at 5 m/s and its seed more."""
    time = np.arange(1, 6) * 0.1
    table = {"strategy": "alcc", "profile": "rec/1@0.0s", "driver_id": 0, "time_s": time}
    table |= {"desired_speed_mps": 20.0, "time_gap_s": 1.0, "leader_speed": 5.0 + time}
    table |= {f"{x}_acceleration": 0.0 for x in ("leader", "cav", "hdv")}
    table |= {"hdv_speed": 5.0, "cav_gap": 8.0, "hdv_gap": 8.0}
    seeds = (pd.DataFrame({**table, "training_seed": n, "cav_speed": 5.0 + n}) for n in (3, 1))
    return pd.concat(seeds).astype({"training_seed": "Int64"})


def parts(column: str, *values: object, **size: int) -> pd.DataFrame:
    return pd.concat([windows(**size).assign(**{column: value}) for value in values])


def drivers() -> pd.DataFrame:
    return pd.concat([load_drivers(mode=mode).head(6) for mode in ("local", "global")])


FIGURES = {
    "power_map": (alcc.power_map, ["kW", "speed [m/s]"]),
    "learning_curve": (lambda: learning_curve(training()), ["network (2 seeds)", "95 % interval"]),
    "limits_never_reached": (
        lambda: training_figure(
            training().assign(loss_actor=1.0, share_efficiency=0.0, limit_efficiency=0.02)
        ),
        ["objective, less is better", "long time gap: in no batch"],
    ),
    "reward_terms": (
        lambda: alcc.reward_terms(training()),
        ["energy of the human driver", "(2 seeds)"],
    ),
    "sample_episode": (lambda: run_figures.sample_episode(steps(), "alcc"), ["gap ahead [m]"]),
    "human_energy": (
        lambda: run_figures.human_energy_figure(Means.of(episodes()), "reference"),
        ["of 3 drivers", "+17.5 %", "kJ"],
    ),
    "improvement": (
        lambda: run_figures.paired_improvement(Means.of(episodes()), "alcc", "reference"),
        ["1 of 3 drivers", "over windows and seeds"],
    ),
    "distributions": (lambda: alcc.distributions(episodes()), ["n = 3 drivers", "75.0"]),
    "generalization": (
        lambda: alcc.generalization_figure(windows()),
        ["paper, 4 profiles", "n = 2", "mean of 2 seeds", "human driver"],
    ),
    "ablations": (
        lambda: alcc.comparison_figure(parts("ablation", "none", "no_safety")),
        ["no safety", "n = 2 seeds"],
    ),
    "calibration": (
        lambda: calibration_figure(drivers()),
        ["local\nn = 6", "global\nn = 6", "RMSPE [%]", "held at 1.5", "on a bound"],
    ),
    "joint": (lambda: joint_figure(drivers()), ["6 drivers, local calibration", "correlation"]),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_fits_a_paper_and_says_what_it_shows(name, tmp_path) -> None:
    draw, expected = FIGURES[name]
    figure = draw()
    save(figure, tmp_path / f"{name}.png", formats=["svg"])
    written = texts(figure)
    for words in expected:
        assert words in written, written
    assert figure.get_size_inches()[0] in (COLUMN_WIDTH, PAGE_WIDTH)
    assert not re.search(r"(^|[^\w.])-\d", written), "a minus is no hyphen"
    ticks = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for tick in axis.get_major_ticks()
        for label in (tick.label1, tick.label2)
    }
    for item in set(figure.findobj(Text)) - ticks:
        if item.get_visible() and item.get_text().strip():
            box = item.get_window_extent()
            left, low, right, high = *box.min, *(figure.bbox.max - box.max)
            assert min(left, low, right, high) > -1.0, f"{item.get_text()!r} is cut off"
    # Letters stay letters in vector formats, for a search.
    drawn = (tmp_path / f"{name}.svg").read_text()
    for line in "\n".join(expected).splitlines():
        assert line in html.unescape(drawn)


def test_letters_of_a_pdf_have_a_journals_fonts(tmp_path) -> None:
    save(alcc.power_map(), tmp_path / "map.pdf")
    assert b"/FontFile2" in (tmp_path / "map.pdf").read_bytes()


def test_one_seed_is_said_and_of_one_window_no_interval_drawn() -> None:
    frame = episodes()
    frame = frame[(frame["training_seed"] != 1).fillna(True) & (frame["profile_id"] == 0)]
    for figure in (
        run_figures.paired_improvement(Means.of(frame), "alcc", "reference"),
        run_figures.human_energy_figure(Means.of(frame), "alcc"),
        alcc.generalization_figure(Means.of(frame).windows),
    ):
        assert "1 training seed" in (found := texts(figure)) or "1 seed" in found
        assert "95 %" not in found


def test_the_overview_has_the_savings_of_the_table_and_colours_are_on_the_image(tmp_path) -> None:
    frame = episodes().assign(strategy=lambda x: x["strategy"].replace("alcc", "own_energy"))
    found = report(windows_for(frame))
    table = found.short
    own = steps().assign(strategy="own_energy")
    figure = run_figures.overview(frame, own, "own_energy", found)
    right = figure.axes[1]
    labels = [x.get_text().replace("\n", " ") for x in right.get_yticklabels()]
    assert labels == list(table["driver"])
    shown = right.lines[0].get_xdata()
    np.testing.assert_allclose(shown, table["saved_pct"].fillna(0.0))
    ends = [line[:, 0] for line in right.collections[0].get_segments() if len(line)]
    bounds = table[["saved_pct_low", "saved_pct_high"]].dropna()
    np.testing.assert_allclose(ends, bounds)
    for energy in table["energy_kj_per_km"]:
        assert f"{energy:.1f} kJ/km" in texts(figure)
    assert "path energy per km saved" in texts(figure)
    image = pixels(figure, tmp_path / "x.png")
    assert all(count(image, run_figures.VEHICLE_STYLES[name][1]) > 50 for name in ("cav", "hdv"))
    legend = figure.axes[0].get_legend()  # it covers no data
    assert legend.get_window_extent().y0 >= figure.axes[0].get_window_extent().y1 - 1.0
    image = pixels(
        run_figures.paired_improvement(Means.of(episodes()), "alcc", "reference"),
        tmp_path / "y.png",
    )
    assert count(image, colour("alcc")) > 300
    assert count(image, colour("reference"), 0.45) > 50


def platoon(jerk: float) -> pd.DataFrame:
    time = 0.2 * np.arange(1, 31)
    found = [
        {"strategy": name, "case": "case 1", "follower": follower, "time_s": time}
        | {"speed_mps": 5.0 + follower + time, "jerk_mps3": jerk * np.sin(time)}
        for name in ("cacc paper_like", "hcfs")
        for follower in range(4)
    ]
    return pd.concat(map(pd.DataFrame, found), ignore_index=True)


def test_jerk_has_its_own_scale_and_followers_their_own_colours() -> None:
    for jerk, dotted in ((2.0, 0), (29.0, 2)):
        figure = jerks(platoon(jerk), "case 1", 30.0)
        assert (figure.axes[0].get_ylim()[1] > 30.0) == (dotted > 0)
        assert [x.get_linestyle() for x in figure.axes[0].lines].count(":") == dotted
        assert "bound of ±30" in texts(figure)
    figure = velocities(platoon(1.0), "case 1")
    assert "CACC, fitted to Table IV" in texts(figure)
    assert len({line.get_color() for line in figure.axes[0].lines}) == 4  # with the leader


def test_switching_has_the_colour_of_the_controller_that_drives() -> None:
    winner = np.array([[0, 0, 1, 1], [1, 0, 0, 0], [0, 1, 0, 1]])  # follower × time
    rows = [
        {"strategy": "hcfs", "case": "case 1", "follower": f + 1, "time_s": 0.2 * (t + 1)}
        | {"winner": float(winner[f, t])}
        for f in range(3)
        for t in range(4)
    ]
    figure = switching(pd.DataFrame(rows), "case 1")
    assert "case 1: HCFS (policy 42 %)" in texts(figure)
    assert "\nrule\n" in texts(figure)
    figure.canvas.draw()
    image = np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0
    colours = np.array([to_rgb(hue) for hue in WINNER_COLOURS.values()])
    centres = [(0.2 * t + 0.1, f + 1) for f in range(3) for t in range(4)]
    places = figure.axes[0].transData.transform(centres).astype(int)
    drawn = np.array([image[len(image) - y, x] for x, y in places])
    np.testing.assert_allclose(drawn, colours[winner.ravel()], atol=1 / 255)


def test_the_record_is_drawn_with_its_training_part_and_the_cases() -> None:
    record = stretch("udds", 0.2, 0.5)
    case = Case("case 1", stretch("us06", 0.2, 0.5, 126.0, 146.0), 8)
    figure = record_figure(record, 600.0, [case])
    whole, window = figure.axes
    np.testing.assert_array_equal(whole.lines[0].get_ydata(), record.record(0).numpy())
    part = whole.patches[0].get_path().get_extents(whole.patches[0].get_patch_transform())
    np.testing.assert_allclose(part.intervalx, [600.0, 1369.0])
    np.testing.assert_array_equal(window.lines[0].get_ydata(), case.profile.record(0).numpy())
    assert "US06 from 126 s on" in texts(figure)


RING = {"string": "automated human*2", "road": "ring", "circumference": 60.0, "vehicle_length": 5.0}


def string_steps(name: str, stops: float) -> pd.DataFrame:
    time = 0.1 * np.arange(1, 101)
    table = {"strategy": name, "training_seed": pd.NA, "profile": "p", "driver_id": 0}
    table |= {"time_s": time, "leader_speed": 10.0}
    for vehicle, kind in enumerate(("cav", "hdv1", "hdv2")):
        slow = (3.0 + vehicle < time) & (6.0 + vehicle > time)
        table |= {f"{kind}_speed": np.where(slow, 10.0 - stops, 10.0)}
        table |= {f"{kind}_gap": 10.0 + vehicle}
    return pd.DataFrame(table)


ROWS = pd.concat([string_steps("human", 9.0), string_steps("alcc", 0.5)])


def test_space_time_lines_stand_behind_the_leader_by_gaps_and_lengths() -> None:
    figure = space_time(ROWS, ["human", "alcc"], {"scenario": {**RING, "road": "open"}})
    assert figure is not None
    first, last = (axis.collections[-1] for axis in figure.axes[:2])
    start = last.get_segments()[0][0]
    assert start == pytest.approx([0.1, -(10.0 + 11.0 + 12.0 + 3 * 5.0)])
    assert first.get_array().min() == pytest.approx(1.0)
    assert first.get_clim() == last.get_clim() == (0.0, 10.0)
    short = ROWS.drop(columns=[name for name in ROWS if name.startswith("hdv2")])
    two = {**RING, "road": "open", "string": "automated human"}
    assert space_time(short, ["human"], {"scenario": two}) is None


def test_a_ring_closes_and_no_line_crosses_it() -> None:
    figure = space_time(ROWS, ["human"], {"scenario": RING})
    assert figure is not None
    for lines in figure.axes[0].collections:
        segments = np.array(lines.get_segments())[..., 1]
        assert segments.min() >= 0.0
        assert segments.max() <= 60.0
        assert np.abs(np.diff(segments, axis=1)).max() < 30.0


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_networks_and_own_controllers_have_figures_and_those_of_the_package_none(tmp_path) -> None:
    own = "lcc_rl.pieces.LinearACC"  # as a user's class, under a name of its own
    rivals = f"compare={{mine: {own}, acc_filtered: acc_filtered}}"
    words = ("variant=alcc", "policy=pretrained", "+filter=cbf", rivals, "evaluation.drivers=3")
    evaluation.run(tiny("evaluate", *words, agent=False), tmp_path)
    drawn = {path.stem for path in (tmp_path / "figures").iterdir()} - {"overview", "space_time"}
    whose = {
        re.match(r"(?:episode|human_energy|improvement)_(\w+?)(?:_vs_\w+)?$", x)[1] for x in drawn
    }
    assert whose == {"alcc", "mine"}
    assert {"episode_mine", "human_energy_mine", "improvement_mine_vs_idm_acc"} <= drawn


def test_a_strategy_without_measures_has_no_figure() -> None:
    frame = episodes()
    energies = frame.columns[frame.columns.str.endswith("_kj")]
    frame.loc[frame["strategy"] == "reference", energies] = np.nan  # collisions in the warm-up
    found = [name for name, _ in run_figures.study_figures(frame, steps()[:0], {})]
    assert any("alcc" in name for name in found)
    assert not any("reference" in name for name in found)
    calm = steps().assign(strategy="reference", profile="calm", leader_speed=5.0)
    cfg = {"scenario": {**RING, "road": "open", "string": "automated human"}}
    shown = run_figures.study_figures(episodes(), pd.concat([steps(), calm]), cfg)
    assert {name for name, _ in shown if name.startswith("episode")} == {"episode alcc"}


def test_drivers_that_are_alike_make_a_histogram() -> None:
    alike = episodes()
    column = "hdv_path_energy_kj"
    alike[column] = 300.0 + 1e-12 * np.arange(len(alike))
    run_figures.human_energy_figure(Means.of(alike), "reference")


def test_the_human_behind_is_behind_the_car_at_its_place() -> None:
    table = steps().drop(columns=["hdv_speed", "hdv_acceleration", "hdv_gap"])
    table = table.assign(cav_place=1, hdv1_speed=6.0, hdv2_speed=4.0, hdv2_gap=8.0)
    axis = run_figures.sample_episode(table, "alcc").axes[0]
    drawn = {line.get_label(): line.get_ydata() for line in axis.get_lines()}
    assert (drawn["human behind"] == 4.0).all()
