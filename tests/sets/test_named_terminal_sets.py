"""Terminal sets by name are those of the functions that they stand for."""

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.sets.convex_sets import set_bounds
from jaxmpc.sets.invariant import TERMINAL_SETS, named_terminal_set

MPC = problems.joint(3)
LAW = jm.lqr(MPC.system, MPC.Q, MPC.R)


def test_names():
    limits = MPC.states, MPC.inputs
    found = {name: named_terminal_set(name, MPC.system, LAW, *limits) for name in TERMINAL_SETS}
    assert found["none"] is None and found["box"] is MPC.states
    np.testing.assert_array_equal(
        found["invariant"].h, jm.maximal_invariant_set(MPC.system, LAW.K, *limits).h
    )
    level = jm.sets.invariant_ellipsoid(MPC.system, LAW.K, LAW.P, *limits).level
    assert found["ellipsoid"].level == level


def test_errors():
    with pytest.raises(ValueError, match="terminal: 'states'"):
        named_terminal_set("states", MPC.system, LAW, MPC.states, MPC.inputs)
    with pytest.raises(ValueError, match="without limits"):
        named_terminal_set("invariant", MPC.system, LAW, None, None)


@pytest.mark.parametrize("shape", ["polytope", "ellipsoid", "box", "none"])
def test_set_bounds(shape):
    """|x_1| <= 1, |x_2| <= 2 in each shape; outwards by no more than a part in a million."""
    box = problems.symmetric(1.0, 2.0)
    given = {
        "box": box, "polytope": box.to_polytope(), "none": None,
        "ellipsoid": jm.Ellipsoid(np.diag([1.0, 0.25]), 1.0),
    }[shape]  # fmt: skip
    lower, upper = set_bounds(given, 2)
    if given is None:
        assert np.all(upper == np.inf) and np.all(lower == -np.inf)
        return
    assert np.all(upper >= [1, 2]) and np.all(lower <= [-1, -2])
    np.testing.assert_allclose(upper, [1, 2], rtol=2e-6)
    np.testing.assert_allclose(lower, [-1, -2], rtol=2e-6)
