"""MPC stage by stage, for A, B, c that differ for every problem of a batch or at every step.

ADMM's iteration is that of `qp/admm.py` on the condensed QP, the iterates are the same; only the
condensed matrices are never formed. A step needs "linear terms on the rows, minimise the quadratic
with its penalties", the LQR problem of `stages.py` with W = diag(ρE²): a backward and a forward
pass over the stages, where the dense step reads a matrix of (rows)² entries. Newton steps on the
active rows follow, a Riccati recursion each, and where these do not end at the solution an interior
point method (`interior_point.py`).

The row scale E of `qp/admm.scale` makes the rows a_i of all inputs one unit long in the metric of
the Hessian: 1/E_i² = a_i' P⁻¹ a_i. P⁻¹ is the covariance of inputs drawn with density exp(−J): by
the same recursion without penalties u_k = K x_k + e_k with e_k of covariance G⁻¹, hence that of x_k
runs forward, Σ⁺ = (A + BK) Σ (A + BK)' + B G⁻¹ B' from Σ_0 = 0.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from jaxmpc.arrays import Reals, as_array, host_array
from jaxmpc.checks import concrete, fail, require_finite, require_kind
from jaxmpc.mpc.plan import Plan, WarmStart, answer
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import layout
from jaxmpc.mpc.stagewise.interior_point import STEPS, Interior, interior_step
from jaxmpc.mpc.stagewise.riccati import Gains
from jaxmpc.mpc.stagewise.stages import (
    Sample,
    Stages,
    at,
    cleaned,
    conditions,
    judged,
    minimise,
    predict,
    riccati,
    stage_residuals,
    stages,
    unconstrained,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import (
    ADMM,
    DEFAULT,
    Splitting,
    default_rho,
    iterate,
    scaled_multipliers,
    start,
)
from jaxmpc.qp.certificate import Proof
from jaxmpc.qp.derivative import Undo, implicit
from jaxmpc.qp.loops import repeat_while
from jaxmpc.qp.modes import own_modes, varying
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.precision import arrays, matmul, precisely
from jaxmpc.qp.problem import QPSolution
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.residuals import Measured, Pair, assess, with_status
from jaxmpc.qp.solve import tolerance
from jaxmpc.qp.status import Status
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.systems.system import LinearSystem

# Most stages that the passes of an ADMM step write out, without a loop over them. Loops reorder
# (batch, N, …) to (N, batch, …) at each step, which takes longer than the products.
UNROLL = 32
# Newton steps before the interior point method, where ADMM.newton_steps is None.
NEWTON_STEPS = 6


def solve_stagewise(
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    solver: ADMM = DEFAULT,
    warm_start: Plan | WarmStart | None = None,
    *,
    input_reference: Reals | None = None,
    scale: ArrayLike | None = None,
) -> Plan:
    """Solve an MPC problem stage by stage from the state x0 (n,): what takes the least time where
    the system is another one in each problem, or at each step.

    A (n, n), B (n, m) and c (n,) of mpc.system may have a leading axis N:
    x_{k+1} = A_k x_k + B_k u_k + c_k. `replace(mpc, system=...)` puts a system into a problem.

    x0, references, solver and the Plan are those of `solve`, and so is the status: residuals and
    gap of the returned inputs and multipliers, evaluated from the data in float64. What differs:
    no infeasibility is proved (a problem without a solution ends as ITERATION_LIMIT: soften the
    rows that may not hold). Derivatives with respect to every array of data are those of
    solver.differentiate. warm_start: an earlier Plan or a WarmStart, whose states are not read.
    solver.newton_steps: at most so many, a Riccati recursion each; 5 suffice where ADMM, or the
    warm start, has found the active rows. None: 6, after them an interior point method where they
    have not ended at the solution (its steps need rows with l < u), and 6 again; all in float64.
    mpc.prestabilise is not read: the inputs are the variables, so a plant that grows more than
    1e5-fold over the horizon in open loop has residuals above eps by rounding alone; `solve` takes
    those. scale (rows,): the row scale of a similar problem
    (`factor_stages(...).E`), which saves a Riccati recursion; it changes the path, not the answer.
    A row of scale 0 counts as one that no input moves: where that is not so, the plan does not
    become SOLVED.

    `jax.vmap` over x0, references or the arrays of `mpc`, its system's among them. Raises
    ValueError for bad data that can be read, and for what only `solve` supports: Ellipsoids,
    control horizons, input rates.
    """
    factor = factor_stages(mpc, solver, scale)
    return plan_stages(
        factor, mpc, x0, reference, solver, warm_start, input_reference=input_reference
    )


def factor_stages(
    mpc: MPC, solver: ADMM = DEFAULT, scale: ArrayLike | None = None
) -> "StageFactor":
    """What x0, references and warm start do not change: row scale and Riccati gains.

    Arguments and errors as in `solve_stagewise`; `plan_stages` does the rest.
    """
    mpc = checked(mpc, solver)
    rows = sum(len(steps) * size for _, steps, size in layout(mpc))
    if scale is not None and np.shape(scale) != (rows,):
        fail("scale", f"shape {np.shape(scale)}", f"Give ({rows},), one number a row")
    return _factor(*arrays((mpc, solver.rho, scale)), steps=solver.admm_steps() > 0)


def checked(mpc: MPC, solver: ADMM) -> MPC:
    """The problem without prestabilising gain; ValueError for what is wrong with it or the solver,
    and for what is not solved stage by stage."""
    require_kind("mpc", mpc, MPC)
    system = mpc.system
    require_kind("system", system, LinearSystem)
    for name, found in (
        ("terminal_set is an Ellipsoid", isinstance(mpc.terminal_set, Ellipsoid)),
        ("control_horizon is given", mpc.control_horizon is not None),
        ("input rates are limited or weighed", mpc.input_in_state),
    ):
        if found:
            fail("mpc", name, "Stage by stage there is no such thing: use jm.solve")
    first: dict[str, Any] = {}
    for name, dimensions in (("A", 2), ("B", 2), ("c", 1)):
        value = getattr(system, name)
        if value is None:
            continue
        if concrete(value):
            require_finite(name, host_array(name, value))
        value = as_array(value)
        shape = np.shape(value)
        staged = len(shape) == dimensions + 1
        if staged and shape[0] != mpc.horizon:
            fail(name, f"shape {shape}", f"A leading axis counts the {mpc.horizon} steps")
        first[name] = value[0] if staged and shape[0] else value
    at_first = replace(mpc, system=replace(system, **first), prestabilise=None)
    at_first.validate()
    at_first.require_unique_inputs()  # the recursion divides by R + B'SB
    solver.validate(sum(len(steps) * size for _, steps, size in layout(mpc)))
    return replace(mpc, prestabilise=None)


@pytree
class StageFactor:
    """What data and penalties decide: row scale E (rows,), 0 for a row that no input moves; rho
    (S, rows) with the gains of each of the S penalties of a schedule, None where there are no ADMM
    steps; fault: NOT_RUN where the data are usable, else the status that says why not."""

    stages: Stages
    E: Array
    rho: Array
    gains: Gains | None
    fault: Array


@partial(jax.jit, static_argnames="steps")
@own_modes
def _factor(mpc: MPC, rho: Any, scale: Any, steps: bool) -> StageFactor:
    s, fault = cleaned(stages(mpc))
    E = row_scale(s) if scale is None else jnp.asarray(scale, s.Q.dtype)
    inputs = s.horizon * s.B.shape[-1]
    rho = default_rho(E, inputs) if rho is None else jnp.asarray(rho, E.dtype)
    rho = jnp.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, E.shape[0]))
    gains = jax.lax.map(lambda rho: riccati(s, rho * E**2), rho) if steps else None
    # Finite data can still overflow, or be too near singular for their precision.
    leaves = jax.tree.leaves((E, gains))
    sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in leaves]))
    E, gains = jax.tree.map(lambda v: jnp.where(sound, v, 0.0), (E, gains))
    return StageFactor(s, E, rho, gains, jnp.where(sound, fault, jnp.int32(Status.ITERATION_LIMIT)))


def row_scale(s: Stages) -> Array:
    """E (rows,): 1/E² is the variance of the row under exp(−J); 0 where that is zero."""
    gains = riccati(s)

    def forward(Sigma: Array, stage: tuple) -> tuple[Array, Array]:
        (closed, _, inverse), B = stage
        B = s.B if B is None else B
        spread = matmul(B, matmul(inverse, B.T))
        return matmul(closed, matmul(Sigma, closed.T)) + spread, Sigma

    start = jnp.zeros_like(s.P)
    last, Sigma = jax.lax.scan(forward, start, (gains, *s.varying("B")))
    Sigma = jnp.concatenate([Sigma, last[None]])
    variance, own = [jnp.zeros(0, s.Q.dtype)], [jnp.zeros(0, s.Q.dtype)]
    square = lambda M, V: jnp.sum(matmul(M, V) * M, axis=-1)
    deviation = lambda V: jnp.sqrt(jnp.maximum(jnp.diagonal(V, axis1=-2, axis2=-1), 0.0))
    for _, steps, _, H, D, _ in s.blocks():
        # H x + D (K x + e), e of covariance G⁻¹.
        F: Any = 0.0 if H is None else H
        noise: Any = 0.0
        V = at(Sigma, steps)
        if D is not None:
            K, inverse = at(gains.K, steps), at(gains.inverse, steps)
            F, noise = F + matmul(D, K), square(D, inverse)
        value = square(F, V) + noise
        size = jnp.sum(jnp.abs(F) * deviation(jax.lax.stop_gradient(V))[:, None, :], axis=-1) ** 2
        variance.append(value.ravel())
        own.append((size + noise).ravel())
    squared, terms = jnp.concatenate(variance), jnp.concatenate(own)
    # A row is zero when it is rounding noise, of its own terms or beside the others.
    eps = jnp.finfo(squared.dtype).eps
    noise = jnp.maximum((100 * eps) ** 2 * terms, eps**2 * jnp.max(squared, initial=0.0))
    zero = squared <= noise
    return jnp.where(zero, 0.0, 1 / jnp.sqrt(jnp.where(zero, 1.0, squared)))


def splittings(
    factor: StageFactor, sample: Sample, unroll: int = 1
) -> tuple[list[Splitting], list[tuple[Array, Array]]]:
    """The splitting of each penalty of the schedule, and the x (N+1, n) and u (N, m) of least cost
    with that penalty on the rows alone. Bounds and E·row include what x0 and c put into the rows;
    in the condensed QP they are moved by that."""
    s, E = factor.stages, factor.E
    made, ends = [], []
    for i, rho in enumerate(factor.rho):
        gains = jax.tree.map(lambda v, i=i: v[i], factor.gains)
        free = unconstrained(s, gains, rho * E**2, sample)

        def image(r: Array, rho: Array = rho, gains: Gains = gains) -> Array:
            return E * s.rows(*minimise(s, gains, *s.pull(rho * E * r), unroll))

        made.append(Splitting(rho, image, E * s.rows(*free)))
        ends.append(free)
    return made, ends


def read(
    factor: StageFactor, bounds: Bounds, t: Array, free: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Inputs u (N, m) and multipliers y (rows,) that t stands for at the last penalty."""
    s, E, rho = factor.stages, factor.E, factor.rho[-1]
    gains = jax.tree.map(lambda v: v[-1], factor.gains)
    p = bounds.project(t, rho)
    x, u = (
        a + b for a, b in zip(free, minimise(s, gains, *s.pull(rho * E * (2 * p - t))), strict=True)
    )
    # A soft row that no input moves gets its penalty's gradient as multiplier: the gap closes.
    y = jnp.where(E == 0, s.bounds.penalty_gradient(s.rows(x, u)), E * rho * (t - p))
    return u, s.bounds.admissible(y)


