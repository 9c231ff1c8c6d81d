"""The hypotheses of the stability theorems, against closed forms and rationals."""

from fractions import Fraction

import exact
import numpy as np
import pytest
from plants import JOINT, UNSTABLE
from problems import symmetric

from jaxmpc import Box, LinearSystem, lqr, maximal_invariant_set
from jaxmpc.sets.control_invariant import (
    maximal_control_invariant_set,
)
from jaxmpc.sets.convex_sets import Ellipsoid
from jaxmpc.sets.invariant import invariant_ellipsoid
from jaxmpc.sets.terminal_hypotheses import _exact_factor, _Loop, _Rows, verify_terminal

INF = np.inf


def joint_arguments(terminal_set, **changes):
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    return {
        "system": JOINT, "Q": Q, "R": R, "terminal_cost": lqr(JOINT, Q, R).P,
        "terminal_set": terminal_set, "states": symmetric(1.5, 2), "inputs": symmetric(2),
    } | changes  # fmt: skip


def test_terminal_set_of_the_joint_and_its_certificate():
    K = lqr(JOINT, np.diag([50.0, 1.0]), np.array([[0.1]])).K
    terminal = maximal_invariant_set(JOINT, K, symmetric(1.5, 2), symmetric(2))
    report = verify_terminal(**joint_arguments(terminal))
    assert report.recursive_feasibility is True and report.stability is True
    assert all(check.holds for check in report.checks)
    assert "Theorem 1 (recursive feasibility) applies." in str(report)
    assert str(report).startswith(
        "With limits of inputs and states, outputs C x among these, none of rates, moves free"
    )
    assert len(str(report).splitlines()) == 3 + 2 * len(report.checks)
    # M >= 0, M H = H (A + BK), M h <= h, in rationals; the set's rows were rounded themselves
    M, H, h, A, B, K = (
        exact.rational(part)
        for part in (report.certificate, terminal.H, terminal.h, JOINT.A, JOINT.B, report.K)
    )
    closed = [[A[i][j] + B[i][0] * K[0][j] for j in range(2)] for i in range(2)]
    columns = list(zip(*H, strict=True))
    for i, weights in enumerate(M):
        assert min(weights) >= 0
        assert exact.dot(weights, h) <= h[i] * (1 + Fraction(1, 10**14))
        for j in range(2):
            image = exact.dot(H[i], [row[j] for row in closed])
            assert abs(exact.dot(weights, columns[j]) - image) <= Fraction(1, 10**14)
    assert report.exact_factor <= 1 and "is at most 1" in report["invariance under K"].sentence
    # the ellipsoid of the same law
    ellipsoid = invariant_ellipsoid(
        JOINT, report.K, lqr(JOINT, np.diag([50.0, 1.0]), np.array([[0.1]])).P,
        symmetric(1.5, 2), symmetric(2),
    )  # fmt: skip
    report = verify_terminal(**joint_arguments(ellipsoid, terminal_cost=None))
    assert report.recursive_feasibility is True and report.stability is True
    assert report.factor == pytest.approx(0.9168846938332548, rel=1e-12)
    assert "rational arithmetic" in report["invariance under K"].sentence
    assert report["inputs of K admissible"].margin == pytest.approx(0, abs=1e-12)
    larger = Ellipsoid(ellipsoid.P, 4 * ellipsoid.level)
    report = verify_terminal(**joint_arguments(larger))
    assert report["inputs of K admissible"].margin == pytest.approx(-2, abs=1e-12)
    assert report["control invariance"].holds is None and report.recursive_feasibility is None
    assert report.stability is False


def test_rounding_takes_no_invariant_set_out_of_itself():
    """The exact factor of sets whose rows round, under a load as in notebook 09."""
    system = LinearSystem([[1, 0.05], [0, 0.7]], [[0.012], [0.43]])
    states, inputs, load = symmetric(1.5, 2), symmetric(2), symmetric(0.6)
    K = lqr(system, np.diag([50.0, 1.0]), [[2.0]]).K
    for against in ({}, {"disturbance": load, "disturbance_matrix": system.B}):
        X_f = maximal_invariant_set(system, K, states, inputs, **against)
        Q, R = np.diag([50.0, 1.0]), np.array([[2.0]])
        report = verify_terminal(system, Q, R, None, X_f, states, inputs, K, **against)
        assert report["invariance under K"].holds and report.exact_factor <= 1


def test_control_invariance_is_enough_for_theorem_1():
    terminal = maximal_control_invariant_set(JOINT, symmetric(1.5, 2), symmetric(2))
    report = verify_terminal(**joint_arguments(terminal))
    assert report.recursive_feasibility is True and report.stability is False
    assert report["invariance under K"].holds is False
    assert report["inputs of K admissible"].margin < -20
    report = verify_terminal(**joint_arguments(None))
    assert report.recursive_feasibility is False
    assert "[1.5, 2. ]" in report["control invariance"].sentence


