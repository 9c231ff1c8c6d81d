"""Accuracy on QPs from files: who solves them, how well, and does the status tell the truth?

    python experiments/qp_benchmark.py --problems DIR

DIR holds .npz files in qpsolvers' form (P, q, G, h, A, b, lb, ub; absent ones are empty). The
public set mpc_qpbenchmark (Caron 2025, Apache-2.0) has this form. Residuals (primal, dual, duality
gap; absolute, infinity norm) are computed here, in float64 against the data as they are in the
file, from each (z, y) in the convention l ≤ Az ≤ u, Pz + q + A'y = 0.

solved: all three residuals are within that tolerance. right code: the solver said solved exactly
when they are within 1e-6, or within the tolerance it ran at where that is looser (column "asked":
1e-9 of reference solvers, 1e-4 of those that run in float32). mean ms: time of a second call on
the same problem, for the first one may compile; the data are in the solver's own format by then,
its set-up counts; a first call above 20 s is not repeated. A solver that raises has failed in
every column. Reference solvers run where they are installed; those not written in JAX compute in
float64 whatever --dtype says.
"""

import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from qp_judge import residuals
from scipy import sparse

import jaxmpc as jm

TOLERANCES = (1e-3, 1e-6, 1e-9)
ASKED = 1e-9  # of every reference solver in float64
SLOW = 2e4  # ms; a first call above that is not repeated
FIELDS = ("P", "q", "G", "h", "A", "b", "lb", "ub")


@dataclass(frozen=True)
class Settings:
    """problems: folder with .npz files. iterations, newton_steps: settings of jaxmpc's solver.
    dtype: of the solvers in JAX. solvers: packages to run (none: all). each: print a line a
    problem."""

    problems: Path
    iterations: int = 200
    newton_steps: int = 60
    dtype: Literal["float64", "float32"] = "float64"
    solvers: tuple[str, ...] = ()
    each: bool = False


# Solves once: z, y in our row convention, and whether the solver says solved.
Solve = Callable[[], tuple[Any, Any, bool]]


def load(path: Path) -> jm.QP:
    """One QP; fields that are absent are stored as arrays without dimensions."""
    with np.load(path, allow_pickle=True) as data:
        fields = {k: data[k] for k in FIELDS if k in data.files and data[k].ndim}
    return jm.QP.from_qpsolvers(**fields)


def one_sided(qp: jm.QP) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Callable]:
    """E, b, G, h of Ez = b, Gz ≤ h, and the function that maps their multipliers to our y: a row's
    is what its upper side pushes less what its lower side does."""
    equal = qp.l == qp.u
    upper, lower = np.isfinite(qp.u) & ~equal, np.isfinite(qp.l) & ~equal
    G = np.vstack([qp.A[upper], -qp.A[lower]])
    h = np.concatenate([qp.u[upper], -qp.l[lower]])

    def multiplier(of_equal, of_rest):
        y, above = np.zeros(qp.l.size), int(upper.sum())
        y[equal] = of_equal
        y[upper] += of_rest[:above]
        y[lower] -= of_rest[above:]
        return y

    return qp.A[equal], qp.u[equal], G, h, multiplier


@cache
def compiled(iterations: int, newton_steps: int, eps: float | None) -> Callable:
    return jax.jit(
        lambda qp: jm.solve_qp(qp, jm.ADMM(iterations, newton_steps=newton_steps, eps=eps))
    )


def jaxmpc(qp: jm.QP, s: Settings) -> Solve:
    data = jax.tree.map(lambda v: jnp.asarray(v, s.dtype), qp)
    run = compiled(s.iterations, s.newton_steps, 1e-6 if s.dtype == "float64" else None)

    def solve():
        solution = jax.block_until_ready(run(data))
        return solution.z, solution.y, int(solution.status) == jm.Status.SOLVED

    return solve


def osqp(qp: jm.QP, s: Settings) -> Solve:
    import osqp

    P, A = sparse.csc_matrix(np.triu(qp.P)), sparse.csc_matrix(qp.A)
    accuracy = dict(eps_abs=ASKED, eps_rel=0.0, max_iter=100_000, polishing=True)

    def solve():
        solver = osqp.OSQP()
        solver.setup(P, qp.q, A, qp.l, qp.u, **accuracy, verbose=False)
        with redirect_stdout(StringIO()):  # it reports a needless polish whatever verbose says
            result = solver.solve(raise_error=False)
        return result.x, result.y, result.info.status_val == 1

    return solve


