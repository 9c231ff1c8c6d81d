"""One physics step of a MuJoCo model in MJX, and how it is differentiated."""

import copy
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jax.extend.core.primitives import acos_p, sqrt_p

from jaxmpc.checks import fail
from jaxmpc.qp.linalg import matmul, solve, stand_ins
from jaxmpc.robots.configurations import difference, normalised, product, rates, retract
from jaxmpc.robots.jaxpr_rewriting import in_pieces, moving, rewritten, with_forward_jacobian
from jaxmpc.robots.mujoco_access import BALL, FREE, mjx_module, mujoco
from jaxmpc.robots.parameters import DIRECTIONS, FRICTIONS, NO_FRICTION, PAYLOAD, acting_fields
from jaxmpc.robots.rigid_bodies import (
    FIELDS,
    Tree,
    dynamics,
    inverse_dynamics,
    side_by_side,
    slopes,
)

# mjtIntegrator.
EULER, RK4 = 0, 1

# mjtDisableBit, mjtEq, the last mjtTrn of a joint, and that of a site.
NO_SPRINGS, NO_GRAVITY, NO_EULER_DAMPING = 32, 128, 32768
EQUALITY_OF_JOINTS, TRANSMISSION_BY_JOINT, TRANSMISSION_BY_SITE = 2, 1, 4
# mjtJacobian.
DENSE = 0


