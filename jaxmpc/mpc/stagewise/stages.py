"""A linear-quadratic problem stage by stage: its data, recursions and optimality conditions.

The problem of all stages has states x (N+1, n) that follow from inputs u (N, m), the cost of `MPC`
and rows H x_k + D u_k with bounds and penalties. Everything that a solver needs of it costs N
products with n×n matrices; the condensed matrices are never formed. To minimise the cost with
penalties ½ W row² on the rows and linear terms is an LQR problem. With the weights doubled (J has
no ½, the QP has) the stage cost is

    ½ [x; u]' [2Q + H'WH, H'WD; D'WH, 2R + D'WD] [x; u] − g_x'x − g_u'u

and the value function ½ x'S x + p'x of the steps after k gives (Rawlings, Mayne, Diehl 2017, §1.3)

    G = 2R + D'WD + B'S⁺B,   K = −G⁻¹(B'S⁺A + D'WH),   u = K x + G⁻¹(g_u − B'p⁺),
    p = (A + BK)'p⁺ − g_x − K'g_u.

Only p runs backward and only x forward; all else is done for all stages at once.

With a gain the inputs are u_k = K_k x_k + v_k and a plan is its moves v, the substitution of
`mpc.prestabilise`: x follows from v by A + BK, which does not lose the digits that an unstable A
does, and so do the costates. The problem, its rows and the recursion above stay those in x and u;
only gradients are taken at fixed v.

Where input rates are limited or weighed, the state here is (x_k, u_{k−1}), x_0 followed by u_{−1}:
A and B get m more rows, u_k = u_k, the rate u_k − u_{k−1} is a row in state and input, and its cost
Δu'W Δu is a part of Q, R and the cross term. The reference of u_{k−1} is that of u_k,
so that the difference of both distances is the rate.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.mpc.plan import Aim
from jaxmpc.mpc.problem import MPC, dynamics_of, weights_of
from jaxmpc.mpc.rows import (
    Layout,
    Rows,
    blocks,
    bounds_of,
    layout_of,
    split,
    spread,
)
from jaxmpc.mpc.stagewise.recursion_kernels import Gains, recurrence, riccati_recursion, tracking
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.admm import convex
from jaxmpc.qp.linalg import (
    apply,
    apply_transposed,
    floating_dtype,
    matmul,
    precisely,
    rounding,
)
from jaxmpc.qp.problem import Bounds
from jaxmpc.qp.residuals import CANCELS, SHARE, Pair, Terms
from jaxmpc.qp.status import Status


@pytree
class Stages:
    """The data of a problem in one floating type.

    A (n, n), B (n, m), c (n,), or with a leading axis N. Q, R, P: weights, without ½; P of x_N; Q
    and R may have a leading axis N; cross M (m, n), or (N, m, n): of the term 2 u'M x, None for
    zero.
    blocks, bounds: the rows of `rows.blocks`, and what is asked of all of them (rows,). aim: where
    a plan begins and what it tracks, with full references; none of it until it is known.
    remembers: whether the state is (x_k, u_{k−1}), and n its size. gain K (m, n) or (N, m, n):
    plans are moves v, the inputs u = K x + v; None: they are the inputs.
    """

    A: Array
    B: Array
    c: Array
    Q: Array
    R: Array
    P: Array
    blocks: tuple[Rows, ...]
    bounds: Bounds
    horizon: int = static()
    cross: Array | None = None
    aim: Aim = Aim(None)
    remembers: bool = static(default=False)
    gain: Array | None = None

    @classmethod
    def of(cls, mpc: MPC) -> "Stages":
        """Return the data of `mpc`. Works inside jit, vmap and grad."""
        dtype = floating_dtype(mpc)
        A, B, c = dynamics_of(mpc.system, dtype)
        Q, R, P, W = weights_of(mpc, dtype)
        found = blocks(mpc, dtype)
        rows = tuple(Rows(b.kind, b.H, b.D, b.steps, b.box) for b in found)
        s = cls(A, B, c, Q, R, P, rows, bounds_of(found, dtype), mpc.horizon)
        if not mpc.input_in_state:
            return s
        weight = None if mpc.input_rate_weight is None else W
        return _with_rates(s, weight, [block.rate for block in found])

    def aimed(self, aim: Aim) -> "Stages":
        """Return the stages with x0 and full references of the problem as it was stated."""
        if self.remembers:
            before = jnp.concatenate([aim.inputs, aim.inputs[-1:]])  # the last has no weight
            states = jnp.concatenate([aim.states, before], axis=1)
            aim = aim._replace(x0=jnp.concatenate([aim.x0, aim.previous_input]), states=states)
        return replace(self, aim=aim)

    def joined(self, x: Array, u: Array) -> Array:
        """Return the states of the stages for those x (N+1, ·) of the system under u (N, m)."""
        if not self.remembers:
            return x
        before = jnp.concatenate([self.aim.x0[None, x.shape[1] :], u])
        return jnp.concatenate([x, before], axis=1)

    def of_system(self, x: Array) -> Array:
        """Return the states of the system in those x (N+1, n) of the stages."""
        return x[:, : x.shape[1] - self.B.shape[-1]] if self.remembers else x

    @property
    def closed(self) -> Array:
        """The matrix from a state to the next at fixed moves, A or A + BK."""
        return self.A if self.gain is None else self.A + matmul(self.B, self.gain)

    def inputs(self, x: Array, v: Array) -> Array:
        """Return the inputs (N, m) along x (N+1, n) for moves v (N, m)."""
        return v if self.gain is None else v + apply(self.gain, x[:-1])

    def moves(self, x: Array, u: Array) -> Array:
        """Return the moves (N, m) of inputs u (N, m) along x (N+1, n)."""
        return u if self.gain is None else u - apply(self.gain, x[:-1])

    def at_fixed_moves(self, gx: Array, gu: Array) -> Array:
        """Return the gradient in x (N+1, n) at fixed moves of a function of x and u whose
        gradients in these are gx (N+1, n) and gu (N, m)."""
        if self.gain is None:
            return gx
        return gx + jnp.pad(apply_transposed(self.gain, gu), ((0, 1), (0, 0)))

    @property
    def layout(self) -> Layout:
        """(kind, steps, rows a step) of each block."""
        return layout_of(self.blocks)

    def by_block(self, v: Array) -> list[tuple[Rows, Array]]:
        """Each block with its part (steps, rows a step) of v (rows,)."""
        return list(zip(self.blocks, split(self.layout, v), strict=True))

    def rows(self, x: Array, u: Array) -> Array:
        """H x_k + D u_k of all blocks (rows,) along x (N+1, n), u (N, m)."""
        values = [block.values(x, u).ravel() for block in self.blocks]
        return jnp.concatenate([jnp.zeros(0, x.dtype), *values])

    def pull(self, weights: Array) -> tuple[Array, Array]:
        """Σ weights·(gradient of the row) in x (N+1, n) and u (N, m): the transpose of `rows`."""
        N, n, m = self.horizon, self.A.shape[-1], self.B.shape[-1]
        gx, gu = jnp.zeros((N + 1, n), weights.dtype), jnp.zeros((N, m), weights.dtype)
        for block, w in self.by_block(weights):
            gx, gu = block.pull(w, gx, gu)
        return gx, gu

    def gradient(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Of J at x, u: (N+1, n) and (N, m)."""
        aim = self.aim
        e, d = 2 * (x - aim.states), 2 * (u - aim.inputs)
        gx, gu = apply(self.Q, e[:-1]), apply(self.R, d)
        if self.cross is not None:
            gx, gu = gx + apply_transposed(self.cross, d), gu + apply(self.cross, e[:-1])
        gradient = jnp.concatenate([gx, apply(self.P, e[-1:])]), gu
        return gradient if aim.slopes is None else jax.tree.map(jnp.add, gradient, aim.slopes)

    def varying(self, *names: str) -> list[Any]:
        """The named ones of A, B, c where they differ from step to step, else None."""
        values = [(getattr(self, name), 1 if name == "c" else 2) for name in names]
        return [v if v.ndim > dimensions else None for v, dimensions in values]


