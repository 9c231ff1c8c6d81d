"""Solutions that bounds hold at zero: every size of the pair vanishes there but the multipliers."""

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc import Status


@pytest.mark.parametrize(("upper", "cost"), [(np.inf, 1e-3), (3.0, 1.0), (np.inf, 1e4)])
def test_programs_with_their_solution_at_zero(upper, cost):
    """z = 0 is optimal for 0 ≤ Az ≤ u where Pz + q + A'y = 0 with y ≤ 0, that is q = −A'y."""
    rng, n, rows = np.random.default_rng(7), 6, 9

    def program():
        M = rng.normal(size=(n, n))
        A = np.vstack([np.eye(n), rng.normal(size=(3, n))]) * 10.0 ** rng.uniform(-2, 2, (rows, 1))
        y = np.where(np.arange(rows) < n, -rng.uniform(0.1, 1, rows), 0.0)
        P, ends = cost * (M @ M.T + 0.1 * np.eye(n)), (np.zeros(rows), np.full(rows, upper))
        return jm.QP(P, -cost * A.T @ y, A, *ends)

    programs = jax.tree.map(lambda *v: np.stack(v), *(program() for _ in range(24)))
    with jax.enable_x64(True):
        found = jax.jit(jax.vmap(jm.solve_qp))(programs)
    assert (found.status == Status.SOLVED).all()
    assert np.abs(found.z).max() < 1e-9


def positive_systems(count, n, m):
    """Return stable systems whose states stay positive, and whose inputs are doses."""
    rng = np.random.default_rng(n)
    for _ in range(count):
        A = rng.uniform(0, 1, (n, n))
        A *= rng.uniform(0.5, 0.95) / np.abs(np.linalg.eigvals(A)).max()
        yield jm.LinearSystem(A, rng.uniform(0, 1, (n, m)), dt=1.0), rng.uniform(1, 5, (16, n))


CASES = [(2, 1, 1.0), (3, 2, 1e-3), (4, 2, 1e3)]


@pytest.mark.parametrize(
    ("n", "m", "unit"),
    [CASES[0], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[1:])],
)
def test_plans_that_dose_nothing(n, m, unit):
    """With A, B, x0 ≥ 0 every predicted state grows with every input, so does the cost of the
    states, and the best of all inputs u ≥ 0 is none."""
    stagewise = jax.jit(jax.vmap(jm.mpc.solve_stagewise, in_axes=(None, 0)))
    for system, x0s in positive_systems(3, n, m):
        limits = {"states": jm.Box(np.zeros(n), np.full(n, 20 * unit)), "inputs": jm.Box(0, unit)}
        mpc = jm.MPC(system, np.eye(n), 0.1 * np.eye(m), 10, terminal_cost=np.eye(n), **limits)
        with jax.enable_x64(True):
            both = jm.solve_many(mpc, unit * x0s), stagewise(mpc, unit * x0s)
        for plans in both:
            assert (plans.status == Status.SOLVED).all()
            assert np.abs(plans.inputs).max() < 1e-9 * unit
