"""Nonlinear MPC by sequential quadratic programming on the stages (direct multiple shooting).

Each QP is the expansion of `nonlinear.py` about the iterate x (N+1, n), u (N, m), solved as in
`solve.py`; states and inputs are both variables, so an iterate may have defects
f(x_k, u_k) − x_{k+1}. The step to the QP's solution is shortened until the merit function

    φ = J + penalties of soft rows + Σ w |defect| + Σ w (violation of hard rows)

falls by a part of what the QP predicts (Armijo), after a second-order correction where the whole
step does not lower it. φ is exact where each weight w exceeds its
multiplier; Powell's rule, w ← max(|λ|, (w + |λ|)/2), keeps that with λ of the QP (Nocedal, Wright
2006, §18.3). One QP a time step, with a full step from the last plan shifted by one, is the
real-time iteration (Diehl, Bock, Schlöder 2005).

The status comes from the residuals of the nonlinear problem itself at the returned x, u, y: the
conditions of the expansion about them, whose gradients are the true ones, and the defects.
Derivatives follow from the same conditions by the implicit function theorem, with the Hessian of
the Lagrangian (`nonlinear.curved`): one Riccati recursion.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals, all_finite
from jaxmpc.checks import entries, fail, require_kind, whole
from jaxmpc.mpc.plan import Aim, Plan, WarmStart, answer, checked_aim, checked_array
from jaxmpc.mpc.rows import dynamics_terms, row_count, split, spread
from jaxmpc.mpc.stagewise.newton_steps import (
    INTERIOR_STEPS,
    Search,
    stage_conditions,
    stage_newton_step,
)
from jaxmpc.mpc.stagewise.nonlinear import (
    NonlinearMPC,
    all_rows,
    curved,
    expanded,
    task_layout,
    total_cost,
)
from jaxmpc.mpc.stagewise.recursion_kernels import recurrence
from jaxmpc.mpc.stagewise.solve import (
    NEWTON_STEPS,
    StageFactor,
    checked,
    full_aim,
    require_row_scale,
    scaled,
    stage_solution,
)
from jaxmpc.mpc.stagewise.stages import (
    Stages,
    cleaned,
    measured_pair,
    predict,
    riccati,
    stage_residuals,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ADMM, DEFAULT, default_rho, scaled_multipliers
from jaxmpc.qp.jax_transformations import Undo, implicit, own_modes, repeat_while, varying
from jaxmpc.qp.linalg import apply, arrays, cholesky, precisely, rounding
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import SHARE, Measured, Proof, Terms, assess
from jaxmpc.qp.solve import tolerance
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box

# QPs at most, of `solve_nonlinear`.
ITERATIONS = 100
# Part of the predicted decrease that a step has to make, and the shortest step.
DECREASE, SHORTEST = 1e-4, 1e-4
# A multiplier, relative to the largest, above which a row counts as held.
HELD = 1e-6
# Least tolerance in float32, in which the model itself is evaluated.
SINGLE = 1e-3


def solve_nonlinear(
    problem: NonlinearMPC,
    x0: Reals,
    reference: Reals | None = None,
    solver: ADMM = DEFAULT,
    warm_start: Plan | WarmStart | None = None,
    *,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
    targets: Sequence[Reals | None] | None = None,
    iterations: int = ITERATIONS,
    hessian: Literal["exact", "gauss-newton"] = "exact",
    scale: Reals | None = None,
) -> Plan:
    """Solve a nonlinear MPC from the state x0 (n,) by sequential quadratic programming.

    reference (n,) or (N+1, n), input_reference (m,) or (N, m), previous_input u_{−1} (m,), None for
    zero. targets: one array for each task, in place of its own. solver: of the QPs, as in
    `solve_stagewise` (no ADMM steps where solver.iterations is None); its eps is the tolerance of
    the nonlinear problem.
    warm_start: an earlier Plan or a WarmStart; None, or where it costs a hundred times as much: at
    rest at x0 under the first input reference.
    iterations: QPs at most. 1: the real-time iteration, a full step, whose plan, residuals and
    status are those of the QP about the warm start.
    hessian: "exact", the Lagrangian's where it is convex (few QPs near the solution), or
    "gauss-newton", which needs no second derivatives of the model (of tasks with weights, yes,
    without which targets out of reach make full steps swing). scale (rows,): row scale of a
    similar problem, as in `solve_stagewise`.

    Returns the Plan at which the search ended, SOLVED where the residuals of the nonlinear problem
    are at most eps (a point that satisfies the first-order conditions: a local minimum, mostly),
    with the number of QPs as `iterations`. `jax.vmap` over x0, references, targets, warm starts and
    the arrays of the problem; an instance leaves the batch when it is solved. Derivatives are those
    of the solution (implicit function theorem, exact second derivatives), with respect to all
    arrays of the problem and x0, where the plan is SOLVED and a strict minimum, and finite numbers
    elsewhere. Raises ValueError for wrong shapes, and for what `solve_stagewise` does not support.
    """
    require_kind("problem", problem, NonlinearMPC)
    solver = checked_search(problem, solver, iterations, hessian)
    mpc = problem.mpc
    s = jax.eval_shape(Stages.of, mpc)
    rows = (*s.layout, *task_layout(problem))
    require_row_scale(scale, row_count(rows))
    aim = checked_aim(mpc, x0, reference, input_reference, previous_input)
    every_target = _full_targets(problem, targets, s.P.dtype)
    aim = full_aim(mpc, aim, s.P.dtype)._replace(targets=every_target)
    if warm_start is None:
        x = jnp.broadcast_to(aim.x0, aim.states.shape)
        u = jnp.broadcast_to(aim.inputs[:1], aim.inputs.shape)
        start = WarmStart(x, u, jnp.zeros(row_count(rows), s.P.dtype))
    else:
        start = WarmStart.of(warm_start, rows, mpc)
    given = arrays((problem.closed(s.P.dtype), solver, aim, start, scale))
    # About a plan the multipliers are known, of which the exact Hessian is made.
    known = warm_start is not None
    return _solve(*given, iterations=int(iterations), hessian=hessian, known=known)


def checked_search(
    problem: NonlinearMPC,
    solver: ADMM,
    steps: int,
    hessian: str,
    name: str = "iterations",
) -> ADMM:
    """Return the solver of the QPs, without ADMM steps unless it says how many; ValueError for what
    is wrong with the arguments of `solve_nonlinear`. name: of the number of QPs."""
    problem.validate()
    whole(name, steps, 1)
    if solver.iterations is None:
        solver = replace(solver, iterations=0)
    checked(problem.mpc, replace(solver, rho=None))
    if hessian not in ("exact", "gauss-newton"):
        fail("hessian", f"{hessian!r}", 'Give "exact" or "gauss-newton"')
    if solver.differentiate != "implicit" and steps > 1:
        fail("solver.differentiate", f"{solver.differentiate!r}", f'With {name} > 1: "implicit"')
    return solver


def _full_targets(
    problem: NonlinearMPC, targets: Sequence[Reals | None] | None, dtype: DTypeLike
) -> tuple[Array, ...]:
    """Return the targets of all tasks at all stages, (N+1, p) each: those given, or the tasks'
    own. Raises ValueError for wrong shapes."""
    cure = "Give one for each task, None for the task's own"
    own = [task.target for task in problem.tasks]
    given = own if targets is None else entries("targets", targets, cure)
    if len(given) != len(problem.tasks):
        fail("targets", f"{len(given)} for {len(problem.tasks)} tasks", cure)
    full = []
    for i, (value, size) in enumerate(zip(given, problem.sizes(), strict=True)):
        shape = (problem.mpc.horizon + 1, size)
        value = checked_array(f"targets[{i}]", 0 if value is None else value, [(), (size,), shape])
        full.append(jnp.broadcast_to(jnp.asarray(value, dtype), shape))
    return tuple(full)


@partial(jax.jit, static_argnames=("iterations", "hessian", "known"))
@own_modes
def _solve(
    problem: NonlinearMPC,
    solver: ADMM,
    aim: Aim,
    warm_start: WarmStart,
    scale: Array | None,
    iterations: int,
    hessian: str,
    known: bool,
) -> Plan:
    base, fault = cleaned(Stages.of(problem.mpc))
    numbers = (aim, [(task.weight, task.rho) for task in problem.tasks])
    fault = jnp.where(all_finite(numbers), fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    aim = jax.tree.map(lambda v: jnp.where(usable, v, 0), aim)
    base, mpc, problem = base.aimed(aim), problem.mpc, problem.remembering()
    eps = tolerance(solver, base.P.dtype)
    if eps.dtype != jnp.float64:
        eps = jnp.maximum(eps, SINGLE)
    # What is not finite in a warm start counts as 0.
    x, u, y = (jnp.nan_to_num(v.astype(base.P.dtype), posinf=0, neginf=0) for v in warm_start)
    x, u, y = within_reason(base, problem, x.at[0].set(aim.x0), u, y)
    count = jnp.int32(1)
    if iterations > 1:
        constants = jax.lax.stop_gradient((base, problem, scale, eps))
        first = Iterate.begin(*jax.lax.stop_gradient((x, u, y)), exact=known)
        step = partial(sqp_step, iterations, hessian)
        last = repeat_while(lambda state: state.open, step, constants, first, steps="recursion")
        x, u, y, count = last.x, last.u, last.y, last.steps
    constant = jax.lax.stop_gradient
    about = constant(expanded(base, problem, x, u))
    # What has no finite expansion has the derivative 0: as NaN it would be the whole batch's.
    out = about.bounds.outside(about.rows(x, u))
    finite = usable & all_finite(replace(about, bounds=Bounds(out, out)))
    base, problem, aim, x, u, y = jax.tree.map(
        lambda v: jnp.where(finite, v, constant(v)), (base, problem, aim, x, u, y)
    )
    s = expanded(base, problem, x, u)
    measured, E = constant(scaled(s, scale))
    rho, s = penalty(s, E), replace(s, gain=measured.gain)
    # Where the expansion overflows nothing is solved, and what is applied is a number still.
    or_start = lambda planned, u=u: jnp.where(jnp.isfinite(planned), planned, u)
    if iterations == 1:
        gains = None
        if solver.admm_steps():
            gains = jax.tree.map(lambda v: v[None], riccati(s, rho * E**2))
        factor = StageFactor(s, E, rho[None], gains, fault)
        found = stage_solution(factor, s, solver, WarmStart(x, u, y))
        x = predict(s, found.z)
        u = or_start(s.inputs(x, found.z))
    else:
        moves = measured.moves(x, u)
        x = predict(measured, moves)
        z = jnp.concatenate([x.ravel(), or_start(measured.inputs(x, moves)).ravel()])
        z, y = implicit(nonlinear_conditions, (base, problem), (E, rho, measured.gain), z, y)
        x, u = _states_inputs(s, z)
        y = s.bounds.following(y, E, s.rows(x, u))
        found = assess(nonlinear_residuals, (measured, E), moves, y, Proof.none(moves, y), eps)
        s = expanded(base, problem, x, u) if problem.tasks else s
    found = replace(found, iterations=jnp.asarray(count, jnp.int32))
    plan = answer(mpc, s.layout, found, fault, s.of_system(x), u, aim)
    return with_tasks(plan, s, base, problem, x)


def within_reason(
    base: Stages, problem: NonlinearMPC, x: Array, u: Array, y: Array
) -> tuple[Array, Array, Array]:
    """Return the warm start x (N+1, ·) of the system, u, y in the states of the stages, or rest at
    x0 where it costs more than anybody plans: 100 times what rest does, under the first input
    reference or under inputs at their limits.

    About the plan of a reading that is far off, the expansion would be rounding."""
    rest_u = jnp.broadcast_to(base.aim.inputs[:1], u.shape)
    most = rest_u
    if isinstance(problem.mpc.inputs, Box):
        ends = arrays((problem.mpc.inputs.lower, problem.mpc.inputs.upper))
        sizes = jnp.stack(
            [jnp.abs(jnp.broadcast_to(jnp.asarray(v, u.dtype), u.shape)) for v in ends]
        )
        most = jnp.max(jnp.where(jnp.isfinite(sizes), sizes, 0.0), axis=0) + jnp.abs(rest_u)
    still = jnp.broadcast_to(x[:1], x.shape)
    x, rest_x, most_x = (base.joined(x, u), base.joined(still, rest_u), base.joined(still, most))
    J = lambda x, u: jax.lax.stop_gradient(total_cost(base, problem, x, u))
    sane = J(x, u) <= 100 * (J(rest_x, rest_u) + J(most_x, most))
    return jnp.where(sane, x, rest_x), jnp.where(sane, u, rest_u), jnp.where(sane, y, 0.0)


def rows_of(s: Stages, base: Stages, problem: NonlinearMPC, x: Array, u: Array) -> Array:
    """Return the limited quantities (rows,) at x, u, moved as the bounds of the expansion are: for
    each row by the constant by which its expansion at 0 differs from the function's."""
    about = s.aim.states, s.aim.inputs
    return all_rows(base, problem, x, u) + (s.rows(*about) - all_rows(base, problem, *about))


