"""Redundant rows and factors of products."""

import numpy as np
import pytest
import scipy
from polytopes import unimodular
from scipy.optimize import linprog

import jaxmpc.sets.geometry as geometry
from jaxmpc.sets.convex_sets import Polytope
from jaxmpc.sets.geometry import factors, irredundant


def test_factors_find_a_hidden_product():
    rng = np.random.default_rng(0)
    T, inverse = unimodular(rng, 7)
    blocks = [rng.standard_normal((rows, n)) for rows, n in ((6, 2), (9, 3), (2, 1), (2, 1))]
    Y = scipy.linalg.block_diag(*blocks) @ inverse
    parts, S = factors(Y)
    assert sorted((len(rows), Z.shape[1]) for rows, Z in parts) == [(2, 1), (2, 1), (6, 2), (9, 3)]
    points = rng.standard_normal((50, 7))
    for rows, Z in parts:  # Z t is Y x, for t some entries of S x
        start = np.linalg.lstsq(Z, (points @ Y[rows].T).T, rcond=None)
        np.testing.assert_allclose(Z @ start[0], (points @ Y[rows].T).T, atol=1e-10)
    assert S.shape == (7, 7)
    bridge = np.vstack([Y, rng.standard_normal(7)])  # one row that contains all coordinates
    assert len(factors(bridge)[0]) == 1
    assert factors(np.eye(3)[:2])[1].shape == (2, 3)


@pytest.mark.parametrize("n", [2, 3, 5, 6])
def test_hulls_and_programs_find_the_same_rows(n, monkeypatch):
    rng = np.random.default_rng(n)
    Y = rng.standard_normal((60, n)) * rng.uniform(0.3, 1, (60, 1))
    Y = np.vstack([Y, 0.5 * Y[:10], Y[:10], 0.5 * (Y[10:20] + Y[20:30])])  # all redundant
    hull = irredundant(Y)
    monkeypatch.setattr(geometry, "_HULL_DIMENSIONS", 1)
    programs = irredundant(Y)
    np.testing.assert_array_equal(hull, programs)
    np.testing.assert_array_equal(irredundant(Y, known=hull), programs)
    assert hull.max() < 60
    unbounded = Y[Y[:, 0] > 0]
    needed = []  # by definition: over the set of the others its maximum exceeds 1
    for i, row in enumerate(unbounded):
        others = [j for j, other in enumerate(unbounded) if j < i or not np.allclose(other, row)]
        ones = np.ones(len(others))
        top = linprog(-row, A_ub=unbounded[others], b_ub=ones, bounds=(None, None))
        if top.status == 3 or -top.fun > 1 + 1e-9:
            needed.append(i)
    np.testing.assert_array_equal(irredundant(unbounded), needed)
    monkeypatch.undo()
    np.testing.assert_array_equal(irredundant(unbounded), needed)


def test_reduce_in_twelve_dimensions():
    rng = np.random.default_rng(0)
    # 100 rows on a sphere, all irredundant, and 300 inside their polar hull.
    Y = rng.standard_normal((100, 12))
    Y /= np.linalg.norm(Y, axis=1)[:, None]
    weights = rng.dirichlet(np.ones(4), 300)
    inside = np.einsum("ij,ijk->ik", weights, Y[rng.integers(0, 100, (300, 4))]) * 0.999
    order = rng.permutation(400)
    rows = np.vstack([Y, inside])[order]
    reduced = Polytope(rows, np.ones(400), tuple(map(str, order))).reduce()
    assert sorted(map(int, reduced.labels)) == list(range(100))
