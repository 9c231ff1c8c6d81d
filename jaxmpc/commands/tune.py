"""The command `jaxmpc tune weights`: arguments to calls, no mathematics."""

import contextlib
import dataclasses
import io
import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import optax
import tyro

from jaxmpc import config as configs
from jaxmpc.checks import fail
from jaxmpc.closed_loop.outcome import evaluate_runs
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.robot_mpc import robot_mpc
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulate_many import simulate_many
from jaxmpc.commands.options import (
    Horizon,
    Terminal,
    model_hash,
    option,
    report_error,
    versions,
    write_json,
)
from jaxmpc.commands.robot_map import refused
from jaxmpc.commands.simulate import Simulate, plant_numbers
from jaxmpc.commands.tuning import (
    CHECKPOINT,
    TUNED,
    feasible_states,
    open_run,
    optimizer_of,
    problem_file,
    start_range,
)
from jaxmpc.compiled import Compiled
from jaxmpc.control import violation
from jaxmpc.control.riccati import lqr
from jaxmpc.control.sets import Box, Ellipsoid, Polytope
from jaxmpc.mpc.condense import prestabilising_gain
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.soften import soften
from jaxmpc.mpc.solve import Controller
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.robots.linear import LinearPlant
from jaxmpc.robots.load import load_robot
from jaxmpc.sweeps.feasible_set import grid, map_feasible_set
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.weights import TuningRun, tune_weights
from jaxmpc.tuning_plots import plot_before_after, plot_maps, plot_tuning

# Entries of a weight that the table shows.
SHOWN = 24
# The largest share by which limits can be tightened.
TIGHTEST = 0.5


