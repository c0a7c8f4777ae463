"""The calibrate command: files, report, and one clear line for whatever is wrong."""

import io
import os
import subprocess
import sys
from pathlib import Path

import lcc_rl.conf
import pandas as pd
import pytest
from omegaconf import OmegaConf
from rich.console import Console

from lcc_rl.commands import calibration
from lcc_rl.drivers.population import bootstrap
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.io.files import parquet_metadata
from lcc_rl.runs.cli import main_guard, prepare_torch

CONF = Path(str(lcc_rl.conf.__file__)).parent
SOURCE = """
from types import SimpleNamespace
import pandas as pd
from lcc_rl.errors import DataError

class Source:
    def __init__(self, path: str) -> None:
        self.path = path

    def load(self):
        try:
            episodes = pd.read_parquet(self.path)
        except OSError as error:
            raise DataError(f"{self.path}: no such file") from error
        return SimpleNamespace(episodes=episodes, report=["3 episodes read"])
"""


@pytest.fixture
def source(tmp_path, monkeypatch, uneven_lengths):
    """Folder with a data source of its own and an episode file."""
    (tmp_path / "a_source.py").write_text(SOURCE)
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "own.yaml").write_text("_target_: a_source.Source\npath: ???\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    uneven_lengths.to_parquet(tmp_path / "episodes.parquet")
    return tmp_path


@pytest.fixture
def cfg(source):
    """Configuration of a small calibration in both modes."""
    calibration = OmegaConf.load(CONF / "calibration" / "base.yaml")
    quick = {"population": 8, "generations": 2, "founders": 1}
    changes = {"modes": ["local", "global"], "local_genetic": quick, "global_genetic": quick}
    data = OmegaConf.load(source / "data" / "own.yaml")
    data.path = str(source / "episodes.parquet")
    return OmegaConf.create(
        {
            "seed": 0,
            "threads": 1,
            "device": "cpu",
            "data": data,
            "calibration": OmegaConf.merge(calibration, changes),
        }
    )


def test_run_writes_table_and_figures_and_says_what_it_did(cfg, tmp_path):
    out = io.StringIO()
    drivers = calibration.run(cfg, tmp_path / "run", Console(file=out, width=100))
    names = sorted(path.name for path in (tmp_path / "run").iterdir())
    assert names == ["calibration.png", "config.yaml", "drivers.parquet", "joint_distribution.png"]
    written = pd.read_parquet(tmp_path / "run" / "drivers.parquet")
    pd.testing.assert_frame_equal(written, drivers, check_dtype=False)
    metadata = parquet_metadata(tmp_path / "run" / "drivers.parquet")
    assert metadata["report"].startswith("3 of 3 episodes used")
    assert '"modes": ["local", "global"]' in metadata["config"]
    assert len(bootstrap(tmp_path / "run" / "drivers.parquet")) == 3
    for text in ("3 episodes read", "3 of 3 episodes used", "RMSPE [%]", "time gap [s]"):
        assert text in out.getvalue()


@pytest.mark.parametrize(
    ("key", "value", "error", "message"),
    [
        ("data.path", "/no/such", DataError, "/no/such: no such file"),
        ("data.path", "???", ConfigError, "data.path"),
        ("seed", "abc", ConfigError, "seed"),
        ("threads", 0, ConfigError, "threads"),
        ("device", "abacus", ConfigError, "abacus"),
        ("calibration.modes", ["locl"], ConfigError, "local"),
        ("calibration.bounds.time_gap", [2.0, 1.0], ConfigError, "time_gap"),
        ("calibration.local_genetic.population", 2, ConfigError, "population"),
        ("calibration.selection.min_gap_m", 1e3, DataError, "gap below 1000 m"),
    ],
)
def test_bad_input_ends_in_an_error_that_names_it(cfg, tmp_path, key, value, error, message):
    OmegaConf.update(cfg, key, value)
    with pytest.raises(error, match=message):
        calibration.run(cfg, tmp_path / "run", Console(file=io.StringIO()))
    assert not (tmp_path / "run").exists()


def test_every_mode_and_population_file_composes():
    for name in ("local", "global", "both"):
        node = OmegaConf.load(CONF / "calibration" / f"{name}.yaml")
        assert set(node.modes) <= {"local", "global"}
    assert OmegaConf.missing_keys(OmegaConf.load(CONF / "drivers" / "calibrated.yaml")) == {"path"}


@pytest.mark.parametrize(
    ("raised", "code", "text"),
    [
        (DataError("a.csv: row 3:\n  bad"), 2, "lcc_rl: error: a.csv: row 3: bad\n"),
        (OSError(28, "No space left on device"), 2, "No space left on device"),
        (KeyboardInterrupt(), 130, "lcc_rl: interrupted\n"),
    ],
)
def test_guard_prints_one_line(raised, code, text, capsys):
    def fail():
        raise raised

    with pytest.raises(SystemExit) as stop:
        main_guard(fail)()
    assert stop.value.code == code
    shown = capsys.readouterr().err
    assert text in shown
    assert shown.count("\n") == 1


def test_guard_shows_the_error_behind_a_wrapped_one(capsys):
    from hydra.errors import InstantiationException

    def fail():
        try:
            raise DataError("the reason")
        except DataError as error:
            raise InstantiationException("Error in call to target") from error

    with pytest.raises(SystemExit):
        main_guard(fail)()
    assert capsys.readouterr().err == "lcc_rl: error: the reason\n"


def test_guard_lets_bugs_through():
    with pytest.raises(ZeroDivisionError):
        main_guard(lambda: 1 / 0)()


def test_device_and_threads_are_prepared():
    cfg = OmegaConf.create({"seed": 0, "threads": 1, "device": "cpu"})
    assert prepare_torch(cfg).type == "cpu"


def command(source, *overrides):
    paths = [str(source), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    return subprocess.run(
        [sys.executable, "-m", "lcc_rl.calibrate", "--config-dir", str(source), *overrides],
        cwd=source,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_command_writes_into_the_run_folder(source):
    quick = "calibration.local_genetic.generations=2"
    done = command(source, "data=own", "data.path=episodes.parquet", quick, "hydra.run.dir=here")
    assert done.returncode == 0, done.stderr
    assert (source / "here" / "drivers.parquet").is_file()
    assert (source / "here" / ".hydra" / "config.yaml").is_file()
    assert "v0 on a bound" in done.stdout


@pytest.mark.parametrize(
    ("override", "message"),
    [("data.path=/no/such", "/no/such: no such file"), ("calibration=locl", "'locl'")],
)
def test_command_ends_bad_input_with_one_line_and_code_two(source, override, message):
    done = command(source, "data=own", override)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
