"""A road with slopes: places, energies and motion."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import POPULATION, check_refused, wavy_profiles

import lcc_rl
from lcc_rl.config import load
from lcc_rl.energy import ElectricCar, Fleet
from lcc_rl.envs import Inputs, build_env
from lcc_rl.envs.checks import ADDED_BY
from lcc_rl.envs.step import pieces_of
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.pieces import Controller, Slope
from lcc_rl.pieces.base import OBSERVATION
from lcc_rl.pieces.world import World

POINTS = [(0.0, 0.0), (200.0, 0.04), (450.5, -0.03), (700.0, 0.0)]
ROAD = f"scenario.pieces.slope.points={[list(point) for point in POINTS]}"
HILLS = ["energy=electric", "+slope=hills", "drivers=highway", ROAD]
LEADS = [("leader", "leader", 0.04)]  # its path power has no jumps
WAVE = 15.0 + 4.0 * np.sin(np.arange(801) / 30.0)


def grades(place: np.ndarray) -> np.ndarray:
    """Return the grades of :data:`POINTS` at places."""
    return np.interp(np.mod(place, 700.0), *np.array(POINTS).T)


def test_energies_count_the_grade_at_the_place_of_each_vehicle() -> None:
    found = lcc_rl.simulate(WAVE, "automated human*2", "idm_acc", overrides=HILLS)
    level = lcc_rl.simulate(WAVE, "automated human*2", "idm_acc", overrides=["drivers=highway"])
    pairs = (found.steps[x] - level.steps[x] for x in ("speed_mps", "gap_m"))
    assert all(not (difference.abs() > 0.0).any() for difference in pairs)
    car, begin = ElectricCar(), 0.0
    for vehicle, drive in found.steps.groupby("vehicle"):
        speed, gap = drive["speed_mps"].to_numpy(float), drive["gap_m"].iloc[0]
        begin -= 0.0 if vehicle == 0 else 5.0 + gap
        place = begin + np.append(0.0, 0.05 * (speed[1:] + speed[:-1]).cumsum())
        np.testing.assert_allclose(drive["place_m"], place, atol=2e-3)
        slope = grades(place)
        np.testing.assert_allclose(drive["grade_rad"], slope, atol=1e-4)
        acceleration, force = np.diff(speed) / 0.1, car.mass * 9.81
        force = force * (car.rolling * np.cos(slope[1:]) + np.sin(slope[1:]))
        force += car.inertia * acceleration + car.resistance * speed[:-1] ** 2
        wheels, fade = force * speed[:-1], np.minimum(speed[:-1] / car.fade_speed, 1.0)
        power = wheels.clip(0.0) / car.efficiency + car.auxiliary
        power -= (-wheels).clip(0.0, car.regeneration_limit) * fade * car.efficiency
        np.testing.assert_allclose(drive["power_w"].iloc[1:], power, rtol=2e-3, atol=60.0)
        row = found.vehicles.loc[vehicle]
        assert row["energy_kj"] == pytest.approx(1e-4 * power.sum(), rel=1e-3)
        height = 1e-4 * (np.sin(slope[1:]) * speed[:-1]).sum() * car.mass * 9.81
        moving = 5e-4 * car.inertia * (speed[-1] ** 2 - speed[0] ** 2)
        net = row["energy_kj"] - (height + moving) / car.efficiency
        assert row["path_energy_kj"] == pytest.approx(net, rel=1e-3)


def test_places_stay_exact_for_an_hour() -> None:
    slope = Slope(points=POINTS, repeats=True).bind(
        World(time_step=0.02, energy=Fleet({"all": ElectricCar()})), "leader"
    )
    speed, place, rest = torch.tensor([33.3]), torch.zeros(1), torch.zeros(1)
    for _ in range(180_000):
        place, _, rest = slope.compute(place, rest, speed, speed)
    assert place.item() == pytest.approx(3600.0 * speed.item(), abs=0.05)


def test_an_evaluation_counts_the_same(subtests) -> None:
    words = ["variant=alcc", "evaluation.baselines=[]", "evaluation.warm_up=0", *HILLS]
    cfg = load("evaluate", [*words, "scenario.horizon=399"]).with_(compare=["idm_acc"])
    profiles = wavy_profiles()
    inputs = Inputs(profiles, profiles, POPULATION)
    rows, _ = evaluate(Entrants(cfg).strategies(inputs)[-1], inputs, 1, 64, 0)
    leader = profiles.record(0).numpy()
    string = "automated human"
    hills, flat = (
        lcc_rl.simulate(leader, string, "idm_acc", POPULATION, words).vehicles.set_index("role")
        for words in ([*HILLS[:2], ROAD], HILLS[:1])
    )
    for name, role, share in (("cav", "automated", 0.0), ("hdv", "human", 0.0), *LEADS):
        with subtests.test(role):
            energy = hills["path_energy_kj"][role]
            assert rows[f"{name}_path_energy_kj"][0] == pytest.approx(energy, rel=1e-4 + share)
            assert abs(energy / flat["path_energy_kj"][role] - 1.0) > 0.05


def test_machine_code_drives_the_same_hills(caplog) -> None:
    leader = np.concatenate([WAVE, WAVE[::-1], WAVE])
    compiled = lcc_rl.simulate(leader, "human*2", overrides=HILLS).steps
    assert "runs by tensors" not in caplog.text
    plain = lcc_rl.simulate(leader[:1001], "human*2", overrides=HILLS).steps
    for name in ("place_m", "grade_rad", "power_w"):
        np.testing.assert_allclose(
            compiled[name][: len(plain)], plain[name], rtol=1e-4, atol=1e-3 + (name[0] == "p") * 0.1
        )


def test_trucks_slow_down_uphill() -> None:
    hills = ["energy=compact", "+slope=hills", "drivers=highway", "+fleet=trucks"]
    found = lcc_rl.simulate(
        [25.0] * 1001, "human", overrides=[*hills, "scenario.fleet.truck.share=1"]
    )
    assert found.steps.query("vehicle == 1")["speed_mps"].min() < 24.0
    assert found.vehicles["share_infeasible"].max() == 0.0


def test_a_share_of_the_slope_may_act_on_the_motion() -> None:
    word = "+scenario.actuators.{}={{_target_: lcc_rl.pieces.Actuation, slope: {}}}"
    string, up = "automated human", "scenario.pieces.slope.points=[[0, 0.03], [5000, 0.03]]"
    held, felt = (
        lcc_rl.simulate(
            [15.0] * 601, string, "idm_acc", overrides=[*HILLS[:3], up, word.format("human", share)]
        ).vehicles.set_index("role")
        for share in (0.0, 0.5)
    )
    assert felt["mean_gap_m"]["human"] > held["mean_gap_m"]["human"] + 0.5
    assert felt["mean_gap_m"]["automated"] == held["mean_gap_m"]["automated"]
    first = 0.5 * 9.81 * np.sin(0.03)
    steps = lcc_rl.simulate(
        [15.0] * 3, "human", overrides=[*HILLS[:3], up, word.format("human", 0.5)]
    ).steps
    level = lcc_rl.simulate([15.0] * 3, "human", overrides=[*HILLS[:3], up]).steps
    column = steps["acceleration_mps2"] - level["acceleration_mps2"]
    assert column[steps["time_s"] == 0.1].iloc[-1] == pytest.approx(-first, rel=1e-4)
    behind = [*HILLS, "+filter=cbf", word.format("automated", 0.5)]
    cases = [
        ("human", None, [word.format("human", 0.5)], "needs a slope"),
        ("automated", {"a_filtered": "idm_acc"}, behind, "the safety filter knows no slopes"),
    ]
    check_refused(lambda *x: lcc_rl.simulate([15.0] * 9, *x[:2], overrides=x[2]), cases)


def test_a_preview_is_the_grade_ahead() -> None:
    cfg = load("train", ["variant=alcc", "scenario.horizon=300", *HILLS, "+knowledge=terrain"])
    env = build_env(cfg, wavy_profiles(), POPULATION, 3, seed=0)
    moments = env.rollout(60)
    place = moments["vehicles", "place"][..., :1, :].numpy()
    seen = moments[OBSERVATION][..., -4:].numpy() / 20.0
    ahead = place + np.array([0.0, 50.0, 100.0, 200.0])
    np.testing.assert_allclose(seen, grades(ahead), atol=1e-4)
    assert abs(seen).max() > 0.01


def test_the_objective_is_the_path_energy() -> None:
    term = "+reward.terms.path={_target_: lcc_rl.pieces.PathEnergy, scale: 1000.0}"
    cfg = load("train", ["variant=alcc", "scenario.horizon=300", *HILLS, term])
    env = build_env(cfg, wavy_profiles(), POPULATION, 2, seed=0)
    after = env.rollout(50)["next"]
    speed, power = (after["vehicles", x][..., :1, :] for x in ("speed", "power"))
    acceleration = after["vehicles", "acceleration"][..., :1, :]
    before = speed - 0.1 * acceleration
    car, slope = ElectricCar(), after["vehicles", "grade"][..., :1, :]
    lifted = car.mass * 9.81 * slope.sin() + car.inertia * acceleration
    expected = -1e-4 * (power - lifted * before / car.efficiency)
    torch.testing.assert_close(
        after["automated", "reward_terms", "path"], expected, rtol=1e-4, atol=1e-4
    )


def test_roads_that_are_refused() -> None:
    cases = [
        (["scenario=ring"], "an open road"),
        (["energy=alcc"], "PaperMotor has no grade"),
        (["scenario.pieces.slope.points=[[0,0],[0,0.1]]"], "must begin with 0 and increase"),
        (["scenario.pieces.slope.points=[[0,0],[5,1]]"], "less than or equal to 0.3"),
    ]
    check_refused(lambda words: lcc_rl.make_env("alcc", 2, [*HILLS[:3], *words]), cases)
    check_refused(lambda x: lcc_rl.make_env("alcc", 2, [x]), [("+knowledge=terrain", "needs a sl")])


class Uphill(Controller):
    """Reads what a slope writes."""

    reads = ("self.speed", "self.grade")

    def command(self, speed, grade):
        return 0.1 * (20.0 - speed) - grade


class Ahead(Uphill):
    reads = ("self.speed", "terrain.grade")


def test_the_option_that_adds_an_entry_is_named() -> None:
    cases = [(Uphill, r"writes; \+slope=hills adds"), (Ahead, r"\+slope=hills \+knowledge=terrain")]
    check_refused(lambda kind: lcc_rl.simulate([9.0] * 50, "automated", kind()), cases)
    for options in ADDED_BY.values():  # each adds all entries for which it stands
        words = ["energy=electric", "scenario.string=automated human automated", *options.split()]
        written = {name for name, said in ADDED_BY.items() if said == options}
        env = lcc_rl.make_env("alcc", 2, words)
        keys = [key for piece in pieces_of(env) for key in piece.entries]
        assert written <= {".".join(key) for key in keys} | {key[0] for key in keys}, options


def test_a_profile_need_not_repeat() -> None:
    world = World(profiles=wavy_profiles(), energy=Fleet({"all": ElectricCar()}))
    odd = Slope(points=((0.0, 0.0), (2.5, 0.01)), repeats=True).bind(world, "vehicles")
    assert odd.grade_at(torch.tensor([2.0, 3.75, -1.0])).tolist() == pytest.approx(
        [0.008, 0.005, 0.006], abs=1e-6
    )
    slope = Slope(points=tuple(POINTS)).bind(world, "vehicles")
    place = torch.tensor([-50.0, 0.0, 100.0, 700.0, 9e5])
    assert slope.grade_at(place).tolist() == pytest.approx([0.0, 0.0, 0.02, 0.0, 0.0], abs=1e-6)
