"""Problem 4: the Lyapunov identity of the DARE, and V(x⁺) − V(x) + l(x, u) along closed loops.

The identity (A+BK)'P(A+BK) − P + Q + K'RK = 0 with u = Kx, K = −(R + B'PB)⁻¹B'PA makes x'Px
decrease by exactly the stage cost along the LQR loop. With P as terminal cost and the LQR's
maximal invariant set as terminal set the MPC's optimal value decreases by at least the stage cost
(Theorem 3). With the ingredients of the lesson's program (terminal cost Q, no terminal set), or
with none, nothing promises that, and it fails.

    python experiments/lesson/problem_4_lyapunov.py
"""

from dataclasses import dataclass

import jax
import numpy as np
import tyro
from lesson_joint import LIMITS, SYSTEM, TORQUE, A, B, Q, R, joint

import jaxmpc as jm
from jaxmpc.closed_loop.simulation import lyapunov_decrease, simulate


@dataclass(frozen=True)
class Settings:
    """steps: samples of each loop. grid: states a side, of which the feasible ones are driven."""

    steps: int = 60
    grid: int = 9


def run(s: Settings) -> dict[str, float]:
    """Print the residual of the identity and the largest V(x⁺) − V(x) + l of each loop, over all
    feasible starts; return them."""
    lqr = jm.lqr(SYSTEM, Q, R)
    K, P = np.asarray(lqr.K), np.asarray(lqr.P)
    closed = A + B @ K
    residual = np.abs(closed.T @ P @ closed - P + Q + K.T @ R @ K).max() / np.abs(P).max()
    x = np.random.default_rng(0).uniform([-1.5, -2], [1.5, 2], (1000, 2)).T
    form = lambda W, v: np.sum(v * (W @ v), axis=0)
    change = form(P, closed @ x) - form(P, x) + form(Q, x) + form(R, K @ x)
    table = {"DARE identity": residual, "LQR loop": np.abs(change).max() / form(P, x).max()}
    print(f"identity, largest entry over that of P: {residual:.1e}")
    print(f"LQR loop, |V(x⁺) − V(x) + l| over the largest V: {table['LQR loop']:.1e}\n")

    invariant = jm.maximal_invariant_set(SYSTEM, K, LIMITS, TORQUE)
    problems = {
        "P of the DARE, O_inf, N = 20": joint(20, terminal_cost=P, terminal_set=invariant),
        "terminal cost Q, N = 20 (section 7)": joint(20),
        "no terminal cost, N = 2": joint(2, terminal_cost=None),
    }
    starts = jm.grid([-1.5, -2.0], [1.5, 2.0], (s.grid, s.grid))
    print(f"{'MPC loop':38}{'feasible starts':>16}{'lost':>6}{'max V(x⁺) − V(x) + l':>24}")
    for name, mpc in problems.items():
        controller = jm.Controller(mpc)
        loops = jax.jit(jax.vmap(lambda x0, c=controller: simulate(c, SYSTEM, x0, s.steps)))(starts)
        steps = np.asarray(loops.feasible_steps)
        decrease = np.asarray(lyapunov_decrease(loops))
        # Differences of values of plans that are all solved.
        valid = np.arange(1, s.steps) < steps[:, None]
        worst = float(decrease[valid].max())
        lost = int(np.sum((steps > 0) & (steps < s.steps)))
        print(f"{name:38}{np.sum(steps > 0):16}{lost:6}{worst:24.3e}")
        table[name] = worst
    return table


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
