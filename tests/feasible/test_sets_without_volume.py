"""Empty, flat and unbounded feasible sets under each policy: what is said of them, and whether the
cure that an error gives is one."""

from dataclasses import replace

import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.feasible import any_policy_polytope, feasible_growth, feasible_polytope

MPC = jm.MPC(
    system=jm.LinearSystem([[1, 0.2], [0, 1]], [[0.02], [0.2]]),
    Q=np.eye(2),
    R=0.1,
    horizon=3,
    states=jm.Box([-1.0, -1.0], [1.0, 1.0]),
    inputs=jm.Box(-1.0, 1.0),
)
NOISE = {"disturbance": jm.Box(-0.01, 0.01)}
GAIN = {**NOISE, "gain": [[-2.0, -2.5]]}
POLICIES = {
    "nominal": {},
    "tightened": GAIN,
    "affine": {**NOISE, "policy": "affine"},
    "tube": {**GAIN, "policy": "tube"},
}
FAR = {"terminal_set": jm.Box([5.0, 5.0], [6.0, 6.0])}
OPEN = {"states": jm.Box([-np.inf, -1.0], [np.inf, 1.0])}


@pytest.mark.parametrize("policy", POLICIES)
def test_cures_of_a_feasible_set_without_facets(policy):
    given = replace(MPC, **POLICIES[policy])
    empty, unbounded = replace(given, **FAR), replace(given, **OPEN)
    with pytest.raises(ValueError, match=r"set is empty.* (Relax a limit)"):
        feasible_polytope(empty)
    assert feasible_polytope(given).volume() > 1  # the cure
    with pytest.raises(ValueError, match="unbounded. Map it with map_feasible_set"):
        feasible_polytope(unbounded)
    fmap = jm.map_feasible_set(unbounded, [[0.0, 0.0], [0.0, 2.0]])
    np.testing.assert_array_equal(fmap.label, [1, -1])
    assert any_policy_polytope(empty).is_empty()
    assert not any_policy_polytope(given).is_empty()


def test_flat_feasible_sets():
    flat = replace(MPC, horizon=1, terminal_set=jm.Box([0.0, 0.0], [0.0, 0.0]))
    with pytest.raises(ValueError, match="flat.*jm.explicit.critical_regions.mpc."):
        feasible_polytope(flat)
    assert len(jm.explicit.critical_regions(flat).regions)
    growth = feasible_growth(flat, [1, 2])
    assert growth.volume[0] == growth.facets[0] == 0 and growth.sets[0] is None
    np.testing.assert_allclose(
        growth.volume[1], feasible_polytope(replace(flat, horizon=2)).volume()
    )
    one_way = {"disturbance": jm.Box([-0.01], [0.01]), "disturbance_matrix": [[1.0], [0.0]]}
    still = jm.LinearSystem(np.eye(2), np.eye(2))
    sides = jm.Box([-1.0, 0.0], [1.0, 0.0])
    robust = replace(
        MPC, system=still, R=np.eye(2), policy="affine", states=sides, inputs=sides, **one_way
    )
    with pytest.raises(ValueError, match="empty or flat.*Relax a limit"):
        feasible_polytope(robust)
    assert feasible_growth(robust, [2]).volume[0] == 0


@pytest.mark.long
def test_a_flat_terminal_set_of_many_states_is_no_flat_feasible_set():
    """Above four dimensions X_N is computed backwards from it, which says nothing of its volume."""
    system = jm.LinearSystem(np.eye(5) + 0.5 * np.eye(5, k=1), np.eye(5)[:, -1:])
    sides, rest = jm.Box(-np.ones(5), np.ones(5)), jm.Box(np.zeros(5), np.zeros(5))
    mpc = jm.MPC(
        system, np.eye(5), 0.1, 6, states=sides, inputs=jm.Box(-1.0, 1.0), terminal_set=rest
    )
    around = 1e-3 * np.vstack([np.eye(5), -np.eye(5)])
    assert np.all(jm.solve_many(mpc, around).solved)  # a body about the origin
    with pytest.raises(ValueError, match="facets are not found"):
        feasible_growth(mpc, [6])


def test_a_grid_that_ends_at_the_limits_is_decided():
    """Of a chain of integrators by Euler's rule: each label is that of a linear program."""
    system = jm.LinearSystem(np.eye(4) + 0.1 * np.eye(4, k=1), 0.1 * np.eye(4)[:, 3:])
    sides = jm.Box(-np.ones(4), np.ones(4))
    mpc = jm.MPC(system, np.eye(4), 0.1, 5, states=sides, inputs=jm.Box(-1, 1))
    fmap = jm.map_feasible_set(mpc, jm.grid([-1, -1], [1, 1], 5), axes=[0, 1], fixed=[0, 0])
    states = np.pad(fmap.x0s, ((0, 0), (0, 2)))
    assert np.all(np.abs(fmap.label) == 1)
    np.testing.assert_array_equal(jm.solve_many(mpc, states).solved, fmap.label == 1)


def limited(place, low, high):
    """Return the problem with one coordinate, or all of the last state, between low and high."""
    sides, n = np.array([[low, high], [-1.0, 1.0]]), np.eye(2)
    ends = np.array([high, high, -low, -low])
    given = {
        "inputs": {"inputs": jm.Box(low, high)},
        "states": {"states": jm.Box(*sides[::-1].T)},
        "states of a polytope": {"states": jm.Polytope(np.vstack([n, -n]), [1, high, 1, -low])},
        "end": {"terminal_set": jm.Box([low, low], [high, high])},
        "end in a polytope": {"terminal_set": jm.Polytope(np.vstack([n, -n]), ends)},
        "outputs": {"outputs": jm.Outputs([[1.0, 1.0]], [low], [high], stages=(3,))},
    }
    return replace(MPC, horizon=4, **given[place])


@pytest.mark.parametrize(
    "place", ["inputs", "states", "states of a polytope", "end", "end in a polytope", "outputs"]
)
def test_limits_that_are_equal_but_for_rounding_are_equal(place):
    """0.1 + 0.2 is 0.3 and 5.6e-17. A state of one problem is labelled as that of the other one,
    and none is left undecided."""
    states = np.random.default_rng(1).uniform(-0.9, 0.9, (60, 2))
    if place.startswith("states"):
        states[:40, 1] = 0.3
    exact, rounded = (
        jm.map_feasible_set(limited(place, 0.3, high), states).label for high in (0.3, 0.1 + 0.2)
    )
    assert set(exact) == {1, -1}
    np.testing.assert_array_equal(rounded, exact)
