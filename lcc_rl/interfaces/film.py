"""Pictures of the road for Gymnasium's ``render_mode="rgb_array"``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from lcc_rl.envs.arrays import ArrayEpisodes
from lcc_rl.envs.step import pieces_of
from lcc_rl.errors import require
from lcc_rl.figures.animation import road_picture
from lcc_rl.functional.pattern import AUTOMATED
from lcc_rl.pieces import RolePlaces, StringMotion
from lcc_rl.pieces.features import CLASS
from lcc_rl.results.motion import SampleMotion


class Film:
    """Records the states of the present episode in one place of a batch."""

    def __init__(self, episodes: ArrayEpisodes, place: int) -> None:
        self.episodes, self.place = episodes, place
        pieces: dict[type, Any] = {type(piece): piece for piece in pieces_of(episodes.env)}
        self.motion = pieces[StringMotion]
        self.drawn = pieces[RolePlaces].string.drawn
        self.moments: list[tuple[Any, Any, Any]] = []

    def expose(self, begins: bool) -> None:
        """Record the present state; ``begins``: it is the first of an episode."""
        if begins:
            self.moments.clear()
        speed, gap = (self._look("vehicles", name) for name in ("speed", "gap"))
        ahead = speed[-1] if self.motion.string.ring else self._look("leader", "speed")[0]
        self.moments.append((speed, gap, ahead))

    def picture(self) -> Any:
        """Return a picture of the present state, ``[height, width, 3]``, uint8."""
        require(bool(self.moments), "call reset before render")
        speed, gap, ahead = map(np.asarray, zip(*self.moments, strict=True))
        string, length = self.motion.string, np.array(self.motion.vehicle_length)
        if CLASS in self.episodes.rows.keys:
            own = self.motion.fleet.lengths(torch.from_numpy(self._look(*CLASS)).long()).numpy()
            length = np.array([own[-1] if string.ring else length, *own])
        lengths = np.broadcast_to(length, len(string) + 1)
        time = np.arange(len(ahead)) * self.motion.time_step
        front, around = np.cumsum(ahead) * self.motion.time_step, None
        if string.ring:
            around = float(gap[0].sum() + lengths[1:].sum())
            front = np.cumsum(speed[:, 0]) * self.motion.time_step + gap[:, 0] + lengths[0]
        roles = string.roles
        if self.drawn:
            own = set(self._look(AUTOMATED, "index"))
            rest = iter(sorted(roles, key=AUTOMATED.__eq__))
            roles = tuple(AUTOMATED if i in own else next(rest) for i in range(len(string)))
        leader = None if string.ring else ahead
        return road_picture(SampleMotion(time, roles, speed, gap, front, leader, lengths, around))

    def _look(self, *key: str) -> Any:
        rows = self.episodes.rows
        index = rows.keys.index(key)
        first = sum(rows.sizes[:index])
        return self.episodes.state[self.place, first : first + rows.sizes[index]].copy()
