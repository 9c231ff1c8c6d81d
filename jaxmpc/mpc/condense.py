"""From an MPC problem to a small dense QP: the states are eliminated ("condensing").

With u_k = K x_k + v_k (K = 0 unless prestabilised) and z = (v_0, …, v_{N−1}) all predictions
are affine in z and in the parameter θ = x_0, or θ = (x_0, u_{−1}) where input rates matter:

    x_k = Φ_k θ + Γ_k z + φ_k,        u_k = K x_k + v_k = Ψ_k θ + Ω_k z + ψ_k.

Γ, Φ and φ side by side follow from step to step by one recursion, X⁺ = (A + BK) X + [B E_k, 0, c],
with E_k the columns of the input of step k; A, B, c and K may differ from step to step.
With a control horizon z holds the free moves only. Every constraint is then a row
lower ≤ C z + D θ + d ≤ upper, in the order of `rows.blocks`; the cost is
½ z'Pz + (F θ + f(references))'z + const. P, F, C, D depend on nothing that changes from one time
step to the next.
Rows at k = 0 have C = 0 unless they bound inputs.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.checks import concrete, is_definite, require_memory, require_untraced
from jaxmpc.mpc.problem import MPC, Switch, Weights, dynamics_of, weights_of
from jaxmpc.mpc.rows import Layout, blocks, bounds_of, layout_of, split, stacked
from jaxmpc.mpc.stagewise.recursion_kernels import riccati_recursion
from jaxmpc.mpc.tightening import require_room, require_tightened, with_gain
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.admm import ADMM, Factor, factorise
from jaxmpc.qp.jax_transformations import (
    compiled_lightly,
    differentiated_apart,
    own_modes,
    varying,
)
from jaxmpc.qp.linalg import (
    apply,
    arrays,
    by_step,
    float64_arrays,
    floating_dtype,
    host_arrays,
    matmul,
    namespace,
    on_device,
    solve,
)
from jaxmpc.qp.problem import QP, Bounds
from jaxmpc.sets.geometry import row_lengths
from jaxmpc.systems.riccati import lqr, spectral_radius
from jaxmpc.systems.system import LinearSystem, host_matrices
from jaxmpc.systems.units import natural_units


@pytree
class Condensed:
    """The parametric QP of an MPC problem; `qp(theta)` is the QP at θ.

    With p = n, or n + m where the previous input counts, and nz variables: Phi (N+1, n, p),
    Gamma (N+1, n, nz), phi (N+1, n): predicted states. Psi (N, m, p), Omega (N, m, nz), psi (N, m):
    predicted inputs. P (nz, nz), F (nz, p), f (nz,): cost. C, D, d, lower, upper: rows.
    soft_linear, soft_quadratic (rows,): weights of soft rows, inf and 0 where hard; None without
    any. radius: of the terminal ball, whose rows are the last `balls`. weights: of the cost.
    K (m, n), or one a step: prestabilising gain. K_N (m, n): gain of the unconstrained input of one
    more step, u_N = K_N x_N. layout: (kind, steps, rows a step) of each block of rows. begins: the
    first step of each move.
    """

    Phi: Array
    Gamma: Array
    phi: Array
    Psi: Array
    Omega: Array
    psi: Array
    P: Array
    F: Array
    f: Array
    C: Array
    D: Array
    d: Array
    lower: Array
    upper: Array
    soft_linear: Any
    soft_quadratic: Any
    radius: Any
    weights: Weights
    K: Array
    K_N: Array
    layout: Layout = static()
    balls: tuple[int, ...] = static()
    begins: tuple[int, ...] = static()

    def qp(
        self,
        theta: Array,
        reference: Array | None = None,
        input_reference: Array | None = None,
        shift: Array | None = None,
    ) -> QP:
        """QP at θ (p,). reference (N+1, n), input_reference (N, m): what to track, None for 0.
        shift (rows,): added to the rows, None for 0."""
        q = differentiated_apart(matmul(self.F, theta) + self.f)
        if reference is not None:
            weighted = self.weights.of_states(reference)
            q = q - 2 * jnp.einsum("kni,kn->i", self.Gamma, weighted, precision="highest")
        if input_reference is not None:
            weighted = self.weights.of_inputs(input_reference)
            q = q - 2 * jnp.einsum("kmi,km->i", self.Omega, weighted, precision="highest")
        constant = matmul(self.D, theta) + self.d
        constant = constant if shift is None else constant + shift
        l, u = self.lower - constant, self.upper - constant
        soft = self.soft_linear, self.soft_quadratic
        return QP(self.P, q, self.C, l, u, *soft, self.radius, self.limits.sizes(), self.balls)

    def factor(self, solver: ADMM) -> Factor:
        """Return what the matrices of the QP decide about its solution by `solver`."""
        return factorise(self.P, self.C, solver, self.balls)

    @property
    def limits(self) -> Bounds:
        """What is asked of the rows as stated, without what follows from θ."""
        return Bounds(
            self.lower, self.upper, self.soft_linear, self.soft_quadratic, self.radius, self.balls
        )

    def reach(self, reach: Array) -> Array:
        """Return how far rows move along a unit of length (rows,), where that is known of those
        that z moves and 0 of the others: for these, what is the most of the same row at other
        steps, which has its unit."""
        parts = split(self.layout, reach)
        most = [jnp.max(part, axis=0, keepdims=True, initial=0.0) for part in parts]
        filled = [jnp.where(p > 0, p, q).ravel() for p, q in zip(parts, most, strict=True)]
        return jnp.concatenate([*filled, reach[:0]])

    def variables(self, states: Array, inputs: Array) -> Array:
        """z (nz,) of a trajectory, states (N+1, n) and inputs (N, m): the inverse of
        `trajectory`, with the input at its first step for each move."""
        return (inputs - apply(self.K, states[:-1]))[np.array(self.begins)].ravel()

    def trajectory(self, theta: Array, z: Array) -> tuple[Array, Array]:
        """States (N+1, n) and inputs (N, m) that z predicts from θ."""
        # One product of the batch each, (B, nz)·(nz, rows), not one a step.
        one = lambda M, v: matmul(v, M.reshape(-1, M.shape[-1]).T).reshape(M.shape[:-1])
        states = one(self.Phi, theta) + one(self.Gamma, z) + self.phi
        inputs = one(self.Psi, theta) + one(self.Omega, z) + self.psi
        return states, inputs

    def response(self, system: LinearSystem, forecast: Array) -> tuple[Array, Array]:
        """States (N+1, n) and inputs (N, m) that a forecast e (N, n) adds to those of z and θ:
        x̃_{k+1} = (A + BK) x̃_k + e_k from x̃_0 = 0, ũ_k = K x̃_k."""
        A, B, _ = dynamics_of(system, forecast.dtype)
        states = _predicted(A + matmul(B, self.K), forecast, jnp.zeros_like(forecast[0]))
        return states, apply(self.K, states[:-1])


def _predicted(A: Array, w: Array, start: Array) -> Array:
    """Return x_0 … x_N of x⁺ = A_k x + w_k from x_0 = start, a vector or a matrix: A (n, n), or
    one a step, w (N, n, …)."""
    xp = namespace((A, w, start))
    if xp is np:
        found = [start]
        for own, push in zip(np.broadcast_to(A, (len(w), *A.shape[-2:])), w, strict=True):
            found.append(own @ found[-1] + push)
        return xp.array(found)
    each, at = by_step((A, 2))

    def move(x: Array, step: tuple) -> tuple[Array, Array]:
        own, w = step
        return matmul(at(own)[0], x) + w, x

    last, x = jax.lax.scan(move, varying(start, (A, w)), (each, w))
    return jnp.concatenate([x, last[None]])


def prestabilising_gain(mpc: MPC) -> Any:
    """Return the gain K (m, n) of u = Kx + v that `mpc.prestabilise` asks for, zero for none; one
    for each step, (N, m, n), where the system differs from step to step. Raises ValueError where it
    is True and there is no LQR; none if A and B are traced then."""
    wish, none = mpc.prestabilise, np.zeros((mpc.system.m, mpc.system.n))
    system = replace(mpc.system, c=None)
    if not isinstance(wish, Switch | None):
        return wish
    if mpc.control_horizon is not None or (wish is not None and not wish.on):
        return none
    # Any stabilising gain serves; a little weight on every state makes the DARE solvable.
    Q, R = np.eye(system.n), np.eye(system.m)
    if {"system.A", "system.B"} & set(mpc.varying):
        return _gains_by_step(replace(mpc, system=system))
    if not concrete(system):
        if wish is None:
            return none
        K = jax.lax.stop_gradient(jnp.asarray(lqr(system, Q, R).K))
        return jnp.where(jnp.all(jnp.isfinite(K)), K, 0.0)
    A, B, _ = host_matrices(system)
    if wish is None and spectral_radius(A) <= 1 + 1e-9:
        return none
    if concrete(mpc.Q, mpc.R) and np.ndim(mpc.Q) == np.ndim(mpc.R) == 2:
        Q, R = host_array("Q", mpc.Q), host_array("R", mpc.R)
    units = natural_units(A, B, Q, R)
    Q = Q + 1e-3 * units.cost_matrix(np.eye(len(Q)))
    if not is_definite(R):
        R = R + 1e-3 * np.diag(np.diag(B.T @ Q @ B))
    try:
        return lqr(system, Q, R).K
    except ValueError:
        if wish is None:
            return none
        raise


def _gains_by_step(mpc: MPC) -> Any:
    """Return the gains (N, m, n) of the regulator of unit weights in `natural_units` over the
    horizon, for a system that differs from step to step; (m, n) zeros where no step grows and none
    was asked for."""
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    given: tuple[Any, Any] = arrays((mpc.system.A, mpc.system.B))
    A, B = given
    if concrete(A, B):
        A, B, _ = host_matrices(mpc.system, by_step=True)
    if mpc.prestabilise is None:
        if not concrete(A, B):
            return np.zeros((m, n))
        if spectral_radius(A) <= 1 + 1e-9:
            return np.zeros((m, n))
    dtype = floating_dtype(given)
    units = natural_units(*(abs(v).reshape(-1, *v.shape[-2:]).max(axis=0) for v in (A, B)))
    A, B = (v.astype(dtype) for v in jax.lax.stop_gradient(given))
    units = jax.tree.map(lambda v: jnp.asarray(v, dtype), units)
    Q, R = (jnp.broadcast_to(jnp.eye(k, dtype=dtype), (N + 1, k, k)) for k in (n, m))
    gains = _regulator(Q, R[:-1], *units.system(A, B))
    return jnp.where(jnp.all(jnp.isfinite(gains)), units.gain(gains), 0.0)


@compiled_lightly(0)
@own_modes
def _regulator(Q: Array, R: Array, A: Array, B: Array) -> Array:
    return riccati_recursion(Q, R, None, A, B).K


def condense(mpc: MPC) -> Condensed:
    """Build the parametric QP. Differentiable in every array of `mpc`. Raises ValueError where it
    does not fit into memory."""
    mpc = _ready(mpc)
    return on_device(_on_host(mpc)) if concrete(mpc) else _condense_in_jax(arrays(mpc))


def _ready(mpc: MPC) -> MPC:
    """Return the problem with its gains, if it can be condensed."""
    a_step = sum(np.shape(s.rows()[1])[-1] for s in (mpc.states, mpc.inputs) if s is not None)
    sizes = mpc.horizon, mpc.system.n, mpc.system.m, mpc.control_horizon, a_step
    needed = condensed_bytes(*sizes) * jax.dtypes.canonicalize_dtype(float).itemsize / 8
    require_memory("horizon", needed, "Give fewer steps, or use jm.mpc.solve_stagewise")
    require_tightened(mpc, "a plan of one sequence of inputs")
    mpc = filled_in(mpc)
    if mpc.disturbance is not None and concrete(mpc):
        require_room(mpc, blocks(mpc, float))
    return mpc


def _on_host(mpc: MPC) -> Condensed:
    """Condense a known problem into arrays of NumPy, in the present precision."""
    with np.errstate(over="ignore", invalid="ignore"):  # the status tells
        return _condense(host_arrays(mpc))


def filled_in(mpc: MPC) -> MPC:
    """Return the problem with its gains: the prestabilising one, and that of its policy."""
    return with_gain(replace(mpc, prestabilise=prestabilising_gain(mpc)))


def condensed_bytes(
    N: int, n: int, m: int, control_horizon: int | tuple[int, ...] | None, a_step: int
) -> float:
    """Return the bytes of the large arrays of a condensed problem in float64: Γ and Ω before moves
    are blocked, an identity, P and C with `a_step` rows a step."""
    moves: Any = N if control_horizon is None else control_horizon
    free = (len(moves) if isinstance(moves, tuple) else moves) * m
    return 8 * (N * m * (N * n + 2 * N * m) + free * (free + N * a_step))


def in_float64(mpc: MPC) -> MPC:
    """Return the problem as host arrays in float64, with its gains filled in; raise ValueError
    where it is traced."""
    cure = "Call it outside jit, vmap and grad; inside them take jm.solve, and jax.vmap for a batch"
    require_untraced("mpc", mpc, cure)
    return float64_arrays(filled_in(mpc))


def _condense(mpc: MPC) -> Condensed:
    """`condense` of a problem of JAX's arrays, traced or not, or of NumPy's."""
    system, N = mpc.system, mpc.horizon
    n, m, p = system.n, system.m, mpc.dimension
    dtype = floating_dtype(replace(mpc, prestabilise=None))
    xp = namespace(mpc)
    inverse_times: Any = solve if xp is jnp else np.linalg.solve
    cast = lambda v: xp.asarray(v, dtype)
    weights = Q, R, P_N, W = weights_of(mpc, dtype)
    A, B, c = dynamics_of(system, dtype)
    K = cast(mpc.prestabilise)

    # v_k = E_k z: the steps of a block share their move.
    places = np.eye(max(mpc.moves) + 1)[list(mpc.moves)]
    E = cast(np.kron(places, np.eye(m)).reshape(N, m, -1))
    nz = E.shape[2]
    pushes = cast(places)[:, None, :, None] * B[..., None, :]
    drift = xp.broadcast_to(c, (N, n))[..., None]
    w = [pushes.reshape(N, n, nz), xp.zeros((N, n, p), dtype), drift]
    X = _predicted(
        A + matmul(B, K), xp.concatenate(w, axis=2), xp.eye(n, nz + p + 1, nz, dtype=dtype)
    )
    Gamma, Phi, phi = X[..., :nz], X[..., nz:-1], X[..., -1]
    Psi, Omega, psi = matmul(K, Phi[:N]), matmul(K, Gamma[:N]) + E, apply(K, phi[:N])

    # Δu_k = u_k − u_{k−1}, with u_{−1} the last m coordinates of θ.
    previous = np.pad(np.eye(m), ((0, 0), (n, 0))) if p > n else np.zeros((m, p))
    before = (xp.zeros_like(Omega[0]), cast(previous), xp.zeros_like(psi[0]))
    rates = tuple(
        M - xp.concatenate([M_0[None], M[:-1]])
        for M, M_0 in zip((Omega, Psi, psi), before, strict=True)
    )

    of_states = xp.concatenate([xp.broadcast_to(Q, (N, n, n)), P_N[None]])

    def form(X: Array, U: Array, V: Array) -> Array:
        """Return 2 Σ_k M_k' W_k X_k with the weights of states, inputs and rates: the Hessian for
        X = Γ, the part of the linear term in θ for X = Φ, its constant part for X = φ."""
        total = _weighted_sum(Gamma, of_states, X) + _weighted_sum(Omega, R, U)
        if mpc.input_rate_weight is not None:
            total = total + _weighted_sum(rates[0], W, V)
        return 2 * total

    P = form(Gamma, Omega, rates[0])

    # argmin over u of u'Ru + (Ax + Bu)'P(Ax + Bu) with the data of the last step, the least of
    # them where there are several.
    A_last, B_last, R_last = (M[-1] if M.ndim == 3 else M for M in (A, B, R))
    BtP = matmul(B_last.T, P_N)
    G = R_last + matmul(BtP, B_last)
    ridge = 10 * xp.finfo(dtype).eps * xp.trace(G) / m
    ridge = cast(xp.where(ridge > 0, ridge, 1.0))
    K_N = -inverse_times(G + ridge * xp.eye(m, dtype=dtype), matmul(BtP, A_last))

    found = blocks(mpc, dtype)
    bounds = bounds_of(found, dtype)
    states, inputs = (Gamma, Phi, phi), (Omega, Psi, psi)
    empty = (xp.zeros((0, P.shape[0]), dtype), xp.zeros((0, p), dtype), xp.zeros(0, dtype))
    parts = [empty] + [stacked(b, states, rates if b.rate else inputs) for b in found]
    C, D, d = (xp.concatenate(part) for part in zip(*parts, strict=True))
    return Condensed(
        Phi=Phi,
        Gamma=Gamma,
        phi=phi,
        Psi=Psi,
        Omega=Omega,
        psi=psi,
        P=(P + P.T) / 2,
        F=form(Phi, Psi, rates[1]),
        f=form(phi, psi, rates[2]),
        C=C,
        D=D,
        d=d,
        lower=bounds.l,
        upper=bounds.u,
        soft_linear=bounds.linear,
        soft_quadratic=bounds.quadratic,
        radius=bounds.radius,
        weights=weights,
        K=K,
        K_N=K_N,
        layout=layout_of(found),
        balls=bounds.balls,
        begins=tuple(int(k) for k in np.unique(mpc.moves, return_index=True)[1]),
    )


def _weighted_sum(M: Array, weight: Array, X: Array) -> Array:
    """Return Σ_k M_k' W_k X_k: M (N, a, i), W (a, a), or one a step, X (N, a, …)."""
    xp = namespace((M, weight, X))
    if xp is np:
        weighted = matmul(weight, X) if X.ndim == 3 else apply(weight, X)
        return xp.tensordot(M, weighted, ((0, 1), (0, 1)))
    of_steps = "kab" if weight.ndim == 3 else "ab"
    return jnp.einsum(f"kai,{of_steps},kb...->i...", M, weight, X, precision="highest")


