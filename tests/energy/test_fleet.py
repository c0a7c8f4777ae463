"""Classes of vehicles: who has which energy model, and what an environment makes of it."""

import pytest
import torch
from helpers import check_refused, slow_but

import lcc_rl
from lcc_rl.config import load
from lcc_rl.energy import CirclesFuel, ElectricCar, Fleet, PaperMotor
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import ConfigError
from lcc_rl.pieces.features import CLASS

MODELS = {
    "car": CirclesFuel(),
    "truck": CirclesFuel(vehicle="Class8Tractor"),
    "electric": ElectricCar(),
}
MIXED = ["energy=mixture", "scenario.string=automated human*3"]


def test_every_vehicle_has_the_power_of_its_class() -> None:
    fleet = Fleet(MODELS)
    speed, acceleration = torch.rand(2, 60, generator=torch.Generator().manual_seed(0)) * 20.0
    kind = torch.arange(60) % 3
    found = fleet.power(speed, acceleration, kind)
    for number, model in enumerate(MODELS.values()):
        own = kind == number
        torch.testing.assert_close(found[own], model.power(speed[own], acceleration[own]))
    assert fleet.acceleration_loss(speed, acceleration, kind) is None
    beyond = fleet.infeasible(speed, acceleration + 2.0, kind)
    assert beyond[kind < 2].any()
    assert not beyond[kind < 2].all()
    assert not beyond[kind == 2].any()  # the electric car defines no limit
    assert Fleet({"electric": ElectricCar()}).infeasible(speed, acceleration) is None
    assert Fleet({"all": PaperMotor()}).acceleration_loss(speed, acceleration).min() >= 0.0


STRINGS = ["automated*2 human*6", "{size: 8, penetration: 0.25}"]


@pytest.mark.parametrize("string", slow_but(STRINGS[1:], STRINGS))
def test_classes_are_drawn_by_share_and_constant(string) -> None:
    overrides = [
        "energy=mixture",
        f"scenario.string={string}",
        "energy.shares={midsize: 3, suv: 1, compact: 0, pickup: 0, class8: 0, electric: 0}",
    ]
    env = lcc_rl.make_env(
        "alcc", 2000, [*overrides, "+energy.roles.automated={electric: 1}"], seed=0
    )
    data = env.rollout(2, break_when_any_done=False)
    kinds = data[CLASS]
    assert (kinds[:, 0] == kinds[:, 1]).all()
    names = list(load("train", overrides).energy.settings["models"])
    index = data["automated", "index"][:, 0]
    own = kinds[:, 0].squeeze(-1).gather(-1, index)
    assert (own == names.index("electric")).all()
    place = torch.arange(8)
    human = kinds[:, 0].squeeze(-1)[~(place == index.unsqueeze(-1)).any(-2)]
    share = (human == names.index("midsize")).float().mean()
    assert share == pytest.approx(0.75, abs=0.02)
    assert (human[human != names.index("midsize")] == names.index("suv")).all()


def test_an_episode_has_the_same_vehicles_whoever_drives() -> None:
    seeds = torch.arange(5).unsqueeze(-1)
    kinds = []
    for variant in ("alcc", "idm"):
        env = lcc_rl.make_env(variant, 5, MIXED, seed=0, single=False)
        first = env.reset(
            env.state_spec.zero().select(("episode", "seed")).set(("episode", "seed"), seeds)
        )
        kinds.append(first[CLASS])
    assert (kinds[0] == kinds[1]).all()
    assert len(kinds[0].unique()) > 2


def test_power_of_an_environment_is_that_of_the_models() -> None:
    env = lcc_rl.make_env("alcc", 4, MIXED, seed=0)
    data = env.rollout(20, break_when_any_done=False)
    fleet = build_energy(load("train", MIXED))
    after = data["next", "vehicles"]
    wanted = fleet.power(data["vehicles", "speed"], after["acceleration"], data[CLASS])
    torch.testing.assert_close(after["power"], wanted)


def test_mistakes_are_named() -> None:
    check_refused(
        lambda make: make(),
        [
            (lambda: Fleet({}), "energy.models is empty"),
            (lambda: Fleet(MODELS, {"cart": 1.0}), r"energy.shares.*'cart'.*car"),
            (lambda: Fleet(MODELS, {"car": 0.0}), "energy.shares: shares"),
            (lambda: Fleet(MODELS, None, {"human": {"bus": 1.0}}), r"energy.roles.human.*'bus'"),
            (lambda: build_energy(load("train", ["energy._target_=builtins.dict"])), "energy"),
            (lambda: CirclesFuel(vehicle="van"), "van"),
            (
                lambda: lcc_rl.make_env("alcc", 1, [*MIXED, "+energy.roles.lorry={class8: 1}"]),
                r"energy.roles.*lorry.*automated, human",
            ),
        ],
        ConfigError,
    )


def test_fuel_and_carbon_dioxide_are_those_of_each_class() -> None:
    energy, kind = torch.full((4,), 1e6), torch.tensor([0, 1, 2, 0])  # [J]
    found = Fleet(MODELS).burnt(energy, kind)
    # 1 MJ over 42.36 kJ/g of petrol, over diesel's; the electric car burns none.
    petrol, diesel = 1e6 / 42360.0, 1e6 / MODELS["truck"].heating_value
    litres = [petrol / 745.0, diesel / 832.0, 0.0, petrol / 745.0]
    assert found["fuel_l"].tolist() == pytest.approx(litres)
    grams = [2.348 / 0.745 * petrol, 2.689 / 0.832 * diesel, 0.0, 2.348 / 0.745 * petrol]
    assert found["co2_g"].tolist() == pytest.approx(grams)
    assert Fleet({"electric": ElectricCar()}).burnt(energy) == {}
