"""simulate: plant and controller together, one sample after the other, under one scan."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxmpc.checks import fail
from jaxmpc.control.system import LinearSystem
from jaxmpc.mpc.problem import Plan
from jaxmpc.mpc.solve import Controller
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.qp.status import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Run:
    """A closed loop of T samples: x_{t+1} = plant(x_t, u_t) + w_t, u_t the first input of a plan.

    states (T+1, n), inputs (T, m). Of each plan: cost (T,), the optimal value V_N(x_t) (without
    ½), and status (T,). stage_cost (T,): (x_t − r_t)'Q(x_t − r_t) + (u_t − s_t)'R(u_t − s_t) with
    the references r, s, zero for none. violation (T+1,): the most by which x_t exceeds a row of
    `mpc.states`, in the units of the row; 0 where it keeps them all. slack (T, p): violations of
    the soft rows at k = 0 of each plan, hence of what happens. Batches have their axes in front.
    """

    states: Array
    inputs: Array
    cost: Array
    status: Array
    stage_cost: Array
    violation: Array
    slack: Array

    @property
    def feasible_steps(self) -> Array:
        """Samples before the first plan that is not SOLVED: T if all are."""
        solved = jnp.asarray(self.status) == Status.SOLVED
        return jnp.sum(jnp.cumprod(solved, axis=-1), axis=-1)


def simulate(
    controller: Controller, plant: Any, x0: Any, steps: int, *, reference: Any = None,
    input_reference: Any = None, disturbance: Any = None, previous_input: Any = None,
) -> Run:  # fmt: skip
    """Drive `plant` from x0 (n,) with `controller` for T = steps samples.

    plant: a LinearSystem, or anything with `step(x, u) -> x` written in JAX; the controller's own
    `mpc.system` makes the nominal loop. A plant that is a pytree is an argument of the compiled
    program, any other object a constant of it. reference: state to track, (n,), or (T + N, n) to
    look ahead: the plan at sample t sees the rows t … t+N. input_reference: the same for inputs,
    (m,) or (T + N − 1, m). disturbance (T, n): added to the next states. previous_input (m,):
    u_{−1} where the problem limits or weighs input rates. All in the controller's dtype.

    One instance: `jax.vmap(lambda x: simulate(controller, plant, x, 50))(x0s)` runs thousands and
    compiles once. The loop goes on after a plan that is not SOLVED, with the first input of its
    best iterate: `run.feasible_steps` says how far the run means anything. Raises ValueError for
    wrong shapes, before any compile; numbers that are not finite get the status NON_FINITE.
    """
    c = controller.condensed
    assert c is not None
    N, n, m = controller.mpc.horizon, c.Q.shape[0], c.R.shape[0]
    if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 1:
        fail("steps", f"{steps!r}", "Give a whole number of samples, at least 1")
    if np.shape(x0) != (n,):
        fail("x0", f"shape {np.shape(x0)}", f"Give one state ({n},); use jax.vmap for many")
    for name, value, shapes in (
        ("reference", reference, ((n,), (steps + N, n))),
        ("input_reference", input_reference, ((m,), (steps + N - 1, m))),
        ("disturbance", disturbance, ((steps, n),)),
        ("previous_input", previous_input, ((m,),)),
    ):
        if value is not None and np.shape(value) not in shapes:
            fail(name, f"shape {np.shape(value)}", f"Give {' or '.join(map(str, shapes))}")
    cast = lambda v: None if v is None else jnp.asarray(v, c.P.dtype)
    references = (cast(reference), cast(input_reference))
    return _simulate(
        controller, _step_of(plant, n, m), cast(x0), references, cast(disturbance),
        cast(previous_input), int(steps),
    )  # fmt: skip


def lyapunov_decrease(run: Run) -> Array:
    """V_N(x_{t+1}) − V_N(x_t) + l(x_t, u_t) along the loop, (T−1,), l the stage cost.

    Nowhere positive where the optimal value is a Lyapunov function: for the nominal plant, inputs
    free at each step and no weight on their rates (which the stage cost here leaves out),
    references at an equilibrium, a terminal set that a law u = Kx keeps invariant inside the
    limits, and a terminal cost P ⪰ Q + K'RK + (A+BK)'P(A+BK) (Mayne, Rawlings, Rao & Scokaert
    2000, Automatica 36, section 3.3; the lesson's Theorem 3). Says nothing from
    `run.feasible_steps` on.
    """
    return run.cost[..., 1:] - run.cost[..., :-1] + run.stage_cost[..., :-1]


def _step_of(plant: Any, n: int, m: int) -> Partial:
    """The plant's step(x, u), what can be traced of the plant as its arguments."""
    if isinstance(plant, LinearSystem):
        plant.validate()
        if (plant.n, plant.m) != (n, m):
            problem = f"has {plant.n} states and {plant.m} inputs"
            fail("plant", problem, f"The controller has {n} and {m}: give them in its coordinates")
        return Partial(_linear_step, arrays(plant))
    if not callable(getattr(plant, "step", None)):
        fail("plant", f"is a {type(plant).__name__}", "Give a LinearSystem, or step(x, u) -> x")
    if jax.tree_util.all_leaves([plant]):  # no pytree
        return Partial(plant.step)
    return Partial(type(plant).step, arrays(plant))


def _linear_step(system: LinearSystem, x: Array, u: Array) -> Array:
    A, B = jnp.asarray(system.A, x.dtype), jnp.asarray(system.B, x.dtype)
    after = matmul(A, x) + matmul(B, u)
    return after if system.c is None else after + jnp.asarray(system.c, x.dtype)


@partial(jax.jit, static_argnames="steps")
def _simulate(
    controller: Controller, step: Partial, x0: Array, references: tuple[Array | None, Array | None],
    disturbance: Array | None, previous_input: Array | None, steps: int,
) -> Run:  # fmt: skip
    c = controller.condensed
    assert c is not None
    N = controller.mpc.horizon
    square = lambda v, W: jnp.sum(v * matmul(W, v))

    def seen(whole: Array | None, t: Array, length: int) -> Array | None:
        """The rows of a reference that the plan at sample t looks at."""
        if whole is None or whole.ndim == 1:
            return whole
        return jax.lax.dynamic_slice_in_dim(whole, t, length)

    def sample(carry: tuple[Array, Plan, Array], at: tuple[Array, Array | None]) -> tuple:
        (x, before, previous), (t, w) = carry, at
        r, s = seen(references[0], t, N + 1), seen(references[1], t, N)
        u, _, plan = controller(x, before, r, input_reference=s, previous_input=previous)
        error, effort = (
            v if target is None else v - (target if target.ndim == 1 else target[0])
            for v, target in ((x, r), (u, s))
        )
        record = Run(
            states=x, inputs=u, cost=plan.cost, status=plan.status,
            stage_cost=square(error, c.Q) + square(effort, c.R),
            violation=_violation(controller, x), slack=plan.slack[0],
        )  # fmt: skip
        after = jnp.asarray(step(x, u), x.dtype)
        return (after if w is None else after + w, plan, u), record

    # A plan of zeros is a cold start, so that one solve is compiled, not two.
    shapes = jax.eval_shape(lambda x: controller(x)[1], x0)
    nothing = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    previous = jnp.zeros_like(nothing.inputs[0]) if previous_input is None else previous_input
    samples = (jnp.arange(steps), disturbance)
    run: Run
    (last, *_), run = jax.lax.scan(sample, (x0, nothing, previous), samples, length=steps)
    return replace(
        run, states=jnp.concatenate([run.states, last[None]]),
        violation=jnp.append(run.violation, _violation(controller, last)),
    )  # fmt: skip


def _violation(controller: Controller, x: Array) -> Array:
    """The most by which x exceeds a row of the state limits."""
    if controller.mpc.states is None:
        return jnp.zeros((), x.dtype)
    H, lower, upper = (jnp.asarray(v, x.dtype) for v in controller.mpc.states.rows())
    value = matmul(H, x)
    worst = jnp.max(jnp.maximum(value - upper, lower - value), initial=0.0)
    # A maximum need not propagate NaN (XLA on CPUs).
    return jnp.where(jnp.all(jnp.isfinite(x)), worst, jnp.nan)
