"""Tables and figures of the documentation are drawn again from what is kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import redraw
from matplotlib.image import imread

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_everything_is_drawn_again_and_the_page_is_the_same(tmp_path) -> None:
    page = Path(shutil.copy(ROOT / "docs" / "tasks.md", tmp_path))
    written = redraw.redraw(ROOT / redraw.REFERENCE, tmp_path, page)
    assert page.read_text() == (ROOT / "docs" / "tasks.md").read_text()
    images = [path for path in written if path.suffix == ".png"]
    assert {path.name for path in images} == {
        "fleets.png",
        "fleets_ring.png",
        "ring.png",
        "record.png",
        "limits.png",
        "measured.png",
        "twins.png",
    }
    for image in images:
        pixels = imread(image)[..., :3].reshape(-1, 3)
        colours = {tuple(row) for row in (255 * pixels[::7]).astype(int) if min(row) < 200}
        assert len(colours) > 100, image  # lines of several colours, not a blank frame


@pytest.mark.slow
@pytest.mark.parametrize("name", redraw.SHOWN_OF)
def test_the_page_of_a_study_holds_the_tables_that_are_kept(tmp_path, name) -> None:
    (tmp_path / "figures").mkdir()
    page = Path(shutil.copy(ROOT / "docs" / f"{name}.md", tmp_path))
    _, *figures = redraw.redraw_study(name, ROOT / redraw.REFERENCE, tmp_path)
    assert page.read_text() == (ROOT / "docs" / f"{name}.md").read_text()
    assert all(figure.stat().st_size > 10_000 for figure in figures)
