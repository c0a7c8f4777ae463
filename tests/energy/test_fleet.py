"""Classes of vehicles: who has which energy model, and what an environment makes of it."""

import math

import pytest
import torch
from helpers import check_refused, compose, make_agent, slow_but, small_env, steady, string

import lcc_rl
from lcc_rl.agents.actor import shared_policy
from lcc_rl.config.compose import identity, load
from lcc_rl.energy import CirclesFuel, ElectricCar, EnergyModel, Fleet, PaperMotor, VehicleClass
from lcc_rl.envs import DifferentiableRollout, StringCollector
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.fit import classes, task_of
from lcc_rl.evaluation.rows import traffic
from lcc_rl.interfaces.exported import program
from lcc_rl.pieces.features import CLASS
from lcc_rl.settings import Number, Positive

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
        first = env.reset(options={("episode", "seed"): seeds})
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


class Weightless(EnergyModel):
    def power(self, speed, acceleration):
        return speed * acceleration


class Lossless(Weightless):
    mass, efficiency = 1500.0, 1.3


class Rolling(EnergyModel):
    mass: Positive = 1500.0  # [kg]
    unit: Number = 1.0
    summed: bool = False
    warming: bool = False
    grade: Number = 0.0
    slope: Number = 1.0
    heating_value: Number = 0.0
    density: Number = 0.0

    def power(self, speed, acceleration):
        force = 1500.0 * (acceleration + 9.81 * self.slope * torch.as_tensor(self.grade).sin())
        power = (force + 200.0) * speed * self.unit
        if self.warming:
            self.unit *= 1.1
        return power.sum() if self.summed else power


class Single(Rolling):
    def validate(self):
        math.sin(self.grade)  # of one number only


class Uphill(Weightless):
    mass = 1500.0
    grade = property(lambda self: 0.01)  # cannot be set


def test_mistakes_are_named() -> None:
    cases = [
        ({}, "energy.models is empty"),
        (MODELS, {"cart": 1.0}, r"energy.shares.*'cart'.*car"),
        (MODELS, {"car": 0.0}, "energy.shares: shares"),
        (MODELS, None, {"human": {"bus": 1.0}}, r"energy.roles.human.*'bus'"),
        ({"x": Weightless()}, "Weightless: an energy model needs its mass, .* nan"),
        ({"x": Lossless()}, "Lossless: efficiency must lie from 0 to 1, got 1.3"),
        ({"x": Rolling(unit=1e-3)}, "Rolling.power .* 15 W per m/s², .* 1.5e[+]04 W"),
        ({"x": Rolling(unit=3.6)}, "Rolling.power"),  # speed taken as km/h
        ({"x": Rolling(unit=-1.0)}, "Rolling.power"),
        ({"x": Rolling(mass=1.5, unit=1e-3)}, "Rolling: .* its mass, 50 to 200000 kg, got 1.5"),
        ({"x": Rolling(grade=2.0)}, "Rolling: grade must be at most 0.3 rad, got 2"),
        (
            {"x": Rolling(slope=0.0)},
            r"by 0 W for a grade of 0.01 rad, its height .* the grade, in r",
        ),
        ({"x": Rolling(slope=57.3)}, r"its height by 1472 W .* the grade, in rad"),
        ({"x": Rolling(heating_value=42.4)}, "Rolling: heating_value must .* J/g, got 42.4"),
        ({"x": Rolling(heating_value=42e3)}, "Rolling: density must .* 0.05 to 1.5 kg/L, got 0.0"),
        ({"x": Uphill()}, "Uphill.power: .*'grade'"),
        ({"x": Single()}, "Single.power with the grade as a tensor: .*use torch in place of math"),
        ({"x": Rolling(warming=True)}, "Rolling gives an episode other power .* again"),
        ({"x": Rolling(summed=True)}, r"Rolling.power: its shape is \[\] for"),
    ]
    check_refused(Fleet, cases, ConfigError)
    cases = [
        (["energy._target_=builtins.dict"], "energy"),
        (["energy=fuel", "energy.vehicle=van"], "vehicle .energy.vehicle. 'van'"),
        (
            ["energy=mixture", "energy.grade=0.02"],
            "Fleet has no grade, .* energy.models.compact.gr",
        ),
        ([*MIXED, "+energy.roles.lorry={class8: 1}"], r"energy.roles.*lorry.*automated, human"),
    ]
    check_refused(lambda words: lcc_rl.make_env("alcc", 1, words), cases, ConfigError)


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


