"""The command `jaxmpc tune weights`: its options, the problem made of them, files and table."""

import dataclasses
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxmpc.app import config as configs
from jaxmpc.app.commands.compile_notice import Compiling
from jaxmpc.app.commands.tune_shared import TUNED, best_of_steps, optimizer_of, two_columns
from jaxmpc.app.options.shared import (
    arguments,
    given_options,
    print_table,
    refuse,
    require_lengths,
)
from jaxmpc.app.options.tune_weights import TuneWeightsOptions
from jaxmpc.app.plots.closed_loops import plot_before_after
from jaxmpc.app.plots.style import save
from jaxmpc.app.plots.tuning import plot_maps, plot_tuning
from jaxmpc.batches import Compiled
from jaxmpc.checks import MOST_COUNT, fail, require_memory
from jaxmpc.closed_loop.robot_controller import RobotController, robot_mpc, robot_references
from jaxmpc.closed_loop.variations import draw_robots
from jaxmpc.feasible.map import map_feasible_set
from jaxmpc.files import as_json, check_results, versions, write_json
from jaxmpc.grids import grid
from jaxmpc.mpc.controller import Controller
from jaxmpc.mpc.problem import MPC, soften
from jaxmpc.qp.admm import ADMM
from jaxmpc.robots.linear_plant import LinearPlant
from jaxmpc.robots.load import load_robot, model_hash
from jaxmpc.sets.convex_sets import Ellipsoid, Polytope
from jaxmpc.systems.system import numbered
from jaxmpc.tuning.parameters import is_diagonal
from jaxmpc.tuning.result import CHECKPOINT, TuningRun, run_folder
from jaxmpc.tuning.tasks import (
    WeightTask,
    feasible_states,
    initial_range,
    linear_task,
    robot_task,
    weight_loss,
    weight_parameters,
)
from jaxmpc.tuning.weights import LOOP_SOLVER

FILES = ("tuning.json", TUNED, "tuning.png", "before_after.png", "maps.png")
# Weight of the time to settle, in time steps, for a linear problem: without it the loss is about
# the cost that the controller minimises anyway, and nothing can be gained.
SETTLING = 5.0
# The optimizer where none is given, and its learning rate.
ADAM, RATE = "adam", 0.05
# Entries of a weight that the table shows.
SHOWN = 24
# Numbers of the table: name in `WeightTask.counts`, name in the table, what they are fractions of.
COUNTS = (
    ("violated", "violated", "of {loops} loops violate a limit"),
    ("unsolved", "unsolved", "of {plans:,} plans each"),
    ("infeasible", "- infeasible", "of all plans: unsolved, and proved infeasible"),
    ("unproved", "- unproved", "of all plans: unsolved, without such a proof"),
    ("fallback", "fallback", "of all plans: solved, with slack in soft limits"),
    ("at_target", "at target", "of {loops} loops at the end"),
)


