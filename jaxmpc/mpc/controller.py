"""Controller: an MPC problem condensed and factored once, for plans at each time step; solve: one
plan.

The status of a plan is one of the problem as it was stated: in states and inputs, from its data.
The condensed QP is solved in other variables, whose terms can be far larger than what they add up
to: predictions of an unstable plant, limits less what the present state contributes. So what counts
for the status of a plan is computed from A, B, c, the weights and the rows themselves:

    rows       v = H x_k + D u_k beyond its bounds, relative to the larger of |bounds| and |v|, and
               for bounds at 0 to a small share of what is typical of the row;
    dynamics   x_{k+1} − (A x_k + B u_k + c), relative to the largest value of the same state over
               the horizon, and a small share of what it is made of, |A||x_k| + |B||u_k| + |c|: a
               state that rests at 0 has no other size than that;
    inputs     the gradient of the Lagrangian g = Γ'(∂J/∂x + H'y) + Ω'(∂J/∂u + D'y), with the
               sensitivities Γ, Ω of the plan to its variables. In the metric of the Hessian, in
               which the cost is ½|w|² + const, it is how far the plan is from the best one for the
               multipliers y; it is compared with √(2J);
    gap        Σ (penalty + conjugate − y v), how far y is from complementary, relative to J.

The solver stops by the terms of its QP. With references it solves for the change from them, so that
these terms are tracking errors too. The inputs that hold a robot at its set-point are far larger: a
plan that is right beside them need not be right beside the errors.
"""

import copy
import warnings
from collections.abc import Callable
from dataclasses import field, replace
from functools import partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, all_finite
from jaxmpc.checks import concrete, fail, require_kind, require_memory
from jaxmpc.mpc.condense import Condensed
from jaxmpc.mpc.plan import (
    Aim,
    Control,
    Multipliers,
    Plan,
    Planned,
    WarmStart,
    answer,
    applied,
    checked_aim,
    limited,
    require_before,
    require_warm_start,
    sorted_multipliers,
    within_limits,
)
from jaxmpc.mpc.policy_rows import MATRICES, PolicyCondensed, condensed_plan
from jaxmpc.mpc.problem import MPC, at_stage, dynamics_of
from jaxmpc.mpc.rows import blocks, dynamics_terms, given_blocks, row_values, split
from jaxmpc.mpc.tightening import with_gain
from jaxmpc.pytrees import prepared_pytree
from jaxmpc.qp.admm import ADMM, DEFAULT, Factor
from jaxmpc.qp.dual import has_dual_steps
from jaxmpc.qp.jax_transformations import (
    attempted_first,
    compiled_lightly,
    default_platform,
    own_modes,
    varying,
)
from jaxmpc.qp.linalg import apply, arrays, host_arrays, matmul, on_device, rounding
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.residuals import NEAR, SHARE, Measured, Terms, worst
from jaxmpc.qp.solve import attempt, can_attempt, in_two_parts, solve_factored
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box, Polytope

T = TypeVar("T")

# Seconds of one core that a plan takes, over (rows + variables)³, measured for 1,600 to 6,000 of
# them; and seconds that are told beforehand.
SECONDS_A_CUBE, LONG_SECONDS = 2e-10, 10.0
# Roundings of float32 that a plan, computed in float64 and then rounded, may be off.
PLAN_ROUNDINGS = 1000


