"""Checks during a training that losses and weights are finite."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, SupportsFloat

import numpy as np
import torch
from tensordict.nn import TensorDictModule
from torch import Tensor

from lcc_rl.errors import Diverged, in_short, require
from lcc_rl.functional.finite import nonfinite_weight
from lcc_rl.results.runs import flatten


def check_state(policy: TensorDictModule, state: Mapping[str, Any]) -> None:
    """Check that the state of an agent contains the policy's weights."""
    kind = type(state).__name__
    require(isinstance(state, Mapping), f"an agent's state_dict returns {kind}, expected a dict")
    held = [value for _, value in flatten(state) if isinstance(value, Tensor)]
    for name, weight in policy.state_dict().items():
        same = any(x.shape == weight.shape and torch.equal(x, weight) for x in held)
        words = "an agent's state_dict lacks the policy's weight"
        require(same, f"{words} {name}; extend super().state_dict() and load_state_dict, too")


def check_restored(saved: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Check that an agent's load_state_dict restored all tensors of a state."""
    held = dict(flatten(now))
    for name, value in flatten(saved):
        same = not isinstance(value, Tensor) or torch.equal(value, held[name].to(value.device))
        require(same, f"an agent's load_state_dict does not restore {name}")


def check_learner(
    policy: TensorDictModule, values: Mapping[str, float | Tensor], advice: str
) -> None:
    """Check that the results of an update and the policy's weights are finite.

    Args:
        policy, values: the policy, and losses and other results by name.
        advice: the remedy in the message.

    Raises:
        Diverged: naming the first value that is not.
    """
    for name, value in values.items():
        words = "learn returns numbers by name, anneal the policy's learning rate"
        single = isinstance(value, (SupportsFloat, Tensor)) and np.size(value) == 1
        require(single, f"{name} is {in_short(value)}; {words}")
        if not math.isfinite(value):
            raise Diverged(f"{name} became {float(value)}", advice)
    found = nonfinite_weight(policy.state_dict())
    if found is not None:
        raise Diverged(f"the policy's weight {found} is not finite", advice)
