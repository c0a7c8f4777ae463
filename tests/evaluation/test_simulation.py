"""A simulation is a table of what an evaluation drives."""

from __future__ import annotations

import functools

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import POPULATION, check_refused, wavy_profiles
from tensordict.nn import TensorDictModule

import lcc_rl
from lcc_rl.assets import ASSETS
from lcc_rl.commands.simulate import main
from lcc_rl.config import load
from lcc_rl.data.profiles import from_records, no_profiles
from lcc_rl.drivers.population import SHIPPED_DRIVERS, bootstrap, fixed
from lcc_rl.envs import Inputs
from lcc_rl.envs.inputs import build_energy
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.entrants import Entrants
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.metrics import METRICS
from lcc_rl.interfaces.driver import Driver
from lcc_rl.pieces import Controller

STEPS = 200
MARGIN = "scenario.filters.automated.margin"
WAVE = 8.0 + 3.0 * np.sin(0.1 * np.arange(STEPS + 1) / 4.0)
EPOCH = pd.DataFrame({"time_s": 1.7e12 + 100.0 * np.arange(9), "speed_mps": 9.0})
BEHIND = {"leader": WAVE, "string": "automated"}
QUICK = ["scenario.horizon=200", "evaluation.baselines=[]", "evaluation.warm_up=0"]


@pytest.mark.parametrize("policy", [None, "pretrained/alcc"])
def test_the_rows_are_those_of_an_evaluation(policy, monkeypatch) -> None:
    monkeypatch.setattr("lcc_rl.evaluation.simulation.BLOCK", 1)  # episode by episode
    string = "automated human*2"
    found = lcc_rl.simulate([WAVE, WAVE + 2.0], string, policy, repeats=3, seed=5)
    words = [f"variant={'idm' if policy is None else 'alcc'}", *QUICK, f"scenario.string={string}"]
    cfg = load("evaluate", words).with_(compare=[] if policy is None else [policy])
    records = [torch.tensor(x, dtype=torch.float32) for x in (WAVE, WAVE + 2.0)]
    profiles = from_records(records, ["a", "b"], ["a", "b"], 0.1)
    inputs = Inputs(no_profiles(0.1), profiles, POPULATION)
    strategy = Entrants(cfg).strategies(inputs)[-1]
    rows, _ = evaluate(strategy, inputs, None, 1024, 5)
    rows = rows[rows["driver_id"] < 3].sort_values(["profile_id", "driver_id"])
    assert len(rows) == 6
    for role, group in (("automated", "cav"), ("human", "hdv")):
        own = found.vehicles[found.vehicles["role"] == role].groupby("episode")
        for key, unit in (("path_energy_kj", 1e-4), ("distance_m", 1e-5)):
            np.testing.assert_allclose(own[key].sum(), rows[f"{group}_{key}"], rtol=unit)
    mean = found.vehicles[found.vehicles["vehicle"] > 0].groupby("episode")["mean_speed_mps"].mean()
    np.testing.assert_allclose(mean, rows["mean_speed_mps"], rtol=1e-6)
    own = found.vehicles[found.vehicles["vehicle"] == 1]
    shared = [key for key in METRICS if key in rows]
    assert {"min_gap_m", "min_ttc_s", "max_jerk_1s_mps3", "standstill_s"} <= {*shared}
    np.testing.assert_allclose(own[shared], rows[shared], rtol=1e-5, atol=1e-4)
    leader = found.vehicles[found.vehicles["vehicle"] == 0]
    assert leader["max_deceleration_mps2"].notna().all()
    assert leader["min_gap_m"].isna().all()