@prepared_pytree
class Controller:
    """An MPC problem that is condensed and factored once, at construction: a feedback policy.

    `controller(x, before) -> Control`: its u (m,) is the first input of its plan, clipped into the
    limits if these are a Box. before: what the controller gave at the time step before, None at the
    start. The plan then, `shifted`, is the warm start, and the input then the previous input (zero
    at the start). When the plan is not SOLVED, u is still the first input of the best iterate: look
    at plan.solved. Of a state that is not finite the plan is NaN, u is finite: the last input where
    its rate is limited or weighed, else zero, within the limits; and what is remembered is the last
    finite plan. A plan is a warm start only where that is nearer to the solution than none: one bad
    reading, finite or not, is forgotten with the next time step.

    mpc: the problem. solver: its settings.

    `condensed` and `factor` are filled in at construction, which `dataclasses.replace` repeats and
    JAX, which rebuilds pytrees, does not. Each array has a buffer of its own: a controller may be
    donated.
    """

    mpc: MPC
    solver: ADMM = DEFAULT
    condensed: Condensed = field(init=False)
    factor: Factor = field(init=False)

    def __post_init__(self) -> None:
        require_linear(self.mpc, "jm.NonlinearController")
        self.mpc.validate()
        require_kind("solver", self.solver, ADMM)
        self.solver.validate()
        mpc, finite = harmless(with_gain(self.mpc))
        condensed = condensed_plan(mpc)
        # The factorization reads from P what is wrong with the data.
        if finite is not True:
            condensed = replace(condensed, P=jnp.where(finite, condensed.P, jnp.nan))
        self.solver.validate(condensed.C.shape[0])
        _look_at_size(mpc, *condensed.C.shape)
        # Arrays from here on, so that a time step need not convert the whole object again.
        given = replace(mpc, prestabilise=condensed.K), self.solver
        parts = unshared((*given, condensed, _factor(condensed, self.solver)))
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
    def takes_forecasts(self) -> bool:
        """True: plans take what is known ahead of disturbances."""
        return True

    @property
    def state_size(self) -> int:
        """Length n of the state."""
        return self.mpc.system.n

    @property
    def limits(self) -> Box | Polytope | None:
        """The set by which violations of a closed loop are measured; of limits that differ from
        stage to stage those of the first."""
        return at_stage(self.mpc.states, 0)

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
        forecast: Reals | None = None,
    ) -> Control[Plan]:
        """The input at the state x (n,), the plan that it belongs to, and what to remember.

        before: None, or what was returned at the time step before. References, previous_input and
        forecast as in `solve`; previous_input None: the input of `before`.
        """
        aim = self._checked(x, reference, input_reference, previous_input, forecast)
        require_before(before)
        last = None if before is None else (before.u, before.memory)
        return self._in_two_parts(_control, aim, last, status=lambda found: found.plan.status)

    def shifted(self, plan: Plan | WarmStart) -> WarmStart:
        """The plan seen one time step later, as a warm start (`WarmStart.shifted`).

        The new last input is the unconstrained optimum of that step for the terminal cost about
        the origin, clipped into its limits and those of its rate. With a control horizon each free
        input becomes what the plan did one step after its beginning.
        """
        c = self.condensed
        start = WarmStart.of(plan, c.layout, self.mpc)
        tail = within_limits(self.mpc, matmul(c.K_N, start.states[-1]), start.inputs[-1])
        return start.shifted(c.layout, tail, bool(c.balls))

    def plan(
        self,
        x0: Reals,
        reference: Reals | None = None,
        warm_start: Plan | WarmStart | None = None,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
        forecast: Reals | None = None,
    ) -> Plan:
        """Plan from x0 (n,); arguments as in `solve`."""
        aim = x0, reference, input_reference, previous_input, forecast
        return self._plan_by(_plan, warm_start, *aim)

    def _plan_by(
        self, program: Callable[..., Plan], warm_start: Plan | WarmStart | None, *aim: Any
    ) -> Plan:
        """Plan by one of the programs made of `plan_for`."""
        checked = self._checked(*aim)
        if warm_start is not None:
            warm_start = arrays(WarmStart.of(warm_start, self.condensed.layout, self.mpc))
        return self._in_two_parts(program, checked, warm_start)

    def _in_two_parts(self, program: Callable[..., T], *given: Any, **status: Any) -> T:
        c = self.condensed
        hard = isinstance(c, PolicyCondensed) or not has_dual_steps(c.balls, c.C)
        return in_two_parts(program, hard, self.solver, self, *given, **status)

    def _checked(self, x0: Reals, *aim: Reals | None) -> Aim:
        """The aim in the controller's precision; ValueError for wrong arguments."""
        if self.dtype == jnp.float64 and jnp.result_type(float) != jnp.float64:
            cure = "Call it under jax.enable_x64(True), or make it outside"
            fail("controller", "was made in float64, and 64-bit mode is off", cure)
        given = checked_aim(self.mpc, x0, *aim)
        cast = lambda v: v.astype(self.dtype) if isinstance(v, np.ndarray) else v
        return jax.tree.map(cast, given)

    def multipliers(self, y: Array) -> Multipliers:
        """Sort the QP's multipliers y (rows,) by constraint and step."""
        c = self.condensed
        return sorted_multipliers(self.mpc, c.layout, y)


