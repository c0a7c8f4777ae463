"""Every figure of a study draws from a tiny table, and says what it shows."""

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from study_frames import episodes, training

from lcc_rl.results import figures as study_figures
from lcc_rl.results import training_figures
from lcc_rl.results.drawing import save
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
