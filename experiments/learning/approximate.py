"""Approximate MPC: a network in the place of the solver, and for which states it is proved.

C is the largest set in which some input u with |u| ≤ limit − e keeps all states within their limits
for ever, whatever is added to the input that is no larger than e (`maximal_control_invariant_set`
with the disturbance B w, |w| ≤ e). The expert is an MPC on C: its input is at most limit − e, and
its first state lies so deep in C that an error e of the input leads nowhere else. So a network
within e of the expert keeps all limits for ever, without a plan (Hertneck et al. 2018, IEEE Control
Systems Letters 2, arXiv:1806.04167), and one that is further off may. What has to hold at a state x
of C is, exactly:

    |u(x)| ≤ limit    and    A x + B u(x) ∈ C,    u(x) what the network gives, clipped to ± limit.

The data are uniform samples of C, each proved feasible (`sample_feasible_set`), with the expert's
inputs from `solve_many`; the network has ReLU layers. Then, for the share of C where this holds:

sampled     it is decided at new uniform states; a bound on the share holds with 99.9 % confidence
            (Clopper & Pearson 1934).
proved      by `jm.explicit.prove_network`: C is cut into simplices, halved until the condition is
            proved for all states of one, refuted for all of them, or the number of cells ends.

"filtered" is the network with its input moved into the interval of inputs that lead into C, which
keeps all limits from every state of C. Printed last: closed loops from new states of C, their
cost beside the expert's, and the time of one input.

    python experiments/learning/approximate.py
    python experiments/learning/approximate.py --plant masses --plans 1000000 --updates 40000
"""

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array
from scipy.linalg import expm
from scipy.stats import beta

import jaxmpc as jm
from jaxmpc.mpc.condense import condense


@dataclass(frozen=True)
class Settings:
    """plant: "joint" (2 states) or "masses" (4). errors: e, each with its own set C, expert and
    network; 0: no room for errors. plans: to learn from. hidden: units of both hidden layers.
    updates, rate, batch: of Adam. penalty: in its loss, on next states near the boundary of C.
    judged: new states. cells: simplices that are looked at, at most. loops, steps: closed loops and
    their length. timed: states that DAQP solves, if it is installed."""

    plant: str = "joint"
    errors: tuple[float, ...] = (0.0, 0.05)
    horizon: int = 15
    plans: int = 100_000
    hidden: int = 24
    updates: int = 20_000
    rate: float = 3e-3
    batch: int = 512
    penalty: float = 10.0
    judged: int = 100_000
    cells: int = 300_000
    loops: int = 1000
    steps: int = 100
    timed: int = 500
    seed: int = 0


CONFIDENCE = 0.999
LIMIT = 1.0  # of the input

# One (W, b) a layer: W (units, inputs of the layer), b (units,).
Network = list[tuple[Array, Array]]


class Task(NamedTuple):
    """The plant, C, and the expert on it."""

    system: jm.LinearSystem
    body: jm.Polytope
    expert: jm.MPC


def plant(name: str) -> jm.LinearSystem:
    """Return a joint, x = (angle, speed), or two masses with a spring between them, the first of
    them pushed, x = (positions, speeds)."""
    if name == "joint":
        return jm.LinearSystem([[1, 0.1], [0, 1]], [[0.005], [0.1]], dt=0.1)
    if name != "masses":
        raise ValueError(f"plant: {name!r}. Give 'joint' or 'masses'.")
    rates = np.zeros((5, 5))
    rates[:2, 2:4], rates[2:4, :2], rates[2, 4] = np.eye(2), [[-1, 1], [1, -1]], 1.0
    found = expm(0.5 * rates)
    return jm.LinearSystem(found[:4, :4], found[:4, 4:], dt=0.5)


def task(s: Settings, error: float) -> Task:
    """Return C for errors of the input up to `error`, and the expert."""
    system = plant(s.plant)
    n, B = system.n, np.asarray(system.B)
    limits = jm.Box(-np.ones(n), np.ones(n))
    inputs, wrong = jm.Box([error - LIMIT], [LIMIT - error]), jm.Box([-error], [error])
    body = jm.sets.maximal_control_invariant_set(
        system, limits, inputs,
        disturbance=wrong if error else None, disturbance_matrix=B if error else None,
    )  # fmt: skip
    assert body.exact, "its feasible set is C only where C is the largest one"
    print(f"C: {len(body.h)} half-spaces, volume {body.volume():.4f}; {body.reason.split(';')[0]}")
    # The first state that an input moves lies so deep in C that the error leads nowhere else.
    H, h = (np.asarray(part) for part in (body.H, body.h))
    deep = jm.mpc.Outputs(H, upper=h - error * np.abs(H @ B).sum(axis=1), stages=(1,))
    Q, R = np.eye(n), np.eye(1)
    expert = jm.MPC(
        system, Q, R, s.horizon, states=limits, inputs=inputs, outputs=deep,
        terminal_cost=np.asarray(jm.lqr(system, Q, R).P),
    )  # fmt: skip
    return Task(system, jm.Polytope(H, h), expert)


