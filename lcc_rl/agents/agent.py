"""Base of agents: settings of a learning algorithm and its state."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, cast

import torch
from pydantic import Field

from lcc_rl.data.profiles import Profiles
from lcc_rl.pieces.observation import Observation
from lcc_rl.pieces.world import World
from lcc_rl.settings import Settings, values

Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
Schedule = Literal["cosine", "linear"]  # shape of the learning rates


@dataclass(frozen=True)
class Scene:
    """Context in which an agent learns.

    Args:
        observation_size: entries of the observation of one automated vehicle.
        seed: seed of the initial weights and of the random numbers of updates.
        device: device of the networks.
        world: properties that the pieces of the environment share.
        observation: the observation, for policies that are rules.
        max_acceleration: acceleration of action 1 [m/s²], for rules; None if the controller of
            automated vehicles has no such setting.
    """

    observation_size: int
    seed: int = 0
    device: str = "cpu"
    world: World = field(default_factory=World)
    observation: Observation | None = None
    max_acceleration: float | None = None


class Agent(Settings, ABC):
    """Settings of a learning algorithm; ``setup`` builds its ``policy``.

    ``policy`` reads ``"observation"`` and writes ``"action"``; ``loop`` trains it.
    :class:`lcc_rl.agents.CollectingLoop` also reads ``noise`` and the attributes with a default.
    """

    loop: ClassVar[Any]  # a class, see lcc_rl.agents.loop.TrainingLoop
    every, burn_in = 1, 0  # steps of an action; first steps of an episode, with human drivers
    rule = objective = returns = cast(Any, None)  # below the policy; of limits; scale of rewards

    if TYPE_CHECKING:  # set by setup

        def __getattr__(self, name: str) -> Any: ...

    def start(self, scene: Scene) -> Self:
        """Return the agent with fresh networks."""
        learner = type(self).__new__(type(self))
        learner.__dict__.update(values(self), seed=scene.seed, device=scene.device)
        learner.setup(scene)
        return learner

    @abstractmethod
    def setup(self, scene: Scene) -> None:
        """Build ``policy`` and everything else that a training needs."""

    def take(self, profiles: Profiles) -> None:
        """Read the training records, if overridden; by default nothing depends on them."""

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's.

        By default they are constant.
        """
        rates = (x.param_groups[0]["lr"] for x in self._parts().values() if hasattr(x, "step"))
        return float(next(rates, 0.0))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to resume bit for bit.

        By default this is the state of every attribute that has one, such as networks and
        optimizers. Random numbers are derived by :func:`derived_seed` and need no state.
        """
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        return {name: part for name, part in vars(self).items() if hasattr(part, "state_dict")}


def derived_seed(*parts: object) -> int:
    """Return a seed that depends on all parts; different parts give independent streams."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def anneal(
    optimizers: Iterable[torch.optim.Optimizer],
    share: float,
    final_lr_fraction: float,
    schedule: Schedule = "cosine",
) -> float:
    """Set learning rates that fall from their initial value to a fraction of it.

    Args:
        optimizers: whose rates are set.
        share: share of the training that is over.
        final_lr_fraction: final rate as a fraction of the initial one; 1: constant.
        schedule: half a cosine, or a line.

    Returns:
        The first rate.
    """
    left = 1.0 - share if schedule == "linear" else 0.5 * (1.0 + math.cos(math.pi * share))
    factor = final_lr_fraction + (1.0 - final_lr_fraction) * left
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    for group in groups:
        group["lr"] = factor * group.setdefault("initial_lr", group["lr"])
    return float(groups[0]["lr"])
