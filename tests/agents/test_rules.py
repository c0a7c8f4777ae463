"""Rules whose constants are learned, and networks on top of them."""

from __future__ import annotations

import pytest
import torch
from commands import tiny
from helpers import compose, make_agent

from lcc_rl.agents.agent import Scene
from lcc_rl.agents.rules import make_policy
from lcc_rl.commands import evaluation, training
from lcc_rl.config.nodes import Node
from lcc_rl.errors import ConfigError
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.pieces import Hybrid, Observation
from lcc_rl.pieces.controllers import Controller
from lcc_rl.pieces.cruise import LinearACC

SCALES = {"ahead": {"speed": 0.1}, "self": {"speed": 0.1, "relative_speed": 0.5, "gap": 0.1}}


def seen(speed: float, gap: float, relative: float) -> torch.Tensor:
    return torch.tensor([[[0.1 * (speed + relative), 0.1 * speed, 0.5 * relative, 0.1 * gap]]])


def policy(kind: str, observation: Observation | None = None, constants=None, limit=3.0):
    observation = observation or Observation(scales=SCALES).bind()
    size = observation.event_shape[-1]
    scene = Scene(size, observation=observation, max_acceleration=limit)
    return make_policy(kind, scene, (8, 8), constants).module


@pytest.mark.parametrize("state", [(8.0, 15.0, 0.5), (0.0, 2.5, 1.0), (12.0, 18.0, -2.0)])
def test_the_rules_are_those_of_the_equations(state) -> None:
    speed, gap, relative = (torch.tensor(x) for x in state)
    idm = IDMConstants(1.2, 1.7, 1.5)(speed, gap, -relative, 20.0, 1.1)
    constants = {"desired_speed": 20.0, "time_gap": 1.1, "acceleration": 1.2}
    constants |= {"deceleration": 1.7, "min_gap": 1.5}
    action = policy("idm", constants=constants, limit=4.0)(seen(*state))
    assert action.item() == pytest.approx(float(idm) / 4.0, rel=1e-4)
    acc = LinearACC.law(speed, gap, relative, 25.0, 1.5, 2.0, 0.1, 0.5)
    assert policy("acc")(seen(*state)).item() == pytest.approx(float(acc) / 3.0, rel=1e-4)


def test_calm_reads_the_mean_of_its_speed_from_a_memory() -> None:
    sources = ["self.speed", "ahead.speed"]
    scales = {**SCALES, "memory": {"entries": 0.5}}
    words = {"widths": {"memory": 4}}
    kept = Observation(scales=scales, relative_to={"memory": sources}, **words).bind()
    state, lags = seen(4.0, 14.0, -0.3), torch.tensor([0.5 * 0.4, 0.5 * 0.8, 9.0, 9.0])
    # The mean of both is 0.6 m/s above the speed, 2 m above 12 m add 0.04 m/s, in 1 s.
    constants = {"gain": 0.02, "gap": 12.0, "time_gap": 1.2, "response": 1.0}
    rule = policy("calm", kept, constants=constants)
    action = rule(torch.cat([state, lags.expand(1, 1, 4)], -1))
    assert action.item() == pytest.approx(0.64 / 3.0)
    with pytest.raises(ConfigError, match=r"needs memory\.entries relative to self\.speed"):
        policy("residual_calm")


class Scaled(Controller):
    """An own controller of a policy's actions, whose scale has a name of its own."""

    scale: float = 1.0
    reads = ("automated.action",)

    def command(self, action: torch.Tensor) -> torch.Tensor:
        return action * self.scale


class Learned(Hybrid):
    """A hybrid that always takes the policy's action."""

    def choose(self, rule: torch.Tensor, learned: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(learned, dtype=torch.bool)


def test_a_rule_in_a_hybrid_has_the_scale_of_its_actions_not_its_limit() -> None:
    cfg = tiny("train", "variant=alcc", "agent=analytic", "agent.policy=idm", agent=False)
    own = {"_target_": f"{__name__}.Learned", "rule": {"_target_": "lcc_rl.pieces.IDMACC"}}
    for more, scale in (({"max_acceleration": 1.0}, 3.0), ({"action_scale": 2.0}, 2.0)):
        node = Node.of({**own, **more}, "automated")
        agent = make_agent(cfg.with_(scenario={"controllers": {"automated": node}}))
        assert agent.policy.module.max_acceleration == scale


def test_a_rule_of_unknown_scale_and_a_bound_of_no_residual_are_refused() -> None:
    cfg = tiny("train", "variant=alcc", "agent=analytic", "agent.policy=idm", agent=False)
    node = Node.of({"_target_": f"{__name__}.Scaled", "scale": 2.0}, "automated")
    cfg = cfg.with_(scenario={"controllers": {"automated": node}})
    with pytest.raises(ConfigError, match="needs the acceleration of action 1"):
        make_agent(cfg)
    bounded = tiny("train", "variant=alcc", "agent=analytic", "agent.bound=0.5", agent=False)
    with pytest.raises(ConfigError, match=r"agent\.bound=0\.5 has no effect: .* not network"):
        make_agent(bounded)


def test_a_residual_begins_at_the_rule_and_leaves_it_alone(subtests) -> None:
    for kind in ["idm", "acc"]:
        with subtests.test(kind=kind):
            rule, residual = policy(kind), policy(f"residual_{kind}")
            state = seen(8.0, 15.0, 0.5)
            assert torch.equal(residual(state), rule(state))
            residual(state).sum().backward()
            graded = {name for name, entry in residual.named_parameters() if entry.grad is not None}
            assert graded
            assert all(name.startswith("network.") for name in graded)


def test_the_agent_learns_the_constants_alone() -> None:
    agent = make_agent(compose("alcc", "agent=analytic", "agent.policy=idm"))
    assert [tuple(entry.shape) for entry in agent.policy.parameters()] == [(5,)]


@pytest.mark.slow
def test_a_rule_is_trained_stored_and_evaluated_like_a_network(tmp_path) -> None:
    words = ("agent=analytic", "agent.policy=residual_idm", "surrogates@agent=limits")
    small = ("agent.hidden=[8]", "training.segment=20", "training.environments=4")
    folder = tmp_path / "run"
    cfg = tiny("train", *words, *small, "training.episodes=8", agent=False)
    training.run(cfg, folder, quiet=True)
    cfg = tiny("evaluate", f"policy={folder}", "+filter=cbf", agent=False)
    rows = evaluation.run(cfg, tmp_path / "evaluated", quiet=True)
    assert set(rows["strategy"]) >= {"idm", "alcc"}
    assert rows.loc[rows["strategy"] == "alcc", "total_path_energy_kj"].notna().all()
