"""The tables of docs/tasks.md are those of outputs/reference/."""

from __future__ import annotations

import shutil
from pathlib import Path

import leaderboard

ROOT = Path(__file__).parents[2]


def test_the_page_holds_the_scores_kept(tmp_path) -> None:
    page = shutil.copy(ROOT / "docs" / "tasks.md", tmp_path)
    reference = str(ROOT / leaderboard.REFERENCE)
    assert leaderboard.main(["--reference", reference, "--page", str(page)]) == 0
    assert Path(page).read_text() == (ROOT / "docs" / "tasks.md").read_text()


def test_a_page_without_its_marks_is_named(tmp_path, capsys) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    assert leaderboard.main(["--reference", str(tmp_path), "--page", str(page)]) == 1
    assert f"{page}: it lacks the lines" in capsys.readouterr().err
