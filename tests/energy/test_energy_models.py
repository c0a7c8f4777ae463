"""Energy models against published figures and their own parts."""

from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.interpolate import PchipInterpolator

from lcc_rl.config import load
from lcc_rl.energy import CirclesFuel, ElectricCar, EnergyModel, PaperMotor
from lcc_rl.energy.fuel import TRUCKS, coefficients
from lcc_rl.envs.inputs import build_energy

POINTS = Path(__file__).parent / "circles_fuel_check_points.csv"
MODELS: dict[str, EnergyModel] = {
    "motor": PaperMotor(),
    "electric": ElectricCar(),
    **{name: CirclesFuel(vehicle=name) for name in coefficients()},
}
# Label figures of FASTSim's vehicle files, city and highway [kWh/mile].
LABELS = {"electric": (0.265, 0.331), "bolt": (0.263, 0.306)}
BOLT = {"mass": 1758.0, "drag": 0.29, "area": 2.845, "rolling": 0.0073, "regeneration_limit": 7e4}
CARS = {"electric": ElectricCar(), "bolt": ElectricCar(**BOLT)}
# A label counts 70 % of the range of the laboratory, and 86 % of the socket reaches the battery.
LABORATORY, CHARGER, MILE = 0.7, 0.86, 1.609344


@pytest.mark.parametrize("vehicle", coefficients())
def test_fuel_equals_the_published_model_at_its_check_points(vehicle) -> None:
    points = pd.read_csv(POINTS)
    points = points[points["vehicle"] == vehicle]
    assert len(points) == 13
    for grade, part in points.groupby("grade_rad"):
        model = CirclesFuel(vehicle=vehicle, grade=grade)
        motion = [
            torch.tensor(part[name].to_numpy()) for name in ("speed_mps", "acceleration_mps2")
        ]
        torch.testing.assert_close(
            model.fuel(*motion), torch.tensor(part["fuel_g_per_s"].to_numpy()), atol=1e-5, rtol=0.0
        )
        assert model.infeasible(*motion).tolist() == part["infeasible"].astype(bool).tolist()


FAST = torch.linspace(25.0, 45.0, 201, dtype=torch.float64)
MIXTURE = build_energy(load("train", ["energy=mixture"]))


@pytest.mark.parametrize("grade", [0.0, 0.03])
def test_faster_never_takes_less_per_km(grade) -> None:
    models = MODELS | {
        f"mixture.{x}": y for x, y in zip(MIXTURE.names, MIXTURE.models, strict=True)
    }
    for name, model in models.items():
        model = replace(model, grade=grade) if hasattr(model, "grade") else model
        steady = model.power(FAST, torch.zeros_like(FAST)) / FAST
        assert (steady.diff() > 0.0).all(), name
        for acceleration in (0.5, 3.0):  # what a vehicle cannot do is no cheaper than its speed
            per_km = model.power(FAST, torch.full_like(FAST, acceleration)) / FAST
            assert (per_km >= steady - 1e-9).all(), name


def test_a_truck_pays_for_the_speed_that_it_cannot_hold() -> None:
    speed = torch.tensor([30.0, 35.0, 45.0], dtype=torch.float64)
    truck = MODELS["Class8Tractor"]
    assert truck.infeasible(speed, torch.zeros(3)).tolist() == [False, True, True]
    per_km = truck.power(speed, torch.zeros(3)) / speed
    assert per_km.tolist() == pytest.approx([14776.0, 18421.0, 27529.0], rel=1e-4)


def test_alternating_around_a_speed_takes_less_fuel_than_holding_it() -> None:
    """docs/energy.md: the jump of the fuel cut rewards it, see the limit of jerk."""
    car, speed = CirclesFuel(), torch.tensor([10.0, 20.0, 30.0], dtype=torch.float64)
    cut = car._cut(speed)
    share = 0.5 * (car.fuel(speed, cut) + car.fuel(speed, -cut)) / car.fuel(speed, 0.0 * cut)
    assert share.tolist() == pytest.approx([0.65, 0.77, 0.92], abs=0.005)


def test_a_trucks_steady_fuel_grows_with_speed_as_published() -> None:
    def litres(kmh: float) -> float:
        speed = torch.tensor(kmh / 3.6)
        energy = MODELS["Class8Tractor"].power(speed, torch.zeros(())) / speed * 1e5
        return float(MODELS["Class8Tractor"].burnt(energy)[0])

    assert [litres(kmh) for kmh in (80, 100, 120)] == pytest.approx([29.3, 37.8, 48.5], abs=0.1)
    slow, middle, fast = (litres(1.609344 * mph) for mph in (55, 65, 75))
    # A US combination truck: 20 % less (EPA), 27 % more (ATA), see docs/energy.md.
    assert slow / middle == pytest.approx(0.80, abs=0.03)
    assert fast / middle == pytest.approx(1.27, abs=0.06)


