"""Controller: an MPC law whose matrices are condensed and factored once."""

from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import concrete, fail, require_kind
from jaxmpc.mpc.condense import Condensed, condense
from jaxmpc.mpc.plan import (
    Control,
    Multipliers,
    Plan,
    Planned,
    WarmStart,
    answer,
    applied,
    limited,
    sorted_multipliers,
)
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.stated_residuals import judged
from jaxmpc.pytrees import prepared_pytree
from jaxmpc.qp.admm import ADMM, DEFAULT, Factor
from jaxmpc.qp.admm import factor as factorise
from jaxmpc.qp.dual_search import has_dual_steps
from jaxmpc.qp.modes import own_modes, varying
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.qp.solve import in_two_parts, solve_factored
from jaxmpc.qp.status import Status
from jaxmpc.sets.box import Box
from jaxmpc.sets.polytope import Polytope


@prepared_pytree
class Controller:
    """An MPC law whose matrices are condensed and factored once, at construction.

    `controller(x, before) -> Control`: its u (m,) is the first input of its plan, clipped into the
    limits if these are a Box. before: what the controller gave at the time step before, None at the
    start. The plan then, `shifted`, is the warm start, and the input then the previous input (zero
    at the start). When the plan is not SOLVED, u is still the first input of the best iterate: look
    at plan.solved. Of a state that is not finite the plan is NaN, u is finite: the last input where
    its rate is limited or weighed, else zero, within the limits; and what is remembered is the last
    finite plan. A plan is a warm start only where that is nearer to the solution than none: one bad
    reading, finite or not, is forgotten with the next time step.

    `condensed` and `factor` are filled in at construction, which `dataclasses.replace` repeats and
    JAX, which rebuilds pytrees, does not. Each array has a buffer of its own: a controller may be
    donated.
    """

    mpc: MPC
    solver: ADMM = DEFAULT
    condensed: Condensed = field(init=False)
    factor: Factor = field(init=False)

    def __post_init__(self) -> None:
        require_kind("mpc", self.mpc, MPC)
        self.mpc.validate()
        require_kind("solver", self.solver, ADMM)
        self.solver.validate()
        mpc, finite = harmless(self.mpc)
        condensed = condense(mpc)
        # The factorization reads from P what is wrong with the data.
        condensed = replace(condensed, P=jnp.where(finite, condensed.P, jnp.nan))
        self.solver.validate(condensed.C.shape[0])
        # Arrays from here on, so that a sample need not convert the whole object again.
        given = arrays((replace(mpc, prestabilise=condensed.K), self.solver))
        made = condensed, _factor(condensed, self.solver)
        parts = unshared((*given, *made))
        vars(self).update(zip(("mpc", "solver", "condensed", "factor"), parts, strict=True))

    def __repr__(self) -> str:
        """Return the size of the problem, in one line: the arrays may be long."""
        P = self.condensed.P
        rows = sum(len(steps) * size for _, steps, size in self.condensed.layout)
        sizes = f"horizon {self.mpc.horizon}, {rows} rows, Hessian {np.shape(P)}"
        return f"Controller({sizes}, {getattr(P, 'dtype', type(P).__name__)})"

    @property
    def dtype(self) -> Any:
        """Floating type of the plans."""
        return self.condensed.P.dtype

    @property
    def state_size(self) -> int:
        """Length n of the state."""
        return self.mpc.system.n

    @property
    def limits(self) -> Box | Polytope | None:
        """The set by which violations of a closed loop are measured."""
        return self.mpc.states

    def coordinates(self, x: Array) -> Array:
        """The state in which `mpc` is written: x itself."""
        return x

    def start(self, x: Array, input_reference: Reals | None = None) -> Control[Plan]:
        """What stands for the time step before the first: zeros, a cold start.

        (So that a scan compiles one solve, not two: without a warm start and with.)"""
        return zeros_of(self, x)

    def __call__(
        self,
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
    ) -> Control[Plan]:
        """The input at the state x (n,), the plan that it belongs to, and what to remember.

        before: None, or what was returned at the time step before. References and previous_input as
        in `solve`; previous_input None: the input of `before`.
        """
        given = self._checked(x, reference, input_reference, previous_input)
        last = None if before is None else (before.u, before.memory)
        return self._in_two_parts(_control, *given, last, status=lambda found: found.plan.status)

    def shifted(self, plan: Plan | WarmStart) -> WarmStart:
        """The plan seen one time step later, as a warm start (`WarmStart.shifted`).

        The new last input is the unconstrained optimum of that step for the terminal cost about
        the origin, clipped into its limits. With a control horizon each free input becomes what the
        plan did one step after its beginning.
        """
        c, system = self.condensed, self.mpc.system
        start = WarmStart.of(plan, c.layout, self.mpc.horizon, system.n, system.m)
        tail = limited(self.mpc.inputs, matmul(c.K_N, start.states[-1]))
        return start.shifted(c.layout, tail, bool(c.balls))

    def plan(
        self, x0: Any, reference: Any = None, warm_start: Any = None, input_reference: Any = None,
        previous_input: Any = None,
    ) -> Plan:  # fmt: skip
        """Plan from x0 (n,); arguments as in `solve`."""
        given = self._checked(x0, reference, input_reference, previous_input)
        if warm_start is not None:
            c, mpc = self.condensed, self.mpc
            start = WarmStart.of(warm_start, c.layout, mpc.horizon, mpc.system.n, mpc.system.m)
            warm_start = arrays(start)
        return self._in_two_parts(_plan, *given, warm_start)

    def _in_two_parts(self, program: Callable[..., Any], *given: Any, **kwargs: Any) -> Any:
        c = self.condensed
        hard = not has_dual_steps(c.balls, c.C)
        return in_two_parts(program, hard, self.solver, self, *given, **kwargs)

    def _checked(
        self, x0: Any, reference: Any, input_reference: Any, previous_input: Any
    ) -> list[Any]:
        """The arguments in the controller's precision; ValueError for wrong ones."""
        if self.dtype == jnp.float64 and jnp.result_type(float) != jnp.float64:
            cure = "Call it under jax.enable_x64(True), or make it outside"
            fail("controller", "was made in float64, and 64-bit mode is off", cure)
        given = plan_arguments(self.mpc, x0, reference, input_reference, previous_input)
        return [v.astype(self.dtype) if isinstance(v, np.ndarray) else v for v in given]

    def multipliers(self, y: Array) -> Multipliers:
        """Sort the QP's multipliers y (rows,) by constraint and step."""
        c = self.condensed
        return sorted_multipliers(self.mpc, c.layout, y)