# -- classes with limits ---------------------------------------------------------------------------

TRUCK = MODELS["truck"]
LIMIT = 9.0  # which the wavy leaders, up to 14 m/s, exceed [m/s]
TRUCKS = ["+fleet=trucks", f"scenario.fleet.truck.speed_limit={LIMIT}"]
HALF = [*TRUCKS, "scenario.fleet.truck.share=0.5"]
ALL = [*HALF, "scenario.fleet.truck.roles=[automated,human]"]


def test_a_class_is_bounded_by_power_over_mass_and_speed_less_the_resistances() -> None:
    speed, full = torch.tensor([5.0, 20.0, 25.0, 30.0]), torch.full((4,), 3.0)
    lorry = ElectricCar(mass=40e3, drag=0.6, area=10.0, rolling=0.006, power_limit=300e3)
    drag = 0.5 * 1.2 * 0.6 * 10.0 * speed.square() + 40e3 * 9.81 * 0.006
    wanted = (300e3 / speed - drag) / (40e3 * 1.03)
    torch.testing.assert_close(lorry.strongest(speed), wanted)
    found = VehicleClass(energy=lorry).within(full, speed, 0.1)
    torch.testing.assert_close(found, wanted, atol=2e-3, rtol=0.0)
    assert not lorry.infeasible(speed, found).any()
    assert lorry.infeasible(speed, full).all()
    # The diesel truck: 212 kW for 25 t, at 30 m/s less than 0.05 m/s².
    found = VehicleClass(energy=TRUCK, speed_limit=25.0).within(full, speed, 0.1)
    torch.testing.assert_close(found[1], TRUCK.strongest(speed)[1] - 1e-3)
    assert 0.2 < found[1] < 0.4
    assert found[2:].tolist() == pytest.approx([0.0, -50.0])  # the limit
    braking = -full
    assert VehicleClass(energy=TRUCK).within(braking, speed, 0.1).equal(braking)
    assert VehicleClass(energy=TRUCK, bounded=False).within(full, speed, 0.1).equal(full)
    for without in (PaperMotor(), ElectricCar()):  # no power limit is known
        assert VehicleClass(energy=without).within(full, speed, 0.1).equal(full)


def test_a_trucks_bound_has_the_gradient_of_its_power() -> None:
    speed = torch.tensor([10.0, 20.0], dtype=torch.float64, requires_grad=True)
    command = torch.tensor([0.1, 3.0], dtype=torch.float64, requires_grad=True)
    one = VehicleClass(energy=TRUCK, speed_limit=29.0)
    assert torch.autograd.gradcheck(lambda a, v: one.within(a, v, 0.1), (command, speed))
    one.within(command, speed, 0.1).sum().backward()
    assert command.grad.tolist() == [1.0, 0.0]  # the second is bounded by its speed alone
    assert speed.grad[0] == 0.0 > speed.grad[1]


STRINGS_OF_TRUCKS = [string("automated*2 human*4"), "scenario.string={size: 6, penetration: 0.4}"]