def require_linear(mpc: Any, other: str) -> None:
    """Raise ValueError unless this is an MPC; other: what takes one with a nonlinear model."""
    nonlinear = isinstance(getattr(mpc, "mpc", None), MPC) and hasattr(mpc, "tasks")
    require_kind("mpc", mpc, MPC, cure=f"Give it to {other}" if nonlinear else "")


def _look_at_size(mpc: MPC, rows: int, variables: int) -> None:
    """Raise ValueError where the matrices of the solver do not fit into memory, and warn where a
    plan takes long on a CPU."""
    size, what = rows + variables, f"horizon: {variables:,} variables and {rows:,} rows, all dense"
    cure = "Give fewer steps, or use jm.mpc.solve_stagewise: its time grows with the horizon alone"
    if mpc.disturbance is not None and mpc.policy == "tube":
        cure = "Give fewer steps, or a gain that damps faster, whose tube has fewer variables"
    require_memory(what, 8.0 * MATRICES * size**2, cure)
    seconds = SECONDS_A_CUBE * float(size) ** 3
    if seconds > LONG_SECONDS and default_platform() == "cpu":
        warnings.warn(f"{what}: a plan takes some {seconds:,.0f} s. {cure}", stacklevel=4)


def unshared(parts: tuple) -> tuple:
    """Return the problem, the solver and what is made of them with a buffer for each array, which
    neither another one nor an array of the user has."""
    seen: set[int] = set()

    def own(v: Array) -> Array:
        again = id(v) in seen
        seen.add(id(v))
        return jnp.array(v) if again and concrete(v) else v

    def copied(v: Any) -> Any:
        if not concrete(v):
            return arrays(v)
        return jnp.array(arrays(v)) if isinstance(v, Array) else on_device(host_arrays(v))

    return jax.tree.map(own, (*jax.tree.map(copied, parts[:2]), *parts[2:]))


def harmless(mpc: MPC) -> tuple[MPC, Any]:
    """Return the problem with harmless numbers where some that are being traced, and cannot be
    refused, are not finite, and whether they are. Others stay as they are, for with known dynamics
    there are gains and sets that traced ones have not.

    An instance that is not solved has the derivative 0, and 0 times NaN is NaN: what is shared with
    the other instances of a batch would have no derivative either.
    """
    paths, tree = jax.tree.flatten_with_path(mpc)
    leaves = [leaf for _, leaf in paths]
    traced = [i for i, leaf in enumerate(leaves) if not concrete(leaf)]
    if not traced:
        return mpc, True
    clean, finite = _harmless([(paths[i][0][-1].name, leaves[i]) for i in traced])
    for i, leaf in zip(traced, clean, strict=True):
        leaves[i] = leaf
    return jax.tree.unflatten(tree, leaves), finite


