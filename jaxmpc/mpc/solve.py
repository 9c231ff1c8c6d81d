"""solve: one plan from one state; Controller: the same with the factorization done once."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import fail
from jaxmpc.mpc.condense import Condensed, condense
from jaxmpc.mpc.problem import MPC, Multipliers, Plan
from jaxmpc.qp.admm import ADMM, Factor
from jaxmpc.qp.admm import factor as factorise
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.qp.solve import solve_factored


def solve(
    mpc: MPC, x0: Any, reference: Any = None, solver: ADMM = ADMM(), warm_start: Any = None  # noqa: B008
) -> Plan:  # fmt: skip
    """Solve one MPC problem from the state x0 (n,).

    reference: state to track, (n,) or (N+1, n); None for the origin. warm_start: an earlier
    Plan. `jax.vmap(solve, in_axes=(None, 0))(mpc, x0s)` solves for many states and factors
    once. Raises ValueError for an ill-posed problem or wrong shapes, before any compile; what
    depends on values inside a batch is answered by `plan.status`.
    """
    return Controller(mpc, solver).plan(x0, reference, warm_start)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Controller:
    """An MPC law whose matrices are condensed and factored once, at construction.

    `controller(x, carry) -> (u, carry, plan)`: u (m,) is the first input of the plan, clipped
    into its limits; carry is None at the start and the previous plan afterwards, whose `shifted`
    form is the warm start. When the plan is not SOLVED, u is still the first input of the best
    iterate: look at plan.status. `condensed` and `factor` are filled in at construction: for
    another problem or solver make another Controller, `dataclasses.replace` would keep the old
    ones.
    """

    mpc: MPC
    solver: ADMM = ADMM()  # noqa: RUF009
    condensed: Condensed | None = None
    factor: Factor | None = None

    def __post_init__(self) -> None:
        # JAX rebuilds this object with its parts present, or with placeholders: leave those be.
        if self.condensed is None and isinstance(self.mpc, MPC):
            self.mpc.validate()
            condensed = condense(self.mpc)
            self.solver.validate(condensed.C.shape[0])
            # Arrays from here on, so that a sample need not convert the whole object again.
            object.__setattr__(self, "mpc", arrays(self.mpc))
            object.__setattr__(self, "solver", arrays(self.solver))
            object.__setattr__(self, "condensed", condensed)
            object.__setattr__(self, "factor", _factor(condensed, self.solver))

    def __call__(self, x: Any, carry: Plan | None = None) -> tuple[Array, Plan, Plan]:
        """First input from state x (n,), what to carry to the next sample, and the whole plan."""
        plan = self.plan(x, warm_start=None if carry is None else self.shifted(carry))
        u = self._limited(plan.inputs[0])
        return u, plan, plan

    def shifted(self, plan: Plan) -> tuple[Array, Array]:
        """The plan seen one sample later, as a warm start (z, y).

        Inputs and multipliers move up by one step. The new last input is the unconstrained
        optimum of that step for the terminal cost, inside its limits; its rows push with nothing.
        What bounded x_N through the terminal set bounds it as a state from now on, where both
        have the same rows.
        """
        c = self.condensed
        assert c is not None
        u = matmul(c.K_N, plan.states[-1])
        u = self._limited(u)
        v = (u - matmul(c.K, plan.states[-1]))[None]
        z = jnp.concatenate([plan.qp.z.reshape(-1, v.shape[1])[1:], v])
        y = plan.multipliers
        same = y.terminal.shape[0] == y.states.shape[1]
        last = y.terminal[None] if same else jnp.zeros_like(y.states[-1:])
        blocks = (y.inputs[1:], jnp.zeros_like(y.inputs[:1]), y.states[1:], last[: len(y.states)])
        return z.ravel(), jnp.concatenate([*(b.ravel() for b in blocks), y.terminal])

    def _limited(self, u: Array) -> Array:
        """u inside the input limits: an actuator takes no rounding beyond them."""
        if self.mpc.inputs is None:
            return u
        lower, upper = arrays((self.mpc.inputs.lower, self.mpc.inputs.upper))
        return jnp.clip(u, jnp.asarray(lower, u.dtype), jnp.asarray(upper, u.dtype))

    def plan(self, x0: Any, reference: Any = None, warm_start: Any = None) -> Plan:
        """Plan from x0 (n,); arguments as in `solve`."""
        c = self.condensed
        assert c is not None
        n, steps = c.Phi.shape[1], c.Phi.shape[0]
        if np.shape(x0) != (n,):
            fail("x0", f"shape {np.shape(x0)}", f"Give one state ({n},); use jax.vmap for many")
        x0 = jnp.asarray(x0, c.P.dtype)
        if reference is not None:
            if np.shape(reference) not in ((n,), (steps, n)):
                fail("reference", f"shape {np.shape(reference)}", f"Give ({n},) or ({steps}, {n})")
            reference = jnp.broadcast_to(jnp.asarray(reference, c.P.dtype), (steps, n))
        start = warm_start.qp if isinstance(warm_start, Plan) else warm_start
        return _plan(self, *arrays((x0, reference, start)))

    def cost(self, states: Array, inputs: Array, reference: Array | None = None) -> Array:
        """J (without ½) of a trajectory: states (N+1, n), inputs (N, m)."""
        c = self.condensed
        assert c is not None
        error = states if reference is None else states - reference
        square = lambda v, W: jnp.sum(v * matmul(v, W))
        return square(error[:-1], c.Q) + square(inputs, c.R) + square(error[-1:], c.P_N)

    def multipliers(self, y: Array) -> Multipliers:
        """Sort the QP's multipliers y (rows,) by constraint and step."""
        mpc, c = self.mpc, self.condensed
        assert c is not None
        count = lambda set_: 0 if set_ is None else set_.rows()[0].shape[0]
        N, steps = mpc.horizon, mpc.horizon - c.first_step
        ends = np.cumsum([N * count(mpc.inputs), steps * count(mpc.states)])
        inputs, states, terminal = jnp.split(y, ends)
        return Multipliers(
            states=states.reshape(steps, count(mpc.states)),
            inputs=inputs.reshape(N, count(mpc.inputs)),
            terminal=terminal,
        )


@jax.jit
def _factor(condensed: Condensed, solver: ADMM) -> Factor:
    return factorise(condensed.P, condensed.C, solver)


@jax.jit
def _plan(controller: Controller, x0: Array, reference: Array | None, start: Any) -> Plan:
    c = controller.condensed
    assert c is not None and controller.factor is not None
    qp = c.qp(x0, reference)
    solution = solve_factored(qp, controller.factor, controller.solver, start)
    states, inputs = c.trajectory(x0, solution.z)
    return Plan(
        states=states, inputs=inputs, cost=controller.cost(states, inputs, reference),
        multipliers=controller.multipliers(solution.y), status=solution.status,
        primal_residual=solution.primal_residual, dual_residual=solution.dual_residual,
        gap=solution.gap, iterations=solution.iterations, qp=solution,
    )  # fmt: skip
