"""Functions of JAX, rewritten: other primitives, smaller pieces, derivatives by forward mode."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Primitive, jaxpr_as_fun

from jaxmpc.qp.jax_transformations import default_platform, kept_unvarying
from jaxmpc.qp.linalg import JAXLIB

# How many operations XLA of old jaxlibs may fuse on a CPU.
PIECE = 15


def rewritten(function: Callable, rules: Mapping[Primitive, Callable]) -> Callable:
    """Return the same function of pytrees of arrays, with the primitives of `rules` replaced.

    rules: for each primitive the function that replaces it. It takes the primitive's operands,
    its parameters as keywords, and returns what it returns: one array, or a list of them for a
    primitive with several results, of the same shapes and types. Bodies of jit, scan, while, cond,
    checkpoint and custom_jvp are rewritten too, the last with their rules. Not rewritten are rules
    of custom_vjp and what JAX does not show in a jaxpr (the parts of custom_root since 0.12).

    The result can be differentiated, batched and compiled like the function itself; its derivatives
    are those of the replacements.
    """

    def run(*args: Any) -> Any:
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        out = _evaluated(closed, rules, jax.tree.leaves(args))
        return jax.tree.unflatten(jax.tree.structure(shape), out)

    return run


def _evaluated(closed: ClosedJaxpr, rules: Mapping[Primitive, Callable], args: Sequence) -> list:
    """Evaluate the traced function, equation by equation, and return its outputs."""
    jaxpr = closed.jaxpr
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*closed.consts, *args), strict=True))
    read = lambda v: v.val if isinstance(v, Literal) else values[v]
    for eqn in jaxpr.eqns:
        if eqn.primitive in rules:
            made = rules[eqn.primitive](*map(read, eqn.invars), **eqn.params)
            made = made if eqn.primitive.multiple_results else [made]
        else:
            given = list(dict.fromkeys(v for v in eqn.invars if not isinstance(v, Literal)))
            params = {key: _replaced(value, rules) for key, value in eqn.params.items()}
            alone = lambda eqn, given=given: jaxpr_as_fun(
                ClosedJaxpr(
                    jaxpr.replace(constvars=[], invars=given, outvars=eqn.outvars, eqns=[eqn]), ()
                )
            )
            apply = alone(eqn.replace(params=params))
            if eqn.primitive.name == "custom_jvp_call":
                apply = _with_rule(apply, alone(eqn), rules)
            made = apply(*map(read, given))
        values.update(zip(eqn.outvars, made, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _with_rule(values: Callable, original: Callable, rules: Mapping[Primitive, Callable]) -> Any:
    """Return the function `values`, its derivative that of `original`, rewritten."""
    stand_in = jax.custom_jvp(values)

    def rule(primals: tuple, tangents: tuple) -> tuple:
        of, at, directions = moving(original, primals, tangents)
        return rewritten(lambda *pair: jax.jvp(of, *pair), rules)(at, directions)

    stand_in.defjvp(rule, symbolic_zeros=True)
    return stand_in


def _holds(value: Any, rules: Mapping[Primitive, Callable]) -> bool:
    """Return whether a traced function, or one among parameters, has a primitive to replace."""
    if isinstance(value, ClosedJaxpr | Jaxpr):  # one class since JAX 0.12
        return any(eqn.primitive in rules or _holds(eqn.params, rules) for eqn in value.eqns)
    if isinstance(value, dict):
        return any(_holds(part, rules) for part in value.values())
    return isinstance(value, tuple | list) and any(_holds(part, rules) for part in value)


def _replaced(value: Any, rules: Mapping[Primitive, Callable]) -> Any:
    """Return a parameter with the traced functions in it rewritten."""
    if not _holds(value, rules):
        return value
    if isinstance(value, tuple | list):
        parts = [_replaced(part, rules) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else type(value)(parts)
    closed = value if isinstance(value, ClosedJaxpr) else ClosedJaxpr(value, ())
    shapes = [
        jax.ShapeDtypeStruct(aval.shape, aval.dtype, weak_type=aval.weak_type)
        for aval in closed.in_avals
    ]
    new = jax.make_jaxpr(lambda *args: _evaluated(closed, rules, args))(*shapes)
    return new if isinstance(value, ClosedJaxpr) else new.jaxpr


def moving(function: Callable, primals: Sequence, tangents: Sequence) -> tuple:
    """Return what a rule of `jax.custom_jvp` with symbolic zeros differentiates: `function` of the
    leaves of its arguments whose tangent is not zero, these leaves of the primals, and their
    tangents."""
    leaves, tree = jax.tree.flatten(tuple(primals))
    is_zero = lambda t: isinstance(t, SymbolicZero)
    directions = jax.tree.leaves(tuple(tangents), is_leaf=is_zero)
    which = [i for i, t in enumerate(directions) if not is_zero(t)]

    def of(*values: Any) -> Any:
        new = list(leaves)
        for i, value in zip(which, values, strict=True):
            new[i] = value
        return function(*jax.tree.unflatten(tree, new))

    return of, tuple(leaves[i] for i in which), tuple(directions[i] for i in which)


def in_pieces(function: Callable, size: int = PIECE) -> Callable:
    """Return the same function of arrays, split into parts of `size` operations that XLA does not
    fuse.

    XLA's CPU backend of jaxlib 0.7 to 0.11.0 (the newest for Python 3.11) fuses long chains of
    small operations, joint after joint, and then computes the beginning of the chain again for each
    number that depends on it: a linear model of 7 joints takes 800 times as long. With any
    other version or device the function is left as it is.
    """

    def run(*args: Any) -> Any:
        if default_platform() != "cpu" or JAXLIB >= (0, 11, 1):
            return function(*args)
        closed, shape = jax.make_jaxpr(function, return_shape=True)(*args)
        jaxpr, leaves = closed.jaxpr, jax.tree.leaves(args)
        values = dict(
            zip((*jaxpr.constvars, *jaxpr.invars), (*closed.consts, *leaves), strict=True)
        )
        reads = lambda eqns: dict.fromkeys(
            v for eqn in eqns for v in eqn.invars if not isinstance(v, Literal)
        )
        for start in range(0, len(jaxpr.eqns), size):
            eqns, later = jaxpr.eqns[start : start + size], jaxpr.eqns[start + size :]
            ends = (v for v in jaxpr.outvars if not isinstance(v, Literal))
            needed = reads(later) | dict.fromkeys(ends)
            made = [v for eqn in eqns for v in eqn.outvars if v in needed]
            given = [v for v in reads(eqns) if v in values]
            piece = jaxpr.replace(constvars=[], invars=given, outvars=made, eqns=eqns)
            out = jaxpr_as_fun(ClosedJaxpr(piece, ()))(*(values[v] for v in given))
            values.update(zip(made, jax.lax.optimization_barrier(out), strict=True))
        out = [v.val if isinstance(v, Literal) else values[v] for v in jaxpr.outvars]
        return jax.tree.unflatten(jax.tree.structure(shape), out)

    return run


def with_forward_jacobian(function: Callable) -> Callable:
    """Return the same function of pytrees, its derivative a Jacobian made by forward mode.

    Reverse mode then transposes one matrix product instead of the function. It stores one Jacobian
    a step, and does not multiply infinite derivatives, as those of distances of shapes
    that do not touch can be, by zeros. Both are `kept_unvarying`, as MJX's solver has to be.
    """
    wrapped = jax.custom_jvp(kept_unvarying(function))

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        def slopes(*primals: Any) -> Any:  # of all: what does not move may vary over a mesh
            of, at, _ = moving(lambda *args: (function(*args),) * 2, primals, tangents)
            return jax.jacfwd(of, argnums=tuple(range(len(at))), has_aux=True)(*at)

        jacobians, value = kept_unvarying(slopes)(*primals)
        directions = moving(function, primals, tangents)[2]
        products = (
            jnp.tensordot(J, d, d.ndim, precision="highest")
            for J, d in zip(jacobians, directions, strict=True)
        )
        return value, sum(products, jnp.zeros_like(value))

    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped
