"""ClosedLoopObjective: the loss of closed loops as a function of the parameters, with gradients."""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from jaxmpc.batches import Devices, device_bytes, program_bytes
from jaxmpc.checks import fail
from jaxmpc.closed_loop.simulation import Conditions, Each, simulate_each
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import arrays
from jaxmpc.qp.status import Status
from jaxmpc.sets.violations import TOLERANCE
from jaxmpc.tuning.batch_mean import BatchMean
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameters, values

MODES = ("auto", "forward", "reverse")
# Parameters up to which "auto" tries forward mode, whose cost grows with their number.
FORWARD = 32
# Primitives of linear algebra, of cubic cost.
FACTORING = ("cholesky", "triangular_solve", "lu", "eigh", "qr", "householder_product", "svd")

# Initial states (B, n), and the variations of the plant with B in front.
Data = tuple[np.ndarray, dict[str, np.ndarray]]


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
        aims = (self.reference, self.input_reference)
        r, s = (aim(given) if callable(aim) else aim for aim in aims)
        each = Each(x0s.astype(controller.dtype), varied, {})
        run = simulate_each(
            controller, plant, Conditions(r, s), each, steps=self.steps, checkpoint=checkpoint
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
        total, aux = jax.eval_shape(self.total, *self.arguments(theta, x0s, varied, np.ones(1)))
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
