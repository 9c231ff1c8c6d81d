"""Facets, vertices and volume of {center + G w : |w_i| <= 1} from its generators, the columns of G,
in NumPy in float64.

A facet of such a set is where d'x is largest for a normal d that is orthogonal to n - 1 independent
generators; there every other generator counts with the sign of d'g. Each vertex lies on such a
facet (McMullen 1971, On zonotopes, Trans. AMS 159).
"""

import math
from collections.abc import Iterator
from itertools import chain, combinations, islice, product

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.sets.lp import maximise

# Generators less than this apart in direction are parallel, and those that are this much smaller
# than the set in each coordinate are rounding. (In coordinates in which the set has size 1.)
_SAME = 1e-13
# A direction in which the set is thinner than this, relative to its size, is none.
THIN = 1e-12
INSIDE = 1e-10  # a point counts as inside up to this fraction of the half-widths
_MOST = 300_000  # subsets of generators that are tried at most for facets and vertices
_MOST_VOLUME = 5_000_000  # and for the volume
_TOGETHER = 20_000  # of them at once


def reach(G: np.ndarray) -> np.ndarray:
    """Return the half-widths (n,) of the set: how far it reaches along each coordinate."""
    return np.abs(G).sum(axis=1)


def merged(G: np.ndarray) -> np.ndarray:
    """Return generators (n, m) without those that are zero or rounding, each parallel class as
    one."""
    size = reach(G)
    unit = np.where(size > 0, size, 1.0)
    S = G / unit[:, None]
    length = np.linalg.norm(S, axis=0)
    S = S[:, length > _SAME]
    if not S.shape[1]:
        return np.zeros((len(G), 0))
    # One sign of each direction: the first entry that is not small is positive.
    D = S / np.linalg.norm(S, axis=0)
    first = np.argmax(np.abs(D) > 1e-3, axis=0)
    flip = np.sign(D[first, np.arange(D.shape[1])])
    D, S = D * flip, S * flip
    order = np.lexsort(np.round(D, 10))
    D, S = D[:, order], S[:, order]
    close = np.linalg.norm(np.diff(D, axis=1), axis=0) <= _SAME
    group = np.concatenate([[0], np.cumsum(~close)])
    sums = np.zeros((group[-1] + 1, len(G)))
    np.add.at(sums, group, S.T)
    return sums.T * unit[:, None]


