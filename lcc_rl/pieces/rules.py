"""Published rules for smoothing traffic, and the handover from a human driver to a rule."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from lcc_rl.errors import ConfigError, require_in, require_positive
from lcc_rl.functional.pattern import AUTOMATED, VehicleString
from lcc_rl.functional.rules import follower_stopper_speed
from lcc_rl.pieces.base import Key
from lcc_rl.pieces.controllers import Controller


class FollowerStopper(Controller):
    """FollowerStopper in its time-headway form (Stern et al. 2018, arXiv 1705.01693).

    Drives at a desired speed unless the vehicle ahead is near; see
    :func:`lcc_rl.functional.rules.follower_stopper_speed`. The command is (v_cmd − v)/T within
    the limits. The desired speed is fixed, or the mean of the vehicle's own speed during the last
    ``window`` seconds, kept in ``(role, "speed_history")``, ``[*batch, n, samples]`` [m/s].

    Args:
        time_step: duration of a step T [s].
        desired_speed: v_d; None: the vehicle's own mean [m/s].
        window: length of that mean [s].
        gaps: Δx⁰_k, gaps at standstill that bound the regions [m].
        time_gaps: h_k; Δx⁰_k is at least h_k v; zeros for the original form [s].
        decelerations: d_k, see the paper [m/s²].
        max_acceleration, max_deceleration: limits of the command [m/s²].
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        time_step: float,
        desired_speed: float | None = None,
        window: float = 60.0,
        gaps: Sequence[float] = (4.5, 5.25, 6.0),
        time_gaps: Sequence[float] = (0.4, 0.6, 0.8),
        decelerations: Sequence[float] = (1.5, 1.0, 0.5),
        max_acceleration: float = 1.5,
        max_deceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.controllers.{role}"
        limits = {"max_acceleration": max_acceleration, "max_deceleration": max_deceleration}
        require_positive(where, **limits)
        require_in(where, "(0, 3600]", window=window)
        lists = {"gaps": gaps, "time_gaps": time_gaps, "decelerations": decelerations}
        for name, values in lists.items():
            interval = "[0, inf)" if name == "time_gaps" else "(0, inf)"
            require_in(where, interval, **{f"{name}[{i}]": x for i, x in enumerate(values)})
            if len(values) != 3:
                raise ConfigError(f"{where}.{name} must be three numbers, got {list(values)}")
        if list(gaps) != sorted(gaps):
            raise ConfigError(f"{where}.gaps must increase, got {list(gaps)}")
        if desired_speed is not None:
            require_positive(where, desired_speed=desired_speed)
        history = (role, "speed_history")
        names = ["self.speed", "self.gap", "ahead.speed"]
        kept = [] if desired_speed is not None else [history]
        names += [".".join(key) for key in kept]
        super().__init__(string, role, names, kept)
        self.samples = max(round(window / time_step), 1)
        self.desired_speed, self.time_step = desired_speed, time_step
        self.shape = tuple(gaps), tuple(time_gaps), tuple(decelerations)
        self.limits = (-max_deceleration, max_acceleration)

    def command(self, speed: Tensor, gap: Tensor, ahead: Tensor, *history: Tensor) -> Any:
        """Return the commands, and the history where it is kept."""
        if self.desired_speed is not None:
            return self._towards(speed, gap, ahead, torch.full_like(speed, self.desired_speed))
        past = torch.cat([speed, history[0][..., :-1]], -1)
        return self._towards(speed, gap, ahead, past.mean(-1, keepdim=True)), past

    def _towards(self, speed: Tensor, gap: Tensor, ahead: Tensor, desired: Tensor) -> Tensor:
        wanted = follower_stopper_speed(speed, gap, ahead, desired, *self.shape)
        return ((wanted - speed) / self.time_step).clamp(*self.limits)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        specs = super().written_specs(batch, device)
        for key in self.targets[1:]:
            shape = (*batch, self.event_shape[0], self.samples)
            specs[key] = Unbounded(shape=shape, device=device)
        return specs


class Handover(Controller):
    """Lets one controller drive until a moment of the episode, and another one from then on.

    Both compute from the start, so that one which remembers is ready when its turn comes.

    Args:
        before: who drives first, a human driver say.
        after: who drives from ``from_s`` on.
        from_s: that moment [s].
        time_step: duration of a step [s].
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if ``from_s`` is negative.
    """

    def __init__(
        self,
        before: Controller,
        after: Controller,
        from_s: float,
        time_step: float,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        require_in(f"scenario.controllers.{role}", "[0, inf)", from_s=from_s)
        both = (before, after)
        super().__init__(
            string,
            role,
            ["episode.step", *before.names, *after.names],
            [key for inner in both for key in inner.targets[1:]],
            [key for inner in both for key in inner.constants],
            [key for inner in both for key in inner.reset_options],
        )
        self.before, self.after = before, after
        self.from_step = round(from_s / time_step)

    def command(self, step: Tensor, *entries: Tensor) -> Any:
        """Return the commands of whoever drives, and what both write besides."""
        place = len(self.before.names)
        first = self.before.command(*entries[:place])
        second = self.after.command(*entries[place:])
        first, second = (x if isinstance(x, tuple) else (x,) for x in (first, second))
        command = torch.where(step < self.from_step, first[0], second[0])
        return (command, *first[1:], *second[1:])

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        return {
            **self.before.written_specs(batch, device),
            **self.after.written_specs(batch, device),
        }

    def constant_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        return {
            **self.before.constant_specs(batch, device),
            **self.after.constant_specs(batch, device),
        }

    def begin(self, given: TensorDictBase, start: TensorDictBase) -> None:
        self.before.begin(given, start)
        self.after.begin(given, start)
