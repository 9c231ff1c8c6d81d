"""Feasible sets grown by gradient: how much larger, at what cost, and worth how much horizon.

    python experiments/feasible_set_growth.py                   # all parts, all plants
    python experiments/feasible_set_growth.py --parts trade --out growth

Areas are proved: inner and outer bounds of `map_feasible_set(...).refine()` before and after, on
no state that tuning has seen. Costs are those of closed loops of the exact plant under the weights
Q, R of the plant's own file, from states of the smallest set compared (so that all have a plan).

Part "terminal": weights Q_t of the terminal law alone. K_t, P_t are its LQR; the terminal set is
the largest {x'P_t x ≤ level} in which K_t keeps all limits, the terminal cost what K_t costs under
Q and R. Every Q_t gives a stable, recursively feasible controller (checked: `verify_terminal`).
Beside it longer horizons with the LQR's own ellipsoid, the LQR's maximal invariant set, and no
terminal set, which bounds what any can give.

Part "tightening": limits shrunk so that u = v + K(x − v's state) keeps them for N steps whatever
|w| ≤ w_max adds to x: by Σ_{j<N} |(A+BK)^j| w_max, and |K| times that (Chisci, Rossiter & Zappa
2001, Automatica 37(7)). w_max is what a share `push` of the largest input does in a sample. K is
the LQR's of weights Q_k: these are tuned.

Part "horizon": N is whole, but the period dt of prediction is not: the horizon lasts N dt seconds.
dt and Q_t are tuned together, dt up to twice its start. "beyond" is by how much a limit is
exceeded between samples, in shares of its half-width.

Part "trade": closed-loop cost − weight × share, by `tune_weights`, for a row of weights, starting
from the LQR's ellipsoid; picture trade.png.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax
import tyro
from jax.scipy.linalg import expm

import jaxmpc as jm
from jaxmpc.app.config import load
from jaxmpc.feasible.map import FeasibleSetMap
from jaxmpc.feasible.smooth_fraction import feasible_fraction
from jaxmpc.systems.riccati import cost_of_law
from jaxmpc.tuning.feasible_set import tune_feasible_set
from jaxmpc.tuning.losses import ClosedLoopLoss
from jaxmpc.tuning.parameters import Parameter
from jaxmpc.tuning.weights import tune_weights

HERE = Path(__file__).parent
FILES = {
    "double integrator": ("double_integrator.toml", 4),
    "pendulum": ("inverted_pendulum.toml", 10),
}


@dataclass(frozen=True)
class Settings:
    """parts: which (none: all). plants: which. updates: steps of Adam. rate: its step. states:
    sampled, a quarter of them for validation. width: of the share. loops, steps: closed loops for
    the cost, and their samples. push: size of the disturbance. weights: of the trade-off.
    tolerance: relative gap of proved areas. out: folder of pictures."""

    parts: tuple[Literal["terminal", "tightening", "horizon", "trade"], ...] = ()
    plants: tuple[Literal["joint", "double integrator", "pendulum"], ...] = (
        "joint", "double integrator", "pendulum",
    )  # fmt: skip
    updates: int = 40
    rate: float = 0.2
    states: int = 1000
    width: float = 0.02
    loops: int = 64
    steps: int = 40
    push: float = 0.2
    weights: tuple[float, ...] = (0.0, 0.3, 1.0, 3.0)
    tolerance: float = 1e-3
    seed: int = 0
    out: Path = Path("growth")


def plant(name: str) -> jm.MPC:
    """The problem without terminal set, with a horizon that does not reach everything anyway."""
    if name != "joint":
        file, N = FILES[name]
        return replace(load(HERE / file).build_mpc(), terminal_set=None, horizon=N)
    system = jm.LinearSystem(
        np.array([[1, 0.01], [0, 1]]), np.array([[0], [0.2]]), dt=0.01,
        state_names=("q", "dq"), state_units=("rad", "rad/s"),
    )  # fmt: skip
    limits = jm.Box(np.array([-1.5, -2.0]), np.array([1.5, 2.0]))
    torque = jm.Box(np.array([-2.0]), np.array([2.0]))
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    return jm.MPC(system, Q, R, horizon=20, states=limits, inputs=torque)


def with_law(mpc: jm.MPC, Q_t: Any) -> jm.MPC:
    """Terminal set and cost of the law that Q_t asks for."""
    law = jm.lqr(mpc.system, Q_t, mpc.R)
    terminal = jm.sets.invariant_ellipsoid(mpc.system, law.K, law.P, mpc.states, mpc.inputs)
    return replace(
        mpc, terminal_set=terminal, terminal_cost=cost_of_law(mpc.system, law.K, mpc.Q, mpc.R)
    )


def samples(mpc: jm.MPC, count: int, seed: int) -> np.ndarray:
    """States spread evenly over the box of the limits."""
    box = mpc.states
    return np.random.default_rng(seed).uniform(box.lower, box.upper, (count, mpc.system.n))


def area(mpc: jm.MPC, s: Settings) -> tuple[FeasibleSetMap, tuple[float, float]]:
    """The refined map, and the proved bounds of its area."""
    fmap = jm.map_feasible_set(mpc, samples(mpc, 64, s.seed + 1)).refine(s.tolerance)
    return fmap, fmap.volume_bounds()


def inside(fmap: FeasibleSetMap, count: int, seed: int) -> np.ndarray:
    """States spread evenly over the inner polytope of a map."""
    polytope = fmap.inner()
    H, h = np.asarray(polytope.H), np.asarray(polytope.h)
    corners = polytope.vertices()
    draws = np.random.default_rng(seed).uniform(corners.min(0), corners.max(0), (100 * count, 2))
    return draws[np.all(draws @ H.T <= h * 0.999, axis=1)][:count]


def cost(mpc: jm.MPC, x0s: np.ndarray, s: Settings) -> tuple[float, float]:
    """Mean Σ x'Qx + u'Ru of closed loops, and the share of plans that were not solved."""
    controller = jm.Controller(mpc, jm.ADMM(iterations=300, newton_steps=20))
    with jax.enable_x64(True):
        run = jm.simulate_many(controller, mpc.system, x0s, s.steps)
    stage = np.einsum("bti,ij,btj->bt", run.states[:, :-1], mpc.Q, run.states[:, :-1])
    stage = stage + np.einsum("bti,ij,btj->bt", run.inputs, mpc.R, run.inputs)
    return float(stage.sum(axis=1).mean()), float(np.mean(run.status != jm.Status.SOLVED))


def grow(
    make_mpc: Callable[[Any], jm.MPC], parameters: dict[str, Parameter], mpc: jm.MPC, s: Settings
) -> Any:
    """The tuning run, with what it took."""
    run = tune_feasible_set(
        make_mpc, parameters, samples(mpc, s.states, s.seed), s.width, updates=s.updates,
        optimizer=optax.adam(s.rate), seed=s.seed,
    )  # fmt: skip
    h = run.history
    share = -h.validation[[0, h.best]]
    print(f"  share of unseen states {share[0]:.3f} -> {share[1]:.3f}, best of {h.steps} steps: "
          f"{h.best}, {h.seconds:.0f} s; " + ", ".join(
              f"{name} = {np.round(v, 4).tolist()}" for name, v in run.values.items()))  # fmt: skip
    return run


def row(label: str, bounds: tuple[float, float], first: float, *rest: str) -> None:
    """One line of a table."""
    print(f"  {label:34s} {bounds[0]:10.4f} {bounds[1]:10.4f} {bounds[0] / first:8.2f} x  ",
          "  ".join(rest))  # fmt: skip


def terminal(name: str, s: Settings) -> None:
    """Terminal weights."""
    mpc = plant(name)
    before = with_law(mpc, mpc.Q)
    run = grow(lambda v: with_law(mpc, v["Q_t"]), {"Q_t": Parameter(mpc.Q, "definite")}, mpc, s)
    fmap, first = area(before, s)
    x0s = inside(fmap, s.loops, s.seed + 2)
    law = jm.lqr(mpc.system, mpc.Q, mpc.R)
    invariant = jm.maximal_invariant_set(mpc.system, law.K, mpc.states, mpc.inputs)
    rows = {f"LQR ellipsoid, N = {mpc.horizon}": before, "  tuned law": run.mpc}
    for factor in (2, 4):
        longer = replace(before, horizon=factor * mpc.horizon)
        rows[f"LQR ellipsoid, N = {longer.horizon}"] = longer
    rows["LQR maximal invariant set"] = replace(before, terminal_set=invariant)
    rows["no terminal set"] = replace(before, terminal_set=None)
    for label, problem in rows.items():
        paid, unsolved = cost(problem, x0s, s)
        row(label, area(problem, s)[1], first[0], f"cost {paid:10.4f}", f"unsolved {unsolved:.1%}")
    tuned, K = run.mpc, jm.lqr(mpc.system, run.values["Q_t"], mpc.R).K
    report = jm.sets.verify_terminal(
        mpc.system, mpc.Q, mpc.R, tuned.terminal_cost, tuned.terminal_set, mpc.states, mpc.inputs, K
    )
    print(f"  tuned: recursive feasibility {report.recursive_feasibility}, stability "
          f"{report.stability} (verify_terminal)")  # fmt: skip


def tightening(name: str, s: Settings) -> None:
    """Weights of the law that holds disturbances down."""
    mpc = plant(name)
    w_max = s.push * np.abs(mpc.system.B) @ np.asarray(mpc.inputs.upper)
    n, N = mpc.system.n, mpc.horizon

    def spread(K: Any) -> tuple[Any, Any]:
        """Σ |(A+BK)^j| w_max and Σ |K (A+BK)^j| w_max over j < N."""
        closed = jnp.asarray(mpc.system.A) + jnp.asarray(mpc.system.B) @ K
        step = lambda M, _: (closed @ M, (jnp.abs(M) @ w_max, jnp.abs(K @ M) @ w_max))
        _, (x, u) = jax.lax.scan(step, jnp.eye(n, dtype=closed.dtype), length=N)
        return x.sum(axis=0), u.sum(axis=0)

    def make_mpc(v: Any) -> jm.MPC:
        K = jm.lqr(mpc.system, v["Q_k"], mpc.R).K
        x, u = spread(K)
        shrunk = lambda box, r: jm.Box(box.lower + r, box.upper - r)
        return replace(mpc, states=shrunk(mpc.states, x), inputs=shrunk(mpc.inputs, u))

    def host(v: Any) -> jm.MPC:
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, make_mpc(v))

    start = mpc.Q + 1e-3 * np.trace(mpc.Q) * np.eye(n)
    try:
        run = grow(make_mpc, {"Q_k": Parameter(start, "definite")}, mpc, s)
        first = area(host({"Q_k": start}), s)[1]
        for label, v in (("weights of the plant", {"Q_k": start}), ("  tuned", run.values)):
            problem = host(v)
            left = np.concatenate([problem.states.upper, problem.inputs.upper])
            row(label, area(problem, s)[1], first[0], f"limits left {np.round(left, 3)}")
        row("no disturbance", area(mpc, s)[1], first[0])
    except ValueError as error:
        print(f"  {error}")


def horizon(name: str, s: Settings) -> None:
    """Length of the prediction in seconds, with the terminal weights."""
    mpc = plant(name)
    dt = mpc.system.dt
    if name == "joint":
        A, B = np.array([[0.0, 1.0], [0, 0]]), np.array([[0.0], [20.0]])
    elif name == "pendulum":
        config = load(HERE / FILES[name][0])
        A, B = np.array(config.system.A), np.array(config.system.B)
    else:
        A, B = np.array([[0.0, 1.0], [0, 0]]), np.array([[0.0], [1.0]])
    n, m = B.shape
    block = np.block([[A, B], [np.zeros((m, n + m))]])

    def sampled(dt: Any) -> tuple[Any, Any]:
        M = expm(block * dt)
        return M[:n, :n], M[:n, n:]

    def make_mpc(v: Any) -> jm.MPC:
        A, B = sampled(jnp.asarray(v["dt"]))
        return with_law(replace(mpc, system=replace(mpc.system, A=A, B=B, dt=None)), v["Q_t"])

    def host(v: Any) -> jm.MPC:
        with jax.enable_x64(True):
            A, B = (np.asarray(M) for M in sampled(jnp.asarray(float(v["dt"]))))
        return with_law(replace(mpc, system=replace(mpc.system, A=A, B=B, dt=None)), v["Q_t"])

    def beyond(problem: jm.MPC, period: float, x0s: np.ndarray) -> tuple[float, float]:
        """Largest excess between samples, and ∫ x'Qx + u'Ru dt over the same time, over dt."""
        controller = jm.Controller(problem, jm.ADMM(iterations=300, newton_steps=20))
        length = int(np.ceil(s.steps * dt / period))
        with jax.enable_x64(True):
            run = jm.simulate_many(controller, problem.system, x0s, length)
            fine = [np.asarray(M) for M in jax.vmap(sampled)(period * (jnp.arange(20) + 1) / 20)]
        x = np.einsum("fij,btj->btfi", fine[0], run.states[:, :-1])
        x = x + np.einsum("fij,btj->btfi", fine[1], run.inputs)
        most = (np.abs(x) - mpc.states.upper) / mpc.states.half_widths()
        stage = np.einsum("btfi,ij,btfj->btf", x, mpc.Q, x).mean(axis=2)
        stage = stage + np.einsum("bti,ij,btj->bt", run.inputs, mpc.R, run.inputs)
        return float(most.max()), float(stage.sum(axis=1).mean() * period / dt)

    start = {"dt": np.array(dt), "Q_t": mpc.Q}
    both = {
        "dt": Parameter(1.02 * dt, "interval", lower=dt, upper=2 * dt),
        "Q_t": Parameter(mpc.Q, "definite"),
    }
    run = grow(make_mpc, both, mpc, s)
    only = grow(make_mpc, {**both, "Q_t": replace(both["Q_t"], train=False)}, mpc, s)
    fmap, first = area(host(start), s)
    x0s = inside(fmap, s.loops, s.seed + 2)
    for label, v in (("before", start), ("  dt tuned", only.values), ("  both tuned", run.values)):
        period = float(v["dt"])
        problem = host(v)
        excess, paid = beyond(problem, period, x0s)
        row(f"{label}, horizon {mpc.horizon * period:.3g} s", area(problem, s)[1], first[0],
            f"cost {paid:10.4f}", f"beyond {excess:.4f}")  # fmt: skip
    for factor in (2, 4):
        longer = replace(host(start), horizon=factor * mpc.horizon)
        row(f"N = {longer.horizon}, horizon {longer.horizon * dt:.3g} s", area(longer, s)[1],
            first[0])  # fmt: skip


def trade(name: str, s: Settings) -> None:
    """Area against closed-loop cost."""
    mpc = replace(plant(name), horizon=max(3, plant(name).horizon // 4))
    points = samples(mpc, s.states, s.seed)
    before = with_law(mpc, mpc.Q)
    fmap, first = area(before, s)
    x0s, unseen = inside(fmap, s.loops, s.seed + 2), inside(fmap, s.loops, s.seed + 3)
    loss = ClosedLoopLoss(mpc.Q, mpc.R, limits=mpc.states)
    base = cost(before, unseen, s)[0]
    found = [("start", fmap, first, base, 0.0)]
    print(f"  N = {mpc.horizon}; losses in units of the start's mean cost a sample")
    with jax.enable_x64(True):
        for weight in s.weights:
            scale = weight * base / s.steps
            run = tune_weights(
                lambda v: with_law(mpc, v["Q_t"]), {"Q_t": Parameter(mpc.Q, "definite")},
                mpc.system, x0s, loss, s.steps,
                solver=jm.ADMM(iterations=50, newton_steps=5), optimizer=optax.adam(s.rate),
                updates=s.updates, batch=16, seed=s.seed, mode="forward",
                design_loss=lambda made, k=scale: -k * feasible_fraction(made, points, s.width),
            )  # fmt: skip
            print(f"  weight {weight:g}: {run.history.seconds:.0f} s, best {run.history.best}",
                  flush=True)  # fmt: skip
            grown, bounds = area(run.mpc, s)
            paid, unsolved = cost(run.mpc, unseen, s)
            found.append((f"weight {weight:g}", grown, bounds, paid, unsolved))
    for label, _, bounds, paid, unsolved in found:
        row(label, bounds, first[0], f"cost {paid:10.4f} ({paid / base - 1:+.2%})",
            f"unsolved {unsolved:.1%}")  # fmt: skip
    picture(name, mpc, found, s)


def picture(name: str, mpc: jm.MPC, found: list[tuple], s: Settings) -> None:
    """The sets on the left, area against cost on the right, in the same colours."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    free = area(replace(mpc, terminal_set=None), s)[1][1]
    right.axvline(free, color="0.6", linestyle="--")
    right.annotate("no terminal set", (free, 0.03), (-4, 0), ha="right", fontsize=8, color="0.4",
                   xycoords=("data", "axes fraction"), textcoords="offset points")  # fmt: skip
    colours = plt.get_cmap("viridis")(np.linspace(0, 0.9, len(found)))
    for (label, fmap, bounds, paid, _), colour in zip(found, colours, strict=True):
        ring = fmap.inner().vertices()
        left.plot(*np.vstack([ring, ring[:1]]).T, color=colour)
        right.plot(bounds[0], paid, "o", color=colour)
        right.annotate(label, (bounds[0], paid), (0, 7), textcoords="offset points", fontsize=8,
                       ha="center" if bounds[0] > 0.15 * free else "left")  # fmt: skip
    left.set(
        xlabel=mpc.labels[0], ylabel=mpc.labels[1],
        title=f"{name}, N = {mpc.horizon}: proved feasible sets, colours as beside",
    )  # fmt: skip
    right.set(
        xlabel="proved area", ylabel="mean closed-loop cost, unseen states",
        title="area grown by closed-loop cost − weight × share",
    )  # fmt: skip
    right.margins(0.1, 0.2)
    right.set_xlim(0)
    s.out.mkdir(parents=True, exist_ok=True)
    path = s.out / f"trade-{name.replace(' ', '-')}.png"
    figure.savefig(path, dpi=130)
    print(f"  {path}")


PARTS = {"terminal": terminal, "tightening": tightening, "horizon": horizon, "trade": trade}


if __name__ == "__main__":
    settings = tyro.cli(Settings)
    for part in settings.parts or PARTS:
        for name in settings.plants:
            print(f"{part}, {name}", flush=True)
            PARTS[part](name, settings)
