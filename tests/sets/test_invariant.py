"""Invariant sets and terminal conditions, against closed forms and exact rational results."""

from dataclasses import replace
from fractions import Fraction

import exact
import jax
import numpy as np
import problems
import pytest
from problems import symmetric

from jaxmpc import Box, LinearSystem, Polytope, lqr, maximal_invariant_set
from jaxmpc.sets.control_invariant import (
    ControlInvariantSet,
    largest_cut,
    maximal_control_invariant_set,
)
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.invariant import invariant_ellipsoid
from jaxmpc.sets.one_step import one_step, predecessor
from jaxmpc.sets.terminal_hypotheses import _exact_factor, _Loop, _Rows, verify_terminal

INF = np.inf
JOINT = LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
DOUBLE = LinearSystem([[1, 1], [0, 1]], [[1], [0.5]])
LECTURE = LinearSystem([[1, 1], [0, 1]], [[0.4], [1]])
UNSTABLE = LinearSystem([[2.0]], [[1.0]])


def interval(polytope):
    """(lower, upper) of a set on the line."""
    return -polytope.support(np.array([-1.0])), polytope.support(np.array([1.0]))


# --- One step back ---------------------------------------------------------------------


@pytest.mark.slow
def test_numbers_are_the_limits_of_every_coordinate():
    system = LinearSystem([[1, 0.1], [0, 1]], [0, 0.1])
    given = maximal_control_invariant_set(system, Box(-1, 1), Box(-0.5, 0.5))
    full = maximal_control_invariant_set(system, Box([-1, -1], [1, 1]), Box([-0.5], [0.5]))
    np.testing.assert_array_equal(given.H, full.H)
    np.testing.assert_array_equal(given.h, full.h)


def test_predecessor_on_the_line():
    w = Box([-0.5], [0.25])
    # 2x + u + w in [-3, 3]: 2x <= 3 - 0.25 + 1 and 2x >= -3 + 0.5 - 1
    before = predecessor(UNSTABLE, symmetric(3), None, symmetric(1), w)
    assert interval(before) == pytest.approx((-1.75, 1.875), abs=1e-14)
    before = predecessor(UNSTABLE, symmetric(3), symmetric(1.8), symmetric(1).to_polytope(), w)
    assert interval(before) == pytest.approx((-1.75, 1.8), abs=1e-14)
    drifting = LinearSystem([[1.0]], [[1.0]], c=[3.0])
    before = predecessor(drifting, Box([2], [5]), None, Box([0], [1]))
    assert interval(before) == pytest.approx((-2, 2), abs=1e-14)
    # a single admissible input; and inputs that reach anything
    before = predecessor(UNSTABLE, symmetric(3), None, Box([0.5], [0.5]))
    assert interval(before) == pytest.approx((-1.75, 1.25), abs=1e-14)
    before = predecessor(UNSTABLE, symmetric(3), None, None)
    assert not before.H.any() and before.h == [1.0]
    assert predecessor(UNSTABLE, symmetric(3), Box([4], [5]), symmetric(1)).is_empty()
    assert predecessor(UNSTABLE, symmetric(3), None, symmetric(1), symmetric(3.1)).is_empty()


def test_predecessor_with_a_singular_matrix_is_a_strip():
    system = LinearSystem([[1, 1], [0, 0]], [[0.5], [1]])
    before = predecessor(system, symmetric(1, 1), None, symmetric(1))
    order = np.argsort(before.H[:, 0])
    np.testing.assert_allclose(before.H[order] * np.sqrt(2), [[-1, -1], [1, 1]], atol=1e-14)
    np.testing.assert_allclose(before.h * np.sqrt(2), 1.5, atol=1e-14)
    # what cannot be reached at all: x2+ = u in [2, 3] with |u| <= 1
    target = Box([-1, 2], [1, 3])
    assert predecessor(system, target, None, symmetric(1)).is_empty()
    stuck = LinearSystem([[1, 0], [0, 0]], [[1], [0]])
    assert predecessor(stuck, target, None, symmetric(1)).is_empty()


