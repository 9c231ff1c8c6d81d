"""One physics step of a MuJoCo model in MJX, and how it is differentiated."""

import contextlib
import io
import re
import warnings
from collections.abc import Callable, Mapping
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun

from jaxmpc.checks import fail
from jaxmpc.robots.tangent import normalised, quaternions, retract

if TYPE_CHECKING:
    import mujoco


JAXLIB = tuple(int(part) for part in re.findall(r"\d+", version("jaxlib"))[:3])

# mjtIntegrator; it moves the configuration by several velocities, not by the last.
RK4 = 1

# Operations that old jaxlibs may fuse on a CPU.
PIECE = 15


class Physics:
    """A mujoco.MjModel and what MJX makes of it; two are equal only if they are the same object.

    model: the mujoco.MjModel. mjx: mjx.Model with host arrays, in float64 whatever JAX's mode.
    Raises ValueError for models that MJX does not support.
    """

    def __init__(self, model: "mujoco.MjModel") -> None:
        self.model = model
        self.joints = tuple(int(joint) for joint in model.jnt_type)
        try:
            with warnings.catch_warnings(), jax.enable_x64(True):
                warnings.simplefilter("ignore")
                mjx = mjx_module()
                self.mjx: Any = jax.tree.map(np.asarray, mjx.put_model(model))
                mjx.make_data(model)
        except NotImplementedError as error:
            fail("model", f"MJX does not support it: {error}", "Take that out of the file")
        if quaternions(self.joints) and model.opt.integrator == RK4:
            fail("model", "moves orientations by RK4", 'Use integrator="Euler" or "implicitfast"')

    def step(self, x: Array, u: Array, numbers: Mapping[str, Any] | None = None) -> Array:
        """x = (qpos, qvel) one physics step later: a function of x, u and nothing carried along.

        numbers: fields of mjx.Model to replace.
        """
        numbers = jax.tree.map(jnp.asarray, dict(numbers or {}))
        return in_pieces(self._step)(x, u, numbers)

    def _step(self, x: Array, u: Array, numbers: dict[str, Array]) -> Array:
        mjx = mjx_module()
        cast = lambda tree: jax.tree.map(
            lambda v: jnp.asarray(v, x.dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v, tree
        )
        blank, nq = cast(mjx.make_data(self.model)), self.model.nq
        model = cast(self.mjx.replace(**numbers))
        data = mjx.step(model, blank.replace(qpos=x[:nq], qvel=x[nq:], ctrl=u))
        q = data.qpos
        if quaternions(self.joints):
            # The same step; MJX's own has the derivative 0 for a body that does not turn.
            start = normalised(self.joints, x[:nq])
            q = retract(self.joints, start, model.opt.timestep * data.qvel)
        return jnp.concatenate([q, data.qvel])


def mjx_module() -> Any:
    """mujoco.mjx, which says on stdout that Warp is not installed when it is first imported."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def in_pieces(function: Callable, size: int = PIECE) -> Callable:
    """The same function of arrays, as pieces of `size` operations that XLA does not fuse.

    XLA's CPU backend of jaxlib 0.7 to 0.11.0 (the newest for Python 3.11) fuses long chains of
    small operations, joint after joint, and then computes the beginning of the chain again for each
    number that depends on it: a linear model of 7 joints takes 800 times as long. With any
    other version or device the function is left as it is.
    """

    def run(*args: Any) -> Any:
        if jax.default_backend() != "cpu" or not (0, 7, 0) <= JAXLIB < (0, 11, 1):
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
    """The same function of pytrees, its derivative a Jacobian made by forward mode.

    Reverse mode then transposes one matrix product instead of the function, so it works
    through while loops (MJX's constraint solver) and remembers a Jacobian a step.
    """
    wrapped = jax.custom_jvp(function)

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        leaves, tree = jax.tree.flatten(primals)
        directions = jax.tree.leaves(tangents, is_leaf=lambda t: isinstance(t, SymbolicZero))
        moving = [i for i, t in enumerate(directions) if not isinstance(t, SymbolicZero)]

        def of(*values: Array) -> tuple[Array, Array]:
            new = list(leaves)
            for i, value in zip(moving, values, strict=True):
                new[i] = value
            return (function(*jax.tree.unflatten(tree, new)),) * 2

        at = [leaves[i] for i in moving]
        jacobians, value = jax.jacfwd(of, argnums=tuple(range(len(at))), has_aux=True)(*at)
        products = (
            jnp.tensordot(J, directions[i], directions[i].ndim, precision="highest")
            for J, i in zip(jacobians, moving, strict=True)
        )
        return value, sum(products, jnp.zeros_like(value))

    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped
