"""Systems, sets, LQR and invariant sets, against closed forms and exact rational results."""

import itertools
import math
from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy

from jaxmpc import Box, LinearSystem, Polytope, lqr, maximal_invariant_set
from jaxmpc.sets import lp
from jaxmpc.sets.geometry import irredundant as _irredundant
from jaxmpc.systems import LQR

INF = np.inf
# A robot joint (inertia 0.05, 10 ms) and the double integrator of MPT3's test suite, with
# O_inf of their LQR from an exact rational recursion.
JOINT = LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
JOINT_LQR = (JOINT, np.diag([50.0, 1.0]), np.array([[0.1]]))
DOUBLE = LinearSystem([[1, 1], [0, 1]], [[1], [0.5]], dt=1.0)
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
# The maximal control-invariant set of DOUBLE, exact; half of it, the rest is its mirror image.
C_INF_HALF = [
    [-5, -1], [-9 / 2, -3 / 2], [-7 / 2, -2], [-2, -5 / 2], [0, -3], [5 / 2, -7 / 2], [5, -47 / 12],
]  # fmt: skip
C_INF = np.array(C_INF_HALF + [[-x, -y] for x, y in C_INF_HALF])


def sorted_rows(points):
    points = np.round(np.asarray(points, dtype=float), 9) + 0.0
    return points[np.lexsort(points.T)]


def assert_same_points(left, right, atol=1e-9):
    assert np.shape(left) == np.shape(right)
    np.testing.assert_allclose(sorted_rows(left), sorted_rows(right), atol=atol)


def cube(n, half=1.0):
    return Polytope(np.vstack([np.eye(n), -np.eye(n)]), np.full(2 * n, half))


# --- LinearSystem -----------------------------------------------------------------------


def test_system_takes_lists_and_resolves_labels():
    system = LinearSystem([[1, 0.1], [0, 1]], [[0], [1]], dt=0.1)
    system.validate()
    assert (system.n, system.m, system.dt, system.c) == (2, 1, 0.1, None)
    assert system.state_labels == ("x1", "x2") and system.input_labels == ("u1",)
    named = replace(
        system,
        state_names=("q", "dq"),
        state_units=("rad", ""),
        input_names=("torque",),
        input_units=("N m",),
    )
    named.validate()
    assert named.state_labels == ("q [rad]", "dq") and named.input_labels == ("torque [N m]",)
    assert replace(system, state_units=("m", "m/s")).state_labels == ("x1 [m]", "x2 [m/s]")


def test_objects_are_pytrees_with_any_leaves():
    axes = LinearSystem(A=0, B=None, c=object(), dt=0.1)
    assert jax.tree.map(lambda leaf: leaf, axes).dt == 0.1
    for instance in (JOINT, Box([0.0], [1.0]), cube(2), LQR(K=np.eye(1), P=np.eye(1))):
        leaves, tree = jax.tree.flatten(instance)
        assert type(jax.tree.unflatten(tree, [object()] * len(leaves))) is type(instance)
    batch = replace(JOINT, A=np.stack([JOINT.A, 2 * JOINT.A]))
    step = jax.jit(jax.vmap(lambda s: s.A @ jnp.ones(s.n), in_axes=(replace(JOINT, A=0, B=None),)))
    assert step(batch).shape == (2, 2)
    jax.jit(lambda s: s.validate() or s.A)(JOINT)  # shapes are checked while tracing
    assert jax.jit(lambda s: s.validate() or jnp.asarray(s.A))(DOUBLE).shape == (2, 2)
    with pytest.raises(ValueError, match="B: shape"):
        jax.jit(lambda s: s.validate())(replace(JOINT, B=np.ones((3, 1))))


def test_from_continuous_double_integrator_and_drift():
    h = 0.3
    system = LinearSystem.from_continuous(
        [[0, 1], [0, 0]], [[0], [2]], h, c=[0, -9.81], state_names=["q", "dq"]
    )
    np.testing.assert_allclose(system.A, [[1, h], [0, 1]], atol=1e-15)
    np.testing.assert_allclose(system.B, [[h**2], [2 * h]], atol=1e-15)
    np.testing.assert_allclose(system.c, [-9.81 * h**2 / 2, -9.81 * h], atol=1e-15)
    assert system.dt == h and system.state_names == ("q", "dq")
    a, b = -3.0, 2.0
    scalar = LinearSystem.from_continuous([[a]], [[b]], h)
    np.testing.assert_allclose(scalar.A, [[math.exp(a * h)]], rtol=1e-15)
    np.testing.assert_allclose(scalar.B, [[b * math.expm1(a * h) / a]], rtol=1e-14)
    assert scalar.c is None


