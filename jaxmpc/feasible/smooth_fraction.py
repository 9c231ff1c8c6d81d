"""feasible_fraction: the size of the feasible set, smoothed to have a derivative.

How far x_0 is from keeping all limits is a least-distance problem in the plan z,

    δ(x_0)² = min_z Σ_i dist(C_i z + D_i x_0 + d_i, [l_i + w s_i, u_i − w s_i])² / s_i²,

over the rows of the condensed QP and the terminal ball, each limit tightened by a fraction w of
its own size s_i. The minimum of a convex, once differentiable function has a derivative that takes
no derivative of the minimiser (Danskin 1966): with z held fixed, everything else moves.
1/(1 + (δ/w)²) is then 1 where all limits can be kept with a margin of w, at most ½ where one has to
be met exactly, and falls to 0 outside.
"""

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_array
from jaxmpc.checks import concrete, fail, require_real, require_shape, whole
from jaxmpc.mpc.condense import Condensed, condense
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp import linalg
from jaxmpc.qp.jax_transformations import kept_whole, own_modes, varying
from jaxmpc.qp.linalg import arrays, matmul
from jaxmpc.qp.newton import Augmented, Constants, gram, newton_step, ridged
from jaxmpc.qp.problem import Bounds

# Newton steps at most: most states need 3 to 20.
MOST_STEPS = 60


def feasible_fraction(
    mpc: MPC, x0s: Reals, width: float = 0.02, *, scale: Any = None, newton_steps: int = MOST_STEPS
) -> Array:
    """Return the smoothed fraction of states x0s (B, n) from which hard constraints can be kept.

    width: of the smoothing, > 0, as a fraction of each limit's size.
    scale: these sizes (rows,), in the order of `row_table`; None: half the distance of the two
        sides of a limit, the absolute value of an only side.
    newton_steps: of the search for the plan nearest to the limits.

    The mean of `membership`. Times the volume of the region that x0s samples evenly it is the
    volume of the feasible set, but for the smoothing. Differentiable with respect to every array
    of `mpc` and x0s, in both modes, once.
    """
    return jnp.mean(membership(mpc, x0s, width, scale=scale, newton_steps=newton_steps))


def membership(
    mpc: MPC, x0s: Any, width: Any = 0.02, *, scale: Any = None, newton_steps: int = MOST_STEPS
) -> Array:
    """Return 1/(1 + (δ/width)²) for each of the states x0s (B, n): (B,), between 0 and 1.

    δ: least distance of any plan from the limits tightened by `width`; see above. width > 0: a
    fraction of each limit's size, which is half the distance of its two sides, the absolute value
    of the only side of a one-sided row, the radius (root of the level) of a terminal ellipsoid.
    scale: these sizes (rows,), in the order of `row_table`, if others are wanted. 1: all limits
    can be kept with a margin of `width`; from the boundary of the feasible set outwards at most ½
    (as no plan keeps all limits with a margin there), except where an equality decides: those are
    not tightened. Soft rows do not count. Where input rates are limited a state is (x, u_{−1}).
    States that are not finite count 0; a problem that holds NaN, such as the terminal set of a law
    that does not exist, gives NaN.

    The smaller the width, the sharper: the sum over a grid tends to the number of its points in
    the feasible set. It is an objective for gradient ascent; proofs come from `map_feasible_set`.
    Computed in the dtype of the problem's arrays; float64 is advised. Raises ValueError for wrong
    shapes.
    """
    if mpc.soft and mpc.states is None and mpc.terminal_set is None and not mpc.outputs:
        fail(
            "mpc", "has only soft limits of its states", "Give the hard problem, or jm.harden(mpc)"
        )
    mpc.validate()
    mpc = replace(mpc, soft=(), input_rate_weight=None)  # no part in what is feasible
    for name, value in (("x0s", x0s), ("width", width)):
        require_real(name, value)
    newton_steps = whole("newton_steps", newton_steps, 1)
    x0s, width = (v if hasattr(v, "ndim") else np.asarray(v) for v in map(as_array, (x0s, width)))
    if x0s.ndim != 2 or x0s.shape[1] != mpc.dimension:
        fail("x0s", f"shape {x0s.shape}", f"Give states (B, {mpc.dimension}), one a row")
    x0s, width = arrays((x0s, width))  # JAX's from here on, which compiles
    if concrete(width) and not (np.ndim(width) == 0 and 0 < float(width) < 1):
        fail("width", f"{width}", "Give a fraction of the limits between 0 and 1, such as 0.02")
    condensed = condense(mpc)
    if scale is not None:
        require_shape("scale", scale, condensed.lower.shape, "One size for each row")
        if concrete(scale) and not np.all(np.asarray(scale) > 0):
            fail("scale", "holds an entry that is not positive", "Sizes are positive")
        scale = arrays(scale)
    return _membership(condensed, x0s, width, scale, newton_steps)


