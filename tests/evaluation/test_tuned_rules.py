"""Tuned cruise controls: as controllers, and as baselines with and without the safety filter."""

from __future__ import annotations

import pytest
import torch
from helpers import compose

from lcc_rl.agents.rules import ACCRule, IDMRule
from lcc_rl.errors import ConfigError
from lcc_rl.evaluation.strategies import TUNED, baseline
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.functional.rules import idm_acc, linear_acc
from lcc_rl.pieces import IDMACC, LinearACC


@pytest.mark.parametrize("name", TUNED)
def test_a_tuned_baseline_keeps_the_filter_and_has_constants_for_it(name) -> None:
    free, filtered = (
        baseline(compose("alcc", *words), name).cfg.scenario for words in ((), ("+filter=cbf",))
    )
    assert free.filters.get(AUTOMATED) is None
    assert filtered.filters[AUTOMATED].time_gap == 2.45
    own = [dict(scenario.controllers[AUTOMATED]) for scenario in (free, filtered)]
    assert own[0].keys() == own[1].keys()
    assert own[0]["time_gap"] != own[1]["time_gap"]
    # A human driver has no filter, whoever else does.
    human = baseline(compose("alcc", "+filter=cbf"), "idm").cfg.scenario
    assert human.filters.get(AUTOMATED) is None


@pytest.mark.parametrize("name", TUNED.values())
def test_constants_tuned_behind_the_filter_are_driven_behind_it(name) -> None:
    scenario = baseline(compose("alcc", "+filter=cbf"), f"{name}_filtered").cfg.scenario
    assert scenario.filters[AUTOMATED].time_gap == 2.45
    with pytest.raises(ConfigError, match=f"{name}_filtered drives behind the safety filter"):
        baseline(compose("alcc"), f"{name}_filtered")


@pytest.mark.parametrize(
    ("piece", "rule", "law"), [(IDMACC, IDMRule, idm_acc), (LinearACC, ACCRule, linear_acc)]
)
def test_a_controller_commands_what_the_rule_of_an_agent_does(piece, rule, law) -> None:
    generator = torch.Generator().manual_seed(0)
    speed, gap = (20.0 * torch.rand(64, 1, 1, generator=generator) for _ in range(2))
    relative_speed = torch.randn(64, 1, 1, generator=generator)
    command = piece(**rule.START).command(speed, gap, relative_speed)
    constants = rule.START.values()
    assert torch.equal(command, law(speed, gap, relative_speed, *constants).clamp(-3.0, 3.0))
    assert command.min() == -3.0
