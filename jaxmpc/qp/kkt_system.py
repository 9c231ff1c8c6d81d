"""The optimality conditions of a program linearised at a solution, and their solver."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.qp.batched_loops import in_blocks, repeat_while, true_places
from jaxmpc.qp.dual_kernel import MOST_ROWS, damped_kernel
from jaxmpc.qp.linalg import definite_solver
from jaxmpc.qp.newton import gram, ridged
from jaxmpc.qp.precision import matmul
from jaxmpc.qp.triton import on_gpu

# Rows of the reduced system at most, where there is no kernel, steps of the method of multipliers,
# and instances whose matrices of the size of H are held at once.
REDUCED_ROWS, SWEEPS, DENSE_BLOCK = 48, 8, 512


def linearised(
    H: Array, A: Array, weights: Array, normals: list[Array], rho: float, flat: Array
) -> Callable[[Array, Array], tuple[Array, Array]]:
    """Solver of the optimality conditions with the pieces of g held fixed.

    The conditions Hw + q + A'y = 0 and e(Aw + y/ρ) = y/ρ, moved by a (n,) and c (m,), move
    their solution by

        H dw + A'dy = −a,        dy/ρ = D (A dw + dy/ρ) + c,        D = diag(weights) + Σ h h'.

    The function returned maps (a, c) to (dw, dy); it is linear. D is singular or not: eliminating
    dy by the method of multipliers needs only the definite K = H + ρ A'DA (with a ridge), and
    eight steps leave an error (1 + ρ s²)⁻⁸ for active rows with least singular value s. Where
    active rows contradict each other, dw tends to their least-squares solution and dy stays
    bounded by 8ρ times the contradiction.

    flat: whether H is not nearly the identity. Without normals the rows R with D = 0 have dy = ρc,
    and the others, W, make the system symmetric, Λ = (1/D − 1)/ρ:

        H dw + A_W'dy_W = −a − A_R'dy_R,        A_W dw − Λ dy_W = −c_W/D.
    """
    D = lambda v: weights * v + sum(h * jnp.sum(h * v) for h in normals)
    if normals:
        inverse = definite_solver(dense_system(H, A, weights, normals, rho))
        return partial(swept, H, A, D, rho, inverse)
    n, active = A.shape[1], weights > jnp.finfo(A.dtype).eps ** 2
    slack = (1 / jnp.where(active, weights, 1.0) - 1) / rho
    only = lambda y: jnp.where(active, y, 0.0)

    def product(wy: Array) -> Array:
        w, y = wy[:n], wy[n:]
        rows = jnp.where(active, matmul(w, A.T) - slack * y, y)
        return jnp.concatenate([matmul(w, H) + matmul(only(y), A), rows])

    constants, own = jax.lax.stop_gradient(((H, A, flat), (weights, active, slack)))

    def approach(_: Callable, b: Array) -> Array:
        return jnp.concatenate(approximate(rho, constants, own, (b[:n], b[n:])))

    def solver(a: Array, c: Array) -> tuple[Array, Array]:
        rest = jnp.where(active, 0.0, rho * c)
        b = [-a - matmul(rest, A), only(-c / jnp.where(active, weights, 1.0))]
        # In one vector: a part without tangents could not be transposed.
        moved = jax.lax.custom_linear_solve(product, jnp.concatenate(b), approach, symmetric=True)
        return moved[:n], moved[n:] + rest

    return solver


def dense_system(H: Array, A: Array, weights: Array, normals: list[Array], rho: float) -> Array:
    """Return K = H + ρ A'DA (n, n) of `linearised`, with a ridge."""
    return ridged(H + rho * gram(A, weights, normals), rho)