class Physics:
    """A mujoco.MjModel and its mjx.Model; two are equal only if they are the same object.

    model: the mujoco.MjModel. mjx: mjx.Model with NumPy arrays, in float64 in either mode of JAX.
    limited: fields of the file that say which forces are limited, in force where numbers from which
    `load_robot` made limits of inputs vary. Raises ValueError for models that MJX does not support.

    Inertia, velocities and their forces are those of `rigid_bodies.py`; MJX gives the forces of
    springs, tendons and actuators, the rows of constraints and their solver.
    """

    def __init__(
        self, model: "mujoco.MjModel", limited: Mapping[str, np.ndarray] | None = None
    ) -> None:
        # Sparse matrices hold what the file's numbers fill, and `numbers` may fill more.
        self.model, self.limited = (model := copy.copy(model)), dict(limited or {})
        model.opt.jacobian = DENSE
        self._acting: dict[frozenset[str], Physics] = {}
        self.own: dict[str, tuple[int, ...]] = {PAYLOAD: ()}  # shapes of numbers beside mjx.Model's
        self.joints = tuple(int(joint) for joint in model.jnt_type)
        self.tree = Tree.of(model)
        self.filled = _filled(model)
        try:
            # Also where a program that needs it is being traced, see `acting`.
            outside = jax.ensure_compile_time_eval()
            with warnings.catch_warnings(), jax.enable_x64(True), outside:
                warnings.simplefilter("ignore")
                mjx = mjx_module()
                self.mjx: Any = jax.tree.map(np.asarray, mjx.put_model(model, impl="jax"))
                blank = mjx.make_data(model, impl="jax")
        except NotImplementedError as error:
            fluid = "fluid" in str(error)
            cure = 'Write integrator="Euler"' if fluid else "Take that out of the file"
            fail("model", f"MJX does not support it: {str(error).rstrip('.')}", cure)
        self.constraints = len(blank._impl.efc_J)
        self.rows = self.constraints > 0
        placed = blank._impl.contact.dim.size or np.any(model.eq_type != EQUALITY_OF_JOINTS)
        light = model.flg_gravcomp or np.any(model.body_gravcomp)
        in_fluid = model.opt.density or model.opt.viscosity or np.any(model.opt.wind)
        # Whether a force depends on where the bodies are, other than through the joints.
        led = np.any(model.actuator_trntype > TRANSMISSION_BY_JOINT)
        self.posed = bool(model.ntendon or light or in_fluid or led or (self.rows and placed))

    @property
    def tamed(self) -> dict[Any, Callable]:
        """Return the operations to put in place of others, for their derivatives. (No field: they
        cannot be pickled.)"""
        return TAMED if self.rows or self.model.ntendon else {}

    def acting(self, numbers: Mapping[str, Any]) -> "Physics":
        """Return the physics in whose programs these numbers act; the same one for the same names,
        so that compiled programs are found again."""
        fields = acting_fields(self.model, self.limited, numbers)
        if not fields:
            return self
        if (key := frozenset(fields)) not in self._acting:
            model = copy.copy(self.model)
            for name, value in fields.items():
                setattr(model, name, value)
            self._acting[key] = self.of(model)
        return self._acting[key]

    def of(self, model: "mujoco.MjModel") -> "Physics":
        """Return the same kind of physics of another model."""
        return Physics(model, self.limited)

    def step(self, x: Array, u: Array, numbers: Mapping[str, Any] | None = None) -> Array:
        """Return x = (qpos, qvel, act) one physics step later: a function of x, u and nothing
        carried along.

        numbers: fields of mjx.Model to replace, see `parameters.py`. Differentiable in all three,
        forward and reverse; with constraints by `with_forward_jacobian`. Computed in float64 where
        64-bit mode is on, as MJX's own numbers are then, and returned in the type of x.
        """
        if (physics := self.acting(numbers or {})) is not self:
            return physics.step(x, u, numbers)
        dtype = x.dtype
        x, u, numbers = _widest((x, u, in_force(numbers)))
        step = in_pieces(rewritten(self._step, {**stand_ins(), **self.tamed}))
        if not self.rows:
            return step(x, u, numbers).astype(dtype)
        return with_forward_jacobian(step)(x, u, numbers).astype(dtype)

    def bare_step(self, x: Array, u: Array) -> Array:
        """Return `step`, not prepared for derivatives, batches and long programs."""
        return self._step(x, u, {})

    def _step(self, x: Array, u: Array, numbers: dict[str, Array]) -> Array:
        x_q, v, act = jnp.split(x, [self.model.nq, self.model.nq + self.model.nv])
        q, h = normalised(self.joints, x_q), jnp.asarray(self.mjx.opt.timestep, x.dtype)
        if self.model.opt.integrator == RK4:
            forward = lambda q, v: self._accelerations(False, numbers, q, v, act, u)
            return self._runge_kutta(forward, q, v, h)
        moved = _next_activations(*self._forced(numbers, q, v, act, u)) if self.model.na else act
        v = v + h * self._rates(numbers, q, v, act, u)
        # MJX's own integration of positions has the derivative 0 for a body that does not turn.
        return jnp.concatenate([retract(self.joints, q, h * v), v, moved])

    def _rates(self, numbers: dict[str, Array], q: Array, v: Array, act: Array, u: Array) -> Array:
        """Return the accelerations (nv,) that a physics step goes on with."""
        return self._accelerations(True, numbers, q, v, act, u)

    def data(self, x: Array, u: Array, numbers: Mapping[str, Any] | None = None) -> Any:
        """Return mjx.Data at x = (qpos, qvel, act) under u: poses and velocities of bodies, geoms
        and sites, forces of actuators and springs (qfrc_actuator, qfrc_passive), qfrc_bias,
        inertias of bodies and of the whole (_impl.cinert, _impl.M).
        Differentiable."""
        if (physics := self.acting(numbers or {})) is not self:
            return physics.data(x, u, numbers)
        x, u, own = _widest((x, u, in_force(numbers)))
        x_q, v, act = jnp.split(x, [self.model.nq, self.model.nq + self.model.nv])
        q = normalised(self.joints, x_q)
        M, bias, poses = self._dynamics(own, q, v)
        model, data = self._forced(own, q, v, act, u)
        M = M + self._added(model, data, False)
        return data.replace(qfrc_bias=bias).tree_replace({**poses, "_impl.M": M})

    def balance(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return M (nv, nv) and the force f (nv,) at x = (qpos, qvel) under u: a step of an Euler
        method without constraints goes on with the accelerations M⁻¹ f."""
        q, v = x[: self.model.nq], x[self.model.nq :]
        model, data = self._forced({}, q, v, x[:0], u)
        M, bias, _ = self._dynamics({}, q, v)
        return M + self._added(model, data, True), data.qfrc_smooth - bias

    def _accelerations(self, damped: bool, *point: Any) -> Array:
        """Return the accelerations (nv,) at point = (numbers, q, v, act, u); damped: with the
        integrator's implicit part.

        Differentiated as the solution of the balance of forces (implicit function theorem), not by
        the iterations of MJX's solver, which err in their derivatives as much as in the
        accelerations, and have none where elliptic contacts do not touch.
        """
        solved = jax.custom_jvp(partial(self._solved, damped))

        def rule(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
            found = solved(*primals)
            of, at, directions = moving(partial(self._missing, damped, found), primals, tangents)
            of = rewritten(of, self.tamed) if self.tamed else of  # before it is differentiated
            _, missing, (first, second, C) = jax.jvp(of, at, directions, has_aux=True)
            M = self._dynamics(*primals[:3])[0]
            moved = da = jnp.zeros_like(found[0])
            if self.rows:
                K = M + first - C
                moved = da = -solve((K + K.T) / 2, missing[0])
            if damped or not self.rows:
                da = -solve(M + second, missing[1] - matmul(C, moved))
            return found, (da, moved)

        solved.defjvp(rule, symbolic_zeros=True)
        return solved(*point)[0]

    def _solved(
        self, damped: bool, numbers: dict[str, Array], q: Array, v: Array, act: Array, u: Array
    ) -> tuple[Array, Array]:
        """Return the accelerations (nv,) with and without the integrator's implicit part."""
        model, data = self._forced(numbers, q, v, act, u)
        M, bias, _ = self._dynamics(numbers, q, v)
        force = data.qfrc_smooth - bias
        pushed = first = jnp.zeros_like(v)
        if self.rows:
            first = self._constrained(model, data, M + self._added(model, data, False), force)
            if not damped:
                return first, first
            pushed = _constraint_forces(model, data, first)
        return solve(M + self._added(model, data, damped), force + pushed), first

    def _missing(
        self, damped: bool, found: tuple[Array, Array], *point: Any
    ) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        """Return the generalised forces that the accelerations `found` without and with the
        implicit part lack at point = (numbers, q, v, act, u), then what is added to M for each, and
        the derivative of the constraint forces in the accelerations."""
        (model, data), (numbers, q, v, *_) = self._forced(*point), point
        a, first = found
        forces, zero = data.qfrc_smooth, jnp.zeros_like(a)
        added = self._added(model, data, False), self._added(model, data, damped)
        lack = lambda a, added: self._inverse_dynamics(numbers, q, v, a) + matmul(added, a) - forces
        if not self.rows:
            return (zero, lack(a, added[1])), (*added, jnp.zeros_like(added[0]))
        pushed = partial(_constraint_forces, model, data)
        forces = forces + pushed(first)
        second = lack(a, added[1]) if damped else zero
        return (lack(first, added[0]), second), (*added, jax.jacfwd(pushed)(first))

    def _constrained(self, model: Any, data: Any, M: Array, force: Array) -> Array:
        """Return the accelerations by MJX's constraint solver."""
        mjx = mjx_module()
        data = data.replace(qfrc_smooth=force, qacc_smooth=solve(M, force))
        data = mjx.factor_m(model, data.tree_replace({"_impl.M": M}))
        return mjx.solve(model, data).qacc

    def _added(self, model: Any, data: Any, damped: bool) -> Array:
        """Return what tendons with inertia add to M (nv, nv), and damped: what the integrator does,
        as in mjx.euler and mjx.implicit, but for what couples branches, which MuJoCo leaves out."""
        J, h = data._impl.ten_J, model.opt.timestep
        added = matmul(J.T * model.tendon_armature, J)
        if damped and self.model.opt.integrator == EULER:
            if not self.model.opt.disableflags & NO_EULER_DAMPING:
                added = added + jnp.diag(h * model.dof_damping)
        elif damped:
            slope = mjx_module().deriv_smooth_vel(_without_saturated(model, data), data)
            added = added if slope is None else added - h * slope
        return jnp.where(self.filled, added, 0)

    def _forced(
        self, numbers: dict[str, Array], q: Array, v: Array, act: Array, u: Array
    ) -> tuple[Any, Any]:
        """Return mjx.Model and mjx.Data with the forces of springs, dampers and actuators in
        qfrc_smooth, and with the rows of constraints."""
        mjx = mjx_module()
        cast = lambda tree: jax.tree.map(
            lambda v: jnp.asarray(v, q.dtype) if jnp.issubdtype(v.dtype, jnp.floating) else v, tree
        )
        # A copy for each program. JAX caches by identity how it converted NumPy arrays, also for
        # programs of the other precision, and MJX passes it arrays of the model.
        of_model = {key: value for key, value in numbers.items() if hasattr(self.mjx, key)}
        of_model |= {key: v + NO_FRICTION for key, v in of_model.items() if key in FRICTIONS}
        model = copy.deepcopy(self.mjx).replace(**of_model)
        model = cast(model.replace(**_without_margins(model)))
        data = cast(mjx.make_data(self.model, impl="jax")).replace(qpos=q, qvel=v, act=act, ctrl=u)
        if self.posed:
            data = data.tree_replace(self._dynamics(numbers, q, v)[2])
            data = mjx.tendon(model, data)
            data = mjx.collision(model, data) if self.rows else data
        data = self._with_lengths(model, mjx.transmission(model, mjx.make_constraint(model, data)))
        speeds = {"actuator_velocity": data._impl.actuator_moment, "ten_velocity": data._impl.ten_J}
        data = data.tree_replace({f"_impl.{name}": matmul(J, v) for name, J in speeds.items()})
        data = mjx.fwd_actuation(model, self._with_passive_forces(model, data))
        force = data.qfrc_passive + data.qfrc_actuator
        if self.model.ntendon:
            force = force - mjx.tendon_bias(model, data).qfrc_bias
        data = data.replace(qfrc_smooth=force)
        # Rows of contacts that do not touch exert no force; the derivative of their distance does
        # not always exist.
        rows = data._impl
        if self.rows:
            idle = jnp.all(rows.efc_J == 0, axis=1) & (rows.efc_aref == 0)
            constant = lambda v: jnp.where(idle, jax.lax.stop_gradient(v.T), v.T).T
            names = ("efc_J", "efc_D", "efc_aref")
            data = data.tree_replace({f"_impl.{n}": constant(getattr(rows, n)) for n in names})
        return model, data

    def _with_passive_forces(self, model: Any, data: Any) -> Any:
        """Return mjx.Data with the forces of springs, dampers, fluids and gravity compensation.

        MJX's springs of orientations and tendons have the derivative 0 at rest: of a rotation by
        nothing there is no axis, and the two ends of a tendon's rest length are cases that exclude
        their end. Their forces are -k (q - q_rest) and -k J'(l - l_rest).
        """
        mjx, host = mjx_module(), self.model
        turning = np.isin(host.jnt_type, (FREE, BALL))
        stiff = np.any(host.jnt_stiffness[turning]) or np.any(host.tendon_stiffness)
        if not stiff or host.opt.disableflags & NO_SPRINGS:
            return mjx.passive(model, data)
        others = jnp.where(turning, 0, model.jnt_stiffness)
        none = jnp.zeros_like(model.tendon_stiffness)
        bare = model.replace(jnt_stiffness=others, tendon_stiffness=none)
        data, length = mjx.passive(bare, data), data.ten_length
        stiffness = (model.jnt_stiffness - others)[host.dof_jntid]
        force = -stiffness * difference(self.joints, model.qpos_spring, data.qpos)
        lower, upper = model.tendon_lengthspring.T
        rest = jnp.where(lower == upper, lower, jnp.clip(length, lower, upper))
        force = force + matmul(data._impl.ten_J.T, model.tendon_stiffness * (rest - length))
        return data.replace(qfrc_passive=data.qfrc_passive + force)

    def _with_lengths(self, model: Any, data: Any) -> Any:
        """Return mjx.Data with the lengths of actuators of ball joints, and of sites relative to
        others, by rotation vectors that have derivatives at 0 too."""
        host, lengths = self.model, data.actuator_length
        rotation = partial(difference, (BALL,))
        for i, (kind, (at, base)) in enumerate(
            zip(host.actuator_trntype, host.actuator_trnid, strict=True)
        ):
            gear = model.actuator_gear[i]
            if kind == TRANSMISSION_BY_SITE and base >= 0 and np.any(host.actuator_gear[i, 3:]):
                frames = [product(data.xquat[host.site_bodyid[s]], model.site_quat[s])
                          for s in (base, at)]  # fmt: skip
                apart = matmul(data.site_xmat[base].T, data.site_xpos[at] - data.site_xpos[base])
                turned = jnp.concatenate([apart, rotation(*frames)])
            elif kind <= TRANSMISSION_BY_JOINT and host.jnt_type[at] == BALL:
                begin = host.jnt_qposadr[at]
                none = jnp.eye(4, dtype=data.qpos.dtype)[0]
                turned, gear = rotation(none, data.qpos[begin : begin + 4]), gear[:3]
            else:
                continue
            lengths = lengths.at[i].set(jnp.dot(gear, turned))
        return data.replace(actuator_length=lengths)

    def _rigid(self, function: Callable, numbers: dict[str, Array], q: Array, *rest: Array) -> Any:
        """Return what a function of `rigid_bodies.py` does."""
        fixed = {key: np.array(getattr(self.mjx, key), q.dtype)[..., None] for key in FIELDS}
        off = bool(self.model.opt.disableflags & NO_GRAVITY)
        fixed["gravity"] = (0.0 if off else 1.0) * np.array(self.mjx.opt.gravity, q.dtype)[:, None]
        own = {key: value for key, value in numbers.items() if key in (*FIELDS, PAYLOAD)}
        call = lambda own, *rest: function(self.tree, {**fixed, **own}, *rest)
        return side_by_side(call)(jax.tree.map(lambda v: jnp.asarray(v, q.dtype), own), q, *rest)

    def _dynamics(self, numbers: dict[str, Array], q: Array, v: Array) -> tuple[Array, Array, dict]:
        """Return M (nv, nv), bias (nv,) and fields of mjx.Data."""
        return self._rigid(dynamics, numbers, q, v)

    def _inverse_dynamics(self, numbers: dict[str, Array], q: Array, v: Array, a: Array) -> Array:
        """Return M a + bias (nv,), with derivatives in closed form."""
        inverse = jax.custom_jvp(partial(self._rigid, inverse_dynamics))

        def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
            numbers, q, v, a = primals
            moved, dq, dv, da = tangents
            is_zero = lambda t: isinstance(t, SymbolicZero)
            found = jnp.zeros_like(a)
            if not all(map(is_zero, jax.tree.leaves(moved, is_leaf=is_zero))):
                inner = lambda numbers: self._rigid(inverse_dynamics, numbers, q, v, a)
                of, at, directions = moving(inner, (numbers,), (moved,))
                found = found + jax.jvp(of, at, directions)[1]
            dq = dq if is_zero(dq) else rates(self.joints, q, dq)
            for K, d in zip(self._rigid(slopes, numbers, q, v, a), (dq, dv, da), strict=True):
                found = found if is_zero(d) else found + matmul(K, d)
            return inverse(*primals), found

        inverse.defjvp(rule, symbolic_zeros=True)
        return inverse(numbers, q, v, a)

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
            acceleration = forward(moved, rate)
            return (rate, acceleration, rates + b * rate, accelerations + b * acceleration), None

        table = jnp.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]], v.dtype)
        end, _ = jax.lax.scan(in_pieces(stage), (jnp.zeros_like(v),) * 4, table)
        return jnp.concatenate([move(end[2]), v + h * end[3]])