@pytest.mark.parametrize("pattern", STRINGS_OF_TRUCKS)
def test_trucks_keep_their_limits_whatever_is_commanded(pattern) -> None:
    env = small_env("alcc", 16, [pattern, *ALL, "energy=fuel", "scenario.pieces.collision=null"])
    data = env.rollout(120, steady(1.0, env), break_when_any_done=False)  # full throttle
    before, after, kinds = data["vehicles"], data["next", "vehicles"], data[CLASS]
    trucks = (kinds == 1).expand_as(after["speed"])
    assert 0.3 < trucks.double().mean() < 0.7
    assert after["speed"][trucks].max() <= LIMIT + 1e-5
    assert after["speed"][~trucks].max() > LIMIT + 2.0
    assert data["vehicles", "speed"][:, 0][trucks[:, 0]].max() <= LIMIT
    beyond = build_energy(compose("alcc", *ALL, "energy=fuel")).infeasible(
        before["speed"], after["acceleration"], kinds
    )
    assert not beyond[trucks].any()
    desired = data["human", "desired_speed"]
    assert (desired == LIMIT).double().mean() > 0.2  # the driver of a truck expects it
    assert desired.max() > LIMIT + 10.0
    # Nobody starts faster than the trucks ahead of it.
    first, kinds = data["vehicles", "speed"][:, 0], kinds[:, 0]
    behind = (kinds == 1).cumsum(-2) > 0
    assert first[behind].max() <= LIMIT < first[~behind].max()


def test_every_path_drives_trucks_alike() -> None:
    overrides = [string("automated human*3"), *ALL, "training.gap_range=[0.8,1.5]"]
    overrides += ["energy=fuel", "scenario.horizon=40"]
    policy = make_agent(compose("alcc", *overrides)).policy
    keys = [("vehicles", name) for name in ("speed", "gap", "acceleration", "command", "power")]
    with torch.no_grad():
        rolled = small_env("alcc", 8, overrides, seed=3).rollout(
            40, shared_policy(policy), break_when_any_done=False
        )
        env = small_env("alcc", 8, overrides, seed=3)
        unrolled = DifferentiableRollout(env, policy.module, keys)
        _, record = unrolled.play(unrolled.start(), 40)
        steps = unrolled.assemble(record)["next"]
    env = small_env("alcc", 8, overrides, seed=3)
    collector = StringCollector(
        env, shared_policy(policy), frames_per_batch=320, keys=[("next", *key) for key in keys]
    )
    collected = next(iter(collector))["next"]
    loose = [*overrides, "scenario.fleet.truck.speed_limit=null"]
    free = small_env("alcc", 8, loose, seed=3)
    free = free.rollout(40, shared_policy(policy), break_when_any_done=False)["next"]
    for key in keys:
        assert torch.equal(steps[key], rolled["next", *key]), key
        assert torch.equal(collected[key], rolled["next", *key]), key
    assert not torch.equal(free["vehicles", "speed"], rolled["next", "vehicles", "speed"])


def test_a_filter_keeps_its_promise_in_a_truck() -> None:
    # Full throttle behind the filter: what it allows, a truck may not be able to do.
    words = [string("automated human*2"), *ALL, "scenario.fleet.truck.share=1", "+filter=cbf"]
    env = small_env("alcc", 24, [*words, "scenario.pieces.collision=null"], nominal=True)
    data = env.rollout(200, steady(1.0, env), break_when_any_done=False)["next"]
    promised = data["automated", "promised"] == 1.0
    assert promised.double().mean() > 0.9
    assert (data["vehicles", "ttc"][..., :1, :][promised] >= 4.0).all()
    assert (data["automated", "safe"][:, 1:][promised[:, :-1]] == 1.0).all()


