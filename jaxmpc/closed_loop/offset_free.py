"""Offset-free MPC: estimated disturbances move the model and the target of each plan."""

from dataclasses import field, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals, host_array, module_of
from jaxmpc.checks import concrete, fail, require_finite, require_kind, require_shape
from jaxmpc.closed_loop.estimation import KalmanFilter
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.mpc.condense import prestabilising_gain
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Control, Plan, checked_array, reference_shapes
from jaxmpc.mpc.problem import MPC, Outputs, Soft, as_tuple
from jaxmpc.mpc.steady_state import SteadyState, SteadyStates
from jaxmpc.pytrees import prepared_pytree
from jaxmpc.qp.linalg import arrays, matmul
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope
from jaxmpc.systems.system import LinearSystem, host_matrices, numbered


@prepared_pytree
class OffsetFreeController:
    """MPC without steady-state error under constant disturbances and model errors.

    controller: a Controller, or a RobotController with linearize="set-point".
    observer: a `KalmanFilter` of the controller's own model with `disturbance`s d; `simulate` takes
        it from here. What a set of limits says of states is asked of the estimates.
    tracked (q, p): the combinations of the measured outputs that are to reach their references;
        None: all. For q up to the number of inputs they reach them exactly, within the limits.
    units (q,): of these, in which distances from references are measured where limits keep the
        outputs from them; None: ones.

    At each time step the target is the steady state of the model under the estimated d,
        x_s = A x_s + B u_s + c + B_d d,   within all limits of the problem (terminal set included),
    whose tracked outputs T (C x_s + C_d d) are the nearest to those of the reference, T C r; it is
    r's outputs themselves where the limits let them be. Of several the one of least effort, u'Ru
    with the R of the problem (and x'Qx where no input tells them apart). The plan tracks x_s, u_s
    and predicts with c + B_d d. A reference over time, or a forecast, has the target of each of its
    rows. Where no steady state keeps the limits, the plan has the status of the search for one
    (PRIMAL_INFEASIBLE mostly).

    Where the loop settles, no target at a limit that the plant cannot keep, the tracked outputs are
    at their references, if there are as many disturbances as measured outputs; whatever the true
    plant is (Pannocchia & Rawlings 2003, AIChE Journal 49(2), theorem 1; Maeder, Borrelli & Morari
    2009, Automatica 45(10)). With fewer, errors remain of what the disturbances do not model.

    Called as `Controller` is, with disturbance (k,), the estimate, None for zero. input_reference
    is not tracked: u_s takes its place. The model of the observer must not be traced; limits,
    weights, noise and all that a loop computes may be. Raises ValueError for what does not fit
    together, before any compile.
    """

    controller: Controller | RobotController
    observer: KalmanFilter
    tracked: Any = None
    units: Any = None
    steady: SteadyStates = field(init=False)
    loads: Any = field(init=False)
    seen: tuple[Any, Any] = field(init=False)

    def __post_init__(self) -> None:
        controller, observer = self.controller, self.observer
        require_kind("controller", controller, Controller, RobotController)
        if isinstance(controller, RobotController) and controller.fixed is None:
            what = f"linearises about the {controller.linearize}"
            fail("controller", what, 'Give linearize="set-point": one model for plan and observer')
        require_kind("observer", observer, KalmanFilter)
        observer = observer.prepared()
        system = controller.mpc.system
        if not observer.disturbance:
            cure = 'Give disturbance=Disturbance("input", process=...)'
            fail("observer.disturbance", "is empty", cure)
        _require_same_model(observer, system)
        own = observer.linear_model
        B, p = host_matrices(own)[1], observer.p
        C = np.eye(p, system.n) if observer.C is None else host_array("observer.C", observer.C)
        tracked = np.eye(p) if self.tracked is None else host_array("tracked", self.tracked)
        if tracked.ndim != 2 or tracked.shape[1] != p or not len(tracked):
            fail("tracked", f"shape {tracked.shape}", f"Give (q, {p}), a column an output")
        require_finite("tracked", tracked)
        units = np.ones(len(tracked)) if self.units is None else host_array("units", self.units)
        require_shape("units", units, (len(tracked),), "Give one for each tracked output")
        if not np.all((units > 0) & np.isfinite(units)):
            fail("units", f"{units}", "Give positive numbers")
        steady = SteadyStates.of(controller.mpc, own, tracked @ C, units)
        if not steady.count:
            fail("tracked", "no input moves them at rest", "Track outputs that inputs move")
        loads = host_array("observer.disturbance", observer.on_states(B))
        seen = tracked @ C, tracked @ host_array("observer.disturbance", observer.matrix("output"))
        made = arrays((observer, tracked, units, steady, loads, seen))
        names = ("observer", "tracked", "units", "steady", "loads", "seen")
        vars(self).update(zip(names, made, strict=True))

    @property
    def mpc(self) -> MPC:
        """Return the problem of the controller."""
        return self.controller.mpc

    @property
    def dtype(self) -> Any:
        """Return the precision of the plans."""
        return self.controller.dtype

    @property
    def state_size(self) -> int:
        """Return the length of the plant's state."""
        return self.controller.state_size

    @property
    def limits(self) -> Any:
        """Return the set by which violations of a closed loop are measured."""
        return self.controller.limits

    @property
    def takes_forecasts(self) -> bool:
        """True: plans take what is known ahead of disturbances."""
        return True

    def coordinates(self, x: Array) -> Array:
        """Return the coordinates ξ (n,) of a state."""
        return self.controller.coordinates(x)

    def start(self, x: Array, input_reference: Any = None) -> Control[Plan]:
        """Return what stands for the time step before the first, as the controller does."""
        return self.controller.start(x, input_reference)

    def target(
        self,
        reference: Reals | None = None,
        disturbance: Reals | None = None,
        forecast: Reals | None = None,
    ) -> SteadyState:
        """Return the steady state x (n,), u (m,) that a plan tracks under the disturbance (k,).

        reference, forecast: as in `solve`; where one has rows over time x is (N+1, n), u (N, m),
        and the status that of the first row that has none.
        """
        return self._target(reference, self._known(disturbance, forecast), disturbance)

    def _known(self, disturbance: Any, forecast: Any) -> Array:
        """Return what is known to be added to the next states, (n,) or (N, n)."""
        n, k = self.mpc.system.n, self.observer.disturbances
        d = self._array("disturbance", disturbance, [(k,)])
        e = self._array("forecast", forecast, [(n,), (self.mpc.horizon, n)])
        return matmul(jnp.asarray(self.loads, self.dtype), d) + e

    def _target(self, reference: Any, known: Array, disturbance: Any) -> SteadyState:
        r = self._array("reference", reference, reference_shapes(self.mpc)["reference"])
        d = self._array("disturbance", disturbance, [(self.observer.disturbances,)])
        of_states, of_disturbances = (jnp.asarray(M, self.dtype) for M in self.seen)
        aims = matmul(r, of_states.T) - matmul(of_disturbances, d)
        if aims.ndim == known.ndim == 1:
            return self.steady.nearest(aims, known)
        known = jnp.concatenate([known, known[-1:]]) if known.ndim == 2 else known
        axes = tuple(0 if v.ndim == 2 else None for v in (aims, known))
        x, u, status = jax.vmap(self.steady.nearest, axes)(aims, known)
        return SteadyState(x, u[:-1], status[jnp.argmax(status != Status.SOLVED)])

    def _array(self, name: str, value: Any, shapes: list[tuple[int, ...]]) -> Array:
        """Return an argument in the controller's precision, zeros of the first shape for None."""
        value = np.zeros(shapes[0]) if value is None else checked_array(name, value, shapes)
        return jnp.asarray(value, self.dtype)

    def __call__(
        self,
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
        forecast: Reals | None = None,
        disturbance: Reals | None = None,
    ) -> Control[Plan]:
        """Return the input (m,) at the state x, its plan, and what to remember."""
        known = self._known(disturbance, forecast)
        target = self._target(reference, known, disturbance)
        given: dict[str, Any] = {"previous_input": previous_input, "forecast": known}
        control = self.controller(x, before, target.x, input_reference=target.u, **given)
        solved = target.status == Status.SOLVED
        status = jnp.where(solved, control.plan.status, target.status)
        return control._replace(plan=replace(control.plan, status=status))


