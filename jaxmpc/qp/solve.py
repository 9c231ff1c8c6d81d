"""Solve a quadratic program: factorise, ADMM, Newton steps, status, cost, derivative.

The functions stand in the order in which a call comes to them; then what prepares the data, a solve
from known multipliers, and the margin of feasibility, which is the value of a program.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from operator import attrgetter
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.typing import DTypeLike

from jaxmpc.arrays import Reals, of_known_type
from jaxmpc.checks import concrete, fail, require_kind, require_shape
from jaxmpc.qp.admm import (
    ADMM,
    ADMM_STEPS,
    DEFAULT,
    WARM_STEPS,
    Factor,
    ScaledProgram,
    factorise,
    harmless_matrices,
    iterate,
    nearer,
    read,
    splittings,
    start,
)
from jaxmpc.qp.admm_kernel import iterate_batch, suits
from jaxmpc.qp.derivative import dense_conditions
from jaxmpc.qp.dual import FEW_STEPS, few_steps, has_dual_steps
from jaxmpc.qp.jax_transformations import (
    attempted_first,
    compiled_lightly,
    has_kernels,
    implicit,
    in_blocks,
    own_modes,
    tree_where,
    varying,
)
from jaxmpc.qp.kernel import EXACT, ROUGH, Product
from jaxmpc.qp.linalg import (
    arrays,
    cast,
    floating_dtype,
    infinity_norm,
    matmul,
    precisely,
    symmetric,
)
from jaxmpc.qp.newton import MultiplierState, improve, multipliers_start, multipliers_step
from jaxmpc.qp.problem import QP, QPSolution
from jaxmpc.qp.residuals import (
    Pair,
    Proof,
    assess,
    correcting_rows,
    prove,
    residual_terms,
    row_sizes,
    with_fault,
    with_status,
    worst,
)
from jaxmpc.qp.status import Status

T = TypeVar("T")
# What a solve may begin from: an earlier solution, or z and y.
WarmPair = QPSolution | tuple[Reals, Reals] | None

# Bounds of this size mean none, as in OSQP, MOSEK and the MPS format.
INFINITE = 1e20
# Settings for the linear program of a margin.
LINEAR = ADMM(iterations=100, newton_steps=60)


def solve_qp(qp: QP, solver: ADMM = DEFAULT, warm_start: WarmPair = None) -> QPSolution:
    """Minimise ½ z'Pz + q'z subject to l ≤ Az ≤ u by ADMM and Newton steps.

    One instance; `jax.vmap` for many. Where P and A are not batched they are factored once;
    where they are, each instance has its own factor. Soft rows and balls: see `QP`. Bounds of 1e20
    and above are infinite.

    qp: the program. solver: settings of the solver.
    warm_start: a (z, y) pair or an earlier QPSolution.

    The status comes from residuals in the
    units of `qp` (see `ADMM.eps`), computed in float64 even for float32 data, or from a
    certificate (`residuals.py`); of float32 data it speaks of the float64 pair that was found,
    which is then rounded. z, y and cost are differentiable with respect to every array
    of `qp`, forward and reverse, for every status (`derivative.py`); an instance with NON_FINITE
    data has derivative zero. Raises ValueError for bad shapes and, where values can be read, bad
    values.
    """
    require_kind("qp", qp, QP)
    require_kind("solver", solver, ADMM)
    qp = qp.dense()
    qp.validate()
    solver.validate(np.shape(qp.A)[0])
    if warm_start is not None:
        require_warm_start(qp, warm_start)
    linear = concrete(qp.P) and not np.any(np.asarray(qp.P))
    arguments = as_arrays(qp), *arrays((solver, warm_start))
    hard = linear or not has_dual_steps(qp.balls, qp.A)
    return in_two_parts(partial(_solve, linear=linear), hard, solver, *arguments)


@compiled_lightly(1, static_argnames=("whole", "linear"))
@own_modes
def _solve(
    qp: QP, solver: ADMM, warm_start: WarmPair, *, whole: bool, linear: bool = False
) -> QPSolution:
    """`solve_qp`. linear: known to have P = 0, so that there are no steps on the dual."""
    made = factorise(qp.P, qp.A, solver, qp.balls)
    unit = unit_of_cost(qp, made)
    if warm_start is not None:
        z, y = require_warm_start(qp, warm_start)
        warm_start = z, jnp.asarray(y) / unit
    given = with_cost_divided(qp, unit), made, solver, warm_start
    if whole and not linear and can_attempt(solver, qp.balls, qp.A):
        found, fault = attempted_first(_attempt, _solve_whole, _derived, *given)
    else:
        found, fault = solve_factored(*given, whole=whole)
    y, cost, dual, gap = (v * unit for v in (found.y, found.cost, found.dual_residual, found.gap))
    return with_fault(replace(found, y=y, cost=cost, dual_residual=dual, gap=gap), fault)


def unit_of_cost(qp: QP, factor: Factor) -> Array:
    """Return the unit of the cost: 1, and where P = 0, which leaves it free beside that of the
    limits, the power of two that makes q, in ADMM's coordinates, 2^10 times the mean finite limit.

    The mean is that of logarithms, so that neither some limits that are far off nor rounding in
    place of 0 decide it. Proximal steps are as long as q: with 2^-5 in place of 2^10 some end short
    of the limits (4 of 480 random programs), with 2^20 none do. Where most limits are far off, as
    1e12 for none, q drowns the least of them that is not 2^-45 of the mean, by which 0 is rounded:
    q is at most 2^30 (in float32 2^15) times that one."""
    q, bounds = infinity_norm(matmul(qp.q, factor.T)), qp.bounds.scaled(factor.E)
    ends = jnp.abs(jnp.stack([bounds.l, bounds.u]))
    count = (ends > 0) & (ends < jnp.inf)
    logs = jnp.log2(jnp.where(count, ends, 1.0))
    mean = jnp.sum(logs) / jnp.maximum(jnp.sum(count), 1)
    least = jnp.min(logs, where=count & (logs >= mean - 45), initial=jnp.inf)
    typical = jnp.minimum(mean, least + (jnp.finfo(ends.dtype).nmant - 12) // 2)
    exponent = jnp.round(jnp.log2(q) - typical) - 10
    use = jnp.all(qp.P == 0) & jnp.any(count) & jnp.isfinite(exponent)
    exponent = jax.lax.stop_gradient(jnp.where(use, exponent, 0.0))
    return jnp.ldexp(jnp.ones((), qp.q.dtype), exponent.astype(jnp.int32))


def with_cost_divided(qp: QP, unit: Array) -> QP:
    """Return the program with P = 0 whose cost is that of `qp`, divided by `unit`."""
    weights = {name: getattr(qp, name) for name in ("q", "soft_linear", "soft_quadratic")}
    return replace(qp, **{name: v / unit for name, v in weights.items() if v is not None})


def can_attempt(solver: ADMM, balls: tuple[int, ...], A: Array) -> bool:
    """Return whether a few steps on the dual may solve programs: else there is no `attempt`."""
    free = not solver.fixed and solver.differentiate == "implicit"
    return free and solver.most_newton_steps() >= FEW_STEPS and has_dual_steps(balls, A)


def attempt(
    qp: QP,
    factor: Factor,
    solver: ADMM,
    warm_start: WarmPair = None,
    *,
    measured: bool = True,
) -> tuple[QPSolution, Array]:
    """`solve_factored` by a few steps on the dual: SOLVED, or ITERATION_LIMIT where these do not
    suffice. measured: False leaves out the residuals of float64 data. Not differentiable."""
    clean, fault = cleaned(qp, factor.fault)
    p = ScaledProgram.of(clean, factor, tolerance(solver, qp.q.dtype))
    begin, single = admm_end(p, solver, warm_start, refined=True), p.q.dtype != jnp.float64
    steps = partial(few_steps, measured or single)
    pair = precisely(lambda p, y: steps(p.unrounded() if single else p, y), p, begin.y)
    found = with_status(pair.measured, pair.z, pair.y, Proof.none(p.q, p.bounds.l))
    count = jnp.int32(admm_steps(solver, warm_start))
    return replace(found, cost=value(clean, pair.z, pair.y), iterations=count), fault


@jax.jit
def _attempt(*given: Any) -> tuple[tuple[QPSolution, Array], Array]:
    found, fault = attempt(*given)
    return (found, fault), found.status == Status.SOLVED


def solve_factored(
    qp: QP,
    factor: Factor,
    solver: ADMM,
    warm_start: WarmPair = None,
    *,
    whole: bool = True,
    found: QPSolution | None = None,
) -> tuple[QPSolution, Array]:
    """`solve_qp` after its factorization: what a controller repeats at each sample.

    whole: False leaves out the method of multipliers and proofs, and ADMM after a warm start
    (`in_two_parts`). found: the solution where it is known, and derivatives alone are asked for.
    Returns the solution and the fault of the data, NOT_RUN for none. Where there is one the
    solution is that of harmless data: `with_fault` says so, after all that is computed from it, for
    the derivative of a product with NaN is NaN even where nobody looks at it.
    """
    clean, fault = cleaned(qp, factor.fault)
    if not whole and warm_start is not None:
        solver = replace(solver, iterations=0)
    if solver.differentiate == "implicit":
        constants = jax.lax.stop_gradient((clean, factor, solver, warm_start))
        found = search(*constants, whole) if found is None else found
        z, y = implicit(dense_conditions, clean, (constants[1], solver.smoothing), found.z, found.y)
        y = clean.bounds.following(y, constants[1].E, matmul(z, clean.A.T))
    else:
        found = search(clean, factor, solver, warm_start, whole)
        z, y = found.z, found.y
    steps = jnp.int32(admm_steps(solver, warm_start))
    return replace(found, z=z, y=y, cost=value(clean, z, y), iterations=steps), fault


_solve_whole = jax.jit(solve_factored)


def _derived(found: tuple[QPSolution, Array], *given: Any) -> tuple[QPSolution, Array]:
    return solve_factored(*given, found=found[0])


def search(
    qp: QP, factor: Factor, solver: ADMM, warm_start: WarmPair, whole: bool = True
) -> QPSolution:
    """Return the solution of clean data by ADMM and Newton steps, with its status, without its cost
    and count of iterations. whole: see `in_two_parts`."""
    p = ScaledProgram.of(qp, factor, tolerance(solver, qp.q.dtype))
    most, unrolled = solver.most_newton_steps(), solver.differentiate == "unrolled"
    begin = admm_end(p, solver, warm_start, refined=most > 0 and not unrolled)
    if most and not unrolled:
        return refined_end(p, solver, begin, whole)
    found = stepped_end(p, begin, most)
    if most or not admm_steps(solver, warm_start):
        return found
    return or_inaccurate(found, begin, solver.dtype or p.q.dtype)


def admm_steps(solver: ADMM, warm_start: WarmPair) -> int:
    """Return how many ADMM steps there are."""
    return solver.admm_steps(ADMM_STEPS if warm_start is None else WARM_STEPS)


def admm_end(
    p: ScaledProgram, solver: ADMM, warm_start: WarmPair, *, refined: bool
) -> MultiplierState:
    """Return where the steps of ADMM end, as the state at which Newton steps begin. refined: these
    follow, are in float64, and make up for rough products."""
    q, bounds, factor = p.q, p.bounds, p.factor
    t = jnp.zeros_like(bounds.l)
    if warm_start is not None:
        t = nearer(splittings(factor, q)[0], bounds, warm(p, warm_start))
    own = q.dtype
    # Of JAX's arrays: without its float64 there is float32 alone.
    dtype = jax.dtypes.canonicalize_dtype(solver.dtype or ("float32" if refined else own))
    steps = admm_steps(solver, warm_start)
    product = ROUGH if refined else EXACT
    constants, data = cast(((factor, jnp.asarray(solver.alpha)), (q, bounds, t)), dtype)
    if solver.differentiate == "unrolled":
        ends = loop(steps, constants, data)
    else:
        fits = has_kernels(len(t)) and suits(factor, p.qp.balls, dtype, product)
        kernel = partial(loop_kernel, steps, product) if fits else None
        ends = in_blocks(partial(loop, steps), constants, data, kernel=kernel)
    (w, y), (w_old, y_old) = cast(ends, own)
    return replace(multipliers_start(q, w, y), change=y - y_old, move=w - w_old)


def loop(iterations: int, constants: tuple, data: tuple) -> list[tuple[Array, Array]]:
    """Scaled w (n,) and y (m,) after `iterations` steps of ADMM from t (m,), and one step before.
    constants: the factor and alpha; data: q, bounds, t."""
    (factor, alpha), (q, bounds, t) = constants, data
    ends = iterate(splittings(factor, q), bounds, t, iterations, alpha)
    return [read(factor, t, q, bounds) for t in ends]


def loop_kernel(
    iterations: int, product: Product, constants: tuple, data: tuple
) -> list[tuple[Array, Array]]:
    """`loop` of a batch, as a kernel for NVIDIA GPUs; B in front of all leaves of `data`."""
    (factor, alpha), (q, bounds, t) = constants, data
    ends = iterate_batch(factor, alpha, q, bounds, t, iterations, product)
    return [jax.vmap(partial(read, factor))(t, q, bounds) for t in ends]


def refined_end(p: ScaledProgram, solver: ADMM, begin: MultiplierState, whole: bool) -> QPSolution:
    """Return the solution by Newton steps in float64 (`newton.py`)."""
    single, most = p.q.dtype != jnp.float64, solver.most_newton_steps()
    steps = partial(improve, most, solver.fixed, whole, single)
    improved = lambda p, begin: steps(p.unrounded() if single else p, begin)
    pair, proof, ended, idle = precisely(improved, p, begin)
    found = with_status(pair.measured, pair.z, pair.y, proof)
    unsolved = found.status == Status.ITERATION_LIMIT
    status = jnp.where(unsolved & idle, jnp.int32(Status.INACCURATE), found.status)
    return replace(found, status=jnp.where(ended, status, jnp.int32(Status.ITERATION_LIMIT)))


def stepped_end(p: ScaledProgram, begin: MultiplierState, most: int) -> QPSolution:
    """Return the solution by a fixed number of Newton steps, which may be 0, in the type of the
    data: differentiable step by step."""
    qp, factor, q, bounds = p.qp, p.factor, p.q, p.bounds
    pair, end = p.unscaled(begin.w, begin.y), begin
    if most:
        advance = lambda s, _: (multipliers_step(factor.H, q, factor.A, bounds, s), None)
        end = lax.scan(advance, varying(begin, begin), length=most)[0]
        other = p.unscaled(end.w, end.y)
        error = lambda z, y: reduce(jnp.maximum, worst(residual_terms(qp, z, y), 0.0)[1])
        better = lax.stop_gradient(error(*other) < error(*pair))
        pair = tree_where(better, other, pair)
    sizes = p.typical_sizes(end.w, end.y)
    allowed = p.eps * row_sizes(0.0, qp.row_sizes, sizes)
    certified = partial(prove, qp, factor.T, factor.E, correcting_rows(qp), allowed)
    proof = certified(end.change, end.move).joined(certified(end.y, end.w))
    terms = lambda qp, sizes, z, y: residual_terms(qp, z, y, sizes)
    return assess(terms, (qp, sizes), *pair, proof, p.eps)


def or_inaccurate(found: QPSolution, end: MultiplierState, dtype: DTypeLike) -> QPSolution:
    """Return what ADMM alone has found, as INACCURATE where it is not solved and the last step
    moved w and y by no more than the rounding of iterates of this type."""
    eps, moves = jnp.finfo(dtype).eps, ((end.move, end.w), (end.change, end.y))
    still = [infinity_norm(move) <= eps * infinity_norm(v) for move, v in moves]
    stopped = (found.status == Status.ITERATION_LIMIT) & still[0] & still[1]
    return replace(found, status=jnp.where(stopped, jnp.int32(Status.INACCURATE), found.status))


def value(qp: QP, z: Array, y: Array) -> Array:
    """The cost at z, with the derivative of the optimal value: that of the Lagrangian
    ½ z'Pz + q'z + y'Az − g*(y) at (z, y) (envelope theorem). Penalties that are being paid stand
    there as themselves, for at |y| = c the conjugate of an L1 penalty has no derivative."""
    own = 0.5 * jnp.sum(z * matmul(z, qp.P)) + jnp.sum(qp.q * z)
    Az, bounds = matmul(z, qp.A.T), qp.bounds
    cost = jnp.sum(bounds.cost(Az))
    if bounds.linear is None:
        lagrangian = own + jnp.sum(y * Az - bounds.support(y))
    else:
        paid = jnp.isfinite(bounds.linear) & (jnp.abs(y) >= bounds.linear)
        y = jnp.where(paid, 0.0, y)
        penalty = replace(bounds, linear=jnp.where(paid, bounds.linear, jnp.inf)).cost(Az)
        lagrangian = own + jnp.sum(penalty + y * Az - bounds.support(y))
    fixed = jax.lax.stop_gradient
    return fixed(own + cost) + (lagrangian - fixed(lagrangian))


def in_two_parts(
    program: Callable[..., T],
    hard: bool,
    solver: ADMM,
    *arguments: Any,
    status: Callable[[T], Array] = attrgetter("status"),
) -> T:
    """Return program(*arguments, whole=True), whose status is status(result).

    One instance from plain Python runs first without the method of multipliers, which most programs
    do not need and which is half of what there is to compile, and without ADMM steps if it has a
    warm start, which mostly is as near as these would come; what it leaves open is solved again
    with both. hard: known to need them.
    """
    every = hard or solver.fixed or solver.newton_steps == 0 or solver.differentiate != "implicit"
    if every or not concrete(arguments):
        return program(*arguments, whole=True)
    found = program(*arguments, whole=False)
    solved = int(status(found)) != Status.ITERATION_LIMIT  # as an int: == would be a program
    return found if solved else program(*arguments, whole=True)


def as_arrays(qp: QP) -> QP:
    """The same program with all fields in one floating type, the widest among them, P made exactly
    symmetric, and bounds of 1e20 and above as infinity."""
    dtype = floating_dtype(qp)
    qp = jax.tree.map(
        lambda v: jnp.asarray(v, dtype), qp, is_leaf=lambda v: isinstance(v, list | tuple)
    )
    l = jnp.where(qp.l <= -INFINITE, -jnp.inf, qp.l)
    u = jnp.where(qp.u >= INFINITE, jnp.inf, qp.u)
    return replace(qp, P=symmetric(qp.P), l=l, u=u)


def cleaned(qp: QP, matrix_fault: Array) -> tuple[QP, Array]:
    """The program with harmless data where its own are not usable, and the fault in them.

    matrix_fault: that of P and A, `Factor.fault`. Bad data must not reach the loop: NaN would pass
    through clip unseen on a CPU.
    """
    finite = (
        jnp.all(jnp.isfinite(qp.q))
        & jnp.all(qp.l <= qp.u)
        & ~jnp.any(jnp.isposinf(qp.l) | jnp.isneginf(qp.u))
    )
    # The rows of a ball have l = u = its centre, and a free centre is no centre.
    ball = jnp.arange(qp.l.shape[0]) >= qp.l.shape[0] - sum(qp.balls)
    finite = finite & jnp.all(~ball | (jnp.isfinite(qp.l) & (qp.l == qp.u)))
    if qp.bounds.linear is not None:  # and balls are hard
        finite = finite & jnp.all(~ball | jnp.isposinf(qp.bounds.linear))
    harmless: dict[str, Any] = {
        "q": 0.0,
        "l": jnp.where(ball, 0.0, -jnp.inf),
        "u": jnp.where(ball, 0.0, jnp.inf),
    }
    if qp.soft_linear is not None:
        finite = finite & jnp.all(qp.soft_linear >= 0)
        harmless["soft_linear"] = jnp.inf
    if qp.soft_quadratic is not None:
        finite = finite & jnp.all((qp.soft_quadratic >= 0) & jnp.isfinite(qp.soft_quadratic))
        harmless["soft_quadratic"] = 0.0
    if qp.radius is not None:
        finite = finite & jnp.all(qp.radius >= 0)
        harmless["radius"] = 1.0
    fault = jnp.where(finite, matrix_fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    fields: dict[str, Any] = {
        name: jnp.where(usable, getattr(qp, name), v) for name, v in harmless.items()
    }
    P, A = harmless_matrices(qp.P, qp.A, matrix_fault == Status.NOT_RUN)
    return replace(qp, P=P, A=A, **fields), fault


def warm(p: ScaledProgram, warm_start: WarmPair) -> Array:
    """Return t (m,) of a warm start, a pair z (n,), y (m,) or a solution; what is not finite counts
    as 0. Raises ValueError for other shapes."""
    z, y = require_warm_start(p.qp, warm_start)
    clean = lambda v: jnp.nan_to_num(jnp.asarray(v, p.q.dtype), posinf=0.0, neginf=0.0)
    return start(p.bounds, p.factor.rho[0], *p.scaled_rows(clean(z), clean(y)))


def require_warm_start(qp: QP, warm_start: Any) -> tuple[Reals, Reals]:
    """Return z and y of a warm start; ValueError for other things and other shapes."""
    pair = (warm_start.z, warm_start.y) if hasattr(warm_start, "z") else warm_start
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        what = f"is a {type(warm_start).__name__}"
        fail("warm_start", what, "Give a pair (z, y) or an earlier QPSolution")
    for name, value, like in (("z", pair[0], qp.q), ("y", pair[1], qp.l)):
        require_shape(f"warm_start {name}", value, np.shape(like), f"Needed: {np.shape(like)}")
    return pair[0], pair[1]


def tolerance(solver: ADMM, dtype: DTypeLike) -> Array:
    """Return the relative tolerance that `solver` asks for."""
    return jnp.asarray(solver.eps, dtype)


def from_multipliers(qp: QP, factor: Factor, y: Array) -> tuple[QPSolution, Array]:
    """`solve_factored` for multipliers y (m,) in ADMM's coordinates that may be those of the
    solution: ITERATION_LIMIT, for nothing is measured. For hard rows, without balls; not
    differentiable."""
    clean, fault = cleaned(qp, factor.fault)
    p = ScaledProgram.of(clean, factor)
    y = p.bounds.admissible(jnp.where(jnp.all(jnp.isfinite(y)), y / p.unit, 0.0))
    z, y = p.unscaled(-p.q - matmul(y, factor.A), y)
    return with_status(Pair.none(z, y).measured, z, y, Proof.none(p.q, p.bounds.l)), fault


def feasibility_margin(
    qp: QP, scale: Any = None, max_margin: float = 1e3, solver: ADMM = LINEAR
) -> tuple[Array, Array]:
    """The largest t with l + t·scale ≤ Az ≤ u − t·scale for some z, and its status.

    t > 0: all hard rows can be kept with a distance of t·scale at once. t < 0: no z keeps them,
    and |t|·scale is the least uniform widening of the bounds that lets one. t = 0 is the boundary
    of the feasible set. An equality keeps t ≤ 0. The cost P, q and soft rows do not count; t
    stops at `max_margin`, which one-sided rows alone may never do.

    qp: the program. max_margin: the largest t of interest.
    scale (m,) > 0: what a violation of 1 means in each row; None: 1, the row's own unit.

    The margin t is
    the value of a linear program, concave in l and u and therefore, in MPC, in the initial
    state; differentiable (the gradient is one of its supergradients) whatever its sign. The
    status is that of the linear program: t is exact where it is SOLVED. One instance;
    `jax.vmap` for many. Raises ValueError for wrong shapes and for balls.
    """
    qp = qp.dense()
    qp.validate()
    m, n = np.shape(qp.A)
    if qp.balls:
        fail("qp", "has balls", "The margin is that of rows; give a program without balls")
    if scale is not None:
        require_shape("scale", scale, (m,), "One for each row of A")
    qp = as_arrays(qp)
    dtype, bounds = qp.q.dtype, qp.bounds.hard()
    s = jnp.ones(m, dtype) if scale is None else jnp.asarray(of_known_type(scale), dtype)
    # Variables (z, t): Az + t s ≤ u, l ≤ Az − t s, t ≤ max_margin.
    last = jnp.zeros(n + 1, dtype).at[n].set(1.0)
    A = jnp.concatenate([jnp.block([[qp.A, s[:, None]], [qp.A, -s[:, None]]]), last[None]])
    none = jnp.full(m, jnp.inf, dtype)
    l = jnp.concatenate([-none, bounds.l, -jnp.full(1, jnp.inf, dtype)])
    u = jnp.concatenate([bounds.u, none, jnp.full(1, max_margin, dtype)])
    solution = solve_qp(QP(np.zeros((n + 1, n + 1), dtype), -last, A, l, u), solver)
    return -solution.cost, solution.status
