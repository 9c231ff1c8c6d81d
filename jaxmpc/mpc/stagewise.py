"""ADMM stage by stage: MPC whose A, B, c differ for every problem of a batch or every step.

The iteration is that of `qp/admm.py` on the condensed QP, the iterates are the same; only the
condensed matrices are never formed. A step needs "linear terms on the rows, minimise the quadratic
with its penalties", which is an LQR problem: with gains from one Riccati recursion a backward
and a forward pass over the stages, N products with n×n matrices each, where the dense step reads
a matrix of (rows)² entries. With the weights doubled (J has no ½, the QP has) and W = diag(ρE²)
the stage cost is

    ½ [x; u]' [2Q + H'WH, H'WD; D'WH, 2R + D'WD] [x; u] − g_x'x − g_u'u

and the value function ½ x'S x + p'x of the steps after k gives (Rawlings, Mayne, Diehl 2017, §1.3)

    G = 2R + D'WD + B'S⁺B,   K = −G⁻¹(B'S⁺A + D'WH),   u = K x + G⁻¹(g_u − B'p⁺),
    p = (A + BK)'p⁺ − g_x − K'g_u.

Only p runs backward and only x forward; all else is done for all stages at once.

The row scale E of `qp/admm.scale` makes the rows a_i of all inputs one unit long in the metric of
the Hessian: 1/E_i² = a_i' P⁻¹ a_i. P⁻¹ is the covariance of inputs drawn with density exp(−J): by
the same recursion without penalties u_k = K x_k + e_k with e_k of covariance G⁻¹, hence that of x_k
runs forward, Σ⁺ = (A + BK) Σ (A + BK)' + B G⁻¹ B' from Σ_0 = 0.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail, require_finite
from jaxmpc.control.sets import Box, Ellipsoid
from jaxmpc.control.system import LinearSystem, as_array, host_array
from jaxmpc.mpc.kernels import Gains, recurrence, riccati_recursion, tracking
from jaxmpc.mpc.plan import Plan, WarmStart, answer
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import Layout, blocks, layout
from jaxmpc.qp.admm import (
    ADMM,
    DEFAULT,
    Splitting,
    convex,
    default_rho,
    iterate,
    scaled_multipliers,
    start,
)
from jaxmpc.qp.batches import repeat_while
from jaxmpc.qp.certificate import Proof
from jaxmpc.qp.derivative import Undo, implicit
from jaxmpc.qp.linalg import cholesky
from jaxmpc.qp.newton import Constants
from jaxmpc.qp.precision import arrays, floating_dtype, matmul, precisely, rounding
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.residuals import Pair, Terms, assess
from jaxmpc.qp.solve import tolerance
from jaxmpc.qp.status import Status

# Most stages that the passes of an ADMM step write out, without a loop over them. Loops reorder
# (batch, N, …) to (N, batch, …) at each step, which takes longer than the products.
UNROLL = 32
# Newton steps where ADMM.refine is None. A problem without a solution takes them all.
MOST_STEPS = 150


def solve_stagewise(
    mpc: MPC, system: LinearSystem, x0: Any, reference: Any = None, solver: ADMM = DEFAULT,
    warm_start: Any = None, *, input_reference: Any = None, scale: Any = None,
) -> Plan:  # fmt: skip
    """Solve `mpc` with `system` in place of its own, whose A (n, n), B (n, m) and c (n,) may have
    a leading axis N: x_{k+1} = A_k x_k + B_k u_k + c_k.

    x0, references, solver and the Plan are those of `solve`, and so is the status: residuals and
    gap of the returned inputs and multipliers, evaluated from the data in float64. What differs:
    no infeasibility is proved (a problem without a solution ends as ITERATION_LIMIT: soften the
    rows that may not hold). Derivatives with respect to every array of data are those of
    solver.differentiate. warm_start: an earlier Plan or a WarmStart, whose states are not read.
    solver.refine: Newton steps at most (None: 150), a Riccati recursion each; 5 suffice where ADMM
    has found the active rows. mpc.prestabilise is not read:
    the inputs are the variables, so a plant that grows more than 1e5-fold over the horizon in open
    loop (1e3-fold in float32) has residuals above eps by rounding alone; `solve` takes those. scale
    (rows,): the row scale of a similar problem (`factor_stages(...).E`), which saves one of two
    Riccati recursions; it changes the path of ADMM, not the answer. A row of scale 0 counts as
    one that no input moves: where that is not so, the plan does not become SOLVED.

    `jax.vmap` over system, x0, references or the arrays of `mpc`. Raises ValueError for bad data
    that can be read, and for what only `solve` supports: Ellipsoids, control horizons, input rates.
    """
    factor = factor_stages(mpc, system, solver, scale)
    return plan_stages(
        factor, replace(mpc, system=system), x0, reference, solver, warm_start,
        input_reference=input_reference,
    )  # fmt: skip


def factor_stages(
    mpc: MPC, system: LinearSystem, solver: ADMM = DEFAULT, scale: Any = None
) -> "StageFactor":  # fmt: skip
    """What x0, references and warm start do not change: row scale and Riccati gains.

    Arguments and errors as in `solve_stagewise`; `plan_stages` does the rest.
    """
    mpc = checked(mpc, system, solver)
    rows = sum(len(steps) * size for _, steps, size in layout(mpc))
    if scale is not None and np.shape(scale) != (rows,):
        fail("scale", f"shape {np.shape(scale)}", f"Give ({rows},), one number a row")
    return _factor(*arrays((mpc, solver.rho, scale)))


def checked(mpc: MPC, system: LinearSystem, solver: ADMM) -> MPC:
    """The problem with `system` in it; ValueError for what is wrong with either."""
    if not isinstance(system, LinearSystem):
        fail("system", f"is a {type(system).__name__}", "Give a jm.LinearSystem")
    for name, found in (
        ("terminal_set is an Ellipsoid", isinstance(mpc.terminal_set, Ellipsoid)),
        ("control_horizon is given", mpc.control_horizon is not None),
        ("input rates are limited or weighed", mpc.input_in_state),
    ):
        if found:
            fail("mpc", name, "Stage by stage there is no such thing: use jm.solve")
    first: dict[str, Any] = {}
    for name, dimensions in (("A", 2), ("B", 2), ("c", 1)):
        value = getattr(system, name)
        if value is None:
            continue
        if concrete(value):
            require_finite(name, host_array(name, value))
        value = as_array(value)
        shape = np.shape(value)
        staged = len(shape) == dimensions + 1
        if staged and shape[0] != mpc.horizon:
            fail(name, f"shape {shape}", f"A leading axis counts the {mpc.horizon} steps")
        first[name] = value[0] if staged and shape[0] else value
    replace(mpc, system=replace(system, **first), prestabilise=None).validate()
    mpc = replace(mpc, system=system, prestabilise=None)
    solver.validate(sum(len(steps) * size for _, steps, size in layout(mpc)))
    return mpc


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Stages:
    """The data of a problem in one floating type.

    A (n, n), B (n, m), c (n,), or with a leading axis N. Q, R, P: weights, without ½; P of x_N;
    stage (N,): weights of the stages.
    H (r, n) and D (r, m) of each block of rows (`rows.blocks`), None for zero. lower, upper,
    linear, quadratic (rows,): as in `Bounds`. layout: (kind, steps, rows a step) of each block;
    boxes: whether its matrix is the identity.
    """

    A: Array
    B: Array
    c: Array
    Q: Array
    R: Array
    P: Array
    stage: Array
    H: tuple[Any, ...]
    D: tuple[Any, ...]
    lower: Array
    upper: Array
    linear: Any
    quadratic: Any
    layout: Layout = field(metadata={"static": True})
    boxes: tuple[bool, ...] = field(metadata={"static": True})
    horizon: int = field(metadata={"static": True})

    @property
    def bounds(self) -> Bounds:
        """What the problem asks of its rows."""
        return Bounds(self.lower, self.upper, self.linear, self.quadratic)

    def blocks(self) -> list[tuple[slice, tuple[int, ...], int, Any, Any, bool]]:
        """(its rows, steps, rows a step, H, D, whether that is the identity) of each block."""
        found, first = [], 0
        for (_, steps, size), H, D, box in zip(
            self.layout, self.H, self.D, self.boxes, strict=True
        ):
            last = first + len(steps) * size
            found.append((slice(first, last), steps, size, H, D, box))
            first = last
        return found

    def rows(self, x: Array, u: Array) -> Array:
        """H x_k + D u_k of all blocks (rows,) along x (N+1, n), u (N, m)."""
        parts = [jnp.zeros(0, x.dtype)]
        for _, steps, _, H, D, box in self.blocks():
            value: Any = 0.0
            for M, v in ((H, x), (D, u)):
                if M is not None:
                    v = at(v, steps)
                    value = value + (v if box else matmul(v, M.T))
            parts.append(value.ravel())
        return jnp.concatenate(parts)

    def pull(self, weights: Array) -> tuple[Array, Array]:
        """Σ weights·(gradient of the row) in x (N+1, n) and u (N, m): the transpose of `rows`."""
        N, n, m = self.horizon, self.A.shape[-1], self.B.shape[-1]
        gx: Any = jnp.zeros((N + 1, n), weights.dtype)
        gu: Any = jnp.zeros((N, m), weights.dtype)
        for rows, steps, size, H, D, box in self.blocks():
            w = weights[rows].reshape(len(steps), size)
            if H is not None:
                gx = gx + spread(w if box else matmul(w, H), steps, N + 1)
            if D is not None:
                gu = gu + spread(w if box else matmul(w, D), steps, N)
        return gx, gu

    def varying(self, *names: str) -> list[Any]:
        """The named ones of A, B, c where they differ from step to step, else None."""
        values = [(getattr(self, name), 1 if name == "c" else 2) for name in names]
        return [v if v.ndim > dimensions else None for v, dimensions in values]


def consecutive(steps: tuple[int, ...]) -> bool:
    """Return whether the steps are k, k + 1, …"""
    return bool(steps) and steps == tuple(range(steps[0], steps[0] + len(steps)))


def at(v: Array, steps: tuple[int, ...]) -> Array:
    """Return v_k at the steps."""
    if consecutive(steps):
        return v[steps[0] : steps[0] + len(steps)]
    return v[np.array(steps, int)]


def spread(part: Array, steps: tuple[int, ...], length: int) -> Array:
    """Return the array of so many steps that is `part` at the steps and zero elsewhere."""
    if consecutive(steps):
        ends = (steps[0], length - steps[0] - len(steps))
        return jnp.pad(part, (ends, *[(0, 0)] * (part.ndim - 1)))
    return jnp.zeros((length, *part.shape[1:]), part.dtype).at[np.array(steps, int)].add(part)


def apply(M: Array, v: Array) -> Array:
    """Return M_k v_k, or M v_k, for all steps: M (N, a, b) or (a, b), v (N, b)."""
    return matmul(v, M.T) if M.ndim == 2 else matmul(M, v[..., None])[..., 0]


def apply_transposed(M: Array, v: Array) -> Array:
    """Return M_k'v_k, or M'v_k, for all steps."""
    return matmul(v, M) if M.ndim == 2 else matmul(v[..., None, :], M)[..., 0, :]


def stages(mpc: MPC) -> Stages:
    """Return the data of `mpc`. Works inside jit, vmap and grad."""
    system, n = mpc.system, mpc.system.n
    dtype = floating_dtype(mpc)
    cast = lambda v: jnp.asarray(v, dtype)
    found = blocks(mpc, dtype)
    box = {
        kind: isinstance(set_, Box)
        for kind, set_ in (
            ("input", mpc.inputs), ("state", mpc.states), ("terminal", mpc.terminal_set)
        )
    }  # fmt: skip
    none = [jnp.zeros(0, dtype)]
    tiled = lambda values: jnp.concatenate(none + [
        jnp.tile(v, len(b.steps)) for v, b in zip(values, found, strict=True)
    ])  # fmt: skip
    linear = quadratic = None
    if any(b.linear is not None for b in found):
        weight = lambda b, name, hard: (
            jnp.full(b.size, hard, dtype) if b.linear is None else getattr(b, name)
        )
        linear = tiled([weight(b, "linear", jnp.inf) for b in found])
        quadratic = tiled([weight(b, "quadratic", 0.0) for b in found])
    return Stages(
        A=cast(system.A), B=cast(system.B),
        c=jnp.zeros(n, dtype) if system.c is None else cast(system.c),
        Q=cast(mpc.Q), R=cast(mpc.R),
        P=jnp.zeros((n, n), dtype) if mpc.terminal_cost is None else cast(mpc.terminal_cost),
        stage=cast(np.ones(mpc.horizon) if mpc.stage_weights is None else mpc.stage_weights),
        H=tuple(b.H for b in found), D=tuple(b.D for b in found),
        lower=tiled([b.lower for b in found]), upper=tiled([b.upper for b in found]),
        linear=linear, quadratic=quadratic,
        layout=tuple((b.kind, b.steps, b.size) for b in found),
        boxes=tuple(box.get(b.kind, False) for b in found), horizon=mpc.horizon,
    )  # fmt: skip


def cleaned(s: Stages) -> tuple[Stages, Array]:
    """The data with harmless ones in their place where they are not usable, and the fault in
    them (see `qp.solve.cleaned`): NOT_RUN for none, NON_CONVEX where Q, R or P is indefinite or R
    singular."""
    ok = jnp.all(s.lower <= s.upper) & ~jnp.any(jnp.isposinf(s.lower) | jnp.isneginf(s.upper))
    for value in jax.tree.leaves((s.A, s.B, s.c, s.Q, s.R, s.P, s.stage, s.H, s.D)):
        ok = ok & jnp.all(jnp.isfinite(value))
    if s.linear is not None:
        ok = ok & jnp.all(s.linear >= 0)
        ok = ok & jnp.all((s.quadratic >= 0) & jnp.isfinite(s.quadratic))
    weights = [jnp.where(ok, (W + W.T) / 2, 0.0) for W in (s.Q, s.R, s.P)]
    definite = jnp.all(jnp.isfinite(cholesky(jax.lax.stop_gradient(weights[1]))))
    for W in weights:
        definite = definite & convex(W)
    definite = definite & jnp.all(s.stage > 0)
    fault = jnp.where(definite, Status.NOT_RUN, Status.NON_CONVEX)
    fault = jnp.where(ok, fault, Status.NON_FINITE).astype(jnp.int32)
    ok = ok & definite
    clean = lambda tree, harmless=0.0: jax.tree.map(lambda v: jnp.where(ok, v, harmless), tree)
    return replace(
        s, A=clean(s.A), B=clean(s.B), c=clean(s.c), Q=clean(s.Q), P=clean(s.P),
        stage=clean(s.stage, 1.0),
        R=clean(s.R, jnp.eye(s.R.shape[0], dtype=s.R.dtype)), H=clean(s.H), D=clean(s.D),
        lower=clean(s.lower, -jnp.inf), upper=clean(s.upper, jnp.inf),
        linear=clean(s.linear, jnp.inf), quadratic=clean(s.quadratic),
    ), fault  # fmt: skip


def riccati(s: Stages, weights: Any = None) -> Gains:
    """Gains for the cost and ½ Σ weights·row², weights (rows,) or None."""
    N, stage = s.horizon, s.stage[:, None, None]
    Q = 2 * jnp.concatenate([stage * s.Q, s.P[None]])
    R = 2 * stage * s.R
    cross = None
    for rows, steps, size, H, D, box in s.blocks() if weights is not None else ():
        w = weights[rows].reshape(len(steps), size)
        diagonal = lambda w: w[:, :, None] * jnp.eye(w.shape[1], dtype=w.dtype)
        form = lambda M, L, w=w: matmul(M.T * w[:, None, :], L)
        if H is not None:
            Q = Q + spread(diagonal(w) if box else form(H, H), steps, N + 1)
        if D is not None:
            R = R + spread(diagonal(w) if box else form(D, D), steps, N)
        if H is not None and D is not None:
            cross = (0.0 if cross is None else cross) + spread(form(D, H), steps, N)
    return riccati_recursion(Q, R, cross, s.A, s.B)


def minimise(s: Stages, gains: Gains, gx: Array, gu: Array, unroll: int = 1) -> tuple[Array, Array]:
    """x (N+1, n), u (N, m) of least penalised cost − gx·x − gu·u from x_0 = 0, without c and
    references."""
    return tracking(gains, s.A, s.B, gx, gu, unroll)


def follow(gains: Gains, x0: Array, w: Array, unroll: int = 1) -> Array:
    """x (N+1, n) of x⁺ = (A + BK) x + w from x0 (n,), w (N, n)."""

    x = recurrence(gains.closed, w, x0, unroll=unroll)
    return jnp.concatenate([x0[None], x])


def predict(s: Stages, x0: Array, u: Array) -> Array:
    """x (N+1, n) from x0 (n,) under the inputs u (N, m)."""
    w = jnp.broadcast_to(apply(s.B, u) + s.c, (s.horizon, len(x0)))
    return jnp.concatenate([x0[None], recurrence(s.A, w, x0)])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class StageFactor:
    """What data and penalties decide: row scale E (rows,), 0 for a row that no input moves; rho
    (S, rows) with the gains of each of the S penalties of a schedule; fault: NOT_RUN where the
    data are usable, else the status that says why not."""

    stages: Stages
    E: Array
    rho: Array
    gains: Gains
    fault: Array


@jax.jit
def _factor(mpc: MPC, rho: Any, scale: Any = None) -> StageFactor:
    s, fault = cleaned(stages(mpc))
    E = row_scale(s) if scale is None else jnp.asarray(scale, s.Q.dtype)
    inputs = s.horizon * s.B.shape[-1]
    rho = default_rho(E, inputs) if rho is None else jnp.asarray(rho, E.dtype)
    rho = jnp.broadcast_to(rho, (rho.shape[0] if rho.ndim == 2 else 1, E.shape[0]))
    gains = jax.lax.map(lambda rho: riccati(s, rho * E**2), rho)
    # Finite data can still overflow, or be too near singular for their precision.
    leaves = jax.tree.leaves((E, gains))
    sound = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in leaves]))
    E, gains = jax.tree.map(lambda v: jnp.where(sound, v, 0.0), (E, gains))
    return StageFactor(s, E, rho, gains, jnp.where(sound, fault, jnp.int32(Status.ITERATION_LIMIT)))


def row_scale(s: Stages) -> Array:
    """E (rows,): 1/E² is the variance of the row under exp(−J); 0 where that is zero."""
    gains = riccati(s)

    def forward(Sigma: Array, stage: tuple) -> tuple[Array, Array]:
        (closed, _, inverse), B = stage
        B = s.B if B is None else B
        spread = matmul(B, matmul(inverse, B.T))
        return matmul(closed, matmul(Sigma, closed.T)) + spread, Sigma

    start = jnp.zeros_like(s.Q)
    last, Sigma = jax.lax.scan(forward, start, (gains, *s.varying("B")))
    Sigma = jnp.concatenate([Sigma, last[None]])
    variance, own = [jnp.zeros(0, s.Q.dtype)], [jnp.zeros(0, s.Q.dtype)]
    square = lambda M, V: jnp.sum(matmul(M, V) * M, axis=-1)
    deviation = lambda V: jnp.sqrt(jnp.maximum(jnp.diagonal(V, axis1=-2, axis2=-1), 0.0))
    for _, steps, _, H, D, _ in s.blocks():
        # H x + D (K x + e), e of covariance G⁻¹.
        F: Any = 0.0 if H is None else H
        noise: Any = 0.0
        V = at(Sigma, steps)
        if D is not None:
            K, inverse = at(gains.K, steps), at(gains.inverse, steps)
            F, noise = F + matmul(D, K), square(D, inverse)
        value = square(F, V) + noise
        size = jnp.sum(jnp.abs(F) * deviation(jax.lax.stop_gradient(V))[:, None, :], axis=-1) ** 2
        variance.append(value.ravel())
        own.append((size + noise).ravel())
    squared, terms = jnp.concatenate(variance), jnp.concatenate(own)
    # A row is zero when it is rounding noise, of its own terms or beside the others.
    eps = jnp.finfo(squared.dtype).eps
    noise = jnp.maximum((100 * eps) ** 2 * terms, eps**2 * jnp.max(squared, initial=0.0))
    zero = squared <= noise
    return jnp.where(zero, 0.0, 1 / jnp.sqrt(jnp.where(zero, 1.0, squared)))


class Sample(NamedTuple):
    """Initial state and references of one solve: x0 (n,), references (N+1, n) and (N, m)."""

    x0: Array
    states: Array
    inputs: Array

    def gradient(self, s: Stages, x: Array, u: Array) -> tuple[Array, Array]:
        """Of J at x, u: (N+1, n) and (N, m)."""
        e, stage = 2 * (x - self.states), s.stage[:, None]
        gx = jnp.concatenate([stage * matmul(e[:-1], s.Q.T), matmul(e[-1:], s.P.T)])
        return gx, 2 * stage * matmul(u - self.inputs, s.R.T)


def unconstrained(s: Stages, gains: Gains, weights: Array, sample: Sample) -> tuple[Array, Array]:
    """x, u of least cost with the penalties ½ Σ weights·row²."""
    # From a trajectory that the gains keep bounded, one minimisation of what is left.
    x = follow(gains, sample.x0, jnp.broadcast_to(s.c, (s.horizon, s.c.shape[-1])))
    u = apply(gains.K, x[:-1])
    moved = jax.tree.map(jnp.add, sample.gradient(s, x, u), s.pull(weights * s.rows(x, u)))
    dx, du = minimise(s, gains, -moved[0], -moved[1])
    return x + dx, u + du


def splittings(
    factor: StageFactor, sample: Sample, unroll: int = 1
) -> tuple[list[Splitting], list[tuple[Array, Array]]]:
    """The splitting of each penalty of the schedule, and the x (N+1, n) and u (N, m) of least cost
    with that penalty on the rows alone. Bounds and E·row include what x0 and c put into the rows;
    in the condensed QP they are moved by that."""
    s, E = factor.stages, factor.E
    made, ends = [], []
    for i, rho in enumerate(factor.rho):
        gains = jax.tree.map(lambda v, i=i: v[i], factor.gains)
        free = unconstrained(s, gains, rho * E**2, sample)

        def image(r: Array, rho: Array = rho, gains: Gains = gains) -> Array:
            return E * s.rows(*minimise(s, gains, *s.pull(rho * E * r), unroll))

        made.append(Splitting(rho, image, E * s.rows(*free)))
        ends.append(free)
    return made, ends


def read(
    factor: StageFactor, bounds: Bounds, t: Array, free: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Inputs u (N, m) and multipliers y (rows,) that t stands for at the last penalty."""
    s, E, rho = factor.stages, factor.E, factor.rho[-1]
    gains = jax.tree.map(lambda v: v[-1], factor.gains)
    p = bounds.project(t, rho)
    x, u = (
        a + b for a, b in zip(free, minimise(s, gains, *s.pull(rho * E * (2 * p - t))), strict=True)
    )
    # A soft row that no input moves gets its penalty's gradient as multiplier: the gap closes.
    y = jnp.where(E == 0, s.bounds.penalty_gradient(s.rows(x, u)), E * rho * (t - p))
    return u, s.bounds.admissible(y)


