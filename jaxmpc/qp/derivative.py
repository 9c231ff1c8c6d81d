"""Derivatives of the solution map (P, q, A, l, u, …) → (z, y), by the implicit function theorem.

At a solution the conditions Pz + q + A'y = 0 and e(Az + y/ρ) = y/ρ hold for every ρ > 0, with the
prox residual e(v) = v − prox(v) (`projection.py`). With the formula of e in each row, the active
set, held fixed they are smooth, and a change of the
data moves (z, y) by one linear system, which `kkt_system.linearised` solves in ADMM's coordinates.
JAX transposes that for reverse mode and differentiates it again for higher orders.

Which element of the generalised derivative is taken, and what it means where none exists:

* A hard row counts as active where it has a multiplier. One that only touches, y = 0, counts as
  inactive. An equality is always active; its multiplier's sign says which of l, u it follows (each
  by half where y = 0).
* Smoothing μ > 0 replaces the 0 or 1 of "active" by k/(ρ + k), k = Σ μ/s² over both sides, with
  the slacks s = (τ + √(τ² + 4μ))/2, τ = slack − multiplier, of the central path (Chen, Harker,
  Kanzow, Smale): the stiffness of a log barrier. (z, y) stay those of the exact solution;
  equalities, soft rows and balls are not smoothed.
* Where active rows depend on each other, the least-squares answer (see `linearised`).
* A row that is violated and has a multiplier of the same sign (the program is infeasible, or not
  yet solved) counts as a soft row with the quadratic weight k = y/violation. For an infeasible
  program the method of multipliers ends at the point that violates the rows least, with a large
  k: the derivative is that of the closest feasible program (Bambade et al. 2024, QPLayer), up to
  about 1/k.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.admm import Factor, scaled, scaled_rows
from jaxmpc.qp.jax_modes import own_modes
from jaxmpc.qp.kkt_system import linearised
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import Bounds

# Maps tangents of the optimality conditions to tangents of (z, y) that undo them; linear.
Undo = Callable[[Any], tuple[Array, Array]]
Conditions = Callable[[Any, Any, Array, Array], tuple[Callable[[Any], Any], Undo]]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def implicit(
    conditions_of: Conditions, data: Any, constants: Any, z: Array, y: Array
) -> tuple[Array, Array]:
    """Return the solution (z, y), given as constants, with its derivatives with respect to `data`.

    conditions_of(data, constants, z, y) gives the optimality conditions as a function of the data
    alone, with z, y and the active set held fixed, and the function that maps a change of them to
    the change of (z, y) that undoes it.
    """
    return z, y


@implicit.defjvp
@own_modes
def _implicit_jvp(conditions_of: Conditions, primals: tuple, tangents: tuple) -> tuple:
    data, constants, z, y = primals
    # As a result of this function, z and y carry the derivatives that higher orders need.
    z, y = implicit(conditions_of, data, constants, z, y)

    def moved(data: Any, constants: Any, z: Array, y: Array, change: Any) -> tuple[Array, Array]:
        conditions, undo = conditions_of(data, constants, z, y)
        return undo(jax.jvp(conditions, (data,), (change,))[1])

    # Going backward, all but these arguments is computed then: held, it would be several times as
    # much for each solve of a closed loop.
    return (z, y), jax.checkpoint(moved)(data, constants, z, y, tangents[0])


def dense_conditions(
    qp: QP, constants: tuple[Factor, Any], z: Array, y: Array
) -> tuple[Callable[[QP], tuple[Array, Array]], Undo]:
    """The `conditions_of` that `implicit` takes for a program and (factor, smoothing)."""
    factor, smoothing = constants
    T, E = factor.T, factor.E
    A = E[:, None] * matmul(qp.A, T)
    H = matmul(T.T, matmul(qp.P, T))
    rho = Constants.of(z.dtype).linear
    _, bounds, unit = scaled(factor, qp)
    v, y_w = scaled_rows(factor, qp, unit, z, y)
    # μ is a product of a slack and a multiplier, each of which is measured in the unit.
    upper, lower, others = activity(bounds, v, y_w, smoothing / unit**2, rho)

    def conditions(qp: QP) -> tuple[Array, Array]:
        bounds = qp.bounds.scaled(E).divided(unit)
        v = E * matmul(z, qp.A.T) / unit
        sides = upper * (v - bounds.u) + lower * (v - bounds.l)
        rows = jnp.where(others, bounds.prox_residual(v + y_w / rho, rho), sides)
        return matmul(matmul(z, qp.P) + qp.q + matmul(y, qp.A), T) / unit, rows

    weights, normals = bounds.curvature(v + y_w / rho, rho)
    weights = jnp.where(others, weights, upper + lower)
    inverse = linearised(H, A, weights, normals, rho, factor.flat)

    def undo(moved: tuple[Array, Array]) -> tuple[Array, Array]:
        dw, dy = inverse(*moved)
        return unit * matmul(dw, T.T), unit * E * dy

    return conditions, undo


class Activity(NamedTuple):
    """How far each hard row counts as active: weights in [0, 1] of its upper and its lower bound;
    and which rows are others (soft ones, balls), whose prox residual stands as it is."""

    upper: Array
    lower: Array
    others: Array


def activity(bounds: Bounds, v: Array, y: Array, smoothing: float | Array, rho: float) -> Activity:
    """Return how far rows count as active, with the choices made at the top of this file."""
    precision = jnp.finfo(v.dtype).eps
    others = jnp.arange(v.shape[0]) >= v.shape[0] - sum(bounds.balls)
    if bounds.linear is not None:
        others = others | jnp.isfinite(bounds.linear)

    # Multipliers at rounding level are none.
    pushes = jnp.abs(y) > precision**0.75 * (1 + jnp.max(jnp.abs(y), initial=0.0))
    out = jax.lax.stop_gradient(bounds.violation(v))
    spring = (y * out > 0) & (jnp.abs(out) > 0.1 * jnp.sqrt(precision) * (1 + jnp.abs(v)))
    k = jax.lax.stop_gradient(jnp.where(spring, y / jnp.where(spring, out, 1.0), 0.0))
    active = jnp.where(spring, k / (rho + k), 1.0)
    upper = jnp.where(pushes & (y > 0), active, 0.0)
    lower = jnp.where(pushes & (y < 0), active, 0.0)
    equal = bounds.l == bounds.u
    upper, lower = (jnp.where(equal & ~pushes, 0.5, side) for side in (upper, lower))

    smoothing = jnp.asarray(smoothing, v.dtype)
    mu = jnp.where(smoothing > 0, smoothing, 1.0)

    def stiffness(slack: Array, push: Array) -> Array:
        finite = jnp.isfinite(slack)
        tau = jnp.where(finite, slack - push, 1.0)
        s = (jnp.abs(tau) + jnp.sqrt(tau**2 + 4 * mu)) / 2
        s = jnp.where(tau > 0, s, mu / s)  # the product of both roots is μ
        return jnp.where(finite, mu / s**2, 0.0)

    above = stiffness(bounds.u - v, jnp.maximum(y, 0.0))
    below = stiffness(v - bounds.l, jnp.maximum(-y, 0.0))
    rounded = (smoothing > 0) & ~equal & ~spring
    total = rho + above + below
    upper = jnp.where(others, 0.0, jnp.where(rounded, above / total, upper))
    lower = jnp.where(others, 0.0, jnp.where(rounded, below / total, lower))
    return Activity(upper, lower, others)
