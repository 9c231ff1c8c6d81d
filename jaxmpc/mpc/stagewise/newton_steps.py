"""Newton steps stage by stage, on the active rows and of an interior point method; the search that
they are part of, and the derivative of what it finds. Each costs one Riccati recursion.

**On the active rows.** In scaled rows v, multipliers y/E and with the residual e(v) = v − prox(v)
of `qp/problem.py` the optimality conditions are gradient = 0 and e(v + y/ρ) = y/ρ. With the
derivative D of e a semismooth Newton step from moves z (N, m), the inputs where there is no gain,
and multipliers y (rows,) asks

    gradient + P dz + rows'dy = 0,        dy (1 − D)/ρ = D dv + c,    c = e − y/ρ.

Where D = 1 (a row held at its bound) 0·dy becomes dy/κ with a large κ, a proximal step on y:
dy = ω dv + ω_c c, with ω = ρ D/(1 − D + D ρ/κ) and ω_c = ρ/(1 − D + D ρ/κ). What is left is an LQR
problem with penalties ω, one Riccati recursion. Rows are held by v + y/ρ of ADMM's own ρ, so that κ
does not disturb the guess; it costs accuracy only within a step, since each starts from residuals
of the data.

**Interior point method**, for what these alone do not solve: Mehrotra's predictor and corrector
(1992; Rao, Wright, Rawlings 1998). In scaled rows v each bound b of a row, upper (s = 1) or lower
(s = −1), has a slack t > 0 and a multiplier z > 0; a soft row with the penalty c e + ½ k e² has its
violation e > 0 too:

    s (v − b) − e + t = 0,        t z = μ,        e (c + k e − z) = μ,        μ → 0.

A hard row has e = 0. With ν = c + k e − z a Newton step with targets μ_t, μ_e for the two products
gives de = (μ_e − e ν + e dz) / (ν + k e) and dz = ω s dv + β with

    ω = z / (t + z e / (ν + k e)),        r = s (v − b) − e + t,
    β = (μ_t − t z + z r − z (μ_e − e ν) / (ν + k e)) / (t + z e / (ν + k e)).

What is left is an LQR problem with the weights ω on the rows. The targets are Mehrotra's, μ (μ'/μ)³
with μ' what the step to μ = 0 reaches, but at least (1 − α) μ where a part α of that step can be
taken: where a single product is far below the others steps are short, and without that so are the
next thirty. It converges from any start, in 5 to 20 steps, where Newton steps on the active rows
may cycle. The matrices stay bounded where a soft row is violated: there ω → k.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.mpc.stagewise.recursion_kernels import Gains
from jaxmpc.mpc.stagewise.stages import (
    Stages,
    conditions,
    measured_pair,
    minimise,
    residuals_of,
    riccati,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import scaled_multipliers
from jaxmpc.qp.jax_transformations import Undo
from jaxmpc.qp.linalg import precisely, rounding
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import Pair

# Steps of the interior point method at most.
INTERIOR_STEPS = 60
# Slack of the first step at least, in scaled rows; part of the way to the boundary that is taken;
# and the part of a step below which the iterates have come to rest.
LEAST_SLACK, FRACTION, REST = 1e-2, 0.995, 1e-8
# Of second-order terms of products at most, in units of their mean.
MOST_CURVED = 10.0
# Where rounding stops the method: its own residuals, once below BEGUN, grow LOST times.
BEGUN, LOST = 1e-3, 100.0
# κ of derivatives: where Newton's leaves a share of 1e-2 this leaves 1e-4 at each step.
KAPPA = 1e8
# Of a proximal term on the multipliers: weights of 1e11 and more would be lost in rounding.
DAMPING = 1e-11


class Errors(NamedTuple):
    """How far the optimality conditions are from holding: v + y/ρ and c (rows,), the gradient
    (N, m); see top of this file."""

    v: Array
    c: Array
    gradient: Array

    @classmethod
    def of(cls, s: Stages, E: Array, rho: Array, z: Array, y: Array) -> "Errors":
        """Return those of moves z (N, m) and multipliers y (rows,)."""
        found, push = conditions(s, z, y), scaled_multipliers(E, y) / rho
        v = E * found.rows + push
        return cls(v, s.bounds.scaled(E).prox_residual(v, rho) - push, found.gradient)


def distance(s: Stages, E: Array, rho: Array, z: Array, y: Array) -> Array:
    """Return how far the conditions are from holding as a number in units of the cost: Σ ρ c², c in
    rows of variance 1 under exp(−J), and Σ gradient²/R over the inputs.

    Beside a hundred times that of zero it tells a warm start from numbers that are none, such as
    the plan of a state far off.
    """
    _, c, gradient = Errors.of(s, E, rho, z, y)
    weight = jnp.diagonal(s.R, axis1=-2, axis2=-1)
    return jnp.sum(rho * c**2) + jnp.sum(gradient**2 / jnp.where(weight > 0, weight, 1.0))


def newton_direction(
    s: Stages, E: Array, rho: Array, v: Array, kappa: float | None = None
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Return the linear map (c, gradient) → (dz, dy) of a Newton step at v + y/ρ (rows,). kappa: κ,
    None for that of Newton's method."""
    D = s.bounds.scaled(E).curvature(v, rho)[0]
    loose = 1 - D + D * rho / (Constants.of(E.dtype).linear if kappa is None else kappa)
    omega = rho * D / loose
    gains = riccati(s, omega * E**2)

    def step(c: Array, gradient: Array) -> tuple[Array, Array]:
        push = rho * c / loose
        dx, du = descent(s, gains, E * push, gradient)
        return s.moves(dx, du), E * (omega * E * s.rows(dx, du) + push)

    return step


