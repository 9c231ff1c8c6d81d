"""Learned penalties beside constant and adaptive ones: states solved by ADMM in fixed steps.

    python experiments/penalties.py --problem joint

"solved" is the share of held-out feasible states with status SOLVED (residuals and gap below 1e-6,
float64) after the steps, no Newton. "steps to 99 %": the fewest, on a grid, after which 99 %
of the held-out states are solved.

States: uniform in the state limits (arm2: a box about home; product: each joint's limits, hidden
as the product is; springs8_30: denser near the origin), those that `map_feasible_set` proves
feasible. Learning and the choice of the constant see the first part only; both judge on the rest.

default: rho of the problem (`ADMM.rho`), alpha = 1.6. constant: best of a grid of rho and alpha on
states of the first part (for "steps to 99 %" the best for that). OSQP: OSQP itself with its scaling
and its adaptive rho, intervals of 5 to 100 steps, whichever is best, run to the given number of
iterations without termination checks or polish; its answers judged by our residuals. learned:
`tune_solver`; for "steps to 99 %" learned anew for each number of steps that was tried.
"""

import time
from dataclasses import dataclass, replace
from functools import reduce
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import osqp
import tyro
from bench import families
from hidden_product import JOINTS, product
from hidden_product import Settings as Product
from scipy import sparse

import jaxmpc as jm
from jaxmpc.app import config
from jaxmpc.mpc.condense import Condensed, condense, in_float64
from jaxmpc.qp.admm import ScaledProgram, factorise, iterate, read, splittings
from jaxmpc.qp.residuals import residual_terms, worst
from jaxmpc.tuning.result import TuningRun
from jaxmpc.tuning.solver import transfer_penalties, tune_solver

HERE = Path(__file__).parent
RHOS, ALPHAS = np.logspace(-2, 2, 13), (1.0, 1.6, 1.9)
INTERVALS = (5, 10, 25, 50, 100)
# Steps that are tried for 99 %.
TRIED = (20, 40, 60, 80, 100, 120, 140, 160, 200, 240, 300, 400, 500)
LONG, EVERY = 2000, 20


@dataclass(frozen=True)
class Settings:
    """learn, test: numbers of states. steps: ADMM steps. updates, batch: of learning. constants:
    states that the constant is chosen on. osqp: states that OSQP is given, one by one. longer: also
    carry groups to twice the horizon. to_99: also count steps of learned penalties to 99 %."""

    problem: Literal[
        "joint", "double_integrator", "inverted_pendulum", "arm2", "product", "springs8_30"
    ] = "joint"
    learn: int = 3000
    test: int = 2000
    steps: int = 100
    updates: int = 200
    batch: int = 32
    constants: int = 300
    osqp: int = 500
    longer: bool = True
    to_99: bool = True
    seed: int = 0
    """States along each of two axes."""
    terminal: bool = False
    """The joint's invariant set as terminal set."""


@dataclass
class Case:
    """A problem, what it tracks, and how states are drawn."""

    mpc: jm.MPC
    draw: Any
    tracked: dict[str, np.ndarray]


def joint(horizon: int = 20) -> jm.MPC:
    """The lesson's joint."""
    system = jm.LinearSystem(np.array([[1.0, 0.01], [0.0, 1.0]]), np.array([[0.0], [0.2]]), dt=0.01)
    limits = jm.Box(np.array([-1.5, -2.0]), np.array([1.5, 2.0]))
    Q, R = np.diag([50.0, 1.0]), np.array([[0.1]])
    return jm.MPC(
        system, Q, R, horizon, limits, jm.Box([-2.0], [2.0]), terminal_set=limits,
        terminal_cost=jm.lqr(system, Q, R).P,
    )  # fmt: skip


def case(name: str) -> Case:
    """By name."""
    tracked: dict[str, np.ndarray] = {}
    if name == "product":
        settings = Product()
        mpc, back = product(settings)
        T = np.linalg.inv(back)
        wide = np.array([v for _, q, dq in JOINTS for v in (q, dq)])
        return Case(mpc, lambda rng, k: rng.uniform(-wide, wide, (k, len(wide))) @ T.T, tracked)
    if name == "arm2":
        robot = jm.load_robot("arm2")
        x, u = robot.equilibrium()
        mpc, home = jm.robot_mpc(robot), np.asarray(robot.coordinates(x))
        tracked = {"reference": home, "input_reference": np.asarray(u)}
        wide = np.array([1.0, 1.0, 3.5, 5.5])
        return Case(mpc, lambda rng, k: home + rng.uniform(-wide, wide, (k, 4)), tracked)
    if name == "springs8_30":
        mpc = families.problem(name)
        wide = families.half_widths(mpc)
        near = lambda rng, k: rng.uniform(0, 1, (k, 1)) ** (1 / 4)  # as `families.family`
        return Case(
            mpc, lambda rng, k: rng.uniform(-wide, wide, (k, len(wide))) * near(rng, k), tracked
        )
    mpc = joint() if name == "joint" else config.load(HERE / f"{name}.toml").build_mpc()
    lower, upper = np.asarray(mpc.states.lower), np.asarray(mpc.states.upper)
    return Case(mpc, lambda rng, k: rng.uniform(lower, upper, (k, len(lower))), tracked)


def feasible(c: Case, mpc: jm.MPC, count: int, seed: int) -> np.ndarray:
    """So many states proved feasible."""
    rng, found = np.random.default_rng(seed), np.zeros((0, mpc.system.n))
    while len(found) < count:
        x = c.draw(rng, 8192)
        found = np.concatenate([found, x[jm.map_feasible_set(mpc, x).label == 1]])
    return found[:count]


