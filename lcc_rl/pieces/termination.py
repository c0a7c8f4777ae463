"""Termination: a collision ends the episode."""

from __future__ import annotations

from torch import Tensor
from torchrl.envs import Transform

from lcc_rl.pieces.base import Feature
from lcc_rl.pieces.views import EPISODE


class Collision(Feature):
    """Ends an episode (``"terminated"`` and ``"done"``) when any gap of the string is zero or less.

    Without this piece episodes continue after a collision. Gaps may become negative; the evaluation
    counts them.
    """

    role = EPISODE
    reads = (("done",), ("terminated",), "vehicles.gap")
    writes = ("done", "terminated")

    def compute(self, done: Tensor, terminated: Tensor, gap: Tensor) -> tuple[Tensor, Tensor]:
        """Return done and terminated, ``[*batch, 1]``."""
        terminated = terminated | (gap <= 0.0).any(-2)
        return done | terminated, terminated

    _reset = Transform._reset
    transform_observation_spec = Transform.transform_observation_spec
