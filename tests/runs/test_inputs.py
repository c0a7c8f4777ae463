"""What the files hold that a run reads is a part of what the run is."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from commands import NO_AGENT, run_command
from helpers import slow_but

from lcc_rl.commands.evaluation import made_by
from lcc_rl.config.compose import identity, load
from lcc_rl.config.inputs import inputs_of
from lcc_rl.config.nodes import as_plain
from lcc_rl.drivers.population import load_drivers
from lcc_rl.envs.inputs import shared_inputs
from lcc_rl.errors import ResultsError
from lcc_rl.io.files import write_parquet
from lcc_rl.results.runs import check_folder

OWN = """import own_helper
from lcc_rl.pieces import RewardTerm
class Term(RewardTerm):
    table: str = ''
"""
TERM = "+reward.terms.own={_target_: own_term.Term, table: t.txt}"
# What is typed after the command, and the file that it reads.
READ = {
    "data=episodes data.path=pairs.csv": "pairs.csv",
    "data=episodes data.path=[pairs.csv,more.csv]": "more.csv",
    "data=ngsim 'data.path=days/*.csv'": "days/two.csv",
    "drivers=calibrated drivers.path=drivers.parquet": "drivers.parquet",
    "leader=record leader.path=cycle.csv": "cycle.csv",
    "leader=drives leader.path=trips": "trips/one.csv",
    "policy=run": "run/policy.pt",
    "policy=kept.pt": "kept.pt",
    "compare=[sweep]": "sweep/seed=1/policy.pt",
    "compare={own: run_filtered}": "run/policy.pt",
    "compare=[own.yaml]": "own.yaml",
    "compare=[program.onnx]": "program.onnx",
    "compare=[own_term.Term]": "own_term.py",
    TERM: "t.txt",
    f"{TERM} ": "own_term.py",
    f"{TERM}  ": "own_helper.py",
}


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """A folder in which commands run, and in which Python finds modules."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "own_term", raising=False)
    monkeypatch.delitem(sys.modules, "own_helper", raising=False)
    (tmp_path / "own_helper.py").write_text("WEIGHT = 1\n")
    (tmp_path / "own_term.py").write_text(OWN)
    return tmp_path


@pytest.mark.parametrize("typed", slow_but([*READ][::4], READ))
def test_a_configuration_has_another_identity_once_a_file_holds_something_else(
    place, typed
) -> None:
    words = [typed.strip()] if "{" in typed else typed.replace("'", "").split()
    file = place / READ[typed]
    before = identity(load("evaluate", words)) if file.suffix != ".py" else None
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("a") as text:
        text.write("# one\n")
    first = identity(load("evaluate", words))
    assert first != before
    os.utime(file, (1, 1))
    assert identity(load("evaluate", words)) == first
    with file.open("a") as text:
        text.write("# two\n")
    assert identity(load("evaluate", words)) != first


def test_a_file_replaced_within_its_size_and_times_has_another_hash(place, monkeypatch) -> None:
    file, other, content = place / "cycle.csv", place / "other.csv", {"leader": {"path": "*.csv"}}
    for aged in (False, True):  # written just now, or a while ago
        monkeypatch.setattr("lcc_rl.config.inputs.FRESH", 0.0 if aged else 1e9)
        found = []
        for text in ("one", "two"):
            other.write_text(text)
            os.utime(other, (1, 1))
            other.replace(file)
            found.append(inputs_of(content)["leader"]["cycle.csv"])
        assert found[0] != found[1], aged


def test_modules_of_another_environment_are_not_followed(place, monkeypatch) -> None:
    shared = place / "base" / "site-packages"  # a second folder of installed packages
    shared.mkdir(parents=True)
    (shared / "own_helper.py").write_text("WEIGHT = 1\n")
    (place / "own_helper.py").unlink()
    monkeypatch.syspath_prepend(shared)
    found = inputs_of({"compare": ["own_term.Term"]})
    assert [*found["compare"]] == ["own_term.py"]


def test_imports_within_functions_and_packages_are_followed(place) -> None:
    package = place / "own_parts"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "late.py").write_text("import own_helper, torch, lcc_rl, missing, old\n")
    (place / "old.py").write_text("print 'of Python 2'\n")  # may be imported optionally
    (package / "beside.py").write_text("")
    (package / "term.py").write_text("def Term():\n    from .late import X\n")
    found = inputs_of({"compare": ["own_parts.term.Term"]})
    assert [*found["compare"]] == ["term.py", "late.py", "old.py", "own_helper.py"]
    (package / "term.py").write_text("import own_parts, other\n\ndef Term(): ...\n")
    (place / "other").mkdir()
    (place / "other" / "__init__.py").write_text("other = 1")
    found = inputs_of({"compare": ["own_parts.term.Term"]})["compare"]
    assert [*found] == ["term.py", "other/__init__.py", "own_parts/__init__.py"]