def with_tasks(plan: Plan, s: Stages, base: Stages, problem: NonlinearMPC, x: Array) -> Plan:
    """Return the plan, with the states x (N+1, n) of the stages, with what tasks add to cost and
    slack."""
    if not problem.tasks:
        return plan
    u = plan.inputs
    rows = rows_of(s, base, problem, x, u)
    J = total_cost(base, problem, x, u) + jnp.sum(s.bounds.cost(rows))
    slack = [plan.slack]
    out = jnp.abs(rows - jnp.clip(rows, s.bounds.l, s.bounds.u))[len(base.bounds.l) :]
    layout, limited = task_layout(problem), [task for task in problem.tasks if task.limited]
    for (_, steps, _), task, part in zip(layout, limited, split(layout, out), strict=True):
        if task.rho is not None:
            slack.append(spread(part, steps, len(x)))
    return replace(plan, cost=J, slack=jnp.concatenate(slack, axis=1))


def penalty(s: Stages, E: Array) -> Array:
    """Return the penalty ρ (rows,) for the row scale E (rows,)."""
    return jnp.broadcast_to(default_rho(E, s.horizon * s.B.shape[-1]), E.shape)


@pytree
class Merit:
    """The merit function φ: its weights of defects (N, n) and of hard rows (rows,)."""

    defects: Array
    rows: Array

    def raised(self, defects: Array, rows: Array) -> "Merit":
        """Return the weights after Powell's rule, for multipliers of these sizes."""
        powell = lambda w, m: jnp.maximum(jnp.abs(m), (w + jnp.abs(m)) / 2)
        return Merit(powell(self.defects, defects), powell(self.rows, rows))

    def value(
        self, s: Stages, base: Stages, problem: NonlinearMPC, x: Array, u: Array
    ) -> tuple[Array, Array]:
        """Return φ at x, u and the sum of its terms' sizes; s: an expansion."""
        rows = rows_of(s, base, problem, x, u)
        gap = jax.vmap(problem.model.step)(x[:-1], u) - x[1:]
        parts = [
            total_cost(base, problem, x, u),
            jnp.sum(s.bounds.cost(rows)),
            jnp.sum(self.defects * jnp.abs(gap)),
            jnp.sum(self.rows * jnp.abs(s.bounds.violation(rows))),
        ]
        return jnp.sum(jnp.stack(parts)), jnp.sum(jnp.abs(jnp.stack(parts)))

    def decrease(self, s: Stages, dx: Array, du: Array) -> Array:
        """Return by how much φ falls along the whole step dx, du in the expansion."""
        x, u, bounds = s.aim.states, s.aim.inputs, s.bounds
        before, after = s.rows(x, u), s.rows(x + dx, u + du)
        outside = lambda v: jnp.sum(bounds.cost(v) + self.rows * jnp.abs(bounds.violation(v)))
        # The cost is quadratic: its change is the mean of the gradients at both ends.
        ends = zip(s.gradient(x, u), s.gradient(x + dx, u + du), strict=True)
        gx, gu = ((a + b) / 2 for a, b in ends)
        gaps = jnp.sum(self.defects * jnp.abs(defects(s, x, u)[0]))
        return outside(before) - outside(after) + gaps - jnp.sum(gx * dx) - jnp.sum(gu * du)


