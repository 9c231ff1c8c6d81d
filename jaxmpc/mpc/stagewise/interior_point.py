"""A primal-dual interior point method stage by stage, for what Newton steps alone do not solve.

Mehrotra's predictor and corrector (1992) with one Riccati recursion a step (Rao, Wright, Rawlings
1998). In scaled rows v each bound b of a row, upper (s = 1) or lower (s = −1), has a slack t > 0
and a multiplier z > 0; a soft row with the penalty c e + ½ k e² has its violation e > 0 too:

    s (v − b) − e + t = 0,        t z = μ,        e (c + k e − z) = μ,        μ → 0.

A hard row has e = 0. With ν = c + k e − z a Newton step with targets μ_t, μ_e for the two products
gives de = (μ_e − e ν + e dz) / (ν + k e) and dz = ω s dv + β with

    ω = z / (t + z e / (ν + k e)),        r = s (v − b) − e + t,
    β = (μ_t − t z + z r − z (μ_e − e ν) / (ν + k e)) / (t + z e / (ν + k e)).

What is left is an LQR problem with the weights ω on the rows. It converges from any start, in 5 to
20 steps, where Newton steps on the active rows may cycle. The matrices stay bounded where a soft
row is violated: there ω → k.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.mpc.stagewise.stages import conditions, measured_pair, minimise, riccati
from jaxmpc.pytrees import pytree
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import Pair

# Steps at most.
INTERIOR_STEPS = 40
# Slack of the first step at least, in scaled rows; part of the way to the boundary that is taken;
# and the part of a step below which the iterates have come to rest.
LEAST_SLACK, FRACTION, REST = 1e-2, 0.995, 1e-8
# Of a proximal term on the multipliers: weights of 1e11 and more would be lost in rounding.
DAMPING = 1e-11


class Sides(NamedTuple):
    """A number for each side of each row, upper first: arrays (2, rows). t, z, e: top of this
    file."""

    t: Array
    z: Array
    e: Array

    def moved(self, by: "Sides", length: Array) -> "Sides":
        """Return the point `length` of the way along the step `by`."""
        return Sides(*(v + length * d for v, d in zip(self, by, strict=True)))


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
            soft = present & finite
            c, k = jnp.where(finite, bounds.linear, c), jnp.where(finite, bounds.quadratic, k)
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
class InteriorState:
    """Loop state of one instance: inputs u (N, m), the sides' numbers, the best pair of all so far,
    the steps taken, and whether to go on."""

    u: Array
    at: Sides
    best: Pair
    steps: Array
    open: Array

    @classmethod
    def begin(cls, best: Pair) -> "InteriorState":
        """Return the state before the first step, which will go from the inputs of `best` to those
        of least cost without rows."""
        blank = jnp.zeros((2, len(best.y)), best.y.dtype)
        at = Sides(blank, blank, blank)
        return cls(best.z, at, best, jnp.int32(0), ~(best.near | best.finished))


def interior_step(most: int, constants: tuple, state: InteriorState) -> InteriorState:
    """One step; the search ends after `most`, when the residuals are below a thousandth of eps, one
    step after they are small enough, or when the iterates have come to rest.

    constants: stages, row scale E (rows,), the multipliers `fixed` (rows,) of soft rows
    that no input moves, 0 in others, and eps.
    """
    s, E, fixed, eps = constants
    limits, at, first = Limits.of(s.bounds.scaled(E)), state.at, state.steps == 0
    found = conditions(s, state.u, fixed + E * limits.multipliers(at))
    nu, has = limits.nu(at), limits.present
    v = E * found.rows
    r = limits.sign * (v - limits.b) - at.e + at.t
    bend = jnp.where(limits.soft & ~first, nu + limits.k * at.e, 1.0)
    loose = jnp.where(has & ~first, at.t + at.z * (at.e / bend + DAMPING), 1.0)
    omega = jnp.where(has, at.z / loose, 0.0)
    gains = riccati(s, jnp.sum(omega, axis=0) * E**2)

    def direction(targets: Array) -> tuple[Array, Array, Sides]:
        """Return the Newton step towards t z, e ν = targets (2, 2, rows): rows, inputs, sides."""
        far = targets[0] - at.t * at.z
        give = jnp.where(limits.soft, (targets[1] - at.e * nu) / bend, 0.0)
        beta = jnp.where(has, (far + at.z * (r - give)) / loose, 0.0)
        gx, gu = s.pull(E * jnp.sum(limits.sign * beta, axis=0))
        dx, du = minimise(s, gains, -gx, -gu - found.gradient)
        dv = E * s.rows(dx, du)
        dz = omega * limits.sign * dv + beta
        de = give + at.e * dz / bend
        return dv, du, Sides(de - r - limits.sign * dv, dz, de)

    mean = limits.mean(at)
    *_, guess = direction(jnp.zeros((2, *r.shape), r.dtype))
    reached = at.moved(guess, jnp.minimum(limits.length(at, guess), 1.0))
    centre = mean * (limits.mean(reached) / jnp.where(mean > 0, mean, 1.0)) ** 3
    curved = jnp.stack([guess.t * guess.z, guess.e * (limits.k * guess.e - guess.z)])
    dv, du, step = direction(centre - curved)
    length = jnp.minimum(FRACTION * limits.length(at, step), 1.0)
    sound = jnp.all(jnp.isfinite(du)) & (first | (length > REST))
    length = jnp.where(sound, jnp.where(first, 1.0, length), 0.0)
    clean = lambda tree: jax.tree.map(lambda d: jnp.where(sound, d, 0.0), tree)
    u = state.u + length * clean(du)
    begun, at = limits.start(v + dv), at.moved(clean(step), length)
    at = jax.tree.map(lambda a, b: jnp.where(first, a, b), begun, at)
    y = fixed + E * limits.multipliers(at)
    pair = measured_pair(eps, s, u, y)
    best, again = (
        state.best.or_better(pair),
        pair.measured.within_tolerance & state.best.measured.within_tolerance,
    )
    steps = state.steps + 1
    wanted = ~(best.near | best.finished | again) & sound & (steps < most)
    return InteriorState(u, at, best, steps, wanted)