def test_lower_limits_are_written_as_such():
    """x >= -1 is the tightest, not -1 x <= 1: the set ends there, and 3 before the upper limit."""
    arguments = {
        "system": UNSTABLE, "Q": np.eye(1), "R": np.eye(1), "terminal_cost": None,
        "terminal_set": symmetric(1), "states": Box([-1], [4]), "inputs": symmetric(2),
    }  # fmt: skip
    sentence = verify_terminal(**arguments)["terminal set within states"].sentence
    assert sentence == "The tightest limit, x1 >= -1, is reached up to -1 on the terminal set."


def test_rational_certificates_of_dyadic_data():
    # |x| <= 1 under diag(1/2, -1/4) plus a coupling of 1/4: 3/4 in the first row, exactly
    system = LinearSystem([[0.5, 0.25], [0, -0.25]], [[0.0], [1.0]])
    arguments = {
        "system": system, "Q": np.eye(2), "R": np.eye(1), "terminal_cost": 4 * np.eye(2),
        "terminal_set": symmetric(1, 1), "states": symmetric(1, 1), "inputs": symmetric(1),
        "K": np.zeros((1, 2)),
    }  # fmt: skip
    report = verify_terminal(**arguments)
    assert report.exact_factor == Fraction(3, 4) and report.factor == 0.75
    assert report.stability is True
    report = verify_terminal(**arguments, disturbance=Box([-0.25, 0], [0.25, 0.125]))
    assert "Theorem 3 is about w = 0: under the disturbance x need not converge." in str(report)
    assert report.exact_factor == 1 and report["invariance under K"].holds is True
    report = verify_terminal(**arguments, disturbance=symmetric(0.5, 0))
    assert report.exact_factor == Fraction(5, 4)
    assert report["invariance under K"].margin == pytest.approx(-0.25)
    # no input acts against the first coordinate
    assert report["control invariance"].holds is False
    report = verify_terminal(**(arguments | {"K": [[0.0, 1.25]]}))
    assert report.exact_factor == 1 and report["inputs of K admissible"].margin == -0.25


def test_rational_bound_charges_the_residual():
    # Without multipliers all of H (A+BK) x is residual: |x| <= 1, up to the LPs' margin, bounds it.
    data = np.array([[0.5, 0.25], [0.0, -0.25]]), np.zeros((2, 1)), np.zeros((1, 2))
    body = _Rows(np.vstack([np.eye(2), -np.eye(2)]), np.ones(4))
    factor = _exact_factor(np.zeros((4, 4)), body, _Loop(*data, np.zeros(2), None))
    assert Fraction(3, 4) <= factor <= Fraction(3, 4) * (1 + Fraction(1, 10**5))


def test_invariance_of_a_set_without_bound():
    """|x_2| ≤ 1 with x_2+ = 0.69 x_2, x_1 free: kept, with the factor in rationals, not a crash."""
    system = LinearSystem([[0.3, 0.1], [0.0, 0.7]], [[0.0], [0.1]])
    strip = Box([-np.inf, -1], [np.inf, 1])
    report = verify_terminal(
        system, np.eye(2), np.eye(1), None, strip, strip, symmetric(1), K=[[0.0, -0.1]]
    )
    assert report["invariance under K"].holds
    assert report.exact_factor == pytest.approx(0.69, rel=1e-14)
    assert report["states compact"].holds is False


def scalar_report(**changes):
    """x+ = x/2 + u, u = x/4, so that x+ = 3/4 x; Q = R = 1, P = 4 and |x_N| <= 1."""
    arguments = {
        "system": LinearSystem([[0.5]], [[1.0]]), "Q": [[1.0]], "R": [[1.0]],
        "terminal_cost": [[4.0]], "terminal_set": symmetric(1), "states": symmetric(2),
        "inputs": symmetric(1), "K": [[0.25]],
    }  # fmt: skip
    return verify_terminal(**(arguments | changes))


