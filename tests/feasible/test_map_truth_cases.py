"""Systems with exactly known sets, thresholds and answers, through the public names alone.

The numbers are exact rationals or closed forms, written with each case; how they were derived
stands beside them. One test, a case each.
"""

import importlib
import sys
from pathlib import Path

import numpy as np
import problems
import pytest

import jaxmpc as jm
from jaxmpc.feasible import feasible_growth
from jaxmpc.recursion import smallest_horizon

P_DARE, K_DARE = np.array(problems.P_JOINT), np.array(problems.K_JOINT)


def scalar_integrator():
    """x⁺ = x + u: |x_0| ≤ radius for each index set of the state limit, by hand."""
    for N, X, U in ((5, 1.0, 0.3), (3, 1.0, 2.0)):
        for steps, terminal, radius in (
            (range(N + 1), None, X),
            (range(1, N + 1), None, X + U),
            ((N,), None, X + N * U),
            (range(N), None, X),
            (range(N), 0.0, min(X, N * U)),
            (range(N), X / 4, min(X, X / 4 + N * U)),
        ):
            mpc = problems.scalar(
                horizon=N, x_max=X, u_max=U, terminal=terminal, constrained_stages=tuple(steps)
            )
            ends = jm.feasible_polytope(mpc).vertices().ravel()
            np.testing.assert_allclose(ends, [-radius, radius], rtol=1e-9)


def double_integrator():
    """The MPT toolbox's example: C_inf of area 1375/24 with 14 facets, found at step 6."""
    mpc = problems.double_integrator()
    body = jm.sets.maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs)
    assert body.exact and body.iterations == 6 and len(body.vertices()) == 14
    assert body.volume() == pytest.approx(1375 / 24, rel=1e-12)
    assert np.abs(body.vertices() - [2.5, -3.5]).max(axis=1).min() < 1e-9


def double_integrator_lqr():
    """The same with its LQR, Q = I, R = 1: six facets, and the largest ellipsoid inside."""
    mpc = problems.double_integrator()
    law = jm.lqr(mpc.system, np.eye(2), np.eye(1))
    np.testing.assert_allclose(law.K, [[-0.5197540074523589, -0.9399575360220684]], rtol=1e-9)
    body = jm.maximal_invariant_set(mpc.system, law.K, mpc.states, mpc.inputs)
    assert body.index == 2 and len(body.vertices()) == 6
    assert body.volume() == pytest.approx(13.74039794963338, rel=1e-9)
    ellipsoid = jm.sets.invariant_ellipsoid(mpc.system, law.K, law.P, mpc.states, mpc.inputs)
    assert ellipsoid.level == pytest.approx(2.2690725611388145, rel=1e-9)
    assert ellipsoid.contraction == pytest.approx(0.4595183119694164, rel=1e-9)
    assert ellipsoid.volume() == pytest.approx(3.2752599406821137, rel=1e-9)


# By exact polygon recursion: area of X_N for N = 0, 1, …
LECTURE = {
    0.25: [4.0, 3.19, 2.7675, 2.6075, 2.5875, 2.5875],
    0.3: [4.0, 3.2256, 2.8892, 2.8108, 2.8108],
}


def lecture_sets():
    """Areas of X_N and C_inf of the lecture's example, both input limits."""
    for u_max, areas in LECTURE.items():
        for N, area in enumerate(areas[1:], start=1):
            body = jm.feasible_polytope(problems.lecture(u_max, N))
            assert body.volume() == pytest.approx(area, abs=1e-9)
        mpc = problems.lecture(u_max)
        body = jm.sets.maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs)
        assert body.exact and body.iterations == {0.25: 4, 0.3: 3}[u_max]
        assert body.volume() == pytest.approx(areas[-1], abs=1e-9)


def lecture_recursion():
    """|u| ≤ 1/4, N = 3: lost, at worst by 0.0474341649 from (−0.95, 1); N = 4: kept."""
    report = jm.recursive_feasibility(problems.lecture(), steps=2)
    assert (report.weak.holds, report.strong.holds, report.law.holds) == (False, False, False)
    worst = report.counterexample
    assert worst.distance == pytest.approx(0.04743416490252569, abs=1e-4)
    assert np.abs(np.abs(worst.state) - [0.95, 1.0]).max() < 1e-3
    assert worst.normal @ worst.next_state > worst.offset
    assert report.lost_by_law == pytest.approx(0.02, abs=1e-6)
    assert smallest_horizon(problems.lecture(), 5).horizon == 4


def lecture_weaker():
    """|u| ≤ 0.3, N = 3: the law stays although not every feasible move does."""
    report = jm.recursive_feasibility(problems.lecture(0.3), steps=2)
    assert (report.weak.holds, report.strong.holds, report.law.holds) == (True, False, True)


def lecture_penalty():
    """rho_bar = 11.25 at (−1/4, −3/5), by the state row at k = 3; 2(r u_max − q) for a scalar."""
    found = jm.explicit.exact_penalty(problems.lecture())
    assert found.exact and found.rho_bar == pytest.approx(11.25, rel=1e-6)
    np.testing.assert_allclose(np.abs(found.at), [0.25, 0.6], atol=1e-6)
    assert found.row.stage == 3
    system = jm.LinearSystem(np.eye(1), np.eye(1))
    for q, r, u_max, rho in ((1.0, 2.0, 1.0, 2.0), (1.0, 5.0, 0.5, 3.0), (3.0, 1.0, 1.0, 0.0)):
        mpc = jm.MPC(
            system=system, Q=np.eye(1), R=r * np.eye(1), horizon=1,
            inputs=problems.symmetric(u_max),
            terminal_cost=q * np.eye(1), terminal_set=problems.symmetric(1.0),
        )  # fmt: skip
        assert jm.explicit.exact_penalty(mpc).rho_bar == pytest.approx(rho, abs=1e-6)


def joint_sets():
    """The joint: C_inf = X_5 = X_20 of area 1489/125; without the limit at k = 0, 1789/125."""
    for N, area in ((1, 11.96), (4, 11.9136), (5, 11.912)):
        assert jm.feasible_polytope(problems.joint(N)).volume() == pytest.approx(area, abs=1e-9)
    mpc = problems.joint()
    body = jm.sets.maximal_control_invariant_set(mpc.system, mpc.states, mpc.inputs)
    assert body.exact and body.iterations == 5 and len(body.vertices()) == 14
    assert body.volume() == pytest.approx(1489 / 125, abs=1e-9)
    for steps, area in (
        (range(21), 1489 / 125),
        (range(20), 1489 / 125),
        (range(1, 21), 1789 / 125),
    ):
        whole = jm.feasible_polytope(
            jm.MPC(mpc.system, mpc.Q, mpc.R, 20, mpc.states, mpc.inputs,
                   constrained_stages=tuple(steps))
        )  # fmt: skip
        assert whole.volume() == pytest.approx(area, abs=1e-8)


def joint_needle():
    """N = 4: 0.0134 % of the area is lost; the search finds (1.444, 2) → (1.464, 1.6)."""
    report = jm.recursive_feasibility(problems.joint(4), steps=1, max_regions=0)
    worst = report.counterexample
    assert report.law.holds is False and worst.distance == pytest.approx(0.0039968, abs=1e-5)
    np.testing.assert_allclose(np.abs(worst.state), [1.444, 2.0], atol=1e-3)


def joint_recursion():
    """N = 5: the law stays, not every move; N = 6: every move does."""
    five = jm.recursive_feasibility(problems.joint(5), steps=1)
    assert [c.holds for c in (five.weak, five.strong, five.law)] == [True, False, True]
    six = jm.recursive_feasibility(problems.joint(6), steps=1, max_regions=0)
    assert [c.holds for c in (six.weak, six.strong, six.law)] == [True, True, True]


def joint_lqr():
    """DARE, O_inf and the ellipsoid of the joint."""
    mpc = problems.joint()
    law = jm.lqr(mpc.system, mpc.Q, mpc.R)
    np.testing.assert_allclose(law.K, K_DARE, rtol=1e-9)
    np.testing.assert_allclose(law.P, P_DARE, rtol=1e-9)
    body = jm.maximal_invariant_set(mpc.system, law.K, mpc.states, mpc.inputs)
    assert body.index == 3 and len(body.vertices()) == 10
    assert body.volume() == pytest.approx(0.9473310116683459, rel=1e-8)
    ellipsoid = jm.sets.invariant_ellipsoid(mpc.system, law.K, law.P, mpc.states, mpc.inputs)
    assert ellipsoid.level == pytest.approx(1.4137628195913876, rel=1e-8)
    assert ellipsoid.volume() == pytest.approx(0.10389475972612443, rel=1e-8)
    assert ellipsoid.contraction == pytest.approx(0.9168846938332548, rel=1e-8)


# Area of X_N with terminal set O_inf.
GROWTH = {5: 2.8660955786866498, 20: 5.523166981610873, 60: 11.740489512145142}


def joint_o_inf():
    """X_N with terminal set O_inf grows by 0.8 for 5 steps; 22 vertices at N = 20."""
    growth = feasible_growth(problems.joint_o_inf(), tuple(GROWTH))
    np.testing.assert_allclose(growth.volume, list(GROWTH.values()), rtol=1e-8)
    np.testing.assert_array_equal(growth.facets, [16, 22, 16])


def hidden_product():
    """Two joints behind a change of coordinates: volume 70.661984, 34 facets, 280 vertices."""
    body = jm.feasible_polytope(problems.hidden_product())
    assert body.volume() == pytest.approx(problems.VOLUME_PRODUCT, rel=1e-8)
    assert len(body.h) == 34 and len(body.vertices()) == 280


def hidden_product_12d():
    """10,000 states at relative distances down to 5e-5: none wrong, none undecided."""
    sys.path.append(str(Path(__file__).parents[2] / "experiments"))
    module = importlib.import_module("hidden_product")
    found = module.run(module.Settings())
    assert found["wrong"] == found["undecided"] == 0 and found["feasible"] > 4000


FAST = (
    double_integrator, double_integrator_lqr, lecture_penalty, joint_lqr, hidden_product,
)  # fmt: skip
# Recursion and sets have fast tests of their own.
SLOW = (
    joint_recursion, lecture_weaker, lecture_recursion, joint_needle, hidden_product_12d,
    lecture_sets, joint_sets, joint_o_inf, scalar_integrator,
)  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(
    "case",
    [*FAST, *(pytest.param(case, marks=pytest.mark.slow) for case in SLOW)],
    ids=lambda case: case.__name__,
)
def test_case(case):
    """Each quantity within the tolerance of its case."""
    case()