def test_predecessor_with_a_triangle_of_inputs():
    triangle = Polytope([[-1, 0], [0, -1], [1, 1]], [0, 0, 1])
    system = LinearSystem(np.eye(2), np.eye(2))
    before = predecessor(system, symmetric(1, 1), symmetric(5, 5), triangle)
    # area of a sum: 4 + 1/2 + twice the mixed area, 2 (1 + 1)
    assert before.volume() == pytest.approx(8.5, abs=1e-12) and len(before.h) == 5


def test_predecessor_by_ridges_and_by_elimination(monkeypatch):
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((66, 4))
    target = Polytope(normals / np.linalg.norm(normals, axis=1)[:, None], 1 + 0.2 * rng.random(66))
    system = LinearSystem(np.eye(4), rng.standard_normal((4, 2)))
    inputs = Box([-0.3, -0.1], [0.2, 0.4])
    by_ridges = predecessor(system, target, None, inputs)
    monkeypatch.setattr("jaxmpc.sets.one_step._MANY", 1000)
    by_pairs = predecessor(system, target, None, inputs)
    assert len(by_ridges.h) == len(by_pairs.h) > 250
    assert by_ridges.volume() == pytest.approx(by_pairs.volume(), rel=1e-12)
    for direction in rng.standard_normal((10, 4)):  # a sum of sets: their supports add up
        expected = target.support(direction) + float(inputs.support(-direction @ system.B))
        assert by_ridges.support(direction) == pytest.approx(expected, rel=1e-6)


# --- Maximal control invariant sets ----------------------------------------------------


@pytest.mark.parametrize(
    ("system", "states", "inputs", "area", "vertices", "index"),
    [
        (DOUBLE, symmetric(5, 5), 1, Fraction(1375, 24), 14, 6),
        (JOINT, symmetric(1.5, 2), 2, Fraction(1489, 125), 14, 5),
        (LECTURE, symmetric(1, 1), 0.25, Fraction(207, 80), 10, 4),
        (LECTURE, symmetric(1, 1), 0.3, Fraction(7027, 2500), 10, 3),
    ],
)
@pytest.mark.first(1)
def test_known_control_invariant_sets(system, states, inputs, area, vertices, index):
    found = maximal_control_invariant_set(system, states, symmetric(inputs))
    assert found.exact and found.iterations == index and found.gap == 0
    assert f"C_{index} = C_{index + 1}" in found.reason
    assert found.volume() == pytest.approx(float(area), abs=1e-12)
    assert len(found.vertices()) == len(found.h) == vertices
    np.testing.assert_array_equal(found.outer.h, found.h)
    shorter = maximal_control_invariant_set(
        system, states, symmetric(inputs), max_iterations=index - 1
    )
    assert not shorter.exact and "max_iterations" in shorter.reason
    assert shorter.volume() < float(area) < shorter.outer.volume()


def test_affine_dynamics_and_two_inputs_against_rationals():
    mpc = problems.drifting()
    found = maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs, max_iterations=4)
    # Complex eigenvalues outside the unit circle: each C_k has new facets, without end.
    assert not found.exact and found.iterations == 4
    body = exact.feasible_polygon(replace(mpc, terminal_set=mpc.states, horizon=4))
    assert found.outer.volume() == pytest.approx(float(body.area), rel=1e-13)
    assert len(found.outer.h) == len(body.vertices)
    later = exact.feasible_polygon(replace(mpc, terminal_set=mpc.states, horizon=12))
    assert later.contains(found.vertices() * (1 - 1e-12)).all()
    assert 0.5 * float(later.area) < found.volume() <= float(later.area)


@pytest.mark.slow
def test_recursion_without_end_gives_a_pair():
    found = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1))
    assert not found.exact and found.gap < 1e-9 and "without end" in found.reason
    inner, outer = interval(found), interval(found.outer)
    assert -1 - 1e-12 <= inner[0] < -1 + 1e-9 and 1 - 1e-9 < inner[1] <= 1 + 1e-12
    assert -1 - 1e-9 < outer[0] <= -1 and 1 <= outer[1] < 1 + 1e-9
    early = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1), max_iterations=3)
    assert early.iterations == 3 and interval(early.outer)[1] == pytest.approx(1 + 4 / 8)
    assert 0.9 < interval(early)[1] <= 1 and early.gap == pytest.approx(
        1.5 / interval(early)[1] - 1, rel=1e-9
    )
    # Its unstable mode x1 + 2/3 x2 doubles, with |u| 11/12 against it; x2 stays by itself.
    mpc = problems.unstable()
    found = maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs)
    assert not found.exact and found.gap < 1e-8
    assert found.volume() <= 55 / 3 <= found.outer.volume()
    assert found.volume() == pytest.approx(55 / 3, rel=1e-8)


@pytest.mark.slow
def test_robust_control_invariant_sets():
    w = symmetric(0.1)
    found = maximal_control_invariant_set(UNSTABLE, symmetric(5), symmetric(1), disturbance=w)
    assert not found.exact and interval(found)[1] == pytest.approx(0.9, abs=1e-9)
    # x+ = x + u + w keeps any interval that w leaves room in, if u is the stronger one.
    integrator = LinearSystem([[1.0]], [[1.0]])
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.3), disturbance=w)
    assert found.exact and found.iterations == 0 and interval(found) == (-1, 1)
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.1), disturbance=w)
    assert found.exact
    found = maximal_control_invariant_set(integrator, symmetric(1), symmetric(0.05), disturbance=w)
    assert found.exact and found.is_empty() and "against every disturbance" in found.reason
    # In the plane: the worst disturbance at every step, the input by one LP on the set's rows.
    w = Box([-0.02, -0.05], [0.03, 0.05]).to_polytope()
    states, inputs = symmetric(5, 5), symmetric(1)
    found = maximal_control_invariant_set(DOUBLE, states, inputs, disturbance=w)
    assert found.exact and found.volume() < 1375 / 24
    A, B = np.array(DOUBLE.A, float), np.array(DOUBLE.B, float)[:, 0]
    for x in found.vertices():
        # B u + A x + W within {H x <= h}: an interval of u
        left = found.h - (found.H @ w.vertices().T).max(axis=1) - found.H @ (A @ x)
        slope = found.H @ B
        top = min(1, (left[slope > 1e-12] / slope[slope > 1e-12]).min())
        bottom = max(-1, (left[slope < -1e-12] / slope[slope < -1e-12]).max())
        assert bottom <= top + 1e-9


def test_empty_and_flat_sets_are_reported():
    far = LinearSystem([[1.0]], [[1.0]], c=[2.0])
    found = maximal_control_invariant_set(far, symmetric(5), symmetric(1))
    assert found.exact and found.is_empty() and found.outer.is_empty()
    assert (
        found.reason.startswith("empty: no equilibrium") and "misses them by 1 of" in found.reason
    )
    nowhere = LinearSystem(np.eye(2), [[1], [0]], c=[0, 0.1])
    found = maximal_control_invariant_set(nowhere, symmetric(5, 5), None)
    assert found.is_empty() and "no equilibrium" in found.reason
    found = maximal_control_invariant_set(
        UNSTABLE, symmetric(5), symmetric(1), disturbance=symmetric(1.1)
    )
    assert found.is_empty() and "against every disturbance" in found.reason
    alone = maximal_control_invariant_set(UNSTABLE, symmetric(5), Box([0], [0]))
    assert not alone.exact and alone.gap == INF and "an equilibrium alone" in alone.reason
    assert interval(alone) == pytest.approx((0, 0), abs=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": None}, "states: NoneType is no Box"),
        ({"states": Box([-1, -INF], [1, 1])}, "states: is unbounded"),
        ({"states": Box([-1, 0], [1, 0])}, "states: is flat"),
        ({"inputs": symmetric(1, 1)}, "inputs: has dimension 2"),
        ({"disturbance": Box([0.1, 0], [0.2, 1])}, "disturbance: does not hold the origin"),
        ({"disturbance": Box([-1, -INF], [0.2, 1])}, "disturbance: is unbounded"),
        ({"max_iterations": 0}, "max_iterations: 0 is no positive"),
        ({"tolerance": 0.0}, "tolerance: 0.0 is not between"),
    ],
)
def test_control_invariant_set_errors(changes, message):
    arguments = {"states": symmetric(1, 1), "inputs": symmetric(1)} | changes
    with pytest.raises(ValueError, match=message):
        maximal_control_invariant_set(DOUBLE, **arguments)


