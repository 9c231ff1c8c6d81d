"""Random programs of every kind, of any rank, bounded, unbounded and infeasible: the status and the
optimal value of each against Clarabel."""

import clarabel
import numpy as np
import pytest
import scipy.sparse
from padded import solutions

import jaxmpc as jm
from jaxmpc import Status

# What ours may say where Clarabel is sure; a program can be infeasible with an infeasible dual.
EXPECTED = {
    "Solved": {Status.SOLVED},
    "PrimalInfeasible": {Status.PRIMAL_INFEASIBLE},
    "DualInfeasible": {Status.DUAL_INFEASIBLE, Status.PRIMAL_INFEASIBLE},
}


def draw(rng, n, m, scaled):
    """Return P of random rank, q, and m rows about a point: of one side, equal, free or moved away;
    scaled: in units a million apart."""
    M = rng.normal(size=(n, rng.integers(0, n + 1)))
    P, A = M @ M.T, rng.normal(size=(m, n)) * (rng.uniform(size=(m, n)) < rng.choice([0.3, 1.0]))
    v = A @ (rng.normal(size=n) * (rng.uniform() < 0.7))
    l, u = v - rng.choice([0, 0.5, 2.0], m), v + rng.choice([0, 0.5, 2.0], m)
    side = rng.integers(0, 4, m)
    l, u = np.where(side == 1, -np.inf, l), np.where(side == 2, np.inf, u)
    if rng.uniform() < 0.3:
        i, by = rng.integers(m), rng.choice([-3.0, 3.0])
        l[i], u[i] = l[i] + by, u[i] + by
    q = rng.normal(size=n) * (rng.uniform() < 0.85)
    if rng.uniform() < 0.4:  # in the range of the rows and of P: seldom unbounded
        q = P @ rng.normal(size=n) - A.T @ (rng.normal(size=m) * (rng.uniform(size=m) < 0.5))
    if scaled:
        d, e, c = (10.0 ** rng.uniform(-3, 3, k) for k in (n, m, 1))
        P, q, A, l, u = c * d[:, None] * P * d, c * d * q, e[:, None] * A * d, e * l, e * u
    return P, q, A, l, u


def by_clarabel(P, q, A, l, u):
    equal = l == u
    above, below = np.isfinite(u) & ~equal, np.isfinite(l) & ~equal
    G = scipy.sparse.csc_matrix(np.vstack([A[equal], A[above], -A[below]]))
    h = np.concatenate([u[equal], u[above], -l[below]])
    kinds = [(clarabel.ZeroConeT, equal.sum()), (clarabel.NonnegativeConeT, len(h) - equal.sum())]
    cones = [cone(int(size)) for cone, size in kinds if size]
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.max_iter = False, 500
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-10
    P = scipy.sparse.csc_matrix(np.triu(P))
    found = clarabel.DefaultSolver(P, q, G, h, cones, settings).solve()
    return str(found.status), found.obj_val


@pytest.mark.long
@pytest.mark.parametrize("scaled", [False, True])
@pytest.mark.parametrize(("n", "m"), [(4, 6), pytest.param(8, 5, marks=pytest.mark.slow)])
def test_random_programs(n, m, scaled):
    rng = np.random.default_rng(5)
    programs = [draw(rng, n, m, scaled) for _ in range(96)]
    found = solutions([jm.QP(*program) for program in programs])
    counts = dict.fromkeys(EXPECTED, 0)
    for program, status, cost in zip(programs, found.status, found.cost, strict=True):
        kind, value = by_clarabel(*program)
        if kind in EXPECTED:
            counts[kind] += 1
            assert status in EXPECTED[kind], (kind, counts)
            assert kind != "Solved" or abs(cost - value) <= 1e-6 * abs(value) + 1e-8
    assert min(counts["Solved"], counts["DualInfeasible"]) >= 8, counts


@pytest.mark.parametrize(("upper", "cost"), [(np.inf, 1e-3), (3.0, 1.0), (np.inf, 1e4)])
def test_programs_with_their_solution_at_zero(upper, cost):
    """z = 0 is optimal for 0 ≤ Az ≤ u where Pz + q + A'y = 0 with y ≤ 0, that is q = −A'y: every
    size of the pair vanishes there but the multipliers."""
    rng, n, m = np.random.default_rng(7), 4, 6

    def program():
        M = rng.normal(size=(n, n))
        A = np.vstack([np.eye(n), rng.normal(size=(2, n))]) * 10.0 ** rng.uniform(-2, 2, (m, 1))
        y = np.where(np.arange(m) < n, -rng.uniform(0.1, 1, m), 0.0)
        P, ends = cost * (M @ M.T + 0.1 * np.eye(n)), (np.zeros(m), np.full(m, upper))
        return jm.QP(P, -cost * A.T @ y, A, *ends)

    found = solutions([program() for _ in range(96)])
    assert (found.status == Status.SOLVED).all()
    assert np.abs(found.z).max() < 1e-9
