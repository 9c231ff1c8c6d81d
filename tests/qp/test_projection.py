"""Soft rows and balls: the function g itself, and QPs that hold them, against other solvers.

Programs are solved in batches of one shape, each with its own P and A, so that each solver
compiles once. Nothing that judges an answer (`judged`, `penalty`, `conjugate`, Clarabel) uses
the library.
"""

import os
import subprocess
import sys
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import padded
import pytest
from jax import enable_x64
from padded import COUNT
from scipy.optimize import brentq, minimize_scalar

import jaxmpc as jm
from jaxmpc.qp.problem import Bounds

INF = np.inf
N, ROWS = 5, 12  # variables and rows of every program below
BALLS = (3, 2)

COARSE = jm.ADMM(iterations=3, newton_steps=0)
solve_coarse = jax.jit(
    jax.vmap(lambda qp, eps: jm.solve_qp(qp, replace(COARSE, eps=eps)), (0, None))
)
solve_warm = jax.jit(
    jax.vmap(lambda qp, eps, start: jm.solve_qp(qp, replace(COARSE, eps=eps), start), (0, None, 0))
)


def as32(tree):
    return jax.tree.map(np.float32, tree)


def as64(tree):
    return jax.tree.map(np.float64, tree)


def one(tree, i):
    """Element i of a batch."""
    return jax.tree.map(lambda v: np.asarray(v)[i], tree)


def stacked(trees):
    return jax.tree.map(lambda *v: np.stack(v), *trees)


def solve_fine(qp, eps):
    """Solutions of a batch, of `COUNT` programs without balls by a program of other files."""
    if qp.balls or qp.A.shape != (COUNT, ROWS, N):
        return padded.solve(qp, np.asarray(eps, qp.q.dtype))
    return padded.solutions([one(qp, i) for i in range(COUNT)], eps, qp.q.dtype)


def weights(qp):
    """c and k of every row as arrays; c = inf is a hard row."""
    m = len(qp.l)
    c = np.full(m, INF) if qp.soft_linear is None else np.asarray(qp.soft_linear)
    k = np.zeros(m) if qp.soft_quadratic is None else np.asarray(qp.soft_quadratic)
    return c, k


def ball_slices(qp):
    """(rows, radius) of each ball."""
    first, out = len(qp.l) - sum(qp.balls), []
    for size, radius in zip(qp.balls, () if qp.radius is None else qp.radius, strict=True):
        out.append((slice(first, first + size), float(radius)))
        first += size
    return out


def penalty(p, l, u, c, k):
    """g of one row at p: inf outside a hard interval, c d + k d²/2 outside a soft one."""
    d = max(l - p, p - u, 0.0)
    if d == 0:
        return 0.0
    return INF if np.isinf(c) else c * d + k * d * d / 2


def conjugate(y, l, u, c, k):
    """g* of one row: max over p of y p − g(p), by cases.

    The best p lies at a bound, at distance (|y| − c)/k beyond it, or nowhere.
    """
    if y == 0:
        return 0.0
    bound = u if y > 0 else l
    if np.isinf(bound):
        return INF
    over = abs(y) - c
    if over <= 0:
        return y * bound
    return y * bound + over * over / (2 * k) if k > 0 else INF


def judged(qp, z, y):
    """Primal residual, dual residual, gap and the size of the terms of each, in plain numpy."""
    qp, z, y = as64(qp), np.asarray(z, float), np.asarray(y, float)
    c, k = weights(qp)
    v, balls = qp.A @ z, ball_slices(qp)
    rows = range(len(v) - sum(qp.balls))
    out = [max(qp.l[i] - v[i], v[i] - qp.u[i], 0.0) for i in rows if np.isinf(c[i])] + [0.0]
    g = sum(0.0 if np.isinf(c[i]) else penalty(v[i], qp.l[i], qp.u[i], c[i], k[i]) for i in rows)
    h = sum(conjugate(y[i], qp.l[i], qp.u[i], c[i], k[i]) for i in rows)
    for block, radius in balls:
        away = np.linalg.norm(v[block] - qp.l[block])
        out.append(max(away - radius, 0.0))
        h += y[block] @ qp.l[block] + radius * np.linalg.norm(y[block])
    dual = np.abs(qp.P @ z + qp.q + qp.A.T @ y).max(initial=0)
    gap = abs(z @ qp.P @ z + qp.q @ z + g + h)
    size = (
        (np.abs(qp.A) @ np.abs(z)).max(initial=0),
        (np.abs(qp.P) @ np.abs(z) + np.abs(qp.q) + np.abs(qp.A.T) @ np.abs(y)).max(initial=0),
        abs(z @ qp.P @ z) + np.abs(qp.q) @ np.abs(z) + g + abs(h),
    )
    return np.array([max(out), dual, gap]), np.array(size)


def assert_honest(batch, sol, eps):
    """SOLVED only with residuals within eps, relative to their terms, and rounding; the reported
    ones are those of (z, y).

    The rounding floor is what `ADMM.eps` promises: 100 (float32: 4) machine epsilons of the size
    of the terms; float32 pairs are rounded after they have been judged. A ball of violation r has
    entries up to r, so its largest may be √3 smaller.
    """
    single = np.asarray(sol.z).dtype == np.float32
    floor = (4 if single else 100) * np.finfo(np.float32 if single else np.float64).eps
    for i in range(len(sol.status)):
        value, size = judged(one(batch, i), sol.z[i], sol.y[i])
        own = np.array([sol.primal_residual[i], sol.dual_residual[i], sol.gap[i]])
        rounding = 1e-6 * value + floor * (1 + size)
        assert (own <= value + rounding).all()
        assert (value <= np.array([np.sqrt(3), 1, 1]) * own + rounding).all()
        if sol.status[i] == jm.Status.SOLVED:
            allowed = eps * (1 + 1e-6) * (1 + size) + (2 if single else 1) * floor * size
            assert (value <= np.array([np.sqrt(3), 1, 1]) * allowed).all(), (i, value, allowed)


def clarabel_answer(qp):
    """(z, y, cost) by Clarabel: soft rows with two slacks each, balls as second-order cones."""
    clarabel = pytest.importorskip("clarabel")
    from scipy import sparse

    n, m, (c, k) = len(qp.q), len(qp.l), weights(qp)
    rows = range(m - sum(qp.balls))
    soft = [i for i in rows if np.isfinite(c[i])]
    width = n + 2 * len(soft)
    above = {i: n + j for j, i in enumerate(soft)}
    below = {i: n + len(soft) + j for j, i in enumerate(soft)}
    P, q = np.zeros((width, width)), np.zeros(width)
    P[:n, :n], q[:n] = qp.P, qp.q
    for i in soft:
        for column in (above[i], below[i]):
            P[column, column], q[column] = k[i], c[i]

    zero, cone, second, sizes = [], [], [], []  # (row, bound, position in y, sign)

    def row(i, sign):
        a = np.zeros(width)
        a[:n] = sign * qp.A[i]
        if i in above:
            a[above[i] if sign > 0 else below[i]] = -1
        return a

    for i in rows:
        if qp.l[i] == qp.u[i] and i not in above:
            zero.append((row(i, 1), qp.u[i], i, 1))
            continue
        if np.isfinite(qp.u[i]):
            cone.append((row(i, 1), qp.u[i], i, 1))
        if np.isfinite(qp.l[i]):
            cone.append((row(i, -1), -qp.l[i], i, -1))
    for column in range(n, width):
        cone.append((-np.eye(width)[column], 0.0, None, 0))
    for block, radius in ball_slices(qp):
        sizes.append(block.stop - block.start + 1)
        second.append((np.zeros(width), radius, None, 0))
        second += [(row(i, -1), -qp.l[i], i, -1) for i in range(block.start, block.stop)]
    G, bound, place, sign = zip(*zero, *cone, *second, strict=True)
    cones = [clarabel.ZeroConeT(len(zero))] if zero else []
    cones += [clarabel.NonnegativeConeT(len(cone))] if cone else []
    cones += [clarabel.SecondOrderConeT(size) for size in sizes]
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = 1e-12
    settings.max_iter = 500
    found = clarabel.DefaultSolver(
        sparse.csc_matrix(np.triu(P)), q, sparse.csc_matrix(np.array(G)), np.array(bound), cones,
        settings,
    ).solve()  # fmt: skip
    assert "Solved" in str(found.status) or "InsufficientProgress" in str(found.status)
    y = np.zeros(m)
    for i, s, dual in zip(place, sign, found.z, strict=True):
        if i is not None:
            y[i] += s * dual
    return np.array(found.x)[:n], y, found.obj_val


# Programs with a known answer. Draw z and for each row a value, a bound and a multiplier that
# satisfy the optimality conditions; then q = −Pz − A'y.


def soft_program(seed, scale=1.0, contradict=True):
    """(qp, z, y) with soft rows: inside, at the bound, beyond; L1, quadratic or both.

    scale: size of the penalties. contradict: two soft rows that no point satisfies together.
    At most N rows fix z, so that y is unique too.
    """
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((N, N))
    P, z, A = M @ M.T + 0.5 * np.eye(N), rng.standard_normal(N), rng.standard_normal((ROWS, N))
    c, k = np.full(ROWS, INF), np.zeros(ROWS)
    c[4:] = scale * rng.uniform(0.5, 2, 8) * rng.integers(0, 2, 8)
    k[4:] = np.where(c[4:] == 0, 1, rng.integers(0, 2, 8)) * scale * rng.uniform(0.5, 2, 8)
    if contradict:
        A[5] = A[4]
    v = A @ z
    slack = rng.uniform(0.2, 2, (2, ROWS))
    l, u, y = v - slack[0], v + slack[1], np.zeros(ROWS)
    side = rng.choice([-1, 1], ROWS)
    side[5] = -side[4]
    hard_push = rng.uniform(0.1, 3, ROWS)
    for i, kind in enumerate(["at", "equal", "in", "free", "beyond", "beyond"]
                             + ["beyond", "at", "in", "in", "beyond", "in"]):  # fmt: skip
        s = side[i]
        if kind in ("at", "equal"):
            l[i], u[i] = (l[i], v[i]) if s > 0 else (v[i], u[i])
            # A quadratic row without L1 weight has no multiplier at its bound.
            y[i] = s * (hard_push[i] if np.isinf(c[i]) else 0.7 * c[i])
        if kind == "equal":
            l[i] = u[i] = v[i]
        if kind == "free":
            l[i], u[i] = -INF, INF
        if kind == "beyond":
            d = slack[0, i]
            l[i], u[i] = (v[i] - d - 1, v[i] - d) if s > 0 else (v[i] + d, v[i] + d + 1)
            y[i] = s * (c[i] + k[i] * d)
    one_sided = (rng.uniform(size=ROWS) < 0.3) & (y > 0)
    l[one_sided] = -INF
    qp = jm.QP(P, -P @ z - A.T @ y, A, l, u, soft_linear=c, soft_quadratic=k)
    return qp, z, y


def ball_program(seed, active):
    """(qp, z, y) with interval rows and two balls; active: which balls hold with a multiplier."""
    rng = np.random.default_rng(seed)
    M = rng.standard_normal((N, N))
    P, z, A = M @ M.T + 0.5 * np.eye(N), rng.standard_normal(N), rng.standard_normal((ROWS, N))
    v, slack = A @ z, rng.uniform(0.2, 2, (2, ROWS))
    l, u, y = v - slack[0], v + slack[1], np.zeros(ROWS)
    u[0], y[0] = v[0], 1.5
    l[1], y[1] = v[1], -0.5
    radius, first = rng.uniform(0.3, 2, len(BALLS)), ROWS - sum(BALLS)
    for i, size in enumerate(BALLS):
        rows = slice(first, first + size)
        first += size
        normal = rng.standard_normal(size)
        normal /= np.linalg.norm(normal)
        share = 1.0 if active[i] else rng.uniform(0, 0.9)
        l[rows] = u[rows] = v[rows] - share * radius[i] * normal
        if active[i]:
            y[rows] = rng.uniform(0.2, 3) * normal
    return jm.QP(P, -P @ z - A.T @ y, A, l, u, radius=radius, balls=BALLS), z, y


def batch_of(programs):
    """Batches of qp, z and y from a list of (qp, z, y)."""
    return [stacked(part) for part in zip(*programs, strict=True)]


def soft_batch(scale=None, **kwargs):
    scale = np.ones(COUNT) if scale is None else scale
    return batch_of([soft_program(i, scale[i], **kwargs) for i in range(COUNT)])


def ball_batch():
    return batch_of([ball_program(i, (i % 2 == 0, i % 4 < 2)) for i in range(COUNT)])


