"""The ALCC study and its plain loop: the physics as one function of tensors."""

from __future__ import annotations

from argparse import Namespace
from functools import cache
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from benchmarks.harness import agree, stream
from lcc_rl.config import load
from lcc_rl.config.schemas import StudyConfig
from lcc_rl.envs import Inputs, build_env, load_inputs
from lcc_rl.functional.estimation import Belief, predict_and_update
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.random import choose, uniform
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.pieces.base import ACTION, SEED, STEP
from lcc_rl.pieces.rewards import TOUCH

State = dict[str, Tensor]
Played = tuple[State, State, Tensor]  # the next state, what was written, the next observation


@cache
def study(quick: bool) -> tuple[StudyConfig, Inputs]:
    """Configuration and inputs of the ALCC study on the synthetic stream."""
    cfg = load("train", ["variant=alcc", "experiment=paper_windows"])
    return cfg, load_inputs(cfg, stream(quick).load().episodes)


def training(options: Namespace, batch: int) -> TransformedEnv:
    """Build the ALCC environment of a training: gaps spread at the start, episodes that end."""
    cfg, inputs = study(options.quick)
    return build_env(cfg, inputs.training, inputs.population, batch)


def alcc(options: Namespace, batch: int, far: bool = False, followers: int = 1) -> TransformedEnv:
    """Build the ALCC environment; from ``far`` behind the leader no episode ends by a collision."""
    cfg, inputs = study(options.quick)
    start = {"standstill_gap": 500.0, "time_gap": 30.0} if far else {}
    own = cfg.scenario.start["automated"].changed(**start, gap_range=[1.0, 1.0])
    string = f"automated human*{followers}"
    cfg = cfg.with_(scenario={"start": {"automated": own}, "string": string})
    return build_env(cfg, inputs.training, inputs.population, batch)


