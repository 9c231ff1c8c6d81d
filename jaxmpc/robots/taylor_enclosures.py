"""Enclosures of a function of JAX and its first two derivatives over boxes, by its own program.

The traced program is run in NumPy (`traced_programs.py`), on polynomials of Taylor of second order
in place of numbers: value, gradient and Hessian, each an interval that holds them on the whole box.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from jaxmpc.checks import fail
from jaxmpc.robots.intervals import (
    Interval,
    add,
    common,
    cosine,
    guarded,
    multiply,
    negative,
    point,
    reciprocal,
    root,
    sine,
    square,
    subtract,
    total,
)
from jaxmpc.robots.traced_programs import Move, TracedProgram, for_product


class Taylor:
    """Arrays of functions on boxes: values, first and second derivatives in some variables.

    variables: those that the functions depend on. of: an Interval (K, 2 boxes, *shape), K = 1 + k +
    k (k + 1)/2 for k variables: the value, ∂_i, and ∂_i ∂_j for i ≤ j, on each box and then at a
    point in each. steps: Interval (boxes, d), the boxes less these points.
    """

    def __init__(self, variables: tuple[int, ...], of: Interval, steps: Interval) -> None:
        self.variables, self.of, self.steps = variables, of, steps

    @property
    def boxes(self) -> int:
        """Return the number of boxes."""
        return len(self.steps.lower)

    def on_steps(self, other: "Taylor") -> "Taylor":
        """Return the same functions on the boxes of another one in more variables, whose first
        variables these are."""
        return Taylor(self.variables, self.of, other.steps)

    def narrowed(self) -> "Taylor":
        """Return the same functions, their values and first derivatives on the boxes narrowed to
        what follows from those at the points and the second derivatives: f(c) + f'(c) s + s'Hs/2
        and f'(c) + H s. It undoes what terms that cancel one another have widened."""
        k, B = len(self.variables), self.boxes
        axes = (1,) * len(self.shape)
        s = self.steps[:, self.variables].mapped(lambda v: v.T.reshape(k, B, *axes))
        at, bend = self.of[: 1 + k, B:], self.of[1 + k :, :B]
        place = np.zeros((k, k), int)
        i, j = np.triu_indices(k)
        place[i, j] = place[j, i] = np.arange(len(i))
        change = total(multiply(bend[place], s[None]), 1)  # H s (k, boxes, ...)
        half = multiply(point(0.5), change)
        of = Interval(self.of.lower.copy(), self.of.upper.copy())
        of[1 : 1 + k, :B] = common(of[1 : 1 + k, :B], add(at[1:], change))
        value = add(at[0], total(multiply(add(at[1:], half), s), 0))
        of[0, :B] = common(of[0, :B], value)
        return Taylor(self.variables, of, self.steps)

    @property
    def shape(self) -> tuple[int, ...]:
        """Return the shape of the array of functions."""
        return self.of.lower.shape[2:]

    def mapped(self, function: Callable[[np.ndarray], np.ndarray]) -> "Taylor":
        """Return what a function that only moves entries makes of it."""
        return Taylor(self.variables, self.of.mapped(function), self.steps)

    def entries(self, move: Move) -> "Taylor":
        """Return what an operation of a program that only moves entries makes of it."""
        return self.mapped(lambda ends: move(ends, 2))

    def spread(self, axes: int) -> "Taylor":
        """Return a single function (shape ()) with this many axes; others as they are."""
        if self.shape or not axes:
            return self
        return self.mapped(lambda ends: ends.reshape(*ends.shape, *(1,) * axes))

    def on(self, variables: tuple[int, ...]) -> "Taylor":
        """Return the same functions with derivatives in more variables."""
        if variables == self.variables:
            return self
        places = [0, *(1 + variables.index(i) for i in self.variables)]
        pairs = {pair: 1 + len(variables) + k for k, pair in enumerate(_pairs(variables))}
        places += [pairs[pair] for pair in _pairs(self.variables)]
        wide = _zeros(len(variables), *self.of.lower.shape[1:])
        wide[places] = self.of
        return Taylor(variables, wide, self.steps)

    def __add__(self, other: "Taylor | np.ndarray") -> "Taylor":
        if not isinstance(other, Taylor):
            other = _constant(other, self)
        a, b = _aligned([self, other])
        return Taylor(a.variables, add(a.of, b.of), a.steps).narrowed()

    def __neg__(self) -> "Taylor":
        return Taylor(self.variables, negative(self.of), self.steps)

    def __sub__(self, other: "Taylor | np.ndarray") -> "Taylor":
        return self + (-other)

    def __mul__(self, other: "Taylor | np.ndarray") -> "Taylor":
        if not isinstance(other, Taylor):
            factor = np.asarray(other, np.float64)
            of = multiply(self.spread(factor.ndim).of, point(factor))
            return Taylor(self.variables, of, self.steps)
        if other is self:
            return self.composed(square(self.of[0]), multiply(point(2.0), self.of[0]), point(2.0))
        a, b = _aligned([self, other])
        k = len(a.variables)
        found = add(multiply(a.of[:1], b.of), multiply(b.of[:1], a.of))
        found[0] = multiply(a.of[0], b.of[0])
        i, j = (1 + ends for ends in np.triu_indices(k))
        crossed = add(multiply(a.of[i], b.of[j]), multiply(a.of[j], b.of[i]))
        found[1 + k :] = add(found[1 + k :], crossed)
        return Taylor(a.variables, found, a.steps).narrowed()

    def composed(self, value: Interval, slope: Interval, bend: Interval) -> "Taylor":
        """Return φ of the functions: enclosures of φ, φ′ and φ″ on their values are given."""
        k, of = len(self.variables), self.of
        found = multiply(slope, of)
        found[0] = value
        i, j = (1 + ends for ends in np.triu_indices(k))
        crossed = multiply(of[i], of[j])
        same = (i == j).reshape(-1, *(1,) * (crossed.lower.ndim - 1))
        squares = np.where(same, np.maximum(crossed.lower, 0), crossed.lower)
        crossed = Interval(squares, crossed.upper)
        found[1 + k :] = add(found[1 + k :], multiply(bend, crossed))
        return Taylor(self.variables, found, self.steps).narrowed()

    def inverted(self) -> "Taylor":
        """Return one over the functions."""
        value = reciprocal(self.of[0])
        second = multiply(square(value), value)
        return self.composed(value, negative(square(value)), multiply(point(2.0), second))

    def summed(self, axes: Sequence[int]) -> "Taylor":
        """Return sums over axes of the array of functions."""
        of = total(self.of, tuple(2 + i for i in axes))
        return Taylor(self.variables, of, self.steps).narrowed()


