"""The hypotheses under which a terminal set and cost make MPC recursively feasible and stable."""

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import NamedTuple

import numpy as np

from jaxmpc.arrays import Reals, as_weight, fractions_of, host_array
from jaxmpc.checks import fail, require_finite, require_kind, require_shape
from jaxmpc.pytrees import record
from jaxmpc.sets.control_invariant import largest_cut
from jaxmpc.sets.convex_sets import Box, ConvexSet, Ellipsoid, Polytope, unit_half_spaces
from jaxmpc.sets.disturbances import Image, disturbance_set, largest_norm, supports
from jaxmpc.sets.geometry import Flat, affine_hull, framed
from jaxmpc.sets.invariant import contraction
from jaxmpc.sets.lp import Program, extent, maximise
from jaxmpc.sets.predecessors import OneStep, one_step
from jaxmpc.systems.riccati import UNREACHED, least_reached, lqr
from jaxmpc.systems.system import LinearSystem, host_matrices

# A limit counts as kept if it is exceeded by no more than this, relative to the set's extent
# along the row (to |P| for matrix inequalities). Sets that touch a limit exceed it by rounding.
_TOUCH = 1e-9
_EXACT_PRODUCTS = 200_000  # a certificate with no more products is also evaluated in rationals


@dataclass(frozen=True)
class Check:
    """One hypothesis, with the result of its check.

    holds: True, False, or None for undecided.
    margin: by how much, in `unit`; negative if it fails, None if there is no number.
    unit: of the margin. sentence: the result in words.
    theorems: which of the two theorems (1, 3) need it.
    """

    name: str
    holds: bool | None
    margin: float | None
    unit: str
    sentence: str
    theorems: tuple[int, ...] = (3,)


