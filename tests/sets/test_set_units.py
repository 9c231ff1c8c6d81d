"""Units of rows and coordinates change no answer of a set: the same random set is written in other
units, x = unit x', and with every row times another number. Nor does rounding in the rows."""

from fractions import Fraction

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.sets import (
    geometry,
    lp,
    maximal_control_invariant_set,
    maximal_invariant_set,
    predecessor,
)

SPREAD, ROWS = 8, 8  # powers of ten


def random_set(rng, n, equal=False):
    """A bounded polytope about a random point, not far from the origin, with redundant rows; equal:
    with two opposite rows, so that it is flat."""
    center = rng.normal(size=n)
    H = np.vstack([np.eye(n), -np.eye(n), rng.normal(size=(2 * n, n))])
    h = H @ center + rng.uniform(0.5, 2, len(H))
    if equal:
        e = rng.normal(size=n)
        H, h = np.vstack([H, e, -e]), np.append(h, [e @ center, -e @ center])
    return H, h


def units(rng, n, rows):
    """Units of the coordinates and factors of the rows."""
    return 10.0 ** rng.uniform(-SPREAD, SPREAD, n), 10.0 ** rng.uniform(-ROWS, ROWS, rows)


def same_points(found, expected, tolerance=1e-9):
    assert len(found) == len(expected)
    distance = np.abs(found[:, None] - expected).max(axis=2)
    size = tolerance * np.ptp(expected, axis=0).max()
    assert distance.min(axis=1).max() <= size and distance.min(axis=0).max() <= size


