"""The command that reproduces a study: refused in one line, and the recipe of its runs."""

from __future__ import annotations

import pytest

from lcc_rl.cli.guard import main_guard
from lcc_rl.studies import reproduce as tool


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["alcc", "--recipe", "smok"], "smok"),
        (["report", "nowhere"], "no evaluation/episodes.parquet"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, words, expected) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as caught:
        main_guard(tool.main)(words)
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert expected in said
    assert len(said.strip().splitlines()) == 1
