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
from jax import enable_x64

import jaxmpc as jm

INF = np.inf
FINE = jm.ADMM(iterations=200, refine=30, eps=1e-9)
UNROLLED = jm.ADMM(iterations=400, refine=0, differentiate="unrolled")
# Directions of the data; "bounds" moves l and u alike, equalities and centres of balls included.
DIRECTIONS = ("P", "q", "A", "l", "u", "bounds", "soft_linear", "soft_quadratic", "radius")


@pytest.fixture
def x64():
    with enable_x64(True):
        yield


def outputs(qp: jm.QP, solver: jm.ADMM = FINE) -> tuple:
    """What has a derivative: z, y, cost."""
    sol = jm.solve_qp(qp, solver)
    return sol.z, sol.y, sol.cost


@cache
def compiled(kind: str, solver: jm.ADMM = FINE):
    """Batched over programs of one shape: the solution, its derivative along a direction, or the
    gradient of ct'outputs with respect to all fields."""
    f = partial(outputs, solver=solver)
    if kind == "solve":
        return jax.jit(jax.vmap(lambda qp: (f(qp), jm.solve_qp(qp, solver).status)))
    if kind == "jvp":
        return jax.jit(jax.vmap(lambda qp, d: jax.jvp(f, (qp,), (d,))[1]))
    return jax.jit(jax.vmap(lambda qp, ct: jax.vjp(f, qp)[1](ct)[0]))


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

    @pytest.mark.parametrize("seeds", [3, pytest.param(100, marks=pytest.mark.slow)])
    def test_central_differences(self, x64, seeds):
        h, cases = 1e-5, [(seed, name) for seed in range(seeds) for name in DIRECTIONS]
        programs = [everything(seed) for seed, _ in cases]
        qps = [qp for qp, _, _ in programs]
        ds = [direction(qp, name, seed) for qp, (seed, name) in zip(qps, cases, strict=True)]
        solve = compiled("solve")
        sides = []
        for side in (0.0, h, -h):
            batch = stack([moved(qp, d, side) for qp, d in zip(qps, ds, strict=True)])
            values, status = solve(batch)
            np.testing.assert_array_equal(status, jm.Status.SOLVED)
            sides.append(values)
        at, plus, minus = sides
        np.testing.assert_allclose(at[0], np.stack([z for _, z, _ in programs]), atol=1e-8)
        np.testing.assert_allclose(at[1], np.stack([y for _, _, y in programs]), atol=1e-7)
        numeric = jax.tree.map(lambda a, b: np.asarray(a - b) / (2 * h), plus, minus)
        exact = compiled("jvp")(stack(qps), stack(ds))
        rng = np.random.default_rng(0)
        ct = jax.tree.map(lambda v: rng.standard_normal(v.shape), at)
        gradient = compiled("vjp")(stack(qps), ct)
        take = lambda tree, i: jax.tree.map(lambda v: np.asarray(v[i]), tree)
        for i, case in enumerate(cases):
            try:
                assert_near(take(exact, i), take(numeric, i), 1e-5)
            except AssertionError as error:
                raise AssertionError(f"seed, field {case}") from error
            # <ct, J d> = <J'ct, d>
            forward = sum(np.sum(a * b) for a, b in zip(take(ct, i), take(exact, i), strict=True))
            pairs = zip(*map(jax.tree.leaves, (take(gradient, i), ds[i])), strict=True)
            backward = sum(np.sum(a * b) for a, b in pairs)
            np.testing.assert_allclose(backward, forward, rtol=1e-8, atol=1e-8, err_msg=str(case))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))

    def test_gradient_of_P_is_symmetric(self, x64):
        qp, _, _ = everything(0)
        ct = (np.arange(8.0), np.ones(14), np.ones(()))
        gradient = compiled("vjp")(stack([qp] * 27), stack([ct] * 27))
        np.testing.assert_allclose(gradient.P, np.swapaxes(gradient.P, 1, 2), atol=1e-14)


