"""Files that come from somebody else: they run no code, write nowhere and end in one line."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import pandas as pd
import pytest
import torch
import yaml
from commands import run_command, tiny
from helpers import POPULATION, check_refused, wavy_profiles

from lcc_rl.agents.factory import build_agent, make_trainer, training_env
from lcc_rl.agents.loop import TrainingLoop
from lcc_rl.commands import evaluation
from lcc_rl.commands.pipeline import composed_part
from lcc_rl.config import load
from lcc_rl.data.sources import NgsimSource
from lcc_rl.errors import DataError, ResultsError
from lcc_rl.io.files import read_parquet, write_parquet
from lcc_rl.pieces import SafetyReward
from lcc_rl.results.policies import load_policy
from lcc_rl.results.runs import load_config
from lcc_rl.runs.arguments import Arguments


def changed(text: str, changes: dict[str, object]) -> str:
    """Return settings with other values at dotted keys."""
    settings = yaml.safe_load(text)
    for key, value in changes.items():
        *path, last = key.split(".")
        node = settings
        for part in path:
            node = node.setdefault(part, {})
        node[last] = value
    return yaml.safe_dump(settings, sort_keys=False)


def change(folder: Path, changes: dict[str, object] | str) -> None:
    """Change the settings of a run and of its policy, or replace them by a text."""
    old = (folder / "config.yaml").read_text()
    text = changes if isinstance(changes, str) else changed(old, changes)
    (folder / "config.yaml").write_text(text)
    policy = torch.load(folder / "policy.pt", weights_only=True)
    torch.save({**policy, "config": text}, folder / "policy.pt")


@pytest.fixture
def run(trained, tmp_path) -> Path:
    return Path(shutil.copytree(trained, tmp_path / "run"))


# -- settings --------------------------------------------------------------------------------------

TARGET = "reward.terms.safety._target_"
# Settings that a file may not hold, and the words of the error.
FOREIGN: list[tuple[dict[str, object] | str, str]] = [
    ({TARGET: "os.system"}, rf"{TARGET} names 'os.system'"),
    ({"drivers.law": "os.system"}, "drivers.law names 'os.system'"),
    ({"calibration": {"model": "evil.Model"}}, r"calibration\.model names 'evil\.Model'"),
    ({"compare": ["idm", "evil.drive_filtered"]}, r"compare\.1 names 'evil\.drive'.*trust="),
    ({"compare": {"a": {"_target_": "evil.Drive"}}}, r"compare\.a\._target_ names 'evil\.Drive'"),
    ({TARGET: "mine.Comfort"}, "names 'mine.Comfort'.*trust="),
    ({TARGET: "lcc_rl.config.import_module"}, TARGET),
    ({"seed": "${oc.env:SECRET}"}, "seed refers to"),
    ("seed: !!python/object:os.system {}", "damaged"),
    (": [", "damaged"),
    ("seed: " + 50_000 * "[", "damaged.*recursion"),
    ({"agent": "ddpg"}, "agent: expected a node"),
]


def test_settings_that_a_run_or_policy_may_not_hold(run, monkeypatch) -> None:
    monkeypatch.setenv("SECRET", "revealed")
    before = (run / "config.yaml").read_text()
    for changes, words in FOREIGN:
        change(run, before)
        change(run, changes)
        for read, name in ((load_config, r"config\.yaml"), (load_policy, r"policy\.pt")):
            with pytest.raises(ResultsError, match=rf"{name}.*{words}") as caught:
                read(run)
            assert "revealed" not in str(caught.value)


def test_a_stored_configuration_writes_nowhere_but_into_its_folder(run, tmp_path, caplog) -> None:
    logger = {"_target_": "lcc_rl.runs.loggers.RowLogger", "kind": "tensorboard", "where": "x"}
    change(run, {"logger": logger})
    with caplog.at_level("WARNING", logger="lcc_rl"):
        cfg = load_config(run)
    assert (cfg.logger.made().kind, cfg.logger.made().where) == ("tensorboard", None)
    assert "logger.where=x names a path to write to and is left out" in caplog.text
    change(run, {"logger": None})
    run_command("train", f"resume={run}", cwd=tmp_path, check=True)
    assert list(tmp_path.iterdir()) == [run]


def test_ones_own_module_can_be_trusted_by_name_but_not_by_the_folder(
    run, tmp_path, monkeypatch
) -> None:
    (tmp_path / "comforts.py").write_text(
        "from lcc_rl.pieces import SafetyReward\nclass Comfort(SafetyReward): pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    change(run, {TARGET: "comforts.Comfort", "trust": ["os"]})
    assert load_config(run, ["comforts"]).trust == ["comforts"]
    (parser := Arguments()).add_trust()  # of lcc-rl repeat and table
    for words in (["trust=[comforts,os]"], ["--trust", "comforts,os"]):
        assert parser.parse_args(words).trust == ["comforts", "os"]
    with pytest.raises(ResultsError, match=r"trust=\[comforts\]"):
        load_config(run, ["other"])


class Comfort(SafetyReward):
    """A piece of one's own."""


