"""The ladder that labels points: short ADMM on all, least-distance Newton on what is left.

For the question "feasible or not" the cost is dropped. In an orthonormal basis U of the range
of the (row-normalised) constraint matrix a zero-cost ADMM step is t⁺ = t + α(U U'r − clip(t)):
the alternating projection of Douglas and Rachford between {U w} and the box of the bounds.
Iterates may be float32. Nothing here decides a label: every candidate, a w or a multiplier,
goes to `proofs.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import linprog

from jaxmpc.mpc.condense import condense, in_float64
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.projection import Bounds
from jaxmpc.qp.refine import least_distance
from jaxmpc.sweeps import proofs
from jaxmpc.sweeps.compiled import Compiled
from jaxmpc.sweeps.proofs import Problem, View

ALPHA = 1.6
HIGHS = {"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10}
INSET = 1e-10


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """Rows of the condensed constraints: lower ≤ (U w)_i + D_i θ ≤ upper, i = 1..R.

    U (R, k) is an orthonormal basis of what the decision variables (inputs, prestabilised or
    not, and in a projection the free states) can do to the normalised rows; back (nz, k) leads
    from w to the variables. A row that nothing moves (k = 0; Euler's q₁ does not feel u₀) has
    U = 0: a half-space on θ alone. weight (R,) brings multipliers to the units of the problem's
    rows, and index says where the multiplier of each state and terminal row of the problem
    stands among the R (R where there is none). Psi, Omega, psi: inputs from θ and the variables.
    """

    U: Any
    back: Any
    D: Any
    lower: Any
    upper: Any
    weight: Any
    index: Any
    Psi: Any
    Omega: Any
    psi: Any


def rows(mpc: MPC, view: View) -> Rows:
    """Condense, restrict to the view and normalise; all on the host in float64."""
    with jax.enable_x64(True):
        c = jax.tree.map(np.asarray, condense(in_float64(mpc)))
    axes, others = list(view.axes), list(view.others)
    C, D, lower, upper = c.C, c.D[:, axes], c.lower - c.d, c.upper - c.d
    Psi, Omega, psi = c.Psi[:, :, axes], c.Omega, c.psi
    if view.projects:
        extra = len(others)
        C = np.block([[C, c.D[:, others]], [np.zeros((extra, C.shape[1])), np.eye(extra)]])
        D = np.concatenate([D, np.zeros((extra, len(axes)))])
        lower, upper = np.append(lower, view.lower), np.append(upper, view.upper)
        Omega = np.concatenate([Omega, c.Psi[:, :, others]], axis=2)
    elif others:
        rest = np.asarray(view.fixed)[others]
        lower, upper = lower - c.D[:, others] @ rest, upper - c.D[:, others] @ rest
        psi = psi + c.Psi[:, :, others] @ rest

    norm = np.linalg.norm(C, axis=1)
    still = norm <= 1e-13 * norm.max(initial=0.0)
    C = np.where(still[:, None], 0.0, C)
    keep = np.flatnonzero(np.isfinite(lower) | np.isfinite(upper))
    size = np.where(still, np.linalg.norm(D, axis=1), norm)[keep]
    weight = 1 / np.where(size > 0, size, 1.0)
    U, singular, Vt = np.linalg.svd(weight[:, None] * C[keep], full_matrices=False)
    rank = int(np.sum(singular > 1e-12 * singular.max(initial=0.0)))
    U, back = U[:, :rank], Vt[:rank].T / singular[:rank]

    n_inputs = 0 if mpc.inputs is None else mpc.horizon * mpc.system.m
    n_rows = len(c.lower) - n_inputs
    index = np.full(n_rows, len(keep))
    ours = (keep >= n_inputs) & (keep < len(c.lower))
    index[keep[ours] - n_inputs] = np.flatnonzero(ours)
    return Rows(
        U, back, weight[:, None] * D[keep], weight * lower[keep], weight * upper[keep], weight,
        index, Psi, Omega, psi,
    )  # fmt: skip


def support(
    rows: Rows, direction: np.ndarray, center: np.ndarray | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Without a centre max direction'θ over the set; with one max t ≥ 0 on center + t·direction.

    Returns the optimum (inf: unbounded, −inf: empty), w, and the multipliers of the rows (HiGHS).
    """
    R, k = rows.U.shape
    bounds: list[Any]
    low, high = np.isfinite(rows.lower), np.isfinite(rows.upper)
    if center is None:
        A, shift = np.hstack([rows.U, rows.D]), np.zeros(R)
        cost, bounds = np.append(np.zeros(k), direction), [(None, None)] * A.shape[1]
    else:
        A, shift = np.hstack([rows.U, (rows.D @ direction)[:, None]]), rows.D @ center
        cost, bounds = np.append(np.zeros(k), 1.0), [(None, None)] * k + [(0, None)]
    result = linprog(
        -cost, A_ub=np.vstack([A[high], -A[low]]),
        b_ub=np.concatenate([(rows.upper - shift)[high], (shift - rows.lower)[low]]),
        bounds=bounds, options=HIGHS,
    )  # fmt: skip
    y = np.zeros(R)
    if result.x is None:
        return -np.inf if result.status == 2 else np.inf, np.zeros(k), y
    push = -result.ineqlin.marginals
    y[high] += push[: high.sum()]
    y[low] -= push[high.sum() :]
    return float(-result.fun), result.x[:k], y


def bounding_box(rows: Rows, otherwise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Extent (d,), |θ| ≤ extent on the feasible set, and the multipliers (2d, R) of its sides.

    The extent is twice the LPs' answer, which outweighs their tolerances; where they find the
    set empty, `otherwise`: the region that is looked at.
    """
    d = rows.D.shape[1]
    ends, _, y = zip(*(support(rows, s * e) for s in (1.0, -1.0) for e in np.eye(d)), strict=True)
    reach = np.abs(ends).reshape(2, d).max(axis=0)
    return otherwise if -np.inf in ends else 2 * reach + 1e-300, np.array(y)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Verdict:
    """What was proved of one point: label 1, −1 or 0, and x_0 with inputs, or the cut."""

    label: Array
    start: Array
    inputs: Array
    normal: Array
    offset: Array


def inputs_of(p: Problem, rows: Rows, theta: Array, w: Array) -> tuple[Array, Array]:
    """Inputs (N, m) and free states that the coordinates w stand for."""
    variables = matmul(jnp.asarray(rows.back), w)
    inputs = matmul(jnp.asarray(rows.Psi), theta) + matmul(jnp.asarray(rows.Omega), variables)
    return inputs + rows.psi, variables[p.horizon * p.B.shape[1] :]


def cut_of(p: Problem, rows: Rows, y: Array) -> tuple[Array, Array, Array]:
    """The half-space (a, b, rounding) that multipliers y (R,) of the rows give."""
    y = jnp.append(y * rows.weight, 0.0)[jnp.asarray(rows.index)]
    steps, r = p.horizon - p.first_step, p.H.shape[0]
    return proofs.cut(p, y[: steps * r].reshape(steps, r), y[steps * r :])


def judge(p: Problem, rows: Rows, theta: Array, w: Array, candidates: list[Array]) -> Verdict:
    """Try to prove the point θ feasible by w, and infeasible by each candidate multiplier."""
    theta, w = theta.astype(jnp.float64), w.astype(jnp.float64)
    inputs, free = inputs_of(p, rows, theta, w)
    feasible, inputs = proofs.prove_feasible(p, theta, free, inputs)
    normal, offset = jnp.zeros_like(theta), jnp.asarray(jnp.inf, jnp.float64)
    infeasible = jnp.asarray(False)
    for y in candidates:
        a, b, rounding = cut_of(p, rows, y.astype(jnp.float64))
        here = proofs.excludes(p, a, b, rounding, theta) & ~infeasible
        normal, offset = jnp.where(here, a, normal), jnp.where(here, b, offset)
        infeasible = infeasible | here
    label = jnp.where(feasible, 1, jnp.where(infeasible, -1, 0)).astype(jnp.int8)
    return Verdict(label, p.view.initial_state(theta, free), inputs, normal, offset)


@functools.cache
def admm_rung(iterations: int, dtype: Any) -> Compiled:
    """The compiled first rung: (p, rows, points (B, d)) → verdicts and w (B, k)."""

    @jax.jit
    def rung(p: Problem, rows: Rows, points: Array) -> tuple[Verdict, Array]:
        U = jnp.asarray(rows.U, dtype)
        shift = matmul(jnp.asarray(rows.D), points.T)  # (R, B): columns are points
        l = (jnp.asarray(rows.lower)[:, None] - shift).astype(dtype)
        u = (jnp.asarray(rows.upper)[:, None] - shift).astype(dtype)

        def step(t, _=None):
            s = jnp.clip(t, l, u)
            return t + ALPHA * (matmul(U, matmul(U.T, 2 * s - t)) - s), None

        before, _ = jax.lax.scan(step, jnp.clip(jnp.zeros_like(l), l, u), length=iterations - 1)
        t, _ = step(before)
        excess = lambda t: t - jnp.clip(t, l, u)
        w = matmul(U.T, jnp.clip(t, l, u) - excess(t))
        change = excess(t) - excess(before)
        verdict = jax.vmap(lambda *a: judge(p, rows, a[0], a[1], [a[2], a[3]]))(
            points, w.T, change.T, excess(t).T
        )
        return verdict, w.T

    return Compiled(rung)


@functools.cache
def newton_rung(steps: int) -> Compiled:
    """The compiled second rung: (p, rows, points (B, d), w (B, k)) → verdicts and w."""

    @jax.jit
    def rung(p: Problem, rows: Rows, points: Array, w: Array) -> tuple[Verdict, Array]:
        U = jnp.asarray(rows.U)

        def one(theta: Array, w: Array) -> tuple[Verdict, Array]:
            shift = matmul(jnp.asarray(rows.D), theta)
            l, u = rows.lower - shift, rows.upper - shift
            # The nearest feasible w lies on a face, where a roll-out has no margin for its
            # rounding: aim a little inside. Cuts are judged on the true bounds all the same.
            inset = jnp.minimum(INSET * (1 + jnp.fmin(jnp.abs(l), jnp.abs(u))), (u - l) / 4)
            inner = Bounds(l + inset, u - inset)
            w, e = least_distance(U, inner, w.astype(jnp.float64), steps)
            return judge(p, rows, theta, w, [e]), w

        return jax.vmap(one)(points, w)

    return Compiled(rung)
