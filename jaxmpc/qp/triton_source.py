"""The text of a kernel as a function of Triton, from its jaxpr.

Each equation is a line, `v3 = v1 + v2`; loops and branches assign the variables of their results.
The memory of an instance of a batch begins at the pointer `p0`, `p1`, … of an argument or result.
"""

import functools
import hashlib
import linecache
import math
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.extend.core import Literal

from jaxmpc.qp.jax_transformations import called_jaxpr

if TYPE_CHECKING:
    from jaxmpc.qp.kernel import Kernel

# What stands before each kernel. (Of a number and NaN these are the number; with NaN instead the
# search on the dual needs twice the registers. Sums, such as a program's duality gap, keep NaN.)
HEAD = """import triton
import triton.language as tl


@triton.jit
def larger(a, b):
    return tl.maximum(a, b)


@triton.jit
def smaller(a, b):
    return tl.minimum(a, b)

"""
# Equations whose text is that of their operands, put in place. (A quotient of integers is rounded
# towards zero by both.)
OPERATIONS = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "neg": "-{}",
    "abs": "tl.abs({})",
    "square": "{0} * {0}",
    "rem": "{} % {}",
    "max": "larger({}, {})",
    "min": "smaller({}, {})",
    "eq": "{} == {}",
    "ne": "{} != {}",
    "lt": "{} < {}",
    "le": "{} <= {}",
    "gt": "{} > {}",
    "ge": "{} >= {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "xor": "{} ^ {}",
    "not": "{} == 0",
    "select_n": "tl.where({0}, {2}, {1})",
    "copy": "{}",
    "barrier": "tl.debug_barrier()",
    "program": "place",
}
REDUCTIONS = {"reduce_sum": "tl.sum({}, axis={})"} | {
    name: f"tl.reduce({{}}, {{}}, {how})"
    for name, how in [("reduce_max", "larger"), ("reduce_min", "smaller")]
}
# Of `lax.DotAlgorithmPreset`: Triton's names of it.
PRODUCTS = {"BF16_BF16_F32_X3": "bf16x3", "BF16_BF16_F32_X6": "bf16x6"}
INDENT = "    "


def triton_source(kernel: "Kernel", batched: tuple, batch: tuple[int, ...]) -> str:
    """Return the text of a kernel for a batch of programs. batched: for each argument which axes of
    the batch it has."""
    lines = _Lines()
    refs = [*kernel.inputs, *kernel.outputs]
    arguments = ", ".join(f"a{ref.number}" for ref in refs)
    flags = [*batched, *[(True,) * len(batch)] * len(kernel.outputs)]
    lines.add("number = tl.program_id(0)")
    lines.add(f"place = number % {kernel.own}" if kernel.own > 1 else "place = 0")
    lines.add(f"number = number // {kernel.own}" if kernel.own > 1 else "")
    for k in reversed(range(1, len(batch))):
        lines.add(f"i{k} = number % {batch[k]}")
        lines.add(f"number = number // {batch[k]}")
    lines.add("i0 = number")
    for ref, own in zip(refs, flags, strict=True):
        steps, size = [], math.prod(ref.shape)
        for k in reversed(range(len(batch))):
            if own[k]:
                steps.append(f"i{k}.to(tl.int64) * {size}")
                size *= batch[k]
        lines.add(" + ".join([f"p{ref.number} = a{ref.number}", *steps]))
    lines.jaxpr(kernel.jaxpr, [])
    body = "\n".join(line for line in lines.lines if line.strip())
    return f"{HEAD}\n@triton.jit\ndef {kernel.name}({arguments}):\n{body}\n"


@functools.lru_cache(maxsize=256)
def triton_function(source: str) -> Any:
    """Return the function of Triton whose text this is. (The same object for the same text: by it
    jax-triton knows what it has compiled.)"""
    name = source.rsplit("@triton.jit\ndef ", 1)[1].split("(", 1)[0]
    file = f"<{name} {hashlib.sha256(source.encode()).hexdigest()[:16]}>"
    # Triton reads the text of a function as `inspect` finds it.
    linecache.cache[file] = (len(source), None, source.splitlines(keepends=True), file)
    space: dict[str, Any] = {"__name__": "jaxmpc.qp.triton_source"}
    exec(compile(source, file, "exec"), space)  # noqa: S102
    return space[name]


