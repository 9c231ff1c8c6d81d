"""Problem 1: the KKT conditions of an MPC plan, and what its multipliers say about the cost.

The QP is written in the lesson's form, min ½z'Hz + f'z subject to Gz ≤ h, Ez = b with states as
variables, by loops that share nothing with jaxmpc. λ comes from the plan (`plan.multipliers`), ν
from stationarity by least squares; the four conditions must then hold. With the cost J as H says
it (without ½ in front of x'Qx), dJ*/dh_i = −λ_i: tightening limit i by δ costs λ_i·δ. The last
columns show that by central differences of J*, the limit of one step moved, all others kept.

    python experiments/lesson/problem_1_multipliers.py
"""

from dataclasses import dataclass, replace

import independent
import jax
import jax.numpy as jnp
import numpy as np
import tyro
from lesson_joint import LIMITS, TAU_MAX, X_MAX, A, B, Q, R, joint

import jaxmpc as jm
from jaxmpc.mpc.plan import flat_multipliers
from jaxmpc.mpc.rows import layout, row_table


@dataclass(frozen=True)
class Settings:
    """q, dq: the state, rad and rad/s. horizon: N. step: of the differences, in each row's unit."""

    q: float = -1.2
    dq: float = 0.1
    horizon: int = 20
    step: float = 1e-4


@dataclass(frozen=True)
class Table:
    """residuals: of the four KKT conditions. Of each active row: label, its multiplier (> 0 pushes
    against the upper bound) and the price of tightening measured by differences, both in the
    cost's unit per unit of the row."""

    residuals: dict[str, float]
    labels: list[str]
    multipliers: np.ndarray
    differences: np.ndarray


def kkt(mpc: jm.MPC, plan: jm.mpc.Plan, x0: np.ndarray) -> dict[str, float]:
    """Largest residual of each KKT condition of the stacked QP."""
    N = mpc.horizon
    qp = independent.stack(A, B, Q, R, mpc.terminal_cost, N, x0, X_MAX, TAU_MAX, range(N + 1))
    z = np.concatenate([np.ravel(plan.inputs), np.ravel(plan.states)])
    two_sided = [*plan.multipliers.inputs, *plan.multipliers.states, plan.multipliers.terminal]
    parts = [(np.maximum(y, 0.0), np.maximum(-y, 0.0)) for y in map(np.asarray, two_sided)]
    multipliers = np.concatenate([side for pair in parts for side in pair])
    gradient = qp.H @ z + qp.f + qp.G.T @ multipliers
    nu = np.linalg.lstsq(qp.E.T, -gradient, rcond=None)[0]
    slack = qp.h - qp.G @ z
    return {
        "stationarity  Hz + f + G'λ + E'ν": np.abs(gradient + qp.E.T @ nu).max(),
        "primal        max(Gz − h), Ez − b": max(-slack.min(), np.abs(qp.E @ z - qp.b).max(), 0.0),
        "dual          max(−λ)": max(-multipliers.min(), 0.0),
        "slackness     λ·(Gz − h)": np.abs(multipliers * slack).max(),
    }


def prices(controller: jm.Controller, x0: np.ndarray, rows: np.ndarray, upper, step: float):
    """−dJ*/d(limit) of some rows by central differences, outward positive: (rows,)."""
    qp = controller.condensed.qp(jnp.asarray(x0))
    solver = jm.ADMM(iterations=1000, newton_steps=40)

    def cost(row, amount, is_upper):
        moved = jnp.where(jnp.arange(qp.u.shape[0]) == row, amount, 0.0)
        u, l = jnp.where(is_upper, qp.u + moved, qp.u), jnp.where(is_upper, qp.l, qp.l - moved)
        solution = jm.solve_qp(replace(qp, l=l, u=u), solver)
        return jnp.where(solution.status == jm.Status.SOLVED, solution.cost, jnp.nan)

    both = jnp.concatenate([rows, rows]), jnp.repeat(jnp.array([step, -step]), len(rows))
    loosened, tightened = jnp.split(jax.vmap(cost)(*both, jnp.concatenate([upper, upper])), 2)
    return np.asarray(tightened - loosened) / (2 * step)


def run(s: Settings) -> Table:
    """Print the residuals and the active rows; return them."""
    x0 = np.array([s.q, s.dq])
    lqr = jm.lqr(joint().system, Q, R)
    mpc = joint(s.horizon, terminal_cost=lqr.P, terminal_set=LIMITS)
    controller = jm.Controller(mpc, jm.ADMM(newton_steps=40))
    plan = controller.plan(x0)
    print(jm.Status(int(plan.status)).sentence)
    residuals = kkt(mpc, plan, x0)
    for name, value in residuals.items():
        print(f"  {name:36}{value:.1e}")

    y = np.asarray(flat_multipliers(layout(mpc), plan.multipliers))
    active = np.flatnonzero(np.abs(y) > 1e-6 * np.abs(y).max())
    measured = prices(controller, x0, active, y[active] > 0, s.step)
    table, labels = row_table(mpc), []
    print(f"\n{'active limit':36}{'multiplier':>14}{'−dJ*/dh':>14}{'difference':>12}")
    for i, price in zip(active, measured, strict=True):
        row, side = table[i], "upper" if y[i] > 0 else "lower"
        labels.append(f"{row.name} {side} at k = {row.stage}, per {row.unit}")
        error = abs(abs(y[i]) - price)
        print(f"{labels[-1]:36}{abs(y[i]):14.6f}{price:14.6f}{error:12.1e}")
    return Table(residuals, labels, y[active], measured)


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
