"""Clairvoyant bound: the best drive that the gradient finds if the whole profile is known.

Every episode is optimised separately. The objective is the energy of the vehicles and all drivers
behind them, net of kinetic energy. Otherwise braking just before the end would pay off, because A2
returns more than twice the kinetic energy. In a task it is divided by the distance, and the flow
must not be below that of the initial drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv

from lcc_rl.config.schemas import StudyConfig
from lcc_rl.envs import DifferentiableRollout, build_env
from lcc_rl.envs.inputs import Inputs, build_energy
from lcc_rl.envs.step import check_batch
from lcc_rl.errors import require
from lcc_rl.evaluation.episodes import Plan
from lcc_rl.evaluation.metrics import KILO, LONG_TIME_GAP, UNSAFE_TTC
from lcc_rl.evaluation.rollout import reset_options
from lcc_rl.evaluation.strategies import Strategy
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.pieces.base import ACTION, STEP, next_key
from lcc_rl.pieces.features import CLASS
from lcc_rl.pieces.views import VEHICLES, Views

CONSTRAINED = ("gap", "relative_speed", "time_gap", "speed")
BOUND_BOTH, BOUND_OWN = "clairvoyant", "clairvoyant own"
MARGIN = 1.01  # margin of one per cent on the limits
LEAST_GAP = 0.5  # [m]
FAR_GAP = 20.0  # largest excess of a gap that counts [m]
LARGEST_STEP, SMALLEST_STEP = 0.02, 0.001  # change of an action per iteration
FLOW_PRICE = 3.0  # cost of losing the whole flow as a multiple of the energy


class Planned:
    """A policy plus a plan of shifts of its actions, ``[steps, batch, A, 1]``."""

    def __init__(self, policy: Any, shifts: Tensor) -> None:
        self.policy, self.shifts = policy, shifts
        self.in_keys = [*policy.in_keys, STEP]

    def __call__(self, td: TensorDictBase) -> TensorDictBase:
        td = self.policy(td)
        shift = self.shifts[int(td.get(STEP).flatten()[0])]
        return td.set(ACTION, (td.get(ACTION) + shift).clamp(-1.0, 1.0))


def clairvoyant(
    strategy: Strategy,
    inputs: Inputs,
    drivers: int | None,
    seed: int,
    iterations: int = 400,
    compiled: bool = True,
    own: bool = False,
    hold: int = 1,
    report: Callable[[int, dict[str, float]], None] = lambda iteration, values: None,
) -> Strategy:
    """Return the best strategy found, starting from the drive of a learned controller.

    The prices of the limits (time-to-collision, time gap and gap; in a task the flow, with the
    gaps kept by the filter) rise. The problem is not convex: there may be better drives.

    Args:
        strategy: the initial controller; its policy must be a network of the observation.
        inputs, drivers, seed: as for :func:`lcc_rl.evaluation.episodes.evaluate`, which needs the
            same values, and a batch with all episodes.
        iterations: gradient steps.
        compiled: compile the simulator.
        own: minimise the energy of the automated vehicles only.
        hold: number of steps of each shift.
        report: called with the number of the iteration, the objective and the price of the limits.

    Raises:
        Diverged: if an action or an entry of objective or limits is not finite.
    """
    require(iterations >= 1, f"iterations must be at least 1, got {iterations}")
    env, options = _episodes(strategy, inputs, drivers, seed)
    policy: Any = strategy.policy
    network, steps = policy.module.requires_grad_(False), env.base_env.horizon
    keys = [(VEHICLES, name) for name in CONSTRAINED]
    source = DifferentiableRollout(env, network, keys, (), compiled)
    # Plans minimise the smooth energy; the best one is chosen by the measured energy.
    goal, measured = Goal(strategy.cfg, own), Goal(strategy.cfg, own, exact=True)
    cars = strategy.cfg.automated
    shape = (math.ceil(steps / hold), env.batch_size[0], cars, 1)
    shifts, best = torch.zeros(shape, requires_grad=True), Best(env.batch_size[0])
    optimizer = torch.optim.Adam([shifts], betas=(0.9, 0.95))
    for iteration in range(iterations):
        share = iteration / iterations
        every = shifts.repeat_interleave(hold, 0)[:steps]
        _, record = source.play(source.start(options), steps, every)
        data = source.assemble(record)
        check_batch(data, label=strategy.title)
        price, missed = goal(data)
        best.take(torch.stack(measured(data)).sum(0), every)
        total = price + min(1.0, 0.1 + 1.8 * share) * missed
        _descend(optimizer, total, share, math.sqrt(hold))
        means = {"kJ": float(price.detach().mean()), "missed": float(missed.detach().mean())}
        report(iteration + 1, means)
    planned = Planned(strategy.policy, best.shifts)
    return replace(strategy, name=BOUND_OWN if own else BOUND_BOTH, policy=planned, seed=None)


def _episodes(
    strategy: Strategy, inputs: Inputs, drivers: int | None, seed: int
) -> tuple[TransformedEnv, TensorDict]:
    count = len(inputs.population.time_gap)
    plan = Plan(len(inputs.evaluation), count, drivers, len(inputs.evaluation) * count)
    profile, driver, _ = plan.episodes(0)
    cfg = strategy.cfg.for_any_leader()
    env = build_env(cfg, inputs.evaluation, inputs.population, len(profile), nominal=True)
    return env, reset_options(env, profile, driver, seed, count)


class Best:
    """The shifts of every episode, ``[steps, batch, A, 1]``, at the lowest price so far."""

    def __init__(self, episodes: int) -> None:
        self.price, self.shifts = torch.full((episodes,), torch.inf), torch.zeros(())

    @torch.no_grad()
    def take(self, price: Tensor, shifts: Tensor) -> None:
        """Keep the shifts of the episodes with a lower price, ``[batch]``, than before."""
        better = price < self.price
        self.price = torch.where(better, price, self.price)
        self.shifts = torch.where(better.view(-1, 1, 1), shifts, self.shifts)


def _descend(optimizer: torch.optim.Optimizer, price: Tensor, share: float, length: float) -> None:
    """Take a step, which is longer for fewer shifts."""
    (group,) = optimizer.param_groups
    (shifts,) = group["params"]
    optimizer.zero_grad(set_to_none=True)
    price.sum().backward()
    # Every episode is a separate problem with its own scale.
    shifts.grad /= shifts.grad.square().sum((0, 2, 3), keepdim=True).sqrt().clamp(min=1e-6)
    fall = 0.5 * (1.0 + math.cos(math.pi * share))
    group["lr"] = length * (SMALLEST_STEP + (LARGEST_STEP - SMALLEST_STEP) * fall)
    optimizer.step()


class Goal:
    """Objective of a plan and the price of its limits, each ``[batch]`` [kJ].

    In a task the objective is the energy minus a price times the distance. The price is the energy
    per metre of the first drive, so a smaller value means less energy per distance. The limit is
    the flow of that drive.

    Args:
        cfg: configuration of the initial controller.
        own: count the energy of the automated vehicles only.
        exact: use the measured energy instead of the smooth one.
    """

    def __init__(self, cfg: StudyConfig, own: bool, exact: bool = False) -> None:
        scenario = cfg.scenario
        self.task, self.string = cfg.task is not None, scenario.vehicles
        self.length, self.time_step = scenario.vehicle_length, scenario.time_step
        self.fleet, self.own, self.exact = build_energy(cfg), own, exact and self.task
        self.first: tuple[Tensor, Tensor] | None = None

    def __call__(self, data: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Return objective and price for a drive."""
        energy = self.energy(data)
        if not self.task:
            return energy, misses(data, self.string)
        speed, gap = (data.get(next_key((VEHICLES, x))).flatten(1) for x in ("speed", "gap"))
        distance = speed.sum(1) * self.time_step
        kinds = data.get(CLASS, None)
        length = self.length if kinds is None else self.fleet.lengths(kinds).flatten(1).mean(1)
        flow = speed.mean(1) / (gap.mean(1) + length)
        if self.first is None:
            self.first = (energy / distance).detach(), flow.detach()
        per_metre, least = self.first
        worth = per_metre * distance
        lost = (1.0 - flow / least).clamp(min=0.0)
        return energy - worth, FLOW_PRICE * worth.detach() * lost

    def energy(self, data: TensorDictBase) -> Tensor:
        """Return the path energy of the counted vehicles, ``[batch]`` [kJ].

        If ``exact``, it is the energy drawn net of kinetic energy, which has jumps.
        """
        now, then = data.get((VEHICLES, "speed")), data.get(("next", VEHICLES, "speed"))
        kind = data.get(CLASS, None)
        if self.own:
            names = ["self.speed", "next.self.speed"] + ["self.energy_class"] * (kind is not None)
            now, then, *kinds = Views(self.string, AUTOMATED, names).of(data)
            kind = kinds[0] if kinds else None
        fleet, motion = self.fleet, (now, (then - now) / self.time_step)
        power = fleet.power(*motion, kind) if self.exact else fleet.path_power(*motion, kind)
        if self.exact:
            stored = fleet.stored_energy(then, kind) - fleet.stored_energy(now, kind)
            power = power - stored / self.time_step + fleet.unpaid(*motion, kind)
        return power.flatten(1).sum(1) * self.time_step * KILO


def misses(data: TensorDictBase, string: VehicleString) -> Tensor:
    """Return the price of missed limits in each episode, ``[batch]``; zero if they are kept."""
    views = Views(string, AUTOMATED, [f"next.self.{name}" for name in CONSTRAINED])
    gap, relative_speed, time_gap, _ = views.of(data)
    closing = -relative_speed
    longest = LONG_TIME_GAP / MARGIN * gap / time_gap.clamp(min=1e-3)
    over = torch.stack([MARGIN * UNSAFE_TTC * closing - gap, gap - longest]).clamp(0.0, FAR_GAP)
    near = (LEAST_GAP - gap).clamp(min=0.0)
    return ((over + 0.3 * over.square()).sum(0) + 10.0 * near).flatten(1).sum(1)