def _without_saturated(model: Any, data: Any) -> Any:
    """Return the model whose actuators at the limit of their force have no slope in the speed: as
    in MuJoCo's own implicit integrators, and other than in MJX's."""
    if not np.any(model.actuator_forcelimited):
        return model
    low, high = model.actuator_forcerange.T
    at_limit = (data.actuator_force <= low) | (data.actuator_force >= high)
    at_limit = at_limit & (np.asarray(model.actuator_forcelimited) != 0)
    still = lambda parameters: jnp.asarray(parameters).at[:, 2].multiply(~at_limit)
    names = "actuator_gainprm", "actuator_biasprm"
    return model.replace(**{name: still(getattr(model, name)) for name in names})


def _without_margins(model: Any) -> dict[str, Any]:
    """Return the ranges of joints and tendons, narrowed by their margins, and no margins: MJX
    subtracts the margin of a stop twice. A ball joint has an upper end only."""
    fields: dict[str, Any] = {}
    for kind, two in (("jnt", model.jnt_type != BALL), ("tendon", np.ones(model.ntendon))):
        margin, ends = getattr(model, f"{kind}_margin"), getattr(model, f"{kind}_range")
        inwards = np.stack([two, -np.ones(len(two))], axis=1)
        fields[f"{kind}_range"] = ends + margin[:, None] * inwards
        fields[f"{kind}_margin"] = np.zeros(margin.shape)
    return fields


