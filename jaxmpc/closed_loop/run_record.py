"""Run: the record of a closed loop at each time step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.status import Status


@pytree
class Run:
    """A closed loop of T time steps: x_{t+1} = plant(x_t, u_t) + w_t, u_t the first input of a plan
    (with a delay, of the plan one time step earlier).

    states (T+1, n), inputs (T, m). Of each plan: cost (T,), the optimal value V_N(x_t) (without
    ½), and status (T,). stage_cost (T,): (x_t − r_t)'Q(x_t − r_t) + (u_t − s_t)'R(u_t − s_t) with
    the references r, s, zero for none. violation (T+1,): the most by which x_t exceeds a row of
    the state limits, in the units of the row; 0 where it keeps them all. slack (T, p): violations
    of the soft rows at k = 0 of each plan, hence of what happens. fallback (T,): whether the plan
    violates soft rows anywhere on its horizon by more than 1e-6 (1e-3 in float32), as happens
    where the limits cannot all be kept. estimates (T, n): the states as an observer estimates them
    from the outputs so far; None without an observer. Batches have their axes in front. For robots
    states are the plant's, (qpos, qvel), and x in costs and limits means their
    coordinates.
    """

    states: Array
    inputs: Array
    cost: Array
    status: Array
    stage_cost: Array
    violation: Array
    slack: Array
    fallback: Array
    estimates: Any = None

    def __repr__(self) -> str:
        """Return the shapes, in one line: the arrays may be long."""
        fields = (f"{name} {np.shape(v)}" for name, v in vars(self).items() if v is not None)
        return f"Run({', '.join(fields)})"

    @property
    def feasible_steps(self) -> Array:
        """Return the number of plans before the first that is not SOLVED: T if all are."""
        solved = jnp.asarray(self.status) == Status.SOLVED
        return jnp.sum(jnp.cumprod(solved, axis=-1), axis=-1)

    def on_host(self) -> "Run":
        """Return the run as NumPy arrays with a batch axis in front, added where there is none."""
        run = jax.tree.map(np.asarray, self)
        return run if run.states.ndim == 3 else jax.tree.map(lambda v: v[None], run)


def lyapunov_decrease(run: Run) -> Array:
    """Return V_N(x_{t+1}) − V_N(x_t) + l(x_t, u_t) along the loop, (T−1,), l the stage cost.

    It is nowhere positive where the optimal value is a Lyapunov function: for the nominal plant,
    inputs free at each step, no weights on input rates or of single stages (the stage cost here
    leaves them out), references at an equilibrium, a terminal set that a law u = Kx keeps invariant
    inside the limits, and a terminal cost P ⪰ Q + K'RK + (A+BK)'P(A+BK) (Mayne, Rawlings, Rao &
    Scokaert 2000, Automatica 36, section 3.3; Rawlings, Mayne & Diehl 2017, section 2.4). The
    values from `run.feasible_steps` on mean nothing.
    """
    return run.cost[..., 1:] - run.cost[..., :-1] + run.stage_cost[..., :-1]
