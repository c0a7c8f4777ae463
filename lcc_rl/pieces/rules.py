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
from lcc_rl.functional.rules import follower_stopper_speed, pi_saturation_speed
from lcc_rl.pieces.base import Key
from lcc_rl.pieces.controllers import Controller


class Averaging(Controller):
    """Base of rules that know the mean of the vehicle's own speed during the last seconds.

    It is kept in ``(role, "speed_history")``, ``[*batch, n, samples]`` [m/s]; before the window
    is full, the mean is that since the episode began.

    Args:
        time_step: duration of a step T [s].
        window: length of the mean [s]; None: none is kept.
        max_acceleration, max_deceleration: limits of the command [m/s²].
        reads: names of what the rule reads besides, in order.
        writes: entries written besides the command and the history.
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        time_step: float,
        window: float | None,
        max_acceleration: float,
        max_deceleration: float,
        reads: Sequence[str],
        writes: Sequence[Key] = (),
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.controllers.{role}"
        limits = {"max_acceleration": max_acceleration, "max_deceleration": max_deceleration}
        require_positive(where, **limits)
        if window is not None:
            require_in(where, "(0, 3600]", window=window)
        kept = [] if window is None else [(role, "speed_history")]
        known = ["episode.step", *(".".join(key) for key in kept)] if kept else []
        super().__init__(string, role, [*reads, *known], [*kept, *writes])
        self.samples = 0 if window is None else max(round(window / time_step), 1)
        self.time_step, self.limits = time_step, (-max_deceleration, max_acceleration)

    def mean(self, speed: Tensor, step: Tensor, history: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean [m/s], ``[*batch, n, 1]``, and the history with the present in it."""
        past = torch.cat([speed, history[..., :-1]], -1)
        return past.sum(-1, keepdim=True) / (step + 1).clamp(max=self.samples), past

    def towards(self, wanted: Tensor, speed: Tensor) -> Tensor:
        """Return the acceleration [m/s²] to a speed, within the limits."""
        return ((wanted - speed) / self.time_step).clamp(*self.limits)

    def written_specs(self, batch: torch.Size, device: torch.device | None) -> dict[Key, Any]:
        specs = super().written_specs(batch, device)
        if self.samples:
            shape = (*batch, self.event_shape[0], self.samples)
            specs[self.role, "speed_history"] = Unbounded(shape=shape, device=device)
        return specs


class FollowerStopper(Averaging):
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
        require_in(where, "(0, 3600]", window=window)
        super().__init__(
            time_step,
            window if desired_speed is None else None,
            max_acceleration,
            max_deceleration,
            ("self.speed", "self.gap", "ahead.speed"),
            (),
            string,
            role,
        )
        self.desired_speed = desired_speed
        self.shape = tuple(gaps), tuple(time_gaps), tuple(decelerations)

    def command(self, speed: Tensor, gap: Tensor, ahead: Tensor, *kept: Tensor) -> Any:
        """Return the commands, and the history where it is kept."""
        if self.desired_speed is not None:
            return self._beside(speed, gap, ahead, torch.full_like(speed, self.desired_speed))
        mean, past = self.mean(speed, *kept)
        return self._beside(speed, gap, ahead, mean), past

    def _beside(self, speed: Tensor, gap: Tensor, ahead: Tensor, desired: Tensor) -> Tensor:
        wanted = follower_stopper_speed(speed, gap, ahead, desired, *self.shape)
        return self.towards(wanted, speed)


class PISaturation(Averaging):
    """PI with saturation (Stern et al. 2018, arXiv 1705.01693).

    Drives at the mean of its own speed, a little faster where the gap is large, and like the
    vehicle ahead where it is small; see :func:`lcc_rl.functional.rules.pi_saturation_speed`. The
    command before is kept in ``(role, "commanded_speed")``, ``[*batch, n, 1]`` [m/s].

    Args:
        time_step: duration of a step T [s].
        window: length of the mean [s].
        gaps: between which catching up sets in [m].
        catch_up: by how much the target may exceed the mean [m/s].
        least_gap: gap below which it drives like the vehicle ahead [m].
        closing_time: how long closing in may take [s].
        transition: range of gaps over which it changes from one to the other [m].
        max_acceleration, max_deceleration: limits of the command [m/s²].
        string, role: see :class:`lcc_rl.pieces.controllers.Controller`.

    Raises:
        ConfigError: if a setting is out of range.
    """

    def __init__(
        self,
        time_step: float,
        window: float = 38.0,
        gaps: Sequence[float] = (7.0, 30.0),
        catch_up: float = 1.0,
        least_gap: float = 4.0,
        closing_time: float = 2.0,
        transition: float = 2.0,
        max_acceleration: float = 1.5,
        max_deceleration: float = 3.0,
        string: VehicleString | None = None,
        role: str = AUTOMATED,
    ) -> None:
        where = f"scenario.controllers.{role}"
        if len(gaps) != 2 or not 0.0 <= gaps[0] < gaps[1]:
            raise ConfigError(f"{where}.gaps must be two increasing numbers, got {list(gaps)}")
        require_in(where, "[0, inf)", catch_up=catch_up, least_gap=least_gap)
        require_positive(where, closing_time=closing_time, transition=transition)
        limits = (max_acceleration, max_deceleration)
        before = (role, "commanded_speed")
        reads = ("self.speed", "self.gap", "ahead.speed", ".".join(before))
        super().__init__(time_step, window, *limits, reads, [before], string, role)
        self.shape = tuple(gaps), catch_up, least_gap, closing_time, transition

    def command(
        self, speed: Tensor, gap: Tensor, ahead: Tensor, before: Tensor, *kept: Tensor
    ) -> Any:
        """Return the commands, the history and the speed commanded."""
        mean, past = self.mean(speed, *kept)
        before = torch.where(kept[0] == 0, speed, before)
        wanted = pi_saturation_speed(speed, gap, ahead, mean, before, *self.shape)
        return self.towards(wanted, speed), past, wanted


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
