"""simulate: plant and controller together, one sample after the other, under one scan."""

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.tree_util import Partial
from tqdm.std import tqdm

from jaxmpc.checks import fail
from jaxmpc.compiled import Compiled, first_rows, padded
from jaxmpc.control.system import LinearSystem
from jaxmpc.mpc.feedback import LinearFeedback as LinearFeedback
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.qp.status import Status


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Run:
    """A closed loop of T samples: x_{t+1} = plant(x_t, u_t) + w_t, u_t the first input of a plan.

    states (T+1, n), inputs (T, m). Of each plan: cost (T,), the optimal value V_N(x_t) (without
    ½), and status (T,). stage_cost (T,): (x_t − r_t)'Q(x_t − r_t) + (u_t − s_t)'R(u_t − s_t) with
    the references r, s, zero for none. violation (T+1,): the most by which x_t exceeds a row of
    the state limits, in the units of the row; 0 where it keeps them all. slack (T, p): violations
    of the soft rows at k = 0 of each plan, hence of what happens. fallback (T,): whether the plan
    breaks soft rows anywhere on its horizon by more than 1e-6 (1e-3 in float32): what is done
    where the limits cannot all be kept. Batches have their axes in front. For robots states are
    the plant's, (qpos, qvel), and x in costs and limits means their coordinates.
    """

    states: Array
    inputs: Array
    cost: Array
    status: Array
    stage_cost: Array
    violation: Array
    slack: Array
    fallback: Array

    @property
    def feasible_steps(self) -> Array:
        """Samples before the first plan that is not SOLVED: T if all are."""
        solved = jnp.asarray(self.status) == Status.SOLVED
        return jnp.sum(jnp.cumprod(solved, axis=-1), axis=-1)


