"""A short run of the fuzzer, and that it notices what it is for."""

from __future__ import annotations

import time

import fuzz
import pytest
import torch

from lcc_rl.config import load
from lcc_rl.errors import ConfigError


def test_random_overrides_work_or_are_refused() -> None:
    counts, failures = fuzz.run(iter(range(10)), time.monotonic() + 300.0)
    text = "\n".join(f"{case.overrides}: {trail}" for case, trail in failures)
    assert not failures, f"python -m tests.fuzz --case {failures[0][0].seed}\n{text}"
    assert {end.partition(" ")[2] for end in counts} <= {"works", "refused"}
    assert counts["build works"] > 0
    assert counts["build refused"] > 0


def test_a_case_is_the_same_for_the_same_seed() -> None:
    assert [fuzz.make(seed) for seed in range(9)] == [fuzz.make(seed) for seed in range(9)]
    assert len({fuzz.make(seed).overrides for seed in range(9)}) == 9


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
    counts, [(case, trail)] = fuzz.run(iter([3]), time.monotonic() + 9)
    assert words in trail
    assert case == fuzz.make(3)
    assert sum(counts.values()) == 1


# What it found, one for each kind.
FOUND = (
    ("~drivers", "drivers is required: say drivers=…"),
    ("~threads", "threads is required: say threads=…"),
    ("~scenario.controllers.automated", "scenario.controllers names only human"),
    ("scenario.controllers.human='???'", "scenario.controllers.human is required: say"),
    ("+experiment@deployed=single_profile", "Could not override 'split@deployed.split'"),
    ("agent=null", "agent=null: Config group override must be a string or a list"),
    ("logger=[nan,1]", r"logger=\[nan,1\]: argument of type 'int'"),
    ("evaluation.baselines.x=1", r"evaluation\.baselines\.x=1: invalid literal"),
    (f"data.seed=1{'0' * 400}", r"data\.seed must be a number of 63 bits, got one of 1329"),
    ("reward.terms.safety.weight=${scenario.start}", "weight must be a valid number"),
    ("+scenario.controllers.human.time_gap=${scenario}", "Interpolation to parent node"),
)


@pytest.mark.parametrize(("override", "words"), FOUND)
def test_what_it_found_stays_mended(override, words) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        fuzz.build_study(("variant=alcc", *fuzz.SMALL, override))
    assert "\n" not in str(caught.value)


def test_a_number_where_a_controller_belongs() -> None:
    with pytest.raises(ConfigError, match=r"scenario\.controllers\.automated"):
        fuzz.build_study(("variant=ddpg", *fuzz.SMALL, "++scenario.controllers.automated=-0.0"))


def test_two_wrong_options_of_which_the_second_shows_without_the_first() -> None:
    wrong = ("knowledge@deployed=preview", "++evaluation.baselines.weight=0.5")
    with pytest.raises(ConfigError, match="unknown option 'knowledge'; valid: agent") as caught:
        fuzz.build_study(("variant=own_energy", *fuzz.SMALL, *wrong))
    assert "\n" not in str(caught.value)


def test_a_reference_in_a_circle_that_arises_when_the_policy_is_deployed() -> None:
    with pytest.raises(ConfigError, match="clamp must be a valid boolean"):
        fuzz.build_study(("variant=hcfs", *fuzz.SMALL, "deployed.clamp=${scenario}"))


def test_an_agent_whose_action_nobody_takes() -> None:
    words = r"scenario\.controllers\.automated \(handover\) takes no action .* agent=none"
    handover = "controller@scenario.controllers.automated=handover"
    with pytest.raises(ConfigError, match=words):
        fuzz.build_study(("variant=alcc", *fuzz.SMALL, handover))
    assert load("train", ["variant=alcc", handover]).agent is not None
