"""A controller in C99: the condensed problem as tables, ADMM with a fixed number of steps as code.

The code is `mpc.c`, the same for all problems. What the matrices decide is computed here in float64
and written as data. With M = P + C'E R E C, R = diag(rho), a stage of the schedule needs
ZF = M⁻¹C'E R and ZQ = −M⁻¹ in the units of the problem; `Factor` has them in coordinates z = T w.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import each_part, joined
from jaxmpc.checks import (
    fail,
    positive,
    require_finite,
    require_kind,
    require_shape,
    require_untraced,
    shown,
    whole,
)
from jaxmpc.export.c_files import GIVE_PROBLEM, CFiles, input_limits, literal
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.plan import Plan, References, WarmStart, constant_references
from jaxmpc.mpc.policy_rows import PolicyCondensed
from jaxmpc.mpc.problem import MPC
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status

# Relative residuals below which the code says "solved".
TOLERANCE = {"float64": 1e-6, "float32": 1e-3}
# Closed loops of `check_fixed_steps`.
LOOPS = 20
# States that are drawn to find their starts, and at which plans are made at once.
DRAWN = 50 * LOOPS


def export_c(
    mpc: MPC,
    folder: str | Path,
    solver: ADMM | None = None,
    *,
    name: str = "mpc",
    dtype: Literal["float64", "float32"] = "float64",
    tolerance: float | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Write a controller as C99 code: what `Controller(mpc, solver)` does in a closed loop.

    Each call of `NAME_step` warm-starts from the plan before, takes `solver.iterations` steps of
    ADMM (50 where that is None) and none of Newton's: `solver` is taken with newton_steps=0.
    Nothing is allocated and no loop depends on data but for the branches of a projection, so the
    time of a call hardly varies. What it returns as status comes from residuals that it computes
    itself. Choose iterations and rho with `choose_steps` or `tune_solver`, and see what they reach
    with `check_fixed_steps`.

    References are constant over the horizon. Inputs in a Box are clipped into it. Of a system that
    differs from step to step the inputs themselves are the variables: no gain for each step keeps
    long predictions of unstable ones well-conditioned.

    folder: where NAME.c, NAME.h, NAME_sizes.h, NAME_tables.h and NAME_example.c are written. dtype:
    type of all numbers there; the tables are computed in float64. tolerance: of the residuals
    relative to the largest of their terms and `sizes_of_code`, None: 1e-6, and 1e-3 in float32.

    Returns the paths. Raises ValueError for a problem that cannot be solved, a name that C does not
    take, and files that exist, unless overwrite.
    """
    solver = ADMM() if solver is None else solver
    require_kind("mpc", mpc, MPC, cure=GIVE_PROBLEM)
    require_untraced("mpc", mpc)
    require_kind("solver", solver, ADMM)
    files = CFiles.open(folder, name, dtype, tolerance, TOLERANCE, overwrite)
    with jax.enable_x64(True):
        controller = Controller(mpc, replace(solver, newton_steps=0))
        if controller.condensed.K.ndim == 3:  # a plan is shifted in the variables of one gain
            mpc = replace(mpc, prestabilise=False)
            controller = Controller(mpc, controller.solver)
        fault = Status(int(controller.factor.fault))
        if fault != Status.NOT_RUN:
            fail("mpc", f"cannot be factored: {fault.name}", "See the status in jm.Status")
        sizes, tables = _sizes(controller), _tables(controller)
    real = files.real
    sizes["TOLERANCE"] = literal(files.tolerance, real)
    suffix = "f" if real == "float" else ""
    macros = {"FABS": f"fabs{suffix}", "SQRT": f"sqrt{suffix}"}
    macros["ALPHA"] = literal(float(np.asarray(controller.solver.alpha)), real)
    return files.write(("mpc.h", "mpc.c", "example.c"), sizes, tables, mpc.system.n, macros)


