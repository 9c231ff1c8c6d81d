"""tune_weights: the numbers of an MPC problem by gradient through its closed loops."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxmpc.checks import fail, whole
from jaxmpc.closed_loop.memory import device_bytes, program_bytes
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulate_many import as_argument, require_variations, simulate_batch
from jaxmpc.compiled import Compiled
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.soften import harden
from jaxmpc.mpc.solve import Controller
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.precision import arrays
from jaxmpc.qp.status import Status
from jaxmpc.tuning import archive
from jaxmpc.tuning.descent import Descent, descend, minibatch
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameters, raw, require_parameters, values

MODES = ("auto", "forward", "reverse")
# Parameters up to which forward mode is tried by "auto": it pays for each of them.
FORWARD = 32


@dataclass(frozen=True, eq=False)
class TuningRun:
    """What tuning found: the values of least validation loss, and how it came there.

    values, initial: name → array, the best and the first. history: of every step (`Descent`);
    numbers are means over the loops of a step, validation_numbers over the validation loops:

        unsolved    share of plans that are not SOLVED, infeasible ones and others
        infeasible  share of plans proved infeasible
        fallback    share of plans that break soft rows
        violation   share of loops that leave the limits of a ClosedLoopLoss (of another loss:
                    the controller's own) by more than 1e-6 (1e-3 in float32)
        excluded    loops left out because their loss was not finite

    mode: "forward", "reverse" or "reverse, checkpointed". settings: what was asked, JSON data.
    """

    values: dict[str, np.ndarray]
    initial: dict[str, np.ndarray]
    history: Descent
    mode: str
    settings: dict[str, Any]
    parameters: Parameters
    make_mpc: Callable[[Mapping[str, Any]], Any]
    solver: ADMM

    @property
    def controller(self) -> Any:
        """The controller with the best values."""
        return controller_of(self.make_mpc, self.values, self.solver)

    @property
    def mpc(self) -> MPC:
        """The problem with the best values."""
        made = self.make_mpc(self.values)
        return made if isinstance(made, MPC) else made.mpc

    @property
    def improvement(self) -> float:
        """By which share the validation loss fell: 0.2 for 20 %."""
        first, best = self.history.validation[[0, self.history.best]]
        return float((first - best) / abs(first)) if first else 0.0

    def record(self) -> dict[str, Any]:
        """All of it as JSON data: settings, values, and the numbers of every step."""
        h = self.history
        column = lambda v: [float(x) if np.isfinite(x) else None for x in v]
        each = jax.vmap(partial(values, self.parameters))
        trace = jax.tree.map(np.asarray, each(jax.tree.map(jnp.asarray, h.thetas)))
        listed = lambda tree: {name: np.asarray(v).tolist() for name, v in tree.items()}
        return {
            "settings": self.settings, "mode": self.mode, "initial": listed(self.initial),
            "values": listed(self.values), "best_step": h.best, "improvement": self.improvement,
            "loss": column(h.loss), "gradient_norm": column(h.gradient_norm),
            "accepted": h.accepted.tolist(), "validation": column(h.validation),
            "numbers": {name: column(v) for name, v in h.numbers.items()},
            "validation_numbers": {name: column(v) for name, v in h.validation_numbers.items()},
            "values_by_step": listed(trace), "seconds": h.seconds,
        }  # fmt: skip


def tune_weights(
    make_mpc: Callable[[Mapping[str, Any]], Any], parameters: Parameters, plant: Any, x0s: Any,
    loss: Callable[[Run], Any] | None = None, steps: int = 50, *, reference: Any = None,
    input_reference: Any = None, variations: Mapping[str, Any] | None = None,
    solver: ADMM = ADMM(iterations=50, refine=3),  # noqa: B008
    optimizer: optax.GradientTransformation | None = None, updates: int = 100,
    batch: int | None = None, validation: Any = 0.25,
    design_loss: Callable[[MPC], Any] | None = None, mode: str = "auto", seed: int = 0,
    checkpoint: str | Path | None = None, progress: bool = False,
) -> TuningRun:  # fmt: skip
    """Minimise the mean loss of closed loops over parameters of their MPC, by gradient.

        min_θ  mean_i loss(run_i(θ)) + design_loss(mpc(θ)),   run_i from x0s[i], T = steps samples

    The derivative goes through plant, solver (`ADMM.differentiate`) and all samples. It is finite
    whatever becomes of single plans: an infeasible QP has the derivative of the closest feasible
    one, a robot's MPC is soft; both are counted in the history.

    Arguments:
        make_mpc: name → value of all parameters to an MPC (then driven by `Controller` with
            `solver`) or to a controller, such as RobotController. It is traced: make what needs
            the host (`robot_mpc`) outside, and put values in by `dataclasses.replace`. Any field
            of MPC can depend on them, and `jm.lqr` inside has a derivative.
        parameters: name → `Parameter`.
        plant: as in `simulate`. x0s (B, n): initial states. variations: as in `simulate_many`,
            each (B, …): numbers of the plant of which the controller knows nothing.
        loss: of one run. None: `ClosedLoopLoss` with Q, R and state limits of the problem at the
            start. Not `run.stage_cost`: it is weighed by the very Q and R that are tuned.
        reference, input_reference: as in `simulate`, or functions of the values.
        optimizer: of optax; None: Adam of 0.05, which moves a weight by 5 % a step.
        batch: loops of each step, drawn anew from x0s; None: all. updates: number of steps.
        validation: share of x0s (the last ones) kept apart, or initial states of its own (then
            without variations, unless it is a pair of states and variations).
        design_loss: of the problem alone, such as the `feasible_share` of sample states.
        mode: "forward" (cost grows with the number of parameters, memory does not), "reverse"
            (the other way round; samples are computed twice where memory asks for it), "auto":
            both are timed on the first step's data where there are at most 32 parameters.
        checkpoint: file that is replaced after every step (`descend`); where it is present the
            run goes on from there. It must be of the same run: parameters and data are compared,
            and the loss at the start is computed again.

    Raises ValueError for what does not fit together, before any compile.
    """
    require_parameters(parameters)
    x0s = np.asarray(x0s)
    if x0s.ndim != 2 or not len(x0s):
        fail("x0s", f"shape {x0s.shape}", "Give initial states (B, n)")
    variations = {name: np.asarray(v) for name, v in dict(variations or {}).items()}
    require_variations(plant, variations, len(x0s))
    if mode not in MODES:
        fail("mode", f"{mode!r}", f"Give one of {', '.join(MODES)}")
    batch = len(x0s) if batch is None else whole("batch", batch, 1)
    steps, updates = whole("steps", steps, 1), whole("updates", updates, 0)
    seed = whole("seed", seed, 0)
    train, test = split((x0s, variations), validation)
    require_variations(plant, test[1], len(test[0]))
    size = min(batch, len(train[0]))
    start = raw(parameters)
    initial = {name: np.asarray(p.value) for name, p in parameters.items()}
    controller = controller_of(make_mpc, initial, solver)
    if loss is None:
        mpc = controller.mpc
        r, s = (aim(initial) if callable(aim) else aim for aim in (reference, input_reference))
        limits = controller.limits
        if limits is None and mpc.soft:
            limits = harden(mpc).states
        loss = ClosedLoopLoss(
            np.asarray(mpc.Q), np.asarray(mpc.R), r, s, limits,
            plant=plant if hasattr(plant, "coordinates") else None,
        )  # fmt: skip
    problem = Problem(
        make_mpc, parameters, solver, as_argument(plant), steps, loss, reference,
        input_reference, design_loss,
    )  # fmt: skip
    problem.check(start, train)
    settings = {
        "parameters": {name: p.record() for name, p in parameters.items()},
        "steps": steps, "batch": size, "train": len(train[0]), "validation": len(test[0]),
        "seed": seed, "data": archive.fingerprint(None, train, test),
        "dtype": np.dtype(controller.dtype).name,
    }  # fmt: skip

    def data(step: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """The initial states of a step."""
        chosen = minibatch(len(train[0]), size, seed, step)
        return jax.tree.map(lambda v: v[chosen], train)

    slopes_by: list[tuple[str, Callable]] = []  # the mode chosen, once a step is asked for
    evaluate = Compiled(jax.jit(problem.total))
    sound: list[np.ndarray] = []  # of the validation loops, those finite at the start

    def gradient(theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        x, varied = data(step)
        if not slopes_by:
            slopes_by.append(problem.gradient(start, data(0), mode))
        slope, weights = slopes_by[0][1], np.ones(len(x))
        value, slopes, aux = slope(theta, x, varied, weights)
        finite = np.isfinite(value) and all(np.all(np.isfinite(v)) for v in jax.tree.leaves(slopes))
        bad = ~np.isfinite(aux["losses"])
        if not finite and bad.any() and not bad.all():  # the rest without them
            weights = np.where(bad, 0.0, 1.0)
            keep = np.where(bad, np.argmin(bad), np.arange(len(x)))
            x, varied = jax.tree.map(lambda v: v[keep], (x, varied))
            value, slopes, aux = slope(theta, x, varied, weights)
        return value, slopes, numbers(aux, weights)

    def validate(theta: Any) -> tuple[float, dict[str, float]]:
        _, aux = evaluate(*problem.arguments(theta, test[0], test[1], np.ones(len(test[0]))))
        if not sound:
            sound.append(np.isfinite(aux["losses"]))
        # Loops that are not finite at the start are left out for good; another makes the loss NaN.
        used = aux["losses"][sound[0]]
        value = np.mean(used) + aux["design"] if len(used) else np.nan
        return float(value), numbers(aux, sound[0])

    history = descend(
        start, gradient, validate, optax.adam(0.05) if optimizer is None else optimizer, updates,
        checkpoint=checkpoint, settings=settings, progress=progress,
    )  # fmt: skip
    best = exact_values(parameters, history.theta)
    chosen = slopes_by[0][0] if slopes_by else mode
    return TuningRun(best, initial, history, chosen, settings, parameters, make_mpc, solver)


def exact_values(parameters: Parameters, theta: Any) -> dict[str, np.ndarray]:
    """The values at θ in float64, on the host."""
    with jax.enable_x64(True):
        return jax.tree.map(np.asarray, values(parameters, theta))


def controller_of(make_mpc: Any, given: Mapping[str, Any], solver: ADMM) -> Any:
    """The controller that make_mpc's problem leads to."""
    made = make_mpc(given)
    if isinstance(made, MPC):
        return Controller(made, solver)
    if not (callable(made) and hasattr(made, "mpc") and hasattr(made, "start")):
        fail("make_mpc", f"returns a {type(made).__name__}", "Return a jm.MPC or a controller")
    return made


def numbers(aux: dict[str, np.ndarray], weights: np.ndarray) -> dict[str, float]:
    """Means over the loops with weight, see `TuningRun`."""
    used = np.asarray(weights) > 0
    names = ("unsolved", "infeasible", "fallback", "violation")
    found = {name: float(np.mean(aux[name][used])) if used.any() else np.nan for name in names}
    return {**found, "excluded": float(np.sum(~used))}


Data = tuple[np.ndarray, dict[str, np.ndarray]]


def split(data: Data, validation: Any) -> tuple[Data, Data]:
    """Initial states and variations for training and for validation."""
    x0s, variations = data
    if not isinstance(validation, tuple) and np.ndim(validation) == 0:
        if not 0 < validation < 1:
            fail("validation", f"{validation}", "Give a share in (0, 1), or initial states")
        count = max(1, round(validation * len(x0s)))
        if count >= len(x0s):
            fail("x0s", f"{len(x0s)} states", "Give at least 2: training and validation")
        cut = len(x0s) - count
        part = lambda where: jax.tree.map(lambda v: v[where], data)
        return part(slice(None, cut)), part(slice(cut, None))
    states, varied = validation if isinstance(validation, tuple) else (validation, {})
    states, varied = np.asarray(states), {k: np.asarray(v) for k, v in dict(varied).items()}
    if states.ndim != 2 or states.shape[1] != x0s.shape[1] or not len(states):
        fail("validation", f"shape {states.shape}", f"Give states (B, {x0s.shape[1]})")
    return data, (states, varied)


@dataclass(frozen=True, eq=False)
class Problem:
    """The closed loops as a function of θ."""

    make_mpc: Any
    parameters: Parameters
    solver: ADMM
    plant: Any
    steps: int
    loss: Any
    reference: Any
    input_reference: Any
    design_loss: Any

    def arguments(self, theta: Any, x0s: Any, varied: Any, weights: Any) -> tuple:
        """Of `total`, as arrays of the present precision."""
        return arrays((theta, self.plant, x0s, varied, weights))

    def total(
        self, theta: Any, plant: Any, x0s: Array, varied: dict[str, Array], weights: Array,
        recompute: bool = False,
    ) -> tuple[Array, dict[str, Array]]:  # fmt: skip
        """Weighted mean loss, and what is counted of each loop."""
        given = values(self.parameters, theta)
        controller = controller_of(self.make_mpc, given, self.solver)
        aims = (self.reference, self.input_reference)
        r, s = (aim(given) if callable(aim) else aim for aim in aims)
        run = simulate_batch(
            controller, plant, r, s, x0s.astype(controller.dtype), varied, self.steps, recompute
        )
        losses = jax.vmap(self.loss)(run)
        total = jnp.sum(jnp.where(weights > 0, weights * losses, 0.0)) / jnp.sum(weights)
        design = jnp.zeros(())
        if self.design_loss is not None:
            design = jnp.asarray(self.design_loss(controller.mpc))
        beyond = jnp.max(run.violation, axis=1)
        if isinstance(self.loss, ClosedLoopLoss) and self.loss.limits is not None:
            beyond = jax.vmap(self.loss.worst)(run)
        share = lambda v: jnp.mean(v.astype(float), axis=1)
        tolerance = 1e-6 if run.states.dtype == jnp.float64 else 1e-3
        aux = {
            "losses": losses, "design": design,
            "unsolved": share(run.status != Status.SOLVED),
            "infeasible": share(run.status == Status.PRIMAL_INFEASIBLE),
            "fallback": share(run.fallback),
            "violation": beyond > tolerance,
        }  # fmt: skip
        return total + design, aux

    def check(self, theta: Any, data: Data) -> None:
        """Raise what tracing raises, before anything compiles."""
        x0s, varied = jax.tree.map(lambda v: v[:1], data)
        total, aux = jax.eval_shape(self.total, *self.arguments(theta, x0s, varied, np.ones(1)))
        if aux["losses"].shape != (1,) or total.shape != ():
            fail("loss", f"has shape {aux['losses'].shape[1:]}", "Return one number")

    def gradient(self, theta: Any, data: Data, mode: str) -> tuple[str, Callable]:
        """(name of the mode, (θ, x0s, varied, weights) → value, gradient, aux)."""
        flat, unravel = ravel_pytree(arrays(theta))

        def forward(theta: Any, *rest: Any) -> tuple[Array, Any, Any]:
            flat = ravel_pytree(theta)[0]
            at = lambda flat: self.total(unravel(flat), *rest)
            one = lambda v: jax.jvp(at, (flat,), (v,), has_aux=True)
            value, slope, aux = jax.vmap(one, out_axes=(None, 0, None))(
                jnp.eye(len(flat), dtype=flat.dtype)
            )
            return value, unravel(slope), aux

        def reverse(theta: Any, *rest: Any, recompute: bool = False) -> tuple[Array, Any, Any]:
            at = partial(self.total, recompute=recompute)
            (value, aux), slope = jax.value_and_grad(at, has_aux=True)(theta, *rest)
            return value, slope, aux

        x0s, varied = data
        arguments = self.arguments(theta, x0s, varied, np.ones(len(x0s)))
        tried: dict[str, Compiled] = {}
        if mode != "reverse" and (mode == "forward" or flat.size <= FORWARD):
            tried["forward"] = Compiled(jax.jit(forward))
        if mode != "forward":
            name, plain = "reverse", Compiled(jax.jit(reverse))
            try:
                if program_bytes(plain.program(*arguments)) > 0.5 * device_bytes():
                    name = "reverse, checkpointed"
                    plain = Compiled(jax.jit(partial(reverse, recompute=True)))
                tried[name] = plain
            except ValueError:  # a plant with a loop that JAX cannot transpose
                if not tried:
                    raise
        name = next(iter(tried))
        if len(tried) > 1:
            name = min(tried, key=lambda name: seconds(tried[name], arguments))
        program = tried[name]
        return name, lambda theta, *rest: program(*self.arguments(theta, *rest))


def seconds(program: Compiled, arguments: tuple) -> float:
    """Time of the second of two calls, compile apart."""
    program(*arguments)
    begun = time.perf_counter()
    program(*arguments)
    return time.perf_counter() - begun