@pytree
class Search:
    """Loop state of one instance: inputs u (N, m) and multipliers y (rows,) of the last Newton
    step, the best pair of all so far, the steps taken, and whether to go on."""

    u: Array
    y: Array
    best: Pair
    steps: Array
    open: Array


def newton_step(
    s: Stages, sample: Sample, E: Array, rho: Array, u: Array, y: Array
) -> tuple[Array, Array]:
    """Semismooth Newton on the optimality conditions from inputs u (N, m), multipliers y (rows,).

    In scaled rows v, multipliers y/E and with the residual e(v) = v − prox(v) of `projection.py`
    the conditions are gradient = 0 and e(v + y/ρ) = y/ρ. With the derivative D of e a step asks

        gradient + P du + rows'dy = 0,        dy (1 − D)/ρ = D dv + c,    c = e − y/ρ.

    Where D = 1 (a row held at its bound) 0·dy becomes dy/κ with a large κ, a proximal step on y:
    dy = ω dv + ω_c c, with ω = ρ D/(1 − D + D ρ/κ) and ω_c = ρ/(1 − D + D ρ/κ). What is left is an
    LQR problem with penalties ω. Rows are held by v + y/ρ of ADMM's own ρ, so that κ does not
    disturb the guess; it costs accuracy only within a step, since each starts from residuals of
    the data.
    """
    v, c, gradient = errors(s, sample, E, rho, u, y)
    D = s.bounds.scaled(E).curvature(v, rho)[0]
    du, dy = newton(s, E, rho, D)(c, gradient)
    return u + du, y + dy


def search_step(most: int, constants: tuple, state: Search) -> Search:
    """One Newton step; the search ends after `most`, or below a thousandth of eps."""
    s, sample, E, rho, eps = constants
    u, y = newton_step(s, sample, E, rho, state.u, state.y)
    pair = judged(eps, s, sample, u, y)
    best, steps = state.best.or_better(pair), state.steps + 1
    return Search(u, y, best, steps, ~(best.near | best.solved) & (steps < most))


def errors(
    s: Stages, sample: Sample, E: Array, rho: Array, u: Array, y: Array
) -> tuple[Array, Array, Array]:
    """v + y/ρ, c and the gradient, see `newton_step`."""
    found, push = conditions(s, sample, u, y), scaled_multipliers(E, y) / rho
    v = E * found.rows + push
    return v, s.bounds.scaled(E).prox_residual(v, rho) - push, found.gradient


def distance(s: Stages, sample: Sample, E: Array, rho: Array, u: Array, y: Array) -> Array:
    """Return how far the conditions of `newton_step` are from holding, a number in units of the
    cost: Σ ρ c², c in rows of variance 1 under exp(−J), and Σ gradient²/R over the inputs.

    Beside a hundred times that of zero it tells a warm start from numbers that are none, such as
    the plan of a state far off.
    """
    _, c, gradient = errors(s, sample, E, rho, u, y)
    weight = jnp.diagonal(s.R, axis1=-2, axis2=-1) * s.stage[:, None]
    return jnp.sum(rho * c**2) + jnp.sum(gradient**2 / jnp.where(weight > 0, weight, 1.0))


