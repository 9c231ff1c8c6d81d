"""Certificates one by one, given candidates whose worth is known by construction.

Claims are checked in rationals (`exact.proves_empty`), and programs that are feasible in rationals
must never be proved empty. All programs are filled up to one shape, so that few things compile.
"""

import exact
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import (
    Proof,
    correcting_rows,
    descent_ray,
    farkas,
    prove,
    recession,
    to_length_one,
)

INF = np.inf
EPS = 2.0**-52
M, N = 8, 3


pytestmark = pytest.mark.usefixtures("x64")


def program(A=None, l=(), u=(), P=None, q=(), y=(), d=()):
    """A program with up to M rows and N variables, and candidates y and d, filled up: by rows of
    zeros without bounds and variables without cost."""
    fill = lambda v, value, n: np.append(np.asarray(v, float), np.full(n - len(v), value))
    A = np.zeros((0, N)) if A is None else np.array(A, float)
    P = np.zeros((0, 0)) if P is None else P
    A_full, P_full = np.zeros((M, N)), np.zeros((N, N))
    A_full[: len(A), : A.shape[1]], P_full[: len(P), : len(P)] = A, P
    qp = P_full, fill(q, 0.0, N), A_full, fill(l, -INF, M), fill(u, INF, M)
    return qp, fill(y, 0.0, M), fill(d, 0.0, N)


def _certify(qp, y, d):
    qp = jm.QP(*qp)
    return farkas(qp, y, correcting_rows(qp))[:2], descent_ray(qp, d)


COMPILED = jax.jit(jax.vmap(_certify))
PROVE = jax.jit(prove)
ONE = jax.jit(lambda qp, y, *more: farkas(qp, y, correcting_rows(qp), *more))


def certify(programs):
    """Certificates (·, M), whether they are proved, rays (·, N) and whether they are found, of
    programs in batches of one size."""
    size, parts = 64, []
    for i in range(0, len(programs), size):
        some = [*programs[i : i + size], *[programs[0]] * size][:size]
        found = COMPILED(*jax.tree.map(lambda *v: np.stack(v), *some))
        parts.append(jax.tree.leaves(found))
    return [np.concatenate(v)[: len(programs)] for v in zip(*parts, strict=True)]


def empty_by(rng, gap):
    """Oblique a'z ≥ max over a box + gap·size, in odd units; its Farkas vector, off a little."""
    a, unit = rng.normal(size=N), 10.0 ** rng.uniform(-6, 6, N)
    pivot = 10.0 ** rng.uniform(-3, 3, N) * rng.choice([-1, 1], N)
    half = rng.uniform(0.5, 2, N)
    size = np.abs(a) @ half
    A = np.vstack([np.diag(pivot), a]) / unit
    lower = np.append(-half * np.abs(pivot), size * (1 + gap))
    upper = np.append(half * np.abs(pivot), INF)
    y = np.append(a / pivot, -1.0) * (1 + 1e-3 * rng.normal(size=N + 1))
    y *= 10.0 ** rng.uniform(-9, 9)
    return program(A, lower, upper, y=y)


class TestFarkas:
    def test_what_is_proved_is_true_in_rationals(self):
        """In odd units; candidates are off by 1e-3, and corrected. Gaps down to rounding."""
        rng = np.random.default_rng(0)
        gaps = 10.0 ** rng.uniform(-17, 0, 120) * np.where(np.arange(120) % 3, 1, -1)
        programs = [empty_by(rng, gap) for gap in gaps]
        certificates, proved, _, _ = certify(programs)
        assert not proved[gaps < 0].any() and proved[gaps > 1e-13].all()
        for ((_, _, A, l, u), _, _), y, true in zip(programs, certificates, proved, strict=True):
            if true:
                assert exact.proves_empty(A, l, u, y)
                assert np.all(np.abs(y @ A) <= 100 * EPS * (np.abs(y) @ np.abs(A)))
            else:
                np.testing.assert_array_equal(y, 0)

    def test_products_that_cancel_leave_a_leak(self):
        """Rows a (z₁ − r z₂) = 0 with large a and y'a = 0 but for rounding, and z in a box that has
        (r, 1)·s as a corner: feasible in rationals. The sum of the certificate is rounding alone,
        and of either sign."""
        rng = np.random.default_rng(1)
        programs = []
        for pivot in (0.01, 0.25, 3.0, 1000.0) * 40:
            s, r = 10.0 ** rng.integers(-2, 3), rng.uniform(0.5, 2)
            a = 1e3 * rng.normal(size=5)
            rows = np.column_stack([a, -a * r])
            corner = np.array([r * s, s])
            exactly = exact.rational(corner)
            values = [exact.dot(row, exactly) for row in exact.rational(rows)]
            below = [np.nextafter(float(v), -INF) for v in values]
            above = [np.nextafter(float(v), INF) for v in values]
            box = np.abs(np.nextafter(pivot * corner, INF))
            y = rng.normal(size=5)
            y = np.concatenate([[0.0, 0.0], y - a * (y @ a) / (a @ a)])
            A = np.vstack([pivot * np.eye(2), rows])
            programs.append(program(A, [*-box, *below], [*box, *above], y=y))
        assert not certify(programs)[1].any()

    def test_sums_that_cancel_leave_rounding(self):
        """z₁ + z₂ = v several times: y'1 = 0 exactly, so y'v is 0 but for rounding."""
        rng = np.random.default_rng(2)
        programs = []
        for _ in range(100):
            whole = -rng.integers(0, 2**17, M - 2)
            y = np.array([2**20, *whole, -(2**20) - whole.sum()]) * 2.0**-20
            v = np.full(M, rng.uniform(1, 2))
            programs.append(program(np.ones((M, 2)), v, v, y=y))
        assert not certify(programs)[1].any()

    @pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
    def test_rows_that_contradict_each_other_by_some_roundings(self, scale):
        """scale ≤ z₁ + z₂ ≤ scale (1 − k ε): nothing for k ≤ 1, a proof from some hundred on."""
        k = np.array([0, 1, 200, 10**4, 10**8])
        rows = np.ones((2, 2))
        got = certify([
            program(rows, [scale, -INF], [INF, scale * (1 - i * EPS)], y=[-1.0, 1.0]) for i in k
        ])[1]  # fmt: skip
        np.testing.assert_array_equal(got, k > 1)

    def test_a_variable_without_a_row_must_not_be_left(self):
        """z₁ + z₂ ≥ 2 and z₁ + (1 + t) z₂ ≤ 1 is feasible for t ≠ 0; z₂ in a box or not."""
        rows = lambda t: [[1.0, 1.0], [1.0, 1.0 + t]]
        box, none = ([-10.0], [10.0]), ([-INF], [10.0])
        cases = [(0.0, none), (1e-9, none), (-1e-9, none), (0.0, box), (1e-3, box), (1.0, box)]
        programs = [
            program([*rows(t), [0.0, 3.0]], [2.0, -INF, *low], [INF, 1.0, *high], y=[-1.0, 1.0])
            for t, (low, high) in cases
        ]
        y, proved, _, _ = certify(programs)
        np.testing.assert_array_equal(proved, [True, False, False, True, True, False])
        # The box row takes −t of z₂ over.
        np.testing.assert_allclose(y[4, :3], [-1.0, 1.0, -1e-3 / 3], rtol=1e-9)

    def test_zero_and_wrong_signs_prove_nothing(self):
        A, l, u = [[1.0, 1.0], [1.0, 1.0]], [2.0, -INF], [INF, 1.0]
        for y in ([0.0, 0.0], [1.0, -1.0], [np.nan, 1.0], [1.0, 1.0], [-1.0, 0.0]):
            found, proved, _, _ = certify([program(A, l, u, y=y)])
            assert not proved[0]
            np.testing.assert_array_equal(found, 0)

    @pytest.mark.parametrize(("weight", "empty"), [(10.0, False), (INF, True)])
    def test_soft_rows_prove_nothing(self, weight, empty):
        """z₁ ≥ 2 and z₁ ≤ 1, where the second row is soft or hard."""
        qp = jm.QP(
            jnp.eye(1), jnp.zeros(1), jnp.ones((2, 1)), jnp.array([2.0, -INF]),
            jnp.array([INF, 1.0]), soft_linear=jnp.array([INF, weight]),
        )  # fmt: skip
        y, proved, _ = ONE(qp, jnp.array([-1.0, 1.0]))
        assert proved == empty and np.abs(y).max() == empty

    def test_beyond_the_tolerance(self):
        """z₁ ≥ 1 + d and z₁ ≤ 1 still contradict each other when each is widened by t < d/2."""
        qp = lambda d: jm.QP(
            jnp.eye(1), jnp.zeros(1), jnp.ones((2, 1)), jnp.array([1 + d, -INF]),
            jnp.array([INF, 1.0]),
        )  # fmt: skip
        for d, t, beyond in ((1e-3, 4e-4, True), (1e-3, 6e-4, False), (1e-10, 1e-6, False)):
            assert ONE(qp(d), jnp.array([-1.0, 1.0]), jnp.full(2, t))[1:] == (True, beyond)

    @pytest.mark.parametrize(("low", "empty"), [(0.9, False), (2.0, True)])
    def test_ball(self, low, empty):
        """z₁ ≥ low and |z| ≤ 1; the vector (−1, 1) of z₁ alone leaves nothing of A'y."""
        qp = jm.QP(
            jnp.eye(2), jnp.zeros(2), jnp.array([[1.0, 0], [1, 0], [0, 1]]),
            jnp.array([low, 0, 0]), jnp.array([INF, 0, 0]), radius=jnp.ones(1), balls=(2,),
        )  # fmt: skip
        assert ONE(qp, jnp.array([-1.0, 1.0, 0.0]))[1] == empty


def test_correcting_rows():
    """The largest entry of a column among hard rows of this entry alone, outside of balls."""
    rng, rows = np.random.default_rng(3), jax.jit(correcting_rows)
    for _ in range(12):
        A = rng.normal(size=(9, 4)) * (rng.random((9, 4)) < 0.3)
        soft = rng.random(9) < 0.3
        soft[-2:] = False
        qp = jm.QP(
            np.eye(4), np.zeros(4), jnp.asarray(A), np.zeros(9), np.zeros(9),
            soft_linear=jnp.where(soft, 1.0, INF), radius=np.ones(1), balls=(2,),
        )  # fmt: skip
        row, pivot = map(np.asarray, rows(qp))
        expected_row, expected = np.full(4, -1), np.zeros(4)
        for i, j in np.ndindex(7, 4):
            alone = np.count_nonzero(A[i]) == 1 and not soft[i]
            if alone and abs(A[i, j]) > abs(expected[j]):
                expected_row[j], expected[j] = i, A[i, j]
        np.testing.assert_array_equal(pivot, expected)
        np.testing.assert_array_equal(row[pivot != 0], expected_row[pivot != 0])


class TestProve:
    """Candidates come in ADMM's coordinates: z = T w, rows multiplied by E."""

    T, E = np.array([[2.0, 1.0], [0.0, 0.5]]), np.array([4.0, 0.25, 0.0])

    def proved(self, l, u, y=(0.0, 0.0, 0.0), d=(0.0, 0.0)):
        A = np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 0.0]])
        qp = jm.QP(np.zeros((2, 2)), np.array([1.0, 0.0]), A, np.array(l), np.array(u))
        qp = jax.tree.map(jnp.asarray, qp)
        arrays = map(jnp.asarray, (self.T, self.E))
        return PROVE(qp, *arrays, correcting_rows(qp), jnp.zeros(3), jnp.array(y), jnp.array(d))

    def test_rows_that_nothing_moves(self):
        """0'z ≥ 1 and 0'z ≤ −1, whatever the candidate is."""
        for low, high, sign in ((1.0, INF, -1.0), (-INF, -1.0, 1.0)):
            found = self.proved([-INF, -INF, low], [1.0, 2.0, high], y=(1.0, 1.0, 0.0))
            assert found.infeasible
            np.testing.assert_array_equal(found.certificate, [0.0, 0.0, sign])
        assert not self.proved([-INF, -INF, -1.0], [1.0, 2.0, 1.0]).infeasible

    def test_coordinates(self):
        found = self.proved([2.0, -INF, -1.0], [INF, 1.0, 1.0], y=(-0.25, 4.0, 0.0))
        assert found.infeasible and not found.unbounded
        np.testing.assert_array_equal(found.certificate, [-1.0, 1.0, 0.0])
        # T d = (−2, 2), along which z₁ falls and z₁ + z₂ stays; d itself is no ray.
        found = self.proved([0.0, 0.0, -1.0], [1.0, 1.0, 1.0], d=(-3.0, 4.0))
        assert found.unbounded and not found.infeasible
        np.testing.assert_array_equal(found.ray, [-1.0, 1.0])

    def test_no_rows(self):
        empty = jnp.zeros((0, 2))
        qp = jm.QP(jnp.zeros((2, 2)), jnp.ones(2), empty, jnp.zeros(0), jnp.zeros(0))
        none, rows = jnp.zeros(0), correcting_rows(qp)
        found = PROVE(qp, jnp.eye(2), none, rows, none, none, -jnp.ones(2))
        assert found.unbounded and not found.infeasible and found.certificate.shape == (0,)

    def test_joined(self):
        """What either proves, and the first where both do, but for one beyond the tolerance."""
        for *bits, beyond in np.ndindex(2, 2, 2, 2, 2):
            parts = [
                Proof(jnp.full(2, 1.0 + i), jnp.asarray(bool(a)), jnp.asarray(bool(a and beyond)),
                      jnp.full(3, 5.0 + i), jnp.asarray(bool(b)))
                for i, (a, b, beyond) in enumerate(((*bits[:2], False), (*bits[2:], beyond)))
            ]  # fmt: skip
            got = parts[0].joined(parts[1])
            assert got.infeasible == (bits[0] or bits[2])
            assert got.unbounded == (bits[1] or bits[3])
            assert got.beyond == (bits[2] and beyond)
            assert got.certificate[0] == (1 if bits[0] and not got.beyond else 2)
            assert got.ray[0] == (5 if bits[1] else 6)
        none = Proof.none(jnp.ones(3), jnp.ones(2))
        assert not none.infeasible and not none.unbounded
        assert not np.any(none.ray) and not np.any(none.certificate)


