"""Critical regions of any multi-parametric QP: degenerate, flat, unbounded, in any units.

The oracle is DAQP, an active-set solver that shares nothing with the search: at random parameters
the optimum of each QP, and where there is none.
"""

from dataclasses import replace

import daqp
import jax
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.explicit import ParametricQP, critical_regions, parametric_qp
from jaxmpc.explicit.parametric_program import in_numpy
from jaxmpc.mpc.condense import condensed_in_float64

INTEGRATOR = jm.LinearSystem([[1, 1], [0, 1.0]], [0.5, 1])
X, U = jm.Box([-5, -5], [5, 5]), jm.Box(-1, 1)


def optimum(qp, theta):
    """z of the QP at θ by DAQP, None where it is infeasible."""
    q = in_numpy(qp)
    rows = np.ascontiguousarray(q.G), q.h + q.S @ theta, np.full(len(q.h), -1e30)
    z, _, flag, _ = daqp.solve(q.P, q.q + q.F @ theta, *rows, np.zeros(len(q.h), np.int32),
                               primal_tol=1e-11)  # fmt: skip
    return z if flag == 1 else None


def cost(qp, theta, z):
    q = in_numpy(qp)
    Y, y, c = q.alone
    return z @ q.P @ z / 2 + (q.q + q.F @ theta) @ z + theta @ Y @ theta / 2 + y @ theta + c


def random_program(seed):
    """A program with duplicated and dependent rows, equalities, tied parameters, small whole
    numbers, on a box, a flat box or without bounds: (program, within)."""
    rng = np.random.default_rng(seed)
    nz, p, r = rng.integers(1, 5), rng.integers(1, 4), rng.integers(3, 8)
    whole = rng.random() < 0.5

    def draw(*shape):
        return rng.integers(-2, 3, shape).astype(float) if whole else rng.normal(size=shape)

    L, G, S = draw(nz, nz), draw(r, nz), draw(r, p) * (rng.random() < 0.8)
    h = rng.integers(0, 3, r).astype(float) if whole else rng.uniform(0.2, 2, r)
    rows = [np.column_stack([G, S, h])]
    if rng.random() < 0.5:  # the same rows again, and a sum of two
        rows += [rows[0][:2], 3 * rows[0][:1], rows[0][:1] + rows[0][1:2]]
    if rng.random() < 0.4:
        equal = draw(1, nz + p + 1)
        rows += [equal, -equal]
    if rng.random() < 0.3 and p > 1:
        tie = np.column_stack([np.zeros((1, nz)), draw(1, p), np.zeros((1, 1))])
        rows += [tie, -tie]
    data = np.vstack(rows)
    low, high = np.full(p, -2.0), np.full(p, 2.0)
    within = jm.Box(low, high)
    if rng.random() < 0.3:
        within = None
    elif rng.random() < 0.3 and p > 1:
        fixed = rng.integers(p)
        low[fixed] = high[fixed] = 0.5
        within = jm.Box(low, high)
    parts = {"q": draw(nz), "F": draw(nz, p), "Y": np.eye(p), "y": draw(p), "c": 1.5}
    program = ParametricQP(L @ L.T + np.eye(nz), data[:, :nz], data[:, -1], S=data[:, nz:-1],
                           **parts)  # fmt: skip
    return program, within, rng


def check(seed, spread):
    """The law in units of any size is DAQP's optimum in plain ones, and so is the value."""
    qp, within, rng = random_program(seed)
    nz, p = np.shape(qp.F)
    z_unit, unit = 10 ** rng.uniform(-spread, spread, nz), 10 ** rng.uniform(-spread, spread, p)
    row = 10 ** rng.uniform(-1.6 * spread, 1.6 * spread, len(qp.h))
    other = ParametricQP(
        qp.P * np.outer(z_unit, z_unit), row[:, None] * qp.G * z_unit, row * qp.h,
        qp.q * z_unit, z_unit[:, None] * qp.F * unit, row[:, None] * qp.S * unit,
        qp.Y * np.outer(unit, unit), qp.y * unit, qp.c,
    )  # fmt: skip
    set_ = None if within is None else jm.Box(within.lower / unit, within.upper / unit)
    try:
        regions = critical_regions(other, set_)
    except ValueError as error:
        assert any(word in str(error) for word in ("empty", "flat", "one value")), error
        for theta in rng.normal(size=(20, p)):
            fixed = theta if within is None else np.clip(theta, within.lower, within.upper)
            assert optimum(qp, fixed) is None
        return
    assert regions.complete, regions.reason
    corners = np.concatenate([r.vertices for r in regions.regions]) * unit
    points = [rng.dirichlet(np.ones(len(corners)) / 3, 20) @ corners]
    if within is None:
        points += [rng.normal(size=(10, p)), 300 * rng.normal(size=(10, p))]
    elif not regions.tied:
        points += [rng.uniform(within.lower, within.upper, (20, p))]
    points = np.concatenate(points)
    found, value, wrong = regions.plan(points / unit) * z_unit, regions.value(points / unit), 0
    for theta, z, v in zip(points, found, value, strict=True):
        best = optimum(qp, theta)
        if (best is None) != np.isnan(v):
            wrong += 1  # within rounding of the boundary
            continue
        if best is not None:
            size = 1 + np.abs(best).max()
            np.testing.assert_allclose(z, best, rtol=0, atol=1e-7 * size)
            assert v == pytest.approx(cost(qp, theta, z), rel=1e-7, abs=1e-7 * size**2)
    assert wrong <= 1


@pytest.mark.parametrize("seed", [0, 8, 21, 50, 58, 77, 103, 458])
def test_programs_of_all_kinds(seed):
    check(seed, spread=0)


@pytest.mark.parametrize("seed", [5, 12, 52, 103, 458, 540])
def test_programs_in_other_units(seed):
    check(seed, spread=4)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_many_programs():
    for seed in range(1000, 1300):
        check(seed, spread=seed % 5)


def test_a_row_that_the_optimum_always_meets():
    """Such a row is weakly active everywhere, with multiplier zero: rounding makes no facet."""
    P = np.array([[2.0, 2], [2, 6]])
    # The first derivative of the cost is P[0] z + q + F θ: its row says that it is at most zero.
    F = np.array([[-2.0, -2], [0, 0]])
    rows = np.vstack([P[:1], [[0, -1.0]]])
    qp = ParametricQP(P, rows, [2.0, 1.0], [-2.0, -2.0], F, np.vstack([-F[:1], [[1, 2.0]]]))
    regions = critical_regions(qp, jm.Box([-2, -2], [2, 2]))
    assert regions.complete and regions.volume == pytest.approx(16)
    theta = np.array([-0.5, -0.17])
    np.testing.assert_allclose(regions.plan([theta])[0], optimum(qp, theta), atol=1e-9)


def test_a_region_may_end_beyond_the_window(monkeypatch):
    """The first window is too small for the facets of this program, and is enlarged."""
    from jaxmpc.explicit import active_sets, regions

    qp = ParametricQP(np.eye(1), [[1.0], [-1.0]], [1e4, 1.0], F=[[1.0, -2.0]],
                      S=[[1.0, 0.0], [0.0, 0.01]])  # fmt: skip
    assert active_sets.REACH < 1e4
    found = critical_regions(qp)
    assert found.complete and found.volume == np.inf and len(found) == 3
    for theta in 10.0 ** np.arange(7)[:, None] * np.array([[1.0, 1.3], [-1, 0.4], [0.3, -1.1]])[0]:
        z = optimum(qp, theta)
        np.testing.assert_allclose(found.plan([theta])[0], z, rtol=1e-7, atol=1e-7)
    monkeypatch.setattr(regions, "WINDOWS", 1)
    monkeypatch.setattr(regions, "REACH", 1e-3)
    assert not critical_regions(qp).complete