class TestClosedForms:
    @pytest.mark.parametrize("solver", [FINE, UNROLLED], ids=["implicit", "unrolled"])
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
        solver = jm.ADMM(differentiate=mode)

        @jax.jit
        @partial(jax.jacrev, argnums=(0, 1, 2))
        def jacobian(q, l, u):
            return jm.solve_qp(jm.QP(jnp.eye(5), q, jnp.eye(5), l, u), solver).z

        masks = -(jnp.abs(q) < 1), q > 1, q < -1
        for got, mask in zip(jacobian(q, -one, one), masks, strict=True):
            np.testing.assert_allclose(got, np.diag(np.asarray(mask, float)), atol=1e-14)

    @pytest.mark.parametrize("size", [1, 2, 3])
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
            return outputs(qp)[:2]

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
                z, y, cost = outputs(jm.QP(one, -a, one, -u, u, c, k))
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

    def test_every_kind_of_row(self, x64):
        """Soft rows: dV/dc = d, dV/dk = d²/2. Balls: dV/dradius = −|y_b|, dV/dcentre = −y_b."""
        for seed in range(3):
            qp, z, y = everything(seed)
            ct = (np.zeros(8), np.zeros(14), np.ones(()))
            one = jax.tree.map(lambda v: v[0], compiled("vjp")(stack([qp] * 27), stack([ct] * 27)))
            self.check(qp, one, z, y)
            v = qp.A @ z
            d = np.where(np.isfinite(qp.soft_linear), np.abs(v - np.clip(v, qp.l, qp.u)), 0)
            near = partial(np.testing.assert_allclose, atol=1e-7)
            near(one.soft_linear, d)
            near(one.soft_quadratic, d**2 / 2)
            near(one.radius, [-np.linalg.norm(y[10:12]), -np.linalg.norm(y[12:])])
            near((one.l + one.u)[10:], -y[10:])

    def test_dependent_rows(self, x64):
        """z on four rows in R³, two of them parallel: y is one of many, and the derivative along
        any move that keeps the rows consistent is the same for all of them. q and P do not see y
        at all, so the value is smooth in them: central differences."""
        rng = np.random.default_rng(0)
        n, h = 3, 1e-5
        A, z = rng.standard_normal((5, n)), rng.standard_normal(n)
        A[1], A[3] = 2 * A[0], A[0] + A[2]
        y, v = np.array([0.5, 0.7, 1.0, 0.4, 0.0]), A @ z
        u = v + np.array([0, 0, 0, 0, 1.0])
        qp = jm.QP(np.eye(n), -z - A.T @ y, A, np.full(5, -INF), u)
        value = jax.jit(lambda qp: jm.solve_qp(qp, FINE).cost)
        gradient, sol = jax.jit(jax.grad(value))(qp), jm.solve_qp(qp, FINE)
        assert sol.status == jm.Status.SOLVED
        np.testing.assert_allclose(sol.z, z, atol=1e-8)
        self.check(qp, gradient, z, np.asarray(sol.y))
        shift = rng.standard_normal(n)
        for d in (
            replace(zeros(qp), q=rng.standard_normal(n)),
            replace(zeros(qp), P=np.outer(shift, shift)),
            replace(zeros(qp), u=A @ shift),  # the whole set moves
        ):
            numeric = (value(moved(qp, d, h)) - value(moved(qp, d, -h))) / (2 * h)
            along = sum(
                jnp.sum(a * b) for a, b in zip(*map(jax.tree.leaves, (gradient, d)), strict=True)
            )
            np.testing.assert_allclose(along, numeric, rtol=1e-6, atol=1e-8)


class TestSecondOrder:
    def test_hessian_of_value_is_jacobian_of_z(self, x64):
        """dV/dq = z, hence d²V/dq² = dz/dq; a hard, a soft and a ball constraint are met."""
        qp, _, _ = everything(0)
        f = lambda q: outputs(replace(qp, q=q))
        hessian = jax.jit(jax.hessian(lambda q: f(q)[2]))(jnp.asarray(qp.q))
        jacobian = jax.jit(jax.jacfwd(lambda q: f(q)[0]))(jnp.asarray(qp.q))
        np.testing.assert_allclose(hessian, jacobian, atol=1e-10)
        np.testing.assert_allclose(hessian, hessian.T, atol=1e-10)
        assert np.linalg.eigvalsh(hessian).max() < 1e-10  # V is concave in q

    def test_finite_differences_of_the_gradient(self, x64):
        """Second derivatives along three directions that change all fields at once."""
        qp, _, _ = everything(1)
        rng = np.random.default_rng(0)
        names = [name for name in DIRECTIONS if name not in "lu"]
        parts = [[direction(qp, name, i) for name in names] for i in range(3)]
        ds = [jax.tree.map(lambda *v: sum(v), *part) for part in parts]
        a, b = rng.standard_normal(8), rng.standard_normal(14)

        def scalar(t):
            z, y, cost = outputs(
                jax.tree.map(lambda v, *d: v + sum(map(jnp.multiply, t, d)), qp, *ds)
            )
            return jnp.stack([jnp.sum(a * z) + jnp.sum(b * y), cost])

        at, h = jnp.zeros(3), 1e-5
        gradient = jax.jit(jax.jacrev(scalar))
        numeric = np.stack(
            [(gradient(at + h * e) - gradient(at - h * e)) / (2 * h) for e in np.eye(3)], axis=-1
        )
        for second in (jax.jacfwd(jax.jacrev(scalar)), jax.jacrev(jax.jacfwd(scalar))):
            got = jax.jit(second)(at)
            for i in range(2):
                scale = np.abs(numeric[i]).max()
                np.testing.assert_allclose(got[i], numeric[i], atol=1e-5 * scale)