def test_from_object_reads_scipy():
    A, B, C, D = [[0.0, 1], [-2, -3]], [[0.0], [1]], [[1.0, 0]], [[0.0]]
    continuous = scipy.signal.StateSpace(A, B, C, D)
    expected = continuous.to_discrete(0.1)
    system = LinearSystem.from_object(continuous, dt=0.1)
    np.testing.assert_allclose(system.A, expected.A, atol=1e-14)
    np.testing.assert_allclose(system.B, expected.B, atol=1e-14)
    assert system.dt == 0.1
    with pytest.raises(ValueError, match="dt: is missing and obj is continuous"):
        LinearSystem.from_object(continuous)
    assert LinearSystem.from_object(expected).dt == 0.1
    assert LinearSystem.from_object(scipy.signal.StateSpace(A, B, C, D, dt=True)).dt is None
    with pytest.raises(ValueError, match=r"obj: has no \.A"):
        LinearSystem.from_object(scipy.signal.TransferFunction([1], [1, 1]), dt=0.1)


def test_from_object_reads_python_control_and_itself():
    A, B = np.array([[0.0, 1], [0, 0]]), np.array([[0.0], [1]])
    labels = {"state_labels": ["q", "dq"], "input_labels": ["F"], "output_labels": ["q"]}
    fake = lambda dt: SimpleNamespace(A=A, B=B, dt=dt, **labels)
    sampled = LinearSystem.from_object(fake(0), dt=0.5)
    np.testing.assert_allclose(sampled.B, [[0.125], [0.5]], atol=1e-15)
    assert sampled.state_labels == ("q", "dq") and sampled.input_labels == ("F",)
    assert LinearSystem.from_object(fake(True)).dt is None
    assert LinearSystem.from_object(fake(True), dt=0.2).dt == 0.2
    assert LinearSystem.from_object(fake(0.2), dt=0.2).dt == 0.2
    for dt, given, message in [
        (0, None, "dt: is missing"),
        (0, -1.0, "dt: -1.0 is not a positive"),
        (0.2, 0.1, "differs from obj.dt"),
        (None, 0.1, "does not say whether"),
        (-0.1, None, "dt: -0.1 is not"),
    ]:
        with pytest.raises(ValueError, match=message):
            LinearSystem.from_object(fake(dt), dt=given)
    drifting = replace(JOINT, c=np.ones(2), dt=None)
    again = LinearSystem.from_object(drifting, dt=0.01)
    assert again.dt == 0.01 and again.c is drifting.c
    with pytest.raises(ValueError, match="dt: 0 is not a positive"):
        LinearSystem.from_object(replace(JOINT, dt=0), dt=0.01)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"A": np.ones((2, 3))}, "A: shape"),
        ({"A": np.ones(2)}, "A: shape"),
        ({"A": [[1, 2], [3]]}, "A: .* is not an array"),
        ({"A": [["a", "b"], ["c", "d"]]}, "A: entries of type <U1 where real"),
        ({"A": [[1, np.nan], [0, 1]]}, "A: holds NaN"),
        ({"A": 1j * np.eye(2)}, "A: entries of type complex128 where real"),
        ({"B": np.ones((3, 1))}, "B: shape"),
        ({"B": np.ones(3)}, "B: shape"),
        ({"B": [[INF], [0]]}, "B: holds"),
        ({"c": np.ones((2, 1))}, "c: shape"),
        ({"c": [0, np.nan]}, "c: holds"),
        ({"dt": 0.0}, "dt: 0.0"),
        ({"dt": True}, "dt: True"),
        ({"dt": "1"}, "dt: '1'"),
        ({"dt": INF}, "dt: inf"),
        ({"state_names": ("q",)}, "state_names: 1 entries where 2"),
        ({"input_units": ("N", "m")}, "input_units: 2 entries where 1"),
        ({"input_names": ["F"]}, "input_names: .* tuple"),
    ],
)
def test_system_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        replace(JOINT, **changes).validate()


