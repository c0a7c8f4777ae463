"""Tables and figures of the documentation are written again from what is kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import pages
import pytest
from matplotlib.image import imread
from page_blocks import ROOT

from lcc_rl.errors import ConfigError

REFERENCE = ROOT / pages.REFERENCE


@pytest.fixture
def docs(tmp_path) -> Path:
    (tmp_path / "figures").mkdir()
    (tmp_path / "notes").mkdir()
    for page in (ROOT / "docs").rglob("*.md"):
        if page.parent.name in ("docs", "notes"):
            shutil.copy(page, tmp_path / page.relative_to(ROOT / "docs"))
    return tmp_path


def same(docs: Path, *names: str) -> None:
    for name in names:
        assert (docs / name).read_text() == (ROOT / "docs" / name).read_text(), name


def test_the_pages_hold_the_scores_kept(docs) -> None:
    pages.tasks(REFERENCE, docs)
    pages.learners(REFERENCE, docs)
    same(docs, "ablations.md", "fleets.md", "leaderboard.md", "limits.md", "learners.md")
    same(docs, "notes/results.md")


@pytest.mark.slow
@pytest.mark.parametrize("name", pages.SHOWN_OF)
def test_the_page_of_a_study_holds_the_tables_that_are_kept(docs, name) -> None:
    pages.study(name, REFERENCE, docs)
    same(docs, f"{name}.md")
    assert len(list((docs / "figures").iterdir())) == len(pages.SHOWN_OF[name])


@pytest.mark.slow
def test_every_figure_is_drawn_again(tmp_path) -> None:
    for image in pages.figures(REFERENCE, tmp_path):
        pixels = imread(image)[..., :3].reshape(-1, 3)
        colours = {tuple(row) for row in (255 * pixels[::7]).astype(int) if min(row) < 200}
        assert len(colours) > 100, image  # lines of several colours, not a blank frame


def test_a_mark_without_a_table_is_named(tmp_path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- table: nothing -->\n<!-- end -->\n")
    with pytest.raises(ConfigError, match="no table 'nothing'; known: a"):
        pages.fill(page, {"a": "b"})
