"""Nonlinear MPC from many random starts: solved, cost and time, beside IPOPT.

For each problem of `problems.py`: all starts in one batch from the state at rest, then IPOPT
(CasADi, exact second derivatives, MUMPS) for some of them one after the other, from the same
point. A local optimum depends on the path; costs are compared where both solvers end at one.

    python experiments/nonlinear/benchmark.py --count 1024
"""

import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import tyro
from problems import PROBLEMS, Published

import jaxmpc as jm
from jaxmpc.mpc import solve_nonlinear


@dataclass(frozen=True)
class Settings:
    """count: random starts. ipopt: how many of them IPOPT solves too, 0 for none. steps: QPs at
    most."""

    problems: tuple[str, ...] = tuple(PROBLEMS)
    count: int = 1024
    ipopt: int = 32
    steps: int = 100
    hessian: str = "exact"
    seed: int = 0


def by_ipopt(published: Published) -> Any:
    """Return x0 -> (cost, seconds, solved) by CasADi and IPOPT."""
    import casadi as ca

    n, m, N = len(published.Q), len(published.R), published.horizon
    x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
    stack = lambda parts: ca.vertcat(*parts)
    step = ca.Function("step", [x, u], [published.step(x, u, ca, stack)])
    opti = ca.Opti()
    X, U, start = opti.variable(n, N + 1), opti.variable(m, N), opti.parameter(n)
    J = 0
    form = lambda W, v: ca.dot(ca.DM(W) * v, v)
    for k in range(N):
        opti.subject_to(X[:, k + 1] == step(X[:, k], U[:, k]))
        J += form(published.Q, X[:, k] - published.target)
        J += form(published.R, U[:, k] - published.middle)
        low, high = published.middle - published.limit, published.middle + published.limit
        opti.subject_to(opti.bounded(low, U[:, k], high))
        if published.distance is not None:
            opti.subject_to(stack(published.distance(X[:, k + 1], ca)) >= 0)
    opti.minimize(J + form(published.P, X[:, N] - published.target))
    opti.subject_to(X[:, 0] == start)
    quiet = {"print_level": 0, "tol": 1e-8, "max_iter": 500, "sb": "yes"}
    opti.solver("ipopt", {"print_time": False, "expand": True}, quiet)

    def solve(x0: np.ndarray) -> tuple[float, float, bool]:
        opti.set_value(start, x0)
        opti.set_initial(X, np.tile(x0[:, None], (1, N + 1)))
        opti.set_initial(U, np.tile(published.middle[:, None], (1, N)))
        begin = time.perf_counter()
        try:
            opti.solve()
            solved = True
        except RuntimeError:
            solved = False
        return float(opti.debug.value(opti.f)), time.perf_counter() - begin, solved

    return solve


def run(s: Settings) -> None:
    """Print one line for each problem."""
    print(f"{'':10}{'starts':>7}{'solved':>9}{'QPs: median, 90 %, most':>25}{'ms a start':>12}"
          f"{'compile':>9}{'one start':>11}{'IPOPT: solved':>15}{'ms':>8}{'same cost':>11}"
          f"{'lower':>7}{'higher':>8}")  # fmt: skip
    for name in s.problems:
        published = PROBLEMS[name]
        problem, rng = published.problem(), np.random.default_rng(s.seed)
        starts = np.array([published.start(rng) for _ in range(s.count)])
        one = lambda x, published=published, problem=problem: solve_nonlinear(
            problem, x, published.target, input_reference=published.middle, iterations=s.steps,
            hessian=s.hessian,
        )  # fmt: skip
        many = jax.jit(jax.vmap(one))
        seconds = []
        for _ in range(2):
            begin = time.perf_counter()
            plans = jax.block_until_ready(many(starts))
            seconds.append(time.perf_counter() - begin)
        alone = []
        for x in (starts[0], *starts[:10]):
            begin = time.perf_counter()
            jax.block_until_ready(one(x))
            alone.append(time.perf_counter() - begin)
        solved = np.asarray(plans.status) == jm.Status.SOLVED
        counts = np.percentile(plans.iterations, [50, 90, 100])
        text = (
            f"{name:10}{s.count:7}{solved.mean():9.2%}{counts[0]:13.0f},{counts[1]:5.0f},"
            f"{counts[2]:5.0f}{1e3 * seconds[1] / s.count:12.3f}{seconds[0] - seconds[1]:8.1f}s"
            f"{1e3 * np.median(alone[1:]):9.1f}ms"
        )
        if s.ipopt:
            solve = by_ipopt(published)
            theirs = [solve(x) for x in starts[: s.ipopt]]
            both = np.array([ok for *_, ok in theirs]) & solved[: s.ipopt]
            ratio = np.array([J for J, *_ in theirs]) / np.asarray(plans.cost)[: s.ipopt]
            same = np.abs(ratio - 1) < 1e-5
            share, median = np.mean([ok for *_, ok in theirs]), np.median([t for _, t, _ in theirs])
            lower, higher = (np.sum(both & ~same & side) for side in (ratio > 1, ratio < 1))
            text += f"{share:15.1%}{1e3 * median:8.1f}{np.sum(both & same):7}/{both.sum()}"
            text += f"{lower:7}{higher:8}"
        print(text, flush=True)


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
