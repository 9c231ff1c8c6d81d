"""MPC stage by stage, for A, B, c that differ for every problem of a batch or at every step.

ADMM's iteration is that of `qp/admm.py` on the condensed QP, the iterates are the same; only the
condensed matrices are never formed. A step needs "linear terms on the rows, minimise the quadratic
with its penalties", the LQR problem of `stages.py` with W = diag(ρE²): a backward and a forward
pass over the stages, where the dense step reads a matrix of (rows)² entries. Newton steps on the
active rows follow, a Riccati recursion each, and where these do not end at the solution an interior
point method (`newton_steps.py`).

The row scale E of `qp/admm.scale` makes the rows a_i of all inputs one unit long in the metric of
the Hessian: 1/E_i² = a_i' P⁻¹ a_i. P⁻¹ is the covariance of inputs drawn with density exp(−J): by
the same recursion without penalties u_k = K x_k + e_k with e_k of covariance G⁻¹, hence that of x_k
runs forward, Σ⁺ = (A + BK) Σ (A + BK)' + B G⁻¹ B' from Σ_0 = 0.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals, all_finite, as_array
from jaxmpc.checks import fail, require_kind, require_memory
from jaxmpc.mpc.plan import Aim, Plan, WarmStart, answer, checked_aim, require_warm_start
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import at, layout, row_count
from jaxmpc.mpc.stagewise.affine_policies import (
    affine_plan,
    answers_disturbances,
    bytes_needed,
    require_independent_generators,
)
from jaxmpc.mpc.stagewise.newton_steps import (
    INTERIOR_STEPS,
    Search,
    distance,
    stage_conditions,
    stage_newton_step,
)
from jaxmpc.mpc.stagewise.recursion_kernels import Gains, covariances
from jaxmpc.mpc.stagewise.stages import (
    Stages,
    cleaned,
    measured_pair,
    minimise,
    predict,
    riccati,
    rows_under,
    stage_residuals,
    unconstrained,
)
from jaxmpc.mpc.tightening import with_gain, without_disturbance
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
from jaxmpc.qp.jax_transformations import implicit, own_modes, repeat_while, varying
from jaxmpc.qp.linalg import arrays, matmul, precisely
from jaxmpc.qp.problem import Bounds, QPSolution
from jaxmpc.qp.residuals import Measured, Pair, Proof, assess, with_status
from jaxmpc.qp.solve import tolerance
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Ellipsoid
from jaxmpc.sets.disturbances import is_centred

# Most stages that the passes of an ADMM step write out, without a loop over them. Loops reorder
# (batch, N, …) to (N, batch, …) at each step, which takes longer than the products.
UNROLL = 32
# ADMM steps, where ADMM.iterations is None and Newton steps follow.
ADMM_STEPS = 20
# Newton steps before the interior point method and after it, and steps of all three where
# ADMM.newton_steps is None.
NEWTON_STEPS = 6
MOST_STEPS = 2 * NEWTON_STEPS + INTERIOR_STEPS
# Growth of states over the horizon from which on the variables are moves: two digits of them.
GROWTH = 100.0


def solve_stagewise(
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    solver: ADMM = DEFAULT,
    warm_start: Plan | WarmStart | None = None,
    *,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
    scale: Reals | None = None,
) -> Plan:
    """Solve an MPC problem stage by stage from the state x0 (n,): what takes the least time where
    the system is another one in each problem, or at each step.

    A (n, n), B (n, m) and c (n,) of mpc.system may have a leading axis N, as for `solve`.
    `replace(mpc, system=...)` puts a system into a problem.

    x0, references, previous_input, solver and the Plan are those of `solve`, and so is the status:
    residuals and gap of the returned inputs and multipliers, evaluated from the data in float64.
    What differs: no infeasibility is proved (a problem without a solution ends as ITERATION_LIMIT:
    soften the rows that may not hold). Derivatives with respect to every array of data are those of
    solver.differentiate. warm_start: an earlier Plan or a WarmStart.
    solver.newton_steps: at most so many, a Riccati recursion each, in float64; 5 suffice where
    ADMM, or the warm start, has found the active rows. After the first 6, where these have not
    ended at the solution, come steps of an interior point method, which need rows with l < u, and
    the last 6 are Newton steps again. None: 72.
    Predictions of unstable systems lose no digits: their variables are v, with inputs u = K x + v
    by the gains of least cost without rows (mpc.prestabilise is not read).
    scale (rows,): the row scale of a similar problem (`factor_stages(...).E`), which saves a
    Riccati recursion; it changes the path, not the answer. Without that recursion there is no K:
    give no scale for a system that grows 1e5-fold over the horizon. A row of scale 0 counts as one
    that no input moves: where that is not so, the plan does not become SOLVED.

    Disturbances: with policy="tightened" as above. With "affine" (a Box, or a Zonotope of
    independent generators) plan.feedback is M, found together with the plan by an interior point
    method whose size does not grow with N² variables (`affine_policies.py`), in float64, from a
    cold start; solver.newton_steps: at most so many of its steps, None: 60. SOLVED: the policy
    keeps all rows for every w, and its plan is the one of least cost, both to the tolerance.
    INACCURATE: it keeps all rows, and may be followed, but is not shown to be the best.
    ITERATION_LIMIT: neither. It has no derivatives.

    `jax.vmap` over x0, references or the arrays of `mpc`, its system's among them. Raises
    ValueError for bad data that can be read, and for what only `solve` supports: Ellipsoids,
    control horizons, tubes.
    """
    require_kind("mpc", mpc, MPC)
    mpc.require_sizes()
    checked_aim(mpc, x0, reference, input_reference, previous_input)  # before any compile
    require_warm_start(warm_start)
    factor = factor_stages(mpc, solver, scale)
    aim = {"input_reference": input_reference, "previous_input": previous_input}
    return plan_stages(factor, mpc, x0, reference, solver, warm_start, **aim)


def factor_stages(mpc: MPC, solver: ADMM = DEFAULT, scale: Reals | None = None) -> "StageFactor":
    """What x0, references and warm start do not change: row scale and Riccati gains.

    Arguments and errors as in `solve_stagewise`; `plan_stages` does the rest.
    """
    mpc = checked(mpc, solver)
    rows = row_count(layout(mpc))
    require_row_scale(scale, rows)
    answers = answers_disturbances(mpc)
    steps = solver.admm_steps(ADMM_STEPS) > 0 and not answers
    mpc = without_disturbance(mpc) if answers else mpc
    return _factor(*arrays((mpc, solver.rho, scale)), steps=steps)


def require_row_scale(scale: Reals | None, rows: int) -> None:
    """Raise ValueError unless a row scale has a number for each row."""
    shape = (rows,) if scale is None else np.shape(as_array(scale))
    if shape != (rows,):
        fail("scale", f"shape {shape}", f"Give ({rows},), one number a row")


def checked(mpc: MPC, solver: ADMM) -> MPC:
    """The problem without prestabilising gain; ValueError for what is wrong with it or the solver,
    and for what is not solved stage by stage."""
    require_kind("mpc", mpc, MPC)
    for name, found in (
        ("terminal_set is an Ellipsoid", isinstance(mpc.terminal_set, Ellipsoid)),
        ("control_horizon is given", mpc.control_horizon is not None),
        ("policy is 'tube'", mpc.disturbance is not None and mpc.policy == "tube"),
    ):
        if found:
            fail("mpc", name, "Stage by stage there is no such thing: use jm.solve")
    mpc = replace(mpc, prestabilise=None)
    mpc.validate()
    if answers_disturbances(mpc):
        require_independent_generators(mpc.disturbance)
        require_memory("horizon", bytes_needed(mpc), "Give fewer steps, or another policy")
    mpc = with_gain(mpc)
    mpc.require_unique_inputs()  # the recursion divides by R + B'SB
    solver.validate(row_count(layout(mpc)))
    return mpc


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
    s, fault = cleaned(Stages.of(mpc))
    s, E = scaled(s, scale)
    inputs = s.horizon * s.B.shape[-1]
    rho = default_rho(E, inputs) if rho is None else jnp.asarray(rho, E.dtype)
    rho = jnp.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, E.shape[0]))
    gains = jax.lax.map(lambda rho: riccati(s, rho * E**2), rho) if steps else None
    # Finite data can still overflow.
    sound = all_finite((E, gains, s.gain))
    E, gains, gain = jax.tree.map(lambda v: jnp.where(sound, v, 0.0), (E, gains, s.gain))
    fault = jnp.where(sound, fault, jnp.int32(Status.NON_FINITE))
    return StageFactor(replace(s, gain=gain), E, rho, gains, fault)


def scaled(s: Stages, scale: Array | None) -> tuple[Stages, Array]:
    """Return the stages with the gain of their moves, and the row scale E (rows,); without a gain
    and with this row scale where one is given."""
    if scale is not None:
        return s, jnp.asarray(scale, s.Q.dtype)
    free = riccati(s)
    return replace(s, gain=stabilising_gain(s, free)), row_scale(s, free)


def stabilising_gain(s: Stages, gains: Gains) -> Array:
    """Return the gain of least cost without rows, of the first stage where the system is the same
    at all, if the states would grow GROWTH-fold without it, and else zero. What the plan is does
    not depend on it, hence it has no derivative."""
    A, K = jax.lax.stop_gradient((s.A, gains.K))
    if A.ndim == 2:
        powers = [A]
        for _ in range(math.ceil(math.log2(s.horizon))):
            powers.append(matmul(powers[-1], powers[-1]))
        products = jnp.stack(powers)
    else:
        step = lambda product, A: (matmul(A, product),) * 2
        products = jax.lax.scan(step, varying(jnp.eye(A.shape[-1], dtype=A.dtype), A), A)[1]
    # n at most where nothing grows, and the same in all coordinates of the states.
    traces = jnp.abs(jnp.trace(products, axis1=-2, axis2=-1))
    grows = ~jnp.all(traces <= GROWTH * A.shape[-1])  # also where they overflow
    return jnp.where(grows, K[0] if A.ndim == 2 and s.B.ndim == 2 else K, 0.0)


def row_scale(s: Stages, gains: Gains) -> Array:
    """E (rows,): 1/E² is the variance of the row under exp(−J); 0 where that is zero. gains: those
    of s without weights on rows."""
    spread = matmul(s.B, matmul(gains.inverse, jnp.swapaxes(s.B, -1, -2)))
    Sigma = jnp.concatenate([jnp.zeros_like(s.P)[None], covariances(gains.closed, spread)])
    variance, own = [jnp.zeros(0, s.Q.dtype)], [jnp.zeros(0, s.Q.dtype)]
    square = lambda M, V: jnp.sum(matmul(M, V) * M, axis=-1)
    deviation = lambda V: jnp.sqrt(jnp.maximum(jnp.diagonal(V, axis1=-2, axis2=-1), 0.0))
    for block in s.blocks:
        # H x + D (K x + e), e of covariance G⁻¹.
        steps, D = block.steps, block.D
        F: Any = 0.0 if block.H is None else block.H
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


def stage_splittings(
    factor: StageFactor, s: Stages, unroll: int = 1
) -> tuple[list[Splitting], tuple[Array, Array]]:
    """The splitting of each penalty of the schedule, and with the last one the x (N+1, n) and
    u (N, m) of least cost with that penalty on the rows alone. Bounds and E·row include what x0 and
    c put into the rows; in the condensed QP they are moved by that."""
    E, made = factor.E, []
    for i, rho in enumerate(factor.rho):
        gains = jax.tree.map(lambda v, i=i: v[i], factor.gains)
        free = unconstrained(s, gains, rho * E**2)

        def image(r: Array, rho: Array = rho, gains: Gains = gains) -> Array:
            return E * s.rows(*minimise(s, gains, *s.pull(rho * E * r), unroll))

        made.append(Splitting(rho, image, E * s.rows(*free)))
    return made, free


def read(
    factor: StageFactor, s: Stages, bounds: Bounds, t: Array, free: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Moves v (N, m) and multipliers y (rows,) that t stands for at the last penalty."""
    E, rho = factor.E, factor.rho[-1]
    gains = jax.tree.map(lambda v: v[-1], factor.gains)
    p = bounds.project(t, rho)
    pushed = minimise(s, gains, *s.pull(rho * E * (2 * p - t)))
    x, u = jax.tree.map(jnp.add, free, pushed)
    # A soft row that no input moves gets its penalty's gradient as multiplier: the gap closes.
    y = jnp.where(E == 0, s.bounds.penalty_gradient(s.rows(x, u)), E * rho * (t - p))
    return s.moves(x, u), s.bounds.admissible(y)


