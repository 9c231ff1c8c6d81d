"""Numbers that JAX does not read: results are those of the same numbers in float64.

Files hold them: `.mat`, FITS and HDF5 of machines with the other byte order, `np.longdouble`; other
libraries do: tables of pandas, tensors of torch, sparse matrices of SciPy.
"""

from dataclasses import replace

import jax
import numpy as np
import pandas as pd
import pytest
import scipy.sparse

import jaxmpc as jm

STATE, STATES = [0.5, 0.1], [[0.5, 0.1], [0.4, -0.2], [-3.0, 0.0]]


def problem(cast):
    A, B = cast([[1, 0.1], [0, 1]]), cast([[0], [0.1]])
    return jm.MPC(
        jm.LinearSystem(A, B, dt=0.1), cast(np.eye(2)), cast([[1]]), 5,
        states=jm.Box(cast([-1, -1]), cast([1, 1])), inputs=jm.Box(cast([-1]), cast([1])),
        terminal_cost=cast([3, 4]), input_rate_limit=cast([0.5]), input_rate_weight=cast([[0.1]]),
    )  # fmt: skip


def program(cast):
    rows = cast([[1, 0], [0, 1]])
    return jm.QP(cast([[2, 0], [0, 1]]), cast([1, 1]), rows, cast([-1, -0.5]), cast([1, 1]))


def sparse():
    qp = program(np.asarray)
    return replace(qp, P=scipy.sparse.csc_matrix(qp.P), A=scipy.sparse.coo_matrix(qp.A))


def tuned(cast):
    mpc = replace(problem(np.asarray), input_rate_limit=None, input_rate_weight=None)
    parameters = {"Q": jm.Parameter(cast(np.eye(2)), "diagonal")}
    make = lambda v: replace(mpc, Q=v["Q"])
    return jm.tune_weights(make, parameters, mpc.system, cast(STATES), steps=2, updates=1).values


def mapped(cast):
    points = np.hstack([STATES, np.zeros((3, 1))])
    return jm.map_feasible_set(problem(cast), cast(points)).label


def looped(cast):
    mpc, x = problem(cast), cast(STATES[:2])
    return jm.simulate_many(jm.Controller(mpc), mpc.system, x, 2, references=x).states


CALLS = {
    "map": mapped,
    "program": lambda c: program(c).dense(),
    "inside jit": lambda c: jax.jit(jax.tree.leaves)(jm.mpc.soften(problem(c), c(50.0))),
    "set": lambda c: jm.Polytope(c([[1, 0], [0, 1], [-1, -1]]), c([1, 1, 1])).volume(),
}
SLOW = {
    "plan": lambda c: jm.solve(problem(c), c(STATE), c(STATE), previous_input=c([0.0])).inputs,
    "plans": lambda c: jm.solve_many(problem(c), c(STATES)).inputs,
    "solution": lambda c: jm.solve_qp(program(c)).z,
    "margin": lambda c: jm.qp.feasibility_margin(program(c), c([1, 2]))[0],
    "sparse": lambda c: jm.qp.feasibility_margin(sparse(), c([1, 2]))[0],
    "loops": looped,
    "tuned": tuned,
}


class Tensor:
    """An array as torch has it: NumPy reads it, its type is none of NumPy's."""

    def __init__(self, values):
        self.values, self.dtype = np.asarray(values), "tensors.float64"
        self.shape, self.ndim = self.values.shape, self.values.ndim

    def __array__(self, dtype=None, copy=None):
        return np.asarray(self.values, dtype)

    def __len__(self):
        return len(self.values)

    def __getitem__(self, index):
        return Tensor(self.values[index])


def table(values):
    return {1: pd.Series, 2: pd.DataFrame}.get(np.ndim(values), np.asarray)(values)


def sparse_matrix(values):
    return scipy.sparse.csc_array(values) if np.ndim(values) == 2 else np.asarray(values)


KINDS = {
    "other byte order": lambda v: np.asarray(v).astype(">f8"),
    "longdouble": lambda v: np.asarray(v).astype(np.longdouble),
    "table": table,
    "tensor": Tensor,
    "sparse": sparse_matrix,
}


def same(call):
    wanted = call(np.asarray)
    for cast in KINDS.values():
        jax.tree.map(np.testing.assert_array_equal, call(cast), wanted)


@pytest.mark.parametrize("call", CALLS.values(), ids=CALLS)
def test_results_are_those_in_float64(call):
    same(call)


@pytest.mark.slow
@pytest.mark.parametrize("call", SLOW.values(), ids=SLOW)
def test_more_results_are_those_in_float64(call):
    same(call)


@pytest.mark.parametrize("entry", [object(), "a", 1j])
def test_entries_that_are_no_numbers(entry):
    with pytest.raises(ValueError, match="x0s: entries of type .* where real numbers are needed"):
        jm.map_feasible_set(problem(np.asarray), np.full((2, 3), entry))


def test_the_cure_for_numbers_in_an_array_of_objects():
    mixed = np.array([[0.5, 0.1, 0.0, "a name"]], dtype=object)[:, :3]
    with pytest.raises(ValueError, match=r"np.asarray\(..., dtype=float\)"):
        jm.map_feasible_set(problem(np.asarray), mixed)
    assert jm.map_feasible_set(problem(np.asarray), np.asarray(mixed, dtype=float)).label.size == 1


def test_steps_in_float64_where_jax_has_none_are_silent():
    """They are in float32 then, as the plan is, and no warning says so."""
    plan = jm.solve_qp(program(np.asarray), jm.ADMM(20, newton_steps=0, dtype="float64"))
    assert plan.z.dtype == np.float32
