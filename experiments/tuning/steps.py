"""Steps and time of Gauss-Newton, Adam, sampling and CMA-ES on the same closed loops.

    joint   the inverse problem of inverse.py: from an expert's trajectories to its weights, from
            weights 3 to 10 times off; the loss is zero at the expert's weights
    arm2    that of the two-link arm in MJX
    masses  the task of useful.py: two-link arms whose masses, damping and payload the controller
            does not know; the loss is that of tracking, effort and violations
    valve   a double integrator whose valve has three positions, which has no useful derivative

All modes have the same start, training and validation loops. Adam, with derivatives and with
samples, has a rate that falls to a hundredth along a cosine; Gauss-Newton takes its own steps. The
table has, by step, the least validation loss so far in shares of the one at the start; the steps
and the processor time (s) until a loss is as low as the best of Adam with derivatives; and the
processor time of a step, which does not depend on what else the machine does. Compiling is apart,
by the clock. CMA-ES is that of the package cma, with its default population, on the mean loss of
the training loops; a step is a generation.

    python experiments/tuning/steps.py --tasks joint arm2 masses valve
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import inverse
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
import useful

import jaxmpc as jm
from jaxmpc import tuning as tuner
from jaxmpc.batches import Compiled
from jaxmpc.tuning.objective import flattened
from jaxmpc.tuning.parameters import Parameter, raw
from jaxmpc.tuning.weights import prepared

SHOWN = (1, 2, 3, 5, 10, 20, 40, 60)


@dataclass(frozen=True)
class Settings:
    """updates, rate: of Adam. steps: of Gauss-Newton. loops: to learn from, a quarter of them to
    validate. spread: of starts of the task masses, as in useful.py."""

    tasks: tuple[str, ...] = ("joint", "arm2", "masses", "valve")
    modes: tuple[str, ...] = ("auto", "sampling", "cma", "gauss-newton")
    updates: int = 60
    steps: int = 10
    rate: float = 0.15
    loops: int = 32
    spread: float = 0.1
    bits: int = 64
    seed: int = 0


def inverse_task(s: Settings, name: str) -> tuple[tuple, dict[str, Any]]:
    """Return the arguments of `tune_weights` for a problem of inverse.py."""
    given = inverse.Settings(train=s.loops, test=4)
    rng = np.random.default_rng([s.seed, 0])
    case = {"joint": inverse.joint, "arm2": inverse.arm2}[name](given, rng)
    expert = jm.simulate_many(
        case.controller(**case.hidden), case.plant, case.starts, given.samples, **case.aims
    )
    factor = lambda v: np.exp(
        rng.choice([-1, 1], v.shape) * rng.uniform(*np.log(given.wrong), v.shape)
    )
    parameters = {key: Parameter(v * factor(v), "positive") for key, v in case.hidden.items()}
    loss = inverse.imitation(case.starts, expert.states, case.size)
    make = lambda v: case.controller(**v)
    starts = case.starts[: s.loops]
    return (make, parameters, case.plant, starts, loss, given.samples), case.aims


def masses_task(s: Settings) -> tuple[tuple, dict[str, Any]]:
    """Return those of the task of useful.py."""
    given = useful.Settings(spread=s.spread, seed=s.seed)
    robot, aims = useful.robot_at_rest(given)
    guess, make = useful.law(given, robot)
    loss = jm.ClosedLoopLoss(
        guess["q"],
        guess["r"],
        *aims.values(),
        robot.state_limits,
        violation=given.violation,
        plant=robot,
    )
    parameters = {name: Parameter(v, "positive") for name, v in guess.items()}
    x0s, variations = useful.world(given, robot, s.loops, 0)
    return (make, parameters, robot, x0s, loss, given.samples), aims | {"variations": variations}


class Valve:
    """A double integrator with inputs of -1, 0 and 1."""

    model = jm.LinearSystem(np.array([[1, 0.2], [0, 1]]), np.array([[0.02], [0.2]]), dt=0.2)

    def step(self, x: Any, u: Any) -> Any:
        """Return the next state."""
        return self.model.step(x, jnp.round(u))


def valve_task(s: Settings) -> tuple[tuple, dict[str, Any]]:
    """Return those of the valve."""
    mpc = jm.MPC(Valve.model, np.eye(2), np.eye(1), 5, inputs=jm.Box([-1.0], [1.0]))

    def make(v: Any) -> jm.MPC:
        Q = jnp.diag(jnp.asarray(v["q"]))
        return replace(mpc, Q=Q, R=jnp.diag(jnp.asarray(v["r"])), terminal_cost=Q)

    parameters = {"q": Parameter(np.ones(2), "positive"), "r": Parameter(np.ones(1), "positive")}
    x0s = np.random.default_rng(s.seed).uniform(-1, 1, (s.loops, 2))
    loss = jm.ClosedLoopLoss([1.0, 0.1], [0.01])
    solver = jm.ADMM(iterations=30, newton_steps=0, eps=1e-3)
    return (make, parameters, Valve(), x0s, loss, 25), {"solver": solver}


def by_cma(
    s: Settings, given: tuple, options: dict[str, Any], count: int
) -> tuple[np.ndarray, list[float]]:
    """Return the validation loss by generation, and the processor time after each."""
    import cma

    make, parameters, plant, x0s, loss, samples = given
    loops = prepared(make, parameters, plant, x0s, loss, samples, tuner.Settings(), **options)
    start, unravel = flattened(raw(parameters))
    evaluate, x, varied = loops.objective.several(None), *loops.train
    strategy = cma.CMAEvolutionStrategy(start, 0.3, {"seed": s.seed + 1, "verbose": -9})
    found, times = [loops.validate(unravel(start))[0]], []
    for _ in range(count):
        asked = np.array(strategy.ask())
        losses, _ = evaluate(unravel(asked), x, varied, np.ones(len(x)))
        strategy.tell(asked, np.where(np.isfinite(losses), losses, 1e9))
        found.append(loops.validate(unravel(strategy.result.xfavorite))[0])
        times.append(time.process_time())
    return np.array(found), times


class Timed:
    """An optimiser of optax that notes the processor time at each of its calls."""

    def __init__(self, optimizer: optax.GradientTransformation) -> None:
        self.optimizer, self.times = optimizer, []

    def transformation(self) -> optax.GradientTransformation:
        """Return the optimiser."""

        def update(*args: Any) -> Any:
            self.times.append(time.process_time())
            return self.optimizer.update(*args)

        return optax.GradientTransformation(self.optimizer.init, update)


def run(s: Settings) -> None:
    """Tune each task in each mode, and print the table."""
    print(f"{s}\n{jax.devices()[0].device_kind}, JAX {jax.__version__}")
    for name in s.tasks:
        others = {"masses": masses_task, "valve": valve_task}
        given, options = others[name](s) if name in others else inverse_task(s, name)
        print(f"\n{name}: {sum(p.value.size for p in given[1].values())} weights")
        heads = "".join(f"{k:>9}" for k in SHOWN)
        print(f"{'step':14}{heads}{'as Adam':>9}{'time':>8}{'a step':>8}{'compile':>9}")
        least = np.nan
        for mode in s.modes:
            newton, compiled, label = mode == "gauss-newton", Compiled.seconds, mode
            count = s.steps if newton else s.updates
            if mode == "cma":
                validation, times = by_cma(s, given, options, count)
            else:
                schedule = optax.cosine_decay_schedule(s.rate, count, 0.01)
                timed = Timed(optax.sgd(1.0) if newton else optax.adam(schedule))
                how = {"updates": count, "mode": mode, "optimizer": timed.transformation()}
                tuned = jm.tune_weights(*given, **how, **options)
                validation, times = tuned.history.validation, timed.times
                label = tuned.settings["mode"]
            compiled = Compiled.seconds - compiled
            # The first step compiles.
            step = (times[-1] - times[1]) / max(count - (2 if mode == "cma" else 1), 1)
            so_far = np.minimum.accumulate(np.nan_to_num(validation, nan=np.inf))
            shares = so_far / so_far[0]
            if mode == "auto":
                least = shares[-1]
            reached = np.flatnonzero(shares <= least * (1 + 1e-6))
            when = f"{reached[0]:9d}{reached[0] * step:8.1f}" if len(reached) else ""
            shown = "".join(f"{shares[k]:9.1e}" if k <= count else f"{'':9}" for k in SHOWN)
            print(f"{label:14}{shown}{when:17}{step:8.2f}{compiled:9.0f}", flush=True)


if __name__ == "__main__":
    settings = tyro.cli(Settings, description=__doc__)
    with jax.enable_x64(settings.bits == 64):
        run(settings)