def joint_batch(count: int) -> tuple[jm.QP, jm.QP]:
    """QPs that share P and A, about half of the rows of a box met; and axes for `vmap`."""
    rng = np.random.default_rng(0)
    n = 4
    M = rng.standard_normal((n, n))
    A = np.vstack([np.eye(n), rng.standard_normal((2, n))])
    l, u = -rng.uniform(0.3, 1, (count, 6)), rng.uniform(0.3, 1, (count, 6))
    qp = jm.QP(M @ M.T + np.eye(n), 4 * rng.standard_normal((count, n)), A, l, u)
    return qp, jm.QP(P=None, q=0, A=None, l=0, u=0)


def loss(qp: jm.QP, solver: jm.ADMM = FINE):
    """A scalar that all of z and y enter."""
    sol = jm.solve_qp(qp, solver)
    return jnp.sum(jnp.arange(1.0, sol.z.size + 1) * sol.z) + 0.1 * jnp.sum(sol.y**2)


class TestTransformations:
    def test_gradient_of_shared_matrices_is_the_sum(self, x64):
        """vmap(grad) gives each instance's own; grad of a batch's sum adds up those of P and A."""
        qp, axes = joint_batch(16)
        total = lambda qp: jnp.sum(jax.vmap(loss, in_axes=(axes,))(qp))
        shared = jax.jit(jax.grad(total))(qp)
        each = jax.jit(jax.vmap(jax.grad(loss), in_axes=(axes,)))(qp)
        near = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-10)
        for name in ("P", "A"):
            near(getattr(shared, name), getattr(each, name).sum(axis=0))
        for name in "qlu":
            near(getattr(shared, name), getattr(each, name))
        single = (
            jax.grad(loss)(jax.tree.map(lambda v, w: v if v.ndim == w.ndim - 1 else v, qp, qp))
            if False
            else jax.jit(jax.grad(loss))(replace(qp, q=qp.q[3], l=qp.l[3], u=qp.u[3]))
        )
        near(single.A, each.A[3])
        near(single.u, each.u[3])

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

    @pytest.mark.parametrize("build", ["solve", "controller"])
    def test_closed_loop(self, x64, build):
        """Cost of eight closed-loop steps, inputs at their limit in the first ones: gradient with
        respect to x0 and Q through `scan` against central differences."""
        A, B = np.array([[1.0, 0.2], [0.0, 1.0]]), np.array([[0.02], [0.2]])
        system = jm.LinearSystem(A, B)
        solver = jm.ADMM(iterations=60)

        @jax.jit
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
        (_, (status, u)), (of_x, of_Q) = jax.value_and_grad(cost, (0, 1), has_aux=True)(x0, Q)
        np.testing.assert_array_equal(status, jm.Status.SOLVED)
        assert (np.abs(u) > 1 - 1e-9).sum() in range(1, 8)
        value = lambda x0, Q: cost(x0, Q)[0]
        for e in np.eye(2):
            numeric = (value(x0 + h * e, Q) - value(x0 - h * e, Q)) / (2 * h)
            np.testing.assert_allclose(of_x @ e, numeric, rtol=1e-5)
            D = np.diag(e)
            numeric = (value(x0, Q + h * D) - value(x0, Q - h * D)) / (2 * h)
            np.testing.assert_allclose(np.sum(of_Q * D), numeric, rtol=1e-5, atol=1e-7)


KINDS = ("degenerate", "weak", "infeasible", "unbounded", "plain", "NaN")


