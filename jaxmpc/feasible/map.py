"""Maps of the feasible set: every point proved feasible, proved infeasible, or undecided."""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm.std import tqdm

from jaxmpc.arrays import Reals, host_array
from jaxmpc.checks import fail, number, require_kind, require_memory, whole
from jaxmpc.feasible import proofs
from jaxmpc.feasible.candidates import StagePenalties
from jaxmpc.feasible.centered_polytope import power_of_two
from jaxmpc.feasible.executors import label_elsewhere
from jaxmpc.feasible.labels import Labels, OnDemand
from jaxmpc.feasible.pipeline import label_chunks
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Rays
from jaxmpc.feasible.refinement import refined
from jaxmpc.mpc.problem import MPC
from jaxmpc.pytrees import record
from jaxmpc.qp.status import Status
from jaxmpc.sets.ellipsoid import Ellipsoid
from jaxmpc.sets.geometry import hull_volume
from jaxmpc.sets.polytope import Polytope

# Volumes are sums of rounded products; bounds are widened by more than that.
VOLUME_ROUNDING = 1e-11


def grid(lower: Reals, upper: Reals, shape: Any) -> np.ndarray:
    """Return the points of a regular grid, end points included: (Π shape, d), first coordinate
    slowest. A number among lower, upper (d,) and shape (d,) holds along each axis.

    Raises ValueError for what is no grid, and for one that does not fit into memory.
    """
    given = (host_array("grid lower", lower), host_array("grid upper", upper), np.asarray(shape))
    d = max(np.size(value) for value in given)
    lower, upper, shape = (v if v.ndim else np.full(d, v) for v in given)
    shape = tuple(whole("grid shape", k, 1) for k in shape.ravel().tolist())
    if not shape or not lower.shape == upper.shape == (len(shape),):
        fail("grid", f"lower {lower.shape}, upper {upper.shape}, shape {shape}", "Same length each")
    if not (np.all(np.isfinite(lower)) and np.all(np.isfinite(upper)) and np.all(lower <= upper)):
        fail("grid", f"lower {lower}, upper {upper}", "Give finite lower ≤ upper")
    require_memory("grid", 16 * len(shape) * math.prod(shape), "Give fewer points")
    lines = [np.linspace(*ends) for ends in zip(lower, upper, shape, strict=True)]
    return mesh(lines)


def mesh(lines: Sequence[np.ndarray], index: np.ndarray | None = None) -> np.ndarray:
    """Return the points (B, d) of a grid with these d coordinates, the first one slowest; index
    (k,): only these of them, which needs no memory for the others."""
    if index is None:
        return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, len(lines))
    place = np.unravel_index(index, [len(line) for line in lines])
    return np.stack([line[i] for line, i in zip(lines, place, strict=True)], axis=-1)


