"""Solvers of the field on the condensed QPs of many states, in one form.

Each function sets its solver up for the QPs of a `Condensed` with q (count, nz), l and u
(count, rows), and returns a call that solves them all: z (count, nz), y (count, rows) and status
(count,), SOLVED, EMPTY (infeasible) or another number.
"""

from collections.abc import Callable

import numpy as np
from scipy import sparse

from jaxmpc.mpc.condense import Condensed

SOLVED, EMPTY = 1, 3
Answers = tuple[np.ndarray, np.ndarray, np.ndarray]
Call = Callable[[], Answers]


def daqp_loop(c: Condensed, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> Call:
    """DAQP's dual active-set solver."""
    import daqp

    # DAQP takes memory that it may write to.
    P, A, sense = np.array(c.P), np.array(c.C), np.zeros(len(c.lower), np.int32)

    def call() -> Answers:
        found = [daqp.solve(P, q[i], A, u[i], l[i], sense) for i in range(len(q))]
        z, y = np.array([f[0] for f in found]), np.array([f[3]["lam"] for f in found])
        return z, y, np.array([{1: SOLVED, -1: EMPTY}.get(f[2], 0) for f in found])

    return call


def piqp_loop(c: Condensed, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> Call:
    """PIQP's dense interior-point solver, set up once and updated."""
    import piqp

    solver = piqp.DenseSolver()
    solver.settings.eps_abs, solver.settings.eps_rel = 1e-8, 0.0
    solver.setup(c.P, q[0], None, None, c.C, l[0], u[0])

    def call() -> Answers:
        z, y, status = np.zeros_like(q), np.zeros_like(l), np.zeros(len(q), int)
        for i in range(len(q)):
            solver.update(c=q[i], h_l=l[i], h_u=u[i])
            ended = solver.solve()
            z[i], y[i] = solver.result.x, solver.result.z_u - solver.result.z_l
            solved = ended == piqp.PIQP_SOLVED
            status[i] = SOLVED if solved else EMPTY * (ended == piqp.PIQP_PRIMAL_INFEASIBLE)
        return z, y, status

    return call


def osqp_loop(c: Condensed, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> Call:
    """OSQP, set up once and updated, at 1e-6."""
    import osqp

    solver = osqp.OSQP()
    upper, A = sparse.csc_matrix(np.triu(c.P)), sparse.csc_matrix(c.C)
    solver.setup(
        upper, q[0], A, l[0], u[0], eps_abs=1e-6, eps_rel=0.0, max_iter=20_000, verbose=False
    )

    def call() -> Answers:
        z, y, status = np.zeros_like(q), np.zeros_like(l), np.zeros(len(q), int)
        for i in range(len(q)):
            solver.update(q=q[i], l=l[i], u=u[i])
            result = solver.solve()
            z[i], y[i], status[i] = result.x, result.y, result.info.status_val
        return z, y, status

    return call


def moreau_batch(c: Condensed, q: np.ndarray, l: np.ndarray, u: np.ndarray) -> Call:
    """Moreau's batched CPU solver at its default tolerance."""
    import moreau

    P, A = sparse.csr_matrix(c.P), sparse.csr_matrix(np.vstack([c.C, -c.C]))
    b, m = np.hstack([u, -l]), len(c.lower)
    solver = moreau.CompiledSolver(
        n=P.shape[0], m=A.shape[0], P_row_offsets=P.indptr, P_col_indices=P.indices,
        A_row_offsets=A.indptr, A_col_indices=A.indices,
        cones=moreau.Cones(num_nonneg_cones=A.shape[0]),
        settings=moreau.Settings(device="cpu", batch_size=len(q)),
    )  # fmt: skip
    solver.setup(P.data, A.data)

    def call() -> Answers:
        solution = solver.solve(q, b)
        s = np.asarray(solution.z)
        names = [str(v).rsplit(".", 1)[-1] for v in solver.info.status]
        status = [{"Solved": SOLVED, "PrimalInfeasible": EMPTY}.get(name, 0) for name in names]
        return np.asarray(solution.x), s[:, :m] - s[:, m:], np.array(status)

    return call
