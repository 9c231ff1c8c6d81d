"""A robot of MuJoCo as a plant: one control period forward, and its affine model.

A file gives two models. The plant is the model as written, except that the force limits of motors
become `input_limits`. The predictor is the same without constraint rows (joint limits, contacts,
friction loss, equalities): a stiff spring at a joint's end makes a linear model useless one sample
later, so limits belong into the MPC. Both apply inputs without MuJoCo's clamp to `ctrlrange`, whose
derivative is wrong at the bound, where MPC often operates: the controller has to keep u inside
`input_limits`.
"""

import warnings
from dataclasses import field, replace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.linalg import eigh
from jaxmpc.qp.modes import own_modes, varying
from jaxmpc.qp.precision import floating_dtype, matmul
from jaxmpc.robots.balance import lacking, nearest_rest, require_rest, rest_at, settled
from jaxmpc.robots.physics import Physics
from jaxmpc.robots.report import RobotReport, report_of
from jaxmpc.robots.tangent import difference, quaternions, retract, unit_orientations
from jaxmpc.sets.box import Box
from jaxmpc.systems.system import LinearSystem

if TYPE_CHECKING:
    import mujoco


@pytree
class Robot:
    """A MuJoCo model as a plant with sampled inputs; made by `load_robot`.

    State of the plant: x = (qpos, qvel), size nq + nv. State of models and controllers: coordinates
    ξ = (q ⊖ anchor, qvel), size n = 2 nv: hinge and slide joints as they are, free positions as
    they are, orientations as the rotation vector (rad) from that of `home`. Without quaternions
    both are the same numbers. Activation states of actuators, act (na,), stand behind qvel in both.
    The input u (m,) is MuJoCo's ctrl, held for a control period dt (s) of `substeps` physics steps.
    Units are MuJoCo's: m, rad, s, kg, N, N m.

    state_limits (in ξ), input_limits: Boxes, ±inf for no limit. home (nq + nv + na,): the set-point
    of the file. anchor (nq,): zeros, with the orientations of home. plant, predictor: `Physics`,
    constants of compiled programs (twice to ten times as fast as arguments). numbers: parameters of
    the plant that differ in a batch (masses, damping), see `vary`. notes: (kind, text) of what
    `load_robot` found, see `report`. file: the mujoco.MjModel as it was given.
    """

    state_limits: Box
    input_limits: Box
    home: Any
    plant: Physics = static()
    predictor: Physics = static()
    anchor: tuple[float, ...] = static()
    substeps: int = static()
    dt: float = static()
    name: str = static(default="")
    state_names: tuple[str, ...] = static(default=())
    state_units: tuple[str, ...] = static(default=())
    input_names: tuple[str, ...] = static(default=())
    input_units: tuple[str, ...] = static(default=())
    numbers: dict[str, Any] = field(default_factory=dict)
    notes: tuple[tuple[str, str], ...] = static(default=())
    file: Any = static(default=None)

    @property
    def mujoco(self) -> "mujoco.MjModel":
        """Return the plant as MuJoCo's own model, for rendering and the C engine."""
        return self.plant.model

    def __repr__(self) -> str:
        """Return the name and the sizes, in one line; `report` has the rest."""
        return f"Robot({self.name!r}, n={self.n}, m={self.m}, dt={self.dt:g} s)"

    @property
    def n(self) -> int:
        """Return the number of coordinates ξ, 2 nv + na."""
        return 2 * self.mujoco.nv + self.mujoco.na

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return self.mujoco.nu

    @property
    def joints(self) -> tuple[int, ...]:
        """Return the mjtJoint of each joint."""
        return tuple(int(joint) for joint in self.mujoco.jnt_type)

    @property
    def state_size(self) -> int:
        """Return the length of the state x, nq + nv + na."""
        return self.mujoco.nq + self.mujoco.nv + self.mujoco.na

    def step(self, x: Any, u: Any) -> Array:
        """Return the state x one control period later, with the input u (m,) held.

        Differentiable in x, u and the numbers of `plant`, in forward and reverse mode. Each physics
        step computes its Jacobian by forward mode, that of constraint forces by the implicit
        function theorem instead of through MJX's solver. Second derivatives: forward over either.
        """
        return _stepped(self, *self._checked_arrays(x, u))

    def _step(self, x: Array, u: Array) -> Array:
        body = lambda x, _: (self.plant.step(x, u, self.numbers), None)
        return jax.lax.scan(body, x, length=self.substeps)[0]

    def linearize(
        self, x: Any, u: Any, *, exact: bool = False, numbers: Any = None
    ) -> LinearSystem:  # fmt: skip
        """Return the affine model ξ⁺ = A ξ + B u + c of a whole control period about x (nq + nv,),
        u (m,).

        It is of the predictor, by automatic differentiation. exact=False: one physics step is
        linearised and its affine map applied `substeps` times (a tenth of the cost; on a 7-joint
        arm A is off by 1 %, B by 0.05 %). exact=True: Jacobians along the physics steps, and c such
        that the model passes through the predictor's own next state. numbers: fields of mjx.Model
        in place of the predictor's own, see `vary`.
        """
        return _linearized(self, *self._checked_arrays(x, u), numbers or {}, exact=exact)

    def _linearize(
        self, x: Array, u: Array, numbers: dict[str, Any], exact: bool
    ) -> LinearSystem:  # fmt: skip
        advance = lambda s, u: self.coordinates(self.predictor.step(self.state(s), u, numbers))

        def affine(s: Array) -> tuple[Array, Array, Array]:
            moved = lambda s, u: (advance(s, u),) * 2
            (A, B), after = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)(s, u)
            return A, B, after

        start = self.coordinates(x)
        zero = jnp.zeros((self.n, self.m), x.dtype)
        if exact:

            def chain(carry: tuple, _: None) -> tuple[tuple, None]:
                s, A, B = carry
                A_1, B_1, after = affine(s)
                return (after, matmul(A_1, A), matmul(A_1, B) + B_1), None

            first = (start, jnp.eye(self.n, dtype=x.dtype), zero)
            (after, A, B), _ = jax.lax.scan(chain, varying(first, first), length=self.substeps)
            c = after - matmul(A, start) - matmul(B, u)
        else:
            A_1, B_1, after = affine(start)
            c_1 = after - matmul(A_1, start) - matmul(B_1, u)
            A, B, c = A_1, B_1, c_1
            for _ in range(self.substeps - 1):
                A, B, c = matmul(A_1, A), matmul(A_1, B) + B_1, matmul(A_1, c) + c_1
        return LinearSystem(
            A, B, c, self.dt, state_names=self.state_names, state_units=self.state_units,
            input_names=self.input_names, input_units=self.input_units,
        )  # fmt: skip

    def transition(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return A (n, n), B (n, m) of one physics step of the plant about x, u, in tangent
        coordinates: those of mujoco.mjd_transitionFD, by automatic differentiation."""
        return _differentiated(self, *self._checked_arrays(x, u))

    def _transition(self, x: Array, u: Array) -> tuple[Array, Array]:
        nq, nv = self.mujoco.nq, self.mujoco.nv

        def motion(d: Array, u: Array) -> Array:
            moved = jnp.concatenate([retract(self.joints, x[:nq], d[:nv]), x[nq:] + d[nv:]])
            y = self.plant.step(moved, u, self.numbers)
            at = jax.lax.stop_gradient(y[:nq])
            return jnp.concatenate([difference(self.joints, at, y[:nq]), y[nq:]])

        A, B = jax.jacfwd(motion, argnums=(0, 1))(jnp.zeros(self.n, x.dtype), u)
        return A, B

    def coordinates(self, x: Any) -> Array:
        """Return ξ (n,) of a state x (nq + nv + na,)."""
        x = jnp.asarray(x)
        require_shape("x", x, (self.state_size,), "Give (qpos, qvel, act) of one robot")
        if not quaternions(self.joints):
            return x
        nq = self.mujoco.nq
        anchor = jnp.asarray(self.anchor, x.dtype)
        return jnp.concatenate([difference(self.joints, anchor, x[:nq]), x[nq:]])

    def state(self, coordinates: Any) -> Array:
        """Return x (nq + nv + na,) with the coordinates ξ (n,)."""
        xi = jnp.asarray(coordinates)
        require_shape("coordinates", xi, (self.n,), "Two numbers a dof; use jax.vmap for many")
        if not quaternions(self.joints):
            return xi
        nv = self.mujoco.nv
        anchor = jnp.asarray(self.anchor, xi.dtype)
        return jnp.concatenate([retract(self.joints, anchor, xi[:nv]), xi[nv:]])

    def equilibrium(self, q: Any = None, *, near: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u): the robot at rest in the configuration q (nq,), and the input that holds
        it.

        q: None for that of `home`; (..., nq) for many. The input (or the activation, where an
        actuator has one) balances gravity and passive forces, the least one where there are
        several. near (nq,), in place of q: the configuration nearest to it that inputs within the
        limits hold, inside the position limits: a local search, least squares of the forces and
        of the motion. Limits' springs, contacts, equalities and dry friction do not help. Computed
        outside JAX in float64 by MuJoCo's C engine.

        Raises ValueError where the actuators cannot hold q at all, or only beyond input_limits,
        and where the search from `near` ends at unbalanced forces: nothing but contact holds a
        body that stands on the ground. It names the coordinates that lack a force. Also where the
        file moves there in MuJoCo: force limits, couplings, contacts or stops take the rest away.
        """
        if near is not None:
            if q is not None:
                fail("near", "is given beside q", "Give one of them")
            require_shape("near", near, (self.mujoco.nq,), "One configuration, as in qpos")
            rest = nearest_rest(self, self._configurations("near", near))
            if not rest.held:
                fail(
                    "near", f"no configuration that can be held was found from there: "
                    f"{lacking(self, rest)}", "Start elsewhere, or give the robot what holds it",
                )  # fmt: skip
            require_rest("near", self, [rest])
            return rest.x, rest.u
        q = self._configurations("q", self.home[: self.mujoco.nq] if q is None else q)
        rests = [rest_at(self, row) for row in q.reshape(-1, q.shape[-1])]
        for rest in rests:
            if not rest.balanced:
                fail(
                    "q", f"{rest.q}: no input balances the forces; {lacking(self, rest)}",
                    "Choose a configuration that the actuators hold, or search with near=",
                )  # fmt: skip
        over = np.array([rest.over for rest in rests])
        if np.any(over > 1e-9):
            i = int(np.argmax(over.max(axis=0)))
            needed = np.array([rest.drive[i] for rest in rests])
            fail(
                "q", f"needs {self.input_names[i]} = {needed}, "
                f"the limits are [{rests[0].lower[i]:g}, {rests[0].upper[i]:g}]",
                "Choose a configuration that the actuators hold, or search with near=",
            )  # fmt: skip
        require_rest("q", self, rests)
        join = lambda rows, size: np.array(rows).reshape(*q.shape[:-1], size)
        x = join([rest.x for rest in rests], self.state_size)
        return x, join([rest.u for rest in rests], self.m)

    def set_point(self, target: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u), the state and the input about which `robot_mpc` takes its model.

        target (nq,): `equilibrium(target)`. None: `equilibrium()` at home, home moved inside the
        position limits if it is not; where that cannot be held `equilibrium(near=home)`; and where
        nothing nearby can, home at rest under the input within the limits that leaves the least
        unbalanced force. The affine model has that force in its c: it predicts a fall, and inputs
        still move what they can. Each step down this list gives a UserWarning that names the
        coordinates.
        """
        if target is not None:
            return self.equilibrium(target)
        rest, texts = settled(self)
        for text in texts:
            warnings.warn(text, stacklevel=2)
        return rest.x, rest.u

    def report(self) -> RobotReport:
        """Return an account of what was read, what is ignored, and where limits come from."""
        return report_of(self)

    def inverse_dynamics(self, q: Any, velocity: Any, acceleration: Any) -> np.ndarray:
        """Return the inputs u (..., m) that give `acceleration` (..., nv) at q (..., nq), velocity
        (..., nv).

        They are of the predictor, in continuous time. Computed outside JAX in float64 by MuJoCo's C
        engine (mj_inverse). Raises ValueError where no input does, as for a model whose actuators
        have activation states.
        """
        import mujoco

        nv = self.mujoco.nv
        if self.mujoco.na:
            fail("robot", "has activation states between inputs and forces",
                 "Inverse dynamics need actuators with dyntype none")  # fmt: skip
        q = self._configurations("q", q)
        rates = []
        for argument, value in (("velocity", velocity), ("acceleration", acceleration)):
            require_shape(argument, value, (*q.shape[:-1], nv), "One number for each dof")
            require_finite(argument, value)
            rates.append(host_array(argument, value).reshape(-1, nv))
        smooth = self.predictor.model
        data, found = mujoco.MjData(smooth), []
        for position, speed, change in zip(q.reshape(-1, q.shape[-1]), *rates, strict=True):
            data.qpos, data.qvel, data.qacc = position, speed, change
            data.ctrl = 0
            mujoco.mj_inverse(smooth, data)
            needed = data.qfrc_inverse.copy()
            forces = []
            for i in range(-1, self.m):  # forces of the actuators are affine in u
                data.ctrl = np.arange(self.m) == i
                mujoco.mj_fwdPosition(smooth, data)
                mujoco.mj_fwdVelocity(smooth, data)
                mujoco.mj_fwdActuation(smooth, data)
                forces.append(data.qfrc_actuator.copy())
            J, offset = np.array(forces[1:]).T - forces[0][:, None], forces[0]
            u = np.linalg.lstsq(J, needed - offset, rcond=None)[0]
            missing = np.abs(J @ u + offset - needed)
            if np.any(missing > 1e-6 * (1 + np.abs(needed).max())):
                dof = self.state_names[int(np.argmax(missing))]
                fail(
                    "q", f"{position}: no input balances the forces; {missing.max():.3g} are "
                    f"missing at {dof}", "Choose a motion that the actuators can make",
                )  # fmt: skip
            found.append(u)
        return np.array(found).reshape(*q.shape[:-1], self.m)

    def trajectory(self, positions: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the reference and input reference of a motion given by its positions, for
        `simulate`.

        positions (K, nv): coordinates of the joints once a control period. Returns states (K, n)
        with velocities by central differences, and inputs (K, m) by inverse dynamics. NumPy; not
        traceable. Raises ValueError for wrong shapes, or orientations that turn.
        """
        nv = self.mujoco.nv
        given = host_array("positions", positions)
        if given.ndim != 2 or given.shape[1] != nv or len(given) < 3:
            fail("positions", f"shape {given.shape}", f"Give (K, {nv}) with K ≥ 3 samples")
        require_finite("positions", given)
        turned = [i for i, name in enumerate(self.state_names[:nv]) if " rotation " in name]
        if quaternions(self.joints) and np.any(given[:, turned]):
            fail("positions", "turn a free or ball joint", "Only its translation can be given")
        velocity = np.gradient(given, self.dt, axis=0)
        acceleration = np.gradient(velocity, self.dt, axis=0)
        with jax.enable_x64(True):
            q = np.array([self.state(np.append(p, 0 * p))[: self.mujoco.nq] for p in given])
        return np.hstack([given, velocity]), self.inverse_dynamics(q, velocity, acceleration)

    def vary(self, **numbers: Any) -> "Robot":
        """Return the same robot with other numbers in its plant; models and controllers keep
        theirs.

        numbers: fields of mjx.Model by name, such as body_mass (nbody,), dof_damping (nv,),
        dof_armature, actuator_gear, dof_frictionloss (where the file has some); or payload (kg): a
        point mass at the site "tool", a number. Works under `jax.vmap`, which is how a batch gets
        a robot each; the inverse weights that shape MuJoCo's soft limits stay those of the file.
        """
        payload = numbers.pop("payload", None)
        for key, value in numbers.items():
            present: Any = getattr(self.plant.mjx, key, None)
            if key.startswith("_") or not hasattr(present, "shape"):
                fail(key, "is no array of mjx.Model", "Give fields such as body_mass, dof_damping")
            require_shape(key, value, np.shape(present), "As in robot.plant.mjx")
            require_finite(key, value)
            if key == "dof_frictionloss" and not np.all(present > 0):
                cure = "Give those joints a little frictionloss in the file"
                fail(key, "is zero for some joints of the file, which then have no such row", cure)
        varied = {**self.numbers, **numbers}
        if payload is not None:
            varied |= self._loaded(payload, varied)
        return replace(self, numbers=varied)

    def _loaded(self, payload: Any, varied: dict[str, Any]) -> dict[str, Array]:
        """Return the mass, centre and inertia of the body that carries the site "tool", with a
        point mass there: parallel axes about the new centre (Steiner), then principal axes."""
        import mujoco

        site = mujoco.mj_name2id(self.mujoco, mujoco.mjtObj.mjOBJ_SITE, "tool")
        if site < 0:
            fail("payload", "the model has no site named tool", "Add one where loads are held")
        require_shape("payload", payload, (), "Mass in kg")
        i, at = int(self.mujoco.site_bodyid[site]), jnp.asarray(self.mujoco.site_pos[site])
        of = lambda key: jnp.asarray(varied.get(key, getattr(self.plant.mjx, key)))
        mass, centre = of("body_mass")[i], of("body_ipos")[i]
        total = mass + payload
        middle = (mass * centre + payload * at) / total
        w, v = of("body_iquat")[i, 0], of("body_iquat")[i, 1:]
        cross = lambda a: jnp.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
        turn = jnp.eye(3) + 2 * w * cross(v) + 2 * matmul(cross(v), cross(v))
        inertia = matmul(turn * of("body_inertia")[i], turn.T)
        for m, p in ((mass, centre), (payload, at)):
            inertia = inertia + m * matmul(cross(p - middle).T, cross(p - middle))
        principal, axes = eigh(inertia)
        axes = axes * jnp.sign(jnp.linalg.det(axes))
        put = lambda key, value: of(key).at[i].set(value)
        return {
            "body_mass": put("body_mass", total), "body_ipos": put("body_ipos", middle),
            "body_inertia": put("body_inertia", principal),
            "body_iquat": put("body_iquat", _quaternion(axes)),
        }  # fmt: skip

    def _checked_arrays(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return a state and an input as arrays of one dtype; raise ValueError for wrong shapes."""
        size = self.state_size
        problem = "Give (qpos, qvel, act) of one robot; use jax.vmap for many"
        if np.shape(x) == (self.n,) != (size,):
            problem = "That is the size of the coordinates: robot.state(ξ) makes a state of them"
        require_shape("x", x, (size,), problem)
        require_shape("u", u, (self.m,), "One number for each actuator")
        dtype = floating_dtype((x, u))
        return jnp.asarray(x, dtype), jnp.asarray(u, dtype)

    def _configurations(self, argument: str, q: Any) -> np.ndarray:
        q = host_array(argument, q)
        if q.shape[-1:] != (self.mujoco.nq,):
            fail(argument, f"shape {q.shape}", f"Give (..., {self.mujoco.nq}), as in qpos")
        require_finite(argument, q)
        return unit_orientations(argument, self.joints, q)


# Compiled once a robot, also where the user calls them outside `jit`.
_stepped = jax.jit(own_modes(Robot._step))
_linearized = jax.jit(own_modes(Robot._linearize), static_argnames="exact")
_differentiated = jax.jit(own_modes(Robot._transition))


def _quaternion(R: Array) -> Array:
    """Return the unit quaternion (w first) of a rotation matrix: the eigenvector of Bar-Itzhack's K
    (2000, J. Guidance 23, eq. 6) with the largest eigenvalue, right for every rotation."""
    x, y, z = R[:, 0], R[:, 1], R[:, 2]
    K = jnp.array([
        [x[0] - y[1] - z[2], y[0] + x[1], z[0] + x[2], y[2] - z[1]],
        [y[0] + x[1], y[1] - x[0] - z[2], z[1] + y[2], z[0] - x[2]],
        [z[0] + x[2], z[1] + y[2], z[2] - x[0] - y[1], x[1] - y[0]],
        [y[2] - z[1], z[0] - x[2], x[1] - y[0], x[0] + y[1] + z[2]],
    ])  # fmt: skip
    q = eigh(K / 3)[1][:, -1]
    return jnp.array([q[3], q[0], q[1], q[2]])
