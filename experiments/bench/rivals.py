"""Solvers of the field on a batch of QPs that share P and A, in one form, each as fast as its own
interface allows: set up once, then updated.

    min ½ z'Pz + q'z,  l ≤ Az ≤ u,  with multipliers y of Pz + q + A'y = 0

Each function of RIVALS takes a `Batch` and a tolerance, sets its solver up, and returns a call
that solves them all: z (B, nz), y (B, rows) and status (B,), a `Status`. All compute in float64.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from typing import Any

import jax
import numpy as np
from jax import Array
from scipy import sparse

from jaxmpc.arrays import Reals
from jaxmpc.qp.status import Status

SOLVED, EMPTY, OPEN = Status.SOLVED, Status.PRIMAL_INFEASIBLE, Status.ITERATION_LIMIT
# QPs whose residuals are computed at a time.
AT_ONCE = 65_536
Answers = tuple[np.ndarray, np.ndarray, np.ndarray]
Call = Callable[[], Answers]


@dataclass(frozen=True, eq=False)
class Batch:
    """QPs that share P (nz, nz) and A (rows, nz): q (B, nz), l and u (B, rows)."""

    P: np.ndarray
    A: np.ndarray
    q: np.ndarray
    l: np.ndarray
    u: np.ndarray

    @classmethod
    def of(cls, c: Any, x: np.ndarray) -> "Batch":
        """Return the QPs of the states x (B, n); c: a `Condensed` on the host."""
        shift = x @ c.D.T + c.d
        return cls(c.P, c.C, x @ c.F.T + c.f, c.lower - shift, c.upper - shift)

    def __len__(self) -> int:
        return len(self.q)

    def part(self, which: slice) -> "Batch":
        """Return some of the QPs."""
        return replace(self, q=self.q[which], l=self.l[which], u=self.u[which])

    def closest(self) -> "Batch":
        """Return the programs of the point of least norm that keeps the limits: the question
        whether there is one, in a form that every solver takes."""
        return replace(self, P=np.eye(len(self.P)), q=np.zeros_like(self.q))


def residuals(qps: Batch, z: Reals, y: Reals) -> np.ndarray:
    """Return primal residual, dual residual and gap of each pair as (3, B): infinity norms,
    absolute, infinity where a number is not finite.

    gap = |z'Pz + q'z + Σ u y⁺ − l y⁻|. A multiplier that pushes against a bound that is not there
    counts as zero, and the dual residual shows what it was worth.
    """
    z, y = np.asarray(z, float), np.asarray(y, float)
    if len(z) > AT_ONCE:  # the arrays below are of the size of y, some at a time
        parts = [slice(i, i + AT_ONCE) for i in range(0, len(z), AT_ONCE)]
        return np.hstack([residuals(qps.part(part), z[part], y[part]) for part in parts])
    y = np.where(((y > 0) & np.isposinf(qps.u)) | ((y < 0) & np.isneginf(qps.l)), 0.0, y)
    with np.errstate(invalid="ignore", over="ignore"):
        Az, gradient = z @ qps.A.T, z @ qps.P + qps.q
        primal = np.abs(Az - np.clip(Az, qps.l, qps.u)).max(axis=1, initial=0.0)
        dual = np.abs(gradient + y @ qps.A).max(axis=1)
        pushed = np.where(y > 0, qps.u, np.where(y < 0, qps.l, 0.0))
        gap = np.abs((z * gradient).sum(axis=1) + (pushed * y).sum(axis=1))
        found = np.array([primal, dual, gap])
    return np.where(np.isfinite(found), found, np.inf)


def _gathered(qps: Batch, one: Callable[[int], tuple[Any, Any, int]]) -> Answers:
    """Return z, y and status of a Python loop over all QPs."""
    z, y, status = np.empty_like(qps.q), np.empty_like(qps.l), np.empty(len(qps), int)
    for i in range(len(qps)):
        z[i], y[i], status[i] = one(i)
    return z, y, status


def daqp(qps: Batch, tolerance: float) -> Call:
    """DAQP's dual active-set method; exact but for rounding, so the tolerance moves little."""
    import daqp

    # DAQP takes memory that it may write to.
    P, A, sense = np.array(qps.P), np.array(qps.A), np.zeros(len(qps.A), np.int32)
    l, u = np.maximum(qps.l, -1e30), np.minimum(qps.u, 1e30)
    model = daqp.Model()
    model.setup(P, qps.q[0], A, u[0], l[0], sense)
    model.settings = {"primal_tol": min(1e-6, tolerance)}
    known = {1: SOLVED, -1: EMPTY}

    def one(i: int) -> tuple[Any, Any, int]:
        # Given `sense`, it forgets the active set of the QP before.
        model.update(f=qps.q[i], bupper=u[i], blower=l[i], sense=sense)
        z, _, flag, info = model.solve()
        return z, info["lam"], known.get(flag, OPEN)

    return lambda: _gathered(qps, one)


