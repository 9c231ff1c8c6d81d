"""The task of `jaxmpc tune weights`: problem, plant, initial states and loss from its options."""

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import given_options
from jaxmpc.app.commands.tuning import feasible_states, problem_file, start_range
from jaxmpc.checks import MOST_COUNT, fail, require_memory
from jaxmpc.closed_loop.many import simulate_many
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.robot_problem import robot_mpc
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.variations import draw_robots, plant_numbers
from jaxmpc.mpc.condense import prestabilising_gain
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.softening import soften
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.sets import violations
from jaxmpc.sets.box import Box
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.polytope import Polytope
from jaxmpc.systems.riccati import lqr
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter

# The largest fraction by which limits can be tightened.
TIGHTEST = 0.5


class TuningTask(NamedTuple):
    """The task of `jaxmpc tune weights`, built from its options and checked.

    make: values → MPC or controller. x0s (B, n or nq + nv) and variations (B, ...); train (B,):
    which of them are for training, the others for validation. limits: of the states. write: values
    → text of tuned.toml; load: path of such a file → its controller. options: what else determines
    the result. dropped: number of states drawn that have no plan. mpc: the hard problem before
    tuning. config: None for robots.
    """

    name: str
    make: Callable[[Mapping[str, Any]], Any]
    parameters: dict[str, Parameter]
    plant: Any
    x0s: np.ndarray
    variations: dict[str, np.ndarray]
    train: np.ndarray
    loss: ClosedLoopLoss
    reference: np.ndarray | None
    input_reference: np.ndarray | None
    steps: int
    solver: ADMM
    dtype: str
    limits: Box | Polytope | None
    write: Callable[[Mapping[str, np.ndarray]], str]
    load: Callable[[Path], Any]
    options: dict[str, Any]
    dropped: int
    mpc: MPC
    config: configs.Config | None

    def simulated(self, make: Callable[[], Any]) -> Run:
        """Simulate the validation loops with a controller, or with the Controller of an MPC."""
        with jax.enable_x64(self.dtype == "float64"):
            made = make()
            controller = Controller(made, self.solver) if isinstance(made, MPC) else made
            return simulate_many(
                controller, self.plant, self.x0s[~self.train], self.steps,
                reference=self.reference, input_reference=self.input_reference,
                variations={k: v[~self.train] for k, v in self.variations.items()},
            )  # fmt: skip

    def counted(self, run: Run, tolerance: float) -> dict[str, Any]:
        """Return counts of violations, unsolved plans and so on, from states and inputs."""
        goal = np.zeros(self.plant.n) if self.reference is None else self.reference
        outcome = evaluate_runs(run, self.plant, goal, tolerance=tolerance)
        kept = outcome.kept
        if isinstance(self.limits, Polytope):
            limits = jax.tree.map(lambda v: np.asarray(v, float), self.limits)
            kept = kept & violations.kept(limits, outcome.coordinates).all(axis=(1, 2))
        status = np.asarray(run.status)
        return {
            "loops": len(kept), "plans": int(status.size), "violated": float(np.mean(~kept)),
            "kept_to": violations.TOLERANCE["float64"],
            "unsolved": float(np.mean(status != Status.SOLVED)),
            "infeasible": float(np.mean(status == Status.PRIMAL_INFEASIBLE)),
            "fallback": float(np.mean((status == Status.SOLVED) & np.asarray(run.fallback))),
            "at_target": float(np.mean(outcome.reached)),
        }  # fmt: skip


def linear_family(
    hard: MPC, follow: Any, rho: float | None, parameters: Mapping[str, Parameter], limits: Any
) -> Callable[[Mapping[str, Any]], MPC]:
    """Return the map from values to the problem that the controller solves. Works inside jit, vmap
    and grad."""
    # The gain that keeps predictions of unstable plants in bounds changes rounding only.
    base = dataclasses.replace(hard, prestabilise=prestabilising_gain(hard))
    follow = follow if isinstance(follow, str) else "none"
    box = hard.terminal_set is hard.states

    def make(values: Mapping[str, Any]) -> MPC:
        mpc = dataclasses.replace(base, Q=values.get("Q", hard.Q), R=values.get("R", hard.R))
        mpc = dataclasses.replace(mpc, terminal_cost=follower(mpc, values, follow))
        if "tightening" in values:
            states = limits.tightened(values["tightening"])
            mpc = dataclasses.replace(
                mpc, states=states, terminal_set=states if box else mpc.terminal_set
            )
        return mpc if rho is None else soften(mpc, values.get("rho", rho))

    return make


