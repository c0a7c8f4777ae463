"""Leaders from several sources: recorded traffic, highway drives, drive cycles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch

from lcc_rl.data.cycles import Leaders, join
from lcc_rl.errors import ConfigError, DataError, require_positive, unknown_name


class Mixture:
    """Leaders from several sources side by side.

    Training draws a source by its weight, then one of its records, all alike. Evaluation takes
    the windows of every source.

    Args:
        weights: how often a source is drawn, relative to the others, by name; those not named
            have 1.
        **sources: by name, each like a node of ``leader``.

    Raises:
        ConfigError: if there is no source, a weight is not positive or names no source.
    """

    def __init__(self, weights: Mapping[str, float] | None = None, **sources: Any) -> None:
        if not sources:
            raise ConfigError("leader: a mixture names no source of leaders")
        for name, source in sources.items():
            if not callable(getattr(source, "load", None)):
                raise ConfigError(
                    f"leader.{name} must be a source of leaders, got {source!r}; "
                    f"say +leader@leader.{name}=…"
                )
        for name, weight in (weights or {}).items():
            if name not in sources:
                raise unknown_name("source in leader.weights", str(name), sources)
            require_positive("leader.weights", **{str(name): weight})
        self.sources, self.weights = sources, dict(weights or {})

    def load(self, time_step: float, horizon: int, followers: int | None = None) -> Leaders:
        """Read everything; see :meth:`lcc_rl.data.cycles.RecordLeaders.load`."""
        found: dict[str, Leaders] = {}
        for name, source in self.sources.items():
            try:
                found[name] = source.load(time_step, horizon, followers)
            except DataError as error:
                raise DataError(f"leader.{name}: {error}") from error
        # A source that is for evaluation only has nothing to draw from.
        learned = {name: one for name, one in found.items() if len(one.training)}
        parts = [one.training.at_least(horizon) for one in learned.values()]
        training = join(parts) if parts else next(iter(found.values())).training
        each = [
            torch.full((len(part),), self.weights.get(name, 1.0) / len(part), dtype=torch.float64)
            for name, part in zip(learned, parts, strict=True)
        ]
        windows = join([one.windows for one in found.values()])
        names = tuple(name for name, one in found.items() for _ in range(len(one.windows)))
        return Leaders(
            replace(training, weights=torch.cat(each) if each else None),
            replace(windows, sources=names),
            tuple(case for one in found.values() for case in one.cases),
            tuple(case for one in found.values() for case in one.full_length),
            tuple(f"{name}: {line}" for name, one in found.items() for line in one.report),
        )
