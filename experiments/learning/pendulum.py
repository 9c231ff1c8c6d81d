"""Imitation of a nonlinear MPC: the pendulum of Amos et al. 2018 (NeurIPS, arXiv:1810.13400).

The state is (cos θ, sin θ, θ'), upright at (1, 0, 0), of a rod of 1 kg and 1 m with g = 10 m/s², by
semi-implicit steps of 0.05 s; the torque is at most 2 N m, which does not lift it at once. The
expert plans 20 steps that minimise Σ w_i (x_i − r_i)² + w_u u² with w = (1, 1, 0.1), w_u = 0.001
and r = (1, 0, 0); its inputs are at their limits for much of the time. The learner sees the
expert's inputs of `batch` new states at each step, angles uniform within ±90° and speeds within
±1 rad/s, and follows the gradient of the mean of (u − u*)² through `jm.mpc.solve_nonlinear`, by
Adam, whose learning rate falls to zero. Tasks:

    dynamics    g, mass and length unknown (only g / length and mass × length² matter)
    cost        w, w_u and r unknown
    both        all of them

Printed: the loss on states unseen so far, and what was learned, by step; the share of the expert's
inputs at a limit; the time of the first step and the median of the others.

    python experiments/learning/pendulum.py
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

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, Plan, solve_nonlinear


@dataclass(frozen=True)
class Settings:
    """steps: of Adam, each with `batch` new states. rate: its learning rate at first, of logarithms
    and of r. horizon: steps of a plan. judged: unseen states. tasks: which to learn.
    rival_steps: of mpc.pytorch, on the same states, if it is installed; 0 for none."""

    steps: int = 200
    batch: int = 16
    rate: float = 0.02
    horizon: int = 20
    judged: int = 64
    tasks: tuple[str, ...] = ("dynamics", "cost", "both")
    rival_steps: int = 5
    seed: int = 0


DT, TORQUE = 0.05, 2.0
# The expert's numbers: of the rod (g, mass, length), weights of states and input, target.
EXPERT = {
    "rod": np.log([10.0, 1.0, 1.0]),
    "weights": np.log([1.0, 1.0, 0.1, 0.001]),
    "target": np.array([1.0, 0.0, 0.0]),
}
# Where the learner begins.
START = {
    "rod": np.log([8.0, 1.3, 0.9]),
    "weights": np.log([0.5, 0.5, 0.5, 0.005]),
    "target": np.array([0.5, 0.3, 0.0]),
}
LEARNED = {"dynamics": ("rod",), "cost": ("weights", "target"), "both": tuple(EXPERT)}

Theta = dict[str, Any]  # logarithms of the rod and the weights, and the target


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pendulum:
    """A rod that turns about one end: g (m/s²), mass (kg), length (m)."""

    rod: Any

    def step(self, x: Array, u: Array) -> Array:
        """Return (cos θ, sin θ, θ') one step later under the torque u (1,)."""
        g, mass, length = self.rod
        cos, sin, speed = x
        turned = 1.5 * g / length * sin + 3 * u[0] / (mass * length**2)
        speed = speed + DT * turned
        c, s = jnp.cos(DT * speed), jnp.sin(DT * speed)
        return jnp.stack([cos * c - sin * s, sin * c + cos * s, speed])


def plans(s: Settings, theta: Theta, x: Array) -> Plan:
    """Return the plans from states x (B, 3)."""
    weights = jnp.exp(theta["weights"])
    sizes = jm.LinearSystem(np.eye(3), np.zeros((3, 1)), dt=DT)  # read for sizes only
    mpc = jm.MPC(
        sizes, jnp.diag(weights[:3]), weights[3:, None], s.horizon,
        inputs=jm.Box([-TORQUE], [TORQUE]), terminal_cost=jnp.diag(weights[:3]),
    )  # fmt: skip
    problem = NonlinearMPC(mpc, Pendulum(jnp.exp(theta["rod"])))
    solve = lambda x: solve_nonlinear(problem, x, reference=theta["target"])
    return jax.vmap(solve)(x)


def draw(random: np.random.Generator, count: int) -> np.ndarray:
    """Return random states (count, 3)."""
    angle = random.uniform(-np.pi / 2, np.pi / 2, count)
    return np.stack([np.cos(angle), np.sin(angle), random.uniform(-1, 1, count)], axis=1)


def described(own: Theta) -> str:
    """Return what was learned, of the rod what matters."""
    found = []
    if "rod" in own:
        g, mass, length = np.exp(own["rod"])
        found.append(f"g/l {g / length:.4f}, m l² {mass * length**2:.4f}")
    if "weights" in own:
        weights = np.exp(own["weights"])
        found.append(f"w/w_1 {np.round(weights / weights[0], 4)}, r {np.round(own['target'], 3)}")
    return "; ".join(found)


def learn(s: Settings, task: str, plan: Callable) -> list[float]:
    """Learn one task and print how; return the losses on unseen states."""
    random = np.random.default_rng(s.seed)
    own = {name: jnp.asarray(START[name]) for name in LEARNED[task]}
    unseen, rule = draw(random, s.judged), optax.adam(optax.cosine_decay_schedule(s.rate, s.steps))
    starts = [draw(random, s.batch) for _ in range(s.steps)]
    lesson = [(x, np.asarray(plan(EXPERT, x).inputs)) for x in starts]
    goal = plan(EXPERT, unseen).inputs

    def loss(own: Theta, x: Array, inputs: Array) -> tuple[Array, Array]:
        found = plans(s, EXPERT | own, x)
        use = found.solved[:, None, None]
        return jnp.mean((found.inputs - inputs) ** 2, where=use), jnp.mean(found.solved)

    @jax.jit
    def update(own: Theta, state: Any, x: Array, inputs: Array) -> tuple[Theta, Any, Any]:
        found, slope = jax.value_and_grad(loss, has_aux=True)(own, x, inputs)
        change, state = rule.update(slope, state)
        return optax.apply_updates(own, change), state, found

    def judge(k: int) -> None:
        judged.append(float(np.mean((plan(EXPERT | own, unseen).inputs - goal) ** 2)))
        print(f"  {k:4} loss {judged[-1]:.2e}  {described(own)}", flush=True)

    judged: list[float] = []
    losses, seconds, solved, state = [], [], [], rule.init(own)
    for k, batch in enumerate(lesson):
        if k in {0, 10, 50, 100}:
            judge(k)
        begun = time.perf_counter()
        own, state, (value, part) = jax.block_until_ready(update(own, state, *batch))
        seconds.append(time.perf_counter() - begun)
        losses.append(float(value))
        solved.append(float(part))
    judge(s.steps)
    own_step = np.median(seconds[1:])
    print(f"  first step {seconds[0]:.1f} s, others {1e3 * own_step:.0f} ms; "
          f"{np.mean(solved):.1%} of the plans solved")  # fmt: skip
    if s.rival_steps:
        try:
            found, theirs = mpc_pytorch(s, task, lesson[: s.rival_steps])
        except ImportError as error:
            print(f"  mpc.pytorch: left out ({error})")
            return judged
        step = np.median(theirs)
        print(f"  mpc.pytorch: {1e3 * step:.0f} ms a step, {step / own_step:.0f} times")
        for name, values in (("jaxmpc", losses), ("mpc.pytorch", found)):
            shown = " ".join(f"{v:.6f}" for v in values[: s.rival_steps])
            print(f"  {name:12} losses of the batches {shown}", flush=True)
    return judged


def mpc_pytorch(s: Settings, task: str, lesson: list) -> tuple[list[float], list[float]]:
    """Return the losses of the first steps by mpc.pytorch, and the seconds of each.

    Its last input, which moves no state that has a cost, is the twenty-first.
    """
    import torch
    from mpc import mpc

    torch.set_num_threads(1)
    tensor = lambda v: torch.tensor(np.asarray(v), dtype=torch.float64)
    theta = {name: tensor(v) for name, v in EXPERT.items()}
    own = {name: tensor(START[name]).requires_grad_() for name in LEARNED[task]}
    rule = torch.optim.Adam(own.values(), lr=s.rate)
    fall = torch.optim.lr_scheduler.LambdaLR(rule, lambda k: (1 + np.cos(np.pi * k / s.steps)) / 2)

    class Rod(torch.nn.Module):
        """The pendulum, at (g, mass, length)."""

        def __init__(self, rod: Any) -> None:
            super().__init__()
            self.rod = rod

        def forward(self, x: Any, u: Any) -> Any:
            g, mass, length = self.rod
            cos, sin, speed = x.unbind(dim=1)
            turned = 1.5 * g / length * sin + 3 * u[:, 0] / (mass * length**2)
            speed = speed + DT * turned
            c, s = torch.cos(DT * speed), torch.sin(DT * speed)
            return torch.stack([cos * c - sin * s, sin * c + cos * s, speed], dim=1)

    losses, seconds = [], []
    for x, inputs in lesson:
        begun = time.perf_counter()
        at = theta | own
        weights, count = at["weights"].exp(), s.horizon + 1
        linear = -weights * torch.cat([at["target"], torch.zeros(1, dtype=torch.float64)])
        cost = mpc.QuadCost(
            torch.diag(weights).expand(count, len(x), 4, 4), linear.expand(count, len(x), 4)
        )
        solver = mpc.MPC(
            3, 1, count, u_lower=-TORQUE, u_upper=TORQUE, n_batch=len(x), lqr_iter=100, verbose=-1,
            grad_method=mpc.GradMethods.AUTO_DIFF, exit_unconverged=False,
            detach_unconverged=False,
        )  # fmt: skip
        _, found, _ = solver(tensor(x), cost, Rod(at["rod"].exp()))
        loss = torch.mean((found[: s.horizon].transpose(0, 1) - tensor(inputs)) ** 2)
        rule.zero_grad()
        loss.backward()
        rule.step()
        fall.step()
        losses.append(loss.item())
        seconds.append(time.perf_counter() - begun)
    return losses, seconds


def run(s: Settings) -> dict[str, list[float]]:
    """Learn each task, in float64."""
    print(s)
    losses = {}
    with jax.enable_x64(True):
        plan = jax.jit(lambda theta, x: plans(s, theta, x))
        found = plan(EXPERT, draw(np.random.default_rng(1), 256))
        at, solved = np.mean(np.abs(found.inputs) > TORQUE - 1e-6), np.mean(found.solved)
        print(f"{solved:.1%} of the expert's plans solved, {at:.0%} of its inputs at a limit")
        for task in s.tasks:
            print(f"\n{task} unknown", flush=True)
            losses[task] = learn(s, task, plan)
    return losses


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
