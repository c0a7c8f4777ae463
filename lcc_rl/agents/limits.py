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
from typing import Any

import torch
from torch import Tensor

from lcc_rl.config.words import RECORDED
from lcc_rl.data.profiles import Profiles
from lcc_rl.errors import ConfigError, require

log = logging.getLogger("lcc_rl")
DAMPING = 2.0  # share of the latest miss in the price of an average, against oscillations
LEAST = 1e-3  # smaller limits count as this share


class Limits:
    """The multipliers of all limits, such as those of the ALCC paper's problem (A5).

    Args:
        largest: largest share of the time of each limit, by name; ``recorded``: the share of the
            recorded drivers, see :meth:`take`.
        rate: largest change of the logarithm of a multiplier per update.
        known: the surrogates by name.

    Raises:
        ConfigError: if a name is unknown, or its surrogate has no limit or no weight.
    """

    def __init__(
        self, largest: Mapping[str, float | str | None], rate: float, known: Mapping[str, Any]
    ) -> None:
        given = {name: share for name, share in largest.items() if share is not None}
        for name in given:
            require(name in known, f"agent.limits.{name}: there is no agent.surrogates.{name}")
            if not hasattr(known[name], "missed"):
                kind = type(known[name]).__name__
                raise ConfigError(f"agent.limits.{name}: {kind} has no limit to keep")
            if not known[name].weight:
                raise ConfigError(
                    f"agent.limits.{name}: agent.surrogates.{name}.weight is 0, so its price has "
                    f"no effect; raise it, or use agent.limits.{name}=null"
                )
        self.recorded = {name: known[name] for name, share in given.items() if share == RECORDED}
        self.largest = {name: 0.0 if x == RECORDED else float(x) for name, x in given.items()}
        self.rate = rate
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
        return math.exp(self.logarithms.get(name, 0.0) + DAMPING * self.latest.get(name, 0.0))

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