def test_to_length_one():
    np.testing.assert_array_equal(to_length_one(jnp.array([0.5, -2.0])), [0.25, -1.0])
    np.testing.assert_array_equal(to_length_one(jnp.zeros(3)), np.zeros(3))
    assert to_length_one(jnp.zeros(0)).shape == (0,)


def test_recession():
    """½ d'Hd + g'd is ½|Pd|² + ½(q'd/|q| + 1)² − ½, and only directions within bounds cost
    nothing."""
    rng, compiled = np.random.default_rng(4), jax.jit(recession)
    for q in (1e-9 * rng.normal(size=4), 1e9 * rng.normal(size=4)):
        P = rng.normal(size=(4, 4))
        P = P @ P.T
        bounds = Bounds(
            jnp.array([1.0, -INF, -INF, -2, 3, 3]), jnp.array([2.0, 5, INF, INF, 3, 3]),
            jnp.full(6, 7.0), jnp.full(6, 8.0), jnp.array([9.0]), (2,),
        )  # fmt: skip
        H, g, cone = jax.tree.map(np.asarray, compiled(jnp.asarray(P), jnp.asarray(q), bounds))
        for d in rng.normal(size=(5, 4)):
            along = q @ d / np.linalg.norm(q)
            expected = 0.5 * np.sum((P @ d) ** 2) + 0.5 * (along + 1) ** 2 - 0.5
            assert 0.5 * d @ H @ d + g @ d == pytest.approx(expected, rel=1e-9)
        np.testing.assert_array_equal(cone.l, [0, -INF, -INF, 0, 0, 0])
        np.testing.assert_array_equal(cone.u, [0, 0, INF, INF, 0, 0])
        np.testing.assert_array_equal(cone.radius, [0.0])
        assert cone.linear is None and cone.quadratic is None
    plain = Bounds(jnp.zeros(1), jnp.ones(1))
    H, g, cone = recession(jnp.eye(1), jnp.zeros(1), plain)
    assert cone.radius is None and g[0] == 0 and H[0, 0] == 1


