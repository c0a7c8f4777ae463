"""Animations of sample episodes: an offline page, an SVG, a GIF or an MP4."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import (
    Image,  # comes with matplotlib
    ImageDraw,
)

from lcc_rl.assets import page_of
from lcc_rl.errors import ConfigError, unknown_name
from lcc_rl.figures.drawing import INK, PAGE_WIDTH, legend_above, new_figure, paper
from lcc_rl.figures.space_time import SPEED_COLOURS, side_by_side
from lcc_rl.functional.pattern import AUTOMATED, HUMAN
from lcc_rl.io.atomic import atomic_path
from lcc_rl.results.motion import MotionSeries, SampleMotion

ANIMATION_FORMATS = (".html", ".svg", ".gif", ".mp4")
ROLE_COLOURS = {"leader": INK, AUTOMATED: "#0072b2", HUMAN: "#d55e00"}
ROLE_WORDS = ("human driver", "controlled car")  # in baselines, humans may drive it
LARGEST_PAGE = 50_000  # most samples of a page, each a speed and a gap
FEW_VEHICLES = 6  # most vehicles for which all lines are thick
FRAME_RATE, MOST_FRAMES = 10, 150  # frames per second; most frames
DPI = 100


def animate(motions: Mapping[str, SampleMotion], path: str | Path) -> Path:
    """Write an animation; the ending selects the format.

    A page (``.html``) plays in any browser and has a slider. A ``.gif`` or ``.mp4`` plays long
    episodes faster and shows the factor. These formats show one episode. An ``.svg`` shows rings
    side by side. For open roads an ``.svg``, or a ``.gif`` of several episodes, shows space-time
    diagrams that unroll.

    Args:
        motions: episodes of at least two samples, by title.
        path: the file; an existing one is replaced.

    Returns:
        The path.

    Raises:
        ConfigError: if the ending is unknown, the format does not support these episodes, or ffmpeg
            is missing.
        ResultsError: if the file cannot be written.
    """
    path = Path(path)
    check_ending(path, len(motions))
    (title, motion), *_ = motions.items()
    with atomic_path(path) as temporary:
        if path.suffix == ".html":
            temporary.write_text(page(motion, title), encoding="utf-8")
        elif path.suffix == ".svg" and motion.circumference is not None:
            temporary.write_text(ring_picture(motions), encoding="utf-8")
        elif path.suffix == ".svg" or len(motions) > 1:
            unroll(motions, temporary, path.suffix)
        elif path.suffix == ".gif":
            _write_gif(motion, title, temporary)
        else:
            _write_mp4(motion, title, temporary)
    return path


def check_ending(path: Path, episodes: int) -> None:
    """Check that an animation can be written in the format of its ending."""
    if path.suffix not in ANIMATION_FORMATS:
        raise unknown_name("ending of an animation", path.suffix, ANIMATION_FORMATS)
    if episodes > 1 and path.suffix not in (".svg", ".gif"):
        raise ConfigError(f"{path.suffix} shows one strategy; an .svg or a .gif shows several")
    if path.suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise ConfigError("an .mp4 needs ffmpeg, which is not installed; write a .html or .gif")


def page(motion: SampleMotion, title: str) -> str:
    """Return the page with all data."""
    # Fewest steps between samples within the largest size.
    every = -(-motion.speed.size // LARGEST_PAGE)
    short = motion.at(slice(None, None, every))
    data = {
        "title": title,
        "time": _numbers(short.time),
        "roles": [HUMAN if role == HUMAN else AUTOMATED for role in motion.roles],
        "speed": [_numbers(column) for column in short.speed.T],
        "gap": [_numbers(column) for column in short.gap.T],
        "front": _numbers(short.front),
        "leader": None if short.leader is None else _numbers(short.leader),
        "length": motion.lengths.tolist(),
        "circumference": motion.circumference,
        "colours": ROLE_COLOURS,
        "names": {"leader": "leader", AUTOMATED: ROLE_WORDS[1], HUMAN: ROLE_WORDS[0]},
    }
    return page_of("animation.html", data)


def _numbers(values: MotionSeries) -> list[float]:
    return [round(float(value), 2) for value in values]


def frames(motion: SampleMotion, title: str) -> Iterator[Figure]:
    """Yield the figure of an animation for every frame; it is one object."""
    count = min(max(round(FRAME_RATE * float(motion.time[-1] - motion.time[0])), 2), MOST_FRAMES)
    moments = np.linspace(0, len(motion.time) - 1, count).round().astype(int)
    faster = (motion.time[-1] - motion.time[0]) * FRAME_RATE / count
    figure = new_figure(PAGE_WIDTH, 6.6 if motion.circumference else 5.0)
    road, speeds, gaps = figure.subplots(
        3, 1, height_ratios=(3 if motion.circumference else 1, 2, 2)
    )
    figure.suptitle(f"{title}\n{faster:.1f} × as fast" if faster > 1.05 else title)
    _lines(speeds, motion, motion.speed, "speed [m/s]", motion.leader)
    _lines(gaps, motion, motion.gap, "gap ahead [m]", None)
    for line in legend_above(speeds).get_lines():
        line.set(linewidth=1.2, alpha=1.0)
    gaps.set_xlabel("time [s]")
    cursors = [axis.axvline(motion.time[0], color="#b00020", lw=0.8) for axis in (speeds, gaps)]
    place = _on_road(road, motion)
    place(0)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")  # the layout is fixed
    for moment in moments:
        place(int(moment))
        for cursor in cursors:
            cursor.set_xdata([motion.time[moment]] * 2)
        speeds.set_title(f"{motion.time[moment]:.1f} s", loc="right")
        yield figure


@paper
def road_picture(motion: SampleMotion) -> Any:
    """Return a picture of the road at the end of a motion, ``[height, width, 3]``, uint8."""
    figure = new_figure(PAGE_WIDTH, 5.8 if motion.circumference else 1.4)
    road = figure.subplots()
    road.set_title(f"{motion.time[-1]:.1f} s", loc="right")
    _on_road(road, motion)(len(motion.time) - 1)
    return _pixels(figure)[..., :3].copy()


def _pixels(figure: Figure) -> Any:
    figure.set_dpi(DPI)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]


def _on_road(road: Axes, motion: SampleMotion) -> Callable[[int], None]:
    """Draw the cars of a motion; return a function that places them for a sample."""
    cars = LineCollection([], linewidths=9.0, capstyle="butt")
    road.add_collection(cars)
    cars.set_color([*_hues(motion), *([] if motion.leader is None else [INK])])
    return partial(_around if motion.circumference else _along, road, cars, motion)


def _hues(motion: SampleMotion) -> list[str]:
    return [ROLE_COLOURS.get(role, ROLE_COLOURS[AUTOMATED]) for role in motion.roles]


def _lines(
    axis: Axes, motion: SampleMotion, values: MotionSeries, label: str, leader: MotionSeries | None
) -> None:
    """Draw an entry of all vehicles over time, automated ones above all others."""
    if leader is not None:
        axis.plot(motion.time, leader, color=INK, label="leader")
    named = set()
    for vehicle, (role, hue) in enumerate(zip(motion.roles, _hues(motion), strict=True)):
        bold = role != HUMAN or len(motion.roles) <= FEW_VEHICLES
        look: dict[str, Any] = {"zorder": 3} if bold else {"lw": 0.6, "alpha": 0.3}
        name = None if hue in named else ROLE_WORDS[role != HUMAN]
        named.add(hue)
        axis.plot(motion.time, values[:, vehicle], color=hue, label=name, **look)
    axis.set_xlim(motion.time[0], motion.time[-1])
    axis.set_ylim(0.0, 1.05 * max(float(values.max()), 1.0))
    axis.set_ylabel(label)


def _along(axis: Axes, cars: LineCollection, motion: SampleMotion, moment: int) -> None:
    """Place the cars on an open road in a view that moves with the leader."""
    front = float(motion.front[moment])
    fronts, first = [*motion.position[moment], front], motion.lengths[0]
    placed = zip(fronts, np.roll(motion.lengths, -1), strict=True)
    cars.set_segments([[(x - length, 0.0), (x, 0.0)] for x, length in placed])
    longest = float((motion.gap + motion.lengths[1:]).sum(axis=1).max())
    axis.set_xlim(front - longest - 2 * first, front + first)
    axis.set_ylim(-1.0, 1.0)
    axis.set_yticks([])
    axis.spines["left"].set_visible(False)
    axis.set_xlabel("position [m]")


def _around(axis: Axes, cars: LineCollection, motion: SampleMotion, moment: int) -> None:
    turn = 2.0 * np.pi / float(motion.circumference or 1.0)
    reach = np.linspace(-motion.lengths[1:], 0.0, 5, axis=1)
    angles = turn * (motion.position[moment][:, None] + reach)
    cars.set_segments(list(np.stack([np.cos(angles), np.sin(angles)], -1)))
    axis.set_aspect("equal")
    axis.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15))
    axis.axis("off")


@paper
def _write_gif(motion: SampleMotion, title: str, path: Path) -> None:
    images = []
    for figure in frames(motion, title):
        image = Image.fromarray(_pixels(figure)).convert("RGB")
        images.append(image.quantize(64, Image.Quantize.FASTOCTREE))
    settings = {"duration": 1000 // FRAME_RATE, "loop": 0, "optimize": True}
    images[0].save(path, "GIF", save_all=True, append_images=images[1:], **settings)


@paper
def _write_mp4(motion: SampleMotion, title: str, path: Path) -> None:
    writer = FFMpegWriter(fps=FRAME_RATE, extra_args=["-f", "mp4", "-pix_fmt", "yuv420p"])
    for number, figure in enumerate(frames(motion, title)):
        if number == 0:
            writer.setup(figure, str(path), dpi=DPI)
        writer.grab_frame()
    writer.finish()


# -- rings side by side, as an SVG -----------------------------------------------------------------

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
    last, pieces = len(motion.time) - 1, (motion.time[-1] - motion.time[0]) / KEY_STEP
    shown = motion.at(np.linspace(0, last, max(math.ceil(pieces), 1) + 1).round().astype(int))
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


# -- space-time diagrams that unroll with time, as an SVG or a GIF ---------------------------------

FINE, TALL = 160, 3.4  # resolution [1/inch] and height [inches] of the picture
POINTS = 400  # most points of a line
SECONDS, HELD, FRAMES = 12.0, 3.0, 60  # time of unrolling, pause [s]; frames of a GIF
PAPER, COLOURS = "#ffffff", 255

Box = tuple[float, float, float, float]  # left, top, right, bottom [px]


def unroll(motions: Mapping[str, SampleMotion], path: Path, ending: str) -> None:
    """Write diagrams that appear from left to right.

    Args:
        motions: motions on an open road with equal times, by title.
        path, ending: the file, and its format, ``.svg`` or ``.gif``.

    Raises:
        ConfigError: if a motion is on a ring.
    """
    if any(motion.circumference is not None for motion in motions.values()):
        raise ConfigError("a .gif shows one ring; an .svg shows several")
    picture, boxes = _picture(motions)
    if ending == ".svg":
        path.write_text(_svg(picture, boxes, "; ".join(motions)), encoding="utf-8")
        return
    frames = [_covered(picture, boxes, share) for share in np.linspace(0.0, 1.0, FRAMES)]
    duration = [round(1e3 * SECONDS / FRAMES)] * (FRAMES - 1) + [round(1e3 * HELD)]
    frames[0].save(path, "GIF", save_all=True, append_images=frames[1:], duration=duration, loop=0)


def _picture(motions: Mapping[str, SampleMotion]) -> tuple[Image.Image, list[Box]]:
    """Return the whole diagram and the boxes of its time axes."""
    every = max(len(next(iter(motions.values())).time) // POINTS, 1)
    short = {name: motion.at(slice(None, None, every)) for name, motion in motions.items()}
    figure = side_by_side(short, TALL)
    figure.set_dpi(FINE)
    axes = figure.axes[: len(motions)]
    for axis, motion in zip(axes, short.values(), strict=True):
        axis.set_xlim(motion.time[0], motion.time[-1])
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())  # type: ignore[attr-defined]
    extents, high = [axis.get_window_extent() for axis in axes], len(pixels)
    boxes = [(box.x0 + 1.0, high - box.y1, box.x1 + 1.0, high - box.y0 - 1.0) for box in extents]
    image = Image.fromarray(pixels).convert("RGB")
    return image.quantize(COLOURS, Image.Quantize.MEDIANCUT), boxes


def _covered(picture: Image.Image, boxes: list[Box], share: float) -> Image.Image:
    """Return the picture up to a share of the time."""
    image = picture.convert("RGB")
    for left, top, right, bottom in boxes:
        now = left + share * (right - left)
        ImageDraw.Draw(image).rectangle((now, top, max(right, now), bottom), PAPER)
    return image.quantize(palette=picture, dither=Image.Dither.NONE)


def _svg(picture: Image.Image, boxes: list[Box], title: str) -> str:
    """Return the picture under moving covers."""
    data = BytesIO()
    picture.save(data, "PNG", optimize=True)
    (wide, high), whole = picture.size, SECONDS + HELD
    times = f'keyTimes="0;{SECONDS / whole:g};1" dur="{whole:g}s" repeatCount="indefinite"'
    covers = [
        f'<rect y="{top:.1f}" height="{bottom - top:.1f}" fill="{PAPER}" x="{right:.1f}" width="0">'
        f'<animate attributeName="x" values="{left:.1f};{right:.1f};{right:.1f}" {times}/>'
        f'<animate attributeName="width" values="{right - left:.1f};0;0" {times}/></rect>'
        for left, top, right, bottom in boxes
    ]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide} {high}" width="{wide}" '
        f'height="{high}">\n<title>{escape(title)}</title>\n<image width="{wide}" height="{high}" '
        f'href="data:image/png;base64,{b64encode(data.getvalue()).decode()}"/>\n'
        + "\n".join(covers)
        + "\n</svg>\n"
    )
