"""Files that come from somebody else: they run no code, write nowhere and end in one line."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import pandas as pd
import pytest
import torch
import yaml
from commands import UNTRAINED, run_command, tiny

from lcc_rl import results
from lcc_rl.commands import evaluation, training
from lcc_rl.config import identity, load
from lcc_rl.data.sources import NgsimSource
from lcc_rl.errors import ConfigError, DataError, LccError, ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.io.settings import parse_yaml, read_json, read_text
from lcc_rl.io.tensors import read_torch
from lcc_rl.results.policies import load_policy
from lcc_rl.results.runs import load_config
from lcc_rl.runs.states import inspect_run
from lcc_rl.synthetic.stream import StreamSource

SMALL = {"recordings": 1, "platoons": 2, "vehicles": 3}


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("trained") / "alcc"
    training.run(tiny("train", "variant=alcc"), folder, quiet=True)
    return folder


@pytest.fixture
def run(trained, tmp_path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


def changed(settings: dict, **changes: object) -> dict:
    """Return settings with others at dotted keys; a double underscore stands for a dot."""
    for key, value in changes.items():
        *path, last = (
            key.split("__")
            if not key.endswith("_target_")
            else [*key.removesuffix("___target_").split("__"), "_target_"]
        )
        node = settings
        for part in path:
            node = node.setdefault(part, {})
        node[last] = value
    return settings


def change(folder: Path, **changes: object) -> None:
    """Change settings of a run's config.yaml."""
    path = folder / "config.yaml"
    path.write_text(
        yaml.safe_dump(changed(yaml.safe_load(path.read_text()), **changes), sort_keys=False)
    )


