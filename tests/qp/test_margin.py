"""The feasibility margin against values known by hand, and as a guide into the feasible set."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.optimize import linprog

import jaxmpc as jm

INF = np.inf


pytestmark = pytest.mark.usefixtures("x64")


def rows(A, l, u, **fields) -> jm.QP:
    """A program of which only the constraints matter."""
    A, l, u = (np.asarray(v, float) for v in (A, l, u))
    n = A.shape[1]
    return jm.QP(np.eye(n), np.ones(n), A, l, u, **fields)


def filled(qp) -> jm.QP:
    """With a variable in no row and rows that hold nothing up to (3, 2): one program for all."""
    m, n = qp.A.shape
    A, free = np.zeros((3, 2)), np.full(3 - m, INF)
    A[:m, :n] = qp.A
    return rows(A, np.append(qp.l, -free), np.append(qp.u, free))


@jax.jit  # in one program, not in thirty small ones
def margin_and_status(qp, scale, max_margin):
    return jm.qp.feasibility_margin(qp, scale, max_margin)


def margin(qp, scale=None, max_margin=1e3) -> float:
    t, status = margin_and_status(qp, np.ones(len(qp.l)) if scale is None else scale, max_margin)
    assert status == jm.Status.SOLVED
    return float(t)


@pytest.mark.long
@pytest.mark.first(1)
@pytest.mark.parametrize(
    ("qp", "t"),
    [
        (rows([[1]], [-1], [3]), 2.0),  # half the width
        (rows([[1], [1]], [2, -INF], [INF, 1]), -0.5),  # z ≥ 2 and z ≤ 1: half the gap
        (rows([[1], [0]], [-5, -INF], [5, -0.25]), -0.25),  # a row that z cannot move
        (rows([[1, 0], [0, 1], [1, 1]], [-1, -1, 3], [1, 1, INF]), -1 / 3),
        (rows([[1], [1]], [-1, 0.3], [1, 0.3]), 0.0),  # an equality
        (rows([[1]], [0], [INF]), 1000.0),  # nothing holds t but the limit
    ],
)
def test_known_values(qp, t):
    assert margin(filled(qp)) == pytest.approx(t, abs=1e-8)


@pytest.mark.long
def test_scale_and_limit():
    qp = filled(rows([[1], [1]], [2, -INF], [INF, 1]))
    assert margin(qp, scale=np.array([3.0, 1.0, 1.0])) == pytest.approx(-0.25, abs=1e-8)
    assert margin(filled(rows([[1]], [0], [INF])), max_margin=7.0) == pytest.approx(7.0)


@pytest.mark.slow
def test_soft_rows_do_not_count():
    qp = rows([[1], [1]], [-1, 5], [1, INF], soft_linear=np.array([INF, 3.0]))
    assert margin(qp) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.slow
def test_random_rows_against_another_solver():
    rng = np.random.default_rng(0)
    A = rng.standard_normal((30, 12, 5))
    l, u = rng.standard_normal((30, 12)) - 1, rng.standard_normal((30, 12)) + 1
    l, u = np.minimum(l, u), np.maximum(l, u)
    l[:, :3], u[:, 3:5] = -INF, INF
    batch = jm.QP(np.eye(5), np.zeros(5), A, l, u)
    axes = (jm.QP(P=None, q=None, A=0, l=0, u=0),)
    t, status = jax.jit(jax.vmap(jm.qp.feasibility_margin, in_axes=axes))(batch)
    np.testing.assert_array_equal(status, jm.Status.SOLVED)
    for i in range(30):
        ones = np.ones((12, 1))
        G = np.block([[A[i], ones], [-A[i], ones]])
        h = np.concatenate([u[i], -l[i]])
        keep = np.isfinite(h)
        best = linprog([0] * 5 + [-1], G[keep], h[keep], bounds=[(None, None)] * 5 + [(None, 1e3)])
        assert t[i] == pytest.approx(-best.fun, abs=1e-7)


@pytest.mark.slow
def test_gradient_against_differences():
    """Both signs: at a state inside the joint's feasible set and at one outside. The margin is
    piecewise affine: long steps keep the rounding of its values out of the differences."""
    condensed = jm.Controller(problems.joint()).condensed
    f = jax.jit(lambda x: jm.qp.feasibility_margin(condensed.qp(x))[0])
    gradient = jax.jit(jax.grad(f))
    for x in (np.array([0.3, 1.2]), np.array([1.4, 1.7]), np.array([-1.9, -2.5])):
        numeric = [(f(x + h) - f(x - h)) / 2e-4 for h in 1e-4 * np.eye(2)]
        np.testing.assert_allclose(gradient(x), numeric, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mpc", "count"),
    [
        (problems.joint(), 60),
        pytest.param(problems.joint(), 1000, marks=pytest.mark.slow),
        pytest.param(problems.joint_o_inf(), 1000, marks=pytest.mark.slow),
    ],
    ids=["joint, 60", "joint", "O_inf"],
)
def test_climbing_the_margin_leads_into_the_feasible_set(mpc, count):
    """Polyak steps on the concave margin bring every infeasible state in; labels prove it."""
    condensed = jm.Controller(mpc).condensed
    value = lambda x: jm.qp.feasibility_margin(condensed.qp(x))
    climb = jax.jit(jax.vmap(jax.value_and_grad(value, has_aux=True)))
    x = np.random.default_rng(1).uniform([-3, -4], [3, 4], (4 * count, 2))
    x = x[jm.map_feasible_set(mpc, x).label == -1][:count]
    assert len(x) == count
    for _ in range(20):
        (t, status), gradient = (jax.tree.map(np.asarray, v) for v in climb(x))
        assert np.all(status == jm.Status.SOLVED)
        step = (1e-3 - t) / np.sum(gradient**2, axis=1)
        x = np.where((t > 0)[:, None], x, x + step[:, None] * gradient)
    assert np.all(jm.map_feasible_set(mpc, x).label == 1)


@pytest.mark.slow
def test_bad_input():
    qp = rows([[1]], [-1], [1])
    with pytest.raises(ValueError, match="scale"):
        jm.qp.feasibility_margin(qp, scale=np.ones(2))
    ball = replace(qp, l=np.zeros(1), u=np.zeros(1), radius=np.ones(1), balls=(1,))
    with pytest.raises(ValueError, match="balls"):
        jm.qp.feasibility_margin(ball)
    assert jnp.isfinite(jm.qp.feasibility_margin(qp)[0])
