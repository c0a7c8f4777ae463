"""Tables of many runs: settings as columns, and damaged runs beside good ones."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml
from helpers import check_refused

from lcc_rl import results
from lcc_rl.commands import animate
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.io import files
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.results.runs import differences
from lcc_rl.results.sweeps import load_sweep
from lcc_rl.runs.overview import main as status

TABLE = "episodes.parquet"


def episodes(seed: int, rows: int = 6) -> pd.DataFrame:
    energy = np.random.default_rng(seed).random(rows)
    strategy, count = ["idm", "alcc"] * (rows // 2), pd.array([None, 3] * (rows // 2), "Int64")
    return pd.DataFrame({"strategy": strategy, "training_seed": count, "energy_kj": energy})


def made(folder: Path, seed: int = 0, **settings: object) -> Path:
    folder.mkdir(parents=True)
    content = {"seed": seed, "variant": "alcc", "agent": {"gamma": 0.9}, "trust": [], **settings}
    (folder / "config.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    write_parquet(episodes(seed), folder / TABLE)
    return folder


# -- settings --------------------------------------------------------------------------------------


def test_rows_are_those_of_the_files_beside_the_settings_that_are_named(tmp_path) -> None:
    made(tmp_path / "b" / "2", 5, agent={"gamma": 0.9, "tau": 0.1})
    made(tmp_path / "b" / "1", 7)
    own = pd.concat([episodes(7), episodes(5)], ignore_index=True)
    for names, columns in (
        (None, ["run", "seed", "variant", "agent.tau"]),
        ([], ["run"]),
        (["seed"], ["run", "seed"]),
        (["agent.*"], ["run", "agent.gamma", "agent.tau"]),
        (["*"], ["run", "seed", "variant", "agent.gamma", "trust", "agent.tau"]),
    ):
        frame = results.load(tmp_path, settings=names)
        assert list(frame.columns[3:]) == columns
        assert frame["run"].tolist() == ["b/1"] * 6 + ["b/2"] * 6
        assert frame["training_seed"].dtype == own["training_seed"].dtype
        pd.testing.assert_frame_equal(frame[own.columns].astype({"strategy": str}), own)
        found = results.load(tmp_path, settings=names, lazy=True).to_table().to_pandas()
        found = found.astype({"training_seed": "Int64"})
        pd.testing.assert_frame_equal(found.astype(object), frame.astype(object), check_exact=True)
        if "agent.tau" in columns:
            assert frame.groupby("run")["agent.tau"].first().tolist()[1] == 0.1


def test_a_job_counts_each_episode_once(tmp_path) -> None:
    for name in ("alcc", "evaluation"):
        write_parquet(pd.DataFrame({"iteration": [1]}), made(tmp_path / name) / "training.parquet")
    (tmp_path / "evaluation" / "training.parquet").unlink()
    (tmp_path / ".parts").mkdir()
    assert set(results.load(tmp_path)["run"]) == {"evaluation"}
    assert set(results.load(tmp_path, "training")["run"]) == {"alcc"}
    (tmp_path / "evaluation" / TABLE).unlink()
    assert set(results.load(tmp_path)["run"]) == {"alcc"}  # stopped before its end


def test_a_repeated_run_and_one_with_more_text_are_read_and_named(tmp_path, caplog) -> None:
    made(tmp_path / "first", 5)
    again, other = made(tmp_path / "again", 5), made(tmp_path / "other", 7)
    write_parquet(episodes(7).assign(source="highway"), other / TABLE)
    frame = results.load(tmp_path)
    assert frame["source"].astype(object).fillna("").tolist() == [""] * 12 + ["highway"] * 6
    assert frame.attrs["repeated"] == ["again, first (runs of equal settings)"]
    assert "again, first" in caplog.text
    with pytest.raises(ResultsError, match=r"again, first \(runs of equal settings\)"):
        results.load(tmp_path, strict=True)
    shutil.rmtree(again)
    assert "repeated" not in results.load(tmp_path, strict=True).attrs


def test_what_tells_runs_apart_is_few_settings_by_their_last_words() -> None:
    weights = [{"a.weight": w, "b.weight": 1.0, "gamma": 0.9, "inputs.data": w} for w in (0, 1)]
    for settings, expected in (
        (weights, ["a.weight=0", "a.weight=1"]),
        # Of settings that change together the one with most values is enough.
        ([{"rate": r, "kind": r > 1} for r in (1, 2, 3)], ["rate=1", "rate=2", "rate=3"]),
        (
            [{"a.gamma": g, "a.rate": r, "c": 0} for g in (0, 1) for r in (2, 3)],
            [f"a.gamma={g}, a.rate={r}" for g in (0, 1) for r in (2, 3)],
        ),
        ([{"inputs.data": "x"}, {"inputs.data": "y"}], ["inputs.data=x", "inputs.data=y"]),
        ([{"seed": 0}, {"seed": 0, "other.seed": 1}], ["", "other.seed=1"]),
        ([{"seed": 0}, {"seed": 0}], ["", ""]),
    ):
        assert [", ".join(one.values()) for one in differences(settings)] == expected


def sweep_of(root: Path, *runs: dict[str, object], **columns: object) -> pd.DataFrame:
    """Read a sweep over weights and seeds; the controllers that learn nothing are the same."""
    for place, settings in enumerate(runs):
        folder = made(root / str(place), **settings)
        seed, weight = settings["seed"], settings.get("w", float("table" in settings))
        rows = pd.DataFrame({"strategy": ["idm", "alcc"], "training_seed": [None, seed]})
        rows = rows.assign(profile_id=0, leader_speed_mps=9.0, **columns)
        rows["energy_kj"] = [settings.get("base", 5.0), weight]
        rows = rows.astype({"training_seed": "Int64"})
        if "leader" in settings:
            rows["leader_speed_mps"] = settings["leader"]
        write_parquet(rows, folder / TABLE)
    return load_sweep(root)


def test_the_runs_of_a_sweep_are_read_as_one_evaluation(tmp_path) -> None:
    grid = [{"w": w, "seed": seed} for w in (0.5, 2.0) for seed in (0, 1)]
    rows = sweep_of(tmp_path / "grid", *grid)
    names = ["idm", *["alcc w=0.5"] * 2, *["alcc w=2.0"] * 2]
    assert rows["strategy"].tolist() == names
    assert rows["training_seed"].tolist() == [pd.NA, 0, 1, 0, 1]
    assert sweep_of(tmp_path / "seeds", *grid[:2])["strategy"].tolist() == ["idm", "alcc", "alcc"]
    runs = [{"seed": seed, "base": base} for base in (5.0, 6.0) for seed in (0, 1)]
    rows = sweep_of(tmp_path / "events", *runs)  # each beside its own baseline
    found = rows.groupby("source", sort=False)["strategy"].unique().map(list).to_dict()
    assert found == {f"base={x}": ["idm", "alcc"] for x in (5.0, 6.0)}
    assert not rows.attrs["remarks"]
    energies = [{"seed": seed, "energy": {"scale": x}} for x in (1, 9) for seed in (0, 1)]
    *_, remark = sweep_of(tmp_path / "energies", *energies).attrs["remarks"]
    assert remark.endswith("vehicles differ: energy.scale=1 and energy.scale=9.")
    rounded = [{"seed": seed, "base": 5.0 + 1e-6 * seed} for seed in (0, 1)]
    assert "source" not in sweep_of(tmp_path / "machines", *rounded)
    refusals = [
        ([{"seed": 0}, {"seed": 0, "table": "all"}], "training twice: alcc, seed 0: 0 and 1$"),
        ([{"seed": 0}, {"seed": 1, "leader": 8.0}], r"have different leaders .*results\.load"),
        ([{"seed": 0, "leader": x} for x in (8.0, 9.0)], r"\(leader=8.0 and leader=9.0\).*/0; "),
    ]
    for place, (runs, words) in enumerate(refusals):
        with pytest.raises(ConfigError, match=words):
            sweep_of(tmp_path / f"wrong{place}", *runs)


def test_rows_of_changed_code_are_named(tmp_path, monkeypatch, caplog) -> None:
    for seed, version in enumerate(("1.0+a", "1.0+a", "1.0+b")):
        monkeypatch.setattr(files, "code_version", lambda version=version: version)
        made(tmp_path / str(seed), seed=seed)
        line = "rows of several versions: 0, 1 (lcc_rl 1.0+a); 2 (lcc_rl 1.0+b)"
        assert results.load(tmp_path).attrs.get("versions") == ([line] if seed == 2 else None)
    assert line in caplog.text


def test_an_unknown_setting_is_refused_with_the_nearest(tmp_path) -> None:
    hydra = made(tmp_path / "a") / ".hydra"
    hydra.mkdir()
    (hydra / "overrides.yaml").write_text("- ++reward.without=safety\n- ++seed=9")
    frame = results.load(tmp_path, settings=["seed", "reward.*"])  # stored and only typed ones
    with patch("lcc_rl.results.loading.choices_of", lambda _: pytest.fail("not needed")):
        assert list(results.load(tmp_path, settings=["seed"])["seed"]) == list(frame["seed"])
    found = frame.groupby(["reward.without", "seed"], observed=True).size()
    assert found.to_dict() == {("safety", 0): 6}
    with pytest.raises(ConfigError, match=r"'agent.gama'.*Did you mean 'agent.gamma'"):
        results.load(tmp_path, settings=["seed", "agent.gama"])
    with pytest.raises(ConfigError, match=r"'nothing\.\*'; settings=\['\*'\] returns all \d+\.$"):
        results.load(tmp_path, settings=["nothing.*"])


# -- damaged runs ----------------------------------------------------------------------------------


def rewritten(folder: Path, key: bytes, value: bytes) -> None:
    table = pq.read_table(folder / TABLE)
    metadata = {**table.schema.metadata, key: value}
    pq.write_table(table.replace_schema_metadata(metadata), folder / TABLE)


def flipped(folder: Path) -> None:
    """Change a byte of the first page, which its checksum shows."""
    content = bytearray((folder / TABLE).read_bytes())
    content[60] ^= 1
    (folder / TABLE).write_bytes(content)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "text": lambda folder: (folder / TABLE).write_text("x"),
    "page": flipped,
    "schema": lambda folder: rewritten(folder, b"lcc_rl.schema", b"\xff"),
    "pandas": lambda folder: rewritten(folder, b"pandas", b"{broken"),
    "foreign": lambda folder: pd.DataFrame({"a": [1]}).to_parquet(folder / TABLE),
    "typed": lambda folder: write_parquet(
        episodes(0).assign(energy_kj=["much"] * 6), folder / TABLE
    ),
    "yaml": lambda folder: (folder / "config.yaml").write_text(": ["),
    "scenario": lambda folder: (folder / "config.yaml").write_text("scenario: x"),
}


def test_a_flipped_bit_at_the_end_of_a_table_is_named_or_harmless(tmp_path) -> None:
    file = made(tmp_path / "run") / TABLE
    content, refused = file.read_bytes(), 0
    for place in range(9, len(content) - 400, 35):
        file.write_bytes(content[:-place] + bytes([content[-place] ^ 128]) + content[1 - place :])
        try:
            assert len(results.load(tmp_path, strict=True)) == 6
        except ResultsError:
            refused += 1
    assert refused > 10


def test_damaged_runs_are_named_in_a_line_each_and_the_rest_is_read(tmp_path, caplog) -> None:
    for name, damage in DAMAGES.items():
        damage(made(tmp_path / name))
    made(tmp_path / "good" / "1", 1)
    made(tmp_path / "good" / "2", 2)
    frame = results.load(tmp_path)
    assert set(frame["run"]) == {"good/1", "good/2"}
    assert frame.attrs["damaged"].keys() == DAMAGES.keys()
    lines = [record.getMessage() for record in caplog.records]
    assert len(lines) == len(DAMAGES)
    assert all("\n" not in line and str(tmp_path) in line for line in lines)
    assert results.load(tmp_path, lazy=True).schema.names == list(frame.columns)
    with pytest.raises(ResultsError, match=r"text \(failed: episodes\.parquet is cut or damaged\)"):
        results.load(tmp_path, strict=True)
    for name in DAMAGES.keys() - {"typed"}:  # which is wrong beside others only
        with pytest.raises(ResultsError, match=f"none is readable: .*{name}"):
            results.load(tmp_path / name)


def test_broken_metadata_of_pandas_is_one_line(tmp_path) -> None:
    folder = made(tmp_path / "a")

    def read(broken: bytes) -> None:
        rewritten(folder, b"pandas", broken)
        read_parquet(folder / TABLE)

    words = r"a/episodes\.parquet: damaged"
    cases = [(broken, words) for broken in (b"{broken", b"[]", b'{"columns": 5}')]
    check_refused(read, cases, ResultsError)


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """Return a folder of a user whom permissions bind, as which the test works."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        if not os.access(__file__, os.R_OK, effective_ids=True):
            pytest.skip("a clone that only root can read")
        with TemporaryDirectory() as folder:
            yield Path(folder)
    finally:
        os.seteuid(user)


