"""Derivatives of the QP solution: closed forms, central differences, envelope theorem, finiteness.

Central differences are taken where no row is near a change of its piece: all multipliers, slacks
and distances are above 0.2 there, and both sides must be SOLVED. Elsewhere the documented element
of the generalised derivative (head of `jaxmpc/qp/derivative.py`) is compared with a closed form.
"""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.qp.admm import factorise
from jaxmpc.qp.derivative import dense_conditions, linearised

INF = np.inf
# Without the polish a program compiles several times faster; ADMM alone converges on easy ones.
PLAIN = jm.ADMM(iterations=1000, newton_steps=0)
UNROLLED = replace(PLAIN, differentiate="unrolled")
# Directions of the data; "bounds" moves l and u alike, equalities and centres of balls included.
DIRECTIONS = ("P", "q", "A", "l", "u", "bounds", "soft_linear", "soft_quadratic", "radius")


BATCH = 64  # one compiled program of one shape serves most tests


def outputs(qp: jm.QP, solver: jm.ADMM) -> tuple:
    """What has a derivative, z, y and cost; and the status."""
    sol = jm.solve_qp(qp, solver)
    return (sol.z, sol.y, sol.cost), sol.status


@cache
def program(iterations: int = 200, newton_steps: int = 30, differentiate: str = "implicit"):
    """(qp, d, ct, smoothing) → outputs, status, J d, J'ct for BATCH programs of one shape."""

    @jax.jit
    def run(qp, d, ct, smoothing):
        solver = jm.ADMM(
            iterations, newton_steps=newton_steps, differentiate=differentiate, smoothing=smoothing
        )

        @jax.vmap
        def one(qp, d, ct):
            out, push, status = jax.linearize(partial(outputs, solver=solver), qp, has_aux=True)
            (gradient,) = jax.linear_transpose(push, qp)(ct)
            return out, status, push(d), gradient

        return one(qp, d, ct)

    return run


def evaluate(qps: list, ds: list, ct: tuple | None = None, smoothing=0.0, run=None) -> tuple:
    """`program` on lists, BATCH at a time, the last filled up by repetition; as numpy arrays.

    ct: cotangents of z, y, cost, the same for all; ones by default."""
    dtype = qps[0].q.dtype
    ct = (np.ones(8), np.ones(14), np.ones(())) if ct is None else ct
    cast = partial(jax.tree.map, lambda v: np.asarray(v, dtype))
    results = []
    for first in range(0, len(qps), BATCH):
        places = range(first, first + BATCH)
        parts = [stack([trees[i % len(trees)] for i in places]) for trees in (qps, ds, [ct])]
        results.append((run or program())(*map(cast, (*parts, smoothing))))
    return jax.tree.map(lambda *v: np.concatenate(v)[: len(qps)], *results)


def item(tree: Any, i: int) -> Any:
    return jax.tree.map(lambda v: v[i], tree)


def inner(a: Any, b: Any) -> float:
    return sum(np.sum(x * y) for x, y in zip(*map(jax.tree.leaves, (a, b)), strict=True))


def stack(trees: list) -> Any:
    return jax.tree.map(lambda *v: np.stack(v), *trees)


def everything(seed: int) -> tuple[jm.QP, np.ndarray, np.ndarray]:
    """A QP built from its answer (qp, z, y), with a row of each kind in each of its pieces.

    Rows: hard and met above, below, on both sides; inactive, one-sided, free; soft and inside, at
    its bound with |y| < weight, beyond it above and below; a ball that is met; one that is not.
    Five rows and normals fix z in R⁸, so z and y are unique and, nearby, smooth.
    """
    rng = np.random.default_rng(seed)
    n, m = 8, 14
    M = rng.standard_normal((n, n))
    P, A, z = M @ M.T / n + 0.5 * np.eye(n), rng.standard_normal((m, n)), rng.standard_normal(n)
    v, y = A @ z, np.zeros(m)
    l, u = v - rng.uniform(0.3, 1, m), v + rng.uniform(0.3, 1, m)
    linear, quadratic = np.full(m, INF), np.zeros(m)
    push, d = rng.uniform(0.3, 2, m), rng.uniform(0.3, 1, m)
    u[0], y[0] = v[0], push[0]
    l[1], y[1] = v[1], -push[1]
    l[2] = u[2] = v[2]
    y[2] = -push[2]
    l[4], l[5], u[5] = -INF, -INF, INF
    linear[6:10], quadratic[6:10] = rng.uniform(0.3, 1, 4), rng.uniform(0.3, 2, 4)
    u[7], y[7], linear[7] = v[7], push[7], push[7] + 0.5
    u[8], y[8] = v[8] - d[8], linear[8] + quadratic[8] * d[8]
    l[8] = u[8] - 1
    l[9], y[9] = v[9] + d[9], -linear[9] - quadratic[9] * d[9]
    u[9] = l[9] + 1
    normal = rng.standard_normal(2)
    normal, radius = normal / np.linalg.norm(normal), rng.uniform(0.5, 2, 2)
    l[10:12] = u[10:12] = v[10:12] - radius[0] * normal
    y[10:12] = push[10] * normal
    l[12:] = u[12:] = v[12:] + 0.3 * radius[1]
    qp = jm.QP(P, -P @ z - A.T @ y, A, l, u, linear, quadratic, radius, balls=(2, 2))
    return qp, z, y


def zeros(qp: jm.QP) -> jm.QP:
    return jax.tree.map(np.zeros_like, qp)


def direction(qp: jm.QP, name: str, seed: int) -> jm.QP:
    """A random change of one field; P stays symmetric, l = u where it is, infinite what is."""
    rng, still = np.random.default_rng([seed, *name.encode()]), zeros(qp)
    if name == "bounds":
        d = rng.standard_normal(qp.l.shape)
        return replace(still, l=d * np.isfinite(qp.l), u=d * np.isfinite(qp.u))
    value = getattr(qp, name)
    d = np.where(np.isfinite(value), rng.standard_normal(value.shape), 0.0)
    if name == "P":
        d = d + d.T
    if name in "lu":
        d = d * (qp.l < qp.u)
    if name == "soft_quadratic":
        d = d * np.isfinite(qp.soft_linear)
    return replace(still, **{name: d})


def moved(qp: jm.QP, d: jm.QP, h: float) -> jm.QP:
    return jax.tree.map(lambda v, dv: v + h * dv, qp, d)


