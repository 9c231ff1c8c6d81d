"""NonlinearController: a nonlinear MPC problem as a feedback policy, by one or more QPs a step."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.checks import fail, require_kind
from jaxmpc.closed_loop.feedback import Feedback, first_row, one_state
from jaxmpc.closed_loop.orientations import aligned
from jaxmpc.mpc.controller import zeros_of
from jaxmpc.mpc.plan import (
    Control,
    Plan,
    WarmStart,
    anchored,
    applied,
    checked_array,
    limited,
    require_before,
)
from jaxmpc.mpc.problem import MPC, at_stage
from jaxmpc.mpc.rows import layout, row_count
from jaxmpc.mpc.stagewise.nonlinear import NonlinearMPC, task_layout
from jaxmpc.mpc.stagewise.sqp import checked_search, solve_nonlinear
from jaxmpc.pytrees import prepared_pytree, static
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.linalg import floating_dtype, matmul, solve
from jaxmpc.qp.newton import ridged
from jaxmpc.robots.robot import RobotModel


@prepared_pytree
class NonlinearController:
    """A nonlinear MPC problem as a feedback policy, for `simulate` and `tune_weights`.

    `controller(x, before) -> Control`, as `Controller`: its u (m,) is the first input of the plan
    that `solve_nonlinear` finds from x (n,), warm-started by the plan of `before`, shifted by one
    step; at the start by rest at x under the first input_reference. When the plan is not SOLVED, u
    is the first input of where the search ended: look at plan.solved. Limits are hard where the
    problem says so; `jm.soften(mpc, rho)` gives one whose state limits give way.

    problem: `NonlinearMPC`, whose model predicts: `problem.model` as the plant of `simulate` gives
      the nominal loop.
    solver: of the QPs, as in `solve_nonlinear`; its eps is the tolerance of the plan.
    sqp_steps: QPs a time step at most. 1: the real-time iteration, whose status is that of one QP
      about the last plan, not of the nonlinear problem.
    hessian: as in `solve_nonlinear`.
    scale (rows,): row scale of a similar problem, as in `solve_stagewise`; None: of each QP its
      own.

    References are as in `solve_nonlinear`; behind its n columns `reference` may have the targets of
    the tasks, one after the other. A pytree: the arrays of problem and model may be traced. Raises
    ValueError as `solve_nonlinear` does.
    """

    problem: NonlinearMPC
    solver: ADMM = DEFAULT
    sqp_steps: int = static(default=10)
    hessian: Literal["exact", "gauss-newton"] = static(default="exact")
    scale: Any = None

    def __post_init__(self) -> None:
        require_kind("problem", self.problem, NonlinearMPC)
        require_kind("solver", self.solver, ADMM)
        solver = checked_search(
            self.problem, self.solver, self.sqp_steps, self.hessian, "sqp_steps"
        )
        object.__setattr__(self, "solver", solver)

    def __repr__(self) -> str:
        """Return the size of the problem and the QPs a step, in one line."""
        mpc, tasks = self.mpc, len(self.problem.tasks)
        with_tasks = f", {tasks} task{'s' * (tasks > 1)}" if tasks else ""
        sizes = f"{mpc.system.n} states, {mpc.system.m} inputs, horizon {mpc.horizon}{with_tasks}"
        steps = f"at most {self.sqp_steps} SQP steps" if self.sqp_steps > 1 else "one QP"
        return f"NonlinearController({sizes}, {steps} a sample)"

    @property
    def mpc(self) -> MPC:
        """Return the problem's weights, limits and horizon."""
        return self.problem.mpc

    @property
    def model(self) -> Any:
        """Return the model that predicts."""
        return self.problem.model

    @property
    def dtype(self) -> Any:
        """Return the precision of the plans."""
        mpc: Any = self.mpc
        return floating_dtype(replace(mpc, system=None))

    @property
    def takes_numbers(self) -> bool:
        """Return whether plans take numbers of the robot's model."""
        return isinstance(self.model, RobotModel)

    @property
    def state_size(self) -> int:
        """Return the length n of the state."""
        return self.mpc.system.n

    @property
    def limits(self) -> Any:
        """Return the set by which violations of a closed loop are measured; of limits that differ
        from stage to stage those of the first."""
        return at_stage(self.mpc.states, 0)

    @property
    def reference_sizes(self) -> tuple[int, ...]:
        """Return how many columns `reference` may have: n, or those and the tasks' targets."""
        return reference_sizes(self.problem)

    def coordinates(self, x: Array) -> Array:
        """Return the state in which the problem is written: x itself."""
        return x

    def start(self, x: Array, input_reference: Any = None) -> Control[Plan]:
        """Return what stands for the time step before the first: at rest at x under the first input
        of input_reference, zero for none."""
        return resting_start(self, x, input_reference)

    def __call__(
        self,
        x: Reals,
        before: Control[Plan] | None = None,
        reference: Reals | None = None,
        *,
        input_reference: Reals | None = None,
        previous_input: Reals | None = None,
        numbers: Mapping[str, Any] | None = None,
    ) -> Control[Plan]:
        """Return the input (m,) at the state x (n,), its plan, and what to remember.

        before: None, or what was returned at the time step before, of which also the input counts
        where its rate is limited or weighed and previous_input is None.
        numbers: as in `RobotController`, of a `RobotModel`, in place of those that it has.
        """
        x = one_state(self, x)
        require_before(before)
        problem = self.problem
        if given_numbers(self, numbers, f"of a {type(self.model).__name__}", "a RobotModel"):
            assert numbers is not None
            model = replace(self.model, numbers={**self.model.numbers, **numbers})
            problem = replace(problem, model=model)
            reference, input_reference = held_references(
                self.model, model, reference, input_reference, self.dtype
            )
        x, reference = aligned(self.model, self.mpc, x, reference)
        search = {"iterations": self.sqp_steps, "hessian": self.hessian, "scale": self.scale}
        aims = {"input_reference": input_reference, "previous_input": previous_input}
        return sqp_control(problem, self.solver, x, before, reference, **aims, **search)


