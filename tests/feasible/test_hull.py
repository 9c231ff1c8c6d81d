"""Labels by the polytopes of rays: those of the other stages, with proofs of their own."""

import jax
import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import hull_labels, pipeline, rays
from jaxmpc.feasible.hull_labels import Hull, hull_facets
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.verify.exact import roll_out_exactly
from jaxmpc.verify.stored_problem import Constraints

# Problem, half the size of the mapped box, view.
CASES = {
    "one state": (problems.scalar(horizon=4, terminal=1.0, constrain_initial=False), [1.5], {}),
    "lecture": (problems.lecture(), [1.2, 1.2], {}),
    "joint": (problems.joint(5), [1.7, 2.2], {}),
    "no limits at k = 0": (
        jm.MPC(problems.lecture().system, np.eye(2), np.eye(1), 3, states=jm.Box(-1, 1),
               inputs=jm.Box(-0.25, 0.25), constrain_initial=False), [2.5, 2.5], {}),
    "projection": (problems.hidden_product(3), [1.7, 4.0], {"axes": (0, 1)}),
    "slice": (problems.hidden_product(3), [1.3, 1.3], {"axes": (0, 1), "fixed": np.full(4, 0.05)}),
}  # fmt: skip


def worth_rays(monkeypatch, count):
    """Cast rays for so many points of two coordinates, on any device."""
    for name in ("MANY_POINTS", "MANY_POINTS_ELSEWHERE"):
        monkeypatch.setattr(hull_labels, name, count)


@pytest.fixture
def always(monkeypatch):
    worth_rays(monkeypatch, 0)


def points_of(name, count):
    mpc, ends, view = CASES[name]
    return np.random.default_rng(0).uniform(-1, 1, (count, len(ends))) * ends


@pytest.mark.parametrize("name", CASES)
@pytest.mark.first(1)
def test_labels_and_proofs(name, monkeypatch):
    """Against the labels of the other stages, and the plans in exact arithmetic."""
    mpc, _, view = CASES[name]
    points = points_of(name, 600)
    expected = jm.map_feasible_set(mpc, points, chunk=64, **view).label
    worth_rays(monkeypatch, 0)
    problem = FeasibilityProblem.of(mpc, **view)
    assert Hull.of(problem) is not None
    labels = jm.map_feasible_set(mpc, points, chunk=64, **view).labels
    np.testing.assert_array_equal(labels.label, expected)
    assert set(expected) == {-1, 1}
    inside, outside = labels.label == 1, labels.label == -1
    p = Constraints(problem.plain())
    assert np.all(roll_out_exactly(p, labels.start[inside], labels.plan[inside]) >= 0)
    np.testing.assert_array_equal(labels.start[inside][:, list(problem.view.axes)], points[inside])
    # Half-spaces exclude their point and no feasible one.
    normals, offsets = labels.cut_normal[outside], labels.cut_offset[outside]
    assert np.all(np.sum(normals * points[outside], axis=1) > offsets)
    assert np.all(points[inside] @ normals.T <= offsets)
    assert np.all(np.isnan(labels.plan[outside])) and np.all(np.isnan(labels.cut_offset[inside]))


def test_they_decide_nearly_all(always, monkeypatch):
    """No other stage runs where all points are 1e-6 and more from the boundary."""
    mpc = problems.lecture()
    polytope = jm.feasible_polytope(mpc)
    points = points_of("lecture", 1000)
    distance = (points @ np.asarray(polytope.H).T - polytope.h).max(axis=1)
    run, programs = pipeline._run, []
    monkeypatch.setattr(pipeline, "_run", lambda *a: programs.append(a[0]) or run(*a))
    label = jm.map_feasible_set(mpc, points[np.abs(distance) > 1e-6], chunk=64).label
    np.testing.assert_array_equal(label, np.where(distance < 0, 1, -1)[np.abs(distance) > 1e-6])
    assert set(programs) <= {pipeline.compiled_hull(None), hull_labels.compiled_verdicts(None)}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.first(1)
def test_points_labelled_without_a_roll_out_have_plans(name):
    """At all distances from the boundary, on both sides, and beside the planes between cones:
    whatever is said to be feasible has a plan that keeps all limits, in exact arithmetic."""
    mpc, _, view = CASES[name]
    problem = FeasibilityProblem.of(mpc, **view)
    made = Hull.of(problem)
    random, d = np.random.default_rng(1), problem.dimension
    share = random.dirichlet(np.ones(d), (len(made.M), 40))
    share[:, :10] *= random.choice([0.0, 1e-16, 1e-12, 1.0], (len(made.M), 10, d))
    side = random.choice([-1, -1, 1], (len(made.M), 40, 1))
    share *= 1 + side * 10.0 ** random.uniform(-16, 0, (len(made.M), 40, 1))
    edges = np.linalg.inv(made.M)
    points = (made.center + np.einsum("fij,fkj->fki", edges, share)).reshape(-1, d)
    with jax.enable_x64(True):
        label = np.asarray(pipeline.compiled_hull(None).run(made, points)[1][0])
        exact = problem.exact(np.abs(points).max(axis=0))
        found = jax.device_get(hull_labels.compiled_verdicts(None).run(exact, made, points))
    assert set(label) <= {-1, 0, 1} and np.all((found.label == label)[label != 0])
    inside = found.label == 1
    assert np.all(
        roll_out_exactly(Constraints(problem.plain()), found.start[inside], found.plan[inside]) >= 0
    )
    if problem.view.projects:
        assert not np.any(label == 1)  # with free states plans are rolled out
    else:
        assert np.mean(label == 1) > 0.2


@pytest.mark.parametrize("gap", [1e-9, -1e-9])
def test_points_near_the_boundary_go_on(gap, always):
    polytope = jm.feasible_polytope(problems.lecture())
    points = (1 - gap) * polytope.vertices()
    label = jm.map_feasible_set(problems.lecture(), points).label
    np.testing.assert_array_equal(label, np.sign(gap))


def test_points_that_are_not_finite(always):
    points = points_of("lecture", 50)
    expected = jm.map_feasible_set(problems.lecture(), points)
    points[7], points[11] = np.nan, np.inf
    found = jm.map_feasible_set(problems.lecture(), points)
    assert np.all(found.status[[7, 11]] == jm.Status.NON_FINITE)
    others = np.delete(np.arange(50), [7, 11])
    np.testing.assert_array_equal(found.label[others], expected.label[others])
    np.testing.assert_array_equal(found.labels.plan[others], expected.labels.plan[others])


def test_a_problem_keeps_its_cones(monkeypatch):
    worth_rays(monkeypatch, 500)
    problem = FeasibilityProblem.of(problems.lecture())
    points = points_of("lecture", 600)
    assert hull_labels.hull_for(problem, 100) is None
    whole = jm.map_feasible_set(problem, points, chunk=64)
    monkeypatch.setattr(Hull, "of", lambda _: pytest.fail("made again"))
    part = jm.map_feasible_set(problem, points[:100], chunk=64)
    np.testing.assert_array_equal(part.label, whole.label[:100])
    with pytest.raises(ValueError, match="axes, fixed: given with a FeasibilityProblem"):
        jm.map_feasible_set(problem, points, axes=(0, 1))


def test_labels_and_bounds_share_their_rays(monkeypatch):
    """Rays are sent once for the labels, and not again for bounds that are no closer."""
    worth_rays(monkeypatch, 60)
    problem = FeasibilityProblem.of(problems.lecture())
    mapped = jm.map_feasible_set(problem, points_of("lecture", 600), chunk=64)
    monkeypatch.setattr(rays, "close_gap", lambda *_, **__: pytest.fail("sent again"))
    low, high = mapped.refine(1e-8).volume_bounds()
    assert low <= high <= low * (1 + 1e-8)
    with pytest.raises(pytest.fail.Exception, match="sent again"):
        mapped.refine(1e-15)


@pytest.mark.parametrize("case", ["no interior", "unbounded", "many coordinates"])
def test_problems_without_cones(case):
    n = 5 if case == "many coordinates" else 2
    system = jm.LinearSystem(A=np.eye(n), B=np.eye(n))
    mpc = jm.MPC(
        system, np.eye(n), np.eye(n), 2, inputs=jm.Box(-np.ones(n), np.ones(n)),
        states=None if case == "unbounded" else jm.Box(-np.ones(n), np.ones(n)),
        terminal_set=jm.Box([1, 0], [1, 0]) if case == "no interior" else None,
    )  # fmt: skip
    if case == "no interior":
        mpc = jm.MPC(system, np.eye(2), np.eye(2), 1, inputs=jm.Box([0, -1], [0, 1]),
                     terminal_set=jm.Box([0.5, -1], [0.5, 1]))  # fmt: skip
    assert Hull.of(FeasibilityProblem.of(mpc)) is None


def test_facets_of_an_interval_and_of_a_square():
    np.testing.assert_array_equal(hull_facets(np.array([[0.5], [2.0], [-1.0]])), [[2], [1]])
    square = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1], [0, 0]])
    assert {tuple(sorted(f)) for f in hull_facets(square)} == {(0, 1), (1, 2), (2, 3), (0, 3)}


@pytest.mark.parametrize("size", [1e-3, 1e-5, 9.53685707727165e-08, 9.3937e-09, 3.6128e-09])
def test_tiny_terminal_sets_leave_volume(size):
    """Two steps of a double integrator into a box: A⁻² of the box and the two inputs' segments, a
    zonotope of area 4 Σ |det| over the pairs of its generators.

    The plan's decisions have hardly any room, so that each of its states keeps its rows as well as
    any other one; at 3.6e-9 the room is that of an equality."""
    back = np.linalg.inv([[1.0, 1.0], [0.0, 1.0]])
    b = np.array([[0.0], [1.0]])
    generators = np.hstack([size * back @ back, back @ b, back @ back @ b])
    area = 4 * sum(abs(np.linalg.det(generators[:, [i, j]])) for j in range(4) for i in range(j))
    mpc = jm.MPC(
        jm.LinearSystem(np.linalg.inv(back), b), [1.0, 1.0], 1.0, horizon=2, states=jm.Box(-5, 5),
        inputs=jm.Box(-1, 1), terminal_set=jm.Box(-size, size),
    )  # fmt: skip
    assert jm.feasible_polytope(mpc).volume() == pytest.approx(area, rel=1e-7)


@pytest.mark.parametrize("far", [1e3, 1e10, 1e12, 1e15])
def test_facets_stay_valid_beside_a_limit_that_means_none(far):
    """0 ≤ x₁ ≤ far: whatever details of size 1 the set loses, it holds each state with a plan."""
    system = jm.LinearSystem([[1, 1], [0, 1.0]], [[0.5], [1]])
    mpc = jm.MPC(system, [1.0, 1.0], 0.1, 4, states=jm.Box([0, -3], [far, 3]), inputs=jm.Box(-1, 1))
    near = jm.grid([0.05, -2.95], [4.95, 2.95], 15)
    with_plan = near[jm.map_feasible_set(mpc, near).label == 1]
    assert 150 < len(with_plan) < 225
    assert np.all(jm.feasible_polytope(mpc).contains(with_plan))
