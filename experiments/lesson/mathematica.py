"""Section 11: the open-loop problem that the Mathematica program states, N = 10.

Limits at k = 0..N (the terminal state included), reference (1, 0), terminal cost Q, and its
answer u0Opt. As printed, that program does not run: `N` is protected in Mathematica (it is the
numerical value), `u = Array[u, N]` and `x = Array[x, N + 1]` refer to themselves without end, and
each x[k] would have to be a vector of two variables (Array[x, {n, 2}]); A . x + B . {u} is right.
NMinimize is Mathematica's own, so an independent QP with states as variables and the dynamics as
equations, as the program has them, stands in for it.

    python experiments/lesson/mathematica.py
"""

from dataclasses import dataclass

import independent
import jax
import numpy as np
import scipy
import tyro
from lesson_joint import GOAL, LIMITS, TAU_MAX, X_MAX, A, B, Q, R, joint

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """horizon: N. q, dq: the initial state, rad and rad/s."""

    horizon: int = 10
    q: float = 0.0
    dq: float = 0.0


def stated(s: Settings) -> tuple[np.ndarray, float]:
    """Torques (N,) and optimal cost of the program as stated, in its variables u and x.

    The dynamics E z = b are eliminated by a basis of the null space of E, not by prediction
    matrices: nothing is shared with the condensing that is tested.
    """
    N, x0 = s.horizon, np.array([s.q, s.dq])
    qp = independent.stack(A, B, Q, R, Q, N, x0, X_MAX, TAU_MAX, range(N + 1))
    goal = np.concatenate([np.zeros(N), np.tile(GOAL, N + 1)])
    f = -qp.H @ goal
    particular = np.linalg.lstsq(qp.E, qp.b, rcond=None)[0]
    basis = scipy.linalg.null_space(qp.E)
    w = independent.active_set(
        basis.T @ qp.H @ basis, basis.T @ (f + qp.H @ particular), qp.G @ basis,
        qp.h - qp.G @ particular,
    )  # fmt: skip
    z = particular + basis @ w
    return z[:N], float(0.5 * (z - goal) @ qp.H @ (z - goal))


def run(s: Settings) -> dict[str, np.ndarray]:
    """Print both plans; return them."""
    mpc = joint(s.horizon, terminal_set=LIMITS)
    plan = jm.solve(mpc, np.array([s.q, s.dq]), reference=GOAL)
    torques, cost = stated(s)
    ours = np.asarray(plan.inputs)[:, 0]
    print(f"{'k':>3}{'u_k [N m]':>12}{'stated QP':>12}{'difference':>12}")
    for k, (a, b) in enumerate(zip(ours, torques, strict=True)):
        print(f"{k:3}{a:12.6f}{b:12.6f}{abs(a - b):12.1e}")
    print(f"\nu0Opt = {ours[0]:.9f} N m, cost {float(plan.cost):.9f} (stated QP {cost:.9f})")
    print(jm.Status(int(plan.status)).sentence)
    return {"inputs": ours, "stated": torques, "cost": plan.cost, "stated_cost": cost}


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