def plan_stages(
    factor: StageFactor,
    mpc: MPC,
    x0: Reals,
    reference: Reals | None = None,
    solver: ADMM = DEFAULT,
    warm_start: Plan | WarmStart | None = None,
    *,
    input_reference: Reals | None = None,
    previous_input: Reals | None = None,
) -> Plan:
    """The rest of `solve_stagewise`, for the same mpc and solver; mpc.system is not read."""
    aim = checked_aim(mpc, x0, reference, input_reference, previous_input)
    aim = full_aim(mpc, aim, factor.E.dtype)
    if warm_start is not None:
        warm_start = WarmStart.of(warm_start, factor.stages.layout, mpc)
    mpc = with_gain(replace(mpc, prestabilise=None))
    given = arrays((factor, mpc, solver, aim, warm_start))
    return _plan(*given, centred=answers_disturbances(mpc) and is_centred(mpc.disturbance))


def full_aim(mpc: MPC, aim: Aim, dtype: DTypeLike) -> Aim:
    """Return x0 (n,), the references at all stages, (N+1, n) and (N, m), and the previous input
    (m,), None where nothing depends on it, in one floating type."""
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    spread = lambda v, *shape: jnp.broadcast_to(jnp.asarray(0 if v is None else v, dtype), shape)
    x0 = jnp.asarray(aim.x0, dtype)
    before = spread(aim.previous_input, m) if mpc.input_in_state else None
    return Aim(x0, spread(aim.states, N + 1, n), spread(aim.inputs, N, m), before)


