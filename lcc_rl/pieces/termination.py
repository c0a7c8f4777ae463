"""Termination: a collision ends the episode."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from lcc_rl.errors import ConfigError
from lcc_rl.pieces.base import Feature


class Collision(Feature):
    """Ends an episode (``"terminated"`` and ``"done"``) when a gap is zero or less.

    Args:
        vehicles: namespaces of the vehicles whose gap to the one ahead counts.
        followers: those among them that are strings of followers, ``[*batch, followers, 1]``.

    Raises:
        ConfigError: if there is no vehicle, or ``followers`` names one not among them.
    """

    def __init__(self, vehicles: Sequence[str] = ("cav",), followers: Sequence[str] = ()) -> None:
        if not vehicles or not set(followers) <= set(vehicles):
            raise ConfigError(
                f"collision: vehicles {list(vehicles)} must be given and include "
                f"followers {list(followers)}"
            )
        super().__init__(
            ["done", "terminated", *((vehicle, "gap") for vehicle in vehicles)],
            ["done", "terminated"],
        )
        self.strings = [vehicle in followers for vehicle in vehicles]

    def compute(self, done: Tensor, terminated: Tensor, *gaps: Tensor) -> tuple[Tensor, Tensor]:
        """Return done and terminated."""
        for gap, string in zip(gaps, self.strings, strict=True):
            crashed = gap <= 0.0
            terminated = terminated | (crashed.any(-2) if string else crashed)
        return done | terminated, terminated

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return observation_spec

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset
