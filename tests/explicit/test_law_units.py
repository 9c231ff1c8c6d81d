"""Laws, feasible sets and labels of the same problem written in other units, x = S x', u = V u',
with rows times any number, with equalities as two rows, and with previous inputs."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.explicit import critical_regions
from jaxmpc.recursion import analysis, smallest_horizon

INTEGRATOR = jm.LinearSystem([[1, 1], [0, 1.0]], [0.5, 1])
X = jm.Box([-5, -5], [5, 5])


def integrator(**settings):
    given = dict(system=INTEGRATOR, Q=np.eye(2), R=1.0, horizon=3, states=X, inputs=jm.Box(-1, 1))
    return jm.MPC(**{**given, "terminal_set": X, **settings})


def random_problem(rng):
    """Two states, one or two inputs, oblique limits: numbers (A, B, Q, R, X, x, U, u)."""
    m = int(rng.integers(1, 3))
    A, B = rng.normal(size=(2, 2)), rng.normal(size=(2, m))
    A *= rng.uniform(0.6, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    box = lambda k: np.vstack([np.eye(k), -np.eye(k)])
    H = np.vstack([box(2), rng.normal(size=(2, 2))])
    return (A, B, np.diag(rng.uniform(0.5, 2, 2)), np.diag(rng.uniform(0.5, 2, m)),
            H, rng.uniform(2, 4, 6), box(m), rng.uniform(0.5, 1.5, 2 * m))  # fmt: skip


def written(problem, S, V, row_x, row_u, row_f):
    """The problem in units S, V with rows times these numbers."""
    A, B, Q, R, H, h, G, g = problem
    system = jm.LinearSystem(A * S / S[:, None], B * V / S[:, None])
    body = lambda r: jm.Polytope(r[:, None] * H * S, r * h)
    return jm.MPC(
        system, Q * np.outer(S, S), R * np.outer(V, V), horizon=3, states=body(row_x),
        inputs=jm.Polytope(row_u[:, None] * G * V, row_u * g), terminal_set=body(row_f),
    )  # fmt: skip


def both(seed, spread=4):
    """A problem, the same in other units, and the units."""
    rng = np.random.default_rng(seed)
    problem = random_problem(rng)
    m = problem[1].shape[1]
    S, V = 10.0 ** rng.uniform(-spread, spread, 2), 10.0 ** rng.uniform(-spread, spread, m)
    rows = [10.0 ** rng.uniform(-8, 8, size) for size in (6, 2 * m, 6)]
    one = [np.ones(size) for size in (2, m, 6, 2 * m, 6)]
    return written(problem, *one), written(problem, S, V, *rows), S, V, rng


def check_law(seed):
    plain, other, S, V, rng = both(seed)
    a, b = critical_regions(plain), critical_regions(other)
    assert a.complete and b.complete and len(a) == len(b)
    assert b.volume * np.prod(S) == pytest.approx(a.volume, rel=1e-9)
    corners = np.concatenate([r.vertices for r in a.regions])
    x = rng.dirichlet(np.ones(len(corners)) / 4, 200) @ corners
    np.testing.assert_allclose(b.law(x / S) * V, a.law(x), rtol=0, atol=1e-8)
    X_N, other_X_N = jm.feasible_polytope(plain), jm.feasible_polytope(other)
    assert X_N.volume() == pytest.approx(a.volume, rel=1e-9)
    assert len(X_N.h) == len(other_X_N.h)
    assert other_X_N.volume() * np.prod(S) == pytest.approx(a.volume, rel=1e-9)
    require_optimal(plain, a, x)


def require_optimal(mpc, regions, x):
    """The plans are optimal: no hidden row, no other active set, by brute force at some states."""
    from scipy.optimize import minimize

    from jaxmpc.mpc.condense import condensed_in_float64

    c = condensed_in_float64(mpc)
    for state, z in zip(x[:3], regions.plan(x[:3]), strict=True):
        q = c.F @ state + c.f
        rows = c.C @ z + c.D @ state + c.d
        assert np.all(rows <= c.upper + 1e-9) and np.all(rows >= c.lower - 1e-9)
        best = minimize(
            lambda v, q=q: 0.5 * v @ c.P @ v + q @ v, z, jac=lambda v, q=q: c.P @ v + q,
            constraints=[
                {"type": "ineq", "fun": lambda v, k=k, s=state: (
                    c.upper[k] - (c.C @ v + c.D @ s + c.d)[k])} for k in range(len(c.C))
                if np.isfinite(c.upper[k])
            ], method="SLSQP", options={"ftol": 1e-14},
        )  # fmt: skip
        assert 0.5 * z @ c.P @ z + q @ z <= best.fun + 1e-7 * (1 + abs(best.fun))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_laws_in_other_units(seed):
    check_law(seed)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_laws_in_other_units_many():
    for seed in range(3, 53):
        check_law(seed)


def check_map(seed):
    plain, other, S, _, _ = both(seed)
    box = jm.feasible_polytope(plain).vertices()
    points = jm.grid(1.1 * box.min(axis=0) + 1e-3, 1.1 * box.max(axis=0), (8, 8))
    first, second = jm.map_feasible_set(plain, points), jm.map_feasible_set(other, points / S)
    assert np.all(first.label != 0)
    np.testing.assert_array_equal(first.label, second.label)
    body = jm.feasible_polytope(plain)
    off = np.max(points @ body.H.T - body.h, axis=1)
    np.testing.assert_array_equal(first.label[np.abs(off) > 1e-9] == 1, off[np.abs(off) > 1e-9] < 0)


@pytest.mark.slow
def test_labels_in_other_units():
    check_map(0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_labels_in_other_units_many():
    for seed in range(1, 21):
        check_map(seed)


def test_position_and_velocity_rows_in_unlike_units():
    """Position rows times 1e6, velocity rows times 1e-7: the same 23 regions and law."""

    def regions(factors):
        rows = np.vstack([np.eye(2), -np.eye(2)]) * np.array(factors)[:, None]
        body = jm.Polytope(rows, np.array([5, 2, 5, 2.0]) * factors)
        weights = dict(horizon=4, states=body, inputs=jm.Box(-1, 1), terminal_set=body)
        return critical_regions(jm.MPC(INTEGRATOR, [1.0, 1], 0.1, **weights))

    a, b = regions([1.0] * 4), regions([1e6, 1e-7, 1e6, 1e-7])
    assert len(a) == len(b) == 23 and a.complete and b.complete
    x = np.random.default_rng(0).uniform([-5, -2], [5, 2], (500, 2))
    np.testing.assert_allclose(a.law(x), b.law(x), atol=1e-12)


def test_a_row_that_is_dropped_is_noticed(monkeypatch):
    """Completeness rests on the rows as given: where the search loses one, it is not claimed."""
    from jaxmpc.explicit import active_sets, regions

    form = active_sets.least_distance_form

    def lossy(mpc, within, reach, **references):
        p = form(mpc, within, reach, **references)
        # the limits of x1 at the end of the horizon
        lost = np.abs(p.given.C[p.hull.rows]).sum(axis=1) == np.abs(p.given.C).sum(axis=1).max()
        lost &= p.side > 0
        assert lost.any()
        return replace(p, v=np.where(lost, p.v + 1e3, p.v))

    monkeypatch.setattr(regions, "least_distance_form", lossy)
    assert not critical_regions(integrator()).complete


# --- Equalities ------------------------------------------------------------------------------

POINTS = jm.grid([-4.9, -4.7], [4.8, 4.6], (8, 8))


def pair(row, offset, first=1.0, second=1.0):
    """row'x = offset as two rows."""
    row = np.array(row, float)
    return np.array([first * row, -second * row]), np.array([first * offset, -second * offset])


