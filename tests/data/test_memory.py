"""Memory of reading large tables."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pandas as pd

from lcc_rl.data import plausible, tables
from lcc_rl.data.sources import EpisodesSource

PAIRS, SAMPLES = 40, 3000


def written(path, rng: np.random.Generator) -> str:
    """Write a table of pairs, each with a follower one second behind its leader."""
    parts = []
    for pair in range(PAIRS):
        time = 0.1 * np.arange(SAMPLES)
        lead = 15.0 + rng.uniform(1.0, 3.0) * np.sin(time / rng.uniform(3.0, 9.0))
        own = np.append(np.full(10, lead[0]), lead[:-10])
        relative = lead - own
        way = np.append(0.0, np.cumsum(0.05 * (relative[1:] + relative[:-1])))
        columns = {"episode": pair, "recording": "made", "follower_id": 2 * pair + 2}
        columns |= {"leader_id": 2 * pair + 1, "time_s": time.round(1), "leader_length_m": 4.5}
        columns |= {"follower_speed_mps": own, "leader_speed_mps": lead, "gap_m": 25.0 + way}
        front = 100.0 + 0.1 * np.cumsum(lead)
        places = {"leader_position_m": front, "follower_position_m": front - 29.5 - way}
        parts.append(pd.DataFrame({**columns, **places}))
    pd.concat(parts).to_parquet(path, row_group_size=10_000)
    return str(path)


def test_a_table_of_pairs_takes_about_twice_its_memory(tmp_path, monkeypatch) -> None:
    for module in (plausible, tables):
        monkeypatch.setattr(module, "BATCH", 5000)
    source = EpisodesSource(path=written(tmp_path / "pairs.parquet", np.random.default_rng(0)))
    tracemalloc.start()
    try:
        episodes = source.load().episodes
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert len(episodes) == PAIRS * SAMPLES
    assert peak < 2.5 * episodes.memory_usage(deep=True).sum(), peak
