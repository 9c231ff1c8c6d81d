"""tune_weights: tune parameters of an MPC problem by gradients through its closed loops."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jax.flatten_util import ravel_pytree

from jaxmpc.arrays import Reals
from jaxmpc.batches import Devices, chosen_devices, device_bytes, program_bytes
from jaxmpc.checks import fail, nearest, whole
from jaxmpc.closed_loop.simulation import Conditions, Each, Run, require_variations, simulate_each
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC, harden
from jaxmpc.mpc.stagewise.nonlinear import as_argument
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import arrays
from jaxmpc.qp.status import Status
from jaxmpc.sets.limits import TOLERANCE
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.descent import Settings, descend
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameters, raw, require_parameters, values
from jaxmpc.tuning.result import TuningRun, finished

# Where make_mpc returns a problem and no solver is given.
SOLVER = ADMM(iterations=50, rho=1.0, alpha=1.6, newton_steps=20)
MODES = ("auto", "forward", "reverse")
# Parameters up to which "auto" tries forward mode, whose cost grows with their number.
FORWARD = 32
# Primitives of linear algebra, of cubic cost.
FACTORING = ("cholesky", "triangular_solve", "lu", "eigh", "qr", "householder_product", "svd")

# Name, beside the variations of the plants, of the numbers of the loops, by which noise is drawn.
LOOP = "number of the loop"

# Initial states (B, n), and the variations of the plant with B in front.
Data = tuple[np.ndarray, dict[str, np.ndarray]]


def tune_weights(
    make_mpc: Callable[[Mapping[str, Any]], Any],
    parameters: Parameters,
    plant: Any,
    x0s: Reals,
    loss: Callable[[Run], Any] | None = None,
    steps: int = 50,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    variations: Mapping[str, Any] | None = None,
    conditions: Mapping[str, Any] | None = None,
    solver: ADMM | None = None,
    design_loss: Callable[[MPC], Any] | None = None,
    mode: str = "auto",
    **settings: Any,
) -> TuningRun:
    """Minimise the mean loss of closed loops over parameters of their MPC, by gradient.

        min_θ  mean_i loss(run_i(θ)) + design_loss(mpc(θ)),   run_i from x0s[i], T = steps samples

    The derivative goes through plant, solver (`ADMM.differentiate`) and all samples. It is finite
    even where single plans fail: an infeasible QP has the derivative of the closest feasible one,
    and a robot's MPC is soft; the history counts both.

    Arguments:
        make_mpc: name → value of all parameters to an MPC (then driven by `Controller` with
            `solver`) or to a controller, such as RobotController. It is traced: compute what is
            not traceable (`robot_mpc`) outside, and put values in by `dataclasses.replace`. Any
            field of MPC can depend on them, and `jm.lqr` is differentiable inside.
        parameters: name → `Parameter`.
        plant: as in `simulate`. x0s (B, n): initial states. variations: as in `simulate_many`,
            each (B, …): parameters of the plant that the controller does not know.
        loss: of one run. None: `ClosedLoopLoss` with Q, R and state limits of the problem at the
            start. Do not use `run.stage_cost`: its weights are the Q and R that are tuned.
        reference, input_reference: as in `simulate`, or functions of the values.
        conditions: what else the loops have, by the names of `simulate`: disturbance,
            output_disturbance, forecast, previous_input, noise, observer, delay, compensate. Each
            as it takes it, or a function of the values: so observers are tuned.
        solver: None for 50 ADMM steps and at most 20 Newton steps.
        design_loss: of the problem alone, such as the `feasible_fraction` of sample states.
        mode: "forward" (cost grows with the number of parameters, memory does not), "reverse"
            (memory grows with the number of samples; they are computed twice if it does not
            suffice), "auto": the one with fewer operations, counted without compiling, where there
            are at most 32 parameters.
        settings: of `Settings`, as updates=20, batch=64. optimizer None: Adam of 0.05, which
            moves a weight by 5 % a step. validation: given initial states have no variations
            unless they are a pair of states and variations. A checkpoint must be of the same run:
            parameters and data are compared, and the loss at the start is computed again.

    Returns a `TuningRun` whose result is the controller. The numbers of its history are means over
    the loops of a step, those of validation over the validation loops:

        unsolved    fraction of plans that are not SOLVED, infeasible ones and others
        infeasible  fraction of plans proved infeasible
        fallback    fraction of plans that were solved and violate soft rows
        violation   fraction of loops that leave the limits of a ClosedLoopLoss (of another loss:
                    the controller's own) by more than `violation.TOLERANCE`
        excluded    loops left out because their loss was not finite

    Raises ValueError for what does not fit together, before any compile, and on Ctrl-C
    `Interrupted`, a KeyboardInterrupt that holds the `TuningRun` of the finished steps.
    """
    require_parameters(parameters)
    chosen = Settings(**settings)
    chosen.validate()
    x0s = np.asarray(x0s)
    if x0s.ndim != 2 or not len(x0s):
        fail("x0s", f"shape {x0s.shape}", "Give initial states (B, n)")
    variations = {name: np.asarray(v) for name, v in dict(variations or {}).items()}
    require_variations(plant, variations, len(x0s))
    if mode not in MODES:
        fail("mode", f"{mode!r}", f"Give one of {', '.join(MODES)}")
    steps, conditions = whole("steps", steps, 1), dict(conditions or {})
    require_conditions(conditions)
    if conditions.get("noise") is not None:
        variations[LOOP] = np.arange(len(x0s))
    train, test = chosen.split((x0s, variations))
    require_variations(plant, {k: v for k, v in test[1].items() if k != LOOP}, len(test[0]))
    start = raw(parameters)
    initial = {name: np.asarray(p.value) for name, p in parameters.items()}
    build = partial(controller_of, make_mpc, solver=SOLVER if solver is None else solver)
    try:
        controller = build(initial)
    except KeyError as error:
        if error.args[:1] and error.args[0] not in initial:
            cure = f"Add it, or use some of {', '.join(initial)}"
            fail("parameters", f"have no {error.args[0]!r}, which make_mpc asks for", cure)
        raise
    if loss is None:
        aims = (aim(initial) if callable(aim) else aim for aim in (reference, input_reference))
        loss = _default_loss(controller, plant, *aims)
    given = as_argument(plant), steps, loss, reference, input_reference, design_loss, conditions
    objective = ClosedLoopObjective(build, parameters, *given)
    objective.check(start, train)
    decides = chosen.decides(parameters, train, test)
    decides |= {"steps": steps, "dtype": np.dtype(controller.dtype).name}
    loops = _Loops(objective, chosen, start, train, test, mode)
    history = descend(start, loops.gradient, loops.validate, optax.adam(0.05), chosen, decides)
    decides["mode"] = loops.mode
    return finished(TuningRun.of_parameters(parameters, history, decides, build))


def require_conditions(conditions: Mapping[str, Any]) -> None:
    """Raise ValueError unless these are names of what a closed loop has beside its references."""
    names = [f.name for f in fields(Conditions) if not f.name.endswith("reference")]
    for name in conditions:
        if name not in names:
            listed = "are arguments of their own" if name.endswith("reference") else "are not known"
            what = f"has {name!r}; such conditions {listed}"
            fail("conditions", what, f"{nearest(name, names)}Give some of {', '.join(names)}")


@dataclass(eq=False)
class _Loops:
    """The closed loops of a descent from `start`, those of its steps and those of validation.

    mode: as given, from the first step on the one that is used; slope: its program. finite: of the
    validation loops, those that are finite at the start.
    """

    objective: "ClosedLoopObjective"
    settings: Settings
    start: dict[str, np.ndarray]
    train: Data
    test: Data
    mode: str
    slope: Callable | None = None
    finite: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.devices = chosen_devices(self.settings.devices)
        self.evaluate = self.objective.evaluation(self.devices)

    def of_step(self, step: int) -> Data:
        """Return the initial states and variations of a step."""
        rows = self.settings.minibatch(len(self.train[0]), step)
        return jax.tree.map(lambda v: v[rows], self.train)

    def gradient(self, theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        """Return loss, gradient and numbers of a step; without the loops that are not finite."""
        x, varied = self.of_step(step)
        if self.slope is None:
            chosen = self.start, self.of_step(0), self.mode, self.devices
            self.mode, self.slope = self.objective.gradient(*chosen)
        weights = np.ones(len(x))
        value, slopes, aux = self.slope(theta, x, varied, weights)
        finite = np.isfinite(value) and all(np.all(np.isfinite(v)) for v in jax.tree.leaves(slopes))
        bad = ~np.isfinite(aux["losses"])
        if not finite and bad.any() and not bad.all():
            weights = np.where(bad, 0.0, 1.0)
            replaced = np.where(bad, np.argmin(bad), np.arange(len(x)))
            x, varied = jax.tree.map(lambda v: v[replaced], (x, varied))
            value, slopes, aux = self.slope(theta, x, varied, weights)
        return value, slopes, means(aux, weights)

    def validate(self, theta: Any) -> tuple[float, dict[str, float]]:
        """Return loss and numbers of the validation loops. Those that are not finite at the start
        are left out for good; another one makes the loss NaN."""
        x, varied = self.test
        design, aux = self.evaluate(theta, x, varied, np.ones(len(x)))
        if self.finite is None:
            self.finite = np.isfinite(aux["losses"])
        used = aux["losses"][self.finite]
        value = np.mean(used) + design if len(used) else np.nan
        return float(value), means(aux, self.finite)


def _default_loss(controller: Any, plant: Any, r: Any, s: Any) -> ClosedLoopLoss:
    """Return the loss with the weights and state limits of a controller's problem."""
    mpc, limits = controller.mpc, controller.limits
    mpc.require_constant("no loss follows from it: give a loss", "Q", "R")
    if limits is None and mpc.soft:
        limits = harden(mpc).states
    plant = plant if hasattr(plant, "coordinates") else None
    return ClosedLoopLoss(np.asarray(mpc.Q), np.asarray(mpc.R), r, s, limits, plant=plant)


@record
class ClosedLoopObjective:
    """The mean loss of closed loops as a function of θ.

    build: values → controller. plant: from `as_argument`. steps: time steps of a loop. The rest as
    in `tune_weights`.
    """

    build: Callable[[Mapping[str, Any]], Any]
    parameters: Parameters
    plant: Any
    steps: int
    loss: Any
    reference: Any
    input_reference: Any
    design_loss: Any
    conditions: Mapping[str, Any] = field(default_factory=dict)

    def arguments(self, theta: Any, x0s: Any, varied: Any, weights: Any) -> tuple:
        """Return the arguments of `total` as arrays of JAX's current precision."""
        return arrays((theta, self.plant, x0s, varied, weights))

    def total(
        self,
        theta: Any,
        plant: Any,
        x0s: Array,
        varied: dict[str, Array],
        weights: Array,
        checkpoint: bool = False,
    ) -> tuple[Array, dict[str, Array]]:
        """Return the weighted mean loss, and the recorded numbers of each loop."""
        given = values(self.parameters, theta)
        controller = self.build(given)
        shared = {"reference": self.reference, "input_reference": self.input_reference}
        shared |= self.conditions
        shared = {name: v(given) if callable(v) else v for name, v in shared.items()}
        numbers: Any = None
        if shared.get("noise") is not None:
            numbers = varied.get(LOOP, np.arange(len(x0s)))
        varied = {name: v for name, v in varied.items() if name != LOOP}
        each = Each(x0s.astype(controller.dtype), varied, {}, numbers)
        run = simulate_each(
            controller, plant, Conditions(**shared), each, steps=self.steps, checkpoint=checkpoint
        )
        losses = jax.vmap(self.loss)(run)
        total = jnp.sum(jnp.where(weights > 0, weights * losses, 0.0)) / jnp.sum(weights)
        design = jnp.zeros(())
        if self.design_loss is not None:
            design = jnp.asarray(self.design_loss(controller.mpc))
        worst = jnp.max(run.violation, axis=1)
        if isinstance(self.loss, ClosedLoopLoss) and self.loss.limits is not None:
            worst = jax.vmap(self.loss.worst)(run)
        fraction = lambda v: jnp.mean(v.astype(float), axis=1)
        aux = {
            "losses": losses,
            "design": design,
            "unsolved": fraction(run.status != Status.SOLVED),
            "infeasible": fraction(run.status == Status.PRIMAL_INFEASIBLE),
            "fallback": fraction(run.fallback & (run.status == Status.SOLVED)),
            "violation": worst > TOLERANCE[run.states.dtype.name],
        }
        return total + design, aux

    def check(self, theta: Any, data: Data) -> None:
        """Trace the loss without compiling; raise its errors, and ValueError for a wrong shape."""
        x0s, varied = jax.tree.map(lambda v: v[:1], data)
        try:
            total, aux = jax.eval_shape(self.total, *self.arguments(theta, x0s, varied, np.ones(1)))
        except (ConcretizationTypeError, TracerArrayConversionError) as error:
            first = str(error).splitlines()[0]
            cure = "Write them with jax.numpy, without float(), NumPy and if of arrays"
            fail("loss, make_mpc", f"cannot be traced by JAX ({first})", cure)
        if aux["losses"].shape != (1,) or total.shape != ():
            fail("loss", f"has shape {aux['losses'].shape[1:]}", "Return one number")

    def over(self, function: Callable, devices: Devices) -> BatchMean:
        """Return the program of a function with the arguments of `total` and the results of it, or
        value, gradient, and its numbers."""

        def parted(*args: Any) -> tuple[Any, dict[str, Array]]:
            *means, each = function(*args)
            return (*means, each.pop("design")), each

        return BatchMean(parted, devices, (False, False, True, True))

    def evaluation(self, devices: Devices) -> Callable:
        """Return (θ, x0s, varied, weights) → the design loss, and the numbers of each loop."""
        program = self.over(self.total, devices)

        def evaluate(*args: Any) -> tuple[float, dict[str, np.ndarray]]:
            (_, design), each = program(*self.arguments(*args))
            return design, each

        return evaluate

    def gradient(
        self, theta: Any, data: Data, mode: str, devices: Devices = None
    ) -> tuple[str, Callable]:
        """Return the mode, and (θ, x0s, varied, weights) → value, gradient, numbers of each loop.

        With mode "auto" both are traced, and the one with fewer `operations` is compiled.
        """
        flat, unravel = ravel_pytree(arrays(theta))

        def forward(theta: Any, *rest: Any) -> tuple[Array, Any, Any]:
            flat = ravel_pytree(theta)[0]
            at = lambda flat: self.total(unravel(flat), *rest)
            one = lambda v: jax.jvp(at, (flat,), (v,), has_aux=True)
            value, slope, aux = jax.vmap(one, out_axes=(None, 0, None))(
                jnp.eye(len(flat), dtype=flat.dtype)
            )
            return value, unravel(slope), aux

        def reverse(theta: Any, *rest: Any, checkpoint: bool = False) -> tuple[Array, Any, Any]:
            at = partial(self.total, checkpoint=checkpoint)
            (value, aux), slope = jax.value_and_grad(at, has_aux=True)(theta, *rest)
            return value, slope, aux

        x0s, varied = data
        arguments = self.arguments(theta, x0s, varied, np.ones(len(x0s)))
        tried: dict[str, BatchMean] = {}
        if mode != "reverse" and (mode == "forward" or flat.size <= FORWARD):
            tried["forward"] = self.over(forward, devices)
        if mode != "forward":
            tried["reverse"] = self.over(reverse, devices)
        name = cheapest(tried, arguments)
        short = 0.5 * device_bytes()
        if name == "reverse" and program_bytes(tried[name].program(*arguments)) > short:
            del tried[name]
            tried["reverse, checkpointed"] = self.over(partial(reverse, checkpoint=True), devices)
            name = cheapest(tried, arguments)
        program = tried[name]

        def slope(*args: Any) -> tuple[Any, Any, dict[str, np.ndarray]]:
            (value, slopes, _), each = program(*self.arguments(*args))
            return value, slopes, each

        return name, slope


def cheapest(programs: dict[str, BatchMean], arguments: tuple) -> str:
    """Return the name of the program with the fewest operations, without compiling; one that JAX
    cannot transpose, a plant with a loop, counts as the last choice."""
    if len(programs) == 1:
        return next(iter(programs))
    counts = {}
    for name, program in programs.items():
        try:
            counts[name] = operations(program.traced(*arguments))
        except ValueError:
            counts[name] = np.inf
    return min(counts, key=lambda name: counts[name])


def operations(jaxpr: Any) -> float:
    """Return about how many operations a jaxpr takes: those of products and factorizations, and
    one an entry of every other result. A loop of unknown length counts as one pass."""
    jaxpr, total = getattr(jaxpr, "jaxpr", jaxpr), 0.0
    for equation in jaxpr.eqns:
        name, given = equation.primitive.name, equation.params
        inner = [
            operations(part)
            for value in given.values()
            for part in (value if isinstance(value, tuple | list) else (value,))
            if hasattr(part, "eqns") or hasattr(part, "jaxpr")
        ]
        entries = sum(math.prod(v.aval.shape) for v in equation.outvars)
        if inner:
            passes = given["length"] if name == "scan" else 1
            total += passes * (max(inner) if name == "cond" else sum(inner))
        elif name == "dot_general":
            (contracted, _), _ = given["dimension_numbers"]
            shape = equation.invars[0].aval.shape
            total += 2 * entries * math.prod(shape[axis] for axis in contracted)
        elif name in FACTORING:  # n operations an entry, up to a factor
            total += entries * equation.invars[0].aval.shape[-1]
        else:
            total += entries
    return total


def controller_of(make_mpc: Any, given: Mapping[str, Any], solver: ADMM) -> Any:
    """Return the controller at these values: that of make_mpc, or a Controller of its problem."""
    made = make_mpc(given)
    if isinstance(made, MPC):
        return Controller(made, solver)
    if not (callable(made) and hasattr(made, "mpc") and hasattr(made, "start")):
        fail("make_mpc", f"returns a {type(made).__name__}", "Return a jm.MPC or a controller")
    return made


def means(aux: dict[str, np.ndarray], weights: np.ndarray) -> dict[str, float]:
    """Return the means over the loops that have a weight, as `tune_weights` documents them."""
    used = np.asarray(weights) > 0
    names = ("unsolved", "infeasible", "fallback", "violation")
    found = {name: float(np.mean(aux[name][used])) if used.any() else np.nan for name in names}
    return {**found, "excluded": float(np.sum(~used))}