def _sizes(controller: Controller) -> dict[str, Any]:
    """What the code needs to know before it is compiled."""
    mpc, c, factor = controller.mpc, controller.condensed, controller.factor
    return {
        "STATES": mpc.system.n,
        "INPUTS": mpc.system.m,
        "PARAMETERS": mpc.dimension,
        "VARIABLES": c.P.shape[0],
        "ROWS": c.C.shape[0],
        "STAGES": factor.rho.shape[0],
        "ITERATIONS": controller.solver.admm_steps(),
        "THIN": int(factor.G is None),
        "SOFT": int(c.soft_linear is not None),
        "BALLS": len(c.balls),
        "BALL_ROWS": sum(c.balls),
        "RATES": int(mpc.rate_limited),
        "WARM": int(not isinstance(c, PolicyCondensed)),
    }


def _tables(controller: Controller) -> dict[str, Any]:
    """Every table of `mpc.c` by its name, in float64 and int."""
    mpc, c = controller.mpc, controller.condensed
    tables = jax.tree.map(np.asarray, _computed(controller)) | input_limits(mpc)
    tables["row_size"], tables["variable_size"] = jax.tree.map(
        np.asarray, sizes_of_code(controller)
    )
    if c.balls:
        tables["ball_rows"] = np.array(c.balls)
    if not isinstance(c, PolicyCondensed):
        N = mpc.horizon
        later = [mpc.moves[b + 1] if b + 1 < N else -1 for b in c.begins]
        tables |= jax.tree.map(np.asarray, _of_starts(controller))
        tables["later_move"] = np.array(later, int)
        tables["later_row"] = tables["later_row"].astype(int) - 1
    return {key: np.asarray(value) for key, value in tables.items()}


@jax.jit
def sizes_of_code(controller: Controller) -> tuple[jax.Array, jax.Array]:
    """Return sizes of rows (m,) and of gradients in the variables (nz,), in the units of the
    problem: beside them, or beside their terms where these are larger, the code finds residuals
    small. So they are at the origin too, where all terms vanish.

    A row has the size of its nearest bound that is not 0. In the coordinates of ADMM, where the
    Hessian is the identity, states and gradients are lengths alike: the median over the rows of the
    plan of how far these bounds are is the size of the variables, and of rows without one.
    """
    c, factor = controller.condensed, controller.factor
    ends = jnp.abs(jnp.stack([c.lower, c.upper]))
    nearest = jnp.min(jnp.where((ends > 0) & jnp.isfinite(ends), ends, jnp.inf), axis=0)
    far = jnp.where(jnp.isfinite(nearest) & (factor.E > 0), nearest * factor.E, jnp.nan)
    if isinstance(c, PolicyCondensed):  # what a policy answers costs next to nothing
        far = far[: c.copies * sum(len(steps) * size for _, steps, size in c.layout)]
    length = jnp.nanmedian(far)
    length = jnp.where(jnp.isfinite(length), length, 0.0)
    rows = jnp.where(jnp.isfinite(nearest), nearest, length * factor.row_norms)
    return rows, length / jnp.sum(jnp.abs(factor.T), axis=1)


