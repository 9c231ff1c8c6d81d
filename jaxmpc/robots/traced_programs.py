"""The traced program of a function of JAX, run operation by operation on what stands for numbers.

What stands for the numbers of an array is an object with `shape` and `entries`: polynomials of
Taylor on boxes (`taylor_enclosures.py`), degrees (`polynomial_degrees.py`). What does not depend on
the arguments stays an array of NumPy. Operations on constants are done once, in float64.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun

from jaxmpc.qp.jax_transformations import called_jaxpr

# A function of an array and the number of axes in front of those of the program, that only moves
# entries.
Move = Callable[[np.ndarray, int], np.ndarray]


class TracedProgram:
    """A function of JAX as a program on values of another kind.

    function: of arrays of float64 of the given sizes, to a pytree of arrays. `evaluated(args)`
    takes a value for each argument and returns the leaves of the result: values, or arrays where
    they are constant.

    A subclass says what operations do:
        kind: the class of the values. `value.shape` is that of the program's array;
            `value.entries(move)` is what a `Move` makes of it.
        rules: by the name of an operation, a function of its operands and parameters.
        joined(operands): values and constants, flat, one after the other in one value.
        unknown(eqn, given): what an operation returns for which there is no rule, or an error.
    """

    kind: type
    rules: Mapping[str, Callable]

    def __init__(self, function: Callable, sizes: Sequence[int]) -> None:
        self.sizes = tuple(sizes)
        with jax.enable_x64(True):
            self.traced: ClosedJaxpr = jax.make_jaxpr(function)(*(np.zeros(k) for k in sizes))
        # What operations on constants return, and where others move entries, each by its place.
        self.known: dict[tuple[int, ...], list] = {}

    def joined(self, operands: Sequence) -> Any:
        """Return flat operands, some of them constants, one after the other in one value."""
        raise NotImplementedError

    def unknown(self, eqn: Any, given: Sequence) -> list:
        """Return the results of an operation without a rule."""
        raise NotImplementedError

    def evaluated(self, args: Sequence) -> list:
        """Return the results for these arguments."""
        return self._evaluated(self.traced, args, ())

    def _evaluated(self, closed: ClosedJaxpr, args: Sequence, place: tuple[int, ...]) -> list:
        jaxpr = closed.jaxpr
        values = dict(zip(jaxpr.constvars, map(np.asarray, closed.consts), strict=True))
        values.update(zip(jaxpr.invars, args, strict=True))
        read = lambda v: np.asarray(v.val) if isinstance(v, Literal) else values[v]
        for number, eqn in enumerate(jaxpr.eqns):
            here, given = (*place, number), [read(v) for v in eqn.invars]
            moving, inner = any(isinstance(v, self.kind) for v in given), called_jaxpr(eqn)
            if here in self.known and not moving:
                made = self.known[here]
            elif inner is not None:
                made = self._evaluated(inner, given, here)
            elif eqn.primitive.name in ALIKE:
                made = given
            elif moving:
                made = self._moving(jaxpr, eqn, given, here)
            else:
                made = _still(jaxpr, eqn, given)
            if not moving:
                self.known[here] = made
            values.update(zip(eqn.outvars, made, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _moving(self, jaxpr: Jaxpr, eqn: Any, given: Sequence, place: tuple[int, ...]) -> list:
        """Return what an operation on values returns."""
        name = eqn.primitive.name
        if name in SHAPES:
            return [given[0].entries(lambda x, lead: SHAPES[name](x, lead, **eqn.params))]
        if name in self.rules:
            return [self.rules[name](*given, **eqn.params)]
        if name in MOVES and self._known_moves(eqn, given):
            return self._moved(jaxpr, eqn, given, place)
        return self.unknown(eqn, given)

    def _known_moves(self, eqn: Any, given: Sequence) -> bool:
        """Return whether the indices and conditions of an operation are constants."""
        return not any(
            isinstance(x, self.kind) and not np.issubdtype(v.aval.dtype, np.floating)
            for v, x in zip(eqn.invars, given, strict=True)
        )

    def _moved(self, jaxpr: Jaxpr, eqn: Any, given: Sequence, place: tuple[int, ...]) -> list:
        """Return the entries that an operation takes from its operands: found by running it on
        their numbers."""
        real = [np.issubdtype(v.aval.dtype, np.floating) for v in eqn.invars]
        if place not in self.known:
            count, numbered = 0, []
            for v, operand, is_real in zip(eqn.invars, given, real, strict=True):
                size = int(np.prod(v.aval.shape)) if is_real else 0
                ids = np.arange(count, count + size, dtype=float)
                numbered.append(ids.reshape(v.aval.shape) if is_real else operand)
                count += size
            self.known[place] = [ids.astype(int) for ids in _alone(jaxpr, eqn, numbered)]
        operands = [v for v, is_real in zip(given, real, strict=True) if is_real]
        moving = [isinstance(v, self.kind) for v in operands]
        constant = np.repeat(np.invert(moving), [int(np.prod(v.shape)) for v in operands])
        flat = [v.entries(_flat) if m else v.ravel() for v, m in zip(operands, moving, strict=True)]
        zeros = [np.zeros(v.shape) if m else v for v, m in zip(flat, moving, strict=True)]
        numbers = np.concatenate(zeros)
        everything = self.joined(flat)
        return [
            numbers[ids]
            if constant[ids].all()
            else everything.entries(lambda x, lead, ids=ids: x[(..., ids)])
            for ids in self.known[place]
        ]


def _still(jaxpr: Jaxpr, eqn: Any, given: Sequence[np.ndarray]) -> list:
    """Return what an operation on constants returns."""
    name = eqn.primitive.name
    if name in SHAPES:
        return [SHAPES[name](given[0], 0, **eqn.params)]
    if name in ON_CONSTANTS:
        return [ON_CONSTANTS[name](*given).astype(eqn.outvars[0].aval.dtype)]
    return _alone(jaxpr, eqn, given)


def _alone(jaxpr: Jaxpr, eqn: Any, given: Sequence) -> list[np.ndarray]:
    """Return what one operation returns for these operands."""
    free = {v: x for v, x in zip(eqn.invars, given, strict=True) if not isinstance(v, Literal)}
    one = jaxpr.replace(constvars=[], invars=list(free), outvars=list(eqn.outvars), eqns=[eqn])
    with jax.enable_x64(True):
        return [np.asarray(v) for v in jaxpr_as_fun(ClosedJaxpr(one, ()))(*free.values())]


# Operations that return their operands.
ALIKE = {"optimization_barrier", "copy", "copy_p", "stop_gradient", "device_put", "reshard"}


def _flat(x: np.ndarray, lead: int) -> np.ndarray:
    return x.reshape(*x.shape[:lead], -1)


def _sliced(
    x: np.ndarray, lead: int, start_indices: Any, limit_indices: Any, strides: Any
) -> np.ndarray:
    steps = strides or (1,) * len(start_indices)
    parts = map(slice, start_indices, limit_indices, steps)
    return x[(slice(None),) * lead + tuple(parts)]


def _broadcast(
    x: np.ndarray, lead: int, shape: Any, broadcast_dimensions: Any, **_: Any
) -> np.ndarray:
    sizes = [1] * len(shape)
    for size, axis in zip(x.shape[lead:], broadcast_dimensions, strict=True):
        sizes[axis] = size
    return np.broadcast_to(x.reshape(x.shape[:lead] + tuple(sizes)), x.shape[:lead] + tuple(shape))


def _transposed(x: np.ndarray, lead: int, permutation: Any) -> np.ndarray:
    return np.transpose(x, (*range(lead), *(lead + i for i in permutation)))


# Operations on shapes; `lead` axes stand before those of the program.
SHAPES: dict[str, Callable[..., np.ndarray]] = {
    "slice": _sliced,
    "broadcast_in_dim": _broadcast,
    "transpose": _transposed,
    "squeeze": lambda x, lead, dimensions, **_: np.squeeze(x, tuple(lead + i for i in dimensions)),
    "reshape": lambda x, lead, new_sizes, **_: x.reshape(x.shape[:lead] + tuple(new_sizes)),
}
# Operations that take entries from their operands, which indices and conditions say.
MOVES = {
    *("concatenate", "gather", "scatter", "select_n", "pad", "split", "stack", "unstack"),
    *("dynamic_slice", "dynamic_update_slice", "rev"),
}
# Operations on constants; all others are done by JAX, which compiles each.
ON_CONSTANTS: dict[str, Callable[..., np.ndarray]] = {
    **{"add": np.add, "sub": np.subtract, "mul": np.multiply, "neg": np.negative},
    **{"eq": np.equal, "ne": np.not_equal, "lt": np.less, "le": np.less_equal},
    **{"gt": np.greater, "ge": np.greater_equal, "and": np.bitwise_and, "or": np.bitwise_or},
    **{"max": np.maximum, "min": np.minimum, "rem": np.fmod},
}


def for_product(a: Any, b: Any, dimension_numbers: Any) -> tuple[Any, Any, tuple[int, ...]]:
    """Return the operands of `lax.dot_general`, values or constants, with axes such that its result
    is their product entry by entry, summed over the axes returned."""
    (of_a, of_b), (shared_a, shared_b) = dimension_numbers
    (x, free_x), (y, free_y) = _ordered(a, shared_a, of_a), _ordered(b, shared_b, of_b)
    batch = len(shared_a)
    x, y = _widened(x, batch + free_x, free_y), _widened(y, batch, free_x)
    first = batch + free_x + free_y
    return x, y, tuple(range(first, first + len(of_a)))


def _ordered(x: Any, shared: Sequence[int], contracted: Sequence[int]) -> tuple[Any, int]:
    """Return x with its shared axes in front and those contracted behind, and how many others."""
    own = [i for i in range(len(x.shape)) if i not in (*shared, *contracted)]
    order = (*shared, *own, *contracted)
    return _reordered(x, lambda v, lead: _transposed(v, lead, order)), len(own)


def _widened(x: Any, at: int, count: int) -> Any:
    """Return x with so many axes of size 1 more."""
    sizes = (*x.shape[:at], *(1,) * count, *x.shape[at:])
    return _reordered(x, lambda v, lead: v.reshape(v.shape[:lead] + sizes))


def _reordered(x: Any, move: Move) -> Any:
    return move(x, 0) if isinstance(x, np.ndarray) else x.entries(move)