class TestBounds:
    """One Bounds object with every kind of row and two balls, at many points."""

    def bounds(self, seed=0):
        """c, k, l, u of 30 rows (hard, L1, quadratic, both, none; bounds of every kind) and balls
        of 2 and 3 rows."""
        rng = np.random.default_rng(seed)
        c = np.tile([INF, 0.7, 0.0, 0.4, 0.0], 6)
        k = np.tile([0.0, 0.0, 1.3, 2.0, 0.0], 6)
        l = np.repeat([-1.0, -INF, 0.5, -INF, 0.3, -2.0], 5)
        u = np.repeat([1.0, 0.2, INF, INF, 0.3, -1.5], 5)
        centre = rng.standard_normal(5)
        return Bounds(
            np.concatenate([l, centre]), np.concatenate([u, centre]),
            np.concatenate([c, np.full(5, INF)]), np.concatenate([k, np.zeros(5)]),
            np.array([0.8, 1.2]), (2, 3),
        )  # fmt: skip

    def points(self, count=40, seed=1):
        """v near and far, and a penalty for each."""
        rng = np.random.default_rng(seed)
        v = rng.standard_normal((count, 35)) * rng.choice([0.5, 3.0, 30.0], (count, 1))
        return v, rng.choice([0.2, 1.0, 50.0], count)

    def g(self, b, p):
        """g(p), with the hard part forgiving rounding."""
        near = lambda i: penalty(p[i], b.l[i] - 1e-9, b.u[i] + 1e-9, INF, 0)
        out = sum(penalty(p[i], b.l[i], b.u[i], b.linear[i], b.quadratic[i])
                  if np.isfinite(b.linear[i]) else near(i) for i in range(30))  # fmt: skip
        for rows, radius in ((slice(30, 32), 0.8), (slice(32, 35), 1.2)):
            out += 0.0 if np.linalg.norm(p[rows] - b.l[rows]) <= radius + 1e-9 else INF
        return out

    def conjugate(self, b, y):
        out = sum(conjugate(y[i], b.l[i], b.u[i], b.linear[i], b.quadratic[i]) for i in range(30))
        for rows, radius in ((slice(30, 32), 0.8), (slice(32, 35), 1.2)):
            out += y[rows] @ b.l[rows] + radius * np.linalg.norm(y[rows])
        return out

    def each(self, name, b, *arguments):
        method = jax.jit(jax.vmap(lambda *a: getattr(jax.tree.map(jnp.asarray, b), name)(*a)))
        found = jax.tree.map(np.asarray, method(*arguments))
        return found.sum(axis=1) if name in ("cost", "support") else found

    def test_prox_of_rows_is_the_minimiser(self, x64):
        """p minimises g(p) + ½ρ(p − v)²: against scipy between v and its projection, where the
        minimiser must lie, and no point of a grid is better."""
        b = self.bounds()
        v, rho = self.points()
        p = self.each("project", b, v, rho)
        np.testing.assert_allclose(v - self.each("prox_residual", b, v, rho), p, atol=1e-12)
        for v_b, p_b, r in zip(v[:12], p[:12], rho[:12], strict=True):
            for i in range(30):
                row = (b.l[i], b.u[i], b.linear[i], b.quadratic[i])
                at = np.clip(v_b[i], b.l[i], b.u[i])
                if np.isinf(b.linear[i]):
                    assert p_b[i] == at or abs(p_b[i] - at) < 1e-14 * abs(v_b[i])
                    continue
                value = lambda x: penalty(x, *row) + r * (x - v_b[i]) ** 2 / 2  # noqa: B023
                low, high = sorted((at, v_b[i]))
                grid = [value(x) for x in np.linspace(low - 0.5, high + 0.5, 41)]
                assert value(p_b[i]) <= min(grid) * (1 + 1e-12) + 1e-14
                if low < high:
                    other = minimize_scalar(
                        value, bounds=(low, high), method="bounded", options={"xatol": 1e-10}
                    ).x
                    np.testing.assert_allclose(p_b[i], other, atol=1e-6 * (1 + high - low))

    def test_prox_of_a_row_far_outside_pays_its_weight(self, x64):
        """ρe is a subgradient of g at p: the weight c of a violated row, however far v is, and not
        what is left of a difference of two far points."""
        far = np.array([1e16, -1e16, 3e19, 5.0])
        b = Bounds(np.zeros(4), np.zeros(4), np.array([0.3, 2.0, 1e-7, 4.0]), np.zeros(4))
        e = self.each("prox_residual", b, far[None], np.full(1, 0.7))[0]
        np.testing.assert_allclose(0.7 * e, [0.3, -2.0, 1e-7, 0.7 * 5], rtol=1e-14)

    def test_prox_of_balls_is_the_nearest_point(self, x64):
        """Inside, nothing moves; outside, the nearest point of a grid over ball (2 rows) or
        sphere (3 rows) is never nearer than p, and p lies on the ball."""
        b, rng = self.bounds(), np.random.default_rng(2)
        v, rho = self.points()
        p = self.each("project", b, v, rho)
        for rows, radius in ((slice(30, 32), 0.8), (slice(32, 35), 1.2)):
            c, size = b.l[rows], rows.stop - rows.start
            directions = rng.standard_normal((20000, size))
            directions /= np.linalg.norm(directions, axis=1)[:, None]
            sample = c + radius * directions * rng.uniform(size=(20000, 1)) ** (0.2 / size)
            outside = 0
            for v_b, p_b in zip(v[:, rows], p[:, rows], strict=True):
                if np.linalg.norm(v_b - c) <= radius:
                    np.testing.assert_allclose(p_b, v_b, atol=1e-15)
                    continue
                outside += 1
                np.testing.assert_allclose(np.linalg.norm(p_b - c), radius, rtol=1e-12)
                distance = np.linalg.norm(sample - v_b, axis=1).min()
                assert np.linalg.norm(p_b - v_b) <= distance + 1e-12
                assert distance - np.linalg.norm(p_b - v_b) < 0.1  # the sample is dense enough
            assert 0 < outside < len(v)

    def test_moreau(self, x64):
        """y = ρe is the prox of the conjugate: it minimises g*(y) + |y − ρv|²/2ρ (Moreau 1965).
        The objective is convex, so nothing in a neighbourhood of any size may be better."""
        b, rng = self.bounds(), np.random.default_rng(3)
        v, rho = self.points()
        y = rho[:, None] * self.each("prox_residual", b, v, rho)
        for v_b, y_b, r in zip(v, y, rho, strict=True):
            value = lambda y: self.conjugate(b, y) + ((y - r * v_b) ** 2).sum() / (2 * r)  # noqa: B023
            # Rounding may leave y one ulp beyond an L1 weight, where g* is infinite.
            tidy = np.where((b.quadratic == 0), np.clip(y_b, -b.linear, b.linear), y_b)
            np.testing.assert_allclose(tidy, y_b, rtol=1e-12, atol=1e-14)
            least = value(tidy)
            assert np.isfinite(least)
            for size in (1e-3, 1e-1, 10.0):
                for _ in range(5):
                    other = tidy + size * rng.standard_normal(35) * (rng.uniform(size=35) < 0.2)
                    assert value(other) >= least - 1e-9 * (1 + abs(least))

    def test_fenchel_young(self, x64):
        """g(p) + g*(y) ≥ p'y, with equality exactly for y ∈ ∂g(p); cost and support are g and g*
        of numpy, and y = ρe is admissible."""
        b, rng = self.bounds(), np.random.default_rng(4)
        v, rho = self.points()
        e, p = self.each("prox_residual", b, v, rho), self.each("project", b, v, rho)
        y = self.each("admissible", b, rho[:, None] * e)
        np.testing.assert_allclose(y, rho[:, None] * e, rtol=1e-12, atol=1e-12)
        cost, support = self.each("cost", b, p), self.each("support", b, y)
        for i in range(len(v)):
            np.testing.assert_allclose(cost[i], self.g(b, p[i]), rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(support[i], self.conjugate(b, y[i]), rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(cost[i] + support[i], p[i] @ y[i], rtol=1e-9, atol=1e-9)
        other = self.each("admissible", b, 3 * rng.standard_normal((len(v), 35)))
        bound = cost + self.each("support", b, other)
        assert (bound >= np.sum(p * other, axis=1) - 1e-9).all()
        assert (bound > np.sum(p * other, axis=1) + 1e-3).any()

    def test_admissible_is_the_nearest_of_finite_support(self, x64):
        b, rng = self.bounds(), np.random.default_rng(5)
        y = 3 * rng.standard_normal((40, 35))
        near = self.each("admissible", b, y)
        raw, support = self.each("support", b, y), self.each("support", b, near)
        assert np.isfinite(support).all() and np.isinf(raw).all()
        np.testing.assert_array_equal(near, self.each("admissible", b, near))
        for y_b, near_b in zip(y, near, strict=True):
            for i in range(30):
                # In one dimension: what stays was finite already, what moved went to 0 or ±c.
                args = (b.l[i], b.u[i], b.linear[i], b.quadratic[i])
                if np.isfinite(conjugate(y_b[i], *args)):
                    assert near_b[i] == y_b[i]
                else:
                    ends = [t for t in (0.0, b.linear[i], -b.linear[i])
                            if np.isfinite(t) and np.isfinite(conjugate(t, *args))]  # fmt: skip
                    assert near_b[i] == min(ends, key=lambda t: abs(t - y_b[i]))  # noqa: B023
            np.testing.assert_array_equal(near_b[30:], y_b[30:])

    def test_curvature_is_the_derivative_of_the_excess(self, x64):
        """diag(weights) + Σ hh' against central differences, at points away from kinks; and its
        eigenvalues lie in [0, 1], since a prox is firmly nonexpansive."""
        b = jax.tree.map(jnp.asarray, self.bounds())
        v, rho = self.points()
        h = 1e-6

        def compare(v, rho):
            w, normals = b.curvature(v, rho)
            moved = jax.vmap(
                lambda d: (
                    (b.prox_residual(v + h * d, rho) - b.prox_residual(v - h * d, rho)) / (2 * h)
                )
            )(jnp.eye(35))
            kept = jax.vmap(
                lambda d: jnp.all(
                    b.active_set(v + 4 * h * d, rho) == b.active_set(v - 4 * h * d, rho)
                )
            )(jnp.eye(35))
            return jnp.diag(w) + sum(jnp.outer(n, n) for n in normals), moved, jnp.all(kept)

        D, numeric, smooth = map(np.asarray, jax.jit(jax.vmap(compare))(v, rho))
        assert smooth.mean() > 0.9
        np.testing.assert_allclose(D[smooth], numeric[smooth], atol=1e-7)
        eigenvalues = np.linalg.eigvalsh(D)
        assert eigenvalues.min() >= -1e-12 and eigenvalues.max() <= 1 + 1e-12
        # every kind of derivative has occurred
        assert {0.0, 1.0} < set(np.round(D[:, range(30), range(30)].ravel(), 6))

    def test_gradient_of_the_envelope(self, x64):
        """The derivative of min_p g(p) + ½ρ|p − v|² is ρe, kinks or not (it is smooth)."""
        b, rng = self.bounds(), np.random.default_rng(6)
        v, rho = self.points()
        direction, h = rng.standard_normal(v.shape), 1e-5

        def envelope(v):
            e, p = self.each("prox_residual", b, v, rho), self.each("project", b, v, rho)
            return [self.g(b, p_b) for p_b in p] + rho * np.sum(e**2, axis=1) / 2

        numeric = (envelope(v + h * direction) - envelope(v - h * direction)) / (2 * h)
        exact = rho * np.sum(self.each("prox_residual", b, v, rho) * direction, axis=1)
        np.testing.assert_allclose(exact, numeric, rtol=1e-6, atol=1e-4 * rho.max())

    @pytest.mark.first(1)
    @pytest.mark.parametrize("wide", [False, True])
    def test_extremes_give_numbers(self, wide):
        """All penalties from 0 and 1e-6 to 1e6 and inf with all kinds of intervals, balls of
        radius 0 and 1e6, at v on a kink, at the centre and far away: nothing but finite numbers,
        derivatives by JAX included."""
        c, k, (l, u) = [0.0, 1e-6, 1.0, 1e6, INF], [0.0, 1e-6, 1.0, 1e6], np.array(
            [(-INF, INF), (-INF, 1.0), (0.0, INF), (0.0, 0.0), (-1.0, 1.0), (-1e6, 1e6)]
        ).T  # fmt: skip
        grid = [axis.ravel() for axis in np.meshgrid(c, k, np.arange(len(l)), indexing="ij")]
        rows = [l[grid[2].astype(int)], u[grid[2].astype(int)], grid[0], grid[1]]
        balls = [np.zeros(6), np.zeros(6), np.full(6, INF), np.zeros(6)]
        with enable_x64(wide):
            dtype = jnp.float64 if wide else jnp.float32
            b = Bounds(
                *[jnp.asarray(np.concatenate(p), dtype) for p in zip(rows, balls, strict=True)],
                radius=jnp.asarray([0.0, 1.0, 1e6], dtype), balls=(2, 2, 2),
            )  # fmt: skip

            def everything(value, rho):
                v = jnp.full_like(b.l, value).at[-2:].set(2 * value)
                e = b.prox_residual(v, rho)
                y = b.admissible(rho * e)
                return (
                    e, b.project(v, rho), b.curvature(v, rho), b.active_set(v, rho), y,
                    b.support(y),
                    b.support(b.admissible(v)), b.cost(b.project(v, rho)), b.violation(v),
                    jax.jvp(lambda v: b.prox_residual(v, rho), (v,), (jnp.ones_like(v),)),
                    jax.grad(lambda v: jnp.sum(b.prox_residual(v, rho) ** 2))(v),
                )  # fmt: skip

            values = jnp.asarray([0.0, 1.0, -1.0, 1e-30, 1e6, -1e6], dtype)
            results = jax.jit(jax.vmap(jax.vmap(everything, (None, 0)), (0, None)))(
                values, jnp.asarray([1e-6, 1.0, 1e6], dtype)
            )
            for leaf in jax.tree.leaves(results):
                assert np.isfinite(leaf).all()
            inside = np.asarray(b.violation(results[1][-1, -1]))
            np.testing.assert_allclose(inside, 0, atol=1e-6 if wide else 0.2)

    def test_infinite_radius_is_a_free_ball(self, x64):
        """0·inf counts as 0 there, as it does for rows."""
        b = Bounds(jnp.zeros(2), jnp.zeros(2), radius=jnp.array([INF]), balls=(2,))
        np.testing.assert_array_equal(b.prox_residual(jnp.array([1e9, 1.0]), 1.0), 0)
        assert b.support(jnp.zeros(2)).sum() == 0


def with_slacks(qp):
    """The explicit program over (z, above, below): v − above + below ∈ [l, u], slacks ≥ 0, their
    costs the penalties. Slacks of hard rows are fixed to 0, so that all programs have one shape."""
    c, k = weights(qp)
    hard = np.isinf(c)
    P, cost = np.zeros((N + 2 * ROWS,) * 2), np.where(hard, 0.0, c)
    P[:N, :N] = qp.P
    P[range(N, N + 2 * ROWS), range(N, N + 2 * ROWS)] = np.tile(np.where(hard, 1.0, k), 2)
    eye, zero = np.eye(ROWS), np.zeros((2 * ROWS, N))
    A = np.block([[qp.A, -eye, eye], [zero, np.eye(2 * ROWS)]])
    l = np.concatenate([qp.l, np.zeros(2 * ROWS)])
    u = np.concatenate([qp.u, np.tile(np.where(hard, 0.0, INF), 2)])
    return jm.QP(P, np.concatenate([qp.q, cost, cost]), A, l, u)


def coarse_and_warm(qp, z, y):
    """Coarse steps are honest at wide and narrow tolerances; from the answer all are SOLVED."""
    solved = 0
    for eps in (1e-6, 1e-2, 1.0, 30.0):
        sol = solve_coarse(qp, eps)
        assert_honest(qp, sol, eps)
        solved += np.sum(sol.status == jm.Status.SOLVED)
    assert 0 < solved < 4 * COUNT
    warm = solve_warm(qp, 1e-6, (z, y))
    assert_honest(qp, warm, 1e-6)
    np.testing.assert_array_equal(warm.status, jm.Status.SOLVED)
    return warm


class TestSoftRows:
    def test_known_answers(self, x64):
        """z and y as constructed, feasible and infeasible hard version; residuals recomputed;
        multipliers c + k d beyond a bound, at most c where there is no quadratic weight."""
        for contradict in (True, False):
            qp, z, y = soft_batch(contradict=contradict)
            sol = solve_fine(qp, 1e-9)
            np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
            np.testing.assert_allclose(sol.z, z, atol=1e-8)
            np.testing.assert_allclose(sol.y, y, atol=1e-6)
            assert_honest(qp, sol, 1e-9)
            v = np.einsum("bij,bj->bi", qp.A, sol.z)
            d = np.maximum(np.maximum(qp.l - v, v - qp.u), 0)
            soft, c, k = np.isfinite(qp.soft_linear), qp.soft_linear, qp.soft_quadratic
            size = np.abs(np.asarray(sol.y))
            assert (size <= c)[soft & (k == 0)].all()
            beyond = soft & (d > 1e-3)
            assert beyond.sum() > 60
            np.testing.assert_allclose(size[beyond], c[beyond] + (k * d)[beyond], rtol=1e-7)

    def unknown(self):
        """Programs as above, half of them contradicting, moved away from their known answers."""
        rng = np.random.default_rng(7)
        programs = [soft_program(i, contradict=i % 2 == 0)[0] for i in range(COUNT)]
        return [replace(p, q=p.q + rng.standard_normal(N)) for p in programs]

    def test_slack_variables_by_another_solver(self, x64):
        """The same z and cost from Clarabel, which is given slack variables. Its z is right to
        2e-6 (see `TestBalls.test_second_order_cones`)."""
        programs = self.unknown()
        qp = stacked(programs)
        sol = solve_fine(qp, 1e-9)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        assert_honest(qp, sol, 1e-9)
        for i, program in enumerate(programs):
            z, _, cost = clarabel_answer(program)
            np.testing.assert_allclose(sol.z[i], z, atol=2e-6)
            np.testing.assert_allclose(sol.cost[i], cost, rtol=1e-8, atol=1e-8)

    @pytest.mark.slow
    def test_slack_variables_by_this_solver(self, x64):
        """The same z and cost from the explicit program, which has no curvature along slacks of
        L1 penalties."""
        programs = self.unknown()
        sol = solve_fine(stacked(programs), 1e-9)
        explicit = solve_fine(stacked([with_slacks(p) for p in programs]), 1e-6)
        np.testing.assert_array_equal(explicit.status, jm.Status.SOLVED)
        np.testing.assert_allclose(explicit.z[:, :N], sol.z, atol=1e-5)
        np.testing.assert_allclose(explicit.cost, sol.cost, rtol=1e-6, atol=1e-6)

    def priced(self):
        """A feasible hard program, its solution, and the largest multiplier of the rows that
        `soft` marks."""
        qp = soft_batch(contradict=False)[0]
        soft = np.isfinite(qp.soft_linear)
        # All intervals around one point: the hard version is feasible.
        point = np.random.default_rng(8).standard_normal((COUNT, N))
        v = np.einsum("bij,bj->bi", qp.A, point)
        never = np.full(soft.shape, INF)
        hard = replace(
            qp, l=v - 0.3, u=v + 0.3, soft_linear=never, soft_quadratic=np.zeros(soft.shape)
        )
        exact = solve_fine(hard, 1e-9)
        np.testing.assert_array_equal(exact.status, jm.Status.SOLVED)
        size = np.abs(np.where(soft, exact.y, 0.0)).max(axis=1, keepdims=True)
        assert (size > 0.1).all()
        return hard, soft, exact, size

    def test_exact_penalty(self, x64):
        """L1 weights above the largest multiplier give the hard solution, and below they do not:
        a row whose multiplier exceeds its weight must yield (Fletcher's exact penalty)."""
        hard, soft, exact, size = self.priced()
        for factor in (1.01, 100.0):
            sol = solve_fine(replace(hard, soft_linear=np.where(soft, factor * size, INF)), 1e-9)
            solved = np.asarray(sol.status) == jm.Status.SOLVED
            assert solved.mean() > 0.8
            np.testing.assert_allclose(sol.z[solved], exact.z[solved], atol=1e-8)
            np.testing.assert_allclose(sol.cost[solved], exact.cost[solved], rtol=1e-8, atol=1e-8)
        below = solve_fine(replace(hard, soft_linear=np.where(soft, 0.8 * size, INF)), 1e-9)
        solved = np.asarray(below.status) == jm.Status.SOLVED
        assert solved.mean() > 0.8
        assert (np.abs(below.z - exact.z).max(axis=1) > 1e-5)[solved].all()
        assert (below.cost < exact.cost - 1e-8)[solved].all()

    def test_small_penalties_are_solved(self, x64):
        """Every one of the programs above. An L1 row has curvature only where its multiplier is
        between 0 and c, a piece of width c/ρ, which the line search must find."""
        hard, soft, _, size = self.priced()
        for factor in (0.4, 0.8, 1.01):
            sol = solve_fine(replace(hard, soft_linear=np.where(soft, factor * size, INF)), 1e-9)
            np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)

    def test_penalty_sweep(self, x64):
        """Weights from 1e-3 to 1e6, rows contradict each other: solved, and z right to 1e-6."""
        qp, z, y = soft_batch(scale=np.geomspace(1e-3, 1e6, COUNT))
        sol = solve_fine(qp, 1e-9)
        assert np.isfinite(sol.z).all() and np.isfinite(sol.y).all()
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        np.testing.assert_allclose(sol.z, z, rtol=0, atol=1e-6)
        assert (np.abs(sol.y - y) <= 1e-6 * (1 + np.abs(y).max(axis=1, keepdims=True))).all()
        assert_honest(qp, sol, 1e-9)

    def test_penalties_of_a_million(self, x64):
        """All of them at 1e6, where rows are violated."""
        qp, z, _ = soft_batch(scale=np.full(COUNT, 1e6))
        sol = solve_fine(qp, 1e-9)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        np.testing.assert_allclose(sol.z, z, rtol=0, atol=1e-6)

    @pytest.mark.slow
    def test_penalty_sweep_float32(self):
        """Weights from 1e-3 to 1e4: no NaN, a status that holds, and moderate ones solved."""
        scale = np.geomspace(1e-3, 1e4, COUNT)
        qp, z, _ = soft_batch(scale=scale)
        qp = as32(qp)
        sol = solve_fine(qp, np.float32(1e-3))
        assert sol.z.dtype == jnp.float32
        assert np.isfinite(sol.z).all() and np.isfinite(sol.y).all()
        assert_honest(qp, sol, 1e-3)
        status = np.asarray(sol.status)
        assert np.isin(status, [jm.Status.SOLVED, jm.Status.ITERATION_LIMIT]).all()
        assert (status == jm.Status.SOLVED)[scale <= 10].all()
        np.testing.assert_allclose(sol.z[scale <= 10], z[scale <= 10], atol=5e-3)

    def test_violated_zero_row_costs_a_constant(self, x64):
        """0'z ∈ [1, 2] softly: the cost is c + k/2 whatever z is, and the rest is solved."""
        qp, z, _ = soft_batch()
        A, l, u = qp.A.copy(), qp.l.copy(), qp.u.copy()
        A[:, 11], l[:, 11], u[:, 11] = 0.0, 1.0, 2.0  # row 11 is inactive in `soft_program`
        sol = solve_fine(replace(qp, A=A, l=l, u=u), 1e-9)
        np.testing.assert_allclose(sol.z, z, atol=1e-8)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)

    @pytest.mark.slow
    def test_coarse_steps_are_honest(self, x64):
        """Three steps and no polish, cold and from the answer; wide and narrow tolerances."""
        qp, z, y = soft_batch()
        warm = coarse_and_warm(qp, z, y)
        np.testing.assert_allclose(warm.z, z, atol=1e-6)