def clarabel_outcome(qp: jm.QP) -> Callable[[], tuple[np.ndarray, np.ndarray, str]]:
    """z, y and the name of Clarabel's status; y (or z) is its proof of no (or no least) point."""
    import clarabel

    E, b, G, h, multiplier = one_sided(qp)
    P, A = sparse.csc_matrix(np.triu(qp.P)), sparse.csc_matrix(np.vstack([E, G]))
    cones = [clarabel.ZeroConeT(b.size), clarabel.NonnegativeConeT(h.size)]
    right = np.concatenate([b, h])
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_feas = ASKED
    settings.tol_gap_rel = 1e-15  # either gap would do for it

    def solve():
        result = clarabel.DefaultSolver(P, qp.q, A, right, cones, settings).solve()
        dual = np.array(result.z)
        return np.array(result.x), multiplier(dual[: b.size], dual[b.size :]), str(result.status)

    return solve


def clarabel(qp: jm.QP, s: Settings) -> Solve:
    outcome = clarabel_outcome(qp)

    def solve():
        z, y, status = outcome()
        return z, y, status == "Solved"

    return solve


def piqp(qp: jm.QP, s: Settings) -> Solve:
    import piqp

    equal = qp.l == qp.u
    rest = ~equal & (np.isfinite(qp.l) | np.isfinite(qp.u))
    P, E, G = (np.asfortranarray(M) for M in (qp.P, qp.A[equal], qp.A[rest]))

    def solve():
        solver = piqp.DenseSolver()
        solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = ASKED
        solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = 0.0
        solver.setup(P, qp.q, E, qp.u[equal], G, qp.l[rest], qp.u[rest])
        status, y = solver.solve(), np.zeros(qp.l.size)
        result = solver.result
        y[equal], y[rest] = result.y, result.z_u - result.z_l
        return result.x, y, status == piqp.PIQP_SOLVED

    return solve


def proxsuite(qp: jm.QP, s: Settings) -> Solve:
    from proxsuite import proxqp

    equal = qp.l == qp.u
    data = qp.P, qp.q, qp.A[equal], qp.u[equal], qp.A[~equal], qp.l[~equal], qp.u[~equal]
    gap = dict(check_duality_gap=True, eps_duality_gap_abs=ASKED, eps_duality_gap_rel=0.0)

    def solve():
        result = proxqp.dense.solve(*data, eps_abs=ASKED, eps_rel=0.0, **gap)
        y = np.zeros(qp.l.size)
        y[equal], y[~equal] = result.y, result.z
        return result.x, y, result.info.status == proxqp.PROXQP_SOLVED

    return solve


def daqp(qp: jm.QP, s: Settings) -> Solve:
    import daqp

    P, A = (np.ascontiguousarray(M) for M in (qp.P, qp.A))
    sense = np.where(qp.l == qp.u, 5, 0).astype(np.int32)
    l, u = np.maximum(qp.l, -1e30), np.minimum(qp.u, 1e30)

    def solve():
        z, _, flag, info = daqp.solve(P, qp.q, A, u, l, sense, primal_tol=ASKED)
        return z, info["lam"], flag == 1

    return solve


@cache
def qpax_compiled(tolerance: float) -> Callable:
    """The implicit backend: the explicit one keeps slacks and multipliers above √eps, so that
    its own residual does not come below 1e-8."""
    import qpax

    accuracy = dict(backend="i", solver_tol=tolerance, max_iter=100)
    return jax.jit(lambda *data: qpax.solve_qp(*data, **accuracy))


def qpax(qp: jm.QP, s: Settings) -> Solve:
    E, b, G, h, multiplier = one_sided(qp)
    data = [jnp.asarray(v, s.dtype) for v in (qp.P, qp.q, E, b, G, h)]
    run = qpax_compiled(asked("qpax", s))

    def solve():
        z, _, of_rest, of_equal, converged, _ = jax.block_until_ready(run(*data))
        return z, multiplier(of_equal, of_rest), bool(converged)

    return solve


@cache
def jaxopt_compiled(tolerance: float) -> Callable:
    import jaxopt

    box = jaxopt.BoxOSQP(tol=tolerance, maxiter=4000, eq_qp_solve="lu")
    return jax.jit(lambda P, q, A, l, u: box.run(None, (P, q), A, (l, u)))