def unshared(parts: tuple) -> tuple:
    """Return the problem, the solver and what is made of them with a buffer for each array, which
    neither another one nor an array of the user has."""
    seen: set[int] = set()

    def own(v: Array) -> Array:
        again = id(v) in seen
        seen.add(id(v))
        return jnp.array(v) if again and concrete(v) else v

    given = jax.tree.map(lambda v: jnp.array(v) if concrete(v) else v, parts[:2])
    return jax.tree.map(own, (*given, *parts[2:]))


def plan_arguments(
    mpc: MPC, x0: Any, reference: Any = None, input_reference: Any = None,
    previous_input: Any = None,
) -> list[Any]:  # fmt: skip
    """Return the arguments of a plan as arrays, None where they are None; ValueError for wrong
    kinds and shapes. A number will do for one state or input."""
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    shapes = {
        "x0": ((n,), (n,)), "reference": ((n,), (N + 1, n)),
        "input_reference": ((m,), (N, m)), "previous_input": ((m,), (m,)),
    }  # fmt: skip
    checked = []
    for (name, (one, all_steps)), value in zip(
        shapes.items(), (x0, reference, input_reference, previous_input), strict=True
    ):
        if value is not None or name == "x0":
            value = _real_array(name, value)
            if np.shape(value) == () and one == (1,):
                value = value.reshape(1)
            if np.shape(value) not in (one, all_steps):
                cure = f"Give {one}" if one == all_steps else f"Give {one} or {all_steps}"
                fail(name, f"shape {np.shape(value)}", f"{cure}; use jax.vmap for many")
        checked.append(value)
    return checked