class TuneWeights(TuneWeightsOptions):
    """The command: its options, and `run`."""

    def run(self) -> None:
        """Tune, write the files, print the table.

        Raises ValueError for options that do not fit together, before any closed loop compiles.
        """
        begun, compiled = time.perf_counter(), Compiled.seconds
        self.check()
        check_results(self.output / FILES[0], self.resume, self.overwrite)
        optimizer = None
        if self.mode != "gauss-newton":
            optimizer = optimizer_of(self.optimizer or ADAM, self.learning_rate or RATE)
        problem = problem_of_file(self) if self.robot is None else problem_of_robot(self)
        task, options = problem.task, self.record(problem)
        folder = run_folder(self.output, FILES, options, self.resume, self.overwrite)
        with folder as checkpoint:
            loops = f"{len(task.x0s)} closed loops of {task.steps} time steps"
            print(f"{task.name}: {', '.join(self.tune)} from {loops} -> {self.output}", flush=True)
            with Compiling(f"closed loops of {task.name} and their gradient", programs=2):
                run = best_of_steps(
                    lambda: task.tune(
                        optimizer=optimizer,
                        **given_options(self, "updates", "batch", "mode", "seed"),
                        checkpoint=checkpoint,
                        progress=sys.stderr.isatty(),
                    )
                )
        compiling = Compiled.seconds - compiled
        seconds = {"compile": compiling, "run": time.perf_counter() - begun - compiling}
        rows = self.write(problem, run, options, seconds)
        total = f"{time.perf_counter() - begun:.1f} s with set-up, checks and files"
        rows.insert(-1, ("total", total))
        print_table(rows, max(13, *(len(name) for name, _ in rows)))
        if run.history.interrupted:
            raise KeyboardInterrupt

    def record(self, problem: "WeightProblem") -> dict[str, object]:
        """Return the options that determine the result, as JSON data, without --updates."""
        ignored = ("config", "output", "resume", "overwrite", "updates")
        found = {k: v for k, v in dataclasses.asdict(self).items() if k not in ignored}
        task = problem.task
        return as_json(
            {
                **found,
                "optimizer": self.optimizer or ADAM,
                "learning_rate": self.learning_rate or RATE,
                "steps": task.steps,
                "dtype": task.dtype,
                "iterations": task.solver.iterations,
                "newton_steps": task.solver.newton_steps,
                **problem.options,
            }
        )

    def check(self) -> None:
        """Raise ValueError for options that do not go together."""
        if self.robot is None:
            names = ("target", "linearize", "mass", "damping", "payload")
            given = {name: getattr(self, name) or None for name in names}
            refuse(given, None, "It is of robots")
        else:
            given = {"lower": self.lower, "upper": self.upper, "terminal": self.terminal}
            refuse(given, self.robot, "Starts are drawn by --spread, and no terminal set is used")
        if not self.tune or len(set(self.tune)) != len(self.tune):
            fail("--tune", f"{' '.join(self.tune) or 'nothing'}", "Name each quantity once")
        if self.mode == "gauss-newton" and (self.optimizer or self.learning_rate):
            cure = "Leave --optimizer and --learning-rate out: it has steps of its own"
            fail("--mode", "gauss-newton with an optimizer", cure)
        if self.steps is not None and self.seconds is not None:
            fail("--seconds", "given beside --steps", "Give one of them")

    def write(
        self,
        problem: "WeightProblem",
        run: TuningRun,
        options: dict[str, Any],
        seconds: dict[str, float],
    ) -> list[tuple[str, str]]:
        """Write tuned.toml, simulate again with it, write the other files, and return the table."""
        task, h, folder = problem.task, run.history, self.output
        (folder / TUNED).write_text(problem.write(run.values))
        before = task.simulate(lambda: run.build(run.initial))
        after = task.simulate(lambda: problem.load(folder / TUNED))
        counts = [task.counts(loops, self.tolerance) for loops in (before, after)]
        terms = [task.terms(loops) for loops in (before, after)]
        document = {
            "name": task.name,
            "options": options,
            "finished": not h.interrupted,
            "result": {
                "improved": h.best > 0,
                "best_step": h.best,
                "rejected": int(np.sum(~h.accepted)),
                "validation": [float(h.validation[0]), float(h.validation[h.best])],
                "before": counts[0] | {"loss": terms[0]},
                "after": counts[1] | {"loss": terms[1]},
            },
            "this_run": seconds,
            "states_without_plan": problem.without_plan,
            **run.record(),
            "versions": versions(),
        }
        write_json(folder / "tuning.json", document)
        first, last = h.validation[0], h.validation[h.best]
        change = f"no step better than the start, validation loss {first:.4g}"
        if h.best:
            change = f"validation loss {first:.6g} to {last:.6g} ({-100 * run.improvement:+.2f} %)"
        trace = labelled(task, run.trace)
        title = f"{task.name}: {', '.join(self.tune)} tuned, {change}"
        save(plot_tuning(h, trace, title), folder / "tuning.png")
        loops = f"{min(6, task.validation)} of {task.validation} validation loops"
        figure = plot_before_after(
            before,
            after,
            task.plant,
            reference=task.reference,
            input_reference=task.input_reference,
            title=f"{task.name}: {change}\n{loops}, the same starts before and after",
        )
        save(figure, folder / "before_after.png")
        files = [TUNED, "tuning.json", "tuning.png", "before_after.png", CHECKPOINT]
        if problem.config is not None and "tightening" in self.tune and task.plant.n == 2:
            config = configs.load(folder / TUNED, None, "tune")
            points = grid(*config.state_range(), (64, 64))
            maps = (
                map_feasible_set(mpc, points).refine() for mpc in (task.mpc, config.build_mpc())
            )
            save(plot_maps(*maps), folder / "maps.png", config.name)
            files.insert(4, "maps.png")
        return [
            *weight_rows(problem, run, trace, counts, terms),
            ("compile", f"{seconds['compile']:.1f} s"),
            ("run", f"{seconds['run']:.1f} s"),
            ("files", " ".join(str(folder / name) for name in files)),
        ]


