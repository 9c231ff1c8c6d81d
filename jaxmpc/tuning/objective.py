"""ClosedLoopObjective: the mean loss of closed loops as a function of θ, and where it falls.

By derivatives, forward or in reverse. By samples about θ, which need none: the derivative of the
loss averaged over a ball (Flaxman, Kalai and McMahan 2005, Lemma 1). By Gauss-Newton steps, for
which the loss of a loop is a function of the run that is curved, and the run a function of θ that
is taken as linear (Schraudolph 2002).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.errors import ConcretizationTypeError, TracerArrayConversionError
from jax.flatten_util import ravel_pytree

from jaxmpc.batches import Devices, device_bytes, program_bytes
from jaxmpc.checks import fail
from jaxmpc.closed_loop.simulation import Conditions, Each, Run, simulate_each
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import arrays
from jaxmpc.qp.status import Status
from jaxmpc.sets.limits import rows_kept
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.losses import TERM, ClosedLoopLoss, SeveralLosses
from jaxmpc.tuning.parameters import Parameters, values

MODES = ("auto", "forward", "reverse", "sampling", "gauss-newton")
# Parameters up to which "auto" tries forward mode, whose cost grows with their number.
FORWARD = 32
# By how much samples move each θ, in the root mean square: a tenth of a weight.
WIDTH = 0.1
# Damping of Gauss-Newton steps, in shares of the curvature by each θ.
DAMPING = 10.0 ** np.arange(-5, 4)
# The most by which such a step moves a number θ: a weight by a factor of 7.
LARGEST = 2.0
# Primitives of linear algebra, of cubic cost.
FACTORING = ("cholesky", "triangular_solve", "lu", "eigh", "qr", "householder_product", "svd")

# Name, beside the variations of the plants, of the numbers of the loops, by which noise is drawn.
LOOP = "number of the loop"
# Name there of the weights (L,) of `SeveralLosses`.
MIX = "weights of the losses"

# Initial states (B, n), and the variations of the plant with B in front.
Data = tuple[np.ndarray, dict[str, np.ndarray]]
# (θ, x0s, varied, weights, seed) → loss, what the optimiser follows, numbers of each loop.
Slope = Callable[[Any, Any, Any, Any, Any], tuple[Any, Any, dict[str, np.ndarray]]]


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

    def loops(
        self,
        theta: Any,
        plant: Any,
        x0s: Array,
        varied: dict[str, Array],
        checkpoint: bool = False,
    ) -> tuple[Run, Array, Array]:
        """Return the loops (B, …), whether each breaks a limit of the states, (B,), and the design
        loss."""
        given = values(self.parameters, theta)
        controller = self.build(given)
        shared = {"reference": self.reference, "input_reference": self.input_reference}
        shared |= self.conditions
        shared = {name: v(given) if callable(v) else v for name, v in shared.items()}
        numbers: Any = None
        if shared.get("noise") is not None:
            numbers = varied.get(LOOP, np.arange(len(x0s)))
        varied = {name: v for name, v in varied.items() if name not in (LOOP, MIX)}
        each = Each(x0s.astype(controller.dtype), varied, {}, numbers)
        run = simulate_each(
            controller, plant, Conditions(**shared), each, steps=self.steps, checkpoint=checkpoint
        )
        design = jnp.zeros(())
        if self.design_loss is not None:
            design = jnp.asarray(self.design_loss(controller.mpc))
        if isinstance(self.loss, ClosedLoopLoss) and self.loss.limits is not None:
            broken = ~jax.vmap(self.loss.kept)(run)
        else:
            x = jax.vmap(jax.vmap(controller.coordinates))(run.states)
            limits = jax.tree.map(lambda v: jnp.asarray(v, x.dtype), controller.limits)
            broken = ~jnp.all(rows_kept(limits, x), axis=(1, 2))
        return run, broken, design

    def losses(self, run: Run, varied: dict[str, Array]) -> tuple[Array, dict[str, Array]]:
        """Return the loss of each of the loops (B, …), and of several losses each."""
        if not isinstance(self.loss, SeveralLosses):
            return jax.vmap(partial(_number, self.loss))(run), {}
        found = jax.vmap(self.loss)(run)
        terms = {f"{TERM}{name}": found[:, i] for i, name in enumerate(self.loss.functions)}
        return jnp.sum(varied[MIX] * found, axis=1), terms

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
        run, broken, design = self.loops(theta, plant, x0s, varied, checkpoint)
        losses, terms = self.losses(run, varied)
        return mean(losses, weights) + design, self.numbers(run, broken, losses, design) | terms

    def numbers(self, run: Run, broken: Array, losses: Array, design: Array) -> dict[str, Array]:
        """Return the recorded numbers of each loop, and the design loss."""
        fraction = lambda v: jnp.mean(v.astype(float), axis=1)
        return {
            "losses": losses,
            "design": design,
            "unsolved": fraction(run.status != Status.SOLVED),
            "infeasible": fraction(run.status == Status.PRIMAL_INFEASIBLE),
            "fallback": fraction(run.fallback & (run.status == Status.SOLVED)),
            "violation": broken,
        }

    def check(self, theta: Any, data: Data) -> None:
        """Trace the loss without compiling; raise its errors, and ValueError for a wrong shape."""
        x0s, varied = jax.tree.map(lambda v: v[:1], data)
        try:
            total, _ = jax.eval_shape(self.total, *self.arguments(theta, x0s, varied, np.ones(1)))
        except (ConcretizationTypeError, TracerArrayConversionError) as error:
            first = str(error).splitlines()[0]
            cure = "Write them with jax.numpy, without float(), NumPy and if of arrays"
            fail("loss, make_mpc", f"cannot be traced by JAX ({first})", cure)
        if total.shape != ():  # that of a loss is checked by `_number`
            fail("design_loss", f"has shape {total.shape}", "Return one number")

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

    def slope(
        self, theta: Any, data: Data, mode: str, devices: Devices = None
    ) -> tuple[str, Slope]:
        """Return the mode that is used, and what the optimiser follows: the gradient, or, with
        mode "gauss-newton", minus a step."""
        if mode == "sampling":
            return mode, self.sampling(devices)
        if mode == "gauss-newton":
            return mode, self.gauss_newton(theta, devices)
        mode, gradient = self.gradient(theta, data, mode, devices)
        return mode, lambda theta, x0s, varied, weights, seed: gradient(theta, x0s, varied, weights)

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

    def several(self, devices: Devices) -> Callable:
        """Return (P θs, x0s, varied, weights) → the losses (P,), numbers of each loop at the first
        θ, with the loss NaN where it is not finite at any of them."""

        def losses(thetas: Any, *rest: Any) -> tuple[Array, dict[str, Array]]:
            totals, aux = jax.vmap(lambda theta: self.total(theta, *rest))(thetas)
            first = jax.tree.map(lambda v: v[0], aux)
            finite = jnp.all(jnp.isfinite(aux["losses"]), axis=0)
            return totals, {**first, "losses": jnp.where(finite, first["losses"], jnp.nan)}

        program = self.over(losses, devices)

        def evaluate(*args: Any) -> tuple[np.ndarray, dict[str, np.ndarray]]:
            (totals, _), each = program(*self.arguments(*args))
            return np.asarray(totals, np.float64), each

        return evaluate

    def sampling(self, devices: Devices) -> Slope:
        """Return the slope from samples: central differences along k random orthogonal directions,
        for k numbers θ.

        Its expectation is the gradient of the loss averaged over a ball about θ, of the radius of
        these steps; of a quadratic loss it is the gradient.
        """
        evaluate = self.several(devices)

        def slope(theta: Any, x0s: Any, varied: Any, weights: Any, seed: Any) -> Any:
            flat, unravel = flattened(theta)
            k = len(flat)
            random = np.random.default_rng(seed).normal(size=(k, k))
            steps = WIDTH * np.sqrt(k) * np.linalg.qr(random)[0].T
            thetas = unravel(flat + np.concatenate([np.zeros((1, k)), steps, -steps]))
            totals, aux = evaluate(thetas, x0s, varied, weights)
            changes = totals[1 : k + 1] - totals[k + 1 :]
            return totals[0], unravel(changes @ steps / (2 * k * WIDTH**2)), aux

        return slope

    def gauss_newton(self, theta: Any, devices: Devices) -> Slope:
        """Return minus the best of several damped Gauss-Newton steps (Levenberg and Marquardt).

        With H the second derivatives of the mean loss by the states and inputs of the loops, and J
        their derivatives by θ, these are `damped_steps` of C = J'HJ; the one with the least loss is
        taken, none where no step lessens it.
        """
        unravel = ravel_pytree(arrays(theta))[1]

        def curved(theta: Any, *rest: Any) -> tuple[Array, Any, dict[str, Array]]:
            flat, (*_, varied, weights) = ravel_pytree(theta)[0], rest

            def at(flat: Array) -> tuple[Any, Any]:
                run, broken, design = self.loops(unravel(flat), *rest[:-1])
                losses, terms = self.losses(run, varied)
                total = mean(losses, weights) + design
                numbers = self.numbers(run, broken, losses, design) | terms
                return (total, run.states, run.inputs), (run, numbers)

            one = lambda v: jax.jvp(at, (flat,), (v,), has_aux=True)
            (value, *path), (gradient, *moves), (run, numbers) = jax.vmap(
                one, out_axes=(None, 0, None)
            )(jnp.eye(len(flat), dtype=flat.dtype))

            def loss(path: Any) -> Array:
                moved = replace(run, states=path[0], inputs=path[1])
                return mean(self.losses(moved, varied)[0], weights)

            bend = lambda move: jax.jvp(jax.grad(loss), (path,), (move,))[1]
            both = zip(moves, jax.vmap(bend)(moves), strict=True)
            product = partial(jnp.einsum, "i...,j...->ij", precision="highest")
            curvature = sum(product(move, bent) for move, bent in both)
            return value, (gradient, curvature), numbers

        program = self.over(curved, devices)
        evaluate = self.several(devices)

        def slope(theta: Any, x0s: Any, varied: Any, weights: Any, seed: Any) -> Any:
            arguments = self.arguments(theta, x0s, varied, weights)
            (value, (gradient, curvature), _), aux = program(*arguments)
            flat, back = flattened(theta)
            if not np.all(np.isfinite(curvature)):
                return value, back(np.full(len(flat), np.nan)), aux
            steps = damped_steps(np.asarray(gradient, float), np.asarray(curvature, float))
            totals, _ = evaluate(back(flat + steps), x0s, varied, weights)
            totals = np.where(np.isfinite(totals), totals, np.inf)
            best = np.argmin(totals)
            return value, back(-steps[best] * (totals[best] < value)), aux

        return slope


def mean(losses: Array, weights: Array) -> Array:
    """Return the mean of losses (B,) with weights; one of weight zero may be anything."""
    return jnp.sum(jnp.where(weights > 0, weights * losses, 0.0)) / jnp.sum(weights)


def flattened(theta: Any) -> tuple[np.ndarray, Callable]:
    """Return θ as a vector (k,), and the map from vectors (…, k) back to the pytree."""
    leaves, tree = jax.tree.flatten(theta)
    ends = np.cumsum([len(leaf) for leaf in leaves])[:-1]
    flat = np.concatenate([np.asarray(leaf, np.float64) for leaf in leaves])
    return flat, lambda v: jax.tree.unflatten(tree, np.split(v, ends, axis=-1))


def damped_steps(gradient: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Return −(|C| + μ s I)⁻¹ gradient for each damping μ, (P, k), shortened where it moves a
    number by more than LARGEST.

    |C| has the absolute eigenvalues of the curvature, s is their mean (where it is zero, the size
    of the gradient).
    """
    sizes, vectors = np.linalg.eigh((curvature + curvature.T) / 2)
    sizes = np.abs(sizes)
    scale = np.mean(sizes) or np.linalg.norm(gradient) or 1.0
    steps = -(vectors.T @ gradient / (sizes + DAMPING[:, None] * scale)) @ vectors.T
    return steps / np.maximum(1.0, np.abs(steps).max(axis=1, keepdims=True) / LARGEST)