def descent(s: Stages, gains: Gains, pushes: Array, gradient: Array) -> tuple[Array, Array]:
    """Return dx (N+1, n), du (N, m) of least penalised cost + pushes·rows + gradient·moves; pushes
    (rows,), gradient (N, m)."""
    gx, gu = s.pull(pushes)
    return minimise(s, gains, s.at_fixed_moves(-gx, gradient), -gu - gradient)


def stage_newton_step(s: Stages, E: Array, rho: Array, z: Array, y: Array) -> tuple[Array, Array]:
    """Return moves z (N, m) and multipliers y (rows,) after a Newton step."""
    v, c, gradient = Errors.of(s, E, rho, z, y)
    dz, dy = newton_direction(s, E, rho, v)(c, gradient)
    return z + dz, y + dy


class Sides(NamedTuple):
    """A number for each side of each row, upper first: arrays (2, rows). t, z, e: top of this
    file."""

    t: Array
    z: Array
    e: Array


def advanced(at: Any, step: Any, length: Array) -> Any:
    """Return the point `length` of the way along a step."""
    return jax.tree.map(lambda v, d: v + length * d, at, step)


class Limits(NamedTuple):
    """The bounds of all rows: sign s (2, 1), bound b (2, rows), 0 where there is none; whether
    there is one; whether it is soft; the penalty's c, 1 in hard rows, and k, 0 in hard rows."""

    sign: Array
    b: Array
    present: Array
    soft: Array
    c: Array
    k: Array

    @classmethod
    def of(cls, bounds: Bounds) -> "Limits":
        """Return the limits of scaled rows."""
        b = jnp.stack([bounds.u, bounds.l])
        present = jnp.isfinite(b)
        soft = jnp.zeros_like(present)
        c, k = jnp.ones_like(bounds.u), jnp.zeros_like(bounds.u)
        if bounds.linear is not None:
            finite = jnp.isfinite(bounds.linear)
            c, k = jnp.where(finite, bounds.linear, c), jnp.where(finite, bounds.quadratic, k)
            present &= (c > 0) | (k > 0)  # with no penalty 0 < z < c + k e holds nowhere
            soft = present & finite
        sign = jnp.array([[1.0], [-1.0]], b.dtype)
        return cls(sign, jnp.where(present, b, 0.0), present, soft, c, k)

    def nu(self, at: Sides) -> Array:
        """Return the multiplier ν = c + k e − z of e ≥ 0."""
        return self.c + self.k * at.e - at.z

    def products(self, at: Sides) -> Array:
        """Return t z and e ν of all sides (2, 2, rows), 0 where there is none."""
        products = jnp.stack([at.t * at.z, at.e * self.nu(at)])
        return jnp.where(jnp.stack([self.present, self.soft]), products, 0.0)

    def mean(self, at: Sides) -> Array:
        """Return μ, the mean of the products."""
        count = jnp.sum(self.present) + jnp.sum(self.soft)
        return jnp.sum(self.products(at)) / jnp.maximum(count, 1)

    def length(self, at: Sides, step: Sides) -> Array:
        """Return how far a step leaves all of t, z, e and ν positive, 1e30 at most."""
        change = self.k * step.e - step.z
        sides = (at.t, step.t, self.present), (at.z, step.z, self.present)
        pairs = (*sides, (at.e, step.e, self.soft), (self.nu(at), change, self.soft))
        positive = ((v, d, has & (v > 0)) for v, d, has in pairs)
        shrink = [jnp.where(has, -d / jnp.where(has, v, 1.0), 0.0) for v, d, has in positive]
        return 1 / jnp.maximum(jnp.max(jnp.stack(shrink), initial=0.0), 1e-30)

    def multipliers(self, at: Sides) -> Array:
        """Return the multipliers of the rows (rows,)."""
        return jnp.sum(self.sign * jnp.where(self.present, at.z, 0.0), axis=0)

    def start(self, v: Array) -> Sides:
        """Return slacks, multipliers and violations to begin with at the scaled rows v (rows,)."""
        outside = jnp.where(self.present, self.sign * (v - self.b), 0.0)
        size = jnp.maximum(jnp.max(outside, initial=0.0), LEAST_SLACK)
        # From a μ far below the multipliers of the solution steps are short: penalties limit them.
        most = jnp.max(jnp.where(self.soft, self.c, 0.0), initial=0.0)
        mu = size * (100 * size + most / 10)
        # With t given, t z = e ν = μ: a quadratic equation for e where there is a bend k.
        t = jnp.maximum(-outside, size)
        bent = self.k > 0
        z = jnp.where(self.soft & ~bent, mu * self.c / (mu + self.c * t), mu / t)
        k, over = jnp.where(bent, self.k, 1.0), z - self.c
        e = jnp.where(bent, (over + jnp.sqrt(over**2 + 4 * k * mu)) / (2 * k), mu / -over)
        return Sides(t, z, jnp.where(self.soft, e, 0.0))


