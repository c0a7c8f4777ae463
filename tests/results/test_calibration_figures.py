"""Figures of a calibration from a tiny table."""

import pytest

from lcc_rl.drivers.population import load_drivers
from lcc_rl.errors import DataError, ResultsError
from lcc_rl.figures.calibration import calibration_figure, joint_figure
from lcc_rl.figures.drawing import save


@pytest.fixture
def drivers():
    """Six drivers of both modes."""
    import pandas as pd

    return pd.concat([load_drivers(mode=mode).head(6) for mode in ("local", "global")])


def texts(figure):
    from matplotlib.text import Text

    return " ".join(artist.get_text() for artist in figure.findobj(Text))


def test_boxes_name_modes_sizes_units_and_bounds(drivers):
    figure = calibration_figure(drivers)
    shown = texts(figure)
    assert len(figure.axes) == 6
    for text in (
        "local\nn = 6",
        "global\nn = 6",
        "RMSPE [%]",
        "[m/s]",
        "held at 1.5",
        "on a bound",
    ):
        assert text in shown


def test_one_mode_leaves_out_what_it_held(drivers):
    assert len(calibration_figure(drivers[drivers["mode"] == "local"]).axes) == 3


def test_joint_distribution_says_correlation_and_share(drivers):
    shown = texts(joint_figure(drivers))
    share = 100 * drivers[drivers["mode"] == "local"]["desired_speed_at_bound"].mean()
    assert "6 drivers (local calibration)" in shown
    assert "correlation" in shown
    assert f"{share:.0f} %" in shown
    assert "global calibration" in texts(joint_figure(drivers, "global"))


@pytest.mark.parametrize("count", [1, 2])
def test_few_drivers_can_be_drawn(drivers, count, tmp_path):
    few = drivers[drivers["mode"] == "local"].head(count)
    save(calibration_figure(few), tmp_path / "calibration.png")
    save(joint_figure(few), tmp_path / "joint.png")


def test_files_are_written_whole_in_the_format_of_their_suffix(drivers, tmp_path):
    save(joint_figure(drivers), tmp_path / "new" / "joint.png")
    save(calibration_figure(drivers), tmp_path / "calibration.svg")
    assert (tmp_path / "new" / "joint.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (tmp_path / "calibration.svg").read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["calibration.svg", "new"]


def test_bad_tables_and_places_are_refused(drivers, tmp_path):
    with pytest.raises(DataError, match="rmspe"):
        calibration_figure(drivers.drop(columns="rmspe"))
    with pytest.raises(DataError, match="no drivers"):
        joint_figure(drivers.iloc[:0])
    with pytest.raises(DataError, match="no drivers of mode"):
        joint_figure(drivers[drivers["mode"] == "local"], "global")
    (tmp_path / "file").touch()
    with pytest.raises(ResultsError):
        save(joint_figure(drivers), tmp_path / "file" / "joint.png")