@pytree
class Iterate:
    """Loop state of one instance: x (N+1, n), u (N, m), multipliers y (rows,), the merit function,
    the QPs solved, whether the next may have the exact Hessian, and whether to go on."""

    x: Array
    u: Array
    y: Array
    merit: Merit
    steps: Array
    exact: Array
    open: Array

    @classmethod
    def begin(cls, x: Array, u: Array, y: Array, exact: bool) -> "Iterate":
        """Return the state before the first QP."""
        merit = Merit(jnp.zeros_like(x[1:]), jnp.abs(y))
        return cls(x, u, y, merit, jnp.int32(0), jnp.asarray(exact), jnp.asarray(True))


def costates(s: Stages, v: Array, y: Array) -> Array:
    """Return λ (N+1, n), the multipliers of x_0 … x_N, for moves v (N, m) and y (rows,):
    λ_k = ∂(J + y'rows)/∂x_k + A'λ_{k+1}, at fixed moves."""
    x = predict(s, v)
    g = s.at_fixed_moves(*jax.tree.map(jnp.add, s.gradient(x, s.inputs(x, v)), s.pull(y)))
    return jnp.concatenate([recurrence(s.closed, g[:-1], g[-1], adjoint=True), g[-1:]])


def defects(s: Stages, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return f(x_k, u_k) − x_{k+1} (N, n) at the point of expansion, what it is compared with, and
    its terms. A state that rests at 0 has no size but a small share of the latter."""
    parts = apply(s.A, x[:-1]), apply(s.B, u), s.c
    terms = dynamics_terms(s.A, s.B, s.c, x, u)
    sizes = sum(map(jnp.abs, parts), jnp.abs(x[1:])) + SHARE * jnp.max(terms, axis=0)
    return parts[0] + parts[1] + parts[2] - x[1:], sizes, terms


def nonlinear_residuals(s: Stages, E: Array, v: Array, y: Array) -> Terms:
    """Return the residuals of the nonlinear problem at the point of expansion: those of the
    expansion, with the defects among the rows; v (N, m): the moves there."""
    of_rows, *rest = stage_residuals(s, E, v, y)
    of_defects = defects(s, s.aim.states, s.aim.inputs)
    joined = [jnp.concatenate([a, b.ravel()]) for a, b in zip(of_rows, of_defects, strict=True)]
    return [(joined[0], joined[1], joined[2]), *rest]


def nonlinear_conditions(
    data: tuple[Stages, NonlinearMPC],
    constants: tuple[Array, Array, Array | None],
    z: Array,
    y: Array,
) -> tuple[Callable[[Any], Any], Undo]:
    """The `conditions_of` that `implicit` takes for the solution z, its states and inputs: those of
    the expansion about it, with the Hessian of the Lagrangian, and its states. constants: E, ρ and
    the gain of the moves.

    Of an expansion about a fixed point the gradients and states, which depend on the data, and this
    Hessian are the first derivatives of the optimality conditions of the nonlinear problem with
    respect to the data and to x, u. The point and the Hessian follow from data, z and y, so that
    derivatives of higher order are those of the nonlinear problem too.
    """
    x, u = _states_inputs(data[0], z)
    (base, problem), (E, rho, gain) = data, constants
    about = lambda data: replace(expanded(data[0], data[1], x, u), gain=gain)
    s = about(data)
    v = s.moves(x, u)
    lam = costates(s, v, s.bounds.admissible(y))
    exact = curved(s, base, problem, x, u, lam, y)
    # Elsewhere than at a strict minimum, as where the search has not ended, the exact one has no
    # solution: NaN would spoil the sums of a batch.
    convex = convex_with(*jax.lax.stop_gradient((exact, held(s, E, y))))
    bent = where_hessian(convex, exact, s)
    conditions, undo = stage_conditions(with_hessian(s, bent), (E, rho), v, y)

    def conditions_at(data: Any) -> tuple[Array, Array]:
        s = about(data)
        return conditions(with_hessian(s, bent)), predict(s, v)

    def undo_all(moved: tuple[Array, Array]) -> tuple[Array, Array]:
        dv, dy = undo(moved[0])
        follow = lambda dv: recurrence(s.closed, apply(s.B, dv), jnp.zeros_like(x[0]))
        # Linear; as a derivative of itself it can be transposed, kernels or not.
        dx = jax.jvp(follow, (jnp.zeros_like(dv),), (dv,))[1]
        dx = moved[1] + jnp.pad(dx, ((1, 0), (0, 0)))
        return jnp.concatenate([dx.ravel(), s.inputs(dx, dv).ravel()]), dy

    return conditions_at, undo_all


def _states_inputs(s: Stages, z: Array) -> tuple[Array, Array]:
    """Return states (N+1, n) and inputs (N, m) of the vector of both."""
    n, m = s.B.shape[-2:]
    states = (s.horizon + 1) * n
    return z[:states].reshape(-1, n), z[states:].reshape(-1, m)


def with_hessian(s: Stages, other: Stages) -> Stages:
    """Return the stages with the Hessian of others."""
    return replace(s, Q=other.Q, R=other.R, P=other.P, cross=other.cross)


def where_hessian(condition: Array, exact: Stages, s: Stages) -> Stages:
    """Return the stages s, with the Hessian of `exact` where the condition holds."""
    if s.cross is None:
        s = replace(s, cross=jnp.zeros((s.horizon, s.B.shape[-1], s.A.shape[-1]), s.P.dtype))
    chosen = jax.tree.map(lambda a, b: jnp.where(condition, a, b), with_hessian(s, exact), s)
    return with_hessian(s, chosen)


def sqp_step(most: int, hessian: str, constants: tuple, state: Iterate) -> Iterate:
    """Solve the QP about the iterate and go towards its solution; the search ends after `most` QPs,
    where the residuals are below a tenth of the tolerance, or where no step lowers the merit.

    hessian="exact": after a full step, and from the first QP on about a warm start, the QP has the
    Hessian of the Lagrangian, if that is convex with the active rows held. It is then solved by
    Newton steps on the active rows alone, and where that fails the step after takes Gauss and
    Newton's again.
    """
    base, problem, scale, eps = constants
    x, u, y = state.x, state.u, state.y
    s, E = scaled(expanded(base, problem, x, u), scale)
    rho, y, v = penalty(s, E), s.bounds.admissible(y), s.moves(x, u)
    residuals, floor = nonlinear_residuals, rounding(x.dtype)
    measure = lambda s, E, v, y, eps: Measured.of(residuals(s, E, v, y), eps, floor)
    solved = precisely(measure, s, E, v, y, eps / 10).within_tolerance
    exact = jnp.asarray(False)
    if hessian == "exact":
        bent = curved(s, base, problem, x, u, costates(s, v, y), y)
        exact = state.exact & convex_with(bent, held(s, E, y))
        s = where_hessian(exact, bent, s)
    fixed = s.bounds.unmoved(E, s.rows(x, u))
    v_qp, y_qp, usable = precisely(solved_qp, s, E, rho, fixed, eps, v, y, exact)

    merit = state.merit.raised(costates(s, v_qp, y_qp)[1:], y_qp)
    whole_steps = corrected(s, base, problem, E, rho, v_qp, y_qp)
    search, predicted, slack = line_search(merit, s, base, problem, whole_steps)
    go = ~solved & search.found & jnp.all(jnp.isfinite(v_qp))
    go = go & (~exact | (usable & (predicted > -slack)))
    length = search.length
    step = lambda v, d: v + jnp.where(go, d, 0.0)
    x, u, y = step(x, search.step[0]), step(u, search.step[1]), step(y, length * (y_qp - y))
    count = state.steps + ~solved
    exact_next, open_ = go & usable & (length == 1), ~solved & (go | exact) & (count < most)
    return Iterate(x, u, y, merit, count, exact_next, open_)


@pytree
class LineSearch:
    """Loop state of a line search: the part of the step that was tried last, the step in states
    (N+1, n) and inputs (N, m) for it, the attempts made, and whether it is good."""

    length: Array
    step: tuple[Array, Array]
    attempt: Array
    found: Array


def corrected(
    s: Stages, base: Stages, problem: NonlinearMPC, E: Array, rho: Array, v: Array, y: Array
) -> tuple[Array, Array]:
    """Return whole steps in states (3, N+1, n) and inputs (3, N, m): to the solution v, y of the QP
    s; the same moves with states that close its defects to first order; and what a Newton step
    leads to on the QP whose dynamics and rows have the values of the model there.

    Near a solution the defects and violations of whole steps, second-order terms times large
    weights, exceed what the cost gains (Maratos 1978; second-order corrections: Nocedal, Wright
    2006, §18.3).
    """
    x = predict(s, v)
    u = s.inputs(x, v)
    gap = jax.vmap(problem.model.step)(x[:-1], u) - x[1:]
    bend = rows_of(s, base, problem, x, u) - s.rows(x, u)
    bounds = replace(s.bounds, l=s.bounds.l - bend, u=s.bounds.u - bend)
    there = replace(s, c=s.c + gap, bounds=bounds)
    v_there, _ = precisely(stage_newton_step, there, E, rho, v, y)
    moves = jnp.stack([v, v, v_there])
    states = jnp.stack([x, predict(there, v), predict(there, v_there)])
    return states - s.aim.states, jax.vmap(s.inputs)(states, moves) - s.aim.inputs


def line_search(
    merit: Merit,
    s: Stages,
    base: Stages,
    problem: NonlinearMPC,
    whole_steps: tuple[Array, Array],
) -> tuple[LineSearch, Array, Array]:
    """Return where the search ends for a step that lowers the merit by a part of what the expansion
    predicts, the decrease predicted, and its rounding.

    The whole steps are tried first, one after the other, then half of the first and so on.
    """
    x, u = s.aim.states, s.aim.inputs
    value = partial(merit.value, s, base, problem)
    step = whole_steps[0][0], whole_steps[1][0]
    (now, size), predicted = value(x, u), merit.decrease(s, *step)
    slack = 10 * jnp.finfo(x.dtype).eps * size

    def attempt(search: LineSearch) -> LineSearch:
        k = search.attempt
        count = len(whole_steps[0])
        length = jnp.where(k < count, 1.0, search.length / 2)
        dx, du = (length * v[jnp.where(k < count, k, 0)] for v in whole_steps)
        after, _ = value(x + dx, u + du)
        found = after <= now - DECREASE * length * predicted + slack
        return LineSearch(length, (dx, du), k + 1, found)

    begin = LineSearch(jnp.ones((), x.dtype), step, jnp.int32(0), jnp.asarray(False))
    go_on = lambda search: ~search.found & (search.length > SHORTEST)
    return jax.lax.while_loop(go_on, attempt, varying(begin, x)), predicted, slack


def solved_qp(
    s: Stages,
    E: Array,
    rho: Array,
    fixed: Array,
    eps: Array,
    v: Array,
    y: Array,
    exact: Array,
) -> tuple[Array, Array, Array]:
    """Return the solution of a QP from v (N, m), y (rows,), and whether it is one: Newton steps,
    and after them, unless `exact`, interior point steps."""

    def loop(step: Callable, most: int, constants: tuple, state: Any) -> Any:
        is_open, step = (lambda state: state.open), partial(step, constants)
        return jax.lax.while_loop(is_open, step, varying(state, (state, constants)))

    search = Search(NEWTON_STEPS, INTERIOR_STEPS, loop)
    best = search.from_pair(s, E, rho, fixed, eps, measured_pair(eps, s, E, v, y), ~exact)
    return best.z, best.y, best.measured.within_tolerance


def held(s: Stages, E: Array, y: Array) -> Array:
    """Return large weights (rows,) for the rows that multipliers y hold at their limits, 0 for
    others: soft rows beyond their limits give way."""
    push = jnp.abs(scaled_multipliers(E, y))
    active = push > HELD * jnp.max(push, initial=0.0)
    if s.bounds.linear is not None:
        active = active & (jnp.abs(y) < (1 - 1e-6) * s.bounds.linear)
    return Constants.of(y.dtype).linear * E**2 * active


def convex_with(s: Stages, weights: Array) -> Array:
    """Return whether the cost with penalties ½ weights·row² is strictly convex in the inputs: all G
    of the recursion are definite."""
    inverse = riccati(s, weights).inverse
    roots = jax.vmap(cholesky)((inverse + jnp.swapaxes(inverse, -1, -2)) / 2)
    return jnp.all(jnp.isfinite(roots))