def test_safety_changes_the_filter_that_a_policy_keeps() -> None:
    """Each kept filter, its other settings too; none is no filter to change."""
    cfg = load("evaluate", ["variant=alcc", *QUICK, "safety.margin=2"])
    cfg = cfg.with_(compare=["idm_acc", "pretrained/alcc_limits", "pretrained/i80-follow"])
    inputs = Inputs(no_profiles(0.1), wavy_profiles(), POPULATION)
    rows = Entrants(cfg).strategies(inputs)
    filters = {row.name: row.cfg.scenario.filters.get("automated") for row in rows}
    assert [name for name, node in filters.items() if node is None] == ["idm_acc"]
    for row in (row for row in rows if row.policy):
        assert filters[row.name] == row.own.scenario.filters["automated"].changed(margin=2)
    cases = [
        (["idm_acc", "safety.margin=2"], "safety.margin=2 has no effect: nothing drives behind"),
        (["pretrained/alcc", "safety.margin=2"], "safety.margin has no effect: no row has a s"),
        (
            ["pretrained/alcc_limits", "safety.robust=false"],
            "actuators and sensors are exact; .faults",
        ),
        (["pretrained/alcc_limits", "safety.marge=2"], "unknown setting .* Did you mean 'margin'"),
        (["pretrained/alcc_limits", f"{MARGIN}=2"], "safety.margin=2 changes the filter that a"),
    ]
    drive = functools.partial(lcc_rl.simulate, WAVE, "automated human")
    check_refused(lambda given: drive(given[0], overrides=given[1:]), cases, ConfigError)


def test_the_steps_are_a_motion(subtests) -> None:
    frame = pd.DataFrame({"time_s": 0.1 * np.arange(len(WAVE)), "speed_mps": WAVE})
    cases = {
        "humans": {"leader": frame, "string": "human*3"},
        "a car between": {"leader": WAVE, "string": "human automated human"},
        "drawn": {"leader": WAVE, "string": {"size": 4, "penetration": 0.5}, "repeats": 2},
        "ring": {"leader": None, "string": "human*22", "seconds": 5.0},
    }
    for name, case in cases.items():
        ring = ["scenario=ring"] if name == "ring" else []
        with subtests.test(name=name):
            steps = lcc_rl.simulate(**case, overrides=ring).steps
            by = ["episode", "vehicle"]
            assert (steps["time_s"] == steps["time_s"].round(3)).all()  # 0.3, not 0.30…04
            assert not steps.duplicated([*by, "time_s"]).any()
            if name == "humans":
                np.testing.assert_allclose(steps["speed_mps"][steps["vehicle"] == 0], WAVE, 1e-6)
            speed = steps.groupby(by)["speed_mps"].diff()
            np.testing.assert_allclose(
                10.0 * speed.dropna(), steps.loc[speed.notna(), "acceleration_mps2"], atol=2e-3
            )
            at = steps.pivot_table(["speed_mps", "gap_m"], ["episode", "time_s"], "vehicle")
            v, gap = at["speed_mps"].to_numpy(), at["gap_m"].to_numpy()
            ahead, own = (np.roll(v, 1, 1), v) if name == "ring" else (v[:, :-1], v[:, 1:])
            moved = 0.05 * ((ahead - own)[1:] + (ahead - own)[:-1])
            inside = at.index.get_level_values("time_s")[1:] > 0.0
            np.testing.assert_allclose(np.diff(gap, axis=0)[inside], moved[inside], atol=2e-4)
            if name == "drawn":
                assert (steps.drop_duplicates(by)["role"] == "automated").sum() == 4


def test_compiled_code_drives_the_same(monkeypatch, subtests) -> None:
    where = "lcc_rl.evaluation.simulation."

    def steps(name: str, value: int) -> pd.DataFrame:
        monkeypatch.setattr(where + name, value)
        steps = lcc_rl.simulate(WAVE, "automated human", "pretrained/alcc").steps
        return steps.assign(power_w=steps["power_w"] / 1000.0)  # of as many digits as the others

    plain = steps("LONG", 10**6)
    for made, few in [("rows of numbers", 40), ("by torch, around the policy", 0)]:
        with subtests.test(made):
            monkeypatch.setattr(where + "LONG", 1)
            fast = steps("SHORT_STRING", few)
            pd.testing.assert_frame_equal(fast, plain, rtol=1e-4, atol=1e-3)


class Follow(Controller):
    """A controller that brakes late."""

    reads = ("self.gap",)

    def command(self, gap):
        return 0.5 * (gap - 4.0)


def test_a_name_puts_a_controller_behind_the_filter() -> None:
    hard = np.clip(25.0 - 2.5 * (0.1 * np.arange(301) - 10.0).clip(min=0.0), 0.0, 25.0)
    alone = lcc_rl.simulate(hard, "automated", {"mine": Follow()})
    held = [
        lcc_rl.simulate(hard, "automated", one, overrides=["+filter=cbf"]).vehicles["min_gap_m"][1]
        for one in ({"mine_filtered": Follow()}, f"{__name__}.Follow_filtered")
    ]
    assert alone.vehicles["collided"].any()
    assert held[0] == held[1] > 0.0


