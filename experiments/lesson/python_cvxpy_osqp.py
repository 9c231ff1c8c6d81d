"""Section 7: the joint's 50 steps to q = 1 rad in Python, CVXPY + OSQP beside jaxmpc.

The lesson's program, its constraints as it states them (limits at k = 0..N−1, none on x_N,
terminal cost Q), with OSQP once as CVXPY calls it and once at a tight tolerance. Each controller
drives its own loop.

    python experiments/lesson/python_cvxpy_osqp.py
"""

from dataclasses import dataclass

import jax
import numpy as np
import tyro
from lesson_joint import GOAL, SYSTEM, TAU_MAX, X_MAX, A, B, Q, R, joint, rows

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import simulate

TIGHT = {"eps_abs": 1e-10, "eps_rel": 1e-10, "max_iter": 100_000}


@dataclass(frozen=True)
class Settings:
    """steps: samples of the loop. every: print each so-manieth row. horizon: N."""

    steps: int = 50
    every: int = 1
    horizon: int = 20


def cvxpy_loop(s: Settings, **options) -> np.ndarray:
    """Torques (steps, 1) of the lesson's program; `options` go to OSQP. One parametrised problem
    in place of one problem a sample: the same QP, built once."""
    import cvxpy as cp

    N = s.horizon
    start, x, u = cp.Parameter(2), cp.Variable((2, N + 1)), cp.Variable((1, N))
    cost, constraints = 0, [x[:, 0] == start]
    for k in range(N):
        cost += cp.quad_form(x[:, k] - GOAL, Q) + cp.quad_form(u[:, k], R)
        constraints += [
            x[:, k + 1] == A @ x[:, k] + B @ u[:, k],
            cp.abs(x[:, k]) <= X_MAX,
            cp.abs(u[:, k]) <= TAU_MAX,
        ]
    cost += cp.quad_form(x[:, N] - GOAL, Q)
    problem = cp.Problem(cp.Minimize(cost), constraints)
    state, torques = np.zeros(2), []
    for _ in range(s.steps):
        start.value = state
        problem.solve(solver=cp.OSQP, warm_start=True, **options)
        if problem.status not in ("optimal", "optimal_inaccurate"):
            raise RuntimeError("MPC QP infeasible or solver failed")
        torques.append(u.value[:, 0])
        state = A @ state + B @ torques[-1]
    return np.array(torques)


def ours(s: Settings):
    """The same loop by jaxmpc."""
    controller = jm.Controller(joint(s.horizon))
    return simulate(controller, SYSTEM, np.zeros(2), s.steps, reference=GOAL)


def run(s: Settings) -> dict[str, np.ndarray]:
    """Print the lesson's table and the differences; return both loops."""
    loop = ours(s)
    tight, default = cvxpy_loop(s, **TIGHT), cvxpy_loop(s)
    print(rows(loop.states, loop.inputs, s.every))
    difference = lambda other: np.abs(np.asarray(loop.inputs) - other).max()
    print(f"\nlargest difference of a torque to CVXPY + OSQP, {s.steps} steps:")
    print(f"  eps 1e-10            {difference(tight):.1e} N m")
    print(f"  as the lesson calls  {difference(default):.1e} N m")
    return {"states": loop.states, "inputs": loop.inputs, "cvxpy": tight, "default": default}


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
