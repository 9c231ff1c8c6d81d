"""Limits of joints and outputs as sets."""

import numpy as np
import pytest

from jaxmpc import LinearSystem
from jaxmpc.sets.limits import joint_limits, output_limits

INF = np.inf


def test_joint_limits_are_problem_5():
    q_min, q_max, dq = np.array([-1.5, -2.0]), np.array([1.5, 0.5]), np.array([2.0, 3.0])
    limits = joint_limits((q_min, q_max), (-dq, dq), torque=2)
    S_q, S_dq = np.hstack([np.eye(2), np.zeros((2, 2))]), np.hstack([np.zeros((2, 2)), np.eye(2)])
    np.testing.assert_array_equal(limits.states.H, np.vstack([S_q, -S_q, S_dq, -S_dq]))
    np.testing.assert_array_equal(limits.states.h, np.concatenate([q_max, -q_min, dq, dq]))
    assert limits.states.labels == (
        "q1 <= 1.5 rad", "q2 <= 0.5 rad", "q1 >= -1.5 rad", "q2 >= -2 rad",
        "dq1 <= 2 rad/s", "dq2 <= 3 rad/s", "dq1 >= -2 rad/s", "dq2 >= -3 rad/s",
    )  # fmt: skip
    np.testing.assert_array_equal((limits.inputs.lower, limits.inputs.upper), ([-2, -2], [2, 2]))
    system = LinearSystem(np.eye(4), np.ones((4, 2)), **limits.names)
    system.validate()
    assert system.state_labels == ("q1 [rad]", "q2 [rad]", "dq1 [rad/s]", "dq2 [rad/s]")
    assert system.input_labels == ("tau1 [N m]", "tau2 [N m]")
    only = joint_limits(position=(-INF, 1), names=("lift",), units=("m", "m/s", "N"))
    assert only.states.labels == ("lift <= 1 m",) and only.inputs.support([1.0]) == INF
    assert only.state_names == ("lift", "lift velocity") and only.input_units == ("N",)
    assert joint_limits(velocity=1).states.labels == ("dq1 <= 1 rad/s", "dq1 >= -1 rad/s")
    mixed = joint_limits(1, names=("a", "b"), units=(("rad", "m"), ("rad/s", "m/s"), ("N m", "N")))
    assert mixed.states.labels[:2] == ("a <= 1 rad", "b <= 1 m")
    assert joint_limits().states.H.shape == (0, 2)


def test_output_limits_are_rows_of_C():
    C = np.array([[1.0, 2.0], [0.0, -1.0]])
    limits = output_limits(C, [-1, -INF], [3, 4], ("y", "z"), ("m", ""))
    np.testing.assert_array_equal(limits.H, [[1, 2], [0, -1], [-1, -2]])
    np.testing.assert_array_equal(limits.h, [3, 4, 1])
    assert limits.labels == ("y <= 3 m", "z <= 4", "y >= -1 m")
    assert output_limits(C, None, 1).labels == ("y1 <= 1", "y2 <= 1")
    assert output_limits(C, None, None).H.shape == (0, 2)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: joint_limits([1, 2, 3]), "position: .* is not a pair"),
        (lambda: joint_limits((1, -1)), r"position: is empty: lower\[0\] = 1"),
        (lambda: joint_limits(-1), "position: -1 is negative. Give v ≥ 0"),
        (
            lambda: joint_limits(1, torque=[5, 10], names=("a", "b")),
            r"torque: .5, 10. leaves out 0 .* Give \(\[-5, -10\], \[5, 10\]\) for one limit each, "
            r"\(\[5, 5\], \[10, 10\]\) for lower",
        ),
        (lambda: joint_limits(([-1, -1], [1, 1]), (-2, -1)), "velocity: .-2, -1. leaves out 0"),
        (lambda: joint_limits(torque=(1, -1)), "torque: is empty"),
        (lambda: joint_limits(velocity=np.nan), "velocity.lower: holds NaN"),
        (lambda: joint_limits(([-1, -1], [1, 1]), ([-1] * 3, 1)), "position: 2 entries for 3"),
        (lambda: joint_limits(([-1, -1], 1), names=("q",)), "position: 2 entries for 1"),
        (lambda: joint_limits(1, units="rad"), "units: "),
        (lambda: joint_limits(1, units=(("rad", "m"), "", "")), "units: .* does not fit 1"),
        (lambda: output_limits([1, 2], 0, 1), r"C: shape \(2,\) is not \(p, n\)"),
        (lambda: output_limits([[1, 2]], [0, 0], 1), r"limits.lower: shape \(2,\) is not \(1,\)"),
        (lambda: output_limits([[1, 2]], 0, 1, "y"), "names: 'y' is not a list. Give a list of"),
        (lambda: output_limits([[np.inf, 2]], 0, 1), "C: holds NaN"),
    ],
)
def test_limits_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()
