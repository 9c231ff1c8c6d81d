"""Affine policies stage by stage: an interior point method whose steps are Riccati recursions.

The plan and the policy are those of `policy_rows.py`: u_k = v_k + Σ_{j<k} M_kj w_j, the cost that
of the undisturbed plan. With w_j = Γ (ω_j + o), |ω_j| ≤ 1, and U_kj = M_kj Γ, what generator g of
w_j does to the states is a trajectory of its own, a column, whose inputs are free:

    X_{j+1,j} = E Γ_g,    X_{k+1,j} = A X_kj + B U_kj  for k > j.

A row of value r along the plan has the value s_j = H X_kj + D U_kj along column j, and keeps its
limits for all disturbances if and only if r + Σ o s_j + Σ |s_j| ≤ upper and
r + Σ o s_j − Σ |s_j| ≥ lower. The dense QP has N² variables M, and as many T ≥ |s_j| for each
row. Here no matrix is larger than (rows)².

**A step.** Slacks t_i = T − σ_i s (σ = 1, −1) of an entry s of a column have multipliers a_i, and
the two sides of a row z_i. With p = Σ z_i and y = Σ σ_i z_i stationarity in T is Σ a_i = p, and the
force on the entry is Σ σ_i a_i + o y. Eliminated from the Newton system, with w_i = a_i / t_i, an
entry leaves

    change of the force = ω ds + ρ dp + o dy + f,    ω = 4 w_1 w_2 / (w_1 + w_2),
    dT = (R − dp) / (w_1 + w_2) + ρ ds,              ρ = (w_1 − w_2) / (w_1 + w_2),

with R = Σ (μ/t_i − a_i) − (p − Σ a_i) and f = Σ σ_i (μ/t_i − a_i) − ρ R. So for given dz each
column is an LQR problem of its own with the weights ω on its rows: one Riccati recursion each, side
by side. What couples them are the rows: dz solves a system with the matrix

    Σ over the plan and all columns of  D F P⁻¹ F' D  + what slacks add to the diagonal,

F the rows as functions of the inputs, P the Hessian of the LQR problem and D = diag(1, or o and ρ).
F P⁻¹ F' is the covariance of the rows where inputs are drawn with density exp(−½ u'P u), that is
u = K x + e with e_k of covariance G⁻¹ (`solve.py`): forward recursions again. (Leeman, Köhler,
Messerer, Lahr, Diehl & Zeilinger 2024, arXiv:2401.13762, whose norms are Euclidean, alternate
between plan and columns: for given multipliers of the rows and norms of the entries each column is
an LQR problem too. Of a 1-norm most entries of a solution are zero, where such weights have no
limit; here the weights belong to the central path, and Newton's method converges.)

Columns cost nothing. Where ω leaves one without curvature, a small proximal term on its step, in
the metric of the plan's inputs, does not change what the steps converge to.

What is said of a policy is measured of M, from the data: rows with |s_j| in place of T, gradients
with respect to v and U, and the gap with multipliers a clipped to |Σ σ_i a_i| ≤ p.
"""

