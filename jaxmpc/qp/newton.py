"""Semismooth Newton: from ADMM's pair to the exact one, and least-distance feasibility.

Both minimise one convex, piecewise quadratic function, the augmented Lagrangian with the
splitting variable minimised out (Rockafellar 1976; Hermans, Themelis, Patrinos 2019)

    φ(w) = ½ w'Hw + q'w + min_p g(p) + ½ρ|A w + y/ρ − p|²

with g of `problem.py`. Its gradient, with the prox residual e of v = A w + y/ρ, is
Hw + q + ρ A'e, its generalised Hessian H + ρ A'DA with D the derivative of e. With H = q = y = 0
and ρ = 1 the minimum is the distance to feasibility: there e = 0 (a feasible w), or A'e = 0 with
e ≠ 0, which is a Farkas vector: e'A w is 0 for all w but at least g*(e) fails by |e|².

`improve` begins where ADMM ends and measures each pair by its own residuals. Steps on the dual
(`dual.py`) solve most programs; the method of multipliers, whose steps minimise φ, takes the rest,
and proves that there is no solution where there is none.
"""

from collections.abc import Callable
from dataclasses import replace
from enum import IntEnum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.typing import DTypeLike

from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ScaledProgram
from jaxmpc.qp.dual import (
    MOST_STEPS,
    Correction,
    Dual,
    DualPoint,
    corrected,
    has_dual_steps,
    solve_dual,
)
from jaxmpc.qp.jax_transformations import (
    has_kernels,
    repeat_while,
    tree_where,
    varying,
    with_derivative_of,
)
from jaxmpc.qp.kernel import in_one_program
from jaxmpc.qp.linalg import infinity_norm, matmul, solve
from jaxmpc.qp.problem import FREE, Bounds
from jaxmpc.qp.residuals import (
    Correcting,
    Pair,
    Proof,
    correcting_rows,
    farkas,
    prove,
    recession,
    row_sizes,
    to_length_one,
)

# Steps of the line search, a scalar Newton method. Penalties put almost vertical pieces into the
# derivative, which only bisection finds.
LINE_STEPS, LINE_STEPS_SOFT = 6, 24
# First proximal weight of the method of multipliers.
SIGMA = 1.0
# Steps without gain after which a pair within the tolerance is not made better any more.
IDLE = 40
# Steps without gain after which more of them are said to gain nothing, where so many are asked for.
LEAST_IDLE = 200


class Constants(NamedTuple):
    """What the precision decides. rho: first and last penalty of the method of multipliers.
    sigma: last proximal weight. damping: proximal weight of least distance, little but far above
    rounding. linear: penalty of the linearised optimality conditions."""

    rho: tuple[float, float]
    sigma: float
    damping: float
    linear: float

    @classmethod
    def of(cls, dtype: DTypeLike) -> "Constants":
        """Return those of float64, or of float32."""
        double = jnp.finfo(dtype).eps < 1e-10
        return cls((1e3, 1e8), 1e-8, 1e-10, 1e6) if double else cls((1e3, 1e4), 1e-4, 1e-5, 1e3)


def gram(A: Array, weights: Array, normals: list[Array]) -> Array:
    """Return A'(diag(weights) + Σ h h')A for weights (m,) and normals h (m,)."""
    K = matmul(A.T * weights, A)
    for h in normals:
        a = matmul(h, A)
        K = K + a[:, None] * a[None, :]
    return K


def ridged(K: Array, scale: float | Array = 0.0) -> Array:
    """Return K plus a ridge at rounding level, for the null space of K."""
    n = K.shape[0]
    ridge = 10 * jnp.finfo(K.dtype).eps * (jnp.trace(K) / n + scale)
    return K + ridge * jnp.eye(n, dtype=K.dtype)


class Augmented(NamedTuple):
    """φ with a proximal term, φ + ½σ d'(I − H)d for steps d: it acts where the cost has no
    curvature (H = I elsewhere in ADMM's coordinates) and bounds the iterates of linear programs.

    y (m,), H (n, n), q (n,), bounds, rho and sigma as above.
    """

    y: Array
    H: Array
    q: Array
    bounds: Bounds
    rho: Array | float
    sigma: Array | float

    @classmethod
    def distance(cls, bounds: Bounds, w: Array, damping: float | Array) -> "Augmented":
        """Return half the squared distance of the rows from hard bounds, as a function of w (n,).
        damping: weight of the proximal term; a little keeps w where it is where rows only touch."""
        n, one = w.shape[0], jnp.ones((), w.dtype)
        H, q = jnp.zeros((n, n), w.dtype), jnp.zeros_like(w)
        return cls(jnp.zeros_like(bounds.l), H, q, bounds, one, damping * one)


