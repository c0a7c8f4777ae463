"""The documentation site (make docs): Sphinx reads the pages as they lie in docs/."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.addnodes import download_reference

import lcc_rl
from lcc_rl.interfaces.ring_page import ring_page

HERE, ROOT = Path(__file__).parent, Path(__file__).parents[1]
sys.path.append(str(ROOT / "tools"))

import settings  # noqa: E402

project, author, release = "lcc_rl", "The lcc_rl developers", lcc_rl.__version__
html_title, html_theme = f"lcc_rl {release}", "furo"
html_logo = html_favicon = "assets/logo.svg"
html_static_path, html_css_files = ["assets"], ["site.css"]
html_copy_source = html_show_sourcelink = html_show_copyright = False
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
exclude_patterns = ["_build"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "cache"  # a notebook runs anew once it has changed
nb_execution_cache_path = str(ROOT / ".jupyter_cache")
nb_execution_timeout, nb_execution_raise_on_error, nb_merge_streams = 1800, True, True

autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_typehints = "signature"
autodoc_typehints_format, python_maximum_signature_line_length = "short", 80
python_use_unqualified_type_names = True

PLAIN = (".html",)  # opened, not saved, by a click
OPENED = ("ring.html",)
RING = "pretrained/ring-22"  # drives in ring.html, which is written here
CONFIGURATION = "reference/configuration"
NAMED = re.compile(r"(?<!!)\[[\w/]+\.md\]\(([\w/.]+\.md[^)\s]*)\)")  # a link that reads as its file
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\(((?:\.\./)+)([^)\s#]+)(#[^)\s]*)?\)")


def read(app: Any, name: str, source: list[str]) -> None:
    """Rewrite the links of a page, and add all files of conf/ to theirs."""
    source[0] = NAMED.sub(r"[](\1)", LINK.sub(_inside, source[0]))
    source[0] += configuration() if name == CONFIGURATION else ""


def read_included(app: Any, path: Path, name: str, source: list[str]) -> None:
    """Rewrite the links of a page of the project's root."""
    read(app, path.name, source)


def _inside(found: re.Match[str]) -> str:
    text, _, path, _ = found.groups()
    if (ROOT / path).exists() and not (HERE / path).exists():
        plain = text.startswith("`") or text.strip("/") == path
        return text if plain else f"{text} in `{path}`"
    return found[0]


def configuration() -> str:
    """Return all files in conf/, a section per group."""
    parts, folder = [""], ROOT / "conf"
    for group in sorted({path.parent for path in folder.rglob("*.yaml")}):
        name = group.relative_to(folder).as_posix()
        parts.append(f"## {'Entry points' if name == '.' else name}\n")
        for path in sorted(group.glob("*.yaml")):
            title, text = path.relative_to(folder).as_posix(), path.read_text(encoding="utf-8")
            parts.append(f"### {title}\n\n~~~yaml\n{text.rstrip()}\n~~~\n")
    return "\n".join(parts)


def open_pages(app: Any, doctree: nodes.document) -> None:
    """Make links to pages that Sphinx does not write ordinary ones."""
    for node in list(doctree.findall(download_reference)):
        if node["reftarget"].endswith(PLAIN):
            node.replace_self(nodes.reference("", "", *node.children, refuri=node["reftarget"]))


def copy_pages(app: Any, error: Exception | None) -> None:
    """Copy these pages beside the others."""
    for name in OPENED if error is None else ():
        copy = shutil.copytree if (HERE / name).is_dir() else shutil.copy
        shutil.rmtree(app.outdir / name, ignore_errors=True)
        copy(HERE / name, app.outdir / name)


def setup(app: Any) -> None:
    """Write the pages that are not tracked, and connect what is above."""
    settings.main()
    (HERE / OPENED[0]).write_text(ring_page(RING), encoding="utf-8")
    app.connect("source-read", read)
    app.connect("include-read", read_included)
    app.connect("doctree-read", open_pages)
    app.connect("build-finished", copy_pages)
