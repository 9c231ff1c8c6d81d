"""Unions of polytopes, as differences of sets make them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, as_array
from jaxmpc.checks import entries, fail, generator, require_kind
from jaxmpc.pytrees import record
from jaxmpc.sets import drawing
from jaxmpc.sets.fields import AnyTruth
from jaxmpc.sets.linear_sets import LinearSet, Polytope, as_polytope
from jaxmpc.sets.operations import sample_size


@record
class PolytopeUnion:
    """The points that are in at least one of some polytopes of the same dimension.

    pieces: the polytopes. apart: True says that they share boundaries only, as those of
    `set_difference` do; False that they may overlap.
    """

    pieces: tuple[Polytope, ...]
    apart: bool = False

    def __post_init__(self) -> None:
        pieces = entries("pieces", self.pieces, "Give a tuple of Polytopes")
        for piece in pieces:
            require_kind("pieces", piece, Polytope)
        object.__setattr__(self, "pieces", tuple(pieces))

    def is_empty(self) -> bool:
        """Return whether no piece has a point."""
        return all(piece.is_empty() for piece in self.pieces)

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether a piece holds a point x (n,), or each of many (k, n)."""
        if not self.pieces:
            return np.zeros(np.shape(as_array(x))[:-1], bool)
        return np.any([piece.contains(x, tolerance) for piece in self.pieces], axis=0)

    def volume(self) -> float:
        """Return the length, area or volume; what several pieces share counts once."""
        return float(sum(piece.volume() for piece in self.disjoint().pieces))

    def disjoint(self) -> "PolytopeUnion":
        """Return the same points as pieces with volume that share boundaries only."""
        if self.apart:
            return self
        found: list[Polytope] = []
        for i, piece in enumerate(self.pieces):
            found += set_difference(piece, *self.pieces[:i]).pieces
        return PolytopeUnion(tuple(found), apart=True)

    def sample(self, count: int, seed: int = 0) -> np.ndarray:
        """Return points (count, n) uniformly distributed over the union; the same ones for the same
        seed. ValueError where it has no volume, or is unbounded."""
        pieces = self.disjoint().pieces
        volumes = np.array([piece.volume() for piece in pieces])
        if not (len(volumes) and 0 < volumes.sum() < np.inf):
            fail("sample", "of a union without volume, or unbounded", "Sample its pieces")
        random = generator(seed)
        which = random.choice(len(volumes), sample_size(count), p=volumes / volumes.sum())
        found = np.zeros((count, pieces[0].dimension))
        for i, piece in enumerate(pieces):
            own = which == i
            found[own] = piece.sample(int(own.sum()), int(random.integers(2**31)))
        return found

    def plot(self, ax: Any = None, *, label: str | None = None, **style: Any) -> Any:
        """Draw all pieces in one color, as `plot` of a set does; return the axes."""
        if self.is_empty():
            fail("plot", "of an empty union", "Ask is_empty() first")
        style.setdefault("color", drawing.COLOURS[0])
        labels = [label, *[None] * (len(self.pieces) - 1)]
        return drawing.plot(*self.pieces, ax=ax, label=labels, **style)


def set_difference(minuend: LinearSet, *others: LinearSet) -> PolytopeUnion:
    """Return the closure of {x in minuend : x in none of `others`} as a union of polytopes that
    share boundaries only.

    Arguments:
        minuend, others: Boxes, Polytopes or Zonotopes of one dimension.

    Each set taken off cuts a piece row by row: the part beyond its first row, of the rest the part
    beyond its second row, and so on (Baotic 2009, Polytopic computations in constrained optimal
    control, section 3.2). Parts without volume are left out, so the volume is exact; where
    `minuend` itself is flat, nothing is left. In NumPy; not traceable.
    """
    pieces: Sequence[Polytope] = [as_polytope("minuend", minuend).reduce()]
    n = minuend.dimension
    for i, other in enumerate(others):
        other = other.spread(n) if isinstance(other, LinearSet) else other
        taken = as_polytope(f"others[{i}]", other)
        taken._require_fields(f"others[{i}]", n)
        pieces = [part for piece in pieces for part in _beyond(piece, taken)]
    found = tuple(piece for piece in pieces if piece.affine_dimension() == n)
    return PolytopeUnion(found, apart=True)


def _beyond(piece: Polytope, taken: Polytope) -> list[Polytope]:
    """Return the parts with volume of a piece that are outside of a set."""
    n = piece.dimension
    if piece.intersect(taken).affine_dimension() < n:
        return [piece] if piece.affine_dimension() == n else []
    parts = []
    for row, offset in zip(*taken.reduce().unit_rows(), strict=True):
        part = piece.intersect(Polytope(-row[None], [-offset]))
        if part.affine_dimension() == n:
            parts.append(part.reduce())
            piece = piece.intersect(Polytope(row[None], [offset]))
    return parts
