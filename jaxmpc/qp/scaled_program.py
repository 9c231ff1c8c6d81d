"""A program in its own units and in ADMM's coordinates, and what is measured of its points."""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxmpc.pytrees import pytree
from jaxmpc.qp.admm import Factor, natural, scaled, scaled_multipliers, unscaled
from jaxmpc.qp.dual_step import RIDGE, Dual
from jaxmpc.qp.newton import largest
from jaxmpc.qp.precision import matmul, rounding
from jaxmpc.qp.problem import QP
from jaxmpc.qp.projection import FREE, Bounds
from jaxmpc.qp.residuals import (
    SHARE,
    Measured,
    Natural,
    Pair,
    PairCheck,
    Products,
    check_terms,
    row_sizes,
    terms_of,
)
from jaxmpc.qp.triton import has_kernels, in_one_program, indices


@pytree
class ScaledProgram:
    """A program in its own units and, as `q` (n,) and `bounds`, in ADMM's coordinates, which are
    measured in `unit`; eps: the tolerance."""

    qp: QP
    factor: Factor
    q: Array
    bounds: Bounds
    unit: Array
    eps: Array

    @classmethod
    def of(cls, qp: QP, factor: Factor, eps: Array) -> "ScaledProgram":
        """Return the program with clean data."""
        return cls(qp, factor, *scaled(factor, qp), eps)

    def unrounded(self) -> "ScaledProgram":
        """Return the program whose ADMM coordinates are made anew, in float64, from that in its own
        units: what rounding to float32 leaves between the two is more than the last Newton steps
        gain."""
        qp, f = self.qp, self.factor
        A = f.E[:, None] * matmul(qp.A, f.T)
        f = replace(f, H=matmul(f.T.T, matmul(qp.P, f.T)), A=A, S=matmul(A, A.T))
        return ScaledProgram(qp, f, *scaled(f, qp, self.unit), self.eps)

    def natural(self, w: Array, y: Array) -> Natural:
        """Return what is natural for the program at w, y."""
        return natural(self.factor, self.unit, self.q, self.bounds, w, y)

    @property
    def dual(self) -> Dual:
        """The dual in ADMM's coordinates. It seems unbounded, because rows contradict each other,
        from multipliers on that are so large: systems in the active rows have a ridge, beside which
        rows that are more nearly dependent, and hold larger ones, cannot be told apart."""
        limit = 1 / RIDGE * (1 + largest(self.q))
        return Dual(self.factor.A, self.factor.S, self.bounds, limit)

    def measure(self, w: Array, y: Array) -> "MeasuredPair":
        """Return the pair (z, y) of scaled w (n,) and y (m,), and what is measured of it."""
        qp, f, sizes = self.qp, self.factor, self.natural(w, y)
        z, y = unscaled(qp, f, self.unit, w, y)
        products = Products.of(qp, z, y)
        measure = measure_pair_in_kernel if has_kernels(len(y)) and not qp.balls else measure_pair
        vectors = Vectors(qp.q, qp.bounds, qp.row_sizes, z, y, products)
        found, gradient = measure(self.eps, vectors, sizes, f.E, self.unit, self.bounds)
        tolerances = self.eps * row_sizes(products.Az, qp.row_sizes, sizes)
        return MeasuredPair(Pair(z, y, *found), matmul(gradient, f.T) / self.unit, tolerances)


class MeasuredPair(NamedTuple):
    """A pair, the scaled gradient T'(Pz + q + A'y) (n,) of its Lagrangian, and the tolerances of
    rows (m,)."""

    pair: Pair
    gradient: Array
    tolerances: Array


class Vectors(NamedTuple):
    """What the residuals of a pair are computed from, once it is multiplied with the matrices: the
    arguments of `residuals.terms_of`."""

    q: Array
    bounds: Bounds
    known: Array | None
    z: Array
    y: Array
    products: Products


def measure_pair(
    eps: Array, vectors: Vectors, sizes: Natural, E: Array, unit: Array, scaled: Bounds
) -> tuple[PairCheck, Array]:
    """Return what is said of a pair, and the gradient of its Lagrangian. scaled: the bounds in
    ADMM's coordinates, of row scale E and measured in `unit`."""
    y = vectors.y
    terms = terms_of(*vectors, sizes)
    floor = rounding(y.dtype)
    # For soft rows the gap is quadratic in the error of z; the prox residual is linear.
    v, push = E * vectors.products.Az / unit, scaled_multipliers(E, y) / unit
    size = jnp.abs(v) + jnp.abs(push)
    prox = scaled.prox_residual(v + push, 1.0) - push, SHARE + size, size
    values, _, own = terms[1]
    # Entries at rounding level count as zero.
    gradient = jnp.where(jnp.abs(values) > floor * own, values, 0.0)
    return check_terms(terms, eps, floor, [prox]), gradient


def measure_pair_in_kernel(
    eps: Array, vectors: Vectors, sizes: Natural, E: Array, unit: Array, scaled: Bounds
) -> tuple[PairCheck, Array]:
    """`measure_pair` as a kernel for NVIDIA GPUs. Rows and variables that fill up the vectors are
    free, and zero."""
    given, tree = jax.tree.flatten((vectors, replace(sizes, gap=None), E, scaled))  # type: ignore[arg-type]
    free, none = FREE[: len(vectors.bounds.columns)], (0.0,) * len(vectors.products)
    known = None if vectors.known is None else 0.0
    fills = jax.tree.leaves(((0.0, free, known, 0.0, 0.0, none), (0.0,) * 4, 0.0, free))

    def measure(three: Array, *given: Array) -> tuple[list[Array], list[Array]]:
        i = indices(len(three))
        eps, gap, unit = (jnp.sum(jnp.where(i == n, three, 0.0)) for n in range(3))
        vectors, natural, E, scaled = jax.tree.unflatten(tree, given)
        found, gradient = measure_pair(eps, vectors, replace(natural, gap=gap), E, unit, scaled)
        return [gradient], jax.tree.leaves(found)

    data = [(jnp.stack([eps, sizes.gap, unit]), 0.0), *zip(given, fills, strict=True)]
    [gradient], numbers = in_one_program(measure, data, [len(vectors.z)], 7)
    primal, dual, gap, within, error, near, finished = numbers
    return PairCheck(
        Measured(primal, dual, gap, within > 0), error, near > 0, finished > 0
    ), gradient
