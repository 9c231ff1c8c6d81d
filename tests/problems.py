"""The table of problems that all tests share, with what is known of each.

Every entry is a function, so that a test can change a field with `dataclasses.replace`. Exact
areas hold for the decimal data as printed; for the float64 data use `exact.feasible_polygon`.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxmpc as jm
from jaxmpc.mpc.plan import flat_multipliers
from jaxmpc.mpc.rows import layout
from jaxmpc.qp.residuals import residual_terms


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


def residuals(qp, z, y):
    """Primal and dual residual and duality gap of a pair, in the units of the program."""
    return [jnp.max(jnp.abs(v), initial=0.0) for v, *_ in residual_terms(qp, z, y)]


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


def octahedron(n=3, radius=0.3):
    """{x: Σ|x_i| ≤ radius}; 2^(n−1) facets meet in each vertex."""
    signs = np.stack(np.meshgrid(*[[1.0, -1.0]] * n), -1).reshape(-1, n)
    return jm.Polytope(signs, np.full(len(signs), radius))


def apex():
    """Three states, three inputs: x_N sits on apexes of the terminal set for open sets of x_0."""
    return jm.MPC(
        system=jm.LinearSystem(0.9 * np.eye(3), np.diag([1.0, 0.5, 0.8])), Q=np.eye(3),
        R=np.eye(3), horizon=1, states=symmetric(1.0, 1.0, 1.0),
        inputs=symmetric(1.0, 1.5, 1.0), terminal_set=octahedron(),
    )  # fmt: skip


def duplicated():
    """The lecture's problem with state rows twice, scaled, and a row that touches a corner."""
    H = np.vstack([np.eye(2), -np.eye(2), 3 * np.eye(2), [[1.0, 1.0]]])
    rows = jm.Polytope(H, np.array([1.0, 1, 1, 1, 3, 3, 2]))
    return replace(lecture(), states=rows, terminal_set=rows)


def pair():
    """Two lectures side by side: regions and volume are the products."""
    a = lecture()
    both = lambda M: np.kron(np.eye(2), M)
    return replace(
        a, system=jm.LinearSystem(both(a.system.A), both(a.system.B)), Q=both(a.Q), R=both(a.R),
        states=symmetric(*[1.0] * 4), inputs=symmetric(0.25, 0.25),
        terminal_cost=both(a.terminal_cost), terminal_set=symmetric(*[1.0] * 4),
    )  # fmt: skip


def least_distance(mpc, x):
    """Optimal inputs (N, m) by non-negative least squares on rolled-out matrices."""
    from scipy.optimize import nnls

    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    A, B = mpc.system.A, mpc.system.B
    drift = np.zeros(n) if mpc.system.c is None else mpc.system.c
    Phi, Gamma, phi = [np.eye(n)], [np.zeros((n, N * m))], [np.zeros(n)]
    for k in range(N):
        step = A @ Gamma[-1]
        step[:, k * m : (k + 1) * m] += B
        Phi.append(A @ Phi[-1])
        Gamma.append(step)
        phi.append(A @ phi[-1] + drift)
    end = np.zeros((n, n)) if mpc.terminal_cost is None else mpc.terminal_cost
    weights = [mpc.Q] * N + [end]
    P = sum(G.T @ W @ G for G, W in zip(Gamma, weights, strict=True))
    P = P + np.kron(np.eye(N), mpc.R)
    free = [M @ x + d for M, d in zip(Phi, phi, strict=True)]
    q = sum(G.T @ W @ v for G, W, v in zip(Gamma, weights, free, strict=True))
    rows, bounds = [], []
    sets = [(mpc.states, k) for k in range(1, N)] + [(mpc.terminal_set, N)]
    for set_, k in sets:
        H, lower, upper = (np.asarray(v) for v in set_.rows())
        rows += [H @ Gamma[k], -H @ Gamma[k]]
        bounds += [upper - H @ free[k], H @ free[k] - lower]
    eye = np.eye(N * m)
    rows += [eye, -eye]
    bounds += [np.tile(mpc.inputs.upper, N), -np.tile(mpc.inputs.lower, N)]
    G, h = np.vstack(rows), np.concatenate(bounds)
    G, h = G[np.isfinite(h)], h[np.isfinite(h)]
    factor = np.linalg.cholesky(P)
    M = np.linalg.solve(factor, G.T).T
    # min |y|², M y ≤ h + M L⁻¹q (Lawson & Hanson 1974, ch. 23).
    shift = np.linalg.solve(factor, q)
    right = h + M @ shift
    if right.min() < 0:
        E = -np.vstack([M.T, right / -right.min()])
        y, _ = nnls(E, np.eye(len(E))[-1], maxiter=10_000)
        r = E @ y - np.eye(len(E))[-1]
        shift = shift - right.min() * r[:-1] / r[-1]
    return -np.linalg.solve(factor.T, shift).reshape(N, m)


def unstable_systems(count):
    """A (3 count, 2, 2), B and states of random systems, `count` for each of three factors 1.3,
    1.8 and 2.5 by which they grow at a step, in coordinates that may nearly coincide."""
    rng, n = np.random.default_rng(3), 2
    growth = np.repeat([1.3, 1.8, 2.5], count)
    T = np.eye(n) + rng.uniform(-0.9, 0.9, (len(growth), n, n))
    values = np.stack([growth, rng.uniform(-1, 1, len(growth)) * growth], axis=1)
    A = T @ (values[:, :, None] * np.linalg.inv(T))
    return A, rng.normal(size=(len(growth), n, 1)), rng.normal(size=(len(growth), n))
