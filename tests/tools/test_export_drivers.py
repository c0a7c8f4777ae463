"""Calibrated drivers as vehicle types of SUMO."""

from __future__ import annotations

from xml.etree import ElementTree

import export_drivers
import pandas as pd
import pytest

from lcc_rl.drivers.tables import load_drivers
from lcc_rl.errors import DataError

NETWORK = """<net version="1.9">
  <location netOffset="0,0" convBoundary="0,0,100,0" origBoundary="0,0,100,0" projParameter="!"/>
  <edge id="e" from="a" to="b">
    <lane id="e_0" index="0" speed="50" length="100" shape="0,0 100,0"/>
  </edge>
  <junction id="a" type="dead_end" x="0" y="0" incLanes="" intLanes="" shape="0,0"/>
  <junction id="b" type="dead_end" x="100" y="0" incLanes="e_0" intLanes="" shape="100,0"/>
</net>"""


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


def test_the_types_are_those_that_sumo_knows(drivers, tmp_path) -> None:
    libsumo = pytest.importorskip("libsumo", reason="extra sumo")
    target = tmp_path / "vtypes.xml"
    assert export_drivers.main([drivers, str(target)]) == 0
    (tmp_path / "net.xml").write_text(NETWORK)
    libsumo.start(["sumo", "-n", str(tmp_path / "net.xml"), "-a", str(target)])
    try:
        known = libsumo.vehicletype.getIDList()
        assert {f"driver{i}" for i in range(5)} <= set(known)
        expected = load_drivers(drivers)["time_gap_s"][0]
        assert libsumo.vehicletype.getTau("driver0") == pytest.approx(expected, rel=1e-5)
    finally:
        libsumo.close()


def test_drivers_of_another_model_are_refused(drivers, tmp_path) -> None:
    table = pd.read_parquet(drivers).assign(model="gipps", leader_deceleration_mps2=3.0)
    table.to_parquet(drivers)
    with pytest.raises(DataError, match="row 0"):
        export_drivers.main([drivers, str(tmp_path / "vtypes.xml")])