def _padded(M: Array, m: int) -> Array:
    """Return M (…, a, b) with m rows and columns of zeros behind."""
    return jnp.pad(M, [*[(0, 0)] * (M.ndim - 2), (0, m), (0, m)])


def remembering(A: Array, B: Array, c: Array) -> tuple[Array, Array, Array]:
    """Return A, B, c of the state (x_k, u_{k−1}); each may have a leading axis."""
    m = B.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(m, dtype=B.dtype), (*B.shape[:-2], m, m))
    c = jnp.pad(c, [*[(0, 0)] * (c.ndim - 1), (0, m)])
    return _padded(A, m), jnp.concatenate([B, identity], axis=-2), c


def _with_rates(s: Stages, W: Array | None, rates: list[bool]) -> Stages:
    """Return the stages in the state (x_k, u_{k−1}), with the weight W (m, m), or one a step, of
    input rates; rates: which blocks are rows of them."""
    A, B, c = remembering(s.A, s.B, s.c)
    n, m = s.A.shape[-1], s.B.shape[-1]
    found = []
    for block, rate in zip(s.blocks, rates, strict=True):
        if rate:
            H: Any = jnp.pad(-jnp.eye(m, dtype=s.P.dtype), [(0, 0), (n, 0)])
        else:
            axes = [(0, 0)] * (0 if block.H is None else block.H.ndim - 1)
            H = None if block.H is None else jnp.pad(block.H, [*axes, (0, m)])
        found.append(replace(block, H=H, box=block.box and H is None))
    Q, R, P, cross = _padded(s.Q, m), s.R, _padded(s.P, m), None
    if W is not None:
        each = [(0, 0)] * (W.ndim - 2)
        Q, R = Q + jnp.pad(W, [*each, (n, 0), (n, 0)]), R + W
        cross = -jnp.pad(W, [*each, (0, 0), (n, 0)])
    return replace(
        s,
        A=A,
        B=B,
        c=c,
        Q=Q,
        R=R,
        P=P,
        cross=cross,
        blocks=tuple(found),
        remembers=True,
    )


