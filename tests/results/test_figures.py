"""Every figure of a study draws from a tiny table, and says and shows what it should."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
import yaml
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image
from study_frames import episodes, training

from lcc_rl.config import identity, load
from lcc_rl.data.leaders import Case, stretch
from lcc_rl.errors import ConfigError
from lcc_rl.figures.drawing import in_words, save
from lcc_rl.figures.platoon import jerks, record_figure, velocities
from lcc_rl.io.files import write_parquet
from lcc_rl.results import drawing, training_figures
from lcc_rl.results import figures as study_figures
from lcc_rl.studies.alcc import comparison_figures
from lcc_rl.studies.alcc import figures as alcc_figures


def texts(figure: Figure) -> str:
    """Everything written on a figure that is drawn."""
    figure.draw_without_rendering()
    return "\n".join(item.get_text() for item in figure.findobj(Text))


def steps() -> pd.DataFrame:
    time = np.arange(1, 6) * 0.1
    return pd.concat(
        pd.DataFrame(
            {
                "strategy": "alcc",
                "training_seed": pd.array([seed] * 5, dtype="Int64"),
                "profile": "rec/1@0.0s",
                "driver_id": 0,
                "desired_speed_mps": 20.0,
                "time_gap_s": 1.0,
                "time_s": time,
                "leader_speed": 5.0 + time,
                "leader_acceleration": 1.0,
                "cav_speed": 5.0 + seed,
                "cav_acceleration": 0.0,
                "cav_gap": 8.0,
                "hdv_speed": 5.0,
                "hdv_acceleration": 0.0,
                "hdv_gap": 8.0,
            }
        )
        for seed in (3, 1)
    )


def ablated() -> pd.DataFrame:
    return pd.concat([episodes().assign(ablation=name) for name in ("none", "no_safety")])


def strings() -> pd.DataFrame:
    return pd.concat([episodes().assign(followers=number) for number in (1, 5)])


def single() -> pd.DataFrame:
    return pd.concat([episodes(profiles=1).assign(study_profile=number) for number in (3, 12)])


FIGURES = {
    "power_map": (lambda: alcc_figures.power_map(), ["kW", "speed [m/s]"]),
    "learning_curve": (lambda: training_figures.learning_curve(training()), ["n = 2 seeds, 95 %"]),
    "reward_terms": (lambda: alcc_figures.reward_terms(training()), ["HDV energy", "safety"]),
    "sample_episode": (lambda: study_figures.sample_episode(steps(), "alcc"), ["gap ahead [m]"]),
    "human_energy": (
        lambda: study_figures.human_energy(episodes(), "reference"),
        ["n = 3 drivers", "+17.5 %", "kJ"],
    ),
    "improvement": (
        lambda: study_figures.paired_improvement(episodes(), "alcc", "reference"),
        ["1 of 3 drivers", "33 % of (window, driver) pairs", "over windows and seeds"],
    ),
    "distributions": (
        lambda: alcc_figures.distributions(episodes()),
        ["n = 3 drivers", "reference", "75.0", "kJ"],
    ),
    "generalization": (
        lambda: alcc_figures.generalization_figure(episodes()),
        ["paper, 4 profiles", "n = 2", "mean of 2 seeds", "human driver"],
    ),
    "ablations": (
        lambda: comparison_figures.comparison_figure(ablated()),
        ["no safety", "n = 2 seeds"],
    ),
    "followers": (
        lambda: comparison_figures.followers_figure(strings()),
        ["human drivers", "2 seeds"],
    ),
    "single": (
        lambda: comparison_figures.single_profile_figure(single()),
        ["profile 12", "idm", "kJ"],
    ),
}


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_draws_and_says_what_it_shows(name, tmp_path) -> None:
    draw, expected = FIGURES[name]
    figure = draw()
    written = texts(figure)
    for words in expected:
        assert words in written, written
    assert save(figure, tmp_path / f"{name}.png").stat().st_size > 5000


def test_one_seed_is_said_and_of_one_window_no_interval_drawn() -> None:
    frame = episodes()
    frame = frame[~(frame["training_seed"] == 1).fillna(False)]
    assert "1 training seed" in texts(study_figures.paired_improvement(frame, "alcc", "reference"))
    frame = frame[frame["profile_id"] == 0]
    for figure in (
        study_figures.paired_improvement(frame, "alcc", "reference"),
        study_figures.human_energy(frame, "alcc"),
        alcc_figures.generalization_figure(frame),
    ):
        assert "1 training seed" in (found := texts(figure)) or "1 seed" in found
        assert "95 %" not in found


def test_a_sample_episode_is_of_one_seed_only() -> None:
    figure = study_figures.sample_episode(steps(), "alcc")
    lines = {line.get_label(): line.get_ydata() for line in figure.axes[0].lines}
    assert np.asarray(lines["controlled car"]).tolist() == [6.0] * 5  # seed 1, once


def test_seeds_of_different_length_share_the_shorter_curve() -> None:
    frame = training()
    short = frame[~((frame["seed"] == 1) & (frame["iteration"] > 12))]
    figure = training_figures.learning_curve(short)
    assert len(figure.axes[0].lines[0].get_xdata()) == 12


def test_of_a_training_with_limits_the_shares_are_shown_with_the_limit() -> None:
    frame = training().assign(loss_actor=3.0, share_efficiency=0.02)
    frame["agent.limits.efficiency"] = 0.01
    figure = training_figures.training_figure(frame)
    assert "limit 1 %" in texts(figure)
    assert figure.axes[1].lines[0].get_ydata() == pytest.approx(2.0)
    assert len(training_figures.training_figure(training()).axes) == 1


def shown(figure: Figure, path) -> np.ndarray:
    """The colours of a figure's pixels, ``[n, 3]``."""
    with Image.open(save(figure, path, dpi=70)) as image:
        return np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)