class TestOfAnMPC:
    """Parameters beyond the state, and what limits leave open."""

    def agrees(self, mpc, regions, thetas, reference=None, input_reference=None):
        """The law is the first input of DAQP's plan, and the value that plan's cost, summed up
        along its roll-out. reference, input_reference: of θ."""
        c, A, B = condensed_in_float64(mpc), *map(np.asarray, (mpc.system.A, mpc.system.B))
        states = np.zeros((mpc.horizon + 1, 2)), np.zeros((mpc.horizon, 1))
        law, value, known = regions.law(thetas), regions.value(thetas), 0
        assert regions.complete, regions.reason
        for theta, u, v in zip(thetas, law, value, strict=True):
            x_r, u_r = (
                of(theta) if of else none
                for of, none in zip((reference, input_reference), states, strict=True)
            )
            with jax.enable_x64(True):
                qp = jax.tree.map(np.asarray, c.qp(theta[: c.D.shape[1]], x_r, u_r))
            z, _, flag, _ = daqp.solve(np.array(qp.P), np.array(qp.q), np.array(qp.A),
                                       np.minimum(qp.u, 1e30), np.maximum(qp.l, -1e30),
                                       np.zeros(len(qp.u), np.int32), primal_tol=1e-11)  # fmt: skip
            assert (flag == 1) == np.isfinite(v)
            if flag != 1:
                continue
            known += 1
            x, total, before = theta[:2], 0.0, theta[2:3]
            for k, inputs in enumerate(z.reshape(-1, 1)):
                error, off = x - x_r[k], inputs - u_r[k]
                total += error @ np.asarray(mpc.Q) @ error + off @ np.asarray(mpc.R) @ off
                if mpc.input_rate_weight is not None:
                    total += np.ravel(mpc.input_rate_weight)[0] * (inputs - before)[0] ** 2
                x, before = A @ x + B @ inputs, inputs
            np.testing.assert_allclose(u, z[:1], atol=1e-8)
            assert v == pytest.approx(total, rel=1e-8)
        assert known > 2

    def test_references_and_previous_input(self):
        mpc = jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 3, X, U, terminal_set=X,
                     input_rate_limit=0.5, input_rate_weight=[0.3])  # fmt: skip
        qp = parametric_qp(mpc, reference=[[1.0], [0]], input_reference=[[0.1]])
        assert qp.labels[-2:] == ("previous u1", "reference 1")
        regions = critical_regions(qp, jm.Box([-5, -5, -1, -3], [5, 5, 1, 3]))
        thetas = np.random.default_rng(0).uniform([-4, -1, -1, -3], [4, 1, 1, 3], (6, 4))
        self.agrees(
            mpc, regions, thetas, lambda t: np.tile([t[3], 0], (4, 1)),
            lambda t: np.full((3, 1), 0.1 * t[3]),
        )  # fmt: skip

    def test_given_references(self):
        """Also such that differ from step to step, and beside a rate's weight."""
        random = np.random.default_rng(0)
        mpc = jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 3, X, U, terminal_set=X)
        rates = replace(mpc, input_rate_weight=[0.3])
        for given, r, s in (
            (mpc, np.array([4.5, 0.2]), None),
            (mpc, None, np.array([0.3])),
            (rates, random.uniform(-3, 3, (4, 2)), random.uniform(-1, 1, (3, 1))),
        ):
            regions = critical_regions(given, reference=r, input_reference=s)
            thetas = random.uniform(-1, 1, (6, given.dimension)) * [4, 2, 1][: given.dimension]
            aims = [
                None if v is None else lambda _, v=v, k=k: np.broadcast_to(v, (k, v.shape[-1]))
                for v, k in ((r, 4), (s, 3))
            ]
            self.agrees(given, regions, thetas, *aims)
        with pytest.raises(ValueError, match="reference: shape"):
            critical_regions(mpc, reference=[1.0, 2, 3])
        with pytest.raises(ValueError, match="input_reference: given with a ParametricQP"):
            critical_regions(parametric_qp(mpc), input_reference=[1.0])

    def test_without_limits_it_is_lqr(self):
        """One region, R²: with the Riccati cost at the end the law is the gain of LQR."""
        found = jm.lqr(INTEGRATOR, np.eye(2), 0.1)
        regions = critical_regions(
            jm.MPC(INTEGRATOR, np.eye(2), 0.1, 4, terminal_cost=np.asarray(found.P))
        )
        assert regions.complete and len(regions) == 1 and regions.volume == np.inf
        x = np.random.default_rng(0).normal(size=(5, 2)) * [[1], [1e3], [1e6], [1], [1]]
        np.testing.assert_allclose(regions.law(x), x @ np.asarray(found.K).T, rtol=1e-5)
        cost = (x @ np.asarray(found.P) * x).sum(axis=1)
        np.testing.assert_allclose(regions.value(x), cost, rtol=1e-5)

    def test_inputs_alone_are_limited(self):
        mpc = jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 2, inputs=U)
        regions = critical_regions(mpc)
        assert regions.window is not None and "unbounded" in regions.reason
        sizes = np.array([1.0, 1, 10, 100, 1e4])[:, None]
        self.agrees(mpc, regions, sizes * np.random.default_rng(0).normal(size=(5, 2)))

    @pytest.mark.parametrize("horizon", [2, 3])
    def test_a_terminal_point_leaves_few_inputs_free(self, horizon):
        """Two inputs reach it from where two do: nothing is left to optimise at N = 2."""
        mpc = jm.MPC(INTEGRATOR, [1.0, 1], 0.1, horizon, X, U, terminal_set=jm.Box([0, 0], [0, 0]))
        regions = critical_regions(mpc)
        assert regions.complete
        assert regions.volume == pytest.approx(jm.feasible_polytope(mpc).volume(), rel=1e-9)

    def test_an_unstable_plant_without_inputs_at_the_end(self):
        """What is rounding in an orthonormal basis scaled the linear programs: "flat"."""
        system = jm.LinearSystem([[2.0, 1], [0, 0.5]], [0.25, 1])
        mpc = jm.MPC(system, [1.0, 1], 1.0, 6, X, U, prestabilise=True)
        regions = critical_regions(mpc)
        assert regions.complete
        assert regions.volume == pytest.approx(jm.feasible_polytope(mpc).volume(), rel=1e-9)

    def test_limits_of_states_alone(self):
        """Rows that leave some inputs alone have dependent columns."""
        system = jm.LinearSystem([[1, 1], [0, 1.0]], np.eye(2))
        mpc = jm.MPC(system, [1.0, 1], np.eye(2), 3, X)
        regions = critical_regions(mpc)
        assert regions.complete and regions.volume == pytest.approx(100)

    def test_inputs_that_do_nothing(self):
        """A column of zeros in B: the optimum is zero there, which no residual may divide by."""
        system = jm.LinearSystem([[1.01]], [[0.0, -1.0]])
        regions = critical_regions(jm.MPC(system, 1.0, np.eye(2) * 2, 3, jm.Box(-4, 3), U))
        assert regions.complete, regions.reason