def test_lengths_count_in_flow_and_in_the_gaps_of_a_ring() -> None:
    motion = {("vehicles", "speed"): torch.full((6, 2, 3, 1), 10.0)}
    motion["vehicles", "gap"] = motion["vehicles", "speed"][1:]
    kinds = torch.tensor([[0, 0, 0], [1, 0, 1]]).view(2, 3, 1)
    fleet = Fleet({"car": MODELS["car"]}).extended(
        {"truck": VehicleClass(energy=TRUCK, share=0.5, length=20.0, speed_limit=8.0)}, 5.0
    )
    record = {**motion, CLASS: kinds.expand(5, 2, 3, 1)}
    alive = torch.ones(5, 2, 1, dtype=torch.bool)
    found = traffic(record, alive, 5.0, 0.1, torch.tensor([40.0, 40.0]), fleet)
    # One car and two trucks of 20 m: 15 m on average.
    assert found["flow_vph"].flatten().tolist() == pytest.approx([36e3 / 15.0, 36e3 / 25.0])
    # v0 of a truck is its limit, below which none of them is late.
    late = [3 * 0.5 * (1 - 10 / 40), 0.5 * (1 - 10 / 40) + 2 * 0.5 * (1 - 10 / 8)]
    assert found["delay_s"].flatten().tolist() == pytest.approx(late)
    ring = ["scenario=ring", "drivers=ring", "scenario.circumference=100", "reward=reference"]
    ring += [string("automated human*3"), "+fleet=trucks", "scenario.fleet.truck.share=0.5"]
    start = small_env("reference", 8, ring, nominal=True).reset()
    longer = 16.0 * start[CLASS].double().sum(-2)  # 21 m instead of 5 m
    gaps = start["vehicles", "gap"]
    wanted = (100.0 - 20.0 - longer) / 4.0
    torch.testing.assert_close(gaps.double(), wanted.unsqueeze(-1).expand_as(gaps))
    with pytest.raises(ConfigError, match=r"it must exceed 68\.0 m"):
        small_env("reference", 1, [*ring, "scenario.circumference=60"])


def test_what_does_not_use_classes_is_what_it_was() -> None:
    cfg = load("evaluate", ["task=i24-mixed"])
    assert task_of(cfg).unit == "g/km"
    trucks = load("evaluate", ["task=i24-mixed", "+fleet=trucks"])  # petrol and diesel
    assert identity(trucks) != identity(cfg)
    assert task_of(trucks).unit == "kJ/km"
    assert (classes(cfg), classes(trucks)) == (
        "",
        "Classes of vehicles (scenario.fleet): 15% of human: truck.",
    )
    fleet = build_energy(trucks)
    assert fleet.shares == [1.0, 0.0]
    assert fleet.roles["human"] == pytest.approx([0.85, 0.15])
    mixed = build_energy(load("evaluate", ["energy=mixture", "+fleet=trucks"]))
    assert mixed.names[-1] == "truck"
    assert mixed.roles["human"] == pytest.approx([*(0.85 * x for x in mixed.shares[:-1]), 0.15])


def test_mistakes_in_classes_are_named() -> None:
    truck, suv = "scenario.fleet.truck", "+scenario.fleet.suv=${scenario.fleet.truck}"
    both = [*HALF, "+scenario.fleet.van=${scenario.fleet.truck}", f"{truck}.share=0.8"]
    cases = [
        ([*TRUCKS, f"{truck}.share=2"], f"{truck}.share must be"),
        ([*TRUCKS, f"{truck}.length=0"], f"{truck}.length must"),
        (
            [*TRUCKS, f"{truck}.roles=[human,lorry]"],
            rf"role \({truck}.roles\).*lorry.*automated, h",
        ),
        ([*TRUCKS, string("automated")], "truck.speed_limit=9.0 has no effect: .* is human"),
        (["scenario.fleet={truck: {share: 0.1}}"], r"scenario.fleet.*truck.*_target_"),
        (both, "scenario.fleet: the shares of human must not exceed 1, got 1.6"),
        (["energy=mixture", suv, *TRUCKS], "scenario.fleet: energy has a class suv, too"),
    ]
    check_refused(lambda words: small_env("alcc", 1, words), cases, ConfigError)
    cfg = compose("alcc", *ALL)
    with pytest.raises(ConfigError, match=r"class truck \(scenario.fleet\).*cannot drive in SUMO"):
        program(make_agent(cfg).policy.module, cfg=cfg)
