"""The hypotheses under which a terminal set and cost make MPC recursively feasible and stable."""

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals, as_weight, host_array
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.pytrees import record
from jaxmpc.sets.any_set import translated, unit_half_spaces
from jaxmpc.sets.box import Box
from jaxmpc.sets.control_invariant import largest_cut
from jaxmpc.sets.disturbance import disturbance_set, largest_norm, supports
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.geometry import unit_rows
from jaxmpc.sets.invariant import contraction
from jaxmpc.sets.lp import Flat, Program, affine_hull, bound, framed, maximise, safe_extent
from jaxmpc.sets.one_step import one_step
from jaxmpc.sets.polytope import Polytope
from jaxmpc.systems.riccati import least_reached, lqr
from jaxmpc.systems.system import LinearSystem, host_matrices

# A limit counts as kept if it is exceeded by no more than this, relative to the set's extent
# along the row (to |P| for matrix inequalities). Sets that touch a limit exceed it by rounding.
_TOUCH = 1e-9
_EXACT_PRODUCTS = 200_000  # a certificate with no more products is also evaluated in rationals
_DETECTABLE = 1e-10  # as in `lqr`


@dataclass(frozen=True)
class Check:
    """One hypothesis, with the result of its check.

    holds: True, False, or None for undecided.
    margin: by how much, in `unit`; negative if it fails, None if there is no number.
    theorems: which of the two theorems (1, 3) need it.
    """

    name: str
    holds: bool | None
    margin: float | None
    unit: str
    sentence: str
    theorems: tuple[int, ...]


@record
class TerminalReport:
    """What `verify_terminal` found: `report["Lyapunov inequality"]` is one check, `str` a table.

    K: (m, n), the law that was checked, or None.
    certificate: (rows, rows) M >= 0 with M H = H (A+BK) and M h <= factor h for a terminal set
        {H x <= h} with rows of norm 1, or None.
    factor: the set is mapped into itself scaled by this (an ellipsoid: into level * factor).
    exact_factor: a bound of it from the same certificate in rational arithmetic, or None.
    """

    checks: tuple[Check, ...]
    K: np.ndarray | None
    certificate: np.ndarray | None
    factor: float | None
    exact_factor: Fraction | None

    def __getitem__(self, name: str) -> Check:
        """Return the check of this name."""
        for check in self.checks:
            if check.name == name:
                return check
        fail("name", f"{name!r} is no check", f"Use one of {[c.name for c in self.checks]}")

    @property
    def recursive_feasibility(self) -> bool | None:
        """Return whether Theorem 1 applies: all its hypotheses hold (None: some are undecided, none
        fails)."""
        return _all(check.holds for check in self.checks if 1 in check.theorems)

    @property
    def stability(self) -> bool | None:
        """Return whether Theorem 3 applies: all its hypotheses hold (None: some are undecided, none
        fails)."""
        return _all(check.holds for check in self.checks if 3 in check.theorems)

    def __str__(self) -> str:
        words = {True: "yes", False: "NO", None: "?"}
        width = max(len(check.name) for check in self.checks)
        lines = []
        for number, title, holds in (
            (1, "recursive feasibility", self.recursive_feasibility),
            (3, "asymptotic stability", self.stability),
        ):
            missing = [c.name for c in self.checks if number in c.theorems and not c.holds]
            verdict = "applies" if holds else f"does not apply: {', '.join(missing)}"
            lines.append(f"Theorem {number} ({title}) {verdict}.")
        for check in self.checks:
            margin = "" if check.margin is None else f"{check.margin:.6g} {check.unit}"
            needed = ",".join(map(str, check.theorems))
            lines.append(
                f"{words[check.holds]:>3}  {check.name:<{width}}  {needed:<3}  {margin}".rstrip()
            )
            lines.append(f"     {check.sentence}")
        return "\n".join(lines)


