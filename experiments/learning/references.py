"""A small network that corrects the references of an MPC, learned through its closed loop.

A pendulum has to go from upright to a goal angle. Its MPC (limits on speed and torque) has the
linear model of the nominal pendulum at the upright position; each plant is a nonlinear pendulum
with a mass of its own. So the state settles beside the goal. A network that sees the goal and the
mass (weighed before, say) adds a correction to the reference and to the input reference of the MPC;
the limits stay those of the MPC, whatever the network says. The loss is the mean over tasks and
samples of ((θ − goal)/0.02 rad)², from half of the samples on, and (violation/0.1 rad/s)².

Learned by three methods with the same network, tasks, and wall time (compiling apart):

    gradient    Adam, with the exact gradient through network, MPC, physics and all samples
    evolution   evolution strategy (Salimans et al. 2017, arXiv:1703.03864): antithetic normal
                perturbations, ranks in place of losses, Adam
    random      random search: a normal step is kept if it is better

and judged on tasks unseen so far: the loss, the final error of the angle in mrad (median, worst),
and the share of loops that keep the speed limit to 1e-3 rad/s. "none" is the MPC with the torque
that holds the nominal pendulum at the goal, and no correction.

    python experiments/learning/references.py
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array
from jax.flatten_util import ravel_pytree

import jaxmpc as jm
from jaxmpc.closed_loop import Run


@dataclass(frozen=True)
class Settings:
    """goal: largest angle (rad). mass: range (kg). samples: of a loop, 20 ms each. tasks: learned
    from, all at each step, and as many unseen. hidden: width of both hidden layers. updates, rate:
    steps of Adam. rate_evolution, sigma, pairs: of the evolution strategy. scale: step of random
    search."""

    goal: float = 0.3
    mass: tuple[float, float] = (0.7, 1.3)
    samples: int = 80
    tasks: int = 32
    hidden: int = 16
    horizon: int = 10
    updates: int = 100
    rate: float = 0.01
    rate_evolution: float = 0.02
    sigma: float = 0.05
    pairs: int = 8
    scale: float = 0.05
    seed: int = 0


# What the outputs of the network are multiplied by: rad, rad/s, N m.
OUTPUTS = np.array([0.1, 0.1, 1.0])
DT, GRAVITY = 0.02, 9.81


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pendulum:
    """A point mass (kg) on a rod of 1 m, upright at 0, by semi-implicit Euler steps of 5 ms."""

    mass: Any

    def step(self, x: Array, u: Array) -> Array:
        """Return angle and speed (2,) one sample later under the torque u (1,)."""
        for _ in range(4):
            speed = x[1] + DT / 4 * (GRAVITY * jnp.sin(x[0]) + u[0] / self.mass)
            x = jnp.array([x[0] + DT / 4 * speed, speed])
        return x


def law(s: Settings) -> jm.Controller:
    """Return the MPC of a pendulum of 1 kg, linear at 0; its speed limit is soft."""
    A, B = jax.jacfwd(Pendulum(1.0).step, argnums=(0, 1))(jnp.zeros(2), jnp.zeros(1))
    system = jm.LinearSystem(np.asarray(A, float), np.asarray(B, float), dt=DT)
    Q, R = np.diag([50.0, 1.0]), np.array([[1.0]])
    mpc = jm.MPC(
        system, Q, R, s.horizon, inputs=jm.Box([-5.0], [5.0]),
        states=jm.Box([-np.inf, -1.0], [np.inf, 1.0]),
        terminal_cost=np.asarray(jm.lqr(system, Q, R).P),
    )  # fmt: skip
    return jm.Controller(jm.soften(mpc, 1e3), jm.ADMM(iterations=100, newton_steps=0))


def draw(s: Settings, seed: int) -> dict[str, Array]:
    """Return goals and masses of random tasks."""
    random = np.random.default_rng([s.seed, seed])
    goals = random.uniform(-s.goal, s.goal, s.tasks)
    return {"goal": jnp.asarray(goals), "mass": jnp.asarray(random.uniform(*s.mass, s.tasks))}


def loops(controller: jm.Controller, params: Any, tasks: dict[str, Array], steps: int) -> Run:
    """Return the closed loop of each task; with params zero there is no correction."""

    def loop(task: dict[str, Array]) -> Run:
        goal, mass = task["goal"], task["mass"]
        added = OUTPUTS * network(params, jnp.array([goal / 0.3, (mass - 1) / 0.3]))
        r, u = jnp.array([goal, 0.0]), -GRAVITY * jnp.sin(goal)[None]  # what holds 1 kg there
        return jm.simulate(
            controller, Pendulum(mass), jnp.zeros(2), steps, reference=r + added[:2],
            input_reference=u + added[2:],
        )  # fmt: skip

    return jax.vmap(loop)(tasks)


def loss_of(run: Run, tasks: dict[str, Array]) -> Array:
    """Return the mean loss of closed loops."""
    late = run.states[:, run.inputs.shape[1] // 2 :, 0]
    error = (late - tasks["goal"][:, None]) / 0.02
    return jnp.mean(error**2) + jnp.mean((run.violation / 0.1) ** 2)


def network(params: list[tuple[Array, Array]], x: Array) -> Array:
    """Return the outputs (3,) of a network of tanh layers for the observation x (2,)."""
    for W, b in params[:-1]:
        x = jnp.tanh(x @ W + b)
    W, b = params[-1]
    return x @ W + b


def first(s: Settings) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return random weights; those of the last layer are zero, so that training starts from the
    MPC without corrections."""
    random = np.random.default_rng(s.seed)
    sizes = [2, s.hidden, s.hidden, 3]
    layers = [
        (random.normal(size=(a, b)) / np.sqrt(a), np.zeros(b))
        for a, b in zip(sizes, sizes[1:], strict=False)
    ]
    layers[-1] = (0 * layers[-1][0], layers[-1][1])
    return layers


