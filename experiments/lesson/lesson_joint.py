"""The lesson's robot joint, shared by the scripts of this folder: data, limits, MPC, its table.

x = (q, dq) in rad and rad/s, u the torque tau in N m: q⁺ = q + Ts·dq, dq⁺ = dq + Ts/J·tau.
"""

from typing import Any

import numpy as np

import jaxmpc as jm

TS, INERTIA = 0.01, 0.05
A = np.array([[1.0, TS], [0.0, 1.0]])
B = np.array([[0.0], [TS / INERTIA]])
Q = np.diag([50.0, 1.0])
R = np.array([[0.1]])
X_MAX = np.array([1.5, 2.0])  # |q| ≤ 1.5 rad, |dq| ≤ 2 rad/s
TAU_MAX = np.array([2.0])  # |tau| ≤ 2 N m
GOAL = np.array([1.0, 0.0])

SYSTEM = jm.LinearSystem(
    A, B, dt=TS, state_names=("q", "dq"), state_units=("rad", "rad/s"),
    input_names=("tau",), input_units=("N m",),
)  # fmt: skip
LIMITS, TORQUE = jm.Box(-X_MAX, X_MAX), jm.Box(-TAU_MAX, TAU_MAX)


def joint(horizon: int = 20, **settings: Any) -> jm.MPC:
    """The MPC of section 7: limits on x_k at k = 0..N−1, none on x_N, terminal cost Q."""
    given = {"Q": Q, "R": R, "states": LIMITS, "inputs": TORQUE, "terminal_cost": Q} | settings
    return jm.MPC(SYSTEM, horizon=horizon, **given)


def rows(states: Any, inputs: Any, every: int = 1) -> str:
    """The lesson's printout: the state after each step and the torque that led there."""
    lines = [
        f"step {k}, q = {x[0]:.3f}, dq = {x[1]:.3f}, tau = {u[0]:.3f}"
        for k, (x, u) in enumerate(zip(np.asarray(states)[1:], np.asarray(inputs), strict=True))
    ]
    return "\n".join(lines[::every])
