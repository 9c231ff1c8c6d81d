"""Samples of the feasible set, uniform in volume, each proved feasible, and the plans from them.

Two ways lead to points that are uniform on a convex set X_N:

*Triangulation*, where rays have found all vertices (up to four coordinates). The cones from the
centre to the facets of their hull are simplices: one is drawn in proportion to its volume, and a
point in it by exponential weights.

*Hit and run* else (Smith 1984, Operations Research 32; Lovász & Vempala 2006, SIAM J. Comput. 35).
A point moves to a random place on a chord through it, in many chains side by side. The end of a
chord of X_N itself would take a linear program. Here the chains run in a polytope around X_N, of
half-spaces that hold on the whole set, where it takes a minimum over rows; of its points, which
are uniform there, those in X_N are uniform in X_N. Rays through those that are not find facets,
until few are left out. So the half-spaces decide how many points are wasted, and not what is kept.
The chains run in coordinates in which the polytope is about as wide in each direction, and start
where earlier ones ended.

Every point that is kept is labelled feasible by the stages of `pipeline`, with its proof.
"""

import time
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxmpc.arrays import Reals
from jaxmpc.batches import Compiled, default_chunk
from jaxmpc.checks import fail, whole
from jaxmpc.feasible.hard_constraints import Axes
from jaxmpc.feasible.hull_labels import Hull, hull_for
from jaxmpc.feasible.map import map_points
from jaxmpc.feasible.pipeline import Labels
from jaxmpc.feasible.problem import FeasibilityProblem
from jaxmpc.feasible.rays import Boundary, Rays, of_length_one
from jaxmpc.files import write_arrays
from jaxmpc.mpc.many import solve_many
from jaxmpc.mpc.plan import Plan, flat_multipliers
from jaxmpc.mpc.problem import MPC
from jaxmpc.mpc.rows import layout
from jaxmpc.pytrees import record
from jaxmpc.qp.admm import ADMM, DEFAULT
from jaxmpc.qp.jax_transformations import on_host
from jaxmpc.sets.convex_sets import Polytope

# Chains side by side, and points of a trial that looks for facets.
CHAINS, TRIAL = 4096, 512
# Steps between two points of a chain that are kept, for each coordinate. A step takes 1/d of what a
# coordinate has left of its start: e^-6 after so many.
STEPS_BETWEEN = 6
# Random directions that all chains draw from; the products with the rows are made once.
DIRECTIONS = 4096
# Trials until so many points lie in X_N, each followed by rays through those that do not.
TRIALS, ENOUGH, RAYS = 24, 0.9, 200
# The hull of rays is the set if what it lacks is no more than this fraction of the volume.
MISSING_VOLUME = 1e-7
# Points that are drawn at once.
POINTS_AT_ONCE = 2**20


