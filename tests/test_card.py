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


def test_the_page_on_composing_by_hand_prints_what_it_says(tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    page = blocks(ROOT / "docs" / "environment.md")
    (first,) = (n for n, block in enumerate(page) if "import torch\n" in block.text)
    for block in page[first:]:
        if block.language == "python":
            capsys.readouterr()
            with torch.random.fork_rng():
                exec(block.text, space)
        else:
            assert capsys.readouterr().out == block.text


def test_the_cacc_policy_is_a_transform_and_a_policy() -> None:
    rule = CACC().bind(World(time_step=0.2))
    assert isinstance(rule, Transform)
    errors = {f"{name}_error": torch.tensor([[[0.5]]]) for name in ("gap", "speed")}
    errors |= {f"leader_{name}": value for name, value in errors.items()}
    td = TensorDict({"vehicles": errors}, [1])
    policy = TensorDictSequential(ControllerPolicy(rule))
    command = rule(td.copy())["next", "command", "automated"]
    action = policy(td)["automated", "action"]
    torch.testing.assert_close(action, (command / 3.0).clamp(-1.0, 1.0))
    wanted = (0.04 * 0.5 + 0.12 * 0.5 + 1.4 * 0.5 + 1.3 * 0.5) / 0.2
    torch.testing.assert_close(command, torch.full((1, 1, 1), min(wanted, 3.0)))
