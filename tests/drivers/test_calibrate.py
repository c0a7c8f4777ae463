"""The calibrate command: files, report, and one clear line for whatever is wrong."""

import io
from contextlib import chdir
from functools import partial

import pandas as pd
import pytest
import torch
from commands import run_command
from helpers import check_refused, slow_but
from rich.console import Console
from table_text import long_table

from lcc_rl.commands import calibration, repeat
from lcc_rl.config import load
from lcc_rl.drivers.population import bootstrap
from lcc_rl.envs.inputs import described
from lcc_rl.functional.laws import LAWS
from lcc_rl.io.files import parquet_metadata
from lcc_rl.pieces import CalibratedDrivers
from lcc_rl.pieces.world import World
from lcc_rl.runs.progress import phases


@pytest.fixture
def source(tmp_path, uneven_lengths):
    """Folder with an episode file."""
    uneven_lengths.to_parquet(tmp_path / "episodes.parquet")
    return tmp_path


@pytest.fixture
def cfg(source):
    """Configuration of a small calibration in both modes."""
    quick = ("population=8", "generations=2", "founders=1")
    words = [f"calibration.{mode}_genetic.{word}" for mode in ("local", "global") for word in quick]
    path = f"data.path='{source / 'episodes.parquet'}'"
    return load("calibrate", ["data=episodes", path, "calibration=both", *words])


def test_run_writes_table_and_figures_and_says_what_it_did(cfg, tmp_path):
    out = io.StringIO()
    drivers = calibration.run(cfg, tmp_path / "run", Console(file=out, width=100))
    names = sorted(path.name for path in (tmp_path / "run").iterdir())
    tables = ["drivers.parquet", "twins.parquet"]
    figures = ["calibration.png", "joint_distribution.png", "twins.png"]
    assert names == sorted(["config.yaml", "origin.txt", *tables, *figures])
    written = pd.read_parquet(tmp_path / "run" / "drivers.parquet")
    pd.testing.assert_frame_equal(written, drivers, check_dtype=False)
    metadata = parquet_metadata(tmp_path / "run" / "drivers.parquet")
    assert metadata["report"].startswith("read 3 episodes, 954 rows")
    assert '"modes": ["local", "global"]' in metadata["config"]
    assert len(bootstrap(tmp_path / "run" / "drivers.parquet")) == 3
    for text in ("read 3 episodes", "3 of 3 episodes used", "RMSPE [%]", "time gap [s]"):
        assert text in out.getvalue()


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("model", slow_but(["gipps"], list(LAWS)))
def test_every_model_is_calibrated_and_drives_again(cfg, tmp_path, model):
    changes = {"model": model, "objective": "both", "holdout": 0.3}
    cfg = cfg.with_(calibration=cfg.calibration.changed(**changes))
    out = io.StringIO()
    calibration.run(cfg, tmp_path / "run", Console(file=out, width=100))
    for text in ("held out: RMSPE", "gap NRMSE [%], held out", "time gap [s]"):
        assert text in out.getvalue()
    population = bootstrap(tmp_path / "run" / "drivers.parquet", mode="global")
    assert set(population.parameters()) == set(LAWS[model].table())
    driven = CalibratedDrivers().bind(World(population=population))
    state = [torch.full((3, 1, 1), x) for x in (10.0, 20.0, 0.0, 25.0, 1.2)]
    assert driven.acceleration(*state, torch.arange(3).view(3, 1, 1)).isfinite().all()


def test_bad_input_ends_in_an_error_that_names_it(cfg, tmp_path):
    def calibrate(key: str, value: object) -> None:
        entry, *path, last = key.split(".")
        node, own = getattr(cfg, entry), {last: value}
        for part in path:
            own = {part: node.settings[part] | own}
        changed = cfg.with_(**{entry: node.changed(**own)})
        calibration.run(changed, tmp_path / "run", Console(file=io.StringIO()))

    cases = [
        ("data.path", "/no/such", "/no/such: no such file"),
        ("calibration.holdout", 1.0, "holdout"),
        ("calibration.selection.min_gap_m", 1e3, "gap below 1000 m"),
        ("calibration.holdout", 0.001, "holdout 0.001 of an episode of 238 samples"),
        ("calibration.constants.sensitivity", 1.0, "constant of model idm"),
    ]
    check_refused(calibrate, cases)
    assert not (tmp_path / "run").exists()


