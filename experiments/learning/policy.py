"""MPC as the policy of reinforcement learning: swing a pole up on a cart, by PPO.

The task is the cart-pole of leap-c (its example `cartpole`, swing-up): a cart of 1 kg, a pole of
0.1 kg at 0.8 m, a force up to 80 N, 200 steps of 0.05 s by Runge and Kutta's method, the pole
hanging at rest at first (here each coordinate within ± 0.05 of that). The reward of a step is
|π − |θ|| / (10 π), 0.1 where the pole is upright, 20 at most in an episode; it ends where the cart
leaves |x| < 2.4 m. Trained are, by the same algorithm with the same settings,

    mpc    a network sees the state and gives the references of cart and pole to an MPC of 5 steps,
           whose model is the linear one at the state; its weights Q, R are learned with the
           network, through `jm.tuning.MPCLayer`, and begin at those of leap-c's example
    mlp    a network of the same size gives the force

The action is normal about what the policy gives; PPO (Schulman et al. 2017, arXiv:1707.06347) with
generalised advantages and a value network, environments in a batch, all in one program. The network
of "mpc" begins at zero references: "untuned" is that MPC. Printed: the mean return without noise of
new episodes by the number of environment steps, how many ended early, and the times.

    python experiments/learning/policy.py
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array

import jaxmpc as jm


@dataclass(frozen=True)
class Settings:
    """policies: which to train. environments, rollout: side by side, and steps of each between two
    updates; updates: how many. epochs, parts: of PPO, passes over the data and parts of a pass.
    rate: of Adam, at first. deviation: of the action at first, in units of the largest force.
    discount, trace: γ and λ. hidden: units of both hidden layers. horizon: of the MPC. judged:
    episodes of each evaluation, every `every` updates. seeds: one training each."""

    policies: tuple[str, ...] = ("mpc", "mlp")
    environments: int = 128
    rollout: int = 50
    updates: int = 80
    epochs: int = 4
    parts: int = 4
    rate: float = 1e-3
    deviation: float = 0.3
    discount: float = 0.99
    trace: float = 0.95
    hidden: int = 64
    horizon: int = 5
    judged: int = 128
    every: int = 5
    seeds: tuple[int, ...] = (0, 1)


FORCE, TRACK, LENGTH, DT = 80.0, 2.4, 200, 0.05  # N, m, steps, s
CLIP = 0.2  # of PPO
HANGING = np.array([0.0, np.pi, 0.0, 0.0])
SIZES = np.array([2.4, 1.0, 1.0, 5.0, 10.0])  # of what the networks see

Layers = list[tuple[Array, Array]]  # (W, b) of each
Params = Any  # of a policy
Mean = Callable[[Params, Array], Array]  # the action (1,) in [−1, 1] at a state (4,)


class Episode(NamedTuple):
    """State x (4,): position, angle, and their speeds; and the number of steps so far."""

    x: Array
    steps: Array


class Steps(NamedTuple):
    """States, actions in units of the force, log-densities, rewards, values, values of the states
    that follow (0 where an episode ended at a limit), and whether the episode ended."""

    x: Array
    action: Array
    density: Array
    reward: Array
    value: Array
    next_value: Array
    done: Array


def rates(x: Array, force: Array) -> Array:
    """Return the time derivative of the state."""
    M, m, l, g = 1.0, 0.1, 0.8, 9.81
    _, angle, speed, spin = x
    sin, cos = jnp.sin(angle), jnp.cos(angle)
    pull = force - m * l * sin * spin**2
    below = M + m * sin**2
    return jnp.stack([
        speed, spin, (pull + m * g * cos * sin) / below,
        (pull * cos + (M + m) * g * sin) / (l * below),
    ])  # fmt: skip


def moved(x: Array, u: Array) -> Array:
    """Return the state one step later under the force u (1,)."""
    first = rates(x, u[0])
    second = rates(x + DT / 2 * first, u[0])
    third = rates(x + DT / 2 * second, u[0])
    return x + DT / 6 * (first + 2 * second + 2 * third + rates(x + DT * third, u[0]))


def begin(key: Array) -> Episode:
    """Return the start of an episode."""
    aside = jax.random.uniform(key, (4,), minval=-0.05, maxval=0.05)
    return Episode(jnp.asarray(HANGING, jnp.float32) + aside, jnp.zeros((), int))


def step(episode: Episode, action: Array) -> tuple[Episode, Array, Array]:
    """Return the episode after an action (1,), the reward, and whether the cart left the track."""
    x = moved(episode.x, FORCE * jnp.clip(action, -1, 1))
    x = x.at[1].set(jnp.mod(x[1] + jnp.pi, 2 * jnp.pi) - jnp.pi)
    reward = (jnp.pi - jnp.abs(x[1])) / (10 * jnp.pi)
    return Episode(x, episode.steps + 1), reward, jnp.abs(x[0]) >= TRACK


def seen(x: Array) -> Array:
    """Return what networks see of a state, of size 1 or so."""
    return jnp.stack([x[0], jnp.cos(x[1]), jnp.sin(x[1]), x[2], x[3]]) / jnp.asarray(SIZES, x.dtype)


def new_network(key: Array, hidden: int, outputs: int) -> Layers:
    """Return random layers; the last one is small, so that outputs are near zero."""
    sizes = [len(SIZES), hidden, hidden, outputs]
    pairs = zip(jax.random.split(key, 3), sizes[:-1], sizes[1:], strict=True)
    layers = [(jax.random.normal(k, (b, a)) / a**0.5, jnp.zeros(b)) for k, a, b in pairs]
    layers[-1] = 0.01 * layers[-1][0], layers[-1][1]
    return layers


def network_output(layers: Layers, x: Array) -> Array:
    """Return the output of tanh layers at a state."""
    y = seen(x)
    for W, b in layers[:-1]:
        y = jnp.tanh(W @ y + b)
    W, b = layers[-1]
    return W @ y + b


def mlp_policy(s: Settings) -> tuple[Callable[[Array], Params], Mean]:
    """Return how the parameters begin, and the action."""
    return partial(new_network, hidden=s.hidden, outputs=1), network_output


def mpc_policy(s: Settings) -> tuple[Callable[[Array], Params], Mean]:
    """Return the same of the MPC: its weights are learned, its model is that at the state."""
    Q, R = np.diag([2e3, 2e3, 1e-2, 1e-2]), np.array([[0.2]])
    model = jm.LinearSystem(np.eye(4), np.ones((4, 1)), c=np.zeros(4), dt=DT)
    mpc = jm.MPC(
        model, Q, R, s.horizon, inputs=jm.Box([-FORCE], [FORCE]), terminal_cost=Q,
    )  # fmt: skip
    solver = jm.ADMM(iterations=30, newton_steps=0, eps=1e-3)
    layer = jm.tuning.MPCLayer(mpc, ("Q", "R", "A", "B", "c"), solver)
    reach = jnp.array([TRACK, np.pi])

    def start(key: Array) -> Params:
        weights = {name: layer.init()[name].astype(jnp.float32) for name in ("Q", "R")}
        return {"network": new_network(key, s.hidden, 2), "weights": weights}

    def mean(params: Params, x: Array) -> Array:
        rest = jnp.zeros(1, x.dtype)
        A, B = jax.jacfwd(moved, argnums=(0, 1))(x, rest)
        model = {"A": A.ravel(), "B": B.ravel(), "c": moved(x, rest) - A @ x}
        aim = reach * jnp.tanh(network_output(params["network"], x))
        reference = jnp.concatenate([aim, jnp.zeros(2)])
        return layer(params["weights"] | model, x, reference=reference).u / FORCE

    return start, mean


POLICIES = {"mpc": mpc_policy, "mlp": mlp_policy}


def log_density(mean: Array, log_deviation: Array, action: Array) -> Array:
    """Return the logarithm of the normal density, without its constant."""
    apart = (action - mean) / jnp.exp(log_deviation)
    return jnp.sum(-(apart**2) / 2 - log_deviation)


def roll_out(
    s: Settings, policy: Mean, params: Params, episode: Episode, key: Array
) -> tuple[Episode, Steps]:
    """Return the steps of one environment; a new episode follows where one ends."""

    def advance(episode: Episode, key: Array) -> tuple[Episode, Steps]:
        of_action, of_start = jax.random.split(key)
        x, log_deviation = episode.x, params["log_deviation"]
        mean = policy(params["policy"], x)
        action = mean + jnp.exp(log_deviation) * jax.random.normal(of_action, mean.shape)
        after, reward, left = step(episode, action)
        done = left | (after.steps >= LENGTH)
        value, next_value = (network_output(params["value"], v)[0] for v in (x, after.x))
        density = log_density(mean, log_deviation, action)
        seen = Steps(x, action, density, reward, value, jnp.where(left, 0, next_value), done)
        fresh = begin(of_start)
        return jax.tree.map(lambda a, b: jnp.where(done, a, b), fresh, after), seen

    return jax.lax.scan(advance, episode, jax.random.split(key, s.rollout))


def advantages(s: Settings, steps: Steps) -> Array:
    """Return the generalised advantages (T,) of the steps of one environment."""

    def back(later: Array, at: Steps) -> tuple[Array, Array]:
        error = at.reward + s.discount * at.next_value - at.value
        found = error + s.discount * s.trace * jnp.where(at.done, 0, later)
        return found, found

    return jax.lax.scan(back, jnp.zeros(()), steps, reverse=True)[1]


def loss(policy: Mean, params: Params, data: tuple[Steps, Array, Array]) -> Array:
    """Return PPO's loss of a part of the steps, with their advantages and returns."""
    steps, advantage, goal = data
    means = jax.vmap(policy, (None, 0))(params["policy"], steps.x)
    density = jax.vmap(log_density, (0, None, 0))(means, params["log_deviation"], steps.action)
    ratio = jnp.exp(density - steps.density)
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    value = jax.vmap(network_output, (None, 0))(params["value"], steps.x)[:, 0]
    return jnp.mean((value - goal) ** 2) / 2 - jnp.mean(gain)


