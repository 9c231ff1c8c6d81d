"""Ellipsoids about the origin: {x : x'P x <= level}."""

import math

import numpy as np

from jaxmpc.arrays import Reals, as_array, host_array, store_floats
from jaxmpc.checks import concrete, fail, require_shape, require_symmetric_psd
from jaxmpc.pytrees import pytree
from jaxmpc.qp.linalg import solve
from jaxmpc.sets.box import Box
from jaxmpc.sets.convex_set import (
    AnyNumber,
    AnyTruth,
    ConvexSet,
    numbers,
    product,
    require_dimension,
)


@pytree
class Ellipsoid(ConvexSet):
    """{x in R^n : x'P x <= level}, centered at the origin.

    Arguments:
        P: (n, n), symmetric positive definite.
        level: a number > 0.
    """

    P: Reals
    level: Reals

    def __post_init__(self) -> None:
        store_floats(self, "P", "level")

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

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether x'P x <= level + tolerance, x of shape (n,)."""
        self._require_vector("x", x, "point")
        xp, (P, level, x, tolerance) = numbers(self.P, self.level, x, tolerance)
        return product(xp, x, product(xp, P, x)) <= level + tolerance

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the ellipsoid = sqrt(level d'P^-1 d), d of shape (n,)."""
        self._require_vector("d", d, "direction")
        xp, (along, P, level) = numbers(d, self.P, self.level)
        solved = np.linalg.solve(P, along) if xp is np else solve(P, along)
        return xp.sqrt(level * (along @ solved))

    def volume(self) -> float:
        """Return the volume pi^(n/2) / Gamma(n/2 + 1) level^(n/2) / sqrt(det P). In NumPy."""
        P, level = self._values()
        half = len(P) / 2
        logarithm = half * np.log(np.pi * level) - math.lgamma(half + 1)
        return float(np.exp(logarithm - np.linalg.slogdet(P)[1] / 2))

    def bounding_box(self) -> Box:
        """Return the smallest box around it: |x_i| <= sqrt(level (P^-1)_ii). In NumPy."""
        P, level = self._values()
        reach = np.sqrt(level * np.diag(np.linalg.inv(P)))
        return Box(-reach, reach)

    def boundary(self, count: int = 200) -> np.ndarray:
        """Return points (count, 2) of an ellipse, counter-clockwise, for plots. In NumPy."""
        P, level = self._values()
        if len(P) != 2:
            fail("Ellipsoid", f"has dimension {len(P)}", "Only an ellipse can be drawn")
        angles = np.arange(count) * 2 * np.pi / count
        # P = L L' and x = L'^-1 w give x'Px = |w|^2.
        circle = math.sqrt(level) * np.array([np.cos(angles), np.sin(angles)])
        return np.linalg.solve(np.linalg.cholesky(P).T, circle).T

    def _values(self) -> tuple[np.ndarray, float]:
        self.validate("Ellipsoid")
        P = host_array("Ellipsoid.P", self.P)
        return (P + P.T) / 2, float(host_array("Ellipsoid.level", self.level))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        shape = np.shape(as_array(self.P))
        if len(shape) != 2 or shape[0] != shape[1] or not shape[0]:
            fail(f"{argument}.P", f"shape {shape} is not (n, n)", "Give a square matrix")
        require_dimension(argument, shape[0], dimension)
        require_shape(f"{argument}.level", as_array(self.level), (), "Give one number")
