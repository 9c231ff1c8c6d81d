"""Networks in the place of an MPC: what is proved of them, beside exact areas and many states."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import jaxmpc as jm
from jaxmpc.explicit import prove_network
from jaxmpc.explicit.network_proof import excess_bounds, rounding_bound

JOINT = jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]])
UNIT = jm.Box([-1.0, -1.0], [1.0, 1.0])
TORQUE = jm.Box([-1.0], [1.0])


def random_network(seed, sizes, bias=0.3):
    random = np.random.default_rng(seed)
    return [
        (random.normal(size=(b, a)) / np.sqrt(a), bias * random.normal(size=b))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]


def output(network, x, limits):
    for W, b in network[:-1]:
        x = np.maximum(x @ W.T + b, 0)
    W, b = network[-1]
    return np.clip(x @ W.T + b, *limits.bounds())


def excess(system, target, x, u):
    H, h = target.half_spaces()
    following = x @ np.asarray(system.A).T + u @ np.asarray(system.B).T
    return np.max(following @ H.T - h, axis=1)


def test_shares_of_a_clipped_gain_are_areas():
    """x⁺ = 2x + u with u = clip(−2x, ±1/2) from |x| ≤ 1 into itself: for x > 1/4 the next state is
    2x − 1/2 ≤ 1 up to x = 3/4. So three quarters are kept."""
    system, line = jm.LinearSystem([[2.0]], [[1.0]]), jm.Box([-1.0], [1.0])
    half = jm.Box([-0.5], [0.5])
    found = prove_network([([[-2.0]], [0.0])], system, line, half, cells=2000)
    assert abs(found.kept - Fraction(3, 4)) < 1e-6 and abs(found.broken - Fraction(1, 4)) < 1e-6
    assert found.kept <= 0.75 and found.broken <= 0.25
    assert found.kept + found.broken + found.undecided == pytest.approx(1, abs=1e-12)
    assert "75.0" in repr(found)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.first(1)
def test_many_states_agree(seed):
    """No state of a proved cell misses the target, none of a refuted one keeps it, and the shares
    enclose that of random states."""
    network = random_network(seed, [2, 8, 8, 1])
    found = prove_network(network, JOINT, UNIT, TORQUE, cells=60_000)
    x = np.random.default_rng(9).uniform(-1, 1, (200_000, 2))
    kept = np.mean(excess(JOINT, UNIT, x, output(network, x, TORQUE)) <= 0)
    assert found.undecided < 0.02 and found.kept > 0.5 and found.broken > 0
    assert found.kept - 0.004 <= kept <= 1 - found.broken + 0.004


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.first(2)
def test_bounds_hold_in_a_cell(seed):
    """Bounds enclose what 2,000 states of a random simplex have, and are sharp in small ones."""
    random = np.random.default_rng(seed)
    network, (low, high) = random_network(seed, [3, 10, 10, 2]), (np.array([-0.4, -1]), np.ones(2))
    F, G, g = (random.normal(size=shape) for shape in ((5, 3), (5, 2), (5,)))
    with jax.enable_x64(True):
        bounds = jax.jit(excess_bounds)
        for size, gap in ((1.0, 50.0), (1e-4, 2e-2)):
            corners = random.normal(size=3) + size * random.normal(size=(4, 3))
            x = random.dirichlet(np.ones(4), 2000) @ corners
            u = output(network, x, jm.Box(low, high))
            values = np.max(x @ F.T + u @ G.T + g, axis=1)
            given = jax.tree.map(jnp.asarray, (network, (low, high), (F, G, g)))
            least, most = bounds(given, jnp.asarray(corners))
            assert least <= values.min() + 1e-12 and values.max() <= most + 1e-12
            assert most - least < gap


def test_roundings_are_far_below_their_bound():
    """Bounds in float32 differ from those in float64 by less than what float32 may err."""
    random = np.random.default_rng(5)
    network = random_network(5, [2, 24, 24, 1])
    last = tuple(random.normal(size=shape) for shape in ((4, 2), (4, 1), (4,)))
    given = network, (np.array([-1.0]), np.array([1.0])), last
    corners = random.uniform(-1, 1, (500, 3, 2))
    least = rounding_bound(given, np.ones(2))
    with jax.enable_x64(True):
        bounds = jax.jit(jax.vmap(excess_bounds, (None, 0)))

        def found(kind):
            arrays = jax.tree.map(lambda v: jnp.asarray(v, kind), (given, corners))
            return np.stack(bounds(*arrays))

        exact, rough = found(np.float64), found(np.float32)
    assert rough.dtype == np.float32
    off = np.abs(exact - rough).max()
    assert 1e-8 < off < least * np.finfo(np.float32).eps / np.finfo(np.float64).eps / 10
    assert least < 1e-9


def test_open_cells_lie_in_the_set_and_have_its_share():
    body = jm.Polytope.from_points([[-1, -1], [1, -1], [0.3, 1.0]])
    found = prove_network(random_network(1, [2, 6, 1]), JOINT, body, TORQUE, cells=5000)
    assert np.all(body.contains(found.open_cells.reshape(-1, 2), 1e-9))
    area = sum(ConvexHull(cell).volume for cell in found.open_cells)
    assert area / 2 == pytest.approx(found.undecided, rel=1e-9)  # the triangle has area 2


def test_another_target():
    """Into a smaller set fewer states lead, and into a larger one all."""
    network = random_network(2, [2, 8, 1])
    shares = [
        prove_network(
            network, JOINT, UNIT, TORQUE, target=jm.Box([-k, -k], [k, k]), cells=20_000
        ).kept
        for k in (0.9, 1.0, 2.0)
    ]
    assert shares[0] < shares[1] < shares[2] == pytest.approx(1)


def test_targets_that_say_nothing():
    """All states lead into all of the plane; a row of zeros says nothing beside others."""
    network, limits = random_network(2, [2, 8, 1]), jm.Box(-0.5, 0.5)  # two numbers, for all inputs
    whole = prove_network(network, JOINT, UNIT, limits, target=jm.Box(-np.inf, np.inf))
    assert whole.kept == 1
    H, h = np.vstack([np.eye(2), -np.eye(2), np.zeros(2)]), np.array([2.0, 2, 2, 2, 1])
    found = prove_network(network, JOINT, UNIT, limits, target=jm.Polytope(H, h))
    assert found.kept == pytest.approx(1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"network": [(np.ones((2, 8)), np.zeros(2))]}, r"network\[0\]\[0\]: shape \(2, 8\)"),
        ({"network": [(np.ones((2, 2)), np.zeros(2))]}, "has 2 outputs for 1 inputs"),
        ({"network": [(np.ones((1, 2)), np.zeros(2))]}, r"network\[0\]\[1\]"),
        ({"network": [(np.full((1, 2), np.nan), np.zeros(1))]}, r"network\[0\]\[0\]"),
        ({"network": []}, "Give the arrays of each layer"),
        ({"network": 3.0}, "Give the arrays of each layer"),
        ({"inputs": jm.Box([-np.inf], [1.0])}, "inputs: are unbounded"),
        ({"states": jm.Polytope([[1.0, 0.0]], [1.0])}, "states: is unbounded"),
        ({"states": jm.Box([0.0, 0.0], [0.0, 1.0])}, "states"),
        ({"target": jm.Box([-1.0], [1.0])}, "target"),
        ({"cells": 0}, "cells"),
    ],
)
def test_wrong_arguments(change, message):
    given = {"network": random_network(0, [2, 4, 1]), "states": UNIT, "inputs": TORQUE} | change
    with pytest.raises(ValueError, match=message):
        prove_network(system=JOINT, **given)
