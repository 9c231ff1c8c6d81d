"""The condensed QP of plans under affine policies and tubes.

The plan is that of the undisturbed plant: x_{k+1} = A x_k + B u_k + c from x_0, its cost that of
every other plan. What later inputs do about disturbances are more variables of the same QP, which
move rows alone.

*Affine policies*: u_k + Σ_{j<k} M_kj w_j (Goulart, Kerrigan & Maciejowski 2006, Automatica 42). A
row F θ + G v + (D + G M) w of all w = (w_0, w_1, …), with w_j = center + Γ ω_j and |ω_j| ≤ 1,
keeps its limits for all of them if and only if with T ≥ |(D + G M) Γ|, entry by entry,

    F θ + G v + (D + G M) center + Σ T ≤ upper,    F θ + G v + (D + G M) center − Σ T ≥ lower.

The QP has the variables (v, M, T); its rows are those of the upper bounds, those of the lower ones
and then −T ≤ (D + G M) Γ ≤ T. Entries that no policy moves need no T. Rows of rates hold the
differences of the M of two steps. A control horizon holds v, not M: G is then one matrix for v and
another for M. Soft rows may be violated on each side, by the worst w.

*Tubes* (Mayne, Seron & Raković 2005, Automatica 41): u = v + K (x − z) with a nominal trajectory z
that begins anywhere in x_0 − S, S = center + {G ζ : |ζ_i| ≤ 1} a robust invariant set under K. The
rows of (z, v) are tightened by S. Without disturbances x_k = z_k + A_K^k (x_0 − z_0), so that the
rows of the plan lose what x_0 − z_0 does to them under u = K x: linear in ζ. The variables of the
QP are those of the plan and ζ, its rows those of the plan and |ζ_i| ≤ 1. Of the rates the first,
u_0 − u_{−1}, is known and not tightened; the others lose what K (e_k − e_{k−1}) can be, with
e_k = A_K e_{k−1} + E w, e_{k−1} in S and w in W.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.linalg import solve_triangular
from jax.typing import DTypeLike

from jaxmpc.checks import concrete, fail, require_memory
from jaxmpc.mpc.condense import Condensed, condense
from jaxmpc.mpc.problem import MPC, dynamics_of
from jaxmpc.mpc.rows import Block, given_blocks, row_count, row_values
from jaxmpc.mpc.tightening import feedback_gain, require_room, without_disturbance
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.admm import ADMM, SPLIT, Factor, factorise
from jaxmpc.qp.jax_transformations import compiled_lightly, own_modes
from jaxmpc.qp.linalg import arrays, inverse_root, matmul, namespace
from jaxmpc.qp.problem import QP
from jaxmpc.sets.convex_sets import Box, Zonotope
from jaxmpc.sets.disturbances import with_vertices, worst
from jaxmpc.sets.minimal_invariant import minimal_robust_invariant_set
from jaxmpc.systems.riccati import require_stable
from jaxmpc.systems.system import host_matrices

# What stands for no bound of a variable, and for an inverse that there is not.
HUGE = 1e30
# Numbers that the solver holds for each of (rows + variables)², about.
MATRICES = 4
# Generators of a tube's cross-section from which on maps and polytopes take minutes.
MANY_GENERATORS = 300


@pytree
class PolicyCondensed(Condensed):
    """The condensed QP with the variables of a policy behind those of the plan.

    `layout` is that of the plan's rows; these stand `copies` times at the beginning of C.
    response_to_disturbances: (N, m, N p), what inputs do about disturbances before any M, and
    of_answers: (N, m, N m), what they do about M; None for tubes. extent: (nz,) and (nz, p), by
    which and by how much for each |θ_i| the entries of a feasible z are bounded; None where inputs
    have no Box. curvature (nz,): what stands for P's diagonal in the solver's metric where
    variables cost nothing, from how far the limits are (`scales_of_rows`); 0 of the others.
    """

    response_to_disturbances: Any
    of_answers: Any
    extent: Any
    curvature: Array
    copies: int = static()

    def factor(self, solver: ADMM) -> Factor:
        """Return what the matrices of the QP decide, in a metric that knows its limits too."""
        return factorise(self.P, self.C, solver, self.balls, self.curvature)

    def qp(
        self,
        theta: Array,
        reference: Array | None = None,
        input_reference: Array | None = None,
        shift: Array | None = None,
    ) -> QP:
        """QP at θ (p,), as `Condensed.qp` has it, with its extent, unless rows are shifted."""
        found = Condensed.qp(self, theta, reference, input_reference, shift)
        if self.extent is None or shift is not None:
            return found
        constant, slope = self.extent
        return replace(found, extent=constant + matmul(slope, jnp.abs(theta)))

    def reach(self, reach: Array) -> Array:
        """Return how far rows move along a unit of length (rows,), as it is."""
        return reach

    def of_plan(self, y: Array) -> Array:
        """Return the multipliers of the plan's rows from those of all rows: of two sides the
        sum."""
        count = row_count(self.layout)
        return jnp.sum(y[: self.copies * count].reshape(self.copies, count), axis=0)

    def beyond(self, qp: QP, z: Array) -> Array:
        """Return by how much a solution may violate each of the plan's rows (copies, rows): under
        affine policies its upper and its lower bound, of a tube either."""
        value = matmul(qp.A, z)
        over = jnp.maximum(jnp.maximum(value - qp.u, qp.l - value), 0.0)
        count = row_count(self.layout)
        return over[: self.copies * count].reshape(self.copies, count)

    def of_all(self, shift: Array) -> Array:
        """Return what is added to all rows where `shift` is added to the plan's."""
        along = jnp.tile(shift, self.copies)
        return jnp.pad(along, (0, len(self.C) - len(along)))

    def feedback(self, z: Array) -> Array | None:
        """Return M (N, m, N, p) of a solution z, None for tubes."""
        base = self.response_to_disturbances
        if base is None:
            return None
        N, m, Np = base.shape
        entries, first = np.argwhere(causal_entries(N, m, Np // N)), len(self.begins) * m
        M = jnp.zeros((N * m, Np), z.dtype)
        M = M.at[tuple(entries.T)].set(z[first : first + len(entries)])
        found = base + matmul(self.of_answers, M)
        return found.reshape(N, m, N, Np // N)


def condensed_plan(mpc: MPC) -> Condensed:
    """Return the parametric QP of plans of `mpc`, whatever its policy. Raises ValueError where it
    does not fit into memory, and for what plans of the policy are not computed with."""
    if mpc.disturbance is None or mpc.policy == "tightened":
        return condense(mpc)
    require_free_inputs(mpc)
    found = given_blocks(mpc, float)
    plain = without_disturbance(mpc)
    if mpc.policy == "affine":
        require_generators(mpc.disturbance)
        require_memory("horizon", affine_bytes(mpc, found), "Use jm.mpc.solve_stagewise")
        nominal = each = condense(plain)
        if mpc.control_horizon is not None:
            each = condense(replace(plain, control_horizon=None, prestabilise=False))
        return _affine(*arrays((nominal, each, mpc)))
    section, gain = tube_section(mpc), np.asarray(feedback_gain(mpc), float)
    mpc = replace(mpc, disturbance=with_vertices(mpc.disturbance))
    sides = tightened_by(mpc, section, found, gain)
    placed = [
        replace(b, lower=low, upper=high) for b, (low, high) in zip(found, sides, strict=True)
    ]
    require_room(mpc, placed)
    return _tube(*arrays((condense(plain), mpc, gain, section)))


def require_free_inputs(mpc: MPC) -> None:
    """Raise ValueError for a control horizon of a tube, whose inputs are those of a nominal plan
    and of a feedback, which none holds."""
    if mpc.policy == "tube" and mpc.control_horizon is not None:
        what = "given with policy 'tube', whose plans are the inputs under the feedback too"
        fail("control_horizon", what, 'Leave it out, or give policy="tightened" or "affine"')


def require_generators(W: Any) -> None:
    """Raise ValueError unless a set has generators, as affine policies and the rows that limit the
    rates of tubes need."""
    if not isinstance(W, Box | Zonotope):
        what = f"is a {type(W).__name__}, which has no generators, as this policy needs them"
        fail("disturbance", what, 'Give a Box or a Zonotope, or policy="tightened"')


def tube_section(mpc: MPC) -> Zonotope:
    """Return the cross-section S of a tube. Raises ValueError where dynamics, gain or disturbances
    are traced, and as `minimal_robust_invariant_set`."""
    plant = replace(mpc.system, c=None)
    if not concrete(plant, mpc.disturbance, mpc.disturbance_matrix, mpc.gain):
        cure = "Give gain=K (None is the LQR of Q and R), or a Controller made outside of the trace"
        fail("policy", "'tube' beside traced dynamics, gain or disturbances", cure)
    gain = np.asarray(feedback_gain(mpc), float)
    A, B, _ = host_matrices(plant)
    require_stable("gain", A + B @ gain)
    found = minimal_robust_invariant_set(
        plant, gain, mpc.disturbance, disturbance_matrix=mpc.disturbance_matrix
    )
    section = found.to_zonotope()
    count = np.asarray(section.generators).shape[1]
    if count > MANY_GENERATORS:
        what = f"'tube' with a cross-section of {count:,} generators, each of them a variable"
        cure = 'A gain that damps faster has fewer, policy="tightened" none'
        text = f"policy: {what}: plans take seconds, maps and polytopes minutes. {cure}"
        warnings.warn(text, stacklevel=2)
    return section


def causal_entries(N: int, m: int, p: int) -> np.ndarray:
    """Return which entries (N m, N p) of M answer to earlier disturbances."""
    return np.kron(np.tril(np.ones((N, N)), -1), np.ones((m, p))) > 0


def affine_bytes(mpc: MPC, found: Sequence[Block]) -> float:
    """Return about how many bytes the QP of affine policies takes in float64."""
    N, m, p = mpc.horizon, mpc.system.m, mpc.disturbances
    step, moved = _row_steps(found)
    W: Any = mpc.disturbance
    generators = p if isinstance(W, Box) else np.shape(W.generators)[1]
    T = int(np.sum(np.maximum(step - ~moved, 0))) * generators
    variables = N * m + np.count_nonzero(causal_entries(N, m, p)) + T
    return 8.0 * MATRICES * (2 * len(step) + 2 * T + variables) ** 2


def _row_steps(found: Sequence[Block]) -> tuple[np.ndarray, np.ndarray]:
    """Return the step k of each row, and whether the input of that step moves it (rows,)."""
    step = np.concatenate([np.zeros(0, int), *(np.repeat(b.steps, b.size) for b in found)])
    moved = [np.full(len(b.steps) * b.size, b.D is not None) for b in found]
    return step.astype(int), np.concatenate([np.zeros(0, bool), *moved])


def generator_form(mpc: MPC, dtype: DTypeLike) -> tuple[Array, Array, Array]:
    """Return center (p,) and Γ (p, g) of w = center + Γ ω, |ω_i| ≤ 1, and E (n, p), by which w
    enters the states."""
    W: Any = mpc.disturbance
    E = jnp.eye(mpc.system.n, dtype=dtype)
    if mpc.disturbance_matrix is not None:
        E = jnp.asarray(mpc.disturbance_matrix, dtype)
    if isinstance(W, Box):
        lower, upper = (jnp.asarray(v, dtype) for v in (W.lower, W.upper))
        return (lower + upper) / 2, jnp.diag((upper - lower) / 2), E
    return jnp.asarray(W.center, dtype), jnp.asarray(W.generators, dtype), E


def _plan_extent(nominal: Condensed, reach: Array) -> tuple[Array, tuple[Array, Array]]:
    """Return |Ω⁻¹| (N m, N m), and bounds, of 1 and of each |θ_i|, of the variables of plans whose
    inputs are within `reach` (N, m) of zero: u = Ψ θ + Ω z + ψ."""
    size = nominal.Omega.shape[-1]
    Omega, one = nominal.Omega.reshape(size, size), jnp.eye(size, dtype=reach.dtype)
    back = jnp.abs(solve_triangular(Omega, one, lower=True, unit_diagonal=True))
    constant = matmul(back, (reach + jnp.abs(nominal.psi)).ravel())
    return back, (constant, matmul(back, jnp.abs(nominal.Psi).reshape(size, -1)))


def scales_of_rows(P: Array, C: Array, below: Array, above: Array) -> tuple[Array, Array]:
    """Return the width of each row (rows,) and its typical multiplier (rows,), where it has limits
    at these distances below and above the value at z = 0; ∞ and 0 of rows without.

    P and A alone say nothing of how large variables without a cost are, nor of the force on them,
    and a metric for them takes a force over a size. The size is known here. The force follows from
    the multipliers: with W the distance between the limits, or twice that of the only one, a plan
    that moves row c by W costs W² / c'P⁻¹c, and J, the least of these, is what a plan costs that
    limits bend. The multiplier of a row is then J/W. Units of variables, rows and cost play no
    part.
    """
    size = jnp.diag(P)
    unit = 1 / jnp.sqrt(jnp.where(size > 0, size, 1.0))
    scaled = unit[:, None] * P * unit + SPLIT * jnp.eye(len(P), dtype=P.dtype)
    moved = jnp.sum(matmul(C * unit, inverse_root(scaled).T) ** 2, axis=1)
    width = jnp.where(
        jnp.isfinite(below + above), below + above, 2 * jnp.minimum(jnp.abs(below), jnp.abs(above))
    )
    width = jnp.where(width > 0, width, jnp.inf)
    cost = jnp.where(moved > 0, width**2 / jnp.where(moved > 0, moved, 1.0), jnp.inf)
    least = jnp.min(cost, initial=jnp.inf)
    return width, jnp.where(jnp.isfinite(least), least, 0.0) / width


def _input_sizes(mpc: MPC, dtype: DTypeLike) -> tuple[Array, Array] | None:
    """Return the largest |u_i| (m,) and half the width of the limits of inputs; None without a
    Box."""
    if not isinstance(mpc.inputs, Box):
        return None
    lower, upper = (jnp.asarray(v, dtype) for v in (mpc.inputs.lower, mpc.inputs.upper))
    large = lambda v: jnp.minimum(v, HUGE)  # no limit: a product with 0 stays 0
    return large(jnp.maximum(jnp.abs(lower), jnp.abs(upper))), large((upper - lower) / 2)


@compiled_lightly(0)
@own_modes
def _affine(nominal: Condensed, each: Condensed, mpc: MPC) -> PolicyCondensed:
    dtype, N, n, m = nominal.P.dtype, mpc.horizon, mpc.system.n, mpc.system.m
    center, Gamma, E = generator_form(mpc, dtype)
    p, g = Gamma.shape
    found = given_blocks(mpc, dtype)
    # Row (j, q): what w_j = e_q alone adds.
    pushes = jnp.einsum("jk,nq->jqkn", jnp.eye(N, dtype=dtype), E).reshape(N * p, N, n)
    x, u = jax.vmap(lambda e: nominal.response(mpc.system, e))(pushes)
    D = jax.vmap(lambda x, u: row_values(found, x, u, u[0]))(x, u).T.reshape(-1, N, p)
    G = nominal.C

    step, moved = _row_steps(found)
    last = step - ~moved  # the first j whose w_j no earlier input of the row answers to
    j = np.arange(N)
    row, at, generator = np.nonzero(
        np.broadcast_to((j < last[:, None])[..., None], (*D.shape[:2], g))
    )
    places = np.argwhere(causal_entries(N, m, p))
    inputs, disturbed, coordinate = places[:, 0], places[:, 1] // p, places[:, 1] % p

    reach = matmul(D, Gamma)
    fixed = (j == last[:, None]) & ~moved[:, None]
    constant = jnp.sum(jnp.where(fixed[..., None], jnp.abs(reach), 0.0), axis=(1, 2))
    middle = jnp.sum(matmul(D, center), axis=1)
    of_M = each.C[:, inputs]
    answers = of_M[row] * Gamma[coordinate][:, generator].T * (at[:, None] == disturbed)
    sums = jnp.asarray(row == np.arange(len(step))[:, None], dtype)
    one = jnp.eye(len(row), dtype=dtype)
    none = jnp.zeros((len(row), G.shape[1]), dtype)
    value = jnp.concatenate([G, of_M * center[coordinate]], axis=1)
    answers = jnp.concatenate([none, answers], axis=1)
    free, zero = jnp.full(len(step), jnp.inf, dtype), jnp.zeros(len(row), dtype)
    d = nominal.d + middle
    response = u.reshape(N * p, N, m).transpose(1, 2, 0)
    extent, sizes = None, _input_sizes(mpc, dtype)
    if sizes is not None and p == g:
        # Σ_j |U_kj Γ| is at most half the width: of U_kj in units of w, then of M.
        in_w = jnp.minimum(jnp.max(jnp.abs(_inverse(Gamma)), axis=0), HUGE)
        most = jnp.tile(sizes[1], N)[:, None] * jnp.tile(in_w, N)
        back, ends = _plan_extent(
            each, sizes[0] + matmul(most, jnp.abs(jnp.tile(center, N))).reshape(N, m)
        )
        moves = (np.array(nominal.begins)[:, None] * m + np.arange(m)).ravel()
        plan, of_theta = (v[moves] for v in ends)
        M = matmul(back, most + jnp.abs(response.reshape(N * m, N * p)))[tuple(places.T)]
        plan = jnp.append(plan, M)
        of_theta = jnp.pad(of_theta, ((0, len(M)), (0, 0)))
        # ΣT is at most what the row's value leaves to its bound.
        above, below = jnp.abs(nominal.upper - d - constant), jnp.abs(nominal.lower - d + constant)
        room = jnp.minimum(above, below) + matmul(jnp.abs(value), plan)
        room_of_theta = jnp.abs(nominal.D) + matmul(jnp.abs(value), of_theta)
        T, T_of_theta = room[row], room_of_theta[row]
        if nominal.soft_linear is not None:
            # A soft row leaves any room, but no T need be larger than what it bounds.
            soft = jnp.isfinite(nominal.soft_linear)[row]
            least = jnp.abs(reach[row, at, generator]) + matmul(jnp.abs(answers), plan)
            T, T_of_theta = jnp.where(soft, least, T), jnp.where(soft[:, None], 0.0, T_of_theta)
        extent = jnp.append(plan, T), jnp.concatenate([of_theta, T_of_theta])
        extent = jax.lax.stop_gradient(jax.tree.map(lambda v: jnp.minimum(v, HUGE), extent))
    # T and M are as large as what moves a row by its width. The two rows of an entry of T share the
    # multiplier of that for whose sum it is.
    width, multiplier = scales_of_rows(nominal.P, G, d - nominal.lower, nominal.upper - d)
    of_M_alone = jnp.abs(answers[:, G.shape[1] :])
    curvature = jnp.concatenate([
        jnp.zeros(G.shape[1], dtype),
        jnp.sqrt(2 * jnp.sum((of_M_alone * multiplier[row][:, None]) ** 2, axis=0))
        * jnp.max(of_M_alone / width[row][:, None], axis=0, initial=0.0),
        jnp.sqrt(2.0) * multiplier[row] / width[row],
    ])  # fmt: skip
    return _widened(
        nominal,
        C=jnp.block([[value, sums], [value, -sums], [answers, -one], [answers, one]]),
        d=jnp.concatenate([d + constant, d - constant, *2 * [reach[row, at, generator]]]),
        lower=jnp.concatenate([-free, nominal.lower, zero - jnp.inf, zero]),
        upper=jnp.concatenate([nominal.upper, free, zero, zero + jnp.inf]),
        response=response,
        of_answers=each.Omega,
        extent=extent,
        curvature=curvature,
        copies=2,
    )


def _inverse(Gamma: Array) -> Array:
    """Return the inverse of a square matrix, of a diagonal one entry by entry; `HUGE` where there
    is none."""
    entries = jnp.diag(Gamma)
    usual = jnp.where(entries != 0, 1 / jnp.where(entries != 0, entries, 1.0), 0.0)
    diagonal = jnp.all(Gamma == jnp.diag(entries))
    other = jnp.nan_to_num(jnp.linalg.inv(Gamma), nan=HUGE, posinf=HUGE, neginf=-HUGE)
    return jnp.where(diagonal, jnp.diag(usual), other)


def tightened_by(
    mpc: MPC, section: Zonotope, found: Sequence[Block], gain: Any
) -> list[tuple[Any, Any]]:
    """Return the bounds (steps, r) of each block that are left to the nominal trajectory of a
    tube."""
    sides = []
    xp = namespace((mpc, section, gain, [(b.H, b.D) for b in found]))
    for b in found:
        along: Any = 0.0 if b.H is None else b.H
        along = along if b.D is None else along + matmul(b.D, gain)
        low: Any = 0.0
        high: Any = 0.0
        if b.rate:
            A, B, _ = dynamics_of(mpc.system, along.dtype)
            push: Any = along
            if mpc.disturbance_matrix is not None:
                push = matmul(along, xp.asarray(mpc.disturbance_matrix, along.dtype))
            low, high = worst(mpc.disturbance, -push), worst(mpc.disturbance, push)
            along = matmul(along, A + matmul(B, gain)) - along
        middle = matmul(along, xp.asarray(section.center, along.dtype))
        half = xp.sum(xp.abs(matmul(along, xp.asarray(section.generators, along.dtype))), axis=1)
        # The first rate is that of the input that is applied.
        later = np.array([not (b.rate and k == 0) for k in b.steps], float)[:, None]
        low, high = later * (low + half - middle), later * (high + half + middle)
        sides.append((b.lower + low, b.upper - high))
    return sides


@compiled_lightly(0)
@own_modes
def _tube(nominal: Condensed, mpc: MPC, gain: Array, section: Zonotope) -> PolicyCondensed:
    dtype = nominal.P.dtype
    A, B, _ = dynamics_of(mpc.system, dtype)
    K = jnp.asarray(gain, dtype)
    found, closed = given_blocks(mpc, dtype), A + matmul(B, K)

    def responses(e: Array) -> Array:
        return jax.lax.scan(lambda e, _: (matmul(closed, e), e), e, length=mpc.horizon + 1)[1]

    def along(e: Array) -> Array:
        x = responses(e)
        u = matmul(x[:-1], K.T)
        return row_values(found, x, u, u[0])

    center, generators = (jnp.asarray(v, dtype) for v in (section.center, section.generators))
    moves = jax.vmap(along)(generators.T).T
    bounds = [(low.ravel(), high.ravel()) for low, high in tightened_by(mpc, section, found, K)]
    lower, upper = (jnp.concatenate([*(pair[k] for pair in bounds), center[:0]]) for k in (0, 1))
    count = generators.shape[1]
    one, zero = jnp.eye(count, dtype=dtype), jnp.zeros((count, nominal.C.shape[1]), dtype)
    extent, sizes = None, _input_sizes(mpc, dtype)
    if sizes is not None:
        ends = jnp.concatenate([generators.T, center[None]])
        inputs = jax.vmap(lambda e: matmul(responses(e)[:-1], K.T))(ends)
        _, (plan, of_theta) = _plan_extent(nominal, sizes[0] + jnp.sum(jnp.abs(inputs), axis=0))
        extent = jnp.append(plan, jnp.ones(count, dtype)), jnp.pad(of_theta, ((0, count), (0, 0)))
        extent = jax.lax.stop_gradient(extent)
    d = nominal.d - along(center)
    _, multiplier = scales_of_rows(nominal.P, nominal.C, d - lower, upper - d)
    force = jnp.sqrt(jnp.sum((moves * multiplier[:, None]) ** 2, axis=0))  # ζ is of size 1
    return _widened(
        nominal,
        C=jnp.block([[nominal.C, -moves], [zero, one]]),
        d=jnp.concatenate([d, jnp.zeros(count, dtype)]),
        lower=jnp.concatenate([lower, -jnp.ones(count, dtype)]),
        upper=jnp.concatenate([upper, jnp.ones(count, dtype)]),
        response=None,
        of_answers=None,
        extent=extent,
        curvature=jnp.pad(force, (nominal.C.shape[1], 0)),
        copies=1,
    )


def _widened(
    nominal: Condensed,
    C: Array,
    d: Array,
    lower: Array,
    upper: Array,
    response: Any,
    of_answers: Any,
    extent: Any,
    curvature: Array,
    copies: int,
) -> PolicyCondensed:
    """Return the QP with these rows and as many variables, of which the first are the plan's."""
    more = C.shape[1] - nominal.C.shape[1]
    wider = lambda v: jnp.pad(v, [*[(0, 0)] * (v.ndim - 1), (0, more)])
    D = jnp.tile(nominal.D, (copies, 1))
    made = replace(
        nominal,
        Gamma=wider(nominal.Gamma),
        Omega=wider(nominal.Omega),
        P=jnp.pad(nominal.P, (0, more)),
        F=jnp.pad(nominal.F, [(0, more), (0, 0)]),
        f=wider(nominal.f),
        C=C,
        D=jnp.pad(D, [(0, len(C) - len(D)), (0, 0)]),
        d=d,
        lower=lower,
        upper=upper,
    )
    if nominal.soft_linear is not None:
        longer = lambda v, rest: jnp.pad(
            jnp.tile(v, copies), (0, len(C) - len(D)), constant_values=rest
        )
        made = replace(
            made,
            soft_linear=longer(nominal.soft_linear, jnp.inf),
            soft_quadratic=longer(nominal.soft_quadratic, 0.0),
        )
    return PolicyCondensed(
        **vars(made),
        response_to_disturbances=response,
        of_answers=of_answers,
        extent=extent,
        curvature=jax.lax.stop_gradient(curvature),
        copies=copies,
    )
