"""The pages' commands: each one exists, its options do, and its settings compose."""

from __future__ import annotations

import re
import sys

import pytest
from page_checks import CHOICES, check, named, write_configuration
from pages import LANGUAGES, PAGES, ROOT, blocks, commands, inline, name_of, words_of

CONF = ROOT / "conf"


@pytest.fixture(autouse=True)
def own_modules(tmp_path, monkeypatch):
    """Write the modules that the pages tell to write."""
    for page in PAGES:
        for block in blocks(page):
            file = re.match(r"# (\w+\.py)", block.text) if block.language == "python" else None
            if file:
                with (tmp_path / file[1]).open("a") as module:
                    module.write(block.text)
    monkeypatch.syspath_prepend(tmp_path)
    yield
    for path in tmp_path.glob("*.py"):
        sys.modules.pop(path.stem, None)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_what_a_page_names_exists(page, tmp_path) -> None:
    own = write_configuration(blocks(page), tmp_path)
    for block in blocks(page):
        assert block.language in LANGUAGES, f"{page}:{block.line}: {block.language}"
        if block.language in ("bash", "console"):
            for words in commands(block):
                with named(page, block.line, words):
                    check(words, own, fails="lcc_rl: error:" in block.text)
    for span in inline(page):
        if span.startswith(("lcc-rl ", "python tools/", "make ", "pip ")):
            words = words_of(span)
            with named(page, 0, words):
                check(words, None)
        for group, choice in re.findall(r"(?:^|\s)\+?([a-z_/]+)=([a-z_0-9]+)(?=\s|$)", span):
            if (CONF / group).is_dir() and choice not in ("null", "none"):
                assert CONF / group / f"{choice}.yaml" in CHOICES, f"{group}={choice}"