@pytree
class SearchState:
    """Loop state of one instance: moves z (N, m), multipliers y (rows,) or, of the interior point
    method, the sides' numbers, the rows, the gradient (N, m) of the Lagrangian and the least error
    that it came to itself; the best pair of all so far, the steps taken, and whether to go on."""

    z: Array
    dual: Any
    best: Pair
    steps: Array
    open: Array

    @classmethod
    def begin(cls, best: Pair, dual: Any) -> "SearchState":
        """Return the state before the first step, from the moves of `best`."""
        return cls(best.z, dual, best, jnp.int32(0), ~(best.near | best.finished))


def newton_search_step(most: int, constants: tuple, state: SearchState) -> SearchState:
    """One Newton step; the search ends after `most`, or below a thousandth of eps.

    constants: stages, row scale E (rows,), rho (rows,) and eps.
    """
    s, E, rho, eps = constants
    z, y = stage_newton_step(s, E, rho, state.z, state.dual)
    best, steps = state.best.or_better(measured_pair(eps, s, E, z, y)), state.steps + 1
    return SearchState(z, y, best, steps, ~(best.near | best.finished) & (steps < most))


def interior_step(most: int, constants: tuple, state: SearchState) -> SearchState:
    """One interior point step, of which the first leads to the moves of least cost without rows;
    the search ends after `most`, when the residuals are below a thousandth of eps, one
    step after they are small enough, or when the iterates have come to rest.

    constants: stages, row scale E (rows,), the multipliers `fixed` (rows,) of soft rows
    that no input moves, 0 in others, and eps.
    """
    s, E, fixed, eps = constants
    limits, (at, rows, gradient, least) = Limits.of(s.bounds.scaled(E)), state.dual
    first = state.steps == 0
    nu, has = limits.nu(at), limits.present
    v = E * rows
    r = limits.sign * (v - limits.b) - at.e + at.t
    bend = jnp.where(limits.soft & ~first, nu + limits.k * at.e, 1.0)
    loose = jnp.where(has & ~first, at.t + at.z * (at.e / bend + DAMPING), 1.0)
    omega = jnp.where(has, at.z / loose, 0.0)
    gains = riccati(s, jnp.sum(omega, axis=0) * E**2)

    def direction(targets: Array) -> tuple[Array, Array, Sides]:
        """Return the Newton step towards t z, e ν = targets (2, 2, rows): rows, moves, sides."""
        far = targets[0] - at.t * at.z
        give = jnp.where(limits.soft, (targets[1] - at.e * nu) / bend, 0.0)
        beta = jnp.where(has, (far + at.z * (r - give)) / loose, 0.0)
        dx, du = descent(s, gains, E * jnp.sum(limits.sign * beta, axis=0), gradient)
        dv = E * s.rows(dx, du)
        dz = omega * limits.sign * dv + beta
        de = give + at.e * dz / bend
        return dv, s.moves(dx, du), Sides(de - r - limits.sign * dv, dz, de)

    mean = limits.mean(at)
    *_, guess = direction(jnp.zeros((2, *r.shape), r.dtype))
    reach = jnp.minimum(limits.length(at, guess), 1.0)
    ratio = limits.mean(advanced(at, guess, reach)) / jnp.where(mean > 0, mean, 1.0)
    centre = mean * jnp.maximum(ratio**3, 1 - reach)
    curved = jnp.stack([guess.t * guess.z, guess.e * (limits.k * guess.e - guess.z)])
    dv, moved, step = direction(centre - jnp.clip(curved, -MOST_CURVED * mean, MOST_CURVED * mean))
    length = jnp.minimum(FRACTION * limits.length(at, step), 1.0)
    sound = jnp.all(jnp.isfinite(moved)) & (first | (length > REST))
    length = jnp.where(sound, jnp.where(first, 1.0, length), 0.0)
    clean = lambda tree: jax.tree.map(lambda d: jnp.where(sound, d, 0.0), tree)
    z = state.z + length * clean(moved)
    begun, at = limits.start(v + dv), advanced(at, clean(step), length)
    at = jax.tree.map(lambda a, b: jnp.where(first, a, b), begun, at)
    y = s.bounds.admissible(fixed + E * limits.multipliers(at))
    found = conditions(s, z, y)
    pair = Pair.of(z, y, residuals_of(s, E, z, y, found), eps, rounding(z.dtype))
    again = pair.measured.within_tolerance & state.best.measured.within_tolerance
    best, steps = state.best.or_better(pair), state.steps + 1
    lost = (least < BEGUN) & (pair.error > LOST * least)
    wanted = ~(best.near | best.finished | again | lost) & sound & (steps < most)
    dual = at, found.rows, found.gradient, jnp.minimum(least, pair.error)
    return SearchState(z, dual, best, steps, wanted)


