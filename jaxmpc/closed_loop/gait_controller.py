"""MPC of legged robots along a gait: linear models that change as feet stand and swing."""

from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, as_weight, host_array
from jaxmpc.checks import fail, number, require_kind, require_shape, require_symmetric_psd, whole
from jaxmpc.closed_loop.feedback import one_state
from jaxmpc.closed_loop.robot_controller import FORCES, softened_limits
from jaxmpc.mpc.controller import zeros_of
from jaxmpc.mpc.plan import (
    Control,
    Plan,
    WarmStart,
    applied,
    checked_array,
    reference_shapes,
    require_before,
)
from jaxmpc.mpc.problem import MPC, Soft, as_tuple
from jaxmpc.mpc.rows import layout
from jaxmpc.mpc.stagewise.solve import solve_stagewise
from jaxmpc.pytrees import prepared_pytree, static
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.linalg import arrays, floating_dtype, matmul
from jaxmpc.robots.contacts import STANDING
from jaxmpc.robots.force_limits import force_limits
from jaxmpc.robots.gaits import Gait
from jaxmpc.sets.convex_sets import Box

# The Riccati recursion over 2^40 periods of the gait counts as one that does not converge. It has
# where another pass changes it by less than this part of its largest entry.
_DOUBLINGS, _SETTLED = 40, 1e-9


# A, G and H of some steps of a Riccati recursion at once: of one they are A, B R⁻¹ B' and Q.
Steps = tuple[np.ndarray, np.ndarray, np.ndarray]


class GaitMemory(NamedTuple):
    """What a controller remembers: the last finite plan, and how many control periods it is into
    the motion, which the next plan begins with."""

    plan: WarmStart
    time: Array


