"""simulate, simulate_many: plant and controller together, one time step after the other -> Run."""

import functools
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, numpy_array
from jaxmpc.batches import (
    Compiled,
    Devices,
    chosen_devices,
    count,
    device_bytes,
    divisible,
    each_part,
    joined,
    over_devices,
    padded,
    placement,
    program_bytes,
    work_off,
)
from jaxmpc.checks import fail, require_kind, require_real, require_untraced, whole
from jaxmpc.closed_loop.estimation import Belief, KalmanFilter, Noise, model_step
from jaxmpc.closed_loop.feedback import Feedback, LinearFeedback, Plant, first_row, model_of
from jaxmpc.closed_loop.orientations import error_of
from jaxmpc.mpc.plan import Control, checked_aim, checked_array, reference_shapes
from jaxmpc.mpc.problem import weights_of
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.jax_transformations import own_modes, varying
from jaxmpc.qp.linalg import arrays, matmul
from jaxmpc.qp.status import Status
from jaxmpc.robots.parameters import require_numbers
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.limits import worst_violation
from jaxmpc.systems.given_model import as_argument, is_model, written_in_jax
from jaxmpc.systems.system import LinearSystem


@pytree
class Run:
    """A closed loop of T time steps: x_{t+1} = plant(x_t, u_t) + w_t, u_t the first input of a plan
    (with a delay, of the plan one time step earlier).

    states (T+1, n): of the plant; of robots these are (qpos, qvel), and x in costs and limits means
    their coordinates. inputs (T, m): those that acted.
    cost (T,): the optimal value V_N(x_t) of each plan (without ½). status (T,): of each plan.
    stage_cost (T,): (x_t − r_t)'Q(x_t − r_t) + (u_t − s_t)'R(u_t − s_t) with
    the references r, s, for none zero or the motion of a `GaitController`. violation (T+1,): the
    most by which x_t exceeds a row of the state limits, in the units of the row; 0 where it keeps
    them all. slack (T, p): violations of the soft rows at k = 0 of each plan, hence of what
    happens. fallback (T,): whether the plan
    violates soft rows anywhere on its horizon by more than 1e-6 (1e-3 in float32), as happens
    where the limits cannot all be kept. estimates (T, n): the states as an observer estimates them
    from the outputs so far; None without an observer. disturbances (T, k): likewise, where it
    estimates them.

    Batches have their axes in front.
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
    disturbances: Any = None

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

    run: of `simulate`, or with a batch axis in front.

    It is nowhere positive where the optimal value is a Lyapunov function: for the nominal plant,
    inputs free at each step, no weights on input rates or of single stages (the stage cost here
    leaves them out), references at an equilibrium, a terminal set that a law u = Kx keeps invariant
    inside the limits, and a terminal cost P ⪰ Q + K'RK + (A+BK)'P(A+BK) (Mayne, Rawlings, Rao &
    Scokaert 2000, Automatica 36, section 3.3; Rawlings, Mayne & Diehl 2017, section 2.4). The
    values from `run.feasible_steps` on mean nothing.
    """
    return run.cost[..., 1:] - run.cost[..., :-1] + run.stage_cost[..., :-1]


# Slack of a plan that counts as rounding, by precision: the accuracy of solved plans.
SLACK = {"float64": 1e-6, "float32": 1e-3}