def verify_terminal(
    system: LinearSystem,
    Q: Reals,
    R: Reals,
    terminal_cost: Reals | None,
    terminal_set: Box | Polytope | Ellipsoid | None,
    states: Box | Polytope | None,
    inputs: Box | Polytope | None,
    K: Reals | None = None,
    disturbance: Box | Polytope | None = None,
) -> TerminalReport:
    """Check each hypothesis of the theorems on recursive feasibility (1) and stability (3).

    Theorem 1. If states X and inputs U are convex and compact and the terminal set X_f within X
    is control invariant, a feasible MPC problem stays feasible along its own closed loop.
    Theorem 3. If in addition, on X_f, u = K x keeps x in X_f and u in U, and
    (A+BK)'P(A+BK) - P + Q + K'RK <= 0, the origin is asymptotically stable on X_N.
    Both are stated for w = 0. With a disturbance, robust invariance is checked.

    Arguments:
        system: x+ = A x + B u + c.
        Q, R: (n, n), (m, m), symmetric weights of x'Qx + u'Ru.
        terminal_cost: P (n, n), symmetric, of x_N'P x_N; None for the P of `lqr`.
        terminal_set: X_f. None: X takes its place, since x_N is free, so that the problem of
            horizon N is that of horizon N - 1 with terminal set X; Theorem 1 then requires X
            itself to be control invariant, and Theorem 3 is never claimed.
        states, inputs: X and U; None for no limit.
        K: (m, n), of u = K x; None for that of `lqr`.
        disturbance: bounded set of w that holds the origin, or None.

    The certificates.
    - {H x <= h} is invariant under K if there is M >= 0 with M H = H (A+BK) and
      M h + H c + max Hw <= factor h, factor <= 1 (Farkas). M comes from LPs; its residual
      E = M H - H (A+BK) is recomputed and its worst |E| |x| over the set charged to the bound.
      Small certificates are evaluated a second time in rational arithmetic.
    - x'P_f x <= level is invariant if (A+BK)'P_f (A+BK) <= factor P_f; with w and c, if
      sqrt(factor) sqrt(level) + max |w + c|_P <= sqrt(level), which is sufficient only.
    - If K fails, control invariance alone: X_f within Pre(X_f), row by row.
    A limit counts as kept if it is exceeded by at most 1e-9 of the set's extent. NumPy in float64;
    not traceable.

    Raises ValueError for wrong shapes, asymmetric weights or empty sets; a hypothesis that
    fails is an answer, not an error.

    Source: Rawlings, Mayne & Diehl 2017, Model Predictive Control, section 2.4; Bitsoris 1988,
    Int. J. Control 47(6), for the certificate; Hautus 1970, for detectability.
    """
    require_kind("system", system, LinearSystem)
    system.validate()
    n, m = system.n, system.m
    A, B, c = host_matrices(system)
    Q, R = _symmetric("Q", Q, n), _symmetric("R", R, m)
    X, U = unit_half_spaces("states", states, n), unit_half_spaces("inputs", inputs, m)
    law, trouble = None, ""
    if K is None or terminal_cost is None:
        try:
            law = lqr(system, Q, R)
        except ValueError as error:
            trouble = f"lqr has no answer ({error})"
    if K is not None:
        require_shape("K", K, (m, n), "Give u = Kx one row an input, one column a state")
        require_finite("K", K)
    gain = None
    if K is not None or law is not None:
        gain = host_array("K", law.K if K is None and law is not None else K)
    P: np.ndarray | None = None
    if terminal_cost is not None:
        P = _symmetric("terminal_cost", terminal_cost, n)
    elif law is not None:
        P = host_array("P", law.P)
    W = disturbance_set(disturbance, n)

    role = ""
    if isinstance(terminal_set, Ellipsoid):
        terminal_set.validate("terminal_set", n)
        P_f = host_array("terminal_set.P", terminal_set.P)
        level = float(host_array("terminal_set.level", terminal_set.level))
        X_f: _Set = _Ellipse((P_f + P_f.T) / 2, level)
    else:
        if terminal_set is None:
            role = " (there is no terminal set: X in its role, at horizon N - 1)"
        X_f = _Rows(
            *(X if terminal_set is None else unit_half_spaces("terminal_set", terminal_set, n))
        )

    checks = [_compact("states", "X", X), _compact("inputs", "U", U)]
    checks.append(
        _within("terminal set within states", system.state_labels, X, np.eye(n), X_f, (1, 3), role)
    )
    closed = None if gain is None else A + B @ gain
    no_law = f"there is no K to check: {trouble}"
    certificate = factor = exact = None
    if gain is None or closed is None:
        kept = Check("invariance under K", None, None, "", no_law, (3,))
        admissible = Check("inputs of K admissible", None, None, "", no_law, (3,))
    else:
        admissible = _within("inputs of K admissible", system.input_labels, U, gain, X_f, (3,))
        if isinstance(X_f, _Ellipse):
            kept, factor, exact = _ellipse_kept(X_f, closed, c, W, (A, B, gain))
        else:
            kept, certificate, factor, exact = _rows_kept(X_f, closed, c, W, (A, B, gain))
    checks += [_control_invariance(system, X_f, inputs, disturbance, kept, admissible, role)]
    checks += [kept, admissible, _check_lyapunov(closed, gain, P, Q, R, no_law)]
    checks += _weights(A, Q, R, P, trouble)
    shift = float(np.abs(c).max(initial=0.0))
    checks.append(
        Check(
            "origin is an equilibrium", shift == 0, 0.0 - shift, "in x a step",
            "c = 0." if shift == 0 else f"c moves the origin by up to {shift:.3g} in a step: "
            "write the system in deviations from its equilibrium.", (3,),
        )
    )  # fmt: skip
    checks.append(_origin_inside(X_f))
    if terminal_set is None:
        checks.append(
            Check(
                "terminal cost where x_N is free", None, None, "",
                "x_N may leave X, where the Lyapunov inequality and K in U do not hold: Theorem 3 "
                "requires a terminal set.", (3,),
            )
        )  # fmt: skip
    return TerminalReport(tuple(checks), gain, certificate, factor, exact)


