"""Pictures of explicit laws: their polygons fill the set, and slices are those of the regions."""

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.app.plots import plot_regions
from jaxmpc.explicit import ParametricQP, critical_regions

INTEGRATOR = jm.LinearSystem([[1, 1], [0, 1.0]], [0.5, 1])
X, U = jm.Box([-5, -5], [5, 5]), jm.Box(-1, 1)


def area(ax):
    """The area of all polygons in the picture."""
    paths = [path for collection in ax.collections for path in collection.get_paths()]
    corners = [np.asarray(path.vertices)[:-1] for path in paths if len(path.vertices) > 3]
    cross = lambda v: v[:, 0] @ np.roll(v[:, 1], -1) - v[:, 1] @ np.roll(v[:, 0], -1)
    return sum(abs(cross(v)) / 2 for v in corners)


def test_polygons_fill_the_set():
    regions = critical_regions(jm.MPC(INTEGRATOR, [1.0, 1], 0.1, 3, X, U, terminal_set=X))
    ax = plot_regions(regions)
    assert area(ax) == pytest.approx(regions.volume, rel=1e-6)
    assert f"{len(regions)} critical regions" in ax.get_title(loc="left")
    assert plot_regions(regions, show="value").get_xlabel() == "x1"


@pytest.mark.parametrize("units", [(1e6, 1e-6), (1e-6, 1e6), (1.0, 1e-9)])
def test_polygons_fill_the_set_in_any_units(units):
    unit = np.array(units)
    A, B = unit[:, None] * np.array([[1, 1], [0, 1.0]]) / unit, unit * [0.5, 1.0]
    box = jm.Box(-5 * unit, 5 * unit)
    mpc = jm.MPC(jm.LinearSystem(A, B), 1 / unit**2, 0.1, 2, box, U, terminal_set=box)
    regions = critical_regions(mpc)
    assert area(plot_regions(regions)) == pytest.approx(regions.volume, rel=1e-6)


def test_the_colour_bar_says_what_it_measures_beside_the_axes():
    system = jm.LinearSystem([[1, 1], [0, 1.0]], [0.5, 1], input_names=("F",), input_units=("N",))
    regions = critical_regions(jm.MPC(system, [1.0, 1], 0.1, 2, X, U))
    for show, label in (("law", "first input F [N]"), ("value", "least cost")):
        ax = plot_regions(regions, show=show)
        bar = ax.figure.axes[1]
        assert bar.get_ylabel() == label and ax.get_legend() is None
        ax.figure.draw_without_rendering()
        assert 0 < bar.get_position().x0 - ax.get_position().x1 < 0.03


def test_slices_and_unbounded_sets():
    qp = ParametricQP(np.eye(2), np.eye(2), [1.0, 1], F=-np.eye(2, 3), S=np.zeros((2, 3)),
                      names=("a", "b", "c"))  # fmt: skip
    regions = critical_regions(qp)  # z = min(θ, 1) for the first two of three
    assert len(regions) == 4
    ax = plot_regions(regions, axes=(1, 2), fixed=[3.0, 0, 0], limits=[(-2, 2), (-1, 1)])
    assert area(ax) == pytest.approx(8) and "a = 3, " not in ax.get_title(loc="left")
    assert "slice at a = 3" in ax.get_title(loc="left") and ax.get_ylabel() == "c"
    for settings, message in [
        ({"axes": (0, 0)}, "axes"), ({"show": "gain"}, "show"), ({"output": 2}, "output"),
        ({"fixed": [1.0]}, "fixed"), ({"limits": [1, 2]}, "limits"),
    ]:  # fmt: skip
        with pytest.raises(ValueError, match=message):
            plot_regions(regions, **settings)
