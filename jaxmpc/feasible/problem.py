"""The feasibility problem: which initial states have inputs that keep all hard constraints."""

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from jaxmpc.arrays import Reals
from jaxmpc.checks import require_kind, require_untraced
from jaxmpc.feasible import condensed_rows, hard_constraints
from jaxmpc.feasible.condensed_rows import ConstraintRows, RowPrograms
from jaxmpc.feasible.hard_constraints import Axes, ExactData, View, make_view
from jaxmpc.feasible.plan_polytope import PlanPolytope
from jaxmpc.files import as_json
from jaxmpc.mpc.condense import Condensed, condensed_in_float64
from jaxmpc.mpc.policy_rows import tube_section
from jaxmpc.mpc.problem import MPC, Outputs, as_tuple, differing
from jaxmpc.mpc.rows import Block
from jaxmpc.mpc.tightening import feedback_gain, require_tightened, without_disturbance
from jaxmpc.pytrees import record
from jaxmpc.sets.convex_sets import Box, Ellipsoid, Polytope, set_bounds
from jaxmpc.sets.disturbances import disturbance_columns, with_vertices
from jaxmpc.sets.geometry import ROUNDED, binding_rows, implied_equalities, unit_rows
from jaxmpc.sets.lp import ROUNDING
from jaxmpc.sets.polyhedra import independent


