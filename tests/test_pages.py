"""The pages' commands: each one exists, its options do, and its settings compose."""

from __future__ import annotations

import re

import pytest
from page_checks import CHOICES, check, named, write_configuration
from pages import LANGUAGES, PAGES, ROOT, blocks, commands, inline, name_of, words_of

every_page = pytest.mark.parametrize("page", PAGES, ids=name_of)


@every_page
def test_every_block_names_its_language(page) -> None:
    unknown = [block for block in blocks(page) if block.language not in LANGUAGES]
    assert not unknown, "say ```bash for commands, ```console for commands with what they print"


@every_page
def test_every_command_exists_and_takes_its_options(page, tmp_path) -> None:
    own = write_configuration(blocks(page), tmp_path)
    for block in blocks(page):
        if block.language in ("bash", "console"):
            for words in commands(block):
                with named(page, block.line, words):
                    check(words, own, fails="lcc_rl: error:" in block.text)


@every_page
def test_every_command_in_the_text_exists_and_takes_its_options(page) -> None:
    for span in inline(page):
        if span.startswith(("lcc-rl ", "python tools/", "make ", "pip ")):
            words = words_of(span)
            with named(page, 0, words):
                check(words, None)


@every_page
def test_every_choice_in_the_text_has_its_file(page) -> None:
    groups = {path.parent.relative_to(ROOT / "conf").as_posix() for path in CHOICES}
    for span in inline(page):
        for group, choice in re.findall(r"(?:^|\s)\+?([a-z_/]+)=([a-z_0-9]+)(?=\s|$)", span):
            if group in groups and choice not in ("null", "none"):
                assert ROOT / "conf" / group / f"{choice}.yaml" in CHOICES, f"{group}={choice}"