@record
class FeasibleSamples:
    """Points x0s (count, d), independent of each other or nearly so, uniform on the feasible set.

    labels: their proofs, as in `map_feasible_set`; all are feasible, and `labels.plan` are inputs
    that keep all hard constraints. method: "triangulation", whose points are independent, or
    "hit and run". chains: how many of these, 0 for none. steps: between their points. accepted: the
    fraction of the points drawn that lie in X_N. half_spaces: how many the chains run in. seconds:
    from the call on.
    """

    mpc: MPC
    problem: FeasibilityProblem
    x0s: np.ndarray
    labels: Labels
    method: str
    chains: int
    steps: int
    accepted: float
    half_spaces: int
    seconds: float

    def __repr__(self) -> str:
        how = f"{self.method}, {self.accepted:.1%} of the points drawn"
        return (
            f"FeasibleSamples: {len(self.x0s):,} states proved feasible, uniform on X_N "
            f"({how}; {self.seconds:.3g} s)"
        )

    @cached_property
    def states(self) -> np.ndarray:
        """Return the states (count, n), or (x, u_{−1}), that the points stand for."""
        whole = tuple(self.problem.view.axes) == tuple(range(self.mpc.dimension))
        return self.x0s if whole else self.labels.start

    def solve(self, solver: ADMM = DEFAULT, **settings: Any) -> Plan:
        """Return the optimal plans from the samples; settings: those of `solve_many`."""
        return solve_many(self.mpc, self.states, solver, **settings)

    def arrays(self, plans: Plan | None = None) -> dict[str, np.ndarray]:
        """Return the data set as arrays by name, samples in front: `x0`, `feasible_inputs` that
        prove it feasible, and of optimal plans `states`, `inputs`, `cost`, `status`, and
        `multipliers` in the order of `row_table`.

        plans: from `solve`; None: no optimal plans.
        """
        data = {"x0": self.states, "feasible_inputs": self.labels.plan}
        if plans is None:
            return data
        if np.shape(plans.status) != (len(self.x0s),):
            what = f"{np.shape(plans.status)} plans for {len(self.x0s)} samples"
            fail("plans", what, "Give those of samples.solve()")
        with jax.enable_x64(True):
            each = jax.vmap(lambda y: flat_multipliers(layout(self.mpc), y))
            multipliers = np.asarray(each(jax.tree.map(jnp.asarray, plans.multipliers)))
        names = ("states", "inputs", "cost", "status")
        return {
            **data,
            **{name: np.asarray(getattr(plans, name)) for name in names},
            "multipliers": multipliers,
        }

    def save(self, path: str | Path, plans: Plan | None = None) -> None:
        """Write `arrays` as one .npz file, which appears whole or not at all."""
        if Path(path).suffix != ".npz":
            fail("path", f"{str(path)!r}", "Give a name that ends in .npz; for zarr see to_xarray")
        write_arrays(Path(path), None, **self.arrays(plans))

    def to_xarray(self, plans: Plan | None = None) -> Any:
        """Return `arrays` as an xarray.Dataset along `sample`; its `to_zarr` writes a store."""
        import xarray as xr

        axes = {
            "x0": ("state",),
            "feasible_inputs": ("time", "input"),
            "states": ("stage", "system_state"),
            "inputs": ("time", "input"),
            "multipliers": ("row",),
        }
        data = {
            name: (("sample", *axes.get(name, ())), value)
            for name, value in self.arrays(plans).items()
        }
        # (Labels name previous inputs too where those have a weight alone.)
        return xr.Dataset(data, coords={"state": list(self.mpc.labels)[: self.states.shape[1]]})


@on_host
def sample_feasible_set(
    mpc: MPC,
    count: int,
    *,
    seed: int = 0,
    axes: Axes = None,
    fixed: Reals | None = None,
    method: str = "auto",
    steps: int | None = None,
    **settings: Any,
) -> FeasibleSamples:
    """Draw states uniformly from the feasible set of an MPC problem, each proved feasible.

    count: how many. seed: of the random numbers; the same seed gives the same states on one kind of
    processor. axes, fixed: a slice or a projection, as in `map_feasible_set`. method:
    "triangulation" for independent states, where rays find all vertices (up to four coordinates);
    "hit and run" for any bounded set; "auto": the first where it works. steps: of hit and run
    between two states of a chain; None: 6 for each coordinate, after which little of their
    dependence is left. settings: further ones of `map_feasible_set`.

    With `FeasibleSamples.solve` and `save` it makes the data set of an approximate MPC: states with
    optimal inputs and multipliers. States within rounding of the boundary, for which no proof is
    found, are left out, as are those that stay undecided.

    Raises ValueError for wrong arguments, and where the feasible set is empty, flat or unbounded.
    """
    begun = time.perf_counter()
    problem = FeasibilityProblem.of(mpc, axes, fixed)
    count = whole("count", count, 1)
    whole("seed", seed, 0)
    if method not in ("auto", "triangulation", "hit and run"):
        fail("method", f"{method!r}", 'Give "auto", "triangulation" or "hit and run"')
    if steps is not None:
        whole("steps", steps, 1)
    box, _ = problem.programs.bounding_box
    if box is not None and not np.all(np.isfinite(box)):
        i = int(np.argmin(np.all(np.isfinite(box), axis=0)))
        what = f"its feasible set is unbounded along coordinate {i}"
        fail("mpc", what, "Nothing is uniform there: limit that state, or choose other axes")
    rays = Rays.of(problem)
    random = np.random.default_rng(seed)
    cones = None if method == "hit and run" else Cones.of(problem)
    if cones is None and method == "triangulation":
        what = "is for sets of up to four coordinates with flat facets"
        fail("method", f"'triangulation' {what}", 'Give "hit and run"')
    source: Cones | Chains = Chains.of(rays, random, steps, settings) if cones is None else cones
    return drawn(mpc, problem, count, source, random, begun, settings)


