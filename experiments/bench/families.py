"""MPC problems that the field measures solvers on, with initial states for each.

joint: the lesson's robot joint, N = 20. springs4, 8, 16: masses on springs between walls with that
many states, forces on every other mass, N = 20 or, with _30, 30. quadrotor: planar, about hover.
cartpole: about the upright pole, unstable. turbompc: the random systems of TurboMPC's benchmark
(n = 8, m = 4, 39 intervals, |u| ≤ 1; _10: ≤ 10). All float64, with names as in FAMILIES.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import numpy as np
from scipy.linalg import solve_discrete_are

from jaxmpc.checks import fail, nearest
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.mpc.problem import MPC
from jaxmpc.sets.convex_sets import Box
from jaxmpc.systems.system import LinearSystem

# States of a family that differ from each other; more are these again.
DISTINCT = 65_536
# States that `family` labels at a time: one shape, hence one compiled program.
BLOCK = 8192


def regulator(
    A: np.ndarray,
    B: np.ndarray,
    Q: np.ndarray,
    R: np.ndarray,
    horizon: int,
    x: np.ndarray,
    u: np.ndarray,
) -> MPC:
    """The problem |x_k| ≤ x, |u_k| ≤ u with the LQR's terminal cost."""
    return MPC(
        LinearSystem(A, B),
        Q,
        R,
        horizon,
        states=Box(-x, x),
        inputs=Box(-u, u),
        terminal_cost=solve_discrete_are(A, B, Q, R),
    )


def sampled(Ac: np.ndarray, Bc: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """A, B of the system sampled with zero-order hold."""
    system = LinearSystem.from_continuous(Ac, Bc, dt)
    return np.asarray(system.A), np.asarray(system.B)


def joint() -> MPC:
    """The lesson's joint: angle and rate, torque."""
    Q = np.diag([50.0, 1.0])
    return MPC(
        LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]])),
        Q,
        np.array([[0.1]]),
        20,
        states=Box(np.array([-1.5, -2]), np.array([1.5, 2])),
        inputs=Box(np.array([-2.0]), np.array([2.0])),
        terminal_cost=Q,
    )


def springs(masses: int, horizon: int) -> MPC:
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


def quadrotor() -> MPC:
    """A planar quadrotor about hover: x, z, tilt and their rates; thrusts beside those of hover."""
    g, mass, inertia, arm = 9.81, 0.5, 0.005, 0.17
    Ac, Bc = np.zeros((6, 6)), np.zeros((6, 2))
    Ac[:3, 3:], Ac[3, 2] = np.eye(3), -g
    Bc[4], Bc[5] = 1 / mass, [-arm / inertia, arm / inertia]
    A, B = sampled(Ac, Bc, 0.05)
    Q, limits = np.diag([10, 10, 1, 1, 1, 0.1]), np.array([2, 2, 0.5, 2, 2, 4])
    return regulator(A, B, Q, 0.1 * np.eye(2), 20, limits, np.full(2, 1.5))


def cartpole() -> MPC:
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
) -> tuple[MPC, np.ndarray]:
    """A system of TurboMPC's benchmark and initial states (batch, n), from its own generator."""
    random = np.random.RandomState(seed)
    A = np.eye(n) + 0.1 * random.randn(n, n)
    values, V = np.linalg.eig(A)
    size = np.abs(values)
    values = np.where(size < 0.99, values, values / (size + 0.01))
    A = (V @ np.diag(values) @ np.linalg.inv(V)).real
    B, c, x0 = random.randn(n, m), 0.01 * random.randn(n), 5 * random.randn(batch, n)
    limit = np.full(m, umax)
    mpc = MPC(
        LinearSystem(A, B, c),
        np.eye(n),
        np.eye(m),
        horizon,
        inputs=Box(-limit, limit),
        terminal_cost=np.eye(n),
    )
    return mpc, x0


PROBLEMS: dict[str, Callable[[], MPC]] = {
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


def problem(name: str, horizon: int | None = None) -> MPC:
    """Return the problem of a family, with another horizon where one is given.

    Raises ValueError for a name that is not in FAMILIES.
    """
    if name not in FAMILIES:
        fail("family", f"no problem {name!r}", f"{nearest(name, FAMILIES)}{', '.join(FAMILIES)}")
    mpc = turbompc(LIMITS[name])[0] if name in LIMITS else PROBLEMS[name]()
    return mpc if horizon is None else replace(mpc, horizon=horizon)


def family(
    name: str, count: int, seed: int = 0, horizon: int | None = None
) -> tuple[MPC, np.ndarray]:
    """Return the problem of a family and feasible states (count, n).

    They are proved feasible by `map_feasible_set`, dense near the origin; the systems of TurboMPC
    have states without limits, and their own generator. Above 65,536 states they repeat.
    """
    mpc, few = problem(name, horizon), min(count, DISTINCT)
    x = _feasible(name, few, seed, mpc.horizon)
    return mpc, np.resize(x, (count, x.shape[1]))


@cache
def _feasible(name: str, count: int, seed: int, horizon: int) -> np.ndarray:
    """Return states of a family (count, n), all different."""
    if name in LIMITS:
        return turbompc(LIMITS[name], batch=count, seed=seed)[1]
    mpc, random = problem(name, horizon), np.random.default_rng(seed)
    h = half_widths(mpc)
    x = np.zeros((0, len(h)))
    while len(x) < count:
        size = random.uniform(0, 1, (BLOCK, 1)) ** (1 / 4)
        drawn = random.uniform(-h, h, (BLOCK, len(h))) * size
        x = np.concatenate([x, drawn[map_feasible_set(mpc, drawn).label == 1]])
    return x[:count]


def half_widths(mpc: MPC) -> np.ndarray:
    """Return the limits (n,) of |x|. Raises ValueError where the states have none."""
    if not isinstance(mpc.states, Box):
        fail("family", "the states have no limits", "Take another problem")
    return np.asarray(mpc.states.half_widths(), float)


def box_states(mpc: MPC, count: int, seed: int = 0) -> np.ndarray:
    """Return random states (count, n) of the box of the state limits, widened by 6 % so that some
    of them are infeasible."""
    high = 1.06 * half_widths(mpc)
    few = np.random.default_rng(seed).uniform(-high, high, (min(count, DISTINCT), len(high)))
    return np.resize(few, (count, len(high)))
