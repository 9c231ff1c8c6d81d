"""The command `jaxmpc simulate`: arguments to calls, no mathematics."""

import contextlib
import dataclasses
import importlib
import io
import json
import os
import sys
import time
from ctypes.util import find_library
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
import zarr
from tqdm.std import tqdm

from jaxmpc.checks import fail
from jaxmpc.closed_loop.linear_feedback import LinearFeedback
from jaxmpc.closed_loop.outcome import Outcome, evaluate_runs
from jaxmpc.closed_loop.robot_controller import RobotController
from jaxmpc.closed_loop.robot_mpc import robot_mpc
from jaxmpc.closed_loop.run import Run
from jaxmpc.closed_loop.simulate_many import simulate_many
from jaxmpc.commands.options import model_hash, open_folder, option, report_error
from jaxmpc.compiled import Compiled, first_rows, padded
from jaxmpc.config import load_robot_config
from jaxmpc.control.riccati import lqr
from jaxmpc.control.violation import TOLERANCE
from jaxmpc.plots import plot_runs
from jaxmpc.qp.admm import ADMM
from jaxmpc.qp.status import Status
from jaxmpc.robots.load import load_robot
from jaxmpc.robots.robot import Robot
from jaxmpc.robots.video import render, save_video
from jaxmpc.sweeps import store

# Seconds between frames of the video.
FRAME = 0.04
# What --config says where an option does not, and what holds without either.
USUAL = {"horizon": 20, "margin": 0.02, "linearize": "state", "penalty": 1e4}