class NewtonStep(NamedTuple):
    """Result of one step: w (n,), its prox residual (m,), the gradient of φ (n,), and whether φ was
    minimised."""

    w: Array
    excess: Array
    gradient: Array
    minimised: Array


def newton_step(w: Array, phi: Augmented, A: Array) -> NewtonStep:
    """Take one step on φ from w (n,) with exact line search; A (m, n).

    φ is quadratic where no row changes its piece, so a full step that leaves all pieces as they
    were has reached the minimum.
    """
    y, H, q, bounds, rho, sigma = phi
    v = matmul(w, A.T) + y / rho
    e = bounds.prox_residual(v, rho)
    gradient = matmul(w, H) + q + rho * matmul(e, A)
    weights, normals = bounds.curvature(v, rho)
    smooth = H + sigma * (jnp.eye(w.shape[0], dtype=w.dtype) - H)
    d = -solve(ridged(smooth + rho * gram(A, weights, normals), rho), gradient)

    # φ along w + t d costs no product with A: two scalars and A d.
    Ad, Hd = matmul(d, A.T), matmul(d, smooth)
    slope, curvature = jnp.sum(d * jnp.stack([matmul(w, H) + q, Hd]), axis=1)
    minimised = jnp.all(bounds.active_set(v + Ad, rho) == bounds.active_set(v, rho))

    t = jnp.where(minimised, 1.0, line_minimum(bounds, rho, v, Ad, slope, curvature))
    w_new, e_new = w + t * d, bounds.prox_residual(v + t * Ad, rho)
    if not bounds.balls:
        # The prox residual is linear where the active set does not change. Adding the change keeps
        # the rounding of a small e small; ρ will multiply it.
        e_new = jnp.where(minimised, e + weights * Ad, e_new)
    return NewtonStep(w_new, e_new, matmul(w_new, H) + q + rho * matmul(e_new, A), minimised)


def line_minimum(
    bounds: Bounds, rho: Array | float, v: Array, Ad: Array, slope: Array, curvature: Array
) -> Array:
    """Return t ≥ 0 at which slope·t + ½ curvature·t² + min_p g(p) + ½ρ|v + t Ad − p|² is least.

    Without balls a kernel where it runs: as a loop of XLA each of its steps is several launches."""
    given = bounds, jnp.asarray(rho, v.dtype), v, Ad, slope, curvature
    if bounds.balls or not has_kernels(len(v)):
        return _line_minimum(*given)
    return with_derivative_of(_line_minimum, _line_minimum_in_kernel)(*given)


def _line_minimum_in_kernel(
    bounds: Bounds, rho: Array, v: Array, Ad: Array, slope: Array, curvature: Array
) -> Array:
    def program(
        slope: Array, curvature: Array, rho: Array, v: Array, Ad: Array, *columns: Array
    ) -> tuple[list, list[Array]]:
        bounds = Bounds.of_rows(columns)
        step = _bracket(bounds, rho, v, Ad, slope, curvature)
        again, end = lambda _, carry: step(carry), jnp.int32(_line_steps(bounds))
        carry = lax.fori_loop(jnp.int32(0), end, again, _first_bracket(slope))
        return [], [_end_of(carry)]

    rows = [(v, 0.0), (Ad, 0.0), *zip(bounds.columns, FREE, strict=False)]
    return in_one_program(program, [slope, curvature, rho], rows, [], 1)[1][0]


# A step length t, and those that are known to be too small and too large.
Bracket = tuple[Array, Array, Array]


def _line_minimum(
    bounds: Bounds, rho: Array, v: Array, Ad: Array, slope: Array, curvature: Array
) -> Array:
    step = _bracket(bounds, rho, v, Ad, slope, curvature)
    begin = varying(_first_bracket(slope), (slope, v))
    again = lambda carry, _: (step(carry), None)
    return _end_of(lax.scan(again, begin, length=_line_steps(bounds))[0])