class Listening(Controller):
    """Keeps the gap and the speed that it receives."""

    reads = ("self.gap_error", "self.leader_speed_error")

    def command(self, gap_error, speed_error):
        return 0.1 * gap_error + 0.8 * speed_error


def test_controllers_with_messages_and_other_scenarios_need_no_reward() -> None:
    own = f"{__name__}.Listening"
    for one, words in (("cacc", []), ("deadbeat", []), (own, []), ("acc", ["scenario=platoon"])):
        found = lcc_rl.simulate(WAVE, "automated*2 human", one, overrides=words).vehicles
        assert (found["min_gap_m"][1:] > 0.0).all(), one
        if not words and one != own:  # equal to their own variant
            of_variant = [f"variant={one}"]
            same = lcc_rl.simulate(WAVE, "automated*2 human", one, overrides=of_variant).vehicles
            pd.testing.assert_frame_equal(found, same)


def test_wrong_arguments_are_named(tmp_path) -> None:
    (late := tmp_path / "late.csv").write_text("time_s,speed_mps\n0,9\n5000,9\n")
    (fast := tmp_path / "fast.csv").write_text("time_s,speed_kmh\n0,9\n1,9\n")
    cases = [
        ({"leader": late}, r"samples of each drive are 5000 s apart; .*, in ms \(convert it\), or"),
        ({"leader": fast}, "it has time_s, speed_kmh; convert them to SI"),
        ({"leader": fast, "overrides": ["leader.units.speed=km/h"]}, r"files have time_s \[s\]"),
        ({"leader": fast, "overrides": ["seed=3"]}, "simulate: see the arguments$"),
        ({"leader": None}, "leader=None needs scenario=ring and sec"),
        ({"leader": None, "seconds": 5.0}, "a ring .*has leader=None, an open road has a leader"),
        ({"leader": WAVE, "overrides": ["scenario=ring"]}, "an open road has a leader"),
        ({"leader": [3.0]}, "at least two speeds"),
        ({"leader": []}, "at least two speeds"),
        ({"leader": torch.ones(2, 3, requires_grad=True)}, r"shape \[2, 3\]; give a column"),
        ({"leader": [3.0, -1.0]}, "speed 1, at 0.1 s, is -1, not from 0 to 70 m/s"),
        ({"leader": [3.0, np.inf], "time_step": 0.2}, "speed 1, at 0.2 s, is inf, not from 0"),
        ({"leader": np.ones((2, 3))}, r"speeds .*shape \[2, 3\]; give a column"),
        ({"leader": pd.DataFrame({"v": WAVE})}, "^the data frame: lacks .*time_s"),
        ({"leader": EPOCH}, r"expected a number .* s; is it in ms, us or ns \(convert it\)\?$"),
        ({"leader": pd.DataFrame({"v": [1, "x"]})}, "^the data frame: .*Could not convert 'x'"),
        ({"leader": 12.0 * WAVE}, r"leader must be speeds .*is 96, not .*in km/h"),
        ({"leader": np.ma.masked_greater(WAVE, 9.0)}, "speed 14, at 1.4 s, is nan, not from 0"),
        ({"leader": WAVE, "drivers": {"a": 1}}, "drivers: not a population: "),
        *(
            ({"leader": WAVE, "overrides": [f"{key}=2"]}, f"{key}=2: has no effect .*arguments$")
            for key in ("scenario.horizon", "scenario.string", "seed", "compare", "experiment")
        ),
        ({"leader": WAVE, "overrides": ["leader.path=2"]}, "the arguments; files have time_s"),
        ({"leader": [9.0, 9.0, 18.0]}, r"speed 1, at 0.1 s, changes by 90 m/s², .*time_step=…"),
        ({**BEHIND, "overrides": ["observation.raw=true"]}, "raw=true has no effect: no row obs"),
        (
            {**BEHIND, "controller": "pretrained/i80-follow"},
            "^pretrained/i80-f.*string needs one, ",
        ),
        *(
            ({"leader": x}, rf"{x}: no such file, and none of .*\(hwfet, udds, us06, wltc_3b\)")
            for x in ("nowhere.csv", "drives", "platoons")
        ),
        ({"leader": WAVE, "seconds": 99.0}, "seconds=99, and the leader drives for 20 s"),
        ({"leader": WAVE, "seconds": 1.25}, "seconds=1.25 is no multiple of time_step=0.1"),
        ({"leader": WAVE, "drivers": POPULATION, "overrides": ["drivers=highway"]}, "drivers=high"),
        ({"leader": WAVE, "seconds": "long"}, r"simulate\.seconds must be a valid number"),
        ({"leader": WAVE, "time_step": 0.0}, r"simulate\.time_step must be greater"),
        ({"leader": WAVE, "repeats": 0}, r"simulate\.repeats must be greater"),
        ({"leader": WAVE, "string": "car*3"}, "car"),
        ({"leader": WAVE, "string": "human", "controller": "idm_acc"}, "no vehicle"),
        ({"leader": WAVE, "string": "automated", "controller": "nobody"}, "unknown strategy"),
        *(
            ({**BEHIND, "controller": one, "overrides": x}, rf"nothing drives behind .*\({who}\)")
            for one, who in (({"mine": Follow()}, "mine"), (Follow(), "Follow"), ("acc", "acc"))
            for x in (["+filter=cbf"], ["task=i24-follow5", f"{MARGIN}=2"])
        ),
        ({**BEHIND, "controller": {"a": "idm", "b": "acc"}}, "controller: expected one, such as"),
        ({**BEHIND, "controller": {"a_filtered": Follow()}}, "a_filtered needs the safety filter"),
    ]
    check_refused(lambda given: lcc_rl.simulate(**given), cases)
    with pytest.raises(TypeError, match=r"^simulate\(\) got an unexpected .*'driver'"):
        lcc_rl.simulate(WAVE, driver=POPULATION)  # type: ignore[call-arg]