@own_modes
def _harmless(values: list[tuple[str, Array]]) -> tuple[list[Array], Array]:
    """Return arrays, given with their names in the problem, as `harmless` does."""
    # Infinite where there is none.
    open_ended = ("lower", "upper", "h", "rho", "quadratic", "input_rate_limit")
    numbers = [jnp.where(jnp.isinf(v), 0, v) if name in open_ended else v for name, v in values]
    finite, clean = all_finite(numbers), []
    for name, value in values:
        instead: Any = 1.0 if name in ("level", "rho") else 0.0
        if name in ("R", "P"):  # of the cost; of an ellipsoid
            instead = jnp.eye(value.shape[-1], dtype=value.dtype)
        clean.append(jnp.where(finite, value, instead))
    return clean, finite


def zeros_of(controller: Callable[[Array], Control[Planned]], x: Array) -> Control[Planned]:
    """Return zeros in place of what a controller gives at x."""
    shapes = jax.eval_shape(controller, x)
    zeros = jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)
    return varying(zeros, (x, controller))


@compiled_lightly(0)
@own_modes
def _factor(condensed: Condensed, solver: ADMM) -> Factor:
    made = condensed.factor(solver)
    return replace(made, row_norms=condensed.reach(made.row_norms))


def with_solver(controller: Controller, solver: ADMM) -> Controller:
    """Return the controller with another solver, whose numbers may be traced."""
    other = copy.copy(controller)
    vars(other).update(solver=solver, factor=_factor(controller.condensed, solver))
    return other


@compiled_lightly(1, static_argnames="whole")
@own_modes
def _control(
    controller: Controller, aim: Aim, last: tuple[Array, WarmStart | None] | None, *, whole: bool
) -> Control[Plan]:
    start = memory = None
    if last is not None:
        u, memory = last
        start = None if memory is None else controller.shifted(memory)
        if aim.previous_input is None:  # read where the problem limits or weighs input rates
            u = limited(controller.mpc.inputs, jnp.where(jnp.isfinite(u), u, 0.0))
            aim = aim._replace(previous_input=u)
    plan = _plan(controller, aim, start, whole=whole)
    return applied(controller.mpc, controller.condensed.layout, plan, memory, aim.previous_input)


@own_modes
def plan_for(controller: Controller, aim: Aim, start: WarmStart | None, *, whole: bool) -> Plan:
    """Return the plan of an aim; whole: see `qp.solve.in_two_parts`."""
    c, given = controller.condensed, (controller, aim, start)
    plain = whole and not isinstance(c, PolicyCondensed)
    if plain and can_attempt(controller.solver, c.balls, c.C):
        return attempted_first(_attempt, _plan_whole, _derived, *given)[0]
    return plan_with(partial(solve_factored, whole=whole), *given)[0]


def plan_with(
    solve: Callable[..., tuple[QPSolution, Array]],
    controller: Controller,
    aim: Aim,
    start: WarmStart | None,
    share: float = 1.0,
) -> tuple[Plan, QPSolution]:
    """Return the plan of an aim, and the solution of its QP by `solve`, which takes what
    `solve_factored` does. share: of the tolerances, that the plan must keep."""
    c, mpc = controller.condensed, controller.mpc
    aim = aim if mpc.input_in_state else aim._replace(previous_input=None)
    aim = jax.tree.map(lambda v: jnp.asarray(v, c.P.dtype), aim)
    finite = all_finite(aim)
    # Harmless numbers until all is computed: the derivative of a product with NaN is NaN.
    aim = jax.tree.map(lambda v: jnp.where(finite, v, 0.0), aim)
    aim = aim.along(mpc)
    theta = aim.x0
    if mpc.input_in_state:
        previous = aim.previous_input
        aim = aim._replace(
            previous_input=jnp.zeros(mpc.system.m, theta.dtype) if previous is None else previous
        )
        theta = jnp.concatenate([theta, aim.previous_input])
    qp, z0 = _qp(controller, theta, aim), _tracked(c, aim)
    if z0 is not None:
        qp = qp.about(z0)
    pair = None
    if start is not None and not isinstance(c, PolicyCondensed):
        z = c.variables(start.states, start.inputs)
        pair = z if z0 is None else z - z0, start.multipliers
    solution, fault = solve(qp, controller.factor, controller.solver, pair)
    found = solution if z0 is None else replace(solution, z=z0 + solution.z)
    fault = jnp.where(finite, fault, Status.NON_FINITE)
    return plan_of_solution(controller, theta, aim, found, fault, share), solution