@pytest.mark.parametrize(
    ("changes", "name", "holds", "margin"),
    [
        ({}, "terminal set within states", True, 1.0),
        ({}, "invariance under K", True, 0.25),
        ({}, "inputs of K admissible", True, 0.75),
        ({}, "Lyapunov inequality", True, 11 / 16),
        ({"states": Box([-INF], [2])}, "states compact", False, -INF),
        ({"states": None}, "states compact", False, -INF),
        ({"inputs": None}, "inputs compact", False, -INF),
        ({"terminal_set": symmetric(2.5)}, "terminal set within states", False, -0.5),
        ({"terminal_set": Ellipsoid([[4.0]], 25.0)}, "terminal set within states", False, -0.5),
        ({"K": [[0.75]]}, "invariance under K", False, -0.25),
        ({"K": [[0.75]]}, "control invariance", True, 3.0),
        ({"K": [[0.75]], "terminal_set": Ellipsoid([[4.0]], 4.0)}, "invariance under K", False,
         1 - 1.25**2),
        ({"K": [[-1.25]]}, "inputs of K admissible", False, -0.25),
        ({"K": [[-1.25]], "terminal_set": Ellipsoid([[4.0]], 4.0)}, "inputs of K admissible",
         False, -0.25),
        ({"terminal_cost": [[2.0]]}, "Lyapunov inequality", False, -3 / 16),
        ({"terminal_cost": [[-1.0]]}, "terminal cost positive semidefinite", False, -1.0),
        ({"Q": [[-1.0]]}, "Q positive semidefinite", False, -1.0),
        ({"R": [[0.0]]}, "R positive definite", False, 0.0),
        ({"Q": [[0.0]]}, "detectability", True, INF),
        ({"Q": [[0.0]], "system": LinearSystem([[1.0]], [[1.0]])}, "detectability", False, 0.0),
        ({"system": LinearSystem([[0.5]], [[1.0]], c=[0.125])}, "origin is an equilibrium",
         False, -0.125),
        ({"system": LinearSystem([[0.5]], [[1.0]], c=[0.5])}, "invariance under K", False, -0.25),
        ({"terminal_set": Box([0], [1])}, "origin inside terminal set", False, 0.0),
        ({"terminal_set": Box([0.25], [1])}, "origin inside terminal set", False, -0.25),
        ({"disturbance": symmetric(0.25)}, "invariance under K", True, 0.0),
        ({"disturbance": symmetric(0.5)}, "invariance under K", False, -0.25),
        ({"disturbance": symmetric(0.5)}, "control invariance", True, 2.0),
        ({"disturbance": symmetric(0.25), "terminal_set": Ellipsoid([[4.0]], 4.0)},
         "invariance under K", True, 0.0),
        ({"disturbance": symmetric(0.5), "terminal_set": Ellipsoid([[4.0]], 4.0)},
         "invariance under K", None, -0.25),
        ({"terminal_set": symmetric(0)}, "invariance under K", True, 0.0),
        # 2x + u in [-2, 2] asks |x| <= 1.5: a quarter of the extent is lost
        ({"system": UNSTABLE, "terminal_set": symmetric(2), "K": [[-1.0]]}, "control invariance",
         False, -0.25),
        ({"system": UNSTABLE, "terminal_set": None, "K": [[-1.0]]}, "control invariance", False,
         -0.25),
        ({"system": LinearSystem([[1.0]], [[1.0]]), "terminal_set": None, "K": [[-1.0]]},
         "control invariance", True, 0.5),
        ({"states": None, "inputs": None, "terminal_set": None}, "control invariance", True, INF),
    ],
)  # fmt: skip
def test_each_hypothesis(changes, name, holds, margin):
    report = scalar_report(**changes)
    check = report[name]
    assert check.holds is holds
    assert check.margin == pytest.approx(margin, abs=1e-12)
    if not holds:
        verdicts = {1: report.recursive_feasibility, 3: report.stability}
        assert not any(verdicts[number] for number in check.theorems)
        assert f"{'NO' if holds is False else '?'}  {name}" in str(report)


def test_terminal_report_without_a_law():
    report = scalar_report(K=None, terminal_cost=None)
    assert report.stability is True
    report = scalar_report(K=None, terminal_cost=None, Q=[[-1.0]])
    assert report["invariance under K"].holds is None and report.K is None
    assert report["control invariance"].holds is True and report.recursive_feasibility is True
    assert report.stability is False and "lqr has no answer" in str(report)
    # the law that is given is the one checked, also where lqr supplies the cost
    assert scalar_report(terminal_cost=None).K == [[0.25]]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"Q": [[1.0, 0.0]]}, "Q: shape"),
        ({"K": [[1.0, 0.0]]}, "K: shape"),
        ({"terminal_set": 1.0}, "terminal_set: float is no convex set"),
        ({"terminal_set": symmetric(1, 1)}, "terminal_set: has dimension 2"),
        ({"states": Box([1], [0])}, "states: is empty"),
    ],
)
def test_terminal_errors(changes, message):
    with pytest.raises(ValueError, match=message):
        scalar_report(**changes)
    with pytest.raises(ValueError, match="is no check"):
        scalar_report()["nonsense"]


def test_results_print_in_a_few_lines():
    report = scalar_report(K=[[0.75]])
    assert repr(report).splitlines() == str(report).splitlines()[:3]
    assert "invariance under K" in repr(report).splitlines()[2]
    system = LinearSystem([[0.5]], [[1.0]])
    found = maximal_invariant_set(system, [[0.25]], symmetric(1), symmetric(1))
    assert repr(found).startswith("InvariantSet(") and "index=0" in repr(found)
    inner = maximal_control_invariant_set(system, symmetric(1), symmetric(1))
    assert len(repr(inner).splitlines()) <= 4
