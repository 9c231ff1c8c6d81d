"""The table of problems that all tests share, with what is known of each.

Every entry is a function, so that a test can change a field with `dataclasses.replace`. Exact
areas hold for the decimal data as printed; for the float64 data use `exact.feasible_polygon`.
"""

import jax
import numpy as np

import jaxmpc as jm
from jaxmpc.mpc.plan import flat_multipliers
from jaxmpc.mpc.rows import layout


def symmetric(*limits: float) -> jm.Box:
    """{x: |x_i| ≤ limits_i}."""
    return jm.Box(-np.array(limits, float), np.array(limits, float))


def scalar(a=1.0, horizon=5, x_max=1.0, u_max=0.3, terminal=None, **settings) -> jm.MPC:
    """x⁺ = a x + u, |x| ≤ x_max (None: no limit), |u| ≤ u_max, |x_N| ≤ terminal."""
    return jm.MPC(
        system=jm.LinearSystem(np.array([[a]]), np.array([[1.0]])), Q=np.eye(1), R=np.eye(1),
        horizon=horizon, states=None if x_max is None else symmetric(x_max),
        inputs=symmetric(u_max), terminal_set=None if terminal is None else symmetric(terminal),
        **settings,
    )  # fmt: skip


def double_integrator(horizon=10) -> jm.MPC:
    """The double integrator of the MPT toolbox; C_inf has area 1375/24 and 14 facets."""
    limit = symmetric(5.0, 5.0)
    return jm.MPC(
        system=jm.LinearSystem(np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0], [0.5]])),
        Q=np.eye(2), R=np.eye(1), horizon=horizon, states=limit, inputs=symmetric(1.0),
        terminal_set=limit,
    )  # fmt: skip


C_INF_DOUBLE_INTEGRATOR = 1375 / 24


def lecture(u_max=0.25, horizon=3) -> jm.MPC:
    """Double integrator on which MPC without a terminal set loses feasibility."""
    limit = symmetric(1.0, 1.0)
    return jm.MPC(
        system=jm.LinearSystem(np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.4], [1.0]])),
        Q=np.eye(2), R=10 * np.eye(1), horizon=horizon, states=limit, inputs=symmetric(u_max),
        terminal_cost=np.eye(2), terminal_set=limit,
    )  # fmt: skip


AREA_LECTURE = {0.25: 1043 / 400, 0.3: 7027 / 2500}  # X_3


def joint(horizon=20, terminal_set="states") -> jm.MPC:
    """Robot joint, 10 ms, inertia 0.05 kg m²: |q| ≤ 1.5 rad, |dq| ≤ 2 rad/s, |torque| ≤ 2 N m."""
    limit = symmetric(1.5, 2.0)
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.0, 0.01], [0.0, 1.0]]), np.array([[0.0], [0.2]]), dt=0.01
        ),
        Q=np.diag([50.0, 1.0]), R=np.array([[0.1]]), horizon=horizon, states=limit,
        inputs=symmetric(2.0), terminal_cost=np.array(P_JOINT),
        terminal_set=limit if terminal_set == "states" else terminal_set,
    )  # fmt: skip


P_JOINT = [[836.4585534716418, 15.783998400228846], [15.783998400228846, 2.4826921099685366]]
K_JOINT = [[-15.838825731024865, -2.649704251932495]]
AREA_JOINT = 1489 / 125  # from horizon 6 on
# Upper half of the maximal invariant set of the joint's LQR, H x ≤ h; it is symmetric.
HALF_O_INF = np.array([
    [0.9862937722130597, 0.16499877240068495, 0.12454127458213289],
    [0.0, 1.0, 2.0],
    [0.9891690042841133, -0.14678106473103347, 0.6245216792470564],
    [0.9991749946004327, -0.04061194609010405, 0.4291249510733852],
    [0.9999674625577459, -0.008066834932186545, 0.380476873747723],
])  # fmt: skip
O_INF_JOINT = jm.Polytope(
    np.vstack([HALF_O_INF[:, :2], -HALF_O_INF[:, :2]]), np.tile(HALF_O_INF[:, 2], 2)
)
AREA_JOINT_O_INF = 5.523166981610873  # horizon 20, 22 facets


def joint_o_inf(horizon=20) -> jm.MPC:
    """The joint with the maximal invariant set of its LQR as terminal set: the hard case."""
    return joint(horizon, O_INF_JOINT)