@jax.jit  # in one program, not in a hundred small ones
def _computed(controller: Controller) -> dict[str, Any]:
    """The tables of the program and its factorization."""
    mpc, c, factor = controller.mpc, controller.condensed, controller.factor
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    origin, T = jnp.zeros(mpc.dimension), factor.T

    def q_of_reference(r: jax.Array) -> jax.Array:
        return c.qp(origin, reference=jnp.broadcast_to(r, (N + 1, n))).q

    def q_of_input_reference(r: jax.Array) -> jax.Array:
        return c.qp(origin, input_reference=jnp.broadcast_to(r, (N, m))).q

    bounds = c.qp(origin).bounds.scaled(factor.E)
    tables = {
        "P": c.P,
        "C": c.C,
        "E": factor.E,
        "rho": factor.rho.ravel(),
        # From coordinates w to z = T w, and from q to q_w = T'q.
        "ZF": T @ factor.F,
        "ZQ": -(T @ factor.Minv @ T.T),
        "q_theta": c.F,
        "q_constant": c.f,
        "q_state": jax.jacfwd(q_of_reference)(jnp.zeros(n)),
        "q_input": jax.jacfwd(q_of_input_reference)(jnp.zeros(m)),
        "shift_theta": c.D,
        "shift_constant": c.d,
        "lower": c.lower,
        "upper": c.upper,
        "first_theta": c.Psi[0],
        "first_z": c.Omega[0],
        "first_constant": c.psi[0],
    }
    if factor.G is not None:
        tables["G"] = factor.G
    if bounds.linear is not None:
        tables |= {"soft_linear": bounds.linear, "soft_quadratic": bounds.quadratic}
    if c.balls:
        tables["radius"] = bounds.radius
    return tables


@jax.jit
def _of_starts(controller: Controller) -> dict[str, Any]:
    """The tables by which a plan begins with its references or with the plan before.

    later_row: number of the row of the last plan, from 1, whose multiplier each row begins with, 0
    for none: what `Controller.shifted` does to multipliers that are the numbers of their rows."""
    mpc, c = controller.mpc, controller.condensed
    N, n, m = mpc.horizon, mpc.system.n, mpc.system.m
    numbers = jnp.arange(1.0, c.C.shape[0] + 1)
    states, inputs = jnp.zeros((N + 1, n)), jnp.zeros((N, m))
    start = WarmStart(states, inputs, numbers)
    tables = {
        "z_state": jax.jacfwd(lambda r: c.variables(states + r, inputs))(states[0]),
        "z_input": jax.jacfwd(lambda r: c.variables(states, inputs + r))(inputs[0]),
        "end_theta": c.Phi[N],
        "end_z": c.Gamma[N],
        "end_constant": c.phi[N],
        "tail_gain": c.K_N,
        "prestabilising_gain": c.K,
        "later_row": start.shifted(c.layout, jnp.zeros(m), bool(c.balls)).multipliers,
    }
    if mpc.rate_limited:
        tables |= {"last_theta": c.Psi[-1], "last_z": c.Omega[-1], "last_constant": c.psi[-1]}
    return tables


# --- Closed loops under the law of the code, beside plans that are solved to the end ----


@dataclass(frozen=True)
class ClosedLoopCheck:
    """What `check_fixed_steps` found along closed loops.

    plans: how many. solvable: how many of them are solved by ADMM and Newton steps. reached:
    how many of these the fixed number of steps solves to the tolerance. input_error: the largest
    difference between the inputs of the two where both are solved; input_error_any: where the
    precise plan is. Both are 0 where there is no such plan.
    """

    plans: int
    solvable: int
    reached: int
    input_error: float
    input_error_any: float


def require_box(mpc: MPC, lower: Any, upper: Any) -> None:
    """Raise ValueError where the corners of a box of states are not (n,) finite numbers each, in
    this order."""
    for argument, bound in (("lower", lower), ("upper", upper)):
        require_shape(argument, bound, (mpc.system.n,), "Give a number for each state")
        require_finite(argument, bound)
    if np.any(np.asarray(lower) > np.asarray(upper)):
        fail("lower", f"{shown(lower)} exceeds upper {shown(upper)}", "Give lower, then upper")


def solved_by_code(controller: Controller, plan: Plan, tolerance: Any) -> Any:
    """Return whether the code says SOLVED of a plan: its residuals are small beside `sizes_of_code`
    (here the least of these), where those of a `Plan` near the origin are measured by its own
    size."""
    rows, variables = (jnp.min(v, initial=jnp.inf) for v in sizes_of_code(controller))
    small = (plan.primal_residual <= tolerance * rows) & (
        plan.dual_residual <= tolerance * variables
    )
    return (plan.status == Status.SOLVED) | small


