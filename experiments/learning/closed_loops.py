"""Closed-loop tuning as others published it: DiffTune-MPC's two examples and BP-MPC's swing-up.

Each is restated from the authors' scripts: plant, MPC, loss, first weights. The derivative of the
loss goes through plant, plans and, where a plan is made about the one before, through that too.

    integrator   DiffTune-MPC (Tao et al. 2024, arXiv:2312.11384), first example: a mass with
                 friction, |u| ≤ 1, 1,000 samples of 0.01 s, follows t + 1 − cos t; N = 20; the loss
                 is the sum of squared errors of the position; learned: Q (2) and R
    wheels       its second: a robot on two wheels (0.5 m apart, 0.1 m radius, ±2π rad/s each), 200
                 samples of 0.05 s, follows (1 − cos t/2, t/2); N = 10, one QP a sample about the
                 last plan; the loss is that of both positions; learned: Q (3) and R (2)
    swing-up     BP-MPC (Zuliani, Balta, Lygeros 2023, arXiv:2312.15521): a pendulum on a cart from
                 hanging to upright in 170 samples of 0.015 s, |u| ≤ 4 N; N = 11, one QP a sample
                 about the last plan; the loss is the sum of x'Qx + u'Ru over the loop, with the Q
                 of the MPC; learned: the terminal cost (10 numbers) and R

In the first two stage costs are weighed by the sampling time and the terminal cost is that of x_N
with weights 1, which is not learned, as in the scripts. Limits of the swing-up's cart, 5 m and
5 m/s, are soft (15 a unit, and 5 a unit squared).

Two rules each: "theirs", steps against the gradient as published (integrator and wheels: rate 0.01,
weights kept between 0.01 and 100 or 1,000; swing-up: 1e-4 log(k + 1)/(k + 1)^0.51), and "Adam" on
the logarithms of the weights. Printed: the loss by step; the time of a step, loss and gradient, and
of the first one with compiling; the largest difference of the gradient from central differences of
the loss, relative to its largest entry; and the share of samples with a solved plan under the best
weights. Beside them, where they are installed: cvxpylayers on the integrator (seconds of one step,
loss and gradient), and for the swing-up the least loss of all trajectories, by CasADi and IPOPT
from the tuned one.

    python experiments/learning/closed_loops.py
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array

import jaxmpc as jm
from jaxmpc.mpc import NonlinearMPC, solve_nonlinear


@dataclass(frozen=True)
class Settings:
    """tasks: which to run. updates: of each rule. rate: of Adam. cvxpylayers: samples of its loop,
    from which the time of one step is scaled, 0 for none."""

    tasks: tuple[str, ...] = ("integrator", "wheels", "swing-up")
    updates: int = 20
    rate: float = 0.2
    cvxpylayers: int = 50


@dataclass(frozen=True)
class Loop:
    """What `run` of the parameters θ (p,) gives: the states (T + 1, n), inputs (T, m) and which
    plans are solved (T,); `loss` of states and inputs.

    step: of the published rule, (k, gradient) -> change of θ, and its limits of θ. logarithms:
    which θ are weights, of which Adam moves the logarithm."""

    theta: np.ndarray
    run: Callable[[Array], tuple[Array, Array, Array]]
    loss: Callable[[Array, Array], Array]
    step: Callable[[int, np.ndarray], np.ndarray]
    limits: tuple[float, float]
    logarithms: np.ndarray


def integrator() -> Loop:
    """Return the first example of DiffTune-MPC."""
    dt, N, T = 0.01, 20, 1000
    model = jm.LinearSystem.from_continuous([[0, 1], [0, -0.05]], [[0], [1]], dt=dt)
    limits = {"states": jm.Box([-100, -100], [100, 100]), "inputs": jm.Box(-1, 1)}
    mpc = jm.MPC(model, dt * np.eye(2), dt * np.eye(1), N, terminal_cost=np.eye(2), **limits)
    t = dt * np.arange(T + N + 1)
    target = np.stack([t + 1 - np.cos(t), 1 + np.sin(t)], axis=1)
    # Their plans see the target of the sample after each state's.
    ahead = np.concatenate([target[1:], target[-1:]])[: T + N]

    def run(theta: Array) -> tuple[Array, Array, Array]:
        weighed = replace(mpc, Q=dt * jnp.diag(theta[:2]), R=dt * jnp.diag(theta[2:]))
        found = jm.simulate(jm.Controller(weighed), model, np.zeros(2), T, reference=ahead)
        return found.states, found.inputs, found.status == jm.Status.SOLVED

    loss = lambda x, u: jnp.sum((x[:, 0] - target[: T + 1, 0]) ** 2)
    descent = lambda k, gradient: -0.01 * gradient
    return Loop(np.ones(3), run, loss, descent, (0.01, 100.0), np.ones(3, bool))


def rk4(rate: Callable, h: float, x: Any, u: Any) -> Any:
    """Return x after h seconds, by the classical Runge-Kutta method."""
    k1 = rate(x, u)
    k2 = rate(x + h / 2 * k1, u)
    k3 = rate(x + h / 2 * k2, u)
    k4 = rate(x + h * k3, u)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def real_time(
    problem: NonlinearMPC, x0: Array, targets: Array, u0: Array
) -> tuple[Array, Array, Array]:
    """Return the states, inputs and solved plans of the loop of one QP a sample: about x0 and u0 at
    first, then about the last plan shifted by a step. targets (T, N + 1, n)."""
    step, N = problem.model.step, problem.mpc.horizon

    def sample(carry: tuple[Array, Any], target: Array) -> tuple[tuple, tuple]:
        x, about = carry
        plan = solve_nonlinear(problem, x, target, warm_start=about, iterations=1)
        u = plan.inputs[0]
        inputs = jnp.concatenate([plan.inputs[1:], plan.inputs[-1:]])
        states = jnp.concatenate([plan.states[1:], step(plan.states[-1], inputs[-1])[None]])
        after = step(x, u)
        return (after, replace(plan, states=states, inputs=inputs)), (x, u, plan.status)

    first = solve_nonlinear(problem, x0, targets[0], iterations=1)
    about = replace(
        first, states=jnp.tile(x0, (N + 1, 1)), inputs=jnp.tile(u0, (N, 1)),
        multipliers=jax.tree.map(jnp.zeros_like, first.multipliers),
    )  # fmt: skip
    (last, _), (x, u, status) = jax.lax.scan(sample, (x0, about), targets)
    return jnp.concatenate([x, last[None]]), u, status == jm.Status.SOLVED


def wheels() -> Loop:
    """Return the second example of DiffTune-MPC."""
    dt, N, T = 0.05, 10, 200
    rate = lambda x, u: jnp.stack([u[0] * jnp.cos(x[2]), u[0] * jnp.sin(x[2]), u[1]])
    model = lambda x, u: rk4(rate, dt, x, u)
    # Speeds of both wheels, v ± ½·0.5 ω, within 2π·0.1 m/s.
    speeds, most = np.array([[1, 0.25], [1, -0.25]]), 0.2 * np.pi
    inputs = jm.Polytope(np.concatenate([speeds, -speeds]), np.full(4, most))
    sizes = jm.LinearSystem(np.eye(3), np.zeros((3, 2)), dt=dt)
    mpc = jm.MPC(sizes, dt * np.eye(3), dt * np.eye(2), N, inputs=inputs, terminal_cost=np.eye(3))
    t = dt * np.arange(T + N + 2)
    target = np.stack([1 - np.cos(t / 2), t / 2, np.arctan2(0.5, 0.5 * np.sin(t / 2))], axis=1)
    ahead = target[1 + np.arange(T)[:, None] + np.arange(N + 1)]

    def run(theta: Array) -> tuple[Array, Array, Array]:
        weighed = replace(mpc, Q=dt * jnp.diag(theta[:3]), R=dt * jnp.diag(theta[3:]))
        x0 = jnp.array([0.0, 0.0, np.pi / 2])
        return real_time(NonlinearMPC(weighed, model), x0, jnp.asarray(ahead), jnp.zeros(2))

    loss = lambda x, u: jnp.sum((x[:, :2] - target[: T + 1, :2]) ** 2)
    descent = lambda k, gradient: -0.01 * gradient
    return Loop(np.ones(5), run, loss, descent, (0.01, 1000.0), np.ones(5, bool))


def pendulum(x: Any, u: Any, math: Any = jnp, stack: Any = jnp.stack) -> Any:
    """Return dx/dt of the cart (position, speed) and pendulum (angle, rate) of BP-MPC."""
    g, m, mu, J = 9.804, 0.305, 1.5492e-3, 1.47e-4
    s, c = math.sin(x[2]), math.cos(x[2])
    push, common = u[0] + mu * x[3] ** 2 * s, m * J - mu**2 * c**2
    moved = (J * push - mu**2 * g * s * c) / common
    turned = (m * mu * g * s - mu * c * push) / common
    return stack([x[1], moved, x[3], turned])


SWING = {"h": 0.015, "Q": np.diag([100.0, 1, 100, 1]), "R": 1e-6, "most": 4.0, "T": 170}
HANGING = np.array([0.0, 0, -np.pi, 0])


def swing_up() -> Loop:
    """Return the example of BP-MPC."""
    h, Q, R, N, T = SWING["h"], SWING["Q"], SWING["R"], 11, SWING["T"]
    model = lambda x, u: rk4(pendulum, h, x, u)
    A, B = jax.jacobian(model, (0, 1))(jnp.zeros(4), jnp.zeros(1))
    far = np.array([5.0, 5, np.inf, np.inf])
    sizes = jm.LinearSystem(np.eye(4), np.zeros((4, 1)), dt=h)
    most = SWING["most"]
    mpc = jm.MPC(sizes, Q, np.eye(1), N, inputs=jm.Box(-most, most), states=jm.Box(-far, far))
    mpc = jm.soften(mpc, 15.0, quadratic=5.0)
    at_rest = np.asarray(jm.lqr(jm.LinearSystem(A, B), Q, R * np.eye(1)).P)
    lower = np.tril_indices(4)

    def run(theta: Array) -> tuple[Array, Array, Array]:
        L = jnp.zeros((4, 4)).at[lower].set(theta[:10])
        weight = (theta[10] ** 2 + 1e-6) * jnp.eye(1)
        weighed = replace(mpc, R=weight, terminal_cost=L @ L.T + 0.01 * jnp.eye(4))
        goal = jnp.zeros((T, N + 1, 4))
        problem = NonlinearMPC(weighed, model)
        return real_time(problem, jnp.asarray(HANGING), goal, jnp.full(1, 0.1))

    loss = lambda x, u: jnp.sum(x * (x @ Q)) + R * jnp.sum(u**2)
    start = np.append(np.linalg.cholesky(at_rest - 0.01 * np.eye(4))[lower], 1e-3)
    descent = lambda k, gradient: -1e-4 * np.log(k + 2) / (k + 2) ** 0.51 * gradient
    return Loop(start, run, loss, descent, (-np.inf, np.inf), np.zeros(11, bool))


TASKS = {"integrator": integrator, "wheels": wheels, "swing-up": swing_up}


def tuned(loop: Loop, value: Callable, rule: str, s: Settings) -> tuple[np.ndarray, list, float]:
    """Return the best θ of a rule, the losses of all steps and the median seconds of one."""
    theta, losses, seconds = loop.theta.copy(), [], []
    into = lambda v: np.where(loop.logarithms, np.log(np.where(loop.logarithms, v, 1.0)), v)
    out = lambda v: np.where(loop.logarithms, np.exp(np.where(loop.logarithms, v, 0.0)), v)
    # Numbers that are no weights move in units of their size.
    size = np.where(loop.logarithms, 1.0, np.maximum(np.abs(theta), 0.1 * np.abs(theta).max()))
    adam = optax.adam(optax.cosine_decay_schedule(s.rate, s.updates, 0.05))
    state, best = adam.init(theta), (np.inf, theta)
    for k in range(s.updates + 1):
        begin = time.perf_counter()
        loss, gradient = jax.block_until_ready(value(jnp.asarray(theta)))
        seconds.append(time.perf_counter() - begin)
        losses.append(float(loss))
        best = min(best, (losses[-1], theta.copy()), key=lambda pair: pair[0])
        g = np.asarray(gradient)
        if rule == "theirs":
            theta = np.clip(theta + loop.step(k, g), *loop.limits)
            continue
        own = np.where(loop.logarithms, g * theta, g * size)
        move, state = adam.update(own, state)
        theta = np.clip(out(into(theta) + size * np.asarray(move)), *loop.limits)
    return best[1], losses, float(np.median(seconds))


def differences(value: Callable, theta: np.ndarray, size: float = 1e-6) -> float:
    """Return the largest difference of the gradient from central differences over steps of this
    size (in units of the numbers, 0.01 at least), relative to its largest entry."""
    gradient, found = np.asarray(value(jnp.asarray(theta))[1]), []
    for i, number in enumerate(theta):
        step = np.zeros_like(theta)
        step[i] = size * max(abs(number), 1e-2)
        ahead, behind = (float(value(jnp.asarray(theta + v))[0]) for v in (step, -step))
        found.append((ahead - behind) / (2 * step[i]))
    return float(np.abs(gradient - found).max() / np.abs(gradient).max())


def by_cvxpylayers(samples: int) -> tuple[float, float]:
    """Return the seconds of loss and gradient of the integrator by cvxpylayers (its JAX interface,
    after a first call), from those of a loop of so many samples, and the largest relative
    difference of that gradient from jaxmpc's."""
    import cvxpy as cp
    from cvxpylayers.jax import CvxpyLayer

    dt, N = 0.01, 20
    model = jm.LinearSystem.from_continuous([[0, 1], [0, -0.05]], [[0], [1]], dt=dt)
    A, B = np.asarray(model.A), np.asarray(model.B)
    x, u = cp.Variable((N + 1, 2)), cp.Variable((N, 1))
    start, goal, root = cp.Parameter(2), cp.Parameter((N + 1, 2)), cp.Parameter(3)
    of_goal = cp.Parameter((N, 2))  # root times goal: products of parameters are not allowed
    J = cp.sum_squares(x[N] - goal[N]) + dt * cp.sum_squares(root[2] * u)
    J += sum(dt * cp.sum_squares(cp.multiply(root[:2], x[k]) - of_goal[k]) for k in range(N))
    rows = [x[0] == start, cp.abs(u) <= 1, x[1:] == x[:-1] @ A.T + u @ B.T]
    layer = CvxpyLayer(cp.Problem(cp.Minimize(J), rows), [start, goal, root, of_goal], [u])
    t = 1.5 + dt * np.arange(samples + N + 2)  # before, the input is at its limit
    target = np.stack([t + 1 - np.cos(t), 1 + np.sin(t)], axis=1)
    first = 0.9 * target[0]

    def by_layer(theta: Array) -> Array:
        state, loss = jnp.asarray(first), 0.0
        for k in range(samples):
            ahead, weights = target[k + 1 : k + N + 2], jnp.sqrt(theta)
            (plan,) = layer(state, ahead, weights, weights[:2] * ahead[:-1])
            loss = loss + (state[0] - target[k, 0]) ** 2
            state = A @ state + B @ plan[0]
        return loss

    def own(theta: Array) -> Array:
        limits = {"inputs": jm.Box(-1, 1), "terminal_cost": np.eye(2)}
        mpc = jm.MPC(model, dt * jnp.diag(theta[:2]), dt * jnp.diag(theta[2:]), N, **limits)
        ahead = target[1 : samples + N + 1]
        run = jm.simulate(jm.Controller(mpc), model, first, samples, reference=ahead)
        return jnp.sum((run.states[:samples, 0] - target[:samples, 0]) ** 2)

    theta = jnp.ones(3)
    jax.grad(by_layer)(theta)
    begin = time.perf_counter()
    found = jax.grad(by_layer)(theta)
    seconds = (time.perf_counter() - begin) * 1000 / samples
    exact = jax.grad(own)(theta)
    return seconds, float(jnp.abs(found - exact).max() / jnp.abs(exact).max())


