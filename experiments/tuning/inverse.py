"""The inverse test: from the closed loops of an expert with hidden weights back to its behaviour.

An expert drives a plant with weights Q*, R* that the tuner never sees. It sees the expert's
trajectories from some starts, and begins with weights that are wrong by factors of `wrong[0]` to
`wrong[1]`, up or down, each its own. The loss is the mean squared difference of the trajectories,
in shares of the limits' half-widths. What counts is that error from starts of which the tuner has
seen nothing, before and after: 100 times less is asked for. Weights are determined only up to a
common factor (the table divides by the first); the terminal cost is Q's for the joint, and that of
the LQR for the arm, for expert and pupil alike.

    joint   the lesson's joint as a linear plant, hard limits
    arm2    two links in MJX, linear models as `linearize` says (`RobotController`), soft limits

    python experiments/tuning/inverse.py --plants joint
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import jaxmpc as jm
from jaxmpc.closed_loop import Run
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.weights import tune_weights


@dataclass(frozen=True)
class Settings:
    """train, test: starts. samples: of a loop. updates: steps of Adam, of rate `rate` falling to a
    hundredth along a cosine. spread: of the arm's starts about home, rad and (times 4) rad/s.
    wrong: least and greatest factor by which the first guess is off. bits: of numbers."""

    plants: tuple[str, ...] = ("joint", "arm2")
    train: int = 32
    test: int = 32
    samples: int = 40
    updates: int = 80
    rate: float = 0.15
    horizon: int = 20
    iterations: int = 50
    newton_steps: int = 3
    linearize: str = "state"
    spread: float = 0.4
    wrong: tuple[float, float] = (3.0, 10.0)
    mode: str = "auto"
    trials: int = 1
    bits: int = 64
    seed: int = 0


@dataclass(frozen=True)
class Case:
    """plant; controller of (q, r), the diagonals of the weights; hidden weights; starts; references
    and the sizes (n,) by which errors are measured."""

    plant: Any
    controller: Callable[[Any, Any], Any]
    hidden: dict[str, np.ndarray]
    starts: np.ndarray
    aims: dict[str, Any]
    size: np.ndarray


def joint(s: Settings, rng: np.random.Generator) -> Case:
    """The lesson's joint, from starts whose plans the expert can make to the end."""
    system = jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01)
    limit, count = np.array([1.5, 2.0]), s.train + s.test
    mpc = jm.MPC(
        system,
        np.eye(2),
        np.eye(1),
        s.horizon,
        states=jm.Box(-limit, limit),
        inputs=jm.Box([-2.0], [2.0]),
        constrained_stages=tuple(range(1, s.horizon + 1)),
    )
    solver = jm.ADMM(s.iterations, newton_steps=s.newton_steps)

    def controller(q: Any, r: Any) -> Any:
        Q = jnp.diag(jnp.asarray(q))
        return jm.Controller(replace(mpc, Q=Q, R=jnp.diag(jnp.asarray(r)), terminal_cost=Q), solver)

    hidden = {"q": np.array([50.0, 1.0]), "r": np.array([0.1])}
    draws = rng.uniform(-limit, limit, (4 * count, 2))
    run = jm.simulate_many(controller(**hidden), system, draws, s.samples)
    starts = draws[(run.status == jm.Status.SOLVED).all(axis=1)][:count]
    return Case(system, controller, hidden, starts, {}, limit)