class Conditions(NamedTuple):
    """Rows (rows,) and gradient (N, m) of the Lagrangian with respect to the inputs, and the
    sizes of the terms of both."""

    rows: Array
    gradient: Array
    row_size: Array
    gradient_size: Array


def conditions(s: Stages, sample: Sample, u: Array, y: Array) -> Conditions:
    """Optimality conditions of inputs u (N, m) and multipliers y (rows,), by the states that u
    leads to and the costates λ_k = ∂J/∂x_k + H'y + A'λ_{k+1}."""
    x = predict(s, sample.x0, u)
    (gx, own), (px, pushed) = sample.gradient(s, x, u), s.pull(y)

    g = gx + px
    costate = jnp.concatenate([recurrence(s.A, g[:-1], g[-1], adjoint=True)[1:], g[-1:]])
    absolute = jax.tree.map(jnp.abs, replace(s, linear=None, quadratic=None))
    return Conditions(
        s.rows(x, u), own + pushed + apply_transposed(s.B, costate),
        absolute.rows(jnp.abs(x), jnp.abs(u)),
        jnp.abs(own) + absolute.pull(jnp.abs(y))[1]
        + apply_transposed(absolute.B, jnp.abs(costate)),
    )  # fmt: skip


def stage_residuals(s: Stages, sample: Sample, u: Array, y: Array) -> Terms:
    """As `qp.residuals.residual_terms`, for the condensed QP in the inputs.

    With the gradient g of the Lagrangian the gap z'Pz + q'z + g(Az) + g*(y) is
    u'g + g(rows) + g*(y) − y'rows: at the optimum both parts are zero.
    """
    found, bounds = conditions(s, sample, u, y), s.bounds
    penalty, support, product = bounds.cost(found.rows), bounds.support(y), y * found.rows
    gap = jnp.sum(u * found.gradient) + jnp.sum(penalty + support - product)
    size = jnp.sum(jnp.abs(u) * found.gradient_size)
    size = size + jnp.sum(penalty + jnp.abs(support) + jnp.abs(product))
    return [
        (bounds.violation(found.rows), found.row_size),
        (found.gradient.ravel(), found.gradient_size.ravel()),
        (gap[None], size[None]),
    ]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Search:
    """Loop state of one instance: inputs u (N, m) and multipliers y (rows,) of the last Newton
    step, the best pair of all so far, the steps taken, and whether to go on."""

    u: Array
    y: Array
    best: Pair
    steps: Array
    open: Array


