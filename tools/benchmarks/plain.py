"""Benchmarks, the study and its plain loop: the physics as one function of tensors."""

from __future__ import annotations

from argparse import Namespace
from functools import cache

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import step_mdp

from benchmarks.harness import TOLERANCE, stream
from lcc_rl.config import load
from lcc_rl.envs import Inputs, build_env, load_inputs
from lcc_rl.envs.rollout import ACTION
from lcc_rl.functional.estimation import Belief, predict_and_update
from lcc_rl.functional.idm import idm_acceleration
from lcc_rl.functional.kinematics import advance_gap, advance_speed
from lcc_rl.functional.power import motor_power
from lcc_rl.functional.random import uniform
from lcc_rl.functional.safety import time_gap, time_to_collision
from lcc_rl.pieces.base import SEED, STEP


@cache
def study(quick: bool) -> tuple[DictConfig, Inputs]:
    """Configuration and inputs of the ALCC study on the synthetic stream."""
    cfg = load("train", ["variant=alcc"])
    return cfg, load_inputs(cfg, stream(quick).load().episodes)


def alcc(
    options: Namespace, batch: int, initial_time_gap: float = 1.5, followers: int = 1
) -> TransformedEnv:
    """Build the ALCC environment; the automated vehicle starts with the given time gap [s]."""
    cfg, inputs = study(options.quick)
    cfg = cfg.copy()
    cfg.scenario.start.automated.time_gap = initial_time_gap
    cfg.scenario.start.automated.gap_range = [1.0, 1.0]
    cfg.scenario.string = f"automated human*{followers}"
    return build_env(cfg, inputs.training, inputs.population, batch, device=options.device)


class PlainLoop:
    """The physics of the environment as one function of tensors, without TorchRL.

    Args:
        env: an ALCC environment with one human follower, whose settings and data it shares.
    """

    def __init__(self, env: TransformedEnv) -> None:
        pieces = {type(piece).__name__: piece for piece in env.transform}
        terms = {piece.name: piece for piece in env.transform if hasattr(piece, "weight")}
        self.leader, self.motion = pieces["NGSIMLeader"], pieces["StringMotion"]
        self.max_acceleration = pieces["Action"].max_acceleration
        self.human, self.estimator = pieces["IDM"], pieces["DriverEstimator"]
        self.scales, self.penalty = pieces["Observation"].constants, terms["collision"].weight
        self.safety, self.efficiency = terms["safety"], terms["efficiency"]
        energies = (terms["cav_energy"], terms["hdv_energy"])
        self.cav_price, self.hdv_price = (term.weight * term.factor for term in energies)

    def start(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Begin where a reset of the environment begins; all entries are ``[batch, width]``."""
        (cav, speed), (cav_gap, gap) = (td["vehicles", key].unbind(-2) for key in ("speed", "gap"))
        keys = ("estimate", "covariance", "desired_speed", "desired_time_gap")
        return {
            "seed": td[SEED],
            "step": td[STEP],
            "place": self.leader.offsets[td["leader", "profile"]] + td["leader", "start"],
            "leader": td["leader", "speed"],
            "cav": cav,
            "cav_gap": cav_gap,
            "speed": speed,
            "gap": gap,
            **{key: td["human", key].squeeze(-2) for key in keys},
        }

    def step(self, now: dict[str, Tensor], action: Tensor) -> tuple[dict[str, Tensor], ...]:
        """Return the next state and what the environment writes beside it."""
        dt, drivers = self.motion.time_step, self.human.drivers
        leader = self.leader.speeds[now["place"] + now["step"] + 1]
        cav, cav_acceleration = advance_speed(now["cav"], action * self.max_acceleration, dt)
        cav_gap = advance_gap(now["cav_gap"], now["leader"], now["cav"], leader, cav, dt)
        motion = (now["speed"], now["gap"], now["speed"] - now["cav"])
        wish = idm_acceleration(*motion, now["desired_speed"], now["desired_time_gap"], drivers)
        noise = self.human.noise * uniform(now["seed"], now["step"], self.human.noise_stream)
        speed, acceleration = advance_speed(now["speed"], wish * (1.0 + noise), dt)
        gap = advance_gap(now["gap"], now["cav"], now["speed"], cav, speed, dt)
        belief = Belief(now["estimate"], now["covariance"])
        error = self.estimator.measurement_error
        predicted, belief = predict_and_update(*motion, speed, belief, drivers, dt, error)
        early = now["step"] < self.estimator.learning_steps
        predicted = torch.where(early, self.estimator.mean(*motion), predicted)
        threshold = self.safety.threshold
        ttc = time_to_collision(cav_gap - self.safety.margin, cav - leader)
        late = time_gap(cav_gap, cav) >= self.efficiency.threshold
        reward = (
            self.safety.weight * (ttc.clamp(self.safety.floor, threshold) / threshold).log()
            - self.efficiency.weight * late.float()
            - self.cav_price * motor_power(now["cav"], cav_acceleration)
            - self.hdv_price * motor_power(now["speed"], predicted)
            - self.penalty * ((cav_gap <= 0.0) | (gap <= 0.0)).float()
        )
        seen = [leader, cav, leader - cav, cav_gap, speed, cav - speed, gap]
        written = {
            "observation": torch.cat(seen, dim=-1) * self.scales,
            "reward": reward,
            "hdv_power": motor_power(now["speed"], acceleration),
        }
        reached = {"leader": leader, "cav": cav, "cav_gap": cav_gap, "speed": speed, "gap": gap}
        learned = {"estimate": belief.estimate, "covariance": belief.covariance}
        return {**now, "step": now["step"] + 1, **reached, **learned}, written


def check_physics(options: Namespace, steps: int) -> None:
    """Hold the plain loop against the environment, whose episodes go on after a collision."""
    env = alcc(options, 64)
    plain, generator, td = PlainLoop(env), torch.Generator().manual_seed(0), env.reset()
    state = plain.start(td)
    for step in range(steps):
        action = torch.rand(64, 1, generator=generator).to(env.device or "cpu") * 2.0 - 1.0
        td = env.step(td.set(ACTION, action.unsqueeze(-2)))
        state, written = plain.step(state, action)
        for name in ("observation", "reward"):
            off = float((td["next", "automated", name].squeeze(-2) - written[name]).abs().max())
            if not off <= TOLERANCE:
                raise RuntimeError(f"step {step}: {name} of the plain loop is off by {off:g}")
        td = step_mdp(td)