@record
class FeasibleSetMap:
    """Points of a state space, each with its label and the proof of it (see `Labels`).

    x0s (B, d): the points, in the states `axes`. bound_point (K, d), bound_normal (F, d),
    bound_offset (F,): points proved feasible and half-spaces proved valid by `refine`.
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

    def inner(self) -> Polytope:
        """Return the convex hull of all points proved feasible: a subset of the feasible set.

        Raises ValueError while these points have no interior.
        """
        points = np.concatenate([self.x0s[self.label == 1], self.bound_point])
        return scaled_back(Polytope.from_points(points / self._unit), self._unit)

    def cuts(self) -> tuple[np.ndarray, np.ndarray]:
        """Return all half-spaces a'x ≤ b proved valid for the feasible set: a (K, d), b (K,)."""
        proved = (self.label == -1) & np.isfinite(self.labels.cut_offset)
        normals = np.concatenate([self.labels.cut_normal[proved], self.bound_normal])
        offsets = np.concatenate([self.labels.cut_offset[proved], self.bound_offset])
        return normals, offsets

    def outer(self) -> Polytope:
        """Return the intersection of all half-spaces proved valid: a superset of the feasible set.

        Raises ValueError where it is unbounded, empty or flat.
        """
        normals, offsets = self.cuts()
        if not len(offsets):
            what = "no half-space is proved that holds on the whole set"
            fail("outer", what, "Map points outside the set, or refine(), if it is bounded")
        return scaled_back(Polytope(normals * self._unit, offsets).reduce(), self._unit)

    @property
    def _unit(self) -> np.ndarray:
        """Return units (d,) in which the points proved feasible are about 1 apart: qhull and LPs
        need coordinates of like size."""
        points = np.concatenate([self.x0s[self.label == 1], self.bound_point])
        return power_of_two(np.ptp(points, axis=0) if len(points) else np.zeros(points.shape[1]))

    def volume_bounds(self) -> tuple[float, float]:
        """Return certified bounds on the volume (area in 2-D) of the feasible set, or of its
        section.

        (0, 0) where the half-spaces leave nothing, an upper bound of inf where they leave an
        unbounded set.
        """
        points = np.concatenate([self.x0s[self.label == 1], self.bound_point])
        low = hull_volume(points) * (1 - VOLUME_ROUNDING)
        normals, offsets = self.cuts()
        outer = Polytope(normals * self._unit, offsets)
        if len(offsets) and outer.is_empty():
            return low, 0.0
        try:
            high = float(outer.reduce().volume() * np.prod(self._unit)) * (1 + VOLUME_ROUNDING)
        except ValueError:
            high = np.inf
        return low, high

    def terminal_section(self) -> Polytope | None:
        """Return the terminal set in the mapped states (slice or all states), None where there is
        none.

        An Ellipsoid is given as a polygon of 256 of its boundary points, in two mapped states.
        """
        set_ = self.mpc.terminal_set
        view = self.problem.view
        axes, others = list(view.axes), list(view.others)
        if set_ is None or self.mpc.dimension > self.mpc.system.n or view.projects:
            return None
        rest = view.fixed[others] if others else np.zeros(0)
        if isinstance(set_, Ellipsoid):
            return ellipse(
                np.asarray(set_.P, float), float(np.asarray(set_.level)), axes, others, rest
            )
        body = set_ if isinstance(set_, Polytope) else set_.to_polytope()
        H, h = np.asarray(body.H, float), np.asarray(body.h, float)
        return Polytope(H[:, axes], h - H[:, others] @ rest)

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
        try:
            found = refined(Rays.of(self.problem), gap, rounds, deadline=deadline)
        except ValueError:
            return self
        left, box = found.gap, self.problem.programs.bounding_box[0]
        if left > gap and box is not None and np.all(np.isfinite(box)):
            warnings.warn(
                f"refine: the bounds of the volume differ by {left:.2g} of it, more than the "
                f"gap {gap:.2g}", stacklevel=2,
            )  # fmt: skip
        labels = excluded(self.labels, found.rays, self.x0s, found.normals, found.offsets)
        return replace(
            self, labels=labels, bound_point=found.points, bound_normal=found.normals,
            bound_offset=found.offsets,
        )  # fmt: skip

    def to_xarray(self) -> Any:
        """Return the map as an xarray.Dataset along the dimension `sample`, names and units
        attached."""
        import xarray

        data = {
            "label": ("sample", self.label),
            "status": ("sample", self.status),
            "x0": (("sample", "coordinate"), self.x0s),
            "start": (("sample", "state"), self.labels.start),
            "plan": (("sample", "time", "input"), self.labels.plan),
            "cut_normal": (("sample", "coordinate"), self.labels.cut_normal),
            "cut_offset": ("sample", self.labels.cut_offset),
            "bound_point": (("ray", "coordinate"), self.bound_point),
            "bound_normal": (("facet", "coordinate"), self.bound_normal),
            "bound_offset": ("facet", self.bound_offset),
        }
        system = self.mpc.system
        names = {
            "coordinate": list(self.axis_names),
            "state": list(self.mpc.labels),
            "input": list(system.input_labels),
        }
        return xarray.Dataset(data, coords=names)


def scaled_back(body: Polytope, unit: np.ndarray) -> Polytope:
    """Return {x: x / unit ∈ body}."""
    return Polytope(np.asarray(body.H) / unit, np.asarray(body.h))


def ellipse(
    P: np.ndarray, level: float, axes: list[int], others: list[int], rest: np.ndarray
) -> Polytope | None:
    """Return a polygon in the section {y: (y, rest)'P(y, rest) ≤ level}; None unless y has two
    entries.

    With S the block of P at y, c = −S⁻¹ P_yo rest and α = level − rest'P_oo rest + c'S c the
    section is (y − c)'S(y − c) ≤ α.
    """
    S, cross = P[np.ix_(axes, axes)], P[np.ix_(axes, others)] @ rest
    centre = -np.linalg.solve(S, cross)
    inside = level - rest @ P[np.ix_(others, others)] @ rest + centre @ S @ centre
    if len(axes) != 2 or inside <= 0:
        return None
    angle = 2 * np.pi * np.arange(256) / 256
    circle = np.stack([np.cos(angle), np.sin(angle)])
    points = np.sqrt(inside) * np.linalg.solve(np.linalg.cholesky(S).T, circle).T
    return Polytope.from_points(centre + points)


def excluded(
    labels: Labels, rays: Rays, points: np.ndarray, normals: np.ndarray, offsets: np.ndarray
) -> Labels:  # fmt: skip
    """Return labels where undecided points that one of the half-spaces excludes are infeasible.

    This is done only within the extent of the feasible set that LPs found: there a half-space of
    `proofs.everywhere` is one of `proofs.cut`, and no label depends on an LP.
    """
    p = rays.exact
    within = np.all(np.abs(points) + p.side_0 * points <= p.reach_0, axis=1)
    left = np.flatnonzero((labels.status == Status.ITERATION_LIMIT) & within)
    if not len(left) or not len(offsets):
        return labels
    with jax.enable_x64(True):
        one = lambda a, b, x: proofs.excludes(a, b, jnp.zeros_like(a), x)
        table = jax.vmap(jax.vmap(one, in_axes=(0, 0, None)), in_axes=(None, None, 0))
        excludes = np.asarray(table(normals, offsets, points[left]))
    out = np.flatnonzero(excludes.any(axis=1))
    left, by = left[out], np.argmax(excludes[out], axis=1)
    found = {
        "cut_normal": OnDemand(lambda: normals[by]), "cut_offset": OnDemand(lambda: offsets[by])
    }  # fmt: skip
    return labels.changed(left, -1, Status.PRIMAL_INFEASIBLE, found)


def map_feasible_set(
    mpc: MPC | FeasibilityProblem, x0s: Reals, *, axes: Any = None,
    fixed: Reals | None = None,
    iterations: int = 50, dtype: Any = "float32", chunk: int | None = None,
    gap: float | None = None,
    penalties: StagePenalties | None = None, progress: bool = False, executor: Any = None,
    devices: Any = None,
) -> FeasibleSetMap:  # fmt: skip
    """Label each point: is there an input sequence that keeps every hard constraint of `mpc`?

    x0s: points (B, d). axes: indices of the d mapped states (None: all n). fixed: values (n,) of
    all states, for a slice through them; None with d < n: a projection (feasible if some value of
    the other states is). The cost is ignored. Every label rests on a proof in float64
    (`proofs.py`): an input sequence whose roll-out keeps all rows, or a half-space that excludes
    the point, each by more than rounding; what is neither is 0, undecided. Where equalities tie the
    inputs to the states (a terminal point) the proof is that inputs within rounding of the plan
    keep them exactly; two rows of a polytope that are opposite but for rounding are one equality.
    Where input rates are limited the states are (x, u_{−1}), and one whose previous input the input
    limits exclude, which cannot have been applied, is labelled −1. iterations and dtype affect the
    ADMM stage alone and cannot make a label wrong. The last undecided points, up to 2,000 in a
    call, get linear programs of some milliseconds each, an equal share of each chunk. chunk: number
    of points that a compiled program takes at once (None: by device). gap: call
    `FeasibleSetMap.refine` with this gap, None to skip it. penalties: of the ADMM stage.
    progress: show a bar. executor: what labels the chunks, such as a
    `concurrent.futures.ProcessPoolExecutor` with the start method spawn, or the executor of a
    cluster: `submit(function, *arguments)` returns a future with `result()`. Labels and proofs are
    those without it, bit for bit on processors of one kind. A chunk whose worker died is submitted
    again up to 3 times, with a warning. devices: a number of them, or a sequence of JAX devices,
    which share the points of a chunk; None: the default device.

    A point with NaN or infinity gets status NON_FINITE and label 0. Raises ValueError for wrong
    shapes and ill-posed problems before anything compiles.
    """
    if isinstance(mpc, FeasibilityProblem):
        problem = mpc
        if axes is not None or fixed is not None:
            fail("axes, fixed", "given with a FeasibilityProblem", "It has its own view")
    else:
        problem = FeasibilityProblem.of(mpc, axes, fixed)
    whole("iterations", iterations, 1)
    if chunk is not None:
        whole("chunk", chunk, 1)
    if gap is not None:
        number("gap", gap, 0, "Give a gap of at least 0, or None")
    if penalties is not None:
        require_kind("penalties", penalties, StagePenalties)
    result = map_points(
        problem, x0s, iterations=iterations, dtype=dtype, chunk=chunk, penalties=penalties,
        progress=progress, executor=executor, devices=devices,
    )  # fmt: skip
    return result if gap is None else result.refine(gap)


def map_points(
    problem: FeasibilityProblem, points: Any, *, progress: bool = False,
    deadline: float = np.inf, executor: Any = None, **settings: Any,
) -> FeasibleSetMap:  # fmt: skip
    """Label the points (B, d) of a feasibility problem; settings: those of `label_chunks`.

    deadline: of `time.monotonic`; chunks of points that are left then get status NOT_RUN. executor:
    as in `map_feasible_set`.
    """
    if executor is not None:
        settings["label"] = partial(label_elsewhere, executor)
    points = host_array("x0s", points)
    parts, done = [Labels.empty(0, problem)], 0
    with tqdm(total=len(points), unit="pt", disable=not progress) as bar:
        for _, part in label_chunks(problem, points, **settings):
            parts.append(part)
            done += len(part.label)
            bar.update(len(part.label))
            if time.monotonic() > deadline:
                break
    parts.append(Labels.empty(len(points) - done, problem))
    return FeasibleSetMap.of(problem, points, Labels.joined(parts))