class TestDescentRay:
    """min q'z + ½ z'Pz along d = (1, 1, 0), up to units of variables and rows."""

    D = np.array([1.0, 1.0, 0.0])
    FLAT = np.array([[2.0, -2, 1], [-2, 2, -1], [1, -1, 5]])

    def found(self, P, q, A, l, u, d=D, units=None):
        unit = np.ones(3) if units is None else units[:3]
        row = np.ones(len(A)) if units is None else units[3 : 3 + len(A)]
        A, l, u = np.array(A) * unit * row[:, None], row * np.array(l), row * np.array(u)
        return program(A, l, u, P * unit * unit[:, None], np.array(q) * unit, d=d / unit)

    def test_each_condition(self):
        rows = [[1.0, -1.0, 4.0], [1.0, 0.0, 0.0], [0.0, -3.0, 1.0]]
        l, u, q = [-1.0, -1.0, -INF], [1.0, INF, 1.0], [-1.0, 0.5, 3.0]
        bent = lambda t: self.FLAT + t * np.outer(self.D, self.D)
        moved = lambda i, t: [[v + t * (k == i) for v in row] for k, row in enumerate(rows)]
        case = lambda P=self.FLAT, q=q, A=rows, l=l, u=u, d=self.D: (P, q, A, l, u, d)
        cases = [
            (case(), True), (case(d=1e-9 * self.D), True), (case(q=[-1e-9, 0, 0]), True),
            (case(q=[1e9, -1e9 - 1, 0]), True),
            (case(d=-self.D), False), (case(d=0 * self.D), False), (case(q=[1.0, -1.0, 1]), False),
            (case(q=[1.0, -1.0 + 2e-16, 1]), False), (case(q=[0.0, 0.0, 1]), False),
            (case(P=bent(1e-8)), False), (case(P=bent(-1e-8)), False),
            (case(A=moved(0, 1e-9)), False), (case(A=moved(0, -1e-9)), False),
            (case(A=moved(0, 1e-9), u=[INF, INF, 1]), True),
            (case(A=moved(0, -1e-9), u=[INF, INF, 1]), False),
            (case(A=moved(0, -1e-9), l=[-INF, -1, -INF]), True),
            (case(A=moved(0, 1e-9), l=[-INF, -1, -INF]), False),
            (case(u=[1.0, 1.0, 1.0]), False), (case(l=[-1.0, -1.0, -1.0]), False),
        ]  # fmt: skip
        rng = np.random.default_rng(5)
        for units in (None, 2.0 ** rng.integers(-20, 20, 6), 2.0 ** rng.integers(-20, 20, 6)):
            programs = [self.found(*given, units=units) for given, _ in cases]
            _, _, rays, found = certify(programs)
            np.testing.assert_array_equal(found, [true for _, true in cases])
            for (_, _, d), ray, true in zip(programs, rays, found, strict=True):
                np.testing.assert_allclose(ray, d / np.abs(d).max() if true else 0 * d, rtol=1e-15)

    def test_products_may_be_off_by_rounding(self):
        """Matrices and rows across d in floats: products are sums that cancel."""
        rng = np.random.default_rng(6)
        programs = []
        for _ in range(60):
            d = rng.normal(size=3)
            across = lambda M, d=d: M - np.outer(M @ d, d) / (d @ d)
            factor, A = across(rng.normal(size=(2, 3))), across(rng.normal(size=(5, 3)))
            q = 1e3 * across(rng.normal(size=(1, 3)))[0] - d * 10.0 ** rng.uniform(-6, 0)
            programs.append(program(A, -np.ones(5), np.ones(5), factor.T @ factor, q, d=d))
        assert certify(programs)[3].all()