_condense_in_jax = compiled_lightly(0)(own_modes(_condense))


def condensed_in_float64(mpc: MPC) -> Condensed:
    """`condense(mpc)` of a known problem, also inside jit: every array a float64 array of NumPy."""
    with jax.enable_x64(True), jax.core.eval_context():
        return jax.tree.map(np.asarray, _on_host(_ready(in_float64(mpc))))


class Inequalities(NamedTuple):
    """C z + D θ ≤ b: one row for each finite bound of a condensed problem, balls left out.

    C (r, nz), D (r, p), b (r,). row (r,): which row of the condensed problem it is; side (r,): 1
    for its upper bound, −1 for its lower one.
    """

    C: np.ndarray
    D: np.ndarray
    b: np.ndarray
    row: np.ndarray
    side: np.ndarray

    @classmethod
    def of(cls, c: Condensed) -> "Inequalities":
        """The inequalities of a condensed problem whose arrays are NumPy's."""
        linear = len(c.C) - sum(c.balls)
        upper, lower = (np.flatnonzero(np.isfinite(v[:linear])) for v in (c.upper, c.lower))
        row, side = np.append(upper, lower), np.repeat([1.0, -1.0], [len(upper), len(lower)])
        b = side * (np.where(side > 0, c.upper[row], c.lower[row]) - c.d[row])
        return cls(side[:, None] * c.C[row], side[:, None] * c.D[row], b, row, side)

    def normalised(self) -> tuple["Inequalities", np.ndarray]:
        """The same inequalities with rows (C, D) of length 1, and the lengths (r,) they had."""
        length = row_lengths(np.hstack([self.C, self.D]))
        C, D = self.C / length[:, None], self.D / length[:, None]
        return self._replace(C=C, D=D, b=self.b / length), length
