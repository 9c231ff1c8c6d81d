"""Derivatives of QP solutions: agreement with central differences, time of the backward pass.

    python experiments/qp_derivatives.py

Part "agreement": random families with known answers (`qp_families.py`), as many as have all
multipliers of active rows and all slacks of others above 1e-2 (in rows of length one), the active
rows independent.
Each field moves along a random direction in proportion to its entries; "bounds" moves l and u
alike, equalities included. dz and dy along it are compared with central differences at two step
widths; where those differ from each other by more than 1e-6 of their size, or where a program is
not SOLVED, the differences decide nothing ("decided" is the share that is left). within: share of
the decided whose dz (dy) is within 1e-5 of its largest entry, or of 1e-3 of z's where that is more.

Part "time": QPs of a robot joint's MPC that share P and A; median of the repeats, the functions
taking turns, compilation apart. backward is (forward and gradient) less forward.

Part "rivals": the gradient of w'z with respect to q, l, u of such QPs, by other solvers in JAX,
where they are installed; against central differences of our solution that agree at two step widths.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from qp_families import FAMILIES, Instance, draw, padded

import jaxmpc as jm

FIELDS = ("P", "q", "A", "l", "u", "bounds")
PARTS = ("agreement", "time", "rivals")
STEP = 1e-5


@dataclass(frozen=True)
class Settings:
    """parts: which (none: all). families: which (none: all with a solution). instances: programs a
    family. count: QPs of the joint timed at once. rivals: of those given to other solvers. repeats:
    of each timed function."""

    parts: tuple[Literal["agreement", "time", "rivals"], ...] = ()
    families: tuple[str, ...] = ()
    instances: int = 50
    count: int = 4096
    rivals: int = 64
    repeats: int = 7
    seed: int = 0


def regular(instance: Instance) -> bool:
    """Whether each row is clearly active or clearly not, and the active ones are independent."""
    qp, z, y = instance.qp, instance.z, instance.y
    length = np.maximum(np.linalg.norm(qp.A, axis=1), 1e-300)
    slack = np.minimum(qp.u - qp.A @ z, qp.A @ z - qp.l) / length
    pushed = np.abs(y) * length > 1e-2
    active = (qp.A / length[:, None])[pushed]
    independent = np.linalg.matrix_rank(active, 1e-10) == len(active) if len(active) else True
    return bool(np.all(pushed | (slack > 1e-2)) and independent)


def direction(qp: jm.QP, field: str, rng: np.random.Generator) -> jm.QP:
    """A random change of one field in proportion to its entries; P stays semidefinite."""
    still = jax.tree.map(np.zeros_like, qp)
    finite = lambda v: np.where(np.isfinite(v), v, 0.0)
    if field == "bounds":
        d = rng.standard_normal(qp.l.shape) * np.maximum(np.abs(finite(qp.l)), np.abs(finite(qp.u)))
        return replace(
            still, l=np.where(np.isfinite(qp.l), d, 0), u=np.where(np.isfinite(qp.u), d, 0)
        )
    value = getattr(qp, field)
    d = rng.standard_normal(value.shape) * finite(value)
    if field == "P":  # (I + hS)P(I + hS) to first order
        S = rng.standard_normal(len(value))
        d = value * (S[:, None] + S)
    return replace(still, **{field: d * (qp.l < qp.u) if field in "lu" else d})


def agreement(s: Settings) -> None:
    """Table of part (a)."""
    solver = jm.ADMM(500, newton_steps=20, eps=1e-6)

    @jax.jit
    @jax.vmap
    def evaluate(qp, d):
        def f(qp):
            sol = jm.solve_qp(qp, solver)
            return (sol.z, sol.y), sol.status

        solution, push, status = jax.linearize(f, qp, has_aux=True)
        return solution, push(d), status

    families = s.families or [f for f in FAMILIES if draw(f, 0).status == jm.Status.SOLVED]
    print("Agreement with central differences, float64")
    print(f"{'family':18}{'field':>8}{'programs':>10}{'decided':>9}{'z within':>10}{'y within':>10}"
          f"{'z median':>10}{'z worst':>9}")  # fmt: skip
    for family in families:
        seeds = range(s.seed, s.seed + 4 * s.instances)
        drawn = (draw(family, seed) for seed in seeds)
        chosen = [i.qp for i in drawn if regular(i)][: s.instances]
        if not chosen:
            print(f"{family:18} no program away from degeneracy", flush=True)
            continue
        count = len(chosen)
        filled = [padded(chosen[i % count]) for i in range(s.instances)]
        for field in FIELDS:
            rng = np.random.default_rng([s.seed, *field.encode()])
            stack = lambda trees: jax.tree.map(lambda *v: np.stack(v), *trees)
            batch = stack(filled)
            d = stack([direction(qp, field, rng) for qp in filled])
            at, exact, status = evaluate(batch, d)
            solved, numeric = [np.asarray(status) == jm.Status.SOLVED], []
            for h in (STEP, 2 * STEP):
                sides = []
                for sign in (h, -h):
                    moved = jax.tree.map(lambda v, dv, sign=sign: v + sign * dv, batch, d)
                    values, _, status = evaluate(moved, d)
                    sides.append(jax.tree.map(np.asarray, values))
                    solved.append(np.asarray(status) == jm.Status.SOLVED)
                numeric.append(jax.tree.map(lambda a, b, h=h: (a - b) / (2 * h), *sides))
            size = lambda v: np.abs(v).max(axis=1)
            columns = []
            for k in range(2):
                fine, coarse, got = numeric[0][k], numeric[1][k], np.asarray(exact[k])
                scale = np.maximum(size(fine), 1e-3 * size(np.asarray(at[k]))) + 1e-12
                decided = np.all(solved, axis=0) & (size(fine - coarse) <= 1e-6 * scale)
                columns.append((decided[:count], (size(got - fine) / scale)[:count]))
            (decided, error), (decided_y, error_y) = columns
            share = lambda ok: f"{np.mean(ok):10.1%}" if ok.size else f"{'-':>10}"
            figures = (
                (np.median(error[decided]), error[decided].max())
                if decided.any()
                else (np.nan,) * 2
            )
            print(f"{family:18}{field:>8}{count:10}{np.mean(decided):9.1%}"
                  f"{share(error[decided] <= 1e-5)}{share(error_y[decided_y] <= 1e-5)}"
                  f"{figures[0]:10.1e}{figures[1]:9.1e}", flush=True)  # fmt: skip


def joint(count: int, seed: int) -> tuple[jm.QP, Any]:
    """QPs of the joint that have a solution, with shared P and A; and axes for `vmap`."""
    box = lambda *limits: jm.Box(-np.array(limits), np.array(limits))
    Q = np.diag([50.0, 1.0])
    mpc = jm.MPC(
        system=jm.LinearSystem(np.array([[1, 0.01], [0, 1]]), np.array([[0.0], [0.2]]), dt=0.01),
        Q=Q, R=np.array([[0.1]]), horizon=20, states=box(1.5, 2.0), inputs=box(2.0),
        terminal_cost=Q,
    )  # fmt: skip
    condensed = jm.Controller(mpc).condensed
    assert condensed is not None
    x0 = np.random.default_rng(seed).uniform(-1, 1, (2 * count, 2)) * [1.5, 2.0]
    axes = jm.QP(P=None, q=0, A=None, l=0, u=0)
    qp = jax.jit(jax.vmap(condensed.qp, out_axes=axes))(x0)
    status = jax.jit(jax.vmap(jm.solve_qp, in_axes=(axes,)))(qp).status
    solved = np.asarray(status) == jm.Status.SOLVED
    keep = np.flatnonzero(solved)[:count]
    print(f"Robot joint: {qp.q.shape[1]} variables, {qp.l.shape[1]} rows; {keep.size} QPs, "
          f"{solved.mean():.1%} of those drawn are SOLVED")  # fmt: skip
    return replace(qp, q=qp.q[keep], l=qp.l[keep], u=qp.u[keep]), axes


def medians(
    functions: dict[str, Callable], arguments: tuple, repeats: int
) -> dict[str, np.ndarray]:
    """Seconds of each, median and least, taking turns; the first call, which compiles, apart."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for name, function in functions.items():
        begun = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        print(f"  {name}: first call {time.perf_counter() - begun:.1f} s", flush=True)
    for _ in range(repeats):
        for name, function in functions.items():
            begun = time.perf_counter()
            jax.block_until_ready(function(*arguments))
            times[name].append(time.perf_counter() - begun)
    return {name: np.array([np.median(v), min(v)]) for name, v in times.items()}


