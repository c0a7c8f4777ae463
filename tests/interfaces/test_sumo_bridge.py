"""Vehicles of SUMO driven by this package move as those of its own environment."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import check_refused, play
from torch import Tensor

from benchmarks import string
from lcc_rl.config import load
from lcc_rl.config.nodes import Node
from lcc_rl.data.profiles import from_records
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs import build_env
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.named import controller_of
from lcc_rl.evaluation.strategies import with_weights
from lcc_rl.interfaces.sumo import Bridge
from lcc_rl.pieces import Controller
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import Positive

libsumo = pytest.importorskip("libsumo", reason="extra sumo")
STEP, STEPS, LENGTH = 0.1, 600, 5.0
POLICY = "pretrained/i24-follow5"  # a memory, a filter, the acceleration ahead, the vehicle behind
HUMAN = {"_target_": "lcc_rl.pieces.IDM", "noise": 0.0, "desired_speed": 25.0, "time_gap": 1.2}


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    libsumo.close()


def leader_speed() -> Tensor:
    """Return a leader that slows down to a crawl and drives off again, ``[time + 1]`` [m/s]."""
    return 7.0 + 5.0 * torch.cos(torch.arange(STEPS + 1) * STEP / 6.0)


def own_motion(driver: str) -> tuple[Tensor, Tensor]:
    """Return speeds and gaps, ``[time + 1, 2]``, in this package's environment."""
    cfg = load("evaluate", ["variant=alcc", "task=i24-follow5", f"scenario.horizon={STEPS}"])
    drivers = {"human": Node.of(HUMAN, "human")}
    cfg = cfg.with_(scenario={"string": "automated human", "controllers": drivers})
    policy: Any = None
    if driver.startswith("pretrained"):
        weights, own = load_policy(driver)
        policy = with_weights(own, weights, own.seed, driver, bootstrap()).policy
        cfg = cfg.with_(observation=own.observation)
    else:
        drivers = {"automated": controller_of(driver)}
        cfg = cfg.with_(scenario={"controllers": drivers, "filters": {"automated": None}})
    profiles = from_records([leader_speed()], ["wave"], ["wave"], STEP)
    env = build_env(cfg, profiles, bootstrap(), 1, nominal=True)
    keys = [("vehicles", "speed"), ("vehicles", "gap")]
    first = env.reset()["vehicles", "gap"].flatten()
    speed, gap = (play(env, policy, None, keys)[0][key].flatten(1) for key in keys)
    return speed, torch.cat([first.unsqueeze(0), gap])


def start(
    folder: Path, cars: dict[str, tuple[float, float]], step: float = STEP, of_type: str = ""
) -> None:
    """Start SUMO on a ring of 10 km with vehicles at given places and speeds."""
    string.write_network(folder / "net.xml", 10_000.0)
    rows = [
        f'<vehicle id="{car}" type="t" depart="0" departPos="{place}" departSpeed="{speed}">'
        '<route edges="east west"/></vehicle>'
        for car, (place, speed) in cars.items()
    ]
    kind = f'<vType id="t" length="{LENGTH}" minGap="1.5" maxSpeed="40" speedDev="0"{of_type}/>'
    (folder / "cars.xml").write_text(f"<routes>{kind}{''.join(rows)}</routes>")
    words = ["sumo", "-n", f"{folder}/net.xml", "-r", f"{folder}/cars.xml", "--no-step-log"]
    words += ["--step-length", str(step), "--no-warnings"]
    words += [] if of_type else ["--step-method.ballistic", "true"]
    libsumo.start(words)
    libsumo.simulationStep()


