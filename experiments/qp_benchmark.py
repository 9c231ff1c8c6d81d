"""Accuracy on QPs from files: who solves them, how well, and does the status tell the truth?

    python experiments/qp_benchmark.py --problems DIR

DIR holds .npz files in qpsolvers' form (P, q, G, h, A, b, lb, ub; absent ones are empty). Residuals
(primal, dual, duality gap; absolute, infinity norm) are computed here from each (z, y). "solved" at
a tolerance: all three are within it. "right code": the solver said solved exactly when it was so at
1e-6. The public set mpc_qpbenchmark (Caron 2025, Apache-2.0) has this form.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro

import jaxmpc as jm

TOLERANCES = (1e-3, 1e-6, 1e-9)
FIELDS = ("P", "q", "G", "h", "A", "b", "lb", "ub")


@dataclass(frozen=True)
class Settings:
    """problems: folder with .npz files. iterations, refine: settings of jaxmpc's solver.
    dtype: float64 or float32. each: print a line a problem."""

    problems: Path
    iterations: int = 500
    refine: int = 20
    dtype: str = "float64"
    each: bool = False


def load(path: Path) -> jm.QP:
    """One QP; fields that are absent are stored as arrays without dimensions."""
    with np.load(path, allow_pickle=True) as data:
        fields = {k: data[k] for k in FIELDS if k in data.files and data[k].ndim}
    return jm.QP.from_qpsolvers(**fields)


def residuals(qp: jm.QP, z: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Primal residual, dual residual and gap, in float64 on the host."""
    z, y = np.asarray(z, np.float64), np.asarray(y, np.float64)
    Az = qp.A @ z
    with np.errstate(invalid="ignore"):
        support = np.where(y > 0, y * qp.u, np.where(y < 0, y * qp.l, 0.0)).sum()
    primal = np.abs(Az - np.clip(Az, qp.l, qp.u)).max(initial=0.0)
    dual = np.abs(qp.P @ z + qp.q + y @ qp.A).max()
    return np.array([primal, dual, abs(z @ qp.P @ z + qp.q @ z + support)])


def ours(qp: jm.QP, s: Settings) -> tuple[np.ndarray, bool, float]:
    """Residuals, status is SOLVED, seconds of the second call (the first compiles)."""
    eps = 1e-6 if s.dtype == "float64" else None
    solver = jm.ADMM(iterations=s.iterations, refine=s.refine, eps=eps)
    with jax.enable_x64(s.dtype == "float64"):
        data = jax.tree.map(lambda v: np.asarray(v, s.dtype), qp)
        jm.solve_qp(data, solver)
        begun = time.perf_counter()
        solution = jax.block_until_ready(jm.solve_qp(data, solver))
        seconds = time.perf_counter() - begun
    return residuals(qp, solution.z, solution.y), int(solution.status) == 1, seconds


def osqp_solver(qp: jm.QP, s: Settings) -> tuple[np.ndarray, bool, float]:
    """OSQP at 1e-9 with polishing."""
    import osqp
    from scipy import sparse

    begun = time.perf_counter()
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(qp.P)), qp.q, sparse.csc_matrix(qp.A), qp.l, qp.u,
        eps_abs=1e-9, eps_rel=0.0, max_iter=100_000, polishing=True, verbose=False,
    )  # fmt: skip
    result = solver.solve()
    seconds = time.perf_counter() - begun
    return residuals(qp, result.x, result.y), result.info.status_val == 1, seconds


def run(settings: Settings) -> None:
    """Solve all, print the table."""
    paths = sorted(settings.problems.glob("*.npz"))
    if not paths:
        raise SystemExit(f"no .npz file in {settings.problems}")
    contestants = {f"jaxmpc {settings.dtype}": ours}
    try:
        import osqp

        contestants[f"OSQP {osqp.__version__}"] = osqp_solver
    except ImportError:
        print("OSQP is not installed: pip install -e '.[bench]'")
    names = [f"solved {t:.0e}" for t in TOLERANCES]
    print(
        f"{len(paths)} problems\n{'':16}{''.join(f'{n:>14}' for n in names)}    right code  mean ms"
    )
    for name, solve in contestants.items():
        outcomes = []
        for path in paths:
            qp = load(path)
            worst, said, seconds = solve(qp, settings)
            outcomes.append((worst.max(), said, seconds))
            if settings.each:
                figures = " ".join(f"{v:.1e}" for v in worst)
                print(f"  {name} {path.stem:12} {figures} {'solved' if said else 'not solved'}")
        error, said, seconds = (np.array(column) for column in zip(*outcomes, strict=True))
        shares = "".join(f"{np.mean(error <= t):14.1%}" for t in TOLERANCES)
        right = np.mean(said == (error <= (1e-6 if "32" not in name else 1e-3)))
        print(f"{name:16}{shares}{right:14.1%}{seconds.mean() * 1e3:9.2f}")


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
