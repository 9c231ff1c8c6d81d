"""Maximal invariant sets and ellipsoids of a law, against closed forms and exact results."""

from dataclasses import replace

import numpy as np
import pytest
from plants import DOUBLE, JOINT, JOINT_LQR
from polytopes import assert_same_points, interval
from problems import symmetric

from jaxmpc import Box, LinearSystem, Polytope, lqr, maximal_invariant_set
from jaxmpc.sets.invariant import invariant_ellipsoid

INF = np.inf


# Vertices of O_inf of JOINT_LQR, from an exact rational recursion.
JOINT_O_INF = [
    [-0.3687944010552624, 1.4496977336585621],
    [0.20831143418682585, -2.0],
    [0.33458342138865665, -2.0],
    [0.35332070151663836, -1.8737280127981693],
    [0.36835828710899876, -1.5037585592360438],
    [0.3687944010552624, -1.4496977336585621],
    [-0.20831143418682585, 2.0],
    [-0.33458342138865665, 2.0],
    [-0.35332070151663836, 1.8737280127981693],
    [-0.36835828710899876, 1.5037585592360438],
]


DOUBLE_O_INF_ROWS = [  # published in MPT3, test_ltisystem_LQRSet_01: rows of H x <= 1
    [0.135017323795083, -0.280916176928742],
    [-0.135017323795083, 0.280916176928742],
    [-0.00533643109831478, -0.529404762529574],
    [0.00533643109831478, 0.529404762529574],
    [-0.519754007452359, -0.939957536022068],
    [0.519754007452359, 0.939957536022068],
]


def test_invariant_set_of_the_joint():
    law = lqr(*JOINT_LQR)
    states, inputs = Box([-1.5, -2], [1.5, 2]), Box([-2], [2])
    invariant = maximal_invariant_set(JOINT, law.K, states, inputs)
    assert invariant.index == 3 and invariant.H.shape == (10, 2)
    assert invariant.volume() == pytest.approx(0.9473310116683459, abs=1e-12)
    assert_same_points(invariant.vertices(), JOINT_O_INF)
    alone = maximal_invariant_set(
        JOINT, law.K, states.to_polytope(), inputs.to_polytope(), max_iterations=3
    )
    assert_same_points(np.c_[alone.H, alone.h], np.c_[invariant.H, invariant.h])
    with pytest.raises(ValueError, match="max_iterations: 2 steps"):
        maximal_invariant_set(JOINT, law.K, states, inputs, max_iterations=2)


def test_invariant_set_of_the_published_double_integrator():
    K = lqr(DOUBLE, np.eye(2), np.eye(1)).K
    states, inputs = Box([-5, -5], [5, 5]), Box([-1], [1])
    invariant = maximal_invariant_set(DOUBLE, K, states, inputs)
    assert invariant.index == 2
    assert invariant.volume() == pytest.approx(13.74039794963338, rel=1e-12)
    assert_same_points(invariant.H / invariant.h[:, None], DOUBLE_O_INF_ROWS)


def test_invariant_set_is_invariant_and_maximal():
    rng = np.random.default_rng(0)
    system = LinearSystem(rng.standard_normal((3, 3)), rng.standard_normal((3, 2)), c=np.zeros(3))
    K = lqr(system, np.eye(3), np.eye(2)).K
    closed = system.A + system.B @ K
    invariant = maximal_invariant_set(system, K, Box([-1] * 3, [2] * 3), Box([-1, -2], [1, 1]))

    def violation(x):  # worst over the constraints and over time
        worst = -INF
        for _ in range(100):
            u = K @ x.T
            worst = np.maximum(worst, np.max([*(x.T - 2), *(-1 - x.T)], axis=0))
            worst = np.maximum(worst, np.max([u[0] - 1, u[1] - 1, -1 - u[0], -2 - u[1]], axis=0))
            x = x @ closed.T
        return worst

    vertices = invariant.vertices()
    assert (vertices @ closed.T @ invariant.H.T - invariant.h).max() <= 1e-12
    assert violation(vertices).max() <= 1e-12
    points = rng.uniform(-1, 2, (2000, 3))
    inside = (points @ invariant.H.T <= invariant.h).all(axis=1)
    np.testing.assert_array_equal(inside, violation(points) <= 0)
    assert 0 < inside.sum() < 2000


def test_invariant_sets_of_product_and_closed_forms():
    K = lqr(*JOINT_LQR).K
    arm = LinearSystem(np.kron(np.eye(4), JOINT.A), np.kron(np.eye(4), JOINT.B))
    states, inputs = Box([-1.5, -2] * 4, [1.5, 2] * 4), Box([-2] * 4, [2] * 4)
    product = maximal_invariant_set(arm, np.kron(np.eye(4), K), states, inputs)
    assert product.index == 3 and product.H.shape == (40, 8)
    # A shift register keeps its box at once, though its rows touch it for ever.
    shift = LinearSystem(np.diag([1.0, 1.0], 1), np.ones((3, 1)))
    kept = maximal_invariant_set(shift, np.zeros((1, 3)), Box([-1] * 3, [1] * 3), None)
    assert kept.index == 0 and kept.volume() == pytest.approx(8)
    # Constraints need not bound the set by themselves, if the motion does:
    # |x1| <= 1 and |x1/2 + x2| <= 1 after a step, |x1/4 + x2| <= 1 after two.
    chain = LinearSystem([[0.5, 1], [0, 0.5]], [[1], [0]])
    half = maximal_invariant_set(chain, np.zeros((1, 2)), Box([-1, -INF], [1, INF]), None)
    assert half.index == 2
    rows = np.array([[1, 0], [0.5, 1], [0.25, 1]])
    assert_same_points(half.H / half.h[:, None], np.vstack([rows, -rows]))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": [[15.8, 2.6]]}, "K: A . BK has spectral radius .* other sign"),
        ({"K": [[0, 0]]}, "K: A . BK has spectral radius 1,"),
        ({"K": [[1.0]]}, "K: shape"),
        ({"K": [[np.nan, 0]]}, "K: holds NaN"),
        ({"system": replace(JOINT, c=[0, 0.1])}, "system.c: is not zero"),
        ({"states": Box([0, -2], [1.5, 2])}, "states: the origin is not in its interior"),
        ({"inputs": Box([0.1], [2])}, "inputs: the origin is not in its interior"),
        ({"states": Box([-1], [1])}, "states: has dimension 1 where 2"),
        ({"inputs": Box([-1, -1], [1, 1])}, "inputs: has dimension 2 where 1"),
        ({"states": Box([2, -1], [1, 1])}, "states: is empty"),
        ({"states": None}, "states: NoneType is no Box or Polytope"),
        ({"inputs": 2.0}, "inputs: float is no Box or Polytope"),
        ({"states": Box([-INF, -INF], [1, INF]), "inputs": None}, "max_iterations|unbounded"),
        ({"states": Box([-INF] * 2, [INF] * 2), "inputs": None}, "unbounded: nothing"),
    ],
)
def test_invariant_set_errors(changes, message):
    arguments = {
        "system": JOINT,
        "K": lqr(*JOINT_LQR).K,
        "states": Box([-1.5, -2], [1.5, 2]),
        "inputs": Box([-2], [2]),
        "max_iterations": 20,
    }
    with pytest.raises(ValueError, match=message):
        maximal_invariant_set(**(arguments | changes))


def test_unbounded_invariant_set():
    decay = LinearSystem(0.5 * np.eye(2), [[1], [0]])
    with pytest.raises(ValueError, match="states: the invariant set is unbounded"):
        maximal_invariant_set(decay, np.zeros((1, 2)), Box([-1, -INF], [1, INF]), None)


def test_robust_invariant_sets_on_the_line():
    no_input = np.zeros((1, 1))
    half = LinearSystem([[-0.5]], [[1.0]])
    limits, w = Box([-1], [3]), symmetric(0.1)
    # -x/2 + w >= -1 asks x <= 1.8; what x <= 3 asks of later steps is weaker
    found = maximal_invariant_set(half, no_input, limits, None, disturbance=w)
    assert interval(found) == pytest.approx((-1, 1.8), abs=1e-13) and found.index == 1
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