@prepared_pytree
class GaitController:
    """MPC of a legged robot along a gait, stage by stage.

    At each control period the problem has the linear models of the next N, the motion of the gait
    as reference, hard limits of inputs, and as soft rows friction cones and state limits. What
    follows the horizon costs what it does under the periodic LQR of the gait. Coordinates of the
    problem, and axes of Q, are relative to the path of the trunk (`gait.relative`).

    gait: from `jm.robots.gait`. Q (n, n) or its diagonal (n,), R (m, m) or (m,): weights of the
      distances from the motion and from the torques of rest.
    horizon: control periods N.
    solver: with iterations=None, as by default, there are no ADMM steps but Newton steps from the
      last plan and an interior point method (`solve_stagewise`).
    rho: L1 weight, cost per unit, of state limits; of friction cones it is 100 times as much a unit
      of the input, as in `RobotController`.
    margin: fraction by which state limits are tightened, as in `robot_mpc`.

    `controller(x, before)` as `RobotController`. The reference is `gait.reference`, unless another
    is given, in ξ too. Raises ValueError for arguments that do not fit together, for gaits whose
    LQR does not exist, and for limits of the trunk's place or orientation where it turns.
    """

    gait: Gait
    mpc: MPC
    solver: ADMM
    rho: Any
    cost_to_go: Any
    horizon: int = static(default=1)
    place_limited: bool = static(default=False)

    def __init__(
        self,
        gait: Gait,
        Q: Reals,
        R: Reals,
        horizon: int = 30,
        *,
        solver: ADMM | None = None,
        rho: Reals = 100.0,
        margin: float = 0.02,
    ) -> None:
        require_kind("gait", gait, Gait)
        whole("horizon", horizon, 1)
        if not 0 <= margin < 1:
            fail("margin", f"{margin}", "Give a fraction in [0, 1)")
        number("rho", rho, 0.0, "Weights are at least 0")
        robot = gait.robot
        Q, R = (host_array("Q", as_weight(Q, robot.n)), host_array("R", as_weight(R, robot.m)))
        for name, weight, size in (("Q", Q, robot.n), ("R", R, robot.m)):
            require_shape(name, weight, (size, size), f"Or give its diagonal ({size},)")
        require_symmetric_psd("Q", Q)
        require_symmetric_psd("R", R, definite=True)
        if solver is not None:
            require_kind("solver", solver, ADMM)
        limited = np.any(np.isfinite(np.array(robot.state_limits.bounds())), axis=0)
        _require_free_trunk(gait, limited)
        P = periodic_cost_to_go(gait, Q, R)
        first = {name: v[0] for name, v in _matrices(gait).items()}
        limits = MPC(
            system=replace(gait.system, **first), Q=Q, R=R, horizon=horizon,
            states=robot.state_limits.tightened(margin), inputs=robot.input_limits,
            constrained_stages=tuple(range(1, horizon + 1)), terminal_cost=P[0], prestabilise=False,
        )  # fmt: skip
        solver = DEFAULT if solver is None else solver
        solver = replace(solver, iterations=0) if solver.iterations is None else solver
        with jax.ensure_compile_time_eval():
            forces = force_limits(robot, np.asarray(robot.state(gait.states[0])), gait.inputs)
        if forces is not None:
            limits = replace(limits, outputs=replace(forces, stages=tuple(range(horizon))))
        vars(self).update(gait=arrays(gait), mpc=arrays(softened_limits(limits, rho)), rho=rho)
        vars(self).update(solver=arrays(solver), cost_to_go=jnp.asarray(P), horizon=horizon)
        vars(self).update(place_limited=bool(limited[:2].any()))
        self.problem(jnp.int32(0)).validate()

    def __repr__(self) -> str:
        """Return in one line what it controls."""
        feet = ", ".join(self.gait.names)
        return f"GaitController({self.gait.robot.name} on {feet}, horizon {self.horizon})"

    @property
    def robot(self) -> Any:
        """The robot, with the model of its feet."""
        return self.gait.robot

    @property
    def dtype(self) -> Any:
        """Return the precision of the plans."""
        return floating_dtype((self.mpc.Q, self.mpc.R))

    @property
    def state_size(self) -> int:
        """Return the length of the robot's state, nq + nv."""
        return self.robot.state_size

    @property
    def limits(self) -> Box:
        """Return the robot's own state limits, without margin."""
        return self.robot.state_limits

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of the robot's state."""
        return self.robot.coordinates(x)

    def problem(self, time: Array) -> MPC:
        """Return the problem of the horizon that begins at a control period of the motion."""
        gait, N = self.gait, self.horizon
        phases = (time + jnp.arange(N)) % gait.period
        system, cones = (
            jax.tree.map(lambda v: v[phases], part) for part in (_matrices(gait), gait.cones)
        )
        size = jnp.max(jnp.abs(gait.cones.D), axis=(0, 2))
        weight = FORCES * jnp.max(jnp.asarray(self.rho)) / jnp.where(size > 0, size, 1.0)
        names = self.robot.predictor.feet.cone_names
        friction = Soft(cones.C, None, cones.upper, weight, 0.0, cones.D, tuple(range(N)), names)
        last = self.cost_to_go[(time + N) % gait.period]
        limits = as_tuple("soft", self.mpc.soft, Soft)
        if self.place_limited:
            limits = tuple(self._relative(rows, time) for rows in limits)
        return replace(
            self.mpc,
            system=replace(self.mpc.system, **system),
            soft=(*limits, friction),
            terminal_cost=last,
        )

    def _relative(self, rows: Soft, time: Array) -> Soft:
        """Return limits of ξ as those of the coordinates relative to a straight path, which differ
        from stage to stage."""
        path = self.gait.path
        seconds = (time + np.array(rows.stages)) * self.robot.dt
        away = matmul(path.places(path.home, seconds) - path.home, jnp.asarray(rows.C)[:, :2].T)
        lower, upper = rows.sides
        return replace(rows, lower=lower - away, upper=upper - away)

    def numbers_at(self, t: Any) -> dict[str, Any]:
        """Return which feet stand at the control period t of the motion, as a number of the
        robot's model."""
        return {STANDING: jnp.asarray(self.gait.standing)[t % self.gait.period]}

    def motion(self, t: Any) -> tuple[Any, Any]:
        """Return what is tracked at the control period t where no other reference is given: ξ (n,)
        and the torques of rest (m,)."""
        return self.gait.reference(1, t)[0], self.gait.inputs

    def distance(self, x: Array, xi: Array, t: Any) -> Array:
        """Return the distance (n,) of a state x from ξ in the coordinates that are weighed at the
        control period t."""
        relative = partial(self.gait.relative, t=t)
        return relative(x) - relative(self.robot.state(xi))

    def begun(self, before: Control[Plan], t: int) -> Control[Plan]:
        """Return what `start` gives for loops whose first plan begins at the control period t."""
        memory: Any = before.memory
        return before._replace(memory=memory._replace(time=jnp.int32(t)))

    def start(self, x: Array, input_reference: Any = None) -> Control[Plan]:
        """Return what stands for the time step before the first: the torques of rest."""
        zeros: Any = zeros_of(partial(self, input_reference=input_reference), x)
        plan = zeros.memory.plan
        states = jnp.broadcast_to(self.coordinates(x), plan.states.shape)
        inputs = jnp.broadcast_to(self.gait.inputs, plan.inputs.shape)
        warm = plan._replace(states=states, inputs=inputs)
        return zeros._replace(u=inputs[0], memory=zeros.memory._replace(plan=warm))

    def __call__(
        self,
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
    ) -> Control[Plan]:
        """Return the input (m,) at the state x, its plan, in ξ, and what to remember."""
        x = one_state(self, x)
        require_before(before)
        memory: Any = None if before is None else before.memory
        time = jnp.int32(0) if memory is None else memory.time
        problem = self.problem(time)
        rows = layout(problem)
        last = None if memory is None else memory.plan
        gait, times = self.gait, time + jnp.arange(self.horizon + 1)
        if reference is None:
            aim = jnp.asarray(gait.states)[times % gait.period]
        else:
            given = checked_array("reference", reference, reference_shapes(self.mpc)["reference"])
            given = jnp.broadcast_to(given, (self.horizon + 1, self.robot.n))
            aim = jax.vmap(lambda xi, t: gait.relative(self.robot.state(xi), t))(given, times)
        start = None if last is None else last.shifted(rows, last.inputs[-1])
        plan = solve_stagewise(
            problem, gait.relative(x, time), aim, self.solver, start,
            input_reference=gait.inputs if input_reference is None else input_reference,
        )  # fmt: skip
        control = applied(problem, rows, plan, last)
        assert control.memory is not None
        later: Any = GaitMemory(control.memory, time + 1)
        plan = replace(plan, states=jax.vmap(gait.in_the_world)(plan.states, times))
        return Control(control.u, plan, later)


