"""Words on the frames of a video: robot, number, time, legend, and which limit is exceeded."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmpc.robots.robot import Robot
from jaxmpc.sets.violations import kept, row_violations

# The target has the colour of set-points in the plots; red is for limits alone.
INK, PAPER, RED, TARGET = (40, 40, 40), (255, 255, 255), (200, 20, 20), (0, 158, 115)


class Captions(NamedTuple):
    """What is written on F frames of B tiles: the robot's name, the numbers of the robots, the
    times (F,) in s, the name of the limit that is exceeded (B, F), "" for none, and whether there
    is a target."""

    robot: str
    numbers: Sequence[int]
    times: np.ndarray
    exceeded: np.ndarray
    has_target: bool


def captioned(
    film: np.ndarray, tiles: Sequence[tuple[int, int]], size: tuple[int, int], words: Captions
) -> np.ndarray:
    """Return the frames (F, h, w, 3) with a line above and a legend below.

    tiles: (top, left) of each of the B robots; size: (height, width) of a tile.
    """
    from PIL import Image, ImageDraw

    font = _font(round(np.clip(size[0] / 18, 12, 18)))
    line = font.size + 8
    legend = _lines(_legend(words.has_target), font, film.shape[2] - 8)
    room = ((0, 0), (line, line * len(legend)), (0, 0), (0, 0))
    film = np.pad(film, room, constant_values=255)
    edge = max(3, size[0] // 60)
    for k, frame in enumerate(film):
        picture = Image.fromarray(frame)
        draw = ImageDraw.Draw(picture)
        clock = f"{words.times[k]:.2f} s"
        draw.text((6, 3), words.robot, INK, font)
        draw.text((film.shape[2] - 6 - font.getlength(clock), 3), clock, INK, font)
        for (top, left), number, limit in zip(
            tiles, words.numbers, words.exceeded[:, k], strict=True
        ):
            top += line
            if limit:
                corners = (left, top, left + size[1] - 1, top + size[0] - 1)
                draw.rectangle(corners, outline=RED, width=edge)
                text = _fitting(f"beyond limit: {limit}", font, size[1] - 2 * edge - 8)
                _plate(draw, (left + edge, top + size[0] - edge - line), text, font, PAPER, RED)
            _plate(draw, (left + edge, top + edge), f"robot {number}", font, INK, PAPER)
        for i, entries in enumerate(legend):
            x, y = 6.0, film.shape[1] - line * (len(legend) - i) + 3
            for colour, text in entries:
                box = (x, y + 2, x + font.size - 2, y + font.size)
                draw.rectangle(box, colour if colour == TARGET else PAPER, colour, width=2)
                draw.text((x + font.size + 3, y), text, INK, font)
                x += _width((colour, text), font)
        frame[:] = np.asarray(picture)
    return film


def exceeded_limits(robot: Robot, states: np.ndarray, inputs: Any, every: int) -> np.ndarray:
    """Return which limit is exceeded, as a text (B, F), "" for none.

    It is the one that is exceeded most, as a fraction of half its range, at the samples from one
    frame to the next. states (B, T+1, nq + nv), inputs (B, T, m) or None.
    """
    with jax.enable_x64(True):
        xi = states
        if robot.n != robot.state_size:
            xi = np.asarray(jax.vmap(jax.vmap(robot.coordinates))(states))
    names = (*robot.state_names, *robot.input_names)
    units = (*robot.state_units, *robot.input_units)
    labels = [f"{n} [{unit}]" if unit else n for n, unit in zip(names, units, strict=True)]
    over = np.zeros((*xi.shape[:2], robot.n + robot.m))
    pairs = [(robot.state_limits, xi, slice(0, robot.n))]
    if inputs is not None:
        held = np.concatenate([inputs, inputs[:, -1:]], axis=1)
        pairs.append((robot.input_limits, held, slice(robot.n, None)))
    for limits, values, part in pairs:
        excess = row_violations(limits, values) / limits.half_widths()
        over[..., part] = np.where(kept(limits, values), 0.0, excess)
    worst = np.maximum.reduceat(over, np.arange(0, over.shape[1], every), axis=1)
    index = np.where(worst.max(axis=2) > 0, 1 + worst.argmax(axis=2), 0)
    return np.array(["", *labels])[index]


def _legend(has_target: bool) -> list[tuple[tuple[int, int, int], str]]:
    """Return the colours of the video and what they say."""
    target = [(TARGET, "see-through: target")] if has_target else []
    return [*target, (RED, "red frame: beyond a limit")]


def _lines(entries: list[Any], font: Any, width: float) -> list[list[Any]]:
    """Return the entries of the legend, divided into lines that fit."""
    lines: list[list[Any]] = [[]]
    for entry in entries:
        if lines[-1] and sum(_width(e, font) for e in [*lines[-1], entry]) > width:
            lines.append([])
        lines[-1].append(entry)
    return lines


def _width(entry: tuple[Any, str], font: Any) -> float:
    """Return the width of an entry of the legend, with the space that follows it."""
    return 2 * font.size + 4 + font.getlength(entry[1])


def _plate(draw: Any, place: tuple[int, int], words: str, font: Any, ink: Any, paper: Any) -> None:
    """Write words in a box whose upper left corner is `place`."""
    x, y = place
    draw.rectangle((x, y, x + font.getlength(words) + 8, y + font.size + 7), fill=paper)
    draw.text((x + 4, y + 3), words, ink, font)


def _fitting(words: str, font: Any, width: float) -> str:
    """Return the words, cut at the end to this width in pixels."""
    while len(words) > 1 and font.getlength(words) > width:
        words = words[:-2] + "…"
    return words


def _font(size: int) -> Any:
    """Return the font that matplotlib brings along: Pillow's own lacks most of Unicode."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(
        str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size
    )