def test_own_files_of_settings_are_read_anew(place, monkeypatch) -> None:
    own = "# @package _global_\nscenario: {{horizon: {}}}\n"
    words = ["hydra.searchpath=[file://c]", "+knowledge=mine"]
    for folder, horizon in ((place, 31), (place, 32), (place / "sub", 33), (place, 32)):
        (folder / "c" / "knowledge").mkdir(parents=True, exist_ok=True)
        (folder / "c" / "knowledge" / "mine.yaml").write_text(own.format(horizon))
        monkeypatch.chdir(folder)
        assert load("train", words).scenario.horizon == horizon


def test_a_run_without_own_files_has_none(place) -> None:
    (place / "alcc").write_text("not read")
    cfg = load("evaluate", ["variant=alcc", "compare=[idm,pretrained/alcc]", "policy=pretrained"])
    assert cfg.inputs == {}


def drivers(place: Path, factor: float) -> None:
    table = load_drivers()
    write_parquet(table.assign(time_gap_s=factor * table["time_gap_s"]), place / "d.parquet")


@pytest.mark.parametrize(
    ("entry", "anew"), slow_but([("train", False)], [("train", False), ("evaluate", True)])
)
def test_a_changed_file_is_said_on_resume_and_seen_by_a_sweep(place, entry, anew) -> None:
    drivers(place, 1.0)
    words = [*NO_AGENT, "variant=idm", "drivers=calibrated", "drivers.path=d.parquet"]
    words += ["evaluation.drivers=2"] + ["evaluation.baselines=[]"] * (entry == "evaluate")
    seed = "evaluation.seed=0" if entry == "evaluate" else "seed=0"
    sweep = (entry, "-m", *words, seed, "sweep=s")
    run_command(*sweep, cwd=place, check=True)
    (settings,) = (place / "outputs" / entry / "s").glob("*/config.yaml")
    run, first = settings.parent, made_by(settings.parent / "episodes.parquet")
    assert "finished before" in run_command(*sweep, cwd=place, check=True).stdout
    drivers(place, 1.1)
    done = run_command(entry, f"resume='{run}'", cwd=place)
    assert done.returncode == 2
    assert "d.parquet (drivers) has changed since the run began" in done.stderr
    done = run_command(*sweep, cwd=place)
    assert "finished before" not in done.stdout
    assert [settings] == list(run.parent.glob("*/config.yaml"))
    assert (made_by(run / "episodes.parquet") != first) == anew == (done.returncode == 0)
    if not anew:
        assert "of other settings (inputs.drivers.d.parquet)" in done.stderr + done.stdout
        drivers(place, 1.0)
        assert run_command(*sweep, cwd=place).returncode == 0  # the refusal is forgotten
    (place / "d.parquet").unlink()
    done = run_command(entry, f"resume='{run}'", cwd=place)
    assert "d.parquet (drivers) is missing; restore it" in done.stderr


def test_what_a_run_reads_is_no_setting() -> None:
    with pytest.raises(Exception, match="inputs: runs record the files that they read"):
        load("train", ["inputs={}"])


@pytest.mark.slow
def test_a_file_of_config_dir_is_an_input(place) -> None:
    own = place / "own" / "controller" / "slow.yaml"
    own.parent.mkdir(parents=True)
    kept = []
    for accel in (0.1, 0.2):
        own.write_text(f"_target_: lcc_rl.pieces.ConstantAcceleration\nacceleration: {accel}\n")
        words = (
            "compare=[slow]",
            "evaluation.baselines=[]",
            f"hydra.run.dir=run{accel}",
            *NO_AGENT,
        )
        command = ("evaluate", "variant=idm", *words, "--config-dir", "own")
        run_command(*command, cwd=place, check=True)
        kept.append(made_by(place / f"run{accel}" / "episodes.parquet"))
    assert kept[0] != kept[1]


OWN_LEADERS = """from lcc_rl.data.leaders import DriveLeaders
class Own(DriveLeaders):
    def load(self, *given):
        return DriveLeaders(path=self.path, evaluation_share=1, fastest=FASTEST).load(*given)
"""


def test_a_class_that_is_defined_anew_is_used(monkeypatch) -> None:
    """As in a notebook, whose ``__main__`` is no file."""
    module = ModuleType("cells")
    monkeypatch.setitem(sys.modules, "cells", module)
    words = ["experiment=smoke", "leader={_target_: cells.Own, path: udds}"]
    words += ["evaluation.profiles=null", "scenario.horizon=20"]
    counts = []
    for fastest in ("None", "None", "5.0"):
        if fastest != "None" or not counts:
            exec(OWN_LEADERS.replace("FASTEST", fastest), vars(module))
        counts.append(len(shared_inputs(load("train", words)).evaluation))
    assert counts == [90, 90, 44]


def test_a_setting_that_an_older_version_did_not_have_is_no_other_setting(place) -> None:
    cfg = load("evaluate", ["variant=idm"])
    stored = as_plain(cfg)
    del stored["evaluation"]["front"], stored["measures"]
    (place / "config.yaml").write_text(yaml.safe_dump(stored))
    (place / "episodes.parquet").write_text("")
    check_folder(cfg, place)
    with pytest.raises(ResultsError, match=r"episodes.parquet of other settings \(seed\)"):
        check_folder(load("evaluate", ["variant=idm", "seed=1"]), place)