# In the fast suite balls are met in the programs of `test_derivative.py`.
@pytest.mark.slow
class TestBalls:
    def test_known_answers(self, x64):
        """No ball, one or both active: z and the multipliers, along the normals, as constructed."""
        qp, z, y = ball_batch()
        sol = solve_fine(qp, 1e-9)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        np.testing.assert_allclose(sol.z, z, atol=1e-7)
        np.testing.assert_allclose(sol.y, y, atol=1e-6)
        assert_honest(qp, sol, 1e-9)

    def test_second_order_cones(self, x64):
        """Programs whose answer nothing tells, against Clarabel: z, cost and multipliers.

        Clarabel stops at a gap of 1e-12, and λ|Δz|²/2 ≤ gap with P ⪰ λI, λ = ½: its z is
        right to 2e-6 (`test_known_answers` asks for 1e-7 of constructed answers).
        """
        qp = ball_batch()[0]
        rng = np.random.default_rng(9)
        qp = replace(qp, q=qp.q + 3 * rng.standard_normal(qp.q.shape))
        sol = solve_fine(qp, 1e-9)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        assert_honest(qp, sol, 1e-9)
        active = np.zeros(2, int)
        for i in range(COUNT):
            z, y, cost = clarabel_answer(one(qp, i))
            np.testing.assert_allclose(sol.z[i], z, atol=2e-6)
            np.testing.assert_allclose(sol.cost[i], cost, rtol=1e-8, atol=1e-8)
            for j, (rows, _) in enumerate(ball_slices(one(qp, i))):
                a, b = np.asarray(sol.y[i][rows]), y[rows]
                if np.linalg.norm(b) > 1e-3:
                    active[j] += 1
                    turn = a / np.linalg.norm(a) - b / np.linalg.norm(b)
                    np.testing.assert_allclose(turn, 0, atol=1e-5)
        assert (active > COUNT // 4).all()

    def projection_program(self, rng, p, radius):
        """Project p onto {z: |A_b z − c| ≤ radius}: min ½|z − p|²; the other rows are free."""
        A, l = rng.standard_normal((ROWS, N)), np.full(ROWS, -INF)
        l[7:] = rng.standard_normal(5)
        u = np.where(np.isinf(l), INF, l)
        return jm.QP(np.eye(N), -p, A, l, u, radius=np.array([radius, 1e6]), balls=BALLS)

    def test_projection_onto_an_ellipsoid(self, x64):
        """z(λ) = (I + λA'A)⁻¹(p + λA'c) with λ the root of |A z(λ) − c| = r; y = λ(A z − c).
        Points a thousand radii away, and inside."""
        rng = np.random.default_rng(10)
        size, radius = 10 ** rng.uniform(-1, 3, COUNT), 10 ** rng.uniform(-1, 1, COUNT)
        programs = [
            self.projection_program(rng, size[i] * rng.standard_normal(N), radius[i])
            for i in range(COUNT)
        ]
        qp = stacked(programs)
        sol = solve_fine(qp, 1e-8)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        for i, program in enumerate(programs):
            A, c, p, r = program.A[7:10], program.l[7:10], -program.q, program.radius[0]
            point = lambda t: np.linalg.solve(np.eye(N) + t * A.T @ A, p + t * A.T @ c)  # noqa: B023
            excess = lambda t: np.linalg.norm(A @ point(t) - c) - r  # noqa: B023
            t = 0.0 if excess(0) <= 0 else brentq(excess, 0, 1e9, xtol=1e-14, rtol=1e-14)
            z = point(t)
            np.testing.assert_allclose(sol.z[i], z, atol=1e-7 * (1 + np.abs(z).max()))
            np.testing.assert_allclose(sol.y[i][7:10], t * (A @ z - c), atol=1e-6 * (1 + t * r))

    def test_radius_zero_is_an_equality(self, x64):
        """A_b z = c: the KKT system solved by numpy."""
        rng = np.random.default_rng(11)
        programs = [self.projection_program(rng, rng.standard_normal(N), 0.0)
                    for _ in range(COUNT)]  # fmt: skip
        sol = solve_fine(stacked(programs), 1e-8)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        for i, program in enumerate(programs):
            A, c = program.A[7:10], program.l[7:10]
            kkt = np.block([[np.eye(N), A.T], [A, np.zeros((3, 3))]])
            answer = np.linalg.solve(kkt, np.concatenate([-program.q, c]))
            scale = 1 + np.abs(answer).max()
            np.testing.assert_allclose(sol.z[i], answer[:N], atol=1e-7 * scale)
            np.testing.assert_allclose(sol.y[i][7:10], answer[N:], atol=1e-5 * scale)

    def emptied(self):
        """On the ball, w'(Az − c) ≥ −r|w|; row 6 asks for less by a margin: nothing satisfies
        both. The other rows are inactive bounds."""
        qp = ball_batch()[0]
        rng = np.random.default_rng(12)
        A, l, u = qp.A.copy(), qp.l.copy(), qp.u.copy()
        margin = np.geomspace(0.03, 3, COUNT)
        for i in range(COUNT):
            w = rng.standard_normal(3)
            A[i, 6] = w @ A[i, 7:10]
            reach = w @ l[i, 7:10] - qp.radius[i, 0] * np.linalg.norm(w)
            l[i, 6], u[i, 6] = -INF, reach - margin[i] * np.linalg.norm(w)
        return replace(qp, A=A, l=l, u=u)

    @pytest.mark.slow
    @pytest.mark.parametrize("wide", [True, False])
    def test_ball_against_half_space(self, wide):
        """PRIMAL_INFEASIBLE with a Farkas vector: A'y = 0 and Σ u y⁺ − l y⁻ + c'y_b + r|y_b| < 0.
        A'y is compared with rounding of its own terms, since no row bounds a variable alone."""
        qp = self.emptied()
        with enable_x64(wide):
            qp = qp if wide else as32(qp)
            sol = solve_fine(qp, 1e-9 if wide else np.float32(1e-3))
            found = np.asarray(sol.status) == jm.Status.PRIMAL_INFEASIBLE
            others = np.asarray(sol.status)[~found]
            assert np.isin(others, (jm.Status.ITERATION_LIMIT, jm.Status.INACCURATE)).all()
            assert found.mean() > 0.9 if wide else found.mean() > 0.8
            for i in np.flatnonzero(found):
                p, y = as64(one(qp, i)), np.asarray(sol.certificate[i], float)
                left, terms = p.A.T @ y, np.abs(p.A.T) @ np.abs(y)
                eps = np.finfo(np.float64 if wide else np.float32).eps
                assert (np.abs(left) <= 50 * eps * terms).all()
                total = sum(conjugate(y[j], p.l[j], p.u[j], INF, 0) for j in range(7))
                for rows, radius in ball_slices(p):
                    total += p.l[rows] @ y[rows] + radius * np.linalg.norm(y[rows])
                assert total < 0
                np.testing.assert_allclose(np.abs(y).max(), 1, rtol=1e-6)

    def test_ball_around_everything_changes_nothing(self, x64):
        """A ball that z is deep inside: the answer without it, wherever its centre is."""
        programs = [ball_program(i, (False, False)) for i in range(COUNT)]
        qp, z, y = batch_of(programs)
        for radius in (1e2, 1e6):
            sol = solve_fine(replace(qp, radius=np.full(qp.radius.shape, radius)), 1e-9)
            np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
            np.testing.assert_allclose(sol.z, z, atol=1e-8)
            np.testing.assert_array_equal(sol.y[:, 7:], 0)

    def test_infinite_radius(self, x64):
        programs = [ball_program(i, (False, False)) for i in range(COUNT)]
        qp, z, _ = batch_of(programs)
        sol = solve_fine(replace(qp, radius=np.full(qp.radius.shape, INF)), 1e-9)
        np.testing.assert_allclose(sol.z, z, atol=1e-8)
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)

    @pytest.mark.slow
    def test_float32(self):
        qp, z, y = ball_batch()
        qp = as32(qp)
        sol = solve_fine(qp, np.float32(1e-3))
        assert sol.z.dtype == jnp.float32
        np.testing.assert_array_equal(sol.status, jm.Status.SOLVED)
        np.testing.assert_allclose(sol.z, z, atol=5e-3)
        np.testing.assert_allclose(sol.y, y, atol=5e-2)
        assert_honest(qp, sol, 1e-3)

    @pytest.mark.slow
    def test_coarse_steps_are_honest(self, x64):
        qp, z, y = ball_batch()
        coarse_and_warm(qp, z, y)
        empty = solve_coarse(self.emptied(), 1e-6)
        assert jm.Status.SOLVED not in np.asarray(empty.status)