def content(folder: Path) -> dict[str, str]:
    """Return a checksum of every file of a folder, those of Hydra included."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


# -- no place to write -----------------------------------------------------------------------------


def test_a_stored_configuration_writes_nowhere_but_into_its_folder(run, tmp_path, caplog) -> None:
    victim, other = tmp_path / "victim.csv", tmp_path / "new.csv"
    victim.write_text("mine")
    for path in (victim, other):
        change(run, data__keep=str(path))
        with caplog.at_level("WARNING", logger="lcc_rl"):
            assert load_config(run).data["keep"] is None
        assert f"data.keep={path} names a place to write and is left out" in caplog.text
    training.run(load("train", [f"resume={run}"]), run, quiet=True)
    assert victim.read_text() == "mine"
    assert not other.exists()


def test_places_of_loggers_are_left_out(run) -> None:
    change(
        run, logger={"_target_": "lcc_rl.runs.loggers.RowLogger", "kind": "mlflow", "where": "x"}
    )
    cfg = load_config(run)
    assert cfg.logger["where"] is None
    assert cfg.logger["kind"] == "mlflow"


def test_a_resumed_run_may_be_given_a_logger_and_nothing_else(run) -> None:
    words = (f"resume={run}", "logger=rows", "logger.kind=typo")
    done = run_command("lcc_rl.cli.train", *words, cwd=run.parent)
    assert "logger.kind must be 'tensorboard'" in done.stderr
    done = run_command("lcc_rl.cli.train", f"resume={run}", "seed=3", cwd=run.parent)
    assert "seed=3" in done.stderr


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "mine.Comfort",
        "lcc_rl.config.import_module",
        "lcc_rl.data.episodes.write_episodes",
        "lcc_rl.synthetic.stream.keep_files",
    ],
)
def test_foreign_code_and_functions_that_write_may_not_be_named(run, target) -> None:
    change(run, reward__terms__safety___target_=target)
    with pytest.raises(ResultsError, match=rf"safety\._target_ names '{target}'"):
        load_config(run)


def test_ones_own_module_can_be_trusted_by_name(run, tmp_path, monkeypatch) -> None:
    (tmp_path / "comforts.py").write_text(
        "from lcc_rl.pieces import SafetyReward\nclass Comfort(SafetyReward): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    change(run, reward__terms__safety___target_="comforts.Comfort")
    assert load_config(run, ["comforts"]).variant == "alcc"
    with pytest.raises(ResultsError, match=r"trust=\[comforts\]"):
        load_config(run, ["other"])


def test_references_to_the_environment_are_not_resolved(run, monkeypatch) -> None:
    monkeypatch.setenv("SECRET", "told")
    text = (run / "config.yaml").read_text()
    for value in ("${oc.env:SECRET}", "'x${lcc.folder:a,b}y'", "[['${oc.env:SECRET}']]"):
        (run / "config.yaml").write_text(f"{text}\nextra: {value}\n")
        with pytest.raises(ResultsError, match=r"extra.* refers to .*expected plain") as caught:
            load_config(run)
        assert "told" not in str(caught.value)


def test_what_a_folder_trusts_is_not_trusted(run) -> None:
    change(run, trust=["os"])
    assert load_config(run).trust == []
    assert load_config(run, ["mine"]).trust == ["mine"]


def test_keep_never_overwrites(tmp_path) -> None:
    path = tmp_path / "stream.csv"
    StreamSource(**SMALL, keep=str(path)).load()
    before = content(tmp_path)
    StreamSource(**SMALL, keep=str(path)).load()  # the same again is fine
    with pytest.raises(ConfigError, match=r"data\.keep: .*stream\.csv exists and holds something"):
        StreamSource(**SMALL, seed=1, keep=str(path)).load()
    assert content(tmp_path) == before
    path.unlink()
    with pytest.raises(ConfigError, match=r"stream_truth\.parquet exists"):
        StreamSource(**SMALL, seed=1, keep=str(path)).load()
    assert not path.exists()
    with pytest.raises(ConfigError, match=r"keep .*csv.*got 'a\.parquet'"):
        StreamSource(keep="a.parquet")


def test_where_a_stream_is_kept_is_no_part_of_a_run() -> None:
    assert identity(load("train", ["data.keep=a.csv"])) == identity(load("train"))


# -- bounds ----------------------------------------------------------------------------------------


# -- what is no file -------------------------------------------------------------------------------


def test_pipes_are_not_waited_for(tmp_path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(DataError, match=r"pipe: cannot be read: a folder, pipe or device"):
        NgsimSource(path=str(pipe)).load()
    for read in (read_text, read_json, read_torch, read_parquet):
        with pytest.raises(ResultsError, match=r"pipe: (not a file|no such file)"):
            read(pipe)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"done": "x"}', "3", "{}"])
def test_progress_that_is_none(run, text) -> None:
    for name in ("progress.json", "sweep.json"):
        (run / name).write_text(text)
    run_command("lcc_rl.cli.status", str(run.parent), cwd=run.parent, check=True)
    assert inspect_run(run).total == 0


@pytest.mark.parametrize("words", ["compare=[{}]", "policy={}"])
@pytest.mark.parametrize("place", ["pipe", "folder", "/dev/zero", "nothing"])
def test_a_policy_that_is_no_file(tmp_path, words, place) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    cfg = tiny("evaluate", "variant=alcc", words.format(tmp_path / place))
    with pytest.raises(ResultsError, match=r"(not a file|no such file)$"):
        evaluation.run(cfg, tmp_path / "out", quiet=True)


# -- policies --------------------------------------------------------------------------------------

W = "module.0.0.weight"
WEIGHTS = {
    "weights are list, expected named tensors": [1],
    "weights are dict, expected named tensors": {},
    "weight 1 is int": {1: 2},
    rf"weight '{W}' is str": {W: "abc"},
    rf"weight '{W}' holds values that are no numbers": {W: torch.full((16, 7), float("nan"))},
}


def foreign_policy(trained: Path, path: Path, weights: object = None, **changes: object) -> str:
    """Write a policy with other weights or settings."""
    policy = torch.load(trained / "policy.pt", weights_only=True)
    config = yaml.safe_dump(changed(yaml.safe_load(policy["config"]), **changes), sort_keys=False)
    if weights is None:
        weights = policy["weights"]
    elif isinstance(weights, dict) and all(isinstance(name, str) for name in weights) and weights:
        weights = {**policy["weights"], **weights}
    torch.save({"weights": weights, "config": config}, path)
    return str(path)


def both_ways(path: str) -> list:
    ways = (("variant=alcc", f"policy={path}"), ("variant=idm", f"compare=[{path}]"))
    return [tiny("evaluate", *way, agent=False) for way in ways]


@pytest.mark.parametrize("words", WEIGHTS)
def test_weights_that_are_none(trained, tmp_path, words) -> None:
    path = foreign_policy(trained, tmp_path / "p.pt", WEIGHTS[words])
    with pytest.raises(ResultsError, match=rf"p\.pt.*{words}"):
        load_policy(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"agent": None}, "it has no agent"),
        ({"agent": "ddpg"}, "agent: expected a node"),
        ({"seed": "abc"}, "seed must be a valid integer"),
        ({"scenario": None}, "scenario must be a mapping"),
        ({"scenario__pieces": []}, r"scenario\.pieces must be"),
    ],
)
def test_a_policy_whose_settings_are_damaged(trained, tmp_path, changes, words) -> None:
    path = foreign_policy(trained, tmp_path / "p.pt", **changes)
    with pytest.raises(ResultsError, match=rf"p\.pt: .*{words}"):
        load_policy(path)


FITS = (
    ({"weights": {W: torch.ones(3, 3)}}, "was trained with 3 observed entries"),
    ({"weights": {"more": torch.ones(1)}}, "Unexpected key"),
    ({"agent___target_": "lcc_rl.agents.SAC"}, "unknown setting"),
    ({"agent": {"_target_": "lcc_rl.pieces.Action", "max_acceleration": 1.0}}, "agent: expected"),
    ({"agent__hidden": [8, 8]}, "size mismatch"),
    ({"scenario__time_step": 0.5}, r"trained with scenario\.time_step=0\.5, got 0\.1"),
)


@pytest.mark.parametrize(("changes", "words"), FITS)
def test_a_policy_that_does_not_fit(trained, tmp_path, changes, words) -> None:
    path = foreign_policy(trained, tmp_path / "p.pt", **changes)
    cfg = both_ways(path)["weights" in changes or "scenario__time_step" in changes]
    with pytest.raises(LccError, match=rf"^.*p\.pt.*{words}.*$"):
        evaluation.run(cfg, tmp_path / "out", quiet=True)


def test_an_action_that_means_another_acceleration(trained, tmp_path) -> None:
    place = "scenario__controllers__automated__max_acceleration"
    path = foreign_policy(trained, tmp_path / "p.pt", **{place: 1.0})
    one, other = both_ways(path)
    with pytest.raises(ConfigError, match=r"p\.pt.*automated\.max_acceleration=1\.0, got 3\.0"):
        evaluation.run(one, tmp_path / "out", quiet=True)
    # Compared policies drive with their own controller.
    rows = evaluation.run(other, tmp_path / "out", quiet=True)
    assert "alcc" in set(rows["strategy"])


@pytest.mark.parametrize(
    "change",
    ["missing", "policy", *(pytest.param(x, marks=pytest.mark.slow) for x in ("agent", "list"))],
)
def test_a_checkpoint_that_does_not_fit(run, change) -> None:
    path = run / "checkpoint.pt"
    state = torch.load(path, weights_only=True)
    if change == "missing":
        del state["memory"]
    elif change == "agent":
        state["agent"] = {"actor": 1}
    else:
        state = [1] if change == "list" else torch.load(run / "policy.pt", weights_only=True)
    torch.save(state, path)
    before = content(run)
    with pytest.raises(ResultsError, match=r"checkpoint\.pt: (does not fit|belongs to another)"):
        training.run(load("train", [f"resume={run}"]), run, quiet=True)
    assert content(run) == before


# -- tables ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["0", "²", "-1", "", "2", "01", "x" * 5000])
def test_schema_versions_that_there_are_not(tmp_path, version) -> None:
    path = tmp_path / "a.parquet"
    write_parquet(pd.DataFrame({"a": [1]}), path, {"lcc_rl.schema": version})
    with pytest.raises(ResultsError, match=r"a\.parquet: schema version .*expected 1") as caught:
        read_parquet(path)
    assert len(str(caught.value)) < 200


def test_damaged_runs_are_left_out_by_name(trained, tmp_path, caplog) -> None:
    for name in "abc":
        shutil.copytree(trained, tmp_path / name)
    (tmp_path / "b" / "episodes.parquet").write_text("x")
    (tmp_path / "c" / "config.yaml").write_text(": [")
    rows = results.load(tmp_path)
    assert set(rows["run"]) == {"a"}
    assert set(rows.attrs["damaged"]) == {"b", "c"}
    assert "left out" in caplog.text
    assert "b/episodes.parquet" in caplog.text
    with pytest.raises(ResultsError, match=r"b/episodes\.parquet"):
        results.load(tmp_path, strict=True)
    shutil.rmtree(tmp_path / "a")
    with pytest.raises(ResultsError, match=r"none is readable: .*b/episodes\.parquet"):
        results.load(tmp_path)


def test_yaml_of_python_objects_is_damaged() -> None:
    for text in ("!!python/object:os.system {}", "? [a]\n: 1", "a: 1" + "0" * 9000, "\x00"):
        with pytest.raises(ResultsError, match="x: damaged"):
            parse_yaml(text, "x")


def test_one_wrong_byte_in_weights_is_noticed(trained, tmp_path) -> None:
    content = bytearray((trained / "policy.pt").read_bytes())
    content[len(content) // 2] ^= 0x10
    (tmp_path / "policy.pt").write_bytes(content)
    with pytest.raises(ResultsError, match=r"policy\.pt"):
        read_torch(tmp_path / "policy.pt")


def test_a_killed_writer_leaves_nothing_that_is_read(tmp_path) -> None:
    (tmp_path / f".episodes.parquet.{os.getpid()}.tmp").write_bytes(b"PAR1 half")
    with pytest.raises(ResultsError, match=r"no episodes\.parquet"):
        results.load(tmp_path)


@pytest.mark.slow
def test_policies_of_two_agents_stand_side_by_side(tmp_path) -> None:
    for agent in ("ddpg", "analytic"):
        cfg = tiny("train", "variant=alcc", f"agent={agent}", agent=False)
        training.run(cfg, tmp_path / agent, quiet=True)
    compared = f"compare=[{tmp_path / 'analytic'}]"
    cfg = tiny("evaluate", "variant=alcc", f"policy={tmp_path / 'ddpg'}", compared, agent=False)
    rows = evaluation.run(cfg, tmp_path / "both", quiet=True)
    assert list(rows["strategy"].unique()) == [*UNTRAINED, "alcc analytic", "alcc ddpg"]
    energies = rows.groupby("strategy")["total_energy_kj"].mean()
    assert energies["alcc analytic"] != energies["alcc ddpg"]