def assert_near(got: Any, expected: Any, rtol: float) -> None:
    """Every output as one vector: |difference| ≤ rtol |expected|."""
    for name, a, b in zip(("z", "y", "cost"), got, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=rtol * (1e-2 + np.abs(b).max()), err_msg=name)


class TestEveryField:
    """z, y and cost against central differences; jvp and vjp are each other's adjoint."""

    @pytest.mark.long
    @pytest.mark.first(1)
    @pytest.mark.parametrize("first", range(0, 288, 8))
    def test_central_differences(self, x64, first):
        h, cases = 4e-4, [(first + seed, name) for seed in range(8) for name in DIRECTIONS]
        programs = [everything(seed) for seed, _ in cases]
        qps = [qp for qp, _, _ in programs]
        ds = [direction(qp, name, seed) for qp, (seed, name) in zip(qps, cases, strict=True)]
        rng = np.random.default_rng(0)
        ct = (rng.standard_normal(8), rng.standard_normal(14), np.ones(()))
        at, status, exact, gradient = evaluate(qps, ds, ct)
        np.testing.assert_array_equal(status, jm.Status.SOLVED)
        np.testing.assert_allclose(at[0], np.stack([z for _, z, _ in programs]), atol=1e-8)
        np.testing.assert_allclose(at[1], np.stack([y for _, _, y in programs]), atol=1e-7)
        sides = []
        for side in (h, -h, 2 * h, -2 * h):
            values, status, _, _ = evaluate(
                [moved(qp, d, side) for qp, d in zip(qps, ds, strict=True)], ds
            )
            np.testing.assert_array_equal(status, jm.Status.SOLVED)
            sides.append(values)
        # Differences of fourth order, so that h is large enough for the rounding of z.
        central = lambda a, b, c, d: (8 * (a - b) - (c - d)) / (12 * h)
        numeric = jax.tree.map(central, *sides)
        for i, case in enumerate(cases):
            for name, a, b in zip(("z", "y", "cost"), exact, numeric, strict=True):
                tolerance = 1e-5 * (1e-2 + np.abs(b[i]).max())
                note = f"d {name}, seed and field {case}"
                np.testing.assert_allclose(a[i], b[i], rtol=0, atol=tolerance, err_msg=note)
            # <ct, J d> = <J'ct, d>
            left, right = inner(ct, item(exact, i)), inner(item(gradient, i), ds[i])
            np.testing.assert_allclose(right, left, rtol=1e-8, atol=1e-8, err_msg=str(case))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        np.testing.assert_allclose(gradient.P, np.swapaxes(gradient.P, 1, 2), atol=1e-12)


@pytest.mark.slow
class TestClosedForms:
    @pytest.mark.parametrize("solver", [PLAIN, UNROLLED], ids=["implicit", "unrolled"])
    def test_equalities(self, x64, solver):
        """K (z, y) = (−q, b), K the KKT matrix: d(z, y) = K⁻¹(−dq − dP z − dA'y, db − dA z)."""
        rng = np.random.default_rng(3)
        n, m = 5, 3
        P, A = np.diag(rng.uniform(0.5, 2, n)), rng.standard_normal((m, n))
        q, b = rng.standard_normal(n), rng.standard_normal(m)
        K = np.block([[P, A.T], [A, np.zeros((m, m))]])
        answer = np.linalg.solve(K, np.concatenate([-q, b]))
        z, y = answer[:n], answer[n:]

        @jax.jit
        @partial(jax.jacrev, argnums=(0, 1, 2, 3))
        def jacobian(P, q, A, b):
            sol = jm.solve_qp(jm.QP(P, q, A, b, b), solver)
            return jnp.concatenate([sol.z, sol.y])

        of_P, of_q, of_A, of_b = jacobian(P, q, A, b)
        inverse = np.linalg.inv(K)
        near = partial(np.testing.assert_allclose, rtol=1e-8, atol=1e-9)
        near(of_q, -inverse[:, :n])
        near(of_b, inverse[:, n:])
        full = -np.einsum("ai,j->aij", inverse[:, :n], z)
        near(of_P, (full + np.swapaxes(full, 1, 2)) / 2)
        push, turn = np.einsum("aj,i->aij", inverse[:, :n], y), inverse[:, n:, None] * z
        near(of_A, -push - turn)

    @pytest.mark.parametrize("mode", ["implicit", "unrolled"])
    def test_box(self, x64, mode):
        """P = I, A = I: z = clip(−q, l, u), so dz/dq, dz/dl, dz/du are masks, and exactly so."""
        q, one = jnp.array([0.3, -0.8, 2.0, -1.5, 5.0]), jnp.ones(5)
        solver = replace(PLAIN, differentiate=mode)

        @jax.jit
        @partial(jax.jacrev, argnums=(0, 1, 2))
        def jacobian(q, l, u):
            return jm.solve_qp(jm.QP(jnp.eye(5), q, jnp.eye(5), l, u), solver).z

        masks = -1.0 * (jnp.abs(q) < 1), q > 1, q < -1
        for got, mask in zip(jacobian(q, -one, one), masks, strict=True):
            np.testing.assert_allclose(got, np.diag(np.asarray(mask, float)), atol=1e-14)

    @pytest.mark.parametrize("size", [1, 3])
    def test_ball(self, x64, size):
        """z = centre + r d/|d|, d = −q − centre: dz/dq = −r/|d| (I − nn'), dz/dr = n, y = d − rn.

        Inside the ball z = −q whatever the radius and the centre."""
        rng = np.random.default_rng(size)
        centre, radius = rng.standard_normal(size), np.array([0.7])

        @jax.jit
        @partial(jax.jacfwd, argnums=(0, 1, 2))
        def jacobian(q, centre, radius):
            eye = jnp.eye(size)
            qp = jm.QP(eye, q, eye, centre, centre, radius=radius, balls=(size,))
            return outputs(qp, PLAIN)[0][:2]

        n = rng.standard_normal(size)
        n /= np.linalg.norm(n)
        near = partial(np.testing.assert_allclose, atol=1e-10)
        for length in (2.0, 0.3):
            (zq, zc, zr), (yq, yc, yr) = jacobian(-centre - length * n, centre, radius)
            outside = length > 0.7
            turn = 0.7 / length * (np.eye(size) - np.outer(n, n)) if outside else np.eye(size)
            near(zq, -turn)
            near(zc, np.eye(size) - turn)
            near(zr[:, 0], n if outside else 0 * n)
            near(yq, turn - np.eye(size))
            near(yc, turn - np.eye(size))
            near(yr[:, 0], -n if outside else 0 * n)

    def test_soft_row(self, x64):
        """min ½(z − a)² + c d + ½ k d², d = max(z − u, 0) or max(l − z, 0).

        Above: inside (a < u) z = a; at the bound (a < u + c) z = u, y = a − u; beyond it
        d = (a − u − c)/(1 + k), z = u + d, y = c + k d. Below the mirror image. cost = ½z² − az
        plus penalty."""
        cases, expected = [], []
        for c, k in ((0.5, 0.0), (0.5, 2.0), (0.0, 2.0)):
            for side in (1.0, -1.0):
                for gap in (-0.4, 0.25, 1.5):
                    if gap < c or gap != 0.25:
                        cases.append((side * (1 + gap), 1.0, c, k))
                        beyond, at = gap > c, 0 < gap < c
                        d = max(gap - c, 0) / (1 + k)
                        s, b = side, beyond
                        share = k / (1 + k) if b else float(at)
                        z = (1 - share, s * share, -s * b / (1 + k), -s * d / (1 + k))
                        y = (share, -s * share, s * b / (1 + k), s * d / (1 + k))
                        push = c + k * d if b else (gap if at else 0.0)
                        cost = (-s * (1 + min(gap, 0) + d), -push, d, d**2 / 2)
                        expected.append((z, y, cost))

        @jax.jit
        @jax.vmap
        def jacobian(x):
            def f(x):
                a, u, c, k = x[:, None]
                one = jnp.eye(1)
                (z, y, cost), _ = outputs(jm.QP(one, -a, one, -u, u, c, k), PLAIN)
                return z[0], y[0], cost

            return jax.jacrev(f)(x)

        got = np.stack(jacobian(np.array(cases)), axis=1)
        np.testing.assert_allclose(got, np.array(expected), atol=1e-9)