def newton(s: Stages, E: Array, rho: Array, D: Array) -> Callable[[Array, Array], Any]:
    """(c, gradient) → (du, dy) of `newton_step`: linear."""
    loose = 1 - D + D * rho / Constants.of(E.dtype).linear
    omega = rho * D / loose
    gains = riccati(s, omega * E**2)

    def step(c: Array, gradient: Array) -> tuple[Array, Array]:
        push = rho * c / loose
        gx, gu = s.pull(E * push)
        dx, du = minimise(s, gains, -gx, -gu - gradient)
        return du, E * (omega * E * s.rows(dx, du) + push)

    return step


def stage_conditions(
    data: tuple[Stages, Sample], constants: tuple[Array, Array], u: Array, y: Array
) -> tuple[Callable[[Any], Any], Undo]:
    """The `conditions_of` that `qp.derivative.implicit` takes for (stages, sample) and (E, ρ).

    The conditions F(data, u, y) = 0 of `newton_step` hold at a solution, hence J d(u, y) = −dF with
    the matrix J of a Newton step: one Riccati recursion, whatever the number of iterations. Rows
    that touch with a zero multiplier count as inactive, as in `qp/derivative.py`.
    """
    (s, sample), (E, rho) = data, constants
    v, c, gradient = errors(s, sample, E, rho, u, y)
    step = newton(s, E, rho, s.bounds.scaled(E).curvature(v, rho)[0])

    def follow(moved: Any) -> Any:
        # The step is linear; as a derivative of itself it can be transposed, kernels or not.
        return jax.jvp(step, (c, gradient), tuple(moved))[1]

    def undo(moved: Any) -> tuple[Array, Array]:
        # What the proximal step on y leaves, of relative size ρ/κ, is taken up by a second step.
        first = follow(moved)
        of_pair = lambda u, y: errors(s, sample, E, rho, u, y)[1:]
        left = jax.jvp(of_pair, (u, y), first)[1]
        return jax.tree.map(jnp.add, first, follow(jax.tree.map(jnp.add, moved, left)))

    return lambda data: errors(data[0], data[1], E, rho, u, y)[1:], undo