def piqp(qps: Batch, tolerance: float) -> Call:
    """PIQP's dense interior-point method."""
    import piqp

    solver = piqp.DenseSolver()
    solver.settings.eps_abs = solver.settings.eps_duality_gap_abs = tolerance
    solver.settings.eps_rel = solver.settings.eps_duality_gap_rel = 0.0
    P, A = np.asfortranarray(qps.P), np.asfortranarray(qps.A)
    solver.setup(P, qps.q[0], None, None, A, qps.l[0], qps.u[0])
    known = {piqp.PIQP_SOLVED: SOLVED, piqp.PIQP_PRIMAL_INFEASIBLE: EMPTY}

    def one(i: int) -> tuple[Any, Any, int]:
        solver.update(c=qps.q[i], h_l=qps.l[i], h_u=qps.u[i])
        flag, result = solver.solve(), solver.result
        return result.x, result.z_u - result.z_l, known.get(flag, OPEN)

    return lambda: _gathered(qps, one)


def osqp(qps: Batch, tolerance: float) -> Call:
    """OSQP's ADMM; each starts from the answer before it, as is its default."""
    import osqp

    solver = osqp.OSQP()
    P, A = sparse.csc_matrix(np.triu(qps.P)), sparse.csc_matrix(qps.A)
    solver.setup(
        P,
        qps.q[0],
        A,
        qps.l[0],
        qps.u[0],
        eps_abs=tolerance,
        eps_rel=0.0,
        max_iter=20_000,
        verbose=False,
    )
    known = {1: SOLVED, 3: EMPTY}

    def one(i: int) -> tuple[Any, Any, int]:
        solver.update(q=qps.q[i], l=qps.l[i], u=qps.u[i])
        result = solver.solve(raise_error=False)
        return result.x, result.y, known.get(result.info.status_val, OPEN)

    return lambda: _gathered(qps, one)


def clarabel(qps: Batch, tolerance: float) -> Call:
    """Clarabel's interior-point method."""
    import clarabel

    G, h, multiplier = _one_sided(qps)
    P, A = sparse.csc_matrix(np.triu(qps.P)), sparse.csc_matrix(G)
    settings = clarabel.DefaultSettings()
    settings.verbose, settings.presolve_enable = False, False  # it takes no new data after one
    settings.tol_gap_abs = settings.tol_feas = tolerance
    settings.tol_gap_rel = 1e-15  # either gap would do for it
    cones = [clarabel.NonnegativeConeT(len(G))]
    solver = clarabel.DefaultSolver(P, qps.q[0], A, h[0], cones, settings)
    known = {"Solved": SOLVED, "PrimalInfeasible": EMPTY}

    def one(i: int) -> tuple[Any, Any, int]:
        solver.update(q=qps.q[i], b=h[i])
        result = solver.solve()
        y = multiplier(np.array(result.z)[None])[0]
        return np.array(result.x), y, known.get(str(result.status), OPEN)

    return lambda: _gathered(qps, one)