class PlainLoop:
    """The physics of the environment as one function of tensors, without TorchRL.

    Args:
        env: an ALCC environment, one automated vehicle ahead of human drivers, whose settings and
            data it shares.
    """

    def __init__(self, env: TransformedEnv) -> None:
        pieces = {type(piece).__name__: piece for piece in env.transform}
        terms = {piece.name: piece for piece in env.transform if hasattr(piece, "weight")}
        self.leader, self.motion = pieces["NGSIMLeader"], pieces["StringMotion"]
        self.max_acceleration = pieces["Action"].max_acceleration
        self.human, self.estimator = pieces["IDM"], pieces["DriverEstimator"]
        self.scales, self.penalty = pieces["Observation"].factors, terms["collision"].weight
        self.safety, self.efficiency = terms["safety"], terms["efficiency"]
        self.horizon, self.rows = env.base_env.horizon, env.batch_size.numel()
        energies = (terms["cav_energy"], terms["hdv_energy"])
        self.cav_price, self.hdv_price = (term.weight * term.factor for term in energies)

    def start(self, td: TensorDictBase) -> State:
        """Begin where a reset of the environment begins.

        Entries are ``[batch, 1]``, of the human drivers ``[batch, n, width]``.
        """
        speed, gap = td["vehicles", "speed"], td["vehicles", "gap"]
        keys = ("estimate", "covariance", "desired_speed", "desired_time_gap")
        return {
            "seed": td[SEED],
            "step": td[STEP],
            "place": self.leader.offsets[td["leader", "profile"]] + td["leader", "start"],
            "leader": td["leader", "speed"],
            "cav": speed[:, 0],
            "cav_gap": gap[:, 0],
            "speed": speed[:, 1:],
            "gap": gap[:, 1:],
            **{key: td["human", key] for key in keys},
        }

    def step(self, now: State, action: Tensor) -> tuple[State, State]:
        """Return the next state and what the environment writes beside it."""
        dt, drivers = self.motion.time_step, self.human.drivers
        leader = self.leader.speeds[now["place"] + now["step"] + 1]
        cav, cav_acceleration = advance_speed(now["cav"], action * self.max_acceleration, dt)
        cav_gap = advance_gap(now["cav_gap"], now["leader"], now["cav"], leader, cav, dt)
        ahead = following(now["cav"], now["speed"])
        motion = (now["speed"], now["gap"], now["speed"] - ahead)
        wish = drivers(*motion, now["desired_speed"], now["desired_time_gap"])
        draws = uniform(
            now["seed"][:, None], now["step"][:, None], self.human.noise_stream + self.human.index
        )
        noise = self.human.noise * draws
        speed, acceleration = advance_speed(now["speed"], wish * (1.0 + noise), dt)
        gap = advance_gap(now["gap"], ahead, now["speed"], following(cav, speed), speed, dt)
        belief = Belief(now["estimate"], now["covariance"])
        error = self.estimator.measurement_error
        predicted, belief = predict_and_update(*motion, speed, belief, drivers, dt, error)
        early = now["step"][:, None] < self.estimator.learning_steps
        predicted = torch.where(early, self.estimator.mean(*motion), predicted)
        threshold = self.safety.threshold
        room = (cav_gap - self.safety.margin).clamp(min=TOUCH)
        ttc = time_to_collision(torch.where(cav_gap > 0.0, room, cav_gap), cav - leader)
        late = time_gap(cav_gap, cav) >= self.efficiency.threshold
        reward = (
            self.safety.weight * (ttc.clamp(self.safety.floor, threshold) / threshold).log()
            - self.efficiency.weight * late.float()
            - self.cav_price * motor_power(now["cav"], cav_acceleration)
            - self.hdv_price * motor_power(now["speed"], predicted).sum(-2)
            - self.penalty * ((cav_gap <= 0.0) | (gap <= 0.0).any(-2)).float()
        )
        written = {"reward": reward, "hdv_power": motor_power(now["speed"], acceleration)}
        reached = {"leader": leader, "cav": cav, "cav_gap": cav_gap, "speed": speed, "gap": gap}
        learned = {"estimate": belief.estimate, "covariance": belief.covariance}
        after = {**now, "step": now["step"] + 1, **reached, **learned}
        return after, {**written, "observation": self.observe(after)}

    def observe(self, now: State) -> Tensor:
        """Return what the automated vehicle sees."""
        leader, cav, speed, gap = now["leader"], now["cav"], now["speed"][:, 0], now["gap"][:, 0]
        seen = [leader, cav, leader - cav, now["cav_gap"], speed, cav - speed, gap]
        return torch.cat(seen, dim=-1) * self.scales

    def over(self, now: State) -> tuple[Tensor, Tensor]:
        """Return where an episode ends by a collision, and where it ends at all."""
        crashed = (now["cav_gap"] <= 0.0) | (now["gap"] <= 0.0).any(-2)
        return crashed, crashed | (now["step"] >= self.horizon)

    def begin(self, seed: Tensor) -> State:
        """Return the first moment of the episodes of some seeds, ``[n, 1]``."""
        leader, human, believed = self.leader, self.human, self.estimator
        starts = self.motion.starts
        profile = choose(seed, len(leader.offsets), leader.profile_stream)
        first = choose(seed, leader.starts[profile], leader.start_stream)
        place = leader.offsets[profile] + first
        speed = leader.speeds[place]
        stream = human.driver_stream + human.index
        driver = choose(seed[:, None], len(human.desired_speeds), stream)
        v0, headway = human.desired_speeds[driver], human.time_gaps[driver]
        cap, humans = starts["human"].cap_time_gap, speed[:, None].expand_as(v0)
        own = starts["automated"]
        factor = own.lowest + (own.highest - own.lowest) * uniform(seed, 0, own.stream)
        return {
            "seed": seed,
            "step": torch.zeros_like(seed),
            "place": place,
            "leader": speed,
            "cav": speed,
            "cav_gap": factor * (own.standstill_gap + own.time_gap * speed),
            "speed": humans,
            "gap": human.drivers.equilibrium_gap(humans, v0, headway, cap),
            "estimate": believed.prior_estimate.expand(*v0.shape[:2], 2),
            "covariance": believed.prior_covariance.expand(*v0.shape[:2], 3),
            "desired_speed": v0,
            "desired_time_gap": headway,
        }

    def play(self, now: State, action: Tensor, seeds: Any) -> Played:
        """Take a step, replace episodes that end; return state, what was written, observation.

        Made for the compiler: every episode is begun anew, and that taken where one is over.
        """
        after, written = self.step(now, action)
        crashed, over = self.over(after)
        new = self.begin(seeds)
        after = {name: chosen(over, new[name], value) for name, value in after.items()}
        written |= {"terminated": crashed, "done": over}
        return after, written, chosen(over, self.observe(new), written["observation"])

    def play_eagerly(self, now: State, action: Tensor, seeds: Any) -> Played:
        """The same without a compiler: only episodes that are over are begun anew."""
        after, written = self.step(now, action)
        crashed, over = self.over(after)
        written |= {"terminated": crashed, "done": over}
        seen, rows = written["observation"], over.flatten().nonzero().flatten()
        if len(rows):
            new = self.begin(seeds[rows])
            seen = seen.index_put((rows,), self.observe(new))
            after = {name: value.index_put((rows,), new[name]) for name, value in after.items()}
        return after, written, seen

    def seeds(self) -> Tensor:
        """Draw the seeds of new episodes."""
        return torch.randint(2**31, (self.rows, 1))


def following(first: Tensor, others: Tensor) -> Tensor:
    """Return what is ahead of each of some vehicles, ``[batch, n, 1]``."""
    alone = others.shape[1] == 1
    return first[:, None] if alone else torch.cat([first[:, None], others[:, :-1]], -2)


def chosen(over: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Return new values where an episode is over, ``[batch, 1]``."""
    return torch.where(over.view(-1, *(1 for _ in new.shape[1:])), new, old)


def check_physics(options: Namespace, steps: int) -> None:
    """Check the plain loop against the environment, in which episodes go on after a collision."""
    _check_steps(alcc(options, 64), steps)
    _check_steps(alcc(options, 64, far=True, followers=3), steps)
    check_resets(options)


def _check_steps(env: TransformedEnv, steps: int) -> None:
    plain, generator, td = PlainLoop(env), torch.Generator().manual_seed(0), env.reset()
    state = plain.start(td)
    for step in range(steps):
        action = torch.rand(64, 1, generator=generator) * 2.0 - 1.0
        td = env.step(td.set(ACTION, action.unsqueeze(-2)))
        state, written = plain.step(state, action)
        for name in ("observation", "reward"):
            own = td["next", "automated", name].squeeze(-2)
            agree(f"step {step}: {name} of the plain loop", written[name], own)
        td = step_mdp(td)


def check_resets(options: Namespace) -> None:
    """Hold the first moments of the plain loop against those of the environment."""
    env = training(options, 64)
    plain, td = PlainLoop(env), env.reset()
    begun, wanted = plain.begin(td[SEED]), plain.start(td)
    for name, value in wanted.items():
        agree(f"first moment: {name} of the plain loop", begun[name], value)