@record
class TerminalReport:
    """What `verify_terminal` found: `report["Lyapunov inequality"]` is one check, `str` a table.

    checks: all of them. K: (m, n), the law that was checked, or None.
    certificate: (rows, rows) M >= 0 with M H = H (A+BK) and M h <= factor h for a terminal set
        {H x <= h} with rows of norm 1, or None.
    factor: the set is mapped into itself scaled by this (an ellipsoid: into level * factor).
    exact_factor: a bound of it from the same certificate in rational arithmetic, or None.
    disturbed: invariance was checked for every disturbance; Theorem 3 is stated for none.
    """

    checks: tuple[Check, ...]
    K: np.ndarray | None
    certificate: np.ndarray | None
    factor: float | None
    exact_factor: Fraction | None
    disturbed: bool = False

    def __getitem__(self, name: str) -> Check:
        """Return the check of this name."""
        for check in self.checks:
            if check.name == name:
                return check
        fail("name", f"{name!r} is no check", f"Use one of {[c.name for c in self.checks]}")

    @property
    def recursive_feasibility(self) -> bool | None:
        """Return whether Theorem 1 applies: True if all its hypotheses hold, False if one fails,
        None if some are undecided."""
        return self._applies(1)

    @property
    def stability(self) -> bool | None:
        """Return whether Theorem 3 applies, as `recursive_feasibility` does."""
        return self._applies(3)

    def _applies(self, theorem: int) -> bool | None:
        answers = [check.holds for check in self.checks if theorem in check.theorems]
        return False if False in answers else None if None in answers else True

    def __repr__(self) -> str:
        """Return what the checks say of each theorem."""
        lines = [
            "With limits of inputs and states, outputs C x among these, none of rates, moves free:"
        ]
        for number, title in ((1, "recursive feasibility"), (3, "asymptotic stability")):
            missing = [c.name for c in self.checks if number in c.theorems and not c.holds]
            answer = f"does not apply: {', '.join(missing)}" if missing else "applies"
            lines.append(f"Theorem {number} ({title}) {answer}.")
        if self.disturbed:
            lines.append("Theorem 3 is about w = 0: under the disturbance x need not converge.")
        return "\n".join(lines)

    def __str__(self) -> str:
        """Return what the checks say of each theorem, and a table of them."""
        words, lines = {True: "yes", False: "NO", None: "?"}, [repr(self)]
        width = max(len(check.name) for check in self.checks)
        for check in self.checks:
            margin = "" if check.margin is None else f"{check.margin:.6g} {check.unit}"
            if check.margin is not None and check.margin < 0 and check.holds:
                margin = f"0 {check.unit}, to rounding"
            needed = ",".join(map(str, check.theorems))
            line = f"{words[check.holds]:>3}  {check.name:<{width}}  {needed:<3}  {margin}"
            lines += [line.rstrip(), f"     {check.sentence}"]
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
    disturbance: ConvexSet | None = None,
    disturbance_matrix: Reals | None = None,
) -> TerminalReport:
    """Check each hypothesis of the theorems on recursive feasibility (1) and stability (3).

    Theorem 1. If states X and inputs U are convex and compact and the terminal set X_f within X
    is control invariant, a feasible MPC problem stays feasible along its own closed loop.
    Theorem 3. If in addition, on X_f, u = K x keeps x in X_f and u in U, and
    (A+BK)'P(A+BK) - P + Q + K'RK <= 0, the origin is asymptotically stable on X_N.
    Both are stated for w = 0. With a disturbance, robust invariance is checked. Limits of input
    rates, outputs and blocked moves are no part of either: with limited rates let the state be (x,
    u_{k−1}) and the input its change, and give that system, whose limits are those of a set.

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
        disturbance_matrix: E (n, p) of x+ = A x + B u + c + E w, None for the identity.

    {H x <= h} is invariant under K if there is M >= 0 with M H = H (A+BK) and M h + H c + max Hw
    <= factor h, factor <= 1 (Farkas). M comes from LPs; its residual E = M H - H (A+BK) is
    recomputed and its worst |E| |x| over the set charged to the bound. Small certificates are
    evaluated a second time in rational arithmetic. x'P_f x <= level is invariant if (A+BK)'P_f
    (A+BK) <= factor P_f; with w and c, if sqrt(factor) sqrt(level) + max |w + c|_P <= sqrt(level),
    which is sufficient only. If K fails, control invariance alone: X_f within Pre(X_f), row by row.
    A limit counts as kept if it is exceeded by at most 1e-9 of the set's extent. NumPy in float64;
    not traceable.

    Raises ValueError for wrong shapes, asymmetric weights or empty sets; a hypothesis that
    fails is an answer, not an error.

    Source: Rawlings, Mayne & Diehl 2017, Model Predictive Control, section 2.4; Bitsoris 1988,
    Int. J. Control 47(6), for the certificate; Hautus 1970, for detectability.
    """
    require_kind("system", system, LinearSystem)
    system.validate()
    A, B, c = host_matrices(system)
    Q, R = _symmetric("Q", Q, system.n), _symmetric("R", R, system.m)
    X = _Rows(*unit_half_spaces("states", states, system.n))
    U = _Rows(*unit_half_spaces("inputs", inputs, system.m))
    gain, P, no_law = _gain_and_cost(system, Q, R, K, terminal_cost)
    W = disturbance_set(disturbance, system.n, disturbance_matrix)
    # Without one X takes its role, at horizon N − 1.
    X_f = replace(X, called="X") if terminal_set is None else _terminal_set(terminal_set, system.n)
    name = "inputs of K admissible"
    if gain is None:
        loop = None
        under_K = _Invariance(Check("invariance under K", None, None, "", no_law))
        admissible = Check(name, None, None, "", no_law)
    else:
        loop = _Loop(A, B, gain, c, W)
        under_K = X_f.invariance(loop)
        admissible = _within(name, system.input_labels, U, gain, X_f)
    name = "terminal set within states"
    inside = _within(name, system.state_labels, X, np.eye(system.n), X_f)
    step = one_step(system, inputs, disturbance, disturbance_matrix)
    checks = [
        _compact("states", "X", X),
        _compact("inputs", "U", U),
        replace(inside, theorems=(1, 3)),
        _control_invariance(step, X_f, under_K.check, admissible),
        under_K.check,
        admissible,
        _lyapunov(loop, P, Q, R, no_law),
        *_weights(A, Q, R, P, no_law),
        _equilibrium_at_origin(c),
        X_f.origin_inside(),
    ]
    if terminal_set is None:
        where = "x_N may leave X, where the Lyapunov inequality and K in U do not hold"
        sentence = f"{where}: Theorem 3 requires a terminal set."
        checks.append(Check("terminal cost where x_N is free", None, None, "", sentence))
    return TerminalReport(tuple(checks), gain, *under_K[1:], disturbed=W is not None)


