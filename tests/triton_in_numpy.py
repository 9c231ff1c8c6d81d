"""The operations of Triton that texts of kernels use, by NumPy, one program after the other.

They share nothing with how JAX runs kernels without a GPU: what a text says is tried as Python.
"""

import functools
import math
from types import SimpleNamespace

import numpy as np


class Block(np.ndarray):
    """An array with Triton's conversion of types."""

    def to(self, dtype):
        return block(self, dtype)


def block(values, dtype=None):
    return np.array(values, dtype).view(Block)


class Pointer:
    """Places in memory, an array of one axis."""

    def __init__(self, memory, offset=0):
        self.memory, self.offset = memory, offset

    def __add__(self, offset):
        return Pointer(self.memory, self.offset + offset)


def load(pointer, mask, other):
    inside = np.where(mask, pointer.offset, 0)
    assert np.all((inside >= 0) & (inside < len(pointer.memory)))
    return block(np.where(mask, pointer.memory[inside], other), pointer.memory.dtype)


def store(pointer, value, mask):
    place, value, mask = np.broadcast_arrays(pointer.offset, value, mask)
    places = place[mask]
    assert np.all((places >= 0) & (places < len(pointer.memory)))
    assert len(set(places.tolist())) == places.size  # no two write to the same place
    assert value.dtype == pointer.memory.dtype
    pointer.memory[places] = value[mask]


def dot(a, b, input_precision, out_dtype):
    assert a.dtype == b.dtype == out_dtype
    return block(np.asarray(a, float) @ np.asarray(b, float), out_dtype)


def reduce(x, axis, combine):
    return block(functools.reduce(combine, np.moveaxis(x, axis, 0)))


def language(number):
    """Return what `tl` is in program `number`."""
    return SimpleNamespace(
        int1=np.bool_,
        int32=np.int32,
        int64=np.int64,
        float32=np.float32,
        float64=np.float64,
        program_id=lambda axis: block(number, np.int32),
        arange=lambda first, end: block(np.arange(first, end), np.int32),
        full=lambda shape, value, dtype: block(np.full(shape, value), dtype),
        broadcast_to=lambda x, shape: block(np.broadcast_to(x, shape)),
        reshape=lambda x, shape: block(np.reshape(x, shape)),
        permute=lambda x, axes: block(np.transpose(x, axes)),
        where=lambda condition, a, b: block(np.where(condition, a, b)),
        abs=lambda x: block(np.abs(x)),
        maximum=lambda a, b: block(np.fmax(a, b)),
        minimum=lambda a, b: block(np.fmin(a, b)),
        sqrt=lambda x: block(np.sqrt(x)),
        sqrt_rn=lambda x: block(np.sqrt(x)),
        sum=lambda x, axis: block(np.sum(x, axis, dtype=x.dtype)),
        cumsum=lambda x, axis: block(np.cumsum(x, axis, dtype=x.dtype)),
        reduce=reduce,
        dot=dot,
        load=load,
        store=store,
        debug_barrier=lambda: None,
    )


def require_apart(text):
    """Fail where two variables of a loop begin as the same variable: Triton takes one of them for
    constant if the loop's text, run once, gives it the value that it had."""
    begins, loops = {}, []
    for line in text.splitlines():
        depth, (names, _, values) = len(line) - len(line.lstrip()), line.strip().partition(" = ")
        if line.lstrip().startswith("while "):
            loops.append(depth)
        elif values and loops and depth > loops[-1] and "," in names:
            found = [begins.get(name) for name in names.split(", ")]
            copies = [value for value in found if value in begins]
            assert len(set(copies)) == len(copies), (line, copies)
        elif values:
            begins.setdefault(names, values)


def run(text, kernel, args, batch):
    """Return the results of the text of a kernel for these arguments."""
    require_apart(text)
    head = "import triton\nimport triton.language as tl\n"
    assert text.startswith(head)
    space = {"triton": SimpleNamespace(jit=lambda function: function)}
    exec(compile(text[len(head) :], "<kernel>", "exec"), space)  # noqa: S102
    inputs = [np.array(v).reshape(-1) for v in args]
    outputs = []
    for ref in kernel.outputs:
        size = math.prod((*batch, *ref.shape))
        unset = np.nan if ref.dtype.kind == "f" else np.iinfo(ref.dtype).min
        outputs.append(np.full(size, unset, ref.dtype))
    for number in range(math.prod(batch) * kernel.own):
        space["tl"] = language(number)
        space[kernel.name](*map(Pointer, [*inputs, *outputs]))
    return [v.reshape(*batch, *ref.shape) for v, ref in zip(outputs, kernel.outputs, strict=True)]