@dataclasses.dataclass(frozen=True)
class Simulate:
    """Drive thousands of robots to a target under constrained MPC, and count what holds.

    What it does
      Puts many copies of a robot at random states, each with its own masses if asked for, and
      drives all of them to a target: physics by MuJoCo MJX, at each sample a linear model and an
      MPC that keeps joint, velocity and torque limits. Then judges every run by its own states
      and inputs, not by what the MPC promised.
      Limits that a plan cannot keep are broken as little as --penalty asks (fallback), and counted.

    How to start
      $ jaxmpc simulate
      $ jaxmpc simulate --robot arm7 --count 256 --seconds 1 --mass 0.1 --output runs/a
      The first samples come after the compiler: 20 s for one joint, a minute for seven.

    How to read the table
      success        robots that kept all limits and ended at the target: each coordinate within
                     --tolerance of half its range (limits' half-width; 1 where it has none)
      limits kept    robots with all states and inputs within the limits at all samples, to 1e-6
                     (1e-6 of the limit, where that is above 1). The margin is not counted in.
      promised       robots all of whose plans were solved without fallback; how many kept limits
      worst          the largest violation in shares of half the range, in its own unit
      plans solved   plans whose residuals pass: 1e-6 in float64, 1e-3 in float32
      fallback       plans that break soft limits somewhere on their horizon
      settling       time after which a robot stays within the tolerance for the rest of its run
      cost           sum of (x - x_target)'Q(x - x_target) + (u - u_target)'R(u - u_target)
      run            wall time without compiler, files and pictures
      real time      robot-seconds simulated in a second of wall time; the second number is
                     simulated time by wall time for all robots at once: above 1 is real time

    Files, all in the folder of --output
      runs.png       Positions, velocities and inputs of some robots over time, limits in grey.
                     Orange: fallback plans. Red: limits exceeded.
      robots.gif     Some of the robots, in real time. Needs OpenGL: without a display libegl1
                     libegl-mesa0 libgl1-mesa-dri libgl1 (Debian, Ubuntu); without it no video.
      summary.json   The table's numbers, target, worst violation of each coordinate, versions.
      runs.zarr      points (the start), states, inputs, status, cost, fallback, ... of every
                     robot. Opens with xarray.open_zarr(path, consolidated=False).
      Ctrl-C         Stops; finished chunks are kept, --resume goes on from there.
      Exit code      0 done, whatever the robots did; 2 error (one line on stderr says which);
                     130 stopped by Ctrl-C.
    """

    robot: Annotated[str, option("NAME|FILE", "joint")] = "joint"
    """joint, pendulum, cartpole, arm2, arm6, arm7, quadrotor, or an MJCF or URDF file."""
    config: Annotated[Path | None, option("FILE", "none: the options below")] = None
    """TOML file of jaxmpc tune weights --robot: [robot] name, horizon, margin, linearize, [cost] Q,
    R, P, rho. An option given here wins over the file."""
    count: Annotated[int, option("B", "64")] = 64
    """Number of robots."""
    seconds: Annotated[float, option("S", "2")] = 2.0
    """Simulated time."""
    target: Annotated[tuple[float, ...] | None, option("Q [Q ...]", "home of the model")] = None
    """Configuration to rest at, one number a joint, in rad or m (qpos of MuJoCo)."""
    spread: Annotated[float, option("SHARE", "0.5")] = 0.5
    """Starts are uniform around home, up to this share of the way to the limits.
    Where there is no limit, up to this number itself. In positions and velocities."""
    seed: Annotated[int, option("K", "0")] = 0
    """Of starts, masses, damping and payloads."""
    linearize: Annotated[
        Literal["set-point", "state", "trajectory", "lqr"] | None,
        option("{set-point,state,trajectory,lqr}", "from --config, else state"),
    ] = None
    """Linear models: once at the target, at each measured state, along the last plan.
    lqr: no MPC but linear feedback, clipped to the input limits, to compare with."""
    horizon: Annotated[int | None, option("N", "from --config, else 20")] = None
    """Prediction horizon, in control periods."""
    state_weights: Annotated[
        tuple[float, ...] | None,
        option("Q [Q ...]", "from --config, else Bryson's rule, velocities x 0.01"),
    ] = None
    """Diagonal of Q: positions, then velocities. Bryson's rule: 1/(half the range)^2."""
    input_weights: Annotated[
        tuple[float, ...] | None, option("R [R ...]", "from --config, else Bryson's rule x 0.01")
    ] = None
    """Diagonal of R, one number an actuator."""
    margin: Annotated[float | None, option("SHARE", "from --config, else 0.02")] = None
    """Room that the MPC leaves to state limits, in shares of half the range."""
    penalty: Annotated[float | None, option("RHO", "from --config, else 1e4")] = None
    """L1 weight of state limits; too small a weight breaks limits that could be kept."""
    iterations: Annotated[int, option("K", "50")] = 50
    """ADMM steps of each plan."""
    refine: Annotated[int | None, option("K", "2; with float64 3")] = None
    """Newton steps after them; 3 solve nearly all plans, in two to four times the time."""
    mass: Annotated[float, option("SHARE", "0")] = 0.0
    """Each body's mass and inertia times a number from 1 - SHARE to 1 + SHARE.
    The MPC does not know: it has the model of the file."""
    damping: Annotated[float, option("SHARE", "0")] = 0.0
    """The same for the damping of each joint."""
    payload: Annotated[float, option("KG", "0")] = 0.0
    """Mass from 0 to KG at the site "tool" of the model; the MPC does not know."""
    tolerance: Annotated[float, option("SHARE", "0.02")] = 0.02
    """How near the target counts as there, in shares of half the range."""
    dtype: Annotated[Literal["float32", "float64"], option("{float32,float64}", "float32")] = (
        "float32"
    )
    """Precision of physics and MPC."""
    chunk: Annotated[int | None, option("B", "256 on a CPU, 4096 on others")] = None
    """Robots at a time: what is written at once, and lost at most."""
    video: Annotated[int, option("K", "4")] = 4
    """Number of robots in the video; 0: none."""
    output: Annotated[Path, option("DIR", "jaxmpc-simulate")] = Path("jaxmpc-simulate")
    """Folder for the files; made where absent."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Go on with the run in --output."""
    overwrite: Annotated[bool, tyro.conf.FlagCreatePairsOff, option(None, "off")] = False
    """Delete the run in --output and start again."""

    def run(self) -> int:
        """Do it; the result is the exit code."""
        try:
            command = self.settled()
            job = command.prepare()
        except ValueError as error:
            return report_error(error)
        return command.finish(job)

    def settled(self) -> "Simulate":
        """The command with what --config or `USUAL` says for options that are not given."""
        found: dict[str, Any] = dict(USUAL)
        if self.config is not None:
            file = load_robot_config(self.config)
            found |= {
                "horizon": file.robot.horizon, "margin": file.robot.margin,
                "linearize": file.robot.linearize, "penalty": file.cost.rho,
            }  # fmt: skip
        missing = {key: value for key, value in found.items() if getattr(self, key) is None}
        return dataclasses.replace(self, **missing)

    def finish(self, job: "Job") -> int:
        """Run what `prepare` opened; the exit code."""
        robot = job.robot
        print(f"{robot.name}: {self.count:,} robots for {self.seconds:g} s -> {self.output}")
        speed = self.drive(job)
        run = _read(self.output / "runs.zarr")
        outcome = evaluate_runs(run, robot, job.reference, tolerance=self.tolerance)
        files = ["runs.zarr", "summary.json", "runs.png"]
        figure = plot_runs(run, robot, reference=job.reference, input_reference=job.input_reference)
        figure.savefig(self.output / "runs.png", dpi=150)
        if self.video:
            files += self.film(robot, run)
        summary = self.summary(job, run, outcome, speed)
        (self.output / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
        print(self.table(summary, " ".join(str(self.output / name) for name in files)))
        return 0

    def prepare(self) -> "Job":
        """Check and open everything a run needs. Raises ValueError, compiles no loop."""
        self.check()
        path = self.output / "runs.zarr"
        if path.exists() and not (self.resume or self.overwrite):
            fail(str(path), "exists", "Add --resume to go on with it or --overwrite to start again")
        if self.video:
            _choose_renderer()
        try:
            importlib.import_module("mujoco")
        except (AttributeError, ImportError, RuntimeError) as error:
            problem = f"mujoco does not start with {os.environ.get('MUJOCO_GL')!r} ({error})"
            fail("MUJOCO_GL", problem, "Unset it, or install the OpenGL library that it names")
        with contextlib.redirect_stdout(io.StringIO()):  # MJX tells of absent optional parts
            robot = load_robot(self.robot)
        sizes = (
            ("--target", self.target, robot.mujoco.nq),
            ("--state-weights", self.state_weights, robot.n),
            ("--input-weights", self.input_weights, robot.m),
        )
        for name, given, size in sizes:
            if given is not None and len(given) != size:
                fail(name, f"has {len(given)} numbers", f"{robot.name} needs {size}")
        target = None if self.target is None else np.array(self.target)
        file: dict[str, Any] = {}
        if self.config is not None:
            file = load_robot_config(self.config).weights(robot)
        options = {"Q": self.state_weights, "R": self.input_weights}
        file |= {key: np.array(value) for key, value in options.items() if value is not None}
        more = {"terminal_cost": file["terminal_cost"]} if "terminal_cost" in file else {}
        horizon: Any = self.horizon
        mpc = robot_mpc(
            robot, file.get("Q"), file.get("R"), horizon, target=target, margin=self.margin or 0.0,
            **more,
        )  # fmt: skip
        controller: Any
        with jax.enable_x64(self.dtype == "float64"):
            if self.linearize == "lqr":
                controller = LinearFeedback(mpc, lqr(mpc.system, mpc.Q, mpc.R).K, robot)
            else:
                solver = ADMM(iterations=self.iterations, refine=self.newton_steps)
                controller = RobotController(
                    robot, mpc, solver, linearize=str(self.linearize), penalty=self.penalty
                )
        x, input_reference = robot.equilibrium(target)
        with jax.enable_x64(True):
            reference = np.asarray(robot.coordinates(x))
        starts, variations = self.draw(robot)
        if variations:
            robot.vary(**{key: value[0] for key, value in plant_numbers(robot, variations).items()})
        open_folder(self.output)
        if path.exists() and self.overwrite:
            store.remove(path)
        steps = max(1, round(self.seconds / robot.dt))
        chunk = self.chunk or (256 if jax.default_backend() == "cpu" else 4096)
        group = store.open_store(
            path, starts, self.fields(robot, steps), self.settings(robot, mpc),
            min(chunk, self.count), (steps, robot.state_size, robot.m),
        )  # fmt: skip
        for name in ("summary.json", "runs.png", "robots.gif"):  # of an earlier run
            (self.output / name).unlink(missing_ok=True)
        return Job(robot, controller, reference, input_reference, steps, starts, variations, group)

    def check(self) -> None:
        """Raise ValueError for options that make no sense."""
        if self.resume and self.overwrite:
            fail("--overwrite", "given beside --resume", "Choose one")
        for name, least in (
            ("count", 1), ("horizon", 1), ("iterations", 1), ("refine", 0), ("video", 0),
            ("seed", 0), ("chunk", 1),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is not None and value < least:
                fail(f"--{name}", f"{value}", f"Give a whole number, at least {least}")
        for name in ("seconds", "penalty", "tolerance"):
            if not 0 < getattr(self, name) < np.inf:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a positive number")
        if not 0 <= self.payload < np.inf:
            fail("--payload", f"{self.payload}", "Give a mass in kg")
        if not 0 <= self.spread <= 1:
            fail("--spread", f"{self.spread}", "Give a share from 0 to 1")
        for name in ("margin", "mass", "damping"):
            if not 0 <= getattr(self, name) < 1:
                fail(f"--{name}", f"{getattr(self, name)}", "Give a share from 0 to below 1")

    def draw(self, robot: Robot) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Starts (B, nq + nv), and factors of mass (B, bodies), damping (B, nv), payload (B,)."""
        starts, masses, dampings, loads = np.random.default_rng(self.seed).spawn(4)
        with jax.enable_x64(True):
            home = np.asarray(robot.coordinates(np.asarray(robot.home)))
            lower, upper = (
                np.where(np.isfinite(end), np.abs(end - home), 1.0)
                for end in (np.asarray(robot.state_limits.lower), robot.state_limits.upper)
            )
            aside = self.spread * starts.uniform(-1, 1, (self.count, robot.n))
            xi = home + np.where(aside > 0, upper, lower) * aside
            x0s = np.asarray(jax.vmap(robot.state)(xi))
        found = {}
        for name, share, random, size in (
            ("mass", self.mass, masses, robot.mujoco.nbody),
            ("damping", self.damping, dampings, robot.mujoco.nv),
        ):
            if share:
                found[name] = random.uniform(1 - share, 1 + share, (self.count, size))
        if self.payload:
            found["payload"] = loads.uniform(0, self.payload, self.count)
        return x0s, found

    def fields(self, robot: Robot, steps: int) -> dict[str, store.Field]:
        """What the store keeps of each robot."""
        number = lambda shape, *axes: store.Field(shape, self.dtype, np.nan, axes)
        factor = lambda shape, *axes: store.Field(shape, "float64", np.nan, axes)
        found = {
            "states": number((steps + 1, robot.state_size), "sample_time", "state"),
            "inputs": number((steps, robot.m), "time", "input"),
            "cost": number((steps,), "time"),
            "status": store.Field((steps,), "int8", int(Status.NOT_RUN), ("time",)),
            "stage_cost": number((steps,), "time"),
            "violation": number((steps + 1,), "sample_time"),
            "fallback": store.Field((steps,), "bool", False, ("time",)),
        }
        if self.mass:
            found["mass"] = factor((robot.mujoco.nbody,), "body")
        if self.damping:
            found["damping"] = factor((robot.mujoco.nv,), "dof")
        if self.payload:
            found["payload"] = factor(())
        return found

    def settings(self, robot: Robot, mpc: Any) -> dict[str, Any]:
        """What decides the results, as JSON data."""
        apart = ("output", "video", "tolerance", "resume", "overwrite", "chunk")
        options = {k: v for k, v in dataclasses.asdict(self).items() if k not in apart}
        weights = {
            "state_weights": np.diag(mpc.Q).tolist(),
            "input_weights": np.diag(mpc.R).tolist(),
        }
        if self.config is None:
            del options["config"]
        else:  # what is in the file, not where it lies
            weights |= {
                name: np.asarray(value, float).tolist()
                for name, value in (("Q", mpc.Q), ("R", mpc.R), ("P", mpc.terminal_cost))
            }
            options["config"] = "tuned"
        options |= {**weights, "refine": self.newton_steps, "model": model_hash(robot)}
        return options

    @property
    def newton_steps(self) -> int:
        """`refine`, or what the precision asks for: ADMM alone seldom comes to 1e-6."""
        return (3 if self.dtype == "float64" else 2) if self.refine is None else self.refine

    def drive(self, job: "Job") -> "Speed":
        """Run the chunks not yet done, and commit each."""
        todo, speed = store.pending(job.group), Speed()
        rows = [np.arange(self.count)[store.chunk_rows(job.group, k)] for k in todo]
        size = len(np.arange(self.count)[store.chunk_rows(job.group, 0)])
        total = sum(map(len, rows))
        with tqdm(total=total, unit=" robots", disable=None) as bar:
            for index, chosen in zip(todo, rows, strict=True):
                varied = {key: value[chosen] for key, value in job.variations.items()}
                begun, compiled = time.perf_counter(), Compiled.seconds
                with jax.enable_x64(self.dtype == "float64"):
                    run = simulate_many(
                        job.controller, job.robot, padded(job.starts[chosen], size), job.steps,
                        reference=job.reference, input_reference=job.input_reference,
                        variations={
                            key: padded(value, size)
                            for key, value in plant_numbers(job.robot, varied).items()
                        },
                    )  # fmt: skip
                compiling = Compiled.seconds - compiled
                speed.compile_seconds += compiling
                speed.run_seconds += time.perf_counter() - begun - compiling
                speed.robots += len(chosen)
                run = first_rows(run, len(chosen))
                kept = {name: getattr(run, name) for name in self.fields(job.robot, job.steps)
                        if hasattr(run, name)}  # fmt: skip
                store.commit(job.group, index, **kept, **varied)
                bar.update(len(chosen))
        return speed

    def film(self, robot: Robot, run: Run) -> list[str]:
        """Draw the first robots; a line on stderr where nothing can be drawn."""
        finite = np.flatnonzero(np.isfinite(run.states).all(axis=(1, 2)))[: self.video]
        every = max(1, round(FRAME / robot.dt))
        try:
            if not len(finite):
                raise RuntimeError("no video: no robot has finite states")
            frames = render(robot, run.states[finite], every=every)
        except RuntimeError as error:
            print(f"jaxmpc: {error}", file=sys.stderr)
            return []
        save_video(self.output / "robots.gif", frames, 1 / (every * robot.dt))
        return ["robots.gif"]

    def summary(self, job: "Job", run: Run, outcome: Outcome, speed: "Speed") -> dict[str, Any]:
        """The numbers of the table, and what they rest on."""
        robot, plans = job.robot, int(np.size(run.status))
        names = [*robot.state_names, *robot.input_names]
        units = [*robot.state_units, *robot.input_units]
        excess = [outcome.state_excess, outcome.input_excess]
        worst = np.concatenate([np.nanmax(e, axis=(0, 1), initial=0.0) for e in excess])
        widths = [b.half_widths() for b in (robot.state_limits, robot.input_limits)]
        i = int(np.argmax(worst / np.concatenate(widths)))
        finite = lambda v: float(v) if np.isfinite(v) else None
        level = lambda v, q: finite(
            np.quantile(np.where(np.isnan(v), np.inf, v), q, method="higher")
        )
        levels = lambda v: {"median": level(v, 0.5), "95 %": level(v, 0.95)}
        count = lambda v: int(np.count_nonzero(v))
        seconds = job.steps * robot.dt
        simulated = {}
        if speed.robots:
            simulated = {
                "solves_per_second": speed.robots * job.steps / speed.run_seconds,
                "robot_seconds_per_second": speed.robots * seconds / speed.run_seconds,
                "real_time_factor": seconds / speed.run_seconds,
            }
        mpc = self.linearize != "lqr"
        return {
            "robot": robot.name,
            "robots": len(outcome.kept),
            "samples": job.steps,
            "control_period": robot.dt,
            "success": count(outcome.success),
            "limits_kept": count(outcome.kept),
            "limits_kept_to": TOLERANCE["float64"],
            "reached": count(outcome.reached),
            "not_finite": count(~np.isfinite(run.states).all(axis=(1, 2))),
            "promised": count(outcome.plans_valid) if mpc else None,
            "promised_and_kept": count(outcome.plans_valid & outcome.kept) if mpc else None,
            "worst_violation": {"of": names[i], "by": float(worst[i]), "unit": units[i]},
            "violations": {
                "states": dict(zip(robot.state_names, worst[: robot.n].tolist(), strict=True)),
                "inputs": dict(zip(robot.input_names, worst[robot.n :].tolist(), strict=True)),
            },
            "plans": plans if mpc else 0,
            "plans_solved": count(run.status == Status.SOLVED),
            "fallback_plans": count(run.fallback),
            "settling": levels(outcome.settling),
            "cost": levels(outcome.cost),
            "this_run": {**dataclasses.asdict(speed), **simulated},
            "target": dict(zip(robot.state_names, job.reference.tolist(), strict=True)),
            "target_input": dict(zip(robot.input_names, job.input_reference.tolist(), strict=True)),
            "tolerance": dict(zip(robot.state_names, outcome.band.tolist(), strict=True)),
            "config": job.group.attrs["config"],
            "versions": {
                **dict(job.group.attrs["versions"]),  # type: ignore[arg-type]
                **{name: version(name) for name in ("mujoco", "mujoco-mjx")},
            },
            "device": jax.devices()[0].device_kind,
        }  # fmt: skip

    def table(self, s: dict[str, Any], files: str) -> str:
        """The summary for the eye."""
        share = lambda key: f"{s[key]:>9,}  {s[key] / s['robots']:8.2%}"
        mpc, worst, this = s["plans"] > 0, s["worst_violation"], s["this_run"]
        after = lambda v: "never" if v is None else f"{v:.4g} s"
        number = lambda v: "not finite" if v is None else f"{v:.4g}"
        middle = lambda key, show: (
            f"median {show(s[key]['median'])}, 95 % up to {show(s[key]['95 %'])}"
        )
        length = f"{s['samples']:,} samples of {s['control_period']:g} s each"
        rows = [
            ("robots", f"{s['robots']:>9,}  {length}"),
            ("success", f"{share('success')}  limits kept, and at the target at the end"),
            ("limits kept", f"{share('limits_kept')}  to {TOLERANCE['float64']:g}, all samples"),
        ]
        if s["not_finite"]:
            rows.append(("not finite", share("not_finite")))
        if mpc:
            kept = f"of these {s['promised_and_kept']:,} kept all limits"
            rows.append(("promised", f"{share('promised')}  {kept}"))
        beyond = f"{worst['by']:.3g} {worst['unit']} beyond a limit of {worst['of']}"
        rows.append(("worst", beyond if worst["by"] else "no limit exceeded"))
        if mpc:
            for key, label, what in (
                ("plans_solved", "plans solved", ""),
                ("fallback_plans", "fallback", "  break soft limits"),
            ):
                part = f"{s[key]:>9,}  {s[key] / s['plans']:8.2%}"
                rows.append((label, f"{part}  of {s['plans']:,}{what}"))
        rows.append(("settling", middle("settling", after)))
        rows.append(("cost", middle("cost", number)))
        rows.append(("compile", f"{this['compile_seconds']:.2f} s"))
        if this["robots"]:
            what = "MPC solves" if mpc else "control steps"
            rate = f"{this['solves_per_second']:,.0f} {what}/s"
            rows.append(
                ("run", f"{this['run_seconds']:.2f} s for {this['robots']:,} robots, {rate}")
            )
            rows.append(
                (
                    "real time",
                    f"{this['robot_seconds_per_second']:,.4g} robot-seconds/s; all "
                    f"{this['robots']:,} at {this['real_time_factor']:.3g} times real time",
                )
            )
        rows.append(("files", files))
        return "\n".join(f"  {name:<13} {value}" for name, value in rows)


class Job(NamedTuple):
    """A run that is checked and open, before anything compiles."""

    robot: Robot
    controller: Any
    reference: np.ndarray
    input_reference: np.ndarray
    steps: int
    starts: np.ndarray
    variations: dict[str, np.ndarray]
    group: zarr.Group


@dataclasses.dataclass
class Speed:
    """What this process did, its share of a run that may have been resumed."""

    robots: int = 0
    compile_seconds: float = 0.0
    run_seconds: float = 0.0


def plant_numbers(robot: Robot, variations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Factors as the numbers that `Robot.vary` takes."""
    model, found = robot.mujoco, {}
    if "mass" in variations:
        factor = variations["mass"]
        found = {
            "body_mass": factor * model.body_mass,
            "body_inertia": factor[..., None] * model.body_inertia,
        }
    if "damping" in variations:
        found["dof_damping"] = variations["damping"] * model.dof_damping
    if "payload" in variations:
        found["payload"] = variations["payload"]
    return found


def _read(path: Path) -> Run:
    """The runs in the store, on the host."""
    data = store.read(path).load()
    names = [field.name for field in dataclasses.fields(Run) if field.name != "slack"]
    found: dict[str, Any] = {name: data[name].values for name in names}
    # x_0 is measured and no limit binds it, so that there is no soft row at k = 0.
    found["slack"] = np.zeros((*found["status"].shape, 0))
    return Run(**found)


def _choose_renderer() -> None:
    """Let MuJoCo, not imported yet, render through EGL where there is no display."""
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    late = "mujoco" in sys.modules
    if sys.platform == "linux" and not display and not late and find_library("EGL"):
        os.environ.setdefault("MUJOCO_GL", "egl")
