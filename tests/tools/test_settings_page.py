"""The page of settings, which the site makes, is that of the classes."""

from __future__ import annotations

import re

import settings as tool

from lcc_rl.agents import DDPG


def test_the_page_has_a_section_for_each_class_that_has_settings() -> None:
    sections = re.findall(r"^## (.*)$", tool.page(), re.M)
    assert len(sections) == len(set(sections)) > 50
    assert f"{DDPG.__module__}.{DDPG.__name__}" in sections


def test_a_setting_has_type_default_and_the_words_beside_it() -> None:
    rows = {name: rest for name, *rest in tool.settings(DDPG)}
    assert rows["mask_terminal"] == [
        "bool",
        "True",
        "value 0 after a collision; False: the critic's value",
    ]
    assert rows["target_every"][1] == "{'actor': 1, 'critic': 1}"
