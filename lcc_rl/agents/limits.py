"""Limits of a training: their prices rise until the limits hold.

A limit is a largest share of the time. A multiplier prices its smooth surrogate, which has a
gradient; the multiplier follows the true share (a proxy Lagrangian: Cotter, Jiang and Sridharan,
"Two-player games for efficient non-convex constrained optimization", ALT 2019). If a safety filter
keeps the limit, its price falls towards zero. The limit of an average, such as the spacing, can be
missed on both sides; its price also depends on the latest miss, which damps oscillations (Stooke,
Achiam and Abbeel, "Responsive safety in reinforcement learning by PID Lagrangian methods", ICML
2020).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from lcc_rl.config.words import RECORDED
from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, require

log = logging.getLogger("lcc_rl")
LEAST = 1e-3  # smaller limits count as this share


class Limits:
    """The multipliers of all limits, such as those of the ALCC paper's problem (A5).

    Args:
        largest: largest share of the time of each limit, by name; ``recorded``: the share of the
            recorded drivers, see :meth:`take`.
        rate: largest change of the logarithm of a multiplier per update.
        known: the surrogates by name.
        damping: factor of the latest miss in the logarithm of the multiplier of an average.
        where: the setting that gives the limits.

    Raises:
        ConfigError: if a name is unknown, or its surrogate has no limit or no weight.
    """

    def __init__(
        self,
        largest: Mapping[str, float | str | None],
        rate: float,
        known: Mapping[str, Any],
        damping: float = 2.0,
        *,
        where: str = "agent.limits",
    ) -> None:
        given = {name: share for name, share in largest.items() if share is not None}
        for name in given:
            lacking = f"there is no agent.surrogates.{name}; surrogates@agent=limits adds terms"
            require(name in known, f"{where}.{name}: {lacking}")
            if not hasattr(known[name], "missed"):
                kind = type(known[name]).__name__
                raise ConfigError(f"{where}.{name}: {kind} has no limit to keep")
            if not known[name].weight:
                raise ConfigError(
                    f"{where}.{name}: agent.surrogates.{name}.weight is 0, so its price has "
                    f"no effect; raise it, or use {where}.{name}=null"
                )
        self.recorded = {name: known[name] for name, share in given.items() if share == RECORDED}
        self.largest = {name: 0.0 if x == RECORDED else float(x) for name, x in given.items()}
        self.rate, self.damping = rate, damping
        self.logarithms = dict.fromkeys(self.largest, 0.0)
        self.widths = {
            name: known[name].limit_width for name in given if hasattr(known[name], "limit_width")
        }
        self.latest = dict.fromkeys(self.widths, 0.0)  # last miss of each average

    def take(self, profiles: Profiles) -> None:
        """Set the limits that are ``recorded`` to the share of the recorded drivers.

        Args:
            profiles: speeds of the training leaders and motion of the recorded drivers.

        Raises:
            ConfigError: if no driver was recorded.
        """
        for name, term in self.recorded.items():
            if profiles.followers is None:
                raise ConfigError(
                    f"agent.limits.{name}={RECORDED}: no driver was recorded behind these leaders; "
                    f"give the share of the time as a number, such as agent.limits.{name}=0.01"
                )
            speed, gap = profiles.followers.split(1, -1)
            relative = profiles.speeds.unsqueeze(-1) - speed
            seen = {"self.speed": speed, "self.gap": gap, "self.relative_speed": relative}
            share = float(term.missed(*(seen[key] for key in term.reads)).double().mean())
            self.largest[name] = share
            log.info("agent.limits.%s: %.4f of the time, as the recorded drivers", name, share)

    def price(self, name: str) -> float:
        """Return the multiplier of a limit; 1 for other terms."""
        return math.exp(self.logarithms.get(name, 0.0) + self.damping * self.latest.get(name, 0.0))

    def update(self, shares: Mapping[str, float]) -> None:
        """Raise the multipliers of missed limits and lower the others.

        Args:
            shares: share of the time in which each limit was missed.
        """
        for name, share in shares.items():
            largest = self.largest[name]
            if name in self.widths:
                over = (share - largest) / max(abs(largest), self.widths[name])
            else:
                over = share / max(largest, LEAST) - 1.0
            over = min(max(over, -1.0), 1.0)
            self.logarithms[name] += self.rate * over
            if name in self.widths:
                self.latest[name] = over

    def state_dict(self) -> dict[str, Tensor]:
        """Return the multipliers."""
        values = [kept[name] for kept in self._kept() for name in sorted(kept)]
        return {"logarithms": torch.tensor(values, dtype=torch.float64)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the result of :meth:`state_dict`."""
        values = iter(state["logarithms"].tolist())
        for kept in self._kept():
            kept.update({name: next(values) for name in sorted(kept)})

    def _kept(self) -> tuple[dict[str, float], dict[str, float]]:
        return self.logarithms, self.latest


class LimitsEach:
    """Limits that hold behind each record of leaders by itself, each with a multiplier.

    The limit of all episodes together may be missed behind one leader and more than kept behind
    another; here it may not. Such a price adds to that of all episodes.

    Args:
        largest: largest share of the time of each limit, by name.
        how: rate, known and damping, as for :class:`Limits`.
    """

    def __init__(self, largest: Mapping[str, float | None], *how: Any) -> None:
        self.make = partial(Limits, largest, *how, where="agent.limits_each")
        self.largest = self.make().largest
        self.records: list[Limits] = []
        self.profile: list[int] = []  # record of each episode of the batch

    def take(self, records: int) -> None:
        """Begin with the number of the records of leaders."""
        require(records or not self.largest, "agent.limits_each: no recorded leader on this road")
        self.records = [self.make() for _ in range(records)]

    def begin(self, profile: Tensor | None) -> None:
        """Begin a batch of episodes behind the records ``[batch, 1]``; None: without leaders."""
        self.profile = [] if profile is None else profile.flatten().tolist()

    def price(self, name: str, like: Tensor) -> Tensor | float:
        """Return the multiplier of each episode, ``[batch, 1, 1]``; 0 for other terms."""
        if name not in self.largest:
            return 0.0
        return like.new_tensor([self.records[i].price(name) for i in self.profile])[:, None, None]

    def update(self, shares: Mapping[str, Tensor]) -> dict[str, float]:
        """Update the multipliers of the batch's records.

        Args:
            shares: share of the time in which each limit was missed, ``[batch]``.

        Returns:
            The largest share behind a record, and the mean price, of each limit.
        """
        row = {}
        for name, share in shares.items():
            behind: dict[int, list[float]] = {}
            for record, value in zip(self.profile, share.tolist(), strict=True):
                behind.setdefault(record, []).append(value)
            means = {record: sum(values) / len(values) for record, values in behind.items()}
            prices = [self.records[record].price(name) for record in means]
            row[f"most_{name}"] = max(means.values())
            row[f"price_each_{name}"] = sum(prices) / len(prices)
            for record, mean in means.items():
                self.records[record].update({name: mean})
        return row

    def state_dict(self) -> dict[str, Tensor]:
        """Return the multipliers, a row per record."""
        rows = [x.state_dict()["logarithms"] for x in self.records]
        return {"logarithms": torch.stack(rows) if rows else torch.zeros(0, dtype=torch.float64)}

    def load_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Restore the result of :meth:`state_dict`."""
        for record, row in zip(self.records, state["logarithms"], strict=True):
            record.load_state_dict({"logarithms": row})