def test_settings_without_effect_are_said(caplog) -> None:
    quiet, drawn = ["scenario.controllers.human.noise=0"], "repeats=2, seed=3"
    start = "scenario.start.human=${scenario.start.automated}"
    others = ["controller@scenario.controllers.human=acc", start]
    lost = ["+event=lost_target", "scenario.sensors.automated.lost_from=2"]
    cases = [
        ("automated", Follow(), fixed(33.0, 1.3), [], f"drivers, {drawn}"),
        ("automated", "human", fixed(33.0, 1.3), [], ""),
        ("automated", None, fixed(33.0, 1.3, min_gap=3.0), [], drawn),
        ("automated", None, fixed(33.0, 1.3), lost, "drivers"),
        ("human", None, fixed(33.0, 1.3), quiet, drawn),
        ("human", None, fixed(2.0, 1.3), others, f"drivers, {drawn}"),
        ("automated human", "pretrained/alcc", fixed(33.0, 1.3), quiet, drawn),
        ("automated human", "pretrained/alcc", fixed(33.0, 1.3), [], ""),
    ]
    for *case, without in cases:
        caplog.clear()
        lcc_rl.simulate(WAVE, *case, repeats=2, seed=3)
        said = f"without effect on these vehicles: {without}"
        assert caplog.messages == [said] * bool(without), case


def test_a_mixture_names_the_class_whose_power_each_vehicle_draws() -> None:
    settings = ["energy=mixture", "drivers=highway"]
    found = lcc_rl.simulate(10.0 + WAVE, "human*6", overrides=settings, repeats=2)
    fleet, keys = build_energy(load("evaluate", settings)), ["episode", "vehicle"]
    kinds = found.vehicles.set_index(keys)["energy_class"]
    assert kinds.nunique() > 2
    for key, rows in found.steps.groupby(keys):
        speed, acceleration, power = (
            torch.tensor(rows[name].to_numpy())
            for name in ("speed_mps", "acceleration_mps2", "power_w")
        )
        drawn = fleet.classes[kinds[key]].energy.power(speed[:-1], acceleration[1:])
        torch.testing.assert_close(drawn, power[1:])