def timing(s: Settings) -> None:
    """Table of part (b)."""
    qp, axes = joint(s.count, s.seed)
    weight = jnp.asarray(np.random.default_rng(1).standard_normal(qp.q.shape[1]))
    solve = jax.vmap(jm.solve_qp, in_axes=(axes,))

    def loss(q, l, u, P, A):
        sol = solve(jm.QP(P, q, A, l, u))
        return jnp.sum(sol.z @ weight), sol

    functions = {
        "forward": jax.jit(lambda *a: loss(*a)[1]),
        "and gradient q, l, u": jax.jit(jax.value_and_grad(loss, (0, 1, 2), has_aux=True)),
        "and gradient P, A too": jax.jit(jax.value_and_grad(loss, (0, 1, 2, 3, 4), has_aux=True)),
    }
    took = medians(functions, (qp.q, qp.l, qp.u, qp.P, qp.A), s.repeats)
    forward = took["forward"]
    print(f"\n{'float64':24}{'ms in all':>10}{'least':>8}{'µs a QP':>9}{'backward/forward':>18}"
          f"{'of least':>10}")  # fmt: skip
    for name, t in took.items():
        ratios = (t - forward) / forward
        tail = "" if name == "forward" else f"{ratios[0]:18.2f}{ratios[1]:10.2f}"
        each = t[0] * 1e6 / len(qp.q)
        print(f"{name:24}{t[0] * 1e3:10.1f}{t[1] * 1e3:8.1f}{each:9.1f}{tail}", flush=True)


def ours(P, q, A, l, u):
    return jm.solve_qp(jm.QP(P, q, A, l, u)).z