def _require_free_trunk(gait: Gait, limited: np.ndarray) -> None:
    """Raise ValueError where the trunk turns and what turns with it is limited in the axes of the
    world; limited (n,): whether each coordinate ξ is."""
    robot = gait.robot
    turning = np.arange(robot.n)[[0, 1, 3, 4, 5, robot.mujoco.nv, robot.mujoco.nv + 1]]
    found = [robot.state_names[i] for i in turning if limited[i]]
    if np.any(gait.path.turn != 0) and found:
        what = f"turns, and {robot.name} has limits of {', '.join(found)}"
        fail("gait", what, "Load the robot without these (position=, velocity=), or let turn be 0")


def periodic_cost_to_go(gait: Gait, Q: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Return P (P, n, n): ξ'P_k ξ is the least cost of distances ξ from the motion at phase k from
    there on, Σ ξ'Qξ + u'Ru, under the linear models of the gait.

    The Riccati recursion backward through the period (Bittanti, Colaneri & De Nicolao 1991, 'The
    periodic Riccati equation'), begun at its fixed point: that of 1, 2, 4, ... periods at once,
    by doubling, as in `systems/riccati.py`. So slow gaits and large R cost no more.
    """
    A, B = (np.asarray(v, float) for v in (gait.system.A, gait.system.B))
    found = np.zeros((gait.period, *Q.shape))
    with np.errstate(all="ignore"):  # without a fixed point numbers grow beyond all bounds
        try:
            before = found[0]
            steps = [(A[k], B[k] @ np.linalg.solve(R, B[k].T), Q) for k in range(gait.period)]
            whole = reduce(_one_after_other, steps)
            for _ in range(_DOUBLINGS):
                if np.abs(whole[2] - before).max() <= _SETTLED * np.abs(whole[2]).max():
                    break
                before, whole = whole[2], _one_after_other(whole, whole)
            P = whole[2]
            for _ in range(3):  # the last pass checks the one before
                before = found[0].copy()
                for k in reversed(range(gait.period)):
                    BtP = B[k].T @ P
                    K = -np.linalg.solve(R + BtP @ B[k], BtP @ A[k])
                    closed = A[k] + B[k] @ K
                    P = Q + closed.T @ P @ closed + K.T @ R @ K
                    found[k] = P = (P + P.T) / 2
            if np.abs(P - before).max() <= _SETTLED * np.abs(P).max():
                return found
        except np.linalg.LinAlgError:
            pass
    cure = "Weigh what it moves, or let more feet stand at a time (duty)"
    fail("gait", "has no periodic LQR: inputs do not hold all of the motion", cure)


def _one_after_other(first: Steps, then: Steps) -> Steps:
    """Return (A, G, H) of some steps of the Riccati recursion and of those that follow them."""
    (A, G, H), (A_then, G_then, H_then) = first, then
    W = np.linalg.solve(np.eye(len(A)) + G @ H_then, np.hstack([A, G]))
    WA, WG = np.split(W, 2, axis=1)
    G, H = G_then + A_then @ WG @ A_then.T, H + A.T @ H_then @ WA
    return A_then @ WA, (G + G.T) / 2, (H + H.T) / 2


def _matrices(gait: Gait) -> dict[str, Any]:
    """Return A, B and c of the linear models."""
    return {name: getattr(gait.system, name) for name in ("A", "B", "c")}