def test_the_main_job_trusts_what_its_own_command_names() -> None:
    own = f"+reward.terms.comfort={{_target_: {__name__}.Comfort}}"
    trainings, final = composed_part(load("pipeline", [own]), [own])
    assert final.trust == [__name__]
    assert all("comfort" in part.reward.terms for part in trainings.values())


# -- weights ---------------------------------------------------------------------------------------

WEIGHT = "module.0.0.weight"


class Evil:
    def __reduce__(self):
        return os.mkdir, ("evil-was-here",)


def policy_with(path: Path, weights: object = None, **changes: object) -> None:
    """Change a policy's weights, or its settings by their dotted keys."""
    policy = torch.load(path, weights_only=True)
    old = policy["weights"]
    new = old | weights if isinstance(weights, dict) else weights or old
    torch.save({"weights": new, "config": changed(policy["config"], changes)}, path)


def one_wrong_byte(path: Path) -> None:
    old = bytearray(path.read_bytes())
    old[len(old) // 2] ^= 0x10
    path.write_bytes(old)


def packed(path: Path) -> None:
    """Compress the entries of a file, as torch never does."""
    with ZipFile(path) as old:
        entries = {name: old.read(name) for name in old.namelist()}
    with ZipFile(path, "w", ZIP_DEFLATED) as new:
        for name, entry in entries.items():
            new.writestr(name, entry)


# What a policy's file may not be.
DAMAGED: dict[str, Callable[[Path], object]] = {
    "malicious pickle": lambda path: path.write_bytes(pickle.dumps(Evil())),
    "malicious archive": lambda path: torch.save(Evil(), path),
    "other type": lambda path: policy_with(path, {"more": bytearray(9)}),
    "one wrong byte": one_wrong_byte,
    "list": lambda path: policy_with(path, [1]),
    "not a number": lambda path: policy_with(path, {WEIGHT: torch.full((16, 7), torch.nan)}),
    "bytes": lambda path: policy_with(path, {WEIGHT: torch.ones(16, 7, dtype=torch.int8)}),
    "complex": lambda path: policy_with(path, {WEIGHT: torch.ones(16, 7) * 1j}),
    "packed": packed,
    "no entries": lambda path: torch.save({"config": ""}, path),
    "no agent": lambda path: policy_with(path, agent=None),
}


def test_a_file_that_is_no_policy_runs_no_code(run, monkeypatch) -> None:
    monkeypatch.chdir(run)
    path = run / "policy.pt"
    before = path.read_bytes()

    def damaged(what: str) -> None:
        path.write_bytes(before)
        DAMAGED[what](path)
        load_policy(path)

    check_refused(damaged, ((what, r"policy\.pt: ") for what in DAMAGED), ResultsError)
    assert not (run / "evil-was-here").exists()


FITS = [
    ({"weights": {WEIGHT: torch.ones(3, 3)}}, "alcc", r"p\.pt.*trained with 3 observed entries"),
    ({"weights": {"more": torch.ones(1)}}, "alcc", r"p\.pt.*Unexpected key"),
    ({"agent._target_": "lcc_rl.agents.SAC"}, "idm", r"p\.pt.*unknown setting"),
    ({"scenario.time_step": 0.5}, "idm", r"p\.pt.*scenario\.time_step=0\.5, got 0\.1"),
    ({"scenario.controllers.automated.max_acceleration": 1.0}, "alcc", r"max_acceleration=1\.0"),
    ({}, "reference", "trained as variant alcc"),
    ({}, "none", "has no agent"),
]


def test_a_policy_that_does_not_fit(trained, tmp_path) -> None:
    def evaluate(changes: dict[str, object], variant: str) -> None:
        path = Path(shutil.copy(trained / "policy.pt", tmp_path / "p.pt"))
        policy_with(path, **changes)
        given = {"idm": f"compare=[{path}]"}.get(variant, f"policy={path}")
        variant = "idm" if variant == "none" else variant
        cfg = tiny("evaluate", f"variant={variant}", given, agent=False)
        evaluation.run(cfg, tmp_path / "out", quiet=True)

    check_refused(evaluate, FITS)


def test_a_compared_policy_drives_with_its_own_controller(trained, tmp_path) -> None:
    path = Path(shutil.copy(trained / "policy.pt", tmp_path / "p.pt"))
    policy_with(path, **{"scenario.controllers.automated.max_acceleration": 1.0})
    cfg = tiny("evaluate", "variant=idm", f"compare=[{path}]", agent=False)
    rows = evaluation.run(cfg, tmp_path / "out", quiet=True)
    assert "alcc" in set(rows["strategy"])


def test_what_is_no_file_is_not_waited_for(tmp_path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for place, why in {"pipe": "not a file", "folder": "not a file", "nothing": "no such"}.items():
        with pytest.raises(DataError, match=place):
            NgsimSource(path=str(tmp_path / place)).load()
        with pytest.raises(ResultsError, match=r"(not a file|no such file)$"):
            load_policy(tmp_path / place)
        with pytest.raises(ResultsError, match=f"{place}: {why}"):
            read_parquet(tmp_path / place)


# -- checkpoints -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loops(tmp_path_factory) -> dict[str, TrainingLoop]:
    """Return loops that took two iterations, and saved them."""
    made = {}
    for agent in ("ddpg", "analytic"):
        words = ["variant=alcc", f"agent={agent}", "training.episodes=16"]
        cfg = tiny("train", *words, agent=agent == "ddpg")
        folder = tmp_path_factory.mktemp(agent)
        env = training_env(cfg, wavy_profiles(), POPULATION)
        made[agent] = make_trainer(cfg, build_agent(cfg, POPULATION), env, folder)
        made[agent].run()
    return made


def first(state: object) -> tuple[dict, str]:
    """Return the first mapping in a state that holds a tensor, and its name there."""
    for name, value in state.items():
        if isinstance(value, torch.Tensor):
            return state, name
        if isinstance(value, dict) and (found := first(value)):
            return found
    return ()


def cast(kind: torch.dtype) -> Callable[[dict], None]:
    def change(state: dict) -> None:
        entries, name = first(state["agent"])
        entries[name] = entries[name].to(kind)

    return change


def spoil_optimizer(state: dict) -> None:
    agent = state["agent"]
    steps = agent.get("optimizer") or agent["all"]
    steps["state"][0]["exp_avg"].view(-1)[0] = torch.nan


TAMPERED: dict[str, tuple[Callable[[dict], object], str]] = {
    **{
        f"iteration {value!r}": (lambda state, v=value: state.update(iteration=v), "iteration")
        for value in (-3, 1.5, "1", 10**9, 0, 1)
    },
    "updates": (lambda state: state.update(updates=-7), "updates must be greater"),
    "no rows": (lambda state: state.update(rows={}), "iteration 2, but rows of"),
    "words": (lambda state: state["rows"].update(iteration=["a", "b"]), "rows: column 'iteration'"),
    "no agent": (lambda state: state.update(agent=[]), "agent must be"),
    "empty": (lambda state: state.update(agent={}), "agent lacks"),
    "more": (lambda state: state.update(more=1), "'more'"),
    "less": (lambda state: state.pop("memory"), "memory is required"),
    "bytes": (cast(torch.int8), "weight is torch.int8"),
    "complex": (cast(torch.complex64), "weight is torch.complex64"),
    "optimizer": (spoil_optimizer, r"0\.exp_avg holds values that are not finite"),
}


@pytest.mark.parametrize("agent", ["ddpg", "analytic"])
def test_a_checkpoint_that_was_tampered_with_is_refused(loops, agent) -> None:
    loop = loops[agent]
    path = loop.folder / "checkpoint.pt"
    before = path.read_bytes()
    for change, words in TAMPERED.values():
        state = torch.load(path, weights_only=True)
        change(state)
        torch.save(state, path)
        with pytest.raises(ResultsError, match=rf"checkpoint\.pt: .*{words}"):
            loop.load()
        path.write_bytes(before)
    loop.load()


# -- tables ----------------------------------------------------------------------------------------


def test_schema_versions_that_there_are_not(tmp_path) -> None:
    path = tmp_path / "a.parquet"
    for version in ("0", "²", "-1", "", "2", "x" * 5000):
        write_parquet(pd.DataFrame({"a": [1]}), path, {"lcc_rl.schema": version})
        with pytest.raises(ResultsError, match=r"a\.parquet: schema version") as caught:
            read_parquet(path)
        assert len(str(caught.value)) < 200
