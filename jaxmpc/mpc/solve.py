"""solve: one plan from one state; Controller: the same with the factorization done once."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.checks import concrete, fail
from jaxmpc.control.sets import Box, Polytope
from jaxmpc.mpc.condense import Condensed, condense
from jaxmpc.mpc.problem import MPC, Multipliers, Plan
from jaxmpc.mpc.rows import blocks
from jaxmpc.qp.admm import ADMM, Factor
from jaxmpc.qp.admm import factor as factorise
from jaxmpc.qp.precision import arrays, matmul
from jaxmpc.qp.solve import marked, solve_factored
from jaxmpc.qp.status import Status

# (kind, steps, rows a step) of each block of rows.
Layout = tuple[tuple[str, tuple[int, ...], int], ...]


def solve(
    mpc: MPC, x0: Any, reference: Any = None, solver: ADMM = ADMM(), warm_start: Any = None, *,  # noqa: B008
    input_reference: Any = None, previous_input: Any = None,
) -> Plan:  # fmt: skip
    """Solve one MPC problem from the state x0 (n,).

    reference: state to track, (n,) or (N+1, n), in place of the origin: the cost becomes
    Σ (x_k − r_k)'Q(x_k − r_k) + …; constraints, the terminal set too, stay where they are.
    input_reference: input to track, (m,) or (N, m), such as that of `equilibrium`; None for zero.
    previous_input: u_{−1} (m,) where the problem limits or weighs input rates; None for zero.
    warm_start: an earlier Plan.

    `jax.vmap(solve, in_axes=(None, 0))(mpc, x0s)` solves for many states and factors
    once. Raises ValueError for an ill-posed problem or wrong shapes, before any compile; what
    depends on values inside a batch is answered by `plan.status`.
    """
    return Controller(mpc, solver).plan(x0, reference, warm_start, input_reference, previous_input)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Controller:
    """An MPC law whose matrices are condensed and factored once, at construction.

    `controller(x, carry) -> (u, carry, plan)`: u (m,) is the first input of the plan, clipped
    into its limits if these are a Box; carry is None at the start and the previous plan
    afterwards, whose `shifted` form is the warm start and whose first input is the previous one
    (zero at the start). When the plan is not SOLVED, u is still the first input of the best
    iterate: look at plan.status. `condensed` and `factor` are filled in at construction: for
    another problem or solver make another Controller, `dataclasses.replace` would keep the old
    ones.
    """

    mpc: MPC
    solver: ADMM = ADMM()  # noqa: RUF009
    condensed: Condensed | None = None
    factor: Factor | None = None

    def __post_init__(self) -> None:
        # JAX rebuilds this object with its parts present, or with placeholders: leave those be.
        if self.condensed is None and isinstance(self.mpc, MPC):
            self.mpc.validate()
            mpc, finite = harmless(self.mpc)
            condensed = condense(mpc)
            # The factorization reads from P what is wrong with the data.
            condensed = replace(condensed, P=jnp.where(finite, condensed.P, jnp.nan))
            self.solver.validate(condensed.C.shape[0])
            # Arrays from here on, so that a sample need not convert the whole object again.
            mpc = replace(mpc, prestabilise=condensed.K)
            object.__setattr__(self, "mpc", arrays(mpc))
            object.__setattr__(self, "solver", arrays(self.solver))
            object.__setattr__(self, "condensed", condensed)
            object.__setattr__(self, "factor", _factor(condensed, self.solver))

    @property
    def dtype(self) -> Any:
        """In what the controller computes."""
        assert self.condensed is not None
        return self.condensed.P.dtype

    @property
    def state_size(self) -> int:
        """Numbers in the state that the controller is given."""
        return self.mpc.system.n

    @property
    def limits(self) -> Box | Polytope | None:
        """Limits of the state that a closed loop is judged by."""
        return self.mpc.states

    def coordinates(self, x: Array) -> Array:
        """The state in which `mpc` is written: x itself."""
        return x

    def start(self, x: Array, input_reference: Any = None) -> Plan:
        """What to carry into the first sample: a plan of zeros, a cold start.

        (So that a scan compiles one solve, not two: without a warm start and with.)"""
        shapes = jax.eval_shape(lambda x: self(x)[1], x)
        return jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shapes)

    def __call__(
        self, x: Any, carry: Plan | None = None, reference: Any = None, *,
        input_reference: Any = None, previous_input: Any = None,
    ) -> tuple[Array, Plan, Plan]:  # fmt: skip
        """First input from state x (n,), what to carry to the next sample, and the whole plan.

        References and previous_input as in `solve`; previous_input None: what the carry says.
        """
        start = None if carry is None else self.shifted(carry)
        if carry is not None and previous_input is None and self.mpc.remembers:
            previous_input = limited(self.mpc.inputs, carry.inputs[0])
        plan = self.plan(x, reference, start, input_reference, previous_input)
        return limited(self.mpc.inputs, plan.inputs[0]), plan, plan

    def shifted(self, plan: Plan) -> tuple[Array, Array]:
        """The plan seen one sample later, as a warm start (z, y).

        Inputs and multipliers move up by one step. The new last input is the unconstrained
        optimum of that step for the terminal cost, inside its limits; its rows push with nothing.
        What bounded x_N through the terminal set bounds it as a state from now on, where both
        have the same rows. With a control horizon each move becomes what the plan did one step
        after its beginning.
        """
        c = self.condensed
        assert c is not None
        x, moves, N = plan.states[-1], np.array(self.mpc.moves), self.mpc.horizon
        tail = limited(self.mpc.inputs, matmul(c.K_N, x)) - matmul(c.K, x)
        z = jnp.concatenate([plan.qp.z.reshape(-1, c.R.shape[0]), tail[None]])
        # A move takes over what the old plan did one step after the move begins.
        begins = np.unique(moves, return_index=True)[1]
        z = z[np.append(moves, moves[-1] + 1)[begins + 1]]
        return z.ravel(), shifted_multipliers(c.layout, N, plan.qp.y, bool(c.balls))

    def plan(
        self, x0: Any, reference: Any = None, warm_start: Any = None, input_reference: Any = None,
        previous_input: Any = None,
    ) -> Plan:  # fmt: skip
        """Plan from x0 (n,); arguments as in `solve`."""
        c = self.condensed
        assert c is not None
        (steps, n, p), m, dtype = c.Phi.shape, c.R.shape[0], c.P.dtype
        if np.shape(x0) != (n,):
            fail("x0", f"shape {np.shape(x0)}", f"Give one state ({n},); use jax.vmap for many")
        theta = jnp.asarray(x0, dtype)
        if previous_input is not None and np.shape(previous_input) != (m,):
            fail("previous_input", f"shape {np.shape(previous_input)}", f"Give one input ({m},)")
        if p > n:
            previous = jnp.zeros(m, dtype) if previous_input is None else previous_input
            theta = jnp.concatenate([theta, jnp.asarray(previous, dtype)])
        tracked = []
        for name, value, shape in (
            ("reference", reference, (steps, n)),
            ("input_reference", input_reference, (steps - 1, m)),
        ):
            if value is not None:
                if np.shape(value) not in (shape[1:], shape):
                    fail(name, f"shape {np.shape(value)}", f"Give {shape[1:]} or {shape}")
                value = jnp.broadcast_to(jnp.asarray(value, dtype), shape)
            tracked.append(value)
        start = warm_start.qp if isinstance(warm_start, Plan) else warm_start
        return _plan(self, *arrays((theta, *tracked, start)))

    def cost(
        self, states: Array, inputs: Array, reference: Any = None, input_reference: Any = None,
        previous_input: Any = None,
    ) -> Array:  # fmt: skip
        """J (without ½) of a trajectory, states (N+1, n) and inputs (N, m), with what input rates
        and soft rows pay. previous_input (m,): None for zero."""
        return cost(self.mpc, states, inputs, reference, input_reference, previous_input)

    def slack(self, states: Array, inputs: Array) -> Array:
        """Violation of the soft rows along a trajectory: (N+1, p), zero where none holds."""
        return slack(self.mpc, states, inputs)

    def multipliers(self, y: Array) -> Multipliers:
        """Sort the QP's multipliers y (rows,) by constraint and step."""
        c = self.condensed
        assert c is not None
        return multipliers(self.mpc, c.layout, y)