@record
class FeasibilityProblem:
    """The hard constraints of an MPC problem, and which initial states points θ (d,) stand for.

    mpc: the problem without soft rows and weights of input rates, which do not influence
    feasibility, with polytopes that are boxes as those, and with the rows of polytopes that imply
    equalities as outputs. Where input rates are limited, u_{−1} is one of the inputs that could be
    applied: the feasible set holds no (x, u_{−1}) with u_{−1} outside `inputs`. view: all states, a
    slice or a projection. Everything else follows from these two, in NumPy in float64, and is
    computed once, when it is first used.
    """

    mpc: MPC
    view: View

    @classmethod
    def of(cls, mpc: MPC, axes: Axes = None, fixed: Reals | None = None) -> "FeasibilityProblem":
        """Return the feasibility problem of `mpc`; axes, fixed: the view, as in `map_feasible_set`.

        Raises ValueError for an ill-posed problem and for a wrong view.
        """
        require_kind("mpc", mpc, MPC)
        require_untraced("mpc", mpc)
        mpc.validate()
        require_tightened(mpc, "what labels by one sequence of inputs")
        mpc = with_constant_sets(mpc)
        boxes = {name: as_box(getattr(mpc, name)) for name in ("states", "inputs", "terminal_set")}
        outputs = tuple(map(_joined, as_tuple("outputs", mpc.outputs, Outputs)))
        changes = {**boxes, "outputs": outputs, "soft": (), "input_rate_weight": None}
        hard = with_equalities(replace(mpc, **changes))
        return cls(hard, make_view(hard, axes, fixed))

    @property
    def dimension(self) -> int:
        """Return d, the number of coordinates of θ."""
        return len(self.view.axes)

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Return the names of these coordinates, with units."""
        return tuple(self.mpc.labels[i] for i in self.view.axes)

    @cached_property
    def memory(self) -> dict[str, Any]:
        """Return what those who label points keep from one call to the next."""
        return {}

    @cached_property
    def condensed(self) -> Condensed:
        """Return the condensed problem, of all states."""
        return with_previous_inputs(self.mpc, condensed_in_float64(self.mpc))

    @cached_property
    def blocks(self) -> list[Block]:
        """Return the blocks of hard rows, in the order of the condensed rows."""
        return hard_constraints.hard_blocks(self.mpc)

    @cached_property
    def widest_blocks(self) -> list[Block]:
        """Return them with bounds no narrower than exactly, of a robust problem; else the same."""
        if self.mpc.disturbance is None:
            return self.blocks
        return hard_constraints.hard_blocks(self.mpc, widest=True)

    @cached_property
    def rows(self) -> ConstraintRows:
        """Return the condensed rows in θ and an orthonormal basis."""
        return condensed_rows.constraint_rows(self.mpc, self.view, self.condensed, self.blocks)

    @cached_property
    def programs(self) -> RowPrograms:
        """Return the linear programs over `rows`."""
        return RowPrograms(self.rows)

    @cached_property
    def weighted_rows(self) -> tuple[ConstraintRows, ...]:
        """Return the rows without prestabilisation, in units that grow as the slowest and as the
        fastest unstable mode do; none where no mode is unstable. Multipliers of late rows are tiny
        beside those of early ones, and precise in such units alone."""
        moduli = np.abs(np.linalg.eigvals(np.asarray(self.mpc.system.A, float))).ravel()
        moduli = moduli[moduli > 1 + 1e-9]
        if not len(moduli):
            return ()
        slow, fast = np.minimum([moduli.min(), moduli.max()], 1e200 ** (1 / self.mpc.horizon))
        free = replace(self.mpc, prestabilise=False)
        c = with_previous_inputs(free, condensed_in_float64(free))
        return tuple(
            condensed_rows.constraint_rows(self.mpc, self.view, c, self.blocks, growth)
            for growth in ([slow, fast] if fast > (1 + 1e-6) * slow else [fast])
        )

    @cached_property
    def plan_polytope(self) -> PlanPolytope:
        """Return the polytope of all states and the decisions that keep all rows, for any
        view."""
        return PlanPolytope.of(self.condensed)

    def exact(self, region: np.ndarray, size: np.ndarray | None = None) -> ExactData:
        """Return the exact data that proofs work on.

        region (d,): bounds of |θ| that are used where linear programs find the feasible set empty.
        size (d,): typical size of θ, None for that of the set; it selects how rounding errors are
        bounded, not whether they are.
        """
        extent, _ = self.programs.bounding_box
        extent = np.array([-region, region]) if extent is None else extent
        return hard_constraints.exact_data(
            self.mpc, self.view, self.blocks, extent, size, self.widest_blocks
        )

    def plain(self) -> dict[str, Any]:
        """Return the hard constraints as JSON data, from which stored labels can be verified.

        A, B, c of x⁺ = Ax + Bu + c over `horizon` steps, each with a leading axis where it differs
        from step to step, as H, D, lower and upper may for their steps; moves: index of the free
        move that each input equals. rows: lower ≤ Hx + Du ≤ upper at steps (None: no bound).
        ellipsoid: P and level of x_N'Px_N ≤ level, or None. disturbance: of a robust problem, whose
        rows are those before they are tightened, as `described_policy` says. axes: the
        mapped states; others: the index of those that are not, and their value or bounds.
        """
        mpc, view, set_ = self.mpc, self.view, self.mpc.terminal_set
        A, B, c = hard_constraints.augmented_dynamics(mpc)
        given = hard_constraints.hard_blocks(without_disturbance(mpc))
        rows = [
            {"steps": list(b.steps), "H": b.H, "D": b.D, "lower": b.lower, "upper": b.upper}
            for b in given
            if b.radius is None
        ]
        ellipsoid = {"P": set_.P, "level": set_.level} if isinstance(set_, Ellipsoid) else None
        others: dict[str, Any] = {"index": list(view.others)}
        if view.projects:
            others |= {"lower": view.lower, "upper": view.upper}
        elif view.others:
            others["value"] = np.asarray(view.fixed)[list(view.others)]
        plain = {"A": A, "B": B, "c": c, "horizon": mpc.horizon, "moves": list(mpc.moves)}
        if mpc.disturbance is not None:
            plain["disturbance"] = described_policy(mpc)
        plain |= {"rows": rows, "ellipsoid": ellipsoid, "axes": list(view.axes), "others": others}
        return as_json(plain)

    def row_margins(self, exact: ExactData, size: np.ndarray) -> np.ndarray:
        """Return what margins (R,) of the rows a proof needs relative to each other: as rounding
        can move them at points of this size (d,), within a factor of 1e9."""
        start = hard_constraints.start_sizes(self.view, size)
        rounding = hard_constraints.rounding_of_rows(exact, start)
        found = np.zeros(len(self.rows.lower) + 1)
        found[self.rows.index] = np.concatenate([np.ravel(part) for part in rounding])
        return np.clip(found[:-1] * self.rows.weight, self.rows.size, 1e9 * self.rows.size)


def described_policy(mpc: MPC) -> dict[str, Any]:
    """Return the disturbances and the policy of a robust problem, as `plain` has them: E (n, p), W
    as lower and upper, as center and generators, or as points, and the gain (m, n), which affine
    policies do not have; of a tube its section too, as center and generators."""
    W: Any = mpc.disturbance
    if isinstance(W, Box):
        lower, upper = np.asarray(W.lower, float), np.asarray(W.upper, float)
        set_ = {"lower": lower, "upper": upper}
    elif hasattr(W, "generators"):
        set_ = {"center": np.asarray(W.center, float), "generators": np.asarray(W.generators)}
    else:
        set_ = {"points": np.asarray(with_vertices(W).points, float)}
    E = disturbance_columns(mpc.disturbance_matrix, mpc.system.n)
    found = {"policy": mpc.policy, "E": E, "set": set_}
    if mpc.policy != "affine":
        found["gain"] = np.asarray(feedback_gain(mpc), np.float64)
    if mpc.policy == "tube":
        section = tube_section(mpc)
        found["section"] = {"center": section.center, "generators": section.generators}
    return found


def with_previous_inputs(mpc: MPC, c: Condensed) -> Condensed:
    """Return the condensed problem with the rows of `hard_constraints.previous_inputs` before all
    others."""
    for b in hard_constraints.previous_inputs(mpc):
        more: dict[str, Any] = {
            "C": np.concatenate([np.zeros((b.size, c.C.shape[1])), c.C]),
            "D": np.concatenate([b.H, c.D]),
            "d": np.concatenate([np.zeros(b.size), c.d]),
            "lower": np.concatenate([b.lower, c.lower]),
            "upper": np.concatenate([b.upper, c.upper]),
        }
        c = replace(c, layout=((b.kind, b.steps, b.size), *c.layout), **more)
    return c


def with_constant_sets(mpc: MPC) -> MPC:
    """Return the problem with limits that differ from stage to stage as outputs, and a box around
    them in their place; a box of inputs as it is."""
    n, N = mpc.system.n, mpc.horizon
    outputs = list(as_tuple("outputs", mpc.outputs, Outputs))
    changes: dict[str, Any] = {}
    for name, stages in (("states", mpc.state_stages), ("inputs", tuple(range(N)))):
        set_ = getattr(mpc, name)
        if not differing(set_) or (name == "inputs" and isinstance(set_, Box)):
            continue
        H, lower, upper = set_.rows()
        labels = set_.labels if isinstance(set_, Polytope) else mpc.system.state_names
        C, D = (H, None) if name == "states" else (np.zeros((np.shape(H)[-2], n)), H)
        outputs.append(Outputs(C, lower, upper, D, stages, labels))
        changes[name] = hard_constraints.around(set_)
    return replace(mpc, outputs=tuple(outputs), **changes) if changes else mpc


def with_equalities(mpc: MPC) -> MPC:
    """Return the problem with the rows of polytopes that imply equalities, as two opposite ones do,
    as outputs with lower = upper, and a box around each of these sets in its place.

    The equalities are `implied_equalities` to rounding: two rows that are opposite but for that
    are one equality. Of those that depend on each other as many are kept as are independent.
    """
    n, m, N = mpc.system.n, mpc.system.m, mpc.horizon
    outputs = list(as_tuple("outputs", mpc.outputs, Outputs))
    changes: dict[str, Any] = {}
    places = {
        "inputs": (m, tuple(range(N))),
        "states": (n, mpc.state_stages),
        "terminal_set": (n, (N,)),
    }
    for name, (size, stages) in places.items():
        set_ = getattr(mpc, name)
        if not isinstance(set_, Polytope):
            continue
        H, h = np.asarray(set_.H, np.float64), np.asarray(set_.h, np.float64)
        part = binding_rows(H, h, name)
        H, h = H[part], h[part]
        equal = implied_equalities(*unit_rows(H, h), ROUNDING / 100)
        if not equal.any():
            continue
        one = independent(*unit_rows(H[equal], h[equal]))
        rows = np.append(np.flatnonzero(equal)[one], np.flatnonzero(~equal))
        lower = np.where(np.arange(len(rows)) < len(one), h[rows], -np.inf)
        C, D = (H[rows], None) if name != "inputs" else (np.zeros((len(rows), n)), H[rows])
        labels = tuple(set_.labels[i] for i in part[rows]) if set_.labels else ()
        outputs.append(Outputs(C, lower, h[rows], D, stages, labels))
        changes[name] = Box(*set_bounds(set_, size))
    return replace(mpc, outputs=tuple(outputs), **changes) if changes else mpc


def as_box(set_: Any) -> Any:
    """Return a Polytope whose rows are limits of single coordinates as the same Box, other sets as
    they are. Two opposite rows become one equality then, also where they are that but for rounding,
    and limits of inputs part of the proofs' support functions. Rows must be powers of two long, so
    that nothing is rounded."""
    if isinstance(set_, Box):
        return _joined(set_)
    if not isinstance(set_, Polytope):
        return set_
    H, h = np.asarray(set_.H, np.float64), np.asarray(set_.h, np.float64)
    entry = H.sum(axis=1)
    if not (np.all(np.sum(H != 0, axis=1) == 1) and np.all(np.abs(np.frexp(entry)[0]) == 0.5)):
        return set_
    with np.errstate(over="ignore"):
        limit = np.where(H != 0, (h / entry)[:, None], np.nan)
    upper = np.nanmin(np.where(H > 0, limit, np.inf), axis=0, initial=np.inf)
    lower = np.nanmax(np.where(H < 0, limit, -np.inf), axis=0, initial=-np.inf)
    return _joined(Box(lower, upper)) if np.all(lower <= upper) else set_


def _joined(limits: Any) -> Any:
    """Return a Box or Outputs with both limits the lower one where they are equal but for rounding,
    as 0.3 and 0.1 + 0.2 are: whoever keeps that one keeps both."""
    lower, upper = (np.asarray(v, np.float64) for v in (limits.lower, limits.upper))
    with np.errstate(invalid="ignore"):
        apart = upper - lower
        size = np.maximum(np.abs(lower), np.abs(upper))
    equal = (apart > 0) & (apart <= ROUNDED * size) & np.isfinite(size)
    return replace(limits, upper=np.where(equal, lower, upper)) if equal.any() else limits
