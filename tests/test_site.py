"""The documentation site builds without a warning and loads nothing from elsewhere."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytest.importorskip("myst_nb", reason="extra docs")
pytest.importorskip("furo", reason="extra docs")

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("site")]
ROOT = Path(__file__).parents[1]
# What a browser loads without being asked.
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
NOT_LOADED = {"canonical", "next", "prev", "alternate"}  # relations that are links only


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "site"
    nowhere = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:9")
    words = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet"]
    words += ["-d", str(tmp_path_factory.mktemp("trees")), "docs", str(folder)]
    settings = ["-D", "nb_execution_mode=off"]  # tests/test_notebooks.py runs them
    environment = os.environ | nowhere
    done = subprocess.run(
        words + settings, cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


class Loaded(HTMLParser):
    """Collects what a page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        target = given.get(LOADS.get(tag, ""))
        if target and not set((given.get("rel") or "").split()) & NOT_LOADED:
            self.found.append(target)
        self.found += re.findall(r"url\(([^)]+)\)", given.get("style") or "")


def test_no_page_loads_anything_from_another_host(site) -> None:
    pages = sorted(site.rglob("*.html"))
    assert {"index.html", "tasks.html", "api.html", "alcc.html"} <= {p.name for p in pages}
    for page in pages:
        parser = Loaded()
        parser.feed(page.read_text(encoding="utf-8"))
        foreign = [target for target in parser.found if re.match(r"(https?:)?//", target)]
        assert not foreign, f"{page.name} loads {foreign}"
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import )[\"']?(https?:)?//", style.read_text()), style.name


def test_every_page_is_reached_and_links_read_as_words(site) -> None:
    start = (site / "index.html").read_text(encoding="utf-8")
    for page in (ROOT / "docs").rglob("*.md"):
        address = page.relative_to(ROOT / "docs").with_suffix(".html").as_posix()
        assert address == "index.html" or f'href="{address}"' in start, address
        text = (site / address).read_text(encoding="utf-8")
        assert not re.search(r"<a [^>]*>(<[^>]+>)*[\w/]+\.md<", text), address
    assert (site / "ring.html").exists()


def test_signatures_are_not_cut_off(site) -> None:
    text = (site / "reference" / "api.html").read_text(encoding="utf-8")
    for name in ("make_env", "compare"):
        signature = re.search(rf'<dt class="[^"]*" id="[\w.]+\.{name}">(.*?)</dt>', text, re.S)
        assert signature, name
        assert signature[1].count("<dd>") == signature[1].count('class="sig-param"') > 2, name