@jax.jit  # compiled once for all controllers of a problem
def _controls(controller: Controller, states: Any, before: Any, target: References) -> Any:
    """Return inputs (B, m) and statuses (B,) of plans from states (B, n) after inputs (B, m)."""
    one = lambda x, u: controller(x, None, **target, previous_input=u)
    found = jax.vmap(one)(states, before)
    return found.u, found.plan.status


def _precise_plans(
    controller: Controller, states: np.ndarray, before: np.ndarray, target: References
) -> tuple[np.ndarray, np.ndarray]:
    """Return `_controls` in parts of one shape."""
    program = lambda rows: _controls(controller, *rows, target)
    return joined([part.result for part in each_part(program, (states, before), DRAWN)])


def starting_states(
    controller: Controller, lower: np.ndarray, upper: np.ndarray, seed: int, target: References
) -> np.ndarray:
    """Return random states (`LOOPS`, n) of a box, such that have a plan where there are some."""
    starts = np.random.default_rng(seed).uniform(lower, upper, (DRAWN, len(lower)))
    before = np.zeros((DRAWN, controller.mpc.system.m))
    _, status = _precise_plans(controller, starts, before, target)
    return starts[np.argsort(status != Status.SOLVED, kind="stable")[:LOOPS]]


def check_fixed_steps(
    mpc: MPC,
    solver: ADMM,
    lower: Reals,
    upper: Reals,
    plans: int = 1000,
    tolerance: float = 1e-6,
    seed: int = 0,
    *,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
) -> ClosedLoopCheck:
    """Run `Controller(mpc, solver)` with newton_steps=0 from random states of the box [lower,
    upper] (n,), and at each state solve the plan precisely too.

    20 closed loops begin at states that have a plan.

    lower, upper: corners (n,) of the box. plans: how many, rounded up to a multiple of 20.
    tolerance: as in `export_c`. reference (n,), input_reference (m,): state and input that the
    loops track, such as those of `equilibrium`; None: zero.

    Raises ValueError for an invalid problem, bounds and references of another shape, and bad
    counts.
    """
    require_kind("mpc", mpc, MPC, cure=GIVE_PROBLEM)
    require_untraced("mpc", mpc)
    require_kind("solver", solver, ADMM)
    mpc.require_constant("closed loops need one system for all time steps", "system")
    whole("plans", plans, 1)
    positive("tolerance", tolerance)
    require_box(mpc, lower, upper)
    with jax.enable_x64(True):
        lower, upper = host_array("lower", lower), host_array("upper", upper)
        fixed = Controller(mpc, replace(solver, newton_steps=0, eps=tolerance))
        precise = Controller(mpc, ADMM())
        target = constant_references(mpc, reference, input_reference)
        starts = starting_states(precise, lower, upper, seed, target)

        def step(state: Any, _: Any) -> Any:
            x, before = state
            control = fixed(x, before, **target)
            solved = solved_by_code(fixed, control.plan, tolerance)
            return (mpc.system.step(x, control.u), control), (x, before.u, control.u, solved)

        def loop(x: Any) -> Any:
            return jax.lax.scan(step, (x, fixed.start(x)), length=-(-plans // LOOPS))[1]

        loops = (np.asarray(v) for v in jax.jit(jax.vmap(loop))(starts))
        x, before, u, solved = (v.reshape(-1, *v.shape[2:]) for v in loops)
        best_u, best = _precise_plans(precise, x, before, target)
        error = np.abs(u - best_u).max(axis=1)
    solvable = best == Status.SOLVED
    both = solvable & solved
    return ClosedLoopCheck(
        plans=best.size,
        solvable=int(solvable.sum()),
        reached=int(both.sum()),
        input_error=float(error[both].max(initial=0.0)),
        input_error_any=float(error[solvable].max(initial=0.0)),
    )
