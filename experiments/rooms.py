"""Draw which room imports which, from the imports themselves: docs/assets/rooms.svg.

    python experiments/rooms.py

A room stands one line below the lowest room that imports it; arrows that follow from others are
left out.
"""

import ast
from html import escape
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PURPOSES = {
    "qp": "quadratic programs",
    "store": "blocks of results",
    "systems": "linear systems, LQR",
    "sets": "sets, linear programs",
    "mpc": "problems and plans",
    "robots": "models and physics",
    "feasible": "feasible sets, proofs",
    "verify": "the proofs again",
    "explicit": "explicit law, penalties",
    "closed_loop": "simulation",
    "recursion": "recursive feasibility",
    "tuning": "descent",
    "robot_maps": "prediction and robot",
    "export": "C code, programs",
    "workflow": "design, report",
    "app": "command line",
}
WIDTH, HEIGHT, ACROSS, DOWN = 176, 46, 206, 96


def imported(room: str) -> set[str]:
    """Return the rooms that the files of a room import."""
    found: set[str] = set()
    for path in (ROOT / "jaxmpc" / room).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            if isinstance(node, ast.Import):
                modules = [name.name for name in node.names]
            found |= {module.split(".")[1] for module in modules if module.startswith("jaxmpc.")}
    return found & PURPOSES.keys() - {room}


def reduced(below: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the arrows that do not follow from others."""

    def reach(room: str) -> set[str]:
        return below[room].union(*(reach(other) for other in below[room]))

    return {
        room: {b for b in rooms if not any(b in reach(other) for other in rooms - {b})}
        for room, rooms in below.items()
    }


def placed(arrows: dict[str, set[str]]) -> dict[str, tuple[float, int]]:
    """Return where each room stands: across, and how many lines below the top."""
    line: dict[str, int] = {}
    while len(line) < len(arrows):
        for room in arrows:
            above = {other for other in arrows if room in arrows[other]}
            if room not in line and above <= line.keys():
                line[room] = 1 + max((line[other] for other in above), default=-1)
    spots: dict[str, tuple[float, int]] = {}
    for depth in range(max(line.values()) + 1):
        here = [room for room in arrows if line[room] == depth]
        middle = {
            room: np.mean([spots[other][0] for other in spots if room in arrows[other]] or [0.0])
            for room in here
        }
        here.sort(key=lambda room: (middle[room], room))
        for i, room in enumerate(here):
            spots[room] = (ACROSS * (i - (len(here) - 1) / 2), depth)
    return spots


def drawn(arrows: dict[str, set[str]], spots: dict[str, tuple[float, int]]) -> str:
    """Return the picture as SVG."""
    left = min(x for x, _ in spots.values()) - WIDTH / 2 - 12
    right = max(x for x, _ in spots.values()) + WIDTH / 2 + 12
    bottom = max(depth for _, depth in spots.values()) * DOWN
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="{left:g} -12 {right - left:g} '
        f'{bottom + HEIGHT + 24:g}" font-family="sans-serif" text-anchor="middle">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 0L8 4L0 8z" fill="#456"/></marker></defs>',
        f'<rect x="{left:g}" y="-12" width="{right - left:g}" height="{bottom + HEIGHT + 24:g}" '
        'fill="white"/>',
    ]
    for room, below in arrows.items():
        x, y = spots[room][0], DOWN * spots[room][1] + HEIGHT
        for other in sorted(below):
            to, end = spots[other][0], DOWN * spots[other][1] - 2
            bend = (end - y) / 2
            parts.append(
                f'<path d="M{x:g} {y:g}C{x:g} {y + bend:g} {to:g} {end - bend:g} {to:g} {end:g}" '
                'fill="none" stroke="#456" stroke-width="1.2" marker-end="url(#tip)"/>'
            )
    for room, (x, depth) in spots.items():
        y = DOWN * depth
        parts.append(
            f'<rect x="{x - WIDTH / 2:g}" y="{y:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" '
            f'fill="#eef2f6" stroke="#456"/><text x="{x:g}" y="{y + 19:g}" font-size="15" '
            f'font-weight="bold" fill="#123">{room}</text><text x="{x:g}" y="{y + 37:g}" '
            f'font-size="13" fill="#123">{escape(PURPOSES[room])}</text>'
        )
    return "\n".join([*parts, "</svg>"]) + "\n"


if __name__ == "__main__":
    ARROWS = reduced({room: imported(room) for room in PURPOSES})
    (ROOT / "docs" / "assets" / "rooms.svg").write_text(drawn(ARROWS, placed(ARROWS)))
    for ROOM, BELOW in ARROWS.items():
        print(f"{ROOM} -> {', '.join(sorted(BELOW)) or '–'}")
