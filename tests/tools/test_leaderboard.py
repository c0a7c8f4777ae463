"""The tables of docs/tasks.md are those of outputs/reference/."""

from __future__ import annotations

import shutil
from pathlib import Path

import leaderboard
import pytest

from lcc_rl.errors import ConfigError

ROOT = Path(__file__).parents[2]


def test_the_page_holds_the_scores_kept(tmp_path) -> None:
    page = shutil.copy(ROOT / "docs" / "tasks.md", tmp_path)
    leaderboard.write_tables(ROOT / leaderboard.REFERENCE, Path(page))
    assert Path(page).read_text() == (ROOT / "docs" / "tasks.md").read_text()


def test_the_page_holds_the_files_of_scores(tmp_path) -> None:
    page = shutil.copy(ROOT / leaderboard.BOARD, tmp_path)
    leaderboard.write_board(ROOT / leaderboard.SCORES, Path(page))
    assert Path(page).read_text() == (ROOT / leaderboard.BOARD).read_text()


def test_a_page_without_its_marks_is_named(tmp_path) -> None:
    page = tmp_path / "page.md"
    page.write_text("nothing\n")
    with pytest.raises(ConfigError, match="it lacks the lines"):
        leaderboard.write_tables(tmp_path, page)