def swept(
    H: Array, A: Array, D: Callable, rho: float, inverse: Callable, a: Array, c: Array
) -> tuple[Array, Array]:
    """Return (dw, dy) of `linearised` by eight steps of the method of multipliers; inverse: K⁻¹."""

    def sweep(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        dw, dy = carry
        rows = D(matmul(dw, A.T) + dy / rho) + c - dy / rho
        gradient = a + matmul(dw, H) + matmul(dy, A)
        step = -inverse(gradient + rho * matmul(rows, A))
        return (dw + step, dy + rho * (D(matmul(step, A.T)) + rows)), None

    return jax.lax.scan(sweep, (jnp.zeros_like(a), jnp.zeros_like(c)), length=SWEEPS)[0]


def approximate(
    rho: float, constants: tuple, own: tuple, b: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Return (dw, dy) of the symmetric system in `linearised` with right-hand sides b; not
    differentiable. constants: H, A, flat; own: weights, active, Λ.

    Where H is nearly the identity and few rows are active, the eight steps are taken in these rows
    (`damped`), four of them on what the first four leave of the system, in which H is what it is.
    The other instances of a batch take them with systems of the size of H.
    """
    (H, A, flat), (weights, active, slack) = constants, own
    if min(A.shape) <= REDUCED_ROWS and not on_gpu():
        return in_blocks(partial(dense_steps, rho), (H, A), (weights, b))
    most = MOST_ROWS if on_gpu() else REDUCED_ROWS
    W, S = true_places(active, most), matmul(A, A.T)
    take = lambda v: v.at[W].get(mode="fill", fill_value=0.0)

    def half(b: tuple[Array, Array]) -> tuple[Array, Array]:
        right = take(matmul(b[0], A.T) - b[1])
        y = damped(S, W, take(slack), right, 1 / rho, SWEEPS // 2)
        dy = jnp.zeros_like(b[1]).at[W].add(y, mode="drop")
        return b[0] - matmul(dy, A), dy

    dw, dy = half(b)
    rows = jnp.where(active, matmul(dw, A.T) - slack * dy, b[1])
    more_w, more_y = half((b[0] - matmul(dw, H) - matmul(dy, A), b[1] - rows))
    reduced = dw + more_w, jnp.where(active, dy + more_y, b[1])

    def by_blocks(constants: tuple, state: tuple) -> tuple:
        weights, b, _, is_open = state
        found = in_blocks(partial(dense_steps, rho), constants, (weights, b), large=DENSE_BLOCK)
        # What stayed the same XLA would take for constant, and factor before the loop, for nothing.
        none = jax.tree.map(jnp.zeros_like, (weights, b))
        return *none, found, ~is_open

    many = (jnp.sum(active) > most) | flat
    state = weights, b, reduced, many
    return repeat_while(lambda s: s[3], by_blocks, (H, A), state, steps="long")[2]


def dense_steps(rho: float, constants: tuple, data: tuple) -> tuple[Array, Array]:
    """Return `approximate` of one instance with any number of active rows, by systems of the size
    of H. constants: H, A; data: weights, and b, which has no entries in inactive rows."""
    (H, A), (weights, (a, c)) = constants, data
    inverse = definite_solver(dense_system(H, A, weights, [], rho))
    return swept(H, A, lambda v: weights * v, rho, inverse, -a, -weights * c)


def damped(S: Array, W: Array, slack: Array, b: Array, damping: float, steps: int) -> Array:
    """Return y (k,) after so many steps y += (M + damping·I)⁻¹(b − M y) from 0, M = S_WW +
    diag(slack) positive semidefinite: b's solution, or where M is singular and b contradicts it,
    least-squares with a bounded part in the null space. W (k,): rows of S, filled up with their
    number; slack, b (k,)."""
    if on_gpu():
        return damped_kernel(S, W, slack, b, damping, steps)
    M = S.at[W[:, None], W[None, :]].get(mode="fill", fill_value=0.0) + jnp.diag(slack)
    inverse = definite_solver(M + damping * jnp.eye(len(W), dtype=b.dtype))
    y = jnp.zeros_like(b)
    for _ in range(steps):
        y = y + inverse(b - matmul(y, M))
    return y