def plan_stages(
    factor: StageFactor, mpc: MPC, x0: Any, reference: Any = None, solver: ADMM = DEFAULT,
    warm_start: Any = None, *, input_reference: Any = None,
) -> Plan:  # fmt: skip
    """The rest of `solve_stagewise`, for the same mpc and solver; mpc.system is not read."""
    s, dtype = factor.stages, factor.E.dtype
    N, n, m = s.horizon, s.A.shape[-1], s.B.shape[-1]
    if np.shape(x0) != (n,):
        fail("x0", f"shape {np.shape(x0)}", f"Give one state ({n},); use jax.vmap for many")
    aims = []
    for name, value, shape in (
        ("reference", reference, (N + 1, n)), ("input_reference", input_reference, (N, m))
    ):  # fmt: skip
        value = jnp.zeros(shape[1:], dtype) if value is None else value
        if np.shape(value) not in (shape[1:], shape):
            fail(name, f"shape {np.shape(value)}", f"Give {shape[1:]} or {shape}")
        aims.append(jnp.broadcast_to(jnp.asarray(value, dtype), shape))
    if warm_start is not None:
        warm_start = WarmStart.of(warm_start, s.layout, N, n, m)
    mpc = replace(mpc, prestabilise=None)
    sample = Sample(jnp.asarray(x0, dtype), *aims)
    return _plan(*arrays((factor, mpc, solver, sample, warm_start)))


