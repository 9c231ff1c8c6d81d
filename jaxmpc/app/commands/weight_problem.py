"""The problem of `jaxmpc tune weights`: a task from a problem file or a robot, and tuned.toml."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.options import arguments, given_options, require_lengths
from jaxmpc.app.commands.weight_options import WeightOptions
from jaxmpc.checks import MOST_COUNT, fail, require_memory
from jaxmpc.closed_loop.robot_controller import RobotController, robot_mpc, robot_references
from jaxmpc.closed_loop.variations import draw_robots
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.softening import soften
from jaxmpc.qp.admm import ADMM
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.polytope import Polytope
from jaxmpc.tuning.initial_states import feasible_states, initial_range
from jaxmpc.tuning.tasks import (
    WeightTask,
    linear_task,
    robot_task,
    weight_loss,
    weight_parameters,
)
from jaxmpc.tuning.weights import SOLVER


@dataclass(frozen=True, eq=False)
class WeightProblem:
    """A task and its files.

    write: values → text of tuned.toml; load: path of such a file → its controller. options: what
    determines the result beside the options of the command. without_plan: number of states drawn
    that have none. config: None for robots.
    """

    task: WeightTask
    write: Callable[[Mapping[str, np.ndarray]], str]
    load: Callable[[Path], Controller | RobotController]
    options: dict[str, Any]
    without_plan: int = 0
    config: configs.Config | None = None


def problem_of_file(command: WeightOptions) -> WeightProblem:
    """Return the problem of a TOML file. Raises ValueError; compiles nothing."""
    overrides = given_options(command, "horizon", "terminal")
    config = with_margin(configs.load(command.config, overrides, "tune"), command)
    hard, rho = config.build_mpc(), config.cost.rho
    if rho is not None:  # the number that "exact" stands for
        soft = config.build_controlled().soft
        rho = float(np.asarray(soft[0].rho)) if isinstance(soft, tuple) and soft else 0.0
    config = with_numbers(config, hard, rho)
    solver = dataclasses.replace(
        config.build_solver() or SOLVER, **given_options(command, "iterations", "newton_steps")
    )
    steps = number_of_steps(command, config.system.dt, 50)
    require_sizes(command, steps, hard.system.n, hard.system.m)
    limits, spread = config.state_limits(), 0.9 if command.spread is None else command.spread
    parameters = weight_parameters(
        hard,
        command.tune,
        weights=command.weights,
        rho=rho,
        margin=config.limits.margin,
        limits=limits,
    )
    x0s, without_plan = feasible_states(
        hard if rho is None else soften(hard, rho),
        *initial_range(config.state_range(), command.lower, command.upper, spread),
        command.count,
        command.seed,
        limits,
    )
    follow = config.cost.P
    task = linear_task(
        hard,
        parameters,
        x0s,
        name=config.name,
        terminal_weight=follow if isinstance(follow, str) else "given",
        rho=rho,
        limits=limits,
        solver=solver,
        steps=steps,
        **arguments(command, linear_task, weight_loss, leave=("steps",)),
    )

    def load(path: Path) -> Controller:
        return Controller(configs.load(path, None, "tune").build_controlled(), solver)

    def write(values: Mapping[str, np.ndarray]) -> str:
        return tuned(config, values).to_toml()

    return WeightProblem(
        task, write, load, {"problem": config.to_dict("tune")}, without_plan, config
    )


def problem_of_robot(command: WeightOptions) -> WeightProblem:
    """Return the problem of --robot. Raises ValueError; only the linear model compiles."""
    robot = load_robot(str(command.robot))
    file, section, cost = None, configs.RobotSection(name=robot.name), None
    weights: dict[str, Any] = {}
    if command.config is not None:
        file = configs.load_robot_config(command.config)
        section, cost, weights = file.robot, file.cost, file.weights(robot)
    given = given_options(command, "horizon", "margin", "linearize")
    section = dataclasses.replace(section, **given)
    require_lengths(command, robot.name, target=robot.mujoco.nq)
    steps = number_of_steps(command, robot.dt, max(1, round(1.0 / robot.dt)))
    require_sizes(command, steps, robot.n, robot.m)
    target = None if command.target is None else np.array(command.target)
    rho = 1e4 if cost is None else cost.rho
    follow = "lqr" if cost is None else cost.P if isinstance(cost.P, str) else "none"
    solver = ADMM(iterations=command.iterations, newton_steps=command.newton_steps)

    def problem(section: configs.RobotSection, weights: Mapping[str, Any]) -> MPC:
        return robot_mpc(
            robot, horizon=section.horizon, target=target, margin=section.margin, **weights
        )

    spread = 0.5 if command.spread is None else command.spread
    x0s, factors = draw_robots(
        robot, spread=spread, **arguments(command, draw_robots, leave=("robot", "spread"))
    )
    mpc = problem(section, weights)
    parameters = weight_parameters(
        mpc,
        command.tune,
        weights=command.weights,
        rho=rho,
        margin=section.margin,
        limits=robot.state_limits,
        target=robot_references(robot, target)[0],
    )
    task = robot_task(
        robot,
        mpc,
        parameters,
        x0s,
        terminal_weight=follow,
        rho=rho,
        target=target,
        linearize=section.linearize,
        factors=factors,
        solver=solver,
        steps=steps,
        **arguments(
            command, robot_task, weight_loss, leave=("robot", "steps", "target", "linearize")
        ),
    )

    def write(values: Mapping[str, np.ndarray]) -> str:
        end: Any = follow
        if "P" in values or (follow == "none" and mpc.terminal_cost is not None):
            end = from_matrix(values.get("P", mpc.terminal_cost), flat=False)
        cost = configs.RobotCostSection(
            Q=from_matrix(values.get("Q", mpc.Q)),
            R=from_matrix(values.get("R", mpc.R)),
            P=end,
            rho=float(values.get("rho", rho)),
        )
        margin = float(values.get("tightening", section.margin))
        return configs.RobotConfig(
            robot=dataclasses.replace(section, margin=margin), cost=cost
        ).to_toml()

    def load(path: Path) -> RobotController:
        file = configs.load_robot_config(path)
        made, linearize = problem(file.robot, file.weights(robot)), file.robot.linearize
        return RobotController(robot, made, solver, linearize=linearize, rho=file.cost.rho)

    return WeightProblem(task, write, load, {"robot": write({}), "model": model_hash(robot)})


def number_of_steps(command: WeightOptions, dt: float, usual: int) -> int:
    """Return the length of the closed loops. Raises ValueError for too many steps."""
    if command.seconds is None:
        return command.steps or usual
    if command.seconds / dt > MOST_COUNT:
        fail("--seconds", f"{command.seconds:g}", f"Give at most {MOST_COUNT * dt:g}")
    return max(1, round(command.seconds / dt))


def require_sizes(command: WeightOptions, steps: int, n: int, m: int) -> None:
    """Raise ValueError where the loops do not fit into memory, or the loss not the problem."""
    needed = 8 * command.count * (steps + 1) * (n + m)
    require_memory("--count, --steps", needed, "Tune on fewer loops, or shorter ones")
    require_lengths(command, "The problem", tracking=n, effort=m)


def with_margin(config: configs.Config, command: WeightOptions) -> configs.Config:
    """Return the problem with --margin, or with one to start from where tightening is tuned."""
    margin, tuned = config.limits.margin, "tightening" in command.tune
    if command.margin is not None or (tuned and not margin):
        margin = 0.02 if command.margin is None else command.margin
    if margin and config.limits.x_min is None:
        fail("--tune tightening, --margin", "the problem has no x_min, x_max", "Give limits")
    if tuned and config.mpc.terminal in ("invariant", "ellipsoid"):
        what = f'the terminal set "{config.mpc.terminal}" rests on the limits as they are'
        fail("--tune tightening", what, "Use --terminal box or none")
    limits = dataclasses.replace(config.limits, margin=margin)
    return dataclasses.replace(config, limits=limits)


def with_numbers(config: configs.Config, hard: MPC, rho: float | None) -> configs.Config:
    """Return the problem with numbers for what depends on its weights: rho, and a terminal set
    that the LQR of these weights keeps invariant."""
    cost, mpc, given = dataclasses.replace(config.cost, rho=rho), config.mpc, hard.terminal_set
    if mpc.terminal != "box" and isinstance(given, Polytope):
        h = tuple(np.asarray(given.h, float).tolist())
        H = from_matrix(given.H, flat=False)
        mpc = dataclasses.replace(mpc, terminal="none", H_f=H, h_f=h)
    if mpc.terminal != "box" and isinstance(given, Ellipsoid):
        level, P = float(np.asarray(given.level)), from_matrix(given.P, flat=False)
        mpc = dataclasses.replace(mpc, terminal="none", P_f=P, level_f=level)
    return dataclasses.replace(config, cost=cost, mpc=mpc)


def tuned(config: configs.Config, values: Mapping[str, np.ndarray]) -> configs.Config:
    """Return the problem with tuned values."""
    changes: dict[str, Any] = {
        name: from_matrix(values[name]) for name in ("Q", "R", "P") if name in values
    }
    if "rho" in values:
        changes["rho"] = float(values["rho"])
    margin = float(values.get("tightening", config.limits.margin))
    limits = dataclasses.replace(config.limits, margin=margin)
    cost = dataclasses.replace(config.cost, **changes)
    return dataclasses.replace(config, cost=cost, limits=limits)


def from_matrix(value: Any, flat: bool = True) -> Any:
    """Return a matrix as the file holds it: rows, or the diagonal of a diagonal one if `flat`."""
    value = np.asarray(value, float)
    if flat and np.all(value == np.diag(np.diag(value))):
        return tuple(np.diag(value).tolist())
    return tuple(map(tuple, value.tolist()))