def cleaned(s: Stages) -> tuple[Stages, Array]:
    """The data with harmless numbers in place of those that are not usable, and the fault in them
    (see `qp.solve.cleaned`): NOT_RUN for none, NON_CONVEX where Q, R or P is indefinite.

    Each array by itself: what a batch shares is read and cleaned once, whatever its instances hold.
    """
    everywhere = lambda *tests: jnp.all(jnp.stack([jnp.all(test) for test in tests]))
    numbers = jax.tree.leaves((s.A, s.B, s.c, s.Q, s.R, s.P, s.blocks))
    lower, upper = s.bounds.l, s.bounds.u
    ordered = (lower <= upper) & ~jnp.isposinf(lower) & ~jnp.isneginf(upper)
    tests = [*map(jnp.isfinite, numbers), ordered]
    finite = lambda tree: jax.tree.map(lambda v: jnp.where(jnp.isfinite(v), v, 0.0), tree)
    linear, quadratic = s.bounds.linear, s.bounds.quadratic
    if linear is not None:
        tests += [linear >= 0, (quadratic >= 0) & jnp.isfinite(quadratic)]
        linear, quadratic = (
            jnp.where(test, v, harmless)
            for test, v, harmless in zip(tests[-2:], (linear, quadratic), (jnp.inf, 0), strict=True)
        )
    lower, upper = jnp.where(ordered, lower, -jnp.inf), jnp.where(ordered, upper, jnp.inf)
    Q, R, P, cross = finite((s.Q, s.R, s.P, s.cross))
    # What `require_symmetric_psd` takes for rounding of 0 is none of a curvature here either.
    slack = lambda M: 1e-15 * jnp.max(jnp.abs(M), initial=0.0) * jnp.eye(len(M), dtype=M.dtype)
    whole = lambda M: convex(M + slack(M))
    sound = lambda M: jnp.all(jax.vmap(whole)(M)) if M.ndim == 3 else whole(M)
    convexity = [sound(Q), sound(R), sound(P)]
    fault = jnp.where(everywhere(*convexity), Status.NOT_RUN, Status.NON_CONVEX)
    fault = jnp.where(everywhere(*tests), fault, Status.NON_FINITE).astype(jnp.int32)
    identity = jnp.broadcast_to(jnp.eye(R.shape[-1], dtype=R.dtype), R.shape)
    Q, R, P = map(jnp.where, convexity, (Q, R, P), (jnp.zeros_like(Q), identity, jnp.zeros_like(P)))
    if cross is not None:
        cross = jnp.where(everywhere(*convexity), cross, 0.0)
    harmless = replace(
        s,
        A=finite(s.A),
        B=finite(s.B),
        c=finite(s.c),
        Q=Q,
        R=R,
        P=P,
        blocks=finite(s.blocks),
        bounds=Bounds(lower, upper, linear, quadratic),
        cross=cross,
    )
    return harmless, fault