def simulate(
    controller: Feedback,
    plant: Plant,
    x0: Reals,
    steps: int,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    disturbance: Reals | None = None,
    output_disturbance: Reals | None = None,
    forecast: Reals | None = None,
    previous_input: Reals | None = None,
    noise: Noise | None = None,
    observer: KalmanFilter | None = None,
    delay: int = 0,
    compensate: bool = True,
    checkpoint: bool = False,
) -> Run:
    """Simulate `plant` under `controller` from the state x0 (n,) for T = steps time steps.

    controller: a Controller, RobotController, NonlinearController, OffsetFreeController or
        LinearFeedback.
    plant: a LinearSystem, LinearPlant or Robot, or any function (x, u) -> x⁺ or object with such a
        `step`, written in JAX; the controller's own `mpc.system`, or `model` of a
        NonlinearController, gives the nominal loop. The arrays of a pytree are arguments of the
        compiled program, any other object is a constant of it.
    reference: state to track in the coordinates of the controller, (n,), or (T + N, n): the plan at
        step t sees the rows t … t+N. None: their origin, also where a robot's problem was made
        about another target.
    input_reference: input to track, (m,), or (T + N − 1, m); None: zero.
    disturbance (T, n): added to the next states. output_disturbance (T, p): to what is measured.
    forecast: what the controller and its observer know of `disturbance`, in the coordinates of the
        controller, (n,), or (T + N − 1, n): the plan at step t sees the rows t … t+N−1. It does not
        act by itself. None: nothing is known ahead.
    previous_input (m,): u_{−1} where the problem limits or weighs input rates, or where inputs are
        delayed; None for zero, with a RobotController for the first input of input_reference.
    noise: `Noise` of the plant and of what is measured; None for none.
    observer: a `KalmanFilter`; the controller sees its estimate, `run.estimates`. None: that of an
        OffsetFreeController, or the controller sees the state, with the measurement noise if there
        is any.
    delay: steps from the measurement to the input that follows from it, 0 or 1. With 1 the input
        computed at step t acts at t + 1, and previous_input at 0.
    compensate: with a delay, plan from the state one step later, which the controller's own model
        predicts under the input on its way, with the references of that step (their last row is
        repeated). False: plan as if there were no delay.
    checkpoint: under reverse-mode differentiation store only what is carried from step to step and
        compute the steps again: less memory, more time.

    Returns one `Run` in the controller's precision. For many initial states use
    `jax.vmap(lambda x: simulate(controller, plant, x, 50))(x0s)`, or `simulate_many`, which splits
    them into chunks that fit into memory. After a plan that is not SOLVED the loop goes on with
    the first input of the best iterate; `run.feasible_steps` counts the steps before that.
    Raises ValueError for wrong shapes, before any compile; numbers that are not finite give the
    status NON_FINITE.
    """
    aims = (reference, input_reference)
    added = disturbance, output_disturbance, forecast
    given = Conditions(*aims, *added, previous_input, noise, observer, delay, compensate)
    plant, x0, given = checked_loop(controller, plant, x0, steps, given)
    return _simulate(controller, plant, x0, given, steps=int(steps), checkpoint=checkpoint)


@pytree
class Conditions:
    """What a closed loop has beside its controller, plant and initial state; see `simulate`."""

    reference: Any = None
    input_reference: Any = None
    disturbance: Any = None
    output_disturbance: Any = None
    forecast: Any = None
    previous_input: Any = None
    noise: Noise | None = None
    observer: KalmanFilter | None = None
    delay: int = static(default=0)
    compensate: bool = static(default=True)


