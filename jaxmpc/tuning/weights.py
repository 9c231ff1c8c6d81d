"""tune_weights: tune parameters of an MPC problem by gradients through its closed loops."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax

from jaxmpc.arrays import Reals, numpy_array
from jaxmpc.batches import chosen_devices
from jaxmpc.checks import fail, generator, nearest, require_shape, whole
from jaxmpc.closed_loop.simulation import Conditions, Run, initial_states, require_variations
from jaxmpc.mpc.problem import MPC, harden
from jaxmpc.qp.admm import ADMM
from jaxmpc.systems.given_model import as_argument
from jaxmpc.tuning.descent import Settings, descend
from jaxmpc.tuning.losses import ClosedLoopLoss, SeveralLosses
from jaxmpc.tuning.objective import (
    LOOP,
    MIX,
    MODES,
    ClosedLoopObjective,
    Data,
    Slope,
    controller_of,
    means,
)
from jaxmpc.tuning.parameters import (
    Parameters,
    exact_values,
    moved,
    raw,
    require_parameters,
)
from jaxmpc.tuning.result import Interrupted, TuningRun, finished

# Where make_mpc returns a problem and no solver is given.
LOOP_SOLVER = ADMM(iterations=50, rho=1.0, alpha=1.6, newton_steps=20)


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
    starts: int | Sequence[Mapping[str, Reals]] = 1,
    **settings: Any,
) -> TuningRun:
    """Minimise the mean loss of closed loops over parameters of their MPC, by gradient or samples.

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
            are at most 32 parameters. "sampling": the slope by 2k + 1 simulations of all loops for
            k numbers, for loops without a derivative: contacts, friction, inputs that are rounded,
            plants outside JAX (`jax.pure_callback`); numbers are moved by about a tenth of a
            weight. "gauss-newton": steps from first derivatives of the loops and second ones of
            the loss, by forward mode, for few parameters and a smooth loss.
        starts: number of starting points, or, beside the given values, name → value of each of the
            others; what is not named starts as given. Of a number the others are random: each θ
            of `Parameter` is moved by a normal number, a weight by a factor of e or so. All take
            the same steps through the same programs; the result is the best on the validation
            loops, and says which it was. Checkpoints of the others: NAME-1.npz, ...
        settings: of `Settings`, as updates=20, batch=64. optimizer None: Adam of 0.05, which
            moves a weight by 5 % a step; with "gauss-newton" its steps themselves. validation:
            given initial states have no variations unless they are a pair of states and
            variations. A checkpoint must be of the same run: parameters and data are compared, and
            the loss at the start is computed again.

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
    chosen = Settings.of("tune_weights", settings)
    loops = prepared(
        make_mpc,
        parameters,
        plant,
        x0s,
        loss,
        steps,
        chosen,
        reference=reference,
        input_reference=input_reference,
        variations=variations,
        conditions=conditions,
        solver=solver,
        design_loss=design_loss,
        mode=mode,
    )
    points = _starting_points(parameters, starts, chosen.seed)
    return loops.run(parameters) if len(points) == 1 else _best_of(loops, points)


def prepared(
    make_mpc: Callable[[Mapping[str, Any]], Any],
    parameters: Parameters,
    plant: Any,
    x0s: Reals,
    loss: Callable[[Run], Any] | None,
    steps: int,
    settings: Settings,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    variations: Mapping[str, Any] | None = None,
    conditions: Mapping[str, Any] | None = None,
    solver: ADMM | None = None,
    design_loss: Callable[[MPC], Any] | None = None,
    mode: str = "auto",
) -> "Loops":
    """Return the closed loops of `tune_weights`, whose arguments these are, without compiling."""
    require_parameters(parameters)
    settings.validate()
    x0s = initial_states(plant, x0s)
    variations = {name: numpy_array(v) for name, v in dict(variations or {}).items()}
    require_variations(plant, variations, len(x0s))
    if mode not in MODES:
        fail("mode", f"{mode!r}", f"Give one of {', '.join(MODES)}")
    steps, conditions = whole("steps", steps, 1), dict(conditions or {})
    require_conditions(conditions)
    if conditions.get("noise") is not None:
        variations[LOOP] = np.arange(len(x0s))
    train, test = settings.split((x0s, variations))
    require_variations(plant, {k: v for k, v in test[1].items() if k != LOOP}, len(test[0]))
    initial = {name: np.asarray(p.value) for name, p in parameters.items()}
    build = partial(controller_of, make_mpc, solver=LOOP_SOLVER if solver is None else solver)
    try:
        controller = build(initial)
    except KeyError as error:
        if error.args[:1] and error.args[0] not in initial:
            cure = f"Add it, or use some of {', '.join(initial)}"
            fail("parameters", f"have no {error.args[0]!r}, which make_mpc asks for", cure)
        raise
    for name, function in (("loss", loss), ("design_loss", design_loss)):
        if function is not None and not callable(function):
            of = "a Run" if name == "loss" else "an MPC"
            fail(name, f"is a {type(function).__name__}", f"Give a function of {of}")
    if loss is None:
        aims = (aim(initial) if callable(aim) else aim for aim in (reference, input_reference))
        loss = _default_loss(controller, plant, *aims)
    given = as_argument(plant), steps, loss, reference, input_reference, design_loss, conditions
    objective = ClosedLoopObjective(build, parameters, *given)
    loops = Loops(objective, settings, train, test, mode, np.dtype(controller.dtype).name)
    if isinstance(loss, SeveralLosses):
        loops.weigh(np.ones(len(loss.functions)))
    objective.check(raw(parameters), loops.train)
    return loops