def arm2(s: Settings, rng: np.random.Generator) -> Case:
    """The two-link arm from random starts to its home."""
    robot = jm.load_robot("arm2")
    x_ref, u_ref = robot.equilibrium()
    mpc = jm.robot_mpc(robot, horizon=s.horizon)
    solver = jm.ADMM(s.iterations, newton_steps=s.newton_steps)

    def controller(q: Any, r: Any) -> Any:
        Q, R = jnp.diag(jnp.asarray(q)), jnp.diag(jnp.asarray(r))
        P = jm.lqr(mpc.system, Q, R).P
        made = replace(mpc, Q=Q, R=R, terminal_cost=P)
        return jm.RobotController(robot, made, solver, linearize=s.linearize)

    shift = s.spread * rng.uniform(-1, 1, (s.train + s.test, robot.state_size))
    shift[:, robot.n // 2 :] *= 4
    hidden = {"q": np.array([40.0, 25.0, 1.0, 0.3]), "r": np.array([0.002, 0.02])}
    aims = {"reference": np.asarray(robot.coordinates(x_ref)), "input_reference": u_ref}
    return Case(robot, controller, hidden, x_ref + shift, aims, robot.state_limits.half_widths())


def imitation(starts: np.ndarray, states: np.ndarray, size: np.ndarray) -> Callable[[Run], Any]:
    """Mean squared distance of a run to the expert's states (B, T+1, n) from the same start."""

    def loss(run: Run) -> Any:
        same = jnp.argmin(jnp.sum((jnp.asarray(starts) - run.states[0]) ** 2, axis=1))
        return jnp.mean(((run.states - jnp.asarray(states)[same]) / jnp.asarray(size)) ** 2)

    return loss


def trial(s: Settings, name: str, seed: int) -> None:
    """Hide, tune, compare, print."""
    rng = np.random.default_rng([s.seed, seed])
    case = {"joint": joint, "arm2": arm2}[name](s, rng)
    drive = lambda weights: jm.simulate_many(
        case.controller(**weights), case.plant, case.starts, s.samples, **case.aims
    )
    expert = drive(case.hidden)
    wrong = {
        key: value
        * np.exp(rng.choice([-1, 1], value.shape) * rng.uniform(*np.log(s.wrong), value.shape))
        for key, value in case.hidden.items()
    }
    seen, unseen = slice(None, s.train), slice(s.train, None)
    tuned = tune_weights(
        lambda v: case.controller(**v),
        {k: Parameter(v, "positive") for k, v in wrong.items()},
        case.plant,
        case.starts[seen],
        imitation(case.starts, expert.states, case.size),
        s.samples,
        optimizer=optax.adam(optax.cosine_decay_schedule(s.rate, s.updates, 0.01)),
        updates=s.updates,
        mode=s.mode,
        **case.aims,
    )
    print(
        f"\n{name}, trial {seed}: {len(case.starts[seen])} starts to learn from (a quarter to "
        f"validate), {len(case.starts[unseen])} unseen, {s.samples} samples, N = {s.horizon}, "
        f"{s.updates} updates, {tuned.settings['mode']} mode, {tuned.history.seconds:.0f} s, "
        f"float{s.bits}"
    )
    print(f"{'':8}{'weights, by the first':>54}{'mean square':>13}{'worst':>9}{'unsolved':>10}")
    mean = {}
    for label, given in (("hidden", case.hidden), ("wrong", wrong), ("tuned", tuned.values)):
        run = drive(given)
        off = (((run.states - expert.states) / case.size) ** 2)[unseen]
        mean[label] = off.mean()
        flat = np.concatenate([given["q"], given["r"]])
        unsolved = (run.status[unseen] != jm.Status.SOLVED).mean()
        print(
            f"{label:8}{' '.join(f'{v:.2e}' for v in flat / flat[0]):>54}{mean[label]:13.2e}"
            f"{np.sqrt(off.max()):9.1e}{unsolved:10.2%}"
        )
    ratio = mean["wrong"] / max(mean["tuned"], np.finfo(float).tiny)
    steps = tuned.history.validation
    reached = np.flatnonzero(steps <= steps[0] / 100)
    when = f"after {reached[0]} updates" if len(reached) else "not"
    print(
        f"error on unseen starts: {ratio:.3g} times less ({'≥' if ratio >= 100 else 'BELOW'} 100; "
        f"on validation {when}); rejected steps {np.sum(~tuned.history.accepted)}",
        flush=True,
    )


def run(s: Settings) -> None:
    """All trials of all plants."""
    print(s)
    with jax.enable_x64(s.bits == 64):
        for name in s.plants:
            for seed in range(s.trials):
                trial(s, name, seed)


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