def given_numbers(controller: Any, numbers: Any, where: str, needed: str) -> bool:
    """Return whether there are numbers of a robot's model; raise ValueError where plans take
    none."""
    if numbers is not None:
        require_kind("numbers", numbers, Mapping, cure='Give {"payload": ...}')
    if numbers and not controller.takes_numbers:
        fail("numbers", f"given {where}", f"Give {needed}")
    return bool(numbers)


def held_references(
    file: RobotModel, told: RobotModel, reference: Any, input_reference: Any, dtype: Any
) -> tuple[Any, Any]:
    """Return both references, activations and inputs changed by what makes up, at their first
    rows, for the change of the next state from one model to the other: least squares, exact where
    each joint has a motor. As they are where one of them is None."""
    if reference is None or input_reference is None:
        return reference, input_reference
    r, s = (first_row(part, dtype) for part in (reference, input_reference))
    n, na = file.robot.n, file.robot.mujoco.na
    system: Any = told.linearize(r[:n], s)
    # At rest activations α stay: (A − 1) α + B u makes up for what is lost.
    M = jnp.concatenate([(system.A - jnp.eye(n, dtype=r.dtype))[:, n - na :], system.B], axis=1)
    lost = file.step(r[:n], s) - told.step(r[:n], s)
    # Motors of large and small inertias have columns of other sizes, and a ridge moves the answer:
    # columns of length 1, and twice more for what is left.
    size = jnp.sqrt(jnp.sum(M**2, axis=0))
    size = jnp.where(size > 0, size, 1.0)
    M = M / size
    normal, by = ridged(matmul(M.T, M)), jnp.zeros_like(size)
    for _ in range(3):
        by = by + solve(normal, matmul(M.T, lost - matmul(M, by)))
    by = by / size
    states = jnp.asarray(reference, dtype).at[..., n - na : n].add(by[:na])
    return states, jnp.asarray(input_reference, dtype) + by[na:]


def sqp_control(
    problem: NonlinearMPC,
    solver: ADMM,
    x: Array,
    before: Control[Plan] | None,
    reference: Any,
    *,
    input_reference: Any,
    previous_input: Any,
    **search: Any,
) -> Control[Plan]:
    """Return what a controller gives at x (n,), planned about the plan of `before`, shifted by one
    step, or about rest. search: other arguments of `solve_nonlinear`."""
    mpc, rows = problem.mpc, layout(problem.mpc) + task_layout(problem)
    memory = None if before is None else before.memory
    last = last_input(mpc, before, previous_input)
    if memory is None:
        blank = jnp.zeros(row_count(rows), x.dtype)
        start = WarmStart(*at_rest(mpc, x, input_reference), blank)
    else:
        start = memory.shifted(rows, memory.inputs[-1])
    reference, targets = _with_targets(problem, reference)
    plan = solve_nonlinear(
        problem, x, reference, solver, anchored(start, x),
        input_reference=input_reference, previous_input=last, targets=targets, **search,
    )  # fmt: skip
    return applied(mpc, rows, plan, memory, last)


def reference_sizes(problem: NonlinearMPC) -> tuple[int, ...]:
    """Return how many columns a reference may have: n, or those and the tasks' targets."""
    return (problem.n, problem.n + problem.targets) if problem.tasks else (problem.n,)


def _with_targets(problem: NonlinearMPC, reference: Any) -> tuple[Any, Any]:
    """Return the reference of the states and those of the tasks, None for their own."""
    N, n = problem.mpc.horizon, problem.n
    if reference is None:
        return None, None
    shapes = [shape for size in reference_sizes(problem) for shape in ((size,), (N + 1, size))]
    reference = checked_array("reference", reference, shapes)
    if np.shape(reference)[-1] == n:
        return reference, None
    ends = n + np.cumsum(problem.sizes())[:-1]
    reference, *targets = jnp.split(jnp.asarray(reference), [n, *ends], axis=-1)
    return reference, targets


def resting_start(controller: Feedback, x: Array, input_reference: Any) -> Control[Plan]:
    """Return what stands for the time step before the first of a controller whose plans are about
    a trajectory: at rest at x under the first input of input_reference, zero for none."""
    zeros = zeros_of(partial(controller, input_reference=input_reference), x)
    states, inputs = at_rest(controller.mpc, controller.coordinates(x), input_reference)
    assert zeros.memory is not None
    memory = zeros.memory._replace(states=states, inputs=inputs)
    return zeros._replace(u=inputs[0], memory=memory)


def at_rest(mpc: MPC, xi: Array, input_reference: Any) -> tuple[Array, Array]:
    """Return states (N+1, n) that stay at ξ and inputs (N, m), the first of input_reference."""
    u = first_row(np.zeros(mpc.system.m) if input_reference is None else input_reference, xi.dtype)
    states = jnp.broadcast_to(xi, (mpc.horizon + 1, len(xi)))
    return states, jnp.broadcast_to(u, (mpc.horizon, mpc.system.m))


def last_input(mpc: MPC, before: Control[Plan] | None, previous_input: Any) -> Array | None:
    """Return the input (m,) before a time step: the given one, or that of `before`; None where
    neither is known, and one within the limits where it is not finite."""
    if previous_input is None:
        if before is None:
            return None
        previous_input = before.u
    u = jnp.asarray(previous_input)
    return jnp.where(jnp.isfinite(u), u, limited(mpc.inputs, jnp.zeros_like(u)))
