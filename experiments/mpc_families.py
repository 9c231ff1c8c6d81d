"""MPC problems that the field measures solvers on, each with feasible initial states.

joint: the lesson's robot joint, N = 20. springs4, 8, 16: masses on springs between walls with that
many states, forces on every other mass, N = 20 or, with _30, 30. quadrotor: planar, about hover.
cartpole: about the upright pole, unstable. turbompc: the random systems of TurboMPC's benchmark
(n = 8, m = 4, 39 intervals, |u| ≤ 1; _10: ≤ 10). All float64, with names as in FAMILIES.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.linalg import solve_discrete_are

import jaxmpc as jm


def regulator(
    A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray, horizon: int, x: np.ndarray,
    u: np.ndarray,
) -> jm.MPC:  # fmt: skip
    """The problem |x_k| ≤ x, |u_k| ≤ u with the LQR's terminal cost."""
    return jm.MPC(
        jm.LinearSystem(A, B), Q, R, horizon, states=jm.Box(-x, x), inputs=jm.Box(-u, u),
        terminal_cost=solve_discrete_are(A, B, Q, R),
    )  # fmt: skip


def sampled(Ac: np.ndarray, Bc: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A, B of the system sampled with zero-order hold."""
    system = jm.LinearSystem.from_continuous(Ac, Bc, dt)
    return np.asarray(system.A), np.asarray(system.B)


def joint() -> jm.MPC:
    """The lesson's joint: angle and rate, torque."""
    Q = np.diag([50.0, 1.0])
    return jm.MPC(
        jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]])), Q,
        np.array([[0.1]]), 20, states=jm.Box([-1.5, -2], [1.5, 2]), inputs=jm.Box([-2.0], [2.0]),
        terminal_cost=Q,
    )  # fmt: skip


def springs(masses: int, horizon: int) -> jm.MPC:
    """Masses in a row between walls, unit mass and stiffness, a force on every other one."""
    n, forces = 2 * masses, max(1, masses // 2)
    K = 2 * np.eye(masses) - np.eye(masses, k=1) - np.eye(masses, k=-1)
    Ac = np.block([[np.zeros((masses, masses)), np.eye(masses)], [-K, -0.1 * np.eye(masses)]])
    Bc = np.zeros((n, forces))
    Bc[masses + 2 * np.arange(forces), np.arange(forces)] = 1
    A, B = sampled(Ac, Bc, 0.1)
    return regulator(
        A, B, np.eye(n), 0.1 * np.eye(forces), horizon, np.ones(n), np.full(forces, 0.5)
    )


def quadrotor() -> jm.MPC:
    """A planar quadrotor about hover: x, z, tilt and their rates; thrusts beside those of hover."""
    g, mass, inertia, arm = 9.81, 0.5, 0.005, 0.17
    Ac, Bc = np.zeros((6, 6)), np.zeros((6, 2))
    Ac[:3, 3:], Ac[3, 2] = np.eye(3), -g
    Bc[4], Bc[5] = 1 / mass, [-arm / inertia, arm / inertia]
    A, B = sampled(Ac, Bc, 0.05)
    Q, limits = np.diag([10, 10, 1, 1, 1, 0.1]), np.array([2, 2, 0.5, 2, 2, 4])
    return regulator(A, B, Q, 0.1 * np.eye(2), 20, limits, np.full(2, 1.5))


def cartpole() -> jm.MPC:
    """A cart with an upright pole: positions, rates; force on the cart."""
    M, m, length, g = 1.0, 0.2, 0.5, 9.81
    Ac, Bc = np.zeros((4, 4)), np.zeros((4, 1))
    Ac[:2, 2:], Ac[2, 1], Ac[3, 1] = np.eye(2), m * g / M, (M + m) * g / (M * length)
    Bc[2:, 0] = 1 / M, 1 / (M * length)
    A, B = sampled(Ac, Bc, 0.05)
    limits = np.array([2, 0.5, 3, 3])
    return regulator(
        A, B, np.diag([10.0, 10, 1, 1]), np.array([[0.1]]), 30, limits, np.array([10.0])
    )


def turbompc(
    umax: float = 1.0, n: int = 8, m: int = 4, horizon: int = 39, batch: int = 1, seed: int = 0
) -> tuple[jm.MPC, np.ndarray]:
    """A system of TurboMPC's benchmark and initial states (batch, n), from its own generator."""
    random = np.random.RandomState(seed)
    A = np.eye(n) + 0.1 * random.randn(n, n)
    values, V = np.linalg.eig(A)
    size = np.abs(values)
    values = np.where(size < 0.99, values, values / (size + 0.01))
    A = (V @ np.diag(values) @ np.linalg.inv(V)).real
    B, c, x0 = random.randn(n, m), 0.01 * random.randn(n), 5 * random.randn(batch, n)
    limit = np.full(m, umax)
    mpc = jm.MPC(
        jm.LinearSystem(A, B, c), np.eye(n), np.eye(m), horizon, inputs=jm.Box(-limit, limit),
        terminal_cost=np.eye(n),
    )  # fmt: skip
    return mpc, x0


PROBLEMS: dict[str, Callable[[], jm.MPC]] = {
    "joint": joint,
    "springs4": partial(springs, 2, 20),
    "springs8": partial(springs, 4, 20),
    "springs8_30": partial(springs, 4, 30),
    "springs16": partial(springs, 8, 20),
    "springs16_30": partial(springs, 8, 30),
    "quadrotor": quadrotor,
    "cartpole": cartpole,
}
LIMITS = {"turbompc": 1.0, "turbompc_10": 10.0}
FAMILIES = (*PROBLEMS, *LIMITS)


def family(name: str, count: int, seed: int = 0) -> tuple[jm.MPC, np.ndarray]:
    """A problem and initial states (count, n) that are proved feasible, dense near the origin."""
    if name in LIMITS:
        return turbompc(LIMITS[name], batch=count, seed=seed)
    mpc, random = PROBLEMS[name](), np.random.default_rng(seed)
    h = np.asarray(mpc.states.upper, float)
    x = np.zeros((0, len(h)))
    while len(x) < count:
        size = random.uniform(0, 1, (4 * count, 1)) ** (1 / 4)
        drawn = random.uniform(-h, h, (4 * count, len(h))) * size
        x = np.concatenate([x, drawn[jm.map_feasible_set(mpc, drawn).label == 1]])
    return mpc, x[:count]