def jaxopt(qp: jm.QP, s: Settings) -> Solve:
    data = [jnp.asarray(v, s.dtype) for v in (qp.P, qp.q, qp.A, qp.l, qp.u)]
    run = jaxopt_compiled(asked("jaxopt", s))

    def solve():
        params, state = jax.block_until_ready(run(*data))
        return params.primal[0], params.dual_eq, int(state.status) == 1

    return solve


def moreau(qp: jm.QP, s: Settings, method: str = "auto") -> Solve:
    """Moreau's own choice, an active set up to 500 variables."""
    import moreau

    E, b, G, h, multiplier = one_sided(qp)
    P, A = sparse.csr_array(qp.P), sparse.csr_array(np.vstack([E, G]))
    right = np.concatenate([b, h])
    cones = moreau.Cones(num_zero_cones=b.size, num_nonneg_cones=h.size)
    settings = moreau.Settings(
        solver=method, device="cpu",
        ipm_settings=moreau.IPMSettings(tol_gap_abs=ASKED, tol_gap_rel=1e-15, tol_feas=ASKED),
        active_set_settings=moreau.ActiveSetSettings(primal_tol=ASKED),
    )  # fmt: skip

    def solve():
        solver = moreau.Solver(P, qp.q, A, right, cones, settings)
        result = solver.solve()
        y = multiplier(result.z[: b.size], result.z[b.size :])
        return result.x, y, solver.info.status == moreau.SolverStatus.Solved

    return solve


def moreau_ipm(qp: jm.QP, s: Settings) -> Solve:
    return moreau(qp, s, "ipm")


# A name up to its underscore is the package that the adapter imports.
SOLVERS: dict[str, Callable[[jm.QP, Settings], Solve]] = {
    f.__name__: f
    for f in (jaxmpc, osqp, clarabel, piqp, proxsuite, daqp, qpax, jaxopt, moreau, moreau_ipm)
}
IN_JAX = ("jaxmpc", "qpax", "jaxopt")


def asked(name: str, s: Settings) -> float:
    """The tolerance that a solver runs at."""
    if name == "jaxmpc":
        return 1e-6 if s.dtype == "float64" else 1e-3
    return ASKED if s.dtype == "float64" or name not in IN_JAX else 1e-4


def measure(name: str, qp: jm.QP, s: Settings) -> tuple[np.ndarray, bool, bool, float]:
    """Residuals, whether the solver said solved, whether that was right, milliseconds."""
    try:
        solve, ms = SOLVERS[name](qp, s), [0.0]
        while len(ms) < 3 and ms[-1] < SLOW:
            begun = time.perf_counter()
            z, y, said = solve()
            ms.append((time.perf_counter() - begun) * 1e3)
        worst = residuals(qp, z, y)
    except Exception as error:  # whatever it is, it is the solver's failure, not ours
        print(f"  {name} raised {type(error).__name__}: {str(error)[:60]!r}")
        return np.full(3, np.inf), False, False, np.nan
    return worst, said, said == bool(worst.max() <= max(1e-6, asked(name, s))), ms[-1]


def run(s: Settings) -> None:
    """Solve all, print the table."""
    jax.config.update("jax_enable_x64", s.dtype == "float64")
    paths = sorted(s.problems.glob("*.npz"))
    if not paths:
        raise SystemExit(f"no .npz file in {s.problems}")
    heads = "".join(f"{f'solved {t:.0e}':>14}" for t in TOLERANCES)
    print(f"{len(paths)} problems\n{'':28}{heads}{'right code':>12}{'asked':>8}{'mean ms':>10}")
    for name in s.solvers or SOLVERS:
        package = name.split("_")[0]
        if find_spec(package) is None:
            print(f"{name}: left out, not installed")
            continue
        release = "" if package == "jaxmpc" else f" {version(package)}"
        title = f"{name}{release} {s.dtype if name in IN_JAX else 'float64'}"
        outcomes = []
        for path in paths:
            outcomes.append(measure(name, load(path), s))
            if s.each:
                worst, said, _, ms = outcomes[-1]
                figures = " ".join(f"{v:.1e}" for v in worst)
                print(f"  {path.stem:12} {figures} {'' if said else 'not '}solved {ms:.2f} ms")
        worst, _, right, ms = (np.array(column) for column in zip(*outcomes, strict=True))
        shares = "".join(f"{np.mean(worst.max(axis=1) <= t):14.1%}" for t in TOLERANCES)
        tail = f"{right.mean():12.1%}{asked(name, s):8.0e}{np.nanmean(ms):10.2f}"
        print(f"{title:28}{shares}{tail}", flush=True)


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