def checked_loop(
    controller: Feedback, plant: Plant, x0: Any, steps: int, given: Conditions
) -> tuple[Any, Array, Conditions]:
    """Return plant, initial state and conditions as arguments of a program, in the controller's
    precision; raise ValueError where one is wrong."""
    require_controller(controller)
    require_kind("compensate", given.compensate, bool, np.bool_, cure="Give True or False")
    n, size = controller.mpc.system.n, controller.state_size
    whole("steps", steps, 1)
    aim = checked_aim(
        controller.mpc,
        x0,
        given.reference,
        given.input_reference,
        given.previous_input,
        given.forecast,
        steps=steps,
        state_size=size,
        widths=getattr(controller, "reference_sizes", None),
    )
    disturbance = given.disturbance
    if disturbance is not None:
        disturbance = checked_array("disturbance", disturbance, [(steps, size)])
    if whole("delay", given.delay, 0) > 1:
        fail("delay", f"{given.delay}", "Give 0 or 1 samples; put longer delays into the model")
    plant = _checked_plant(plant, controller)
    if given.forecast is not None and not getattr(controller, "takes_forecasts", False):
        what = f"given to a {type(controller).__name__} whose plans take none"
        cure = 'Give a Controller, or a RobotController with linearize="set-point"'
        fail("forecast", what, cure)
    observer, noise = given.observer, given.noise
    own = getattr(controller, "observer", None)
    if own is not None and observer is not None:
        fail("observer", "given beside that of the controller", "Leave it out")
    if own is not None:
        _require_period("controller.observer.model", own.model, controller)
    if observer is not None:
        require_kind("observer", observer, KalmanFilter, cure="Give a closed_loop.KalmanFilter")
        _require_period("observer.model", observer.model, controller)
        observer = arrays(observer.prepared())
        if observer.model.n != n:
            what = f"has {observer.model.n} states, the controller's model {n}"
            fail("observer.model", what, "Give the model of the same plant")
    outputs = next((one.p for one in (observer, own) if one is not None), n)
    if noise is not None:
        require_kind("noise", noise, Noise, cure="Give a closed_loop.Noise")
        noise = noise.prepared(n, outputs)
    measured = given.output_disturbance
    if measured is not None:
        measured = checked_array("output_disturbance", measured, [(steps, outputs)])
    seen = any(part is not None for part in (noise, observer, own, measured))
    if size != n and seen and not hasattr(plant, "state"):
        what = f"a {type(plant).__name__} does not say which state has the coordinates ξ"
        fail("plant", what, "Give a Robot, or an object with coordinates(x) and state(ξ)")
    cast = lambda v: jnp.asarray(v, controller.dtype)
    aim, disturbance, measured = jax.tree.map(cast, (aim, disturbance, measured))
    given = replace(
        given,
        reference=aim.states,
        input_reference=aim.inputs,
        disturbance=disturbance,
        output_disturbance=measured,
        forecast=aim.forecast,
        previous_input=aim.previous_input,
        noise=noise,
        observer=observer,
        delay=int(given.delay),
        compensate=bool(given.compensate),
    )
    return plant, aim.x0, given


def require_controller(controller: Any) -> None:
    """Raise ValueError unless a closed loop can be run with this controller."""
    if isinstance(controller, LinearFeedback):
        controller.validate()
    if not hasattr(controller, "mpc"):
        what = f"is a {type(controller).__name__}"
        cure = "Give a Controller, RobotController, NonlinearController or LinearFeedback"
        fail("controller", what, cure)


def _checked_plant(plant: Any, controller: Feedback) -> Any:
    """Return the plant as an argument of a program; raise ValueError unless it is one and fits."""
    n, m = controller.state_size, controller.mpc.system.m
    if not is_model(plant) or hasattr(plant, "mpc"):
        cure = "Give a LinearSystem, a Robot, or a function (x, u) -> x"
        fail("plant", f"is a {type(plant).__name__}", cure)
    if isinstance(plant, LinearSystem):
        plant.validate()
    sizes = getattr(plant, "state_size", n), getattr(plant, "m", m)
    if sizes != (n, m):
        what = f"has {sizes[0]} states and {sizes[1]} inputs, the controller {n} and {m}"
        cure = "Give them in its coordinates (a RobotController knows those of its robot)"
        fail("plant", what, cure)
    _require_period("plant", plant, controller)
    return arrays(as_argument(plant))


def _require_period(argument: str, model: Any, controller: Feedback) -> None:
    """Raise ValueError where a model has another sampling period than that of the controller."""
    both = (getattr(one, "system", one) for one in (model, model_of(controller)))
    (here, unit), (there, other) = (
        (getattr(one, "dt", None), getattr(one, "time_unit", "s")) for one in both
    )
    if here and there and unit == other and abs(here - there) > 1e-6 * there:
        what = f"has a sampling period of {here:g} {unit}, the controller's model {there:g}"
        fail(argument, what, "Give both the same one (dt=, control_period=)")


