"""Calibrated drivers as vehicle types of SUMO."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import pandas as pd
import pytest

from lcc_rl.commands import export_drivers
from lcc_rl.drivers.tables import load_drivers

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


@pytest.mark.parametrize("mode", [None, "global"])
def test_the_file_holds_what_the_table_holds(drivers, tmp_path, capsys, mode) -> None:
    target = tmp_path / "new" / "vtypes.xml"
    words = [] if mode is None else ["--mode", mode]
    assert export_drivers.main([drivers, str(target), *words]) == 0
    assert "5 vehicle types" in capsys.readouterr().out
    root = ElementTree.parse(target).getroot()
    assert root.tag == "additional"
    types = root.findall("vType")
    assert [x.get("id") for x in types] == [f"driver{i}" for i in range(5)]
    table = load_drivers(drivers, mode)
    for found, (_, row) in zip(types, table.iterrows(), strict=True):
        assert found.get("carFollowModel") == "IDM"
        for key, column in (
            *(("maxSpeed", "desired_speed_mps"), ("desiredMaxSpeed", "desired_speed_mps")),
            *(("tau", "time_gap_s"), ("accel", "acceleration_mps2")),
            *(("decel", "deceleration_mps2"), ("minGap", "min_gap_m")),
        ):
            assert float(found.get(key)) == pytest.approx(row[column], rel=1e-5), key
        assert float(found.get("speedDev")) == 0.0
    assert [path.name for path in target.parent.iterdir()] == ["vtypes.xml"]


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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.assign(model="gipps", leader_deceleration_mps2=3.0), "row 0.*no.*'gipps'"),
        (lambda t: t.assign(time_gap_s=-1.0), "row 0, column 'time_gap_s'"),
        (lambda t: t.iloc[:0], "no drivers"),
    ],
)
def test_bad_drivers_end_in_one_line_and_leave_the_old_file(
    drivers, tmp_path, capsys, change, words
) -> None:
    target = tmp_path / "vtypes.xml"
    target.write_text("before")
    change(pd.read_parquet(drivers)).to_parquet(drivers)
    assert export_drivers.main([drivers, str(target)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: {drivers}: ")
    assert said.count("\n") == 1
    assert re.search(words, said)
    assert target.read_text() == "before"


@pytest.mark.parametrize("words", [["--mode", "locl"], []])
def test_other_bad_input_is_one_line_too(drivers, tmp_path, capsys, words) -> None:
    source = drivers if words else str(tmp_path / "nothing.parquet")
    assert export_drivers.main([source, str(tmp_path / "vtypes.xml"), *words]) == 1
    said = capsys.readouterr().err
    assert ("'locl'" if words else "nothing.parquet: no such file") in said
    assert said.count("\n") == 1


def test_a_target_that_cannot_be_written_is_named(drivers, tmp_path, capsys) -> None:
    assert export_drivers.main([drivers, str(tmp_path / "drivers.parquet" / "x.xml")]) == 1
    assert "cannot be written" in capsys.readouterr().err