class _Lines:
    """Lines of a function as they are written, and the names of variables."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.depth = 1
        self.count = 0

    def add(self, text: str) -> None:
        self.lines.append(INDENT * self.depth + text)

    def new(self, text: str) -> str:
        """Write the text's value into a variable; return its name."""
        name = f"v{self.count}"
        self.count += 1
        self.add(f"{name} = {text}")
        return name

    def jaxpr(self, closed: Any, args: list[str]) -> list[str]:
        """Write a jaxpr; return the names of its results."""
        jaxpr: Any = closed.jaxpr
        names = dict(zip(jaxpr.invars, args, strict=True))
        for v, constant in zip(jaxpr.constvars, closed.consts, strict=True):
            names[v] = _number(np.asarray(constant).item(), v.aval.dtype)

        def name(v: Any) -> str:
            kind: Any = v.aval
            return _number(v.val, kind.dtype) if isinstance(v, Literal) else names[v]

        for eqn in jaxpr.eqns:
            found = self.equation(eqn, [name(v) for v in eqn.invars])
            names |= zip(eqn.outvars, found, strict=True)
        return [name(v) for v in jaxpr.outvars]

    def equation(self, eqn: Any, given: list[str]) -> list[str]:
        """Write an equation; return the names of its results."""
        kind = eqn.primitive.name
        if kind in ("while", "cond"):
            return getattr(self, f"{kind}_")(eqn.params, given)
        if kind == "store":
            ref, (offset, value, mask) = eqn.params["ref"], given
            self.add(f"tl.store(p{ref.number} + {offset}, {value}, mask={mask})")
            return ["0"]
        if kind == "barrier":
            self.add("tl.debug_barrier()")
            return ["0"]
        inner = called_jaxpr(eqn)
        if inner is not None:
            return self.jaxpr(inner, given)
        return [self.new(self.text(eqn, given))]

    def text(self, eqn: Any, given: list[str]) -> str:
        """Return the value of an equation as a text."""
        kind, params, out = eqn.primitive.name, eqn.params, eqn.outvars[0].aval
        shapes, type_of = (
            [v.aval.shape for v in eqn.invars],
            eqn.invars and eqn.invars[0].aval.dtype,
        )
        if kind in OPERATIONS:
            return OPERATIONS[kind].format(*given)
        if kind == "load":
            offset, mask = given
            other = _number(params["other"], out.dtype)
            return f"tl.load(p{params['ref'].number} + {offset}, mask={mask}, other={other})"
        if kind == "div":
            return f"{given[0]} {'//' if type_of.kind == 'i' else '/'} {given[1]}"
        if kind == "sqrt":
            return f"tl.{'sqrt_rn' if type_of == np.float32 else 'sqrt'}({given[0]})"
        if kind == "sign":
            return f"({given[0]} > 0).to({_type(out.dtype)}) - ({given[0]} < 0)"
        if kind == "integer_pow" and params["y"] == 2:
            return f"{given[0]} * {given[0]}"
        if kind == "convert_element_type":
            return (
                f"{given[0]} != 0"
                if out.dtype.kind == "b"
                else f"{given[0]}.to({_type(out.dtype)})"
            )
        if kind == "iota":
            return f"tl.arange(0, {out.shape[0]})"
        if kind == "broadcast_in_dim":
            return _broadcast(given[0], shapes[0], out.shape, params["broadcast_dimensions"])
        if kind in ("reshape", "squeeze"):
            return f"tl.reshape({given[0]}, {list(out.shape)})"
        if kind == "transpose":
            return f"tl.permute({given[0]}, {list(params['permutation'])})"
        if kind in REDUCTIONS:
            text = given[0]
            for axis in sorted(params["axes"], reverse=True):
                text = REDUCTIONS[kind].format(text, axis)
            return text
        if kind == "cumsum" and not params["reverse"]:
            return f"tl.cumsum({given[0]}, axis={params['axis']})"
        if kind == "dot_general":
            product = PRODUCTS[params["precision"].name] if out.dtype == np.float32 else "ieee"
            precise = f"input_precision='{product}', out_dtype={_type(out.dtype)}"
            return f"tl.dot({given[0]}, {given[1]}, {precise})"
        raise NotImplementedError(f"no text in Triton for the operation {kind} of a kernel: {eqn}")

    def while_(self, params: dict, given: list[str]) -> list[str]:
        enter, body = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        # Triton takes a variable of a loop for constant if the loop's text, run once, gives it the
        # very value that it had, as t, previous = f(t), t does where both begin with the same.
        begin, copy = given[body:], "tl.where(tl.full([], True, tl.int1), {0}, {0})"
        state = [
            self.new(copy.format(text) if text in begin[:k] else text)
            for k, text in enumerate(begin)
        ]
        [go] = self.jaxpr(params["cond_jaxpr"], [*given[:enter], *state])
        go = self.new(go)
        self.add(f"while {go}:")
        self.depth += 1
        self.assign(state, self.jaxpr(params["body_jaxpr"], [*given[enter:body], *state]))
        self.assign([go], self.jaxpr(params["cond_jaxpr"], [*given[:enter], *state]))
        self.depth -= 1
        return state

    def cond_(self, params: dict, given: list[str]) -> list[str]:
        otherwise, then = params["branches"]
        results = [f"v{self.count + k}" for k in range(len(then.jaxpr.outvars))]
        self.count += len(results)
        for head, branch in ((f"if {given[0]} != 0:", then), ("else:", otherwise)):
            self.add(head)
            self.depth += 1
            self.assign(results, self.jaxpr(branch, given[1:]))
            self.depth -= 1
        return results

    def assign(self, names: list[str], values: list[str]) -> None:
        """Write that variables take values, all at once."""
        if names:
            self.add(f"{', '.join(names)} = {', '.join(values)}")


def _number(value: Any, dtype: Any) -> str:
    """Return a number of a type: as it stands Triton would take it for a float32."""
    plain = np.asarray(value).item()
    text = f"float('{plain}')" if isinstance(plain, float) and not math.isfinite(plain) else plain
    return f"tl.full([], {text}, {_type(dtype)})"


def _type(dtype: Any) -> str:
    return f"tl.{'int1' if np.dtype(dtype).kind == 'b' else dtype}"


def _broadcast(text: str, shape: tuple, out: tuple, axes: tuple[int, ...]) -> str:
    """Return an array of another shape, whose axis axes[k] is the axis k of the array."""
    if not out:
        return text
    if shape:
        places = ", ".join(":" if k in axes else "None" for k in range(len(out)))
        text = text if len(axes) == len(out) else f"{text}[{places}]"
        between = [shape[axes.index(k)] if k in axes else 1 for k in range(len(out))]
        if tuple(between) == tuple(out):
            return text
    return f"tl.broadcast_to({text}, {list(out)})"