def newton_step(
    factor: StageFactor, sample: Sample, bounds: Bounds, u: Array, y: Array
) -> tuple[Array, Array]:
    """Semismooth Newton on the optimality conditions from ADMM's u (N, m) and y (rows,).

    In scaled rows v, multipliers y/E and with the residual e(v) = v − prox(v) of `projection.py`
    the conditions are gradient = 0 and e(v + y/ρ) = y/ρ. With the derivative D of e a step asks

        gradient + P du + rows'dy = 0,        dy (1 − D)/ρ = D dv + c,    c = e − y/ρ.

    Where D = 1 (a row held at its bound) 0·dy becomes dy/κ with a large κ, a proximal step on y:
    dy = ω dv + ω_c c, with ω = ρ D/(1 − D + D ρ/κ) and ω_c = ρ/(1 − D + D ρ/κ). What is left is an
    LQR problem with penalties ω. Rows are held by v + y/ρ of ADMM's own ρ, so that κ does not
    disturb the guess; it costs accuracy only within a step, since each starts from residuals of
    the data.
    """
    s, E, rho = factor.stages, factor.E, factor.rho[-1]
    found = errors(s, sample, E, rho, u, y)
    if u.dtype != jnp.float64:  # values of float64, derivatives of float32
        fixed = jax.lax.stop_gradient
        exact = precisely(errors, s, sample, E, rho, u, y)
        found = jax.tree.map(lambda p, e: p + fixed(e - p), found, exact)
    D = bounds.curvature(found[0], rho)[0]
    du, dy = newton(s, E, rho, D)(*found[1:])
    return u + du, y + dy


def search_step(most: int, constants: tuple, state: Search) -> Search:
    """One Newton step; the search ends after `most`, or below a thousandth of eps."""
    factor, sample, bounds, eps = constants
    u, y = newton_step(factor, sample, bounds, state.u, state.y)
    pair = judged(eps, factor.stages, sample, u, y)
    best, steps = state.best.or_better(pair), state.steps + 1
    return Search(u, y, best, steps, ~(best.near | best.solved) & (steps < most))


def judged(eps: Array, s: Stages, sample: Sample, u: Array, y: Array) -> Pair:
    """The pair of inputs u (N, m) and multipliers y (rows,), judged in float64."""
    y, floor = s.bounds.admissible(y), rounding(u.dtype)
    judge = lambda s, sample, u, y, eps: Pair.of(u, y, stage_residuals(s, sample, u, y), eps, floor)
    return precisely(judge, s, sample, u, y, eps)


def errors(
    s: Stages, sample: Sample, E: Array, rho: Array, u: Array, y: Array
) -> tuple[Array, Array, Array]:
    """v + y/ρ, c and the gradient, see `newton_step`."""
    found, push = conditions(s, sample, u, y), scaled_multipliers(E, y) / rho
    v = E * found.rows + push
    return v, s.bounds.scaled(E).prox_residual(v, rho) - push, found.gradient


def newton(s: Stages, E: Array, rho: Array, D: Array) -> Callable[[Array, Array], Any]:
    """(c, gradient) → (du, dy) of `newton_step`: linear."""
    loose = 1 - D + D * rho / Constants.of(E.dtype).linear
    omega = rho * D / loose
    gains = riccati(s, omega * E**2)

    def step(c: Array, gradient: Array) -> tuple[Array, Array]:
        push = rho * c / loose
        gx, gu = s.pull(E * push)
        dx, du = minimise(s, gains, -gx, -gu - gradient)
        return du, E * (omega * E * s.rows(dx, du) + push)

    return step


def stage_conditions(
    data: tuple[Stages, Sample], constants: tuple[Array, Array], u: Array, y: Array
) -> tuple[Callable[[Any], Any], Undo]:
    """The `conditions_of` that `qp.derivative.implicit` takes for (stages, sample) and (E, ρ).

    The conditions F(data, u, y) = 0 of `newton_step` hold at a solution, hence J d(u, y) = −dF with
    the matrix J of a Newton step: one Riccati recursion, whatever the number of iterations. Rows
    that touch with a zero multiplier count as inactive, as in `qp/derivative.py`.
    """
    (s, sample), (E, rho) = data, constants
    v, c, gradient = errors(s, sample, E, rho, u, y)
    step = newton(s, E, rho, s.bounds.scaled(E).curvature(v, rho)[0])

    def follow(moved: Any) -> Any:
        # The step is linear; as a derivative of itself it can be transposed, kernels or not.
        return jax.jvp(step, (c, gradient), tuple(moved))[1]

    def undo(moved: Any) -> tuple[Array, Array]:
        # What the proximal step on y leaves, of relative size ρ/κ, is taken up by a second step.
        first = follow(moved)
        of_pair = lambda u, y: errors(s, sample, E, rho, u, y)[1:]
        left = jax.jvp(of_pair, (u, y), first)[1]
        return jax.tree.map(jnp.add, first, follow(jax.tree.map(jnp.add, moved, left)))

    return lambda data: errors(data[0], data[1], E, rho, u, y)[1:], undo