def test_electric_cars_use_what_their_label_says(subtests) -> None:
    for cycle, place in [("udds", 0), ("hwfet", 1)]:
        for car in CARS:
            with subtests.test(cycle=cycle, car=car):
                speed = shipped_cycle(cycle)
                power = CARS[car].power(speed[:-1], speed.diff() / 0.1)
                used = float(power.sum()) * 0.1 / 3600.0  # [Wh]
                kilometres = float((speed[1:] + speed[:-1]).sum()) / 2.0 * 0.1 / 1e3
                published = LABELS[car][place] * LABORATORY * CHARGER / MILE * 1e3
                assert used / kilometres == pytest.approx(published, rel=0.15)


def test_braking_returns_no_more_than_the_limits_allow() -> None:
    speed, motor = torch.linspace(0.0, 15.0, 1001), PaperMotor()
    faster, slower = (motor.power(speed, torch.full_like(speed, x)) for x in (0.1, -0.1))
    returned = torch.trapezoid((faster - slower) / 0.2, speed)  # gently, of the papers' motor
    kinetic = motor.stored_energy(speed[-1]) - motor.stored_energy(speed[0])
    assert float(returned / kinetic) == pytest.approx(2.6, abs=0.05)
    car = ElectricCar(auxiliary=0.0, regeneration_limit=20e3, efficiency=0.9)
    speed = torch.tensor([30.0, 20.0, 2.5, 0.0])
    power = car.power(speed, torch.full((4,), -3.0))
    assert power[:2].tolist() == pytest.approx([-18e3, -18e3])
    whole = ElectricCar(auxiliary=0.0, efficiency=0.9, fade_speed=0.1)
    assert power[2] == pytest.approx(0.5 * float(whole.power(speed, torch.full((4,), -3.0))[2]))
    assert power[3] == 0.0


@pytest.mark.parametrize("name", MODELS)
def test_a_path_takes_what_is_drawn_less_what_is_stored(name) -> None:
    model, speed = MODELS[name], torch.linspace(8.0, 22.0, 2001, dtype=torch.float64)
    motion = speed[:-1], speed.diff() / 0.01
    drawn, path = (
        float(part(*motion).sum()) * 0.01 for part in (model.smooth_power, model.path_power)
    )
    stored = float(model.stored_energy(speed[-1]) - model.stored_energy(speed[0]))
    unpaid = float(model.unpaid(*motion).sum())  # 0.7 m/s² is too much for trucks
    assert (unpaid > 0.0) == (name in TRUCKS)
    stored -= unpaid * 0.01
    if name == "motor":  # whose own stored energy is not the kinetic one
        loss = float(model.acceleration_loss(*motion).sum()) * 0.01
        steady = float(model.power(speed[:-1], torch.zeros_like(speed[:-1])).sum()) * 0.01
        assert path == pytest.approx(steady + loss, rel=1e-9)
    else:
        assert path == pytest.approx(drawn - stored, abs=2e-3 * stored)
        assert model.acceleration_loss(*motion) is None


@pytest.mark.parametrize("name", [name for name in MODELS if name != "motor"])
def test_power_has_a_finite_gradient_everywhere(name) -> None:
    speed, acceleration = torch.meshgrid(
        torch.linspace(0.0, 45.0, 91), torch.linspace(-5.0, 3.0, 81), indexing="ij"
    )
    speed, acceleration = (x.clone().requires_grad_() for x in (speed, acceleration))
    for function in (MODELS[name].power, MODELS[name].smooth_power, MODELS[name].path_power):
        found = torch.autograd.grad(function(speed, acceleration).sum(), (speed, acceleration))
        assert all(part.isfinite().all() for part in found)


def shipped_cycle(name: str) -> torch.Tensor:
    table = pd.read_csv(str(files("lcc_rl.assets").joinpath("cycles", f"{name}.csv")))
    times = np.arange(0.0, table["time_s"].iloc[-1] + 0.05, 0.1)
    speeds = PchipInterpolator(table["time_s"], table["speed_mps"])(times)
    return torch.from_numpy(np.maximum(speeds, 0.0))
