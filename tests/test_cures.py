"""Cures that error messages and statuses name: they are tried, and they help."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

import jaxmpc as jm

SYSTEM = jm.LinearSystem([[1, 0.1], [0, 1]], [0.005, 0.1], dt=0.1)
BOX = jm.Box([-1, -1], [1, 1])


def problem(horizon=5, **fields):
    return jm.MPC(SYSTEM, [1, 1], 0.1, horizon, states=BOX, inputs=jm.Box(-1, 1), **fields)


@pytest.mark.parametrize("half", [np.triu, np.tril])
def test_one_half_of_a_symmetric_matrix(half):
    """Half of the sum of both, the cure of other matrices, would halve what is off the diagonal."""
    P = np.array([[4.0, 1], [1, 2]])
    with pytest.raises(ValueError, match="P: is triangular, not symmetric") as refusal:
        jm.QP(half(P), np.ones(2), np.eye(2), -np.ones(2), np.ones(2)).validate()
    cure = str(refusal.value).split(" use ")[1]
    np.testing.assert_array_equal(eval(cure, {"np": np, "P": half(P)}), P)
    with pytest.raises(ValueError, match="Use .P . P.T. / 2"):
        jm.QP(P + [[0, 1], [0, 0]], np.ones(2), np.eye(2), -np.ones(2), np.ones(2)).validate()


def test_a_longer_horizon_helps_with_a_terminal_set_alone():
    """X_{N+1} ⊆ X_N without one: what has no plan over N steps has none over more."""
    cure = "with a terminal set enlarge that or lengthen the horizon"
    assert cure in jm.Status.PRIMAL_INFEASIBLE.sentence
    near, far = (jm.feasible_polytope(problem(N)) for N in (2, 8))
    assert far.is_subset(near) and far.volume() < near.volume()
    small = jm.Box([-0.1, -0.1], [0.1, 0.1])
    near, far = (jm.feasible_polytope(problem(N, terminal_set=small)) for N in (2, 8))
    assert far.volume() > near.volume()


@pytest.mark.slow
def test_a_number_weighs_the_rate_of_one_input():
    one, other = (problem(input_rate_weight=W) for W in (0.01, [[0.01]]))
    one.validate()
    plans = [jm.solve(mpc, [0.5, 0.1], previous_input=[0.3]) for mpc in (one, other)]
    np.testing.assert_array_equal(plans[0].inputs, plans[1].inputs)


def test_points_of_a_map_with_limited_rates():
    """The message names the columns that are missing."""
    mpc = problem(input_rate_limit=0.2)
    with pytest.raises(ValueError, match=r"points \(B, 3\): states, then previous inputs"):
        jm.map_feasible_set(mpc, np.zeros((3, 2)))
    slice_ = r"map a slice: axes=\[0, 1\], fixed=\[0\]"
    with pytest.raises(ValueError, match=slice_):
        jm.map_feasible_set(mpc, np.zeros((3, 2)))
    with pytest.raises(
        ValueError, match=r"fixed: shape \(2,\).*each of previous u1, \(1,\), or of all"
    ):
        jm.map_feasible_set(mpc, np.zeros((3, 2)), axes=[0, 1], fixed=[0, 0])


@pytest.mark.slow
def test_maps_with_limited_rates_as_the_messages_ask():
    """With the columns that they name the map is made."""
    mpc = problem(input_rate_limit=0.2)
    assert jm.map_feasible_set(mpc, np.zeros((3, 3))).label.tolist() == [1, 1, 1]
    short, whole = (
        jm.map_feasible_set(mpc, np.zeros((3, 2)), axes=[0, 1], fixed=fixed)
        for fixed in ([0.1], [7, 7, 0.1])
    )
    np.testing.assert_array_equal(short.fixed, [0, 0, 0.1])
    np.testing.assert_array_equal(whole.fixed, short.fixed)
    meaning = short.to_xarray().bound_normal.attrs["long_name"]
    assert meaning == "a of a half-space a'x <= b that holds all feasible states"


@pytest.mark.long
def test_an_infeasible_plan_does_not_look_like_a_plan():
    """Its text begins with the status and holds no cost; its multipliers are no sensitivities, and
    the cure that the refusal names finds the limits."""
    mpc, x0 = problem(terminal_set=jm.Box([-0.1, -0.1], [0.1, 0.1])), [0.8, 0.0]
    solve = partial(jm.solve, solver=jm.ADMM(iterations=5000, newton_steps=0))  # compiles fastest
    plan = solve(mpc, x0)
    assert repr(plan).startswith("Plan(status=PRIMAL_INFEASIBLE, cost=none, states=")
    with pytest.raises(ValueError, match="plan: is PRIMAL_INFEASIBLE") as refusal:
        jm.mpc.active_constraints(mpc, plan)
    call = str(refusal.value).split("Ask ")[1].split(" which")[0]
    assert call.startswith("jm.solve(jm.soften(")
    light = SimpleNamespace(solve=solve, soften=jm.soften)
    soft = eval(call, {"jm": light, "mpc": mpc, "x0": x0})
    assert soft.solved and soft.slack.max() > 0.5
    found = jm.mpc.active_constraints(jm.soften(mpc, rho=1e3), soft)
    assert max(row.violation for row in found) == pytest.approx(float(soft.slack.max()))
    assert repr(soft).startswith("Plan(status=SOLVED, states=")


def test_hypotheses_name_no_terminal_set_that_is_not_there():
    report = jm.sets.verify_terminal(
        SYSTEM, np.eye(2), 0.1, None, None, states=BOX, inputs=jm.Box(-1, 1)
    )
    assert "lies within X, 1 from its boundary" in str(report)
    assert "the terminal set" not in str(report).replace("requires a terminal set", "")


@pytest.mark.slow
def test_lost_states_between_the_points_of_a_grid():
    """0.05 % of X_4 is lost, less than the distance of a grid's points: samples lie in it."""
    joint = jm.LinearSystem([[1, 0.01], [0, 1]], [0, 0.2], dt=0.01)
    limits = {"states": jm.Box([-1.5, -2], [1.5, 2]), "inputs": jm.Box(-2, 2)}
    report = jm.recursive_feasibility(jm.MPC(joint, [50, 1], 0.1, 4, **limits), steps=5)
    assert report.law.holds is False and 0 < report.lost_by_law < 1e-3 * report.volume
    assert report.loops.counts()["lost after one step"] > 0


def test_what_helps_for_flat_sets_is_named_and_helps():
    """u₀ = −10 x₂ leads (x₁, x₂) to 0 in one step where x₁ = −x₂/20, |x₂| ≤ 1/10: a segment."""
    mpc = problem(1, terminal_set=jm.Box([0, 0], [0, 0]))
    with pytest.raises(ValueError, match=r"flat.*critical_regions\(mpc\)"):
        jm.feasible_polytope(mpc)
    (region,) = jm.explicit.critical_regions(mpc).regions
    ends = region.vertices[np.argsort(region.vertices[:, 1])]
    np.testing.assert_allclose(ends, [[0.005, -0.1], [-0.005, 0.1]], atol=1e-12)
    with pytest.raises(ValueError, match="^problem: .* one value of the parameters, .* Solve"):
        jm.explicit.critical_regions(replace(mpc, inputs=jm.Box([0], [0])))
