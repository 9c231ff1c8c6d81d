"""MuJoCo's C engine: what our robots are compared with."""

import mujoco
import numpy as np

EPS = 1e-6


def data_at(model, x, u):
    data = mujoco.MjData(model)
    rates = model.nq + model.nv
    data.qpos, data.qvel, data.ctrl = x[: model.nq], x[model.nq : rates], u
    if model.na:
        data.act = x[rates:]
    return data


def c_steps(model, x, u, count):
    """x after `count` steps of the C engine, its solver started cold each time, as MJX's."""
    data = data_at(model, x, u)
    for _ in range(count):
        data.qacc_warmstart = 0
        mujoco.mj_step(model, data)
    return np.concatenate([data.qpos, data.qvel, data.act])


def moved(model, q, motion):
    """q after a small motion (nv,)."""
    q = np.array(q, float)
    mujoco.mj_integratePos(model, q, np.asarray(motion, float), 1.0)
    return q


def motion_between(model, first, second):
    """The small motion (nv,) that takes one q to another."""
    d = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, d, 1.0, np.asarray(first, float), np.asarray(second, float))
    return d


def by_differences(robot, step, x, u):
    """A, B of a step by central differences, small motions against small motions."""
    model, nq, nv = robot.mujoco, robot.mujoco.nq, robot.mujoco.nv
    after = np.asarray(step(x, u))

    def motion(d, u):
        y = np.asarray(step(np.concatenate([moved(model, x[:nq], d[:nv]), x[nq:] + d[nv:]]), u))
        return np.concatenate([motion_between(model, after[:nq], y[:nq]), y[nq:]])

    d, zero = EPS * np.eye(2 * nv), np.zeros(2 * nv)
    A = [(motion(e, u) - motion(-e, u)) / 2 / EPS for e in d]
    B = [(motion(zero, u + e) - motion(zero, u - e)) / 2 / EPS for e in EPS * np.eye(robot.m)]
    return np.array(A).T, np.array(B).T


def c_transition(robot, x, u):
    """A, B of mujoco.mjd_transitionFD, with a solver that has converged; by our own differences of
    the C engine where that function refuses (RK4)."""
    model = robot.mujoco
    if model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4:
        return by_differences(robot, lambda x, u: c_steps(model, x, u, 1), x, u)
    tolerance, model.opt.tolerance = model.opt.tolerance, 0
    data, n = data_at(model, x, u), 2 * model.nv + model.na
    mujoco.mj_forward(model, data)
    A, B = np.zeros((n, n)), np.zeros((n, model.nu))
    mujoco.mjd_transitionFD(model, data, EPS, True, A, B, None, None)
    model.opt.tolerance = tolerance
    return A, B


def c_state(robot, xi):
    """x of coordinates from the anchor."""
    nv = robot.mujoco.nv
    return np.concatenate([moved(robot.mujoco, robot.anchor, xi[:nv]), xi[nv:]])


def c_coordinates(robot, x):
    """Coordinates from the anchor."""
    nq = robot.mujoco.nq
    return np.concatenate([motion_between(robot.mujoco, robot.anchor, x[:nq]), x[nq:]])


def c_affine(robot, x, u, count):
    """A, B, c in the coordinates, by central differences through the C engine's predictor."""
    xi = c_coordinates(robot, x)
    f = lambda xi, u: c_coordinates(
        robot, c_steps(robot.predictor.model, c_state(robot, xi), u, count)
    )
    columns = lambda g, size: np.array([(g(d) - g(-d)) / 2 for d in EPS * np.eye(size)]).T / EPS
    A = columns(lambda d: f(xi + d, u), robot.n)
    B = columns(lambda d: f(xi, u + d), robot.m)
    return A, B, f(xi, u) - A @ xi - B @ u