def proxqp(qps: Batch, tolerance: float) -> Call:
    """ProxQP's dense augmented Lagrangian method, from a cold start; at most 1,000 steps, for it
    takes its default of 10,000 times 1,500 on some infeasible QPs."""
    from proxsuite import proxqp

    solver = proxqp.dense.QP(len(qps.P), 0, len(qps.A))
    settings = solver.settings
    settings.eps_abs, settings.eps_rel = tolerance, 0.0
    settings.check_duality_gap, settings.eps_duality_gap_abs = True, tolerance
    settings.eps_duality_gap_rel = 0.0
    settings.initial_guess = proxqp.NO_INITIAL_GUESS
    settings.max_iter, settings.max_iter_in = 1000, 100
    solver.init(H=qps.P, g=qps.q[0], C=qps.A, l=qps.l[0], u=qps.u[0])
    known = {proxqp.PROXQP_SOLVED: SOLVED, proxqp.PROXQP_PRIMAL_INFEASIBLE: EMPTY}

    def one(i: int) -> tuple[Any, Any, int]:
        solver.update(g=qps.q[i], l=qps.l[i], u=qps.u[i])
        solver.solve()
        result = solver.results
        return result.x, result.z, known.get(result.info.status, OPEN)

    return lambda: _gathered(qps, one)


def moreau(qps: Batch, tolerance: float, gradient: bool = False) -> Call:
    """Moreau's batch on the CPU, by the method that it chooses; `call.solver` is its object."""
    import moreau

    G, h, multiplier = _one_sided(qps)
    P, A = sparse.csr_matrix(qps.P), sparse.csr_matrix(G)
    solver = moreau.CompiledSolver(
        n=len(qps.P),
        m=len(G),
        P_row_offsets=P.indptr,
        P_col_indices=P.indices,
        A_row_offsets=A.indptr,
        A_col_indices=A.indices,
        cones=moreau.Cones(num_nonneg_cones=len(G)),
        settings=moreau.Settings(
            device="cpu",
            batch_size=len(qps),
            enable_grad=gradient,
            ipm_settings=moreau.IPMSettings(
                tol_gap_abs=tolerance, tol_gap_rel=1e-15, tol_feas=tolerance
            ),
            active_set_settings=moreau.ActiveSetSettings(primal_tol=min(1e-6, tolerance)),
        ),
    )
    solver.setup(P.data, A.data)
    known = {"Solved": SOLVED, "PrimalInfeasible": EMPTY}

    def call() -> Answers:
        solution = solver.solve(qps.q, h)
        names = [str(v).rsplit(".", 1)[-1] for v in solver.info.status]
        status = np.array([known.get(name, OPEN) for name in names])
        return np.asarray(solution.x), multiplier(np.asarray(solution.z)), status

    call.solver = solver  # type: ignore[attr-defined]
    return call


def qpax_pair(tolerance: float) -> Callable[..., tuple[Array, Array, Array]]:
    """Return qpax's interior-point method on one QP (P, q, A, l, u), in JAX: z, y, status."""
    import jax.numpy as jnp
    import qpax

    accuracy: dict[str, Any] = dict(backend="i", solver_tol=tolerance, max_iter=100)

    def one(P: Array, q: Array, A: Array, l: Array, u: Array) -> tuple[Array, Array, Array]:
        none = jnp.zeros((0, q.size)), jnp.zeros(0)
        G, h = jnp.concatenate([A, -A]), jnp.concatenate([u, -l])
        z, _, s, _, converged, _ = qpax.solve_qp(P, q, *none, G, h, **accuracy)
        return z, s[: l.size] - s[l.size :], jnp.where(converged, SOLVED, OPEN)

    return one


def qpax_primal(tolerance: float) -> Callable[..., Array]:
    """Return the z of qpax's QP as a function that differentiates."""
    import jax.numpy as jnp
    import qpax

    def one(P: Array, q: Array, A: Array, l: Array, u: Array) -> Array:
        none = jnp.zeros((0, q.size)), jnp.zeros(0)
        G, h = jnp.concatenate([A, -A]), jnp.concatenate([u, -l])
        return qpax.solve_qp_primal(P, q, *none, G, h, backend="i", solver_tol=tolerance)

    return one


