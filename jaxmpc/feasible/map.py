"""Maps of the feasible set: every point proved feasible, proved infeasible, or undecided."""

import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmpc.arrays import Reals, host_array
from jaxmpc.batches import Part, chosen_devices, count, default_chunk, joined, slices, work_off
from jaxmpc.checks import fail, number, require_step_type, whole
from jaxmpc.feasible import proofs
from jaxmpc.feasible.hard_constraints import Axes, ExactData
from jaxmpc.feasible.hull_labels import hull_for
from jaxmpc.feasible.pipeline import Labels, OnDemand, Scope, labelled_parts
from jaxmpc.feasible.policy_hull import policy_hull, policy_labels
from jaxmpc.feasible.policy_problem import PolicyProblem, problem_of
from jaxmpc.feasible.polytope_growth import any_policy_polytope
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import closed_bounds
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.jax_transformations import default_platform, on_host
from jaxmpc.qp.status import Status
from jaxmpc.sets.convex_sets import Ellipsoid, Polytope
from jaxmpc.sets.geometry import hull_volume
from jaxmpc.sets.lp import power_of_two

# Volumes are sums of rounded products; bounds are widened by more than that.
VOLUME_ROUNDING = 1e-11
# Points that a GPU takes at once where rays have found polytopes, which need little memory a point.
HULL = 2**22
# Why labels under policies take no executor.
EXECUTOR = "given with affine policies or tubes, whose hull one process keeps"
# What refinement proves, and its dimensions in data sets.
BOUNDS = {
    "bound_point": ("ray", "coordinate"),
    "bound_normal": ("facet", "coordinate"),
    "bound_offset": ("facet",),
}
MEANINGS = {
    "bound_point": "state at the end of a ray that is proved feasible",
    "bound_normal": "a of a half-space a'x <= b that holds all feasible states",
    "bound_offset": "b of a half-space a'x <= b that holds all feasible states",
}


