"""Policies that are rules with learned constants, optionally with a network as correction.

They map the observation to the action, as a network does, so agents that learn through the
simulator can train and store them as any policy.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from lcc_rl.agents.actor import Activation, make_actor, seeded_mlp
from lcc_rl.agents.agent import Scene
from lcc_rl.errors import ConfigError, require, require_known, unknown_name
from lcc_rl.functional.layout import total
from lcc_rl.pieces.cruise import IDMACC, Cruise, LinearACC
from lcc_rl.pieces.observation import Observation
from lcc_rl.pieces.rules import Calm


class Rule(nn.Module):
    """A rule with learned logarithms of its constants, which remain positive.

    Args:
        kind: the controller with the law; its defaults are the initial constants.
        observation: the observation, with the entries that the rule reads.
        constants: other initial constants, by name.
        max_acceleration: acceleration of action 1 [m/s²].

    Raises:
        ConfigError: if a constant is unknown or not positive, or an entry is not observed.
    """

    scales: Tensor

    def __init__(
        self,
        kind: type[Cruise | Calm],
        observation: Observation,
        constants: Mapping[str, float] | None,
        max_acceleration: float,
    ) -> None:
        super().__init__()
        start, given = kind.constants_of_rule(), dict(constants or {})
        require_known("constant of the rule", given, start)
        values = {**start, **given}
        self.law, self.names = kind.law, tuple(values)
        self.logarithms = nn.Parameter(torch.tensor([math.log(x) for x in values.values()]))
        self.max_acceleration = max_acceleration
        self.columns = [observation.columns_of(*names) for names in kind.observed]
        scales = [observation.factors[columns].sum() for columns in self.columns]
        self.register_buffer("scales", torch.stack(scales), False)

    def constants(self) -> dict[str, float]:
        """Return the constants by name."""
        return dict(zip(self.names, self.logarithms.exp().tolist(), strict=True))

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action in [−1, 1], ``[*batch, 1]``, for the observation ``[*batch, n]``."""
        seen = (
            total(observation[..., columns], -1) / scale  # the mean, if there are several
            for columns, scale in zip(self.columns, self.scales, strict=True)
        )
        command = self.law(*seen, *self.logarithms.exp())
        return (command / self.max_acceleration).clamp(-1.0, 1.0)


class Residual(nn.Module):
    """A rule with fixed constants plus a network that is zero at the start.

    Args:
        network: maps an observation to a number.
        bound: largest action that the network adds.
    """

    def __init__(self, rule: Rule, network: nn.Module, bound: float = 1.0) -> None:
        super().__init__()
        self.rule = rule.requires_grad_(False)
        self.network, self.bound = network, bound
        last = [layer for layer in network.modules() if isinstance(layer, nn.Linear)][-1]
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, observation: Tensor) -> Tensor:
        """Return the action in [−1, 1], ``[*batch, 1]``."""
        correction = self.bound * torch.tanh(self.network(observation))
        return (self.rule(observation) + correction).clamp(-1.0, 1.0)


RULE_KINDS: dict[str, type[Cruise | Calm]] = {"idm": IDMACC, "acc": LinearACC, "calm": Calm}
NETWORK_ALONE = "network"
RESIDUAL = "residual_"


def make_policy(
    kind: str,
    scene: Scene,
    hidden: Sequence[int],
    constants: Mapping[str, float] | None,
    activation: Activation = "relu",
    bound: float = 1.0,
) -> TensorDictModule:
    """Build the policy of an agent.

    Args:
        kind: ``"network"``; a rule with learned constants, ``"idm"``, ``"acc"`` or ``"calm"``; or a
            rule with a network, such as ``"residual_idm"``.
        scene: where the agent learns; rules need its observation.
        hidden: sizes of the hidden layers of a network.
        constants: initial constants of a rule.
        activation: activation between the layers of a network.
        bound: largest action that a network adds to a rule.

    Returns:
        A module that reads ``"observation"`` ``[*batch, n]`` and writes ``"action"``
        ``[*batch, 1]``, on the device of the scene.

    Raises:
        ConfigError: if the kind is unknown, constants are given without a rule or a bound without
            a network on top of one, or the acceleration of action 1 is unknown for a rule.
    """
    size, seed = scene.observation_size, scene.seed
    idle = f"agent.bound={bound:g} has no effect: it is of agent.policy={RESIDUAL}…, not {kind}"
    require(bound == 1.0 or kind.startswith(RESIDUAL), idle)
    if kind == NETWORK_ALONE:
        require(not constants, "agent.constants belong to a rule: use agent.policy=idm or acc")
        return make_actor(size, 1, hidden, seed, activation).to(scene.device)
    name = kind.removeprefix(RESIDUAL)
    if name not in RULE_KINDS:
        known = (NETWORK_ALONE, *RULE_KINDS, *(RESIDUAL + rule for rule in RULE_KINDS))
        raise unknown_name("agent.policy", kind, known)
    if scene.max_acceleration is None:
        raise ConfigError(
            f"agent.policy={kind} needs the acceleration of action 1, but the controller of "
            "automated vehicles has no setting max_acceleration [m/s²]"
        )
    assert scene.observation is not None
    rule = Rule(RULE_KINDS[name], scene.observation, constants, scene.max_acceleration)
    module: nn.Module = rule
    if kind != name:
        module = Residual(rule, seeded_mlp(size, 1, hidden, seed, activation), bound)
    policy = TensorDictModule(module, in_keys=["observation"], out_keys=["action"])
    return policy.to(scene.device)
