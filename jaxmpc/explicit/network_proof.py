"""What is proved of a network in the place of an MPC: the share of a set of states from which its
input leads into a set.

The set is cut into simplices (Delaunay). Over one of them each quantity q(x) of the network is
enclosed by an affine function, q(x) in M x + t ± r, as in zonotopes (Singh et al. 2018, NeurIPS);
an affine function is largest at a corner. Layers are affine, and max(z, 0) of a z between a < 0 and
b > 0 lies in slope z + [0, −slope a] with slope = b / (b − a). A simplex in which the next state
keeps every half-space is proved, one in which it breaks one everywhere is refuted; others are cut
in two at their longest edge.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.batches import each_part, joined
from jaxmpc.checks import fail, require_finite, require_kind, require_shape, whole
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box
from jaxmpc.sets.linear_sets import LinearSet, as_polytope
from jaxmpc.sets.polyhedra import TRIANGULATED, simplex_volumes, triangulation
from jaxmpc.systems.system import LinearSystem, host_matrices

# Simplices that a program takes at once.
SIMPLICES_AT_ONCE = 8192
# What half-spaces of length one, in units of the set's size, have to keep beside the roundings of
# the bounds: those of whoever evaluates the network.
ROUNDINGS = 1e-9

# Quantities (k,) over a simplex: M (k, n), t (k,), r (k,).
Enclosure = tuple[Array, Array, Array]


@record
class NetworkProof:
    """What is proved of the next states of a set, in shares of its volume that add up to 1.

    kept: the input leads into the target. broken: it leads elsewhere. undecided: neither is
    proved. cells: simplices that were looked at. open_cells (K, n+1, n): corners of those that are
    undecided.
    """

    kept: float
    broken: float
    undecided: float
    cells: int
    open_cells: np.ndarray

    def __repr__(self) -> str:
        return (
            f"NetworkProof: {self.kept:.4%} of the volume proved to keep the target, "
            f"{self.broken:.4%} to miss it, {self.undecided:.4%} undecided ({self.cells:,} cells)"
        )


def prove_network(
    network: Sequence[tuple[Any, Any]],
    system: LinearSystem,
    states: LinearSet,
    inputs: Box,
    *,
    target: LinearSet | None = None,
    cells: int = 300_000,
) -> NetworkProof:
    """Prove for which share of a set of states a network's input leads into a set.

    Arguments:
        network: (W, b) of each layer, W (units, inputs of the layer) and b (units,), with
            max(·, 0) between layers. The input is the output of the last one, clipped to `inputs`.
        system: x⁺ = A x + B u + c.
        states: bounded set with volume, in up to six dimensions. In a control invariant set, such
            as `jm.sets.maximal_control_invariant_set`, the network keeps all limits for ever where
            every share but `kept` is zero; elsewhere it does for one more step.
        inputs: limits of the inputs, finite.
        target: where the next state has to be; None: in `states`. Under disturbances E w, w in W,
            give `states.pontryagin_difference(W.image(E))`.
        cells: that are looked at, at most.

    All states of a cell that counts as kept keep every half-space of the target by 1e-9 of the
    set's size, and by what float64 may err in these bounds; `states` and `target` count as given.
    States with one input alone that leads into the target stay undecided, however small the cells
    are.

    Raises ValueError for wrong arguments, and sets that are empty, flat or unbounded.
    """
    require_kind("system", system, LinearSystem)
    require_kind("inputs", inputs, Box)
    n, m = system.n, system.m
    whole("cells", cells, 1)
    inputs.validate("inputs", m)
    inputs = inputs.spread(m)
    low, high = inputs.bounds("inputs")
    if not np.all(np.isfinite(low) & np.isfinite(high)):
        fail("inputs", "are unbounded", "Give finite limits, to which the network's input is cut")
    system.validate()
    body = as_polytope("states", states, n).require_body("states")
    if n > TRIANGULATED:
        problem = f"has dimension {n}, and simplices are made in up to {TRIANGULATED}"
        fail("states", problem, "Prove a system of fewer states")
    goal = body if target is None else as_polytope("target", target, n)
    layers = _checked(network, n, m)

    vertices = body.vertices()
    left = triangulation(vertices)
    size = vertices.max(axis=0) - vertices.min(axis=0)
    H, h = (np.asarray(part, float) for part in goal.half_spaces())
    length = np.abs(H * size).sum(axis=1)
    if np.any(h[length == 0] < 0):
        fail("target", "is empty", "Give a set that holds states")
    # Rows that say something, in units of the set's size; where none does, one that says nothing.
    H, h, length = (part[length > 0] for part in (H, h, length))
    H, h = (H / length[:, None], h / length) if len(H) else (np.zeros((1, n)), np.ones(1))
    A, B, c = host_matrices(system)
    with jax.enable_x64(True):
        last = H @ A, H @ B, H @ c - h
        margin = ROUNDINGS + rounding_bound(
            (layers, (low, high), last), np.abs(vertices).max(axis=0)
        )
        network64 = jax.tree.map(jnp.asarray, (layers, (low, high), last))
        bounds = jax.jit(jax.vmap(excess_bounds, (None, 0)))
        whole_volume, kept, broken, count = float(simplex_volumes(left).sum()), 0.0, 0.0, 0
        while len(left) and count + len(left) <= cells:
            parts = each_part(lambda part: bounds(network64, part), left, SIMPLICES_AT_ONCE)
            least, most = joined([part.result for part in parts])
            count += len(left)
            volume, proved, refuted = simplex_volumes(left), most <= -margin, least >= margin
            kept += float(volume[proved].sum())
            broken += float(volume[refuted].sum())
            left = _halves(left[~proved & ~refuted], size)
    undecided = float(simplex_volumes(left).sum())
    return NetworkProof(
        kept / whole_volume, broken / whole_volume, undecided / whole_volume, count, left
    )


def excess_bounds(network: Any, corners: Array) -> tuple[Array, Array]:
    """Return bounds of max(F x + G u(x) + g) over a simplex: a number that it is nowhere below, and
    one that it is nowhere above.

    network: the layers, (low, high) to which the input is clipped, and (F, G, g). corners
    (n+1, n).
    """
    layers, (low, high), (F, G, g) = network

    def ends(M: Array, t: Array, r: Array) -> tuple[Array, Array]:
        values = corners @ M.T + t
        return jnp.min(values, axis=0) - r, jnp.max(values, axis=0) + r

    def affine(W: Array, b: Array, found: Enclosure) -> Enclosure:
        M, t, r = found
        return W @ M, W @ t + b, jnp.abs(W) @ r

    def rectified(found: Enclosure) -> Enclosure:
        (M, t, r), (a, b) = found, ends(*found)
        split = (a < 0) & (b > 0)
        slope = jnp.where(split, b / jnp.where(split, b - a, 1.0), jnp.where(a >= 0, 1.0, 0.0))
        half = jnp.where(split, -slope * a / 2, 0.0)
        return slope[:, None] * M, slope * t + half, slope * r + half

    n, dtype = corners.shape[1], corners.dtype
    found = jnp.eye(n, dtype=dtype), jnp.zeros(n, dtype), jnp.zeros(n, dtype)
    for W, b in layers[:-1]:
        found = rectified(affine(W, b, found))
    # The clipped input is high − max(high − low − max(z − low, 0), 0).
    W, b = layers[-1]
    minus = -jnp.eye(len(b), dtype=dtype)
    above = rectified(affine(W, b - low, found))
    M, t, r = affine(G @ minus, G @ high + g, rectified(affine(minus, high - low, above)))
    least, most = ends(M + F, t, r)
    return jnp.max(least), jnp.max(most)


def rounding_bound(network: Any, reach: np.ndarray) -> float:
    """Return more than the floating-point error of `excess_bounds` for corners within ± reach (n,).

    Let g bound |M x| + |t| + r of each quantity. A layer takes it to |W| g + |b|, and max(·, 0) to
    2 g at most, as the slope is at most 1 and half the band at most g / 2. Each entry is a sum of
    at most k products, twice a layer with that at the corners, and as the errors of one layer grow
    as its quantities do, 8 (k + 8) units in the last place of the last g for each layer are more
    than all of them (Higham 2002, section 3.1).
    """
    layers, (low, high), (F, G, g) = network
    size, width = reach, len(reach)
    for i, (W, b) in enumerate(layers):
        size = np.abs(W) @ (size if i == 0 else 2 * size) + np.abs(b)
        width = max(width, W.shape[1])
    span = 2 * (2 * (size + np.abs(low)) + np.abs(high) + np.abs(low))  # both ends of the limits
    last = np.abs(F) @ reach + np.abs(G) @ (span + np.abs(high)) + np.abs(g)
    each = 8 * (width + 8) * np.finfo(np.float64).eps
    return float(each * (len(layers) + 4) * last.max())


def _checked(network: Any, n: int, m: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the layers as float64 arrays, or raise ValueError."""
    try:
        layers = [(host_array("network", W), host_array("network", b)) for W, b in network]
    except (TypeError, ValueError):
        layers = []
    if not layers:
        fail("network", "is no sequence of (W, b)", "Give the arrays of each layer, first to last")
    units = n
    for i, (W, b) in enumerate(layers):
        if W.ndim != 2 or W.shape[1] != units:
            cure = f"Give (units, {units}): one row a unit; of kernels (in, out) give the transpose"
            fail(f"network[{i}][0]", f"shape {W.shape}", cure)
        require_shape(f"network[{i}][1]", b, (len(W),), "One number for each row of W")
        require_finite(f"network[{i}][0]", W)
        require_finite(f"network[{i}][1]", b)
        units = len(W)
    if units != m:
        fail("network", f"has {units} outputs for {m} inputs", "One row of the last W an input")
    return layers


def _halves(corners: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return both halves of each simplex, cut in the middle of the edge that is longest in the
    units `size` (n,) of the coordinates."""
    i, j = np.triu_indices(corners.shape[1], 1)
    edges = ((corners[:, i] - corners[:, j]) / size) ** 2
    longest = np.argmax(edges.sum(axis=2), axis=1)
    each, i, j = np.arange(len(corners)), i[longest], j[longest]
    middle = (corners[each, i] + corners[each, j]) / 2
    one, two = corners.copy(), corners.copy()
    one[each, i], two[each, j] = middle, middle
    return np.concatenate([one, two])