_plan_whole = jax.jit(partial(plan_with, solve_factored))


@jax.jit
def _attempt(
    controller: Controller, aim: Aim, start: WarmStart | None
) -> tuple[tuple[Plan, QPSolution], Array]:
    """Return what few steps on the dual find, and whether the residuals of the plan as stated are
    as far below their tolerances as those of the QP at which the solver ends."""
    unmeasured = partial(attempt, measured=False)
    plan, solution = found = plan_with(unmeasured, controller, aim, start, share=NEAR)
    return found, (plan.status == Status.SOLVED) & (solution.status == Status.SOLVED)


def _derived(found: tuple[Plan, QPSolution], *given: Any) -> tuple[Plan, QPSolution]:
    return plan_with(partial(solve_factored, found=found[1]), *given)


_plan = compiled_lightly(1, static_argnames="whole")(plan_for)
# Of `solve`, which makes a controller for each plan: that takes more time than the plan.
_plan_once = compiled_lightly(0, static_argnames="whole")(plan_for)


def _tracked(c: Condensed, aim: Aim) -> Array | None:
    """Return the variables (nz,) of the references, about which the QP is solved; None where there
    are no references, and under affine policies and tubes."""
    if isinstance(c, PolicyCondensed) or (aim.states is None and aim.inputs is None):
        return None
    states = jnp.zeros_like(c.phi) if aim.states is None else aim.states
    inputs = jnp.zeros_like(c.psi) if aim.inputs is None else aim.inputs
    return c.variables(states, inputs)


def _qp(controller: Controller, theta: Array, aim: Aim) -> QP:
    """Return the condensed QP of an aim at θ (p,).

    What a forecast adds to states and inputs, x̃ and ũ, is known: the rest tracks the references
    less these, and keeps the limits less the rows of these.
    """
    c, mpc = controller.condensed, controller.mpc
    if aim.forecast is None:
        return c.qp(theta, aim.states, aim.inputs)
    x, u = c.response(mpc.system, aim.forecast)
    none = jnp.zeros_like(u[0])
    shift = row_values(given_blocks(mpc, x.dtype), x, u, none)
    states, inputs = (0.0 if r is None else r for r in (aim.states, aim.inputs))
    shift = c.of_all(shift) if isinstance(c, PolicyCondensed) else shift
    qp = c.qp(theta, states - x, inputs - u, shift)
    if mpc.input_rate_weight is None:
        return qp
    push = _of_rates(2 * apply(c.weights.W, jnp.diff(u, axis=0, prepend=none[None])))
    return replace(qp, q=qp.q + jnp.einsum("kmi,km->i", c.Omega, push, precision="highest"))


def _of_rates(g: Array) -> Array:
    """Return the gradient (N, m) in u of what has the gradient g in the rates u_k − u_{k−1}."""
    return g - jnp.concatenate([g[1:], jnp.zeros_like(g[:1])])