def coupled(first=1.0, second=1.0):
    """Two inputs that are equal, |u_1| ≤ 1."""
    H, h = pair([1, -1], 0.0, first, second)
    return jm.Polytope(np.vstack([H, [[1, 0], [-1, 0]]]), np.append(h, [1, 1]))


TWO = jm.LinearSystem([[1, 1], [0, 1.0]], [[0.5, 0.5], [1, 1]])
ORIGIN = jm.Polytope(*[np.concatenate(v) for v in zip(pair([1, 0.3], 0), pair([0, 1], 0, 7, 1e-6),
                                                       strict=True)])  # fmt: skip
ALIKE = {
    # the same problem: with its equality as rows, and without
    "coupled inputs": (
        integrator(system=TWO, R=np.eye(2), inputs=coupled()),
        integrator(system=jm.LinearSystem(TWO.A, [1, 2.0]), R=2.0),
    ),
    "coupled, unlike rows": (
        integrator(system=TWO, R=np.eye(2), inputs=coupled(1e6, 1e-7)),
        integrator(system=jm.LinearSystem(TWO.A, [1, 2.0]), R=2.0),
    ),
    "an input switched off": (
        integrator(system=TWO, R=np.eye(2), inputs=jm.Box([-1, 0], [1, 0]).to_polytope()),
        integrator(),
    ),
    "terminal point": (
        integrator(terminal_set=ORIGIN, horizon=4),
        integrator(terminal_set=jm.Box([0, 0], [0, 0]), horizon=4),
    ),
}


