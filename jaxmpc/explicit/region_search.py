"""Search for all critical regions, from one to the next across their facets."""

import time
from collections import deque

import numpy as np

from jaxmpc.checks import fail, whole
from jaxmpc.explicit.active_piece import Cell, cell
from jaxmpc.explicit.least_distance import DEPENDENT, LeastDistanceForm
from jaxmpc.sets.geometry import hull_volume
from jaxmpc.sets.polytope import Polytope

# The fraction of the volume, and the distance of a facet in coordinates where X_N just fits into
# [−1, 1]^n, up to which the regions must fill X_N.
FILL = 1e-9
# How far beyond a facet the region behind it is looked for, relative to the facet's region.
STEPS = (1e-2, 1e-4, 1e-6)
# Rounds of the search from what is missing, and random points of X_N from which each starts again.
REPAIRS, RESTARTS = 20, 50
DIMENSIONS = 6


class RegionSearch:
    """Breadth-first search across facets, from random points again until X_N is full. cells: active
    set → region, None for no volume."""

    def __init__(self, p: LeastDistanceForm, max_regions: int, deadline: float = np.inf) -> None:
        self.p, self.max_regions, self.deadline = p, max_regions, deadline
        self.begun = time.perf_counter()
        self.random = np.random.default_rng(0)
        self.cells: dict[tuple[int, ...], Cell | None] = {}
        self.found: list[Cell] = []
        self.queue: deque[Cell] = deque()

    @property
    def full(self) -> bool:
        """Return True once there are `max_regions`, or the deadline."""
        return len(self.found) >= self.max_regions or self.late

    @property
    def late(self) -> bool:
        """Return True once the deadline, of `time.monotonic`, is over."""
        return time.monotonic() > self.deadline

    def visit(self, active: tuple[int, ...] | None) -> Cell | None:
        """Return the region of an active set, and queue it when it is new."""
        if active is None:
            return None
        active = tuple(sorted(active))
        if active not in self.cells:
            new = cell(self.p, active)
            self.cells[active] = new
            if new is not None:
                self.found.append(new)
                self.queue.append(new)
        return self.cells[active]

    def cross_all(self) -> None:
        """Cross every facet of every queued region."""
        while self.queue and not self.full:
            here = self.queue.popleft()
            for i in range(len(here.h)):
                if not self.full:
                    self.cross(here, i)

    def cross(self, here: Cell, i: int) -> None:
        """Visit the regions behind facet i."""
        candidates: list[tuple[int, ...]] = []
        for row in here.behind[i].tolist():
            beyond = exchange(self.p, here.law.active, row)
            if beyond is None:  # the facet bounds X_N
                return
            candidates += beyond
        reached = [self.visit(active) for active in candidates]
        middle = here.middles[i]
        if any(c is not None and c.touches(middle) for c in reached):
            return
        # Several rows vanish on the facet at once: look just behind it.
        for step in STEPS:
            behind = self.visit(self.p.active(middle + step * here.radius * here.H[i]))
            if behind is not None and behind.touches(middle):
                return

    def restart(self) -> None:
        """Search on from random points of X_N, those in no region yet: on chords between points
        where rays from the interior point leave it."""
        n = len(self.p.center)
        for _ in range(RESTARTS):
            if self.full:
                return
            ends = [self.p.leave(d) for d in self.random.standard_normal((2, n))]
            if ends[0] is None or ends[1] is None:
                continue
            chord = ends[0] + self.random.random() * (ends[1] - ends[0])
            point = self.p.interior + self.random.random() * (chord - self.p.interior)
            if not any(np.all(c.H @ point <= c.h) for c in self.found):
                self.visit(self.p.active(point))
                self.cross_all()

    def fill(self) -> tuple[bool, str]:
        """Check that the regions fill X_N, and search on from what is missing; return (complete,
        reason)."""
        random, stale = self.random, 0
        why = ""
        for _ in range(REPAIRS):
            if self.late:
                return False, f"stopped by the time limit, after {len(self.found)} regions"
            if self.full:
                return False, f"stopped at the limit of {self.max_regions} regions"
            points = np.concatenate([c.vertices for c in self.found])
            volumes = sum(hull_volume(c.vertices, thin=True) for c in self.found)
            whole = hull_volume(points, thin=True)
            hull = Polytope.from_points(points)
            tops = [self.p.support(a) for a in np.asarray(hull.H) if not self.late]
            if self.late:
                continue
            beyond = np.array([value for value, _ in tops]) - np.asarray(hull.h)
            gap = 1 - volumes / whole
            why = (
                f"the volumes of the regions sum to that of their hull (relative gap {gap:.0e}); "
                f"X_N reaches beyond its {len(beyond)} facets by {max(beyond.max(), 0):.0e}, "
                "relative to its size, by one linear program each over all rows as given"
            )
            if beyond.max() <= FILL and abs(gap) <= FILL:
                return True, why
            before = len(self.found)
            for (_, corner), far in zip(tops, beyond, strict=True):
                if corner is not None and far > FILL:
                    inside = self.p.interior + (corner - self.p.interior) * (1 - 1e-6)
                    self.visit(self.p.active(inside))
            for c in list(self.found):
                if self.full:
                    break
                for middle, normal in zip(c.middles, c.H, strict=True):
                    corner = c.vertices[random.integers(len(c.vertices))]
                    # Anywhere on the facet, which is convex, and a little behind it.
                    to = corner - normal * (normal @ (corner - middle))
                    point = middle + 0.9 * random.random() * (to - middle)
                    self.visit(self.p.active(point + 1e-6 * c.radius * normal))
            self.cross_all()
            self.restart()
            stale = 0 if len(self.found) > before else stale + 1
            if stale == 2:
                break
        return False, why.replace("the volumes of", "a part was not found: the volumes of")