def cheapest(programs: dict[str, BatchMean], arguments: tuple) -> str:
    """Return the name of the program with the fewest operations, without compiling.

    Programs that JAX cannot trace, in reverse mode those of a plant with a loop, do not count.
    Raises ValueError where none is left.
    """
    counts, reason = {}, ""
    for name, program in programs.items():
        try:
            counts[name] = operations(program.traced(*arguments))
        except ValueError as error:
            reason = str(error).splitlines()[0]
    if not counts:
        cure = 'Give mode="sampling", which needs no derivative'
        fail("mode", f"{', '.join(programs)}: the loops have no such derivative ({reason})", cure)
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
    if not callable(make_mpc):
        cure = "Give a function of the values, such as lambda v: dataclasses.replace(mpc, Q=v['Q'])"
        fail("make_mpc", f"is a {type(make_mpc).__name__}", cure)
    made = make_mpc(given)
    if isinstance(made, MPC):
        return Controller(made, solver)
    if not (callable(made) and hasattr(made, "mpc") and hasattr(made, "start")):
        fail("make_mpc", f"returns a {type(made).__name__}", "Return a jm.MPC or a controller")
    return made


def means(aux: dict[str, np.ndarray], weights: np.ndarray) -> dict[str, float]:
    """Return the means over the loops that have a weight, as `tune_weights` documents them."""
    used = np.asarray(weights) > 0
    terms = [name for name in aux if name.startswith(TERM)]
    names = ("unsolved", "infeasible", "fallback", "violation", *terms)
    found = {name: float(np.mean(aux[name][used])) if used.any() else np.nan for name in names}
    return {**found, "excluded": float(np.sum(~used))}


def _number(loss: Callable[[Run], Any], run: Run) -> Array:
    """Return the loss of one run; raise ValueError where it is not one number."""
    found = loss(run)
    if found is None or np.shape(found) != ():
        what = "None" if found is None else f"shape {np.shape(found)}"
        fail("loss", f"returns {what}", "Return one number of a Run; jm.SeveralLosses has several")
    return jnp.asarray(found)