def plan_stages(
    factor: StageFactor, mpc: MPC, x0: Any, reference: Any = None, solver: ADMM = DEFAULT,
    warm_start: Any = None, *, input_reference: Any = None,
) -> Plan:  # fmt: skip
    """The rest of `solve_stagewise`, for the same mpc and solver; mpc.system is not read."""
    s, dtype = factor.stages, factor.E.dtype
    N, n, m = s.horizon, s.A.shape[-1], s.B.shape[-1]
    if np.shape(x0) != (n,):
        fail("x0", f"shape {np.shape(x0)}", f"Give one state ({n},); use jax.vmap for many")
    aims = []
    for name, value, shape in (
        ("reference", reference, (N + 1, n)), ("input_reference", input_reference, (N, m))
    ):  # fmt: skip
        value = jnp.zeros(shape[1:], dtype) if value is None else value
        if np.shape(value) not in (shape[1:], shape):
            fail(name, f"shape {np.shape(value)}", f"Give {shape[1:]} or {shape}")
        aims.append(jnp.broadcast_to(jnp.asarray(value, dtype), shape))
    if warm_start is not None:
        warm_start = WarmStart.of(warm_start, s.layout, N, n, m)
    mpc = replace(mpc, prestabilise=None)
    sample = Sample(jnp.asarray(x0, dtype), *aims)
    return _plan(*arrays((factor, mpc, solver, sample, warm_start)))