@record
class FeasibleSetMap:
    """Points of a state space, each with its label and the proof of it (see `Labels`).

    problem: what was asked. x0s (B, d): the points, in the states `axes`. labels: of the points,
    with their proofs. bound_point (K, d): points that `refine` proved feasible. bound_normal
    (F, d), bound_offset (F,): half-spaces a'x ≤ b that `refine` proved valid.
    """

    problem: FeasibilityProblem
    x0s: np.ndarray
    labels: Labels
    bound_point: np.ndarray
    bound_normal: np.ndarray
    bound_offset: np.ndarray

    def __repr__(self) -> str:
        bounds = f"; bounds: {len(self.bound_point)} points, {len(self.bound_offset)} half-spaces"
        return f"FeasibleSetMap in {', '.join(self.axis_names)}: {self.labels}{bounds}"

    @classmethod
    def of(cls, problem: FeasibilityProblem, x0s: Reals, labels: Labels) -> "FeasibleSetMap":
        """Return a map from labels that were made elsewhere, by chunks or from a store."""
        d = problem.dimension
        none = np.zeros((0, d)), np.zeros((0, d)), np.zeros(0)
        return cls(problem, np.asarray(x0s, float), labels, *none)

    @property
    def mpc(self) -> MPC:
        """Return the MPC problem, without soft rows and weights of input rates."""
        return self.problem.mpc

    @property
    def claim(self) -> str:
        """Return what the labels 1 and −1 say, in a sentence: of a robust problem they are claims
        about a class of policies."""
        mpc = self.mpc
        if mpc.disturbance is None:
            return "Feasible: some plan keeps all limits; infeasible: none does."
        kinds = {
            "tightened": "a plan with the feedback of the gain",
            "tube": "a tube of the gain about a nominal plan",
            "affine": "an affine policy",
        }
        return (
            f"Feasible: {kinds[mpc.policy]} keeps all limits under every disturbance; infeasible: "
            "no policy of this class does, others may (any_policy_labels)."
        )

    def any_policy_labels(self) -> np.ndarray:
        """Return labels (B,) int8 of the same points about any policy, whose inputs may be any
        function of the states so far: 1 where some policy keeps all limits under every disturbance,
        −1 where none does, so that no other `policy` helps, 0 where a point lies within 1e-9 of
        the boundary, or is not finite.

        A point labelled feasible is. Others are compared with `any_policy_polytope`, which is
        exact to rounding. Raises ValueError as that does, and for a projection.
        """
        view = self.problem.view
        if view.projects:
            fail("axes", "give a projection, of which there is no such set", "Give fixed too")
        if self.mpc.disturbance is None:
            return self.label.copy()
        H, h = any_policy_polytope(self.mpc).half_spaces()
        x = view.states(self.x0s)
        with np.errstate(invalid="ignore", over="ignore"):
            beyond = x @ H.T - h
            near = 1e-9 * (np.abs(x) @ np.abs(H).T + np.abs(h))
        inside, outside = np.all(beyond < -near, axis=1), np.any(beyond > near, axis=1)
        inside |= self.label == 1
        outside &= np.isfinite(x).all(axis=1) & ~inside
        return np.where(inside, 1, np.where(outside, -1, 0)).astype(np.int8)

    @property
    def axes(self) -> tuple[int, ...]:
        """Return the indices of the d mapped states."""
        return self.problem.view.axes

    @property
    def fixed(self) -> np.ndarray | None:
        """Return the values (n,) of the other states in a slice, zero at `axes`; None for a
        projection or where all states are mapped."""
        return self.problem.view.fixed

    @property
    def label(self) -> np.ndarray:
        """Return the labels (B,) int8: 1 proved feasible, −1 proved infeasible, 0 undecided."""
        return self.labels.label

    @property
    def status(self) -> np.ndarray:
        """Return the values of `Status` (B,), int8."""
        return self.labels.status

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Return the names of the mapped states with their units."""
        return self.problem.axis_names

    def counts(self) -> dict[str, int]:
        """Return how many points are feasible, infeasible, undecided, not finite, not run."""
        return self.labels.counts()

    @property
    def _inside(self) -> np.ndarray:
        """Return all points proved feasible (K, d)."""
        return np.concatenate([self.x0s[self.label == 1], self.bound_point])

    def cuts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all half-spaces a'x ≤ b proved valid for the feasible set: a (K, d), b (K,)."""
        proved = (self.label == -1) & np.isfinite(self.labels.cut_offset)
        normals = np.concatenate([self.labels.cut_normal[proved], self.bound_normal])
        offsets = np.concatenate([self.labels.cut_offset[proved], self.bound_offset])
        return normals, offsets

    @property
    def _unit(self) -> np.ndarray:
        """Return units (d,) in which the points proved feasible are about 1 apart: qhull and LPs
        need coordinates of like size."""
        points = self._inside
        return power_of_two(np.ptp(points, axis=0) if len(points) else np.zeros(points.shape[1]))

    def inner(self) -> Polytope:
        """Return the convex hull of all points proved feasible: a subset of the feasible set.

        Raises ValueError while these points have no interior.
        """
        return scaled_back(
            Polytope.from_points(self._inside / self._unit).require_body(), self._unit
        )

    def outer(self) -> Polytope:
        """Return the intersection of all half-spaces proved valid: a superset of the feasible set.

        Raises ValueError where it is unbounded, empty or flat.
        """
        normals, offsets = self.cuts()
        if not len(offsets):
            what = "no half-space is proved that holds on the whole set"
            fail("outer", what, "Map points outside the set, or refine(), if it is bounded")
        return scaled_back(
            Polytope(normals * self._unit, offsets).require_body().reduce(), self._unit
        )

    def volume_bounds(self) -> tuple[float, float]:
        """Return certified bounds on the volume (area in 2-D) of the feasible set, or of its
        section.

        (0, 0) where the half-spaces leave nothing, an upper bound of inf where they leave an
        unbounded set.
        """
        low = hull_volume(self._inside) * (1 - VOLUME_ROUNDING)
        normals, offsets = self.cuts()
        outer = Polytope(normals * self._unit, offsets)
        if len(offsets) and outer.is_empty():
            return low, 0.0
        try:
            whole = outer.require_body().reduce().volume()
            high = float(whole * np.prod(self._unit)) * (1 + VOLUME_ROUNDING)
        except ValueError:
            high = np.inf
        return low, high

    def terminal_section(self) -> Polytope | None:
        """Return the terminal set in the mapped states (slice or all states), None where there is
        none.

        An Ellipsoid is given as a polygon of 256 of its boundary points, in two mapped states.
        """
        set_, view = self.mpc.terminal_set, self.problem.view
        axes, others = list(view.axes), list(view.others)
        if set_ is None or self.mpc.dimension > self.mpc.system.n or view.projects:
            return None
        rest = view.fixed[others] if others else np.zeros(0)
        if isinstance(set_, Ellipsoid):
            return elliptic_section(set_, axes, others, rest)
        body = set_ if isinstance(set_, Polytope) else set_.to_polytope()
        H, h = np.asarray(body.H, float), np.asarray(body.h, float)
        return Polytope(H[:, axes], h - H[:, others] @ rest)

    @on_host
    def refine(
        self, gap: float = 1e-6, rounds: int = 30, *, deadline: float = np.inf
    ) -> "FeasibleSetMap":
        """Send rays through the vertices of the outer polytope until the volume bounds meet.

        Each ray adds a proved boundary point and a proved facet (`boundary`); in up to four
        mapped dimensions this ends at the exact polytope. Undecided points that a facet excludes
        are labelled infeasible. gap: relative gap of the volume bounds at which to stop;
        a warning tells the gap where the rays, or rounds of them, end before. deadline: of
        `time.monotonic`, after which no round of rays begins. A set without interior, or unbounded,
        is returned as it is.
        """
        found, left = self.refined(gap, rounds, deadline=deadline)
        if left > gap:
            warn_of_gap(left, gap)
        return found

    def refined(
        self, gap: float, rounds: int = 30, *, deadline: float = np.inf
    ) -> tuple["FeasibleSetMap", float]:
        """Return the map of `refine`, and the gap that its rays leave, 0 for sets without one."""
        number("gap", gap, 0, "Give a gap of at least 0")
        if isinstance(self.problem, PolicyProblem):  # rays were sent for the labels
            points, _, normals, offsets, _ = policy_hull(self.problem).bounds
            found = replace(self, bound_point=points, bound_normal=normals, bound_offset=offsets)
            return found, 0.0
        try:
            rays, proved, left = closed_bounds(self.problem, gap, rounds, deadline=deadline)
        except ValueError:
            return self, 0.0
        box = self.problem.programs.bounding_box[0]
        bounded = box is not None and np.all(np.isfinite(box))
        points, _, normals, offsets, _ = proved
        labels = excluded(self.labels, rays.exact, self.x0s, normals, offsets)
        found = replace(
            self, labels=labels, bound_point=points, bound_normal=normals, bound_offset=offsets
        )
        return found, left if bounded else 0.0

    def to_xarray(self) -> Any:
        """Return the map as an xarray.Dataset along the dimension `sample`, names and units
        attached; its variables are `x0`, those of `Labels`, and `bound_point`, `bound_normal`,
        `bound_offset`."""
        import xarray as xr

        further = {"start": ("state",), "plan": ("time", "input"), "cut_normal": ("coordinate",)}
        further["answer"] = ("time", "input", "cause", "direction")
        if self.mpc.policy == "tube":
            further["answer"] = ("generator",)
        data: dict[str, Any] = {
            name: (("sample", *further.get(name, ())), value)
            for name, value in self.labels.arrays().items()
        }
        data["x0"] = ("sample", "coordinate"), self.x0s
        data |= {
            name: (axes, getattr(self, name), {"long_name": MEANINGS[name]})
            for name, axes in BOUNDS.items()
        }
        names = {
            "coordinate": list(self.axis_names),
            "state": list(self.mpc.labels),
            "input": list(self.mpc.system.input_labels),
        }
        return xr.Dataset(data, coords=names)


def warn_of_gap(left: float, gap: float) -> None:
    """Warn that the bounds of a volume differ by `left` of it after `refine`."""
    what = f"differ by {left:.2g} of it, more than the gap {gap:.2g}"
    warnings.warn(f"refine: the bounds of the volume {what}", stacklevel=3)


def scaled_back(body: Polytope, unit: np.ndarray) -> Polytope:
    """Return {x: x / unit ∈ body}."""
    return Polytope(np.asarray(body.H) / unit, np.asarray(body.h))


def elliptic_section(
    body: Ellipsoid, axes: list[int], others: list[int], rest: np.ndarray
) -> Polytope | None:
    """Return a polygon in the section {y: (y, rest)'P(y, rest) ≤ level}; None unless y has two
    entries.

    With S the block of P at y, c = −S⁻¹ P_yo rest and α = level − rest'P_oo rest + c'S c the
    section is (y − c)'S(y − c) ≤ α.
    """
    P, level = np.asarray(body.P, float), float(np.asarray(body.level))
    S = P[np.ix_(axes, axes)]
    center = -np.linalg.solve(S, P[np.ix_(axes, others)] @ rest)
    inside = level - rest @ P[np.ix_(others, others)] @ rest + center @ S @ center
    if len(axes) != 2 or inside <= 0:
        return None
    return Polytope.from_points(center + Ellipsoid(S, inside).boundary(256))