def simulate(
    controller: Any, plant: Any, x0: Any, steps: int, *, reference: Any = None,
    input_reference: Any = None, disturbance: Any = None, previous_input: Any = None,
    checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Drive `plant` from x0 (n,) with `controller` for T = steps samples.

    controller: a Controller, RobotController or LinearFeedback. plant: a LinearSystem, LinearPlant
    or Robot, or anything with `step(x, u) -> x` written in JAX; the controller's own `mpc.system`
    makes the nominal loop. A plant that is a pytree is an argument of the compiled
    program, any other object a constant of it. reference: state to track, (n,), or (T + N, n) to
    look ahead: the plan at sample t sees the rows t … t+N. input_reference: the same for inputs,
    (m,) or (T + N − 1, m). disturbance (T, n): added to the next states. previous_input (m,):
    u_{−1} where the problem limits or weighs input rates. All in the controller's dtype.
    checkpoint: in reverse mode keep only what is carried from sample to sample, and compute the
    samples again: less memory, more time.

    One instance: `jax.vmap(lambda x: simulate(controller, plant, x, 50))(x0s)` runs thousands and
    compiles once; `simulate_many` does so by chunks that fit into memory. The loop goes on after a
    plan that is not SOLVED, with the first input of its best iterate: `run.feasible_steps` says how
    far the run means anything. Raises ValueError for wrong shapes, before any compile; numbers
    that are not finite get the status NON_FINITE.
    """
    return _simulate(
        *_checked(
            controller, plant, x0, steps, reference, input_reference, disturbance, previous_input
        ),
        int(steps),
        checkpoint,
    )


def simulate_many(
    controller: Any, plant: Any, x0s: Any, steps: int, *, reference: Any = None,
    input_reference: Any = None, variations: Mapping[str, Any] | None = None,
    chunk: int | None = None, progress: bool = False,
) -> Run:  # fmt: skip
    """Closed loops from many initial states x0s (B, n), chunk by chunk; host arrays (B, ...).

    variations: numbers of the plant that differ between the B loops, as `plant.vary` takes them,
    each with B in front: dict(body_mass=(B, nbody), payload=(B,)) randomises masses (domain
    randomisation). The controller knows nothing of them. chunk: loops a compiled program runs
    at once; None: all, halved until the program fits into the device's memory. progress: show a
    bar. The rest is that of `simulate`.
    """
    if np.ndim(x0s) != 2 or not len(x0s):
        fail("x0s", f"shape {np.shape(x0s)}", f"Give (B, {controller.state_size}), B ≥ 1")
    x0s, varied = np.asarray(x0s), dict(variations or {})
    require_variations(plant, varied, len(x0s))
    if chunk is not None and chunk < 1:
        fail("chunk", f"{chunk}", "Give a count of at least 1")
    _checked(controller, plant, x0s[0], steps, reference, input_reference, None, None)
    reference, input_reference = (
        None if v is None else np.asarray(v) for v in (reference, input_reference)
    )
    setting = Steps.of(steps, plant)
    parts = arrays((controller, setting, reference, input_reference))
    rows = lambda start, size: arrays(
        jax.tree.map(lambda v: padded(np.asarray(v)[start : start + size], size), (x0s, varied))
    )
    size = min(chunk or len(x0s), len(x0s))
    while chunk is None and size > 1:
        if needed(_LOOPS.program(*parts, *rows(0, size))) <= 0.8 * memory():
            break
        size = -(-size // 2)
    found = []
    with tqdm(total=len(x0s), unit=" loops", disable=not progress) as bar:
        for start in range(0, len(x0s), size):
            run = _LOOPS(*parts, *rows(start, size))
            here = min(size, len(x0s) - start)
            found.append(first_rows(run, here))
            bar.update(here)
    return jax.tree.map(lambda *v: np.concatenate(v), *found)


def require_variations(plant: Any, varied: Mapping[str, Any], count: int) -> None:
    """Raise ValueError unless `count` plants can differ by these numbers."""
    for key, value in varied.items():
        if np.shape(value)[:1] != (count,):
            fail(f"variations[{key!r}]", f"shape {np.shape(value)}", f"Put {count} in front")
    if varied and not hasattr(plant, "vary"):
        fail("variations", f"given for a {type(plant).__name__}", "Give a Robot or LinearPlant")
    if varied:  # names and shapes
        plant.vary(**{key: np.asarray(value)[0] for key, value in varied.items()})


@dataclass(frozen=True, eq=False)
class Opaque:
    """A plant that is no pytree, told apart by identity."""

    plant: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Steps:
    """For how many samples, and the plant, as a pytree or (opaque) as any object."""

    count: int = field(metadata={"static": True})
    plant: Any
    opaque: Any = field(metadata={"static": True})

    @classmethod
    def of(cls, count: int, plant: Any) -> "Steps":
        """So many steps of a plant."""
        opaque = jax.tree_util.all_leaves([plant])  # no pytree: a constant of the program
        return cls(int(count), None if opaque else plant, Opaque(plant) if opaque else None)


def loops(
    controller: Any, steps: Steps, reference: Any, input_reference: Any, x0s: Array,
    varied: dict[str, Array], checkpoint: bool = False,
) -> Run:  # fmt: skip
    """Closed loops from x0s (B, n), each with its own numbers in the plant. Traceable."""

    def loop(x0: Array, numbers: dict[str, Array]) -> Run:
        plant = steps.plant if steps.opaque is None else steps.opaque.plant
        plant = plant.vary(**numbers) if numbers else plant
        return simulate(
            controller, plant, x0, steps.count, reference=reference,
            input_reference=input_reference, checkpoint=checkpoint,
        )  # fmt: skip

    return jax.vmap(loop)(x0s, varied)


_LOOPS = Compiled(jax.jit(loops))


def lyapunov_decrease(run: Run) -> Array:
    """V_N(x_{t+1}) − V_N(x_t) + l(x_t, u_t) along the loop, (T−1,), l the stage cost.

    Nowhere positive where the optimal value is a Lyapunov function: for the nominal plant, inputs
    free at each step and no weights on their rates or of single stages (which the stage cost here
    leaves out),
    references at an equilibrium, a terminal set that a law u = Kx keeps invariant inside the
    limits, and a terminal cost P ⪰ Q + K'RK + (A+BK)'P(A+BK) (Mayne, Rawlings, Rao & Scokaert
    2000, Automatica 36, section 3.3; the lesson's Theorem 3). Says nothing from
    `run.feasible_steps` on.
    """
    return run.cost[..., 1:] - run.cost[..., :-1] + run.stage_cost[..., :-1]


def _checked(
    controller: Any, plant: Any, x0: Any, steps: Any, reference: Any, input_reference: Any,
    disturbance: Any, previous_input: Any,
) -> tuple:  # fmt: skip
    """The arguments of `_simulate` but the last; ValueError for what is wrong with them."""
    mpc = controller.mpc
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    size = controller.state_size
    if not isinstance(steps, int | np.integer) or isinstance(steps, bool) or steps < 1:
        fail("steps", f"{steps!r}", "Give a whole number of samples, at least 1")
    if np.shape(x0) != (size,):
        fail("x0", f"shape {np.shape(x0)}", f"Give one state ({size},); use jax.vmap for many")
    for name, value, shapes in (
        ("reference", reference, ((n,), (steps + N, n))),
        ("input_reference", input_reference, ((m,), (steps + N - 1, m))),
        ("disturbance", disturbance, ((steps, size),)),
        ("previous_input", previous_input, ((m,),)),
    ):
        if value is not None and np.shape(value) not in shapes:
            fail(name, f"shape {np.shape(value)}", f"Give {' or '.join(map(str, shapes))}")
    cast = lambda v: None if v is None else jnp.asarray(v, controller.dtype)
    references = (cast(reference), cast(input_reference))
    step = _step_of(plant, size, m)
    return controller, step, cast(x0), references, cast(disturbance), cast(previous_input)


def _step_of(plant: Any, n: int, m: int) -> Partial:
    """The plant's step(x, u), what can be traced of the plant as its arguments."""
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


def needed(program: Any) -> float:
    """Bytes that a compiled program takes."""
    found = program.memory_analysis()
    return 0.0 if found is None else found.temp_size_in_bytes + found.output_size_in_bytes


def memory() -> float:
    """Bytes that the present device has."""
    found = jax.devices()[0].memory_stats()
    if found and "bytes_limit" in found:
        return found["bytes_limit"]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


@partial(jax.jit, static_argnames=("steps", "checkpoint"))
def _simulate(
    controller: Any, step: Partial, x0: Array, references: tuple[Array | None, Array | None],
    disturbance: Array | None, previous_input: Array | None, steps: int, checkpoint: bool,
) -> Run:  # fmt: skip
    mpc = controller.mpc
    N, Q, R = mpc.horizon, jnp.asarray(mpc.Q, x0.dtype), jnp.asarray(mpc.R, x0.dtype)
    tolerance = 1e-6 if x0.dtype == jnp.float64 else 1e-3
    square = lambda v, W: jnp.sum(v * matmul(W, v))

    def seen(whole: Array | None, t: Any, length: int) -> Array | None:
        """The rows of a reference that the plan at sample t looks at."""
        if whole is None or whole.ndim == 1:
            return whole
        return jax.lax.dynamic_slice_in_dim(whole, t, length)

    def sample(carry: tuple[Array, Any, Array], at: tuple[Array, Array | None]) -> tuple:
        (x, before, previous), (t, w) = carry, at
        r, s = seen(references[0], t, N + 1), seen(references[1], t, N)
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

    before = controller.start(x0, seen(references[1], 0, N))
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
    """The most by which x exceeds a row of the state limits."""
    if controller.limits is None:
        return jnp.zeros((), x.dtype)
    H, lower, upper = (jnp.asarray(v, x.dtype) for v in controller.limits.rows())
    value = matmul(H, controller.coordinates(x))
    worst = jnp.max(jnp.maximum(value - upper, lower - value), initial=0.0)
    # A maximum need not propagate NaN (XLA on CPUs).
    return jnp.where(jnp.all(jnp.isfinite(x)), worst, jnp.nan)