BLOCKS = [(0.2, (1.5, 2.0)), (0.1, (1.0, 1.5)), (0.25, (1.2, 1.8))]


def hidden(blocks):
    """Joints behind a unimodular change of coordinates of states and of inputs."""
    n = 2 * blocks
    T = (np.eye(n) - np.eye(n, k=-1) - np.eye(n, k=-3)) @ (np.eye(n) + np.eye(n, k=2))
    T_inverse = np.round(np.linalg.inv(T))
    V = np.eye(blocks) - np.eye(blocks, k=1)
    A, B, limits = np.kron(np.eye(blocks), JOINT.A), np.zeros((n, blocks)), []
    for i in range(blocks):
        gain, limit = BLOCKS[i % 3]
        B[2 * i + 1, i] = gain
        limits += limit
    system = LinearSystem(T @ A @ T_inverse, T @ B @ V)
    states = Polytope(np.vstack([T_inverse, -T_inverse]), np.tile(limits, 2))
    return system, states, Polytope(np.vstack([V, -V]), np.full(2 * blocks, 2.0)), T


@pytest.mark.parametrize(
    "blocks", [pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow), 6]
)
@pytest.mark.slow
def test_hidden_products(blocks):
    system, states, inputs, T = hidden(blocks)
    assert abs(np.linalg.det(T)) == pytest.approx(1)
    parts = [
        maximal_control_invariant_set(
            LinearSystem(JOINT.A, [[0], [gain]]), symmetric(*limit), symmetric(2)
        )
        for gain, limit in BLOCKS[:blocks]
    ]
    parts = parts * (1 if blocks < 6 else 2)
    found = maximal_control_invariant_set(system, states, inputs)
    assert found.exact and found.iterations == max(part.iterations for part in parts)
    assert len(found.h) == sum(len(part.h) for part in parts)
    volume = np.prod([part.volume() for part in parts])
    assert found.volume() == pytest.approx(volume, rel=1e-10)
    for direction in np.random.default_rng(0).standard_normal((10, 2 * blocks)):
        own = (T.T @ direction).reshape(-1, 2)
        expected = sum(part.support(d) for part, d in zip(parts, own, strict=True))
        assert found.support(direction) == pytest.approx(expected, rel=1e-10)


def test_checks_of_invariance_can_fail():
    step = one_step(DOUBLE, symmetric(1), None)
    box = symmetric(5, 5).to_polytope()
    # from (5, 5) the least sum of coordinates after a step is 9: x1 + x2 <= 6, 4/10 of 10 off
    assert largest_cut(step.back(box), box) == pytest.approx(0.4, abs=1e-12)
    assert largest_cut(step.back(box), box, enough=0.01) > 0.01


def test_control_invariant_sets_pass_through_jax():
    found = maximal_control_invariant_set(JOINT, symmetric(1.5, 2), symmetric(2))
    leaves, tree = jax.tree.flatten(found)
    again = jax.tree.unflatten(tree, leaves)
    assert isinstance(again, ControlInvariantSet) and again.exact and again.reason == found.reason
    assert bool(found.contains(np.zeros(2))) and not bool(found.contains(np.array([1.5, 2.0])))


# --- Robust maximal invariant sets -----------------------------------------------------


def test_robust_invariant_sets_on_the_line():
    no_input = np.zeros((1, 1))
    half = LinearSystem([[-0.5]], [[1.0]])
    limits, w = Box([-1], [3]), symmetric(0.1)
    # -x/2 + w >= -1 asks x <= 1.8; what x <= 3 asks of later steps is weaker
    found = maximal_invariant_set(half, no_input, limits, None, disturbance=w)
    assert interval(found) == pytest.approx((-1, 1.8), abs=1e-14) and found.index == 1
    same = maximal_invariant_set(half, no_input, limits, None, disturbance=symmetric(0))
    assert interval(same) == interval(maximal_invariant_set(half, no_input, limits, None))
    assert interval(same) == pytest.approx((-1, 2))
    # |w| adds up to 0.6 / (1 - 0.5) = 1.2 > 1
    with pytest.raises(ValueError, match=r"disturbance: moves the state by 1.05 of .* within 3"):
        maximal_invariant_set(half, no_input, symmetric(1), None, disturbance=symmetric(0.6))
    maximal_invariant_set(half, no_input, symmetric(1), None, disturbance=symmetric(0.49))


