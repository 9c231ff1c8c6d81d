"""Feasible sets of problems whose limits and dynamics differ from step to step: labels beside
linear programs over all trajectories, and proofs in exact arithmetic."""

import jax
import numpy as np
import scipy
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidate_search import cut_of
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.verify.exact import beyond, roll_out_exactly
from jaxmpc.verify.half_space_search import Programs
from jaxmpc.verify.stored_problem import Constraints, label_shapes

n, m, N = 2, 1, 4
RANDOM = np.random.default_rng(3)
A = np.array([[1.0, 0.3], [0.1, 1.1]]) + 0.1 * RANDOM.normal(size=(N, n, n))
B = RANDOM.normal(size=(N, n, m))
C = 0.05 * RANDOM.normal(size=(N, n))
LOWER, UPPER = -1 - 0.3 * np.arange(N)[:, None] * np.ones(n), np.full(n, 1.5)
U_UPPER = np.array([[0.6], [0.4], [0.5], [0.2]])
H, D = RANDOM.normal(size=(N, 1, n)), RANDOM.normal(size=(N, 1, m))
MPC = jm.MPC(
    jm.LinearSystem(A, B, C), np.eye(n), np.eye(m), N, states=jm.Box(LOWER, UPPER),
    inputs=jm.Box(np.array([-0.5]), U_UPPER), outputs=jm.Outputs(H, upper=[0.9], D=D),
    terminal_set=jm.Box(-0.8, 0.8),
)  # fmt: skip


def least_violation(x0: np.ndarray) -> float:
    """Return the least t with which some inputs keep all rows to within t, by one linear program in
    the inputs."""
    G, g = [], []
    gain, x = np.zeros((n, N * m)), x0
    for k in range(N + 1):
        last = k == N
        u = np.eye(m, N * m, k * m) if not last else np.zeros((m, N * m))
        upper, lower = (UPPER, LOWER[k]) if not last else (np.full(n, 0.8), np.full(n, -0.8))
        G += [gain, -gain]
        g += [upper - x, x - lower]
        if not last:
            G += [u, -u, H[k] @ gain + D[k] @ u]
            g += [U_UPPER[k], np.array([0.5]), 0.9 - H[k] @ x]
            gain, x = A[k] @ gain + B[k] @ u, A[k] @ x + C[k]
    G, g = np.vstack(G), np.concatenate(g)
    rows = np.hstack([G, -np.ones((len(G), 1))])
    free = [(None, None)] * (N * m + 1)
    return scipy.optimize.linprog(np.eye(N * m + 1)[-1], rows, g, bounds=free).fun


POINTS = RANDOM.uniform(-2, 2, (24, n))
VIOLATION = np.array([least_violation(x) for x in POINTS])


def test_proofs_are_those_of_exact_arithmetic():
    """Plans and half-spaces of linear programs, proved in floats and in fractions."""
    assert np.sum(VIOLATION < -1e-3) > 4 < np.sum(VIOLATION > 1e-3)
    view = FeasibilityProblem.of(MPC)
    exact = view.exact(np.full(n, 2.0))
    stored = view.plain()
    assert label_shapes({"problem": stored})["plan"] == (N, m)
    q = Constraints(stored)
    programs, rows = view.programs, view.rows
    box = Programs(q).boxes()
    with enable_x64(True):
        plan = jax.jit(lambda x, u: proofs.prove_feasible(exact, x, x[:0], u))
        cut = jax.jit(lambda y: cut_of(exact, rows, y))
        for x, violation in zip(POINTS, VIOLATION, strict=True):
            w, y = programs.margin(x, np.ones(len(rows.lower)))
            inputs = rows.Psi @ x + rows.Omega @ (rows.back @ w) + rows.psi
            proved, inputs = map(np.asarray, plan(x, inputs))
            assert proved == (violation < 0), violation
            if proved:
                assert roll_out_exactly(q, x[None], inputs[None])[0] >= 0
            excluded = max(float(proofs.excludes(*cut(s * y), x)) for s in (1.0, -1.0))
            assert excluded == (violation > 0), violation
    for x, violation in zip(POINTS[:8], VIOLATION[:8], strict=True):
        found = [beyond(q, y, x[None], box)[0] for y in Programs(q).multipliers(x, 0 * x)]
        assert (max(found, default=-np.inf) > 0) == (violation > 0)


def test_sets_of_constant_data_with_a_leading_axis_are_the_same():
    each = lambda v: np.repeat(np.asarray(v, float)[None], N, axis=0)
    one = jm.MPC(
        jm.LinearSystem(A[0], B[0]), np.eye(n), np.eye(m), N, jm.Box([-1, -1], [1, 1]),
        jm.Box([-0.5], [0.5]), input_rate_limit=[0.3], terminal_set=jm.Box(-0.8, 0.8),
    )  # fmt: skip
    box = jm.Polytope(each([[1, 0], [0, 1], [-1, 0], [0, -1]]), np.ones(4))
    same = jm.MPC(
        jm.LinearSystem(each(A[0]), each(B[0])), np.eye(n), np.eye(m), N, box,
        jm.Box(each([-0.5]), each([0.5])), input_rate_limit=each([0.3]),
        terminal_set=jm.Box(-0.8, 0.8),
    )  # fmt: skip
    a, b = jm.feasible_polytope(one), jm.feasible_polytope(same)
    assert a.is_subset(b) and b.is_subset(a)