def variables(box: Interval, points: np.ndarray, which: Sequence[int]) -> Taylor:
    """Return the variables of these numbers as functions on boxes (boxes, d) with points (boxes, d)
    in them."""
    which, k = tuple(which), len(which)
    of, each = _zeros(k, 2 * len(points), k), np.arange(k)
    ends = (np.vstack([end, points])[:, which] for end in (box.lower, box.upper))
    of[0] = Interval(*ends)
    of[1 + each, :, each] = point(1.0)
    return Taylor(which, of, subtract(box, point(points)))


def _zeros(k: int, *shape: int) -> Interval:
    """Return zeros for functions of k variables, to be written into."""
    size = 1 + k + k * (k + 1) // 2
    return Interval(np.zeros((size, *shape)), np.zeros((size, *shape)))


def _pairs(variables: tuple[int, ...]) -> list[tuple[int, int]]:
    i, j = np.triu_indices(len(variables))
    return [(variables[a], variables[b]) for a, b in zip(i, j, strict=True)]


def _constant(value: Any, like: Taylor) -> Taylor:
    """Return a constant as a function with zero derivatives."""
    value = np.asarray(value, np.float64)
    of = _zeros(len(like.variables), like.of.lower.shape[1], *value.shape)
    of[0] = point(value)
    return Taylor(like.variables, of, like.steps)


def _aligned(values: Sequence[Taylor]) -> list[Taylor]:
    """Return functions with derivatives in the variables of them all, single ones (shape ()) with
    as many axes as the others."""
    every = tuple(sorted({i for v in values for i in v.variables}))
    axes = max(len(v.shape) for v in values)
    return [v.spread(axes).on(every) for v in values]


def _cosine(x: Taylor, **_: Any) -> Taylor:
    value, slope = cosine(x.of[0]), negative(sine(x.of[0]))
    return x.composed(value, slope, negative(value))


def _sine(x: Taylor, **_: Any) -> Taylor:
    value = sine(x.of[0])
    return x.composed(value, cosine(x.of[0]), negative(value))


def _root(x: Taylor, **_: Any) -> Taylor:
    value = root(x.of[0])
    slope = multiply(point(0.5), reciprocal(value))
    bend = negative(multiply(point(0.5), multiply(slope, reciprocal(x.of[0]))))
    return x.composed(value, slope, bend)


def _sum(a: Taylor | np.ndarray, b: Taylor | np.ndarray, **_: Any) -> Taylor:
    return a + b if isinstance(a, Taylor) else b + a  # type: ignore[operator, return-value]


def _difference(a: Taylor | np.ndarray, b: Taylor | np.ndarray, **_: Any) -> Taylor:
    return a - b if isinstance(a, Taylor) else (-b) + a  # type: ignore[operator, return-value]


def _product(a: Taylor | np.ndarray, b: Taylor | np.ndarray, **_: Any) -> Any:
    """Return the product; that with zeros alone is a constant."""
    for factor in (a, b):
        if not isinstance(factor, Taylor) and not np.any(factor):
            return np.zeros(np.broadcast_shapes(a.shape, b.shape))
    return a * b if isinstance(a, Taylor) else b * a  # type: ignore[operator, return-value]


