"""Tasks of `tune_weights`, for a linear problem and for a robot: which weights, loops and loss.

Beside the weights Q, R and P (the terminal weight) a task may tune rho, the L1 weight of soft
limits, and the tightening: the fraction of their half-width by which state limits are moved
inwards. All is checked before a closed loop compiles.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, numpy_array
from jaxmpc.checks import fail, generator, is_definite, require_finite, require_memory
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.closed_loop.robot_controller import (
    RobotController,
    lqr_cost,
    robot_references,
    with_margin,
)
from jaxmpc.closed_loop.simulation import Run, simulate_many
from jaxmpc.closed_loop.variations import plant_numbers
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.mpc.condense import Inequalities, prestabilising_gain
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC, soften
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.linalg import float64_arrays
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.parameters import require_numbers
from jaxmpc.robots.robot import Robot
from jaxmpc.sets.convex_sets import Box, Polytope
from jaxmpc.sets.limits import TOLERANCE, rows_kept
from jaxmpc.sets.lp import Program
from jaxmpc.tuning.losses import TERMS, ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter, is_diagonal
from jaxmpc.tuning.result import TuningRun
from jaxmpc.tuning.weights import LOOP_SOLVER, tune_weights

# The largest fraction by which limits can be tightened.
TIGHTEST = 0.5
# The most random states that are drawn for each state wanted.
TRIES = 10
# Values of the parameters by name: traced ones, or arrays.
Values = Mapping[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class WeightTask:
    """Weights to tune, from `linear_task` or `robot_task`.

    make: values → MPC or controller. x0s (B, n or nq + nv): initial states.
    variations: of the plants, name → (B, ...), as in `simulate_many`.
    validation: so many of the last initial states are for validation. loss: of a run.
    limits: of the states, not tightened. mpc: the problem before tuning, with hard limits.
    dtype: of loops and derivatives.
    """

    name: str
    make: Callable[[Values], MPC | RobotController]
    parameters: dict[str, Parameter]
    plant: LinearPlant | Robot
    x0s: np.ndarray
    variations: dict[str, np.ndarray]
    validation: int
    loss: ClosedLoopLoss
    reference: np.ndarray | None
    input_reference: np.ndarray | None
    steps: int
    solver: ADMM
    dtype: str
    limits: Box | Polytope | None
    mpc: MPC

    def tune(self, **settings: Any) -> TuningRun:
        """Return the run of `tune_weights`. settings: its mode, and those of `Settings`."""
        with jax.enable_x64(self.dtype == "float64"):
            return tune_weights(
                self.make,
                self.parameters,
                self.plant,
                self.x0s,
                self.loss,
                self.steps,
                reference=self.reference,
                input_reference=self.input_reference,
                variations=self.variations,
                solver=self.solver,
                validation=self.validation / len(self.x0s),
                **settings,
            )

    def simulate(self, make: Callable[[], Any]) -> Run:
        """Simulate the validation loops with the controller, or the MPC, that `make` returns."""
        count = self.validation
        with jax.enable_x64(self.dtype == "float64"):
            made = make()
            return simulate_many(
                Controller(made, self.solver) if isinstance(made, MPC) else made,
                self.plant,
                self.x0s[-count:],
                self.steps,
                reference=self.reference,
                input_reference=self.input_reference,
                variations={name: v[-count:] for name, v in self.variations.items()},
            )

    def terms(self, run: Run) -> dict[str, float]:
        """Return the mean over the loops of each term of the loss."""
        with jax.enable_x64(self.dtype == "float64"):
            given = jax.tree.map(jnp.asarray, run)
            each = jax.tree.map(np.asarray, jax.jit(jax.vmap(self.loss.terms))(given))
        # The program has them in the order of the alphabet.
        return {name: float(np.mean(each[name])) for name in TERMS if name in each}

    def counts(self, run: Run, tolerance: float) -> dict[str, float]:
        """Return fractions of loops and plans from states and inputs alone: violated, unsolved,
        infeasible, unproved, fallback, at_target (within this fraction of half the range of each
        state)."""
        goal = np.zeros(self.plant.n) if self.reference is None else self.reference
        outcome = evaluate_runs(run, self.plant, goal, tolerance=tolerance)
        kept = outcome.kept
        if isinstance(self.limits, Polytope):
            limits = float64_arrays(self.limits)
            kept = kept & rows_kept(limits, outcome.coordinates).all(axis=(1, 2))
        status = np.asarray(run.status)
        return {
            "loops": len(kept),
            "plans": int(status.size),
            "violated": float(np.mean(~kept)),
            "kept_to": TOLERANCE["float64"],
            "unsolved": float(np.mean(status != Status.SOLVED)),
            "infeasible": float(np.mean(status == Status.PRIMAL_INFEASIBLE)),
            "unproved": float(
                np.mean((status != Status.SOLVED) & (status != Status.PRIMAL_INFEASIBLE))
            ),
            "fallback": float(np.mean((status == Status.SOLVED) & np.asarray(run.fallback))),
            "at_target": float(np.mean(outcome.reached)),
        }


def weight_parameters(
    mpc: MPC,
    tune: Sequence[str] = ("Q", "R"),
    *,
    weights: str = "diagonal",
    rho: float | None = None,
    margin: float = 0.0,
    limits: Box | Polytope | None = None,
    target: np.ndarray | None = None,
) -> dict[str, Parameter]:
    """Return what is tuned, of Q, R, P, rho and tightening, as it is at the start.

    tune: names of these.
    weights: "diagonal" or "full", the form of Q and R; P is full unless it starts diagonal. rho:
    the L1 weight of soft limits. margin: the tightening of the state `limits` at the start, which
    is at most TIGHTEST and leaves the target (n,) inside. Raises ValueError for a weight that is
    not positive definite, and for what the problem does not have.
    """
    mpc.require_constant("jm.tuning.MPCLayer alone learns it", "Q", "R")
    found: dict[str, Parameter] = {}
    for name, value in (("Q", mpc.Q), ("R", mpc.R), ("P", mpc.terminal_cost)):
        if name not in tune:
            continue
        if value is None:
            fail(f"tune {name}", "the problem has no terminal weight", 'Give [cost] P = "lqr"')
        value = np.asarray(value, float)
        diagonal = is_diagonal(value)
        if weights == "diagonal" and not diagonal and name != "P":
            fail("weights", f"diagonal, and {name} of the problem is not", "Add --weights full")
        if not is_definite(value):
            cure = "Give each direction a small weight to start from"
            fail(f"tune {name}", f"{name} is not positive definite", cure)
        domain = "diagonal" if weights == "diagonal" and diagonal else "definite"
        found[name] = Parameter(value, domain)
    if "rho" in tune:
        if not rho:
            cure = (
                'Give it [cost] rho = "exact", or a number in cost per unit of a violated limit: '
                "limits of states and the terminal set become soft"
            )
            fail("tune rho", "the problem has no soft limits", cure)
        found["rho"] = Parameter(rho, "positive")
    if "tightening" in tune:
        if not isinstance(limits, Box):
            fail("tune tightening, margin", "the problem has no x_min, x_max", "Give limits")
        found["tightening"] = _tightening(
            margin, limits, np.zeros(mpc.system.n) if target is None else target
        )
    return found


def linear_task(
    mpc: MPC,
    parameters: dict[str, Parameter],
    x0s: Reals,
    *,
    name: str = "mpc",
    terminal_weight: str = "given",
    rho: float | None = None,
    limits: Box | Polytope | None = None,
    solver: ADMM = LOOP_SOLVER,
    steps: int = 50,
    validation: float = 0.25,
    dtype: str = "float64",
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    **terms: Any,
) -> WeightTask:
    """Return the task of a linear problem with hard limits, controlled by `Controller`.

    parameters: of `weight_parameters`. terminal_weight: where P is not tuned it follows the tuned
    Q and R as "lqr" or "Q", or stays as "given". rho: the L1 weight of soft limits, None for hard
    ones. limits: of the states, where those of the problem are tightened ones. validation: fraction
    of the initial states x0s (B, n). terms: of `weight_loss`.
    """
    mpc.require_constant("closed loops have the same problem at every time step")
    limits = mpc.states if limits is None else limits
    n, inputs = mpc.system.n, mpc.inputs
    assert isinstance(inputs, Box)
    box = limits if isinstance(limits, Box) else Box(np.full(n, -np.inf), np.full(n, np.inf))
    # The gain that keeps predictions of unstable plants in bounds changes rounding only.
    base = dataclasses.replace(mpc, prestabilise=prestabilising_gain(mpc))
    shared = mpc.terminal_set is mpc.states

    def make(values: Values) -> MPC:
        made = _weighted(base, values, terminal_weight)
        if "tightening" in values:
            states = box.tightened(values["tightening"])
            end = states if shared else made.terminal_set
            made = dataclasses.replace(made, states=states, terminal_set=end)
        return made if rho is None else soften(made, values.get("rho", rho))

    plant = LinearPlant(mpc.system, box, inputs, name=name)
    plant.validate()
    return WeightTask(
        name=name,
        make=make,
        parameters=parameters,
        plant=plant,
        x0s=numpy_array(x0s),
        variations={},
        validation=_validation(validation, len(np.asarray(x0s))),
        loss=weight_loss(mpc.Q, mpc.R, limits, reference, input_reference, **terms),
        reference=None if reference is None else np.asarray(reference, float),
        input_reference=None if input_reference is None else np.asarray(input_reference, float),
        steps=steps,
        solver=solver,
        dtype=dtype,
        limits=limits,
        mpc=mpc,
    )


def robot_task(
    robot: Robot,
    mpc: MPC,
    parameters: dict[str, Parameter],
    x0s: Reals,
    *,
    terminal_weight: str = "lqr",
    rho: float = 1e4,
    target: Reals | None = None,
    linearize: str = "state",
    factors: Mapping[str, np.ndarray] | None = None,
    solver: ADMM | None = None,
    steps: int = 50,
    validation: float = 0.25,
    dtype: str = "float32",
    **terms: Any,
) -> WeightTask:
    """Return the task of a robot under `RobotController`, which rests at `target`.

    terminal_weight, terms: as in `linear_task`; "lqr" follows a terminal cost that there is, which
    `robot_mpc` leaves out where the set-point does not rest. target: configuration to rest at.
    mpc: of `robot_mpc` for this target. x0s, factors: of `draw_robots`; the MPC keeps
    the nominal model. linearize, rho, solver: of `RobotController`. The rest as in `linear_task`.
    """
    reference, input_reference = robot_references(robot, target)
    with jax.enable_x64(True):
        x = np.asarray(robot.state(reference))
    if mpc.terminal_cost is None and terminal_weight == "lqr":
        terminal_weight = "given"
    loss = weight_loss(mpc.Q, mpc.R, robot.state_limits, reference, input_reference, robot, **terms)
    variations = plant_numbers(robot, dict(factors or {}))
    require_numbers(robot.plant, variations, (len(np.asarray(x0s)),))

    def make(values: Values) -> RobotController:
        made = _weighted(mpc, values, terminal_weight)
        if "tightening" in values:
            made = with_margin(robot, made, x, values["tightening"])
        return RobotController(robot, made, solver, linearize=linearize, rho=values.get("rho", rho))

    return WeightTask(
        name=robot.name,
        make=make,
        parameters=parameters,
        plant=robot,
        x0s=numpy_array(x0s),
        variations=variations,
        validation=_validation(validation, len(np.asarray(x0s))),
        loss=loss,
        reference=reference,
        input_reference=input_reference,
        steps=steps,
        solver=ADMM() if solver is None else solver,
        dtype=dtype,
        limits=robot.state_limits,
        mpc=mpc,
    )


def weight_loss(
    Q: Reals,
    R: Reals,
    limits: Box | Polytope | None,
    reference: Reals | None = None,
    input_reference: Reals | None = None,
    robot: Robot | None = None,
    *,
    tracking: Reals | None = None,
    effort: Reals | None = None,
    violation: float = 10.0,
    settling: float = 0.0,
    tolerance: float = 0.02,
) -> ClosedLoopLoss:
    """Return the loss of a task: `ClosedLoopLoss` with weights of its own.

    tracking, effort: diagonals in place of Q and R. violation, settling: weights of these terms,
    see `ClosedLoopLoss`. tolerance: fraction of half the range of each
    state that counts as settled.
    """
    Q, R = (
        np.asarray(W) if given is None else np.asarray(given)
        for W, given in ((Q, tracking), (R, effort))
    )
    half = limits.half_widths() if isinstance(limits, Box) else np.ones(len(Q))
    return ClosedLoopLoss(
        Q,
        R,
        reference,
        input_reference,
        limits,
        violation,
        settling,
        band=tolerance * half,
        plant=robot,
    )


def _validation(fraction: float, count: int) -> int:
    """Return how many of the initial states are for validation, at least one and not all."""
    return min(max(1, round(fraction * count)), count - 1)


def _weighted(mpc: MPC, values: Values, terminal_weight: str) -> MPC:
    """Return the problem with tuned weights; P is tuned itself, follows Q and R, or is as given."""
    mpc = dataclasses.replace(mpc, Q=values.get("Q", mpc.Q), R=values.get("R", mpc.R))
    P = values.get("P", mpc.Q if terminal_weight == "Q" else mpc.terminal_cost)
    if terminal_weight == "lqr" and "P" not in values and {"Q", "R"} & set(values):
        P = lqr_cost(mpc.system, mpc.Q, mpc.R)
    return dataclasses.replace(mpc, terminal_cost=P)


def _tightening(start: float, limits: Box, target: np.ndarray) -> Parameter:
    """Return the fraction by which limits are tightened as a Parameter: at most TIGHTEST, and the
    target stays inside."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    half = (upper - lower) / 2
    both = np.isfinite(half) & (half > 0)
    if not both.any():
        fail("tune tightening", "no state has limits on both sides", "Tune something else")
    room = (np.minimum(upper - target, target - lower) / np.where(both, half, 1.0))[both]
    highest = min(TIGHTEST, 0.9 * float(room.min()))
    if not 0 < start < highest:
        fail("margin", f"{start}", f"To tune it start above 0 and below {highest:.4g}")
    return Parameter(start, "interval", lower=0.0, upper=highest)


