"""Section 9: the joint's QP in the one-sided form G z ≤ h that Java solvers such as ojAlgo take.

ojAlgo's ConvexSolver (QuadraticSolver in old versions, as in the sketch) minimises ½z'Qz − c'z
subject to A_E z = b_E and A_I z ≤ b_I (its Javadoc). So mind the sign of c, here c = −f, and that
two-sided rows l ≤ Az ≤ u become [A; −A] z ≤ [u; −l], rows with an infinite bound left out. In
place of its active-set solver runs one on SciPy (`independent.active_set`), on matrices built
without jaxmpc; beside it jaxmpc solves its own problem.

    python experiments/lesson/java_ejml_ojalgo.py
"""

from dataclasses import dataclass

import independent
import jax
import numpy as np
import tyro
from lesson_joint import GOAL, SYSTEM, TAU_MAX, X_MAX, A, B, Q, R, joint, rows

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import simulate


@dataclass(frozen=True)
class Settings:
    """steps: samples of the loop. every: print each so-manieth row. horizon: N."""

    steps: int = 50
    every: int = 5
    horizon: int = 20


def first_torque(x: np.ndarray, N: int) -> np.ndarray:
    """`solveAndGetFirstTorque` at the state x: (1,). Raises ValueError if the QP is infeasible."""
    qp = independent.condense(A, B, Q, R, Q, N, x, X_MAX, TAU_MAX, GOAL, range(N))
    G, h = qp.one_sided()
    return independent.active_set(qp.H, qp.f, G, h)[:1]


def run(s: Settings) -> dict[str, np.ndarray]:
    """Print the table; return both loops, each driven by its own torques."""
    states, torques = [np.zeros(2)], []
    for _ in range(s.steps):
        torques.append(first_torque(states[-1], s.horizon))
        states.append(A @ states[-1] + B @ torques[-1])
    loop = simulate(jm.Controller(joint(s.horizon)), SYSTEM, np.zeros(2), s.steps, reference=GOAL)
    print(rows(states, torques, s.every))
    difference = np.abs(np.asarray(loop.inputs) - torques).max()
    print(f"\nlargest difference of a torque, {s.steps} steps: {difference:.1e} N m")
    return {"states": np.array(states), "inputs": np.array(torques), "ours": loop.inputs}


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
