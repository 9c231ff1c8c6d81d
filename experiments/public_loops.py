"""Closed loops of a public collection of MPC benchmarks, each sample against another solver.

    python experiments/public_loops.py

Plants, weights, limits, horizons and start states are those of mpcBenchmarking (H. J. Ferreau,
H. Peyrl, D. Kouzoupis, A. Zanelli, github.com/ferreau/mpcBenchmarking), restated from their
equations; what its files do not hold (the quadcopter's matrices, the crane's time constants, the
chain's rest) is that of the papers it cites or is computed here. A number behind a name is the
variant.

At every sample Clarabel, or PIQP where it does not end, solves the problem as stated, in states and
inputs, the dynamics as equations. A loop passes when the controller could be made and, at every
sample where a solution exists, the plan is SOLVED, its cost that of the other solver, and each
limit and each equation of the dynamics holds. References are followed as they are now, at x_N too.
"cost": the largest difference, relative to the optimal
cost (or to 1e-6 of the largest in the loop). "limit": the largest violation in units of its row,
"row": relative to the sum of the absolute terms of its row. The plant follows the plan; where that
is not SOLVED, the other solver's. It stops where neither finds one.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import clarabel
import jax
import numpy as np
import scipy
import tyro
from scipy import sparse

import jaxmpc as jm

INF = np.inf
TOLERANCE = 1e-6  # of costs and rows, relative
ASKED = 1e-9  # of the other solvers


@dataclass(frozen=True)
class Settings:
    """samples: of the longest loop (its segments are shortened alike). names: loops whose name
    begins with one of these (none: all)."""

    samples: int = 80
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Loop:
    """references: segments (samples, state reference (n,)), followed without knowing those ahead.
    follow: the plant (x, u) -> next x where that is not the model."""

    name: str
    mpc: jm.MPC
    x0: np.ndarray
    references: tuple[tuple[int, np.ndarray], ...]
    input_reference: np.ndarray
    follow: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None

    def reference(self, cap: int) -> np.ndarray:
        """The reference (samples, n) of the loop, shortened to about `cap` samples."""
        share = min(1.0, cap / sum(length for length, _ in self.references))
        return np.vstack([
            np.tile(value, (max(1, round(share * length)), 1)) for length, value in self.references
        ])  # fmt: skip


def problem(
    system: jm.LinearSystem, Q: Any, R: Any, N: int, *, u: Any = None, y: Any = None, C: Any = None,
    P: Any = None, blocks: Any = None, **more: Any,
) -> jm.MPC:  # fmt: skip
    """The MPC problem with the cost Σ (Cx)'Q(Cx) + u'Ru + x_N'P x_N and the limits u of inputs and
    y of outputs Cx at k = 0..N−1, each a pair or a symmetric bound; C None: the states."""
    n, m = system.n, system.m
    square = lambda W, size: np.diag(np.broadcast_to(np.asarray(W, float), size).astype(float))
    weight = square(Q, n if C is None else len(C))
    sides = lambda v, size: [
        np.broadcast_to(np.asarray(side, float), size)
        for side in (v if isinstance(v, tuple) else (-np.asarray(v, float), v))
    ]
    if u is not None:
        more["inputs"] = jm.Box(*sides(u, m))
    if y is not None and C is None:
        more["states"] = jm.Box(*sides(y, n))
    elif y is not None:
        more["outputs"] = jm.Outputs(C, *sides(y, len(C)))
    return jm.MPC(
        system, weight if C is None else C.T @ weight @ C, square(R, m), N,
        terminal_cost=P, control_horizon=blocks, **more,
    )  # fmt: skip


def loop(
    name: str, mpc: jm.MPC, x0: Any, references: Any = 30, input_reference: Any = 0.0, **more: Any
) -> Loop:
    """references: number of samples about the origin, or segments."""
    n, m = mpc.system.n, mpc.system.m
    segments = ((references, 0.0),) if isinstance(references, int) else references
    spread = lambda v, size: np.broadcast_to(np.asarray(v, float), size)
    return Loop(
        name, mpc, np.asarray(x0, float), tuple((k, spread(v, n)) for k, v in segments),
        spread(input_reference, m), **more,
    )  # fmt: skip


def lqr_cost(system: jm.LinearSystem, Q: Any, R: Any) -> np.ndarray:
    """Solution of the Riccati equation, by SciPy; Q, R diagonals or matrices."""
    Q, R = (np.diag(W) if np.ndim(W) == 1 else np.asarray(W, float) for W in (Q, R))
    return scipy.linalg.solve_discrete_are(system.A, system.B, Q, R)


sampled = jm.LinearSystem.from_continuous


def aircraft() -> list[Loop]:
    """AFTI-F16 with two saturating surfaces: states speed, angle of attack, pitch rate, pitch."""
    A = [[-0.0151, -60.5651, 0, -32.174], [-0.0001, -1.3411, 0.9929, 0],
         [0.00018, 43.2541, -0.86939, 0], [0, 0, 1, 0]]  # fmt: skip
    B = [[-2.516, -13.136], [-0.1689, -0.2514], [-17.251, -1.5766], [0, 0]]
    system, C = sampled(A, B, 0.05), np.eye(4)[[1, 3]]
    two, four = np.array([0.5, 100]), np.array([INF, 0.5, INF, 100])
    blocks, up, x0 = (1, 1, 3, 5), [0, 0, 0, 10.0], np.zeros(4)
    heavy = np.array([1e-4, 100, 1e-3, 100])
    track = lambda *heights: tuple((50, [0, 0, 0, h]) for h in heights)
    by = lambda R, y, **more: problem(system, 10, R, 10, u=25, y=y, C=C, **more)
    published = lambda N: problem(system, heavy, 1e-2, N, u=25, y=four, P=np.diag(heavy))
    return [
        loop("aircraft 1", by(0, two, blocks=blocks), x0, ((50, up),)),
        loop("aircraft 2", by(1e-3, two), x0, ((70, up),)),
        loop("aircraft 3", by(0, None, blocks=blocks), x0, ((50, up),)),
        loop("aircraft 4", by(0, two), x0, ((50, up),)),
        loop(
            "aircraft 10", problem(system, [0, 10, 0, 10], 0, 10, u=25, y=four, blocks=blocks),
            x0, ((50, up),),
        ),
        loop(
            "aircraft 11", problem(system, [0.1, 10, 0, 10], 1e-4, 10, u=25, y=four), x0,
            ((50, up),),
        ),
        loop("aircraft 12", published(10), x0, ((35, up), (45, 0.0))),
        loop("aircraft 13", published(10), x0, track(10, 0, 5, -1, 0)),
        loop("aircraft 14", published(50), x0, track(10, 0, 5, -1, 0)),
    ]  # fmt: skip


def ball_on_plate() -> list[Loop]:
    """One axis of a ball on a plate: position, speed."""
    system = jm.LinearSystem([[1, 0.01], [0, 1.0]], [-0.0004, -0.0701], dt=0.01)
    y, P = (np.array([-0.2, -0.1]), np.array([0.01, 0.1])), np.diag([100, 10.0])
    by = lambda N=15, u=(-0.0524, 0.0524): problem(system, [100, 10], 1, N, u=u, y=y, P=P)
    moving = ((60, [0, 0.05]),)
    return [
        loop("ball on plate 1", by(), [-0.05, 0.05], moving),
        loop("ball on plate 2", by(), [-0.05, 0], moving),
        loop("ball on plate 3", by(u=(-0.03, 0.0524)), [-0.17, 0], moving),
        loop("ball on plate 4", by(25), [-0.15, 0], 150),
    ]


def distillation_column() -> list[Loop]:
    """Davison's binary column: eleven compositions and pressure, sampled every minute."""
    A = np.diag([-14, -13.8, -14.1, -15.8, -31.2, -35.2, -42.2, -48.2, -57.2, -48.3, -18.5])
    A += np.diag([9.5, 9.5, 9.5, 9.5, 20.2, 20.2, 20.2, 20.2, 20.2, 25.5], -1)
    A += np.diag([4.3, 4.6, 6.3, 11, 15, 22, 28, 37, 42, 0.5], 1)
    A[[1, 2, 7, 8], 10] = [0.5, 0.2, 0.2, 0.5]
    B = np.array([
        [0, 5, 2, 1, 0, 0, -5, -10, -40, -20, 460], [0, -40, -20, -10, 0, 0, 10, 30, 5, 2, 460],
        [0, 2500, 5000, 5000, 5000, 5000, 5000, 5000, 2500, 2500, 0],
    ]).T  # fmt: skip
    x0 = [0.33804, 1.1006, 2.4606, 3.7428, 3.2063, 4.2654, 3.8579, 2.7192, 1.4173, 0.6067, 0.88599]
    system, C = sampled(1e-3 * A, 1e-6 * B, 60.0), np.eye(11)[[9, 0, 10]]
    mpc = problem(system, 100, 1, 15, u=np.array([2.5, 2.5, 0.3]), C=C)
    return [loop("distillation column 1", mpc, x0, 45)]


