"""The design card's sentences: each piece is a TensorDict transform that composes into envs."""

from __future__ import annotations

import torch
from page_blocks import ROOT, blocks
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs.transforms import Transform

from lcc_rl.agents.controller import ControllerPolicy
from lcc_rl.pieces import CACC
from lcc_rl.pieces.world import World


def test_the_program_that_composes_by_hand_prints_what_the_page_shows(capsys) -> None:
    page = blocks(ROOT / "docs" / "environment.md")
    command, shown = next(b.text for b in page if "by_hand.py" in b.text).split("\n", 1)
    with torch.random.fork_rng():
        exec((ROOT / command.removeprefix("$ python ")).read_text(), {})
    assert capsys.readouterr().out == shown


def test_the_cacc_policy_is_a_transform_and_a_policy() -> None:
    rule = CACC().bind(World(time_step=0.2))
    assert isinstance(rule, Transform)
    errors = {f"{name}_error": torch.tensor([[[0.5]]]) for name in ("gap", "speed")}
    errors |= {f"leader_{name}": value for name, value in errors.items()}
    td = TensorDict({"vehicles": errors}, [1])
    policy = TensorDictSequential(ControllerPolicy(rule))
    command = rule(td.copy())["next", "automated", "command"]
    action = policy(td)["automated", "action"]
    torch.testing.assert_close(action, (command / 3.0).clamp(-1.0, 1.0))
    wanted = (0.04 * 0.5 + 0.12 * 0.5 + 1.4 * 0.5 + 1.3 * 0.5) / 0.2
    torch.testing.assert_close(command, torch.full((1, 1, 1), min(wanted, 3.0)))
