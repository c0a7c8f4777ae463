"""Summary tables by hand, and files that are whole or not there."""

import io
import os
import pickle

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import torch
from rich.console import Console

from lcc_rl.errors import ResultsError
from lcc_rl.io.atomic import atomic_path
from lcc_rl.io.files import parquet_metadata, read_parquet, write_parquet
from lcc_rl.io.tensors import read_torch, write_torch
from lcc_rl.results.tables import as_rich, summary


def episodes() -> pd.DataFrame:
    rows = []
    energies = {"direct": None, "idm": (100.0, 100.0), "reference": (90.0, 100.0)}
    energies["alcc"] = (95.0, 80.0)
    for strategy, cav in energies.items():
        for driver in range(2):
            own = np.nan if cav is None else cav[driver]
            rows.append(
                {
                    "strategy": strategy,
                    "profile_id": 0,
                    "driver_id": driver,
                    "cav_energy_kj": own,
                    "cav_net_energy_kj": own,
                    "hdv_energy_kj": 50.0,
                    "hdv_net_energy_kj": 40.0,
                    "total_energy_kj": own + 50.0,
                    "total_path_energy_kj": own + 40.0,
                    "total_net_energy_kj": own + 40.0,
                    "cav_distance_m": np.nan if cav is None else 500.0,
                    "hdv_distance_m": 500.0,
                    "collided": False,
                    "min_ttc_s": 5.0 + driver,
                    "share_ttc_unsafe": 0.1 * driver,
                    "share_time_gap_long": 0.0,
                    "rms_jerk_mps3": 1.0,
                }
            )
    return pd.DataFrame(rows)


def test_summary_by_hand() -> None:
    table = summary(episodes()).set_index("strategy")
    assert table.loc["alcc", "total_energy_kj"] == pytest.approx(137.5)  # (145 + 130)/2
    assert table.loc["alcc", "saving_vs_idm"] == pytest.approx(1 - 137.5 / 150)
    assert table.loc["alcc", "saving_vs_reference"] == pytest.approx(1 - 137.5 / 145)
    assert table.loc["alcc", "path_saving_vs_idm"] == pytest.approx(1 - 127.5 / 140)
    # Driver 0: 145 against 140 with the reference, worse; driver 1: 130 against 150, better.
    assert table.loc["alcc", "drivers_worse_than_reference"] == 0.5
    assert table.loc["alcc", "drivers_worse_than_idm"] == 0.0
    # One window, no seeds: nothing to resample.
    assert np.isnan(table.loc["alcc", "path_saving_vs_idm_low"])
    assert table.loc["alcc", "min_ttc_s"] == 5.0
    assert table.loc["alcc", "share_ttc_unsafe"] == pytest.approx(0.05)
    # 275 kJ over two episodes of two vehicles and 0.5 km each: 2 km.
    assert table.loc["alcc", "kj_per_km"] == pytest.approx(137.5)
    assert table.loc["direct", "kj_per_km"] == pytest.approx(100.0)
    assert np.isnan(table.loc["idm", "saving_vs_idm"])


def test_a_driver_that_gains_in_the_mean_may_lose_in_single_windows() -> None:
    first = episodes()
    # In the second window alcc costs driver 1 what it gains in the first, and half of it more.
    second = first.assign(profile_id=1)
    loser = (second["strategy"] == "alcc") & (second["driver_id"] == 1)
    second.loc[loser, "total_path_energy_kj"] += 30.0
    table = summary(pd.concat([first, second])).set_index("strategy")
    assert table.loc["alcc", "drivers_worse_than_idm"] == 0.0
    assert table.loc["alcc", "pairs_worse_than_idm"] == 0.25
    low, high = (table.loc["alcc", f"path_saving_vs_idm_{end}"] for end in ("low", "high"))
    # One window of two is drawn: 127.5 or 142.5 kJ against 140.
    assert (low, high) == pytest.approx((1 - 142.5 / 140, 1 - 127.5 / 140))


def test_table_fits_a_terminal_and_says_units() -> None:
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(as_rich(summary(episodes()), "title [x]"))
    text = console.export_text()
    assert "energy as drawn [kJ]" in text
    assert text.index("path energy [kJ]") < text.index("energy as drawn")
    assert "net of kinetic" not in text
    assert "title [x]" in text
    assert "+8.3%" in text
    assert "…" not in text


