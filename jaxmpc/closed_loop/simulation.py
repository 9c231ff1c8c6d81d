"""simulate: plant and controller together, one sample after the other, under one scan."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_real, whole
from jaxmpc.closed_loop.linear_feedback import LinearFeedback
from jaxmpc.closed_loop.noise import Noise
from jaxmpc.closed_loop.observer import KalmanFilter, model_of, model_step
from jaxmpc.closed_loop.run import Run
from jaxmpc.mpc.problem import weights_of
from jaxmpc.pytrees import record
from jaxmpc.qp.modes import own_modes, varying
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.sets.violations import worst_violation
from jaxmpc.systems.system import LinearSystem

# Slack of a plan that counts as rounding, by precision: the accuracy of solved plans.
SLACK = {"float64": 1e-6, "float32": 1e-3}


def simulate(
    controller: Any, plant: Any, x0: Reals, steps: int, *, reference: Reals | None = None,
    input_reference: Reals | None = None, disturbance: Reals | None = None,
    previous_input: Reals | None = None,
    noise: Noise | None = None, observer: KalmanFilter | None = None, delay: int = 0,
    compensate: bool = True, checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Simulate `plant` under `controller` from the state x0 (n,) for T = steps samples.

    controller: a Controller, RobotController or LinearFeedback.
    plant: a LinearSystem, LinearPlant or Robot, or any object with `step(x, u) -> x` written in
        JAX; the controller's own `mpc.system` gives the nominal loop. A plant that is a pytree is
        an argument of the compiled program, any other object a constant of it.
    reference: state to track in the coordinates of the controller, (n,), or (T + N, n): the plan at
        sample t sees the rows t … t+N. None: their origin, also where a robot's problem was made
        about another target.
    input_reference: input to track, (m,), or (T + N − 1, m); None: zero.
    disturbance (T, n): added to the next states.
    previous_input (m,): u_{−1} where the problem limits or weighs input rates, or where inputs are
        delayed; None for zero.
    noise: `Noise` of the plant and of what is measured; None for none.
    observer: a `KalmanFilter`; the controller sees its estimate, `run.estimates`. None: the
        controller sees the state, with the measurement noise if there is any.
    delay: samples from the measurement to the input that follows from it, 0 or 1. With 1 the input
        computed at sample t acts at t + 1, and previous_input at 0.
    compensate: with a delay, plan from the state one sample later, which the controller's own model
        predicts under the input on its way, with the references of that sample (their last row is
        repeated). False: plan as if there were no delay.
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
        controller, plant, x0, steps, reference=reference, input_reference=input_reference,
        disturbance=disturbance, previous_input=previous_input, noise=noise, observer=observer,
        delay=delay,
    )  # fmt: skip
    return _simulate(*checked, int(steps), int(delay), bool(compensate), checkpoint)


def checked_arguments(
    controller: Any, plant: Any, x0: Any, steps: Any, *, reference: Any = None,
    input_reference: Any = None, disturbance: Any = None, previous_input: Any = None,
    noise: Any = None, observer: Any = None, delay: Any = 0,
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
        (
            "reference",
            reference,
            tuple(shape for k in reference_sizes(controller) for shape in ((k,), (steps + N, k))),
        ),
        ("input_reference", input_reference, ((m,), (steps + N - 1, m))),
        ("disturbance", disturbance, ((steps, size),)),
        ("previous_input", previous_input, ((m,),)),
    ):
        if value is None:
            continue
        require_real(name, value)
        if np.shape(value) not in shapes:
            fail(name, f"shape {np.shape(value)}", f"Give {' or '.join(map(str, shapes))}")
    if whole("delay", delay, 0) > 1:
        fail("delay", f"{delay}", "Give 0 or 1 samples; put longer delays into the model")
    plant = _checked_plant(plant, size, m)
    if observer is not None:
        if not isinstance(observer, KalmanFilter):
            fail("observer", f"is a {type(observer).__name__}", "Give a closed_loop.KalmanFilter")
        observer = arrays(observer.prepared())
        if observer.model.n != n:
            what = f"has {observer.model.n} states, the controller's model {n}"
            fail("observer.model", what, "Give the model of the same plant")
    if noise is not None:
        if not isinstance(noise, Noise):
            fail("noise", f"is a {type(noise).__name__}", "Give a closed_loop.Noise")
        noise = noise.prepared(n, n if observer is None else observer.p)
    if size != n and (noise is not None or observer is not None) and not hasattr(plant, "state"):
        what = f"a {type(plant).__name__} does not say which state has the coordinates ξ"
        fail("plant", what, "Give a Robot, or an object with coordinates(x) and state(ξ)")
    cast = lambda v: None if v is None else jnp.asarray(v, controller.dtype)
    references = (cast(reference), cast(input_reference))
    given = (cast(x0), references, cast(disturbance), cast(previous_input))
    return controller, as_argument(plant), *given, noise, observer


def reference_sizes(controller: Any) -> tuple[int, ...]:
    """Return how many columns the reference of a controller may have."""
    return getattr(controller, "reference_sizes", (controller.mpc.system.n,))


def _checked_plant(plant: Any, n: int, m: int) -> Any:
    """Return the plant, its leaves as arrays; raise ValueError unless it has `step` and fits."""
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
    return plant if jax.tree_util.all_leaves([plant]) else arrays(plant)


@jax.tree_util.register_static
@record
class ConstantPlant:
    """A plant that is no pytree: a constant of the compiled program, compared by identity."""

    plant: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ConstantPlant) and self.plant is other.plant

    def __hash__(self) -> int:
        return id(self.plant)


def as_argument(plant: Any) -> Any:
    """Return the plant as an argument of a program: itself where it is a pytree."""
    return ConstantPlant(plant) if jax.tree_util.all_leaves([plant]) else plant


@partial(jax.jit, static_argnames=("steps", "delay", "compensate", "checkpoint"))
@own_modes
def _simulate(
    controller: Any, plant: Any, x0: Array, references: tuple[Array | None, Array | None],
    disturbance: Array | None, previous_input: Array | None, noise: Noise | None,
    observer: KalmanFilter | None, steps: int, delay: int, compensate: bool, checkpoint: bool,
) -> Run:  # fmt: skip
    plant = plant.plant if isinstance(plant, ConstantPlant) else plant
    mpc = controller.mpc
    N, (Q, R, *_) = mpc.horizon, weights_of(mpc, x0.dtype)
    tolerance = SLACK[x0.dtype.name]
    square = lambda v, W: jnp.sum(v * matmul(W, v))
    ahead_by = delay if compensate else 0
    # ξ of a state and the state of ξ, where the plant tells them apart.
    coordinates = getattr(plant, "coordinates", lambda x: x)
    state = getattr(plant, "state", lambda xi: xi)

    def ahead(reference: Array | None, t: Any, length: int) -> Array | None:
        """Return the rows of a reference that a plan which begins at sample t tracks."""
        if reference is None or reference.ndim == 1:
            return reference
        if ahead_by:
            reference = jnp.concatenate([reference, reference[-1:]])
        return jax.lax.dynamic_slice_in_dim(reference, t, length)

    def rows(t: Any) -> tuple[Array | None, Array | None]:
        """Return both references as a plan that begins at sample t tracks them."""
        return ahead(references[0], t, N + 1), ahead(references[1], t, N)

    def sample(carry: tuple[Array, Any, Array, Any], at: tuple) -> tuple:
        (x, before, previous, belief), (t, d, w, v) = carry, at
        seen = x
        if observer is not None:
            y = observer.outputs(coordinates(x))
            belief = observer.corrected(belief, y if v is None else y + v)
            seen = state(belief.mean)
        elif v is not None:
            seen = state(coordinates(x) + v)
        estimate = None if observer is None else seen
        if delay:
            belief = None if observer is None else observer.predicted(belief, previous)
            if compensate and belief is not None:
                seen = state(belief.mean)
            elif compensate:
                seen = state(model_step(model_of(controller), coordinates(seen), previous))
        r, s = rows(t + 1 if ahead_by else t)
        control = controller(seen, before, r, input_reference=s, previous_input=previous)
        plan, u = control.plan, previous if delay else control.u
        error, effort = (
            value
            if target is None
            else value - (target if target.ndim == 1 else target[0])[: len(value)]
            for value, target in zip(
                (controller.coordinates(x), u), rows(t) if ahead_by else (r, s), strict=True
            )
        )
        record = Run(
            states=x, inputs=u, cost=plan.cost, status=plan.status,
            stage_cost=square(error, Q) + square(effort, R),
            violation=_violation(controller, x), slack=plan.slack[0],
            fallback=jnp.any(plan.slack > tolerance), estimates=estimate,
        )  # fmt: skip
        after = jnp.asarray(plant.step(x, u), x.dtype)
        if w is not None:
            after = state(coordinates(after) + w)
        if observer is not None and not delay:
            belief = observer.predicted(belief, u)
        return (after if d is None else after + d, control, control.u, belief), record

    before = controller.start(x0, ahead(references[1], ahead_by, N))
    previous = jnp.zeros(mpc.system.m, x0.dtype) if previous_input is None else previous_input
    n, p = mpc.system.n, mpc.system.n if observer is None else observer.p
    w, v = (None, None) if noise is None else noise.draw(steps, n, p, x0.dtype)
    belief = None if observer is None else observer.first(coordinates(x0))
    run: Run
    if checkpoint:
        sample = jax.checkpoint(sample, prevent_cse=False)
    samples, first = (jnp.arange(steps), disturbance, w, v), (x0, before, previous, belief)
    (last, *_), run = jax.lax.scan(sample, varying(first, first), samples, length=steps)
    return replace(
        run, states=jnp.concatenate([run.states, last[None]]),
        violation=jnp.append(run.violation, _violation(controller, last)),
    )  # fmt: skip


def _violation(controller: Any, x: Array) -> Array:
    """Return the most by which x exceeds a row of the controller's state limits."""
    limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), controller.limits)
    return worst_violation(limits, controller.coordinates(x))
