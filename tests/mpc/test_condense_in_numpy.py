"""The condensed problem of NumPy's arrays: that of the traced program, and nothing is compiled."""

import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.mpc.condense import condense
from jaxmpc.mpc.rows import _root

SYSTEM = jm.LinearSystem([[1.0, 0.2], [0.1, 0.9]], [[0.1], [0.3]], c=[0.01, -0.02])
COST = {"Q": np.array([[2.0, 0.5], [0.5, 1.0]]), "R": 0.3, "terminal_cost": 3 * np.eye(2)}
LIMITS = {"states": jm.Box([-2.0, -2.0], [2.0, 2.0]), "inputs": jm.Box(-1.0, 1.0)}
SAME = {**COST, **LIMITS, "prestabilise": np.array([[-0.3, -0.4]])}


def every_row(horizon):
    return jm.MPC(
        SYSTEM, horizon=horizon, **SAME, input_rate_limit=0.5, input_rate_weight=0.2,
        outputs=jm.Outputs([[1.0, 1.0]], upper=[1.5], D=[[0.2]], stages=(0, 2)),
        soft=jm.Soft([[0.0, 1.0]], lower=[-0.5], upper=[0.4], rho=2.0, quadratic=0.5),
        terminal_set=jm.Ellipsoid(np.array([[2.0, 0.3], [0.3, 1.0]]), 0.7),
        stage_weights=np.linspace(1.0, 2.0, horizon),
    )  # fmt: skip


def tightened(horizon):
    """The policy is u = v + K e; the disturbance moves one direction."""
    return jm.MPC(
        SYSTEM, horizon=horizon, **SAME, input_rate_limit=0.5, gain=np.array([[-0.2, -0.5]]),
        disturbance=jm.Box([-0.02], [0.03]), disturbance_matrix=np.array([[1.0], [0.5]]),
        terminal_set=jm.Polytope([[1.0, 1.0], [-1.0, 0.5]], [0.7, 0.8]),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.first(2)
@pytest.mark.parametrize(
    ("make", "x64"),
    [(every_row, True), (tightened, False), (every_row, False), (tightened, True)],
)
def test_it_is_that_of_the_traced_program(make, x64, compiled):
    with jax.enable_x64(x64):
        compiled.clear()
        found = condense(make(4))
        assert not compiled
        expected = jax.jit(condense)(make(4))
        assert jax.tree.structure(found) == jax.tree.structure(expected)
        near = 1e-13 if x64 else 1e-5
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            assert isinstance(one, jax.Array) and one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=near, atol=near)


def test_a_flat_ellipsoid_has_no_root():
    """As in a traced program, where it makes the plan NON_FINITE."""
    assert np.isnan(_root(np.diag([1.0, 0.0]))).all()
    np.testing.assert_allclose(_root(np.diag([4.0, 9.0])), np.diag([2.0, 3.0]))