def test_parquet_round_trip_with_metadata(tmp_path) -> None:
    path = tmp_path / "deep" / "a.parquet"
    frame = pd.DataFrame({"x": [1.0, 2.0]})
    write_parquet(frame, path, {"lcc_rl.config": "abc"})
    pd.testing.assert_frame_equal(read_parquet(path), frame)
    metadata = parquet_metadata(path)
    assert metadata["lcc_rl.config"] == "abc"
    assert {"lcc_rl.schema", "lcc_rl.version", "lcc_rl.torch"} <= set(metadata)
    assert metadata["lcc_rl.processor"].strip()


def test_infinite_numbers_are_not_written_and_missing_ones_are_null(tmp_path) -> None:
    path = tmp_path / "a.parquet"
    for bad in (np.inf, -np.inf, np.float32("inf")):
        frame = pd.DataFrame({"gap_m": [1.0, np.nan, bad, bad]})
        with pytest.raises(ResultsError, match=r"a\.parquet: row 2, column 'gap_m' is infinite"):
            write_parquet(frame, path)
    assert list(tmp_path.iterdir()) == []
    write_parquet(pd.DataFrame({"gap_m": [1.0, np.nan]}), path)
    assert pq.read_table(path)["gap_m"].to_pylist() == [1.0, None]


def test_a_least_ttc_that_was_not_measured_is_a_dash() -> None:
    table = summary(
        episodes().assign(min_ttc_s=lambda rows: rows["min_ttc_s"].where(rows["strategy"] != "idm"))
    )
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(as_rich(table, "title"))
    row = next(line for line in console.export_text().splitlines() if "time-to-coll" in line)
    assert row.count("–") == table["min_ttc_s"].isna().sum() >= 1
    assert "1000" not in row


@pytest.mark.parametrize("read", [read_parquet, parquet_metadata])
def test_what_is_no_table_is_named(tmp_path, read) -> None:
    with pytest.raises(ResultsError, match=r"a\.parquet: no such file"):
        read(tmp_path / "a.parquet")
    (tmp_path / "a.parquet").write_bytes(b"PAR1 cut off")
    with pytest.raises(ResultsError, match=r"a\.parquet: not a readable parquet file"):
        read(tmp_path / "a.parquet")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fails_half_way() -> None:
        with atomic_path(path) as temporary:
            temporary.write_text("new, but")
            raise ValueError("half-way")

    with pytest.raises(ValueError, match="half-way"):
        fails_half_way()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_is_one_clear_error(tmp_path) -> None:
    if not os.path.exists("/dev/full"):
        pytest.skip("no /dev/full on this system")

    def fills_the_disk() -> None:
        with atomic_path(tmp_path / "a.txt"), open("/dev/full", "w") as full:
            full.write("x")
            full.flush()

    with pytest.raises(ResultsError, match=r"a\.txt: cannot be written: .*[Nn]o space"):
        fills_the_disk()
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_a_file(tmp_path) -> None:
    (tmp_path / "x").write_text("")
    with pytest.raises(ResultsError, match="cannot be written"):
        write_parquet(pd.DataFrame({"a": [1]}), tmp_path / "x" / "a.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1 nonsense", b"\x00" * 100])
def test_damaged_parquet(tmp_path, content) -> None:
    (tmp_path / "a.parquet").write_bytes(content)
    with pytest.raises(ResultsError, match=r"a\.parquet: not a readable parquet"):
        read_parquet(tmp_path / "a.parquet")


def test_newer_schema_is_refused(tmp_path) -> None:
    write_parquet(pd.DataFrame({"a": [1]}), tmp_path / "a.parquet", {"lcc_rl.schema": "99"})
    with pytest.raises(ResultsError, match=r"schema version .99."):
        read_parquet(tmp_path / "a.parquet")


class Evil:
    def __reduce__(self):
        return (os.mkdir, ("evil-was-here",))


def test_a_malicious_pickle_is_refused_and_not_run(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open("policy.pt", "wb") as file:
        pickle.dump(Evil(), file)
    with pytest.raises(ResultsError, match=r"policy\.pt"):
        read_torch("policy.pt")
    torch.save(Evil(), "zipped.pt")
    with pytest.raises(ResultsError, match=r"zipped\.pt"):
        read_torch("zipped.pt")
    assert not os.path.exists("evil-was-here")


def test_weights_round_trip(tmp_path) -> None:
    write_torch({"a": torch.ones(2), "n": 3}, tmp_path / "w.pt")
    content = read_torch(tmp_path / "w.pt")
    assert torch.equal(content["a"], torch.ones(2))
    assert content["n"] == 3