def test_a_leader_that_is_replaced_does_not_jump() -> None:
    words = ["+event=cut_in", "scenario.pieces.leader.at=[3,4]"]
    words += ["scenario.pieces.leader.excess=[-5,-4]", "scenario.pieces.leader.settling=5"]
    found = lcc_rl.simulate([12.0] * 101, "automated", overrides=words)
    leader = found.steps[found.steps["vehicle"] == 0]
    assert leader["speed_mps"].diff().min() < -3.9  # of two vehicles
    assert leader["acceleration_mps2"].abs().max() < 1.1
    assert leader["power_w"].min() > 0.0  # no braking
    settling = leader[leader["acceleration_mps2"] > 0.5]["power_w"]
    assert settling.diff().abs().max() < 2e3  # also from the step of the change on
    energies = [name for name in found.vehicles if name.endswith("energy_kj")]
    assert found.vehicles.loc[0, energies].isna().all()  # two vehicles in turn
    assert found.vehicles.loc[1, energies].notna().all()


def test_drivers_of_a_table_are_those_of_its_path(caplog) -> None:
    path = ASSETS / SHIPPED_DRIVERS  # it has both modes
    for mode in ("local", "global"):
        args = WAVE, "automated human*2", "human"
        found = lcc_rl.simulate(*args, drivers=path, overrides=[f"drivers.mode={mode}"])
        given = lcc_rl.simulate(*args, drivers=bootstrap(mode=mode))
        pd.testing.assert_frame_equal(found.steps, given.steps)
    assert "several modes" not in caplog.text
    lcc_rl.simulate(WAVE, "human", drivers=path)
    assert "holds drivers of several modes; drivers.mode=local is taken" in caplog.text
    cases = [("drivers.path=b.parquet", "has no effect in simulate"), ("drivers=fixed", "path")]
    check_refused(lambda word: lcc_rl.simulate(WAVE, drivers=path, overrides=[word]), cases)


def test_the_command_drives_as_the_function_does(tmp_path, capsys) -> None:
    leader, steps, vehicles = (tmp_path / x for x in ("a.csv", "steps.parquet", "vehicles.csv"))
    time = 0.1 * np.arange(len(WAVE))
    pd.DataFrame({"time_s": time, "speed_mps": WAVE}).to_csv(leader, index=False)
    found = lcc_rl.simulate(leader, "automated human", "idm_acc", overrides=["energy=bolt"], seed=2)
    words = f"{leader} --string automated+human --controller idm_acc --seed 2 energy=bolt"
    words = [word.replace("+", " ") for word in words.split()]
    main([*words, "--steps", f"{steps}", "--vehicles", f"{vehicles}"])
    printed = capsys.readouterr().out
    assert "path_energy_kj" in printed
    assert "more:" not in printed
    main([f"{leader}", "--string", "human*42"])
    assert capsys.readouterr().out.endswith("and 3 more: --vehicles FILE has all\n")
    pd.testing.assert_frame_equal(pd.read_parquet(steps), found.steps, check_dtype=False)
    pd.testing.assert_frame_equal(pd.read_csv(vehicles), found.vehicles, check_dtype=False)
    cases = [
        ([*words, "--repeats", "0"], "argument --repeats: must be greater than or equal to 1"),
        ([*words, "--steps", f"{steps}"], "exists already; choose another --steps"),
        ([*words, "--steps", "steps.txt"], "argument --steps: .*csv|parquet"),
        (["none.csv"], r"none\.csv: no such file"),
        (["scenario=ring"], "leader=None needs scenario=ring and seconds"),
    ]
    check_refused(main, cases)


def test_networks_of_other_libraries_drive_as_their_exported_programs(tmp_path, caplog) -> None:
    torch.manual_seed(0)
    network = torch.nn.Sequential(torch.nn.Linear(7, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    module = TensorDictModule(network, ["observation"], ["action"])
    lcc_rl.export(network, tmp_path / "policy.onnx")
    found = [
        lcc_rl.simulate(WAVE, "automated human", x).steps
        for x in (network, {"mine": module}, tmp_path / "policy.onnx")
    ]
    pd.testing.assert_frame_equal(*found[:2], check_exact=True)
    motion = [steps.drop(columns="power_w") for steps in found[1:]]  # small powers: last digits
    pd.testing.assert_frame_equal(*motion, rtol=1e-3, atol=1e-3)
    network[2].bias.data.fill_(9.0)
    lcc_rl.simulate(WAVE, "automated human", network)
    assert "Sequential: 1e+02 % of its actions are beyond" in caplog.text
    expected = (
        r"expected a run, a file or a controller, got Seq.*; lcc_rl\.export\(…, 'policy.onnx'"
    )
    check_refused(Driver, [(network, 0.1, expected)], ConfigError)
