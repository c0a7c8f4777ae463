"""A short run of the fuzzer, and that it notices what it is for."""

from __future__ import annotations

import time

import fuzz
import pytest
import torch


def test_random_overrides_work_or_are_refused() -> None:
    counts, failures = fuzz.run(iter(range(10)), time.monotonic() + 300.0)
    text = "\n".join(f"{case.overrides}: {trail}" for case, trail in failures)
    assert not failures, f"python tests/fuzz.py --case {failures[0][0].seed}\n{text}"
    assert {end.partition(" ")[2] for end in counts} <= {"works", "refused"}
    assert counts["build works"] > 0
    assert counts["build refused"] > 0
    assert fuzz.make(8) == fuzz.make(8) != fuzz.make(9)


@pytest.mark.parametrize(
    ("does", "words"),
    [
        (lambda: {}["key"], "KeyError"),
        (lambda: time.sleep(5), "TooLong"),
        (lambda: torch.ones(3 << 30), "can't allocate memory"),
    ],
)
def test_other_errors_hangs_and_too_much_memory_are_failures(monkeypatch, does, words) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 1)
    monkeypatch.setattr(fuzz, "attempt", lambda case: does())
    _, [(case, trail)] = fuzz.run(iter([3]), time.monotonic() + 9)
    assert words in trail
    assert case == fuzz.make(3)