def drawn(
    mpc: MPC,
    problem: FeasibilityProblem,
    count: int,
    source: "Cones | Chains",
    random: np.random.Generator,
    begun: float,
    settings: dict[str, Any],
) -> FeasibleSamples:
    """Draw points from a source until `count` of them are proved feasible."""
    # Parts of few sizes, for which programs are compiled.
    chunk = min(max(1 << (count - 1).bit_length(), TRIAL), default_chunk())
    settings = {"chunk": chunk, **settings}
    points, labels, tried, kept = list[np.ndarray](), list[Labels](), 0, 0
    while kept < count:
        share = max(kept, 1) / tried if tried else 1.0
        if tried > 1000 and share < 1e-3:
            what = f"{kept} of {tried} points are proved feasible"
            fail("mpc", what, "Scale states and inputs, or give more iterations")
        wanted = min(int((count - kept) / share * 1.01) + 16, POINTS_AT_ONCE)
        x = source.draw(wanted, random)
        found = map_points(problem, x, **settings).labels
        inside = np.flatnonzero(found.label == 1)
        tried += len(x)
        kept += len(inside)
        inside = inside[: len(inside) - max(kept - count, 0)]
        points.append(x[inside])
        labels.append(found.rows(inside))
    return FeasibleSamples(
        mpc=mpc,
        problem=problem,
        x0s=np.concatenate(points),
        labels=Labels.joined(labels),
        method=source.method,
        chains=source.chains,
        steps=source.steps,
        accepted=kept / tried,
        half_spaces=source.half_spaces,
        seconds=time.perf_counter() - begun,
    )


class Cones(NamedTuple):
    """The simplices of the centre (d,) with each facet of a hull: edges (F, d, d) as columns, and
    their shares (F,) of the volume, summed up."""

    center: np.ndarray
    edges: np.ndarray
    shares: np.ndarray
    half_spaces: int
    method: str = "triangulation"
    chains: int = 0
    steps: int = 0

    @classmethod
    def of(cls, problem: FeasibilityProblem) -> "Cones | None":
        """Return the cones of the hull that rays have found, None where it is not all of the
        set."""
        hull = hull_for(problem, np.inf)
        if hull is None or not hull.gap <= MISSING_VOLUME:
            return None
        return cls.in_hull(hull)

    @classmethod
    def in_hull(cls, hull: Hull) -> "Cones":
        """Return the cones of a hull."""
        edges = np.linalg.inv(hull.M)
        volumes = np.abs(np.linalg.det(edges / np.abs(edges).max(axis=(0, 2))[:, None]))
        shares = np.cumsum(volumes)
        return cls(hull.center, edges, shares / shares[-1], len(hull.offsets))

    def draw(self, count: int, random: np.random.Generator) -> np.ndarray:
        """Return `count` independent points (count, d), uniform on the hull."""
        d = len(self.center)
        which = np.searchsorted(self.shares, random.random(count))
        # Exponential numbers divided by their sum are uniform on the simplex.
        weights = random.standard_exponential((count, d + 1))
        weights = weights[:, :d] / weights.sum(axis=1, keepdims=True)
        return self.center + np.einsum("fij,fj->fi", self.edges[which], weights)


class Bounds(NamedTuple):
    """Half-spaces normals (F, d) x ≤ offsets (F,) that hold on the whole set, none implied by the
    others."""

    normals: np.ndarray
    offsets: np.ndarray

    def with_rays(self, found: Boundary) -> "Bounds":
        """Return these and those that rays have found, as few as bound the same polytope."""
        valid = np.isfinite(found.offsets)
        normals = np.concatenate([self.normals, found.normals[valid]])
        offsets = np.concatenate([self.offsets, found.offsets[valid]])
        try:
            body = Polytope(normals, offsets).reduce()
        except ValueError:  # too ill-conditioned: more than are needed
            return Bounds(normals, offsets)
        return Bounds(np.asarray(body.H), np.asarray(body.h))