def follower(mpc: MPC, values: Mapping[str, Any], follow: str) -> Any:
    """Return the terminal weight: tuned itself, following Q and R, or unchanged."""
    if "P" in values:
        return values["P"]
    if follow == "lqr" and {"Q", "R"} & set(values):
        return lqr(mpc.system, mpc.Q, mpc.R).P
    return mpc.Q if follow == "Q" else mpc.terminal_cost


def weight_parameter(name: str, value: Any, form: str) -> Parameter:
    """Return Q, R or P as a Parameter; raise ValueError unless it is positive definite."""
    if value is None:
        fail(f"--tune {name}", "the problem has no terminal weight", 'Give [cost] P = "lqr"')
    value = np.asarray(value, float)
    diagonal = bool(np.all(value == np.diag(np.diag(value))))
    if form == "diagonal" and not diagonal and name != "P":
        fail("--weights", f"diagonal, and {name} of the problem is not", "Add --weights full")
    if np.linalg.eigvalsh((value + value.T) / 2)[0] <= 0:
        cure = "Give each direction a small weight to start from"
        fail(f"--tune {name}", f"{name} is not positive definite", cure)
    return Parameter(value, "diagonal" if form == "diagonal" and diagonal else "definite")


def tightening(start: float, limits: Box, target: np.ndarray) -> Parameter:
    """Return the fraction by which limits are tightened as a Parameter: at most TIGHTEST, and the
    target stays inside."""
    lower, upper = np.asarray(limits.lower, float), np.asarray(limits.upper, float)
    half = (upper - lower) / 2
    both = np.isfinite(half) & (half > 0)
    if not both.any():
        fail("--tune tightening", "no state has limits on both sides", "Tune something else")
    room = (np.minimum(upper - target, target - lower) / np.where(both, half, 1.0))[both]
    highest = min(TIGHTEST, 0.9 * float(room.min()))
    if not 0 < start < highest:
        fail("--margin", f"{start}", f"To tune it start above 0 and below {highest:.4g}")
    return Parameter(start, "interval", lower=0.0, upper=highest)


def tuned(config: configs.Config, values: Mapping[str, np.ndarray]) -> configs.Config:
    """Return the problem with tuned values."""
    changes: dict[str, Any] = {
        name: from_matrix(values[name]) for name in ("Q", "R", "P") if name in values
    }
    if "rho" in values:
        changes["rho"] = float(values["rho"])
    limits = config.limits
    if "tightening" in values:
        limits = dataclasses.replace(limits, margin=float(values["tightening"]))
    cost = dataclasses.replace(config.cost, **changes)
    return dataclasses.replace(config, cost=cost, limits=limits)


def from_matrix(value: Any, flat: bool = True) -> Any:
    """Return a matrix as the file holds it: rows, or the diagonal of a diagonal one if `flat`."""
    value = np.asarray(value, float)
    if flat and np.all(value == np.diag(np.diag(value))):
        return tuple(np.diag(value).tolist())
    return tuple(map(tuple, value.tolist()))


def linear_task(command: Any) -> TuningTask:
    """Return the task of a TOML file."""
    config = problem_file(command)
    margin = config.limits.margin if command.margin is None else command.margin
    if "tightening" in command.tune and command.margin is None and not margin:
        margin = 0.02
    if margin and config.limits.x_min is None:
        fail("--tune tightening, --margin", "the problem has no x_min, x_max", "Give limits")
    if margin != config.limits.margin:
        section = dataclasses.replace(config.limits, margin=margin)
        config = dataclasses.replace(config, limits=section)
    if "tightening" in command.tune and config.mpc.terminal in ("invariant", "ellipsoid"):
        what = f'the terminal set "{config.mpc.terminal}" rests on the limits as they are'
        fail("--tune tightening", what, "Use --terminal box or none")
    hard, rho = config.build_mpc(), config.cost.rho
    if rho is not None:  # the number that "exact" stands for
        controlled = config.build_controlled()
        rho = float(controlled.soft[0].rho) if controlled.soft else 0.0  # type: ignore[index, arg-type]
    if "rho" in command.tune and not rho:
        fail("--tune rho", "the problem has no soft limits", "Give it [cost] rho")
    config = with_numbers(config, hard, rho)
    parameters: dict[str, Parameter] = {
        name: weight_parameter(name, value, command.weights)
        for name, value in (("Q", hard.Q), ("R", hard.R), ("P", hard.terminal_cost))
        if name in command.tune
    }
    if "rho" in command.tune:
        parameters["rho"] = Parameter(rho, "positive")
    limits = config.state_limits()
    if "tightening" in command.tune:
        assert isinstance(limits, Box)
        parameters["tightening"] = tightening(margin, limits, np.zeros(hard.system.n))
    n, m = hard.system.n, hard.system.m
    free = Box(np.full(n, -np.inf), np.full(n, np.inf))
    assert isinstance(hard.inputs, Box)
    plant = LinearPlant(
        hard.system, limits if isinstance(limits, Box) else free, hard.inputs,
        name=config.name,
    )  # fmt: skip
    settings = config.build_solver() or ADMM(iterations=50, rho=1.0, alpha=1.6, newton_steps=20)
    count = settings.iterations if command.iterations is None else command.iterations
    newton_steps = settings.newton_steps if command.newton_steps is None else command.newton_steps
    solver = dataclasses.replace(settings, iterations=count, newton_steps=newton_steps)
    dtype = command.dtype or "float64"
    fraction = 0.9 if command.spread is None else command.spread
    steps = command.steps or 50
    if command.seconds is not None:
        steps = whole_samples(command.seconds, plant.dt)
    require_loops(command.count, steps, n, m)
    require_loss(command, n, m)
    x0s, dropped = feasible_states(
        hard if rho is None else soften(hard, rho), config.state_limits(),
        *start_range(config, command.lower, command.upper, fraction), command.count, command.seed,
    )  # fmt: skip

    def write(values: Mapping[str, np.ndarray]) -> str:
        return tuned(config, values).to_toml()

    def load(path: Path) -> Controller:
        return Controller(configs.load(path, None, "tune").build_controlled(), solver)

    make = linear_family(hard, config.cost.P, rho, parameters, limits)
    return TuningTask(
        config.name, make, parameters, plant, x0s, {}, training(command, len(x0s)),
        loss_of(command, hard.Q, hard.R, limits, plant, None, None), None, None, steps,
        solver, dtype, limits, write, load, {"problem": config.to_dict("tune")}, dropped, hard,
        config,
    )  # fmt: skip


def whole_samples(seconds: float, dt: float) -> int:
    """Return the number of samples in some seconds, at least 1. Raises ValueError for too many."""
    if seconds / dt > MOST_COUNT:
        fail("--seconds", f"{seconds:g}", f"Give at most {MOST_COUNT * dt:g}")
    return max(1, round(seconds / dt))


def require_loops(count: int, steps: int, n: int, m: int) -> None:
    """Raise ValueError where states and inputs of all loops do not fit into memory in float64."""
    needed = 8 * count * (steps + 1) * (n + m)
    require_memory("--count, --steps", needed, "Tune on fewer loops, or shorter ones")


def with_numbers(config: configs.Config, hard: MPC, rho: float | None) -> configs.Config:
    """Return the problem with numbers for what depends on its weights: rho, and a terminal set
    that the LQR of these weights keeps invariant."""
    cost, mpc = dataclasses.replace(config.cost, rho=rho), config.mpc
    given, plain = hard.terminal_set, lambda v: tuple(map(tuple, np.asarray(v, float).tolist()))
    if mpc.terminal != "box" and isinstance(given, Polytope):
        h = tuple(np.asarray(given.h, float).tolist())
        mpc = dataclasses.replace(mpc, terminal="none", H_f=plain(given.H), h_f=h)
    if mpc.terminal != "box" and isinstance(given, Ellipsoid):
        level = float(np.asarray(given.level))
        mpc = dataclasses.replace(mpc, terminal="none", P_f=plain(given.P), level_f=level)
    return dataclasses.replace(config, cost=cost, mpc=mpc)