def dc_motor() -> list[Loop]:
    """Bemporad and Mosca's servo: angle and speed of the load, of the motor; limit of torsion."""
    stiff, gear, load, motor = 1280.2, 20.0, 10.0, 0.5
    damping = (0.1 + 10**2 / 20) / motor
    A = [[0, 1, 0, 0], [-stiff / load, -25 / load, stiff / gear / load, 0], [0, 0, 0, 1],
         [stiff / gear / motor, 0, -stiff / gear**2 / motor, -damping]]  # fmt: skip
    system = sampled(A, [0, 0, 0, 10 / 20 / motor], 0.1)
    torsion, weight = np.array([[stiff, 0, -stiff / gear, 0], [0, 1, 0, 1]]), [100, 0, 100, 0]

    def of(number: int, N: int, high: float, volts: float = 220, torque: float = 78.5398,
           R: float = 1e-4, blocks: Any = None) -> Loop:  # fmt: skip
        limit = jm.Outputs(torsion, [-torque, -100], [torque, 100])
        mpc = problem(
            system, weight, R, N, u=volts, P=np.diag(weight), outputs=limit, blocks=blocks
        )
        ends = (np.array([high / gear, 0, high, 0]), np.array([-high / gear, 0, -high, 0]))
        wave = ((51, ends[0]), (50, ends[1]), (50, ends[0]), (50, ends[1]))
        return loop(f"DC motor {number}", mpc, np.zeros(4), wave)

    return [
        of(1, 10, 10, blocks=(1, 9)), of(2, 20, 10), of(3, 100, 10), of(4, 100, 10, volts=30),
        of(5, 20, 3, torque=5), of(9, 20, 3, torque=5, R=1),
    ]  # fmt: skip


