"""Problem 3: when soft limits are free, and how large ρ must be when they are not.

Above: a state from which the unconstrained optimum keeps all limits. Whatever ρ > 0, the slack is
zero and the plan is that of the hard problem, as Problem 3 asks to show. (Its proof compares
slacks at x* only; what is needed is J(x, ε) ≥ J(x) ≥ J(x*) for every x, with ε = 0 at x*.)

Below: a state from which limits are active. The slack is zero exactly for ρ ≥ ρ̄(x), the largest
multiplier of a softened row (KKT of the soft problem: λ_i ≤ ρ; Kerrigan & Maciejowski 2000). With
ρ below it the plan pays; a quadratic penalty alone always pays a little. J is without ½.

    python experiments/lesson/problem_3_soft.py
"""

from dataclasses import dataclass

import jax
import numpy as np
import tyro
from lesson_joint import LIMITS, Q, R, joint

import jaxmpc as jm
from jaxmpc.mpc import Plan
from jaxmpc.mpc.problem import soften


@dataclass(frozen=True)
class Settings:
    """horizon: N. inside, active: the two states (q in rad, dq in rad/s). rhos: penalties for the
    first; factors: penalties for the second, in parts of ρ̄. quadratic: weight of ε² alone."""

    horizon: int = 20
    inside: tuple[float, float] = (0.05, -0.1)
    active: tuple[float, float] = (-1.2, 0.1)
    rhos: tuple[float, ...] = (1e-6, 1e-3, 1.0, 1e3)
    factors: tuple[float, ...] = (0.5, 0.9, 0.999, 1.001, 1.1, 2.0, 100.0)
    quadratic: float = 1e4


def run(s: Settings) -> dict[str, np.ndarray]:
    """Print and return, for both states, rows (ρ, largest slack, largest |u − u_hard|, cost)."""
    lqr = jm.lqr(joint().system, Q, R)
    mpc = joint(s.horizon, terminal_cost=lqr.P, terminal_set=LIMITS)
    solver = jm.ADMM(iterations=400, newton_steps=40)

    def compare(x0: np.ndarray, hard: Plan, rho: float, quadratic: float = 0.0) -> list[float]:
        plan = jm.solve(soften(mpc, rho, quadratic), x0, solver=solver)
        assert plan.status == jm.Status.SOLVED
        change = np.abs(np.asarray(plan.inputs) - np.asarray(hard.inputs)).max()
        return [rho, float(plan.slack.max()), float(change), float(plan.cost)]

    def show(row: list[float], rho: str) -> None:
        print(f"{rho:>22}{row[1]:16.3e}{row[2]:16.3e}{row[3]:16.6f}")

    print(f"{'ρ':>22}{'largest slack':>16}{'|u − u_hard|':>16}{'cost':>16}")
    x0 = np.array(s.inside)
    hard = jm.solve(mpc, x0, solver=solver)
    free = [compare(x0, hard, rho) for rho in s.rhos]
    print(f"x0 = {s.inside}: no limit active, cost {float(hard.cost):.6f}")
    for row in free:
        show(row, f"{row[0]:g}")

    x0 = np.array(s.active)
    hard = jm.solve(mpc, x0, solver=solver)
    y = hard.multipliers
    rho_bar = float(max(np.abs(y.states).max(), np.abs(y.terminal).max()))
    priced = [compare(x0, hard, factor * rho_bar) for factor in s.factors]
    print(f"x0 = {s.active}: limits active, cost {float(hard.cost):.6f}, ρ̄(x0) = {rho_bar:.6f}")
    for row, factor in zip(priced, s.factors, strict=True):
        show(row, f"{factor:g} ρ̄")
    show(square := compare(x0, hard, 0.0, s.quadratic), f"only {s.quadratic:g}·ε²")
    return {
        "free": np.array(free), "priced": np.array(priced), "square": np.array(square),
        "rho_bar": np.array(rho_bar),
    }  # fmt: skip


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
