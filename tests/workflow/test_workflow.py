"""The workflow as one object, on systems whose report can be told beforehand."""

import itertools
import time
from dataclasses import replace

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.app.cli import main
from jaxmpc.feasible.map import map_points
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.workflow.offline_checks import SetPoint, nominal_loops, theorems


def test_design_builds_what_its_parts_say():
    """Terminal ingredients are those of the functions it names, and so is the penalty."""
    mpc = problems.joint(5)
    made = {
        terminal: jm.design(
            mpc.system, mpc.Q, mpc.R, 5, states=mpc.states, inputs=mpc.inputs, terminal=terminal
        )
        for terminal in ("invariant", "ellipsoid", "box", "none")
    }
    law = jm.lqr(mpc.system, mpc.Q, mpc.R)
    body = made["invariant"].mpc.terminal_set
    assert body.volume() == pytest.approx(0.9473310116683459, rel=1e-8)
    assert made["ellipsoid"].mpc.terminal_set.level == pytest.approx(1.4137628195913876, rel=1e-8)
    assert made["box"].mpc.terminal_set is mpc.states and made["none"].mpc.terminal_set is None
    for design in made.values():
        np.testing.assert_allclose(design.mpc.terminal_cost, law.P)
        assert not design.mpc.soft and design.penalty is None
    exact = jm.design(
        mpc.system, mpc.Q, mpc.R, 3, states=mpc.states, inputs=mpc.inputs, terminal="box",
        soft="exact",
    )  # fmt: skip
    assert exact.penalty.exact and exact.mpc.states is None
    assert exact.mpc.soft[0].rho == exact.penalty.advised > exact.penalty.rho_bar > 0


def limited_output(D=None, terminal="invariant", stages=None, horizon=1):
    """A double integrator whose speed is limited as an output, or with D another output is."""
    system = jm.LinearSystem([[1.0, 1.0], [0.0, 1.0]], [0.5, 1.0])
    box, push = jm.Box([-2.0, -2.0], [2.0, 2.0]), jm.Box(-0.3, 0.3)
    speed = jm.Outputs([0.0, 1.0], -0.2, 0.2, D, stages)
    return jm.design(
        system, [1.0, 0.0], 1.0, horizon, states=box, inputs=push, terminal=terminal, outputs=speed
    ).mpc


@pytest.mark.parametrize("terminal", ["invariant", "ellipsoid"])
def test_terminal_sets_keep_outputs_within_their_limits(terminal):
    """The farthest output of the terminal set, under its law, is at its limit, or within it."""
    for D in (None, [[0.5]]):
        mpc = limited_output(D, terminal)
        K = np.asarray(jm.lqr(mpc.system, mpc.Q, mpc.R).K)
        output = np.array([0.0, 1.0]) + (0.5 * K[0] if D else 0.0)
        farthest = float(mpc.terminal_set.support(output[None])[0])
        assert farthest <= 0.2 + 1e-12 and (farthest > 0.19 or terminal == "ellipsoid")


@pytest.mark.parametrize(
    ("stages", "kept"), [((0, 1, 2), True), ((2,), True), ((3,), True), ((0, 1), False)]
)
def test_terminal_sets_keep_outputs_of_the_end_of_the_horizon(stages, kept):
    """What a plan of three steps that goes on by the law has to keep."""
    mpc = limited_output(stages=stages, horizon=3)
    farthest = float(mpc.terminal_set.support(np.array([[0.0, 1.0]]))[0])
    assert farthest == pytest.approx(0.2 if kept else 0.26833, abs=1e-4) or not kept
    assert (farthest <= 0.2 + 1e-12) == kept