@dataclasses.dataclass(frozen=True, eq=False)
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


def problem_of_file(command: TuneWeights) -> WeightProblem:
    """Return the problem of a TOML file. Raises ValueError; compiles nothing."""
    if command.settling is None:
        command = dataclasses.replace(command, settling=SETTLING)
    overrides = given_options(command, "horizon", "terminal")
    config = tightened_config(configs.load(command.config, overrides, "tune"), command)
    hard, rho = config.build_mpc(), config.cost.rho
    if rho is not None:  # the number that "exact" stands for
        soft = config.build_controlled().soft
        rho = float(np.asarray(soft[-1].rho)) if isinstance(soft, tuple) and soft else 0.0
    config = with_numbers(config, hard, rho)
    solver = dataclasses.replace(
        config.build_solver() or LOOP_SOLVER,
        **given_options(command, "iterations", "newton_steps"),
    )
    steps = number_of_steps(command, config.system.dt, 100)
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
        *initial_range(config.around_target(spread), command.lower, command.upper),
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
        **config.references(),
        **arguments(command, linear_task, weight_loss, leave=("steps",)),
    )

    def load(path: Path) -> Controller:
        return Controller(configs.load(path, None, "tune").build_controlled(), solver)

    def write(values: Mapping[str, np.ndarray]) -> str:
        return tuned(config, values).to_toml()

    return WeightProblem(
        task, write, load, {"problem": config.to_dict("tune")}, without_plan, config
    )


def problem_of_robot(command: TuneWeights) -> WeightProblem:
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


def number_of_steps(command: TuneWeights, dt: float, usual: int) -> int:
    """Return the length of the closed loops. Raises ValueError for too many steps."""
    if command.seconds is None:
        return command.steps or usual
    if command.seconds / dt > MOST_COUNT:
        fail("--seconds", f"{command.seconds:g}", f"Give at most {MOST_COUNT * dt:g}")
    return max(1, round(command.seconds / dt))


def require_sizes(command: TuneWeights, steps: int, n: int, m: int) -> None:
    """Raise ValueError where the loops do not fit into memory, or the loss not the problem."""
    needed = 8 * command.count * (steps + 1) * (n + m)
    require_memory("--count, --steps", needed, "Tune on fewer loops, or shorter ones")
    require_lengths(command, "The problem", tracking=n, effort=m)
    for name in ("tracking", "effort"):
        given = getattr(command, name)
        if given is not None and not min(given) >= 0:
            fail(f"--{name}", f"{min(given):g}", "Give weights of at least 0")


def tightened_config(config: configs.Config, command: TuneWeights) -> configs.Config:
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
    if flat and is_diagonal(value):
        return tuple(np.diag(value).tolist())
    return tuple(map(tuple, value.tolist()))


