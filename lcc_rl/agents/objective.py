"""The objective of a training through the simulator: terms, surrogates and limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import field
from functools import partial
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from lcc_rl.agents.actor import Activation
from lcc_rl.agents.agent import Agent, Scene
from lcc_rl.agents.limits import Limits, LimitsEach
from lcc_rl.agents.rules import NETWORK_ALONE, make_policy
from lcc_rl.config.schemas import all_of
from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, Diverged
from lcc_rl.functional.finite import any_nonfinite
from lcc_rl.pieces.base import Key, as_key, next_key
from lcc_rl.pieces.rewards import RewardTerm
from lcc_rl.pieces.world import World
from lcc_rl.settings import Count, NonNegative, Positive, Share

_ALL_TERMS = partial(all_of, kind=RewardTerm, added="<name>={_target_: …} adds one")
Terms = Annotated[dict[str, Any], AfterValidator(_ALL_TERMS)]


class Aiming(Agent):
    """Settings of agents with a policy of networks and rules, and an objective.

    The objective may differ from the reward.
    """

    hidden: Sequence[Count]  # layers of a network
    activation: Activation = "relu"  # between the layers of networks
    # A network; a rule with learned constants (idm, acc, calm), of agent=analytic only; or a
    # network on top of a rule (residual_idm, residual_acc, residual_calm).
    policy: Any = NETWORK_ALONE
    constants: dict[str, Positive] | None = None  # of a rule at the start; the others keep theirs
    bound: Positive = 1.0  # largest action that a network adds to a rule
    # Time in which humans drive before every episode; nothing is learned from it, and the policy
    # takes over in developed traffic [s].
    humans_first: NonNegative = 0.0
    # Reward terms that take the place of those of the same name in the objective; their
    # weights multiply the terms' own. Those of terms that the reward lacks are ignored.
    surrogates: Terms = field(default_factory=dict)
    # Largest share of the time in which a surrogate's limit may be missed, by its name, or that of
    # the recorded drivers; its weight is the price at the start, see lcc_rl.agents.limits.
    limits: dict[str, Share | Literal["recorded"] | None] = field(default_factory=dict)
    limit_rate: Positive = 0.1  # largest change of the logarithm of such a price at once
    # Factor of the latest miss in the logarithm of the price of an average, such as the spacing.
    limit_damping: NonNegative = 2.0
    # Terms of the objective only.
    regularizers: Terms = field(default_factory=dict)

    def aim(self, scene: Scene) -> None:
        """Make objective and policy, and find the steps in which humans drive first."""
        self.objective = Objective(self, scene.device, scene.world)
        self.burn_in = scene.world.steps(self.humans_first, "agent.humans_first")
        given = self.hidden, self.constants, self.activation, self.bound
        self.policy = make_policy(self.policy, scene, *given)

    def take(self, profiles: Profiles) -> None:
        """Take the limits that recorded drivers set."""
        self.objective.limits.take(profiles)


class Objective:
    """The terms of an objective and the prices of its limits.

    Args:
        settings: see :class:`Aiming`; its ``limits_each`` if it has any.
        device: device of the terms.

    Raises:
        ConfigError: if a node or a limit is wrong.
    """

    def __init__(self, settings: Any, device: str, world: World) -> None:
        def made(where: str) -> dict[str, RewardTerm]:
            return {
                name: term.bind(world, name).to(device)
                for name, term in getattr(settings, where).items()
                if term is not None
            }

        self.surrogates, self.regularizers = made("surrogates"), made("regularizers")
        how = settings.limit_rate, self.surrogates, settings.limit_damping
        self.limits = Limits(settings.limits, *how)
        self.each = LimitsEach(getattr(settings, "limits_each", {}), *how)
        self.terms: list[tuple[RewardTerm, float]] = []
        self.priced = self.terms  # those with a limit of all episodes

    @property
    def differs(self) -> bool:
        """Whether it differs from the reward."""
        return bool(self.surrogates or self.regularizers)

    def replace(self, terms: Sequence[RewardTerm]) -> None:
        """Replace the reward's terms by their surrogates, and add the regularizers.

        A term of weight 0 has no part in the objective, and no limit.
        """
        own = self.surrogates
        chosen = [
            (own[term.name], term.weight) if term.name in own else (term, 1.0)
            for term in terms
            if term.weight
        ]
        self.terms = chosen + [(term, 1.0) for term in self.regularizers.values()]
        self.priced = [(term, x) for term, x in self.terms if term.name in self.limits.largest]

    def wanted(self, env: EnvBase) -> list[Key]:
        """Return the entries of the next state that the terms read.

        Raises:
            ConfigError: naming a term that reads an entry that the environment lacks.
        """
        known = set(map(as_key, env.full_observation_spec.keys(True, True)))
        read = [(term, key) for term, _ in self.terms for _, key in term.needs]
        for term, key in read:
            if key not in known:
                what = f"{term.name} ({type(term).__name__})"
                raise ConfigError(
                    f"agent: the objective's term {what} reads {'.'.join(key)}, which no piece "
                    "writes; take the term out or add the piece"
                )
        return [key for _, key in read]

    def score(self, data: TensorDictBase) -> Tensor:
        """Return the objective at every step of a rollout, ``[batch, steps, A]``.

        Args:
            data: the rollout, ``[batch, steps]``.

        Raises:
            Diverged: naming the first term that is not finite.
        """
        parts = []
        for term, factor in self.terms:
            value = term.computed(_entries(term, data)).squeeze(-1)
            parts.append(factor * self._price(term.name, value) * value)
        if any_nonfinite(parts):
            for (term, _), part in zip(self.terms, parts, strict=True):
                if any_nonfinite([part]):
                    kind = type(term).__name__
                    raise Diverged(f"the objective's term {term.name} ({kind}) is nan")
        return torch.stack(parts).sum(0)

    def at_price_one(self, data: TensorDictBase) -> Tensor:
        """Return the terms with limits at price 1, ``[batch, steps, A, terms]``; see `score`."""
        return torch.cat([x * term.computed(_entries(term, data)) for term, x in self.priced], -1)

    def prices(self, like: Tensor) -> Tensor:
        """Return the present price of each term with a limit, ``[terms]``."""
        return like.new_tensor([self.limits.price(term.name) for term, _ in self.priced])

    def _price(self, name: str, like: Tensor) -> Tensor | float:
        """Return the price of a term: that of all episodes, plus that behind its record."""
        each = self.each.price(name, like)
        only_each = name in self.each.largest and name not in self.limits.largest
        return each if only_each else self.limits.price(name) + each

    def limited(self, limits: Limits | LimitsEach) -> dict[str, Any]:
        """Return the terms with such a limit, by name."""
        return {term.name: term for term, _ in self.terms if term.name in limits.largest}

    def missed(self, data: TensorDictBase, running: Tensor) -> dict[str, float]:
        """Return the share of a rollout's time in which each limit was missed.

        Args:
            data: the rollout, ``[batch, steps]``.
            running: which steps count, ``[batch, steps, 1]``.
        """
        return {
            name: float(self._missed(term, data, running, (0, 1, 2)))
            for name, term in self.limited(self.limits).items()
        }

    def update(self, shares: Mapping[str, float]) -> dict[str, float]:
        """Change the prices of limits by the shares of the time in which they were missed.

        Returns:
            Columns of a record: the largest share, the share missed and the price until then.
        """
        price, largest = self.limits.price, self.limits.largest
        row = {
            **{f"limit_{name}": largest[name] for name in shares},
            **{f"share_{name}": share for name, share in shares.items()},
            **{f"price_{name}": price(name) for name in shares},
        }
        self.limits.update(shares)
        return row

    def missed_each(self, data: TensorDictBase, running: Tensor) -> dict[str, Tensor]:
        """Return the shares of the time in each episode, ``[batch]``; see :meth:`missed`."""
        return {
            name: self._missed(term, data, running, (1, 2))
            for name, term in self.limited(self.each).items()
        }

    @torch.no_grad()
    def _missed(
        self, term: Any, data: TensorDictBase, running: Tensor, over: tuple[int, ...]
    ) -> Tensor:
        missed = term.missed(*term.views(*_entries(term, data))).squeeze(-1)
        counted = running.expand_as(missed)
        return (missed * counted).double().sum(over) / counted.sum(over).clamp(min=1)


def _entries(term: RewardTerm, data: TensorDictBase) -> list[Tensor]:
    return [data.get(next_key(key)) for _, key in term.needs]