def in_force(numbers: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return numbers as arrays, directions among them with length one, as MuJoCo's compiler makes
    them."""
    unit = lambda v: v / jnp.linalg.norm(v, axis=-1, keepdims=True)
    given = {key: jnp.asarray(v) for key, v in (numbers or {}).items()}  # lists too
    return given | {key: unit(v) for key, v in given.items() if key in DIRECTIONS}


def _widest(tree: Any) -> Any:
    """Return the pytree with its floats in float64 where 64-bit mode is on, else in float32."""
    wide = jnp.result_type(float)
    number = lambda v: v.astype(wide) if jnp.issubdtype(v.dtype, jnp.floating) else v
    return jax.tree.map(lambda v: number(jnp.asarray(v)), tree)


def _filled(model: "mujoco.MjModel") -> np.ndarray:
    """Return which entries (nv, nv) MuJoCo's M has, those of two dofs on one branch of the tree of
    bodies: what is added to M is added to these alone."""
    found = np.zeros((model.nv, model.nv), bool)
    for i, (start, size) in enumerate(zip(model.M_rowadr, model.M_rownnz, strict=True)):
        columns = model.M_colind[start : start + size]
        found[i, columns] = found[columns, i] = True
    return found


def _next_activations(model: Any, data: Any) -> Array:
    """Return the activations (na,) one physics step later, as mjx.euler does."""
    from mujoco.mjx._src.forward import _next_activation

    return _next_activation(model, data, data.act_dot)


def _constraint_forces(model: Any, data: Any, a: Array) -> Array:
    """Return the generalised forces (nv,) of the constraints under the accelerations a (nv,)."""
    from mujoco.mjx._src.solver import Context

    return Context.create(model, data.replace(qacc=a), grad=False).qfrc_constraint


def _tamed(function: Callable, slope: Callable, smooth: Callable) -> Callable:
    """Return a function of arrays with the derivative `slope` where `smooth` says so, else 0.

    MJX computes lengths and angles by it at the ends of their ranges, where the derivative is
    infinite: the distance of a point inside a cylinder, the arc of a tendon that only touches. The
    chain rule multiplies infinity by 0 there.
    """
    tame = jax.custom_jvp(function)

    def rule(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
        inside = smooth(*primals)
        at = jnp.where(inside, primals[0], 0.5)
        return tame(*primals), jnp.where(inside, slope(at) * tangents[0], 0)

    tame.defjvp(rule)
    return lambda x, **_: tame(x)


TAMED = {
    sqrt_p: _tamed(jax.lax.sqrt, lambda x: 0.5 / jax.lax.sqrt(x), lambda x: x > 0),
    acos_p: _tamed(jax.lax.acos, lambda x: -jax.lax.rsqrt(1 - x * x), lambda x: jnp.abs(x) < 1),
}