from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import all_finite, host_array
from jaxmpc.checks import concrete, fail
from jaxmpc.mpc.plan import Aim, Plan, answer
from jaxmpc.mpc.policy_rows import generator_form, require_generators
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Layout, layout, row_count
from jaxmpc.mpc.stagewise.newton_steps import (
    BEGUN,
    FRACTION,
    INTERIOR_STEPS,
    LOST,
    MOST_CURVED,
    REST,
    Limits,
    Sides,
    advanced,
)
from jaxmpc.mpc.stagewise.recursion_kernels import Gains, covariances, recurrence
from jaxmpc.mpc.stagewise.stages import (
    Stages,
    conditions,
    minimise,
    predict,
    residuals_of,
    riccati,
    unconstrained,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.jax_transformations import repeat_while
from jaxmpc.qp.linalg import (
    apply,
    apply_transposed,
    definite_solver,
    matmul,
    precisely,
    rounding,
)
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import SHARE, Pair, Proof, Terms, with_status, worst
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box, Zonotope
from jaxmpc.sets.generators import span

# Of the proximal term on the steps of columns, beside the largest weight of their rows.
PROXIMAL = 1e-14
# Added to the diagonal of the rows' system, of which it is 1.
RIDGE = 1e-14


def answers_disturbances(mpc: MPC) -> bool:
    """Return whether later inputs are free functions of disturbances."""
    return mpc.disturbance is not None and mpc.policy == "affine"


def require_independent_generators(W: Any) -> None:
    """Raise ValueError unless a policy can answer to each generator by itself."""
    require_generators(W)
    if isinstance(W, Zonotope):
        cure = "Give a Box or independent generators, or use jm.solve"
        if not concrete(W.generators):
            fail("disturbance", "is a Zonotope inside a trace", cure)
        Gamma = host_array("disturbance", W.generators)
        rank = span(Gamma)[1].shape[1]
        if rank < Gamma.shape[1]:
            what = (
                f"has {Gamma.shape[1]} generators of rank {rank}: stage by stage each is answered"
            )
            fail("disturbance", what, cure)


def bytes_needed(mpc: MPC) -> float:
    """Return about how many bytes a step holds in float64."""
    rows = row_count(layout(mpc))
    n = mpc.system.n + (mpc.system.m if mpc.input_in_state else 0)
    W: Any = mpc.disturbance
    columns = mpc.horizon * (mpc.disturbances if isinstance(W, Box) else W.generators.shape[1])
    return 8.0 * (4 * (2 * rows) ** 2 + columns * (rows * (4 * n + 20) + 6 * mpc.horizon * n * n))


@pytree
class Columns:
    """The problem of plan and columns in float64; J columns (j, g), those of a step together.

    stages: of the plan, rows with their bounds as given. E (rows,): row scale, 0 for a row that no
    input moves. gains and least (N, m): of the plan of least cost without rows. pushes (J, N, n):
    what enters each column's state. offset: o of each column (J, 1), None where it is zero.
    Gamma (p, g) and its left inverse back (g, p). answers (J, N): 1 where the column's input is
    free. of_plan (rows, rows): F P⁻¹ F' of the plan.
    """

    stages: Stages
    E: Array
    gains: Gains
    least: Array
    pushes: Array
    offset: Array | None
    Gamma: Array
    back: Array
    answers: Array
    of_plan: Array

    @property
    def reached(self) -> Array:
        """Which rows a column moves at all (J, rows)."""
        step = row_steps(self.stages.layout)
        N = self.stages.horizon
        return jnp.asarray(np.repeat(step > np.arange(N)[:, None], len(self.pushes) // N, axis=0))

    def rows(self, U: Array, pushes: Array | None = None) -> Array:
        """Return the scaled rows (J, rows) of columns with inputs U (J, N, m)."""
        s = self.stages

        def of(U: Array, push: Array) -> Array:
            return self.E * s.rows(_from_rest(s.A, apply(s.B, U) + push), U)

        return jax.vmap(of)(U, self.pushes if pushes is None else pushes)

    def riccati(self, omega: Array) -> Gains:
        """Return the gains (J, …) of columns with the weights omega (J, rows) on scaled rows."""
        s = self.stages
        none = jnp.zeros_like
        free = replace(s, Q=none(s.Q), P=none(s.P), cross=None)
        size = 1 / jnp.diagonal(self.gains.inverse, axis1=-2, axis2=-1)
        size = size[..., None] * jnp.eye(size.shape[-1], dtype=size.dtype)
        most = jnp.max(omega, axis=1, initial=0.0)
        most = jnp.maximum(most, jnp.finfo(most.dtype).eps * jnp.max(most))
        most = jnp.where(most > 0, most, 1.0)

        def one(omega: Array, most: Array) -> Gains:
            return riccati(replace(free, R=PROXIMAL * most * size), omega * self.E**2)

        found = jax.vmap(one)(omega, most)
        mask = self.answers[..., None, None]
        return found._replace(K=found.K * mask, inverse=found.inverse * mask)

    def minimise(self, gains: Gains, force: Array) -> Array:
        """Return the inputs (J, N, m) of columns that a force (J, rows) on scaled rows leads to."""
        s = self.stages

        def one(gains: Gains, force: Array) -> Array:
            gx, gu = s.pull(self.E * force)
            return minimise(s, gains, -gx, -gu)[1]

        return jax.vmap(one)(gains, force)

    def policy(self, U: Array) -> Array:
        """Return M (N, m, N, p) of inputs U (J, N, m)."""
        N, m = U.shape[1:]
        each = U.reshape(N, -1, N, m)
        return jnp.einsum("jgkm,gp->kmjp", each, self.back, precision="highest")

    def inputs(self, M: Array) -> Array:
        """Return the inputs (J, N, m) of the policy M."""
        N, m = M.shape[:2]
        each = jnp.einsum("kmjp,pg->jgkm", M, self.Gamma, precision="highest")
        return each.reshape(-1, N, m)


def _from_rest(A: Array, w: Array) -> Array:
    """Return x (N+1, n) from x_0 = 0 with x⁺ = A x + w."""
    start = jnp.zeros_like(w[0])
    return jnp.concatenate([start[None], recurrence(A, w, start)])


def row_steps(layout: Layout) -> np.ndarray:
    """Return the step k of each row (rows,)."""
    return np.array([k for _, steps, size in layout for k in steps for _ in range(size)], int)


def _by_row(s: Stages) -> tuple[Array, Array]:
    """Return H (rows, n) and D (rows, m) of all rows."""
    n, m = s.B.shape[-2:]
    H, D = [jnp.zeros((0, n), s.A.dtype)], [jnp.zeros((0, m), s.A.dtype)]
    for block in s.blocks:
        for M, into, width in ((block.H, H, n), (block.D, D, m)):
            shape = len(block.steps), block.size, width
            full = jnp.zeros(shape, s.A.dtype) if M is None else jnp.broadcast_to(M, shape)
            if into is D and max(block.steps) == s.horizon:
                full = full.at[-1].set(0.0)  # the last step has no input
            into.append(full.reshape(-1, width))
    return jnp.concatenate(H), jnp.concatenate(D)


def covariance(s: Stages, E: Array, gains: Gains, weights: Array) -> Array:
    """Return Σ over columns of D_a F P⁻¹ F' D_b (a, b, rows, rows), D_a = diag(weights[a]), F the
    scaled rows as functions of the inputs.

    gains (J, …), weights (a, J, rows). With C = A + BK and e_k of covariance G⁻¹ the covariance of
    x_k and row l, at step i, is C_{k−1} … C_{i+1} (C_i Σ_i F_l' + B G⁻¹ D_l') for k > i, and
    Σ_i F_l' for k = i: all rows l are carried forward at once, and read at the rows of each step.
    """
    N, (n, m) = s.horizon, s.B.shape[-2:]
    count, step = len(E), row_steps(s.layout)
    # One more row, of zeros, stands for none where a step has fewer rows than others.
    padded = lambda v: jnp.pad(v, [*[(0, 0)] * (v.ndim - 2), (0, 1), (0, 0)])
    H, D = (padded(E[:, None] * v) for v in _by_row(s))
    weights = jnp.pad(weights, ((0, 0), (0, 0), (0, 1)))
    places = [np.flatnonzero(step == k) for k in range(N + 1)]
    most = max(len(p) for p in places[:-1])
    table = np.array([np.pad(p, (0, most - len(p)), constant_values=count) for p in places[:-1]])
    here = np.append(step, N)
    B = jnp.broadcast_to(s.B, (N, n, m))
    shared = matmul(B, gains.inverse)  # covariance of x_{k+1} and e_k
    Sigma = jax.vmap(covariances)(gains.closed, matmul(shared, jnp.swapaxes(B, -1, -2)))
    Sigma = jnp.pad(Sigma, ((0, 0), (1, 0), (0, 0), (0, 0)))
    before = np.minimum(here, N - 1)
    F = H + matmul(D[:, None], gains.K[:, before])[:, :, 0]
    columns = lambda v: jnp.swapaxes(v, -1, -2)
    own = columns(matmul(F[:, :, None], Sigma[:, here])[:, :, 0]) * weights[:, :, None]
    pushed = columns(apply(shared[:, before], D)) * weights[:, :, None]

    def read(X: Array, rows: Any) -> Array:
        """Return the covariances of these rows with all others, from those of x_k."""
        left = weights[:, :, rows, None] * F[:, rows]
        return jnp.einsum("ajrn,bjnl->abrl", left, X, precision="highest")

    def stage(X: Array, given: tuple) -> tuple[Array, tuple[Array, Array]]:
        rows, closed, inverse = given
        X = X.at[..., rows].set(own[..., rows])
        noise = matmul(matmul(D[rows], inverse), D[rows].T)
        w = weights[:, :, rows]
        same = jnp.einsum("ajr,jrl,bjl->abrl", w, noise, w, precision="highest")
        found = read(X, rows)
        X = matmul(closed, X).at[..., rows].add(pushed[..., rows])
        return X, (found, same)

    each = jnp.asarray(table), *(jnp.moveaxis(v, 1, 0) for v in (gains.closed, gains.inverse))
    X, (found, same) = jax.lax.scan(stage, jnp.zeros_like(own), each)
    size = weights.shape[0]
    whole = jnp.zeros((size, size, count + 1, count + 1), E.dtype)
    whole = whole.at[:, :, table.ravel()].set(
        jnp.moveaxis(found, 0, 2).reshape(size, size, -1, count + 1)
    )
    whole = whole.at[:, :, table[:, :, None], table[:, None]].add(jnp.moveaxis(same, 0, 2))
    last = places[-1]
    if len(last):
        whole = whole.at[:, :, last].set(read(X.at[..., last].set(own[..., last]), last))
    whole = whole[:, :, :count, :count]
    later = jnp.where(step[:, None] > step, whole, 0.0)
    whole = jnp.where(step[:, None] == step, whole, later)
    return whole + jnp.transpose(later, (1, 0, 3, 2))


class Point(NamedTuple):
    """Inputs v (N, m) of the plan and U (J, N, m) of the columns; the sides of the rows; and of the
    entries the slacks t and multipliers a (2, J, rows), upper first."""

    v: Array
    U: Array
    sides: Sides
    t: Array
    a: Array


SIGNS = np.array([1.0, -1.0])[:, None, None]


def _begin(c: Columns) -> Point:
    """Return the point of the first step: the plan of least cost without rows, columns under its
    gains, and room that is some of each row's."""
    s, E, v = c.stages, c.E, c.least
    K = c.gains.K * c.answers[..., None, None]
    X = jax.vmap(lambda push: _from_rest(c.gains.closed, push))(c.pushes)
    U = apply(K, X[:, :-1])
    entries, limits = c.rows(U), Limits.of(s.bounds.scaled(E))
    inside = c.reached & jnp.any(limits.present, axis=0)
    reach = jnp.sum(jnp.where(inside, jnp.abs(entries), 0.0), axis=0)
    r = E * s.rows(predict(s, v), v)
    if c.offset is not None:
        r = r + jnp.sum(c.offset * entries, axis=0)
    sides = limits._replace(b=limits.b - limits.sign * reach).start(r)
    room = jnp.min(jnp.where(limits.present, sides.t, jnp.inf), axis=0)
    room = jnp.where(jnp.isfinite(room), room, 1.0) / jnp.maximum(jnp.sum(inside, axis=0), 1)
    t = jnp.where(inside, jnp.abs(entries) - SIGNS * entries + room, 1.0)
    z = jnp.where(limits.present, sides.z, 0.0)
    a = jnp.where(inside, jnp.sum(z, axis=0) * t[::-1] / jnp.sum(t, axis=0), 0.0)
    return Point(v, U, sides._replace(z=z), t, a)


class Solver(NamedTuple):
    """What the steps of one problem share: the limits of scaled rows, which entries count, and the
    number of pairs of a slack and a multiplier."""

    limits: Limits
    inside: Array
    pairs: Array

    @classmethod
    def of(cls, c: Columns) -> "Solver":
        """Return that of a problem."""
        limits = Limits.of(c.stages.bounds.scaled(c.E))
        inside = c.reached & jnp.any(limits.present, axis=0)
        count = jnp.sum(limits.present) + jnp.sum(limits.soft) + 2 * jnp.sum(inside)
        return cls(limits, inside, jnp.maximum(count, 1))

    def mean(self, at: Point) -> Array:
        """Return the mean of all products of slacks and multipliers."""
        products = jnp.sum(self.limits.products(at.sides))
        return (products + jnp.sum(jnp.where(self.inside, at.t * at.a, 0.0))) / self.pairs

    def length(self, at: Point, step: Point) -> Array:
        """Return how far a step leaves all slacks and multipliers positive, 1e30 at most."""
        pairs = (at.t, step.t), (at.a, step.a)
        shrink = [
            jnp.max(jnp.where(self.inside & (v > 0), -d / jnp.where(v > 0, v, 1.0), 0.0), initial=0)
            for v, d in pairs
        ]
        of_entries = 1 / jnp.maximum(jnp.maximum(*shrink), 1e-30)
        return jnp.minimum(of_entries, self.limits.length(at.sides, step.sides))


def direction(c: Columns, at: Point) -> Point:
    """Return the step of Mehrotra's predictor and corrector, with his centring; see top of
    `newton_steps.py`."""
    s, E, solver = c.stages, c.E, Solver.of(c)
    limits, inside, _ = solver
    sign, has, soft = limits.sign, limits.present, limits.soft
    t, z, e = at.sides
    y, p = limits.multipliers(at.sides), jnp.sum(z, axis=0)
    found = conditions(s, at.v, E * y)
    T = jnp.sum(jnp.where(inside, jnp.mean(at.t, axis=0), 0.0), axis=0)
    along = c.offset
    r = E * found.rows
    if along is not None:
        r = r + jnp.sum(along * c.rows(at.U), axis=0)
    left = jnp.where(has, sign * (r - limits.b) + T - e + t, 0.0)
    missing = jnp.where(inside, p - jnp.sum(at.a, axis=0), 0.0)
    w = jnp.where(inside, at.a / at.t, 0.5)
    both = jnp.sum(w, axis=0)
    rho = jnp.where(inside, (w[0] - w[1]) / both, 0.0)
    gains = c.riccati(jnp.where(inside, 4 * w[0] * w[1] / both, 0.0))
    force = jnp.sum(SIGNS * at.a, axis=0)
    force = force if along is None else force + along * y

    # The system of the rows, of the two sides dz: dy = Σ sign dz pulls as r does, dp = Σ dz as T.
    shares = rho[None] if along is None else jnp.stack([rho, jnp.where(inside, along, 0.0)])
    of_columns = covariance(s, E, gains, shares)
    pp = of_columns[0, 0] + jnp.diag(jnp.sum(jnp.where(inside, 1 / both, 0.0), axis=0))
    yy, yp = c.of_plan, jnp.zeros_like(pp)
    if along is not None:
        yy, yp = yy + of_columns[1, 1], of_columns[1, 0]
    K = jnp.block([[(a * b * yy + a * yp + b * yp.T + pp) for b in (1, -1)] for a in (1, -1)])
    nu = limits.nu(at.sides)
    bend = jnp.where(soft, nu + limits.k * e, 1.0)
    safe = jnp.where(has, z, 1.0)
    K = jnp.where(has.ravel()[:, None] & has.ravel(), K, 0.0)
    K = K + jnp.diag(jnp.where(has, t / safe + jnp.where(soft, e / bend, 0.0), 1.0).ravel())
    unit = 1 / jnp.sqrt(jnp.diag(K))
    solve = definite_solver(unit[:, None] * K * unit + RIDGE * jnp.eye(len(K), dtype=K.dtype))
    still = jnp.zeros_like(c.pushes)
    at_rest = jnp.zeros_like(predict(s, at.v))
    free = minimise(s, c.gains, at_rest, -found.gradient)

    def step(targets: tuple[Array, Array]) -> Point:
        """Return the Newton step towards t z, e ν (2, 2, rows) and t a (2, J, rows) = targets."""
        of_rows, of_entries = targets
        more = jnp.where(inside, of_entries / at.t - at.a, 0.0)
        total = jnp.sum(more, axis=0) - missing
        known = force + jnp.sum(SIGNS * more, axis=0) - rho * total
        known = jnp.where(inside, known, 0.0)
        far = jnp.where(has, (of_rows[0] - t * z) / safe, 0.0)
        give = jnp.where(soft, (of_rows[1] - e * nu) / bend, 0.0)
        ds = c.rows(c.minimise(gains, known), still)
        dr = E * s.rows(*free)
        dr = dr if along is None else dr + jnp.sum(along * ds, axis=0)
        dT = jnp.sum(jnp.where(inside, total / both + rho * ds, 0.0), axis=0)
        b = jnp.where(has, sign * dr + dT + left + far - give, 0.0).ravel()
        dz = jnp.where(has, (unit * solve(unit * b)).reshape(2, -1), 0.0)
        dy, dp = jnp.sum(sign * dz, axis=0), jnp.sum(dz, axis=0)
        gx, gu = s.pull(E * dy)
        dx, dv = jax.tree.map(jnp.add, free, minimise(s, c.gains, -gx, -gu))
        dr = E * s.rows(dx, dv)
        known = known + rho * dp if along is None else known + rho * dp + along * dy
        dU = c.minimise(gains, jnp.where(inside, known, 0.0))
        ds = c.rows(dU, still)
        dr = dr if along is None else dr + jnp.sum(along * ds, axis=0)
        dt = jnp.where(inside, (total - dp - 2 * SIGNS * w[::-1] * ds) / both, 0.0)
        da = more - w * dt * inside
        de = jnp.where(soft, give + e * dz / bend, 0.0)
        dT = jnp.sum(jnp.mean(dt, axis=0), axis=0)
        dt_rows = jnp.where(has, de - left - sign * dr - dT, 0.0)
        return Point(dv, dU, Sides(dt_rows, dz, de), dt, da)

    mean = solver.mean(at)
    most = MOST_CURVED * mean

    def corrected(guess: Point, first: Array) -> tuple[Point, None]:
        reach = jnp.minimum(solver.length(at, guess), 1.0)
        ratio = solver.mean(advanced(at, guess, reach)) / jnp.where(mean > 0, mean, 1.0)
        centre = mean * jnp.maximum(ratio**3, 1 - reach)
        g = guess.sides
        curved = jnp.stack([g.t * g.z, g.e * (limits.k * g.e - g.z)]), guess.t * guess.a
        targets = [jnp.where(first, 0.0, centre - jnp.clip(v, -most, most)) for v in curved]
        return step((targets[0], targets[1])), None

    none = jax.tree.map(jnp.zeros_like, at)
    return jax.lax.scan(corrected, none, jnp.array([True, False]))[0]


class Policy(NamedTuple):
    """Inputs v (N, m) of the plan, the feedback M (N, m, N, p), by how much each side of each row
    is violated at worst (2, rows), upper first, and whether all hold to the tolerance."""

    v: Array
    feedback: Array
    beyond: Array
    kept: Array


def measured_policy(eps: Array, c: Columns, at: Point) -> Pair:
    """Return the `Policy` of a point with multipliers y (2, rows) of the two sides of the rows,
    measured: robust rows, gradients and gap (top of this file)."""
    s, E, M = c.stages, c.E, c.policy(at.U)
    U, count = c.inputs(M), len(c.E)
    X = jax.vmap(lambda U, push: _from_rest(s.A, apply(s.B, U) + push))(U, c.pushes)
    entries = jax.vmap(s.rows)(X, U)
    reach, middle = jnp.sum(jnp.abs(entries), axis=0), jnp.zeros_like(E)
    if c.offset is not None:
        middle = jnp.sum(c.offset * entries, axis=0)
    # For this M the plan is that of a nominal problem: a copy of the rows for each side.
    free = jnp.full_like(reach, jnp.inf)
    upper, lower = s.bounds.u - middle - reach, s.bounds.l - middle + reach
    soft = [None if v is None else jnp.tile(v, 2) for v in (s.bounds.linear, s.bounds.quadratic)]
    bounds = Bounds(jnp.append(-free, lower), jnp.append(upper, free), soft[0], soft[1])
    tight = replace(s, blocks=s.blocks * 2, bounds=bounds)
    # Where the policy keeps all rows about the plan of least cost, that is the solution.
    idle = jnp.all(bounds.outside(tight.rows(predict(s, c.least), c.least)) == 0)
    v = jnp.where(idle, c.least, at.v)
    z = E * jnp.where(Limits.of(s.bounds.scaled(E)).present & ~idle, at.sides.z, 0.0)
    y = bounds.admissible(jnp.append(z[0], -z[1]))
    rows = tight.rows(predict(s, v), v)
    y = jnp.where(jnp.tile(E == 0, 2), bounds.penalty_gradient(rows), y)
    found = conditions(tight, v, y)
    of_rows, of_plan, (gap, size, terms) = residuals_of(tight, jnp.tile(E, 2), v, y, found)

    p, y_plan = y[:count] - y[count:], y[:count] + y[count:]
    q = jnp.clip(E * jnp.sum(SIGNS * at.a, axis=0), -p, p)
    q = jnp.where(E == 0, p * jnp.sign(entries), q)
    force = q if c.offset is None else q + c.offset * y_plan
    gx, gu = jax.vmap(s.pull)(force)
    back = jax.vmap(lambda g: recurrence(s.A, g[:-1], g[-1], adjoint=True))(gx)
    back = jnp.concatenate([back[:, 1:], gx[:, -1:]], axis=1)
    later = jax.vmap(partial(apply_transposed, s.B))(back)
    free_inputs = c.answers[..., None]
    gradient, own = free_inputs * (gu + later), free_inputs * (jnp.abs(gu) + jnp.abs(later))
    absolute = jax.tree.map(jnp.abs, replace(s, bounds=Bounds(s.bounds.l, s.bounds.u)))
    x_terms, u_terms = jax.vmap(absolute.pull)(jnp.abs(force))
    carried = jnp.abs(back) + jax.lax.cumsum(x_terms[:, 1:], axis=1, reverse=True)
    noise = u_terms + jax.vmap(partial(apply_transposed, absolute.B))(carried)
    # A column's inputs are those of the plan for each unit of ω: they share its sizes.
    typical = jnp.max(found.gradient_size, axis=0)
    sizes = own + SHARE * (typical + jnp.max(own, axis=(0, 1)))
    noise = noise + jnp.max(found.gradient_terms, axis=0)
    entry_terms = jax.vmap(absolute.rows)(jnp.abs(X), jnp.abs(U))
    gap = gap + jnp.sum(U * gradient) + jnp.sum(p * jnp.abs(entries) - q * entries)
    size = size + jnp.sum(jnp.abs(U) * own)
    terms = terms + jnp.sum(jnp.abs(U) * noise) + jnp.sum(p * entry_terms)
    violation, row_sizes, row_terms = of_rows
    row_terms = row_terms + jnp.tile(jnp.sum(entry_terms, axis=0), 2)
    joined = [
        jnp.append(a, b.ravel()) for a, b in zip(of_plan, (gradient, sizes, noise), strict=True)
    ]
    measured: Terms = [
        (violation, row_sizes, row_terms),
        (joined[0], joined[1], joined[2]),
        (gap, size, terms),
    ]
    floor = rounding(E.dtype)
    beyond = jnp.maximum(jnp.maximum(found.rows - bounds.u, bounds.l - found.rows), 0.0)
    policy: Any = Policy(v, M, beyond.reshape(2, -1), worst(measured[:1], floor)[0][0] <= eps)
    return Pair.of(policy, y.reshape(2, -1), measured, eps, floor)


@pytree
class PolicySearch:
    """Loop state of one instance: the point, the best policy so far, the least error that the
    method came to, the steps taken, and whether to go on."""

    at: Point
    best: Pair
    least: Array
    steps: Array
    open: Array


def policy_step(most: int, constants: tuple[Columns, Array], state: PolicySearch) -> PolicySearch:
    """One interior point step; the search ends after `most`, when the residuals are far below eps,
    or when the iterates have come to rest."""
    c, eps = constants
    at = state.at
    step = direction(c, at)
    length = jnp.minimum(FRACTION * Solver.of(c).length(at, step), 1.0)
    sound = all_finite(step) & (length > REST)
    step = jax.tree.map(lambda d: jnp.where(sound, d, 0.0), step)
    at = advanced(at, step, jnp.where(sound, length, 0.0))
    pair = measured_policy(eps, c, at)
    best, steps = state.best.or_better(pair), state.steps + 1
    lost = (state.least < BEGUN) & (pair.error > LOST * state.least)
    wanted = ~(best.near | best.finished | lost) & sound & (steps < most)
    return PolicySearch(at, best, jnp.minimum(state.least, pair.error), steps, wanted)


def searched_policy(
    most: int, fixed: bool, s: Stages, E: Array, push: Array, offset: Any, Gamma: Array, eps: Array
) -> tuple[Pair, Array]:
    """Return the best policy that is found in at most so many steps, and how many were taken.

    push (n, g): E Γ. offset: o (g,), None for zero. fixed: all steps are taken.
    """
    N, g = s.horizon, push.shape[1]
    pushes = jnp.zeros((N, g, N, len(push)), push.dtype)
    pushes = pushes.at[np.arange(N), :, np.arange(N)].set(push.T).reshape(N * g, N, -1)
    later = np.arange(N) > np.repeat(np.arange(N), g)[:, None]
    # What does nothing to the states needs no answer.
    answers = jnp.where(jnp.any(pushes != 0, axis=(1, 2))[:, None], later, 0.0)
    offset = None if offset is None else jnp.tile(offset, N)[:, None]
    gains = riccati(s)
    least = unconstrained(s, gains, jnp.zeros_like(E))[1]
    alone = jax.tree.map(lambda v: v[None], gains)
    of_plan = covariance(s, E, alone, jnp.ones((1, 1, len(E)), E.dtype))[0, 0]
    c = Columns(s, E, gains, least, pushes, offset, Gamma, jnp.linalg.pinv(Gamma), answers, of_plan)
    begun = _begin(c)
    best = measured_policy(eps, c, begun)
    error = jnp.asarray(jnp.inf, E.dtype)
    state = PolicySearch(begun, best, error, jnp.int32(0), ~(best.near | best.finished))
    step = partial(policy_step, most)
    if fixed:
        state = jax.lax.scan(lambda v, _: (step((c, eps), v), None), state, length=most)[0]
    elif most:
        state = repeat_while(lambda state: state.open, step, (c, eps), state, "recursion")
    return state.best, state.steps


@jax.custom_jvp
def _without_derivative(tree: Any) -> Any:
    """Return the tree; ValueError where it is differentiated."""
    return tree


@_without_derivative.defjvp
def _(primals: tuple, tangents: tuple) -> tuple:
    what = "of an affine policy is differentiated, and stage by stage it has no derivative"
    fail("mpc", what, 'Use jm.solve, or policy="tightened"')


def affine_plan(
    mpc: MPC, s: Stages, E: Array, fault: Array, solver: ADMM, aim: Aim, centred: bool
) -> Plan:
    """Return the plan of an affine policy from the stages of the undisturbed plant, aimed, and
    their row scale E (rows,). fault: NOT_RUN where the data are usable. centred: whether W is known
    to be symmetric about zero. Works inside jit and vmap."""
    mpc, s, E, aim = _without_derivative((mpc, s, E, aim))
    dtype, n = E.dtype, mpc.system.n
    center, Gamma, into = generator_form(mpc, dtype)
    sound = all_finite((center, Gamma, into))
    fault = jnp.where((fault == Status.NOT_RUN) & ~sound, jnp.int32(Status.NON_FINITE), fault)
    center, Gamma, into = jax.tree.map(lambda v: jnp.where(sound, v, 0.0), (center, Gamma, into))
    push = jnp.pad(matmul(into, Gamma), ((0, s.A.shape[-1] - n), (0, 0)))
    offset = None if centred else matmul(jnp.linalg.pinv(Gamma), center)
    most = INTERIOR_STEPS if solver.newton_steps is None else solver.newton_steps
    search = partial(searched_policy, most, solver.fixed)
    best, steps = precisely(search, s, E, push, offset, Gamma, jnp.asarray(solver.eps, dtype))
    policy: Any = best.z
    y = jnp.sum(best.y, axis=0)
    found = with_status(best.measured, policy.v, y, Proof.none(policy.v, y))
    # Rows that hold make a policy that may be followed, whatever its cost.
    kept = (found.status == Status.ITERATION_LIMIT) & policy.kept
    status = jnp.where(kept, jnp.int32(Status.INACCURATE), found.status)
    found = replace(found, status=status, iterations=steps)
    x = s.of_system(predict(s, policy.v))
    return answer(mpc, s.layout, found, fault, x, policy.v, aim, policy.feedback, policy.beyond)
