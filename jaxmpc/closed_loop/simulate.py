"""simulate: plant and controller together, one sample after the other, under one scan."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial

from jaxmpc.checks import fail, require_real, whole
from jaxmpc.closed_loop.linear_feedback import LinearFeedback
from jaxmpc.closed_loop.run import Run
from jaxmpc.control.system import LinearSystem
from jaxmpc.control.violation import worst_violation
from jaxmpc.qp.precision import arrays, matmul

# Slack of a plan that counts as rounding, by precision: the accuracy of solved plans.
SLACK = {"float64": 1e-6, "float32": 1e-3}


def simulate(
    controller: Any, plant: Any, x0: Any, steps: int, *, reference: Any = None,
    input_reference: Any = None, disturbance: Any = None, previous_input: Any = None,
    checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Simulate `plant` under `controller` from the state x0 (n,) for T = steps samples.

    controller: a Controller, RobotController or LinearFeedback.
    plant: a LinearSystem, LinearPlant or Robot, or any object with `step(x, u) -> x` written in
        JAX; the controller's own `mpc.system` gives the nominal loop. A plant that is a pytree is
        an argument of the compiled program, any other object a constant of it.
    reference: state to track, (n,), or (T + N, n): the plan at sample t sees the rows t … t+N.
    input_reference: input to track, (m,), or (T + N − 1, m).
    disturbance (T, n): added to the next states.
    previous_input (m,): u_{−1} where the problem limits or weighs input rates; None for zero.
    checkpoint: under reverse-mode differentiation store only what is carried from sample to
        sample and compute the samples again: less memory, more time.

    Returns one `Run` in the controller's precision. For many initial states use
    `jax.vmap(lambda x: simulate(controller, plant, x, 50))(x0s)`, or `simulate_many`, which splits
    them into chunks that fit into memory. After a plan that is not SOLVED the loop goes on with
    the first input of the best iterate; `run.feasible_steps` counts the samples before that.
    Raises ValueError for wrong shapes, before any compile; numbers that are not finite give the
    status NON_FINITE.
    """
    checked = checked_arguments(
        controller, plant, x0, steps, reference, input_reference, disturbance, previous_input
    )
    return _simulate(*checked, int(steps), checkpoint)


def checked_arguments(
    controller: Any, plant: Any, x0: Any, steps: Any, reference: Any, input_reference: Any,
    disturbance: Any, previous_input: Any,
) -> tuple:  # fmt: skip
    """Return the traced arguments of `_simulate`; raise ValueError where one is wrong."""
    if isinstance(controller, LinearFeedback):
        controller.validate()
    if not hasattr(controller, "mpc"):
        what = f"is a {type(controller).__name__}"
        fail("controller", what, "Give a Controller, RobotController or LinearFeedback")
    mpc = controller.mpc
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    size = controller.state_size
    whole("steps", steps, 1)
    require_real("x0", x0)
    if np.shape(x0) != (size,):
        fail("x0", f"shape {np.shape(x0)}", f"Give one state ({size},); use jax.vmap for many")
    for name, value, shapes in (
        ("reference", reference, ((n,), (steps + N, n))),
        ("input_reference", input_reference, ((m,), (steps + N - 1, m))),
        ("disturbance", disturbance, ((steps, size),)),
        ("previous_input", previous_input, ((m,),)),
    ):
        if value is None:
            continue
        require_real(name, value)
        if np.shape(value) not in shapes:
            fail(name, f"shape {np.shape(value)}", f"Give {' or '.join(map(str, shapes))}")
    cast = lambda v: None if v is None else jnp.asarray(v, controller.dtype)
    references = (cast(reference), cast(input_reference))
    step = _step_of(plant, size, m)
    return controller, step, cast(x0), references, cast(disturbance), cast(previous_input)


def _step_of(plant: Any, n: int, m: int) -> Partial:
    """Return the plant's step(x, u); the arrays of a plant that is a pytree are its leaves."""
    if not callable(getattr(plant, "step", None)):
        fail("plant", f"is a {type(plant).__name__}", "Give a LinearSystem, or step(x, u) -> x")
    if isinstance(plant, LinearSystem):
        plant.validate()
    sizes = getattr(plant, "state_size", n), getattr(plant, "m", m)
    if sizes != (n, m):
        fail(
            "plant", f"has {sizes[0]} states and {sizes[1]} inputs, the controller {n} and {m}",
            "Give them in its coordinates (a RobotController knows those of its robot)",
        )  # fmt: skip
    if jax.tree_util.all_leaves([plant]):  # no pytree
        return Partial(plant.step)
    return Partial(type(plant).step, arrays(plant))


@partial(jax.jit, static_argnames=("steps", "checkpoint"))
def _simulate(
    controller: Any, step: Partial, x0: Array, references: tuple[Array | None, Array | None],
    disturbance: Array | None, previous_input: Array | None, steps: int, checkpoint: bool,
) -> Run:  # fmt: skip
    mpc = controller.mpc
    N, Q, R = mpc.horizon, jnp.asarray(mpc.Q, x0.dtype), jnp.asarray(mpc.R, x0.dtype)
    tolerance = SLACK[x0.dtype.name]
    square = lambda v, W: jnp.sum(v * matmul(W, v))

    def ahead(reference: Array | None, t: Any, length: int) -> Array | None:
        """Return the rows of a reference that the plan at sample t tracks."""
        if reference is None or reference.ndim == 1:
            return reference
        return jax.lax.dynamic_slice_in_dim(reference, t, length)

    def sample(carry: tuple[Array, Any, Array], at: tuple[Array, Array | None]) -> tuple:
        (x, before, previous), (t, w) = carry, at
        r, s = ahead(references[0], t, N + 1), ahead(references[1], t, N)
        u, carried, plan = controller(x, before, r, input_reference=s, previous_input=previous)
        error, effort = (
            v if target is None else v - (target if target.ndim == 1 else target[0])
            for v, target in ((controller.coordinates(x), r), (u, s))
        )
        record = Run(
            states=x, inputs=u, cost=plan.cost, status=plan.status,
            stage_cost=square(error, Q) + square(effort, R),
            violation=_violation(controller, x), slack=plan.slack[0],
            fallback=jnp.any(plan.slack > tolerance),
        )  # fmt: skip
        after = jnp.asarray(step(x, u), x.dtype)
        return (after if w is None else after + w, carried, u), record

    before = controller.start(x0, ahead(references[1], 0, N))
    previous = jnp.zeros(mpc.system.m, x0.dtype) if previous_input is None else previous_input
    samples = (jnp.arange(steps), disturbance)
    run: Run
    if checkpoint:
        sample = jax.checkpoint(sample, prevent_cse=False)
    (last, *_), run = jax.lax.scan(sample, (x0, before, previous), samples, length=steps)
    return replace(
        run, states=jnp.concatenate([run.states, last[None]]),
        violation=jnp.append(run.violation, _violation(controller, last)),
    )  # fmt: skip


def _violation(controller: Any, x: Array) -> Array:
    """Return the most by which x exceeds a row of the controller's state limits."""
    limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), controller.limits)
    return worst_violation(limits, controller.coordinates(x))
