"""The documentation site: built without a warning, loads nothing from elsewhere, fits the width."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import pytest
from commands import QUICK, TINY, jobs_in_threads, run_command

pytest.importorskip("mkdocs", reason="extra docs")
pytest.importorskip("mkdocstrings", reason="extra docs")

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("site")]
ROOT = Path(__file__).parents[1]
WIDTH = 1280
# What a browser loads without being asked.
LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}
NOT_LOADED = {"canonical", "next", "prev", "alternate"}  # relations that are links only
MEASURE = """<script>addEventListener("load", () => setTimeout(() => {
  document.documentElement.dataset.width = document.documentElement.scrollWidth;
}, 200))</script>"""


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site") / "site"
    nowhere = dict.fromkeys(("http_proxy", "https_proxy"), "http://127.0.0.1:9")
    words = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    environment = {**os.environ, **nowhere, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
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
    assert {"index.html", "tasks.html", "api.html", "alcc_i80.html"} <= {p.name for p in pages}
    for page in pages:
        parser = Loaded()
        parser.feed(page.read_text(encoding="utf-8"))
        foreign = [target for target in parser.found if re.match(r"(https?:)?//", target)]
        assert not foreign, f"{page.name} loads {foreign}"
    for style in site.rglob("*.css"):
        assert not re.search(r"(url\(|@import )[\"']?(https?:)?//", style.read_text()), style.name


class Measured(SimpleHTTPRequestHandler):
    """Serves the site, with a program in every page that notes its width."""

    def do_GET(self) -> None:
        path = Path(self.translate_path(self.path))
        if path.suffix != ".html" or not path.is_file():
            return super().do_GET()
        text = path.read_text(encoding="utf-8").replace("</body>", f"{MEASURE}</body>")
        # The reports allow no program at all; this one is ours.
        text = text.replace("default-src 'none'", "default-src 'none'; script-src 'unsafe-inline'")
        content = text.encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/html; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)
        return None

    def log_message(self, *args: object) -> None:
        """Say nothing."""


@pytest.fixture(scope="module")
def address(site, tmp_path_factory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("job")
    words = (*TINY, QUICK, "variants=[reference,alcc]", "hydra.run.dir=run")
    with pytest.MonkeyPatch.context() as patch:
        jobs_in_threads(patch)
        run_command("lcc_rl.pipeline", *words, cwd=folder, check=True)
    shutil.copy(folder / "run" / "report.html", site / "report.html")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Measured, directory=str(site))) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SHOWN = ("index", "tasks", "limits", "alcc", "sweeps", "reference/api", "reference/configuration")


@pytest.mark.skipif(not any(map(shutil.which, BROWSERS)), reason="no Chromium")
@pytest.mark.parametrize("page", [*SHOWN, "reports/hcfs", "report"])
def test_a_page_fits_the_width_and_reports_no_error(page, address, tmp_path) -> None:
    browser = next(filter(None, map(shutil.which, BROWSERS)))
    quiet = ("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars")
    alone = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
    own = (f"--user-data-dir={tmp_path}", f"--window-size={WIDTH},1000", "--enable-logging=stderr")
    words = (browser, *quiet, alone, *own, "--virtual-time-budget=5000", "--dump-dom")
    done = subprocess.run(
        [*words, f"{address}/{page}.html"], capture_output=True, text=True, timeout=120
    )
    width = re.search(r'<html[^>]* data-width="(\d+)"', done.stdout)
    assert width, done.stderr[-2000:]
    assert int(width[1]) <= WIDTH
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not said
