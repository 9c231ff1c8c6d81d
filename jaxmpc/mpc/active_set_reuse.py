"""Reuse of active sets: affine laws of multipliers of some states, tried on their neighbours.

In ADMM's coordinates (H = I; `qp/admm.py`) a solution with active rows W has multipliers
S_WW y_W = v_W − b_W, where v = −A q are the rows of the unconstrained minimiser and b the active
bounds. Both are affine in the parameter θ of the problem, and so is y_W = L (θ, 1): the law of the
critical region (Bemporad et al. 2002, Automatica 38). States that lie in the same region as a
solved one get their exact solution from its law; near it the law is a start from which few steps on
the dual are left. Nothing is assumed: every plan is accepted by its own residuals
(`qp/solve.py`, `solve_from`), and what is not solved so goes to the solver.

The nearest solved state is found by cells: quantiles of the states divide each coordinate, one
state of each cell is solved, and each state follows the nearest of its own cell and of those beside
it. That needs few coordinates.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.batches import padded
from jaxmpc.mpc.aim import Aim
from jaxmpc.mpc.controller import Controller, planned
from jaxmpc.mpc.plan import Multipliers, Plan, flat_multipliers
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import scaled_multipliers
from jaxmpc.qp.dual import RIDGE, has_dual_steps, most_rows
from jaxmpc.qp.linalg import matmul, solve
from jaxmpc.qp.solve import solve_from
from jaxmpc.qp.status import Status
from jaxmpc.qp.transformations import true_places

# Coordinates of a state up to which its neighbours are near enough.
MOST_COORDINATES = 4
# One state in so many is solved first.
STATES_A_CELL = 128
# States among which those are chosen, for each of them, and states that the quantiles are of.
CHOICE, SAMPLE = 4, 4096
# Multipliers relative to the largest that count as zero.
INACTIVE = 1e-9


@pytree
class Laws:
    """The laws of S solved states: y[rows] = slope (θ, 1), rows (S, K), filled up with the number
    of rows, slope (S, K, p + 1); NaN where a state has none. sign (S, K): of these multipliers."""

    rows: Array
    sign: Array
    slope: Array

    def evaluate(self, i: Array, theta: Array, count: int) -> Array:
        """Return the multipliers (count,) that law i gives θ (p,), those of the wrong sign as 0."""
        y = jnp.sum(self.slope[i] * jnp.append(theta, 1.0), axis=1)
        y = jnp.where(self.sign[i] * y < 0, 0.0, y)
        return jnp.zeros(count, y.dtype).at[self.rows[i]].add(y, mode="drop")


@pytree
class Cells:
    """Cells of R^p: edges (g − 1, p) divide each coordinate in g. lower, width (g, p): of the
    intervals, in which distances are measured. law (g^p,): index of the state of each cell that is
    solved, −1 for none; states (S, p): all of these."""

    edges: Array
    lower: Array
    width: Array
    law: Array
    states: Array

    def nearest(self, x: Array) -> Array:
        """Return the index of the solved state nearest to x (p,), of those in its cell and the
        cells beside it; −1 where there is none."""
        g, p = self.lower.shape
        axis = np.arange(p)
        k = jnp.sum(x > self.edges, axis=0)
        lower, width = self.lower[k, axis], self.width[k, axis]
        side = jnp.where(x > lower + 0.5 * width, 1, -1)
        steps = np.concatenate([np.zeros((1, p), int), np.eye(p, dtype=int), np.ones((1, p), int)])
        beside = jnp.clip(k + steps * side, 0, g - 1)
        law = self.law[jnp.sum(beside * g ** axis[::-1], axis=1)]
        distance = jnp.sum(((self.states[law] - x) / width) ** 2, axis=1)
        return law[jnp.argmin(jnp.where(law < 0, jnp.inf, distance))]


def transferable(controller: Controller) -> bool:
    """Return whether states may follow solved ones: the problem has hard rows alone, curvature in
    all directions, and few coordinates."""
    c, f = controller.condensed, controller.factor
    assert c is not None and f is not None
    if not has_dual_steps(c.balls, c.C) or c.soft_linear is not None:
        return False
    return controller.mpc.dimension <= MOST_COORDINATES and not bool(f.flat)


def choose(x: Any) -> tuple[np.ndarray, Cells]:
    """Return the indices of some of the states x (B, p), one a cell, and the cells.

    The number of cells follows from a power of two, so that few programs are compiled.
    """
    B, p = x.shape
    count = 2 ** int(np.log2(max(B // STATES_A_CELL, 1)))
    g = int(count ** (1 / p) + 1e-9)
    # At random: equal distances would be in step with the lines of a grid.
    index = np.sort(np.random.default_rng(0).integers(0, B, CHOICE * count))
    some = np.asarray(x[index])
    finite = np.all(np.isfinite(some), axis=1)
    index, some = index[finite], some[finite]
    if not len(some):
        index, some = np.zeros(1, int), np.zeros((1, p))
    few = np.random.default_rng(1).integers(0, len(some), SAMPLE)
    ordered = np.sort(some[few], axis=0)
    ends = ordered[np.linspace(0, len(ordered) - 1, g + 1).astype(int)]
    edges, width = ends[1:-1], np.diff(ends, axis=0)
    k = [np.searchsorted(edges[:, j], some[:, j]) for j in range(p)]
    cell = np.ravel_multi_index(k, (g,) * p)
    first = np.full(g**p, -1)
    first[cell[::-1]] = np.arange(len(some))[::-1]
    chosen = np.flatnonzero(first >= 0)
    law = np.full(g**p, -1, np.int32)
    law[chosen] = np.arange(len(chosen))
    states = padded(some[first[chosen]], g**p)
    width = np.where(width > 0, width, 1.0)
    cells = Cells(*map(jnp.asarray, (edges, ends[:-1], width, law, states)))
    return index[first[chosen]], cells


def laws_of(controller: Controller, multipliers: Multipliers, status: Array) -> Laws:
    """Return the laws of plans with these multipliers and this status, S in front."""
    c, f = controller.condensed, controller.factor
    assert c is not None and f is not None
    m, most = len(f.E), most_rows(c.C)
    finite = lambda bound: jnp.where(jnp.isfinite(bound), bound, 0.0)
    # v − b of the upper and of the lower bound, in (θ, 1).
    linear = f.E[:, None] * c.D - matmul(f.A, matmul(f.T.T, c.F))
    shift = f.E * c.d - matmul(matmul(c.f, f.T), f.A.T)
    beyond = lambda bound: jnp.column_stack([linear, shift - f.E * finite(bound)])
    upper, lower = beyond(c.upper), beyond(c.lower)

    def law(multipliers: Array, solved: Array) -> Laws:
        y = scaled_multipliers(f.E, multipliers)
        active = jnp.abs(y) > INACTIVE * jnp.max(jnp.abs(y), initial=0.0)
        rows = true_places(active, most)
        take = lambda v: v.at[rows].get(mode="fill", fill_value=0.0)
        sign = jnp.sign(take(y))
        right = jnp.where(sign[:, None] > 0, take(upper), take(lower))
        S = f.S.at[rows[:, None], rows[None, :]].get(mode="fill", fill_value=0.0)
        S = S + jnp.diag(jnp.where(rows < m, RIDGE, 1.0))
        slope = jax.vmap(lambda column: solve(S, column), in_axes=1, out_axes=1)(right)
        known = solved & (jnp.sum(active) <= most)
        return Laws(rows, sign, jnp.where(known, slope, jnp.nan))

    flat = jax.vmap(lambda m: flat_multipliers(c.layout, m))(multipliers)
    return jax.vmap(law)(flat, status == Status.SOLVED)


def follow(controller: Controller, laws: Laws, cells: Cells, steps: int, theta: Array) -> Plan:
    """Return the plan from θ (p,) by the law of a solved state nearby and so many steps on the
    dual: SOLVED, or ITERATION_LIMIT where that leads to none."""
    c, f = controller.condensed, controller.factor
    assert c is not None and f is not None
    i = cells.nearest(theta)
    y = jnp.where(i < 0, jnp.nan, laws.evaluate(i, theta, len(f.E)))
    found, fault = solve_from(c.qp(theta), f, controller.solver, y, steps)
    x0, previous = jnp.split(theta, [controller.mpc.system.n])
    aim = Aim(x0, previous_input=previous if controller.mpc.input_in_state else None)
    return planned(controller, theta, aim, found, fault)
