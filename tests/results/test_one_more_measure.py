"""A measure from outside the package: every table, limit and file has it after one call."""

from __future__ import annotations

import csv
import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from helpers import check_refused, slow_but

import lcc_rl
from lcc_rl.cli import score, table
from lcc_rl.commands import evaluation
from lcc_rl.config import load
from lcc_rl.errors import ResultsError
from lcc_rl.evaluation.metrics import METRICS, ROAD_METRICS, register, safety_measures
from lcc_rl.results.measures import MEASURES, Measure
from lcc_rl.results.platoons import PLATOON
from lcc_rl.results.remarks import remarks

SMALL = [
    "scenario.horizon=60",
    "evaluation.warm_up=0",
    "evaluation.profiles=3",
    "evaluation.drivers=2",
]
# Neither its key nor its words say how it is aggregated, bounded or measured.
MINE = Measure(
    "peak_jerk",
    "hardest jerk",
    unit="m/s³",
    aggregate="max",
    bound="at most",
    limit="jerk",
    short="most\njerk",
)
MODULE = """
from lcc_rl.evaluation.metrics import register
from lcc_rl.results.measures import Measure

register({}, lambda over, jerk: over.highest(jerk.abs()))
"""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Write the module of a user's measure; yield the setting that names it."""
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "my_measures.py").write_text(MODULE.format(repr(MINE)), "utf-8")
    monkeypatch.syspath_prepend(tmp_path / "code")
    kept = [(x, x[:]) for x in (MEASURES, PLATOON)]
    yield "measures=[my_measures]"
    for place, before in kept:
        place[:] = before
    for metrics in (METRICS, ROAD_METRICS):
        metrics.pop(MINE.key, None)
    sys.modules.pop("my_measures", None)


TRUSTED = ["--trust", "elsewhere,my_measures"]


@pytest.mark.usefixtures("blank_figures")
@pytest.mark.parametrize("words", slow_but(["task"], ["task", "variant=idm"]))
def test_it_stands_in_every_table(words, mine, tmp_path, capsys) -> None:
    task = ["task=i80-follow", "compare=[idm_acc]", f"+task.limits.{MINE.key}=1e-3"]
    typed = task if words == "task" else [words]
    folder = tmp_path / "run"
    rows = evaluation.run(load("evaluate", [*typed, *SMALL, mine]), folder)
    assert rows[MINE.key].max() > 0.01
    assert "jerk" in capsys.readouterr().out  # of a task by its limit
    found = {}
    for form in ("text", "markdown", "latex", "csv"):
        table.main([str(folder), "--all", "--format", form, *TRUSTED])
        found[form] = capsys.readouterr().out
    assert "hardest jerk [m/s³]" in found["text"]
    assert "peak jerk [m/s³]" in found["markdown"]
    assert "peak jerk [m/s$^3$]" in found["latex"]
    cells = list(csv.DictReader(found["csv"].splitlines()))
    for row in cells:  # of all its episodes
        own = rows.loc[rows["strategy"] == row["strategy"], MINE.key].max()
        value = float(row[MINE.key] or "nan")  # without automated vehicles there is none
        assert value == pytest.approx(own, nan_ok=True)
    table.main([str(folder), "--format", "markdown", *TRUSTED])
    assert re.search(r"jerk.* \[m/s³\]", capsys.readouterr().out.splitlines()[0])
    if words == "task":
        assert "limit: jerk ≤ 0.001 [m/s³]" in found["text"]
        assert "False" in [row["kept"] for row in cells]
        with pytest.raises(ResultsError, match=r"measures.0 names 'my_measures', "):
            table.main([str(folder)])


def test_rows_of_platoons_have_it(mine, tmp_path, capsys) -> None:
    words = ["variant=cacc", "evaluation.profiles=2", "evaluation.full_length=false", mine]
    rows = evaluation.run(load("evaluate", words), tmp_path)
    np.testing.assert_allclose(rows[MINE.key], rows["peak_jerk_mps3"])
    assert "most" in capsys.readouterr().out
    table.main([str(tmp_path), "--all", *TRUSTED])
    assert "hardest jerk [m/s³]" in capsys.readouterr().out


def test_vehicles_of_a_simulation_have_it(mine) -> None:
    vehicles = lcc_rl.simulate([9.0, *[9.9] * 40], "human automated", overrides=[mine]).vehicles
    np.testing.assert_allclose(vehicles[MINE.key][1:], vehicles["max_jerk_mps3"][1:])
    assert vehicles[MINE.key][1:].min() > 0.0


REFUSED = [
    ("a x!", {}, lambda over, gap: gap, "measure 'a x!': expected letters, digits and _"),
    ("min_gap_m", {}, lambda over, gap: gap, "the package has one of this key"),
    ("mine", {}, lambda over, gapp: gapp, "entry of the measure mine 'gapp'.*'gap'"),
    ("mine", {"bound": "≥"}, None, "bound of mine '≥'; valid: .*at least"),
    ("mine", {}, lambda over, gap: over.worst(gap), "measure mine: .*no attribute 'worst'"),
    ("mine", {}, lambda over, gap: 1.0, r"mine: expected a number .* \[2, 1\], got \[\]"),
    ("mine", {}, lambda over, gap, speed: over.mean(gap * speed), "measure mine: .*51"),
    ("mine", {"aggregate": "maximum"}, None, "aggregate of mine 'maximum'.*'max'"),
]


def test_what_is_unclear_is_refused() -> None:
    check_refused(lambda key, given, metric: register(Measure(key, **given), metric), REFUSED)
    series, alive = {"gap": torch.ones(5, 2, 1, 1)}, torch.ones(5, 2, 1, 1, dtype=torch.bool)
    whole = [({"mine": lambda over, gap: gap}, r"mine: expected a number .* \[2, 1\], got \[5")]
    check_refused(lambda metrics: safety_measures(series, alive, 0.1, metrics), whole)
    words = "measures: cannot find 'no_such': .*export PYTHONPATH"
    check_refused(lambda word: load("evaluate", [word]), [("measures=[no_such]", words)])


@pytest.mark.slow
def test_a_score_has_it(mine, tmp_path) -> None:
    words = ["idm_acc", "--task", "i80-follow", "--on", "everyday", "--out", str(tmp_path / "out")]
    assert score.main([*words, *SMALL, mine]) == 0
    (row,) = json.loads((tmp_path / "out" / "score.json").read_text("utf-8"))["results"]
    assert row["measures"][MINE.key] > 0.0


def test_a_key_is_registered_once_but_a_module_may_be_loaded_again(mine) -> None:
    load("evaluate", [mine])
    importlib.reload(sys.modules["my_measures"])
    assert [one.key for one in MEASURES].count(MINE.key) == 1
    words = "peak_jerk: my_measures has registered one of this key; expected another"
    check_refused(lambda metric: register(MINE, metric), [(lambda over: over.steps, words)])


def test_a_measure_without_a_number_is_named(mine) -> None:
    load("evaluate", [mine])
    rows = {"strategy": ["alcc"], "episodes": [3], MINE.key: [np.nan]}
    assert any(f"No episode has a number of {MINE.key}" in x for x in remarks(pd.DataFrame(rows)))
    assert not remarks(pd.DataFrame(rows | {MINE.key: [1.0]}))