def qpax(P, q, A, l, u, **settings):
    """Primal solution; target_kappa is the relaxation at which it differentiates."""
    import qpax as package

    empty = jnp.zeros((0, q.size), q.dtype)
    G, h = jnp.concatenate([A, -A]), jnp.concatenate([u, -l])
    return package.solve_qp_primal(P, q, empty, empty[:, 0], G, h, **settings)


def jaxopt_box(P, q, A, l, u):
    import jaxopt

    solver = jaxopt.BoxOSQP(tol=1e-9, maxiter=4000, eq_qp_solve="lu")
    return solver.run(None, (P, q), A, (l, u)).params.primal[0]


def jaxopt_osqp(P, q, A, l, u):
    import jaxopt

    G, h = jnp.concatenate([A, -A]), jnp.concatenate([u, -l])
    solver = jaxopt.OSQP(tol=1e-9, maxiter=4000, eq_qp_solve="lu")
    return solver.run(None, (P, q), None, (G, h)).params.primal


def compare(s: Settings) -> None:
    """Table of part (c), without the rows that no variable enters (the state at k = 0)."""
    qp, _ = joint(s.rivals, s.seed + 1)
    rows = np.flatnonzero(np.abs(np.asarray(qp.A)).sum(axis=1) > 0)
    P, A, q, l, u = qp.P, qp.A[rows], qp.q, qp.l[:, rows], qp.u[:, rows]
    rng = np.random.default_rng(2)
    w = jnp.asarray(rng.standard_normal(q.shape[1]))
    d = [rng.standard_normal(v.shape) for v in (q, l, u)]
    gradients = lambda solve: jax.jit(
        jax.vmap(jax.value_and_grad(lambda q, l, u: jnp.sum(w * solve(P, q, A, l, u)), (0, 1, 2)))
    )
    value = jax.jit(jax.vmap(lambda q, l, u: jnp.sum(w * ours(P, q, A, l, u))))
    numeric = []
    for h in (1e-6, 2e-6):
        plus, minus = (
            value(*(v + t * dv for v, dv in zip((q, l, u), d, strict=True))) for t in (h, -h)
        )
        numeric.append(np.asarray(plus - minus) / (2 * h))
    scale = np.abs(numeric[0]) + 1e-2
    decided = np.abs(numeric[0] - numeric[1]) <= 1e-6 * scale
    print(f"central differences decide {decided.mean():.1%} of {len(q)}\n")
    print(f"{'':26}{'median':>9}{'worst':>9}{'≤ 1e-5':>8}{'≤ 1e-3':>8}{'value off':>11}"
          f"{'µs forward':>12}{'µs and gradient':>17}")  # fmt: skip
    names: dict[str, tuple[str, Callable]] = {
        "jaxmpc": ("jaxmpc", ours),
        "qpax": ("qpax", qpax),
        "qpax, kappa 1e-9": ("qpax", partial(qpax, target_kappa=1e-9)),
        "qpax, exact": ("qpax", partial(qpax, backend="i", solver_tol=1e-9, target_kappa=1e-9)),
        "jaxopt BoxOSQP": ("jaxopt", jaxopt_box),
        "jaxopt OSQP": ("jaxopt", jaxopt_osqp),
    }
    at = np.asarray(value(q, l, u))
    for name, (package, solve) in names.items():
        if find_spec(package) is None:
            print(f"{name}: left out, not installed")
            continue
        title = (
            name if package == "jaxmpc" else name.replace(package, f"{package} {version(package)}")
        )
        try:
            forward = jax.jit(jax.vmap(lambda q, l, u, solve=solve: solve(P, q, A, l, u)))
            both, took = gradients(solve), {}
            for key, f in (("forward", forward), ("both", both)):
                jax.block_until_ready(f(q, l, u))
                times = []
                while len(times) < s.repeats and sum(times) < 20:
                    begun = time.perf_counter()
                    out = jax.block_until_ready(f(q, l, u))
                    times.append(time.perf_counter() - begun)
                took[key] = np.median(times) * 1e6 / len(q)
            got, gradient = jax.tree.map(np.asarray, out)
        except Exception as error:  # whatever it is, it is the solver's failure, not ours
            print(f"{title}: raised {type(error).__name__}: {str(error)[:60]!r}", flush=True)
            continue
        along = sum(np.sum(g * dv, axis=1) for g, dv in zip(gradient, d, strict=True))
        error = np.where(np.isfinite(along), np.abs(along - numeric[0]) / scale, np.inf)[decided]
        print(f"{title:26}{np.median(error):9.1e}{error.max():9.1e}{np.mean(error <= 1e-5):8.1%}"
              f"{np.mean(error <= 1e-3):8.1%}{np.abs(got - at).max():11.1e}"
              f"{took['forward']:12.1f}{took['both']:17.1f}", flush=True)  # fmt: skip


def run(s: Settings) -> None:
    """The tables asked for."""
    jax.config.update("jax_enable_x64", True)
    for part, table in zip(PARTS, (agreement, timing, compare), strict=True):
        if not s.parts or part in s.parts:
            print()
            table(s)


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
