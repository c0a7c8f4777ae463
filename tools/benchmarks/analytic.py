"""Benchmark of the main job's training: an iteration by the simulator's gradient."""

from __future__ import annotations

from argparse import Namespace
from copy import deepcopy
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor, nn

from benchmarks.harness import Row, Run, agree, rates
from benchmarks.plain import PlainLoop, State
from lcc_rl.agents.agent import derived_seed
from lcc_rl.agents.factory import build_agent, make_trainer
from lcc_rl.agents.gradient import GradientTrainer
from lcc_rl.agents.vectors import denormals_flushed
from lcc_rl.config import load
from lcc_rl.envs import load_inputs

QUICK = ("scenario.horizon=20", "training.segment=20", "training.environments=8")
# Of a state: what changes, and what the plain loop does not know.
MOVING = ("leader", "cav", "cav_gap", "speed", "gap", "estimate", "covariance", "step")
ADDED = ("driven", "leader_acceleration")
OWN, PLAIN, WHOLE = "Analytic", "by hand", "by hand, network in the graph"


def analytic(options: Namespace) -> list[Row]:
    """Return iterations/s of the main job's training, beside the same by hand.

    By hand: the physics, filter and objective as one function, which records nothing, and Adam.
    The package's iteration also records the reward's terms, checks what it learns from and
    learns the prices of limits.
    """
    cfg = load("train", ["variant=alcc", "experiment=main", *(QUICK if options.quick else ())])
    cfg.training.compiled, cfg.device = options.compile, options.device
    inputs = load_inputs(cfg)
    agent, profiles = build_agent(cfg, inputs.population, cfg.device), inputs.to_learn_from()
    agent.take(profiles)
    with TemporaryDirectory(prefix="lcc_rl_benchmark_") as folder, torch.enable_grad():
        trainer = make_trainer(cfg, agent, profiles, inputs.population, Path(folder))
        assert isinstance(trainer, GradientTrainer)
        made = {PLAIN: False} | ({WHOLE: True} if options.compile else {})
        plain = {name: ByHand(trainer, whole, options.compile) for name, whole in made.items()}
        own: Run = partial(trainer._numbers, trainer._source())
        own()
        for name, other in plain.items():
            expected = trainer.rows[0]["loss_actor"]
            agree(f"the loss {name}", other() / expected, 1.0, 1e-3)
        runs: dict[str, Run] = {OWN: own, **plain}
        counts, batch = dict.fromkeys(runs, 1), cfg.training.environments
        return rates(options, runs, "iterations/s", counts, {OWN: [*plain]}, batch, grad=True)


class ByHand:
    """An iteration on plain tensors, for one automated vehicle and a human driver.

    Args:
        trainer: whose environment, objective and first weights it has.
        whole: compile the network with the step.
        compiled: compile the step.
    """

    def __init__(self, trainer: GradientTrainer, whole: bool, compiled: bool) -> None:
        self.env, self.plain, self.whole = trainer.env, PlainLoop(trainer.env), whole
        self.seed = derived_seed(trainer.seed, 0, "episodes")
        pieces = {type(piece).__name__: piece for piece in trainer.env.transform}
        self.filter = pieces["CBFFilter"]
        self.terms = {term.name: (term, factor) for term, factor in trainer.objective.terms}
        self.network: nn.Module = deepcopy(trainer.agent.policy.module)
        self.clip = trainer.agent.clip_norm
        rate = trainer.agent.learning_rate
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=rate, betas=(0.9, 0.99))
        self.compiled = torch.compile(self.step, dynamic=False) if compiled else self.step

    def __call__(self) -> float:
        """Play, learn and return the loss."""
        with denormals_flushed():
            self.env.set_seed(self.seed)
            td = self.env.reset()
            now = self.plain.start(td) | {"driven": td["vehicles", "acceleration"][:, 0]}
            now["leader_acceleration"] = td["leader", "acceleration"]
            seen, total = self.plain.observe(now), torch.zeros_like(now["cav"])
            for number in range(self.env.base_env.horizon):
                action = seen if self.whole else self.network(seen)
                step = self.compiled if number else self.step  # the first has no gradient yet
                after, total, seen = step(now, total, action)
                now = now | after
            loss = -total.mean()
            self.optimizer.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(self.network.parameters(), self.clip)
            self.optimizer.step()
        return float(loss.detach())

    def step(self, now: State, total: Tensor, action: Tensor) -> tuple[State, Tensor, Tensor]:
        """Return what changes, the objective so far and the observation.

        Args:
            now: the state.
            total: the objective so far.
            action: of the policy; with the network in the graph, what it sees.
        """
        action = self.network(action) if self.whole else action
        most, dt = self.plain.max_acceleration, self.plain.motion.time_step
        motion = (now["cav"], now["cav_gap"], now["leader"], now["leader_acceleration"])
        command = self.filter.filtered(most * action, *motion)
        state = {name: value for name, value in now.items() if name not in ADDED}
        after, _ = self.plain.step(state, command / most)
        driven = (after["cav"] - now["cav"]) / dt
        behind = (after["speed"] - now["speed"]) / dt
        gain = self.gain("efficiency", after["cav_gap"], after["cav"])
        gain = gain + self.gain("cav_energy", after["cav"], driven)
        gain = gain + self.gain("hdv_energy", after["speed"], behind).sum(-2)
        gain = gain + self.gain("smoothness", (driven - now["driven"]) / dt)
        leader = (after["leader"] - now["leader"]) / dt
        moved = {name: after[name] for name in MOVING}
        moved |= {"driven": driven, "leader_acceleration": leader}
        return moved, total + gain, self.plain.observe(after)

    def gain(self, name: str, *entries: Tensor) -> Tensor:
        """Return a term of the objective."""
        term, factor = self.terms[name]
        if name.endswith("energy"):
            speed, acceleration = entries
            before = speed - acceleration * term.time_step
            reward = -term.factor * term.energy.path_power(before, acceleration, None)
        else:
            reward = term.reward(*entries)
        return factor * term.weight * reward
