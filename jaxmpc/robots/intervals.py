"""Arithmetic with intervals in NumPy, rounded outward: what is returned holds every value that the
operation has on numbers of the intervals, in real numbers and not in floating-point ones.

An operation of float64 errs by half a unit in the last place at most; an interval is widened by
2^-52 of its ends, which is more. Numbers so small that this fails raise FloatingPointError inside
`guarded`. Sines and cosines are those of NumPy, taken to be right within 2^-50.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from jaxmpc.pytrees import record

UNIT = 2.0**-52
# What NumPy's sines and cosines may be off: its own tables say less than 4 of 2^-53.
OFF = 2.0**-50
# Beyond this the number of periods is not known well enough to look for maxima.
FAR_ANGLE = 1e4


@record
class Interval:
    """[lower, upper], two arrays of one shape."""

    lower: np.ndarray
    upper: np.ndarray

    def __getitem__(self, index: Any) -> "Interval":
        return Interval(self.lower[index], self.upper[index])

    def __setitem__(self, index: Any, values: "Interval") -> None:
        self.lower[index] = values.lower
        self.upper[index] = values.upper

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Interval":
        """Return what a function that only moves entries makes of both ends."""
        return Interval(function(self.lower), function(self.upper))


def guarded() -> Any:
    """Return a context in which numbers too small or too large raise FloatingPointError."""
    return np.errstate(under="raise", over="raise", invalid="raise", divide="raise")


def point(value: Any) -> Interval:
    """Return the interval that holds one number, exactly."""
    value = np.asarray(value, np.float64)
    return Interval(value, value)


def outward(lower: np.ndarray, upper: np.ndarray) -> Interval:
    """Return the interval widened by what one rounding may have changed; 0 is exact."""
    return Interval(lower - np.abs(lower) * UNIT, upper + np.abs(upper) * UNIT)


def add(a: Interval, b: Interval) -> Interval:
    """Return a + b."""
    return outward(a.lower + b.lower, a.upper + b.upper)


def negative(a: Interval) -> Interval:
    """Return −a."""
    return Interval(-a.upper, -a.lower)


def subtract(a: Interval, b: Interval) -> Interval:
    """Return a − b."""
    return add(a, negative(b))


def multiply(a: Interval, b: Interval) -> Interval:
    """Return a b."""
    ends = a.lower * b.lower, a.lower * b.upper, a.upper * b.lower, a.upper * b.upper
    lower = np.minimum(np.minimum(ends[0], ends[1]), np.minimum(ends[2], ends[3]))
    upper = np.maximum(np.maximum(ends[0], ends[1]), np.maximum(ends[2], ends[3]))
    return outward(lower, upper)


def square(a: Interval) -> Interval:
    """Return a², which is never negative."""
    ends = a.lower * a.lower, a.upper * a.upper
    across = (a.lower <= 0) & (a.upper >= 0)
    found = outward(np.minimum(*ends), np.maximum(*ends))
    return Interval(np.where(across, 0.0, found.lower), found.upper)


def reciprocal(a: Interval) -> Interval:
    """Return 1 / a. Raises ZeroDivisionError where a holds 0."""
    if np.any((a.lower <= 0) & (a.upper >= 0)):
        raise ZeroDivisionError("an interval that holds 0 is divided by")
    return outward(1 / a.upper, 1 / a.lower)


def root(a: Interval) -> Interval:
    """Return √a. Raises ZeroDivisionError unless a is above 0: √ has no derivative at 0."""
    if np.any(a.lower <= 0):
        raise ZeroDivisionError("the root of an interval that holds 0 or less")
    return outward(np.sqrt(a.lower), np.sqrt(a.upper))


def cosine(a: Interval) -> Interval:
    """Return cos a."""
    return _wave(a, np.cos, 0.0)


def sine(a: Interval) -> Interval:
    """Return sin a."""
    return _wave(a, np.sin, 0.5)


def _wave(a: Interval, wave: Any, shift: float) -> Interval:
    """Return the range of a sine or cosine, largest at (2 k + shift) π and least half a period
    on."""
    ends = wave(a.lower), wave(a.upper)
    # Extrema that lie next to the interval only are counted too: it widens the range.
    near = 1e-9
    first = np.ceil(a.lower / np.pi - shift - near)
    last = np.floor(a.upper / np.pi - shift + near)
    far = np.maximum(np.abs(a.lower), np.abs(a.upper)) > FAR_ANGLE
    even = (2 * np.ceil(first / 2) <= last) | far
    odd = (2 * np.ceil((first - 1) / 2) + 1 <= last) | far
    lower = np.where(odd, -1.0, np.maximum(np.minimum(*ends) - OFF, -1.0))
    upper = np.where(even, 1.0, np.minimum(np.maximum(*ends) + OFF, 1.0))
    return Interval(lower, upper)


def total(a: Interval, axis: int | tuple[int, ...]) -> Interval:
    """Return the sum over axes."""
    axes = np.atleast_1d(axis) % a.lower.ndim
    terms = int(np.prod([a.lower.shape[i] for i in axes]))
    off = terms * UNIT
    over = tuple(int(i) for i in axes)
    lower, upper = a.lower.sum(axis=over), a.upper.sum(axis=over)
    sizes = np.abs(a.lower).sum(axis=over), np.abs(a.upper).sum(axis=over)
    return Interval(lower - off * sizes[0], upper + off * sizes[1])


def dot(a: Interval, b: Interval) -> Interval:
    """Return Σ_i a_i b_i over the last axis."""
    return total(multiply(a, b), -1)


def matrix_product(a: Interval, b: Interval) -> Interval:
    """Return the matrix a b (…, i, k) of a (…, i, j) and b (…, j, k)."""
    return total(multiply(a[..., :, :, None], b[..., None, :, :]), -2)


def hull(a: Interval, b: Interval) -> Interval:
    """Return the least interval that holds both."""
    return Interval(np.minimum(a.lower, b.lower), np.maximum(a.upper, b.upper))


def common(a: Interval, b: Interval) -> Interval:
    """Return what two enclosures of the same number have in common."""
    return Interval(np.maximum(a.lower, b.lower), np.minimum(a.upper, b.upper))
