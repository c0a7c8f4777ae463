"""Patterns of a string: what they mean, where they are wrong, and how penetration is rounded."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lcc_rl.errors import ConfigError
from lcc_rl.functional.pattern import RESERVED, parse_string
from lcc_rl.pieces.base import ROLE, TERM
from lcc_rl.pieces.views import AHEAD, BEHIND, EPISODE, LEADER, NEXT, SELF, VEHICLES

A, H = "automated", "human"


def test_what_a_pattern_means(subtests) -> None:
    for pattern, roles in [
        ("automated", [A]),
        ("automated human*5", [A, *[H] * 5]),
        ("  human * 2(automated) ", [H, H, A]),
        ("human*2 (automated human*2)*2", [H, H, A, H, H, A, H, H]),
        ("((automated human)*2 cacc)*2", [A, H, A, H, "cacc"] * 2),
        ("human (my_car2)*1", [H, "my_car2"]),
        ("automated*10000", [A] * 10_000),
        ("automated*0000025", [A] * 25),
        ("automated*00000100", [A] * 100),
    ]:
        with subtests.test(pattern=pattern):
            string = parse_string(pattern)
            assert string.roles == tuple(roles)
            assert not string.drawn
            assert not string.ring
            assert len(string) == len(roles)


def test_an_error_points_at_the_place(subtests) -> None:
    for pattern, words, place in [
        ("", "expected a role", 1),
        ("automated )", "expected a role, '(' or the end", 11),
        ("(automated", "this bracket is never closed", 1),
        ("human (automated (human)", "this bracket is never closed", 7),
        ("automated ()", "expected a role", 12),
        ("*3 human", "expected a role before '*'", 1),
        ("human leader", "the name leader is reserved, expected a role", 7),
        ("human*0", "expected a number that makes 1…10000 vehicles", 6),
        ("human*99999", "expected a number that makes 1…10000 vehicles", 6),
        ("automated human*-2", "expected a number behind '*'", 16),
        ("automated, human", "expected a role, '(' or the end", 10),
        ("automated*5000 human*5001", "more than 10000 vehicles", 16),
        ("human*2*3", "expected a role before '*'", 8),
        ("(" * 30 + "human" + ")" * 30, "too many brackets", 22),
    ]:
        with subtests.test(pattern=pattern):
            with pytest.raises(ConfigError) as error:
                parse_string(pattern)
            text = str(error.value)
            assert f"{words} at character {place}: " in text
            # The pattern itself, marked where it goes wrong.
            assert text.endswith(f"{pattern[: place - 1]}»{pattern[place - 1 :]}")
    assert {VEHICLES, LEADER, EPISODE, SELF, AHEAD, BEHIND, NEXT, ROLE, TERM} == RESERVED


def test_a_share_is_a_number() -> None:
    with pytest.raises(ConfigError, match=r"penetration must lie in \[0, 1\], got True"):
        parse_string({"size": 10, "penetration": True})


def test_penetration_is_rounded_to_whole_vehicles(subtests) -> None:
    for size, penetration, count in [
        (100, 0.1, 10),
        (10, 0.04, 1),  # at least one above 0
        (10, 1e-9, 1),
        (10, 0.0, 0),  # 0 is allowed: nobody is automated
        (10, 0.26, 3),
        (6, 0.34, 2),
        (10, 1, 10),
        (1, 0.5, 1),
    ]:
        with subtests.test(size=size):
            string = parse_string({"size": size, "penetration": penetration})
            assert string.count(A) == count
            assert string.count(H) == size - count
            # Where only one role is left there is nothing to draw.
            assert string.drawn == (0 < count < size)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.text(alphabet="ah()* 12", max_size=12))
def test_any_text_is_a_string_or_refused_in_one_way(text) -> None:
    message, string = "", None
    try:
        string = parse_string(text)
    except ConfigError as error:
        message = str(error)
    if string is None:
        assert "at character" in message
    else:
        assert set(string.roles) <= set(re.findall(r"[A-Za-z_]\w*", text))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 300), st.floats(0.0, 1.0))
def test_a_mixture_is_as_near_to_its_penetration_as_whole_vehicles_allow(size, share) -> None:
    count = parse_string({"size": size, "penetration": share}).count(A)
    assert abs(count - size * share) <= 0.5 or count == 1
    assert (count == 0) == (share == 0.0)