@jax.jit
def run(condensed: Condensed, tracked: Any, x: jax.Array, rho: Any, alpha: Any) -> jax.Array:
    """Largest residual over tolerance (LONG/EVERY, B) after each EVERY steps of constant rho."""
    made = factorise(condensed.P, condensed.C, jm.ADMM(rho=rho), condensed.balls)

    def one(x: jax.Array) -> jax.Array:
        qp = condensed.qp(x, *tracked)
        p = ScaledProgram.of(qp, made)

        def chunk(t: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
            t, _ = iterate(splittings(made, p.q), p.bounds, t, EVERY, alpha)
            w, y = read(made, t, p.q, p.bounds)
            return t, excess(qp, *p.unscaled(w, y))

        return jax.lax.scan(chunk, jnp.zeros_like(qp.l), length=LONG // EVERY)[1]

    return jax.vmap(one, out_axes=1)(x)


def excess(qp: jm.QP, z: jax.Array, y: jax.Array) -> jax.Array:
    """Largest residual over its tolerance; SOLVED is ≤ 1."""
    above, _ = worst(residual_terms(qp, z, y), 100 * jnp.finfo(z.dtype).eps)
    return reduce(jnp.maximum, above) / 1e-6


@jax.jit
def judged(condensed: Condensed, tracked: Any, x: jax.Array, z: jax.Array, y: jax.Array) -> Any:
    """Whether answers of others are solved."""

    def one(x: jax.Array, z: jax.Array, y: jax.Array) -> jax.Array:
        qp = condensed.qp(x, *tracked)
        return excess(qp, z, qp.bounds.admissible(y)) <= 1

    return jax.vmap(one)(x, z, y)


plans = jax.jit(jax.vmap(jm.Controller.plan, in_axes=(None, 0, None, None, None)))


class Table:
    """What is measured of one problem."""

    def __init__(self, s: Settings, mpc: jm.MPC, tracked: dict[str, np.ndarray], x: np.ndarray):
        self.s, self.mpc = s, in_float64(mpc)
        self.given = tracked
        steps, (n, m) = mpc.horizon, (mpc.system.n, mpc.system.m)
        wide = lambda name, shape: (
            None if name not in tracked else jnp.broadcast_to(tracked[name], shape)
        )
        self.tracked = (
            wide("reference", (steps + 1, n)), wide("input_reference", (steps, m))
        )  # fmt: skip
        self.condensed = condense(self.mpc)
        self.first, self.test = x[: s.learn], x[s.learn :]

    def solved(self, solver: jm.ADMM) -> float:
        """Share of the held-out states with status SOLVED."""
        made = jm.Controller(self.mpc, solver)
        status = plans(made, self.test, self.tracked[0], None, self.tracked[1]).status
        return float(np.mean(np.asarray(status) == jm.Status.SOLVED))

    def constants(self) -> tuple[str, float, str]:
        """Best (rho, alpha) for `steps` and its share; fewest steps to 99 %."""
        few = self.first[: self.s.constants]
        residuals = {
            (rho, alpha): np.asarray(run(self.condensed, self.tracked, few, rho, alpha))
            for rho in RHOS for alpha in ALPHAS
        }  # fmt: skip
        at = self.s.steps // EVERY - 1
        rank = lambda r: (-np.mean(r[at] <= 1), np.median(r[at]))
        best = min(residuals, key=lambda k: rank(residuals[k]))
        share = self.solved(jm.ADMM(self.s.steps, *best, newton_steps=0))
        soon = min(residuals, key=lambda k: to_99(residuals[k])[::-1])
        held = np.asarray(run(self.condensed, self.tracked, self.test, *soon))
        name = f"best constant, rho = {best[0]:.2g}, alpha = {best[1]}"
        return name, share, told(to_99(held), soon)

    def osqp(self) -> tuple[str, float, str]:
        """The same of OSQP, and the time of one loop."""
        x = self.test[: self.s.osqp]
        share = {k: np.mean(self.osqp_solved(x, self.s.steps, k)) for k in INTERVALS}
        best = max(share, key=lambda k: share[k])
        soon: tuple[Any, int] = (None, 0)
        for count in (40, 60, 80, 100, 120, 160, 200, 240, 300, 400, 500, 700, 1000, 1500, 2000):
            if not self.s.to_99:
                break
            found = {k: np.mean(self.osqp_solved(x, count, k)) for k in INTERVALS if k <= count}
            interval = max(found, key=lambda k: found[k])
            soon = (None if found[interval] < 0.99 else count, interval)
            if soon[0]:
                break
        text = f"{soon[0] or '> 2000'} (rho every {soon[1]})" if self.s.to_99 else ""
        return f"OSQP, rho every {best} steps", float(share[best]), text

    def osqp_solved(self, x: np.ndarray, count: int, interval: int) -> np.ndarray:
        """Whether OSQP's answers after so many iterations are solved."""
        data = jax.jit(jax.vmap(lambda x: ((p := self.condensed.qp(x, *self.tracked)).q, p.l, p.u)))
        q, l, u = map(np.asarray, data(x))
        solver = osqp.OSQP()
        solver.setup(
            sparse.csc_matrix(np.triu(self.condensed.P)), q[0],
            sparse.csc_matrix(self.condensed.C), l[0], u[0], verbose=False, max_iter=count,
            check_termination=0, adaptive_rho=True, adaptive_rho_interval=interval,
            eps_abs=1e-12, eps_rel=0.0, warm_starting=False, polishing=False,
        )  # fmt: skip
        answers = []
        for q_i, l_i, u_i in zip(q, l, u, strict=True):
            solver.update(q=q_i, l=l_i, u=u_i)
            solver.update_settings(rho=0.1)  # the adapted one of the last state would stay
            result = solver.solve(raise_error=False)
            answers.append((np.nan_to_num(result.x), np.nan_to_num(result.y)))
        z, y = (jnp.asarray(v) for v in zip(*answers, strict=True))
        return np.asarray(judged(self.condensed, self.tracked, x, z, y))

    def learn(self, iterations: int, stages: int, groups: str) -> TuningRun:
        """Penalties learned on the first part."""
        return tune_solver(
            self.mpc, self.first, iterations, stages=stages, groups=groups, seed=self.s.seed,
            updates=self.s.updates, batch=self.s.batch, **self.given,
        )  # fmt: skip

    def learned(self, stages: int, groups: str) -> tuple[TuningRun, str, float, str]:
        """The same of learned penalties."""
        begun = time.perf_counter()
        found = self.learn(self.s.steps, stages, groups)
        seconds = time.perf_counter() - begun
        share = self.solved(found.solver)
        name = f"learned, {stages} stage{'s' * (stages > 1)}, by {groups}"
        texts = [f"{seconds:.0f} s"]
        shares = {self.s.steps: share}

        def at(count: int) -> float:
            if count not in shares:
                shares[count] = self.solved(self.learn(count, stages, groups).solver)
            return shares[count]

        if self.s.to_99 and (stages, groups) == (4, "step"):
            # The share grows with the steps, nearly: bisection on the grid.
            low, high = -1, len(TRIED)
            while high - low > 1:
                middle = TRIED.index(self.s.steps) if (low, high) == (-1, len(TRIED)) else (
                    (low + high) // 2
                )  # fmt: skip
                low, high = (low, middle) if at(TRIED[middle]) >= 0.99 else (middle, high)
            found_99 = TRIED[high] if high < len(TRIED) else None
            texts.append(f"{found_99 or f'> {TRIED[-1]}'} (tried: " + ", ".join(
                f"{k}: {v:.1%}" for k, v in sorted(shares.items())
            ) + ")")  # fmt: skip
        return found, name, share, "; ".join(texts)


def to_99(residuals: np.ndarray) -> tuple[float, int]:
    """(99 % quantile of the last residuals, fewest steps with 99 % solved)."""
    there = np.mean(residuals <= 1, axis=1) >= 0.99
    steps = EVERY * (int(np.argmax(there)) + 1) if there.any() else 10 * LONG
    return float(np.quantile(np.nan_to_num(residuals[-1], nan=np.inf), 0.99)), steps


def told(found: tuple[float, int], best: Any = None) -> str:
    """For the table."""
    of = "" if best is None else f" (rho = {best[0]:.2g}, alpha = {best[1]})"
    return (f"> {LONG}" if found[1] > LONG else f"{found[1]}") + of


def report(s: Settings) -> None:
    """Print the table of one problem."""
    c = case(s.problem)
    table = Table(s, c.mpc, c.tracked, feasible(c, c.mpc, s.learn + s.test, s.seed))
    rows = table.condensed.C.shape
    print(f"{s.problem}: N = {c.mpc.horizon}, {rows[1]} variables, {rows[0]} rows, {s.steps} steps")
    show = lambda name, share, more="": print(f"  {name:<44}{share:8.2%}  {more}", flush=True)
    own = table.condensed
    rho = float(factorise(own.P, own.C, jm.ADMM(), own.balls).rho[0, 0])
    few = np.asarray(run(own, table.tracked, table.test, rho, 1.6))
    show(
        f"default, rho = {rho:.2g}, alpha = 1.6",
        table.solved(jm.ADMM(s.steps, newton_steps=0)),
        told(to_99(few)),
    )
    show(*table.constants())
    begun = time.perf_counter()
    table.osqp_solved(table.test[: s.osqp], 1000, 25)
    seconds = (time.perf_counter() - begun) * s.test / s.osqp
    show(*table.osqp())
    found = None
    for stages, groups in ((1, "row"), (4, "row"), (1, "step"), (4, "step")):
        found, *line = table.learned(stages, groups)
        show(*line)
    print(
        f"  (OSQP takes {seconds:.1f} s for 1,000 iterations on each of the {s.test} test states)"
    )
    if s.longer and found is not None:
        mpc = replace(c.mpc, horizon=2 * c.mpc.horizon)
        table = Table(s, mpc, c.tracked, feasible(c, mpc, s.learn + s.test, s.seed))
        print(f"  twice the horizon, N = {mpc.horizon}, {table.condensed.C.shape[0]} rows")
        for steps in (s.steps, 2 * s.steps):
            show(f"{steps} steps: default", table.solved(jm.ADMM(steps, newton_steps=0)))
            show("groups of the shorter one", table.solved(transfer_penalties(found, mpc, steps)))
            show("learned anew", table.solved(table.learn(steps, 4, "step").solver))


def main() -> None:
    """Print."""
    s = tyro.cli(Settings, description=__doc__)
    with jax.enable_x64(True):
        report(s)


if __name__ == "__main__":
    main()