def _starting_points(
    parameters: Parameters, starts: int | Sequence[Mapping[str, Reals]], seed: int
) -> list[Parameters]:
    """Return the parameters at each starting point, the given one first."""
    if isinstance(starts, Sequence) and not isinstance(starts, str):
        points = [parameters]
        for i, given in enumerate(starts):
            point = dict(parameters)
            for name in given if isinstance(given, Mapping) else [str(given)]:
                if name not in parameters:
                    cure = f"{nearest(str(name), parameters)}Give values of {', '.join(parameters)}"
                    fail("starts", f"holds {name!r}, which is no parameter", cure)
                where, own = f"starts[{i}][{name!r}]", parameters[name]
                require_shape(where, given[name], own.value.shape, "As the parameter's value")
                try:
                    point[name] = replace(own, value=given[name])
                except ValueError as error:
                    raise ValueError(str(error).replace("value", where, 1)) from None
            points.append(point)
        return points
    random, theta = generator(seed), raw(parameters)
    draw = lambda: {name: v + random.normal(size=v.shape) for name, v in theta.items()}
    others = range(whole("starts", starts, 1) - 1)
    return [parameters, *(moved(parameters, exact_values(parameters, draw())) for _ in others)]


def _best_of(loops: "Loops", points: Sequence[Parameters]) -> TuningRun:
    """Return the run of the starting point that comes to the least validation loss, beside what
    the loss is at the first one. Raises Interrupted."""
    runs: dict[int, TuningRun] = {}
    stopped = False
    try:
        for number, parameters in enumerate(points):
            # The given point raises an error where its loss is not finite; another is left out.
            if number == 0 or np.isfinite(loops.validate(raw(parameters))[0]):
                runs[number] = loops.run(parameters, number)
    except KeyboardInterrupt as stop:
        if isinstance(stop, Interrupted):
            runs[number] = stop.run
        if not runs:
            raise
        stopped = True
    first, best = runs[0], min(runs, key=lambda number: runs[number].after["loss"])
    after = [runs[i].after["loss"] if i in runs else np.nan for i in range(len(points))]
    found = replace(
        runs[best],
        initial=first.initial,
        before=first.before,
        improved=best > 0 or first.improved,
        start=best,
        starts=np.array(after),
    )
    if stopped:
        raise Interrupted(found, f"{len(runs)} of {len(points)} starts")
    return found


def require_conditions(conditions: Mapping[str, Any]) -> None:
    """Raise ValueError unless these are names of what a closed loop has beside its references."""
    names = [f.name for f in fields(Conditions) if not f.name.endswith("reference")]
    for name in conditions:
        if name not in names:
            listed = "are arguments of their own" if name.endswith("reference") else "are not known"
            what = f"has {name!r}; such conditions {listed}"
            fail("conditions", what, f"{nearest(name, names)}Give some of {', '.join(names)}")


@dataclass(eq=False)
class Loops:
    """The closed loops of a tuner, those of its steps and those of validation; its programs, which
    all its descents share.

    mode: as given, from the first step on the one that is used; slope: its program. dtype: of the
    numbers. finite: of the validation loops, those that are finite at the first point.
    """

    objective: ClosedLoopObjective
    settings: Settings
    train: Data
    test: Data
    mode: str
    dtype: str
    slope: Slope | None = None
    finite: np.ndarray | None = None

    def __post_init__(self) -> None:
        self.devices = chosen_devices(self.settings.devices)
        self.evaluate = self.objective.evaluation(self.devices)

    def weigh(self, weights: np.ndarray) -> None:
        """Set the weights (L,) of several losses."""
        for x, varied in (self.train, self.test):
            varied[MIX] = np.tile(weights, (len(x), 1))

    def run(self, parameters: Parameters, number: int = 0) -> TuningRun:
        """Return the run that starts with the values of these parameters.

        number: of several runs, by which their checkpoints differ. Raises Interrupted.
        """
        settings, objective = self.settings, self.objective
        if number and settings.checkpoint is not None:
            path = Path(settings.checkpoint)
            settings = replace(settings, checkpoint=path.with_stem(f"{path.stem}-{number}"))
        decides = settings.decides(parameters, self.train, self.test)
        decides |= {"steps": objective.steps, "dtype": self.dtype}
        if self.mode in ("sampling", "gauss-newton"):  # all others follow the gradient
            decides["slope"] = self.mode
        optimizer = optax.sgd(1.0) if self.mode == "gauss-newton" else optax.adam(0.05)
        start = raw(parameters)
        history = descend(start, self.gradient, self.validate, optimizer, settings, decides)
        decides["mode"] = self.mode
        return finished(TuningRun.of_parameters(parameters, history, decides, objective.build))

    def of_step(self, step: int) -> Data:
        """Return the initial states and variations of a step."""
        rows = self.settings.minibatch(len(self.train[0]), step)
        return jax.tree.map(lambda v: v[rows], self.train)

    def gradient(self, theta: Any, step: int) -> tuple[float, Any, dict[str, float]]:
        """Return loss, gradient and numbers of a step; without the loops that are not finite."""
        x, varied = self.of_step(step)
        if self.slope is None:
            chosen = theta, self.of_step(0), self.mode, self.devices
            self.mode, self.slope = self.objective.slope(*chosen)
        weights, seed = np.ones(len(x)), [self.settings.seed, step]
        value, slopes, aux = self.slope(theta, x, varied, weights, seed)
        finite = np.isfinite(value) and all(np.all(np.isfinite(v)) for v in jax.tree.leaves(slopes))
        bad = ~np.isfinite(aux["losses"])
        if not finite and bad.any() and not bad.all():
            weights = np.where(bad, 0.0, 1.0)
            replaced = np.where(bad, np.argmin(bad), np.arange(len(x)))
            x, varied = jax.tree.map(lambda v: v[replaced], (x, varied))
            value, slopes, aux = self.slope(theta, x, varied, weights, seed)
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