def riccati(s: Stages, weights: Any = None) -> Gains:
    """Gains for the cost and ½ Σ weights·row², weights (rows,) or None."""
    N = s.horizon
    each = lambda M: jnp.broadcast_to(M, (N, *M.shape[-2:]))
    Q = 2 * jnp.concatenate([each(s.Q), s.P[None]])
    R = 2 * each(s.R)
    cross = None if s.cross is None else 2 * each(s.cross)
    for block, w in () if weights is None else s.by_block(weights):
        H, D, steps, box = block.H, block.D, block.steps, block.box
        diagonal = lambda w: w[:, :, None] * jnp.eye(w.shape[1], dtype=w.dtype)
        if H is not None:
            Q = Q + spread(diagonal(w) if box else _weighed(H, H, w), steps, N + 1)
        if D is not None:
            R = R + spread(diagonal(w) if box else _weighed(D, D, w), steps, N)
        if H is not None and D is not None:
            cross = (0.0 if cross is None else cross) + spread(_weighed(D, H, w), steps, N)
    return riccati_recursion(Q, R, cross, s.A, s.B)


def _weighed(M: Array, L: Array, w: Array) -> Array:
    """Return M'diag(w_k)L of each step (steps, a, b); w (steps, r), M (r, a) and L (r, b), or one a
    step."""
    if M.ndim == 2 and L.ndim == 2:  # the same at all steps, of a batch too: one product with w
        products = M[:, :, None] * L[:, None, :]
        return matmul(w, products.reshape(len(M), -1)).reshape(-1, *products.shape[1:])
    return matmul(jnp.swapaxes(M, -1, -2) * w[:, None, :], L)


def minimise(s: Stages, gains: Gains, gx: Array, gu: Array, unroll: int = 1) -> tuple[Array, Array]:
    """x (N+1, n), u (N, m) of least penalised cost − gx·x − gu·u from x_0 = 0, without c and
    references."""
    return tracking(gains, s.A, s.B, gx, gu, unroll)


def predict(s: Stages, v: Array) -> Array:
    """x (N+1, n) from x_0 under the moves v (N, m), without a gain the inputs."""
    x0 = s.aim.x0
    w = jnp.broadcast_to(apply(s.B, v) + s.c, (s.horizon, len(x0)))
    return jnp.concatenate([x0[None], recurrence(s.closed, w, x0)])