@record
class _Rows:
    """{G x <= g}, rows of norm 1; no rows for all of R^n."""

    G: np.ndarray
    g: np.ndarray

    def top(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (upper bounds of max row x, M with M G = rows but for rounding); inf if
        unbounded."""
        bounds, M = np.zeros(len(rows)), np.zeros((len(rows), len(self.g)))
        program = Program(self.G, self.g)
        for i, row in enumerate(rows):
            if not row.any():
                continue
            best = program.maximise(row) if len(self.g) else None
            if best is None or best.y is None:
                bounds[i] = np.inf
                continue
            M[i] = best.y
            bounds[i] = bound(row, best.y, self.G, self.g, self.reach)
        return bounds, M

    @cached_property
    def reach(self) -> np.ndarray:
        """Return the bounds of |x_i| over the set, with a margin for the LP's error; inf if there
        is none."""
        if not len(self.g):
            return np.full(self.G.shape[1], np.inf)
        return safe_extent(self.G, self.g)

    def width(self, rows: np.ndarray | None = None) -> np.ndarray:
        """Return how far the set reaches along each row (None: its own) from a point inside; where
        that is rounding, as in a flat set, the size of the row's terms."""
        center = Program(self.G, self.g).margin()[0]
        tops, rows = (self.g, self.G) if rows is None else (self.top(rows)[0], rows)
        width = np.maximum(tops - rows @ center, 0.0)
        size = np.abs(tops) + np.abs(rows) @ np.where(np.isfinite(self.reach), self.reach, 0.0)
        return np.where(width > _TOUCH * size, width, np.where(size > 1e-280, size, 1.0))


@record
class _Ellipse:
    """{x'P x <= level}."""

    P: np.ndarray
    level: float

    def top(self, rows: np.ndarray) -> tuple[np.ndarray, None]:
        """Return (max row x, None)."""
        squares = np.einsum("ij,ij->i", rows, np.linalg.solve(self.P, rows.T).T)
        return np.sqrt(self.level * squares), None

    def width(self, rows: np.ndarray) -> np.ndarray:
        """Return how far the set reaches along each row from its center."""
        width = self.top(rows)[0]
        return np.where(width > 0, width, 1.0)


_Set = _Rows | _Ellipse


def _compact(name: str, letter: str, rows: tuple[np.ndarray, np.ndarray]) -> Check:
    """Check that the set of these rows is bounded."""
    reach = _Rows(*rows).reach
    holds = bool(np.isfinite(reach).all())
    sentence = f"{letter} is convex, as every set of linear rows is, and "
    if holds:
        sentence += f"bounded: no coordinate exceeds {reach.max() / (1 + 1e-6):.6g}."
    else:
        free = ", ".join(str(i + 1) for i in np.flatnonzero(np.isinf(reach)))
        sentence += (
            f"unbounded in coordinate {free}. The theorem as stated does not apply; its shifted "
            "plan uses convexity and compactness nowhere, so the conclusion stands if an optimal "
            "plan exists (it does for Q >= 0, R > 0, P >= 0)."
        )
    margin = float(reach.max() / (1 + 1e-6)) if holds else -np.inf
    return Check(f"{name} compact", holds, margin, "largest coordinate", sentence, (1,))


def _within(
    name: str, labels: tuple[str, ...], rows: tuple[np.ndarray, np.ndarray], output: np.ndarray,
    X_f: _Set, theorems: tuple[int, ...], role: str = "",
) -> Check:  # fmt: skip
    """Check that `output` x lies within the rows for all x in X_f; the margin is a distance from a
    row's hyperplane."""
    (G, g), unit = rows, "distance to the limit"
    if not len(g):
        return Check(name, True, np.inf, unit, f"Nothing limits {', '.join(labels)}.", theorems)
    tops = X_f.top(G @ output)[0]
    slack = g - tops
    worst = int(np.argmin(slack))
    terms = [(f"{v:.6g} " if v != 1 else "") + labels[j] for j, v in enumerate(G[worst]) if v]
    limit = f"{' + '.join(terms)} <= {g[worst]:.6g}"
    if np.isinf(tops[worst]):
        sentence = f"The set is unbounded, and so is the violation of {limit}."
        return Check(name, False, -np.inf, unit, sentence, theorems)
    allowed = _TOUCH * np.maximum(np.abs(g), X_f.width(G @ output))
    reached = f"The tightest limit, {limit}, is reached up to {tops[worst]:.6g} on the terminal set"
    return Check(
        name, bool((slack >= -allowed).all()), float(slack[worst]), unit, f"{reached}{role}.",
        theorems,
    )  # fmt: skip


def _rows_kept(
    X_f: _Rows, closed: np.ndarray, c: np.ndarray, W: Any,
    law: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[Check, np.ndarray | None, float | None, Fraction | None]:  # fmt: skip
    """Check invariance of {G x <= g} under u = K x, by M >= 0 with M G = G closed."""
    name, unit, G, g = "invariance under K", "of the extent", X_f.G, X_f.g
    if not len(g):
        sentence = "All of R^n is invariant."
        return Check(name, True, np.inf, unit, sentence, (3,)), None, None, None
    images, M = X_f.top(G @ closed)
    if np.isinf(images).any():
        sentence = (
            f"On this unbounded set (A+BK) x violates row {np.argmax(images) + 1} without limit."
        )
        return Check(name, False, -np.inf, unit, sentence, (3,)), None, None, None
    reached = images + G @ c + supports(W, G)
    residual = float(np.abs(M @ G - G @ closed).max())
    slack = (g - reached) / X_f.width()
    worst = int(np.argmin(slack))
    holds = bool(slack[worst] >= -_TOUCH)
    factor = float((reached / g).max()) if g.min() > 0 else None
    exact = None
    if factor is not None and (W is None or isinstance(W, Box)):
        exact = _exact_factor(M, X_f, c, W, law)
    sentence = f"M >= 0 with M H = H(A+BK) up to {residual:.1e}"
    if factor is not None:
        sentence += f" and M h{'' if W is None else ' + max Hw'} <= {factor:.9g} h"
    sentence += f"; the tightest row, {worst + 1}, is reached to {reached[worst]:.9g} of "
    sentence += f"{g[worst]:.9g}."
    if exact is not None and exact <= 1:
        sentence += " In rational arithmetic the factor is at most 1."
    elif exact is not None and holds:
        sentence += f" In rational arithmetic the factor exceeds 1 by {float(exact - 1):.1e}."
    return Check(name, holds, float(slack[worst]), unit, sentence, (3,)), M, factor, exact


def _exact_factor(
    M: np.ndarray, X_f: _Rows, c: np.ndarray, W: Box | None,
    law: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> Fraction | None:  # fmt: skip
    """Return max_i (M h + |M H - H(A+BK)| |x| + H c + max Hw)_i / h_i, without rounding.

    Where the rows that M uses are n and independent, their multipliers are computed again from
    M H = H(A+BK), so that no residual is left. |x| is bounded by LPs and a margin. None where the
    set is too large for it, or unbounded where a residual is left.
    """
    H, h, n = X_f.G, X_f.g, len(c)
    if len(h) ** 2 * n > _EXACT_PRODUCTS:
        return None
    A = _closed_loop_fractions(law)
    rows, limits, drift = _fractions(H), _fractions(h), _fractions(c)
    reach = [_fractions(v) if np.isfinite(v) else None for v in X_f.reach]
    lower, upper = (None, None) if W is None else (_fractions(W.lower), _fractions(W.upper))
    factor = None
    for i, row in enumerate(rows):
        image = [_dot(row, column) for column in zip(*A, strict=True)]
        used = np.flatnonzero(M[i] > 0)
        y = [Fraction(float(M[i, j])) for j in used]
        if len(used) == n:
            solved = _gauss_jordan(
                [list(column) for column in zip(*(rows[j] for j in used), strict=True)], image
            )
            y = solved if solved is not None and min(solved) >= 0 else y
        bound = _dot(y, [limits[j] for j in used]) + _dot(row, drift)
        for k in range(n):
            left = image[k] - _dot(y, [rows[j][k] for j in used])
            farthest = reach[k] if left else Fraction(0)
            if farthest is None:
                return None
            bound += abs(left) * farthest
        if lower is not None and upper is not None:
            bound += sum(max(r * lo, r * hi) for r, lo, hi in zip(row, lower, upper, strict=True))
        ratio = bound / limits[i]
        factor = ratio if factor is None else max(factor, ratio)
    return factor


def _ellipse_kept(
    X_f: _Ellipse, closed: np.ndarray, c: np.ndarray, W: Any,
    law: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> tuple[Check, float, Fraction | None]:  # fmt: skip
    """Check invariance of {x'P x <= level} under u = K x."""
    name, P = "invariance under K", X_f.P
    factor = contraction(closed, P)
    least = float(np.linalg.eigvalsh(P - closed.T @ P @ closed)[0])
    sentence = (
        f"(A+BK)'P_f(A+BK) <= {factor:.9g} P_f; the least eigenvalue of P_f - (A+BK)'P_f(A+BK) "
        f"is {least:.3g}"
    )
    if W is None and not c.any():
        if len(P) <= 8:
            A, F = _closed_loop_fractions(law), _fractions(P)
            FA = [[_dot(row, column) for column in zip(*A, strict=True)] for row in F]
            D = [
                [F[i][j] - _dot([a[i] for a in A], [r[j] for r in FA]) for j in range(len(F))]
                for i in range(len(F))
            ]
            if _positive(D):
                sentence += ", and the matrix is positive definite in rational arithmetic"
        return (
            Check(name, factor <= 1 + _TOUCH, 1 - factor, "of the level", sentence + ".", (3,)),
            factor,
            None,
        )
    w_norm = float(np.sqrt(c @ P @ c)) if W is None else largest_norm(translated(W, c), P)
    radius = np.sqrt(X_f.level)
    slack = float(1 - np.sqrt(factor) - w_norm / radius)
    sentence += (
        f"; with |w + c|_P <= {w_norm:.6g} the image reaches at most {1 - slack:.9g} of the radius"
    )
    holds = True if slack >= -_TOUCH else None if factor <= 1 else False
    sentence += "." if holds else ", a bound that is sufficient only."
    return Check(name, holds, slack, "of the radius", sentence, (3,)), factor, None


def _control_invariance(
    system: LinearSystem, X_f: _Set, inputs: Any, disturbance: Any, kept: Check,
    admissible: Check, role: str,
) -> Check:  # fmt: skip
    """Check control invariance of X_f: by the law K, or by one step of the predecessor."""
    name, unit = "control invariance", "of the extent"
    if kept.holds and admissible.holds:
        sentence = f"u = K x is admissible and keeps the state in the terminal set{role}."
        return Check(name, True, kept.margin, kept.unit, sentence, (1,))
    if isinstance(X_f, _Ellipse):
        sentence = "K does not show it, and whether another law does is not decided for ellipsoids."
        return Check(name, None, None, unit, sentence, (1,))
    if not len(X_f.g):
        return Check(name, True, np.inf, unit, f"All of R^n is invariant{role}.", (1,))
    body = Polytope(X_f.G, X_f.g)
    try:
        usable = bool(np.isfinite(X_f.reach).all()) and framed("X_f", X_f.G, X_f.g).bounded
    except Flat:
        usable = False
    if not usable:
        sentence = f"K does not show it, and the set is unbounded or flat{role}: not decided."
        return Check(name, None, None, unit, sentence, (1,))
    before = one_step(system, inputs, disturbance).back(body)
    if before.is_empty():
        sentence = f"From no state can an admissible input reach the terminal set{role}."
        return Check(name, False, -np.inf, unit, sentence, (1,))
    cut = largest_cut(before, body)
    if cut <= _TOUCH:
        sentence = (
            f"K does not show it, but every state of the set has an admissible input that keeps "
            f"it in: no row of Pre(X_f) cuts X_f (upper bounds from LPs){role}."
        )
        return Check(name, True, -cut, unit, sentence, (1,))
    H, h = unit_rows(before.H, before.h)
    tops = [maximise(row, X_f.G, X_f.g) for row in H]
    worst = int(np.argmax([top.value - limit for top, limit in zip(tops, h, strict=True)]))
    state = np.array2string(np.asarray(tops[worst].x) + 0.0, precision=6, separator=", ")
    sentence = (
        f"No admissible input keeps x = {state} in the set{role}; Pre(X_f) cuts off "
        f"{cut:.3g} of the set's extent there."
    )
    return Check(name, False, -cut, unit, sentence, (1,))


def _check_lyapunov(
    closed: np.ndarray | None, K: Any, P: Any, Q: np.ndarray, R: np.ndarray, no_law: str
) -> Check:
    """Check (A+BK)'P(A+BK) - P + Q + K'RK <= 0."""
    name, unit = "Lyapunov inequality", "cost per |x|^2"
    if closed is None or P is None:
        return Check(name, None, None, unit, no_law, (3,))
    parts = closed.T @ P @ closed, P, Q, K.T @ R @ K
    change = parts[0] - P + Q + parts[3]
    top, size = float(np.linalg.eigvalsh(change)[-1]), np.linalg.norm(P, 2)
    # Signs of eigenvalues do not depend on units; rounding is judged in those in which each state
    # costs about 1.
    scale_x = _units_of(P)
    scale = sum(np.linalg.norm(scale_x[:, None] * part * scale_x, 2) for part in parts)
    scale += np.linalg.norm(np.abs(closed * scale_x / scale_x[:, None]), 2) ** 2
    holds = np.linalg.eigvalsh(scale_x[:, None] * change * scale_x)[-1] <= _TOUCH * scale
    sentence = (
        f"The largest eigenvalue of (A+BK)'P(A+BK) - P + Q + K'RK is {top:.3g}, "
        f"for |P| = {size:.3g}."
    )
    return Check(name, bool(holds), -top, unit, sentence, (3,))


def _weights(
    A: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray | None, trouble: str
) -> list[Check]:
    """Check definiteness of the weights, and detectability."""
    checks = []
    for name, matrix, definite in (
        ("Q positive semidefinite", Q, False),
        ("R positive definite", R, True),
        ("terminal cost positive semidefinite", P, False),
    ):
        if matrix is None:  # of the three, P alone, and then lqr has failed
            checks.append(Check(name, None, None, "least eigenvalue", trouble, (3,)))
            continue
        least, unit = float(np.linalg.eigvalsh(matrix)[0]), _units_of(matrix)
        alike = unit[:, None] * matrix * unit
        bottom = float(np.linalg.eigvalsh(alike)[0])
        holds = bottom > 0 if definite else bottom >= -_TOUCH * np.linalg.norm(alike, 2)
        sentence = f"The least eigenvalue is {least:.6g}."
        checks.append(Check(name, bool(holds), least, "least eigenvalue", sentence, (3,)))
    unit = _units_of(Q if P is None else P)
    weights, axes = np.linalg.eigh(unit[:, None] * Q * unit)
    output = np.sqrt(np.maximum(weights, 0.0))[:, None] * axes.T  # Q = output'output
    seen, mode = least_reached((A * unit / unit[:, None]).T, output.T)
    if seen == np.inf:
        sentence = "Every mode decays by itself."
    elif seen <= _DETECTABLE:
        sentence = f"Q puts no weight on the mode with eigenvalue {mode}, which does not decay."
    else:
        sentence = f"Every mode that does not decay costs something; the least, eigenvalue {mode}."
    checks.append(
        Check("detectability", bool(seen > _DETECTABLE), seen, "least singular value", sentence,
              (3,))
    )  # fmt: skip
    return checks


def _units_of(P: np.ndarray) -> np.ndarray:
    """Return units of the coordinates in which a weight's diagonal is 1; 1 where it is not
    positive, in units of the largest."""
    diagonal = np.diag(P)
    top = diagonal.max(initial=0.0)
    return 1 / np.sqrt(np.where(diagonal > 0, diagonal, top if top > 0 else 1.0))


def _origin_inside(X_f: _Set) -> Check:
    """Check that the origin lies in the interior of X_f, relative to its affine hull.

    The theorem needs a bound of the optimal cost near the origin. The cost is convex and piecewise
    quadratic, hence continuous, on the polytope X_N, whether X_f is {0}, another flat set or has an
    interior (Rawlings, Mayne & Diehl 2017, sections 2.4.2 and 7.3).
    """
    name, unit = "origin inside terminal set", "distance in x"
    if isinstance(X_f, _Ellipse):
        depth = float(np.sqrt(X_f.level / np.linalg.eigvalsh(X_f.P)[-1]))
    else:
        depth = float(X_f.g.min(initial=np.inf))
        hull = affine_hull(X_f.G, X_f.g)
        assert hull is not None
        if hull.equal.any() and not np.any(X_f.g[hull.equal]):
            depth = float((hull.g / np.linalg.norm(hull.G, axis=1)).min(initial=np.inf))
            if depth > 0:
                point = not hull.basis.size
                what = "the origin alone" if point else "flat, with the origin in its middle"
                sentence = (
                    f"The terminal set is {what}, and the optimal cost is continuous on the "
                    "polytope X_N all the same."
                )
                return Check(name, True, 0.0 if point else depth, unit, sentence, (3,))
    where = "within" if depth > 0 else "on the boundary of" if depth == 0 else "outside"
    sentence = f"The origin lies {where} the terminal set, {abs(depth):.6g} from its boundary."
    return Check(name, depth > 0, depth, unit, sentence, (3,))


def _symmetric(argument: str, value: Reals, n: int) -> np.ndarray:
    """Return a symmetric matrix (n, n) in float64; raise ValueError unless it is one."""
    value = as_weight(value, n)
    require_shape(argument, value, (n, n), "Give one square matrix")
    matrix = host_array(argument, value)
    require_finite(argument, matrix)
    if np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        fail(argument, "is not symmetric", f"Use ({argument} + {argument}.T) / 2")
    return (matrix + matrix.T) / 2


def _all(answers: Any) -> bool | None:
    """Return False if any answer is False, else None if any is None, else True."""
    answers = list(answers)
    return False if False in answers else None if None in answers else True


def _fractions(array: Any) -> Any:
    """Return nested lists of Fractions, each exactly the float it comes from."""
    array = np.asarray(array, np.float64)
    return [_fractions(row) for row in array] if array.ndim else Fraction(float(array))


def _closed_loop_fractions(law: tuple[np.ndarray, np.ndarray, np.ndarray]) -> list:
    """Return A + BK of the law (A, B, K) as nested lists of Fractions."""
    A, B, K = (_fractions(part) for part in law)
    columns = list(zip(*K, strict=True))
    return [
        [a + _dot(b, column) for a, column in zip(row, columns, strict=True)]
        for row, b in zip(A, B, strict=True)
    ]


def _dot(a: Any, b: Any) -> Fraction:
    """Return the inner product of two sequences of Fractions."""
    return sum((x * y for x, y in zip(a, b, strict=True)), Fraction(0))


def _gauss_jordan(matrix: list, right: list) -> list | None:
    """Solve a square system in rationals by Gauss-Jordan elimination; None if it is singular."""
    rows = [[*row, b] for row, b in zip(matrix, right, strict=True)]
    for k in range(len(rows)):
        pivot = next((i for i in range(k, len(rows)) if rows[i][k]), None)
        if pivot is None:
            return None
        rows[k], rows[pivot] = rows[pivot], rows[k]
        rows[k] = [value / rows[k][k] for value in rows[k]]
        for i in range(len(rows)):
            if i != k and rows[i][k]:
                rows[i] = [v - rows[i][k] * w for v, w in zip(rows[i], rows[k], strict=True)]
    return [row[-1] for row in rows]


def _positive(matrix: list) -> bool:
    """Return whether a symmetric matrix of Fractions is positive definite (pivots of L D L')."""
    rows = [list(row) for row in matrix]
    for k in range(len(rows)):
        if rows[k][k] <= 0:
            return False
        for i in range(k + 1, len(rows)):
            ratio = rows[i][k] / rows[k][k]
            rows[i] = [v - ratio * w for v, w in zip(rows[i], rows[k], strict=True)]
    return True
