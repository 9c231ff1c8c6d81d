"""Nonlinear MPC problems that others published, restated in JAX and for CasADi.

swing-up    acados' getting-started example: a pendulum of 0.1 kg and 0.8 m on a cart of 1 kg, from
            hanging to upright in 1 s with forces up to 80 N; N = 20, RK4.
drone       TurboMPC's example: a point mass of 32 kg with quadratic drag past three round
            obstacles to the origin; N = 50 of 1 s, forces up to 10 N, RK4. (Its weight of 0.01 on
            input rates is left out.)
quadrotor   TurboMPC's quadrotor (thrust and torques, unit quaternion) from up to 1 m and 1 rad
            away to hover; N = 20 of 0.05 s, RK4.

Each is a `Published`: the functions take the module of mathematics, jax.numpy or CasADi's.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Task


@dataclass(frozen=True)
class Published:
    """rate(x, u, math) -> ẋ as a list; one RK4 step of h seconds a stage. Q, R, P: diagonals (no
    ½); limit (m,): |u − middle| at most. distance(x, math) -> list of numbers to be at least 0, or
    None. start(rng) -> x0 (n,). target (n,)."""

    name: str
    rate: Callable
    h: float
    horizon: int
    Q: np.ndarray
    R: np.ndarray
    P: np.ndarray
    middle: np.ndarray
    limit: np.ndarray
    target: np.ndarray
    start: Callable
    distance: Callable | None = None

    def step(self, x: Any, u: Any, math: Any = jnp, stack: Any = jnp.stack) -> Any:
        """Return x one stage later, by the classical Runge-Kutta method."""
        rate = lambda x: stack(self.rate(x, u, math))
        h, k1 = self.h, rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def problem(self) -> NonlinearMPC:
        """Return the problem for `solve_nonlinear`; distances are hard limits."""
        n, m = len(self.Q), len(self.R)
        system = jm.LinearSystem(np.eye(n), np.zeros((n, m)), dt=self.h)
        box = jm.Box(self.middle - self.limit, self.middle + self.limit)
        mpc = jm.MPC(system, np.diag(self.Q), np.diag(self.R), self.horizon, inputs=box,
                     terminal_cost=np.diag(self.P))  # fmt: skip
        tasks = ()
        if self.distance is not None:
            distance = self.distance
            far = lambda at: jnp.stack(distance(at.x, jnp))
            tasks = (Task(far, lower=0.0, rho=None, name="distance", unit="m"),)
        return NonlinearMPC(mpc, self.step, tasks)


def _pendulum(x: Any, u: Any, math: Any) -> list:
    cart, pole, length, g = 1.0, 0.1, 0.8, 9.81
    angle, speed, turn, force = x[1], x[2], x[3], u[0]
    s, c = math.sin(angle), math.cos(angle)
    common = cart + pole - pole * c * c
    push = -pole * length * s * turn * turn
    return [
        speed, turn, (push + pole * g * c * s + force) / common,
        (push * c + force * c + (cart + pole) * g * s) / (length * common),
    ]  # fmt: skip


def _drone(x: Any, u: Any, math: Any) -> list:
    mass, drag = 32.0, 0.2
    size = lambda v: abs(v) if math is jnp else math.fabs(v)
    pull = [(u[i] - drag * size(x[3 + i]) * x[3 + i]) / mass for i in range(3)]
    return [x[3], x[4], x[5], *pull]


def _quadrotor(x: Any, u: Any, math: Any) -> list:
    mass, g = 0.1, 9.81
    inertia = np.array([[0.1, 0.01, 0.01], [0.01, 0.1, 0.01], [0.01, 0.01, 0.1]])
    inverse = np.linalg.inv(inertia)
    length = math.sqrt(x[6] ** 2 + x[7] ** 2 + x[8] ** 2 + x[9] ** 2)
    q = [x[6 + i] / length for i in range(4)]
    w = [x[10], x[11], x[12]]
    lift = u[0] / mass
    up = [2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]),
          q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2]  # fmt: skip
    turned = [
        -(q[1] * w[0] + q[2] * w[1] + q[3] * w[2]) / 2,
        (q[0] * w[0] + q[2] * w[2] - q[3] * w[1]) / 2,
        (q[0] * w[1] + q[3] * w[0] - q[1] * w[2]) / 2,
        (q[0] * w[2] + q[1] * w[1] - q[2] * w[0]) / 2,
    ]
    L = [sum(inertia[i, j] * w[j] for j in range(3)) for i in range(3)]
    torque = [L[1] * w[2] - L[2] * w[1] + u[1], L[2] * w[0] - L[0] * w[2] + u[2],
              L[0] * w[1] - L[1] * w[0] + u[3]]  # fmt: skip
    spin = [sum(inverse[i, j] * torque[j] for j in range(3)) for i in range(3)]
    return [x[3], x[4], x[5], lift * up[0], lift * up[1], lift * up[2] - g, *turned, *spin]


CENTRES = np.array([[-1.4, -0.1], [-0.7, 0.3], [-0.3, 0.25]])
RADII = np.array([0.3, 0.2, 0.2])


def _far(x: Any, math: Any) -> list:
    return [
        math.sqrt((x[0] - c[0]) ** 2 + (x[1] - c[1]) ** 2) - r
        for c, r in zip(CENTRES, RADII, strict=True)
    ]


def _tilted(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    angle = rng.uniform(0, 1)
    q = np.append(np.cos(angle / 2), np.sin(angle / 2) * axis / np.linalg.norm(axis))
    place, speed = rng.uniform(-1, 1, 3), rng.uniform(-0.5, 0.5, 3)
    return np.concatenate([place, speed, q, rng.uniform(-0.5, 0.5, 3)])


_UPRIGHT = np.zeros(13)
_UPRIGHT[6] = 1.0

PROBLEMS = {
    "swing-up": Published(
        "swing-up", _pendulum, 0.05, 20, Q=0.05 * np.array([1e3, 1e3, 1e-2, 1e-2]),
        R=0.05 * np.array([1e-2]), P=np.array([1e3, 1e3, 1e-2, 1e-2]), middle=np.zeros(1),
        limit=np.array([80.0]), target=np.zeros(4),
        start=lambda rng: rng.uniform([-1, -np.pi, -1, -1], [1, np.pi, 1, 1]),
    ),
    "drone": Published(
        "drone", _drone, 1.0, 50, Q=0.1 * np.ones(6), R=np.ones(3), P=np.ones(6),
        middle=np.zeros(3), limit=10 * np.ones(3), target=np.zeros(6), distance=_far,
        start=lambda rng: np.array([-1.9, 0.05, 0.2, 0, 0, 0]) + rng.normal(0, 0.05, 6),
    ),
    "quadrotor": Published(
        "quadrotor", _quadrotor, 0.05, 20,
        Q=np.repeat([1.0, 0.1, 1.0, 0.1], [3, 3, 4, 3]), R=np.array([0.1, 1.0, 1.0, 1.0]),
        P=10 * np.repeat([1.0, 0.1, 1.0, 0.1], [3, 3, 4, 3]),
        middle=np.array([0.981, 0, 0, 0]), limit=np.array([0.981, 0.2, 0.2, 0.2]),
        target=_UPRIGHT, start=_tilted,
    ),
}  # fmt: skip
