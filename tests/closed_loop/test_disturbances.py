"""Sequences of disturbances, and closed loops that keep all limits under them."""

import numpy as np
import pytest
from jax import enable_x64

import jaxmpc as jm
from jaxmpc.closed_loop import draw_disturbances, worst_disturbance

SYSTEM = jm.LinearSystem([[1.0, 1.0], [0.0, 1.0]], [[0.5], [1.0]])
X, U = jm.Box([-5.0, -2.0], [5.0, 2.0]), jm.Box([-1.0], [1.0])
E = np.array([[0.5], [1.0]])


def robust(size: float, **fields) -> jm.MPC:
    W = jm.Box([-size], [size])
    K = jm.lqr(SYSTEM, np.eye(2), 0.1).K
    last = jm.maximal_invariant_set(SYSTEM, K, X, U, disturbance=W, disturbance_matrix=E)
    given = {"disturbance": W, "disturbance_matrix": E, "terminal_set": last}
    return jm.MPC(SYSTEM, np.eye(2), 0.1, 4, X, U, **{**given, **fields})


def test_sequences():
    mpc = robust(0.2)
    w = draw_disturbances(mpc, 7, 5)
    assert w.shape == (5, 7, 2)
    np.testing.assert_allclose(np.abs(w @ [0.0, 1.0]), 0.2, atol=1e-15)
    np.testing.assert_allclose(w[:, :, 0], 0.5 * w[:, :, 1], atol=1e-15)
    inside = draw_disturbances(mpc, 7, 500, kind="inside")
    assert np.abs(inside[:, :, 1]).max() <= 0.2 and np.std(inside[:, :, 1]) < 0.15
    with pytest.raises(ValueError, match="kind: 'worst'"):
        draw_disturbances(mpc, 7, 5, kind="worst")
    with pytest.raises(ValueError, match="mpc: has no disturbance"):
        draw_disturbances(jm.MPC(SYSTEM, np.eye(2), 0.1, 4, X, U), 7, 5)


class Overflows:
    """A plant whose next state is no number."""

    def step(self, x, u):
        return x * np.nan


def test_starts_may_be_lists_and_a_loop_that_overflows_has_no_distance():
    mpc = robust(0.2, terminal_set=None, gain=np.array([[-0.6, -1.0]]))
    law = jm.closed_loop.LinearFeedback(mpc, [[-0.6, -1.0]])
    found, beyond = worst_disturbance(law, [0.5, 0.0], 4, seed=1)
    same, as_array = worst_disturbance(law, np.array([0.5, 0.0]), 4, seed=1)
    np.testing.assert_array_equal(found, same)
    assert beyond == as_array < 0
    sequence, beyond = worst_disturbance(law, [0.5, 0.0], 4, plant=Overflows(), seed=1)
    first = draw_disturbances(mpc, 4, 1, seed=1)[0]
    assert np.isnan(beyond)
    np.testing.assert_array_equal(sequence, first)  # the one that did that, and none after it
    drawn, of_drawn = worst_disturbance(law, [0.5, 0.0], 4, rounds=1, seed=1)
    np.testing.assert_array_equal(drawn, first)  # no step by the gradient
    assert of_drawn <= as_array


@pytest.mark.slow
def test_no_sequence_breaks_a_limit():
    """From a state near a limit; the sequence found by gradient is no better than random ones."""
    x0 = np.array([-4.2, 1.55])
    with enable_x64():
        strong = jm.Controller(robust(0.2))
        sequence, beyond = worst_disturbance(strong, x0, 6)
        assert sequence.shape == (6, 2) and beyond <= 1e-6
        both, top = worst_disturbance(strong, np.stack([x0, x0 / 2]), 6)
        assert both.shape == (2, 6, 2) and top <= beyond + 1e-9
        run = jm.simulate(strong, SYSTEM, x0, 6, disturbance=sequence)
        assert float(run.violation.max()) <= 1e-6 and np.all(run.status == jm.Status.SOLVED)
        for w in draw_disturbances(robust(0.2), 6, 20):
            run = jm.simulate(strong, SYSTEM, x0, 6, disturbance=w)
            assert float(run.violation.max()) <= 1e-6 and np.all(run.status == jm.Status.SOLVED)
            assert float(run.states[1:, 1].max() - 2.0) <= beyond + 1e-6