class Chains:
    """Chains of hit and run in the polytope normals y ≤ offsets, x = center + shape y.

    y (C, d): where the chains are. normals: in y, as `directions` (K, d); slopes (K, F): the
    products of these.
    """

    method = "hit and run"

    def __init__(
        self, center: np.ndarray, normals: np.ndarray, offsets: np.ndarray, steps: int, chains: int
    ) -> None:
        """Start chains at the centre of normals x ≤ offsets."""
        self.center, self.steps, self.chains = center, steps, chains
        self.normals, self.offsets = normals, offsets - normals @ center
        # The widths along the axes differ by no more than the distances of facets do.
        self.shape = np.diag(1 / np.abs(normals / self.offsets[:, None]).max(axis=0))
        self.y = np.zeros((chains, len(center)))

    @property
    def half_spaces(self) -> int:
        """Return the number of half-spaces."""
        return len(self.offsets)

    @classmethod
    def of(
        cls, rays: Rays, random: np.random.Generator, steps: int | None, settings: dict[str, Any]
    ) -> "Chains":
        """Return chains that have forgotten their start, in half-spaces among which most points lie
        in the feasible set."""
        problem, d = rays.problem, rays.problem.dimension
        steps = STEPS_BETWEEN * d if steps is None else steps
        box = rays.box()
        bounds = Bounds(box.normals, box.offsets).with_rays(
            rays.cast(of_length_one(random.standard_normal((8 * d, d))))
        )
        for _ in range(TRIALS):
            trial = cls(rays.center, *bounds, STEPS_BETWEEN * d, TRIAL)
            trial.settle(random)
            x = trial.draw(TRIAL, random)
            inside = map_points(problem, x, **{**settings, "chunk": TRIAL}).label == 1
            if np.mean(inside) >= ENOUGH:
                break
            bounds = bounds.with_rays(rays.cast(x[~inside][:RAYS] - rays.center))
        chains = cls(rays.center, *bounds, steps, CHAINS)
        chains.settle(random)
        return chains

    def settle(self, random: np.random.Generator) -> None:
        """Run the chains from the centre until they have forgotten it, in coordinates that their
        own spread gives: three times, each in better ones."""
        d = len(self.center)
        for _ in range(3):
            self.run(4 * STEPS_BETWEEN * d, random)
            spread = np.linalg.cholesky(np.cov((self.y @ self.shape.T).T).reshape(d, d))
            self.y = np.linalg.solve(spread, self.shape @ self.y.T).T
            self.shape = spread
        self.run(2 * STEPS_BETWEEN * d, random)

    def run(self, steps: int, random: np.random.Generator) -> None:
        """Take steps in all chains."""
        directions = of_length_one(random.standard_normal((DIRECTIONS, len(self.center))))
        rows = self.normals @ self.shape
        size = np.linalg.norm(rows, axis=1)
        rows, offsets = rows / size[:, None], self.offsets / size
        key = random.integers(2**32)
        with jax.enable_x64(True):
            self.y = WALK(self.y, rows, offsets, directions, directions @ rows.T, key,
                          np.arange(steps))  # fmt: skip

    def draw(self, count: int, random: np.random.Generator) -> np.ndarray:
        """Return points (count, d) of the chains, `steps` steps apart in each."""
        found = []
        for _ in range(-(-count // self.chains)):
            self.run(self.steps, random)
            found.append(self.center + self.y @ self.shape.T)
        return np.concatenate(found)[:count]


def walk(
    y: Array, rows: Array, offsets: Array, directions: Array, slopes: Array, seed: Any, steps: Array
) -> Array:
    """Return where chains y (C, d) are after hit-and-run steps in rows y ≤ offsets.

    The room that is left to each row (C, F) is most of the work, and is kept in float32: where a
    chain turns is off by as much, beside the size of the set. Places are in float64.
    """
    key, slopes = jax.random.key(seed), slopes.astype(jnp.float32)

    def step(carry: tuple[Array, Array], i: Array) -> tuple[Any, None]:
        y, room = carry
        first, second = jax.random.split(jax.random.fold_in(key, i))
        which = jax.random.randint(first, (len(y),), 0, len(directions))
        slope = slopes[which]
        # A chain that rounding has put beyond a row may not leave by more.
        far = jnp.maximum(room, 0.0) / slope
        high = jnp.min(jnp.where(slope > 0, far, jnp.inf), axis=1)
        low = jnp.max(jnp.where(slope < 0, far, -jnp.inf), axis=1)
        t = (low + jax.random.uniform(second, (len(y),), room.dtype) * (high - low))[:, None]
        return (y + t * directions[which], room - t * slope), None

    start = y, (offsets - y @ rows.T).astype(jnp.float32)
    return jax.lax.scan(step, start, steps)[0][0]


# For each number of chains, rows and steps one program.
WALK = Compiled(jax.jit(walk))