def test_a_folder_that_cannot_be_entered_is_named(open_folder, capsys) -> None:
    made(open_folder / "good")
    closed = made(open_folder / "closed")
    closed.chmod(0o000)
    try:
        frame = results.load(open_folder)
        assert set(frame["run"]) == {"good"}
        assert frame.attrs["damaged"].keys() == {"closed"}
        status([str(open_folder)])
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == 3
        assert "closed  cannot be read: Permission denied" in lines[0]
        with pytest.raises(OSError, match="closed"):  # which commands show in a line
            animate.run(closed)
    finally:
        closed.chmod(0o700)


MOVED = {
    "strategy": ["idm"] * 2,
    "training_seed": [0, 0],
    "profile": ["a"] * 2,
    "driver_id": [1, 1],
}
MOVED |= {"time_s": [0.1, 0.2], "cav_speed": [9.0, 9.0], "cav_gap": [20.0, 20.0]}


def test_an_animation_of_foreign_files_is_refused_in_a_line(tmp_path) -> None:
    lacks = r"\d: not written by a run: KeyError: "
    cases = [
        ({"strategy": ["idm"] * 2}, {}, lacks + "'training_seed'"),
        ({"a": [1]}, {}, lacks + "'strategy'"),
        (MOVED, {}, lacks + "'scenario'"),
        (MOVED, {"scenario": "x"}, r"config\.yaml: damaged: scenario must be a mapping .*'x'"),
        (MOVED, {"scenario": {"road": 3}}, lacks + "'string'"),
    ]

    def animated(steps: dict[str, object], settings: dict[str, object]) -> None:
        folder = made(tmp_path / str(len([*tmp_path.iterdir()])), **settings)
        write_parquet(pd.DataFrame(steps), folder / "steps.parquet")
        animate.run(folder)

    check_refused(animated, cases, ResultsError)