@pytest.mark.parametrize("shape", ["box", "polytope"])
def test_robust_invariant_set_in_the_plane(shape):
    K = np.array(lqr(DOUBLE, np.eye(2), np.eye(1)).K)
    closed = np.array(DOUBLE.A) + np.array(DOUBLE.B) @ K
    w = Box([-0.1, -0.05], [0.08, 0.1])
    if shape == "polytope":
        w = Polytope([[1, 1], [-1, 0], [0, -1]], [0.1, 0.1, 0.05])
    found = maximal_invariant_set(DOUBLE, K, symmetric(5, 5), symmetric(1), disturbance=w)
    corners = w.vertices()
    images = (found.vertices() @ closed.T)[:, None] + corners
    assert (images @ found.H.T - found.h).max() <= 1e-12
    # by the definition: F Acl^k x + the worst sums of F Acl^i w, 60 steps ahead
    F = np.vstack([np.eye(2) / 5, -np.eye(2) / 5, K, -K])
    points = np.random.default_rng(1).uniform(-5, 5, (4000, 2))
    worst, power, drift = np.full(len(points), -INF), np.eye(2), np.zeros(len(F))
    for _ in range(60):
        worst = np.maximum(worst, (points @ (F @ power).T + drift).max(axis=1))
        drift, power = drift + (F @ power @ corners.T).max(axis=1), closed @ power
    inside = (points @ found.H.T <= found.h).all(axis=1)
    np.testing.assert_array_equal(inside, worst <= 1)
    assert 100 < inside.sum() < 3900
    # random extreme disturbances never lead out
    rng, x = np.random.default_rng(2), np.repeat(found.vertices(), 50, axis=0)
    for _ in range(50):
        x = x @ closed.T + corners[rng.integers(len(corners), size=len(x))]
        assert (x @ found.H.T <= found.h + 1e-12).all()


# --- Invariant ellipsoids --------------------------------------------------------------


@pytest.mark.parametrize(
    ("system", "Q", "R", "states", "inputs", "level", "gamma2", "area"),
    [
        (
            JOINT, np.diag([50.0, 1.0]), [[0.1]], (1.5, 2), 2,
            1.4137628195913876, 0.9168846938332548, 0.10389475972612443,
        ),
        (
            DOUBLE, np.eye(2), [[1.0]], (5, 5), 1,
            2.2690725611388145, 0.4595183119694164, 3.2752599406821137,
        ),
    ],
)  # fmt: skip
def test_known_ellipsoids(system, Q, R, states, inputs, level, gamma2, area):
    law = lqr(system, Q, R)
    arguments = (system, law.K, law.P, symmetric(*states), symmetric(inputs))
    ellipsoid = invariant_ellipsoid(*arguments)
    assert ellipsoid.level == pytest.approx(level, rel=1e-12)
    assert ellipsoid.contraction == pytest.approx(gamma2, rel=1e-12)
    assert ellipsoid.volume() == pytest.approx(area, rel=1e-12)


def test_ellipsoids_on_the_line():
    half, K, P = LinearSystem([[0.5]], [[1.0]]), [[0.25]], [[4.0]]
    # 4 x^2 <= level within |x| <= 3 and |x / 4| <= 0.5
    assert invariant_ellipsoid(half, K, P, symmetric(3), symmetric(0.5)).level == 16
    assert invariant_ellipsoid(half, K, P, None, symmetric(0.5)).level == 16
    assert invariant_ellipsoid(half, K, P, symmetric(3), None).level == 36
    assert invariant_ellipsoid(half, K, P, Box([-1], [INF]), None).level == 4
    # |w|_P = 2 |w| and gamma = 3/4: the level must be 64 w^2
    limits = (symmetric(1), None)
    assert invariant_ellipsoid(half, K, P, *limits, symmetric(0.25)).level == 4
    with pytest.raises(ValueError, match=r"needs the level 5\.76 .* leave 4, .* 1\.76 too little"):
        invariant_ellipsoid(half, K, P, *limits, symmetric(0.3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": [[1.0]]}, r"P: is no Lyapunov matrix .* by the factor 2\.25 "),
        ({"P": [[-1.0]]}, "P: is not positive definite"),
        ({"P": [[1.0, 0]]}, "P: shape"),
        ({"states": Box([0], [1])}, "states: the origin is not in its interior"),
        ({"inputs": Box([0.1], [1])}, "inputs: the origin is not in its interior"),
        ({"states": None, "inputs": None}, "nothing is constrained"),
        ({"system": LinearSystem([[0.5]], [[1.0]], c=[1.0])}, "system.c"),
    ],
)
def test_ellipsoid_errors(changes, message):
    arguments = {
        "system": LinearSystem([[0.5]], [[1.0]]), "K": [[0.25]], "P": [[4.0]],
        "states": symmetric(1), "inputs": symmetric(1),
    }  # fmt: skip
    with pytest.raises(ValueError, match=message):
        invariant_ellipsoid(**(arguments | changes))