def test_costs_that_are_singular_but_for_rounding_are_refused():
    """P = MM' with fewer columns than rows leaves z open along M'z = 0; of its rounded entries a
    Cholesky factor may exist."""
    rng = np.random.default_rng(0)
    for n in (2, 3, 4):
        for k in range(1, n):
            for _ in range(10):
                M = rng.normal(size=(n, k)) * 10.0 ** rng.uniform(-2, 2, (n, 1))
                qp = ParametricQP(M @ M.T, np.ones((1, n)), [1.0], F=rng.normal(size=(n, 1)))
                with pytest.raises(ValueError, match="P: is singular"):
                    critical_regions(qp, jm.Box([-1], [1]))


def test_errors():
    qp = ParametricQP(np.eye(2), np.eye(2), [1.0, 1.0], S=np.ones((2, 1)))
    box = jm.Box([-1], [1])
    assert critical_regions(qp, box).complete
    for changes, message in [
        ({"P": np.diag([1.0, 0.0])}, "P: is singular"),
        ({"P": np.diag([1.0, -1.0])}, "P: is not positive semidefinite"),
        ({"P": np.eye(3)}, r"G: shape"),
        ({"h": [1.0, np.nan]}, "h: holds NaN"),
        ({"h": [1.0]}, "h: shape"),
        ({"S": None}, "F, S: are both None"),
        ({"S": np.ones(2)}, "S: shape"),
        ({"F": [[1.0, 2], [3, 4]]}, "S: shape"),
        ({"q": [np.inf, 0]}, "q: holds NaN or infinity"),
        ({"names": ("a", "b")}, "names: 2 entries where 1"),
        ({"output": (np.eye(2), np.eye(2), np.zeros(2))}, "output: direct"),
        ({"h": [-3.0, 1.0], "G": np.zeros((2, 2))}, "is empty"),
    ]:
        with pytest.raises(ValueError, match=message):
            critical_regions(replace(qp, **changes), box)
    with pytest.raises(ValueError, match="problem: is an int"):
        critical_regions(3)
    with pytest.raises(ValueError, match="within: has dimension 2"):
        critical_regions(qp, jm.Box([-1, -1], [1, 1]))
    with pytest.raises(ValueError, match="regions: are those of a ParametricQP"):
        _ = critical_regions(qp, box).mpc
    mpc = jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 2, inputs=U)
    with pytest.raises(ValueError, match=r"reference: shape \(3, 1\)"):
        parametric_qp(mpc, reference=np.ones((3, 1)))


def test_no_c_code_of_unbounded_regions(tmp_path):
    regions = critical_regions(jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 2, inputs=U))
    with pytest.raises(ValueError, match=r"regions: .*unbounded.*within"):
        jm.export.export_explicit_c(regions, tmp_path)