def rows_under(s: Stages, v: Array) -> Array:
    """The rows (rows,) from x_0 under the moves v (N, m)."""
    x = predict(s, v)
    return s.rows(x, s.inputs(x, v))


def unconstrained(s: Stages, gains: Gains, weights: Array) -> tuple[Array, Array]:
    """x, u of least cost with the penalties ½ Σ weights·row²."""
    # From a trajectory that the gains keep bounded, one minimisation of what is left.
    x0, c = s.aim.x0, jnp.broadcast_to(s.c, (s.horizon, s.c.shape[-1]))
    x = jnp.concatenate([x0[None], recurrence(gains.closed, c, x0)])
    u = apply(gains.K, x[:-1])
    moved = jax.tree.map(jnp.add, s.gradient(x, u), s.pull(weights * s.rows(x, u)))
    dx, du = minimise(s, gains, -moved[0], -moved[1])
    return x + dx, u + du


class Optimality(NamedTuple):
    """Rows (rows,) and gradient (N, m) of the Lagrangian with respect to the moves, the terms of
    both and of the cost, the sums that the gradient is a difference of, and how large the cost is.
    """

    rows: Array
    gradient: Array
    row_terms: Array
    gradient_terms: Array
    cost_terms: Array
    gradient_size: Array
    cost_size: Array


def conditions(s: Stages, v: Array, y: Array) -> Optimality:
    """Optimality conditions of moves v (N, m) and multipliers y (rows,), by the states that v
    leads to and the costates λ_k = ∂J/∂x_k + H'y + A'λ_{k+1}, at fixed moves."""
    x = predict(s, v)
    u = s.inputs(x, v)
    (gx, own), (px, pushed) = s.gradient(x, u), s.pull(y)
    # Of cost and rows apart: at the solution their sum is small, its rounding is that of the parts.
    both = jax.vmap(s.at_fixed_moves)(jnp.stack([gx, px]), jnp.stack([own, pushed]))
    back = jax.vmap(lambda g: recurrence(s.closed, g[:-1], g[-1], adjoint=True))(both)
    of_cost, of_rows = jnp.concatenate([back[:, 1:], both[:, -1:]], axis=1)
    absolute = jax.tree.map(jnp.abs, replace(s, bounds=Bounds(s.bounds.l, s.bounds.u)))
    # A state is a difference of the terms of its step, as where torques balance the weight.
    moved = apply(absolute.A, jnp.abs(x[:-1])) + apply(absolute.B, jnp.abs(u)) + absolute.c
    terms = jnp.concatenate([jnp.abs(x[:1]), moved])
    # Its gradient, of the terms of its distance from the reference, and of slopes.
    far = absolute.aim._replace(states=-absolute.aim.states, inputs=-absolute.aim.inputs)
    weighed, own_terms = replace(absolute, aim=far).gradient(terms, jnp.abs(u))
    later = jax.lax.cumsum(weighed[1:], reverse=True)
    # The rounding of a costate is that of others too, as of a speed's that of its position.
    later = later + apply_transposed(absolute.A, later)
    back_terms = later + jnp.abs(of_cost) + jnp.abs(of_rows)
    cost_part = jnp.abs(own) + apply_transposed(absolute.B, jnp.abs(of_cost))
    row_part = jnp.abs(pushed + apply_transposed(s.B, of_rows))
    # Of an expansion the cost at its point is not known, only gradients: those of all of x and u.
    expansion = s.aim.slopes is not None
    dx, du = (x, u) if expansion else (x - s.aim.states, u - s.aim.inputs)
    return Optimality(
        rows=s.rows(x, u),
        gradient=own + pushed + apply_transposed(s.B, of_cost + of_rows),
        row_terms=absolute.rows(terms, jnp.abs(u)),
        gradient_terms=own_terms
        + absolute.pull(jnp.abs(y))[1]
        + apply_transposed(absolute.B, back_terms),
        cost_terms=(jnp.sum(terms * weighed) + jnp.sum(jnp.abs(u) * own_terms)) / 2,
        gradient_size=cost_part + row_part,
        cost_size=(jnp.sum(jnp.abs(dx * gx)) + jnp.sum(jnp.abs(du * own))) / 2,
    )


