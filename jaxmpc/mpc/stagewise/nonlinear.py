"""MPC of a nonlinear model with costs and limits on functions of its state, and its expansion.

About a trajectory x (N+1, n), u (N, m) the problem becomes one of `stages.py`: the model affine,
functions affine, the cost of weighed functions |g − target|²_W by Gauss-Newton: gradient
2 G'W(g − target), Hessian 2 G'WG with G the Jacobian of g, and a diagonal that is at least the
curvature left out (`majorant`). All quadratic terms stand about the trajectory itself, so the
gradient there is that of the true cost.

Near a solution, and for its derivatives, the Hessian of the Lagrangian takes the place of Gauss and
Newton's, stage by stage: with the costates λ and the multipliers y of the functions' rows

    ½ ∇²[ℓ_k(x, u) + λ_{k+1}'f(x, u) + y_k'g(x, u)].
"""

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import DTypeLike

from jaxmpc.arrays import store_floats
from jaxmpc.checks import (
    concrete,
    fail,
    require_finite,
    require_kind,
    require_real,
    require_symmetric_psd,
)
from jaxmpc.mpc.plan import Aim
from jaxmpc.mpc.problem import MPC, dynamics_of, require_stages, store_stages
from jaxmpc.mpc.rows import Rows, at, joined_bounds, spread
from jaxmpc.mpc.stagewise.stages import Stages, remembering
from jaxmpc.pytrees import named_pytree, pytree, static
from jaxmpc.qp.linalg import apply, apply_transposed, matmul, symmetric
from jaxmpc.qp.problem import Bounds
from jaxmpc.systems.given_model import as_argument, closed, is_model, may_close_over, written_in_jax
from jaxmpc.systems.system import LinearSystem


@pytree
class Task:
    """A cost or a limit on a smooth function g of the state and the input:

        Σ_k (g_k − target_k)'W (g_k − target_k)  in the cost (no ½),
        lower ≤ g_k ≤ upper.

    function: one step of the model -> (p,) or a number, written in JAX, of what `model.view(x, u)`
        gives: for a robot mjx.Data with the poses and velocities of all bodies, for other models
        a `Point` with x and u. The arrays of a pytree, such as an equinox module, are data of the
        program, any other function is a constant of it, told apart by identity.
    weight: W, a number, (p,) for a diagonal or (p, p); None: no cost.
    target: (p,), or (N + 1, p) for each step; None: zero.
    lower, upper: (p,) or a number, ±inf or None for no limit.
    rho: weight ρ of the violations ρ Σ e with which the limits are soft (`Soft`); None: hard.
    stages: the k at which cost and limits hold; None: 1 … N. At N the input counts as zero.
    name, unit: in tables.
    """

    function: Any
    weight: Any = None
    target: Any = None
    lower: Any = None
    upper: Any = None
    rho: Any = 1e4
    stages: tuple[int, ...] | None = static(default=None)
    name: str = static(default="task")
    unit: str = static(default="")

    def __post_init__(self) -> None:
        if callable(self.function):
            object.__setattr__(self, "function", as_argument(self.function))
        store_stages(self, "stages")
        store_floats(self, "weight", "target", "lower", "upper", "rho")

    @property
    def limited(self) -> bool:
        """Return whether there are limits."""
        return self.lower is not None or self.upper is not None

    def at(self, horizon: int) -> tuple[int, ...]:
        """Return the stages at which cost and limits hold."""
        return tuple(range(1, horizon + 1)) if self.stages is None else self.stages

    def bounds(self, shift: Array) -> Bounds:
        """Return what is asked of the function's values and `shift` (steps, p), as rows."""
        lower = jnp.asarray(-jnp.inf if self.lower is None else self.lower, shift.dtype)
        upper = jnp.asarray(jnp.inf if self.upper is None else self.upper, shift.dtype)
        rho = jnp.full(shift.size, jnp.inf if self.rho is None else self.rho, shift.dtype)
        return Bounds((lower + shift).ravel(), (upper + shift).ravel(), rho, jnp.zeros_like(rho))

    def validate(self, size: int, horizon: int) -> None:
        """Raise ValueError for arguments that do not fit a function of `size` numbers."""
        name = self.name
        vector: tuple[tuple[int, ...], ...] = ((), (size,))
        allowed = {"weight": (*vector, (size, size)), "target": (*vector, (horizon + 1, size))}
        for what, shapes in {**allowed, "lower": vector, "upper": vector, "rho": ((),)}.items():
            value = getattr(self, what)
            if value is None:
                continue
            require_real(f"{name}.{what}", value)
            if np.shape(value) not in shapes:
                listed = " or ".join(map(str, shapes))
                cure = f"The function gives {size} numbers: give {listed}"
                fail(f"{name}.{what}", f"shape {np.shape(value)}", cure)
            if what not in ("lower", "upper"):
                require_finite(f"{name}.{what}", value)
        if self.weight is not None and concrete(self.weight):
            values = np.asarray(self.weight, float)
            values = np.diag(values) if values.ndim == 1 else np.atleast_2d(values)
            require_symmetric_psd(f"{name}.weight", values)
        cure = "Give weight= for a cost, or lower= and upper= for limits"
        if self.target is not None and self.weight is None:
            fail(f"{name}.target", "is given without a weight", cure)
        if self.weight is None and not self.limited:
            fail(name, "has neither a weight nor limits", cure)
        if self.rho is not None and concrete(self.rho) and not float(self.rho) >= 0:
            fail(f"{name}.rho", f"{self.rho}", "Give at least 0, or None for hard limits")
        if self.limited and concrete(self.lower, self.upper):
            lower = -np.inf if self.lower is None else np.asarray(self.lower, float)
            upper = np.inf if self.upper is None else np.asarray(self.upper, float)
            if not np.all(lower <= upper):
                fail(f"{name}.lower", "exceeds upper or is NaN", "Give lower ≤ upper")
        require_stages(f"{name}.stages", self.stages, horizon)
        if self.stages == ():
            fail(f"{name}.stages", "is empty", f"Give stages from 0 to {horizon}, or no task")


@named_pytree
class Point(NamedTuple):
    """State x (n,) and input u (m,) of one step."""

    x: Array
    u: Array


@pytree
class NonlinearMPC:
    """The problem of `MPC` with a nonlinear model, and with costs and limits on functions:

        min  Σ_{k<N} (e_k'Q e_k + d_k'R d_k) + e_N'P e_N + Σ (costs of the tasks)
        s.t. x_{k+1} = f(x_k, u_k), the limits of mpc, the limits of the tasks,

    e = x − reference, d = u − input_reference.

    mpc: `MPC`, whose `system` is read for its sizes and names only. Not for an Ellipsoid or control
        horizons.
    model: f, a function (x, u) -> x⁺ written in JAX, or an object with such a `step`, and, if it
        has them, `linearize(x, u)` -> LinearSystem and `view(x, u)`, of which tasks are functions.
        The arrays of a pytree, such as an equinox module, are data of the program (derivatives with
        respect to them), any other object is a constant of it.
    tasks: `Task`s.
    """

    mpc: MPC
    model: Any
    tasks: tuple[Task, ...] = ()

    def __post_init__(self) -> None:
        if isinstance(self.mpc, MPC) and is_model(self.model):
            object.__setattr__(self, "model", as_argument(self.model))

    @property
    def n(self) -> int:
        """Return the number of states."""
        return self.mpc.system.n

    @property
    def m(self) -> int:
        """Return the number of inputs."""
        return self.mpc.system.m

    @property
    def targets(self) -> int:
        """Return how many numbers the functions of all tasks give together."""
        return sum(self.sizes())

    def sizes(self) -> list[int]:
        """Return how many numbers the function of each task gives."""
        return [shape[0] for shape in self._shapes()[1]] if self.tasks else []

    def closed(self, dtype: DTypeLike) -> "NonlinearMPC":
        """Return the problem with the traced arrays that its functions close over as data; dtype:
        of the states and inputs that they are called with."""
        if not any(map(may_close_over, (self.model, *(task.function for task in self.tasks)))):
            return self
        kind = lambda v: dtype if jnp.issubdtype(v.dtype, jnp.floating) else v.dtype
        as_called = lambda v: jax.ShapeDtypeStruct(v.shape, kind(v))
        x, u, view = jax.tree.map(as_called, self._shapes()[2])
        tasks = [replace(task, function=closed(task.function, view)) for task in self.tasks]
        return replace(self, model=closed(self.model, x, u), tasks=tuple(tasks))

    def _shapes(self) -> tuple[tuple[int, ...], list[tuple[int, ...]], tuple]:
        leaves, tree = jax.tree.flatten(self)
        kind = lambda v: jax.dtypes.canonicalize_dtype(jnp.result_type(v))
        return _shapes(tree, tuple((np.shape(v), kind(v)) for v in leaves))

    def validate(self) -> None:
        """Raise ValueError for a bad problem, before any compile."""
        require_kind("mpc", self.mpc, MPC)
        self.mpc.validate()
        if self.mpc.disturbance is not None:
            what = "given beside a nonlinear model, for which the tightened rows prove nothing"
            fail("mpc.disturbance", what, "Leave it out, or use jm.solve with a linear model")
        self.mpc.require_unique_inputs()
        if not is_model(self.model):
            fail("model", f"is a {type(self.model).__name__}", "Give f(x, u) -> x⁺, or its object")
        if not isinstance(self.tasks, tuple) or not all(isinstance(t, Task) for t in self.tasks):
            fail("tasks", f"is a {type(self.tasks).__name__}", "Give a tuple of jm.mpc.Task")
        for task in self.tasks:
            if not callable(task.function):
                cure = "Give a function of what the model's view gives"
                fail(f"{task.name}.function", f"is a {type(task.function).__name__}", cure)
        after, values, _ = self._shapes()
        if after != (self.mpc.system.n,):
            cure = f"Give the next state ({self.mpc.system.n},), as mpc.system has it"
            fail("model.step(x, u)", f"shape {after}", cure)
        for task, shape in zip(self.tasks, values, strict=True):
            if len(shape) > 1:
                fail(f"{task.name}.function", f"gives shape {shape}", "Give a vector of numbers")
            task.validate(shape[0], self.mpc.horizon)

    def value(self, task: Task, x: Array, u: Array) -> Array:
        """Return what the task's function gives at x, u, as a vector."""
        found = task.function(self.view(x, u))
        if not hasattr(found, "dtype") and not isinstance(found, int | float):
            what = f"gives a {type(found).__name__}"
            fail(f"{task.name}.function", what, "Give a vector of numbers")
        return jnp.atleast_1d(jnp.asarray(found)).astype(x.dtype)

    def view(self, x: Array, u: Array) -> Any:
        """Return what tasks are functions of."""
        return getattr(self.model, "view", Point)(x, u)

    def remembering(self) -> "NonlinearMPC":
        """Return the problem with a model of (x_k, u_{k−1}) where `Stages` have that state."""
        if not self.mpc.input_in_state:
            return self
        return replace(self, model=RememberingModel(self.model, self.mpc.system.n))

    def values(self, x: Array, u: Array) -> list[Array]:
        """Return what each task's function gives at its steps, (steps, p), along x (N+1, n),
        u (N, m)."""
        found = []
        for task in self.tasks:
            steps = task.at(len(u))
            each = jax.vmap(lambda x, u, task=task: self.value(task, x, u))
            found.append(each(at(x, steps), at(u, steps)))
        return found


@pytree
class RememberingModel:
    """A model with the state (x_k, u_{k−1}), of which n numbers are those of the given one."""

    given: Any
    n: int = static()

    def step(self, x: Array, u: Array) -> Array:
        """Return the next state."""
        return jnp.concatenate([self.given.step(x[: self.n], u), u])

    def linearize(self, x: Array, u: Array) -> LinearSystem:
        """Return the affine model about x, u."""
        return LinearSystem(*remembering(*linear_model(self.given, x[: self.n], u)))

    def view(self, x: Array, u: Array) -> Any:
        """Return what tasks are functions of."""
        return getattr(self.given, "view", Point)(x[: self.n], u)


@functools.lru_cache(maxsize=256)
def _shapes(tree: Any, leaves: tuple) -> tuple[tuple[int, ...], list[tuple[int, ...]], tuple]:
    """Return the shapes of the next state and of what each task's function gives, and the types of
    x, u and what tasks are functions of, for a problem with this structure and these shapes and
    dtypes of its leaves."""
    abstract = tree.unflatten([jax.ShapeDtypeStruct(*leaf) for leaf in leaves])
    system = abstract.mpc.system
    x, u = (jax.ShapeDtypeStruct((size,), jnp.result_type(float)) for size in (system.n, system.m))

    def outputs(problem: NonlinearMPC, x: Array, u: Array) -> Any:
        values = [problem.value(task, x, u) for task in problem.tasks]
        return problem.model.step(x, u), values, problem.view(x, u) if values else None

    with written_in_jax("model or task"):
        after, values, view = jax.eval_shape(outputs, abstract, x, u)
    if not hasattr(after, "shape"):
        cure = f"Give the next state ({system.n},), an array of jax.numpy"
        fail("model.step(x, u)", f"gives a {type(after).__name__}", cure)
    return after.shape, [value.shape for value in values], (x, u, view)


def weighed(weight: Any, v: Array) -> Array:
    """Return W v for v (..., p) with a weight that is a number, a diagonal or a matrix."""
    weight = jnp.asarray(weight, v.dtype)
    return matmul(v, symmetric(weight)) if weight.ndim == 2 else v * weight


def task_cost(task: Task, value: Array, target: Array) -> Array:
    """Return the cost of a task's function `value` (..., p), summed."""
    e = value - target
    return jnp.zeros((), e.dtype) if task.weight is None else jnp.sum(e * weighed(task.weight, e))


def total_cost(s: Stages, problem: NonlinearMPC, x: Array, u: Array) -> Array:
    """Return the cost of a trajectory without penalties; s: `Stages` of the MPC."""
    aim = s.aim
    e, d = x - aim.states, u - aim.inputs
    J = jnp.sum(e[:-1] * apply(s.Q, e[:-1])) + jnp.sum(d * apply(s.R, d))
    J = J + jnp.sum(e[-1] * matmul(e[-1], s.P.T))
    if s.cross is not None:
        J = J + 2 * jnp.sum(d * apply(s.cross, e[:-1]))
    for task, value, target in zip(problem.tasks, problem.values(x, u), aim.targets, strict=True):
        J = J + task_cost(task, value, at(target, task.at(len(u))))
    return J


def all_rows(s: Stages, problem: NonlinearMPC, x: Array, u: Array) -> Array:
    """Return the limited quantities of a trajectory (rows,), in the order of the expansion."""
    found = [s.rows(x, u)]
    for task, value in zip(problem.tasks, problem.values(x, u), strict=True):
        found += [value.ravel()] if task.limited else []
    return jnp.concatenate(found)


def linear_model(model: Any, x: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return A (n, n), B (n, m), c (n,) of the affine model about x (n,), u (m,)."""
    own = getattr(model, "linearize", None)
    if own is not None:
        return dynamics_of(own(x, u), x.dtype)
    moved = lambda x, u: (model.step(x, u),) * 2
    (A, B), after = jax.jacfwd(moved, argnums=(0, 1), has_aux=True)(x, u)
    return A, B, after - matmul(A, x) - matmul(B, u)


def expanded(s: Stages, problem: NonlinearMPC, x: Array, u: Array) -> Stages:
    """Return the problem about x (N+1, n), u (N, m); s: `Stages` of the MPC."""
    N, dtype = s.horizon, s.P.dtype
    A, B, c = jax.vmap(lambda x, u: linear_model(problem.model, x, u))(x[:-1], u)
    Q, R, P, cross = s.Q, s.R, s.P, s.cross
    gx, gu = s.gradient(x, u)
    blocks, bounds = list(s.blocks), [s.bounds]
    for task, target in zip(problem.tasks, s.aim.targets, strict=True):
        steps = task.at(N)
        pair = lambda x, u, task=task: (problem.value(task, x, u),) * 2
        slopes = jax.vmap(jax.jacfwd(pair, argnums=(0, 1), has_aux=True))
        (G, D), value = slopes(at(x, steps), at(u, steps))
        if task.weight is not None:
            error = 2 * weighed(task.weight, value - at(target, steps))
            turned = jnp.swapaxes(G, 1, 2), jnp.swapaxes(D, 1, 2)
            WG, WD = (jnp.swapaxes(weighed(task.weight, M), 1, 2) for M in turned)
            bent = spread(matmul(turned[0], WG), steps, N + 1)
            Q, P, R = Q + bent[:-1], P + bent[-1], R + spread(matmul(turned[1], WD), steps, N)
            cross = (0.0 if cross is None else cross) + spread(matmul(turned[1], WG), steps, N)
            give, take = majorant(problem, task, at(x, steps), at(u, steps), error)
            give = spread(give, steps, N + 1)
            Q, P, R = Q + give[:-1], P + give[-1], R + spread(take, steps, N)
            gx = gx + spread(apply_transposed(G, error), steps, N + 1)
            gu = gu + spread(apply_transposed(D, error), steps, N)
        if task.limited:
            about = apply(G, at(x, steps)) + apply(D, at(u, steps)) - value
            blocks.append(Rows("task", G, D, steps, box=False))
            bounds.append(task.bounds(about))
    return replace(
        s,
        A=A,
        B=B,
        c=c,
        Q=Q,
        R=R,
        P=P,
        cross=cross,
        blocks=tuple(blocks),
        bounds=joined_bounds(bounds, dtype),
        aim=Aim(s.aim.x0, x, u, slopes=(gx, gu)),
    )


def majorant(
    problem: NonlinearMPC, task: Task, x: Array, u: Array, error: Array
) -> tuple[Array, Array]:
    """Return diagonal weights of states (steps, n, n) and inputs (steps, m, m) that are at least
    the curvature which Gauss-Newton leaves out, ½ Σ error_i ∇²g_i, error = 2 W (g − target).

    A symmetric matrix is at most the diagonal of its absolute row sums. Where the target is met
    they are zero. Where it is out of reach, full Gauss-Newton steps alone may swing for
    ever; with these weights the expansion bounds the task's cost from above, next to the
    trajectory.
    """
    n = x.shape[-1]

    def sums(x: Array, u: Array, error: Array) -> Array:
        pulled = lambda z: jnp.sum(error * problem.value(task, z[:n], z[n:])) / 2
        return jnp.sum(jnp.abs(jax.jacfwd(jax.grad(pulled))(jnp.concatenate([x, u]))), axis=1)

    found = jax.vmap(sums)(x, u, error)
    diagonal = lambda v: v[:, :, None] * jnp.eye(v.shape[1], dtype=v.dtype)
    return diagonal(found[:, :n]), diagonal(found[:, n:])


def task_layout(problem: NonlinearMPC) -> tuple:
    """Return (kind, steps, rows a step) of the rows that tasks add."""
    N = problem.mpc.horizon
    sized = zip(problem.tasks, problem.sizes(), strict=True)
    return tuple(("task", task.at(N), size) for task, size in sized if task.limited)


def curved(
    s: Stages, base: Stages, problem: NonlinearMPC, x: Array, u: Array, costates: Array, y: Array
) -> Stages:
    """Return the expansion s with the Hessian of the Lagrangian in place of the Gauss-Newton one.

    base: `Stages` of the MPC; costates λ (N+1, n) of x_0 … x_N; y (rows,) of s.
    """
    N, n, dtype = s.horizon, s.P.shape[0], s.P.dtype
    hessian = lambda f, *args: jax.jacfwd(jax.grad(f))(*args) / 2
    join = lambda x, u: jnp.concatenate([x, u], axis=-1)

    def of_model(z: Array, pull: Array) -> Array:
        return hessian(lambda z: jnp.sum(pull * problem.model.step(z[:n], z[n:])), z)

    blocks = jnp.pad(jax.vmap(of_model)(join(x[:-1], u), costates[1:]), ((0, 1), (0, 0), (0, 0)))
    first = len(base.bounds.l)
    for task, target in zip(problem.tasks, base.aim.targets, strict=True):
        steps = task.at(N)
        size = target.shape[1]
        pull = jnp.zeros((len(steps), size), dtype)
        if task.limited:
            pull = y[first : first + pull.size].reshape(pull.shape)
            first += pull.size

        def of_task(z: Array, r: Array, pull: Array, task: Task = task) -> Array:
            def part(z: Array) -> Array:
                value = problem.value(task, z[:n], z[n:])
                return task_cost(task, value, r) + jnp.sum(pull * value)

            return hessian(part, z)

        where = join(at(x, steps), at(u, steps))
        found = jax.vmap(of_task)(where, at(target, steps), pull)
        blocks = blocks + spread(found, steps, N + 1)
    Q, R = base.Q + blocks[:-1, :n, :n], base.R + blocks[:-1, n:, n:]
    cross = blocks[:-1, n:, :n]
    if base.cross is not None:
        cross = cross + base.cross
    return replace(s, Q=Q, R=R, cross=cross, P=base.P + blocks[-1, :n, :n])