@partial(jax.jit, static_argnames="centred")
@own_modes
def _plan(
    factor: StageFactor,
    mpc: MPC,
    solver: ADMM,
    aim: Aim,
    warm_start: WarmStart | None,
    *,
    centred: bool,
) -> Plan:
    fault = jnp.where(all_finite(aim), factor.fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    aim = jax.tree.map(lambda v: jnp.where(jnp.isfinite(v), v, 0), aim)
    # Only cost and slack are read from the problem as given.
    mpc = jax.tree.map(lambda v: jnp.where(usable, v, 0), mpc)
    s = factor.stages.aimed(aim)
    if answers_disturbances(mpc):
        return affine_plan(mpc, replace(s, gain=None), factor.E, fault, solver, aim, centred)
    if warm_start is not None:
        states = s.joined(warm_start.states, warm_start.inputs)
        warm_start = warm_start._replace(states=states)
    found = stage_solution(factor, s, solver, warm_start)
    found = replace(found, iterations=jnp.int32(solver.admm_steps(ADMM_STEPS)))
    x = predict(s, found.z)
    return answer(mpc, s.layout, found, fault, s.of_system(x), s.inputs(x, found.z), aim)


def stage_solution(
    factor: StageFactor, s: Stages, solver: ADMM, warm_start: WarmStart | None
) -> QPSolution:
    """Return the solution, moves z (N, m) and multipliers y (rows,), from a warm start in the
    states of the stages, with its derivatives and its status: that of what was measured of the
    float64 pair that Newton steps end at, before it was rounded, or where there were none of what
    is measured of this pair."""
    given = factor, s, solver, warm_start
    if solver.differentiate == "implicit":
        factor, *_ = given = jax.lax.stop_gradient(given)
        z, y, measured = searched(*given)
        z, y = implicit(stage_conditions, s, (factor.E, factor.rho[-1]), z, y)
        y = s.bounds.following(y, factor.E, rows_under(s, z))
    else:
        z, y, measured = searched(*given)
    none = Proof.none(z, y)
    if measured is not None:
        return with_status(measured, z, y, none)
    return assess(stage_residuals, (s, factor.E), z, y, none, tolerance(solver, z.dtype))


def searched(
    factor: StageFactor, s: Stages, solver: ADMM, warm_start: WarmStart | None
) -> tuple[Array, Array, Measured | None]:
    """Moves z (N, m) and multipliers y (rows,): ADMM, Newton steps, interior point method; and
    what was measured of them where Newton steps end at them."""
    E, rho = factor.E, factor.rho
    z, y = jnp.zeros((s.horizon, s.B.shape[-1]), E.dtype), jnp.zeros_like(E)
    if warm_start is not None:  # what is not finite counts as 0
        clean = lambda v: jnp.nan_to_num(jnp.asarray(v, E.dtype), posinf=0.0, neginf=0.0)
        x, u, multipliers = map(clean, warm_start)
        given = s.moves(x, u), multipliers
        far = lambda pair: jax.lax.stop_gradient(distance(s, E, rho[-1], *pair))
        near = far(given) <= 100 * far((z, y))
        z, y = (jnp.where(near, v, 0.0) for v in given)
    rows = rows_under(s, z)
    fixed = s.bounds.unmoved(E, rows)
    if factor.gains is not None:
        bounds, v = s.bounds.scaled(E), E * rows
        t = v if warm_start is None else start(bounds, rho[0], v, scaled_multipliers(E, y))
        schedule, free = stage_splittings(factor, s, min(s.horizon, UNROLL))
        t, _ = iterate(schedule, bounds, t, solver.admm_steps(ADMM_STEPS), solver.alpha)
        z, y = read(factor, s, bounds, t, free)
    y = jnp.where(E == 0, fixed, y)
    unrolled = solver.differentiate == "unrolled"
    most = solver.most_newton_steps(NEWTON_STEPS if unrolled else MOST_STEPS)
    if not most:
        return z, y, None
    if unrolled:
        step = lambda pair, _: (stage_newton_step(s, E, rho[-1], *pair), None)
        z, y = jax.lax.scan(step, (z, y), length=most)[0]
        return z, s.bounds.admissible(y), None
    newton, interior = min(most, NEWTON_STEPS), max(most - 2 * NEWTON_STEPS, 0)
    refine = partial(refined, Search(newton, interior, _always if solver.fixed else _while_open))
    best = precisely(refine, s, E, rho[-1], fixed, tolerance(solver, z.dtype), z, y)
    return best.z, best.y, best.measured


def _always(step: Callable, most: int, constants: tuple, state: Any) -> Any:
    """Take `most` steps."""
    state = varying(state, (constants, state))
    moved = lambda state, _: (varying(step(constants, state), state), None)
    return jax.lax.scan(moved, state, length=most)[0]


def _while_open(step: Callable, most: int, constants: tuple, state: Any) -> Any:
    """Take steps until the instance has left."""
    return repeat_while(lambda state: state.open, step, constants, state, "recursion")


def refined(
    search: Search, s: Stages, E: Array, rho: Array, fixed: Array, eps: Array, z: Array, y: Array
) -> Pair:
    """Return the best pair that a search finds from moves z (N, m), y (rows,); with interior point
    steps Newton steps follow them once more."""

    def go_on(best: Pair, first: Array) -> tuple[Pair, None]:
        return search.from_pair(s, E, rho, fixed, eps, best, first), None

    best = measured_pair(eps, s, E, z, y)
    # Weights of rows that are held grow until rounding stops the interior point method; Newton's
    # are bounded. As a loop, so that both are compiled once.
    rounds = jnp.arange(2 if search.interior else 1) == 0
    return jax.lax.scan(go_on, varying(best, (best, s, fixed)), rounds)[0]
