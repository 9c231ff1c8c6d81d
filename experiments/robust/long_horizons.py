"""One state's affine policy at long horizons: stage by stage, as one dense QP, and by Clarabel.

    python experiments/robust/long_horizons.py [masses, most steps of the dense QP, horizon ...]

Masses in a row between springs, two thirds of them pushed, |x| ≤ 2, |u| ≤ 0.8, a disturbance of
0.03 on every state. Clarabel (one thread) gets the sparse program: the dynamics of plan and columns
as equalities and T ≥ |s| for each entry. Seconds of processor time, of a second plan, and
of Clarabel without building the program. Then 1,000 sequences inside W and 1,000 of its vertices.
"""

import sys
import time

import clarabel
import numpy as np
import scipy.sparse as sp
from jax import block_until_ready, enable_x64
from scipy.linalg import expm

import jaxmpc as jm

X_MOST, U_MOST, W_MOST = 2.0, 0.8, 0.03


def problem(masses: int, N: int) -> jm.MPC:
    """Return the problem of so many masses."""
    n, m = 2 * masses, max(1, 2 * masses // 3)
    K = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    field = np.zeros((n + m, n + m))
    field[:masses, masses:n] = np.eye(masses)
    field[masses:n, :masses], field[masses:n, masses:n] = -K, -0.05 * np.eye(masses)
    field[masses:n, n:] = np.eye(masses)[:, :m]
    step = expm(0.3 * field)
    box = lambda size, count: jm.Box(-size * np.ones(count), size * np.ones(count))
    return jm.MPC(
        jm.LinearSystem(step[:n, :n], step[:n, n:]), np.eye(n), 0.1 * np.eye(m), horizon=N,
        states=box(X_MOST, n), inputs=box(U_MOST, m), policy="affine", disturbance=box(W_MOST, n),
    )  # fmt: skip


def by_clarabel(mpc: jm.MPC, x0: np.ndarray) -> tuple[float, float, int]:
    """Return Clarabel's cost, its seconds, and the number of variables."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    (n, m), N = B.shape, mpc.horizon
    size = n + m
    # Blocks (x_k, u_k) of the plan, k = 0 … N−1, then of column (j, g), k = j+1 … N−1, then its T.
    columns = [(j, g) for j in range(N - 1) for g in range(n)]
    first = size * N + size * np.concatenate([[0], np.cumsum([N - 1 - j for j, _ in columns])])
    entries = int(first[-1]) - size * N
    total = size * N + 2 * entries
    move = sp.csr_matrix(np.hstack([A, B]))
    rows, rhs = [], []

    def dynamics(start: int, steps: int, initial: np.ndarray) -> None:
        pick = sp.csr_matrix((np.ones(n), (np.arange(n), start + np.arange(n))), (n, total))
        rows.append(pick)
        rhs.append(initial)
        if steps > 1:
            along = sp.kron(sp.eye(steps - 1, steps), move)
            along = along - sp.kron(sp.eye(steps - 1, steps, 1), sp.eye(n, size))
            before = sp.csr_matrix((along.shape[0], start))
            after = sp.csr_matrix((along.shape[0], total - start - size * steps))
            rows.append(sp.hstack([before, along, after]))
            rhs.append(np.zeros(along.shape[0]))

    dynamics(0, N, x0)
    for (j, g), start in zip(columns, first, strict=False):
        dynamics(int(start), N - 1 - j, W_MOST * np.eye(n)[g])
    equalities = sum(len(v) for v in rhs)
    limit = np.tile(np.append(np.full(n, X_MOST), np.full(m, U_MOST)), N)
    plan = sp.eye(size * N)
    sums = sp.hstack([
        sp.kron(sp.eye(N - 1 - j, N, j + 1).T, sp.eye(size)) for j, _ in columns
    ])  # fmt: skip
    none = sp.csr_matrix((size * N, entries))
    apart = sp.csr_matrix((entries, size * N))
    for sign in (1, -1):
        rows.append(sp.hstack([sign * plan, none, sums]))
        rhs.append(limit)
        rows.append(sp.hstack([apart, sign * sp.eye(entries), -sp.eye(entries)]))
        rhs.append(np.zeros(entries))
    weights = np.tile(np.append(np.ones(n), 0.1 * np.ones(m)), N)
    P = sp.diags(np.append(2 * weights, np.zeros(2 * entries))).tocsc()
    C, c = sp.vstack(rows).tocsc(), np.concatenate(rhs)
    cones = [clarabel.ZeroConeT(equalities), clarabel.NonnegativeConeT(len(c) - equalities)]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.max_threads = 1
    begun = time.process_time()
    found = clarabel.DefaultSolver(P, np.zeros(total), C, c, cones, settings).solve()
    return found.obj_val, time.process_time() - begun, total


def timed(plan) -> tuple[jm.mpc.Plan, float]:
    """Return the result of a call, and its processor time."""
    begun = time.process_time()
    found = block_until_ready(plan())
    return found, time.process_time() - begun


def worst_violation(mpc: jm.MPC, plan: jm.mpc.Plan) -> float:
    """Return by how much 2,000 sequences break a limit at most, below 0 for not at all."""
    A, B = np.asarray(mpc.system.A), np.asarray(mpc.system.B)
    N, n = mpc.horizon, len(A)
    inside = np.random.default_rng(0).uniform(-W_MOST, W_MOST, (1000, N, n))
    w = np.concatenate([inside, W_MOST * np.sign(inside)])
    M = np.asarray(plan.feedback)
    u = np.asarray(plan.inputs) + np.tensordot(w, M, ((1, 2), (2, 3)))
    x, most = np.tile(np.asarray(plan.states[0]), (len(w), 1)), np.abs(u).max() - U_MOST
    for k in range(N):
        most = max(most, np.abs(x).max() - X_MOST)
        x = x @ A.T + u[:, k] @ B.T + w[:, k]
    return most


def main(masses: int, dense: int, horizons: list[int]) -> None:
    """Print a table with a row for each horizon."""
    titles = ("n m N", "stages: s, steps, status", "Clarabel: s, variables", "dense: s")
    print(*titles, "cost, less Clarabel's", "worst violation", sep=" | ")
    for N in horizons:
        mpc = problem(masses, N)
        n, m = np.shape(mpc.system.B)
        x0 = np.append(np.full(masses, 1.4), np.zeros(masses))
        with enable_x64():
            jm.mpc.solve_stagewise(mpc, x0 + 0.01)
            plan, seconds = timed(lambda mpc=mpc, x0=x0: jm.mpc.solve_stagewise(mpc, x0))
            cost, own, variables = by_clarabel(mpc, x0)
            other = "-"
            if dense >= N:
                controller = jm.Controller(mpc)
                controller.plan(x0 + 0.01)
                found, slow = timed(lambda controller=controller, x0=x0: controller.plan(x0))
                apart = float(np.abs(found.inputs - plan.inputs).max())
                other = f"{slow:.3f} (inputs apart {apart:.0e})"
        print(
            f"{n} {m} {N} | {seconds:.3f}, {int(plan.iterations)}, {int(plan.status)} | {own:.3f}, "
            f"{variables} | {other} | {float(plan.cost):.6f}, {float(plan.cost) - cost:.0e} | "
            f"{worst_violation(mpc, plan):.1e}",
            flush=True,
        )


if __name__ == "__main__":
    masses, dense, *horizons = [int(v) for v in sys.argv[1:]] or [2, 10, 5, 10, 20, 50]
    main(masses, dense, horizons)