def robot_task(command: Any) -> TuningTask:
    """Return the task of a robot."""
    file = None if command.config is None else configs.load_robot_config(command.config)
    robot = load_robot(str(command.robot))
    section = configs.RobotSection(name=robot.name) if file is None else file.robot
    given = given_options(command, "horizon", "margin", "linearize")
    section = dataclasses.replace(section, **given)
    if command.target is not None and len(command.target) != robot.mujoco.nq:
        what = f"has {len(command.target)} numbers"
        fail("--target", what, f"{robot.name} needs {robot.mujoco.nq}")
    target = None if command.target is None else np.array(command.target)
    # What does not compile is checked before the linear model is.
    steps = command.steps or whole_samples(command.seconds or 1.0, robot.dt)
    require_loops(command.count, steps, robot.n, robot.m)
    require_loss(command, robot.n, robot.m)
    weights: dict[str, Any] = {} if file is None else file.weights(robot)
    mpc = robot_mpc(robot, horizon=section.horizon, target=target, margin=section.margin, **weights)
    Q, R, P = mpc.Q, mpc.R, mpc.terminal_cost
    rho = 1e4 if file is None else file.cost.rho
    follow = "lqr" if file is None else file.cost.P
    follow = follow if isinstance(follow, str) else "none"
    parameters: dict[str, Parameter] = {
        name: weight_parameter(name, value, command.weights)
        for name, value in (("Q", Q), ("R", R), ("P", P))
        if name in command.tune
    }
    if "rho" in command.tune:
        parameters["rho"] = Parameter(rho, "positive")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # robot_mpc has said the same
        x, s = robot.set_point(target)
    with jax.enable_x64(True):
        r = np.asarray(robot.coordinates(x))
    if "tightening" in command.tune:
        parameters["tightening"] = tightening(section.margin, robot.state_limits, r)
    solver = ADMM(iterations=command.iterations, newton_steps=command.newton_steps)
    x0s, variations = draw_robots(
        robot, command.count, command.seed,
        spread=0.5 if command.spread is None else command.spread,
        mass=command.mass, damping=command.damping, payload=command.payload,
    )  # fmt: skip
    variations = plant_numbers(robot, variations)
    if variations:
        robot.vary(**{key: value[0] for key, value in variations.items()})
    dtype = command.dtype or "float32"
    loss = loss_of(command, Q, R, robot.state_limits, robot, r, s)

    def controller(mpc: MPC, rho: Any, linearize: str) -> RobotController:
        return RobotController(robot, mpc, solver, linearize=linearize, rho=rho)

    def make(values: Mapping[str, Any]) -> RobotController:
        changed = dataclasses.replace(mpc, Q=values.get("Q", Q), R=values.get("R", R))
        changed = dataclasses.replace(changed, terminal_cost=follower(changed, values, follow))
        if "tightening" in values:
            states = robot.state_limits.tightened(values["tightening"])
            changed = dataclasses.replace(changed, states=states)
        return controller(changed, values.get("rho", rho), section.linearize)

    def write(values: Mapping[str, np.ndarray]) -> str:
        end: Any = follow
        if "P" in values or (follow == "none" and P is not None):
            end = from_matrix(values.get("P", P), flat=False)
        margin = float(values.get("tightening", section.margin))
        return configs.RobotConfig(
            robot=dataclasses.replace(section, margin=margin),
            cost=configs.RobotCostSection(
                Q=from_matrix(values.get("Q", Q)), R=from_matrix(values.get("R", R)), P=end,
                rho=float(values.get("rho", rho)),
            ),
        ).to_toml()  # fmt: skip

    def load(path: Path) -> RobotController:
        file = configs.load_robot_config(path)
        mpc = robot_mpc(
            robot, horizon=file.robot.horizon, target=target, margin=file.robot.margin,
            **file.weights(robot),
        )  # fmt: skip
        return controller(mpc, file.cost.rho, file.robot.linearize)

    start = {"robot": write({}), "model": model_hash(robot)}
    return TuningTask(
        robot.name, make, parameters, robot, x0s, variations, training(command, len(x0s)), loss, r,
        np.asarray(s), steps, solver, dtype, robot.state_limits, write, load, start, 0, mpc,
        None,
    )  # fmt: skip


def training(command: Any, count: int) -> np.ndarray:
    """Return which initial states (count,) are for training; the last ones are for validation."""
    kept = min(max(1, round(command.validation * count)), count - 1)
    return np.arange(count) < count - kept


def require_loss(command: Any, n: int, m: int) -> None:
    """Raise ValueError where --tracking or --effort does not fit n states and m inputs."""
    for name, given, size in (("tracking", command.tracking, n), ("effort", command.effort, m)):
        if given is not None and len(given) != size:
            fail(f"--{name}", f"has {len(given)} numbers", f"The problem needs {size}")


def loss_of(
    command: Any, Q: Any, R: Any, limits: Any, plant: Any, r: Any, s: Any
) -> ClosedLoopLoss:
    """Return the loss that the options describe; Q, R: weights at the start, r, s: references."""
    Q = np.asarray(Q) if command.tracking is None else np.array(command.tracking)
    R = np.asarray(R) if command.effort is None else np.array(command.effort)
    half = limits.half_widths() if isinstance(limits, Box) else np.ones(len(Q))
    return ClosedLoopLoss(
        Q, R, r, s, limits, command.violation, command.settling, command.tolerance * half,
        plant=None if isinstance(plant, LinearPlant) else plant,
    )  # fmt: skip
