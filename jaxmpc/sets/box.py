"""Boxes: {x : lower <= x <= upper}."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, as_array, dimensions, host_array, store_floats
from jaxmpc.checks import concrete, fail
from jaxmpc.pytrees import pytree
from jaxmpc.sets.convex_set import (
    AnyArray,
    AnyNumber,
    AnyTruth,
    LinearSet,
    as_floats,
    numbers,
    require_matching,
)
from jaxmpc.sets.polytope import Polytope


@pytree
class Box(LinearSet):
    """{x in R^n : lower <= x <= upper}, elementwise.

    Arguments:
        lower, upper: (n,) arrays, in the units of x; -inf and inf for no bound. A number beside an
            array stands for all its coordinates; two numbers are an interval, n = 1, and in an
            `MPC` the bounds of every coordinate.

    All methods but `contains`, `support`, `tightened` and `rows` run in NumPy, not traceable.
    """

    lower: Reals
    upper: Reals

    def __post_init__(self) -> None:
        store_floats(self, "lower", "upper")
        axes = dimensions(self.lower), dimensions(self.upper)
        if axes in ((0, 1), (1, 0)):
            one, other = ("lower", "upper") if axes[0] == 0 else ("upper", "lower")
            self._fill(one, np.shape(as_array(getattr(self, other))))

    def _fill(self, name: str, shape: tuple[int, ...]) -> None:
        value = getattr(self, name)
        full = jnp.broadcast_to if isinstance(value, jax.Array) else np.broadcast_to
        object.__setattr__(self, name, full(value, shape))
        store_floats(self, name)

    def spread(self, n: int) -> "Box":
        """Return the box with two numbers as the bounds of each of n coordinates; any other box
        unchanged."""
        if (dimensions(self.lower), dimensions(self.upper)) != (0, 0):
            return self
        box = Box(self.lower, self.upper)
        for name in ("lower", "upper"):
            box._fill(name, (n,))
        return box

    @property
    def dimension(self) -> int:
        """Return n, the number of coordinates."""
        return (np.shape(as_array(self.lower)) or (1,))[-1]

    def validate(self, argument: str, dimension: int | None = None) -> None:
        """Raise ValueError, naming `argument`, for wrong shapes, NaN or an empty box."""
        self = self.spread(1)
        self._require_fields(argument, dimension)
        if not concrete((self.lower, self.upper)):
            return
        lower, upper = self.bounds(argument)
        for name, value in (("lower", lower), ("upper", upper)):
            if np.isnan(value).any():
                fail(f"{argument}.{name}", "holds NaN", "Use -inf or inf for no bound")
        empty = (lower > upper) | (lower == np.inf) | (upper == -np.inf)
        if empty.any():
            i = int(np.argmax(empty))
            cure = "Give lower <= upper, with -inf below or inf above for no bound"
            fail(argument, f"is empty: lower[{i}] = {lower[i]:g}, upper[{i}] = {upper[i]:g}", cure)

    def contains(self, x: Reals, tolerance: float = 0.0) -> AnyTruth:
        """Return whether lower - tolerance <= x <= upper + tolerance, x of shape (n,)."""
        self = self.spread(1)
        self._require_vector("x", x, "point")
        xp, (x, lower, upper, tolerance) = numbers(x, self.lower, self.upper, tolerance)
        return xp.all((lower - tolerance <= x) & (x <= upper + tolerance))

    def support(self, d: Reals) -> AnyNumber:
        """Return max d'x over the box, d of shape (n,); inf where the box is unbounded along d."""
        self = self.spread(1)
        self._require_vector("d", d, "direction")
        xp, (along, lower, upper) = numbers(d, self.lower, self.upper)
        # The maximiser, with 0 where d is 0: there 0 * inf would be NaN.
        return along @ xp.where(along > 0, upper, xp.where(along < 0, lower, 0))

    def tightened(self, fraction: float | jax.Array) -> "Box":
        """Return the box with its two-sided coordinates narrowed on each side by a fraction of
        their half-width. Works inside jit, vmap and grad with respect to `fraction`."""
        lower, upper = np.asarray(self.lower, float), np.asarray(self.upper, float)
        half = np.where(np.isfinite(upper - lower), upper - lower, 0.0) / 2
        return Box(lower + fraction * half, upper - fraction * half)

    def half_widths(self) -> np.ndarray:
        """Return half the distance between the two ends of each coordinate, (n,); 1 where an end
        is infinite or both coincide. It is the unit of weights and tolerances."""
        lower, upper = self.spread(1).bounds()
        width = (upper - lower) / 2
        return np.where(np.isfinite(width) & (width > 0), width, 1.0)

    def rows(self) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Return (H, lower, upper) of the two-sided rows lower <= H x <= upper; H is the
        identity."""
        self = self.spread(1)
        lower, upper = as_floats(self.lower), as_floats(self.upper)
        return np.eye(self.dimension, dtype=lower.dtype), lower, upper

    def half_spaces(self) -> tuple[np.ndarray, np.ndarray]:
        """Return (H, h) of the rows H x <= h of finite bounds."""
        lower, upper = self._checked_bounds()
        identity = np.eye(len(lower))
        above, below = np.isfinite(upper), np.isfinite(lower)
        rows = np.vstack([identity[above], -identity[below]])
        return rows, np.concatenate([upper[above], -lower[below]])

    def to_polytope(self) -> Polytope:
        """Return the same set as H x <= h, with infinite bounds dropped."""
        return Polytope(*self.half_spaces())

    def intersect(self, other: LinearSet) -> "Box | Polytope":
        """Return the points in both sets: a Box with a Box (perhaps empty), else a Polytope."""
        if not isinstance(other, Box):
            return self.to_polytope().intersect(other)
        lower, upper = self._checked_bounds()
        other.validate("other", len(lower))
        lower_too, upper_too = other.bounds("other")
        return Box(np.maximum(lower, lower_too), np.minimum(upper, upper_too))

    def vertices(self) -> np.ndarray:
        """Return the corners (2^n, n), counter-clockwise in 2-D; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        corners = np.array(list(itertools.product(*zip(lower, upper, strict=True))))
        return corners[[0, 2, 3, 1]] if len(lower) == 2 else corners

    def volume(self) -> float:
        """Return the length, area or volume; ValueError if unbounded."""
        lower, upper = self._finite_bounds()
        return float(np.prod(upper - lower))

    def _require_fields(self, argument: str, dimension: int | None = None) -> None:
        require_matching(argument, {"lower": self.lower, "upper": self.upper}, 1, dimension)

    def bounds(self, argument: str = "Box") -> tuple[np.ndarray, np.ndarray]:
        """Return copies of (lower, upper) in float64. NumPy; not traceable."""
        lower = host_array(f"{argument}.lower", self.lower)
        return lower, host_array(f"{argument}.upper", self.upper)

    def _checked_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        self = self.spread(1)
        self.validate("Box")
        return self.bounds()

    def _finite_bounds(self) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self._checked_bounds()
        if not np.isfinite([lower, upper]).all():
            fail("Box", "is unbounded", "Give finite bounds in every coordinate")
        return lower, upper