# What goes from one time step to the next: the state, what the controller gave at the step before,
# the input then, and the observer's belief.
Carried = tuple[Array, Control, Array, Belief | None]
# What befalls a time step: its number, the disturbance, the noise of the plant and of the outputs.
Exogenous = tuple[Array, Array | None, Array | None, Array | None]


class Loop:
    """One closed loop: what its time steps share."""

    def __init__(self, controller: Feedback, plant: Plant, given: Conditions, dtype: Any) -> None:
        self.controller, self.plant, self.given = controller, plant, given
        own = getattr(controller, "observer", None)
        self.observer: KalmanFilter | None = given.observer if own is None else own
        self.horizon = controller.mpc.horizon
        weights = weights_of(replace(controller.mpc, stage_weights=None), dtype)
        # Where they differ from step to step a time step costs what the first of a plan does.
        self.Q, self.R = (M[0] if M.ndim == 3 else M for M in (weights.Q, weights.R))
        # Steps by which plans begin later than what is measured.
        self.later = given.delay if given.compensate else 0
        # ξ of a state and the state of ξ, where the plant tells them apart.
        self.coordinates = getattr(plant, "coordinates", lambda x: x)
        self.state = getattr(plant, "state", lambda xi: xi)

    def rows(self, reference: Array | None, t: Array | int, length: int) -> Array | None:
        """Return the rows of a reference that a plan which begins at step t tracks."""
        if reference is None or reference.ndim == 1:
            return reference
        if self.later:
            reference = jnp.concatenate([reference, reference[-1:]])
        return jax.lax.dynamic_slice_in_dim(reference, t, length)

    def references(self, t: Array) -> tuple[Array | None, Array | None]:
        """Return both references as a plan that begins at step t tracks them."""
        N, given = self.horizon, self.given
        return self.rows(given.reference, t, N + 1), self.rows(given.input_reference, t, N)

    def seen(
        self, x: Array, t: Array, previous: Array, belief: Belief | None, noise: Array | None
    ) -> tuple[Array, Array | None, Belief | None]:
        """Return the state that the controller plans from, the observer's estimate of state and
        disturbances from the outputs so far, and what it goes on with."""
        observer, seen, estimate = self.observer, x, None
        if observer is not None and belief is not None:
            y = observer.outputs(self.coordinates(x))
            belief = observer.corrected(belief, y if noise is None else y + noise)
            estimate = belief.mean
            seen = self.state(observer.split(estimate)[0])
        elif noise is not None:
            seen = self.state(self.coordinates(x) + noise)
        if self.given.delay and observer is not None and belief is not None:
            belief = self.predicted(belief, previous, t)
            if self.later:
                seen = self.state(observer.split(belief.mean)[0])
        elif self.later:
            known, model = self.known(t), model_of(self.controller, t)
            after = model_step(model, self.coordinates(seen), previous)
            seen = self.state(after if known is None else after + known)
        return seen, estimate, belief

    def known(self, t: Array) -> Array | None:
        """Return what is known to be added to the state after step t."""
        forecast = self.given.forecast
        return forecast if forecast is None or forecast.ndim == 1 else forecast[t]

    def predicted(self, belief: Belief, u: Array, t: Array) -> Belief:
        """Return the observer's belief after step t, under the input u."""
        assert self.observer is not None
        numbers_at: Any = getattr(self.controller, "numbers_at", lambda t: {})
        return self.observer.predicted(belief, u, self.known(t), numbers_at(t))

    def stage_cost(self, x: Array, u: Array, t: Array) -> Array:
        """Return (x − r)'Q(x − r) + (u − s)'R(u − s), r and s the references at step t, those of
        the controller's own motion where none are given."""
        r, s = self.references(t)
        controller: Any = self.controller
        if hasattr(controller, "motion"):
            own_r, own_s = controller.motion(t)
            r, s = own_r if r is None else r, own_s if s is None else s
        r, s = (None if v is None else first_row(v, x.dtype) for v in (r, s))
        if hasattr(controller, "distance"):
            error = controller.distance(x, r, t)
        else:
            error = error_of(model_of(controller), controller.mpc, controller.coordinates(x), r)
        effort = u if s is None else u - s
        return jnp.sum(error * matmul(self.Q, error)) + jnp.sum(effort * matmul(self.R, effort))

    def violation(self, x: Array) -> Array:
        """Return the most by which x exceeds a row of the controller's state limits."""
        limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), self.controller.limits)
        return worst_violation(limits, self.controller.coordinates(x))

    def step(self, carried: Carried, exogenous: Exogenous) -> tuple[Carried, Run]:
        """Return what goes on to the next time step, and the record of this one."""
        (x, before, previous, belief), (t, disturbance, process, measurement) = carried, exogenous
        observer = self.observer
        seen, estimate, belief = self.seen(x, t, previous, belief, measurement)
        begin = t + 1 if self.later else t
        r, s = self.references(begin)
        told: dict[str, Any] = {"input_reference": s, "previous_input": previous}
        if self.given.forecast is not None:
            told["forecast"] = self.rows(self.given.forecast, begin, self.horizon)
        state = disturbances = None
        if observer is not None and estimate is not None:
            state, found = observer.split(estimate)
            state, disturbances = self.state(state), found if len(found) else None
        if getattr(self.controller, "observer", None) is not None:
            told["disturbance"] = disturbances
        elif observer is not None and disturbances is not None and observer.estimates_numbers:
            if getattr(self.controller, "takes_numbers", False):
                told["numbers"] = observer.numbers(disturbances)
        control = self.controller(seen, before, r, **told)
        plan, u = control.plan, previous if self.given.delay else control.u
        record = Run(
            states=x,
            inputs=u,
            cost=plan.cost,
            status=plan.status,
            stage_cost=self.stage_cost(x, u, t),
            violation=self.violation(x),
            slack=plan.slack[0],
            fallback=jnp.any(plan.slack > SLACK[x.dtype.name]),
            estimates=state,
            disturbances=disturbances,
        )
        with written_in_jax("plant"):
            after = self.plant.step(x, u)
        shape = getattr(after, "shape", None)
        if shape != x.shape:
            what = f"shape {shape}" if shape is not None else f"a {type(after).__name__}"
            what = f"has a step that returns {what}"
            fail("plant", what, f"Return the next state {x.shape}")
        after = jnp.asarray(after, x.dtype)
        if process is not None:
            after = self.state(self.coordinates(after) + process)
        if observer is not None and belief is not None and not self.given.delay:
            belief = self.predicted(belief, u, t)
        after = after if disturbance is None else after + disturbance
        return (after, control, control.u, belief), record


