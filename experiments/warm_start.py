"""What warm starts save along a closed loop: ADMM steps until all residuals and the gap
are within 1e-6, at each sample of the robot joint under MPC (N = 20), from

    cold      zero
    same      the previous plan as it was
    shifted   the previous plan moved up by one sample (`Controller.shifted`)

    python experiments/warm_start.py
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array

import jaxmpc as jm
from jaxmpc.mpc.plan import WarmStart
from jaxmpc.qp.admm import ScaledProgram, iterate, read, splittings
from jaxmpc.qp.problem import QP
from jaxmpc.qp.residuals import residual_terms
from jaxmpc.qp.solve import warm


@dataclass(frozen=True)
class Settings:
    """loops: closed loops, from random feasible states. samples: of each. most: steps at which
    counting stops. every: steps between two looks at the residuals."""

    loops: int = 64
    samples: int = 40
    most: int = 3000
    every: int = 5
    seed: int = 0


def joint() -> jm.MPC:
    """The robot joint with the terminal cost of its LQR."""
    system = jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    limits = jm.Box(np.array([-1.5, -2.0]), np.array([1.5, 2.0]))
    torque = jm.Box(np.array([-2.0]), np.array([2.0]))
    return jm.MPC(
        system, Q, R, horizon=20, states=limits, inputs=torque,
        terminal_cost=jm.lqr(system, Q, R).P, terminal_set=limits,
    )  # fmt: skip


def run(s: Settings) -> None:
    """Drive the loops with exact plans, count beside them, print the table."""
    mpc = joint()
    controller = jm.Controller(mpc, jm.ADMM(newton_steps=30))
    condensed, factor = controller.condensed, controller.factor

    def steps_to_solve(qp: QP, warm_start: tuple[Array, Array]) -> Array:
        p = ScaledProgram.of(qp, factor)

        def look(carry: tuple[Array, Array, Array], _: None) -> tuple:
            t, count, needed = carry
            schedule = splittings(factor, p.q)
            t, _ = iterate(schedule, p.bounds, t, s.every, controller.solver.alpha)
            pair = p.unscaled(*read(factor, t, p.q, p.bounds))
            largest = [jnp.max(jnp.abs(v), initial=0.0) for v, *_ in residual_terms(qp, *pair)]
            done = jnp.max(jnp.stack(largest)) <= 1e-6
            count = count + s.every
            return (t, count, jnp.where(done & jnp.isinf(needed), count, needed)), None

        carry = (warm(p, warm_start), 0.0, jnp.inf)
        return jax.lax.scan(look, carry, length=s.most // s.every)[0][2]

    def sample(carry: tuple[Array, jm.mpc.Plan], _: None) -> tuple:
        x, before = carry
        x = mpc.system.A @ x + mpc.system.B @ before.inputs[0]
        qp, plan = condensed.qp(x), controller.plan(x)
        zero = (jnp.zeros_like(qp.q), jnp.zeros_like(qp.l))
        of = lambda plan: WarmStart.of(plan, condensed.layout, mpc)
        pair = lambda w: (condensed.variables(w.states, w.inputs), w.multipliers)
        starts = (zero, pair(of(before)), pair(controller.shifted(before)))
        return (x, plan), (*(steps_to_solve(qp, each) for each in starts), plan.status)

    def loop(x0: Array) -> tuple:
        return jax.lax.scan(sample, (x0, controller.plan(x0)), length=s.samples)[1]

    draws = np.random.default_rng(s.seed).uniform([-1.5, -2], [1.5, 2], (2 * s.loops, 2))
    x0s = draws[jm.map_feasible_set(mpc, draws).label == 1][: s.loops]
    *counts, status = map(np.asarray, jax.jit(jax.vmap(loop))(x0s))
    solved = status == jm.Status.SOLVED
    print(f"{solved.sum()} samples of {len(x0s)} loops; ADMM steps until residuals are ≤ 1e-6")
    print(f"{'':10}{'median':>8}{'mean':>8}{'90 %':>8}{'unsolved':>10}{'cold/mean':>11}")
    cold = np.minimum(counts[0][solved], s.most).mean()
    for name, count in zip(("cold", "same", "shifted"), counts, strict=True):
        v = np.minimum(count[solved], s.most)  # what is not solved counts as the most
        print(
            f"{name:10}{np.median(v):8.0f}{v.mean():8.1f}{np.quantile(v, 0.9):8.0f}"
            f"{np.isinf(count[solved]).sum():10d}{cold / v.mean():11.2f}"
        )


if __name__ == "__main__":
    with jax.enable_x64(True):
        run(tyro.cli(Settings, description=__doc__))