class TestOptimalValue:
    """Envelope theorem: the derivative of the optimal value is that of the Lagrangian."""

    def check(self, qp: jm.QP, gradient: jm.QP, z, y) -> None:
        near = partial(np.testing.assert_allclose, rtol=1e-7, atol=1e-7)
        near(gradient.q, z)
        near(gradient.P, np.outer(z, z) / 2)
        near(gradient.A, np.outer(y, z))
        rows = np.arange(len(y) - sum(qp.balls))
        near(gradient.u[rows], -np.maximum(y, 0)[rows])
        near(gradient.l[rows], np.maximum(-y, 0)[rows])

    @pytest.mark.slow
    def test_every_kind_of_row(self, x64):
        """Soft rows: dV/dc = d, dV/dk = d²/2. Balls: dV/dradius = −|y_b|, dV/dcentre = −y_b."""
        programs = [everything(seed) for seed in range(5)]
        qps, ct = [qp for qp, _, _ in programs], (np.zeros(8), np.zeros(14), np.ones(()))
        _, _, _, gradient = evaluate(qps, qps, ct)
        for i, (qp, z, y) in enumerate(programs):
            one = item(gradient, i)
            self.check(qp, one, z, y)
            v = qp.A @ z
            d = np.where(np.isfinite(qp.soft_linear), np.abs(v - np.clip(v, qp.l, qp.u)), 0)
            near = partial(np.testing.assert_allclose, atol=1e-7)
            near(one.soft_linear, d)
            near(one.soft_quadratic, d**2 / 2)
            near(one.radius, [-np.linalg.norm(y[10:12]), -np.linalg.norm(y[12:])])
            near((one.l + one.u)[10:], -y[10:])

    @pytest.mark.long
    def test_dependent_rows(self, x64):
        """Two more rows with a push, 2 × row 0 and row 0 + row 1: y is one of many. The value is
        still smooth in q and P, which do not see y, and along a move of the whole feasible set,
        where y'A is all that counts: central differences."""
        h, rng = 1e-5, np.random.default_rng(0)
        qp, z, y = everything(0)
        A, y, l, u = qp.A.copy(), y.copy(), qp.l.copy(), qp.u.copy()
        A[3], A[4] = 2 * A[0], A[0] - A[1]
        y[3:5], l[3:5], u[3:5] = [0.7, 0.4], -INF, (A @ z)[3:5]
        qp = replace(qp, A=A, l=l, u=u, q=-qp.P @ z - A.T @ y)
        shift = rng.standard_normal(8)
        still = zeros(qp)
        ds = [
            replace(still, q=rng.standard_normal(8)),
            replace(still, P=np.outer(shift, shift)),
            replace(still, l=A @ shift * np.isfinite(l), u=A @ shift * np.isfinite(u)),
        ]
        ct = (np.zeros(8), np.zeros(14), np.ones(()))
        sides = [moved(qp, d, s) for s in (0, h, -h) for d in ds]
        out, status, exact, gradient = evaluate(sides, ds * 3, ct)
        np.testing.assert_array_equal(status, jm.Status.SOLVED)
        np.testing.assert_allclose(out[0][0], z, atol=1e-8)
        self.check(qp, item(gradient, 0), z, out[1][0])
        numeric = (out[2][3:6] - out[2][6:]) / (2 * h)
        np.testing.assert_allclose(exact[2][:3], numeric, rtol=1e-6, atol=1e-7)
        assert np.isfinite(exact[0]).all() and np.isfinite(exact[1]).all()