def plan_of_solution(
    controller: Controller,
    theta: Array,
    aim: Aim,
    found: QPSolution,
    fault: Array,
    share: float = 1.0,
) -> Plan:
    """Return the plan of a solution of the condensed QP at θ (p,), with the status and residuals of
    the problem as stated; fault: the status that faulty data give, NOT_RUN for none.

    In float32 the status is that of the QP, which speaks of the plan before it was rounded; rows
    and dynamics are checked to the precision that is left. Under affine policies and tubes, which
    the plan alone does not show, it is that of the QP.
    """
    mpc, c = controller.mpc, controller.condensed
    states, inputs = c.trajectory(theta, found.z)
    if aim.forecast is not None:
        more = c.response(mpc.system, aim.forecast)
        states, inputs = states + more[0], inputs + more[1]
    if isinstance(c, PolicyCondensed):
        feedback, beyond = c.feedback(found.z), c.beyond(_qp(controller, theta, aim), found.z)
        found = replace(found, y=c.of_plan(found.y))
        return answer(mpc, c.layout, found, fault, states, inputs, aim, feedback, beyond)
    terms = stated_terms(*jax.lax.stop_gradient((controller, found.y, states, inputs, aim)))
    eps, dtype = share * jnp.asarray(controller.solver.eps, states.dtype), states.dtype
    if dtype == jnp.float64:
        measured = Measured.of(terms, eps, rounding(dtype))
        found = replace(
            found, primal_residual=measured.primal, dual_residual=measured.dual, gap=measured.gap
        )
        solved = measured.within_tolerance
    else:
        allowed = eps + PLAN_ROUNDINGS * jnp.finfo(dtype).eps
        solved = (found.status == Status.SOLVED) & (worst(terms[:1], allowed)[1][0] <= allowed)
    lost = jnp.where(found.status == Status.SOLVED, Status.INACCURATE, found.status)
    found = replace(found, status=jnp.where(solved, Status.SOLVED, lost).astype(jnp.int32))
    return answer(mpc, c.layout, found, fault, states, inputs, aim)


def stated_terms(controller: Controller, y: Array, x: Array, u: Array, aim: Aim) -> Terms:
    """Return the residuals at the top of this file, with their sizes and terms: rows and dynamics
    (rows + N·n,), inputs (variables of the QP,), gap (1,)."""
    mpc, c, factor = controller.mpc, controller.condensed, controller.factor
    e = x if aim.states is None else x - aim.states
    d = u if aim.inputs is None else u - aim.inputs
    weights = c.weights
    gx, gu = weights.of_states(e), weights.of_inputs(d)
    J = jnp.sum(e * gx) + jnp.sum(d * gu)
    # What the tracking errors are differences of.
    cancels = J
    if aim.states is not None or aim.inputs is not None:
        cancels = J + jnp.sum(x * weights.of_states(x)) + jnp.sum(u * weights.of_inputs(u))
    before = jnp.zeros_like(u[0]) if aim.previous_input is None else aim.previous_input
    rates = jnp.diff(u, axis=0, prepend=before[None])
    if mpc.input_rate_weight is not None:
        push = apply(weights.W, rates)
        J = J + jnp.sum(rates * push)
        gu = gu + _of_rates(push)
    gx, gu = 2 * gx, 2 * gu

    violations, values, limits, slopes = [], [], [], []
    gap = products = jnp.zeros((), x.dtype)
    for block, y_block in zip(blocks(mpc, x.dtype), split(c.layout, y), strict=True):
        if block.rate:
            v = block.values(x, rates)
            gu = gu + _of_rates(block.pull(y_block, gx, jnp.zeros_like(gu))[1])
        else:
            v = block.values(x, u)
            gx, gu = block.pull(y_block, gx, gu)
        bounds, v, y_rows = block.bounds(), v.ravel(), y_block.ravel()
        penalty, support = bounds.cost(v), bounds.support(y_rows)
        J = J + jnp.sum(penalty)
        gap = gap + jnp.sum(penalty + support - y_rows * v)
        products = products + jnp.sum(jnp.abs(y_rows * v)) + jnp.sum(jnp.abs(support))
        violations.append(bounds.violation(v))
        values.append(jnp.abs(v))
        limits.append(bounds.sizes())
        slopes.append(bounds.slope(v))

    moved = jnp.concatenate([M.reshape(-1, M.shape[-1]) for M in (c.Gamma, c.Omega)])
    g = matmul(jnp.concatenate([gx.ravel(), gu.ravel()]), moved)
    root = lambda v: jnp.where(v > 0, jnp.sqrt(jnp.where(v > 0, v, 1.0)), 0.0)
    length, rounds = root(2 * J), root(2 * cancels)
    # Not differentiated: NaN, where a compiler rounds what it compares in two ways.
    largest = lambda v: jax.lax.stop_gradient(jnp.max(v, axis=0, initial=0.0))
    rounds = rounds + largest(jnp.abs(y) * factor.row_norms)

    A, B, drift = dynamics_of(mpc.system, x.dtype)
    drift = drift if aim.forecast is None else drift + aim.forecast
    defects = x[1:] - (apply(A, x[:-1]) + apply(B, u) + drift)
    terms = dynamics_terms(A, B, drift, x, u)
    most = largest(jnp.abs(x)) + SHARE * largest(terms)
    most = jnp.broadcast_to(most, terms.shape)
    value, limit, slope = (jnp.concatenate([*v, y[:0]]) for v in (values, limits, slopes))
    row_size = jnp.maximum(limit, value)
    # Only a limit of 0 has no size of its own.
    unknown = jnp.where(limit > 0, 0.0, factor.row_norms)
    row_terms = row_size + rounds * unknown
    # A penalty is a multiple of a violation, which is a difference of the terms of its row.
    products = products + jnp.sum(slope * row_terms)
    per_variable = 1 / jnp.sum(jnp.abs(factor.T), axis=1)
    # At a set-point tracking errors are zero, but not their rounding, which adds up over the steps
    # whose terms cancel, as where inputs balance the weight: those of a step count at later ones.
    size, Gamma, Omega = (jax.tree.map(jnp.abs, v) for v in (weights, c.Gamma, c.Omega))
    of_states = jnp.concatenate([matmul(size.Q, Gamma[:-1]), matmul(size.P, Gamma[-1:])])
    of_terms = jnp.cumsum(of_states[::-1], axis=0)[::-1]
    each = jnp.concatenate([M.reshape(-1, M.shape[-1]) for M in (of_terms, matmul(size.R, Omega))])
    made_of = [jnp.abs(x[0]), terms.ravel(), jnp.abs(u).ravel()]
    apart = 2 * matmul(jnp.concatenate(made_of), each)
    return [
        (
            jnp.concatenate([*violations, defects.ravel()]),
            jnp.concatenate([row_size + SHARE * length * unknown, most.ravel()]),
            jnp.concatenate([row_terms, terms.ravel()]),
        ),
        (g, length * per_variable, rounds * per_variable + apart),
        (gap[None], 2 * J[None], (cancels + products)[None]),
    ]


