"""Section 8: the builder that the C++ sketch leaves out, `buildJointMPCQP`, and OSQP's C library.

jaxmpc condenses the joint's MPC to min ½z'Hz + g'z, l ≤ Az ≤ u with z the stacked torques: these
five arrays are what the C++ program copies into Eigen and hands to OSQP. At each sample they are
compared with a construction of their own (explicit powers of A) and solved three ways: OSQP on
the five arrays, `jm.solve_qp` on the same, and `jm.solve` on the MPC problem itself. H and A do
not depend on the state: a C++ program sets OSQP up once and updates g, l and u at each sample.

    python experiments/lesson/cpp_eigen_osqp.py
"""

from dataclasses import dataclass

import independent
import jax
import numpy as np
import tyro
from lesson_joint import GOAL, SYSTEM, TAU_MAX, TS, X_MAX, A, B, Q, R, joint, rows

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """steps: samples of the loop. every: print each so-manieth row. horizon: N."""

    steps: int = 50
    every: int = 5
    horizon: int = 20


def build_joint_mpc_qp(controller: jm.Controller, x0: np.ndarray) -> independent.Condensed:
    """The C++ struct MPCQP at x0: H, g (here f), A (here G), l, u. The constant makes ½z'Hz + g'z
    the cost J; no solver needs it."""
    qp = controller.condensed.qp(x0, np.tile(GOAL, (controller.mpc.horizon + 1, 1)))
    error = np.asarray(controller.condensed.Phi) @ x0 - GOAL
    weights = [*[Q] * controller.mpc.horizon, controller.mpc.terminal_cost]
    constant = sum(e @ W @ e for e, W in zip(error, weights, strict=True))
    return independent.Condensed(*map(np.asarray, (qp.P, qp.q, qp.A, qp.l, qp.u)), constant)


def run(s: Settings) -> dict[str, np.ndarray]:
    """Drive the loop with OSQP's torque; compare matrices and torques at each sample."""
    controller = jm.Controller(joint(s.horizon))
    # l and u are limits less what the state contributes. At a limit, and OSQP's torques lead there
    # to within 1e-11, nothing else says how large a violation is: speed at k = 0 has no torque.
    sizes = np.concatenate([np.tile(TAU_MAX, s.horizon), np.tile(X_MAX, s.horizon)])
    x = np.zeros(2)
    states, torques, others, matrices = [x], [], [], []
    for _ in range(s.steps):
        qp = build_joint_mpc_qp(controller, x)
        own = independent.condense(
            A, B, Q, R, Q, s.horizon, x, X_MAX, TAU_MAX, GOAL, range(s.horizon)
        )
        matrices.append([np.abs(a - b).max() for a, b in zip(qp, own, strict=True)])
        torques.append(independent.osqp(qp)[:1])
        solution = jm.solve_qp(jm.QP(qp.H, qp.f, qp.G, qp.l, qp.u, row_sizes=sizes))
        plan = controller.plan(x, GOAL)
        assert solution.status == plan.status == jm.Status.SOLVED
        others.append([solution.z[0], plan.inputs[0, 0]])
        x = A @ x + B @ torques[-1]
        states.append(x)
    difference = np.abs(np.array(others) - np.array(torques)).max(axis=0)
    print(rows(states, torques, s.every))
    print(f"\nH {qp.H.shape}, A {qp.G.shape}; Ts = {SYSTEM.dt} s = {TS} s")
    for name, error in zip("HgAlu", np.max(matrices, axis=0), strict=False):
        print(f"  {name}: largest difference to the independent construction {error:.1e}")
    print("largest difference of the first torque to OSQP's on these arrays:")
    print(f"  jm.solve_qp on the same arrays  {difference[0]:.1e} N m")
    print(f"  jm.solve on the MPC problem     {difference[1]:.1e} N m")
    return {
        "states": np.array(states), "inputs": np.array(torques), "solve_qp": difference[0],
        "solve": difference[1], "matrices": np.max(matrices, axis=0),
    }  # fmt: skip


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
