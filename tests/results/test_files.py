"""Files are whole or not there, tables finite, and nothing in them runs; shipped policies."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch

from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import parquet_metadata, read_parquet, write_parquet
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.policies import load_policy, pretrained_path


def test_tables_and_weights_come_back_as_they_were(tmp_path) -> None:
    path, frame = tmp_path / "deep" / "a.parquet", pd.DataFrame({"x": [1.0, np.nan]})
    write_parquet(frame, path, {"lcc_rl.config": "abc"})
    pd.testing.assert_frame_equal(read_parquet(path), frame)
    assert pq.read_table(path)["x"].to_pylist() == [1.0, None]
    assert {"lcc_rl.config", "lcc_rl.schema", "lcc_rl.version"} <= set(parquet_metadata(path))
    write_torch({"a": torch.ones(2), "n": 3}, tmp_path / "w.pt")
    assert read_torch(tmp_path / "w.pt")["n"] == 3


def test_infinite_numbers_are_not_written(tmp_path) -> None:
    frame = pd.DataFrame({"gap_m": [1.0, np.nan, -np.inf]})
    with pytest.raises(ResultsError, match=r"a\.parquet: row 2, column 'gap_m' is infinite"):
        write_parquet(frame, tmp_path / "a.parquet")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fails() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("new, but")
            raise ValueError("half-way")

    with pytest.raises(ValueError, match="half-way"):
        fails()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_shipped_policy_says_where_it_comes_from_and_names_no_path() -> None:
    for variant in ("alcc", "reference"):
        weights, cfg = load_policy("pretrained", variant)
        assert cfg.variant == variant
        assert all(torch.isfinite(value).all() for value in weights.values())
        assert "seed" in read_torch(pretrained_path(variant))["provenance"]
    with pytest.raises(ConfigError, match="alcc"):
        load_policy("pretrained", "direct")