def span(G: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (unit, U, N): units (n,) of the coordinates, in which G / unit has a basis U (n, r) of
    its columns and N (n, n - r) of their complement, orthonormal both."""
    size = reach(G)
    unit = np.where(size > 0, size, 1.0)
    # Of the triangular factor: of thousands of columns themselves it rounds a thousand times more.
    U, values, _ = np.linalg.svd(np.transpose(np.linalg.qr(G.T / unit, mode="r")))
    rank = int((values > THIN * max(values, default=1.0)).sum())
    if rank == len(G):
        U = np.eye(rank)
    return unit, U[:, :rank], U[:, rank:]


def facet_normals(S: np.ndarray, argument: str = "Zonotope") -> np.ndarray:
    """Return the unit normals (k, r) of the facets, one of each opposite pair, of a set with volume
    whose generators are `merged`."""
    r, m = S.shape
    if r == 1:
        return np.ones((1, 1))
    D = S / np.linalg.norm(S, axis=0)
    if r == 2:
        return np.column_stack([-D[1], D[0]])
    found = []
    _require_few(argument, "facets", m, r - 1, _MOST)
    for subset in _subsets(m, r - 1):
        _, values, Vt = np.linalg.svd(D[:, subset].transpose(2, 1, 0))
        independent = values[:, -1] > 1e-10
        found.append(Vt[independent, -1])
    normals = np.vstack(found)
    first = np.argmax(np.abs(normals) > 1e-3, axis=1)
    normals = normals * np.sign(normals[np.arange(len(normals)), first])[:, None]
    _, once = np.unique(np.round(normals, 9), axis=0, return_index=True)
    return normals[once]


def vertex_signs(S: np.ndarray, argument: str = "Zonotope") -> np.ndarray:
    """Return the signs w (k, m) with which S w are the vertices, each once, of a set with volume
    whose generators are `merged`."""
    r, m = S.shape
    if r == 0:
        return np.zeros((1, 0), np.int8)
    if r == 1:
        return np.sign(S) * np.array([[-1], [1]])
    if r == 2:
        # Counter-clockwise from the lowest: generators upwards by their angle, one after the other.
        up = np.where((S[1] > 0) | ((S[1] == 0) & (S[0] > 0)), 1, -1)
        rank = np.argsort(np.argsort(np.arctan2(S[1] * up, S[0] * up)))
        half = np.where(rank < np.arange(m)[:, None], 1, -1) * up
        return np.vstack([half, -half])
    normals = facet_normals(S, argument)
    values = normals @ (S / np.linalg.norm(S, axis=0))
    on = np.abs(values) <= 1e-9
    signs = np.where(on, 0, np.sign(values)).astype(np.int8)
    found = []
    plain = on.sum(axis=1) == r - 1
    if plain.any():  # parallelepipeds: all signs of their generators
        inside = np.nonzero(on[plain])[1].reshape(-1, r - 1)
        for corner in product((-1, 1), repeat=r - 1):
            filled = signs[plain].copy()
            np.put_along_axis(filled, inside, np.array([corner], np.int8), axis=1)
            found.append(filled)
    for row, normal in zip(np.flatnonzero(~plain), normals[~plain], strict=True):
        within = np.flatnonzero(on[row])
        _, _, Vt = np.linalg.svd(normal[None])
        corners = vertex_signs(Vt[1:] @ S[:, within], argument)
        filled = np.tile(signs[row], (len(corners), 1))
        filled[:, within] = corners
        found.append(filled)
    half = np.vstack(found)
    return np.unique(np.vstack([half, -half]), axis=0)


def volume(G: np.ndarray) -> float:
    """Return 2^n sum |det| over all n generators (Shephard 1974, Canadian J. Math. 26)."""
    n, m = G.shape
    if m < n:
        return 0.0
    size = reach(G)
    if not size.all():
        return 0.0
    _require_few("Zonotope", "volume", m, n, _MOST_VOLUME)
    S = G / size[:, None]
    total = math.fsum(
        np.abs(np.linalg.det(S[:, subset].transpose(2, 0, 1))).sum() for subset in _subsets(m, n)
    )
    return float(2.0**n * total * np.prod(size))


def _subsets(m: int, k: int) -> Iterator[np.ndarray]:
    """Yield arrays (k, count) of the subsets of k of m, many at once."""
    every = combinations(range(m), k)
    while True:
        flat = np.fromiter(chain.from_iterable(islice(every, _TOGETHER)), dtype=int)
        if not flat.size:
            return
        yield flat.reshape(-1, k).T


def _require_few(argument: str, what: str, m: int, k: int, most: int) -> None:
    count = math.comb(m, k)
    if count > most:
        problem = f"{what} from {count:.2g} sets of {k} of {m} generators are too many to compute"
        fail(argument, problem, "Use support and contains, which need none, or fewer generators")


def holds(center: np.ndarray, G: np.ndarray, x: np.ndarray, tolerance: float) -> bool:
    """Return whether center + G w = x to within `tolerance`, 1e-10 of the half-widths and the
    rounding of x and the center for some |w_i| <= 1, by one LP."""
    size, apart = reach(G), x - center
    allowed = tolerance + 4 * np.finfo(float).eps * (np.abs(x) + np.abs(center))
    if np.any(~(np.abs(apart) <= allowed + size * (1 + 2 * INSIDE))):
        return False
    m, moves = G.shape[1], size > 0
    if not moves.any():
        return True
    G, size, apart, allowed = G[moves], size[moves], apart[moves], allowed[moves]
    # Least t with |apart - G w| <= tolerance + t size.
    identity, zeros = np.eye(m), np.zeros((2 * m, 1))
    rows = np.vstack(
        [np.c_[G, -size], np.c_[-G, -size], np.c_[np.vstack([identity, -identity]), zeros]]
    )
    limits = np.concatenate([apart + allowed, allowed - apart, np.ones(2 * m)])
    return maximise(-np.eye(m + 1)[-1], rows, limits).value >= -INSIDE
