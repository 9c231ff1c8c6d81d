"""From an MPC problem to a small dense QP: the states are eliminated ("condensing").

With u_k = K x_k + v_k (K = 0 unless prestabilised) and z = (v_0, …, v_{N−1}) all predictions
are affine in z and x0:

    x_k = Φ_k x0 + Γ_k z + φ_k,        u_k = K x_k + v_k.

Every constraint is then a row lower ≤ C z + D x0 + d ≤ upper, in the order inputs (step by
step), states (step by step), terminal set; the cost is ½ z'Pz + (F x0 + f(reference))'z + const.
P, F, C, D depend on nothing that moves between samples. Rows at k = 0 have C = 0.
"""

from dataclasses import dataclass, field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail
from jaxmpc.control.riccati import lqr
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.precision import arrays, floating_dtype, matmul
from jaxmpc.qp.problem import QP


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Condensed:
    """The parametric QP of an MPC problem; `qp(x0)` is its member at one initial state.

    Phi (N+1, n, n), Gamma (N+1, n, N·m), phi (N+1, n): predicted states. Psi (N, m, n),
    Omega (N, m, N·m), psi (N, m): predicted inputs. P (N·m, N·m), F (N·m, n): cost. C, D, d,
    lower, upper: rows. Q, R, P_N: weights. K (m, n): prestabilising gain. K_N (m, n): gain of the
    unconstrained input of one more step, u_N = K_N x_N. first_step: first k with state rows.
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
    Q: Array
    R: Array
    P_N: Array
    K: Array
    K_N: Array
    first_step: int = field(metadata={"static": True})

    def qp(self, x0: Array, reference: Array | None = None) -> QP:
        """QP at x0 (n,). reference (N+1, n): states to track, None for the origin."""
        q = matmul(self.F, x0) + self.f
        if reference is not None:
            weighted = jnp.concatenate(
                [matmul(reference[:-1], self.Q), matmul(reference[-1:], self.P_N)]
            )
            q = q - 2 * jnp.einsum("kni,kn->i", self.Gamma, weighted, precision="highest")
        shift = matmul(self.D, x0) + self.d
        return QP(P=self.P, q=q, A=self.C, l=self.lower - shift, u=self.upper - shift)

    def trajectory(self, x0: Array, z: Array) -> tuple[Array, Array]:
        """States (N+1, n) and inputs (N, m) that z predicts from x0."""
        states = matmul(self.Phi, x0) + matmul(self.Gamma, z) + self.phi
        inputs = matmul(self.Psi, x0) + matmul(self.Omega, z) + self.psi
        return states, inputs


def prestabilising_gain(mpc: MPC) -> Any:
    """The gain K of u = Kx + v that `mpc.prestabilise` asks for; zero for none."""
    wish, none = mpc.prestabilise, np.zeros((mpc.system.m, mpc.system.n))
    if wish is False:
        return none
    if wish is not None and wish is not True:
        return wish
    if not concrete(mpc.system.A, mpc.system.B, mpc.Q, mpc.R):
        if wish is True:
            fail("prestabilise", "is True where A, B are traced", "Give the gain K (m, n) itself")
        return none
    spectral_radius = np.abs(np.linalg.eigvals(np.asarray(mpc.system.A, float))).max()
    if wish is None and spectral_radius <= 1 + 1e-9:
        return none
    # Any stabilising gain serves; a little weight on every state makes the DARE solvable.
    Q = np.asarray(mpc.Q, float)
    weight = 1e-3 * max(np.trace(Q) / len(Q), 1e-9)
    try:
        return lqr(mpc.system, Q + weight * np.eye(len(Q)), mpc.R).K
    except ValueError:
        if wish is True:
            raise
        return none


def condense(mpc: MPC) -> Condensed:
    """Build the parametric QP. Differentiable in every array of `mpc`."""
    return _condense(arrays(replace(mpc, prestabilise=prestabilising_gain(mpc))))


def in_float64(mpc: MPC) -> MPC:
    """The problem as host arrays in float64, with the prestabilising gain filled in."""
    return jax.tree.map(np.float64, replace(mpc, prestabilise=prestabilising_gain(mpc)))


@jax.jit
def _condense(mpc: MPC) -> Condensed:
    system, N = mpc.system, mpc.horizon
    n, m = system.n, system.m
    dtype = floating_dtype(replace(mpc, prestabilise=None))
    cast = lambda v: jnp.asarray(v, dtype)
    A, B = cast(system.A), cast(system.B)
    c = jnp.zeros(n, dtype) if system.c is None else cast(system.c)
    K = cast(mpc.prestabilise)

    A_K = A + matmul(B, K)
    _, Phi = jax.lax.scan(lambda M, _: (matmul(A_K, M), M), jnp.eye(n, dtype=dtype), length=N + 1)
    response = matmul(Phi[:N], B)  # A_K^j B
    lag = np.arange(N + 1)[:, None] - 1 - np.arange(N)[None, :]
    Gamma = jnp.where((lag >= 0)[:, :, None, None], response[np.maximum(lag, 0)], 0.0)
    Gamma = Gamma.transpose(0, 2, 1, 3).reshape(N + 1, n, N * m)
    drift = matmul(Phi[:N], c)  # A_K^j c
    phi = jnp.concatenate([jnp.zeros((1, n), dtype), jnp.cumsum(drift, axis=0)])

    own = jnp.eye(N * m, dtype=dtype).reshape(N, m, N * m)
    Psi, Omega, psi = matmul(K, Phi[:N]), matmul(K, Gamma[:N]) + own, matmul(phi[:N], K.T)

    Q, R = cast(mpc.Q), cast(mpc.R)
    P_N = jnp.zeros((n, n), dtype) if mpc.terminal_cost is None else cast(mpc.terminal_cost)
    weights = jnp.concatenate([jnp.broadcast_to(Q, (N, n, n)), P_N[None]])
    # Σ_k M_k' W_k X_k with W on the states and R on the inputs: Hessian, its x0 and constant part.
    form = lambda X, U: (
        2
        * (
            jnp.einsum("kai,kab,kb...->i...", Gamma, weights, X, precision="highest")
            + jnp.einsum("kai,ab,kb...->i...", Omega, R, U, precision="highest")
        )
    )
    P = form(Gamma, Omega)

    # argmin over u of u'Ru + (Ax + Bu)'P(Ax + Bu).
    BtP = matmul(B.T, P_N)
    K_N = -jnp.linalg.solve(R + matmul(BtP, B), matmul(BtP, A))

    first = 0 if mpc.constrain_initial else 1
    blocks = [(Omega, Psi, psi, rows_of(mpc.inputs, m, dtype))]
    blocks.append((Gamma[first:N], Phi[first:N], phi[first:N], rows_of(mpc.states, n, dtype)))
    blocks.append((Gamma[N:], Phi[N:], phi[N:], rows_of(mpc.terminal_set, n, dtype)))
    C, D, d, lower, upper = (
        jnp.concatenate(parts)
        for parts in zip(*(stack_rows(*block) for block in blocks), strict=True)
    )
    return Condensed(
        Phi, Gamma, phi, Psi, Omega, psi, (P + P.T) / 2, form(Phi, Psi), form(phi, psi),
        C, D, d, lower, upper, Q, R, P_N, K, K_N, first,
    )  # fmt: skip


def rows_of(set_: Any, size: int, dtype: Any) -> tuple[Array, Array, Array]:
    """Two-sided rows (H, lower, upper) of a set in R^size; none for None."""
    if set_ is None:
        return jnp.zeros((0, size), dtype), jnp.zeros(0, dtype), jnp.zeros(0, dtype)
    H, lower, upper = (jnp.asarray(v, dtype) for v in set_.rows())
    return H, lower, upper


def stack_rows(
    M: Array, by_x0: Array, constant: Array, rows: tuple[Array, Array, Array]
) -> tuple[Array, Array, Array, Array, Array]:
    """Rows H v_k with v_k = M_k z + by_x0_k x0 + constant_k for a number of steps, flattened."""
    H, lower, upper = rows
    steps = M.shape[0]
    return (
        matmul(H, M).reshape(steps * H.shape[0], M.shape[2]),
        matmul(H, by_x0).reshape(steps * H.shape[0], by_x0.shape[2]),
        matmul(constant, H.T).reshape(-1),
        jnp.tile(lower, steps),
        jnp.tile(upper, steps),
    )
