"""Degrees of a function of JAX as a polynomial in some of its arguments, by its own program.

Each entry of each intermediate result gets a number that its degree does not exceed: sums have the
larger one, products the sum, and any other operation is known on results of degree 0 only. These
are facts about real numbers, whatever the values.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jaxmpc.robots.traced_programs import Move, TracedProgram, for_product


class Degrees:
    """Bounds of the degrees of an array of functions: −inf for the constant 0, inf for what may be
    no polynomial."""

    def __init__(self, of: np.ndarray) -> None:
        self.of = of

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape of the array of functions."""
        return self.of.shape

    def entries(self, move: Move) -> "Degrees":
        """Return what an operation that only moves entries makes of it."""
        return Degrees(move(self.of, 0))


def polynomial_degrees(
    function: Callable, sizes: Sequence[int], degrees: Sequence[int]
) -> list[np.ndarray]:
    """Return bounds of the degrees of the entries of a function's results.

    function: of arrays of float64 of these sizes, to a pytree of arrays. degrees: of each argument;
    those of degree 0 may be in any operation. Bounds are inf where the function may be no
    polynomial in the others, and −inf where it is zero.
    """
    arguments = [Degrees(np.full(k, float(d))) for k, d in zip(sizes, degrees, strict=True)]
    return [_degrees(v) for v in _DegreesProgram(function, sizes).evaluated(arguments)]


def _degrees(x: Any) -> np.ndarray:
    return x.of if isinstance(x, Degrees) else np.where(np.asarray(x) != 0, 0.0, -np.inf)


def _sum(a: Any, b: Any, **_: Any) -> Degrees:
    return Degrees(np.maximum(_degrees(a), _degrees(b)))


def _product(a: Any, b: Any, **_: Any) -> Degrees:
    a, b = np.broadcast_arrays(_degrees(a), _degrees(b))
    zero = (a == -np.inf) | (b == -np.inf)
    return Degrees(np.where(zero, -np.inf, np.where(zero, 0, a) + np.where(zero, 0, b)))


def _quotient(a: Any, b: Any, **_: Any) -> Degrees:
    return _product(a, Degrees(np.where(_degrees(b) <= 0, 0.0, np.inf)))


def _converted(x: Degrees, new_dtype: Any, **_: Any) -> Degrees:
    if np.issubdtype(new_dtype, np.floating):
        return x
    return Degrees(np.where(x.of <= 0, x.of, np.inf))


def _power(x: Degrees, y: int, **_: Any) -> Degrees:
    if y == 0:
        return Degrees(np.zeros(x.shape))
    if y > 0:
        return Degrees(y * x.of)
    return Degrees(np.where(x.of <= 0, 0.0, np.inf))


def _contracted(a: Any, b: Any, dimension_numbers: Any, **_: Any) -> Degrees:
    x, y, axes = for_product(a, b, dimension_numbers)
    return _totalled(_product(x, y), axes)


def _totalled(x: Degrees, axes: Sequence[int], **_: Any) -> Degrees:
    return Degrees(x.of.max(axis=tuple(axes), initial=-np.inf))


def _larger(a: Any, b: Any, sign: float = 1.0, **_: Any) -> Degrees:
    """Return max(a, b), for sign −1 min(a, b): the other one beside a limit that is infinite."""
    found = Degrees(np.where(np.maximum(_degrees(a), _degrees(b)) <= 0, 0.0, np.inf))
    for x, limit in ((a, b), (b, a)):
        if not isinstance(limit, Degrees):
            free = np.broadcast_to(limit == -sign * np.inf, found.shape)
            found = Degrees(np.where(free, _degrees(x), found.of))
    return found


def _same(x: Degrees, **_: Any) -> Degrees:
    return x


_RULES: dict[str, Callable[..., Degrees]] = {
    **{"add": _sum, "add_any": _sum, "sub": _sum, "mul": _product, "div": _quotient},
    **{"neg": _same, "convert_element_type": _converted, "integer_pow": _power},
    **{"square": lambda x, **_: _product(x, x), "reduce_sum": _totalled},
    **{"dot_general": _contracted, "max": _larger},
    "min": lambda a, b, **_: _larger(a, b, -1.0),
}


class _DegreesProgram(TracedProgram):
    """A function of JAX as a program on degrees."""

    kind, rules = Degrees, _RULES

    def joined(self, operands: Sequence) -> Degrees:
        """Return flat operands one after the other."""
        return Degrees(np.concatenate([_degrees(v) for v in operands]))

    def unknown(self, eqn: Any, given: Sequence) -> list:
        """Return degree 0 where all operands have it, else inf."""
        plain = all(np.all(_degrees(v) <= 0) for v in given)
        degree = 0.0 if plain else np.inf
        return [Degrees(np.full(v.aval.shape, degree)) for v in eqn.outvars]
