"""The closed loops of the public collection: some samples of a few of them, and the judge itself.

All of them: `python experiments/public_loops.py`.
"""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

FILE = Path(__file__).parents[2] / "experiments" / "public_loops.py"
spec = importlib.util.spec_from_file_location("public_loops", FILE)
public = importlib.util.module_from_spec(spec)
sys.modules["public_loops"] = public  # dataclasses look themselves up there
spec.loader.exec_module(public)

# Of the aircraft's loop 12: the angle of attack is at its limit −0.5, and by rounding beyond it.
ON_LIMIT = [-821.4524898810853, -0.5 - 2.754e-13, -6.855089141963495, 7.09269203997036]


@pytest.fixture(scope="module")
def loops():
    return {one.name: one for one in (*public.aircraft(), *public.small_examples())}


def follow(one, samples):
    with jax.enable_x64(True):
        return public.follow(one, samples)


@pytest.mark.slow
def test_aircraft_rides_on_the_limit_of_a_state(loops):
    """A limit of x_0, which no input moves, exceeded by rounding is no proof of anything."""
    descent = replace(loops["aircraft 12"], x0=np.array(ON_LIMIT), references=((20, np.zeros(4)),))
    record = follow(descent, 20)
    assert (record.found, record.others) == (20, ())
    assert record.passed


@pytest.mark.slow
def test_aircraft_without_weights_of_inputs(loops):
    """R = 0, where the outputs make the cost of the moves definite."""
    record = follow(replace(loops["aircraft 1"], references=((5, np.array([0, 0, 0, 10.0])),)), 5)
    assert record.refused == ""
    assert (record.found, record.others) == (5, ())
    assert record.passed


def test_judge(loops):
    """It sees a limit missed by 1e-3 and an input off by 1e-2."""
    one = loops["FiOrdOs 2"]
    statement = public.Statement(one.mpc)
    r = statement.target(np.zeros(2), np.zeros(1))
    w = statement.solve(one.x0, r)
    assert max(statement.violations(w, one.x0)) < 1e-8
    low = np.min(w[1:12:2])
    assert low == pytest.approx(-0.5, abs=1e-7)  # a limit of the second state is met
    beyond = w.copy()
    beyond[1:12:2][np.argmin(w[1:12:2])] -= 1e-3
    assert statement.violations(beyond, one.x0)[0] == pytest.approx(1e-3, rel=1e-3)
    off = w.copy()
    off[-1] += 1e-2
    assert statement.violations(off, one.x0)[1] > 1e-3


def test_judge_of_an_infeasible_state(loops):
    pytest.importorskip("piqp")  # asked where Clarabel finds nothing
    statement = public.Statement(loops["FiOrdOs 2"].mpc)
    r = statement.target(np.zeros(2), np.zeros(1))
    assert statement.solve(np.array([3.4, 3.0]), r) is None