def returns(policy: Mean, params: Params, keys: Array) -> tuple[Array, Array]:
    """Return the return of an episode from each key, without noise, and whether it ended early."""

    def advance(carry: Any, _: None) -> tuple[Any, Array]:
        episode, over = carry
        episode, reward, left = step(episode, policy(params, episode.x))
        return (episode, over | left), jnp.where(over, 0, reward)

    def one(key: Array) -> tuple[Array, Array]:
        (_, over), rewards = jax.lax.scan(advance, (begin(key), jnp.array(False)), length=LENGTH)
        return jnp.sum(rewards), over

    return jax.vmap(one)(keys)


class Curve(NamedTuple):
    """Environment steps, mean return and share that ended early at each evaluation (K,), and the
    seconds of compiling and of all else."""

    steps: np.ndarray
    returns: np.ndarray
    early: np.ndarray
    compiling: float
    seconds: float


def train(s: Settings, name: str, seed: int) -> tuple[Params, Curve]:
    """Return the trained policy and how it learned."""
    start, policy = POLICIES[name](s)
    keys = iter(jax.random.split(jax.random.key(seed), 4))
    params = {
        "policy": start(next(keys)), "value": new_network(next(keys), s.hidden, 1),
        "log_deviation": jnp.full(1, np.log(s.deviation)),
    }  # fmt: skip
    count = s.updates * s.epochs * s.parts
    rule = optax.chain(
        optax.clip_by_global_norm(0.5),
        optax.adam(optax.linear_schedule(s.rate, s.rate / 10, count)),
    )

    def descend(carry: Any, data: Any) -> tuple[Any, None]:
        params, state = carry
        slope = jax.grad(partial(loss, policy))(params, data)
        change, state = rule.update(slope, state)
        return (optax.apply_updates(params, change), state), None

    def update(carry: Any, key: Array) -> tuple[Any, None]:
        params, state, episodes = carry
        of_steps, of_parts = jax.random.split(key)
        each = jax.random.split(of_steps, s.environments)
        episodes, steps = jax.vmap(partial(roll_out, s, policy, params))(episodes, each)
        gain = jax.vmap(partial(advantages, s))(steps)
        flat = jax.tree.map(
            lambda v: v.reshape(-1, *v.shape[2:]), (steps, gain, gain + steps.value)
        )
        size = s.environments * s.rollout
        orders = [jax.random.permutation(k, size) for k in jax.random.split(of_parts, s.epochs)]
        parts = jnp.concatenate(orders).reshape(s.epochs * s.parts, -1)
        shuffled = jax.tree.map(lambda v: v[parts], flat)
        (params, state), _ = jax.lax.scan(descend, (params, state), shuffled)
        return (params, state, episodes), None

    judge = jax.jit(lambda params, keys: returns(policy, params["policy"], keys))
    updates = jax.jit(lambda carry, keys: jax.lax.scan(update, carry, keys)[0])
    episodes = jax.vmap(begin)(jax.random.split(next(keys), s.environments))
    carry, fresh = (params, rule.init(params), episodes), jax.random.split(next(keys), s.updates)
    judged = jax.random.split(jax.random.key(seed + 1000), s.judged)
    begun = time.perf_counter()
    judge, updates = (
        judge.lower(params, judged).compile(), updates.lower(carry, fresh[: s.every]).compile()
    )  # fmt: skip
    compiling, begun = time.perf_counter() - begun, time.perf_counter()
    found = [(0, *judge(params, judged))]
    for i in range(0, s.updates, s.every):
        carry = updates(carry, fresh[i : i + s.every])
        taken = (i + s.every) * s.rollout * s.environments
        found.append((taken, *judge(carry[0], judged)))
    steps, gained, early = (np.array(v) for v in zip(*found, strict=True))
    spent = time.perf_counter() - begun
    return carry[0], Curve(steps, gained.mean(axis=1), early.mean(axis=1), compiling, spent)


def run(s: Settings) -> dict[str, list[Curve]]:
    """Train all policies; print their curves: mean return, and the share that ended early."""
    print(s, flush=True)
    found: dict[str, list[Curve]] = {}
    for name in s.policies:
        found[name] = [train(s, name, seed)[1] for seed in s.seeds]
        for seed, curve in zip(s.seeds, found[name], strict=True):
            print(f"{name}, seed {seed}: compiling {curve.compiling:.0f} s, all else "
                  f"{curve.seconds:.0f} s, {1e6 * curve.seconds / curve.steps[-1]:.0f} µs a step",
                  flush=True)  # fmt: skip
    curves = [
        (f"{name} {k}", v) for name in found for k, v in zip(s.seeds, found[name], strict=True)
    ]
    print(f"{'steps':>8}" + "".join(f"{title:>16}" for title, _ in curves))
    for i, count in enumerate(curves[0][1].steps):
        row = "".join(f"{c.returns[i]:8.3f} {c.early[i]:7.1%}" for _, c in curves)
        print(f"{count:8}{row}")
    return found


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
