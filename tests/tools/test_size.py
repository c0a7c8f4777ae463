"""How large the project is: lines counted by hand."""

from __future__ import annotations

import pandas as pd
import size

MODULE = '''"""What the module contains."""

# A comment.
def check_gap(gap):
    """Check a gap.

    More.
    """
    if gap < 0:
        raise ValueError(
            "negative"
        )


def test_gap():
    check_gap(1)
    text = """
    no docstring"""
    return text  # the gap
'''


def test_lines_code_and_guards_of_a_module() -> None:
    # The function check_gap, five lines without its docstring, and its call guard.
    assert size.measured(MODULE) == {"modules": 1, "lines": 19, "code": 10, "guards": 6, "tests": 1}


def test_the_table_adds_lcc_rl_and_tools(monkeypatch, tmp_path) -> None:
    for name in ("lcc_rl/a.py", "lcc_rl/b/c.py", "tools/d.py", "tests/e.py", "conf/f.yaml"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(MODULE if name.endswith("py") else "a: 1\n")
    names = [path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*.*")]
    monkeypatch.setattr(size, "ROOT", tmp_path)
    table = size.table(names, {"tests/e.py": 7})
    assert table["lines"].to_dict() == {
        "conf": 0,
        "lcc_rl": 38,
        "lcc_rl + tools": 57,
        "lcc_rl/b": 19,
        "tests": 19,
        "tools": 19,
    }
    assert table.loc["tests", "cases"] == 7
    assert table.loc["conf", "yaml"] == 1
    assert table.loc["tools", "%"] == 60.0


def test_the_structure_of_a_package(monkeypatch, tmp_path) -> None:
    modules = {
        "lcc_rl/base/one.py": "SPEED = 1\n",
        "lcc_rl/base/two.py": "from lcc_rl.base.one import SPEED\n",
        "lcc_rl/above/three.py": "from lcc_rl.base import one\nSPEED: int = 2\n_own = 1\n",
        "lcc_rl/above/four.py": "import lcc_rl.top.five\ndef h(cfg, seed): pass\n",
        "lcc_rl/top/five.py": "def f(x: TrainConfig):\n    from lcc_rl.above.four import g\n",
    }
    for name, text in modules.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(size, "ROOT", tmp_path)
    # SPEED stands in two modules; above and top import each other, so they share floor 2.
    assert list(size.structure(modules).values()) == [1, 2, 1, 2]


def test_a_number_above_its_ceiling_has_a_line() -> None:
    numbers = {part: {"lines": 0, "code": 0, "yaml": 0} for part in size.CEILINGS}
    found = pd.DataFrame.from_dict(numbers, orient="index")
    assert size.above(found, dict(size.STRUCTURE)) == []
    found.loc["conf", "yaml"] = size.CEILINGS["conf"]["yaml"] + 1
    (line,) = size.above(found, dict(size.STRUCTURE))
    assert line.startswith("conf, yaml: ")


def test_the_suite_has_no_more_cases_than_agreed(request) -> None:
    assert request.session.testscollected <= size.CASES
