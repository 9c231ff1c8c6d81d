"""Colours and drawing functions that the plots share. No function shows a window."""

import re
import textwrap
from pathlib import Path
from typing import Any, BinaryIO

from matplotlib import font_manager, rc_context, rcParams
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.transforms import Bbox

from jaxmpc.pytrees import UNBROKEN

# Okabe and Ito's palette: distinct with any colour vision, and in grey by lightness.
INFEASIBLE, FEASIBLE, UNDECIDED = "#dddcd8", "#9fcbe6", "#f0d024"
OUTER, INNER, TERMINAL = "#d55e00", "#00486b", "#006f52"
# Plans that the solver did not solve: they say nothing about limits.
NOT_SOLVED = "#a05fa8"
EDGE = "#8a8a8a"
BEFORE, AFTER = "#d55e00", "#0072b2"

# Width in inches of a picture for a column of a paper.
COLUMN = 3.5

# Keyword arguments of Matplotlib.
Style = dict[str, Any]
GRID: Style = {"color": "#ececec", "lw": 0.7}
SET_POINT: Style = {"color": TERMINAL, "lw": 1.0, "ls": (0, (4, 2))}


def for_column() -> bool:
    """Return whether pictures are for a column: Matplotlib's figure.figsize is that narrow."""
    return rcParams["figure.figsize"][0] <= COLUMN


def save(figure: Any, path: Path | BinaryIO, name: str = "") -> list[str]:
    """Write a figure, cut to its content, at the width of a column just as wide, and return the
    names of the files. name: of the system, put before the first title.

    Letters that the usual font lacks are drawn with fonts that are installed and have them. Where
    Matplotlib's savefig.format is "pdf" or "svg", the picture is written beside it in that format;
    one of an earlier run in another format is removed.
    """
    if name:
        _put_before_title(figure, name)
    texts = [t for t in figure.findobj(Text) if not t.get_text().isascii()]
    families = [*rcParams["font.sans-serif"][:1], *_fonts_for("".join(t.get_text() for t in texts))]
    for found in texts:
        found.set_fontfamily(families)
    box: Any = fit_in_column(figure) if figure.get_figwidth() <= COLUMN else "tight"
    figure.savefig(path, format="png", dpi=150, bbox_inches=box, pad_inches=0.15)
    if not isinstance(path, Path):
        return []
    files = [str(path)]
    for suffix in ("pdf", "svg"):
        beside = path.with_suffix(f".{suffix}")
        if rcParams["savefig.format"] == suffix:
            # Type 42: conferences refuse the Type 3 that is Matplotlib's default.
            with rc_context({"pdf.fonttype": 42}):
                figure.savefig(beside, bbox_inches=box, pad_inches=0.05)
            files.append(str(beside))
        else:
            beside.unlink(missing_ok=True)
    return files


def _put_before_title(figure: Any, name: str) -> None:
    """Begin the first title of a figure, that of all panels if it has one, with a name."""
    ax = figure.axes[0]
    title = figure.get_suptitle() or ax.get_title(loc="left")
    if not title:
        return
    text = f"{name}: {title[0].lower()}{title[1:]}"
    if figure.get_suptitle():
        figure._suptitle.set_text(text)
    else:
        ax.set_title(text, loc="left", fontsize=8 if for_column() else 11)


def fit_in_column(figure: Any) -> Bbox:
    """Break titles that are wider than a figure, and make it as much higher; return what to cut
    out, in inches: its whole width, and the height of its content."""
    engine = figure.get_layout_engine()
    for layout in ("none", engine):  # beside words that are too wide there is no room for axes
        figure.set_layout_engine(layout)
        figure.draw_without_rendering()
        more = 0.16 * _break_titles(figure)  # a line of 8 points
        figure.set_figheight(figure.get_figheight() + more)
    figure.draw_without_rendering()
    content = figure.get_tightbbox()
    return Bbox([[0, content.y0 - 0.05], [figure.get_figwidth(), content.y1 + 0.05]])


def _break_titles(figure: Any) -> int:
    """Break titles that end beyond a figure; return by how many lines more."""
    lines = 0
    for title in (figure._suptitle, *(ax._left_title for ax in figure.axes)):
        if title is None or not title.get_text():
            continue
        box, text = title.get_window_extent(), title.get_text()
        if box.x1 > figure.bbox.x1:
            title.set_text(broken(text, (figure.bbox.x1 - box.x0) / box.width))
            lines += title.get_text().count("\n") - text.count("\n")
    return lines


def broken(text: str, room: float) -> str:
    """Return a text with more lines, each at most the share `room` as long as the longest one is:
    broken after commas and colons where that will do, else at spaces."""
    longest = max(int(0.95 * room * max(map(len, text.split("\n")))), 1)
    found = []
    for line in text.split("\n"):
        parts = re.sub(r"(?<![,:]) ", UNBROKEN, line)
        fits = max(map(len, parts.split(" ")), default=0) <= longest
        found += textwrap.wrap(parts if fits else line, longest) or [line]
    return "\n".join(found).replace(UNBROKEN, " ")


def _fonts_for(text: str) -> list[str]:
    """Return installed fonts that together have the letters that Matplotlib's own lacks."""
    own = font_manager.get_font(font_manager.findfont(rcParams["font.sans-serif"][0]))
    missing = {ord(letter) for letter in text if letter.isprintable()} - set(own.get_charmap())
    found = []
    for entry in font_manager.fontManager.ttflist if missing else ():
        if entry.weight != 400 or entry.style != "normal":
            continue
        has = missing & set(font_manager.get_font(entry.fname).get_charmap())
        if has:
            missing -= has
            found.append(entry.name)
        if not missing:
            break
    return found


def patch(name: str, colour: str, count: Any = None) -> Patch:
    """Return a legend entry for an area, with the number of samples that it stands for."""
    label = name if count is None else f"{name} ({count:,})"
    return Patch(facecolor=colour, edgecolor=EDGE, linewidth=0.6, label=label)