def inverted_pendulums() -> list[Loop]:
    """Davison's double and triple pendulum, a torque at each joint, and Maeder's single one."""
    found = []
    A = [[0, 1, 0, 0], [9.8, 0, -9.8, 0], [0, 0, 0, 1], [-9.8, 0, 29.4, 0]]
    system, C = sampled(A, [[0, 0], [1, -2], [0, 0], [-2, 5]], 0.01), np.eye(4)[[0, 2]]
    P = lqr_cost(system, 100 * C.T @ C, 0.1 * np.eye(2))
    for k, (x0, y) in enumerate(
        (([0.1, 0.05, 0.1, 0.05], None), ([0, 0, 0.1, 0.5], None), ([0.1, 0.05, 0.1, 0.05], 0.12))
    ):
        mpc = problem(system, 100, 0.1, 10, u=5, y=y, C=C, P=P)
        found.append(loop(f"double pendulum {k + 1}", mpc, x0, 440))
    K = np.array([[29.4, -19.6, -3.6e-16], [-29.4, 39.2, -9.8], [0, -19.6, 19.6]])
    M = np.array([[1.67, -2.67, 1], [-2.33, 4.83, -3.5], [0.667, -2.67, 4]])
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [K, np.zeros((3, 3))]])
    system, C = sampled(A, np.vstack([np.zeros((3, 3)), M]), 0.01), np.eye(6)[:3]
    P = lqr_cost(system, 100 * C.T @ C, 0.1 * np.eye(3))
    for k, y in enumerate((None, 0.15, 0.12)):
        mpc = problem(system, 100, 0.1, 30, u=5, y=y, C=C, P=P)
        found.append(loop(f"triple pendulum {k + 1}", mpc, [0.05] * 3 + [0.025] * 3, 420))
    A = [[1.001, -0.05, -0.001], [-0.05, 1.003, 0.05], [-0.001, 0.05, 1.001]]
    system = jm.LinearSystem(A, [0, 0.001, 0.05])
    P = lqr_cost(system, np.eye(3), [0.1])
    for k, (N, cost) in enumerate(((15, P), (15, np.diag(np.diag(P))), (2, P))):
        mpc = problem(system, 1, 0.1, N, u=1.25, P=cost)
        found.append(loop(f"pendulum {k + 1}", mpc, [0.6] * 3, 150))
    return found


def small_examples() -> list[Loop]:
    """Two-state examples of FiOrdOs, FORCES, a course at ETH, and Bemporad's terminal set."""
    found = []
    system = jm.LinearSystem([[0.8, 1], [0, 0.9]], [-1, 2.0])
    P = scipy.linalg.solve_discrete_lyapunov(np.asarray(system.A).T, np.eye(2))
    riccati = lqr_cost(system, np.eye(2), [1.0])
    box = (np.array([-3.5, -0.5]), np.array([3.5, 2]))
    for k, (x0, cost, y) in enumerate((([1, 2], P, None), ([1, 2], riccati, box),
                                       ([10, 20], P, None))):  # fmt: skip
        mpc = problem(system, 1, 1, 5, u=0.7, y=y, P=cost)
        found.append(loop(f"FiOrdOs {k + 1}", mpc, x0, 20))
    system = jm.LinearSystem([[1.1, 1], [0, 1.0]], [1, 0.5])
    P = lqr_cost(system, np.eye(2), [1.0])
    away, home = [4, -4.0], 0.0
    for k, (N, u, segments) in enumerate((
        (9, 0.5, ((21, home),)), (20, 0.5, ((45, home), (25, away))),
        (100, 0.5, ((125, home), (25, away))), (10, 0.4, ((49, home), (61, away))),
    )):  # fmt: skip
        mpc = problem(system, 1, 1, N, u=u, y=5, P=P)
        found.append(loop(f"FORCES {k + 1}", mpc, [-4, 2], segments))
    system = jm.LinearSystem([[0.7115, -0.4345], [0.4345, 0.8853]], [0.2173, 0.0573])
    P = lqr_cost(system, 10 * np.eye(2), [1.0])
    steps = ((40, home), (80, [5, 15.0]), (100, [-5, -5.0]))
    for k, (x0, N, blocks, segments) in enumerate((
        ([10, 0], 10, None, ((30, home),)), ([10, 0], 20, None, steps),
        ([100, -100], 10, (1, 9), ((50, home),)), ([100, -100], 50, None, ((50, home),)),
        ([100, -100], 100, None, ((125, home), (25, [10, 10.0]))),
    )):  # fmt: skip
        mpc = problem(system, 10, 1, N, u=5, P=P, blocks=blocks)
        found.append(loop(f"toy {k + 1}", mpc, x0, segments))
    system = jm.LinearSystem([[0.4424, 1], [-0.4746, 0.4424]], [0, 2.0623], dt=0.2)
    C, rest = np.array([[-0.7013, 1.9407]]), 0.5 * np.array([2.6252, 1.4639])
    T = np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [0.4424, 1], [-0.4424, -1]])
    P = lqr_cost(system, 10 * C.T @ C, [1.0])
    for k, N in enumerate((6, 200)):
        last = jm.Polytope(T, 0.1 + T @ rest)
        mpc = problem(system, 10, 1, N, u=1, y=1, C=C, P=P, terminal_set=last)
        found.append(loop(f"terminal polytope {k + 1}", mpc, [0, 0], ((50, rest),), 0.5))
    return found