@dataclasses.dataclass(frozen=True)
class TuneWeights:
    """Tune an MPC's weights by gradient, through its closed loops: what one usually guesses.

    What it does
      Draws initial states, runs the closed loop from each, and moves the weights down the gradient
      of the mean loss: through plant, limits and solver, all samples of all loops. The loss of a
      loop is, with e = x - target, v = u - target's input and the weights Q, R of the START,
        mean over samples of e'Q e + v'R v + violation * (sum of excesses over state limits)
        + settling * (samples until |e| stays within the tolerance)
      so that the horizon, the limits and what the model leaves out decide what the controller's
      own weights should be. A part of the loops is kept apart (--validation): the result is the
      step of least loss on those, the start itself where no step is better.
      Without a file the problem is one robot joint: x = (q, dq), torque u, 20 steps of 0.01 s.

    How to start
      $ jaxmpc tune weights
      $ jaxmpc tune weights --config pendulum.toml --tune Q R P --updates 50 --output tuned/a
      $ jaxmpc tune weights --robot arm2 --mass 0.2 --payload 0.5 --tune Q R rho tightening
      The first step comes after the compiler: half a minute for one joint, minutes for an arm.

    What can be tuned (--tune)
      Q, R        weights of states and inputs; diagonal, or --weights full: L L', any positive
                  definite matrix
      P           terminal weight; where it is not tuned it stays what the file says: "lqr" and "Q"
                  follow the tuned Q and R
      rho         L1 weight of soft limits, where the problem has any ([cost] rho; robots always)
      tightening  share of their half-width by which state limits are moved inwards, from --margin,
                  at most 0.5
      An invariant or elliptic terminal set is that of the start, kept as it is.

    How to read the table
      loss        mean over the validation loops, before and after, and the change
      beyond      validation loops that leave a limit of states or inputs, to 1e-6 (of the limit,
                  where that is above 1); tightening not counted in
      unsolved    plans whose residuals do not pass (1e-6 in float64, 1e-3 in float32)
      infeasible  plans proved infeasible
      fallback    plans that break soft limits somewhere on their horizon
      at target   loops that end within --tolerance of half the range of each state
      then        the weights
      All but the loss is counted in new runs, the second of them with what tuned.toml says.

    Files, all in the folder of --output
      tuned.toml        The whole problem with the tuned weights: for --config of jaxmpc sweep,
                        recursion, info, tune; of a robot for jaxmpc simulate --robot NAME --config.
      tuning.json       Options, loss, gradient norm, shares and weights of every step, versions.
      tuning.png        The same over the steps. Red crosses: steps rejected, as not finite.
      before_after.png  Some validation loops with the weights before and after.
      maps.png          The feasible set before and after: two states, tightening tuned.
      checkpoint.npz    What --resume goes on from, written after every step.
      Ctrl-C            Stops; steps that are done are kept, --resume goes on from there. A run
                        that is done goes on with --resume and more --updates.
      Exit code         0 done, whether better or not; 2 error (one line on stderr says which); 130
                        stopped by Ctrl-C.

    What the TOML file holds
      The sections [system], [limits], [cost], [mpc] of jaxmpc sweep --help, and, all optional,
      [limits]  margin, the tightening (needs x_min, x_max)
      [mpc]     H_f, h_f (H_f x_N <= h_f) or P_f, level_f (x_N'P_f x_N <= level_f) in the place of
                terminal
      [solver]  iterations, rho, alpha, refine; jaxmpc tune penalties writes them
      With --robot: the sections that tuned.toml has, [robot] and [cost].
    """

    config: Annotated[Path | None, option("FILE", "the built-in joint")] = None
    """TOML file with the problem; with --robot its weights at the start."""
    robot: Annotated[str | None, option("NAME|FILE", "none: a linear system")] = None
    """joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or URDF file."""
    tune: Annotated[
        tuple[Literal["Q", "R", "P", "rho", "tightening"], ...],
        option("{Q,R,P,rho,tightening} [...]", "Q R"),
    ] = ("Q", "R")
    """What is tuned; see above."""
    weights: Annotated[Literal["diagonal", "full"], option("{diagonal,full}", "diagonal")] = (
        "diagonal"
    )
    """Form of Q and R. P is full unless it starts diagonal."""
    updates: Annotated[int, option("K", "100")] = 100
    """Steps of the optimizer."""
    count: Annotated[int, option("B", "64")] = 64
    """Number of initial states, validation included."""
    batch: Annotated[int | None, option("B", "all that are not for validation")] = None
    """Loops of one step, drawn anew each time."""
    validation: Annotated[float, option("SHARE", "0.25")] = 0.25
    """Share of the initial states kept apart."""
    steps: Annotated[int | None, option("K", "50; robots: 1 s")] = None
    """Length of the closed loops, in samples."""
    seconds: Annotated[float | None, option("S", "none: --steps")] = None
    """The same in seconds."""
    optimizer: Annotated[str, option("NAME", "adam")] = "adam"
    """Optimizer of optax, by name: adam, adamw, sgd, rmsprop, lion, ..."""
    learning_rate: Annotated[float, option("X", "0.05")] = 0.05
    """Its step; with adam a weight changes by about this share in a step."""
    mode: Annotated[
        Literal["auto", "forward", "reverse"], option("{auto,forward,reverse}", "auto")
    ] = "auto"
    """Derivatives: forward pays for each weight, reverse takes memory.
    auto: both are compiled, and the faster one runs."""
    tracking: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "Q at the start")] = None
    """Diagonal of the loss's own Q."""
    effort: Annotated[tuple[float, ...] | None, option("R [R ...]", "R at the start")] = None
    """Diagonal of the loss's own R."""
    violation: Annotated[float, option("W", "10")] = 10.0
    """Weight of excesses over state limits in the loss, in shares of half the range."""
    settling: Annotated[float, option("W", "0")] = 0.0
    """Weight of a sample of time to settle in the loss."""
    tolerance: Annotated[float, option("SHARE", "0.02")] = 0.02
    """What counts as at the target, in shares of half the range of each state."""
    lower: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Lower ends of the initial states, one number a state. Not for robots."""
    upper: Annotated[tuple[float, ...] | None, option("X [X ...]", "state limits x --spread")] = (
        None
    )
    """Upper ends. States without a plan within the limits (linear programs) are drawn again."""
    spread: Annotated[float | None, option("SHARE", "0.9; robots 0.5")] = None
    """Initial states are uniform up to this share of the way to the limits."""
    horizon: Horizon = None
    """Prediction horizon, in samples."""
    terminal: Terminal = None
    """Set for the last state, as in jaxmpc sweep. Not for robots."""
    margin: Annotated[float | None, option("SHARE", "from the file; 0.02 if tuned or robot")] = None
    """Tightening of the state limits at the start, in shares of half the range."""
    target: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "home of the model")] = None
    """With --robot: configuration to rest at."""
    linearize: Annotated[
        Literal["set-point", "state", "trajectory"] | None,
        option("{set-point,state,trajectory}", "from the file, else state"),
    ] = None
    """With --robot: where the linear models are taken; see jaxmpc simulate."""
    mass: Annotated[float, option("SHARE", "0")] = 0.0
    """With --robot: masses and inertias times numbers from 1 - SHARE to 1 + SHARE.
    Each loop has its own; the MPC does not know."""
    damping: Annotated[float, option("SHARE", "0")] = 0.0
    """The same for the damping of each joint."""
    payload: Annotated[float, option("KG", "0")] = 0.0
    """Mass from 0 to KG at the site "tool" of the model; the MPC does not know."""
    iterations: Annotated[int | None, option("K", "[solver], else 50; robots 20")] = None
    """ADMM steps of each plan."""
    refine: Annotated[int | None, option("K", "[solver], else 3; robots 2")] = None
    """Newton steps after them."""
    dtype: Annotated[
        Literal["float32", "float64"] | None,
        option("{float32,float64}", "float64; robots float32"),
    ] = None
    """Precision of loops and derivatives."""
    seed: Annotated[int, option("K", "0")] = 0
    """Of initial states, batches, masses, damping and payloads."""
    output: Annotated[Path, option("DIR", "jaxmpc-weights")] = Path("jaxmpc-weights")
    """Folder for the files; made where absent."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Go on with the run in --output."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Delete the run in --output and start again."""

    def run(self) -> int:
        """Do it; the result is the exit code."""
        begun, compiled = time.perf_counter(), Compiled.seconds
        try:
            problem = self.prepare()
            print(
                f"{problem.name}: {', '.join(self.tune)} from {len(problem.x0s)} closed loops of "
                f"{problem.steps} samples -> {self.output}", flush=True,
            )  # fmt: skip
            with jax.enable_x64(problem.dtype == "float64"):
                run = tune_weights(
                    problem.make, problem.parameters, problem.plant, problem.x0s, problem.loss,
                    problem.steps, reference=problem.reference,
                    input_reference=problem.input_reference, variations=problem.variations,
                    validation=float(np.mean(~problem.train)), solver=problem.solver,
                    optimizer=self.stepper(), updates=self.updates, batch=self.batch,
                    mode=self.mode, seed=self.seed, checkpoint=self.output / CHECKPOINT,
                    progress=sys.stderr.isatty(),
                )  # fmt: skip
        except ValueError as error:
            return report_error(error)
        compiling = Compiled.seconds - compiled
        seconds = {"compile": compiling, "run": time.perf_counter() - begun - compiling}
        # The start has no rounding of exp(log(v)) in it.
        best = run.values if run.history.best else run.initial
        (self.output / TUNED).write_text(problem.write(best))
        print(self.save(problem, run, seconds, begun))
        return 0

    def prepare(self) -> "Problem":
        """Check and open everything. Raises ValueError, compiles no closed loop."""
        self.check()
        if (self.output / "tuning.json").exists() and not (self.resume or self.overwrite):
            there = self.output / "tuning.json"
            fail(
                str(there), "exists", "Add --resume to go on with it or --overwrite to start again"
            )
        problem = self.linear() if self.robot is None else self.nonlinear()
        self.stepper(np.zeros(1))
        files = ("tuning.json", TUNED, "tuning.png", "before_after.png", "maps.png")
        open_run(self.output, files, self.options(problem), self.resume, self.overwrite)
        return problem

    def check(self) -> None:
        """Raise ValueError for options that make no sense."""
        if self.robot is None:
            given = {name: getattr(self, name) for name in
                     ("target", "linearize", "mass", "damping", "payload")}  # fmt: skip
            refused({k: v or None for k, v in given.items()}, None, "It is of robots")
        else:
            given = {"lower": self.lower, "upper": self.upper, "terminal": self.terminal}
            refused(given, self.robot, "Starts are drawn by --spread, and no terminal set is used")
        if not self.tune or len(set(self.tune)) != len(self.tune):
            fail("--tune", f"{' '.join(self.tune) or 'nothing'}", "Name each quantity once")
        if self.steps is not None and self.seconds is not None:
            fail("--seconds", "given beside --steps", "Give one of them")
        for name, least in (
            ("updates", 0), ("count", 2), ("batch", 1), ("steps", 1), ("iterations", 1),
            ("refine", 0), ("seed", 0),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value < least:
                fail(f"--{name}", f"{value}", f"Give a whole number, at least {least}")
        for name in ("seconds", "learning_rate", "tolerance"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                fail(f"--{name.replace('_', '-')}", f"{value}", "Give a positive number")
        for name in ("violation", "settling", "payload"):
            if not 0 <= getattr(self, name) < np.inf:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a number, at least 0")
        if not 0 < self.validation < 1:
            fail("--validation", f"{self.validation}", "Give a share above 0 and below 1")
        for name in ("margin", "mass", "damping"):
            if not 0 <= (getattr(self, name) or 0.0) < 1:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a share from 0 to below 1")
        if self.spread is not None and not 0 < self.spread <= 1:
            fail("--spread", f"{self.spread}", "Give a share above 0 and up to 1")

    def stepper(self, tried: Any = None) -> optax.GradientTransformation:
        """The optimizer; with `tried`, parameters to try it on, ValueError where it is none."""
        return optimizer_of(self.optimizer, self.learning_rate, tried)

    def linear(self) -> "Problem":
        """The problem of a file."""
        config = problem_file(self)
        margin = config.limits.margin if self.margin is None else self.margin
        if "tightening" in self.tune and self.margin is None and not margin:
            margin = 0.02
        if margin and config.limits.x_min is None:
            fail("--tune tightening, --margin", "the problem has no x_min, x_max", "Give limits")
        if margin != config.limits.margin:
            section = dataclasses.replace(config.limits, margin=margin)
            config = dataclasses.replace(config, limits=section)
        if "tightening" in self.tune and config.mpc.terminal in ("invariant", "ellipsoid"):
            what = f'the terminal set "{config.mpc.terminal}" rests on the limits as they are'
            fail("--tune tightening", what, "Use --terminal box or none")
        hard, rho = config.build_mpc(), config.cost.rho
        if rho is not None:  # the number that "exact" stands for
            controlled = config.build_controlled()
            rho = float(controlled.soft[0].rho) if controlled.soft else 0.0  # type: ignore[index]
        if "rho" in self.tune and not rho:
            fail("--tune rho", "the problem has no soft limits", "Give it [cost] rho")
        config = self.settled(config, hard, rho)
        parameters: dict[str, Parameter] = {
            name: weight_parameter(name, value, self.weights)
            for name, value in (("Q", hard.Q), ("R", hard.R), ("P", hard.terminal_cost))
            if name in self.tune
        }
        if "rho" in self.tune:
            parameters["rho"] = Parameter(rho, "positive")
        limits = config.state_limits()
        if "tightening" in self.tune:
            assert isinstance(limits, Box)
            parameters["tightening"] = tightening(margin, limits, np.zeros(hard.system.n))
        n, m = hard.system.n, hard.system.m
        free = Box(np.full(n, -np.inf), np.full(n, np.inf))
        assert isinstance(hard.inputs, Box)
        plant = LinearPlant(
            hard.system, limits if isinstance(limits, Box) else free, hard.inputs,
            name=config.name,
        )  # fmt: skip
        settings = config.build_solver() or ADMM(iterations=50, refine=3)
        count = settings.iterations if self.iterations is None else self.iterations
        refine = settings.refine if self.refine is None else self.refine
        solver = dataclasses.replace(settings, iterations=count, refine=refine)
        dtype = self.dtype or "float64"
        x0s, dropped = self.starts(config, hard if rho is None else soften(hard, rho))
        steps = self.steps or 50
        if self.seconds is not None:
            steps = max(1, round(self.seconds / plant.dt))

        def write(values: Mapping[str, np.ndarray]) -> str:
            return tuned(config, values).to_toml()

        def read(path: Path) -> Controller:
            return Controller(configs.load(path, None, "tune").build_controlled(), solver)

        make = linear_family(hard, config.cost.P, rho, parameters, limits)
        return Problem(
            config.name, make, parameters, plant, x0s, {}, self.apart(len(x0s)),
            self.loss(hard.Q, hard.R, n, m, limits, plant, None, None), None, None, steps, solver,
            dtype, limits, write, read, {"problem": config.to_dict("tune")}, dropped, hard, config,
        )  # fmt: skip

    def settled(self, config: configs.Config, hard: MPC, rho: float | None) -> configs.Config:
        """The problem with what depends on the weights as numbers: rho, and a terminal set that
        the LQR of the start keeps."""
        cost, mpc = dataclasses.replace(config.cost, rho=rho), config.mpc
        given, plain = hard.terminal_set, lambda v: tuple(map(tuple, np.asarray(v, float).tolist()))
        if mpc.terminal != "box" and isinstance(given, Polytope):
            h = tuple(np.asarray(given.h, float).tolist())
            mpc = dataclasses.replace(mpc, terminal="none", H_f=plain(given.H), h_f=h)
        if mpc.terminal != "box" and isinstance(given, Ellipsoid):
            level = float(np.asarray(given.level))
            mpc = dataclasses.replace(mpc, terminal="none", P_f=plain(given.P), level_f=level)
        return dataclasses.replace(config, cost=cost, mpc=mpc)

    def starts(self, config: configs.Config, mpc: MPC) -> tuple[np.ndarray, int]:
        """Initial states (count, n), and how many were drawn and proved infeasible."""
        share = 0.9 if self.spread is None else self.spread
        lower, upper = start_range(config, self.lower, self.upper, share)
        return feasible_states(mpc, config.state_limits(), lower, upper, self.count, self.seed)

    def nonlinear(self) -> "Problem":
        """The problem of a robot."""
        file = None if self.config is None else configs.load_robot_config(self.config)
        with contextlib.redirect_stdout(io.StringIO()):  # MJX tells of absent optional parts
            robot = load_robot(str(self.robot))
        said = configs.RobotSection(name=robot.name) if file is None else file.robot
        given: dict[str, Any] = {
            "horizon": self.horizon, "margin": self.margin, "linearize": self.linearize,
        }  # fmt: skip
        said = dataclasses.replace(said, **{k: v for k, v in given.items() if v is not None})
        if self.target is not None and len(self.target) != robot.mujoco.nq:
            what = f"has {len(self.target)} numbers"
            fail("--target", what, f"{robot.name} needs {robot.mujoco.nq}")
        target = None if self.target is None else np.array(self.target)
        # What does not compile is checked before the linear model is.
        loss = self.loss(np.eye(robot.n), np.eye(robot.m), robot.n, robot.m, None, None, None, None)
        weights: dict[str, Any] = {} if file is None else file.weights(robot)
        mpc = robot_mpc(robot, horizon=said.horizon, target=target, margin=said.margin, **weights)
        Q, R, P = mpc.Q, mpc.R, mpc.terminal_cost
        rho = 1e4 if file is None else file.cost.rho
        follow = "lqr" if file is None else file.cost.P
        follow = follow if isinstance(follow, str) else "none"
        parameters: dict[str, Parameter] = {
            name: weight_parameter(name, value, self.weights)
            for name, value in (("Q", Q), ("R", R), ("P", P))
            if name in self.tune
        }
        if "rho" in self.tune:
            parameters["rho"] = Parameter(rho, "positive")
        x, s = robot.equilibrium(target)
        with jax.enable_x64(True):
            r = np.asarray(robot.coordinates(x))
        if "tightening" in self.tune:
            parameters["tightening"] = tightening(said.margin, robot.state_limits, r)
        solver = ADMM(
            iterations=20 if self.iterations is None else self.iterations,
            refine=2 if self.refine is None else self.refine,
        )
        drawn = Simulate(
            count=self.count, spread=0.5 if self.spread is None else self.spread, seed=self.seed,
            mass=self.mass, damping=self.damping, payload=self.payload,
        )  # fmt: skip
        x0s, variations = drawn.draw(robot)
        variations = plant_numbers(robot, variations)
        if variations:
            robot.vary(**{key: value[0] for key, value in variations.items()})
        dtype = self.dtype or "float32"
        steps = self.steps or max(1, round((self.seconds or 1.0) / robot.dt))
        loss = self.loss(Q, R, robot.n, robot.m, robot.state_limits, robot, r, s)

        def controller(mpc: MPC, penalty: Any, linearize: str) -> RobotController:
            return RobotController(robot, mpc, solver, linearize=linearize, penalty=penalty)

        def make(values: Mapping[str, Any]) -> RobotController:
            changed = dataclasses.replace(mpc, Q=values.get("Q", Q), R=values.get("R", R))
            changed = dataclasses.replace(changed, terminal_cost=follower(changed, values, follow))
            if "tightening" in values:
                states = robot.state_limits.tightened(values["tightening"])
                changed = dataclasses.replace(changed, states=states)
            return controller(changed, values.get("rho", rho), said.linearize)

        def write(values: Mapping[str, np.ndarray]) -> str:
            end: Any = follow
            if "P" in values or (follow == "none" and P is not None):
                end = matrix(values.get("P", P), flat=False)
            margin = float(values.get("tightening", said.margin))
            return configs.RobotConfig(
                robot=dataclasses.replace(said, margin=margin),
                cost=configs.RobotCostSection(
                    Q=matrix(values.get("Q", Q)), R=matrix(values.get("R", R)), P=end,
                    rho=float(values.get("rho", rho)),
                ),
            ).to_toml()  # fmt: skip

        def read(path: Path) -> RobotController:
            file = configs.load_robot_config(path)
            mpc = robot_mpc(
                robot, horizon=file.robot.horizon, target=target, margin=file.robot.margin,
                **file.weights(robot),
            )  # fmt: skip
            return controller(mpc, file.cost.rho, file.robot.linearize)

        start = {"robot": write({}), "model": model_hash(robot)}
        return Problem(
            robot.name, make, parameters, robot, x0s, variations, self.apart(len(x0s)), loss, r,
            np.asarray(s), steps, solver, dtype, robot.state_limits, write, read, start, 0, mpc,
            None,
        )  # fmt: skip

    def apart(self, count: int) -> np.ndarray:
        """Which initial states are for training; the last ones are for validation."""
        kept = min(max(1, round(self.validation * count)), count - 1)
        return np.arange(count) < count - kept

    def loss(
        self, Q: Any, R: Any, n: int, m: int, limits: Any, plant: Any, r: Any, s: Any
    ) -> ClosedLoopLoss:
        """The loss of the options."""
        for name, given, size in (("tracking", self.tracking, n), ("effort", self.effort, m)):
            if given is not None and len(given) != size:
                fail(f"--{name}", f"has {len(given)} numbers", f"The problem needs {size}")
        Q = np.asarray(Q) if self.tracking is None else np.array(self.tracking)
        R = np.asarray(R) if self.effort is None else np.array(self.effort)
        half = limits.half_widths() if isinstance(limits, Box) else np.ones(n)
        return ClosedLoopLoss(
            Q, R, r, s, limits, self.violation, self.settling, self.tolerance * half,
            plant=None if isinstance(plant, LinearPlant) else plant,
        )  # fmt: skip

    def options(self, problem: "Problem") -> dict[str, Any]:
        """What decides the result, as JSON data; --updates may grow."""
        apart = ("config", "output", "resume", "overwrite", "updates")
        found = {k: v for k, v in dataclasses.asdict(self).items() if k not in apart}
        solver = {"iterations": problem.solver.iterations, "refine": problem.solver.refine}
        found |= {"steps": problem.steps, "dtype": problem.dtype, **solver, **problem.options}
        return json.loads(json.dumps(found))

    def save(
        self, problem: "Problem", run: TuningRun, seconds: dict[str, float], begun: float
    ) -> str:  # fmt: skip
        """Check the file in new runs, write the others; the table."""
        h, test = run.history, problem.x0s[~problem.train]
        before, after = (
            problem.simulated(controller)
            for controller in (
                lambda: run.build(run.initial), lambda: problem.read(self.output / TUNED)
            )
        )  # fmt: skip
        counts = [problem.counted(loops, self.tolerance) for loops in (before, after)]
        with jax.enable_x64(True):
            record = run.record()
        trace = labelled(problem, record["values_by_step"])
        rejected = int(np.sum(~h.accepted))
        result = {
            "improved": h.best > 0, "best_step": h.best, "rejected": rejected,
            "validation": [float(h.validation[0]), float(h.validation[h.best])],
            "before": counts[0], "after": counts[1],
        }  # fmt: skip
        document = {
            "name": problem.name, "options": self.options(problem), "finished": True,
            "result": result, "this_run": seconds, "states_without_plan": problem.dropped,
            **record, "versions": versions(),
        }  # fmt: skip
        write_json(self.output / "tuning.json", document)
        change = (
            f"validation loss {h.validation[0]:.6g} to {h.validation[h.best]:.6g} "
            f"({-100 * run.improvement:+.2f} %)"
            if h.best
            else f"no step better than the start, validation loss {h.validation[0]:.4g}"
        )
        title = f"{problem.name}: {', '.join(self.tune)} tuned, {change}"
        figure = plot_tuning(h, trace, title)
        figure.savefig(self.output / "tuning.png", dpi=150)
        shown = min(6, len(test))
        title = (
            f"{change}\n{shown} of {len(test)} validation loops, the same starts before and after"
        )
        figure = plot_before_after(
            before, after, problem.plant, reference=problem.reference,
            input_reference=problem.input_reference, title=f"{problem.name}: {title}",
        )  # fmt: skip
        figure.savefig(self.output / "before_after.png", dpi=150)
        files = [TUNED, "tuning.json", "tuning.png", "before_after.png", CHECKPOINT]
        if problem.config is not None and "tightening" in self.tune and problem.plant.n == 2:
            self.maps(problem).savefig(self.output / "maps.png", dpi=150)
            files.insert(4, "maps.png")
        seconds = {**seconds, "total": time.perf_counter() - begun}
        return self.table(problem, run, result, trace, seconds, files)

    def maps(self, problem: "Problem") -> Any:
        """Feasible sets before and after."""
        config = configs.load(self.output / TUNED, None, "tune")
        low, high = config.state_range()
        points = grid(low, high, (64, 64))
        found = [map_feasible_set(m, points).refine() for m in (problem.mpc, config.build_mpc())]
        return plot_maps(*found)

    def table(
        self, problem: "Problem", run: TuningRun, result: dict[str, Any],
        trace: dict[str, dict[str, np.ndarray]], seconds: dict[str, float], files: list[str],
    ) -> str:  # fmt: skip
        """The result for the eye."""
        h, (first, last) = run.history, result["validation"]
        before, after = result["before"], result["after"]
        entries = [
            (f"{group} {name}".strip(), values[0], values[h.best])
            for group, parts in trace.items()
            for name, values in parts.items()
        ]
        wide = max(13, *(len(name) for name, _, _ in entries[:SHOWN]))
        row = lambda name, a, b, more="": f"  {name:<{wide}} {a:>12} {b:>12}  {more}".rstrip()
        share = lambda v: f"{100 * v:.2f} %"
        change = f"{-100 * run.improvement:+.2f} %" if result["improved"] else "no change"
        lines = [row("", "before", "after"), row("loss", f"{first:.6g}", f"{last:.6g}", change)]
        loops = before["loops"]
        for key, name, more in (
            ("beyond", "beyond", f"of {loops} loops: leave a limit"),
            ("unsolved", "unsolved", f"of {before['plans']:,} plans each"),
            ("infeasible", "infeasible", "of them proved infeasible"),
            ("fallback", "fallback", "of them break soft limits"),
            ("at_target", "at target", f"of {loops} loops at the end"),
        ):
            lines.append(row(name, share(before[key]), share(after[key]), more))
        for name, a, b in entries[:SHOWN]:
            ratio = f"x {b / a:.3g}" if a else ""
            lines.append(row(name, f"{a:.5g}", f"{b:.5g}", ratio))
        if len(entries) > SHOWN:
            lines.append(f"  {'...':<{wide}} {len(entries) - SHOWN} more in {TUNED}")
        if any(p.domain == "definite" for p in problem.parameters.values()):
            lines.append(f"  {'':<{wide}} of full matrices the diagonal; all of it in {TUNED}")
        if not result["improved"]:
            words = (
                f"none of {h.steps} steps is better on the validation loops: {TUNED} is the start"
            )
            lines.append(f"  {'result':<{wide}} {words}")
        if problem.dropped:
            words = (
                f"{problem.dropped:,} initial states drawn have no plan within the limits: replaced"
            )
            lines.append(f"  {'starts':<{wide}} {words}")
        what = f"best is {h.best} of {h.steps}; {result['rejected']} rejected as not finite"
        lines += [
            f"  {'steps':<{wide}} {what}",
            f"  {'mode':<{wide}} {run.settings['mode']}",
            f"  {'compile':<{wide}} {seconds['compile']:.1f} s",
            f"  {'run':<{wide}} {seconds['run']:.1f} s",
            f"  {'total':<{wide}} {seconds['total']:.1f} s with set-up, checks and files",
            f"  {'files':<{wide}} {' '.join(str(self.output / name) for name in files)}",
        ]
        return "\n".join(lines)


class Problem(NamedTuple):
    """Everything that tuning of weights needs, checked.

    make: values to an MPC or controller. x0s (B, n or nq + nv), varied (B, ...); train (B,): which
    of them are for training. limits: what counts as beyond. write: values to the text of
    tuned.toml; read: the controller that such a file stands for. options: what else decides.
    dropped: states drawn that have no plan. mpc: at the start, hard. config: None for robots.
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
    read: Callable[[Path], Any]
    options: dict[str, Any]
    dropped: int
    mpc: MPC
    config: configs.Config | None

    def simulated(self, make: Callable[[], Any]) -> Run:
        """The validation loops with a controller."""
        with jax.enable_x64(self.dtype == "float64"):
            made = make()
            controller = Controller(made, self.solver) if isinstance(made, MPC) else made
            return simulate_many(
                controller, self.plant, self.x0s[~self.train], self.steps,
                reference=self.reference, input_reference=self.input_reference,
                variations={k: v[~self.train] for k, v in self.variations.items()},
            )  # fmt: skip

    def counted(self, run: Run, tolerance: float) -> dict[str, Any]:
        """What became of the loops, judged from their states and inputs."""
        goal = np.zeros(self.plant.n) if self.reference is None else self.reference
        outcome = evaluate_runs(run, self.plant, goal, tolerance=tolerance)
        kept = outcome.kept
        if isinstance(self.limits, Polytope):
            limits = jax.tree.map(lambda v: np.asarray(v, float), self.limits)
            kept = kept & violation.kept(limits, outcome.coordinates).all(axis=(1, 2))
        status = np.asarray(run.status)
        return {
            "loops": len(kept), "plans": int(status.size), "beyond": float(np.mean(~kept)),
            "kept_to": violation.TOLERANCE["float64"],
            "unsolved": float(np.mean(status != Status.SOLVED)),
            "infeasible": float(np.mean(status == Status.PRIMAL_INFEASIBLE)),
            "fallback": float(np.mean(run.fallback)),
            "at_target": float(np.mean(outcome.reached)),
        }  # fmt: skip


def linear_family(
    hard: MPC, follow: Any, rho: float | None, parameters: Mapping[str, Parameter], limits: Any
) -> Callable[[Mapping[str, Any]], MPC]:
    """Values to the problem that the controller solves. Traceable."""
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
    """The terminal weight: tuned itself, following Q and R, or as it was."""
    if "P" in values:
        return values["P"]
    if follow == "lqr" and {"Q", "R"} & set(values):
        return lqr(mpc.system, mpc.Q, mpc.R).P
    return mpc.Q if follow == "Q" else mpc.terminal_cost


def weight_parameter(name: str, value: Any, form: str) -> Parameter:
    """Q, R or P as what is tuned. ValueError where its start has no logarithm."""
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
    """The share by which limits are tightened: up to TIGHTEST, and never past the target."""
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
    """The problem with other weights."""
    changes: dict[str, Any] = {
        name: matrix(values[name]) for name in ("Q", "R", "P") if name in values
    }
    if "rho" in values:
        changes["rho"] = float(values["rho"])
    limits = config.limits
    if "tightening" in values:
        limits = dataclasses.replace(limits, margin=float(values["tightening"]))
    cost = dataclasses.replace(config.cost, **changes)
    return dataclasses.replace(config, cost=cost, limits=limits)


def matrix(value: Any, flat: bool = True) -> Any:
    """A matrix as the file has it: rows, or if `flat` the diagonal where there is nothing else."""
    value = np.asarray(value, float)
    if flat and np.all(value == np.diag(np.diag(value))):
        return tuple(np.diag(value).tolist())
    return tuple(map(tuple, value.tolist()))


def labelled(problem: Problem, traces: Mapping[str, Any]) -> dict[str, dict[str, np.ndarray]]:
    """Weights by step: group → entry → (T+1,); the diagonal of matrices."""
    if problem.config is None:
        states, inputs = list(problem.plant.state_names), list(problem.plant.input_names)
        half = len(states) // 2
        if states[:half] == states[half:]:
            states = [*states[:half], *(f"{name} velocity" for name in states[half:])]
    else:
        system = problem.plant.system
        states = list(system.state_names) or [f"x{i + 1}" for i in range(system.n)]
        inputs = list(system.input_names) or [f"u{i + 1}" for i in range(system.m)]
    found: dict[str, dict[str, np.ndarray]] = {}
    for group, trace in traces.items():
        trace = np.asarray(trace, float)
        if trace.ndim == 1:
            found[group] = {"": trace}
        else:
            names = inputs if group == "R" else states
            found[group] = {name: trace[:, i, i] for i, name in enumerate(names)}
    return found
