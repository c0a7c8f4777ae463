"""Cars driven from outside are given the commands that the environment's cars are given."""

from __future__ import annotations

import pickle
import re
from dataclasses import replace
from functools import cache
from importlib.resources import files
from time import perf_counter
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers import POPULATION, check_refused, wavy_profiles
from page_blocks import ROOT, blocks

from lcc_rl.config import load
from lcc_rl.drivers.population import fixed
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError, Diverged
from lcc_rl.evaluation.strategies import baseline, trained
from lcc_rl.interfaces.driver import MEASURED, Driver
from lcc_rl.interfaces.sumo import Bridge
from lcc_rl.pieces import CBFFilter, Controller
from lcc_rl.pieces.base import SEED
from lcc_rl.results.policies import load_policy

POLICY = "pretrained/i24-follow5"  # a memory, a filter, the vehicle behind
CARS, STEPS, FIRST = 4, 80, 5
DRIVERS = (POLICY, "pretrained/i24-mixed", "idm_acc_filtered", "pi_saturation", "idm", "mpc")
VIEWS = {"self": ("vehicles", 0), "ahead": ("leader", 0), "behind": ("vehicles", 1)}


@cache
def driven(driver: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return what the cars of an environment measure before each step, and their commands."""
    words = ["variant=alcc", f"scenario.horizon={STEPS}", "+filter=cbf"]
    cfg = load("evaluate", words)
    if driver.startswith("pretrained"):
        strategy = trained(cfg, driver, load_policy(driver), POPULATION)
        filters = {"automated": None, **strategy.own.scenario.filters}
        strategy = replace(strategy, cfg=strategy.cfg.with_(scenario={"filters": filters}))
    else:
        strategy = baseline(cfg, driver)
    env = build_env(strategy.cfg, wavy_profiles(), POPULATION, CARS, nominal=True)
    start = env.reset().select(SEED)
    start[SEED] = FIRST + torch.arange(CARS).unsqueeze(-1)
    with torch.no_grad():
        data = env.rollout(
        STEPS, strategy.policy, tensordict=env.reset(options=start), auto_reset=False,
        break_when_any_done=False,
    )  # fmt: skip
    measured = {
        f"{view}.{entry}": data[space, entry].flatten(2)[..., place].numpy().T
        for view, (space, place) in VIEWS.items()
        for entry in ("speed", "gap", "acceleration")
        if (view, entry) != ("ahead", "gap")
    }
    return measured, data["next", "automated", "command"].flatten(2)[..., 0].numpy().T


def at(step: int, measured: dict[str, np.ndarray], cars=slice(None)) -> dict[str, np.ndarray]:
    return {name: values[step][cars] for name, values in measured.items()}


@pytest.mark.parametrize("name", DRIVERS)
def test_cars_are_commanded_as_those_of_the_environment(name) -> None:
    measured, commands = driven(name)
    driver = Driver(name, 0.1, seed=FIRST)
    found = [driver.step(at(step, measured)) for step in range(STEPS)]
    np.testing.assert_allclose(found, commands, atol=2e-4)
    assert np.ptp(commands) > 0.5
    # A car alone, by numbers, is commanded as one of several.
    alone = Driver(name, 0.1, seed=FIRST + 2)
    for step in range(STEPS):
        one = alone.step({key: float(x) for key, x in at(step, measured, 2).items()})
        assert isinstance(one, float)
        assert one == pytest.approx(found[step][2], abs=1e-5)


def test_cars_come_and_go_and_begin_anew() -> None:
    measured, _ = driven(POLICY)
    whole, driver, fresh = (Driver(POLICY, 0.1) for _ in range(3))
    for step in range(30):
        expected = whole.step(at(step, measured))
        order = [0, 1, 2, 3] if step % 2 else [3, 0, 2, 1]
        # Car 1 leaves for a while, car 3 is reset when it returns.
        present = [car for car in order if car != 1 or not 10 <= step < 20]
        if step == 20:
            driver.reset(["car3"])
        found = driver.step(at(step, measured, present), [f"car{car}" for car in present])
        began = [1, 3] if step >= 20 else []
        anew = fresh.step(at(step, measured, began), began)
        for car, command, kept in zip(present, found, driver.memory, strict=True):
            own, past = (anew, fresh) if car in began else (expected, whole)
            place = list(past.cars).index(car)
            assert command == pytest.approx(own[place], abs=1e-5)
            np.testing.assert_allclose(kept, past.memory[place], rtol=1e-5)
    assert (abs(whole.memory[[1, 3]] - fresh.memory) > 0.01).any(1).all()
    assert driver.step({name: [] for name in driver.names}, []).shape == (0,)


def test_a_person_who_leaves_and_returns_is_the_same_person(tmp_path) -> None:
    table = tmp_path / "drivers.parquet"
    table.write_bytes((files("lcc_rl.assets") / "i80_drivers.parquet").read_bytes())
    driver = pickle.loads(pickle.dumps(Driver("human", 0.1, drivers=table)))
    seen = {"self.speed": 12.0, "self.gap": 20.0, "ahead.speed": 11.0}
    two = {name: [value] * 2 for name, value in seen.items()}
    first = driver.step(two, ["a", "b"])
    assert first[0] != first[1]
    driver.step({name: [value] for name, value in seen.items()}, ["b"])
    assert driver.step(two, ["a", "b"])[0] == first[0]


def test_one_bad_sample_is_held_and_a_car_begins_anew_after_more() -> None:
    measured, _ = driven(POLICY)
    driver, whole, fresh = (Driver(POLICY, 0.1) for _ in range(3))
    for step in range(12):
        given = at(step, measured)
        expected = whole.step(given)
        if step in (5, 6, 7):
            given["ahead.speed"] = np.where([0, 1, 0, 0], np.nan, given["ahead.speed"])
        found = driver.step(given)
        if step > 7:
            expected[1] = fresh.step(at(step, measured, [1]))[0]
        np.testing.assert_allclose(found[[0, 2, 3]], expected[[0, 2, 3]], atol=1e-5)
        near = 0.3 if step == 5 else 1e-5  # it computes with measurements of a step before
        assert found[1] == pytest.approx(-3.0 if step in (6, 7) else expected[1], abs=near)


STEADY = {
    **dict.fromkeys(("self.speed", "ahead.speed", "behind.speed"), 15.0),
    "self.gap": 40.0,
    "behind.gap": 25.0,
    "behind.present": 1.0,
    **dict.fromkeys(("self.acceleration", "ahead.acceleration", "behind.acceleration"), 0.0),
}


@pytest.mark.parametrize("name", [POLICY, "idm_acc_filtered", "pretrained/alcc_limits"])
def test_faults_and_other_targets(name, subtests) -> None:
    """The command during a fault and after it, from step 10 on, against that without a fault."""
    driver, anew = (Driver(name, 0.1) for _ in range(2))
    usual = [driver.step(STEADY) for _ in range(30)]
    zeros, lost = dict.fromkeys(STEADY, 0.0), {"self.gap": 0.0, "ahead.speed": 0.0}
    cases = [
        ("a sample of zeros", zeros, 1, usual[0]),
        ("no target for a sample", lost, 1, usual[0]),
        ("a NaN", {"self.speed": np.nan}, 1, usual[0]),
        ("no target for three samples", lost, 3, -3.0),
        ("a rear radar fails", {"behind.gap": np.nan}, 3, None),
        ("no rear radar", {x: np.nan for x in STEADY if x.startswith("behind")}, 3, None),
        ("a vehicle cuts in", {"self.gap": 28.0}, 20, None),
        ("a vehicle cuts out", {"self.gap": 46.0}, 20, None),
    ]
    for what, fault, count, expected in cases:
        with subtests.test(what):
            driver.reset()
            anew.reset()
            steps = [STEADY | fault if 10 <= k < 10 + count else STEADY for k in range(30)]
            found = np.array([driver.step(x) for x in steps])
            during, after = found[10 : 10 + count], found[10 + count + 1 :]
            np.testing.assert_allclose(after, usual[11 + count :], atol=0.02)
            if expected is not None:
                assert during[-1] == pytest.approx(expected, abs=1e-4)
            else:  # as a car that begins then
                np.testing.assert_allclose(during, anew.step(STEADY | fault), atol=0.05)


def test_a_driver_keeps_the_margin_of_its_filter_behind_a_car_at_standstill() -> None:
    for name in (POLICY, "pretrained/i80-follow", "idm_acc_filtered"):
        for margin in (None, 2.0):
            driver = Driver(name, 0.1, safety=None if margin is None else {"margin": margin})
            speed, gap = 15.0, 80.0
            for _ in range(900):
                command = driver.step(
                    STEADY | {"ahead.speed": 0.0, "self.speed": speed, "self.gap": gap}
                )
                reached = max(speed + 0.1 * command, 0.0)
                speed, gap = reached, gap - 0.05 * (speed + reached)
            assert speed < 0.05
            assert gap >= (margin or 0.2) - 0.01


def test_brakes_and_drive_are_those_of_the_car() -> None:
    near = STEADY | {"ahead.speed": 2.0, "self.speed": 15.0, "self.gap": 12.0}
    far = STEADY | {"ahead.speed": 15.0, "self.speed": 2.0, "self.gap": 300.0}
    limits = {"max_braking": 6.0, "max_acceleration": 1.5}
    for name in (POLICY, "idm_acc_filtered"):
        usual, own = Driver(name, 0.1), Driver(name, 0.1, limits=limits)
        assert usual.step(near) == pytest.approx(-3.0)
        assert own.step(near) == pytest.approx(-6.0)
        assert own.step(far, ["other"]) <= 1.5 + 1e-6


def test_without_a_vehicle_behind() -> None:
    measured, _ = driven(POLICY)
    here = at(0, measured)
    without = {name: x for name, x in here.items() if not name.startswith("behind")}
    like_own = without | {"behind.speed": here["self.speed"], "behind.gap": here["self.gap"]}
    names = [here | {"behind.present": [1, 0, 0, 1]}, without, like_own, here]
    driver, found = Driver(POLICY, 0.1), []
    for given in names:
        driver.reset()
        found.append(driver.step(given))
    some, none, assumed, every = found
    np.testing.assert_array_equal(none, assumed)
    np.testing.assert_array_equal(some, np.where([True, False, False, True], every, none))
    assert (none != every).all()


def hold(gap, speed):
    return 0.1 * (gap - 30.0) + 0.0 * speed


def by_numpy(gap):
    return torch.as_tensor(0.1 * np.asarray(gap) - 1.0)


def nothing(gap):
    return gap * float("nan")


def test_a_rule_of_ones_own_drives_behind_a_filter_of_ones_own() -> None:
    near = {"self.speed": 20.0, "self.gap": 40.0, "ahead.speed": 15.0, "ahead.acceleration": 0.0}
    assert Driver(hold, 0.1).step({"self.speed": 20.0, "self.gap": 40.0}) == pytest.approx(1.0)
    found = [
        Driver(who, 0.1, safety=CBFFilter(time_to_collision=shortest)).step(near)
        for who, shortest in [(hold, 4.0), (hold, 6.0), (f"{__name__}.hold", 6.0)]
    ]
    assert found[2] == found[1] < -1.0 < found[0]
    assert Driver(f"{__name__}.hold_filtered", 0.1).step(near) == found[0]
    driver = Driver(by_numpy, 0.5)
    assert [driver.step({"self.gap": gap}) for gap in (20.0, 30.0)] == pytest.approx([1.0, 2.0])


def test_own_drivers_drive_as_people_do() -> None:
    """They react late to what was, by their own time gap; other drivers command something else."""
    start, later = {"self.speed": 12.0, "self.gap": 20.0, "ahead.speed": 13.0}, {"self.gap": 9.0}
    people = Driver("human", 0.1, drivers=fixed(45.0, 0.83, reaction_delay=0.3))
    found = [people.step(start | (later if step else {})) for step in range(5)]
    assert max(found[:4]) == pytest.approx(min(found[:4]), rel=0.05)  # noise is up to 5 %
    assert found[4] < 0.6 * found[0]
    gentle = Driver("human", 0.1, drivers=fixed(45.0, 2.0))
    assert gentle.step(start) < found[0] - 0.3
    with pytest.raises(ConfigError, match=f"drivers needs a rule; {POLICY} is a policy"):
        Driver(POLICY, 0.1, drivers=POPULATION)


def test_bad_input_is_one_clear_error() -> None:
    making = [
        (POLICY, 0.2, "trained with steps of 0.1 s"),
        ("cacc tuned", 0.1, "cacc tuned reads self.gap_error, which is not measured here, only"),
        ("pretrained/hcfs", 0.2, "pretrained/hcfs reads .*, which is not measured here, only"),
        ("idm_ac", 0.1, "Did you mean 'idm_acc'"),
        *((x, 0, "time_step must be greater than or equal to 0.001") for x in ("idm_acc", POLICY)),
        ("idm_acc", None, "time_step must be a valid number, .*got None"),
        ("idm_acc", 0.1, (), {"margin": 2.0}, "idm_acc has no safety filter whose settings"),
        (POLICY, 0.1, (), {"margins": 2.0}, "Did you mean 'margin'"),
        (POLICY, 0.1, (), None, 0, None, {"max_brake": 6}, "Did you mean 'max_braking'"),
        *(("human", 0.1, (), None, x, "seed must be a whole") for x in (-1, 2**40, 0.5, None)),
    ]
    check_refused(Driver, making, ConfigError)
    given = {"self.speed": 9.0, "self.gap": 20.0, "ahead.speed": 9.0}
    steps = [
        ({"self.speed": 9.0}, None, r"idm_acc reads self.gap, which is not given: gap .* \[m\]"),
        (given | {"self.gaps": 1.0}, None, "Did you mean 'self.gap'"),
        (given | {"self.gap": [1.0, 2.0]}, ["a"], "cars must be 2 different"),
        (given, ["a", "a"], "cars must be 1 different ids"),
        (given | {"self.gap": [[1.0], [2.0]]}, None, "arrays of one length"),
        (given | {"self.gap": [1.0, 2.0], "self.speed": [1.0]}, None, "arrays of one length"),
        ([1.0, 2.0], None, "measured must name measurements, such as self.gap, got list"),
        *(
            (given | {"self.gap": x}, None, "measured must hold numbers")
            for x in ("near", 1j, [1j], 10**400, None, torch.ones(1, requires_grad=True))
        ),
        (given | {"self.gap": [1.0, 2.0]}, "ab", "cars must be a list of ids, got 'ab'"),
        (given, [[1]], "cars must be a list of ids: unhashable type: 'list'"),
    ]
    driver = Driver("idm_acc", 0.1)
    check_refused(driver.step, steps, ConfigError)
    check_refused(driver.reset, [("car12", "cars must be a list of ids"), ([[1]], "list")])
    people = Driver("human", 0.1)
    people.step(given, ["car1"])
    check_refused(people.reset, [("car12", "cars must be a list of ids, got 'car12'")], ConfigError)
    more = {name: [x, x] for name, x in given.items()}  # with the ids of the step before
    check_refused(people.step, [(more, ["car1"], "cars must be 2 different ids")], ConfigError)
    assert list(people.cars) == ["car1"]
    with pytest.raises(Diverged, match="nothing: the command of car7 is nan"):
        Driver(nothing, 0.1).step({"self.gap": [1.0]}, ["car7"])


def test_no_driver_takes_a_measurement_that_is_no_number() -> None:
    """Behind a filter it brakes; without one a command that depends on it ends in one error."""
    given = dict.fromkeys(MEASURED, np.full(2, 12.0))
    for name in ("follower_stopper", "constant", "ovm", "idm_acc", "human", "pretrained/alcc"):
        driver = Driver(name, 0.1)
        for entry in driver.names:
            bad = {**given, entry: np.array([12.0, np.nan])}
            if entry.startswith("behind."):  # a vehicle like the own one
                assert np.ptp(driver.step(bad)) < 1e-5
                driver.reset()
                continue
            if (name, entry) in (("constant", "self.speed"), ("ovm", "ahead.speed")):
                found = driver.step(bad)  # it does not depend on it
                driver.reset()
                np.testing.assert_array_equal(found, driver.step(given))
                driver.reset()
                continue
            with pytest.raises(Diverged, match=f"{re.escape(entry)} is nan in row 1 of the cars"):
                driver.step(bad)
            assert len(driver.cars) == len(driver.memory) == 0
    with pytest.raises(Diverged, match=r"alcc: self\.gap is inf in row 1 of the cars"):
        driver.step({**given, "self.gap": np.array([12.0, np.inf])})
    for name in (POLICY, "idm_acc_filtered", "pretrained/i80-follow"):
        driver = Driver(name, 0.1)
        for k, entry in enumerate(driver.names):
            bad = (np.nan, np.inf, -np.inf)[k % 3]
            driver.reset()
            found = driver.step({**given, entry: np.array([12.0, bad])})
            rear = entry.startswith("behind.")
            assert found[1] == pytest.approx(found[0] if rear else -3.0), (name, entry)
            assert found[0] > -3.0


class Careful(Controller):
    """Holds its last command over a gap that is no number."""

    reads = ("self.gap",)
    remembers = ("last",)

    def command(self, gap, last):
        wanted = torch.where(gap.isfinite(), 0.1 * (gap - 30.0), last)
        return wanted, wanted


class Mean(Careful):
    """Keeps a mean of its gaps, which an infinite gap spoils."""

    def command(self, gap, last):
        mean = 0.5 * (gap + last)
        return 0.1 * (mean - 30.0), mean


def test_a_controller_of_ones_own_handles_a_nan_as_in_the_exported_program() -> None:
    cases = [
        (Careful, [20.0, np.nan, np.nan, 40.0], [-1.0, -1.0, -1.0, 1.0]),
        (Mean, [20.0, np.inf, 40.0, -np.inf, 40.0], [-2.0, 3.0, -1.0, -3.0, -1.0]),  # begins anew
    ]
    for rule, gaps, commands in cases:
        driver, program, memory = Driver(rule, 0.1), Driver(rule, 0.1).program, torch.zeros(1, 2)
        for gap, wanted in zip(gaps, commands, strict=True):
            command, memory = program(torch.tensor([[gap]]), memory)
            assert driver.step({"self.gap": gap}) == pytest.approx(float(command)) == wanted


def test_a_bridge_names_the_time_of_a_measurement_or_command_that_is_no_number(monkeypatch) -> None:
    """With a simulation whose one car measures a speed of NaN, without SUMO."""
    cars = SimpleNamespace(
        getIDList=lambda: ("car7", "lead"),
        getLeader=lambda car, sight: ("lead", 12.0),
        getFollower=lambda car, sight: None,
        getMinGap=lambda car: 1.5,
        getSpeed=lambda car: float("nan") if car == "lead" else 9.0,
        getAcceleration=lambda car: 0.0,
    )
    clock = SimpleNamespace(getDeltaT=lambda: 0.1, getTime=lambda: 4.2)
    sumo = SimpleNamespace(isLoaded=lambda: True, simulation=clock, vehicle=cars)
    sumo.vehicletype = SimpleNamespace(getIDList=tuple)
    monkeypatch.setattr("lcc_rl.interfaces.sumo.load_sumo", lambda: sumo)
    cases = [
        ("idm_acc", r"ahead\.speed is nan in row 0 of the cars.* at 4\.2 s"),
        (nothing, r"nothing: the command of car7 is nan at 4\.2 s"),
    ]
    check_refused(lambda driver: Bridge(driver, ["car7"]).command(), cases, Diverged)


def test_the_example_of_the_page_prints_what_it_shows(capsys) -> None:
    page = blocks(ROOT / "docs" / "interfaces.md")
    (place,) = (n for n, block in enumerate(page) if "import Driver" in block.text)
    assert len([line for line in page[place].text.splitlines() if line.strip()]) <= 25
    exec(page[place].text, {})
    assert capsys.readouterr().out == page[place + 1].text


@pytest.mark.slow
@pytest.mark.parametrize("name", [POLICY, "idm_acc_filtered"])
def test_a_step_of_one_car_takes_less_than_100_microseconds(name) -> None:
    driver = Driver(name, 0.1)
    measured = {
        key: float(x) for key, x in at(0, driven(name)[0], 0).items() if key in driver.names
    }
    times = []
    for _ in range(2000):
        before = perf_counter()
        driver.step(measured)
        times.append(perf_counter() - before)
    assert np.quantile(times, 0.25) < 1e-4
