"""Feasible states in 12 dimensions against an exact answer.

Joints that do not know of each other, x_i = (q_i, dq_i), are hidden behind an integer change of
coordinates of determinant 1: x = T (x_1, …, x_J). A state is feasible if and only if each x_i
lies in the feasible polygon of its own joint, which exact steps of `predecessor` give; the
labels of `map_feasible_set` know nothing of that. Six joints: 42.6 million vertices.

    python experiments/hidden_product.py --joints 6 --states 10000

prints labels, errors and seconds.
"""

import time
from dataclasses import dataclass

import numpy as np
import tyro

import jaxmpc as jm

# Gain (period over inertia), and limits of position and velocity, of each joint.
JOINTS = ((0.2, 1.5, 2.0), (0.1, 1.0, 1.5), (0.2, 1.0, 1.0), (0.05, 2.0, 1.0), (0.1, 1.5, 1.0),
          (0.2, 2.0, 1.5))  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """Which product, and which states."""

    joints: int = 6
    horizon: int = 10
    states: int = 10_000
    closest: float = 1e-4
    """Least distance from the boundary, relative to the distance from the origin."""
    seed: int = 0


def block(i: int, horizon: int) -> jm.MPC:
    """One joint."""
    gain, q, dq = JOINTS[i]
    limits = jm.Box(np.array([-q, -dq]), np.array([q, dq]))
    return jm.MPC(
        jm.LinearSystem(np.array([[1.0, 0.01], [0.0, 1.0]]), np.array([[0.0], [gain]])),
        np.eye(2), np.eye(1), horizon, limits, jm.Box([-2.0], [2.0]), terminal_set=limits,
    )  # fmt: skip


def product(settings: Settings) -> tuple[jm.MPC, np.ndarray]:
    """All joints behind the change of coordinates, and T⁻¹."""
    n = 2 * settings.joints
    rng = np.random.default_rng(settings.seed)
    lower, upper = (np.tril(rng.integers(-1, 2, (n, n)), -1) + np.eye(n) for _ in range(2))
    sparse = rng.random((n, n)) < 0.3
    T = np.where(sparse, lower, np.eye(n)) @ np.where(sparse.T, upper.T, np.eye(n))
    back = np.round(np.linalg.inv(T))
    assert np.array_equal(T @ back, np.eye(n))
    A, B, limits = np.eye(n), np.zeros((n, settings.joints)), np.zeros(n)
    for i in range(settings.joints):
        gain, q, dq = JOINTS[i]
        A[2 * i, 2 * i + 1], B[2 * i + 1, i] = 0.01, gain
        limits[2 * i : 2 * i + 2] = q, dq
    states = jm.Polytope(np.vstack([back, -back]), np.tile(limits, 2))
    inputs = jm.Box(np.full(settings.joints, -2.0), np.full(settings.joints, 2.0))
    system = jm.LinearSystem(T @ A @ back, T @ B)
    mpc = jm.MPC(
        system, np.eye(n), np.eye(settings.joints), settings.horizon, states, inputs,
        terminal_set=states,
    )  # fmt: skip
    return mpc, back


def polygon(mpc: jm.MPC) -> jm.Polytope:
    """The exact feasible polygon of one joint, scaled to h = 1."""
    body = mpc.states.to_polytope()
    for _ in range(mpc.horizon):
        body = jm.sets.predecessor(mpc.system, body, mpc.states, mpc.inputs)
    return jm.Polytope(body.H / body.h[:, None], np.ones(len(body.h)))


def run(settings: Settings) -> dict[str, float]:
    """Labels, errors and seconds."""
    mpc, back = product(settings)
    polygons = [polygon(block(i, settings.horizon)) for i in range(settings.joints)]

    def gauge(x: np.ndarray) -> np.ndarray:
        """The factor by which the product must grow to hold x: feasible up to 1."""
        parts = (x @ back.T).reshape(len(x), settings.joints, 2)
        return np.max([np.max(parts[:, i] @ p.H.T, axis=1) for i, p in enumerate(polygons)], axis=0)

    rng = np.random.default_rng(settings.seed + 1)
    x = rng.standard_normal((settings.states, mpc.system.n))
    distance = settings.closest ** rng.uniform(0, 1, settings.states)
    wanted = 1 + rng.choice([-0.5, 0.5], settings.states) * distance
    x *= (wanted / gauge(x))[:, None]
    inside = gauge(x) <= 1
    begun = time.perf_counter()
    fmap = jm.map_feasible_set(mpc, x)
    seconds = time.perf_counter() - begun
    return {
        "states": settings.states,
        "feasible": fmap.counts()["feasible"],
        "infeasible": fmap.counts()["infeasible"],
        "undecided": fmap.counts()["undecided"],
        "wrong": int(np.sum((fmap.label != 0) & ((fmap.label == 1) != inside))),
        "seconds": seconds,
        "of them compiling": fmap.labels.compile_seconds,
    }


def main() -> None:
    """Run and print."""
    for name, value in run(tyro.cli(Settings, description=__doc__)).items():
        print(f"{name:<20} {value:,.2f}" if isinstance(value, float) else f"{name:<20} {value:,}")


if __name__ == "__main__":
    main()