class Search(NamedTuple):
    """Newton steps, and after them interior point steps, at most so many of each. loop(step, most,
    constants, state): repeats a step while the state is open."""

    newton: int
    interior: int
    loop: Callable[[Callable, int, tuple, Any], Any]

    def from_pair(
        self, s: Stages, E: Array, rho: Array, fixed: Array, eps: Array, best: Pair, wanted: Array
    ) -> Pair:
        """Return the best pair that is found from one. fixed (rows,): the multipliers of soft rows
        that no input moves, 0 in others. wanted: whether interior point steps may follow."""
        step: Callable = partial(newton_search_step, self.newton)
        best = self.loop(step, self.newton, (s, E, rho, eps), SearchState.begin(best, best.y)).best
        if not self.interior:
            return best
        blank = jnp.zeros((2, len(best.y)), best.y.dtype)
        found = conditions(s, best.z, fixed)
        least = jnp.asarray(jnp.inf, best.y.dtype)
        dual = Sides(blank, blank, blank), found.rows, found.gradient, least
        begun = SearchState.begin(best, dual)
        begun = replace(begun, open=begun.open & wanted)
        step = partial(interior_step, self.interior)
        return self.loop(step, self.interior, (s, E, fixed, eps), begun).best


def stage_conditions(
    s: Stages, constants: tuple[Array, Array], z: Array, y: Array
) -> tuple[Callable[[Any], Any], Undo]:
    """The `conditions_of` that `qp.derivative.implicit` takes for the stages and (E, ρ).

    The conditions F(s, z, y) = 0 hold at a solution, hence J d(z, y) = −dF with the matrix J of a
    Newton step: one Riccati recursion, whatever the number of iterations, in float64 as in
    `qp/derivative.py`. Rows that touch with a zero multiplier count as inactive.
    """
    E, rho = constants
    v = Errors.of(s, E, rho, z, y).v
    flat = lambda moves, rows: jnp.concatenate([moves.ravel(), rows])
    split = lambda d: (d[: z.size].reshape(z.shape), d[z.size :])

    def conditions_at(s: Stages) -> Array:
        _, c, gradient = Errors.of(s, E, rho, z, y)
        return flat(gradient, c)

    def J(s: Stages, E: Array, rho: Array, v: Array, d: Array) -> Array:
        dz, dy = split(d)
        at = jnp.zeros_like(dz), jnp.zeros_like(dy)
        found = jax.jvp(partial(conditions, s), at, (dz, dy))[1]
        push, D = scaled_multipliers(E, dy) / rho, s.bounds.scaled(E).curvature(v, rho)[0]
        return flat(found.gradient, D * (E * found.rows + push) - push)

    def inverse(s: Stages, E: Array, rho: Array, v: Array, b: Array) -> Array:
        step = newton_direction(s, E, rho, v, KAPPA)
        zero = jnp.zeros_like(y, E.dtype), jnp.zeros_like(z, E.dtype)

        def follow(b: Array) -> Array:
            gradient, c = split(-b)
            # The step is linear; as a derivative of itself it can be transposed, kernels or not.
            return flat(*jax.jvp(step, zero, (c, gradient))[1])

        # The proximal step on y leaves a share 1/(1 + κ s²) where the active rows have the least
        # singular value s, which is small where inputs cost little; a second step the square of it,
        # and the rounding of κ, which a third takes away.
        found = follow(b)
        for _ in range(2):
            found = found + follow(b - J(s, E, rho, v, found))
        return found

    def transposed(s: Stages, E: Array, rho: Array, v: Array, b: Array) -> Array:
        return jax.linear_transpose(partial(inverse, s, E, rho, v), b)(b)[0]

    at = jax.lax.stop_gradient((s, E, rho, v))

    def undo(moved: Array) -> tuple[Array, Array]:
        # In one vector: a part without tangents could not be transposed.
        solve = lambda _, b: precisely(inverse, *at, b)
        solve_transposed = lambda _, b: precisely(transposed, *at, b)
        along = partial(J, s, E, rho, v)
        return split(jax.lax.custom_linear_solve(along, -moved, solve, solve_transposed))

    return conditions_at, undo