class TestSecondOrder:
    @pytest.mark.slow
    def test_value(self, x64):
        """dV/dq = z, hence d²V/dq² = dz/dq, and V is concave in q."""
        qp, _, _ = everything(0)

        @jax.jit
        def evaluate(q):
            f = lambda q: outputs(replace(qp, q=q), PLAIN)[0]
            return jax.hessian(lambda q: f(q)[2])(q), jax.jacfwd(lambda q: f(q)[0])(q)

        hessian, jacobian = evaluate(jnp.asarray(qp.q))
        np.testing.assert_allclose(hessian, jacobian, atol=1e-10)
        np.testing.assert_allclose(hessian, hessian.T, atol=1e-10)
        assert np.linalg.eigvalsh(hessian).max() < 1e-10

    @pytest.mark.slow
    @pytest.mark.parametrize("slack_ball", [False, True])
    def test_finite_differences_of_the_gradient(self, x64, slack_ball):
        """Second derivatives along two directions that change all fields at once, in both orders,
        with a ball that is met, and with one beside it that is not."""
        qp, _, _ = everything(1)
        if not slack_ball:  # the second ball becomes two hard rows that are not met
            qp = replace(qp, balls=(2,), radius=qp.radius[:1])
            order = np.r_[0:10, 12:14, 10:12]
            l = qp.l.copy()
            l[12:] -= 1.0
            take = lambda v: v[order]
            qp = replace(
                qp, A=take(qp.A), l=take(l), u=take(qp.u), soft_linear=take(qp.soft_linear),
                soft_quadratic=take(qp.soft_quadratic),
            )  # fmt: skip
        rng = np.random.default_rng(0)
        names = [name for name in DIRECTIONS if name not in "lu"]
        sums = [[direction(qp, name, i) for name in names] for i in range(2)]
        ds = [jax.tree.map(lambda *v: sum(v), *parts) for parts in sums]
        a, b = rng.standard_normal(8), rng.standard_normal(14)

        def scalars(t):
            shifted = jax.tree.map(lambda v, *d: v + t[0] * d[0] + t[1] * d[1], qp, *ds)
            (z, y, cost), _ = outputs(shifted, PLAIN)
            return jnp.stack([jnp.sum(a * z) + jnp.sum(b * y), cost])

        @jax.jit
        @jax.vmap
        def evaluate(t):
            gradient = jax.jacrev(scalars)
            return gradient(t), jax.jacfwd(gradient)(t), jax.jacrev(jax.jacfwd(scalars))(t)

        h = 1e-5
        points = h * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
        gradient, *seconds = evaluate(points)
        numeric = np.stack([gradient[1] - gradient[2], gradient[3] - gradient[4]], axis=-1) / (
            2 * h
        )
        for second in seconds:
            for i in range(2):
                scale = np.abs(numeric[i]).max()
                np.testing.assert_allclose(second[0, i], numeric[i], atol=1e-5 * scale)


def joint_batch(count: int) -> tuple[jm.QP, jm.QP]:
    """QPs that share P and A, about half of the rows of a box met; and axes for `vmap`."""
    rng = np.random.default_rng(0)
    n = 4
    M = rng.standard_normal((n, n))
    A = np.vstack([np.eye(n), rng.standard_normal((2, n))])
    l, u = -rng.uniform(0.3, 1, (count, 6)), rng.uniform(0.3, 1, (count, 6))
    qp = jm.QP(M @ M.T + np.eye(n), 4 * rng.standard_normal((count, n)), A, l, u)
    return qp, jm.QP(P=None, q=0, A=None, l=0, u=0)


def loss(qp: jm.QP, solver: jm.ADMM = PLAIN):
    """A scalar that all of z and y enter."""
    sol = jm.solve_qp(qp, solver)
    return jnp.sum(jnp.arange(1.0, sol.z.size + 1) * sol.z) + 0.1 * jnp.sum(sol.y**2)


class TestTransformations:
    @pytest.mark.slow
    def test_gradient_of_shared_matrices_is_the_sum(self, x64):
        """vmap(grad) gives each instance's own; grad of a batch's sum adds up those of P and A."""
        qp, axes = joint_batch(64)

        @jax.jit
        def evaluate(qp):
            total = lambda qp: jnp.sum(jax.vmap(loss, in_axes=(axes,))(qp))
            return jax.grad(total)(qp), jax.vmap(jax.grad(loss), in_axes=(axes,))(qp)

        shared, each = evaluate(qp)
        near = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9)
        for name in ("P", "A"):
            near(getattr(shared, name), getattr(each, name).sum(axis=0))
        for name in "qlu":
            near(getattr(shared, name), getattr(each, name))

    @pytest.mark.slow
    def test_float32_is_near_float64(self):
        qp, axes = joint_batch(64)
        gradient = jax.jit(jax.vmap(jax.grad(loss), in_axes=(axes,)))
        with enable_x64(True):
            wide = jax.tree.map(np.asarray, gradient(qp))
        narrow = gradient(jax.tree.map(np.float32, qp))
        for name in ("P", "q", "A", "l", "u"):
            got, expected = getattr(narrow, name), getattr(wide, name)
            assert got.dtype == jnp.float32
            scale = np.abs(expected).reshape(64, -1).max(axis=1)
            error = np.abs(got - expected).reshape(64, -1).max(axis=1)
            assert (error <= 1e-3 * (scale + 1)).all(), (name, (error / (scale + 1)).max())

    @pytest.mark.slow
    @pytest.mark.parametrize("build", ["solve", "controller"])
    def test_closed_loop(self, x64, build):
        """Cost of eight closed-loop steps, inputs at their limit in the first ones: gradient with
        respect to x0 and Q through `scan` against central differences."""
        A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
        system = jm.LinearSystem(A, B)
        solver = jm.ADMM(iterations=800, newton_steps=0)

        def cost(x0, Q):
            one = np.ones(1)
            mpc = jm.MPC(
                system=system, Q=Q, R=np.eye(1), horizon=5, inputs=jm.Box(-one, one),
                states=jm.Box(np.full(2, -5.0), np.full(2, 5.0)), prestabilise=False,
            )  # fmt: skip
            controller = jm.Controller(mpc, solver) if build == "controller" else None

            def step(x, _):
                if controller is None:
                    plan = jm.solve(mpc, x, solver=solver)
                else:
                    plan = controller.plan(x)
                u = plan.inputs[0]
                return A @ x + B @ u, (jnp.sum(x**2) + jnp.sum(u**2), plan.status, u)

            _, (stage, status, u) = jax.lax.scan(step, x0, length=8)
            return jnp.sum(stage), (status, u)

        x0, Q, h = jnp.array([2.0, 0.5]), jnp.diag(jnp.array([3.0, 0.5])), 1e-5
        evaluate = jax.jit(jax.value_and_grad(cost, (0, 1), has_aux=True))
        (_, (status, u)), (of_x, of_Q) = evaluate(x0, Q)
        np.testing.assert_array_equal(status, jm.Status.SOLVED)
        assert (np.abs(u) > 1 - 1e-9).sum() in range(1, 8)
        value = lambda x0, Q: evaluate(x0, Q)[0][0]
        for e in np.eye(2):
            numeric = (value(x0 + h * e, Q) - value(x0 - h * e, Q)) / (2 * h)
            np.testing.assert_allclose(of_x @ e, numeric, rtol=1e-5)
            D = np.diag(e)
            numeric = (value(x0, Q + h * D) - value(x0, Q - h * D)) / (2 * h)
            np.testing.assert_allclose(np.sum(of_Q * D), numeric, rtol=1e-5, atol=1e-7)


