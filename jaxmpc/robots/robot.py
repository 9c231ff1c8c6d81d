"""A robot of MuJoCo as a plant: one control period forward, and its affine models.

A file gives two models. The plant is the model as written, except that the force limits of motors
become `input_limits`. The predictor is the same without limits of joints, forces and activations,
contacts and friction loss: a stiff spring at a joint's end makes a linear model useless one sample
later, so limits belong into the MPC. Couplings (equalities) are in both; feet that stand are held
in the predictor by forces of their own (`contacts.py`). Both apply inputs without MuJoCo's clamp to
`ctrlrange`, whose derivative is wrong at the bound, where MPC often operates: the controller has to
keep u inside `input_limits`.
"""

import warnings
from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import as_floats, host_array
from jaxmpc.checks import fail, require_finite, require_shape
from jaxmpc.pytrees import pytree, static
from jaxmpc.qp.jax_transformations import own_modes, varying
from jaxmpc.qp.linalg import matmul
from jaxmpc.robots.configurations import difference, nearest_turns, quaternions, retract
from jaxmpc.robots.contacts import standing_physics, touching_spheres
from jaxmpc.robots.couplings import MET, Couplings
from jaxmpc.robots.description import RobotDescription, host_coordinates
from jaxmpc.robots.equilibria import (
    inverse_actuation,
    lacking,
    nearest_rest,
    require_rest,
    rest_at,
    settled,
)
from jaxmpc.robots.mujoco_access import equalities, muscular
from jaxmpc.robots.parameters import require_numbers
from jaxmpc.systems.system import LinearSystem

# How far from the ends of its range the excitation of a muscle is where it is differentiated.
_INSIDE = 1e-6


@pytree
class Robot(RobotDescription):
    """A MuJoCo model as a plant with sampled inputs; made by `load_robot`.

    State of the plant: x = (qpos, qvel), size nq + nv. State of models and controllers: coordinates
    ξ = (q ⊖ anchor, qvel), size n = 2 nv: hinge and slide joints as they are, free positions as
    they are, orientations as the rotation vector (rad) from that of `home`. Without quaternions
    both are the same numbers. Activation states of actuators, act (na,), stand behind qvel in both.
    The input u (m,) is MuJoCo's ctrl, held for a control period dt (s) of `substeps` physics steps.
    Units are MuJoCo's: m, rad, s, kg, N, N m.

    state_limits (in ξ), input_limits: Boxes, ±inf for no limit. home (nq + nv + na,): the set-point
    of the file. substeps: physics steps of a control period. dt: the control period in s.
    state_names, state_units: of the n coordinates. input_names, input_units: of the m inputs.
    anchor (nq,): zeros, with the orientations of home. plant, predictor: `Physics`, constants of
    compiled programs (twice to ten times as fast as arguments). numbers: parameters of the plant
    that differ in a batch (masses, damping), see `vary`. notes: (kind, text) of what `load_robot`
    found, see `report`. file: the mujoco.MjModel as it was given. shapes:
    the mujoco.MjModel to draw, where that is another one: a URDF's with its shapes.
    """

    def step(self, x: Any, u: Any) -> Array:
        """Return the state x one control period later, with the input u (m,) held.

        Differentiable in x, u and the numbers of `plant`, in forward and reverse mode. Each physics
        step computes its Jacobian by forward mode, that of constraint forces by the implicit
        function theorem instead of through MJX's solver. Second derivatives: forward over either.
        """
        return _stepped(self, *self.checked_arrays(x, u))

    def _step(self, x: Array, u: Array) -> Array:
        body = lambda x, _: (self.plant.step(x, u, self.numbers), None)
        return jax.lax.scan(body, x, length=self.substeps)[0]

    def linearize(
        self, x: Any, u: Any, *, exact: bool = False, numbers: dict[str, Any] | None = None
    ) -> LinearSystem:
        """Return the affine model ξ⁺ = A ξ + B u + c of a whole control period about x (nq + nv,),
        u (m,).

        Rotation vectors of ξ⁺ are those nearest to those of ξ, also where these come to more than
        half a turn. It is of the predictor, by automatic differentiation. exact=False: one physics
        step is linearised and its affine map applied `substeps` times (a tenth of the cost; on a
        7-joint arm A is off by 1 %, B by 0.05 %). exact=True: Jacobians along the physics steps,
        and c such that the model passes through the predictor's own next state. A robot with
        couplings always gets this: their forces differ from one physics step to the next. numbers:
        fields of mjx.Model in place of the predictor's own, see `vary`.
        """
        x, u = self.checked_arrays(x, u)
        return RobotModel(self, numbers or {}, exact).linearize(self.coordinates(x), u)

    def _linearize(
        self, start: Array, u: Array, numbers: dict[str, Any], exact: bool
    ) -> LinearSystem:
        def step(xi: Array, u: Array) -> tuple[Array, Array]:
            after = self.coordinates(self.predictor.step(self.state(xi), u, numbers))
            after = nearest_turns(self.joints, after, xi)
            return after, after

        one = jax.jacfwd(step, argnums=(0, 1), has_aux=True)
        muscles = muscular(self.mujoco)
        if muscles.any():
            # MuJoCo clamps the excitation of muscles to [0, 1], and at rest it is 0: the derivative
            # there is that towards the inside.
            slopes, inside = one, jnp.where(muscles, jnp.clip(u, _INSIDE, 1 - _INSIDE), u)
            one = lambda xi, u: (slopes(xi, inside)[0], step(xi, u)[0])
        if exact:
            Chain = tuple[Array, Array, Array]

            def chain(carry: Chain, _: None) -> tuple[Chain, None]:
                xi, A, B = carry
                (A_1, B_1), after = one(xi, u)
                return (after, matmul(A_1, A), matmul(A_1, B) + B_1), None

            zero = jnp.zeros((self.n, self.m), start.dtype)
            first = (start, jnp.eye(self.n, dtype=start.dtype), zero)
            (after, A, B), _ = jax.lax.scan(chain, varying(first, first), length=self.substeps)
            c = after - matmul(A, start) - matmul(B, u)
        else:
            (A_1, B_1), after = one(start, u)
            A, B, c = A_1, B_1, after - matmul(A_1, start) - matmul(B_1, u)
            c_1 = c
            for _ in range(self.substeps - 1):
                A, B, c = matmul(A_1, A), matmul(A_1, B) + B_1, matmul(A_1, c) + c_1
        states: dict[str, Any] = {"state_names": self.state_names, "state_units": self.state_units}
        inputs: dict[str, Any] = {"input_names": self.input_names, "input_units": self.input_units}
        return LinearSystem(A, B, c, self.dt, **states, **inputs)

    def transition(self, x: Any, u: Any) -> tuple[Array, Array]:
        """Return A (n, n), B (n, m) of one physics step of the plant about x, u, in tangent
        coordinates: those of mujoco.mjd_transitionFD, by automatic differentiation."""
        return _differentiated(self, *self.checked_arrays(x, u))

    def _transition(self, x: Array, u: Array) -> tuple[Array, Array]:
        nq, nv = self.mujoco.nq, self.mujoco.nv

        def motion(d: Array, u: Array) -> tuple[Array, Array]:
            moved = jnp.concatenate([retract(self.joints, x[:nq], d[:nv]), x[nq:] + d[nv:]])
            return (self.plant.step(moved, u, self.numbers),) * 2

        zero = jnp.zeros(self.n, x.dtype)
        slopes, y = jax.jacfwd(motion, argnums=(0, 1), has_aux=True)(zero, u)

        def tangent(after: Array) -> Array:
            """Return the way from y to another state, both of which x moves."""
            return jnp.concatenate([difference(self.joints, y[:nq], after[:nq]), after[nq:]])

        along = lambda column: jax.jvp(tangent, (y,), (column,))[1]
        A, B = (jax.vmap(along, in_axes=1, out_axes=1)(slope) for slope in slopes)
        return A, B

    def equilibrium(self, q: Any = None, *, near: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u): the robot at rest in the configuration q (nq,), and the input that holds
        it.

        q: None for that of `home`, moved to where the couplings are met; (..., nq) for many. The
        input (or the activation, where an
        actuator has one) balances gravity and passive forces; where several do, the one of least
        squares, each input relative to half its range, or to what the load asks of it if that is
        less. Couplings carry what they can; their springs yield a little, so x lies next to q
        there, and is taken for q too. near (nq,), in place of q: the configuration nearest to it
        that inputs within the limits hold, inside the position limits: a local search, least
        squares of the forces and of the motion. Limits' springs, contacts and dry friction do not
        help. Computed
        outside JAX in float64 by MuJoCo's C engine.

        Raises ValueError where the actuators cannot hold q at all, or only beyond input_limits,
        and where the search from `near` ends at unbalanced forces: nothing but contact holds a
        body that stands on the ground. It names the coordinates that lack a force. Also where the
        file moves there in MuJoCo: force limits, couplings, contacts or stops take the rest away.
        """
        stands = hasattr(self.predictor, "feet")
        if near is not None:
            if q is not None:
                fail("near", "is given beside q", "Give one of them")
            require_shape("near", near, (self.mujoco.nq,), "One configuration, as in qpos")
            if stands:
                what = "is given for a robot that stands, whose feet hold it where they are at home"
                fail("near", what, "Give q, a configuration with the feet in their places")
            rest = nearest_rest(self, self.configurations("near", near))
            if not rest.held:
                missing = "no configuration that can be held was found from there: "
                cure = "Start elsewhere, or give the robot what holds it (`standing` on feet)"
                fail("near", missing + lacking(self, rest), cure)
            require_rest("near", self, [rest])
            return rest.x, rest.u
        if q is None:
            q = Couplings(self.predictor.model).met(self.home[: self.mujoco.nq])
        return self._equilibria("q", q)

    def _require_inside(self, argument: str, x: np.ndarray) -> None:
        """Raise ValueError where a position of the state x (nq + nv + na,) is beyond its limits."""
        xi, (lower, upper) = host_coordinates(self, x), self.state_limits.bounds()
        beyond = np.maximum(lower - xi, xi - upper) > 1e-9 * self.state_limits.half_widths()
        for i in np.flatnonzero(beyond)[:1]:
            name, unit = self.state_names[i], self.state_units[i]
            problem = f"has {name} = {xi[i]:g} {unit}, limits are [{lower[i]:g}, {upper[i]:g}]"
            fail(argument, problem, "Choose a configuration inside them")

    def _equilibria(self, argument: str, q: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u) of the robot at rest in q (..., nq), as `equilibrium`; errors name the
        argument that gave q."""
        q = self.configurations(argument, q)
        rows, couplings = q.reshape(-1, q.shape[-1]), Couplings(self.predictor.model)
        feet: Any = getattr(self.predictor, "feet", None)
        if feet is not None:
            for row in rows:
                feet.require_touching(argument, self.mujoco, row)
        rests = [rest_at(self, self._coupled(argument, row, couplings)) for row in rows]
        cure = "Choose a configuration that the actuators hold, or search for one: "
        cure += "robot.equilibrium(near=q)"
        if feet is None and not all(rest.held for rest in rests):
            if spheres := touching_spheres(self.mujoco, rows[0]):
                cure = f"Let it stand on what touches the ground: robot.standing({spheres})"
        if feet is not None:
            cure = "Choose another configuration, or give more torque, or feet with more friction"
        for rest in rests:
            if not rest.balanced or np.any(rest.over):
                self._require_inside(argument, rest.x)
            if not rest.balanced:
                missing = f"no input balances the forces; {lacking(self, rest)}"
                fail(argument, f"{rest.q}: {missing}", cure)
        over = np.array([rest.over for rest in rests])
        if np.any(over):
            i = int(np.argmax(over.max(axis=0)))
            needed = np.array([rest.drive[i] for rest in rests])
            limits = f"the limits are [{rests[0].lower[i]:g}, {rests[0].upper[i]:g}]"
            fail(argument, f"needs {self.input_names[i]} = {needed}, {limits}", cure)
        require_rest(argument, self, rests)
        x, u = (np.array([getattr(rest, name) for rest in rests]) for name in ("x", "u"))
        return x.reshape(*q.shape[:-1], self.state_size), u.reshape(*q.shape[:-1], self.m)

    def _coupled(self, argument: str, q: np.ndarray, couplings: Couplings) -> np.ndarray:
        """Return the configuration (nq,) that meets the couplings of the file: q itself, or the
        nearest one where q breaks them by at most twice what rest there does. ValueError else."""
        off = couplings.unmet(q)
        if not off:
            return q
        nearest = couplings.met(q)
        cure = f"The nearest configuration that meets them: {nearest}"
        if couplings.unmet(nearest):
            cure = "No configuration near it meets them: start elsewhere, or mend the file"
        else:
            yields = couplings.rows(rest_at(self, nearest).x[: len(q)])[0]
            if np.all(np.abs(couplings.rows(q)[0]) <= 2 * np.abs(yields) + MET):
                return nearest
        return fail(argument, f"{q} violates couplings (equalities) of the file: {off}", cure)

    def set_point(self, target: Any = None) -> tuple[np.ndarray, np.ndarray]:
        """Return (x, u), the state and the input about which `robot_mpc` takes its model.

        target (nq,): `equilibrium(target)`. None: `equilibrium()` at home, home moved inside the
        position limits if it is not; where that cannot be held `equilibrium(near=home)`; and where
        nothing nearby can, home at rest under the input within the limits that leaves the least
        unbalanced force. The affine model has that force in its c: it predicts a fall, and inputs
        still move what they can. Each step down this list gives a UserWarning that names the
        coordinates. Raises ValueError where force limits of servos alone do not hold home.
        """
        if target is not None:
            nq = (self.mujoco.nq,)
            require_shape("target", target, nq, "One configuration; `equilibrium` takes many")
            return self._equilibria("target", target)
        rest, texts = settled(self)
        for text in texts:
            warnings.warn(text, stacklevel=2)
        return rest.x, rest.u

    def inverse_dynamics(self, q: Any, velocity: Any, acceleration: Any) -> np.ndarray:
        """Return the inputs u (..., m) that give `acceleration` (..., nv) at q (..., nq), velocity
        (..., nv).

        They are of the predictor, in continuous time. Computed outside JAX in float64 by MuJoCo's C
        engine. Raises ValueError where no input does, as for a model whose actuators
        have activation states, and for robots on feet.
        """
        nv = self.mujoco.nv
        if hasattr(self.predictor, "feet"):
            cure = "At rest `equilibrium` knows them"
            fail("robot", "stands on feet, whose forces inverse dynamics do not know", cure)
        if self.mujoco.na:
            cure = "Inverse dynamics need actuators with dyntype none"
            fail("robot", "has activation states between inputs and forces", cure)
        q = self.configurations("q", q)
        motions = [q.reshape(-1, q.shape[-1])]
        for argument, value in (("velocity", velocity), ("acceleration", acceleration)):
            require_shape(argument, value, (*q.shape[:-1], nv), "One number for each dof")
            require_finite(argument, value)
            motions.append(host_array(argument, value).reshape(-1, nv))
        found = []
        for row in zip(*motions, strict=True):
            u, missing = inverse_actuation(self, *row)
            if np.any(missing):
                place = f"at {self.state_names[int(np.argmax(missing))]}"
                problem = f"no input balances the forces; {missing.max():.3g} are missing {place}"
                fail("q", f"{row[0]}: {problem}", "Choose a motion that the actuators can make")
            found.append(u)
        return np.array(found).reshape(*q.shape[:-1], self.m)

    def trajectory(self, positions: Any) -> tuple[np.ndarray, np.ndarray]:
        """Return the reference and input reference of a motion given by its positions, for
        `simulate`.

        positions (K, nv): coordinates of the joints once a control period. Returns states (K, n)
        with velocities by central differences, and inputs (K, m) by inverse dynamics; of those the
        last has no sample after it: `simulate(..., reference=states, input_reference=inputs[:-1])`.
        NumPy; not traceable. Raises ValueError for wrong shapes, or orientations that turn.
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

    def standing(self, feet: Sequence[str], *, friction: float | None = None) -> "Robot":
        """Return the same robot with a model whose feet stand where they touch the ground at home.

        feet: names of geoms, spheres, that touch something fixed. friction: coefficient μ that
        plans count on, None for 80 % of the file's. The plant is the same, with its own contacts.
        Linear models, `equilibrium` and `set_point` hold the feet still by contact forces, and
        `robot_mpc` has the friction cones as rows: see `jaxmpc/robots/contacts.py`.

        Raises ValueError for geoms that are no spheres or further than a quarter of their radius
        from the ground, and warns of those that are as deep in it; ValueError too for models
        with equalities or the integrator RK4, and where the feet hold one another.
        """
        return replace(self, predictor=standing_physics(self, feet, friction))

    def vary(self, **numbers: Any) -> "Robot":
        """Return the same robot with other numbers in its plant; models and controllers keep
        theirs.

        numbers: fields of mjx.Model by name, such as body_mass (nbody,), dof_damping (nv,),
        actuator_gear: of bodies mass, inertia, places and gravcomp, of joints axis, place, springs,
        damping, armature, dry friction and stops, of shapes place, size and contact, of tendons,
        actuators and equalities their parameters (`jaxmpc.robots.parameters.FIELDS`). Or payload
        (kg): a point mass at the site "tool", a number. Each acts as in MuJoCo's C engine, where
        nothing else of the file changes with it: inverse weights, which shape soft limits, stay.
        With other gears, gains or ranges of forces the plant clamps forces as its file says. Works
        under `jax.vmap`, which is how a batch gets a robot each. Raises ValueError for other names
        and shapes, and for negative masses.
        """
        require_numbers(self.plant, numbers)
        return replace(self, numbers={**self.numbers, **numbers})


# Compiled once a robot, also where the user calls them outside `jit`.
_stepped = jax.jit(own_modes(Robot._step))
_linearized = jax.jit(own_modes(Robot._linearize), static_argnames="exact")
_differentiated = jax.jit(own_modes(Robot._transition))


@pytree
class RobotModel:
    """The predictor of a robot (no contacts, no joint limits) in the coordinates ξ.

    numbers: in place of the file's, those of `Robot.vary` (masses, damping, payload), with
    respect to which plans can be differentiated. exact: see `Robot.linearize`; sequential quadratic
    programming needs it.
    """

    robot: Robot
    numbers: dict[str, Any] = field(default_factory=dict)
    exact: bool = static(default=True)

    def step(self, xi: Array, u: Array) -> Array:
        """Return ξ (n,) one control period later, its rotation vectors nearest to those of ξ."""
        robot = self.robot
        require_numbers(robot.predictor, self.numbers)
        advance = lambda x, _: (robot.predictor.step(x, u, self.numbers), None)
        after = jax.lax.scan(advance, robot.state(xi), length=robot.substeps)[0]
        return nearest_turns(robot.joints, robot.coordinates(after), xi)

    def linearize(self, xi: Array, u: Array) -> LinearSystem:
        """Return the affine model about ξ, u; see `Robot.linearize`."""
        robot = self.robot
        require_numbers(robot.predictor, self.numbers)
        exact = self.exact or bool(equalities(robot.predictor.model))
        xi = jnp.asarray(as_floats(xi))
        return _linearized(robot, xi, jnp.asarray(u, xi.dtype), self.numbers, exact=exact)

    def view(self, xi: Array, u: Array) -> Any:
        """Return mjx.Data at ξ under u: qpos, qvel, act, ctrl, the poses and velocities of bodies,
        geoms and sites, the forces of actuators and springs."""
        robot = self.robot
        x = jnp.asarray(robot.state(xi))
        require_numbers(robot.predictor, self.numbers)
        return robot.predictor.data(x, u, self.numbers)