def test_limits_of_outputs_of_the_state_are_limits_of_states():
    """Sets, claims and theorems are those of the problem with the same rows among the states."""
    mpc = limited_output()
    rows = jm.Polytope([[1.0, 0], [-1, 0], [0, 1], [0, -1]], [2.0, 2.0, 0.2, 0.2])
    stated = replace(mpc, states=rows, outputs=())
    assert (
        mpc.terminal_set
        == jm.design(mpc.system, mpc.Q, mpc.R, 1, states=rows, inputs=mpc.inputs).mpc.terminal_set
    )
    of_both = [jm.feasible.any_policy_polytope(problem) for problem in (mpc, stated)]
    assert of_both[0] == of_both[1] == jm.feasible_polytope(mpc)
    report = jm.recursive_feasibility(mpc, search=False, seconds=30)
    assert report.strong.holds and report.law.holds
    assert str(theorems(mpc)) == str(theorems(stated))
    assert theorems(mpc).recursive_feasibility


def test_harden_undoes_soften():
    """Rows at all state steps become states, rows at N the terminal set; the set is the same."""
    mpc = problems.drifting(3)
    back = jm.mpc.harden(jm.soften(mpc, 10.0))
    assert not back.soft and not back.outputs
    before, after = jm.feasible_polytope(mpc), jm.feasible_polytope(back)
    assert before.is_subset(after) and after.is_subset(before)
    odd = jm.Soft(np.array([[1.0, 0.0]]), upper=np.array([0.5]), stages=(2,))
    assert jm.mpc.harden(jm.MPC(mpc.system, mpc.Q, mpc.R, 3, soft=odd)).outputs[0].stages == (2,)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (dict(terminal="largest"), "terminal: 'largest'"),
        (dict(soft="free"), "soft: 'free'"),
        (dict(states=None, inputs=None), "terminal: 'invariant' without limits"),
        (dict(limits=jm.joint_limits(1.5, 2.0, 2.0)), "limits: given beside"),
    ],
)
def test_wrong_arguments(settings, message):
    mpc = problems.joint(5)
    given = {"states": mpc.states, "inputs": mpc.inputs, **settings}
    with pytest.raises(ValueError, match=message):
        jm.design(mpc.system, mpc.Q, mpc.R, 5, **given)


@pytest.mark.slow
def test_report_of_the_command(capsys):
    """Joint, N = 2, no terminal set: refuted, with the reasons; every section is there."""
    assert main(["info", "--horizon", "2", "--steps", "5", "--loops", "8"]) == 0
    text = capsys.readouterr().out
    for section in (
        "Problem", "Feasible set", "Recursive feasibility", "Exact penalty",
        "Terminal ingredients", "Closed loops",
    ):  # fmt: skip
        assert f"\n{section}" in text
    assert "law                  refuted" in text and "11.96" in text
    assert "NO  control invariance" in text and "not done" not in text


def test_info_explains_what_it_cannot_read(capsys, tmp_path):
    assert main(["info", "--config", str(tmp_path / "none.toml")]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert main(["info", "--loops", "0"]) == 2
    assert "--loops" in capsys.readouterr().err


def test_report_keeps_to_its_time(capsys):
    """Stages are announced, and what is left out is said."""
    report = jm.workflow.offline_report(problems.joint(20), seconds=0.01, progress=True)
    assert report.feasible_set is None and report.loops is None
    assert report.terminal is not None and report.recursion.law.holds is None
    text = str(report)
    assert text.count("no time was left") >= 2 and "no samples are mapped" in text
    lines = capsys.readouterr().err.splitlines()
    assert all(" s  " in line for line in lines)
    for stage in ("terminal ingredients", "theorem and linear programs", "exact penalty"):
        assert any(stage in line for line in lines)


@pytest.mark.long
def test_a_report_of_a_robust_problem_says_against_what():
    mpc = replace(problems.joint(3), disturbance=jm.Box(-0.001, 0.001), policy="affine")
    text = str(jm.workflow.offline_report(mpc, seconds=0.01))
    assert "every disturbance, by a policy of kind 'affine'" in text
    assert "those of a robust problem are not followed" in text
    assert "Theorem 3 is about w = 0" in text


@pytest.mark.long
def test_costs_in_other_units_decrease_as_much():
    """Of an unstable system without a terminal cost, whose cost may grow."""
    system = jm.LinearSystem([[1.2, 1], [0, 1.1]], [[0.5], [1]], dt=1.0)
    x0s = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 2))
    found = []
    for unit in (1.0, 2.0**-60, 2.0**60):
        sets = {"states": jm.Box([-5, -5], [5, 5]), "inputs": jm.Box(-1, 1)}
        mpc = jm.MPC(system, unit * np.eye(2), 0.01 * unit * np.eye(1), 2, **sets)
        loops = nominal_loops(mpc, x0s, 6, SetPoint.of(mpc, np.zeros(2), np.zeros(1)))
        found.append(loops.increase)
    assert found[0] > 0.5
    np.testing.assert_allclose(found, found[0], rtol=1e-6)