def _gain_and_cost(
    system: LinearSystem, Q: np.ndarray, R: np.ndarray, K: Reals | None, P: Reals | None
) -> tuple[np.ndarray | None, np.ndarray | None, str]:
    """Return K and P, those of `lqr` in place of None, and why one is missing where that fails."""
    gain = cost = None
    trouble = ""
    if K is not None:
        require_shape("K", K, (system.m, system.n), "Give u = Kx one row an input")
        require_finite("K", K)
        gain = host_array("K", K)
    if P is not None:
        cost = _symmetric("terminal_cost", P, system.n)
    if gain is None or cost is None:
        try:
            law = lqr(system, Q, R)
            gain = host_array("K", law.K) if gain is None else gain
            cost = host_array("P", law.P) if cost is None else cost
        except ValueError as error:
            trouble = f"lqr has no answer ({error})"
    return gain, cost, trouble


class _Loop(NamedTuple):
    """x+ = (A + BK) x + c + w with w in W; W is None for w = 0."""

    A: np.ndarray
    B: np.ndarray
    K: np.ndarray
    c: np.ndarray
    W: ConvexSet | None

    @property
    def closed(self) -> np.ndarray:
        """Return A + BK."""
        return self.A + self.B @ self.K

    @property
    def exactly_closed(self) -> np.ndarray:
        """Return A + BK as Fractions, without rounding."""
        return fractions_of(self.A) + fractions_of(self.B) @ fractions_of(self.K)


class _Invariance(NamedTuple):
    """The check of invariance under K, and what shows it: see `TerminalReport`."""

    check: Check
    certificate: np.ndarray | None = None
    factor: float | None = None
    exact_factor: Fraction | None = None