def explore(p: LeastDistanceForm, max_regions: int, deadline: float = np.inf) -> RegionSearch:
    """Run the search from an interior point across all facets, until the deadline of
    `time.monotonic`, and return it."""
    max_regions = whole("max_regions", max_regions, 1)
    if len(p.center) > DIMENSIONS:
        what = f"its states have {len(p.center)} coordinates, too many for vertices"
        cure = f"Regions serve up to {DIMENSIONS}; exact_penalty(method='samples') serves more"
        fail("mpc", what, cure)
    search = RegionSearch(p, max_regions, deadline)
    search.visit(p.active(p.interior))
    search.cross_all()
    for _ in range(REPAIRS):
        if search.found or search.late:
            break
        search.restart()
    if not search.found:
        fail("mpc", "no critical region was found: too ill-conditioned", "Scale states and inputs")
    return search


def exchange(
    p: LeastDistanceForm, active: tuple[int, ...], row: int
) -> list[tuple[int, ...]] | None:
    """Return the active sets behind a facet on which `row` vanishes; None where nothing is feasible
    there.

    A multiplier that vanishes: its row leaves. A row that becomes active joins; if it depends on
    the active ones, M_row = Σ α_j M_j, its multiplier t changes theirs to λ_j − t α_j, and one
    with α_j > 0 leaves. Without such a j, M_row + Σ|α_j| M_j = 0 is a Farkas certificate.
    """
    rows = [j for j in active if j != row]
    if len(rows) < len(active):
        return [tuple(rows)]
    if p.zero_row[row]:
        return None
    Q, R = np.linalg.qr(p.M[rows].T)
    along = Q.T @ p.M[row]
    if np.linalg.norm(p.M[row] - Q @ along) > DEPENDENT:
        return [(*active, row)]
    alpha = np.linalg.solve(R, along)
    leaving = np.flatnonzero(alpha > 1e-9 * np.abs(alpha).max(initial=0.0))
    if not len(leaving):
        return None
    return [(*(k for k in active if k != rows[j]), row) for j in leaving]