@pytest.fixture
def command(source):
    """Function that runs the command in the folder of the episode file."""
    return partial(run_command, "calibrate", cwd=source)


@pytest.mark.usefixtures("blank_figures")
def test_command_writes_into_the_run_folder(source, command):
    quick = [f"calibration.local_genetic.{name}" for name in ("generations=2", "population=8")]
    (source / "data").mkdir()
    node = "_target_: lcc_rl.data.sources.EpisodesSource\npath: episodes.parquet\n"
    (source / "data" / "own.yaml").write_text(node)
    own = ["--config-dir", str(source), "data=own", "hydra.run.dir=here"]
    done = command(*own, *quick, check=True)
    assert (source / "here" / "drivers.parquet").is_file()
    assert (source / "here" / ".hydra" / "config.yaml").is_file()
    assert "v0 on a bound" in done.stdout
    with chdir(source):
        assert repeat.main(["here"]) == 0


@pytest.mark.usefixtures("blank_figures")
def test_drivers_keep_the_names_of_the_data(cfg, tmp_path):
    names = {0: "", 1: "Audi", 2: "BMW", 3: "Ford"}
    table = long_table().replace({"id": names, "ahead": names})
    table.to_csv(tmp_path / "named.csv", index=False)
    columns = "{vehicle: id, time: t, speed: v, leader: ahead, gap: gap}"
    path = f"data.path={tmp_path / 'named.csv'}"
    named = load("calibrate", ["data=table", path, f"data.columns={columns}"])
    cfg = cfg.with_(data=named.data, calibration=cfg.calibration.changed(modes=["local"]))
    calibration.run(cfg, tmp_path / "run", Console(file=io.StringIO()))
    drivers = pd.read_parquet(tmp_path / "run" / "drivers.parquet")
    assert drivers["follower"].tolist() == ["BMW", "Ford"]
    assert drivers["leader"].tolist() == ["Audi", "BMW"]
    assert len(bootstrap(tmp_path / "run" / "drivers.parquet")) == 2


def test_spreads_are_those_of_a_sample():
    assert calibration._spread(pd.Series([0.0, 2.0])) == "1.00 ± 1.41"  # n − 1
    assert calibration._spread(pd.Series([2.0, 2.0])) == "2.00 (all)"


@pytest.mark.usefixtures("blank_figures")
def test_the_report_counts_records_and_drivers(cfg, source, tmp_path):
    path = source / "episodes.parquet"
    table = pd.read_parquet(path).reset_index(drop=True)
    table["gap_m"] = table["gap_m"].where(table.index != 438)  # a blank cell in the middle of one
    table.to_parquet(path)
    out, lines = io.StringIO(), []
    cfg = cfg.with_(calibration=cfg.calibration.changed(modes=["local"]))
    emit = lines.extend
    drivers = calibration.run(cfg, tmp_path / "run", Console(file=out, width=100), emit)
    assert len(drivers) == 4
    assert any(line.startswith("local: RMSPE of 4 records of 3 drivers: ") for line in lines)
    assert "4 records of 3 drivers" in out.getvalue()
    people = bootstrap(tmp_path / "run" / "drivers.parquet")
    assert "4 human drivers, one per record of 3 vehicle" in described(people, load("evaluate", []))


def test_phases_report_lines_with_the_time_left_where_there_is_no_terminal():
    lines, quiet = [], Console(file=io.StringIO())
    with phases("calibration", quiet, lines.extend, every=0.0) as progress:
        for phase in ("generations", "reactions tried"):
            for done in (1, 2):
                progress(done, 2, phase)
    assert lines[-1] == "calibration: reactions tried: 2/2  ETA 0:00"
    assert len(lines) == 4
    with phases("calibration", quiet, lines.extend) as progress:
        progress(1, 2, "generations")
    assert len(lines) == 4