@pytest.mark.first(2)
@pytest.mark.parametrize("name", ALIKE)
@pytest.mark.slow
def test_equalities_as_rows(name):
    written, plain = ALIKE[name]
    volume = jm.feasible_polytope(plain).volume()
    assert jm.feasible_polytope(written).volume() == pytest.approx(volume, rel=1e-9)
    first, second = critical_regions(written), critical_regions(plain)
    assert first.complete and second.complete and len(first) == len(second)
    assert first.volume == pytest.approx(volume, rel=1e-9)
    corners = np.concatenate([r.vertices for r in first.regions])
    x = np.random.default_rng(0).dirichlet(np.ones(len(corners)) / 4, 40) @ corners
    m = plain.system.m
    np.testing.assert_allclose(first.law(x)[:, :m], second.law(x), atol=1e-8)
    labels = jm.map_feasible_set(written, POINTS).label
    assert np.all(labels != 0)
    np.testing.assert_array_equal(labels, jm.map_feasible_set(plain, POINTS).label)


def test_a_terminal_point_has_the_laws_multipliers():
    """At each vertex of each region P z + F x + f + C'y = 0 with y of the right signs."""
    regions = critical_regions(integrator(terminal_set=ORIGIN, horizon=4))
    from jaxmpc.mpc.condense import condensed_in_float64

    c = condensed_in_float64(regions.mpc)
    for r in regions.regions:
        z, y = r.vertices @ r.Z.T + r.z0, r.vertices @ r.L.T + r.l0
        gradient = z @ c.P.T + r.vertices @ c.F.T + c.f + y @ c.C[r.rows]
        assert np.abs(gradient).max() < 1e-9 * (1 + np.abs(y).max())
        above = np.isfinite(c.lower[r.rows])
        assert np.all(y[:, ~above] >= -1e-9 * (1 + np.abs(y).max()))


def with_a_constant_state():
    """A drift as a third state that is 1, and as a constant of the dynamics."""
    system = jm.LinearSystem([[1, 1, 0.2], [0, 1.0, 0.1], [0, 0, 1]], [0.5, 1, 0])
    limits = jm.Box([-5, -5, 1], [5, 5, 1])
    mpc = jm.MPC(system, np.eye(3), 1.0, 3, limits, jm.Box(-1, 1), terminal_set=limits)
    return mpc, integrator(system=replace(INTEGRATOR, c=np.array([0.2, 0.1])))


@pytest.mark.slow
def test_labels_with_a_constant_state():
    mpc, with_drift = with_a_constant_state()
    labels = jm.map_feasible_set(mpc, np.column_stack([POINTS, np.ones(64)])).label
    np.testing.assert_array_equal(labels, jm.map_feasible_set(with_drift, POINTS).label)


def test_a_constant_state_is_no_reason_to_be_undecided():
    mpc, with_drift = with_a_constant_state()
    with pytest.raises(ValueError, match="flat"):
        jm.feasible_polytope(mpc)
    regions, plain = critical_regions(mpc), critical_regions(with_drift)
    assert regions.complete and regions.free == (0, 1) and len(regions) == len(plain)
    assert regions.volume == pytest.approx(plain.volume, rel=1e-9)
    law = regions.law(np.column_stack([POINTS, np.ones(64)]))
    np.testing.assert_allclose(law, plain.law(POINTS), atol=1e-9)
    assert np.isnan(regions.law(np.column_stack([POINTS, 1.1 * np.ones(64)]))).all()
    with pytest.raises(ValueError, match="flat, as equalities tie the states"):
        jm.explicit.exact_penalty(mpc)


def test_invariant_sets_with_coupled_inputs():
    one = jm.LinearSystem(TWO.A, [1, 2.0])
    inputs, U = coupled(1e3, 1e-3), jm.Box(-1, 1)
    law = lambda s: jm.lqr(s, np.eye(2), 2 / s.m * np.eye(s.m)).K  # 2 u² = u_1² + u_2²
    for f in (
        lambda s, U: jm.sets.predecessor(s, X, X, U),
        lambda s, U: jm.sets.maximal_control_invariant_set(s, X, U),
        lambda s, U: jm.sets.maximal_invariant_set(s, law(s), X, U),
    ):
        found, expected = f(TWO, inputs), f(one, U)
        assert len(found.h) == len(expected.h)
        assert found.volume() == pytest.approx(expected.volume(), rel=1e-9)
    with pytest.raises(ValueError, match="inputs: the origin is not in its interior"):
        jm.sets.maximal_invariant_set(TWO, [[-0.2, -0.3], [-0.1, -0.3]], X, inputs)


def test_recursion_with_coupled_inputs():
    """The same claims as with one input, and the same counterexample."""
    coupled_mpc, plain = ALIKE["coupled inputs"]
    first, second = (jm.recursive_feasibility(m, seconds=60, search=False, steps=2)
                     for m in (coupled_mpc, plain))  # fmt: skip
    for name, claim in first.claims.items():
        assert claim.holds == second.claims[name].holds
    assert first.volume == pytest.approx(second.volume, rel=1e-9)


# --- Previous inputs ---------------------------------------------------------------------------