def test_from_continuous_errors():
    with pytest.raises(ValueError, match="dt: 0 is not a positive"):
        LinearSystem.from_continuous([[0]], [[1]], 0)
    with pytest.raises(ValueError, match="B: shape"):
        LinearSystem.from_continuous([[0]], [[1], [1]], 0.1)


# --- Box --------------------------------------------------------------------------------


def test_box():
    box = Box([-1, -2], [3, INF])
    box.validate("states", 2)
    assert box.dimension == 2
    points = np.array([[0, 0], [3, 1e9], [3.1, 0], [0, -2.1], [np.nan, 0]])
    np.testing.assert_array_equal(jax.vmap(box.contains)(points), [1, 1, 0, 0, 0])
    assert box.contains(np.array([3.05, 0]), tolerance=0.1)
    assert box.support([1, -1]) == 5 and box.support([-2, 0]) == 2
    assert box.support([0, 1]) == INF and box.support([1, 0]) == 3
    np.testing.assert_array_equal(jax.grad(box.support)(jnp.array([1.0, 0.0])), [3, 0])
    H, lower, upper = box.rows()
    np.testing.assert_array_equal(H, np.eye(2))
    np.testing.assert_array_equal(lower, [-1, -2])
    np.testing.assert_array_equal(upper, [3, INF])
    polytope = box.to_polytope()
    np.testing.assert_array_equal(polytope.H, [[1, 0], [-1, 0], [0, -1]])
    np.testing.assert_array_equal(polytope.h, [3, 1, 2])
    finite = Box([-1, 0], [1, 3])
    np.testing.assert_array_equal(finite.vertices(), [[-1, 0], [1, 0], [1, 3], [-1, 3]])
    assert finite.volume() == 6
    assert Box(np.zeros(4), np.ones(4)).vertices().shape == (16, 4)


def test_sets_pass_under_jit_and_grad():
    inside = jax.jit(lambda s, x: s.contains(x))
    assert inside(Box([0.0], [1.0]), jnp.array([0.5]))
    assert not inside(cube(2), jnp.array([0.5, 1.5]))
    jax.jit(lambda s: s.validate("s", 2) or s.rows())(cube(2))
    boxes = Box(np.zeros((3, 2)), np.arange(6.0).reshape(3, 2))
    np.testing.assert_array_equal(jax.vmap(lambda b: b.support(jnp.ones(2)))(boxes), [1, 5, 9])
    with jax.enable_x64(True):
        assert Box([0.0], [1.0]).contains(np.array([1 + 1e-12])) == jnp.array(False)


@pytest.mark.parametrize(
    ("box", "message"),
    [
        (Box([0, 0], [1, -1]), r"states: is empty: lower\[1\] = 0, upper\[1\] = -1"),
        (Box([INF, 0], [INF, 1]), "states: is empty"),
        (Box([-1, np.nan], [1, 1]), "states.lower: holds NaN"),
        (Box([-1, 0], [1]), "states.upper: shape"),
        (Box(-1, 1), "states: has dimension 1 where 2"),
        (Box([-1], [1]), "states: has dimension 1 where 2"),
        (Box(None, [1]), "states.lower: None"),
    ],
)
def test_box_errors(box, message):
    with pytest.raises(ValueError, match=message):
        box.validate("states", 2)


def test_box_errors_in_use():
    with pytest.raises(ValueError, match="Box: is unbounded"):
        Box([0], [INF]).volume()
    with pytest.raises(ValueError, match="Box: is unbounded"):
        Box([0], [INF]).vertices()
    with pytest.raises(ValueError, match="x: shape"):
        Box(-1, 1).contains([0.0, 0.0])
    with pytest.raises(ValueError, match=r"x: shape \(3, 2\).*jax.vmap"):
        Box([0, 0], [1, 1]).contains(np.zeros((3, 2)))
    with pytest.raises(ValueError, match="d: shape"):
        Box([0, 0], [1, 1]).support([1.0])
    with pytest.raises(ValueError, match="traced"):
        jax.jit(lambda b: b.volume())(Box([0.0], [1.0]))


# --- Polytope ---------------------------------------------------------------------------


def test_polytope_basics():
    triangle = Polytope([[-1, 0], [0, -2], [1, 1], [1, 0]], [0, 0, 1, INF])
    triangle.validate("terminal_set", 2)
    assert triangle.dimension == 2
    points = np.array([[0.2, 0.2], [0.6, 0.6], [-0.1, 0.2], [np.nan, 0]])
    np.testing.assert_array_equal(jax.vmap(triangle.contains)(points), [1, 0, 0, 0])
    assert triangle.contains([0.6, 0.6], tolerance=0.21)
    np.testing.assert_allclose(triangle.vertices(), [[0, 0], [1, 0], [0, 1]], atol=1e-14)
    assert triangle.volume() == pytest.approx(0.5, abs=1e-14)
    centre, radius = triangle.chebyshev()
    assert radius == pytest.approx(1 / (2 + math.sqrt(2)), abs=1e-14)
    np.testing.assert_allclose(centre, [radius, radius], atol=1e-14)
    assert triangle.support([1, 3]) == pytest.approx(3, abs=1e-14)
    assert Polytope([[1, 0]], [1]).support([0, 1]) == INF
    assert Polytope([[1, 0]], [1]).support([2, 0]) == pytest.approx(2)
    everything = Box([-INF, -INF], [INF, INF]).to_polytope()
    everything.validate("states", 2)
    assert everything.support([0, 1]) == INF and everything.contains([1e9, 0])
    H, lower, upper = triangle.rows()
    assert np.all(lower == -INF) and H.shape == (4, 2)
    np.testing.assert_array_equal(upper, triangle.h)


def test_polytope_of_exact_vertices():
    polytope = Polytope.from_points(np.vstack([C_INF, [[0, 0], [1, 1]]]))
    assert polytope.H.shape == (14, 2)
    np.testing.assert_allclose(np.linalg.norm(polytope.H, axis=1), 1, atol=1e-15)
    assert polytope.volume() == pytest.approx(1375 / 24, rel=1e-13)
    vertices = polytope.vertices()
    start = int(np.argmin(np.linalg.norm(vertices - C_INF[0], axis=1)))
    np.testing.assert_allclose(np.roll(vertices, -start, axis=0), C_INF, atol=1e-12)
    for d in np.random.default_rng(0).standard_normal((5, 2)):
        assert polytope.support(d) == pytest.approx((C_INF @ d).max(), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_round_trips(n):
    rng = np.random.default_rng(n)
    simplex = np.vstack([np.zeros(n), np.eye(n)])
    assert Polytope.from_points(simplex).volume() == pytest.approx(1 / math.factorial(n))
    corners = np.array(list(itertools.product([-1.0, 1.0], repeat=n)))
    box, cross = Polytope.from_points(corners), Polytope(corners, np.ones(2**n))
    assert box.H.shape == (2 * n, n)
    assert_same_points(box.vertices(), corners)
    assert box.volume() == pytest.approx(2**n, rel=1e-13)
    assert_same_points(cross.vertices(), np.vstack([np.eye(n), -np.eye(n)]))
    assert cross.volume() == pytest.approx(2**n / math.factorial(n), rel=1e-13)
    points = rng.standard_normal((30, n))
    hull = Polytope.from_points(points)
    assert (points @ hull.H.T - hull.h).max() <= 1e-12
    vertices = hull.vertices()
    again = Polytope.from_points(vertices)
    assert_same_points(np.c_[again.H, again.h], np.c_[hull.H, hull.h])
    # An affine image: vertices move along, the volume scales by the determinant.
    T, shift = rng.standard_normal((n, n)) + 3 * np.eye(n), rng.standard_normal(n)
    H = hull.H @ np.linalg.inv(T)
    image = Polytope(H, hull.h + H @ shift)
    assert_same_points(image.vertices(), vertices @ T.T + shift)
    assert image.volume() == pytest.approx(hull.volume() * abs(np.linalg.det(T)), rel=1e-11)


def test_scales_and_units_do_not_matter():
    lower, upper = np.array([-1e-4, -2e3, 1000.0]), np.array([2e-4, 3e3, 1001.0])
    box = Box(lower, upper)
    polytope = box.to_polytope()
    assert polytope.volume() == pytest.approx(1.5, rel=1e-11)
    scale = upper - lower
    assert_same_points((polytope.vertices() - lower) / scale, (box.vertices() - lower) / scale)
    touching = Polytope([[1, 0], [-1, 0], [0, 1], [0, -1], [-1, -1]], [1, 1e-17, 1e3, 1e-17, 0])
    assert touching.volume() == pytest.approx(1e3, rel=1e-12)
    tiny = cube(2, 1e-8)
    assert tiny.volume() == pytest.approx(4e-16, rel=1e-12)
    assert tiny.support([1, 1]) == pytest.approx(2e-8, rel=1e-12)


def test_intersect():
    square = cube(2)
    shifted = square.intersect(Box([0, -INF], [5, 0.5]))
    assert shifted.H.shape == (7, 2)
    assert shifted.volume() == pytest.approx(1.5, abs=1e-14)
    assert shifted.reduce().H.shape == (4, 2)
    diamond = Polytope(np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]), 1.5 * np.ones(4))
    assert square.intersect(diamond).volume() == pytest.approx(4 - 4 * 0.125, abs=1e-13)
    with pytest.raises(ValueError, match="other: has dimension 3 where 2"):
        square.intersect(cube(3))
    with pytest.raises(ValueError, match="other: list"):
        square.intersect([1, 2])


def test_reduce_thirty_thousand_tangents_of_a_circle():
    rng = np.random.default_rng(0)
    angles = rng.uniform(0, 2 * np.pi, 30_000)
    H = np.column_stack([np.cos(angles), np.sin(angles)])
    gaps = np.diff(np.sort(angles), append=angles.min() + 2 * np.pi)
    area = np.tan(gaps / 2).sum()  # each gap adds two triangles of height 1
    reduced = Polytope(3 * H, 3 * np.ones(len(H))).reduce()
    assert 29_900 <= len(reduced.H) <= 30_000  # neighbours closer than 1e-6 rad merge
    np.testing.assert_allclose(np.linalg.norm(reduced.H, axis=1), 1, atol=1e-14)
    vertices = reduced.vertices()
    x, y = vertices.T
    assert (x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2 == pytest.approx(area, abs=1e-10)
    assert (H[::30] @ vertices.T).max() <= 1 + 1e-11


def test_reduce_near_duplicates():
    rng = np.random.default_rng(1)
    angles = np.arange(5000) * 2 * np.pi / 5000
    H = np.column_stack([np.cos(angles), np.sin(angles)])
    copies = [H + 1e-14 * rng.standard_normal(H.shape) for _ in range(3)]
    reduced = Polytope(np.vstack(copies), np.ones(3 * len(H))).reduce()
    assert len(reduced.H) == 5000
    assert reduced.volume() == pytest.approx(5000 * np.tan(np.pi / 5000), abs=1e-12)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 7])
def test_reduce_drops_copies_and_rows_that_touch(n):
    rng = np.random.default_rng(n)
    touching = rng.standard_normal((20, n))  # rows a'x <= |a|_1 touch the cube in a corner
    outside = rng.standard_normal((20, n))
    H = np.vstack([touching, 5 * np.eye(n), -np.eye(n), outside, np.zeros((1, n)), np.eye(n)])
    h = np.abs(H).sum(axis=1) + np.r_[np.zeros(20 + 2 * n), np.ones(21), 1e-14 * np.ones(n)]
    reduced = Polytope(H, h).reduce()
    assert_same_points(np.c_[reduced.H, reduced.h], np.c_[cube(n).H, cube(n).h])


@pytest.mark.parametrize("n", [2, 3, 5])
def test_duality_and_linear_programs_agree(n):
    H = np.random.default_rng(n).standard_normal((40, n))
    np.testing.assert_array_equal(
        Polytope(H, np.ones(40)).reduce().H.shape[0], len(_irredundant(H))
    )


@pytest.mark.parametrize(
    ("polytope", "message"),
    [
        (Polytope([[1, 0], [-1, 0]], [0, -1]), "terminal_set: is empty"),
        (Polytope([[0, 0]], [-1]), "terminal_set: is empty"),
        (Polytope([[1, 0]], [-INF]), "terminal_set: is empty"),
        (Polytope([[1, np.nan]], [1]), "terminal_set.H: holds"),
        (Polytope([[1, 0]], [np.nan]), "terminal_set.h: holds NaN"),
        (Polytope([[1, 0]], [1, 2]), "terminal_set.h: shape"),
        (Polytope([1, 0], [1]), "terminal_set.H: shape"),
        (Polytope([[1, 0, 0]], [1]), "terminal_set: has dimension 3 where 2"),
    ],
)
def test_polytope_errors(polytope, message):
    with pytest.raises(ValueError, match=message):
        polytope.validate("terminal_set", 2)


@pytest.mark.parametrize("method", ["vertices", "volume", "reduce"])
@pytest.mark.parametrize(
    ("H", "h", "message"),
    [
        ([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 1, 1], "Polytope: is flat"),
        ([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -2, 1, 1], "Polytope: is empty"),
        ([[1, 0], [-1, 0]], [1, 1], "Polytope: is unbounded"),
        ([[1, 0], [-1, 0], [0, 1]], [1, 1, 1], "Polytope: is unbounded"),
        ([[1, 0]], [1], "Polytope: is unbounded"),
        ([[1]], [1], "Polytope: is unbounded"),
        ([[1], [-1]], [1, -1], "Polytope: is flat"),
        ([[1], [-1]], [1, -1.1], "Polytope: is empty"),
        (np.vstack([np.eye(8), -np.eye(8)[1:]]), np.ones(15), "Polytope: is unbounded"),
    ],
)
def test_polytope_degenerate(method, H, h, message):
    with pytest.raises(ValueError, match=message):
        getattr(Polytope(H, h), method)()


def test_polytope_errors_in_use():
    empty, flat = Polytope([[1], [-1]], [0, -1]), Polytope([[1], [-1]], [1, -1])
    flat.validate("set")
    assert flat.chebyshev()[1] == pytest.approx(0, abs=1e-12)
    for call in (empty.chebyshev, lambda: empty.support([1.0])):
        with pytest.raises(ValueError, match="Polytope: is empty"):
            call()
    with pytest.raises(ValueError, match="arbitrarily large"):
        Polytope([[1, 0]], [1]).chebyshev()
    with pytest.raises(ValueError, match="x: shape"):
        cube(2).contains(np.zeros(3))
    with pytest.raises(ValueError, match="d: holds NaN"):
        cube(2).support([np.nan, 0])
    with pytest.raises(ValueError, match="Polytope.h: shape"):
        Polytope(np.eye(2), [1]).reduce()
    for points, message in [
        ([[0, 0], [1, 1], [2, 2]], "points: lie in a hyperplane"),
        ([[1], [1]], "points: lie in a hyperplane"),
        ([1, 2], "points: shape"),
        ([[np.nan], [1]], "points: holds NaN"),
    ]:
        with pytest.raises(ValueError, match=message):
            Polytope.from_points(points)


# --- LQR --------------------------------------------------------------------------------


def riccati_residual(system, Q, R, P):
    A, B = np.asarray(system.A, float), np.asarray(system.B, float)
    S = R + B.T @ P @ B
    return A.T @ P @ A - A.T @ P @ B @ np.linalg.solve(S, B.T @ P @ A) + Q - P


def test_lqr_of_the_joint():
    law = lqr(*JOINT_LQR)
    np.testing.assert_allclose(law.K, [[-15.838825731024865, -2.649704251932495]], rtol=1e-12)
    P = [[836.4585534716418, 15.783998400228846], [15.783998400228846, 2.4826921099685366]]
    np.testing.assert_allclose(law.P, P, rtol=1e-12)
    eigenvalues = np.sort(np.linalg.eigvals(JOINT.A + JOINT.B @ law.K))
    np.testing.assert_allclose(eigenvalues, [0.5387347079226628, 0.9313244416908382], rtol=1e-11)


def test_lqr_scalar_closed_form():
    # p = q + a²p - a²b²p²/(r + b²p), a quadratic in p.
    a, b, q, r = 2.0, 0.5, 3.0, 0.7
    s = r * (1 - a**2) - q * b**2
    p = (-s + math.sqrt(s**2 + 4 * b**2 * q * r)) / (2 * b**2)
    law = lqr(LinearSystem([[a]], [[b]]), [[q]], [[r]])
    assert law.P[0, 0] == pytest.approx(p, rel=1e-14)
    assert law.K[0, 0] == pytest.approx(-a * b * p / (r + b**2 * p), rel=1e-14)


@pytest.mark.parametrize("seed", range(5))
def test_lqr_satisfies_the_riccati_equation(seed):
    rng = np.random.default_rng(seed)
    A, B = rng.standard_normal((6, 6)), rng.standard_normal((6, 2))
    Q, R = np.diag(rng.random(6)), np.eye(2)
    law = lqr(LinearSystem(A, B, c=np.ones(6)), Q, R)
    assert np.abs(riccati_residual(LinearSystem(A, B), Q, R, law.P)).max() <= 1e-12 * law.P.max()
    K = -np.linalg.solve(R + B.T @ law.P @ B, B.T @ law.P @ A)
    np.testing.assert_allclose(law.K, K, rtol=1e-12)
    np.testing.assert_array_equal(law.P, law.P.T)
    # x'Px is the cost of the law: sum it up.
    x = x0 = rng.standard_normal(6)
    cost = 0.0
    for _ in range(3000):
        u = law.K @ x
        cost, x = cost + x @ Q @ x + u @ R @ u, A @ x + B @ u
    assert cost == pytest.approx(x0 @ law.P @ x0, rel=1e-10)


TURN = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
TILT = np.array([[1.0, 0.3, -0.7], [0.2, -1.1, 0.5], [0.9, 0.4, 1.3]])
JORDAN = TILT @ [[1, 1, 0], [0, 1, 0], [0, 0, 0.5]] @ np.linalg.inv(TILT)


@pytest.mark.parametrize(
    ("A", "B", "Q", "R", "message"),
    [
        (JOINT.A, JOINT.B, -np.eye(2), np.eye(1), "Q: is not positive semidefinite"),
        (JOINT.A, JOINT.B, [[1, 1], [0, 1]], np.eye(1), "Q: is not symmetric"),
        (JOINT.A, JOINT.B, np.eye(3), np.eye(1), "Q: shape"),
        (JOINT.A, JOINT.B, np.eye(2), [[0]], "R: is not positive definite"),
        (JOINT.A, JOINT.B, np.eye(2), np.eye(2), "R: shape"),
        (np.diag([2, 0.5]), [[0], [1]], np.eye(2), np.eye(1), "B: not stab.*eigenvalue 2"),
        (TURN, [[0], [0]], np.eye(2), np.eye(1), r"eigenvalue 0.955336[+-]0.29552j"),
        (JORDAN, TILT @ [[1], [0], [1]], np.eye(3), np.eye(1), "B: not stab.*eigenvalue 1"),
        (np.diag([2, 0.5]), [[1], [1]], np.diag([0, 1]), np.eye(1), "Q: not detect.*value 2"),
        (np.eye(2), np.eye(2), np.diag([0, 1]), np.eye(2), "Q: not detectable.*eigenvalue 1"),
        (np.ones((2, 3)), JOINT.B, np.eye(2), np.eye(1), "A: shape"),
    ],
)
def test_lqr_errors(A, B, Q, R, message):
    with pytest.raises(ValueError, match=message):
        lqr(LinearSystem(A, B), Q, R)


def test_lqr_leaves_decaying_modes_alone():
    law = lqr(LinearSystem(np.diag([0.5, 1.2]), [[0], [1]]), np.diag([0, 1]), np.eye(1))
    assert law.K[0, 0] == 0 and law.P[0, 0] == 0


# --- Maximal invariant sets -------------------------------------------------------------


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


def test_a_delay_of_the_input_is_no_keyword_and_its_cure_is_exact():
    A, B, dt, delay = np.array([[0, 1], [-2, -0.3]]), np.array([[0.0], [1]]), 0.1, 0.03
    with pytest.raises(ValueError, match=r"delay: is no argument .*B − B0"):
        LinearSystem.from_continuous(A, B, dt, delay=delay)
    with pytest.raises(ValueError, match="state_name: is no argument .* Did you mean state_names"):
        LinearSystem.from_continuous(A, B, dt, state_name=("q", "dq"))
    whole = LinearSystem.from_continuous(A, B, dt)
    rest = LinearSystem.from_continuous(A, B, dt - delay)
    first = LinearSystem.from_continuous(A, B, delay)
    system = LinearSystem(
        np.block([[whole.A, whole.B - rest.B], [np.zeros((1, 3))]]), np.vstack([rest.B, np.eye(1)])
    )
    x, before, u = np.array([0.3, -1.0]), np.array([0.7]), np.array([-0.4])
    between = first.A @ x + first.B @ before  # the old input for the delay, then the new one
    after = system.A @ np.append(x, before) + system.B @ u
    assert after == pytest.approx(np.append(rest.A @ between + rest.B @ u, u), abs=1e-15)
