"""Pages of the documentation site that are made from files elsewhere; a hook of mkdocs.yml.

The start page is README.md, the configuration's is made from conf/, and links that leave docs/
lead to the pages made from them.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
COPIED = {
    "index.md": "README.md",
    "contributing.md": "CONTRIBUTING.md",
    "changelog.md": "CHANGELOG.md",
}
CONFIGURATION = "reference/configuration.md"
CODE = "`" * 3
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
INTRODUCTION = """# Configuration

Every option of every command, as its file in `conf/` gives it. A group is chosen by
`group=name`, an option set by `key=value`; `lcc-rl train --help` lists the groups, and
`lcc-rl train --cfg job …` prints what is composed.
"""


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    for name, source in COPIED.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, name, content=_inside_docs(text)))
    files.append(File.generated(config, CONFIGURATION, content=configuration()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Let links that leave docs/ lead to generated pages, or stand as plain code."""
    up = page.file.src_uri.count("/")

    def changed(found: re.Match[str]) -> str:
        picture, text, target = found.groups()
        path, _, place = target.partition("#")
        if re.match(r"[a-z]+:", target) or not path.startswith("../" * (up + 1)):
            return found[0]
        made = {source: name for name, source in COPIED.items()}
        name = made.get(path[3 * (up + 1) :])
        if path[3 * (up + 1) :].startswith("conf/"):
            name = CONFIGURATION
        if name is None:
            return text if text.startswith("`") else f"`{path[3 * (up + 1) :]}`"
        return f"{picture}[{text}]({'../' * up}{name}{'#' * bool(place)}{place})"

    return LINK.sub(changed, markdown)


def on_page_content(html: str, page: Any, config: Any, files: Files) -> str:
    """Leave out Sphinx's roles of docstrings, which mkdocstrings does not know."""
    return re.sub(r":(?:class|func|mod|data|meth|attr):(?=<code)", "", html)


def configuration() -> str:
    """Return the page of all files in conf/, a section per group."""
    parts, folder = [INTRODUCTION], ROOT / "conf"
    for group in sorted({path.parent for path in folder.rglob("*.yaml")}):
        name = group.relative_to(folder).as_posix()
        parts.append(f"## {'Entry points' if name == '.' else name}\n")
        for path in sorted(group.glob("*.yaml")):
            text = path.read_text(encoding="utf-8").rstrip()
            parts.append(
                f"### {path.relative_to(folder).as_posix()}\n\n{CODE}yaml\n{text}\n{CODE}\n"
            )
    return "\n".join(parts)


def _inside_docs(text: str) -> str:
    """Rewrite the links of a page of the project's root for a place in docs/."""

    def changed(found: re.Match[str]) -> str:
        picture, text, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        inside = target.removeprefix("docs/")
        made = {source: name for name, source in COPIED.items()}
        if inside == target and target not in made:
            return f"`{target}`"
        if inside.endswith("/") or not Path(inside.partition("#")[0]).suffix:
            inside = f"{inside.rstrip('/')}/agents.md"
        return f"{picture}[{text}]({made.get(target, inside)})"

    return LINK.sub(changed, text)
