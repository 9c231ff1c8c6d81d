"""Wrong arguments in Python: ValueError in one line that names the argument, before any compile.
What has one meaning is accepted: numbers and vectors where a matrix is needed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmpc as jm
from jaxmpc.closed_loop import draw_disturbances, worst_disturbance
from jaxmpc.pytrees import record

A, B = np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]])
S = jm.LinearSystem(A, B, dt=0.01)
x = np.zeros(2)


def mpc(**changes):
    given = {
        "system": S, "Q": np.eye(2), "R": np.eye(1), "horizon": 3,
        "states": jm.Box(np.array([-1, -1]), np.array([1, 1])),
        "inputs": jm.Box(np.array([-1]), np.array([1])),
    }  # fmt: skip
    return jm.MPC(**{**given, **changes})


def qp(**changes):
    given = {"P": np.eye(2), "q": np.zeros(2), "A": np.eye(2), "l": -np.ones(2), "u": np.ones(2)}
    return jm.QP(**{**given, **changes})


M = mpc()
BOX = M.states
LAW = jm.closed_loop.LinearFeedback(M, np.zeros((1, 2)))


def fraction(x0s=((0, 0),), **more):
    return jm.feasible.feasible_fraction(M, x0s, **more)


ROBUST = mpc(disturbance=jm.Box(-0.01, 0.01), disturbance_matrix=B, gain=np.zeros((1, 2)))
TASK = jm.mpc.Task(lambda point: point.x[0], weight=1.0)


def LOSS(run):  # noqa: N802
    return run.states[0, 0]


def solver(x0s=None, **more):
    x0s = np.zeros((12, 2)) if x0s is None else x0s
    return jm.tuning.tune_solver(M, x0s, 10, stages=2, **more)


def trade_off(losses=None, **more):
    losses = {"a": LOSS, "b": LOSS} if losses is None else losses
    given = {"Q": jm.Parameter(np.eye(2), "diagonal")}
    make = lambda v: dataclasses.replace(M, Q=v["Q"])
    return jm.tuning.trade_off(make, given, S, np.zeros((8, 2)), losses, 3, **more)


def exported(platforms):
    return jm.export.export_jax(M, "nowhere.jax", platforms=platforms)


def worst(x0):
    law = jm.closed_loop.LinearFeedback(ROBUST, np.zeros((1, 2)))
    return worst_disturbance(law, np.reshape(x0, (-1, 2)) if x0 == [] else x0, 3)


def nonlinear(task, **more):
    return jm.mpc.solve_nonlinear(jm.mpc.NonlinearMPC(M, S, (task,)), x, **more)


class Returns:
    """A plant of two states whose step returns something else."""

    n, m, state_size = 2, 1, 2

    def __init__(self, value):
        self.value = value

    def step(self, x, u):
        return self.value


def hiding(array):
    """Return the array with its first entry hidden."""
    return np.ma.array(array, mask=np.arange(array.size).reshape(array.shape) == 0)


def sweep(along, **more):
    return jm.feasible.sweep_into("nowhere", M, along, **more)


# How the answer begins, and the call.
CALLS = [
    ("mpc: is a str. Give a jm.MPC", lambda: jm.solve("x", x)),
    ("mpc: is a NoneType. Give a jm.MPC", lambda: jm.solve(None, x)),
    ("mpc: is a LinearSystem. Give a jm.MPC", lambda: jm.solve(S, x)),
    ("mpc: is a QP. Give a jm.MPC", lambda: jm.solve(qp(), x)),
    ("x0: None where real numbers are", lambda: jm.solve(M, None)),
    ("x0: 'abc' where real numbers are", lambda: jm.solve(M, "abc")),
    ("x0: entries of type <U1 where real", lambda: jm.solve(M, ["a", "b"])),
    ("x0: entries of type complex128 where", lambda: jm.solve(M, x + 1j)),
    ("x0: [1, [2, 3]] is not an array of", lambda: jm.solve(M, [1, [2, 3]])),
    ("x0: shape (3,). Give (2,)", lambda: jm.solve(M, np.zeros(3))),
    ("x0: shape (5, 2). Give (2,); use", lambda: jm.solve(M, np.zeros((5, 2)))),
    ("x0: {'q': 1, 'dq': 2} where real", lambda: jm.solve(M, {"q": 1, "dq": 2})),
    ("x0: entries of type object where real", lambda: jm.solve(M, [None, None])),
    ("x0: {1, 2} where real numbers are", lambda: jm.solve(M, {1, 2})),
    ("reference: ADMM() where real", lambda: jm.solve(M, x, jm.ADMM())),
    ("reference: 'r' where real numbers are", lambda: jm.solve(M, x, "r")),
    ("reference: entries of type complex128 where", lambda: jm.solve(M, x, x + 1j)),
    ("reference: shape (3,). Give (2,) or (4, 2)", lambda: jm.solve(M, x, np.zeros(3))),
    ("solver: is an ndarray. Give a jm.ADMM", lambda: jm.solve(M, x, None, x)),
    ("solver: is a str. Give a jm.ADMM", lambda: jm.solve(M, x, solver="osqp")),
    ("solver: is a type. Give a jm.ADMM", lambda: jm.solve(M, x, solver=jm.ADMM)),
    ("warm_start: is a str. Give a Plan or a", lambda: jm.solve(M, x, warm_start="x")),
    ("warm_start: is an ndarray. Give a Plan or a", lambda: jm.solve(M, x, warm_start=x)),
    (
        "input_reference: shape (2,). Give (1,) or (3, 1)",
        lambda: jm.solve(M, x, input_reference=np.zeros(2)),
    ),
    (
        "previous_input: shape (2,). Give (1,)",
        lambda: jm.solve(M, x, previous_input=np.zeros(2)),
    ),
    ("previous_input: 'u' where real numbers are", lambda: jm.solve(M, x, previous_input="u")),
    ("x0s: 'x' where real numbers are", lambda: jm.solve_many(M, "x")),
    ("x0s: shape (2,). Give states (B, 2)", lambda: jm.solve_many(M, x)),
    ("x0s: entries of type complex128 where", lambda: jm.solve_many(M, np.zeros((3, 2)) + 1j)),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.solve_many("M", np.zeros((3, 2)))),
    ("solver: is a str. Give a jm.ADMM", lambda: jm.solve_many(M, np.zeros((3, 2)), "s")),
    ("chunk: 0. Give a whole number of at", lambda: jm.solve_many(M, np.zeros((3, 2)), chunk=0)),
    (
        "chunk: 1.5. Give a whole number of at",
        lambda: jm.solve_many(M, np.zeros((3, 2)), chunk=1.5),
    ),
    (
        "dtype: 'int8'. Iterate in 'float32' or",
        lambda: jm.solve_many(M, np.zeros((3, 2)), dtype="int8"),
    ),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.Controller("x")(x)),
    ("mpc: is an int. Give a jm.MPC", lambda: jm.Controller(3).plan(x)),
    ("solver: is a str. Give a jm.ADMM", lambda: jm.Controller(M, "s")),
    ("qp: is an int. Give a jm.QP", lambda: jm.solve_qp(3)),
    (
        "mpc: is an int. Give a jm.MPC: controller.mpc, for an offset-free controller jm.closed",
        lambda: jm.export.export_c(3, "nowhere"),
    ),
    ("qp: is a str. Give a jm.QP", lambda: jm.solve_qp("qp")),
    ("qp: is a NoneType. Give a jm.QP", lambda: jm.solve_qp(None)),
    ("qp: is an MPC. Give a jm.QP", lambda: jm.solve_qp(M)),
    ("qp: is a tuple. Give a jm.QP", lambda: jm.solve_qp((1, 2))),
    ("solver: is an int. Give a jm.ADMM", lambda: jm.solve_qp(qp(), 3)),
    ("P: 'P' where real numbers are", lambda: jm.solve_qp(qp(P="P"))),
    ("P: None where real numbers are", lambda: jm.solve_qp(qp(P=None))),
    ("P: entries of type complex128 where", lambda: jm.solve_qp(qp(P=np.eye(2) * 1j))),
    ("P: shape (3, 3) where (2, 2) is", lambda: jm.solve_qp(qp(P=np.eye(3)))),
    ("P: is not positive semidefinite", lambda: jm.solve_qp(qp(P=-np.eye(2)))),
    ("P: is not symmetric. Use (P + P.T) /", lambda: jm.solve_qp(qp(P=[[1, 2], [1, 1.0]]))),
    ("P: is triangular, not symmetric. For", lambda: jm.solve_qp(qp(P=[[1, 2], [0, 1.0]]))),
    ("q: None where real numbers are", lambda: jm.solve_qp(qp(q=None))),
    ("q: 'q' where real numbers are", lambda: jm.solve_qp(qp(q="q"))),
    ("q: entries of type <U1 where real", lambda: jm.solve_qp(qp(q=["a", "b"]))),
    ("q: entries of type complex128 where", lambda: jm.solve_qp(qp(q=x + 1j))),
    ("q: shape (2, 2) is not (n,). Give", lambda: jm.solve_qp(qp(q=np.zeros((2, 2))))),
    ("q: holds NaN or infinity. Give", lambda: jm.solve_qp(qp(q=x * np.nan))),
    ("A: 'A' where real numbers are", lambda: jm.solve_qp(qp(A="A"))),
    ("A: shape (2,) is not (m, 2). One", lambda: jm.solve_qp(qp(A=x))),
    ("A: entries of type <U1 where real", lambda: jm.solve_qp(qp(A=[["a", "b"], ["c", "d"]]))),
    ("A: holds NaN or infinity. Give", lambda: jm.solve_qp(qp(A=np.full((2, 2), np.inf)))),
    ("l, u: row 0 has l = 2.0 and u = 1.0.", lambda: jm.solve_qp(qp(l=[2.0, 2.0]))),
    ("l, u: row 0 has l = nan and u = 1.0.", lambda: jm.solve_qp(qp(l=[np.nan, 2.0]))),
    ("l: 'l' where real numbers are", lambda: jm.solve_qp(qp(l="l"))),
    ("l: entries of type <U1 where real", lambda: jm.solve_qp(qp(l=["a", "b"]))),
    ("l: None where real numbers are", lambda: jm.solve_qp(qp(l=None))),
    ("u: entries of type complex128 where", lambda: jm.solve_qp(qp(u=x + 1j))),
    ("A: [[1, 2], [3]] is not an array of", lambda: jm.solve_qp(qp(A=[[1, 2], [3]]))),
    ("warm_start: is a str. Give a pair (z, y) or", lambda: jm.solve_qp(qp(), jm.ADMM(), "w")),
    ("warm_start: is a tuple. Give a pair (z, y) or", lambda: jm.solve_qp(qp(), jm.ADMM(), (x,))),
    (
        "warm_start z: shape (3,) where (2,) is needed.",
        lambda: jm.solve_qp(qp(), jm.ADMM(), (np.zeros(3), x)),
    ),
    (
        "soft_linear: holds a negative weight or NaN.",
        lambda: jm.solve_qp(qp(soft_linear=[-1.0, 1])),
    ),
    ("soft_linear: 's' where real numbers are", lambda: jm.solve_qp(qp(soft_linear="s"))),
    (
        "soft_quadratic: entries of type <U1 where real",
        lambda: jm.solve_qp(qp(soft_quadratic=["a", "b"])),
    ),
    ("balls, radius: (2,), None. Give both, or neither", lambda: jm.solve_qp(qp(balls=(2,)))),
    ("balls: 3. Give a tuple with the number", lambda: jm.solve_qp(qp(balls=3, radius=[1.0]))),
    ("radius: 'r' where real numbers are", lambda: jm.solve_qp(qp(balls=(2,), radius="r"))),
    ("P: None where real numbers are", lambda: jm.QP.from_qpsolvers(None, None)),
    (
        "iterations: 1.5. Give a whole number of at",
        lambda: jm.solve(M, x, solver=jm.ADMM(iterations=1.5)),
    ),
    (
        "iterations: 'x'. Give a whole number of at",
        lambda: jm.solve(M, x, solver=jm.ADMM(iterations="x")),
    ),
    (
        "iterations: 1000000000000. Give at most",
        lambda: jm.solve(M, x, solver=jm.ADMM(iterations=10**12)),
    ),
    (
        "iterations: True. Give a whole number of at",
        lambda: jm.solve(M, x, solver=jm.ADMM(iterations=True)),
    ),
    (
        "newton_steps: 1.5. Give a whole number of at",
        lambda: jm.solve(M, x, solver=jm.ADMM(newton_steps=1.5)),
    ),
    ("rho: 'x' where real numbers are", lambda: jm.solve(M, x, solver=jm.ADMM(rho="x"))),
    ("rho: holds a value that is not", lambda: jm.solve(M, x, solver=jm.ADMM(rho=0))),
    ("alpha: 2. Over-relaxation lies in (0,", lambda: jm.solve(M, x, solver=jm.ADMM(alpha=2))),
    ("alpha: 'a' where real numbers are", lambda: jm.solve(M, x, solver=jm.ADMM(alpha="a"))),
    (
        "alpha: [1.0, 1.0]. Over-relaxation lies",
        lambda: jm.solve(M, x, solver=jm.ADMM(alpha=[1.0, 1.0])),
    ),
    ("alpha: None where real numbers are", lambda: jm.solve(M, x, solver=jm.ADMM(alpha=None))),
    ("eps: -1. Tolerances are at least 0", lambda: jm.solve(M, x, solver=jm.ADMM(eps=-1))),
    ("eps: 'e' where real numbers are", lambda: jm.solve(M, x, solver=jm.ADMM(eps="e"))),
    (
        "differentiate: 'x'. Give \"implicit\" or",
        lambda: jm.solve(M, x, solver=jm.ADMM(differentiate="x")),
    ),
    (
        'dtype: \'int\'. Give "float32", "float64"',
        lambda: jm.solve(M, x, solver=jm.ADMM(dtype="int")),
    ),
    (
        "smoothing: -1. Give 0 (none) or a positive",
        lambda: jm.solve(M, x, solver=jm.ADMM(smoothing=-1)),
    ),
    (
        "smoothing: 's' where real numbers are",
        lambda: jm.solve(M, x, solver=jm.ADMM(smoothing="s")),
    ),
    ("system: is an int. Give a jm.LinearSystem", lambda: mpc(system=3).validate()),
    ("system: is an ndarray. Give a", lambda: mpc(system=A).validate()),
    ("Q: 'Q' where real numbers are", lambda: mpc(Q="Q").validate()),
    ("Q: entries of type <U1 where real", lambda: mpc(Q=[["a", "b"], ["c", "d"]]).validate()),
    ("Q: None where real numbers are", lambda: mpc(Q=None).validate()),
    ("Q: shape () where (2, 2) is needed.", lambda: mpc(Q=1.0).validate()),
    ("Q: shape (3,) where (2, 2) is", lambda: mpc(Q=[1, 2, 3]).validate()),
    ("Q: is not positive semidefinite", lambda: mpc(Q=[-1, 2]).validate()),
    ("Q: entries of type complex128 where", lambda: mpc(Q=np.eye(2) * 1j).validate()),
    ("Q: holds NaN or infinity. Give", lambda: mpc(Q=np.eye(2) * np.nan).validate()),
    ("Q: [[1, 2], [3]] is not an array of", lambda: mpc(Q=[[1, 2], [3]]).validate()),
    ("R: is not positive definite, and at k = 0", lambda: mpc(R=0.0, Q=[0, 0]).validate()),
    ("R: is not positive semidefinite", lambda: mpc(R=-1.0).validate()),
    ("R: '1' where real numbers are", lambda: mpc(R="1").validate()),
    ("R: shape () where (1, 1) is needed.", lambda: mpc(R=True).validate()),
    ("R: None where real numbers are", lambda: mpc(R=None).validate()),
    ("R: shape (2,) where (1, 1) is", lambda: mpc(R=[1, 2]).validate()),
    ("horizon: 0. Give a whole number of steps,", lambda: mpc(horizon=0)),
    ("horizon: 2.5. Give a whole number of", lambda: mpc(horizon=2.5)),
    ("horizon: True. Give a whole number of", lambda: mpc(horizon=True)),
    ("horizon: '3'. Give a whole number of", lambda: mpc(horizon="3")),
    ("horizon: None. Give a whole number of", lambda: mpc(horizon=None)),
    ("horizon: [3]. Give a whole number of", lambda: mpc(horizon=[3])),
    ("system: is an ndarray. Give a jm.LinearSystem", lambda: jm.MPC(A, B, A, [[1]], 10)),
    ("horizon: needs ", lambda: jm.solve(mpc(horizon=10**6), x)),
    ("horizon: needs ", lambda: jm.solve(mpc(horizon=10**30), x)),
    ("horizon: needs ", lambda: jm.map_feasible_set(mpc(horizon=10**6), np.zeros((1, 2)))),
    ("states: is an int. Give a Box or Polytope,", lambda: mpc(states=3).validate()),
    ("states: is a tuple. Give a Box or", lambda: mpc(states=(-1, 1)).validate()),
    (
        "states: is an Ellipsoid. Give a Box or",
        lambda: mpc(states=jm.Ellipsoid(np.eye(2), 1.0)).validate(),
    ),
    ("states: has dimension 1 where 2 is", lambda: mpc(states=jm.Box([-1], [1])).validate()),
    ("states: is empty: lower[0] = 1, upper[0]", lambda: mpc(states=jm.Box(1, -1)).validate()),
    (
        "states.lower: holds NaN. Use -inf or inf for no",
        lambda: mpc(states=jm.Box([np.nan, 0], 1)).validate(),
    ),
    ("states.lower: 'a' where real numbers are", lambda: mpc(states=jm.Box("a", "b")).validate()),
    (
        "states.lower: entries of type <U1 where real",
        lambda: mpc(states=jm.Box(["a", "b"], ["c", "d"])).validate(),
    ),
    (
        "states.lower: entries of type complex128 where",
        lambda: mpc(states=jm.Box([-1j, -1], [1, 1])).validate(),
    ),
    (
        "states.lower: None where real numbers are",
        lambda: mpc(states=jm.Box(None, [1, 1])).validate(),
    ),
    ("inputs: has dimension 2 where 1 is", lambda: mpc(inputs=jm.Box([-1, -1], [1, 1])).validate()),
    ("inputs: is a str. Give a Box or Polytope,", lambda: mpc(inputs="box").validate()),
    (
        "Polytope.h: shape (2,) where (1,) is needed.",
        lambda: mpc(states=jm.Polytope([[1, 0]], [1, 2])).validate(),
    ),
    (
        "states.H: shape (2,) is not (rows, n). For one row write [[1.0, 0.0]]",
        lambda: mpc(states=jm.Polytope([1, 0], [1, 2])).validate(),
    ),
    ("B: shape (1, 2) where (2, 1) is needed. Give B.T", lambda: jm.LinearSystem(A, [[0, 0.2]])),
    (
        "x0s: shape (4, 3). Give (B, 2), B ≥ 1,",
        lambda: jm.tune_weights(
            lambda v: mpc(Q=v["Q"]), {"Q": jm.Parameter(np.eye(2), "diagonal")}, S, np.zeros((4, 3))
        ),
    ),
    ("divisor: 0 divides no set. Give a finite", lambda: jm.Box(-x, x) / 0),
    (
        "states: is empty: no point satisfies all",
        lambda: mpc(states=jm.Polytope([[1, 0], [-1, 0]], [-1, -1])).validate(),
    ),
    (
        "terminal_set.level: -1 is not a positive number. Give",
        lambda: mpc(terminal_set=jm.Ellipsoid(np.eye(2), -1.0)).validate(),
    ),
    (
        "terminal_set.level: '1' where real numbers are",
        lambda: mpc(terminal_set=jm.Ellipsoid(np.eye(2), "1")).validate(),
    ),
    (
        "terminal_set.P: shape () is not (n, n). Give a",
        lambda: mpc(terminal_set=jm.Ellipsoid(1.0, 1.0)).validate(),
    ),
    ("terminal_cost: 'lqr' is text, which files", lambda: mpc(terminal_cost="lqr")),
    ("terminal_set: 'invariant' is text, which files", lambda: mpc(terminal_set="invariant")),
    (
        "terminal_cost: shape (3, 3) where (2, 2) is",
        lambda: mpc(terminal_cost=np.eye(3)).validate(),
    ),
    (
        "terminal_cost: is not positive semidefinite",
        lambda: mpc(terminal_cost=-np.eye(2)).validate(),
    ),
    ("constrain_initial: 'no'. Give True or False", lambda: mpc(constrain_initial="no").validate()),
    (
        "constrained_stages: (True, False). Give np.flatnonzero(mask) in place",
        lambda: mpc(constrained_stages=[True, False]).validate(),
    ),
    (
        "constrained_stages: (1, 9). Give a tuple of different",
        lambda: mpc(constrained_stages=(1, 9)).validate(),
    ),
    (
        "constrained_stages: (1.5,). Give a tuple of different",
        lambda: mpc(constrained_stages=(1.5,)).validate(),
    ),
    (
        "constrained_stages: (4,). Give a tuple of different",
        lambda: mpc(constrained_stages=4).validate(),
    ),
    (
        "control_horizon: 9 moves in 3 steps. Give at most",
        lambda: mpc(control_horizon=9).validate(),
    ),
    ("control_horizon: 0. Give a number of moves, or", lambda: mpc(control_horizon=0).validate()),
    (
        "control_horizon: 1.5. Give a number of moves, or",
        lambda: mpc(control_horizon=1.5).validate(),
    ),
    (
        "control_horizon: '1'. Give a number of moves, or",
        lambda: mpc(control_horizon="1").validate(),
    ),
    (
        "control_horizon: (1, 1) adds up to 2. Make it 3",
        lambda: mpc(control_horizon=(1, 1)).validate(),
    ),
    (
        "control_horizon: (1, 2.0). Give a number of moves,",
        lambda: mpc(control_horizon=[1, 2.0]).validate(),
    ),
    (
        "input_rate_weight: 'w' where real numbers are",
        lambda: mpc(input_rate_weight="w").validate(),
    ),
    (
        "input_rate_weight: shape (2,) where (1, 1) is needed. Give (1, 1)",
        lambda: mpc(input_rate_weight=[1, 2.0]).validate(),
    ),
    (
        "input_rate_weight: is not positive semidefinite",
        lambda: mpc(input_rate_weight=[-1.0]).validate(),
    ),
    (
        "input_rate_limit: -1.0. |Δu| ≤ limit needs limit ≥",
        lambda: mpc(input_rate_limit=-1.0).validate(),
    ),
    ("input_rate_limit: 'x' where real numbers are", lambda: mpc(input_rate_limit="x").validate()),
    (
        "input_rate_limit: shape (2,). Give (1,) or a Box",
        lambda: mpc(input_rate_limit=[1, 2]).validate(),
    ),
    (
        "stage_weights: shape (2,) where (3,) is needed.",
        lambda: mpc(stage_weights=[1, 2]).validate(),
    ),
    (
        "stage_weights: [-1.0, 1.0, 1.0]. Give numbers of at least 0",
        lambda: mpc(stage_weights=[-1, 1, 1]).validate(),
    ),
    ("stage_weights: 'www' where real numbers are", lambda: mpc(stage_weights="www").validate()),
    ("prestabilise: 'yes' where real numbers are", lambda: mpc(prestabilise="yes").validate()),
    ("prestabilise: shape (2,) where (1, 2) is", lambda: mpc(prestabilise=np.zeros(2)).validate()),
    ("soft: int. Give a jm.Soft, or a tuple", lambda: mpc(soft=3).validate()),
    (
        "soft[0].C: shape (3, 3). Give (p, 2), one",
        lambda: mpc(soft=jm.Soft(np.eye(3), upper=[1, 1, 1])).validate(),
    ),
    (
        "soft[0].rho: -1. Penalties are at least 0",
        lambda: mpc(soft=jm.Soft(np.eye(2), upper=[1, 1], rho=-1)).validate(),
    ),
    (
        "soft[0].rho: 'x' where real numbers are",
        lambda: mpc(soft=jm.Soft(np.eye(2), upper=[1, 1], rho="x")).validate(),
    ),
    (
        "soft[0].C: 'C' where real numbers are",
        lambda: mpc(soft=jm.Soft("C", upper=[1, 1])).validate(),
    ),
    (
        "soft[0].C: entries of type <U1 where real",
        lambda: mpc(soft=jm.Soft([["a", "b"]], upper=[1])).validate(),
    ),
    (
        "soft[0].upper: 'dd' where real numbers are",
        lambda: mpc(soft=jm.Soft(np.eye(2), upper="dd")).validate(),
    ),
    (
        "soft[0].upper: is None, and so is lower. Give one",
        lambda: mpc(soft=jm.Soft(np.eye(2), upper=None)).validate(),
    ),
    ("outputs: str. Give a jm.Outputs, or a", lambda: mpc(outputs="y").validate()),
    (
        "outputs[0].C: shape (3, 3). Give (p, 2), one",
        lambda: mpc(outputs=jm.Outputs(np.eye(3), [0], [1])).validate(),
    ),
    (
        "outputs[0]: is empty: lower[0] = 2, upper[0]",
        lambda: mpc(outputs=jm.Outputs(np.eye(2), [2, 2], [1, 1])).validate(),
    ),
    (
        "outputs[0].lower: entries of type <U1 where real",
        lambda: mpc(outputs=jm.Outputs(np.eye(2), ["a", "b"], [1, 1])).validate(),
    ),
    (
        "outputs[0].stages: (9,). Give a tuple of different",
        lambda: mpc(outputs=jm.Outputs(np.eye(2), [0, 0], [1, 1], stages=(9,))).validate(),
    ),
    (
        "outputs[0].names: ['a', 'b'] is not a tuple",
        lambda: mpc(outputs=jm.Outputs(np.eye(2), [0, 0], [1, 1], names=["a", "b"])).validate(),
    ),
    ("A: 'A' where real numbers are", lambda: jm.LinearSystem("A", B).validate()),
    ("A: None where real numbers are", lambda: jm.LinearSystem(None, B).validate()),
    ("A: shape (2,) is not (n, n). Give a", lambda: jm.LinearSystem([1, 2], B).validate()),
    ("A: shape () is not (n, n). Give a matrix, [[", lambda: jm.LinearSystem(1.0, 1.0).validate()),
    ("A: shape (2, 3) where (3, 3) is", lambda: jm.LinearSystem(np.zeros((2, 3)), B).validate()),
    ("A: entries of type complex128 where", lambda: jm.LinearSystem(A * 1j, B).validate()),
    ("A: holds NaN or infinity. Give", lambda: jm.LinearSystem(A * np.nan, B).validate()),
    ("A: [[1, 2], [3]] is not an array of", lambda: jm.LinearSystem([[1, 2], [3]], B).validate()),
    (
        "A: shape (0, 0) is not (n, n). Give",
        lambda: jm.LinearSystem(np.zeros((0, 0)), np.zeros((0, 1))).validate(),
    ),
    ("A: {'a': 1} where real numbers are", lambda: jm.LinearSystem({"a": 1}, B).validate()),
    ("B: shape (3, 1) where (2, 1) is", lambda: jm.LinearSystem(A, [1, 2, 3]).validate()),
    ("B: 'B' where real numbers are", lambda: jm.LinearSystem(A, "B").validate()),
    ("B: entries of type <U1 where real", lambda: jm.LinearSystem(A, ["a", "b"]).validate()),
    ("B: shape () is not (n, m). Give a", lambda: jm.LinearSystem(A, 1.0).validate()),
    (
        "B: shape (2, 1, 1) where (2, 1) is needed.",
        lambda: jm.LinearSystem(A, np.zeros((2, 1, 1))).validate(),
    ),
    ("c: shape (3,) where (2,) is needed.", lambda: jm.LinearSystem(A, B, [1, 2, 3]).validate()),
    ("c: 'c' where real numbers are", lambda: jm.LinearSystem(A, B, "c").validate()),
    ("dt: -1 is not a positive number. Give", lambda: jm.LinearSystem(A, B, dt=-1)),
    ("dt: '1' is not a positive number.", lambda: jm.LinearSystem(A, B, dt="1")),
    ("dt: True is not a positive number.", lambda: jm.LinearSystem(A, B, dt=True)),
    (
        "state_names: 1 entries where 2 are needed.",
        lambda: jm.LinearSystem(A, B, state_names=("a",)),
    ),
    (
        "state_names: ['a', 'b'] is not a tuple of",
        lambda: jm.LinearSystem(A, B, state_names=["a", "b"]),
    ),
    (
        "state_names: ('a', 'a') has a name twice. Give",
        lambda: jm.LinearSystem(A, B, state_names=("a", "a")),
    ),
    (
        "state_units: 'rad' is not a tuple of strings.",
        lambda: jm.LinearSystem(A, B, state_units="rad"),
    ),
    ("dt: 0 is not a positive number. Give", lambda: jm.LinearSystem.from_continuous(A, B, 0)),
    ("dt: 'x' is not a positive number.", lambda: jm.LinearSystem.from_continuous(A, B, "x")),
    (
        "state_names: 3 is not a tuple of strings.",
        lambda: jm.LinearSystem.from_continuous(A, B, 0.1, state_names=3),
    ),
    ("obj: has no .A. Give a state-space", lambda: jm.LinearSystem.from_object(3)),
    ("grid shape: 50.5. Give a whole number of at", lambda: jm.grid(-1, 1, 50.5)),
    ("grid shape: 5.0. Give a whole number of at", lambda: jm.grid([-1, -1], [1, 1], (5, 2.5))),
    ("grid lower: 'a' where real numbers are", lambda: jm.grid("a", "b", 3)),
    ("grid shape: '5'. Give a whole number of at", lambda: jm.grid(-1, 1, "5")),
    ("grid shape: None. Give a whole number of at", lambda: jm.grid(-1, 1, None)),
    ("grid shape: 0. Give a whole number of at", lambda: jm.grid(-1, 1, 0)),
    ("grid shape: -3. Give a whole number of at", lambda: jm.grid(-1, 1, -3)),
    ("grid: lower [-inf], upper [1.]. Give", lambda: jm.grid(-np.inf, 1, 3)),
    ("grid: lower [nan], upper [1.]. Give", lambda: jm.grid(np.nan, 1, 3)),
    ("grid: lower [1.], upper [-1.]. Give", lambda: jm.grid(1, -1, 3)),
    ("grid: lower (2,), upper (2,), shape (3,", lambda: jm.grid([0, 0], [1, 1], (3, 3, 3))),
    ("grid: lower (2,), upper (3,), shape (3,", lambda: jm.grid([0, 0], [1, 1, 1], 3)),
    (
        "grid: lower (2, 2), upper (2, 2), shape",
        lambda: jm.grid(np.zeros((2, 2)), np.ones((2, 2)), 3),
    ),
    ("grid: needs ", lambda: jm.grid([0, 0], [1, 1], (10**6, 10**6))),
    ("grid: needs ", lambda: jm.grid(0, 1, 10**30)),
    ("grid upper: 1j where real numbers are needed.", lambda: jm.grid(0, 1j, 5)),
    ("grid shape: True. Give a whole number of at", lambda: jm.grid(0, 1, True)),
    ("grid: lower (0,), upper (0,), shape ().", lambda: jm.grid([], [], ())),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.map_feasible_set("M", np.zeros((3, 2)))),
    ("mpc: is a LinearSystem. Give a jm.MPC", lambda: jm.map_feasible_set(S, np.zeros((3, 2)))),
    ("x0s: 'x' where real numbers are", lambda: jm.map_feasible_set(M, "x")),
    (
        "x0s: entries of type complex128 where",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)) + 1j),
    ),
    ("x0s: shape (2,). Give points (B, 2),", lambda: jm.map_feasible_set(M, x)),
    ("x0s: shape (3, 3). Give points (B, 2),", lambda: jm.map_feasible_set(M, np.zeros((3, 3)))),
    (
        "axes: (5,). Give different state",
        lambda: jm.map_feasible_set(M, np.zeros((3, 1)), axes=(5,)),
    ),
    (
        "axes: 'q' is not a list. Give state",
        lambda: jm.map_feasible_set(M, np.zeros((3, 1)), axes="q"),
    ),
    (
        "axes: (0, 0). Give different state",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), axes=(0, 0)),
    ),
    (
        "axes: (0.5,). Give state indices or",
        lambda: jm.map_feasible_set(M, np.zeros((3, 1)), axes=(0.5,)),
    ),
    (
        "fixed: shape (3,). Give a value for each of x2, (1,), or of all, (2,)",
        lambda: jm.map_feasible_set(M, np.zeros((3, 1)), axes=(0,), fixed=[1, 2, 3]),
    ),
    (
        "fixed: 'ab' where real numbers are",
        lambda: jm.map_feasible_set(M, np.zeros((3, 1)), axes=(0,), fixed="ab"),
    ),
    (
        "iterations: 0. Give a whole number of at",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), iterations=0),
    ),
    (
        "iterations: 1.5. Give a whole number of at",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), iterations=1.5),
    ),
    (
        "dtype: 'int'. Iterate in 'float32' or",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), dtype="int"),
    ),
    (
        "chunk: 0. Give a whole number of at",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), chunk=0),
    ),
    (
        "chunk: 1.5. Give a whole number of at",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), chunk=1.5),
    ),
    (
        "gap: 'x' where real numbers are",
        lambda: jm.map_feasible_set(M, np.zeros((3, 2)), gap="x"),
    ),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.feasible.boundary("M", 3)),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.recursive_feasibility("M")),
    ("directions: 'x' where real numbers are", lambda: jm.feasible.boundary(M, "x")),
    ("x0s: 'x' where real numbers are", lambda: jm.recursive_feasibility(M, "x")),
    ("x0s: entries of type complex128", lambda: jm.recursive_feasibility(M, [[1j, 0]])),
    ("x0s: 'x' where real numbers are", lambda: jm.explicit.exact_penalty(M, "x")),
    ("steps: 0. Give a whole number of at", lambda: jm.recursive_feasibility(M, steps=0)),
    ("steps: 1.5. Give a whole number of at", lambda: jm.recursive_feasibility(M, steps=1.5)),
    ("max_regions: -1. Give a whole number", lambda: jm.recursive_feasibility(M, max_regions=-1)),
    ("seconds: 0. Give a positive number", lambda: jm.recursive_feasibility(M, seconds=0)),
    ("seconds: '1'. Give a positive number", lambda: jm.recursive_feasibility(M, seconds="1")),
    ("system: is a str. Give a jm.LinearSystem", lambda: jm.lqr("S", np.eye(2), np.eye(1))),
    ("Q: 'Q' where real numbers are", lambda: jm.lqr(S, "Q", np.eye(1))),
    ("Q: shape (3, 3) where (2, 2) is", lambda: jm.lqr(S, np.eye(3), np.eye(1))),
    ("R: is not positive definite (least", lambda: jm.lqr(S, np.eye(2), 0.0)),
    (
        "B: not stabilizable: does not move",
        lambda: jm.lqr(jm.LinearSystem(A * 2, B * 0), np.eye(2), 1.0),
    ),
    (
        "system: is a str. Give a jm.LinearSystem",
        lambda: jm.maximal_invariant_set("S", np.zeros((1, 2)), jm.Box(-1, 1), None),
    ),
    (
        "K: 'K' where real numbers are",
        lambda: jm.maximal_invariant_set(S, "K", jm.Box(-1, 1), None),
    ),
    (
        "states: int is no Box or Polytope. Give",
        lambda: jm.maximal_invariant_set(S, np.array([[-1.0, -1.0]]), 3, None),
    ),
    (
        "system: is a str. Give a jm.LinearSystem",
        lambda: jm.sets.maximal_control_invariant_set("S", jm.Box(-1, 1), jm.Box(-1, 1)),
    ),
    (
        "states: str is no Box or Polytope. Give",
        lambda: jm.sets.maximal_control_invariant_set(S, "x", jm.Box(-1, 1)),
    ),
    (
        "system: is a str. Give a jm.LinearSystem",
        lambda: jm.sets.invariant_ellipsoid("S", np.zeros((1, 2)), np.eye(2), jm.Box(-1, 1), None),
    ),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.explicit.exact_penalty("M")),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.soften("M", 1.0)),
    ("soft[0].rho: 'x' where real numbers are", lambda: jm.soften(M, "x")),
    ("soft[0].rho: -1.0. Penalties are at least 0", lambda: jm.soften(M, -1.0)),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.workflow.offline_report("M")),
    ("steps: 0. Give a whole number of at", lambda: jm.workflow.offline_report(M, steps=0)),
    (
        "system: is a str. Give a jm.LinearSystem",
        lambda: jm.sets.verify_terminal(
            "S", None, np.eye(2), np.eye(1), np.eye(2), None, None, None
        ),
    ),
    ("system: is a str. Give a jm.LinearSystem", lambda: jm.design("S", np.eye(2), np.eye(1), 3)),
    ("model: 'nothing' is no file. Give a", lambda: jm.load_robot("nothing")),
    ("model: is an int. Give a name, a path or", lambda: jm.load_robot(3)),
    ("model: is a NoneType. Give a name, a", lambda: jm.load_robot(None)),
    (
        "control_period: -1 is not a positive number. Give",
        lambda: jm.load_robot("joint", control_period=-1),
    ),
    ("controller: is a str. Give a Controller,", lambda: jm.simulate("c", S, x, 3)),
    (
        "controller: is a str. Give a Controller,",
        lambda: jm.simulate_many("c", S, np.zeros((2, 2)), 3),
    ),
    (
        "chunk: 1.5. Give a whole number of",
        lambda: jm.simulate_many(LAW, S, np.zeros((2, 2)), 3, chunk=1.5),
    ),
    (
        "variations: is a list. Give a dict,",
        lambda: jm.simulate_many(LAW, S, np.zeros((2, 2)), 3, variations=[1]),
    ),
    ('parameters: is a dict. Give {"Q":', lambda: jm.tune_weights("m", {}, S, x, 3, 4)),
    ("mpc: is a str. Give a jm.MPC", lambda: jm.tuning.tune_solver("m", np.zeros((3, 2)), 5)),
    (
        "iterations: 0. Give a whole number of at",
        lambda: jm.tuning.tune_solver(M, np.zeros((30, 2)), 0),
    ),
    ("position: 'x' where real numbers are", lambda: jm.joint_limits("x")),
    ("robot: is a str. Give a Robot or a", lambda: jm.robot_mpc("joint")),
    ("robot: is a str. Give a Robot or a", lambda: jm.RobotController("joint", "m")),
    ("value: 'x' where real numbers are", lambda: jm.Parameter("x")),
    ("x: shape (3,) where (2,) is needed.", lambda: jm.Box([-1, -1], [1, 1]).contains([1, 2, 3])),
    ("x: 'x' where real numbers are", lambda: jm.Box(-1, 1).contains("x")),
    ("x: shape (1,) where (2,) is needed.", lambda: jm.Polytope([[1, 0]], [1]).contains([1])),
    ("Polytope: is unbounded: it is no hull of", lambda: jm.Polytope([[1, 0]], [1]).vertices()),
    (
        "axes: [5] are not distinct numbers in",
        lambda: jm.Box([-1, -1], [1, 1]).to_polytope().project([5]),
    ),
    (
        "factor: -1 is not a positive number. Give",
        lambda: jm.Box([-1, -1], [1, 1]).to_polytope().scale(-1),
    ),
    (
        "factor: '2' where real numbers are",
        lambda: jm.Box([-1, -1], [1, 1]).to_polytope().scale("2"),
    ),
    ("Ellipsoid.P: shape () is not (n, n). Give a", lambda: jm.Ellipsoid("P", 1).volume()),
    # Rows of different lengths, when an object is made, and masks.
    ("A: [[1, 2], [3]] is not an array of", lambda: jm.LinearSystem([[1, 2], [3]], B)),
    ("c: [[1, 2], [3]] is not an array of", lambda: jm.LinearSystem(A, B, c=[[1, 2], [3]])),
    ("upper: [1, [2]] is not an array of", lambda: jm.Box([0, 0], [1, [2]])),
    ("H: [[1, 2], [3]] is not an array of", lambda: jm.Polytope([[1, 2], [3]], [1, 1])),
    ("Q: [[1, 2], [3]] is not an array of", lambda: mpc(Q=[[1, 2], [3]])),
    ("A: is a masked array that hides entries. Give", lambda: jm.LinearSystem(hiding(A), B)),
    ("lower: is a masked array that hides", lambda: jm.Box(hiding(x), [1, 1])),
    ("x0: is a masked array that hides", lambda: jm.solve(M, hiding(x))),
    ("x0: is a masked array that hides", lambda: jm.solve(M, list(hiding(x)))),
    ("x0s: is a masked array that hides", lambda: jm.solve_many(M, [hiding(x), x])),
    ("x0s: is a masked array that hides", lambda: jm.map_feasible_set(M, hiding(A))),
    ("P: is a masked array that hides", lambda: jm.solve_qp(qp(P=hiding(np.eye(2))))),
    ("value: is a masked array that hides", lambda: jm.Parameter(hiding(x))),
    # Numbers in place of sequences, and the reverse.
    ("horizons: 3 is not a list. Give a", lambda: jm.feasible.feasible_growth(M, 3)),
    ("horizons: 0. Give a whole number of at", lambda: jm.feasible.feasible_growth(M, [3, 0])),
    ("horizons: 2.5. Give a whole number of at", lambda: jm.feasible.feasible_growth(M, [2.5])),
    ("mpc: is an int. Give a jm.MPC", lambda: jm.feasible.feasible_growth(3, [3])),
    ("mpc: is an int. Give a jm.MPC", lambda: jm.recursion.smallest_horizon(3)),
    ("seed: 1.5. Give a whole number of at", lambda: BOX.sample(2, seed=1.5)),
    ("seed: True. Give a whole number of at", lambda: BOX.to_polytope().sample(2, seed=True)),
    ("seed: -1. Give a whole number of at", lambda: BOX.to_zonotope().sample(2, seed=-1)),
    (
        "seed: 'a'. Give a whole number of at",
        lambda: jm.Ellipsoid(np.eye(2), 1).sample(2, seed="a"),
    ),
    ("run: is an int. Give a", lambda: jm.tuning.transfer_penalties(3, M)),
    ("axes: 0 is not a list. Give state", lambda: jm.map_feasible_set(M, x, axes=0)),
    ("x0s: shape (). Give points (B, 2), one", lambda: jm.map_feasible_set(M, 3)),
    ("devices: array(2). Give a whole", lambda: jm.solve_many(M, [x], devices=np.array(2))),
    ("newton_steps: [1]. Give a whole number of", lambda: fraction(newton_steps=[1])),
    ("x0s: shape (0,). Give states (B, 2), one", lambda: fraction([])),
    ("along: 3 is not a list. Give 2 arrays", lambda: sweep(3)),
    ("along: has arrays of shapes []. Give 2", lambda: sweep([])),
    ("along: has arrays of shapes [(0,), (0,)].", lambda: sweep([[], []])),
    ("along: has arrays of shapes [(), ()].", lambda: sweep([1, 1])),
    ("shard: 3 is not a list. Give i and n of", lambda: sweep([x, x], shard=3)),
    ("shard: 1. Give i and n of i/n, with i from", lambda: sweep([x, x], shard=(1,))),
    ("settings: is an int. Give a Mapping", lambda: sweep([x, x], settings=3)),
    (
        "max_iterations: [3]. Give a whole number",
        lambda: jm.maximal_invariant_set(S, [[-1, -1]], BOX, M.inputs, max_iterations=[3]),
    ),
    (
        "tolerance: [1]. Give a relative gap",
        lambda: jm.sets.maximal_control_invariant_set(S, BOX, M.inputs, tolerance=[1]),
    ),
    ("system: is an int. Give a jm.LinearSystem", lambda: jm.sets.predecessor(3, BOX, BOX, BOX)),
    (
        "disturbance_matrix: shape () where (2,)",
        lambda: jm.sets.predecessor(S, BOX, BOX, M.inputs, BOX, 3),
    ),
    ("system: is an int. Give a jm.LinearSystem", lambda: jm.sets.reachable_sets(3, BOX, BOX)),
    ("sets: hold a int. Give Boxes, Polytopes", lambda: jm.sets.plot(3)),
    ("names: 3 is not a list. Give a list", lambda: jm.joint_limits(1.0, names=3)),
    ("units: 3 is not a list. Give three", lambda: jm.joint_limits(1.0, units=3)),
    (
        "names: [None] are not strings. Give a",
        lambda: jm.sets.output_limits([[1]], -1, 1, names=[None]),
    ),
    (
        "law: is an int. Give a jm.systems.LQR",
        lambda: jm.sets.named_terminal_set("invariant", S, 3, BOX, M.inputs),
    ),
    ("pieces: 3 is not a list. Give a tuple", lambda: jm.sets.PolytopeUnion(3)),
    ("n: [2]. Give a whole number of at least", lambda: jm.Polytope.empty([2])),
    ("count: [3]. Give a whole number of at", lambda: jm.Ellipsoid(np.eye(2), 1).boundary([3])),
    ("axes: 1.5 is not a list. Name those", lambda: BOX.project(1.5)),
    ("seconds: (). Give a time limit in", lambda: jm.explicit.critical_regions(M, seconds=())),
    ("seconds: (). Give a time limit in", lambda: jm.explicit.exact_penalty(M, seconds=())),
    ("rho: 'x' where real numbers are needed.", lambda: jm.explicit.exact_penalty(M, rho="x")),
    ("factor: is a Polytope. P.cartesian_product", lambda: BOX * BOX.to_polytope()),
    ("rho: 'exact'. Give a number: jm.explicit", lambda: jm.soften(M, "exact")),
    (
        "constrain_initial: is False, and constrained_",
        lambda: mpc(constrain_initial=False, constrained_stages=(0, 2)).validate(),
    ),
    ("c: 0.01 where (2,) is needed. Give one", lambda: jm.LinearSystem(A, B, 0.01)),
    (
        "K: LQR(K=[[",
        lambda: jm.maximal_invariant_set(S, jm.lqr(S, np.eye(2), 1), BOX, M.inputs),
    ),
    ("x0s: shape (4, 1). Give points (B, 2), one", lambda: jm.map_feasible_set(M, np.eye(4)[:1].T)),
    ("x0s: entries of type <U1 where real", lambda: solver([["a", "b"]] * 12)),
    ("solver: is a str. Give a jm.ADMM", lambda: solver(solver="admm")),
    ("warm_start: 3 is none of them. Give a pair", lambda: solver(warm_start=3)),
    ("validation: 'x' where real numbers are", lambda: solver(validation="x")),
    ("weights: entries of type complex128 where", lambda: trade_off(weights=[[1j, 1.0]])),
    ("losses['b']: is an int. Give a function of", lambda: trade_off(losses={"a": LOSS, "b": 3})),
    ("lower: 'a' where real numbers are needed.", lambda: jm.Parameter(1.0, "interval", "a", 2)),
    ("name: 3. Give letters, digits and _", lambda: jm.export.export_c(M, "nowhere", name=3)),
    ("folder: is a NoneType. Give the path", lambda: jm.export.export_c(M, None)),
    ("platforms: 'cpu'. Give a tuple of some of", lambda: exported("cpu")),
    ("platforms: ('tpuu',). Give a tuple of some", lambda: exported(("tpuu",))),
    (
        "lower: [0, 1] exceeds upper [1, 0]. Give",
        lambda: jm.export.check_fixed_steps(M, jm.ADMM(10), [0, 1], [1, 0]),
    ),
    ("mpc: is a LinearFeedback. Give a jm.MPC", lambda: draw_disturbances(LAW, 3, 2)),
    ("controller: is an MPC. Give a Controller", lambda: worst_disturbance(M, x, 3)),
    (
        "plant: has a sampling period of 0.02 s, the controller's model 0.01. Give both",
        lambda: jm.simulate(LAW, jm.LinearSystem(A, B, dt=0.02), x, 3),
    ),
    ("x0: shape (0, 2). Give (B, 2), B ≥ 1", lambda: worst([])),
    ("x0: shape (1, 2, 2). Give (B, 2), B ≥ 1", lambda: worst([[x, x]])),
    ("x0: holds NaN or infinity. Give", lambda: worst([[0, 0], [np.nan, 0]])),
    ("compensate: is a str. Give True or", lambda: jm.simulate(LAW, S, x, 3, compensate="no")),
    ("x0: shape (2, 1). Give (2,): x0.ravel()", lambda: jm.solve(M, x[:, None])),
    ("x0: shape (3, 2). Give (2,); use jax.vmap", lambda: jm.solve(M, np.zeros((3, 2)))),
    ("x0: shape (3,). Give (2,)", lambda: jm.solve(M, np.zeros(3))),
    ("a.function: is a str. Give a function", lambda: nonlinear(jm.mpc.Task("cos", name="a"))),
    (
        "task: has neither a weight nor limits. Give",
        lambda: nonlinear(jm.mpc.Task(lambda point: point.x[0])),
    ),
    ("targets: 3.0 is not a list. Give one", lambda: nonlinear(TASK, targets=3.0)),
    ("scale: shape (2,). Give (9,), one number", lambda: nonlinear(TASK, scale=[1.0, 2.0])),
]


@pytest.mark.parametrize(("message", "call"), CALLS, ids=range(len(CALLS)))
def test_wrong_arguments_are_named(message, call, compiled):
    compiled.clear()
    with pytest.raises(ValueError) as caught:
        call()
    text = str(caught.value)
    assert text.startswith(message), text
    assert "\n" not in text and len(text) < 300 and not compiled


def test_wrong_arguments_of_a_controller_are_named():
    controller = jm.Controller(M)
    with pytest.raises(ValueError, match=r"rho: shape \(2,\). Give \(\), \(9,\) or"):
        jm.Controller(M, jm.ADMM(rho=[1, 2]))
    for given, message in (
        ("x", "x0: 'x' where real"), (jm.ADMM(), "x0: ADMM() where real"), (None, "x0: None where"),
        (x + 1j, "x0: entries of type complex"), (jnp.zeros(2, complex), "x0: entries of type c"),
        (0.5, "x0: shape ()"),
    ):  # fmt: skip
        with pytest.raises(ValueError) as caught:
            controller(given)
        assert str(caught.value).startswith(message)
    for feedback in (controller, jm.closed_loop.LinearFeedback(M, np.zeros((1, 2)))):
        with pytest.raises(ValueError, match="^before: is an ndarray. .* reference has its name"):
            feedback(x, np.zeros(2))
    for wrong in ("x", x + 1j, np.zeros(3)):
        with pytest.raises(ValueError, match="^x0: "):
            jm.simulate(controller, S, wrong, 3)
        with pytest.raises(ValueError, match="^x0s: "):
            jm.simulate_many(controller, S, wrong, 3)
    with pytest.raises(ValueError, match="^reference: "):
        jm.simulate(controller, S, x, 3, reference=jm.ADMM())


def same(one, other):
    leaves, others = (jax.tree.flatten(value) for value in (one, other))
    assert leaves[1] == others[1]
    for a, b in zip(leaves[0], others[0], strict=True):
        np.testing.assert_array_equal(a, b)


def test_numbers_and_vectors_stand_for_the_matrices_they_mean():
    same(jm.LinearSystem(A, [0, 0.2], dt=0.01).B, B)
    wanted = mpc(Q=np.diag([50.0, 1.0]), R=np.array([[0.1]]), terminal_cost=np.diag([2.0, 3.0]))
    given = mpc(
        system=jm.LinearSystem(A, np.array([0, 0.2]), dt=0.01), Q=[50.0, 1.0], R=0.1,
        terminal_cost=(2.0, 3.0), states=jm.Box(-1, 1), inputs=jm.Box(-1, 1),
    )  # fmt: skip
    given.validate()
    same(given, wanted)
    same(mpc(states=jm.Box(-1, [1, 2])).states, jm.Box(np.array([-1, -1]), [1, 2]))
    same(mpc(R=[0.1]).R, np.array([[0.1]]))
    law, other = jm.lqr(S, [50.0, 1.0], 0.1), jm.lqr(S, np.diag([50.0, 1.0]), [[0.1]])
    np.testing.assert_array_equal(law.K, other.K)
    # A number for several states or inputs has more than one meaning.
    with pytest.raises(ValueError, match="Q: shape"):
        mpc(Q=1.0).validate()


@pytest.mark.parametrize("rows", [jm.Outputs, jm.Soft])
def test_one_row_may_be_a_vector_and_its_sides_numbers(rows):
    found, same = rows([1, 0], -1, 2, D=[0.5]), rows([[1, 0]], [-1], [2], D=[[0.5]])
    for name in ("C", "lower", "upper", "D"):
        value, expected = getattr(found, name), getattr(same, name)
        assert value.dtype == expected.dtype
        np.testing.assert_array_equal(value, expected)
    of_all = rows(np.eye(2), upper=3)
    assert of_all.lower is None
    np.testing.assert_array_equal(of_all.upper, [3, 3])
    slope = jax.grad(lambda end: jnp.sum(rows(np.eye(2), upper=end).upper))(3.0)
    assert slope == 2


def test_two_numbers_are_an_interval():
    box = jm.Box(-1, 3)
    box.validate("box", 1)
    assert (box.dimension, box.volume(), box.vertices().tolist()) == (1, 4.0, [[-1.0], [3.0]])
    assert box.contains([2.0]) and not box.contains([4.0]) and box.support([-2.0]) == 2.0
    assert box.half_widths() == [2.0] and box.tightened(0.5).upper == 2.0
    same(box.to_polytope(), jm.Box([-1], [3]).to_polytope())
    same(jm.Box([-1, -2], np.inf), jm.Box([-1, -2], np.array([np.inf, np.inf])))


def test_grids_take_numbers_for_all_axes():
    np.testing.assert_array_equal(jm.grid(-1, 1, 3), [[-1], [0], [1]])
    np.testing.assert_array_equal(jm.grid([-1, -2], [1, 2], 3), jm.grid([-1, -2], [1, 2], (3, 3)))
    np.testing.assert_array_equal(jm.grid(-1, [1, 2], (2, 3)), jm.grid([-1, -1], [1, 2], [2, 3]))


LIGHT = jm.ADMM(newton_steps=0)


def of_one_state(inputs):
    return jm.MPC(jm.LinearSystem([[0.9]], [1.0]), 1.0, 1.0, horizon=2, inputs=inputs)


@pytest.mark.long
def test_masked_arrays_that_hide_nothing_are_arrays():
    box = jm.Box(np.ma.array([-1]), np.ma.array([1.0]))
    plan = jm.solve(of_one_state(box), np.ma.array([0.0]), solver=LIGHT)
    np.testing.assert_array_equal(plan.states, 0)
    assert not isinstance(box.upper, np.ma.MaskedArray)


@pytest.mark.slow
def test_lists_are_states_of_fractions():
    with jax.enable_x64(True):
        assert fraction([[0, 0], [1, 1]]) == fraction(np.array([[0.0, 0], [1, 1]]))


def test_of_no_points_there_are_no_distances():
    assert BOX.distance(np.zeros((0, 2))).shape == (0,)
    assert jm.explicit.critical_regions(M).law(np.zeros((0, 2))).shape == (0, 1)


def test_numbers_are_states_where_there_is_one():
    plans = [jm.solve(of_one_state(jm.Box(-1, 1)), x0, solver=LIGHT) for x0 in (0.5, [0.5])]
    np.testing.assert_array_equal(plans[0].states, plans[1].states)


def test_rebuilt_objects_stay_what_they_are():
    specification = jax.tree.map(lambda _: None, M)
    assert jax.tree.leaves(specification) == []
    axes = jm.MPC(None, Q=0, R=None, horizon=3)
    assert (axes.Q, axes.R) == (0, None)
    weights = np.stack([np.eye(2), 2 * np.eye(2)])
    total = jax.vmap(lambda Q: mpc(Q=Q).Q.sum())(jnp.asarray(weights))
    np.testing.assert_array_equal(total, [2, 4])
    # Vectors and numbers may be traced.
    np.testing.assert_array_equal(jax.jit(lambda q, r: mpc(Q=q, R=r).Q)(x + 2, 1.0), 2 * np.eye(2))
    system = jax.jit(lambda b: jm.LinearSystem(A, b).B)(jnp.ones(2))
    np.testing.assert_array_equal(system, [[1], [1]])
    box = jax.jit(lambda u: mpc(states=jm.Box(-1.0, u)).states.upper)(2.0)
    np.testing.assert_array_equal(box, [2, 2])


@pytest.mark.parametrize(
    "message, call",
    [
        ("MPC: there is no argument u_min. Did you mean inputs?", lambda: mpc(u_min=-1)),
        ("MPC: there is no argument terminal_weight. Did you mean terminal_cost?",
         lambda: mpc(terminal_weight=1)),
        ("MPC: there is no argument P. Did you mean terminal_cost?", lambda: mpc(P=1)),
        ("ADMM: there is no argument max_iter. Did you mean iterations?",
         lambda: jm.ADMM(max_iter=9)),
        ("MPC: there is no argument max_iter. MPC takes", lambda: mpc(max_iter=9)),
        ("LinearSystem: there is no argument C. LinearSystem", lambda: jm.LinearSystem(A, B, C=A)),
        ("LinearSystem: there is no argument state_name. Did you mean state_names?",
         lambda: jm.LinearSystem(A, B, state_name=("q", "v"))),
        ("ADMM: there is no argument iteration. Did you mean iterations?",
         lambda: jm.ADMM(iteration=3)),
        ("QP: A, l, u are missing. QP takes P, q, A, l, u,", lambda: jm.QP(np.eye(2), x)),
        ("QP: u is missing.", lambda: jm.QP(np.eye(2), x, A, l=x)),
        ("tune_weights: there is no argument lr. Its settings are updates, optimizer",
         lambda: jm.tune_weights(lambda v: M, {}, S, x[None], lr=0.1)),
        ("MPC: there is no argument horizons. Did you mean horizon?",
         lambda: dataclasses.replace(M, horizons=4)),
    ],
)  # fmt: skip
def test_arguments_that_do_not_exist_or_are_missing(message, call):
    with pytest.raises(TypeError) as told:
        call()
    assert str(told.value).startswith(message)


def test_a_misspelt_argument_of_a_design_is_named_before_any_work():
    with pytest.raises(TypeError, match="design: there is no argument limts. Did you mean limits"):
        jm.design(S, np.eye(2), np.eye(1), 3, limts=1)


def test_a_plant_without_a_period_fits_any_controller():
    system = dataclasses.replace(S, dt=None)
    boxes = jm.Box([-1.0, -1.0], [1.0, 1.0]), jm.Box([-1.0], [1.0])
    for plant in (system, jm.LinearPlant(system, *boxes), lambda x, u: x):
        jm.simulate(LAW, plant, x, 1)


@pytest.mark.parametrize(
    ("found", "value"),
    [
        (r"shape \(3,\)", np.zeros(3)),
        (r"shape \(2, 1\)", np.zeros((2, 1))),
        ("a NoneType", None),
        ("a dict", {"x": x}),
    ],
)
def test_a_plant_whose_step_returns_no_state_is_named(found, value):
    message = rf"plant: has a step that returns {found}. Return the next state \(2,\)"
    with pytest.raises(ValueError, match=message):
        jm.simulate(LAW, Returns(value), x, 3)


@pytest.mark.parametrize(
    "plant",
    [
        lambda x, u: np.array([x[0], u[0]]),
        lambda x, u: x if x[0] > 0 else -x,
        lambda x, u: jnp.array([float(x[0]), u[0]]),
    ],
)
def test_a_plant_that_is_not_written_in_jax_is_told_what_helps(plant):
    with pytest.raises(ValueError, match="plant: is not written in JAX .* Use jax.numpy"):
        jm.simulate(LAW, plant, x, 3)
    with pytest.raises(ValueError, match="plant: is not written in JAX .* Use jax.numpy"):
        jm.simulate_many(LAW, plant, [x], 3)


@pytest.mark.parametrize("plant", [lambda t, x, u: x, lambda u, x: A @ x + B @ u])
def test_a_plant_of_other_arguments_is_told_its_own(plant):
    with pytest.raises(ValueError, match="plant: raises a TypeError .* is a function of a state"):
        jm.simulate(LAW, plant, x, 3)
    with pytest.raises(ValueError, match="model or task: raises a TypeError .* in this order"):
        jm.mpc.solve_nonlinear(jm.mpc.NonlinearMPC(M, plant), x)


@pytest.mark.parametrize(
    ("instance", "name", "meant"),
    [(M, "N", "horizon"), (BOX.to_polytope(), "V", "vertices"), (LAW, "u", None)],
)
def test_attributes_of_other_libraries_are_told_what_they_are_called_here(instance, name, meant):
    hint = "" if meant is None else rf"\. Did you mean {meant}\?"
    with pytest.raises(AttributeError, match=rf"object has no attribute '{name}'{hint}$"):
        getattr(instance, name)
    assert not hasattr(instance, name)


def test_an_error_inside_a_property_stays_what_it_is():
    @record
    class Broken:
        @property
        def half(self):
            return (1).nothing

    with pytest.raises(AttributeError, match="'int' object has no attribute 'nothing'"):
        Broken().half  # noqa: B018


def test_errors_inside_a_constructor_stay_what_they_are():
    @record
    class Sized:
        of: list

        def __post_init__(self):
            len(self.of)

    with pytest.raises(TypeError, match="has no len"):
        Sized(of=3)
    with pytest.raises(TypeError, match="takes 2 positional arguments but 3 were given"):
        Sized([], [])


@pytest.mark.parametrize(
    "message, call",
    [
        ("Polytope.h: shape (2,) where (1,) is", lambda: jm.Polytope([[1.0, 0.0]], [1.0, 2.0])),
        ("Polytope.labels: 1 entries where 2", lambda: jm.Polytope(np.eye(2), x, ("a",))),
        ("Box.upper: shape (3,) where (2,) is", lambda: jm.Box([1, 2], [3, 4, 5])),
        ("Zonotope.generators: shape (1, 3) is not", lambda: jm.sets.Zonotope(x, [[1, 2, 3]])),
        ("Ellipsoid.P: shape (2, 3) is not (n, n)", lambda: jm.Ellipsoid(np.ones((2, 3)), 1.0)),
        ("Ellipsoid.center: shape (3,) where", lambda: jm.Ellipsoid(np.eye(2), 1, [1, 2, 3])),
    ],
)
def test_sets_of_wrong_shapes_are_refused_when_they_are_made(message, call):
    with pytest.raises(ValueError) as told:
        call()
    assert str(told.value).startswith(message)


def test_batches_of_sets_and_their_axes_are_made():
    """What JAX makes has no shape of one set."""
    many = jm.Polytope(np.ones((4, 3, 2)), np.ones((4, 3)))
    axes = jm.Polytope(H=0, h=None)
    one = jm.Polytope(np.ones((3, 2)), np.ones(3))
    assert jax.vmap(lambda p: p.H.sum(), in_axes=(axes,))(
        jm.Polytope(many.H, one.h)
    ).shape == (4,)  # fmt: skip
    last = jax.vmap(lambda p: p, out_axes=-1)(many)
    assert (last.H.shape, last.h.shape) == ((3, 2, 4), (3, 4))


OUTSIDE = {
    "solve_many": lambda mpc: jm.solve_many(mpc, np.zeros((4, 2))),
    "map": lambda mpc: jm.map_feasible_set(mpc, jm.feasible.grid([-1, -1], [1, 1], 3)),
    "feasible_polytope": jm.feasible_polytope,
    "boundary": lambda mpc: jm.feasible.boundary(mpc, 8),
    "sample": lambda mpc: jm.feasible.sample_feasible_set(mpc, 10),
    "recursion": jm.recursive_feasibility,
    "first_step_in": lambda mpc: jm.mpc.first_step_in(mpc, jm.Box([-1, -1], [1, 1])),
    "regions": jm.explicit.critical_regions,
    "exact_penalty": jm.explicit.exact_penalty,
    "export_c": lambda mpc: jm.export.export_c(mpc, "never-written"),
    "export_jax": lambda mpc: jm.export.export_jax(mpc, "never-written"),
    "choose_steps": lambda mpc: jm.export.choose_steps(mpc, [-1, -1], [1, 1]),
    "tune_solver": lambda mpc: jm.tuning.tune_solver(mpc, np.zeros((4, 2))),
    "simulate_many": lambda mpc: jm.simulate_many(
        jm.Controller(mpc), jm.LinearPlant(mpc.system, mpc.states, mpc.inputs), np.zeros((4, 2)), 3
    ),
}


@pytest.mark.parametrize("name", OUTSIDE)
def test_what_jax_cannot_trace_says_so(name, tmp_path, monkeypatch):
    """In place of an error from inside JAX about an array of a shape."""
    monkeypatch.chdir(tmp_path)

    def traced(A):
        OUTSIDE[name](mpc(system=jm.LinearSystem(A, B, dt=0.01)))

    with pytest.raises(ValueError, match=r"^(mpc|controller|A): is traced by JAX, .* outside jit"):
        jax.eval_shape(traced, A)


@pytest.mark.parametrize(
    ("transform", "start"), [(jax.jit, 3), (jax.vmap, np.array([3])), (jax.grad, 3.0)]
)
def test_a_traced_horizon_says_what_to_give(transform, start):
    with pytest.raises(ValueError, match="horizon: is traced by JAX. It is static: give a Python"):
        transform(lambda N: mpc(horizon=N).Q[0, 0])(start)


@pytest.mark.parametrize(
    "given, message",
    [
        ({"Q": np.eye(3)}, r"Q: shape \(3, 3\) where \(2, 2\)"),
        ({"Q": [1.0, 2.0, 3.0]}, r"Q: shape \(3,\)"),
        ({"R": np.eye(2)}, r"R: shape \(2, 2\) where \(1, 1\)"),
        ({"terminal_cost": np.eye(1)}, "terminal_cost: shape"),
        ({"states": jm.Box([-1.0] * 3, [1.0] * 3)}, "states: has dimension 3 where 2"),
        ({"inputs": jm.Box([-1.0, -1.0], [1.0, 1.0])}, "inputs: has dimension 2 where 1"),
        ({"terminal_set": jm.Polytope([[1.0, 0, 0]], [1.0])}, "terminal_set: has dimension 3"),
        ({"input_rate_weight": np.eye(2)}, "input_rate_weight: shape"),
        ({"A": [[1.0, 2.0]]}, r"A: shape \(1, 2\) where \(2, 2\)"),
        ({"B": [1.0, 2.0, 3.0]}, r"B: shape \(3, 1\) where \(2, 1\)"),
        ({"c": [1.0]}, r"c: shape \(1,\) where \(2,\)"),
    ],
)
def test_shapes_that_do_not_fit_are_told_at_construction(given, message):
    """In whatever stands for the numbers; JAX rebuilds problems of other shapes without a word."""
    dynamics = {"A": [[1.0, 0.1], [0.0, 1.0]], "B": [0.0, 0.1]}

    def make(given):
        of_system = {k: given.get(k, dynamics.get(k)) for k in ("A", "B", "c")}
        rest = {k: v for k, v in given.items() if k not in of_system}
        start = {"Q": np.eye(2), "R": np.eye(1), "horizon": 3, "states": jm.Box([-1, -1], [1, 1])}
        return jm.MPC(jm.LinearSystem(**of_system), **{**start, **rest})

    with pytest.raises(ValueError, match=message):
        make(given)
    ((name, value),) = given.items()
    if isinstance(value, np.ndarray | list):
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(lambda v: make({name: v}), np.asarray(value))
    mpc = make({})
    many = jax.tree.map(lambda v: np.stack([v, v, v]), mpc)
    assert dataclasses.replace(many, system=many.system).system.B.shape == (3, 2, 1)
    plant = jm.LinearPlant(S, BOX, jm.Box(-1.0, 1.0))
    for change in (np.transpose, np.shape, np.ravel, lambda v: object(), lambda v: 0, type):
        jax.tree.leaves(jax.tree.map(change, (many, plant)))
        jax.tree.map(lambda v: None, (many, plant))
