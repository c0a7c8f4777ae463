"""The ALCC study as a Gymnasium environment in plain Python, one car and one driver."""

from __future__ import annotations

import math
from bisect import bisect_left
from typing import Any

import gymnasium
import numpy as np
from torchrl.envs import TransformedEnv

from benchmarks.plain import PlainLoop
from benchmarks.plain_scalars import bits, power
from lcc_rl.functional.estimation import REFERENCE_SPEED
from lcc_rl.functional.idm import IDMConstants
from lcc_rl.functional.random import STEP as STRIDE
from lcc_rl.functional.random import STREAM
from lcc_rl.pieces.rewards import TOUCH

Numbers = tuple[float, ...]


class PlainEnv(gymnasium.Env[Any, Any]):
    """The ALCC study of one automated vehicle and one driver in Python's own numbers.

    Args:
        env: the environment whose settings and data it shares.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, env: TransformedEnv) -> None:
        plain = self.plain = PlainLoop(env)
        self.observation_space = gymnasium.spaces.Box(-1e6, 1e6, (7,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        leader, human, starts = plain.leader, plain.human, plain.motion.starts
        self.record, self.offsets = leader.speeds.tolist(), leader.offsets.tolist()
        self.firsts = leader.starts.tolist()
        described = (human.desired_speeds.tolist(), human.time_gaps.tolist())
        self.drawn = list(zip(*described, strict=True))
        self.starts = (starts["automated"], starts["human"].cap_time_gap)
        self.drivers: IDMConstants = human.drivers
        self.root = 2.0 * math.sqrt(self.drivers.acceleration * self.drivers.deceleration)
        mean = plain.estimator.mean
        self.thresholds, self.sums = mean.thresholds.tolist(), mean.sums.tolist()
        self.inverse_power, self.dt = mean.inverse_power, plain.motion.time_step
        self.noise, self.stream = human.noise, human.noise_stream * STREAM
        self.scales = plain.scales.numpy()
        self.error = plain.estimator.measurement_error**2
        self.learning = plain.estimator.learning_steps
        self.prior = (
            *plain.estimator.prior_estimate.tolist(),
            *plain.estimator.prior_covariance.tolist(),
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        super().reset(seed=seed)
        return self.begin(int(self.np_random.integers(2**31))), {}

    def begin(self, seed: int) -> Any:
        """Begin the episode of a seed; return what is seen."""
        leader, drivers, (own, cap) = self.plain.leader, self.drivers, self.starts
        profile = bits(seed + leader.profile_stream * STREAM) * len(self.offsets) >> 32
        first = bits(seed + leader.start_stream * STREAM) * self.firsts[profile] >> 32
        driver = bits(seed + self.plain.human.driver_stream * STREAM) * len(self.drawn) >> 32
        self.v0, self.headway = self.drawn[driver]
        self.place = self.offsets[profile] + first
        speed = self.record[self.place]
        draw = (bits(seed + own.stream * STREAM) >> 8) * 2.0**-24
        gap = own.standstill_gap + own.time_gap * speed
        gap *= own.lowest + (own.highest - own.lowest) * draw
        free = max(1.0 - (speed / self.v0) ** 4, 1e-6)
        behind = (drivers.min_gap + speed * self.headway) / math.sqrt(free)
        behind = min(behind, 2.0 * drivers.min_gap + cap * speed)
        self.motion, self.belief = (speed, speed, gap, speed, behind), self.prior
        self.seed, self.count = seed, 0
        return self.observe()

    def observe(self) -> Any:
        """Return what the automated vehicle sees."""
        leader, cav, gap, speed, behind = self.motion
        seen = (leader, cav, leader - cav, gap, speed, cav - speed, behind)
        return np.array(seen, np.float32) * self.scales

    def step(self, action: Any) -> Any:
        """Take a step."""
        (leader, cav, gap, speed, behind), dt = self.motion, self.dt
        wish = min(max(float(action[0]), -1.0), 1.0) * self.plain.max_acceleration
        cav_reached = max(cav + wish * dt, 0.0)
        draw = (bits(self.seed + self.count * STRIDE + self.stream) >> 8) * 2.0**-24
        free = (speed / self.v0) ** 4
        wish = self.idm(speed, behind, speed - cav, free, self.headway)[0]
        reached = max(speed + wish * (1.0 + self.noise * draw) * dt, 0.0)
        predicted = self.believe(speed, behind, speed - cav, reached)
        self.count += 1
        ahead = self.record[self.place + self.count]
        gap += 0.5 * dt * ((leader - cav) + (ahead - cav_reached))
        behind += 0.5 * dt * ((cav - speed) + (cav_reached - reached))
        reward = self.reward(ahead, cav_reached, gap, behind)
        reward -= self.plain.cav_price * power(cav, (cav_reached - cav) / dt)
        reward -= self.plain.hdv_price * power(speed, predicted)
        self.motion = (ahead, cav_reached, gap, reached, behind)
        ends = (gap <= 0.0 or behind <= 0.0, self.count >= self.plain.horizon)
        return self.observe(), reward, *ends, {}

    def reward(self, ahead: float, cav: float, gap: float, behind: float) -> float:
        """Return the reward but for energies; it depends on the motion reached alone."""
        safety, efficiency, plain = self.plain.safety, self.plain.efficiency, self.plain
        room, ttc = max(gap - safety.margin, TOUCH) if gap > 0.0 else gap, safety.threshold
        if room <= 0.0:
            ttc = safety.floor
        elif cav > ahead:
            ttc = min(max(room / (cav - ahead), safety.floor), safety.threshold)
        late = gap / max(cav, 1.0) >= efficiency.threshold
        reward: float = safety.weight * math.log(ttc / safety.threshold)
        hit = gap <= 0.0 or behind <= 0.0
        return reward - efficiency.weight * late - plain.penalty * hit

    def idm(self, speed: float, gap: float, rate: float, free: float, time_gap: float) -> Numbers:
        """Return the acceleration, s*/s, 1/s, and whether the time gap matters."""
        known = self.drivers
        inverse = 1.0 / max(gap, known.gap_floor)
        dynamic = speed * (time_gap + rate / self.root)
        ratio = (known.min_gap + max(dynamic, 0.0)) * inverse
        return self.limited(1.0 - free - ratio * ratio), ratio, inverse, dynamic > 0.0

    def limited(self, share: float) -> float:
        """Return a share of the largest acceleration within the physical limits."""
        known = self.drivers
        wish = known.acceleration * share
        return min(max(wish, -known.braking_limit), known.acceleration_limit)

    def mean(self, speed: float, gap: float, rate: float) -> float:
        """Return the mean acceleration of the calibrated drivers."""
        shift, s0 = rate / self.root, self.drivers.min_gap
        share, first, second = self.sums[bisect_left(self.thresholds, -shift)]
        linear = first + shift * share
        squared = second + shift * (2.0 * first + shift * share)
        wished = s0 * s0 + speed * (2.0 * s0 * linear + speed * squared)
        inverse = 1.0 / max(gap, self.drivers.gap_floor)
        return self.limited(1.0 - speed**4 * self.inverse_power - wished * inverse * inverse)

    def believe(self, speed: float, gap: float, rate: float, reached: float) -> float:
        """Learn from a step of the driver; return the acceleration predicted before."""
        q, t, qq, qt, tt = self.belief
        free, a = (speed / REFERENCE_SPEED) ** 4, self.drivers.acceleration
        predicted, ratio, inverse, matters = self.idm(speed, gap, rate, free * q, t)
        measured = (reached - speed) / self.dt
        if reached > 0.0 and abs(measured) < self.drivers.acceleration_limit:
            by_q, by_t = -a * free, -2.0 * a * ratio * speed * inverse * matters
            to_q, to_t = qq * by_q + qt * by_t, qt * by_q + tt * by_t
            bend = a * (speed * inverse) ** 2 * tt
            weight = 1.0 / (by_q * to_q + by_t * to_t + 2.0 * bend * bend + self.error)
            surprise = (measured - predicted + bend) * weight
            qq, qt, tt = (
                qq - to_q * to_q * weight,
                qt - to_q * to_t * weight,
                tt - to_t * to_t * weight,
            )
            q, t = q + to_q * surprise, t + to_t * surprise
            bounded = max(q, 0.0)
            t = min(max(t + qt / qq * (bounded - q), 0.05), 10.0)
            self.belief = (bounded, t, qq, qt, tt)
        return self.mean(speed, gap, rate) if self.count < self.learning else predicted
