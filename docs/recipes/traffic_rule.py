"""A rule that drives at the speed of the traffic further ahead, rival of a network that knows it.

export PYTHONPATH=docs/recipes
lcc-rl evaluate task=i24-fleet leader=i24 leader.path=i24_leaders.parquet leader.fastest=null \
    evaluation.warm_up=0 'knowledge=[memory,traffic]' trust=[traffic_rule] \
    'compare={ahead_filtered: {_target_: traffic_rule.Ahead, time_gap: 2.0}}'
"""

import torch

from lcc_rl.pieces import Controller
from lcc_rl.settings import NonNegative, Positive, Share


class Ahead(Controller):
    """Follows half the mean of the speeds far ahead and half the speed of the next vehicle."""

    near: Share = 0.5  # weight of the speed of the next vehicle
    gain: Positive = 0.01  # of the distance from the gap that the time gap asks for [1/s]
    time_gap: Positive = 1.5  # [s]
    standstill_gap: NonNegative = 2.0  # [m]
    braking: Positive = 1.5  # deceleration behind a slower vehicle [m/s²]
    response: Positive = 1.0  # [s]

    reads = ("self.speed", "self.gap", "self.relative_speed", "traffic.speed")

    def command(self, speed, gap, relative, traffic):
        flow = self.near * (speed + relative) + (1.0 - self.near) * traffic.mean(-1, keepdim=True)
        free = gap - self.standstill_gap
        wanted = flow + self.gain * (free - self.time_gap * speed)
        safe = free - relative.clamp(max=0.0).square() / (2.0 * self.braking)
        # The safety filter keeps time gaps of at least 1.05 s.
        return (torch.minimum(wanted, safe / 1.05).clamp(min=0.0) - speed) / self.response
