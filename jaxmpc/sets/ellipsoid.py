"""Ellipsoids in R^n. `contains` and `support` are JAX functions; the rest runs in NumPy."""

import math
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
import scipy

from jaxmpc.arrays import Reals, as_array, host_array, store_floats
from jaxmpc.checks import (
    concrete,
    fail,
    generator,
    require_finite,
    require_shape,
    require_symmetric_psd,
    whole,
)
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import solve, symmetric
from jaxmpc.sets.fields import (
    AnyNumber,
    AnyTruth,
    affine_map,
    numbers,
    one_or_many,
    product,
    require_dimension,
    section,
    vector,
)
from jaxmpc.sets.geometry import row_lengths
from jaxmpc.sets.linear_sets import Box
from jaxmpc.sets.lp import FLAT
from jaxmpc.sets.operations import BasicSet, sample_size


@pytree
class Ellipsoid(BasicSet):
    """{x in R^n : (x - center)'P (x - center) <= level}.

    Arguments:
        P: (n, n), symmetric positive definite.
        level: a number > 0.
        center: (n,), or None for the origin. A terminal set of an `MPC` has none.

    It is bounded and has volume; give a Box or Zonotope for a point or a segment. Its image under
    a matrix of full row rank, its sections and its preimages under one of full column rank are
    ellipsoids; sums, differences and intersections with sets are not, and are refused.
    """

    P: Reals
    level: Reals
    center: Reals | None = None

    def __post_init__(self) -> None:
        store_floats(self, "P", "level", "center")
        self._require_given(P=2, level=0)

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return np.shape(as_array(self.P))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, P not positive definite,
        or level <= 0."""
        self._require_fields(argument, dimension)
        if not concrete((self.P, self.level)):
            return
        require_symmetric_psd(f"{argument}.P", self.P, definite=True)
        level = host_array(f"{argument}.level", self.level)
        if not (np.isfinite(level) and level > 0):
            fail(f"{argument}.level", f"{level:g} is not a positive number", "Give x'Px's maximum")
        if self.center is not None:
            require_finite(f"{argument}.center", self.center)

    def require_origin(self, argument: str) -> None:
        """Raise ValueError, naming `argument`, unless it is centered at the origin."""
        if self.center is not None and not (
            concrete(self.center) and not np.any(np.asarray(self.center))
        ):
            cure = "Write the system in deviations from the center, or give a Polytope"
            fail(argument, "is an Ellipsoid with a center", cure)

    def is_empty(self) -> bool:
        """Return False: it holds its center."""
        self._values()
        return False

    def is_bounded(self) -> bool:
        """Return True."""
        self._values()
        return True

    def affine_dimension(self) -> int:
        """Return n: it has volume."""
        return len(self._values()[0])

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether (x - center)'P (x - center) <= level + tolerance, for a point x (n,) or
        for each of many (k, n)."""
        self.validate("Ellipsoid")
        x, many = one_or_many("x", x, self.dimension)
        xp, (P, level, x, tolerance) = numbers(self.P, self.level, x, tolerance)
        x = x if self.center is None else x - xp.asarray(self.center)
        if many:
            return xp.sum(product(xp, x, P) * x, axis=-1) <= level + tolerance
        return product(xp, x, product(xp, P, x)) <= level + tolerance

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the ellipsoid = d'center + sqrt(level d'P^-1 d), for one direction d
        (n,) or for each of many (k, n)."""
        self.validate("Ellipsoid")
        d, many = one_or_many("d", d, self.dimension)
        xp, (along, P, level) = numbers(d, self.P, self.level)
        columns = along.T if many else along
        P = symmetric(P)
        solved = np.linalg.solve(P, columns) if xp is np else solve(P, columns)
        square = xp.sum(along * solved.T, axis=-1) if many else along @ solved
        reach = xp.sqrt(level * square)
        return reach if self.center is None else reach + product(xp, along, self.center)

    def volume(self) -> float:
        """Return the volume pi^(n/2) / Gamma(n/2 + 1) level^(n/2) / sqrt(det P). In NumPy."""
        P, level, _ = self._values()
        half = len(P) / 2
        logarithm = half * np.log(np.pi * level) - math.lgamma(half + 1)
        return float(np.exp(logarithm - np.linalg.slogdet(P)[1] / 2))

    def bounding_box(self) -> Box:
        """Return the smallest box around it: |x_i - center_i| <= sqrt(level (P^-1)_ii). In
        NumPy."""
        P, level, center = self._values()
        reach = np.sqrt(level * np.diag(np.linalg.inv(P)))
        return Box(center - reach, center + reach)

    def boundary(self, count: int = 200) -> np.ndarray:
        """Return points (count, 2) of an ellipse, counter-clockwise, for plots. In NumPy."""
        center, L = self._ball()
        if len(L) != 2:
            fail("Ellipsoid", f"has dimension {len(L)}", "Only an ellipse can be drawn")
        count = whole("count", count, 1)
        angles = np.arange(count) * 2 * np.pi / count
        return center + np.array([np.cos(angles), np.sin(angles)]).T @ L.T

    def image(self, M: Reals, t: Reals | None = None) -> "Ellipsoid":
        """Return {M x + t : x in the set}, M (k, n) of rank k; t (k,), or None for 0. ValueError
        where the image is flat, which no Ellipsoid is."""
        P, level, center = self._values()
        M, t = affine_map(M, t, (None, len(P)))
        L = np.linalg.solve(np.linalg.cholesky(P).T, np.eye(len(P)))  # x = center + L w
        root = M @ L
        size = np.linalg.svd(root / row_lengths(root)[:, None], compute_uv=False)
        if len(M) > len(P) or not size[-1] > FLAT * size[0]:
            problem = f"has a rank below {len(M)}, so the image is flat, which no Ellipsoid is"
            fail("M", problem, "Map to fewer coordinates, or give a Zonotope")
        Q = np.linalg.inv(root @ root.T)
        return Ellipsoid((Q + Q.T) / 2, level, M @ center + t)

    def preimage(self, M: Reals, t: Reals | None = None) -> "Ellipsoid":
        """Return {x : M x + t in the set}, M (n, k) of rank k; t (n,), or None for 0. ValueError
        where it is unbounded, empty or a point."""
        P, level, center = self._values()
        M, t = affine_map(M, t, (len(P), None))
        U = np.linalg.cholesky(P).T
        root, offset = U @ M, U @ (center - t)
        size = np.linalg.svd(root / row_lengths(root.T), compute_uv=False)
        if M.shape[1] > len(P) or not size[-1] > FLAT * size[0]:
            problem = f"has a rank below {M.shape[1]}, so the set is unbounded"
            fail("M", problem, "Give a matrix of full column rank")
        # |root x - offset|^2 <= level
        middle = np.linalg.lstsq(root, offset, rcond=None)[0]
        left = level - float(np.sum((root @ middle - offset) ** 2))
        if not left > 0:
            fail("Ellipsoid", "is empty there, or a point, which no Ellipsoid is", "Use a Polytope")
        return Ellipsoid(root.T @ root, left, middle)

    def slice(self, values: Mapping[int, float]) -> "Ellipsoid":
        """Return the section with some coordinates fixed, {axis: value, ...}, in the others.
        ValueError where it is empty, or a point."""
        n = self.dimension
        fixed, at, rest = section(values, n)
        t = np.zeros(n)
        t[fixed] = at
        return self.preimage(np.eye(n)[:, rest], t)

    def translate(self, by: Reals) -> "Ellipsoid":
        """Return {x + by : x in the set}, by (n,)."""
        P, level, center = self._values()
        return Ellipsoid(P, level, center + vector("by", by, len(P)))

    def minkowski_sum(self, other: Any) -> NoReturn:
        """Raise ValueError: the sum of an ellipsoid and a set is none of the sets here."""
        problem = "of an Ellipsoid is none of the sets here"
        fail("minkowski_sum", problem, "Add their supports; move it by `E + x`")

    def pontryagin_difference(self, other: Any) -> NoReturn:
        """Raise ValueError: that from an ellipsoid is none of the sets here."""
        problem = "from an Ellipsoid is none of the sets here"
        fail("pontryagin_difference", problem, "Take it from a Box or Polytope; move it by `E - x`")

    def intersect(self, other: Any) -> NoReturn:
        """Raise ValueError: the intersection with an ellipsoid is none of the sets here."""
        problem = "with an Ellipsoid is none of the sets here"
        fail("intersect", problem, "Ask both whether they contain a point, or give a Polytope")

    def chebyshev(self) -> tuple[np.ndarray, float]:
        """Return (center, radius) of the largest ball inside."""
        P, level, center = self._values()
        return center, math.sqrt(level / np.linalg.eigvalsh(P)[-1])

    def sample(self, count: int, seed: int = 0) -> np.ndarray:
        """Return points (count, n) uniformly distributed over it; the same ones for the same
        seed."""
        center, L = self._ball()
        random, n = generator(seed), len(L)
        ball = random.standard_normal((sample_size(count), n))
        ball *= (random.uniform(size=(count, 1)) ** (1 / n)) / np.linalg.norm(
            ball, axis=1, keepdims=True
        )
        return center + ball @ L.T

    def _ball(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (center, L) of the set {center + L w : |w| <= 1}."""
        P, level, center = self._values()
        # P = U'U and x = center + sqrt(level) U^-1 w.
        return center, math.sqrt(level) * np.linalg.inv(np.linalg.cholesky(P).T)

    def _closest(self, x: np.ndarray) -> np.ndarray:
        # y = x - s P (y - center), s >= 0 so that y is on the boundary.
        P, level, center = self._values()
        values, V = np.linalg.eigh(P)
        apart = V.T @ (x - center)
        if values @ apart**2 <= level:
            return x.copy()
        excess = lambda s: values @ (apart / (1 + s * values)) ** 2 / level - 1
        most = 1 / values[0]
        while excess(most) > 0:
            most *= 2
        s = scipy.optimize.brentq(excess, 0.0, most, xtol=1e-300, rtol=8.9e-16)
        return center + V @ (apart / (1 + s * values))

    def _covers(self, other: BasicSet, tolerance: float) -> bool:
        P, level, center = self._values()
        return other.is_bounded() and other._farthest(P, center) <= level * (1 + tolerance)

    def _farthest(self, P: np.ndarray, center: np.ndarray) -> float:
        # max |root w + offset|^2 over |w| <= 1: at (mu - D) w = g in coordinates of the
        # eigenvectors of root'root, mu > max D (Moré & Sorensen 1983, SIAM J. Sci. Comput. 4).
        own, L = self._ball()
        R = np.linalg.cholesky(P).T
        root, offset = R @ L, R @ (own - center)
        D, V = np.linalg.eigh(root.T @ root)
        g = V.T @ (root.T @ offset)
        value = lambda w: float(np.sum((root @ (V @ w) + offset) ** 2))
        excess = lambda mu: float(np.sum((g / (mu - D)) ** 2)) - 1
        low, high = D[-1] * (1 + 1e-12), 2 * (D[-1] + float(np.linalg.norm(g)))
        if excess(low) > 0:
            return value(g / (scipy.optimize.brentq(excess, low, high, rtol=8.9e-16) - D))
        # No g along the last eigenvector: w goes along it, either way, as far as it may.
        w = g / (low - D)
        w[-1] = 0.0
        last = np.eye(len(D))[-1] * np.sqrt(max(1 - w @ w, 0.0))
        return max(value(w + last), value(w - last))

    def _values(self) -> tuple[np.ndarray, float, np.ndarray]:
        self.validate("Ellipsoid")
        P = host_array("Ellipsoid.P", self.P)
        center = np.zeros(len(P)) if self.center is None else host_array("center", self.center)
        return (P + P.T) / 2, float(host_array("Ellipsoid.level", self.level)), center

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        shape = np.shape(as_array(self.P))
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            fail(f"{argument}.P", f"shape {shape} is not (n, n)", "Give a square matrix")
        require_dimension(argument, shape[0], dimension)
        require_shape(f"{argument}.level", as_array(self.level), (), "Give one number")
        if self.center is not None:
            require_shape(f"{argument}.center", self.center, shape[:1], "Give one entry a state")