def embedded(P: Any, q: Any, A: Any, l: Any, u: Any) -> jm.QP:
    """A small program in the shape of `everything`: the first variables and rows are its own, the
    other variables have cost ½z² and lie deep in the two balls, the other rows are zero."""
    n, m = len(q), len(l)
    big = jm.QP(
        np.eye(8), np.zeros(8), np.zeros((14, 8)), np.full(14, -INF), np.full(14, INF),
        np.full(14, INF), np.zeros(14), np.full(2, 10.0), balls=(2, 2),
    )  # fmt: skip
    big.P[:n, :n], big.q[:n], big.A[:m, :n], big.l[:m], big.u[:m] = P, q, A, l, u
    big.A[10:, 4:], big.l[10:], big.u[10:] = np.eye(4), 0.0, 0.0
    return big


def unit(name: str, *index: int) -> jm.QP:
    """The direction that moves one entry of one field."""
    d = zeros(everything(0)[0])
    getattr(d, name)[index] = 1.0
    return d


CASES = 288
KINDS = ("degenerate", "weak", "infeasible", "unbounded", "plain", "NaN")


def hard_case(seed: int) -> tuple[jm.QP, str]:
    """A program that has no ordinary derivative, in the shape of `everything`, from small integers:
    rows met twice; rows met without a push, exactly; contradicting rows; P = 0 and hardly a bound;
    NaN in one field."""
    rng = np.random.default_rng(seed)
    kind, n, m = KINDS[seed % len(KINDS)], 8, 14
    whole = lambda *shape: rng.integers(-2, 3, shape).astype(float)
    P, A, z, y = np.eye(n), whole(m, n), whole(n), np.zeros(m)
    if kind in ("degenerate", "infeasible"):
        A[1], A[3] = A[0], 2 * A[2]
    if kind == "degenerate":
        y[:4] = rng.integers(0, 3, 4)
    if kind == "unbounded":
        P = np.zeros((n, n))
    v = A @ z
    l, u = np.full(m, -INF), v + rng.integers(0, 2, m)
    u[:4] = v[:4]
    if kind == "infeasible":
        l[1], u[1] = u[0] + 1, INF
    linear, quadratic = np.full(m, INF), np.zeros(m)
    linear[6:9], quadratic[7:9] = (1.0, 0.0, 2.0), 1.0
    q = -P @ z - A.T @ y
    if kind == "unbounded":
        u[:10], q = INF, whole(n) + 0.5
    radius = rng.integers(0, 2, 2).astype(float)  # a ball of radius zero is a point
    l[10:] = u[10:] = v[10:]
    l[10] = u[10] = v[10] + radius[0]
    qp = jm.QP(P, q, A, l, u, linear, quadratic, radius, balls=(2, 2))
    if kind == "NaN":
        name = ("P", "q", "A", "l", "u", "soft_linear", "radius")[seed // len(KINDS) % 7]
        getattr(qp, name).flat[0] = np.nan
    return qp, kind


class TestFiniteForEveryStatus:
    """The gradient of Σz + Σy + cost is a number whatever became of the program."""

    def check(self, first: int, dtype: Any, run=None) -> tuple[np.ndarray, np.ndarray]:
        cases = [hard_case(first + seed) for seed in range(CASES)]
        qps = [jax.tree.map(lambda v: v.astype(dtype), qp) for qp, _ in cases]
        kinds = np.array([kind for _, kind in cases])
        _, status, _, gradient = evaluate(qps, qps, run=run)
        for field in ("P", "q", "A", "l", "u", "soft_linear", "soft_quadratic", "radius"):
            finite = np.isfinite(getattr(gradient, field)).reshape(CASES, -1).all(axis=1)
            bad = {kind: int((~finite & (kinds == kind)).sum()) for kind in KINDS}
            assert finite.all(), (field, bad, first + np.flatnonzero(~finite)[:5])
        nan = kinds == "NaN"
        np.testing.assert_array_equal(status[nan], jm.Status.NON_FINITE)
        for leaf in jax.tree.leaves(gradient):
            np.testing.assert_array_equal(leaf[nan], 0)
        clean = [qps[0] if bad else qp for qp, bad in zip(qps, nan, strict=True)]
        _, _, _, alone = evaluate(clean, qps, run=run)
        for a, b in zip(*map(jax.tree.leaves, (gradient, alone)), strict=True):
            np.testing.assert_array_equal(a[~nan], b[~nan])
        return kinds, status

    @pytest.mark.long
    def test_float64(self, x64):
        kinds, status = self.check(0, np.float64)
        for kind, expected in (
            ("degenerate", "SOLVED"), ("weak", "SOLVED"), ("infeasible", "PRIMAL_INFEASIBLE"),
        ):  # fmt: skip
            share = np.mean(status[kinds == kind] == jm.Status[expected])
            assert share > 0.7, (kind, np.unique(status[kinds == kind], return_counts=True))
        assert jm.Status.DUAL_INFEASIBLE in status[kinds == "unbounded"]

    @pytest.mark.slow
    def test_float32_without_polish(self):
        """None to 1e-6: a tolerance of a few roundings, which ADMM alone seldom meets."""
        _, status = self.check(0, np.float32, program(20, 0))
        assert {jm.Status.INACCURATE, jm.Status.ITERATION_LIMIT} & set(status)

    @pytest.mark.slow
    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    @pytest.mark.parametrize("steps", [(200, 30), (20, 0), (3, 0)])
    def test_ten_thousand(self, dtype, steps):
        with enable_x64(dtype == np.float64):
            for first in range(CASES, 10_000, CASES):
                self.check(first, dtype, program(*steps))


class TestInfeasible:
    """z is the answer of the closest feasible program: violations least in the sense of squares
    over rows of length one (P = I and unit rows: those of the data), then the cost."""

    def test_closed_forms(self, x64):
        """Line: z₁ ≥ 2, z₁ ≥ 1.4, z₁ ≤ 0.5: the mean of the three, each moves it by a third, and
        z₂ = −q₂. Plane: a'z ≥ 1, a'z ≤ 0: a'z = ½ and z = −q along the rest, |z₁| ≤ 10 is free."""
        a, q, e = np.array([0.6, 0.8]), np.array([0.5, -1.0]), np.array([1.0, 0.0])
        programs = (
            (np.array([e, e, e]), [2, 1.4, -INF], [INF, INF, 0.5]),
            (np.array([a, a, e]), [1, -INF, -10], [INF, 0, 10]),
        )
        qps = [embedded(np.eye(2), q, *program) for program in programs for _ in range(8)]
        ds = [unit("q", i) for i in range(2)] + [unit(f, i) for f in "lu" for i in range(3)]
        ds = [
            jax.tree.map(lambda v, b: v * np.isfinite(b), d, qp)
            for d, qp in zip(ds * 2, qps, strict=True)
        ]
        out, status, exact, _ = evaluate(qps, ds)
        np.testing.assert_array_equal(status, jm.Status.PRIMAL_INFEASIBLE)
        z, dz = out[0][:, :2].reshape(2, 8, 2), exact[0][:, :2].reshape(2, 8, 2)
        rest, zero = np.eye(2) - np.outer(a, a), 0 * a
        np.testing.assert_allclose(z[:, 0], [[1.3, 1.0], -rest @ q + a / 2], atol=1e-5)
        line = [zero, [0, -1], e / 3, e / 3, zero, zero, zero, e / 3]
        plane = [*-rest, a / 2, zero, zero, zero, a / 2, zero]
        np.testing.assert_allclose(dz, [line, plane], atol=1e-3)

    def test_central_differences(self, x64):
        """`everything` with row 4 against row 0: both fail by the same distance at z in the scaled
        rows a_i'T/|a_i'T|, where |a_i'T|² = a_i'P⁻¹a_i. Moved are q, bounds, soft weights and
        radius; P and A would also change what "closest" means."""
        h, names = 5e-4, ("q", "l", "u", "bounds", "soft_linear", "soft_quadratic", "radius")
        qps, ds, answers, cases = [], [], [], []
        for seed in range(8):
            qp, z, y = everything(seed)
            A, l, u = qp.A.copy(), qp.l.copy(), qp.u.copy()
            A[4] = 1.5 * A[0]
            size = 0.5 * np.sqrt(np.einsum("ij,ij->i", A, np.linalg.solve(qp.P, A.T).T))
            v = A @ z
            l[0], u[0], l[4], u[4] = -INF, v[0] - size[0], v[4] + size[4], INF
            qp = replace(qp, A=A, l=l, u=u)
            for name in names:
                qps.append(qp), ds.append(direction(qp, name, seed)), answers.append(z)
                cases.append((seed, name))
        out, status, exact, _ = evaluate(qps, ds)
        np.testing.assert_array_equal(status, jm.Status.PRIMAL_INFEASIBLE)
        np.testing.assert_allclose(out[0], answers, atol=1e-4)
        shifted = lambda s: [moved(qp, d, s) for qp, d in zip(qps, ds, strict=True)]
        plus, minus = (evaluate(shifted(s), ds)[0][0] for s in (h, -h))
        numeric = (plus - minus) / (2 * h)
        error = np.abs(exact[0] - numeric).max(axis=1) / (np.abs(numeric).max(axis=1) + 0.1)
        bad = [(case, float(e)) for case, e in zip(cases, error, strict=True) if not e < 5e-3]
        assert not bad, bad


def level_of(p: np.ndarray, S: np.ndarray) -> float:
    """λ with |S z(λ)| = 1, z(λ) = (I + λS²)⁻¹ p: S diagonal, |Sp| > 1."""
    size = lambda level: np.linalg.norm(S @ (p / (1 + level * np.diag(S) ** 2))) - 1
    return scipy.optimize.brentq(size, 0.0, 1e3, xtol=1e-15)


class TestKinks:
    """min ½z² + qz, z ≤ u, is z = min(−q, u): one-sided derivatives at q = −u are −1 and 0 with
    respect to q, 0 and 1 with respect to u."""

    def at(self, q, u=1.0, a=1.0, mu=0.0):
        """d(z, y)/dq, /du, /da of min ½z² + qz, a z ≤ u at up to 96 points."""
        q, u, a = np.broadcast_arrays(*map(np.atleast_1d, map(np.float64, (q, u, a))))
        parts = zip(q, u, a, strict=True)
        qps = [embedded([[1]], [qi], [[ai]], [-INF], [ui]) for qi, ui, ai in parts]
        names = (unit("q", 0), unit("u", 0), unit("A", 0, 0))
        ds = [d for d in names for _ in qps]
        _, status, (dz, dy, _), gradient = evaluate(qps * 3, ds, smoothing=mu)
        np.testing.assert_array_equal(status, jm.Status.SOLVED)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
        return np.stack([dz[:, 0], dy[:, 0]], axis=1).reshape(3, -1, 2)

    def test_weakly_active_counts_as_inactive(self, x64):
        """Several bounds, so that rounding leaves the multiplier at zero, above, or below it."""
        u = np.linspace(0.1, 3, 30)
        of_q, of_u, of_a = self.at(-u, u)
        np.testing.assert_allclose(of_q, np.tile([-1.0, 0.0], (30, 1)), atol=1e-9)
        np.testing.assert_allclose(of_u, 0, atol=1e-9)
        np.testing.assert_allclose(of_a, 0, atol=1e-9)

    def test_a_slight_push_counts_as_active(self, x64):
        for push in (1e-3, 1e-6, 1e-9):
            of_q, of_u, _ = self.at(-1 - push)
            np.testing.assert_allclose(of_q, [[0, -1]], atol=1e-6)
            np.testing.assert_allclose(of_u, [[1, -1]], atol=1e-6)

    @pytest.mark.parametrize("mu", [1e-4, 1e-2])
    def test_smoothed_is_that_of_the_central_path(self, x64, mu):
        """z + q + μ/(u − z) = 0: with the slack s, s − μ/s = u + q and dz/dq = −1/(1 + μ/s²).
        z(q − δ, u + δ) = z(q, u) + δ, so dz/du = 1 + dz/dq. (In dz/da the multiplier of the
        exact solution takes part.)"""
        q = np.linspace(-3, 1, 41)
        of_q, of_u, _ = self.at(q, mu=mu)
        tau = 1 + q
        s = (tau + np.sqrt(tau**2 + 4 * mu)) / 2
        slope = -1 / (1 + mu / s**2)
        near = partial(np.testing.assert_allclose, atol=1e-5)
        near(of_q[:, 0], slope)
        near(of_q[:, 1], -1 - slope)
        near(of_u[:, 0], 1 + slope)
        near(of_u[:, 1], -1 - slope)
        # The same scan is continuous, without a jump at the kink.
        fine = np.linspace(-1.01, -0.99, 96)
        for part in self.at(fine, mu=mu):
            assert np.abs(np.diff(part[:, 0])).max() < 2e-2 * np.abs(part[:, 0]).max() + 1e-6

    def test_small_smoothing_is_none(self, x64):
        """μ → 0 away from the kink, every argument."""
        q = np.array([-2.0, -1.3, -0.7, 0.5])
        for smooth, exact in zip(self.at(q, a=1.1, mu=1e-12), self.at(q, a=1.1), strict=True):
            np.testing.assert_allclose(smooth, exact, atol=1e-5)

    def test_between_the_one_sided_derivatives(self, x64):
        """At z = u = 1 without a push: dz/dq in (−1, 0), dz/du in (0, 1), dz/da in (−1, 0)."""
        for mu in (1e-8, 1e-4, 1e-2):
            of_q, of_u, of_a = (float(v[0, 0]) for v in self.at(-1.0, mu=mu))
            assert -0.99 < of_q < -0.01
            assert 0.01 < of_u < 0.99
            assert -0.99 < of_a < -0.01

    @pytest.mark.long
    def test_small_multipliers_of_soft_rows_in_float32(self):
        """min ½|z − t|² + max(a'z − b, 0) at a'z = b with a multiplier of about 10⁻⁴ of z, of whose
        size the rounding of a'z seems to be: dz/dt is the projection on the row."""
        rng = np.random.default_rng(0)
        a, z = rng.normal(size=(1024, 3)), 10 * rng.normal(size=(1024, 3))
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        y = rng.uniform(0.8e-4, 1.2e-4, 1024) * np.abs(z).max(axis=1)
        t, b = z + y[:, None] * a, np.sum(a * z, axis=1)

        @jax.jit
        @jax.vmap
        def derivative(t, a, b, z, y):
            one = np.ones(1, np.float32)
            soft = {"soft_linear": one, "soft_quadratic": 0 * one}
            qp = jm.QP(np.eye(3, dtype=np.float32), -t, a[None], -INF * one, b[None], **soft)
            factor = factorise(qp.P, qp.A, jm.ADMM())
            conditions, undo = dense_conditions(qp, (factor, 0.0), z, y[None])
            along = lambda t: conditions(replace(qp, q=-t))
            return jax.vmap(lambda d: undo(jax.jvp(along, (t,), (d,))[1])[0])(
                np.eye(3, dtype=np.float32)
            )

        found = derivative(*map(np.float32, (t, a, b, z, y)))
        expected = np.eye(3) - a[:, :, None] * a[:, None, :]
        np.testing.assert_allclose(found, expected, atol=1e-5)

    @pytest.mark.long
    def test_active_sets_in_bad_condition_in_float32(self):
        """Rows a, b at an angle of 0.01 that hold z at a vertex, dz/du = (a, b)⁻ᵀ; and the distance
        from p to an ellipse |Sz| ≤ 1 with half axes 1 and 1/300, z = M⁻¹p with M = I + λS²,
        dz/dp = M⁻¹ − nn'/n'Mn with n = M⁻¹S²z. In float32 alone both were wrong by a half."""
        angle, one, eye = np.float32(0.01), np.ones(2, np.float32), np.eye(2, dtype=np.float32)
        rows = np.array([[1.0, 0.0], [np.cos(angle), np.sin(angle)]], np.float32)
        S = np.diag([1.0, 300.0]).astype(np.float32)

        @jax.jit
        @jax.vmap
        def jacobian(p, u, radius, z, y):
            """Of the point next to p with both rows ≤ u in the ellipse of this radius."""
            A, centre = np.vstack([rows, S]), 0 * one

            def program(p, u):
                l, u = jnp.concatenate([-INF * one, centre]), jnp.concatenate([u, centre])
                return jm.QP(eye, -p, A, l, u, radius=radius[None], balls=(2,))

            made = factorise(eye, jnp.asarray(A), jm.ADMM(), (2,))
            conditions, undo = dense_conditions(program(p, u), (made, 0.0), z, y)
            along = lambda *d: undo(jax.jvp(lambda *v: conditions(program(*v)), (p, u), d)[1])[0]
            turned = lambda *d: jax.vmap(along, out_axes=1)(*d)
            return turned(eye, 0 * eye), turned(0 * eye, eye)

        # The vertex: z − p + rows'y = 0. The ellipse: z(λ) − p + S'y = 0 with y = λ S z.
        vertex = np.linalg.solve(rows.astype(float), 0.5 * one)
        push = one - np.linalg.solve(rows.T.astype(float), vertex)
        points, none = np.array([[1.5, 0.3], [0.5, 0.1], [-2, 1]]), np.zeros(2)
        weights = [1 + level_of(p, S) * np.diag(S) ** 2 for p in points]
        ends = [(p / w, np.append(none, np.linalg.solve(S, p - p / w)))
                for p, w in zip(points, weights, strict=True)]  # fmt: skip
        z, y = map(np.stack, zip((vertex, np.append(push, none)), *ends, strict=True))
        p, u = np.vstack([rows.T @ one, points]), np.vstack([0.5 * one, np.full((3, 2), INF)])
        of_p, of_u = jacobian(*map(np.float32, (p, u, [INF, 1, 1, 1], z, y)))
        inverse = np.linalg.inv(rows.astype(float))
        np.testing.assert_allclose(of_u[0], inverse, atol=1e-3 * np.abs(inverse).max())
        for p, found in zip(points, of_p[1:], strict=True):
            M = np.eye(2) + level_of(p, S) * S.astype(float) ** 2
            n = np.linalg.solve(M, S**2 @ np.linalg.solve(M, p))
            expected = np.linalg.inv(M) - np.outer(n, n) / (n @ M @ n)
            np.testing.assert_allclose(found, expected, atol=1e-5)

    def test_smoothing_of_many_rows(self, x64):
        """Every field of a program away from kinks: μ → 0 gives the exact derivative."""
        qp, _, _ = everything(2)
        ds = [direction(qp, name, 0) for name in DIRECTIONS]
        smooth, exact = (evaluate([qp] * 9, ds, smoothing=mu)[2] for mu in (1e-13, 0.0))
        for i, name in enumerate(DIRECTIONS):
            for a, b in zip(smooth, exact, strict=True):
                np.testing.assert_allclose(a[i], b[i], atol=1e-4, err_msg=name)


class TestUnrolled:
    """Derivatives of the steps as they were taken, of the settings and the start too."""

    @pytest.mark.slow
    def test_settings_and_start(self, x64):
        qp, z, y = everything(0)
        rng = np.random.default_rng(0)
        rows = rng.uniform(0.5, 2, 14)
        rows[10:12], rows[12:] = rows[10], rows[12]  # a ball has one penalty

        def f(rho, alpha, z, y):
            solver = jm.ADMM(9, rho=rho, alpha=alpha, newton_steps=0, differentiate="unrolled")
            sol = jm.solve_qp(qp, solver, warm_start=(z, y))
            return jnp.sum(jnp.sin(sol.z)) + jnp.sum(sol.y**2)

        # Near the answer: a start farther off than zero is dropped.
        at = (rows, 1.5, z + 0.1 * rng.standard_normal(8), y + 0.1 * rng.standard_normal(14))
        f, h = jax.jit(f), 1e-6
        gradient = jax.jit(jax.grad(f, (0, 1, 2, 3)))(*at)
        for i, value in enumerate(at):
            d = rng.standard_normal(np.shape(value))
            if i == 0:
                d[10:12], d[12:] = d[10], d[12]
            shifted = lambda t, i=i, d=d: f(*[v + t * d if j == i else v for j, v in enumerate(at)])
            numeric = (shifted(h) - shifted(-h)) / (2 * h)
            assert abs(numeric) > 1e-3  # the argument matters
            np.testing.assert_allclose(np.sum(gradient[i] * d), numeric, rtol=1e-5)

    @pytest.mark.long
    def test_implicit_ignores_settings_and_start(self, x64):
        qp, z, y = everything(0)
        f = lambda rho, z: jnp.sum(jm.solve_qp(qp, jm.ADMM(rho=rho), warm_start=(z, y)).z)
        for part in jax.jit(jax.grad(f, (0, 1)))(1.0, z):
            np.testing.assert_array_equal(part, 0)

    @pytest.mark.slow
    def test_converged_is_implicit(self, x64):
        """Where the steps have converged, their derivative has too: all fields."""
        qp, _, _ = everything(0)
        total = lambda qp: sum(map(jnp.sum, outputs(qp, UNROLLED)[0]))
        steps = jax.jit(jax.grad(total))(qp)
        exact = item(evaluate([qp], [qp])[3], 0)
        # How an equality shares its derivative between l and u is nobody's business.
        equal = np.asarray(qp.l) == np.asarray(qp.u)
        joined = lambda g: replace(g, l=g.l + np.where(equal, g.u, 0), u=np.where(equal, 0, g.u))
        pair = joined(steps), joined(exact)
        for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)

    @pytest.mark.slow
    def test_float32_without_64_bit_mode(self):
        """Residuals are computed in float64 behind the scenes, and take no part in it."""
        qp, _ = joint_batch(1)
        q = jnp.asarray(qp.q[0], jnp.float32)
        qp = jax.tree.map(np.float32, replace(qp, l=qp.l[0], u=qp.u[0]))
        solver = jm.ADMM(20, newton_steps=0, differentiate="unrolled")
        gradient = jax.grad(lambda q: loss(replace(qp, q=q), solver))(q)
        assert gradient.dtype == jnp.float32 and np.isfinite(gradient).all()

    @pytest.mark.slow
    def test_memory_grows_like_the_square_root(self, x64):
        """Reverse mode through 16 times as many steps: about 4 times the memory, not 16."""
        qp, axes = joint_batch(256)

        def temporary(iterations):
            solver = jm.ADMM(iterations, newton_steps=0, differentiate="unrolled")
            total = lambda q: jnp.sum(
                jax.vmap(partial(loss, solver=solver), in_axes=(axes,))(replace(qp, q=q))
            )
            return (
                jax.jit(jax.grad(total)).lower(qp.q).compile().memory_analysis().temp_size_in_bytes
            )

        assert temporary(1600) < 5 * temporary(100)


