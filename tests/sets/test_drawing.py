"""Pictures of sets: what stands in the axes."""

import matplotlib
import numpy as np
import pytest

matplotlib.use("agg")
import matplotlib.pyplot as plt

import jaxmpc as jm
from jaxmpc.sets import PolytopeUnion, Zonotope, plot, set_difference
from jaxmpc.sets.drawing import COLOURS, polygons

INF = np.inf
TRIANGLE = jm.Polytope.from_points([[0, 0], [2, 0], [0, 1]])


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")


def test_polygons_lines_and_points():
    ax = plot(
        TRIANGLE,
        Zonotope([0, 2], [[1], [0.5]]),
        jm.Box([3, 0], [3, 0]),
        jm.Box([1, 0], [0, 1]),
        jm.Ellipsoid(np.eye(2), 1.0, [2, 2]),
        label=["triangle", "segment", "point", "empty", "disk"],
    )
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert set(names) == {"triangle", "segment", "point", "disk"}
    corners = ax.patches[0].get_xy()
    assert len(corners) == 4
    np.testing.assert_allclose(np.ptp(corners, axis=0), [2, 1], rtol=1e-12)
    low, high = np.transpose([ax.get_xlim(), ax.get_ylim()])
    assert np.all(low <= [-1, 0]) and np.all(high >= [3, 3])
    assert len({line.get_color() for line in ax.lines}) == 4
    TRIANGLE.translate([10, 0]).plot(ax=ax)
    assert ax.get_xlim()[1] > 12  # the picture grows
    ax.set_xlim(-1, 1)
    TRIANGLE.plot(ax=ax)
    assert ax.get_xlim() == (-1, 1)  # unless its limits are set


def test_unbounded_sets_are_cut_off_and_named_so():
    ax = plot(jm.Box([0, 0], [INF, 1]), TRIANGLE, label=["strip", "triangle"])
    names = [text.get_text() for text in ax.get_legend().get_texts()]
    assert names == ["strip (unbounded)", "triangle"]
    corners = ax.patches[0].get_xy()
    assert corners[:, 0].max() == ax.get_xlim()[1] > 2
    # Three edges of the strip, none at the border of the picture.
    strip = [line for line in ax.lines if line.get_color() == COLOURS[0]]
    assert len(strip) == 3 and all(line.get_xdata().min() < 2 for line in strip)
    half = jm.Polytope([[1, 1]], [1]).plot(label="half plane")
    assert [t.get_text() for t in half.get_legend().get_texts()] == ["half plane (unbounded)"]
    whole = jm.Polytope(np.zeros((0, 2)), np.zeros(0)).plot()
    assert not whole.lines and len(whole.patches) == 1


def test_three_dimensions():
    ax = plot(
        jm.Box([0, 0, 0], [1, 1, 1]),
        jm.Polytope.from_points([[2, 0, 0], [3, 0, 0], [2, 1, 1]]),
        Zonotope([0, 0, 2], [[1], [1], [0]]),
        jm.Ellipsoid(np.eye(3), 1.0, [2, 2, 2]),
        jm.Box([0, 2, 0], [1, 3, INF]),
    )
    assert ax.name == "3d" and len(ax.collections) == 4 and len(ax.lines) == 1
    faces = polygons(Zonotope([0, 0, 0], [[1, 0, 1], [0, 1, 1], [0, 0, 1]]).vertices())
    assert [len(face) for face in faces] == [4] * 6
    for face in faces:  # corners in order: the sides of a parallelogram
        np.testing.assert_allclose(face[0] + face[2], face[1] + face[3], atol=1e-12)
    with pytest.raises(ValueError, match="ax: has two dimensions"):
        plot(jm.Box([0, 0, 0], [1, 1, 1]), ax=plt.subplots()[1])


def test_unions_and_what_cannot_be_drawn():
    ring = set_difference(jm.Box([-1, -1], [1, 1]), jm.Box([-0.2, -0.3], [0.5, 0.4]))
    ax = ring.plot(label="ring")
    assert len(ax.patches) == 4 and len(ax.get_legend().get_texts()) == 1
    assert len({patch.get_facecolor() for patch in ax.patches}) == 1
    for sets, message in [
        ((), "sets: is empty"),
        ((jm.Box(np.zeros(4), np.ones(4)),), "dimensions 4"),
    ]:
        with pytest.raises(ValueError, match=message):
            plot(*sets)
    with pytest.raises(ValueError, match="empty union"):
        PolytopeUnion(()).plot()
