"""Random QP families with known answers, and how often a solver finds them.

    python experiments/qp_families.py --count 200 --reference

Each feasible program is built from its solution: draw z, the active rows and their multipliers y,
then derive q = −Pz − A'y, l and u. Each infeasible one is built from its certificate.

Answers are judged on the program as drawn, in float64 and its own units (Clarabel solves it in
float64 too, whatever --dtype says). "absolute": primal residual, dual residual and gap are within
1e-6. "relative": every entry of them is within 1e-9 of the sum of the absolute terms in it
(float32: 1e-3 and 1e-5). Proofs of infeasibility are checked in rational arithmetic. "exact": what
should be zero is within the rounding of its terms, 500·(machine epsilon of dtype), and what should
be negative is so by more than that share. "loose": the same with 1e-6 (float32: 1e-3), or exact.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import jax
import numpy as np
import tyro
from qp_benchmark import clarabel_outcome
from qp_judge import proves_empty, proves_unbounded, residual_terms

import jaxmpc as jm
from jaxmpc.qp.problem import QPSolution

INF = np.inf


@dataclass(frozen=True)
class Instance:
    """A program, the status that is right, and its solution where it has one."""

    qp: jm.QP
    status: jm.Status
    z: np.ndarray | None = None
    y: np.ndarray | None = None


def from_solution(
    P: np.ndarray, A: np.ndarray, active: int, equal: int, rng: np.random.Generator,
    weak: int = 0, size: float = 1.0, z: np.ndarray | None = None, order: np.ndarray | None = None,
) -> Instance:  # fmt: skip
    """`active` rows with a push, `equal` equalities, `weak` rows that touch without a push; the
    others are inactive, one-sided, or free. They are drawn, or taken in this order; so is z."""
    m, n = A.shape
    z = size * rng.standard_normal(n) if z is None else z
    value = A @ z
    reach = np.linalg.norm(A, axis=1) * size + 1e-300
    l, u = value - rng.uniform(0.2, 2, m) * reach, value + rng.uniform(0.2, 2, m) * reach
    y = np.zeros(m)
    order = rng.permutation(m) if order is None else order
    pushed, equals, touching, rest = np.split(order, np.cumsum([active, equal, weak]))
    y[pushed] = rng.uniform(0.1, 3, active) * rng.choice([-1, 1], active)
    y[equals] = rng.uniform(0.1, 3, equal) * rng.choice([-1, 1], equal)
    above = np.zeros(m, bool)
    above[pushed] = y[pushed] > 0
    above[touching] = rng.uniform(size=weak) < 0.5
    met = np.concatenate([pushed, touching])
    u[met] = np.where(above[met], value[met], u[met])
    l[met] = np.where(above[met], l[met], value[met])
    l[equals] = u[equals] = value[equals]
    one_sided = rest[: len(rest) // 3]
    l[one_sided] = -INF
    u[rest[-(len(rest) // 6) :]] = INF
    half = pushed[: active // 2]
    l[half], u[half] = np.where(above[half], -INF, l[half]), np.where(above[half], u[half], INF)
    return Instance(jm.QP(P, -P @ z - A.T @ y, A, l, u), jm.Status.SOLVED, z, y)


def _sizes(rng: np.random.Generator) -> tuple[int, int]:
    n = int(rng.integers(2, 31))
    return n, int(rng.integers(n + 4, 3 * n + 8))


def _gram(n: int, rank: int, rng: np.random.Generator, left: Any = 1.0) -> np.ndarray:
    """left·F F'·left' for random F (n, rank). Multiplied in this order P is positive semidefinite
    to rounding of its own entries."""
    factor = np.dot(left, rng.standard_normal((n, rank)))
    return factor @ factor.T


def dense(rng: np.random.Generator) -> Instance:
    """Definite P, dense A."""
    n, m = _sizes(rng)
    P = _gram(n, n, rng) + 0.1 * np.eye(n)
    return from_solution(P, rng.standard_normal((m, n)), int(rng.integers(0, n)), 0, rng)


def sparse(rng: np.random.Generator) -> Instance:
    """Diagonal P, A with one entry in six and simple bounds."""
    n, m = _sizes(rng)
    A = rng.standard_normal((m - n // 2, n)) * (rng.uniform(size=(m - n // 2, n)) < 1 / 6)
    A = np.vstack([A, np.eye(n)[: n // 2]])
    touched = int((np.abs(A).sum(axis=1) > 0).sum())
    A = A[np.argsort(np.abs(A).sum(axis=1) == 0, kind="stable")]
    program = from_solution(
        np.diag(rng.uniform(0.01, 10, n)), A[:touched], min(touched, n) // 2, 0, rng
    )
    qp, zero = program.qp, m - touched
    whole = jm.QP(
        qp.P, qp.q, A, np.append(qp.l, np.full(zero, -1.0)), np.append(qp.u, np.ones(zero))
    )
    return Instance(whole, program.status, program.z, np.append(program.y, np.zeros(zero)))


def degenerate(rng: np.random.Generator) -> Instance:
    """More active rows than variables, dependent and doubled ones, and rows that only touch."""
    n, m = _sizes(rng)
    A = rng.standard_normal((m, n))
    A[m // 2 : m // 2 + m // 4] = A[: m // 4] * rng.uniform(0.5, 2, (m // 4, 1))
    P = _gram(n, n, rng) + 0.1 * np.eye(n)
    return from_solution(P, A, min(n + 2, m - 3), 0, rng, weak=min(3, m - min(n + 2, m - 3)))


def curved_badly(rng: np.random.Generator) -> Instance:
    """Eigenvalues of P from 1e-8 to 1."""
    n, m = _sizes(rng)
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    P = V * np.geomspace(1e-8, 1, n) @ V.T
    return from_solution((P + P.T) / 2, rng.standard_normal((m, n)), int(0.8 * n), 0, rng)


def scaled_badly(rng: np.random.Generator) -> Instance:
    """Rows and variables in units from 1e-4 to 1e4: condition of P up to 1e16, of A 1e8."""
    n, m = _sizes(rng)
    units, rows = 10 ** rng.uniform(-4, 4, n), 10 ** rng.uniform(-4, 4, m)
    program = from_solution(
        _gram(n, n, rng) + 0.1 * np.eye(n), rng.standard_normal((m, n)), n // 2, 0, rng
    )
    qp = program.qp
    other = jm.QP(
        units[:, None] * qp.P * units, units * qp.q, rows[:, None] * qp.A * units,
        rows * qp.l, rows * qp.u,
    )  # fmt: skip
    return Instance(other, program.status, program.z / units, program.y / rows)


def parallel_rows(rng: np.random.Generator) -> Instance:
    """Active rows that are almost parallel, condition of the active rows up to 1e8."""
    n, m = _sizes(rng)
    k = max(n // 2, 1)
    U = np.linalg.qr(rng.standard_normal((m, m)))[0][:, :n]
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    A = U * np.geomspace(1, 10 ** -rng.uniform(0, 8), n) @ V.T
    return from_solution(np.eye(n) + _gram(n, n, rng), A, k, 0, rng)


def equalities(rng: np.random.Generator) -> Instance:
    """Two thirds of the variables fixed by equalities."""
    n, m = _sizes(rng)
    P = _gram(n, n, rng) + 0.1 * np.eye(n)
    return from_solution(P, rng.standard_normal((m, n)), n // 4, (2 * n) // 3, rng)


def linear(rng: np.random.Generator) -> Instance:
    """P = 0, one vertex."""
    n, m = _sizes(rng)
    equal = int(rng.integers(0, n // 2 + 1))
    return from_solution(np.zeros((n, n)), rng.standard_normal((m, n)), n - equal, equal, rng)


def linear_degenerate(rng: np.random.Generator) -> Instance:
    """P = 0, more than n rows through the solution, three of them without a push."""
    n, m = _sizes(rng)
    active = min(n + 1, m - 3)
    return from_solution(np.zeros((n, n)), rng.standard_normal((m, n)), active, 0, rng, weak=3)


def flat(rng: np.random.Generator) -> Instance:
    """P of half rank; rows fix the rest."""
    n, m = _sizes(rng)
    P = _gram(n, n // 2, rng)
    return from_solution(P, rng.standard_normal((m, n)), n - int(rng.integers(0, n // 2)), 0, rng)


def large_units(rng: np.random.Generator) -> Instance:
    """Cost of size 1e4 and solution of size 1e2."""
    n, m = _sizes(rng)
    P = 1e4 * (_gram(n, n, rng) / n + 0.1 * np.eye(n))
    return from_solution(P, rng.standard_normal((m, n)), n // 2, 0, rng, size=1e2)


def _flat_directions(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A random P (n, n) of about half rank, and a basis (n, flat) of its null space."""
    rank = int(rng.integers(1, n // 2 + 1))
    V = np.linalg.qr(rng.standard_normal((n, n)))[0]
    factor = V[:, :rank] @ rng.standard_normal((rank, rank))
    return factor @ factor.T, V[:, rank:]


def rows_without_cost(rng: np.random.Generator) -> Instance:
    """Every row lies in the null space of P, some are equalities; where they do not span it, there
    are many solutions."""
    n, _ = _sizes(rng)
    P, basis = _flat_directions(n, rng)
    flat = basis.shape[1]
    m = int(rng.integers(1, 2 * n + 1))
    met = min(m, flat)
    equal = int(rng.integers(0, met + 1))
    A = rng.standard_normal((m, flat)) @ basis.T
    return from_solution(P, A, met - equal, equal, rng)


def some_rows_without_cost(rng: np.random.Generator) -> Instance:
    """Every second row lies in the null space of P; up to half of the rows are equalities. There
    may be many solutions."""
    n, _ = _sizes(rng)
    P, basis = _flat_directions(n, rng)
    m = int(rng.integers(1, 2 * n + 1))
    A = rng.standard_normal((m, n))
    A[::2] = A[::2] @ basis @ basis.T
    equal = int(rng.integers(0, min(m, n) // 2 + 1))
    return from_solution(P, A, int(rng.integers(0, min(m, n) - equal + 1)), equal, rng)


def equalities_without_cost(rng: np.random.Generator) -> Instance:
    """Equalities in the null space of P, as many as it has dimensions or fewer; few other rows."""
    n, _ = _sizes(rng)
    P, basis = _flat_directions(n, rng)
    flat = basis.shape[1]
    equal = int(rng.integers(1, flat + 1))
    A = np.vstack([rng.standard_normal((equal, flat)) @ basis.T, rng.standard_normal((4, n))])
    order = np.append(equal + np.arange(4), np.arange(equal))  # the other rows push
    return from_solution(P, A, 4, equal, rng, order=order)


def zero_weights(rng: np.random.Generator) -> Instance:
    """Diagonal P with zeros; rows that couple only the variables of weight zero, a third of them
    equalities, and bounds of some variables. There may be many solutions."""
    n, _ = _sizes(rng)
    flat = int(rng.integers(1, n))
    weights = rng.permutation(np.append(np.zeros(flat), rng.uniform(0.01, 10, n - flat)))
    rows = rng.standard_normal((int(rng.integers(1, flat + 3)), n)) * (weights == 0)
    A = np.vstack([rows, np.eye(n)[rng.uniform(size=n) < rng.uniform()]])
    equal = min(len(rows), flat) // 3
    active = min(len(rows), flat) - equal
    return from_solution(np.diag(weights), A, active, equal, rng, order=np.arange(len(A)))


def heavy_slacks(rng: np.random.Generator) -> Instance:
    """Soft rows Cx − s with slack variables s of weight 1e5, all of them paid; half of x without
    weight, some of it bounded. There may be many solutions."""
    n, slacks = int(rng.integers(4, 21)), int(rng.integers(2, 11))
    weights = np.where(rng.uniform(size=n) < 0.5, 0.0, rng.uniform(0.01, 1, n))
    P = np.diag(np.append(weights, np.full(slacks, 1e5)))
    C = np.hstack([rng.standard_normal((slacks, n)), -np.eye(slacks)])
    bounded = np.eye(n, n + slacks)[rng.uniform(size=n) < rng.uniform()]
    z = np.append(rng.standard_normal(n), 1e-5 * rng.standard_normal(slacks))
    pushed = slacks + int(rng.integers(0, len(bounded) + 1))  # the soft rows first
    order = np.arange(slacks + len(bounded))
    return from_solution(P, np.vstack([C, bounded]), pushed, 0, rng, z=z, order=order)


def jerk_chain(rng: np.random.Generator) -> Instance:
    """Speeds are sums of sums of jerks, which have no weight and half of them are at their small
    limits; a goal for the distance with a slack of weight 2e5, whose multiplier is up to 2e3. Only
    speeds have a linear cost."""
    speeds, limit = int(rng.integers(4, 13)), 3.5e-4
    jerks = speeds + 2  # the last two end at rest
    n = speeds + jerks + 1
    chain = np.zeros((jerks + 1, n))
    chain[:jerks, speeds:-1] = np.eye(jerks)
    for lag, factor in ((0, -1), (1, 2), (2, -1)):
        k = np.arange(speeds)
        chain[k + lag, k] += factor
    chain[-1, :speeds], chain[-1, -1] = 10 ** rng.uniform(-4, -2), 1
    pushed, sign = rng.uniform(size=jerks) < 0.5, rng.choice([-1, 1], jerks)
    jerk = limit * np.where(pushed, sign, rng.uniform(-0.9, 0.9, jerks))
    v = list(rng.uniform(-0.04, 0.04, 2))
    for k in range(2, speeds):
        v.append(jerk[k] + 2 * v[-1] - v[-2])
    slack = rng.choice([-1, 1]) * 10 ** rng.uniform(-5, -2)
    z = np.concatenate([v, jerk, [slack]])
    weights = np.concatenate([np.linspace(0.1, 1, speeds), np.zeros(jerks), [2e5]])
    push = np.where(pushed, sign * 10 ** rng.uniform(-1, 3, jerks), 0.0)
    y = np.concatenate([np.zeros(speeds), push, [0.0], -push, [-2e5 * slack]])
    A = np.vstack([np.eye(n), chain])
    box = np.concatenate([np.full(speeds, 2 * np.max(np.abs(v))), np.full(jerks, limit), [1e4]])
    l, u = np.append(-box, chain @ z), np.append(box, chain @ z)
    q = -weights * z - A.T @ y
    q[speeds:] = 0.0  # but for rounding
    return Instance(jm.QP(np.diag(weights), q, A, l, u), jm.Status.SOLVED, z, y)


def low_rank(rng: np.random.Generator) -> Instance:
    """P = B'B for B of few rows and whole numbers, rows that span its null space, some of them
    equalities, and a box."""
    n, _ = _sizes(rng)
    rank = int(rng.integers(1, max(n // 3, 1) + 1))
    B = rng.integers(-2, 3, (rank, n)).astype(float)
    basis = np.linalg.svd(B)[2][np.linalg.matrix_rank(B) :]
    A = np.vstack([basis, rng.standard_normal((3, n)), np.eye(n)])
    order = np.append(rng.permutation(len(basis)), len(basis) + rng.permutation(n + 3))
    equal = int(rng.integers(0, len(basis) + 1))
    return from_solution(B.T @ B, A, len(basis) - equal, equal, rng, order=order)


def nearly_parallel(rng: np.random.Generator) -> Instance:
    """Two active rows ±a − εb at an angle 2ε from 2e-3 to 2e-6, whose multipliers of up to 1e10
    cancel but for a push t/ε along b, of up to 1e5."""
    n, m = _sizes(rng)
    a, b = np.linalg.qr(rng.standard_normal((n, 2)))[0].T
    angle = 10 ** rng.uniform(-6, -3)
    far = min(1.0, 2e10 * angle**2) / angle
    across = np.eye(n) - np.outer(b, b)
    P = np.outer(b, b) + across @ (_gram(n, n, rng) + 0.1 * np.eye(n)) @ across
    pair = np.array([a - angle * b, -a - angle * b])
    z = far * b + rng.standard_normal(n)
    A = np.vstack([pair, rng.standard_normal((m - 2, n))])
    value, reach = A @ z, np.linalg.norm(A, axis=1) * (1 + far)
    l, u = value - rng.uniform(0.2, 2, m) * reach, value + rng.uniform(0.2, 2, m) * reach
    l[:2], u[:2], y = -INF, value[:2], np.zeros(m)
    y[:2] = far / (2 * angle) * rng.uniform(0.9, 1.0)
    P = (P + P.T) / 2
    return Instance(jm.QP(P, -P @ z - A.T @ y, A, l, u), jm.Status.SOLVED, z, y)


def far_linear(rng: np.random.Generator) -> Instance:
    """P = 0, one vertex, at a distance of 1e3 to 1e8."""
    n, m = _sizes(rng)
    A = rng.standard_normal((m, n))
    return from_solution(np.zeros((n, n)), A, n, 0, rng, size=10 ** rng.uniform(3, 8))


def empty(rng: np.random.Generator) -> Instance:
    """No feasible point: rows combined by a positive y give 0'z ≤ −gap; no box needed."""
    n, m = _sizes(rng)
    k = int(rng.integers(2, n + 2))
    A, z = rng.standard_normal((m, n)), rng.standard_normal(n)
    weights = rng.uniform(0.2, 2, k)
    A[k - 1] = -weights[: k - 1] @ A[: k - 1] / weights[k - 1]
    value = A @ z
    l, u = value - rng.uniform(0.2, 2, m), value + rng.uniform(0.2, 2, m)
    l[:k], u[:k] = -INF, value[:k]
    u[k - 1] -= 10 ** rng.uniform(-2, 0.5)
    order = rng.permutation(m)
    P = _gram(n, int(rng.integers(0, n + 1)), rng)
    qp = jm.QP(P, rng.standard_normal(n), A[order], l[order], u[order])
    return Instance(qp, jm.Status.PRIMAL_INFEASIBLE)


def empty_in_a_box(rng: np.random.Generator) -> Instance:
    """A half-space that misses a box."""
    n, m = _sizes(rng)
    A = np.vstack([np.eye(n), rng.standard_normal((m - n, n))])
    l, u = np.full(m, -1.0), np.ones(m)
    reach = np.abs(A[n]).sum()
    l[n], u[n] = reach * (1 + 10 ** rng.uniform(-3, 0)), INF
    l[n + 1 :], u[n + 1 :] = -INF, rng.uniform(0, 2, m - n - 1)
    qp = jm.QP(_gram(n, n, rng) + 0.1 * np.eye(n), rng.standard_normal(n), A, l, u)
    return Instance(qp, jm.Status.PRIMAL_INFEASIBLE)


def unbounded(rng: np.random.Generator) -> Instance:
    """A ray d with Pd = 0, q'd < 0 that no row stops."""
    n, m = _sizes(rng)
    d = rng.standard_normal(n)
    d /= np.linalg.norm(d)
    off = np.eye(n) - np.outer(d, d)
    P = _gram(n, int(rng.integers(0, n)), rng, off)
    A, z = rng.standard_normal((m, n)), rng.standard_normal(n)
    A[: m // 3] = A[: m // 3] @ off  # rows along the ray, bounded on both sides
    value = A @ z
    l, u = value - rng.uniform(0.2, 2, m), value + rng.uniform(0.2, 2, m)
    rest = np.arange(m) >= m // 3
    l[rest & (A @ d < 0)], u[rest & (A @ d > 0)] = -INF, INF
    q = off @ rng.standard_normal(n) - rng.uniform(0.3, 2) * d
    return Instance(jm.QP((P + P.T) / 2, q, A, l, u), jm.Status.DUAL_INFEASIBLE)


FAMILIES: dict[str, Callable[[np.random.Generator], Instance]] = {
    f.__name__: f
    for f in (
        dense, sparse, degenerate, curved_badly, scaled_badly, parallel_rows, equalities, linear,
        linear_degenerate, flat, large_units, rows_without_cost, some_rows_without_cost,
        equalities_without_cost, zero_weights, heavy_slacks, jerk_chain, low_rank,
        nearly_parallel, far_linear, empty, empty_in_a_box, unbounded,
    )
}  # fmt: skip


def draw(family: str, seed: int) -> Instance:
    """One member of a family; the same for the same seed."""
    return FAMILIES[family](np.random.default_rng([seed, *family.encode()]))


@dataclass(frozen=True)
class Settings:
    """count: programs a family, from seed on. families: which (none: all). iterations,
    newton_steps: of jaxmpc's solver, its defaults; dtype: of the data. reference: run Clarabel
    too."""

    count: int = 1000
    seed: int = 0
    families: tuple[str, ...] = ()
    iterations: int = jm.ADMM().iterations
    newton_steps: int | None = None  # None: the default
    dtype: Literal["float64", "float32"] = "float64"
    reference: bool = False


@dataclass(frozen=True)
class Answer:
    """What a solver says of one program; y and z are its proof where it says infeasible."""

    status: jm.Status
    z: np.ndarray
    y: np.ndarray


def padded(qp: jm.QP, n: int = 30, m: int = 100) -> jm.QP:
    """The same program with n variables and m + n rows: added variables are fixed to 0 by a row
    of their own and as curved as the others are on average; added rows are free."""
    rows, size = qp.A.shape
    added = np.arange(size, n)
    P, A = np.zeros((n, n)), np.zeros((m + n, n))
    l, u = np.full(m + n, -INF), np.full(m + n, INF)
    P[:size, :size], A[:rows, :size], l[:rows], u[:rows] = qp.P, qp.A, qp.l, qp.u
    P[added, added] = np.trace(qp.P) / size
    A[m + added, added], l[m + added], u[m + added] = 1.0, 0.0, 0.0
    return jm.QP(P, np.append(qp.q, np.zeros(n - size)), A, l, u)


def ours(solve: Callable[[jm.QP], QPSolution], qps: list[jm.QP], s: Settings) -> list[Answer]:
    """jaxmpc's answers, 250 programs at a time; the last batch is filled up with repetitions."""
    answers, batch = [], min(250, len(qps))
    for first in range(0, len(qps), batch):
        part = [qps[i % len(qps)] for i in range(first, first + batch)]
        stacked = jax.tree.map(lambda *v: np.stack(v).astype(s.dtype), *map(padded, part))
        solutions = jax.tree.map(np.asarray, solve(stacked))
        for i, qp in enumerate(part):
            solution, (m, n) = jax.tree.map(lambda v, i=i: v[i], solutions), qp.A.shape
            status = jm.Status(int(solution.status))
            z = solution.ray if status == jm.Status.DUAL_INFEASIBLE else solution.z
            y = solution.certificate if status == jm.Status.PRIMAL_INFEASIBLE else solution.y
            answers.append(Answer(status, z[:n].astype(float), y[:m].astype(float)))
    return answers[: len(qps)]


def clarabel(qp: jm.QP) -> Answer:
    """Clarabel's answer; a status other than three plain ones counts as ITERATION_LIMIT."""
    z, y, name = clarabel_outcome(qp)()
    names = dict(Solved=1, PrimalInfeasible=3, DualInfeasible=5)
    return Answer(jm.Status(names.get(name, 7)), z, y)


def quality(instance: Instance, answer: Answer, dtype: str) -> tuple[float, float, float]:
    """Absolute error, whether that and the relative one are small; of a proof: 0, exact, loose."""
    qp, double = instance.qp, dtype == "float64"
    if instance.status == jm.Status.SOLVED:
        terms = residual_terms(qp, answer.z, answer.y)
        error = max(np.abs(value).max(initial=0.0) for value, _ in terms)
        near = all(np.all(np.abs(v) <= (1e-9 if double else 1e-5) * size) for v, size in terms)
        return error, error <= (1e-6 if double else 1e-3), near
    if answer.status != instance.status:
        return 0.0, False, False
    empty = instance.status == jm.Status.PRIMAL_INFEASIBLE
    check, proof = (proves_empty, answer.y) if empty else (proves_unbounded, answer.z)
    exact = check(qp, proof, 500 * float(np.finfo(dtype).eps))
    return 0.0, exact, exact or check(qp, proof, 1e-6 if double else 1e-3)


def line(family: str, name: str, instances: list[Instance], answers: list[Answer], s: Settings):
    """One row of the table; ends with the statuses that are wrong and the first seed of each."""
    right = [i.status == a.status for i, a in zip(instances, answers, strict=True)]
    rows = [quality(i, a, s.dtype) for i, a in zip(instances, answers, strict=True)]
    error, first, second = (np.array(column) for column in zip(*rows, strict=True))
    wrong: dict[str, list[int]] = {}
    for k, (fine, a) in enumerate(zip(right, answers, strict=True)):
        if not fine:
            wrong.setdefault(a.status.name, []).append(s.seed + k)
    median = f"{np.median(error):.0e}" if instances[0].status == jm.Status.SOLVED else ""
    shares = "".join(f"{np.mean(v):10.1%}" for v in (right, first, second))
    remarks = ", ".join(f"{k} {len(v)} (seed {v[0]})" for k, v in wrong.items())
    print(f"{family:18}{name:9}{shares}{median:>9}  {remarks}", flush=True)


def run(s: Settings) -> None:
    """Draw, solve, judge; a row a family and solver."""
    jax.config.update("jax_enable_x64", s.dtype == "float64")
    solver = jm.ADMM(s.iterations, newton_steps=s.newton_steps)
    solve = jax.jit(jax.vmap(lambda qp: jm.solve_qp(qp, solver)))
    print(
        f"{s.count} a family, jaxmpc in {s.dtype}: {s.iterations} steps, "
        f"{solver.most_newton_steps()} Newton steps at most"
    )
    for status, columns in (
        (jm.Status.SOLVED, ("right", "absolute", "relative", "median")),
        (jm.Status.PRIMAL_INFEASIBLE, ("right", "exact", "loose", "")),
        (jm.Status.DUAL_INFEASIBLE, ("right", "exact", "loose", "")),
    ):
        chosen = [f for f in s.families or FAMILIES if draw(f, 0).status == status]
        if chosen:
            heads = "".join(f"{c:>10}" for c in columns[:3])
            print(f"\n{status.name:27}{heads}{columns[3]:>9}  wrong statuses")
        for family in chosen:
            instances = [draw(family, s.seed + k) for k in range(s.count)]
            line(family, "jaxmpc", instances, ours(solve, [i.qp for i in instances], s), s)
            if s.reference:
                line(family, "clarabel", instances, [clarabel(i.qp) for i in instances], s)


if __name__ == "__main__":
    run(tyro.cli(Settings, description=__doc__))