def jaxopt_pair(tolerance: float) -> Callable[..., tuple[Array, Array, Array]]:
    """Return jaxopt's OSQP on one QP (P, q, A, l, u), in JAX: z, y, status."""
    import jax.numpy as jnp
    import jaxopt

    box = jaxopt.BoxOSQP(tol=tolerance, maxiter=4000, eq_qp_solve="lu")

    def one(P: Array, q: Array, A: Array, l: Array, u: Array) -> tuple[Array, Array, Array]:
        params, state = box.run(None, (P, q), A, (l, u))
        known = jnp.where(state.status == 3, EMPTY, OPEN)
        return params.primal[0], params.dual_eq, jnp.where(state.status == 1, SOLVED, known)

    return one


def jaxopt_primal(tolerance: float) -> Callable[..., Array]:
    """Return the z of jaxopt's OSQP, which differentiates."""
    pair = jaxopt_pair(tolerance)
    return lambda *qp: pair(*qp)[0]


def _batched(pair: Callable[[float], Callable[..., Any]]) -> Callable[[Batch, float], Call]:
    """Return a solver of one QP in JAX as one of a batch, under `jax.vmap`."""

    def make(qps: Batch, tolerance: float) -> Call:
        program = jax.jit(jax.vmap(pair(tolerance), in_axes=(None, 0, None, 0, 0)))
        data = jax.device_put((qps.P, qps.q, qps.A, qps.l, qps.u))

        def call() -> Answers:
            z, y, status = jax.block_until_ready(program(*data))
            return np.asarray(z), np.asarray(y), np.asarray(status)

        return call

    return make


def _one_sided(qps: Batch) -> tuple[np.ndarray, np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return G and h (B, rows) of Gz ≤ h and the function from its multipliers (B, rows) to y,
    leaving out bounds that are infinite for all."""
    upper = np.isfinite(qps.u).any(axis=0)
    lower = np.isfinite(qps.l).any(axis=0)
    count = int(upper.sum())
    G = np.vstack([qps.A[upper], -qps.A[lower]])
    h = np.hstack([qps.u[:, upper], -qps.l[:, lower]])

    def multiplier(s: np.ndarray) -> np.ndarray:
        y = np.zeros((len(s), len(upper)))
        y[:, upper] += s[:, :count]
        y[:, lower] -= s[:, count:]
        return y

    return G, h, multiplier


@dataclass(frozen=True)
class Rival:
    """A solver of the field. package: what is imported. loop: it solves one QP at a time. in_jax:
    its batch is `jax.vmap`. asked: the tolerance that it is given, relative to the one that its
    answers must meet. primal: z as a function that JAX differentiates."""

    package: str
    make: Callable[[Batch, float], Call]
    loop: bool = True
    in_jax: bool = False
    asked: float = 1.0
    primal: Callable[[float], Callable[..., Array]] | None = None

    @property
    def installed(self) -> bool:
        """Return whether the package can be imported."""
        return find_spec(self.package) is not None

    @property
    def version(self) -> str:
        """Return the version of the installed package."""
        try:
            return version(self.package)
        except PackageNotFoundError:
            return "unknown"


RIVALS = {
    "daqp": Rival("daqp", daqp),
    "moreau": Rival("moreau", moreau, loop=False),
    "piqp": Rival("piqp", piqp),
    "osqp": Rival("osqp", osqp),
    "clarabel": Rival("clarabel", clarabel),
    "proxqp": Rival("proxsuite", proxqp),
    # These two test a mean over the rows, and a norm of their own.
    "qpax": Rival("qpax", _batched(qpax_pair), False, True, 0.01, qpax_primal),
    "jaxopt": Rival("jaxopt", _batched(jaxopt_pair), False, True, 0.01, jaxopt_primal),
}