def _line_steps(bounds: Bounds) -> int:
    return LINE_STEPS if bounds.linear is None else LINE_STEPS_SOFT


def _first_bracket(slope: Array) -> Bracket:
    one = jnp.ones((), slope.dtype)
    return one, 0 * one, jnp.inf * one


def _end_of(bracket: Bracket) -> Array:
    """Return t, or where none is known to be too large the largest that is too small."""
    t, low, high = bracket
    return jnp.where(high == jnp.inf, low, t)


def _bracket(
    bounds: Bounds, rho: Array, v: Array, Ad: Array, slope: Array, curvature: Array
) -> Callable[[Bracket], Bracket]:
    """Return a Newton step on the derivative, which grows with t, between what is bracketed."""

    def step(bracket: Bracket) -> Bracket:
        t, low, high = bracket
        at = v + t * Ad
        derivative = slope + t * curvature + rho * jnp.sum(bounds.prox_residual(at, rho) * Ad)
        D, hs = bounds.curvature(at, rho)
        second = curvature + rho * (jnp.sum(D * Ad**2) + sum(jnp.sum(h * Ad) ** 2 for h in hs))
        low, high = jnp.where(derivative < 0, t, low), jnp.where(derivative < 0, high, t)
        move = t - derivative / jnp.maximum(second, jnp.finfo(v.dtype).tiny)
        middle = jnp.where(high == jnp.inf, 4 * t, (low + high) / 2)
        inside = (move > low) & (move < high) & (move < 10 * t)
        return jnp.where(inside, move, middle), low, high

    return step