@pytest.mark.slow
def test_previous_inputs_are_within_their_limits():
    """One feasible set of (x, u_−1) for all: regions, polytope, labels, rays, fraction."""
    mpc = integrator(input_rate_limit=0.5, horizon=2)
    body, regions = jm.feasible_polytope(mpc), critical_regions(mpc)
    assert regions.complete and regions.volume == pytest.approx(body.volume(), rel=1e-9)
    assert body.support([0, 0, 1]) == pytest.approx(1) == body.support([0, 0, -1])
    points = np.array([[0, 0, 0.9], [0, 0, 1.1], [0, 0, -1.3], [1, -1, 0.0]])
    fmap = jm.map_feasible_set(mpc, points)
    assert fmap.label.tolist() == [1, -1, -1, 1]
    assert fmap.problem.axis_names[-1] == "previous u1"
    outer = jm.feasible.boundary(mpc, np.array([[0, 0, 1.0], [0, 0, -1]]), center=np.zeros(3)).outer
    np.testing.assert_allclose(outer, [1, 1], rtol=1e-6)
    projected = jm.map_feasible_set(mpc, points[:, :2], axes=(0, 1))
    assert projected.label.tolist() == [1, 1, 1, 1]
    # Without limits of the inputs any previous input could have been.
    free = replace(mpc, inputs=None)
    assert jm.map_feasible_set(free, np.array([[0, 0, 3.0]])).label.tolist() == [1]


def test_a_law_starts_at_random_points_where_the_centre_is_degenerate():
    """A published program without the facet-to-facet property, symmetric about the centre. Brute
    force over all active sets finds the same plans."""
    A = np.array([[1, 0, -1], [-1, 0, -1], [0, 1, -1], [0, -1, -1], [0.75, 0.64, -1],
                  [-0.75, -0.64, -1]])  # fmt: skip
    W = np.array([[1, 0], [-1, 0], [0, -1], [0, 1], [1, 0], [-1, 0.0]])
    rows = jm.Outputs(-W, np.full(6, -np.inf), -np.ones(6), A, stages=(0,))
    system = jm.LinearSystem(np.zeros((2, 2)), np.zeros((2, 3)))
    limits = jm.Box([-1.5] * 2, [1.5] * 2)
    mpc = jm.MPC(system, np.zeros((2, 2)), np.eye(3) / 2, 1, limits, outputs=rows)
    regions = critical_regions(mpc)
    assert regions.complete and regions.volume == pytest.approx(9, rel=1e-9)
    x = np.random.default_rng(0).uniform(-1.5, 1.5, (60, 2))
    sets = set()
    for state, plan in zip(x, regions.plan(x), strict=True):
        b = W @ state - 1
        for k in range(1, 4):
            for active in map(list, combinations(range(6), k)):
                M = A[active] @ A[active].T
                if np.linalg.cond(M) > 1e10:
                    continue
                y = -np.linalg.solve(M, b[active])
                z = -A[active].T @ y
                if np.all(y >= 0) and np.all(A @ z <= b + 1e-9):
                    np.testing.assert_allclose(plan, z, atol=1e-9)
                    sets.add(tuple(active))
    assert len(sets) <= len(regions) == 12


def test_no_limits_of_the_states_is_unbounded_not_empty():
    mpc = integrator(states=None, terminal_set=None)
    with pytest.raises(ValueError, match="unbounded along coordinate 0"):
        jm.explicit.exact_penalty(mpc)
    empty = integrator(terminal_set=jm.Box([8, 8], [9, 9]))
    with pytest.raises(ValueError, match="is empty"):
        critical_regions(empty)


def test_settled_horizons_survive_one_that_fails(monkeypatch):
    settle = analysis.settle_claims

    def fails_at_two(mpc, *rest):
        if mpc.horizon == 2:
            raise ValueError("LP: no answer")
        return settle(mpc, *rest)

    monkeypatch.setattr(analysis, "settle_claims", fails_at_two)
    weak = jm.MPC(INTEGRATOR, [1.0, 1], 10.0, 3, X, jm.Box(-0.1, 0.1))
    found = smallest_horizon(weak, max_horizon=3, max_regions=0)
    assert list(found.reasons) == [1, 2, 3] and found.reasons[2].holds is None
    assert "LP: no answer" in found.reasons[2].reason


@pytest.mark.slow
def test_programs_of_a_long_unstable_prediction_end():
    """2^18 between the first and last rows: HiGHS stops on some of the programs, or cycles."""
    system = jm.LinearSystem([[2.0, 1], [0, 0.5]], [1, 0.0])
    mpc = integrator(system=system, R=10.0, terminal_set=None)
    found = smallest_horizon(mpc, max_horizon=19, max_regions=0, seconds=250)
    assert found.horizon is None and list(found.reasons) == list(range(1, 20))