def test_a_map_that_runs_out_of_time_says_so():
    fmap = map_points(
        FeasibilityProblem.of(problems.lecture()), np.zeros((5, 2)), chunk=2, deadline=-np.inf
    )
    assert fmap.counts()["feasible"] == 2 and fmap.counts()["not run"] == 3
    assert len(fmap.labels.plan) == 5


@pytest.mark.slow
def test_report_of_an_ellipsoidal_and_of_a_4d_problem(monkeypatch):
    """What does not apply is said, not left out."""
    mpc = problems.joint(6)
    law = jm.lqr(mpc.system, mpc.Q, mpc.R)
    last = jm.sets.invariant_ellipsoid(mpc.system, law.K, law.P, mpc.states, mpc.inputs)
    report = jm.workflow.offline_report(
        jm.MPC(mpc.system, mpc.Q, mpc.R, 6, mpc.states, mpc.inputs, law.P, last), steps=10, loops=8
    )
    assert report.terminal.recursive_feasibility and report.terminal.stability
    assert report.penalty is None and "ellips" in report.notes["penalty"].lower()
    assert report.recursion.strong.holds is True
    assert report.loops.feasible == 8 and report.loops.increase <= 1e-7
    # Time passes by looks at the clock, not on a wall, where a busy machine has no time for a map.
    looks = itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: 0.1 * next(looks))
    product = jm.workflow.offline_report(problems.hidden_product(3), steps=3, loops=8, seconds=60)
    assert product.feasible_set.counts()["undecided"] == 0 and product.loops.feasible <= 8
    assert "random ones: not shares of the volume" in str(product)


def test_a_report_says_where_its_loops_go_and_whether_that_holds():
    """A double integrator rests at any position without an input, and at no other velocity."""
    system = jm.LinearSystem([[1, 1], [0, 1]], [[0.5], [1]], c=[0, 0.5], dt=1.0)
    states, soft = jm.Box([-5, -5], [5, 5]), jm.Soft([[1, 0]], upper=[2], names=("reach",))
    mpc = jm.MPC(system, 1.0, 1.0, 3, states=states, inputs=jm.Box(-1, 1), soft=soft)
    mpc = replace(mpc, Q=np.eye(2))
    for x, u, drift, broken in (
        ([1, 0], [-0.5], [-0.25, 0], ()),  # c alone is not balanced: x⁺ − x = (u/2, u + 1/2)
        ([6, 0], [-1.5], [-0.75, -1], ("input limit u1", "state limit x1", "soft limit reach")),
        ([1, 2], [0.0], [2, 0.5], ()),
    ):
        found = SetPoint.of(mpc, x, u)
        np.testing.assert_allclose(found.drift, drift)
        assert found.broken == broken and "no equilibrium" in str(found)
    straight = replace(mpc, system=replace(system, c=None))
    report = jm.workflow.offline_report(straight, reference=[1.0, 0.0], steps=2, seconds=1)
    assert "Set-point\n  x = [1., 0.], u = [0.]\n  an equilibrium that keeps" in str(report)
    with pytest.raises(ValueError, match="reference: differs over time"):
        jm.workflow.offline_report(straight, reference=np.zeros((4, 2)))
