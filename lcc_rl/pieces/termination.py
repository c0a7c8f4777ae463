"""Termination: a collision ends the episode."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from lcc_rl.pieces.base import Entry, Feature
from lcc_rl.pieces.views import EPISODE


class Collision(Feature):
    """Ends an episode (``"terminated"`` and ``"done"``) when any gap of the string is zero or less.

    Without this piece a collision ends nothing; gaps may turn negative and are counted in the
    evaluation.
    """

    role = EPISODE
    reads = (("done",), ("terminated",), "vehicles.gap")
    writes = (
        Entry("done", "–", "terminated or truncated", 1, torch.bool),
        Entry(
            "terminated", "–", "a collision ended the episode, where collisions do", 1, torch.bool
        ),
    )

    def compute(self, done: Tensor, terminated: Tensor, gap: Tensor) -> tuple[Tensor, Tensor]:
        """Return done and terminated, ``[*batch, 1]``."""
        terminated = terminated | (gap <= 0.0).any(-2)
        return done | terminated, terminated

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        return observation_spec

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset
