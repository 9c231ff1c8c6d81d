"""The states that some input takes into a set, by hand and by two methods."""

import numpy as np
import pytest
from plants import UNSTABLE
from polytopes import interval
from problems import symmetric

from jaxmpc import Box, LinearSystem, Polytope
from jaxmpc.sets.predecessors import predecessor


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
    monkeypatch.setattr("jaxmpc.sets.predecessors._MANY", 1000)
    by_pairs = predecessor(system, target, None, inputs)
    assert len(by_ridges.h) == len(by_pairs.h) > 250
    assert by_ridges.volume() == pytest.approx(by_pairs.volume(), rel=1e-12)
    for direction in rng.standard_normal((10, 4)):  # a sum of sets: their supports add up
        expected = target.support(direction) + float(inputs.support(-direction @ system.B))
        assert by_ridges.support(direction) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    "units", [np.ones(3), np.array([0.1, 1e4, 100.0]), np.array([1e4, 1e-5, 1e3])]
)
def test_states_that_a_rotated_plant_takes_to_a_point(units):
    """cos(π/2) is 6e-17, a coordinate's own unit where other rows have offset 0. A'A = I, so that
    they are -A'B u: a segment, of which coordinates came as 0."""
    turn = np.pi / 2
    A, B = np.eye(3), np.array([[0.6], [-0.3], [0.8]])
    A[:2, :2] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    system = LinearSystem(units[:, None] * A / units, units[:, None] * B)
    point, inputs = Box(np.zeros(3), np.zeros(3)), Box([-0.7], [0.4])
    ends = -np.array([[-0.7], [0.4]]) @ (A.T @ B).T
    axes = np.vstack([np.eye(3), -np.eye(3)])
    found = predecessor(system, point, None, inputs)
    np.testing.assert_allclose(found.support(axes / units), (ends @ axes.T).max(axis=0), atol=1e-9)
