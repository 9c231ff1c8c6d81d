"""Colours and drawing functions that the plots share. No function shows a window."""

from pathlib import Path
from typing import Any, BinaryIO

from matplotlib import font_manager, rcParams
from matplotlib.patches import Patch
from matplotlib.text import Text

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


def save(figure: Any, path: Path | BinaryIO, name: str = "") -> None:
    """Write a figure, cut to its content. name: of the system, put before the first title.

    Letters that the usual font lacks are drawn with fonts that are installed and have them. Where
    Matplotlib's savefig.format is "pdf" or "svg", the picture is written beside it in that format;
    one of an earlier run in another format is removed.
    """
    if name and (title := figure.axes[0].get_title(loc="left")):
        text = f"{name}: {title[0].lower()}{title[1:]}"
        figure.axes[0].set_title(text, loc="left", fontsize=8 if for_column() else 11)
    texts = [t for t in figure.findobj(Text) if not t.get_text().isascii()]
    families = [*rcParams["font.sans-serif"][:1], *_fonts_for("".join(t.get_text() for t in texts))]
    for found in texts:
        found.set_fontfamily(families)
    figure.savefig(path, format="png", dpi=150, bbox_inches="tight", pad_inches=0.15)
    if not isinstance(path, Path):
        return
    for suffix in ("pdf", "svg"):
        beside = path.with_suffix(f".{suffix}")
        if rcParams["savefig.format"] == suffix:
            figure.savefig(beside, bbox_inches="tight", pad_inches=0.05)
        else:
            beside.unlink(missing_ok=True)


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