@partial(jax.jit, static_argnames=("steps", "checkpoint"))
@own_modes
def _simulate(
    controller: Feedback,
    plant: Plant,
    x0: Array,
    given: Conditions,
    *,
    steps: int,
    checkpoint: bool,
) -> Run:
    loop, system = Loop(controller, plant, given, x0.dtype), controller.mpc.system
    observer, previous = loop.observer, given.previous_input
    start = lambda t: controller.start(x0, loop.rows(given.input_reference, t, loop.horizon))
    before = start(loop.later)
    if previous is None:  # a start traces the whole controller
        previous = (start(0) if loop.later else before).u
    if loop.later and hasattr(controller, "begun"):
        before = controller.begun(before, loop.later)
    outputs = system.n if observer is None else observer.p
    w = v = belief = None
    if given.noise is not None:
        w, v = given.noise.draw(steps, system.n, outputs, x0.dtype)
    if given.output_disturbance is not None:
        v = given.output_disturbance if v is None else v + given.output_disturbance
    if observer is not None:
        belief = observer.first(loop.coordinates(x0))
    first = x0, before, previous, belief
    exogenous = jnp.arange(steps), given.disturbance, w, v
    step = jax.checkpoint(loop.step, prevent_cse=False) if checkpoint else loop.step
    (last, *_), run = jax.lax.scan(step, varying(first, first), exogenous, length=steps)
    states = jnp.concatenate([run.states, last[None]])
    return replace(run, states=states, violation=jnp.append(run.violation, loop.violation(last)))