# Rounding errors grow for a while where FollowerStopper switches between its regions.
@pytest.mark.parametrize(
    ("driver", "share"),
    [
        ("idm", 1.0),
        ("acc", 1.0),
        ("follower_stopper", 0.75),
        pytest.param(POLICY, 1.0, marks=pytest.mark.slow),
    ],
)
def test_it_moves_as_in_the_own_environment(driver, share, tmp_path) -> None:
    speeds, gaps = own_motion(driver)
    leader = leader_speed().tolist()
    front = 500.0 - LENGTH - gaps[0, 0].item()
    places = {"lead": 500.0, "own": front, "behind": front - LENGTH - gaps[0, 1].item()}
    first = [leader[0], *speeds[0].tolist()]
    start(tmp_path, dict(zip(places, zip(places.values(), first, strict=True), strict=True)))
    cars = libsumo.vehicle
    cars.setSpeedMode("lead", 0)
    bridges = [Bridge(driver, ["own"]), Bridge(HUMAN, ["behind"])]
    found = []
    for reached in [*leader[1:], leader[-1]]:
        found.append([cars.getSpeed("own"), cars.getSpeed("behind")])
        for bridge in bridges:
            bridge.command()
        cars.setSpeed("lead", reached)
        libsumo.simulationStep()
    difference = (torch.tensor(found) - speeds).abs()
    assert difference.flatten().quantile(share) < 1e-5
    assert speeds.amax() - speeds.amin() > 5.0


def test_with_nobody_ahead_in_sight_sumo_drives(tmp_path) -> None:
    start(tmp_path, {"lead": (500.0, 10.0), "own": (400.0, 10.0)})
    bridge = Bridge(POLICY, lambda car: car == "own", sight=100.0)
    for executed, mode in ((True, 0), (False, 31), (True, 0)):
        assert set(bridge.command(executed)) == {"own"}
        assert libsumo.vehicle.getSpeedMode("own") == mode
    libsumo.vehicle.setSpeedMode("lead", 0)
    libsumo.vehicle.setSpeed("lead", 30.0)
    for _ in range(100):
        libsumo.simulationStep()
        commanded = bridge.command()
    assert not commanded
    assert not bridge.driver.cars
    assert libsumo.vehicle.getSpeedMode("own") == 31
    libsumo.vehicle.setSpeed("lead", 0.0)
    while not bridge.command():
        libsumo.simulationStep()
    memory, ahead = bridge.driver.memory, bridge._measured("own")[3]
    assert memory[:, 1:5].tolist() == [pytest.approx([ahead] * 4)]  # it has begun anew
    libsumo.vehicle.remove("own")
    libsumo.simulationStep()
    assert not bridge.command()


def test_a_command_is_executed_beyond_what_sumo_thinks_safe(tmp_path) -> None:
    start(tmp_path, {"lead": (500.0, 10.0), "own": (480.0, 10.0)})
    hard = {"_target_": "lcc_rl.pieces.ConstantAcceleration", "acceleration": 3.0}
    bridge = Bridge(hard, ["own"])
    for _ in range(20):
        assert bridge.command() == {"own": 3.0}
        libsumo.simulationStep()
        assert libsumo.vehicle.getAcceleration("own") == pytest.approx(3.0)
    bridge.release()
    libsumo.simulationStep()
    assert libsumo.vehicle.getAcceleration("own") < 0.0


def test_sight_is_in_metres_ahead_and_behind(tmp_path) -> None:
    """SUMO finds neighbours on the same edge at any distance."""
    start(tmp_path, {"lead": (500.0, 10.0), "own": (440.0, 10.0), "behind": (380.0, 10.0)})
    for sight, present in ((100.0, 1.0), (56.0, 1.0), (54.0, None)):
        measured = Bridge("acc", "own", sight=sight)._measured("own")
        assert (measured and measured[-1]) == present
    libsumo.vehicle.moveTo("behind", "east_0", 370.0)
    assert Bridge("acc", "own", sight=56.0)._measured("own")[5:] == (0.0,) * 4