def count(pixels: np.ndarray, colour: str, alpha: float = 1.0) -> int:
    """How many pixels have a colour, or a transparent one on white."""
    mixed = 255 * (alpha * np.array(to_rgb(colour)) + 1.0 - alpha)
    return int((np.abs(pixels - mixed).max(-1) <= 3).sum())


def test_the_overview_has_a_bar_per_strategy_and_the_legend_covers_none(tmp_path) -> None:
    frame = episodes().assign(strategy=lambda x: x["strategy"].replace("alcc", "own_energy"))
    figure = study_figures.overview(frame, steps().assign(strategy="own_energy"), "own_energy")
    right = figure.axes[1]
    assert [x.get_text() for x in right.get_yticklabels()] == ["idm", "own energy", "reference"]
    assert len(right.patches) == 6
    pixels = shown(figure, tmp_path / "x.png")
    assert count(pixels, study_figures.VEHICLES["cav"][1]) > 500
    assert count(pixels, study_figures.VEHICLES["hdv"][1]) > 500
    for axis in figure.axes:
        legend, frame_of_data = axis.get_legend(), axis.get_window_extent()
        assert legend.get_window_extent().y0 >= frame_of_data.y1 - 1.0
    labels = [label.get_window_extent() for label in right.get_yticklabels()]
    assert not any(a.overlaps(b) for i, a in enumerate(labels) for b in labels[:i])


def test_the_colours_of_all_strategies_are_on_the_image(tmp_path) -> None:
    figure = study_figures.paired_improvement(episodes(), "alcc", "reference")
    pixels = shown(figure, tmp_path / "x.png")
    assert count(pixels, study_figures.colour("alcc"), 0.8) > 300
    assert count(pixels, study_figures.colour("reference"), 0.45) > 50
    curves = shown(training_figures.learning_curve(training()), tmp_path / "y.png")
    for name in dict.fromkeys(training()["variant"]):
        assert count(curves, study_figures.colour(str(name))) > 10


def platoon(jerk: float) -> pd.DataFrame:
    parts = []
    for name in ("cacc paper_like", "hcfs"):
        for follower in range(4):
            time = 0.2 * np.arange(1, 31)
            table = {"strategy": name, "case": "case 1", "follower": follower, "time_s": time}
            table |= {"speed_mps": 5.0 + follower + time, "jerk_mps3": jerk * np.sin(time)}
            parts.append(pd.DataFrame(table))
    return pd.concat(parts, ignore_index=True)


