"""Space-time diagrams that unroll with time, side by side, as an SVG or a GIF."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from lcc_rl.errors import ConfigError
from lcc_rl.figures.space_time import side_by_side
from lcc_rl.results.motion import SampleMotion

DPI, HIGH = 160, 3.4  # resolution [1/inch] and height [inches] of the picture
POINTS = 400  # most points of a line
SECONDS, HELD, FRAMES = 12.0, 3.0, 60  # time of unrolling, pause [s]; frames of a GIF
PAPER, COLOURS = "#ffffff", 255

Box = tuple[float, float, float, float]  # left, top, right, bottom [px]


def unroll(motions: Mapping[str, SampleMotion], path: Path, ending: str) -> None:
    """Write diagrams that appear from left to right.

    Args:
        motions: motions on an open road with equal times, by title.
        path: the file.
        ending: ``.svg`` or ``.gif``.

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
    figure = side_by_side(short, HIGH)
    figure.set_dpi(DPI)
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
