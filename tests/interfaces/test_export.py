"""Exported policies command what the environment's vehicles obey, filter included."""

from __future__ import annotations

import ctypes
import functools
import json
import shutil
import subprocess
import sys
import types
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import check_refused, play, small_env
from page_blocks import ROOT, blocks
from torch import nn

import lcc_rl
from lcc_rl.cli.export import main
from lcc_rl.config import load
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.interfaces.driver import Driver
from lcc_rl.interfaces.exported import DrivingProgram, described_input, program
from lcc_rl.pieces import Controller
from lcc_rl.results.policies import load_policy
from lcc_rl.settings import Positive


@pytest.fixture(scope="module")
def module() -> DrivingProgram:
    return program("pretrained/i80-follow")


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> dict[str, Path]:
    """Its files by their ending: an export takes seconds."""
    pytest.importorskip("onnxscript", reason="extra interfaces")
    folder = tmp_path_factory.mktemp("exported")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporters' own making
        return {
            end: lcc_rl.export("pretrained/i80-follow", folder / f"policy{end}")
            for end in (".onnx", ".pt2")
        }


def states(module: DrivingProgram, count: int = 256) -> torch.Tensor:
    chance = torch.Generator().manual_seed(0)
    return 20.0 * torch.rand(count, len(module.names), generator=chance)


def memories(module: DrivingProgram, count: int = 256) -> torch.Tensor:
    """Of filters: gaps of as many metres as are predicted, what they grow too fast [m/s], and the
    last measurements.
    """
    chance = torch.Generator().manual_seed(1)
    drawn, begun = torch.rand(count, 2, generator=chance), torch.ones(count, 2)
    last, missed = 20.0 * torch.rand(count, len(module.names)), torch.zeros(count, 1)
    return torch.cat([begun, 20.0 * drawn[:, :1], drawn[:, 1:] - 0.5, last, missed], -1)


def test_it_commands_what_the_vehicle_of_the_environment_obeys(module) -> None:
    own = load_policy("pretrained/i80-follow")[1]
    extra = ["+filter=cbf", "+observation.scales.ahead.acceleration=0.3", "agent=analytic"]
    env = small_env("alcc", 16, ["scenario.horizon=60", *extra], nominal=True)
    assert own.observation == load("train", ["variant=alcc", *extra]).observation

    def policy(td):
        state = torch.stack([value(td, name) for name in module.names], -1)
        acceleration, memory[0] = module(state, memory[0])
        said.append(acceleration.squeeze(-1))
        return td.set(("automated", "action"), said[-1].view(-1, 1, 1) / 3.0)

    said: list[torch.Tensor] = []
    memory = [torch.zeros(16, module.width)]
    record, _ = play(env, policy, None, [("automated", "command")])
    obeyed = record["automated", "command"].flatten(1)[-60:]
    # Filtered inside already, the environment's own filter changes nothing.
    torch.testing.assert_close(torch.stack(said)[: len(obeyed)], obeyed, atol=2e-3, rtol=0.0)


def value(td, name: str) -> torch.Tensor:
    view, entry = name.split(".")
    if view == "ahead":
        return td["leader", entry].squeeze(-1)
    return td["vehicles", entry][:, 0 if view == "self" else 1, 0]


def test_the_filter_is_inside(module) -> None:
    near = {"ahead.speed": 0.0, "self.gap": 5.0}
    state = torch.tensor([[near.get(name, 15.0) for name in module.names]])
    anew = torch.zeros(1, module.width)
    assert module(state, anew)[0].item() == -3.0
    assert all(x.isfinite().all() for x in module(torch.full_like(state, torch.nan), anew))


@pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_pytorch_program_computes_the_same_and_says_what_it_reads(module, exported) -> None:
    path = exported[".pt2"]
    about = {"lcc_rl": ""}
    loaded = torch.export.load(path, extra_files=about).module()
    given = (states(module), memories(module))
    torch.testing.assert_close(loaded(*given), module(*given))
    assert [item["name"] for item in json.loads(about["lcc_rl"])["inputs"]] == module.names
    assert "places ahead (traffic, value 2)" in described_input("traffic.speed.1").meaning
    with pytest.raises(ResultsError, match="exists already"):
        lcc_rl.export("pretrained/i80-follow", path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_onnxruntime_computes_the_same(module, exported) -> None:
    runtime = pytest.importorskip("onnxruntime", reason="extra interfaces")
    session = runtime.InferenceSession(exported[".onnx"])
    state, memory = states(module), memories(module)
    found = session.run(None, {"state": state.numpy(), "memory": memory.numpy()})
    for one, other in zip(found, module(state, memory), strict=True):
        np.testing.assert_allclose(one, other.numpy(), atol=1e-5)
    about = json.loads(session.get_modelmeta().custom_metadata_map["lcc_rl"])
    assert about["filter"] is True
    assert [item["name"] for item in about["inputs"]] == module.names


class Patient(Controller):
    """A controller with a memory, the mean of its gaps."""

    aim: Positive = 20.0  # [m]
    reads = ("self.gap",)
    remembers = ("mean",)

    def command(self, gap, mean):
        mean = 0.9 * mean + 0.1 * gap
        return 0.1 * (mean - self.aim), mean


def built(name: str, *paths: Path) -> Callable[..., float]:
    """Return a function of files in C, of arrays."""
    if (compiler := shutil.which("cc")) is None:
        pytest.skip("no C compiler")
    strict = "-std=c99 -O2 -Wall -Wextra -Wno-unused-function -pedantic -Werror -shared -fPIC"
    file = paths[0].with_suffix(".so")
    subprocess.run([compiler, *strict.split(), *paths, "-o", file, "-lm"], check=True)
    function = getattr(ctypes.CDLL(str(file)), name)
    function.restype = ctypes.c_float
    kind = ctypes.POINTER(ctypes.c_float)
    return lambda *arrays: function(*(x.ctypes.data_as(kind) for x in arrays))


OWN = {"own": Patient(aim=15.0), "mapping": {"mine_filtered": Patient()}}


@pytest.mark.parametrize("name", ["pretrained/i24-follow5", "idm_acc_filtered", "idm_acc", *OWN])
def test_c_code_computes_the_same(name, tmp_path) -> None:
    """With the memory of its own, through NaN, a lost target and another one."""
    driver = OWN.get(name, name)
    path = lcc_rl.export(driver, tmp_path / "follow.c")
    step = built("follow_step", path)
    module = Driver(driver, 0.1).program
    width, chance = len(module.names), np.random.default_rng(0)
    state, kept = 20.0 * chance.random((1, width)), np.zeros((1, module.width), np.float32)
    memory = [torch.zeros(1, module.width)] * bool(module.width)
    for k in range(60):
        state = np.abs(state + 0.3 * chance.normal(size=state.shape)).astype(np.float32)
        seen = state.copy()
        if memory and k in (20, 30, 31, 32):
            seen[0, k % width] = np.nan
        if memory and k in (40, 50, 51, 52):
            seen[0, k % width] = np.inf if k % 2 else -np.inf
        expected, *memory = (
            module(torch.from_numpy(seen), *memory) if memory else [module(torch.from_numpy(seen))]
        )
        found = step(seen, kept)
        assert found == pytest.approx(expected.item(), abs=2e-6, nan_ok=True), k
        assert np.isfinite(found) or np.isnan(seen).any()  # memories stay finite
        for one in memory:
            np.testing.assert_allclose(kept, one.numpy(), rtol=1e-6, atol=1e-6)
    head = path.read_text(encoding="utf-8")
    assert all(f": {column} [" in head for column in module.names)
    change = " or" if name.startswith("pretrained") else ", not when"
    assert f"]: zeros when the car begins{change} its target changes\n" in head


def test_the_age_of_a_target_is_the_same_in_simulation_driver_onnx_and_c(tmp_path) -> None:
    """Of the page's controller; also in a simulation of the ONNX file, with ages, and filtered."""
    ort = pytest.importorskip("onnxruntime", reason="extra interfaces")
    texts = [x.text for x in blocks(ROOT / "docs" / "controllers.md") if "# my_pieces" in x.text]
    exec("".join(texts), vars(sys.modules.setdefault("my_page", types.ModuleType("my_page"))))
    paths = {end: lcc_rl.export("my_page.coast", tmp_path / f"to{end}") for end in (".onnx", ".c")}
    lost, behind = ["+event=lost_target"], ["+filter=cbf", "safety.robust=false"]
    lost += [f"scenario.sensors.automated.{x}" for x in ("lost_from=5", "lost_for=3")]
    leader = 20.0 + 2.0 * np.sin(0.05 * np.arange(121))
    drive = functools.partial(lcc_rl.simulate, leader, "automated")
    driven = {"my_page.coast": [], paths[".onnx"]: [], "my_page.coast_filtered": behind}
    steps, again, filtered = (
        drive(x, overrides=lost + words).steps.query("vehicle == 1").reset_index()
        for x, words in driven.items()
    )
    np.testing.assert_allclose(again["speed_mps"], steps["speed_mps"], atol=1e-5)
    with pytest.raises(ConfigError, match=r"memory is for steps of 0\.1 s"):
        drive(paths[".onnx"], time_step=0.05)
    given, safe = Driver("my_page.coast", 0.1), Driver("my_page.coast_filtered", 0.1)
    driver, step = Driver("my_page.coast", 0.1), built("to_step", paths[".c"])
    session = ort.InferenceSession(paths[".onnx"])
    memory, kept = (np.zeros((1, driver.program.width), np.float32) for _ in range(2))

    def at(steps, k: int, last: int) -> dict[str, float]:
        age = {"self.target_age": np.float32(0.1) * (k - last), "ahead.speed": leader[last]}
        ahead = 10.0 * (leader[last] - leader[last - 1]) if last else 0.0
        own = {"self.speed": steps["speed_mps"][k], "self.gap": steps["gap_m"][last]}
        return {**own, **age, "ahead.acceleration": ahead}

    for k in range(120):
        held = at(steps, k, 50 if 50 < k <= 80 else k)
        seen = held if held["self.target_age"] == 0.0 else held | {"self.gap": np.nan}
        seen = seen | {"self.target_age": 0.0}
        state = np.array([[seen[name] for name in driver.names]], np.float32)
        acceleration, memory = session.run(None, {"state": state, "memory": memory})
        del seen["self.target_age"]
        found = [driver.step(seen), given.step(held), acceleration.item(), step(state, kept)]
        assert found == pytest.approx([steps["acceleration_mps2"][k + 1]] * 4, abs=1e-5), k
        command = safe.step(at(filtered, k, 50 if 50 < k <= 80 else k))
        assert command == pytest.approx(filtered["acceleration_mps2"][k + 1], abs=1e-4), k


def test_programs_in_c_with_steps_of_20_ms_share_a_program(tmp_path) -> None:
    files = [tmp_path / name for name in ("my-car.c", "2.c")]
    for file in files:
        lcc_rl.export(Patient(), file, overrides=["time_step=0.02"])
        assert '"time_step_s": 0.02' in file.read_text(encoding="utf-8")
    assert all(built(name, *files) for name in ("my_car_step", "_2_step"))


def test_a_measurement_that_is_no_number_brakes_or_shows(exported, tmp_path) -> None:
    """In every input of every format: clamp and minimum let NaN through, and hide nothing."""
    ort = pytest.importorskip("onnxruntime", reason="extra interfaces")
    network = nn.Sequential(nn.Linear(7, 1), nn.Hardtanh())
    plain = {end: lcc_rl.export(network, tmp_path / f"network{end}") for end in exported}
    for paths, wanted in ((exported, -3.0), (plain, np.nan)):
        session = ort.InferenceSession(paths[".onnx"])
        makes = torch.export.load(paths[".pt2"]).module()
        given = [one.name for one in session.get_inputs()]
        widths = [one.shape[1] for one in session.get_inputs()]
        inputs = json.loads(session.get_modelmeta().custom_metadata_map["lcc_rl"])["inputs"]
        usual = session.run(
            None,
            {
                x: np.full((1, w), 12.0 * (x == "state"), np.float32)
                for x, w in zip(given, widths, strict=True)
            },
        )[0][0]
        for rows in (1, 5):
            for column in range(widths[0]):
                state = torch.full((rows, widths[0]), 12.0)
                state[0, column] = torch.inf if wanted < 0.0 and rows > 1 else torch.nan
                entries = [state, *(torch.zeros(rows, width) for width in widths[1:])]
                feed = {name: x.numpy() for name, x in zip(given, entries, strict=True)}
                found = makes(*entries)
                found = found[0] if isinstance(found, tuple) else found
                for one in (session.run(None, feed)[0], found.detach().numpy()):
                    rear = "stand_in" in inputs[column]  # then a vehicle like the own one
                    assert rear == inputs[column]["name"].startswith("behind.")
                    np.testing.assert_allclose(one[0], usual if rear else wanted, rtol=1e-5)
                    assert np.isfinite(one[1:]).all()


def nothing(gap):
    return gap * torch.nan


def test_bad_input_is_one_clear_error() -> None:
    cases = [
        (["pretrained/alcc", "x.tflite"], "ending"),
        (["pretrained/nobody", "x.onnx"], "nobody"),
        (["pretrained/alcc", "x.onnx", "safety.margin=2"], "alcc has no safety filter"),
        (
            ["pretrained/i80-follow", "x.onnx", "+safety.margin=-2"],
            r"safety.margin must be greater",
        ),
        (["idm_acc", "x.c", "limits.max_braking=0"], "limits.max_braking must be greater than 0"),
        (
            ["idm_acc", "x.c", "scenario.max_braking=6"],
            r"\(.c\) takes safety.*no road; .*yaml file",
        ),
        (["pretrained/alcc", "x.c", "time_step=0.02"], "has the time step of its training"),
        (["idm_acc", "x.c", "time_step=20"], "time_step must be less than or equal to 0.5, got"),
        (["idm_ac", "x.onnx"], "idm_acc"),
        (["idm_acc", "x.html"], r"idm_acc: a page \(.html\) needs a run or a policy file"),
        ([f"{__name__}.nothing", "x.c"], "nothing cannot be exported: its command is not finite"),
        ([f"{__name__}.nothing_filtered", "x.c"], "nothing_filtered cannot be exported: its comm"),
        (
            ["follower_stopper", "x.c"],
            "memory of 602 numbers, is not .*: it takes .*; use .onnx or",
        ),
        (["human", "x.c"], "human draws noise from seeds: it cannot be exported"),
    ]
    check_refused(main, cases, ConfigError)
    with pytest.raises(ConfigError, match=r"safety\.… and limits\.… are given as arguments, too"):
        lcc_rl.export("idm_acc", "x.c", overrides=["limits.max_braking=6"], limits={})
    held = ["scenario.controllers.automated.hold=0.5"]
    with pytest.raises(ConfigError, match=r"controllers\.automated\.hold.* has no program"):
        lcc_rl.export(nn.Linear(7, 1), "x.onnx", overrides=held)