@jax.jit
def _plan(factor: StageFactor, mpc: MPC, solver: ADMM, sample: Sample, warm_start: Any) -> Plan:
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in sample]))
    fault = jnp.where(finite, factor.fault, jnp.int32(Status.NON_FINITE))
    usable = fault == Status.NOT_RUN
    # Only cost and slack are read from the problem as given.
    sample, mpc = jax.tree.map(lambda v: jnp.where(usable, v, 0), (sample, mpc))
    if solver.differentiate == "implicit":
        constants = jax.lax.stop_gradient((factor, sample, solver, warm_start))
        fixed = constants[0].E, constants[0].rho[-1]
        u, y = implicit(stage_conditions, (factor.stages, sample), fixed, *solution(*constants))
    else:
        u, y = solution(factor, sample, solver, warm_start)
    s, eps = factor.stages, tolerance(solver, u.dtype)
    found = assess(stage_residuals, (s, sample), u, y, Proof.none(u, y), eps)
    found = replace(found, iterations=jnp.int32(solver.admm_steps()))
    x = predict(s, sample.x0, u)
    return answer(mpc, s.layout, found, fault, x, u, sample.states, sample.inputs)


def solution(
    factor: StageFactor, sample: Sample, solver: ADMM, warm_start: WarmStart | None
) -> tuple[Array, Array]:
    """Inputs u (N, m) and multipliers y (rows,): ADMM, then Newton steps."""
    s, E, rho = factor.stages, factor.E, factor.rho[0]
    bounds = s.bounds.scaled(E)
    u, y = jnp.zeros((s.horizon, s.B.shape[-1]), E.dtype), jnp.zeros_like(E)
    if warm_start is not None:  # what is not finite counts as 0
        clean = lambda v: jnp.nan_to_num(jnp.asarray(v, E.dtype), posinf=0.0, neginf=0.0)
        u, y = clean(warm_start.inputs), clean(warm_start.multipliers)
    rows = E * s.rows(predict(s, sample.x0, u), u)
    t = start(bounds, rho, rows, scaled_multipliers(E, y)) if warm_start is not None else rows
    schedule, free = splittings(factor, sample, min(s.horizon, UNROLL))
    t, _ = iterate(schedule, bounds, t, solver.admm_steps(), solver.alpha)
    u, y = read(factor, bounds, t, free[-1])
    refine = solver.newton_steps(MOST_STEPS)
    if refine and solver.differentiate == "unrolled":
        newton = lambda pair, _: (newton_step(factor, sample, bounds, *pair), None)
        u, y = jax.lax.scan(newton, (u, y), length=refine)[0]
        y = s.bounds.admissible(y)
    elif refine:
        eps = tolerance(solver, u.dtype)
        best = judged(eps, s, sample, u, y)
        state = Search(u, y, best, jnp.int32(0), ~(best.near | best.solved))
        constants = (factor, sample, bounds, eps)
        step = partial(search_step, refine)
        if solver.fixed:
            again = lambda state, _: (step(constants, state), None)
            state = jax.lax.scan(again, state, length=refine)[0]
        else:
            state = repeat_while(lambda state: state.open, step, constants, state)
        u, y = state.best.z, state.best.y
    return u, y
