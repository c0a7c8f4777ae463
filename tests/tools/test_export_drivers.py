"""Calibrated drivers as vehicle types of SUMO."""

from __future__ import annotations

from xml.etree import ElementTree

import export_drivers
import pandas as pd
import pytest

from lcc_rl.drivers.tables import load_drivers
from lcc_rl.errors import DataError


@pytest.fixture
def drivers(tmp_path) -> str:
    """Return the file of the first five shipped drivers, in both modes."""
    both = [load_drivers(mode=mode).head(5) for mode in ("local", "global")]
    pd.concat(both).to_parquet(tmp_path / "drivers.parquet")
    return str(tmp_path / "drivers.parquet")


def test_the_file_holds_what_the_table_holds(drivers, tmp_path) -> None:
    target = tmp_path / "new" / "vtypes.xml"
    assert export_drivers.main([drivers, str(target), "--mode", "global"]) == 0
    types = ElementTree.parse(target).getroot().findall("vType")
    table = load_drivers(drivers, "global")
    for found, (_, row) in zip(types, table.iterrows(), strict=True):
        for key, column in (
            *(("maxSpeed", "desired_speed_mps"), ("desiredMaxSpeed", "desired_speed_mps")),
            *(("tau", "time_gap_s"), ("accel", "acceleration_mps2")),
            *(("decel", "deceleration_mps2"), ("minGap", "min_gap_m")),
        ):
            assert float(found.get(key)) == pytest.approx(row[column], rel=1e-5), key


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.assign(model="gipps", leader_deceleration_mps2=3.0), "row 0"),
        (lambda t: t.assign(time_gap_s=-1.0), "row 0, column 'time_gap_s'"),
    ],
)
def test_bad_drivers_end_in_one_line(drivers, tmp_path, change, words) -> None:
    target = tmp_path / "vtypes.xml"
    change(pd.read_parquet(drivers)).to_parquet(drivers)
    with pytest.raises(DataError, match=words):
        export_drivers.main([drivers, str(target)])
    assert not target.exists()
