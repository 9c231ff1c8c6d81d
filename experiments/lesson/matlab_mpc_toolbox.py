"""Section 10: what MATLAB's MPC Toolbox makes of the lesson's numbers, p = 20 and m = 3.

The toolbox minimises (MathWorks, "QP Optimization Problem for Linear MPC")

    Σ_{i=1..p} |Wy (y_{k+i} − r)|²
    + Σ_{i=0..p−1} |Wu u_{k+i}|² + |WΔu (u_{k+i} − u_{k+i−1})|² + ρ ε²,

hence, in the words of `jm.MPC`:

* weights stand inside the square: OutputVariables = [50 1] is Q = diag(2500, 1), and
  ManipulatedVariables = 0.1 is R = 0.01. For the Q = diag(50, 1), R = 0.1 of the other sections
  write [sqrt(50) 1] and sqrt(0.1);
* ManipulatedVariablesRate is 0.1 where it is not given (the toolbox says so when it builds the
  object): input_rate_weight = 0.01, and the previous input matters. Write 0 for none;
* outputs count at i = 1..p: the last one has the weight of the others (terminal_cost = Q), and
  limits hold at k = 1..p (constrained_stages), not at k = 0;
* the control horizon m = 3 leaves three moves free, u_{k+i} = u_{k+2} from i = 2 on
  (control_horizon=3);
* limits with MinECR, MaxECR > 0 are soft, all through one slack ε, −ECR ε ≤ y − limit ≤ ECR ε;
  its weight Weights.ECR is 1e5 unless given. MathWorks advises to soften all output limits and
  to keep those of inputs hard. Zero ECRs make them hard, as here; `--soft` prints what ECR = 1 on
  the outputs does to the speed limit. jm.Soft has a slack a row instead;
* mpcmove takes an mpcstate object (not the vector x of the lesson), estimates the state from y
  and assumes integrating output disturbances: with this exact model both change nothing.

Every loop is compared with an independent QP, built by loops and solved by an active-set method.

    python experiments/lesson/matlab_mpc_toolbox.py
"""

from dataclasses import dataclass

import independent
import jax
import numpy as np
import tyro
from lesson_joint import GOAL, SYSTEM, TAU_MAX, X_MAX, A, B, joint, rows

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import simulate

# Wy, Wu, WΔu: as MATLAB reads the lesson, and the cost of the lesson's other sections.
WEIGHTS = {
    "as MATLAB reads the lesson": ((50.0, 1.0), 0.1, 0.1),
    "the other sections' cost": ((np.sqrt(50.0), 1.0), np.sqrt(0.1), 0.0),
}


@dataclass(frozen=True)
class Settings:
    """p, m: prediction and control horizon. steps: samples. every: print each so-manieth row.
    soft: also drive the loop with MATLAB's single slack on the output limits."""

    p: int = 20
    m: int = 3
    steps: int = 50
    every: int = 5
    soft: bool = False


def problem(s: Settings, Wy, Wu: float, Wdu: float) -> jm.MPC:
    """The toolbox's problem with hard limits."""
    Q = np.diag(np.square(Wy))
    return joint(
        s.p, Q=Q, R=np.array([[Wu**2]]), terminal_cost=Q,
        input_rate_weight=np.array([Wdu**2]) if Wdu else None, control_horizon=s.m,
        constrained_stages=tuple(range(1, s.p + 1)),
    )  # fmt: skip


def blocked(s: Settings, Wy, Wu: float, Wdu: float, x: np.ndarray, before: np.ndarray):
    """The same as a QP in the m free moves, by loops: Condensed."""
    p, m, Q = s.p, s.m, np.diag(np.square(Wy))
    full = independent.condense(
        A, B, Q, np.array([[Wu**2]]), Q, p, x, X_MAX, TAU_MAX, GOAL, range(1, p + 1)
    )
    moves = np.zeros((p, m))
    difference, first = np.eye(p), np.zeros(p)
    for k in range(p):
        moves[k, min(k, m - 1)] = 1.0
        if k:
            difference[k, k - 1] = -1.0
    first[0] = before[0]  # Δu = difference u − first
    rate = 2 * Wdu**2
    H = full.H + rate * difference.T @ difference
    f = full.f - rate * difference.T @ first
    constant = full.constant + rate / 2 * first @ first
    return independent.Condensed(
        moves.T @ H @ moves, moves.T @ f, full.G @ moves, full.l, full.u, constant
    )


def softened(qp: independent.Condensed, inputs: int, weight: float = 1e5):
    """(H, f, G, h) in (z, ε): rows after the first `inputs` yield by ε at the cost weight·ε²."""
    H = np.pad(qp.H, ((0, 1), (0, 1)))
    H[-1, -1] = 2 * weight
    slack = np.where(np.arange(len(qp.G)) < inputs, 0.0, -1.0)[:, None]
    G = np.vstack([np.hstack([qp.G, slack]), np.hstack([-qp.G, slack])])
    return H, np.append(qp.f, 0.0), G, np.concatenate([qp.u, -qp.l])


def run(s: Settings) -> dict[str, dict[str, np.ndarray]]:
    """Print each loop with its largest differences to the independent QP; return them all."""
    table = {}
    for name, weights in WEIGHTS.items():
        loop = simulate(
            jm.Controller(problem(s, *weights)), SYSTEM, np.zeros(2), s.steps, reference=GOAL
        )
        states, inputs = np.asarray(loop.states), np.asarray(loop.inputs)
        first, cost = [], []
        for x, before in zip(states, [np.zeros(1), *inputs[:-1]], strict=False):
            qp = blocked(s, *weights, x, before)
            z = independent.active_set(qp.H, qp.f, *qp.one_sided())
            first.append(z[:1])
            cost.append(qp.cost(z))
        relative = np.abs(np.asarray(loop.cost) / cost - 1).max()
        difference = np.abs(inputs - first).max()
        print(f"{name}: Wy {np.round(weights[0], 4)}, Wu {weights[1]:.4f}, Wdu {weights[2]:.4f}")
        print(rows(states, inputs, s.every))
        print(f"objective to the independent QP: relative {relative:.1e}; u: {difference:.1e} N m")
        print(f"plans solved: {int(loop.feasible_steps)} of {s.steps}\n")
        table[name] = {
            "states": states, "inputs": inputs, "objective": relative, "u": difference,
            "feasible_steps": int(loop.feasible_steps),
        }  # fmt: skip
        if s.soft:
            x, before, fastest = np.zeros(2), np.zeros(1), 0.0
            for _ in range(s.steps):
                z = independent.active_set(*softened(blocked(s, *weights, x, before), s.p))
                before = z[:1]
                x = A @ x + B @ before
                fastest = max(fastest, abs(x[1]))
            print(f"  output limits soft with one slack, ECR 1: |dq| up to {fastest:.6f} rad/s\n")
            table[name]["fastest"] = fastest
    return table


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