@jax.jit
@own_modes
def _plan(factor: StageFactor, mpc: MPC, solver: ADMM, sample: Sample, warm_start: Any) -> Plan:
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(sample)]))
    fault = jnp.where(finite, factor.fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    sample = jax.tree.map(lambda v: jnp.where(jnp.isfinite(v), v, 0), sample)
    # Only cost and slack are read from the problem as given.
    mpc = jax.tree.map(lambda v: jnp.where(usable, v, 0), mpc)
    if solver.differentiate == "implicit":
        constants = jax.lax.stop_gradient((factor, sample, solver, warm_start))
        fixed = constants[0].E, constants[0].rho[-1]
        u, y, measured = solution(*constants)
        u, y = implicit(stage_conditions, (factor.stages, sample), fixed, u, y)
    else:
        u, y, measured = solution(factor, sample, solver, warm_start)
    s = factor.stages
    found = stated(solver, s, sample, u, y, measured)
    found = replace(found, iterations=jnp.int32(solver.admm_steps()))
    x = predict(s, sample.x0, u)
    return answer(mpc, s.layout, found, fault, x, u, sample.states, sample.inputs)


def stated(
    solver: ADMM, s: Stages, sample: Sample, u: Array, y: Array, measured: Measured | None
) -> QPSolution:
    """Return the solution with its status: what was measured of the float64 pair that Newton steps
    end at, before it was rounded, or where there were none what is measured of this pair."""
    none = Proof.none(u, y)
    if measured is not None:
        return with_status(measured, u, y, none)
    return assess(stage_residuals, (s, sample), u, y, none, tolerance(solver, u.dtype))


def solution(
    factor: StageFactor, sample: Sample, solver: ADMM, warm_start: WarmStart | None
) -> tuple[Array, Array, Measured | None]:
    """Inputs u (N, m) and multipliers y (rows,): ADMM, Newton steps, interior point method; and
    what was measured of them where Newton steps end at them."""
    s, E, rho = factor.stages, factor.E, factor.rho
    u, y = jnp.zeros((s.horizon, s.B.shape[-1]), E.dtype), jnp.zeros_like(E)
    if warm_start is not None:  # what is not finite counts as 0
        clean = lambda v: jnp.nan_to_num(jnp.asarray(v, E.dtype), posinf=0.0, neginf=0.0)
        given = clean(warm_start.inputs), clean(warm_start.multipliers)
        far = lambda pair: jax.lax.stop_gradient(distance(s, sample, E, rho[-1], *pair))
        near = far(given) <= 100 * far((u, y))
        u, y = (jnp.where(near, v, 0.0) for v in given)
    rows = s.rows(predict(s, sample.x0, u), u)
    fixed = jnp.where(E == 0, s.bounds.penalty_gradient(rows), 0.0)
    if factor.gains is not None:
        bounds, v = s.bounds.scaled(E), E * rows
        t = v if warm_start is None else start(bounds, rho[0], v, scaled_multipliers(E, y))
        schedule, free = splittings(factor, sample, min(s.horizon, UNROLL))
        t, _ = iterate(schedule, bounds, t, solver.admm_steps(), solver.alpha)
        u, y = read(factor, bounds, t, free[-1])
    y = jnp.where(E == 0, fixed, y)
    newton, measured = solver.most_newton_steps(NEWTON_STEPS), None
    if newton and solver.differentiate == "unrolled":
        step = lambda pair, _: (newton_step(s, sample, E, rho[-1], *pair), None)
        u, y = jax.lax.scan(step, (u, y), length=newton)[0]
        y = s.bounds.admissible(y)
    elif newton:
        eps = tolerance(solver, u.dtype)
        last = STEPS if solver.newton_steps is None else 0
        search = partial(refined, newton, last, solver.fixed)
        u, y, measured = precisely(search, s, sample, E, rho[-1], fixed, eps, u, y)
    return u, y, measured


def refined(
    newton: int, interior: int, constant: bool, s: Stages, sample: Sample, E: Array, rho: Array,
    fixed: Array, eps: Array, u: Array, y: Array,
) -> tuple[Array, Array, Measured]:  # fmt: skip
    """The best pair, and what was measured of it, after `newton` Newton steps from u (N, m), y
    (rows,), and where that is not good enough `interior` interior point steps and Newton steps
    again, at most; constant: always as many."""

    def repeated(step: Callable, most: int, constants: tuple, state: Any) -> Pair:
        step = partial(step, most)
        if constant:
            again = lambda state, _: (step(constants, state), None)
            return jax.lax.scan(again, state, length=most)[0].best
        return repeat_while(lambda state: state.open, step, constants, state, "stages").best

    def round_(best: Pair, first: Array) -> tuple[Pair, None]:
        state = Search(best.z, best.y, best, jnp.int32(0), ~(best.near | best.solved))
        best = repeated(search_step, newton, (s, sample, E, rho, eps), state)
        if interior:
            begun = Interior.begin(best)
            begun = replace(begun, open=begun.open & first)
            best = repeated(interior_step, interior, (s, sample, E, fixed, eps), begun)
        return best, None

    best = judged(eps, s, sample, u, y)
    # Weights of rows that are held grow until rounding stops the interior point method; Newton's
    # are bounded. As a loop, so that both are compiled once.
    rounds = jnp.arange(2 if interior else 1) == 0
    best, _ = jax.lax.scan(round_, varying(best, (best, s, sample, fixed)), rounds)
    return best.z, best.y, best.measured