def solve(
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    solver: ADMM = DEFAULT,
    warm_start: Plan | WarmStart | None = None,
    *,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
    forecast: Reals | None = None,
) -> Plan:
    """Solve one MPC problem from the state x0 (n,).

    mpc: the problem. x0 (n,): the initial state, in the units of x.
    solver: settings of the solver.
    reference: state to track, (n,) or (N+1, n), in place of the origin: the cost becomes
    Σ (x_k − r_k)'Q(x_k − r_k) + …; constraints, the terminal set too, stay where they are.
    input_reference: input to track, (m,) or (N, m), such as that of `equilibrium`; None for zero.
    previous_input: u_{−1} (m,) where the problem limits or weighs input rates; None for zero.
    forecast: disturbance that is known ahead, (n,) or (N, n), row k of which is added to x_{k+1};
    None for zero.
    warm_start: an earlier Plan or a WarmStart; affine policies and tubes make no use of it.

    `jax.vmap(solve, in_axes=(None, 0))(mpc, x0s)` solves for many states and factors
    once. Raises ValueError for an ill-posed problem or wrong shapes, before any compile; what
    depends on values inside a batch is answered by `plan.status`.
    """
    require_linear(mpc, "jm.solve_nonlinear")
    mpc.require_sizes()
    aim = x0, reference, input_reference, previous_input, forecast
    checked_aim(mpc, *aim)
    require_warm_start(warm_start)
    controller = Controller(mpc, solver)
    return controller._plan_by(_plan_once, warm_start, *aim)