def check_set(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    H, h = random_set(rng, n)
    unit, row = units(rng, n, len(h))
    P, S = jm.Polytope(H, h), jm.Polytope(row[:, None] * H * unit, row * h)
    assert S.volume() == pytest.approx(P.volume() / np.prod(unit), rel=1e-9)
    same_points(S.vertices() * unit, P.vertices())
    assert len(S.reduce().h) == len(P.reduce().h)
    d = rng.normal(size=n)
    assert S.support(d * unit) == pytest.approx(P.support(d), rel=1e-9)
    other_H, other_h = random_set(rng, n)
    other_row = 10.0 ** rng.uniform(-ROWS, ROWS, len(other_h))
    Q, T = jm.Polytope(other_H, other_h), jm.Polytope(
        other_row[:, None] * other_H * unit, other_row * other_h
    )  # fmt: skip
    both, both_in_units = P.intersect(Q), S.intersect(T)
    assert both_in_units.is_empty() == both.is_empty()
    if not both.is_empty():
        assert both_in_units.volume() * np.prod(unit) == pytest.approx(both.volume(), rel=1e-9)
        assert both_in_units.is_subset(S) and both_in_units.is_subset(T)
    assert S.is_subset(T) == P.is_subset(Q)
    if n > 1:
        kept = S.project([0])
        assert kept.volume() * unit[0] == pytest.approx(P.project([0]).volume(), rel=1e-9)
    smaller = jm.Polytope(S.H, S.h).scale(0.5).pontryagin_difference(S.scale(0.1))
    assert smaller.is_empty() == P.scale(0.5).pontryagin_difference(P.scale(0.1)).is_empty()


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.first(2)
def test_sets_in_other_units(seed):
    check_set(seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_sets_in_other_units_many():
    for seed in range(6, 106):
        check_set(seed)


def check_flat_set(seed):
    """A flat set stays flat, and keeps its affine hull and what it projects to."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 5))
    H, h = random_set(rng, n, equal=True)
    unit, row = units(rng, n, len(h))
    G, g = row[:, None] * H * unit, row * h
    for rows, right in ((H, h), (G, g)):
        equal = geometry.implied_equalities(rows, right)
        assert np.flatnonzero(equal).tolist() == [len(h) - 2, len(h) - 1]
        assert jm.Polytope(rows, right).volume() == 0
    found = jm.Polytope(G, g).project(range(n - 1)).volume() * np.prod(unit[:-1])
    assert found == pytest.approx(jm.Polytope(H, h).project(range(n - 1)).volume(), rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_flat_sets_in_other_units(seed):
    check_flat_set(seed)


def test_projection_of_a_flat_set_is_that_of_its_other_description():
    """{(x, y): y = a x + b, x in a square}: x fills the square, (x_1, y) a parallelogram."""
    a, b = np.array([0.3, -2.0]), 0.7
    rows = np.vstack([np.eye(2), -np.eye(2)])
    H = np.vstack([np.pad(rows, ((0, 0), (0, 1))), np.append(-a, 1.0), np.append(a, -1.0)])
    flat = jm.Polytope(H, np.append(np.ones(4), [b, -b]))
    assert flat.project([0, 1]).volume() == pytest.approx(4, rel=1e-12)
    corners = np.array([[x, a @ [x, y] + b] for x in (-1, 1) for y in (-1, 1)])
    same_points(flat.project([0, 2]).vertices(), corners)
    line = flat.intersect(jm.Polytope([[1, 0, 0], [-1, 0, 0]], [0, 0])).project([1, 2])
    same_points(line.vertices(), np.array([[-1, 2.7], [1, -1.3]]))


def polygon(rng, rows):
    """Rows y'x <= 1 about the origin, and the exact area of what they leave of a square."""
    angle = rng.uniform(0, 2 * np.pi, rows)
    G = np.vstack([np.column_stack([np.cos(angle), np.sin(angle)]), np.eye(2), -np.eye(2)])
    g = np.append(rng.uniform(0.5, 2, rows), np.full(4, 2.0))
    corners = [[Fraction(x), Fraction(y)] for x, y in ((-2, -2), (2, -2), (2, 2), (-2, 2))]
    for row, end in zip(G, g, strict=True):
        (a, b), end = map(Fraction, row), Fraction(end)
        room = [end - a * x - b * y for x, y in corners]
        kept = []
        for i, (p, r) in enumerate(zip(corners, room, strict=True)):
            q, s = corners[i - 1], room[i - 1]
            if (r > 0) != (s > 0):
                kept.append([v + (w - v) * s / (s - r) for v, w in zip(q, p, strict=True)])
            if r >= 0:
                kept.append(p)
        corners = kept
    turned = zip(corners, corners[1:] + corners[:1], strict=True)
    return G, g, sum(p[0] * q[1] - p[1] * q[0] for p, q in turned) / 2


def check_rounding(seed):
    """A product of polygons, most rows of which belong to one of them, with rounding in place of
    zeros: its volume is the exact one, it has no equalities, and its centre keeps all rows."""
    rng = np.random.default_rng(seed)
    n = 2 * int(rng.integers(2, 5))
    parts = [polygon(rng, 1 if i else 60) for i in range(n // 2)]
    H = np.zeros((sum(len(g) for _, g, _ in parts), n))
    h, start, volume = np.concatenate([g for _, g, _ in parts]), 0, Fraction(1)
    for i, (G, g, area) in enumerate(parts):
        H[start : start + len(g), 2 * i : 2 * i + 2] = G
        start, volume = start + len(g), volume * area
    size = 10.0 ** rng.uniform(-17, -13, H.shape) * rng.choice([-1, 0, 1], H.shape)
    noisy = np.where(H == 0, size, H)
    unit = 10.0 ** rng.uniform(-3, 3, n) if seed % 2 else np.ones(n)
    P = jm.Polytope(noisy * unit, h)
    assert P.volume() * np.prod(unit) == pytest.approx(float(volume), rel=1e-9)
    reduced, clean = P.reduce(), jm.Polytope(H * unit, h).reduce()
    assert P.affine_dimension() == n and len(reduced.h) == len(clean.h)
    d = rng.normal(size=n) * unit
    assert P.support(d) == pytest.approx(clean.support(d), rel=1e-9)
    center, _ = P.chebyshev()
    center = [Fraction(x) for x in center]
    for row, end in zip(*P.half_spaces(), strict=True):
        assert sum(Fraction(a) * x for a, x in zip(row, center, strict=True)) < Fraction(end)


@pytest.mark.parametrize("seed", range(6, 12))
@pytest.mark.first(3)
def test_rounding_in_rows_changes_no_answer(seed):
    check_rounding(seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_rounding_in_rows_changes_no_answer_many():
    for seed in range(12, 106):
        check_rounding(seed)


def plant(rng):
    A, B = rng.normal(size=(2, 2)), rng.normal(size=(2, 2))
    return A / np.abs(np.linalg.eigvals(A)).max(), B


def check_invariant(seed):
    rng = np.random.default_rng(seed)
    A, B = plant(rng)
    S, V = 10.0 ** rng.uniform(-4, 4, (2, 2))
    X = np.vstack([np.eye(2), -np.eye(2), [[1.0, 0.5]]])
    x, U, u = np.array([5, 4, 5, 3, 5.5]), np.vstack([np.eye(2), -np.eye(2)]), np.ones(4)
    r, q = 10.0 ** rng.uniform(-ROWS, ROWS, 5), 10.0 ** rng.uniform(-ROWS, ROWS, 4)
    problems = []
    for s, v, row_x, row_u in ((np.ones(2), np.ones(2), np.ones(5), np.ones(4)), (S, V, r, q)):
        system = jm.LinearSystem(A * s / s[:, None], B * v / s[:, None])
        states = jm.Polytope(row_x[:, None] * X * s, row_x * x)
        inputs = jm.Polytope(row_u[:, None] * U * v, row_u * u)
        problems.append((system, states, inputs, s))
    answers = []
    for system, states, inputs, s in problems:
        before = predecessor(system, states, states, inputs)
        largest = maximal_control_invariant_set(system, states, inputs)
        answers.append((len(before.h), before.volume() * np.prod(s), largest.exact,
                        len(largest.h), largest.volume() * np.prod(s)))  # fmt: skip
    (m, v, exact, rows, area), other = answers
    assert (m, exact, rows) == (other[0], *other[2:4])
    assert other[1] == pytest.approx(v, rel=1e-9) and other[4] == pytest.approx(area, rel=1e-7)
    K = -0.3 * np.linalg.lstsq(B, A, rcond=None)[0]
    sizes = []
    for (system, states, inputs, s), v in zip(problems, (np.ones(2), V), strict=True):
        body = maximal_invariant_set(system, K * s / v[:, None], states, inputs)
        sizes.append((len(body.h), body.volume() * np.prod(s)))
    assert sizes[0][0] == sizes[1][0] and sizes[1][1] == pytest.approx(sizes[0][1], rel=1e-9)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.first(1)
def test_invariant_sets_in_other_units(seed):
    check_invariant(seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_invariant_sets_in_other_units_many():
    for seed in range(2, 32):
        check_invariant(seed)


def check_program(seed):
    """The status, the optimum and the proof of a program do not depend on units either."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 6))
    kind = seed % 3  # bounded, unbounded, empty
    H, h = random_set(rng, n) if kind != 1 else (rng.normal(size=(n, n)), rng.uniform(0, 1, n))
    if kind == 2:
        H, h = np.vstack([H, -H[:1]]), np.append(h, -h[0] - rng.uniform(0.01, 1))
    unit, row = units(rng, n, len(h))
    d = rng.normal(size=n)
    d = d if kind != 1 else -H.sum(axis=0)  # −H r of a ray r
    G, g = row[:, None] * H * unit, row * h
    first, second = lp.maximise(d, H, h), lp.maximise(d * unit, G, g)
    if kind:
        assert first.value == second.value == (np.inf if kind == 1 else -np.inf)
    else:
        assert second.value == pytest.approx(first.value, rel=1e-9)
        size = np.abs(G).T @ second.y
        assert np.all(np.abs(G.T @ second.y - d * unit) <= 1e-12 * size)
    if kind == 2:
        y = lp.Program(G, g).farkas
        size = np.abs(G).T @ y
        assert np.all(y >= 0) and g @ y < 0 and np.all(np.abs(G.T @ y) <= 1e-12 * size)


@pytest.mark.parametrize("seed", range(9))
def test_programs_in_other_units(seed):
    check_program(seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_programs_in_other_units_many():
    for seed in range(9, 609):
        check_program(seed)


def test_concrete_data_are_judged_in_float64():
    """Whatever JAX's precision: a point beyond a limit by less than float32 sees is outside."""
    import jax
    import jax.numpy as jnp

    box, point, inside = jm.Box([-20000.0, -1], [20000.0, 1]), [20000.0005, 0.0], [19999.9995, 0]
    ball = jm.Ellipsoid(np.eye(2), 4e8)
    with jax.enable_x64(False):
        for body in (box, box.to_polytope(), ball):
            assert not body.contains(np.array(point)) and body.contains(np.array(inside))
            assert body.contains(jnp.array([1.0, 0.0]))
            traced = jax.jit(lambda body, x: body.contains(x))(body, jnp.array([1.0, 0.0]))
            assert bool(traced)
        assert box.support([1.0, 1e-7]) == 20000 + 1e-7
        assert ball.support([3.0, 4.0]) == pytest.approx(1e5, rel=1e-15)


def test_origin_as_terminal_set_keeps_stability():
    """x_N = 0 makes MPC stable: as a Box, as opposite rows of any length, in other units."""
    for unit in (1.0, 1e3):
        system = jm.LinearSystem([[1, 1 / unit], [0, 1.0]], [0.5, unit])
        X, U = jm.Box([-5, -5 * unit], [5, 5 * unit]), jm.Box(-1, 1)
        rows = np.array([[1e6, 0], [-1e-6, 0], [1.0, 3.0], [-1e4, -3e4]])
        for origin in (jm.Box([0, 0], [0, 0]), jm.Polytope(rows, np.zeros(4))):
            weight = np.diag([1, 1 / unit**2])
            report = jm.sets.verify_terminal(system, weight, [[1.0]], None, origin, X, U)
            assert report.recursive_feasibility and report.stability
    line = jm.Polytope([[1.0, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 1, 1])  # without the origin
    report = jm.sets.verify_terminal(system, weight, [[1.0]], None, line, X, U)
    assert report["origin inside terminal set"].holds is False