@functools.partial(jax.jit, static_argnames="steps")
@own_modes
def _membership(c: Condensed, x0s: Array, width: Array, scale: Any, steps: int) -> Array:
    dtype = c.C.dtype
    width = width.astype(dtype)
    size, tight = _tightened(c, width, None if scale is None else scale.astype(dtype))
    C, D = c.C / size[:, None], c.D / size[:, None]

    def at(D: Array, tight: Bounds, x0: Array) -> Bounds:
        shift = matmul(D, x0) + c.d / size
        return replace(tight, l=tight.l - shift, u=tight.u - shift)

    # Newton starts where two-sided rows are nearest their centres, by least squares.
    both = jnp.isfinite(tight.l) & jnp.isfinite(tight.u)
    centred = jax.lax.stop_gradient(jnp.where(both[:, None], C, 0.0))
    normal = ridged(matmul(centred.T, centred), 1.0)

    def one(x0: Array) -> Array:
        # The minimiser, and which states have one that numbers can hold. Of the distance the first
        # derivative takes it for a constant; the second follows it.
        given = jnp.all(jnp.isfinite(x0))
        x0 = jnp.where(given, x0, 0.0)
        fixed, bounds = jax.lax.stop_gradient((C, at(D, tight, x0)))
        z = linalg.solve(normal, matmul(jnp.where(both, bounds.l + bounds.u, 0) / 2, centred))
        z, e = nearest_point(fixed, bounds, z, steps)
        usable = given & jnp.isfinite(jnp.sum(e**2) / width**4) & jnp.all(jnp.isfinite(z))
        x0, z = jnp.where(usable, x0, 0.0), jax.lax.stop_gradient(jnp.where(usable, z, 0.0))
        weights, normals = bounds.curvature(matmul(z, fixed.T), 1.0)

        def distance(z: Array) -> Array:
            e = at(D, tight, x0).prox_residual(matmul(z, C.T), 1.0)
            # A row that the minimiser just touches is one that it keeps, in all derivatives.
            return jnp.where(weights > 0, e, jax.lax.stop_gradient(e))

        z = _following(z, matmul(distance(z), C), gram(fixed, weights, normals))
        residual = distance(z)
        return jnp.where(usable, 1 / (1 + jnp.sum(residual**2) / width**2), 0.0)

    data = (c.C, c.D, c.d, c.lower, c.upper, c.radius)
    missing = jnp.any(jnp.array([jnp.any(jnp.isnan(part)) for part in jax.tree.leaves(data)]))
    return jnp.where(missing, jnp.nan, jax.vmap(one)(x0s.astype(dtype)))


@jax.custom_jvp
def _following(z: Array, gradient: Array, K: Array) -> Array:
    """Return the minimiser z (n,), a constant, which follows the `gradient` there that the data
    change: dz = −K⁻¹ d(gradient), K the Hessian (n, n)."""
    return z


@_following.defjvp
def _(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    z, gradient, K = primals
    # Where K has no curvature the gradient does not change but by rounding, which must stay small.
    n = len(z)
    ridge = jnp.finfo(z.dtype).eps ** (2 / 3) * (1 + jnp.trace(K) / n)
    dz = -linalg.solve(K + ridge * jnp.eye(n, dtype=z.dtype), tangents[1])
    return kept_whole(_following)(z, gradient, K), dz


def nearest_point(A: Array, bounds: Bounds, w: Array, steps: int) -> tuple[Array, Array]:
    """Minimise ½ dist²(A w, set) as `least_distance` does; return w and the prox residual.

    It ends when the gradient A'e is small beside e, or as small as rounding leaves it for bounds
    of size one. In a batch all wait for the slowest.
    """
    phi = Augmented.distance(bounds, w, Constants.of(w.dtype).damping)
    size = lambda v: jnp.max(jnp.abs(v), initial=0.0)

    def body(carry: tuple[Array, ...]) -> tuple[Array, ...]:
        k, w, _, _ = carry
        step = newton_step(w, phi, A)
        enough = jnp.finfo(w.dtype).eps * (1e4 * size(step.excess) + 30)
        return k + 1, step.w, step.excess, size(step.gradient) <= enough

    start: tuple[Array, ...] = (jnp.asarray(0), w, jnp.zeros_like(bounds.l), jnp.asarray(False))
    start = varying(start, (start, A, bounds))
    _, w, e, _ = jax.lax.while_loop(lambda carry: (carry[0] < steps) & ~carry[3], body, start)
    return w, e


def _tightened(c: Condensed, width: Array, scale: Any) -> tuple[Array, Bounds]:
    """Return the size of each row, and the bounds tightened by `width` of it and divided by it."""
    has_low, has_high = jnp.isfinite(c.lower), jnp.isfinite(c.upper)
    low, high = jnp.where(has_low, c.lower, 0.0), jnp.where(has_high, c.upper, 0.0)
    room = (high - low) / 2
    balls = sum(c.balls)
    if scale is None:
        scale = jnp.where(has_low & has_high, room, jnp.abs(high + low))
        if balls:
            scale = scale.at[-balls:].set(jnp.repeat(c.radius, np.array(c.balls)))
        scale = jnp.where(scale > 0, scale, 1.0)
    take = jnp.where(has_low & has_high, jnp.minimum(width * scale, room), width * scale)
    radius = None
    if balls:
        ends = len(c.lower) - balls + np.cumsum(c.balls) - 1  # the rows of a ball share their size
        radius = c.radius / scale[ends] - width
    l = jnp.where(has_low, (low + take) / scale, -jnp.inf)
    u = jnp.where(has_high, (high - take) / scale, jnp.inf)
    return scale, Bounds(l, u, radius=radius, balls=c.balls)