# --- Terminal conditions ---------------------------------------------------------------


def joint_arguments(terminal_set, **changes):
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    return {
        "system": JOINT, "Q": Q, "R": R, "terminal_cost": lqr(JOINT, Q, R).P,
        "terminal_set": terminal_set, "states": symmetric(1.5, 2), "inputs": symmetric(2),
    } | changes  # fmt: skip


def test_terminal_set_of_the_joint_and_its_certificate():
    K = lqr(JOINT, np.diag([50.0, 1.0]), np.array([[0.1]])).K
    terminal = maximal_invariant_set(JOINT, K, symmetric(1.5, 2), symmetric(2))
    report = verify_terminal(**joint_arguments(terminal))
    assert report.recursive_feasibility is True and report.stability is True
    assert all(check.holds for check in report.checks)
    assert "Theorem 1 (recursive feasibility) applies." in str(report)
    assert len(str(report).splitlines()) == 2 + 2 * len(report.checks)
    # M >= 0, M H = H (A + BK), M h <= h, in rationals; the set's rows were rounded themselves
    M, H, h, A, B, K = (
        exact.rational(part)
        for part in (report.certificate, terminal.H, terminal.h, JOINT.A, JOINT.B, report.K)
    )
    closed = [[A[i][j] + B[i][0] * K[0][j] for j in range(2)] for i in range(2)]
    columns = list(zip(*H, strict=True))
    for i, weights in enumerate(M):
        assert min(weights) >= 0
        assert exact.dot(weights, h) <= h[i] * (1 + Fraction(1, 10**14))
        for j in range(2):
            image = exact.dot(H[i], [row[j] for row in closed])
            assert abs(exact.dot(weights, columns[j]) - image) <= Fraction(1, 10**14)
    assert report.exact_factor <= 1 + Fraction(1, 10**14)
    # the ellipsoid of the same law
    ellipsoid = invariant_ellipsoid(
        JOINT, report.K, lqr(JOINT, np.diag([50.0, 1.0]), np.array([[0.1]])).P,
        symmetric(1.5, 2), symmetric(2),
    )  # fmt: skip
    report = verify_terminal(**joint_arguments(ellipsoid, terminal_cost=None))
    assert report.recursive_feasibility is True and report.stability is True
    assert report.factor == pytest.approx(0.9168846938332548, rel=1e-12)
    assert "rational arithmetic" in report["invariance under K"].sentence
    assert report["inputs of K admissible"].margin == pytest.approx(0, abs=1e-12)
    larger = Ellipsoid(ellipsoid.P, 4 * ellipsoid.level)
    report = verify_terminal(**joint_arguments(larger))
    assert report["inputs of K admissible"].margin == pytest.approx(-2, abs=1e-12)
    assert report["control invariance"].holds is None and report.recursive_feasibility is None
    assert report.stability is False


def test_control_invariance_is_enough_for_theorem_1():
    terminal = maximal_control_invariant_set(JOINT, symmetric(1.5, 2), symmetric(2))
    report = verify_terminal(**joint_arguments(terminal))
    assert report.recursive_feasibility is True and report.stability is False
    assert report["invariance under K"].holds is False
    assert report["inputs of K admissible"].margin < -20
    report = verify_terminal(**joint_arguments(None))
    assert report.recursive_feasibility is False
    assert "[1.5, 2. ]" in report["control invariance"].sentence
    assert "at horizon N - 1" in report["control invariance"].sentence


