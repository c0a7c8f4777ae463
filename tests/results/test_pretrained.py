"""The policies that ship with the package, and the tool that puts them there."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
import torch

from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.errors import ConfigError
from lcc_rl.io.tensors import read_torch
from lcc_rl.results.policies import load_policy, pretrained_path, save_policy
from lcc_rl.results.savings import UNTRAINED

TOOL = Path(__file__).resolve().parents[2] / "tools" / "export_pretrained.py"
TINY = ("experiment=smoke", "data.platoons=4", "data.recordings=2", "scenario.horizon=40")


@pytest.mark.parametrize("name", ["alcc_limits", "alcc_mixture"])
def test_policies_learned_within_limits_keep_their_filter_and_their_names(name, tmp_path) -> None:
    _, cfg = load_policy(f"pretrained/{name}")
    assert cfg.scenario.filters["automated"]["time_gap"] == 2.45
    assert (cfg.data, cfg.drivers, cfg.leader, cfg.split) == (None,) * 4
    how = ["variant=alcc", "policy=pretrained", f"compare=[pretrained/{name}]"]
    how += ["evaluation.baselines=[idm]"]
    rows = evaluation.run(load("evaluate", [*TINY, *how]), tmp_path, quiet=True)
    # Two ways to learn are no seeds of one.
    assert set(rows["strategy"]) == {"idm", "alcc pretrained", f"alcc {name}"}
    kept = rows[rows["strategy"] == f"alcc {name}"]
    assert (kept["share_ttc_unsafe"] - kept["share_ttc_unpromised"]).max() == 0.0


@pytest.mark.parametrize("variant", ["alcc", "reference"])
def test_a_shipped_policy_says_where_it_comes_from_and_names_no_path(variant) -> None:
    weights, cfg = load_policy("pretrained", variant)
    assert cfg.variant == variant
    assert all(torch.isfinite(value).all() for value in weights.values())
    assert (cfg.data, cfg.drivers, cfg.split) == (None,) * 3
    assert "seed" in read_torch(pretrained_path(variant))["provenance"]


def test_evaluate_the_shipped_policies(tmp_path) -> None:
    how = ["variant=alcc", "policy=pretrained", "compare=[pretrained/reference]"]
    rows = evaluation.run(load("evaluate", [*TINY, *how]), tmp_path, quiet=True)
    assert {*UNTRAINED, "alcc", "reference"} == set(rows["strategy"])


def test_a_variant_without_a_shipped_policy_says_which_have_one() -> None:
    with pytest.raises(ConfigError, match="alcc"):
        load_policy("pretrained", "direct")


def test_export_leaves_out_what_belongs_to_one_machine(tmp_path) -> None:
    spec = importlib.util.spec_from_file_location("export_pretrained", TOOL)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    cfg = load("train", ["variant=alcc", "data=episodes", "data.path=/home/me"])
    save_policy({"w": torch.ones(1)}, cfg, tmp_path / "policy.pt")
    content = read_torch(tool.export(tmp_path / "policy.pt", "a trial", tmp_path / "out"))
    assert "variant: alcc\n" in content["config"]
    assert "/home/me" not in content["config"]
    assert content["provenance"].startswith("a trial")