def _require_same_model(observer: KalmanFilter, system: LinearSystem) -> None:
    """Raise ValueError unless a filter has the model of the plans: two steady states of different
    models leave an offset between them."""
    if not hasattr(observer.model, "system") and not isinstance(observer.model, LinearSystem):
        what = f"is a {type(observer.model).__name__}"
        fail("observer.model", what, "Give mpc.system, the model of the plans")
    own = observer.linear_model
    if (own.n, own.m) != (system.n, system.m):
        what = f"has {own.n} states and {own.m} inputs, that of the plans {system.n} and {system.m}"
        fail("observer.model", what, "Give mpc.system")
    if concrete(own, system):
        pairs = zip(host_matrices(own), host_matrices(system), strict=True)
        if not all(np.allclose(a, b, rtol=1e-6, atol=0) for a, b in pairs):
            fail("observer.model", "differs from mpc.system", "Give mpc.system to both")


def augmented(mpc: MPC, observer: KalmanFilter) -> MPC:
    """Return the problem whose states are (x, d), the disturbances of an observer as states that
    stay: for feasible sets with d as a parameter, and for exported controllers.

    observer: a `KalmanFilter` with disturbances d.

    Limits, weights and the terminal set are those of x; d is free and costs nothing. Then
        jm.map_feasible_set(augmented(mpc, observer), x0s, axes=range(n), fixed=[0] * n + d)
    maps the states from which the limits can be kept under d, and of `jm.export` the programs take
    the estimate (x, d), and the target (x_s, 0) and u_s of `OffsetFreeController.target` as
    references.

    Raises ValueError for an Ellipsoid as terminal set, of which (x, d) has none, and for robust
    problems.
    """
    require_kind("mpc", mpc, MPC)
    mpc.validate()
    mpc.require_constant("observers and their disturbances know one problem for all")
    require_kind("observer", observer, KalmanFilter)
    observer = observer.prepared()
    system = mpc.system
    if (observer.model.n, observer.model.m) != (system.n, system.m):
        what = f"has {observer.model.n} states and {observer.model.m} inputs"
        fail("observer.model", what, f"The problem has {system.n} and {system.m}")
    if isinstance(mpc.terminal_set, Ellipsoid):
        fail("terminal_set", "is an Ellipsoid", "Use a Polytope inside it")
    if mpc.disturbance is not None:
        what = "is given, and (x, d) has no gain that stabilises d"
        fail("mpc.disturbance", what, "Leave it out, or give the mean of d as the system's c")
    k = observer.disturbances
    A, B, c = host_matrices(system)
    top, zeros = np.hstack([A, host_array("observer", observer.on_states(B))]), np.zeros
    names = system.state_names or numbered("x", system.n)
    units = system.state_units and system.state_units + ("",) * k
    more = replace(
        system,
        A=np.vstack([top, np.hstack([zeros((k, system.n)), np.eye(k)])]),
        B=np.vstack([B, zeros((k, system.m))]),
        c=np.append(c, zeros(k)),
        state_names=(*names, *(f"d{i + 1}" for i in range(k))),
        state_units=units,
    )
    wider = partial(_with_columns, k=k)
    weight = lambda M: module_of(M).pad(M, (0, k))
    return replace(
        mpc,
        system=more,
        Q=weight(mpc.Q),
        terminal_cost=None if mpc.terminal_cost is None else weight(mpc.terminal_cost),
        states=wider(mpc.states),
        terminal_set=wider(mpc.terminal_set),
        soft=tuple(wider(rows) for rows in as_tuple("soft", mpc.soft, Soft)),
        outputs=tuple(wider(rows) for rows in as_tuple("outputs", mpc.outputs, Outputs)),
        prestabilise=np.pad(np.asarray(prestabilising_gain(mpc)), ((0, 0), (0, k))),
    )


def _with_columns(rows: Any, k: int) -> Any:
    """Return a set, or rows, of states with k more of them, which nothing limits."""
    if rows is None:
        return None
    if isinstance(rows, Box):
        ends = rows.bounds()
        return Box(np.append(ends[0], np.full(k, -np.inf)), np.append(ends[1], np.full(k, np.inf)))
    columns = ((0, 0), (0, k))
    if isinstance(rows, Polytope):
        return replace(rows, H=np.pad(np.asarray(rows.H), columns))
    return replace(rows, C=np.pad(np.asarray(rows.C), columns))