Losses = Callable[[Array], Array]


def by_gradient(s: Settings, theta: Array, slope: Callable) -> tuple[Array, float]:
    """Return the parameters after `updates` steps of Adam, and the seconds."""
    rule = optax.adam(optax.cosine_decay_schedule(s.rate, s.updates, 0.1))
    state, begun = rule.init(theta), time.perf_counter()
    for _ in range(s.updates):
        change, state = rule.update(slope(theta)[1], state)
        theta = optax.apply_updates(theta, change)
    theta.block_until_ready()
    return theta, time.perf_counter() - begun


def by_evolution(s: Settings, theta: Array, losses: Losses, seconds: float) -> tuple[Array, int]:
    """Return the parameters after this time, and how many settings were simulated."""
    rule, random = optax.adam(s.rate_evolution), np.random.default_rng(s.seed)
    state, count, begun = rule.init(theta), 0, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        aside = random.normal(size=(s.pairs, theta.size))
        found = np.asarray(losses(theta + s.sigma * np.concatenate([aside, -aside])))
        ranks = np.argsort(np.argsort(found)) / (2 * s.pairs - 1) - 0.5
        change, state = rule.update(
            jnp.asarray((ranks[: s.pairs] - ranks[s.pairs :]) @ aside / s.pairs, theta.dtype), state
        )
        theta, count = optax.apply_updates(theta, change), count + 2 * s.pairs
    return theta, count


def by_random_search(
    s: Settings, theta: Array, losses: Losses, seconds: float
) -> tuple[Array, int]:  # fmt: skip
    """Return the best parameters found in this time, and how many were simulated."""
    random, best, count, begun = np.random.default_rng(s.seed), np.inf, 0, time.perf_counter()
    while time.perf_counter() - begun < seconds:
        tried = theta + s.scale * random.normal(size=(2 * s.pairs, theta.size))
        tried = tried.astype(theta.dtype) if count else tried.at[0].set(theta)
        found = np.asarray(losses(tried))
        count += len(found)
        if np.min(found) < best:
            best, theta = float(np.min(found)), tried[np.argmin(found)]
    return theta, count


def run(s: Settings) -> dict[str, dict[str, float]]:
    """Learn by each method and judge on unseen tasks; print the table."""
    controller, known, unseen = law(s), draw(s, 0), draw(s, 1)
    theta, unravel = ravel_pytree(jax.tree.map(jnp.asarray, first(s)))
    simulated = jax.jit(lambda theta, tasks: loops(controller, unravel(theta), tasks, s.samples))
    loss = lambda theta: loss_of(simulated(theta, known), known)
    losses, slope = jax.jit(jax.vmap(loss)), jax.jit(jax.value_and_grad(loss))

    begun = time.perf_counter()
    jax.block_until_ready((slope(theta), losses(jnp.tile(theta, (2 * s.pairs, 1)))))
    print(
        f"{s}\n{theta.size} parameters; compiling {time.perf_counter() - begun:.0f} s", flush=True
    )
    learned, seconds = by_gradient(s, theta, slope)
    found = {
        "none": (theta, 0), "gradient": (learned, s.updates),
        "evolution": by_evolution(s, theta, losses, seconds),
        "random": by_random_search(s, theta, losses, seconds),
    }  # fmt: skip
    table: dict[str, dict[str, float]] = {}
    for name, (params, count) in found.items():
        here, there = (simulated(params, tasks) for tasks in (known, unseen))
        off = 1e3 * np.abs(np.asarray(there.states[:, -1, 0] - unseen["goal"]))
        table[name] = {
            "loss, known": float(loss_of(here, known)),
            "loss, unseen": float(loss_of(there, unseen)),
            "median mrad": float(np.median(off)), "worst mrad": float(off.max()),
            "kept %": 100 * float(np.mean(np.asarray(there.violation).max(axis=1) <= 1e-3)),
            "settings": count,
        }  # fmt: skip
    print(f"{seconds:.1f} s each; settings: gradients, or losses, of all {s.tasks} tasks\n")
    print(f"{'':10}" + "".join(f"{title:>14}" for title in table["none"]))
    for name, row in table.items():
        print(f"{name:10}" + "".join(f"{value:14.4g}" for value in row.values()))
    return table


if __name__ == "__main__":
    run(tyro.cli(Settings))