def _real_array(name: str, value: Any) -> Any:
    if isinstance(value, np.ndarray) and value.dtype.kind in "iuf":  # the usual case, and fast
        return value
    value = as_array(value)
    if not isinstance(value, jax.Array):
        return host_array(name, value)
    if jnp.issubdtype(value.dtype, jnp.complexfloating):
        fail(name, f"entries of type {value.dtype} where real numbers are needed", "Use .real")
    return value


def harmless(mpc: MPC) -> tuple[MPC, Any]:
    """Return the problem with harmless dynamics and weights where they are not finite, and whether
    they are: numbers that are being traced cannot be refused."""
    fields = ("system", "Q", "R", "terminal_cost", "stage_weights", "input_rate_weight")
    data = {name: getattr(mpc, name) for name in fields}
    if concrete(data):
        return mpc, True
    clean, finite = _harmless(data, np.eye(mpc.system.m))
    return replace(mpc, **clean), finite


@own_modes
def _harmless(data: dict[str, Any], R: np.ndarray) -> tuple[dict[str, Any], Array]:
    leaves = [jnp.asarray(v) for v in jax.tree.leaves(data)]
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in leaves]))
    clean = jax.tree.map(lambda v: jnp.where(finite, jnp.asarray(v), 0), data)
    return {**clean, "R": jnp.where(finite, jnp.asarray(data["R"]), R)}, finite


def zeros_of(controller: Callable[[Array], Control[Planned]], x: Array) -> Control[Planned]:
    """Return zeros in place of what a controller gives at x."""
    shapes = jax.eval_shape(controller, x)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return varying(zeros, (x, controller))


@jax.jit
@own_modes
def _factor(condensed: Condensed, solver: ADMM) -> Factor:
    made = factorise(condensed.P, condensed.C, solver, condensed.balls)
    return replace(made, reach=condensed.reach(made.reach))


@partial(jax.jit, static_argnames="whole")
@own_modes
def _control(
    controller: Controller,
    x: Array,
    reference: Array | None,
    input_reference: Array | None,
    previous_input: Array | None,
    last: tuple[Array, WarmStart | None] | None,
    *,
    whole: bool,
) -> Control[Plan]:
    start = memory = None
    if last is not None:
        u, memory = last
        start = None if memory is None else controller.shifted(memory)
        if previous_input is None:  # read where the problem limits or weighs input rates
            previous_input = limited(controller.mpc.inputs, jnp.where(jnp.isfinite(u), u, 0.0))
    plan = _plan(controller, x, reference, input_reference, previous_input, start, whole=whole)
    return applied(controller.mpc, controller.condensed.layout, plan, memory, previous_input)


@partial(jax.jit, static_argnames="whole")
@own_modes
def _plan(
    controller: Controller, x0: Array, reference: Any, input_reference: Any, previous_input: Any,
    start: WarmStart | None, *, whole: bool,
) -> Plan:  # fmt: skip
    c, mpc = controller.condensed, controller.mpc
    given = (x0, reference, input_reference, previous_input if mpc.input_in_state else None)
    given = jax.tree.map(lambda v: jnp.asarray(v, c.P.dtype), given)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(given)]))
    # Harmless numbers until all is computed: the derivative of a product with NaN is NaN.
    x0, reference, input_reference, previous = jax.tree.map(
        lambda v: jnp.where(finite, v, 0.0), given
    )
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    if reference is not None:
        reference = jnp.broadcast_to(reference, (N + 1, n))
    if input_reference is not None:
        input_reference = jnp.broadcast_to(input_reference, (N, m))
    theta = x0
    if mpc.input_in_state:
        previous = jnp.zeros(m, x0.dtype) if previous is None else previous
        theta = jnp.concatenate([x0, previous])
    qp = c.qp(theta, reference, input_reference)
    pair = None if start is None else (c.variables(start.states, start.inputs), start.multipliers)
    found, fault = solve_factored(qp, controller.factor, controller.solver, pair, whole=whole)
    fault = jnp.where(finite, fault, Status.NON_FINITE)
    states, inputs = c.trajectory(theta, found.z)
    found = judged(
        mpc, c, controller.factor, controller.solver, found, states, inputs, reference,
        input_reference, previous,
    )  # fmt: skip
    return answer(mpc, c.layout, found, fault, states, inputs, reference, input_reference, previous)