def test_jerk_has_its_own_scale_and_the_bound_is_drawn_where_it_is_named() -> None:
    small, large = (jerks(platoon(jerk), "case 1", 30.0) for jerk in (2.0, 29.0))
    assert small.axes[0].get_ylim()[1] < 3.0
    assert large.axes[0].get_ylim()[1] > 30.0
    for figure, dotted, said in ((small, 0, "beyond the scale"), (large, 2, "dotted: bound ±30")):
        assert [x.get_linestyle() for x in figure.axes[0].lines].count(":") == dotted
        assert said in texts(figure)


def test_followers_have_different_colours_and_names_are_words(tmp_path) -> None:
    figure = velocities(platoon(1.0), "case 1")
    assert "cacc paper like" in texts(figure)
    assert "_" not in texts(figure)
    colours = {line.get_color() for line in figure.axes[0].lines}
    assert len(colours) == 4  # three followers and the leader
    assert len(np.unique(shown(figure, tmp_path / "x.png"), axis=0)) > 50


def test_names_are_read_aloud() -> None:
    assert in_words("preview_10s") == "preview 10 s"
    assert in_words("pi_saturation") == "pi saturation"
    assert drawing.in_file("pi_saturation ../x: y") == "pi_saturation_.._x__y"


def test_further_formats_lie_beside_the_image(tmp_path) -> None:
    figure = velocities(platoon(1.0), "case 1")
    assert save(figure, tmp_path / "x.png", formats=["png", "pdf", "svg"]) == tmp_path / "x.png"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.pdf", "x.png", "x.svg"]
    assert (tmp_path / "x.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize("entry", ["train", "evaluate", "pipeline", "calibrate"])
def test_unknown_formats_are_refused_before_anything_begins(entry) -> None:
    with pytest.raises(ConfigError, match="'bmp'; valid: pdf, png, svg"):
        load(entry, ["figure_formats=[png,bmp]"])
    with pytest.raises(ConfigError, match="must name png"):
        load(entry, ["figure_formats=[svg]"])


def test_formats_do_not_make_another_run() -> None:
    one, other = (load("train", words) for words in ([], ["figure_formats=[png,pdf]"]))
    assert identity(one) == identity(other)


@pytest.mark.slow
def test_figures_of_a_run_with_pieces_of_ones_own_need_no_trust(tmp_path) -> None:
    write_parquet(episodes(), tmp_path / "episodes.parquet")
    both = pd.concat([steps(), steps().assign(strategy="reference")])
    write_parquet(both, tmp_path / "steps.parquet")
    scenario = {"string": "automated human", "road": "open", "vehicle_length": 5.0}
    scenario["pieces"] = {"mine": {"_target_": "not_installed.Mine"}}
    settings = {"scenario": scenario, "figure_formats": ["png", "svg"]}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(settings))
    drawn = study_figures.write_study_figures(tmp_path)
    names = {path.name for path in drawn}
    assert {"overview.png", "episode_alcc.png", "improvement_reference_vs_idm.png"} <= names
    assert all(path.with_suffix(".svg").exists() for path in drawn)


def test_the_record_is_drawn_with_its_training_part_and_the_cases() -> None:
    record = stretch("udds", 0.2, 0.5)
    case = Case("case 1", stretch("us06", 0.2, 0.5, 126.0, 146.0), 8)
    figure = record_figure(record, 600.0, [case, replace(case, name="case 2")])
    whole, first, second = figure.axes
    line = whole.lines[0]
    np.testing.assert_array_equal(line.get_ydata(), record.record(0).numpy())
    np.testing.assert_allclose(line.get_xdata()[[0, 1, -1]], [0.0, 0.2, 1369.0])
    part = whole.patches[0].get_path().get_extents(whole.patches[0].get_patch_transform())
    np.testing.assert_allclose(part.intervalx, [600.0, 1369.0])
    for axis in (first, second):
        np.testing.assert_array_equal(axis.lines[0].get_ydata(), case.profile.record(0).numpy())
    assert [len(axis.lines) for axis in (first, second)] == [2, 1]  # the paper's ends of case 1
    assert "US06 from 126 s on" in texts(figure)
