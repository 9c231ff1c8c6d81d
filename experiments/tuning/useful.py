"""Weights that a person would guess, tuned on robots that are not as modelled.

Every robot has masses, inertias, damping and a payload of its own, of which its controller knows
nothing. The guess is Bryson's rule, as `robot_mpc` has it; the loss has weights of its own, fixed:
tracking of a set-point, effort, violations of the limits (`ClosedLoopLoss`, with Bryson's Q and R
times the factors `tracking`, `damped`, `effort`, and `violation`). Tuned are the diagonals of Q
and R; the terminal cost follows as that of the LQR. Then, on starts and robots unseen so far:

    loss        mean closed-loop loss; change: against the guess; at least −20 % is asked for
    kept        share of loops that keep all limits of states to 1e-6, with no less than the guess
    mean, worst violation, in rad or rad/s: mean over loops of the largest, and the largest of all

Beside it, with the same wall time (compile apart), random search, CMA-ES (cma) and Bayesian
optimisation (optuna: Gaussian processes where torch is installed, else TPE) over the same
logarithms of the weights, within factors of `box` about the guess. Their oracle is the same
compiled batch of closed loops, of the training and validation robots together, for `candidates`
settings at once. "data" is the loss on these; "matched": seconds until theirs was as good as what
gradient tuning ended with (inf: not within `budget` times its wall time; the table counts what
they had found after once that time).

    python experiments/tuning/useful.py --robot arm2 --test 1024 --mass 0.1 --damping 0.5 --delay 1
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax.flatten_util import ravel_pytree
from searchers import SEARCHERS, Space, search, within

import jaxmpc as jm
from jaxmpc.batches import Compiled
from jaxmpc.robots.robot import Robot
from jaxmpc.systems.given_model import as_argument
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.objective import ClosedLoopObjective
from jaxmpc.tuning.parameters import Parameter, raw
from jaxmpc.tuning.weights import tune_weights


@dataclass(frozen=True)
class Settings:
    """train, validation, test: loops. samples: of each. updates, rate: steps of Adam, and its rate,
    which falls to a tenth along a cosine. mass, damping: shares by which they are off. payload: kg
    at most. delay: samples, 0 or 1, by which inputs come late, of which the controller knows
    nothing. spread: of starts about home, rad and (times 4) rad/s. velocity: limits in place of the
    file's, times theirs. sigma: first step of CMA-ES and random search's scale, in log(weight)."""

    robot: str = "arm2"
    train: int = 24
    validation: int = 8
    test: int = 64
    samples: int = 50
    updates: int = 30
    rate: float = 0.2
    horizon: int = 20
    iterations: int = 20
    newton_steps: int = 2
    linearize: str = "state"
    mass: float = 0.3
    damping: float = 0.5
    payload: float = 0.4
    delay: int = 0
    spread: float = 0.1
    velocity: float = 0.5
    margin: float = 0.02
    tracking: float = 1.0
    damped: float = 1.0
    effort: float = 1.0
    violation: float = 10.0
    mode: str = "auto"
    rivals: tuple[str, ...] = ("random", "cma", "bayes")
    box: float = 100.0
    sigma: float = 1.0
    candidates: int = 1
    budget: float = 1.0
    bits: int = 32
    seed: int = 0


def world(s: Settings, robot: Robot, count: int, seed: int) -> tuple[np.ndarray, dict]:
    """Starts (B, n), and masses, inertias, damping, payloads of B robots."""
    rng, model = np.random.default_rng([s.seed, seed]), robot.mujoco
    shift = s.spread * rng.uniform(-1, 1, (count, robot.state_size))
    shift[:, model.nq :] *= 4 * s.velocity
    factor = rng.uniform(1 - s.mass, 1 + s.mass, (count, model.nbody))
    damping = rng.uniform(1 - s.damping, 1 + s.damping, (count, model.nv)) * model.dof_damping
    varied = {
        "body_mass": factor * model.body_mass,
        "dof_damping": damping,
        "body_inertia": factor[..., None] * model.body_inertia,
    }
    if s.payload:
        varied["payload"] = rng.uniform(0, s.payload, count)
    return np.asarray(robot.home) + shift, varied


def law(s: Settings, robot: Robot) -> tuple[dict, Callable, jm.ADMM]:
    """The guess, and the controller as a function of the diagonals of Q and R."""
    mpc = jm.robot_mpc(robot, horizon=s.horizon, margin=s.margin)
    solver = jm.ADMM(s.iterations, newton_steps=s.newton_steps)

    def make(v: Any) -> jm.RobotController:
        Q, R = jnp.diag(jnp.asarray(v["q"])), jnp.diag(jnp.asarray(v["r"]))
        P = jm.lqr(mpc.system, Q, R).P
        made = replace(mpc, Q=Q, R=R, terminal_cost=P)
        return jm.RobotController(robot, made, solver, linearize=s.linearize)

    return {"q": np.diag(mpc.Q), "r": np.diag(mpc.R)}, make


def robot_at_rest(s: Settings) -> tuple[Robot, dict[str, np.ndarray]]:
    """The robot with its limits of velocity, and the set-point where it rests, by the arguments of
    a loop."""
    robot = jm.load_robot(s.robot)
    speed = s.velocity * np.asarray(robot.state_limits.upper)[robot.mujoco.nv :]
    robot = jm.load_robot(s.robot, velocity=(-speed, speed))
    x, u = robot.equilibrium()
    return robot, {"reference": np.asarray(robot.coordinates(x)), "input_reference": u}


def run(s: Settings) -> None:
    """Tune, search for as long, judge all on the same unseen robots."""
    robot, aims = robot_at_rest(s)
    nv = robot.mujoco.nv
    late = {"delay": s.delay, "compensate": False}
    guess, make = law(s, robot)
    loss = ClosedLoopLoss(
        guess["q"] * np.repeat([s.tracking, s.damped], nv),
        guess["r"] * s.effort,
        *aims.values(),
        robot.state_limits,
        violation=s.violation,
        plant=robot,
    )
    parameters = {name: Parameter(v, "positive") for name, v in guess.items()}
    known, unseen = world(s, robot, s.train + s.validation, 0), world(s, robot, s.test, 1)
    print(f"{s}\n{jax.devices()[0].device_kind}, JAX {jax.__version__}", flush=True)

    begun, compiling = time.perf_counter(), Compiled.seconds
    tuned = tune_weights(
        make,
        parameters,
        robot,
        known[0],
        loss,
        s.samples,
        variations=known[1],
        conditions=late,
        mode=s.mode,
        validation=s.validation / (s.train + s.validation),
        updates=s.updates,
        optimizer=optax.adam(optax.cosine_decay_schedule(s.rate, s.updates, 0.1)),
        **aims,
    )
    compiling = Compiled.seconds - compiling
    wall = time.perf_counter() - begun - compiling

    # The oracle of the others, and of the numbers in the column "data".
    start, back = ravel_pytree(raw(parameters))
    problem = ClosedLoopObjective(
        make, parameters, as_argument(robot), s.samples, loss, *aims.values(), None, late
    )
    total = lambda theta, *rest: problem.total(back(theta), *rest)[0]
    several = Compiled(jax.jit(jax.vmap(total, in_axes=(0, None, None, None, None))))
    fixed = problem.arguments(raw(parameters), *known, np.ones(len(known[0])))[1:]

    def oracle(thetas: np.ndarray) -> np.ndarray:
        rows = jnp.asarray(np.resize(thetas, (s.candidates, thetas.shape[1])), start.dtype)
        losses = several(rows, *fixed)[: len(thetas)].astype(float)
        return np.where(np.isfinite(losses), losses, 1e9)

    flat = lambda v: np.log(np.concatenate([v["q"], v["r"]]))
    oracle(flat(guess)[None])  # compiles
    ended = float(oracle(flat(tuned.values)[None])[0])
    print(
        f"gradient, {tuned.settings['mode']}: {wall:.1f} s for {s.updates} updates, "
        f"compiling {compiling:.0f} s"
        f", rejected {np.sum(~tuned.history.accepted)}, best after {tuned.history.best}, "
        f"validation {tuned.history.validation[0]:.5g} to {np.nanmin(tuned.history.validation):.5g}"
    )
    found = {"guess": (guess, 0, 0.0), "gradient": (tuned.values, s.updates, wall)}
    space = Space(flat(guess), float(np.log(s.box)), s.sigma, s.candidates, s.seed)
    for name in s.rivals:
        try:
            trace = search(SEARCHERS[name](space), oracle, s.budget * wall)
        except ImportError as error:
            print(f"{name}: not installed ({error})")
            continue
        _, count, _, best = within(trace, wall)
        q, r = np.split(np.exp(best), [2 * nv])
        when = next((row[0] for row in trace if row[2] <= ended), np.inf)
        found[name] = {"q": q, "r": r}, count, when

    print(
        f"{'':10}{'steps':>7}{'matched':>9}{'data':>10}{'loss':>10}{'change':>9}{'kept':>8}"
        f"{'mean':>10}{'worst':>10}{'unsolved':>10}{'soft':>8}"
    )
    base, tests = None, (unseen[0], s.samples)
    for name, (v, count, when) in found.items():
        r = jm.simulate_many(make(v), robot, *tests, variations=unseen[1], **late, **aims)
        losses = np.asarray(jax.vmap(loss)(jax.tree.map(jnp.asarray, r)), float)
        base = losses.mean() if base is None else base
        worst = r.violation.max(axis=1)
        print(
            f"{name:10}{count:7d}{when:9.1f}{oracle(flat(v)[None])[0]:10.5f}{losses.mean():10.5f}"
            f"{losses.mean() / base - 1:+9.1%}{(worst <= 1e-6).mean():8.1%}{worst.mean():10.2e}"
            f"{worst.max():10.2e}{(r.status != jm.Status.SOLVED).mean():10.2%}"
            f"{r.fallback.mean():8.2%}",
            flush=True,
        )
    for name, (v, *_) in found.items():
        times = np.exp(flat(v) - flat(guess))
        print(f"{name:10}weights, times the guess: {np.array2string(times, precision=3)}")


if __name__ == "__main__":
    settings = tyro.cli(Settings, description=__doc__)
    with jax.enable_x64(settings.bits == 64):
        run(settings)
