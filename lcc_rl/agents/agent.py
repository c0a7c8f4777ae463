"""What every agent is: settings that start a learner in a scene."""

from __future__ import annotations

import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import torch
from pydantic import Field

from lcc_rl.data.profiles import Profiles
from lcc_rl.pieces.observation import Observation
from lcc_rl.pieces.world import World
from lcc_rl.settings import Settings, values

Fraction = Annotated[float, Field(gt=0.0, le=1.0)]
Schedule = Literal["cosine", "linear"]  # how learning rates fall


@dataclass(frozen=True)
class Scene:
    """The scene in which an agent learns.

    Args:
        observation_size: entries of the observation of one automated vehicle.
        seed: seed of the initial weights and of what is drawn in an update.
        device: where the networks live.
        world: what the pieces of the environment share.
        observation: what the policy sees, for policies that are rules.
        max_acceleration: acceleration of action 1 [m/s²], for rules; None where the controller of
            automated vehicles has no such setting.
    """

    observation_size: int
    seed: int = 0
    device: str = "cpu"
    world: World = field(default_factory=World)
    observation: Observation | None = None
    max_acceleration: float | None = None


class Agent(Settings, ABC):
    """Settings of a learning algorithm; ``setup`` makes its ``policy``.

    ``policy`` reads ``"observation"`` and writes ``"action"``; ``loop`` trains it.
    """

    loop: ClassVar[Any]  # a class, see lcc_rl.agents.loop.TrainingLoop

    if TYPE_CHECKING:  # what setup makes

        def __getattr__(self, name: str) -> Any: ...

    def start(self, scene: Scene) -> Self:
        """Return the agent with fresh networks."""
        learner = type(self).__new__(type(self))
        learner.__dict__.update(values(self), seed=scene.seed, device=scene.device)
        learner.setup(scene)
        return learner

    @abstractmethod
    def setup(self, scene: Scene) -> None:
        """Make ``policy`` and what else a training needs."""

    def take(self, profiles: Profiles) -> None:
        """Take what depends on the records to learn behind: nothing, unless overridden."""

    def anneal(self, share: float) -> float:
        """Set the learning rates after this share of the training; return the policy's.

        Unless overridden they stay as they are.
        """
        rates = (x.param_groups[0]["lr"] for x in self._parts().values() if hasattr(x, "step"))
        return float(next(rates, 0.0))

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to resume bit for bit.

        Unless overridden that is the state of every attribute that has one, such as networks and
        optimizers; random numbers come from :func:`derived_seed` and need no state.
        """
        return {name: part.state_dict() for name, part in self._parts().items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        for name, part in self._parts().items():
            part.load_state_dict(state[name])

    def _parts(self) -> dict[str, Any]:
        return {name: part for name, part in vars(self).items() if hasattr(part, "state_dict")}


def derived_seed(*parts: object) -> int:
    """Return a seed that depends on all parts; distinct purposes get independent streams."""
    digest = hashlib.sha256("/".join(map(str, parts)).encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def anneal(
    optimizers: Iterable[torch.optim.Optimizer],
    share: float,
    final_lr_fraction: float,
    schedule: Schedule = "cosine",
) -> float:
    """Let learning rates fall from what they are made with to a share of it.

    Args:
        optimizers: whose rates to set.
        share: how much of the training is over.
        final_lr_fraction: of the rate at the start, at the end; 1 for a constant rate.
        schedule: along half a cosine, or a line.

    Returns:
        The first rate.
    """
    left = 1.0 - share if schedule == "linear" else 0.5 * (1.0 + math.cos(math.pi * share))
    factor = final_lr_fraction + (1.0 - final_lr_fraction) * left
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    for group in groups:
        group["lr"] = factor * group.setdefault("initial_lr", group["lr"])
    return float(groups[0]["lr"])
