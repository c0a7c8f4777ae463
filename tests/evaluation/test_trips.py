"""The energy of recorded trips is that of a leader in an evaluation."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused
from page_blocks import blocks

import lcc_rl
from lcc_rl.cli.energy import main
from lcc_rl.config import load
from lcc_rl.energy import EnergyModel
from lcc_rl.envs import load_inputs
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import DataError
from lcc_rl.evaluation.metrics import energy_measures
from lcc_rl.runs.arguments import files_and_settings

COLUMNS = "leader.columns={drive: trip, time: t, speed: v}"
GRADED = ["leader.columns={drive: trip, time: t, speed: v, grade: slope}", "leader.units.grade=%"]
KMH = "leader.units.speed=km/h"
SECONDS = 60


class OfMap(EnergyModel):
    """A map that ends at 16 m/s."""

    mass = 1500.0

    def power(self, speed, acceleration):
        return torch.where(speed > 16.0, torch.nan, 1500.0 * acceleration * speed)


def made(step: float = 1.0) -> pd.DataFrame:
    """Two trips of a minute, the second one on a slope of 3 %."""
    time = np.arange(0.0, SECONDS + step / 2, step)
    speed = 12.0 + 8.0 * np.sin(0.1 * time), 18.0 - 6.0 * np.cos(0.2 * time)
    parts = [
        pd.DataFrame({"trip": name, "t": time, "v": own, "slope": slope})
        for name, own, slope in zip("ab", speed, (0.0, 3.0), strict=True)
    ]
    return pd.concat(parts, ignore_index=True)


@pytest.fixture
def path(tmp_path) -> str:
    made().to_csv(tmp_path / "trips.csv", index=False)
    return str(tmp_path / "trips.csv")


def test_the_energy_is_that_of_the_leaders_of_an_evaluation(path, subtests) -> None:
    for energy in ("bolt", "electric", "fuel", "compact", "alcc"):
        with subtests.test(energy):
            found = lcc_rl.trip_energies(path, [f"energy={energy}", COLUMNS])
            words = [f"leader.path={path}", COLUMNS, "leader.evaluation_share=1"]
            words = ["variant=direct", "leader=drives", *words, f"energy={energy}"]
            cfg = load("evaluate", [*words, f"scenario.horizon={10 * SECONDS}"])
            leaders, fleet = load_inputs(cfg).evaluation, build_energy(cfg)
            assert [*leaders.recordings] == found["trip"].tolist() == ["a", "b"]
            speed = torch.stack([leaders.record(i) for i in range(2)], 1)[..., None, None]
            power = fleet.power(speed[:-1], speed.diff(dim=0) / 0.1)
            expected = energy_measures(power, speed, torch.ones_like(power) > 0, 0.1, fleet)
            for key, unit in (("energy_kj", 1.0), ("net_energy_kj", 1.0), ("distance_m", 1e-3)):
                own = found[key.replace("_m", "_km")] if unit < 1 else found[key]
                np.testing.assert_allclose(own, unit * expected[key].flatten(), rtol=1e-5)
            ratio = found["energy_kj"] / 36.0 / found["distance_km"]
            np.testing.assert_allclose(found["kwh_per_100km"], ratio, rtol=1e-9)
            assert ("fuel_l" in found) == (energy in ("fuel", "compact"))


def test_a_grade_by_sample_is_that_of_the_model(path, subtests) -> None:
    for energy in ("electric", "fuel"):
        with subtests.test(energy):
            flat, steep = (
                lcc_rl.trip_energies(path, [f"energy={energy}", f"energy.grade={x}", COLUMNS])
                for x in (0.0, np.arctan(0.03))
            )
            found = lcc_rl.trip_energies(path, [f"energy={energy}", *GRADED])
            for column in ("energy_kj", "net_energy_kj"):
                expected = [flat[column][0], steep[column][1]]
                np.testing.assert_allclose(found[column], expected, rtol=1e-6)
            model = build_energy(load("evaluate", ["variant=direct", f"energy={energy}"])).models[0]
            drawn, net = (steep[x] - flat[x] for x in ("energy_kj", "net_energy_kj"))
            height = 1e3 * flat["distance_km"] * np.sin(np.arctan(0.03))
            work = model.mass * 9.81 * height / model.efficiency / 1e3
            if energy == "electric":  # speeds at the steps' starts
                np.testing.assert_allclose(drawn - net, work, rtol=5e-3)
            else:  # the model's own fuel for the grade, which is less at these speeds
                assert ((drawn - net) / work).between(0.9, 0.99).all()


def test_a_truck_uphill_has_the_net_energy_of_a_level_road() -> None:
    speed, still = torch.tensor([10.0, 15.0, 20.0]), torch.zeros(3)
    for vehicle in ("Class8Tractor", "Pickup", "Compact"):
        words = ["variant=direct", "energy=fuel", f"energy.vehicle={vehicle}"]
        (level,) = build_energy(load("evaluate", words)).models
        for grade in (0.02, 0.04, 0.06):
            uphill = level.at(torch.full((3,), grade))
            can = ~uphill.infeasible(speed, still)
            assert bool(can[0])
            net = uphill.path_power(speed, still)
            torch.testing.assert_close(
                net[can], level.path_power(speed, still)[can], rtol=0.05, atol=0
            )
            assert float(level.on(grade).climbing(torch.zeros(1))) == 0.0
            slow = torch.linspace(0.0, 0.2, 41)  # across the speed of idling
            paths = (x.path_power(slow, 0.0 * slow) for x in (level.on(grade), level))
            torch.testing.assert_close(*paths)
    for words in (["energy=fuel"], ["energy=electric", "energy.regeneration_limit=0"]):
        build_energy(load("evaluate", ["variant=direct", "energy.grade=-0.05", *words]))


def test_motion_beyond_a_model_is_said_and_a_power_without_number_is_refused(path, caplog) -> None:
    truck = ["energy=fuel", "energy.vehicle=Class8Tractor", COLUMNS]
    found = lcc_rl.trip_energies(path, truck)
    assert (found["share_infeasible"] > 0.1).all()
    assert "a drives beyond the model's power for" in caplog.text
    assert (lcc_rl.trip_energies(path, ["energy=bolt", COLUMNS])["share_infeasible"] == 0.0).all()
    own = [f"energy._target_={__name__}.OfMap", "trust=[test_trips]", COLUMNS]
    message = r"a: OfMap.power is nan at 16\.\d+ m/s and 0\.\d+ m/s², 5\.\d s after the start"
    with pytest.raises(DataError, match=message):
        lcc_rl.trip_energies(path, own)


def test_trips_of_files_rates_and_with_holes(tmp_path, path, subtests) -> None:
    whole = lcc_rl.trip_energies(path, ["energy=bolt", COLUMNS])
    for step in (0.1, 0.25, 1.0):
        with subtests.test(step=step):
            folder = tmp_path / f"{step}"
            folder.mkdir()
            for name, trip in made(step).groupby("trip"):
                trip.drop(columns="trip").to_parquet(folder / f"{name}.parquet")
            words = ["energy=bolt", "leader.columns={time: t, speed: v}"]
            found = lcc_rl.trip_energies(folder, words)
            assert found["trip"].tolist() == ["a", "b"]
            np.testing.assert_allclose(found["energy_kj"], whole["energy_kj"], rtol=5e-3)
    with subtests.test("a clock in single precision"):
        time = (0.1 * np.arange(4080)).astype("float32")
        pd.DataFrame({"t": time, "v": 10.0}).to_parquet(tmp_path / "one.parquet")
        found = lcc_rl.trip_energies(tmp_path / "one.parquet", words)
        assert found["duration_s"].tolist() == [407.9]
    with subtests.test("a hole"):
        trips = made()
        trips[~trips["t"].between(25.0, 33.0)].to_csv(path, index=False)
        found = lcc_rl.trip_energies(path, ["energy=bolt", COLUMNS])
        assert found["parts"].tolist() == [2, 2]
        assert (found["duration_s"] < SECONDS - 8).all()
        assert (found["duration_s"] == found["duration_s"].round(1)).all()
        assert (found["distance_km"] < whole["distance_km"]).all()


def test_averaged_speeds_are_those_of_leaders(path) -> None:
    plain, averaged = (
        lcc_rl.trip_energies(path, [COLUMNS, *words])["net_energy_kj"]
        for words in ([], ["leader.average_s=5"])
    )
    assert (averaged < plain).all()  # shorter, too, by the ends of the average


def test_the_command_prints_and_writes_the_trips(tmp_path, path, capsys, subtests) -> None:
    expected = lcc_rl.trip_energies(path, ["energy=fuel", COLUMNS])
    for name, read in (("x.csv", pd.read_csv), ("x.parquet", pd.read_parquet)):
        with subtests.test(name):
            main([path, COLUMNS, "energy=fuel", "--out", str(tmp_path / name)])
            assert "2 trips: 1.8 km" in capsys.readouterr().out
            pd.testing.assert_frame_equal(read(tmp_path / name), expected)


def test_trips_are_sorted_by_their_numbers(path) -> None:
    names = ["trip 10", "trip 2", "a", "1", "trip 2b"]
    pd.concat([made()[:61].assign(trip=name) for name in names]).to_csv(path, index=False)
    found = lcc_rl.trip_energies(path, ["energy=fuel", COLUMNS])
    assert found["trip"].tolist() == ["1", "a", "trip 2", "trip 2b", "trip 10"]
    assert files_and_settings(["a" * 300 + "=1", path]) == ([path], ["a" * 300 + "=1"])


def test_refused_trips(path) -> None:
    trips = made().assign(v_mps=1.0, slope_pct=0.0)
    faults = {
        "word": (trips.assign(v=trips["v"].astype(str).where(trips.index != 70, "x")), []),
        "fast": (trips.assign(v=3.6 * trips["v"]), []),
        "steep": (trips.assign(slope=15.0 * trips["slope"]), GRADED),
    }

    def call(*words: str) -> None:
        table, more = faults.get(words[0], (trips, list(words)))
        table.to_csv(path, index=False)
        lcc_rl.trip_energies(path, [COLUMNS, "energy=bolt", *more])

    check_refused(
        call,
        [
            ("word", r"trips\.csv: data row 71, column 'v' holds 'x'"),
            ("fast", r"trips\.csv: .*data row 1\d, column 'v' .*leader\.units\.speed"),
            ("seed=3", "seed=3 has no effect on the energy of given trips"),
            ("leader.fastest=9", "leader.fastest=9 has no effect on the energy of given trips"),
            ("energy=mixture", "a mixture has several models"),
            ("leader.columns.drive=id", "lacks the column id; it has trip, t, v, slope, v_mps, "),
            (GRADED[0], r"holds '3\.0'.*0\.3 rad; is it in % \(leader\.units\.grade=%\)\?"),
            ("leader.columns.grade=slope_pct", "'slope_pct' contains %, .*leader.units.grade=%"),
            (
                "leader.columns.speed=v_mps",
                KMH,
                "'v_mps' contains m/s, but it is read in km/h; set",
            ),
            ("steep", *GRADED, r"column 'slope' holds '45\.0'; .* 0\.3 rad, -30 to 30 in its unit"),
            (*GRADED, "energy=alcc", "PaperMotor has no grade"),
        ],
    )
    check_refused(
        lcc_rl.trip_energies,
        [
            (path, "energy=bolt", "trip_energies.overrides .*got 'energy=bolt'"),
            (3, [], r"trip_energies\.path"),
        ],
    )


def test_a_simulated_drive_on_hills_is_priced_as_the_pages_show(tmp_path, monkeypatch) -> None:
    pages = Path(__file__).parents[2] / "docs"
    (car,) = (x.text for x in blocks(pages / "your_car.md") if "class MyCar" in x.text)
    (hills,) = (x.text for x in blocks(pages / "energy.md") if "slope.points" in x.text)
    (tmp_path / "my_car.py").write_text(car)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names: dict = {}
    exec(hills, names)
    words = ["energy._target_=my_car.MyCar", *names["hills"][1:]]
    driven = lcc_rl.simulate("udds", "automated", "idm_acc", overrides=words, seconds=300)
    drive = driven.steps.query("vehicle == 1").assign(drive="car 1")
    drive.to_parquet("hills.parquet")
    words = [words[0], "leader.columns.grade=grade_rad"]
    found = lcc_rl.trip_energies("hills.parquet", words)["energy_kj"].item()
    flat = lcc_rl.trip_energies("hills.parquet", words[:1])["energy_kj"].item()
    speed, grade = (drive[name].to_numpy(float) for name in ("speed_mps", "grade_rad"))
    v, a, share = speed[:-1], np.diff(speed) / 0.1, sys.modules.pop("my_car").MAP.numpy()
    force = 110.0 + 1.2 * v + 0.42 * v**2 + 1650.0 * (1.04 * a + 9.81 * np.sin(grade[:-1]))
    by_force = [np.interp(abs(force), [0.0, 2000.0, 4000.0], row) for row in share]
    share = [
        np.interp(x, [0.0, 15.0, 30.0], row) for x, row in zip(v, np.array(by_force).T, strict=True)
    ]
    power = np.where(force > 0.0, force * v / share, force * v * share) + 400.0
    assert found == pytest.approx(power.sum() * 1e-4, rel=1e-4)
    assert abs(found - flat) > 0.01 * flat
    assert driven.vehicles["energy_kj"][1] == pytest.approx(found, rel=3e-3)
