"""One physics step of a MuJoCo model in MJX, and how it is differentiated."""

import contextlib
import copy
import io
import warnings
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.extend.core import ClosedJaxpr, Literal, jaxpr_as_fun
from jax.extend.core.primitives import sqrt_p

from jaxmpc.checks import fail
from jaxmpc.qp.linalg import JAXLIB, solve, stand_ins
from jaxmpc.robots.rewrite import moving, rewritten
from jaxmpc.robots.tangent import normalised, retract

if TYPE_CHECKING:
    import mujoco


# mjtIntegrator.
EULER, RK4 = 0, 1

# mjtDisableBit.
NO_CONSTRAINTS = 1

# How many operations XLA of old jaxlibs may fuse on a CPU.
PIECE = 15


class Physics:
    """A mujoco.MjModel and its mjx.Model; two are equal only if they are the same object.

    model: the mujoco.MjModel. mjx: mjx.Model with NumPy arrays, in float64 in either mode of JAX.
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

    def step(self, x: Array, u: Array, numbers: Mapping[str, Any] | None = None) -> Array:
        """Return x = (qpos, qvel, act) one physics step later: a function of x, u and nothing
        carried along.

        numbers: fields of mjx.Model to replace. Differentiable in all three, forward and reverse;
        with constraints by `with_forward_jacobian`.
        """
        numbers = jax.tree.map(jnp.asarray, dict(numbers or {}))
        if self.model.opt.disableflags & NO_CONSTRAINTS:
            return in_pieces(rewritten(self._step, stand_ins()))(x, u, numbers)
        step = in_pieces(rewritten(self._step, {**stand_ins(), sqrt_p: root}))
        return with_forward_jacobian(step)(x, u, numbers)

    def _step(self, x: Array, u: Array, numbers: dict[str, Array]) -> Array:
        mjx = mjx_module()
        cast = lambda tree: jax.tree.map(
            lambda v: jnp.asarray(v, x.dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v, tree
        )
        # A copy for each program. JAX caches by identity how it converted NumPy arrays, also for
        # programs of the other precision, and MJX passes it arrays of the model.
        model = cast(copy.deepcopy(self.mjx).replace(**numbers))
        blank, h = cast(mjx.make_data(self.model)), model.opt.timestep
        x_q, v, act = jnp.split(x, [self.model.nq, self.model.nq + self.model.nv])
        q = normalised(self.joints, x_q)
        forward = lambda q, v: accelerated(model, blank.replace(qpos=q, qvel=v, act=act, ctrl=u))
        if self.model.opt.integrator == RK4:
            return self._runge_kutta(forward, q, v, h)
        integrate = mjx.euler if self.model.opt.integrator == EULER else mjx.implicit
        after = integrate(model, forward(x_q, v))
        v = after.qvel
        # MJX's own integration of positions has the derivative 0 for a body that does not turn.
        return jnp.concatenate([retract(self.joints, q, h * v), v, after.act])

    def _runge_kutta(self, forward: Callable, q: Array, v: Array, h: Array) -> Array:
        """Return (qpos, qvel) after a step of length h by the classical method of fourth order.

        MJX's own method cannot be used: its tableau is a NumPy array of the module, which the
        caching described in `_step` makes fail in the second of two precisions.
        """
        move = lambda rate: retract(self.joints, q, h * rate)

        def stage(carry: tuple, weights: Array) -> tuple[tuple, None]:
            rate, acceleration, rates, accelerations = carry
            a, b = weights
            moved, rate = move(a * rate), v + a * h * acceleration
            acceleration = forward(moved, rate).qacc
            return (rate, acceleration, rates + b * rate, accelerations + b * acceleration), None

        table = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], v.dtype)
        end, _ = jax.lax.scan(in_pieces(stage), (jnp.zeros_like(v),) * 4, table)
        return jnp.concatenate([move(end[2]), v + h * end[3]])


def accelerated(model: Any, data: Any) -> Any:
    """Return mjx.Data with the accelerations and constraint forces at its state, as mjx.forward
    does."""
    mjx = mjx_module()
    for part in (mjx.fwd_position, mjx.fwd_velocity, mjx.fwd_actuation, mjx.fwd_acceleration):
        data = part(model, data)
    rows = data._impl
    if rows.efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth)
    # Rows of contacts that do not touch exert no force; the derivative of their distance does not
    # always exist.
    idle = jnp.all(rows.efc_J == 0, axis=1) & (rows.efc_aref == 0)
    still = lambda v: jnp.where(idle, jax.lax.stop_gradient(v.T), v.T).T
    data = data.tree_replace(
        {f"_impl.{key}": still(getattr(rows, key)) for key in ("efc_J", "efc_D", "efc_aref")}
    )
    a = constrained(model, data)
    return data.replace(qacc=a, qfrc_constraint=_constraint_forces(model, data, a))


@jax.custom_jvp
def constrained(model: Any, data: Any) -> Array:
    """Return the accelerations (nv,) by MJX's constraint solver.

    The derivatives are those of the balance of forces (implicit function theorem), not of the
    solver's iterations: these have none where elliptic contacts do not touch, and err as much as
    the iterates do.
    """
    return mjx_module().solve(model, data).qacc


def _balance(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    """Return the accelerations and their derivative by the implicit function theorem."""
    a = constrained(*primals)

    def missing(a: Array, model: Any, data: Any) -> Array:
        carried = mjx_module().mul_m(model, data, a) - data.qfrc_smooth
        return carried - _constraint_forces(model, data, a)

    of, at, directions = moving(lambda *rest: missing(a, *rest), primals, tangents)
    matrix = jax.jacfwd(missing)(a, *primals)
    return a, -solve((matrix + matrix.T) / 2, jax.jvp(of, at, directions)[1])


constrained.defjvp(_balance, symbolic_zeros=True)


def _constraint_forces(model: Any, data: Any, a: Array) -> Array:
    """Return the generalised forces (nv,) of the constraints under the accelerations a (nv,)."""
    from mujoco.mjx._src.solver import Context

    return Context.create(model, data.replace(qacc=a), grad=False).qfrc_constraint


@jax.custom_jvp
def _root(x: Array) -> Array:
    return jax.lax.sqrt(x)


@_root.defjvp
def _root_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    y = _root(*primals)
    inside = y > 0
    return y, jnp.where(inside, tangents[0] / (2 * jnp.where(inside, y, 1)), 0)


def root(x: Array, **_: Any) -> Array:
    """Return the square root, with the derivative 0 at 0 instead of an infinite one.

    MJX computes lengths by it that can be 0, such as the distance of a point inside a cylinder, and
    the chain rule multiplies infinity by 0 there.
    """
    return _root(x)


def mjx_module() -> Any:
    """Import mujoco.mjx without its message on stdout that Warp is not installed, and return it."""
    with contextlib.redirect_stdout(io.StringIO()):
        from mujoco import mjx
    return mjx


def in_pieces(function: Callable, size: int = PIECE) -> Callable:
    """Return the same function of arrays, split into parts of `size` operations that XLA does not
    fuse.

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
    """Return the same function of pytrees, its derivative a Jacobian made by forward mode.

    Reverse mode then transposes one matrix product instead of the function. It stores one Jacobian
    a step, and does not multiply infinite derivatives, as those of distances of shapes
    that do not touch can be, by zeros.
    """
    wrapped = jax.custom_jvp(function)

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        of, at, directions = moving(lambda *args: (function(*args),) * 2, primals, tangents)
        jacobians, value = jax.jacfwd(of, argnums=tuple(range(len(at))), has_aux=True)(*at)
        products = (
            jnp.tensordot(J, d, d.ndim, precision="highest")
            for J, d in zip(jacobians, directions, strict=True)
        )
        return value, sum(products, jnp.zeros_like(value))

    wrapped.defjvp(rule, symbolic_zeros=True)
    return wrapped