def harmless(mpc: MPC) -> tuple[MPC, Any]:
    """Return the problem with harmless dynamics and weights where they are not finite, and whether
    they are: numbers that are being traced cannot be refused."""
    fields = ("system", "Q", "R", "terminal_cost", "stage_weights", "input_rate_weight")
    data = {name: getattr(mpc, name) for name in fields}
    if concrete(data):
        return mpc, True
    leaves = jax.tree.leaves(data)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(jnp.asarray(v))) for v in leaves]))
    clean = jax.tree.map(lambda v: jnp.where(finite, jnp.asarray(v), 0), data)
    clean["R"] = jnp.where(finite, jnp.asarray(mpc.R), np.eye(mpc.system.m))
    return replace(mpc, **clean), finite


def limited(inputs: Any, u: Array) -> Array:
    """u inside the input limits, if these are a Box: an actuator takes no rounding beyond them."""
    if not isinstance(inputs, Box):
        return u
    lower, upper = arrays((inputs.lower, inputs.upper))
    return jnp.clip(u, jnp.asarray(lower, u.dtype), jnp.asarray(upper, u.dtype))


def cost(
    mpc: MPC, states: Array, inputs: Array, reference: Any = None, input_reference: Any = None,
    previous_input: Any = None,
) -> Array:  # fmt: skip
    """J (without ½) of a trajectory; see `Controller.cost`."""
    error = states if reference is None else states - reference
    effort = inputs if input_reference is None else inputs - input_reference
    cast = lambda W: jnp.asarray(W, states.dtype)
    square = lambda v, W, s=1.0: jnp.sum(s * v * matmul(v, cast(W)))
    stage = 1.0 if mpc.stage_weights is None else cast(mpc.stage_weights)[:, None]
    J = square(error[:-1], mpc.Q, stage) + square(effort, mpc.R, stage)
    if mpc.terminal_cost is not None:
        J = J + square(error[-1:], mpc.terminal_cost)
    if mpc.input_rate_weight is not None:
        W = cast(mpc.input_rate_weight)
        first = jnp.zeros_like(inputs[0]) if previous_input is None else previous_input
        rates = jnp.diff(inputs, axis=0, prepend=first[None])
        J = J + square(rates, jnp.diag(W) if W.ndim == 1 else W)
    for block, e in _violations(mpc, states, inputs):
        J = J + jnp.sum(e * (block.linear + 0.5 * block.quadratic * e))
    return J


def slack(mpc: MPC, states: Array, inputs: Array) -> Array:
    """Violation of the soft rows along a trajectory; see `Controller.slack`."""
    columns = [
        jnp.zeros((len(states), block.size), e.dtype).at[np.array(block.steps, int)].set(e)
        for block, e in _violations(mpc, states, inputs)
    ]
    return jnp.concatenate([jnp.zeros((len(states), 0), states.dtype), *columns], axis=1)


def _violations(mpc: MPC, states: Array, inputs: Array) -> list[tuple[Any, Array]]:
    """Each soft block with its violations (steps, rows)."""
    if not mpc.soft:
        return []
    found = []
    for block in blocks(mpc, states.dtype):
        if block.linear is not None:
            steps = np.array(block.steps, int)
            value = matmul(states[steps], block.H.T)
            if block.D is not None:
                value = value + matmul(inputs[steps], block.D.T)
            beyond = jnp.maximum(value - block.upper, block.lower - value)
            found.append((block, jnp.maximum(beyond, 0.0)))
    return found


def multipliers(mpc: MPC, layout: Layout, y: Array) -> Multipliers:
    """The multipliers y (rows,) of all rows sorted by constraint and step."""
    of: dict[str, list[Array]] = {}
    for (kind, _, _), part in zip(layout, split(layout, y), strict=True):
        of.setdefault(kind, []).append(part)
    empty = lambda *shape: [jnp.zeros(shape, y.dtype)]
    return Multipliers(
        states=of.get("state", empty(len(mpc.state_steps), 0))[0],
        inputs=of.get("input", empty(mpc.horizon, 0))[0],
        terminal=of.get("terminal", empty(1, 0))[0][0],
        outputs=tuple(of.get("output", ())), soft=tuple(of.get("soft", ())),
        rates=of.get("rate", [None])[0],
    )  # fmt: skip


def shifted_multipliers(layout: Layout, horizon: int, y: Array, round_end: bool = False) -> Array:
    """Multipliers (rows,) of a plan as a warm start one sample later: see `Controller.shifted`.

    round_end: the terminal set is an ellipsoid, whose rows are no state limits.
    """
    parts = split(layout, y)
    terminal = next((part[0] for (kind, *_), part in zip(layout, parts, strict=True)
                     if kind == "terminal"), y[:0])  # fmt: skip
    moved = []
    for (kind, steps, size), part in zip(layout, parts, strict=True):
        if kind != "terminal":
            # Step k takes over from k + 1: from the block itself, else from the terminal set.
            place = {k: j for j, k in enumerate(steps)}
            same = kind == "state" and not round_end and terminal.shape[0] == size
            last = terminal if same else jnp.zeros(size, y.dtype)
            source = jnp.concatenate([part, last[None], jnp.zeros((1, size), y.dtype)])
            end = len(steps)
            later = [place.get(k + 1, end if k + 1 == horizon else end + 1) for k in steps]
            part = source[np.array(later, int)]
        moved.append(part.ravel())
    return jnp.concatenate([*moved, y[:0]])


def split(layout: Layout, y: Array) -> list[Array]:
    """y (rows,) as one array (steps, rows a step) for each block."""
    ends = np.cumsum([len(steps) * size for _, steps, size in layout], dtype=int)
    shapes = [(len(steps), size) for _, steps, size in layout]
    parts = jnp.split(y, ends)[: len(shapes)]
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


@jax.jit
def _factor(condensed: Condensed, solver: ADMM) -> Factor:
    return factorise(condensed.P, condensed.C, solver, condensed.balls)


@jax.jit
def _plan(
    controller: Controller, theta: Array, reference: Any, input_reference: Any, start: Any
) -> Plan:
    c = controller.condensed
    assert c is not None and controller.factor is not None
    given = (theta, reference, input_reference)
    finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(v)) for v in jax.tree.leaves(given)]))
    # Harmless numbers until all is computed: the derivative of a product with NaN is NaN.
    theta, reference, input_reference = jax.tree.map(lambda v: jnp.where(finite, v, 0.0), given)
    qp = c.qp(theta, reference, input_reference)
    found, fault = solve_factored(qp, controller.factor, controller.solver, start)
    fault = jnp.where(finite, fault, Status.NON_FINITE)
    states, inputs = c.trajectory(theta, found.z)
    previous = theta[c.Q.shape[0] :] if controller.mpc.remembers else None
    cost = controller.cost(states, inputs, reference, input_reference, previous)
    slack, solution = controller.slack(states, inputs), marked(found, fault)
    nan = lambda v: jnp.where(fault == Status.NOT_RUN, v, jnp.nan)
    return Plan(
        states=nan(states), inputs=nan(inputs), cost=nan(cost), slack=nan(slack),
        multipliers=controller.multipliers(solution.y), status=solution.status,
        primal_residual=solution.primal_residual, dual_residual=solution.dual_residual,
        gap=solution.gap, iterations=solution.iterations,
        qp=solution,
    )  # fmt: skip
