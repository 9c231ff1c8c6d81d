"""Bounds of linear programs."""

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.sets import lp
from jaxmpc.sets.lp import Model, Program, scaling


def test_bound_is_valid_for_inexact_multipliers():
    rows = np.vstack([np.eye(2), -np.eye(2)])
    d, g = np.array([1.0, 2.0]), np.ones(4)
    top = lp.maximise(d, rows, g)
    assert top.value == pytest.approx(3, abs=1e-12)
    random = np.random.default_rng(0)
    for size in (0.0, 1e-12, 1e-3, 1.0):
        y = np.abs(top.y + size * random.standard_normal(4))
        above = lp.bound(d, y, rows, g, np.ones(2))
        assert 3 - 1e-15 <= above <= 3 + 10 * size + 1e-12


def test_solver_prints_nothing(capfd):
    rows = np.vstack([np.eye(2), -np.eye(2)])
    lp.maximise(np.ones(2), rows, np.ones(4))
    assert capfd.readouterr() == ("", "")


def test_programs_begin_where_the_last_one_ended_and_end_where_they_would():
    random = np.random.default_rng(0)
    rows, sides = random.standard_normal((30, 5)), random.uniform(1, 2, 30)
    rows, sides = np.vstack([rows, np.eye(5), -np.eye(5)]), np.append(sides, np.full(10, 9.0))
    program = lp.Program(rows, sides)
    for d in random.standard_normal((40, 5)):
        one, alone = program.maximise(d), lp.maximise(d, rows, sides)
        assert one.value == pytest.approx(alone.value, rel=1e-12)
        np.testing.assert_allclose(one.x, alone.x, atol=1e-11)
        np.testing.assert_allclose(one.y @ rows, d, atol=1e-12)


def test_small_entries_count_at_distant_points():
    """y + 5e-10 x <= 1 and y >= 1 - 1e-7 end x at 200, not at its limit of 1000."""
    rows = np.array([[1.0, 0.0], [-1.0, 0.0], [5e-10, 1.0], [0.0, -1.0]])
    sides = np.array([1000.0, 1.0, 1.0, 1e-7 - 1])
    assert lp.maximise(np.array([1.0, 0.0]), rows, sides).value == pytest.approx(200, rel=1e-6)


def test_an_answer_outside_the_rows_is_asked_for_again(monkeypatch):
    """HiGHS may call a point optimal that its rows exclude, after changes from an old basis."""
    program, calls = Program(np.vstack([np.eye(2), -np.eye(2)]), np.ones(4)), []
    maximise, forget = Model.maximise, Model.forget

    def wrong_from_a_basis(model, cost, method="simplex"):
        (x, y), claim = maximise(model, cost, method)
        calls.append(method)
        return (x + (0.01 if calls[-1] != "anew" and "anew" not in calls else 0.0), y), claim

    monkeypatch.setattr(Model, "maximise", wrong_from_a_basis)
    monkeypatch.setattr(Model, "forget", lambda model: (calls.append("anew"), forget(model)))
    found = program.maximise(np.array([1.0, 2.0]))
    assert calls == ["simplex", "anew", "simplex"]
    np.testing.assert_allclose(found.x, [1, 1], atol=1e-12)
    assert abs(found.value - 3) < 1e-12


def test_no_answer_is_better_than_one_outside_the_rows(monkeypatch):
    program = Program(np.vstack([np.eye(2), -np.eye(2)]), np.ones(4))
    maximise = Model.maximise

    def wrong(model, cost, method="simplex"):
        (x, y), claim = maximise(model, cost, method)
        return (x + 0.01, y), claim

    monkeypatch.setattr(Model, "maximise", wrong)
    monkeypatch.setattr(Program, "_by_dual", lambda *_: None)
    with pytest.raises(ValueError, match="no answer that can be checked"):
        program.maximise(np.array([1.0, 2.0]))


def test_variables_within_bounds_of_their_own_count_in_these_units():
    """|ζ_i| ≤ 1 beside sixty rows in which ζ has entries of 1e-10: the smaller rows must not make
    1e10 the unit of ζ, in which the bounds are closer than any margin that can be told from 0."""
    random = np.random.default_rng(0)
    rows = np.hstack([random.normal(size=(60, 2)), 1e-10 * random.normal(size=(60, 3))])
    box = np.hstack([np.zeros((3, 2)), np.eye(3)])
    G, g = np.vstack([rows, -rows, box, -box]), np.ones(126)
    _, column = scaling(G, g)
    assert (column[2:] <= 2).all()
    assert Program(G, g).margin()[1] > 0.1


@pytest.mark.parametrize("spread", [0, 4])
def test_a_set_is_unbounded_where_only_rounding_closes_it(spread):
    """Rows computed elsewhere: x₀ ≥ −1.25 and |x₁| ≤ 1, with rounding in place of a zero."""
    rng = np.random.default_rng(spread)
    G = np.array([[-0.8, 0.0], [1.4e-18, 1.0], [-2.8e-18, -1.0], [-0.8, 0.0], [1.4e-18, 2.0]])
    g = np.array([1.0, 1.0, 1.0, 2.0, 3.0])
    row, unit = 10 ** rng.uniform(-spread, spread, 5), 10 ** rng.uniform(-spread, spread, 2)
    program = Program(row[:, None] * G * unit, row * g)
    low, high = program.bounds()
    assert high[0] == np.inf
    np.testing.assert_allclose([low[0], low[1], high[1]] * unit[[0, 1, 1]], [-1.25, -1, 1])


@pytest.mark.parametrize("rounding", [0.1 + 0.2 - 0.3, 1e-25, 3e-12, 1e-10])
@pytest.mark.long
def test_a_side_that_is_small_beside_others_is_no_unit(rounding):
    """Sets with a row through 0 are those with rounding in its place, or another number far below
    all others, in all that is asked."""
    random = np.random.default_rng(0)
    looked = 0
    while looked < 25:
        n = int(random.choice([2, 2, 3]))
        H = random.integers(-2, 3, (n + int(random.integers(1, 4)), n)).astype(float)
        h = random.integers(1, 4, len(H)).astype(float)
        h[i := random.integers(len(h))] = 0.0
        if not H.any(axis=1).all():
            continue
        exact = jm.Polytope(H, h)
        if exact.affine_dimension() < n or not exact.is_bounded():
            continue
        looked += 1
        h[i] = rounding
        found = jm.Polytope(H, h)
        d = random.integers(-2, 3, (3, n)) + 0.1
        assert found.is_bounded()
        np.testing.assert_allclose(found.support(d), exact.support(d), atol=1e-9 + 20 * rounding)
        np.testing.assert_allclose(found.volume(), exact.volume(), rtol=1e-9)
        box = [end for P in (found, exact) for end in P.bounding_box().bounds()]
        np.testing.assert_allclose(box[:2], box[2:], atol=1e-9 + 20 * rounding)
        less = jm.Polytope(d, exact.support(d) - 0.01)
        assert not found <= less


def test_another_last_column_brings_other_units():
    """A row whose only entry was rounding does not keep the scale of that."""
    G = np.array([[1, 1.0], [-1, 1], [0, 2e-17], [0, -2e-17], [1, 0], [-1, 0]])
    program = Program(G.copy(), np.array([1, 1, 5, 5, 1, 1.0]))
    program.maximise([0, 1.0])
    program.change_last_column(np.array([1, 1, 0.7, -0.7, 0, 0]))
    assert program.maximise([0, 1.0]).value == pytest.approx(1)


def test_flat_sets_through_the_origin_keep_both_halves():
    """Rows with rounding in their entries and sides of 0; a zonotope that is a needle."""
    random = np.random.default_rng(0)
    for _ in range(5):
        H = np.vstack([np.eye(2), -np.eye(2)]) + 6e-17 * random.uniform(-1, 1, (4, 2))
        flat = jm.Polytope(H, [0.1, 0, 0.1, 0])
        found = flat.support(np.vstack([np.eye(2), -np.eye(2)]))
        np.testing.assert_allclose(found, [0.1, 0, 0.1, 0], atol=1e-12)
    for G in ([[1, 0.5], [5e-17, 2e-17]], [[1.0], [5e-17]]):
        needle = jm.sets.Zonotope([0, 0], G).to_polytope()
        half = np.abs(G).sum(axis=1)[0]
        np.testing.assert_allclose(needle.support([[1.0, 0], [-1, 0]]), half)
        assert not needle.contains([100.0, 0]) and needle.volume() < 1e-15


def test_rounding_closes_nothing_and_opens_nothing():
    """A side on one side only; sums that leave some; entries beside facets through 0."""
    for e in (0.0, 1e-17):
        assert jm.Polytope([[1, 0], [-1, 0], [0, 1]], [1, 1, e]).support([1, -1]) == np.inf
        low = jm.Polytope([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, 1, e, 1])
        assert low.support([1, -1]) == pytest.approx(2)
        difference = jm.Polytope([[1, -1], [-1, 1], [1, 1], [-1, -1]], 5.0 * np.ones(4)) - low
        np.testing.assert_allclose(difference.h, [3, 4, 4, 3])
        corner = jm.Polytope([[-1, 1], [-1, -1], [1, e]], [0, 0, 1])
        np.testing.assert_allclose(corner.bounding_box().bounds(), [[0, -1], [1, 1]], atol=1e-12)
    half = jm.Box([-np.inf, -0.7], [0.9, 1.9])
    total = half + jm.sets.Zonotope([-1.1, 2.1], [[-0.2], [0.5]])
    assert total.support([1.0, 2.0]) == pytest.approx(8.6)
    # Units that are 1e18 apart are no rounding, nor is a limit of 1e20.
    s = np.array([1e9, 1e-9])
    corner = jm.Polytope(np.array([[-1, -2], [0, -1], [3, 1], [-1, 1]]) * s, [0, 0, 3, 1])
    np.testing.assert_allclose([*corner.support(np.diag(s)), corner.volume()], [1, 1.5, 4 / 3])
    assert (
        jm.Polytope(np.array([[0, 3], [3, 0], [-2, -1]]) * s, np.zeros(3)).affine_dimension() == 0
    )
    loose = jm.Polytope([[1, 1], [-1, -1], [1, 0], [-1, 1]], [1, 1, 1e20, 1])
    np.testing.assert_allclose(loose.support([[0, 1], [1, 1]]), [1, 1], atol=1e-9)
    for far in (1e15, 1e18):
        half = jm.Polytope([[1, 0], [-1, 0], [0, 1], [0, -1], [-1, -1]], [far, 0, 1, 1, -0.5])
        np.testing.assert_allclose(half.support([[-1, 0], [-1, 0.5]]), [0, 0.5], atol=1e-9)
    # The direction of a small entry has no say in units that fit.
    s = 2.0 ** np.array([40, 20])
    triangle = Program(np.array([[1, -2], [-1, 1], [1, 0.0]]) * s, np.array([-1.35e-12, 2, 0]))
    assert triangle.maximise(np.array([-1e-9, -0.5]) * s).value == pytest.approx(1)
    # Two bounds of a coordinate's own are a small set.
    small = jm.Box([-1e-17, -1], [2e-17, 1])
    np.testing.assert_allclose(small.volume(), 6e-17, rtol=1e-9)
    np.testing.assert_allclose(small.to_polytope().support([1, 0]), 2e-17, rtol=1e-9)
