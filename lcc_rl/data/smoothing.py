"""Smoothing of recorded motion: positions of trajectories, or averages of whole episodes.

:class:`SavitzkyGolay` smooths positions and differentiates them. :func:`averaged` returns moving
averages of the episodes of any source, for energies that do not depend on the noise of sensors.

Raw NGSIM speeds and accelerations are noisy and disagree with the positions. In stretches without a
missing frame the positions are smoothed, speed and acceleration are their derivatives, and space
headways are derived again. Smoothing is off unless a configuration names this class or a function
of trajectories.

At the ends of a stretch a window is one-sided. With noisy positions of known motion, the error of
the speed is there 3 times that of the interior, and that of the acceleration 6 times. Rows without
a whole window are therefore left out, by default 0.7 s at each end, with all shorter stretches.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
import pandas as pd
import scipy  # loads signal and ndimage, which take a second, where they are used
from numpy.typing import NDArray
from pydantic import Field

from lcc_rl.arrays import Floats
from lcc_rl.data.episodes import MOTION_COLUMNS
from lcc_rl.data.grid import stretches
from lcc_rl.data.trajectories import FRAME, SAMPLE_KEYS, Trajectories, find_leaders
from lcc_rl.errors import ConfigError, DataError
from lcc_rl.settings import Settings


class SavitzkyGolay(Settings):
    """Local polynomial fits of positions.

    Speed and acceleration are the derivatives of the polynomial. Called with trajectories.
    """

    # Length of the window [s], rounded up to an odd number of frames.
    window_s: Annotated[float, Field(gt=0.0, lt=600.0)] = 1.5
    order: Annotated[int, Field(ge=2, le=100)] = 3  # order of the polynomial

    def validate(self) -> None:
        if self.window_s < FRAME * (self.order + 1):
            raise ConfigError(
                f"smoothing.window_s must be at least {FRAME * (self.order + 1):g} s for order "
                f"{self.order}, got {self.window_s}"
            )

    def __call__(self, trajectories: Trajectories) -> Trajectories:
        """Return smoothed trajectories; the argument is not changed.

        Rows within ``margin`` of an end of a stretch are left out. Negative smoothed speeds, as at
        standstill, are set to zero. The report counts both.

        Raises:
            DataError: if no stretch is long enough.
        """
        samples = trajectories.samples
        starts, lengths = stretches(samples["segment"].to_numpy())
        kinematics = self.smooth(samples["position_m"].to_numpy(dtype=float))
        inner = _within(starts, lengths) >= self.margin
        if not inner.any():
            raise DataError(
                f"{', '.join(trajectories.report.files)}: no stretch is long enough for {self}: "
                f"the longest has {lengths.max()} frames, {2 * self.margin + 1} are needed"
            )
        samples = samples[inner].reset_index(drop=True)
        names = ("position_m", "speed_mps", "acceleration_mps2")
        for name, smoothed in zip(names, kinematics, strict=True):
            samples[name] = smoothed[inner].astype(np.float32)
        backward = samples["speed_mps"] < 0.0
        samples.loc[backward, "speed_mps"] = 0.0
        codes, *keys = (samples[key] for key in SAMPLE_KEYS)
        leader = find_leaders(codes.cat.codes.to_numpy(), *(key.to_numpy() for key in keys))
        position = samples["position_m"].to_numpy()
        headway = np.where(leader >= 0, position[leader] - position, samples["space_headway_m"])
        samples["space_headway_m"] = headway.astype(np.float32)
        note = (
            f"smoothed with {self}: {int(backward.sum()):,} speeds below zero became zero; left "
            f"out {int((~inner).sum()):,} rows within {self.margin * FRAME:.1f} s of the end of a "
            f"stretch, {int((lengths <= 2 * self.margin).sum()):,} stretches entirely"
        )
        report = trajectories.report
        return Trajectories(samples, replace(report, notes=[*report.notes, note]))

    @property
    def window(self) -> int:
        """Frames of the window."""
        return round(self.window_s / FRAME) | 1

    @property
    def margin(self) -> int:
        """Rows at each end of a stretch without a whole window."""
        return self.window // 2

    def smooth(self, position: Floats) -> tuple[Floats, Floats, Floats]:
        """Smooth concatenated stretches as one.

        Args:
            position: positions ``[rows]`` [m].

        Returns:
            Position [m], speed [m/s] and acceleration [m/s²], each ``[rows]``; values within
            ``margin`` rows of an end are not used.
        """
        settings = {"polyorder": self.order, "delta": FRAME, "mode": "nearest"}
        smoothed, speed, acceleration = (
            scipy.signal.savgol_filter(position, self.window, deriv=order, **settings)
            for order in range(3)
        )
        return smoothed, speed, acceleration


def _within(starts: NDArray[np.intp], lengths: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the number of rows between each row and the nearer end of its stretch."""
    place = np.arange(lengths.sum()) - np.repeat(starts, lengths)
    return np.minimum(place, np.repeat(lengths, lengths) - 1 - place)


def averaged(episodes: pd.DataFrame, seconds: float, source: str) -> tuple[pd.DataFrame, str]:
    """Return centred moving averages of the motion of episodes, and a line on rows left out.

    Speeds, gaps and positions have the same average, so gaps still agree with speeds. Rows without
    a whole window are left out.

    Args:
        episodes: see :data:`lcc_rl.data.episodes.SCHEMA`; not changed.
        seconds: width of the window [s], rounded up to an odd number of frames.
        source: the file or files, for messages.

    Raises:
        DataError: if no episode is long enough.
    """
    width = round(seconds / FRAME) | 1
    starts, lengths = stretches(episodes["episode"].to_numpy())
    inner = _within(starts, lengths) >= width // 2
    if not inner.any():
        longest = FRAME * lengths.max()
        raise DataError(
            f"{source}: the longest episode has {longest:.1f} s, data.average_s={seconds:g}"
        )
    motion = episodes[MOTION_COLUMNS].to_numpy(np.float64)
    motion = scipy.ndimage.uniform_filter1d(motion, width, axis=0)[inner]
    columns = dict(zip(MOTION_COLUMNS, motion.astype(np.float32).T, strict=True))
    line = (
        f"averaged over {width * FRAME:.1f} s: left out {int((~inner).sum()):,} rows at the ends "
        f"of episodes, {int((lengths < width).sum()):,} episodes entirely"
    )
    return episodes[inner].reset_index(drop=True).assign(**columns), line
