"""ONNX programs that others made: the page's example, what they may hold, and what they command."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import POPULATION, check_refused, play, small_env, wavy_profiles
from page_blocks import ROOT, blocks
from tensordict import TensorDict

import lcc_rl
from lcc_rl.config import load
from lcc_rl.envs import Inputs, build_env
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import LccError
from lcc_rl.evaluation.episodes import evaluate
from lcc_rl.evaluation.named import controller_of, is_policy
from lcc_rl.evaluation.strategies import trained
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.interfaces.driver import Driver
from lcc_rl.interfaces.exported import NetworkController, driving, measuring
from lcc_rl.interfaces.onnx_policy import OnnxPolicy, Program
from lcc_rl.pieces import Action, Observation
from lcc_rl.pieces.knowledge import ObservationMemory
from lcc_rl.results.policies import load_policy

onnx = pytest.importorskip("onnx", reason="extra interfaces")
pytest.importorskip("onnxruntime", reason="extra interfaces")
GAP = {"name": "self.gap", "unit": "m"}
ABOUT = {"inputs": [GAP], "output": "acceleration [m/s²]"}


def written(path: Path, nodes, takes, makes, about=ABOUT, more=()) -> str:
    """Write a program; takes and makes are (name, width) of inputs and outputs."""
    kind = onnx.TensorProto.FLOAT
    sides = [
        [onnx.helper.make_tensor_value_info(name, kind, ["batch", width]) for name, width in side]
        for side in (takes, makes)
    ]
    graph = onnx.helper.make_graph(nodes, "g", *sides, list(more))
    opsets = [onnx.helper.make_opsetid("", 18)]
    model = onnx.helper.make_model(graph, opset_imports=opsets, ir_version=10)
    text = about if isinstance(about, str) else json.dumps(about)
    onnx.helper.set_model_props(model, {"lcc_rl": text})
    path.write_bytes(model.SerializeToString())
    return str(path)


def tenth(path: Path, about=ABOUT, takes=(("state", 1),)) -> str:
    """Write a program whose acceleration is a tenth of what it reads."""
    number = onnx.helper.make_tensor("c", onnx.TensorProto.FLOAT, [1], [0.1])
    node = onnx.helper.make_node("Mul", [takes[0][0], "c"], ["acceleration"])
    return written(path, [node], takes, [("acceleration", 1)], about, [number])


def test_the_example_of_the_page_needs_no_lcc_rl_and_drives(tmp_path, monkeypatch) -> None:
    pytest.importorskip("onnxscript", reason="extra interfaces")
    page = blocks(ROOT / "docs" / "interfaces.md")
    (text,) = (block.text for block in page if "torch.onnx.export" in block.text)
    assert len([line for line in text.splitlines() if line.strip()]) <= 24
    with monkeypatch.context() as alone, warnings.catch_warnings():
        for name in [name for name in sys.modules if name.partition(".")[0] == "lcc_rl"]:
            alone.setitem(sys.modules, name, None)  # an import of the package fails
        alone.chdir(tmp_path)
        warnings.simplefilter("ignore")
        exec(text, {})
    bound = OnnxPolicy(path=str(tmp_path / "follow.onnx")).bind(name=AUTOMATED)
    assert bound.names == ("self.gap", "self.speed", "ahead.speed")
    gap, speed, ahead = (torch.rand(5, 1, 1) * 20.0 for _ in range(3))
    expected = (0.2 * (gap - 2.0 - 1.3 * speed) + 0.8 * (ahead - speed)).clamp(-3.0, 3.0)
    torch.testing.assert_close(bound.compute(gap, speed, ahead)[0], expected)


def test_commands_are_held_within_the_largest_acceleration(tmp_path) -> None:
    path = tenth(tmp_path / "a.onnx")
    assert not is_policy(path)  # a file of weights
    bound = OnnxPolicy(path=controller_of(path).settings["path"]).bind()
    found = bound.compute(torch.tensor([[[20.0], [400.0]]]))[0]
    assert found.flatten().tolist() == [pytest.approx(2.0), 3.0]


def test_a_program_remembers_what_it_returned(tmp_path) -> None:
    takes, makes = [("state", 1), ("memory", 1)], [("acceleration", 1), ("next_memory", 1)]
    nodes = [
        onnx.helper.make_node("Add", ["memory", "state"], ["next_memory"]),
        onnx.helper.make_node("Identity", ["next_memory"], ["acceleration"]),
    ]
    path = written(tmp_path / "sum.onnx", nodes, takes, makes)
    cfg = load("evaluate", ["variant=idm", "scenario.horizon=3", "evaluation.warm_up=0"])
    env = build_env(cfg.driven_by(controller_of(path)), wavy_profiles(), POPULATION, 4)
    data = env.rollout(3, break_when_any_done=False)
    gaps = data["vehicles", "gap"][:, :, :1].cumsum(1).clamp(max=3.0)
    kept = data["next", "automated", "program"]
    torch.testing.assert_close(kept, data["vehicles", "gap"][:, :, :1].cumsum(1))
    torch.testing.assert_close(data["next", "automated", "command"], gaps)
    # Alike where another simulator measures, such as SUMO.
    driver = Driver(path, 0.1)
    for step in range(1, 4):
        assert driver.step({"self.gap": [1.0, 0.5]}).tolist() == [step, 0.5 * step]


@pytest.fixture(scope="module")
def follow(tmp_path_factory) -> str:
    """The shipped policy with a memory, exported."""
    pytest.importorskip("onnxscript", reason="extra interfaces")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter's own making
        path = tmp_path_factory.mktemp("exported") / "follow.onnx"
        return str(lcc_rl.export("pretrained/i24-follow5", path))


def test_an_exported_policy_that_remembers_drives_as_the_policy(follow) -> None:
    cfg = load(
        "evaluate",
        ["task=i24-follow5", "variant=alcc", "scenario.horizon=40", "evaluation.warm_up=0"],
    )
    weights = load_policy("pretrained/i24-follow5", "alcc")
    policy = trained(cfg, "pretrained", weights, POPULATION)
    program = replace(policy, cfg=policy.cfg.driven_by(controller_of(follow)), policy=None)
    inputs = Inputs(wavy_profiles(2), wavy_profiles(2), POPULATION)
    shown = ["cav_net_energy_kj", "mean_gap_m", "hdv_distance_m"]
    rows = [evaluate(one, inputs, 2, 10, seed=1)[0][shown] for one in (policy, program)]
    pd.testing.assert_frame_equal(*rows, rtol=1e-5)


def test_a_program_with_memory_holds_a_nan_once_then_brakes_and_begins_anew(follow) -> None:
    program = Program(follow)
    seen = {"self.gap": 25.0, "behind.gap": 20.0, "behind.present": 1.0}
    seen |= dict.fromkeys(("self.speed", "ahead.speed", "behind.speed"), 12.0)
    one = torch.tensor([seen.get(name, 0.0) for name in program.names])
    good = one.repeat(len(one), 1)
    bad = good.clone()
    bad.fill_diagonal_(torch.nan)  # one measurement of each row
    rear = torch.tensor([[name.startswith("behind.")] for name in program.names])
    zeros = torch.zeros(len(one), program.memory)
    first, memory = program(good, zeros)
    assert first.abs().max() < 1.0
    braking = torch.full_like(first, -3.0)
    usual = {"behind.gap": 25.0}  # a vehicle behind like the own one
    like_own = torch.tensor([(seen | usual).get(name, 0.0) for name in program.names])
    stand_in = program(like_own[None], zeros[:1])[0]
    held, lost = (torch.where(rear, stand_in, other) for other in (first, braking))
    for state, expected in ((bad, held), (bad, lost), (bad, lost), (good, first)):
        found, memory = program(state, memory)
        torch.testing.assert_close(found, expected)
    again, _ = program(good, zeros)
    torch.testing.assert_close(again, first)


@pytest.mark.parametrize(("knowledge", "kind"), [("memory", "stacked"), ("spread", "filtered")])
def test_it_remembers_as_the_piece_does(knowledge, kind) -> None:
    words = [f"+knowledge={knowledge}", f"scenario.pieces.memory.kind={kind}", "scenario.horizon=9"]
    words.append("evaluation.warm_up=0")
    env = small_env("alcc", 3, words, nominal=True)
    pieces = pieces_of(env)
    seen, action = (next(p for p in pieces if isinstance(p, k)) for k in (Observation, Action))
    memory = [piece for piece in pieces if isinstance(piece, ObservationMemory)]
    network = torch.nn.Linear(len(seen.factors), 1)
    controller = NetworkController(network=network, max_acceleration=action.max_acceleration)
    driver = driving([*memory, seen, controller], None, measuring(0.1))
    kept = torch.zeros(3, driver.width)

    whose = {"self": ("vehicles", 0), "ahead": ("leader", 0), "behind": ("vehicles", 1)}
    places = [(whose[view], entry) for view, entry in (n.split(".") for n in driver.names)]

    def policy(td: TensorDict) -> TensorDict:
        nonlocal kept
        state = [td[space, entry].view(3, -1)[:, [place]] for (space, place), entry in places]
        found, kept = driver(torch.cat(state, -1), kept)
        wanted = network(td["automated", "observation"]).clamp(-1.0, 1.0)
        torch.testing.assert_close(found.view(-1, 1, 1), 3.0 * wanted, atol=1e-4, rtol=0.0)
        return td.set(("automated", "action"), wanted)

    policy.in_keys = [("automated", "observation")]
    policy.in_keys += [(space, entry) for (space, _), entry in places]
    with torch.no_grad():
        play(env, policy, None, [("vehicles", "speed")])
    assert (kept[:, 0] == 1.0).all()


FOREIGN = [
    ({**ABOUT, "inputs": [{**GAP, "name": "leader.next_speed"}]}, "'leader.next_speed' is not"),
    ({**ABOUT, "inputs": [{**GAP, "name": "../../etc/passwd"}]}, "is not measured"),
    (
        {**ABOUT, "inputs": [{**GAP, "name": "traffic.speed.0"}]},
        "knowledge .* lacks: compare the p",
    ),
    ({**ABOUT, "inputs": [{**GAP, "unit": "ft"}]}, "self.gap is in m, got 'ft'"),
    ({**ABOUT, "inputs": [GAP, GAP]}, r"expected the input state \[batch, 2\]"),
    ({}, "lacks the metadata"),
    ({**ABOUT, "inputs": []}, "inputs"),
    ({**ABOUT, "output": "acceleration [g]"}, "output"),
    ({"inputs": [GAP]}, "output is required"),
    ("[1]", "must be a JSON object"),
    ("{", "are no JSON"),
]


def test_metadata_that_are_refused(tmp_path) -> None:
    check_refused(lambda about: controller_of(tenth(tmp_path / "a.onnx", about)), FOREIGN)


def test_files_that_are_refused(tmp_path) -> None:
    for name, content in (("none.onnx", None), ("text.onnx", b"text"), ("empty.onnx", b"")):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(LccError, match=name):
            controller_of(str(tmp_path / name))
    with pytest.raises(LccError, match=r"got \['other'\]"):
        controller_of(tenth(tmp_path / "a.onnx", takes=[("other", 1)]))


def test_a_program_names_no_other_file(tmp_path) -> None:
    (tmp_path / "weights").write_bytes(np.float32(0.1).tobytes())
    path = tenth(tmp_path / "a.onnx")
    model = onnx.load(path)
    (weight,) = model.graph.initializer
    weight.ClearField("float_data")
    weight.data_location = onnx.TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="weights")
    Path(path).write_bytes(model.SerializeToString())
    with pytest.raises(LccError, match=r"a\.onnx"):
        controller_of(path)
