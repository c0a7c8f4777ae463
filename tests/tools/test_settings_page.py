"""The page of settings is that of the classes."""

from __future__ import annotations

import settings as tool

from lcc_rl.agents import DDPG


def test_the_page_is_up_to_date() -> None:
    assert tool.PAGE.read_text() == tool.page()


def test_a_setting_has_type_default_and_the_words_beside_it() -> None:
    rows = {name: rest for name, *rest in tool.settings(DDPG)}
    assert rows["mask_terminal"] == [
        "bool",
        "True",
        "no value is expected after a collision; False: one is",
    ]
    assert rows["target_every"][1] == "{'actor': 1, 'critic': 1}"