def least_loss(states: np.ndarray, inputs: np.ndarray) -> float:
    """Return the least loss of all trajectories of the swing-up, by IPOPT from this one."""
    import casadi as ca

    h, Q, T, most = SWING["h"], ca.DM(SWING["Q"]), SWING["T"], SWING["most"]
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 1)
    rate = lambda x, u: pendulum(ca.vertsplit(x), [u], ca, lambda parts: ca.vertcat(*parts))
    step = ca.Function("step", [x, u], [rk4(rate, h, x, u)])
    opti = ca.Opti()
    X, U = opti.variable(4, T + 1), opti.variable(1, T)
    opti.subject_to(X[:, 0] == ca.DM(HANGING))
    for k in range(T):
        opti.subject_to(X[:, k + 1] == step(X[:, k], U[:, k]))
    opti.subject_to(opti.bounded(-most, U, most))
    opti.subject_to(opti.bounded(-5, X[:2, :], 5))
    opti.minimize(ca.sumsqr(ca.chol(Q) @ X) + SWING["R"] * ca.sumsqr(U))
    opti.set_initial(X, states.T)
    opti.set_initial(U, inputs.T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "max_iter": 2000})
    return float(opti.solve().value(opti.f))


def tune(name: str, s: Settings) -> None:
    """Print the results of one task."""
    loop = TASKS[name]()

    def both(theta: Array) -> Array:
        states, inputs, _ = loop.run(theta)
        return loop.loss(states, inputs)

    value, run = jax.jit(jax.value_and_grad(both)), jax.jit(loop.run)
    begin = time.perf_counter()
    jax.block_until_ready(value(jnp.asarray(loop.theta)))
    first = time.perf_counter() - begin
    off = differences(value, loop.theta)
    print(f"{name}: first call {first:.1f} s, gradient within {off:.0e} of central differences")
    bests = {}
    for rule in ("theirs", "Adam"):
        theta, losses, seconds = tuned(loop, value, rule, s)
        bests[rule] = min(losses), theta
        shown = sorted({*range(0, s.updates, max(1, s.updates // 5)), s.updates})
        listed = ", ".join(f"{k}: {losses[k]:.5g}" for k in shown)
        _, _, solved = run(jnp.asarray(theta))
        change = 100 * (min(losses) / losses[0] - 1)
        print(f"    {rule:7} loss by step {listed}; best {min(losses):.5g} ({change:+.1f} %)")
        share = 100 * np.mean(solved)
        print(f"            {1e3 * seconds:.0f} ms a step; plans solved at the best {share:.1f} %")
    loss, theta = min(bests.values(), key=lambda pair: pair[0])
    print("    learned:", np.array2string(theta, precision=4, max_line_width=200))
    found = partial(print, "   ")
    try:
        if name == "integrator" and s.cvxpylayers:
            seconds, off = by_cvxpylayers(s.cvxpylayers)
            found(f"cvxpylayers: {seconds:.1f} s a step, gradients within {off:.0e} of each other")
        if name == "swing-up":
            states, inputs, _ = run(jnp.asarray(theta))
            least = least_loss(np.asarray(states), np.asarray(inputs))
            found(f"least loss of all trajectories (IPOPT): {least:.6g}, tuned {loss:.6g}")
    except ImportError as error:
        found(f"not compared: {error}")


def main(s: Settings) -> None:
    """Tune each task."""
    with jax.enable_x64(True):
        for name in s.tasks:
            tune(name, s)


if __name__ == "__main__":
    main(tyro.cli(Settings))