def hidden_product(horizon=10) -> jm.MPC:
    """Two joints behind a unimodular change of coordinates x = T (joint 1, joint 2): 4-D."""
    T = np.array([[1.0, 0, 0, 0], [-1, 1, 0, -1], [-1, 0, 1, 1], [0, 1, 0, 0]])
    limits = jm.Polytope(np.vstack([T_INVERSE, -T_INVERSE]), np.tile([1.5, 2.0, 1.0, 1.5], 2))
    A, B = np.eye(4), np.zeros((4, 2))
    A[0, 1] = A[2, 3] = 0.01
    B[1, 0], B[3, 1] = 0.2, 0.1
    return jm.MPC(
        system=jm.LinearSystem(T @ A @ T_INVERSE, T @ B), Q=np.eye(4), R=np.eye(2),
        horizon=horizon, states=limits, inputs=symmetric(2.0, 2.0), terminal_set=limits,
    )  # fmt: skip


T_INVERSE = np.array([[1.0, 0, 0, 0], [0, 0, 0, 1], [2, 1, 1, -1], [-1, -1, 0, 1]])
VOLUME_PRODUCT = 70.661984


def product_block(index: int, horizon=10) -> jm.MPC:
    """One of the two joints that `hidden_product` hides."""
    gain, limit = ((0.2, (1.5, 2.0)), (0.1, (1.0, 1.5)))[index]
    system = jm.LinearSystem(np.array([[1.0, 0.01], [0.0, 1.0]]), np.array([[0.0], [gain]]))
    return jm.MPC(
        system=system, Q=np.eye(2), R=np.eye(1), horizon=horizon, states=symmetric(*limit),
        inputs=symmetric(2.0), terminal_set=symmetric(*limit),
    )  # fmt: skip


def unstable(horizon=30) -> jm.MPC:
    """A mode that doubles at each step: predictions grow by 2^horizon."""
    return jm.MPC(
        system=jm.LinearSystem(np.array([[2.0, 1.0], [0.0, 0.5]]), np.array([[0.25], [1.0]])),
        Q=np.eye(2), R=np.eye(1), horizon=horizon, states=symmetric(5.0, 5.0),
        inputs=symmetric(1.0), terminal_set=symmetric(5.0, 5.0),
    )  # fmt: skip


def drifting(horizon=4) -> jm.MPC:
    """Affine dynamics, two inputs, one-sided and oblique limits, rows of any length."""
    return jm.MPC(
        system=jm.LinearSystem(
            np.array([[1.1, 0.3], [-0.2, 0.9]]), np.array([[0.5, 0.1], [0.0, 0.7]]),
            c=np.array([0.05, -0.1]),
        ),
        Q=np.array([[2.0, 0.5], [0.5, 1.0]]), R=np.diag([0.5, 2.0]), horizon=horizon,
        states=jm.Polytope(
            np.array([[3.0, 1.0], [-2.0, 0.5], [0.3, -1.7], [-1.0, 2.0], [0.0, 1.0]]),
            np.array([4.0, 3.0, 2.0, 2.5, 1.2]),
        ),
        inputs=jm.Box(np.array([-0.3, -0.5]), np.array([0.4, 0.2])),
        terminal_cost=np.array([[3.0, -0.2], [-0.2, 2.0]]),
        terminal_set=jm.Box(np.array([-1.0, -0.8]), np.array([0.7, 0.9])),
    )  # fmt: skip


PLANAR = {
    "double integrator": double_integrator,
    "lecture, |u| ≤ 0.25": lambda: lecture(0.25),
    "lecture, |u| ≤ 0.3": lambda: lecture(0.3),
    "joint": joint,
    "joint, terminal O_inf": joint_o_inf,
    "unstable": lambda: unstable(10),
    "drifting": drifting,
}


def rows_of(mpc, plans):
    """Multipliers of one plan (rows,), or of many, in the order of `row_table`."""
    flat = lambda multipliers: flat_multipliers(layout(mpc), multipliers)
    return np.asarray((jax.vmap(flat) if plans.cost.ndim else flat)(plans.multipliers))


# The least that a file for the commands holds.
MINIMAL_FILE = """
[system]
A = [[1.0, 1.0], [0.0, 1.0]]
B = [[1.0], [0.5]]
dt = 1.0
state_names = ["p", "v"]
[limits]
x_min = [-5.0, -5.0]
x_max = [5.0, 5.0]
u_min = [-1.0]
u_max = [1.0]
[cost]
Q = [1.0, 2.0]
R = [1.0]
[mpc]
horizon = 3
[sweep]
grid = [3, 4]
"""