class TestOwnMatrices:
    """Each element of a batch with its own P and A (the shapes above: soft rows and balls)."""

    @pytest.mark.parametrize("make", [soft_batch, ball_batch], ids=["soft", "balls"])
    @pytest.mark.slow
    def test_batch_agrees_with_single(self, x64, make):
        """A program's answer does not depend on its neighbours (to rounding: other kernels)."""
        qp = make()[0]
        batch = solve_coarse(qp, 1e-6)
        single = jax.jit(lambda qp: jm.solve_qp(qp, replace(COARSE, eps=1e-6)))
        for i in range(COUNT):
            alone = single(one(qp, i))
            np.testing.assert_allclose(batch.z[i], alone.z, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(batch.y[i], alone.y, rtol=1e-8, atol=1e-8)
            assert batch.status[i] == alone.status

    @pytest.mark.slow
    @pytest.mark.parametrize("count", [64, 2048])
    @pytest.mark.parametrize("x32", [False, True])
    def test_large_batch_agrees_with_single(self, count, x32):
        """Loop and polish, whole batch against one by one and against the construction."""
        programs = [soft_program(seed) for seed in range(count)]
        qp, z, _ = batch_of(programs)
        with enable_x64(not x32):
            qp = as32(qp) if x32 else qp
            eps = np.float32(1e-3) if x32 else 1e-9
            batch = jax.tree.map(np.asarray, solve_fine(qp, eps))
            solved = batch.status == jm.Status.SOLVED
            assert solved.mean() > 0.99  # the rest: see `test_small_penalties_are_solved`
            np.testing.assert_allclose(batch.z[solved], z[solved], atol=2e-2 if x32 else 1e-7)
            single = jax.jit(lambda qp, eps: jm.solve_qp(qp, jm.ADMM(eps=eps)))
            for i in range(0, count, max(count // 256, 1)):
                alone = single(one(qp, i), eps)
                np.testing.assert_allclose(batch.z[i], alone.z, atol=1e-2 if x32 else 1e-7)
                assert batch.status[i] == alone.status

    @pytest.mark.slow
    @pytest.mark.parametrize("make", [soft_batch, ball_batch], ids=["soft", "balls"])
    @pytest.mark.parametrize("wide", [True, False])
    def test_bad_matrices_stay_alone(self, make, wide):
        """NaN or infinity in one P or A: NON_FINITE there, and neighbours bit for bit the same."""
        with enable_x64(wide):
            qp, eps = make()[0], 1e-6
            qp, eps = (qp, eps) if wide else (as32(qp), np.float32(eps))
            P, A = qp.P.copy(), qp.A.copy()
            P[1, 0, 0], P[5, 2, 3], A[9, 4, 1], A[31, 11, 0] = np.nan, INF, np.nan, -INF
            expected, got = solve_fine(qp, eps), solve_fine(replace(qp, P=P, A=A), eps)
            bad = np.isin(np.arange(COUNT), [1, 5, 9, 31])
            np.testing.assert_array_equal(np.asarray(got.status)[bad], jm.Status.NON_FINITE)
            assert np.isnan(got.z[bad]).all() and np.isnan(got.cost[bad]).all()
            for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
                np.testing.assert_array_equal(a[~bad], b[~bad])


HANG = """
import jax, jax.numpy as jnp, numpy as np, jaxmpc as jm
rng = np.random.default_rng(0)
B, n, m = 2048, 8, 14
M = rng.standard_normal((B, n, n)).astype(np.float32)
P, A = M @ M.transpose(0, 2, 1) + np.eye(n, dtype=np.float32), rng.standard_normal((B, m, n))
q, l = rng.standard_normal((B, n)), np.where(np.arange(m) < m - 4, -1.0, 0.0) * np.ones((B, 1))
soft = np.where(np.arange(m) < 5, 1.0, np.inf) * np.ones((B, 1))
qp = jm.QP(P, q, A, l, -l, soft_linear=soft, radius=np.ones((B, 1)), balls=(4,))
qp = jax.tree.map(np.float32, qp)
status = jax.jit(jax.vmap(lambda p: jm.solve_qp(p, jm.ADMM(iterations=10, newton_steps=10)).status))
assert (np.asarray(status(qp)) == 1).mean() > 0.9
"""


@pytest.mark.slow
@pytest.mark.timeout(200)
@pytest.mark.parametrize("cured", [True, False])
def test_large_batches_of_own_matrices_end(cured):
    """With and without the environment's cures for old jaxlibs (see conftest.py)."""
    environment = dict(os.environ)
    if not cured:
        environment.pop("NPROC", None)
        environment.pop("XLA_FLAGS", None)
    subprocess.run([sys.executable, "-c", HANG], env=environment, check=True, timeout=180)


class TestBadInput:
    def program(self, **fields):
        """Four rows on two variables, the last two a ball."""
        l, u = np.array([-1.0, -1, 0, 0]), np.array([1.0, 1, 0, 0])
        A = np.vstack([np.eye(2), np.eye(2)])
        qp = jm.QP(np.eye(2), np.zeros(2), A, l, u, radius=np.ones(1), balls=(2,))
        return replace(qp, **fields)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            (dict(soft_linear=np.ones(3)), "soft_linear"),
            (dict(soft_linear=np.ones((4, 1))), "soft_linear"),
            (dict(soft_linear=1.0), "soft_linear"),
            (dict(soft_linear=np.array([-1, 1, INF, INF])), "soft_linear"),
            (dict(soft_linear=np.array([np.nan, 1, INF, INF])), "soft_linear"),
            (dict(soft_quadratic=np.ones(3)), "soft_quadratic"),
            (dict(soft_quadratic=np.array([-1.0, 0, 0, 0])), "soft_quadratic"),
            (dict(soft_quadratic=np.array([np.nan, 0, 0, 0])), "soft_quadratic"),
            (dict(soft_quadratic=np.array([INF, 0, 0, 0])), "soft_quadratic"),
            (dict(soft_linear=np.array([INF, INF, 1.0, INF])), "soft_linear"),
            pytest.param(
                dict(soft_quadratic=np.array([0, 0, 1.0, 0])),
                "soft_quadratic",
            ),
            (dict(radius=None), "radius"),
            (dict(balls=()), "balls"),
            (dict(balls=(5,)), "balls"),
            (dict(balls=(0,)), "balls"),
            (dict(balls=(3, -1), radius=np.ones(2)), "balls"),
            (dict(balls=(2, 3), radius=np.ones(2)), "balls"),
            (dict(radius=np.ones(2)), "radius"),
            (dict(radius=1.0), "radius"),
            (dict(radius=np.array([-0.1])), "radius"),
            (dict(radius=np.array([np.nan])), "radius"),
            (dict(u=np.array([1.0, 1, 0.1, 0])), "l, u"),
            (dict(l=np.array([-1, -1, -INF, 0])), "l, u"),
            (dict(l=np.array([-1, -1, np.nan, 0]), u=np.array([1, 1, np.nan, 0])), "l, u"),
        ],
    )
    def test_raises_before_anything_compiles(self, change, words, monkeypatch):
        def compiled(*_):
            pytest.fail("reached the compiled solver")

        monkeypatch.setattr("jaxmpc.qp.solve._solve", compiled)
        with pytest.raises(ValueError, match=words):
            jm.solve_qp(self.program(**change))

    def spoilt(self, make, changes):
        """The batch, and it with element i of `field` changed; solved by the coarse solver."""
        clean = make()[0]
        qp = clean
        for i, field, at, value in changes:
            array = getattr(qp, field).copy()
            array[i][at] = value
            qp = replace(qp, **{field: array})
        bad = np.isin(np.arange(COUNT), [change[0] for change in changes])
        expected, got = solve_coarse(clean, 1e-6), solve_coarse(qp, 1e-6)
        np.testing.assert_array_equal(np.asarray(got.status)[bad], jm.Status.NON_FINITE)
        assert np.isnan(got.z[bad]).all() and np.isnan(got.primal_residual[bad]).all()
        for a, b in zip(jax.tree.leaves(expected), jax.tree.leaves(got), strict=True):
            np.testing.assert_array_equal(a[~bad], b[~bad])

    @pytest.mark.slow
    def test_bad_weights_in_a_batch(self, x64):
        changes = [
            (2, "soft_linear", 5, -1.0), (4, "soft_linear", 7, np.nan),
            (6, "soft_quadratic", 5, -1.0), (8, "soft_quadratic", 5, np.nan),
            (10, "soft_quadratic", 5, INF),
        ]  # fmt: skip
        self.spoilt(soft_batch, changes)

    @pytest.mark.slow
    def test_bad_balls_in_a_batch(self, x64):
        changes = [
            (2, "radius", 0, -0.1), (4, "radius", 1, np.nan), (6, "u", 8, 1e3), (8, "l", 10, -1e3),
            (10, "l", 7, np.nan), (12, "u", 11, INF),
        ]  # fmt: skip
        self.spoilt(ball_batch, changes)

    @pytest.mark.slow
    def test_soft_balls_in_a_batch(self, x64):
        """A finite L1 weight in the rows of a ball means nothing: that instance has bad data."""

        def make():
            qp = ball_batch()[0]
            return [replace(qp, soft_linear=np.full_like(qp.l, INF))]

        self.spoilt(make, [(3, "soft_linear", 8, 1.0)])

    @pytest.mark.slow
    def test_integers_and_lists(self, x64):
        """min ½|z|² − 3Σz with |z₁| ≤ 1 at cost d + ½d², |z₂| ≤ 1 at cost 2d, |(z₃, z₄)| ≤ 1.

        Row 1: 3 − z₁ = 1 + (z₁ − 1) gives 3/2. Row 2: its multiplier 3 − 1 = 2 is the weight.
        Disc: the nearest point to (3, 3).
        """
        eye = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
        sol = jm.solve_qp(
            jm.QP(
                eye, [-3, -3, -3, -3], eye, [-1, -1, 0, 0], [1, 1, 0, 0],
                soft_linear=[1, 2, INF, INF], soft_quadratic=[1, 0, 0, 0], radius=[1], balls=(2,),
            ),
            jm.ADMM(iterations=300, newton_steps=0),
        )  # fmt: skip
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, [1.5, 1, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-6)
        np.testing.assert_allclose(sol.y[:2], [1.5, 2], atol=1e-6)