def weight_rows(
    problem: WeightProblem,
    run: TuningRun,
    trace: Mapping[str, Mapping[str, np.ndarray]],
    counts: list[dict[str, float]],
    terms: list[dict[str, float]],
) -> list[tuple[str, str]]:
    """Return the rows of the table on losses, their `terms` and `counts` before and after, weights
    and steps."""
    h = run.history
    entries = [
        (f"{group} {name}".strip(), values[0], values[h.best])
        for group, parts in trace.items()
        for name, values in parts.items()
    ]
    first, last = h.validation[0], h.validation[h.best]
    change = f"{-100 * run.improvement:+.2f} %" if h.best else "no change"
    rows = [
        ("", two_columns(("before", "after"))),
        ("loss", two_columns((f"{first:.6g}", f"{last:.6g}"), change)),
    ]
    for name in terms[0]:
        rows.append((f"- {name}", two_columns(f"{part[name]:.6g}" for part in terms)))
    for key, name, of in COUNTS:
        shares = (f"{100 * numbers[key]:.2f} %" for numbers in counts)
        rows.append((name, two_columns(shares, of.format(**counts[0]))))
    for name, a, b in entries[:SHOWN]:
        ratio = f"x {b / a:.3g}" if a else ""
        rows.append((name, two_columns((f"{a:.5g}", f"{b:.5g}"), ratio)))
    if len(entries) > SHOWN:
        rows.append(("...", f"{len(entries) - SHOWN} more in {TUNED}"))
    if any(p.domain == "definite" for p in problem.task.parameters.values()):
        rows.append(("", f"of full matrices the diagonal; all of it in {TUNED}"))
    own = isinstance(problem.task.plant, LinearPlant) and not problem.task.loss.settling
    if own and _same_weights(problem.task):
        rows.append(("loss", "about the cost that the controller minimises: little can be gained"))
    if problem.task.loss.settling and not any(numbers["at_target"] for numbers in counts):
        what = "is about the same for all weights, for no loop settles in the time that it has"
        rows.append(("settling", f"{what}: raise --steps or --tolerance, or give --settling 0"))
    if not h.best:
        what = f"none of {h.steps} steps is better on the validation loops"
        rows.append(("result", f"{what}: {TUNED} is the start"))
    if problem.without_plan:
        what = "initial states drawn have no plan within the limits: replaced"
        rows.append(("starts", f"{problem.without_plan:,} {what}"))
    rejected = np.sum(~h.accepted)
    rows.append(("steps", f"best is {h.best} of {h.steps}; {rejected} rejected as not finite"))
    return [*rows, ("mode", run.settings["mode"])]


def _same_weights(task: WeightTask) -> bool:
    """Return whether the loss weighs states and inputs as the problem does before tuning."""
    pairs = (task.loss.Q, task.mpc.Q), (task.loss.R, task.mpc.R)
    return all(np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


def labelled(
    task: WeightTask, traces: Mapping[str, np.ndarray]
) -> dict[str, dict[str, np.ndarray]]:
    """Return the weights by step: group → entry → (T+1,); of matrices their diagonal."""
    plant = task.plant
    if isinstance(plant, LinearPlant):
        states = list(plant.system.state_names or numbered("x", plant.n))
        inputs = list(plant.system.input_names or numbered("u", plant.m))
    else:
        states, inputs, half = list(plant.state_names), list(plant.input_names), plant.n // 2
        if states[:half] == states[half:]:
            states = [*states[:half], *(f"{name} velocity" for name in states[half:])]
    found: dict[str, dict[str, np.ndarray]] = {}
    for group, values in traces.items():
        trace = np.asarray(values, float)
        names = [] if trace.ndim == 1 else inputs if group == "R" else states
        found[group] = {name: trace[:, i, i] for i, name in enumerate(names)} or {"": trace}
    return found