def least_distance(A: Array, bounds: Bounds, w: Array, steps: int) -> tuple[Array, Array]:
    """Minimise ½ dist²(A w, set) from w (n,); return w and e = A w − its projection.

    e = 0: w satisfies the rows. A'e = 0 with e ≠ 0: no w does, and e is the Farkas vector.
    """
    bounds = bounds.hard()
    phi = Augmented.distance(bounds, w, 0.0)

    def body(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        step = newton_step(carry[0], phi, A)
        return (step.w, step.excess), None

    begin = varying((w, phi.y), (w, A, bounds))
    return jax.lax.scan(body, begin, length=steps)[0]


@pytree
class MultiplierState:
    """State of the proximal method of multipliers: w (n,), y (m,); `change`: the last change of y,
    on an infeasible program nearly a Farkas vector; `move`: the last change of w, on an unbounded
    one nearly a ray; the penalties rho and sigma, the violation before and the tolerance for φ."""

    w: Array
    y: Array
    change: Array
    move: Array
    rho: Array
    sigma: Array
    before: Array
    tolerance: Array


def multipliers_start(q: Array, w: Array, y: Array) -> MultiplierState:
    """Return the state of the method of multipliers at (w, y)."""
    none_y, none_w = jnp.zeros_like(y), jnp.zeros_like(w)
    first = (Constants.of(w.dtype).rho[0], SIGMA, jnp.inf)
    rho, sigma, before = (jnp.asarray(v, w.dtype) for v in first)
    tolerance = 0.1 * (infinity_norm(q) + infinity_norm(y))
    return MultiplierState(w, y, none_y, none_w, rho, sigma, before, tolerance)


def multipliers_step(
    H: Array, q: Array, A: Array, bounds: Bounds, state: MultiplierState
) -> MultiplierState:
    """Take one Newton step of the proximal method of multipliers."""
    phi = Augmented(state.y, H, q, bounds, state.rho, state.sigma)
    return multipliers_update(q, state, newton_step(state.w, phi, A))


def multipliers_update(q: Array, state: MultiplierState, step: NewtonStep) -> MultiplierState:
    """Return the state after a Newton step on φ.

    Whenever φ is minimised the multipliers become ρ e; ρ grows tenfold if the violation has not
    fallen tenfold, and σ falls a hundredfold. "Minimised" is exact (`newton_step`), or the
    gradient is below a tolerance that falls tenfold each time: where many rows only touch, the
    pieces never come to rest.
    """
    constants, s = Constants.of(state.w.dtype), state
    # (In one reduction.)
    three = jnp.abs(jnp.stack([step.gradient, q, step.w]))
    gradient, linear, w = jnp.max(three, axis=1, initial=0.0)
    # The rounding of rows A w, which are as large as w, is multiplied by ρ.
    eps = jnp.finfo(s.w.dtype).eps
    noise = 10 * eps * (linear + w + s.rho * infinity_norm(step.excess)) + eps * s.rho * w
    done = step.minimised | (gradient <= jnp.maximum(s.tolerance, noise))
    new = jnp.where(done, s.rho * step.excess, s.y)
    violation = infinity_norm(new - s.y) / s.rho
    grow = done & (violation > 0.1 * s.before)
    rho = jnp.where(grow, jnp.minimum(10 * s.rho, constants.rho[1]), s.rho)
    # A Newton step has a ridge of 10 ε ρ, which must be little beside σ.
    least = jnp.maximum(constants.sigma, 40 * eps * rho)
    return MultiplierState(
        w=step.w,
        y=new,
        change=jnp.where(done, new - s.y, s.change),
        move=step.w - s.w,
        rho=rho,
        sigma=jnp.maximum(jnp.where(done, s.sigma / 100, s.sigma), least),
        before=jnp.where(done, violation, s.before),
        tolerance=jnp.where(done, s.tolerance / 10, s.tolerance),
    )


class Phase(IntEnum):
    """What Newton steps minimise: the augmented Lagrangian of the method of multipliers; the
    distance from the rows, whose residual becomes a Farkas vector; or `recession`, whose minimiser
    becomes a ray."""

    MULTIPLIERS, DISTANCE, RAY = range(3)


@pytree
class Refinement:
    """Loop state of one instance: the point of the method of multipliers; its program, whose bounds
    may have been widened; q (n,) corrected by what rounding leaves of the gradient; the best pair
    so far; Newton steps of the method, and steps since the best pair became better; what is proved;
    w (n,) of the search for a proof; the `Phase`, the steps left for it, whether the bounds have
    been widened, and whether to go on."""

    point: MultiplierState
    bounds: Bounds
    q: Array
    best: Pair
    steps: Array
    idle: Array
    proof: Proof
    w: Array
    phase: Array
    left: Array
    widened: Array
    open: Array


class RefinementData(NamedTuple):
    """What the steps need: the program, H² (n, n), `correcting_rows`, and whether P, which is not
    0, has been rounded to float32."""

    program: ScaledProgram
    squared: Array
    correcting: tuple[Array, Array]
    rounded: Array


def improve(
    most: int, fixed: bool, whole: bool, single: bool, p: ScaledProgram, begin: MultiplierState
) -> tuple[Pair, Proof, Array, Array]:
    """Improve the point of ADMM by `most` Newton steps at most, in float64. fixed: every instance
    takes them all. whole: with the method of multipliers. single: the data were float32.

    The method of multipliers takes what steps on the dual do not solve: P singular, balls,
    degenerate or infeasible rows.
    Returns the best pair and what is proved, whether there is nothing left to try, and whether the
    last half of many steps, 200 at least, have not made the pair better.
    """
    qp, f, false = p.qp, p.factor, jnp.asarray(False)
    best, go_on = Pair.none(p.q, p.bounds.l), ~false
    correcting = correcting_rows(qp)
    if has_dual_steps(qp.balls, qp.A) and not fixed:
        # The dual of an infeasible program has no maximum: steps towards it would be wasted.
        empty = proved_empty(p, correcting, begin)
        best, y = solve_dual(p, begin.y, ~f.flat & ~empty, most)
        go_on = ~best.finished
        # Multipliers that grow without bound are nearly a Farkas vector.
        lost = infinity_norm(y) > Dual.of(p).limit
        begin = replace(begin, change=jnp.where(lost, y, begin.change))
        begin = least_violation(begin, empty)
    if not whole:
        return best, Proof.none(p.q, p.bounds.l), best.finished, false
    rounded, none = jnp.any(f.H != 0) & single, jnp.int32(0)
    given = RefinementData(p, matmul(f.H, f.H), correcting, rounded)
    s = Refinement(
        point=begin,
        bounds=p.bounds,
        q=p.q,
        best=best,
        steps=none,
        idle=none,
        proof=Proof.none(p.q, p.bounds.l),
        w=begin.w,
        phase=jnp.int32(Phase.MULTIPLIERS),
        left=jnp.int32(most),
        widened=false,
        open=go_on,
    )
    if fixed:
        length = most + 4 * proof_steps(most)
        s = varying(s, (s, given))
        step = lambda s, _: (tree_where(s.open, advance(most, given, s), s), None)
        s = lax.scan(step, s, length=length)[0]
    else:
        m, n = qp.A.shape
        work = 2 * m * n * n  # of A'DA
        s = repeat_while(lambda s: s.open, partial(advance, most), given, s, "long", work=work)
        if has_dual_steps(qp.balls, qp.A):
            s = replace(s, best=corrected_end(p, s))
    return s.best, s.proof, ~false, s.idle > max(most // 2, LEAST_IDLE)


def proved_empty(p: ScaledProgram, correcting: Correcting, begin: MultiplierState) -> Array:
    """Return whether the last change of ADMM's multipliers is a Farkas vector.

    Beside kernels it is asked of those changes alone whose support is negative before it is
    corrected: nine in ten of those that are one, and 1 % of the others at most (joint, springs of
    4 and 8 states). Elsewhere one more loop costs more to compile than it saves."""

    def ask(given: tuple, _: tuple[Array, Array]) -> tuple[Array, Array]:
        p, correcting, begin = given
        allowed = p.eps * row_sizes(0.0, p.qp.row_sizes, p.typical_sizes(begin.w, begin.y))
        empty = farkas(p.qp, p.factor.E * begin.change, correcting, allowed)[2]
        return jnp.asarray(False), empty

    given, false = (p, correcting, begin), jnp.asarray(False)
    if not has_kernels(len(begin.y)):
        return ask(given, (false, false))[1]
    support = jnp.sum(p.bounds.support(p.bounds.admissible(begin.change)))
    return repeat_while(lambda s: s[0], ask, given, (support < 0, false), steps="long")[1]


def corrected_end(p: ScaledProgram, s: Refinement) -> Pair:
    """Return the best pair after corrections from where the method of multipliers ends.

    Its penalty multiplies the rounding of rows, so that it stops short of rounding. Where the
    Hessian H in ADMM's coordinates is singular a correction is a step of the proximal point method:
    with I − H as the proximal term the Hessian is I, and the minimiser without rows is
    w − (Hw + q + A'y)."""
    f, point = p.factor, s.point
    gradient = matmul(point.w, f.H) + s.q + matmul(point.y, f.A)
    begin = DualPoint(point.y, point.w, matmul(point.w, f.A.T))
    go_on = ~s.best.finished & ~s.proof.beyond & ~s.proof.unbounded & jnp.isfinite(s.best.error)
    start = Correction(begin, gradient, s.best, jnp.int32(0), go_on)
    return corrected(MOST_STEPS, replace(p, bounds=s.bounds), start).best


def proof_steps(most: int) -> int:
    """Return the Newton steps towards a Farkas vector; twice as many towards a ray."""
    return max(min(most // 5, 100), 1)


def advance(most: int, given: RefinementData, s: Refinement) -> Refinement:
    """Take one Newton step of the present phase, measure its pair and look for a proof: at first of
    the method of multipliers, `most` times at most; see `next_phase`."""
    p, f = given.program, given.program.factor
    primal, distance = s.phase == Phase.MULTIPLIERS, s.phase == Phase.DISTANCE
    at, phi = _minimised(given, s, primal, distance)
    step = newton_step(at, phi, f.A)
    stiff = s.point.rho >= Constants.of(s.w.dtype).rho[1]
    point = tree_where(primal, multipliers_update(s.q, s.point, step), s.point)
    pair, gradient, tolerances = p.measure(point.w, point.y)
    # What rounding of T'PT hides of the gradient counts as a part of q (defect correction).
    q = s.q + gradient - (matmul(point.w, f.H) + s.q + matmul(point.y, f.A))
    ray = jnp.where(distance, point.move, step.w)
    y = jnp.where(primal, point.change, step.excess)
    proved = prove(p.qp, f.T, f.E, given.correcting, tolerances, y, ray, balance=True)
    proof = s.proof.joined(proved)
    # Where there is no answer, the best is the point of least violation, at which this ends.
    best = tree_where(primal, s.best.or_better(pair), s.best)
    idle = jnp.where(best.error < 0.5 * s.best.error, 0, s.idle + primal)
    best = tree_where(proof.beyond & ~best.finished, pair, best)
    steps, left = s.steps + primal, s.left - 1
    new = replace(s, point=point, q=q, best=best, steps=steps, idle=idle, proof=proof, left=left)
    return next_phase(most, p, new, step, stiff, primal, distance)


def _minimised(
    given: RefinementData, s: Refinement, primal: Array, distance: Array
) -> tuple[Array, Augmented]:
    """Return where the step of the present phase begins, and what it minimises."""
    p, H = given.program, given.program.factor.H
    hard, (H_ray, q_ray, cone) = p.bounds.hard(), recession(given.squared, p.q, p.bounds)
    if s.bounds.linear is not None:  # of one structure, so that one of them can be taken
        linear = jnp.full_like(s.bounds.linear, jnp.inf)
        quadratic = jnp.zeros_like(s.bounds.quadratic)
        hard = replace(hard, linear=linear, quadratic=quadratic)
        cone = replace(cone, linear=linear, quadratic=quadratic)
    damping, y, q = Constants.of(s.w.dtype).damping, jnp.zeros_like(s.point.y), s.q
    # In float32 what ADMM says of directions without curvature that no active row stops is rounding
    # of P divided by a ridge: until φ is minimised first, its proximal term is centred at 0.
    centred = H + s.point.sigma * (jnp.eye(len(H), dtype=H.dtype) - H)
    H = jnp.where(given.rounded & (s.point.sigma == SIGMA), centred, H)
    multipliers = Augmented(s.point.y, H, q, s.bounds, s.point.rho, s.point.sigma)
    to_rows = Augmented(y, 0 * H, 0 * q, hard, 1.0, damping)
    to_ray = Augmented(y, H_ray, q_ray, cone, 1.0, damping)
    return jax.tree.map(
        lambda a, b, c: jnp.where(primal, a, jnp.where(distance, b, c)),
        (s.point.w, multipliers),
        (s.w, to_rows),
        (s.w, to_ray),
    )


def next_phase(
    most: int,
    p: ScaledProgram,
    s: Refinement,
    step: NewtonStep,
    stiff: Array,
    primal: Array,
    distance: Array,
) -> Refinement:
    """Return the state in the phase that follows a step. stiff: whether that had the last penalty.

    After the method of multipliers come steps of least distance; then, if P is singular, of
    `recession`. Rows that contradict each other by less than their tolerances have a solution all
    the same: where that is found, steps of least distance come at once, the bounds are widened by
    what is left of the violation, which is the least, and the method of multipliers begins anew.
    """
    proof, point, flat, few = s.proof, s.point, p.factor.flat, proof_steps(most)
    over = s.left <= 0
    narrow = proof.infeasible & ~proof.beyond & ~s.widened
    ended = s.best.finished | (s.best.measured.within_tolerance & (s.idle >= IDLE))
    ended = ended | proof.unbounded | (proof.beyond & ((stiff & step.minimised) | ~primal))
    to_distance = primal & (over | narrow)
    rested = distance & (over | (narrow & step.minimised))
    widen = rested & narrow & (s.steps < most)
    to_ray = rested & ~widen & flat
    ended = ended | (rested & ~widen & ~flat) | ((s.phase == Phase.RAY) & over)
    phase = jnp.where(to_distance, Phase.DISTANCE, jnp.where(to_ray, Phase.RAY, s.phase))
    left = jnp.where(to_distance, few, jnp.where(to_ray, 2 * few, s.left))
    w = jnp.where(to_distance, point.w, jnp.where(to_ray, to_length_one(point.move), step.w))

    point = least_violation(point, proof.beyond & ~stiff)
    anew = multipliers_start(p.q, step.w, jnp.zeros_like(point.y))
    return replace(
        s,
        bounds=s.bounds.widened(step.excess * widen),
        point=tree_where(widen, anew, point),
        q=tree_where(widen, p.q, s.q),
        w=w,
        phase=jnp.where(widen, Phase.MULTIPLIERS, phase),
        left=jnp.where(widen, most - s.steps, left),
        widened=s.widened | widen,
        open=~ended,
    )


def least_violation(point: MultiplierState, infeasible: Array) -> MultiplierState:
    """Return `point`, or where the program is infeasible the start of a search for the least
    violation of the rows: the last penalty at once, and no multipliers."""
    last = Constants.of(point.w.dtype).rho[1]
    rho, y = jnp.where(infeasible, last, point.rho), jnp.where(infeasible, 0.0, point.y)
    return replace(point, rho=rho, y=y)
