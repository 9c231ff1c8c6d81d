"""Newton steps on the active rows stage by stage, the search that they are part of, and the
derivative of what it finds.

In scaled rows v, multipliers y/E and with the residual e(v) = v − prox(v) of `qp/problem.py` the
optimality conditions are gradient = 0 and e(v + y/ρ) = y/ρ. With the derivative D of e a semismooth
Newton step from inputs u (N, m) and multipliers y (rows,) asks

    gradient + P du + rows'dy = 0,        dy (1 − D)/ρ = D dv + c,    c = e − y/ρ.

Where D = 1 (a row held at its bound) 0·dy becomes dy/κ with a large κ, a proximal step on y:
dy = ω dv + ω_c c, with ω = ρ D/(1 − D + D ρ/κ) and ω_c = ρ/(1 − D + D ρ/κ). What is left is an LQR
problem with penalties ω, one Riccati recursion. Rows are held by v + y/ρ of ADMM's own ρ, so that κ
does not disturb the guess; it costs accuracy only within a step, since each starts from residuals
of the data.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.mpc.stagewise.interior_point import InteriorState, interior_step
from jaxmpc.mpc.stagewise.stages import Stages, conditions, measured_pair, minimise, riccati
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import scaled_multipliers
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.residuals import Pair
from jaxmpc.qp.transformations import Undo


class Errors(NamedTuple):
    """How far the optimality conditions are from holding: v + y/ρ and c (rows,), the gradient
    (N, m); see top of this file."""

    v: Array
    c: Array
    gradient: Array

    @classmethod
    def of(cls, s: Stages, E: Array, rho: Array, u: Array, y: Array) -> "Errors":
        """Return those of inputs u (N, m) and multipliers y (rows,)."""
        found, push = conditions(s, u, y), scaled_multipliers(E, y) / rho
        v = E * found.rows + push
        return cls(v, s.bounds.scaled(E).prox_residual(v, rho) - push, found.gradient)


def distance(s: Stages, E: Array, rho: Array, u: Array, y: Array) -> Array:
    """Return how far the conditions are from holding as a number in units of the cost: Σ ρ c², c in
    rows of variance 1 under exp(−J), and Σ gradient²/R over the inputs.

    Beside a hundred times that of zero it tells a warm start from numbers that are none, such as
    the plan of a state far off.
    """
    _, c, gradient = Errors.of(s, E, rho, u, y)
    weight = jnp.diagonal(s.R, axis1=-2, axis2=-1) * s.stage[:, None]
    return jnp.sum(rho * c**2) + jnp.sum(gradient**2 / jnp.where(weight > 0, weight, 1.0))


def newton_direction(
    s: Stages, E: Array, rho: Array, v: Array
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Return the linear map (c, gradient) → (du, dy) of a Newton step at v + y/ρ (rows,)."""
    D = s.bounds.scaled(E).curvature(v, rho)[0]
    loose = 1 - D + D * rho / Constants.of(E.dtype).linear
    omega = rho * D / loose
    gains = riccati(s, omega * E**2)

    def step(c: Array, gradient: Array) -> tuple[Array, Array]:
        push = rho * c / loose
        gx, gu = s.pull(E * push)
        dx, du = minimise(s, gains, -gx, -gu - gradient)
        return du, E * (omega * E * s.rows(dx, du) + push)

    return step


def stage_newton_step(s: Stages, E: Array, rho: Array, u: Array, y: Array) -> tuple[Array, Array]:
    """Return inputs u (N, m) and multipliers y (rows,) after a Newton step."""
    v, c, gradient = Errors.of(s, E, rho, u, y)
    du, dy = newton_direction(s, E, rho, v)(c, gradient)
    return u + du, y + dy


@pytree
class NewtonState:
    """Loop state of one instance: inputs u (N, m) and multipliers y (rows,) of the last Newton
    step, the best pair of all so far, the steps taken, and whether to go on."""

    u: Array
    y: Array
    best: Pair
    steps: Array
    open: Array

    @classmethod
    def begin(cls, best: Pair) -> "NewtonState":
        """Return the state before the first step."""
        return cls(best.z, best.y, best, jnp.int32(0), ~(best.near | best.finished))


def newton_search_step(most: int, constants: tuple, state: NewtonState) -> NewtonState:
    """One Newton step; the search ends after `most`, or below a thousandth of eps."""
    s, E, rho, eps = constants
    u, y = stage_newton_step(s, E, rho, state.u, state.y)
    best, steps = state.best.or_better(measured_pair(eps, s, u, y)), state.steps + 1
    return NewtonState(u, y, best, steps, ~(best.near | best.finished) & (steps < most))


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
        best = self.loop(step, self.newton, (s, E, rho, eps), NewtonState.begin(best)).best
        if not self.interior:
            return best
        begun = InteriorState.begin(best)
        begun = replace(begun, open=begun.open & wanted)
        step = partial(interior_step, self.interior)
        return self.loop(step, self.interior, (s, E, fixed, eps), begun).best


def stage_conditions(
    s: Stages, constants: tuple[Array, Array], u: Array, y: Array
) -> tuple[Callable[[Any], Any], Undo]:
    """The `conditions_of` that `qp.derivative.implicit` takes for the stages and (E, ρ).

    The conditions F(s, u, y) = 0 hold at a solution, hence J d(u, y) = −dF with the matrix J of a
    Newton step: one Riccati recursion, whatever the number of iterations. Rows that touch with a
    zero multiplier count as inactive, as in `qp/derivative.py`.
    """
    E, rho = constants
    v, *at_solution = Errors.of(s, E, rho, u, y)
    step = newton_direction(s, E, rho, v)

    def conditions_at(s: Stages, u: Array, y: Array) -> tuple[Array, Array]:
        _, c, gradient = Errors.of(s, E, rho, u, y)
        return c, gradient

    def follow(moved: Any) -> Any:
        # The step is linear; as a derivative of itself it can be transposed, kernels or not.
        return jax.jvp(step, tuple(at_solution), tuple(moved))[1]

    def undo(moved: Any) -> tuple[Array, Array]:
        # What the proximal step on y leaves, of relative size ρ/κ, is taken up by a second step.
        first = follow(moved)
        left = jax.jvp(partial(conditions_at, s), (u, y), first)[1]
        return jax.tree.map(jnp.add, first, follow(jax.tree.map(jnp.add, moved, left)))

    return lambda s: conditions_at(s, u, y), undo
