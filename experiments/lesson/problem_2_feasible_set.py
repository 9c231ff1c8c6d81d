"""Problem 2: where the limit |x| ≤ xmax holds decides the feasible set of x⁺ = x + u, |u| ≤ umax.

The lesson answers |x0| ≤ xmax + N·umax. That is right only if the limit is imposed at k = N alone:

    at k = N alone              xmax + N·umax        (N steps to come back)
    at k = 1..N                 xmax + umax          (one step to come back)
    at k = 0..N, or 0..N−1      xmax                 (x0 itself must keep it; u = 0 keeps it)
    at k = 0..N−1, |x_N| ≤ xf   min(xmax, xf + N·umax)

jaxmpc proves the boundary from both sides for each N, and labels a grid of states with proofs for
the longest. Problem 2 says k = 0..N, so its answer is |x0| ≤ xmax.

    python experiments/lesson/problem_2_feasible_set.py [--picture problem_2.png]
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """x_max, u_max: the limits. x_f: of the smaller terminal set. horizons: values of N, ascending.
    points: grid of initial states. picture: file to write, or none."""

    x_max: float = 1.0
    u_max: float = 0.15
    x_f: float = 0.2
    horizons: tuple[int, ...] = (1, 2, 4, 8)
    points: int = 401
    picture: Path | None = None


def cases(s: Settings) -> dict:
    """Name: (settings of the MPC, closed form of the largest |x0| as a function of N)."""
    limit, small = (jm.Box([-v], [v]) for v in (s.x_max, s.x_f))
    states = {"states": limit}
    return {
        "k = N alone": ({"terminal_set": limit}, lambda N: s.x_max + N * s.u_max),
        "k = 1..N": (
            {**states, "terminal_set": limit, "constrain_initial": False},
            lambda N: s.x_max + s.u_max,
        ),
        "k = 0..N": ({**states, "terminal_set": limit}, lambda N: s.x_max),
        "k = 0..N−1": (states, lambda N: s.x_max),
        f"k = 0..N−1, |x_N| ≤ {s.x_f}": (
            {**states, "terminal_set": small},
            lambda N: min(s.x_max, s.x_f + N * s.u_max),
        ),
    }


def integrator(s: Settings, N: int, settings: dict) -> jm.MPC:
    """The MPC problem of one case."""
    one = np.eye(1)
    return jm.MPC(
        jm.LinearSystem(one, one), one, one, horizon=N, inputs=jm.Box([-s.u_max], [s.u_max]),
        **settings,
    )  # fmt: skip


def run(s: Settings) -> dict[str, np.ndarray]:
    """Print the table; return for each case rows (N, closed form, proved inside, proved outside,
    wrong labels, undecided), the last two NaN where no grid was labelled."""
    span = 1.1 * (s.x_max + max(s.horizons) * s.u_max)
    x0s = jm.grid([-span], [span], (s.points,))
    table = {}
    print(f"{'limit holds at':24}{'N':>3}{'closed form':>13}{'proved inside':>16}{'outside':>16}")
    for name, (settings, closed_form) in cases(s).items():
        rows = []
        for N in s.horizons:
            mpc, exact = integrator(s, N, settings), closed_form(N)
            rays = jm.feasible.boundary(mpc, np.array([[1.0], [-1.0]]))
            inside = rays.center[0] + rays.directions[:, 0] * rays.inner
            outside = rays.center[0] + rays.directions[:, 0] * rays.outer
            rows.append([N, exact, np.abs(inside).min(), np.abs(outside).max(), np.nan, np.nan])
            print(f"{name:24}{N:3}{exact:13.4f}{rows[-1][2]:16.12f}{rows[-1][3]:16.12f}")
        label = jm.map_feasible_set(mpc, x0s).label
        truth = np.where(np.abs(x0s[:, 0]) <= exact, 1, -1)
        rows[-1][4:] = np.sum(label * truth == -1), np.sum(label == 0)
        print(f"{'':24}{s.points} states: {rows[-1][4]:.0f} wrong, {rows[-1][5]:.0f} undecided")
        table[name] = np.array(rows)
    if s.picture is not None:
        draw(s, table)
    return table


def draw(s: Settings, table: dict[str, np.ndarray]) -> None:
    """Left: largest |x0| against N for each index set. Right: why, from x0 on the book's bound."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    shapes = [("o", 7), ("s", 7), ("o", 12), ("v", 7), ("D", 5)]
    for (name, rows), (marker, size) in zip(table.items(), shapes, strict=True):
        left.plot(
            rows[:, 0], rows[:, 2], marker, ms=size, mfc="none", mew=1.5, label=f"limit at {name}"
        )
    N = np.linspace(0, max(s.horizons), 2)
    left.plot(N, s.x_max + N * s.u_max, "k--", lw=1, label="book: xmax + N umax")
    left.set(xlabel="horizon N", ylabel="largest feasible |x0|", ylim=(0, None))
    left.legend(fontsize=8)

    N = max(s.horizons)
    k = np.arange(N + 1)
    right.axhspan(-s.x_max, s.x_max, color="tab:green", alpha=0.15, label="|x| ≤ xmax")
    for x0, color, text in (
        (s.x_max + N * s.u_max, "tab:red", "book's bound"),
        (s.x_max + s.u_max, "tab:orange", "xmax + umax"),
        (s.x_max, "tab:green", "xmax"),
    ):
        x = np.maximum(x0 - k * s.u_max, 0.0)
        bad = x > s.x_max + 1e-9
        right.plot(k, x, "-", color=color, lw=1)
        right.plot(k[~bad], x[~bad], "o", color=color, label=f"fastest return from {text}")
        right.plot(k[bad], x[bad], "x", color=color, ms=8)
    right.plot([], [], "kx", ms=8, label="limit broken at this k")
    right.set(xlabel="step k", ylabel="x_k", title=f"N = {N}", ylim=(0, None))
    right.legend(fontsize=8)
    figure.savefig(s.picture, dpi=120)
    print(f"picture: {s.picture}")


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