def helicopter() -> list[Loop]:
    """Toendel's laboratory helicopter: elevation and pitch, their rates and integrals."""
    A = 0.99 * np.eye(6)
    A[[0, 1, 4, 5], [2, 3, 0, 1]] = 0.01
    B = np.outer([0, 0.0001, 0.0019, 0.0132, 0, 0], [1, -1])
    system, Q = jm.LinearSystem(A, B), np.array([100, 100, 10, 10, 400, 200.0])
    y, P = np.array([INF, INF, 0.44, 0.6, INF, INF]), lqr_cost(system, Q, [1e-3, 1e-3])
    last = jm.Box(-np.ones(6), np.ones(6))
    by = lambda N, R, P: problem(system, Q, R, N, u=(-1, 3), y=y, P=P, terminal_set=last)
    return [
        loop(f"helicopter {k}", by(N, R, P), [0.5, 0.5, 0, 0, 0, 0], 100)
        for k, N, R, P in ((1, 3, 1e-3, P), (2, 20, 1e-3, P), (4, 10, 1, np.diag(np.diag(P))))
    ]


def slope(f: Callable, at: np.ndarray) -> np.ndarray:
    """Jacobian by complex steps: f takes and returns vectors."""
    return np.stack([f(at + 1e-30j * e).imag / 1e-30 for e in np.eye(len(at))], axis=1)


def linearized(f: Callable, x: Any, u: Any, dt: float) -> jm.LinearSystem:
    """ẋ = f(x, u) linearized about (x, u) and sampled, affine."""
    x, u = np.asarray(x, float), np.asarray(u, float)
    A = slope(lambda x: f(x, u), x.astype(complex))
    B = slope(lambda u: f(x.astype(complex), u), u.astype(complex))
    return sampled(A, B, dt, f(x, u) - A @ x - B @ u)