def network_input(network: Network, x: Any) -> Array:
    """Return the inputs (..., m) at the states x (..., n)."""
    for W, b in network[:-1]:
        x = jax.nn.relu(x @ W.T + b)
    W, b = network[-1]
    return jnp.clip(x @ W.T + b, -LIMIT, LIMIT)


def train(s: Settings, task: Task, x: np.ndarray, u: np.ndarray, error: float) -> Network:
    """Fit a network to inputs u (K, m) at states x (K, n), in float32, and return it in float64.

    The loss is the mean of (u(x) − u)², and of `penalty` times the square of what the next state
    has less than half of the expert's distance from the half-spaces of C.
    """
    random = np.random.default_rng(s.seed)
    sizes = [x.shape[1], s.hidden, s.hidden, u.shape[1]]
    start = [
        (np.sqrt(2 / a) * random.normal(size=(b, a)), np.zeros(b))
        for a, b in zip(sizes[:-1], sizes[1:], strict=True)
    ]
    H, h = (np.asarray(part) for part in (task.body.H, task.body.h))
    of_x, of_u = H @ np.asarray(task.system.A), H @ np.asarray(task.system.B)
    room = h - error / 2 * np.abs(of_u).sum(axis=1)
    of_x, of_u, room = (jnp.asarray(v, jnp.float32) for v in (of_x, of_u, room))
    rule = optax.adam(optax.cosine_decay_schedule(s.rate, s.updates))
    data = jnp.asarray(x, jnp.float32), jnp.asarray(u, jnp.float32)

    def loss(network: Network, x: Array, u: Array) -> Array:
        given = network_input(network, x)
        missing = jax.nn.relu((x @ of_x.T + given @ of_u.T) - room)
        return jnp.mean((given - u) ** 2) + s.penalty * jnp.mean(jnp.max(missing, axis=1) ** 2)

    def update(carry: Any, key: Array) -> tuple[Any, Array]:
        network, state = carry
        rows = jax.random.randint(key, (s.batch,), 0, len(x))
        value, slope = jax.value_and_grad(loss)(network, data[0][rows], data[1][rows])
        change, state = rule.update(slope, state)
        return (optax.apply_updates(network, change), state), value

    network = jax.tree.map(lambda v: jnp.asarray(v, jnp.float32), start)
    keys = jax.random.split(jax.random.key(s.seed), s.updates)
    (network, _), _ = jax.jit(lambda carry: jax.lax.scan(update, carry, keys))(
        (network, rule.init(network))
    )
    return jax.tree.map(lambda v: v.astype(jnp.float64), network)


def input_range(task: Task, x: Array) -> tuple[Array, Array]:
    """Return the least and the largest input at x (n,) that leads into C, for one input."""
    H, h = (jnp.asarray(part) for part in (task.body.H, task.body.h))
    slope, room = H @ task.system.B[:, 0], h - H @ (task.system.A @ x)
    ends = room / jnp.where(slope == 0, 1.0, slope)
    upper = jnp.min(jnp.where(slope > 0, ends, LIMIT))
    lower = jnp.max(jnp.where(slope < 0, ends, -LIMIT))
    return jnp.maximum(lower, -LIMIT)[None], jnp.minimum(upper, LIMIT)[None]


def excess(task: Task, x: Array, u: Array) -> Array:
    """Return by how much the next state lies beyond the worst half-space of C; ≤ 0: in C."""
    H, h = (jnp.asarray(part) for part in (task.body.H, task.body.h))
    return jnp.max(H @ (task.system.A @ x + task.system.B @ u) - h)


def sampled_share(kept: np.ndarray) -> tuple[float, float]:
    """Return the share of states (K,) that keep the condition, and the number that the share of C
    exceeds with confidence `CONFIDENCE`."""
    count, total = int(kept.sum()), len(kept)
    least = beta.ppf(1 - CONFIDENCE, count, total - count + 1) if count else 0.0
    return count / total, float(least)


def closed_loops(s: Settings, task: Task, network: Network, x: np.ndarray) -> None:
    """Print how loops from the states x end under the network, filtered, and the expert."""
    controller = jm.Controller(task.expert)

    def filtered(x: Array) -> Array:
        return jnp.clip(network_input(network, x), *input_range(task, x))

    laws = {
        "network": lambda x: network_input(network, x),
        "filtered": filtered,
        "expert": lambda x: controller(x).u,
    }
    expert_cost = None
    for name in reversed(laws):
        law = laws[name]

        def step(x: Array, _: None, law: Any = law) -> tuple[Array, tuple[Array, Array]]:
            u = law(x)
            return task.system.step(x, u), (jnp.sum(x**2) + jnp.sum(u**2), jnp.max(jnp.abs(x)))

        loop = lambda x, step=step: jax.lax.scan(step, x, length=s.steps)[1]
        cost, largest = (np.asarray(v) for v in jax.jit(jax.vmap(loop))(x))
        cost, beyond = cost.sum(axis=1), largest.max(axis=1) - 1
        expert_cost = cost if expert_cost is None else expert_cost
        ratio = np.mean(cost) / np.mean(expert_cost)
        print(
            f"  loops, {name:9} within limits {np.mean(beyond <= 1e-6):8.2%}, "
            f"most beyond {max(beyond.max(), 0):7.1e}, cost {ratio:7.4f} of the expert's"
        )


