"""Tuning without gradients: CMA-ES over the weights of a policy, most of use for rules.

Every candidate drives the same episodes; how well is the objective without a discount, so that
nothing need be smooth (Hansen, "The CMA evolution strategy: a tutorial", arXiv 1604.00772; the
search itself is the package cmaes').
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch.nn.utils import parameters_to_vector, vector_to_parameters

from lcc_rl.agents.agent import Scene, derived_seed
from lcc_rl.agents.checks import check_batch
from lcc_rl.agents.loop import REPORTED, episode_statistics
from lcc_rl.agents.simulated import SimulatedAgent, SimulatedLoop
from lcc_rl.envs.rollout import DifferentiableRollout
from lcc_rl.errors import ConfigError, how_to_install
from lcc_rl.settings import Count, Positive

MOST_WEIGHTS = 500  # beyond, the covariance of a generation's candidates says too little


class Tuned(SimulatedAgent):
    """A policy whose weights are tuned by search."""

    policy: Any = "idm"
    hidden: Sequence[Count] = ()
    limit_rate: Positive = 0.2
    # Weights tried on the same episodes before the search moves.
    candidates: Annotated[int, Field(ge=4, le=1000)] = 10
    # Standard deviation of the candidates at the start; of a rule's constants that of their
    # logarithms.
    sigma: Positive = 0.3

    def setup(self, scene: Scene) -> None:
        name = self.policy
        super().setup(scene)
        self.weights = [entry for entry in self.policy.parameters() if entry.requires_grad]
        count = sum(entry.numel() for entry in self.weights)
        if count > MOST_WEIGHTS:
            raise ConfigError(
                f"agent.policy={name} has {count} weights, a search can tune "
                f"{MOST_WEIGHTS}: use agent.policy=idm or acc, or a smaller agent.hidden"
            )
        self.begun = parameters_to_vector(self.weights).detach().double().cpu().numpy()
        self.search = self._search()
        # Cost of every candidate so far, and its share of each limit, by name.
        self.costs: list[float] = []
        self.missed: list[list[float]] = []
        self.asked: list[np.ndarray] = []
        self.center = self.begun

    def _search(self) -> Any:
        try:
            from cmaes import CMA
        except ImportError as error:
            raise ConfigError(f"agent=tuned needs cmaes: {how_to_install('tune')}") from error
        size, seed = self.candidates, derived_seed(self.seed, "search")
        return CMA(self.begun, self.sigma, seed=seed, population_size=size)

    def anneal(self, share: float) -> float:
        """Return the first step size of the search, which has no learning rate."""
        return self.sigma

    def ask(self) -> None:
        """Give the policy the weights of the next candidate."""
        self.asked.append(self.search.ask())
        self._drive(self.asked[-1])

    def tell(self, cost: float, shares: Mapping[str, float]) -> None:
        """Say how dear the last candidate was, and how often it missed each limit.

        After the last candidate of a generation the search moves, and the prices with it.
        """
        self.costs.append(cost)
        self.missed.append([share for _, share in sorted(shares.items())])
        count = self.candidates
        if len(self.costs) % count == 0:
            self.search.tell(list(zip(self.asked, self.costs[-count:], strict=True)))
            self.asked, self.center = [], self.search.mean
            means = np.mean(self.missed[-count:], axis=0)
            self.objective.limits.update(dict(zip(sorted(shares), means.tolist(), strict=True)))

    def settle(self) -> None:
        """Give the policy the weights around which the search looks."""
        self._drive(self.center)

    def _drive(self, weights: np.ndarray) -> None:
        vector_to_parameters(torch.as_tensor(weights).to(self.weights[0]), self.weights)

    def state_dict(self) -> dict[str, Any]:
        """Return everything that :meth:`load_state_dict` needs to resume bit for bit."""
        return {
            "policy": self.policy.state_dict(),
            "costs": torch.tensor(self.costs, dtype=torch.float64),
            "missed": torch.tensor(self.missed, dtype=torch.float64),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned, by making the same search again."""
        limits = self.objective.limits
        limits.logarithms = dict.fromkeys(limits.logarithms, 0.0)
        self.search, self.costs, self.missed = self._search(), [], []
        self.asked, self.center = [], self.begun
        names = sorted(self.objective.limited())
        for cost, shares in zip(state["costs"].tolist(), state["missed"].tolist(), strict=True):
            self.ask()
            self.tell(cost, dict(zip(names, shares, strict=True)))
        self.policy.load_state_dict(state["policy"])


class SearchLoop(SimulatedLoop[Tuned]):
    """Tunes by search, one candidate an iteration; arguments as of :class:`TrainingLoop`."""

    advice = "Lower agent.sigma"
    watched = "cost"

    def _source(self) -> DifferentiableRollout:
        return self._rollout()

    def _iterate(self, source: DifferentiableRollout) -> dict[str, float]:
        """Let a candidate drive a batch of episodes."""
        begun = time.perf_counter()
        generation = self.iteration // self.agent.candidates
        self.env.set_seed(derived_seed(self.seed, generation, "episodes"))
        self.agent.ask()
        with torch.no_grad():
            network = self.agent.policy.module
            _, record = source.play(source.start(), network, self.horizon)
            data = source.assemble(record)
            check_batch(data)
            running = 1.0 - (data["next", "terminated"].cumsum(1) > 0).double()
            objective = self.objective.score(data) * running
        shares = self.objective.missed(data, running)
        limits = self._limits_row(shares)
        cost = -float(objective.sum(1).mean())
        self.agent.tell(cost, shares)
        self.agent.settle()
        self.iteration += 1
        self.updates = self.iteration // self.agent.candidates
        row = {
            "iteration": float(self.iteration),
            "episodes": float(self.iteration * self.env.batch_size[0]),
            "transitions": float(self.iteration * data.numel()),
            "updates": float(self.updates),
            **episode_statistics(data.select(*REPORTED)),
            "cost": cost,
            **limits,
        }
        self._record(row, time.perf_counter() - begun, 0.0)
        return row
