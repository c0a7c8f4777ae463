"""The page: escaped, self-contained, and shown as it should be by a real browser."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.image import imread
from PIL import Image

from lcc_rl.errors import ResultsError
from lcc_rl.figures.drawing import new_figure, save
from lcc_rl.figures.page import Section, heading, made, write_report
from lcc_rl.io.files import processor, write_parquet

BROWSERS = ("chromium", "chromium-browser", "google-chrome")


@pytest.fixture
def page(tmp_path) -> Path:
    figure = new_figure(2.0, 1.0)
    figure.subplots().plot([0, 1], [0, 1])
    pictures = [("A line", save(figure, tmp_path / f"line.{kind}")) for kind in ("png", "svg")]
    table = pd.DataFrame(
        {
            "strategy": ["alcc", "<b>"],
            "saving_pct": [4.384, -1.0],
            "saving_pct_low": [4.1, np.nan],
            "saving_pct_high": [4.6, np.nan],
            "episodes": [4980, 12],
            "total_energy_kj": [270.123, np.nan],
            "within_limits": [True, False],
        }
    )
    sections = [
        Section("First & last", "One < two.\n\nNext.", [("A table", table)], pictures),
        made(["lcc-rl reproduce alcc"], [("Configuration", "seed: 0")]),
    ]
    return write_report(tmp_path, "A study", sections)


def test_pictures_keep_every_pixel(page) -> None:
    found = re.findall(r"data:image/(\w+);base64,([^\"]+)", page.read_text())
    (data,) = (data for kind, data in found if kind == "webp")
    shown, drawn = Image.open(BytesIO(base64.b64decode(data))), Image.open(page.parent / "line.png")
    assert shown.convert("RGBA").tobytes() == drawn.convert("RGBA").tobytes()


class Outline(HTMLParser):
    """Collects what a page holds."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [str(value) for name, value in attrs if name in ("src", "href", "action")]


def outline(html: str) -> Outline:
    parser = Outline()
    parser.feed(html)
    return parser


def test_a_page_holds_everything_and_fetches_nothing(page) -> None:
    html = page.read_text()
    found = outline(html)
    assert found.tags.count("img") == 2
    assert found.tags.count("table") == 2
    assert "script" not in found.tags
    assert "link" not in found.tags
    assert all(link.startswith(("#", "data:image/")) for link in found.links)
    assert not re.search(r"url\(|@import|https?://", html)
    assert "default-src 'none'" in html


def test_cells_are_formatted_for_readers(page) -> None:
    html = page.read_text()
    assert "<th>strategy</th>" in html
    assert '<th class="number">saving [%]</th>' in html
    assert '<td class="number">4.38 (4.10 … 4.60)</td>' in html
    assert '<td class="number">−1.00</td>' in html
    assert '<td class="number">4,980</td>' in html
    assert '<td class="number">270.1</td>' in html
    assert "saving pct low" not in html
    assert "<td>yes</td>" in html
    assert ">–</td>" in html
    assert "&lt;b&gt;" in html
    assert "First &amp; last" in html
    assert "One &lt; two.</p>" in html


def test_how_it_was_made(page) -> None:
    html = page.read_text()
    assert "lcc-rl reproduce alcc" in html
    assert "<td>torch</td>" in html
    assert re.search(r"written on \d{4}-\d\d-\d\d", html)


def test_where_trainings_ran_is_counted(tmp_path) -> None:
    paths = [tmp_path / f"{number}.parquet" for number in range(3)]
    for path in paths[:2]:
        write_parquet(pd.DataFrame({"a": [1]}), path)
    pq.write_table(pa.table({"a": [1]}), paths[2])  # of a release that did not say
    text = made([], runs=paths).text
    assert text.endswith(f"ran on: {processor()} (2), not recorded (1).")


def test_headings_say_units() -> None:
    assert heading("total_energy_kj") == "total energy [kJ]"
    assert heading("energy_kj_per_km") == "energy [kJ/km]"
    assert heading("least_ttc_s") == "least TTC [s]"
    assert heading("seeds") == "seeds"


def test_a_missing_figure_is_named(tmp_path) -> None:
    with pytest.raises(ResultsError, match=r"nothing\.png: cannot be read"):
        write_report(tmp_path, "x", [Section("s", figures=[("c", tmp_path / "nothing.png")])])


def browse(page: Path, *options: str) -> str:
    """Open a page in a real browser, as far as one is installed."""
    browser = next((name for name in BROWSERS if shutil.which(name)), None)
    if browser is None:
        pytest.skip(f"no browser installed: none of {', '.join(BROWSERS)} found")
    profile = f"--user-data-dir={page.parent / 'browser'}"
    quiet = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking")
    words = [browser, *quiet, profile, *options, page.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_browser_shows_tables_and_figures(page) -> None:
    found = outline(browse(page, "--dump-dom"))
    assert found.tags.count("table") == 2
    assert found.tags.count("img") == 2
    assert found.tags.count("details") == 2
    picture = page.parent / "shot.png"
    browse(page, f"--screenshot={picture}", "--window-size=1000,1600")
    pixels = imread(picture)
    assert pixels.shape[:2] == (1600, 1000)
    # The line of the png figure is drawn in matplotlib's blue.
    blue = np.abs(pixels[..., :3] - np.array([0.122, 0.467, 0.706])).max(-1) < 0.1
    assert blue.sum() > 100


def test_a_browser_asks_the_network_for_nothing(page) -> None:
    log = page.parent / "net.json"
    browse(page, "--dump-dom", f"--log-net-log={log}")
    asked = set(re.findall(r'"url":"((?:https?|wss?)://[^"]+)"', log.read_text()))
    # What the browser asks for on its own account does not come from the page.
    blank = page.parent / "blank.html"
    blank.write_text("<!doctype html><title>blank</title>")
    browse(blank, "--dump-dom", f"--log-net-log={log}")
    own = set(re.findall(r'"url":"((?:https?|wss?)://[^"]+)"', log.read_text()))
    hosts, usual = ({url.split("/")[2] for url in urls} for urls in (asked, own))
    assert hosts <= usual, hosts - usual