def test_an_action_step_that_changes_the_whole_simulation_is_named(tmp_path, caplog) -> None:
    cars = {"lead": (500.0, 10.0), "own": (480.0, 10.0)}
    start(tmp_path, cars, of_type=' actionStepLength="1"')
    Bridge("acc", "own")
    assert "actionStepLength of t exceeds the step of 0.1 s" in caplog.text


class Counting(Controller):
    gain: Positive = 0.1
    reads = ("self.gap",)
    remembers = ("steps",)

    def command(self, gap, steps):
        return self.gain * steps + 0.0 * gap, steps + 1.0


def steady(gap, speed):
    return 0.01 * gap - 0.02 * speed


def test_whatever_compare_takes_drives(tmp_path) -> None:
    start(tmp_path, {"lead": (500.0, 10.0), "own": (480.0, 10.0)})
    (tmp_path / "counting.yaml").write_text(f"_target_: {__name__}.Counting\ngain: 0.2\n")
    node = {"_target_": f"{__name__}.Counting"}
    alike = [Bridge(who, "own") for who in (Counting, node["_target_"], node, Counting(gain=0.1))]
    twice = Bridge(tmp_path / "counting.yaml", "own")
    for step in range(3):
        expected = pytest.approx(0.1 * step)
        assert [one.command(execute=False)["own"] for one in alike] == [expected] * len(alike)
        assert twice.command(execute=False)["own"] == pytest.approx(0.2 * step)
    assert Bridge(steady, "own").command()["own"] == pytest.approx(0.01 * 15.0 - 0.2, abs=1e-4)


def nobody_knows(gap, speed):
    return gap * float("nan")


def alone(gap, speed):
    return gap.mean()


@pytest.mark.slow
def test_sumo_is_imported_without_its_line_about_pyarrow() -> None:
    words = "import os; from lcc_rl.interfaces.sumo import load_sumo; load_sumo(); "
    words += "print(os.environ.get('LIBSUMO_AS_TRACI'))"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout == "None\n"


@pytest.mark.slow
@pytest.mark.parametrize("driver", [None, "pretrained/ring-22"])
def test_a_policy_keeps_a_wave_from_growing(driver, tmp_path) -> None:
    cfg = load("evaluate", ["variant=alcc", "task=ring-22"])
    string.start(cfg, tmp_path, cfg.scenario.circumference)
    bridge = Bridge(driver, "car0") if driver else None
    noise = np.random.default_rng(0)
    deviation = cfg.scenario.controllers["human"].made().wiener * STEP**0.5
    cars, names = libsumo.vehicle, [f"car{number}" for number in range(22)]
    for _ in range(6000):
        if bridge is not None:
            bridge.command()
        libsumo.simulationStep()
        for name in names[bridge is not None :]:  # SUMO's own drivers have no noise
            reached = cars.getSpeed(name) + deviation * noise.standard_normal()
            cars.setPreviousSpeed(name, max(reached, 0.0))
        assert libsumo.simulation.getCollidingVehiclesNumber() == 0
    spread = np.std([cars.getSpeed(name) for name in names])
    assert spread > 3.0 if driver is None else spread < 0.3


def test_bad_input_is_one_clear_error(tmp_path) -> None:
    start(tmp_path, {"lead": (500.0, 10.0), "own": (480.0, 10.0)})
    cases = [
        ("follow_stopper", "Did you mean 'follower_stopper'"),
        ({"_target_": "lcc_rl.pieces.CACC"}, "CACC reads self.gap_error, which is not measured"),
        (nobody_knows, r"nobody_knows.*: the command of own is nan at 0\.1 s"),
        (alone, r"alone writes .* \[\] .* expected \[1, 1\] .* per vehicle"),
    ]
    check_refused(lambda driver: Bridge(driver, ["own"]).command(), cases)
    libsumo.close()
    start(tmp_path, {"own": (400.0, 10.0)}, step=0.5)
    with pytest.raises(ConfigError, match=r"--step-length 0\.1"):
        Bridge("pretrained/ring-22", ["own"])