def initial_range(
    limits: tuple[np.ndarray, np.ndarray],
    lower: Sequence[float] | None = None,
    upper: Sequence[float] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends (n,) of the initial states: as given, else the limits (n,). Raises ValueError
    where they are not finite, or lower not below upper."""
    low, high = limits
    for name, given in (("lower", lower), ("upper", upper)):
        if given is not None and len(given) != len(low):
            fail(name, f"has {len(given)} numbers", f"The problem has {len(low)} states")
        if given is not None:
            require_finite(name, np.asarray(given, float))
    low = low if lower is None else np.asarray(lower, float)
    high = high if upper is None else np.asarray(upper, float)
    if not np.all(np.isfinite([low, high])):
        fail("lower, upper", "the state limits do not bound all states", "Give both ends")
    if np.any(low >= high):
        fail("lower", f"{low.tolist()} not below upper {high.tolist()}", "Lower must be below")
    return low, high


def feasible_states(
    mpc: MPC,
    lower: np.ndarray,
    upper: np.ndarray,
    count: int,
    seed: int = 0,
    limits: Box | Polytope | None = None,
) -> tuple[np.ndarray, int]:
    """Return uniform states (count, n) of a range that have a plan, and how many drawn had none.

    Linear programs decide whether a state has a plan, without compiling: all hard rows are linear
    but those of an ellipsoidal terminal set, which are left out. limits: states outside a Polytope
    are not drawn. Raises ValueError where too few have a plan.
    """
    require_memory("count", 8 * count * mpc.system.n, "Tune on fewer states")
    rows = Inequalities.of(FeasibilityProblem.of(mpc).condensed)
    random, without_plan = generator(seed), 0
    found: list[np.ndarray] = []
    for _ in range(TRIES * count):
        x = random.uniform(lower, upper)
        if isinstance(limits, Polytope) and np.any(np.asarray(limits.H) @ x > np.asarray(limits.h)):
            continue
        b = rows.b - rows.D @ np.pad(x, (0, rows.D.shape[1] - len(x)))
        if len(b) and Program(rows.C, b).empty:
            without_plan += 1
            continue
        found.append(x)
        if len(found) == count:
            return np.array(found), without_plan
    cure = "Draw from where plans exist: lower, upper, or a smaller spread around the target"
    fail("initial states", f"{len(found)} of {TRIES * count} drawn have a plan", cure)