def initial_states(owner: Any, x0s: Reals, argument: str = "x0s") -> np.ndarray:
    """Return initial states (B, n), checked against the length of those of a controller or plant,
    where that has one."""
    require_real(argument, x0s)
    found, size = numpy_array(x0s), getattr(owner, "state_size", None)
    if found.ndim != 2 or not len(found) or size not in (None, found.shape[1]):
        cure = f"Give (B, {size or 'n'}), B ≥ 1, one initial state a row"
        fail(argument, f"shape {found.shape}", cure)
    return found


def simulate_many(
    controller: Feedback,
    plant: Plant,
    x0s: Reals,
    steps: int,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    references: Reals | None = None,
    input_references: Reals | None = None,
    disturbance: Reals | None = None,
    disturbances: Reals | None = None,
    output_disturbance: Reals | None = None,
    forecast: Reals | None = None,
    previous_input: Reals | None = None,
    noise: Noise | None = None,
    observer: KalmanFilter | None = None,
    delay: int = 0,
    compensate: bool = True,
    variations: Mapping[str, Any] | None = None,
    chunk: int | None = None,
    progress: bool = False,
    devices: Any = None,
) -> Run:
    """Simulate closed loops from many initial states x0s (B, n); return NumPy arrays (B, ...).

    controller, plant, steps, previous_input, observer, delay, compensate: as in `simulate`.
    reference, input_reference, disturbance, output_disturbance, forecast: as in `simulate`, the
        same for all loops.
    references, input_references: one for each loop, (B, n) and (B, m), or over time (B, T + N, n)
        and (B, T + N − 1, m); in place of those for all.
    disturbances (B, T, n): one for each loop, in place of that for all.
    noise: as in `simulate`, each loop with its own (see `Noise.seed`).
    variations: parameters of the plant that differ between the B loops, as `plant.vary` takes
        them, each with B in front: dict(body_mass=(B, nbody), payload=(B,)) randomises masses
        (domain randomisation). The controller keeps the nominal model.
    chunk: number of loops that the compiled program runs at once; None: all of them, halved until
        the program fits into the memory of the device.
    progress: show a progress bar.
    devices: a number of them, or a sequence of JAX devices, which share the loops of a chunk; None:
        the default device.

    Raises ValueError as `simulate` does.
    """
    cure = "Call it outside jit, vmap and grad; inside them take jax.vmap of jm.simulate"
    for argument, value in {"x0s": x0s, "controller": controller, "plant": plant}.items():
        require_untraced(argument, value, cure)
    x0s = initial_states(controller, x0s)
    if variations is not None:
        cure = "Give a dict, such as {'mass': masses} with one entry for each loop"
        require_kind("variations", variations, Mapping, cure=cure)
    variations = {name: numpy_array(v) for name, v in dict(variations or {}).items()}
    require_variations(plant, variations, len(x0s))
    chunk = None if chunk is None else whole("chunk", chunk, 1)
    devices = chosen_devices(devices)
    aims = (reference, input_reference)
    added = disturbance, output_disturbance, forecast
    given = Conditions(*aims, *added, previous_input, noise, observer, delay, compensate)
    plant, _, shared = checked_loop(controller, plant, x0s[0], steps, given)
    several = {"reference": references, "input_reference": input_references}
    several["disturbance"] = disturbances
    own = {name: numpy_array(value) for name, value in several.items() if value is not None}
    _require_own(own, given, controller, steps, len(x0s))
    numbers = None if noise is None else np.arange(len(x0s))
    each = Each(x0s, variations, own, numbers)
    shares = jax.device_put(arrays((controller, plant, shared)), placement(devices))
    loops = _compiled_loops(int(steps), devices)

    def run(part: Each) -> Run:
        return loops(*shares, jax.device_put(part, placement(devices, True)))

    size = divisible(min(chunk or len(x0s), len(x0s)), devices)
    while chunk is None and size > count(devices):
        first = jax.tree.map(lambda v, size=size: padded(np.asarray(v)[:size], size), each)
        program = loops.program(*shares, jax.device_put(first, placement(devices, True)))
        if program_bytes(program) <= 0.8 * device_bytes():
            break
        size = divisible(-(-size // 2), devices)
    runs = list[Run]()
    keep = lambda part: runs.append(part.result)
    work_off(each_part(run, each, size), keep, len(x0s), unit="loops", progress=progress)
    return joined(runs)


@pytree
class Each:
    """What differs between B loops: initial states (B, n), variations of the plant, references of
    their own by name, and the numbers (B,) of the loops for their noise, None without noise."""

    x0s: Any
    variations: dict[str, Any]
    references: dict[str, Any]
    numbers: Any = None


def _require_own(
    own: Mapping[str, np.ndarray], shared: Conditions, controller: Feedback, steps: int, count: int
) -> None:
    """Raise ValueError unless what each loop has of its own, references and disturbances, has these
    shapes."""
    widths = getattr(controller, "reference_sizes", None)
    shapes = reference_shapes(controller.mpc, steps, widths)
    shapes["disturbance"] = [(steps, controller.state_size)]
    for name, value in own.items():
        if getattr(shared, name) is not None:
            fail(f"{name}s", f"given beside {name}", "Give one for all loops, or one for each")
        require_real(f"{name}s", value)
        choice = [(count, *shape) for shape in shapes[name]]
        if value.shape not in choice:
            listed = " or ".join(map(str, choice))
            cure = f"Give {listed}, one for each loop; {name} is for all of them"
            fail(f"{name}s", f"shape {value.shape}", cure)


def require_variations(plant: Any, variations: Mapping[str, Any], count: int) -> None:
    """Raise ValueError unless `count` plants can differ by these parameters."""
    for key, value in variations.items():
        if np.shape(value)[:1] != (count,):
            fail(f"variations[{key!r}]", f"shape {np.shape(value)}", f"Put {count} in front")
    if variations and not hasattr(plant, "vary"):
        fail("variations", f"given for a {type(plant).__name__}", "Give a Robot or LinearPlant")
    if isinstance(plant, Robot):
        require_numbers(plant.plant, variations, (count,))
    elif variations:  # the plant checks names and shapes
        plant.vary(**{key: np.asarray(value)[0] for key, value in variations.items()})


def simulate_each(
    controller: Feedback,
    plant: Any,
    shared: Conditions,
    each: Each,
    *,
    steps: int,
    checkpoint: bool,
) -> Run:
    """Return the runs (B, ...) of loops under shared conditions and those of their own. Works
    inside jit, vmap and grad.

    plant: from `as_argument`; each loop has it with its own variations.
    """

    def loop(one: Each) -> Run:
        given = replace(shared, **one.references)
        if shared.noise is not None:
            given = replace(given, noise=shared.noise.of_loop(one.numbers))
        varied = plant.vary(**one.variations) if one.variations else plant
        return simulate(controller, varied, one.x0s, steps, checkpoint=checkpoint, **vars(given))

    return jax.vmap(loop)(each)


@functools.cache
def _compiled_loops(steps: int, devices: Devices) -> Compiled:
    loops = functools.partial(simulate_each, steps=steps, checkpoint=False)
    return over_devices(loops, devices, (False, False, False, True))