def hard_case(seed: int) -> tuple[jm.QP, str]:
    """A program of one shape that has no ordinary derivative: rows met twice; rows met without a
    push, in exact arithmetic (small integers); contradicting rows; P = 0 and no bound; NaN."""
    rng = np.random.default_rng(seed)
    kind, n, m = KINDS[seed % len(KINDS)], 4, 9
    whole = lambda *shape: rng.integers(-2, 3, shape).astype(float)
    P, A, z = np.eye(n), whole(m, n), whole(n)
    y = np.zeros(m)
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
        l[1] = u[0] + 1
        u[1] = INF
    linear, quadratic = np.full(m, INF), np.zeros(m)
    linear[4:6], quadratic[5] = (1.0, 0.0), 1.0
    q = -P @ z - A.T @ y
    if kind == "unbounded":
        u[: m - 2], q = INF, whole(n) + 0.5
    radius = np.array([1.0 if seed % 2 else 0.0])  # a ball of radius zero is a point
    l[7:] = u[7:] = v[7:] + (np.array([1.0, 0.0]) if seed % 2 else 0.0)
    qp = jm.QP(P, q, A, l, u, linear, quadratic, radius, balls=(2,))
    if kind == "NaN":
        name = ("P", "q", "A", "l", "u", "soft_linear", "radius")[seed // len(KINDS) % 7]
        getattr(qp, name).flat[0] = np.nan
    return qp, kind


class TestFiniteForEveryStatus:
    """The gradient of Σz + Σy + cost is a number whatever became of the program."""

    def gradients(self, count: int, solver: jm.ADMM, dtype: Any):
        cases = [hard_case(seed) for seed in range(count)]
        batch = jax.tree.map(lambda v: v.astype(dtype), stack([qp for qp, _ in cases]))
        kinds = np.array([kind for _, kind in cases])

        def total(qp):
            sol = jm.solve_qp(qp, solver)
            return jnp.sum(sol.z) + jnp.sum(sol.y) + sol.cost, sol.status

        evaluate = jax.jit(jax.vmap(jax.grad(total, has_aux=True)))
        gradient, status = jax.tree.map(np.asarray, evaluate(batch))
        for field in ("P", "q", "A", "l", "u", "soft_linear", "soft_quadratic", "radius"):
            finite = np.isfinite(getattr(gradient, field)).reshape(count, -1).all(axis=1)
            bad = {kind: int((~finite & (kinds == kind)).sum()) for kind in KINDS}
            assert finite.all(), (field, bad, np.flatnonzero(~finite)[:5])
        nan = kinds == "NaN"
        np.testing.assert_array_equal(status[nan], jm.Status.NON_FINITE)
        for leaf in jax.tree.leaves(gradient):
            np.testing.assert_array_equal(leaf[nan], 0)

        harmless = jax.tree.map(
            lambda v: np.where(nan.reshape(-1, *[1] * (v.ndim - 1)), v[0], v), batch
        )
        alone, _ = jax.tree.map(np.asarray, evaluate(harmless))
        for a, b in zip(*map(jax.tree.leaves, (gradient, alone)), strict=True):
            np.testing.assert_array_equal(a[~nan], b[~nan])
        return kinds, status

    def test_float64(self, x64):
        kinds, status = self.gradients(300, jm.ADMM(iterations=50), np.float64)
        for kind, expected in (
            ("degenerate", "SOLVED"), ("weak", "SOLVED"), ("infeasible", "PRIMAL_INFEASIBLE"),
        ):  # fmt: skip
            share = np.mean(status[kinds == kind] == jm.Status[expected])
            assert share > 0.8, (kind, np.unique(status[kinds == kind], return_counts=True))
        assert jm.Status.DUAL_INFEASIBLE in status[kinds == "unbounded"]

    def test_float32(self):
        self.gradients(300, jm.ADMM(iterations=50), np.float32)

    def test_unfinished(self, x64):
        _, status = self.gradients(300, jm.ADMM(iterations=3, refine=0), np.float64)
        assert (status == jm.Status.ITERATION_LIMIT).sum() > 50

    @pytest.mark.slow
    @pytest.mark.parametrize("dtype", [np.float64, np.float32])
    @pytest.mark.parametrize("steps", [(50, 10), (3, 0)])
    def test_many(self, dtype, steps):
        with enable_x64(dtype == np.float64):
            self.gradients(10_000, jm.ADMM(steps[0], refine=steps[1]), dtype)


class TestInfeasible:
    """z is the answer of the closest feasible program: violations least in the sense of squares
    over rows of length one (P = I and unit rows: those of the data), then the cost."""

    def jacobian(self, qp: jm.QP):
        f = lambda q, l, u: jm.solve_qp(replace(qp, q=q, l=l, u=u), FINE)
        sol = f(qp.q, qp.l, qp.u)
        assert sol.status == jm.Status.PRIMAL_INFEASIBLE
        args = map(jnp.asarray, (qp.q, qp.l, qp.u))
        return np.asarray(sol.z), jax.jit(jax.jacrev(lambda *a: f(*a).z, (0, 1, 2)))(*args)

    def test_line(self, x64):
        """z ≥ 2, z ≥ 1.4, z ≤ 0.5: the mean of the three, each moves it by a third."""
        l, u = np.array([2.0, 1.4, -INF]), np.array([INF, INF, 0.5])
        z, (dq, dl, du) = self.jacobian(jm.QP(np.eye(1), np.array([3.0]), np.ones((3, 1)), l, u))
        near = partial(np.testing.assert_allclose, atol=1e-5)
        near(z, [1.3])
        near(dq, [[0.0]])
        near(dl, [[1 / 3, 1 / 3, 0]])
        near(du, [[0, 0, 1 / 3]])

    def test_plane(self, x64):
        """a'z ≥ 1, a'z ≤ 0: a'z = ½ and z = −q along the rest; a third row |z₁| ≤ 10 is free."""
        a = np.array([0.6, 0.8])
        q = np.array([0.5, -1.0])
        qp = jm.QP(
            np.eye(2), q, np.array([a, a, [1, 0]]), np.array([1, -INF, -10]), np.array([INF, 0, 10])
        )
        z, (dq, dl, du) = self.jacobian(qp)
        rest = np.eye(2) - np.outer(a, a)
        near = partial(np.testing.assert_allclose, atol=1e-5)
        near(z, -rest @ q + a / 2)
        near(dq, -rest)
        near(dl, np.outer(a, [0.5, 0, 0]))
        near(du, np.outer(a, [0, 0.5, 0]))

    def test_central_differences(self, x64):
        """Random programs with one pair of contradicting rows, beside rows that are met with a
        push and rows that are not. q, l and u; P and A also change what "closest" means."""
        n, m, h, count = 5, 9, 1e-4, 8
        qps = []
        for seed in range(count):
            rng = np.random.default_rng(seed)
            M, A = rng.standard_normal((n, n)), rng.standard_normal((m, n))
            A[1] = rng.uniform(0.5, 2) * A[0]
            # Built from its answer in the metric of the rows A_i M⁻ᵀ/|A_i M⁻ᵀ|: both rows fail by
            # the same normalised amount.
            P = M @ M.T + np.eye(n)
            length = np.sqrt(np.einsum("ij,ij->i", A, np.linalg.solve(P, A.T).T))
            z, y, v = rng.standard_normal(n), np.zeros(m), None
            v = A @ z
            l, u = v - 1.5 - rng.uniform(0, 1, m), v + 1.5 + rng.uniform(0, 1, m)
            l[0], u[1], u[0], l[1] = v[0] + 0.5 * length[0], v[1] - 0.5 * length[1], INF, -INF
            u[2], y[2], l[3], y[3] = v[2], 0.7, v[3], -0.9
            y[0] = rng.standard_normal()
            qps.append((jm.QP(P, -P @ z - A.T @ y, A, l, u), z))
        batch, z = stack([qp for qp, _ in qps]), np.stack([z for _, z in qps])
        solve, jvp = compiled("solve"), compiled("jvp")
        for name in ("q", "l", "u"):
            d = stack([direction(qp, name, i) for i, (qp, _) in enumerate(qps)])
            (at, _, _), status = solve(batch)
            np.testing.assert_array_equal(status, jm.Status.PRIMAL_INFEASIBLE)
            np.testing.assert_allclose(at, z, atol=1e-4)
            sides = [solve(moved(batch, d, side))[0][0] for side in (h, -h)]
            numeric = np.asarray(sides[0] - sides[1]) / (2 * h)
            exact = np.asarray(jvp(batch, d)[0])
            scale = np.abs(numeric).max(axis=1, keepdims=True)
            error = np.abs(exact - numeric) / (scale + 0.1)
            assert error.max() < 1e-3, (name, error.max(axis=1))


class TestKinks:
    """min ½z² + qz, z ≤ u, is z = min(−q, u): one-sided derivatives at q = −u are −1 and 0 with
    respect to q, 0 and 1 with respect to u."""

    @staticmethod
    @cache
    def derivatives(solver: jm.ADMM):
        def f(q, u, a, mu):
            qp = jm.QP(jnp.eye(1), q[None], a[None, None], jnp.full(1, -INF), u[None])
            sol = jm.solve_qp(qp, replace(solver, smoothing=mu))
            return jnp.stack([sol.z[0], sol.y[0]])

        return jax.jit(jax.vmap(jax.jacrev(f, (0, 1, 2)), in_axes=(0, 0, 0, None)))

    def at(self, q, u=1.0, a=1.0, mu=0.0):
        q, u, a = np.broadcast_arrays(*map(np.atleast_1d, map(np.float64, (q, u, a))))
        pad = np.zeros(401 - q.size)
        args = [np.append(q, pad), np.append(u, pad + 1), np.append(a, pad + 1)]
        out = self.derivatives(jm.ADMM(iterations=50))(*args, mu)
        return [np.asarray(v)[: q.size] for v in out]

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
        z(q − δ, u + δ) = z(q, u) + δ, so dz/du = 1 + dz/dq. In a row a z ≤ u of length one after
        scaling, dz/da = −(z dz/du + y dz/dq … ) is left to the general test below."""
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
        fine = np.linspace(-1.01, -0.99, 401)
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

    def test_smoothing_of_many_rows(self, x64):
        """Every field of a program away from kinks: μ → 0 gives the exact derivative."""
        qp, _, _ = everything(2)
        tiny = replace(FINE, smoothing=1e-13)
        ds = [direction(qp, name, 0) for name in DIRECTIONS]
        batch, ds = stack([qp] * 27), stack(ds * 3)
        smooth, exact = compiled("jvp", tiny)(batch, ds), compiled("jvp")(batch, ds)
        for i, name in enumerate(DIRECTIONS):
            for a, b in zip(smooth, exact, strict=True):
                np.testing.assert_allclose(a[i], b[i], atol=1e-4, err_msg=name)


class TestUnrolled:
    """Derivatives of the steps as they were taken, of the settings and the start too."""

    def test_settings_and_start(self, x64):
        qp, _, _ = everything(0)
        rng = np.random.default_rng(0)
        rows = rng.uniform(0.5, 2, 14)
        rows[10:12], rows[12:] = rows[10], rows[12]  # a ball has one penalty

        def f(rho, alpha, z, y):
            solver = jm.ADMM(9, rho=rho, alpha=alpha, refine=0, differentiate="unrolled")
            sol = jm.solve_qp(qp, solver, warm_start=(z, y))
            return jnp.sum(jnp.sin(sol.z)) + jnp.sum(sol.y**2)

        at = (rows, 1.5, rng.standard_normal(8), rng.standard_normal(14))
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

    def test_implicit_ignores_settings_and_start(self, x64):
        qp, z, y = everything(0)
        f = lambda rho, z: jnp.sum(jm.solve_qp(qp, jm.ADMM(rho=rho), warm_start=(z, y)).z)
        for part in jax.jit(jax.grad(f, (0, 1)))(1.0, z):
            np.testing.assert_array_equal(part, 0)

    def test_converged_is_implicit(self, x64):
        """Where the steps have converged, their derivative has too: all fields."""
        qp, _, _ = everything(0)
        ds = stack([direction(qp, name, 0) for name in DIRECTIONS] * 3)
        steps = compiled("jvp", UNROLLED)(stack([qp] * 27), ds)
        exact = compiled("jvp")(stack([qp] * 27), ds)
        for i, name in enumerate(DIRECTIONS):
            for a, b in zip(steps, exact, strict=True):
                np.testing.assert_allclose(a[i], b[i], rtol=1e-5, atol=1e-5, err_msg=name)

    def test_memory_grows_like_the_square_root(self):
        """Reverse mode through 16 times as many steps: about 4 times the memory, not 16."""
        qp, axes = joint_batch(256)
        qp = jax.tree.map(np.float32, qp)

        def temporary(iterations):
            solver = jm.ADMM(iterations, refine=0, differentiate="unrolled")
            total = lambda q: jnp.sum(
                jax.vmap(partial(loss, solver=solver), in_axes=(axes,))(replace(qp, q=q))
            )
            return (
                jax.jit(jax.grad(total)).lower(qp.q).compile().memory_analysis().temp_size_in_bytes
            )

        assert temporary(1600) < 5 * temporary(100)