def excluded(
    labels: Labels, p: ExactData, points: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> Labels:
    """Return labels where undecided points that one of the half-spaces excludes are infeasible.

    This is done only within the extent of the feasible set that LPs found: there a half-space of
    `proofs.everywhere` is one of `proofs.cut`, and no label depends on an LP.
    """
    within = np.all(np.abs(points) + p.side_0 * points <= p.reach_0, axis=1)
    left = np.flatnonzero((labels.status == Status.ITERATION_LIMIT) & within)
    if not len(left) or not len(offsets):
        return labels
    with jax.enable_x64(True):
        a, b, theta = jnp.asarray(normals), jnp.asarray(offsets), jnp.asarray(points[left])
        excludes = np.asarray(proofs.excludes(a, b, jnp.zeros_like(a), theta[:, None]))
    out = np.flatnonzero(excludes.any(axis=1))
    left, by = left[out], np.argmax(excludes[out], axis=1)
    found = {
        "cut_normal": OnDemand(lambda: normals[by]),
        "cut_offset": OnDemand(lambda: offsets[by]),
    }
    return labels.changed(left, -1, Status.PRIMAL_INFEASIBLE, found)


@on_host
def map_feasible_set(
    mpc: MPC | FeasibilityProblem,
    x0s: Reals,
    *,
    axes: Axes = None,
    fixed: Reals | None = None,
    iterations: int = 50,
    dtype: Any = "float32",
    chunk: int | None = None,
    gap: float | None = None,
    progress: bool = False,
    executor: Any = None,
    devices: Any = None,
) -> FeasibleSetMap:
    """Label each point: is there an input sequence that keeps every hard constraint of `mpc`?

    x0s: points (B, d). axes: indices or names of the d mapped states (None: all n). fixed: values
    of the other states (n − d,), or of all (n,), for a slice through them; None with d < n: a
    projection (feasible if some value of the other states is). Where input rates are limited the
    previous inputs are states too.
    iterations, dtype: of the ADMM stage alone; they cannot make a label wrong.
    chunk: number of points that a compiled program takes at once (None: by device).
    gap: call `FeasibleSetMap.refine` with this gap, None to skip it. progress: show a bar.
    executor: what labels the chunks, such as a `concurrent.futures.ProcessPoolExecutor` with the
    start method spawn, or the executor of a cluster: `submit(function, *arguments)` returns a
    future with `result()`; None: this process.
    devices: a number of them, or a sequence of JAX devices, which share the points of a chunk;
    None: the default device.

    The cost is ignored. Every label rests on a proof in float64
    (`proofs.py`): an input sequence whose roll-out keeps all rows, or a half-space that excludes
    the point, each by more than rounding; what is neither is 0, undecided. Where equalities tie the
    inputs to the states (a terminal point) the proof is that inputs within rounding of the plan
    keep them exactly; two rows of a polytope that are opposite but for rounding are one equality.
    Where input rates are limited the states are (x, u_{−1}), and one whose previous input the input
    limits exclude, which cannot have been applied, is labelled −1. Of a robust problem a label is
    about its policy: 1 that one keeps all rows under every disturbance, −1 that none of its kind
    does; affine ones are combined from those at the ends of rays (`policy_hull.py`), for up to four
    states. The last undecided points, up to 2,000 in a call, get linear programs of some
    milliseconds each, an equal share of each chunk. Labels and proofs are the same with an executor
    and without, bit for bit on processors of one kind; a chunk whose worker died is submitted again
    up to 3 times, with a warning.

    A point with NaN or infinity gets status NON_FINITE and label 0. Raises ValueError for wrong
    shapes and ill-posed problems before anything compiles. `sweep` labels a grid into a store.
    """
    if isinstance(mpc, FeasibilityProblem):
        problem = mpc
        if axes is not None or fixed is not None:
            fail("axes, fixed", "given with a FeasibilityProblem", "It has its own view")
    else:
        problem = problem_of(mpc, axes, fixed)
    whole("iterations", iterations, 1)
    require_step_type(dtype)
    if gap is not None:
        number("gap", gap, 0, "Give a gap of at least 0, or None")
    result = map_points(
        problem,
        x0s,
        iterations=iterations,
        dtype=dtype,
        chunk=chunk,
        progress=progress,
        executor=executor,
        devices=devices,
    )
    return result if gap is None else result.refine(gap)


@on_host
def map_points(
    problem: FeasibilityProblem,
    x0s: Reals,
    *,
    progress: bool = False,
    deadline: float = np.inf,
    **settings: Any,
) -> FeasibleSetMap:
    """Label the points (B, d) of a feasibility problem; settings: those of `label_chunks`. Points
    that are left at the deadline (of `time.monotonic`) get status NOT_RUN."""
    points, parts = host_array("x0s", x0s, copy=False), list[Part[Labels]]()
    _require_points(problem, points)
    if isinstance(problem, PolicyProblem):
        return _map_policies(problem, points, settings)
    with ThreadPoolExecutor(1) as copies:
        kept = copies.submit(joined, [points])  # while the device works
        chunks = label_chunks(problem, points, **settings)
        done = work_off(
            chunks, parts.append, len(points), unit="pt", progress=progress, deadline=deadline
        )
        left = Labels.empty(len(points) - done.count, problem)
        labels = Labels.joined([*(p.result for p in parts), left])
        return FeasibleSetMap.of(problem, kept.result(), labels)


def _map_policies(
    problem: PolicyProblem, points: np.ndarray, settings: Mapping[str, Any]
) -> FeasibleSetMap:
    """Label points (B, d) under affine policies."""
    if settings.get("executor") is not None:
        fail("executor", EXECUTOR, "Leave it out")
    chunk = settings.get("chunk")
    chunk = None if chunk is None else whole("chunk", chunk, 1)
    labels = policy_labels(problem, points, chunk, settings.get("devices"))
    return FeasibleSetMap.of(problem, points.copy(), labels)


def _require_points(problem: FeasibilityProblem, points: np.ndarray) -> None:
    d = problem.dimension
    if points.ndim != 2 or points.shape[1] != d:
        columns = f"points (B, {d}), one column a mapped state"
        if problem.mpc.rate_limited and points.shape[1:] == (problem.mpc.system.n,):
            n = problem.mpc.system.n
            columns = f"points (B, {d}): states, then previous inputs, for rates are limited; or "
            columns += f"map a slice: axes={list(range(n))}, fixed={[0] * (d - n)}"
        elif points.ndim == 2 and 0 < points.shape[1] < d:
            k = points.shape[1]
            columns += f"; or map a slice: axes={list(range(k))}, fixed={[0] * (d - k)}"
        fail("x0s", f"shape {points.shape}", f"Give {columns}")


def label_chunks(
    problem: FeasibilityProblem,
    points: np.ndarray,
    *,
    chunk: int | None = None,
    scope: Scope | None = None,
    **settings: Any,
) -> Iterator[Part[Labels]]:
    """Label points chunk by chunk; the place of each part is its slice. See `map_feasible_set`.

    scope: None for that of these points; settings: further ones of `labelled_parts`.
    """
    points = np.asarray(points, np.float64)
    _require_points(problem, points)
    before = problem.memory.get("points", 0)
    total = before + len(points) if scope is None else scope.points
    if chunk is None:
        devices = count(chosen_devices(settings.get("devices")))
        held = 16 * sum(problem.rows.U.shape)  # vectors of rows and inputs
        if default_platform() != "cpu" and hull_for(problem, total) is not None:
            chunk = devices * default_chunk(held / 4, HULL)
        else:
            chunk = devices * default_chunk(held)
    chunk = min(whole("chunk", chunk, 1), max(len(points), 1))
    places = slices(len(points), chunk)
    if scope is None:
        empty = problem.programs.bounding_box[0] is None
        scope = Scope.of(points, len(places), before, extent=empty)
        problem.memory["points"] = total
    yield from labelled_parts(problem, places, points.__getitem__, scope, chunk, **settings)
