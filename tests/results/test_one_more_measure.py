"""One more measure is a function in ``METRICS`` and a line in ``MEASURES``: every table has it."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest
from helpers import slow_but

from lcc_rl.cli import table
from lcc_rl.commands import evaluation, score
from lcc_rl.config import load
from lcc_rl.evaluation.metrics import METRICS
from lcc_rl.results.measures import MEASURES, Measure

SMALL = [
    "scenario.horizon=60",
    "evaluation.warm_up=0",
    "evaluation.profiles=3",
    "evaluation.drivers=2",
]
MINE = Measure(
    "max_jerk_mps3",
    "largest jerk [m/s³]",
    short="most\njerk",
    limit="jerk\n≤ {:g}\n[m/s³]",
)


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(METRICS, MINE.key, lambda over, jerk: over.highest(jerk.abs()))
    MEASURES.append(MINE)
    yield
    MEASURES.remove(MINE)


@pytest.mark.usefixtures("mine", "blank_figures")
@pytest.mark.parametrize("words", slow_but(["task"], ["task", "variant=idm"]))
def test_it_stands_in_every_table(words, tmp_path, capsys) -> None:
    task = ["task=i80-follow", "compare=[idm_acc]", f"+task.limits.{MINE.key}=1e-3"]
    typed = task if words == "task" else [words]
    rows = evaluation.run(load("evaluate", [*typed, *SMALL]), tmp_path)
    assert rows[MINE.key].max() > 0.01
    assert "jerk" in capsys.readouterr().out  # of a task by its limit
    found = {}
    for form in ("text", "markdown", "latex", "csv"):
        table.main([str(tmp_path), "--all", "--format", form])
        found[form] = capsys.readouterr().out
    assert MINE.label in found["text"]
    assert "max jerk [m/s³]" in found["markdown"]
    assert "max jerk [m/s³]" in found["latex"]
    assert MINE.key in found["csv"].splitlines()[0].split(",")
    table.main([str(tmp_path), "--format", "markdown"])
    assert "max jerk [m/s³]" in capsys.readouterr().out.splitlines()[0]
    if words == "task":
        assert "limit: jerk ≤ 0.001 [m/s³]" in found["text"]


@pytest.mark.slow
@pytest.mark.usefixtures("mine")
def test_a_score_has_it(tmp_path) -> None:
    words = ["idm_acc", "--task", "i80-follow", "--on", "everyday", "--out", str(tmp_path / "out")]
    assert score.main([*words, *SMALL]) == 0
    (row,) = json.loads((tmp_path / "out" / "score.json").read_text("utf-8"))["results"]
    assert row["measures"][MINE.key] > 0.0