def tank_reactor() -> list[Loop]:
    """Klatt and Engell's stirred tank: two concentrations, temperatures of tank and jacket."""

    def reaction(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        a, b, T, J = x
        k1 = 1.287e12 * np.exp(-9758.3 / (273.15 + T))
        k3 = 9.043e9 * np.exp(-8560.0 / (273.15 + T))
        heat = (k1 * a * 4.2 - k1 * b * 11.0 - k3 * a * a * 41.85) / (0.9342 * 3.01)
        wall = 4032.0 * 0.215
        return np.array([
            u[0] * (5.1 - a) - k1 * a - k3 * a * a, -u[0] * b + k1 * a - k1 * b,
            u[0] * (104.9 - T) - heat + wall / (0.9342 * 3.01 * 10) * (J - T),
            (u[1] + wall * (T - J)) / (5.0 * 2.0),
        ]) / 3600  # fmt: skip

    rest, input_rest = np.array([2.14, 1.09, 114.2, 112.9]), np.array([14.19, -1113.5])
    system = linearized(reaction, rest, input_rest, 75.0)
    mpc = problem(system, [0.2, 1, 0.5, 0.2], [0.5, 5e-7], 20, u=([3, -9000], [35, 0]))

    def follow(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        answer = scipy.integrate.solve_ivp(
            lambda _, x: reaction(x, u), (0, 75.0), x, method="LSODA", rtol=1e-9, atol=1e-9
        )
        return answer.y[:, -1]

    given = mpc, [0, 0, 85, 85], ((80, rest),), input_rest
    return [loop("tank reactor 1", *given), loop("tank reactor 2", *given, follow=follow)]


def crane() -> list[Loop]:
    """Overhead crane of KU Leuven about rest: cart, cable, angle and the two voltages, whose rates
    are the inputs."""
    cart, winch = (0.012790605943772, 0.047418203070092), (0.024695192379264, 0.034087337273386)

    def motion(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        _, v, L, w, angle, rate, on_cart, on_winch = x
        pull, wind = (cart[1] * on_cart - v) / cart[0], (winch[1] * on_winch - w) / winch[0]
        turn = -(9.81 * np.sin(angle) + pull * np.cos(angle) + 2 * w * rate) / L
        return np.array([v, pull, w, wind, rate, turn, u[0], u[1]])

    rest = np.array([0, 0, 0.9, 0, 0, 0, 0, 0])
    y = np.array([INF] * 6 + [10, 10])
    at = lambda position, length: np.array([position, 0, length, 0, 0, 0, 0, 0])
    mpc = problem(
        linearized(motion, rest, np.zeros(2), 0.01), [56, 6, 115, 0.01, 10, 10, 1e-8, 1e-8], 1e-5,
        100, u=100, y=y, blocks=(10,) * 10,
    )  # fmt: skip
    track = ((200, at(0, 1)), (800, at(0.2, 0.7)), (800, at(0.5, 0.5)), (800, at(0.1, 0.5)))
    return [loop("crane 2", mpc, rest, (*track, (900, at(0.2, 0.8))))]


def quadcopter() -> list[Loop]:
    """Quadcopter of the MPT toolbox about hover: three angles, position, and their rates."""
    A, B = np.eye(12), np.zeros((12, 4))
    A[[0, 1, 2], [6, 7, 8]] = 0.1
    A[[3, 4, 5], [9, 10, 11]] = 0.0992
    A[[9, 10, 11], [9, 10, 11]] = 0.9846
    A[[3, 4], [0, 1]], A[[3, 4], [6, 7]] = (0.0488, -0.0488), (0.0016, -0.0016)
    A[[9, 10], [0, 1]], A[[9, 10], [6, 7]] = (0.9734, -0.9734), (0.0488, -0.0488)
    roll, pitch, yaw, lift = np.array([[0, -1, 0, 1], [-1, 0, 1, 0], [-1, 1, -1, 1], [1] * 4])
    B[[0, 3, 6, 9]] = np.outer([0.0726, 0.0006, 1.4512, 0.0236], roll)
    B[[1, 4, 7, 10]] = np.outer([0.0726, -0.0006, 1.4512, -0.0236], pitch)
    B[[2, 8]], B[[5, 11]] = np.outer([0.0152, 0.3049], yaw), np.outer([0.0106, 0.2107], lift)
    system, free = jm.LinearSystem(A, B, dt=0.1), [INF] * 6
    tilt = np.pi / 6
    y = (
        np.array([-tilt, -tilt, -INF, -INF, -INF, -1, *[-INF] * 6]),
        np.array([tilt, tilt, INF, INF, INF, INF, *free]),
    )
    low, high = 9.6 - 10.5916, 13 - 10.5916
    Q = np.array([0, 0, 10, 10, 10, 10, 0, 0, 0, 5, 5, 5.0])
    by = lambda N, **more: problem(system, Q, 0.1, N, u=(low, high), y=y, **more)
    start = lambda share, position, rates: share * np.array([tilt, tilt, *position, *[rates] * 6])
    slow = dict(Q=1e-4 * Q, R=100.0, N=20)
    cylinder = np.zeros((2, 12))
    cylinder[:, 3:5] = [[-1, 1], [1, 1]]
    P = np.diag(np.diag(lqr_cost(system, Q, [0.1] * 4)))
    Q6 = [0.1, 0.1, 10, 10, 10, 10, 0.01, 0.1, 0.1, 5, 5, 5]
    turned = [0, 0, 1.0, *[0] * 9]
    origin, far = np.zeros(12), start(0.3, (5, 5, 5, 5), 5)
    return [
        loop("quadcopter 1", by(10, blocks=(1, 9)), origin, ((30, turned),)),
        loop("quadcopter 2", by(20), origin, 50),
        loop("quadcopter 3", by(100), origin, 50),
        loop("quadcopter 4", problem(system, u=(low - 5, high + 5), y=y, **slow), far, 150),
        loop(
            "quadcopter 5",
            problem(system, **slow, outputs=jm.Outputs(cylinder, [-3.5, -3.5], [3.5, 3.5])),
            start(0.2, (5, 8, 8, 5), 10), 150,
        ),
        loop(
            "quadcopter 6", problem(system, Q6, 0.1, 10, u=(low, high), y=y, P=P),
            start(0.15, (5, 5, 5, 5), 1), 50,
        ),
    ]  # fmt: skip


def robot_arm() -> list[Loop]:
    """Zometa's arm of two links: angle and speed of each."""
    A = [[0, 1, 0, 0], [0, -17.2, 0, 0], [0, 0, 0, 1], [0, 1, 0, -16.1]]
    system = sampled(A, [[0, 0], [2.62, 0], [0, 0], [0, 2.48]], 0.004)
    Q, y = np.array([1.14e4, 22.4, 1.14e4, 29.4]), np.array([INF, 1, INF, 1])
    by = lambda N: problem(system, Q, [0.22, 0.237], N, u=np.array([100, 25.0]), y=y, P=np.diag(Q))
    return [loop(f"robot arm {k + 1}", by(N), [-1, 0, 1, 0], 400) for k, N in enumerate((5, 20))]


def fractionator() -> list[Loop]:
    """Shell's heavy oil fractionator without its dead times: nine lags, a column an input."""
    gain = np.array([[4.05, 1.77, 5.88], [5.39, 5.72, 6.9], [4.38, 4.42, 7.2]])
    time = np.array([[50, 60, 50], [50, 60, 40], [33, 44, 19]])
    system = sampled(np.diag(-1 / time.T.ravel()), np.kron(np.eye(3), np.ones((3, 1))), 3.0)
    C = np.hstack([np.diag(column) for column in (gain / time).T])
    x0 = [1, 0.2, 1, 0.2, 0.3, 0.1, 0, 0.2, 0.22]
    return [
        loop(f"fractionator {k + 1}", problem(system, 100, 1e-5, N, u=0.5, y=0.5, C=C), x0, length)
        for k, (N, length) in enumerate(((20, 30), (40, 100)))
    ]


def spacecraft() -> list[Loop]:
    """Attitude of Hegrenaes' satellite: three rates, a wheel's speed, three Euler parameters."""
    i1, i2, i3, wheel = 4.25, 4.337, 3.664, 4e-5
    k = i2 - wheel
    kx, ky, kz = (i2 - i3) / i1, (i1 - i3) / i2, (i2 - i1) / i3
    A, B = np.zeros((7, 7)), np.zeros((7, 4))
    A[0, [2, 4]], A[2, [0, 6]] = (1 - kx, -8 * kx), (kz - 1, -2 * kz)
    A[[1, 3], 5] = -6 * ky * i2 / k
    A[[4, 5, 6], [0, 1, 2]] = 0.5
    B[[0, 1, 2], [0, 1, 2]] = 1 / i1, 1 / k, 1 / i3
    B[1, 3], B[3, [1, 3]] = -1 / k, (-1 / k, i2 / k * wheel)
    y = np.array([1, 1, 1, 800, 1, 1, 1.0])
    return [
        loop(
            f"spacecraft {number}",
            problem(
                sampled(A, B, 0.1), [500, 500, 500, 1e-7, 1, 1, 1], [200, 200, 200, 1], 20,
                u=np.array([0.0484, 0.0484, 0.0398, 0.002]), y=y, blocks=blocks,
            ),
            [0.1] * 7, 500,
        )
        for number, blocks in ((1, (1, 19)), (2, 10))
    ]  # fmt: skip


def springs() -> list[Loop]:
    """Three masses between springs: speeds and positions; a force on the first, a speed of the
    last."""
    K = np.diag([-2.0] * 3) + np.diag([1.0] * 2, 1) + np.diag([1.0] * 2, -1)
    A = np.block([[np.zeros((3, 3)), K], [np.eye(3), np.zeros((3, 3))]])
    B = np.zeros((6, 2))
    B[[0, 5], [0, 1]] = 1
    system, x0 = sampled(A, B, 0.01), np.array([0, 0, 3.5, 3.5, 0, 0])
    P = lqr_cost(system, [0.01] * 6, [0.01] * 2)
    return [
        loop(f"springs {k}", problem(system, 0.01, 0.01, N, u=0.5, y=3.5, P=P), x, length)
        for k, N, x, P, length in (
            (1, 200, x0, P, 10), (2, 20, x0 / 2, P, 300), (3, 40, x0 / 2, P, 300),
            (4, 20, x0 / 2, np.diag(np.diag(P)), 300),
        )
    ]  # fmt: skip


def chain() -> list[Loop]:
    """Nine masses on springs between a wall and an end that moves at speed u, linearized about
    rest: positions, the end, speeds; pushed for a second. Variants 13 and 14: without and with a
    second wall."""
    m, length, g = 0.03, 0.0333, 9.81

    def motion(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        links = np.diff(x[:30].reshape(10, 3), axis=0, prepend=np.zeros((1, 3)))
        pull = (1 - length / np.sqrt(np.sum(links**2, axis=1, keepdims=True))) * links
        push = np.diff(pull, axis=0) / m - g * np.array([0, 0, 1])
        return np.concatenate([x[30:], u, push.ravel()])

    end, guess = np.array([1.0, 0, 0]), np.outer(np.arange(1, 10) / 10, [1, 0, 0])
    whole = lambda p: np.concatenate([p, end, np.zeros(27)])
    sag = np.linspace(-0.9, 0.9, 9)[:, None] ** 2 - 1
    at_rest = scipy.optimize.fsolve(
        lambda p: motion(whole(p), np.zeros(3))[30:], (guess + sag * [0, 0, 1]).ravel(), xtol=1e-13
    )
    rest = whole(at_rest)
    system = linearized(motion, rest, np.zeros(3), 0.2)
    x0 = rest
    for _ in range(5):
        x0 = system.A @ x0 + system.B @ [-1, 1, 1] + system.c
    Q, wall = [0] * 27 + [50] * 3 + [2] * 27, np.eye(57)[1:27:3]
    limit = jm.Outputs(wall, np.full(9, -0.2), np.full(9, INF))
    by = lambda **more: problem(system, Q, 0.02, 20, u=1, **more)
    return [
        loop("chain 13", by(), x0, ((40, rest),)),
        loop("chain 14", by(outputs=limit), x0, ((40, rest),)),
    ]


def loops() -> list[Loop]:
    """All of them."""
    makers = (
        aircraft, ball_on_plate, distillation_column, dc_motor, inverted_pendulums, small_examples,
        helicopter, tank_reactor, crane, quadcopter, robot_arm, fractionator, spacecraft, springs,
        chain,
    )  # fmt: skip
    return [one for maker in makers for one in maker()]


class Statement:
    """The problem of an MPC in w = (x_0, …, x_N, u_0, …, u_{N−1}), written from its fields alone:

        min (w − r)'H(w − r)  s.t.  E w = e(x_0),  lower ≤ G w ≤ upper.

    E: x_0, the dynamics, and inputs held equal; G: every limit, a row each.
    """

    def __init__(self, mpc: jm.MPC) -> None:
        system, N = mpc.system, mpc.horizon
        A, B = np.asarray(system.A), np.asarray(system.B)
        (n, m), self.mpc = B.shape, mpc
        size = (N + 1) * n + N * m
        self.sizes = np.zeros(size)
        state = lambda k: slice(k * n, (k + 1) * n)
        control = lambda k: slice((N + 1) * n + k * m, (N + 1) * n + (k + 1) * m)
        P = np.zeros((n, n)) if mpc.terminal_cost is None else np.asarray(mpc.terminal_cost)
        weights = [np.asarray(mpc.Q)] * N + [P] + [np.asarray(mpc.R)] * N
        self.H = sparse.csc_matrix(scipy.linalg.block_diag(*weights))
        equal: list[tuple[list, Any]] = [([(state(0), np.eye(n))], np.zeros(n))]
        drift = np.zeros(n) if system.c is None else np.asarray(system.c)
        for k in range(N):
            step = [(state(k + 1), np.eye(n)), (state(k), -A), (control(k), -B)]
            equal.append((step, drift))
            if k and mpc.moves[k] == mpc.moves[k - 1]:
                held = [(control(k), np.eye(m)), (control(k - 1), -np.eye(m))]
                equal.append((held, np.zeros(m)))
        limits: list[tuple[list, Any, Any]] = []

        def add(rows: Any, where: Callable, steps: Any) -> None:
            M, low, high = (np.asarray(part) for part in rows)
            some = np.isfinite(low) | np.isfinite(high)
            limits.extend(([(where(k), M[some])], low[some], high[some]) for k in steps)

        outputs = (mpc.outputs,) if isinstance(mpc.outputs, jm.Outputs) else mpc.outputs
        if mpc.inputs is not None:
            add(mpc.inputs.rows(), control, range(N))
        if mpc.states is not None:
            add(mpc.states.rows(), state, range(N))
        for rows in outputs:
            add((rows.C, *rows.sides), state, range(N))
        if mpc.terminal_set is not None:
            add(mpc.terminal_set.rows(), state, [N])

        def stack(parts: list) -> sparse.csc_matrix:
            rows = []
            for part in parts:
                row = np.zeros((len(part[0][1]), size))
                for where, block in part:
                    row[:, where] = block
                rows.append(sparse.csr_matrix(row))
            return sparse.vstack([sparse.csr_matrix((0, size)), *rows], format="csc")

        self.E, self.e = stack([p for p, _ in equal]), np.concatenate([e for _, e in equal])
        self.G = stack([p for p, _, _ in limits])
        self.lower, self.upper = (
            np.concatenate([np.zeros(0), *[limit[i] for limit in limits]]) for i in (1, 2)
        )

    def first_input(self, w: np.ndarray) -> np.ndarray:
        """u_0 of w."""
        n, m = np.shape(self.mpc.system.B)
        begin = (self.mpc.horizon + 1) * n
        return w[begin : begin + m]

    def target(self, state: np.ndarray, control: np.ndarray) -> np.ndarray:
        """r for constant references."""
        N = self.mpc.horizon
        return np.concatenate([np.tile(state, N + 1), np.tile(control, N)])

    def cost(self, w: np.ndarray, r: np.ndarray) -> float:
        """(w − r)'H(w − r)."""
        return float((w - r) @ (self.H @ (w - r)))

    def right_side(self, x0: np.ndarray) -> np.ndarray:
        """e of the state x0."""
        return np.concatenate([x0, self.e[len(x0) :]])

    def violations(self, w: np.ndarray, x0: np.ndarray) -> tuple[float, float]:
        """The largest violation of a limit, in units of its row; and the largest of a limit or an
        equation, relative to the sum of the absolute terms of its row, each variable counted with
        its largest value along this and earlier plans (at rest a term alone says nothing)."""
        n, m = np.shape(self.mpc.system.B)
        split = (self.mpc.horizon + 1) * n
        largest = lambda part, size: np.tile(
            np.abs(part).reshape(-1, size).max(axis=0), len(part) // size
        )
        sizes = np.append(largest(w[:split], n), largest(w[split:], m))
        self.sizes = sizes = np.maximum(self.sizes, sizes)
        e, value = self.right_side(x0), self.G @ w
        met = np.clip(value, self.lower, self.upper)
        beyond, size = np.abs(value - met), abs(self.G) @ sizes + np.abs(met)
        off, terms = np.abs(self.E @ w - e), abs(self.E) @ sizes + np.abs(e)
        share = lambda v, size: np.max(v / np.where(v > 0, size, 1.0), initial=0.0)
        return beyond.max(initial=0.0), max(share(beyond, size), share(off, terms))

    def solve(self, x0: np.ndarray, r: np.ndarray) -> np.ndarray | None:
        """w by Clarabel, by PIQP where that has no answer; None where neither finds one. Solved for
        w − r, so that the cost they end by is that of the problem."""
        e, shift = self.right_side(x0) - self.E @ r, self.G @ r
        lower, upper = self.lower - shift, self.upper - shift
        high, low = np.isfinite(upper), np.isfinite(lower)
        rows = sparse.vstack([self.E, self.G[high], -self.G[low]], format="csc")
        right = np.concatenate([e, upper[high], -lower[low]])
        cones = [clarabel.ZeroConeT(len(e)), clarabel.NonnegativeConeT(len(right) - len(e))]
        settings = clarabel.DefaultSettings()
        settings.verbose = False
        settings.tol_gap_abs, settings.tol_gap_rel, settings.tol_feas = 1e-14, ASKED, ASKED
        P, q = 2 * self.H, np.zeros(len(r))
        answer = clarabel.DefaultSolver(
            sparse.triu(P, format="csc"), q, rows, right, cones, settings
        ).solve()
        if answer.status == clarabel.SolverStatus.Solved:
            return r + np.array(answer.x)
        import piqp

        solver = piqp.SparseSolver()
        solver.settings.eps_abs, solver.settings.eps_rel = ASKED, ASKED
        solver.setup(P, q, self.E, e, self.G, lower, upper)
        return r + solver.result.x if solver.solve() == piqp.PIQP_SOLVED else None


@dataclass
class Record:
    """Of one loop: samples that the other solver solved, those of them that are SOLVED here, names
    of the other statuses; costs here and there; the largest violations as in `violations`."""

    found: int = 0
    solved: int = 0
    others: tuple[str, ...] = ()
    costs: tuple[tuple[float, float], ...] = ()
    limit: float = 0.0
    row: float = 0.0
    refused: str = ""

    @property
    def cost(self) -> float:
        """The largest relative difference of costs."""
        here, there = np.array(self.costs).reshape(-1, 2).T
        least = 1e-6 * np.max(there, initial=0.0) + 1e-12  # both may be 0
        return np.max(np.abs(here - there) / np.maximum(there, least), initial=0.0)

    @property
    def passed(self) -> bool:
        """Whether all is as it should be; a loop whose first state has no plan ends there."""
        fine = self.cost <= TOLERANCE and self.row <= TOLERANCE
        told = self.found > 0 or self.others == (jm.Status.PRIMAL_INFEASIBLE.name,)
        return not self.refused and self.solved == self.found and told and fine


def follow(one: Loop, samples: int) -> Record:
    """Run one loop, shortened to about so many samples."""
    record, statement = Record(), Statement(one.mpc)
    try:
        controller = jm.Controller(one.mpc)
    except ValueError as error:
        record.refused = str(error)
        return record
    x, N, system = one.x0, one.mpc.horizon, one.mpc.system
    control = controller.start(x)
    for target in one.reference(samples):
        r = statement.target(target, one.input_reference)
        known = dict(input_reference=np.tile(one.input_reference, (N, 1)))
        control = controller(x, control, np.tile(target, (N + 1, 1)), **known)
        plan = control.plan
        u, status = np.asarray(control.u), jm.Status(int(plan.status))
        best = statement.solve(x, r)
        if status == jm.Status.SOLVED:
            w = np.concatenate([np.ravel(plan.states), np.ravel(plan.inputs)])
            limit, row = statement.violations(w, x)
            record.limit, record.row = max(record.limit, limit), max(record.row, row)
            if best is not None:
                record.costs += ((statement.cost(w, r), statement.cost(best, r)),)
        if best is not None:
            record.found += 1
            record.solved += status == jm.Status.SOLVED
        if status != jm.Status.SOLVED:
            record.others += (status.name,)
            if best is None:
                break
            u = statement.first_input(best)
        if one.follow is not None:
            x = one.follow(x, u)
        else:
            x = system.A @ x + system.B @ u + (0.0 if system.c is None else system.c)
    return record


def run(s: Settings) -> dict[str, Record]:
    """Run all, print the table; each loop's record."""
    chosen = [one for one in loops() if not s.names or one.name.startswith(s.names)]
    print(f"{'loop':24}{'n':>3}{'m':>3}{'N':>5}{'SOLVED':>9}{'cost':>9}{'limit':>9}{'row':>9}")
    records = {}
    for one in chosen:
        with jax.enable_x64(True):
            r = records[one.name] = follow(one, s.samples)
        counts = {name: r.others.count(name) for name in dict.fromkeys(r.others)}
        remark = r.refused or ", ".join(f"{name} {k}" for name, k in counts.items())
        print(
            f"{one.name:24}{one.mpc.system.n:3}{one.mpc.system.m:3}{one.mpc.horizon:5}"
            f"{f'{r.solved}/{r.found}':>9}{r.cost:9.0e}{r.limit:9.0e}{r.row:9.0e}"
            f"  {'' if r.passed else 'FAILED '}{remark}",
            flush=True,
        )
    passed = sum(r.passed for r in records.values())
    print(f"{passed} of {len(records)} loops passed")
    return records


if __name__ == "__main__":
    if not all(r.passed for r in run(tyro.cli(Settings, description=__doc__)).values()):
        raise SystemExit(1)
