"""Vectors and numbers stand for matrices wherever they have one meaning."""

import numpy as np
import pytest

import jaxmpc as jm


def test_a_vector_is_one_input_in_continuous_time():
    A, B = [[0, 1], [0, -0.5]], [0, 1]
    found = jm.LinearSystem.from_continuous(A, B, dt=0.1)
    wanted = jm.LinearSystem.from_continuous(A, [[0], [1]], dt=0.1)
    np.testing.assert_array_equal(found.B, wanted.B)
    assert found.B.shape == (2, 1)


def test_weights_of_verify_terminal():
    system = jm.LinearSystem([[1, 0.1], [0, 1]], [0, 0.1])
    X, U = jm.Box([-1, -1], [1, 1]), jm.Box(-1, 1)
    law = jm.lqr(system, [1, 1], 0.1)
    found = jm.sets.verify_terminal(system, [1, 1], 0.1, law.P, X, X, U)
    wanted = jm.sets.verify_terminal(system, np.eye(2), [[0.1]], law.P, X, X, U)
    assert str(found) == str(wanted)


def test_limits_of_design_are_joint_limits():
    system, X = jm.LinearSystem([[1, 0.1], [0, 1]], [0, 0.1]), jm.Box([-1, -1], [1, 1])
    with pytest.raises(ValueError, match="limits: is a tuple. Give what jm.joint_limits returns"):
        jm.design(system, [1, 1], 0.1, 5, limits=(X, jm.Box(-1, 1)))
