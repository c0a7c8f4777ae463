"""An animated picture of the ring road as an SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape

from matplotlib.colors import to_hex

from lcc_rl.errors import ConfigError
from lcc_rl.figures.space_time import SPEED_COLOURS
from lcc_rl.functional.pattern import HUMAN
from lcc_rl.results.motion import MotionSeries, SampleMotion

SPEED_UP, KEY_STEP = 20.0, 1.5  # factor of the speed; time between key frames [s]
WIDE, HIGH = 330, 380  # size of a panel [px]
RADIUS, ROAD, CAR_SIZE = 118, 24, 12  # radius of the ring, widths of road and cars [px]
SVG_FRAME = """<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}" \
height="{high}" font-family="system-ui, 'Segoe UI', Roboto, sans-serif" text-anchor="middle">
<title>{title}</title>
<style>.card {{ fill: #fff; stroke: #dfe3e8 }} .road {{ stroke: #e4e7ec; fill: none }}
.name {{ fill: #1b1f24; font-weight: 600 }} .soft {{ fill: #5a6370 }} .mark {{ stroke: #0b5fc0 }}
.bar {{ fill: #0b5fc0 }}
@media (prefers-color-scheme: dark) {{ .card {{ fill: #181c22; stroke: #2b323b }}
.road {{ stroke: #2b323b }} .car {{ stroke: #ffffffa0; stroke-width: 1.2 }}
.name {{ fill: #e8ecf1 }} .soft {{ fill: #9ba6b4 }}
.mark {{ stroke: #6fb4ff }} .bar {{ fill: #6fb4ff }} }}</style>
<rect class="card" x=".5" y=".5" width="{inner}" height="{below}" rx="12"/>
{panels}
<g font-size="12">{time}</g>
</svg>
"""


def ring_picture(motions: Mapping[str, SampleMotion]) -> str:
    """Return an SVG of rings side by side; cars move and change their colour.

    Args:
        motions: motions with equal times, by title.

    Raises:
        ConfigError: if a motion is not of a ring road.
    """
    if any(motion.circumference is None for motion in motions.values()):
        raise ConfigError("an .svg shows rings or open roads, not both")
    top = max(float(motion.speed.max()) for motion in motions.values())
    panels = [_panel(*item, place, top) for place, item in enumerate(motions.items())]
    wide = WIDE * len(motions)
    size = {"wide": wide, "high": HIGH, "inner": wide - 1, "below": HIGH - 1}
    bar = _bar(next(iter(motions.values())), wide)
    title = escape("; ".join(motions))
    return SVG_FRAME.format(**size, title=title, panels="\n".join(panels), time=bar)


def _panel(name: str, motion: SampleMotion, place: int, top: float) -> str:
    """Return one ring with its cars."""
    step = float(motion.time[1] - motion.time[0])
    shown = motion.at(slice(None, None, max(round(KEY_STEP / step), 1)))
    turn = 360.0 / float(motion.circumference or 1.0)  # of a metre [degrees]
    angles = -turn * (shown.position - 0.5 * motion.lengths[1:])
    long = math.radians(turn) * RADIUS * motion.lengths[1:]
    cars = [
        _car(role != HUMAN, angles[:, car], shown.speed[:, car] / top, long[car], _time_of(motion))
        for car, role in enumerate(motion.roles)
    ]
    last = motion.speed[motion.time > motion.time[-1] - 60.0]
    return (
        f'<g transform="translate({WIDE * (place + 0.5)} 192)">'
        f'<text class="name" y="-156" font-size="16">{escape(name)}</text>'
        f'<circle class="road" r="{RADIUS}" stroke-width="{ROAD}"/>\n'
        + "\n".join(cars)
        + f'<text class="name" y="4" font-size="26">{3.6 * last.mean():.1f} km/h</text>'
        '<text class="soft" y="26" font-size="13">mean speed in the end</text></g>'
    )


def _car(marked: bool, angles: MotionSeries, shares: MotionSeries, long: float, time: str) -> str:
    """Return a car with angles over time [degrees], coloured by shares of the top speed."""
    hues = ";".join(to_hex(SPEED_COLOURS(share)) for share in shares)
    mark = (
        f'<circle class="mark" cx="{RADIUS}" r="{0.8 * long:.1f}" fill="none" stroke-width="2.5"/>'
    )
    return (
        f'<g>{mark * marked}<rect class="car" x="{RADIUS - CAR_SIZE / 2}" y="{-long / 2:.1f}" '
        f'width="{CAR_SIZE}" height="{long:.1f}" rx="3.5">'
        f'<animate attributeName="fill" {time} values="{hues}"/></rect>'
        f'<animateTransform attributeName="transform" type="rotate" {time} '
        f'values="{";".join(f"{angle:.1f}" for angle in angles)}"/></g>'
    )


def _time_of(motion: SampleMotion) -> str:
    duration = (motion.time[-1] - motion.time[0]) / SPEED_UP
    return f'dur="{duration:.2f}s" repeatCount="indefinite"'


def _bar(motion: SampleMotion, wide: int) -> str:
    """Return a bar that grows with the time."""
    first, last = float(motion.time[0]), float(motion.time[-1])
    room, low = wide - 80, HIGH - 34
    ticks = [
        f'<text class="soft" x="{40 + room * (60.0 * minute - first) / (last - first):.0f}" '
        f'y="{low + 20}">{minute} min</text>'
        for minute in range(math.ceil(first / 60.0), math.floor(last / 60.0) + 1)
    ]
    return (
        f'<path class="road" d="M40 {low + 2}h{room}" stroke-width="4"/>'
        f'<rect class="bar" x="40" y="{low}" height="4" width="0" rx="2">'
        f'<animate attributeName="width" {_time_of(motion)} values="0;{room}"/></rect>'
        + "".join(ticks)
    )
