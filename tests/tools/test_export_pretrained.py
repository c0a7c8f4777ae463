"""The tool that ships a policy leaves out what belongs to one machine."""

from __future__ import annotations

import export_pretrained
import torch

from lcc_rl.config import load
from lcc_rl.io.tensors import read_torch
from lcc_rl.results.policies import save_policy


def test_an_exported_policy_names_its_provenance_and_no_path(tmp_path) -> None:
    cfg = load("train", ["variant=alcc", "data=episodes", "data.path=/home/me"])
    cfg = cfg.with_(inputs={"data": {"/home/me/a.parquet": "1"}})
    save_policy({"w": torch.ones(1)}, cfg, tmp_path / "policy.pt")
    path = export_pretrained.export(tmp_path / "policy.pt", "a trial", tmp_path / "out")
    content = read_torch(path)
    assert "variant: alcc\n" in content["config"]
    assert "/home/me" not in content["config"]
    assert "a.parquet: '1'" in content["config"]
    assert content["provenance"].startswith("a trial")