def _quotient(a: Taylor | np.ndarray, b: Taylor | np.ndarray, **_: Any) -> Taylor:
    if isinstance(b, Taylor):
        return _product(a, b.inverted())
    inverse = reciprocal(point(b))
    return Taylor(a.variables, multiply(a.of, inverse), a.steps)  # type: ignore[union-attr]


def _converted(x: Taylor, new_dtype: Any, **_: Any) -> Taylor:
    if not np.issubdtype(new_dtype, np.floating):
        fail("robot", "its program rounds to whole numbers", "Take a smooth model")
    return x


def _power(x: Taylor, y: int, **_: Any) -> Any:
    if y == 0:
        return np.ones(x.shape)
    found = x
    for _step in range(abs(y) - 1):
        found = x * found if found is not x else x * x
    return found if y > 0 else found.inverted()


def _larger(a: Taylor | np.ndarray, b: Taylor | np.ndarray, sign: float = 1.0, **_: Any) -> Taylor:
    """Return max(a, b), for sign −1 min(a, b), where it is always the one that is no constant, as
    beside limits that are infinite or not reached."""
    x, limit = (a, b) if isinstance(a, Taylor) else (b, a)
    if isinstance(limit, Taylor):
        fail("robot", "its program compares two results", "Take a smooth model")
    of = x.of[0] if sign > 0 else negative(x.of[0])  # type: ignore[union-attr]
    if not np.all(of.lower >= sign * limit):
        fail("robot", "its program has a limit that is reached", "Take a model without that limit")
    return x  # type: ignore[return-value]


def _compared(
    a: Taylor | np.ndarray, b: Taylor | np.ndarray, compare: Callable[..., np.ndarray], **_: Any
) -> np.ndarray:
    """Return what a comparison with infinite limits says of all numbers."""
    sides = [np.zeros(v.shape) if isinstance(v, Taylor) else v for v in (a, b)]
    limit = b if isinstance(a, Taylor) else a
    if isinstance(limit, Taylor) or not np.all(np.isinf(limit)):
        fail("robot", "its program compares results", "Take a model without limits of forces")
    return compare(*sides)


def _contracted(
    a: Taylor | np.ndarray, b: Taylor | np.ndarray, dimension_numbers: Any, **_: Any
) -> Any:
    x, y, axes = for_product(a, b, dimension_numbers)
    product = _product(x, y)
    if not isinstance(product, Taylor):
        return product.sum(axis=axes)
    return product.summed(axes) if axes else product


RULES: dict[str, Callable[..., Any]] = {
    **{"add": _sum, "add_any": _sum, "sub": _difference, "mul": _product, "div": _quotient},
    **{"neg": lambda x, **_: -x, "square": lambda x, **_: x * x, "integer_pow": _power},
    **{"cos": _cosine, "sin": _sine, "sqrt": _root, "convert_element_type": _converted},
    "rsqrt": lambda x, **_: _root(x).inverted(),
    **{"max": _larger, "min": lambda a, b, **_: _larger(a, b, -1.0)},
    **{
        name: partial(_compared, compare=compare)
        for name, compare in (
            *(("gt", np.greater), ("ge", np.greater_equal), ("eq", np.equal)),
            *(("lt", np.less), ("le", np.less_equal), ("ne", np.not_equal)),
        )
    },
    "reduce_sum": lambda x, axes, **_: x.summed(axes),
    "dot_general": _contracted,
}


class TaylorProgram(TracedProgram):
    """A function of JAX as a program on boxes, see `TracedProgram`.

    `program(box, points)`, an Interval (boxes, d) in all d numbers of its arguments and a point
    (boxes, d) in each, returns the leaves of the result as `Taylor`s, or as arrays where they are
    constant.

    Raises ValueError, naming the operation, where the function has one without a rule here, such as
    loops, branches and maxima, and ZeroDivisionError where an enclosure that is divided by holds 0
    (take smaller boxes).
    """

    kind, rules = Taylor, RULES

    def __call__(self, box: Interval, points: np.ndarray) -> list:
        starts = np.cumsum([0, *self.sizes])
        args = [
            variables(box, points, range(start, start + size))
            for start, size in zip(starts, self.sizes, strict=False)
        ]
        with guarded():
            return self.evaluated(args)

    def joined(self, operands: Sequence) -> Taylor:
        """Return flat operands one after the other."""
        like = next(v for v in operands if isinstance(v, Taylor))
        parts = _aligned([v if isinstance(v, Taylor) else _constant(v, like) for v in operands])
        ends = (
            np.concatenate([getattr(part.of, end) for part in parts], axis=-1)
            for end in ("lower", "upper")
        )
        return Taylor(parts[0].variables, Interval(*ends), like.steps)

    def unknown(self, eqn: Any, given: Sequence) -> list:
        """Raise ValueError."""
        name = eqn.primitive.name
        problem = f"its program has the operation {name}, whose range over a box is not known here"
        fail("robot", problem, "Take rigid bodies with motors: no contacts, tendons or loops")