def test_rational_certificates_of_dyadic_data():
    # |x| <= 1 under diag(1/2, -1/4) plus a coupling of 1/4: 3/4 in the first row, exactly
    system = LinearSystem([[0.5, 0.25], [0, -0.25]], [[0.0], [1.0]])
    arguments = {
        "system": system, "Q": np.eye(2), "R": np.eye(1), "terminal_cost": 4 * np.eye(2),
        "terminal_set": symmetric(1, 1), "states": symmetric(1, 1), "inputs": symmetric(1),
        "K": np.zeros((1, 2)),
    }  # fmt: skip
    report = verify_terminal(**arguments)
    assert report.exact_factor == Fraction(3, 4) and report.factor == 0.75
    assert report.stability is True
    report = verify_terminal(**arguments, disturbance=Box([-0.25, 0], [0.25, 0.125]))
    assert report.exact_factor == 1 and report["invariance under K"].holds is True
    report = verify_terminal(**arguments, disturbance=symmetric(0.5, 0))
    assert report.exact_factor == Fraction(5, 4)
    assert report["invariance under K"].margin == pytest.approx(-0.25)
    # no input acts against the first coordinate
    assert report["control invariance"].holds is False
    report = verify_terminal(**(arguments | {"K": [[0.0, 1.25]]}))
    assert report.exact_factor == 1 and report["inputs of K admissible"].margin == -0.25


def test_rational_bound_charges_the_residual():
    # Without multipliers all of H (A+BK) x is residual: |x| <= 1, up to the LPs' margin, bounds it.
    data = np.array([[0.5, 0.25], [0.0, -0.25]]), np.zeros((2, 1)), np.zeros((1, 2))
    body = _Rows(np.vstack([np.eye(2), -np.eye(2)]), np.ones(4))
    factor = _exact_factor(np.zeros((4, 4)), body, _Loop(*data, np.zeros(2), None))
    assert Fraction(3, 4) <= factor <= Fraction(3, 4) * (1 + Fraction(1, 10**5))


def test_invariance_of_a_set_without_bound():
    """|x_2| ≤ 1 with x_2+ = 0.69 x_2, x_1 free: kept, with the factor in rationals, not a crash."""
    system = LinearSystem([[0.3, 0.1], [0.0, 0.7]], [[0.0], [0.1]])
    strip = Box([-np.inf, -1], [np.inf, 1])
    report = verify_terminal(
        system, np.eye(2), np.eye(1), None, strip, strip, symmetric(1), K=[[0.0, -0.1]]
    )
    assert report["invariance under K"].holds
    assert report.exact_factor == pytest.approx(0.69, rel=1e-14)
    assert report["states compact"].holds is False


def scalar_report(**changes):
    """x+ = x/2 + u, u = x/4, so that x+ = 3/4 x; Q = R = 1, P = 4 and |x_N| <= 1."""
    arguments = {
        "system": LinearSystem([[0.5]], [[1.0]]), "Q": [[1.0]], "R": [[1.0]],
        "terminal_cost": [[4.0]], "terminal_set": symmetric(1), "states": symmetric(2),
        "inputs": symmetric(1), "K": [[0.25]],
    }  # fmt: skip
    return verify_terminal(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "name", "holds", "margin"),
    [
        ({}, "terminal set within states", True, 1.0),
        ({}, "invariance under K", True, 0.25),
        ({}, "inputs of K admissible", True, 0.75),
        ({}, "Lyapunov inequality", True, 11 / 16),
        ({"states": Box([-INF], [2])}, "states compact", False, -INF),
        ({"states": None}, "states compact", False, -INF),
        ({"inputs": None}, "inputs compact", False, -INF),
        ({"terminal_set": symmetric(2.5)}, "terminal set within states", False, -0.5),
        ({"terminal_set": Ellipsoid([[4.0]], 25.0)}, "terminal set within states", False, -0.5),
        ({"K": [[0.75]]}, "invariance under K", False, -0.25),
        ({"K": [[0.75]]}, "control invariance", True, 3.0),
        ({"K": [[0.75]], "terminal_set": Ellipsoid([[4.0]], 4.0)}, "invariance under K", False,
         1 - 1.25**2),
        ({"K": [[-1.25]]}, "inputs of K admissible", False, -0.25),
        ({"K": [[-1.25]], "terminal_set": Ellipsoid([[4.0]], 4.0)}, "inputs of K admissible",
         False, -0.25),
        ({"terminal_cost": [[2.0]]}, "Lyapunov inequality", False, -3 / 16),
        ({"terminal_cost": [[-1.0]]}, "terminal cost positive semidefinite", False, -1.0),
        ({"Q": [[-1.0]]}, "Q positive semidefinite", False, -1.0),
        ({"R": [[0.0]]}, "R positive definite", False, 0.0),
        ({"Q": [[0.0]]}, "detectability", True, INF),
        ({"Q": [[0.0]], "system": LinearSystem([[1.0]], [[1.0]])}, "detectability", False, 0.0),
        ({"system": LinearSystem([[0.5]], [[1.0]], c=[0.125])}, "origin is an equilibrium",
         False, -0.125),
        ({"system": LinearSystem([[0.5]], [[1.0]], c=[0.5])}, "invariance under K", False, -0.25),
        ({"terminal_set": Box([0], [1])}, "origin inside terminal set", False, 0.0),
        ({"terminal_set": Box([0.25], [1])}, "origin inside terminal set", False, -0.25),
        ({"disturbance": symmetric(0.25)}, "invariance under K", True, 0.0),
        ({"disturbance": symmetric(0.5)}, "invariance under K", False, -0.25),
        ({"disturbance": symmetric(0.5)}, "control invariance", True, 2.0),
        ({"disturbance": symmetric(0.25), "terminal_set": Ellipsoid([[4.0]], 4.0)},
         "invariance under K", True, 0.0),
        ({"disturbance": symmetric(0.5), "terminal_set": Ellipsoid([[4.0]], 4.0)},
         "invariance under K", None, -0.25),
        ({"terminal_set": symmetric(0)}, "invariance under K", True, 0.0),
        # 2x + u in [-2, 2] asks |x| <= 1.5: a quarter of the extent is lost
        ({"system": UNSTABLE, "terminal_set": symmetric(2), "K": [[-1.0]]}, "control invariance",
         False, -0.25),
        ({"system": UNSTABLE, "terminal_set": None, "K": [[-1.0]]}, "control invariance", False,
         -0.25),
        ({"system": LinearSystem([[1.0]], [[1.0]]), "terminal_set": None, "K": [[-1.0]]},
         "control invariance", True, 0.5),
        ({"states": None, "inputs": None, "terminal_set": None}, "control invariance", True, INF),
    ],
)  # fmt: skip
def test_each_hypothesis(changes, name, holds, margin):
    report = scalar_report(**changes)
    check = report[name]
    assert check.holds is holds
    assert check.margin == pytest.approx(margin, abs=1e-12)
    if not holds:
        verdicts = {1: report.recursive_feasibility, 3: report.stability}
        assert not any(verdicts[number] for number in check.theorems)
        assert f"{'NO' if holds is False else '?'}  {name}" in str(report)


def test_terminal_report_without_a_law():
    report = scalar_report(K=None, terminal_cost=None)
    assert report.stability is True
    report = scalar_report(K=None, terminal_cost=None, Q=[[-1.0]])
    assert report["invariance under K"].holds is None and report.K is None
    assert report["control invariance"].holds is True and report.recursive_feasibility is True
    assert report.stability is False and "lqr has no answer" in str(report)
    # the law that is given is the one checked, also where lqr supplies the cost
    assert scalar_report(terminal_cost=None).K == [[0.25]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Q": [[1.0, 0.0]]}, "Q: shape"),
        ({"K": [[1.0, 0.0]]}, "K: shape"),
        ({"terminal_set": 1.0}, "terminal_set: float is no convex set"),
        ({"terminal_set": symmetric(1, 1)}, "terminal_set: has dimension 2"),
        ({"states": Box([1], [0])}, "states: is empty"),
    ],
)
def test_terminal_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        scalar_report(**changes)
    with pytest.raises(ValueError, match="is no check"):
        scalar_report()["nonsense"]
