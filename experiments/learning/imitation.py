"""Imitation of an MPC expert: jaxmpc beside mpc.pytorch and cvxpylayers, step by step.

The linear task of Amos et al. 2018 (NeurIPS, arXiv:1810.13400) with limits on the inputs:
n = m = 3, plans of T = 5 states x₀ … x₄ and inputs u₀ … u₄ that minimise

    Σ ½ τ'Wτ + p'τ,  τ = (x, u),  with x⁺ = A x + B u and |u| ≤ limit,

A = I + 0.2 × normal, B and p normal. The learner sees the expert's plans of 128 new normal x₀ at
each step and follows the gradient of mean (u − u*)² + mean (x − x*)² by RMSprop, rate 0.01. Tasks:

    dynamics    A and B unknown, W = I and p known
    cost        W = diag(exp θ) and p = −W r unknown, A and B known; θ starts at 1, r at 0
    both        A, B, W and p unknown

All begin at the same numbers, see the same data in the same order and compute in float64 unless
`bits` says else. Printed: the loss by step; the largest relative difference of the loss from
jaxmpc's (in float64) over all steps; median time of a step (wall, and of all processors of the
process), of steps after the first; the time of the first step, with compiling and all else that is
done once, imports apart; that of all steps; and after how many steps jaxmpc has caught up with the
rival, as these times say. Rivals are left out where they are not installed.

    python experiments/learning/imitation.py
"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro

import jaxmpc as jm

SIZE, STEPS_OF_PLAN = 3, 5  # n = m, and T


@dataclass(frozen=True)
class Settings:
    """steps: of RMSprop, each with `batch` new states. limit: of every input. rate: of RMSprop.
    tasks, rivals: which to run. bits: precisions of jaxmpc. newton_steps: of jaxmpc's solver, its
    own choice if None; without any it compiles in a third of the time. programs: a folder of
    compiled programs that JAX finds again in the next run. rival_threads: of torch, whose matrices
    are small here: more threads wait for each other."""

    steps: int = 50
    batch: int = 128
    limit: float = 0.7
    rate: float = 0.01
    tasks: tuple[str, ...] = ("dynamics", "cost", "both")
    rivals: tuple[str, ...] = ("mpc.pytorch", "cvxpylayers")
    bits: tuple[int, ...] = (64, 32)
    newton_steps: int | None = None
    programs: str | None = None
    rival_threads: int = 1
    seed: int = 0


class Expert(NamedTuple):
    """A, B (3, 3) and what minimises the cost, r = −W⁻¹p (6,); its weights are 1."""

    A: np.ndarray
    B: np.ndarray
    r: np.ndarray


class Batch(NamedTuple):
    """First states x (B, 3), and the expert's states and inputs (B, 5, 3)."""

    x: np.ndarray
    states: np.ndarray
    inputs: np.ndarray


class Learned(NamedTuple):
    """The loss before each step (K,), wall and processor seconds of each (K, 2). The first step has
    all that is done once: making the layer, compiling."""

    losses: np.ndarray
    times: np.ndarray


# θ: {"A": (9,), "B": (9,)}, {"Q": (3,), "R": (3,), "r": (6,)} or both, the weights as logarithms.
Theta = dict[str, Any]
LEARNED = {"dynamics": ("A", "B"), "cost": ("Q", "R"), "both": ("A", "B", "Q", "R")}


def draw(random: np.random.Generator) -> Expert:
    """Return a random plant and target."""
    A = np.eye(SIZE) + 0.2 * random.normal(size=(SIZE, SIZE))
    return Expert(A, random.normal(size=(SIZE, SIZE)), -random.normal(size=2 * SIZE))


def problem(A: np.ndarray, B: np.ndarray, weight: float, limit: float) -> jm.MPC:
    """Return the problem whose weights are all the same. The state after the last is free."""
    W = weight * np.eye(SIZE)
    bound = np.full(SIZE, limit)
    return jm.MPC(jm.LinearSystem(A, B), W, W, STEPS_OF_PLAN, inputs=jm.Box(-bound, bound))


def lesson(s: Settings, expert: Expert, random: np.random.Generator) -> list[Batch]:
    """Return new states for each step with the expert's plans, in float64."""
    x = random.normal(size=(s.steps, s.batch, SIZE))
    with jax.enable_x64(True):
        mpc = problem(expert.A, expert.B, 1.0, s.limit)
        solve = lambda x: jm.solve(
            mpc, x, solver=jm.ADMM(200, eps=1e-9), reference=expert.r[:SIZE],
            input_reference=expert.r[SIZE:],
        )  # fmt: skip
        plans = jax.tree.map(np.asarray, jax.jit(jax.vmap(solve))(x.reshape(-1, SIZE)))
    assert plans.solved.all()
    shape = (s.steps, s.batch, STEPS_OF_PLAN, SIZE)
    states, inputs = plans.states[:, :STEPS_OF_PLAN].reshape(shape), plans.inputs.reshape(shape)
    return [Batch(*found) for found in zip(x, states, inputs, strict=True)]


def with_jaxmpc(s: Settings, expert: Expert, start: Expert, task: str) -> Iterator[Any]:
    """Yield after the set-up, then the loss of each batch sent, having stepped."""
    learn = LEARNED[task]
    known = start if "A" in learn else expert
    weight = float(np.exp(1)) if "Q" in learn else 1.0
    solver = jm.ADMM(newton_steps=s.newton_steps)
    layer = jm.tuning.MPCLayer(problem(known.A, known.B, weight, s.limit), learn, solver)

    def loss(theta: Theta, batch: Batch) -> jax.Array:
        r = theta.get("r", jnp.asarray(expert.r))
        own = {name: theta[name] for name in learn}
        law = lambda x: layer(own, x, reference=r[:SIZE], input_reference=r[SIZE:]).plan
        plans = jax.vmap(law)(batch.x)
        return jnp.mean((plans.inputs - batch.inputs) ** 2) + jnp.mean(
            (plans.states[:, :STEPS_OF_PLAN] - batch.states) ** 2
        )

    rule = optax.rmsprop(s.rate, decay=0.99, eps=1e-8, eps_in_sqrt=False)

    @jax.jit
    def update(theta: Theta, state: Any, batch: Batch) -> tuple[Any, Any, jax.Array]:
        value, slope = jax.value_and_grad(loss)(theta, batch)
        change, state = rule.update(slope, state)
        return optax.apply_updates(theta, change), state, value

    theta = layer.init() | ({"r": jnp.zeros(2 * SIZE)} if "Q" in learn else {})
    state, value = rule.init(theta), None
    while True:
        batch = yield value
        theta, state, moved = update(theta, state, batch)
        value = float(moved)


def mpc_pytorch(s: Settings, expert: Expert, task: str) -> Callable:
    """Return the plans of mpc.pytorch, with the settings of the published script."""
    import torch
    from mpc import mpc

    def plans(A: Any, B: Any, w: Any, r: Any, x: Any) -> tuple[Any, Any]:
        shape = (STEPS_OF_PLAN, s.batch)
        cost = mpc.QuadCost(
            torch.diag(w).expand(*shape, 2 * SIZE, 2 * SIZE), (-w * r).expand(*shape, 2 * SIZE)
        )
        F = torch.cat((A, B), dim=1).expand(STEPS_OF_PLAN - 1, s.batch, SIZE, 2 * SIZE)
        solver = mpc.MPC(
            SIZE, SIZE, STEPS_OF_PLAN, u_lower=-s.limit, u_upper=s.limit, n_batch=s.batch,
            lqr_iter=100, verbose=-1, exit_unconverged=False, detach_unconverged=False,
        )  # fmt: skip
        states, inputs, _ = solver(x, cost, mpc.LinDx(F, None))
        return states.transpose(0, 1), inputs.transpose(0, 1)

    return plans


def cvxpylayers(s: Settings, expert: Expert, task: str) -> Callable:
    """Return the plans of cvxpylayers (diffcp, Clarabel); what is known is constant."""
    import cvxpy as cp
    import torch
    from cvxpylayers.torch import CvxpyLayer

    X, U = cp.Variable((STEPS_OF_PLAN, SIZE)), cp.Variable((STEPS_OF_PLAN, SIZE))
    x_0, root, aim = cp.Parameter(SIZE), cp.Parameter(2 * SIZE), cp.Parameter(2 * SIZE)
    A, B = cp.Parameter((SIZE, SIZE)), cp.Parameter((SIZE, SIZE))
    learn_model, learn_cost = "A" in LEARNED[task], "Q" in LEARNED[task]
    model = (A, B) if learn_model else (expert.A, expert.B)
    W, offset = (root, aim) if learn_cost else (np.ones(2 * SIZE), expert.r)
    rows = [X[0] == x_0, cp.abs(U) <= s.limit]
    rows += [X[k + 1] == model[0] @ X[k] + model[1] @ U[k] for k in range(STEPS_OF_PLAN - 1)]
    cost = sum(
        cp.sum_squares(cp.multiply(W, cp.hstack([X[k], U[k]])) - offset)
        for k in range(STEPS_OF_PLAN)
    )
    parameters = [A, B] * learn_model + [root, aim] * learn_cost + [x_0]
    layer = CvxpyLayer(cp.Problem(cp.Minimize(cost), rows), parameters, [X, U])

    def plans(A: Any, B: Any, w: Any, r: Any, x: Any) -> tuple[Any, Any]:
        model = (A, B) if learn_model else ()
        cost = (torch.sqrt(w), torch.sqrt(w) * r) if learn_cost else ()
        return layer(*model, *cost, x, solver_args={"solve_method": "Clarabel"})

    return plans


RIVALS = {"mpc.pytorch": mpc_pytorch, "cvxpylayers": cvxpylayers}


def with_torch(
    s: Settings, expert: Expert, start: Expert, task: str, rival: Callable
) -> Iterator[Any]:
    """The same as `with_jaxmpc`, with the plans of a rival."""
    import torch

    torch.set_num_threads(s.rival_threads)
    tensor = lambda v: torch.tensor(np.asarray(v), dtype=torch.float64)
    plans = rival(s, expert, task)
    first = {}
    if "A" in LEARNED[task]:
        first |= {"A": start.A.ravel(), "B": start.B.ravel()}
    if "Q" in LEARNED[task]:
        first |= {"Q": np.ones(SIZE), "R": np.ones(SIZE), "r": np.zeros(2 * SIZE)}
    theta = {name: tensor(v).requires_grad_() for name, v in first.items()}
    rule, value = torch.optim.RMSprop(theta.values(), lr=s.rate, alpha=0.99, eps=1e-8), None
    while True:
        x, states, inputs = map(tensor, (yield value))
        square = (SIZE, SIZE)
        A, B = (
            theta[name].reshape(square) if name in theta else tensor(getattr(expert, name))
            for name in ("A", "B")
        )
        w = torch.cat((theta["Q"], theta["R"])).exp() if "Q" in theta else tensor(np.ones(2 * SIZE))
        found = plans(A, B, w, theta.get("r", tensor(expert.r)), x)
        loss = torch.mean((found[1] - inputs) ** 2) + torch.mean((found[0] - states) ** 2)
        rule.zero_grad()
        loss.backward()
        rule.step()
        value = loss.item()


def learn(make: Callable[[], Iterator[Any]], batches: list[Batch]) -> Learned:
    """Send all batches and take the times; the set-up counts with the first step."""
    losses, times = [], []
    begun, busy = time.perf_counter(), time.process_time()
    learner: Any = make()
    next(learner)
    for batch in batches:
        losses.append(learner.send(batch))
        now, used = time.perf_counter(), time.process_time()
        times.append((now - begun, used - busy))
        begun, busy = now, used
    return Learned(np.array(losses), np.array(times))


def line(name: str, found: Learned, ours: Learned) -> None:
    """Print the row of one of them."""
    apart = np.max(np.abs(found.losses / ours.losses - 1))
    (wall, cpu), (our_wall, our_cpu) = (np.median(v.times[1:], axis=0) for v in (found, ours))
    once = [v.times[0, 0] for v in (ours, found)]
    even = f"{(once[0] - once[1]) / (wall - our_wall):9.0f}" if name in RIVALS else ""
    all_wall, all_cpu = found.times.sum(axis=0)
    print(
        f"{name:18}{apart:10.1e}{1e3 * wall:11.2f}{wall / our_wall:8.1f}{1e3 * cpu:11.2f}"
        f"{cpu / our_cpu:8.1f}{found.times[0, 0]:9.2f}{all_wall:9.2f}{all_cpu:9.2f}{even}",
        flush=True,
    )


def report(s: Settings, task: str) -> dict[str, Learned]:
    """Learn one task by all; print the tables."""
    random = np.random.default_rng(s.seed)
    expert, start = draw(random), draw(random)
    batches = lesson(s, expert, random)
    at = np.mean([np.abs(b.inputs) > s.limit - 1e-6 for b in batches])
    print(f"\n{task} unknown; {at:.0%} of the expert's inputs are at a limit")
    found = {}
    for bits in s.bits:
        with jax.enable_x64(bits == 64):
            found[f"jaxmpc, float{bits}"] = learn(
                lambda: with_jaxmpc(s, expert, start, task), batches
            )
    for name in s.rivals:
        try:
            RIVALS[name](s, expert, task)  # imports are no part of the times
        except ImportError as error:
            print(f"{name}: left out ({error})")
            continue
        rival = lambda name=name: with_torch(s, expert, start, task, RIVALS[name])
        found[name] = learn(rival, batches)
    shown = sorted({0, 1, 4, 9, 24, s.steps - 1} & set(range(s.steps)))
    print(f"{'loss at step':18}" + "".join(f"{k + 1:>12}" for k in shown))
    for name, learned in found.items():
        print(f"{name:18}" + "".join(f"{learned.losses[k]:12.6f}" for k in shown))
    print(
        f"\n{'':18}{'apart':>10}{'step ms':>11}{'ratio':>8}{'cpu ms':>11}{'ratio':>8}{'first s':>9}"
        f"{'all s':>9}{'cpu s':>9}{'even at':>9}"
    )
    ours = next(iter(found.values()))
    for name, learned in found.items():
        line(name, learned, ours)
    return found


def run(s: Settings) -> dict[str, dict[str, Learned]]:
    """Learn each task by all."""
    print(s)
    if s.programs:
        jax.config.update("jax_compilation_cache_dir", s.programs)
    return {task: report(s, task) for task in s.tasks}


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
