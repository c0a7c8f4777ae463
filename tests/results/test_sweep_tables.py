"""Tables of sweeps: a row per setting, named by what was varied, and what is missing in it."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
import yaml
from helpers import check_refused
from study_frames import episodes

from lcc_rl import results
from lcc_rl.cli import table
from lcc_rl.commands.table import read_run
from lcc_rl.config import load
from lcc_rl.errors import ConfigError, ResultsError
from lcc_rl.figures.evaluation import measures_of
from lcc_rl.io.files import write_parquet
from lcc_rl.io.tensors import write_torch
from lcc_rl.results import names
from lcc_rl.results.report import report, windows_for
from lcc_rl.results.runs import EPISODES, save_config
from lcc_rl.results.sweeps import labels, load_sweep, without_effect
from lcc_rl.runs.overview import main as status
from lcc_rl.runs.plans import PLAN, SweepPlan, read_plan, unfinished

WEIGHT = "reward.terms.efficiency.weight"


def cell(root: Path, seed: int, weight: str, *words: str, rows: bool = True, shift=0.0) -> Path:
    """Make a run of a sweep over seeds and weights, with two windows of three drivers."""
    folder = root / f"seed={seed}+{WEIGHT}={weight}_{seed:04d}{abs(hash(weight)) % 10**4:04d}"
    (folder / ".hydra").mkdir(parents=True)
    typed = ["variant=alcc", *words, f"++seed={seed}", f"++{WEIGHT}={weight}"]
    (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(typed))
    if rows:
        save_config(load("train", ["variant=alcc", f"seed={seed}", f"{WEIGHT}={weight}"]), folder)
        frame = episodes(profiles=6)
        frame = frame[(frame["strategy"] == "alcc") & (frame["training_seed"] == 0)]
        frame = frame.assign(training_seed=seed)
        for name in frame.columns[frame.columns.str.endswith("energy_kj")]:
            frame[name] += shift
        write_parquet(frame.astype({"training_seed": "Int64"}), folder / EPISODES)
        weights = torch.tensor([float(seed), shift])
        write_torch({"weights": {"a": weights}, "config": weight}, folder / "policy.pt")
    return folder


def sweep(root: Path) -> Path:
    """Make a sweep: two equal settings, and failed, stopped, waiting and damaged runs."""
    plan = {"runs": 12, "varied": ["seed", WEIGHT], "values": [["0", "1", "2"], [*"1248"]]}
    root.mkdir()
    (root / "sweep.json").write_text(json.dumps(plan))
    for seed in (0, 1, 2):
        (cell(root, seed, "1", rows=False) / "error.txt").write_text("must be a number\n")
        cell(root, seed, "2", shift=float(seed))
        if seed:
            cell(root, seed, "4", shift=float(seed))
    save_config(load("train", ["variant=alcc"]), cell(root, 0, "4", rows=False))
    cell(root, 0, "8", shift=9.0)
    (cell(root, 1, "8", shift=3.0) / EPISODES).write_text("x")
    return root


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return sweep(tmp_path_factory.mktemp("sweeps") / "mine")


def test_a_later_command_in_a_sweep_s_folder_forgets_no_cell(tmp_path) -> None:
    first = SweepPlan(4, ["seed", WEIGHT], [["0", "1"], ["1", "2"]])
    single, again = SweepPlan(1), SweepPlan(2, ["seed"], [["0", "7"]])
    cell(tmp_path, 0, "1")
    found = []
    for plan in (first, single, again, first):
        plan = plan.after(read_plan(tmp_path))
        (tmp_path / PLAN).write_text(json.dumps(asdict(plan)))
        found.append(sorted(unfinished(tmp_path)))
    waiting = sorted(f"seed={seed}+{WEIGHT}={x}" for seed, x in ((0, 2), (1, 1), (1, 2)))
    assert found == [waiting, waiting, sorted([*waiting, "seed=7"]), sorted([*waiting, "seed=7"])]


def test_cells_that_are_one_run_wait_once_and_end_together(tmp_path) -> None:
    first = SweepPlan(2, ["w", "seed"], [["1", "1.0"], ["0", "1"]], ["a" * 8, "b" * 8] * 2)
    other = SweepPlan(2, ["seed"], [["0", "1"]], ["a" * 8, "b" * 8])
    same_words = SweepPlan(2, ["seed"], [["0", "1"]], ["c" * 8, "a" * 8])
    (tmp_path / f"w=1+seed=0_{'a' * 8}").mkdir()
    (tmp_path / f"w=1+seed=0_{'a' * 8}" / EPISODES).write_bytes(b"PAR1 rows PAR1")
    for plan, waiting in (
        (first, ["w=1+seed=1"]),
        (other.after(first), ["seed=1"]),
        (same_words.after(other), ["seed=0", "seed=1"]),
    ):
        (tmp_path / PLAN).write_text(json.dumps(asdict(plan)))
        assert [*unfinished(tmp_path)] == waiting


def words_of(text: str) -> str:
    """Return a text without line breaks, frames and marks of comments."""
    return " ".join(re.sub(r"\n%|[\n\\]", " ", text).split())


MISSING = (
    "seed=0+efficiency.weight=1, seed=1+efficiency.weight=1, seed=2+efficiency.weight=1 "
    "(failed: must be a number)",
    "seed=0+efficiency.weight=4 (stopped)",
    "seed=2+efficiency.weight=8 (waiting)",
    "seed=1+efficiency.weight=8 (damaged: episodes.parquet: not readable as parquet",
)


def test_runs_without_rows_are_listed_wherever_a_sweep_is_read(root, capsys, caplog) -> None:
    frame = results.load(root)
    assert frame["run"].nunique() == 6
    states = {re.sub("_[0-9]{8}$", "", key): x for key, x in frame.attrs["unfinished"].items()}
    assert states == {
        **{f"seed={seed}+{WEIGHT}=1": "failed: must be a number" for seed in (0, 1, 2)},
        f"seed=0+{WEIGHT}=4": "stopped",
        f"seed=2+{WEIGHT}=8": "waiting",
    }
    assert len(frame.attrs["damaged"]) == 1
    assert "efficiency.weight=8 (waiting)" in caplog.text
    cases = [
        (True, name, r"not finished: .*=1 \(failed: must") for name in ("episodes", "training")
    ]
    check_refused(lambda strict, name: results.load(root, name, strict=strict), cases, ResultsError)
    status([str(root)])
    assert capsys.readouterr().out.count("\n") == 12  # and the line of all
    for words in ([], ["--all"], ["--format=latex"], ["--format=markdown"]):
        table.main([str(root), *words])
        printed = words_of(capsys.readouterr().out)
        if words != ["--all"]:
            assert all(one in printed for one in MISSING), printed
    one = report_of(root, "alcc efficiency.weight=4")
    figure = measures_of(one, [replace(one, short=one.short.drop(columns=one.shown[-2].key))])
    equal = measures_of(replace(one, short=one.short.assign(collisions_per_seed=2.0)))
    assert 0.0 in [x.get_xlim()[0] for x in equal.axes if x.get_xlabel().startswith("colli")]
    noted = words_of(figure._supxlabel.get_text())
    assert noted.startswith("6 windows × 3 drivers, 600 steps, after 20 s; lines: 95 % intervals ")
    assert all(one in noted for one in ("saved: against", *MISSING))
    # A folder of failed runs only is one line.
    for run in root.glob("*=1_*"):
        with pytest.raises(ResultsError, match="failed: must be a number"):
            results.load(run)


def report_of(root: Path, against: str | None = None):
    return read_run(root, ()).reports(against)[0]


def test_rows_are_settings_and_have_their_seeds(root, capsys) -> None:
    rows = load_sweep(root)
    found = rows.groupby("strategy")["training_seed"].unique().map(list).to_dict()
    assert found == {
        f"alcc efficiency.weight={x}": y
        for x, y in zip("248", ([0, 1, 2], [1, 2], [0]), strict=True)
    }
    one = report_of(root)
    table_ = one.short.set_index("strategy")
    assert sorted(table_["seeds"]) == [1, 2, 3]
    assert (set(table_["windows"]), set(table_["drivers"])) == ({6}, {3})
    marked = [name for name in table_["driver"] if name.endswith("‡")]
    assert marked == ["network (efficiency.weight=8) ‡"]
    assert any("one training seed" in line for line in one.remarks)
    # Two settings with the same weights are said to be so.
    assert without_effect(root) == [
        f"{WEIGHT} had no effect: the networks of equal seeds are the same with "
        "efficiency.weight=2 and efficiency.weight=4."
    ]
    # Compared by equal seeds: with those of seeds 1 and 2 nothing is saved.
    compared = report_of(root, "alcc efficiency.weight=4")
    saved = compared.short.set_index("strategy")["saved_pct"]
    assert saved["alcc efficiency.weight=2"] == pytest.approx(0.0, abs=1e-9)
    assert (
        "left out: for network (efficiency.weight=2) seed 0 of network (efficiency.weight=2)"
        in compared.note
    )
    text = "network (efficiency.weight=2)"
    table.main([str(root), "--against", f"{text} †", "--format", "csv"])
    line = next(x for x in capsys.readouterr().out.splitlines() if text in x)
    assert line.split(",")[3] == ""  # the baseline


def test_evaluations_of_equal_rows_name_what_had_no_effect(tmp_path) -> None:
    for seed, weight in ((0, "1"), (0, "2"), (1, "4"), (1, "8")):
        (cell(tmp_path, seed, weight, shift=float(seed)) / "policy.pt").unlink()
    (line,) = without_effect(tmp_path)
    assert line == (
        f"{WEIGHT} had no effect: the rows are the same with efficiency.weight=1 and "
        "efficiency.weight=2 (and in 1 more case)."
    )


def test_files_of_equal_content_are_one_setting(tmp_path) -> None:
    for seed, place in enumerate(("here", "there")):
        (path := tmp_path / f"{place}.parquet").write_text("the same")
        words = ["data=episodes", f"data.path={path}", f"seed={seed}"]
        folder = cell(tmp_path / "sweep", seed, "1", f"++data.path={path}")
        save_config(load("train", ["variant=alcc", *words]), folder)
    assert {*load_sweep(tmp_path / "sweep")["strategy"]} == {"alcc"}


def test_a_row_may_have_another_name_everywhere(root, capsys, monkeypatch) -> None:
    monkeypatch.setattr(names, "LABELS", dict(names.LABELS))
    monkeypatch.setattr(names, "FORMER", {})
    renamed = ["--rename", "network (efficiency.weight=2)", "half", "--against", "half"]
    for words in ([], ["--format=latex"], ["--format=csv"], ["--all"]):
        table.main([str(root), *renamed, *words])
        printed = capsys.readouterr().out
        assert "half" in printed
        assert "network (efficiency.weight=2)" not in printed
        renamed = ["--against", "network (efficiency.weight=2)"]  # the name before
    known = ["alcc a=1", "alcc a=2", "rule"]
    cases = [
        ("alcc a=3", "x", "unknown strategy 'alcc a=3'.*Did you mean 'alcc a="),
        ("alcc a=1", "network (a=2)", r"--rename: 'network \(a=2\)' is in use"),
        ("alcc a=1", "human", "--rename: 'human' is in use"),
    ]
    check_refused(lambda row, label: names.rename(row, label, known), cases, ConfigError)


def test_runs_are_named_by_what_their_commands_varied(tmp_path) -> None:
    plain = [{"agent.gamma": 0.9, "agent.tau": tau, "w.a.x": tau, "w.b.x": 1} for tau in (1, 2)]
    sources = [{"w.x": 1.0, "inputs.reward.mine.py": digest} for digest in ("3f", "4a")]
    for typed, stored, expected in (
        (["a=1 w.x=1.0", "a=1"], sources, ["mine.py=3f", "mine.py=4a"]),
        (["w.x=1", "w.x=1.0"], sources, ["mine.py=3f", "mine.py=4a"]),
        (["ablation=full", "ablation=no_jerk"], plain, ["ablation=full", "ablation=no_jerk"]),
        (["++w.a.x=1", "++w.a.x=2"], plain, ["a.x=1", "a.x=2"]),
        # The seed is no setting, nor is what both have in common.
        (["a=1 seed=1 table=all", "a=2 seed=2"], plain, ["a=1", "a=2"]),
        # A command does not tell them apart, or one of them has none.
        (["a=1", "a=1"], plain, ["a.x=1", "a.x=2"]),
        (["a=1", ""], plain, ["a.x=1", "a.x=2"]),
        (["a=1", "a=2"], [plain[0], plain[0]], ["", ""]),
        # Each run has the words that not all commands have, with the stored values of others.
        (
            ["a=1 no=b", "a=1 agent=x agent.tau=2"],
            plain,
            ["agent.tau=1, no=b", "agent.tau=2, agent=x"],
        ),
    ):
        folders = [tmp_path / f"{len([*tmp_path.iterdir()])} {place}" for place in (0, 1)]
        for folder, words in zip(folders, typed, strict=True):
            (folder / ".hydra").mkdir(parents=True)
            if words:
                (folder / ".hydra" / "overrides.yaml").write_text(yaml.safe_dump(words.split()))
        found = [", ".join(one.values()) for one in labels(stored, folders)]
        assert found == expected, typed


def test_collisions_of_several_seeds_are_means_of_a_training() -> None:
    frame = episodes(profiles=6)
    seeds, hit = frame["training_seed"], frame["strategy"].eq("alcc") & frame["driver_id"].eq(0)
    frame["collided"] = hit
    for part in (frame, *(frame[seeds.isna() | (seeds == seed)] for seed in (0, 1))):
        short = report(windows_for(part)).short.set_index("strategy")
        name = "collisions_per_seed" if part is frame else "collisions"
        assert short.loc["alcc"].filter(like="collisions").to_dict() == {name: 6}