def seconds(call: Any, rounds: int = 5) -> float:
    """Return the least time of a call, after one that compiles."""
    jax.block_until_ready(call())
    found = []
    for _ in range(rounds):
        begun = time.perf_counter()
        jax.block_until_ready(call())
        found.append(time.perf_counter() - begun)
    return min(found)


def print_times(s: Settings, task: Task, network: Network, x: np.ndarray) -> None:
    """Print the time of an input by the network, `solve_many` and DAQP, on states of C."""
    law = jax.jit(lambda x: network_input(network, x))
    points = jnp.asarray(x)
    print(f"  µs a state: network {1e6 * seconds(lambda: law(points)) / len(x):.3f}", end="")
    controller = jm.Controller(task.expert)
    many = seconds(lambda: jm.solve_many(controller, x).inputs, 2)
    print(f", solve_many {1e6 * many / len(x):.2f}", end="")
    one = jax.jit(lambda x: controller(x).u)
    alone = [seconds(lambda f=f: f(points[0]), 200) for f in (law, one)]
    print(f"; one state alone: {1e6 * alone[0]:.0f} and {1e6 * alone[1]:.0f}", end="")
    try:
        import daqp
    except ImportError as error:
        print(f"; DAQP left out ({error})")
        return
    c = jax.tree.map(np.asarray, condense(task.expert))
    chosen = x[: s.timed]
    q, shift = chosen @ c.F.T + c.f, chosen @ c.D.T + c.d
    lower, upper = np.maximum(c.lower - shift, -1e30), np.minimum(c.upper - shift, 1e30)
    model, sense = daqp.Model(), np.zeros(c.C.shape[0], np.int32)
    model.setup(np.array(c.P), q[0], np.array(c.C), upper[0], lower[0], sense)
    begun = time.perf_counter()
    for i in range(len(chosen)):
        model.update(f=q[i], bupper=upper[i], blower=lower[i], sense=sense)
        model.solve()
    print(f", DAQP {1e6 * (time.perf_counter() - begun) / len(chosen):.0f}")


def learn(s: Settings, error: float) -> tuple[Task, Network, jm.explicit.NetworkProof]:
    """Make C, data and network for errors of the input up to `error`, and print what holds."""
    print(f"\ne = {error}", flush=True)
    here, begun = task(s, error), time.perf_counter()
    samples = jm.feasible.sample_feasible_set(here.expert, s.plans, seed=s.seed)
    drawn, begun = time.perf_counter() - begun, time.perf_counter()
    plans = samples.solve()
    solved, found = time.perf_counter() - begun, np.asarray(plans.solved)
    x, u = samples.states[found], np.asarray(plans.inputs)[found, 0]
    begun = time.perf_counter()
    network = jax.block_until_ready(train(s, here, x, u, error))
    trained = time.perf_counter() - begun
    print(
        f"  {len(samples.states):,} states in {drawn:.1f} s, {found.mean():.3%} of their plans "
        f"solved in {solved:.1f} s, network trained in {trained:.1f} s"
    )

    fresh = here.body.sample(s.judged, s.seed + 1)
    inputs = jax.jit(lambda x: network_input(network, x))(fresh)
    off = np.asarray(jax.jit(jax.vmap(lambda x, u: excess(here, x, u)))(fresh, inputs))
    share, least = sampled_share(off <= 0)
    optimal = np.asarray(jm.solve_many(here.expert, fresh).inputs)[:, 0]
    wrong = np.abs(np.asarray(inputs) - optimal)
    print(f"  error of the input: mean {wrong.mean():.4f}, largest {wrong.max():.4f}")
    print(f"  sampled: {share:.4%} of {s.judged:,} states, of C ≥ {least:.4%} with {CONFIDENCE:.1%}"
          f" confidence; worst {off.max():.1e} beyond C")  # fmt: skip
    begun = time.perf_counter()
    proof = jm.explicit.prove_network(
        network, here.system, here.body, jm.Box([-LIMIT], [LIMIT]), cells=s.cells
    )
    print(
        f"  proved: {proof.kept:.4%} of the volume of C; refuted {proof.broken:.4%}, undecided "
        f"{proof.undecided:.4%}; {proof.cells:,} cells, {time.perf_counter() - begun:.1f} s",
        flush=True,
    )
    closed_loops(s, here, network, fresh[: s.loops])
    print_times(s, here, network, fresh)
    return here, network, proof


def run(s: Settings) -> list[jm.explicit.NetworkProof]:
    """Learn with each room for errors."""
    print(s)
    with jax.enable_x64(True):
        return [learn(s, error)[2] for error in s.errors]


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
