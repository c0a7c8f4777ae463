"""Termination: a collision ends the episode."""

from __future__ import annotations

from torch import Tensor

from lcc_rl.pieces.base import AfterStep
from lcc_rl.pieces.views import EPISODE


class Collision(AfterStep):
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