@pytest.mark.slow
def test_few_and_many_active_rows_in_a_batch():
    """Against the linear system itself; rows that depend on each other where few are active."""
    rng = np.random.default_rng(0)
    n, m, rho = 60, 70, 1e6
    A = rng.standard_normal((m, n))
    A[7] = A[3]
    A /= np.linalg.norm(A, axis=1)[:, None]
    H = np.eye(n) + 1e-9 * np.diag(rng.standard_normal(n))
    counts = (0, 5, 47, 48, 49, 55)
    weights = np.zeros((len(counts), m))
    for row, count in zip(weights, counts, strict=True):
        row[rng.choice(np.arange(8, m), count, replace=False)] = 1.0
    weights[1, :3] = rng.uniform(0.1, 0.9, 3)
    a, c = rng.standard_normal((len(counts), n)), rng.standard_normal((len(counts), m))
    with jax.enable_x64(True):
        given = jnp.asarray(H), jnp.asarray(A)
        move = lambda D, a, c: linearised(*given, D, [], rho, jnp.asarray(False))(a, c)
        dw, dy = jax.vmap(move)(*map(jnp.asarray, (weights, a, c)))
        for i, D in enumerate(weights):
            whole = np.block([[H, A.T], [D[:, None] * A, np.diag((D - 1) / rho)]])
            wanted = np.linalg.solve(whole, -np.concatenate([a[i], c[i]]))
            found = np.concatenate([dw[i], dy[i]])
            np.testing.assert_allclose(found, wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max())
        # The normal of row 3 twice: the same change, and its multiplier in two parts.
        twice = weights[1] + (np.arange(m) == 3) + (np.arange(m) == 7)
        once = weights[1] + (np.arange(m) == 3)
        c = np.where(np.isin(np.arange(m), (3, 7)), 0.0, c[1])
        (w_2, y_2), (w_1, y_1) = (move(*map(jnp.asarray, (D, a[1], c))) for D in (twice, once))
        np.testing.assert_allclose(w_2, w_1, atol=1e-6)
        np.testing.assert_allclose(y_2[3] + y_2[7], y_1[3], rtol=1e-6, atol=1e-6)