@record
class _Rows:
    """{G x <= g}, rows of norm 1; no rows for all of R^n. called: in sentences."""

    G: np.ndarray
    g: np.ndarray
    called: str = "the terminal set"

    def maxima(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (upper bounds of max row x, M with M G = rows but for rounding); inf if
        unbounded."""
        bounds, M = np.zeros(len(rows)), np.zeros((len(rows), len(self.g)))
        program = Program(self.G, self.g)
        for i in np.flatnonzero(rows.any(axis=1)):
            bounds[i] = np.inf
            if len(self.g):
                best = program.maximise(rows[i])
                bounds[i] = program.bound(rows[i], best, self.extent)
                M[i] = 0.0 if best.y is None else best.y
        return bounds, M

    @cached_property
    def extent(self) -> np.ndarray:
        """Return bounds of |x_i| over the set, `lp.extent`; inf if there is none."""
        if not len(self.g):
            return np.full(self.G.shape[1], np.inf)
        return extent(self.G, self.g)

    def width(self, rows: np.ndarray, tops: np.ndarray) -> np.ndarray:
        """Return how far the set, with these maxima of the rows, reaches along each from a point
        inside; where that is rounding, as in a flat set, the size of the row's terms."""
        width = np.maximum(tops - rows @ Program(self.G, self.g).margin()[0], 0.0)
        size = np.abs(tops) + np.abs(rows) @ np.where(np.isfinite(self.extent), self.extent, 0.0)
        return np.where(width > _TOUCH * size, width, np.where(size > 1e-280, size, 1.0))

    def invariance(self, loop: _Loop) -> _Invariance:
        """Check invariance under u = K x, by M >= 0 with M G = G (A + BK)."""
        name, unit, G, g = "invariance under K", "of the extent", self.G, self.g
        if not len(g):
            return _Invariance(Check(name, True, np.inf, unit, "All of R^n is invariant."))
        largest, M = self.maxima(G @ loop.closed)
        if np.isinf(largest).any():
            row = np.argmax(largest) + 1
            sentence = f"On this unbounded set (A+BK) x violates row {row} without limit."
            return _Invariance(Check(name, False, -np.inf, unit, sentence))
        attained = largest + G @ loop.c + supports(loop.W, G)
        residual = float(np.abs(M @ G - G @ loop.closed).max())
        slack = (g - attained) / self.width(G, g)
        worst = int(np.argmin(slack))
        holds = bool(slack[worst] >= -_TOUCH)
        sentence, factor, exact = f"M >= 0 with M H = H(A+BK) up to {residual:.1e}", None, None
        if g.min() > 0:
            factor = float((attained / g).max())
            sentence += f" and M h{'' if loop.W is None else ' + max Hw'} <= {factor:.9g} h"
            exact = _exact_factor(M, self, loop)
        ends = f"{attained[worst]:.9g} of {g[worst]:.9g}"
        sentence += f"; the tightest row, {worst + 1}, is reached to {ends}."
        if exact is not None and exact <= 1:
            sentence += " In rational arithmetic the factor is at most 1."
        elif exact is not None and holds:
            sentence += (
                f" In rational arithmetic the factor exceeds 1 by {float(exact - 1):.1e}: kept up "
                f"to rounding, for which {_TOUCH:g} of the extent is allowed."
            )
        return _Invariance(
            Check(name, holds, float(slack[worst]), unit, sentence), M, factor, exact
        )

    def origin_inside(self) -> Check:
        """Check that the origin lies in the interior, relative to the affine hull.

        The theorem needs a bound of the optimal cost near the origin. The cost is convex and
        piecewise quadratic, hence continuous, on the polytope X_N, whether the set is {0}, another
        flat set or has an interior (Rawlings, Mayne & Diehl 2017, sections 2.4.2 and 7.3).
        """
        hull = affine_hull(self.G, self.g)
        assert hull is not None
        if hull.equal.any() and not np.any(self.g[hull.equal]):
            depth = float((hull.g / np.linalg.norm(hull.G, axis=1)).min(initial=np.inf))
            if depth > 0:
                point = not hull.basis.size
                what = "the origin alone" if point else "flat, with the origin in its middle"
                sentence = (
                    f"{self.called.capitalize()} is {what}, and the optimal cost is continuous on "
                    "the polytope X_N all the same."
                )
                there = _origin_at(0.0 if point else depth, self.called)
                return replace(there, holds=True, sentence=sentence)
            return _origin_at(depth, self.called)
        return _origin_at(float(self.g.min(initial=np.inf)), self.called)


@record
class _Ellipse:
    """{x'P x <= level}. called: in sentences."""

    P: np.ndarray
    level: float
    called: str = "the terminal set"

    def maxima(self, rows: np.ndarray) -> tuple[np.ndarray, None]:
        """Return (max row x, None)."""
        squares = np.einsum("ij,ij->i", rows, np.linalg.solve(self.P, rows.T).T)
        return np.sqrt(self.level * squares), None

    def width(self, rows: np.ndarray, tops: np.ndarray) -> np.ndarray:
        """Return how far the set, with these maxima of the rows, reaches from its center."""
        return np.where(tops > 0, tops, 1.0)

    def invariance(self, loop: _Loop) -> _Invariance:
        """Check invariance under u = K x: (A+BK)'P (A+BK) <= P, with room for c and w."""
        name, P, closed = "invariance under K", self.P, loop.closed
        factor = contraction(closed, P)
        least = float(np.linalg.eigvalsh(P - closed.T @ P @ closed)[0])
        sentence = (
            f"(A+BK)'P_f(A+BK) <= {factor:.9g} P_f; the least eigenvalue of P_f - (A+BK)'P_f(A+BK) "
            f"is {least:.3g}"
        )
        if loop.W is None and not loop.c.any():
            if len(P) <= 8:
                A, F = loop.exactly_closed, fractions_of(P)
                if _positive(F - A.T @ F @ A):
                    sentence += ", and the matrix is positive definite in rational arithmetic"
            holds = factor <= 1 + _TOUCH
            check = Check(name, holds, 1 - factor, "of the level", f"{sentence}.")
            return _Invariance(check, factor=factor)
        c, W = loop.c, loop.W
        norm = float(np.sqrt(c @ P @ c)) if W is None else largest_norm(W, P, c)
        slack = float(1 - np.sqrt(factor) - norm / np.sqrt(self.level))
        sentence += (
            f"; with |w + c|_P <= {norm:.6g} the image reaches at most {1 - slack:.9g} of the "
            "radius"
        )
        enough = True if slack >= -_TOUCH else None if factor <= 1 else False
        sentence += "." if enough else ", a bound that is sufficient only."
        check = Check(name, enough, slack, "of the radius", sentence)
        return _Invariance(check, factor=factor)

    def origin_inside(self) -> Check:
        """Check that the origin, which is its center, lies in the interior."""
        return _origin_at(float(np.sqrt(self.level / np.linalg.eigvalsh(self.P)[-1])), self.called)


def _origin_at(depth: float, called: str) -> Check:
    """Return the check of the origin at this depth in a set."""
    where = "within" if depth > 0 else "on the boundary of" if depth == 0 else "outside"
    sentence = f"The origin lies {where} {called}, {abs(depth):.6g} from its boundary."
    return Check("origin inside terminal set", depth > 0, depth, "distance in x", sentence)


def _terminal_set(given: Box | Polytope | Ellipsoid, n: int) -> _Rows | _Ellipse:
    """Return a terminal set in R^n, checked."""
    if not isinstance(given, Ellipsoid):
        return _Rows(*unit_half_spaces("terminal_set", given, n))
    given.validate("terminal_set", n)
    given.require_origin("terminal_set")
    P = host_array("terminal_set.P", given.P)
    return _Ellipse((P + P.T) / 2, float(host_array("terminal_set.level", given.level)))


def _compact(name: str, letter: str, limits: _Rows) -> Check:
    """Check that a set of linear rows is bounded."""
    top = float(limits.extent.max() / (1 + 1e-6))
    if np.isfinite(top):
        found = f"bounded: no coordinate exceeds {top:.6g}."
    else:
        free = ", ".join(str(i + 1) for i in np.flatnonzero(np.isinf(limits.extent)))
        found = (
            f"unbounded in coordinate {free}. The theorem as stated does not apply; its shifted "
            "plan uses convexity and compactness nowhere, so the conclusion stands if an optimal "
            "plan exists (it does for Q >= 0, R > 0, P >= 0)."
        )
        top = -np.inf
    sentence = f"{letter} is convex, as every set of linear rows is, and {found}"
    return Check(f"{name} compact", top > -np.inf, top, "largest coordinate", sentence, (1,))


def _within(
    name: str,
    labels: tuple[str, ...],
    limits: _Rows,
    output: np.ndarray,
    X_f: _Rows | _Ellipse,
) -> Check:
    """Check that `output` x lies within the limits for all x in X_f; the margin is a distance from
    a row's hyperplane."""
    G, g, unit = limits.G, limits.g, "distance to the limit"
    if not len(g):
        return Check(name, True, np.inf, unit, f"Nothing limits {', '.join(labels)}.")
    rows = G @ output
    tops = X_f.maxima(rows)[0]
    slack = g - tops
    worst = int(np.argmin(slack))
    sign = -1 if np.count_nonzero(G[worst]) == 1 and G[worst].sum() < 0 else 1  # x >= lower
    row = sign * G[worst]
    terms = [(f"{v:.6g} " if v != 1 else "") + labels[j] for j, v in enumerate(row) if v]
    limit = f"{' + '.join(terms)} {'<=' if sign > 0 else '>='} {sign * g[worst]:.6g}"
    if np.isinf(tops[worst]):
        sentence = f"The set is unbounded, and so is the violation of {limit}."
        return Check(name, False, -np.inf, unit, sentence)
    holds = bool((slack >= -_TOUCH * np.maximum(np.abs(g), X_f.width(rows, tops))).all())
    reached = (
        f"The tightest limit, {limit}, is reached up to {sign * tops[worst]:.6g} on {X_f.called}"
    )
    return Check(name, holds, float(slack[worst]), unit, f"{reached}.")


def _control_invariance(
    step: OneStep, X_f: _Rows | _Ellipse, kept: Check, admissible: Check
) -> Check:
    """Check control invariance of X_f: by the law K, or by one step backwards."""

    def check(holds: bool | None, margin: float | None, sentence: str) -> Check:
        return Check("control invariance", holds, margin, "of the extent", sentence, (1,))

    if kept.holds and admissible.holds:
        sentence = f"u = K x is admissible and keeps the state in {X_f.called}."
        return replace(check(True, kept.margin, sentence), unit=kept.unit)
    if isinstance(X_f, _Ellipse):
        sentence = "K does not show it, and whether another law does is not decided for ellipsoids."
        return check(None, None, sentence)
    if not len(X_f.g):
        return check(True, np.inf, "All of R^n is invariant.")
    try:
        usable = bool(np.isfinite(X_f.extent).all()) and framed("X_f", X_f.G, X_f.g).bounded
    except Flat:
        usable = False
    if not usable:
        sentence = "K does not show it, and the set is unbounded or flat: not decided."
        return check(None, None, sentence)
    body = Polytope(X_f.G, X_f.g)
    before = step.back(body)
    if before.is_empty():
        sentence = f"From no state can an admissible input reach {X_f.called}."
        return check(False, -np.inf, sentence)
    cut = largest_cut(before, body)
    if cut <= _TOUCH:
        sentence = (
            "K does not show it, but every state of the set has an admissible input that keeps "
            "it in: no row of Pre(X_f) cuts X_f (upper bounds from LPs)."
        )
        return check(True, -cut, sentence)
    H, h = before.unit_rows()
    tops = [maximise(row, X_f.G, X_f.g) for row in H]
    worst = int(np.argmax([top.value - limit for top, limit in zip(tops, h, strict=True)]))
    state = np.array2string(np.asarray(tops[worst].x) + 0.0, precision=6, separator=", ")
    sentence = (
        f"No admissible input keeps x = {state} in the set; Pre(X_f) cuts off "
        f"{cut:.3g} of the set's extent there."
    )
    return check(False, -cut, sentence)


def _lyapunov(
    loop: _Loop | None, P: np.ndarray | None, Q: np.ndarray, R: np.ndarray, no_law: str
) -> Check:
    """Check (A+BK)'P(A+BK) - P + Q + K'RK <= 0."""
    name, unit = "Lyapunov inequality", "cost per |x|^2"
    if loop is None or P is None:
        return Check(name, None, None, unit, no_law)
    parts = loop.closed.T @ P @ loop.closed, P, Q, loop.K.T @ R @ loop.K
    change = parts[0] - P + Q + parts[3]
    top, size = float(np.linalg.eigvalsh(change)[-1]), np.linalg.norm(P, 2)
    # Signs of eigenvalues do not depend on units; rounding is measured in those in which each state
    # costs about 1.
    unit_x = _units_of(P)
    scale = sum(np.linalg.norm(unit_x[:, None] * part * unit_x, 2) for part in parts)
    scale += np.linalg.norm(np.abs(loop.closed * unit_x / unit_x[:, None]), 2) ** 2
    holds = np.linalg.eigvalsh(unit_x[:, None] * change * unit_x)[-1] <= _TOUCH * scale
    sentence = (
        f"The largest eigenvalue of (A+BK)'P(A+BK) - P + Q + K'RK is {top:.3g}, "
        f"for |P| = {size:.3g}."
    )
    return Check(name, bool(holds), -top, unit, sentence)


def _weights(
    A: np.ndarray, Q: np.ndarray, R: np.ndarray, P: np.ndarray | None, no_law: str
) -> list[Check]:
    """Check definiteness of the weights, and detectability."""
    checks = []
    for name, matrix, definite in (
        ("Q positive semidefinite", Q, False),
        ("R positive definite", R, True),
        ("terminal cost positive semidefinite", P, False),
    ):
        if matrix is None:  # of the three, P alone, and then lqr has failed
            checks.append(Check(name, None, None, "least eigenvalue", no_law))
            continue
        least, unit = float(np.linalg.eigvalsh(matrix)[0]), _units_of(matrix)
        alike = unit[:, None] * matrix * unit
        bottom = float(np.linalg.eigvalsh(alike)[0])
        holds = bottom > 0 if definite else bottom >= -_TOUCH * np.linalg.norm(alike, 2)
        sentence = f"The least eigenvalue is {least:.6g}."
        checks.append(Check(name, bool(holds), least, "least eigenvalue", sentence))
    unit = _units_of(Q if P is None else P)
    weights, axes = np.linalg.eigh(unit[:, None] * Q * unit)
    output = np.sqrt(np.maximum(weights, 0.0))[:, None] * axes.T  # Q = output'output
    seen, mode = least_reached((A * unit / unit[:, None]).T, output.T)
    if seen == np.inf:
        sentence = "Every mode decays by itself."
    elif seen <= UNREACHED:
        sentence = f"Q puts no weight on the mode with eigenvalue {mode}, which does not decay."
    else:
        sentence = f"Every mode that does not decay costs something; the least, eigenvalue {mode}."
    detectable = bool(seen > UNREACHED)
    return [*checks, Check("detectability", detectable, seen, "least singular value", sentence)]


def _equilibrium_at_origin(c: np.ndarray) -> Check:
    """Check that the drift is zero."""
    shift = float(np.abs(c).max(initial=0.0))
    cure = "write the system in deviations from its equilibrium"
    moved = f"c moves the origin by up to {shift:.3g} in a step: {cure}."
    sentence = moved if shift else "c = 0."
    return Check("origin is an equilibrium", shift == 0, 0.0 - shift, "in x a step", sentence)


def _units_of(P: np.ndarray) -> np.ndarray:
    """Return units of the coordinates in which a weight's diagonal is 1; 1 where it is not
    positive, in units of the largest."""
    diagonal = np.diag(P)
    top = diagonal.max(initial=0.0)
    return 1 / np.sqrt(np.where(diagonal > 0, diagonal, top if top > 0 else 1.0))


def _symmetric(argument: str, value: Reals, n: int) -> np.ndarray:
    """Return a symmetric matrix (n, n) in float64; raise ValueError unless it is one."""
    value = as_weight(value, n)
    require_shape(argument, value, (n, n), "Give one square matrix")
    matrix = host_array(argument, value)
    require_finite(argument, matrix)
    if np.abs(matrix - matrix.T).max() > 1e-6 * np.abs(matrix).max():
        fail(argument, "is not symmetric", f"Use ({argument} + {argument}.T) / 2")
    return (matrix + matrix.T) / 2


# --- Rational arithmetic: arrays of Fractions -------------------------------------------


def _exact_factor(M: np.ndarray, X_f: _Rows, loop: _Loop) -> Fraction | None:
    """Return max_i (M h + |M H - H(A+BK)| |x| + H c + max Hw)_i / h_i, without rounding.

    Where the rows that M uses are n and independent, their multipliers are computed again from
    M H = H(A+BK), so that no residual is left. |x| is bounded by LPs and a margin. None where the
    set is too large for it, or unbounded where a residual is left, or W is no Box or image of one.
    """
    n = len(loop.c)
    E, box = (loop.W.E, loop.W.of) if isinstance(loop.W, Image) else (np.eye(n), loop.W)
    exact_ends = box is None or isinstance(box, Box)
    if len(X_f.g) ** 2 * n > _EXACT_PRODUCTS or not exact_ends:
        return None
    H, h = fractions_of(X_f.G), fractions_of(X_f.g)
    images, bounds = H @ loop.exactly_closed, H @ fractions_of(loop.c)
    if isinstance(box, Box):
        ends, along = (fractions_of(box.lower), fractions_of(box.upper)), H @ fractions_of(E)
        bounds = bounds + np.maximum(along * ends[0], along * ends[1]).sum(axis=1)
    for i, image in enumerate(images):
        used = np.flatnonzero(M[i] > 0)
        y = fractions_of(M[i, used])
        if len(used) == n:
            solved = _solved_exactly(H[used].T, image)
            y = solved if solved is not None and min(solved) >= 0 else y
        left = abs(image - (y[:, None] * H[used]).sum(axis=0))
        off = np.flatnonzero(left)
        if not np.isfinite(X_f.extent[off]).all():
            return None
        bounds[i] += (y * h[used]).sum() + (left[off] * fractions_of(X_f.extent[off])).sum()
    return max(bounds / h)


def _solved_exactly(matrix: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Solve a square system in rationals by Gauss-Jordan elimination; None if it is singular."""
    rows = np.column_stack([matrix, right])
    for k in range(len(rows)):
        pivots = k + np.flatnonzero(rows[k:, k])
        if not len(pivots):
            return None
        rows[[k, pivots[0]]] = rows[[pivots[0], k]]
        rows[k] = rows[k] / rows[k, k]
        others = np.arange(len(rows)) != k
        rows[others] = rows[others] - np.outer(rows[others, k], rows[k])
    return rows[:, -1]


def _positive(matrix: np.ndarray) -> bool:
    """Return whether a symmetric matrix of Fractions is positive definite (pivots of L D L')."""
    rows = matrix.copy()
    for k in range(len(rows)):
        if rows[k, k] <= 0:
            return False
        rows[k + 1 :] = rows[k + 1 :] - np.outer(rows[k + 1 :, k] / rows[k, k], rows[k])
    return True