def stage_residuals(s: Stages, E: Array, v: Array, y: Array) -> Terms:
    """As `qp.residuals.residual_terms` for the condensed QP in the moves; E (rows,): row scale."""
    return residuals_of(s, E, v, y, conditions(s, v, y))


def residuals_of(s: Stages, E: Array, v: Array, y: Array, found: Optimality) -> Terms:
    """Return `stage_residuals` of a pair whose conditions are known.

    With the gradient g of the Lagrangian the gap z'Pz + q'z + g(Az) + g*(y) is
    v'g + g(rows) + g*(y) − y'rows: at the optimum both parts are zero. Its size is at most twice
    what the plan costs: where the model is unstable, parts of g are larger by |A|^N.

    What is typical of a row and of an input is what is the most of the same one over the horizon.
    All that may vanish, as where u = 0 is all that limits allow: inputs that cost as much as the
    plan, J ≤ ½ c, move a row of scale E by up to √c/E, and steps that end at a limit of zero leave
    rounding of that. Another limit is what its row is compared with, however far off the plan
    without it is.
    """
    bounds = s.bounds
    reach = jnp.where(E > 0, jnp.sqrt(2 * found.cost_terms) / jnp.where(E > 0, E, 1.0), 0.0)
    own_terms = found.row_terms + reach
    penalty, support, product = bounds.cost(found.rows), bounds.support(y), y * found.rows
    gap = jnp.sum(v * found.gradient) + jnp.sum(penalty + support - product)
    terms = jnp.sum(jnp.abs(v) * found.gradient_terms)
    slopes = bounds.slope(found.rows) + jnp.abs(y)
    terms = terms + jnp.sum(slopes * own_terms + jnp.abs(support))
    size = jnp.sum(penalty + jnp.abs(support) + jnp.abs(product))
    size = size + jnp.sum(jnp.abs(v) * found.gradient_size)
    size = jnp.minimum(size, 2 * (found.cost_size + jnp.sum(penalty)))

    def most(values: Array) -> Array:
        most_of = lambda part: jnp.max(part, axis=0, initial=0.0)
        parts = split(s.layout, values)
        parts = [jnp.broadcast_to(most_of(part), part.shape).ravel() for part in parts]
        return jnp.concatenate([*parts, values[:0]])

    known = bounds.sizes()
    row_size = jnp.maximum(known, jnp.abs(found.rows))
    row_terms = jnp.where(known > 0, found.row_terms, own_terms) + row_size
    gradient_size = found.gradient_size + SHARE * jnp.max(found.gradient_size, axis=0)
    gradient_terms = found.gradient_terms + jnp.max(found.gradient_terms, axis=0)
    row_sizes = row_size + SHARE * most(row_size)
    # Where bounds hold inputs at zero all sums of the gap vanish.
    size = size + CANCELS * jnp.sum(jnp.abs(y) * row_sizes)
    return [
        (bounds.violation(found.rows), row_sizes, row_terms + most(row_terms)),
        (found.gradient.ravel(), gradient_size.ravel(), gradient_terms.ravel()),
        (gap[None], size[None], terms[None]),
    ]


def measured_pair(eps: Array, s: Stages, E: Array, v: Array, y: Array) -> Pair:
    """The pair of moves v (N, m) and multipliers y (rows,), its residuals measured in float64; E:
    row scale (rows,)."""
    y, floor = s.bounds.admissible(y), rounding(v.dtype)
    pair = lambda s, E, v, y, eps: Pair.of(v, y, stage_residuals(s, E, v, y), eps, floor)
    return precisely(pair, s, E, v, y, eps)
